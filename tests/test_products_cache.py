"""memory=: lag products kept for all orders and many block rows."""

import io
import os
import shutil
from dataclasses import fields

import joblib
import numpy as np
import pytest
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit

from sklearn_hd import MOESPRegressor
from sklearn_hd._identify import products_cache
from sklearn_hd._identify.products_cache import KeptSums
from sklearn_hd.algorithms.linalg.double_double import Pair
from sklearn_hd.algorithms.subspace.hankel import hankel_factor
from sklearn_hd.algorithms.subspace.lag_products import LagProducts, lag_products
from sklearn_hd.algorithms.subspace.sums import RecordEnds, Sums
from sklearn_hd.exceptions import CacheWarning

STORED = (LagProducts, Pair, Sums, RecordEnds)


@pytest.fixture
def data(rng):
    u = rng.standard_normal((1500, 2))
    y = np.zeros((1500, 2))
    for k in range(1499):
        y[k + 1] = [0.8 * y[k, 0] - 0.3 * y[k, 1] + u[k, 0], 0.5 * y[k, 1] + u[k].sum()]
    return u, y + 0.01 * rng.standard_normal(y.shape)


@pytest.fixture
def counted(monkeypatch):
    """Calls of lag_products that really multiply."""
    calls = []

    def count(records, n_lags, exact):
        calls.append(n_lags)
        return lag_products(records, n_lags, exact)

    monkeypatch.setattr(products_cache, "lag_products", count)
    return calls


def same_model(one, other):
    for name in "ABCD":
        np.testing.assert_allclose(
            getattr(one.model_, name), getattr(other.model_, name), atol=1e-10
        )


def test_block_rows_in_any_order_share_their_products(tmp_path, data, counted):
    grid = [(order, block_rows) for block_rows in (7, 3, 36, 5, 20, 33) for order in (2, 3)]
    plain = [MOESPRegressor(order, block_rows=i).fit(*data) for order, i in grid]
    counted.clear()
    for (order, i), model in zip(grid, plain, strict=True):
        same_model(MOESPRegressor(order, block_rows=i, memory=str(tmp_path)).fit(*data), model)
    assert counted == [64, 128]  # 32 block rows and fewer; more


@pytest.mark.slow
def test_a_search_goes_through_each_fold_once_or_twice(tmp_path, data, counted):
    grid = {"order": [1, 2, 3, 4], "block_rows": [5, 8, 18, 33]}
    search = GridSearchCV(MOESPRegressor(memory=tmp_path), grid, cv=TimeSeriesSplit(3)).fit(*data)
    assert len(counted) <= 2 * 3 + 2
    plain = GridSearchCV(MOESPRegressor(), grid, cv=TimeSeriesSplit(3)).fit(*data)
    assert search.best_params_ == plain.best_params_
    np.testing.assert_allclose(
        search.cv_results_["mean_test_score"], plain.cv_results_["mean_test_score"], atol=1e-10
    )


@pytest.mark.slow
def test_two_processes_may_share_a_folder(tmp_path, data):
    grid = {"order": [2, 3], "block_rows": [5, 20]}
    model = MOESPRegressor(memory=joblib.Memory(tmp_path, verbose=0))
    search = GridSearchCV(model, grid, cv=TimeSeriesSplit(2), n_jobs=2).fit(*data)
    plain = GridSearchCV(MOESPRegressor(), grid, cv=TimeSeriesSplit(2)).fit(*data)
    np.testing.assert_allclose(
        search.cv_results_["mean_test_score"], plain.cv_results_["mean_test_score"], atol=1e-10
    )


@pytest.mark.parametrize("change", ["value", "shape", "order", "seam"])
def test_other_data_have_other_products(tmp_path, rng, change):
    z = rng.standard_normal((40, 4))
    records = [(z[:20, :2], z[:20, 2:]), (z[20:, :2], z[20:, 2:])]
    other = {
        "value": [(z[:20, :2], z[:20, 2:]), (z[20:, :2], np.nextafter(z[20:, 2:], 9.0))],
        "shape": [(z[:20, :3], z[:20, 3:]), (z[20:, :2], z[20:, 2:])][:1],
        "order": records[::-1],
        "seam": [(z[:, :2], z[:, 2:])],
    }[change]
    kept = KeptSums(str(tmp_path))
    for each in (records, other):
        inputs, outputs = map(list, zip(*each, strict=True))
        expected = hankel_factor(inputs, outputs, 3)
        np.testing.assert_allclose(kept.factor(inputs, outputs, 3, None), expected, atol=1e-12)


