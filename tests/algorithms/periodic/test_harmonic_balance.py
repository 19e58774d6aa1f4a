"""Periodic solutions: harmonic balance, shooting, and the integrator below it."""

import re

import numpy as np
import pytest

from sklearn_hd.algorithms.periodic.harmonic_balance import (
    evaluate_harmonics,
    product,
    resize_harmonics,
    sample_harmonics,
    solve_harmonic_balance,
)
from sklearn_hd.algorithms.periodic.integration import integrate, solve_shooting
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, sampled_harmonics
from sklearn_hd.exceptions import TrimError

OMEGA = 2.0


def cubic(x, u, t):
    """ẋ = −x³ + u + what makes x = cos ωt + 0.3 sin 2ωt + 0.5 the solution at u = 0.7."""
    exact = np.cos(OMEGA * t) + 0.3 * np.sin(2 * OMEGA * t) + 0.5
    rate = -OMEGA * np.sin(OMEGA * t) + 0.6 * OMEGA * np.cos(2 * OMEGA * t)
    return -(x**3) + exact**3 + rate + (u - 0.7)


def cubic_jacobian(x, u, t):
    return -3.0 * x.T[:, :, None] ** 2, np.ones((len(t), 1, 1))


EXACT = np.array([0.5, 1.0, 0.0, 0.0, 0.3])


def explode(x, u, t):
    return 1.0 + x**2 + 0.0 * t


def explode_jacobian(x, u, t):
    return 2.0 * x.T[:, :, None], np.zeros((len(t), 1, 0))


def test_manufactured_solution_is_found():
    X, u, residual = solve_harmonic_balance(
        cubic, cubic_jacobian, OMEGA, np.zeros((9, 1)), np.array([0.7])
    )
    np.testing.assert_allclose(X[:, 0], np.r_[EXACT, np.zeros(4)], atol=1e-12)
    assert u[0] == 0.7
    assert residual <= 1e-12


def test_target_determines_the_free_input():
    X, u, _ = solve_harmonic_balance(
        cubic,
        cubic_jacobian,
        OMEGA,
        np.zeros((9, 1)),
        np.array([0.0]),
        free=[0],
        targets=[(0, 0.5)],
    )
    np.testing.assert_allclose(X[:5, 0], EXACT, atol=1e-11)
    np.testing.assert_allclose(u, [0.7], atol=1e-11)


def test_shooting_finds_the_same_orbit_and_input():
    x0, u, defect = solve_shooting(
        cubic,
        2 * np.pi / OMEGA,
        np.array([1.2]),
        np.array([0.5]),
        free=[0],
        targets=[(0, 0.5)],
    )
    np.testing.assert_allclose(x0, [1.5], rtol=1e-11)
    np.testing.assert_allclose(u, [0.7], rtol=1e-11)
    assert defect < 1e-12


def test_no_periodic_solution_is_said_with_the_residual():
    with pytest.raises(TrimError, match=r"relative residual of \d.*give a guess closer"):
        solve_harmonic_balance(explode, explode_jacobian, OMEGA, np.zeros((5, 1)), np.zeros(0))


def test_too_few_iterations_are_said():
    with pytest.raises(TrimError, match="after 1 iterations"):
        solve_harmonic_balance(
            cubic, cubic_jacobian, OMEGA, np.zeros((9, 1)), np.array([0.7]), max_iterations=1
        )


def test_the_residual_named_is_the_last_one():
    """More iterations leave less, and a tolerance just above it is met by as many."""
    problem = cubic, cubic_jacobian, OMEGA, np.zeros((9, 1)), np.array([0.7])
    named = []
    for k in (1, 2, 3):
        with pytest.raises(TrimError) as error:
            solve_harmonic_balance(*problem, max_iterations=k)
        named.append(float(re.search(r"relative residual of (\S+)", str(error.value))[1]))
        reached = solve_harmonic_balance(*problem, max_iterations=k, tolerance=1.01 * named[-1])[2]
        assert reached == pytest.approx(named[-1], rel=0.01)
    assert named[0] > named[1] > named[2]


def test_shooting_says_that_an_orbit_diverges():
    with pytest.raises(TrimError, match="shorter than one period"):
        solve_shooting(explode, 2 * np.pi / OMEGA, np.zeros(1), np.zeros(0))


def test_shooting_says_that_no_orbit_returns():
    with pytest.raises(TrimError, match="relative defect of"):
        solve_shooting(lambda x, u, t: np.ones(1) + 0.01 * np.cos(x), 1.0, np.zeros(1), np.zeros(0))


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match=r"n_points=16 .* give more than 16"):
        solve_harmonic_balance(
            cubic, cubic_jacobian, OMEGA, np.zeros((9, 1)), np.array([0.7]), n_points=16
        )


def test_right_hand_side_that_takes_one_point_is_refused():
    with pytest.raises(ValueError, match="must take many points at once"):
        solve_harmonic_balance(
            lambda x, u, t: np.zeros(1), cubic_jacobian, OMEGA, np.zeros((3, 1)), np.array([0.7])
        )


def test_sample_then_decompose_is_the_identity():
    X = np.random.default_rng(0).standard_normal((31, 2))
    np.testing.assert_allclose(sampled_harmonics(sample_harmonics(X, 64).T, 15), X, atol=1e-14)


@pytest.mark.parametrize("n_harmonics", [0, 1, 2, 7, 40])
def test_series_at_any_point_equals_its_samples(n_harmonics):
    rng = np.random.default_rng(n_harmonics)
    X = rng.standard_normal((2 * n_harmonics + 1, 3))
    psi = 2 * np.pi * np.arange(128) / 128
    sampled = harmonic_functions(psi, range(n_harmonics + 1)) @ X
    np.testing.assert_allclose(evaluate_harmonics(X, psi), sampled, atol=1e-12)
    assert evaluate_harmonics(X, 0.3).shape == (3,)
    many = np.linspace(-7.0, 9.0, 10_001)  # more than are evaluated at a time
    some = [0, 4095, 4096, 9999, 10_000]
    found, wanted = evaluate_harmonics(X, many)[some], evaluate_harmonics(X, many[some])
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_coefficients_of_a_product_are_those_of_its_values():
    rng = np.random.default_rng(3)
    first, second = rng.standard_normal((3, 5, 4)), rng.standard_normal((5, 4, 2))
    psi = 2 * np.pi * np.arange(64) / 64
    expected = evaluate_harmonics(first, psi) @ evaluate_harmonics(second, psi)
    found = evaluate_harmonics(product(first, second), psi)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_resize_pads_and_cuts():
    X = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(resize_harmonics(resize_harmonics(X, 6), 2), X)
    np.testing.assert_array_equal(resize_harmonics(X, 1), X[:3])


def test_integration_holds_inputs_exactly():
    rng = np.random.default_rng(0)
    t, u = np.cumsum(rng.uniform(0.1, 2.0, 30)), rng.standard_normal((30, 1))
    x = integrate(lambda x, u, t: u - x, [1.0], u, t)
    decay = np.exp(-np.diff(t))
    for k in range(29):
        assert x[k + 1, 0] == pytest.approx(u[k, 0] + (x[k, 0] - u[k, 0]) * decay[k], rel=1e-11)


def test_integration_says_where_it_stopped():
    with pytest.raises(RuntimeError, match=r"stopped between t = 1 s and 2 s"):
        integrate(lambda x, u, t: x**2, [1.0], np.zeros((2, 0)), [0.0, 2.0])
