"""The sections of the report, one function each: from what was read to HTML."""

import inspect
import platform
import re
from datetime import datetime
from html import escape
from importlib.metadata import version

import numpy as np
import pandas as pd

from sklearn_hd._model_step import ModelStep
from sklearn_hd._report.doubts import doubts, doubts_box
from sklearn_hd._report.facts import LEVEL, REACH, Run, exponents_of, motion_table, read_fitted
from sklearn_hd._report.page import attempt, digits, facts_table, figure, line, page, table
from sklearn_hd._sample_model import SampleModel
from sklearn_hd.algorithms.signals.fourier import harmonic_labels
from sklearn_hd.frequency import estimate_omega
from sklearn_hd.model_selection._scorers import last_model_step
from sklearn_hd.plotting import (
    BodeDisplay,
    EigenvalueDisplay,
    HarmonicsDisplay,
    PeriodicMatrixDisplay,
    ResidualDisplay,
    ResponseDisplay,
    SingularValueDisplay,
)

__all__ = ["whole_page"]

READINGS = {
    "sliding": "sliding: Fourier coefficients through a window that slides over the record",
    "period": "period: whole periods, one after another",
    "sample": "sample: each row as a sample with its azimuth",
    "plain": "plain: no fundamental frequency, each row is a sample",
}
PACKAGES = ("sklearn_hd", "numpy", "scipy", "scikit-learn", "pandas", "control", "slycot")
MOST_ROWS = 60  # of a table of parameters
LONGEST = 200  # letters of a parameter's value
TURNS = 8  # of a turning machine, in the closer picture of a response


def whole_page(pipe, X, y, validation, units, title):
    """The report as text of HTML."""
    units = dict(units or {})
    fitted = read_fitted(pipe, X, y, units)
    told = None if validation is None else _checked_validation(validation)
    run = None if told is None else _validated(fitted, told)
    sections = [
        ("data", "Data", _data(fitted)),
        ("harmonics", "Harmonics", _harmonics(fitted)),
        ("order", "Order", _order(fitted)),
        ("modes", "Modes", _modes(fitted)),
        ("model", "Model", _model(fitted)),
        ("residuals", "Residuals", _residuals(fitted)),
        ("validation", "Validation", _validation(fitted, told, run)),
        ("warnings", "Warnings", _warnings(fitted)),
        ("settings", "Settings", _settings(fitted)),
        ("versions", "Versions", _versions()),
    ]
    inputs = fitted.basis.input_signals
    named = f"Model of {', '.join(map(str, fitted.last.target_names_))}"
    named += f" from {', '.join(map(str, inputs))}" if inputs else ", from outputs alone"
    return page(str(title or named), _head(fitted, run), sections)


def _checked_validation(validation):
    """X and y of the validation record."""
    if not isinstance(validation, tuple | list) or len(validation) != 2:
        raise ValueError(
            f"validation={type(validation).__name__} is not understood; give a pair of inputs and "
            f"outputs, validation=(X_new, y_new), or None"
        )
    return tuple(validation)


def _validated(fitted, told):
    """The simulation over the validation record; ValueError if its columns do not fit."""
    step, handed = last_model_step(fitted.pipe, told[0])
    step._experiment(handed, told[1])
    return Run.of(step, handed, told[1], fitted.units)


def _head(fitted, run):
    """What the page says first: how good, how many states, and doubts."""
    n_states, own = fitted.last.model_.n_states, fitted.run
    if fitted.matcher is not None and fitted.matcher.match_.periodic is not None:
        n_states = fitted.matcher.match_.periodic.n_states
    if run is None:
        scored = (
            f"R² = {digits(own.r2, 4)} on the record that was used to fit. No validation record "
            f"was given: every figure on this page is of the record that was used to fit."
        )
    else:
        scored = (
            f"R² = {digits(run.r2, 4)} on the validation record, which was not used to fit, and "
            f"{digits(own.r2, 4)} on the record that was used to fit."
        )
    states = "1 state" if n_states == 1 else f"{n_states} states"
    checks = f"Checked: {'R² of the fit' if run is None else 'R² of both records'}, warnings that "
    checks += "can be made again"
    checks += "" if fitted.reducer is None else ", verdicts of the modes"
    checks += "." if isinstance(fitted.tests, str) else ", residual tests."
    if isinstance(fitted.tests, str):
        checks += " The residuals were not tested."
    return line(f"{scored} The model has {states}.") + doubts_box(doubts(fitted, run), checks)


