"""From samples at their azimuths to models in continuous time: ltp_, the reducer, the matcher."""

import pickle

import numpy as np
import pandas as pd
import pytest
from periodic_cases import coupled, deflection_only, mathieu, same_exponents
from sklearn.pipeline import Pipeline, make_pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._match import affine
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics
from sklearn_hd.exceptions import CoordinatesWarning, IdentifiabilityWarning, InstabilityWarning
from sklearn_hd.systems import LTPSystem

OSCILLATOR = MatrixStructure([[0, 1], ["-k", "-d"]], [[0], ["b"]])
SWINGING = HarmonicStructure(
    F={"0": [[0, 1], ["-k", "-d"]], "1c": [[0, 0], ["e", 0]]}, G={"0": [[0], ["b"]]}
)


def loads(psi):
    """A forced response that stands on the outputs beside what inputs do."""
    return 1.0 + 2.0 * np.cos(psi) - np.sin(3.0 * psi)


def record(system, samples=16.216, turns=200, noise=0.01, seed=0):
    """An input that always moves, loads at every turn, and noise, as frames."""
    rng, n = np.random.default_rng(seed), int(turns * samples)
    t = np.arange(n) * system.period / samples
    u = np.repeat(rng.choice([-1.0, 0.0, 1.0], (n // 3 + 1, system.n_inputs)), 3, axis=0)[:n]
    y = system.simulate(u, t)
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    y = y + loads(system.omega * t)[:, None]
    index = pd.Index(t, name="time")
    return (
        pd.DataFrame(u, index, list(system.input_names)),
        pd.DataFrame(y, index, list(system.output_names)),
    )


def pipeline(omega, *, order="auto", harmonics=None, reduce=None, **match):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, reading="sample", output_harmonics=harmonics)),
            ("identify", MOESPRegressor(order=order)),
            ("reduce", reduce or SpuriousModeReducer()),
            ("match", StructuredMatcher(**match)),
        ]
    )


@pytest.fixture(scope="module")
def measured():
    return record(mathieu())


@pytest.fixture(scope="module")
def identified(measured):
    """The frame that the reducer reads."""
    u, y = measured
    return pipeline(2.0)[:2].fit_transform(u, y)


@pytest.fixture(scope="module")
def fitted(measured):
    return pipeline(2.0).fit(*measured)


def apart(found, wanted):
    """Difference in parts of what moves."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    return np.linalg.norm(found - wanted) / np.linalg.norm(wanted - wanted.mean(axis=0))


# ---- the state from which predictions begin ------------------------------------------------------


@pytest.mark.parametrize("mean", [0.0, 0.05])
@pytest.mark.slow
def test_predictions_begin_on_the_forced_motion(mean):
    """With a mode that lasts 300 turns; the record's mean is 1.6 standard deviations away."""
    F = np.zeros((3, 2, 2))
    F[0], F[1, 0, 1] = [[-0.001, 1.0], [0.0, -0.5]], 0.5
    slow = LTPSystem(F, [[0.0], [1.0]], omega=2.0, state_names=["q", "v"])
    u, _ = record(slow)
    t = u.index.to_numpy()
    y = slow.simulate(u.to_numpy() + mean, t)
    y = y + 0.01 * y.std(axis=0) * np.random.default_rng(1).standard_normal(y.shape)
    u, y = u + mean, pd.DataFrame(y + loads(2.0 * t)[:, None], u.index, ["q", "v"])
    pipe = pipeline(2.0).fit(u, y)
    for steps in (pipe[:2], pipe):
        assert apart(steps.predict(u), y) < 0.03


