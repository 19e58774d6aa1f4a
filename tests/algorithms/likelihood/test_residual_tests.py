import numpy as np

from sklearn_hd.algorithms.likelihood.predictor import of_each_output
from sklearn_hd.algorithms.likelihood.residual_tests import (
    autoregression,
    filtered,
    lagged,
    score_test,
)
from sklearn_hd.algorithms.periodic.multipliers import orthonormal_range
from sklearn_hd.algorithms.signals.fourier import times

NOTHING = np.zeros((400, 0))


def test_one_regressor_and_no_parameter_is_a_closed_form():
    e, z = np.random.default_rng(0).standard_normal((2, 400, 1))
    found = score_test(e, z[:, None], NOTHING)
    assert np.isclose(found.statistic, np.sum(z * e) ** 2 / np.sum(z**2 * e**2))
    assert found.degrees == 1


def test_what_parameters_take_away_is_not_asked():
    rng = np.random.default_rng(1)
    e, Z = rng.standard_normal((200, 2)), rng.standard_normal((200, 2, 3))
    span = orthonormal_range(Z.reshape(400, 3))
    found = score_test(e + Z @ [1.0, 2.0, 3.0], Z, span)
    assert (found.statistic, found.degrees, found.p_value) == (0.0, 0, 1.0)


def test_a_multiple_of_the_sensitivities_changes_nothing():
    """What C(α) is for: an error of the parameters, to first order."""
    rng = np.random.default_rng(2)
    e, Z, S = (rng.standard_normal((400, *shape)) for shape in ((1,), (1, 4), (5,)))
    right, wrong = (
        score_test(e + S @ off, Z, orthonormal_range(S)) for off in (np.zeros((5, 1)), S[:5, :1])
    )
    assert np.isclose(right.statistic, wrong.statistic)


def test_the_coordinates_of_regressors_do_not_matter():
    rng = np.random.default_rng(3)
    e, Z, T = (rng.standard_normal(shape) for shape in ((200, 2), (200, 2, 5), (5, 5)))
    one, other = (score_test(e, regressors, NOTHING) for regressors in (Z, Z @ T))
    assert np.isclose(one.statistic, other.statistic)
    assert one.degrees == other.degrees == 5


def test_span_leaves_out_what_depends_and_rests():
    columns = np.random.default_rng(4).standard_normal((50, 3))
    span = orthonormal_range(np.hstack([columns, 1e6 * columns[:, :1], np.zeros((50, 1))]))
    assert span.shape == (50, 3)
    assert np.allclose(span.T @ span, np.eye(3), atol=1e-12)


def test_lags_begin_with_zeros():
    found = lagged(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), [0, 2])
    assert found.tolist() == [[1, 2, 0, 0], [3, 4, 0, 0], [5, 6, 1, 2]]


def test_of_each_output_and_times():
    assert of_each_output(np.array([[1.0, 2.0]]), np.eye(2)).tolist() == [
        [[1, 2, 0, 0], [0, 0, 1, 2]]
    ]
    assert times(np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]])).tolist() == [[3, 4, 6, 8]]


def test_autoregression_leaves_the_noise_that_made_the_signal():
    rng = np.random.default_rng(5)
    Phi = np.array([[[0.5, 0.2], [-0.1, 0.4]], [[-0.3, 0.0], [0.1, 0.2]]])
    e, v = rng.standard_normal((20_000, 2)), np.zeros((20_000, 2))
    for k in range(2, len(v)):
        v[k] = Phi[0] @ v[k - 1] + Phi[1] @ v[k - 2] + e[k]
    assert np.allclose(filtered(v[..., None], Phi)[2:, :, 0], e[2:])
    found = autoregression([v[:9000], v[9000:]], 6)
    assert 2 <= len(found) <= 4
    assert np.allclose(found[:2], Phi, atol=0.05)
    assert len(autoregression([e], 6)) <= 1
