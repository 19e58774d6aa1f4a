"""Signals that come late: moved by whole samples, and by parts of them.

A delay of κ = k + f samples, k whole and 0 ≤ f < 1, makes of an input v that is held from sample
to sample

    u(t) = v[j − k − 1] for the first f of the interval behind sample j, then v[j − k].

Its mean over the interval, (1 − f) v[j − k] + f v[j − k − 1], held, moves a system as u does but
for terms of the second order in the sample time. Both values as two inputs, with an effect each
(:mod:`sklearn_hd.algorithms.periodic.delayed_response`), are exact.

An output that is read late is moved the other way. Between its samples it is smooth, and splines
tell it. Nothing is ever taken from the other end of a record: before its first row an input is
held at its first value, and whoever fits a model leaves these rows out. Subspace steps move
records so; predictions are brought back by the same splines.
"""

import numpy as np

from sklearn_hd.algorithms.signals.resampling import ON_GRID, interpolate


def first_lag(samples):
    """Whole samples of some delays, and what is left of them, between 0 and 1.

    What is whole except for rounding is whole.

    Examples
    --------
    >>> first_lag(np.array([2.25, 3.0 - 1e-9]))
    (array([2, 3]), array([0.25, 0.  ]))
    """
    whole = np.floor(np.asarray(samples, dtype=float) + ON_GRID).astype(int)
    rest = samples - whole
    return whole, np.where(rest < ON_GRID, 0.0, rest)


def lagged(values, lags):
    """Each signal some whole samples later, held at its first value before.

    Parameters
    ----------
    values : ndarray, shape (n_samples, n_signals)
    lags : ndarray of int, shape (n_signals,)
        Below zero, earlier; the last value is then held behind.

    Examples
    --------
    >>> lagged(np.arange(4.0)[:, None], np.array([2])).ravel().tolist()
    [0.0, 0.0, 0.0, 1.0]
    """
    rows = np.arange(len(values))[:, None] - np.asarray(lags)
    return np.take_along_axis(values, np.clip(rows, 0, len(values) - 1), axis=0)


def arriving(values, samples):
    """Held inputs as they arrive, by their means over each interval.

    Examples
    --------
    >>> arriving(np.array([[0.0], [1.0], [1.0]]), np.array([0.25])).ravel().tolist()
    [0.0, 0.75, 1.0]
    """
    whole, rest = first_lag(samples)
    new = lagged(values, whole)
    return new + rest * (lagged(values, whole + 1) - new)


def advanced(values, samples):
    """Outputs read late, at the rows at which they were; the last ones hold the last value.

    Parameters
    ----------
    values : ndarray, shape (n_samples, n_signals)
    samples : ndarray, shape (n_signals,)
    """
    return late(values, -np.asarray(samples, dtype=float))


def late(values, samples):
    """Smooth signals some samples later; before the first row they hold the first value.

    Examples
    --------
    >>> t = np.arange(100.0)[:, None]
    >>> bool(np.allclose(late(np.sin(0.1 * t), np.array([1.5]))[2:], np.sin(0.1 * t - 0.15)[2:]))
    True
    """
    whole, rest = first_lag(samples)
    if not (whole.any() or rest.any()):
        return values
    whole, rest = (np.broadcast_to(each, values.shape[1:]) for each in (whole, rest))
    moved, place = lagged(values, whole), np.arange(float(len(values)))
    for j in np.flatnonzero(rest):
        at = np.clip(place - whole[j] - rest[j], 0.0, place[-1])
        moved[:, j] = interpolate(values[:, [j]], place, at)[:, 0]
    return moved


def turned(coefficients, angles):
    """Fourier coefficients (2 N + 1, n_signals) of periodic signals, later by some angles.

    Examples
    --------
    >>> turned(np.array([[0.0], [1.0], [0.0]]), np.array([np.pi / 2])).round(12).ravel().tolist()
    [0.0, 0.0, 1.0]
    """
    found, orders = np.array(coefficients, dtype=float), np.arange(1, len(coefficients) // 2 + 1)
    turn = np.exp(-1j * orders[:, None] * angles)
    moved = (found[1::2] - 1j * found[2::2]) * turn
    found[1::2], found[2::2] = moved.real, -moved.imag
    return found
