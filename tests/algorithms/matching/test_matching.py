"""Structured matching: laws of exact matches, optimality of inexact ones, what is refused."""

import numpy as np
import pytest
from scipy import linalg, optimize

from sklearn_hd.algorithms.lti.hinf import hinf_norm
from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.algorithms.matching import matching
from sklearn_hd.algorithms.matching.matching import match_structure
from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem, channel_scales
from sklearn_hd.algorithms.matching.smooth_peak import Certificate, SmoothDescent
from sklearn_hd.exceptions import UnstableModelError
from sklearn_hd.structures import MatrixStructure

NAN = np.nan
NEAR = 1e-3  # of the least norm, relative: how near the descent has to come

# Vertical flight of a flapping-wing vehicle, one harmonic kept (Aerospace 2024, 11(11), 875,
# Eq. 26): heave (w_0, φ̇_1c, φ̇_1s) and flap (φ̇_0, w_1c, w_1s).
A_HEAVE = np.array([[-4.0, -0.032, -0.105], [-856.9, -54.747, -179.46], [-2817.0, 151.0, -96.28]])
B_HEAVE = np.array([[0.0], [7.256e6], [0.0]])
A_FLAP = np.array([[-75.51, -428.4, -1408.0], [-0.065, -2.892, -165.9], [-0.211, 164.5, -5.107]])
B_FLAP = np.array([[3.628e6], [0.0], [0.0]])
SUBSYSTEMS = {"heave": (A_HEAVE, B_HEAVE), "flap": (A_FLAP, B_FLAP)}


def subsystem(name):
    """Structure with A and the one driven entry of B free, and its true parameters."""
    A, B = SUBSYSTEMS[name]
    structure = MatrixStructure(np.full((3, 3), NAN), np.where(B == 0, 0.0, NAN)).affine
    return structure, np.concatenate([A.ravel(), B[B != 0]])


