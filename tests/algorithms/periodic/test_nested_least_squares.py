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
        solution, left, _ = fit.solve()
        np.testing.assert_allclose(solution, expected, rtol=1e-8)
        np.testing.assert_allclose(left, y - X @ expected, atol=1e-10)
        assert not len(fit.undetermined)


def test_dependent_columns_are_told_and_share(rng):
    y, X = rng.standard_normal(30), rng.standard_normal((30, 4))
    fit = NestedLeastSquares(y)
    fit.extend(X)
    plain, left, _ = fit.solve()
    fit.extend(X[:, [1]])
    solution, same, _ = fit.solve()
    unknown = np.linalg.norm(fit.undetermined, axis=0)
    np.testing.assert_allclose(unknown, [0.0, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], atol=1e-12)
    np.testing.assert_allclose(solution[[1, 4]], 0.5 * plain[1], rtol=1e-9)
    np.testing.assert_allclose(same, left, atol=1e-13)


def test_columns_of_zeros_are_unknown_and_zero(rng):
    fit = NestedLeastSquares(rng.standard_normal(10))
    fit.extend(np.zeros((10, 2)))
    solution, left, _ = fit.solve()
    assert solution.tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(left, fit.target)
    assert len(fit.undetermined) == 2


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


def test_stiff_columns_have_the_marginal_likelihood_of_their_prior(rng):
    """Against the density of y itself, N(F b, σ² + τ² H Hᵀ), b profiled out."""
    n, k = 40, 6
    F, H, stiffness = rng.standard_normal((n, 2)), rng.standard_normal((n, k)), 1.0 + np.arange(k)
    H[:, 3] = H[:, 2] + 1e-3 * H[:, 3]  # hardly told apart
    y = F @ [1.0, -2.0] + H @ (0.3 * rng.standard_normal(k) / stiffness) + rng.standard_normal(n)
    fit = NestedLeastSquares(y)
    fit.extend(F)
    fit.extend(H)
    solution, left, misfit = fit.solve(np.append([0.0, 0.0], stiffness))

    def direct(ratio):  # σ²/τ²
        V = np.eye(n) + (H / stiffness) @ (H / stiffness).T / ratio
        inverse = np.linalg.inv(V)
        b = np.linalg.solve(F.T @ inverse @ F, F.T @ inverse @ y)
        off = np.linalg.qr(F, mode="complete")[0][:, 2:]  # the restricted likelihood
        cost = n * np.log((y - F @ b) @ inverse @ (y - F @ b))
        return cost + np.linalg.slogdet(off.T @ V @ off)[1] + np.log(n)

    ratios = 2.0 ** np.linspace(-40, 20, 600)
    assert abs(misfit - min(map(direct, ratios))) < 0.1
    np.testing.assert_allclose(left, y - np.hstack([F, H]) @ solution, atol=1e-12)


def test_exact_data_are_explained_exactly_by_the_smoothest_solution(rng):
    F, H = rng.standard_normal((30, 2)), rng.standard_normal((30, 3))
    H = np.hstack([H, H[:, [2]]])  # its last two never part
    stiffness, truth = np.array([0.0, 0.0, 1.0, 2.0, 3.0, 4.0]), rng.standard_normal(6)
    fit = NestedLeastSquares(np.hstack([F, H]) @ truth)
    fit.extend(np.hstack([F, H]))
    solution, left, _ = fit.solve(stiffness)
    np.testing.assert_allclose(solution[:4], truth[:4], rtol=1e-9)
    joint = truth[4] + truth[5]  # the least 9 b² + 16 c² of all b + c = joint
    np.testing.assert_allclose(solution[4:], [joint * 16 / 25, joint * 9 / 25], rtol=1e-9)
    assert np.abs(left).max() < 1e-12
