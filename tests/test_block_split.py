"""Folds of blocks of rows: of frames on both sides of a block, of arrays on one."""

import pickle

import numpy as np
import pandas as pd
import pytest
from law_cases import directions
from scipy.linalg import block_diag
from sklearn.base import clone
from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - makes the next import work
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    HalvingGridSearchCV,
    KFold,
    cross_val_predict,
    cross_val_score,
)
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import TimeBaseWarning
from sklearn_hd.model_selection import (
    BlockSplit,
    PeriodBlockSplit,
    smallest_within_one_standard_error,
)

SLOW = 0.998 * np.array([[np.cos(0.05), -np.sin(0.05)], [np.sin(0.05), np.cos(0.05)]])
TWO_STATES = MOESPRegressor(order=2, block_rows=6)


def ringing(n_rows, noise=0.0, seed=0):
    """Inputs and outputs of an oscillation that outlasts a fold: a joined record jumps."""
    rng = np.random.default_rng(seed)
    u, y, x = rng.standard_normal((n_rows, 1)), np.empty((n_rows, 1)), np.zeros(2)
    for k in range(n_rows):
        y[k], x = x[1], SLOW @ x + [u[k, 0], 0.0]
    return u, y + noise * y.std() * rng.standard_normal(y.shape)


def pairs(folds):
    return [(train.tolist(), test.tolist()) for train, test in folds]


@pytest.mark.parametrize(("n_rows", "n_splits"), [(12, 3), (13, 5), (100, 7), (5, 5)])
def test_of_frames_they_are_the_folds_of_scikit_learn(n_rows, n_splits):
    u = np.zeros((n_rows, 2))
    expected = pairs(KFold(n_splits).split(u))
    dates = pd.date_range("2026-05-01", periods=n_rows, freq="10ms")
    for index in (None, 0.1 * np.arange(n_rows), dates, dates - dates[0]):
        frame = pd.DataFrame(u, index=index)
        assert pairs(BlockSplit(n_splits).split(frame)) == expected
        assert pairs(BlockSplit(n_splits).split(frame[0])) == expected


@pytest.mark.parametrize("gap", [0, 1, 7])
@pytest.mark.parametrize("n_splits", [2, 3, 4, 5])
def test_of_arrays_training_rows_are_consecutive(n_splits, gap):
    u = np.zeros((61, 1))
    split = BlockSplit(n_splits, gap=gap)
    folds = list(split.split(u))
    assert len(folds) == split.get_n_splits() == n_splits
    assert np.concatenate([test for _, test in folds]).tolist() == list(range(61))
    for train, test in folds:
        assert np.all(np.diff(train) == 1)
        sides = max(test[0] - gap, 0), max(60 - test[-1] - gap, 0)
        assert len(train) == max(sides)
        distance = train[0] - test[-1] if train[0] > test[-1] else test[0] - train[-1]
        assert distance == gap + 1
    assert pairs(split.split(u.tolist())) == pairs(folds)


@pytest.mark.parametrize("n_rows", [300, 600, 2000])
@pytest.mark.slow
def test_the_hole_of_a_fold_is_not_joined(n_rows):
    """Without noise every fold has the true model; KFold closes an array's hole by a jump."""
    u, y = ringing(n_rows)
    for inputs in (u, pd.DataFrame(u)):
        assert cross_val_score(TWO_STATES, inputs, y, cv=BlockSplit(5)).min() > 1 - 1e-9
    assert cross_val_score(TWO_STATES, pd.DataFrame(u), y, cv=KFold(5)).min() > 1 - 1e-9
    with pytest.warns(TimeBaseWarning, match="joined at 1 place"):
        assert cross_val_score(TWO_STATES, u, y, cv=KFold(5)).min() < 0.9


SHUFFLED = KFold(3, shuffle=True, random_state=0)


