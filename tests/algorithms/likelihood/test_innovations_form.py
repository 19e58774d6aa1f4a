"""Laws of the likelihood of predictions: its covariance, its search, its gain."""

import numpy as np
import pytest
from predictor_cases import OMEGA, deviations, oscillator, plain_predictions
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from sklearn_hd.algorithms.likelihood.forms import Form, interpolating
from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.likelihood.prediction_error import (
    RATIOS,
    _answering_alike,
    first_gain,
    fit_gain,
    prediction_error,
)
from sklearn_hd.algorithms.likelihood.predictor import as_records, residuals, simulate
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics

SPREAD = np.array([[0.04, 0.015], [0.015, 0.02]])


def simulated(form, theta, gain, rng, n_samples, *, first=0, spread=SPREAD, hold=6):
    """A record of the innovations form itself, from rest."""
    psi = 2 * np.pi * (first + np.arange(n_samples)) / form.n_phases
    response = form.with_gain(None).response(theta, sensitivities=False)
    Psi, Out = response.Psi, response.Out
    K = np.zeros((1, 2, 2)) if gain is None else gain
    K = evaluate_harmonics(K, psi) if len(K) > 1 else np.broadcast_to(K[0], (n_samples, 2, 2))
    u = np.repeat(rng.standard_normal(n_samples // hold + 1), hold)[:n_samples, None]
    e = rng.standard_normal((n_samples, 2)) @ np.linalg.cholesky(spread).T
    x, y = np.zeros(2), np.empty((n_samples, 2))
    for j in range(n_samples):
        z = np.append(x, u[j])
        phase = (first + j) % 8
        y[j] = Out[phase % len(Out)] @ z + e[j]
        x = Psi[phase % len(Psi)] @ z + K[j] @ e[j]
    return u, y, first


@pytest.fixture
def fitted(rng):
    """A form with a gain, a record, and parameters near the truth."""
    structure, theta = oscillator()
    form = Form(structure, OMEGA, 8, n_gain_harmonics=1)
    gain = 0.2 * rng.standard_normal((3, 2, 2))
    segments = [simulated(form, theta, gain, rng, n, first=f) for n, f in ((130, 0), (75, 3))]
    return form, segments, np.concatenate([theta, gain.ravel()])


def log_density(S, left):
    """−log of the normal density of residuals, by SciPy."""
    return -np.sum(multivariate_normal(np.zeros(len(S)), S).logpdf(left))


def left_of(problem, point):
    response = problem.form.response(point.theta, sensitivities=False)
    pairs = zip(problem.records, point.x0, strict=True)
    return np.concatenate([residuals(response, record, x0) for record, x0 in pairs])


@pytest.mark.slow
@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("sigma", [None, (0.2, 0.15)])
def test_cost_is_the_logarithm_of_the_normal_density(fitted, rng, correlated, sigma):
    form, segments, parameters = fitted
    problem = likelihood_problem(form, segments, sigma, correlated)
    point = problem.point(parameters, 0.1 * rng.standard_normal((2, 2)))
    S, left = problem.spread(point.moments), left_of(problem, point)
    assert point.cost == pytest.approx(log_density(S, left), rel=1e-10)
    assert (S[0, 1] == 0.0) == (not correlated or sigma is not None)
    np.testing.assert_allclose(point.rss, np.sum(left**2, axis=0))
    if sigma is None:  # the covariance itself
        expected = left.T @ left / len(left)
        expected = expected if correlated else np.diag(np.diag(expected))
        np.testing.assert_allclose(S, expected, rtol=1e-7)
    if sigma is not None:
        np.testing.assert_allclose(S, np.diag(np.square(sigma)))
    psi = [2 * np.pi * (first + np.arange(len(u))) / 8 for u, _, first in segments]
    expected = [
        plain_predictions(form, parameters, record, angles, x0)
        for record, angles, x0 in zip(problem.records, psi, point.x0, strict=True)
    ]
    outputs = np.concatenate([record.outputs for record in problem.records])
    expected = np.concatenate(expected) - outputs
    np.testing.assert_allclose(left, expected, atol=1e-8)


def test_the_covariance_is_the_most_likely_one(fitted, rng):
    """No other covariance, however near, is more likely; and it is that of another search."""
    form, segments, parameters = fitted
    problem = likelihood_problem(form, segments, correlated=True)
    point = problem.point(parameters, np.zeros((2, 2)))
    S, left = problem.spread(point.moments), left_of(problem, point)
    best = log_density(S, left)
    for step in (1e-2, 1e-3):
        for change in ([[1, 0], [0, 0]], [[0, 0], [0, 1]], [[0, 1], [1, 0]]):
            for sign in (1.0, -1.0):
                moved = S + sign * step * np.max(S) * np.array(change)
                assert log_density(moved, left) > best

    def cost(values):
        L = np.array([[np.exp(values[0]), 0.0], [values[1], np.exp(values[2])]])
        return log_density(L @ L.T, left)

    L = np.linalg.cholesky(np.diag(np.diag(S)))
    found = minimize(cost, [np.log(L[0, 0]), 0.0, np.log(L[1, 1])], tol=1e-10).x
    L = np.array([[np.exp(found[0]), 0.0], [found[1], np.exp(found[2])]])
    np.testing.assert_allclose(L @ L.T, S, rtol=1e-4)


@pytest.mark.slow
def test_a_step_promises_what_it_keeps(fitted, rng):
    """The gradient of the cost, S at its own optimum, is that of central differences."""
    form, segments, parameters = fitted
    problem = likelihood_problem(form, segments, correlated=True)
    x0 = 0.1 * rng.standard_normal((2, 2))
    point = problem.point(parameters, x0)
    found = np.zeros(len(parameters) + 2)
    for segment, _, block in problem.whitened(point, problem.spread(point.moments)):
        slope = np.tensordot(block[:-1], block[-1], 2)
        found[2:] += slope[2:]
        if segment == 0:
            found[:2] += slope[:2]
    expected = []
    for k in range(len(found)):
        ends = []
        for step in (1e-6, -1e-6):
            theta, start = parameters.copy(), x0.copy()
            if k < 2:
                start[0, k] += step
            else:
                theta[k - 2] += step
            ends.append(problem.point(theta, start).cost)
        expected.append((ends[0] - ends[1]) / 2e-6)
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.max(np.abs(expected)))


@pytest.mark.slow
@pytest.mark.parametrize("correlated", [False, True])
def test_the_best_inputs_are_the_optimum_of_what_is_linear(fitted, correlated):
    """The gradient by G, Q and initial states is zero; F, P and the gain stay."""
    form, segments, parameters = fitted
    problem = likelihood_problem(form, segments, correlated=correlated)
    moved = parameters.copy()
    moved[form.linear] += 1.0
    start = problem.point(moved, np.ones((2, 2)))
    found = problem.with_best_inputs(start)
    for _ in range(60):  # S in turn
        found = problem.with_best_inputs(found)
    assert found.cost < start.cost
    others = np.setdiff1d(np.arange(len(moved)), form.linear)
    np.testing.assert_array_equal(found.theta[others], moved[others])
    assert len(form.linear) > 0
    slopes = np.zeros((2, len(form.linear) + 2))
    for segment, _, block in problem.whitened(found, problem.spread(found.moments), form.linear):
        slopes[segment] += np.tensordot(block[:-1], block[-1], 2)
        scale = np.linalg.norm(block[:-1].reshape(len(block) - 1, -1), axis=1)
    scale = np.max(scale)
    assert np.max(np.abs(slopes[:, :2])) < 1e-4 * scale
    assert np.max(np.abs(slopes[:, 2:].sum(axis=0))) < 1e-4 * scale


# ---- the search ---------------------------------------------------------------------------


@pytest.mark.slow
def test_a_periodic_innovations_model_is_found_within_its_deviations(rng):
    structure, theta = oscillator()
    form = Form(structure, OMEGA, 8)
    gain = np.zeros((3, 2, 2))
    gain[0], gain[1] = [[0.35, 0.1], [-0.2, 0.3]], [[0.1, 0.0], [0.15, -0.1]]
    segments = [simulated(form, theta, gain, rng, 6000)]
    result = prediction_error(form, segments, 1.05 * theta)
    assert result.converged
    assert result.problem.form.n_gain_harmonics >= 1
    z = (result.theta - theta) / deviations(result)
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert np.max(np.abs(z)) < 3.5
    np.testing.assert_allclose(result.gain[:3], gain, atol=0.06)
    np.testing.assert_allclose(result.spread, SPREAD, atol=0.004)
    k = structure.n_parameters
    assert result.covariance.shape == (k, k)
    assert result.n_parameters == k + result.gain.size + 2 + 3  # x0, S
    assert result.aic == pytest.approx(2 * (result.n_parameters + result.cost))


@pytest.mark.slow
def test_its_deviations_are_those_of_many_records(rng):
    """Twelve short fits of four parameters: rms of error over deviation is near one."""
    structure, theta = oscillator(varies="", steps=True)
    form = Form(structure, 1.0, 8, discrete=True)
    kept = [0, 1, 2, 3]
    small = structure.restricted(kept)
    rest = np.delete(np.arange(len(theta)), kept)
    constant = structure.coefficients(np.where(np.isin(np.arange(len(theta)), rest), theta, 0.0))
    small = type(structure)(constant, small.basis, 2, small.parameter_names)
    form, z = Form(small, 1.0, 8, discrete=True), []
    gain = np.array([[[0.4, 0.1], [-0.2, 0.3]]])
    for _ in range(12):
        segments = [simulated(form, theta[kept], gain, rng, 700)]
        result = fit_gain(form.with_gain(0), segments, theta[kept], gain)
        covariance, _ = result.problem.linearise(result.point).covariance()
        z.append((result.theta - theta[kept]) / np.sqrt(np.diag(covariance)[:4]))
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.35


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n_records", "most"), [(4, 1), pytest.param(20, 4, marks=pytest.mark.slow)]
)
def test_no_gain_where_no_noise_moves_the_states(n_records, most):
    """The share of records of white noise on the outputs that is given a gain."""
    structure, theta = oscillator(varies="")
    form, taken = Form(structure, OMEGA, 8), 0
    for seed in range(n_records):
        rng = np.random.default_rng(seed)
        segments = [simulated(form, theta, None, rng, 200, spread=np.diag([0.04, 0.02]))]
        taken += prediction_error(form, segments, theta).gain is not None
    assert taken <= most


