"""MOESPRegressor on dask DataFrames: the model of a single process, and no data moved."""

import os
import pickle
import re
import signal
import sys

import joblib
import numpy as np
import pandas as pd
import pytest
from conftest import random_stable
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd._identify.partitions import Partitions, _partition
from sklearn_hd._readings import PlainReading
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.exceptions import ExcitationWarning

dask = pytest.importorskip("dask")
dd = pytest.importorskip("dask.dataframe")
pytestmark = pytest.mark.usefixtures("synchronous_dask")

STEP = 0.1


def response(rng, n_rows, noise=0.05, *, n=4, m=2, n_outputs=3, radius=0.9):
    """Inputs and outputs of a random model, on an index of seconds."""
    A, B, C = random_stable(rng, n, m, n_outputs, radius=radius)
    u = rng.standard_normal((n_rows, m))
    y = propagate(A, u @ B.T, rng.standard_normal(n)) @ C.T
    y = y + noise * np.std(y, axis=0) * rng.standard_normal(y.shape)
    t = pd.Index(np.arange(n_rows) * STEP, name="time")
    X = pd.DataFrame(u, index=t, columns=[f"u{c}" for c in range(m)])
    return X, pd.DataFrame(y, index=t, columns=[f"y{c}" for c in range(n_outputs)])


def cut(frame, edges, loads=None):
    """A dask DataFrame of consecutive rows; what is read is noted."""
    bounds = [0, *edges, len(frame)]

    def load(k):
        if loads is not None:
            loads.append(k)
        return frame.iloc[bounds[k] : bounds[k + 1]]

    return dd.from_map(load, range(len(edges) + 1), meta=frame.iloc[:0])


def in_records(X, y, lengths, dropped=()):
    """The same rows as records of some lengths, with gaps where rows are dropped."""
    label = np.repeat([f"flight {r}" for r in range(len(lengths))], lengths)
    time = np.concatenate([np.arange(n) * STEP for n in lengths])
    index = pd.MultiIndex.from_arrays([label, time], names=["record", "time"])
    keep = np.setdiff1d(np.arange(len(X)), dropped)
    return X.set_axis(index).iloc[keep], y.set_axis(index).iloc[keep]


def assert_same_model(found, expected, rtol=1e-10):
    assert found.order_ == expected.order_
    assert found.block_rows_ == expected.block_rows_
    here, there = found.model_, expected.model_
    gain = np.linalg.norm(there.C) * np.linalg.norm(there.B)
    for name, size in (("A", 1.0), ("B", None), ("C", None), ("D", gain)):
        a, b = getattr(here, name), getattr(there, name)
        np.testing.assert_allclose(a, b, rtol=0, atol=rtol * (size or np.abs(b).max()))
    assert found.x0_.shape == expected.x0_.shape
    np.testing.assert_allclose(found.x0_, expected.x0_, atol=rtol * np.abs(expected.x0_).max())
    values = expected.singular_values_
    np.testing.assert_allclose(found.singular_values_, values, rtol=0, atol=rtol * values[0])
    assert here.dt == pytest.approx(there.dt, rel=1e-10)
    assert (here.input_names, here.output_names) == (there.input_names, there.output_names)


def both(X, y, edges, **parameters):
    """Fitted on partitions, and in memory."""
    return (
        MOESPRegressor(**parameters).fit(cut(X, edges), cut(y, edges)),
        MOESPRegressor(**parameters).fit(X, y),
    )


# ---- the same model ------------------------------------------------------------------------


@pytest.mark.parametrize("edges", [[], [700], [3, 4, 200, 230, 900]], ids=str)
@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("noise", [0.0, 1e-6, 0.05])
def test_partitioned_by_time(rng, noise, feedthrough, edges):
    X, y = response(rng, 1500, noise)
    assert_same_model(*both(X, y, edges, feedthrough=feedthrough))


