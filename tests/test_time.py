"""When rows were sampled: jitter, rounding, long holes, records, and indices that are no time."""

import numpy as np
import pandas as pd
import pytest
from conftest import KEPT
from numpy.testing import assert_allclose
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd._clock import read_time, straightened, why_short
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import JitterWarning, ResamplingWarning, TimeBaseWarning
from sklearn_hd.model_selection import PeriodBlockSplit

DT = 2 * np.pi / (2 * np.pi * 26.3) / 64  # 64 samples a wingbeat of the hawkmoth


def frame(index):
    return pd.DataFrame({"u": np.zeros(len(index))}, index=index)


@pytest.mark.parametrize("hole", [50, 10_000, 3_000_000])
@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.2])
def test_jitter_and_a_hole_of_any_length(rng, jitter, hole):
    """The length of the hole in samples is known no better than the sample time."""
    rows = np.r_[0:300, 300 + hole : 900 + hole]
    time = DT * (rows + rng.uniform(-jitter, jitter, len(rows)))
    base = read_time(frame(time))
    assert base.segments == (slice(0, 300), slice(300, 900))
    assert abs(base.sample_time - DT) <= 4 * base.uncertainty + 1e-9 * DT


@pytest.mark.parametrize("digits", [5, 6, 9])
def test_rounded_times(digits):
    """594.1 μs written with five, six or nine digits: the step is found, the hole is a hole."""
    rows = np.r_[0:2000, 102_000:104_000]
    base = read_time(frame(np.round(DT * rows, digits)))
    assert len(base.segments) == 2
    assert base.sample_time == pytest.approx(DT, rel=10.0 ** (1 - digits))
    assert base.jitter == (0.0, 0.0)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize("unit", [1e-6, 5e-5, 1e-4])
def test_the_unit_of_a_clock_is_no_jitter(start, unit):
    """Times are multiples of a unit: rows lie on their line."""
    time = start + unit * np.round(DT * np.arange(4000) / unit)
    base = read_time(frame(time))
    assert base.jitter == (0.0, 0.0)
    off = straightened(time.copy(), base, base.sample_time) - start - DT * np.arange(4000)
    assert np.ptp(off) < 0.1 * unit + 4.0 * np.spacing(start)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize(
    ("step", "lost"),
    [(step, []) for step in (1.0413e-3, 1.188e-3, 1.25e-3, 1.8e-3, 2.37e-3)]
    + [(1.0413e-3, [700]), (1.188e-3, [700]), (1.8e-3, [700])],
)
def test_a_clock_as_coarse_as_the_samples_is_refused(start, step, lost):
    """Milliseconds of 420 to 960 Hz: the longer steps are no gaps, and the step is named."""
    time = np.delete(start + 1e-3 * np.round(step / 1e-3 * np.arange(1600)), lost)
    with pytest.raises(ValueError, match=r"rounded to 0.001 s, or of rows that are miss") as raised:
        read_time(frame(time))
    named = float(str(raised.value).split("np.arange(n_rows) * ")[1].split(";")[0])
    assert named == pytest.approx(step, rel=5e-5)


def test_rows_lost_at_random_are_no_coarse_clock(rng):
    rows = np.arange(1600)
    for share in (0.02, 0.1, 0.3):
        time = 1e-3 * rows[rng.random(1600) > share]
        assert read_time(frame(time)).sample_time == pytest.approx(1e-3)
    records = [(k, 1e-2 * i) for k in range(25) for i in np.delete(rows[:200], 20 + k)]
    assert read_time(frame(pd.MultiIndex.from_tuples(records))).sample_time == pytest.approx(1e-2)
    nearly = 1e-3 * np.delete(np.arange(5000), 100 * np.arange(1, 50) + rng.integers(-2, 3, 49))
    assert len(read_time(frame(nearly)).segments) == 50


def test_who_gives_the_sample_time_has_told():
    time = 1e-3 * np.round(1.188 * np.arange(1600))
    assert len(read_time(frame(time), sample_time=1e-3).segments) > 200


@pytest.mark.parametrize("n_rows", [1600, 1601, 1602])
@pytest.mark.parametrize("every", [3, 10])
def test_every_tenth_row_lost_may_be_a_coarse_clock(every, n_rows):
    rows = np.arange(n_rows)
    with pytest.warns(JitterWarning, match=f"one in {every} is missing: if they are rounded, give"):
        read_time(frame(1e-3 * rows[rows % every < every - 1]))
    base = read_time(frame(DT * rows[rows % 10 < 9]))  # no clock has such a unit
    assert len(base.segments) == n_rows // 10 + (n_rows % 10 > 0)


