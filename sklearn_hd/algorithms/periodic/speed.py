"""The speed of a machine, as precisely as its record tells it.

A machine that turns has an orbit, a waveform w of the turn beside which what inputs do is small:

    y(t) = w(ψ) + r(t),   ψ = ω t,   ∂y/∂δ = (ψ − ψ̄) w′(ψ)   for ω (1 + δ)

Over hundreds of turns a speed that is off by a millionth leaves more of the orbit than r is. Two
kinds of Gauss-Newton steps for δ follow each other:

1. beside the Fourier coefficients of w, with r as if it were white; on some turns about the
   middle first, then on more, so that no step is longer than a part of a turn;
2. of what a periodic predictor leaves (:func:`~.periodic_predictor.azimuth_drift`), in which r is
   explained by what was before, as long as it leaves less and less. That is ten to a thousand
   times as precise, but a predictor with poles near one imitates an orbit that drifts, so it
   comes last.

Either half of the record has to show the orbit of the other: without one (a trim subtracted) speeds
stay as given. And the new one has to be worth it: the predictor leaves less by Rao's and by the
likelihood ratio test, and it does so in either half. The analyzer needs it; ``estimate_omega``
needs the speed itself.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.harmonic_decomposition import derivative_matrix
from sklearn_hd.algorithms.periodic.periodic_predictor import (
    LagSums,
    Layout,
    azimuth_drift,
    forced_mean,
    spread_rows,
)
from sklearn_hd.algorithms.signals.fourier import MOST_ROWS, ROWS_PER_COLUMN, harmonic_functions
from sklearn_hd.algorithms.signals.fundamental import BEYOND

LEAST_TURNS = 3.0  # of a record: fewer repeat nothing
FIRST_TURNS = 16  # about the middle, of the first steps: speeds off by a hundredth are found
MOST_STEPS = 8
LAGS = 8  # of the predictor
ORBITS = 2  # harmonics of what inputs do: one alone takes the orbit of another input for a speed
ORBIT = 0.02  # of the energy of an output about its mean, that the orbit of the other half holds
HALVES = 1 / 16  # of what a half gains by another speed if it tells as much of it as the other
WORTH = 0.01  # of what a predictor leaves, that another speed has to explain
VARIES = 0.1  # of a speed, searched to either side in a part of the records
START = 0.01  # of a speed, between starts: 0.08 turns at either end of the first turns
PART_TURNS = 4 * LEAST_TURNS  # of a part, whose halves tell, too
FAR_ASTRAY = 0.05  # turns over a part: turbulence alone shifts the phase by up to a third of that


class Speed(NamedTuple):
    """Another speed than the one given.

    ``omega`` and its deviation ``std`` are in rad/s. ``turns`` is by how much the
    azimuth would have gone astray over the record. ``moved`` is what that is of the
    outputs about their waveforms, in parts of their energy.
    """

    omega: float
    std: float
    turns: float
    moved: float


def measured_speed(segments, omega, n_harmonics):
    """The speed at which a record repeats itself, if surely another than some.

    Segments are (inputs, outputs, time), evenly sampled, and the harmonics are those of
    the waveform. Returns None where the record tells no other speed.
    """
    sought = _sought(segments, omega, n_harmonics)
    if sought is None:
        return None
    segments, given, found, n_harmonics = sought
    n_rows = sum(len(y) for _, y, _ in segments)
    off, std = found.omega / omega - 1.0, found.std
    enough = max(BEYOND**2, WORTH * n_rows)
    if not ((off / std) ** 2 > enough and n_rows * (given.left - found.left) > enough):
        return None
    if not _is_of_halves(segments, given, found, n_harmonics):
        return None
    slopes, rest, _ = _waveform_slopes(segments, found.omega, n_harmonics)
    moved = float(np.max(off**2 * np.sum(slopes**2, axis=0) / _energy(rest)))
    turns = _span(segments) * omega / (2.0 * np.pi)
    return Speed(found.omega, std * omega, abs(off) * turns, moved)


def orbit_speed(segments, omega, n_harmonics, *, span=0.0):
    """The speed near some at which the orbit of a record repeats itself.

    Parameters are those of :func:`measured_speed`. The speed may lie a ``span``,
    a share of omega, to either side. Returns ω and its standard deviation, or None
    where the record shows no orbit. If half of the record contradicts the orbit's
    speed, these are the speed as given and the distance between both.
    """
    sought = _sought(segments, omega, n_harmonics, span)
    if sought is None or not np.isfinite(sought[2].std):
        return None
    segments, given, found, n_harmonics = sought
    off = abs(found.omega / omega - 1.0)
    far = off > BEYOND * found.std
    if far and not _is_of_halves(segments, given, found, n_harmonics):
        return omega, omega * off
    return found.omega * (1.0 + found.drift), found.std * found.omega


def speeds_apart(parts, omega, n_harmonics, whole=None):
    """The speed of each part of some records by its own orbit, if surely they are not one speed.

    Each part is a list of segments as in :func:`measured_speed`. ``whole`` is ω of all
    records and its standard deviation, from which parts may be apart; by default it is
    the best known of their own. Returns ω and its standard deviation for each part,
    with None for a part that shows no orbit, or is too short for its halves to tell.
    Returns None if they may be one speed.
    """
    least = 2.0 * np.pi * PART_TURNS / omega
    speeds = [
        orbit_speed(own, omega, n_harmonics, span=VARIES) if _span(own) >= least else None
        for own in parts
    ]
    told = [(*speed, _span(own)) for speed, own in zip(speeds, parts, strict=True) if speed]
    if len(told) < 2:
        return None
    omegas, stds, seconds = np.transpose(told)
    best = np.argmin(stds)
    omega, std = whole or (omegas[best], stds[best])
    off = np.abs(omegas - omega)
    apart = off > BEYOND * np.hypot(stds, std)
    return speeds if np.any(apart & (off * seconds > 2.0 * np.pi * FAR_ASTRAY)) else None


def orbit_drift(segments, omega, n_harmonics):
    """By how much the speed of an orbit changes from the first row to the last.

    Twice the difference between the halves of the record, each beside its own waveform: a predictor
    would imitate an orbit that drifts. Parameters are those of :func:`measured_speed`.
    Returns the drift and its standard deviation, in rad/s, or None where a half shows
    no orbit. The deviation is as if what is beside the waveforms were white.
    """
    speeds, variance = [], 0.0
    for half in _halves(_alike(_some_rows(segments))):
        speed = _along_waveform(half, omega, n_harmonics)
        if orbit_share(half, speed, n_harmonics) < ORBIT:
            return None
        slopes, rest, _ = _waveform_slopes(half, speed, n_harmonics)
        variance += 1.0 / (len(rest) * np.sum(slopes**2 / _energy(rest)))
        speeds.append(speed)
    return float(2.0 * (speeds[1] - speeds[0])), float(2.0 * omega * np.sqrt(variance))


def orbit_share(segments, omega, n_harmonics):
    """Share of an output's energy that the waveform of the other half of the record holds.

    The largest of all outputs, the least of both halves. Parameters are those of
    :func:`measured_speed`.
    """
    y, time = np.vstack([y for _, y, _ in segments]), np.concatenate([t for *_, t in segments])
    X, first = harmonic_functions(omega * time, range(n_harmonics + 1)), time < np.median(time)
    shares = []
    for half in (first, ~first):
        waveform = linalg.lstsq(X[~half], y[~half])[0]
        rest, moved = y[half] - X[half] @ waveform, y[half] - y[half].mean(axis=0)
        shares.append(1.0 - np.sum(rest**2, axis=0) / _energy(moved))
    return float(np.max(np.min(shares, axis=0)))


def _sought(segments, omega, n_harmonics, span=0.0):
    """Segments as they are read, predictors at some speed and at that of the orbit; or None.

    And the harmonics of both: as many as the samples tell at either speed.
    """
    n_harmonics = min(n_harmonics, _harmonics_told(segments, omega))
    told = _alike(_some_rows(segments))
    layout = _layout(told, n_harmonics)
    turns = _span(told) * omega / (2.0 * np.pi)
    if n_harmonics < 1 or layout is None or turns < LEAST_TURNS:
        return None
    given = _Predicted.of(told, omega, layout)
    starts = {omega, _strongest(told, omega, n_harmonics, span)}
    starts |= {_along_waveform(told, each, n_harmonics) for each in starts}
    start = max(sorted(starts), key=lambda each: orbit_share(told, each, n_harmonics))
    found = given if start == omega else _Predicted.of(told, start, layout)
    for _ in range(MOST_STEPS):
        if not abs(found.t) > 1.0:
            break
        ahead = _Predicted.of(told, found.omega * (1.0 + found.drift), layout)
        if not ahead.left < found.left:
            break
        found = ahead
    fewer = _harmonics_told(segments, found.omega)
    if fewer < n_harmonics:
        return _sought(segments, omega, fewer, span)
    if orbit_share(told, found.omega, n_harmonics) < ORBIT:
        return None
    return told, given, found, n_harmonics


def _harmonics_told(segments, omega):
    """How many harmonics samples tell from their images about half the sampling rate.

    A harmonic and its image that do not part within the record have phases that nothing tells; a
    speed would seem to be known from them.
    """
    seconds = sum(time[-1] - time[0] for *_, time in segments)
    steps = sum(len(time) - 1 for *_, time in segments)
    if not seconds > 0.0:
        return 0
    turns = seconds * omega / (2.0 * np.pi)
    return max(0, int(0.5 * (steps / turns - 1.0 / max(turns, 1.0))))


def _some_rows(segments):
    """Segments, or pieces of them evenly over a long record."""
    lengths = [len(y) for _, y, _ in segments]
    if sum(lengths) <= MOST_ROWS:
        return segments
    pieces = spread_rows(lengths, MOST_ROWS, n_places=16)
    pieces = [(s, rows) for s, rows in pieces if rows.stop - rows.start > LAGS]
    return [tuple(z[rows] for z in segments[s]) for s, rows in pieces]


def _alike(segments):
    """Signals in parts of their largest values, about zero: no square overflows."""
    middles, sizes = [], []
    for k in (0, 1):
        values = np.vstack([s[k] for s in segments])
        middles.append(0.5 * (values.min(axis=0) + values.max(axis=0)))
        size = np.max(np.abs(values - middles[k]), axis=0)
        sizes.append(np.where(size > 0.0, size, 1.0))
    return [
        ((u - middles[0]) / sizes[0], (y - middles[1]) / sizes[1], time) for u, y, time in segments
    ]


def _halves(segments):
    """Segments before the middle of their time, and after it."""
    times = np.concatenate([time for *_, time in segments])
    middle = 0.5 * (times.min() + times.max())
    for later in (False, True):
        rows = [(time >= middle) == later for *_, time in segments]
        both = zip(segments, rows, strict=True)
        yield [tuple(z[own] for z in segment) for segment, own in both if own.any()]


def _is_of_halves(segments, given, found, n_harmonics):
    """Whether predictions of either half of a record leave less at the speed found, too.

    What is not linear in a few turns of large motion looks like another speed, in these alone. A
    half turns half as far astray, so it gains a quarter of what the whole does, at least a part of
    that.
    """
    gain = HALVES * np.expm1(given.left - found.left) / 4.0
    for half in _halves(segments):
        layout = _layout(half, n_harmonics) if half else None
        if layout is None or _span(half) * given.omega / (2.0 * np.pi) < LEAST_TURNS:
            continue
        here, there = (_Predicted.of(half, each.omega, layout) for each in (given, found))
        if not np.expm1(here.left - there.left) > gain:
            return False
    return True


def _span(segments):
    """Seconds from the first row to the last."""
    return np.ptp([t for *_, time in segments for t in time[[0, -1]]])


def _layout(segments, n_loads):
    """The predictor that the rows with all of its lags determine; None where that is none."""
    m, n_outputs = segments[0][0].shape[1], segments[0][1].shape[1]
    for lags in range(LAGS, 0, -1):
        layout = Layout(m, n_outputs, lags, 1, ORBITS, n_loads, False)
        n_rows = sum(max(len(y) - lags, 0) for _, y, _ in segments)
        if n_rows >= ROWS_PER_COLUMN * layout.n_columns:
            return layout
    return None


def _energy(values):
    """Of each column, one where there is none."""
    found = np.sum(values**2, axis=0)
    return np.where(found > 0.0, found, 1.0)


# ---- beside the waveform -----------------------------------------------------------------------


def _strongest(segments, omega, n_harmonics, span):
    """The speed within a span at which one waveform leaves least of some turns about the middle."""
    near = _about_middle(segments, omega, FIRST_TURNS)
    if not span or sum(len(y) for _, y, _ in near) < ROWS_PER_COLUMN * (2 * n_harmonics + 2):
        return omega
    off = START * np.arange(1, math.ceil(span / START) + 1)
    starts = omega * (1.0 + np.concatenate([-off[::-1], [0.0], off]))
    left = [np.sum(_waveform_slopes(near, each, n_harmonics)[1] ** 2) for each in starts]
    return float(starts[np.argmin(left)])


def _along_waveform(segments, omega, n_harmonics):
    """The speed at which least is left beside one waveform; that given where it is no orbit."""
    turns, found, whole = FIRST_TURNS, omega, _span(segments) * omega / (2.0 * np.pi)
    while True:
        near = _about_middle(segments, omega, turns)
        n_rows = sum(len(y) for _, y, _ in near)
        if n_rows >= ROWS_PER_COLUMN * (2 * n_harmonics + 2):
            found = _steps(near, found, n_harmonics)
        if turns >= whole:
            break
        turns *= 4  # for the next
    return found


def _about_middle(segments, omega, turns):
    """The rows of some turns about the middle of the time."""
    time = np.concatenate([t for *_, t in segments])
    middle, half = 0.5 * (time.min() + time.max()), np.pi * turns / omega
    near = [tuple(z[np.abs(s[2] - middle) <= half] for z in s) for s in segments]
    return [s for s in near if len(s[1])]


def _steps(segments, omega, n_harmonics):
    """Gauss-Newton steps, each output weighed by what the waveform leaves of it."""
    for _ in range(MOST_STEPS):
        slopes, rest, _ = _waveform_slopes(segments, omega, n_harmonics)
        weights = 1.0 / _energy(rest)
        information = np.sum(slopes**2 * weights)
        if information <= 0.0:
            break
        drift = np.sum(slopes * rest * weights) / information
        omega *= 1.0 + drift
        if drift**2 * information * len(rest) < 1.0:
            break
    return omega


def _waveform_slopes(segments, omega, n_harmonics):
    """Slopes of the outputs by δ beside their waveform, what it leaves of them, and outputs."""
    y, psi = (
        np.vstack([y for _, y, _ in segments]),
        omega * np.concatenate([t for *_, t in segments]),
    )
    X = harmonic_functions(psi, range(n_harmonics + 1))
    Q, R = linalg.qr(X, mode="economic")
    waveform = linalg.lstsq(R, Q.T @ y)[0]
    turned = derivative_matrix(n_harmonics, 1, 1.0) @ waveform
    slopes = (X @ turned) * (psi - psi.mean())[:, None]
    return slopes - Q @ (Q.T @ slopes), y - X @ waveform, y


# ---- by prediction -----------------------------------------------------------------------------


class _Predicted(NamedTuple):
    """What a predictor leaves at some speed, and where its errors lead.

    ``drift`` is δ, and ``t`` the same in standard errors. ``left`` is the logarithm of
    the determinant of the covariance that predictions leave.
    """

    omega: float
    drift: float
    t: float
    left: float

    @property
    def std(self):
        """Standard deviation of δ; infinite where the record tells nothing of it."""
        return abs(self.drift / self.t) if self.t else np.inf

    @classmethod
    def of(cls, segments, omega, layout):
        """Of some segments, about their periodic means at this speed, in like units."""
        turning = [(u, y, omega * t) for u, y, t in segments]
        means = forced_mean(turning, layout.n_loads)
        turning = [
            (u - evaluate_harmonics(means[0], psi), y - evaluate_harmonics(means[1], psi), psi)
            for u, y, psi in turning
        ]
        n_rows = sum(len(y) for _, y, _ in turning)
        scales = [np.sqrt(_energy(np.vstack([s[k] for s in turning])) / n_rows) for k in (0, 1)]
        alike = [(u / scales[0], y / scales[1], psi) for u, y, psi in turning]
        predictor = LagSums.of(alike, layout).predictor()
        means = tuple(mean / scale for mean, scale in zip(means, scales, strict=True))
        drift, t, _ = azimuth_drift(alike, means, predictor)
        covariance = predictor.covariance + EXACT * np.eye(layout.n_outputs)
        left = np.linalg.slogdet(covariance)[1] + 2.0 * np.sum(np.log(scales[1]))
        return cls(omega, drift, t, float(left))