@pytest.mark.filterwarnings("ignore:the model is unstable")
@pytest.mark.parametrize("seed", range(8))
def test_records_gaps_and_partitions_anywhere(seed):
    """Partitions empty or of one row, short records, unstable models, with noise or without."""
    rng = np.random.default_rng(seed)
    lengths = [600, *rng.integers(2, 300, rng.integers(0, 5))]
    n, m, n_outputs = rng.integers(1, 6), rng.integers(1, 3), rng.integers(1, 4)
    noise, radius = rng.choice([0.0, 1e-4, 0.05]), rng.choice([0.5, 0.95, 1.002])
    X, y = response(rng, sum(lengths), noise, n=n, m=m, n_outputs=n_outputs, radius=radius)
    X, y = in_records(X, y, lengths, dropped=rng.choice(sum(lengths), 2))
    edges = sorted(rng.integers(0, len(X) + 1, rng.integers(1, 12)).tolist())
    feedthrough = bool(rng.integers(2))
    assert_same_model(*both(X, y, [0, *edges], order=int(n), feedthrough=feedthrough))


def test_partitions_shorter_than_a_window(rng):
    X, y = response(rng, 210)
    assert_same_model(*both(X, y, list(range(7, 210, 7)), block_rows=8))


def test_the_hard_case(rng):
    """Low-pass inputs, two modes near one: what takes exact sums takes them here as well."""
    X, y = response(rng, 6000, 0.0, radius=0.98)
    X = X.rolling(40, min_periods=1).mean()
    A, B, C = random_stable(rng, 4, 2, 3, radius=0.99)
    y[:] = propagate(A, X.to_numpy() @ B.T, rng.standard_normal(4)) @ C.T
    loads = []
    expected = MOESPRegressor(4).fit(X, y)
    edges = [1000, 2500, 4000]
    found = MOESPRegressor(4).fit(cut(X, edges, loads), cut(y, edges))
    assert_same_model(found, expected, rtol=1e-9)
    assert sorted(loads) == [0, 1, 2, 3]


def test_data_are_read_once(rng):
    X, y = response(rng, 1200)
    loads = []
    MOESPRegressor().fit(cut(X, [300, 700], loads), cut(y, [300, 700]))
    assert sorted(loads) == [0, 1, 2]


@pytest.mark.parametrize(
    "parameters", [{"order": 3, "block_rows": 6}, {"scale": False}, {"block_rows": 30}], ids=str
)
def test_parameters_mean_the_same(rng, parameters):
    X, y = response(rng, 900)
    assert_same_model(*both(X, 1e3 * y, [100, 500], **parameters))


def test_default_block_rows_shrink_with_few_rows(rng):
    X, y = response(rng, 110)
    found, expected = both(X, y, [50])
    assert expected.block_rows_ < 15
    assert_same_model(found, expected)


@pytest.mark.parametrize(
    "index",
    [
        pd.RangeIndex(900),
        pd.to_timedelta(np.arange(900) * 20, unit="ms"),
        pd.date_range("2024-03-30 23:59:50", periods=900, freq="20ms"),
    ],
    ids=["counted", "timedelta", "dates"],
)
def test_every_kind_of_time(rng, index):
    X, y = response(rng, 900)
    X.index = y.index = index
    assert_same_model(*both(X, y, [100, 500]))


def test_partitions_of_unix_seconds_follow_on_one_another(rng):
    """Floats there are 1.2 % of this step apart."""
    X, y = response(rng, 900)
    X.index = y.index = 1.7e9 + 2e-5 * np.arange(900)
    found, expected = both(X, y, [100, 500])
    np.testing.assert_allclose(found.model_.A, expected.model_.A, atol=1e-10)
    assert found.model_.dt == pytest.approx(2e-5, rel=1e-6)


def test_what_pandas_and_dask_make_of_parquet(rng, tmp_path):
    X, y = in_records(*response(rng, 1000), [400, 350, 250])
    for label, record in X.join(y).groupby("record"):
        record.to_parquet(tmp_path / f"{label}.parquet")
    data = dd.from_map(pd.read_parquet, sorted(tmp_path.glob("*.parquet")))
    found = MOESPRegressor().fit(data[list(X)], data[list(y)])
    assert_same_model(found, MOESPRegressor().fit(X, y))