# ---- data and how it was read ----------------------------------------------------------------


def _data(fitted):
    """Signals, rows, sampling, segments, trim, what the inputs did."""
    base, basis, experiment = fitted.experiment.base, fitted.basis, fitted.experiment
    lengths = [s.stop - s.start for s in base.segments]
    duration, step = sum(lengths) * base.sample_time, base.sample_time
    rows, records = len(fitted.y), len(set(base.records))
    given = rows if not lengths else sum(lengths)
    facts = {
        "rows": f"{rows:,}".replace(",", " "),
        "rows that the model reads": f"{given:,}".replace(",", " ") if given != rows else None,
        "records": records,
        "segments without a gap": f"{len(lengths)}, of {min(lengths)} to {max(lengths)} rows"
        if len(lengths) > 1
        else "1",
        "sample time": f"{digits(step, 6)} s ({digits(1.0 / step)} Hz)",
        "duration": f"{digits(duration)} s"
        + (f", {digits(duration * basis.omega / (2 * np.pi))} periods" if basis.harmonic else ""),
        "clock": "rows are counted: the data have no times" if base.counted else None,
        "jitter": f"{digits(base.jitter[0], 2)} s rms" if base.jitter[1] > 0.0 else None,
        "trim": _trim(fitted),
    }
    table_of_signals = pd.concat(
        [
            _signals(experiment.inputs, basis.input_signals, "input", fitted.units),
            _signals(experiment.outputs, experiment.output_names, "output", fitted.units),
        ]
    )
    words = ("role", "unit")
    note = "Motion: about the trim that was subtracted, if any." if basis.harmonic else None
    return "".join(
        [
            facts_table(facts),
            table(table_of_signals, words),
            line(note, "note") if note else "",
            line(_excited(fitted)),
            figure(
                lambda: ResponseDisplay.from_estimator(
                    fitted.pipe, fitted.X, fitted.y, units=fitted.units
                ),
                f"The record of the fit, measured and simulated{_first_of(records)}.",
            ),
        ]
    )


def _first_of(records):
    return "" if records == 1 else f" (the first of {records} records)"


def _signals(parts, names, role, units):
    """What each signal does on the grid, trim subtracted."""
    values = np.vstack(parts)
    if values.shape[1] == 0:
        return pd.DataFrame()
    names = names if len(names) == values.shape[1] else range(values.shape[1])
    table = {
        "role": role,
        "mean": values.mean(axis=0),
        "motion, rms": values.std(axis=0),
        "least": values.min(axis=0),
        "largest": values.max(axis=0),
        "unit": [units.get(name, "–") for name in names],
    }
    return pd.DataFrame(table, index=pd.Index([str(name) for name in names], name="signal"))


def _trim(fitted):
    """What was subtracted from the outputs, in words."""
    basis = fitted.basis
    if not basis.harmonic:
        return None
    if basis.output_trim is None:
        return "nothing was subtracted"
    if basis.reading == "sample" or not basis.trim_known:
        return "the forced periodic response was identified together with the dynamics"
    span = None if fitted.analyzer is None else fitted.analyzer.trim_span
    where = "in turns at rest, found in the record" if span == "auto" else f"trim_span={span!r}"
    sizes = ", ".join(
        f"{name} {digits(size, 3)}{_unit(name, fitted.units)} rms"
        for name, size in zip(
            [signal for signal, _ in basis.outputs], basis.output_trim.std(axis=0), strict=True
        )
    )
    return f"the mean waveform of a period was subtracted ({where}): {sizes}"


def _unit(name, units):
    return f" {units[name]}" if name in units else ""


def _excited(fitted):
    """What the inputs moved in, in words."""
    known = fitted.last._excitation
    if known is None:
        return "The record has no inputs, or the fit kept nothing of what they excite."
    moved, places = known.directions.moved.shape[1], known.directions.moved.shape[0]
    moving = [
        f"{name} in {digits(100.0 * share, 3)} % of the rows"
        for name, share in zip(known.names, _moving(fitted.experiment.inputs), strict=True)
    ]
    text = f"The inputs change: {', '.join(moving)}. They moved in {moved} of {places} directions"
    text += " (an input at a phase of the period each)." if places > len(known.names) else "."
    if known.information is not None:
        left = digits(100.0 * known.information.left, 3)
        text += f" The fit leaves {left} % (rms) of the motion that they cause."
    return text


