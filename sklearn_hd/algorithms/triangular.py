"""Triangular factors R, RᵀR = XᵀX, of tall matrices: merged, or from the product XᵀX."""

import numpy as np
from scipy import linalg

__all__ = ["safe_cholesky", "triangle"]

EPS = np.finfo(float).eps
TOLERATED_LOSS = 1e-7  # far below what noise does, 1/√n, to as many rows as fit anywhere


def triangle(*stacked):
    """R factor of matrices stacked, some of them perhaps R factors of others.

    Parameters
    ----------
    *stacked : ndarray, shapes (n_s, r)

    Returns
    -------
    R : ndarray, shape (min(Σ n_s, r), r)

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


def safe_cholesky(G, rounding=EPS):
    """R factor from a product XᵀX in double, or None where rounding would be seen in it.

    With columns brought to equal length, rounding of G by ε perturbs them by about ε ‖R⁻¹‖²
    beside each other, squared Frobenius norm.

    Parameters
    ----------
    G : ndarray, shape (r, r)
        The upper triangle is read.
    rounding : float, default=machine epsilon
        Of its entries, beside the lengths of columns.

    Returns
    -------
    R : ndarray, shape (r, r), or None
    """
    size = np.sqrt(np.diagonal(G))
    if not np.all(size > 0.0):
        return None
    scaled = G / size / size[:, None]
    L, fault = linalg.lapack.dpotrf(scaled.T, lower=1, clean=1, overwrite_a=1)
    if fault:
        return None
    inverse, _ = linalg.lapack.dtrtri(L, lower=1)
    return L.T * size if rounding * np.linalg.norm(inverse) ** 2 <= TOLERATED_LOSS else None
