"""Period by period: the linear time-periodic system comes back, in closed form."""

from types import SimpleNamespace

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
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MatrixStructure, MOESPRegressor
from sklearn_hd._match.input_problem import InputProblem
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import (
    CoordinatesWarning,
    ExcitationWarning,
    IdentifiabilityWarning,
    InstabilityWarning,
)
from sklearn_hd.systems import LTPSystem, flapping_blade

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
@pytest.mark.slow
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


@pytest.mark.slow
def test_an_input_that_changes_at_every_sample():
    data = random_changes(140)
    pipe = fit_wing(data)
    assert pipe["identify"].order_ == 2
    assert wing_error(pipe, data) <= 2e-4


@pytest.mark.parametrize("n_periods", [60, 120])
def test_too_few_periods_for_such_an_input_are_said(n_periods):
    message = (
        rf"move in {min(64, n_periods)} directions within the period, and {n_periods} periods "
        rf"can separate \d+ .* \d+ consecutive periods would be enough; use a longer record"
    )
    with pytest.raises(ValueError, match=message):
        fit_wing(random_changes(n_periods))


@pytest.mark.slow
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
    "rotor blade": flapping_blade(mu=0.5),
    "more outputs than states": mathieu(P=[[1, 0], [0, 1], [1, 1]], output_names=["y", "v", "s"]),
}
SLACK = {"defective": 1e-5}  # the square root of rounding splits a double exponent


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.slow
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
    with pytest.warns(CoordinatesWarning, match=r"in Floquet coordinates, .* measure more outputs"):
        pipe.fit(u, y)
    found = pipe["match"].ltp_
    assert found.state_names == tuple(f"z{i + 1}" for i in range(system.n_states))
    same_exponents(found.floquet_exponents(), system)
    sizes = np.mean(np.sum(found.P(np.linspace(0.0, 2.0 * np.pi, 40)[1:]) ** 2, axis=1), axis=0)
    n_modes = {"complex pair": 1, "negative multipliers": 2, "two of four": 3}[name]
    assert np.sum(sizes) == pytest.approx(n_modes, rel=1e-6)  # each of size one
    assert pipe.score(u, y) > 1 - 1e-8
    fresh, truth = record(system, seed=9)
    np.testing.assert_allclose(pipe.predict(fresh), truth, atol=1e-5 * truth.abs().max().max())


