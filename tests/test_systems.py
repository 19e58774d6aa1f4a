"""Periodic systems: the paper's matrices, trim, linearisation, exact responses, errors."""

import pickle

import control
import numpy as np
import pandas as pd
import pytest
from periodic_cases import periodicity_defect
from scipy import linalg
from scipy.integrate import solve_ivp

from sklearn_hd.algorithms.signals.fourier import sampled_harmonics
from sklearn_hd.exceptions import TrimError
from sklearn_hd.systems import (
    FourierMatrix,
    LTPSystem,
    PeriodicSystem,
    estimate_harmonic_transfer_function,
    flapping_wing,
)

# Aerospace 2024, 11(11), 875, Eq. 25, as printed: the digits are truncated, not rounded.
EQ_25_A = [
    ["-4", "0", "0", "-0.032", "0", "-0.105"],
    ["0", "-75.51", "-428.4", "0", "-1.408e3", "0"],
    ["0", "-0.065", "-2.892", "0", "-165.9", "0"],
    ["-856.9", "0", "0", "-54.74", "0", "-179.4"],
    ["0", "-0.211", "164.5", "0", "-5.107", "0"],
    ["-2.817e3", "0", "0", "151.0", "0", "-96.28"],
]
EQ_25_B = [
    ["0", "0", "0"],
    ["0", "3.628e6", "0"],
    ["0", "0", "0"],
    ["7.256e6", "0", "0"],
    ["0", "0", "0"],
    ["0", "0", "0"],
]
# Eq. 26: the same in the order w_0, phi_dot_1c, phi_dot_1s, phi_dot_0, w_1c, w_1s.
EQ_26_ORDER = [0, 3, 5, 1, 2, 4]
EQ_26_A = [
    ["-4", "-0.032", "-0.105", "0", "0", "0"],
    ["-856.9", "-54.747", "-179.46", "0", "0", "0"],
    ["-2.817e3", "151.0", "-96.28", "0", "0", "0"],
    ["0", "0", "0", "-75.51", "-428.4", "-1.408e3"],
    ["0", "0", "0", "-0.065", "-2.892", "-165.9"],
    ["0", "0", "0", "-0.211", "164.5", "-5.107"],
]
ROUNDING = 1e-9  # relative error that is not a digit: 7.2559999999e6 is printed 7.256e6


def as_printed(value, printed, size):
    """The number in the printed one's format, its digits cut off."""
    if printed == "0":
        return "0" if abs(value) < ROUNDING * size else repr(value)
    mantissa, _, exponent = printed.partition("e")
    decimals = len(mantissa.partition(".")[2])
    scaled = value / 10.0 ** int(exponent or 0) * 10**decimals
    digits = np.trunc(scaled * (1 + ROUNDING)) / 10**decimals
    return f"{digits:.{decimals}f}" + (f"e{exponent}" if exponent else "")


def truncated(matrix, printed):
    size = np.max(np.abs(matrix))
    return [
        [as_printed(value, text, size) for value, text in zip(row, texts, strict=True)]
        for row, texts in zip(matrix, printed, strict=True)
    ]


@pytest.fixture(scope="module")
def wing():
    return flapping_wing()


@pytest.fixture(scope="module")
def paper_hd(wing):
    """The paper's model: a trim of two harmonics, decomposed with N = 1."""
    return wing.linearize(wing.trim(2)).harmonic_decomposition(1)


@pytest.fixture(scope="module")
def orbit(wing):
    return wing.trim(256, method="shooting")


@pytest.fixture(scope="module")
def wing_ltp(wing, orbit):
    return wing.linearize(orbit)


# ---- the paper ----------------------------------------------------------------------------


def test_hd_matrices_are_those_of_equation_25(paper_hd):
    assert truncated(paper_hd.A, EQ_25_A) == EQ_25_A
    assert truncated(paper_hd.B, EQ_25_B) == EQ_25_B


def test_reordered_matrices_are_those_of_equation_26(paper_hd):
    A = paper_hd.A[np.ix_(EQ_26_ORDER, EQ_26_ORDER)]
    assert truncated(A, EQ_26_A) == EQ_26_A
    B = paper_hd.B[EQ_26_ORDER]
    expected = [EQ_25_B[row] for row in EQ_26_ORDER]
    assert truncated(B, expected) == expected