def kinked():
    """Damping by the speed of a flap, |cos ψ|: no number of harmonics is enough."""
    psi, F = 2.0 * np.pi * np.arange(64) / 64, np.zeros((64, 2, 2))
    F[:] = [[-0.2, 1.0], [-1.0, -0.3]]
    F[:, 1, 1] -= 4.0 * np.abs(np.cos(psi))
    F[:, 0, 1] += np.cos(psi)
    F = sampled_harmonics(F, 16)
    return LTPSystem(F, [[0.0], [1.0]], omega=2.0, state_names=["q", "v"])


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_inputs_as_measured_match_as_those_about_their_trim():
    """The response to a trim of 1000 times the motion is none of the match's."""
    u, y = record(kinked(), samples=16, turns=80, noise=1e-4)
    about, measured = (
        pipeline(2.0, order=2, structure=HarmonicStructure()).fit(u + mean, y)
        for mean in (0.0, 1e3)
    )
    assert measured[-1].ltp_.state_names == ("q", "v")  # F of as few harmonics as the samples
    same_exponents(measured[-1].ltp_.floquet_exponents(), about[-1].ltp_, 1e-6)
    assert measured.score(u + 1e3, y) == pytest.approx(about.score(u, y), abs=1e-6)
    assert measured.score(u + 1e3, y) > about[:2].score(u, y) - 1e-4


@pytest.mark.slow
def test_how_a_record_was_measured_does_not_matter():
    """Trims and loads of 30 to 1000 times the motion, units, the clock, the order of outputs."""
    u, y = record(kinked(), samples=16, turns=80)
    psi, later = 2.0 * u.index.to_numpy(), u.index + 1e4 * np.pi
    wave = 30.0 * (np.cos(psi) - 2.0 * np.sin(psi))[:, None]
    records = {
        "as simulated": (u, y),
        "a trim of the inputs": (u + 1e3, y),
        "a trim that is a wave": (u + wave, y),
        "loads": (u, y + wave),
        "units": (1e6 * u, y * [1e-5, 1e5]),
        "the clock": (u.set_axis(later), y.set_axis(later)),
        "the order": (u, y[["v", "q"]]),
    }
    found = {}
    for name, (inputs, outputs) in records.items():
        steps = HarmonicAnalyzer(2.0), MOESPRegressor(), SpuriousModeReducer()
        pipe = make_pipeline(*steps, StructuredMatcher(structure=HarmonicStructure()))
        exponents = pipe.fit(inputs, outputs)[-1].ltp_.floquet_exponents()
        found[name] = *exponents, pipe.score(inputs, outputs)
    expected = np.tile(found["as simulated"], (len(found), 1))
    np.testing.assert_allclose(list(found.values()), expected, rtol=1e-7)


def test_counting_states_from_the_forced_motion_changes_nothing_else():
    rng = np.random.default_rng(2)
    coefficients = 0.03 * rng.standard_normal((5, 4, 4))
    coefficients[0, :2, :2] += np.diag([0.8, 0.5])
    gain = 0.1 * rng.standard_normal((3, 2, 2))
    model = PeriodicInnovations(coefficients, gain, np.eye(2), 0.7, 0.2)
    moved, psi = model.about_orbit(), 0.2 + 0.7 * np.arange(200)
    u, zero = rng.standard_normal((200, 1)), np.zeros(2)
    gap = moved.rows(psi).simulated(u, zero) - model.rows(psi).simulated(u, zero)
    free = np.stack([each.ravel() for each in model.rows(psi).free()], axis=1)
    left = gap.ravel() - free @ np.linalg.lstsq(free, gap.ravel())[0]  # another state at ψ = 0.2
    assert np.max(np.abs(left)) < 1e-12
    forced = evaluate_harmonics(model.forced_response(20), psi)
    still = moved.rows(psi).simulated(0.0 * u, zero)
    np.testing.assert_allclose(still, forced, atol=1e-3)


# ---- ltp_ ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("samples", [16.0, 16.216, 7.3, 50.01])
@pytest.mark.parametrize("make", [mathieu, coupled, deflection_only])
@pytest.mark.slow
def test_ltp_has_the_exponents_of_the_model_and_of_the_machine(make, samples):
    system = make()
    pipe = pipeline(system.omega, order=system.n_states)[:2].fit(*record(system, samples))
    found = pipe["identify"].ltp_.floquet_exponents()
    model = pipe["identify"].model_.exponents()
    turn = system.period
    np.testing.assert_allclose(
        np.sort_complex(np.exp(found * turn)), np.sort_complex(np.exp(model * turn)), rtol=1e-9
    )
    same_exponents(found, system, rtol=0.02)