@pytest.mark.parametrize("step", [DT, 4e-4, 1e-3])
def test_jitter_of_one_unit_of_the_clock_is_jitter(rng, step):
    """Steps of an even clock are two neighbouring numbers of units, and many of them."""
    unit = 1e-4
    time = unit * (np.round(step * np.arange(4000) / unit) + rng.choice([0, 1], 4000))
    assert read_time(frame(time)).jitter[1] > 0.4 * unit


def test_records_have_the_unit_of_their_clock_from_their_own_beginning():
    time = np.concatenate(
        [s + 1e-4 * np.round(DT * np.arange(400) / 1e-4) for s in (0.0, 5.000037)]
    )
    record = np.repeat(["a", "b"], 400)
    base = read_time(frame(pd.MultiIndex.from_arrays([record, time], names=["record", "time"])))
    assert base.jitter == (0.0, 0.0)


@pytest.mark.parametrize("unit", [1e-6, 1e-4])
@pytest.mark.slow
def test_a_clock_of_some_unit_identifies_the_same_model(unit):
    wing = make_flapping_wing("nltp", n_periods=180, amplitude=0.005)
    time, found = wing.inputs.index.to_numpy(), []
    for index in (time, unit * np.round(time / unit)):
        pipe = Pipeline(
            [("harmonics", HarmonicAnalyzer(wing.omega)), ("identify", MOESPRegressor())]
        )
        u, y = (
            table.set_axis(pd.Index(index, name="time")) for table in (wing.inputs, wing.outputs)
        )
        found.append(pipe.fit(u, y)["identify"].model_.exponents())
    assert_allclose(found[1], found[0], rtol=1e-6)


def test_a_period_of_rounded_times_is_whole():
    """32 samples a wingbeat, 1188.2 μs apart: the median step of 1188 μs gives 32.006."""
    omega = 2 * np.pi * 26.3
    time = np.round(2 * DT * np.arange(3200), 6)
    basis = HarmonicAnalyzer(omega).fit(frame(time)).basis_
    assert basis.samples_per_period == 32
    assert basis.sample_time == pytest.approx(2 * DT, rel=1e-7)


def test_even_times_keep_their_step_to_the_last_bit():
    for step in (0.1, 1 / 3, DT):
        base = read_time(frame(step * np.arange(500)))
        assert base.sample_time == np.median(np.diff(step * np.arange(500)))
        assert base.jitter == (0.0, 0.0)


def test_a_stray_row_is_refused_beside_jitter(rng):
    time = np.arange(600.0) + rng.uniform(-0.05, 0.05, 600)
    time[300:] += 0.5
    with pytest.raises(
        ValueError, match=r"\(row 300\) is 1\.\d+ samples of .*: too uneven for jit"
    ):
        read_time(frame(time))


def test_resampled_rows_of_a_long_hole_keep_their_phase(rng):
    """A cosine on both sides of a hole of 1e5 jittered samples comes out as one."""
    rows = np.r_[0:1280, 101_280:102_560]
    time = DT * (rows + rng.uniform(-0.1, 0.1, len(rows)))
    omega = 2 * np.pi * 26.3
    X = pd.DataFrame({"u": np.cos(omega * time)}, index=time)
    with pytest.warns(JitterWarning):
        found = HarmonicAnalyzer(omega, input_harmonics=1).fit_transform(X)
    np.testing.assert_allclose(found[["u_0", "u_1c", "u_1s"]] - [0.0, 1.0, 0.0], 0.0, atol=1e-5)


def test_records_are_labelled_by_all_levels_above_the_time():
    parts = {(day, flight): frame(np.arange(4.0)) for day in "ab" for flight in (1, 2)}
    data = pd.concat(parts, names=["day", "flight", "time"])
    assert read_time(data).records == (("a", 1), ("a", 2), ("b", 1), ("b", 2))
    assert read_time(data.droplevel("flight").iloc[:4]).records == ("a",)


TIMES = np.arange(20) / 16
NO_TIMES = {
    "floats as objects": (pd.Index(list(TIMES), dtype=object), r"data.index.astype\(float\)"),
    "numbers as text": (pd.Index([f"{t}" for t in TIMES]), r"data.index.astype\(float\)"),
    "dates as text": (
        pd.Index([f"2026-05-01 12:00:{s:02}" for s in range(20)]),
        r"\(though its labels read as one: data.set_axis\(pd.to_datetime\(data.index\)\)\)",
    ),
    "dates as objects": (
        pd.Index([pd.Timestamp("2026-05-01").date()] * 20, dtype=object),
        r"pd.to_datetime\(data.index\)",
    ),
    "periods": (pd.period_range("2026", periods=20, freq="s"), r"data.index.to_timestamp\(\)"),
    "text": (pd.Index(list("abcdefghijklmnopqrst")), r"which is not a time; use seconds"),
    "truth": (pd.Index([True, False] * 10), r"dtype bool, which is not a time; use seconds"),
}