def test_records_named_in_a_column(rng):
    X, y = in_records(*response(rng, 1000), [400, 350, 250])
    data = cut(X.join(y).reset_index(), [300, 800])
    data = data.map_partitions(pd.DataFrame.set_index, ["record", "time"])
    found = MOESPRegressor().fit(data[list(X)], data[list(y)])
    assert_same_model(found, MOESPRegressor().fit(X, y))


def test_a_series_of_outputs(rng):
    X, y = response(rng, 800, n_outputs=1)
    expected = MOESPRegressor(4).fit(X, y["y0"])
    found = MOESPRegressor(4).fit(cut(X, [300]), cut(y, [300])["y0"])
    assert_same_model(found, expected)
    pd.testing.assert_series_equal(found.predict(X), expected.predict(X), rtol=1e-9)


def test_what_comes_after_is_in_memory(rng):
    X, y = response(rng, 1200)
    found, expected = both(X, y, [300, 700])
    assert found.n_features_in_ == 2
    assert list(found.feature_names_in_) == ["u0", "u1"]
    pd.testing.assert_frame_equal(found.predict(X), expected.predict(X), rtol=1e-9)
    assert found.score(X, y) == pytest.approx(expected.score(X, y), rel=1e-12)
    again = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(again.model_.A, found.model_.A)
    assert not hasattr(clone(found), "model_")
    reduced = SpuriousModeReducer().fit(found.transform(X), y)
    assert reduced.system_.nstates == found.order_


def test_what_is_moved_does_not_grow_with_the_rows(rng):
    sizes = []
    for n_rows in (20_000, 60_000):
        X, y = response(rng, n_rows)
        sizes.append(len(pickle.dumps(_partition(0, X, y, PlainReading(), n_lags=30))))
    assert sizes[0] == pytest.approx(sizes[1], rel=1e-3)
    assert sizes[1] < 0.3 * (X.size + y.size) * 8


def test_merging_is_a_tree(rng):
    X, y = response(rng, 1200)
    edges = list(range(50, 1200, 50))
    data = Partitions(cut(X, edges), cut(y, edges), lambda basis: 5)
    assert data.lengths == [1200]
    assert len(data.found.statistics.open) == 1
    assert data.found.statistics.closed is None
    assert data.found.last.partition == 23


# ---- bad input -----------------------------------------------------------------------------


def fit_error(X, y, kind=ValueError):
    with pytest.raises(kind) as raised:
        MOESPRegressor().fit(X, y)
    return str(raised.value)


def test_dask_not_installed(rng, monkeypatch):
    X, y = response(rng, 100)
    X, y = cut(X, [50]), cut(y, [50])
    monkeypatch.setitem(sys.modules, "dask", None)
    assert 'pip install "sklearn_hd[dask]"' in fit_error(X, y, ImportError)


def test_one_of_both_in_memory(rng):
    X, y = response(rng, 100)
    assert "y is a DataFrame in memory" in fit_error(cut(X, [50]), y, TypeError)
    assert "X is a ndarray in memory" in fit_error(X.to_numpy(), cut(y, [50]), TypeError)


def test_other_collections(rng):
    X, y = response(rng, 100)
    array = cut(X, [50]).to_dask_array(lengths=True)
    assert "X is a dask Array, which has no index" in fit_error(array, cut(y, [50]), TypeError)


def test_other_partitions(rng):
    X, y = response(rng, 100)
    words = fit_error(cut(X, [50]), cut(y, [50, 70]))
    assert "X has 2 partitions and y has 3: they must match one to one" in words
    words = fit_error(cut(X, []), cut(y.iloc[:99], []))
    assert words.startswith("partition 0: X has 100 rows and y has 99")
    words = fit_error(cut(X, []), cut(y.set_axis(y.index + 5.0), []))
    assert words.startswith("partition 0: X and y have different indices")