@pytest.mark.filterwarnings("ignore:what a simulation leaves goes with inputs")  # too few states
@pytest.mark.parametrize("seed", [1, 7, 13])
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_orders_of_no_periodic_system_are_passed_over(seed):
    """Of fast modes noise leaves multipliers of either sign; machines have even numbers below 0."""
    rng, n = np.random.default_rng(seed), 4
    F = 0.3 * rng.standard_normal((3, n, n))
    F[0] = rng.standard_normal((n, n))
    F[0] -= (0.2 + np.max(np.linalg.eigvals(F[0]).real)) * np.eye(n)
    system = LTPSystem(F, rng.standard_normal((n, 1)), rng.standard_normal((2, n)), omega=1.0)
    pipe = pipeline(1.0)[:2].fit(*record(system, 7.3, turns=200, seed=seed))
    negative = np.abs(pipe["identify"].model_.innovations.multiplier_logarithms().imag) > 3.141592
    assert negative.sum() % 2 == 0
    assert pipe["identify"].ltp_.n_states == pipe["identify"].order_


@pytest.mark.slow
def test_ltp_of_a_time_invariant_machine_is_time_invariant():
    system = mathieu(excitation=0.0)
    identify = pipeline(2.0)[:2].fit(*record(system))["identify"]
    assert identify.n_harmonics_ == 0
    F, _, _, _ = identify.ltp_.fourier_coefficients(1)
    assert np.max(np.abs(F[1:])) < 1e-12
    same_exponents(np.linalg.eigvals(F[0]), system, rtol=0.01)


# ---- the reducer ---------------------------------------------------------------------------------


def test_the_reducer_has_nothing_to_remove_and_says_so(fitted, measured):
    u, y = measured
    reducer = fitted["reduce"]
    assert set(reducer.modes_["verdict"]) == {"genuine"}
    assert set(reducer.modes_["reason"]) == {"identified from samples, without a window"}
    assert reducer.n_states_ == 2
    wanted = np.sort_complex(fitted["identify"].model_.exponents())
    found = np.sort_complex(reducer.modes_["eigenvalue"].to_numpy(complex))
    np.testing.assert_allclose(found, wanted)
    np.testing.assert_array_equal(fitted[:3].predict(u), fitted[:2].predict(u))
    assert fitted[:3].score(u, y) == fitted[:2].score(u, y)
    with pytest.raises(AttributeError, match=r"ltp_ of MOESPRegressor.*output_harmonics=0"):
        reducer.system_  # noqa: B018


def test_the_reducer_refuses_another_number_of_states(identified, measured):
    with pytest.raises(ValueError, match=r"n_states=3.*its 2 states; use MOESPRegressor\(order=3"):
        SpuriousModeReducer(n_states=3).fit(identified, measured[1])


def test_the_reducer_may_be_left_out(identified, fitted, measured):
    u, y = measured
    match = StructuredMatcher().fit(identified, y)
    np.testing.assert_array_equal(match.predict(identified), fitted.predict(u))


# ---- the matcher ---------------------------------------------------------------------------------


def test_without_a_structure_the_match_is_the_model_identified(fitted, measured):
    u, y = measured
    assert apart(fitted.predict(u), fitted[:2].predict(u)) < 1e-3
    assert fitted.score(u, y) == pytest.approx(fitted[:2].score(u, y), abs=1e-6)
    match = fitted["match"]
    assert match.ltp_.state_names == ("y", "v")
    assert match.system_.nstates == 2 * (2 * fitted["identify"].n_harmonics_ + 1)
    assert np.isnan(match.hinf_error_)
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.predict(u), fitted.predict(u))


