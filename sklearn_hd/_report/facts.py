"""What a report reads once of a fitted pipeline and its records.

What speaks against a model: each doubt with its figure and the section that shows more.
"""

import warnings
from dataclasses import dataclass
from html import escape

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from sklearn.base import clone
from sklearn.pipeline import Pipeline
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._containers import without_inputs
from sklearn_hd._fit_checks import warn_of_mismatch
from sklearn_hd._guards import first_of
from sklearn_hd._model_step import ModelStep
from sklearn_hd._opinion import DOUBT, contradictions, warn_unconfirmed
from sklearn_hd._records.data import Experiment
from sklearn_hd._report.page import REFUSALS, digits, with_reach
from sklearn_hd._simulators import scored_simulation
from sklearn_hd.exceptions import UnstableModelError
from sklearn_hd.harmonics import HarmonicAnalyzer
from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.model_selection._scorers import last_model_step
from sklearn_hd.plotting import ResidualDisplay
from sklearn_hd.plotting._display import REACH, compared_names, find_step, steps_of
from sklearn_hd.reduction import SpuriousModeReducer
from sklearn_hd.subspace import MOESPRegressor

HARMLESS = (  # of how rows were read, and of coordinates
    "CoordinatesWarning",
    "TimeBaseWarning",
    "JitterWarning",
    "ResamplingWarning",
)
ANCHORS = {  # of the section that shows what a warning is about
    "ExcitationWarning": "data",
    "FrequencyMismatchWarning": "harmonics",
    "IdentifiabilityWarning": "modes",
    "InstabilityWarning": "modes",
}
UNSURE = ("ambiguous", "second-order")