def spring_chain(n_masses, n_outputs, seed=0):
    """Masses in a row on springs and dampers, pulled at the free end: 2 n parameters."""
    cells = np.full((2 * n_masses, 2 * n_masses), 0.0)
    cells[:n_masses, n_masses:] = np.eye(n_masses)
    pull, look = np.zeros((2 * n_masses, 1)), np.eye(n_outputs, 2 * n_masses)
    pull[-1] = 1.0
    stacked = np.block([[cells, pull], [look, np.zeros((n_outputs, 1))]])
    basis = np.zeros((2 * n_masses, *stacked.shape))
    for k in range(2 * n_masses):
        i, offset = k % n_masses, (k // n_masses) * n_masses
        left, right = n_masses + i, offset + i
        basis[k, left, right] = -1.0
        if i > 0:
            basis[k, left - 1, right - 1] = -1.0
            basis[k, left - 1, right] = basis[k, left, right - 1] = 1.0
    names = tuple(f"{kind}{i}" for kind in "kc" for i in range(n_masses))
    random = np.random.default_rng(seed)
    theta = np.concatenate([random.uniform(1, 9, n_masses), random.uniform(0.1, 0.5, n_masses)])
    return AffineStructure(stacked, basis, 2 * n_masses, names), theta


def changed_state(structure, theta, T):
    """The structure's model at θ in other coordinates."""
    A, B, C, D = structure.matrices(theta)
    return T @ A @ linalg.inv(T), T @ B, C @ linalg.inv(T), D


def disturbed_heave(size, random):
    """A stable model near heave, in no structure, its channels disturbed alike."""
    states = np.array([[1e-3], [1.0], [1.0]])
    while True:
        noise = random.standard_normal((3, 7))
        A = A_HEAVE + size * np.abs(A_HEAVE).mean() / 30 * noise[:, :3] * (states / states.T)
        B = B_HEAVE + size * np.abs(B_HEAVE).max() * noise[:, 3:4] * states
        C = np.eye(3) + size * noise[:, 4:] * (states / states.T)
        if linalg.eigvals(A).real.max() < 0:
            return A, B, C, np.zeros((3, 1))


# Exact matches


@pytest.mark.slow
@pytest.mark.parametrize("closed_form", [True, False], ids=["closed form", "search"])
@pytest.mark.parametrize("name", list(SUBSYSTEMS))
def test_twenty_random_changes_of_state_and_starts(name, closed_form, monkeypatch):
    if not closed_form:
        monkeypatch.setattr(matching, "output_transformation", lambda problem: None)
    structure, truth = subsystem(name)
    random = np.random.default_rng(2024)
    for _ in range(20):
        model = changed_state(structure, truth, random.standard_normal((3, 3)))
        start = truth * (1 + random.uniform(-0.5, 0.5, len(truth)))
        result = match_structure(*model, structure, theta0=start)
        A = SUBSYSTEMS[name][0]
        assert result.exact
        assert result.converged
        assert linalg.norm(result.A - A) <= 1e-11 * linalg.norm(A)


def test_structured_model_matches_itself_without_a_start():
    structure, truth = subsystem("heave")
    result = match_structure(*structure.matrices(truth), structure)
    np.testing.assert_allclose(result.theta, truth, rtol=1e-10)
    assert result.relative_error < 1e-8
    assert result.unidentified == ()


@pytest.mark.parametrize(("n_masses", "n_outputs"), [(1, 1), (2, 1), (3, 1), (3, 3), (5, 1)])
@pytest.mark.slow
def test_fewer_outputs_than_states(n_masses, n_outputs):
    structure, truth = spring_chain(n_masses, n_outputs)
    random = np.random.default_rng(77)
    for _ in range(4):
        T, _ = linalg.qr(random.standard_normal((2 * n_masses, 2 * n_masses)))
        start = truth * (1 + random.uniform(-0.5, 0.5, len(truth)))
        result = match_structure(*changed_state(structure, truth, T), structure, theta0=start)
        assert result.exact
        np.testing.assert_allclose(result.theta, truth, rtol=1e-9)


def test_unstable_start_finds_the_stable_model():
    structure, truth = spring_chain(2, 1)
    start = truth * [1, 1, -1, -1]
    assert linalg.eigvals(structure.matrices(start)[0]).real.max() > 0
    result = match_structure(*structure.matrices(truth), structure, theta0=start)
    np.testing.assert_allclose(result.theta, truth, rtol=1e-9)


def test_start_at_zero_has_its_poles_on_the_axis(monkeypatch):
    monkeypatch.setattr(matching, "output_transformation", lambda problem: None)
    structure = MatrixStructure([["a"]], [[1.0]]).affine
    result = match_structure([[-2.0]], [[1.0]], [[1.0]], [[0.0]], structure, theta0=[0.0])
    np.testing.assert_allclose(result.theta, [-2.0], rtol=1e-12)


def test_shared_and_scaled_parameters():
    structure = MatrixStructure([["-d", "w"], ["-w", "-d"]], [[0.0], ["2*b"]], C=[["b", 1.0]])
    truth = np.array([0.3, 5.0, 1.7])
    T = np.array([[1.0, 2.0], [-1.0, 1.5]])
    model = changed_state(structure.affine, truth, T)
    result = match_structure(*model, structure.affine, theta0=1.4 * truth)
    np.testing.assert_allclose(result.theta, truth, rtol=1e-10)


def test_feedthrough_parameters_are_matched():
    structure = MatrixStructure([[NAN]], [[1.0]], [[NAN]], [[NAN]]).affine
    result = match_structure(
        [[-3.0]], [[2.0]], [[0.5]], [[7.0]], structure, theta0=[-1.0, 2.0, 1.0]
    )
    np.testing.assert_allclose(result.theta, [-3.0, 1.0, 7.0], rtol=1e-11)


def test_two_inputs_two_outputs():
    cells = [["a", "w", 0.0], ["-w", "a", "c"], [0.0, "d", "e"]]
    structure = MatrixStructure(
        cells, [[1.0, 0.0], [0.0, "b"], [0.0, 1.0]], C=np.eye(2, 3), D=[[0.0, NAN], [0.0, 0.0]]
    )
    truth = dict(zip("awcdeb", [-0.5, 4.0, 1.0, -2.0, -3.0, 0.7], strict=True))
    truth = np.array([truth.get(name, 0.2) for name in structure.parameter_names])
    T = np.random.default_rng(8).standard_normal((3, 3))
    result = match_structure(
        *changed_state(structure.affine, truth, T), structure.affine, theta0=1.3 * truth
    )
    np.testing.assert_allclose(result.theta, truth, rtol=1e-9)


def test_result_does_not_depend_on_units():
    structure, truth = spring_chain(2, 1)
    A, B, C, D = structure.matrices(truth)
    scaled = AffineStructure(
        np.block([[structure.constant[:4]], [1e6 * structure.constant[4:]]]),
        structure.basis,
        4,
        structure.parameter_names,
    )
    result = match_structure(A, B, 1e6 * C, D, scaled, theta0=1.3 * truth)
    np.testing.assert_allclose(result.theta, truth, rtol=1e-9)


# Matches that are not exact


def test_best_constant_for_a_lag_is_half_its_gain():
    # |1/(1 + jω) − d| is largest at 0 or ∞: d = 1/2, error 1/2
    structure = AffineStructure(np.zeros((1, 1)), np.ones((1, 1, 1)), 0, ("d",))
    result = match_structure([[-1.0]], [[1.0]], [[1.0]], [[0.0]], structure, theta0=[0.0])
    assert result.theta[0] == pytest.approx(0.5, abs=NEAR)
    assert result.hinf_error == pytest.approx(0.5, rel=NEAR)
    assert result.converged


@pytest.mark.slow
def test_first_order_match_against_nelder_mead_and_the_hankel_bound():
    A = np.array([[-1.0, 0.0, 0.0], [0.0, -0.5, 3.0], [0.0, -3.0, -0.5]])
    B, C, D = np.array([[2.0], [0.3], [0.1]]), np.array([[1.0, 0.2, -0.3]]), np.zeros((1, 1))
    structure = MatrixStructure([["a"]], [["b"]]).affine
    result = match_structure(A, B, C, D, structure, theta0=[-3.0, 1.0])

    def error(theta):
        if theta[0] >= 0:
            return 1e6
        both = (
            linalg.block_diag(A, [[theta[0]]]),
            np.vstack([B, [[theta[1]]]]),
            np.append(C, [[-1.0]], 1),
        )
        return hinf_norm(*both, D)[0]

    settings = {"xatol": 1e-10, "fatol": 1e-12, "maxiter": 2000}
    best = min(
        optimize.minimize(error, start, method="Nelder-Mead", options=settings).fun
        for start in ([-1.0, 2.0], [-0.3, 1.0], [-5.0, 10.0])
    )
    assert result.hinf_error <= best * (1 + NEAR)
    controllability = linalg.solve_continuous_lyapunov(A, -B @ B.T)
    observability = linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
    hankel = np.sort(np.sqrt(linalg.eigvals(controllability @ observability).real))
    assert result.hinf_error >= hankel[-2]  # no first-order model comes nearer


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.001, 0.01, 0.05])
def test_disturbed_heave_reaches_one_optimum_from_any_start(size):
    structure, truth = subsystem("heave")
    random = np.random.default_rng(11)
    model = disturbed_heave(size, random)
    results = [
        match_structure(*model, structure, theta0=truth * (1 + random.uniform(-0.5, 0.5, 10)))
        for _ in range(2)
    ]
    best = min(result.hinf_error for result in results)
    problem = MatchingProblem.build(*model, structure)
    for result in results:
        assert result.hinf_error <= best * (1 + NEAR)
        assert result.relative_error <= problem.peak(result.theta_least_squares)[0]
        assert not result.exact
        assert linalg.eigvals(result.A).real.max() < 0


