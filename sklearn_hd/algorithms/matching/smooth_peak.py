"""Descent to the least H∞ norm of a matching error, through smooth bounds of it.

    f_μ(θ) = min_t  log t − μ Σ_i log det(I − E_iᴴ E_i / t²) − μ Σ_k log (u_k − θ_k) (θ_k − l_k)

with E_i = E(jω_i; θ). As μ falls t comes down on the norm, and θ, kept within its bounds by
the last term, to a point where no direction lowers it. Peaks of nearly the same height are
one smooth function there, along whose curved valleys Newton's steps are long where the
linearisation of the single peaks holds for short ones only. Three things make them longer:
each step has a second-order correction, from what E became beyond its linearisation; steps
bend as sinh coordinates do, θ = w sinh z, so that parameters far beyond their scale w move
by factors; and from one μ to the next the descent follows the path of minima. The
frequencies ω_i stay while μ does, so that f_μ is one function; only a peak that moves
between them joins.

The derivatives of f_μ by the singular values are the weights of the peaks' gradients: where
f_μ is stationary they certify, with no program to be solved, how much the norm could still
fall. Matches in the H∞ norm end here.

A smooth upper bound of the largest singular value among several matrices.

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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import optimize

from sklearn_hd.algorithms.lti.hinf import tops_between

GAP = 2e-5  # of t from the norm: its minima then lie within 1e-4 or so of the least norm
_FALL = 0.2  # of μ from one round to the next
_SETTLED = 1e-2  # decrease of f, in units of μ, that a Newton step must promise; certificates
# are 1e-4 to 1e-3 with it, 1e-2 with a tenth
_LEAST_GAIN = 1e-3  # actual over promised decrease below which a step is refused
_GOOD = 0.9  # from which it needs no correction
_SLIGHT = 1e-5  # share of a singular value in the curvature, of the largest, that is left out
_MISSED = 0.2  # of the distance of a peak from t, by which the points may miss its top
_FARTHEST = 3.0  # change of z in one step: a factor of 20
_TO_WALL = 0.9  # of the way to a bound that one step may go
_OFF_WALL = 1e-2  # distance from bounds to begin with, in scales of θ
_TOUCHED = 1e-3  # from which a parameter ends on its bound, if the norm allows
_LEAST_WEIGHT = 1e-3  # of a peak that counts: the bound weighs all points, most of them little


class LogDetBound:
    """f_μ of matrices E_i, and of what they become when they move.

    ``error`` (n_points, l, m) has E_i, ``slope`` (n_points, l, m, k) has ∂E_i/∂θ, and
    ``directions`` (k, n_directions) is M of θ → θ + M ζ. ``sizes``
    (n_points, min(l, m)) are singular values, largest first, and ``top`` is the largest
    one of all.
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

    ``gradient`` and ``hessian`` are by ζ. ``by_parameter`` (k,) is ∂f_μ/∂θ, and
    ``weights`` (n_points, min(l, m)) are ∂f_μ/∂σ.
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


@dataclass(frozen=True, eq=False)
class Certificate:
    """First-order conditions of a least H∞ norm."""

    frequencies: np.ndarray  # (n_active,): rad/s, of the peaks that hold the norm where it is
    errors: np.ndarray  # (n_active,): σ_max(E) there
    # (n_active,): of their gradients in the convex combination nearest to zero; they sum to 1
    weights: np.ndarray
    # upper bound of the decrease, relative to the norm, that the linearised response allows within
    # one move of it as long as the residual. 0 at a stationary point.
    predicted_decrease: float


@dataclass(frozen=True, eq=False)
class SmoothDescent:
    """Where :func:`smooth_descent` ended."""

    theta: np.ndarray  # (k,): the point of least norm among the ends of the rounds with one μ
    history: tuple  # of float: norms that were the least so far, the start first
    ratio: float  # t over the norm in the last round
    certificate: Certificate | None = None  # None where there was nothing to descend
    n_iter: int = 0  # Newton steps

    @property
    def value(self):
        """The least norm."""
        return self.history[-1]

    @property
    def predicted_decrease(self):
        """By how much, relative to itself, the norm could still fall; infinite if not known."""
        return np.inf if self.certificate is None else self.certificate.predicted_decrease

    def further(self, problem, max_iter):
        """The same down to the last bound."""
        rest = smooth_descent(problem, self.theta, first=self.ratio, max_iter=max_iter)
        history, n_iter = self.history + rest.history[1:], self.n_iter + rest.n_iter
        return replace(rest, history=history, n_iter=n_iter)


