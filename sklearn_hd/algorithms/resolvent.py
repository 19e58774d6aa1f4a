"""States of a linear model at many points s, from one triangular form of A.

    A = S Q T Qᴴ S⁻¹,    (sI − A)⁻¹ = S Q (sI − T)⁻¹ Qᴴ S⁻¹

with S diagonal (balancing) and Q unitary (Schur), so that nothing is lost where
eigenvectors are nearly alike. The triangular equations are solved for all s together, one
state after the other.
"""

from functools import lru_cache

import numpy as np
from scipy import linalg

__all__ = ["TriangularForm", "triangular_form"]


class TriangularForm:
    """(sI − A)⁻¹ B and C (sI − A)⁻¹ at many points.

    Parameters
    ----------
    A : ndarray, shape (n, n)

    Attributes
    ----------
    poles : complex ndarray, shape (n,)
    """

    def __init__(self, A):
        balanced, (scale, _) = linalg.matrix_balance(A, permute=False, separate=True)
        self._T, Q = linalg.schur(balanced, output="complex")
        self._into, self._out_of = Q.conj().T / scale, scale[:, None] * Q
        self.poles = np.diagonal(self._T)

    def driven(self, B, s):
        """(sI − A)⁻¹ B, shape (n, n_points, m); 0 at s = ∞."""
        drive, decay = self._into @ B, self._decay(s)
        states, flat = _empty(decay, B.shape[1])
        for i in reversed(range(len(decay))):
            from_others = (self._T[i, i + 1 :] @ flat[i + 1 :]).reshape(states[i].shape)
            np.multiply(from_others + drive[i], decay[i][:, None], out=states[i])
        return (self._out_of @ flat).reshape(states.shape)

    def seen(self, C, s):
        """(C (sI − A)⁻¹)ᵀ, shape (n, n_points, l); 0 at s = ∞."""
        sight, decay = (C @ self._out_of).T, self._decay(s)
        states, flat = _empty(decay, len(C))
        for i in range(len(decay)):
            from_others = (self._T[:i, i] @ flat[:i]).reshape(states[i].shape)
            np.multiply(from_others + sight[i], decay[i][:, None], out=states[i])
        return (self._into.T @ flat).reshape(states.shape)

    def _decay(self, s):
        """1 / (s − t) for all poles t, (n, n_points)."""
        finite = np.isfinite(s)
        gaps = s[finite] - self.poles[:, None]
        if not gaps.all():
            raise np.linalg.LinAlgError(
                f"the response at s = {s[finite][~gaps.all(axis=0)][0]:.6g} is infinite: it is a "
                f"pole; choose other points"
            )
        decay = np.zeros((len(self.poles), len(s)), dtype=complex)
        decay[:, finite] = 1.0 / gaps
        return decay


def _empty(decay, n_columns):
    """States (n, n_points, n_columns) to be filled in, and the same as rows."""
    states = np.empty((*decay.shape, n_columns), dtype=complex)
    return states, states.reshape(len(states), decay.shape[1] * n_columns)


def triangular_form(A):
    """The triangular form of A; those of the last few matrices are remembered."""
    return _remembered(np.ascontiguousarray(A, dtype=float).tobytes(), len(A))


@lru_cache(maxsize=8)
def _remembered(entries, n):
    return TriangularForm(np.frombuffer(entries).reshape(n, n))
