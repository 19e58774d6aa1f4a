"""Past-output MOESP subspace identification (Verhaegen, 1994; the paper's section 2.2).

From the triangular factor of [U_f; U_p; Y_p; Y_f] = L Q,

    L_32 = U S Vᵀ      (future outputs on past data, future inputs projected out)
    Γ_i  = U_n S_n^½   (Eq. 13),   C = Γ_i[:l],   Γ_i[:-l] A = Γ_i[l:]

and with A and C known, y is linear in B, D and the initial states.
"""

import numpy as np
from scipy import linalg
from scipy.signal import fftconvolve

from sklearn_hd.algorithms.simulation import propagate

__all__ = [
    "input_matrices",
    "noise_floor",
    "observability_subspace",
    "order_by_gap",
    "order_by_wide_gap",
    "release_idle_directions",
    "response_regressors",
    "state_matrices",
]

EPS = np.finfo(float).eps
MAX_GROWTH = 20.0  # e-folds over which an unstable model is simulated in one piece
IDLE_SHARE = 1e-11  # of the largest direction: rounding
OVERFLOW_GROWTH = 300.0  # e-folds whose squares are numbers still
GAP_REACH = np.sqrt(10.0)
CLEAR_GAP = 2.0
CONVOLVED_ORDER = 40
WIDE_GAP = 1e3


def observability_subspace(R, block_rows, n_inputs):
    """Left singular vectors and singular values of the projected future outputs.

    Parameters
    ----------
    R : ndarray, shape (2 i (m + l), 2 i (m + l))
        From :func:`~sklearn_hd.algorithms.hankel.hankel_factor`.
    block_rows : int
    n_inputs : int

    Returns
    -------
    U : ndarray, shape (i l, i l)
    singular_values : ndarray, shape (i l,)
    """
    past = slice(block_rows * n_inputs, R.shape[0] - _future_width(R, block_rows, n_inputs))
    projected = R[past, past.stop :].T
    U, singular_values, _ = linalg.svd(projected, full_matrices=False)
    return U, singular_values


def release_idle_directions(R, n_future_inputs):
    """The factor with nothing projected out that the future inputs do not excite.

    Where inputs excite fewer directions than they have rows, a QR factorisation goes on
    with directions made of rounding, which lie in the very columns in which inputs move:
    projected out, they take the response with them. They are handed on to the past.

    Parameters
    ----------
    R : ndarray, shape (p, p)
        From :func:`~sklearn_hd.algorithms.hankel.hankel_factor`.
    n_future_inputs : int
        Rows of U_f, i m.

    Returns
    -------
    R : ndarray, shape (p, p)
        Upper block triangular; RᵀR as before, but for what is below rounding in U_f.
    """
    n = n_future_inputs
    rotation, sizes, _ = linalg.svd(R[:n, :n])
    idle = sizes <= IDLE_SHARE * sizes[0]
    if not idle.any():
        return R
    freed = rotation[:, idle].T @ R[:n, n:]
    rest = linalg.qr(np.vstack([freed, R[n:, n:]]), mode="r")[0][: len(R) - n]
    kept = np.zeros_like(R)
    kept[: n - idle.sum()] = rotation[:, ~idle].T @ R[:n]
    kept[n:, n:] = rest
    return kept


def _future_width(R, block_rows, n_inputs):
    return R.shape[0] // 2 - block_rows * n_inputs


def noise_floor(R, block_rows, n_inputs, n_columns):
    """Largest singular value that rounding, or white output noise, would give.

    The residual of the future outputs after regression on all past and future
    data, L_33, has the noise's standard deviation times the square root of the
    columns left; random rows of that size in L_32 have singular values up to
    σ (√(i l) + √(i (m + l))) (Marchenko and Pastur, 1967).

    Parameters
    ----------
    R : ndarray
        From :func:`~sklearn_hd.algorithms.hankel.hankel_factor`.
    block_rows, n_inputs, n_columns : int

    Returns
    -------
    floor : float
    """
    future = _future_width(R, block_rows, n_inputs)
    start = R.shape[0] - future
    past = start - block_rows * n_inputs
    left = n_columns - start
    rounding = 10.0 * EPS * np.sqrt(n_columns) * np.linalg.norm(R[:, start:], 2)
    if left < future:
        return rounding  # too few columns to see a residual
    sigma = np.linalg.norm(R[start:, start:]) / np.sqrt(future * left)
    return max(rounding, sigma * (np.sqrt(future) + np.sqrt(past)))