@pytest.mark.filterwarnings("ignore:X does not have valid feature names")
@pytest.mark.parametrize(
    "validate",
    [
        lambda u, y: GridSearchCV(TWO_STATES, {"order": [1, 2]}).fit(u, y),
        lambda u, y: GridSearchCV(TWO_STATES, {"order": [1]}, cv=3, n_jobs=1).fit(u.tolist(), y),
        lambda u, y: cross_val_score(make_pipeline(TWO_STATES), u, y, cv=SHUFFLED),
        lambda u, y: cross_val_predict(
            TWO_STATES, u, y, cv=GroupKFold(3), groups=np.arange(400) // 99
        ),
        lambda u, y: cross_val_score(
            GridSearchCV(TWO_STATES, {"order": [2]}, cv=BlockSplit(2)), u, y, cv=KFold(3)
        ),
        lambda u, y: cross_val_score(
            make_pipeline(StandardScaler(), TWO_STATES), pd.DataFrame(u), y, cv=KFold(3)
        ),
        lambda u, y: HalvingGridSearchCV(
            TWO_STATES, {"order": [1, 2]}, cv=BlockSplit(2), min_resources=200, random_state=0
        ).fit(u, y),
    ],
    ids=["search", "list", "shuffled", "groups", "nested", "scaler", "halving"],
)
def test_arrays_whose_rows_a_fold_joins_are_told(validate):
    """Frames, and splits of consecutive rows, raise no warning in all the other tests."""
    u, y = ringing(400)
    with pytest.warns(TimeBaseWarning, match=r"joined at \d+ place.*or give pd.DataFrame\(X\)"):
        validate(u, y)


@pytest.mark.slow
@pytest.mark.parametrize("as_given", [np.asarray, pd.DataFrame])
def test_a_search_over_plain_data_finds_the_order(as_given):
    u, y = ringing(1500, noise=0.02)
    search = GridSearchCV(
        MOESPRegressor(),
        {"order": [1, 2, 3, 4], "block_rows": [6, 10]},
        cv=BlockSplit(5),
        refit=smallest_within_one_standard_error,
    ).fit(as_given(u), as_given(y))
    assert search.best_params_["order"] == 2
    assert abs(np.abs(search.best_estimator_.eigenvalues_) - 0.998).max() < 1e-3


def test_every_record_is_cut_by_itself():
    lengths = {"a": 9, "b": 20, "c": 7}
    parts = {
        name: pd.DataFrame({"u": np.zeros(n)}, index=0.1 * np.arange(n))
        for name, n in lengths.items()
    }
    folds = list(BlockSplit(3, gap=1).split(pd.concat(parts, names=["record", "time"])))
    first = 0
    for part in parts.values():
        for fold, alone in zip(folds, BlockSplit(3, gap=1).split(part), strict=True):
            for rows, own in zip(fold, alone, strict=True):
                mine = rows[(rows >= first) & (rows < first + len(part))]
                assert (mine - first).tolist() == own.tolist()
        first += len(part)


def test_training_rows_begin_new_segments():
    u, y = map(pd.DataFrame, ringing(400))
    records = pd.concat({"a": u, "b": u}), pd.concat({"a": y, "b": y})
    for (X, Y), expected in (((u, y), [1, 2, 2, 1]), (records, [2, 4, 4, 2])):
        found = [
            len(clone(TWO_STATES).fit(X.iloc[train], Y.iloc[train]).x0_)
            for train, _ in BlockSplit(4).split(X)
        ]
        assert found == expected


def test_cross_val_predict_takes_the_splitter():
    u, y = ringing(400)
    predicted = cross_val_predict(TWO_STATES, u, y, cv=BlockSplit(4))
    assert predicted.shape == y.shape
    assert np.isfinite(predicted).all()


def test_splitter_prints_clones_and_pickles():
    split = BlockSplit(3, gap=2)
    assert repr(split) == "BlockSplit(gap=2, n_splits=3)"
    assert clone(GridSearchCV(TWO_STATES, {}, cv=split)).cv.gap == 2
    assert pickle.loads(pickle.dumps(split)).n_splits == 3


@pytest.mark.parametrize("as_given", [np.asarray, pd.DataFrame])
@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"n_splits": 1}, "n_splits must be a whole number of at least 2, got 1"),
        ({"n_splits": 13}, r"record 0 has 12 row\(s\), too few for n_splits=13 blocks; give long"),
        ({"gap": -1}, "gap must be a whole number of at least 0, got -1.*counts the rows left out"),
        ({"gap": 12}, "gap=12 leaves no row to train on beside block 0 of n_splits=5; give longer"),
    ],
)
def test_splitter_words_what_is_wrong(parameters, message, as_given):
    with pytest.raises(ValueError, match=message):
        list(BlockSplit(**parameters).split(as_given(np.zeros((12, 1)))))
    with pytest.raises(ValueError, match="X is None; BlockSplit reads the times"):
        list(BlockSplit().split(None))


