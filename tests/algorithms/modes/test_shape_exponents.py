"""The least-squares problem of shapes and exponents."""

import numpy as np
import pytest
from scipy import linalg

from sklearn_hd.algorithms.modes.shape_exponents import _Left, _ShapeProblem
from sklearn_hd.algorithms.periodic.multipliers import (
    RefinedMap,
    block_and_slopes,
    characteristic,
    with_characteristic,
)
from sklearn_hd.algorithms.periodic.periodic_realization import shape_functions

PHASES = 16
REAL, PAIR = np.array([[-0.3, 0.8], [0.2, -1.1]]), np.array([[-0.2, 1.0], [-1.4, -0.3]])


@pytest.mark.parametrize("block", [REAL, PAIR])
@pytest.mark.parametrize("coefficients", [(-1.2, 0.2), (-0.6, 1.5), (-0.4, 9.0), (3.0, -8.0)])
def test_a_block_moves_as_its_slopes_say(block, coefficients):
    """Of the kind it had, of the other one, and far beyond what it was."""
    found, slopes = block_and_slopes(block, np.array(coefficients))
    np.testing.assert_allclose(characteristic(found), coefficients, rtol=1e-12)
    for slope, step in zip(slopes, 1e-6 * np.eye(2), strict=True):
        after, before = (with_characteristic(block, coefficients + d) for d in (step, -step))
        np.testing.assert_allclose(slope, (after - before) / 2e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("rates", "signs"),
    [([REAL], [1.0]), ([PAIR, np.array([[-0.5]])], [1.0, 1.0]), ([PAIR, REAL], [1.0, -1.0])],
)
def test_jacobian_of_what_is_left_is_the_derivative(rng, rates, signs):
    blocks = [sign * linalg.expm(rate) for sign, rate in zip(signs, rates, strict=True)]
    n, wanted = sum(map(len, rates)), np.concatenate([characteristic(block) for block in blocks])
    refined = RefinedMap(linalg.block_diag(*blocks), np.eye(n), (), 1.1 * wanted, 3.0 * np.eye(n))
    root = rng.standard_normal((n, n))
    sights, residual = rng.standard_normal((PHASES, 2, n)), np.ones((PHASES, 2))
    problem = _ShapeProblem(sights, root @ root.T, residual, 50, refined, blocks, signs)
    psi = 2.0 * np.pi * np.arange(PHASES) / PHASES
    left = _Left(problem, [shape_functions(psi, 2, flip)[0] for flip in problem.flips])
    point = np.concatenate([characteristic(rate) for rate in problem.logarithms])
    columns = [(left(point + d)[0] - left(point - d)[0]) / 2e-6 for d in 1e-6 * np.eye(n)]
    residuals, jacobian = left(point)
    assert residuals.shape == (PHASES * n * 2 + n,)
    scale = np.abs(jacobian).max()
    np.testing.assert_allclose(jacobian, np.transpose(columns), atol=1e-7 * scale)


def test_beyond_the_fastest_exponent_stands_a_wall():
    refined = RefinedMap(np.eye(1), np.eye(1), (), np.ones(1), np.eye(1))
    problem = _ShapeProblem(
        np.ones((PHASES, 1, 1)), np.eye(1), np.ones((PHASES, 1)), 9, refined, [np.eye(1)], [1.0]
    )
    residuals, jacobian = _Left(problem, [np.ones((PHASES, 1))])(np.array([-30.0]))
    assert np.all(residuals == 1e100)
    assert not jacobian.any()