@pytest.mark.parametrize("criterion", ["hinf", "least_squares"])
@pytest.mark.parametrize(
    "samples",
    [
        16.0,
        16.216,
        7.3,
        50.01,
    ],
)
@pytest.mark.slow
def test_entries_are_those_of_the_machine(samples, criterion):
    pipe = pipeline(2.0, order=2, structure=SWINGING, criterion=criterion)
    u, y = record(mathieu(), samples)
    found = pipe.fit(u, y)["match"].theta_
    truth = {"k": 2.0, "d": 0.2, "e": 1.0, "b": 1.0}
    assert found.to_dict() == pytest.approx(truth, rel=0.02)
    assert pipe.score(u, y) > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("samples", [16.0, 16.216, 7.3])
def test_coefficients_are_those_of_the_machine(samples):
    system = coupled()
    pipe = pipeline(3.0, order=4, structure=HarmonicStructure(F=2, G=0))
    pipe.fit(*record(system, samples, turns=400))
    found, truth = (s.fourier_coefficients(2) for s in (pipe["match"].ltp_, system))
    assert np.max(np.abs(found[0] - truth[0])) < 0.02 * np.max(np.abs(truth[0]))
    assert np.max(np.abs(found[1] - truth[1])) < 0.02


@pytest.mark.slow
def test_new_records_are_predicted_with_their_loads():
    """At another clock, from another azimuth, loads included."""
    u, y = record(mathieu())
    pipe = pipeline(2.0, structure=SWINGING).fit(u, y)
    new, _ = record(mathieu(), noise=0.0, seed=3, turns=40)
    truth = mathieu().simulate(new.to_numpy(), new.index.to_numpy())
    truth = truth + loads(2.0 * new.index.to_numpy())[:, None]
    assert apart(pipe.predict(new), truth) < 0.01
    later = slice(205, None)  # begins within a turn
    rest = pipe.predict(new * 0.0)
    np.testing.assert_allclose(pipe.predict(new.iloc[later] * 0.0), rest.iloc[later], atol=1e-9)


@pytest.mark.slow
def test_parameters_may_be_fixed_and_shared(measured):
    structure = SWINGING.fix({"d": 0.2})
    found = pipeline(2.0, structure=structure).fit(*measured)["match"].theta_
    assert "d" not in found.index
    assert found["k"] == pytest.approx(2.0, rel=0.01)
    states = HarmonicStructure(F=1, G=0, states=["v", "y"])
    ltp = pipeline(2.0, structure=states).fit(*measured)["match"].ltp_
    assert ltp.state_names == ("v", "y")
    assert ltp.fourier_coefficients(1)[0][1, 0, 1] == pytest.approx(1.0, rel=0.02)


@pytest.mark.slow
def test_states_of_unlike_size_and_noise_keep_their_exponents():
    """Nearness is that of predictions in parts of the innovations, not of entries."""
    system = mathieu()
    u, y = record(system, 16.0)
    y["v"] += 0.3 * y["v"].std() * np.random.default_rng(5).standard_normal(len(y))
    y["v"] *= 1e3
    pipe = pipeline(2.0, order=2, structure=HarmonicStructure(F=1, G=0)).fit(u, y)
    same_exponents(pipe["match"].ltp_.floquet_exponents(), system, rtol=0.02)


@pytest.mark.slow
def test_one_output_leads_to_floquet_coordinates():
    system = deflection_only()
    u, y = record(system)
    pipe = pipeline(2.0, order=2, structure=HarmonicStructure())
    with pytest.warns(CoordinatesWarning, match="Floquet coordinates"):
        pipe.fit(u, y)
    assert pipe["match"].ltp_.state_names == ("z1", "z2")
    same_exponents(pipe["match"].ltp_.floquet_exponents(), system, rtol=0.01)
    assert pipe.score(u, y) == pytest.approx(pipe[:2].score(u, y), abs=1e-5)
    with pytest.warns(CoordinatesWarning):
        pipe.fit(u, 1e4 * y)  # in other units
    shapes = pipe["match"].ltp_.P(np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False))
    assert np.mean(np.sum(shapes**2, axis=(1, 2))) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*(exponents are in doubt|the model lacks)")
