"""MOESPRegressor on dask DataFrames whose partitions are read through a sliding window."""

import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import make_pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd._identify import sliding
from sklearn_hd.algorithms.subspace import hankel
from sklearn_hd.datasets import make_flapping_wing

dask = pytest.importorskip("dask")
dd = pytest.importorskip("dask.dataframe")
pytestmark = pytest.mark.usefixtures("synchronous_dask")

KEPT = {"w": [0], "phi_dot": [1]}
PARTITIONS = [[0, 1], [2], [3]]  # records in each


def flights(**options):
    return make_flapping_wing("ltp", n_records=4, random_state=1, snr=50, **options)


@pytest.fixture(scope="module")
def steady():
    """Inputs that move all the time."""
    return flights(n_periods=60, input="multisine", samples_per_period=32)


@pytest.fixture(scope="module")
def doublets():
    """Inputs that change at several phases of the period."""
    return flights(width=7.3)


def analyzed(data, **options):
    hop = round(2.0 * np.pi / data.omega / data.sample_time) // 8
    analyzer = HarmonicAnalyzer(data.omega, output_harmonics=KEPT, **({"hop": hop} | options))
    return analyzer, analyzer.fit_transform(data.inputs, data.outputs)


def by_record(frame, partitions=PARTITIONS):
    records = frame.index.get_level_values("record")
    parts = [frame[records.isin(labels)] for labels in partitions]
    return dd.from_map(lambda k: parts[k], range(len(parts)), meta=frame.iloc[:0])


def through_window(data, analyzer, frame, partitions=PARTITIONS):
    X = by_record(data.inputs, partitions)
    return X.map_partitions(analyzer.transform, meta=frame.iloc[:0])


def assert_same_simulation(found, expected, frame, rtol=1e-10):
    assert found.order_ == expected.order_
    assert found.block_rows_ == expected.block_rows_
    values = expected.singular_values_
    np.testing.assert_allclose(found.singular_values_, values, rtol=0, atol=rtol * values[0])
    here, there = (each.predict(frame, x0=each.x0_) for each in (found, expected))
    for name in there:
        np.testing.assert_allclose(here[name], there[name], atol=rtol * np.abs(there[name]).max())


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [{"order": 10, "block_rows": 20}, {}], ids=str)
def test_partitions_of_whole_records(steady, parameters):
    analyzer, frame = analyzed(steady)
    X = through_window(steady, analyzer, frame)
    found = MOESPRegressor(**parameters).fit(X, by_record(steady.outputs))
    expected = MOESPRegressor(**parameters).fit(frame, steady.outputs)
    assert_same_simulation(found, expected, frame)
    assert found.model_.windowed
    assert found.model_.output_names == expected.model_.output_names
    if parameters:
        reduced = SpuriousModeReducer().fit(found.transform(frame), steady.outputs)
        assert reduced.n_states_ >= 2


@pytest.mark.parametrize("scale", [True, False])
@pytest.mark.slow
def test_inputs_that_change_at_several_phases(doublets, monkeypatch, scale):
    """Most directions of such inputs are rounding, which is never the same: far below noise."""
    monkeypatch.setattr(hankel, "FEW_COLUMNS", 0)  # by exact sums
    analyzer, frame = analyzed(doublets)
    X = through_window(doublets, analyzer, frame, [[0, 1, 2], [3]])
    y = by_record(doublets.outputs, [[0, 1, 2], [3]])
    estimator = MOESPRegressor(8, block_rows=20, scale=scale)
    found, expected = estimator.fit(X, y), MOESPRegressor(**estimator.get_params())
    assert_same_simulation(found, expected.fit(frame, doublets.outputs), frame, rtol=1e-5)


