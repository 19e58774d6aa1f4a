"""Laws of the propagation of covariances."""

import numpy as np
import pytest

from sklearn_hd.algorithms.likelihood.uncertainty import propagate_std


@pytest.fixture
def covariance(rng):
    """Of five parameters, all of them correlated."""
    root = rng.standard_normal((5, 5))
    return root @ root.T


def test_deviations_of_linear_functions_are_those_of_draws(rng, covariance):
    jacobian = rng.standard_normal((2, 3, 5)) + 1j * rng.standard_normal((2, 3, 5))
    draws = rng.multivariate_normal(np.zeros(5), covariance, 20_000) @ jacobian.swapaxes(1, 2)
    std = propagate_std(jacobian, covariance)
    np.testing.assert_allclose(std.real, np.std(draws.real, axis=1), rtol=0.03)
    np.testing.assert_allclose(std.imag, np.std(draws.imag, axis=1), rtol=0.03)


def test_deviations_know_no_coordinates_of_the_parameters(rng, covariance):
    """f(T φ) has the same ones, cov φ = T⁻¹ C T⁻ᵀ."""
    jacobian, T = rng.standard_normal((4, 5)), rng.standard_normal((5, 5))
    inverse = np.linalg.inv(T)
    np.testing.assert_allclose(
        propagate_std(jacobian @ T, inverse @ covariance @ inverse.T),
        propagate_std(jacobian, covariance),
        rtol=1e-8,
    )


def test_the_difference_of_parameters_that_err_alike_is_exact():
    assert propagate_std([[1.0, -1.0], [1.0, 1.0]], np.full((2, 2), 4.0)).tolist() == [0.0, 4.0]


def test_a_parameter_that_is_not_identified_spoils_what_depends_on_it_alone(rng, covariance):
    spoilt = covariance.copy()
    spoilt[2], spoilt[:, 2] = np.nan, np.nan
    spoilt[2, 2] = np.inf
    jacobian = rng.standard_normal((2, 5))
    jacobian[0, 2] = 0.0
    others = [0, 1, 3, 4]
    expected = propagate_std(jacobian[0, others], covariance[np.ix_(others, others)])
    found = propagate_std(jacobian, spoilt)
    assert found[0] == pytest.approx(expected, rel=1e-12)
    assert found[1] == np.inf
