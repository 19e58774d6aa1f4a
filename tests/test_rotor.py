"""A rotor in service: its equations, its record, and what the third reading makes of it."""

import pickle

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.datasets import make_rotor
from sklearn_hd.datasets._rotor import INFLOW, _gusts


@pytest.fixture(scope="module")
def rotor():
    return make_rotor(n_turns=200, random_state=0)


def rates(psi, x, asked, inflow, gamma=5.0, mu=0.4, nu=1.2):
    """β′, β″ and θ′ as the docstring has them."""
    (beta, flapping, theta), s, c = x, np.sin(psi), np.cos(psi)
    damping = gamma / 8 * (1 + 4 / 3 * mu * s)
    stiffness = nu**2 + gamma / 8 * (4 / 3 * mu * c + mu**2 * np.sin(2 * psi))
    lift = gamma / 8 * (1 + 8 / 3 * mu * s + 2 * mu**2 * s**2) * theta
    lift += gamma * (1 / 6 + mu / 4 * s) * inflow
    return np.array([flapping, lift - damping * flapping - stiffness * beta, 0.7 * (asked - theta)])


def test_it_has_the_equations_of_its_docstring(rotor):
    """At random points, in time: β in rad, its rate in rad/s."""
    rng, ltp = np.random.default_rng(1), rotor.ltp
    for psi in rng.uniform(0.0, 2.0 * np.pi, 20):
        x, u = rng.standard_normal(3), rng.standard_normal(2)
        found = ltp.F(np.array([psi]))[0] @ x + ltp.G(np.array([psi]))[0] @ u
        expected = rates(psi, x / [1.0, rotor.omega, 1.0], *u)
        expected *= rotor.omega * np.array([1.0, rotor.omega, 1.0])
        assert found == pytest.approx(expected, abs=1e-9)


def test_in_hover_exponents_and_loads_have_closed_forms():
    """λ = −γ/16 ± j √(ν² − (γ/16)²), the actuator's, and β_k of a resonator (Johnson 1980)."""
    gamma, nu, omega = 6.0, 1.15, 30.0
    hover = make_rotor(n_turns=2, gamma=gamma, mu=0.0, nu=nu, omega=omega)
    half = gamma / 16.0
    pair = -half + 1j * np.sqrt(nu**2 - half**2)
    expected = np.exp(2.0 * np.pi * np.array([pair, pair.conjugate(), -0.7]))
    found = np.exp(2.0 * np.pi * hover.exponents / omega)
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), rel=1e-8)
    loads, inflow = hover.loads["flap"], np.array(INFLOW)
    assert loads["0"] == pytest.approx(gamma / 6.0 * inflow[0] / nu**2)
    for k in (1, 2, 3):
        one = gamma / 6.0 * (inflow[2 * k - 1] - 1j * inflow[2 * k])
        one /= nu**2 - k**2 + 1j * k * gamma / 8.0
        found = loads[f"{k}c"] - 1j * loads[f"{k}s"]
        assert found == pytest.approx(one, rel=1e-9)


def test_the_record_is_that_of_its_equations():
    """Integrated sample by sample from the orbit, by another solver."""
    rotor = make_rotor(n_turns=6, turbulence=0.0, noise=0.0, random_state=3)
    psi = np.unwrap(rotor.azimuth.to_numpy())
    slope = np.concatenate([[0.0], np.ravel([[0.0, k] for k in range(1, 13)])])
    at_rest = rotor.loads["flap"].to_numpy()
    speed = np.zeros_like(at_rest)  # of β at ψ = 0: a sine's rate is its harmonic
    speed[2::2] = slope[2::2]
    x = np.array([at_rest[0] + at_rest[1::2].sum(), speed @ at_rest, 0.0])
    flap = []
    for k, asked in enumerate(rotor.inputs["pitch"]):
        flap.append(x[0])
        after = psi[k] + rotor.omega * rotor.sample_time

        def motion(now, x, asked=asked):
            inflow = (harmonic_functions(np.array([now]), range(4)) @ INFLOW)[0]
            return rates(now, x, asked, inflow)

        x = solve_ivp(motion, (psi[k], after), x, rtol=1e-10, atol=1e-13).y[:, -1]
    assert rotor.outputs["flap"].to_numpy() == pytest.approx(np.array(flap), abs=1e-9)


