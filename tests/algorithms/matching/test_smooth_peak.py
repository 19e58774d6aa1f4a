"""Smooth descents: their steps, the frequencies they look at, and where they lead."""

import numpy as np
import pytest

from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem
from sklearn_hd.algorithms.matching.smooth_peak import (
    _corrected,
    _followed,
    _Point,
    _region_step,
    _round,
    _Walls,
    smooth_descent,
)
from sklearn_hd.structures import MatrixStructure
from tests.matching_cases import START, problem_of, start_of


def point_of(problem):
    theta = start_of(problem)
    frequencies = problem.sampling(theta, [problem.peak(theta)[1]])
    return _Point(problem, _Walls(problem, theta), theta, frequencies)


@pytest.mark.parametrize("shape", [(2, 2), (1, 3), (2, 1)])
@pytest.mark.parametrize("mu", [1.0, 1e-2, 1e-4])
def test_slopes_agree_with_differences_along_curved_steps(shape, mu):
    point = point_of(problem_of(*shape))
    slopes = point.slopes(mu)
    hessian = slopes.hessian
    direction = np.random.default_rng(0).standard_normal(len(hessian))
    direction /= np.linalg.norm(direction)

    def value(size):
        return point.value_at(point.moved(size * direction), mu)[0]

    h = 1e-5
    slope = (value(h) - value(-h)) / (2 * h)
    assert slopes.gradient @ direction == pytest.approx(slope, rel=1e-6)
    h = 1e-3 * min(1.0, mu / 1e-3)
    bend = (value(h) + value(-h) - 2 * value(0.0)) / h**2
    assert direction @ hessian @ direction == pytest.approx(bend, rel=1e-2)


@pytest.mark.parametrize("shape", [(2, 2), (1, 3)])
def test_one_pass_over_the_frequencies_gives_what_several_do(shape):
    problem = problem_of(*shape)
    theta = start_of(problem)
    frequencies = problem.sampling(theta, [0.7])
    assert len(np.unique(frequencies)) == len(frequencies)
    np.testing.assert_array_equal(frequencies[: len(problem.grid)], problem.grid)
    assert 0.7 in frequencies
    error, slope, directions = problem.linearised(theta, frequencies)
    wanted = problem.error_and_sensitivity(theta, frequencies)
    np.testing.assert_allclose(error, wanted[0], atol=1e-12)
    np.testing.assert_allclose(error, problem.error(theta, frequencies), atol=1e-12)
    np.testing.assert_allclose(slope, wanted[1], atol=1e-12)
    whole = problem.linearised(theta, problem.grid)[2]
    np.testing.assert_allclose(directions @ directions.T, whole @ whole.T, rtol=1e-8, atol=1e-10)


def test_the_frequencies_stay_but_for_peaks_between_them():
    problem = problem_of()
    theta, sparse = start_of(problem), problem.grid[::8]
    top = problem.peak(theta)[0]
    full = point_of(problem)
    assert full.completed(1e-2) is full
    point = _Point(problem, full.walls, theta, problem.sampling(theta)[: len(problem.grid)])
    missed = top - point.bound.top
    assert missed > 0
    assert len(sparse) < len(point.frequencies)
    left = missed / 10  # t above the parabola's top, far less than what the points miss
    mu = point.bound.weight_for((top + left) / point.bound.top)
    more = point.completed(mu)
    n = len(point.frequencies)
    np.testing.assert_array_equal(more.frequencies[:n], point.frequencies)
    assert len(more.frequencies) > n
    assert top - more.bound.top < 0.1 * missed


def test_the_correction_lowers_f_where_steps_are_long():
    point, mu = _round(point_of(problem_of()), 1e-2, 1.0, 200)[0], 1e-3
    slopes = point.slopes(mu)
    hessian = slopes.hessian
    step, promised, solve = _region_step(slopes.gradient, hessian, 0.4)
    plain = point.value_at(point.moved(step), mu)[0]
    assert plain > point.value(mu) - 0.9 * promised
    theta, value = _corrected(point, slopes, mu, step, solve, -np.inf)
    assert value == point.value_at(theta, mu)[0]
    assert value < plain - 0.02 * promised
    assert _corrected(point, slopes, mu, step, solve, plain)[1] == plain  # low enough