@pytest.mark.slow
def test_more_block_rows_where_the_order_fills_them(steady, monkeypatch):
    """Asked for once; the data are read again for them."""
    asked = []

    def once(decomposition, data, settings):
        asked.append(data)
        return sum(each is data for each in asked) == 1

    monkeypatch.setattr(sliding, "_fills_its_rank", once)
    analyzer, frame = analyzed(steady)
    found = MOESPRegressor().fit(through_window(steady, analyzer, frame), by_record(steady.outputs))
    expected = MOESPRegressor().fit(frame, steady.outputs)
    assert found.block_rows_ == 27
    assert_same_simulation(found, expected, frame, rtol=1e-8)


def fit_error(X, y, **parameters):
    with pytest.raises(ValueError) as raised:  # noqa: PT011 - each caller looks at the words
        MOESPRegressor(**parameters).fit(X, y)
    return str(raised.value)


def test_records_may_not_be_split(steady):
    _, frame = analyzed(steady)
    parts = [frame.iloc[:2500], frame.iloc[2500:]]
    X = dd.from_map(lambda k: parts[k], range(2), meta=frame.iloc[:0])
    outputs = [steady.outputs.iloc[:2500], steady.outputs.iloc[2500:]]
    y = dd.from_map(lambda k: outputs[k], range(2), meta=steady.outputs.iloc[:0])
    words = fit_error(X, y)
    assert "inside record 1, but rows read through a window depend on the rows before" in words


def test_a_basis_that_the_graph_does_not_know(steady):
    analyzer, frame = analyzed(steady)
    X = by_record(steady.inputs, [[0, 1, 2, 3]])
    X = X.map_partitions(analyzer.transform, meta=pd.DataFrame(frame.iloc[:0]))
    words = fit_error(X, by_record(steady.outputs, [[0, 1, 2, 3]]))
    assert "partition 0: its frame carries a harmonic basis, but X had none when" in words
    assert "meta=analyzer.transform(u).iloc[:0]" in words


def test_a_mended_frame_without_values_takes_the_place_of_a_wrong_one(steady):
    """dask takes collections for the same whose parts look alike; the wrong one is alive here."""
    analyzer, frame = analyzed(steady)
    raw = by_record(steady.inputs, [[0, 1, 2, 3]])
    y = by_record(steady.outputs, [[0, 1, 2, 3]])
    wrong = raw.map_partitions(analyzer.transform, meta=pd.DataFrame(frame.iloc[:0]))
    assert "give the analyzer's frame as meta" in fit_error(wrong, y)
    mended = raw.map_partitions(analyzer.transform, meta=frame.iloc[:0])
    assert mended._meta.basis is not None
    _, elsewhere = analyzed(steady, hop=8)
    tokens = {dask.base.tokenize(each.iloc[:0]) for each in (frame, elsewhere, pd.DataFrame(frame))}
    assert len(tokens) == 3
    assert dask.base.tokenize(frame) == dask.base.tokenize(analyzer.transform(steady.inputs))


def test_other_analyses(steady):
    _, frame = analyzed(steady)
    other, _ = analyzed(steady, hop=8)
    X = through_window(steady, other, frame, [[0, 1, 2, 3]])
    y = by_record(steady.outputs, [[0, 1, 2, 3]])
    assert "it was analysed with hop=8, others with 4; fit one" in fit_error(X, y)
    synchronous, frame = analyzed(steady, reading="period", hop=None)
    X = through_window(steady, synchronous, frame)
    assert "X was analysed with reading='period', which needs all records" in fit_error(X, y)


def test_outputs_are_given_in_time(steady):
    analyzer, frame = analyzed(steady)
    X = through_window(steady, analyzer, frame, [[0, 1, 2, 3]])
    words = fit_error(X, X)
    assert "partition 0: y is a frame of harmonics; give it in time" in words


def test_a_pipeline_takes_partitions_at_its_end_alone(steady):
    analyzer, _ = analyzed(steady)
    X, y = by_record(steady.inputs), by_record(steady.outputs)
    with pytest.raises(TypeError, match=r"X is a dask DataFrame, which only MOESPRegressor\.fit"):
        make_pipeline(analyzer, MOESPRegressor()).fit(X, y)
