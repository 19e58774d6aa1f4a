"""The innovation form of a model: its Kalman gain, its predictions, its start.

    x̂[k+1] = A x̂[k] + B u[k] + K e[k],   e[k] = y[k] − C x̂[k] − D u[k]

A − K C is stable, also where A is not. Two state sequences follow from oblique projections O of
the future outputs on the past, one row apart, X̂ = Γ† O (Van Overschee and De Moor, 1996,
section 4.4.2); what they and the output leave when regressed on X̂ and the future inputs has the
covariances of process and measurement noise [Q S; Sᵀ R], and with them

    P = A P Aᵀ + Q − K E Kᵀ,   K = (A P Cᵀ + S) E⁻¹,   E = C P Cᵀ + R

``disturbance_model=True`` and ``weighting="pbsid"`` need the gain, ``predict_ahead`` the rest.
"""

import warnings
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, PRECISION
from sklearn_hd.algorithms.linalg.triangular import solve_within_rank, triangle
from sklearn_hd.algorithms.lti.simulation import propagate

REACH = 4096  # rows over which states are followed
WHITE = (0.0, 1e-12, 1e-10, 1e-8)  # more noise of the outputs, where theirs is that of fewer


@dataclass(frozen=True, eq=False)
class InnovationForm:
    """A discrete-time model and its Kalman gain."""

    A: np.ndarray  # (n, n)
    B: np.ndarray  # (n, m)
    C: np.ndarray  # (l, n)
    D: np.ndarray  # (l, m)
    K: np.ndarray  # (n, l)

    def states(self, inputs, outputs, x0):
        """x̂ of every row, from the outputs of the rows before it.

        Only the last row of ``inputs`` may be without outputs.
        """
        forcing = inputs @ (self.B - self.K @ self.D).T
        forcing[: len(outputs)] += outputs @ self.K.T
        return propagate(self.A - self.K @ self.C, forcing, x0)

    def ahead(self, inputs, outputs, x0, horizon):
        """Outputs predicted some rows ahead; those of the first rows from the initial state.

        Other arguments are as in :meth:`states`. ``horizon``, at least 1, is the number
        of rows from the last output known to the one predicted.
        """
        x, forcing = self.states(inputs, outputs, x0), inputs @ self.B.T
        steps = min(horizon, len(x)) - 1
        if steps > 0:  # rows later, without another innovation
            power, forced = _many_steps(self.A, forcing, steps)
            begun = propagate(self.A, forcing[:steps], x0)
            with np.errstate(over="ignore", invalid="ignore"):
                x = np.concatenate([begun, x[:-steps] @ power.T + forced[steps:]])
        return x @ self.C.T + inputs @ self.D.T

    def initial_state(self, inputs, outputs, covariance=None):
        """The state that leaves the least innovations, by linear least squares.

        Each output counts by the deviation of its innovations, where their
        ``covariance`` is given.
        """
        n = len(self.A)
        if n == 0:
            return np.zeros(0)
        stable = self.A - self.K @ self.C
        radius = np.max(np.abs(linalg.eigvals(stable)))
        rows = REACH if radius >= 1.0 else n + np.log(DEPENDENT) / np.log(max(radius, 1e-3))
        u, y = inputs[: int(min(rows, REACH))], outputs[: int(min(rows, REACH))]
        size = np.ones(y.shape[1]) if covariance is None else np.sqrt(np.diagonal(covariance))
        size = np.where(size > 0.0, size, 1.0)
        left = (y - self.states(u, y, np.zeros(n)) @ self.C.T - u @ self.D.T) / size
        free = propagate(stable, np.zeros((n, len(u), n)), np.eye(n)) @ self.C.T / size
        return linalg.lstsq(free.reshape(n, -1).T, left.ravel(), cond=DEPENDENT)[0]


def _many_steps(A, forcing, steps):
    """A^s, and Σ_j A^{j−1} v[k−j] over the s rows before each row, by repeated doubling."""
    power, forced = np.eye(len(A)), np.zeros_like(forcing)
    square, twice, done, more = A, _later(forcing, 1), 0, 1
    with np.errstate(over="ignore", invalid="ignore"):
        while done < steps:
            if steps & more:
                forced = forced + _later(twice, done) @ power.T
                power, done = power @ square, done + more
            twice = twice + _later(twice, more) @ square.T
            square, more = square @ square, 2 * more
    return power, forced


def _later(rows, count):
    """Rows so many rows later, zero before."""
    return np.concatenate([np.zeros_like(rows[:count]), rows[: len(rows) - count]])


def kalman_gain(A, C, observability, R, block_rows, n_inputs, n_columns):
    """Kalman gain K and covariance of the innovations.

    ``observability`` (i l, n) is in the coordinates of A and C, and ``R`` from
    :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`. It raises ValueError
    if no gain makes A − K C stable.

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

    ``covariance`` is that of process and measurement noise, [Q S; Sᵀ R]. No noise is
    taken for less than a billionth of ``y_scale`` (l,), the sizes of the outputs. It
    raises ValueError if no gain makes A − K C stable.

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
        f"no Kalman gain makes the model of order {n} a stable predictor, because it has a growing "
        f"mode that the outputs hardly show; lower the order, or check the units of the outputs"
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
