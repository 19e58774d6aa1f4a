"""Laws of what residuals are judged by, and of the waveform that they are taken about."""

from dataclasses import replace

import numpy as np
import pytest
from predictor_cases import OMEGA, oscillator

from sklearn_hd._records.likelihood import with_loads
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import (
    _AboutWaveform,
    is_white,
    likelihood_problem,
)
from sklearn_hd.algorithms.likelihood.search import result_of, search, start
from sklearn_hd.algorithms.likelihood.uncertainty import exponent_slopes, propagate_std
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics


def correlated(statistic, n, lag, scale=1.0):
    """Residuals of n ρ² = statistic at one lag, and zero at all others."""
    rho = np.sqrt(statistic / n)
    left = np.zeros(n)
    left[0], left[lag] = scale, scale * (1.0 - np.sqrt(1.0 - 4.0 * rho**2)) / (2.0 * rho)
    return left


@pytest.mark.parametrize("n", [400, 5000])
@pytest.mark.parametrize("lags", [1, 8, 30])
def test_white_ends_four_spreads_above_what_white_noise_has(n, lags):
    """The sum of n ρ² over L lags has mean L and variance 2 L."""
    limit = lags + 4.0 * np.sqrt(2.0 * lags)
    for lag in (1, lags):
        below, above = (correlated(share * limit, n, lag) for share in (0.99, 1.01))
        assert is_white(below[:, None], lags)
        assert not is_white(above[:, None], lags)
        assert is_white(correlated(1.01 * limit, n, lags + 1)[:, None], lags)  # beyond the last
        # each output by itself, whatever its size
        small = correlated(1.01 * limit, n, lag, scale=1e-6)
        assert not is_white(np.column_stack([below, small]), lags)
        assert is_white(np.column_stack([below, 1e-6 * below]), lags)


def test_white_noise_is_called_white_and_what_is_nearly_so_is_not(rng):
    """Of 30 lags the chi-squared law lets one of a thousand by; φ = 0.2 of 2000 samples is seen."""
    noise = rng.standard_normal((300, 2001))
    assert np.mean([is_white(row[:, None], 30) for row in noise]) >= 0.98
    moving = noise[:, 1:] + 0.2 * noise[:, :-1]
    assert np.mean([is_white(row[:, None], 30) for row in moving]) <= 0.2


def about_waveforms(rng, gain, n_phases=7):
    """A form of steps, its parameters, and two records of it."""
    structure, theta = oscillator(steps=True, varies="FG")
    form = Form(structure, OMEGA, n_phases, discrete=True, gauge=True)
    still = form.response(theta, sensitivities=False)
    segments = []
    for n_rows, first in ((400, 3), (40, 0)):
        u = np.repeat(rng.standard_normal(n_rows // 5 + 1), 5)[:n_rows, None]
        x, y, noise = np.zeros(2), np.empty((n_rows, 2)), 0.05 * rng.standard_normal((n_rows, 2))
        for k in range(n_rows):
            z, phase = np.append(x, u[k]), (first + k) % n_phases
            y[k] = still.Out[phase % len(still.Out)] @ z + noise[k]
            x = still.Psi[phase] @ z + (0.0 if gain is None else gain[0] @ noise[k])
        segments.append((u, y, first))
    if gain is None:
        return form, theta, segments
    return form.with_gain(0), np.concatenate([theta, gain.ravel()]), segments


def fitted(form, segments, theta):
    problem = likelihood_problem(form, segments, correlated=form.n_gain_harmonics is not None)
    found = search(
        problem, start(problem, theta), max_iter=40, tol=1e-13, keep_stable=True, bounds=None
    )
    return result_of(problem, found)


GAINS = [None, np.array([[[0.5, 0.1], [-0.2, 0.4]]])]


@pytest.mark.parametrize("gain", GAINS)
def test_a_free_waveform_is_a_fourier_series_of_outputs_with_all_harmonics(rng, gain):
    """The same likelihood, exponents' deviations and criteria as with parameters for it."""
    form, theta, segments = about_waveforms(rng, gain)
    segments, k = segments[:1], form.structure.n_parameters
    found = fitted(replace(form, waveform=True), segments, theta)
    with_constant = [(np.column_stack([u, np.ones(len(u))]), y, first) for u, y, first in segments]
    explicit = replace(form, structure=with_loads(form.structure, 3))
    longer = np.concatenate([theta[:k], np.zeros(14), theta[k:]])
    other = fitted(explicit, with_constant, longer)
    assert found.converged
    assert other.converged
    assert found.cost == pytest.approx(other.cost, abs=1e-8)
    np.testing.assert_allclose(found.spread, other.spread, rtol=1e-7)
    assert found.n_parameters == other.n_parameters
    assert found.aic == pytest.approx(other.aic, abs=1e-8)
    slopes = [exponent_slopes(each.problem.form, each.point.theta) for each in (found, other)]
    deviations = [
        propagate_std(slope[:, :k], each.covariance[:k, :k])
        for (_, slope), each in zip(slopes, (found, other), strict=True)
    ]
    np.testing.assert_allclose(*(exponents for exponents, _ in slopes), rtol=1e-6)
    np.testing.assert_allclose(*deviations, rtol=1e-5)
    series = other.theta[form.structure.n_parameters :].reshape(7, 2)
    loads = evaluate_harmonics(series, 2.0 * np.pi * np.arange(7) / 7)
    np.testing.assert_allclose(found.problem.waveform(found.point), loads, atol=1e-6)


@pytest.mark.parametrize("gain", GAINS)
def test_each_record_may_have_any_waveform(rng, gain):
    form, theta, segments = about_waveforms(rng, gain)
    form, moved = replace(form, waveform=True), []
    for u, y, first in segments:
        wave = 3.0 * rng.standard_normal((7, 2))
        moved.append((u, y + wave[(first + np.arange(len(y))) % 7], first))
    found, other = (fitted(form, each, theta) for each in (segments, moved))
    assert found.cost == pytest.approx(other.cost, abs=1e-6)
    np.testing.assert_allclose(found.sigma, other.sigma, rtol=1e-5)
    np.testing.assert_allclose(
        *(exponent_slopes(form, each.point.theta)[0] for each in (found, other)), rtol=1e-4
    )


def test_rows_about_a_waveform_are_the_same_in_pieces_of_any_length(rng):
    values, about = rng.standard_normal((4, 50, 2)), _AboutWaveform(7)
    rows = np.concatenate([about.rows(values[:, k : k + 11]) for k in range(0, 50, 11)], axis=1)
    np.testing.assert_allclose(rows, _AboutWaveform(7).rows(values), rtol=0.0, atol=1e-14)
    # products of two columns are those about the mean of each phase
    mean = np.zeros_like(values)
    for phase in range(7):
        mean[:, phase::7] = values[:, phase::7].mean(axis=1, keepdims=True)
    left = (values - mean).reshape(4, -1)
    np.testing.assert_allclose(rows.reshape(4, -1) @ rows.reshape(4, -1).T, left @ left.T)


def test_records_of_less_than_two_turns_keep_the_trim_that_was_subtracted(rng):
    form, theta, segments = about_waveforms(rng, None)
    u, y, first = segments[0]
    short = [(u[:13], y[:13], first)]
    problem = likelihood_problem(replace(form, waveform=True), short)
    own = likelihood_problem(form, short)
    x0 = np.zeros((1, 2))
    assert problem.point(theta, x0).cost == own.point(theta, x0).cost
    assert problem.n_waveforms == 0
    assert problem.waveform(own.point(theta, x0)) is None
