"""The fundamental frequency that a record shows by itself.

Wherever its input has been constant for some periods, the response of a linear
time-periodic system is a periodic waveform in proportion to the input, one for
the trim, and a free decay whose modes e^{λt} p(ψ) repeat themselves from period
to period times e^{λT}, whatever p(ψ) is. So with delays of whole periods

    y(t) = Σ_{i=1…n} α_i y(t − i m T) + w_0(ψ) + Σ_j w_j(ψ) u_j,   ψ = ωt, T = 2π/ω,

the α_i common to all outputs and times, holds for the true ω and no other (a
linear time-invariant system apart, to which any ω is true). The ω at which it
leaves least unexplained is the estimate (variable projection, Golub and Pereyra
1973: α and the waveforms are linear). Signals between the samples come from
splines. Users estimate ω with it, and fits warn of another ω by it.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.interpolate import make_interp_spline
from scipy.ndimage import convolve1d, maximum_filter1d, minimum_filter1d
from scipy.optimize import minimize_scalar

from sklearn_hd._checks import check_numbers

DELAYS = 2  # slow modes; more would fit the harmonics of one mode at any ω
STRIDES = (2, 1)  # periods to a delay: the longer, the sharper, if the input rests so long
SPAN = 0.035  # relative, searched to either side
MISMATCH = 5e-4  # relative; the estimate from 60 periods at SNR 20 scatters by 1.5e-4


class FundamentalEstimate(NamedTuple):
    """What a record says of its fundamental frequency.

    Made by :func:`estimate_omega`; each parameter is an attribute.

    Parameters
    ----------
    omega : float
        Estimate, rad/s.
    residual, residual_given : float
        Share of the outputs' variance unexplained at the estimate, and at the
        frequency given.
    n_values : int
        Samples of all outputs that were used.

    References
    ----------
    Golub, Pereyra (1973), The differentiation of pseudo-inverses and nonlinear least
    squares problems whose variables separate, SIAM J. Numerical Analysis 10(2), 413-432.

    Examples
    --------
    >>> estimate = FundamentalEstimate(165.2, 0.01, 0.2, 4000)
    >>> estimate.residual < estimate.residual_given
    True
    """

    omega: float
    residual: float
    residual_given: float
    n_values: int


def estimate_omega(inputs, outputs, sample_time, omega, span=SPAN, starts=None):
    """Fundamental frequency at which records repeat themselves, near a given one.

    Parameters
    ----------
    inputs : list of ndarray, shapes (n_samples_s, n_inputs)
        One array a segment, evenly sampled.
    outputs : list of ndarray, shapes (n_samples_s, n_outputs)
        As measured, or trim subtracted.
    sample_time : float
        Seconds.
    omega : float
        Where to search, rad/s.
    span : float
        Relative, to either side.
    starts : array_like, shape (n_segments,), optional
        Time of the first sample of each segment, seconds: the waveforms that repeat
        themselves go on over gaps. All zero where not given.

    Returns
    -------
    estimate : FundamentalEstimate
        Where least is left unexplained.

    Raises
    ------
    ValueError
        If a number is not positive, the inputs nowhere rest for some periods, or
        there is no minimum within the span.

    References
    ----------
    Golub, Pereyra (1973), The differentiation of pseudo-inverses and nonlinear least
    squares problems whose variables separate, SIAM J. Numerical Analysis 10(2), 413-432.

    Examples
    --------
    >>> t = np.arange(2000) / 32
    >>> y = np.exp(-0.05 * t) * (1 + 0.5 * np.cos(2 * np.pi * t))
    >>> estimate = estimate_omega([np.zeros((2000, 1))], [y[:, None]], 1 / 32, 6.2)
    >>> bool(abs(estimate.omega / (2 * np.pi) - 1) < 1e-6)
    True
    """
    hint = "seconds from row to row, rad/s, and a share of omega"
    check_numbers("positive", hint, sample_time=sample_time, omega=omega, span=span)
    repetition = _Repetition.of(inputs, outputs, sample_time, omega, starts)
    if repetition is None:
        raise ValueError(
            f"the inputs rest nowhere for the {1 + DELAYS} periods of omega={omega:.6g} rad/s that "
            f"are needed to see the record repeat itself; give a longer free decay, or a record in "
            f"trim"
        )
    found, residual = repetition.minimum(omega, span)
    if found is None:
        raise ValueError(
            f"no fundamental frequency stands out within {100 * span:.2g} % of omega={omega:.6g} "
            f"rad/s: widen the span, or the record is not periodic at all"
        )
    return FundamentalEstimate(found, residual, repetition.unexplained(omega), repetition.n_values)


def omega_mismatch(inputs, outputs, sample_time, omega, span=SPAN, starts=None):
    """The estimate, if the record says clearly that the frequency given is another's.

    At the right frequency three residuals tell, and the rest is spared. To be
    clear an estimate must lie 5e-4 off (0.02 periods over a record), leave a
    tenth less unexplained, more than chance, and do so with one delay more, too,
    so that an oscillation of the system's own is not taken for the fundamental.
    (Several lightly damped ones of a system that is not periodic at all were, in
    7 of 150 random systems.)

    Parameters
    ----------
    inputs, outputs, sample_time, omega, span, starts
        As in :func:`estimate_omega`.

    Returns
    -------
    estimate : FundamentalEstimate or None
        None where there is no mismatch, or nothing to tell it from.
    """
    repetition = _Repetition.of(inputs, outputs, sample_time, omega, starts)
    if repetition is None or repetition.at_home(omega):
        return None
    found, residual = repetition.minimum(omega, span)
    if found is None:
        return None
    off = abs(found / omega - 1.0)
    longest = max(len(u) for u in inputs) * sample_time * omega / (2.0 * np.pi)
    if off < MISMATCH or off * longest < 0.02:
        return None
    given = repetition.unexplained(omega)
    ratios = [(given, residual)]
    richer = _Repetition.of(inputs, outputs, sample_time, omega, starts, DELAYS + 1)
    if richer is not None:
        ratios.append([richer.unexplained(w) for w in (omega, found)])
    # 0.3 % off at SNR 20 gives a ratio of 1.4, and 1800 for the other; splines err by 1e-10
    least = max(np.log(1.1), 150.0 / repetition.n_values)
    if any(a - b < 1e-9 or np.log(a / max(b, 1e-300)) < least for a, b in ratios):
        return None
    return FundamentalEstimate(found, residual, given, repetition.n_values)


class _Repetition:
    """How well outputs are explained by their own past, whole periods ago."""

    def __init__(self, inputs, outputs, sample_time, starts, rows, delays, n_harmonics, half):
        self.inputs = [u[r] for u, r in zip(inputs, rows, strict=True)]
        self.times = [r * sample_time for r in rows]
        outputs = [_smooth(y, half) for y in outputs]
        stacked = np.vstack(outputs)
        largest = np.max(np.abs(stacked), axis=0)
        largest[largest == 0.0] = 1.0  # squares of very large or small units leave the range
        scale = np.std(stacked / largest, axis=0) * largest
        scale = np.where(scale > 0.0, scale, 1.0)
        self.outputs = np.vstack([y[r] for y, r in zip(outputs, rows, strict=True)]) / scale
        self.splines = [
            make_interp_spline(np.arange(len(y)) * sample_time, y / scale, k=5)
            for y, r in zip(outputs, rows, strict=True)
            if len(r)
        ]
        self.clock = np.concatenate([t + t0 for t, t0 in zip(self.times, starts, strict=True)])
        self.times, self.inputs = (
            [one for one in some if len(one)] for some in (self.times, self.inputs)
        )
        self.delays, self.n_harmonics = delays, n_harmonics
        self.n_values = self.outputs.size

    @classmethod
    def of(cls, inputs, outputs, sample_time, omega, starts=None, n_delays=DELAYS):
        """With the longest stride for which the inputs rest long enough; None if there is none."""
        period = 2.0 * np.pi / omega / sample_time
        n_harmonics = max(0, min(6, int(0.45 * period)))
        half = round(period / 12)  # outputs are smoothed over a sixth of a period
        unknown = (2 * n_harmonics + 1) * (1 + inputs[0].shape[1])
        for stride in STRIDES:
            rows = _rows_at_rest(inputs, period, stride * n_delays, half)
            found = sum(len(r) for r in rows)
            if found >= 5 * unknown and found >= (DELAYS + 1) * period:
                thin = -(-found // 4000)
                rows = [r[::thin] for r in rows]
                delays = stride * np.arange(1, n_delays + 1)
                starts = np.zeros(len(rows)) if starts is None else starts
                return cls(inputs, outputs, sample_time, starts, rows, delays, n_harmonics, half)
        return None

    def unexplained(self, omega):
        """Share of the outputs' variance that repetition leaves."""
        delays = 2.0 * np.pi / omega * self.delays
        past = np.concatenate(
            [
                np.stack([spline(t - delay) for delay in delays], axis=-1)
                for spline, t in zip(self.splines, self.times, strict=True)
            ]
        )
        Q = linalg.qr(self._waveforms(omega), mode="economic", check_finite=False)[0]
        y = self.outputs - Q @ (Q.T @ self.outputs)
        past = past.reshape(len(past), -1)
        past = (past - Q @ (Q.T @ past)).reshape(-1, len(delays))
        alpha = linalg.lstsq(past, y.reshape(-1), cond=1e-12)[0]
        return float(np.mean((y.reshape(-1) - past @ alpha) ** 2))

    def _waveforms(self, omega):
        """Harmonic functions, alone and times each input, column by column."""
        t, u = self.clock, np.vstack(self.inputs)
        turns = np.exp(1j * omega * t[:, None] * np.arange(self.n_harmonics + 1))
        waves = np.hstack([turns.real, turns.imag[:, 1:]])
        size = np.max(np.abs(u), axis=0)
        return np.hstack([waves, *(waves * u[:, [j]] / size[j] for j in np.flatnonzero(size))])

    def at_home(self, omega):
        """Whether a first look shows the least residual at the frequency given."""
        low, here, high = (self.unexplained(omega * (1.0 + d)) for d in (-3e-3, 0.0, 3e-3))
        if not here < min(low, high):
            return False
        vertex = 1.5e-3 * (low - high) / (low - 2.0 * here + high)
        return abs(vertex) < MISMATCH

    def minimum(self, omega, span):
        """Frequency of least residual within the span, and that residual; None at its edge."""
        grid = omega * (1.0 + np.linspace(-span, span, 15))
        values = [self.unexplained(w) for w in grid]
        least = int(np.argmin(values))
        if least in (0, len(grid) - 1):
            return None, values[least]
        result = minimize_scalar(
            self.unexplained,
            bounds=(grid[least - 1], grid[least + 1]),
            method="bounded",
            options={"xatol": 1e-10 * omega},
        )
        given = self.unexplained(omega)  # exact only where delays fall on samples
        if abs(result.x / omega - 1.0) < MISMATCH and given < result.fun:
            return omega, given
        return float(result.x), float(result.fun)