def _moving(parts):
    """Share of the steps from row to row at which each input changes notably."""
    steps = np.vstack([np.abs(np.diff(u, axis=0)) for u in parts])
    size = np.max([np.ptp(u, axis=0) for u in parts], axis=0)
    return np.mean(steps > 1e-3 * size, axis=0)


def _harmonics(fitted):
    """Reading, frequency, harmonics, window."""
    basis = fitted.basis
    facts = {"reading": READINGS[basis.reading]}
    if not basis.harmonic:
        return facts_table(facts) + line("There are no harmonics: the data have no analyzer.")
    sample = basis.reading == "sample"
    kept = {
        f"harmonics of {name}": ", ".join(map(str, orders))
        for name, orders in (*basis.inputs, *basis.outputs)
        if not sample
    }
    spp = basis.samples_per_period
    facts |= {
        "omega": f"{digits(basis.omega, 9)} rad/s ({digits(basis.omega / (2 * np.pi), 6)} Hz)",
        "omega, from the record": _omega_found(fitted),
        "rows in a period": digits(spp, 6),
        "azimuth": basis.timing.azimuth,
        "window": basis.window if basis.reading == "sliding" else None,
        "rows read": "every sample" if basis.hop == 1 else f"every {basis.hop} samples",
    } | kept
    if sample:
        facts["harmonics of the dynamics"] = fitted.last.model_.innovations.n_harmonics if (
            isinstance(fitted.last.model_, SampleModel)
        ) else None
    return facts_table(facts) + figure(
        lambda: HarmonicsDisplay.from_estimator(
            fitted.pipe, fitted.X, fitted.y, units=fitted.units
        ),
        "The signals, and their Fourier coefficients over time.",
    )


def _omega_found(fitted):
    """What the record says of the frequency, in words."""
    basis = fitted.basis
    if basis.timing.azimuth is not None:
        return "not estimated: the azimuth was measured"
    timing = fitted.analyzer.sample_time, fitted.analyzer.missing
    try:
        found = estimate_omega(
            fitted.X, fitted.y, basis.omega, sample_time=timing[0], missing=timing[1]
        )
    except ValueError as error:
        return f"not estimated: {error}"
    off = basis.omega - found.omega
    text = f"{digits(found.omega, 9)} ± {digits(REACH * found.std, 2)} rad/s (95 %); "
    text += f"omega differs by {digits(off, 2)} rad/s, {digits(found.turns, 2)} turns in all"
    if found.drift:
        text += f"; it drifts by {digits(found.drift, 3)} ± {digits(REACH * found.drift_std, 2)}"
    return text


# ---- the models --------------------------------------------------------------------------------


def _order(fitted):
    """Singular values and the search for the order."""
    step = fitted.identifier
    if step is None:
        return line("There is no MOESPRegressor in this pipeline: no order was searched.")
    asked = "found by the data" if step.order == "auto" else "given"
    facts = {
        "order": f"{step.order_} ({asked})",
        "block rows": step.block_rows_,
        "noise floor of the singular values": digits(step.noise_floor_, 3),
        "feedthrough": f"{digits(bool(step.feedthrough_))}: {step.feedthrough_reason_}",
    }
    search = pd.DataFrame(step.order_search_)
    tried = ""
    if len(search):
        search = search.sort_values(["order", "n_harmonics"]).set_index("order")
        search["share"] *= 100.0
        names = {
            "n_harmonics": "harmonics",
            "feedthrough": "feedthrough",
            "stable": "stable",
            "share": "left (% rms)",
            "bic": "BIC",
        }
        tried = "<h3>Orders tried</h3>" + table(search[list(names)].rename(columns=names))
    return (
        facts_table(facts)
        + figure(
            lambda: SingularValueDisplay.from_estimator(fitted.pipe),
            "Singular values by order; the order taken is marked.",
        )
        + tried
    )


