"""States of a linear model at many points s, from one triangular form of A.

    A = S Q T Qᴴ S⁻¹,    (sI − A)⁻¹ = S Q (sI − T)⁻¹ Qᴴ S⁻¹

with S diagonal (balancing) and Q unitary (Schur), so that nothing is lost where
eigenvectors are nearly alike. The triangular equations are solved for all s together, one
state after the other.

Rounding of the form is that of its largest entries. Where states answer so strongly that it
would be seen (a pole on its way to infinity, slow ones that hang on it), what is left of the
equations in A itself corrects them, as in iterative refinement (Skeel, 1980).
Matches of structured models need it.
"""

from functools import lru_cache

import numpy as np
from scipy import linalg


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
        self._A = A
        balanced, (scale, _) = linalg.matrix_balance(A, permute=False, separate=True)
        self._T, Q = linalg.schur(balanced, output="complex")
        self._into, self._out_of = Q.conj().T / scale, scale[:, None] * Q
        self._rounding = np.finfo(float).eps * linalg.norm(self._T)
        self.poles = np.diagonal(self._T)

    def driven(self, B, s):
        """(sI − A)⁻¹ B, shape (n, n_points, m); 0 at s = ∞."""
        return self._answers(B, s, self._A, self._into, self._out_of, self._upwards)

    def seen(self, C, s):
        """(C (sI − A)⁻¹)ᵀ, shape (n, n_points, l); 0 at s = ∞."""
        return self._answers(C.T, s, self._A.T, self._out_of.T, self._into.T, self._downwards)

    def _answers(self, forces, s, A, into, out_of, solve):
        """States x of s x = A x + forces."""
        decay, drive = self._decay(s), into @ forces
        shape = len(A), len(s), forces.shape[1]
        states = solve(drive[:, None], decay, shape)
        answers = (out_of @ states.reshape(shape[0], shape[1] * shape[2])).reshape(shape)
        growth = self._rounding * _largest_ratio(states, drive)
        error, finite = growth, np.where(np.isfinite(s), s, 0.0)[:, None]  # elsewhere decay is 0
        for _ in range(3):
            if not 1e-10 < error < 1.0:  # unseen, or corrections may not shrink
                break
            left = forces[:, None] - finite * answers + np.tensordot(A, answers, 1)
            states = solve(np.tensordot(into, left, 1), decay, shape)
            answers += np.tensordot(out_of, states, 1)
            error *= growth
        return answers

    def _upwards(self, drive, decay, shape):
        """(sI − T)⁻¹ drive, from the last state to the first."""
        states = np.empty(shape, dtype=complex)
        flat = states.reshape(shape[0], shape[1] * shape[2])
        for i in reversed(range(len(decay))):
            from_others = (self._T[i, i + 1 :] @ flat[i + 1 :]).reshape(shape[1:])
            np.multiply(from_others + drive[i], decay[i][:, None], out=states[i])
        return states

    def _downwards(self, drive, decay, shape):
        """(sI − Tᵀ)⁻¹ drive, from the first state to the last."""
        states = np.empty(shape, dtype=complex)
        flat = states.reshape(shape[0], shape[1] * shape[2])
        for i in range(len(decay)):
            from_others = (self._T[:i, i] @ flat[:i]).reshape(shape[1:])
            np.multiply(from_others + drive[i], decay[i][:, None], out=states[i])
        return states

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


def _largest_ratio(states, drive):
    """How strongly states answer at most, force by force."""
    strongest = np.max(np.abs(states), axis=(0, 1), initial=0.0)
    most = np.max(np.abs(drive), axis=0, initial=0.0)
    return np.max(strongest / np.where(most > 0.0, most, np.inf), initial=0.0)


def triangular_form(A):
    """The triangular form of A; those of the last few matrices are remembered."""
    return _remembered(np.ascontiguousarray(A, dtype=float).tobytes(), len(A))


@lru_cache(maxsize=8)
def _remembered(entries, n):
    return TriangularForm(np.frombuffer(entries).reshape(n, n))
