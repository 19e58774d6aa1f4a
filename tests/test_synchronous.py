"""Period by period: the linear time-periodic system comes back, in closed form."""

import numpy as np
import pandas as pd
import pytest
from periodic_cases import (
    coupled,
    deflection_only,
    mathieu,
    of_exponents,
    record,
    same_exponents,
    synchronous,
)

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems import LTPSystem

KEPT = {"w": [0], "phi_dot": [1]}


def wing_error(pipe, data):
    """Relative error of the heave matrix in percent."""
    exact = data.A_exact.to_numpy()
    return 100 * np.linalg.norm(pipe["match"].system_.A - exact) / np.linalg.norm(exact)


def fit_wing(data, **options):
    pipe = synchronous(data.omega, harmonics=KEPT, **options)
    return pipe.fit(data.inputs, data.outputs)


# ---- the flapping wing -------------------------------------------------------------------------

WING = {
    "edges between periods": ({}, 1e-4),
    "edges within a period": ({"offset": 0.77}, 2e-4),
    "edges near the end of a period": ({"offset": 0.203}, 2e-4),
    "3211": ({"input": "3211", "width": 2.37}, 2e-4),
    "multisine": ({"input": "multisine"}, 2e-4),
}


@pytest.mark.parametrize("case", WING)
def test_the_flapping_wing_comes_back_from_any_input(case):
    options, limit = WING[case]
    data = make_flapping_wing("ltp", n_periods=60, **({"start": 5} | options), random_state=3)
    pipe = fit_wing(data)
    assert pipe["identify"].order_ == 2
    assert wing_error(pipe, data) <= limit
    same_exponents(pipe["match"].ltp_.floquet_exponents(), data.ltp)
    assert pipe.score(data.inputs, data.outputs) > 1 - 1e-8


def random_changes(n_periods, amplitude=8.4e-5):
    rng = np.random.default_rng(0)
    du = amplitude * rng.choice([-1, 1], size=n_periods * 64)
    return make_flapping_wing("ltp", n_periods=n_periods, start=0, width=1, input=du)


def test_an_input_that_changes_at_every_sample():
    data = random_changes(140)
    pipe = fit_wing(data)
    assert pipe["identify"].order_ == 2
    assert wing_error(pipe, data) <= 2e-4


@pytest.mark.parametrize("n_periods", [60, 120])
def test_too_few_periods_for_such_an_input_are_said(n_periods):
    message = (
        rf"move in {min(64, n_periods)} directions within the period, of which {n_periods} periods "
        rf"tell \d+ apart .* \d+ consecutive periods would do; use a longer record"
    )
    with pytest.raises(ValueError, match=message):
        fit_wing(random_changes(n_periods))


@pytest.mark.parametrize(("amplitude", "limit"), [(0.02, 1.2), (0.005, 0.3)])
def test_the_nonlinear_wing(amplitude, limit):
    data = make_flapping_wing("nltp", n_periods=60, start=5, amplitude=amplitude)
    pipe = fit_wing(data, analyzer={"trim_span": data.trim_span})
    assert pipe["identify"].order_ == 2
    assert wing_error(pipe, data) <= limit


def test_more_harmonics_than_were_measured(ltp):
    """The decomposition with N = 5 from outputs analysed with N ≤ 1."""
    found = fit_wing(ltp)["match"].ltp_.harmonic_decomposition(5)
    exact = ltp.ltp.harmonic_decomposition(5)
    assert np.linalg.norm(found.A - exact.A) <= 2e-5 * np.linalg.norm(exact.A)
    assert list(found.state_labels) == list(exact.state_labels)


# ---- other systems -----------------------------------------------------------------------------

