"""Laws of what the reducer takes from the raw record."""

import numpy as np
import pytest

from sklearn_hd._reduce import most_likely
from sklearn_hd.algorithms.likelihood.likelihood import is_white
from sklearn_hd.algorithms.modes.families import real_block
from sklearn_hd.systems import LTPSystem

OMEGA, SPP = 2 * np.pi, 32
DT = 1.0 / SPP
EXPONENTS = np.array([-0.3, -0.6 + 1.1j])  # 1/s
TURN = OMEGA * DT * np.arange(SPP)
OBSERVE = np.zeros((SPP, 2, 3))  # the mean of one output, the first harmonic of another
OBSERVE[:, 0, 0], OBSERVE[:, 1, 1], OBSERVE[:, 1, 2] = 1.0, np.cos(TURN), np.sin(TURN)


def modes(rng):
    """A time-invariant system, and its coefficients C put together to signals."""
    C = rng.standard_normal((3, 3))
    P = np.zeros((3, 2, 3))
    P[0, 0], P[1, 1], P[2, 1] = C
    return LTPSystem(real_block(EXPONENTS), rng.standard_normal((3, 1)), P, omega=OMEGA), C


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


def likely(rng, segments, C, rough=0.1):
    """From a rough start."""
    near = C * (1 + rough * rng.standard_normal(C.shape))
    return most_likely(segments, EXPONENTS * (1 + rough), near, OMEGA, SPP, OBSERVE)


def exponents(A):
    return np.array([A[0, 0], A[1, 1] + 1j * A[1, 2]])


def test_modes_come_back_from_a_rough_start(rng):
    system, C = modes(rng)
    segments = records(rng, system)
    A, found, left = likely(rng, segments, C)
    np.testing.assert_allclose(exponents(A), EXPONENTS, rtol=1e-5)
    assert np.sum(left**2) < 1e-9 * sum(np.sum(y**2) for _, y, _ in segments)
    shape, true = found[:, 0] / found[0, 0], C[:, 0] / C[0, 0]
    np.testing.assert_allclose(shape, true, rtol=1e-4)


def test_what_is_left_under_noise_is_the_noise(rng):
    system, C = modes(rng)
    A, _, left = likely(rng, records(rng, system, noise=0.1), C)
    assert np.mean(left**2) == pytest.approx(0.01, rel=0.15)
    assert is_white(left, SPP)
    np.testing.assert_allclose(exponents(A), EXPONENTS, atol=0.1)


@pytest.mark.slow
def test_modes_that_are_too_few_leave_more_than_noise(rng):
    system, C = modes(rng)
    segments = records(rng, system, noise=0.01)
    _, _, left = most_likely(segments, EXPONENTS[1:], C[:, 1:], OMEGA, SPP, OBSERVE)
    assert not is_white(left, SPP)


def test_whiteness_is_rarely_denied_to_noise_and_never_granted_to_zero():
    draws = np.random.default_rng(0).standard_normal((200, 500, 2))
    assert np.mean([is_white(noise, 32) for noise in draws]) > 0.97
    assert not is_white(np.zeros((50, 1)), 5)
