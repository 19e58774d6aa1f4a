"""Laws of records read in parts: their equations are those of the whole record."""

from functools import reduce
from itertools import pairwise

import numpy as np
import pytest
from conftest import random_stable
from scipy import linalg

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.input_matrices import RecordFactors, input_matrices
from sklearn_hd.algorithms.subspace.record_parts import cuts, input_equations, record_part

JORDAN = linalg.block_diag([[0.98, 1.0], [0.0, 0.98]], [[0.6, 0.4], [-0.4, 0.6]], -0.3)
INTEGRATOR = np.diag([1.0, 0.9, 0.2, -0.7, 0.4])
UNSTABLE = np.diag([1.1, 0.9, 0.2, -0.7, 0.4])
SCALES = np.array([2.0, 0.5]), np.array([1.0, 3.0, 0.1])


def record(rng, A, n_rows, noise):
    n = len(A)
    B, C, D = rng.standard_normal((n, 2)), rng.standard_normal((3, n)), rng.standard_normal((3, 2))
    u = rng.standard_normal((n_rows, 2))
    y = propagate(A, u @ B.T, rng.standard_normal(n)) @ C.T + u @ D.T
    return C, u, y + noise * np.std(y, axis=0) * rng.standard_normal(y.shape)


def squared(part):
    return part.R.T @ part.R


@pytest.mark.parametrize("edges", [[1], [2, 3], [100, 350], [5, 250, 251, 380]], ids=str)
@pytest.mark.parametrize("noise", [0.0, 0.1])
@pytest.mark.parametrize("A", [JORDAN, INTEGRATOR], ids=["double pole", "integrator"])
def test_parts_join_to_the_whole_record(rng, A, noise, edges):
    C, u, y = record(rng, A, 400, noise)
    factors = RecordFactors(A, C, True, SCALES)
    whole = record_part(factors, u, y)
    parts = [record_part(factors, u[a:b], y[a:b]) for a, b in pairwise([0, *edges, 400])]
    joined = reduce(lambda a, b: a.join(b), parts)
    size = np.linalg.norm(squared(whole), 2)
    np.testing.assert_allclose(squared(joined), squared(whole), atol=1e-12 * size)
    np.testing.assert_allclose(joined.power, whole.power, atol=1e-12)
    np.testing.assert_allclose(joined.forced, whole.forced, atol=1e-11)
    assert joined.n_rows == 400


def test_neighbours_are_joined_in_any_order(rng):
    A, _, C = random_stable(rng, 5, 2, 3)
    u, y = rng.standard_normal((90, 2)), rng.standard_normal((90, 3))
    factors = RecordFactors(A, C, False, SCALES)
    a, b, c = (record_part(factors, u[k : k + 30], y[k : k + 30]) for k in (0, 30, 60))
    left, right = a.join(b).join(c), a.join(b.join(c))
    np.testing.assert_allclose(squared(left), squared(right), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(left.forced, right.forced, atol=1e-13)


@pytest.mark.parametrize("A", [JORDAN, UNSTABLE], ids=["stable", "unstable"])
@pytest.mark.parametrize("feedthrough", [False, True])
def test_b_d_and_initial_states_are_those_of_whole_records(rng, A, feedthrough):
    """Records that end within parts, parts within records, an unstable one cut into pieces."""
    lengths, ends = [300, 40, 2, 260], [0, 90, 91, 310, 345, 500, 602]
    C, _, _ = record(rng, A, 1, 0.0)
    inputs = [rng.standard_normal((n, 2)) for n in lengths]
    outputs = [
        propagate(A, u @ np.ones((2, len(A))), rng.standard_normal(len(A))) @ C.T for u in inputs
    ]
    outputs = [y + 0.01 * np.std(y) * rng.standard_normal(y.shape) for y in outputs]
    edges = cuts(A, lengths)
    assert (max(map(len, edges)) > 2) == (A is UNSTABLE)
    first = np.cumsum([0, *lengths])
    total = None
    for start, stop in pairwise(ends):
        parts = []
        for r, each in enumerate(edges):
            for p, (a, b) in enumerate(pairwise(each)):
                low, high = max(a, start - first[r]), min(b, stop - first[r])
                if low < high:
                    rows = slice(low, high)
                    parts.append(((r, p), b - a, inputs[r][rows], outputs[r][rows]))
        found = input_equations(A, C, feedthrough, SCALES, parts)
        total = found if total is None else total + found
    assert total.open == ()
    B, D, x0 = total.solve((5, 2, 3), [(r, 0) for r in range(4)])
    expected = input_matrices(A, C, inputs, outputs, feedthrough, scales=SCALES)
    for here, there in zip((B, D, x0), expected, strict=True):
        np.testing.assert_allclose(here, there, atol=1e-9 * max(1.0, np.abs(there).max()))


def test_what_is_kept_of_a_part_does_not_grow_with_its_rows(rng):
    A, _, C = random_stable(rng, 5, 2, 3)
    factors = RecordFactors(A, C, True, SCALES)
    sizes = set()
    for n_rows in (500, 5000):
        u, y = rng.standard_normal((n_rows, 2)), rng.standard_normal((n_rows, 3))
        sizes.add(record_part(factors, u, y).R.shape)
    assert sizes == {(22, 22)}
