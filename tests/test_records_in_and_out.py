"""What comes out mirrors what went in: types, labels, states by record, extreme units."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import heave_pipeline, random_stable
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning

DT = 0.01


@pytest.fixture
def data(rng):
    """Four hundred rows of a second-order system, its second output the slower state."""
    A, B, C = random_stable(rng, 2, 1, 2)
    A = A @ A  # no pole on the negative real axis
    index = pd.Index(DT * np.arange(400), name="time")
    u = rng.standard_normal((400, 1))
    y = propagate(A, u @ B.T, np.zeros(2)) @ C.T
    return pd.DataFrame(u, index, columns=["u"]), pd.DataFrame(y, index, columns=["w", "q"])


@pytest.fixture
def model(data):
    return MOESPRegressor(order=2, block_rows=6).fit(*data)


# ---- types and labels -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("float32", "float32"),
        ("float64", "float64"),
        ("Float32", "Float32"),
        ("float16", "float64"),
        ("int64", "float64"),
    ],
)
def test_types_are_mirrored(data, given, expected):
    u, y = data
    y = (1000 * y).round().astype(given)
    predicted = MOESPRegressor(order=2, block_rows=6).fit(u, y).predict(u)
    assert predicted.dtypes.astype(str).tolist() == [expected, expected]
    series = MOESPRegressor(order=2, block_rows=6).fit(u, y["w"]).predict(u)
    assert str(series.dtype) == expected
    if given[0] != "F":
        for target in (y.to_numpy(), y["w"].to_numpy()):
            array = MOESPRegressor(order=2, block_rows=6).fit(u.to_numpy(), target)
            assert array.predict(u.to_numpy()).dtype == expected


def test_each_column_keeps_its_own_type(data):
    u, y = data
    y = y.astype({"w": "float32"})
    predicted = MOESPRegressor(order=2, block_rows=6).fit(u, y).predict(u)
    pd.testing.assert_series_equal(predicted.dtypes, y.dtypes)
    np.testing.assert_allclose(predicted, y, atol=1e-5)


def test_names_of_the_columns_are_mirrored(data):
    u, y = data
    y.columns.name = "signal"
    pd.testing.assert_frame_equal(MOESPRegressor(order=2).fit(u, y).predict(u), y)
    y.columns = pd.MultiIndex.from_tuples([("w", "m/s"), ("q", "rad/s")], names=["signal", "unit"])
    fitted = MOESPRegressor(order=2).fit(u, y)
    pd.testing.assert_frame_equal(fitted.predict(u), y)
    pd.testing.assert_frame_equal(pickle.loads(pickle.dumps(fitted)).predict(u), y)


def test_targets_are_known_by_name(data, model):
    u, y = data
    with pytest.raises(
        ValueError, match=r"columns \['q', 'w'\], but the model was .*y\[\['w', 'q'"
    ):
        model.score(u, y[["q", "w"]])
    with pytest.raises(ValueError, match=r"y has the columns \['w', 'r'\], .*; give the same col"):
        model.score(u, y.set_axis(["w", "r"], axis=1))
    with pytest.raises(ValueError, match=r"y has 1 columns, but the model was fitted with 2"):
        model.score(u, y[["w"]])
    score = model.score(u, y)
    assert model.score(u, y.to_numpy()) == score  # arrays have no names
    by_array = MOESPRegressor(order=2, block_rows=6).fit(u.to_numpy(), y.to_numpy())
    assert by_array.score(u.to_numpy(), y.to_numpy()) == pytest.approx(score)
    analyzer = HarmonicAnalyzer(2 * np.pi / DT / 8, output_harmonics=0).fit(u, y)
    with pytest.raises(ValueError, match=r"but the harmonic basis was fitted with \['w', 'q'\]"):
        MOESPRegressor().fit(analyzer.transform(u), y[["q", "w"]])


# ---- initial states ---------------------------------------------------------------------------


def records(*frames):
    labels = [("a", 1), ("a", 2), ("b", 1)]
    names = ["day", "flight", "time"]
    return [pd.concat(dict.fromkeys(labels, data), names=names) for data in frames]


def test_states_by_record_of_several_levels(data, model):
    u = data[0]
    (three,) = records(u)
    states = {("a", 1): [1.0, 0.0], ("a", 2): [0.0, 2.0], ("b", 1): [3.0, 3.0]}
    predicted = model.predict(three, x0=states)
    for label, x0 in states.items():
        np.testing.assert_array_equal(predicted.loc[label], model.predict(u, x0=x0))
    with pytest.raises(ValueError, match=r"no state for record \('a', 1\); give one for each of"):
        model.predict(three, x0={"a": [1.0, 0.0], "b": [1.0, 0.0]})
    with pytest.raises(ValueError, match=r"x0 names the record \('c', 1\), which the data do not"):
        model.predict(three, x0=states | {("c", 1): [0.0, 0.0]})
    with pytest.raises(
        ValueError, match=r"x0 names the record 'pilot', which the data do not have"
    ):
        model.predict(u, x0={0: [1.0, 0.0], "pilot": [0.0, 0.0]})


def test_states_in_a_frame_are_ordered_by_record(data, model):
    u = data[0]
    two = pd.concat({"a": u, "b": u}, names=["record"])
    expected = model.predict(two, x0={"a": [1.0, 0.0], "b": [0.0, 2.0]})
    frame = pd.DataFrame([[0.0, 2.0], [1.0, 0.0]], index=["b", "a"])
    pd.testing.assert_frame_equal(model.predict(two, x0=frame), expected)
    rows = pd.DataFrame([[1.0, 0.0], [0.0, 2.0]])
    pd.testing.assert_frame_equal(model.predict(two, x0=rows), expected)
    with pytest.raises(
        ValueError, match=r"x0 has the rows \['b', 'c'\], which are not the records"
    ):
        model.predict(two, x0=frame.set_axis(["b", "c"]))


def test_states_that_are_named_come_in_any_order(data):
    u, y = data
    structure = MatrixStructure(
        np.full((2, 2), np.nan), np.full((2, 1), np.nan), state_names=["w", "q"]
    )
    chain = SpuriousModeReducer(MOESPRegressor(order=2, block_rows=6))
    matcher = StructuredMatcher(chain, structure=structure).fit(u, y)
    expected = matcher.predict(u, x0=[1.0, 2.0])
    assert expected.iloc[0].tolist() == pytest.approx([1.0, 2.0])
    series = pd.Series({"q": 2.0, "w": 1.0})
    pd.testing.assert_frame_equal(matcher.predict(u, x0=series), expected)
    pd.testing.assert_frame_equal(matcher.predict(u, x0=series.to_frame().T), expected)


# ---- units ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("u_unit", "y_unit"), [(1.0, 1e170), (1e170, 1e170), (1e170, 1e-170), (1e-180, 1e-180)]
)
@pytest.mark.slow
def test_units_whose_squares_leave_the_range_of_floats(u_unit, y_unit):
    """Same score as in plain units, by every step, and no warning of NumPy's (an error here)."""
    data = make_flapping_wing("ltp", start=5, n_periods=60, snr=100, random_state=0)
    plain = heave_pipeline(data.omega, n_states=3).fit(data.inputs, data.outputs)
    u, y = data.inputs * u_unit, data.outputs * y_unit
    pipe = heave_pipeline(data.omega, n_states=3).fit(u, y)
    for stop in (2, 3):
        found = pipe[:stop].score(u, y)
        assert found == pytest.approx(plain[:stop].score(data.inputs, data.outputs), abs=1e-6)
    assert np.isfinite(pipe.predict(u).to_numpy()).all()


