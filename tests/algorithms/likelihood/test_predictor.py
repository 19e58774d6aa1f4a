"""Laws of predictions of sampled models with a gain, and of their derivatives."""

import numpy as np
import pytest
from predictor_cases import (
    FORMS,
    gain_of,
    oscillator,
    plain_predictions,
    record_of,
)

from sklearn_hd.algorithms.likelihood import predictor
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.predictor import (
    n_columns,
    output_sensitivities,
    regressors_of,
    residuals,
    sensitivities,
    sensitivity_pieces,
    sensitivity_sums,
    simulate,
)
from sklearn_hd.algorithms.periodic.multipliers import orthonormal_range
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

GAINS = [None, 0, 1]


def case(name, n_gain_harmonics, rng):
    form, theta = FORMS[name]()
    form = form.with_gain(n_gain_harmonics)
    return form, np.concatenate([theta, gain_of(form, rng)])


def predictions(form, parameters, record, x0):
    return simulate(form.response(parameters, sensitivities=False), record, x0)[1]


@pytest.mark.parametrize("n_gain_harmonics", GAINS)
@pytest.mark.parametrize("name", FORMS)
def test_predictions_are_those_of_a_plain_loop(name, n_gain_harmonics, rng):
    form, parameters = case(name, n_gain_harmonics, rng)
    record, psi = record_of(form, rng, 27)
    x0 = rng.standard_normal(2)
    expected = plain_predictions(form, parameters, record, psi, x0)
    found = predictions(form, parameters, record, x0)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    left = residuals(form.response(parameters, sensitivities=False), record, x0)
    np.testing.assert_allclose(left, expected - record.outputs, atol=1e-9)


def differences(form, parameters, record, x0, step=1e-6):
    """Central differences of the residuals by x0 and all parameters, (c, n_samples, l)."""
    point, found = np.concatenate([x0, parameters]), []
    for k in range(len(point)):
        ends = []
        for sign in (1.0, -1.0):
            moved = point.copy()
            moved[k] += sign * step
            response = form.response(moved[len(x0) :], sensitivities=False)
            ends.append(residuals(response, record, moved[: len(x0)]))
        found.append((ends[0] - ends[1]) / (2.0 * step))
    return np.array(found)


@pytest.mark.parametrize("piece", [1, pytest.param(10**9, marks=pytest.mark.slow)])
@pytest.mark.parametrize("n_gain_harmonics", [None, 1])
@pytest.mark.parametrize("name", FORMS)
def test_derivatives_are_central_differences(name, n_gain_harmonics, piece, rng, monkeypatch):
    """By x0, θ and the coefficients of K; all at once or piece by piece."""
    monkeypatch.setattr(predictor, "AT_ONCE", piece)
    form, parameters = case(name, n_gain_harmonics, rng)
    record, _ = record_of(form, rng, 45)
    x0 = rng.standard_normal(2)
    response = form.response(parameters, sensitivities=True)
    pieces = list(output_sensitivities(response, record, x0))
    assert [start for start, *_ in pieces] == [0, *(stop for _, stop, _ in pieces[:-1])]
    assert pieces[-1][1] == 45
    assert (len(pieces) > 1) == (piece == 1)
    found = np.concatenate([dy for *_, dy in pieces], axis=1)
    assert len(found) == n_columns(response, free_x0=True) + 1 == len(parameters) + 3
    expected = differences(form, parameters, record, x0)
    np.testing.assert_allclose(found[:-1], expected, atol=2e-8 * np.max(np.abs(expected)))
    np.testing.assert_array_equal(found[-1], residuals(response, record, x0))
    fixed = [dy for *_, dy in output_sensitivities(response, record, x0, free_x0=False)]
    np.testing.assert_allclose(np.concatenate(fixed, axis=1), found[2:], atol=1e-12)


@pytest.mark.parametrize(
    "n_samples",
    [2, pytest.param(5, marks=pytest.mark.slow), 8, pytest.param(9, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("name", ["whole", "awkward", "constant"])
def test_records_may_be_shorter_than_a_turn(name, n_samples, rng):
    form, parameters = case(name, 1, rng)
    record, psi = record_of(form, rng, n_samples)
    x0 = rng.standard_normal(2)
    expected = plain_predictions(form, parameters, record, psi, x0)
    np.testing.assert_allclose(predictions(form, parameters, record, x0), expected, atol=1e-9)
    response = form.response(parameters, sensitivities=True)
    found = np.concatenate([dy for *_, dy in output_sensitivities(response, record, x0)], axis=1)
    expected = differences(form, parameters, record, x0)
    np.testing.assert_allclose(found[:-1], expected, atol=2e-8 * max(1, np.max(np.abs(expected))))


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("count", [0, 2])
def test_a_gain_of_zero_is_a_simulation(name, count, rng):
    form, theta = FORMS[name]()
    record, _ = record_of(form, rng, 40)
    x0 = rng.standard_normal(2)
    still = form.with_gain(count)
    found = predictions(still, np.append(theta, np.zeros(still.n_gains)), record, x0)
    np.testing.assert_allclose(found, predictions(form, theta, record, x0), atol=1e-12)


def test_a_deadbeat_gain_forgets_the_start(rng):
    """K = Φ C⁻¹: the state follows the last output alone."""
    structure, theta = oscillator(steps=True, varies="")
    form = Form(structure, 1.0, 1, discrete=True, n_gain_harmonics=0)
    coefficients = structure.coefficients(theta)[0]
    gain = coefficients[:2, :2] @ np.linalg.inv(coefficients[2:, :2])
    parameters = np.concatenate([theta, gain.ravel()])
    record, _ = record_of(form, rng)
    one, other = (predictions(form, parameters, record, x0) for x0 in rng.standard_normal((2, 2)))
    assert np.max(np.abs(one[0] - other[0])) > 0.1
    np.testing.assert_allclose(one[1:], other[1:], atol=1e-12)
    response = form.response(parameters, sensitivities=False)
    np.testing.assert_allclose(response.closed, 0.0, atol=1e-14)
    assert form.radius(response) < 1e-6


def test_an_unstable_model_with_a_stable_predictor_is_predicted(rng):
    structure, theta = oscillator(steps=True, varies="")
    form = Form(structure, 1.0, 1, discrete=True)
    theta = theta.copy()
    theta[:2] = 1.3, 0.2  # grows by thousands of powers of ten over the record
    record, _ = record_of(form, rng, 20_000)
    with_gain = form.with_gain(0)
    M = structure.coefficients(theta)[0]
    gain = 0.9 * M[:2, :2] @ np.linalg.inv(M[2:, :2])
    parameters = np.concatenate([theta, gain.ravel()])
    assert form.radius(form.response(theta, sensitivities=False)) > 1.0
    assert with_gain.radius(with_gain.response(parameters, sensitivities=False)) < 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        assert not np.all(np.isfinite(predictions(form, theta, record, np.ones(2))))
    assert np.max(np.abs(predictions(with_gain, parameters, record, np.ones(2)))) < 100.0


# ---- all Fourier coefficients free ---------------------------------------------------------------


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
    span = orthonormal_range(S.reshape(600, -1), rank=1e-5)
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
    assert orthonormal_range(S[:, 0], rank=1e-5).shape[1] == 2  # pole and gain
    S = sensitivities(rows, u, x, e, one, one, feedthrough=True)
    span = orthonormal_range(S[:, 0], rank=1e-5)
    assert span.shape[1] == 5  # D, a and c (whose start differs), too
