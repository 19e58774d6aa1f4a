"""B, D and the initial states by linear least squares, with A and C known.

    y_k = C A^k x_0 + Σ_{t<k} C A^{k-1-t} B u_t + D u_k

Each record has an initial state of its own. Its equations are brought to triangular form
by themselves, x_0 first:

    [X  F  y] = Q [R_x  R_xf  r_x]        rows that x_0 takes
                  [ 0   R_f   r_f]        rows left for B and D, which all records share

and only these small factors are kept: those of B and D are stacked and factored again,
in any order and grouping, and each x_0 follows from its own rows once B and D are known.

Unstable models are simulated over pieces that are short enough, each with a start of its own.
Many of one length are gone through together, by products
(:mod:`~sklearn_hd.algorithms.subspace.two_sided`) or else by orthogonal transformations
(:mod:`~sklearn_hd.algorithms.subspace.short_pieces`).

The equations never stand in memory as a whole. Three ways lead to the factor, each taken
where the one before it would not do:

1. Cholesky factor of the normal equations
   (:mod:`~sklearn_hd.algorithms.subspace.response_products`), of stable models where noise makes it
   safe.
2. Orthogonal transformations of long records, compressed in blocks
   (:mod:`~sklearn_hd.algorithms.subspace.block_responses`).
3. The same of equations made some thousand rows at a time, for short records, or outputs seen
   through a matrix that varies (Eq. 7). What goes from chunk to chunk is the response of the
   states so far, A^k and Σ_t A^{k-1-t} u_t.
"""

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy import linalg
from scipy.signal import fftconvolve

from sklearn_hd.algorithms.linalg.triangular import triangle
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.block_responses import best_block, compressed_equations
from sklearn_hd.algorithms.subspace.response_basis import response_basis, split
from sklearn_hd.algorithms.subspace.response_products import output_normal, products_factor
from sklearn_hd.algorithms.subspace.short_pieces import equations_of_pieces, is_short
from sklearn_hd.algorithms.subspace.two_sided import products_of_pieces, whole_block

__all__ = [
    "InitialState",
    "RecordFactors",
    "alike_states",
    "carry",
    "input_matrices",
    "pieces_of",
    "response_regressors",
    "solve_shared",
    "without_start",
]

EPS = np.finfo(float).eps
MAX_GROWTH = 20.0  # e-folds over which an unstable model is simulated in one piece
OVERFLOW_GROWTH = 300.0  # e-folds whose squares are numbers still
CONVOLVED_ORDER = 40
CHUNK_BYTES = 2**25  # of equations at a time
LEAST_CHUNK = 256
CARRIED_STEPS = 64
ROUND_BYTES = 2**24  # of responses of pieces, at a time
LONG, LEAST_BLOCK = 64, 9  # pieces that are made of whole blocks, of so many rows
FEWEST = 4  # pieces of one length that are worth going through together
STEPS = 64  # of one after the other that take as long as a piece by itself


def response_regressors(A, C, u, feedthrough):
    """Outputs of x[k+1] = A x + B u, y = C x + D u as a linear map of x[0], B and D.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    u : ndarray, shape (n_samples, m)
    feedthrough : bool
        Whether D is free.

    Returns
    -------
    free : ndarray, shape (n_samples, l, n)
        Response to each entry of x[0].
    forced : ndarray, shape (n_samples, l, n m [+ l m])
        Response to each entry of B (row by row), then of D.
    """
    n, n_outputs = len(A), len(C)
    if n > CONVOLVED_ORDER:
        free = np.empty((len(u), n_outputs, n))
        free[:1] = C
        for k in range(1, len(u)):
            free[k] = free[k - 1] @ A
    else:
        states = propagate(A, np.zeros((n, len(u), n)), np.eye(n))
        free = np.einsum("ptj,lj->tlp", states, C)
    blocks = [_forced_responses(A, C, u, free)]
    if feedthrough:
        direct = np.einsum("ab,tk->tbak", np.eye(n_outputs), u)
        blocks.append(direct.reshape(len(u), n_outputs, n_outputs * u.shape[1]))
    return free, np.concatenate(blocks, axis=-1)