@pytest.mark.parametrize("labels", [["a", "b"], [1, 2]])
def test_levels_in_the_wrong_order(labels):
    data = pd.concat({label: frame(TIMES) for label in labels}, names=["record", "time"])
    with pytest.raises(ValueError, match=r"the last level of the index, 'record', .*swaplevel\(\)"):
        read_time(data.swaplevel().sort_index())
    back = read_time(data.swaplevel().sort_index().swaplevel().sort_index())
    assert back.records == tuple(labels)
    by_speed = pd.concat({speed: frame(np.arange(20)) for speed in (9.5, 12.0)})
    assert read_time(by_speed).records == (9.5, 12.0)  # counted rows of records named by numbers


def test_one_level_is_a_plain_index():
    base = read_time(frame(pd.MultiIndex.from_arrays([TIMES])))
    assert base.records == (0,)
    assert base.sample_time == 1 / 16


@pytest.mark.parametrize("case", NO_TIMES)
def test_an_index_that_is_no_time(case):
    index, message = NO_TIMES[case]
    with pytest.raises(ValueError, match=message):
        read_time(frame(index))


def test_records_that_take_turns_or_have_no_label():
    data = pd.concat({"a": frame(TIMES), "b": frame(TIMES)}, names=["record", "time"])
    with pytest.raises(
        ValueError, match=r"records .* are mixed \(rows 0 and 1 are of 'a' and 'b'\)"
    ):
        read_time(data.sort_index(level="time"))
    with pytest.raises(ValueError, match=r"are mixed .* drawn at random \(HalvingGridSearchCV"):
        read_time(data.sample(frac=1.0, random_state=0))
    codes = [[0] * 20 + [-1] * 20, [*range(20), *range(20)]]
    missing = pd.MultiIndex([["a"], TIMES], codes, names=["record", "time"])
    with pytest.raises(ValueError, match=r"label of the record is missing in row 20 of the index"):
        read_time(frame(missing))


def test_short_segments_say_what_made_them_so(rng):
    rows = np.sort(rng.choice(600, 400, replace=False))
    base = read_time(frame(rows / 16))
    assert "fall into" in why_short(base)
    assert "drawn at random, as by a shuffled split, or thinned out:" in why_short(base)
    assert why_short(read_time(frame(np.r_[0:300, 340:600, 620:900] / 16))) == ""
    X = frame(TIMES).reset_index(drop=True)
    long = pd.concat([X] * 10, ignore_index=True)
    with pytest.warns(match="no times given"):
        analyzer = HarmonicAnalyzer(2 * np.pi / 16).fit(long)
    message = r"shortest segment has 1 rows, .* 2 samples of 1 s apart .* keep the sample time"
    with pytest.raises(ValueError, match=message):
        analyzer.transform(long.iloc[::2])
    target = pd.Series(rng.standard_normal(400), index=rows / 16)
    inputs = pd.DataFrame({"u": rng.standard_normal(400)}, index=rows / 16)
    with pytest.raises(ValueError, match=r"too few for block_rows=15: .*shuffled split"):
        MOESPRegressor(order=2, block_rows=15).fit(inputs, target)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.JitterWarning")
def test_predictions_are_held_beyond_the_first_and_last_sample_of_the_grid(rng):
    """A spline through a response to white inputs is no guide beyond its ends."""
    t = 0.1 * np.arange(200) + 0.02 + rng.uniform(-0.01, 0.01, 200)  # the grid begins at 0.1
    u = rng.standard_normal(200)
    y = np.convolve(u, 0.5 ** np.arange(20))[:200]
    X, y = pd.DataFrame({"u": u}, index=t), pd.Series(y, index=t)
    predicted = MOESPRegressor(order=1, block_rows=5, feedthrough=False).fit(X, y).predict(X)
    inside = predicted.iloc[2:-2]
    assert predicted.iloc[:2].between(inside.min(), inside.max()).all()
    assert predicted.iloc[-2:].between(inside.min(), inside.max()).all()


# ---- any origin of time --------------------------------------------------------------------------

UNIX = 1.7e9  # seconds: floats are 2.4e-7 s apart, 3e-5 rad of a wingbeat and 4e-4 of a sample


@pytest.fixture(scope="module")
def flown():
    return make_flapping_wing("ltp", n_records=4, n_periods=60, start=5, random_state=0)


