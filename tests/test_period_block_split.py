"""Folds of whole periods, by ω, by dates or by a measured azimuth."""

import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV

from sklearn_hd import MOESPRegressor
from sklearn_hd.model_selection import PeriodBlockSplit

SPP = 8
OMEGA = 2 * np.pi  # one period a second


def record(n_periods, *, first=0, spp=SPP):
    """Rows of some periods of OMEGA, the first of them sample ``first``."""
    time = (first + np.arange(n_periods * spp)) / spp
    return pd.DataFrame({"u": np.sin(time)}, index=pd.Index(time, name="time"))


def periods(data, rows, omega=OMEGA):
    """Number of the period of some rows."""
    return np.floor(data.index.get_level_values(-1)[rows] * omega / (2 * np.pi) + 1e-9).astype(int)


@pytest.mark.parametrize("first", [0, 3, -21])
@pytest.mark.parametrize(("n_splits", "gap"), [(2, 0), (3, 1), (5, 2)])
def test_blocks_are_whole_periods_and_test_every_row_once(n_splits, gap, first):
    data = record(17, first=first)
    split = PeriodBlockSplit(n_splits, omega=OMEGA, gap=gap)
    folds = list(split.split(data))
    assert len(folds) == split.get_n_splits() == n_splits
    tested = np.concatenate([test for _, test in folds])
    np.testing.assert_array_equal(tested, np.arange(len(data)))
    borders = [test[0] for _, test in folds[1:]]
    assert not np.any((first + np.array(borders)) % SPP)  # ψ = 0, wherever the record begins
    for train, test in folds:
        for rows in (train, test):
            assert np.all(np.diff(rows) > 0)
        p_test, p_train = periods(data, test), periods(data, train)
        distance = np.where(p_train < p_test[0], p_test[0] - p_train, p_train - p_test[-1])
        assert distance.min() == gap + 1
        left_out = len(data) - len(train) - len(test)
        sides = int(test[0] > 0) + int(test[-1] < len(data) - 1)
        assert left_out == sides * gap * SPP
    sizes = [len(np.unique(periods(data, test))) for _, test in folds]
    assert max(sizes) - min(sizes) <= 2  # whole periods shared evenly; ends may add an incomplete


def test_period_borders_survive_times_that_are_not_exact():
    """Hawkmoth's ω, a late start and rounded times: borders fall on the sample of ψ = 0."""
    omega = 2 * np.pi * 26.3
    dt = 2 * np.pi / omega / 64
    time = np.round(dt * np.arange(640_000, 640_000 + 64 * 30), 9)
    data = pd.DataFrame({"u": time}, index=time)
    for _, test in PeriodBlockSplit(5, omega=omega).split(data):
        assert test[0] % 64 == 0
        assert len(test) == 64 * 6


def test_timedeltas_are_seconds_and_arrays_count_samples():
    data = record(12)
    expected = list(PeriodBlockSplit(3, omega=OMEGA).split(data))
    moments = data.set_axis(pd.to_timedelta(data.index, unit="s"))
    for X in (moments, data["u"]):
        for found, fold in zip(PeriodBlockSplit(3, omega=OMEGA).split(X), expected, strict=True):
            for rows, rows_0 in zip(found, fold, strict=True):
                np.testing.assert_array_equal(rows, rows_0)
    counted = PeriodBlockSplit(3, omega=OMEGA, sample_time=1 / SPP).split(data.to_numpy())
    for (train, test), (train_0, test_0) in zip(counted, expected, strict=True):
        np.testing.assert_array_equal(test, test_0)
        sides = np.split(train_0, np.flatnonzero(np.diff(train_0) > 1) + 1)
        np.testing.assert_array_equal(train, max(sides, key=len))  # one side of the hole


def test_dates_count_from_their_origin():
    data = record(12, first=3)
    expected = list(PeriodBlockSplit(3, omega=OMEGA, trim_span=(1, 3)).split(data))
    origin = pd.Timestamp("2026-05-01 12:00", tz="UTC")
    dated = data.set_axis(origin + pd.to_timedelta(data.index, unit="s"))
    split = PeriodBlockSplit(3, omega=OMEGA, trim_span=(1, 3), time_origin=origin)
    for found, (train, test) in zip(split.split(dated), expected, strict=True):
        np.testing.assert_array_equal(found[0], train)
        np.testing.assert_array_equal(found[1], test)
    with pytest.raises(
        ValueError, match=r"index holds dates, which do not define the azimuth; .*PeriodBlock"
    ):
        list(PeriodBlockSplit(3, omega=OMEGA).split(dated))


@pytest.mark.parametrize("wrapped", [False, True])
def test_blocks_of_a_rotor_whose_speed_varies(wrapped):
    """Whole turns by the azimuth, of 76 rows at first and 54 at last, missing instants or not."""
    time = np.arange(64 * 24) / 64
    psi = OMEGA * (0.85 * time + 0.3 * time**2 / 48) + 0.2
    data = pd.DataFrame({"u": np.sin(time), "psi": psi % OMEGA if wrapped else psi}, index=time)
    data.iloc[200:203, 1] = np.nan
    data.iloc[500:510, 0] = np.nan  # what the analyzer's missing= is for
    hole = data.drop(data.index[800:1000])
    for given, own in ((data, psi), (hole, np.delete(psi, slice(800, 1000)))):
        folds = list(PeriodBlockSplit(4, azimuth="psi", gap=1).split(given))
        assert np.concatenate([test for _, test in folds]).tolist() == list(range(len(given)))
        turns = own / (2 * np.pi)
        for train, test in folds:
            if test[0] > 0:
                assert turns[test[0]] % 1 < 1.2 / 54  # a block begins with a turn
            beyond = np.maximum(
                np.floor(turns[test[0]]) - turns[train], turns[train] - np.ceil(turns[test[-1]])
            )
            assert beyond.min() > 1 - 2 / 54
    by_speed = PeriodBlockSplit(4, omega=OMEGA).split(data)
    starts = np.array([psi[test[0]] / (2 * np.pi) % 1 for _, test in list(by_speed)[1:]])
    assert np.all((starts > 0.03) & (starts < 0.97))  # which the mean speed does not find


