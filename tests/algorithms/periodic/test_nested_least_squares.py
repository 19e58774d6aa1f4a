"""Least squares on a growing number of regressors."""

import numpy as np

from sklearn_hd.algorithms.periodic.combined_periods import NestedLeastSquares


def test_at_each_stage_the_solution_is_that_of_all_columns_so_far(rng):
    y, blocks = rng.standard_normal(60), [rng.standard_normal((60, k)) for k in (3, 1, 7)]
    blocks[1] = blocks[0] @ rng.standard_normal((3, 1)) + 1e-6 * blocks[1]  # nearly known before
    blocks[2] *= 1e8
    fit = NestedLeastSquares(y)
    for k in range(3):
        fit.extend(blocks[k])
        X = np.hstack(blocks[: k + 1])
        size = np.linalg.norm(X, axis=0)
        expected = np.linalg.lstsq(X / size, y)[0] / size
        solution, left, unknown = fit.solve()
        np.testing.assert_allclose(solution, expected, rtol=1e-8)
        np.testing.assert_allclose(left, y - X @ expected, atol=1e-10)
        assert not unknown.any()


def test_dependent_columns_are_told_and_share(rng):
    y, X = rng.standard_normal(30), rng.standard_normal((30, 4))
    fit = NestedLeastSquares(y)
    fit.extend(X)
    plain, left, _ = fit.solve()
    fit.extend(X[:, [1]])
    solution, same, unknown = fit.solve()
    assert unknown.tolist() == [False, True, False, False, True]
    np.testing.assert_allclose(solution[[1, 4]], 0.5 * plain[1], rtol=1e-9)
    np.testing.assert_allclose(same, left, atol=1e-13)


def test_columns_of_zeros_are_unknown_and_zero(rng):
    fit = NestedLeastSquares(rng.standard_normal(10))
    fit.extend(np.zeros((10, 2)))
    solution, left, unknown = fit.solve()
    assert solution.tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(left, fit.target)
    assert unknown.all()


def test_what_no_column_adds_does_not_spoil_the_blocks_after_it(rng):
    """Directions that are rounding must not be taken for new ones."""
    fit, X = NestedLeastSquares(rng.standard_normal(20)), np.zeros((20, 0))
    for _ in range(4):
        block = rng.standard_normal((20, 4))
        block[:, 0] = 0.0
        block[:, 1] = X @ rng.standard_normal(X.shape[1])  # known before; of zeros at first
        fit.extend(block)
        X, y = np.hstack([X, block]), fit.target
        left = fit.solve()[1]
        expected = y - X @ np.linalg.lstsq(X, y, rcond=1e-11)[0]
        np.testing.assert_allclose(left, expected, atol=1e-12)
