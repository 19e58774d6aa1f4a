"""Newton's method for the least H∞ norm where single peaks hold it up.

    min_θ max_i σ_i(θ),     σ_i(θ) = max_ω σ_max(E(jω; θ)) over the ω next to ω_i

Near a least norm some peaks are equally high, each a smooth function of θ as long as its
largest singular value is a single one. With multipliers λ_i of the peaks, Σ λ_i = 1, a step
solves

    min_{t, ζ} t + ½ ζᵀ (Σ λ_i ∂²σ_i/∂ζ²) ζ   subject to   σ_i + ∂σ_i/∂ζ ζ ≤ t,  |ζ| ≤ Δ

which is Newton's on the conditions Σ λ_i ∂σ_i/∂ζ = 0, σ_i = t, so that the last digits cost
few steps. With E = U Σ Vᴴ, D_k = Uᴴ (∂E/∂ζ_k) V and s the largest singular value, the first,

    ∂σ/∂ζ_k = Re D_11,k
    ∂²σ/∂ζ² = Re u₁ᴴ (∂²E/∂ζ²) v₁ + d dᵀ / s,    d = Im D_11                       (its turning)
              + Σ_{i>1} 2 Re(p p̄ᵀ) / (s − σ_i) + 2 Re(q q̄ᵀ) / (s + σ_i)     (that of vectors)
              − (∂²σ/∂ω∂ζ) (∂²σ/∂ω∂ζ)ᵀ / (∂²σ/∂ω²)                     (the top moves aside)

where p, q = (D_i1 ± conj D_1i)/2, and rows and columns without a singular value count
|D_i1|²/s each. Derivatives toward ω are differences.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.hinf import same_tops
from sklearn_hd.algorithms.lti.structured_model import column_sizes
from sklearn_hd.algorithms.matching.cone_programs import least_level

__all__ = ["newton_descent"]

_FIRST_RADIUS = 0.03  # of a step: by as much of the residual a response moves
_LEAST_RADIUS = 1e-9
_LEAST_GAIN = 1e-3  # actual over promised decrease below which a step is refused
_PATIENCE = 8  # steps that together must earn a share
_AGAIN = 3  # times that a search begins anew with a region of size one
_CREEP = 0.2  # that share, of what the linearised peaks promise: else a valley is curved
_GOOD = 0.9  # from which it needs no correction
_REACH = 0.9  # height of a peak, relative to the norm, that may hold it up after a step
_HELD = 1e-6  # multiplier of a peak that holds a step up
_TOUCHED = 1e-6  # distance of a wall that is touched, in steps of size one
_APART = 1e-4  # of ω, over which differences are taken
_SINGLE = 1e-9  # least distance, relative, of a singular value from the largest
_LEVEL = 1e-8  # singular value of gradients, of the largest, that is none
_STIFF = 1e-6  # of the curvature, below which nothing is added across for what lies along
_ROUNDING = 1e-13  # of F: what a step promises below it is none
_LEAST_WEIGHT = 1e-4  # of a gradient that takes part in the combination
_NEXT_TO = 1e-9  # distance from a bound, relative, that the cone programs leave
_PRECISE = 1e-12  # of the programs: their multipliers are the certificate


@dataclass(frozen=True, eq=False)
class Certificate:
    """First-order conditions of a least H∞ norm.

    Attributes
    ----------
    frequencies : ndarray, shape (n_active,)
        rad/s, of the peaks that hold the norm where it is.
    errors : ndarray, shape (n_active,)
        σ_max(E) there.
    weights : ndarray, shape (n_active,)
        Of their gradients in the convex combination nearest to zero; they sum to 1.
    distance : float
        Length of that combination, in units of F, where θ is counted in moves of the
        response as long as the residual; bounds that are touched take their share. The
        gradients are those of all peaks within ``predicted_decrease`` of the top (the
        ε-subdifferential of F), so that both numbers together certify.
    predicted_decrease : float
        Largest decrease, relative to F, that the linearised peaks promise within one such
        move. 0 at a stationary point.
    """

    frequencies: np.ndarray
    errors: np.ndarray
    weights: np.ndarray
    distance: float
    predicted_decrease: float

    @classmethod
    def of(cls, frequencies, errors, weights, distance, predicted_decrease):
        """The same from weights of frequencies in any order, several of them on one peak."""
        active = np.flatnonzero(weights > _LEAST_WEIGHT * weights.sum())
        active = active[np.argsort(frequencies[active])]
        groups = [active[each] for each in same_tops(frequencies[active])]
        tops = [each[np.argmax(errors[each])] for each in groups]
        weights = np.array([weights[each].sum() for each in groups]) / weights[active].sum()
        return cls(frequencies[tops], errors[tops], weights, distance, predicted_decrease)


@dataclass(frozen=True, eq=False)
class MinimaxResult:
    """Where :func:`minimise_peak` ended.

    Attributes
    ----------
    theta : ndarray, shape (k,)
    value : float
        F(θ).
    predicted_decrease : float
        By how much the last convex model, curvature included, could still be lowered,
        relative to F.
    converged : bool
        Whether that is within tol, and what the linearised peaks promise in a region of
        size one within √tol: a step that is second order in the distance.
    history : tuple of float
        F after each step that was accepted, the start first.
    n_iter : int
        Convex subproblems solved.
    certificate : Certificate or None
        Where there is one already.
    """

    theta: np.ndarray
    value: float
    predicted_decrease: float
    converged: bool
    history: tuple
    n_iter: int
    certificate: Certificate | None = None


def newton_descent(problem, theta, *, max_iter=60, tol=1e-8, report=None):
    """Parameters of least H∞ matching error, from nearby.

    Parameters
    ----------
    problem : MatchingProblem
    theta : ndarray, shape (k,)
        With a stable G_s.
    max_iter : int
        Largest number of steps.
    tol : float
        Predicted decrease, relative to F, at which to stop.
    report : callable, optional
        Told the number of steps: ``report(done, note)``.

    Returns
    -------
    result : MinimaxResult
        Where it converged, with a certificate.

    References
    ----------
    R. Fletcher, Practical Methods of Optimization (1987), section 14.4.
    """
    value, top = problem.peak(theta)
    if not 0 < value < np.inf:
        return MinimaxResult(theta, value, np.inf, False, (value,), 0)
    history, levels, passed, radius, n_again = [value], [], [], _FIRST_RADIUS, 0
    peaks = _Peaks(problem, theta, value, [top], [])
    while peaks.can_move and len(levels) < max_iter and radius > _LEAST_RADIUS:
        found, left = peaks.step(peaks.curvature, radius), peaks.certificate.predicted_decrease
        levels.append(value)
        if report is not None:
            report(len(levels), f"error {value:.3g}")
        if found.promised <= tol and peaks.promised > tol:  # the region is too small
            if n_again == _AGAIN:
                break
            radius, n_again = 1.0, n_again + 1
            continue
        if peaks.promised <= tol and (left <= tol or peaks.promised <= _ROUNDING):
            break
        if len(levels) > _PATIENCE and levels[-1 - _PATIENCE] - value < _CREEP * left * value:
            break
        step, trial, (trial_value, trial_top) = peaks.best_of(found, radius)
        gain = (value - trial_value) / (value * max(found.promised, 1e-16))
        if gain > _LEAST_GAIN:
            held = peaks.frequencies[found.weights > _HELD]
            fresh = _Peaks(problem, trial, trial_value, [*held, trial_top], passed)
            if fresh.n_directions < peaks.n_directions:
                gain = -np.inf  # parameters on their way to infinity; a lost one goes uncertified
        radius = region_radius(radius, gain, linalg.norm(step))
        if gain > _LEAST_GAIN:
            theta, value, peaks = trial, trial_value, fresh
            history.append(value)
        elif np.isfinite(trial_value):
            passed.append(trial_top)
            peaks.join([trial_top])
    predicted = peaks.promised if peaks.can_move else np.inf
    converged = predicted <= tol and peaks.certificate.predicted_decrease <= np.sqrt(tol)
    certificate = peaks.certificate if converged else None
    theta, history = on_bounds(problem, theta, history)
    end = predicted, converged, tuple(history), len(levels), certificate
    return MinimaxResult(theta, history[-1], *end)


@dataclass(frozen=True, eq=False)
class _Step:
    """A step ζ, what it promises, and the multipliers of peaks, the ball and walls."""

    zeta: np.ndarray
    promised: float
    weights: np.ndarray
    walls: np.ndarray
    pull: np.ndarray  # Σ λ_i ∂σ_i/∂ζ and the walls' share


class _Peaks:
    """The peaks of E/F at θ that are high enough, and how they move."""

    def __init__(self, problem, theta, value, near, extra):
        self.problem, self.theta, self.value = problem, theta, value
        self.directions = problem.step_directions(theta)
        self.frequencies, heights = problem.high_frequencies(theta, _REACH * value, near, extra)
        self.heights = heights / value
        self._parts = self._moved(self.frequencies)
        self.gradients = self._parts[3][:, 0, 0].real
        self._walls = walls_of(problem, theta, self.directions)

    @property
    def n_directions(self):
        """How many combinations of parameters the response determines."""
        return self.directions.shape[1]

    @property
    def can_move(self):
        """Whether there are any, and peaks: none where the norm is that of rounding."""
        return self.n_directions > 0 and len(self.frequencies) > 0

    def join(self, frequencies):
        """Look at further frequencies too."""
        self.frequencies = np.append(self.frequencies, frequencies)
        joining = self._moved(np.asarray(frequencies))
        self._parts = tuple(np.concatenate(each) for each in zip(self._parts, joining, strict=True))
        self.heights, self.gradients = self._parts[1][:, 0], self._parts[3][:, 0, 0].real

    def _moved(self, frequencies):
        """U, Σ, V and D at some frequencies."""
        error, slope = self.problem.error_and_sensitivity(self.theta, frequencies)
        left, sizes, adjoint = np.linalg.svd(error / self.value)
        n_points, n_rows, n_columns, _ = slope.shape
        shape = n_points, n_rows, n_columns * self.n_directions
        slope = slope @ (self.directions / self.value)
        moved = left.conj().swapaxes(1, 2) @ slope.reshape(shape)
        moved = adjoint.conj()[:, None] @ moved.reshape(slope.shape)
        return left, sizes, adjoint.conj().swapaxes(1, 2), moved

    @cached_property
    def _flat(self):
        """The step of the linearised peaks alone, in a region of size one."""
        return self.step(np.zeros((self.n_directions,) * 2), 1.0)

    @cached_property
    def promised(self):
        """By how much, relative to F, the peaks fall at best in a region of size one."""
        return self.step(self.curvature, 1.0).promised

    @cached_property
    def certificate(self):
        """What the linearised peaks promise there, by their multipliers."""
        found, distance = self._flat, float(linalg.norm(self._flat.pull))
        bound = found.weights @ self.heights - found.walls @ self._walls[1] - distance
        heights, promised = self.heights * self.value, max(0.0, float(1.0 - bound))
        return Certificate.of(self.frequencies, heights, found.weights, distance, promised)

    @cached_property
    def curvature(self):
        """Σ λ_i ∂²σ_i/∂ζ², made positive, by the multipliers of the linearised peaks."""
        held = self._flat.weights > _HELD
        weights, frequencies = self._flat.weights[held], self.frequencies[held]
        left, sizes, right, moved = (each[held] for each in self._parts)
        pairs = weights[:, None] * left[:, :, 0], right[:, :, 0]
        bent = self.problem.error_curvature(self.theta, frequencies, *pairs)
        bent = self.directions.T @ bent @ self.directions / self.value
        parts = [*_turning(sizes, moved), self._aside(frequencies, sizes[:, 0])]
        for factors, each in parts:
            each = np.sqrt(factors * weights)[:, None] * each
            bent += each.real.T @ each.real + each.imag.T @ each.imag
        level = self.gradients[held] - self._flat.weights @ self.gradients
        rows, offsets = self._walls
        touched = rows[(self._flat.walls > _HELD) & (offsets <= _TOUCHED * column_sizes(rows.T))]
        return _convex(bent, np.vstack([level, touched]))

    def _aside(self, frequencies, heights):
        """Factors and rows of what tops gain by moving along the axis; 0 where there is none."""
        moves = (frequencies > 0) & np.isfinite(frequencies)
        apart = _APART * frequencies[moves]
        (_, lower, _, before), (_, higher, _, after) = (
            self._moved(frequencies[moves] + side * apart) for side in (-1.0, 1.0)
        )
        heights = heights[moves]
        is_top = (lower[:, 0] < heights) & (higher[:, 0] < heights)
        bend = 2.0 * heights - lower[:, 0] - higher[:, 0]
        factors = np.zeros(len(frequencies))
        factors[moves] = np.where(is_top, 1.0 / np.where(is_top, bend, 1.0), 0.0)
        rows = np.zeros((len(frequencies), self.n_directions))
        rows[moves] = (after[:, 0, 0].real - before[:, 0, 0].real) / 2.0
        return factors, rows

    def step(self, curvature, radius, heights=None):
        """Where the highest peak is lowest, heights those at ζ = 0."""
        heights = self.heights if heights is None else heights
        found = least_level(heights, self.gradients, curvature, radius, self._walls, _PRECISE)
        total = found.multipliers.sum()
        weights, walls = found.multipliers / total, found.walls / total
        promised = 1.0 - found.height - 0.5 * found.step @ curvature @ found.step
        pull = weights @ self.gradients + walls @ self._walls[0]
        return _Step(found.step, promised, weights, walls, pull)

    def best_of(self, found, radius):
        """A step, its end and (F, ω) there; those of its second-order correction if lower.

        Where peaks are higher at the trial point than they were linearised, in unequal
        measure, the step is found once more as if they went on linearly from there
        (Maratos, 1978).
        """
        first = self._tried(found.zeta)
        value = first[2][0]
        if not np.isfinite(value) or self.value - value >= _GOOD * found.promised * self.value:
            return first
        heights = self.problem.tops_near(first[1], self.frequencies)[1] / self.value
        heights = heights - self.gradients @ found.zeta
        corrected = self.step(self.curvature, radius, heights)
        second = self._tried(corrected.zeta)
        return second if second[2][0] < value else first

    def _tried(self, zeta):
        trial = self.problem.inside(self.theta + self.directions @ zeta)
        return zeta, trial, self.problem.peak(trial)


def _convex(curvature, rows):
    """The curvature made positive, first across the directions that leave some rows at zero.

    Peaks that are held end a step level, and walls that are touched stay so: what is added
    across changes multipliers but not where the steps lead. What is negative along is left out.
    """
    _, sizes, adjoint = linalg.svd(rows / column_sizes(rows.T)[:, None])
    n = np.sum(sizes > _LEVEL * sizes.max(initial=0.0))
    across, along = adjoint[:n], adjoint[n:]
    values, vectors = linalg.eigh(along @ curvature @ along.T)
    turned = vectors.T @ (along @ curvature @ across.T)
    least = max(_STIFF * linalg.norm(curvature, 2), 1e-300)
    rest = across @ curvature @ across.T - turned.T @ (turned / np.maximum(values, least)[:, None])
    needed = max(0.0, -linalg.eigvalsh(rest)[0]) if n else 0.0
    curvature = curvature + needed * across.T @ across
    values, vectors = linalg.eigh((curvature + curvature.T) / 2)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _turning(sizes, moved):
    """Factors and rows of the curvature that comes from singular vectors that turn."""
    largest, n = sizes[:, 0], sizes.shape[1]
    yield 1.0 / largest, moved[:, 0, 0].imag
    for i in range(1, n):
        down, across = moved[:, i, 0], moved[:, 0, i].conj()
        left = np.maximum(largest - sizes[:, i], _SINGLE * largest)
        yield 2.0 / left, (down + across) / 2.0
        yield 2.0 / (largest + sizes[:, i]), (down - across) / 2.0
    for i in range(n, moved.shape[1]):
        yield 1.0 / largest, moved[:, i, 0]
    for i in range(n, moved.shape[2]):
        yield 1.0 / largest, moved[:, 0, i]


def region_radius(radius, gain, length):
    """Trust-region radius after a step of some length earned part of its prediction."""
    if gain < 0.25 or not np.isfinite(gain):
        return 0.3 * min(radius, length)
    return max(radius, 2.5 * length) if gain > 0.75 else radius


def on_bounds(problem, theta, history):
    """Parameters that end next to a bound set on it if the norm is no worse; norms so far."""
    near = _NEXT_TO * np.abs(theta)
    there = np.where(theta - problem.lower <= near, problem.lower, theta)
    there = np.where(problem.upper - theta <= near, problem.upper, there)
    if np.array_equal(there, theta):
        return theta, history
    value = problem.peak(there)[0]
    if value > history[-1]:
        return theta, history
    return there, [*history, value] if value < history[-1] else history


def walls_of(problem, theta, directions):
    """Rows and offsets of the bounds, rows · ζ ≤ offsets."""
    above, below = np.isfinite(problem.upper), np.isfinite(problem.lower)
    rows = np.vstack([directions[above], -directions[below]])
    return rows, np.concatenate([(problem.upper - theta)[above], (theta - problem.lower)[below]])
