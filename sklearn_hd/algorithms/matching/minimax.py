"""Minimisation of the H∞ norm of a matching error by a prox-linear trust region.

    min_θ  F(θ) = sup_ω σ_max(E(jω; θ)),   E = W_o (G_c − G_s(θ)) W_i,   lower ≤ θ ≤ upper

F is neither smooth nor convex, yet it is a convex function (a largest singular value
over all frequencies) of the smooth function θ → E. Each step therefore keeps the convex
part and linearises the smooth one,

    min_{t, ζ} t   subject to   σ_max(E_i + Σ_k ζ_k ∂E_i/∂ζ_k) ≤ t for active ω_i,  |ζ| ≤ Δ

with θ = θ₀ + M ζ, M making the response's sensitivity orthonormal, but for parameters on
their way to infinity. A spectral norm is held below t by second-order cones
|(E_i + …) v| ≤ t, where the directions v are right singular vectors. Few frequencies and
directions begin; those that are violated join, frequencies to which the step moves a peak
among them, until none is. A step is accepted by the exact norm and by the stability of G_s.

At a minimum zero lies in the convex hull of the gradients of the active peaks. The
multipliers of the cones are the weights of that hull, and the ball's multiplier is its
distance from zero: :func:`certify` reports both.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sklearn_hd.algorithms.lti.hinf import same_tops, tops_between
from sklearn_hd.algorithms.matching.cone_programs import least_level

__all__ = [
    "Certificate",
    "MinimaxResult",
    "certify",
    "minimise_peak",
    "on_bounds",
    "region_radius",
    "walls_of",
]


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


def minimise_peak(problem, theta, *, max_iter=100, tol=1e-8, report=None):
    """Parameters of least H∞ matching error, reached downhill from a stable start.

    Parameters
    ----------
    problem : object
        ``peak(theta)`` -> (F, ω of the peak), F = inf where G_s is unstable;
        ``error_and_sensitivity(theta, frequencies)`` -> E and ∂E/∂θ;
        ``active_frequencies(theta, value)``; ``step_directions(theta)`` -> M.
    theta : ndarray, shape (k,)
    max_iter : int
        Largest number of convex subproblems.
    tol : float
        Predicted decrease, relative to F, at which to stop.
    report : callable, optional
        Told the number of convex subproblems solved: ``report(done, note)``.

    Returns
    -------
    result : MinimaxResult
    """
    value, peak = problem.peak(theta)
    directions = problem.step_directions(theta)
    history, top = [value], peak
    radius, n_iter, predicted, moved, converged, n_again = 1.0, 0, np.inf, True, False, 0
    curvature, cuts = np.zeros((directions.shape[1],) * 2), ()
    while n_iter < max_iter and value > 0:
        if moved:
            frequencies = problem.active_frequencies(theta, value, [top])
            model = _Linearisation.at(problem, theta, frequencies, directions, value)
        found = _convex_step(model, curvature, radius, cuts)
        step, duals, model = found.step, found.duals, found.model
        cuts = tuple(zip(model.frequencies[duals[0]], duals[2], strict=True))
        n_iter += 1
        if report is not None:
            report(n_iter, f"error {value:.3g}")
        predicted = 1.0 - found.bound
        if predicted <= tol or radius < _LEAST_RADIUS:
            flat = np.zeros_like(curvature)
            remaining = 1.0 - _convex_step(model, flat, 1.0, cuts).bound
            converged = remaining <= np.sqrt(tol)
            if converged or n_again == _AGAIN:
                last = problem.inside(theta + directions @ step)
                last_value, _ = problem.peak(last)
                if converged and last_value < value:  # costs little, certifies more
                    theta, value = last, last_value
                    history.append(value)
                break
            radius, curvature, n_again = 1.0, flat, n_again + 1  # the region had shrunk too far
            continue
        trial = problem.inside(theta + directions @ step)
        trial_value, trial_peak = problem.peak(trial)
        gain = (value - trial_value) / (value * predicted)
        if gain < 0.75 and np.isfinite(trial_value):
            corrected = _second_order_correction(model, trial, step, radius, cuts)
            second = problem.inside(theta + directions @ corrected)
            second_value, second_peak = problem.peak(second)
            if second_value < trial_value:
                step, trial, trial_value, trial_peak = corrected, second, second_value, second_peak
                gain = (value - trial_value) / (value * predicted)
        fresh = problem.step_directions(trial) if gain > _LEAST_GAIN else directions
        if fresh.shape[1] < directions.shape[1]:
            gain = -np.inf  # parameters on their way to infinity; a lost one goes uncertified
        radius = region_radius(radius, gain, np.linalg.norm(step))
        moved = gain > _LEAST_GAIN
        if moved:
            theta, value = trial, trial_value
            history.append(value)
            top, directions = trial_peak, fresh
        elif np.isfinite(trial_value):
            model = model.join([trial_peak])
        curvature = _lagrangian_curvature(problem, theta, model, duals, directions, value)
    theta, history = on_bounds(problem, theta, history)
    return MinimaxResult(theta, history[-1], predicted, converged, tuple(history), n_iter)


def certify(problem, theta, value):
    """Whether zero lies in the convex hull of the gradients of the active peaks.

    Parameters
    ----------
    problem : object
        As for :func:`minimise_peak`.
    theta : ndarray, shape (k,)
    value : float
        F(θ) > 0.

    Returns
    -------
    certificate : Certificate
    """
    directions = problem.step_directions(theta)
    frequencies = problem.active_frequencies(theta, value, (problem.peak(theta)[1],))
    model = _Linearisation.at(problem, theta, frequencies, directions, value)
    flat = np.zeros((directions.shape[1],) * 2)
    found = _convex_step(model, flat, 1.0)
    (which, duals, _), frequencies = found.duals, found.model.frequencies
    weights = np.bincount(which, np.linalg.norm(duals, axis=1), len(frequencies))
    predicted = max(0.0, 1.0 - found.bound)
    heights = problem.gains(theta, frequencies)
    return Certificate.of(frequencies, heights, weights, found.pull, predicted)


_LEAST_WEIGHT = 1e-4  # of a gradient that takes part in the combination
_LEAST_GAIN = 1e-3  # actual over predicted decrease below which a step is refused
_AGAIN = 3  # times that a search begins anew with a region of size one
_LEAST_RADIUS = 1e-12  # below it a step is lost in the rounding of θ
_SLACK = 1e-10  # violation of a singular-value bound, relative to F, that is let pass
_SHARE = 0.3  # of the decrease predicted that is let pass too: the next step has new vectors
_ALIKE = 1.0 - 1e-6  # product of directions that are one
_LEAST_DUAL = 1e-7  # multiplier of a cone, of 1 in all, that holds a step
_NEXT_TO = 1e-9  # distance from a bound, relative, that the cone programs leave
_LARGE = 0.8  # singular values, relative to F, that have a cone from the first round on


@dataclass(frozen=True, eq=False)
class _Linearisation:
    """E/F + Σ ζ_k ∂E/∂ζ_k / F at some frequencies, columns made the shorter side.

    With a trial point, E is moved so that the model has its error at ζ = step.
    """

    problem: object
    theta: np.ndarray
    directions: np.ndarray
    value: float
    frequencies: np.ndarray
    error: np.ndarray
    slope: np.ndarray
    swapped: bool
    trial: np.ndarray | None = None
    step: np.ndarray | None = None

    @classmethod
    def at(cls, problem, theta, frequencies, directions, value, trial=None, step=None):
        frequencies = np.asarray(frequencies, dtype=float)
        error, sensitivity = problem.error_and_sensitivity(theta, frequencies)
        slope = (sensitivity @ directions) / value
        if trial is None:
            error = error / value
        else:
            error = problem.error_and_sensitivity(trial, frequencies)[0] / value - slope @ step
        swapped = error.shape[2] > error.shape[1]
        if swapped:
            error, slope = error.swapaxes(1, 2), slope.swapaxes(1, 2)
        first = (problem, theta, directions, value, frequencies, error, slope, swapped)
        return cls(*first, trial, step)

    def on(self, frequencies):
        """The same at other frequencies."""
        return self.at(
            self.problem,
            self.theta,
            frequencies,
            self.directions,
            self.value,
            self.trial,
            self.step,
        )

    def join(self, frequencies):
        """The same at further frequencies."""
        other = self.on(frequencies)
        return replace(
            self,
            frequencies=np.concatenate([self.frequencies, other.frequencies]),
            error=np.concatenate([self.error, other.error]),
            slope=np.concatenate([self.slope, other.slope]),
        )

    def corrected(self, trial, step):
        """The same, moved to have the error of a trial point at ζ = step."""
        return replace(self, trial=trial, step=step).on(self.frequencies)

    def after(self, step):
        """Singular values and adjoint right vectors of E + Σ ζ_k ∂E/∂ζ_k."""
        return np.linalg.svd(self.error + self.slope @ step, full_matrices=False)[1:]


def _second_order_correction(model, trial, step, radius, cuts):
    """Step that counts in how far E at the trial point is from its linearisation.

    Along a curved valley, active peaks rise again at second order whatever the step's
    direction, and steps would stay short (Maratos, 1978).
    """
    moved = model.corrected(trial, step)
    return _convex_step(moved, np.zeros((len(step),) * 2), radius, cuts).step


def _lagrangian_curvature(problem, theta, model, duals, directions, value):
    """Positive part of the curvature of θ → E, weighted by the cones' multipliers."""
    which, left, right = duals
    if model.swapped:
        left, right = right.conj(), left.conj()
    hessian = problem.error_curvature(theta, model.frequencies[which], left, right)
    hessian = directions.T @ hessian @ directions / value
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def region_radius(radius, gain, length):
    """Trust-region radius after a step of some length earned part of its prediction."""
    if gain < 0.25 or not np.isfinite(gain):
        return 0.3 * min(radius, length)
    return max(radius, 2.5 * length) if gain > 0.75 else radius


