"""The search for the largest likelihood: Gauss-Newton steps, damped while they do not pay.

The covariance S of what is left is at its own optimum wherever parameters are: what remains is
½ N log det S, weighted least squares whose weights follow the residuals (Levenberg-Marquardt).
Initial states enter linearly and are eliminated from each step.
"""

from dataclasses import dataclass, replace

import numpy as np

from sklearn_hd.algorithms.likelihood.likelihood import (
    LinearSystem,
    Point,
    Problem,
    likelihood_problem,
)

STALLED = 1e-2  # fall of the cost, in all where no step pays, per residual at rounding
FIRST_DAMPING = 1e-6
POOR = 0.5  # of the fall expected: what is linear is then solved for by itself
DAMPING_LIMIT = 1e8  # times the squared singular values: steps have become rounding


class OverflowingStartError(ValueError):
    """A start whose response numbers cannot hold."""


@dataclass(frozen=True, eq=False)
class LikelihoodResult:
    """What maximum likelihood found."""

    theta: np.ndarray  # (k,): of the structure
    # (k_d,): those that are parameters, in samples beyond the whole ones of the record
    delays: np.ndarray
    gain: np.ndarray | None  # (2 H + 1, n, l): Fourier coefficients of K; None for a simulation
    # (l, l): covariance of what is left, corrected for the degrees of freedom that the fit has used
    # (all outputs share them alike), or as given
    spread: np.ndarray
    # (k + k_d, k + k_d): of θ and delays, gain and initial states being unknown: inverse of the
    # Fisher matrix. Infinite on the diagonal and NaN off it for parameters that are not identified.
    covariance: np.ndarray
    cost: float  # negative logarithm of the likelihood
    n_residuals: int  # values of outputs
    n_parameters: int  # all that were estimated: θ, gain, initial states, waveforms, noise levels
    n_iter: int  # jacobians taken
    converged: bool
    unidentified: tuple  # of str: parameters that the data do not determine
    problem: Problem
    point: Point  # where the search ended
    system: LinearSystem  # of the records there
    ahead: LinearSystem  # for another step from there, what is known beforehand included
    correction: float  # for the degrees of freedom that the fit has used, in the covariances

    @property
    def sigma(self):
        """Standard deviation of what is left of each output."""
        return np.sqrt(np.diag(self.spread))

    @property
    def without_gain(self):
        """Parameters except for those of K: to start from."""
        return np.concatenate([self.theta, self.delays])

    @property
    def own_cost(self):
        """The same a value, with noise as it is left, where that was given."""
        problem = replace(self.problem, sigma=None)
        return problem.cost(self.point.moments) / self.n_residuals

    @property
    def aic(self):
        """Akaike's criterion, 2 (n_parameters − log L)."""
        return 2.0 * (self.n_parameters + self.cost)

    @property
    def bic(self):
        """Schwarz's criterion, n_parameters log n_residuals − 2 log L."""
        return self.n_parameters * np.log(self.n_residuals) + 2.0 * self.cost


@dataclass(frozen=True, eq=False)
class Search:
    """Where a search ended."""

    point: Point
    n_iter: int
    converged: bool
    problem: Problem | None = None  # with what is known beforehand


def search(problem, point, *, max_iter, tol, keep_stable, bounds):
    """Damped Gauss-Newton steps until the next one is not worth taking.

    What is known beforehand of inputs is by what the records tell at the start of each search.
    """
    damping, converged, n_iter = FIRST_DAMPING, False, 0
    while n_iter < max_iter and not converged:
        n_iter += 1
        spread = problem.spread(point.moments)
        system = problem.linearise(point, spread)
        if n_iter == 1 and problem.form.input_size is not None:
            known = system.untold(problem.form.stiffness(system.squares))
            problem = replace(problem, known=known)
            system = system.beside(problem.known_rows(point))
            point = problem.point(point.theta, point.x0)
        if bounds is not None:
            system = system.within(bounds[0] - point.theta, bounds[1] - point.theta)
        converged = system.promised <= tol * problem.n_residuals
        trial, damping = _damped_step(problem, point, system, damping, keep_stable)
        if trial is None:
            converged = converged or system.promised <= STALLED or problem.at_rounding(point)
            break
        fall, point = point.cost - trial.cost, trial
        stalled = fall <= STALLED * problem.n_residuals
        converged = converged or (stalled and problem.at_rounding(point))
    return Search(point, n_iter, converged, problem)