def test_integrals_of_the_kinks_must_be_converged(wing):
    """|φ̇| averaged over 256 equal steps a period loses printed digits; 4096 keep them."""
    ltp = wing.linearize(wing.trim(2))
    for n_points, enough in [(256, False), (4096, True)]:
        F = sampled_harmonics(ltp.F(2 * np.pi * np.arange(n_points) / n_points), 2)
        A = LTPSystem(F, np.zeros((2, 1)), omega=ltp.omega).harmonic_decomposition(1).A
        assert (truncated(A, EQ_25_A) == EQ_25_A) is enough


def test_names_follow_equation_24(paper_hd):
    states = ["w_0", "phi_dot_0", "w_1c", "phi_dot_1c", "w_1s", "phi_dot_1s"]
    assert paper_hd.state_labels == paper_hd.output_labels == states
    assert paper_hd.input_labels == ["U_0", "U_1c", "U_1s"]
    assert isinstance(paper_hd, control.StateSpace)
    np.testing.assert_array_equal(paper_hd.C, np.eye(6))
    assert not paper_hd.D.any()


def test_subsystem_eigenvalues(paper_hd):
    """Heave and flap subsystems of Eq. 26; the paper prints -75.75 for the fast mode."""
    A = paper_hd.A[np.ix_(EQ_26_ORDER, EQ_26_ORDER)]
    heave, flap = (np.sort_complex(linalg.eigvals(block)) for block in (A[:3, :3], A[3:, 3:]))
    np.testing.assert_allclose(heave, [-75.75 - 162.42j, -75.75 + 162.42j, -3.529], atol=0.01)
    assert flap[0] == pytest.approx(-76.25, abs=0.01)


def test_trim_torque_and_stroke(wing):
    trim = wing.trim(2)
    assert trim.inputs[0] == pytest.approx(0.00421696, abs=5e-9)
    psi = 2 * np.pi * np.arange(4096) / 4096
    angle = np.cumsum(trim.states(psi)[:, 1]) * wing.period / 4096
    assert np.degrees(np.ptp(angle)) / 2 == pytest.approx(61.3, abs=0.05)


@pytest.mark.parametrize("n_harmonics", [20, 30, 64])
def test_floquet_exponents_of_a_many_harmonic_trim(wing, n_harmonics):
    exponents = wing.linearize(wing.trim(n_harmonics)).floquet_exponents()
    np.testing.assert_allclose(exponents, [-3.527185, -76.07195], rtol=1e-6)


@pytest.mark.parametrize(("n_harmonics", "slow"), [(1, -3.52905), (3, -3.52726), (8, -3.52719)])
def test_hd_eigenvalues_tend_to_the_floquet_exponent(wing_ltp, n_harmonics, slow):
    eigenvalues = linalg.eigvals(wing_ltp.harmonic_decomposition(n_harmonics).A)
    assert np.min(np.abs(eigenvalues - slow)) < 6e-6
    nearest = eigenvalues[np.argmin(np.abs(eigenvalues - wing_ltp.floquet_exponents()[0]))]
    assert nearest == pytest.approx(slow, abs=6e-6)


def test_modal_participation_is_figure_1(wing_ltp):
    """w: heave mode by harmonic 0, flap mode by harmonic 1; φ̇ the other way round."""
    shares = wing_ltp.modal_participation(1)
    heave, flap = shares.columns
    assert heave.real == pytest.approx(-3.53, abs=0.01)
    assert flap.real == pytest.approx(-76.3, abs=0.1)
    for state, mode in [("w", heave), ("phi_dot", flap)]:
        np.testing.assert_allclose(shares.loc[state, mode], [1.0, 0.0], atol=1e-9)
    for state, mode in [("w", flap), ("phi_dot", heave)]:
        np.testing.assert_allclose(shares.loc[state, mode], [0.0, 1.0], atol=1e-9)


# ---- trim -----------------------------------------------------------------------------------


def test_harmonic_balance_agrees_with_shooting(wing, orbit):
    balanced = wing.trim(128)
    np.testing.assert_allclose(balanced.inputs, orbit.inputs, rtol=1e-9)
    np.testing.assert_allclose(balanced.initial_state, orbit.initial_state, rtol=1e-7)
    size = np.max(np.abs(orbit.coefficients), axis=0)
    difference = balanced.coefficients[:41] - orbit.coefficients[:41]
    assert np.max(np.abs(difference) / size) < 1e-9


