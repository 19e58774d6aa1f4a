"""Laws of the output-error fit: exact answers, and the bound that noise sets."""

from dataclasses import replace

import numpy as np
import pytest
from output_error_cases import N_PHASES, OMEGA, fitted
from predictor_cases import deviations, structure_of
from scipy import linalg

from sklearn_hd.algorithms.likelihood import predictor
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import eliminate_states, likelihood_problem
from sklearn_hd.algorithms.likelihood.prediction_error import output_error_of
from sklearn_hd.algorithms.likelihood.predictor import (
    as_records,
    output_sensitivities,
    residuals,
    simulate,
)
from sklearn_hd.algorithms.likelihood.search import search, start
from sklearn_hd.algorithms.likelihood.uncertainty import (
    exponent_slopes,
    fisher_information,
    propagate_std,
)
from sklearn_hd.algorithms.periodic.periodic_structure import sampled_response
from sklearn_hd.algorithms.signals.fourier import harmonic_functions


@pytest.fixture
def oscillator():
    """A Mathieu oscillator: stiffness, its modulation, damping and gain free; q measured."""
    M = np.zeros((3, 3, 3))
    M[0] = [[0.0, 1.0, 0.0], [-9.0, -0.8, 4.0], [1.0, 0.0, 0.1]]
    M[1, 1, 0], M[2, 1, 0] = -2.0, 1.0
    free = np.zeros(M.shape, dtype=bool)
    free[:, 1, 0] = free[0, 1, 1] = free[0, 1, 2] = free[0, 2, 2] = True
    return structure_of(M, free, 2)


