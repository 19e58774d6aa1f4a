"""Signals sampled at uneven places, brought onto a uniform grid, and back.

A signal s is known at places p_0 < p_1 < … (seconds, or azimuth over the mean
speed). Analysis wants it on the multiples of a step h. Two kinds of signal are
told apart:

* smooth ones (outputs, inputs known by their harmonics): the interpolating
  spline of degree five, in both directions. With at least 16 samples in a
  period of the highest frequency its error is below 1e-5 of the amplitude,
  with 32 below 1e-7, with 64 below 1e-8, also where the places are off the
  grid by a fifth of a step; white noise keeps its size within 15 %;
* inputs held from one place to the next: the mean of the held signal over each
  interval [g, g + h) that a sample on the grid is held for. A step stays a step
  (a spline would ring about it) and nothing of its area is lost.

Where the places lie on the grid already both give the samples back. Records with jitter, gaps
or a measured azimuth need them.

Signals that come late: moved by whole samples, and by parts of them.

A delay of κ = k + f samples, k whole and 0 ≤ f < 1, makes of an input v that is held from sample
to sample

    u(t) = v[j − k − 1] for the first f of the interval behind sample j, then v[j − k].

Its mean over the interval, (1 − f) v[j − k] + f v[j − k − 1], held, moves a system as u does but
for terms of the second order in the sample time. Both values as two inputs, with an effect each
(:mod:`sklearn_hd.algorithms.likelihood.forms`), are exact.

An output that is read late is moved the other way. Between its samples it is smooth, and splines
tell it. Nothing is ever taken from the other end of a record: before its first row an input is
held at its first value, and whoever fits a model leaves these rows out. Subspace steps move
records so; predictions are brought back by the same splines.
"""

import numpy as np
from scipy.interpolate import make_interp_spline

ON_GRID = 1e-6  # share of a step within which a place counts as being on the grid


def uniform_grid(start, stop, step):
    """Multiples of ``step`` from ``start`` to ``stop``; the nearest one if there is none.

    Examples
    --------
    >>> uniform_grid(0.3, 2.0, 0.5).tolist()
    [0.5, 1.0, 1.5, 2.0]
    """
    first = int(np.ceil(start / step - ON_GRID))
    last = int(np.floor(stop / step + ON_GRID))
    if last < first:
        first = last = round(start / step)
    return np.arange(first, last + 1) * step


def interpolate(values, places, at, degree=5):
    """Spline through some samples, evaluated elsewhere.

    ``places`` increase. Points ``at`` beyond the ends continue the last piece of the
    spline. Where there are too few samples for the ``degree``, it is lower.

    Examples
    --------
    >>> t = np.arange(64) / 32
    >>> s = interpolate(np.cos(2 * np.pi * t)[:, None], t, np.array([1.01]))
    >>> bool(abs(s[0, 0] - np.cos(2 * np.pi * 1.01)) < 1e-7)
    True
    """
    if len(places) == 1:
        return np.repeat(values, len(at), axis=0)
    degree = min(degree, (len(places) - 1 - (len(places) - 2) % 2))  # odd, fewer than the samples
    origin = places[0]  # times far from zero would cost digits
    return make_interp_spline(places - origin, values, degree)(np.asarray(at) - origin)


def interpolation_error(values, places):
    """Bound of the error, root mean square, of the spline through some samples.

    Every second sample is left out and the spline through the others compared
    with it. With all samples the error is less than half of that: at a kink it
    falls by 2.8 when the samples double, where the signal is smooth by 8 (kinks
    of the second derivative) to 64. On records of the flapping wing with 16 to
    64 samples a period the bound was 1.6 to 4.8 times the true error.

    ``places`` increase, and the bound (n_signals,) is in the units of the signals.

    Examples
    --------
    >>> t = np.arange(640) / 32
    >>> bool(interpolation_error(np.cos(2 * np.pi * t)[:, None], t)[0] < 1e-5)
    True
    """
    if len(places) < 4:
        return np.sqrt(np.mean(values**2, axis=0))  # too few to tell
    errors = [
        interpolate(values[kept::2], places[kept::2], places[1 - kept :: 2]) - values[1 - kept :: 2]
        for kept in (0, 1)
    ]
    return 0.5 * np.sqrt(np.mean(np.vstack(errors) ** 2, axis=0))


