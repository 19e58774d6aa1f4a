"""Local coordinates of the A and C of linear models: what moves their predictions, and no more.

Similarities leave predictions alone. With the one that makes the columns of [A/ρ; C] orthonormal,
l n parameters X remain of the (n + l) n entries,

    [A/ρ; C] = (Q + Q⊥ X) (I + XᵀX)^{-1/2},     Q the present one,   QᵀQ⊥ = 0,

and each of them moves the predictions (output-normal form; ρ = 1 in the first reference).
Eigenvalues stay within the unit circle.

References: J. Bruls, C. T. Chou, B. R. J. Haverkamp, M. Verhaegen, "Linear and non-linear system
identification using separable least squares", European Journal of Control 5 (1999); T. McKelvey,
A. Helmersson, T. Ribarits, "Data driven local coordinates for multivariable linear systems and
their application to system identification", Automatica 40 (2004).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EPS, HALF

RHO = 1.01  # more than one: modes that do not decay have coordinates, too


@dataclass(frozen=True, eq=False)
class OutputNormal:
    """Time-invariant models about one.

    Attributes
    ----------
    frame : ndarray, shape (n + l, n)
        [A/ρ; C], its columns orthonormal.
    across : ndarray, shape (n + l, l)
        Orthonormal to it.
    """

    frame: np.ndarray
    across: np.ndarray

    @classmethod
    def of(cls, A, C):
        """From any A and C; an A that is not stable is moved to the unit circle."""
        frame = _normal(_within_circle(A)[0], C)
        return cls(frame, linalg.svd(frame)[0][:, len(A) :])

    @property
    def size(self):
        return np.array([RHO] * self.frame.shape[1] + [1.0] * self.across.shape[1])[:, None]

    @property
    def columns(self):
        """[A; C], shape (1, n + l, n)."""
        return (self.size * self.frame)[None]

    @property
    def tangents(self):
        """What one unit of each parameter adds to the columns, shape (k, 1, n + l, n)."""
        n = self.frame.shape[1]
        across = self.size * self.across
        return np.einsum("ia,jb->abij", across, np.eye(n)).reshape(-1, 1, *self.frame.shape)

    @property
    def walls(self):
        """Slopes of the sizes of the eigenvalues that lie on the unit circle, (n_walls, k)."""
        n = self.frame.shape[1]
        values, left, right = linalg.eig(RHO * self.frame[:n], left=True)
        there = (np.abs(values) > 1.0 - HALF) & (values.imag >= 0.0)
        left, right, values = left[:, there], right[:, there], values[there]
        slopes = np.einsum("ie,kij,je->ek", left.conj(), self.tangents[:, 0, :n], right)
        return (slopes * (values.conj() / np.sum(left.conj() * right, axis=0))[:, None]).real

    def moved(self, step):
        """Those about the one at some parameters."""
        n = self.frame.shape[1]
        frame = _orthonormal(self.frame + self.across @ step.reshape(-1, n))
        A, clipped = _within_circle(RHO * frame[:n])
        frame = _normal(A, frame[n:]) if clipped else frame
        return replace(
            self, frame=frame, across=_orthonormal(self.across - frame @ (frame.T @ self.across))
        )

    def about(self, random):
        """Those at random at about distance one."""
        size = self.frame.shape[1] * self.across.shape[1]
        return self.moved(random.standard_normal(size) / np.sqrt(size))

    def anywhere(self, n_samples, slow, random):
        """Those at random: any frame, or modes that last, and turn once in, up to n_samples."""
        n, n_outputs = self.frame.shape[1], self.across.shape[1]
        if not slow:
            frame = _orthonormal(random.standard_normal(self.frame.shape))
            return self.of(frame[:n], frame[n:])
        A = np.zeros((n, n))
        for i in range(0, n, 2):
            last, turn = n_samples ** random.random(2)
            a, b = np.exp(-1.0 / last) * np.array([np.cos(np.pi / turn), np.sin(np.pi / turn)])
            A[i : i + 2, i : i + 2] = np.array([[a, b], [-b, a]])[: n - i, : n - i]
        return self.of(A, random.standard_normal((n_outputs, n)))


@dataclass(frozen=True, eq=False)
class AllEntries:
    """Periodic models about one.

    Attributes
    ----------
    columns : ndarray, shape (2 H + 1, n + l, n)
        Fourier coefficients of [A; C].
    """

    columns: np.ndarray

    @property
    def tangents(self):
        return np.eye(self.columns.size).reshape(-1, *self.columns.shape)


def _normal(A, C):
    """Orthonormal [A/ρ; C] of the same model, its states changed as little as may be."""
    P = linalg.solve_discrete_lyapunov(A.T / RHO, C.T @ C)
    values, vectors = linalg.eigh(0.5 * (P + P.T))
    root = np.sqrt(np.maximum(values, EPS * values[-1]))
    T, back = (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
    return _orthonormal(np.vstack([T @ A @ back / RHO, C @ back]))


def _orthonormal(columns):
    left, _, right = linalg.svd(columns, full_matrices=False)
    return left @ right


def _within_circle(A):
    """A with the eigenvalues beyond the unit circle moved to it, and whether there are any."""
    values, vectors = np.linalg.eig(A)
    size = np.abs(values)
    if not np.max(size, initial=0.0) > 1.0:
        return A, False
    moved = vectors * (values / np.maximum(size, 1.0))
    return np.linalg.solve(vectors.T, moved.T).T.real, True
