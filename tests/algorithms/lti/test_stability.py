"""Laws of the nearest stable matrix."""

import numpy as np
import pytest
from conftest import random_stable, same_poles
from scipy.linalg import solve_discrete_lyapunov

from sklearn_hd.algorithms.lti.simulation import growth, is_stable, nearest_stable


def unstable(rng, n, radius=1.3):
    A = rng.standard_normal((n, n))
    return A * (radius / np.max(np.abs(np.linalg.eigvals(A))))


@pytest.mark.parametrize("n", [1, 2, 5, 12, 30])
def test_unstable_eigenvalues_are_mirrored_and_the_others_stay(rng, n):
    A = unstable(rng, n)
    values = np.linalg.eigvals(A)
    wanted = np.where(np.abs(values) > 1.0, 1.0 / values.conj(), values)
    assert same_poles(np.linalg.eigvals(nearest_stable(A, rng.uniform(0.1, 9.0, n))), wanted, 1e-8)


def test_a_stable_matrix_is_its_own(rng):
    A = random_stable(rng, 5, 1, 1)[0]
    assert nearest_stable(A, np.ones(5)) is A
    mirrored = nearest_stable(unstable(rng, 5), np.ones(5))
    assert nearest_stable(mirrored, np.ones(5)) is mirrored


def test_units_of_the_states_do_not_matter(rng):
    A, weights, size = unstable(rng, 4), rng.uniform(0.1, 9.0, 4), rng.uniform(0.01, 100.0, 4)
    scaled = nearest_stable(A * size[:, None] / size, weights / size**2)
    np.testing.assert_allclose(
        scaled * size / size[:, None], nearest_stable(A, weights), rtol=1e-8, atol=1e-10
    )


def test_modes_of_stable_eigenvalues_keep_their_shape(rng):
    A = unstable(rng, 6)
    values, modes = np.linalg.eig(A)
    kept = modes[:, np.abs(values) < 1.0]
    assert 0 < kept.shape[1] < 6
    np.testing.assert_allclose(nearest_stable(A, np.ones(6)) @ kept, A @ kept, atol=1e-10)


def test_of_all_stable_matrices_it_changes_states_least(rng):
    """tr(W (A′ − A) X (A′ − A)ᵀ), X = A′ X A′ᵀ + W⁻¹ s, against others nearby, for small noise."""
    A, weights = unstable(rng, 3), rng.uniform(0.5, 2.0, 3)
    best = nearest_stable(A, weights)

    def change(near):
        X = solve_discrete_lyapunov(near, np.diag(1.0 / weights))
        return np.trace(np.diag(weights) @ (near - A) @ X @ (near - A).T)

    least = change(best)
    for _ in range(200):
        other = best + 1e-3 * rng.standard_normal((3, 3))
        if is_stable(other):
            assert change(other) >= least * (1.0 - 1e-9)


def test_double_integrators_that_grow_are_mirrored_without_a_warning():
    """The suite makes SciPy's, of ill-conditioned equations, errors."""
    for rate in (1e-3, 1e-6, 1e-9):
        A = np.array([[1.0 + rate, 1.0], [0.0, 1.0 + rate]])
        assert growth(nearest_stable(A, np.ones(2))) <= 1e-7


def test_an_integrator_is_stable():
    assert is_stable(np.eye(2))
    assert not is_stable(1.0001 * np.eye(2))
