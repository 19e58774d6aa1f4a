"""What a report reads once of a fitted pipeline and its records."""

import warnings
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import norm
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd._fit_checks import warn_of_mismatch
from sklearn_hd._model_step import ModelStep
from sklearn_hd._opinion import warn_unconfirmed
from sklearn_hd._records.data import Experiment
from sklearn_hd._scoring import scored_simulation
from sklearn_hd._tables import without_inputs
from sklearn_hd.exceptions import UnstableModelError
from sklearn_hd.harmonics import HarmonicAnalyzer
from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.model_selection._scorers import last_model_step
from sklearn_hd.plotting._display import find_step, steps_of
from sklearn_hd.reduction import SpuriousModeReducer
from sklearn_hd.subspace import MOESPRegressor

__all__ = ["LEVEL", "Fitted", "Run", "exponents_of", "motion_table", "read_fitted"]

LEVEL = 0.95
REACH = norm.ppf(0.5 + 0.5 * LEVEL)  # standard deviations to either side


@dataclass(frozen=True, eq=False)
class Run:
    """A free simulation over one record, as ``score`` has it.

    Attributes
    ----------
    outputs : DataFrame
        By output: R², fit in percent, root mean squares of the motion and of the error.
    n_rows : int
        Rows compared.
    reason : str or None
        Why there is no simulation; then ``outputs`` is empty.
    """

    outputs: pd.DataFrame
    n_rows: int
    reason: str | None = None

    @property
    def r2(self):
        """Mean over the outputs; NaN where nothing was simulated."""
        return float(self.outputs["R²"].mean()) if self.reason is None else np.nan

    @classmethod
    def of(cls, step, handed, y, units):
        """Of a step over a record; the reason where it cannot be simulated or scored."""
        try:
            truth, simulated, rows = scored_simulation(step, handed, y)
        except (UnstableModelError, ValueError) as error:
            return cls(pd.DataFrame({"R²": []}), 0, str(error))
        names = step.target_names_
        if step.predicts_harmonics_:
            names = [signal for signal, _ in step.basis_.outputs]
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
    """A fitted pipeline by its steps, and the record of its fit.

    Attributes
    ----------
    pipe : estimator
    X, y : as given
    units : dict
    last : ModelStep
    handed : DataFrame or ndarray
        X as the last step takes it.
    experiment : Experiment
    analyzer, identifier, reducer, matcher : steps or None
    tests : DataFrame or str
        Of the residuals, or why there are none.
    run : Run
        Over the record of the fit.
    told : list of (str, str)
        Names and texts of warnings that were made again.
    """

    pipe: object
    X: object
    y: object
    units: dict
    last: ModelStep
    handed: object
    experiment: Experiment
    analyzer: HarmonicAnalyzer | None
    identifier: MOESPRegressor | None
    reducer: SpuriousModeReducer | None
    matcher: StructuredMatcher | None
    tests: pd.DataFrame | str
    run: Run
    told: list

    @property
    def basis(self):
        """The reading of the record."""
        return self.last.basis_

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
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        experiment = last._experiment(handed, y)
        kinds = HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer, StructuredMatcher
        analyzer, identifier, reducer, matcher = (find_step(pipe, kind) for kind in kinds)
        _warn_again(pipe, X, y, analyzer, experiment, (reducer or identifier, matcher))
        run = Run.of(last, handed, y, units)
        try:
            tests = last.residual_tests(handed, y)
        except (UnstableModelError, ValueError) as error:
            tests = str(error)
    told = list(dict.fromkeys((w.category.__name__, str(w.message)) for w in raised))
    steps = analyzer, identifier, reducer, matcher
    return Fitted(pipe, X, y, units, last, handed, experiment, *steps, tests, run, told)


def _warn_again(pipe, X, y, analyzer, experiment, models):
    """Warnings of a fit that need no fit of the model."""
    if analyzer is not None:
        place = [] if not isinstance(pipe, Pipeline) else [step for _, step in pipe.steps]
        before = place.index(analyzer) if analyzer in place else 0
        clone(analyzer).fit(pipe[:before].transform(X) if before else X, y)
    warn_of_mismatch(experiment)
    model, matcher = models
    opinion = None if model is None else model.model_.opinion
    if opinion is not None:
        warn_unconfirmed(model.model_.exponents(), opinion)
        if matcher is not None:
            warn_unconfirmed(exponents_of(matcher), opinion)


def exponents_of(step):
    """Exponents of a fitted model step, 1/s: Floquet exponents of a periodic model."""
    if isinstance(step, StructuredMatcher) and step.match_.periodic is not None:
        return step.ltp_.floquet_exponents()
    return step.model_.exponents()


def motion_table(exponents, std=None):
    """Decay, frequency and damping of exponents, with half widths of their 95 % intervals.

        λ = σ + jΩ,   ζ = −σ / |λ|,   δζ ≤ (Ω² δσ + |σ Ω| δΩ) / |λ|³

    Parameters
    ----------
    exponents : complex ndarray, shape (n,)
    std : complex ndarray, shape (n,), optional
        Standard deviation of the real part + j times that of the imaginary part.
    """
    z = np.asarray(exponents, complex)
    order = np.lexsort((z.imag, np.abs(z.imag), -z.real))
    z, size = z[order], np.maximum(np.abs(z[order]), np.finfo(float).tiny)
    real = np.abs(z.imag) <= 1e-9 * size
    reach = np.full(len(z), np.nan + 0j) if std is None else REACH * np.asarray(std)[order]
    decay, turn = reach.real, np.where(reach.real >= 0.0, reach.imag, np.nan)
    damping = (z.imag**2 * decay + np.abs(z.real * z.imag) * turn) / size**3
    missing, none = np.full(len(z), np.nan), np.where(real, np.nan, 1.0)
    table = {"real part (1/s)": z.real, "± ": decay, "frequency (rad/s)": z.imag * none}
    table |= {"±  ": turn * none, "frequency (Hz)": np.abs(z.imag) / (2.0 * np.pi) * none}
    table |= {"damping ratio (–)": -z.real / size * none, "±   ": damping * none}
    table["half-life (s)"] = np.divide(-np.log(2.0), z.real, out=missing, where=z.real < 0.0)
    if std is None:
        table = {name: column for name, column in table.items() if not name.startswith("±")}
    return pd.DataFrame(table, index=pd.RangeIndex(1, len(z) + 1, name="mode"))
