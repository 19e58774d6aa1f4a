"""Responses of a linear model to any B, and the products of data with them.

The response to an entry of B is that of a matrix Ξ_k = Σ_{t<k} A^{k-1-t} u_t, one for each
input: with A of n states, n² numbers a sample. But Ξ_k is a polynomial in A, and in
coordinates in which A is block diagonal (eigenvalues that almost coincide in one block;
Bavely and Stewart, 1979) it is block diagonal with

    Ξ = w_1 I + w_2 N + … + w_k N^{k-1},   N = A − mean eigenvalue,   for k eigenvalues

of a block: n numbers w_k in all, with w_{k+1} = F w_k + g u_k, and Ξ_k = Σ_s w_{k,s} N_s. That
of the initial state, A^k, is the response to a pulse just before the record.

Least squares for B, D and the initial state (:mod:`~.input_matrices`, :mod:`~.sums`) need
products of the data with these responses. In coordinates in which the observability Gramian
is the identity, A'A + C'C = 1 (primes transpose), the sums telescope: with

    S(u, z) = Σ_k Ξ_k z_k,     H(z) = Σ_k A^k z_k,     P = A^N

for a record of N samples, one input u or v and one signal z (an input or an output)

    Σ_k Ξ_k' C'C Ξ_k     = A S(u, v) + (A S(v, u))' + Σ_k u_k v_k − Ξ_N' Ξ_N
    Σ_k A^k' C'C Ξ_k     = (A H(u))' − P' Ξ_N
    Σ_k A^k' C'C A^k     = 1 − P'P

and the products with D's inputs and with the outputs are C S and C H. So all that the
equations need of the data are S and H: no more than the products of each signal with w.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
import slycot
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EPS
from sklearn_hd.algorithms.linalg.triangular import triangle

STEPS = 16  # of the recursion one by one; 8 and 32 are as fast, 64 takes twice as long
CONDITION = 1e6  # of the block diagonal coordinates: what is squared loses 12 of 16 digits
LARGEST_BLOCK = 6  # eigenvalues; powers of more are too much alike
BLOCKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # samples that may be taken together
ROUND = 2**16  # samples, multiplied together
STEP_WORK = 20  # of a small product in the recursion, beside that of large ones
PULSE_OVER = 1e-18  # of a response to a pulse: nothing beside rounding


@dataclass(frozen=True)
class ResponseBasis:
    """Recursion of the numbers w that responses are made of, and what they stand for."""

    F: np.ndarray  # (q, q)
    g: np.ndarray  # (q,)
    units: np.ndarray  # (q, n, n): the matrix N_s that each w belongs to


def response_basis(A):
    """Basis of the responses of x[k+1] = A x + B u, y = C x, to any B.

    It returns None where no coordinates of good condition part the eigenvalues far
    enough, or there are none.
    """
    n = len(A)
    if n == 0:
        return None
    T, Z = linalg.schur(A)
    T, X, sizes, _ = slycot.mb03rd(n, T, Z, sort="S", pmax=1e2)  # entries of one transformation
    inverse = np.linalg.inv(X)
    if np.linalg.norm(X) * np.linalg.norm(inverse) > CONDITION or max(sizes) > LARGEST_BLOCK:
        return None
    F, own, g, first = np.zeros((n, n)), np.zeros((n, n, n)), np.zeros(n), 0
    for size in sizes:
        block = slice(first, first + size)
        F[block, block], powers = _block_numbers(T[block, block])
        own[block, block, block], g[first] = powers, 1.0
        first += size
    return ResponseBasis(F, g, X @ own @ inverse)


def _block_numbers(block):
    """F and the matrices N_s of one diagonal block; g is its first unit vector."""
    k = len(block)
    if k == 1:
        return block, np.ones((1, 1, 1))
    if k == 2:  # N² by Cayley and Hamilton
        (a, b), (c, d) = block.tolist()
        centre, half = 0.5 * (a + d), 0.5 * (a - d)
        size = math.sqrt(2.0 * half**2 + b**2 + c**2) or 1.0
        N = [[half / size, b / size], [c / size, -half / size]]
        return [[centre, (half**2 + b * c) / size], [size, centre]], [[[1.0, 0.0], [0.0, 1.0]], N]
    centre = np.trace(block) / k
    N = block - centre * np.eye(k)
    size = np.linalg.norm(N) or 1.0
    N /= size
    powers = [np.eye(k)]
    for _ in range(1, k):
        powers.append(powers[-1] @ N)
    F = centre * np.eye(k) + size * np.eye(k, k=-1)
    F[:, -1] -= size * np.poly(N)[:0:-1]
    return F, np.stack(powers)


def powers_of(A, last):
    """A⁰ … A^last, shape (last + 1, n, n)."""
    powers = np.stack([np.eye(len(A)), A])
    while len(powers) <= last:
        powers = np.concatenate([powers, powers[1:] @ powers[-1]])
    return powers[: last + 1]


def split(theta, n, m, n_outputs):
    """B and D of their entries; a D that was not asked for is zero."""
    D = theta[n * m :].reshape(-1, m) if len(theta) > n * m else np.zeros((n_outputs, m))
    return theta[: n * m].reshape(n, m), D


def run(F, x, state):
    """Turn forcing v into states of x[k+1] = F x[k] + v[k], in place.

    ``x`` has shape (n_steps, channels, q), and ``state`` (channels, q) is the first
    one. It returns the state after the last step.
    """
    whole = len(x) // STEPS * STEPS
    if whole:
        parts = x[:whole].reshape(-1, STEPS, *state.shape)
        now = parts[:, 0].copy()
        for k in range(1, STEPS):
            now = _advance(F, now)
            now += parts[:, k]
        state = run(np.linalg.matrix_power(F, STEPS), now, state)
        for k in range(STEPS):
            then = _advance(F, now)
            then += parts[:, k]
            parts[:, k], now = now, then
    for k in range(whole, len(x)):
        x[k], state = state, _advance(F, state) + x[k]
    return state


def _advance(F, states):
    """F x for each state, as one product."""
    return (states.reshape(-1, len(F)) @ F.T).reshape(states.shape)


@dataclass(frozen=True)
class OutputNormal:
    """A model in coordinates T x, in which its observability Gramian is the identity."""

    A: np.ndarray  # (n, n)
    C: np.ndarray  # (l, n)
    T: np.ndarray  # (n, n): upper triangular
    basis: object  # ResponseBasis: of A
    error: float  # by which A'A + C'C is off the identity, as it grows over the memory of A


def alike_states(A, C):
    """The same model with states that outputs see about alike, by powers of two.

    Without noise, those of an order too high are seen 10⁷ times less than others: what tells
    good coordinates from bad ones would take them for unseen.

    It returns A, C and what each state is multiplied by, as rows of B and initial
    states are.
    """
    squares = np.zeros(len(A))
    with np.errstate(over="ignore", invalid="ignore"):
        seen = C / (np.max(np.abs(C), initial=0.0) or 1.0)
        for _ in range(len(A)):
            squares += np.sum(seen**2, axis=0)
            seen = seen @ A
    size = np.sqrt(np.where((squares > 0.0) & np.isfinite(squares), squares, 1.0))
    size = np.ldexp(1.0, np.frexp(size)[1])
    return A * (size[:, None] / size), C / size, size


def output_normal(A, C):
    """Output-normal coordinates of a stable model.

    It returns None where there are none, or none of good condition.
    """
    n = len(A)
    if n == 0:
        return None
    one = np.eye(n)
    radius = np.max(np.abs(np.linalg.eigvals(A)))
    if radius > 1.0 - 1e-6:  # rounding grows by 1 / (1 − radius²)
        return None
    shown, padded = C if len(C) <= n else triangle(C), np.zeros((n, n))
    padded[: len(shown)] = shown
    T, scale, _ = slycot.sb03od(n, len(shown), A.copy(), one.copy(), padded, "D")
    T = np.triu(T) / scale
    size = np.abs(np.diagonal(T))
    if not size.min() > size.max() / np.sqrt(CONDITION):
        return None
    shown = linalg.lapack.dtrtrs(T, np.vstack([T @ A, C]).T, trans=1)[0].T
    gramian = shown.T @ shown
    if not np.linalg.norm(gramian - one) < 1e-6:
        return None
    shown = shown @ (1.5 * one - 0.5 * gramian)  # columns orthonormal to the last digits
    basis = response_basis(shown[:n])
    if basis is None:
        return None
    off = np.linalg.norm(shown.T @ shown - one)
    error = (n * EPS + off) / (1.0 - radius**2)
    return OutputNormal(shown[:n], shown[n:], T, basis, error)


@dataclass(frozen=True)
class ResponseProducts:
    """What normal equations need of a record with m inputs and p signals, inputs first."""

    forced: np.ndarray  # (m, q, p): Σ_k w_k z_k, w those of the response to an input
    free: np.ndarray  # (q, p): Σ_k w_k z_k, w those of a pulse before the record
    last: np.ndarray  # (m, q): w_N of the responses to inputs
    inputs: np.ndarray  # (m, p): Σ_k u_k z_k'
    outputs: float  # Σ_k y_k' y_k
    n_samples: int


def response_products(basis, u, y, scales):
    """Products of the signals of one record with the responses to its inputs.

    In blocks of L samples: what was before a block by the w at its start, what is in it by its
    own lagged products. Rounds of some thousand samples are multiplied at a time.

    Inputs and outputs are divided by ``scales`` (m,), (l,).
    """
    n_samples, m, q = *u.shape, len(basis.g)
    L = _block(q, m, y.shape[1], n_samples)
    powers = powers_of(basis.F, L)
    within = _pulse_responses(powers, basis.g)
    forcing = (within[L][:, None, None] * np.eye(m)[..., None]).reshape(L * m, m * q)
    n_blocks = -(-n_samples // L)
    n_rounds = -(-n_blocks * L // ROUND)
    per_round = -(-n_blocks // n_rounds)
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
        state[first:] = run(powers[L], states, state[first:])
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


def normal_equations(model, products, feedthrough):
    """Product of the equations with themselves, the outputs last.

    Columns of x[0], B (row by row) and D stand before them. It returns the upper
    triangle, and the rounding of its entries beside the lengths of columns.
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
