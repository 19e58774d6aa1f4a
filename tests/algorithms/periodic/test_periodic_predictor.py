"""The predictor of a periodic machine, and the states behind it."""

import numpy as np
import pytest

from sklearn_hd.algorithms.periodic import periodic_predictor
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_predictor import (
    SENSOR_NOISE,
    LagSums,
    Layout,
    StateSums,
    forced_mean,
    futures_known,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

STEP = 2 * np.pi / 7.3


def segment(n_rows, m=2, n_outputs=1, seed=0, start=0.3):
    rng = np.random.default_rng(seed)
    psi = start + STEP * np.arange(n_rows)
    return rng.standard_normal((n_rows, m)), rng.standard_normal((n_rows, n_outputs)), psi


def layout(**changes):
    given = {"n_inputs": 2, "n_outputs": 1, "n_lags": 3, "n_harmonics": 2}
    given |= {"n_input_harmonics": 1, "n_loads": 2, "feedthrough": True}
    return Layout(**(given | changes))


def test_regressors_are_products_of_lags_and_harmonics():
    u, y, psi = segment(30)
    own = layout()
    X = own.design(u, y, psi, np.arange(3, 30))
    functions = harmonic_functions(psi, range(3))
    k = 11  # row 8 of the design
    loads, now = functions[k], np.kron(u[k], functions[k, :3])
    lags = [
        np.concatenate([np.kron(u[k - s], functions[k, :3]), np.kron(y[k - s], functions[k])])
        for s in (1, 2, 3)
    ]
    np.testing.assert_allclose(X[k - 3], np.concatenate([loads, now, *lags]), rtol=1e-14)
    assert X.shape[1] == own.n_columns


@pytest.mark.parametrize(
    "smaller",
    [
        {"n_lags": 2},
        {"n_harmonics": 1},
        {"n_harmonics": 0, "n_input_harmonics": 0},
        {"n_input_harmonics": 0},
        {"feedthrough": False},
        {"n_loads": 0, "n_lags": 1},
    ],
)
def test_a_smaller_regression_is_part_of_a_larger_one(smaller):
    u, y, psi = segment(40)
    large, small = layout(), layout(**smaller)
    rows = np.arange(3, 40)
    X, part = (each.design(u, y, psi, rows) for each in (large, small))
    np.testing.assert_array_equal(X[:, small.places_in(large)], part)


def test_sums_do_not_depend_on_chunks_or_segments(monkeypatch):
    whole = segment(900)
    own = layout()
    sums = LagSums.of([whole], own)
    monkeypatch.setattr(periodic_predictor, "AT_ONCE", 1)
    np.testing.assert_allclose(LagSums.of([whole], own).gram, sums.gram, rtol=1e-12, atol=1e-9)
    apart = [segment(400, seed=1), segment(300, seed=2, start=1.0)]
    together = LagSums.of(apart, own)
    each = [LagSums.of([one], own) for one in apart]
    np.testing.assert_allclose(together.gram, sum(s.gram for s in each), rtol=1e-10, atol=1e-9)
    assert together.n_rows == sum(s.n_rows for s in each) == 397 + 297


def periodic_regression(n_rows, noise, seed=0):
    """y[k] = (0.6 + 0.2 cos ψ) y[k−1] + (1 − 0.5 sin ψ) u[k−2] + 0.3 cos 2ψ + e[k]."""
    rng = np.random.default_rng(seed)
    psi = STEP * np.arange(n_rows)
    u, e = rng.standard_normal((n_rows, 1)), noise * rng.standard_normal(n_rows)
    y = np.zeros((n_rows, 1))
    for k in range(2, n_rows):
        y[k] = (0.6 + 0.2 * np.cos(psi[k])) * y[k - 1] + (1 - 0.5 * np.sin(psi[k])) * u[k - 2]
        y[k] += 0.3 * np.cos(2 * psi[k]) + e[k]
    return u, y, psi


def test_a_periodic_regression_is_found():
    one = periodic_regression(4000, noise=0.1)
    own = layout(n_inputs=1, n_lags=2, n_harmonics=1, feedthrough=False)
    found = LagSums.of([one], own).predictor()
    np.testing.assert_allclose(found.covariance, 0.01, rtol=0.05)
    truth = np.zeros((2, 3, 2))  # lag, function, channel
    truth[0, :2, 1] = 0.6, 0.2
    truth[1, [0, 2], 0] = 1.0, -0.5
    np.testing.assert_allclose(found.lags[..., 0], truth, atol=0.01)
    np.testing.assert_allclose(found.loads[:, 0], [0, 0, 0, 0.3, 0], atol=0.01)
    assert not found.D.any()


def test_criteria_tell_lags_and_harmonics():
    one = periodic_regression(4000, noise=0.1)
    sums = LagSums.of([one], layout(n_inputs=1, n_lags=6, n_harmonics=2, n_input_harmonics=2))
    least = {}
    for count in range(3):
        own = layout(n_inputs=1, n_lags=6, n_harmonics=count, n_input_harmonics=count)
        _, bic = sums.part(own).criteria(1)
        least[count] = bic.min(), int(np.argmin(bic)) + 1
    assert min(least, key=least.get) == 1
    assert least[1][1] == 2


def test_exact_data_lead_to_the_predictor_for_a_little_sensor_noise():
    """Of y[k] = 0.9 y[k−1] + u[k−1] without noise many predictors of two lags are exact."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((5000, 1)), np.zeros((5000, 1))
    for k in range(1, 5000):
        y[k] = 0.9 * y[k - 1] + u[k - 1]
    own = Layout(1, 1, 2, 0, 0, 0, False)
    found = LagSums.of([(u, y, STEP * np.arange(5000))], own).predictor()
    # y[k] = (0.9 − g) y[k−1] + u[k−1] + 0.9 g y[k−2] + g u[k−2]: least noise in (0.9 − g, 0.9 g)
    g = 0.9 / (1 + 0.81)
    np.testing.assert_allclose(found.lags[:, 0, 1, 0], [0.9 - g, 0.9 * g], atol=2e-3)
    np.testing.assert_allclose(found.lags[:, 0, 0, 0], [1.0, g], atol=2e-3)
    assert 0.0 < found.covariance.item() < SENSOR_NOISE**2
    assert abs(found.left.item()) < 1e-3 * SENSOR_NOISE**2
    noisy = y + 0.1 * rng.standard_normal(y.shape)
    found = LagSums.of([(u, noisy, STEP * np.arange(5000))], own).predictor()
    e = noisy[2:] - sum(
        np.hstack([u, noisy])[2 - s : 5000 - s] @ found.lags[s - 1, 0] for s in (1, 2)
    )
    np.testing.assert_allclose(found.left, np.mean((e - found.loads[0]) ** 2, axis=0), rtol=1e-6)


def test_what_is_known_of_outputs_to_come():
    u, y, psi = segment(60)
    own = layout(n_lags=4, feedthrough=False)
    predictor = LagSums.of([segment(800, seed=3)], own).predictor()
    first, known, free = futures_known((u, y, psi), predictor, 3)
    z, k = np.hstack([u, y]), 17
    for j in range(3):  # inputs are zero from row k on, outputs too, or as predicted
        functions = harmonic_functions(psi[k + j], range(3))

        def answer(n_before, functions=functions, j=j):
            return sum(
                np.einsum("q,qwl,w->l", functions, predictor.lags[s - 1], z[k + j - s])
                for s in range(n_before + 1, 5)
            )

        np.testing.assert_allclose(known[k - first, j], answer(j)[0], rtol=1e-12)
        z[k + j] = 0.0
        z[k + j, own.n_inputs :] = answer(0)
    np.testing.assert_allclose(free[k - first], z[k : k + 3, own.n_inputs :].ravel(), rtol=1e-12)
    assert first == 4
    assert len(known) == 60 - 4 - 2


def test_a_segment_without_a_whole_predictor_tells_nothing():
    predictor = LagSums.of([segment(800)], layout(n_lags=4)).predictor()
    _, known, free = futures_known(segment(5), predictor, 3)
    assert known.shape == free.shape == (0, 3)


def test_means_are_those_of_periodic_signals_at_any_clock():
    psi = STEP * np.arange(500)
    u = 2.0 + np.cos(psi)[:, None] * [1.0, 0.5]
    y = 3.0 * np.sin(2 * psi)[:, None]
    inputs, outputs = forced_mean([(u[:200], y[:200], psi[:200]), (u[200:], y[200:], psi[200:])], 2)
    np.testing.assert_allclose(inputs, [[2, 2], [1, 0.5], [0, 0], [0, 0], [0, 0]], atol=1e-12)
    np.testing.assert_allclose(outputs[:, 0], [0, 0, 0, 0, 3], atol=1e-12)


def known_states(n_rows, order=3, m=2, n_outputs=2, n_harmonics=1, seed=0):
    """Random coefficients, and rows that obey them."""
    rng = np.random.default_rng(seed)
    psi = STEP * np.arange(n_rows)
    M = rng.standard_normal((2 * n_harmonics + 1, order + n_outputs, order + m + 1))
    K = rng.standard_normal((2 * n_harmonics + 1, order, n_outputs))
    x, u = rng.standard_normal((n_rows, order)), rng.standard_normal((n_rows, m))
    e = rng.standard_normal((n_rows, n_outputs))
    known = np.hstack([x, u, np.ones((n_rows, 1))])
    both = np.einsum("tij,tj->ti", evaluate_harmonics(M, psi), known)
    following = both[:, :order] + np.einsum("tij,tj->ti", evaluate_harmonics(K, psi), e)
    return M, K, (x, following, u, both[:, order:], e, psi)


def test_matrices_are_exact_where_states_are_known():
    M, K, rows = known_states(600)
    sums = StateSums.of([rows], n_harmonics=2, n_loads=1)
    coefficients, gain = sums.matrices(1, 1, 1, feedthrough=True)
    np.testing.assert_allclose(coefficients, M, atol=1e-9)
    np.testing.assert_allclose(gain, K, atol=1e-9)


def test_matrices_of_few_harmonics_are_those_of_their_own_regression():
    _, _, rows = known_states(600, n_harmonics=2)
    large = StateSums.of([rows], n_harmonics=2, n_loads=3)
    small = StateSums.of([rows], n_harmonics=1, n_loads=1)
    found = large.matrices(1, 0, 1, feedthrough=False)
    for one, expected in zip(found, small.matrices(1, 0, 1, feedthrough=False), strict=True):
        np.testing.assert_allclose(one[:3], expected, atol=1e-9)
        assert not one[3:].any()
    assert not found[0][1:, :, 3:5].any()  # B constant
    assert not found[0][:, 3:, 3:5].any()  # D zero
