"""Normal equations of B and D over pieces of one length of an unstable model's records.

Each piece has an initial state of its own, free. So the response to an input may be any that
obeys x[k+1] = A x[k] + B u[k]: modes that decay are followed forwards from rest at the start of
a piece, modes that grow backwards from rest at its end. Nothing grows, and sums of products
lose no digits to it.

In coordinates in which A is block diagonal (:mod:`~.response_basis`) a
response is made of q numbers w. With V the w of pulses at both ends, X = [C; C A; …] in bounded
coordinates is linear in V, the equations F of the entries of B and D in the w and u, and

    Σ F'F,  X'F                    follow from Σ w w', Σ w u', Σ V w', …
    Σ F'(I − X (X'X)⁻¹ X') F       is what is left beside the initial states.

Within a block of T samples everything is linear in a = [w, u_0 … u_{T-1}], w at the block's start
for modes that decay and at its end for those that grow: w_t = M_t a and V_t = P_t V. So only
products of the a of whole blocks are summed. Without noise rounding would show: then what B and
D leave of the outputs takes their place, and gives their correction (Björck, 1987).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.sparse.csgraph import connected_components

from sklearn_hd.algorithms.linalg.triangular import safe_cholesky, triangle
from sklearn_hd.algorithms.subspace.response_basis import pulses, run, split

__all__ = ["TwoSidedFactor", "products_of_pieces", "whole_block"]

EPS = np.finfo(float).eps
LARGEST_CONDITION = 1e5  # of the responses to initial states, brought to equal length
LONGEST_BLOCK = 16  # samples
MANY = 2  # pieces, times inputs, beside samples of one
TWICE = 2  # what initial states take, as Gram and Schmidt
LEAST_NOISE = 1e-3  # of the outputs' size: beside what it does, rounding is nothing


@dataclass(frozen=True, eq=False)
class TwoSidedFactor:
    """What pieces of one length say of B and D, and then of their initial states.

    Attributes
    ----------
    R : ndarray, shape (c, c)
        Upper triangular; columns: B (row by row), D, and the outputs.
    responses : object
    """

    R: np.ndarray
    responses: object

    def initial_state(self, u, y, B, D):
        """Least-squares initial state of one piece beside some B and D.

        Parameters
        ----------
        u, y : ndarray, shapes (L, m), (L, l)
        B, D : ndarray, shapes (n, m), (l, m)

        Returns
        -------
        x0 : ndarray, shape (n,)
        """
        return self.responses.initial_state(u, y, B, D)


def whole_block(length):
    """Samples in a block, of which a piece of some length is made of whole ones."""
    return next(T for T in range(LONGEST_BLOCK, 0, -1) if length % T == 0)


def products_of_pieces(basis, C, pieces, n_inputs, feedthrough):
    """Triangular factor of what pieces of one length say of B and D, where rounding allows it.

    Parameters
    ----------
    basis : ResponseBasis
        Of A.
    C : ndarray, shape (l, n)
    pieces : callable
        Gives an iterator over arrays, shapes (n_pieces, L, m + l): inputs and outputs, some
        pieces at a time.
    n_inputs : int
        The first of the channels, m.
    feedthrough : bool
        Whether D is free.

    Returns
    -------
    factor : TwoSidedFactor or None
    """
    responses = _Responses(basis, C, next(pieces()).shape[1])
    if responses.start is None:
        return None
    G, rounding, squares = _summed(responses, pieces(), n_inputs, feedthrough)
    own = safe_cholesky(G[:-1, :-1], rounding)
    if own is None:
        return None
    turned, rest = _solved(own, G)
    if not rest > LEAST_NOISE**2 * squares:
        theta = linalg.solve_triangular(own, turned)
        B, D = split(theta, C.shape[1], n_inputs, len(C))
        left = (responses.left(some, B, D) for some in pieces())
        G, *_ = _summed(responses, left, n_inputs, feedthrough)
        change, rest = _solved(own, G)
        turned = turned + change
    last = np.sqrt(max(rest, 0.0))
    R = np.block([[own, turned[:, None]], [np.zeros((1, len(own))), last]])
    return TwoSidedFactor(R, responses)


def _summed(responses, pieces, n_inputs, feedthrough):
    """Normal equations, the outputs last, what rounding may do to them, and Σ y'y."""
    sums = None
    for some in pieces:
        own = responses.products(some, n_inputs, feedthrough)
        sums = own if sums is None else [a + b for a, b in zip(sums, own, strict=True)]
    G, whole = _equations(responses.seen, *sums[:-1], n_inputs, feedthrough)
    G -= sums[-1]
    left = np.diagonal(G)[:-1]
    if not np.all(left > 0.0):
        return G, np.inf, whole[-1]
    with np.errstate(over="ignore"):
        rounding = EPS * responses.condition * np.max(whole[:-1] / left)
    return G, rounding, whole[-1]


def _solved(own, G):
    """The outputs' column of the factor, and the sum of squares left."""
    turned = linalg.solve_triangular(own, G[:-1, -1], trans=1)
    return turned, G[-1, -1] - turned @ turned


