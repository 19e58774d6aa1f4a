"""Fourier coefficients of periodic and nearly periodic signals.

A signal s whose harmonics k of the fundamental ω are kept reads, with ψ = ωt,

    s(t) = s_0 + Σ_k (s_kc cos kψ + s_ks sin kψ)                          (Eq. 7)

Coefficients are ordered as in the paper's Eq. 9: ``0, 1c, 1s, 2c, 2s, …``.
The complex coefficients of the same signal, s = Σ_k S_k e^{jkψ}, are
S_0 = s_0 and S_{±k} = (s_kc ∓ j s_ks) / 2. The analyzer, its readings and all periodic models
need them.

Periodic systems seen once a period: lifted signals and the directions inputs take.

Sampled once a period, a linear time-periodic system is time-invariant, its inputs and
outputs being all the samples of the period (the lifted signals):

    z[k+1] = Φ z[k] + B w[k],    y_j[k] = O_j z[k] + D_j w[k]     (sample j of period k)

w holds an input's samples of a whole period. Mostly they move in few directions (a step at
a period's start in one, at any other phase in two), and only those have to be told apart.
The period-synchronous reading and match need them.
"""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy import linalg
from scipy.signal import get_window

from sklearn_hd.algorithms.linalg.rounding import HALF, PRECISION, UNKNOWN

TWO_PI = Fraction("6.283185307179586476925286766559005768394")  # to 40 digits
WINDOW_PERIODS = {"boxcar": 1, "triangle": 2, "hann": 2}
AT_ONCE = 1_000_000  # numbers worked on together, 8 MB: a cache
MOST_ROWS = 20_000  # of a longer record, that are looked at
ROWS_PER_COLUMN = 5  # of a regression, below which it is largely noise
LINE = 20.0  # times the power beside it, which a line has by chance once in a thousand


def harmonic_labels(harmonics):
    """Suffixes of the coefficients of some harmonics, in the paper's order.

    Examples
    --------
    >>> harmonic_labels([0, 1, 3])
    ['0', '1c', '1s', '3c', '3s']
    """
    return [
        label for k in harmonics for label in (("0",) if k == 0 else (f"{int(k)}c", f"{int(k)}s"))
    ]


def harmonic_functions(psi, harmonics):
    """Values of 1, cos kψ, sin kψ for the harmonics kept.

    They have shape (..., n_coefficients): one column for harmonic 0, two (cos, sin) for
    each other. ``psi`` (...,) is in radians.
    """
    psi = np.asarray(psi, dtype=float)
    columns = []
    for k in harmonics:
        columns += [np.ones_like(psi)] if k == 0 else [np.cos(k * psi), np.sin(k * psi)]
    return np.stack(columns, axis=-1) if columns else np.empty((*psi.shape, 0))


def times(regressors, functions):
    """Every regressor times every function, shape (n_samples, n_regressors * n_functions)."""
    return np.einsum("ti,tj->tij", regressors, functions).reshape(len(regressors), -1)


def seconds_from_zero_phase(time, omega):
    """Seconds to an instant from the nearest at which ψ = ωt is a whole number of turns.

    Exact, however far from zero the time is: the product ωt would be rounded by as much as
    the time is large (3e-5 rad in Unix seconds at 165 rad/s).

    Examples
    --------
    >>> seconds_from_zero_phase(0.25, 2 * np.pi)
    0.25
    >>> round(seconds_from_zero_phase(1.7e9 + 0.25, 2 * np.pi), 12)  # the float 2π is too small
    0.249999933731
    """
    turns = Fraction(float(time)) * Fraction(float(omega)) / TWO_PI
    whole = round(turns)
    return float(time) if whole == 0 else float((turns - whole) * TWO_PI) / float(omega)


def times_near_zero_phase(time, omega):
    """Increasing times that floats resolve poorly, as they count from the ψ = 0 nearest the first.

    Evenly spaced ones lie on a line, whole samples to the period where floats tell no other.
    Times of which floats resolve a billionth of a step are as they are.

    Examples
    --------
    >>> t = 1.7e9 + np.arange(5) / 100
    >>> np.diff(t).round(9).tolist()
    [0.00999999, 0.00999999, 0.00999999, 0.00999999]
    >>> np.diff(times_near_zero_phase(t, 2 * np.pi)).round(9).tolist()
    [0.01, 0.01, 0.01, 0.01]
    """
    since, rows, rounding = time - time[0], np.arange(len(time)), np.spacing(np.abs(time).max())
    step = since[-1] / max(rows[-1], 1)
    if len(time) < 2 or rounding <= PRECISION * step:  # floats tell times well enough
        return time
    near = seconds_from_zero_phase(time[0], omega)
    period = 2.0 * np.pi / omega
    whole = period / max(round(period / step), 1)
    if abs(whole - step) * rows[-1] <= rounding:
        step = whole
    return near + (step * rows if np.abs(since - step * rows).max() <= rounding else since)