@pytest.mark.slow
def test_no_direction_lowers_the_norm_at_an_optimum():
    structure, truth = subsystem("heave")
    random = np.random.default_rng(12)
    model = disturbed_heave(0.02, random)
    result = match_structure(*model, structure, theta0=truth)
    problem = MatchingProblem.build(*model, structure)
    directions = problem.linearised(result.theta, problem.grid)[2]
    assert result.converged
    assert 0.0 <= result.predicted_decrease <= 1e-2
    for _ in range(200):
        step = (
            directions @ random.standard_normal(directions.shape[1]) * 10 ** random.uniform(-6, -1)
        )
        assert problem.peak(result.theta + step)[0] >= result.relative_error * (1 - NEAR)


def test_a_unit_step_is_bounded_in_response_and_in_parameters():
    structure, truth = subsystem("heave")
    problem = MatchingProblem.build(*disturbed_heave(0.02, np.random.default_rng(3)), structure)
    far = truth.copy()
    far[:2] *= 1e7  # parameters that all but cannot move the response any more
    for theta in (truth, far):
        residual, jacobian = problem.residual_and_jacobian(theta)
        directions = problem.linearised(theta, problem.grid)[2]
        length = linalg.norm(residual)
        reach = 30.0 * np.maximum(np.abs(theta), length / linalg.norm(jacobian, axis=0))
        moved, own = jacobian @ directions / length, directions / reach[:, None]
        unit = moved.T @ moved + own.T @ own
        np.testing.assert_allclose(unit, np.eye(len(unit)), atol=1e-9)


