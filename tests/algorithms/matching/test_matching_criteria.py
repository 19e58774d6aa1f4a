"""Structured matching under weights and bounds, in other norms, and what certifies it."""

import numpy as np
import pytest
from scipy import linalg

from sklearn_hd.algorithms.lti.hinf import hinf_norm
from sklearn_hd.algorithms.matching.matching import match_structure
from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem
from sklearn_hd.structures import MatrixStructure

NAN = np.nan
NEAR = 1e-3  # of the least norm, relative: how near the descent has to come
CRITERIA = ["hinf", "least_squares"]
OSCILLATORS = (
    np.array([[-0.3, 2.0, 0.1], [-2.0, -0.2, 0.4], [0.3, 0.2, -1.5]]),
    np.array([[1.0, 0.2], [0.4, -1.0], [0.3, 0.5]]),
    np.array([[1.0, 0.0, 0.4], [0.2, 1.0, -0.3]]),
    np.zeros((2, 2)),
)
SECOND_ORDER = MatrixStructure([["-a", "w"], ["-w", "-b"]], [[1.0, NAN], [NAN, -1.0]], np.eye(2))
START = np.array([0.3, 2.0, 0.2, 0.2, 0.4])  # a, w, b, B[0,1], B[1,0]


def match(criterion="hinf", model=OSCILLATORS, structure=SECOND_ORDER, **options):
    options = {"theta0": START} | options
    return match_structure(*model, structure.affine, criterion=criterion, **options)


# Bounds


@pytest.mark.slow
@pytest.mark.parametrize("criterion", CRITERIA)
def test_bounds_far_away_change_nothing(criterion):
    free = match(criterion)
    held = match(criterion, bounds=(START - 5.0, START + 5.0))
    np.testing.assert_allclose(held.theta, free.theta, atol=2e-4)
    assert held.hinf_error == pytest.approx(free.hinf_error, rel=NEAR)


@pytest.mark.slow
@pytest.mark.parametrize("criterion", CRITERIA)
def test_a_bound_that_is_met_is_as_good_as_the_parameter_fixed_there(criterion):
    free = match(criterion)
    limit = free.theta[1] - 0.2
    start = np.minimum(START, [9, limit, 9, 9, 9])
    upper = np.where(np.arange(5) == 1, limit, np.inf)
    held = match(criterion, bounds=(np.full(5, -np.inf), upper), theta0=start)
    cells = [["-a", limit], [-limit, "-b"]]
    fixed = MatrixStructure(cells, [[1.0, NAN], [NAN, -1.0]], np.eye(2))
    fixed = match(criterion, structure=fixed, theta0=np.delete(start, 1))
    assert held.theta[1] == pytest.approx(limit, abs=1e-12)
    np.testing.assert_allclose(np.delete(held.theta, 1), fixed.theta, atol=3e-4)
    assert held.hinf_error == pytest.approx(fixed.hinf_error, rel=NEAR)


@pytest.mark.slow
def test_exact_match_out_of_bounds_is_not_taken():
    model = SECOND_ORDER.matrices(START)
    inside = match(model=model, bounds=(START - 1, START + 1), theta0=START + 0.1)
    assert inside.exact
    np.testing.assert_allclose(inside.theta, START, rtol=1e-9)
    outside = match(model=model, bounds=(START + 0.1, START + 1), theta0=START + 0.5)
    assert not outside.exact
    assert np.all(outside.theta >= START + 0.1)


@pytest.mark.slow
def test_each_criterion_is_best_in_its_own_norm():
    results = {criterion: match(criterion) for criterion in CRITERIA}
    assert all(result.converged for result in results.values())
    assert min(results, key=lambda name: results[name].hinf_error) == "hinf"
    np.testing.assert_array_equal(
        results["least_squares"].theta, results["least_squares"].theta_least_squares
    )


# What it leaves behind


@pytest.mark.slow
def test_certificate_is_a_convex_combination_of_gradients_that_vanishes():
    result = match()
    certificate = result.certificate
    problem = MatchingProblem.build(*OSCILLATORS, SECOND_ORDER.affine)
    assert certificate.weights.sum() == pytest.approx(1.0)
    assert np.all(certificate.weights > 0)
    np.testing.assert_allclose(certificate.errors, result.relative_error, rtol=1e-3)
    steps = 1e-6 * np.eye(5)
    gradients = np.array(
        [
            [
                (problem.gains(result.theta + h, [w]) - problem.gains(result.theta - h, [w]))[0]
                for h in steps
            ]
            for w in certificate.frequencies
        ]
    ) / (2e-6)
    combination = certificate.weights @ gradients
    assert linalg.norm(combination) < 1e-3 * linalg.norm(gradients, axis=1).max()


@pytest.mark.slow
def test_a_search_that_is_cut_short_is_not_called_converged():
    starts = [START * np.random.default_rng(seed).uniform(0.7, 1.3, 5) for seed in range(10)]
    short = [match(theta0=start, max_iter=1, n_starts=0) for start in starts]
    whole = match(theta0=START)
    assert whole.converged
    assert whole.certificate.predicted_decrease <= 1e-3
    for result in short:
        assert result.certificate.predicted_decrease >= 0.0
        assert not result.converged or result.hinf_error <= whole.hinf_error * (1 + NEAR)
        assert result.hinf_error >= whole.hinf_error * (1 - NEAR)


def test_static_gain_without_a_start():
    """|1/(1 + jω) − d| is least for d = 1/2."""
    structure = MatrixStructure(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [["d"]])
    result = match("hinf", ([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), structure, theta0=None)
    assert result.theta[0] == pytest.approx(0.5, abs=NEAR)


def test_every_parameter_that_is_not_determined_is_named():
    """A change of state that C does not see moves all of A and B, large entries or small."""
    A, B, _, D = OSCILLATORS
    A = A * np.array([[1.0, 1e-3, 1.0], [1e3, 1.0, 1e3], [1.0, 1e-3, 1.0]])
    structure = MatrixStructure(np.full((3, 3), NAN), np.full((3, 2), NAN), np.eye(2, 3))
    model = A, B, np.eye(2, 3), D
    start = np.concatenate([A.ravel(), B.ravel()])
    result = match("least_squares", model, structure, theta0=start)
    # the third state is free up to x3 → a x1 + b x2 + c x3: rows one and two of B are seen
    assert set(structure.parameter_names) - set(result.unidentified) == {
        "B[0,0]", "B[0,1]", "B[1,0]", "B[1,1]"
    }  # fmt: skip


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.slow
def test_stage_and_measure_of_every_step(criterion):
    result = match(criterion)
    stages = {stage for stage, _ in result.history}
    last = {"hinf": "minimax", "least_squares": "least squares"}[criterion]
    assert stages == {"least squares", last}
    assert result.history[-1][0] == last
    assert result.relative_error == pytest.approx(
        result.hinf_error / hinf_norm(*OSCILLATORS)[0], rel=1e-9
    )
