"""Triangular factors R, RᵀR = XᵀX, of tall matrices: merged, or from the product XᵀX."""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS

TOLERATED_LOSS = 1e-7  # far below what noise does, 1/√n, to as many rows as fit anywhere


def triangle(*stacked):
    """R factor of matrices stacked, some of them perhaps R factors of others.

    Of matrices (n_s, r), the factor (min(Σ n_s, r), r).

    Examples
    --------
    >>> R = triangle(np.array([[3.0, 0.0]]), np.array([[4.0, 0.0], [0.0, 2.0]]))
    >>> np.abs(R).round(12).tolist()
    [[5.0, 0.0], [0.0, 2.0]]
    """
    n_columns = stacked[0].shape[1]
    X = np.empty((sum(map(len, stacked)), n_columns), order="F")
    np.concatenate(stacked, out=X)
    if X.size == 0:
        return X[:n_columns]
    n_work = int(linalg.lapack.dgeqrf_lwork(*X.shape)[0])
    return np.triu(linalg.lapack.dgeqrf(X, lwork=n_work, overwrite_a=1)[0][:n_columns])


def safe_cholesky(G, rounding=EPS, overwrite=False):
    """R factor from a product XᵀX in double, or None where rounding would be seen in it.

    With columns brought to equal length, rounding of G by ε perturbs them by about ε ‖R⁻¹‖²
    beside each other, squared Frobenius norm. ε is ``rounding``, relative to the
    lengths of columns. Only the upper triangle of G is read. With ``overwrite``, R may
    take the place of G.
    """
    squares = np.diagonal(G)
    if not np.all(squares > 0.0):  # less than zero by rounding, where columns hold next to nothing
        return None
    size = np.sqrt(squares)
    L, fault = linalg.lapack.dpotrf(G.T, lower=1, clean=1, overwrite_a=overwrite)
    if fault:
        return None
    return L.T if rounding * _inverse_square(L, size) <= TOLERATED_LOSS else None


def _inverse_square(L, size):
    """Squared Frobenius norm of the inverse of a lower triangular L, rows divided by their size.

    To a digit, which will do beside the tolerance: in single precision.
    """
    if not len(L):
        return 0.0
    rows = np.empty(L.shape, np.float32, order="F")
    np.divide(L, size[:, None], out=rows, casting="same_kind")
    inverse, fault = linalg.lapack.strtri(rows, lower=1, overwrite_c=1)
    with np.errstate(over="ignore"):
        return np.inf if fault else float(np.linalg.norm(inverse)) ** 2


def all_above_rounding(R):
    """Whether all singular values surely are more than rounding of the largest.

    By ‖R‖ ‖R⁻¹‖ in Frobenius norms, which takes a tenth of the time of the singular
    values. R is upper triangular. False says that they may be or not.

    Examples
    --------
    >>> all_above_rounding(np.diag([1.0, 1e-3])), all_above_rounding(np.diag([1.0, 1e-13]))
    (True, False)
    """
    if len(R) == 0:
        return True
    inverse, fault = linalg.lapack.dtrtri(R)
    if fault:
        return False
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(DEPENDENT * np.linalg.norm(R) * np.linalg.norm(inverse) < 0.5)


def column_sizes(matrix):
    """Euclidean length of each column, 1 for a column of zeros."""
    sizes = np.linalg.norm(matrix, axis=0)
    return np.where(sizes > 0, sizes, 1.0)


def column_rms(matrix):
    """Root mean square of each column, 1 for a column of zeros."""
    sizes = np.sqrt(np.mean(matrix**2, axis=0))
    return np.where(sizes > 0.0, sizes, 1.0)


def svd_within_rank(matrix, rank=DEPENDENT, largest=None):
    """Singular vectors and values U, s, Vᵀ of a matrix, but for those that are rounding.

    They are left out down to the share ``rank`` of the largest singular value, or of
    ``largest`` if that is given.

    Examples
    --------
    >>> svd_within_rank(np.array([[3.0, 3.0], [4.0, 4.0]]))[1].round(6).tolist()
    [7.071068]
    """
    U, s, Vt = np.linalg.svd(matrix, full_matrices=False)
    kept = s > rank * (np.max(s, initial=0.0) if largest is None else largest)
    return U[:, kept], s[kept], Vt[kept]


def solve_within_rank(X, Y, size=None, cond=DEPENDENT):
    """Least-squares solution of X Z = Y of least norm, columns of X brought to equal length.

    ``size`` holds the lengths of what the columns of X are the rest of, where parts
    were projected out: a column that is nothing but rounding beside them is left out.
    Singular values below the share ``cond`` of the largest count as zero. Y has shape
    (r, q) or (r,).

    Examples
    --------
    >>> solve_within_rank(np.array([[1.0, 1.0], [0.0, 0.0]]), np.array([[2.0], [0.0]])).ravel()
    array([1., 1.])
    """
    if 0 in (X.shape[1], *Y.shape[1:]):
        return np.zeros((X.shape[1], *Y.shape[1:]))
    size = column_sizes(X) if size is None else np.where(size > 0.0, size, 1.0)
    return linalg.lstsq(X / size, Y, cond=cond)[0] / size.reshape(-1, *(1,) * (Y.ndim - 1))
