"""Equations for B, D and the initial state of a long record, compressed in blocks of rows.

The response to an entry of B is that of a matrix Ξ_k = Σ_{t<k} A^{k-1-t} u_t, one for each
input: with A of n states, n² numbers a sample. But Ξ_k is a polynomial in A, and in
coordinates in which A is block diagonal (eigenvalues that almost coincide in one block;
Bavely and Stewart, 1979) it is block diagonal with

    Ξ = w_1 I + w_2 N + … + w_k N^{k-1},   N = A − mean eigenvalue,   for k eigenvalues

of a block: n numbers w_k in all, with w_{k+1} = F w_k + g u_k, and Ξ_k = Σ_s w_{k,s} N_s. The
initial state is one more input, a pulse just before the record, and stands first.

Within a block of L samples everything is linear in the states w at its start and the
block's inputs and outputs, z = [w, u_0 … u_{L-1}, y_0 … y_{L-1}]. So the record is
compressed into the triangular factor of its z, one for L samples; the equations of the L
samples, applied to that factor, are small. The factor comes from the product ZᵀZ where
noise makes this safe, else by orthogonal transformations.
"""

from dataclasses import dataclass

import numpy as np
import slycot
from scipy import linalg

from sklearn_hd.algorithms.simulation import propagate
from sklearn_hd.algorithms.triangular import safe_cholesky, triangle

__all__ = ["ResponseBasis", "compressed_equations", "response_basis"]

BLOCKS = (2, 3, 4, 6, 8, 12, 16)  # samples
ROUND = 1024  # blocks, whose states are found together
GROUP = 1024  # blocks, multiplied together
STEPS = 16  # of the recursion, taken one by one for all stretches of so many blocks
STEP_WORK = 20  # of a small product in the recursion, beside that of large ones
PULSE_OVER = 1e-18  # of its first size
LARGEST_TRANSFORMATION = 100.0
CONDITION = 1e6
LARGEST_BLOCK = 6  # powers of larger ones are too much alike


