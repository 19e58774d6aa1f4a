"""Numbers that the responses of a linear model are made of, one recursion for any B.

The response to an entry of B is that of a matrix Ξ_k = Σ_{t<k} A^{k-1-t} u_t, one for each
input: with A of n states, n² numbers a sample. But Ξ_k is a polynomial in A, and in
coordinates in which A is block diagonal (eigenvalues that almost coincide in one block;
Bavely and Stewart, 1979) it is block diagonal with

    Ξ = w_1 I + w_2 N + … + w_k N^{k-1},   N = A − mean eigenvalue,   for k eigenvalues

of a block: n numbers w_k in all, with w_{k+1} = F w_k + g u_k, and Ξ_k = Σ_s w_{k,s} N_s. That
of the initial state, A^k, is the response to a pulse just before the record.
"""

import math
from dataclasses import dataclass

import numpy as np
import slycot
from scipy import linalg

__all__ = ["ResponseBasis", "pulses", "response_basis", "run", "split"]

STEPS = 16  # of the recursion
FEW_STRETCHES = 256  # of steps, whose starts go by doubling
LARGEST_TRANSFORMATION = 100.0
CONDITION = 1e6
WORK = 64  # columns that LAPACK takes together
LARGEST_BLOCK = 6  # powers of larger ones are too much alike


@dataclass(frozen=True)
class ResponseBasis:
    """Recursion of the numbers w that responses are made of, and what they stand for.

    Attributes
    ----------
    F : ndarray, shape (q, q)
    g : ndarray, shape (q,)
    units : ndarray, shape (q, n, n)
        The matrix N_s that each w belongs to.
    """

    F: np.ndarray
    g: np.ndarray
    units: np.ndarray

    def seen(self, C):
        """Outputs of each w for each entry of a column of B, shape (l, n, q)."""
        return np.einsum("oi,sij->ojs", C, self.units)

    def powers(self, last):
        """F⁰ … F^last, shape (last + 1, q, q)."""
        powers = np.stack([np.eye(len(self.g)), self.F])
        while len(powers) <= last:
            powers = np.concatenate([powers, powers[1:] @ powers[-1]])
        return powers[: last + 1]


def response_basis(A):
    """Basis of the responses of x[k+1] = A x + B u, y = C x, to any B.

    Parameters
    ----------
    A : ndarray, shape (n, n)

    Returns
    -------
    basis : ResponseBasis or None
        None where no coordinates of good condition part the eigenvalues far enough, or there
        are none.
    """
    n = len(A)
    if n == 0:
        return None
    T, _, _, _, Z, _, fault = linalg.lapack.dgees(_unsorted, A, lwork=WORK * n)
    if fault:
        return None
    T, X, sizes, _ = slycot.mb03rd(n, T, Z, sort="S", pmax=LARGEST_TRANSFORMATION)
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


def _unsorted(*_):
    return False


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


def pulses(F, g, count):
    """g, F g, F² g, …, shape (count, q)."""
    found, step = g[None], F
    while len(found) < count:
        found = np.concatenate([found, found @ step.T])
        step = step @ step
    return found[:count]


def split(theta, n, m, n_outputs):
    """B and D of their entries; a D that was not asked for is zero."""
    D = theta[n * m :].reshape(-1, m) if len(theta) > n * m else np.zeros((n_outputs, m))
    return theta[: n * m].reshape(n, m), D


def run(F, x, state, steps=STEPS):
    """Turn forcing v into states of x[k+1] = F x[k] + v[k], in place.

    Parameters
    ----------
    F : ndarray, shape (q, q)
    x : ndarray, shape (n_steps, channels, q)
    state : ndarray, shape (channels, q)
        The first.
    steps : int, default=16
        Taken one by one for all stretches of so many; in one for all of a stretch after.

    Returns
    -------
    state : ndarray, shape (channels, q)
        That after the last step.
    """
    whole = len(x) // steps * steps
    if whole:
        parts = x[:whole].reshape(-1, steps, *state.shape)
        now = parts[:, 0].copy()
        for k in range(1, steps):
            now = _advance(F, now)
            now += parts[:, k]
        over = _double if len(now) < FEW_STRETCHES else run
        state = over(np.linalg.matrix_power(F, steps), now, state)
        for k in range(steps):
            then = _advance(F, now)
            then += parts[:, k]
            parts[:, k], now = now, then
    for k in range(whole, len(x)):
        x[k], state = state, _advance(F, state) + x[k]
    return state


def _double(F, x, state):
    """As ``run``, by recursive doubling (Kogge and Stone, 1973)."""
    states = np.concatenate([state[None], x])
    rows, step, power = states.reshape(-1, len(F)), len(state), F.T
    while step < len(rows) and power.any():  # else decayed below the smallest number
        rows[step:] += rows[:-step] @ power
        step, power = 2 * step, power @ power
    x[...] = states[:-1]
    return states[-1]


def _advance(F, states):
    """F x for each state, as one product."""
    return (states.reshape(-1, len(F)) @ F.T).reshape(states.shape)