@pytest.mark.slow
def test_a_gain_where_noise_moves_the_states():
    structure, theta = oscillator(varies="")
    form = Form(structure, OMEGA, 8)
    for seed in range(4):
        rng = np.random.default_rng(seed)
        gain = np.array([[[0.3, 0.0], [0.0, 0.3]]])
        segments = [simulated(form, theta, gain, rng, 400)]
        found = prediction_error(form, segments, theta)
        assert found.gain is not None
        assert found.problem.form.n_gain_harmonics == 0  # nothing turns


def test_an_unstable_machine_with_a_stable_predictor_is_found(rng):
    structure, theta = oscillator(varies="", steps=True)
    theta = theta.copy()
    theta[0], theta[4] = 1.0, 0.97  # two of A's diagonal
    form = Form(structure, OMEGA, 8, discrete=True)
    A = structure.coefficients(theta)[0, :2, :2]
    assert np.max(np.abs(np.linalg.eigvals(A))) > 1.0
    gain = 0.7 * A @ np.linalg.inv(structure.coefficients(theta)[0, 2:, :2])
    segments = [simulated(form, theta, gain[None], rng, 300)]
    assert np.std(segments[0][1]) > 100 * np.sqrt(SPREAD[0, 0])
    found = prediction_error(form, segments, theta)
    assert found.converged
    found_A = structure.coefficients(found.theta)[0, :2, :2]
    one, other = (np.sort_complex(np.linalg.eigvals(M)) for M in (found_A, A))
    np.testing.assert_allclose(one, other, atol=5e-3)
    response = found.problem.form.response(found.point.theta, sensitivities=False)
    assert found.problem.form.radius(response) < 1.0
    grows = theta.copy()
    grows[0] = 1e3
    with pytest.raises(ValueError, match="overflows"):  # what a simulation cannot do
        fit_gain(form, segments, grows, None)