def test_every_record_is_cut_by_itself():
    parts = {"a": record(9), "b": record(12), "c": record(7)}
    data = pd.concat(parts, names=["record"])
    folds = list(PeriodBlockSplit(3, omega=OMEGA).split(data))
    starts = {"a": 0, "b": 9 * SPP, "c": 21 * SPP}
    for name, part in parts.items():
        alone = PeriodBlockSplit(3, omega=OMEGA).split(part)
        for (train, test), (train_0, test_0) in zip(folds, alone, strict=True):
            mine = slice(starts[name], starts[name] + len(part))
            for rows, own in ((train, train_0), (test, test_0)):
                inside = rows[(rows >= mine.start) & (rows < mine.stop)] - mine.start
                np.testing.assert_array_equal(inside, own)


def test_a_hole_in_a_record_does_not_split_it():
    data = record(20)
    holed = data.drop(data.index[5 * SPP + 3 : 7 * SPP + 2])  # periods 5 and 7 incomplete
    folds = list(PeriodBlockSplit(3, omega=OMEGA, gap=1).split(holed))
    np.testing.assert_array_equal(
        np.concatenate([test for _, test in folds]), np.arange(len(holed))
    )
    for train, test in folds:
        assert not set(periods(holed, train)) & set(periods(holed, test))


def test_the_trim_span_is_always_trained_on():
    data = record(24)
    split = PeriodBlockSplit(4, omega=OMEGA, trim_span=(0.0, 4.0))
    for train, test in split.split(data):
        assert set(range(4 * SPP)) <= set(train)
        assert test[0] >= 4 * SPP
        assert len(test) == 5 * SPP


def test_training_rows_begin_new_segments(lti):
    """What the model steps make of a fold: one segment on either side of the hole."""
    split = PeriodBlockSplit(4, omega=lti.omega)
    segments = []
    for train, _ in split.split(lti.inputs):
        model = MOESPRegressor(order=3, block_rows=6)
        model.fit(lti.inputs.iloc[train], lti.outputs.iloc[train])
        segments.append(len(model.x0_))
    assert segments == [1, 2, 2, 1]


def test_splitter_prints_clones_and_pickles(lti):
    split = PeriodBlockSplit(3, omega=OMEGA, gap=2)
    assert repr(split) == (
        "PeriodBlockSplit(azimuth=None, gap=2, n_splits=3, omega=6.283185307179586,\n"
        "         sample_time=None, time_origin=None, trim_span=None)"
    )
    search = GridSearchCV(MOESPRegressor(), {"order": [1]}, cv=split)
    assert clone(search).cv.gap == 2
    assert pickle.loads(pickle.dumps(split)).n_splits == 3


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"n_splits": 1}, "n_splits must be a whole number of at least 2, got 1"),
        ({"n_splits": 2.5}, "n_splits must be a whole number"),
        ({"n_splits": 13}, r"record 0 has 12 whole period\(s\).*too few for n_splits=13 blocks"),
        ({"gap": -1}, "gap must be a whole number of at least 0, got -1"),
        ({"gap": 0.5}, "gap must be a whole number"),
        ({"gap": 12}, "gap=12 leaves no whole period to train on beside block 0 of n_splits=5"),
        ({"omega": 0.0}, "omega must be a positive number in rad/s"),
        ({"omega": 60.0}, "0.8378 samples a period; at least two are needed: correct omega, or"),
        ({"trim_span": (3.0, 1.0)}, r"trim_span=\(3.0, 1.0\) is not a pair of times; give"),
        (
            {"omega": None},
            "omega=None and azimuth=None leave the period unknown; give omega in rad",
        ),
        ({"azimuth": "psi"}, "omega=6.28.* and azimuth='psi' are both given"),
        ({"omega": None, "azimuth": "psi"}, r"azimuth='psi' is not among the columns \['u'\] of X"),
        ({"time_origin": "2026-01-01"}, "time_origin=2026-01-01T00:00:00 is given, but the index"),
        ({"trim_span": 2.0}, "trim_span=2.0 is not a pair of times; give"),
        ({"sample_time": 0.5}, "sample_time=0.5 s, but the rows of the index are 0.125 s apart"),
    ],
)
def test_splitter_words_what_is_wrong(parameters, message):
    with pytest.raises(ValueError, match=message):
        list(PeriodBlockSplit(**{"omega": OMEGA, **parameters}).split(record(12)))


def test_splitter_needs_times_and_names_the_short_record():
    with pytest.raises(ValueError, match="X is None; PeriodBlockSplit reads the times"):
        list(PeriodBlockSplit(omega=OMEGA).split(None))
    data = pd.concat({"long": record(9), "short": record(2)}, names=["record"])
    with pytest.raises(ValueError, match=r"record 'short' has 2 whole period\(s\)"):
        list(PeriodBlockSplit(3, omega=OMEGA).split(data))
    unseen = record(9).assign(psi=np.where(np.arange(9 * SPP) < 9 * SPP - 1, np.nan, 1.0))
    with pytest.raises(
        ValueError, match=r"'psi' shows no motion in record 0: it is known at fewer"
    ):
        list(PeriodBlockSplit(3, azimuth="psi").split(unseen))
