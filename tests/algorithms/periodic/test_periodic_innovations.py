"""Discrete periodic innovations models: simulation, prediction, multipliers, loads, filter."""

from dataclasses import replace

import numpy as np
import pytest
from innovation_cases import N_INPUTS as M
from innovation_cases import N_OUTPUTS as L
from innovation_cases import N_STATES as N
from innovation_cases import STEP, drawn, record
from scipy import linalg

from sklearn_hd.algorithms.periodic import floquet
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import (
    PeriodicInnovations,
    propagate_varying,
)
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics


def test_states_of_pieces_are_those_of_one_step_after_another():
    rng = np.random.default_rng(0)
    for n_samples in (1, 2, 7, 50, 101):
        A, v = rng.standard_normal((n_samples, 2, 2)) / 2, rng.standard_normal((n_samples, 2, 3))
        x = start = rng.standard_normal((2, 3))
        found = propagate_varying(A, v, start)
        for k in range(n_samples):
            np.testing.assert_allclose(found[k], x, rtol=1e-10, atol=1e-10)
            x = A[k] @ x + v[k]


def test_simulation_is_that_of_one_row_after_another():
    model = drawn()
    u, y, psi, states = record(model, noise=0.0)
    rows = model.rows(psi)
    np.testing.assert_allclose(rows.simulated(u, states[0]), y, atol=1e-11)
    free = np.einsum("ntl,n->tl", rows.free(), states[0])
    np.testing.assert_allclose(rows.simulated(u, np.zeros(N)) + free, y, atol=1e-11)
    np.testing.assert_allclose(rows.left(u, y), 0.0, atol=1e-9)


def test_slopes_of_multipliers_are_those_of_differences():
    """Of steps made longer, too, to first order in what they are longer by."""
    model = drawn()
    for n_rows, rtol in ((8.0, 1e-6), (8.02, 0.02)):
        case = replace(model, step=2 * np.pi / n_rows)
        logarithms, psi, slopes = case.multiplier_slopes()
        functions = np.array([np.ones(len(psi)), np.cos(psi), np.sin(psi)])
        for h, i, j in [(0, 0, 0), (1, 0, 2), (2, 2, 1)]:
            ends = []
            for sign in (1.0, -1.0):
                moved = case.coefficients.copy()
                moved[h, i, j] += sign * 1e-6
                own = replace(case, coefficients=moved).multiplier_logarithms()
                nearest = np.abs(logarithms[:, None] - own).argmin(axis=1)
                ends.append(own[nearest])
            found = slopes[:, :, i, j] @ functions[h]
            expected = (ends[0] - ends[1]) / 2e-6
            np.testing.assert_allclose(found, expected, rtol=rtol, atol=rtol)


def test_what_overflows_is_told_apart():
    model = drawn(size=9.0)
    psi = STEP * np.arange(800)
    assert model.rows(psi).left(np.ones((800, M)), np.ones((800, L))) is None


@pytest.mark.parametrize("horizon", [1, 2, 5, 100])
def test_predictions_are_those_of_the_definition(horizon):
    model = drawn()
    u, y, psi, states = record(model, noise=0.3)
    found = model.rows(psi).ahead(u, y, states[0], horizon)
    values = evaluate_harmonics(model.coefficients, psi)
    for k in range(0, 80, 7):
        at = max(0, k - horizon + 1)  # the state there is known from the rows before
        x = states[at]
        for j in range(at, k):
            x = values[j, :N] @ np.concatenate([x, u[j], [1.0]])
        expected = values[k, N:] @ np.concatenate([x, u[k], [1.0]])
        np.testing.assert_allclose(found[k], expected, atol=1e-9)


def test_the_first_state_is_found_again():
    model = drawn()
    u, y, psi, states = record(model, noise=0.0)
    x0 = model.rows(psi).initial_state(u, y, model.covariance)
    np.testing.assert_allclose(x0, states[0], atol=1e-8)


def test_a_model_about_means_is_that_of_the_signals_themselves():
    rng, model = np.random.default_rng(3), drawn()
    u_mean, y_mean = rng.standard_normal((7, M)), rng.standard_normal((7, L))
    u, y, psi, states = record(model, noise=0.0)
    whole = model.about(u_mean, y_mean)
    u, y = u + evaluate_harmonics(u_mean, psi), y + evaluate_harmonics(y_mean, psi)
    np.testing.assert_allclose(whole.rows(psi).simulated(u, states[0]), y, atol=1e-10)
    assert whole.n_harmonics == model.n_harmonics == 1


