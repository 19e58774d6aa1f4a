"""Kalman gain of the innovation form, from covariances that past and future data leave.

    x̂[k+1] = A x̂[k] + B u[k] + K e[k],   y[k] = C x̂[k] + D u[k] + e[k]

Two state sequences follow from oblique projections O of the future outputs on the past, one
row apart, X̂ = Γ† O (Van Overschee and De Moor, 1996, section 4.4.2); what they and the output
leave when regressed on X̂ and the future inputs has the covariances of process and measurement
noise [Q S; Sᵀ R], and with them

    P = A P Aᵀ + Q − K E Kᵀ,   K = (A P Cᵀ + S) E⁻¹,   E = C P Cᵀ + R
"""

import warnings
from itertools import product

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import solve_within_rank, triangle

__all__ = ["gain_of_covariances", "kalman_gain"]

PRECISION = 1e-9  # of an output's size: that of the best measurements
WHITE = (0.0, 1e-12, 1e-10, 1e-8)  # more noise of the outputs, where theirs is that of fewer


def kalman_gain(A, C, observability, R, block_rows, n_inputs, n_columns):
    """Kalman gain and covariance of the innovations.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    observability : ndarray, shape (i l, n)
        In the coordinates of A and C.
    R : ndarray, shape (2 i (m + l), 2 i (m + l))
        From :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`.
    block_rows, n_inputs, n_columns : int

    Returns
    -------
    K : ndarray, shape (n, l)
    covariance : ndarray, shape (l, l)

    Raises
    ------
    ValueError
        If no gain makes A − K C stable.

    References
    ----------
    Van Overschee, De Moor (1996), Subspace Identification for Linear Systems, section 4.4.2.
    """
    i, m, n_outputs = block_rows, n_inputs, len(C)
    places = np.split(np.arange(len(R)), np.cumsum([i * m, i * m, i * n_outputs]))
    U_f, U_p, Y_p, Y_f = places
    y = R[:, Y_f[:n_outputs]]
    x = _states(R, U_f, np.concatenate([U_p, Y_p]), Y_f, observability)
    past = np.concatenate([U_p, U_f[:m], Y_p, Y_f[:n_outputs]])
    later = _states(R, U_f[m:], past, Y_f[n_outputs:], observability[:-n_outputs])
    regressors, targets = np.hstack([x, R[:, U_f]]), np.hstack([later, y])
    left = targets - regressors @ solve_within_rank(regressors, targets)
    covariance = left.T @ left / max(1, n_columns - regressors.shape[1])
    return gain_of_covariances(A, C, covariance, np.linalg.norm(y, axis=0) / np.sqrt(n_columns))


def _states(R, future_inputs, past, future_outputs, observability):
    """States at the end of the past, in the coordinates of the rows of R."""
    T = triangle(R[:, np.concatenate([future_inputs, past, future_outputs])])
    inner = slice(len(future_inputs), len(future_inputs) + len(past))
    size = np.linalg.norm(R[:, past], axis=0)
    weights = solve_within_rank(T[inner, inner], T[inner, inner.stop :], size)
    return R[:, past] @ weights @ linalg.pinv(observability).T


def gain_of_covariances(A, C, covariance, y_scale):
    """Kalman gain of the stationary filter, and the covariance of its innovations.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    covariance : ndarray, shape (n + l, n + l)
        Of process and measurement noise, [Q S; Sᵀ R].
    y_scale : ndarray, shape (l,)
        Sizes of the outputs; no noise is taken for less than a billionth of them.

    Returns
    -------
    K : ndarray, shape (n, l)
    covariance : ndarray, shape (l, l)

    Raises
    ------
    ValueError
        If no gain makes A − K C stable.

    References
    ----------
    Anderson, Moore (1979), Optimal Filtering, section 4.4.

    Examples
    --------
    Of x[k+1] = 0.5 x[k] + w[k], y[k] = x[k] + v[k], both noises of variance 1:

    >>> K, E = gain_of_covariances(np.array([[0.5]]), np.eye(1), np.eye(2), np.ones(1))
    >>> P = E.item() - 1.0
    >>> bool(abs(P - (0.25 * P + 1.0 - E.item() * K.item() ** 2)) < 1e-12)
    True
    """
    n = len(A)
    floor = np.diag(np.append(np.zeros(n), (PRECISION * y_scale) ** 2))
    unit = np.max(np.diagonal(covariance)[n:] + np.diagonal(floor)[n:])
    if n == 0 or unit == 0.0:
        return np.zeros((n, len(C))), covariance[n:, n:]
    noise = (covariance + floor) / unit
    for white, driven in product(WHITE, (0.0, PRECISION)):
        more = np.append(np.full(n, driven), np.full(len(C), white))
        try:
            K, E = _stationary(A, C, noise + np.diag(more))
        except (ValueError, linalg.LinAlgWarning, RuntimeWarning):  # LinAlgError is a ValueError
            continue
        if np.max(np.abs(linalg.eigvals(A - K @ C))) < 1.0 + PRECISION:
            return K, E * unit
    raise ValueError(
        f"no Kalman gain makes the model of order {n} a stable predictor: it has a mode that grows "
        f"and that the outputs hardly show; lower the order, or check the units of the outputs"
    )


def _stationary(A, C, noise):
    """Gain and covariance of the innovations, by the algebraic Riccati equation."""
    n = len(A)
    Q, S, R = noise[:n, :n], noise[:n, n:], noise[n:, n:]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        P = linalg.solve_discrete_are(A.T, C.T, Q, R, s=S)
        E = C @ P @ C.T + R
        return linalg.solve(E, (A @ P @ C.T + S).T, assume_a="pos").T, E
