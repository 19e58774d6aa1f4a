import numpy as np
import pytest

from sklearn_hd.algorithms.likelihood.residual_tests import (
    autoregression,
    filtered,
    lagged,
    of_each_output,
    regressors_of,
    score_test,
    sensitivities,
    sensitivity_pieces,
    sensitivity_sums,
    span_of,
    times,
)
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

NOTHING = np.zeros((400, 0))


def test_one_regressor_and_no_parameter_is_a_closed_form():
    e, z = np.random.default_rng(0).standard_normal((2, 400, 1))
    found = score_test(e, z[:, None], NOTHING)
    assert np.isclose(found.statistic, np.sum(z * e) ** 2 / np.sum(z**2 * e**2))
    assert found.degrees == 1


def test_what_parameters_take_away_is_not_asked():
    rng = np.random.default_rng(1)
    e, Z = rng.standard_normal((200, 2)), rng.standard_normal((200, 2, 3))
    span = span_of(Z.reshape(400, 3))
    found = score_test(e + Z @ [1.0, 2.0, 3.0], Z, span)
    assert (found.statistic, found.degrees, found.p_value) == (0.0, 0, 1.0)


def test_a_multiple_of_the_sensitivities_changes_nothing():
    """What C(α) is for: an error of the parameters, to first order."""
    rng = np.random.default_rng(2)
    e, Z, S = (rng.standard_normal((400, *shape)) for shape in ((1,), (1, 4), (5,)))
    right, wrong = (score_test(e + S @ off, Z, span_of(S)) for off in (np.zeros((5, 1)), S[:5, :1]))
    assert np.isclose(right.statistic, wrong.statistic)


def test_the_coordinates_of_regressors_do_not_matter():
    rng = np.random.default_rng(3)
    e, Z, T = (rng.standard_normal(shape) for shape in ((200, 2), (200, 2, 5), (5, 5)))
    one, other = (score_test(e, regressors, NOTHING) for regressors in (Z, Z @ T))
    assert np.isclose(one.statistic, other.statistic)
    assert one.degrees == other.degrees == 5


def test_span_leaves_out_what_depends_and_rests():
    columns = np.random.default_rng(4).standard_normal((50, 3))
    span = span_of(np.hstack([columns, 1e6 * columns[:, :1], np.zeros((50, 1))]))
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


@pytest.mark.parametrize("gain", [True, False])
def test_sensitivities_span_what_small_changes_of_coefficients_do(gain):
    rng, n, m, n_outputs, H = np.random.default_rng(6), 3, 2, 2, 1
    coefficients = 0.1 * rng.standard_normal((3, n + n_outputs, n + m + 1))
    coefficients[0, :n, :n] += 0.6 * np.eye(n)
    K = 0.1 * gain * rng.standard_normal((3, n, n_outputs))
    u, y = rng.standard_normal((300, m)), rng.standard_normal((300, n_outputs))
    psi = 1.0 + 0.4 * np.arange(300)

    def left(step):
        moved = step * np.random.default_rng(7).standard_normal(coefficients.shape)
        turned = step * gain * np.random.default_rng(8).standard_normal(K.shape)
        model = PeriodicInnovations(coefficients + moved, K + turned, np.eye(2), 0.4)
        return model.rows(psi), *model.rows(psi).innovations(u, y, np.zeros(n))

    rows, x, e = left(0.0)
    functions = harmonic_functions(psi, range(H + 1))
    S = sensitivities(rows, u, x, e, functions, functions, feedthrough=True)
    change = (left(1e-6)[2] - left(-1e-6)[2]).ravel() / 2e-6
    span = span_of(S.reshape(600, -1))
    assert np.linalg.norm(change - span @ (span.T @ change)) < 1e-6 * np.linalg.norm(change)
    n_gauge = n * n * (2 * H + 1)  # at least: the coordinates of the state
    n_free = coefficients.size + K.size * gain
    assert n_free - n_gauge - 10 < span.shape[1] < n_free


@pytest.mark.parametrize("feedthrough", [True, False])
@pytest.mark.parametrize("gain", [0.3, 0.0])
def test_pieces_and_sums_are_those_of_all_sensitivities(rng, gain, feedthrough):
    """Weighted, one row or some at once; Σ wᵀ ∂ŷ/∂θ goes backwards through the record."""
    own = rng.standard_normal((3, 5, 6)), gain * rng.standard_normal((3, 3, 2))
    model = PeriodicInnovations(0.2 * own[0], 0.2 * own[1], np.eye(2), 0.4)
    u, y, W = (
        rng.standard_normal((40, 2)),
        rng.standard_normal((40, 2)),
        rng.standard_normal((2, 2)),
    )
    psi = 0.4 * np.arange(40)
    rows = model.rows(psi)
    x, e = rows.innovations(u, y, np.ones(3))
    known = u, x, e, harmonic_functions(psi, range(2)), harmonic_functions(psi, range(3))
    S = sensitivities(rows, *known, feedthrough=feedthrough)
    pairs = regressors_of(rows, *known, feedthrough=feedthrough)
    for most in (1, 7, 40, 100):
        pieces, found = zip(*sensitivity_pieces(rows, pairs, most, W), strict=True)
        np.testing.assert_allclose(np.concatenate(found), W @ S, atol=1e-12)
        assert pieces[0] == slice(0, most)
    w = rng.standard_normal((40, 2))
    sums = sensitivity_sums(rows, pairs, w)
    np.testing.assert_allclose(sums, np.einsum("tl,tlk->k", w, S), atol=1e-11)


def test_a_static_gain_is_sensitive_to_itself_alone():
    model = PeriodicInnovations(np.ones((1, 1, 2)), np.zeros((1, 0, 1)), np.eye(1), 1.0)
    u, y = np.random.default_rng(10).standard_normal((2, 50, 1))
    rows, one = model.rows(np.zeros(50)), np.ones((50, 1))
    x, e = rows.innovations(u, y, np.zeros(0))
    assert np.allclose(e, y - u - 1.0)
    S = sensitivities(rows, u, x, e, one, one[:, :0], feedthrough=True)
    assert np.allclose(S[:, 0], u)


def test_what_is_not_free_is_not_in_the_span():
    rng = np.random.default_rng(9)
    model = PeriodicInnovations(
        np.array([[[0.5, 1.0, 0.0], [1.0, 0.0, 0.0]]]), np.zeros((1, 1, 1)), np.eye(1), 1.0
    )
    u, y = rng.standard_normal((2, 200, 1))
    rows = model.rows(np.zeros(200))
    x, e = rows.innovations(u, y, np.zeros(1))
    one = np.ones((200, 1))
    S = sensitivities(rows, u, x, e, one, one[:, :0], feedthrough=False)
    assert span_of(S[:, 0]).shape[1] == 2  # pole and gain
    S = sensitivities(rows, u, x, e, one, one, feedthrough=True)
    assert span_of(S[:, 0]).shape[1] == 5  # D, a and c (whose start differs), too