@pytest.mark.parametrize(
    ("u_unit", "y_unit", "message"),
    [
        (1.0, 1e210, r"y reaches .*e\+2.. in column 'w', too large to be squared: at most 1e\+200"),
        (1e305, 1.0, r"X reaches .*e\+30. in column 'U', too large to be squared"),
        (
            1e-310,
            1.0,
            r"input 'U' is constant in the rows from [^(]* s, so the record",
        ),
        (
            1.0,
            1e-310,
            r"all outputs are zero in .* \(after the trim is subtracted\): .*their units",
        ),
        (
            1e-170,
            1e190,
            r"MOESPRegressor: the computation failed .*: give inputs and outputs in",
        ),
        (1.0, 1e175, r"StructuredMatcher: the computation failed \(overflow .*in other units"),
        (1e170, 1.0, r"StructuredMatcher: the computation failed .*in other units"),
    ],
)
def test_units_beyond_are_refused(u_unit, y_unit, message):
    data = make_flapping_wing("ltp", start=5, n_periods=60, snr=100, random_state=0)
    structure = MatrixStructure(np.full((3, 3), np.nan), np.full((3, 1), np.nan))
    steps = heave_pipeline(data.omega, n_states=3).steps
    pipe = Pipeline([*steps, ("match", StructuredMatcher(structure=structure))])
    with pytest.raises(ValueError, match=message):
        pipe.fit(data.inputs * u_unit, data.outputs * y_unit)


def test_outputs_at_rest(data):
    u, y = data
    with pytest.raises(ValueError, match=r"all outputs are constant in the rows from t = 0 s to 3"):
        MOESPRegressor(order=2).fit(u, y * 0.0 + 3.0)
    with pytest.warns(IdentifiabilityWarning, match=r"outputs \['q'\] are constant, but not zero"):
        MOESPRegressor(order=2).fit(u, y.assign(q=3.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MOESPRegressor(order=2).fit(u, y.assign(q=0.0))  # decoupled: no row of C
