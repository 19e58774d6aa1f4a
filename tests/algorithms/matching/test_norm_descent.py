"""Ways into the valleys of the H∞ norm, and which of them go on to the ground."""

import numpy as np
import pytest

from sklearn_hd.algorithms.matching import least_squares, norm_descent
from sklearn_hd.algorithms.matching.least_squares import GridFit, Start, fit_from
from sklearn_hd.algorithms.matching.matching import starting_points
from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem
from sklearn_hd.algorithms.matching.norm_descent import _runs, _to_the_ground, least_norm
from sklearn_hd.algorithms.matching.peak_newton import newton_descent
from sklearn_hd.algorithms.matching.smooth_peak import SmoothDescent
from sklearn_hd.structures import MatrixStructure
from tests.matching_cases import START, problem_of

LAG = MatrixStructure([["a"]], [["b"]], [[1.0]]).affine


def fit_at(theta):
    return GridFit(np.asarray(theta, dtype=float), 1.0, 0.0, (1.0,))


def descent_at(problem, theta):
    return SmoothDescent(theta, (problem.peak(theta)[0],), 1.001)


def test_runs_stop_at_one_a_valley_that_has_converged():
    problem = problem_of()
    _, run = least_norm(problem, [fit_at(START)], 100, 1e-8)
    assert run.converged
    points = {4: run.theta, 1: run.theta * (1 + 1e-7)}
    starts = {k: descent_at(problem, theta) for k, theta in points.items()}
    runs = _runs(problem, starts, 20, 1e-8, None)
    assert list(runs) == [4]
    assert runs[4].converged
    assert runs[4].value == pytest.approx(run.value, rel=1e-7)
    starts = {4: descent_at(problem, START), 1: descent_at(problem, START)}
    runs = _runs(problem, starts, 0, 1e-8, None)
    assert list(runs) == [4, 1]  # where none has converged there is more to find
    assert not runs[4].converged


def test_a_ground_above_another_is_left(monkeypatch):
    problem = problem_of()
    run = _to_the_ground(problem, START, 3.0, 20, 1e-8, None)
    assert run.converged
    monkeypatch.setattr(norm_descent, "_NEWTON", 0)
    other = _to_the_ground(problem, START, 3.0, 20, 1e-8, None)
    assert other.converged
    assert other.value == pytest.approx(run.value, rel=1e-7)
    left = _to_the_ground(problem, START, 3.0, 20, 1e-8, None, lowest=0.5 * run.value)
    assert not left.converged
    assert left.n_iter == 0
    assert left.value == pytest.approx(run.value, rel=1e-3)


def test_what_is_told_goes_on_from_one_kind_of_step_to_the_next(monkeypatch):
    """A bar must neither go back nor end before the search."""
    monkeypatch.setattr(norm_descent, "_TURNS", 1)
    told, run = [], least_norm(problem_of(), [fit_at(START)], 1, 0.0, report=None)[1]
    assert not run.converged
    least_norm(problem_of(), [fit_at(START)], 1, 0.0, report=lambda *words: told.append(words))
    steps = [words for words in told if words[0].startswith("minimax, steps from descent 1 of")]
    _, most, done, _ = zip(*steps, strict=True)
    assert len(set(most)) == 1
    assert most[0] >= len(done) - 1 > 3
    assert list(done) == list(range(len(done)))


def test_convex_steps_go_on_where_the_ground_is_flat():
    """Within this bound Newton's steps shrink but slowly: the curvature along them fades."""
    free = newton_descent(problem_of(), START).theta
    bounds = np.full(6, -np.inf), np.full(6, np.inf)
    bounds[1][0] = free[0] - 1.0
    problem = problem_of(bounds=bounds)
    single = newton_descent(problem, problem.inside(free))
    run = _to_the_ground(problem, problem.inside(free), 1.001, 20, 1e-8, None)
    assert not single.converged
    assert run.converged
    assert run.value < single.value


def test_the_history_is_that_of_the_whole_way_down():
    problem = problem_of()
    start, run = least_norm(problem, [fit_at(START)], 100, 1e-8)
    assert start.theta is not None
    assert run.history[0] == problem.peak(START)[0]
    assert run.history[-1] == run.value == problem.peak(run.theta)[0]
    assert np.all(np.diff(run.history) < 0)


def test_faster_poles_than_the_limit_count_as_unstable():
    problem = MatchingProblem.build([[-1.0]], [[1.0]], [[1.0]], [[0.0]], LAG)
    limited = problem.limited(np.array([-2.0, 1.0]), 200.0)
    assert limited.speed_limit == pytest.approx(200.0)  # of the model's own pole
    assert limited.abscissa(np.array([-199.0, 1.0])) == problem.abscissa(np.array([-199.0, 1.0]))
    assert limited.abscissa(np.array([-201.0, 1.0])) == np.inf
    assert limited.peak(np.array([-201.0, 1.0]))[0] == np.inf
    again = limited.limited(np.array([-199.0, 1.0]), 200.0)
    assert again.speed_limit == pytest.approx(1990.0)  # a fast pole to begin with raises it


def test_poles_of_least_squares_stay_below_one_limit_from_line_to_line():
    cells = np.diag(["a", "c", "e"]).astype(object)
    cells[cells == ""] = 0.0
    structure = MatrixStructure(cells, [["b"], ["d"], ["f"]], np.ones((1, 3))).affine
    random = np.random.default_rng(923)
    A = random.standard_normal((3, 3))
    A -= (np.linalg.eigvals(A).real.max() + random.uniform(0.1, 0.5)) * np.eye(3)
    B, C, D = (random.standard_normal(shape) for shape in ((3, 1), (1, 3), (1, 1)))
    problem = MatchingProblem.build(A, B, C, D, structure)
    start = np.append(-random.uniform(0.3, 3.0, 3), random.standard_normal(3))
    fit = fit_from(problem, Start(start, near=False), 100)
    fastest = [np.abs(structure.poles(theta)).max() for theta in (start, fit.theta)]
    assert 1e4 * fastest[0] < fastest[1] <= 1e6 * max(fastest[0], problem.fastest)


def test_an_unstable_start_is_tried_once():
    """On the axis there is nothing to start from: the same again would count as found twice."""
    problem = problem_of()
    unstable = START * [-1, 1, 1, 1, 1, 1]
    kinds = {
        name: [start.near for start in starting_points(problem, theta, False, 2, 0)][:2]
        for name, theta in {"stable": START, "unstable": unstable}.items()
    }
    assert kinds["stable"] == [False, True]
    starts = list(starting_points(problem, unstable, False, 2, 0))
    assert sum(np.array_equal(start.theta, unstable) for start in starts) == 1


def test_lines_that_a_pole_holds_up_are_given_up(monkeypatch):
    problem, lines = problem_of(), []

    def stays(problem, theta, *, shift=0.0, max_iter=100):
        lines.append(shift)
        return fit_at(theta)

    monkeypatch.setattr(least_squares, "levenberg_marquardt", stays)
    assert fit_from(problem, Start(START * [-1, 1, 1, 1, 1, 1], near=False), 100) is None
    assert len(lines) < 20  # of 40
    assert np.all(np.diff(lines) < 0)