def recompose(coefficients, psi, harmonics):
    """Signal of given, possibly time-varying, Fourier coefficients (Eq. 7).

    Coefficients (..., n_coefficients) are in the order of :func:`harmonic_labels`, and
    ``psi`` (...,) is in radians.
    """
    return np.sum(np.asarray(coefficients) * harmonic_functions(psi, harmonics), axis=-1)


def sampled_harmonics(values, n_harmonics):
    """Fourier coefficients of a periodic matrix given at equally spaced phases.

    ``values`` (n_phases, ...) begin at ψ = 0, and ``n_harmonics`` is below
    n_phases / 2. The coefficients are in the order 0, 1c, 1s, ….

    Examples
    --------
    >>> psi = 2 * np.pi * np.arange(8) / 8
    >>> (sampled_harmonics(3.0 - np.sin(psi), 1) + 0.0).round(12).tolist()
    [3.0, 0.0, -1.0]
    """
    spectrum = np.fft.rfft(values, axis=0) / len(values)
    coefficients = np.empty((2 * n_harmonics + 1, *values.shape[1:]))
    coefficients[0] = spectrum[0].real
    coefficients[1::2] = 2.0 * spectrum[1 : n_harmonics + 1].real
    coefficients[2::2] = -2.0 * spectrum[1 : n_harmonics + 1].imag
    return coefficients


def mean_square(coefficients):
    """Of periodic signals over a turn: c₀² + ½ Σ c_k², of real coefficients (2 N + 1, ...).

    Examples
    --------
    >>> mean_square(np.array([2.0, 3.0, 4.0])).item()  # 2 + 3 cos ψ + 4 sin ψ
    16.5
    """
    power = np.square(coefficients)
    return power[0] + 0.5 * np.sum(power[1:], axis=0)


