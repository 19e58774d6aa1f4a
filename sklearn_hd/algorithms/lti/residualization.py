"""Model-order reduction by residualization (Eqs. 16-19).

With the fast states at rest, ẋ_f = 0,

    Â = A_s − A_sf A_f⁻¹ A_fs,    B̂ = B_s − A_sf A_f⁻¹ B_f,
    Ĉ = C_s − C_f A_f⁻¹ A_fs,     D̂ = D − C_f A_f⁻¹ B_f,

and in block-diagonal coordinates, A_sf = A_fs = 0, only D̂ differs from truncation.
The reducer needs it.
"""

import numpy as np
from scipy import linalg


def block_diagonal(A, B, C, slow, fast):
    """Coordinates in which the modes of two groups of eigenvalues do not interact.

    Ordered Schur form, then a Sylvester equation (Bartels and Stewart, 1972).

    Parameters
    ----------
    A, B, C : ndarray, shapes (n, n), (n, m), (l, n)
    slow, fast : complex ndarray
        All eigenvalues of A, in two conjugate-closed groups.

    Returns
    -------
    A, B, C : ndarray
        The same system; its first ``len(slow)`` states hold the slow modes.
    """
    n_slow = len(slow)
    if n_slow in (0, len(A)):
        return A, B, C

    def is_slow(real, imag):
        z = real + 1j * imag
        return np.min(np.abs(z - slow)) < np.min(np.abs(z - fast))

    T, Q, found = linalg.schur(A, output="real", sort=is_slow)
    if found != n_slow:
        raise ValueError(
            "the slow and the fast modes share an eigenvalue to working precision and cannot be "
            "separated; move it to one group"
        )
    coupling = linalg.solve_sylvester(
        T[:n_slow, :n_slow], -T[n_slow:, n_slow:], -T[:n_slow, n_slow:]
    )
    S = np.eye(len(A))
    S[:n_slow, n_slow:] = coupling
    inverse = np.eye(len(A))
    inverse[:n_slow, n_slow:] = -coupling
    return inverse @ T @ S, inverse @ Q.T @ B, C @ Q @ S


def residualize(A, B, C, D, slow, fast):
    """Slow modes of a continuous-time model, the fast ones replaced by their static gain.

    Parameters
    ----------
    A, B, C, D : ndarray
    slow, fast : complex ndarray
        All eigenvalues of A, in two conjugate-closed groups; no fast one is zero.

    Returns
    -------
    A, B, C, D : ndarray

    Examples
    --------
    >>> A, B, C, D = np.diag([-1.0, -50.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))
    >>> reduced = residualize(A, B, C, D, np.array([-1.0]), np.array([-50.0]))
    >>> float(reduced[0][0, 0]), float(reduced[3][0, 0])
    (-1.0, 0.02)
    """
    n = len(slow)
    A, B, C = block_diagonal(A, B, C, np.asarray(slow), np.asarray(fast))
    D = D - C[:, n:] @ linalg.solve(A[n:, n:], B[n:])
    return A[:n, :n], B[:n], C[:, :n], D
