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

__all__ = ["AffineStructure"]


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

    def _factors(self, theta, s):
        """L(s), R(s) and (sI − A)⁻¹, which is 0 at s = ∞."""
        A, B, C, D = self.matrices(theta)
        s = np.atleast_1d(np.asarray(s, dtype=complex))
        finite = np.isfinite(s)
        n, m, p = self.n_states, B.shape[1], len(C)
        resolvent = np.zeros((len(s), n, n), dtype=complex)
        resolvent[finite] = np.linalg.inv(s[finite, None, None] * np.eye(n) - A)
        left = np.empty((len(s), p, n + p), dtype=complex)
        left[:, :, :n], left[:, :, n:] = C @ resolvent, np.eye(p)
        right = np.empty((len(s), n + m, m), dtype=complex)
        right[:, :n], right[:, n:] = resolvent @ B, np.eye(m)
        return left, right, resolvent, C, D

    def response(self, theta, s):
        """G(s), shape (n_points, l, m); s may hold infinity."""
        _, right, _, C, D = self._factors(theta, s)
        return C @ right[:, : self.n_states] + D

    def response_and_sensitivity(self, theta, s):
        """G(s), shape (n_points, l, m), and ∂G/∂θ, shape (n_points, l, m, k)."""
        left, right, _, C, D = self._factors(theta, s)
        rows, columns, rates = self._entries
        moved = left[:, :, None, rows] * right[:, columns].swapaxes(1, 2)[:, None]
        return C @ right[:, : self.n_states] + D, moved @ rates

    def curvature(self, theta, s, left_vectors, right_vectors):
        """Σ_i Re(p_iᴴ ∂²G(s_i)/∂θ² v_i), shape (k, k).

        Parameters
        ----------
        theta : ndarray, shape (k,)
        s : complex ndarray, shape (n_points,)
        left_vectors, right_vectors : complex ndarray, shapes (n_points, l), (n_points, m)
            p_i and v_i.
        """
        left, right, resolvent, _, _ = self._factors(theta, s)
        n = self.n_states
        before = np.einsum("fl,fla->fa", left_vectors.conj(), left)
        after = np.einsum("fbm,fm->fb", right, right_vectors)
        n_points, k = len(resolvent), self.n_parameters
        into = np.tensordot(before, self.basis[:, :, :n], axes=(1, 1))
        out_of = np.tensordot(after, self.basis[:, :n], axes=(1, 2))
        through = (into @ resolvent).swapaxes(0, 1).reshape(k, n_points * n)
        half = (through @ out_of.swapaxes(0, 1).reshape(k, n_points * n).T).real
        return half + half.T


def column_sizes(matrix):
    """Euclidean length of each column, 1 for a column of zeros."""
    sizes = np.linalg.norm(matrix, axis=0)
    return np.where(sizes > 0, sizes, 1.0)
