"""Comparison in scores: measured and simulated outputs on the rows that count, with weights."""

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._guards import extremes
from sklearn_hd._records.delays import leads
from sklearn_hd._records.sampling import joined
from sklearn_hd._simulators import as_seen, fit_initial_state, predicted_ahead, steady
from sklearn_hd._tables import without_inputs
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.signals.late_signals import advanced, late
from sklearn_hd.exceptions import InstabilityWarning, UnstableModelError

WARMUP_SHARE = 0.25  # of a segment, at most
MOST_SCORED = 1e60  # times the measured outputs: a score is their square, its spread its square


def scored_simulation(step, X, y, horizon=None):
    """Measured and simulated outputs on the rows that ``step.score`` counts, and those rows.

    With a horizon, outputs predicted so many rows ahead. Last the forced response of models of
    samples, which both are without.
    """
    check_is_fitted(step)
    experiment = step._experiment(without_inputs(y) if X is None else X, y)
    trim, sampling = experiment.output_trim_at_rows(), experiment.sampling
    truth, simulated, rows, forced = [], [], [], []
    simulators = step._simulators(experiment)
    step._warn_of_inputs(experiment, simulators)
    samples = (step._samples_late if horizon is None else step._samples_ahead)(experiment)
    parts = zip(simulators, experiment.outputs, sampling.pieces, strict=True)
    for i, (simulator, y_segment, piece) in enumerate(parts):
        y_segment = advanced(y_segment, samples)
        warm, counted = score_rows(step, simulator, experiment)
        if counted.start >= counted.stop:
            continue
        within = piece.rows_between(counted.start, counted.stop)
        measured = experiment.measured[piece.rows][within]
        own = np.arange(within.start, within.stop)
        if experiment.has_gaps:  # rows that were bridged do not count
            kept = np.isfinite(measured).all(axis=1)
            measured, own = measured[kept], own[kept]
            within = own
        seen = as_seen(simulator, y_segment)
        outputs = _fitted_outputs(step, simulator, seen, warm, horizon)
        if seen is y_segment:
            outputs = late(outputs, samples)
            on_grid, loads = steady(simulator, piece, experiment.basis, outputs.shape[1], samples)
            known = loads if trim is None else trim[i] + loads
            truth.append(measured - known[within])
        else:
            on_grid, loads = steady(simulator, piece, experiment.basis, outputs.shape[1], 0.0)
            truth.append(piece.back(seen - on_grid)[within])
        simulated.append(piece.back(outputs - on_grid)[within])
        forced.append(loads[within])
        rows.append(own + piece.rows.start)
    if not truth:
        raise ValueError(
            f"no rows are left to score in {experiment.span()}: every segment is shorter than "
            f"one analysis window and the warm-up; give longer records or a smaller warmup"
        )
    truth, simulated = (np.asfortranarray(joined(parts)) for parts in (truth, simulated))
    rows, forced = joined(rows), joined(forced)  # by columns, which are quick to sum
    _meet_at_rest(truth, simulated, experiment.measured[rows])
    return truth, simulated, rows, forced


def score_rows(step, simulator, experiment):
    """Rows of one segment that the initial state is fitted on, and those scored."""
    first, last = experiment.basis.scored_rows(simulator.time)
    unknown, unread = leads(experiment)
    first += unknown
    seconds = step._check_warmup()
    warm = experiment.basis.warmup_samples
    if seconds is not None:
        warm = round(seconds / experiment.base.sample_time)
    warm = max(1, min(warm, int(WARMUP_SHARE * (last - first - 2 * unread))))
    return slice(first, first + warm), slice(first + warm + unread, last - unread)


def _fitted_outputs(step, simulator, outputs, rows, horizon):
    """Outputs from the initial state that fits best over some rows."""
    if horizon is None:
        return simulator.outputs(fit_initial_state(simulator, outputs, rows))
    if not step._predicts_ahead():
        raise ValueError(
            f"horizon={horizon!r} asks for predictions from measured outputs, but this "
            f"{type(step).__name__} has no Kalman gain; use MOESPRegressor(disturbance_model=True) "
            f"or StructuredMatcher(criterion='prediction_error') as the last step, or horizon=None"
        )
    recompose = not step.predicts_harmonics_
    return predicted_ahead(simulator, outputs, horizon, rows=rows, recompose=recompose)


def compared(step, X, y, sample_weight=None, horizon=None):
    """Measured and simulated outputs on the rows that count, and the rows' weights.

    None, and a warning, if outputs grow so much that the spread of such scores over folds would
    not be finite. A search over orders continues with that candidate as the worst.
    """
    try:
        truth, simulated, rows, _ = scored_simulation(step, X, y, horizon)
        weight = weights_of(rows, sample_weight, len(y))
        with np.errstate(over="ignore"):
            grown = np.max(np.abs(extremes(simulated)) / power_of_two(truth))
    except UnstableModelError:
        grown = np.inf
    if grown < MOST_SCORED:
        return truth, simulated, weight
    warn(
        f"a {type(step).__name__} scores -inf: its model is unstable, or was fitted to other "
        f"outputs, and its simulation grows beyond {MOST_SCORED:.0e} times the outputs; drop the "
        f"growing modes (SpuriousModeReducer), lower the order, or score a shorter span",
        InstabilityWarning,
    )
    return None


def _meet_at_rest(truth, simulated, measured):
    """Treat outputs that rest, to rounding, as met if the simulation rests, too."""
    dust = EXACT * np.max(np.abs(extremes(measured)), axis=0)
    for j in np.flatnonzero(np.ptp(truth, axis=0) <= dust):
        if np.max(np.abs(simulated[:, j] - truth[:, j])) <= dust[j]:
            simulated[:, j] = truth[:, j]


def power_of_two(values):
    """About the largest magnitude of each column, as a power of two: dividing rounds nothing."""
    _, exponent = np.frexp(np.max(np.abs(extremes(values)), axis=0))
    return np.ldexp(1.0, np.clip(exponent, -1000, 1000))


def weights_of(rows, sample_weight, n_samples):
    """Weights of the rows that count, after checking that there is one for each row."""
    if sample_weight is None:
        return None
    try:
        weight = np.asarray(sample_weight, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("sample_weight holds values that are not numbers") from None
    if weight.shape != (n_samples,) or not np.isfinite(weight).all() or weight.min() < 0.0:
        raise ValueError(
            f"sample_weight has shape {weight.shape}; give one finite weight of at least zero for "
            f"each of the {n_samples} rows"
        )
    if not weight[rows].any():
        raise ValueError(
            f"sample_weight is zero on all {len(rows)} rows that are scored (warm-up and "
            f"incomplete periods are not scored); give some of them a weight"
        )
    return weight[rows]
