"""Equations for B, D and the initial state of a long record, compressed in blocks of rows.

Within a block of L samples everything is linear in the numbers w that responses are made of
(:mod:`~sklearn_hd.algorithms.subspace.response_basis`) at its start and the block's inputs and
outputs, z = [w, u_0 … u_{L-1}, y_0 … y_{L-1}]; the initial state is one more input, and stands
first. So the record is compressed by orthogonal transformations into the triangular factor
of its z, one for L samples; the equations of the L samples, applied to that factor, are small.
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import triangle
from sklearn_hd.algorithms.subspace.response_basis import run

__all__ = ["best_block", "compressed_equations"]

BLOCKS = (2, 3, 4, 6, 8, 12, 16)  # samples
ROUND = 1024  # blocks, whose states are found together
PULSE_OVER = 1e-18  # of its first size
STEP_WORK = 20  # of a small product in the recursion, beside that of large ones


def best_block(n_rows, n_states, n_inputs, n_outputs):
    """Samples in a block, for the least work; 0 where a record is too short to gain."""

    def work(block):
        width, n_equations = _width(n_states, n_inputs, n_outputs, block), block * n_outputs
        unknown = n_states * (n_inputs + 1) + n_inputs * n_outputs
        small = width * n_equations * unknown * (2 * width + unknown)
        recursion = STEP_WORK * n_states**2 * (n_inputs + 1)
        return n_rows // block * (width**2 + recursion) + small

    blocks = [
        block for block in BLOCKS if n_rows // block >= _width(n_states, n_inputs, n_outputs, block)
    ]
    return min(blocks, key=work, default=0)


def _width(n_states, n_inputs, n_outputs, block):
    """Number of entries of z."""
    return n_states * (n_inputs + 1) + block * (n_inputs + n_outputs)


def compressed_equations(basis, C, u, y, feedthrough, scales):
    """Triangular factor of the equations of one record.

    Parameters
    ----------
    basis : ResponseBasis
    C : ndarray, shape (l, n)
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
    maps = _equation_maps(basis, C, u.shape[1], feedthrough, record.block)
    R = np.zeros((0, record.width))
    for Z in record.rounds():
        R = triangle(R, Z)
    left, steps = record.left_over()
    return triangle(_apply(R, maps), _apply(left, maps[:, :steps]))


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
        shape = len(basis.g), u.shape[1], y.shape[1]
        self.block = block = best_block(len(u), *shape)
        self.width = _width(*shape, block)
        powers = basis.powers(block)
        forced = powers[block - 1 :: -1] @ basis.g
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
            self._fill(Z[:, n_states:], start)
            inputs = Z[:, n_states : n_states + self.n_inputs * self.block]
            Z[:, :q] = 0.0
            np.matmul(inputs, self.forced, out=Z[:, q:n_states])
            if np.max(np.abs(self.state[0]), initial=0.0) <= PULSE_OVER:
                self.state[0] = 0.0
            begin = 0 if self.state[0].any() else 1
            states = Z[:, begin * q : n_states].reshape(len(Z), -1, q)
            self.state[begin:] = run(self.step, states, self.state[begin:])
            yield Z

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


def _equation_maps(basis, C, n_inputs, feedthrough, block):
    """What each entry of z gives to the equations of the L samples.

    Returns
    -------
    maps : ndarray, shape (width, L, l, n + n m [+ l m] + 1)
    """
    seen = basis.seen(C)
    n_outputs, n, q = seen.shape
    m, powers = n_inputs, basis.powers(block - 1)
    maps = np.zeros(
        (
            _width(q, m, n_outputs, block),
            block,
            n_outputs,
            n + m * (n + feedthrough * n_outputs) + 1,
        )
    )
    from_state = np.einsum("ois,tsr->rtoi", seen, powers)
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