@pytest.mark.parametrize("mean", [[[0.3], [0.0]], [[0.0], [0.0]]])
@pytest.mark.parametrize("structure", [HarmonicStructure(G=1, Q=1), HarmonicStructure(), None])
@pytest.mark.slow
def test_a_periodic_input_matrix_and_a_feedthrough(structure, mean):
    G = np.array([[[0.0], [1.0]], [[0.2], [-0.4]], [[0.1], [0.3]]])
    Q = np.array([mean, [[0.0], [0.2]], [[-0.1], [0.0]]])
    system = LTPSystem(mathieu().F, G, Q=Q, omega=2.0, state_names=["y", "v"])
    u, y = record(system)
    pipe = synchronous(2.0, structure)
    if structure is None or structure.n_harmonics("Q") is None:
        with pytest.warns(IdentifiabilityWarning, match=r"so it has a Q of 1 harmonic\(s\)"):
            pipe.fit(u, y)
    else:
        pipe.fit(u, y)
    found = pipe["match"].ltp_
    np.testing.assert_allclose(found.G.coefficients, G, atol=1e-6)
    np.testing.assert_allclose(found.Q.coefficients, Q, atol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_feedthrough_of_little_of_the_motion_is_found(noise):
    """It has 0.3 % of the variance, so nothing but other inputs would show that it is missing."""
    system = LTPSystem(mathieu().F, mathieu().G, Q=[[0.0], [0.05]], omega=2.0)
    u, y = record(system)
    y = y + noise * y.to_numpy().std(axis=0) * np.random.default_rng(0).standard_normal(y.shape)
    pipe = synchronous(2.0)
    with pytest.warns(IdentifiabilityWarning, match=r"leaves 0.00.* so it has a Q of 0 harmonic"):
        pipe.fit(u, y)
    np.testing.assert_allclose(pipe["match"].ltp_.Q.coefficients[0], system.Q(0.0), atol=0.01)


def test_harmonics_of_the_inputs_that_the_record_does_not_tell_apart_are_named():
    """Two changes of the input within whole periods say little of G and Q together."""
    system = mathieu()
    values = np.zeros((60 * 32, 1))
    values[83:1089] = 1.0
    u, y = record(system, u=values)
    pipe = synchronous(2.0, HarmonicStructure(G=1, Q=1))
    with pytest.warns(
        IdentifiabilityWarning, match=r"does not determine G\[y,u1\]_0, .* more phases"
    ):
        pipe.fit(u, y)
    assert pipe.score(u, y) > 1 - 1e-10
    assert synchronous(2.0).fit(u, y)["match"].ltp_.G.n_harmonics == 0


# ---- records, origins, containers --------------------------------------------------------------

PSI = np.linspace(0.0, 2 * np.pi, 17)


def comes_back(pipe, system, atol=1e-10):
    np.testing.assert_allclose(pipe["match"].ltp_.F(PSI), system.F(PSI), atol=atol)
    np.testing.assert_allclose(pipe["match"].ltp_.G(PSI), system.G(PSI), atol=atol)


def several(system, shifts=(0, 5, 17), n_periods=25, **options):
    records = [
        record(system, n_periods=n_periods, seed=i, shift=shift, **options)
        for i, shift in enumerate(shifts)
    ]
    names = {"names": ["record"]}
    return tuple(pd.concat(dict(enumerate(parts)), **names) for parts in zip(*records, strict=True))


def test_several_records_that_begin_at_any_phase():
    system = mathieu()
    u, y = several(system)
    pipe = synchronous(2.0).fit(u, y)
    comes_back(pipe, system)
    assert pipe.score(u, y) > 1 - 1e-12
    pd.testing.assert_frame_equal(pipe.predict(u), y, rtol=0, atol=1e-10, check_freq=False)


def test_a_record_too_short_to_count_does_no_harm():
    system = mathieu()
    (u, y), (short_u, short_y) = several(system), record(system, n_periods=2, shift=3, seed=5)
    u, y = pd.concat({"a": u.loc[0], "b": short_u}), pd.concat({"a": y.loc[0], "b": short_y})
    comes_back(synchronous(2.0).fit(u, y), system)


def test_gaps_of_any_length():
    system = mathieu()
    u, y = record(system, n_periods=90)
    kept = np.ones(len(u), dtype=bool)
    kept[700:733] = kept[1500:1600] = False
    pipe = synchronous(2.0).fit(u[kept], y[kept])
    comes_back(pipe, system)
    assert pipe.score(u[kept], y[kept]) > 1 - 1e-12


def test_azimuth_is_counted_from_time_zero_and_states_from_any_phase():
    system = mathieu()
    u, y = record(system, shift=11)
    pipe = synchronous(2.0).fit(u, y)
    comes_back(pipe, system)
    x0 = [0.3, -0.2]
    moved = system.simulate(u.to_numpy(), u.index.to_numpy(), x0=x0)
    frame = pipe["harmonics"].transform(u)
    np.testing.assert_allclose(pipe["match"].predict(frame, x0=x0), moved, atol=1e-12)
    rest = slice(205, None)  # in mid-period, its initial state unknown
    assert pipe.score(u.iloc[rest], pd.DataFrame(moved[rest], u.index[rest], y.columns)) > 1 - 1e-12


def test_outputs_that_are_decomposed_already():
    system = mathieu()
    u, y = record(system)
    harmonics = HarmonicAnalyzer(2.0, input_harmonics=1, reading="period").fit_transform(y)
    pipe = synchronous(2.0).fit(u, harmonics)
    comes_back(pipe, system)
    assert list(pipe.predict(u).columns) == ["y_0", "y_1c", "y_1s", "v_0", "v_1c", "v_1s"]


@pytest.mark.slow
def test_harmonics_of_the_inputs_that_are_kept():
    """They are the inputs of system_; the periodic model is the same."""
    system = mathieu()
    u, y = record(system)
    match = synchronous(2.0, analyzer={"input_harmonics": 1}).fit(u, y)["match"]
    exact = system.harmonic_decomposition(1)
    assert match.system_.input_labels == ["u1_0", "u1_1c", "u1_1s"]
    places = [list(exact.state_labels).index(name) for name in match.system_.state_labels]
    np.testing.assert_allclose(match.system_.A, exact.A[np.ix_(places, places)], atol=1e-10)
    np.testing.assert_allclose(match.system_.B, exact.B[places], atol=1e-10)


def test_an_input_without_a_mean_over_any_period():
    system = mathieu()
    values = np.zeros((60 * 32, 1))
    for k in range(5, 15):
        values[32 * k : 32 * k + 16], values[32 * k + 16 : 32 * k + 32] = 1.0, -1.0
    u, y = record(system, u=values)
    pipe = synchronous(2.0)
    with pytest.warns(ExcitationWarning, match="fits the effect of inputs within the period"):
        pipe.fit(u, y)
    comes_back(pipe, system)


@pytest.mark.slow
def test_units_of_the_outputs_scale_the_states():
    system, units = mathieu(), np.array([1e6, 1e-3])
    u, y = record(system)
    one = synchronous(2.0).fit(u, y)["match"].ltp_
    other = synchronous(2.0).fit(u, y * units)["match"].ltp_
    back = other.F.coefficients[:3] / units[:, None] * units
    np.testing.assert_allclose(back, one.F.coefficients[:3], atol=1e-10)
    np.testing.assert_allclose(other.G(PSI) / units[:, None], one.G(PSI), rtol=1e-6, atol=1e-12)


@pytest.mark.slow
def test_a_growing_record():
    """An unstable orbit: multipliers of 1.065, 40 times the size at the end."""
    system = mathieu(damping=-0.02)
    u, y = record(system)
    with pytest.warns(InstabilityWarning, match=r"unstable: a Floquet exponent .* 0\.02 1/s"):
        pipe = synchronous(2.0).fit(u, y)
    comes_back(pipe, system, atol=1e-8)
    assert pipe.score(u, y) > 1 - 1e-10


# ---- structures ----------------------------------------------------------------------------------


def test_a_structure_of_known_and_shared_entries():
    """ÿ + d ẏ + (a − q cos ψ) y = u: three numbers."""
    system = mathieu()
    u, y = record(system)
    structure = HarmonicStructure(
        F={"0": [[0, 1], ["-a", "-d"]], "1c": [[0, 0], ["q", 0]]}, G={"0": [[0], [1]]}
    )
    theta = synchronous(2.0, structure).fit(u, y)["match"].theta_
    assert theta.round(9).to_dict() == {"a": 2.0, "d": 0.2, "q": 1.0}


def test_states_are_the_outputs_named():
    u, y = record(mathieu())
    found = synchronous(2.0, HarmonicStructure(states=["v", "y"])).fit(u, y)["match"].ltp_
    assert found.state_names == ("v", "y")
    np.testing.assert_allclose(found.F.coefficients[0], [[-0.2, -2.0], [1.0, 0.0]], atol=1e-10)


def test_any_outputs_that_determine_the_state_may_be_it():
    system = mathieu(P=[[1, 0], [1, 0], [1, 1]], output_names=["y", "twin", "sum"])
    u, y = record(system)
    found = synchronous(2.0).fit(u, y)["match"].ltp_
    assert found.state_names == ("y", "sum")
    np.testing.assert_allclose(found.P(PSI)[0], [[1, 0], [1, 0], [0, 1]], atol=1e-10)


@pytest.mark.slow
def test_no_structure_is_every_coefficient_free():
    system = mathieu()
    u, y = record(system)
    pipe = synchronous(2.0)
    free = pipe.fit(u, y)["match"].theta_
    pd.testing.assert_series_equal(
        pipe.set_params(match__structure=None).fit(u, y)[-1].theta_, free
    )


def test_a_matrix_structure_goes_through_the_closed_form():
    data = make_flapping_wing("ltp", n_periods=60, start=5)
    names = list(data.A_exact.columns)
    structure = MatrixStructure(
        pd.DataFrame(np.nan, names, names), pd.DataFrame(np.nan, names, ["U_0"])
    )
    match = fit_wing(data, structure=structure)["match"]
    exact = data.A_exact.to_numpy()
    assert np.linalg.norm(match.system_.A - exact) <= 1e-6 * np.linalg.norm(exact)
    with pytest.raises(AttributeError, match="ltp_ exists only for a HarmonicStructure"):
        _ = match.ltp_


# ---- noise ---------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.parametrize("noise", [0.05, 0.2])
@pytest.mark.parametrize("system", [mathieu(), deflection_only(), coupled()])
@pytest.mark.slow
def test_the_order_under_noise(system, noise):
    u, y = record(system, noise=noise, n_periods=100, n_changes=8)
    pipe = synchronous(system.omega)[:2]
    assert pipe.fit(u, y)["identify"].order_ == system.n_states


@pytest.mark.slow
def test_the_order_of_the_wing_under_noise():
    for seed in range(5):
        data = make_flapping_wing("ltp", n_periods=60, start=5, snr=20, random_state=seed)
        pipe = synchronous(data.omega, harmonics=KEPT)[:2].fit(data.inputs, data.outputs)
        assert pipe["identify"].order_ == 2


@pytest.mark.parametrize("n", range(1, 7))
def test_the_order_without_noise(n):
    rng = np.random.default_rng(n)
    F = 0.1 * rng.standard_normal((3, n, n))
    F[0] = np.triu(F[0], 1) - np.diag(np.linspace(0.2, 0.7, n))
    system = LTPSystem(F, rng.standard_normal((n, 1)), omega=2.0)
    u, y = record(system, seed=n)
    assert synchronous(2.0)[:2].fit(u, y)["identify"].order_ == n


@pytest.mark.slow
def test_maximum_likelihood_without_noise():
    system = mathieu()
    u, y = record(system)
    pipe = synchronous(2.0, criterion="output_error").fit(u, y)
    comes_back(pipe, system)
    match = pipe["match"]
    assert match.theta_std_.max() < 1e-12
    assert match.noise_std_.max() < 1e-12


@pytest.mark.slow
def test_maximum_likelihood_of_the_noisy_wing():
    """Harmonics chosen by the data; noise and deviations are those of the truth."""
    data = make_flapping_wing("ltp", n_periods=60, start=5, snr=20, random_state=1)
    pipe = fit_wing(data, criterion="output_error")
    match = pipe["match"]
    assert wing_error(pipe, data) < 2.5
    assert match.ltp_.F.n_harmonics <= 8
    assert match.ltp_.G.n_harmonics <= 4
    assert np.isfinite(match.theta_std_).all()
    assert (match.theta_std_ > 0).all()
    noise = (data.outputs - data.outputs_clean).std()
    np.testing.assert_allclose(match.noise_std_, noise, rtol=0.05)


@pytest.mark.slow
def test_maximum_likelihood_beats_the_closed_form():
    """The bound is 1 % for four harmonics; closed forms have 1 to 7 %."""
    errors = []
    for seed in range(5):
        data = make_flapping_wing("ltp", n_periods=60, start=5, snr=20, random_state=seed)
        pipes = fit_wing(data), fit_wing(data, criterion="output_error")
        errors.append([wing_error(pipe, data) for pipe in pipes])
    closed, refined = np.median(errors, axis=0)
    assert refined < 2.0
    assert refined < closed


def test_several_noisy_records():
    system = mathieu()
    u, y = several(system, noise=0.05)
    structure = HarmonicStructure(F=1, G=0)
    match = synchronous(2.0, structure, criterion="output_error").fit(u, y)["match"]
    z = (match.theta_ - true_parameters(system, match)) / match.theta_std_
    assert np.abs(z).max() < 4.5


def true_parameters(system, match):
    """θ of the exact system, by the names of its entries."""
    values = {}
    for name, M in (("F", system.F), ("G", system.G)):
        rows = system.state_names
        columns = rows if name == "F" else system.input_names
        for place, label in enumerate(["0", "1c", "1s"][: len(M.coefficients)]):
            for i, row in enumerate(rows):
                for j, column in enumerate(columns):
                    values[f"{name}[{row},{column}]_{label}"] = M.coefficients[place, i, j]
    return np.array([values[name] for name in match.theta_.index])


def test_what_maximum_likelihood_says_of_itself():
    system = mathieu()
    u, y = record(system, noise=0.05)
    match = synchronous(2.0, HarmonicStructure(F=1, G=0), criterion="output_error").fit(u, y)[-1]
    interval = match.confidence_interval(0.9)
    np.testing.assert_allclose(interval.mean(axis=1), match.theta_, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        interval["upper"] - interval["lower"], 2 * 1.6448536 * match.theta_std_, rtol=1e-6
    )
    covariance = match.covariance_
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), match.theta_std_, rtol=1e-9)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > 0
    found = match.eigenvalues_
    same_exponents(found["eigenvalue"].to_numpy(), system, rtol=0.02)
    frequencies = [0.1, 0.5, 1.0]
    response, std = match.frequency_response(frequencies)
    exact = np.moveaxis(match.system_(1j * np.array(frequencies)), -1, 0)
    np.testing.assert_allclose(response, exact, rtol=1e-9, atol=1e-12)
    assert response.shape == std.shape == (3, 6, 1)
    assert np.isfinite(std).all()


