"""The multipliers' least-squares problem once all else is eliminated."""

import numpy as np
import pytest

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.periodic.multipliers import (
    Modes,
    _Elimination,
    characteristic,
    invariant_blocks,
    with_characteristic,
    without_noise_growth,
)


def problem(blocks, directions, target):
    """Multipliers below 2."""
    edges = np.cumsum([len(block) for block in blocks])[:-1]
    return _Elimination(edges, Modes(directions), target, 2.0)


@pytest.mark.parametrize("n_segments", [1, 3])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_jacobian_of_what_is_left_is_the_derivative(rng, n, n_segments):
    """Central differences, with an input at rest in the first segment too."""
    Phi = rng.standard_normal((n, n))
    Phi *= 0.9 / np.max(np.abs(np.linalg.eigvals(Phi)))
    _, blocks = invariant_blocks(Phi)
    directions = [rng.standard_normal((40, 2)) for _ in range(n_segments)]
    directions[0][:, 1] = 0.0
    elimination = problem(blocks, directions, rng.standard_normal((40 * n_segments, 7)))
    point = np.concatenate([characteristic(block) for block in blocks])
    columns = [
        (elimination.left(point + step)[0] - elimination.left(point - step)[0]) / 2e-6
        for step in 1e-6 * np.eye(n)
    ]
    left, jacobian = elimination.left(point)
    np.testing.assert_allclose(jacobian, np.transpose(columns), atol=1e-7)
    factor, both = elimination.factor(point), np.column_stack([jacobian, left])
    np.testing.assert_allclose(factor.T @ factor, both.T @ both, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_what_is_left_is_what_no_answer_of_the_modes_explains(rng, n):
    """Simulated by the map itself, in two segments of which one is a single period."""
    Phi = rng.standard_normal((n, n))
    Phi *= 0.95 / np.max(np.abs(np.linalg.eigvals(Phi)))
    _, blocks = invariant_blocks(Phi)
    directions, target = (
        [rng.standard_normal((k, 2)) for k in (40, 1)],
        rng.standard_normal((41, 3)),
    )
    columns = [np.vstack(directions)]
    for s, w in enumerate(directions):
        free = [np.zeros((len(v), n)) for v in directions]
        for x in np.eye(n):
            free[s] = propagate(Phi, np.zeros((len(w), n)), x)
            columns.append(np.vstack(free))
    for j, unit in np.ndindex(2, n):
        forced = [
            propagate(Phi, np.outer(w[:, j], np.eye(n)[unit]), np.zeros(n)) for w in directions
        ]
        columns.append(np.vstack(forced))
    M = np.hstack(columns)
    expected = target - M @ np.linalg.lstsq(M, target)[0]
    point = np.concatenate([characteristic(block) for block in blocks])
    left, _ = problem(blocks, directions, target).left(point)
    np.testing.assert_allclose(left, expected.ravel(), atol=1e-9)


def test_beyond_the_largest_multiplier_nothing_is_explained_and_nothing_moves(rng):
    target = rng.standard_normal((20, 3))
    elimination = problem([np.eye(1)], [rng.standard_normal((20, 1))], target)
    left, jacobian = elimination.left(np.array([2.5]))
    np.testing.assert_array_equal(left, target.ravel())
    assert not jacobian.any()


@pytest.mark.parametrize("block", [[[-0.3, 0.8], [0.2, -1.1]], [[-0.2, 1.0], [-1.4, -0.3]]])
@pytest.mark.parametrize("coefficients", [(-1.2, 0.2), (-0.6, 1.5), (-0.4, 9.0), (3.0, -8.0)])
def test_a_block_takes_the_polynomial_asked_for(block, coefficients):
    """Of the kind it had, of the other one, and far beyond what it was."""
    found = with_characteristic(np.array(block), coefficients)
    np.testing.assert_allclose(characteristic(found), coefficients, rtol=1e-12)


@pytest.mark.parametrize("start", [0.3, 1.2, 2.5, 40.0])
def test_a_start_that_outgrows_numbers_finds_back(rng, start):
    """A period of 12 samples tells a multiplier of 0.04 that noise has made any number."""
    w = [rng.standard_normal((60, 1))]
    Phi, true = np.diag([0.7, start]), np.diag([0.7, 0.04])
    states = propagate(true, w[0] @ [[1.0, 2.0]], np.zeros(2))
    lifted = [states @ rng.standard_normal((2, 12))]
    found = np.linalg.eigvals(without_noise_growth(Phi, w, lifted))
    np.testing.assert_allclose(np.sort(found), [0.04, 0.7], atol=1e-6)


@pytest.mark.parametrize("growth", [1.05, 2.6])
def test_growth_that_the_record_shows_is_kept(rng, growth):
    w = [rng.standard_normal((40, 1))]
    true = np.diag([growth, 0.4])
    states = propagate(true, w[0] @ [[1.0, 2.0]], np.zeros(2))
    lifted = [states @ rng.standard_normal((2, 12)) + 1e-3 * rng.standard_normal((40, 12))]
    found = np.linalg.eigvals(without_noise_growth(true + 0.01 * np.eye(2), w, lifted))
    np.testing.assert_allclose(np.max(found), growth, rtol=0.01)