def test_the_path_of_minima_is_followed_to_the_next_one():
    problem, mu = problem_of(), 1e-3
    point = _round(point_of(problem), mu, 1.0, 200)[0]
    there = _round(point, 0.5 * mu, 1.0, 200)[0]
    followed, length = _followed(point, mu, 0.5 * mu)
    values = [each.bound.value(0.5 * mu) for each in (point, followed, there)]
    assert length > 0
    assert values[1] - values[2] < 0.1 * (values[0] - values[2])
    assert _followed(point_of(problem), 1.0, 0.5)[1] >= 0.0  # not at a minimum


@pytest.mark.parametrize("shift", [5.0, 0.0, -5.0], ids=["convex", "indefinite", "concave"])
def test_region_step_is_the_best_in_the_ball(shift):
    random = np.random.default_rng(4)
    hessian = random.standard_normal((4, 4))
    hessian, gradient = hessian + hessian.T + shift * np.eye(4), random.standard_normal(4)

    def decrease(s):
        return -(gradient @ s + 0.5 * s @ hessian @ s)

    step, promised, solve = _region_step(gradient, hessian, 0.7)
    assert np.linalg.norm(step) <= 0.7 * (1 + 1e-5)
    assert promised == pytest.approx(decrease(step))
    np.testing.assert_allclose(solve(gradient), step, rtol=1e-12)
    for _ in range(300):
        rival = random.standard_normal(4)
        rival *= 0.7 * random.uniform() ** 0.25 / np.linalg.norm(rival)
        assert decrease(rival) <= promised * (1 + 1e-5)


@pytest.mark.parametrize("first", [1.5, 3.0])
@pytest.mark.slow
def test_descent_falls_and_ends_near_a_stationary_point(first):
    problem = problem_of()
    descent = smooth_descent(problem, START, first=first, gap=1e-4)
    theta, history = descent.theta, descent.history
    assert 1.0 < descent.ratio <= 1.0 + 1e-4
    assert descent.value == history[-1]
    assert np.all(np.diff(history) < 0)
    assert history[0] == problem.peak(START)[0]
    assert history[-1] == problem.peak(theta)[0]
    assert history[-1] < 0.9 * history[0]
    directions = problem.linearised(theta, problem.grid)[2]
    random = np.random.default_rng(5)
    for _ in range(50):
        step = directions @ random.standard_normal(directions.shape[1]) * 1e-2
        assert problem.peak(theta + step)[0] >= history[-1] * (1 - 1e-3)


def test_descent_stays_within_bounds():
    lower = np.array([-10.0, 4.9, -1.0, -1.0, 0.4, 0.4])
    problem = problem_of(bounds=(lower, -lower + 10.0))
    descent = smooth_descent(problem, START)
    theta, history = descent.theta, descent.history
    np.testing.assert_array_equal(problem.inside(theta), theta)
    assert len(history) > 1


def test_unstable_trials_have_no_bound():
    value, error = point_of(problem_of()).value_at(START * [-1, 1, 1, 1, 1, 1], 1e-2)
    assert value == np.inf
    assert error is None


def test_parameters_without_effect_leave_nothing_to_descend():
    structure = MatrixStructure([[-1.0, 0.0], ["x", -2.0]], [[1.0], [0.0]], [[1.0, 0.0]]).affine
    problem = MatchingProblem.build([[-3.0]], [[1.0]], [[1.0]], [[0.0]], structure)
    descent = smooth_descent(problem, np.array([0.5]))
    assert descent.theta.tolist() == [0.5]
    assert len(descent.history) == 1


@pytest.mark.slow
def test_a_descent_goes_on_where_another_was_cut_short():
    problem = problem_of()
    whole = smooth_descent(problem, START, gap=1e-6)
    short = smooth_descent(problem, START, gap=1e-6, max_iter=8)
    assert short.ratio > 1.0 + 1e-6
    rest = smooth_descent(problem, short.theta, first=short.ratio, gap=1e-6)
    assert rest.history[0] == short.value
    assert rest.value == pytest.approx(whole.value, rel=1e-5)


def test_a_start_beyond_the_speed_limit_is_where_the_descent_ends(monkeypatch):
    problem = problem_of()
    limited, fast = problem.limited(START, 10.0), START * [1e6, 1, 1, 1, 1, 1]
    monkeypatch.setattr(MatchingProblem, "sampling", None)  # has no frequency to begin with
    descent = smooth_descent(limited, fast)
    assert descent.value == np.inf
    np.testing.assert_array_equal(descent.theta, fast)
