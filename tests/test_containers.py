"""Tables of other libraries, records in lists, and clocks among the signals."""

import numpy as np
import pandas as pd
import pytest
from sklearn.model_selection import TimeSeriesSplit, cross_val_score
from sklearn.pipeline import make_pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.model_selection import PeriodBlockSplit

OMEGA, SPP = 2 * np.pi, 16
TIME = pd.Index(np.arange(20 * SPP) / SPP, name="time")
U = pd.DataFrame({"u": np.random.default_rng(0).standard_normal(20 * SPP)}, index=TIME)
Y = pd.DataFrame({"w": np.convolve(U["u"], 0.9 ** np.arange(99))[: 20 * SPP]}, index=TIME)
BOTH = pd.concat({"a": U.assign(v=1.0), "b": U.assign(v=2.0)}, names=["record"])
STEPS = [
    HarmonicAnalyzer(OMEGA, reading="sliding", output_harmonics=0),
    MOESPRegressor(order=1, feedthrough=True),
]


def line_of(error, **names):
    """What the line of code gives that an error ends in."""
    line = str(error.value).rpartition(": ")[2].partition(", or ")[0]
    return eval(line, {"pd": pd, **names})


# ---- records -------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", STEPS, ids=["analyze", "identify"])
@pytest.mark.parametrize(
    "X",
    [
        {"a": U, "b": 2 * U},
        [U, 2 * U],
        (U["u"], 2 * U["u"]),
        [U.to_numpy(), 2 * U.to_numpy()[:99]],
        np.stack([U.to_numpy(), 2 * U.to_numpy()]),
    ],
    ids=["dict", "list", "series", "arrays", "cube"],
)
def test_records_one_by_one_name_the_line_that_joins_them(step, X):
    with pytest.raises(
        (TypeError, ValueError), match=r"X (is a .* of 2 tables|has 3 dim)"
    ) as error:
        step.fit(X, Y)
    line = str(error.value)[str(error.value).index("pd.concat") :]
    found = eval(line, {"pd": pd, "X": X, "len": len})
    assert found.index.names[0] == "record"
    for (_, record), given in zip(
        found.groupby("record"), X.values() if isinstance(X, dict) else X, strict=True
    ):
        np.testing.assert_array_equal(np.squeeze(record), np.squeeze(given))
    with pytest.raises((TypeError, ValueError), match=r"y (is a .* of 2 tables|has 3 dim).*concat"):
        step.fit(U, X)


def test_a_dict_of_signals_is_no_dict_of_records():
    with pytest.raises(TypeError, match=r"make it a DataFrame: pd.DataFrame\(X\)"):
        MOESPRegressor().fit({"u": U["u"], "v": U["u"]}, Y)


# ---- other libraries -----------------------------------------------------------------------------


def test_xarray_names_the_line_that_makes_a_frame():
    xr = pytest.importorskip("xarray")
    data = xr.Dataset.from_dataframe(BOTH)
    cube = data.to_dataarray("signal")
    for X, expected in (
        (data, BOTH),
        (data.transpose("time", "record"), BOTH),
        (cube.transpose("record", "time", "signal"), BOTH),
        (cube.transpose("signal", "time", "record"), BOTH),
        (cube.sel(record="a").transpose("time", "signal"), BOTH.loc["a"]),
        (cube.sel(record="a").transpose("signal", "time"), BOTH.loc["a"]),
        (data["u"].sel(record="a"), BOTH.loc["a"][["u"]]),
    ):
        with pytest.raises(TypeError, match=r"X is an xarray Data(set|Array) with .*time") as error:
            HarmonicAnalyzer(OMEGA).fit(X)
        found = pd.DataFrame(line_of(error, X=X)).drop(columns="record", errors="ignore")
        found.columns = ["u"] if found.shape[1] == 1 else found.columns
        pd.testing.assert_frame_equal(
            found[list(expected)], expected, check_names=False, check_index_type=False
        )
    with pytest.raises(TypeError, match=r"y is an .*, or y.to_series\(\) if 'record' are the reco"):
        HarmonicAnalyzer(OMEGA).fit(U, data["u"])


def of_polars(frame):
    polars = pytest.importorskip("polars")
    return polars.DataFrame({name: frame[name].to_numpy() for name in frame})


def of_pyarrow(frame):
    return pytest.importorskip("pyarrow").Table.from_pandas(frame, preserve_index=False)


@pytest.mark.slow
@pytest.mark.parametrize("make", [of_polars, of_pyarrow])
def test_frames_that_keep_no_index_have_that_of_their_time(make):
    """Columns time and record become the index, and outputs without them are on the same rows."""
    pipe = make_pipeline(*STEPS)
    records = [pd.concat({0: each, 1: -each}, names=["record"]) for each in (U, Y)]
    for u, y in ((U, Y), records):
        expected = pipe.fit(u, y).predict(u)
        X = make(u.reset_index())
        for target in (make(y.reset_index()), make(y)):
            found = pipe.fit(X, target).predict(X)
            pd.testing.assert_frame_equal(found, expected, check_index_type=False)
            assert pipe.score(X, target) == pipe.score(u, y)
    folds = PeriodBlockSplit(3, omega=OMEGA)
    scores = [
        cross_val_score(pipe, *data, cv=folds) for data in ((U, Y), (make(U.reset_index()), Y))
    ]
    np.testing.assert_array_equal(*scores)


