"""Laws of deviations from parts of a record."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import kstest

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.likelihood.prediction_error import output_error_of
from sklearn_hd.algorithms.likelihood.uncertainty import (
    FEWEST,
    LEVELS,
    N_BLOCKS,
    blocks_in_time,
    by_direction,
    by_size,
    part_scores,
)
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure

N = 2000


def static():
    """y = a u + b, no states: least squares."""
    basis = np.zeros((2, 1, 1, 2))
    basis[0, 0, 0, 0] = basis[1, 0, 0, 1] = 1.0
    return Form(PeriodicStructure(np.zeros((1, 1, 2)), basis, 0, ("a", "b")), 1.0, 1, discrete=True)


def line(rng, noise, slope=2.0):
    u = np.column_stack([lfilter([1.0], [1.0, -0.9], rng.standard_normal(N)), np.ones(N)])
    return u, (slope * u[:, 0] + 0.5 + noise)[:, None]


def fit(u, y, divisions):
    form = static()
    result = output_error_of(form, [(u, y, 0)], [0.0, 0.0])
    white = result.system.covariance(gauge=True)[0] * result.correction
    return result, part_scores(result, divisions), white


BLOCKS = [np.minimum(np.arange(N) * 40 // N, 39)]


def test_information_and_scores_are_those_of_least_squares(rng):
    u, y = line(rng, rng.standard_normal(N))
    result, parts, white = fit(u, y, {"time": BLOCKS})
    e = y[:, 0] - u @ result.theta
    np.testing.assert_allclose(result.theta, np.linalg.lstsq(u, y[:, 0])[0], rtol=1e-9)
    s2 = np.mean(e**2)
    for part in (0, 7, 39):
        rows = BLOCKS[0] == part
        np.testing.assert_allclose(parts["time"].scores[part], u[rows].T @ e[rows] / s2, atol=1e-8)
        np.testing.assert_allclose(parts["time"].information[part], u[rows].T @ u[rows] / s2)
    np.testing.assert_allclose(parts["time"].scores.sum(axis=0), 0.0, atol=1e-6)
    covariance = np.linalg.inv(u.T @ u) * s2
    np.testing.assert_allclose(white, covariance, rtol=4 / N)


def spread_of_slopes(colour, n_records=40):
    """Deviation of slopes over many records, and what the two covariances say of it."""
    slopes, robust, plain = [], [], []
    for seed in range(n_records):
        rng = np.random.default_rng(seed)
        noise = lfilter([1.0], [1.0, -colour], rng.standard_normal(N))
        result, parts, white = fit(*line(rng, noise), {"time": BLOCKS})
        slopes.append(result.theta[0])
        robust.append(parts["time"].sandwich(white)[0, 0])
        plain.append(white[0, 0])
    return np.var(slopes), np.mean(robust), np.mean(plain)


@pytest.mark.slow
def test_of_white_noise_both_covariances_are_alike():
    _, robust, plain = spread_of_slopes(0.0, 30)
    assert 0.85 < robust / plain < 1.15


@pytest.mark.slow
def test_of_coloured_noise_the_one_from_blocks_is_right_and_the_other_too_small():
    truth, robust, plain = spread_of_slopes(0.9)
    assert 0.65 < robust / truth < 1.5
    assert plain / truth < 0.3


@pytest.mark.slow
def test_alike_parts_differ_as_often_as_chance_has_it():
    p = []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        u, y = line(rng, rng.standard_normal(N))
        _, parts, white = fit(u, y, {"thirds": [np.arange(N) * 3 // N]})
        p.append(parts["thirds"].compared(white, np.eye(2), np.ones(2)).p_value)
    for column in np.transpose(p):
        assert kstest(column, "uniform").pvalue > 0.01


def test_parts_that_differ_are_seen_with_the_variance_between_them(rng):
    """Two slopes, 1.9 and 2.1: their variance is 0.02, whatever the noise."""
    half = np.arange(N) * 2 // N
    found = []
    for _ in range(10):
        u, _ = line(rng, 0.0)
        y = ((1.9 + 0.2 * half) * u[:, 0] + 0.5 + 0.1 * rng.standard_normal(N))[:, None]
        _, parts, white = fit(u, y, {"halves": [half]})
        comparison = parts["halves"].compared(white, np.eye(2), np.ones(2))
        assert comparison.p_value[0] < 1e-10
        np.testing.assert_allclose(comparison.offsets[0], [-0.1, 0.1], atol=0.04)
        found.append(comparison.variance[0])
    assert 0.5 < np.mean(found) / np.var([1.9, 2.1], ddof=1) < 1.5


def test_an_excess_of_noise_takes_its_share_of_what_differs(rng):
    u, y = line(rng, rng.standard_normal(N))
    _, parts, white = fit(u, y, {"thirds": [np.arange(N) * 3 // N]})
    one, four = (parts["thirds"].compared(white, np.eye(2), np.full(2, x)) for x in (1.0, 4.0))
    assert np.all(four.p_value > one.p_value)
    np.testing.assert_array_equal(one.offsets, four.offsets)


def test_one_part_differs_from_nothing(rng):
    u, y = line(rng, rng.standard_normal(N))
    _, parts, white = fit(u, y, {"all": [np.zeros(N, dtype=int)]})
    comparison = parts["all"].compared(white, np.eye(2), np.ones(2))
    np.testing.assert_array_equal(comparison.variance, 0.0)
    np.testing.assert_allclose(comparison.p_value, 1.0, atol=1e-6)
    assert np.all(np.isfinite(parts["all"].sandwich(white)))


def test_known_noise_is_taken_as_known(rng):
    u, y = line(rng, rng.standard_normal(N))
    problem = likelihood_problem(static(), [(u, y, 0)], sigma=[2.0])
    point = problem.point(np.zeros(2), np.zeros((1, 0)))
    found, _ = problem.linearise(point).covariance(gauge=True)
    np.testing.assert_allclose(found, np.linalg.inv(u.T @ u) * 4.0, rtol=1e-9)


# ---- divisions ----------------------------------------------------------------------------


def motions(rng, lengths):
    found = []
    for n in lengths:
        y = lfilter([1.0], [1.0, -0.95], rng.standard_normal((n, 2)), axis=0)
        found.append(y - y.mean(axis=0))
    return found


@pytest.mark.parametrize("lengths", [(3000,), (700, 60, 900), (25, 3000), (5, 400)])
def test_blocks_follow_each_other_and_hold_as_much_of_the_motion(rng, lengths):
    moved = motions(rng, lengths)
    parts = blocks_in_time(moved)
    assert [len(part) for part in parts] == list(lengths)
    whole = np.concatenate(parts)
    steps = np.diff(whole)
    assert whole[0] == 0
    assert np.all((steps == 0) | (steps == 1))  # none is left out, none comes back
    for one, other in pairwise(parts):
        assert other[0] == one[-1] + 1  # none over two records
    assert whole[-1] < N_BLOCKS + 2 * len(lengths)
    for part in parts:
        assert len(part) < 2 * FEWEST or len(np.unique(part)) <= len(part) // FEWEST
    if lengths == (3000,):
        assert whole[-1] == N_BLOCKS - 1
        square = np.sum(moved[0] ** 2 / np.mean(moved[0] ** 2, axis=0), axis=1)
        weight = square / square.sum() + 1.0 / len(square)
        held = np.bincount(whole, weights=weight)
        assert np.ptp(held) <= 2.1 * np.max(weight)


def test_blocks_of_rest_are_of_equal_length():
    parts = blocks_in_time([np.concatenate([np.zeros((1000, 1)), np.ones((1000, 1))])])
    counts = np.bincount(parts[0])
    assert len(counts) == N_BLOCKS
    assert counts[0] > 2 * counts[-1]  # the motion is divided finer
    level = np.bincount(blocks_in_time([np.ones((2000, 1))])[0])
    assert np.ptp(level) <= 2


def test_a_record_at_rest_is_divided_too():
    """Nothing moves at all: no division by nothing."""
    with np.errstate(all="raise"):
        parts = blocks_in_time([np.zeros((800, 2))])
        assert len(np.unique(parts[0])) > 1
        sizes, directions = by_size([np.zeros((800, 2))], 5), by_direction([np.zeros((800, 2))])
    assert len(sizes[0]) == len(directions[0]) == 800


def test_sizes_hold_a_third_of_the_square_each(rng):
    moved = motions(rng, (3000, 900))
    parts = np.concatenate(by_size(moved, 1))
    square = np.concatenate(moved) ** 2
    square = np.mean(square / square.mean(axis=0), axis=1)
    assert set(parts) == set(range(LEVELS))
    held = np.bincount(parts, weights=square) / square.sum()
    np.testing.assert_allclose(held, 1 / LEVELS, atol=0.01)
    largest = [square[parts == level].max() for level in range(LEVELS - 1)]
    smallest = [square[parts == level].min() for level in range(1, LEVELS)]
    assert np.all(np.array(largest) <= smallest)


def test_sizes_of_units_count_alike(rng):
    moved = motions(rng, (1200,))
    scaled = [each * [1e-6, 1e3] for each in moved]
    for division in (lambda m: by_size(m, 10), by_direction, blocks_in_time):
        np.testing.assert_array_equal(division(moved)[0], division(scaled)[0])


def test_directions_are_the_sides_of_the_largest_extent(rng):
    along = rng.standard_normal(1500)
    motion = np.outer(along, [1.0, -2.0]) + 0.01 * rng.standard_normal((1500, 2))
    parts = by_direction([motion])[0]
    assert set(parts) == {0, 1}
    same = np.mean((along > 0) == parts)
    assert max(same, 1 - same) > 0.98