def all_harmonics(values):
    """Fourier coefficients of the trigonometric polynomial through equally spaced samples.

    ``values`` (n_phases, ...) begin at ψ = 0. There are 2 N + 1 coefficients,
    N = n_phases // 2; of an even number of samples, that harmonic is a cosine.

    Examples
    --------
    >>> (all_harmonics(np.array([3.0, -1.0])) + 0.0).tolist()
    [1.0, 2.0, 0.0]
    """
    n_phases = len(values)
    coefficients = sampled_harmonics(values, n_phases // 2)
    if n_phases % 2 == 0:
        coefficients[-2:] *= 0.5 * np.array([1.0, 0.0]).reshape(2, *(1,) * (values.ndim - 1))
    return coefficients


def fitted_harmonics(parts, n_harmonics):
    """Fourier coefficients (2 N + 1, n_signals) of mean waveforms, by least squares over rows.

    ``parts`` are pairs of values (n_rows_s, n_signals) and any azimuths (n_rows_s,) in
    radians.

    Examples
    --------
    >>> psi = np.array([0.0, 0.3, 1.1, 2.4])
    >>> found = fitted_harmonics([(3.0 - np.sin(psi)[:, None], psi)], 1)
    >>> (found.ravel().round(9) + 0.0).tolist()
    [3.0, 0.0, -1.0]
    """
    gram, products = 0.0, 0.0
    for values, psi in parts:
        length = max(256, AT_ONCE // (2 * n_harmonics + 1))
        for start in range(0, len(psi), length):
            rows = slice(start, start + length)
            functions = harmonic_functions(psi[rows], range(n_harmonics + 1))
            gram = gram + functions.T @ functions
            products = products + functions.T @ values[rows]
    return linalg.lstsq(gram, products)[0]


def standing_lines(parts, n_harmonics):
    """Fourier coefficients of the harmonics whose lines stand out of the motion between them.

    The motion is read at odd multiples of half a turn's frequency: what repeats itself with the
    turn has no power there.

    ``parts`` are as :func:`fitted_harmonics` has them. Coefficients
    (2 n_harmonics + 1, n_signals) are zero where a line does not stand out; the mean is
    always kept.

    Examples
    --------
    >>> psi = np.arange(4000) * 0.7
    >>> motion = np.random.default_rng(0).standard_normal((4000, 1))
    >>> found = standing_lines([(motion + np.cos(2 * psi)[:, None], psi)], 4)
    >>> np.flatnonzero(found[1:]).tolist(), round(float(found[3, 0]), 1)
    ([2, 3], 1.0)
    """
    halves = fitted_harmonics([(values, 0.5 * psi) for values, psi in parts], 2 * n_harmonics)
    power = halves[1::2] ** 2 + halves[2::2] ** 2  # of 1/2, 1, 3/2, … per turn
    lines = np.zeros((2 * n_harmonics + 1, halves.shape[1]))
    lines[0] = halves[0]
    for k in range(1, n_harmonics + 1):
        beside = power[max(2 * k - 4, 0) : 2 * k + 3 : 2]
        stands = power[2 * k - 1] > LINE * np.mean(beside, axis=0)
        lines[2 * k - 1 : 2 * k + 1] = np.where(stands, halves[4 * k - 1 : 4 * k + 1], 0.0)
    return lines


def window_weights(window, samples_per_period):
    """Weights of an analysis window; they sum to one.

    Each window has zeros at every multiple of the fundamental frequency, so a
    periodic signal's coefficients come out exact: ``"boxcar"`` spans one
    period, ``"triangle"`` (a boxcar applied twice) and ``"hann"`` span two.

    The first weight is that of the oldest sample.
    """
    n = int(samples_per_period)
    shapes = {"boxcar": ("boxcar", n), "triangle": ("triang", 2 * n - 1), "hann": ("hann", 2 * n)}
    weights = get_window(*shapes[window], fftbins=window == "hann")
    return weights / weights.sum()


def windowed_coefficients(signal, psi, harmonics, weights, rows):
    """Fourier coefficients seen through a window that ends at each of some rows.

    For harmonic k: ŝ_kc(n) = 2 Σ_i h_i s(n−i) cos kψ(n−i), and likewise with
    sin; the factor is 1 for k = 0, and for half the samples in a period, whose
    cosine and sine are one signal (or the sine vanishes).

    ``psi`` is in radians. The first of ``weights`` is that of the oldest sample. Each
    of ``rows`` is the last sample in its window, and at least ``n_window - 1``.
    """
    rows = np.asarray(rows, dtype=int)
    functions = harmonic_functions(psi, harmonics)
    n_window = len(weights)
    gains = _gains(functions[:n_window], harmonics, weights)
    products = functions * (gains * np.asarray(signal, dtype=float)[:, None])
    windows = np.lib.stride_tricks.sliding_window_view(products, n_window, axis=0)
    result = np.empty((len(rows), len(gains)))
    block = max(1, 250_000 // max(1, n_window * len(gains)))  # numbers: 2 MB
    for start in range(0, len(rows), block):
        some = rows[start : start + block] - n_window + 1
        result[start : start + block] = windows[some] @ weights
    return result


def _gains(functions, harmonics, weights):
    """By what the mean products with some functions give their coefficients."""
    power = weights @ functions**2  # 1 or 1/2; cos² and sin² of one phase at the Nyquist harmonic
    seen = power > PRECISION
    gains = np.where(seen, 1.0 / np.maximum(power, PRECISION), 0.0)
    column = 0
    for k in harmonics:
        pair = slice(column, column + (1 if k == 0 else 2))
        if k > 0:
            both = weights @ np.prod(functions[:, pair], axis=1)
            if np.prod(power[pair]) - both**2 <= PRECISION:
                gains[pair] = seen[pair]
        column = pair.stop
    return gains


def lift(values, phase, samples_per_period):
    """Whole periods of a segment, one a row.

    ``phase`` (n_samples,) has the sample within the period of each row; they are
    consecutive. It returns (n_periods, samples_per_period, n_signals) from the first
    ψ = 0 on.

    Examples
    --------
    >>> lift(np.arange(6.0)[:, None], np.array([1, 0, 1, 0, 1, 0]), 2)[:, :, 0].tolist()
    [[1.0, 2.0], [3.0, 4.0]]
    """
    spp = samples_per_period
    first = int(-phase[0] % spp) if len(phase) else 0
    n_periods = max(0, len(values) - first) // spp
    return values[first : first + n_periods * spp].reshape(n_periods, spp, values.shape[1])


def input_directions(lifted, most=None):
    """Inputs of each period in the fewest directions, the strongest first.

    Each input counts in parts of its root mean square. Directions no stronger than white
    noise on the inputs would give are left out, where the weaker half of all looks like
    such noise and it holds but little energy.

    Each segment has an array (n_periods_s, samples_per_period, m). It returns three
    things: ``most`` directions or fewer, (n_periods_s, r), uncorrelated and of mean
    square one over all periods; the number of directions that the inputs move in,
    except for noise; and the share of the inputs' energy in directions not kept.

    Examples
    --------
    A step at a period's start moves in one direction, one in mid-period in another, too:

    >>> u = np.repeat([0.0, 1.0], [5, 7])[:, None]
    >>> input_directions([lift(u, np.arange(12) % 4, 4)])[1]
    2
    """
    stacked = np.concatenate(lifted)
    if not stacked.any():
        return [np.zeros((len(block), 0)) for block in lifted], 0, 0.0
    _, flat = _in_parts_of_size(stacked)
    U, s, _ = linalg.svd(flat, full_matrices=False)
    n_all = int(np.sum(s > max(1e-10 * s[0], _noise_level(s, flat.shape))))
    kept = n_all if most is None else min(n_all, most)
    W = U[:, :kept] * np.sqrt(len(flat))
    edges = np.cumsum([len(block) for block in lifted])[:-1]
    return np.split(W, edges), n_all, float(np.sum(s[kept:] ** 2) / np.sum(s**2))


@dataclass(frozen=True, eq=False)
class InputDirections:
    """What inputs moved in: combinations of their samples within a row."""

    middle: np.ndarray  # (m,): constant of each input that is no motion
    size: np.ndarray  # (m,): root mean square about it; one where that is zero
    moved: np.ndarray  # (n_phases m, r): orthonormal, of inputs in parts of their size

    @classmethod
    def of(cls, lifted, left_out=0.0, about_mean=False):
        """Of rows of one sample or more, the strongest.

        ``lifted`` has arrays (n_rows_s, n_phases, m). A share ``left_out`` of the
        energy, noise say, may lie in directions left out. What is but rounding is left
        out in any case. With ``about_mean`` the mean of an input is no motion: where
        loads take what it does.
        """
        stacked = np.concatenate(lifted)
        middle = np.zeros(stacked.shape[2])
        if about_mean:
            middle = np.mean(stacked, axis=(0, 1))
            stacked = stacked - middle
        size, flat = _in_parts_of_size(stacked)
        R = linalg.qr(flat, mode="r")[0][: flat.shape[1]]
        _, s, Vt = linalg.svd(R, full_matrices=False)
        beyond = np.cumsum(s[::-1] ** 2)[::-1]  # in this direction and weaker ones
        return cls(middle, size, Vt[(s > HALF * s[0]) & (beyond > left_out * beyond[0])].T)

    def outside(self, lifted):
        """Share of the energy of some inputs that moves otherwise, and each input's part of it.

        Inputs are lifted: a list of shapes (n_rows_s, n_phases, m).

        Examples
        --------
        >>> row = np.array([[[0.0], [0.0], [1.0], [1.0]]])
        >>> InputDirections.of([np.ones((1, 4, 1))]).outside([row])[0]
        0.5
        """
        stacked = (np.concatenate(lifted) - self.middle) / self.size
        flat = stacked.reshape(len(stacked), -1)
        rest = flat - (flat @ self.moved) @ self.moved.T
        each = np.sum(rest.reshape(stacked.shape) ** 2, axis=(0, 1))
        energy = np.sum(flat**2)
        return float(np.sum(each) / energy) if energy > 0.0 else 0.0, each

    @property
    def together(self):
        """Inputs of which some combination never moved, places in ascending order."""
        idle = np.eye(len(self.moved)) - self.moved @ self.moved.T
        part = np.sqrt(np.maximum(np.diag(idle), 0.0)).reshape(-1, len(self.size))
        return np.flatnonzero(part.max(axis=0) > UNKNOWN)


def _in_parts_of_size(stacked):
    """Root mean square of each input, one where it is zero; and rows of inputs in parts of it."""
    largest = np.max(np.abs(stacked), axis=(0, 1), initial=0.0)
    largest = np.where(largest > 0.0, largest, 1.0)
    size = largest * np.sqrt(np.mean((stacked / largest) ** 2, axis=(0, 1)))
    size = np.where(size > 0.0, size, 1.0)
    return size, (stacked / size).reshape(len(stacked), -1)


def _noise_level(singular_values, shape):
    """Largest singular value of white noise whose smaller half these are; 0 if it is signal."""
    if len(singular_values) < 8:  # too few to see a level of noise from
        return 0.0
    weaker = singular_values[len(singular_values) // 2 :]
    sigma = np.sqrt(np.mean(weaker**2) / max(shape))
    level = 1.5 * sigma * (np.sqrt(shape[0]) + np.sqrt(shape[1]))
    below = np.sum(singular_values[singular_values <= level] ** 2)
    return level if below < 0.1 * np.sum(singular_values**2) else 0.0