def recorded(structure, theta, rng, *, lengths=(150, 97), phases=(0, 5), noise=0.0, observe=None):
    """Records of random held inputs, from random initial states."""
    response = sampled_response(structure, theta, OMEGA, N_PHASES, observe)
    segments, starts = [], []
    for n_samples, phase in zip(lengths, phases, strict=True):
        u = np.repeat(rng.standard_normal((n_samples // 4 + 1, structure.n_inputs)), 4, axis=0)
        u = u[:n_samples]
        starts.append(rng.standard_normal(structure.n_states))
        record = as_records([(u, None, phase)], response.Out.shape[1])[0]
        y = simulate(response, record, starts[-1])[1]
        segments.append((u, y + noise * rng.standard_normal(y.shape), phase))
    return segments, np.array(starts)


def residual_vector(structure, theta, segments, x0, observe=None):
    response = sampled_response(structure, theta, OMEGA, N_PHASES, observe)
    records = as_records(segments, response.Out.shape[1])
    parts = [residuals(response, record, start) for record, start in zip(records, x0, strict=True)]
    return np.concatenate(parts)


def jacobian(response, record, x0):
    """[∂ŷ/∂x0, ∂ŷ/∂θ, ŷ − y] of one output, shape (n_samples, c)."""
    pieces = output_sensitivities(response, record, x0)
    return np.concatenate([dy for *_, dy in pieces], axis=1)[:, :, 0].T


# ---- sensitivities ------------------------------------------------------------------------


@pytest.mark.parametrize("piece", [1, 3000, 8_000_000])
def test_jacobian_is_that_of_central_differences(oscillator, rng, piece, monkeypatch):
    """All at once or piece by piece."""
    monkeypatch.setattr(predictor, "AT_ONCE", piece)
    structure, theta = oscillator
    segments, x0 = recorded(structure, theta, rng, lengths=(150,), phases=(5,), noise=0.1)
    response = sampled_response(structure, theta, OMEGA, N_PHASES)
    record = as_records(segments, 1)[0]
    factor = jacobian(response, record, x0[0])

    def residual(values):
        return residual_vector(structure, values[2:], segments, [values[:2]])[:, 0]

    values, step = np.concatenate([x0[0], theta]), 1e-6
    columns = [
        (residual(values + d) - residual(values - d)) / (2 * step)
        for d in step * np.eye(len(values))
    ]
    stacked = np.column_stack([*columns, residual(values)])
    exact = stacked.T @ stacked
    size = np.sqrt(np.diag(exact))
    scale = size[:, None] * size
    np.testing.assert_allclose(factor.T @ factor / scale, exact / scale, rtol=0, atol=1e-7)


def test_simulation_is_the_recursion(oscillator, rng):
    structure, theta = oscillator
    response = sampled_response(structure, theta, OMEGA, N_PHASES)
    record = as_records([(rng.standard_normal((40, 1)), None, 21)], 1)[0]
    x = np.array([1.0, -2.0])
    states, outputs = simulate(response, record, x)
    for k, u in enumerate(record.inputs):
        z = np.concatenate([x, u])
        np.testing.assert_allclose(states[k], x, atol=1e-12)
        np.testing.assert_allclose(outputs[k], response.Out[0] @ z, atol=1e-12)
        x = response.Psi[(21 + k) % N_PHASES] @ z


# ---- without noise ------------------------------------------------------------------------


def test_noise_free_records_give_the_truth(oscillator, rng):
    structure, theta = oscillator
    segments, x0 = recorded(structure, theta, rng)
    result = fitted(structure, segments, theta * 1.1)
    assert result.converged
    assert result.unidentified == ()
    np.testing.assert_allclose(result.theta, theta, rtol=1e-12)
    np.testing.assert_allclose(result.point.x0, x0, atol=1e-12)
    assert np.all(deviations(result) < 1e-12)


def test_time_invariant_states_measured_give_the_regression(rng):
    """With C = I and no noise, x[k+1] = A x[k] + B u[k] is exact by linear least squares."""
    M = np.zeros((1, 6, 4))
    M[0, :3] = rng.standard_normal((3, 4)) - 2.0 * np.eye(3, 4)
    M[0, 3:, :3] = np.eye(3)
    free = np.zeros(M.shape, dtype=bool)
    free[:, :3] = True
    structure, theta = structure_of(M, free, 3)
    [(u, y, _)], _ = recorded(structure, theta, rng, lengths=(200,), phases=(0,))
    regression = linalg.lstsq(np.hstack([y[:-1], u[:-1]]), y[1:])[0].T
    block = np.eye(4)
    block[:3] = regression
    exact = linalg.logm(block).real[:3] * N_PHASES * OMEGA / (2 * np.pi)
    result = fitted(structure, [(u, y, 0)], theta * 1.05)
    np.testing.assert_allclose(result.theta.reshape(3, 4), exact, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(result.theta, theta, rtol=1e-11, atol=1e-12)


def test_outputs_of_very_different_size_and_noise(rng):
    """One output without noise: it rules, at whatever scale the other is."""
    M = np.zeros((1, 3, 2))
    M[0] = [[-1.0, 1.0], [1e6, 0.0], [1e-6, 0.0]]
    free = np.zeros(M.shape, dtype=bool)
    free[0, 0] = free[0, 1, 0] = True
    structure, theta = structure_of(M, free, 1)
    [(u, y, phase)], _ = recorded(structure, theta, rng, lengths=(300,), phases=(0,))
    y[:, 0] += 1e5 * rng.standard_normal(300)
    result = fitted(structure, [(u, y, phase)], theta * 0.9)
    assert result.converged
    np.testing.assert_allclose(result.theta[:2], theta[:2], rtol=1e-12)
    assert abs(result.theta[2] - theta[2]) < 4 * deviations(result)[2]
    assert result.sigma[0] == pytest.approx(1e5, rel=0.15)
    assert result.sigma[1] < 1e-20


def test_observed_harmonics(rng):
    """A time-invariant model of harmonics is fitted to the signal that they make."""
    M = np.zeros((1, 6, 4))
    M[0, :3, :3] = [[-1.0, 0.4, 0.0], [0.3, -2.0, -6.0], [0.0, 6.5, -2.0]]
    M[0, 1, 3], M[0, 3:, :3] = 1.0, np.eye(3)
    free = np.zeros(M.shape, dtype=bool)
    free[0, :3, :3], free[0, 1, 3] = M[0, :3, :3] != 0, True
    structure, theta = structure_of(M, free, 3)
    functions = harmonic_functions(2 * np.pi * np.arange(N_PHASES) / N_PHASES, [0, 1])
    observe = functions[:, None, :]
    segments, x0 = recorded(structure, theta, rng, observe=observe)
    result = output_error_of(Form(structure, OMEGA, N_PHASES, observe), segments, theta * 1.03)
    np.testing.assert_allclose(result.theta, theta, rtol=1e-10)
    np.testing.assert_allclose(result.point.x0, x0, atol=1e-10)


# ---- degrees of freedom -------------------------------------------------------------------


def test_parameters_without_effect_are_named(rng):
    """y = c x, x' = −x + b u: only b c matters; and d has no effect at all."""
    M = np.zeros((1, 2, 3))
    M[0] = [[-1.0, 2.0, 0.7], [3.0, 0.0, 0.0]]
    free = np.zeros(M.shape, dtype=bool)
    free[0, 0], free[0, 1, 0] = True, True
    structure, theta = structure_of(M, free, 1)
    [(u, y, phase)], _ = recorded(structure, theta, rng, lengths=(200,), phases=(0,))
    u[:, 1] = 0.0
    record = as_records([(u, None, phase)], 1)[0]
    y = simulate(sampled_response(structure, theta, OMEGA, N_PHASES), record, [0.5])[1]
    start = theta * [1.1, 1.2, 1.0, 1.3]
    y += 0.01 * rng.standard_normal(y.shape)
    result = fitted(structure, [(u, y, phase)], start)
    assert result.converged
    assert result.unidentified == ("0,0,1", "0,0,2", "0,1,0")
    assert result.theta[1] * result.theta[3] == pytest.approx(6.0, rel=0.01)
    assert result.theta[2] == start[2]
    assert np.isfinite(deviations(result)).tolist() == [True, False, False, False]
    assert np.isnan(result.covariance[0, 1])


def test_eliminating_the_initial_state_is_the_schur_complement(oscillator, rng):
    structure, theta = oscillator
    segments, _ = recorded(structure, theta, rng)
    response = sampled_response(structure, theta, OMEGA, N_PHASES)
    full = np.zeros((10, 10))  # two initial states of two, six parameters
    for k, record in enumerate(as_records(segments, 1)):
        R = jacobian(response, record, np.zeros(2))[:, :-1] / 0.3
        mine = [2 * k, 2 * k + 1, *range(4, 10)]
        full[np.ix_(mine, mine)] += R.T @ R
    form = Form(structure, OMEGA, N_PHASES)
    bound = fisher_information(form, theta, segments, [0.3])
    np.testing.assert_allclose(bound.covariance, linalg.inv(full)[4:, 4:], rtol=1e-9)
    np.testing.assert_allclose(bound.information @ bound.covariance, np.eye(6), atol=1e-9)
    assert np.all(1.0 / np.diag(linalg.inv(full[4:, 4:])) > 1.0 / np.diag(bound.covariance))
    assert bound.unidentified == ()


# ---- what is known beforehand -------------------------------------------------------------------


def test_stiffness_counts_only_where_records_tell_less(rng):
    """Precision S (I + S⁻¹ M S⁻¹)⁻¹ S, M being what the records tell when all else is free."""
    J = rng.standard_normal((40, 5)) * [3.0, 1.0, 1e3, 1.0, 1.0]
    J[:, 3] = 0.0
    system = eliminate_states([np.linalg.qr(np.column_stack([J, rng.standard_normal(40)]))[1]], 0)
    S = np.array([0.0, 2.0, 1.0, 0.5, 10.0])
    rows = system.untold(S)
    own, J = J[:, 1:], J[:, :1]
    rest = own - J @ (J.T @ own) / np.sum(J**2)
    told = rest.T @ rest / np.outer(S[1:], S[1:])
    expected = np.linalg.inv(np.eye(4) + told) * np.outer(S[1:], S[1:])
    np.testing.assert_allclose(rows[:, 1:].T @ rows[:, 1:], expected, atol=1e-12)
    assert not rows[:, 0].any()
    assert expected[2, 2] == pytest.approx(0.25)  # of nothing that the records tell: all of it
    assert expected[1, 1] < 1e-4  # of what they tell: next to nothing


def test_free_parameters_that_nothing_tells_take_nothing_from_stiff_ones(rng):
    """Columns of zeros, and dependent ones, have no direction of their own."""
    free, own = rng.standard_normal((40, 2)), 30.0 * rng.standard_normal((40, 2))
    left, S = rng.standard_normal((40, 1)), np.array([2.0, 0.5])

    def precision(*columns):
        J = np.hstack([*columns, own])
        system = eliminate_states([np.linalg.qr(np.hstack([J, left]))[1]], 0)
        rows = system.untold(np.append(np.zeros(J.shape[1] - 2), S))
        return (rows.T @ rows)[-2:, -2:]

    alone = precision(free)
    np.testing.assert_allclose(precision(np.zeros((40, 3)), free), alone, rtol=1e-9)
    np.testing.assert_allclose(precision(free, free[:, [0]]), alone, rtol=1e-9)
    assert np.all(np.linalg.eigvalsh(alone) < 0.1)


def test_units_do_not_move_the_stiffness_of_inputs(rng):
    M = rng.standard_normal((3, 4, 5))  # two states, two outputs, two inputs and one that is 1
    structure, theta = structure_of(M, np.ones(M.shape, dtype=bool), 2)
    states, inputs, outputs = np.array([1e3, 0.2]), np.array([50.0, 1e-3]), np.array([7.0, 1e4])
    units = np.append(states, outputs)[:, None] / np.concatenate([states, inputs, [3.0]])
    size = np.abs(M[0, :2, 2:4])
    squares = rng.random(len(theta)) + 0.5
    stiffness = Form(structure, OMEGA, N_PHASES, input_size=size).stiffness(squares)
    other = Form(structure, OMEGA, N_PHASES, input_size=size * units[:2, 2:4])
    scaled = other.stiffness(squares / np.tile(units.ravel() ** 2, 3)).reshape(M.shape)
    stiffness = stiffness.reshape(M.shape)
    np.testing.assert_allclose(scaled * units, stiffness, rtol=1e-12)
    assert np.all(stiffness[1:, :2, 2:4] > 0.0)
    assert np.count_nonzero(stiffness) == 8  # no constants, and G alone
    fixed = replace(structure, constant=np.ones(M.shape))
    nothing = [Form(fixed, OMEGA, N_PHASES, input_size=size), replace(other, input_size=0.0 * size)]
    assert not np.any([form.stiffness(squares) for form in nothing])  # about 1, or by no input


def test_the_search_ends_where_likelihood_and_stiffness_balance(oscillator, rng):
    """An input that switches at ψ = 0 alone, in much noise: the size of G is told better by far."""
    structure, theta = oscillator
    M = structure.coefficients(theta)
    free = np.zeros(M.shape, dtype=bool)
    free[:, 1, 2] = free[0, 1, :2] = True
    open_, first = structure_of(M, free, 2)
    u = np.repeat(rng.choice([-1.0, 1.0], (24, 1)), N_PHASES, axis=0)
    response = sampled_response(structure, theta, OMEGA, N_PHASES)
    y = simulate(response, as_records([(u, None, 0)], 1)[0], np.zeros(2))[1]
    y = y + 3.0 * y.std() * rng.standard_normal(y.shape)
    form = Form(open_, OMEGA, N_PHASES)
    stiff = replace(form, input_size=0.25 * np.abs(M[0, :2, 2:]))
    free, held = (output_error_of(each, [(u, y, 0)], first, tol=1e-12) for each in (form, stiff))
    assert free.converged
    assert held.converged
    assert held.cost > free.cost  # of the records alone
    sigma = deviations(free)
    assert np.all(np.abs(held.ahead.step(0.0)) < 1e-3 * sigma)
    assert np.any(np.abs(held.system.step(0.0)) > 0.1 * sigma)
    of_records = np.linalg.inv(held.system.R[:-1, :-1].T @ held.system.R[:-1, :-1])
    np.testing.assert_allclose(held.covariance, of_records * held.correction, rtol=1e-6)
    away = np.array([np.abs(each.theta - first) for each in (free, held)])
    gain = [name.endswith("1,2") and name[0] != "0" for name in open_.parameter_names]
    assert np.linalg.norm(away[1, gain]) < np.linalg.norm(away[0, gain])


@pytest.mark.slow
def test_unstable_steps_are_refused_when_asked(rng):
    """Data of a growing motion pull a stable start across the border, unless held."""
    M = np.zeros((1, 2, 2))
    M[0] = [[0.2, 1.0], [1.0, 0.0]]
    free = np.zeros(M.shape, dtype=bool)
    free[0, 0, 0] = True
    structure, theta = structure_of(M, free, 1)
    segments, _ = recorded(structure, theta, rng)
    held = fitted(structure, segments, [-0.1])
    assert held.theta[0] <= 0.0
    assert held.theta[0] == pytest.approx(0.0, abs=1e-4)
    problem = likelihood_problem(Form(structure, OMEGA, N_PHASES), segments)
    options = {"max_iter": 50, "tol": 1e-8, "keep_stable": False, "bounds": None}
    loose = search(problem, start(problem, [-0.1]), **options)
    np.testing.assert_allclose(loose.point.theta, theta, rtol=1e-11)


def test_criteria_count_everything_estimated(oscillator, rng):
    structure, theta = oscillator
    segments, _ = recorded(structure, theta, rng, noise=0.1)
    result = fitted(structure, segments, theta)
    N, d = 247, 6 + 4 + 1
    assert (result.n_residuals, result.n_parameters) == (N, d)
    rss = np.sum(residual_vector(structure, result.theta, segments, result.point.x0) ** 2)
    cost = 0.5 * N * (np.log(2 * np.pi * rss / N) + 1)
    assert result.cost == pytest.approx(cost, rel=1e-12)
    assert result.aic == pytest.approx(2 * cost + 2 * d)
    assert result.bic == pytest.approx(2 * cost + d * np.log(N))
    assert result.sigma[0] == pytest.approx(np.sqrt(rss / (N - 10)))
    assert result.system.promised < 1e-8 * N


def test_noise_levels_may_be_given(oscillator, rng):
    structure, theta = oscillator
    segments, _ = recorded(structure, theta, rng, noise=0.1)
    free = fitted(structure, segments, theta)
    given = fitted(structure, segments, theta * 1.1, sigma=[0.2])
    np.testing.assert_allclose(given.theta, free.theta, rtol=1e-3)
    ratio = deviations(given) / deviations(free)
    np.testing.assert_allclose(ratio, 0.2 / free.sigma[0], rtol=1e-4)
    assert given.n_parameters == 10


# ---- uncertainty --------------------------------------------------------------------------


@pytest.mark.parametrize("stiffness", [-9.0, -4.0])
def test_exponents_have_the_slopes_of_central_differences(oscillator, stiffness):
    """With two negative real multipliers (parametric resonance), and a complex pair."""
    structure, theta = oscillator
    theta[0] = stiffness
    form = Form(structure, OMEGA, N_PHASES)
    exponents, slopes = exponent_slopes(form, theta)
    assert (exponents[0] == np.conj(exponents[1])) == (stiffness == -4.0)
    moved = [
        exponent_slopes(form, theta + d)[0] - exponent_slopes(form, theta - d)[0]
        for d in 1e-6 * np.eye(6)
    ]
    np.testing.assert_allclose(slopes, np.transpose(moved) / 2e-6, rtol=1e-6, atol=1e-7)


def test_std_of_what_depends_on_unidentified_parameters_is_infinite():
    covariance = np.array([[4.0, np.nan], [np.nan, np.inf]])
    assert propagate_std([[3.0, 0.0], [1.0, 1.0]], covariance).tolist() == [6.0, np.inf]
    std = propagate_std([[3.0 + 1.0j, 0.0], [1.0, 1.0j]], covariance)
    assert std.tolist() == [complex(6.0, 2.0), complex(2.0, np.inf)]


# ---- bad input ----------------------------------------------------------------------------


def test_a_start_that_overflows_is_refused(oscillator):
    structure, _ = oscillator
    with pytest.raises(ValueError, match=r"the response at theta0 overflows \(spectral radius"):
        fitted(structure, [(np.ones((9000, 1)), np.ones((9000, 1)), 0)],
                     [90.0, 0.0, 0.0, 90.0, 4.0, 0.0])  # fmt: skip


def test_each_step_counts_once_and_goes_down(oscillator, rng):
    structure, theta = oscillator
    segments, _ = recorded(structure, theta, rng, noise=0.05)
    results = [fitted(structure, segments, 1.2 * theta, max_iter=k) for k in (1, 2, 3)]
    assert [result.n_iter for result in results] == [1, 2, 3]
    costs = [result.cost for result in results]
    assert costs[0] > costs[1] > costs[2]