def held_means(values, places, grid, step):
    """Means, over each interval of a grid, of signals held from one place to the next.

    ``places`` increase. The first value also counts before its place, the last after
    it. Intervals start at the ``grid``, ``step`` apart.

    Examples
    --------
    >>> u = np.array([[0.0], [1.0], [1.0]])
    >>> held_means(u, np.array([0.0, 1.25, 2.5]), np.arange(3.0), 1.0).ravel().tolist()
    [0.0, 0.75, 1.0]
    """
    borders = np.append(grid, grid[-1] + step)
    inside = places[(places > borders[0]) & (places < borders[-1])]
    edges = np.union1d(borders, inside)
    held = _row_held(places, edges[:-1])
    owner = np.clip(np.searchsorted(borders, edges[:-1], side="right") - 1, 0, len(grid) - 1)
    share = np.diff(edges) / step
    # beside the value at the start of the interval, so that what is constant stays exactly so
    start = values[_row_held(places, grid + ON_GRID * step)]
    excess = (values[held] - start[owner]) * share[:, None]
    means = start.copy()
    np.add.at(means, owner, excess)
    return means


def _row_held(places, at):
    return np.clip(np.searchsorted(places, at, side="right") - 1, 0, len(places) - 1)


def bridge(values, places, longest, degree=3):
    """Short runs of NaN between finite samples of one signal, filled by interpolation.

    Runs of up to ``longest`` samples are filled, but not at the ends. ``degree`` is
    that of the spline through the finite samples.

    Examples
    --------
    >>> bridge(np.array([0.0, np.nan, 2.0, np.nan, np.nan, 5.0]), np.arange(6.0), 1).tolist()
    [0.0, 1.0, 2.0, nan, nan, 5.0]
    """
    missing = np.isnan(values)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(int)))
    starts, stops = edges[::2], edges[1::2]
    short = (stops - starts <= longest) & (starts > 0) & (stops < len(values))
    if not short.any():
        return values
    rows = np.concatenate(
        [np.arange(a, b) for a, b in zip(starts[short], stops[short], strict=True)]
    )
    filled = values.copy()
    known = ~missing
    filled[rows] = interpolate(values[known, None], places[known], places[rows], degree)[:, 0]
    return filled


def unwrap(azimuth, time):
    """Azimuth that grows from turn to turn, from one that may start anew at each turn.

    An azimuth that only ever grows is returned as it is. NaN stays NaN, and
    the turns passed meanwhile are told from the median speed.

    Examples
    --------
    >>> unwrap(np.array([5.0, 6.0, 0.8]), np.arange(3.0)).round(4).tolist()
    [5.0, 6.0, 7.0832]
    """
    known = np.isfinite(azimuth)
    steps = np.diff(azimuth[known])
    if np.all(steps > 0.0):
        return azimuth
    passed = np.diff(time[known])
    turn = 2.0 * np.pi
    speed = np.median((steps - turn * np.rint(steps / turn)) / passed)
    steps += turn * np.rint((speed * passed - steps) / turn)
    whole = azimuth.copy()
    whole[known] = np.cumsum(np.concatenate([azimuth[known][:1], steps]))
    return whole


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

    Lags below zero move it earlier; the last value is then held behind.

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


def late(values, samples):
    """Smooth signals some samples later; before the first row they hold the first value.

    Below zero, earlier: outputs read late, at the rows at which they were, the last value held.

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
    """Fourier coefficients (2 N + 1, …) of periodic signals, later by one angle or one each.

    Examples
    --------
    >>> turned(np.array([[0.0], [1.0], [0.0]]), np.array([np.pi / 2])).round(12).ravel().tolist()
    [0.0, 0.0, 1.0]
    """
    found = np.array(coefficients, dtype=float)
    orders = np.arange(1, len(found) // 2 + 1).reshape(-1, *(1,) * (found.ndim - 1))
    moved = (found[1::2] - 1j * found[2::2]) * np.exp(-1j * orders * angles)
    found[1::2], found[2::2] = moved.real, -moved.imag
    return found
