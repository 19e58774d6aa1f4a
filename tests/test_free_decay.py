"""Laws of the way from a free decay to F(ψ) and its harmonic decomposition."""

import numpy as np
import pytest
from conftest import same_poles
from scipy import linalg

from sklearn_hd.algorithms.modes.mode_shapes import (
    harmonic_state_matrix,
    mode_shapes,
    real_block,
    refine_exponents,
    shape_condition,
    state_matrix_samples,
    strongest_free_decay,
)
from sklearn_hd.systems import LTPSystem

OMEGA, SPP = 2 * np.pi, 64
DT = 1.0 / SPP


def smooth_system(rng, n):
    """A stable F(ψ) with two harmonics."""
    F = 0.5 * rng.standard_normal((5, n, n))
    F[0] -= 1.5 * np.eye(n)
    return LTPSystem(F, np.ones((n, 1)), omega=OMEGA)


def free_decay(system, n, n_periods):
    t = DT * np.arange(n_periods * SPP)
    return system.simulate(np.zeros((len(t), 1)), t, x0=np.ones(n))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_state_matrix_comes_back_from_a_free_decay(rng, n):
    system = smooth_system(rng, n)
    exponents = np.asarray(system.floquet_exponents())
    R = real_block(exponents[exponents.imag >= 0])
    P = mode_shapes(free_decay(system, n, 3 + 2 * n), R, DT, SPP)
    found = state_matrix_samples(P, R, OMEGA)
    psi = 2 * np.pi * np.arange(SPP) / SPP
    np.testing.assert_allclose(found, system.F(psi), atol=1e-6)
    for n_harmonics in (0, 1, 3):
        A = system.harmonic_decomposition(n_harmonics).A
        np.testing.assert_allclose(harmonic_state_matrix(found, n_harmonics, OMEGA), A, atol=1e-6)


def test_the_branch_of_the_exponents_does_not_matter(rng):
    """λ and λ + jω are one mode: the shapes take up the difference."""
    F = rng.standard_normal((2, 2))
    R = real_block([-0.4 + 1.0j])
    moved = real_block([-0.4 + 1.0j + 1j * OMEGA])
    psi = 2 * np.pi * np.arange(SPP) / SPP
    P = F + 0.2 * np.cos(psi)[:, None, None] * rng.standard_normal((2, 2))
    turn = np.array([[np.cos(psi), -np.sin(psi)], [np.sin(psi), np.cos(psi)]]).transpose(2, 0, 1)
    np.testing.assert_allclose(
        state_matrix_samples(P @ turn, moved, OMEGA), state_matrix_samples(P, R, OMEGA), atol=1e-9
    )


def test_a_defective_decay_needs_no_eigenvectors(rng):
    R = np.array([[-0.3, 1.0], [0.0, -0.3]])
    T = rng.standard_normal((2, 2))
    y = np.array([T @ linalg.expm(R * t) @ np.ones(2) for t in DT * np.arange(8 * SPP)])
    F = state_matrix_samples(mode_shapes(y, R, DT, SPP), R, OMEGA)
    np.testing.assert_allclose(F, np.broadcast_to(T @ R @ np.linalg.inv(T), F.shape), atol=1e-9)


def test_units_of_the_outputs_scale_the_state_matrix(rng):
    R, P = real_block([-1.0, -2.0]), rng.standard_normal((SPP, 2, 2)) * 0.1 + np.eye(2)
    S = np.diag([1e6, 1e-6])
    F = state_matrix_samples(P, R, OMEGA)
    scaled = state_matrix_samples(S @ P, R, OMEGA)
    np.testing.assert_allclose(scaled, S @ F @ np.linalg.inv(S), rtol=1e-9)


def test_real_block_has_the_exponents_as_eigenvalues():
    exponents = [-1.0, -0.5 + 2.0j]
    assert same_poles(np.linalg.eigvals(real_block(exponents)), [-1, -0.5 + 2j, -0.5 - 2j], 1e-12)
    assert real_block([]).shape == (0, 0)


@pytest.mark.parametrize("exponents", [[-0.4, -2.0], [-0.3 + 1.2j], [-0.1, -0.5 + 0.8j]])
def test_exponents_are_refined_to_those_of_the_decay(rng, exponents):
    """Whatever the mode shapes: they are eliminated."""
    R = real_block(exponents)
    shapes = rng.standard_normal((16, 2, len(R)))
    y = np.vstack([shapes @ linalg.expm(R * k) @ np.ones(len(R)) for k in range(12)]).reshape(-1, 2)
    start = np.array(exponents, dtype=complex) * 1.15
    found, rest = refine_exponents(y, start, 16)
    np.testing.assert_allclose(found, exponents, rtol=1e-7)
    assert rest < 1e-18 * np.sum(y**2)


def test_refinement_averages_noise(rng):
    """The spread of a refined exponent falls with the number of samples a period."""
    spread = []
    for spp in (4, 64):
        shapes = rng.standard_normal((spp, 1))
        shapes /= np.sqrt(np.mean(shapes**2))
        decay = (shapes * np.exp(-0.3 * np.arange(20))[:, None, None]).reshape(-1, 1)
        noisy = [decay + 0.01 * rng.standard_normal(decay.shape) for _ in range(30)]
        spread.append(np.std([refine_exponents(y, np.array([-0.2]), spp)[0].real for y in noisy]))
    assert spread[1] < spread[0] / 2.5  # 4 = sqrt(64 / 4) in the mean


def test_the_strongest_decay_starts_with_the_period_after_the_last_motion():
    phases = [np.arange(40) % 8, (np.arange(40) + 3) % 8]
    u = [np.zeros((40, 1)), np.zeros((40, 1))]
    u[0][5], u[1][9] = 1.0, 1.0
    y = [np.ones((40, 1)), 2 * np.arange(40.0)[:, None]]
    decay = strongest_free_decay(u, y, phases, 8, 1e-9)
    np.testing.assert_array_equal(decay, y[1][13:37])
    assert strongest_free_decay([u[0] * 0], [y[0]], phases[:1], 8, 1e-9) is None


def test_a_missing_mode_or_output_makes_the_shapes_singular(rng):
    P = rng.standard_normal((8, 2, 2))
    assert np.isfinite(shape_condition(P))
    assert shape_condition(P * [1e6, 1e-6]) == pytest.approx(shape_condition(P), rel=1e-3)
    assert shape_condition(P * [1.0, 0.0]) == np.inf


def test_a_start_that_grows_beyond_all_bounds_explains_nothing():
    decay = np.exp(-0.3 * np.arange(40.0))[:, None]
    found, rest = refine_exponents(decay, np.array([5.0 + 0j]), 1)
    assert np.isfinite(found).all()
    assert rest == pytest.approx(np.sum(decay**2))
