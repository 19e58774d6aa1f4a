"""Time delays: found to rounding without noise, kept by every step, refused where wrong."""

import pickle
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from delay_cases import DT, F, mathieu_record, plain_record
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._exported import contents
from sklearn_hd.algorithms.lti.simulation import simulate
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems import mathieu

SPEED = HarmonicStructure(
    F={"0": [[0, 1], ["k", "d"]], "1c": [[0, 0], ["q", 0]]}, G={"0": [[0], ["b"]]}
)


def mathieu_steps(reading, criterion, structure=None, **delays):
    """The steps of a Mathieu record."""
    options = {} if reading == "sample" else {"output_harmonics": 2}
    rows = 10 if reading == "sample" else 4
    structure = HarmonicStructure(F=1, G=0) if structure is None else structure
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(2.0, reading=reading, **options)),
            ("identify", MOESPRegressor(2, block_rows=rows, **delays)),
            ("match", StructuredMatcher(structure=structure, criterion=criterion)),
        ]
    )


@pytest.mark.slow
def test_all_delays_of_plain_data_are_found_to_rounding():
    u, y = plain_record()
    model = MOESPRegressor(3, block_rows=8, input_delay="auto", output_delay="auto").fit(u, y)
    np.testing.assert_allclose(model.delays_, [0.13, 0.32, 0.0, 0.27], atol=1e-10)
    assert model.delay_std_.isna().tolist() == [False, False, True, False]
    assert model.score(u, y) > 0.9999  # inputs by their means: of the second order
    exponents = np.log(model.eigenvalues_) / DT
    for value in np.linalg.eigvals(F):
        assert np.min(np.abs(exponents - value)) < 1e-2


def test_whole_samples_leave_nothing_of_plain_data():
    u, y = plain_record((0.15, 0.4), (0.0, 0.1))
    asked = {"input_delay": {"u0": 0.15, "u1": 0.4}, "output_delay": {"y1": 0.1}}
    model = MOESPRegressor(3, block_rows=8, **asked).fit(u, y)
    np.testing.assert_allclose(model.predict(u), y, atol=1e-9)
    assert model.score(u, y) == pytest.approx(1.0, abs=1e-12)
    again = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(again.predict(u), model.predict(u))
    assert clone(model).get_params()["input_delay"] == asked["input_delay"]
    reduced = SpuriousModeReducer().fit(model.transform(u), y)
    assert reduced.delays_.equals(model.delays_)
    np.testing.assert_allclose(reduced.predict(model.transform(u)), y, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("reading", ["period", "sample"])
def test_a_periodic_machine_is_exact_with_a_delay_given_and_one_found(reading):
    u, y, dt = mathieu_record()
    steps = mathieu_steps(
        reading, "output_error", input_delay="auto", output_delay={"y_dot": 4.6 * dt}
    )
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", IdentifiabilityWarning
        )  # of the start, without its likelihood
        steps.fit(u, y)
    match = steps["match"]
    np.testing.assert_allclose(match.delays_ / dt, [2.3, 0.0, 4.6], atol=1e-9)
    found = np.sort_complex(match.ltp_.floquet_exponents())
    np.testing.assert_allclose(found, np.sort_complex(mathieu().floquet_exponents()), atol=1e-9)
    np.testing.assert_allclose(steps.predict(u).iloc[40:], y.iloc[40:], atol=1e-8)
    assert steps.score(u, y) == pytest.approx(1.0, abs=1e-12)
    again = pickle.loads(pickle.dumps(steps))
    np.testing.assert_array_equal(again.predict(u), steps.predict(u))


@pytest.mark.slow
def test_predictions_and_their_gain_find_a_delay_within_its_deviation():
    u, y, dt = mathieu_record()
    noise = 0.02 * y.std().to_numpy() * np.random.default_rng(3).standard_normal(y.shape)
    known = {"input_delay": "auto", "output_delay": {"y_dot": 4.6 * dt}}
    match = mathieu_steps("period", "prediction_error", **known).fit(u, y + noise)["match"]
    assert abs(match.delays_["u"] / dt - 2.3) < 3.0 * match.delay_std_["u"] / dt < 0.05


@pytest.mark.slow
def test_a_structure_tells_the_delays_of_both():
    u, y, dt = mathieu_record()
    steps = mathieu_steps("period", "output_error", SPEED, input_delay="auto", output_delay="auto")
    match = steps.fit(u, y)["match"]
    np.testing.assert_allclose(match.delays_ / dt, [2.3, 0.0, 4.6], atol=1e-8)
    np.testing.assert_allclose(match.theta_["k"], -2.0, atol=1e-8)
    assert match.delay_std_.isna().tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("delays", "words"),
    [
        ({"input_delay": -0.1}, "not a delay of 'u0'"),
        ({"input_delay": np.nan}, "not a delay of 'u0'"),
        ({"input_delay": "soon"}, "not a delay of 'u0'"),
        ({"input_delay": {"v": 0.1}}, "names 'v', which is not an input"),
        ({"output_delay": {"u0": 0.1}}, "names 'u0', which is not an output"),
        ({"output_delay": True}, "not a delay of 'y0'"),
        ({"input_delay": 1e3}, "is longer than the rows from"),
        ({"input_delay": 9.5}, "too few|block_rows"),
    ],
)
def test_wrong_delays_are_refused(delays, words):
    with pytest.raises(ValueError, match=words):
        MOESPRegressor(3, block_rows=8, **delays).fit(*plain_record())


