"""Floquet exponents from the transition matrices of parts of a period.

The multipliers of Φ = Φ_p … Φ_2 Φ_1 may span more decades than a product holds:
beside one of size 1, rounding leaves nothing of one of size 1e-60. Orthogonal
bases Q_k carried through the factors, Φ_k Q_{k−1} = Q_k R_k with R_k upper
triangular, split the product without forming it. Once the last basis spans what the
first one did, column by column or block by block,

    Φ Q_0 = Q_0 (Q_0ᵀ Q_p) R_p … R_1

is block triangular, and each block's multipliers follow from its own small factors,
whose sizes are summed as logarithms. (SLICOT's periodic Schur form, MB03WD, was
tried first: its eigenvalues are those of the rounded product, and of 16 factors with
multipliers 1 and 1e-18, its triangular factors gave 0.012 and 1e-18.)
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.periodic.floquet import on_branch, state_units, transition_matrices

__all__ = ["floquet_exponents", "product_logarithms"]

ROTATION = 2.0  # ∫‖F‖ dt of one factor: its condition stays below e⁴
MIN_FACTORS, MAX_FACTORS = 32, 8192
MAX_SWEEPS = 60  # multipliers whose ratio is below 0.5 part in 50
SPLIT = 1e-13  # what couples two blocks that have parted
WIDE = 1e-3  # ratio of multipliers in one block below which sweeps go on


def floquet_exponents(F, omega, *, tolerance=1e-14):
    """Floquet exponents λ of ẋ = F(ψ) x, however far apart.

    Parameters
    ----------
    F : callable
        ψ of shape (n_points,) -> (n_points, n, n), in 1/s.
    omega : float
        Fundamental frequency, rad/s.
    tolerance : float, default=1e-14
        As for :func:`~sklearn_hd.algorithms.periodic.floquet.transition_matrices`.

    Returns
    -------
    exponents : complex ndarray, shape (n,)
        In 1/s, with imaginary part in (−ω/2, ω/2], from the rightmost leftwards,
        conjugate pairs with the negative imaginary part first.

    References
    ----------
    A. Bojanczyk, G. Golub, P. Van Dooren, "The periodic Schur decomposition:
    algorithms and applications", Proc. SPIE 1770 (1992); L. Dieci, R. D. Russell,
    E. S. Van Vleck, "On the computation of Lyapunov exponents for continuous
    dynamical systems", SIAM J. Numer. Anal. 34 (1997).

    Examples
    --------
    Multipliers e^{−1} and e^{−200}, which is 1e-87:

    >>> def F(psi):
    ...     return np.diag([-1.0, -200.0]) + 5.0 * np.sin(psi)[:, None, None] * [[0, 1], [0, 0]]
    >>> floquet_exponents(F, 2 * np.pi).real.round(9).tolist()
    [-1.0, -200.0]
    """
    period = 2.0 * np.pi / omega
    units = state_units(F)
    values = F(np.linspace(0.0, 2.0 * np.pi, 256, endpoint=False))
    size = np.max(np.linalg.norm(values * (units / units[:, None]), axis=(1, 2)), initial=0.0)
    n_factors = int(np.clip(np.ceil(size * period / ROTATION), MIN_FACTORS, MAX_FACTORS))
    psi = np.linspace(0.0, 2.0 * np.pi, n_factors + 1)
    factors, _ = transition_matrices(F, None, psi, omega, tolerance=tolerance)
    return on_branch(product_logarithms(factors * (units / units[:, None])) / period, omega)


def product_logarithms(factors):
    """Logarithms of the eigenvalues of Φ_p … Φ_2 Φ_1, the product not formed.

    Parameters
    ----------
    factors : ndarray, shape (p, n, n)
        Φ_1 first; nonsingular, each well enough conditioned to be inverted.

    Returns
    -------
    logarithms : complex ndarray, shape (n,)
        With imaginary part in [−π, π]; conjugate where the eigenvalues are.

    Examples
    --------
    >>> factors = np.tile(np.diag([1.0, 1e-20]), (50, 1, 1))
    >>> (np.sort(product_logarithms(factors).real) / np.log(10)).round(9).tolist()
    [-1000.0, 0.0]
    """
    n = factors.shape[1]
    start = linalg.qr(np.random.default_rng(0).standard_normal((n, n)))[0]  # in no one's favour
    tolerance = max(SPLIT, 2.0 * len(factors) * np.finfo(float).eps)
    for _ in range(MAX_SWEEPS):
        end, triangles = _carry(factors, start)
        closing = start.T @ end
        blocks = _blocks(closing, tolerance)
        logarithms = [_block_logarithms(closing, triangles, block) for block in blocks]
        if all(np.ptp(block.real) <= -np.log(WIDE) for block in logarithms):
            break
        start = end
    return np.concatenate(logarithms) if logarithms else np.empty(0, dtype=complex)


def _carry(factors, start):
    """Basis after all factors, and the triangular factors on the way."""
    Q, triangles = start, np.empty(factors.shape)
    for k, factor in enumerate(factors):
        Q, triangles[k] = np.linalg.qr(factor @ Q)
    return Q, triangles


def _blocks(closing, tolerance):
    """Slices of columns that span the same before and after."""
    n = len(closing)
    ends = [k for k in range(1, n) if np.max(np.abs(closing[k:, :k])) <= tolerance]
    return [slice(*pair) for pair in zip([0, *ends], [*ends, n], strict=True) if n]


def _block_logarithms(closing, triangles, block):
    """Logarithms of the eigenvalues of one diagonal block, scaled factor by factor."""
    product, scale = np.eye(block.stop - block.start), 0.0
    for factor in triangles[:, block, block]:
        product = factor @ product
        size = np.max(np.abs(product))
        product, scale = product / size, scale + np.log(size)
    with np.errstate(divide="ignore"):  # what rounding has cancelled parts in a later sweep
        return np.log(linalg.eigvals(closing[block, block] @ product).astype(complex)) + scale