class _Responses:
    """Responses over a piece of L samples, in numbers w that do not grow.

    Attributes
    ----------
    seen : ndarray, shape (l, n, q)
        Outputs of each w for each entry of a column of B.
    pulses : ndarray, shape (L, q)
        V.
    block : int
        T.
    maps : ndarray, shape (T, q, q + T)
        M_t; its first q columns are P_t.
    start : ndarray, shape (l, r, q), or None
        From V'F to Q'F, with Q an orthonormal basis of X; None where that would lose digits.
    condition : float
        Of X.
    inverse : ndarray, shape (r, n)
        From Q'y to the coordinates of X.
    free : ndarray, shape (L l, n)
        X.
    """

    def __init__(self, basis, C, length):
        F, g, q = basis.F, basis.g, len(basis.g)
        labels = connected_components(F != 0.0)[1]
        self.modes = [np.flatnonzero(labels == k) for k in range(labels.max() + 1)]
        grows = [np.max(np.abs(linalg.eigvals(F[np.ix_(k, k)]))) > 1.0 for k in self.modes]
        self.grows = np.array(grows)[labels]
        self.ahead, self.back = np.where(self.grows, 0.0, F), np.zeros((q, q))
        growing = np.ix_(self.grows, self.grows)
        self.back[growing] = linalg.inv(F[growing])
        self.pulse = np.where(self.grows, 0.0, g), np.where(self.grows, g, 0.0)
        self.seen, self.units = basis.seen(C), basis.units
        self.block = whole_block(length)
        forward, backward = self._pulses(length)
        self.pulses = forward + backward[::-1]
        self.of_blocks = forward[:: self.block] + self._ends(length)
        self.maps = self._maps()
        self._set_start(np.einsum("oiq,kq->koi", self.seen, self.pulses).reshape(-1, q))

    def _pulses(self, count):
        """F^k g of what decays, and F^{-k-1} g of what grows, k = 0, 1, …"""
        return pulses(self.ahead, self.pulse[0], count), pulses(
            self.back, self.back @ self.pulse[1], count
        )

    def _ends(self, length):
        """V of what grows, at the end of each block."""
        step = np.linalg.matrix_power(self.back, self.block)
        return pulses(step, self.pulse[1], length // self.block)[::-1]

    def _maps(self):
        T, q = self.block, len(self.grows)
        maps = np.zeros((T, q, q + T))
        ahead, behind = np.diag(1.0 - self.grows), self.back
        forward, backward = self._pulses(T)
        for t in range(T):
            maps[t, :, :q] += ahead
            maps[T - 1 - t, :, :q] += behind
            maps[t, :, q : q + t] = forward[:t][::-1].T
            maps[t, :, q + t :] -= backward[: T - t].T
            ahead, behind = self.ahead @ ahead, self.back @ behind
        return maps

    def _set_start(self, X):
        self.free, size = X, np.linalg.norm(X, axis=0)
        size[size == 0.0] = 1.0
        values, directions = linalg.svd(triangle(X / size))[1:]
        self.condition, self.start = values[0] / max(values[-1], EPS), None
        if self.condition <= LARGEST_CONDITION:
            self.inverse = directions / values[:, None] / size
            self.start = np.einsum("ri,oiq->orq", self.inverse, self.seen)

    def _numbers(self, u):
        """The numbers a of each block and input, shape (n_blocks, n_pieces, m, q + T)."""
        T, q = self.block, len(self.grows)
        count, length, m = u.shape
        inputs = u.reshape(count, -1, T, m).transpose(1, 0, 3, 2).reshape(-1, T)
        forward, backward = self._pulses(T)
        w = inputs @ (forward[::-1] - backward)
        w = w.reshape(length // T, count * m, q)
        w[..., self.grows] = w[::-1][..., self.grows]
        step = np.linalg.matrix_power(self.ahead, T) + np.linalg.matrix_power(self.back, T)
        run(step, w, np.zeros(w.shape[1:]))
        w[..., self.grows] = w[::-1][..., self.grows]
        a = np.concatenate([w.reshape(len(inputs), q), inputs], axis=1)
        return a.reshape(len(w), count, m, q + T)

    def products(self, z, m, feedthrough):
        """Σ w w', Σ w z', Σ z z' of some pieces, (n_pieces, L, m + l), and what X takes of F'F."""
        (count, length, p), (T, q, _) = z.shape, self.maps.shape
        a, flat = self._numbers(z[..., :m]), z.reshape(count * length, p)
        own = a.reshape(-1, m * (q + T))
        channels = z.reshape(count, -1, T * p).swapaxes(0, 1).reshape(len(own), -1)
        wz = (own.T @ channels).reshape(m, q + T, T, p)
        wz = np.einsum("tqe,cetz->cqz", self.maps, wz, optimize=True)
        taken = self._taken(a, z, feedthrough)
        return self._squares(own.T @ own, m), wz.reshape(m * q, p), flat.T @ flat, taken.T @ taken

    def _squares(self, squares, m):
        """Σ w w' from Σ a a'."""
        T, q, width = self.maps.shape
        squares = squares.reshape(m, width, m, width).transpose(0, 2, 1, 3)
        left = self.maps.reshape(T * q, width) @ squares
        left = left.reshape(m, m, T, q, width).transpose(0, 1, 3, 2, 4).reshape(m, m, q, -1)
        found = left @ self.maps.transpose(0, 2, 1).reshape(T * width, q)
        return found.transpose(0, 2, 1, 3).reshape(m * q, m * q)

    def _taken(self, a, z, feedthrough):
        """Q'F, and Q' of the outputs, of each piece, one below the other."""
        _, count, m, _ = a.shape
        if count * m > MANY * z.shape[1]:
            inputs = np.ascontiguousarray(z[..., :m].swapaxes(1, 2)).reshape(count * m, -1)
            of_B = (inputs @ self._of_samples).reshape(count, m, -1, self.seen.shape[1])
            of_B = of_B.transpose(0, 2, 3, 1)
        else:
            of_B = self._of_B(a)
        r = of_B.shape[1]
        parts = [of_B.reshape(count, r, -1)]
        ends = np.tensordot(self.start, self.pulses.T @ z, ((2,), (1,)))  # o r p c
        if feedthrough:
            parts.append(ends[..., :m].transpose(2, 1, 0, 3).reshape(count, r, -1))
        parts.append(np.einsum("orpo->pr", ends[..., m:])[..., None])
        return np.concatenate(parts, axis=-1).reshape(count * r, -1)

    def _of_B(self, a):
        """Q'F of the entries of B, for each piece, shape (n_pieces, r, n, m)."""
        n_blocks, count, m, width = a.shape
        q = len(self.grows)
        beside = np.empty((q, count, m, q))  # V'w
        numbers = (self.of_blocks.T @ a.reshape(n_blocks, -1)).reshape(q, count * m, width)
        for mode in self.modes:
            own = self.maps[:, mode[:, None], mode]
            K = np.einsum("tia,tse->aeis", own, self.maps, optimize=True)
            parts = numbers[mode].transpose(1, 0, 2).reshape(count * m, -1)
            parts = parts @ K.reshape(parts.shape[1], -1)
            beside[mode] = parts.reshape(count, m, len(mode), q).transpose(2, 0, 1, 3)
        beside = self.start @ beside.reshape(q, -1)
        beside = beside.reshape(*self.start.shape[:2], count, m, q)  # o r p j s
        return np.einsum("orpjs,ois->prij", beside, self.seen, optimize=True)

    @cached_property
    def _of_samples(self):
        """The same for a single input that is one at one sample, shape (L, r n)."""
        length = len(self.pulses)
        return self._of_B(self._numbers(np.eye(length)[..., None])).reshape(length, -1)

    def left(self, z, B, D):
        """Pieces whose outputs are what B, D and their best initial states leave of them."""
        left, _, _ = self._fitted(z, B, D)
        return np.concatenate([z[..., : B.shape[1]], left], axis=-1)

    def initial_state(self, u, y, B, D):
        """The initial state of one piece."""
        _, starts, a = self._fitted(np.hstack([u, y])[None], B, D)
        first = a[0, 0] @ self.maps[0].T  # w of each input
        x0 = np.einsum("s,sij,j->i", self.pulses[0], self.units, starts[0], optimize=True)
        return x0 + np.einsum("js,sil,lj->i", first, self.units, B, optimize=True)

    def _fitted(self, z, B, D):
        """What is left of the outputs, what X took of it, and the numbers a."""
        m, count, (T, _, width) = B.shape[1], len(z), self.maps.shape
        u, y = z[..., :m], z[..., m:]
        a = self._numbers(u)
        answers = np.einsum("tse,ois,ij->jeto", self.maps, self.seen, B, optimize=True)
        forced = a.reshape(-1, m * width) @ answers.reshape(m * width, -1)
        forced = forced.reshape(len(a), count, T, -1).swapaxes(0, 1).reshape(y.shape)
        left, starts = y - forced - u @ D.T, 0.0
        for _ in range(TWICE):
            taken = np.tensordot(self.pulses.T @ left, self.start, ((1, 2), (2, 0)))  # Q'
            taken = taken @ self.inverse
            left -= (taken @ self.free.T).reshape(left.shape)
            starts = starts + taken
        return left, starts, a


def _equations(seen, ww, wz, zz, m, feedthrough):
    """Σ F'F, and its diagonal were there no signs to cancel."""
    n_outputs, n, q = seen.shape
    B, D = n * m, n * m + feedthrough * n_outputs * m
    G = np.zeros((D + 1, D + 1))
    pairs = seen[:, None, None] @ ww.reshape(m, q, m, q).transpose(0, 2, 1, 3)  # o j k i t
    pairs = np.sum(pairs @ seen.transpose(0, 2, 1)[:, None, None], axis=0)
    G[:B, :B] = pairs.transpose(2, 0, 3, 1).reshape(B, B)
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
