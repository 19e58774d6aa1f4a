"""Laws of what the reducer takes from the raw record."""

import numpy as np
import pytest

from sklearn_hd._reduce.refinement import (
    _decaying_shapes,
    _refined_exponents,
    most_likely,
)
from sklearn_hd.algorithms.likelihood.likelihood import is_white
from sklearn_hd.algorithms.modes.families import real_block
from sklearn_hd.systems import LTPSystem

OMEGA, SPP, N_HARMONICS = 2 * np.pi, 32, 2
DT = 1.0 / SPP
EXPONENTS = np.array([-0.3, -0.6 + 1.1j])  # 1/s


# ---- likelihood of modes -----------------------------------------------------------------------


def periodic_system(rng):
    """In Floquet coordinates, with two harmonics in B and P."""
    G = rng.standard_normal((2 * N_HARMONICS + 1, 3, 1))
    P = rng.standard_normal((2 * N_HARMONICS + 1, 2, 3))
    return LTPSystem(real_block(EXPONENTS), G, P, omega=OMEGA), P


def records(rng, system, noise=0.0):
    """Two segments, the second from another phase on."""
    segments = []
    for n_samples in (20 * SPP, 12 * SPP + 5):
        first = 0 if not segments else 7
        t = DT * (first + np.arange(n_samples))
        u = np.repeat(rng.standard_normal((n_samples // 7 + 1, 1)), 7, axis=0)[:n_samples]
        y = system.simulate(u, t, x0=rng.standard_normal(3))
        segments.append((u, y + noise * rng.standard_normal(y.shape), first))
    return segments


def rough_start(rng, P, size):
    return EXPONENTS * (1 + size), P * (1 + size * rng.standard_normal(P.shape))


def test_a_periodic_system_comes_back_from_a_rough_start(rng):
    system, P = periodic_system(rng)
    segments = records(rng, system)
    modes = most_likely(segments, *rough_start(rng, P, 0.1), OMEGA, SPP)
    np.testing.assert_allclose(modes.exponents, EXPONENTS, rtol=1e-5)
    assert np.sum(modes.left**2) < 1e-9 * sum(np.sum(y**2) for _, y, _ in segments)


def test_what_is_left_under_noise_is_the_noise(rng):
    system, P = periodic_system(rng)
    segments = records(rng, system, noise=0.1)
    modes = most_likely(segments, *rough_start(rng, P, 0.1), OMEGA, SPP)
    assert np.mean(modes.left**2) == pytest.approx(0.01, rel=0.15)
    assert is_white(modes.left, SPP)
    np.testing.assert_allclose(modes.exponents, EXPONENTS, atol=0.1)


def test_a_structure_that_is_wrong_leaves_more_than_noise(rng):
    system, P = periodic_system(rng)
    segments = records(rng, system, noise=0.01)
    modes = most_likely(segments, EXPONENTS[1:], P[:, :, 1:], OMEGA, SPP)
    assert not is_white(modes.left, SPP)


def test_more_harmonics_start_from_fewer(rng):
    system, P = periodic_system(rng)
    segments = records(rng, system)
    few = most_likely(segments, EXPONENTS, P[:3], OMEGA, SPP)
    start = np.concatenate([few.P, np.zeros((2, 2, 3))])
    modes = most_likely(segments, few.exponents, start, OMEGA, SPP, start=few)
    np.testing.assert_allclose(modes.exponents, EXPONENTS, rtol=1e-5)
    assert modes.aic < few.aic


def test_whiteness_is_rarely_denied_to_noise_and_never_granted_to_zero():
    draws = np.random.default_rng(0).standard_normal((200, 500, 2))
    assert np.mean([is_white(noise, 32) for noise in draws]) > 0.97
    assert not is_white(np.zeros((50, 1)), 5)


# ---- free decay ----------------------------------------------------------------------------------


def free_decay(system, n, n_periods):
    t = DT * np.arange(n_periods * SPP)
    y = system.simulate(np.zeros((len(t), 1)), t, x0=np.ones(n))
    return y.reshape(n_periods, -1)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_state_matrix_comes_back_from_a_free_decay(rng, n):
    F = 0.5 * rng.standard_normal((5, n, n))
    F[0] -= 1.5 * np.eye(n)
    system = LTPSystem(F, np.ones((n, 1)), omega=OMEGA)
    exponents = np.asarray(system.floquet_exponents())
    lead = exponents[exponents.imag >= 0]
    decay = free_decay(system, n, 3 + 2 * n)
    shapes, left = _decaying_shapes(decay, lead, OMEGA, SPP)
    psi = 2 * np.pi * np.arange(SPP) / SPP
    np.testing.assert_allclose(shapes.state_matrix(psi, OMEGA, range(n)), system.F(psi), atol=1e-6)
    assert np.sum(left**2) < 1e-20 * np.sum(decay**2)
    other = np.where(lead.imag != 0, lead + 1j * OMEGA, lead)  # a mode's shape takes it up
    shapes, _ = _decaying_shapes(decay, other, OMEGA, SPP)
    np.testing.assert_allclose(shapes.state_matrix(psi, OMEGA, range(n)), system.F(psi), atol=1e-6)


@pytest.mark.parametrize("exponents", [[-0.4, -2.0], [-0.3 + 1.2j], [-0.1, -0.5 + 0.8j]])
def test_exponents_are_refined_to_those_of_the_decay(rng, exponents):
    """Whatever the mode shapes: they are eliminated."""
    step, state = np.exp(exponents), np.ones(len(exponents))
    shapes = rng.standard_normal((32, len(step))) + 1j * rng.standard_normal((32, len(step)))
    decay = np.array([(shapes @ (step**k * state)).real for k in range(12)])
    found = _refined_exponents(decay, np.array(exponents, dtype=complex) * 1.15)
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(exponents), rtol=1e-7)
