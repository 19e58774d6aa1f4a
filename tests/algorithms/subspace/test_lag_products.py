"""Exact truths of lag products, and of the double-double arithmetic they are summed in."""

from fractions import Fraction
from functools import reduce

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sklearn_hd.algorithms.linalg.double_double import Pair, cholesky, product, slices
from sklearn_hd.algorithms.subspace import lag_products as lag_module
from sklearn_hd.algorithms.subspace.lag_products import lag_products, stretch

EXACT = Fraction(1, 2**96)


def fractions(matrix):
    return [[Fraction(float(value)) for value in row] for row in np.atleast_2d(matrix)]


def exact_sum(pair):
    """Both halves as one Fraction each, upper triangle by rows."""
    low = np.zeros_like(pair.high) if pair.low is None else pair.low
    return [
        [Fraction(float(h)) + Fraction(float(e)) for h, e in zip(*rows, strict=True)]
        for rows in zip(pair.high, low, strict=True)
    ]


def rounded(record):
    """A record as exact sums see it: 54 bits beside the largest value of each channel."""
    exponents = np.frexp(np.abs(record).max(axis=0))[1]
    parts = slices(np.ldexp(record, -exponents), 3)
    return np.ldexp(parts.sum(axis=0), exponents)


def dense_gram(records, n_block_rows):
    """Hankel matrix times itself in exact arithmetic."""
    width = n_block_rows * records[0].shape[1]
    total = [[Fraction(0)] * width for _ in range(width)]
    for record in records:
        for start in range(len(record) - n_block_rows + 1):
            column = fractions(record[start : start + n_block_rows].reshape(1, -1))[0]
            for a in range(width):
                for b in range(width):
                    total[a][b] += column[a] * column[b]
    return total


def worst_error(products, truth):
    """Largest error of the Gram matrix beside the diagonal, upper triangle."""
    width = len(truth)
    scale = [Fraction(2) ** int(e) for e in np.tile(products.exponents, len(products.lags))]
    found = exact_sum(products.gram())
    size = max(truth[a][a] for a in range(width))
    errors = [
        abs(found[a][b] * scale[a] * scale[b] - truth[a][b])
        for a in range(width)
        for b in range(a, width)
    ]
    return max(errors) / size


@pytest.fixture
def records(rng):
    """Lengths above, at and below the number of lags; channels in different units."""
    return [rng.standard_normal((n, 2)) * [1.0, 1e-3] for n in (23, 6, 11, 5, 4, 2)]


def test_slices_are_whole_multiples_and_lose_one_rounding(rng):
    values = rng.uniform(-1.0, 1.0, 500)
    parts = slices(values, 3)
    for q, part in enumerate(parts, start=1):
        whole = np.ldexp(part, 18 * q)
        assert np.array_equal(whole, np.rint(whole))
        assert np.max(np.abs(whole)) <= 2**18
    lost = [abs(sum(map(Fraction, p)) - Fraction(v)) for v, p in zip(values, parts.T, strict=True)]
    assert max(lost) <= Fraction(1, 2**55)


def test_products_of_slices_round_nothing(rng):
    left, right = rng.uniform(-1, 1, (30, 2)), rng.uniform(-1, 1, (30, 3))
    found = exact_sum(product(left, right, exact=True))
    for i in range(2):
        for j in range(3):
            pairs = zip(left[:, i], right[:, j], strict=True)
            truth = sum(Fraction(float(a)) * Fraction(float(b)) for a, b in pairs)
            assert abs(found[i][j] - truth) < EXACT


def test_cholesky_finds_a_factor_that_double_cannot_see(rng):
    """Columns that coincide to 2⁻⁴⁰: squared, they are the same in double."""
    n = 6
    R = np.triu(rng.integers(1, 9, (n, n))).astype(float)
    R[np.arange(1, n), np.arange(1, n)] *= 2.0**-40
    exact = fractions(R)
    G = [[sum(exact[k][i] * exact[k][j] for k in range(n)) for j in range(n)] for i in range(n)]
    high = np.array([[float(value) for value in row] for row in G])
    low = np.array(
        [[float(G[i][j] - Fraction(float(high[i, j]))) for j in range(n)] for i in range(n)]
    )
    np.testing.assert_allclose(cholesky(high, low), R, rtol=4e-16)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(high)


