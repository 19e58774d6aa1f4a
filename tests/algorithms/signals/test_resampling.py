"""Uneven samples onto a grid and back: exact where they are even, close where they are not."""

import numpy as np
import pytest

from sklearn_hd.algorithms.signals.resampling import (
    bridge,
    held_means,
    interpolate,
    uniform_grid,
    unwrap,
)


def uneven(rng, n, size=0.2):
    return np.arange(n) + rng.uniform(-size, size, n)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 40])
def test_even_samples_are_given_back(rng, n):
    values, places = rng.standard_normal((n, 2)), 1e6 + 0.01 * np.arange(n)
    np.testing.assert_allclose(interpolate(values, places, places), values, atol=1e-12)
    np.testing.assert_allclose(held_means(values, places, places, 0.01), values, atol=1e-6)


@pytest.mark.parametrize(("samples", "bound"), [(16, 1e-5), (32, 1e-7), (64, 1e-8)])
def test_error_bound_of_band_limited_signals(rng, samples, bound):
    """The figures of the module's docstring, there and back again."""
    places = uneven(rng, 30 * samples)
    grid = uniform_grid(places[0], places[-1], 1.0)
    signal = np.cos(2 * np.pi * places[:, None] / samples + np.arange(4))
    truth = np.cos(2 * np.pi * grid[:, None] / samples + np.arange(4))
    inner = slice(samples, -samples)
    on_grid = interpolate(signal, places, grid)
    assert np.abs(on_grid - truth)[inner].max() < bound
    assert np.abs(interpolate(on_grid, grid, places) - signal)[inner].max() < 2 * bound


def test_white_noise_keeps_its_size(rng):
    places = uneven(rng, 4000)
    noise = rng.standard_normal((4000, 1))
    assert np.std(interpolate(noise, places, np.arange(1.0, 3999.0))) < 1.15


def test_held_signals_keep_their_area_and_their_rest(rng):
    places = uneven(rng, 200)
    values = np.zeros((200, 1))
    values[50:90] = rng.standard_normal((40, 1))
    grid = uniform_grid(places[0], places[-1], 1.0)
    means = held_means(values, places, grid, 1.0)
    area = np.sum(values[:-1, 0] * np.diff(places))
    assert means.sum() == pytest.approx(area, rel=1e-12)
    assert not means[:48].any()
    assert not means[92:].any()


def test_constants_stay_exactly_constant(rng):
    places = uneven(rng, 100)
    means = held_means(np.full((100, 1), 0.1), places, np.arange(1.0, 98.0), 1.0)
    assert np.ptp(means) == 0.0


def test_grid_lies_within_its_span_on_whole_multiples():
    np.testing.assert_allclose(uniform_grid(-0.05, 0.21, 0.1), [0.0, 0.1, 0.2], atol=1e-15)
    assert uniform_grid(0.56, 0.58, 0.1).tolist() == pytest.approx([0.6])


def test_bridges_span_short_runs_between_samples_alone():
    t = np.linspace(0.0, 1.0, 101)
    values = np.sin(5 * t)
    holed = values.copy()
    holed[[0, 1, 20, 21, 22, 50, 99, 100]] = np.nan
    holed[60:70] = np.nan
    filled = bridge(holed, t, 3)
    np.testing.assert_allclose(filled[[20, 21, 22, 50]], values[[20, 21, 22, 50]], atol=1e-5)
    assert np.flatnonzero(np.isnan(filled)).tolist() == [0, 1, *range(60, 70), 99, 100]
    assert bridge(values, t, 3) is values


def test_unwrapping_leaves_growing_azimuth_alone(rng):
    psi = np.cumsum(rng.uniform(0.1, 6.0, 50))
    assert unwrap(psi, np.arange(50.0)) is psi


def test_unwrapping_counts_the_turns_behind_missing_samples(rng):
    psi = np.cumsum(rng.uniform(0.09, 0.11, 500))
    psi[100] = np.nan
    psi[200:295] = np.nan  # a turn and a half
    turns = unwrap(np.mod(psi, 2 * np.pi), np.arange(500.0)) - psi
    np.testing.assert_allclose(turns[np.isfinite(psi)], turns[0], atol=1e-9)
    assert np.isnan(turns[[100, 250]]).all()
