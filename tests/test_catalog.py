"""Systems of the literature: what was proved or computed of them by others."""

import inspect
import pickle

import numpy as np
import pandas as pd
import pytest
from periodic_cases import bittanti_colaneri, meissner, periodicity_defect, vinograd
from scipy import linalg, special
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
    systems,
)
from sklearn_hd.systems import (
    LTPSystem,
    PeriodicSystem,
    coupled_oscillators,
    duffing,
    flapping_blade,
    flapping_wing,
    hawkmoth,
    mathieu,
)

CATALOG = [coupled_oscillators, duffing, flapping_blade, flapping_wing, hawkmoth, mathieu]
CLOSED_FORMS = [bittanti_colaneri, meissner, vinograd]
LINEAR = [entry for entry in CATALOG if entry not in (duffing, flapping_wing, hawkmoth)]


@pytest.mark.parametrize("entry", CATALOG, ids=lambda entry: entry.__name__)
def test_every_parameter_has_a_default(entry):
    assert entry.__name__ in systems.__all__
    assert all(p.default is not p.empty for p in inspect.signature(entry).parameters.values())
    assert isinstance(entry(), LTPSystem if entry in LINEAR else PeriodicSystem)


@pytest.mark.parametrize("entry", LINEAR + CLOSED_FORMS, ids=lambda entry: entry.__name__)
def test_trace_gives_the_sum_of_the_exponents(entry):
    """Liouville: Σ λ is the mean of tr F, up to the folding of imaginary parts."""
    system = entry()
    trace = np.trace(system.fourier_coefficients(0)[0][0])
    assert system.floquet_exponents().sum().real == pytest.approx(trace, abs=1e-12)


@pytest.mark.parametrize("entry", LINEAR + CLOSED_FORMS, ids=lambda entry: entry.__name__)
def test_systems_survive_pickling(entry):
    system = entry()
    again = pickle.loads(pickle.dumps(system))
    np.testing.assert_array_equal(again.floquet_exponents(), system.floquet_exponents())
    assert again.output_names == system.output_names


# ---- Mathieu ----------------------------------------------------------------------------------


def test_mathieu_characteristic_exponent():
    """ν(2, 0.5) = 0.6304914303: a is an eigenvalue of Hill's matrix (ν + 2k)², q beside it."""
    exponents = mathieu(2.0, 0.5, damping=0.0).floquet_exponents()
    nu = np.abs(exponents.imag)
    np.testing.assert_allclose(nu, 0.6304914303, rtol=0, atol=5e-11)
    np.testing.assert_allclose(exponents.real, 0.0, atol=1e-13)
    squares = (nu[0] + 2.0 * np.arange(-20, 21)) ** 2
    stiffness = linalg.eigvalsh_tridiagonal(squares, np.full(40, 0.5))
    assert np.min(np.abs(stiffness - 2.0)) < 1e-12


