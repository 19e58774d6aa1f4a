"""Laws of the block Hankel factor and of PO-MOESP."""

import numpy as np
import pytest
from conftest import random_stable, same_poles

from sklearn_hd.algorithms.lti.simulation import frequency_response, propagate
from sklearn_hd.algorithms.subspace import input_matrices as kernel
from sklearn_hd.algorithms.subspace.hankel import _columns, hankel_factor, n_hankel_columns
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices, response_regressors
from sklearn_hd.algorithms.subspace.order import order_by_gap
from sklearn_hd.algorithms.subspace.projections import (
    noise_floor,
    observability_subspace,
    release_idle_directions,
    state_matrices,
)


def simulate(A, B, C, D, u, x0=None):
    x = propagate(A, u @ B.T, np.zeros(len(A)) if x0 is None else x0)
    return x @ C.T + u @ D.T


def test_columns_hold_consecutive_rows():
    u, y = np.arange(10.0)[:, None], 100 + np.arange(10.0)[:, None]
    first = _columns(u, y, 2, 0, 1)[0]
    assert first.tolist() == [2, 3, 0, 1, 100, 101, 102, 103]


def test_segments_shorter_than_two_hankel_windows_give_no_column():
    assert n_hankel_columns([7, 8, 9], 4) == 3


@pytest.mark.parametrize("feedthrough", [False, True])
def test_noise_free_data_give_the_system_back(rng, feedthrough):
    A, B, C = random_stable(rng, 4, 2, 3)
    D = rng.standard_normal((3, 2)) if feedthrough else np.zeros((3, 2))
    u = [rng.standard_normal((200, 2)), rng.standard_normal((150, 2))]
    starts = rng.standard_normal((2, 4))
    y = [simulate(A, B, C, D, u_s, x0) for u_s, x0 in zip(u, starts, strict=True)]
    R = hankel_factor(u, y, 6)
    U, values = observability_subspace(R, 6, 2)
    floor = noise_floor(R, 6, 2, n_hankel_columns([200, 150], 6))
    assert order_by_gap(values, floor, 15) == 4
    A_f, C_f = state_matrices(U, values, 4, 3)
    assert same_poles(np.linalg.eigvals(A_f), np.linalg.eigvals(A), 1e-9)
    B_f, D_f, _, rest = input_matrices(A_f, C_f, u, y, feedthrough, return_residual=True)
    z = np.exp(1j * np.linspace(0, np.pi, 5))
    np.testing.assert_allclose(
        frequency_response(A_f, B_f, C_f, D_f, z), frequency_response(A, B, C, D, z), atol=1e-8
    )
    assert rest < 1e-16


def test_white_noise_stays_below_the_floor(rng):
    """Outputs that are noise alone: no singular value stands above the floor."""
    u, y = rng.standard_normal((4000, 1)), rng.standard_normal((4000, 2))
    R = hankel_factor([u], [y], 8)
    values = observability_subspace(R, 8, 1)[1]
    floor = noise_floor(R, 8, 1, n_hankel_columns([4000], 8))
    assert values[0] < 1.1 * floor
    assert values[0] > 0.5 * floor


def test_gap_is_sought_next_to_the_floor():
    strong_and_weak = np.array([1000.0, 900.0, 9.0, 8.0, 0.9, 0.5])
    assert order_by_gap(strong_and_weak, 1.0, 5) == 4


def test_without_a_gap_all_values_above_the_floor_count():
    ramp = np.array([100.0, 50.0, 25.0, 13.0, 7.0, 4.0, 2.1, 1.5, 1.2, 0.9])
    assert order_by_gap(ramp, 1.0, 9) == 9
    assert order_by_gap(ramp, 1.0, 5) == 5


def test_idle_directions_of_the_input_take_no_response_with_them(rng):
    """A doublet and its products with harmonics: far fewer directions than rows."""
    A, B, C = random_stable(rng, 3, 1, 2)
    pulse = np.zeros(240)
    pulse[20:37], pulse[37:61] = 1.0, -1.0
    psi = 2 * np.pi * np.arange(240) / 8
    y = propagate(A, pulse[:, None] @ B.T, np.zeros(3)) @ C.T
    u = pulse[:, None] * np.stack([np.ones(240), np.cos(psi), np.sin(psi)], axis=1)
    R = hankel_factor([u], [y], 8)
    released = release_idle_directions(R, 24)
    size = np.linalg.norm(R)
    np.testing.assert_allclose(released.T @ released, R.T @ R, atol=1e-9 * size**2)
    U, values = observability_subspace(released, 8, 3)
    assert values[3] < 1e-10 * values[0]
    A_f, _ = state_matrices(U, values, 3, 2)
    assert same_poles(np.linalg.eigvals(A_f), np.linalg.eigvals(A), 1e-7)
    assert observability_subspace(R, 8, 3)[1][2] <= values[2] * (1 + 1e-9)


def test_a_full_input_is_left_alone(rng):
    R = hankel_factor([rng.standard_normal((90, 1))], [rng.standard_normal((90, 1))], 4)
    assert release_idle_directions(R, 4) is R


@pytest.mark.parametrize("feedthrough", [False, True])
def test_responses_by_convolution_are_those_of_the_recursion(rng, feedthrough, monkeypatch):
    A, _, C = random_stable(rng, 5, 2, 3)
    u = rng.standard_normal((60, 2))
    by_recursion = response_regressors(A, C, u, feedthrough)
    monkeypatch.setattr(kernel, "CONVOLVED_ORDER", 0)
    for one, other in zip(response_regressors(A, C, u, feedthrough), by_recursion, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(other).max())
