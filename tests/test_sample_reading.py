"""``reading="sample"``: periodic innovations models of records in service."""

import pickle
import warnings
from dataclasses import replace

import control
import numpy as np
import pandas as pd
import pytest
from periodic_cases import mathieu, same_exponents
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd._identify import sample
from sklearn_hd._identify.sample_models import Choice, Refined
from sklearn_hd._identify.stages import Settings
from sklearn_hd._records.data import read_for_fit
from sklearn_hd.datasets import make_rotor
from sklearn_hd.exceptions import (
    FrequencyMismatchWarning,
    IdentifiabilityWarning,
    InstabilityWarning,
)
from sklearn_hd.model_selection import BlockSplit
from sklearn_hd.systems import LTPSystem, PeriodicSystem, flapping_blade

OMEGA = 2 * np.pi  # a turn is a second


def pipeline(omega=OMEGA, /, order="auto", block_rows=None, feedthrough="auto", **analysis):
    steps = [
        ("harmonics", HarmonicAnalyzer(omega, reading="sample", **analysis)),
        ("identify", MOESPRegressor(order, block_rows=block_rows, feedthrough=feedthrough)),
    ]
    return Pipeline(steps)


def machine(n_rows=4000, samples=10.0, noise=0.03, growth=1.0, seed=0, start=0.0, rest=0, **held):
    """A periodic innovations model of two states, its loads and its multipliers.

    ``feedback`` of the output comes ``late`` rows later. Returns inputs, outputs, the response to
    the inputs alone and the multipliers.
    """
    feedback, late = held.get("feedback", 0.0), held.get("late", 1)
    rng = np.random.default_rng(seed)
    psi = 2 * np.pi / samples * np.arange(n_rows) + start
    c, s = np.cos(psi), np.sin(psi)
    A = growth * (
        np.array([[0.8, 0.4], [-0.4, 0.75]])
        + c[:, None, None] * [[0.1, 0.0], [0.05, -0.1]]
        + s[:, None, None] * [[0.0, 0.08], [0.06, 0.0]]
    )
    B = np.stack([1 + 0.4 * c, 0.5 - 0.3 * s], axis=1)
    C, K = np.stack([1 + 0.2 * s, 0.5 * np.ones(n_rows)], axis=1), np.array([0.3, 0.1])
    reference, e = rng.standard_normal(n_rows), noise * rng.standard_normal(n_rows)
    reference[:rest] = 0.0
    x, alone = np.zeros(2), np.zeros(2)
    u, y, response = np.empty((3, n_rows))
    for k in range(n_rows):
        y[k] = C[k] @ x + e[k] + 0.7 * c[k] - 0.3 * np.sin(2 * psi[k])
        response[k] = C[k] @ alone
        u[k] = reference[k] - feedback * (y[k - late] if k >= late else 0.0)
        x, alone = A[k] @ x + B[k] * u[k] + K * e[k], A[k] @ alone + B[k] * u[k]
    turn = np.linalg.multi_dot(A[: round(samples)][::-1]) if samples == round(samples) else None
    time = pd.Index((psi / OMEGA), name="time")
    frames = (pd.DataFrame({n: v}, time) for n, v in (("u", u), ("y", y), ("y", response)))
    return *frames, None if turn is None else np.linalg.eigvals(turn)


def share(pipe, u, response, rows):
    """Share of the response to the input that is predicted."""
    found = np.asarray(pipe.predict(u)) - np.asarray(pipe.predict(u.assign(u=0.0)))
    left = (found - response.to_numpy())[rows]
    return 1.0 - np.sum(left**2) / np.sum(response.to_numpy()[rows] ** 2)


@pytest.mark.parametrize(
    "samples",
    [pytest.param(10.0, marks=pytest.mark.slow), pytest.param(16.216, marks=pytest.mark.slow), 7.3],
)
def test_a_periodic_machine_is_found_with_nothing_chosen(samples):
    u, y, response, multipliers = machine(6000, samples)
    pipe = pipeline().fit(u[:4000], y[:4000])
    model = pipe["identify"]
    assert model.order_ == 2
    assert share(pipe, u, response, slice(4000, None)) > 0.998
    if multipliers is not None:
        found = np.sort_complex(model.eigenvalues_)
        np.testing.assert_allclose(found, np.sort_complex(multipliers), atol=0.01)
    one = pipe["identify"].predict_ahead(pipe[:1].transform(u), y).to_numpy()
    assert np.std((one - y.to_numpy())[100:]) < 1.05 * 0.03
    np.testing.assert_allclose(model.innovations_covariance_, 0.03**2, rtol=0.1)


