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

from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.periodic_structure import (
    MAX_SUBSTEPS,
    PeriodicStructure,
    n_substeps,
    sampled_response,
)
from sklearn_hd.algorithms.sensitivity import as_records, jacobian_factors, residuals
from sklearn_hd.algorithms.structured_model import column_sizes

__all__ = ["OutputErrorResult", "output_error"]

SMALLEST_NOISE = 4.0 * np.finfo(float).eps  # of an output's rms; below it is rounding
ROUNDING = 1e-10  # noise relative to the output that may be rounding
STALLED = 1e-2  # fall of the cost per residual; at rounding nothing better can be had
RANK = 1e-11  # singular values relative to the largest; deficient Jacobians have 1e-15
NULL_SHARE = 1e-6  # of a parameter's direction in the null space
FIRST_DAMPING = 1e-6
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

    >>> lag = PeriodicStructure(np.array([[[0.0, 1.0], [1.0, 0.0]]]),
    ...                         np.array([[[[-1.0, 0.0], [0.0, 0.0]]]]), 1, ("rate",))
    >>> u, t = np.ones((50, 1)), 0.1 * np.arange(50)
    >>> y = (1 - np.exp(-2.0 * t[:, None])) / 2.0
    >>> result = output_error(lag, [(u, y, 0)], 2 * np.pi, 10, [1.0])
    >>> bool(np.isclose(result.theta[0], 2.0, rtol=1e-13))
    True
    """
    problem = _problem(structure, segments, omega, n_phases, observe, free_initial_state, sigma)
    point = _start(problem, theta0, x0)
    damping, converged = FIRST_DAMPING, False
    for n_iter in range(1, max_iter + 1):  # noqa: B007 -- read after the loop
        system = problem.linearise(point)
        converged = system.promised <= tol * problem.n_residuals
        trial, damping = _damped_step(problem, point, system, damping, keep_stable)
        if trial is None:
            converged = converged or problem.at_rounding(point)
            break
        fall, point = point.cost - trial.cost, trial
        stalled = fall <= STALLED * problem.n_residuals
        converged = converged or (stalled and problem.at_rounding(point))
        if converged:
            break
    return _result(problem, point, n_iter, converged)


@dataclass(frozen=True, eq=False)
class Point:
    """Parameters, initial states, and how well they fit."""

    theta: np.ndarray
    x0: np.ndarray  # (n_segments, n)
    rss: np.ndarray  # (l,)
    cost: float
    radius: float  # of the monodromy matrix's spectrum


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """Weighted least squares for a step, the initial states eliminated.

    Attributes
    ----------
    factors : list of ndarray, shape (l, c, c)
        Of each segment, not weighted.
    R : ndarray, shape (k + 1, k + 1)
        Triangular factor of the weighted [J r], its projection on x0 taken out.
    size : ndarray, shape (k,)
        Length of J's columns before that.
    states : list of ndarray, shape (n, k + 1)
        The best change of x0 is −states [step; 1].
    """

    factors: list
    R: np.ndarray
    size: np.ndarray
    states: list
    promised_by_states: float
    left: np.ndarray = field(init=False)
    singular: np.ndarray = field(init=False)
    adjoint: np.ndarray = field(init=False)

    def __post_init__(self):
        scaled = self.R[:, :-1] / self.size
        left, singular, adjoint = linalg.svd(scaled, full_matrices=False)
        object.__setattr__(self, "left", left)
        object.__setattr__(self, "singular", singular)
        object.__setattr__(self, "adjoint", adjoint)

    @property
    def kept(self):
        """Singular values that are not rounding; J's columns have length one or less."""
        return self.singular > RANK

    @property
    def projected(self):
        return np.where(self.kept, self.left.T @ self.R[:, -1], 0.0)

    @property
    def promised(self):
        """Fall of the weighted sum of squares to first order."""
        return float(self.projected @ self.projected) + self.promised_by_states

    def step(self, damping):
        """Change of θ, of least norm in scaled coordinates."""
        weight = self.singular / (self.singular**2 + damping)
        weight = np.where(self.kept, weight, 0.0)
        return -(self.adjoint.T @ (weight * self.projected)) / self.size

    def covariance(self):
        """(JᵀJ)⁻¹, and which parameters are not identified."""
        kept = self.kept
        root = self.adjoint[kept].T / self.singular[kept] / self.size[:, None]
        covariance = root @ root.T
        unknown = np.linalg.norm(self.adjoint[~kept], axis=0) > NULL_SHARE
        covariance[unknown, :] = covariance[:, unknown] = np.nan
        covariance[unknown, unknown] = np.inf
        return covariance, unknown