def test_missing_values_name_the_partition(rng):
    X, y = response(rng, 100)
    y.iloc[72, 1] = np.nan
    words = fit_error(cut(X, [50]), cut(y, [50]))
    assert words.startswith("partition 1: y contains NaN: column 'y1', first at t = 7.2 s (row 22)")


def test_other_columns(rng):
    X, y = response(rng, 200)
    parts = [X.iloc[:100], X.iloc[100:][["u1", "u0"]]]
    mixed = dd.from_map(lambda k: parts[k], range(2), meta=X.iloc[:0], enforce_metadata=False)
    words = fit_error(mixed, cut(y, [100]))
    assert (
        "partition 1 of X has the columns ['u1', 'u0'], those before it have ['u0', 'u1']" in words
    )


def test_other_sample_times(rng):
    X, y = in_records(*response(rng, 200), [100, 100])
    time = X.index.get_level_values(1) * np.repeat([1.0, 1.5], 100)
    X.index = y.index = pd.MultiIndex.from_arrays([X.index.get_level_values(0), time])
    assert "have sample times from 0.1 s to 0.15 s" in fit_error(cut(X, [100]), cut(y, [100]))


def test_time_that_does_not_increase(rng):
    X, y = response(rng, 200)
    X, y = (pd.concat([each.iloc[100:], each.iloc[:100]]) for each in (X, y))
    words = fit_error(cut(X, [100]), cut(y, [100]))
    assert "time must increase within a record: partition 1 starts at t = 0 s" in words
    assert "ends at t = 19.9 s" in words


def test_a_step_between_partitions_that_is_no_gap(rng):
    X, y = response(rng, 200)
    late = np.where(np.arange(200) < 100, 0.0, 0.4 * STEP)
    X.index = y.index = X.index + late
    words = fit_error(cut(X, [100]), cut(y, [100]))
    assert "1.4 samples of 0.1 s after the end of the partition before" in words


def test_jitter_is_not_resampled(rng):
    X, y = response(rng, 200)
    X.index = y.index = X.index + 0.1 * STEP * rng.uniform(-1.0, 1.0, 200)
    words = fit_error(cut(X, [100]), cut(y, [100]))
    assert re.match(r"partition [01]: the rows are off an even grid of [\d.]+ s by up to", words)


def test_neighbours_of_one_row(rng):
    X, y = response(rng, 200)
    words = fit_error(cut(X, list(range(1, 200))), cut(y, list(range(1, 200))))
    assert "after one of a single row, which gives no sample time" in words


def test_no_rows(rng):
    X, y = response(rng, 100)
    assert "no rows in any partition" in fit_error(cut(X.iloc[:0], [0]), cut(y.iloc[:0], [0]))


def test_too_few_rows(rng):
    X, y = response(rng, 4)
    assert "too few to identify dynamics from 2 input(s)" in fit_error(cut(X, [2]), cut(y, [2]))
    X, y = response(rng, 40)
    with pytest.raises(ValueError, match="too few for block_rows=15"):
        MOESPRegressor(block_rows=15).fit(cut(X, [20]), cut(y, [20]))


def test_signals_at_rest(rng):
    X, y = response(rng, 400)
    X["u1"] = np.where(np.arange(400) < 200, 0.0, 1.0)  # moves between partitions alone
    assert_same_model(*both(X, y, [200], order=4))
    X["u1"] = 1.0
    assert "input 'u1' is constant in the rows from t = 0 s to 39.9 s" in fit_error(
        cut(X, [200]), cut(y, [200])
    )
    assert "all outputs are zero in the rows" in fit_error(cut(X[["u0"]], [9]), cut(0.0 * y, [9]))


def test_poor_excitation(rng):
    X, y = response(rng, 400)
    X["u0"] = np.sin(0.3 * np.arange(400))
    with pytest.warns(ExcitationWarning, match="the inputs in the rows from t = 0 s to 39.9 s"):
        MOESPRegressor(4).fit(cut(X, [200]), cut(y, [200]))