def order_by_gap(singular_values, floor, max_order):
    """Order at the gap by which singular values stand above a floor.

    Of the ratios σ_n / max(σ_{n+1}, floor) the widest decides, if it spans
    three decades. A lesser gap far above the floor parts strong modes from
    weak ones, not modes from noise: then only ratios count whose lower side
    is within half a decade of the floor. Where the widest of these is less
    than a factor of two there is no gap, and all values above the floor count.

    Parameters
    ----------
    singular_values : ndarray
        In descending order.
    floor : float
        Size of the values that rounding or noise alone would give.
    max_order : int

    Returns
    -------
    order : int
        At least 1.

    Examples
    --------
    >>> order_by_gap(np.array([9.0, 5.0, 2.0, 1e-15, 5e-16]), floor=1e-14, max_order=4)
    3
    """
    order = order_by_wide_gap(singular_values, floor, max_order)
    if order is not None:
        return order
    values = np.maximum(singular_values, floor)
    ratios = (values[:-1] / values[1:])[:max_order]
    near = np.where(values[1:][:max_order] <= GAP_REACH * floor, ratios, 0.0)
    if np.max(near, initial=0.0) >= CLEAR_GAP:
        return int(np.argmax(near)) + 1
    return int(np.clip(np.sum(singular_values > floor), 1, max_order))


def order_by_wide_gap(singular_values, floor, max_order):
    """Order at a gap of three decades or more, the widest; None if there is none."""
    values = np.maximum(singular_values, floor)
    ratios = (values[:-1] / values[1:])[:max_order]
    return int(np.argmax(ratios)) + 1 if np.max(ratios, initial=0.0) >= WIDE_GAP else None


def state_matrices(U, singular_values, order, n_outputs):
    """A and C of the chosen order by the shift property (Eq. 13).

    Returns
    -------
    A : ndarray, shape (order, order)
    C : ndarray, shape (n_outputs, order)
    """
    observability = U[:, :order] * np.sqrt(singular_values[:order])
    A = linalg.lstsq(observability[:-n_outputs], observability[n_outputs:])[0]
    return A, observability[:n_outputs]


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
        blocks.append(direct.reshape(len(u), n_outputs, -1))
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


def input_matrices(A, C, inputs, outputs, feedthrough, observe=None, *, return_residual=False):
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
    pieces, firsts = _pieces(A, [len(u) for u in inputs])
    inputs = [inputs[s][rows] for s, rows in pieces]
    outputs = [outputs[s][rows] for s, rows in pieces]
    observe = None if observe is None else [observe[s][rows] for s, rows in pieces]
    n_forced = n * m + (n_outputs * m if feedthrough else 0)
    size = n_forced + n * len(inputs)
    R = np.zeros((0, size + 1))
    for s, (u, y) in enumerate(zip(inputs, outputs, strict=True)):
        free, forced = response_regressors(A, C, u, feedthrough)
        if observe is not None:
            free, forced = observe[s] @ free, observe[s] @ forced
        rows = np.zeros((y.size, size + 1))
        rows[:, :n_forced] = forced.reshape(y.size, n_forced)
        rows[:, n_forced + n * s : n_forced + n * (s + 1)] = free.reshape(y.size, n)
        rows[:, -1] = y.reshape(-1)
        R = linalg.qr(np.vstack([R, rows]), mode="r", overwrite_a=True)[0][: size + 1]
    solution = _scaled_lstsq(R[:, :-1], R[:, -1])
    B = solution[: n * m].reshape(n, m)
    D = (
        solution[n * m : n_forced].reshape(n_outputs, m)
        if feedthrough
        else np.zeros((n_outputs, m))
    )
    x0 = solution[n_forced:].reshape(len(inputs), n)[firsts]
    if not return_residual:
        return B, D, x0
    return B, D, x0, float(np.sum((R[:, -1] - R[:, :-1] @ solution) ** 2))


def _pieces(A, lengths):
    """Rows of each segment in pieces over which an unstable A does not overflow.

    Each piece gets an initial state of its own; a stable A leaves segments whole.

    Returns
    -------
    pieces : list of (int, slice)
        Segment and rows.
    firsts : list of int
        The first piece of each segment.
    """
    radius = np.max(np.abs(linalg.eigvals(A)), initial=0.0)
    longest = max(lengths, default=0)
    if radius > 1.0:
        longest = max(2 * len(A), int(MAX_GROWTH / np.log(radius)))
        longest = max(2, min(longest, int(OVERFLOW_GROWTH / np.log(radius))))
    pieces, firsts = [], []
    for s, length in enumerate(lengths):
        firsts.append(len(pieces))
        starts = range(0, length, longest) if length else [0]
        pieces += [(s, slice(start, min(start + longest, length))) for start in starts]
    return pieces, firsts


def _scaled_lstsq(regressors, target):
    """Least squares with columns of equal length, so that units do not decide the rank."""
    if regressors.shape[1] == 0:
        return np.zeros(0)
    scale = np.linalg.norm(regressors, axis=0)
    scale[scale == 0.0] = 1.0
    return linalg.lstsq(regressors / scale, target)[0] / scale