@pytest.mark.parametrize("q", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_mathieu_stability_boundaries(q, order):
    """On a = a_m(q) and a = b_m(q) the trace of the monodromy matrix is 2 (−1)^m."""
    boundaries = [special.mathieu_a(order, q)] + ([special.mathieu_b(order, q)] if order else [])
    for a in boundaries:
        trace = np.trace(mathieu(a, q, damping=0.0).monodromy())
        assert trace == pytest.approx(2.0 * (-1) ** order, abs=1e-11)


def test_damping_shifts_the_mathieu_exponents():
    """y = e^{−dt/2} z, z without damping and of stiffness a − d²/4."""
    damped = mathieu(2.0, 0.5, damping=0.3).floquet_exponents()
    shifted = mathieu(2.0 - 0.3**2 / 4, 0.5, damping=0.0).floquet_exponents()
    np.testing.assert_allclose(damped, shifted - 0.15, atol=1e-12)


def test_mathieu_within_a_tongue_grows_unless_damped():
    assert mathieu(1.0, 0.2, damping=0.0).floquet_exponents()[0].real > 0.09
    assert mathieu(1.0, 0.2, damping=0.3).floquet_exponents()[0].real < 0


# ---- Meissner ---------------------------------------------------------------------------------


def test_meissner_multipliers():
    """−0.878096922 and −1.138826449 to nine decimals, by the product of two exponentials."""
    multipliers = np.sort(linalg.eigvals(meissner().monodromy()).real)
    np.testing.assert_allclose(multipliers, [-1.138826449, -0.878096922], atol=6e-10)


def test_meissner_monodromy_is_a_product_of_exponentials():
    system = meissner(stiffness=3.0, modulation=-0.7, share=0.35, period=2.5, damping=0.2)
    expected = np.eye(2)
    for width, stiffness in [(0.35 * 2.5, 3.7), (0.65 * 2.5, 2.3)]:
        expected = linalg.expm(width * np.array([[0.0, 1.0], [-stiffness, -0.2]])) @ expected
    np.testing.assert_allclose(system.monodromy(), expected, rtol=1e-12, atol=1e-13)


# ---- closed forms -----------------------------------------------------------------------------


def test_bittanti_colaneri_exponents():
    np.testing.assert_allclose(bittanti_colaneri().floquet_exponents(), [-1, -3], atol=1e-13)


def test_vinograd_is_unstable_with_frozen_eigenvalues_in_the_left_half_plane():
    system = vinograd()
    psi = np.linspace(0.0, 6.0, 13)
    c, s = np.cos(psi), np.sin(psi)
    F = np.array(
        [
            [-1 - 9 * c**2 + 12 * s * c, 12 * c**2 + 9 * s * c],
            [-12 * s**2 + 9 * s * c, -1 - 9 * s**2 - 12 * s * c],
        ]
    )
    np.testing.assert_allclose(system.F(psi), np.moveaxis(F, -1, 0), atol=1e-13)
    frozen = np.sort(np.linalg.eigvals(system.F(psi)).real, axis=1)
    np.testing.assert_allclose(frozen, np.broadcast_to([-10.0, -1.0], frozen.shape), rtol=1e-9)
    np.testing.assert_allclose(system.floquet_exponents(), [2, -13], atol=1e-12)


# ---- hinged blade -----------------------------------------------------------------------------


@pytest.mark.parametrize(("gamma", "nu"), [(8.0, 1.0), (5.0, 1.15), (12.0, 1.0), (20.0, 1.1)])
def test_hovering_blade(gamma, nu):
    """λ = −γ/16 ± j √(ν² − (γ/16)²), per radian of azimuth (Johnson 1980, section 12-1)."""
    system = flapping_blade(gamma=gamma, mu=0.0, nu=nu, omega=30.0)
    root = np.sqrt(complex(nu**2 - (gamma / 16) ** 2))
    expected = 30.0 * (-gamma / 16 + 1j * root * np.array([1, -1]))
    found = np.exp(system.floquet_exponents() * system.period)
    np.testing.assert_allclose(
        np.sort_complex(found), np.sort_complex(np.exp(expected * system.period)), rtol=1e-9
    )


@pytest.mark.parametrize("mu", [0.0, 0.2, 0.5, 1.0])
def test_blade_exponents_sum_to_the_damping(mu):
    for gamma in (6.0, 12.0):
        exponents = flapping_blade(gamma=gamma, mu=mu, omega=25.0).floquet_exponents()
        assert exponents.sum().real == pytest.approx(-25.0 * gamma / 8, rel=1e-12)


def test_blade_moments_are_integrals_over_the_span():
    """γ/2 ∫ r u_T (u_T θ − u_P) dr with u_T = r + μ sin ψ, u_P = r β′ + μ β cos ψ."""
    gamma, mu, nu, omega = 9.0, 0.35, 1.07, 20.0
    system = flapping_blade(gamma=gamma, mu=mu, nu=nu, omega=omega)
    psi = np.linspace(0.0, 6.0, 11)
    r, weights = np.polynomial.legendre.leggauss(5)
    r, weights = 0.5 * (r + 1), 0.25 * gamma * weights
    u_T = r + mu * np.sin(psi)[:, None]
    F, G = system.F(psi), system.G(psi)
    np.testing.assert_allclose(G[:, 1, 0], omega**2 * (r * u_T**2) @ weights, rtol=1e-13)
    np.testing.assert_allclose(F[:, 1, 1], -omega * (r**2 * u_T) @ weights, rtol=1e-13)
    spring = nu**2 + (r * u_T * mu * np.cos(psi)[:, None]) @ weights
    np.testing.assert_allclose(F[:, 1, 0], -(omega**2) * spring, rtol=1e-13)


def test_hovering_blade_cones_statically():
    """β = γ θ / (8 ν²)."""
    system = flapping_blade(gamma=8.0, mu=0.0, nu=1.2)
    t = np.arange(400) * system.period / 8
    y = system.simulate(np.full(400, 0.1), t)
    np.testing.assert_allclose(y[-1], [0.1 / 1.44, 0.0], atol=1e-9)


def test_blade_refuses_negative_numbers():
    with pytest.raises(ValueError, match=r"mu must be a nonnegative number, got -0.1"):
        flapping_blade(mu=-0.1)


# ---- coupled oscillators ----------------------------------------------------------------------


def test_uncoupled_oscillators_are_two_plain_ones():
    system = coupled_oscillators(coupling=np.zeros((2, 2)), omega=10.0)
    damped = [-z * w + 1j * w * np.sqrt(1 - z**2) for w, z in [(1.0, 0.06), (1.7, 0.04)]]
    expected = np.sort_complex([*damped, *np.conj(damped)])
    np.testing.assert_allclose(np.sort_complex(system.floquet_exponents()), expected, atol=1e-12)


@pytest.mark.parametrize(("e_12", "e_21"), [(0.02, 0.02), (0.01, 0.03)])
def test_combination_resonance_grows_at_the_rate_of_hsu(e_12, e_21):
    system = coupled_oscillators(damping_ratios=(0, 0), coupling=[[0, e_12], [e_21, 0]], omega=2.7)
    expected = np.sqrt(e_12 * e_21 / 1.7) / 4
    growth = system.floquet_exponents()[0].real
    assert growth == pytest.approx(expected, rel=5e-4)  # first order in e


def test_couplings_of_opposite_sign_do_not_resonate_at_the_sum():
    system = coupled_oscillators(damping_ratios=(0, 0), coupling=[[0, 0.02], [-0.02, 0]], omega=2.7)
    assert system.floquet_exponents()[0].real < 1e-7


def test_default_coupled_oscillators_are_stable():
    system = coupled_oscillators()
    assert system.floquet_exponents()[0].real < -0.02
    assert (system.n_states, system.n_inputs, system.n_outputs) == (4, 2, 2)


def test_coupled_oscillators_are_two():
    with pytest.raises(ValueError, match=r"have shapes \(3,\), \(2,\) and \(2, 2\)"):
        coupled_oscillators(frequencies=(1.0, 2.0, 3.0))


# ---- Duffing ----------------------------------------------------------------------------------


def test_duffing_trim_is_periodic_and_its_exponents_sum_to_the_damping():
    system = duffing()
    trim = system.trim(20)
    assert np.max(np.abs(periodicity_defect(system, trim))) < 1e-11
    np.testing.assert_allclose(trim.coefficients[0::4], 0.0, atol=1e-13)  # odd harmonics only
    exponents = system.linearize(trim).floquet_exponents()
    assert exponents.sum().real == pytest.approx(-0.2, abs=1e-11)
    assert exponents[0].real < 0


def test_duffing_without_hardening_is_linear():
    system = duffing(hardening=0.0, omega=1.3)
    response = 1.0 / (1.0 - 1.3**2 + 0.2j * 1.3)
    np.testing.assert_allclose(
        system.trim(3).coefficients[1:3, 0], [response.real, -response.imag], atol=1e-13
    )
    exponents = system.linearize(system.trim(3)).floquet_exponents()
    expected = 1j * np.sqrt(1 - 0.01) - 0.1 - 1.3j  # on the branch of imaginary part
    assert np.min(np.abs(exponents - expected)) < 1e-12


def test_duffing_has_an_exact_oscillation_of_one_frequency():
    """x = a cos ψ solves the free, undamped equation but for the force β a³/4 cos 3ψ."""
    a, beta, omega = 0.8, 1.5, 2.0
    amplitude = (1.0 - omega**2 + 0.75 * beta * a**2) * a
    system = duffing(damping=0.0, hardening=beta, amplitude=amplitude, omega=omega)
    t = np.linspace(0.0, system.period, 9)
    x = np.array([a * np.cos(omega * t), -a * omega * np.sin(omega * t)])
    u = 0.25 * beta * a**3 * np.cos(3 * omega * t)[None]
    acceleration = system.f(x, u, t)[1]
    np.testing.assert_allclose(acceleration, -(omega**2) * x[0], atol=1e-13)


def test_undamped_duffing_at_resonance_starts_from_rest():
    """No first harmonic balances a linear resonance; the guess stays finite."""
    coefficients, inputs = duffing(damping=0.0, hardening=0.0, omega=1.0).trim_guess
    assert not coefficients.any()
    assert not inputs.any()


def test_duffing_jacobian_is_the_derivative():
    system = duffing()
    trim = system.trim(15)
    numeric = PeriodicSystem(
        system.f, period=system.period, state_names=["x", "x_dot"], input_names=["u"]
    )
    psi = np.linspace(0.0, 6.0, 9)
    found, expected = numeric.linearize(trim), system.linearize(trim)
    np.testing.assert_allclose(found.F(psi), expected.F(psi), atol=1e-7)
    np.testing.assert_allclose(found.G(psi), expected.G(psi), atol=1e-9)


# ---- identified from their own responses ------------------------------------------------------


@pytest.mark.filterwarnings("ignore:the outputs .* do not determine")  # two positions, four states
@pytest.mark.parametrize(
    "system",
    [mathieu(), flapping_blade(), coupled_oscillators(), meissner(damping=0.1)],
    ids=["mathieu", "blade", "coupled", "meissner"],
)
def test_exponents_come_back_from_a_record(system):
    """Inputs new in every period, then free decay; period-synchronous, the truth not shown."""
    S, n_periods, rng = 64, 60, np.random.default_rng(0)
    t = pd.Index(np.arange(S * n_periods) * system.period / S, name="time")
    levels = np.zeros((n_periods, system.n_inputs))
    levels[2:20] = rng.choice([-1.0, 1.0], (18, system.n_inputs))
    u = pd.DataFrame(levels.repeat(S, axis=0), t, list(system.input_names))
    y = pd.DataFrame(system.simulate(u, t), t, list(system.output_names))
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(system.omega, reading="period")),
            ("identify", MOESPRegressor(order=system.n_states)),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    ).fit(u, y)
    expected = system.floquet_exponents()
    found = pipe["match"].ltp_.floquet_exponents()
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.max(np.abs(expected)))