@pytest.mark.parametrize(("direct", "found"), [(0.2, 4.0), (1.0, 4.0)])
def test_a_feedthrough_behind_a_delay_is_kept(direct, found):
    """Without D nothing but another delay and other poles explains what inputs do at once."""
    rng = np.random.default_rng(1)
    u, y = np.repeat(rng.choice([-1.0, 1.0], 100), 20)[:, None], np.zeros((2000, 1))
    y = simulate(
        np.array([[0.97]]),
        np.ones((1, 1)),
        0.03 * np.ones((1, 1)),
        np.array([[direct]]),
        u,
        np.zeros(1),
    )
    y = np.concatenate([np.zeros((4, 1)), y[:-4]]) + 0.01 * rng.standard_normal((2000, 1))
    with pytest.warns(IdentifiabilityWarning, match=r"delays are the whole samples .* \(y0 4 s\)"):
        model = MOESPRegressor(1, output_delay="auto").fit(u, y)
    assert model.delays_["y0"] == found
    assert model.model_.D[0, 0] == pytest.approx(direct, abs=0.01)
    assert model.model_.A[0, 0] == pytest.approx(0.97, abs=0.002)


def test_an_input_that_rests_tells_no_delay():
    u, y = plain_record()
    with pytest.raises(ValueError, match="u1"):
        MOESPRegressor(3, block_rows=8, input_delay="auto").fit(u.assign(u1=1.0), y)


def test_files_have_the_delays_and_so_has_the_start_of_a_record():
    u, y = plain_record((0.15, 0.4), (0.0, 0.1))
    asked = {"input_delay": {"u0": 0.15, "u1": 0.4}, "output_delay": {"y1": 0.1}}
    model = MOESPRegressor(3, block_rows=8, **asked).fit(u, y)
    found = contents(model, 8)
    np.testing.assert_allclose(found["input_delay"], [0.15, 0.4])
    np.testing.assert_allclose(found["output_delay"], [0.0, 0.1])
    later, known = u.iloc[60:], y.iloc[60:]
    x0 = model.initial_state(later, known)  # which stands for inputs that are not known, too
    np.testing.assert_allclose(model.predict(later, x0=x0).iloc[12:], known.iloc[12:], atol=1e-7)


def test_noise_of_inputs_is_refused_beside_parts_of_samples():
    u, y, dt = mathieu_record()
    steps = mathieu_steps("period", "output_error", input_delay=2.3 * dt)
    with pytest.raises(ValueError, match="give delays of whole samples"):
        steps.set_params(match__input_noise=0.01).fit(u, y)


def test_chunks_are_refused_with_the_way_out():
    with pytest.raises(ValueError, match="use fit with pandas or arrays"):
        MOESPRegressor(3, block_rows=8, input_delay=0.1).partial_fit(*plain_record())


def test_predictions_ahead_need_outputs_of_one_time():
    u, y = plain_record((0.15, 0.4), (0.0, 0.1))
    options = {"block_rows": 8, "disturbance_model": True, "input_delay": {"u0": 0.15, "u1": 0.4}}
    model = MOESPRegressor(3, output_delay={"y1": 0.1}, **options).fit(u, y)
    with pytest.raises(ValueError, match="the outputs have different delays"):
        model.predict_ahead(u, y)
    u, y = plain_record((0.05, 0.3), (0.1, 0.1))
    options["input_delay"] = {"u0": 0.05, "u1": 0.3}
    model = MOESPRegressor(3, output_delay=0.1, **options).fit(u, y)
    np.testing.assert_allclose(model.predict_ahead(u, y), y, atol=1e-7)


def test_without_delays_there_are_none():
    u, y = plain_record((0.0, 0.0), (0.0, 0.0))
    model = MOESPRegressor(3, block_rows=8).fit(u, y)
    assert model.model_.delays is None
    assert model.delays_.to_dict() == dict.fromkeys(["u0", "u1", "y0", "y1"], 0.0)
    assert model.delay_std_.isna().all()


@pytest.mark.slow
def test_a_delay_that_is_hardly_told_from_none_is_said():
    u, y = plain_record((0.0, 0.0), (0.0, 0.0), 200, 1)
    noisy = y + 0.3 * y.std().to_numpy() * np.random.default_rng(2).standard_normal(y.shape)
    asked = {"input_delay": {"u0": "auto"}, "feedthrough": False}
    with pytest.warns(IdentifiabilityWarning, match="hardly separates these delays from zero: u0"):
        MOESPRegressor(3, block_rows=8, **asked).fit(u, pd.DataFrame(noisy, y.index))


@pytest.mark.slow
def test_errors_of_the_wings_delays_reach_the_bound():
    sys.path.insert(0, str(Path(__file__).parents[1] / "docs/benchmarks"))
    from delays_study import study

    errors, said, bound = study(range(6), n_periods=30)
    assert np.all(np.sqrt(np.mean(errors**2, axis=0)) < 1.8 * bound)  # χ² of six: 99.9 %
    assert np.all(np.abs(errors) < 3.5 * said)