def _modes(fitted):
    """Modes with verdicts, and the second opinion."""
    parts = []
    if fitted.reducer is None:
        parts.append(line("There is no SpuriousModeReducer in this pipeline: no verdicts."))
        if fitted.identifier is not None:
            parts.append(table(motion_table(fitted.identifier.model_.exponents())))
    else:
        modes = fitted.reducer.modes_
        modes.index = pd.RangeIndex(1, len(modes) + 1, name="mode")
        z = modes["eigenvalue"]
        modes.insert(1, "frequency (Hz)", np.abs(np.imag(z)) / (2.0 * np.pi))
        modes = modes.rename(columns={"eigenvalue": "eigenvalue (1/s)"})
        parts.append(table(modes, ("verdict", "reason")))
    parts.append(_opinion(fitted))
    parts.append(
        figure(
            lambda: EigenvalueDisplay.from_estimator(fitted.pipe),
            "Modes identified, and after matching where there is a match.",
        )
    )
    return "".join(parts)


def _opinion(fitted):
    """What another way has found of the exponents."""
    step = fitted.reducer or fitted.identifier
    opinion = None if step is None else step.model_.opinion
    if opinion is None:
        why = "plain data" if not fitted.basis.harmonic else "this reading, or this record,"
        return line(f"There is no second opinion of the exponents: {why} gives none.")
    exponents = step.model_.exponents()
    nearest, apart, _ = opinion.about(exponents)
    order = np.lexsort((exponents.imag, -exponents.real))
    near = np.abs(opinion.exponents[:, None] - exponents + 0.0)
    turns = np.round((exponents - opinion.exponents[:, None]).imag / opinion.omega)
    near = np.abs(opinion.exponents[:, None] + 1j * opinion.omega * turns - exponents)
    spread = opinion.deviations[near.argmin(axis=0)] if len(near) else np.nan + 0 * apart
    compared = pd.DataFrame(
        {
            "model (1/s)": exponents[order],
            "second opinion (1/s)": nearest[order],
            "± (95 %)": REACH * spread[order],
            "apart (% of the rate)": 100.0 * apart[order],
        },
        index=pd.RangeIndex(1, len(exponents) + 1, name="exponent"),
    )
    return f"<h3>Second opinion: {escape(opinion.way)}</h3>" + table(compared)


def _model(fitted):
    """The last model: exponents and entries with their intervals."""
    step, matcher = fitted.last, fitted.matcher
    if matcher is None:
        parts = [line("There is no StructuredMatcher in this pipeline: the model is as identified.")]
    else:
        parts = [facts_table(_match_facts(matcher))]
        if matcher.structure is not None:
            parts.append(f"<h3>Structure</h3><div class='wide'>{matcher.structure._repr_html_()}</div>")
    std = None
    if matcher is not None and matcher.match_.uncertainty is not None:
        found = matcher.eigenvalues_
        exponents, std = found["eigenvalue"], found["std_real"] + 1j * found["std_imag"]
    else:
        exponents = exponents_of(step)
    periodic = fitted.basis.harmonic
    parts += [
        f"<h3>{'Exponents' if periodic else 'Eigenvalues'} of the model</h3>",
        table(motion_table(exponents, None if std is None else np.asarray(std))),
        line(
            (f"±: half widths of {LEVEL:.0%} intervals. " if std is not None else _no_intervals(step))
            + (
                "Floquet exponents are known but for multiples of jω, and so are frequency and "
                "damping ratio."
                if periodic
                else ""
            ),
            "note",
        ),
        attempt(lambda: _entries(fitted), "The entries of the model are not shown"),
        figure(lambda: _picture(fitted), "The model: F(ψ), or its frequency response."),
    ]
    if isinstance(step.model_, SampleModel) and fitted.identifier is not None:
        parts.append(_loads(fitted))
    return "".join(parts)


def _no_intervals(step):
    return (
        "There are no intervals: only StructuredMatcher(criterion='output_error') and "
        "'prediction_error' have standard deviations. "
    )


def _match_facts(matcher):
    """How the match was made, and how good it is."""
    error = matcher.hinf_error_relative_
    likely = matcher.match_.uncertainty
    kinds = {
        "information": "from the information of white noise",
        "robust": "robust, from blocks of the record, for the residuals are no white noise",
    }
    return {
        "criterion": matcher.criterion,
        "relative H∞ error to the identified model": None
        if np.isnan(error)
        else f"{digits(100.0 * error, 3)} % at {digits(matcher.peak_frequency_)} rad/s",
        "iterations": matcher.n_iter_,
        "deviations": None if likely is None else kinds.get(likely.kind, likely.kind),
        "noise of the outputs, rms": None
        if likely is None
        else ", ".join(f"{name} {digits(v, 3)}" for name, v in matcher.noise_std_.items()),
    }


