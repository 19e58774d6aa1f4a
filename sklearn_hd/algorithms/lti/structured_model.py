"""State-space models whose entries are affine in a vector of parameters.

    [A B; C D](θ) = S₀ + Σ_k θ_k S_k

Response and sensitivity follow from two factors alone (s not an eigenvalue of A):

    L(s) = [C (sI − A)⁻¹, I],   R(s) = [(sI − A)⁻¹ B; I],   K(s) = [(sI − A)⁻¹ 0; 0 0]
    G = C (sI − A)⁻¹ B + D,     ∂G/∂θ_k = L S_k R
    ∂²G/∂θ_j∂θ_k = L (S_j K S_k + S_k K S_j) R

Both come at many points s from one triangular form of A, so that nothing is lost where
eigenvectors are nearly alike,

    A = S Q T Qᴴ S⁻¹,    (sI − A)⁻¹ = S Q (sI − T)⁻¹ Qᴴ S⁻¹

with S diagonal (balancing) and Q unitary (Schur). The triangular equations are solved for all s
together, one state after the other. Rounding of the form is that of its largest entries. Where
states answer so strongly that it would be seen (a pole on its way to infinity, slow ones that hang
on it), what is left of the equations in A itself corrects them, as in iterative refinement
(Skeel, 1980). Matches of structured models need it.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EPS
from sklearn_hd.algorithms.linalg.triangular import solve_within_rank
from sklearn_hd.algorithms.signals.fourier import AT_ONCE


class Sizes:
    """Numbers of parameters, inputs and outputs of a structure [A B; C D]."""

    @property
    def n_parameters(self):
        return len(self.parameter_names)

    @property
    def n_inputs(self):
        return self.constant.shape[-1] - self.n_states

    @property
    def n_outputs(self):
        return self.constant.shape[-2] - self.n_states


@dataclass(frozen=True, eq=False)
class AffineStructure(Sizes):
    """State-space model with entries affine in its parameters.

    ``constant`` is S₀, (n + l, n + m), and ``basis`` stacks the S_k, (k, n + l, n + m).
    ``n_states`` is n, which says where [A B; C D] is divided.

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

    def matrices(self, theta):
        """(A, B, C, D) at the parameters θ, shape (k,)."""
        stacked = self.constant + np.tensordot(np.asarray(theta, float), self.basis, 1)
        return parts_of(stacked, self.n_states)

    def project(self, stacked, weights=None):
        """Parameters of the structured matrix nearest to a given one, and the rest.

        ``stacked`` is [A B; C D]. ``weights``, of the same shape, are positive weights
        of its entries in the sum of squares, 1 by default. Returns (theta, residual):
        the smallest θ where several are equally near, and the weighted difference left.
        """
        weights = np.ones_like(self.constant) if weights is None else weights
        columns = (weights * self.basis).reshape(self.n_parameters, -1).T
        gap = weights * (stacked - self.constant)
        theta = solve_within_rank(columns, gap.ravel(), cond=EPS)
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

        ``left_vectors`` are p_ij, (n_points, n_vectors, l), and ``right_vectors`` v_ij,
        (n_points, n_vectors, m); one a point may come without their second axis. At
        infinity, G is affine.
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
        size = max(1, AT_ONCE // max(half.size, 1))
        for here in (slice(k, k + size) for k in range(0, len(s), size)):
            K = np.linalg.inv(s[here, None, None] * np.eye(n) - matrices[0])
            half += np.sum((before[here].swapaxes(1, 2) @ after[here]) * K[places], axis=0).real
        half = rates[first].T @ half @ rates[second]
        return half + half.T


def parts_of(M, n):
    """A, B, C and D of [A B; C D] with n states, or F, G, P and Q."""
    return M[..., :n, :n], M[..., :n, n:], M[..., n:, :n], M[..., n:, n:]


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


class TriangularForm:
    """(sI − A)⁻¹ B and C (sI − A)⁻¹ at many points."""

    def __init__(self, A):
        self._A = A
        balanced, (scale, _) = linalg.matrix_balance(A, permute=False, separate=True)
        self._T, Q = linalg.schur(balanced, output="complex")
        self._into, self._out_of = Q.conj().T / scale, scale[:, None] * Q
        self._rounding = np.finfo(float).eps * linalg.norm(self._T)
        self.poles = np.diagonal(self._T)

    def driven(self, B, s):
        """(sI − A)⁻¹ B, shape (n, n_points, m); 0 at s = ∞."""
        return self._answers(B, s, self._A, self._into, self._out_of, True)

    def seen(self, C, s):
        """(C (sI − A)⁻¹)ᵀ, shape (n, n_points, l); 0 at s = ∞."""
        return self._answers(C.T, s, self._A.T, self._out_of.T, self._into.T, False)

    def _answers(self, forces, s, A, into, out_of, upwards):
        """States x of s x = A x + forces."""
        decay, drive = self._decay(s), into @ forces
        shape = len(A), len(s), forces.shape[1]
        states = self._solved(drive[:, None], decay, shape, upwards)
        answers = (out_of @ states.reshape(shape[0], shape[1] * shape[2])).reshape(shape)
        growth = self._rounding * _largest_ratio(states, drive)
        error, finite = growth, np.where(np.isfinite(s), s, 0.0)[:, None]  # elsewhere decay is 0
        for _ in range(3):
            if not 1e-10 < error < 1.0:  # unseen, or corrections may not shrink
                break
            left = forces[:, None] - finite * answers + np.tensordot(A, answers, 1)
            states = self._solved(np.tensordot(into, left, 1), decay, shape, upwards)
            answers += np.tensordot(out_of, states, 1)
            error *= growth
        return answers

    def _solved(self, drive, decay, shape, upwards):
        """(sI − T)⁻¹ drive, from the last state to the first; (sI − Tᵀ)⁻¹ drive from the first."""
        states, T = np.empty(shape, dtype=complex), self._T
        flat = states.reshape(shape[0], shape[1] * shape[2])
        for i in reversed(range(len(T))) if upwards else range(len(T)):
            from_others = T[i, i + 1 :] @ flat[i + 1 :] if upwards else T[:i, i] @ flat[:i]
            forces = from_others.reshape(shape[1:]) + drive[i]
            np.multiply(forces, decay[i][:, None], out=states[i])
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
