"""The innovation form of a model: its one-step predictor, predictions further ahead, its start.

    x̂[k+1] = A x̂[k] + B u[k] + K e[k],   e[k] = y[k] − C x̂[k] − D u[k]

A − K C is stable, also where A is not.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices

__all__ = ["InnovationForm", "predicted_states"]

FORGOTTEN = 1e-12  # of an initial state
MOST_ROWS = 4096  # that an initial state is fitted to
UNSEEN = 1e-10  # of the strongest initial state's outputs


@dataclass(frozen=True, eq=False)
class InnovationForm:
    """A discrete-time model and its Kalman gain.

    Attributes
    ----------
    A, B, C, D : ndarray, shapes (n, n), (n, m), (l, n), (l, m)
    K : ndarray, shape (n, l)
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    K: np.ndarray

    def states(self, inputs, outputs, x0):
        """x̂ of every row, from the outputs of the rows before it.

        Parameters
        ----------
        inputs : ndarray, shape (n_rows, m)
        outputs : ndarray, shape (n_measured, l)
            Of the first rows; at most the last row may be without.
        x0 : ndarray, shape (n,)

        Returns
        -------
        states : ndarray, shape (n_rows, n)
        """
        forcing = inputs @ (self.B - self.K @ self.D).T
        forcing[: len(outputs)] += outputs @ self.K.T
        return propagate(self.A - self.K @ self.C, forcing, x0)

    def ahead(self, inputs, outputs, x0, horizon):
        """Outputs predicted some rows ahead; those of the first rows from the initial state.

        Parameters
        ----------
        inputs, outputs, x0
            As in :meth:`states`.
        horizon : int
            Rows from the last output known to the one predicted, at least 1.

        Returns
        -------
        outputs : ndarray, shape (n_rows, l)
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

        Parameters
        ----------
        inputs, outputs : ndarray, shapes (n_rows, m), (n_rows, l)
        covariance : ndarray, shape (l, l), optional
            Of the innovations, by whose deviations each output counts.

        Returns
        -------
        x0 : ndarray, shape (n,)
        """
        n = len(self.A)
        if n == 0:
            return np.zeros(0)
        stable = self.A - self.K @ self.C
        radius = np.max(np.abs(linalg.eigvals(stable)))
        rows = MOST_ROWS if radius >= 1.0 else n + np.log(FORGOTTEN) / np.log(max(radius, 1e-3))
        u, y = inputs[: int(min(rows, MOST_ROWS))], outputs[: int(min(rows, MOST_ROWS))]
        size = np.ones(y.shape[1]) if covariance is None else np.sqrt(np.diagonal(covariance))
        size = np.where(size > 0.0, size, 1.0)
        left = (y - self.states(u, y, np.zeros(n)) @ self.C.T - u @ self.D.T) / size
        free = propagate(stable, np.zeros((n, len(u), n)), np.eye(n)) @ self.C.T / size
        return linalg.lstsq(free.reshape(n, -1).T, left.ravel(), cond=UNSEEN)[0]


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


def predicted_states(A, C, K, inputs, outputs):
    """x̂ of every row under inputs whose way in is not known.

    B − K D, D and the initial states are those that leave the least innovations: a linear
    least-squares fit, with regressors that do not grow.

    Parameters
    ----------
    A, C, K : ndarray, shapes (n, n), (l, n), (n, l)
    inputs : list of ndarray, shapes (n_rows_s, m)
    outputs : list of ndarray, shapes (n_rows_s, l)

    Returns
    -------
    states : list of ndarray, shapes (n_rows_s, n)
    """
    stable, rest = A - K @ C, np.zeros(len(A))
    corrected = [propagate(stable, y @ K.T, rest) for y in outputs]
    left = [y - x @ C.T for x, y in zip(corrected, outputs, strict=True)]
    B, _, x0 = input_matrices(stable, C, inputs, left, True)
    driven = [propagate(stable, u @ B.T, start) for u, start in zip(inputs, x0, strict=True)]
    return [x + y for x, y in zip(corrected, driven, strict=True)]