def test_a_structure_that_cannot_respond_so_is_told(measured):
    rigid = HarmonicStructure(F={"0": [[0, 1], [-1.0, -0.2]]}, G={"0": [[0], ["b"]]})
    with pytest.warns(IdentifiabilityWarning, match=r"by 1\.\d times its variance.*structure=None"):
        pipeline(2.0, structure=rigid).fit(*measured)
    growing = HarmonicStructure(F={"0": [[0, 1], [-1.0, 0.4]]}, G={"0": [[0], ["b"]]})
    with pytest.warns(InstabilityWarning, match="identified model is stable"):
        pipeline(2.0, structure=growing).fit(*measured)


@pytest.mark.slow
def test_time_invariant_models_are_matched_in_continuous_time():
    system = mathieu(excitation=0.0)
    u, y = record(system)
    pipe = pipeline(2.0).fit(u, y)
    assert apart(pipe.predict(u), pipe[:2].predict(u)) < 1e-3
    assert pipe["match"].system_.isctime()
    same_exponents(pipe["match"].system_.poles(), system, rtol=0.01)
    with pytest.raises(AttributeError, match="only for a HarmonicStructure"):
        pipe["match"].ltp_  # noqa: B018
    pipe = pipeline(2.0, harmonics=0, structure=OSCILLATOR).fit(u, y)
    truth = {"k": 2.0, "d": 0.2, "b": 1.0}
    assert pipe["match"].theta_.to_dict() == pytest.approx(truth, rel=0.02)
    assert pipe["match"].hinf_error_relative_ < 0.01
    assert pipe.score(u, y) > 0.999
    pipe = pipeline(2.0, structure=HarmonicStructure()).fit(u, y)
    F, _, _, _ = pipe["match"].ltp_.fourier_coefficients(0)
    np.testing.assert_allclose(F[0], [[0.0, 1.0], [-2.0, -0.2]], atol=0.01)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"output_weights": 2.0}, "closed form, which uses no weights"),
        ({"input_noise": 0.1}, "needs maximum likelihood"),
        ({"structure": OSCILLATOR}, r"MatrixStructure is time-invariant.*output_harmonics=0"),
        ({"structure": HarmonicStructure(states=["y", "q"])}, "not among them"),
        (
            {"structure": HarmonicStructure(F={"0": np.full((3, 3), np.nan)})},
            r"3 states, but the identified model has 2.*order=3",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(identified, measured, settings, words):
    frame = SpuriousModeReducer().fit_transform(identified, measured[1])
    with pytest.raises(ValueError, match=words):
        StructuredMatcher(**settings).fit(frame, measured[1])


@pytest.mark.slow
def test_entries_of_states_that_nothing_measures_are_refused():
    with pytest.raises(ValueError, match="do not determine the 2 states for which the structure"):
        pipeline(2.0, order=2, structure=SWINGING).fit(*record(deflection_only()))


@pytest.mark.slow
def test_a_likelihood_names_as_many_harmonics_as_it_found(tmp_path):
    """One output does not determine two states: P(ψ) varies, with more harmonics than the start."""
    u, y = record(deflection_only(), 16.0, turns=60)
    with pytest.warns(CoordinatesWarning):
        match = pipeline(2.0, structure=HarmonicStructure(), criterion="output_error").fit(u, y)[-1]
    system = match.system_
    L = len(system.output_labels) // 2
    assert list(system.output_labels)[:3] == ["y_0", "y_1c", "y_1s"]
    assert system.C.shape[0] == 2 * L + 1 > 3
    match.export(tmp_path / "model.json")


@pytest.mark.slow
def test_a_feedthrough_that_data_show_is_kept():
    system = mathieu(P=np.eye(2), Q=[[0.0], [0.5]], output_names=["y", "a"])
    u, y = record(system, 16.0)
    asked = HarmonicStructure(F=1, G=0, Q=0, states=["y", "a"])
    for structure in (None, HarmonicStructure(), asked):
        pipe = pipeline(2.0, structure=structure).fit(u, y)
        Q = pipe["match"].ltp_.fourier_coefficients(0)[3]
        np.testing.assert_allclose(Q[0], [[0.0], [0.5]], atol=0.01)
        assert pipe.score(u, y) > 0.999
    refined = pipeline(2.0, structure=HarmonicStructure(), criterion="output_error").fit(u, y)
    assert abs(refined["match"].ltp_.fourier_coefficients(0)[3][0, 1, 0] - 0.5) < 0.01
    with pytest.warns(IdentifiabilityWarning, match="Q where there is a feedthrough"):
        pipeline(2.0, structure=HarmonicStructure(F=1, G=0, Q={"0": np.zeros((2, 1))})).fit(u, y)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_a_structure_left_open_leaves_no_more_than_the_model_identified(seed):
    """Two outputs that are nearly one: with few harmonics of F, states would be off by more."""
    F = [
        [[-0.198, -1.257], [3.62, -0.413]],
        [[0.253, -0.819], [0.062, 0.052]],
        [[-0.415, 0.004], [-0.658, 0.231]],
    ]
    G = [[[-1.348], [-1.387]], [[-0.027], [0.106]], [[-0.518], [-0.181]]]
    P = [[-0.002, -0.726], [0.104, 1.152]]
    twins = LTPSystem(F, G, P, omega=2.0, input_names=["u"], output_names=["a", "b"])
    u, y = record(twins, samples=16, seed=seed)
    pipe = pipeline(2.0, structure=HarmonicStructure()).fit(u, y)
    left, identified = 1.0 - pipe.score(u, y), 1.0 - pipe[:2].score(u, y)
    assert left < 2.0 * identified
    same_exponents(pipe["match"].ltp_.floquet_exponents(), twins, 0.02)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the outputs .* do not determine the 2 states")
@pytest.mark.filterwarnings("ignore:the matched model's response")  # 5.3 samples tell too little
def test_a_structure_that_asks_for_nothing_gets_the_harmonics_that_it_needs():
    u, y = record(mathieu(), 5.3, turns=150)
    with pytest.warns(IdentifiabilityWarning, match="the model's residuals are not noise"):
        free, own = (
            pipeline(2.0, order=2, structure=structure).fit(u, y)
            for structure in (None, HarmonicStructure())
        )
    np.testing.assert_allclose(own["match"].theta_, free["match"].theta_)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:[234] of 6 exponents are in doubt")
@pytest.mark.filterwarnings("ignore:the outputs .* do not determine the 6 states")
def test_states_of_noise_have_a_continuous_model_too():
    """Four of six states; shapes of size one keep their match as good as that of the others."""
    u, y = record(mathieu(), 9.1)
    pipe = pipeline(2.0, order=6).fit(u, y)
    assert pipe["match"].ltp_.n_states == 6
    assert apart(pipe.predict(u), pipe[:2].predict(u)) < 0.05


def test_predictions_stay_those_of_the_samples_where_no_continuous_model_has_them(monkeypatch):
    words = "the matched model's response is another", IdentifiabilityWarning
    monkeypatch.setattr(affine, "_unlike", lambda *arguments, **options: words)
    u, y = record(mathieu(), 9.1)
    way = r"ltp_, system_ and theta_ fail: its 2 states change faster than 9\.1 samples per turn"
    with pytest.warns(IdentifiabilityWarning, match=f"is another; .* {way} .* lower order, or"):
        pipe = pipeline(2.0, order=2).fit(u, y)
    pd.testing.assert_frame_equal(pipe.predict(u), pipe[:2].predict(u))