def test_a_record_cut_in_two_tells_nearly_the_same(rng):
    structure, theta = oscillator()
    form = Form(structure, OMEGA, 8)
    gain = np.array([[[0.35, 0.1], [-0.2, 0.3]]])
    u, y, _ = simulated(form, theta, gain, rng, 2400)
    whole = fit_gain(form.with_gain(0), [(u, y, 0)], theta, gain)
    cut = [(u[:1203], y[:1203], 0), (u[1203:], y[1203:], 1203)]
    cut = fit_gain(form.with_gain(0), cut, theta, gain)
    assert len(cut.point.x0) == 2
    assert np.max(np.abs(cut.theta - whole.theta) / deviations(whole)) < 0.5
    np.testing.assert_allclose(deviations(cut), deviations(whole), rtol=0.05)


@pytest.mark.slow
def test_a_gain_that_is_given_is_one_to_start_from(rng):
    structure, theta = oscillator()
    form = Form(structure, OMEGA, 8)
    gain = 0.3 * rng.standard_normal((1, 2, 2))
    segments = [simulated(form, theta, gain, rng, 500)]
    n_harmonics, found = first_gain(form, segments, theta, gain)
    assert n_harmonics == 0
    np.testing.assert_array_equal(found, gain)
    count, by_itself = first_gain(form, segments, theta)
    assert by_itself.shape == (2 * count + 1, 2, 2)
    assert not np.array_equal(by_itself[:1], gain)
    # one that makes the predictor's first cost worse is left
    _, wrong = first_gain(form, segments, theta, np.full((1, 2, 2), 0.9))
    np.testing.assert_array_equal(wrong, by_itself)


