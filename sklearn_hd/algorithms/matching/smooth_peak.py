"""Descent in a smooth upper bound of the H∞ norm, tightened on the way.

    f_μ(θ) = min_t  log t − μ Σ_i log det(I − E_iᴴ E_i / t²),   E_i = E(jω_i; θ)

Peaks of nearly the same height are one smooth function there, along whose curved valleys
Newton's steps are long where the linearisation of the single peaks holds for short ones
only. Three things make them longer: each step has a second-order correction, from what E
became beyond its linearisation; steps bend as sinh coordinates do; and from one μ to the
next the descent follows the path of minima. The frequencies ω_i stay while μ does, so
that f_μ is one function; only a peak that moves between them joins.
"""

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from sklearn_hd.algorithms.lti.hinf import tops_between
from sklearn_hd.algorithms.matching.log_det_bound import BoundSlopes, LogDetBound, log_det_value

__all__ = ["SmoothDescent", "smooth_descent"]

_FALL = 0.2  # of μ from one round to the next
_SETTLED = 0.1  # decrease of f, in units of μ, that a Newton step must promise
_LEAST_GAIN = 1e-3  # actual over promised decrease below which a step is refused
_GOOD = 0.9  # from which it needs no correction
_LEAST_RADIUS = 1e-10
_SLIGHT = 1e-5  # share of a singular value in the curvature, of the largest, that is left out
_MISSED = 0.2  # of the distance of a peak from t, by which the points may miss its top


@dataclass(frozen=True, eq=False)
class SmoothDescent:
    """Where :func:`smooth_descent` ended.

    Attributes
    ----------
    theta : ndarray, shape (k,)
        The point of least norm among the ends of the rounds with one μ.
    history : tuple of float
        Norms that were the least so far, the start first.
    ratio : float
        t over the norm in the last round.
    """

    theta: np.ndarray
    history: tuple
    ratio: float

    @property
    def value(self):
        """The least norm."""
        return self.history[-1]


def smooth_descent(problem, theta, *, first=3.0, gap=1e-3, max_iter=150):
    """Parameters of a low H∞ matching error, reached through smooth bounds of it.

    Parameters
    ----------
    problem : MatchingProblem
    theta : ndarray, shape (k,)
        Returned as it is where G_s is unstable or the error zero.
    first : float
        t over the norm where the descent begins; which valley it ends in depends on it.
    gap : float
        Distance of t from the norm, relative, at which to stop.
    max_iter : int
        Largest number of Newton steps.

    Returns
    -------
    descent : SmoothDescent

    References
    ----------
    S. Boyd and L. Vandenberghe, Convex Optimization (2004), section 11.3.
    """
    value, peak = problem.peak(theta)
    best, history = theta, [value]
    if not 0 < value < np.inf:
        return SmoothDescent(best, tuple(history), first)
    point = _Point(problem, problem.curved_steps(theta), theta, problem.sampling(theta, [peak]))
    if point.n_directions == 0:
        return SmoothDescent(best, tuple(history), first)
    mu, radius, n_left = point.bound.weight_for(first), 1.0, max_iter
    while True:
        point, radius, n_steps = _round(point, mu, radius, n_left)
        n_left -= n_steps
        value, peak = problem.peak(point.theta)
        if value < history[-1]:
            best = point.theta
            history.append(value)
        ratio = point.bound.level(mu) / point.bound.top
        if not np.isfinite(value) or ratio <= 1.0 + gap or n_left <= 0:
            return SmoothDescent(best, tuple(history), float(ratio))
        point, length = _followed(point, mu, _FALL * mu)
        point = point.at(point.theta, problem.sampling(point.theta, [peak]))
        mu, radius = _FALL * mu, max(radius, length, 1e-3)


def _round(point, mu, radius, max_steps):
    """Newton steps with one μ: where they end, the region's radius, their number."""
    n_steps = 0
    while n_steps < max_steps:
        n_steps += 1
        slopes = BoundSlopes(point.bound, mu)
        hessian = slopes.hessian + point.curvature(slopes)
        step, promised, solve = _region_step(slopes.gradient, hessian, radius)
        if promised <= _SETTLED * mu or radius < _LEAST_RADIUS:
            break
        before = point.bound.value(mu)
        trial, value = _corrected(point, slopes, mu, step, solve, before - _GOOD * promised)
        gain, length = (before - value) / promised, np.linalg.norm(step)
        if gain < 0.25:
            radius = 0.3 * length
        elif gain > 0.75:
            radius = max(radius, 2.0 * length)
        if gain > _LEAST_GAIN:
            after = point.at(trial).completed(mu)
            if after.n_directions == 0:
                break
            point = after
    return point, radius, n_steps