# ---- whole periods of arrays -------------------------------------------------------------------


def test_whole_periods_of_arrays_are_on_one_side_too():
    u = np.zeros((96, 1))
    split = PeriodBlockSplit(3, omega=2 * np.pi, sample_time=1 / 8)
    for train, test in split.split(u):
        assert np.all(np.diff(train) == 1)
        assert train[0] % 8 == test[0] % 8 == 0
    assert [len(train) for train, _ in split.split(u)] == [56, 24, 56]


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.TimeBaseWarning")
@pytest.mark.slow
def test_periods_of_an_array_score_as_those_of_its_frame():
    """Without noise either side has the model that both have."""
    data = make_flapping_wing(
        "ltp", input="3211", width=4, n_periods=120, samples_per_period=16, random_state=0
    )
    u, y, step = data.inputs, data.outputs, data.inputs.index[1]
    pipe = make_pipeline(
        HarmonicAnalyzer(data.omega, output_harmonics=2, reading="period"),
        MOESPRegressor(order=2, block_rows=4),
    )
    scores = cross_val_score(pipe, u, y, cv=PeriodBlockSplit(5, omega=data.omega))
    pipe.set_params(harmonicanalyzer__sample_time=step)
    split = PeriodBlockSplit(5, omega=data.omega, sample_time=step)
    arrays = cross_val_score(pipe, u.to_numpy(), y.to_numpy(), cv=split)
    np.testing.assert_allclose(arrays, scores, atol=1e-6)


def test_the_trim_of_an_array_needs_times_as_the_error_gives_them():
    X = np.zeros((96, 1))
    split = PeriodBlockSplit(3, omega=2 * np.pi, sample_time=1 / 8, trim_span=(0, 3))
    with pytest.raises(
        ValueError, match=r"trim_span=\(0, 3\) stays in the training .* X is an"
    ) as raised:
        list(split.split(X))
    line = str(raised.value).partition("give it times: ")[2].partition(", y the same")[0]
    frame = eval(line, {"pd": pd, "np": np, "X": X})
    assert all(set(range(24)) <= set(train) for train, _ in split.split(frame))


# ---- a law over random systems -----------------------------------------------------------------


def random_record(seed, n_rows=800, noise=0.1):
    """Noisy record of a system of one to five states, whose modes lie apart over the band."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    n_inputs, n_outputs = rng.integers(1, 3, 2)
    angles = 0.2 + 2.6 * (np.arange(n // 2) + rng.uniform(0.25, 0.75, n // 2)) / max(n // 2, 1)
    poles = rng.uniform(0.8, 0.97, n // 2) * np.exp(1j * angles)
    blocks = [[[p.real, p.imag], [-p.imag, p.real]] for p in poles]
    A = block_diag(*blocks, *[[[rng.uniform(0.5, 0.9)]]] * (n % 2))
    B, C = directions(rng, n, n_inputs), directions(rng, n, n_outputs).T
    u = rng.standard_normal((n_rows, n_inputs))
    y = propagate(A, u @ B.T, np.zeros(n)) @ C.T
    return n, u, y + noise * y.std(axis=0) * rng.standard_normal(y.shape)


@pytest.mark.slow
@pytest.mark.parametrize("as_given", [np.asarray, pd.DataFrame])
@pytest.mark.parametrize("seed", range(20))
def test_a_search_finds_the_order_of_random_systems(seed, as_given):
    order, u, y = random_record(seed)
    search = GridSearchCV(
        MOESPRegressor(block_rows=10),
        {"order": range(1, 8)},
        cv=BlockSplit(5),
        refit=smallest_within_one_standard_error,
    ).fit(as_given(u), as_given(y))
    assert search.best_params_ == {"order": order}


def test_a_table_without_times_is_cut_as_an_array_is():
    """Polars keeps no index: rows from both sides of a block would close up."""
    polars = pytest.importorskip("polars")
    u, y = ringing(300)
    X, Y = polars.DataFrame(u, schema=["u"]), polars.DataFrame(y, schema=["y"])
    folds = zip(BlockSplit(3).split(X), BlockSplit(3).split(u), strict=True)
    for (train, _), (as_array, _) in folds:
        np.testing.assert_array_equal(train, as_array)
    with pytest.warns(TimeBaseWarning, match=r"joined at 1 place\(s\)"):
        cross_val_score(TWO_STATES, X, Y, cv=KFold(3))
