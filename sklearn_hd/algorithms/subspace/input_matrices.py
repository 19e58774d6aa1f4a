"""B, D and the initial states by linear least squares, with A and C known.

    y_k = C A^k x_0 + Σ_{t<k} C A^{k-1-t} B u_t + D u_k

Each record has an initial state of its own. Its equations are brought to triangular form
by themselves, x_0 first:

    [X  F  y] = Q [R_x  R_xf  r_x]        rows that x_0 takes
                  [ 0   R_f   r_f]        rows left for B and D, which all records share

and only these small factors are kept: those of B and D are stacked and factored again,
in any order and grouping, and each x_0 follows from its own rows once B and D are known.
Unstable models are simulated over pieces that are short enough, each with a start of its own.

The equations never stand in memory as a whole. Three ways lead to the factor, each taken
where the one before it would not do:

1. Cholesky factor of the normal equations (:mod:`~sklearn_hd.algorithms.subspace.responses`), of
   stable models where noise makes it safe.
2. Orthogonal transformations of long records, compressed in blocks of L samples. Within a block
   everything is linear in z = [w, u_0 … u_{L-1}, y_0 … y_{L-1}], with w the numbers at its start
   that responses are made of; the initial state is one more input, and stands first. The
   equations of the L samples are applied to the triangular factor of all z, which is small.
3. The same of equations made some thousand rows at a time, for short records, or outputs seen
   through a matrix that varies (Eq. 7). What goes from chunk to chunk is the response of the
   states so far, A^k and Σ_t A^{k-1-t} u_t.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.signal import fftconvolve

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS
from sklearn_hd.algorithms.linalg.triangular import safe_cholesky, triangle
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.responses import (
    BLOCKS,
    PULSE_OVER,
    STEP_WORK,
    normal_equations,
    output_normal,
    response_basis,
    response_products,
    run,
    split,
)

MAX_GROWTH = 20.0  # e-folds over which an unstable model is simulated in one piece
CONVOLVED_ORDER = 40  # from which on responses are convolved, in less time than by recursion
CHUNK_BYTES = 2**22  # of equations at a time; three times as much stands beside them
CARRIED_STEPS = 64  # of states, multiplied together
BLOCKS_TOGETHER = 1024  # whose states are found together


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
    factors = _RecordFactors(A, C, feedthrough, scales)
    pieces, firsts = pieces_of(A, [len(u) for u in inputs])
    starts, shared = [], np.zeros((0, n * m + feedthrough * n_outputs * m + 1))
    for s, rows in pieces:
        u, y = inputs[s][rows], outputs[s][rows]
        R = factors.of_products(u, y) if observe is None else None
        if R is not None and len(pieces) == 1:  # of good condition
            theta = linalg.lapack.dtrtrs(R[:-1, :-1], R[:-1, -1])[0]
            found = *split(theta[n:], n, m, n_outputs), theta[None, :n]
            return (*found, float(R[-1, -1] ** 2)) if return_residual else found
        if R is None:
            R = factors.of_rows(u, y, None if observe is None else observe[s][rows])
        start, left = _without_start(R, n)
        starts.append(start)
        shared = triangle(shared, left)
    theta = _solve(shared)
    x0 = np.array([starts[k].solve(theta) for k in firsts])
    found = *split(theta, n, m, n_outputs), x0
    if not return_residual:
        return found
    return *found, float(np.sum((shared[:, -1] - shared[:, :-1] @ theta) ** 2))


def pieces_of(A, lengths):
    """Rows of each segment in pieces over which an unstable A does not overflow.

    Each piece gets an initial state of its own; a stable A leaves segments whole.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    lengths : list of int

    Returns
    -------
    pieces : list of (int, slice)
        Segment and rows.
    firsts : list of int
        The first piece of each segment.
    """
    longest, radius = max(lengths, default=0), np.max(np.abs(np.linalg.eigvals(A)), initial=0.0)
    if radius > 1.0:  # no fewer rows than tell states apart, while squares are numbers
        growth = np.log(radius)
        longest = max(2 * len(A), int(MAX_GROWTH / growth))
        longest = max(2, min(longest, int(15.0 * MAX_GROWTH / growth)))
    pieces, firsts = [], []
    for s, length in enumerate(lengths):
        firsts.append(len(pieces))
        starts = range(0, length, longest) if length else [0]
        pieces += [(s, slice(start, min(start + longest, length))) for start in starts]
    return pieces, firsts


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


def _solve(shared):
    """Entries of B and D, row by row, from the equations left for them.

    With columns of equal length, so that units do not decide the rank; of inputs that move
    together the shortest.
    """
    regressors, target = shared[:, :-1], shared[:, -1]
    if regressors.shape[1] == 0:
        return np.zeros(0)
    scale = np.linalg.norm(regressors, axis=0)
    scale[scale == 0.0] = 1.0
    found = linalg.lstsq(regressors / scale, target, cond=DEPENDENT, lapack_driver="gelsy")
    return found[0] / scale


class _RecordFactors:
    """Triangular factors of the equations [x_0, B, D, y] of records.

    Parameters
    ----------
    A, C, feedthrough, scales
        As for ``input_matrices``.
    """

    def __init__(self, A, C, feedthrough, scales):
        self.A, self.C, self.feedthrough, self.scales = A, C, feedthrough, scales
        self.radius = np.max(np.abs(np.linalg.eigvals(A)), initial=0.0)

    @cached_property
    def _normal(self):
        return output_normal(self.A, self.C, self.radius)

    @cached_property
    def _own(self):
        """C, sizes and basis of states that outputs see about alike."""
        A, C, size = alike_states(self.A, self.C)
        return C, size, response_basis(A)

    def of_products(self, u, y):
        """Of one record, from its normal equations; None where these would not do."""
        if self._normal is None or 0 in u.shape:
            return None
        products = response_products(self._normal.basis, u, y, self.scales)
        G, loss = normal_equations(self._normal, products, self.feedthrough)
        R = safe_cholesky(G, loss) if np.isfinite(loss) else None
        if R is None:
            return None
        n, m, T = len(self.A), u.shape[1], self._normal.T
        R[:, :n] = R[:, :n] @ T
        forced = R[:, n : n + n * m].reshape(len(R), n, m)
        R[:, n : n + n * m] = (T.T @ forced).reshape(len(R), n * m)
        return R

    def of_rows(self, u, y, observe=None):
        """Of one record without them, its outputs perhaps seen through a matrix that varies."""
        n, m, n_outputs = len(self.A), u.shape[1], len(self.C)
        if observe is not None or m == 0 or not best_block(len(u), n, m, n_outputs):
            return _record_factor(self.A, self.C, u, y, self.feedthrough, observe, self.scales)
        C, size, basis = self._own
        if basis is None:
            return _record_factor(self.A, self.C, u, y, self.feedthrough, None, self.scales)
        R = _compressed_equations(basis, C, u, y, self.feedthrough, self.scales)
        R[:, :n] *= size
        R[:, n : n + n * m] *= np.repeat(size, m)
        return R


@dataclass(frozen=True)
class _InitialState:
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


def _without_start(R, n):
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
    start = _InitialState(inverse, turned[:r, :-1], turned[:r, -1])
    return start, np.vstack([turned[r:], R[n:, n:]])


def _record_factor(A, C, u, y, feedthrough, observe, scales):
    """Triangular factor of the equations [x_0, B, D, y] of one record, chunk by chunk."""
    n, m = len(A), u.shape[1]
    n_columns = n + m * (n + feedthrough * len(C)) + 1
    chunk = max(256, CHUNK_BYTES // (8 * (y.shape[1] * n_columns + n * n * m)))
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
            carried = _carry(A, u_now, carried)
    return R


def _carry(A, u, carried=None):
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


def best_block(n_rows, n_states, n_inputs, n_outputs):
    """Samples in a block, for the least work; 0 where a record is too short to gain."""

    def work(block):
        width, n_equations = _width(n_states, n_inputs, n_outputs, block), block * n_outputs
        unknown = n_states * (n_inputs + 1) + n_inputs * n_outputs
        small = width * n_equations * unknown * (2 * width + unknown)
        recursion = STEP_WORK * n_states**2 * (n_inputs + 1)
        return n_rows // block * (width**2 + recursion) + small

    blocks = [
        block
        for block in BLOCKS[1:]
        if n_rows // block >= _width(n_states, n_inputs, n_outputs, block)
    ]
    return min(blocks, key=work, default=0)


def _width(n_states, n_inputs, n_outputs, block):
    """Number of entries of z."""
    return n_states * (n_inputs + 1) + block * (n_inputs + n_outputs)


def _compressed_equations(basis, C, u, y, feedthrough, scales):
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
        whole = np.empty((min(BLOCKS_TOGETHER, n_blocks), self.width))
        for start in range(0, n_blocks, BLOCKS_TOGETHER):
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
