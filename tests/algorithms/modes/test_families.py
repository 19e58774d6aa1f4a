"""Laws of the mode classification kernels."""

import numpy as np
import pytest
from conftest import same_poles

from sklearn_hd.algorithms.lti.simulation import (
    block_diagonal,
    frequency_response,
    propagate,
    residualize,
)
from sklearn_hd.algorithms.modes.families import (
    agreeing_copies,
    conjugate_units,
    expected_members,
    floquet_families,
    is_window_pole,
    real_block,
)


def test_copies_share_a_family_whatever_their_shift():
    omega, rows = 2 * np.pi, 8
    base = np.array([-0.2 + 2.0j, -0.2 - 2.0j, -1.5 + 0j])
    exponents = np.array([lam + 1j * p * omega for lam in base for p in range(-3, 4)])
    families = floquet_families(np.exp(exponents / rows), rows, 0.05)
    assert families.tolist() == [0] * 14 + [1] * 7


def test_window_poles_are_those_that_die_within_it():
    z = np.array([0.99, 0.5, 0.3 + 0.1j, 1e-4])
    assert is_window_pole(z, 8, 1e-3).tolist() == [False, False, True, True]


def test_units_are_closed_under_conjugation():
    z = np.array([0.5 + 0.2j, 0.9, 0.5 - 0.2j, -0.3, 0.1j, -0.1j])
    assert sorted(conjugate_units(z)) == [(0, 2), (1,), (4, 5)]


def test_a_subspace_split_off_keeps_poles_and_response(rng):
    """Even beside a defective block at zero, as a window leaves it."""
    genuine = np.array([0.9, 0.5 + 0.3j, 0.5 - 0.3j])
    core = np.array([[0.9, 0, 0], [0, 0.5, 0.3], [0, -0.3, 0.5]])
    jordan = np.diag(np.ones(3), 1)
    T = rng.standard_normal((7, 7))
    A = T @ np.block([[core, np.zeros((3, 4))], [np.zeros((4, 3)), jordan]]) @ np.linalg.inv(T)
    C = rng.standard_normal((2, 7))
    z = np.linalg.eigvals(A)
    kept = z[np.abs(z) > 0.1]
    A_split, _, C_split = block_diagonal(A, np.zeros((7, 0)), C, kept, z[np.abs(z) <= 0.1])
    A_kept, C_kept = A_split[:3, :3], C_split[:, :3]
    assert same_poles(np.linalg.eigvals(A_kept), genuine, 1e-9)
    x0 = T[:, :3] @ rng.standard_normal(3)
    y = propagate(A, np.zeros((30, 7)), x0) @ C.T
    free = propagate(A_kept, np.zeros((3, 30, 3)), np.eye(3)) @ C_kept.T
    X = free.reshape(3, -1).T
    np.testing.assert_allclose(
        X @ np.linalg.lstsq(X, y.ravel(), rcond=None)[0], y.ravel(), atol=1e-8
    )


def test_residualization_keeps_slow_poles_and_static_gain(rng):
    T = rng.standard_normal((4, 4))
    slow, fast = np.array([-1.0, -2.0]), np.array([-30 + 4j, -30 - 4j])
    block = np.zeros((4, 4))
    block[:2, :2], block[2:, 2:] = np.diag(slow), [[-30, 4], [-4, -30]]
    A = T @ block @ np.linalg.inv(T)
    B, C, D = rng.standard_normal((4, 2)), rng.standard_normal((3, 4)), rng.standard_normal((3, 2))
    reduced = residualize(A, B, C, D, slow, fast)
    assert same_poles(np.linalg.eigvals(reduced[0]), slow, 1e-9)
    np.testing.assert_allclose(
        frequency_response(*reduced, [0]), frequency_response(A, B, C, D, [0]), rtol=1e-8
    )


def test_block_diagonal_coordinates_leave_the_response_alone(rng):
    A = rng.standard_normal((5, 5)) - 3 * np.eye(5)
    z = np.linalg.eigvals(A)
    order = np.argsort(-z.real)
    n = 2 if z[order[1]].imag == 0 or np.isclose(z[order[1]], np.conj(z[order[0]])) else 3
    B, C = rng.standard_normal((5, 1)), rng.standard_normal((1, 5))
    moved = block_diagonal(A, B, C, z[order[:n]], z[order[n:]])
    assert np.abs(moved[0][:n, n:]).max() < 1e-10
    s, D = 1j * np.array([0.1, 2.0]), np.zeros((1, 1))
    np.testing.assert_allclose(
        frequency_response(*moved, D, s), frequency_response(A, B, C, D, s), rtol=1e-9
    )
    assert block_diagonal(A, B, C, z, z[:0])[0] is A


def test_one_eigenvalue_in_both_groups_is_refused():
    A = np.array([[-1.0, 1.0], [0.0, -1.0]])
    with pytest.raises(ValueError, match="share an eigenvalue"):
        block_diagonal(A, np.ones((2, 1)), np.ones((1, 2)), np.array([-1.0]), np.array([-1.0]))


def test_members_of_a_decomposition_are_the_differences_of_its_harmonics():
    assert expected_members([(0, 1, 2)], 16) == 9
    assert expected_members([(0, 1, 2)], 8) == 8  # they fold
    assert expected_members([(3,), (0,)], 12) == 2  # 6 and -6 are one
    assert expected_members([(0,)], 8) == 1


@pytest.mark.parametrize("exponent", [-0.5 + 0j, -0.5 + 1.3j, -0.5 + 1j * np.pi])
def test_families_are_complete_with_all_copies(exponent):
    """Real multipliers, negative ones, and pairs; the omission of one copy shows."""
    rows = 8
    members = exponent + 2j * np.pi * np.arange(rows)
    z = np.exp(members / rows)
    if 0 < exponent.imag < 3:
        z = np.concatenate([z, z.conj()])
    alone = np.array([np.exp(-0.9 / rows)])
    every = np.concatenate([z, alone])
    found = agreeing_copies(every, [(0, 1, 2)], rows, 1e-3)
    assert found.tolist() == [True] * len(z) + [False]
    assert not agreeing_copies(every[1:], [(0, 1, 2)], rows, 1e-3).any()
    spread = every * np.exp(0.01 * np.arange(len(every)) / rows)
    assert not agreeing_copies(spread, [(0, 1, 2)], rows, 1e-3).any()


def test_real_block_has_the_exponents_as_eigenvalues():
    exponents = [-1.0, -0.5 + 2.0j]
    assert same_poles(np.linalg.eigvals(real_block(exponents)), [-1, -0.5 + 2j, -0.5 - 2j], 1e-12)
    assert real_block([]).shape == (0, 0)
