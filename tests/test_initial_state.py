"""The state that records start from: what score fits, in the hands of the user."""

import numpy as np
import pandas as pd
import pytest
from periodic_cases import deflection_only, mathieu, record
from sklearn.metrics import r2_score
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._simulators import scored_simulation
from sklearn_hd.exceptions import CoordinatesWarning, IdentifiabilityWarning

MACHINE = mathieu()


def pipeline(reading):
    structure = None if reading == "sliding" else HarmonicStructure()
    return Pipeline([
        ("harmonics", HarmonicAnalyzer(
            MACHINE.omega, output_harmonics=1, reading=reading, trim_span=None)),
        ("identify", MOESPRegressor("auto" if reading == "sliding" else 2)),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher(structure=structure)),
    ])  # fmt: skip


@pytest.fixture(scope="module")
def whole():
    """A record from rest."""
    return record(MACHINE, n_periods=40, samples=16)


@pytest.fixture(scope="module")
def two_records(whole):
    """A record from rest, and one that begins in mid-motion."""
    parts = {"a": slice(0, 640), "b": slice(150, 500)}
    return [pd.concat({k: z.iloc[s] for k, s in parts.items()}, names=["record"]) for z in whole]


@pytest.fixture(scope="module")
def fitted(whole):
    return {reading: pipeline(reading).fit(*whole) for reading in ("sliding", "period", "sample")}


@pytest.mark.parametrize("reading", ["period", "sample"])
def test_it_is_the_true_state_without_noise(fitted, whole, two_records, reading):
    pipe, (X, Y) = fitted[reading], two_records
    x0 = pipe["match"].initial_state(pipe[:3].transform(X), Y)
    assert list(x0.index) == ["a", "b"]
    assert list(x0.columns) == (["y", "v"] if reading == "period" else ["x[0]", "x[1]"])
    true = np.array([np.zeros(2), whole[1].iloc[150]])
    np.testing.assert_allclose(x0, true, atol=5e-5)  # as good as the model identified
    assert r2_score(Y, pipe.predict(X, x0=x0)) > 1.0 - 1e-7


@pytest.mark.parametrize("steps", [2, 3, 4])
@pytest.mark.parametrize("reading", ["sliding", "period", "sample"])
def test_predictions_from_it_are_what_score_compares(fitted, two_records, reading, steps):
    pipe, (X, Y) = fitted[reading][:steps], two_records
    noisy = Y + 0.1 * np.random.default_rng(0).standard_normal(Y.shape)
    frame, step = pipe[:-1].transform(X), pipe[-1]
    _, simulated, rows, forced = scored_simulation(step, frame, noisy)
    x0 = step.initial_state(frame, noisy)
    found = pipe.predict(X, x0=x0).to_numpy()[rows]
    np.testing.assert_allclose(found, simulated + forced, atol=1e-9)


def raw(seed, quiet, trim=40.0):
    """Raw inputs and outputs of the machine: ±1 about the trim after some turns in it."""
    lead, n = 960, 1600  # 60 turns, in which the start dies away, and 100
    moves = np.repeat(np.random.default_rng(seed).choice([-1.0, 1.0], n // 20), 20)
    u = trim + np.concatenate([np.zeros(lead + 16 * quiet), moves[16 * quiet :]])
    t = np.arange(len(u)) * MACHINE.period / 16
    y = np.asarray(MACHINE.simulate(u[:, None], t))
    index = pd.Index(t[lead:] - t[lead], name="time")
    return pd.DataFrame({"u": u[lead:]}, index), pd.DataFrame(y[lead:], index, ["y", "v"])


@pytest.mark.parametrize(("quiet", "most"), [(6, 0.001), (0, 0.2)])
def test_raw_records_begin_in_trim(quiet, most):
    """From the state zero the first turns would be the machine's answer to its trim."""
    pipe = pipeline("sample").fit(*raw(1, 6))
    u, y = raw(2, quiet)
    motion = (y - raw(2, 100)[1]).std()
    errors = ((pipe.predict(u, x0=x0) - y)[:96] / motion for x0 in (None, np.zeros(2)))
    begun, from_zero = (float(np.sqrt((error**2).mean()).max()) for error in errors)
    assert begun < most < 2.0 < from_zero


def test_inputs_about_zero_begin_at_zero():
    """An input that is held from the first sample on is a step."""
    pipe = pipeline("sample").fit(*raw(1, 6, trim=0.0))
    u, _ = raw(2, 0, trim=0.0)
    step = 0.0 * u + 1.0
    np.testing.assert_array_equal(pipe.predict(step), pipe.predict(step, x0=np.zeros(2)))


def test_arrays_give_arrays_and_plain_models_exact_states(rng):
    u = rng.standard_normal((400, 1))
    x, y = np.zeros((401, 2)), np.zeros((400, 1))
    A, b, c = np.array([[0.9, 0.2], [-0.2, 0.7]]), np.array([0.5, 1.0]), np.array([1.0, -1.0])
    x[0] = [3.0, 1.0]
    for k in range(400):
        y[k] = c @ x[k]
        x[k + 1] = A @ x[k] + b * u[k]
    model = MOESPRegressor(2, feedthrough=False).fit(u, y)
    x0 = model.initial_state(u, y)
    assert isinstance(x0, np.ndarray)
    assert x0.shape == (1, 2)
    np.testing.assert_allclose(model.predict(u, x0=x0), y, atol=1e-9)


def test_outputs_alone_have_one_too():
    x = 0.97 ** np.arange(300)
    y = pd.DataFrame({"y": x}, index=pd.Index(0.1 * np.arange(300), name="time"))
    model = MOESPRegressor(1, disturbance_model=True).fit(None, y)
    x0 = model.initial_state(None, y)
    assert list(x0.columns) == ["x[0]"]
    empty = pd.DataFrame(index=y.index)
    np.testing.assert_allclose(model.predict(empty, x0=x0), y, atol=1e-9)


def test_segments_of_one_record_are_counted(fitted, whole):
    pipe, kept = fitted["period"], np.r_[0:300, 400:640]
    u, y = (z.iloc[kept] for z in whole)
    frame = pipe[:3].transform(u)
    x0 = pipe["match"].initial_state(frame, y)
    assert x0.index.name == "segment"
    np.testing.assert_allclose(x0.loc[1], y.iloc[300], atol=1e-5)
    np.testing.assert_allclose(pipe["match"].predict(frame, x0=x0), y, atol=1e-4)


def test_states_of_floquet_coordinates_do_as_well():
    u, y = record(deflection_only(), n_periods=40, samples=16)
    pipe = pipeline("period")
    with pytest.warns(CoordinatesWarning, match="Floquet coordinates"):
        pipe.fit(u, y)
    frame = pipe[:3].transform(u.iloc[160:])
    x0 = pipe["match"].initial_state(frame, y.iloc[160:])
    found = pipe["match"].predict(frame, x0=x0)
    np.testing.assert_allclose(found, y.iloc[160:], atol=1e-4)


def test_short_segments_are_told(fitted, whole):
    pipe, (u, y) = fitted["period"], (z.iloc[160:176] for z in whole)
    with pytest.warns(IdentifiabilityWarning, match=r"1 of 1 segment\(s\) are shorter"):
        x0 = pipe["identify"].initial_state(pipe[:1].transform(u), y)
    assert np.isfinite(x0.to_numpy()).all()


def test_it_wants_outputs_of_the_model(fitted, whole):
    u, y = whole
    frame = fitted["period"][:1].transform(u)
    with pytest.raises(ValueError, match="y has the columns"):
        fitted["period"]["identify"].initial_state(frame, y.rename(columns={"v": "w"}))
