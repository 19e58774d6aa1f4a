"""Maximum likelihood of parameters from measured outputs: the output-error method.

    y[k] = ŷ[k; θ, x0] + e[k],   e_i white, normal, of standard deviation σ_i
    −log L = Σ_i N_i/2 (log 2πσ_i²) + Σ_i RSS_i / (2σ_i²)

With the σ_i unknown, σ_i² = RSS_i / N_i at the optimum, which leaves
min Σ_i N_i/2 log RSS_i: weighted least squares whose weights follow the residuals, solved
by Gauss-Newton steps that are damped (Levenberg-Marquardt) while they do not pay. The
initial state of each record enters linearly and is eliminated from each step.

References: R. K. Mehra, "Identification of stochastic linear dynamic systems using Kalman
filter representation", AIAA J. 9 (1971); R. V. Jategaonkar, *Flight Vehicle System
Identification*, 2006, chapter 4.
"""

from dataclasses import dataclass, replace

import numpy as np

from sklearn_hd.algorithms.likelihood.likelihood import Point, likelihood_problem
from sklearn_hd.algorithms.likelihood.noisy_inputs import noisy_input_problem

STALLED = 1e-2  # fall of the cost per residual; at rounding nothing better can be had
FIRST_DAMPING = 1e-6
SETTLED = 1e-3  # relative change of noise levels; far below their own error
SMALLEST_SHARE = 1e-3  # of the residual that is left to the output's own noise
DAMPING_LIMIT = 1e8  # times the squared singular values: steps have become rounding


@dataclass(frozen=True, eq=False)
class OutputErrorResult:
    """What maximum likelihood found.

    Attributes
    ----------
    theta : ndarray, shape (k,)
    x0 : list of ndarray, shape (n,)
        Initial state of each segment.
    sigma : ndarray, shape (l,)
        Standard deviation of each output's noise, corrected for the degrees of freedom
        that the fit has used (all outputs share them alike), or as given.
    covariance : ndarray, shape (k, k)
        Of θ, the initial states being unknown: inverse of the Fisher matrix. Infinite on
        the diagonal and NaN off it for parameters that are not identified.
    cost : float
        Negative logarithm of the likelihood.
    n_residuals : int
        Values of outputs that were not missing.
    n_parameters : int
        All that were estimated: θ, initial states, noise levels.
    n_iter : int
        Jacobians taken.
    converged : bool
    relative_decrease : float
        Fall of the weighted sum of squares, relative to it, that another step promises.
    unidentified : tuple of str
        Parameters that the data do not determine.
    fit_percent : ndarray, shape (l,)
        100 (1 − |ŷ − y| / |y − mean y|).
    """

    theta: np.ndarray
    x0: list
    sigma: np.ndarray
    covariance: np.ndarray
    cost: float
    n_residuals: int
    n_parameters: int
    n_iter: int
    converged: bool
    relative_decrease: float
    unidentified: tuple
    fit_percent: np.ndarray

    @property
    def theta_std(self):
        """Standard deviation of each parameter, infinite if it is not identified."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def aic(self):
        """Akaike's criterion, 2 (n_parameters − log L)."""
        return 2.0 * (self.n_parameters + self.cost)

    @property
    def bic(self):
        """Schwarz's criterion, n_parameters log n_residuals − 2 log L."""
        return self.n_parameters * np.log(self.n_residuals) + 2.0 * self.cost