@pytest.mark.parametrize("order", ["auto", 2])
@pytest.mark.slow
def test_states_that_the_outputs_show_in_turning_coordinates_are_not_more(order):
    """Constant coordinates of these futures are singular at some azimuth, and take three states."""
    F = [
        [[-0.07, 0.01], [0.01, -0.15]],
        [[-0.39, 0.05], [-0.16, -0.33]],
        [[-0.46, -0.35], [0.67, 0.18]],
    ]
    G = [[[0.81], [-2.37]], [[0.4], [-0.62]], [[0.4], [0.23]]]
    true = LTPSystem(np.array(F), np.array(G), [[-1.63, -1.35]], omega=2.0)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 800), 4)
    time = pd.Index(np.arange(len(u)) * true.period / 16, name="time")
    y = np.asarray(true.simulate(u[:, None], time.to_numpy()))
    y = y + 0.01 * y.std() * rng.standard_normal(y.shape)
    pipe = pipeline(2.0, order=order).fit(
        pd.DataFrame({"u": u}, time), pd.DataFrame(y, time, ["y"])
    )
    assert pipe["identify"].order_ == 2
    found = np.sort(pipe["identify"].ltp_.floquet_exponents().real)
    np.testing.assert_allclose(found, np.sort(true.floquet_exponents().real), rtol=0.02)


@pytest.mark.slow
def test_outputs_are_the_states_where_there_are_enough():
    """All that is known of a blade's flap to come turns far over a turn; flap and rate do not."""
    blade, rng = flapping_blade(gamma=4.0), np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 300), 16)
    time = pd.Index(np.arange(len(u)) * blade.period / 32, name="time")
    y = np.asarray(blade.simulate(u[:, None], time.to_numpy()))
    y = y + 0.02 * y.std(axis=0) * rng.standard_normal(y.shape)
    frames = pd.DataFrame({"u": u}, time), pd.DataFrame(y, time, ["flap", "rate"])
    identify = pipeline(blade.omega).fit(*frames)["identify"]
    tried = pd.DataFrame(identify.order_search_)
    assert identify.order_ == 2
    assert tried.loc[tried["order"] == 2, "share"].min() < 1.02 * 0.02  # before steps of likelihood
    assert identify.n_harmonics_ <= 3
    same_exponents(identify.ltp_.floquet_exponents(), blade, 0.02)


@pytest.mark.slow
def test_a_mode_that_nothing_moves_is_truncated():
    """A third state that neither inputs nor innovations move, beside two that are coupled to it."""
    u, y, *_ = machine()
    X = HarmonicAnalyzer(OMEGA, reading="sample").fit(u, y).transform(u)
    experiment = read_for_fit(X, y)
    data = sample.read(experiment, Settings())
    choice, best, *_ = Choice.of(data, Settings(), experiment.basis)
    good = choice.refined(choice.whole(best), best.stable).linear
    n = good.n_states
    coefficients = np.insert(np.insert(good.coefficients, n, 0.0, axis=1), n, 0.0, axis=2)
    coefficients[0, n, n], coefficients[0, :n, n], coefficients[0, n + 1 :, n] = 0.6, 0.3, 0.5
    more = replace(good, coefficients=coefficients, gain=np.insert(good.gain, n, 0.0, axis=1))
    left, few = choice.truncated(more, best.n_harmonics)
    np.testing.assert_allclose(
        np.sort_complex(few.multipliers()), np.sort_complex(good.multipliers())
    )
    np.testing.assert_allclose(left.variance, choice.compared(n, 0, good).variance, rtol=1e-3)
    one = choice.compared(n + 1, best.n_harmonics, more)
    found = sample._Found(choice, one, Refined(more, None, data.rest, "what it leaves is no noise"))
    kept = sample._truncated(found, choice)
    assert kept.chosen.order == n == 2
    assert kept.left.bic < found.left.bic
    assert "what it leaves is no noise" in kept.against  # nothing said is lost