@pytest.mark.parametrize(
    "system",
    [
        deflection_only(),
        deflection_only(stiffness=1.0, excitation=0.3, damping=0.2),  # negative multipliers
        of_exponents(np.diag([-0.03, -0.2]), P=[[1.0, -1.0]], output_names=["y"]),
    ],
)
@pytest.mark.slow
def test_floquet_coordinates_have_finite_deviations(system):
    """Once the scale of each mode is held, which no output tells."""
    u, y = record(system, noise=0.005, n_changes=8, n_periods=80)
    pipe = synchronous(system.omega, HarmonicStructure(G=2), order=2, criterion="output_error")
    with pytest.warns(CoordinatesWarning, match="Floquet coordinates"):
        match = pipe.fit(u, y)["match"]
    assert np.isfinite(match.theta_std_).all()
    assert np.isfinite(match.eigenvalues_["std_real"]).all()
    same_exponents(match.eigenvalues_["eigenvalue"].to_numpy(), system, rtol=0.05)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_intervals_hold_the_truth_as_often_as_they_say():
    system, inside, errors = mathieu(), [], []
    structure = HarmonicStructure(F=1, G=0)
    for seed in range(60):
        u, y = record(system, noise=0.05, seed=seed, n_periods=40, samples=16)
        match = synchronous(2.0, structure, order=2, criterion="output_error").fit(u, y)["match"]
        interval, true = match.confidence_interval(), true_parameters(system, match)
        inside.append((interval["lower"] < true) & (true < interval["upper"]))
        errors.append((match.theta_ - true) / match.theta_std_)
    assert 0.92 < np.mean(inside) < 0.98
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.1)