def output_error(
    structure,
    segments,
    omega,
    n_phases,
    theta0,
    *,
    observe=None,
    free_initial_state=True,
    x0=None,
    sigma=None,
    input_sigma=None,
    bounds=None,
    max_iter=50,
    tol=1e-8,
    keep_stable=True,
):
    """Parameters of largest likelihood for measured outputs of a periodic system.

        min Σ_i N_i/2 log RSS_i(θ, x0)

    Parameters
    ----------
    structure : PeriodicStructure
    segments : list of (inputs, outputs, first_phase)
        Records: inputs (n_samples, m), held from sample to sample, outputs
        (n_samples, l), NaN where missing, and the phase of the first sample (samples
        after ψ = 0).
    omega : float
        Fundamental frequency, rad/s.
    n_phases : int
        Samples a period.
    theta0 : array_like, shape (k,)
        Start, near enough for the valley of the optimum.
    observe : ndarray, shape (n_phases, l, l_model), optional
        What is measured of the model's outputs at each phase.
    free_initial_state : bool, default=True
        Whether each segment's initial state is estimated too.
    x0 : array_like, shape (n_segments, n), optional
        Initial states, or where to start them; zero, or fitted at theta0, by default.
    sigma : array_like, shape (l,), optional
        Standard deviations of the noise; estimated by default.
    input_sigma : array_like, shape (m,), optional
        Standard deviations of white noise in the inputs as measured, which the system
        does not feel: total least squares. By default inputs are exact.
    max_iter : int, default=50
        Largest number of Jacobians.
    tol : float, default=1e-8
        Fall of the sum of squares, relative to it, below which a step is the last one.
        It begins within √(tol N) standard deviations of the optimum.
    keep_stable : bool, default=True
        Whether steps from a stable to an unstable system are refused.

    Returns
    -------
    result : OutputErrorResult

    Raises
    ------
    ValueError
        If shapes do not fit, or the response at theta0 overflows.

    Examples
    --------
    The rate of a lag from its step response, without noise:

    >>> from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
    >>> lag = PeriodicStructure(np.array([[[0.0, 1.0], [1.0, 0.0]]]),
    ...                         np.array([[[[-1.0, 0.0], [0.0, 0.0]]]]), 1, ("rate",))
    >>> u, t = np.ones((50, 1)), 0.1 * np.arange(50)
    >>> y = (1 - np.exp(-2.0 * t[:, None])) / 2.0
    >>> result = output_error(lag, [(u, y, 0)], 2 * np.pi, 10, [1.0])
    >>> bool(np.isclose(result.theta[0], 2.0, rtol=1e-13))
    True
    """
    problem = likelihood_problem(
        structure, segments, omega, n_phases, observe, free_initial_state, sigma
    )
    point = _start(problem, theta0, x0)
    options = {"max_iter": max_iter, "tol": tol, "keep_stable": keep_stable, "bounds": bounds}
    search = _search(problem, point, **options)
    if input_sigma is None:
        return _result(problem, search)
    return _with_noisy_inputs(problem, search, input_sigma, options)


@dataclass(frozen=True, eq=False)
class _Search:
    """Where a search ended."""

    point: Point
    n_iter: int
    converged: bool


def _search(problem, point, *, max_iter, tol, keep_stable, bounds):
    """Damped Gauss-Newton steps until the next one is not worth taking."""
    damping, converged, n_iter = FIRST_DAMPING, False, 0
    while n_iter < max_iter and not converged:
        n_iter += 1
        system = problem.linearise(point)
        if bounds is not None:
            system = system.within(bounds[0] - point.theta, bounds[1] - point.theta)
        converged = system.promised <= tol * problem.n_residuals
        trial, damping = _damped_step(problem, point, system, damping, keep_stable)
        if trial is None:
            converged = converged or problem.at_rounding(point)
            break
        fall, point = point.cost - trial.cost, trial
        stalled = fall <= STALLED * problem.n_residuals
        converged = converged or (stalled and problem.at_rounding(point))
    return _Search(point, n_iter, converged)


def _with_noisy_inputs(problem, search, input_sigma, options):
    """Total least squares from where least squares ended, the outputs' noise in turn with it."""
    input_sigma = np.asarray(input_sigma, dtype=float)
    if input_sigma.shape != (problem.structure.n_inputs,) or not np.all(input_sigma >= 0):
        raise ValueError(
            f"input_sigma={input_sigma.tolist()} must hold a standard deviation, zero or more, "
            f"for each of {problem.structure.n_inputs} inputs"
        )
    sigma, n_iter, settled = problem.noise(search.point.rss), search.n_iter, False
    smallest = SMALLEST_SHARE * sigma
    for _ in range(options["max_iter"]):
        noisy = noisy_input_problem(problem, sigma, input_sigma)
        start = noisy.point(search.point.theta, search.point.x0)
        search = _search(noisy, start, **options)
        n_iter += search.n_iter
        if problem.sigma is not None:
            settled = True
            break
        old, sigma = sigma, np.maximum(noisy.updated_output_sigma(search.point), smallest)
        settled = bool(np.all(np.abs(sigma - old) <= SETTLED * old))
        if settled:
            break
    search = _Search(search.point, n_iter, search.converged and settled)
    plain = problem.point(search.point.theta, search.point.x0)
    result = _result(noisy, search)
    return replace(
        result,
        sigma=sigma,
        cost=noisy.likelihood(search.point),
        n_parameters=result.n_parameters + (len(sigma) if problem.sigma is None else 0),
        fit_percent=_fit_percent(problem, plain.rss),
    )


