"""Descent in a smooth upper bound of the H∞ norm, tightened on the way.

    f_μ(θ) = min_t  log t − μ Σ_i log det(I − E_iᴴ E_i / t²),   E_i = E(jω_i; θ)

t lies above every σ_max(E_i), by less and less as μ falls: f_μ goes from the logarithm of
the root of Σ |E_i|² (μ → ∞) to that of the norm (μ → 0). Peaks of nearly the same height
are one smooth function there, along whose curved valleys Newton's steps are long where
the linearisation of the single peaks holds for short ones only.

With E = U Σ Vᴴ, x = σ / t, D = Uᴴ (∂E/∂θ) V / t, a = 1 / (1 − x²) and b = x a the barrier has

    ∂/∂θ = 2 Σ_j b_j Re D_jj
    ∂²/∂θ² = 2 Σ_ij a_i a_j |D_ij|² + b_i b_j Re D_ij D_ji,  plus 2 Σ_j b_j Re(u_jᴴ ∂²E/∂θ² v_j) / t
"""

import numpy as np
from scipy import optimize

__all__ = ["smooth_descent"]

_FALL = 0.2  # of μ from one round to the next
_SETTLED = 0.1  # decrease of f, in units of μ, that a Newton step must promise
_ROUND = 20  # largest number of steps with one μ
_LEAST_GAIN = 1e-3  # actual over promised decrease below which a step is refused
_LEAST_RADIUS = 1e-10
_SLIGHT = 1e-5  # share of a singular value in the curvature, of the largest, that is left out


def smooth_descent(problem, theta, *, first=3.0, gap=1e-3, max_iter=150):
    """Parameters of a low H∞ matching error, reached through smooth bounds of it.

    Parameters
    ----------
    problem : MatchingProblem
    theta : ndarray, shape (k,)
        Stable.
    first : float
        t over the norm where the descent begins; which valley it ends in depends on it.
    gap : float
        Distance of t from the norm, relative, at which to stop.
    max_iter : int
        Largest number of Newton steps.

    Returns
    -------
    theta : ndarray, shape (k,)
        The point of least norm among the ends of the rounds with one μ.
    history : tuple of float
        Norms that were the least so far, the start first.

    References
    ----------
    S. Boyd and L. Vandenberghe, Convex Optimization (2004), section 11.3.
    """
    value, peak = problem.peak(theta)
    best, history = theta, [value]
    state = _Bound(problem, theta, peak)
    if value == 0 or state.n_directions == 0:
        return best, tuple(history)
    mu, radius, left = state.weight_for(first), 1.0, max_iter
    while left > 0:
        state, radius, n_steps = _round(state, mu, radius, peak, min(_ROUND, left))
        left -= n_steps
        value, peak = problem.peak(state.theta)
        if value < history[-1]:
            best = state.theta
            history.append(value)
        if not np.isfinite(value) or state.level(mu) <= (1.0 + gap) * state.top:
            break
        mu, radius = _FALL * mu, max(radius, 1e-3)
    return best, tuple(history)


def _round(state, mu, radius, peak, max_steps):
    """Newton steps with one μ: where they end, the region's radius, their number."""
    n_steps = 0
    while n_steps < max_steps:
        n_steps += 1
        gradient, hessian = state.slopes(mu)
        step, promised = _region_step(gradient, hessian, radius)
        if promised <= _SETTLED * mu or radius < _LEAST_RADIUS:
            break
        trial = state.problem.inside(state.theta + state.directions @ step)
        gain = (state.value(mu) - state.value_at(trial, mu)) / promised
        if gain < 0.25:
            radius = 0.3 * np.linalg.norm(step)
        elif gain > 0.75:
            radius = max(radius, 2.0 * np.linalg.norm(step))
        if gain > _LEAST_GAIN:
            after = _Bound(state.problem, trial, peak)
            if after.n_directions < state.n_directions:  # parameters on their way to infinity
                radius = 0.3 * np.linalg.norm(step)
            else:
                state = after
    return state, radius, n_steps


def _region_step(gradient, hessian, radius):
    """Minimiser of gᵀs + ½ sᵀHs within a ball, H of any sign, and the decrease."""
    values, vectors = np.linalg.eigh(hessian)
    g = vectors.T @ gradient
    shift = max(0.0, -values[0] + 1e-14 * np.abs(values).max() + 1e-300)

    def length(shift):
        return np.linalg.norm(g / (values + shift))

    if length(shift) > radius:
        high = shift + 2.0 * np.linalg.norm(g) / radius
        shift = optimize.brentq(lambda at: length(at) - radius, shift, high, rtol=1e-6)
    s = -g / (values + shift)
    return vectors @ s, -(g @ s + 0.5 * s @ (values * s))