def smooth_descent(problem, theta, *, first=3.0, gap=GAP, max_iter=150):
    """SmoothDescent to parameters of a low H∞ matching error, through smooth bounds of it.

    It leaves θ as it is where G_s is unstable or the error zero. ``first`` is t over
    the norm where the descent begins; which valley it ends in depends on it. The
    descent stops at a relative distance ``gap`` of t from the norm, or after
    ``max_iter`` Newton steps.

    References
    ----------
    S. Boyd and L. Vandenberghe, Convex Optimization (2004), section 11.3.
    """
    value, peak = problem.peak(theta)
    best, history = theta, [value]
    if not 0 < value < np.inf:
        return SmoothDescent(best, tuple(history), first)
    walls = _Walls(problem, theta)
    theta = walls.off(theta)
    point = _Point(problem, walls, theta, problem.sampling(theta, [peak]))
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
            break
        point, length = _followed(point, mu, _FALL * mu)
        point = point.at(point.theta, problem.sampling(point.theta, [peak]))
        mu, radius = _FALL * mu, max(radius, length, 1e-3)
    point = _polished(point, mu)
    for theta in (point.theta, point.at_the_end_of_the_path(mu)):
        value = problem.peak(theta)[0]
        if value < history[-1]:
            best = theta
            history.append(value)
    certificate = point.certificate(mu, history[-1])
    held = walls.on(best)
    value = problem.peak(held)[0]
    if value <= (1.0 + gap) * history[-1]:
        best = held
        history += [value] if value < history[-1] else []
    return SmoothDescent(best, tuple(history), float(ratio), certificate, max_iter - n_left)


def _round(point, mu, radius, max_steps):
    """Newton steps with one μ: where they end, the region's radius, their number."""
    n_steps = 0
    while n_steps < max_steps:
        n_steps += 1
        slopes = point.slopes(mu)
        step, promised, solve = _region_step(slopes.gradient, slopes.hessian, radius)
        if promised <= _SETTLED * mu or radius < 1e-10:
            break
        before = point.value(mu)
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
    further = step + solve(slopes.bound.pull(point.bound.missed(error, step)))
    second = point.moved(further)
    second_value, _ = point.value_at(second, mu)
    return (second, second_value) if second_value < value else (trial, value)


def _followed(point, mu, lower):
    """The point moved along the path of minima to a lower μ, and how far, if f falls there."""
    slopes = point.slopes(mu)
    values, vectors = np.linalg.eigh(slopes.hessian)
    if values[0] <= 0:
        return point, 0.0

    def solve(gradient):
        return -vectors @ ((vectors.T @ gradient) / values)

    step = solve((lower - mu) * slopes.drift)
    theta, value = _corrected(point, slopes, lower, step, solve, -np.inf)
    after = point.at(theta) if value < point.value(lower) else point
    if after is point or after.n_directions == 0:
        return point, 0.0
    return after, float(np.linalg.norm(step))


def _polished(point, mu):
    """The point after Newton's steps, as long as the gradient falls: the certificate's last digits.

    f_μ itself is too coarse there to tell one step from the next.
    """
    slopes = point.slopes(mu)
    for _ in range(8):  # Newton steps, which converge quadratically
        values, vectors = np.linalg.eigh(slopes.hessian)
        if values[0] <= 0:
            return point
        step = -vectors @ ((vectors.T @ slopes.gradient) / values)
        theta = point.moved(step)
        if not np.isfinite(point.value_at(theta, mu)[0]):
            return point
        after = point.at(theta)
        if after.n_directions < point.n_directions:
            return point
        further = after.slopes(mu)
        if not np.linalg.norm(further.gradient) < np.linalg.norm(slopes.gradient):
            return point
        point, slopes = after, further
    return point


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