def test_truncation_error_of_the_trim_falls_with_the_cube_of_the_harmonics(wing, orbit):
    """|φ̇| φ̇ has a jump in its curvature wherever the wing reverses: harmonics like k⁻⁴."""
    psi, errors = np.linspace(0, 2 * np.pi, 2001), []
    for N in (32, 128):
        trim = wing.trim(N)
        assert abs(trim.coefficients[0, 0]) < 1e-12  # mean w = 0 holds whatever N
        errors.append(np.max(np.abs(trim.states(psi) - orbit.states(psi))[:, 1]))
    assert errors[0] / errors[1] == pytest.approx(4.0**3, rel=0.5)


def test_shooting_returns_to_its_start(wing, orbit):
    size = np.max(np.abs(orbit.coefficients), axis=0)
    allowed = 1e-13 * size + 1e-14  # of one step of the integration, of which there are many
    assert np.all(np.abs(periodicity_defect(wing, orbit)) < 50 * allowed)
    assert orbit.residual < 1e-10


def test_trim_starts_from_another_trim(wing):
    coarse = wing.trim(2)
    fine = wing.trim(10, guess=coarse)
    np.testing.assert_allclose(fine.coefficients, wing.trim(10).coefficients, rtol=0, atol=1e-9)


def test_trim_with_held_input_leaves_the_mean_free(wing):
    trim = wing.trim(20, targets={}, inputs={"U": 0.0045})
    assert trim.inputs[0] == 0.0045
    assert trim.coefficients[0, 0] < -1e-3  # more lift than weight: it climbs (w is down)


def test_trim_states_are_read_only(orbit):
    with pytest.raises(ValueError, match="read-only"):
        orbit.coefficients[0, 0] = 1.0


@pytest.mark.parametrize("method", ["harmonic_balance", "shooting"])
def test_trim_failure_says_what_to_do(wing, method):
    weightless = flapping_wing(k_L=1e-12)
    with pytest.raises(TrimError, match="give a guess closer"):
        weightless.trim(10, method=method, guess=(np.ones((3, 2)), np.zeros(1)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_harmonics": -1}, "n_harmonics must be a whole number of at least 0, got -1"),
        ({"n_harmonics": 2.5}, "n_harmonics must be a whole number of at least 0, got 2.5"),
        ({"method": "newton"}, "method='newton' is not known; use one of 'harmonic_balance'"),
        ({"targets": {"v": 0.0}}, r"targets names \['v'\].*states are \['w', 'phi_dot'\]"),
        ({"inputs": {"V": 0.0}}, r"inputs names \['V'\]; the inputs are \['U'\]"),
        ({"inputs": {"U": 0.0}}, r"1 targets cannot determine the free inputs \[\]"),
        ({"guess": (np.zeros((3, 1)), np.zeros(1))}, r"coefficients \(2 K \+ 1, 2\)"),
        ({"n_points": 50}, "n_points=50 cannot separate"),
    ],
)
def test_trim_refuses(wing, arguments, message):
    with pytest.raises(ValueError, match=message):
        wing.trim(**arguments)


# ---- linearisation --------------------------------------------------------------------------


