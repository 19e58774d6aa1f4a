"""Common part of future outputs and past data: observability, singular values, A and C.

From the triangular factor of [U_f; U_p; Y_p; Y_f] = L Q, with W_p = [U_p; Y_p], the oblique
projection O of Y_f along U_f on W_p, and Π the projection off the rows of U_f (Van Overschee
and De Moor, 1995, Table 1), Γ is spanned by the singular vectors of W₁ O W₂ = U S Vᵀ:

    MOESP   W₁ = I                        W₂ = Π     (Verhaegen, 1994; W₁ O W₂ is L_32)
    N4SID   W₁ = I                        W₂ = I
    CVA     W₁ = (Y_f Π Y_fᵀ)^(−1/2)      W₂ = Π     (singular values: canonical correlations)

    Γ_i  = U_n S_n^½   (Eq. 13),   C = Γ_i[:l],   Γ_i[:-l] A = Γ_i[l:]

The robust N4SID of the same authors (1996, section 4.4) has the weights of MOESP. Every fit
but ``weighting="pbsid"`` needs it.

``weighting="pbsid"`` is predictor-based subspace identification, for data measured in closed loop
too.

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
from sklearn_hd.algorithms.linalg.triangular import (
    all_above_rounding,
    solve_within_rank,
    svd_within_rank,
    triangle,
)
from sklearn_hd.algorithms.lti.simulation import is_stable, nearest_stable
from sklearn_hd.algorithms.subspace.innovations import gain_of_covariances, kalman_gain


def observability_subspace(R, block_rows, n_inputs):
    """Left singular vectors and singular values of the projected future outputs.

    The largest entry of each vector is positive, whatever way led to R.
    """
    past = slice(block_rows * n_inputs, R.shape[0] - _future_width(R, block_rows, n_inputs))
    projected = triangle(R[past, past.stop :]).T  # of as many columns as rows
    U, singular_values, _ = np.linalg.svd(projected)
    return _upright(U), singular_values


def release_idle_directions(R, n_future_inputs):
    """The factor with nothing projected out that the future inputs do not excite.

    Where inputs excite fewer directions than they have rows, a QR factorisation goes on
    with directions made of rounding, which lie in the very columns in which inputs move:
    projected out, they take the response with them. They are handed on to the past. R stays
    upper block triangular, and RᵀR as before, except for what is below rounding in U_f.
    """
    n = n_future_inputs
    if all_above_rounding(R[:n, :n]):
        return R
    rotation, sizes, _ = linalg.svd(R[:n, :n])
    idle = sizes <= DEPENDENT * sizes[0]
    if not idle.any():
        return R
    freed = rotation[:, idle].T @ R[:n, n:]
    rest = linalg.qr(np.vstack([freed, R[n:, n:]]), mode="r")[0][: len(R) - n]
    kept = np.zeros_like(R)
    kept[: n - idle.sum()] = rotation[:, ~idle].T @ R[:n]
    kept[n:, n:] = rest
    return kept


def _future_width(R, block_rows, n_inputs):
    return R.shape[0] // 2 - block_rows * n_inputs


def noise_floor(R, block_rows, n_inputs, n_columns):
    """Largest singular value that rounding, or white output noise, would give.

    The residual of the future outputs after regression on all past and future
    data, L_33, has the noise's standard deviation times the square root of the
    columns left; random rows of that size in L_32 have singular values up to
    σ (√(i l) + √(i (m + l))) (Marchenko and Pastur, 1967).
    """
    future = _future_width(R, block_rows, n_inputs)
    start = R.shape[0] - future
    past = start - block_rows * n_inputs
    left, noise = n_columns - start, 0.0
    if left >= future:  # else too few columns to see a residual
        sigma = np.linalg.norm(R[start:, start:]) / np.sqrt(future * left)
        noise = sigma * (np.sqrt(future) + np.sqrt(past))
    unit = 10.0 * EPS * np.sqrt(n_columns)
    if noise > unit * np.linalg.norm(R[:, start:]):  # Frobenius, no less than the largest
        return noise
    return max(unit * np.linalg.norm(R[:, start:], 2), noise)


def state_matrices(U, singular_values, order, n_outputs, stable=False):
    """A and C of the chosen order by the shift property (Eq. 13).

    With ``stable``, the nearest stable A, each state weighed by how much outputs see of it.
    """
    observability = U[:, :order] * np.sqrt(singular_values[:order])
    A = np.linalg.lstsq(observability[:-n_outputs], observability[n_outputs:], rcond=EPS)[0]
    if stable:
        A = nearest_stable(A, singular_values[:order])  # the squared columns of Γ
    return A, observability[:n_outputs]


@dataclass(frozen=True, eq=False)
class Projection:
    """Weighted future outputs, decomposed."""

    # (2 i (m + l), 2 i (m + l)): from :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`
    R: np.ndarray
    block_rows: int  # i
    n_inputs: int  # m
    n_columns: int  # Hankel columns behind R
    # (i l, i l): Γ of order n is the first n of them, times the roots of their singular values
    directions: np.ndarray
    singular_values: np.ndarray  # (i l,)
    floor: float  # largest singular value that rounding or white noise would give

    @classmethod
    def of(cls, R, block_rows, n_inputs, n_columns, weighting):
        """The projection under one of the weightings "moesp", "n4sid", "cva"."""
        found = PROJECTIONS[weighting](R, block_rows, n_inputs, n_columns)
        return cls(R, block_rows, n_inputs, n_columns, *found)

    @property
    def n_outputs(self):
        """Number of outputs, l."""
        return len(self.R) // (2 * self.block_rows) - self.n_inputs

    def unweighted(self):
        """The projection of the same data with the weighting "moesp"."""
        return self.of(self.R, self.block_rows, self.n_inputs, self.n_columns, "moesp")

    def state_matrices(self, order, stable=False):
        """A and C of some order (Eq. 13); with ``stable``, A is."""
        return state_matrices(self.directions, self.singular_values, order, self.n_outputs, stable)

    def kalman_gain(self, order, stable=False):
        """K of the innovation form, and the covariance of the innovations."""
        A, C = self.state_matrices(order, stable)
        observability = self.directions[:, :order] * np.sqrt(self.singular_values[:order])
        return kalman_gain(
            A, C, observability, self.R, self.block_rows, self.n_inputs, self.n_columns
        )


def _moesp(R, block_rows, n_inputs, n_columns):
    U, values = observability_subspace(R, block_rows, n_inputs)
    return U, values, noise_floor(R, block_rows, n_inputs, n_columns)


def _n4sid(R, block_rows, n_inputs, n_columns):
    future, past = _blocks(R, block_rows, n_inputs)
    size = np.linalg.norm(R[:, past], axis=0)
    weights = solve_within_rank(R[past, past], R[past, past.stop :], size)
    oblique = R[: past.stop, past] @ weights
    U, values, _ = linalg.svd(oblique.T, full_matrices=False)
    # noise of Y_f is as strong in O as the past beside what of it is off the future inputs:
    # of white N and some S, ‖N S‖ ≤ √rows ‖S‖ + ‖S‖_F (Chevet, 1978), here for √rows + √columns
    rows, columns = len(U), past.stop - past.start
    along = linalg.svdvals(
        solve_within_rank(R[past, past], np.eye(columns), size).T @ R[future, past].T
    )
    stretch = np.sqrt(1.0 + along**2)
    spread = np.sqrt(np.sum(along**2) + columns)
    share = np.sqrt(rows) * np.max(stretch, initial=1.0) + spread
    floor = noise_floor(R, block_rows, n_inputs, n_columns)
    return _upright(U), values, floor * share / (np.sqrt(rows) + np.sqrt(columns))


def _cva(R, block_rows, n_inputs, n_columns):
    future, past = _blocks(R, block_rows, n_inputs)
    off = R[past.start :, past.stop :].T  # Y_f Π
    U, sizes, Vt = svd_within_rank(off)
    rank, largest = len(sizes), np.max(sizes, initial=0.0)
    rotation, correlations, _ = linalg.svd(Vt[:, : past.stop - past.start], full_matrices=False)
    directions, values = np.zeros((len(off), len(off))), np.zeros(len(off))
    directions[:, : rotation.shape[1]] = (U * sizes) @ rotation
    values[: len(correlations)] = correlations
    noisy = int(np.sum(linalg.svdvals(R[past.stop :, past.stop :]) > DEPENDENT * largest))
    floor, left = 10.0 * EPS, n_columns - future.stop
    if rank == min(left, len(off)):  # no fewer than there could be, were all noise
        noisy = rank
    if noisy:  # outputs, or combinations of them, that past and future inputs do not explain
        floor = max(floor, _largest_correlation(noisy / left, (past.stop - past.start) / left))
    return _upright(directions), values, floor


def _largest_correlation(a, b):
    """Largest canonical correlation of independent white data (Wachter, 1980).

    Of a N and b N variables in N samples, as N grows.
    """
    if a + b >= 1.0:
        return 1.0
    return np.sqrt(a * (1.0 - b)) + np.sqrt(b * (1.0 - a))


PROJECTIONS = {"moesp": _moesp, "n4sid": _n4sid, "cva": _cva}


def _blocks(R, block_rows, n_inputs):
    """Where the future inputs, and the past, stand in R."""
    start = block_rows * n_inputs
    return slice(0, start), slice(start, start + len(R) // 2)


def _upright(directions):
    """Each direction with its largest entry positive, whatever way led to it."""
    largest = directions[np.argmax(np.abs(directions), axis=0), np.arange(directions.shape[1])]
    return directions * np.copysign(1.0, largest)


@dataclass(frozen=True, eq=False)
class PredictorSubspace:
    """States that the coefficients of a long predictor make of the past."""

    # (r, i (m + l)): data of the rows k − 1, k − 2, … before row k, in coordinates of R's rows
    past: np.ndarray
    later: np.ndarray  # (r, i (m + l)): the same one row later
    inputs: np.ndarray  # (r, m): at row k
    outputs: np.ndarray  # (r, l): at row k
    coefficients: np.ndarray  # (i l, i (m + l)): Γ̃ 𝒦
    directions: np.ndarray  # (i l, i l): u
    singular_values: np.ndarray  # (i l,)
    floor: float  # largest singular value that rounding or white noise would give
    feedthrough: bool  # whether D is free
    n_columns: int

    @classmethod
    def of(cls, R, block_rows, n_inputs, n_columns, feedthrough):
        """The states behind a triangular factor."""
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
        """A, B, C, D, K and the innovations' covariance of some order; with ``stable``, A is."""
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
    """How many rows back, from 1 to i, the predictor of one row reaches, by Akaike's criterion.

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

    0 where the Bayesian information criterion takes it for chance.
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
    white = rng.standard_normal((20, len(sizes), n_rows * width))
    return max(np.linalg.norm(_shifted(root @ noise, n_rows), 2) for noise in white)
