"""Laws of the way from a free decay to F(ψ) and its harmonic decomposition."""

import numpy as np
import pytest
from conftest import same_poles
from scipy import linalg

from sklearn_hd.algorithms.mode_shapes import (
    harmonic_state_matrix,
    mode_shapes,
    real_block,
    state_matrix_samples,
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