@pytest.mark.slow
def test_a_gain_whose_predictor_overflows_is_none_to_start_from(rng):
    """As that of a gain that has been cut to fewer harmonics than its model needs."""
    structure, theta = oscillator()
    form = Form(structure, OMEGA, 8)
    segments = [simulated(form, theta, np.full((1, 2, 2), 0.2), rng, 3000)]
    wild = np.full((1, 2, 2), 50.0)
    for counts in (None, [0]):
        _, found = first_gain(form, segments, theta, wild, counts)
        _, by_itself = first_gain(form, segments, theta, counts=counts)
        np.testing.assert_array_equal(found, by_itself)


def test_the_first_gain_is_that_of_a_kalman_filter(rng):
    """Of noise in the states and on the outputs: that of the Riccati equation, for some ratio."""
    structure, theta = oscillator(varies="")
    form = Form(structure, OMEGA, 8)
    segments = [simulated(form, theta, np.full((1, 2, 2), 0.2), rng, 300)]
    response = form.response(theta, sensitivities=False)
    size = likelihood_problem(form, segments).size
    A, C = response.Phi[0], response.Out[0, :, :2] / size[:, None]
    gains = []
    for ratio in RATIOS:
        Q = ratio * _answering_alike(A[None], C[None])
        P = solve_discrete_are(A.T, C.T, Q, np.eye(2))
        gains.append(A @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(2)) / size)
    found = first_gain(form, segments, theta)[1][0]
    assert min(np.max(np.abs(found - K)) for K in gains) < 1e-6


def test_bounds_hold_for_the_structure_and_leave_the_gain_free(rng):
    structure, theta = oscillator(varies="")
    form = Form(structure, OMEGA, 8)
    gain = np.array([[[0.3, 0.0], [0.0, 0.3]]])
    segments = [simulated(form, theta, gain, rng, 400)]
    lower, upper = np.full(len(theta), -np.inf), np.full(len(theta), np.inf)
    upper[0] = theta[0] - 0.2
    start = np.minimum(theta, upper)
    found = prediction_error(form, segments, start, bounds=(lower, upper))
    assert found.theta[0] <= upper[0]
    assert found.gain is not None


@pytest.mark.slow
def test_an_awkward_clock_is_fitted_too(rng):
    structure, theta = oscillator()
    form = interpolating(Form(structure, OMEGA, 7.3), theta)
    n = 500
    psi = 2 * np.pi * np.arange(n) / 7.3
    u = np.repeat(rng.standard_normal(n // 5), 5)[:, None]
    record = as_records([(u, np.zeros((n, 2)), psi)], 2)[0]
    y = simulate(form.response(theta, sensitivities=False), record, np.zeros(2))[1]
    y = y + 0.02 * rng.standard_normal(y.shape)
    result = prediction_error(form, [(u, y, psi)], 1.03 * theta)
    assert np.max(np.abs(result.theta - theta) / deviations(result)) < 4.0