def test_polars_without_a_pipeline():
    polars = pytest.importorskip("polars")
    flown = of_polars(U.assign(w=Y["w"]).reset_index())
    model = MOESPRegressor(order=1, feedthrough=True).fit(flown.select("time", "u"), flown["w"])
    expected = MOESPRegressor(order=1, feedthrough=True).fit(U, Y["w"]).predict(U)
    pd.testing.assert_series_equal(model.predict(flown.select("time", "u")), expected)
    with pytest.warns(match="no times given"):  # neither index nor column of times
        HarmonicAnalyzer(OMEGA / SPP).fit(flown.select("u"), flown["w"])
    holes = flown.with_columns(polars.when(polars.col("u") > 0).then(polars.col("u")).alias("u"))
    with pytest.raises(ValueError, match="X contains NaN: column 'u'"):
        MOESPRegressor(order=1).fit(holes.select("time", "u"), flown["w"])
    scores = cross_val_score(model, flown.select("time", "u"), flown["w"], cv=TimeSeriesSplit(2))
    assert min(scores) > 0.99


# ---- clocks --------------------------------------------------------------------------------------

CLOCKS = ["time", "Time", "t", "TIME", "time [s]", "Time_[s]", "time(s)", "time_s", "t [ms]"]


def run(error, **names):
    """The names after the line of code that an error ends in."""
    exec(str(error.value).rpartition(": ")[2].replace(", and ", "; "), {"pd": pd}, names)
    return names


@pytest.mark.parametrize("name", CLOCKS)
@pytest.mark.parametrize("step", STEPS, ids=["analyze", "identify"])
def test_a_forgotten_clock_is_recognised(step, name):
    """The index counts rows, and the times stand among the signals."""
    u, y = U.rename_axis(name), Y.rename_axis(name)
    X, target = u.reset_index(), y.reset_index(drop=True)
    unit = 1000.0 if "ms" in name else 1.0
    u, y = u.set_axis(u.index / unit), y.set_axis(y.index / unit)
    with pytest.raises(ValueError, match=r"of X looks like a clock .*: X = X.set_index") as e:
        step.fit(X, target)
    done = run(e, X=X, y=target)
    pd.testing.assert_frame_equal(done["X"], u)
    step.fit(done["X"], done["y"])
    with pytest.raises(ValueError, match=r"of y looks like a clock .*: y = y.set_index") as e:
        step.fit(u, Y.rename_axis(name).reset_index())
    pd.testing.assert_frame_equal(run(e, y=Y.rename_axis(name).reset_index())["y"], y)


def test_clocks_of_records_dates_and_beside_an_index():
    two = BOTH[["u"]]
    fit = MOESPRegressor(order=1).fit
    with pytest.raises(ValueError, match=r"X.set_index\(\[record, 'time'\]\), with the name of"):
        fit(two.reset_index(drop=True).assign(time=[*TIME, *TIME]), np.zeros(len(two)))
    dates = pd.to_datetime(TIME, unit="s")
    counted = {record: U.reset_index() for record in "ab"}
    counted = pd.concat(counted, names=["record"])
    for X, expected in (
        (two.reset_index("time"), two),  # only the times are a column
        (counted, two),
        (U.reset_index().assign(time=dates), None),
        (U.reset_index().assign(time=dates.astype(str)), None),
    ):
        with pytest.raises(ValueError, match="column 'time' of X looks like a clock") as error:
            fit(X, Y)
        found = run(error, X=X, y=pd.DataFrame({"w": np.zeros(len(X))}))["X"]
        if expected is None:
            assert isinstance(found.index, pd.DatetimeIndex)
        else:
            pd.testing.assert_frame_equal(found, expected)
    with pytest.raises(
        ValueError, match=r"the index holds times already: X.drop\(columns='time'\)"
    ):
        fit(U.assign(time=TIME.to_numpy()), Y)


@pytest.mark.parametrize("name", ["ramp", "T", "dt", "time_constant", "timer", "t_wall", "u"])
def test_a_ramp_of_another_name_is_an_input(name):
    frame = HarmonicAnalyzer(OMEGA).fit_transform(pd.DataFrame({name: TIME**1.1}, index=TIME))
    assert frame.columns[0] == name


def test_milliseconds_of_polars_are_seconds():
    polars = pytest.importorskip("polars")
    X, y = (
        polars.DataFrame({"time_ms": 1000.0 * TIME.to_numpy(), name: frame[name].to_numpy()})
        for name, frame in (("u", U), ("w", Y))
    )
    assert MOESPRegressor(order=1).fit(X, y).model_.dt == pytest.approx(TIME[1] - TIME[0])


def test_a_few_rows_of_a_signal_named_t_are_no_clock():
    """They grow now and then, as those of any signal."""
    X, y = U.rename(columns={"u": "t"}), Y
    model = MOESPRegressor(order=1).fit(X, y)
    for k in range(100):
        assert len(model.predict(X.iloc[k : k + 3])) == 3


def test_a_signal_named_t_that_is_no_clock_is_one():
    MOESPRegressor(order=1).fit(U.rename(columns={"u": "t"}), Y.rename(columns={"w": "time"}))