def moved(data, seconds, period=None):
    """The same rows at later times, later by whole periods."""
    seconds = seconds if period is None else round(seconds / period) * period
    if isinstance(data.index, pd.MultiIndex):
        times = data.index.get_level_values("time") + seconds
        records = data.index.get_level_values("record")
        return data.set_axis(pd.MultiIndex.from_arrays([records, times], names=data.index.names))
    return data.set_axis(data.index + seconds)


def two_steps(omega, **params):
    analyzer = HarmonicAnalyzer(omega, output_harmonics=KEPT, **params)
    return Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())])


@pytest.mark.parametrize("reading", ["sliding", "period"])
@pytest.mark.parametrize("seconds", [1.0, -1e4, UNIX])
@pytest.mark.slow
def test_models_do_not_depend_on_the_origin_of_time(flown, seconds, reading):
    """At 1.7e9 s a score of 0.961 fell, down to -29943, for phases of ωt that were rounded."""
    u, y, period = flown.inputs, flown.outputs, 2 * np.pi / flown.omega
    pipe = two_steps(flown.omega, reading=reading).fit(u, y)
    later = moved(u, seconds, period), moved(y, seconds, period)
    other = two_steps(flown.omega, reading=reading).fit(*later)
    assert other["identify"].order_ == pipe["identify"].order_
    assert other.score(*later) == pytest.approx(pipe.score(u, y), abs=1e-6)
    assert pipe.score(*later) == pytest.approx(pipe.score(u, y), abs=1e-5)  # a far record
    size = np.abs(y.to_numpy()).max()
    predicted = pipe.predict(later[0].iloc[300:2000]), pipe.predict(u.iloc[300:2000])
    np.testing.assert_allclose(*predicted, atol=1e-4 * size)  # 2e-5 rad are left of rounded times


@pytest.mark.parametrize("digits", [7, 8, 9])
@pytest.mark.slow
def test_digits_that_were_rounded_off_are_no_noise(flown, digits):
    """Eight decimals, 1e-5 of a sample, took a score of 0.961 to -3e22 with an order of 30."""
    u, y = flown.inputs, flown.outputs
    pipe = two_steps(flown.omega).fit(u, y)
    rounded = [
        data.set_axis(data.index.set_levels(data.index.levels[1].to_numpy().round(digits), level=1))
        for data in (u, y)
    ]
    other = two_steps(flown.omega).fit(*rounded)
    assert other["identify"].order_ == pipe["identify"].order_
    assert other.score(*rounded) == pytest.approx(pipe.score(u, y), abs=1e-6)


def test_chunks_far_from_the_origin_are_one_record(flown):
    one = flown.inputs.loc[0], flown.outputs.loc[0]
    u, y = (moved(data, UNIX, 2 * np.pi / flown.omega) for data in one)
    frame = HarmonicAnalyzer(flown.omega, output_harmonics=KEPT).fit(u, y).transform(u)
    chunked = MOESPRegressor(order=8)
    for k in range(0, len(u), 777):
        chunked.partial_fit(frame.iloc[k : k + 777], y.iloc[k : k + 777])
    whole = MOESPRegressor(order=8).fit(frame, y)
    assert chunked.score(frame, y) == pytest.approx(whole.score(frame, y), abs=1e-7)
    with pytest.raises(
        ValueError, match=r"begins at t = \d{10}\.\d{3} s, .* \(t = \d{10}\.\d{3} s\)"
    ):
        chunked.partial_fit(frame.iloc[:777], y.iloc[:777])


def test_blocks_and_trim_far_from_the_origin(flown):
    period = 2 * np.pi / flown.omega
    u = flown.inputs.loc[0]
    late = moved(u, UNIX, period)
    folds = PeriodBlockSplit(4, omega=flown.omega).split(u)
    for here, there in zip(folds, PeriodBlockSplit(4, omega=flown.omega).split(late), strict=True):
        assert [a.tolist() for a in here] == [a.tolist() for a in there]
    trims = []
    for data in (u, late):
        span = (data.index[0], data.index[0] + 5 * period)
        analyzer = HarmonicAnalyzer(flown.omega, trim_span=span)
        trims.append(analyzer.fit(data).basis_.input_trim)
    np.testing.assert_array_equal(*trims)