def test_rows_that_repeat_the_last_count_once():
    rows = np.repeat(np.random.default_rng(0).standard_normal((400, 1)), 5, axis=0)
    left = SimpleNamespace(beyond=rows, total=np.sum(rows**2), scale=[1.0], n_told=0)
    assert 350 < InputProblem._n_independent(left) < 450


# ---- trim that is known badly ----------------------------------------------------------------


def test_what_the_trim_is_off_by_is_no_state():
    """The span holds the end of a decay: its mean waveform is off alike in every period."""
    data = make_flapping_wing("ltp", n_periods=60, start=5)
    period = 2 * np.pi / data.omega
    analyzer = {
        "trim_span": (50 * period, 55 * period),
        "output_harmonics": KEPT,
        "reading": "period",
    }
    pipe = Pipeline([("a", HarmonicAnalyzer(data.omega, **analyzer)), ("i", MOESPRegressor())])
    found = pipe.fit(data.inputs, data.outputs)["i"]
    assert found.order_ == 2
    same_exponents(np.log(found.eigenvalues_) / period, data.ltp, rtol=1e-8)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.parametrize("samples", [19, 24])
def test_an_output_that_follows_a_state_keeps_the_exponent_of_the_map(samples):
    """A pump that goes in steps: the shape of the fast output has more harmonics than samples."""

    def F(psi):
        pump = np.where(np.mod(psi, 2 * np.pi) < 2.4, 5.0, 0.4)
        F = np.zeros((len(psi), 2, 2))
        F[:, 0, 0], F[:, 0, 1] = -2.0 - pump, pump
        F[:, 1, 0], F[:, 1, 1] = pump / 8, -(pump + 0.4) / 8
        return F

    system = LTPSystem(F, [[0.0], [1.0]], omega=1.0, state_names=["collector", "tank"])
    X, y = record(system, samples=samples, noise=0.01)
    pipe = synchronous(1.0).fit(X, y)
    exponent = pipe["identify"].model_.exponents()
    true = system.floquet_exponents()[:1]
    np.testing.assert_allclose(exponent, true, rtol=0.02)
    np.testing.assert_allclose(pipe["match"].ltp_.floquet_exponents(), exponent, rtol=1e-3)
    assert pipe.score(X, y) > 0.99


def test_rounding_of_inputs_does_not_move_what_is_identified():
    """Changes in mid-period give many directions, each in few periods: most are idle in most."""
    X, y = record(mathieu(), noise=0.01, seed=3, n_changes=12)
    values = [
        synchronous(2.0)[:2].fit(X * (1 + k * 1.1e-15), y)["identify"].singular_values_
        for k in range(4)
    ]
    np.testing.assert_allclose(values, np.tile(values[0], (4, 1)), rtol=1e-6)