@pytest.mark.slow
def test_history_falls_and_error_is_that_of_the_matrices():
    structure, truth = subsystem("heave")
    model = disturbed_heave(0.03, np.random.default_rng(13))
    result = match_structure(*model, structure, theta0=truth)
    stages = [stage for stage, _ in result.history]
    norms = np.array([value for stage, value in result.history if stage == "minimax"])
    assert stages == sorted(stages)  # least squares first
    assert np.all(np.diff(norms) < 0)
    assert norms[-1] == pytest.approx(result.relative_error, rel=1e-12)
    s = 1j * np.array([result.peak_frequency])
    parts = (result.A, result.B, result.C, result.D)
    gap = frequency_response(*model, s) - frequency_response(*parts, s)
    assert linalg.norm(gap[0], 2) == pytest.approx(result.hinf_error, rel=1e-7)
    assert result.relative_error == pytest.approx(result.hinf_error / hinf_norm(*model)[0])
    s = 1j * np.geomspace(1e-2, 1e5, 20_000)
    gap = frequency_response(*model, s) - frequency_response(*parts, s)
    assert np.linalg.norm(gap, 2, axis=(1, 2)).max() <= result.hinf_error * (1 + 1e-8)


@pytest.mark.slow
def test_several_inputs_and_outputs_against_random_descent():
    random = np.random.default_rng(14)
    A = np.array([[-1.0, 5.0, 0.0], [-5.0, -1.0, 1.0], [0.0, 0.3, -2.0]])
    B, C = random.standard_normal((3, 2)), random.standard_normal((2, 3))
    structure = MatrixStructure([["a", "w"], ["-w", "a"]], np.full((2, 2), NAN)).affine
    start = np.array([-1.0, 5.0, 0.5, 0.5, 0.5, 0.5])
    result = match_structure(A, B, C, np.zeros((2, 2)), structure, theta0=start)
    problem = MatchingProblem.build(A, B, C, np.zeros((2, 2)), structure)
    settings = {"xatol": 1e-9, "fatol": 1e-12, "maxiter": 1500, "adaptive": True}
    rival = optimize.minimize(
        lambda theta: min(problem.peak(theta)[0], 1e6),
        result.theta_least_squares,
        method="Nelder-Mead",
        options=settings,
    )
    assert result.converged
    assert result.relative_error <= rival.fun * (1 + NEAR)
    transposed = AffineStructure(
        structure.constant.T, structure.basis.swapaxes(1, 2), 2, structure.parameter_names
    )
    dual = match_structure(A.T, C.T, B.T, np.zeros((2, 2)), transposed, theta0=start)
    assert dual.hinf_error == pytest.approx(result.hinf_error, rel=NEAR)


@pytest.mark.slow
def test_wide_model_equals_its_transpose():
    structure, truth = subsystem("heave")
    A, B, C, D = disturbed_heave(0.02, np.random.default_rng(15))
    transposed = AffineStructure(
        structure.constant.T, structure.basis.swapaxes(1, 2), 3, structure.parameter_names
    )
    tall = match_structure(A, B, C, D, structure, theta0=truth)
    wide = match_structure(A.T, C.T, B.T, D.T, transposed, theta0=truth)
    assert wide.hinf_error == pytest.approx(tall.hinf_error, rel=NEAR)


