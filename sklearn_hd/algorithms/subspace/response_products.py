"""Normal equations of B, D and the initial state from products of the data with responses.

In coordinates in which the observability Gramian is the identity, A'A + C'C = 1 (primes
transpose), sums over the responses Ξ_k = Σ_{t<k} A^{k-1-t} u_t telescope: with

    S(u, z) = Σ_k Ξ_k z_k,     H(z) = Σ_k A^k z_k,     P = A^N

for a record of N samples, one input u or v and one signal z (an input or an output)

    Σ_k Ξ_k' C'C Ξ_k     = A S(u, v) + (A S(v, u))' + Σ_k u_k v_k − Ξ_N' Ξ_N
    Σ_k A^k' C'C Ξ_k     = (A H(u))' − P' Ξ_N
    Σ_k A^k' C'C A^k     = 1 − P'P

and the products with D's inputs and with the outputs are C S and C H. So all that the
equations need of the data are S and H: no more than the products of each signal with the
numbers w that responses are made of (:mod:`~sklearn_hd.algorithms.subspace.block_responses`).
"""

import functools
from dataclasses import dataclass

import numpy as np
import slycot
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import safe_cholesky, triangle
from sklearn_hd.algorithms.subspace.response_basis import response_basis, run

__all__ = ["OutputNormal", "output_normal", "products_factor"]

EPS = np.finfo(float).eps
MOST_RADIUS = 1.0 - 1e-6
LARGEST_CONDITION = 1e5
BLOCKS = (1, 2, 4, 8, 12, 16, 24, 32)  # samples
ROUND = 2**16  # samples, multiplied together
NEARLY = 1e-6  # the identity, before the last step towards it
PULSE_OVER = 1e-18
LESS_STEPS = 4  # of the recursion, one by one, than stretches
STEP_WORK = 20  # of a small product in the recursion, beside that of large ones


@dataclass(frozen=True)
class OutputNormal:
    """A model in coordinates T x, in which its observability Gramian is the identity.

    Attributes
    ----------
    A, C : ndarray, shapes (n, n), (l, n)
    T : ndarray, shape (n, n)
        Upper triangular.
    basis : ResponseBasis
        Of A.
    error : float
        By which A'A + C'C is off the identity, as it grows over the memory of A.
    """

    A: np.ndarray
    C: np.ndarray
    T: np.ndarray
    basis: object
    error: float


def output_normal(A, C, radius=None):
    """Output-normal coordinates of a stable model.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    radius : float, optional
        Size of the largest eigenvalue, where it is known.

    Returns
    -------
    model : OutputNormal or None
        None where there are none, or none of good condition.
    """
    n = len(A)
    if n == 0:
        return None
    one = np.eye(n)
    radius = np.max(np.abs(np.linalg.eigvals(A))) if radius is None else radius
    if radius > MOST_RADIUS:
        return None
    shown, padded = C if len(C) <= n else triangle(C), np.zeros((n, n))
    padded[: len(shown)] = shown
    T, scale, _ = slycot.sb03od(n, len(shown), A.copy(), one.copy(), padded, "D")
    T = np.triu(T) / scale
    size = np.abs(np.diagonal(T))
    if not size.min() > size.max() / LARGEST_CONDITION:
        return None
    shown = linalg.lapack.dtrtrs(T, np.vstack([T @ A, C]).T, trans=1)[0].T
    gramian = shown.T @ shown
    if not np.linalg.norm(gramian - one) < NEARLY:
        return None
    shown = shown @ (1.5 * one - 0.5 * gramian)  # columns orthonormal to the last digits
    basis = response_basis(shown[:n])
    if basis is None:
        return None
    off = np.linalg.norm(shown.T @ shown - one)
    error = (n * EPS + off) / (1.0 - radius**2)
    return OutputNormal(shown[:n], shown[n:], T, basis, error)


def products_factor(model, u, y, feedthrough, scales):
    """Triangular factor of the equations of one record, where rounding allows it.

    Parameters
    ----------
    model : OutputNormal
    u, y : ndarray, shapes (n_samples, m), (n_samples, l)
    feedthrough : bool
        Whether D is free.
    scales : tuple of ndarray, shapes (m,), (l,)
        What inputs and outputs are divided by.

    Returns
    -------
    R : ndarray, shape (c, c), or None
        Columns: the initial state, B (row by row), D, and the outputs. None where sums in
        double have lost what R should say.
    """
    G, loss = normal_equations(model, response_products(model.basis, u, y, scales), feedthrough)
    R = safe_cholesky(G, loss) if np.isfinite(loss) else None
    if R is None:
        return None
    n, m = len(model.A), u.shape[1]
    R[:, :n] = R[:, :n] @ model.T
    forced = R[:, n : n + n * m].reshape(len(R), n, m)
    R[:, n : n + n * m] = (model.T.T @ forced).reshape(len(R), n * m)
    return R


