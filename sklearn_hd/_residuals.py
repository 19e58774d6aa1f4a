"""Residuals of a fitted model, and the tests whether they are noise."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import linalg
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import check_outputs_given
from sklearn_hd._containers import without_inputs
from sklearn_hd.algorithms.likelihood.predictor import of_each_output, sensitivities
from sklearn_hd.algorithms.likelihood.residual_tests import (
    Score,
    autoregression,
    filtered,
    lagged,
    past,
    score_test,
)
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, OVERFLOW, PRECISION, RANK
from sklearn_hd.algorithms.periodic.multipliers import orthonormal_range
from sklearn_hd.algorithms.periodic.periodic_predictor import SENSOR_NOISE
from sklearn_hd.algorithms.signals.fourier import MOST_ROWS, harmonic_functions, times
from sklearn_hd.exceptions import UnstableModelError

ROWS_PER_PARAMETER = 4  # below which residuals are what parameters leave by chance
MOST_LAGS = 20
TURNS_BACK = 3  # of inputs, which a state that is missing answers to for long
INTERVALS_AN_OCTAVE = 2
MOST_DEGREES = 60  # of freedom of one test: with more, it sees less
ROWS_PER_DEGREE = 10
LAGS_BY_PHASE = 5
HARMONICS_BY_PHASE = (1, 2)
MORE_LOADS = 12  # harmonics beyond those fitted
ALARM = 1e-4  # of tests at fit, which nobody asked for
MOST_PRODUCTS = 2e10  # of a test at fit: some seconds
NEW = np.sqrt(RANK)  # in a direction of a span, of columns of length one


@dataclass(frozen=True, eq=False)
class Segment:
    """Residuals of one segment, and the signals with which they may correlate.

    ``fitted`` (n_samples, l, r) are sensitivities of the predictions to parameters, and
    ``start`` (n_samples, l, n) those to the initial state.
    """

    residuals: np.ndarray
    predicted: np.ndarray
    inputs: np.ndarray
    psi: np.ndarray
    fitted: np.ndarray
    start: np.ndarray

    def of_outputs(self, kept):
        """The same of some outputs alone."""
        own = (values[:, kept] for values in (self.residuals, self.predicted))
        return Segment(*own, self.inputs, self.psi, self.fitted[:, kept], self.start[:, kept])


@dataclass(frozen=True, eq=False)
class Remainder:
    """Residuals of a record under a model, without rounding."""

    segments: list  # of Segment
    output_names: tuple  # of str
    input_names: tuple  # of str
    predicts: bool  # whether residuals are those of one-step predictions; else of simulations
    samples_per_period: float | None  # None without a fundamental frequency
    n_loads: int  # harmonics of the forced response that were fitted; −1 for none, not even a mean
    trim: bool  # whether a periodic mean was subtracted

    @property
    def n_rows(self):
        """Rows of all segments."""
        return sum(len(s.psi) for s in self.segments)

    def part_of_motion(self, lag=0):
        """Covariance of residuals some samples apart, in parts of the motion's variance.

        The largest of all outputs; of white noise nothing but for ``lag=0``. The motion is that
        about the periodic mean that was fitted, or what a trim is off by.
        """
        psi = np.concatenate([s.psi for s in self.segments])
        highest = int(self.samples_per_period) // 2 if self.trim else max(self.n_loads, 0)
        turn = orthonormal_range(harmonic_functions(psi, range(highest + 1)), rank=NEW)
        e = np.vstack([s.residuals for s in self.segments])
        y = e + np.vstack([s.predicted for s in self.segments])
        motion = np.sum((y - turn @ (turn.T @ y)) ** 2, axis=0)
        e = e - turn @ (turn.T @ e) if self.trim else e
        pieces = np.split(e, _ends(self.segments)[:-1])
        alike = sum(np.sum(z[lag:] * z[: len(z) - lag], axis=0) for z in pieces)
        return float(np.max(alike / np.where(motion > 0.0, motion, 1.0), initial=0.0))

    def white(self):
        """Residuals of unit covariance, one array a segment, and the matrix that made them so."""
        e = np.vstack([s.residuals for s in self.segments])
        size = np.sqrt(np.mean(e**2, axis=0))
        alike = (e / size).T @ (e / size) / len(e)
        W = linalg.inv(linalg.cholesky(alike + DEPENDENT * np.eye(len(size)), lower=True)) / size
        return [s.residuals @ W.T for s in self.segments], W


def remainder(experiment, simulators, most_rows=MOST_ROWS):
    """Residuals of a model over an experiment, or its first rows.

    It raises UnstableModelError if a simulation overflows, and ValueError if there are
    too few rows for the parameters.
    """
    basis, segments, left = experiment.basis, [], most_rows
    parts = zip(simulators, experiment.outputs, experiment.phases, experiment.times(), strict=True)
    for simulator, outputs, psi, time in parts:
        first, last = basis.scored_rows(time)
        last = min(last, first + left)
        if last > first:
            at, left = simulator.at_samples(), left - (last - first)
            segments.append(_segment(at, outputs[:last], psi[:last], first))
    names = tuple(signal for signal, _ in basis.outputs) if basis.harmonic else basis.output_labels
    n_parameters = sum(s.start.shape[2] for s in segments)
    n_parameters += segments[0].fitted.shape[2] if segments else 0
    n_rows = sum(len(s.psi) for s in segments)
    if n_rows * len(names) <= ROWS_PER_PARAMETER * n_parameters:
        raise ValueError(
            f"{n_rows} rows of {len(names)} output(s) with a model of {n_parameters} coefficients "
            f"and initial states leave no residuals to test: at least {ROWS_PER_PARAMETER} values "
            f"for each are needed; give a longer record, or a model with fewer states or harmonics"
        )
    size = np.sqrt(np.mean(np.vstack([s.predicted + s.residuals for s in segments]) ** 2, axis=0))
    rest = np.sqrt(np.mean(np.vstack([s.residuals for s in segments]) ** 2, axis=0))
    kept = np.flatnonzero((rest > PRECISION * size) & (size > 0.0))
    signals = basis.input_signals
    return Remainder(
        [s.of_outputs(kept) for s in segments],
        tuple(names[i] for i in kept),
        # measured signals, where these drive the model
        tuple(signals if at.inputs.shape[1] == len(signals) else basis.drive_labels),
        at.predicts,
        basis.samples_per_period if basis.harmonic else None,
        at.n_loads,
        basis.about_trim,
    )


def _segment(at, outputs, psi, first):
    """Residuals of one segment from the initial state that leaves the least."""
    at = at.first(len(outputs))
    rows, inputs = at.rows, at.inputs
    start = rows.started()
    if not np.max(np.abs(start), initial=0.0) < OVERFLOW:
        raise UnstableModelError(
            "the simulation overflows, so there are no residuals to test: the model is unstable; "
            "fit MOESPRegressor(disturbance_model=True), whose predictions are tested, or give a "
            "shorter record"
        )
    x0 = rows.initial_state(inputs, outputs, np.diag(np.mean(outputs**2, axis=0)))
    x, e = rows.innovations(inputs, outputs, x0)
    functions = harmonic_functions(psi, range(at.n_harmonics + 1))
    loads = harmonic_functions(psi, range(at.n_loads + 1)) if at.n_loads >= 0 else functions[:, :0]
    fitted = sensitivities(rows, inputs, x, e, functions, loads, feedthrough=at.feedthrough)
    parts = e, outputs - e, inputs, psi, fitted, start
    return Segment(*(values[first:] for values in parts))


# ---- the tests -------------------------------------------------------------------------------


def scored(left, lags, level, only=None):
    """Score tests of a remainder, all or only one, as a DataFrame, one row a test.

    Residuals of simulations may be coloured by noise that moves the machine. All tests except that
    of their autocorrelation then use the residuals of an autoregression.
    """
    asked = _questions(left, lags)
    asked = asked if only is None else {only: asked[only]}
    found = {name: Score(0.0, 0, 1.0) for name in asked}
    if left.output_names:
        own, W = left.white()
        plain = np.zeros((0, len(W), len(W)))
        coloured = plain if left.predicts else autoregression(own, _Counts.of(left, lags).own)
        for names, Phi in _by_colour(asked, plain, coloured):
            residuals, span = _prepared(left, own, W, Phi)
            for name in names:
                regressors = [filtered(of_each_output(z, np.eye(len(W))), Phi) for z in asked[name]]
                found[name] = score_test(residuals, np.concatenate(regressors), span)
    columns = {
        "statistic": [score.statistic for score in found.values()],
        "degrees": [score.degrees for score in found.values()],
        "p_value": [score.p_value for score in found.values()],
        "share": [max(s.statistic - s.degrees, 0.0) / left.n_rows for s in found.values()],
    }
    table = pd.DataFrame(columns, pd.Index(found, name="test"))
    table["level"] = level / len(table)
    return table.assign(passed=table["p_value"] >= table["level"])


def _by_colour(names, plain, coloured):
    """Which tests are of residuals as they are, and which of what an autoregression leaves."""
    if len(coloured) == 0:
        return [(list(names), plain)]
    own = [name for name in names if name.startswith("autocorrelation")]
    return [(own, plain), ([name for name in names if name not in own], coloured)]


@dataclass(frozen=True)
class _Counts:
    """How many lags and harmonics the tests look at."""

    own: int
    inputs: int
    by_phase: int
    loads: int

    @classmethod
    def of(cls, left, lags):
        n_outputs, m = max(1, len(left.output_names)), max(1, len(left.input_names))
        most = min(MOST_DEGREES, left.n_rows // ROWS_PER_DEGREE)
        asked = MOST_LAGS if lags is None else lags
        own, inputs = (max(1, min(asked, most // (n_outputs * k))) for k in (n_outputs, m))
        pairs = 2 * len(HARMONICS_BY_PHASE) * n_outputs * max(n_outputs, m)
        turn = left.samples_per_period or 1.0
        told = max(int(np.ceil(0.5 * turn)) - 1, 0)
        loads = min(told, max(left.n_loads, 0) + min(MORE_LOADS, most // (2 * n_outputs)))
        if lags is not None:
            most_lags = left.n_rows // (ROWS_PER_DEGREE * n_outputs * max(n_outputs, m))
            if lags > most_lags:
                raise ValueError(
                    f"lags={lags} is more than {left.n_rows} rows allow: with {ROWS_PER_DEGREE} "
                    f"rows for each degree of freedom, at most {most_lags}; give fewer, or None"
                )
            own, inputs = lags, lags
        return cls(own, inputs, max(1, min(LAGS_BY_PHASE, most // pairs)), loads)


def _questions(left, lags):
    """Regressors of each test by its name: one array a segment."""
    counts, segments = _Counts.of(left, lags), left.segments
    mean = np.mean(np.vstack([s.inputs for s in segments]), axis=0)
    u = [s.inputs - mean for s in segments]
    e = left.white()[0] if left.output_names else [s.residuals for s in segments]
    asked = {"autocorrelation": [lagged(each, range(1, counts.own + 1)) for each in e]}
    if left.input_names:
        asked["inputs"] = _earlier(u, counts.inputs, None if lags else left.samples_per_period)
    asked["nonlinearity"] = _powers(segments, counts.loads)
    if not left.trim:
        name = "mean" if left.samples_per_period is None else "loads"
        asked[name] = [harmonic_functions(s.psi, range(counts.loads + 1)) for s in segments]
    if left.samples_per_period is None:
        return asked
    turning = [harmonic_functions(s.psi, HARMONICS_BY_PHASE) for s in segments]
    late = range(1, counts.by_phase + 1)
    pairs = zip(e, turning, strict=True)
    asked["autocorrelation by phase"] = [times(lagged(each, late), f) for each, f in pairs]
    if left.input_names:
        late, pairs = range(counts.by_phase), zip(u, turning, strict=True)
        asked["inputs by phase"] = [times(lagged(each, late), f) for each, f in pairs]
    return asked


def _earlier(inputs, count, samples_per_period):
    """Inputs of the same row and those before, or their sums back to some turns before."""
    if samples_per_period is None:
        return [lagged(u, range(count)) for u in inputs]
    back = max(TURNS_BACK * samples_per_period, 2.0)
    edges = np.geomspace(1.0, back, min(count, int(INTERVALS_AN_OCTAVE * np.log2(back)) + 1))
    edges = np.append(0, np.unique(np.rint(edges).astype(int)))
    return [past(u, edges) for u in inputs]


def _powers(segments, n_loads):
    """Squares and cubes of predictions and inputs, of a row and of the one before.

    About their means over the turn, beside which what the inputs do may be small. What a curved
    machine adds to its linear model is first the square of that, times functions of the azimuth.
    """
    signals = np.vstack([np.hstack([s.predicted, s.inputs]) for s in segments])
    turn = np.vstack([harmonic_functions(s.psi, range(n_loads + 1)) for s in segments])
    turn = orthonormal_range(turn, rank=NEW)
    signals = signals - turn @ (turn.T @ signals)
    size = signals.std(axis=0)
    signals = signals / np.where(size > 0.0, size, 1.0)
    found, highest = [], 1 if n_loads else 0
    for s, v in zip(segments, np.split(signals, _ends(segments)[:-1]), strict=True):
        late, functions = lagged(v, (0, 1)), harmonic_functions(s.psi, range(highest + 1))
        found.append(np.hstack([times(late**2 - 1.0, functions), late**3]))
    return found


def _ends(segments):
    """First row after each segment, of all in one array."""
    return np.cumsum([len(s.psi) for s in segments])


def _columns(left, W):
    """Sensitivities of white residuals to coefficients, and to each segment's initial state."""
    n_starts, first, found = sum(s.start.shape[2] for s in left.segments), 0, []
    for s in left.segments:
        start = np.zeros((len(s.psi), len(W), n_starts))
        start[..., first : first + s.start.shape[2]] = s.start
        first += s.start.shape[2]
        found.append(np.concatenate([W @ s.fitted, W @ start], axis=-1))
    return found