def _forced_responses(A, C, u, free):
    """Responses to each entry of B: by recursion, or for high orders by convolution.

    The response to entry (i, j) is the free one from unit state i, convolved with input j
    and a sample later. A recursion over n m states of n entries each takes n³ m
    operations a sample (27 s for n = 138, m = 2 and 1500 rows; 0.6 s by convolution).
    """
    n, m = len(A), u.shape[1]
    if n > CONVOLVED_ORDER:
        forced = fftconvolve(free[..., None], u[:, None, None, :], axes=0)[: len(u) - 1]
        forced = np.concatenate([np.zeros((1, *forced.shape[1:])), forced])
        return forced.reshape(len(u), len(C), n * m)
    unit = np.einsum("ij,tk->iktj", np.eye(n), u).reshape(n * m, len(u), n)
    states = propagate(A, unit, np.zeros((n * m, n)))
    return np.einsum("ptj,lj->tlp", states, C)


def input_matrices(
    A, C, inputs, outputs, feedthrough, observe=None, *, scales=None, return_residual=False
):
    """B, D and the initial states that fit the outputs best, by linear least squares.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    inputs : list of ndarray, shapes (n_samples_s, m)
        One array a segment.
    outputs : list of ndarray, shapes (n_samples_s, q)
        Measured signals; q = l where ``observe`` is None.
    feedthrough : bool
        Whether D is free (else zero).
    observe : list of ndarray, shapes (n_samples_s, q, l), optional
        What is measured of the model's outputs at each sample, such as the
        recomposition of Eq. 7.
    scales : tuple of ndarray, shapes (m,), (q,), optional
        What inputs and outputs are divided by.
    return_residual : bool, default=False

    Returns
    -------
    B : ndarray, shape (n, m)
    D : ndarray, shape (l, m)
    x0 : ndarray, shape (n_segments, n)
    residual : float
        Sum of squares left, only with ``return_residual``.
    """
    n, m, n_outputs = len(A), inputs[0].shape[1], len(C)
    scales = scales or (np.ones(m), np.ones(outputs[0].shape[1]))
    factor = RecordFactors(A, C, feedthrough, scales)
    pieces, firsts = pieces_of(A, [len(u) for u in inputs], factor.radius)
    starts, shared = {}, np.zeros((0, n * m + feedthrough * n_outputs * m + 1))
    alike, together, two_sided = [], None, None
    if observe is None and m > 0 and len(pieces) > len(firsts):
        alike, together, two_sided = _together(factor, pieces, firsts, inputs, outputs)
    if alike:
        shared = together
    for k in sorted(set(range(len(pieces))) - set(alike)):
        s, rows = pieces[k]
        u, y = inputs[s][rows], outputs[s][rows]
        R = factor.of_products(u, y) if observe is None else None
        if R is not None and len(pieces) == 1:  # of good condition
            theta = linalg.lapack.dtrtrs(R[:-1, :-1], R[:-1, -1])[0]
            found = *split(theta[n:], n, m, n_outputs), theta[None, :n]
            return (*found, float(R[-1, -1] ** 2)) if return_residual else found
        if R is None:
            R = factor.of_rows(u, y, None if observe is None else observe[s][rows])
        starts[k], left = without_start(R, n)
        shared = triangle(shared, left)
    theta = solve_shared(shared)
    B, D = split(theta, n, m, n_outputs)

    def start(k):
        if k in starts:
            return starts[k].solve(theta)
        signals = (z[pieces[k][0]][pieces[k][1]] for z in (inputs, outputs))
        return factor.start(two_sided, *signals, B, D)

    found = B, D, np.array([start(k) for k in firsts])
    if not return_residual:
        return found
    return *found, float(np.sum((shared[:, -1] - shared[:, :-1] @ theta) ** 2))