@pytest.mark.slow
def test_loads_are_told_from_the_dynamics():
    u, *_ = machine(1000)
    u[:] = 0.0
    pipe = pipeline().fit(*machine(4000)[:2])
    loads = pipe["identify"].loads_
    assert loads.index[:3].tolist() == ["0", "1c", "1s"]
    expected = {"0": 0.0, "1c": 0.7, "1s": 0.0, "2c": 0.0, "2s": -0.3}
    for name, value in expected.items():
        assert loads["y"][name] == pytest.approx(value, abs=0.01), name
    rest = pipe.predict(u).to_numpy()[200:, 0]
    psi = OMEGA * u.index.to_numpy()[200:]
    np.testing.assert_allclose(rest, 0.7 * np.cos(psi) - 0.3 * np.sin(2 * psi), atol=0.03)


@pytest.mark.slow
def test_an_azimuth_at_constant_speed_is_the_same_as_omega():
    u, y, *_ = machine(2000, 16.216)
    by_omega = pipeline().fit(u, y)
    X = u.assign(psi=OMEGA * u.index % (2 * np.pi))
    by_azimuth = pipeline(None, azimuth="psi").fit(X, y)
    np.testing.assert_allclose(by_azimuth.predict(X), by_omega.predict(u), atol=1e-6)
    assert by_azimuth["harmonics"].get_feature_names_out().tolist() == ["u", "psi"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_a_rotor_whose_speed_varies_by_a_tenth():
    data = make_rotor(random_state=0, speed_variation=0.1)
    X, split = data.inputs.assign(psi=data.azimuth), 6000
    pipe = pipeline(None, azimuth="psi").fit(X[:split], data.outputs[:split])
    found = pipe.predict(X) - pipe.predict(X.assign(pitch=0.0))
    left = (found - data.response.to_numpy()).to_numpy()[split:]
    assert 1 - np.sum(left**2) / np.sum(data.response.to_numpy()[split:] ** 2) > 0.99


@pytest.mark.slow
def test_units_and_whole_turns_do_not_matter():
    u, y, *_ = machine(2000)
    pipe = pipeline().fit(u, y)
    later = u.index + 40.0  # forty turns
    other = pipeline().fit((1e6 * u).set_axis(later), (1e-3 * y + 7.0).set_axis(later))
    found = other.predict((1e6 * u).set_axis(later)).to_numpy()
    np.testing.assert_allclose((found - 7.0) / 1e-3, pipe.predict(u), atol=1e-5)


@pytest.mark.slow
def test_two_records_are_one_machine():
    parts = [machine(2000, 16.216, seed=s, start=0.4 * s)[:2] for s in range(2)]
    u, y = (pd.concat(dict(enumerate(each))) for each in zip(*parts, strict=True))
    pipe = pipeline().fit(u, y)
    assert pipe["identify"].x0_.shape == (2, pipe["identify"].order_)
    assert pipe.score(u, y) > 0.99
    assert pipe.score(u.loc[[1]], y.loc[[1]]) > 0.99


@pytest.mark.slow
def test_rows_that_are_missing_make_gaps():
    u, y, response, _ = machine(3000)
    kept = np.ones(3000, dtype=bool)
    kept[700:713] = kept[1500:1509] = False
    pipe = pipeline().fit(u[kept], y[kept])
    assert share(pipe, u, response, slice(2000, None)) > 0.995
    holes = y.where(kept[:, None])
    bridged = pipeline(missing="gap").fit(u, holes)
    assert share(bridged, u, response, slice(2000, None)) > 0.995


@pytest.mark.slow
def test_a_machine_held_by_feedback_is_unstable_and_predicted_ahead():
    u, y, *_ = machine(6000, growth=1.22, feedback=0.25, noise=0.1)
    assert np.max(np.abs(y)) < 100.0
    with pytest.warns(InstabilityWarning, match="Floquet multiplier of size 1"):
        pipe = pipeline().fit(u, y)
    model = pipe["identify"]
    multipliers = machine(10, growth=1.22)[3]
    np.testing.assert_allclose(
        np.sort_complex(model.eigenvalues_), np.sort_complex(multipliers), rtol=0.05
    )
    one = model.predict_ahead(pipe[:1].transform(u), y).to_numpy()
    assert np.std((one - y.to_numpy())[100:]) < 1.05 * 0.1


@pytest.mark.slow
def test_feedback_within_a_row_is_no_feedthrough():
    """With D free it would be a part of the machine: the data cannot tell them apart."""
    u, y, _, multipliers = machine(6000, growth=1.22, feedback=0.25, late=0, noise=1.0)
    with pytest.warns(InstabilityWarning, match="weighting='pbsid' if feedback held it"):
        assert pipeline(order=2).fit(u, y)["identify"].feedthrough_
    pipe = pipeline(order=2).set_params(identify__weighting="pbsid")
    with (
        pytest.warns(IdentifiabilityWarning, match=r"lower with D free; .* so D is zero; if no"),
        pytest.warns(InstabilityWarning, match="or another order"),
    ):
        model = pipe.fit(u, y)["identify"]
    assert not model.feedthrough_
    assert "feedback within a row looks the same: D = 0" in model.feedthrough_reason_
    found = np.sort_complex(model.eigenvalues_)
    np.testing.assert_allclose(found, np.sort_complex(multipliers), rtol=0.02)


def test_d_is_not_blamed_on_feedback_where_no_predictor_tells_it():
    """Inputs that earlier rows predict: D is zero without a word."""
    fine = np.arange(60_000) / 400.0
    u = np.sin(2.3 * fine) + 0.5 * np.sin(0.71 * fine)  # moves between samples: D helps
    x = np.zeros(60_000)
    for k in range(59_999):
        x[k + 1] = x[k] + ((-8.0 + 2.0 * np.cos(OMEGA * fine[k])) * x[k] + u[k]) / 400.0
    time = pd.Index(fine[::20], name="time")
    y = x[::20] + 1e-4 * np.random.default_rng(0).standard_normal(3000)
    u, y = pd.DataFrame(u[::20], time, ["u"]), pd.DataFrame(y, time, ["y"])
    pipe = pipeline(order=1).set_params(identify__weighting="pbsid")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = pipe.fit(u, y)["identify"]
    assert not [each for each in said if "feedback within the row" in str(each.message)]
    assert model.feedthrough_reason_ == "weighting='pbsid' takes D = 0"


@pytest.mark.slow
def test_without_harmonics_the_model_is_time_invariant():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((3000, 1)), np.zeros((3000, 1))
    for k in range(1, 3000):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1] + 0.05 * rng.standard_normal()
    time = np.arange(3000) / 10
    frames = pd.DataFrame(u, time, ["u"]), pd.DataFrame(y, time, ["y"])
    pipe = pipeline(output_harmonics=0).fit(*frames)
    model = pipe["identify"]
    assert isinstance(model.system_, control.StateSpace)
    assert (model.order_, model.n_harmonics_) == (1, 0)
    np.testing.assert_allclose(model.eigenvalues_, 0.8, atol=0.01)
    assert pipeline().fit(*frames)["identify"].n_harmonics_ == 0  # the data say so, too