def test_data_that_were_changed_in_place_are_others(tmp_path, data):
    u, y = data
    model = MOESPRegressor(3, block_rows=6, memory=str(tmp_path))
    for change in (0.0, 0.5, -0.0):
        u[701, 1] = change
        same_model(model.fit(u, y), MOESPRegressor(3, block_rows=6).fit(u, y))


@pytest.fixture
def forgetful(monkeypatch):
    """A process with nothing at hand, as one that has just begun."""

    def begin():
        monkeypatch.setattr(products_cache, "_RECENT", products_cache._Recent(2**20))

    begin()
    return begin


def test_files_of_another_layout_are_not_found(tmp_path, data, counted, forgetful, monkeypatch):
    model = MOESPRegressor(3, block_rows=6, memory=str(tmp_path))
    for layout in (1, 1, 2, 2, 1):
        monkeypatch.setattr(products_cache, "LAYOUT", layout)
        forgetful()
        model.fit(*data)
    assert counted == [64, 64]  # the first of each


def test_the_layout_is_the_one_that_is_numbered():
    """Whoever changes a field raises LAYOUT."""
    kept = {each.__name__: [f.name for f in fields(each)] for each in STORED}
    assert (products_cache.LAYOUT, kept) == (
        4,
        {
            "LagProducts": ["lags", "head", "tail", "exponents", "n_rows", "short"],
            "Pair": ["high", "low"],
            "Sums": ["products", "lags", "squares", "ends"],
            "RecordEnds": ["head", "tail", "n_rows"],
        },
    )


class Strange:
    """What a pickle made with another version of a package may do when it is read."""

    def __reduce__(self):
        return eval, ("1 / 0",)


def pickled(value):
    stream = io.BytesIO()
    joblib.dump(value, stream)
    return stream.getvalue()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda content: content[: len(content) // 2],
        lambda content: content.replace(b"sklearn_hd", b"sklearn_hx").replace(b"numpy", b"nunpy"),
        lambda content: b"",
        *(
            lambda content, value=value: pickled(value)
            for value in (
                Strange(),
                None,
                {"a": 1},
                np.full((20, 20), np.nan),
                np.zeros(2),
                (np.zeros(3), np.zeros(3)),
                (("factors", "of others", 6, None), np.zeros((24, 24))),
            )
        ),
    ],
)
def test_files_that_are_not_what_was_stored_are_made_anew(tmp_path, data, forgetful, spoil):
    model = MOESPRegressor(3, block_rows=6, memory=str(tmp_path))
    first = model.fit(*data).model_
    stored = list(tmp_path.rglob("output.pkl"))
    assert len(stored) == 3  # products, factor, correlations
    for file in stored:
        file.write_bytes(spoil(file.read_bytes()))
    forgetful()
    with pytest.warns(
        CacheWarning, match=r"is not what was kept there \(.*\); it is computed anew"
    ) as warned:
        again = model.fit(*data).model_
    told = " ".join(str(w.message) for w in warned)
    assert len(warned) == 3
    assert all(str(file.parent) in told for file in stored)
    assert {w.filename for w in warned} == {__file__}
    forgetful()
    third = model.fit(*data).model_  # without a warning
    for other in (again, third):
        assert all(np.array_equal(getattr(first, name), getattr(other, name)) for name in "ABCD")


@pytest.mark.parametrize("depth", [1, 2, 3, 4])
def test_a_file_where_a_folder_should_be_is_told_and_done_without(tmp_path, data, forgetful, depth):
    place = tmp_path.joinpath(*("joblib", "sklearn_hd", "_identify", "products_cache")[:depth])
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("no folder")
    with pytest.warns(CacheWarning, match=r"cannot be used \(.*so nothing is kept; clear it"):
        model = MOESPRegressor(3, block_rows=6, memory=str(tmp_path)).fit(*data)
    same_model(model, MOESPRegressor(3, block_rows=6).fit(*data))
    assert place.read_text() == "no folder"