class _Walls:
    """Bounds of θ as barriers, and the scales w of the curves along which steps go."""

    def __init__(self, problem, theta):
        self.lower, self.upper = problem.lower, problem.upper
        self.scale = problem.moving_scales(theta)
        self.width = np.minimum(self.upper - self.lower, self.scale)

    def off(self, theta):
        """The parameters moved a hundredth of their scale off their bounds."""
        return np.clip(
            theta, self.lower + _OFF_WALL * self.width, self.upper - _OFF_WALL * self.width
        )

    def on(self, theta):
        """Those that nearly touch a bound on it."""
        near = _TOUCHED * self.width
        theta = np.where(theta - self.lower <= near, self.lower, theta)
        return np.where(self.upper - theta <= near, self.upper, theta)

    def move(self, theta, step):
        """Where a step ends that leaves θ with the velocity ``step``, after time one."""
        z, speed = np.arcsinh(theta / self.scale), np.hypot(theta, self.scale)
        end = self.scale * np.sinh(z + np.clip(step / speed, -_FARTHEST, _FARTHEST))
        lower = theta - _TO_WALL * (theta - self.lower)
        return np.clip(end, lower, theta + _TO_WALL * (self.upper - theta))

    def bend(self, theta):
        """d²θ/ds² along these curves for dθ/ds = 1."""
        return theta / (theta**2 + self.scale**2)

    def value(self, theta):
        """−Σ log of the distances from bounds, in scales."""
        apart = np.concatenate([theta - self.lower, self.upper - theta]) / np.tile(self.scale, 2)
        return -np.sum(np.log(apart[np.isfinite(apart)]))

    def slopes(self, theta):
        """First and second derivatives of that by each parameter."""
        below, above = 1.0 / (theta - self.lower), 1.0 / (self.upper - theta)
        return above - below, above**2 + below**2


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Derivatives of f_μ with the barrier of the bounds."""

    bound: BoundSlopes
    gradient: np.ndarray
    hessian: np.ndarray
    drift: np.ndarray


class _Point:
    """θ and the bound there, on some frequencies."""

    def __init__(self, problem, walls, theta, frequencies):
        self.problem, self.walls, self.theta = problem, walls, theta
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
        return _Point(self.problem, self.walls, theta, frequencies)

    def completed(self, mu):
        """The same with the tops that the frequencies miss by much of what is left to t."""
        tops, heights, sampled = tops_between(self.frequencies, self.bound.sizes[:, 0])
        left = np.maximum(self.bound.level(mu) - heights, 0.0)
        tops = tops[heights - sampled > _MISSED * left]
        return self.at(self.theta, np.append(self.frequencies, tops)) if len(tops) else self

    def moved(self, step):
        """θ after a step ζ."""
        return self.walls.move(self.theta, self.directions @ step)

    def value(self, mu):
        """f_μ."""
        return self.bound.value(mu) + mu * self.walls.value(self.theta)

    def value_at(self, theta, mu):
        """f_μ and E at another θ; infinite and None where G_s is unstable."""
        if self.problem.abscissa(theta) >= 0:
            return np.inf, None
        error = self.problem.error(theta, self.frequencies)
        value = log_det_value(np.linalg.svd(error, compute_uv=False), mu)
        return value + mu * self.walls.value(theta), error

    def slopes(self, mu):
        """Derivatives of f_μ by ζ, the curvature of E and of the steps among them."""
        bound = BoundSlopes(self.bound, mu)
        push, stiffness = self.walls.slopes(self.theta)
        large = bound.weights > _SLIGHT * bound.weights.max()
        here = np.any(large, axis=1)
        left, right = self.bound.vectors(here)
        left = left * (bound.weights * large)[here, :, None]
        bent = self.problem.error_curvature(self.theta, self.frequencies[here], left, right)
        by_parameter = (bound.by_parameter + mu * push) * self.walls.bend(self.theta)
        bent += np.diag(by_parameter + mu * stiffness)
        M = self.directions
        gradient = bound.gradient + mu * (M.T @ push)
        return _Slopes(bound, gradient, bound.hessian + M.T @ bent @ M, bound.drift + M.T @ push)

    def at_the_end_of_the_path(self, mu):
        """Where the path of minima leads as μ goes to zero, by its tangent."""
        slopes = self.slopes(mu)
        step = mu * np.linalg.lstsq(slopes.hessian, slopes.drift, rcond=None)[0]
        return self.moved(step)

    def certificate(self, mu, value):
        """What the weights of the singular values say of the linearised response.

        Σ w_ij σ_ij = 1, so that max_i σ_max(E_i + S_i ζ) ≥ (1 − μ n_walls − |∂f_μ/∂ζ|) / Σ w_ij
        for |ζ| ≤ 1.
        """
        slopes = self.slopes(mu)
        total, rise = slopes.bound.weights.sum(), np.linalg.norm(slopes.gradient)
        n_walls = np.isfinite([self.walls.lower, self.walls.upper]).sum()
        floor = (1.0 - mu * n_walls - rise) / (total * value)
        order = np.argsort(self.frequencies)
        weights = slopes.bound.weights.sum(axis=1)[order] / total
        frequencies, heights = self.frequencies[order], self.bound.sizes[order, 0]
        left, middle, right = heights[:-2], heights[1:-1], heights[2:]
        valleys = 1 + np.flatnonzero((middle < left) & (middle <= right))
        hills = np.split(np.arange(len(order)), valleys)
        hills = [hill for hill in hills if weights[hill].sum() > _LEAST_WEIGHT]
        tops = [hill[np.argmax(heights[hill])] for hill in hills]
        shares = np.array([weights[hill].sum() for hill in hills])
        fall = float(max(0.0, 1.0 - floor))
        return Certificate(frequencies[tops], heights[tops], shares / shares.sum(), fall)
