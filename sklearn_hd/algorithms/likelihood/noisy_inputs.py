"""Output error with noise in the measured inputs too: total least squares.

    u_measured = u + e_u,   y = H(θ) u + e_y,   r = H(θ) u_measured − y = H e_u − e_y

The most likely θ and e_u together minimise |e_y/σ_y|² + |e_u/σ_u|²; what is left of it
at the best e_u is

    rᵀ S⁻¹ r,   S = σ_y² I + σ_u² H Hᵀ

S is the covariance of a system driven by noise, ẋ = F x + G e_u, so that a Kalman filter
turns r into independent innovations (time-varying: S is neither formed nor factored), and
its adjoint gives the best e_u = σ_u² Hᵀ S⁻¹ r. Gauss-Newton steps take ∂ŷ/∂θ at the
inputs so corrected; at those measured, steps would be biased as least squares are.

References: W. A. Fuller, *Measurement Error Models*, 1987, section 3.2; A. E. Bryson,
M. Frazier, "Smoothing for linear and nonlinear dynamic systems", 1963.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from sklearn_hd.algorithms.likelihood.likelihood import Point, Problem, updated_factor
from sklearn_hd.algorithms.likelihood.predictor import output_sensitivities, residuals
from sklearn_hd.algorithms.likelihood.search import Search, result_of, search
from sklearn_hd.algorithms.periodic.floquet import propagate_periodic

SETTLED = 1e-3  # relative change of noise levels; far below their own error
SMALLEST_SHARE = 1e-3  # of the residual that is left to the output's own noise


@dataclass(frozen=True, eq=False)
class InnovationFilter:
    """Kalman filter of r = H e_u − e_y over one record.

    s[k+1] = (Φ_k − K_k C_k) s[k] + K_k r[k],   ν[k] = r[k] − C_k s[k]

    ``closed`` holds Φ_k − K_k C_k and ``output`` C_k. These and the others hold one
    matrix a sample, but for ``input_sigma`` (m,). ``covariance`` is that of the
    innovations, and ``root`` the inverse of its Cholesky factor.
    """

    closed: np.ndarray
    output: np.ndarray
    gain: np.ndarray
    covariance: np.ndarray
    root: np.ndarray
    input_matrix: np.ndarray
    feedthrough: np.ndarray
    input_sigma: np.ndarray

    def whiten(self, signals, state=None, start=0):
        """Independent innovations of unit variance, and the state to go on from.

        ``signals`` (..., n_some, l) begin at sample ``start``. ``state`` (..., n) is
        what an earlier piece ended with.
        """
        *batch, length, _ = signals.shape
        n = self.closed.shape[1]
        some = slice(start, start + length)
        forcing = np.zeros((*batch, length + 1, n))
        forcing[..., :-1, :] = _each(self.gain[some], signals)
        transitions = np.concatenate([self.closed[some], np.eye(n)[None]])
        first = np.zeros((*batch, n)) if state is None else state
        s = propagate_periodic(transitions, forcing, first)
        innovations = signals - _each(self.output[some], s[..., :-1, :])
        return _each(self.root[some], innovations), s[..., -1, :]

    def input_errors(self, whitened):
        """The most likely e_u, shape (n_samples, m), from whitened r (n_samples, l)."""
        scaled = _each(self.root.mT, whitened)
        backwards = self.closed.mT[::-1]
        forcing = _each(self.output.mT, scaled)[::-1]
        after = propagate_periodic(backwards, forcing, np.zeros(forcing.shape[1]))[::-1]
        weights = scaled - _each(self.gain.mT, after)  # S⁻¹ r
        push = _each(self.feedthrough.mT, weights)
        return (push + _each(self.input_matrix.mT, after)) * self.input_sigma**2


def innovation_filter(response, record, sigma, input_sigma):
    """Kalman filter of the residuals that noise in inputs and outputs leaves.

    ``sigma`` (l,) and ``input_sigma`` (m,) are the standard deviations of that noise.
    """
    n, n_samples = response.n_states, len(record.inputs)
    phase = record.first_phase + np.arange(n_samples)
    Psi, Out = response.Psi[phase % len(response.Psi)], response.Out[phase % len(response.Out)]
    Phi, C = Psi[:, :, :n], Out[:, :, :n]
    roots = np.concatenate([Psi, Out], axis=1)[:, :, n:] * input_sigma
    pushed = roots @ roots.mT  # covariance of [Γ; Q] e_u
    pushed[:, n:, n:] += np.diag(sigma**2)
    moved = np.concatenate([Phi, C], axis=1)
    gain, covariance = np.empty((n_samples, n, len(sigma))), pushed[:, n:, n:].copy()
    state = np.zeros((n, n))
    for k in range(n_samples):
        joint = moved[k] @ state @ moved[k].T + pushed[k]
        gain[k] = np.linalg.solve(joint[n:, n:], joint[n:, :n]).T
        state = joint[:n, :n] - gain[k] @ joint[n:, :n]
        covariance[k] = joint[n:, n:]
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    closed = Phi - gain @ C
    return InnovationFilter(
        closed, C, gain, covariance, root, Psi[:, :, n:], Out[:, :, n:], np.asarray(input_sigma)
    )


def _each(matrices, signals):
    """M[k] s[k] for matrices (n_samples, a, b) and signals (..., n_samples, b)."""
    return np.einsum("kab,...kb->...ka", matrices, signals)


@dataclass(frozen=True, eq=False)
class NoisyInputProblem(Problem):
    """Total least squares: the likelihood of θ, x0 and e_u, the latter at its best.

    The search sees one output of unit noise, the innovations of all.
    """

    output_sigma: np.ndarray | None = None
    input_sigma: np.ndarray | None = None
    _last: dict = field(default_factory=dict, repr=False)

    def filters(self, theta, response):
        """Filters of all records; the last ones are kept, for steps return to where they are."""
        if self._last.get("theta") is not theta:
            found = [
                innovation_filter(response, record, self.output_sigma, self.input_sigma)
                for record in self.records
            ]
            self._last.update(theta=theta, filters=found)
        return self._last["filters"]

    def spread(self, moments):
        return np.eye(1)

    def cost(self, moments):
        return self.n_residuals * np.log(np.sqrt(2.0 * np.pi)) + 0.5 * float(moments[0, 0])

    def at_rounding(self, point):
        return False

    def point(self, theta, x0):
        response = self.form.response(theta, sensitivities=False)
        rss, cost = np.zeros((1, 1)), np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            r = [residuals(response, record, x) for record, x in zip(self.records, x0, strict=True)]
            rough = sum(float(np.sum(each**2)) for each in r)
        if np.isfinite(rough):
            for whitening, each in zip(self.filters(theta, response), r, strict=True):
                rss += np.sum(whitening.whiten(each)[0] ** 2)
            cost = self.cost(rss)
        return Point(theta, x0, rss, cost, self.form.radius(response))

    def likelihood(self, point):
        """Negative logarithm of the likelihood of the innovations, their sizes included."""
        filters = self.filters(point.theta, self.form.response(point.theta, sensitivities=False))
        sizes = [np.diagonal(each.root, axis1=1, axis2=2) for each in filters]
        return point.cost - sum(np.sum(np.log(size)) for size in sizes)

    def updated_output_sigma(self, point):
        """Noise of the outputs whose innovations would be as large as those found.

        σ_i² grows by the mean of ν_i² less its expectation.
        """
        response = self.form.response(point.theta, sensitivities=False)
        n_fitted = len(point.theta) + point.x0.size
        found, expected = 0.0, 0.0
        for whitening, record, start in zip(
            self.filters(point.theta, response), self.records, point.x0, strict=True
        ):
            whitened = whitening.whiten(residuals(response, record, start))[0]
            innovations = np.linalg.solve(whitening.root, whitened[:, :, None])[:, :, 0]
            variance = np.diagonal(whitening.covariance, axis1=1, axis2=2)
            found = found + np.sum(innovations**2, axis=0)
            expected = expected + np.sum(variance, axis=0)
        found = found / (1.0 - n_fitted / self.n_residuals)
        old = self.output_sigma**2
        return np.sqrt(np.maximum(old + (found - expected) / self.n_rows, 0.0))

    def with_best_inputs(self, point):
        return point

    def factors(self, point, spread, only=None):
        """Triangular factor of the whitened [∂ŷ/∂x0, ∂ŷ/∂θ, r] of each segment."""
        response = self.form.response(point.theta, sensitivities=True)
        return [
            self._factor(response, *each)
            for each in zip(
                self.filters(point.theta, response), self.records, point.x0, strict=True
            )
        ]

    def _factor(self, response, whitening, record, x0):
        whitened = whitening.whiten(residuals(response, record, x0))[0]
        corrected = replace(record, inputs=record.inputs - whitening.input_errors(whitened))
        factor, state = None, None
        pieces = output_sensitivities(response, corrected, x0)
        for start, stop, dy in pieces:
            dy, state = whitening.whiten(dy[:-1], state, start)
            block = np.concatenate([dy, whitened[None, start:stop]])
            factor = np.zeros((len(block), len(block))) if factor is None else factor
            factor = updated_factor(factor, block.reshape(len(block), -1))
        return factor


def with_noisy_inputs(problem, found, input_sigma, options):
    """Total least squares from where least squares ended, the outputs' noise in turn with it."""
    sigma = np.sqrt(np.diag(problem.spread(found.point.moments)))
    n_iter, settled = found.n_iter, False
    smallest, form = SMALLEST_SHARE * sigma, replace(problem.form, input_size=None)
    for _ in range(options["max_iter"]):
        noisy = NoisyInputProblem(
            form, problem.records, np.ones(1), output_sigma=sigma, input_sigma=input_sigma
        )
        begin = noisy.point(found.point.theta, found.point.x0)
        found = search(noisy, begin, **options)
        n_iter += found.n_iter
        if problem.sigma is not None:
            settled = True
            break
        old, sigma = sigma, np.maximum(noisy.updated_output_sigma(found.point), smallest)
        settled = bool(np.all(np.abs(sigma - old) <= SETTLED * old))
        if settled:
            break
    found = Search(found.point, n_iter, found.converged and settled)
    result = result_of(noisy, found)
    return replace(
        result,
        spread=np.diag(sigma**2),
        cost=noisy.likelihood(found.point),
        n_parameters=result.n_parameters + (len(sigma) if problem.sigma is None else 0),
    )
