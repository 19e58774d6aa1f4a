"""Is the remainder noise? Score tests of the residuals e of a model on regressors z.

Noise cannot be told from the past. Each test asks whether e goes with some function z of past
and present, beyond what any small change of the model's parameters θ would take away:

    s = Σ z⊥[k] e[k],   P = Σ z⊥[k] z⊥[k]ᵀ e[k]²,   sᵀ P⁻¹ s ~ χ²(rank P)

with z⊥ what z leaves of the sensitivities ∂ŷ/∂θ. So the errors of the parameters do not count
to first order, however they were estimated (Neyman's C(α) test); with z = e[k−1] … e[k−L] this is
Breusch's and Godfrey's test for autocorrelation, with z = u[k] … u[k−L] Ljung's for what inputs
explain, which allows for their own colour. A state that is missing answers to inputs for as long
as its mode lasts: sums over ever longer intervals reach back that far with few numbers. The
variance of e may change with time or azimuth (Wooldridge): P takes each residual's own square.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import linalg, stats

from sklearn_hd.algorithms.linalg.triangular import column_sizes

TOLD = 1e-3  # share of a regressor beside the span: of less, errors of second order make more


@dataclass(frozen=True)
class Score:
    """Statistic of a test, its degrees of freedom, and how often noise would exceed it."""

    statistic: float
    degrees: int
    p_value: float


def score_test(residuals, regressors, span):
    """Score of whether residuals go with regressors, beyond what a span of directions takes away.

    ``residuals`` (n_samples, l) have unit covariance, and ``regressors`` shape
    (n_samples, l, q). The columns of ``span`` (n_samples * l, r) are orthonormal: it is
    that of the sensitivities to parameters.

    References
    ----------
    Neyman (1959), Optimal asymptotic tests of composite statistical hypotheses.
    Wooldridge (1990), Econometric Theory 6(1), 17-43.

    Examples
    --------
    >>> from sklearn_hd.algorithms.likelihood.predictor import of_each_output
    >>> e = np.random.default_rng(0).standard_normal((500, 1))
    >>> late = of_each_output(lagged(e, [1]), np.eye(1))
    >>> score_test(e, late, np.zeros((500, 0))).p_value > 0.01
    True
    >>> score_test(e + 0.5 * late[:, 0], late, np.zeros((500, 0))).p_value < 1e-6
    True
    """
    Z = regressors.reshape(residuals.size, -1)
    Z = Z / column_sizes(Z)
    Z = Z - span @ (span.T @ Z)
    e = residuals.ravel() - span @ (span.T @ residuals.ravel())
    g = (Z * e[:, None]).reshape(*residuals.shape, -1).sum(axis=1)
    values, vectors = linalg.eigh(g.T @ g) if g.shape[1] else (np.zeros(0), g.T)
    kept = values > TOLD
    if not kept.any():
        return Score(0.0, 0, 1.0)
    left = 1.0 - span.shape[1] / len(e)  # of the variance, beside what e has lost to the span
    statistic = left * np.sum((vectors[:, kept].T @ g.sum(axis=0)) ** 2 / values[kept])
    degrees = int(np.sum(kept))
    return Score(float(statistic), degrees, float(stats.chi2.sf(statistic, degrees)))


def lagged(signal, lags):
    """A signal some rows before, zeros before its start, shape (n_samples, n_signals * n_lags)."""
    late = np.zeros((len(lags), *signal.shape))
    for row, lag in zip(late, lags, strict=True):
        row[lag:] = signal[: max(len(signal) - lag, 0)]
    return late.transpose(1, 0, 2).reshape(len(signal), -1)


def past(signal, edges):
    """Sums of a signal over intervals of its past, zeros before its start.

    ``edges`` (n_intervals + 1,) count rows back and rise from 0, the row itself. The
    sums have shape (n_samples, n_intervals * n_signals), with all signals of one
    interval side by side.

    Examples
    --------
    >>> past(np.array([[1.0], [2.0], [4.0]]), np.array([0, 1, 3])).tolist()
    [[1.0, 0.0], [2.0, 1.0], [4.0, 3.0]]
    """
    before = edges[-1] + 1
    sums = np.vstack([np.zeros((before, signal.shape[1])), np.cumsum(signal, axis=0)])
    rows = before + np.arange(len(signal))
    return np.hstack([sums[rows - a] - sums[rows - b] for a, b in pairwise(edges)])


def autoregression(segments, most):
    """Φ (order, l, l) of e[k] = Σ_j Φ_j e[k−j] + white noise, of the order with the least AIC.

    Orders up to ``most`` are tried.
    """
    n_outputs = segments[0].shape[1]
    late = np.vstack([lagged(e, range(1, most + 1)) for e in segments])
    e = np.vstack(segments)
    R, aic = linalg.qr(np.hstack([late, e]), mode="r")[0][: late.shape[1] + n_outputs], []
    for order in range(most + 1):
        rest = R[order * n_outputs :, late.shape[1] :]
        _, logdet = np.linalg.slogdet(rest.T @ rest / len(e))
        aic.append(len(e) * logdet + 2.0 * order * n_outputs**2)
    width = int(np.argmin(aic)) * n_outputs
    Phi = linalg.solve_triangular(R[:width, :width], R[:width, late.shape[1] :])
    return Phi.reshape(-1, n_outputs, n_outputs).transpose(0, 2, 1)


def filtered(values, Phi):
    """What an autoregression leaves of values, (n_samples, l, q)."""
    left = values.copy()
    for lag, matrix in enumerate(Phi, start=1):
        left[lag:] -= matrix @ values[:-lag]
    return left