@pytest.mark.parametrize("notes", [b"\xff", b"# first line: none"])
def test_notes_of_joblibs_that_cannot_be_read_are_told(
    tmp_path, data, forgetful, monkeypatch, notes
):
    monkeypatch.setattr(joblib.memory, "_FUNCTION_HASHES", {})  # a process that has just begun
    model = MOESPRegressor(3, block_rows=6, memory=str(tmp_path)).fit(*data)
    (file,) = tmp_path.rglob("func_code.py")
    file.write_bytes(notes)
    forgetful()
    joblib.memory._FUNCTION_HASHES.clear()
    with pytest.warns(CacheWarning, match=r"cannot be used \(.*so nothing is kept; clear it"):
        same_model(MOESPRegressor(3, block_rows=6, memory=str(tmp_path)).fit(*data), model)


def test_what_is_at_hand_is_not_read_again(tmp_path, data, counted):
    model = MOESPRegressor(3, block_rows=6, memory=str(tmp_path))
    first = model.fit(*data).model_
    shutil.rmtree(tmp_path)
    again = model.fit(*data).model_
    assert counted == [64]
    assert all(np.array_equal(getattr(first, name), getattr(again, name)) for name in "ABCD")
    assert list(tmp_path.rglob("*.pkl")) == []


def test_other_choices_are_not_at_hand(tmp_path, data):
    for choice in ({}, {"weighting": "n4sid"}, {"scale": False}, {"block_rows": 7}):
        settings = {"order": 3, "block_rows": 6, **choice}
        same_model(
            MOESPRegressor(memory=str(tmp_path), **settings).fit(*data),
            MOESPRegressor(**settings).fit(*data),
        )


def test_no_more_is_at_hand_than_stated():
    recent = products_cache._Recent(3000)
    for k in range(5):
        recent.get(k, lambda: (np.zeros(100), np.zeros(25)))  # 1000 bytes
        recent.get(0, lambda: np.zeros(125))  # asked for last, so it stays
    assert list(recent.values) == [3, 4, 0]
    assert recent.size == 3000
    recent.get("large", lambda: np.zeros(1000))  # than all that may be at hand
    assert list(recent.values) == [3, 4, 0]
    with pytest.raises(ValueError, match="read-only"):
        recent.get("small", lambda: np.zeros(10))[0] = 1.0


def test_rows_and_columns_of_one_table_have_digests_of_their_own(rng):
    z = rng.standard_normal((6, 6))
    other = products_cache._digest([(np.asfortranarray(z.T), z)])
    assert products_cache._digest([(z, z)]) != other


def test_very_many_lags_are_not_kept(tmp_path, rng, counted):
    u, y = rng.standard_normal((2, 2000, 1))
    for scale in (np.ones(2), 2.0 * np.ones(2)):
        KeptSums(str(tmp_path)).factor([u], [y], 150, scale)
    assert counted == [300, 300]


def test_a_search_without_noise_keeps_exact_products(tmp_path, rng, counted):
    u = rng.standard_normal((9000, 1))
    y = np.zeros((9000, 1))
    for k in range(8999):
        y[k + 1] = 0.8 * y[k] + u[k]
    for order in (1, 2):
        MOESPRegressor(order, block_rows=4, memory=str(tmp_path)).fit(u, y)
    assert counted == [64, 64]  # in double, which does not do, and exactly


@pytest.mark.filterwarnings("ignore:the model is unstable")  # its inputs are not told
def test_outputs_alone_are_kept_as_well(tmp_path, data):
    y = data[1]
    for _ in range(2):
        kept = MOESPRegressor(3, block_rows=6, memory=str(tmp_path)).fit(None, y)
        same_model(kept, MOESPRegressor(3, block_rows=6).fit(None, y))


def test_a_folder_that_may_not_be_written_is_named(tmp_path, data, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)  # root may write anywhere
    with pytest.raises(ValueError, match=r"cannot be written; give a folder that can"):
        MOESPRegressor(memory=str(tmp_path)).fit(*data)


def test_a_folder_that_cannot_be_made_is_named(tmp_path, data):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ValueError, match=r"file' is a file; give a folder that can be written"):
        MOESPRegressor(memory=tmp_path / "file").fit(*data)
    with pytest.raises(ValueError, match=r"file.inside' cannot be written"):
        MOESPRegressor(memory=str(tmp_path / "file" / "inside")).fit(*data)
    for method in (MOESPRegressor.fit, MOESPRegressor.partial_fit):
        with pytest.raises(ValueError, match="memory"):
            method(MOESPRegressor(memory=3), *data)