def _start(problem, theta0, x0):
    """The point to start from; initial states that are free and not given are fitted."""
    structure, n_segments = problem.structure, len(problem.records)
    theta = np.array(theta0, dtype=float)
    if theta.shape != (structure.n_parameters,):
        raise ValueError(
            f"theta0 has shape {theta.shape}; the structure has {structure.n_parameters} parameters"
        )
    start = np.zeros((n_segments, structure.n_states)) if x0 is None else np.array(x0, dtype=float)
    if start.shape != (n_segments, structure.n_states):
        raise ValueError(
            f"x0 has shape {start.shape}; {n_segments} segments of {structure.n_states} states "
            f"need ({n_segments}, {structure.n_states})"
        )
    point = problem.point(theta, start)
    if not np.isfinite(point.cost):
        raise ValueError(
            f"the response at theta0 overflows (spectral radius {point.radius:.4g} of the "
            f"monodromy matrix); start from a stable system, or cut the record into segments"
        )
    if not problem.free_x0 or x0 is not None:
        return point
    noise = problem.size if problem.sigma is None else problem.sigma
    for _ in range(2):  # weighed by the outputs, then by what is left of them
        system = problem.linearise(point, noise, parameters=False)
        trial = problem.point(theta, point.x0 - [each[:, -1] for each in system.states])
        if not trial.cost < point.cost:
            break
        point, noise = trial, problem.noise(trial.rss)
    return point


def _damped_step(problem, point, system, damping, keep_stable):
    """The next point and damping; None if no step, however small, pays."""
    growth = 2.0
    while damping < DAMPING_LIMIT:
        step = system.step(damping)
        x0_step = [-(each @ np.append(step, 1.0)) for each in system.states]
        theta, trial = point.theta + step, None
        if problem.resolves(theta):
            trial = problem.point(theta, point.x0 + x0_step if problem.free_x0 else point.x0)
        unstable = trial is not None and trial.radius > 1.0 >= point.radius
        if trial is not None and trial.cost < point.cost and not (keep_stable and unstable):
            expected = point.cost - problem.predicted_cost(system, step, x0_step)
            gain = (point.cost - trial.cost) / max(expected, 1e-300)
            fall = max(1e-2, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            return trial, max(damping * fall, 1e-16)
        damping, growth = damping * growth, 2.0 * growth
    return None, damping


def _result(problem, search):
    """Estimates with their covariance where a search ended."""
    structure, point, n_residuals = problem.structure, search.point, problem.n_residuals
    n_fitted = structure.n_parameters + (point.x0.size if problem.free_x0 else 0)
    system = problem.linearise(point)
    covariance, unknown = system.covariance()
    sigma, n_noises = problem.noise(point.rss), 0
    if problem.sigma is None:
        spent, n_noises = n_fitted / n_residuals, len(sigma)
        correction = 1.0 / np.sqrt(1.0 - spent) if spent < 1.0 else np.inf
        sigma, covariance = sigma * correction, covariance * correction**2
    return OutputErrorResult(
        theta=point.theta,
        x0=list(point.x0),
        sigma=sigma,
        covariance=covariance,
        cost=point.cost,
        n_residuals=n_residuals,
        n_parameters=n_fitted + n_noises,
        n_iter=search.n_iter,
        converged=search.converged,
        relative_decrease=system.promised / n_residuals,
        unidentified=tuple(np.array(structure.parameter_names, dtype=object)[unknown]),
        fit_percent=_fit_percent(problem, point.rss),
    )


def _fit_percent(problem, rss):
    """100 (1 − |ŷ − y| / |y − mean y|) of each output; NaN for one that is constant."""
    mean = sum(np.sum(record.outputs, axis=0) for record in problem.records) / problem.counts
    spread = sum(
        np.sum(np.where(record.present, record.outputs - mean, 0.0) ** 2, axis=0)
        for record in problem.records
    )
    spread = np.where(spread > 0, spread, np.nan)
    return 100.0 * (1.0 - np.sqrt(rss / spread))
