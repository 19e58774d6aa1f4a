"""Normal equations of B and D over pieces of one length of an unstable model's records.

Each piece has an initial state of its own, free and not asked for. So the response to an input
may be any that obeys x[k+1] = A x[k] + B u[k]: modes that decay are followed forwards from rest
at the start of a piece, modes that grow backwards from rest at its end. Nothing grows, and sums
of products lose no digits to it.

In coordinates in which A is block diagonal (:mod:`~sklearn_hd.algorithms.response_basis`) a
response is made of q numbers w. With V the w of pulses at both ends, X = [C; C A; …] in bounded
coordinates is linear in V, the equations F of the entries of B and D in the w and u, and

    Σ F'F,  X'F                    follow from Σ w w', Σ w u', Σ V w', …
    Σ F'(I − X (X'X)⁻¹ X') F       is what is left beside the initial states.
"""

import numpy as np
from scipy import linalg
from scipy.sparse.csgraph import connected_components

from sklearn_hd.algorithms.triangular import safe_cholesky

__all__ = ["products_of_pieces"]

EPS = np.finfo(float).eps
LARGEST_CONDITION = 1e5  # of the responses to initial states, brought to equal length


def products_of_pieces(basis, C, pieces, n_inputs, feedthrough):
    """Triangular factor of what pieces of one length say of B and D, where rounding allows it.

    Parameters
    ----------
    basis : ResponseBasis
        Of A.
    C : ndarray, shape (l, n)
    pieces : iterable of ndarray, shapes (n_pieces, L, m + l)
        Inputs and outputs, some pieces at a time.
    n_inputs : int
        The first of the channels, m.
    feedthrough : bool
        Whether D is free.

    Returns
    -------
    R : ndarray, shape (c, c), or None
        Columns: B (row by row), D, and the outputs.
    """
    responses, sums = None, None
    for some in pieces:
        if responses is None:
            responses = _Responses(basis, C, some.shape[1])
            if responses.start is None:
                return None
        own = responses.products(np.ascontiguousarray(some.swapaxes(0, 1)), n_inputs, feedthrough)
        sums = own if sums is None else [a + b for a, b in zip(sums, own, strict=True)]
    G, whole = _equations(responses.seen, *sums[:-1], n_inputs, feedthrough)
    G -= sums[-1]
    left = np.diagonal(G)
    if not np.all(left > 0.0):
        return None
    with np.errstate(over="ignore"):
        rounding = EPS * responses.condition * np.max(whole / left)
    return safe_cholesky(G, rounding)


class _Responses:
    """Responses over a piece of L samples, in numbers w that do not grow.

    Attributes
    ----------
    seen : ndarray, shape (l, n, q)
        Outputs of each w for each entry of a column of B.
    pulses : ndarray, shape (L, q)
        V.
    start : ndarray, shape (l, r, q), or None
        From V'F to Q'F, with Q an orthonormal basis of X; None where that would lose digits.
    condition : float
        Of X.
    """

    def __init__(self, basis, C, length):
        F, g = basis.F, basis.g
        labels = connected_components(F != 0.0)[1]
        sizes = [np.max(np.abs(linalg.eigvals(F[labels == k][:, labels == k]))) for k in labels]
        self.grows = np.array(sizes) > 1.0
        self.step = F[~self.grows][:, ~self.grows], g[~self.grows]
        back = linalg.inv(F[self.grows][:, self.grows])
        self.back = back, back @ g[self.grows]
        self.seen = basis.seen(C)
        self.pulses = np.zeros((length, len(g)))
        ahead, behind = g[~self.grows], self.back[1]
        for k in range(length):
            self.pulses[k, ~self.grows], self.pulses[-1 - k, self.grows] = ahead, behind
            ahead, behind = self.step[0] @ ahead, back @ behind
        X = np.einsum("oiq,kq->koi", self.seen, self.pulses).reshape(-1, len(F))
        size = np.linalg.norm(X, axis=0)
        size[size == 0.0] = 1.0
        values, directions = linalg.svd(X / size, full_matrices=False)[1:]
        self.condition, self.start = values[0] / max(values[-1], EPS), None
        if self.condition <= LARGEST_CONDITION:
            start = directions / values[:, None] / size
            self.start = np.einsum("ri,oiq->orq", start, self.seen)

    def _numbers(self, u):
        """The numbers w of the response to each input, shape (L, n_pieces, m, q)."""
        w = np.zeros((*u.shape, len(self.grows)))
        ahead = np.zeros((*u.shape[1:], int(np.sum(~self.grows))))
        behind = np.zeros((*u.shape[1:], int(np.sum(self.grows))))
        (F, g), (back, g_back) = self.step, self.back
        for k in range(len(u)):
            w[k][..., ~self.grows] = ahead
            ahead = ahead @ F.T + u[k, ..., None] * g
            behind = behind @ back.T - u[-1 - k, ..., None] * g_back
            w[-1 - k][..., self.grows] = behind
        return w

    def products(self, z, m, feedthrough):
        """Σ w w', Σ w z', Σ z z' of some pieces, (L, n_pieces, m + l), and what X takes of F'F."""
        length, count, _ = z.shape
        w, q = self._numbers(z[..., :m]), self.pulses.shape[1]
        wide, flat = w.reshape(length * count, m * q), z.reshape(length * count, -1)
        beside = self.pulses.T @ w.reshape(length, -1)
        beside = (self.start @ beside).reshape(*self.start.shape[:2], count, m, q)  # o r p j s
        of_B = np.einsum("orpjs,ois->prij", beside, self.seen, optimize=True)
        parts = [of_B.reshape(count, of_B.shape[1], -1)]
        ends = self.start @ (self.pulses.T @ z.reshape(length, -1))
        ends = ends.reshape(*self.start.shape[:2], count, -1)  # o r p c
        if feedthrough:
            parts.append(ends[..., :m].transpose(2, 1, 0, 3).reshape(count, of_B.shape[1], -1))
        parts.append(np.einsum("orpo->pr", ends[..., m:])[..., None])
        taken = np.concatenate(parts, axis=-1).reshape(-1, sum(p.shape[-1] for p in parts))
        return wide.T @ wide, wide.T @ flat, flat.T @ flat, taken.T @ taken


def _equations(seen, ww, wz, zz, m, feedthrough):
    """Σ F'F, and its diagonal were there no signs to cancel."""
    n_outputs, n, q = seen.shape
    B, D = n * m, n * m + feedthrough * n_outputs * m
    G = np.zeros((D + 1, D + 1))
    pairs = np.einsum("ois,jskt,oht->ijhk", seen, ww.reshape(m, q, m, q), seen, optimize=True)
    G[:B, :B] = pairs.reshape(B, B)
    shown = np.einsum("ois,jsc->oijc", seen, wz.reshape(m, q, -1))
    G[:B, D] = np.einsum("oijo->ij", shown[..., m:]).reshape(-1)
    G[D, D] = np.trace(zz[m:, m:])
    if feedthrough:
        G[:B, B:D] = shown[..., :m].transpose(1, 2, 0, 3).reshape(B, -1)
        G[B:D, B:D] = np.kron(np.eye(n_outputs), zz[:m, :m])
        G[B:D, D] = zz[:m, m:].T.reshape(-1)
    length = np.sqrt(np.diagonal(ww)).reshape(m, q)
    whole = np.diagonal(G).copy()
    whole[:B] = np.sum((np.abs(seen) @ length.T) ** 2, axis=0).reshape(-1)
    return G, whole