@dataclass(frozen=True, eq=False)
class Problem:
    """Structure, records and what is known of the noise."""

    structure: PeriodicStructure
    records: list
    omega: float
    n_phases: int
    observe: np.ndarray | None
    free_x0: bool
    sigma: np.ndarray | None
    counts: np.ndarray  # (l,) values of each output
    size: np.ndarray  # (l,) rms of each output

    @property
    def n_residuals(self):
        return int(self.counts.sum())

    def response(self, theta, *, sensitivities):
        return sampled_response(
            self.structure,
            theta,
            self.omega,
            self.n_phases,
            self.observe,
            sensitivities=sensitivities,
        )

    def noise(self, rss):
        """Standard deviations given, or those of largest likelihood."""
        if self.sigma is not None:
            return self.sigma
        return np.maximum(np.sqrt(rss / self.counts), SMALLEST_NOISE * self.size)

    def cost(self, rss):
        """Negative logarithm of the likelihood."""
        noise = self.noise(rss)
        return float(
            np.sum(self.counts * np.log(np.sqrt(2.0 * np.pi) * noise) + 0.5 * rss / noise**2)
        )

    def at_rounding(self, point):
        return bool(np.all(point.rss <= self.counts * (ROUNDING * self.size) ** 2))

    def resolves(self, theta):
        """Whether the samples can follow the states at these parameters."""
        finite = np.all(np.isfinite(theta))
        return finite and (
            n_substeps(self.structure, theta, self.omega, self.n_phases) <= MAX_SUBSTEPS
        )

    def point(self, theta, x0):
        """Residuals at some parameters and initial states."""
        response = self.response(theta, sensitivities=False)
        with np.errstate(over="ignore", invalid="ignore"):
            rss = sum(
                np.sum(residuals(response, record, start) ** 2, axis=0)
                for record, start in zip(self.records, x0, strict=True)
            )
            cost = self.cost(rss) if np.all(np.isfinite(rss)) else np.inf
        return Point(theta, x0, rss, cost, response.spectral_radius)

    def linearise(self, point, noise=None, *, parameters=True):
        """Least-squares system for a step from a point."""
        noise = self.noise(point.rss) if noise is None else noise
        response = self.response(point.theta, sensitivities=parameters)
        factors = [
            jacobian_factors(response, record, start, free_x0=self.free_x0)
            for record, start in zip(self.records, point.x0, strict=True)
        ]
        n0 = self.structure.n_states if self.free_x0 else 0
        return eliminate_states(factors, noise, n0)

    def predicted_cost(self, system, step, x0_step):
        """Cost at a step if the outputs were linear in it."""
        rss = 0.0
        for factors, states in zip(system.factors, x0_step, strict=True):
            rss = rss + np.sum((factors @ np.concatenate([states, step, [1.0]])) ** 2, axis=1)
        return self.cost(rss)


def eliminate_states(factors, noise, n0):
    """Weigh the outputs' factors, and take the projection on the initial states out.

    Parameters
    ----------
    factors : list of ndarray, shape (l, c, c)
        Of each segment, from :func:`sklearn_hd.algorithms.sensitivity.jacobian_factors`.
    noise : ndarray, shape (l,)
    n0 : int
        Columns of x0: n, or 0.

    Returns
    -------
    system : LinearSystem
    """
    width = factors[0].shape[2] - n0
    R, squares, states, promised = np.zeros((0, width)), np.zeros(width), [], 0.0
    for each in factors:
        stacked = (each / noise[:, None, None]).reshape(-1, n0 + width)
        rest = stacked[:, n0:]
        squares += np.sum(rest**2, axis=0)
        basis, inverse = _range(stacked[:, :n0])
        shares = np.zeros((basis.shape[1], width))
        for _ in range(2):  # the second time for the digits that the first one left
            share = basis.T @ rest
            rest, shares = rest - basis @ share, shares + share
        states.append(inverse @ shares)
        promised += shares[:, -1] @ shares[:, -1]
        R = linalg.qr(np.vstack([R, rest]), mode="r", check_finite=False)[0][:width]
    size = np.sqrt(squares[:-1])
    return LinearSystem(factors, R, np.where(size > 0, size, 1.0), states, float(promised))


def _range(matrix):
    """Orthonormal basis U of a matrix's range, and M⁺U."""
    size = column_sizes(matrix)
    left, singular, adjoint = linalg.svd(matrix / size, full_matrices=False)
    kept = singular > RANK
    return left[:, kept], adjoint[kept].T / singular[kept] / size[:, None]


def _problem(structure, segments, omega, n_phases, observe, free_x0, sigma):
    """The problem, its records checked."""
    n_outputs = structure.n_outputs if observe is None else np.shape(observe)[1]
    records = as_records(segments, structure.n_inputs, n_outputs)
    if sigma is not None:
        sigma = np.asarray(sigma, dtype=float)
        if sigma.shape != (n_outputs,) or not np.all(sigma > 0):
            raise ValueError(
                f"sigma={sigma.tolist()} must hold a positive standard deviation for each of "
                f"{n_outputs} outputs; leave it out to have them estimated"
            )
    counts = sum(record.present.sum(axis=0) for record in records)
    size = np.sqrt(sum(np.sum(record.outputs**2, axis=0) for record in records) / counts)
    largest = np.max(size) if np.max(size) > 0 else 1.0
    size = np.where(size > 0, size, largest)
    return Problem(structure, records, omega, n_phases, observe, free_x0, sigma, counts, size)


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


def _result(problem, point, n_iter, converged):
    """Estimates with their covariance at the point reached."""
    structure, n_residuals = problem.structure, problem.n_residuals
    n_fitted = structure.n_parameters + (point.x0.size if problem.free_x0 else 0)
    noise = problem.noise(point.rss)
    system = problem.linearise(point, noise)
    covariance, unknown = system.covariance()
    if problem.sigma is None:
        spent = n_fitted / n_residuals
        correction = 1.0 / np.sqrt(1.0 - spent) if spent < 1.0 else np.inf
        noise, covariance = noise * correction, covariance * correction**2
    return OutputErrorResult(
        theta=point.theta,
        x0=list(point.x0),
        sigma=noise,
        covariance=covariance,
        cost=point.cost,
        n_residuals=n_residuals,
        n_parameters=n_fitted + (len(noise) if problem.sigma is None else 0),
        n_iter=n_iter,
        converged=converged,
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
