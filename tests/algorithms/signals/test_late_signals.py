"""Laws of signals that come late."""

import numpy as np

from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.signals.resampling import (
    arriving,
    held_means,
    lagged,
    late,
    turned,
)

TIME = np.arange(60.0)
SMOOTH = np.column_stack([np.sin(0.2 * TIME), np.cos(0.15 * TIME)])


def test_nothing_comes_from_the_other_end():
    u = np.arange(1.0, 9.0)[:, None]
    assert lagged(u, [3])[:, 0].tolist() == [1, 1, 1, 1, 2, 3, 4, 5]
    assert lagged(u, [-3])[:, 0].tolist() == [4, 5, 6, 7, 8, 8, 8, 8]


def test_inputs_arrive_by_their_means():
    u, rows = np.random.default_rng(0).standard_normal((40, 2)), np.arange(40.0)
    own = arriving(u, np.array([2.3, 5.0]))
    for j, samples in enumerate([2.3, 5.0]):
        means = held_means(u[:, [j]], rows + samples, rows, 1.0)
        np.testing.assert_allclose(own[:, [j]], means, atol=1e-14)


def test_advancing_takes_a_delay_back():
    samples = np.array([2.4, 7.0])
    there = late(SMOOTH, samples)
    np.testing.assert_allclose(there[8:, 0], np.sin(0.2 * (TIME[8:] - 2.4)), atol=1e-7)
    np.testing.assert_allclose(late(there, -samples)[10:-10], SMOOTH[10:-10], atol=1e-5)
    assert late(SMOOTH, np.zeros(2)) is SMOOTH


def test_coefficients_of_matrices_turn_by_one_angle():
    coefficients = np.random.default_rng(0).standard_normal((7, 2, 1))
    psi = np.linspace(0, 6, 11)
    values = [
        evaluate_harmonics(turned(coefficients, 0.7), psi),
        evaluate_harmonics(coefficients, psi - 0.7),
    ]
    np.testing.assert_allclose(*values)


def test_fourier_coefficients_turn_with_the_signal():
    series = np.array([[0.5], [1.0], [-0.3], [0.2], [0.7]])
    psi = np.linspace(0.0, 6.0, 20)
    values = [
        sum(c[2 * k - 1, 0] * np.cos(k * at) + c[2 * k, 0] * np.sin(k * at) for k in (1, 2))
        for c, at in ((series, psi - 0.8), (turned(series, np.array([0.8])), psi))
    ]
    np.testing.assert_allclose(*values, atol=1e-14)