def test_what_is_linear_adds_up(rotor):
    calm = make_rotor(n_turns=200, turbulence=0.0, noise=0.0, random_state=0)
    left = (calm.outputs - calm.response).to_numpy()
    functions = harmonic_functions(calm.azimuth.to_numpy(), range(13))
    assert left == pytest.approx(functions @ calm.loads.to_numpy(), abs=1e-12)
    assert rotor.response.equals(calm.response)
    noise = (rotor.outputs - rotor.outputs_clean).to_numpy()
    assert noise.std() == pytest.approx(0.01 * rotor.response.to_numpy().std(), rel=0.05)


def test_its_clock_does_not_know_the_machine(rotor):
    steps = np.diff(rotor.inputs.index)
    assert np.ptp(steps) < 1e-12
    assert rotor.samples_per_turn == pytest.approx(2.0 * np.pi / (38.8 * 0.01))
    assert rotor.samples_per_turn % 1.0 == pytest.approx(0.19, abs=0.01)
    moved = np.flatnonzero(np.diff(rotor.inputs["pitch"]))
    assert moved[0] < 12
    assert np.max(np.diff(moved)) < 30
    assert set((moved + 1) % 3) == {0}


def test_gusts_have_the_size_and_memory_that_they_say():
    one, other = (
        make_rotor(n_turns=20, pitch=0.0, turbulence=size, random_state=0)
        for size in (0.004, 0.002)
    )
    functions = harmonic_functions(one.azimuth.to_numpy(), range(13))
    shaken, half = (each.outputs - functions @ each.loads.to_numpy() for each in (one, other))
    assert shaken.to_numpy() == pytest.approx(2.0 * half.to_numpy(), abs=1e-12)
    gusts = _gusts(np.full(100_000, 0.4), np.random.default_rng(0))
    assert gusts.std() == pytest.approx(1.0, rel=0.02)
    assert np.mean(gusts[1:] * gusts[:-1]) == pytest.approx(np.exp(-0.3 * 0.4), rel=0.02)
    assert one.gust_exponent == pytest.approx(-0.3 * one.omega)


@pytest.mark.slow
def test_the_speed_varies_by_what_was_asked():
    rotor = make_rotor(n_turns=500, speed_variation=0.02, random_state=4)
    speed = np.diff(np.unwrap(rotor.azimuth)) / rotor.sample_time
    assert speed.std() == pytest.approx(0.02 * rotor.omega, rel=0.1)
    assert speed.mean() == pytest.approx(rotor.omega, rel=2e-3)
    assert rotor.azimuth.name == "psi"
    assert rotor.azimuth.between(0.0, 2.0 * np.pi, inclusive="left").all()


def test_the_same_seed_gives_the_same_record(rotor):
    again = make_rotor(n_turns=200, random_state=0)
    assert again.outputs.equals(rotor.outputs)
    assert not make_rotor(n_turns=200, random_state=1).outputs.equals(rotor.outputs)
    assert pickle.loads(pickle.dumps(rotor)).outputs.equals(rotor.outputs)


@pytest.mark.parametrize(
    ("argument", "given"),
    [
        ("n_turns", 1),
        ("hold", 0),
        ("omega", -1.0),
        ("sample_time", 0.0),
        ("turbulence", -0.1),
        ("speed_variation", float("nan")),
        ("mu", -0.1),
    ],
)
def test_what_is_not_allowed_is_named(argument, given):
    with pytest.raises(ValueError, match=f"{argument} must be .* got {given}"):
        make_rotor(**{argument: given})
    with pytest.raises(ValueError, match="makes the rotor stand still"):
        make_rotor(speed_variation=2.0)


@pytest.mark.parametrize("variation", [0.0, 0.01])
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_samples_at_their_azimuths_give_the_rotor_back(variation):
    rotor = make_rotor(speed_variation=variation, random_state=5)
    X, y = rotor.inputs.join(rotor.azimuth), rotor.outputs
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(azimuth="psi", reading="sample")),
            ("identify", MOESPRegressor()),
        ]
    )
    split = 2 * len(X) // 3
    pipe.fit(X.iloc[:split], y.iloc[:split])
    test = X.iloc[split:]
    response = pipe.predict(test) - pipe.predict(test.assign(pitch=0.0))
    truth = rotor.response.iloc[split:]
    left = ((response - truth) ** 2).sum() / (truth**2).sum()
    assert left["flap"] < 0.01
    error = (pipe["identify"].loads_ - rotor.loads).abs().max() / rotor.loads.abs().max()
    assert error["flap"] < 0.01