def alike_states(A, C):
    """The same model with states that outputs see about alike, by powers of two.

    Without noise, those of an order too high are seen 10⁷ times less than others: what tells
    good coordinates from bad ones would take them for unseen.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)

    Returns
    -------
    A, C : ndarray
    size : ndarray, shape (n,)
        What each state is multiplied by; rows of B and initial states as well.
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


def _together(factor, pieces, firsts, inputs, outputs):
    """Pieces that are found together, their equations, and what gives their initial states."""
    lengths = np.array([rows.stop - rows.start for _, rows in pieces])
    alike = np.flatnonzero(lengths == np.max(lengths)).tolist()
    later = sorted(set(alike) - set(firsts))
    if later:
        found = factor.two_sided([pieces[k] for k in alike], inputs, outputs)
        if found is not None:
            return alike, *found
        R = factor.of_short([pieces[k] for k in later], inputs, outputs)
        if R is not None:
            return later, R, None
    return [], None, None


def _stacked(pieces, inputs, outputs, scales, n_states):
    """Pieces of one length side by side, some at a time, shape (n_pieces, length, m + l)."""
    rows, n_inputs = pieces[0][1], inputs[0].shape[1]
    at_a_time = max(1, ROUND_BYTES // (8 * n_states * n_inputs * (rows.stop - rows.start)))
    for start in range(0, len(pieces), at_a_time):
        some = pieces[start : start + at_a_time]
        blocks = [[z[s][rows] for s, rows in some] for z in (inputs, outputs)]
        scaled = [np.stack(block) / scale for block, scale in zip(blocks, scales, strict=True)]
        yield np.concatenate(scaled, axis=-1)


def solve_shared(shared):
    """Entries of B and D, row by row, from the equations left for them.

    With columns of equal length, so that units do not decide the rank.
    """
    regressors, target = shared[:, :-1], shared[:, -1]
    if regressors.shape[1] == 0:
        return np.zeros(0)
    scale = np.linalg.norm(regressors, axis=0)
    scale[scale == 0.0] = 1.0
    return linalg.lstsq(regressors / scale, target, lapack_driver="gelsy")[0] / scale


class RecordFactors:
    """Triangular factors of the equations [x_0, B, D, y] of records, by the first way that does.

    Parameters
    ----------
    A, C, feedthrough, scales
        As for ``input_matrices``.
    """

    def __init__(self, A, C, feedthrough, scales):
        self.A, self.C, self.feedthrough, self.scales = A, C, feedthrough, scales

    @cached_property
    def _own(self):
        """A, C and sizes of states that outputs see about alike."""
        return alike_states(self.A, self.C)

    @cached_property
    def radius(self):
        """Size of the largest eigenvalue."""
        return _radius(self.A)

    @cached_property
    def _normal(self):
        return output_normal(self.A, self.C, self.radius)

    @cached_property
    def _basis(self):
        return response_basis(self._own[0])

    def _of_own_states(self, R):
        """A factor in the coordinates given; its columns end with B, D and the outputs."""
        m = len(self.scales[0])
        units = np.repeat(self._own[2], m)
        last = R.shape[1] - 1 - self.feedthrough * len(self.C) * m
        R[:, last - len(units) : last] *= units
        R[:, : last - len(units)] *= self._own[2][: last - len(units)]
        return R

    def of(self, u, y):
        """Of one record."""
        R = self.of_products(u, y)
        return self.of_rows(u, y) if R is None else R

    def two_sided(self, pieces, inputs, outputs):
        """Of many pieces of one length, from normal equations; None where these would not do."""
        if self._basis is None:
            return None
        some = partial(_stacked, pieces, inputs, outputs, self.scales, len(self.A))
        m = inputs[0].shape[1]
        found = products_of_pieces(self._basis, self._own[1], some, m, self.feedthrough)
        return None if found is None else (self._of_own_states(found.R), found)

    def start(self, found, u, y, B, D):
        """The initial state of one of these pieces beside some B and D."""
        u, y, size = u / self.scales[0], y / self.scales[1], self._own[2]
        return found.initial_state(u, y, B * size[:, None], D) / size

    def of_short(self, pieces, inputs, outputs):
        """Of [B, D, y] alone, of many pieces of one length; None where one by one is faster."""
        length = pieces[0][1].stop - pieces[0][1].start
        short = is_short(length, len(self.A), len(self.C))
        if not short or len(pieces) < max(FEWEST, length / STEPS):
            return None
        some = _stacked(pieces, inputs, outputs, self.scales, len(self.A))
        m = inputs[0].shape[1]
        R = equations_of_pieces(*self._own[:2], some, m, self.feedthrough)
        return self._of_own_states(R)

    def of_products(self, u, y):
        """Of one record, from its normal equations; None where these would not do."""
        if self._normal is None or 0 in u.shape:
            return None
        return products_factor(self._normal, u, y, self.feedthrough, self.scales)

    def of_rows(self, u, y, observe=None):
        """Of one record without them, its outputs perhaps seen through a matrix that varies."""
        n, m, n_outputs = len(self.A), u.shape[1], len(self.C)
        compressed = observe is None and m > 0 and self._basis is not None
        if compressed and best_block(len(u), n, m, n_outputs):
            own = self._basis, self._own[1], u, y, self.feedthrough, self.scales
            return self._of_own_states(compressed_equations(*own))
        return _record_factor(self.A, self.C, u, y, self.feedthrough, observe, self.scales)


def pieces_of(A, lengths, radius=None):
    """Rows of each segment in pieces over which an unstable A does not overflow.

    Each piece gets an initial state of its own; a stable A leaves segments whole. ``radius`` is the
    size of the largest eigenvalue, where it is known.

    Returns
    -------
    pieces : list of (int, slice)
        Segment and rows.
    firsts : list of int
        The first piece of each segment.
    """
    radius = _radius(A) if radius is None else radius
    longest = max(lengths, default=0)
    if radius > 1.0:
        longest = max(2 * len(A), int(MAX_GROWTH / np.log(radius)))
        longest = max(2, min(longest, int(OVERFLOW_GROWTH / np.log(radius))))
        while longest > LONG and whole_block(longest) < LEAST_BLOCK:
            longest -= 1
    pieces, firsts = [], []
    for s, length in enumerate(lengths):
        firsts.append(len(pieces))
        starts = range(0, length, longest) if length else [0]
        pieces += [(s, slice(start, min(start + longest, length))) for start in starts]
    return pieces, firsts


def _radius(A):
    return np.max(np.abs(np.linalg.eigvals(A)), initial=0.0)


@dataclass(frozen=True)
class InitialState:
    """Equations of a record's initial state once B and D are known.

    Attributes
    ----------
    inverse : ndarray, shape (n, r)
    coupling : ndarray, shape (r, n_shared)
    right : ndarray, shape (r,)
    """

    inverse: np.ndarray
    coupling: np.ndarray
    right: np.ndarray

    def solve(self, theta):
        """The initial state beside some B and D."""
        return self.inverse @ (self.right - self.coupling @ theta)


def without_start(R, n):
    """The equations that an initial state takes, and those left for B and D.

    Directions in which it is not seen take none.
    """
    R = np.vstack([R, np.zeros((max(0, n - len(R)), R.shape[1]))])
    own, rest = R[:n, :n], R[:n, n:]
    scale = np.linalg.norm(own, axis=0)
    scale[scale == 0.0] = 1.0
    U, s, Vt = linalg.svd(own / scale)
    r = int(np.sum(s > EPS * max(n, 1) * np.max(s, initial=0.0)))
    inverse = Vt[:r].T / s[:r] / scale[:, None]
    turned = U.T @ rest
    start = InitialState(inverse, turned[:r, :-1], turned[:r, -1])
    return start, np.vstack([turned[r:], R[n:, n:]])


def _record_factor(A, C, u, y, feedthrough, observe, scales):
    """Triangular factor of the equations [x_0, B, D, y] of one record, chunk by chunk."""
    n, m = len(A), u.shape[1]
    n_columns = n + m * (n + feedthrough * len(C)) + 1
    chunk = max(LEAST_CHUNK, CHUNK_BYTES // (8 * (y.shape[1] * n_columns + n * n * m)))
    R, carried = np.zeros((0, n_columns)), None
    for start in range(0, max(len(u), 1), chunk):
        rows = slice(start, start + chunk)
        u_now, y_now = u[rows] / scales[0], y[rows] / scales[1]
        free, forced = response_regressors(A, C, u_now, feedthrough)
        if carried is not None:
            power, forced_states = carried
            forced[..., : n * m] += free @ forced_states
            free = free @ power
        if observe is not None:
            free, forced = observe[rows] @ free, observe[rows] @ forced
        equations = np.concatenate([free, forced, y_now[:, :, None]], axis=-1)
        R = triangle(R, equations.reshape(-1, n_columns))
        if rows.stop < len(u):
            carried = carry(A, u_now, carried)
    return R


def carry(A, u, carried=None):
    """A^k and the responses of the states to entries of B, k rows later.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    u : ndarray, shape (n_samples, m)
    carried : tuple of ndarray, optional
        What this returned for the rows before.

    Returns
    -------
    power : ndarray, shape (n, n)
    forced : ndarray, shape (n, n m)
        Entries of B row by row.
    """
    n, m = len(A), u.shape[1]
    power, forced = carried or (np.eye(n), np.zeros((n, n * m)))
    powers = [np.eye(n)]
    for _ in range(min(CARRIED_STEPS, len(u))):
        powers.append(A @ powers[-1])
    powers = np.stack(powers)
    for start in range(0, len(u), CARRIED_STEPS):
        block = u[start : start + CARRIED_STEPS]
        own = np.tensordot(powers[len(block) - 1 :: -1], block, (0, 0)).reshape(n, n * m)
        forced, power = powers[len(block)] @ forced + own, powers[len(block)] @ power
    return power, forced