def _smooth(y, half):
    """Outputs through a Hann window of 2 half + 1 samples.

    What repeats itself still does. White noise would be the smaller for a delay
    between samples than for a whole number of them: a spline averages it.
    """
    window = np.hanning(2 * half + 3)[1:-1]
    return convolve1d(y, window / window.sum(), axis=0, mode="nearest")


def _rows_at_rest(inputs, period, n_periods, half=0):
    """Rows about which all inputs are constant: some periods before, and half a smoothing window.

    One array a segment.
    """
    past = int(np.ceil(n_periods * period * (1.0 + SPAN))) + 2 + half
    span = np.ptp(np.vstack(inputs), axis=0)
    steps = np.abs(np.vstack([np.diff(u, axis=0) for u in inputs]))
    noise = np.median(steps, axis=0) if len(steps) else 0.0
    limit = np.clip(8.0 * noise, 1e-3 * span, 0.2 * span)  # noise spans 8 median steps
    rows, size = [], past + half + 1
    for u in inputs:
        if len(u) < size:
            rows.append(np.zeros(0, dtype=int))
            continue
        windows = {"size": size, "axis": 0, "mode": "nearest"}
        ptp = maximum_filter1d(u, **windows) - minimum_filter1d(u, **windows)
        centre = np.arange(past, len(u) - half) - past + size // 2
        rows.append(np.flatnonzero(np.all(ptp[centre] <= limit, axis=1)) + past)
    return rows