def start(problem, theta0):
    """The point to start from, initial states fitted."""
    x0 = np.zeros((len(problem.records), problem.form.n_states))
    point = problem.point(np.array(theta0, dtype=float), x0)
    if not np.isfinite(point.cost):
        raise OverflowingStartError(
            f"the response at theta0 overflows (spectral radius {point.radius:.4g} of the "
            f"monodromy matrix); start from a stable system, or cut the record into segments"
        )
    spread = np.diag((problem.size if problem.sigma is None else problem.sigma) ** 2)
    for _ in range(2):  # weighed by the outputs, then by what is left of them
        system = problem.linearise(point, spread, ())
        trial = problem.point(point.theta, point.x0 - [each[:, -1] for each in system.states])
        if not trial.cost < point.cost:
            break
        point, spread = trial, problem.spread(trial.moments)
    return point


def cost_of_start(problem, theta0):
    """Cost of the point that a search would start from; infinite where it overflows."""
    try:
        return start(problem, theta0).cost
    except OverflowingStartError:
        return np.inf


def cost_of_best_inputs(form, segments, theta0, sigma):
    """Cost of the F and P given with the best G, Q and initial states; infinite where it overflows.

    ``sigma`` has the standard deviation of what each output leaves.
    """
    problem = likelihood_problem(form, segments, sigma)
    try:
        return problem.with_best_inputs(start(problem, theta0)).cost
    except OverflowingStartError:
        return np.inf


def _damped_step(problem, point, system, damping, keep_stable):
    """The next point and damping; None if no step, however small, pays."""
    growth = 2.0
    while damping < DAMPING_LIMIT:
        step = system.step(damping)
        x0_step = [-(each @ np.append(step, 1.0)) for each in system.states]
        theta, trial = point.theta + step, None
        if problem.form.resolves(theta):
            trial = problem.point(theta, point.x0 + x0_step)
        unstable = trial is not None and trial.radius > 1.0 >= point.radius
        if trial is not None and np.isfinite(trial.cost) and not (keep_stable and unstable):
            expected = 0.5 * system.fall(step)
            if point.cost - trial.cost < POOR * expected:
                trial = problem.with_best_inputs(trial)
        if trial is not None and trial.cost < point.cost and not (keep_stable and unstable):
            gain = (point.cost - trial.cost) / max(expected, 1e-300)
            fall = max(1e-2, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            return trial, max(damping * fall, 1e-16)
        damping, growth = damping * growth, 2.0 * growth
    return None, damping


def result_of(problem, search):
    """Estimates with their covariance where a search ended."""
    form, point, n_residuals = problem.form, search.point, problem.n_residuals
    k, gauge = form.structure.n_parameters, form.discrete or form.gauge
    system = ahead = problem.linearise(point)
    if search.problem is not None and search.problem.known is not None:
        ahead = system.beside(search.problem.known_rows(point))
    n_theta = int(np.sum(system.steps.kept)) if gauge else len(point.theta)  # no similarities
    n_fitted = n_theta + problem.n_waveforms + point.x0.size
    covariance, unknown = system.covariance(gauge=gauge)
    spread, n_noises, correction = problem.spread(point.moments), 0, 1.0
    if problem.sigma is None:
        spent, n = n_fitted / n_residuals, len(spread)
        n_noises = n * (n + 1) // 2 if problem.correlated else n
        correction = 1.0 / (1.0 - spent) if spent < 1.0 else np.inf
        spread, covariance = spread * correction, covariance * correction
    return LikelihoodResult(
        theta=point.theta[:k],
        delays=point.theta[k : form.n_model],
        gain=form.gain(point.theta),
        spread=spread,
        covariance=covariance[: form.n_model, : form.n_model],
        cost=problem.cost(point.moments),
        n_residuals=n_residuals,
        n_parameters=n_fitted + n_noises,
        n_iter=search.n_iter,
        converged=search.converged,
        unidentified=tuple(np.array(form.structure.parameter_names, dtype=object)[unknown[:k]]),
        problem=problem,
        point=point,
        system=system,
        ahead=ahead,
        correction=correction,
    )