@dataclass(frozen=True)
class ResponseBasis:
    """Recursion of the numbers w that responses are made of, and what they stand for.

    Attributes
    ----------
    F : ndarray, shape (q, q)
    g : ndarray, shape (q,)
    seen : ndarray, shape (l, n, q)
        Outputs of each w for each entry of a column of B, or of the initial state.
    """

    F: np.ndarray
    g: np.ndarray
    seen: np.ndarray

    def width(self, n_inputs, block):
        """Number of entries of z."""
        return len(self.g) * (n_inputs + 1) + block * (n_inputs + len(self.seen))

    def block(self, n_rows, n_inputs):
        """Samples in a block, for the least work; 0 where a record is too short to gain."""

        def work(block):
            width, n_equations = self.width(n_inputs, block), block * len(self.seen)
            unknown = len(self.g) * (n_inputs + 1) + n_inputs * len(self.seen)
            small = width * n_equations * unknown * (2 * width + unknown)
            recursion = STEP_WORK * len(self.g) ** 2 * (n_inputs + 1)
            return n_rows // block * (width**2 + recursion) + small

        blocks = [block for block in BLOCKS if n_rows // block >= self.width(n_inputs, block)]
        return min(blocks, key=work, default=0)


def response_basis(A, C):
    """Basis of the responses of x[k+1] = A x + B u, y = C x, to any B.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)

    Returns
    -------
    basis : ResponseBasis or None
        None where no coordinates of good condition part the eigenvalues far enough, or there
        are none.
    """
    n = len(A)
    if n == 0:
        return None
    T, Z = linalg.schur(A)
    T, X, sizes, _ = slycot.mb03rd(n, T, Z, sort="S", pmax=LARGEST_TRANSFORMATION)
    if np.linalg.cond(X) > CONDITION or max(sizes) > LARGEST_BLOCK:
        return None
    inverse = linalg.inv(X)
    steps, pulses, seen, first = [], [], [], 0
    for size in sizes:
        block = slice(first, first + size)
        step, pulse, units = _block_numbers(T[block, block])
        steps.append(step)
        pulses.append(pulse)
        seen.append(np.einsum("oa,sab,bi->ois", C @ X[:, block], units, inverse[block]))
        first += size
    return ResponseBasis(
        linalg.block_diag(*steps), np.concatenate(pulses), np.concatenate(seen, axis=-1)
    )


def _block_numbers(block):
    """F, g and the matrices N_s of one diagonal block."""
    k = len(block)
    centre = np.trace(block) / k
    N = block - centre * np.eye(k)
    size = np.linalg.norm(N)
    if size == 0.0:
        return np.array([[centre]]), np.ones(1), np.eye(k)[None]
    N /= size
    powers = [np.eye(k)]
    for _ in range(1, k):
        powers.append(powers[-1] @ N)
    F = centre * np.eye(k) + size * np.eye(k, k=-1)
    # N^k by Cayley and Hamilton
    F[:, -1] -= size * (np.array([linalg.det(N), 0.0]) if k == 2 else np.poly(N)[:0:-1])
    return F, np.eye(k)[0], np.stack(powers)


def compressed_equations(basis, u, y, feedthrough, scales):
    """Triangular factor of the equations of one record.

    Parameters
    ----------
    basis : ResponseBasis
    u, y : ndarray, shapes (n_samples, m), (n_samples, l)
    feedthrough : bool
        Whether D is free.
    scales : tuple of ndarray, shapes (m,), (l,)
        What inputs and outputs are divided by.

    Returns
    -------
    R : ndarray, shape (c, n + n m [+ l m] + 1)
        Columns: the initial state, B (row by row), D, and the outputs.
    """
    record = _Record(basis, u, y, np.concatenate(scales))
    maps = _equation_maps(basis, u.shape[1], feedthrough, record.block)
    factor = _by_products(record, maps)
    if factor is None:
        R = np.zeros((0, record.width))
        for Z in record.rounds():
            R = triangle(R, Z)
        factor = triangle(_apply(R, maps))
    left, steps = record.left_over()
    return triangle(factor, _apply(left, maps[:, :steps]))


def _by_products(record, maps):
    """Factor of the equations of all whole blocks from ZᵀZ, or None where that is not safe.

    While the pulse of the initial state lasts, its fast modes are told apart within
    blocks, not from block to block: there the factor of Z is orthogonal, and small.
    """
    q = len(record.basis.g)
    head, G = np.zeros((0, record.width)), np.zeros((record.width - q,) * 2)
    for Z in record.rounds():
        split = _pulse_length(Z[:, :q])
        if split:
            head = triangle(head, Z[:split])
        G += Z[split:, q:].T @ Z[split:, q:]
    if G.any():
        rest = safe_cholesky(G)
        if rest is None:
            return None
        head = triangle(head, np.pad(rest, ((0, 0), (q, 0))))
    equations = _apply(head, maps)
    return safe_cholesky(equations.T @ equations)


def _pulse_length(pulse):
    """Number of blocks after which a pulse is over."""
    if np.max(np.abs(pulse[0]), initial=0.0) <= PULSE_OVER:
        return 0
    lasting = np.any(np.abs(pulse) > PULSE_OVER, axis=1)
    return int(np.flatnonzero(lasting)[-1]) + 1


def _apply(Z, maps):
    """Equations that rows of z give, one below the other."""
    width, steps, n_outputs, n_columns = maps.shape
    equations = Z @ maps.reshape(width, -1)
    return equations.reshape(len(Z) * steps * n_outputs, n_columns)


class _Record:
    """The rows z of a record's whole blocks, made some at a time.

    Parameters
    ----------
    basis : ResponseBasis
    u, y : ndarray, shapes (n_samples, m), (n_samples, l)
    scale : ndarray, shape (m + l,)
        What the channels, inputs and outputs, are divided by.
    """

    def __init__(self, basis, u, y, scale):
        self.basis, self.channels, self.scale = basis, [*u.T, *y.T], scale
        self.n_inputs, self.n_rows = u.shape[1], len(u)
        self.block = block = basis.block(len(u), u.shape[1])
        self.width = basis.width(u.shape[1], block)
        powers = _powers(basis, block)
        forced = np.stack([power @ basis.g for power in powers[block - 1 :: -1]])
        self.forced = linalg.block_diag(*[forced] * self.n_inputs)
        self.step = powers[block]
        self.state = None

    def rounds(self):
        """Rows z, a group of blocks at a time, in memory used again; then ``state`` is the last."""
        q, n_blocks = len(self.basis.g), self.n_rows // self.block
        n_states = (self.n_inputs + 1) * q
        self.state = np.zeros((self.n_inputs + 1, q))
        self.state[0] = self.basis.g
        whole = np.empty((min(ROUND, n_blocks), self.width))
        for start in range(0, n_blocks, ROUND):
            Z = whole[: n_blocks - start]
            for first in range(0, len(Z), GROUP):
                rows = Z[first : first + GROUP]
                self._fill(rows[:, n_states:], start + first)
                inputs = rows[:, n_states : n_states + self.n_inputs * self.block]
                rows[:, :q] = 0.0
                np.matmul(inputs, self.forced, out=rows[:, q:n_states])
            if np.max(np.abs(self.state[0]), initial=0.0) <= PULSE_OVER:
                self.state[0] = 0.0
            begin = 0 if self.state[0].any() else 1
            states = Z[:, begin * q : n_states].reshape(len(Z), -1, q)
            self.state[begin:] = _run(self.step, states, self.state[begin:])
            for first in range(0, len(Z), GROUP):
                yield Z[first : first + GROUP]

    def _fill(self, samples, start):
        for c, channel in enumerate(self.channels):
            part = channel[start * self.block : (start + len(samples)) * self.block]
            out = samples[:, c * self.block : (c + 1) * self.block]
            np.divide(part.reshape(-1, self.block), self.scale[c], out=out)

    def left_over(self):
        """The row z of the samples after the last whole block, and how many there are."""
        whole = self.n_rows // self.block * self.block
        z = np.zeros((1, self.width))
        z[0, : self.state.size] = self.state.ravel()
        samples = z[0, self.state.size :].reshape(-1, self.block)
        rest = np.stack([channel[whole:] for channel in self.channels])
        samples[:, : self.n_rows - whole] = rest / self.scale[:, None]
        return z, self.n_rows - whole


def _run(F, x, state):
    """Turn forcing v into states of x[k+1] = F x[k] + v[k], in place.

    Parameters
    ----------
    F : ndarray, shape (q, q)
    x : ndarray, shape (n_steps, channels, q)
    state : ndarray, shape (channels, q)
        The first.

    Returns
    -------
    state : ndarray, shape (channels, q)
        That after the last step.
    """
    whole = len(x) // STEPS * STEPS
    if whole:
        parts = x[:whole].reshape(-1, STEPS, *state.shape)
        ends = parts[:, 0].copy()
        for k in range(1, STEPS):
            ends = _advance(F, ends)
            ends += parts[:, k]
        ends = np.concatenate([ends, np.zeros((1, *state.shape))]).transpose(1, 0, 2)
        starts = propagate(np.linalg.matrix_power(F, STEPS), ends, state).transpose(1, 0, 2)
        state, now = starts[-1], np.ascontiguousarray(starts[:-1])
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


def _powers(basis, block):
    """F⁰ … F^L."""
    powers = [np.eye(len(basis.g))]
    for _ in range(block):
        powers.append(basis.F @ powers[-1])
    return powers


def _equation_maps(basis, n_inputs, feedthrough, block):
    """What each entry of z gives to the equations of the L samples.

    Returns
    -------
    maps : ndarray, shape (width, L, l, n + n m [+ l m] + 1)
    """
    n_outputs, n, q = basis.seen.shape
    m, powers = n_inputs, np.stack(_powers(basis, block)[:block])
    maps = np.zeros(
        (basis.width(m, block), block, n_outputs, n + m * (n + feedthrough * n_outputs) + 1)
    )
    from_state = np.einsum("ois,tsr->rtoi", basis.seen, powers)
    from_input = np.einsum("roti,r->toi", from_state.transpose(0, 2, 1, 3), basis.g)
    inputs = maps[(m + 1) * q :].reshape(m + n_outputs, block, *maps.shape[1:])
    maps[:q, :, :, :n] = from_state
    for j in range(m):
        columns = slice(n + j, n + n * m, m)
        maps[(j + 1) * q : (j + 2) * q, :, :, columns] = from_state
        for t in range(1, block):
            inputs[j, :t, t, :, columns] = from_input[t - 1 :: -1]
    sample, output = np.arange(block)[:, None], np.arange(n_outputs)
    for j in range(m if feedthrough else 0):
        inputs[j, sample, sample, output, n + n * m + output * m + j] = 1.0
    inputs[m + output, sample, sample, output, -1] = 1.0
    return maps
