"""The stable matrix nearest to an unstable one, in closed form.

Of all stable A′ the one with the least stationary tr(W (A′ − A) X (A′ − A)ᵀ), X the covariance of
the states that noise of some size gives under A′ (Jongeneel, Sutter and Kuhn, 2023). With states
as little disturbed as need be, it mirrors each unstable eigenvalue λ at the unit circle to 1/λ̄,
and leaves the stable ones, with their modes, as they are:

    A′ = A − W⁻¹ Vᵀ (X + V W⁻¹ Vᵀ)⁻¹ V A,   X = A_u⁻¹ (X + V W⁻¹ Vᵀ) A_u⁻ᵀ,   V A = A_u V

with V the left invariant subspace of the unstable eigenvalues. ``MOESPRegressor(stable=True)``
needs it.
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, TINY

GROWN = 1.0  # e-folds over a segment; fewer may be the error of an integrator's pole
ON_THE_CIRCLE = 1.0 + DEPENDENT  # of an integrator, to within rounding


def growth(A):
    """E-folds a row by which the fastest mode of x[k+1] = A x[k] grows; negative if none does."""
    return float(np.log(max(np.max(np.abs(linalg.eigvals(A)), initial=0.0), TINY)))


def is_stable(A):
    """Whether no mode of x[k+1] = A x[k] grows, beyond rounding."""
    return growth(A) <= np.log(ON_THE_CIRCLE)


def nearest_stable(A, weights):
    """The stable matrix nearest to A.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    weights : ndarray, shape (n,)
        The diagonal of W: how much a change of each next state counts.

    Returns
    -------
    A : ndarray, shape (n, n)
        As given where it is stable.

    References
    ----------
    Jongeneel, Sutter, Kuhn (2023), IEEE Transactions on Automatic Control 68(5), 2790-2804.

    Examples
    --------
    >>> nearest_stable(np.diag([0.5, 1.25]), np.ones(2)).diagonal().tolist()
    [0.5, 0.8]
    """
    if is_stable(A):
        return A
    T, Q, n_unstable = linalg.schur(A.T, sort=lambda re, im: np.hypot(re, im) > ON_THE_CIRCLE)
    V, own = Q[:, :n_unstable].T, T[:n_unstable, :n_unstable].T
    push = V.T / np.maximum(weights, EPS * np.max(weights))[:, None]
    # Z = X + V W⁻¹ Vᵀ in A_u Z − Z A_u⁻ᵀ = A_u V W⁻¹ Vᵀ; near-integrators make it badly scaled
    Z = linalg.solve_sylvester(own, -linalg.inv(own).T, own @ V @ push)
    size = np.sqrt(np.diagonal(Z))
    pull = linalg.solve(Z / np.outer(size, size), (V @ A) / size[:, None], assume_a="pos")
    return A - (push / size) @ pull