def test_differences_agree_with_the_analytic_jacobian(wing):
    trim = wing.trim(20)
    numeric = PeriodicSystem(
        wing.f,
        _first_state,
        period=wing.period,
        state_names=wing.state_names,
        input_names=wing.input_names,
    )
    assert numeric.output_names == ("y1",)
    by_differences, analytic = numeric.linearize(trim), wing.linearize(trim)
    psi = np.linspace(0.1, 6.1, 7)  # no reversal of the wing within a step of these
    np.testing.assert_allclose(by_differences.F(psi), analytic.F(psi), rtol=1e-7)
    np.testing.assert_allclose(by_differences.G(psi), analytic.G(psi), rtol=1e-7)
    np.testing.assert_allclose(by_differences.P(psi), np.tile([[1.0, 0.0]], (7, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(by_differences.Q(psi), 0.0, atol=1e-9)
    np.testing.assert_allclose(
        by_differences.floquet_exponents(), analytic.floquet_exponents(), rtol=1e-7
    )
    found, expected = by_differences.fourier_coefficients(3)[0], analytic.fourier_coefficients(3)[0]
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.max(np.abs(expected)))


def test_system_without_inputs_is_trimmed_by_differences():
    """ẋ = −x + cos t: x* = (cos t + sin t) / 2, one real exponent −1."""
    system = PeriodicSystem(_relaxation, period=2 * np.pi, state_names="x", input_names=[])
    trim = system.trim(3)
    np.testing.assert_allclose(trim.coefficients[:3, 0], [0.0, 0.5, 0.5], atol=1e-12)
    assert trim.n_harmonics == 3
    assert system.linearize(trim).floquet_exponents()[0] == pytest.approx(-1.0, rel=1e-7)
    assert "states=['x']" in repr(system)


def _relaxation(x, u, t):
    return -x + np.cos(t)


def _first_state(x, u, t):
    return x[:1] + 0.0 * u


# ---- responses against an independent integration ------------------------------------------


def independent_response(x0, torque, du, n_periods, sampled):
    """w, φ̇ and their perturbations: Eq. 23 and its derivatives written out, by SciPy's DOP853.

    ``du`` lists (end of the interval in periods, ΔU); ``sampled`` samples a period.
    """
    k_d1, k_d2, k_d3, k_L = 0.0355222804, 0.335296893, 16.6471651, 6.27088723e-4
    omega, inverse_inertia = 2 * np.pi * 26.3, 7.256e6
    period = 1 / 26.3

    def rates(t, x, change):
        w, p, w_nl, p_nl, dw, dp = x
        drive = inverse_inertia * np.cos(omega * t)
        return [
            9.81 - k_d1 * abs(p) * w - k_L * p**2,
            -k_d2 * abs(p) * p - k_d3 * w * p + drive * torque,
            9.81 - k_d1 * abs(p_nl) * w_nl - k_L * p_nl**2,
            -k_d2 * abs(p_nl) * p_nl - k_d3 * w_nl * p_nl + drive * (torque + change),
            -k_d1 * abs(p) * dw - (k_d1 * np.sign(p) * w + 2 * k_L * p) * dp,
            -k_d3 * p * dw - (2 * k_d2 * abs(p) + k_d3 * w) * dp + drive * change,
        ]

    x, start, pieces = np.r_[x0, x0, 0.0, 0.0], 0, [np.r_[x0, x0, 0.0, 0.0][:, None]]
    for end, change in [*du, (n_periods, 0.0)]:
        for period_number in range(start, end):  # whole periods: the samples stay end points
            for k in range(sampled):
                span = (period_number + np.array([k, k + 1]) / sampled) * period
                solution = solve_ivp(
                    rates, span, x, "DOP853", args=(change,), rtol=1e-12, atol=1e-14
                )
                x = solution.y[:, -1]
                pieces.append(x[:, None])
        start = end
    return np.concatenate(pieces, axis=1).T


def test_responses_agree_with_an_independent_integration(wing, orbit, wing_ltp):
    n_periods, sampled, change = 9, 8, 0.02 * orbit.inputs[0]
    reference = independent_response(
        orbit.initial_state,
        orbit.inputs[0],
        [(1, 0.0), (3, change), (5, -change)],
        n_periods,
        sampled,
    )
    t = np.arange(n_periods * sampled + 1) * wing.period / sampled
    du = np.zeros((len(t), 1))
    du[sampled : 3 * sampled], du[3 * sampled : 5 * sampled] = change, -change
    nonlinear = wing.simulate(orbit.inputs + du, t, orbit.initial_state)
    linear = wing_ltp.simulate(du, t)
    for found, expected in [(nonlinear, reference[:, 2:4]), (linear, reference[:, 4:])]:
        error = np.max(np.abs(found - expected), axis=0) / np.max(np.abs(expected), axis=0)
        assert np.max(error) < 1e-8
    np.testing.assert_allclose(orbit.states(wing.omega * t), reference[:, :2], atol=1e-5)


def test_small_motions_of_the_nonlinear_system_are_those_of_the_linear_one(wing, orbit, wing_ltp):
    t = np.arange(640) * wing.period / 64
    du = np.where(t > 2 * wing.period, 1e-5 * orbit.inputs[0], 0.0)[:, None]
    rest = wing.simulate(orbit.inputs + 0 * du, t, orbit.initial_state)
    moved = wing.simulate(orbit.inputs + du, t, orbit.initial_state)
    linear = wing_ltp.simulate(du, t)
    np.testing.assert_allclose(moved - rest, linear, atol=1e-4 * np.max(np.abs(linear)))


def test_simulate_returns_outputs_of_g(wing, orbit):
    system = PeriodicSystem(
        wing.f, _first_state, period=wing.period, state_names=["a", "b"], input_names="U"
    )
    t = np.arange(5) * 1e-3
    y, x = system.simulate(np.zeros(5), t, orbit.initial_state, return_states=True)
    assert y.shape == (5, 1)
    np.testing.assert_array_equal(y[:, 0], x[:, 0])


def test_systems_can_be_pickled(wing, orbit, wing_ltp):
    t = np.arange(20) * 1e-3
    u = np.full((20, 1), 1e-4)
    again = pickle.loads(pickle.dumps(wing))
    np.testing.assert_array_equal(again.simulate(u, t), wing.simulate(u, t))
    ltp = pickle.loads(pickle.dumps(wing_ltp))
    np.testing.assert_array_equal(ltp.simulate(u, t), wing_ltp.simulate(u, t))
    trim = pickle.loads(pickle.dumps(orbit))
    np.testing.assert_array_equal(trim.states(0.3), orbit.states(0.3))


# ---- refusals ---------------------------------------------------------------------------------


def test_nonlinear_simulate_takes_one_record(wing):
    with pytest.raises(ValueError, match=r"u has shape \(2, 3, 1\)"):
        wing.simulate(np.zeros((2, 3, 1)), [0.0, 1.0, 2.0])


def test_periodic_system_refuses_a_period_that_is_not_positive(wing):
    with pytest.raises(ValueError, match=r"period must be a positive number in seconds, got -1.0"):
        PeriodicSystem(wing.f, period=-1.0, state_names=["a"], input_names=["b"])


def test_periodic_system_needs_names(wing):
    with pytest.raises(ValueError, match="state_names=None must name each signal in text"):
        PeriodicSystem(wing.f, period=1.0, state_names=None, input_names=["U"])


def test_responses_do_not_depend_on_the_origin_of_time(rng):
    """At 1.7e9 s the intervals of a period were not resolved: ωt was rounded to 3e-5 rad."""
    omega = 165.0
    ltp = LTPSystem(FourierMatrix([[[-20.0]], [[5.0]], [[3.0]]]), np.ones((1, 1)), omega=omega)
    machine = PeriodicSystem(
        lambda x, u, t: (-20.0 + 5.0 * np.cos(omega * t) + 3.0 * np.sin(omega * t)) * x + u,
        period=2 * np.pi / omega,
        state_names=["x"],
        input_names=["u"],
    )
    t = 2 * np.pi / omega / 64 * np.arange(640)
    late = t + round(1.7e9 * omega / 2 / np.pi) * 2 * np.pi / omega
    u = rng.standard_normal((640, 1))
    expected = ltp.simulate(u, t)
    for system in (ltp, machine):
        np.testing.assert_allclose(system.simulate(u, t), expected, atol=1e-11)
        np.testing.assert_allclose(
            system.simulate(u, late), expected, atol=1e-4 * np.abs(expected).max()
        )


@pytest.mark.parametrize("seconds", [0.0, 1.7e9])
def test_transfer_functions_are_estimated_from_any_origin_of_time(rng, seconds):
    """A modulator: what ωt rounds away at 1.7e9 s would be a floor of 2e-5."""
    omega = 165.0
    t = 1e-3 * np.arange(6000) + round(seconds * omega / 2 / np.pi) * 2 * np.pi / omega
    u = pd.Series(rng.standard_normal(6000), t, name="u")
    y = (np.cos(omega * 1e-3 * np.arange(6000)) * u).rename("y")
    estimate = estimate_harmonic_transfer_function(u, y, omega, 1)
    np.testing.assert_allclose(np.abs(estimate.harmonic(1)), 0.5, atol=2e-6)
    np.testing.assert_allclose(estimate.harmonic(0), 0.0, atol=2e-6)
