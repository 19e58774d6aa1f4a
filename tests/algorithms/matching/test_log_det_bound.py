"""The smooth bound of the largest singular value: limits, slopes, and what moves them."""

import numpy as np
import pytest

from sklearn_hd.algorithms.matching.smooth_peak import BoundSlopes, LogDetBound, log_det_value

RANDOM = np.random.default_rng(8)
SHAPES = [(7, 2, 3, 4), (7, 3, 2, 4), (5, 1, 1, 2), (6, 3, 3, 5)]


def complex_normal(*shape):
    return RANDOM.standard_normal(shape) + 1j * RANDOM.standard_normal(shape)


def bound_of(shape):
    error, slope = complex_normal(*shape[:3]), complex_normal(*shape)
    directions = RANDOM.standard_normal((shape[3], shape[3]))
    return LogDetBound(error, slope, directions), error, slope @ directions


def test_bound_falls_from_the_mean_square_to_the_largest_singular_value():
    bound, error, _ = bound_of(SHAPES[0])
    sizes = np.linalg.svd(error, compute_uv=False)
    np.testing.assert_allclose(bound.sizes, sizes)
    assert bound.top == sizes.max()
    levels = [bound.level(mu) for mu in (1e4, 1.0, 1e-2, 1e-4, 1e-8)]
    assert np.all(np.diff(levels) < 0)
    assert levels[0] == pytest.approx(np.sqrt(2e4 * np.sum(sizes**2)), rel=1e-3)
    assert levels[-1] == pytest.approx(bound.top, rel=1e-6)
    assert levels[-1] > bound.top
    assert bound.level(bound.weight_for(2.5)) == pytest.approx(2.5 * bound.top, rel=1e-9)


def test_value_is_the_least_over_t_of_the_log_determinants():
    bound, error, _ = bound_of(SHAPES[1])
    products = error.conj().swapaxes(1, 2) @ error
    for mu in (1.0, 1e-2):

        def at(t, mu=mu):
            inside = np.linalg.det(np.eye(2) - products / t**2).real
            return np.log(t) - mu * np.log(inside).sum()

        t = bound.level(mu)
        assert bound.value(mu) == pytest.approx(at(t), rel=1e-12)
        assert at(t) < min(at(t * 1.001), at(t * 0.999))
    assert log_det_value(np.zeros((3, 2)), 1.0) == -np.inf


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("mu", [1.0, 1e-3])
def test_slopes_of_a_linear_error_agree_with_differences(shape, mu):
    bound, error, slope = bound_of(shape)
    slopes = BoundSlopes(bound, mu)
    direction = RANDOM.standard_normal(shape[3])
    direction *= bound.top / np.linalg.norm(slope @ direction)
    own, h = np.eye(shape[3]), 1e-5

    def moved(h):
        return LogDetBound(error + h * (slope @ direction), slope, own)

    before, after = moved(-h), moved(h)
    fall = (after.value(mu) - before.value(mu)) / (2 * h)
    assert slopes.gradient @ direction == pytest.approx(fall, rel=1e-6)
    bend = (BoundSlopes(after, mu).gradient - BoundSlopes(before, mu).gradient) / (2 * h)
    size = np.abs(bend).max()
    np.testing.assert_allclose(slopes.hessian @ direction, bend, rtol=1e-4, atol=1e-5 * size)


@pytest.mark.parametrize("shape", SHAPES)
def test_what_a_movement_of_the_error_and_of_mu_adds_to_the_gradient(shape):
    bound, error, slope = bound_of(shape)
    mu, step = 0.05, np.zeros(shape[3])
    slopes, moved = BoundSlopes(bound, mu), 1e-6 * complex_normal(*shape[:3])
    own = np.eye(shape[3])
    before, after = (
        BoundSlopes(LogDetBound(error + sign * moved, slope, own), mu).gradient for sign in (-1, 1)
    )
    pull = slopes.pull(bound.missed(error + moved, step))
    np.testing.assert_allclose(pull, (after - before) / 2, rtol=1e-5, atol=1e-12)
    h = 1e-5 * mu
    before, after = (BoundSlopes(bound, mu + sign * h).gradient for sign in (-1, 1))
    np.testing.assert_allclose(slopes.drift, (after - before) / (2 * h), rtol=1e-5, atol=1e-7)


def test_nothing_is_missed_where_the_error_moved_linearly():
    bound, error, slope = bound_of(SHAPES[3])
    step = RANDOM.standard_normal(5)
    assert np.abs(bound.missed(error + slope @ step, step)).max() < 1e-12


def test_slopes_by_parameter_are_those_along_the_directions():
    error, slope = complex_normal(6, 3, 2), complex_normal(6, 3, 2, 4)
    directions = RANDOM.standard_normal((4, 4))
    slopes = BoundSlopes(LogDetBound(error, slope, directions), 1e-2)
    np.testing.assert_allclose(directions.T @ slopes.by_parameter, slopes.gradient, rtol=1e-10)
