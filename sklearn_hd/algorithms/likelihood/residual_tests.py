"""Is the remainder noise? Score tests of the residuals e of a model on regressors z.

Noise cannot be told from the past. Each test asks whether e goes with some function z of past
and present, beyond what any small change of the model's parameters θ would take away:

    s = Σ z⊥[k] e[k],   P = Σ z⊥[k] z⊥[k]ᵀ e[k]²,   sᵀ P⁻¹ s ~ χ²(rank P)

with z⊥ what z leaves of the sensitivities ∂ŷ/∂θ. So the errors of the parameters do not count
to first order, however they were estimated (Neyman's C(α) test); with z = e[k−1] … e[k−L] this is
Breusch's and Godfrey's test for autocorrelation, with z = u[k] … u[k−L] Ljung's for what inputs
explain, which allows for their own colour. The variance of e may change with time or azimuth
(Wooldridge): P takes each residual's own square.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats

from sklearn_hd.algorithms.linalg.rounding import RANK
from sklearn_hd.algorithms.periodic.periodic_innovations import propagate_varying

TOLD = 1e-3  # share of a regressor beside the span: of less, errors of second order make more


@dataclass(frozen=True)
class Score:
    """Statistic of a test, its degrees of freedom, and how often noise would exceed it."""

    statistic: float
    degrees: int
    p_value: float


def sensitivities(rows, inputs, states, residuals, functions, loads, *, feedthrough):
    """Derivatives of predictions by the Fourier coefficients of [A B a; C D c] and K.

    One-step predictions; of a model without a gain, simulated outputs.

    Parameters
    ----------
    rows : Rows
        The model at the samples of one segment.
    inputs, states, residuals : ndarray, shapes (n_samples, m), (n_samples, n), (n_samples, l)
    functions, loads : ndarray, shapes (n_samples, 2 H + 1), (n_samples, 2 L + 1)
        1, cos ψ, sin ψ, …, of the matrices, and of a and c (none where they are not fitted).
    feedthrough : bool
        Whether D was fitted.

    Returns
    -------
    sensitivities : ndarray, shape (n_samples, l, n_parameters)
    """
    signals = inputs, states, residuals
    pairs = regressors_of(rows, *signals, functions, loads, feedthrough=feedthrough)
    return next(sensitivity_pieces(rows, pairs, len(states)))[1]


def regressors_of(rows, inputs, states, residuals, functions, loads, *, feedthrough):
    """What the coefficients of [A B K] and of [C D] are multiplied by, then those of a and c.

    Parameters
    ----------
    rows, inputs, states, residuals, functions, loads, feedthrough
        As for :func:`sensitivities`.

    Returns
    -------
    pairs : list of (ndarray, ndarray), shapes (n_samples, q)
        One for each function, and the loads.
    """
    moved = [states, inputs, residuals] if rows.gain.any() else [states, inputs]
    moved, seen = np.hstack(moved), np.hstack([states, inputs]) if feedthrough else states
    return [(f[:, None] * moved, f[:, None] * seen) for f in functions.T] + [(loads, loads)]


def sensitivity_pieces(rows, pairs, most, weights=None):
    """Sensitivities piece by piece, each of some rows: this takes little memory.

    Parameters
    ----------
    rows : Rows
    pairs : list of (ndarray, ndarray)
        From :func:`regressors_of`.
    most : int
        Rows of a piece.
    weights : ndarray, shape (l, l), optional
        Of the outputs.

    Yields
    ------
    piece : slice
        Its rows.
    sensitivities : ndarray, shape (n_rows, l, n_parameters)
    """
    n, K, C = rows.n_states, rows.gain, rows.outputs[..., : rows.n_states]
    W = np.eye(C.shape[1]) if weights is None else weights
    stable, starts = rows.predicting, [np.zeros(1)] * len(pairs)
    for first in range(0, len(C), most):
        piece, found = slice(first, first + most), []
        for k, (drives, direct) in enumerate(pairs):
            drives = of_each_output(drives[piece], np.eye(n))
            forcing = [drives, -of_each_output(direct[piece], K[piece])]
            forcing = np.concatenate(forcing, axis=-1)
            start = np.broadcast_to(starts[k], forcing.shape[1:])
            x = propagate_varying(stable[piece], forcing, start)
            with np.errstate(over="ignore", invalid="ignore"):  # of a model that grows
                starts[k] = stable[piece][-1] @ x[-1] + forcing[-1]
            change = (W @ C[piece]) @ x
            change[..., drives.shape[-1] :] += of_each_output(direct[piece], W)
            found.append(change)
        yield piece, np.concatenate(found, axis=-1)


def sensitivity_sums(rows, pairs, directions):
    """Σ wᵀ ∂ŷ/∂θ over all rows of a segment for some directions w, without the sensitivities.

        λ[k] = (A − K C)ᵀ λ[k+1] + Cᵀ w[k]
        Σ λ[k+1]ᵀ ∂[A B a K] [x u 1 e] + (w[k] − Kᵀ λ[k+1])ᵀ ∂[C D c] [x u 1]

    Parameters
    ----------
    rows : Rows
    pairs : list of (ndarray, ndarray)
        From :func:`regressors_of`.
    directions : ndarray, shape (n_samples, l)

    Returns
    -------
    sums : ndarray, shape (n_parameters,)
    """
    n, w = rows.n_states, directions[..., None]
    back = rows.predicting.transpose(0, 2, 1)[::-1]
    forcing = (rows.outputs[..., :n].transpose(0, 2, 1) @ w)[::-1]
    later = propagate_varying(back, forcing, np.zeros((n, 1)))[::-1]
    seen = (w - rows.gain.transpose(0, 2, 1) @ later)[..., 0]
    sums = [(later[..., 0].T @ drives, seen.T @ direct) for drives, direct in pairs]
    return np.concatenate([part.ravel() for pair in sums for part in pair])


def of_each_output(regressors, weights):
    """Regressors for each output by itself; weights then combine the outputs.

    Parameters
    ----------
    regressors : ndarray, shape (n_samples, q)
    weights : ndarray, shape (a, l) or (n_samples, a, l)

    Returns
    -------
    regressors : ndarray, shape (n_samples, a, l q)
    """
    a, n_outputs = weights.shape[-2:]
    stacked = weights[..., None] * regressors[:, None, None, :]
    return stacked.reshape(len(regressors), a, n_outputs * regressors.shape[1])


def span_of(columns):
    """A basis of some columns, of full rank, shape (n_rows, rank).

    Orthonormal to the rounding of the Gram matrix over its least eigenvalue: 3e-7 on records of
    the flapping wing, where a second pass changes no statistic by more than 4e-9 of it.
    """
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0.0] / size[size > 0.0]
    if columns.shape[1] == 0:
        return columns
    values, vectors = linalg.eigh(columns.T @ columns)
    kept = values > RANK * values[-1]
    return columns @ (vectors[:, kept] / np.sqrt(values[kept]))


def score_test(residuals, regressors, span):
    """Whether residuals go with regressors, beyond what a span of directions takes away.

    Parameters
    ----------
    residuals : ndarray, shape (n_samples, l)
        Of unit covariance.
    regressors : ndarray, shape (n_samples, l, q)
    span : ndarray, shape (n_samples * l, r)
        Orthonormal: of the sensitivities to parameters.

    Returns
    -------
    score : Score

    References
    ----------
    Neyman (1959), Optimal asymptotic tests of composite statistical hypotheses.
    Wooldridge (1990), Econometric Theory 6(1), 17-43.

    Examples
    --------
    >>> e = np.random.default_rng(0).standard_normal((500, 1))
    >>> late = of_each_output(lagged(e, [1]), np.eye(1))
    >>> score_test(e, late, np.zeros((500, 0))).p_value > 0.01
    True
    >>> score_test(e + 0.5 * late[:, 0], late, np.zeros((500, 0))).p_value < 1e-6
    True
    """
    Z = regressors.reshape(residuals.size, -1)
    size = np.linalg.norm(Z, axis=0)
    Z = Z[:, size > 0.0] / size[size > 0.0]
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


def times(regressors, functions):
    """Every regressor times every function, shape (n_samples, n_regressors * n_functions)."""
    return np.einsum("ti,tj->tij", regressors, functions).reshape(len(regressors), -1)


def autoregression(segments, most):
    """Coefficients of e[k] = Σ_j Φ_j e[k−j] + white noise, of the order with the least AIC.

    Parameters
    ----------
    segments : list of ndarray, shapes (n_samples_s, l)
    most : int
        Highest order.

    Returns
    -------
    Phi : ndarray, shape (order, l, l)
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