def test_overflow_in_a_partition(rng):
    X, y = response(rng, 400)
    assert "too large to be squared" in fit_error(cut(X, [100]), cut(1e210 * y, [100]))


def test_what_reads_no_partitions(rng):
    X, y = response(rng, 400)
    found = MOESPRegressor().fit(cut(X, [100]), cut(y, [100]))
    words = r"X is a dask DataFrame, which only MOESPRegressor.fit accepts; load one record"
    for use in (found.predict, found.transform, lambda X: found.score(X, y)):
        with pytest.raises(TypeError, match=words):
            use(cut(X, [100]))
    with pytest.raises(TypeError, match=words):
        HarmonicAnalyzer(1.0).fit(cut(X, [100]), y)


# ---- clusters ------------------------------------------------------------------------------


@pytest.mark.slow  # dask waits for up to half a minute
def test_a_worker_leaves_half_way(rng):
    """With all that it has computed so far."""
    distributed = pytest.importorskip("distributed")
    X, y = response(rng, 1600)
    expected = MOESPRegressor(4).fit(X, y)

    class Leave(distributed.SchedulerPlugin):
        done, left = 0, False

        def transition(self, key, start, finish, *args, **kwargs):
            self.done += finish == "memory"
            if self.done == 10 and not self.left:
                self.left = True
                worker = cluster.workers[0]
                worker.loop.add_callback(worker.close, executor_wait=False)

    edges = list(range(100, 1600, 100))
    with (
        dask.config.set(scheduler="distributed"),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster),
    ):
        plugin = Leave()
        cluster.scheduler.add_plugin(plugin)
        found = MOESPRegressor(4).fit(cut(X, edges), cut(y, edges))
        assert plugin.left
        assert len(cluster.scheduler.workers) == 1
    assert_same_model(found, expected)


@pytest.mark.slow
def test_a_worker_process_is_killed(rng, tmp_path):
    distributed = pytest.importorskip("distributed")
    X, y = in_records(*response(rng, 1600), [200] * 8)
    expected = MOESPRegressor(4).fit(X, y)
    flag, data = tmp_path / "killed", X.join(y)

    def load(k, columns):
        if k == 3 and not flag.exists():
            flag.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return data.iloc[200 * k : 200 * (k + 1)][columns]

    parts = [dd.from_map(load, range(8), columns=list(z), meta=z.iloc[:0]) for z in (X, y)]
    with (
        dask.config.set(scheduler="distributed"),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs="CRITICAL"
        ) as cluster,
        distributed.Client(cluster),
    ):
        found = MOESPRegressor(4).fit(*parts)
    assert flag.exists()
    assert_same_model(found, expected)


def test_grid_search_on_a_cluster(rng):
    distributed = pytest.importorskip("distributed")
    X, y = response(rng, 600)
    search = GridSearchCV(MOESPRegressor(block_rows=6), {"order": [2, 4]}, cv=TimeSeriesSplit(2))
    expected = clone(search).fit(X, y)
    with (
        distributed.LocalCluster(n_workers=2, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):
        search.fit(X, y)
    assert search.best_params_ == expected.best_params_
    scores = [each.cv_results_["mean_test_score"] for each in (search, expected)]
    np.testing.assert_allclose(*scores, rtol=1e-12)


def test_an_error_in_the_users_graph_comes_through_at_once(rng):
    """An AttributeError, too, which Python asks again for where attributes are looked up."""
    t, called = np.arange(60) * 0.1, []
    u, y = (pd.DataFrame({name: rng.standard_normal(60)}, index=t) for name in "uy")

    def broken(part):
        called.append(len(part))
        return part.nope

    X = dd.from_pandas(u, npartitions=2)
    X = X.map_partitions(broken, meta=X._meta)
    with dask.config.set(scheduler="synchronous"), pytest.raises(AttributeError, match="nope"):
        MOESPRegressor(1).fit(X, dd.from_pandas(y, npartitions=2))
    assert len(called) == 1
