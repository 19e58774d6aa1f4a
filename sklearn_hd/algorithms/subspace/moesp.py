"""Past-output MOESP subspace identification (Verhaegen, 1994; the paper's section 2.2).

From the triangular factor of [U_f; U_p; Y_p; Y_f] = L Q,

    L_32 = U S Vᵀ      (future outputs on past data, future inputs projected out)
    Γ_i  = U_n S_n^½   (Eq. 13),   C = Γ_i[:l],   Γ_i[:-l] A = Γ_i[l:]

With A and C known, y is linear in B, D and the initial states
(:mod:`~sklearn_hd.algorithms.subspace.input_matrices`).
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import all_above, triangle

__all__ = [
    "noise_floor",
    "observability_subspace",
    "order_by_gap",
    "order_by_wide_gap",
    "release_idle_directions",
    "state_matrices",
]

EPS = np.finfo(float).eps
IDLE_SHARE = 1e-11  # of the largest direction: rounding
GAP_REACH = np.sqrt(10.0)
CLEAR_GAP = 2.0
WIDE_GAP = 1e3


def observability_subspace(R, block_rows, n_inputs):
    """Left singular vectors and singular values of the projected future outputs.

    Parameters
    ----------
    R : ndarray, shape (2 i (m + l), 2 i (m + l))
        From :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`.
    block_rows : int
    n_inputs : int

    Returns
    -------
    U : ndarray, shape (i l, i l)
        The largest entry of each column is positive, whatever way led to R.
    singular_values : ndarray, shape (i l,)
    """
    past = slice(block_rows * n_inputs, R.shape[0] - _future_width(R, block_rows, n_inputs))
    projected = triangle(R[past, past.stop :]).T  # of as many columns as rows
    U, singular_values, _ = np.linalg.svd(projected)
    largest = U[np.argmax(np.abs(U), axis=0), np.arange(U.shape[1])]
    return U * np.copysign(1.0, largest), singular_values


def release_idle_directions(R, n_future_inputs):
    """The factor with nothing projected out that the future inputs do not excite.

    Where inputs excite fewer directions than they have rows, a QR factorisation goes on
    with directions made of rounding, which lie in the very columns in which inputs move:
    projected out, they take the response with them. They are handed on to the past.

    Parameters
    ----------
    R : ndarray, shape (p, p)
        From :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`.
    n_future_inputs : int
        Rows of U_f, i m.

    Returns
    -------
    R : ndarray, shape (p, p)
        Upper block triangular; RᵀR as before, but for what is below rounding in U_f.
    """
    n = n_future_inputs
    if all_above(R[:n, :n], IDLE_SHARE):
        return R
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
        From :func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`.
    block_rows, n_inputs, n_columns : int

    Returns
    -------
    floor : float
    """
    future = _future_width(R, block_rows, n_inputs)
    start = R.shape[0] - future
    past = start - block_rows * n_inputs
    left, noise = n_columns - start, 0.0
    if left >= future:  # else too few columns to see a residual
        sigma = np.linalg.norm(R[start:, start:]) / np.sqrt(future * left)
        noise = sigma * (np.sqrt(future) + np.sqrt(past))
    unit = 10.0 * EPS * np.sqrt(n_columns)
    if noise > unit * np.linalg.norm(R[:, start:]):  # Frobenius, no less than the largest
        return noise
    return max(unit * np.linalg.norm(R[:, start:], 2), noise)


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
    A = np.linalg.lstsq(observability[:-n_outputs], observability[n_outputs:], rcond=EPS)[0]
    return A, observability[:n_outputs]