@pytest.mark.parametrize("step", [1e-3, 1e-4, 2e-5])
def test_rounding_of_late_times_is_no_jitter(rng, step):
    """Steps of 20 μs take turns to be 19.8 and 20.0, 1.2 % apart: neither said nor resampled."""
    late = pd.DataFrame({"u": rng.standard_normal(1280)}, index=UNIX + step * np.arange(1280))
    assert read_time(late).jitter == (0.0, 0.0)
    y = 0.5 * late["u"].rename("y")
    model = MOESPRegressor(order=1, feedthrough=True).fit(late, y)
    np.testing.assert_allclose(model.predict(late), y, atol=1e-10)
    omega = 2 * np.pi / (64 * step)
    frame = HarmonicAnalyzer(omega, input_harmonics=1).fit_transform(late)
    assert frame.basis.samples_per_period == 64
    early = late.set_axis(step * np.arange(1280))
    other = HarmonicAnalyzer(omega, input_harmonics=1).fit_transform(early)
    sizes = [np.hypot(each["u_1c"], each["u_1s"]).to_numpy() for each in (frame, other)]
    np.testing.assert_allclose(*sizes, atol=1e-9)


def test_resampling_does_not_depend_on_the_origin_of_time():
    step, omega = 1e-4, 2 * np.pi / 64.3e-4
    t = pd.Index(step * np.arange(2000))
    X = pd.DataFrame({"u": np.cos(omega * t)}, index=t)
    found = []
    for data in (X, moved(X, UNIX, 2 * np.pi / omega)):
        with pytest.warns(
            ResamplingWarning, match="The interpolation error is at most .* 2e-07 of 'u'"
        ):
            found.append(HarmonicAnalyzer(omega, input_harmonics=1).fit_transform(data).to_numpy())
    np.testing.assert_allclose(*found, atol=3e-4)  # the first time is rounded: 1e-4 rad


def test_dates_far_from_their_origin(flown):
    """Dates are whole nanoseconds; seconds since 1970 of them are floats again."""
    u, y = flown.inputs.loc[0], flown.outputs.loc[0]
    dates = pd.to_datetime("2026-05-01") + pd.to_timedelta(u.index, unit="s")
    scores = [
        two_steps(flown.omega, time_origin=origin)
        .fit(u.set_axis(dates), y.set_axis(dates))
        .score(u.set_axis(dates), y.set_axis(dates))
        for origin in ("2026-05-01", "1970-01-01")
    ]
    assert scores[0] > 0.9
    assert scores[1] > 0.9


@pytest.mark.parametrize(
    "reading", [pytest.param("sample", marks=pytest.mark.slow), "period", "sliding"]
)
def test_rows_without_times_are_as_far_apart_as_at_fit(reading):
    """Models of samples are predicted at any clock: 1 s a row was one of them."""
    data = make_flapping_wing("ltp", n_periods=60, start=8)
    X, y = data.inputs, data.outputs
    analyzer = HarmonicAnalyzer(data.omega, reading=reading, trim_span=data.trim_span)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(order=2))]).fit(X, y)
    expected, score = pipe.predict(X).to_numpy(), pipe.score(X, y)
    others = X.reset_index(drop=True), y.reset_index(drop=True)
    with pytest.warns(TimeBaseWarning, match=r"had times at fit.* s apart as at fit"):
        np.testing.assert_allclose(pipe.predict(others[0]), expected, rtol=1e-6, atol=1e-9)
    with pytest.warns(TimeBaseWarning, match="had times at fit"):
        assert pipe.score(*others) == pytest.approx(score)
    names = pytest.warns(UserWarning, match="does not have valid feature names")
    with names, pytest.warns(TimeBaseWarning, match="had times at fit"):
        found = pipe.predict(X.to_numpy())
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


def test_times_in_another_unit_than_at_fit_are_told():
    """Models of samples are predicted at any clock, also at one of 64 turns a row."""
    data = make_flapping_wing("ltp", n_periods=60, start=8)
    X = data.inputs
    analyzer = HarmonicAnalyzer(data.omega, reading="sample", trim_span=data.trim_span).fit(X)
    with pytest.warns(TimeBaseWarning, match=r"15\.6 turns of omega=.* in seconds, as at fit"):
        analyzer.transform(X.set_axis(X.index * 1000))


@pytest.mark.parametrize("other", [0.0201, 0.03])
def test_records_of_other_sample_times_are_told_by_these(other):
    rng = np.random.default_rng(5)
    parts = [
        pd.DataFrame({"u": rng.standard_normal(300)}, dt * np.arange(300)) for dt in (0.02, other)
    ]
    u = pd.concat(dict(enumerate(parts)), names=["record", "time"])
    y = u.rename(columns={"u": "y"}).groupby("record").rolling(3, min_periods=1).mean().droplevel(0)
    with pytest.warns(
        JitterWarning, match=rf"records have sample times of 0\.02 to {other} s: signals"
    ):
        MOESPRegressor(order=2).fit(u, y)