class _ConvexStep(NamedTuple):
    """Where :func:`_convex_step` ended.

    Attributes
    ----------
    step : ndarray
        ζ.
    bound : float
        Lower bound of the convex model's least level: that of the cones alone.
    duals : tuple
        Multipliers as (which frequency, left vectors, right vectors); their sum weighs E as
        the optimality conditions do.
    pull : float
        Multiplier of the ball.
    model : _Linearisation
        With the frequencies that joined.
    """

    step: np.ndarray
    bound: float
    duals: tuple
    pull: float
    model: object


def _convex_step(model, curvature, radius, known=(), max_rounds=60):
    """Minimiser ζ of the convex model within a ball and the bounds.

    ``known`` are pairs of a frequency and a direction v that held the step before. Peaks
    that the step moves between the model's frequencies join them (exchange method).
    """
    walls = walls_of(model.problem, model.theta, model.directions)
    which, cuts = _first_directions(model, known)
    for _ in range(max_rounds):
        vectors = np.einsum("flm,fm->fl", model.error[which], cuts)
        rates = np.einsum("flmk,fm->flk", model.slope[which], cuts)
        step, level, duals, _, pull = least_level(vectors, rates, curvature, radius, walls)
        slack = max(_SLACK, _SHARE * (1.0 - level))
        sizes, adjoint = model.after(step)
        tops, heights, _ = tops_between(model.frequencies, sizes[:, 0])
        tops = tops[heights > level + slack]
        if len(tops):
            model = model.join(tops)
            sizes, adjoint = model.after(step)
        order = np.argsort(model.frequencies)
        violated = (sizes > level + slack) & _tops(sizes[:, 0], order)[:, None]
        if not violated.any():
            break
        which = np.concatenate([which, np.nonzero(violated)[0]])
        cuts = np.concatenate([cuts, adjoint[violated].conj()])
    bound = float(level + 0.5 * step @ curvature @ step)
    active = np.flatnonzero(np.linalg.norm(duals, axis=1) > _LEAST_DUAL)
    duals = which[: len(duals)][active], duals[active], cuts[: len(duals)][active]
    return _ConvexStep(step, bound, duals, pull, model)


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


def _tops(gains, order):
    """Where the gains have a local maximum over frequency."""
    padded = np.concatenate([[-np.inf], gains[order], [-np.inf]])
    tops = np.empty(len(gains), dtype=bool)
    tops[order] = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    return tops


def _first_directions(model, known):
    """Whose, and which: right singular vectors of the peaks' large singular values, and those
    that held the step before, at the frequencies that are nearest now.
    """
    sizes, adjoint = model.after(np.zeros(model.slope.shape[-1]))
    large = (sizes > _LARGE) & _tops(sizes[:, 0], np.argsort(model.frequencies))[:, None]
    large[np.argmax(sizes[:, 0]), 0] = True
    which, cuts = list(np.nonzero(large)[0]), list(adjoint[large].conj())
    for frequency, direction in known:
        same = np.flatnonzero(model.frequencies == frequency)  # infinity has no distance
        k = same[0] if len(same) else np.argmin(np.abs(model.frequencies - frequency))
        alike = [abs(np.vdot(v, direction)) for i, v in zip(which, cuts, strict=True) if i == k]
        if max(alike, default=0.0) < _ALIKE:
            which.append(k)
            cuts.append(direction)
    return np.array(which), np.array(cuts)