SYSTEMS = {
    "Mathieu": mathieu(),
    "Mathieu, negative multipliers": mathieu(1.0, 0.3, 0.2),
    "defective": of_exponents([[-0.3, 1.0], [0.0, -0.3]]),
    "repeated": of_exponents(-0.3 * np.eye(2), np.eye(2)),
    "near": of_exponents([[-0.3, 0.0], [0.0, -0.3001]]),
    "complex": of_exponents([[-0.1, 0.3], [-0.3, -0.1]]),
    "two inputs, four states": coupled(),
    "more outputs than states": mathieu(P=[[1, 0], [0, 1], [1, 1]], output_names=["y", "v", "s"]),
}
SLACK = {"defective": 1e-5}  # the square root of rounding splits a double exponent


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_system_comes_back(name):
    """F and G as functions of ψ, Floquet exponents, prediction."""
    system = SYSTEMS[name]
    u, y = record(system)
    pipe = synchronous(system.omega).fit(u, y)
    found, psi = pipe["match"].ltp_, np.linspace(0, 2 * np.pi, 17)
    n = system.n_states
    assert pipe["identify"].order_ == n
    same_exponents(found.floquet_exponents(), system, SLACK.get(name, 1e-6))
    T = system.P(psi)[:, :n]  # the first outputs are the states
    np.testing.assert_allclose(T, np.broadcast_to(np.eye(n), T.shape), atol=1e-15)
    scale = np.abs(system.F(psi)).max()
    np.testing.assert_allclose(found.F(psi), system.F(psi), atol=1e-5 * scale)
    np.testing.assert_allclose(found.G(psi), system.G(psi), atol=1e-5)
    np.testing.assert_allclose(found.P(psi), system.P(psi), atol=1e-5)
    assert pipe.score(u, y) > 1 - 1e-8
    np.testing.assert_allclose(pipe.predict(u), y, atol=1e-5 * y.abs().max().max())


FEWER_OUTPUTS = {
    "complex pair": deflection_only(),
    "negative multipliers": deflection_only(stiffness=1.0, excitation=0.3, damping=0.2),
    "two of four": coupled(P=[[1.0, 0, 0, 0], [0, 0, 1, 0]], output_names=["y1", "y2"]),
}


@pytest.mark.parametrize("name", FEWER_OUTPUTS)
def test_fewer_outputs_than_states_give_floquet_coordinates(name):
    system = FEWER_OUTPUTS[name]
    u, y = record(system, n_periods=120, n_changes=20)
    pipe = synchronous(system.omega)
    with pytest.warns(IdentifiabilityWarning, match=r"in Floquet coordinates, .* measure more outputs"):
        pipe.fit(u, y)
    found = pipe["match"].ltp_
    assert found.state_names == tuple(f"z{i + 1}" for i in range(system.n_states))
    same_exponents(found.floquet_exponents(), system)
    assert pipe.score(u, y) > 1 - 1e-8
    fresh, truth = record(system, seed=9)
    np.testing.assert_allclose(pipe.predict(fresh), truth, atol=1e-5 * truth.abs().max().max())


def test_periodic_input_matrix_and_feedthrough_of_given_harmonics():
    G = np.array([[[0.0], [1.0]], [[0.2], [-0.4]], [[0.1], [0.3]]])
    Q = np.array([[[0.3], [0.0]], [[0.0], [0.2]], [[-0.1], [0.0]]])
    system = LTPSystem(mathieu().F, G, Q=Q, omega=2.0, state_names=["y", "v"])
    u, y = record(system)
    found = synchronous(2.0, HarmonicStructure(G=1, Q=1)).fit(u, y)["match"].ltp_
    np.testing.assert_allclose(found.G.coefficients, G, atol=1e-6)
    np.testing.assert_allclose(found.Q.coefficients, Q, atol=1e-6)


def test_harmonics_of_the_inputs_that_the_record_does_not_tell_apart_are_named():
    """Two changes of the input within whole periods say little of G and Q together."""
    system = mathieu()
    values = np.zeros((60 * 32, 1))
    values[83:1089] = 1.0
    u, y = record(system, u=values)
    pipe = synchronous(2.0, HarmonicStructure(G=1, Q=1))
    with pytest.warns(IdentifiabilityWarning, match=r"does not determine G\[y,u1\]_0, .* more phases"):
        pipe.fit(u, y)
    assert pipe.score(u, y) > 1 - 1e-10
    assert synchronous(2.0).fit(u, y)["match"].periodic_.highest("G") == 0