# ---- products with the data ----------------------------------------------------------------


@dataclass(frozen=True)
class ResponseProducts:
    """What normal equations need of a record with m inputs and p signals, inputs first.

    Attributes
    ----------
    forced : ndarray, shape (m, q, p)
        Σ_k w_k z_k, w those of the response to an input.
    free : ndarray, shape (q, p)
        Σ_k w_k z_k, w those of a pulse before the record.
    last : ndarray, shape (m, q)
        w_N of the responses to inputs.
    inputs : ndarray, shape (m, p)
        Σ_k u_k z_k'.
    outputs : float
        Σ_k y_k' y_k.
    n_samples : int
    """

    forced: np.ndarray
    free: np.ndarray
    last: np.ndarray
    inputs: np.ndarray
    outputs: float
    n_samples: int


def response_products(basis, u, y, scales):
    """Products of the signals of one record with the responses to its inputs.

    In blocks of L samples: what was before a block by the w at its start, what is in it by its
    own lagged products. Rounds of some thousand samples are multiplied at a time.

    Parameters
    ----------
    basis : ResponseBasis
    u, y : ndarray, shapes (n_samples, m), (n_samples, l)
    scales : tuple of ndarray, shapes (m,), (l,)
        What inputs and outputs are divided by.

    Returns
    -------
    products : ResponseProducts
    """
    n_samples, m, q = *u.shape, len(basis.g)
    L = _block(q, m, y.shape[1], n_samples)
    powers = basis.powers(L)
    within = _pulse_responses(powers, basis.g)
    forcing = (within[L][:, None, None] * np.eye(m)[..., None]).reshape(L * m, m * q)
    n_blocks = -(-n_samples // L)
    n_rounds = -(-n_blocks * L // ROUND)
    per_round = -(-n_blocks // n_rounds)
    steps = max(1, int(np.sqrt(per_round)) // LESS_STEPS)
    n_states = (m + 1) * q  # the pulse before the record first
    round_states = np.empty((per_round, n_states))
    sums = [np.zeros((n_states + L * m, L * z.shape[1])) for z in (u, y)]
    squares, state = 0.0, np.zeros((m + 1, q))
    state[0] = basis.g
    for start in range(0, n_samples, per_round * L):
        rows = slice(start, min(start + per_round * L, n_samples))
        inputs, outputs = (_blocks(z[rows], L) for z in (u, y))
        first = 0 if np.max(np.abs(state[0])) > PULSE_OVER else 1
        w = round_states[: len(inputs), first * q :]
        np.matmul(inputs, forcing, out=w[:, -m * q :])
        w[:, : -m * q] = 0.0
        states = w.reshape(len(w), -1, q)
        state[first:] = run(powers[L], states, state[first:], steps)
        for total, z in zip(sums, (inputs, outputs), strict=True):
            total[first * q : n_states] += (z.T @ w).T  # BLAS is faster at tall by slim
            total[n_states:] += inputs.T @ z
        squares = squares + np.array([channel @ channel for channel in y[rows].T])
    rest = n_samples - (n_blocks - 1) * L  # samples of the last block
    last = states[-1, 1 - first :] @ powers[rest].T + u[-rest:].T @ within[rest, :rest]
    forced, free, same = _of_samples(sums, powers[:L], within[:L])
    u_scale, scale = scales[0], np.concatenate(scales)
    return ResponseProducts(
        forced=forced / u_scale[:, None, None] / scale,
        free=free / scale,
        last=last / u_scale[:, None],
        inputs=same / u_scale[:, None] / scale,
        outputs=float(np.sum(squares / scales[1] ** 2)),
        n_samples=n_samples,
    )


def _pulse_responses(powers, g):
    """w at sample t of a block, 0 … L, of pulses at its samples, shape (L + 1, L, q)."""
    L = len(powers) - 1
    pulses = np.concatenate([np.zeros((L, len(g))), powers[:-1] @ g])
    return pulses[L - 1 + np.arange(L + 1)[:, None] - np.arange(L)]


@functools.lru_cache(maxsize=64)
def _block(n_states, n_inputs, n_outputs, n_samples):
    """Samples in a block, for the least work."""

    def work(block):
        products = (n_states + block) * n_inputs * (n_inputs + n_outputs)
        recursion = STEP_WORK * n_states**2 * n_inputs / block
        return products + recursion

    most = max(1, int(np.sqrt(n_samples)))
    return min((b for b in BLOCKS if b <= most), key=work)


def _blocks(rows, L):
    """Consecutive rows, L of them side by side; zeros after the last."""
    missing = -len(rows) % L
    if missing or not rows.flags.c_contiguous:
        whole = np.zeros((len(rows) + missing, rows.shape[1]))
        for c, channel in enumerate(rows.T):  # twice as fast as a reshape of columns
            whole[: len(rows), c] = channel
        rows = whole
    return rows.reshape(-1, L * rows.shape[1])


def _of_samples(sums, powers, within):
    """Products with the responses sample by sample, and those of the inputs with all signals."""
    L, _, q = within.shape
    m = sums[0].shape[1] // L
    sums = np.concatenate([total.reshape(len(total), L, -1) for total in sums], axis=-1)
    before = sums[: (m + 1) * q].reshape(m + 1, q, L, -1)
    own = sums[(m + 1) * q :].reshape(L, m, L, -1)
    before = powers.transpose(1, 0, 2).reshape(q, -1) @ before.transpose(0, 2, 1, 3).reshape(
        m + 1, L * q, -1
    )
    own_forced = within.transpose(2, 1, 0).reshape(q, -1) @ own.transpose(1, 0, 2, 3).reshape(
        m, L * L, -1
    )
    forced = before[1:] + own_forced
    return forced, before[0], np.trace(own, axis1=0, axis2=2)


# ---- the equations -------------------------------------------------------------------------


def normal_equations(model, products, feedthrough):
    """Product of the equations with themselves, the outputs last.

    Parameters
    ----------
    model : OutputNormal
    products : ResponseProducts
    feedthrough : bool

    Returns
    -------
    G : ndarray, shape (c, c)
        The upper triangle.
    rounding : float
        Of its entries, beside the lengths of columns.
    """
    A, C, units = model.A, model.C, model.basis.units
    n, m, n_outputs, one = len(A), len(products.last), len(C), np.eye(len(A))
    flat = units.reshape(len(units), -1)
    forced = (products.forced.transpose(0, 2, 1) @ flat).reshape(m, -1, n, n)
    free = (products.free.T @ flat).reshape(-1, n, n)
    last = (products.last @ flat).reshape(m, n, n)
    power = np.linalg.matrix_power(A, products.n_samples)
    U = products.inputs[:, :m]
    ahead = A @ forced[:, :m]
    both = ahead.transpose(0, 1, 3, 2) + ahead.transpose(1, 0, 2, 3)
    both += U[:, :, None, None] * one
    both -= last.transpose(0, 2, 1)[:, None] @ last
    start = (A @ free[:m]).transpose(0, 2, 1) - power.T @ last
    seen, seen_free = C @ forced, C @ free
    B, D = n, n + n * m  # where columns of each begin
    y = D + feedthrough * n_outputs * m
    G = np.zeros((y + 1, y + 1))
    G[:B, :B] = one - power.T @ power
    G[:B, B:D] = start.transpose(1, 2, 0).reshape(n, -1)
    G[:B, y] = np.einsum("ooi->i", seen_free[m:])
    G[B:D, B:D] = both.transpose(2, 0, 3, 1).reshape(n * m, n * m)
    G[B:D, y] = np.einsum("cooi->ic", seen[:, m:]).reshape(-1)
    G[y, y] = products.outputs
    if feedthrough:
        G[:B, D:y] = seen_free[:m].transpose(2, 1, 0).reshape(n, -1)
        G[B:D, D:y] = seen[:, :m].transpose(3, 0, 2, 1).reshape(n * m, -1)
        for own in range(D, y, m):
            G[own : own + m, own : own + m] = U
        G[D:y, y] = products.inputs[:, m:].T.reshape(-1)
    left, whole = np.diagonal(G)[:D], np.ones(D)
    whole[B:].reshape(n, m)[:] = np.diagonal(U)
    loss = np.max(whole / left) if np.all(left > 0.0) else np.inf
    return G, model.error * loss
