"""The sections of the report, one function each: from what was read to HTML."""

import inspect
import platform
import warnings
from collections.abc import Mapping
from datetime import datetime
from html import escape
from importlib.metadata import version

import numpy as np
import pandas as pd

from sklearn_hd._containers import without_inputs
from sklearn_hd._frame import SampleModel
from sklearn_hd._model_step import ModelStep
from sklearn_hd._report import models
from sklearn_hd._report.facts import (
    Run,
    doubts,
    doubts_box,
    read_fitted,
    stands,
    words_of,
)
from sklearn_hd._report.page import closed_figures, digits, facts_table, figure, line, page, table
from sklearn_hd.frequency import estimate_omega
from sklearn_hd.model_selection._scorers import last_model_step
from sklearn_hd.plotting import AzimuthDisplay, HarmonicsDisplay, ResponseDisplay
from sklearn_hd.plotting._display import REACH, Record

READINGS = {
    "sliding": "sliding: Fourier coefficients through a window that slides over the record",
    "period": "period: whole periods, one after another",
    "sample": "sample: each row as a sample with its azimuth",
    "plain": "plain: no fundamental frequency, each row is a sample",
}
PACKAGES = ("sklearn_hd", "numpy", "scipy", "scikit-learn", "pandas", "control", "slycot")
LONGEST = 200  # letters of a parameter's value
MOST_DRAWN = 5000  # rows that a picture shows apart, some five for each of its pixels
CLOSER = 500  # rows of a longer record that are drawn


@closed_figures()
def whole_page(pipe, X, y, validation, units, title):
    """The report as text of HTML."""
    if units is not None and not isinstance(units, Mapping):
        raise ValueError(f"units={units!r} is not understood; give a dict, such as {{'w': 'm/s'}}")
    told = None if validation is None else _checked_validation(validation)
    fitted = read_fitted(pipe, X, y, dict(units or {}))
    signals = [*fitted.basis.input_signals, *fitted.experiment.output_names]
    foreign = [name for name in fitted.units if name not in signals]
    if foreign:
        raise ValueError(f"units= names {foreign}, but the signals are {signals}")
    run = None if told is None else _validated(fitted, told)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those that tell something of the model are collected
        return _page(fitted, told, run, title)