def _picture(fitted):
    """F(ψ) of a periodic model, else the frequency response."""
    matcher, last = fitted.matcher, fitted.last
    sampled = isinstance(last.model_, SampleModel) and not last.model_.time_invariant
    if (matcher is not None and matcher.match_.periodic is not None) or sampled:
        return PeriodicMatrixDisplay.from_estimator(fitted.pipe, "F")
    return BodeDisplay.from_estimator(fitted.pipe, units=fitted.units)


def _entries(fitted):
    """Parameters with intervals, or the matrices of the model."""
    matcher = fitted.matcher
    if matcher is None or (matcher.structure is None and matcher.match_.periodic is None):
        return _matrices(fitted.last)
    theta = matcher.theta_
    if not len(theta):
        return _fourier(matcher.match_.periodic)
    reach = REACH * matcher.theta_std_
    cells = pd.Series(
        [_with_reach(*pair) for pair in zip(theta, reach, strict=True)], index=theta.index
    )
    named = [re.fullmatch(r"(.+)_(\d+[cs]?)", name) for name in theta.index]
    if all(named) and matcher.match_.periodic is not None:
        rows, columns = zip(*(found.groups() for found in named), strict=True)
        shown = pd.DataFrame({"entry": rows, "harmonic": columns, "value": list(cells)})
        shown = shown.pivot(index="entry", columns="harmonic", values="value")
        shown = shown.loc[list(dict.fromkeys(rows)), list(dict.fromkeys(columns))].fillna("–")
    else:
        shown = cells.to_frame("value").rename_axis("parameter")
    left = len(shown) - MOST_ROWS
    note = line(f"{left} more rows are in theta_ of the matcher.", "note") if left > 0 else ""
    how = "" if reach.isna().all() else f"Value ± half width of the {LEVEL:.0%} interval. "
    how += "F[a,b] is in the unit of a by the unit of b, per second; G the same by input b; P[a,b] "
    how += "and Q[a,b] in the unit of output a by the unit of b."
    if matcher.match_.periodic is None:
        how = how.split("F[a,b]")[0]
    return "<h3>Parameters</h3>" + table(shown.head(MOST_ROWS)) + note + line(how, "note")


def _with_reach(value, reach):
    """A value and the half width of its interval, to the digits that the width tells."""
    if np.isnan(reach):
        return digits(value)
    if not np.isfinite(reach) or reach <= 0.0 or value == 0.0:
        return f"{digits(value)} ± {digits(reach, 2)}"
    count = int(np.clip(np.floor(np.log10(abs(value) / reach)) + 2, 1, 8))
    return f"{digits(value, count)} ± {digits(reach, 2)}"


