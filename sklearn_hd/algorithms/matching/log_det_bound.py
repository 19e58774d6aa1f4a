"""A smooth upper bound of the largest singular value among several matrices.

    f_μ(E) = min_t  log t − μ Σ_i log det(I − E_iᴴ E_i / t²)

t lies above every σ_max(E_i), by less and less as μ falls: f_μ goes from the logarithm of
the root of Σ |E_i|² (μ → ∞) to that of the largest singular value (μ → 0).

With E = U Σ Vᴴ, x = σ / t, D = Uᴴ (∂E/∂ζ) V / t, a = 1 / (1 − x²) (1 in rows and columns
without σ), b = x a and E linear in ζ, the sum B = −Σ_i log det has, at the t for which
μ Σ 2 x b = 1,

    ∂B/∂ζ_k = 2 Σ_j b_j Re D_jj,k,      ∂²B/∂ζ_k∂log t = −4 Σ_j a_j b_j Re D_jj,k
    ∂²B/∂ζ_k∂ζ_m = 2 Σ_ij a_i a_j Re(D̄_ij,k D_ij,m) + b_i b_j Re(D_ij,k D_ji,m)
    ∂²B/∂(log t)² = 4 Σ_j b_j²
"""

from functools import cached_property

import numpy as np
from scipy import optimize


class LogDetBound:
    """f_μ of matrices E_i, and of what they become when they move.

    Parameters
    ----------
    error : complex ndarray, shape (n_points, l, m)
        E_i.
    slope : complex ndarray, shape (n_points, l, m, k)
        ∂E_i/∂θ.
    directions : ndarray, shape (k, n_directions)
        M of θ → θ + M ζ.

    Attributes
    ----------
    sizes : ndarray, shape (n_points, min(l, m))
        Singular values, largest first.
    top : float
        The largest one.
    """

    def __init__(self, error, slope, directions):
        self._left, self.sizes, adjoint = np.linalg.svd(error)
        self._right = adjoint.conj().swapaxes(1, 2)
        self.top = self.sizes.max()
        n_points, n_rows, n_columns, k = slope.shape
        turned = slope.reshape(n_points, n_rows, n_columns * k)
        turned = self._left.conj().swapaxes(1, 2) @ turned
        turned = adjoint.conj()[:, None] @ turned.reshape(n_points, n_rows, n_columns, k)
        n = self.sizes.shape[1]
        self.own_slope = turned[:, range(n), range(n)].real
        self.slope = turned @ directions

    def weight_for(self, ratio):
        """μ for which t is so many times the largest singular value."""
        square = (self.sizes / (ratio * self.top)) ** 2
        return 1.0 / np.sum(2.0 * square / (1.0 - square))

    def level(self, mu):
        """t."""
        return _level(self.sizes, mu)

    def value(self, mu):
        """f_μ."""
        return log_det_value(self.sizes, mu)

    def vectors(self, here):
        """Left and right singular vectors of some E_i, shapes (n, min(l, m), l or m)."""
        n = self.sizes.shape[1]
        return (side[here, :, :n].swapaxes(1, 2) for side in (self._left, self._right))

    def missed(self, error, step):
        """What E became beyond its linearisation, in the coordinates of U and V."""
        moved = self._left.conj().swapaxes(1, 2) @ error @ self._right
        n = self.sizes.shape[1]
        moved[:, range(n), range(n)] -= self.sizes
        return moved - self.slope @ step


class BoundSlopes:
    """Derivatives of f_μ for one μ, E linear in ζ.

    Attributes
    ----------
    gradient : ndarray, shape (n_directions,)
    hessian : ndarray, shape (n_directions, n_directions)
    by_parameter : ndarray, shape (k,)
        ∂f_μ/∂θ.
    weights : ndarray, shape (n_points, min(l, m))
        ∂f_μ/∂σ.
    """

    def __init__(self, bound, mu):
        self._mu, self._level = mu, bound.level(mu)
        self._D, x = bound.slope / self._level, bound.sizes / self._level
        self._a = 1.0 / (1.0 - x**2)
        self._b = x * self._a
        self.weights = 2.0 * mu * self._b / self._level
        self.gradient = 2.0 * mu * np.einsum("fj,fjk->k", self._b, self._diagonal(self._D))
        self.by_parameter = np.einsum("fj,fjk->k", self.weights, bound.own_slope)
        self._with_level = self._toward_level(self._D)
        self._level_alone = 4.0 * np.sum(self._b**2)

    @staticmethod
    def _diagonal(moved):
        n = range(min(moved.shape[1:3]))
        return moved[:, n, n].real

    def _toward_level(self, moved):
        """∂/∂log t of the slope of B along movements of E / t."""
        return -4.0 * np.einsum("fj,fj...->...", self._b * self._a, self._diagonal(moved))

    @cached_property
    def _factors(self):
        """√(a_i a_j), a = 1 where σ is missing, shape (n_points, l, m)."""
        (n_points, n_rows, n_columns), n = self._D.shape[:3], self._a.shape[1]
        rows, columns = np.ones((n_points, n_rows)), np.ones((n_points, n_columns))
        rows[:, :n], columns[:, :n] = self._a, self._a
        return np.sqrt(rows[:, :, None] * columns[:, None])

    @property
    def hessian(self):
        n, k = self._a.shape[1], self._D.shape[3]
        sized = (self._factors[..., None] * self._D).reshape(-1, k)
        square, b = self._D[:, :n, :n], self._b
        crossed = ((b[:, :, None] * b[:, None])[..., None] * square).reshape(-1, k)
        square = square.swapaxes(1, 2).reshape(-1, k)
        hessian = sized.real.T @ sized.real + sized.imag.T @ sized.imag
        hessian += crossed.real.T @ square.real - crossed.imag.T @ square.imag
        hessian = 2.0 * hessian - np.outer(self._with_level, self._with_level) / self._level_alone
        return self._mu * hessian

    def pull(self, moved):
        """What a movement of E, in the coordinates of U and V, adds to the gradient."""
        moved, n, b = moved / self._level, self._a.shape[1], self._b
        pull = 2.0 * np.einsum("fijk,fij->k", self._D.conj(), self._factors**2 * moved).real
        crossed = b[:, :, None] * b[:, None] * moved[:, :n, :n].swapaxes(1, 2)
        pull += 2.0 * np.einsum("fijk,fij->k", self._D[:, :n, :n], crossed).real
        pull -= self._with_level * self._toward_level(moved) / self._level_alone
        return self._mu * pull

    @property
    def drift(self):
        """∂/∂μ of the gradient, with E as it is."""
        return (self.gradient + self._with_level / self._level_alone) / self._mu


def log_det_value(sizes, mu):
    """f_μ of matrices with some singular values, shape (n_points, n)."""
    if not sizes.any():
        return -np.inf
    t = _level(sizes, mu)
    return np.log(t) - mu * np.sum(np.log1p(-((sizes / t) ** 2)))


def _level(sizes, mu):
    """The t at which μ Σ 2 x² / (1 − x²) = 1."""
    top = sizes.max()
    square = (sizes / top) ** 2
    below = 1.0 - square

    def surplus(log_excess):
        excess = np.exp(log_excess)  # t / top − 1
        return np.log(mu * np.sum(2.0 * square / (excess * (2.0 + excess) + below)))

    return top * (1.0 + np.exp(optimize.brentq(surplus, -60.0, 60.0, xtol=1e-13)))
