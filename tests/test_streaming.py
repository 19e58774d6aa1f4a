"""partial_fit: chunks give the model of all rows at once, and wrong ones an error."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import random_stable
from scipy import linalg
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.utils.validation import check_is_fitted

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd._identify import plain
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace import innovations, sums
from sklearn_hd.algorithms.subspace.hankel import hankel_factor
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.algorithms.subspace.lag_products import lag_products
from sklearn_hd.algorithms.subspace.projections import observability_subspace, state_matrices
from sklearn_hd.algorithms.subspace.sums import (
    RecordEnds,
    initial_states_of_heads,
    input_matrices_of_factor,
    input_matrices_of_sums,
    row_sums,
)
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning, TimeBaseWarning


def simulated(rng, lengths, n=4, noise=0.01, A=None):
    """Records of a random system, one after the other in a frame."""
    stable, B, C = random_stable(rng, n, 2, 3)
    A = stable if A is None else A
    D, frames = rng.standard_normal((3, 2)), []
    for label, length in enumerate(lengths):
        u = rng.standard_normal((length, 2))
        y = propagate(A, u @ B.T, rng.standard_normal(n)) @ C.T + u @ D.T
        y += noise * rng.standard_normal(y.shape)
        time = 0.1 * np.arange(length)
        index = pd.MultiIndex.from_product([[label], time], names=["record", "time"])
        frames.append(pd.DataFrame(np.hstack([u, y]), index, ["a", "b", "p", "q", "r"]))
    data = pd.concat(frames)
    return data[["a", "b"]], data[["p", "q", "r"]]


def in_chunks(model, X, y, size):
    for k in range(0, len(X), size):
        model.partial_fit(X.iloc[k : k + size], y.iloc[k : k + size])
    return model


def assert_same_model(one, other, tolerance=1e-10):
    for name in "ABCD":
        a, b = (getattr(step.model_, name) for step in (one, other))
        np.testing.assert_allclose(a, b, atol=tolerance * max(np.abs(b).max(initial=0.0), 1e-300))
    np.testing.assert_allclose(one.x0_, other.x0_, atol=tolerance * np.abs(other.x0_).max())


# ---- the law: chunks give what fit gives -----------------------------------------------------


@pytest.mark.parametrize("size", [97, 1000])
@pytest.mark.parametrize("feedthrough", [True, False])
def test_chunks_of_any_size_give_the_model_of_all_rows(rng, size, feedthrough):
    X, y = simulated(rng, [900, 40, 600])  # a chunk may hold the end of one and all of the next
    settings = {"order": 4, "block_rows": 6, "feedthrough": feedthrough}
    whole = MOESPRegressor(**settings).fit(X, y)
    parts = in_chunks(MOESPRegressor(**settings), X, y, size)
    assert_same_model(parts, whole)
    np.testing.assert_allclose(parts.singular_values_, whole.singular_values_, rtol=1e-8)
    np.testing.assert_allclose(parts.predict(X), whole.predict(X), atol=1e-8)


def test_rows_added_up_in_rounds_give_the_same(rng, monkeypatch):
    """Rounds shorter than the record, and responses followed over fewer rows than it has."""
    monkeypatch.setattr(sums, "ROUND", 512)
    monkeypatch.setattr(sums, "REACH", 300)
    X, y = simulated(rng, [2500, 700, 100])
    settings = {"order": 4, "block_rows": 6, "feedthrough": True}
    parts = in_chunks(MOESPRegressor(**settings), X, y, 400)
    assert_same_model(parts, MOESPRegressor(**settings).fit(X, y))


@pytest.mark.parametrize("zone", [None, "Europe/Berlin"])
@pytest.mark.parametrize("records", [[700], [500, 3, 300]], ids=str)
def test_dates_go_on_from_chunk_to_chunk(rng, records, zone):
    X, y = simulated(rng, records)
    X = X.drop(X.index[300:304])
    dates = pd.Timestamp("2026-03-29 00:59:30", tz=zone) + pd.to_timedelta(X.index.levels[1], "s")
    index = X.index.set_levels(dates, level=1)
    index = index.droplevel(0) if len(records) == 1 else index
    X, y = X.set_axis(index), y.loc[X.index].set_axis(index)
    model, whole = (MOESPRegressor(order=4, block_rows=6) for _ in range(2))
    assert_same_model(in_chunks(model, X, y, 130), whole.fit(X, y))
    assert len(whole.x0_) == len(records) + 1


def test_a_gap_ends_a_segment(rng):
    X, y = simulated(rng, [1200])
    X, y = (z.drop(z.index[500:520]) for z in (X, y))
    settings = {"order": 4, "block_rows": 6, "feedthrough": True}
    parts = in_chunks(MOESPRegressor(**settings), X, y, 250)  # the gap lies where chunks meet
    assert parts.x0_.shape == (2, 4)
    assert_same_model(parts, MOESPRegressor(**settings).fit(X, y))


def test_order_and_block_rows_by_default_are_those_of_fit(rng):
    X, y = simulated(rng, [500])
    parts = in_chunks(MOESPRegressor(feedthrough=True), X, y, 170)
    whole = MOESPRegressor(feedthrough=True).fit(X, y)
    assert (parts.order_, parts.block_rows_) == (whole.order_, whole.block_rows_) == (4, 15)
    assert_same_model(parts, whole)


def test_arrays_go_on_where_the_last_chunk_ended(rng):
    X, y = (z.to_numpy() for z in simulated(rng, [800]))
    settings = {"order": 4, "block_rows": 6, "feedthrough": True}
    parts = MOESPRegressor(**settings)
    for rows in np.split(np.arange(800), 4):
        parts.partial_fit(X[rows], y[rows])
    assert parts.x0_.shape == (1, 4)
    assert_same_model(parts, MOESPRegressor(**settings).fit(X, y))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("excitation", "analysis"),
    [
        ("doublet", {"output_harmonics": {"w": [0], "phi_dot": [1]}, "hop": 8}),
        ("multisine", {"output_harmonics": 1, "hop": 16, "window": "hann"}),
        ("multisine", {"output_harmonics": 1, "hop": 8, "window": "centred-boxcar"}),
        ("multisine", {"input_harmonics": 1, "output_harmonics": 1, "hop": 8}),
    ],
)
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ExcitationWarning")
def test_chunks_seen_through_a_sliding_window_give_the_model_of_the_record(excitation, analysis):
    data = make_flapping_wing("ltp", amplitude=0.005, input=excitation, n_periods=80, start=20)
    analyzer = HarmonicAnalyzer(data.omega, trim_span=data.trim_span, **analysis)
    X = analyzer.fit(data.inputs, data.outputs).transform(data.inputs)
    settings = {"order": 6, "block_rows": 18}
    whole, parts = (MOESPRegressor(**settings) for _ in range(2))
    whole.fit(X, data.outputs)
    for k in range(0, len(X), 1290):  # in the midst of a period
        chunk = analyzer.transform(data.inputs.iloc[k : k + 1290])
        parts.partial_fit(chunk, data.outputs.iloc[k : k + 1290])
    assert_same_model(parts, whole, 1e-8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* within trim_span=")
def test_arrays_go_on_in_the_phase_of_their_trim(rng):
    """Chunks of other than whole periods."""
    X, y = (frame.to_numpy() for frame in simulated(rng, [1500]))
    X = np.repeat(X[:150], 10, axis=0)
    y = y + 3.0 * np.cos(0.2 * np.pi * np.arange(1500))[:, None]
    settings = {"output_harmonics": 1, "trim_span": (0.0, 20.0), "sample_time": 0.1}
    analyzer = HarmonicAnalyzer(2.0 * np.pi, reading="sliding", **settings)
    whole, parts = (MOESPRegressor(order=4, block_rows=24) for _ in range(2))
    with pytest.warns(TimeBaseWarning, match="rows count as samples"):
        analyzer.fit(X, y)
    whole.fit(analyzer.transform(X), y)
    for k in range(0, 1500, 335):
        parts.partial_fit(analyzer.transform(X[k : k + 335]), y[k : k + 335])
    assert_same_model(parts, whole)


def test_modes_that_outlast_the_sums_leave_b_and_d_to_the_factor(rng, monkeypatch):
    """An integrator: without noise B and D are those of the system all the same."""
    monkeypatch.setattr(sums, "REACH", 700)
    A = linalg.block_diag(1.0, [[0.6, 0.5], [-0.5, 0.6]], -0.4)
    X, y = simulated(rng, [1500, 900], noise=0.0, A=A)
    settings = {"order": 4, "block_rows": 6, "feedthrough": True}
    parts = in_chunks(MOESPRegressor(**settings), X, y, 500)
    whole = MOESPRegressor(**settings).fit(X, y)
    assert_same_model(parts, whole, 1e-8)


@pytest.mark.filterwarnings("ignore:the model is unstable")
@pytest.mark.parametrize("pole", [1.0, 1.002])
def test_records_shorter_than_the_sums_reach_are_solved_as_by_fit(rng, pole):
    """Offsets and integrators: whatever mode there is, all rows of such records are at hand."""
    A = linalg.block_diag(pole, [[0.6, 0.5], [-0.5, 0.6]], -0.4)
    X, y = simulated(rng, [1500, 5, 900], noise=0.05, A=A)
    settings = {"order": 4, "block_rows": 6, "feedthrough": True}
    parts = in_chunks(MOESPRegressor(**settings), X, y, 500)
    assert_same_model(parts, MOESPRegressor(**settings).fit(X, y))


# ---- what is kept -----------------------------------------------------------------------------


def test_memory_does_not_grow_with_the_record(rng):
    model = MOESPRegressor(order=4, block_rows=5)
    A, B, C = random_stable(rng, 4, 2, 3)
    sizes = []
    for _ in range(6):
        u = rng.standard_normal((20_000, 2))
        model.partial_fit(u, propagate(A, u @ B.T, np.zeros(4)) @ C.T)
        sizes.append(len(pickle.dumps(model)))
    assert sizes[-1] < 1.05 * max(sizes[:2])
    assert sizes[-1] < 2.5 * (20_000 * 5 * 8)


def test_there_is_no_model_before_there_are_rows_enough(rng):
    X, y = simulated(rng, [300])
    model = MOESPRegressor(order=4, block_rows=6)
    model.partial_fit(X.iloc[:20], y.iloc[:20])
    with pytest.raises(NotFittedError):
        check_is_fitted(model)
    model.partial_fit(X.iloc[20:], y.iloc[20:])
    check_is_fitted(model)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model is unstable")
@pytest.mark.filterwarnings("ignore:inputs explain")
@pytest.mark.parametrize("weighting", ["moesp", "pbsid"])
def test_there_is_no_model_before_there_are_rows_enough_for_its_order(rng, weighting):
    """Default block rows shrink with few rows, and so does the rank that they allow."""
    X, y = (frame.iloc[:, :1] for frame in simulated(rng, [600], noise=0.02))
    model, whole = (MOESPRegressor(order=5, weighting=weighting) for _ in range(2))
    assert not hasattr(in_chunks(model, X[:20], y[:20], 10), "model_")
    in_chunks(model, X[20:], y[20:], 10)
    assert len(model.model_.A) == 5
    assert_same_model(model, whole.fit(X, y), 1e-9)


def test_rows_that_have_no_model_are_kept(rng, monkeypatch):
    X, y = simulated(rng, [900])
    settings = {"order": 4, "block_rows": 6, "disturbance_model": True}
    model = MOESPRegressor(**settings).partial_fit(X[:300], y[:300])
    before = model.model_
    with monkeypatch.context() as patch:
        patch.setattr(innovations, "PRECISION", -1.0)  # no predictor is that stable
        with pytest.warns(IdentifiabilityWarning, match="to 59.9 s: no Kalman gain"):
            model.partial_fit(X[300:600], y[300:600])
    assert model.model_ is before
    model.partial_fit(X[600:], y[600:])
    assert_same_model(model, MOESPRegressor(**settings).fit(X, y))


@pytest.mark.parametrize("still", ["a", "p q r"])
def test_signals_at_rest_so_far_are_named(rng, still):
    X, y = simulated(rng, [400])
    rest = X.copy(), y.copy()
    for z in rest:
        z.iloc[:100, z.columns.isin(still.split())] = 0.0
    model = MOESPRegressor(order=4, block_rows=6)
    words = r"the inputs \['a'\] are at rest" if still == "a" else "all outputs are at rest"
    with pytest.warns(ExcitationWarning, match=words):
        model.partial_fit(rest[0].iloc[:100], rest[1].iloc[:100])
    model.partial_fit(rest[0].iloc[100:], rest[1].iloc[100:])
    assert model.order_ == 4


def test_fit_forgets_chunks_and_clones_have_none(rng):
    X, y = simulated(rng, [600])
    model = MOESPRegressor(order=4, block_rows=6).partial_fit(X, y)
    with pytest.raises(NotFittedError):
        check_is_fitted(clone(model))
    model.fit(X.iloc[:300], y.iloc[:300])
    model.partial_fit(X.iloc[300:], y.iloc[300:])
    alone = MOESPRegressor(order=4, block_rows=6).partial_fit(X.iloc[300:], y.iloc[300:])
    assert_same_model(model, alone)


def test_pickled_between_chunks_it_goes_on(rng):
    X, y = simulated(rng, [600])
    model = MOESPRegressor(order=4, block_rows=6).partial_fit(X.iloc[:350], y.iloc[:350])
    model = pickle.loads(pickle.dumps(model)).partial_fit(X.iloc[350:], y.iloc[350:])
    assert_same_model(model, MOESPRegressor(order=4, block_rows=6).fit(X, y))


# ---- wrong chunks -----------------------------------------------------------------------------


def renamed(X, y):
    return X, y.rename(columns={"p": "other"})


def slower(X, y):
    index = pd.MultiIndex.from_product([[0], 60.0 + 0.2 * np.arange(len(X))])
    return X.set_axis(index), y.set_axis(index)


def earlier(X, y):
    index = pd.MultiIndex.from_product([[0], 0.1 * np.arange(len(X))])
    return X.set_axis(index), y.set_axis(index)


def analysed(X, y):
    analyzer = HarmonicAnalyzer(2 * np.pi / 0.8, output_harmonics=1, hop=2)
    return analyzer.fit_transform(X, y), y


def with_missing(X, y):
    X = X.copy()
    X.iloc[3, 0] = np.nan
    return X, y


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (renamed, r"outputs \['other', 'q', 'r'\], the first one had \['p', 'q', 'r'\]"),
        (slower, "0.2 s apart, those of the first one 0.1 s"),
        (earlier, "begins at t = 0 s, before the end of the last one"),
        (analysed, "carries a harmonic basis, the first one had no one|feature names"),
        (with_missing, "NaN"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_a_wrong_chunk_is_an_error_and_changes_nothing(rng, change, words):
    X, y = simulated(rng, [600])
    model = MOESPRegressor(order=4, block_rows=6).partial_fit(X.iloc[:400], y.iloc[:400])
    before = pickle.dumps(model)
    with pytest.raises(ValueError, match=words):
        model.partial_fit(*change(X.iloc[400:], y.iloc[400:]))
    assert pickle.dumps(model) == before
    model.partial_fit(X.iloc[400:], y.iloc[400:])
    assert_same_model(model, MOESPRegressor(order=4, block_rows=6).fit(X, y))


def test_an_interrupted_chunk_changes_nothing(rng, monkeypatch):
    X, y = simulated(rng, [600])
    model = MOESPRegressor(order=4, block_rows=6).partial_fit(X.iloc[:400], y.iloc[:400])
    before = pickle.dumps(model)
    with monkeypatch.context() as patch:
        patch.setattr(
            plain, "subspace_fit", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt)
        )
        with pytest.raises(KeyboardInterrupt):
            model.partial_fit(X.iloc[400:], y.iloc[400:])
    assert pickle.dumps(model) == before
    model.partial_fit(X.iloc[400:], y.iloc[400:])
    assert_same_model(model, MOESPRegressor(order=4, block_rows=6).fit(X, y))


def test_more_block_rows_than_the_first_chunk_was_read_with_are_refused(rng):
    X, y = simulated(rng, [600])
    model = MOESPRegressor(order=4, block_rows=6).partial_fit(X.iloc[:400], y.iloc[:400])
    with pytest.raises(ValueError, match="block_rows=9 is more than the 6"):
        model.set_params(block_rows=9).partial_fit(X.iloc[400:], y.iloc[400:])
    model.set_params(block_rows=5).partial_fit(X.iloc[400:], y.iloc[400:])
    assert_same_model(model, MOESPRegressor(order=4, block_rows=5).fit(X, y))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"reading": "period"}, "reading='period'"),
        ({"hop": 8, "missing": "gap"}, "no missing samples"),
        ({"hop": 8, "small_signal": "odd"}, "combines whole records"),
    ],
)
def test_analyses_of_whole_records_are_refused(settings, words):
    data = make_flapping_wing("ltp", n_periods=30, start=10, width=3)
    analyzer = HarmonicAnalyzer(data.omega, output_harmonics=1, **settings)
    X = analyzer.fit(data.inputs, data.outputs).transform(data.inputs)
    with pytest.raises(ValueError, match=words):
        MOESPRegressor().partial_fit(X, data.outputs)


def test_rows_that_would_be_resampled_are_refused(rng):
    X, y = simulated(rng, [300])
    analyzer = HarmonicAnalyzer(2 * np.pi / 0.83, output_harmonics=1, hop=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        X = analyzer.fit(X, y).transform(X)
        with pytest.raises(ValueError, match="need resampling"):
            MOESPRegressor().partial_fit(X, y)


# ---- the sums themselves ----------------------------------------------------------------------


@pytest.mark.parametrize("reach", [5, 40, 1000])
@pytest.mark.parametrize("rounds", [[300], [7, 3, 90, 1, 199]])
def test_lagged_sums_are_those_of_all_rows(rng, monkeypatch, reach, rounds):
    monkeypatch.setattr(sums, "REACH", reach)
    z = rng.standard_normal((300, 3))
    parts = [row_sums(rows, 4, [0], [1, 2]) for rows in np.split(z, np.cumsum(rounds)[:-1])]
    while len(parts) > 1:  # in any grouping
        at = rng.integers(len(parts) - 1)
        parts[at : at + 2] = [parts[at].join(parts[at + 1])]
    found = parts[0].closed()
    for d in range(min(reach, 299) + 1):
        np.testing.assert_allclose(found.lags[d], z[: 300 - d, :1].T @ z[d:], atol=1e-11)
    np.testing.assert_allclose(found.lags[300:], 0.0, atol=1e-11)
    np.testing.assert_allclose(found.squares, np.sum(z[:, 1:] ** 2, axis=0))
    np.testing.assert_array_equal(found.ends[0].head, z[:reach])
    np.testing.assert_array_equal(found.ends[0].tail, z[-reach:, :1])


def test_channels_of_sums_are_the_sums_of_channels(rng):
    records = [(rng.standard_normal((n, 4)),) for n in (50, 5, 80)]
    which = np.array([0, 3])
    some = lag_products(records, 6, exact=True).channels(which)
    alone = lag_products([(z[:, which],) for (z,) in records], 6, exact=True)
    np.testing.assert_allclose(some.fewer(4).gram().high, alone.fewer(4).gram().high, rtol=1e-14)
    size = np.sqrt(np.mean(np.vstack([z[:, which] for (z,) in records]) ** 2, axis=0))
    np.testing.assert_allclose(some.root_mean_squares(), size)


@pytest.mark.parametrize("feedthrough", [True, False])
def test_the_factor_alone_gives_b_and_d_without_noise(rng, feedthrough):
    A, B, C = random_stable(rng, 4, 2, 3)
    D = rng.standard_normal((3, 2)) * feedthrough
    u, x0 = rng.standard_normal((400, 2)), rng.standard_normal(4)
    y = propagate(A, u @ B.T, x0) @ C.T + u @ D.T
    R = hankel_factor([u], [y], 5)
    U, values = observability_subspace(R, 5, 2)
    A, C = state_matrices(U, values, 4, 3)
    B, found = input_matrices_of_factor(A, C, R, 5, 2, feedthrough)
    expected = input_matrices(A, C, [u], [y], feedthrough)
    np.testing.assert_allclose(B, expected[0], atol=1e-9)
    np.testing.assert_allclose(found, D, atol=1e-9)
    ends = [RecordEnds(np.hstack([u, y]), u, 400)]
    scales = np.ones(2), np.ones(3)
    starts = initial_states_of_heads(A, B, C, found, ends, scales)
    np.testing.assert_allclose(starts, expected[2], atol=1e-9)


def test_sums_do_not_reach_where_the_model_does(rng, monkeypatch):
    monkeypatch.setattr(sums, "REACH", 50)
    A, C = np.diag([0.9, 0.2]), np.ones((1, 2))
    record = row_sums(rng.standard_normal((400, 2)), 4, [0], [1])
    scales = np.ones(1), np.ones(1)
    assert input_matrices_of_sums(A, C, record.closed(), False, scales) is None
    assert input_matrices_of_sums(A / 2.0, C, record.closed(), False, scales) is not None