def _fourier(periodic):
    """Fourier coefficients of F, G, P and Q, one row an entry."""
    states, inputs, outputs = periodic.state_names, periodic.input_names, periodic.output_names
    sides = {"F": (states, states), "G": (states, inputs), "P": (outputs, states)}
    sides["Q"] = outputs, inputs
    parts = []
    for name, M in zip("FGPQ", periodic.matrices(), strict=True):
        rows, columns = sides[name]
        labels = [f"{name}[{a},{b}]" for a in rows for b in columns]
        if np.any(M):
            values = M.reshape(len(M), -1).T
            parts.append(pd.DataFrame(values, index=labels))
    whole = pd.concat(parts).rename_axis("entry")
    whole.columns = harmonic_labels(range(whole.shape[1] // 2 + 1))
    kept = [c for c in whole.columns if c == "0" or whole[c].any()]
    return "<h3>Fourier coefficients</h3>" + table(whole[kept].head(MOST_ROWS))


def _matrices(step):
    """A, B, C, D with the names of their signals."""
    system = step.system_
    states, inputs, outputs = system.state_labels, system.input_labels, system.output_labels
    shapes = {"A": (states, states), "B": (states, inputs), "C": (outputs, states)}
    shapes["D"] = outputs, inputs
    parts = [
        f"<h3>{name}</h3>" + table(pd.DataFrame(getattr(system, name), rows, columns))
        for name, (rows, columns) in shapes.items()
    ]
    clock = f"discrete, sample time {digits(system.dt, 6)} s" if system.dt else "continuous time"
    return line(f"Matrices of system_ ({clock}).") + "".join(parts)


def _loads(fitted):
    """Forced periodic response of a model of samples."""
    return "<h3>Loads: forced periodic response of the outputs</h3>" + attempt(
        lambda: table(fitted.identifier.loads_.T), "The loads are not shown"
    )


# ---- how good ----------------------------------------------------------------------------------


def _residuals(fitted):
    """Residual tests and the picture of residuals."""
    if isinstance(fitted.tests, str):
        return line(f"The residuals were not tested: {fitted.tests}")
    tests = fitted.tests.copy()
    tests["share"] *= 100.0
    names = {
        "statistic": "statistic",
        "degrees": "degrees of freedom",
        "p_value": "p value",
        "share": "no noise (% of variance)",
        "passed": "passed",
    }
    return (
        line("If the model is right, what it leaves of the record is noise, and every test passes.")
        + table(tests.rename(columns=names))
        + figure(
            lambda: ResidualDisplay.from_estimator(
                fitted.pipe, fitted.X, fitted.y, units=fitted.units
            ),
            "Correlations of the residuals with themselves and with the inputs. The band holds "
            "99 % of the correlations of noise.",
        )
    )


def _validation(fitted, told, run):
    """Scores by output of both records, and by step."""
    parts = []
    if run is None:
        parts.append(
            line(
                "No validation record was given. These figures are of the record that was used to "
                "fit, and may be better than those of a new record. Give report(..., "
                "validation=(X_new, y_new))."
            )
        )
    else:
        parts.append("<h3>Validation record, not used to fit</h3>" + _run(run))
        parts.append(
            figure(
                lambda: ResponseDisplay.from_estimator(fitted.pipe, *told, units=fitted.units),
                "The validation record, measured and simulated.",
            )
        )
    parts.append("<h3>Record that was used to fit</h3>" + _run(fitted.run))
    parts.append(
        line(
            "R² and fit are those of the free simulation about the trim: 1 and 100 % are perfect, "
            "0 is as good as the mean. fit = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖).",
            "note",
        )
    )
    return "".join(parts)


def _run(run):
    """A table of a simulation, or why there is none."""
    if run.reason is not None:
        return line(f"There is no score: {run.reason}")
    return table(run.outputs, ("unit",)) + line(f"{run.n_rows} rows were compared.", "note")


def _warnings(fitted):
    """Warnings that were made again, and what they cannot include."""
    unknown = line(
        "A fitted model does not keep the warnings of its fit. This report repeats those that need "
        "no fit of the model: of the analyzer, the frequency, exponents in doubt, and the inputs. "
        "It cannot know those of the search for the order and of the match (such as a search that "
        "stopped early). Fit again to see them.",
        "note",
    )
    if not fitted.told:
        return line("None of the warnings that were made again was raised.") + unknown
    items = "".join(f"<li><b>{escape(kind)}</b>: {escape(text)}</li>" for kind, text in fitted.told)
    return f"<ul>{items}</ul>{unknown}"


def _settings(fitted):
    """Every parameter of every step; those that were left at their default are said to be."""
    parts = []
    for name, step in fitted.steps.items():
        if not hasattr(step, "get_params"):
            parts.append(line(f"{name}: {step!r}"))
            continue
        known = inspect.signature(type(step).__init__).parameters
        rows = {
            key: (_shortened(value), "default" if _is_default(value, known.get(key)) else "set")
            for key, value in step.get_params(deep=False).items()
        }
        shown = pd.DataFrame(rows.values(), list(rows), ["value", ""]).rename_axis("parameter")
        heading = f"{name}: {type(step).__name__}"
        heading = type(step).__name__ if name == type(step).__name__ else heading
        parts.append(f"<h3>{escape(heading)}</h3>" + table(shown, ("value", "")))
    return "".join(parts)


def _shortened(value):
    """A value as Python writes it, on one line, cut where it is long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def _is_default(value, parameter):
    """Whether a parameter was left as it is."""
    if parameter is None or isinstance(value, ModelStep):
        return False
    same = value is parameter.default or _shortened(value) == _shortened(parameter.default)
    return bool(same)


def _versions():
    """What made the model, and when the page was written."""
    facts = {"page written": f"{datetime.now():%Y-%m-%d %H:%M}"}
    facts |= {"Python": platform.python_version(), "machine": platform.platform(terse=True)}
    return facts_table(facts | {name: version(name) for name in PACKAGES}) + line(
        "These are the versions that wrote this page; the model may have been fitted with others.",
        "note",
    )
