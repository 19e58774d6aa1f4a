"""What future outputs share with past data, under the weightings of three methods.

From the triangular factor of [U_f; U_p; Y_p; Y_f] = L Q, with W_p = [U_p; Y_p], the oblique
projection O of Y_f along U_f on W_p, and Π the projection off the rows of U_f (Van Overschee
and De Moor, 1995, Table 1), Γ is spanned by the singular vectors of W₁ O W₂:

    MOESP   W₁ = I                        W₂ = Π
    N4SID   W₁ = I                        W₂ = I
    CVA     W₁ = (Y_f Π Y_fᵀ)^(−1/2)      W₂ = Π     (singular values: canonical correlations)

The robust N4SID of the same authors (1996, section 4.4) has the weights of MOESP.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import solve_within_rank
from sklearn_hd.algorithms.subspace.kalman_gain import kalman_gain
from sklearn_hd.algorithms.subspace.moesp import noise_floor, observability_subspace, state_matrices

__all__ = ["PROJECTIONS", "Projection"]

EPS = np.finfo(float).eps
RANK = 1e-11  # of the longest direction: rounding


@dataclass(frozen=True, eq=False)
class Projection:
    """Weighted future outputs, decomposed.

    Attributes
    ----------
    R : ndarray, shape (2 i (m + l), 2 i (m + l))
        From :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`.
    block_rows, n_inputs, n_columns : int
        i, m, and the Hankel columns behind R.
    directions : ndarray, shape (i l, i l)
        Γ of order n is the first n of them, times the roots of their singular values.
    singular_values : ndarray, shape (i l,)
    floor : float
        Largest singular value that rounding or white noise would give.
    """

    R: np.ndarray
    block_rows: int
    n_inputs: int
    n_columns: int
    directions: np.ndarray
    singular_values: np.ndarray
    floor: float

    @classmethod
    def of(cls, R, block_rows, n_inputs, n_columns, weighting):
        """The projection under one of the weightings "moesp", "n4sid", "cva"."""
        found = PROJECTIONS[weighting](R, block_rows, n_inputs, n_columns)
        return cls(R, block_rows, n_inputs, n_columns, *found)

    @property
    def n_outputs(self):
        """Number of outputs, l."""
        return len(self.R) // (2 * self.block_rows) - self.n_inputs

    def state_matrices(self, order):
        """A and C of some order (Eq. 13)."""
        return state_matrices(self.directions, self.singular_values, order, self.n_outputs)

    def kalman_gain(self, order):
        """K of the innovation form, and the covariance of the innovations."""
        A, C = self.state_matrices(order)
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
    U, sizes, Vt = linalg.svd(off, full_matrices=False)
    largest = np.max(sizes, initial=0.0)
    rank = int(np.sum(sizes > RANK * largest))
    rotation, correlations, _ = linalg.svd(Vt[:rank, : past.stop - past.start], full_matrices=False)
    directions, values = np.zeros((len(off), len(off))), np.zeros(len(off))
    directions[:, : rotation.shape[1]] = (U[:, :rank] * sizes[:rank]) @ rotation
    values[: len(correlations)] = correlations
    noisy = int(np.sum(linalg.svdvals(R[past.stop :, past.stop :]) > RANK * largest))
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