@pytest.mark.slow
def test_a_feedthrough_is_found_where_there_is_one():
    u, y, *_ = machine(3000)
    without = pipeline().fit(u, y)["identify"]
    direct = y + (0.5 + 0.2 * np.cos(OMEGA * u.index.to_numpy())[:, None]) * u.to_numpy()
    pipe = pipeline().fit(u, direct)
    assert not without.feedthrough_
    assert pipe["identify"].feedthrough_
    assert "Bayesian information criterion" in pipe["identify"].feedthrough_reason_
    assert pipe.score(u, direct) > 0.99


def smooth(system, samples, highest, seed, rows=4000):
    """A multisine that moves on between samples, and the response with 1 % noise."""
    rng = np.random.default_rng(seed)
    fine = np.arange(8 * rows) * system.period / (8 * samples)
    lines = system.omega * np.linspace(0.02, highest, 30)
    u = np.cos(np.outer(fine, lines) + rng.uniform(0, 2 * np.pi, 30)).sum(axis=1, keepdims=True)
    return fine[::8], u[::8], system.simulate(u, fine)[::8], rng


def frames(t, u, y, rng):
    y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    index = pd.Index(t, name="time")
    return pd.DataFrame(u, index), pd.DataFrame(y, index)


@pytest.mark.slow
def test_inputs_that_move_between_samples_add_no_states():
    """Earlier rows tell a smooth input, so that no regression on it tells a feedthrough."""
    system = mathieu()
    t, u, y, rng = smooth(system, 20.0, 0.7, seed=0)
    model = pipeline(2.0).fit(*frames(t, u, y, rng))["identify"]
    assert model.order_ == 2
    assert "the predictor cannot tell D" in model.feedthrough_reason_
    same_exponents(model.model_.exponents(), system, rtol=0.01)


