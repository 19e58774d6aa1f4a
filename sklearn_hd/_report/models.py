"""The sections of the report on order, modes and model."""

import re

import numpy as np
import pandas as pd

from sklearn_hd._frame import SampleModel
from sklearn_hd._report.facts import exponents_of, motion_table
from sklearn_hd._report.page import attempt, digits, facts_table, figure, line, table, with_reach
from sklearn_hd.algorithms.signals.fourier import harmonic_labels
from sklearn_hd.plotting import (
    BodeDisplay,
    EigenvalueDisplay,
    PeriodicMatrixDisplay,
    SingularValueDisplay,
)
from sklearn_hd.plotting._display import LEVEL, REACH

MOST_ROWS = 60  # of a table of parameters
MOST_STATES = 20  # whose matrices are shown
MOST_PAIRS = 6  # of an input and an output, in one picture of frequency responses


def order_section(fitted):
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
    if step.nonlinear_degrees_:
        degrees = " and ".join(map(str, step.nonlinear_degrees_))
        facts["not linear"] = (
            f"products of {degrees} states and inputs were further inputs of the fit: the model is "
            f"that of small motions, and its score on a record of large ones is lower"
        )
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


def modes_section(fitted):
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
        modes["family"] = [int(f) if f >= 0 else "–" for f in modes["family"]]
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
        why = "plain data have" if not fitted.basis.harmonic else "this reading, or record, has"
        return line(f"There is no second opinion of the exponents: {why} none.")
    exponents = step.model_.exponents()
    exponents = exponents[np.lexsort((exponents.imag, -exponents.real))]
    nearest, apart, spread = opinion.about(exponents)
    compared = {"model (1/s)": exponents}
    if not opinion.own:
        compared |= {"second opinion (1/s)": nearest, "apart (% of the rate)": 100.0 * apart}
    compared |= {"± (95 %, % of the rate)": 100.0 * REACH * spread}
    compared = pd.DataFrame(
        {
            name: [digits(v, 4 if np.iscomplexobj(values) else 2) for v in values]
            for name, values in compared.items()
        },
        index=pd.RangeIndex(1, len(exponents) + 1, name="exponent"),
    )
    source = opinion.way.removesuffix(" have").removesuffix(" has")
    text = f"Another way to find the exponents of this record: {source}."
    if opinion.own:
        text += " ± says how well it knows those of the model."
    return "<h3>Second opinion</h3>" + line(text) + table(compared)


