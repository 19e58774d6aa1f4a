"""Smooth bounds of the H∞ norm: their limits, slopes, steps, and where they lead."""

import numpy as np
import pytest

from sklearn_hd.algorithms.matching_problem import MatchingProblem
from sklearn_hd.algorithms.smooth_peak import _Bound, _region_step, smooth_descent
from sklearn_hd.structures import MatrixStructure

NAN = np.nan
A = np.array([[-1.0, 5.0, 0.0], [-5.0, -1.0, 1.0], [0.0, 0.3, -2.0]])
START = np.array([-1.0, 5.0, 0.5, 0.5, 0.5, 0.5])


def problem_of(n_inputs=2, n_outputs=2, bounds=None):
    """Three states to be matched by two."""
    random = np.random.default_rng(3)
    B, C = random.standard_normal((3, n_inputs)), random.standard_normal((n_outputs, 3))
    cells = [["a", "w"], ["-w", "a"]], np.full((2, n_inputs), NAN), np.eye(n_outputs, 2)
    structure = MatrixStructure(*cells).affine
    return MatchingProblem.build(A, B, C, np.zeros((n_outputs, n_inputs)), structure, None, bounds)


def start_of(problem):
    return START[: problem.structure.n_parameters]


def bound_of(problem):
    return _Bound(problem, start_of(problem), problem.peak(start_of(problem))[1])


@pytest.mark.parametrize("shape", [(2, 2), (1, 3), (2, 1)])
@pytest.mark.parametrize("mu", [1.0, 1e-2, 1e-4])
def test_slopes_agree_with_differences(shape, mu):
    problem = problem_of(*shape)
    bound = bound_of(problem)
    gradient, hessian = bound.slopes(mu)
    direction = np.random.default_rng(0).standard_normal(len(gradient))
    direction /= np.linalg.norm(direction)
    step = bound.directions @ direction

    def value(size):
        return bound.value_at(bound.theta + size * step, mu)

    h = 1e-5
    assert gradient @ direction == pytest.approx((value(h) - value(-h)) / (2 * h), rel=1e-6)
    h = 1e-3 * min(1.0, mu / 1e-3)
    bend = (value(h) + value(-h) - 2 * value(0.0)) / h**2
    assert direction @ hessian @ direction == pytest.approx(bend, rel=1e-2)


@pytest.mark.parametrize("shape", [(2, 2), (1, 3)])
def test_one_pass_over_the_grid_gives_what_several_do(shape):
    problem = problem_of(*shape)
    theta = start_of(problem)
    frequencies, error, slope, directions = problem.linearised(theta, [0.7])
    assert len(np.unique(frequencies)) == len(frequencies)
    assert np.isin([*problem.grid, 0.7], frequencies).all()
    wanted = problem.error_and_sensitivity(theta, frequencies)
    np.testing.assert_allclose(error, wanted[0], atol=1e-12)
    np.testing.assert_allclose(slope, wanted[1], atol=1e-12)
    whole = problem.step_directions(theta)
    np.testing.assert_allclose(directions @ directions.T, whole @ whole.T, rtol=1e-8, atol=1e-10)


def test_bound_falls_from_the_mean_square_to_the_norm():
    problem = problem_of()
    bound = bound_of(problem)
    sizes = problem.singular_values(bound.theta, bound.frequencies)
    assert bound.top == pytest.approx(problem.peak(bound.theta)[0], rel=1e-9)
    levels = [bound.level(mu) for mu in (1e4, 1.0, 1e-2, 1e-4, 1e-8)]
    assert np.all(np.diff(levels) < 0)
    assert levels[0] == pytest.approx(np.sqrt(2e4 * np.sum(sizes**2)), rel=1e-3)
    assert levels[-1] == pytest.approx(bound.top, rel=1e-6)
    assert levels[-1] > bound.top
    assert bound.level(bound.weight_for(2.5)) == pytest.approx(2.5 * bound.top, rel=1e-9)


@pytest.mark.parametrize("shift", [5.0, 0.0, -5.0], ids=["convex", "indefinite", "concave"])
def test_region_step_is_the_best_in_the_ball(shift):
    random = np.random.default_rng(4)
    hessian = random.standard_normal((4, 4))
    hessian, gradient = hessian + hessian.T + shift * np.eye(4), random.standard_normal(4)

    def decrease(s):
        return -(gradient @ s + 0.5 * s @ hessian @ s)

    step, promised = _region_step(gradient, hessian, 0.7)
    assert np.linalg.norm(step) <= 0.7 * (1 + 1e-5)
    assert promised == pytest.approx(decrease(step))
    for _ in range(300):
        rival = random.standard_normal(4)
        rival *= 0.7 * random.uniform() ** 0.25 / np.linalg.norm(rival)
        assert decrease(rival) <= promised * (1 + 1e-5)


@pytest.mark.parametrize("first", [1.5, 3.0])
def test_descent_falls_and_ends_near_a_stationary_point(first):
    problem = problem_of()
    theta, history = smooth_descent(problem, START, first=first, gap=1e-4)
    assert np.all(np.diff(history) < 0)
    assert history[0] == problem.peak(START)[0]
    assert history[-1] == problem.peak(theta)[0]
    assert history[-1] < 0.9 * history[0]
    directions = problem.step_directions(theta)
    random = np.random.default_rng(5)
    for _ in range(50):
        step = directions @ random.standard_normal(directions.shape[1]) * 1e-2
        assert problem.peak(theta + step)[0] >= history[-1] * (1 - 1e-3)


def test_descent_stays_within_bounds():
    lower = np.array([-10.0, 4.9, -1.0, -1.0, 0.4, 0.4])
    problem = problem_of(bounds=(lower, -lower + 10.0))
    theta, history = smooth_descent(problem, START)
    np.testing.assert_array_equal(problem.inside(theta), theta)
    assert len(history) > 1


def test_unstable_trials_have_no_bound():
    bound = bound_of(problem_of())
    assert bound.value_at(START * [-1, 1, 1, 1, 1, 1], 1e-2) == np.inf


def test_parameters_without_effect_leave_nothing_to_descend():
    structure = MatrixStructure([[-1.0, 0.0], ["x", -2.0]], [[1.0], [0.0]], [[1.0, 0.0]]).affine
    problem = MatchingProblem.build([[-3.0]], [[1.0]], [[1.0]], [[0.0]], structure)
    theta, history = smooth_descent(problem, np.array([0.5]))
    assert theta.tolist() == [0.5]
    assert len(history) == 1