def _prepared(left, own, W, Phi):
    """Residuals in one array, and the span of what parameters, starts and trim could change."""
    columns = []
    for s, parts in zip(left.segments, _columns(left, W), strict=True):
        if left.trim:
            orders = range(int(left.samples_per_period) // 2 + 1)
            waveform = of_each_output(harmonic_functions(s.psi, orders), np.eye(len(W)))
            parts = np.concatenate([parts, waveform], axis=-1)
        columns.append(filtered(parts, Phi))
    residuals = np.vstack([filtered(e[..., None], Phi)[..., 0] for e in own])
    columns = np.concatenate(columns).reshape(residuals.size, -1)
    return residuals, orthonormal_range(columns, rank=NEW)


def left_of(step, X, y):
    """The remainder of a record under a fitted step."""
    check_is_fitted(step)
    check_outputs_given(y)
    experiment = step._experiment(without_inputs(y) if X is None else X, y)
    experiment = step._compared(experiment)
    return remainder(experiment, step._simulators(experiment))


def why_incomplete(model, experiment, simulators):
    """Why a model of samples lacks states: what it leaves goes with inputs of the past; or "".

    Whatever a feedthrough could explain is taken out: it stands for inputs that move between
    samples. ``simulators(model, experiment)`` are those without a gain, which would follow what
    states that are missing do.
    """
    if not len(model.input_names):
        return ""
    test = _failed("inputs", replace(model, feedthrough=True), experiment, simulators)
    if test is None:
        return ""
    return (
        f"what a simulation leaves goes with inputs of the last {TURNS_BACK} turns: the test gives "
        f"{test['statistic']:.4g} instead of {test['degrees']:.0f} for noise, {test['share']:.2g} "
        f"of what is left; states are missing, an output is late, or the response is not linear: "
        f"raise order=, give output_delay=, use smaller motions, and see residual_tests"
    )


def why_coloured(model, experiment, simulators):
    """Why a model of samples lacks states: its one-step predictions leave no white noise; or "".

    ``simulators(model, experiment)`` are those with the gain. It follows most of what a slow mode
    does that the model lacks, and colours what is left.
    """
    test = _failed("autocorrelation", model, experiment, simulators)
    if test is None:
        return ""
    return (
        f"what one-step predictions leave is not white: the test of its autocorrelation gives "
        f"{test['statistic']:.4g} instead of {test['degrees']:.0f} for noise, {test['share']:.2g} "
        f"of what is left, and a simulation leaves more than they do: a mode of little motion is "
        f"missing, or the noise of sensors or gusts is coloured; raise order=, use "
        f"HarmonicAnalyzer(reading='period') if the inputs rest, and see residual_tests"
    )


def _failed(name, model, experiment, simulators):
    """A residual test that a model of samples fails; None if it passes, or is not made.

    It is not made where rows are too few, the simulation overflows, or less is left than sensors
    leave.
    """
    own, n_outputs = model.innovations, len(model.output_names)
    n, m = own.n_states, len(model.input_names)
    n_parameters = (2 * own.n_harmonics + 1) * (n + n_outputs) * (n + m)
    if not n_parameters:
        return None
    most = min(MOST_ROWS, int(MOST_PRODUCTS / (n_outputs * n_parameters**2)))
    try:
        left = remainder(experiment, simulators(model, experiment), most)
    except (UnstableModelError, ValueError):
        return None
    if left.part_of_motion() < SENSOR_NOISE**2:
        return None
    test = scored(left, None, ALARM, name).loc[name]
    return None if test["passed"] else test