@pytest.mark.slow
def test_a_stable_machine_has_a_stable_model():
    """Squares of the outputs stay in pieces so short that states of their own explain them."""
    system = mathieu()
    t, u, y, rng = smooth(system, 33.3, 1.3, seed=5, rows=2500)
    pipe = pipeline(2.0)
    with pytest.warns(IdentifiabilityWarning, match="exponents are in doubt|not noise"):
        pipe.fit(*frames(t, u, y + 0.1 * y**2 / np.std(y, axis=0), rng))
    found = pipe["identify"]
    tried = pd.DataFrame(found.order_search_)
    assert not tried.loc[tried["bic"].idxmin(), "stable"]
    assert np.max(np.abs(found.eigenvalues_)) < 1.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_oversampled_records_are_thinned():
    data = make_rotor(n_turns=100, sample_time=0.001, hold=30, random_state=0)
    pipe = pipeline(data.omega).fit(data.inputs, data.outputs)
    basis = pipe["harmonics"].basis_
    assert basis.hop == 6
    assert basis.samples_per_period == pytest.approx(data.samples_per_turn / 6)
    predicted = pipe.predict(data.inputs)
    assert len(predicted) == len(data.inputs)
    assert pipe.score(data.inputs, data.outputs) > 0.9


@pytest.mark.slow
def test_a_search_over_order_lags_and_harmonics():
    u, y, *_ = machine(2400)
    grid = {
        "identify__order": [1, 2, 3],
        "identify__block_rows": [6, 10],
        "harmonics__output_harmonics": [0, 2],
    }
    search = GridSearchCV(pipeline(), grid, cv=BlockSplit(3), error_score="raise").fit(u, y)
    assert search.best_params_["identify__order"] in (2, 3)
    assert search.best_params_["harmonics__output_harmonics"] == 2
    assert search.best_score_ > 0.99


@pytest.mark.slow
def test_copies_are_the_same():
    u, y, *_ = machine(1500)
    pipe = pipeline().fit(u, y)
    expected = pipe.predict(u)
    pd.testing.assert_frame_equal(pickle.loads(pickle.dumps(pipe)).predict(u), expected)
    pd.testing.assert_frame_equal(clone(pipe).fit(u, y).predict(u), expected)
    frame = pipe[:1].transform(u)
    assert frame.columns.tolist() == ["u"]
    assert pickle.loads(pickle.dumps(frame)).basis.reading == "sample"


@pytest.mark.slow
def test_a_trim_that_is_given_is_used():
    u, y, response, _ = machine(3000, rest=600)
    pipe = pipeline(trim_span=(0.0, 60.0), load_harmonics=2).fit(u, y)
    trim = pipe["harmonics"].basis_.output_trim
    np.testing.assert_allclose(trim[:, 0], [0.0, 0.7, 0.0, 0.0, -0.3], atol=0.01)
    assert share(pipe, u, response, slice(1000, None)) > 0.995


def test_stable_asks_for_stable_models():
    u, y, *_ = machine(3000, growth=1.22, feedback=0.25, noise=0.1)
    with pytest.raises(ValueError, match="no model of the orders tried"):
        Pipeline(
            [
                ("harmonics", HarmonicAnalyzer(OMEGA, reading="sample")),
                ("identify", MOESPRegressor(2, stable=True)),
            ]
        ).fit(u, y)


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_a_model_of_nothing_says_so():
    rng = np.random.default_rng(0)
    time = np.arange(3000) / 10
    u = pd.DataFrame(rng.standard_normal((3000, 1)), time, ["u"])
    y = pd.DataFrame(rng.standard_normal((3000, 1)), time, ["y"])
    with pytest.warns(IdentifiabilityWarning, match="no model explains the outputs"):
        pipeline().fit(u, y)


