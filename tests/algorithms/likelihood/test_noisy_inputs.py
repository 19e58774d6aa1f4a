"""Laws of total least squares: the filter against dense matrices, and what it gains."""

import numpy as np
import pytest
from output_error_cases import N_PHASES, OMEGA, fitted
from predictor_cases import deviations
from scipy import linalg

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.likelihood.noisy_inputs import NoisyInputProblem, innovation_filter
from sklearn_hd.algorithms.likelihood.predictor import as_records, residuals, simulate
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure, sampled_response

SIGMA, INPUT_SIGMA = np.array([0.1, 0.3]), np.array([0.2, 0.5])


@pytest.fixture
def structure():
    """A damped Mathieu oscillator with two inputs, position and acceleration measured."""
    M = np.zeros((3, 4, 4))
    M[0] = [[0, 1, 0, 0], [-4, -0.8, 4, 1], [1, 0, 0, 0.3], [-4, -0.8, 4, 0]]
    M[1, 1, 0] = -1.0
    basis = np.zeros((3, *M.shape))
    basis[0, 0, [1, 3], 0] = basis[1, 0, [1, 3], 1] = basis[2, 1, 1, 0] = 1.0
    return PeriodicStructure(M, basis, 2, ("stiffness", "damping", "modulation"))


def response_matrix(response, record):
    """H, (n_samples l, n_samples m): outputs, sample by sample, of unit inputs."""
    n_samples, m = record.inputs.shape
    columns = []
    for unit in np.eye(n_samples * m):
        inputs = unit.reshape(n_samples, m)
        [pulse] = as_records([(inputs, None, record.first_phase)], record.outputs.shape[1])
        y = simulate(response, pulse, np.zeros(response.n_states))[1]
        columns.append(y.ravel())
    return np.array(columns).T


@pytest.fixture
def noisy(structure, rng):
    """A record with noise everywhere, its response and its dense S."""
    response = sampled_response(structure, np.zeros(3), OMEGA, N_PHASES)
    y = rng.standard_normal((40, 2))
    [record] = as_records([(rng.standard_normal((40, 2)), y, 5)], 2)
    H = response_matrix(response, record)
    S = np.diag(np.tile(SIGMA**2, 40)) + (H * np.tile(INPUT_SIGMA**2, 40)) @ H.T
    return response, record, H, S


def test_innovations_whiten_the_dense_covariance(noisy):
    response, record, H, S = noisy
    r = residuals(response, record, np.array([1.0, -1.0]))
    whitening = innovation_filter(response, record, SIGMA, INPUT_SIGMA)
    whitened, _ = whitening.whiten(r)
    weighted = linalg.solve(S, r.ravel())
    assert np.sum(whitened**2) == pytest.approx(r.ravel() @ weighted, rel=1e-11)
    sizes = np.sum(np.log(np.diagonal(whitening.root, axis1=1, axis2=2)))
    assert -2 * sizes == pytest.approx(np.linalg.slogdet(S)[1], rel=1e-11)
    errors = (INPUT_SIGMA**2 * (H.T @ weighted).reshape(40, 2)).ravel()
    found = whitening.input_errors(whitened).ravel()
    np.testing.assert_allclose(found, errors, atol=1e-12 * np.abs(errors).max())


def test_whitening_in_pieces_is_whitening_at_once(noisy, rng):
    response, record, _, _ = noisy
    whitening = innovation_filter(response, record, SIGMA, INPUT_SIGMA)
    signals = rng.standard_normal((3, 40, 2))
    whole, _ = whitening.whiten(signals)
    first, state = whitening.whiten(signals[:, :23])
    second, _ = whitening.whiten(signals[:, 23:], state, 23)
    np.testing.assert_allclose(np.concatenate([first, second], axis=1), whole, atol=1e-13)


