"""State-space models whose entries are affine in a vector of parameters.

    [A B; C D](θ) = S₀ + Σ_k θ_k S_k

Response and sensitivity follow from two factors alone (s not an eigenvalue of A):

    L(s) = [C (sI − A)⁻¹, I],   R(s) = [(sI − A)⁻¹ B; I],   K(s) = [(sI − A)⁻¹ 0; 0 0]
    G = C (sI − A)⁻¹ B + D,     ∂G/∂θ_k = L S_k R
    ∂²G/∂θ_j∂θ_k = L (S_j K S_k + S_k K S_j) R
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.resolvent import triangular_form

__all__ = ["AffineStructure"]

_PIECE = 100_000  # entries of second derivatives that are summed together


@dataclass(frozen=True, eq=False)
class AffineStructure:
    """State-space model with entries affine in its parameters.

    Parameters
    ----------
    constant : ndarray, shape (n + l, n + m)
        S₀: [A B; C D] at θ = 0.
    basis : ndarray, shape (k, n + l, n + m)
        S_k: what one unit of each parameter adds.
    n_states : int
        n, which says where [A B; C D] is divided.
    parameter_names : tuple of str, length k

    Examples
    --------
    The lag θ₀/(s + 1):

    >>> lag = AffineStructure(np.array([[-1.0, 0.0], [1.0, 0.0]]),
    ...                       np.array([[[0.0, 1.0], [0.0, 0.0]]]), 1, ("gain",))
    >>> lag.response([3.0], [0.0]).real.item()
    3.0
    """

    constant: np.ndarray
    basis: np.ndarray
    n_states: int
    parameter_names: tuple

    @classmethod
    def fixed(cls, A, B, C, D):
        """A model without parameters."""
        stacked = np.block([[A, B], [C, D]])
        return cls(stacked, np.zeros((0, *stacked.shape)), len(A), ())

    @property
    def n_parameters(self):
        return len(self.basis)

    @property
    def n_inputs(self):
        return self.constant.shape[1] - self.n_states

    @property
    def n_outputs(self):
        return self.constant.shape[0] - self.n_states

    def matrices(self, theta):
        """(A, B, C, D) at the parameters θ, shape (k,)."""
        return self.split(self.constant + np.tensordot(np.asarray(theta, float), self.basis, 1))

    def split(self, stacked):
        """(A, B, C, D) of the block matrix [A B; C D]."""
        n = self.n_states
        return stacked[:n, :n], stacked[:n, n:], stacked[n:, :n], stacked[n:, n:]

    def project(self, stacked, weights=None):
        """Parameters of the structured matrix nearest to a given one, and the rest.

        Parameters
        ----------
        stacked : ndarray, shape (n + l, n + m)
            [A B; C D].
        weights : ndarray, shape (n + l, n + m), optional
            Positive weights of the entries in the sum of squares; 1 by default.

        Returns
        -------
        theta : ndarray, shape (k,)
            The smallest one where several are equally near.
        residual : ndarray, shape (n + l, n + m)
            Weighted difference left.
        """
        weights = np.ones_like(self.constant) if weights is None else weights
        columns = (weights * self.basis).reshape(self.n_parameters, -1).T
        size = column_sizes(columns)
        gap = weights * (stacked - self.constant)
        theta = linalg.lstsq(columns / size, gap.ravel())[0] / size
        return theta, gap - (columns @ theta).reshape(gap.shape)

    @cached_property
    def _entries(self):
        """Rows and columns of the entries that move, and their rates, (n_entries, k)."""
        rows, columns = np.nonzero(np.any(self.basis != 0, axis=0))
        return rows, columns, self.basis[:, rows, columns].T

    def poles(self, theta):
        """Eigenvalues of A, shape (n,)."""
        return triangular_form(self.matrices(theta)[0]).poles

    def _driven(self, matrices, s):
        """R(s), shape (n + m, n_points, m)."""
        A, B = matrices[:2]
        n, m = B.shape
        right = np.empty((n + m, len(s), m), dtype=complex)
        right[:n], right[n:] = triangular_form(A).driven(B, s), np.eye(m)[:, None]
        return right

    def _seen(self, matrices, s):
        """L(s) transposed, shape (n + l, n_points, l)."""
        A, _, C, _ = matrices
        p, n = C.shape
        left = np.empty((n + p, len(s), p), dtype=complex)
        left[:n], left[n:] = triangular_form(A).seen(C, s), np.eye(p)[:, None]
        return left

    def response(self, theta, s):
        """G(s), shape (n_points, l, m); s may hold infinity."""
        matrices = self.matrices(theta)
        return _response(matrices, self._driven(matrices, points(s)))

    def response_and_sensitivity(self, theta, s):
        """G(s), shape (n_points, l, m), and ∂G/∂θ, shape (n_points, l, m, k)."""
        matrices, s = self.matrices(theta), points(s)
        left, right = self._seen(matrices, s), self._driven(matrices, s)
        rows, columns, rates = self._entries
        moved = left[rows][..., None] * right[columns][:, :, None]
        each = moved.shape[1:]
        slope = rates.T @ moved.view(float).reshape(len(rows), 2 * np.prod(each))
        slope = slope.view(complex).reshape(self.n_parameters, *each)
        return _response(matrices, right), np.moveaxis(slope, 0, -1)

    def curvature(self, theta, s, left_vectors, right_vectors):
        """Σ_ij Re(p_ijᴴ ∂²G(s_i)/∂θ² v_ij), shape (k, k).

        Parameters
        ----------
        theta : ndarray, shape (k,)
        s : complex ndarray, shape (n_points,)
            At infinity G is affine.
        left_vectors, right_vectors : complex ndarray
            p_ij and v_ij, shapes (n_points, n_vectors, l) and (n_points, n_vectors, m); one a
            point without their second axis.
        """
        matrices, n = self.matrices(theta), self.n_states
        finite = np.isfinite(s)
        s = s[finite]
        pairs = (left_vectors[finite], right_vectors[finite])
        p, v = (each[:, None] if each.ndim == 2 else each for each in pairs)
        rows, columns, rates = self._entries
        first, second = columns < n, rows < n  # of S_j K S_k: out of states, into states
        before = p.conj() @ self._seen(matrices, s)[rows[first]].transpose(1, 2, 0)
        after = v @ self._driven(matrices, s)[columns[second]].transpose(1, 2, 0)
        places = (slice(None), *np.ix_(columns[first], rows[second]))
        half = np.zeros((before.shape[2], after.shape[2]))
        size = max(1, _PIECE // max(half.size, 1))
        for here in (slice(k, k + size) for k in range(0, len(s), size)):
            K = np.linalg.inv(s[here, None, None] * np.eye(n) - matrices[0])
            half += np.sum((before[here].swapaxes(1, 2) @ after[here]) * K[places], axis=0).real
        half = rates[first].T @ half @ rates[second]
        return half + half.T


def points(s):
    """s as a complex array of one axis."""
    return np.atleast_1d(np.asarray(s, dtype=complex))


def _response(matrices, right):
    """C R_x + D, shape (n_points, l, m)."""
    C, D = matrices[2:]
    states = right[: C.shape[1]]
    shape = states.shape[1:]
    seen = C @ states.reshape(len(states), np.prod(shape))
    return seen.reshape(len(C), *shape).swapaxes(0, 1) + D


def column_sizes(matrix):
    """Euclidean length of each column, 1 for a column of zeros."""
    sizes = np.linalg.norm(matrix, axis=0)
    return np.where(sizes > 0, sizes, 1.0)
