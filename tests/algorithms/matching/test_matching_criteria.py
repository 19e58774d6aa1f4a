"""Structured matching under weights and bounds, in other norms, and what certifies it."""

import numpy as np
import pytest
from scipy import linalg, optimize

from sklearn_hd.algorithms.lti.hinf import h2_norm, hinf_norm
from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.algorithms.matching.h2_matching import h2_error, quadrature
from sklearn_hd.algorithms.matching.matching import match_structure
from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem
from sklearn_hd.algorithms.matching.minimax import certify
from sklearn_hd.algorithms.matching.weighting import in_series
from sklearn_hd.structures import MatrixStructure

NAN = np.nan
CRITERIA = ["hinf", "h2", "least_squares"]
OSCILLATORS = (
    np.array([[-0.3, 2.0, 0.1], [-2.0, -0.2, 0.4], [0.3, 0.2, -1.5]]),
    np.array([[1.0, 0.2], [0.4, -1.0], [0.3, 0.5]]),
    np.array([[1.0, 0.0, 0.4], [0.2, 1.0, -0.3]]),
    np.zeros((2, 2)),
)
SECOND_ORDER = MatrixStructure([["-a", "w"], ["-w", "-b"]], [[1.0, NAN], [NAN, -1.0]], np.eye(2))
START = np.array([0.3, 2.0, 0.2, 0.2, 0.4])  # a, w, b, B[0,1], B[1,0]


def lag(corner, channels=2):
    """1 / (s / corner + 1) on each channel."""
    eye = np.eye(channels)
    return -corner * eye, corner * eye, eye, 0.0 * eye


def match(criterion="hinf", model=OSCILLATORS, structure=SECOND_ORDER, **options):
    options = {"theta0": START} | options
    return match_structure(*model, structure.affine, criterion=criterion, **options)


def weighted_gap(result, model=OSCILLATORS, outputs=None, inputs=None, n=20_000):
    """Largest singular value of W_o (G_c − G_s) W_i over a dense grid."""
    s = 1j * np.concatenate([[0.0], np.geomspace(1e-3, 1e3, n)])
    gap = frequency_response(*model, s)
    gap = gap - frequency_response(result.A, result.B, result.C, result.D, s)
    if outputs is not None:
        gap = frequency_response(*outputs, s) @ gap
    if inputs is not None:
        gap = gap @ frequency_response(*inputs, s)
    return np.linalg.norm(gap, 2, axis=(1, 2)).max()


# Weights


def test_series_connection_multiplies_responses():
    s = 1j * np.array([0.0, 0.3, 7.0])
    both = frequency_response(*in_series(OSCILLATORS, lag(2.0)), s)
    separate = frequency_response(*lag(2.0), s) @ frequency_response(*OSCILLATORS, s)
    np.testing.assert_allclose(both, separate, atol=1e-14)


@pytest.mark.parametrize("criterion", ["hinf", "h2"])
def test_static_filter_is_a_constant_weight(criterion):
    empty = np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0))
    plain = match(criterion, output_weights=[3.0, 1.0], input_weights=[1.0, 0.2])
    filtered = match(
        criterion,
        output_filter=(*empty, np.diag([3.0, 1.0])),
        input_filter=(*empty, np.diag([1.0, 0.2])),
    )
    assert filtered.hinf_error == pytest.approx(plain.hinf_error, rel=1e-5)
    np.testing.assert_allclose(filtered.theta, plain.theta, atol=1e-4)


def test_error_is_that_of_the_weighted_difference():
    outputs, inputs = lag(0.5), lag(20.0)
    result = match(output_filter=outputs, input_filter=inputs)
    assert result.converged
    gap = weighted_gap(result, outputs=outputs, inputs=inputs)
    assert gap == pytest.approx(result.hinf_error, rel=1e-6)


def test_filter_moves_the_match_to_its_band():
    slow = match(output_filter=lag(0.1))
    plain = match()
    at_rest = [
        linalg.norm(
            frequency_response(*OSCILLATORS, [0.0])[0]
            - frequency_response(r.A, r.B, r.C, r.D, [0.0])[0],
            2,
        )
        for r in (slow, plain)
    ]
    assert at_rest[0] < 0.5 * at_rest[1]
    assert weighted_gap(slow) > weighted_gap(plain)


@pytest.mark.parametrize(
    ("filters", "message"),
    [
        ({"output_filter": lag(1.0, 3)}, "output_filter has matrices of shapes"),
        ({"input_filter": tuple(-M for M in lag(1.0))}, "input_filter has a pole at 1"),
    ],
)
def test_filters_that_do_not_fit_are_refused(filters, message):
    with pytest.raises(ValueError, match=message):
        match(**filters)