class _Bound:
    """f_μ at some θ, its slopes along the problem's directions."""

    def __init__(self, problem, theta, peak):
        self.problem, self.theta = problem, theta
        self.frequencies, error, slope, self.directions = problem.linearised(theta, [peak])
        self._left, self._sizes, adjoint = np.linalg.svd(error)
        self._right = adjoint.conj().swapaxes(1, 2)
        n_points, n_rows, n_columns, k = slope.shape
        turned = slope.reshape(n_points, n_rows, n_columns * k)
        turned = self._left.conj().swapaxes(1, 2) @ turned
        turned = adjoint.conj()[:, None] @ turned.reshape(n_points, n_rows, n_columns, k)
        self._slope = turned @ self.directions
        self.top = self._sizes.max()

    @property
    def n_directions(self):
        """How many combinations of parameters the response determines."""
        return self.directions.shape[1]

    def weight_for(self, ratio):
        """μ for which t is so many times the norm."""
        square = (self._sizes / (ratio * self.top)) ** 2
        return 1.0 / np.sum(2.0 * square / (1.0 - square))

    def level(self, mu):
        """t."""
        return _level(self._sizes, mu)

    def value(self, mu):
        """f_μ."""
        return _value(self._sizes, mu)

    def value_at(self, theta, mu):
        """f_μ at another θ, on the same frequencies; infinite where G_s is unstable."""
        if self.problem.abscissa(theta) >= 0:
            return np.inf
        return _value(self.problem.singular_values(theta, self.frequencies), mu)

    def slopes(self, mu):
        """Gradient and Hessian of f_μ."""
        t = self.level(mu)
        D, x = self._slope / t, self._sizes / t
        a = 1.0 / (1.0 - x**2)
        b, n = x * a, x.shape[1]
        diagonal = D[:, range(n), range(n)].real
        gradient = 2.0 * np.einsum("fj,fjk->k", b, diagonal)
        with_level = -4.0 * np.einsum("fj,fjk->k", b * a, diagonal)
        level_alone = 4.0 * np.sum(b**2)
        hessian = _log_det_hessian(D, a, b) + self._bent(2.0 * b / t)
        hessian -= np.outer(with_level, with_level) / level_alone
        return mu * gradient, 0.5 * mu * (hessian + hessian.T)

    def _bent(self, weights):
        """Σ weights · Re(u_jᴴ ∂²E/∂θ² v_j)."""
        large = weights > _SLIGHT * weights.max()
        here, n = np.any(large, axis=1), weights.shape[1]
        left = self._left[here, :, :n].swapaxes(1, 2) * (weights * large)[here, :, None]
        frequencies, right = self.frequencies[here], self._right[here, :, :n].swapaxes(1, 2)
        curvature = self.problem.error_curvature(self.theta, frequencies, left, right)
        return self.directions.T @ curvature @ self.directions


def _log_det_hessian(D, a, b):
    """2 Σ_ij a_i a_j |D_ij|² + b_i b_j Re D_ij D_ji, with a = 1 where σ is missing."""
    n_points, n_rows, n_columns, k = D.shape
    n = a.shape[1]
    rows, columns = np.ones((n_points, n_rows)), np.ones((n_points, n_columns))
    rows[:, :n], columns[:, :n] = a, a
    sized = np.sqrt(rows[:, :, None] * columns[:, None])[..., None] * D
    sized = sized.reshape(-1, k)
    square = D[:, :n, :n]
    crossed = ((b[:, :, None] * b[:, None])[..., None] * square).reshape(-1, k)
    square = square.swapaxes(1, 2).reshape(-1, k)
    own = sized.real.T @ sized.real + sized.imag.T @ sized.imag
    return 2.0 * (own + crossed.real.T @ square.real - crossed.imag.T @ square.imag)


def _level(sizes, mu):
    """The t at which μ Σ 2 x² / (1 − x²) = 1."""
    top = sizes.max()
    square = (sizes / top) ** 2
    below = 1.0 - square

    def surplus(log_excess):
        excess = np.exp(log_excess)  # t / top − 1
        return np.log(mu * np.sum(2.0 * square / (excess * (2.0 + excess) + below)))

    return top * (1.0 + np.exp(optimize.brentq(surplus, -60.0, 60.0, xtol=1e-13)))


def _value(sizes, mu):
    if not sizes.any():
        return -np.inf
    t = _level(sizes, mu)
    return np.log(t) - mu * np.sum(np.log1p(-((sizes / t) ** 2)))
