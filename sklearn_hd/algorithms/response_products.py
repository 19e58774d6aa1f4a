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
numbers w that responses are made of (:mod:`~sklearn_hd.algorithms.block_responses`).
"""

from dataclasses import dataclass

import numpy as np
import slycot
from scipy import linalg

from sklearn_hd.algorithms.response_basis import response_basis, run
from sklearn_hd.algorithms.triangular import safe_cholesky, triangle

__all__ = ["OutputNormal", "output_normal", "products_factor"]

EPS = np.finfo(float).eps
MOST_RADIUS = 1.0 - 1e-6
LARGEST_CONDITION = 1e5
BLOCKS = (1, 2, 4, 8, 12, 16, 24, 32)  # samples
ROUND = 2**16  # samples, multiplied together
NEARLY = 1e-6  # the identity, before the last step towards it
PULSES = 1024  # samples of a pulse multiplied at a time
PULSE_OVER = 1e-18  # of its first size
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


def output_normal(A, C):
    """Output-normal coordinates of a stable model.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)

    Returns
    -------
    model : OutputNormal or None
        None where there are none, or none of good condition.
    """
    n = len(A)
    if n == 0:
        return None
    radius = np.max(np.abs(linalg.eigvals(A)))
    if radius > MOST_RADIUS:
        return None
    shown, padded = triangle(C), np.zeros((n, n))  # no more rows than states
    padded[: len(shown)] = shown
    T, scale, _ = slycot.sb03od(n, len(shown), A.copy(), np.eye(n), padded, "D")
    T = np.triu(T) / scale
    size = np.abs(np.diagonal(T))
    if not size.min() > size.max() / LARGEST_CONDITION:
        return None
    shown = linalg.solve_triangular(T, np.vstack([T @ A, C]).T, trans=1).T
    gramian = shown.T @ shown
    if not np.linalg.norm(gramian - np.eye(n)) < NEARLY:
        return None
    shown = shown @ (1.5 * np.eye(n) - 0.5 * gramian)  # columns orthonormal to the last digits
    basis = response_basis(shown[:n])
    if basis is None:
        return None
    off = np.linalg.norm(shown.T @ shown - np.eye(n))
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

    In blocks of L samples: within a block from its own lagged products, before it by the
    w at its start. Rounds of some thousand samples are multiplied at a time.

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
    u_scale, y_scale = scales
    n_samples, m, q = *u.shape, len(basis.g)
    L = _block(q, m, y.shape[1], n_samples)
    powers = basis.powers(L)
    pulses = powers[:L] @ basis.g
    forcing = np.zeros((L, m, m, q))
    for c in range(m):
        forcing[:, c, c] = pulses[::-1]
    per_round = max(1, ROUND // L)
    left = np.empty((min(per_round, -(-n_samples // L)), m * (q + L)))
    sums = [np.zeros((m * (q + L), L * z.shape[1])) for z in (u, y)]
    squares, state = np.zeros(y.shape[1]), np.zeros((m, q))
    for start in range(0, n_samples, per_round * L):
        rows = slice(start, min(start + per_round * L, n_samples))
        n_blocks = -(-(rows.stop - start) // L)
        blocks = [_blocks(z[rows], n_blocks, L) for z in (u, y)]
        w, inputs = left[:n_blocks, : m * q], left[:n_blocks, m * q :]
        inputs[...] = blocks[0]
        np.matmul(inputs, forcing.reshape(L * m, m * q), out=w)
        state = run(powers[L], w.reshape(n_blocks, m, q), state)
        for total, z in zip(sums, blocks, strict=True):
            total += left[:n_blocks].T @ z
        squares += [channel @ channel for channel in y[rows].T]
    n_rest = (n_samples - 1) % L + 1  # samples of the last block
    last = (
        w[-1].reshape(m, q) @ powers[n_rest].T + u[n_samples - n_rest :].T @ pulses[:n_rest][::-1]
    )
    scale = np.concatenate(scales)
    forced, same = _of_samples(sums, powers[:L], pulses, m)
    return ResponseProducts(
        forced=forced / u_scale[:, None, None] / scale,
        free=_free_products(basis, u, y) / scale,
        last=last / u_scale[:, None],
        inputs=same / u_scale[:, None] / scale,
        outputs=float(np.sum(squares / y_scale**2)),
        n_samples=n_samples,
    )


def _block(n_states, n_inputs, n_outputs, n_samples):
    """Samples in a block, for the least work."""

    def work(block):
        products = (n_states + block) * n_inputs * (n_inputs + n_outputs)
        recursion = STEP_WORK * n_states**2 * n_inputs / block
        return products + recursion

    most = max(1, int(np.sqrt(n_samples)))
    return min((b for b in BLOCKS if b <= most), key=work)


def _blocks(rows, n_blocks, L):
    """Consecutive rows, L of them side by side; zeros after the last."""
    if len(rows) < n_blocks * L or not rows.flags.c_contiguous:
        whole = np.zeros((n_blocks * L, rows.shape[1]))
        for c, channel in enumerate(rows.T):  # twice as fast as a reshape of columns
            whole[: len(rows), c] = channel
        rows = whole
    return rows.reshape(n_blocks, -1)


def _of_samples(sums, powers, pulses, m):
    """Products with the responses sample by sample, and those of the inputs with all signals."""
    L, q = pulses.shape
    sums = np.concatenate([total.reshape(len(total), L, -1) for total in sums], axis=-1)
    before = sums[: m * q].reshape(m, q, L, -1)
    within = sums[m * q :].reshape(L, m, L, -1)
    lags = np.zeros((L, m, sums.shape[-1]))
    for t in range(L):
        lags[: L - t] += within[t, :, t:].transpose(1, 0, 2)
    forced = np.tensordot(powers, before, ((0, 2), (2, 1)))  # q, m, p
    forced += np.tensordot(pulses[: L - 1], lags[1:], ((0,), (0,)))
    return forced.transpose(1, 0, 2), lags[0]


def _free_products(basis, u, y):
    """Σ_k w_k z_k of the pulse, as long as it lasts."""
    n_samples, step = len(u), basis.F
    pulses = basis.g[None]
    while len(pulses) < min(PULSES, n_samples):
        pulses = np.concatenate([pulses, pulses @ step.T])
        step = step @ step
        if np.max(np.abs(step)) < PULSE_OVER:
            break
    sums, power = np.zeros((len(basis.g), u.shape[1] + y.shape[1])), np.eye(len(basis.g))
    for start in range(0, n_samples, len(pulses)):
        rows = slice(start, start + len(pulses))
        own = [pulses[: len(z[rows])].T @ z[rows] for z in (u, y)]
        sums += power @ np.hstack(own)
        power = power @ step
        if np.max(np.abs(power)) < PULSE_OVER:
            break
    return sums


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
    n, m, n_outputs = len(A), len(products.last), len(C)
    forced = np.einsum("csz,sij->czij", products.forced, units, optimize=True)
    free = np.tensordot(products.free, units, ((0,), (0,)))
    last = np.tensordot(products.last, units, 1)
    power = np.linalg.matrix_power(A, products.n_samples)
    U = products.inputs[:, :m]
    ahead = A @ forced[:, :m]
    both = ahead.transpose(0, 1, 3, 2) + ahead.transpose(1, 0, 2, 3)
    both += U[:, :, None, None] * np.eye(n) - np.einsum("cki,dkj->cdij", last, last, optimize=True)
    start = (A @ free[:m]).transpose(0, 2, 1) - power.T @ last
    seen, seen_free = C @ forced, C @ free
    B, D, y = np.cumsum([n, n * m, feedthrough * n_outputs * m])  # where columns of each begin
    G = np.zeros((y + 1, y + 1))
    G[:B, :B] = np.eye(n) - power.T @ power
    G[:B, B:D] = start.transpose(1, 2, 0).reshape(n, -1)
    G[:B, y] = np.einsum("ooi->i", seen_free[m:])
    G[B:D, B:D] = both.transpose(2, 0, 3, 1).reshape(n * m, n * m)
    G[B:D, y] = np.einsum("cooi->ic", seen[:, m:]).reshape(-1)
    G[y, y] = products.outputs
    if feedthrough:
        G[:B, D:y] = seen_free[:m].transpose(2, 1, 0).reshape(n, -1)
        G[B:D, D:y] = seen[:, :m].transpose(3, 0, 2, 1).reshape(n * m, -1)
        G[D:y, D:y] = np.kron(np.eye(n_outputs), U)
        G[D:y, y] = products.inputs[:, m:].T.reshape(-1)
    left = np.diagonal(G)[:D]
    whole = np.concatenate([np.ones(n), np.tile(np.diagonal(U), n)])
    loss = np.max(whole / left) if np.all(left > 0.0) else np.inf
    return G, model.error * loss