@pytest.mark.slow
def test_weights_decide_which_output_is_matched():
    structure, truth = subsystem("heave")
    model = disturbed_heave(0.03, np.random.default_rng(16))
    s = 1j * np.geomspace(1e-1, 1e4, 400)
    errors = {}
    for name, weights in {"plain": None, "first": [1e6, 1.0, 1.0]}.items():
        result = match_structure(*model, structure, theta0=truth, output_weights=weights)
        parts = (result.A, result.B, result.C, result.D)
        gap = np.abs(frequency_response(*model, s) - frequency_response(*parts, s))
        errors[name] = gap.max(axis=0)[:, 0]
    assert errors["first"][0] < errors["plain"][0]
    assert errors["first"][1:].max() > errors["plain"][1:].max()


def test_feedthrough_that_the_structure_cannot_have_is_a_floor():
    structure, truth = spring_chain(1, 1)
    A, B, C, _ = structure.matrices(truth)
    result = match_structure(A, B, C, [[0.25]], structure, theta0=truth)
    assert result.feedthrough_floor == pytest.approx(0.25)
    assert result.hinf_error >= 0.25 * (1 - 1e-9)
    assert match_structure(A, B, C, [[0.0]], structure, theta0=truth).feedthrough_floor == 0.0


@pytest.mark.slow
def test_structure_of_another_order():
    structure, truth = spring_chain(1, 1)
    larger, parameters = spring_chain(2, 1)
    reduced = match_structure(*larger.matrices(parameters), structure, theta0=truth)
    assert reduced.relative_error < 1
    assert linalg.eigvals(reduced.A).real.max() < 0
    extended = match_structure(*structure.matrices(truth), larger, theta0=parameters)
    assert extended.relative_error < 1


def test_without_parameters_the_model_is_only_compared():
    structure = MatrixStructure([[-1.0]], [[1.0]]).affine
    result = match_structure([[-2.0]], [[1.0]], [[1.0]], [[0.0]], structure)
    assert result.hinf_error == pytest.approx(0.5)  # 1 − 1/2 at rest
    assert len(result.theta) == len(result.singular_values) == 0


# Which parameters are determined


def test_parameters_that_the_output_does_not_determine_are_named():
    structure = MatrixStructure([[-1.0, "a"], [0.0, "p"]], [[0.0], ["b"]], C=[[1.0, 0.0]]).affine
    truth = np.array([2.0, -3.0, 5.0])  # only the product a b is seen
    result = match_structure(*structure.matrices(truth), structure, theta0=1.2 * truth)
    assert result.unidentified == ("a", "b")
    assert result.singular_values[-1] <= 1e-12 * result.singular_values[0]
    assert result.theta[1] == pytest.approx(-3.0)
    assert result.theta[0] * result.theta[2] == pytest.approx(10.0)


def test_parameter_without_any_effect_is_named():
    structure = MatrixStructure([[-1.0, 0.0], ["x", "p"]], [["b"], [0.0]], C=[[1.0, 0.0]]).affine
    result = match_structure(
        [[-1.0]], [[3.0]], [[1.0]], [[0.0]], structure, theta0=[1.0, -2.0, 1.0]
    )
    assert set(result.unidentified) == {"x", "p"}


# The parts


def test_sensitivity_and_curvature_agree_with_differences():
    random = np.random.default_rng(20)
    structure = AffineStructure(
        random.standard_normal((5, 6)), random.standard_normal((4, 5, 6)), 3, tuple("abcd")
    )
    theta, s = random.standard_normal(4), np.array([1j, 2 + 3j, np.inf])
    left = random.standard_normal((3, 2)) + 1j * random.standard_normal((3, 2))
    right = random.standard_normal((3, 3)) + 1j * random.standard_normal((3, 3))

    def slope(at):
        rates = structure.response_and_sensitivity(at, s)[1]
        return np.einsum("fl,flmk,fm->k", left.conj(), rates, right).real

    steps = 1e-6 * np.eye(4)
    rates = structure.response_and_sensitivity(theta, s)[1]
    moved = [(structure.response(theta + h, s) - structure.response(theta - h, s)) for h in steps]
    np.testing.assert_allclose(rates, np.stack(moved, -1) / 2e-6, atol=1e-6)
    bent = [(slope(theta + h) - slope(theta - h)) / 2e-6 for h in steps]
    np.testing.assert_allclose(structure.curvature(theta, s, left, right), bent, atol=1e-5)


