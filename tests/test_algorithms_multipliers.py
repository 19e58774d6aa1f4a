"""The multipliers' least-squares problem once all else is eliminated."""

import numpy as np
import pytest

from sklearn_hd.algorithms.multipliers import _Elimination, characteristic, invariant_blocks


@pytest.mark.parametrize("n_segments", [1, 3])
@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_jacobian_of_what_is_left_is_the_derivative(rng, n, n_segments):
    """Central differences, with an input at rest in the first segment too."""
    Phi = rng.standard_normal((n, n))
    Phi *= 0.9 / np.max(np.abs(np.linalg.eigvals(Phi)))
    _, blocks = invariant_blocks(Phi)
    directions = [rng.standard_normal((40, 2)) for _ in range(n_segments)]
    directions[0][:, 1] = 0.0
    elimination = _Elimination(blocks, directions, rng.standard_normal((40 * n_segments, 7)), 2.0)
    point = np.concatenate([characteristic(block) for block in blocks])
    columns = [
        (elimination.left(point + step) - elimination.left(point - step)) / 2e-6
        for step in 1e-6 * np.eye(n)
    ]
    np.testing.assert_allclose(elimination.jacobian(point), np.transpose(columns), atol=1e-7)


def test_beyond_the_largest_multiplier_nothing_is_explained_and_nothing_moves(rng):
    target = rng.standard_normal((20, 3))
    elimination = _Elimination([np.eye(1)], [rng.standard_normal((20, 1))], target, 2.0)
    np.testing.assert_array_equal(elimination.left(np.array([2.5])), target.ravel())
    assert not elimination.jacobian(np.array([2.5])).any()
