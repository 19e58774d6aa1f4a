"""Newton's steps on single peaks: their curvature, where they lead, what certifies them."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import linalg
from sklearn_hd.algorithms.matching_problem import MatchingProblem
from sklearn_hd.algorithms.minimax import certify, minimise_peak
from sklearn_hd.algorithms.peak_newton import _convex, _Peaks, newton_descent
from sklearn_hd.algorithms.smooth_peak import smooth_descent

from sklearn_hd.structures import MatrixStructure
from tests.matching_cases import START, problem_of, start_of


def near_the_ground(problem, gap=1e-3):
    return smooth_descent(problem, start_of(problem), gap=gap).theta


def peaks_of(problem, theta):
    value, top = problem.peak(theta)
    return _Peaks(problem, theta, value, [top], [])


@pytest.mark.parametrize("shape", [(2, 2), (1, 3), (3, 1), (3, 2), (2, 3)])
def test_curvature_agrees_with_differences_of_the_peaks(monkeypatch, shape):
    """Each peak by itself: all weight on it."""
    problem = problem_of(*shape)
    theta = start_of(problem)
    monkeypatch.setattr("sklearn_hd.algorithms.peak_newton._convex", lambda bent, rows: bent)
    peaks = peaks_of(problem, theta)
    tops = [k for k in range(len(peaks.frequencies)) if peaks.frequencies[k] < np.inf]
    direction = np.random.default_rng(0).standard_normal(peaks.n_directions)
    direction /= linalg.norm(direction)
    n_checked = 0
    for k in tops:
        frequency = peaks.frequencies[[k]]
        here, _ = problem.tops_near(theta, frequency)
        if abs(here[0] - frequency[0]) > 1e-5 * frequency[0]:
            continue  # a point of the grid beside a top
        weights = np.zeros(len(peaks.frequencies))
        weights[k] = 1.0
        peaks.__dict__.pop("curvature", None)
        peaks.__dict__["_flat"] = SimpleNamespace(weights=weights, walls=np.empty(0))
        moves = peaks.directions @ direction

        def moved(h, frequency=frequency, moves=moves):
            return problem.tops_near(theta + h * moves, frequency)[1][0] / peaks.value

        h = 1e-4
        slopes = [(moved(step) - moved(-step)) / (2 * step) for step in (h, 0.5 * h)]
        slope = (4.0 * slopes[1] - slopes[0]) / 3.0
        bend = (moved(h) + moved(-h) - 2 * moved(0.0)) / h**2
        assert peaks.gradients[k] @ direction == pytest.approx(slope, rel=1e-5, abs=1e-8)
        assert direction @ peaks.curvature @ direction == pytest.approx(bend, rel=1e-3, abs=1e-4)
        n_checked += 1
    assert n_checked >= 1


@pytest.mark.parametrize("shape", [(2, 2), (1, 3), (3, 2)])
def test_steps_end_where_convex_programs_do_in_few(shape):
    problem = problem_of(*shape)
    theta = near_the_ground(problem)
    run = newton_descent(problem, theta)
    assert run.converged
    assert run.n_iter <= 12
    assert run.certificate.predicted_decrease <= 1e-8
    assert run.certificate.distance <= 1e-8
    assert run.history[0] == problem.peak(theta)[0]
    assert run.value == run.history[-1] == problem.peak(run.theta)[0]
    assert np.all(np.diff(run.history) < 0)
    other = minimise_peak(problem, theta)
    assert other.converged
    assert run.value == pytest.approx(other.value, rel=1e-8)


def test_the_last_steps_are_quadratic():
    """Of what is left, each step leaves about the square."""
    problem = problem_of()
    best = newton_descent(problem, near_the_ground(problem, 1e-6))
    theta, left = near_the_ground(problem), []
    for _ in range(5):
        left.append(linalg.norm(theta - best.theta) / linalg.norm(best.theta))
        theta = newton_descent(problem, theta, max_iter=1).theta
    assert left[0] > 3e-3
    assert left[3] < 500.0 * left[2] ** 2
    assert left[3] / left[2] < 0.5 * left[2] / left[1]
    assert left[4] < 1e-6  # a value within rounding of the least gives no more of theta


def test_a_search_cut_short_has_no_certificate():
    problem = problem_of()
    run = newton_descent(problem, START, max_iter=1)
    assert not run.converged
    assert run.certificate is None
    assert run.n_iter == 1
    assert run.value <= problem.peak(START)[0]


def test_a_creep_is_given_up():
    """Far from the ground, linearised peaks promise a lot and steps earn little of it."""
    problem = problem_of()
    run = newton_descent(problem, START, max_iter=1000)
    assert run.n_iter < 1000
    assert run.value < problem.peak(START)[0]


def test_a_norm_that_no_frequency_has_is_left_as_it_is(monkeypatch):
    """So AB13DD has it where a match is exact but for rounding."""
    problem = problem_of()
    monkeypatch.setattr(MatchingProblem, "peak", lambda self, theta: (10.0, 1.0))
    run = newton_descent(problem, START)
    np.testing.assert_array_equal(run.theta, START)
    assert run.n_iter == 0
    assert not run.converged


def test_a_peak_at_rest_moves_nowhere_along_the_axis():
    """|1/(s + 1) − b/(s + 2)| is least for b = 4/3, as high at 0 as somewhere above."""
    structure = MatrixStructure([[-2.0]], [["b"]], [[1.0]]).affine
    problem = MatchingProblem.build([[-1.0]], [[1.0]], [[1.0]], [[0.0]], structure)
    start = np.array([0.5])
    assert problem.peak(start)[1] == 0.0
    run = newton_descent(problem, start)
    bs = np.linspace(1.0, 2.0, 2001)
    norms = [problem.peak(np.array([b]))[0] for b in bs]
    assert run.converged
    assert run.value <= min(norms) * (1 + 1e-9)
    assert run.theta[0] == pytest.approx(bs[np.argmin(norms)], abs=1e-3)


@pytest.mark.parametrize("start", [START * [-1, 1, 1, 1, 1, 1], None], ids=["unstable", "exact"])
def test_without_an_error_to_lower_the_start_is_the_end(start):
    problem = problem_of()
    if start is None:
        structure = MatrixStructure([["a"]], [[1.0]], [[1.0]]).affine
        problem = MatchingProblem.build([[-2.0]], [[1.0]], [[1.0]], [[0.0]], structure)
        start = np.array([-2.0])
    run = newton_descent(problem, start)
    np.testing.assert_array_equal(run.theta, start)
    assert run.n_iter == 0
    assert not run.converged


@pytest.mark.parametrize(("k", "side"), [(0, "lower"), (1, "upper"), (2, "lower"), (4, "upper")])
def test_bounds_that_are_touched_take_their_share(k, side):
    free = newton_descent(problem_of(), near_the_ground(problem_of()))
    sign = 1.0 if side == "lower" else -1.0
    bounds = {"lower": np.full(6, -np.inf), "upper": np.full(6, np.inf)}
    bounds[side][k] = free.theta[k] + sign
    problem = problem_of(bounds=(bounds["lower"], bounds["upper"]))
    theta = problem.inside(free.theta)
    run, other = newton_descent(problem, theta), minimise_peak(problem, theta)
    assert run.converged
    assert run.value > free.value
    assert run.theta[k] == pytest.approx(bounds[side][k], rel=1e-9)
    np.testing.assert_array_equal(problem.inside(run.theta), run.theta)
    assert run.value == pytest.approx(other.value, rel=1e-8)
    for each in (run, other):
        assert each.history[-1] == each.value == problem.peak(each.theta)[0]
    assert run.certificate.distance < 1e-6
    frequencies, errors = run.certificate.frequencies, run.certificate.errors
    moved = [problem.gains(run.theta + h, frequencies) for h in 1e-6 * np.eye(6)]
    gradients = (np.array(moved) - errors).T / 1e-6
    pull = run.certificate.weights @ gradients
    assert sign * pull[k] > 0  # only the bound holds it
    assert np.all(np.abs(np.delete(pull, k)) < 1e-3 * np.abs(gradients).max())


def test_walls_that_are_not_touched_leave_the_curvature_as_it_is():
    """Peaks that are linearised reach them in a region of size one."""
    problem = problem_of(bounds=(START - 0.3 * np.abs(START), START + 0.3 * np.abs(START)))
    peaks, free = peaks_of(problem, START), peaks_of(problem_of(), START)
    assert peaks._flat.walls.max() > 1e-3
    free._walls = peaks._walls[0][:0], peaks._walls[1][:0]
    flat = free.__dict__["_flat"] = SimpleNamespace(**vars(peaks._flat))
    flat.walls = flat.walls[:0]
    np.testing.assert_array_equal(peaks.curvature, free.curvature)


def test_steps_that_are_refused_are_no_convergence(monkeypatch):
    """What a step promises in a region shrunk to nothing says nothing of the norm."""
    problem = problem_of()
    theta = near_the_ground(problem, 1e-6)
    left = peaks_of(problem, theta).certificate.predicted_decrease
    assert 1e-8 < left < 1e-4
    value, top = problem.peak(theta)

    def peak(self, at):
        return value * (1.0 + (not np.array_equal(at, theta))), top

    monkeypatch.setattr(MatchingProblem, "peak", peak)
    monkeypatch.setattr("sklearn_hd.algorithms.peak_newton._PATIENCE", 60)
    run = newton_descent(problem, theta)
    assert run.predicted_decrease > 1e-8  # in a region of size one
    assert not run.converged
    assert run.certificate is None
    assert run.history == (value,)


def test_certificates_of_both_searches_agree():
    problem = problem_of()
    run = newton_descent(problem, near_the_ground(problem))
    other = certify(problem, run.theta, run.value)
    assert np.sum(other.weights) == pytest.approx(1.0)
    for frequency, weight in zip(run.certificate.frequencies, run.certificate.weights, strict=True):
        near = np.abs(other.frequencies - frequency) < 1e-4 * (1.0 + frequency)  # perhaps some
        assert np.sum(other.weights[near]) == pytest.approx(weight, abs=1e-4)
    assert other.predicted_decrease < 1e-6


def test_curvature_is_made_positive_across_what_peaks_leave_free():
    """Along those directions it stays, if it was positive."""
    random = np.random.default_rng(2)
    gradients = random.standard_normal((3, 6))
    gradients -= np.array([0.2, 0.3, 0.5]) @ gradients
    along = linalg.null_space(gradients - gradients.mean(axis=0))
    positive = random.standard_normal((6, 6))
    across = linalg.orth(gradients.T)
    curvature = positive @ positive.T - 30.0 * across @ across.T
    assert linalg.eigvalsh(curvature)[0] < -1
    made = _convex(curvature, gradients - gradients.mean(axis=0))
    assert linalg.eigvalsh(made)[0] >= -1e-10
    np.testing.assert_allclose(along.T @ made @ along, along.T @ curvature @ along, atol=1e-7)
    with np.errstate(all="raise"):
        np.testing.assert_array_equal(_convex(np.zeros((6, 6)), gradients), 0.0)
    concave = _convex(-np.eye(6), np.zeros((1, 6)))  # one peak leaves all free
    np.testing.assert_allclose(concave, 0.0, atol=1e-12)


def test_high_frequencies_are_those_above_a_level_each_once():
    problem = problem_of()
    value, top = problem.peak(START)
    near = np.array([0.99 * top, 1.005 * top])
    frequencies, heights = problem.high_frequencies(START, 0.5 * value, near, [0.3, 1e-12])
    assert np.all(np.diff(frequencies) > 1e-3 * frequencies[:-1])
    assert heights.max() == pytest.approx(value, rel=1e-9)
    assert frequencies[np.argmax(heights)] == pytest.approx(top, rel=1e-4)
    np.testing.assert_allclose(heights, problem.gains(START, frequencies), rtol=1e-9)
    assert np.all(heights >= 0.5 * value)
    below = problem.grid[problem.gains(START, problem.grid) < 0.5 * value]
    assert not np.isin(below, frequencies).any()
    everything, _ = problem.high_frequencies(START, 0.0, near, [0.3, 1e-12])
    assert everything[0] == 0.0
    assert everything[-1] == np.inf
    assert np.isin([0.3], everything)
