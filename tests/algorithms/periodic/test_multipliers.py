"""The multipliers' least-squares problem once all else is eliminated."""

import numpy as np
import pytest

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.periodic import multipliers
from sklearn_hd.algorithms.periodic.multipliers import (
    Modes,
    _Elimination,
    characteristic,
    invariant_blocks,
    multiplier_deviations,
    refine_multipliers,
    turned_back,
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


@pytest.mark.parametrize("block", [[[-0.3, 0.8], [0.2, -1.1]], [[-0.2, 1.0], [-1.4, -0.3]]])
def test_a_block_that_stays_of_its_kind_keeps_its_eigenvectors(block):
    block = np.array(block)
    given = characteristic(block)
    np.testing.assert_allclose(with_characteristic(block, given), block, atol=1e-14)
    root = 0.25 * given[0] ** 2 - given[1]  # of a pair 1 ± √root: as far apart as before, times 3
    moved = with_characteristic(block, (2.0, 1.0 - 9.0 * root))
    np.testing.assert_allclose(moved @ block, block @ moved, atol=1e-13)


@pytest.mark.parametrize("block", [[[0, 1], [-1, 0]], [[0, -1], [1, 0]], [[-1, 4], [2, 3]]])
@pytest.mark.parametrize("root", [-9.0, -0.25, 0.25, 9.0])
def test_of_a_block_and_its_opposite_of_the_same_polynomial_the_nearer_is_taken(block, root):
    """s/2 I ± N have the same one."""
    block = np.array(block, dtype=float)
    trace = np.trace(block)
    moved = with_characteristic(block, (trace, 0.25 * trace**2 - root))
    opposite = trace * np.eye(2) - moved
    assert np.linalg.norm(moved - block) <= np.linalg.norm(opposite - block)


@pytest.mark.parametrize("kind", [1.0, -1.0])
@pytest.mark.parametrize("angle", [0.0, 0.4, 1.3, -1.1])
@pytest.mark.parametrize("lower", [False, True])
def test_a_pair_moves_little_through_the_double_eigenvalue(kind, angle, lower):
    """From s/2 ± e to s/2 ± j e, or back: by e² where the block itself is of size one."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    for e in (1e-2, 1e-4):
        N = np.array([[0.0, -1.0], [-kind * e**2, 0.0]])
        block = 0.7 * np.eye(2) + turn @ (N.T if lower else N) @ turn.T
        moved = with_characteristic(block, (1.4, 0.49 + kind * e**2))
        np.testing.assert_allclose(moved, block, atol=2.1 * e**2)
        np.testing.assert_allclose(characteristic(moved), (1.4, 0.49 + kind * e**2), rtol=1e-12)


@pytest.mark.parametrize("shape", [(200, 30), (30, 200), (80, 80)])
@pytest.mark.slow
def test_the_strongest_direction_of_white_noise_has_the_law_of_tracy_and_widom(
    shape, rng, monkeypatch
):
    """Quantiles of Bejan (2005), β = 1. The noise's size, from the same data, takes some of the
    spread away (Nadler, 2011): tails hold less."""
    draws = 1e-3 * rng.standard_normal((1500, *shape))
    for quantile, least, most in (
        (-3.1808, 0.01, 0.05),
        (-1.2686, 0.43, 0.57),
        (0.9793, 0.95, 0.985),
    ):
        monkeypatch.setattr(multipliers, "TRACY_WIDOM", quantile)
        found = np.mean([multipliers.is_noise(rest, *shape) for rest in draws])
        assert least <= found <= most


@pytest.mark.parametrize(("apart", "power"), [(0.0, 0.5), (0.4, 1.0)])
def test_a_double_multiplier_is_known_to_the_square_root_of_the_noise(rng, apart, power):
    """An error e of the polynomial moves single roots by a multiple of e, double ones by √e."""
    Phi = np.array([[0.6 + 0.5 * apart, 1.0], [0.0, 0.6 - 0.5 * apart]])
    states = [np.array([0.3, 1.0])]
    for _ in range(30):
        states.append(Phi @ states[-1])
    clean = np.array(states) @ rng.standard_normal((2, 6))
    noise, none = rng.standard_normal(clean.shape), [np.zeros((31, 0))]
    found = [multiplier_deviations(Phi, none, [clean + level * noise])[1] for level in (1e-8, 1e-4)]
    np.testing.assert_allclose(np.log(found[1] / found[0]) / np.log(1e4), power, atol=0.02)


@pytest.mark.parametrize("n_directions", [1, 9])
def test_deviations_hold_however_much_the_inputs_explain(n_directions):
    """Root mean square of error over deviation, 40 records of 60 periods: nine directions and the
    answers of two modes to them leave half of the rows to tell the noise."""
    truth, z = np.array([0.8, 0.4]), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        Phi, B = np.diag(truth), rng.standard_normal((2, n_directions))
        w, states = rng.standard_normal((60, n_directions)), [rng.standard_normal(2)]
        for row in w[:-1]:
            states.append(Phi @ states[-1] + B @ row)
        y = np.array(states) @ rng.standard_normal((2, 10)) + w @ np.ones((n_directions, 10))
        y += 0.01 * y.std() * rng.standard_normal(y.shape)
        found, deviations = multiplier_deviations(refine_multipliers(Phi, [w], [y]), [w], [y])
        order = np.argsort(-found.real)
        z.append((np.log(found[order].real) - np.log(truth)) / deviations[order])
    assert 0.8 < np.sqrt(np.mean(np.square(z))) < 1.15


def test_two_deviations_hold_where_noise_splits_a_pair_that_is_nearly_double():
    """Either root may be where the other is, and errors towards it are larger than away from it."""
    Phi, within = np.array([[0.41, 0.2], [-1e-4, 0.41]]), []
    truth = np.log(np.linalg.eigvals(Phi).astype(complex))
    for seed in range(100):
        rng = np.random.default_rng(seed)
        states = [np.array([1.0, 1.0])]
        for _ in range(29):
            states.append(Phi @ states[-1])
        y = np.array(states) @ rng.standard_normal((2, 10))
        y += 2e-3 * y[0].std() * rng.standard_normal(y.shape)
        none = [np.zeros((30, 0))]
        found, deviations = multiplier_deviations(refine_multipliers(Phi, none, [y]), none, [y])
        off = np.abs(np.log(found.astype(complex))[:, None] - truth).min(axis=1)
        within += (off <= 2.0 * deviations).tolist()
    assert np.mean(within) > 0.9


def test_nothing_is_known_where_answers_explain_all_periods(rng):
    w, y = rng.standard_normal((8, 3)), rng.standard_normal((8, 5))
    assert np.isinf(multiplier_deviations(np.diag([0.8, 0.4]), [w], [y])[1]).all()


@pytest.mark.parametrize("values", [[-0.3], [0.6, -0.01], [-0.5, -0.2, -0.001], [0.5, 0.2]])
def test_a_map_turned_back_keeps_all_but_one_sign(rng, values):
    V = rng.standard_normal((len(values), len(values)))
    Phi, turned = turned_back(V @ np.diag(values) @ np.linalg.inv(V))
    wanted = np.array(values)
    if np.prod(wanted) < 0.0:
        assert np.isclose(turned, max(v for v in values if v < 0.0))
        wanted[wanted == max(v for v in values if v < 0.0)] *= -1.0
    else:
        assert turned == 0.0
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(Phi)), np.sort(wanted), rtol=1e-9)
