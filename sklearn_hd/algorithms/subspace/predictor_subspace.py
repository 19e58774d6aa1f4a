"""Predictor-based subspace identification, for data measured in closed loop too.

In innovation form, with Ã = A − K C and B̃ = B − K D, every stable predictor forgets its state:

    y[k] = Σ_{j=1…p} C Ã^{j−1} [B̃ K] z[k−j] + D u[k] + e[k],   z = [u; y]

to within Ã^p. Its coefficients Ξ_j = C Ã^{j−1} [B̃ K] follow by least squares, for e[k] is
independent of everything before it, feedback or none. Of them

    Γ̃ 𝒦 = [Ξ_1 Ξ_2 … Ξ_p; Ξ_2 … Ξ_p 0; …],   x̂[k] = (S^½ Vᵀ)[k]  of  Γ̃ 𝒦 Z_p = U S Vᵀ

and A, B, C, D, K by regression (Chiuso, 2007: optimised PBSID). All of it is linear in the
data, and so takes no more of them than their triangular factor.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS
from sklearn_hd.algorithms.linalg.triangular import solve_within_rank, triangle
from sklearn_hd.algorithms.lti.stability import is_stable, nearest_stable
from sklearn_hd.algorithms.subspace.innovations import gain_of_covariances

DRAWS = 20  # of coefficients that are noise


@dataclass(frozen=True, eq=False)
class PredictorSubspace:
    """States that the coefficients of a long predictor make of the past.

    Attributes
    ----------
    past : ndarray, shape (r, i (m + l))
        Data of the rows k − 1, k − 2, … before row k, in coordinates of R's rows.
    later : ndarray, shape (r, i (m + l))
        The same one row later.
    inputs, outputs : ndarray, shapes (r, m), (r, l)
        At row k.
    coefficients : ndarray, shape (i l, i (m + l))
        Γ̃ 𝒦.
    directions : ndarray, shape (i l, i l)
        U.
    singular_values : ndarray, shape (i l,)
    floor : float
        Largest singular value that rounding or white noise would give.
    feedthrough : bool
        Whether D is free.
    n_columns : int
    """

    past: np.ndarray
    later: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    coefficients: np.ndarray
    directions: np.ndarray
    singular_values: np.ndarray
    floor: float
    feedthrough: bool
    n_columns: int

    @classmethod
    def of(cls, R, block_rows, n_inputs, n_columns, feedthrough):
        """The states behind a triangular factor.

        Parameters
        ----------
        R : ndarray, shape (2 i (m + l), 2 i (m + l))
            From :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`.
        block_rows, n_inputs, n_columns : int
        feedthrough : bool
        """
        i, m = block_rows, n_inputs
        rows, now = _rows_back(R, i, m)
        width = len(now)
        data = triangle(R[:, np.concatenate([*rows, now])])
        past, inputs, outputs = np.split(data, [i * width, i * width + m], axis=1)
        later = np.hstack([inputs, outputs, past[:, :-width]])
        regressors = np.hstack([past, inputs]) if feedthrough else past
        found = solve_within_rank(regressors, outputs)
        coefficients = _shifted(found[: i * width].T, i)
        U, values, _ = linalg.svd(coefficients @ past.T, full_matrices=False)
        rounding = 10.0 * EPS * np.sqrt(n_columns) * np.linalg.norm(past, 2)
        left = outputs - regressors @ found
        floor = max(rounding, _noise_floor(left, n_columns - regressors.shape[1], i, width))
        return cls(
            past,
            later,
            inputs,
            outputs,
            coefficients,
            U,
            values,
            floor,
            feedthrough,
            n_columns,
        )

    def model(self, order, stable=False):
        """The innovation form of some order; with ``stable``, A is.

        Returns
        -------
        A, B, C, D, K : ndarray
        covariance : ndarray, shape (l, l)
            Of the innovations.
        """
        roots = np.sqrt(self.singular_values[:order])
        read = (self.directions[:, :order] / roots).T @ self.coefficients
        x, later, u, y = self.past @ read.T, self.later @ read.T, self.inputs, self.outputs
        C, D, e = self._regressed(y, x, u if self.feedthrough else u[:, :0])
        if not self.feedthrough:
            D = np.zeros((len(C), u.shape[1]))
        driven = np.hstack([x, u, e])
        A, B, K = np.split(
            solve_within_rank(driven, later).T, np.cumsum([order, u.shape[1]]), axis=1
        )
        if stable and not is_stable(A):
            A = nearest_stable(A, self.singular_values[:order])
            B = solve_within_rank(driven[:, order:], later - x @ A.T).T[:, : u.shape[1]]
        noise = np.hstack([later - x @ A.T - u @ B.T, e])
        covariance = noise.T @ noise / max(1, self.n_columns - order - u.shape[1])
        size = np.linalg.norm(y, axis=0) / np.sqrt(self.n_columns)
        K, innovations = gain_of_covariances(A, C, covariance, size)
        return A, B, C, D, K, innovations

    @staticmethod
    def _regressed(target, *regressors):
        """Coefficients of each block of regressors, and what they leave."""
        stacked = np.hstack(regressors)
        found = solve_within_rank(stacked, target)
        edges = np.cumsum([block.shape[1] for block in regressors])[:-1]
        return *np.split(found.T, edges, axis=1), target - stacked @ found

    def state_matrices(self, order, stable=False):
        """A and C of some order; with ``stable``, A is."""
        found = self.model(order, stable)
        return found[0], found[2]


def rows_remembered(R, block_rows, n_inputs, n_columns, feedthrough):
    """How many rows back the predictor of one row reaches, by Akaike's criterion.

    Parameters
    ----------
    R : ndarray, shape (2 i (m + l), 2 i (m + l))
        Of the most rows tried, i.
    block_rows, n_inputs, n_columns : int
    feedthrough : bool

    Returns
    -------
    n_rows : int
        From 1 to i.

    References
    ----------
    Akaike (1974), IEEE Transactions on Automatic Control 19(6), 716-723.
    """
    rows, now = _rows_back(R, block_rows, n_inputs)
    inputs, outputs = now[:n_inputs], now[n_inputs:]
    first = inputs if feedthrough else inputs[:0]
    T = triangle(R[:, np.concatenate([first, *rows, outputs])])
    target, width = T[:, -len(outputs) :], len(now)
    least = DEPENDENT * np.linalg.norm(target)  # below, nothing is left to predict
    criteria = []
    for p in range(1, block_rows + 1):
        sizes = linalg.svdvals(target[len(first) + p * width :])
        information = 2.0 * n_columns * np.sum(np.log(np.maximum(sizes, least)))
        criteria.append(information + 2.0 * p * width * len(outputs))
    return int(np.argmin(criteria)) + 1


def share_at_once(R, block_rows, n_inputs, n_columns):
    """Share of the innovations' variance that the inputs of the same row explain.

    Parameters
    ----------
    R : ndarray, shape (2 i (m + l), 2 i (m + l))
    block_rows, n_inputs, n_columns : int

    Returns
    -------
    share : float
        From 0 to 1; 0 where the Bayesian information criterion takes it for chance.
    """
    rows, now = _rows_back(R, block_rows, n_inputs)
    T = triangle(R[:, np.concatenate([*rows, now])])
    first, n_outputs = len(T) - len(now), len(now) - n_inputs
    target = T[:, -n_outputs:]
    least = DEPENDENT * np.linalg.norm(target)
    without, left = (
        np.maximum(linalg.svdvals(target[k:]), least) for k in (first, first + n_inputs)
    )
    gain = 2.0 * n_columns * np.sum(np.log(without / left))
    if gain <= n_inputs * n_outputs * np.log(n_columns):
        return 0.0
    return float(1.0 - np.sum(left**2) / np.sum(without**2))


def _rows_back(R, block_rows, n_inputs):
    """Places of the data 1, 2, … rows before a row, and of its own."""
    i, m, n_outputs = block_rows, n_inputs, len(R) // (2 * block_rows) - n_inputs
    U_f, U_p, Y_p, Y_f = np.split(np.arange(len(R)), np.cumsum([i * m, i * m, i * n_outputs]))
    U_p, Y_p = U_p.reshape(i, m), Y_p.reshape(i, n_outputs)
    rows = [np.concatenate([U_p[-j], Y_p[-j]]) for j in range(1, i + 1)]
    return rows, np.concatenate([U_f[:m], Y_f[:n_outputs]])


def _shifted(coefficients, n_rows):
    """Γ̃ 𝒦 of the predictor's coefficients, the latest row of data first."""
    n_outputs, width = coefficients.shape
    lags = coefficients.reshape(n_outputs, n_rows, -1)
    stacked = np.zeros((n_rows, *lags.shape))
    for r in range(n_rows):
        stacked[r, :, : n_rows - r] = lags[:, r:]
    return stacked.reshape(n_rows * n_outputs, width)


def _noise_floor(left, degrees, n_rows, width):
    """Largest singular value of Γ̃ 𝒦 Z_p, were all coefficients white noise beside Z_p.

    Its rows share their entries, so that the law of independent ones does not hold: drawn.
    """
    _, sizes, Vt = linalg.svd(left, full_matrices=False)
    root = (sizes[:, None] * Vt).T / np.sqrt(max(1, degrees))
    rng = np.random.default_rng(0)  # the same floor for the same data
    white = rng.standard_normal((DRAWS, len(sizes), n_rows * width))
    return max(np.linalg.norm(_shifted(root @ noise, n_rows), 2) for noise in white)
