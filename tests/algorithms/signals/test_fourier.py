"""Laws of the Fourier kernels."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sklearn_hd.algorithms.signals.fourier import (
    harmonic_functions,
    harmonic_labels,
    recompose,
    seconds_from_zero_phase,
    window_weights,
    windowed_coefficients,
)

WINDOWS = ["boxcar", "triangle", "hann"]


@pytest.mark.parametrize("window", WINDOWS)
@given(spp=st.integers(4, 24), seed=st.integers(0, 2**16))
def test_periodic_signals_come_back(window, spp, seed):
    """Decompose, then recompose, is the identity for band-limited periodic signals."""
    rng = np.random.default_rng(seed)
    harmonics = range((spp - 1) // 2 + 1)
    true = rng.standard_normal(len(harmonic_labels(harmonics)))
    psi = 2 * np.pi * np.arange(4 * spp) / spp
    signal = recompose(true, psi, harmonics)
    weights = window_weights(window, spp)
    rows = np.arange(len(weights) - 1, len(psi))
    found = windowed_coefficients(signal, psi, harmonics, weights, rows)
    np.testing.assert_allclose(found, np.broadcast_to(true, found.shape), atol=1e-12)


def test_nyquist_harmonic_is_a_cosine_alone():
    psi = 2 * np.pi * np.arange(8) / 8
    signal = 3.0 * np.cos(4 * psi)
    found = windowed_coefficients(signal, psi, [4], window_weights("boxcar", 8), [7])
    np.testing.assert_allclose(found, [[3.0, 0.0]], atol=1e-14)


@pytest.mark.parametrize("late", [0.1, 0.25, 0.5, 0.77])
@pytest.mark.parametrize("window", WINDOWS)
def test_nyquist_harmonic_between_the_samples_through_the_origin(window, late):
    """Cosine and sine are one signal there: it was counted twice."""
    psi = 2 * np.pi * (late + np.arange(32)) / 8
    signal = 3.0 * (-1.0) ** np.arange(32)
    rows = np.arange(15, 32)
    found = windowed_coefficients(signal, psi, [0, 4], window_weights(window, 8), rows)
    np.testing.assert_allclose(recompose(found, psi[rows], [0, 4]), signal[rows], atol=1e-13)


@pytest.mark.parametrize("window", WINDOWS)
def test_windows_have_unit_sum_and_vanish_at_every_harmonic(window):
    spp = 16
    weights = window_weights(window, spp)
    assert weights.sum() == pytest.approx(1.0, abs=1e-14)
    for k in range(1, spp // 2):
        phase = np.exp(2j * np.pi * k * np.arange(len(weights)) / spp)
        assert abs(weights @ phase) < 1e-14


def test_copies_have_the_gain_of_the_window():
    """A decaying harmonic leaves the coefficient of another as Ĥ(λ + jpω) says."""
    spp, omega = 32, 2 * np.pi
    t = np.arange(4 * spp) / spp
    lam, m = -0.7, 3
    signal = np.real(np.exp((lam + 1j * m * omega) * t))
    weights = window_weights("boxcar", spp)
    rows = np.arange(spp - 1, len(t))
    c, s = windowed_coefficients(signal, omega * t, [1], weights, rows).T
    found = (c - 1j * s) / 2
    ages = np.arange(spp)[::-1] / spp
    expected = np.zeros(len(rows), dtype=complex)
    for amplitude, exponent in ((0.5, lam + 2j * omega), (0.5, lam - 4j * omega)):
        gain = weights @ np.exp(-exponent * ages)
        expected += amplitude * gain * np.exp(exponent * t[rows])
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_no_harmonics_give_no_columns():
    assert harmonic_functions(np.zeros(3), []).shape == (3, 0)


def test_long_signals_are_cut_into_blocks_without_a_seam():
    spp = 64
    psi = 2 * np.pi * np.arange(70_000) / spp
    signal = np.sin(0.001 * np.arange(len(psi)))
    weights = window_weights("boxcar", spp)
    rows = np.arange(spp - 1, len(psi))
    every = windowed_coefficients(signal, psi, [0, 1], weights, rows)
    some = windowed_coefficients(signal, psi, [0, 1], weights, rows[::977])
    np.testing.assert_array_equal(every[::977], some)


def arctan_of_inverse(n):
    """Arctan 1/n to sixty digits, by its series."""
    return sum(Fraction((-1) ** k, (2 * k + 1) * n ** (2 * k + 1)) for k in range(45))


@given(time=st.floats(-1e12, 1e12), omega=st.floats(1e-3, 1e5))
def test_phase_is_exact_from_any_origin(time, omega):
    """What is left of the floats given is whole turns off, with π by Machin's formula."""
    turn = 8 * (4 * arctan_of_inverse(5) - arctan_of_inverse(239))
    left = seconds_from_zero_phase(time, omega)
    turns = (Fraction(time) - Fraction(left)) * Fraction(omega) / turn
    assert abs(turns - round(turns)) < 1e-15
    assert abs(Fraction(left) * Fraction(omega)) <= turn / 2 * (1 + Fraction("1e-15"))
