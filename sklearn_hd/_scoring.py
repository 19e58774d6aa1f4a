"""Comparison in scores: measured and simulated outputs on the rows that count, with weights."""

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._fit_checks import DUST
from sklearn_hd._guards import extremes
from sklearn_hd._warn import warn
from sklearn_hd.exceptions import InstabilityWarning, UnstableModelError

__all__ = ["compared", "meet_at_rest", "power_of_two", "scored_simulation", "weights_of"]

MOST_SCORED = 1e60  # times the measured outputs: a score is their square, its spread its square


def scored_simulation(step, X, y, horizon=None):
    """Measured and simulated outputs on the rows that ``step.score`` counts, and those rows.

    With a horizon, outputs predicted so many rows ahead. Last the forced response of models of
    samples, which both are without.
    """
    check_is_fitted(step)
    return step._fitted_simulation(X, y, horizon)


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


def meet_at_rest(truth, simulated, measured):
    """Treat outputs that rest, to rounding, as met if the simulation rests, too."""
    dust = DUST * np.max(np.abs(extremes(measured)), axis=0)
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
