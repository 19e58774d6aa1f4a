"""Laws of the mode classification kernels."""

import itertools

import numpy as np
import pytest
from conftest import same_poles

from sklearn_hd.algorithms import modes as kernel
from sklearn_hd.algorithms.modes import (
    best_modes,
    complete_families,
    conjugate_units,
    expected_members,
    floquet_families,
    invariant_pair,
    is_window_pole,
    mode_regressors,
    residual,
)
from sklearn_hd.algorithms.residualization import block_diagonal, residualize
from sklearn_hd.algorithms.simulation import frequency_response, propagate


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


@pytest.mark.parametrize("exponent", [-0.7 + 0j, -0.4 + 3.0j])
def test_regressors_span_the_response_of_the_mode(rng, exponent):
    """Any response of the mode, driven from any state, is a combination of them."""
    dt, u = 0.05, rng.standard_normal((80, 2))
    z = np.exp(exponent * dt)
    A = np.array([[z.real, z.imag], [-z.imag, z.real]]) if exponent.imag else np.array([[z.real]])
    shape = rng.standard_normal(3) + (1j * rng.standard_normal(3) if exponent.imag else 0)
    C = np.column_stack([shape.real, shape.imag]) if exponent.imag else shape.real[:, None]
    x = propagate(A, u @ rng.standard_normal((2, len(A))), rng.standard_normal(len(A)))
    y = (x @ C.T).reshape(-1)
    X = mode_regressors(exponent, shape, u, dt).reshape(len(y), -1)
    solution = np.linalg.lstsq(X, y, rcond=None)[0]
    np.testing.assert_allclose(X @ solution, y, atol=1e-9)


def test_best_set_is_the_best_of_all(rng):
    sizes = [1, 2, 1, 2, 1]
    edges = np.cumsum([0, *(2 * size for size in sizes)])
    columns = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    data = rng.standard_normal((60, edges[-1] + 1))
    R = np.linalg.qr(data, mode="r")
    value, units = best_modes(R, columns, sizes, 4)[0]
    brute = [
        (residual(R, columns, some), some)
        for k in range(1, 6)
        for some in itertools.combinations(range(5), k)
        if sum(sizes[i] for i in some) == 4
    ]
    assert (value, units) == min(brute)
    target = data[:, -1]
    X = data[:, np.concatenate([columns[i] for i in units])]
    fit = X @ np.linalg.lstsq(X, target, rcond=None)[0]
    assert value == pytest.approx(np.sum((target - fit) ** 2), rel=1e-9)


def test_search_by_exchange_finds_what_all_sets_would(rng, monkeypatch):
    sizes = [1, 2, 1, 2, 1, 2]
    edges = np.cumsum([0, *(2 * size for size in sizes)])
    columns = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    data = rng.standard_normal((200, edges[-1] + 1))
    data[:, -1] = data[:, columns[1]].sum(axis=1) + 2 * data[:, columns[4]].sum(axis=1)
    R = np.linalg.qr(data, mode="r")
    full = best_modes(R, columns, sizes, 3)[0]
    monkeypatch.setattr(kernel, "MAX_SUBSETS", 0)
    value, units = best_modes(R, columns, sizes, 3)[0]
    assert units == full[1] == (1, 4)
    assert value < 1e-20
    assert value == pytest.approx(full[0], abs=1e-20)


def test_many_states_grow_from_fewer(rng, monkeypatch):
    """Each set holds a smaller one, and is the best of those that do."""
    sizes = [1, 2, 1, 2, 1, 2, 2, 1]
    edges = np.cumsum([0, *(2 * size for size in sizes)])
    columns = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    R = np.linalg.qr(rng.standard_normal((200, edges[-1] + 1)), mode="r")
    grown = [best_modes(R, columns, sizes, n)[0] for n in (3, 4)]
    monkeypatch.setattr(kernel, "MANY", 4)
    monkeypatch.setattr(kernel, "FEW_SUBSETS", 1)
    for n in range(5, 12):
        smaller = [set(units) for _, units in grown[-2:]]
        grown += best_modes(R, columns, sizes, n, grown[-2:])
        all_sets = itertools.chain(*(itertools.combinations(range(8), k) for k in range(2, 9)))
        best = min(
            (residual(R, columns, units), units)
            for units in all_sets
            if sum(sizes[i] for i in units) == n
            and any(less < set(units) and len(units) == len(less) + 1 for less in smaller)
        )
        assert grown[-1][0] == pytest.approx(best[0], rel=1e-9)
        assert grown[-1][1] == best[1]


def test_no_set_of_pairs_has_an_odd_number_of_states():
    assert best_modes(np.eye(5), [np.arange(2), np.arange(2, 4)], [2, 2], 3) == []


def test_invariant_pair_keeps_poles_and_response(rng):
    """Even beside a defective block at zero, as a window leaves it."""
    genuine = np.array([0.9, 0.5 + 0.3j, 0.5 - 0.3j])
    core = np.array([[0.9, 0, 0], [0, 0.5, 0.3], [0, -0.3, 0.5]])
    jordan = np.diag(np.ones(3), 1)
    T = rng.standard_normal((7, 7))
    A = T @ np.block([[core, np.zeros((3, 4))], [np.zeros((4, 3)), jordan]]) @ np.linalg.inv(T)
    C = rng.standard_normal((2, 7))
    z = np.linalg.eigvals(A)
    kept = z[np.abs(z) > 0.1]
    A_kept, C_kept = invariant_pair(A, C, kept, z[np.abs(z) <= 0.1])
    assert same_poles(np.linalg.eigvals(A_kept), genuine, 1e-9)
    x0 = T[:, :3] @ rng.standard_normal(3)
    y = propagate(A, np.zeros((30, 7)), x0) @ C.T
    free = propagate(A_kept, np.zeros((3, 30, 3)), np.eye(3)) @ C_kept.T
    X = free.reshape(3, -1).T
    np.testing.assert_allclose(
        X @ np.linalg.lstsq(X, y.ravel(), rcond=None)[0], y.ravel(), atol=1e-8
    )


def test_coinciding_poles_cannot_be_separated():
    A = np.array([[0.5, 1.0], [0.0, 0.5]])
    with pytest.raises(ValueError, match="cannot be separated"):
        invariant_pair(A, np.eye(2), np.array([0.5]), np.array([0.5]))


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
    families = floquet_families(every, rows, 0.05)
    found = complete_families(every, families, rows, rows, 1e-3)
    assert found.tolist() == [True] * len(z) + [False]
    fewer = every[1:]
    assert not complete_families(fewer, families[1:], rows, rows, 1e-3).any()
    spread = every * np.exp(0.01 * np.arange(len(every)) / rows)
    assert not complete_families(spread, families, rows, rows, 1e-3).any()