def model_section(fitted):
    """The last model: exponents and entries with their intervals."""
    step, matcher = fitted.last, fitted.matcher
    if matcher is None:
        parts = [
            line("There is no StructuredMatcher in this pipeline: the model is as identified.")
        ]
    else:
        parts = [facts_table(_match_facts(matcher))]
        if matcher.structure is not None:
            parts.append(
                f"<h3>Structure</h3><div class='wide'>{matcher.structure._repr_html_()}</div>"
            )
    std = None
    if matcher is not None and matcher.match_.uncertainty is not None:
        found = matcher.eigenvalues_
        exponents, std = found["eigenvalue"], found["std_real"] + 1j * found["std_imag"]
    else:
        exponents = exponents_of(step)
    note = f"±: half widths of {LEVEL:.0%} intervals. "
    if std is None:
        note = "There are no intervals: only StructuredMatcher(criterion='output_error') and "
        note += "'prediction_error' have standard deviations. "
    periodic = fitted.basis.harmonic
    if periodic:
        note += "Floquet exponents are known but for multiples of jω, and so are frequency and "
        note += "damping ratio."
    parts += [
        f"<h3>{'Exponents' if periodic else 'Eigenvalues'} of the model</h3>",
        table(motion_table(exponents, std)),
        line(note, "note"),
        attempt(lambda: _entries(fitted), "The entries of the model are not shown"),
        figure(
            lambda: _picture(fitted),
            "The model: what varies over the turn, or the frequency response "
            f"(of {MOST_PAIRS} pairs of signals at most).",
        ),
    ]
    if isinstance(step.model_, SampleModel) and fitted.identifier is not None:
        parts.append("<h3>Loads: forced periodic response of the outputs</h3>")
        parts.append(attempt(lambda: table(fitted.identifier.loads_.T), "The loads are not shown"))
    return "".join(parts)


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
    periodic, last = fitted.periodic, fitted.last
    sampled = isinstance(last.model_, SampleModel) and not last.model_.time_invariant
    if periodic is not None or sampled:
        varies = [name for name in "FGP" if periodic is not None and periodic.highest(name)]
        return PeriodicMatrixDisplay.from_estimator(fitted.pipe, (varies or ["F"])[0])
    system = last.system_
    inputs = system.input_labels[:MOST_PAIRS]
    outputs = system.output_labels[: max(1, MOST_PAIRS // len(inputs))]
    return BodeDisplay.from_estimator(
        fitted.pipe, inputs=inputs, outputs=outputs, units=fitted.units
    )


def _entries(fitted):
    """Parameters with intervals, or the matrices of the model."""
    matcher, periodic = fitted.matcher, fitted.periodic
    if matcher is None or (matcher.structure is None and periodic is None):
        return _matrices(fitted.last)
    theta = matcher.theta_
    if not len(theta):
        return _fourier(periodic)
    reach = REACH * matcher.theta_std_
    cells = [with_reach(*pair) for pair in zip(theta, reach, strict=True)]
    named = [re.fullmatch(r"(.+\])_(\d+[cs]?)", name) for name in theta.index]
    alone = {n: c for n, c, found in zip(theta.index, cells, named, strict=True) if not found}
    shown = pd.DataFrame(
        [(*found.groups(), c) for c, found in zip(cells, named, strict=True) if found],
        columns=["entry", "harmonic", "value"],
    )
    order = list(dict.fromkeys(shown["entry"])), list(dict.fromkeys(shown["harmonic"]))
    shown = shown.pivot_table(index="entry", columns="harmonic", values="value", aggfunc="first")
    shown = shown.reindex(order[0]).reindex(columns=order[1]).fillna("–")
    single = pd.DataFrame({"value": alone}).rename_axis("parameter")
    left = max(len(shown), len(single)) - MOST_ROWS
    note = line(f"{left} more rows are in theta_ of the matcher.", "note") if left > 0 else ""
    how = "" if reach.isna().all() else f"Value ± half width of the {LEVEL:.0%} interval. "
    how += "F[a,b] is in the unit of a by the unit of b, per second; G the same by input b; P[a,b] "
    how += "and Q[a,b] in the unit of output a by the unit of b."
    if periodic is None:
        how = how.split("F[a,b]")[0]
    tables = [table(each.head(MOST_ROWS)) for each in (shown, single) if len(each)]
    return "<h3>Parameters</h3>" + "".join(tables) + note + line(how, "note")


def _fourier(periodic):
    """Fourier coefficients of F, G, P and Q, one row an entry."""
    sides = _sides(periodic.state_names, periodic.input_names, periodic.output_names)
    parts = []
    for name, M, (rows, columns) in zip("FGPQ", periodic.matrices(), sides, strict=True):
        if np.any(M):
            labels = [f"{name}[{a},{b}]" for a in rows for b in columns]
            parts.append(pd.DataFrame(M.reshape(len(M), -1).T, index=labels))
    whole = pd.concat(parts).rename_axis("entry")
    whole.columns = harmonic_labels(range(whole.shape[1] // 2 + 1))
    kept = [c for c in whole.columns if c == "0" or whole[c].any()]
    return "<h3>Fourier coefficients</h3>" + table(whole[kept].head(MOST_ROWS))


def _matrices(step):
    """A, B, C, D with the names of their signals."""
    system = step.system_
    if system.nstates > MOST_STATES:
        return line(f"The matrices of {system.nstates} states are not shown; see system_.")
    sides = _sides(system.state_labels, system.input_labels, system.output_labels)
    parts = [
        f"<h3>{name}</h3>" + table(pd.DataFrame(getattr(system, name), rows, columns))
        for name, (rows, columns) in zip("ABCD", sides, strict=True)
    ]
    clock = f"discrete, sample time {digits(system.dt, 6)} s" if system.dt else "continuous time"
    return line(f"Matrices of system_ ({clock}).") + "".join(parts)


def _sides(states, inputs, outputs):
    """Names of the rows and columns of F, G, P, Q, or of A, B, C, D."""
    return (states, states), (states, inputs), (outputs, states), (outputs, inputs)