@pytest.mark.parametrize("off", [1e-4, 1e-3])
@pytest.mark.slow
def test_an_omega_that_is_off_is_told_and_mended(off):
    u, y, _, multipliers = machine(5000)
    pipe = pipeline(OMEGA * (1.0 + off))
    with pytest.warns(FrequencyMismatchWarning, match=r"at 6\.2831\d+ ± .* is used") as told:
        pipe.fit(u, y)
    assert len([w for w in told if w.category is FrequencyMismatchWarning]) == 1
    assert pipe[0].basis_.omega == pytest.approx(OMEGA, rel=5e-6)
    found = np.sort(np.abs(pipe[1].model_.eigenvalues()))[::-1]
    np.testing.assert_allclose(found[:2], np.sort(np.abs(multipliers))[::-1], rtol=0.05)


def test_a_short_record_says_that_its_model_is_noise():
    u, y, *_ = machine(60)
    with pytest.warns(IdentifiabilityWarning, match=r"rows determine \d+ coefficients"):
        pipeline(block_rows=4).fit(u, y)


@pytest.mark.parametrize(
    ("settings", "rows", "words"),
    [
        ({"output_harmonics": 5}, 1000, "10 samples a turn, which tell harmonics up to 4 apart"),
        ({"output_harmonics": 6}, 1000, "10 samples a turn, too few for harmonic 6"),
        ({"output_harmonics": 2, "hop": 3}, 1000, "of which hop=3 leaves 3.333, too few"),
        ({"output_harmonics": {"y": [1]}}, 1000, "one number for all signals"),
        ({"hop": "period"}, 1000, "hop must be a whole number of at least 1, got 'period'"),
        ({"small_signal": "odd"}, 1000, "reading='sample' does not ask for"),
        ({"block_rows": 30}, 80, "too few for a predictor of 30 lags"),
        ({"order": 9, "block_rows": 4}, 1000, "order=9 exceeds the 4 that block_rows=4"),
        ({}, 5, "only 0.5 of a turn"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_way_out(settings, rows, words):
    u, y, *_ = machine(rows)
    with pytest.raises(ValueError, match=words):
        pipeline(**settings).fit(u, y)


def test_inputs_that_cannot_be_told_from_loads_are_refused():
    u, y, *_ = machine(1000)
    with pytest.raises(ValueError, match="repeats itself with every turn"):
        pipeline().fit(u.assign(u=np.cos(OMEGA * u.index)), y)
    with pytest.raises(ValueError, match="constant in the rows"):
        pipeline().fit(u.assign(u=1.0), y)
    with pytest.raises(ValueError, match="must increase with time"):
        pipeline(None, azimuth="psi").fit(u.assign(psi=2.0), y)


def test_loads_are_a_matter_of_samples_alone():
    u, y, *_ = machine(1000)
    with pytest.raises(ValueError, match="reading='sample' alone"):
        HarmonicAnalyzer(OMEGA, reading="sliding", load_harmonics=2).fit(u, y)
    plain = MOESPRegressor(2, block_rows=5).fit(u, y)
    for name in ("loads_", "ltp_", "n_harmonics_"):
        with pytest.raises(AttributeError, match="HarmonicAnalyzer\\(reading='sample'\\)"):
            getattr(plain, name)


@pytest.mark.slow
def test_nothing_is_spurious_in_samples():
    u, y, *_ = machine(2000)
    pipe = Pipeline([*pipeline().steps, ("reduce", SpuriousModeReducer())]).fit(u, y)
    modes = pipe["reduce"].modes_
    assert set(modes["verdict"]) == {"genuine"}
    assert modes["reason"].str.contains("without a window").all()
    np.testing.assert_array_equal(pipe.predict(u), pipe[:2].predict(u))


@pytest.mark.slow
def test_steps_of_the_likelihood_mend_long_records_of_many_outputs(rng):
    """2 % noise on six outputs hides a mode that lasts 366 rows: the closed form is 2.5 % off."""
    F = 0.05 * rng.standard_normal((3, 4, 4))
    A = rng.standard_normal((4, 4))
    F[0] = 0.5 * (A - (np.max(np.linalg.eigvals(A).real) + 0.08) * np.eye(4))
    system = LTPSystem(F, rng.standard_normal((4, 3)), rng.standard_normal((6, 4)), omega=3.0)
    t = np.arange(300 * 32) * system.period / 32
    u = np.repeat(rng.choice([-1.0, 0.0, 1.0], (len(t) // 7 + 1, 3)), 7, axis=0)[: len(t)]
    y = np.asarray(system.simulate(u, t))
    y = y + y.std(axis=0) * (np.cos(3.0 * t)[:, None] + 0.02 * rng.standard_normal(y.shape))
    time = pd.Index(t, name="time")
    frames = pd.DataFrame(u, time).add_prefix("u"), pd.DataFrame(y, time).add_prefix("y")
    pipe = pipeline(3.0).fit(*frames)
    found, true = pipe["identify"].ltp_.floquet_exponents(), system.floquet_exponents()
    gaps = np.abs(true[:, None] - found).min(axis=1) / np.abs(true.real)
    assert gaps.max() < 0.01


def rotor_in_climb(x, u, t, omega=25.0, mu=0.3, gamma=7.0):
    """A blade with stall: collective and cyclic pitch, damping that gets less with its rate."""
    flap, rate = x[0], x[1] / omega
    s, c, s2 = np.sin(omega * t), np.cos(omega * t), np.sin(2.0 * omega * t)
    pitch = 0.05 + u[0] + u[1] * s
    moment = (1 + 8 / 3 * mu * s + 2 * mu**2 * s**2) * pitch - (4 / 3 + 2 * mu * s) * 0.02
    spring = 1.03 + gamma / 8 * (4 / 3 * mu * c + mu**2 * s2)
    damping = gamma / 8 * (1 + 4 / 3 * mu * s) * rate - 6.0 * rate**3
    accelerated = omega**2 * (gamma / 8 * moment - damping - spring * flap - 2.0 * flap**3)
    return np.stack([x[1], accelerated])


@pytest.mark.slow
def test_smooth_inputs_without_noise_add_no_states():
    """Many lags of an exact record are large and cancel each other: half of them tell more."""
    names = {"state_names": ["flap", "rate"], "input_names": ["collective", "cyclic"]}
    flap = {"output_names": ["flap"], "period": 2 * np.pi / 25.0}
    system = PeriodicSystem(rotor_in_climb, lambda x, u, t: x[:1], **names, **flap)
    trim = system.trim(n_harmonics=10)
    true = system.linearize(trim).floquet_exponents()
    rng, psi = np.random.default_rng(2), 2 * np.pi * np.arange(80 * 64) / 64
    waves = []
    for _ in range(2):
        tones = np.geomspace(0.03, 2.2, 16) * rng.uniform(0.93, 1.07, 16)
        wave = np.sin(np.outer(psi, tones) + rng.uniform(0.0, 6.28, 16)).sum(axis=1)
        waves.append(0.006 * wave / np.abs(wave).max())
    u = pd.DataFrame(np.transpose(waves), pd.Index(psi / 25.0), ["collective", "cyclic"])
    y = system.simulate(u, psi / 25.0, x0=trim.states(0.0))
    found = pipeline(25.0).fit(u, y)["identify"]
    assert found.order_ == 2
    gaps = np.abs(found.ltp_.floquet_exponents()[:, None] - true).min(axis=1)
    assert np.max(gaps / np.abs(true)) < 0.01


@pytest.mark.slow
def test_figures_over_seeds():
    """Discrete models at 20 dB, rotors in gusts."""
    vaf = []
    for seed in range(10):
        u, y, response, multipliers = machine(7000, noise=0.25, seed=seed)
        pipe = pipeline().fit(u[:5000], y[:5000])
        assert np.all(np.abs(pipe["identify"].eigenvalues_[:2].imag) > 0.0)
        assert np.all(np.abs(multipliers.imag) > 0.0)
        vaf.append(share(pipe, u, response, slice(5000, None)))
    assert min(vaf) > 0.99
    assert np.mean(vaf) > 0.997
