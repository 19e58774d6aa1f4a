"""B, D and the initial states by linear least squares, with A and C known.

    y_k = C A^k x_0 + Σ_{t<k} C A^{k-1-t} B u_t + D u_k

Each record has an initial state of its own. Its equations are brought to triangular form
by themselves, x_0 first:

    [X  F  y] = Q [R_x  R_xf  r_x]        rows that x_0 takes
                  [ 0   R_f   r_f]        rows left for B and D, which all records share

and only these small factors are kept: those of B and D are stacked and factored again,
in any order and grouping, and each x_0 follows from its own rows once B and D are known.
Unstable models are simulated over pieces that are short enough, each with a start of its own.

The equations never stand in memory as a whole. Two ways lead to the factor, the second taken
where the first would not do:

1. Cholesky factor of the normal equations (:mod:`~sklearn_hd.algorithms.subspace.responses`), of
   stable models where noise makes it safe.
2. Orthogonal transformations of the equations, made some thousand rows at a time; also of
   outputs seen through a matrix that varies (Eq. 7). What goes from chunk to chunk is the
   response of the states so far, A^k and Σ_t A^{k-1-t} u_t, or the numbers it is made of.
"""

import numpy as np
from scipy import linalg
from scipy.signal import fftconvolve

from sklearn_hd.algorithms.linalg.rounding import EPS
from sklearn_hd.algorithms.linalg.triangular import safe_cholesky, solve_within_rank, triangle
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.responses import (
    alike_states,
    normal_equations,
    output_normal,
    powers_of,
    response_basis,
    response_products,
    run,
    split,
)

MAX_GROWTH = 20.0  # e-folds over which an unstable model is simulated in one piece
CONVOLVED_ORDER = 40  # from which on responses are convolved, in less time than by recursion
CHUNK_BYTES = 2**22  # of equations at a time; three times as much stands beside them


def response_regressors(A, C, u, feedthrough):
    """Outputs of x[k+1] = A x + B u, y = C x + D u as a linear map of x[0], B and D.

    It returns the responses to each entry of x[0], (n_samples, l, n), and those to each
    entry of B, row by row, and of D where ``feedthrough`` frees it:
    (n_samples, l, n m [+ l m]).
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
    return free, _with_direct(_forced_responses(A, C, u, free), u, feedthrough)


def _with_direct(forced, u, feedthrough):
    """Responses to entries of B, and beside them those to entries of D."""
    if not feedthrough:
        return forced
    n_outputs = forced.shape[1]
    direct = np.einsum("ab,tk->tbak", np.eye(n_outputs), u)
    direct = direct.reshape(len(u), n_outputs, n_outputs * u.shape[1])
    return np.concatenate([forced, direct], axis=-1)


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

    It returns B, D, which is zero unless ``feedthrough`` frees it, and the initial
    states (n_segments, n). With ``return_residual`` it also returns the sum of squares
    left.

    Parameters
    ----------
    inputs : list of ndarray, shapes (n_samples_s, m)
        One array a segment.
    outputs : list of ndarray, shapes (n_samples_s, q)
        Measured signals; q = l where ``observe`` is None.
    observe : list of ndarray, shapes (n_samples_s, q, l), optional
        What is measured of the model's outputs at each sample, such as the
        recomposition of Eq. 7.
    scales : tuple of ndarray, shapes (m,), (q,), optional
        What inputs and outputs are divided by.
    """
    n, m, n_outputs = len(A), inputs[0].shape[1], len(C)
    scales = scales or (np.ones(m), np.ones(outputs[0].shape[1]))
    normal = output_normal(A, C) if observe is None else None
    pieces, firsts = pieces_of(A, [len(u) for u in inputs])
    starts, shared = [], np.zeros((0, n * m + feedthrough * n_outputs * m + 1))
    for s, rows in pieces:
        u, y = inputs[s][rows], outputs[s][rows]
        R = _product_factor(normal, u, y, feedthrough, scales)
        if R is not None and len(pieces) == 1:  # of good condition
            theta = linalg.lapack.dtrtrs(R[:-1, :-1], R[:-1, -1])[0]
            found = *split(theta[n:], n, m, n_outputs), theta[None, :n]
            return (*found, float(R[-1, -1] ** 2)) if return_residual else found
        if R is None:
            seen = None if observe is None else observe[s][rows]
            R = _record_factor(A, C, u, y, feedthrough, seen, scales)
        start, left = _without_start(R, n)
        starts.append(start)
        shared = triangle(shared, left)
    # by columns of equal length, so that units do not decide the rank; the shortest one
    theta = solve_within_rank(shared[:, :-1], shared[:, -1])
    starts = [starts[k] for k in firsts]
    x0 = np.array([inverse @ (own[:, -1] - own[:, :-1] @ theta) for inverse, own in starts])
    found = *split(theta, n, m, n_outputs), x0
    if not return_residual:
        return found
    return *found, float(np.sum((shared[:, -1] - shared[:, :-1] @ theta) ** 2))


