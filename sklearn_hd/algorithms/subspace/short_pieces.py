"""Equations for B and D of many short pieces of records, each with an initial state of its own.

Pieces of L samples share the responses X = [C; C A; …; C A^{L-1}] to their initial states, and
are linear in the samples z = [u_0 … u_{L-1}, y_0 … y_{L-1}] of a piece: F(z) of the entries of B
and D, and the outputs. So

- initial states go by one projection for all, I − Q Qᵀ, with Q an orthonormal basis of X;
- more pieces than entries of z are compressed by orthogonal transformations into the triangular
  factor of their z, whose rows are as good as pieces.
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import triangle

__all__ = ["equations_of_pieces", "is_short"]

EPS = np.finfo(float).eps
RESPONSE_BYTES = 2**24  # of all responses of a piece: longer ones gain nothing
ROUND_BYTES = 2**25  # of equations at a time


def is_short(length, n_states, n_outputs):
    """Whether pieces of some length are found together faster than one by one."""
    return 8 * length**2 * n_outputs * n_states <= RESPONSE_BYTES


def equations_of_pieces(A, C, pieces, n_inputs, feedthrough):
    """Triangular factor of what pieces of one length say of B and D.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    pieces : iterable of ndarray, shapes (n_pieces, L, m + l)
        Inputs and outputs, some pieces at a time.
    n_inputs : int
        The first of the channels, m.
    feedthrough : bool
        Whether D is free.

    Returns
    -------
    R : ndarray, shape (c, n m [+ l m] + 1)
        Columns: B (row by row), D, and the outputs.
    """
    Z, shared, responses = None, None, None
    for some in pieces:
        flat = some.reshape(len(some), -1)
        Z = flat if Z is None else np.concatenate([Z, flat])
        if len(Z) > Z.shape[1]:
            Z = triangle(Z)
    Z = Z.reshape(len(Z), -1, n_inputs + len(C))
    responses = _Responses(A, C, Z.shape[1], n_inputs, feedthrough)
    shared = np.zeros((0, responses.width))
    at_a_time = max(1, ROUND_BYTES // (8 * Z.shape[1] * len(C) * responses.width))
    for start in range(0, len(Z), at_a_time):
        shared = triangle(shared, responses.equations(Z[start : start + at_a_time]))
    return shared


class _Responses:
    """What pieces of L samples answer, to each entry of B and D, and beside what."""

    def __init__(self, A, C, length, n_inputs, feedthrough):
        n, n_outputs = len(A), len(C)
        self.m, self.feedthrough = n_inputs, feedthrough
        self.width = n_inputs * (n + feedthrough * n_outputs) + 1
        free = np.empty((length, n_outputs, n))
        free[0] = C
        for k in range(1, length):
            free[k] = free[k - 1] @ A
        self.start = _basis(free.reshape(-1, n))
        self.forced = np.zeros((length, n_outputs, n, length))  # by each earlier sample
        for k in range(length - 1):
            self.forced[k + 1 :, ..., k] = free[: length - 1 - k]

    def equations(self, Z):
        """Equations of some pieces, one below the other, their initial states projected out."""
        count, length = Z.shape[:2]
        u, y, n_outputs = Z[..., : self.m], Z[..., self.m :], Z.shape[-1] - self.m
        n = self.forced.shape[2]
        found = np.empty((count, length * n_outputs, self.width))
        wide = u.transpose(1, 0, 2).reshape(length, -1)
        forced = self.forced.reshape(-1, length) @ wide
        forced = forced.reshape(length * n_outputs, n, count, self.m)
        found[..., : n * self.m] = forced.transpose(2, 0, 1, 3).reshape(count, -1, n * self.m)
        if self.feedthrough:
            direct = np.einsum("ab,ptk->ptbak", np.eye(n_outputs), u)
            found[..., n * self.m : -1] = direct.reshape(count, length * n_outputs, -1)
        found[..., -1] = y.reshape(count, -1)
        found -= self.start @ (self.start.T @ found)
        return found.reshape(-1, self.width)


def _basis(X):
    """Orthonormal columns that span those of X, brought to equal length."""
    size = np.linalg.norm(X, axis=0)
    size[size == 0.0] = 1.0
    U, values, _ = linalg.svd(X / size, full_matrices=False)
    return U[:, : int(np.sum(values > EPS * X.shape[1] * np.max(values, initial=0.0)))]