# Bounds


@pytest.mark.parametrize("criterion", CRITERIA)
def test_bounds_far_away_change_nothing(criterion):
    free = match(criterion)
    held = match(criterion, bounds=(START - 5.0, START + 5.0))
    np.testing.assert_allclose(held.theta, free.theta, atol=2e-4)
    assert held.hinf_error == pytest.approx(free.hinf_error, rel=1e-5)


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
    assert held.hinf_error == pytest.approx(fixed.hinf_error, rel=1e-5)


def test_exact_match_out_of_bounds_is_not_taken():
    model = SECOND_ORDER.matrices(START)
    inside = match(model=model, bounds=(START - 1, START + 1), theta0=START + 0.1)
    assert inside.exact
    np.testing.assert_allclose(inside.theta, START, rtol=1e-9)
    outside = match(model=model, bounds=(START + 0.1, START + 1), theta0=START + 0.5)
    assert not outside.exact
    assert np.all(outside.theta >= START + 0.1)


def test_start_out_of_bounds_is_refused():
    with pytest.raises(ValueError, match=r"the bounds 1 and 3 of w exclude its start 5; start"):
        match(theta0=[0.3, 5.0, 0.2, 0.2, 0.4], bounds=([0, 1, 0, 0, 0], [1, 3, 1, 1, 1]))


def test_bounds_of_wrong_length_or_order_are_refused():
    with pytest.raises(ValueError, match="bounds must be 5 lower and 5 larger upper ones"):
        match(bounds=(START, START))


# The H2 norm


@pytest.mark.parametrize("poles", [[-1.0], [-1e-4, -1e4], [-1e-6 + 3j, -1e-6 - 3j, -2.0]])
def test_quadrature_of_rational_functions(poles):
    """∫₀^∞ |1/(jω − p)|² dω = π / (2 |Re p|) over a pair, arctan apart."""
    poles = np.array(poles, dtype=complex)
    frequencies, weights = quadrature(poles)
    for pole in poles:
        both = [1.0 / np.abs(sign * 1j * frequencies - pole) ** 2 for sign in (1, -1)]
        assert weights @ (both[0] + both[1]) == pytest.approx(np.pi / abs(pole.real), rel=1e-9)


def test_error_by_quadrature_is_that_of_the_gramian():
    random = np.random.default_rng(1)
    problem = MatchingProblem.build(*OSCILLATORS, SECOND_ORDER.affine)
    for _ in range(5):
        theta = START * random.uniform(0.5, 1.5, 5)
        value = h2_error(problem, theta)
        assert value == pytest.approx(h2_norm(*problem.error_model(theta)), rel=1e-9)