def test_curvature_of_several_vectors_at_a_point_is_the_sum():
    random = np.random.default_rng(22)
    structure = AffineStructure(
        random.standard_normal((5, 6)), random.standard_normal((4, 5, 6)), 3, tuple("abcd")
    )
    theta, s = random.standard_normal(4), np.array([1j, 2 + 3j, np.inf])
    left, right = random.standard_normal((3, 2, 2)), random.standard_normal((3, 2, 3))
    each = sum(structure.curvature(theta, s, left[:, j], right[:, j]) for j in range(2))
    np.testing.assert_allclose(structure.curvature(theta, s, left, right), each, rtol=1e-10)
    assert not structure.curvature(theta, s[2:], left[2:], right[2:]).any()


def test_channel_scales_equalise_and_survive_a_zero_channel():
    random = np.random.default_rng(21)
    response = random.standard_normal((50, 3, 2)) * np.array([[1e-1], [1.0], [1e3]]) * [1.0, 1e2]
    outputs, inputs = channel_scales(response)
    energy = np.mean(np.abs(outputs[:, None] * response * inputs) ** 2, axis=0)
    np.testing.assert_allclose(energy.mean(axis=1), energy.mean(), rtol=1e-6)
    np.testing.assert_allclose(energy.mean(axis=0), energy.mean(), rtol=1e-6)
    response[:, 0] = 0.0
    assert np.all(np.isfinite(channel_scales(response)[0]))
    assert np.all(np.isfinite(channel_scales(0 * response)[0]))


# What is refused


def test_unstable_model_is_refused():
    structure, _ = subsystem("heave")
    with pytest.raises(UnstableModelError, match="the model has a pole at"):
        match_structure(-A_HEAVE, B_HEAVE, np.eye(3), np.zeros((3, 1)), structure)


def test_structure_that_is_never_stable_is_refused():
    structure = MatrixStructure([[0.5]], [[NAN]]).affine
    with pytest.raises(UnstableModelError, match="no stable model of this structure was found"):
        match_structure([[-1.0]], [[1.0]], [[1.0]], [[0.0]], structure, theta0=[1.0])


@pytest.mark.slow
def test_a_direction_that_fades_on_the_way_does_not_hold_up_the_others():
    """One channel of four states: the best pair of poles ends double on the real axis."""
    random = np.random.default_rng(502)
    A = random.standard_normal((4, 4))
    A -= (linalg.eigvals(A).real.max() + random.uniform(0.1, 0.5)) * np.eye(4)
    model = A, random.standard_normal((4, 1)), random.standard_normal((1, 4)), np.zeros((1, 1))
    cells = [["a", "w"], ["-w", "a"]], [[NAN], [NAN]], [[1.0, 0.0]]
    result = match_structure(*model, MatrixStructure(*cells).affine)
    assert result.converged
    assert result.hinf_error < 0.386  # 0.444 where it did


@pytest.mark.parametrize(("promised", "converged"), [(1e-3, True), (1.2, False)])
def test_a_bound_that_is_down_at_no_minimum_has_not_converged(monkeypatch, promised, converged):
    """A certificate of more than the norm itself says that the descent ended nowhere."""
    seen = Certificate(np.ones(1), np.ones(1), np.ones(1), promised)

    def ended(problem, fits, starts, max_iter):
        return fits[0], SmoothDescent(fits[0].theta, (problem.peak(fits[0].theta)[0],), 1.0, seen)

    monkeypatch.setattr("sklearn_hd.algorithms.matching.matching.least_norm", ended)
    two = np.diag([-1.0, -3.0])
    lag = MatrixStructure([["-a"]], [["b"]]).affine
    found = match_structure(two, np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), lag)
    assert found.converged is converged