def pieces_of(A, lengths):
    """Rows of each segment in pieces over which an unstable A does not overflow.

    Each piece gets an initial state of its own; a stable A leaves segments whole.

    It returns the pieces, each a segment and a slice of its rows, and the first piece
    of each segment.
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


def _product_factor(normal, u, y, feedthrough, scales):
    """Triangular factor of one record by its normal equations; None where these would not do."""
    if normal is None or 0 in u.shape:
        return None
    products = response_products(normal.basis, u, y, scales)
    G, loss = normal_equations(normal, products, feedthrough)
    R = safe_cholesky(G, loss) if np.isfinite(loss) else None
    if R is None:
        return None
    n, m, T = len(normal.A), u.shape[1], normal.T
    R[:, :n] = R[:, :n] @ T
    forced = R[:, n : n + n * m].reshape(len(R), n, m)
    R[:, n : n + n * m] = (T.T @ forced).reshape(len(R), n * m)
    return R


def _without_start(R, n):
    """The equations that an initial state takes, with the inverse of its part, and those left.

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
    return (inverse, turned[:r]), np.vstack([turned[r:], R[n:, n:]])


def _record_factor(A, C, u, y, feedthrough, observe, scales):
    """Triangular factor of the equations [x_0, B, D, y] of one record, chunk by chunk."""
    n, m = len(A), u.shape[1]
    n_columns = n + m * (n + feedthrough * len(C)) + 1
    chunk = max(256, CHUNK_BYTES // (8 * (y.shape[1] * n_columns + n * n * max(m, 1))))
    A_alike, C_alike, size = alike_states(A, C)
    basis = response_basis(A_alike) if observe is None and len(u) > chunk else None
    R, carried = np.zeros((0, n_columns)), None
    for start in range(0, max(len(u), 1), chunk):
        rows = slice(start, start + chunk)
        u_now, y_now = u[rows] / scales[0], y[rows] / scales[1]
        if basis is None:
            free, forced = response_regressors(A, C, u_now, feedthrough)
            if carried is not None:
                power, forced_states = carried
                forced[..., : n * m] += free @ forced_states
                free = free @ power
            if rows.stop < len(u):
                carried = _carry(A, u_now, carried)
        else:
            free, forced, carried = _by_basis(basis, C_alike, u_now, feedthrough, carried)
        if observe is not None:
            free, forced = observe[rows] @ free, observe[rows] @ forced
        equations = np.concatenate([free, forced, y_now[:, :, None]], axis=-1)
        R = triangle(R, equations.reshape(-1, n_columns))
    if basis is not None:
        R[:, :n] *= size
        R[:, n : n + n * m] *= np.repeat(size, m)
    return R


def _by_basis(basis, C, u, feedthrough, state):
    """What :func:`response_regressors` gives, in a quarter of the time, and the next w."""
    n, m, n_outputs = C.shape[1], u.shape[1], len(C)
    if state is None:
        state = np.zeros((m + 1, len(basis.g)))
        state[0] = basis.g
    w = np.zeros((len(u), *state.shape))
    w[:, 1:] = u[:, :, None] * basis.g
    state = run(basis.F, w, state)
    found = w.reshape(-1, w.shape[-1]) @ (C @ basis.units).reshape(len(basis.g), -1)
    found = found.reshape(len(u), m + 1, n_outputs, n)
    forced = found[:, 1:].transpose(0, 2, 3, 1).reshape(len(u), n_outputs, n * m)
    return found[:, 0], _with_direct(forced, u, feedthrough), state


def _carry(A, u, carried=None):
    """A^k and the responses of the states to entries of B, k rows later.

    ``carried`` is what this returned for the rows before. The responses (n, n m) have
    the entries of B row by row.
    """
    n, m = len(A), u.shape[1]
    powers = powers_of(A, len(u))
    forced = np.tensordot(powers[-2::-1], u, (0, 0)).reshape(n, n * m)
    if carried is None:
        return powers[-1], forced
    return powers[-1] @ carried[0], powers[-1] @ carried[1] + forced