def _page(fitted, told, run, title):
    sections = [
        ("data", "Data", _data(fitted)),
        ("harmonics", "Harmonics", _harmonics(fitted)),
        ("order", "Order", models.order_section(fitted)),
        ("modes", "Modes", models.modes_section(fitted)),
        ("model", "Model", models.model_section(fitted)),
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
    X, y = told
    X = without_inputs(y) if X is None else X
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        step, handed = last_model_step(fitted.pipe, X)
        step._experiment(handed, y)
        run = Run.of(step, handed, y, fitted.units)
    fitted.told.extend(words_of(raised, "of the validation record: "))
    return run


def _head(fitted, run):
    """What the page says first: how good, how many states, and doubts."""
    n_states, own = (fitted.periodic or fitted.last.model_).n_states, fitted.run
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
        "rows": f"{rows:,}".replace(",", "\u202f"),
        "rows that the model reads": f"{given:,}".replace(",", "\u202f") if given != rows else None,
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
    note = line("Motion: about the trim that was subtracted, if any.", "note")
    return "".join(
        [
            facts_table(facts),
            table(table_of_signals, ("role", "unit")),
            note if basis.harmonic else "",
            line(_excited(fitted)),
            _response(fitted, fitted.X, fitted.y, "The record of the fit"),
        ]
    )


def _response(fitted, X, y, what):
    """Measured and simulated outputs; a part of a record that is too long to be read."""
    record = Record(y, None, fitted.basis.timing)
    span, shown = None, "" if record.label is None else f", record {record.label}"
    if len(record.time) > MOST_DRAWN:
        middle = (len(record.time) - CLOSER) // 2
        span = record.time[middle], record.time[middle + CLOSER]
        shown += f": {CLOSER} of its {len(record.time)} rows, from the middle; the fit is of all"
    return figure(
        lambda: ResponseDisplay.from_estimator(fitted.pipe, X, y, span=span, units=fitted.units),
        f"{what}, measured and simulated{shown}.",
    )


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
    if basis.reading == "sample" or not basis.trim_known:
        return "the forced periodic response was identified together with the dynamics"
    if basis.output_trim is None:
        return "nothing was subtracted"
    span = None if fitted.analyzer is None else fitted.analyzer.trim_span
    where = "in turns at rest, found in the record" if span == "auto" else f"trim_span={span!r}"
    units = {name: f" {unit}" for name, unit in fitted.units.items()}
    sizes = ", ".join(
        f"{name} {digits(size, 3)}{units.get(name, '')} rms"
        for (name, _), size in zip(basis.outputs, basis.output_trim.std(axis=0), strict=True)
    )
    return f"the mean waveform of a period was subtracted ({where}): {sizes}"


def _excited(fitted):
    """What the inputs moved in, in words."""
    known = fitted.last._excitation
    if known is None:
        return "The record has no inputs, or the fit kept nothing of what they excite."
    places, moved = known.directions.moved.shape
    n_steps = sum(len(u) - 1 for u in fitted.experiment.inputs)
    moving = [
        f"{name} at {count} of {n_steps} rows"
        for name, count in zip(known.names, _moving(fitted.experiment.inputs), strict=True)
    ]
    text = f"The inputs change: {', '.join(moving)}."
    if moved < places:
        what = "an input at a phase of the period each" if places > len(known.names) else "inputs"
        text += f" They moved in {moved} of {places} directions ({what})."
    if known.information is not None:
        left = digits(100.0 * known.information.left, 3)
        text += f" The fit leaves {left} % (rms) of the motion that they cause."
    return text


def _moving(parts):
    """Number of rows at which each input is notably other than the row before."""
    steps = np.vstack([np.abs(np.diff(u, axis=0)) for u in parts])
    size = np.max([np.ptp(u, axis=0) for u in parts], axis=0)
    return np.sum(steps > 1e-3 * size, axis=0)


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
        model = None if fitted.identifier is None else fitted.identifier.model_
        if isinstance(model, SampleModel):
            facts["harmonics of the dynamics"] = model.innovations.n_harmonics
            facts["harmonics of the loads"] = model.n_loads
        drawn = figure(
            lambda: AzimuthDisplay.from_estimator(fitted.pipe, units=fitted.units),
            "The model by azimuth: loads, noise, and the response to pulses at four azimuths.",
        )
        return facts_table(facts) + drawn
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
    known = {"sample_time": fitted.analyzer.sample_time, "missing": fitted.analyzer.missing}
    try:
        found = estimate_omega(fitted.X, fitted.y, basis.omega, **known)
    except ValueError as error:
        return f"not estimated: {error}"
    if found.rivals:
        rivals = ", ".join(digits(rival, 6) for rival in found.rivals)
        return f"not told: {rivals} rad/s explain the record as well"
    off = basis.omega - found.omega
    text = f"{digits(found.omega, 9)} ± {digits(REACH * found.std, 2)} rad/s (95 %); "
    text += f"omega differs by {digits(off, 2)} rad/s, {digits(found.turns, 2)} turns in all"
    if found.drift:
        text += f"; it drifts by {digits(found.drift, 3)} ± {digits(REACH * found.drift_std, 2)}"
    return text


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
    text = "If the model is linear and right, what it leaves of the record is noise, and every "
    text += "test passes."
    if stands(fitted.matcher) and not tests["passed"].all():
        text += " Some fail, as of a nonlinear machine. Standard deviations come from comparing "
        text += "blocks and parts of the record; they leave no exponent in doubt."
    return (
        line(text)
        + table(tests.rename(columns=names))
        + figure(
            lambda: fitted.residuals,
            "Correlations of the residuals with themselves and with the inputs. The band holds "
            "99 % of the correlations of noise.",
        )
    )


def _validation(fitted, told, run):
    """Scores by output of both records, and by step."""
    if run is None:
        new = line(
            "No validation record was given. These figures are of the record that was used to fit, "
            "and may be better than those of a new record. Give report(..., "
            "validation=(X_new, y_new))."
        )
    else:
        new = "<h3>Validation record, not used to fit</h3>" + _run(run)
        new += _response(fitted, *told, "The validation record")
    note = line(
        "R² and fit are those of the free simulation about the trim: 1 and 100 % are perfect, "
        "0 is as good as the mean. fit = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖).",
        "note",
    )
    return f"{new}<h3>Record that was used to fit</h3>{_run(fitted.run)}{note}"


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
        kind = type(step).__name__
        heading = kind if name == kind else f"{name}: {kind}"
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
    return value is parameter.default or _shortened(value) == _shortened(parameter.default)


def _versions():
    """What made the model, and when the page was written."""
    facts = {"page written": f"{datetime.now():%Y-%m-%d %H:%M}"}
    facts |= {"Python": platform.python_version(), "machine": platform.platform(terse=True)}
    return facts_table(facts | {name: version(name) for name in PACKAGES}) + line(
        "These are the versions that wrote this page; the model may have been fitted with others.",
        "note",
    )