def test_cholesky_of_a_deficient_matrix_has_rows_of_zeros():
    X = np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 5.0]])
    R = cholesky(X.T @ X, np.zeros((3, 3)))
    np.testing.assert_allclose(R.T @ R, X.T @ X, rtol=1e-15)
    assert np.all(R[1] == 0.0)


@pytest.mark.parametrize("remembered", [256, 0], ids=["by a table", "in place"])
@pytest.mark.parametrize("exact", [False, True])
def test_gram_is_symmetric_in_any_order(rng, monkeypatch, records, exact, remembered):
    monkeypatch.setattr(lag_module, "REMEMBERED_ROWS", remembered)
    monkeypatch.setattr(lag_module, "PLACED_ROWS", 3)
    products = lag_products([(z,) for z in records[:3]], 4, exact)
    order = rng.permutation(8)
    for half, turned in zip(products.gram().halves(), products.gram(order).halves(), strict=True):
        np.testing.assert_array_equal(half, half.T)
        np.testing.assert_array_equal(turned, half[np.ix_(order, order)])


def test_plain_and_exact_pairs_add_up_to_a_plain_one():
    assert (Pair(np.ones(1)) + Pair(np.ones(1), np.zeros(1))).low is None


@pytest.mark.parametrize("n_block_rows", [2, 4, 6])
def test_gram_is_that_of_the_dense_hankel_matrix(records, n_block_rows):
    products = lag_products([(z[:, :1], z[:, 1:]) for z in records], 6, exact=True)
    exponents = products.exponents
    seen = [np.ldexp(slices(np.ldexp(z, -exponents), 3).sum(axis=0), exponents) for z in records]
    for z in products.short:  # taken up again for fewer lags, by themselves
        assert len(z) < 6
    fewer = products.fewer(n_block_rows)
    assert fewer.n_columns(n_block_rows) == sum(max(0, len(z) - n_block_rows + 1) for z in records)
    assert products.n_columns(n_block_rows) == fewer.n_columns(n_block_rows)
    long = [z for z in seen if len(z) >= 6]
    short = [z for z in records if n_block_rows <= len(z) < 6]
    own = np.frexp(np.max([np.abs(z).max(axis=0) for z in short], axis=0))[1] if short else None
    short = [np.ldexp(slices(np.ldexp(z, -own), 3).sum(axis=0), own) for z in short]
    assert worst_error(fewer, dense_gram(long + short, n_block_rows)) < EXACT


def test_plain_sums_are_those_of_double(records):
    products = lag_products([(z,) for z in records], 4, exact=False)
    assert not products.exact
    assert worst_error(products, dense_gram(records, 4)) < Fraction(1, 10**14)


def test_more_lags_than_there_are_cannot_be_had(records):
    products = lag_products([(z,) for z in records], 4, exact=False)
    with pytest.raises(
        ValueError, match=r"products of 4 lags are too few for a Hankel matrix of 6 block"
    ):
        products.fewer(6)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**20))
def test_chunks_join_to_the_record_in_any_grouping(seed):
    rng = np.random.default_rng(seed)
    record = rng.standard_normal((40, 2)) * 10.0 ** rng.integers(-3, 4, (40, 1))
    cuts = np.unique(rng.integers(1, 40, rng.integers(1, 9)))
    chunks = np.split(record, cuts)
    parts = [stretch((z[:, :1], z[:, 1:]), 6) for z in chunks]
    while len(parts) > 1:
        at = rng.integers(len(parts) - 1)
        parts[at : at + 2] = [parts[at].join(parts[at + 1])]
    joined = parts[0].closed()
    assert joined.n_rows == 40
    seen = np.vstack([rounded(z) for z in chunks])
    assert worst_error(joined, dense_gram([seen], 6)) < EXACT


def test_a_record_shorter_than_its_lags_is_kept_for_fewer(rng):
    record = rng.standard_normal((5, 1))
    parts = [stretch((z,), 6) for z in (record[:2], record[2:])]
    closed = parts[0].join(parts[1]).closed()
    assert closed.n_columns(6) == 0
    truth = dense_gram([rounded(closed.short[0])], 4)
    assert worst_error(closed.fewer(4), truth) < EXACT