def _corrected(point, slopes, mu, step, solve, enough):
    """θ after a step, or after its second-order correction if that is lower, and f_μ there.

    E at the trial point is not where its linearisation led; the correction takes the
    difference into account, as if E moved on linearly from there (Maratos, 1978).
    """
    trial = point.moved(step)
    value, error = point.value_at(trial, mu)
    if error is None or value <= enough:
        return trial, value
    further = step + solve(slopes.pull(point.bound.missed(error, step)))
    second = point.moved(further)
    second_value, _ = point.value_at(second, mu)
    return (second, second_value) if second_value < value else (trial, value)


def _followed(point, mu, lower):
    """The point moved along the path of minima to a lower μ, and how far, if f falls there."""
    slopes = BoundSlopes(point.bound, mu)
    values, vectors = np.linalg.eigh(slopes.hessian + point.curvature(slopes))
    if values[0] <= 0:
        return point, 0.0

    def solve(gradient):
        return -vectors @ ((vectors.T @ gradient) / values)

    step = solve((lower - mu) * slopes.drift)
    theta, value = _corrected(point, slopes, lower, step, solve, -np.inf)
    after = point.at(theta) if value < point.bound.value(lower) else point
    if after is point or after.n_directions == 0:
        return point, 0.0
    return after, float(np.linalg.norm(step))


def _region_step(gradient, hessian, radius):
    """Minimiser of gᵀs + ½ sᵀHs within a ball, H of any sign, the decrease, g ↦ s by itself."""
    values, vectors = np.linalg.eigh(hessian)
    g = vectors.T @ gradient
    shift = max(0.0, -values[0] + 1e-14 * np.abs(values).max() + 1e-300)

    def length(shift):
        return np.linalg.norm(g / (values + shift))

    if length(shift) > radius:
        high = shift + 2.0 * np.linalg.norm(g) / radius
        shift = optimize.brentq(lambda at: length(at) - radius, shift, high, rtol=1e-6)
    s = -g / (values + shift)

    def solve(gradient):
        return -vectors @ ((vectors.T @ gradient) / (values + shift))

    return vectors @ s, -(g @ s + 0.5 * s @ (values * s)), solve


class _Point:
    """θ and the bound there, on some frequencies."""

    def __init__(self, problem, steps, theta, frequencies):
        self.problem, self.steps, self.theta = problem, steps, theta
        self.frequencies = frequencies
        error, slope, self.directions = problem.linearised(theta, frequencies)
        self.bound = LogDetBound(error, slope, self.directions)

    @property
    def n_directions(self):
        """How many combinations of parameters the response determines."""
        return self.directions.shape[1]

    def at(self, theta, frequencies=None):
        """Another θ, on the same frequencies or others."""
        frequencies = self.frequencies if frequencies is None else frequencies
        return _Point(self.problem, self.steps, theta, frequencies)

    def completed(self, mu):
        """The same with the tops that the frequencies miss by much of what is left to t."""
        tops, heights, sampled = tops_between(self.frequencies, self.bound.sizes[:, 0])
        left = np.maximum(self.bound.level(mu) - heights, 0.0)
        tops = tops[heights - sampled > _MISSED * left]
        return self.at(self.theta, np.append(self.frequencies, tops)) if len(tops) else self

    def moved(self, step):
        """θ after a step ζ."""
        return self.problem.inside(self.steps.move(self.theta, self.directions @ step))

    def value_at(self, theta, mu):
        """f_μ and E at another θ; infinite and None where G_s is unstable."""
        if self.problem.abscissa(theta) >= 0:
            return np.inf, None
        error = self.problem.error(theta, self.frequencies)
        return log_det_value(np.linalg.svd(error, compute_uv=False), mu), error

    def curvature(self, slopes):
        """What the curvature of E and of the steps adds to the Hessian of f_μ."""
        weights = slopes.weights
        large = weights > _SLIGHT * weights.max()
        here = np.any(large, axis=1)
        left, right = self.bound.vectors(here)
        left = left * (weights * large)[here, :, None]
        bent = self.problem.error_curvature(self.theta, self.frequencies[here], left, right)
        bent += np.diag(slopes.by_parameter * self.steps.bend(self.theta))
        return self.directions.T @ bent @ self.directions