def test_units_change_no_prediction():
    model, u_scale, y_scale = drawn(), np.array([3.0, 1e-3]), np.array([1e4, 0.2])
    u, y, psi, states = record(model, noise=0.3)
    other = model.in_units(u_scale, y_scale)
    predicted = model.rows(psi).ahead(u, y, states[0], 1)
    found = other.rows(psi).ahead(u * u_scale, y * y_scale, states[0], 1)
    np.testing.assert_allclose(found, predicted * y_scale, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(other.covariance, model.covariance * np.outer(y_scale, y_scale))


def test_multipliers_are_eigenvalues_of_the_product_over_a_turn():
    model = replace(drawn(), step=2 * np.pi / 9)
    psi = model.start + model.step * np.arange(9)
    A = evaluate_harmonics(model.coefficients, psi)[:, :N, :N]
    product = np.linalg.multi_dot(A[::-1])
    found = np.sort_complex(model.multipliers())
    np.testing.assert_allclose(found, np.sort_complex(linalg.eigvals(product)), atol=1e-12)
    assert model.growth() == pytest.approx(np.log(np.max(np.abs(found))) / 9)


def sampled_oscillator(samples):
    """A Mathieu oscillator sampled so often a turn, with the harmonics that samples tell."""
    step, highest = 2 * np.pi / samples, int(np.ceil(samples / 2)) - 1

    def F(psi):
        stiffness = -1.5 - 0.4 * np.cos(psi)
        zero, one = np.zeros_like(psi), np.ones_like(psi)
        return np.stack([np.stack([zero, one], -1), np.stack([stiffness, -0.3 * one], -1)], axis=-2)

    n_points = 4 * highest + 4
    A = np.array(
        [
            floquet.transition_matrices(F, None, np.array([p, p + step]), 1.0)[0][0]
            for p in 2 * np.pi * np.arange(n_points) / n_points
        ]
    )
    coefficients = np.zeros((2 * highest + 1, 3, 4))
    coefficients[:, :2, :2] = sampled_harmonics(A, highest)
    coefficients[0, 2, 0] = 1.0
    gain = np.zeros((len(coefficients), 2, 1))
    truth = floquet.floquet_exponents(F, 1.0)
    return PeriodicInnovations(coefficients, gain, np.eye(1), step, 0.1), truth


@pytest.mark.parametrize(
    ("samples", "off"), [(16.0, 1e-8), (16.216, 2e-4), (7.3, 5e-3), (50.01, 1e-7)]
)
def test_multipliers_at_any_clock_are_those_of_the_machine(samples, off):
    model, exponents = sampled_oscillator(samples)
    found = model.multiplier_logarithms() / (2 * np.pi)
    np.testing.assert_allclose(np.sort(found.real), np.sort(exponents.real), atol=off)
    np.testing.assert_allclose(np.sort(found.imag), np.sort(exponents.imag), atol=off)


def test_loads_are_what_remains_without_inputs():
    model = drawn()
    _, y, psi, _ = record(model, n_rows=400, noise=0.0, inputs=0.0)
    loads = model.forced_response(12)
    np.testing.assert_allclose(evaluate_harmonics(loads, psi[200:]), y[200:], atol=1e-8)


def residual_noise(model, rest, outputs):
    """Covariance of e, r and v."""
    return linalg.block_diag(model.covariance, rest * np.eye(N), outputs * np.eye(L))


def test_a_filter_whose_predictor_is_stable_stays():
    model = drawn()
    noise = linalg.block_diag(model.covariance, np.zeros((N, N)), model.covariance)
    noise[:L, -L:] = noise[-L:, :L] = model.covariance  # v is e
    filtered = model.filtered(noise)
    np.testing.assert_allclose(filtered.gain, model.gain, atol=1e-9)
    np.testing.assert_allclose(filtered.covariance, model.covariance, atol=1e-12)


def test_a_filter_is_that_of_the_riccati_equation():
    model = drawn(n_harmonics=0)
    constant = np.zeros_like(model.coefficients)
    constant[0] = model.coefficients[0]
    gain = np.zeros_like(model.gain)
    gain[0] = model.gain[0]
    model = replace(model, coefficients=constant, gain=gain)
    filtered = model.filtered(residual_noise(model, 0.3, 0.2))
    A, _, C, _ = (each[0] for each in model.matrices())
    Q = model.gain[0] @ model.covariance @ model.gain[0].T + 0.3 * np.eye(N)
    P = linalg.solve_discrete_are(A.T, C.T, Q, 0.2 * np.eye(L))
    E = C @ P @ C.T + 0.2 * np.eye(L)
    np.testing.assert_allclose(filtered.covariance, E, rtol=1e-9)
    np.testing.assert_allclose(filtered.gain[0], A @ P @ C.T @ linalg.inv(E), atol=1e-9)


@pytest.mark.slow
def test_a_filter_makes_any_predictor_stable():
    model = drawn()
    model = replace(model, gain=40.0 * model.gain)  # A − K C grows
    n_turn = 8
    psi = model.start + model.step * np.arange(20 * n_turn)

    def growth(one):
        rows = one.rows(psi)
        closed = rows.states[..., :N] - rows.gain @ rows.outputs[..., :N]
        return np.max(np.abs(linalg.eigvals(np.linalg.multi_dot(closed[::-1]))))

    assert growth(model) > 1.0
    noise = linalg.block_diag(model.covariance, 1e-3 * np.eye(N), model.covariance)
    assert growth(model.filtered(noise)) < 1.0