@dataclass(frozen=True, eq=False)
class Run:
    """A free simulation over one record, as ``score`` has it."""

    outputs: pd.DataFrame  # by output: R², fit (%), root mean squares of motion and error
    n_rows: int  # that were compared
    reason: str | None = None  # why there is no simulation; then ``outputs`` is empty

    @property
    def r2(self):
        """Mean over the outputs; NaN where nothing was simulated."""
        return float(self.outputs["R²"].mean()) if self.reason is None else np.nan

    @classmethod
    def of(cls, step, handed, y, units):
        """Of a step over a record; the reason where it cannot be simulated or scored."""
        try:
            truth, simulated, rows, _ = scored_simulation(step, handed, y)
        except (UnstableModelError, ValueError) as error:
            return cls(pd.DataFrame({"R²": []}), 0, str(error))
        names = compared_names(step)
        error = np.sqrt(np.mean((truth - simulated) ** 2, axis=0))
        spread = np.std(truth, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            left = np.where(error > 0.0, error / spread, 0.0)
        table = pd.DataFrame(
            {
                "R²": 1.0 - left**2,
                "fit (%)": 100.0 * (1.0 - left),
                "motion, rms": spread,
                "error, rms": error,
                "unit": [units.get(name, "–") for name in names],
            },
            index=pd.Index(names, name="output"),
        )
        return cls(table, len(rows))


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted pipeline by its steps, and the record of its fit."""

    pipe: object
    X: object
    y: object
    units: dict
    last: ModelStep
    experiment: Experiment
    analyzer: HarmonicAnalyzer | None
    identifier: MOESPRegressor | None
    reducer: SpuriousModeReducer | None
    matcher: StructuredMatcher | None
    residuals: ResidualDisplay | None
    tests: pd.DataFrame | str  # of the residuals, or why there are none
    run: Run  # over the record of the fit
    told: list  # names and texts of warnings that were made again

    @property
    def basis(self):
        """The reading of the record."""
        return self.last.basis_

    @property
    def periodic(self):
        """The matched periodic model, or None."""
        return None if self.matcher is None else self.matcher.match_.periodic

    @property
    def steps(self):
        """Every step by its name, in the order of the pipeline."""
        if isinstance(self.pipe, Pipeline):
            return dict(self.pipe.steps)
        return {type(step).__name__: step for step in reversed(list(steps_of(self.pipe)))}


def read_fitted(pipe, X, y, units):
    """Everything that a report says of the record of a fit."""
    X = without_inputs(y) if X is None else X
    last, handed = last_model_step(pipe, X)
    check_is_fitted(last)
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        experiment = last._experiment(handed, y)
        kinds = HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer, StructuredMatcher
        steps = [find_step(pipe, kind) for kind in kinds]
        analyzer, identifier, reducer, matcher = steps
        _warn_again(pipe, X, y, analyzer, experiment, (reducer or identifier, matcher))
        run = Run.of(last, handed, y, units)
        residuals, tests = _tested(pipe, X, y, units)
    told = words_of(raised)
    return Fitted(pipe, X, y, units, last, experiment, *steps, residuals, tests, run, told)


def _tested(pipe, X, y, units):
    """The display of the residuals and their tests; None and the reason where there are none."""
    try:
        with plt.ioff():
            residuals = ResidualDisplay.from_estimator(pipe, X, y, units=units)
    except REFUSALS as error:
        return None, str(error)
    return residuals, residuals.tests


def words_of(raised, what=""):
    """Names and texts of warnings, each once."""
    return list(dict.fromkeys((w.category.__name__, what + str(w.message)) for w in raised))


def _warn_again(pipe, X, y, analyzer, experiment, models):
    """Warnings of a fit that need no fit of the model."""
    if analyzer is not None:
        place = [] if not isinstance(pipe, Pipeline) else [step for _, step in pipe.steps]
        before = place.index(analyzer) if analyzer in place else 0
        again = clone(analyzer)
        if experiment.base.counted:  # rows as far apart as at the fit
            again.set_params(sample_time=experiment.base.sample_time)
        again.fit(pipe[:before].transform(X) if before else X, y)
    warn_of_mismatch(experiment)
    model, matcher = models
    opinion = None if model is None else model.model_.opinion
    if opinion is not None:
        exponents = model.model_.exponents()
        warn_unconfirmed(exponents, opinion)
        if matcher is not None and not contradictions(exponents, opinion):
            warn_unconfirmed(exponents_of(matcher), opinion)


def exponents_of(step):
    """Exponents of a fitted model step, 1/s: Floquet exponents of a periodic model."""
    if isinstance(step, StructuredMatcher) and step.match_.periodic is not None:
        return step.ltp_.floquet_exponents()
    return step.model_.exponents()


def motion_table(exponents, std=None):
    """Decay, frequency and damping of exponents in words, with half widths of 95 % intervals.

        λ = σ + jΩ,   ζ = −σ / |λ|,   δζ ≤ (Ω² δσ + |σ Ω| δΩ) / |λ|³

    ``std`` has the standard deviation of the real part + j times that of the imaginary part.
    """
    z = np.asarray(exponents, complex)
    order = np.lexsort((z.imag, np.abs(z.imag), -z.real))
    z, size = z[order], np.maximum(np.abs(z[order]), np.finfo(float).tiny)
    none = np.where(np.abs(z.imag) <= 1e-9 * size, np.nan, 1.0)
    reach = np.full(len(z), np.nan + 0j) if std is None else REACH * np.asarray(std)[order]
    decay, turn = reach.real, np.where(np.isnan(reach.real), np.nan, reach.imag)
    damping = (z.imag**2 * decay + np.abs(z.real * z.imag) * turn) / size**3
    decays = np.where(z.real < 0.0, -z.real, np.nan)
    columns = {
        "real part (1/s)": (z.real, decay),
        "frequency (rad/s)": (z.imag * none, turn),
        "frequency (Hz)": (np.abs(z.imag) / (2.0 * np.pi) * none, turn / (2.0 * np.pi)),
        "damping ratio (–)": (-z.real / size * none, damping),
        "half-life (s)": (np.log(2.0) / decays, np.log(2.0) * decay / decays**2),
    }
    table = {n: [with_reach(*pair) for pair in zip(*c, strict=True)] for n, c in columns.items()}
    return pd.DataFrame(table, index=pd.RangeIndex(1, len(z) + 1, name="mode"))


def doubts(fitted, validation):
    """Pairs of a text and the anchor of a section; ``validation`` is a Run, or None."""
    found = [
        (text[:1].upper() + text[1:] + ".", ANCHORS.get(kind, "warnings"))
        for kind, text in fitted.told
        if kind not in HARMLESS
    ]
    found += _of_modes(fitted.reducer)
    found += _of_match(fitted.matcher)
    found += _of_residuals(fitted)
    for run, what in ((validation, "the validation record"), (fitted.run, "the record of the fit")):
        if run is None:
            continue
        if run.reason is not None:
            found.append((f"{what.capitalize()} was not scored: {run.reason}", "validation"))
        elif not run.r2 >= 0.5:
            left = f"leaves more than it explains: R² = {digits(run.r2, 3)}."
            found.append((f"The simulation of {what} {left}", "validation"))
    return found


def _of_modes(reducer):
    """Modes that the reducer is not sure of."""
    if reducer is None:
        return []
    modes = reducer.modes_
    unsure = modes[modes["verdict"].isin(UNSURE)]
    return [
        (f"The mode at {digits(mode.eigenvalue)} 1/s is {mode.verdict}: {mode.reason}.", "modes")
        for mode in unsure.itertuples()
    ]


def _of_residuals(fitted):
    """Residuals that are no noise, unless the likelihood's deviations allow for them."""
    tests = fitted.tests
    if isinstance(tests, str) or tests["passed"].all() or stands(fitted.matcher):
        return []
    failed = tests[~tests["passed"]]
    worst = failed["share"].idxmax()
    text = (
        f"The residuals are not white noise: {len(failed)} of {len(tests)} tests fail "
        f"({', '.join(failed.index)}). The test '{worst}' finds "
        f"{digits(100.0 * failed['share'][worst], 2)} % of their variance to be no noise."
    )
    return [(text, "residuals")]


def stands(matcher):
    """Whether a likelihood knows its model's exponents, whatever its residuals are."""
    found = None if matcher is None else matcher.match_.uncertainty
    return found is not None and found.tests is not None and found.doubt is None


def _of_match(matcher):
    """A matched model that is far from the one identified, or not determined by the data."""
    if matcher is None:
        return []
    error, found = matcher.hinf_error_relative_, []
    if error > DOUBT:
        text = (
            f"The matched model differs from the identified one by {digits(100.0 * error, 3)} % "
            f"(H∞ norm of the error, relative) at {digits(matcher.peak_frequency_)} rad/s."
        )
        found.append((text, "model"))
    std = pd.Series(matcher.theta_std_)
    unknown = std.index[np.isinf(std)]
    if len(unknown):
        found.append((f"The record does not determine {first_of(unknown)}.", "model"))
    return found


def doubts_box(found, checks):
    """The box at the top: doubts, or which checks found none."""
    if not found:
        return f'<div class="box"><p><b>No check found a fault.</b> {escape(checks)}</p></div>'
    items = "".join(
        f'<li>{escape(t)} <a href="#{a}">See {a.capitalize()}.</a></li>' for t, a in found
    )
    many = "one doubt" if len(found) == 1 else f"{len(found)} doubts"
    return (
        f'<div class="box doubt"><p><b>This model may be wrong: {many}.</b></p>'
        f"<ul>{items}</ul></div>"
    )
