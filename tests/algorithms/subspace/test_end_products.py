"""Products of rows at one end of records: as they are and multiplied, they say the same."""

import numpy as np
import pytest

from sklearn_hd.algorithms.subspace.end_products import EndRows, EndSum, end_products

P = 2  # channels
ROWS = 5  # at the end of each record


@pytest.fixture(params=[False, True], ids=["plain", "exact"])
def exact(request):
    return request.param


def values(pair):
    return sum(pair.halves())


@pytest.mark.parametrize("n_records", [0, 1, 3])
def test_few_records_are_kept_as_they_are_and_say_the_same(rng, exact, n_records):
    rows = rng.uniform(-1.0, 1.0, (n_records, ROWS * P))
    few = EndRows(rows, exact)
    dense = rows.T @ rows
    np.testing.assert_allclose(values(few.summed().sum), dense, atol=1e-15)
    for ends in (few, few.summed()):
        found = values(ends.by_lag(P, 1, ROWS))
        assert found.shape == (ROWS - 1, P, (ROWS + 1) * P)
        for a in range(1, ROWS):
            expected = np.zeros((P, (ROWS + 1) * P))
            expected[:, : (ROWS - a) * P] = dense[a * P : (a + 1) * P, a * P :]
            np.testing.assert_allclose(found[a - 1], expected, atol=1e-15)


def test_records_are_multiplied_where_that_is_smaller(rng, exact):
    rows = rng.uniform(-1.0, 1.0, (3, 16))
    assert isinstance(end_products(rows[:2], exact), EndRows)
    assert isinstance(end_products(rows, exact), EndSum)


def test_parts_powers_and_sums(rng, exact):
    some, others = rng.uniform(-1.0, 1.0, (2, 1, ROWS * P))
    which, powers = np.array([0, 3, 4]), np.array([0, -3, 40] + [0] * 7)
    a, b = EndRows(some, exact), EndRows(others, exact)
    for ends in (a, a.summed()):
        total = ends.times_powers(powers).part(which) + b.part(which)
        parts = np.vstack([np.ldexp(some, powers), others])[:, which]
        np.testing.assert_allclose(values(total.sum), parts.T @ parts, atol=1e-15)
