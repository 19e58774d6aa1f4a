"""Laws of what residuals are judged by."""

import numpy as np
import pytest

from sklearn_hd.algorithms.likelihood.likelihood import is_white


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