def test_a_large_record_that_is_too_short_rounds_no_other(rng):
    record, spike = rng.standard_normal((9, 2)), np.full((2, 2), 1e15)
    products = lag_products([(record,), (spike,)], 3, exact=True)
    assert worst_error(products, dense_gram([rounded(record)], 3)) < EXACT
    expected = np.sqrt((np.sum(record**2, axis=0) + 2e30) / 11)
    np.testing.assert_allclose(products.root_mean_squares(), expected)


def test_records_add_up_in_any_order(records):
    parts = [lag_products([(z,)], 4, exact=True) for z in records]
    sums = [reduce(lambda a, b: a + b, order) for order in (parts, parts[::-1])]
    truth = dense_gram([rounded(z) for z in records], 4)
    for total in sums:
        assert worst_error(total, truth) < EXACT
        assert total.n_columns(4) == sum(max(0, len(z) - 3) for z in records)


def test_long_records_go_chunk_by_chunk_to_the_same_sums(rng):
    """Longer than one chunk of the sums, in memory order of rows and of columns."""
    record = rng.standard_normal((20_011, 3))
    dense = np.zeros((4, 3, 3))
    for lag in range(4):
        dense[lag] = record[: len(record) - lag].T @ record[lag:]
    for signals in ((record,), (np.asfortranarray(record[:, :2]), record[:, 2:])):
        for exact in (False, True):
            products = lag_products([signals], 4, exact)
            e = products.exponents
            found = np.ldexp(products.lags.high, e[:, None] + e)
            np.testing.assert_allclose(found, dense, atol=1e-9)


@pytest.mark.parametrize("n_lags", [2, 3, 4, 9, 30])
@pytest.mark.parametrize("n_rows", [30, 31, 143, 144, 145, 146, 300])
def test_lags_of_whole_numbers_are_exact_across_chunks(rng, monkeypatch, n_lags, n_rows):
    """Rows at even and at odd places, odd numbers of lags and rows, ends of chunks."""
    monkeypatch.setattr(lag_module, "CHUNK", 72)  # pairs of rows
    record = rng.integers(-9, 10, (n_rows, 3)).astype(float)
    for exact in (False, True):
        products = lag_products([(record[:, :1], record[:, 1:])], n_lags, exact)
        e = products.exponents
        found = np.ldexp(products.lags.high, e[:, None] + e)
        for lag in range(n_lags):
            assert np.array_equal(found[lag], record[: n_rows - lag].T @ record[lag:])


def test_the_largest_slices_there_are_round_nothing(rng):
    """Sums over a whole chunk of values just below one, of one sign and of two."""
    n_rows = 2 * lag_module.CHUNK + 35
    whole = 2**53 - rng.integers(1, 2**36, (n_rows, 2)).astype(object)
    whole[1::2, 1] *= -1
    record = np.ldexp(whole.astype(float), -53)
    assert np.array_equal(rounded(record), record)
    products = lag_products([(record,)], 4, exact=True)
    for lag in range(4):
        truth = whole[: n_rows - lag].T @ whole[lag:]
        halves = (half[lag].ravel().tolist() for half in products.lags.halves())
        for high, low, value in zip(*halves, truth.ravel(), strict=True):
            error = Fraction(high) + Fraction(low) - Fraction(value, 2**106)
            assert abs(error) <= EXACT * n_rows


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("units", [1e-140, 1.0, 1e140])
def test_channels_at_rest_and_units_are_no_matter(rng, exact, units):
    record = rng.standard_normal((50, 3)) * [1.0, 0.0, 1.0]
    scale = np.array([units, 1.0, 1.0 / units])
    products = lag_products([(record * scale,)], 4, exact)
    reference = lag_products([(record,)], 4, exact)
    e = np.tile(products.exponents, 4) - np.tile(reference.exponents, 4)
    unit = np.ldexp(1.0, e) / np.tile(scale, 4)
    found = products.gram().high * unit * unit[:, None]
    np.testing.assert_allclose(found, reference.gram().high, rtol=1e-13, atol=1e-14)
