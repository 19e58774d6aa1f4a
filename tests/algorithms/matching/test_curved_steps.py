"""Steps that bend as sinh coordinates do."""

import numpy as np
import pytest

from sklearn_hd.algorithms.matching.curved_steps import CurvedSteps

SCALE = np.array([1.0, 0.1, 3.0, 1e-3])
THETA = np.array([0.0, 5.0, -2.0, -1e4])
STEPS = CurvedSteps(SCALE)


def test_a_step_leaves_with_its_velocity_and_bends_as_said():
    step, h = np.array([1.0, -2.0, 0.3, 50.0]), 1e-4

    def at(time):
        return STEPS.move(THETA, time * step)

    np.testing.assert_allclose(at(0.0), THETA, rtol=1e-12)
    np.testing.assert_allclose((at(h) - at(-h)) / (2 * h), step, rtol=1e-6)
    bent = (at(h) + at(-h) - 2 * at(0.0)) / h**2
    np.testing.assert_allclose(bent, STEPS.bend(THETA) * step**2, rtol=1e-3, atol=1e-5)


def test_sums_below_the_scale_and_factors_above_it():
    small = CurvedSteps(np.array([1e6])).move(np.array([2.0]), np.array([3.0]))
    assert small == pytest.approx(5.0, rel=1e-9)
    large = CurvedSteps(np.array([1e-6])).move(np.array([2.0]), np.array([2.0]))
    assert large == pytest.approx(2.0 * np.e, rel=1e-9)


def test_products_of_parameters_that_grow_together_stay():
    theta, speed = np.array([4.0, -5.0]), np.array([1.0, -1.0])
    far = CurvedSteps(np.full(2, 1e-9)).move(theta, theta * speed)
    assert np.prod(far) == pytest.approx(np.prod(theta), rel=1e-12)


def test_a_step_has_an_end():
    far = CurvedSteps(np.ones(1)).move(np.zeros(1), np.array([1e300]))
    assert far == pytest.approx(np.sinh(3.0))