def test_gradient_is_that_of_the_criterion(structure, noisy):
    """Jᵀr, J taken at the corrected inputs, is half the derivative of rᵀ S(θ)⁻¹ r."""
    _, record, _, _ = noisy
    segments = [(record.inputs, record.outputs, 5)]
    plain = likelihood_problem(Form(structure, OMEGA, N_PHASES), segments, SIGMA)
    problem = NoisyInputProblem(
        plain.form, plain.records, np.ones(1), output_sigma=SIGMA, input_sigma=INPUT_SIGMA
    )
    start = np.array([0.5, -0.2, 0.1, -0.05, 0.2])  # x0, θ

    def cost(values):
        return problem.point(values[2:], values[None, :2]).cost

    factor = problem.factors(problem.point(start[2:], start[None, :2]), None)[0]
    gradient = (factor.T @ factor)[:-1, -1]
    differences = [(cost(start + d) - cost(start - d)) / 2e-5 for d in 1e-5 * np.eye(5)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-7)


def records(structure, rng, noise, input_noise, *, n_samples=800):
    theta = np.array([0.3, -0.1, 0.4])
    u = np.repeat(rng.standard_normal((n_samples // 4, 2)), 4, axis=0)
    [record] = as_records([(u, None, 0)], 2)
    response = sampled_response(structure, theta, OMEGA, N_PHASES)
    y = simulate(response, record, np.zeros(2))[1]
    measured = u + input_noise * rng.standard_normal(u.shape)
    return [(measured, y + noise * rng.standard_normal(y.shape), 0)], theta


@pytest.mark.slow
def test_exact_inputs_are_plain_output_error(structure, rng):
    segments, theta = records(structure, rng, 0.1, 0.0)
    options = {"sigma": [0.1, 0.2], "tol": 1e-14}
    plain = fitted(structure, segments, theta, **options)
    total = fitted(structure, segments, theta, input_sigma=[0.0, 0.0], **options)
    np.testing.assert_allclose(total.theta, plain.theta, rtol=1e-9)
    np.testing.assert_allclose(total.covariance, plain.covariance, rtol=1e-7)
    assert total.cost == pytest.approx(plain.cost)
    assert total.n_parameters == plain.n_parameters
    estimated = fitted(structure, segments, theta, input_sigma=[0.0, 0.0])
    plain = fitted(structure, segments, theta)
    np.testing.assert_allclose(estimated.theta, plain.theta, rtol=1e-4)
    np.testing.assert_allclose(estimated.sigma, plain.sigma, rtol=1e-3)
    assert estimated.n_parameters == plain.n_parameters


def test_noise_levels_of_the_outputs_are_found_beside_that_of_the_inputs(structure, rng):
    segments, theta = records(structure, rng, SIGMA, INPUT_SIGMA)
    result = fitted(structure, segments, theta, input_sigma=INPUT_SIGMA)
    assert result.converged
    np.testing.assert_allclose(result.sigma, SIGMA, rtol=0.3)
    assert np.all(np.abs(result.theta - theta) < 4 * deviations(result))


def test_all_noise_may_be_the_inputs(structure, rng):
    """Outputs without noise: little is left to them, within √(2/400) of the variance."""
    segments, theta = records(structure, rng, 0.0, INPUT_SIGMA, n_samples=400)
    result = fitted(structure, segments, theta, input_sigma=INPUT_SIGMA)
    plain = fitted(structure, segments, theta)
    assert np.all(result.sigma**2 < 2.0 * np.sqrt(2 / 400) * plain.sigma**2)
    assert np.all(np.abs(result.theta - theta) < 4 * deviations(result))


@pytest.mark.slow
def test_total_least_squares_beats_least_squares(structure):
    """Over 40 seeds: nearer to the truth, and intervals that cover."""
    errors, covered = {"plain": [], "total": []}, {"plain": [], "total": []}
    for seed in range(40):
        segments, theta = records(structure, np.random.default_rng(seed), SIGMA, INPUT_SIGMA)
        for name, known in (("plain", None), ("total", INPUT_SIGMA)):
            result = fitted(structure, segments, theta, input_sigma=known)
            errors[name].append(result.theta - theta)
            covered[name].append(np.abs(errors[name][-1]) < 1.96 * deviations(result))
    rms = {name: np.sqrt(np.mean(np.square(each), axis=0)) for name, each in errors.items()}
    assert np.all(rms["total"] < rms["plain"])
    assert 0.9 < np.mean(covered["total"]) < 0.99