def test_best_gain_is_a_projection():
    """⟨1/(s+1), 1/(s+2)⟩ / ⟨1/(s+2), 1/(s+2)⟩ = (1/3) / (1/4)."""
    structure = MatrixStructure([[-2.0]], [["b"]])
    result = match("h2", ([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), structure, theta0=[1.0])
    assert result.theta[0] == pytest.approx(4 / 3, rel=1e-8)
    assert result.h2_error == pytest.approx(np.sqrt(1 / 2 - (1 / 3) ** 2 / (1 / 4)), rel=1e-8)


def test_best_first_order_model_interpolates_at_its_mirrored_pole():
    """Meier and Luenberger (1967): G and dG/ds agree at −p."""
    A = np.array([[-1.0, 1.0, 0.0], [0.0, -3.0, 1.0], [0.0, 0.0, -7.0]])
    model = A, np.array([[0.5], [0.3], [2.0]]), np.array([[1.0, 0.2, 0.1]]), np.zeros((1, 1))
    result = match("h2", model, MatrixStructure([["p"]], [["b"]]), theta0=[-1.0, 1.0], tol=1e-14)
    p, b = result.theta

    def value_and_slope(A, B, C):
        state = linalg.solve(-p * np.eye(len(A)) - A, B)
        return (C @ state).item(), -(C @ linalg.solve(-p * np.eye(len(A)) - A, state)).item()

    found = value_and_slope(np.array([[p]]), np.array([[b]]), np.array([[1.0]]))
    np.testing.assert_allclose(found, value_and_slope(*model[:3]), rtol=1e-6)


def test_each_criterion_is_best_in_its_own_norm():
    results = {criterion: match(criterion) for criterion in CRITERIA}
    assert all(result.converged for result in results.values())
    assert min(results, key=lambda name: results[name].hinf_error) == "hinf"
    assert min(results, key=lambda name: results[name].h2_error) == "h2"
    np.testing.assert_array_equal(
        results["least_squares"].theta, results["least_squares"].theta_least_squares
    )


def test_feedthrough_is_that_of_the_model_or_refused():
    A, B, C, _ = OSCILLATORS
    model = A, B, C, np.array([[0.5, 0.0], [0.0, 0.0]])
    cells = [[["-a", "w"], ["-w", "-b"]], [[1.0, 0.2], [0.4, -1.0]], np.eye(2)]
    free = MatrixStructure(*cells, [["d", 0.0], [0.0, 0.0]])
    result = match("h2", model, free, theta0=[0.3, 2.0, 0.2, 0.1])
    assert result.theta[3] == 0.5
    assert np.isfinite(result.h2_error)
    with pytest.raises(ValueError, match="the H2 norm is infinite: the model's D = "):
        match("h2", model, MatrixStructure(*cells), theta0=[0.3, 2.0, 0.2])
    bounds = (np.zeros(4), np.array([5.0, 5.0, 5.0, 0.2]))
    with pytest.raises(ValueError, match=r"the bounds of \['d'\] exclude the model's D"):
        match("h2", model, free, theta0=[0.3, 2.0, 0.2, 0.1], bounds=bounds)


def test_feedthrough_is_free_under_weights_that_vanish_at_infinity():
    """Against a search in the norm by Gramians, which knows nothing of the constraint."""
    model = np.array([[-1.0, 2.0], [-2.0, -3.0]]), np.eye(2, 1), np.eye(1, 2), np.zeros((1, 1))
    structure = MatrixStructure([["-a"]], [["b"]], [[1.0]], [["d"]])
    options = {"output_filter": lag(2.0, 1), "theta0": [1.0, 1.0, 0.0]}
    result = match("h2", model, structure, **options)
    problem = MatchingProblem.build(
        *model, structure.affine, {"output_filter": options["output_filter"]}
    )
    rival = optimize.minimize(
        lambda theta: h2_norm(*problem.error_model(theta)) if theta[0] > 0 else 1e3,
        [1.0, 1.0, 0.0],
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 4000},
    )
    assert result.h2_error == pytest.approx(rival.fun * problem.unit, rel=1e-7)
    assert abs(result.theta[2]) > 1e-3


def test_h2_error_is_infinite_where_feedthrough_is_left():
    A, B, C, _ = OSCILLATORS
    result = match("hinf", (A, B, C, 0.3 * np.eye(2)))
    assert result.h2_error == np.inf
    assert result.hinf_error >= 0.3


# What it leaves behind


def test_certificate_is_a_convex_combination_of_gradients_that_vanishes():
    result = match()
    certificate = result.certificate
    problem = MatchingProblem.build(*OSCILLATORS, SECOND_ORDER.affine)
    assert certificate.weights.sum() == pytest.approx(1.0)
    assert np.all(certificate.weights > 0)
    assert certificate.distance < 1e-6
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


def test_certificate_refuses_a_point_that_is_not_stationary():
    problem = MatchingProblem.build(*OSCILLATORS, SECOND_ORDER.affine)
    certificate = certify(problem, START, problem.peak(START)[0])
    assert certificate.distance + certificate.predicted_decrease > 1e-2


def test_a_search_that_is_cut_short_is_not_called_converged():
    starts = [START * np.random.default_rng(seed).uniform(0.7, 1.3, 5) for seed in range(10)]
    short = [match(theta0=start, max_iter=1, n_starts=0) for start in starts]
    whole = match(theta0=START)
    assert whole.converged
    assert whole.certificate.predicted_decrease <= 1e-4
    for result in short:
        assert result.certificate.predicted_decrease >= 0.0
        assert not result.converged or result.hinf_error <= whole.hinf_error * (1 + 1e-6)
        assert result.hinf_error >= whole.hinf_error * (1 - 1e-6)


def test_static_gain_without_a_start():
    """|1/(1 + jω) − d| is least for d = 1/2."""
    structure = MatrixStructure(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [["d"]])
    result = match("hinf", ([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), structure, theta0=None)
    assert result.theta[0] == pytest.approx(0.5, abs=1e-7)


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


def test_starts_in_parallel_give_the_same_match():
    alone, together = match(), match(n_jobs=2)
    np.testing.assert_array_equal(alone.theta, together.theta)
    assert alone.history == together.history


@pytest.mark.parametrize("criterion", CRITERIA)
def test_stage_and_measure_of_every_step(criterion):
    result = match(criterion)
    stages = {stage for stage, _ in result.history}
    last = {"hinf": "minimax", "h2": "h2", "least_squares": "least squares"}[criterion]
    assert stages == {"least squares", last}
    assert result.history[-1][0] == last
    assert result.relative_error == pytest.approx(
        result.hinf_error / hinf_norm(*OSCILLATORS)[0], rel=1e-9
    )
