"""How long a predictor's memory is, by the definition of Akaike's criterion."""

import numpy as np
import pytest

from sklearn_hd.algorithms.linalg.triangular import triangle
from sklearn_hd.algorithms.subspace.hankel import hankel_factor, n_hankel_columns
from sklearn_hd.algorithms.subspace.projections import rows_remembered

MOST = 5


def autoregressive(rng, m, n_outputs, n_samples, share):
    """Outputs that remember three rows, the last of them by a share that is hardly seen."""
    u, y = rng.standard_normal((n_samples, m)), rng.standard_normal((n_samples, n_outputs))
    weights = rng.standard_normal((n_outputs, m + n_outputs)) / np.sqrt(m + n_outputs)
    for k in range(3, n_samples):
        y[k] += weights @ np.hstack([0.5 * u[k - 1], 0.3 * y[k - 1]])
        y[k] += share * weights @ np.hstack([u[k - 3], y[k - 3]])
    return u, y


def by_definition(u, y, feedthrough):
    """The p of least N log det Σ + 2 p (m + l) l, by regressions on explicit rows."""
    n = len(u) - 2 * MOST + 1
    rows = MOST + np.arange(n)
    criteria = []
    for p in range(1, MOST + 1):
        past = [signal[rows - lag] for lag in range(1, p + 1) for signal in (u, y)]
        X = np.hstack([*past, u[rows]] if feedthrough else past)
        left = y[rows] - X @ np.linalg.lstsq(X, y[rows])[0]
        log_det = np.linalg.slogdet(left.T @ left / n)[1]
        criteria.append(n * log_det + 2 * p * (u.shape[1] + y.shape[1]) * y.shape[1])
    return int(np.argmin(criteria)) + 1


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize(("m", "n_outputs"), [(1, 1), (2, 1), (1, 3), (2, 4), (0, 2)])
@pytest.mark.slow
def test_rows_remembered_are_those_of_the_least_criterion(rng, m, n_outputs, feedthrough):
    """Over records in which one row more, or less, is a close call."""
    chosen = []
    for share in np.linspace(0.0, 0.3, 16):
        u, y = autoregressive(rng, m, n_outputs, 400, share)
        R = hankel_factor([u], [y], MOST)
        columns = n_hankel_columns([len(u)], MOST)
        chosen.append(rows_remembered(R, MOST, m, columns, feedthrough))
        assert chosen[-1] == by_definition(u, y, feedthrough)
    assert {1, 3} <= set(chosen)


@pytest.mark.parametrize("n_outputs", [1, 3, 6])
def test_white_outputs_are_not_remembered(rng, n_outputs):
    """Each row more costs two for each of its coefficients, and white noise pays one."""
    data = rng.standard_normal((20, 600, n_outputs + 1))
    factors = [hankel_factor([d[:, :1]], [d[:, 1:]], MOST) for d in data]
    columns = n_hankel_columns([600], MOST)
    rows = [rows_remembered(triangle(R), MOST, 1, columns, False) for R in factors]
    assert rows.count(1) >= 16
