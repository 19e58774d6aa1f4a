"""The fundamental frequency that a record shows by itself.

Write the periods of a record one below the other. Whatever the amplitudes are from
period to period, the response of a linear time-periodic system is then a matrix of low
rank: one row pattern for the trim, one for each mode e^{λt} p(ψ) that lasts longer than a
period, and what the inputs add,

    Y = X Vᵀ + U Gᵀ + noise,   row i about the time at which ψ = 2πi,

at the true ω and at no other, where the patterns shift from row to row (a linear
time-invariant system apart, to which any ω is true). Inputs that always move by a clock of
their own leave few patterns at that clock, too. The ω at which least is left of Y
beside a few patterns is the estimate: the singular value method for periods of varying
amplitude (Kanjilal and Palit 1995), as a least squares problem whose linear part is
eliminated (Golub and Pereyra 1973) and with inputs. Schwarz's criterion chooses the
rank. A row holds Fourier coefficients through a Hann window of two periods, whose place is
no multiple of a sample, so that sums of harmonics are exact at any sampling.

Users estimate ω with it, and fits warn of another ω by it.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.ndimage import convolve1d, median_filter
from scipy.optimize import minimize_scalar
from scipy.signal import detrend, periodogram

from sklearn_hd._checks import check_fraction, check_numbers
from sklearn_hd.algorithms.linalg.rounding import TINY

HARMONICS = 6
SPAN = 0.035  # relative, searched to either side
FEWEST = 8  # periods of a record
LARGEST = 100_000  # samples in all windows; beyond, rows are left out evenly
FLOOR = 1e-4  # noise in parts of an output's motion, below which no record is taken to be
BEYOND = 5.0  # standard deviations at which a value is another
CLEAR = 2.0  # times the mean square that is left; noise alone may leave 1.8 times
SLIGHT = 1.2  # times: what a first-order gain is held against, which CLEAR asks to be real
RANKS = 7  # at most, that a first-order gain is sought at
ASTRAY = 1e-3  # turns
STEP = 1e-3  # of a unit, by which slopes are found
BESIDE = 4.0  # turns of the last harmonic over the record, by which another frequency is off
SHARED = 4 / 3  # variance of sums over windows, each of which has a sixth in common with the next
NOISE = (
    2.0 * SHARED**2
)  # times n + d: above (√n + √d)², the largest singular value of noise, squared


class OmegaEstimate(NamedTuple):
    """Frequency at which records repeat themselves, as :func:`estimate_omega` returns it.

    Parameters
    ----------
    omega : float
        Frequency, rad/s; halfway through the records where it drifts.
    std : float
        Standard deviation of ``omega``, rad/s; too small if the outputs rest in most of a record.
    drift : float
        Change from the first sample to the last, rad/s; zero where the records show none.
    drift_std : float
        Standard deviation of that change, rad/s.
    rivals : tuple of float
        Fractions of ``omega`` that explain the records better, and multiples of it that the
        records do not exclude, rad/s.
    residual, residual_given : float
        Variance that is left at the estimate and at the frequency searched about, of all rows
        together.
    turns : float
        By how many turns the phase of the frequency searched about goes astray over the longest
        segment.
    of_inputs : bool
        Whether inputs that always move repeat themselves at it, and the outputs have no motion of
        it beside them: it may be the clock of the inputs.

    References
    ----------
    Kanjilal, Palit (1995), On multiple pattern extraction using singular value
    decomposition, IEEE Trans. Signal Processing 43(6), 1536-1540.

    Examples
    --------
    >>> estimate = OmegaEstimate(165.2, 0.01, 0.0, 0.02, (), 0.01, 0.2, 0.1)
    >>> estimate.residual < estimate.residual_given
    True
    """

    omega: float
    std: float
    drift: float
    drift_std: float
    rivals: tuple
    residual: float
    residual_given: float
    turns: float
    of_inputs: bool = False


def estimate_omega(inputs, outputs, sample_time, omega=None, span=SPAN, starts=None):
    """Fundamental frequency at which records repeat themselves, with its standard deviation.

    Each segment has an array of inputs and one of outputs, as measured or with the trim
    subtracted, evenly sampled. The search is about ``omega`` (rad/s), as far as
    ``span``, a share of it, to either side. By default, it is about the comb of lines
    that stands out most in the spectrum of the outputs. ``starts`` are times in seconds
    of the first sample of each segment, as patterns go on over gaps; all are zero by
    default. The estimate is where least is left unexplained.
    """
    check_numbers("positive", "seconds from row to row", sample_time=sample_time)
    check_fraction("span", span, "how far to search to either side, as a share of the guess")
    if omega is not None:
        hint = "rad/s, about where to search; None asks the spectrum"
        check_numbers("positive", hint, guess=omega)
    longest = max(map(len, outputs))
    if omega is None and longest < 2 * FEWEST:
        raise ValueError(
            f"the longest of {len(outputs)} segments holds {longest} rows, and {FEWEST} periods "
            f"take {2 * FEWEST} rows at least; give a guess, or fill lost rows"
        )
    if omega is None:
        omega = comb_in_spectrum(outputs, sample_time)
    periods = _Periods(inputs, outputs, sample_time, omega, starts)
    ends = periods.search(span) if periods.moves else None
    if ends is None:
        raise ValueError(
            f"the records hold {periods.n_turns:.3g} periods of omega={omega:.6g} rad/s in "
            f"segments of three or more, with {inputs[0].shape[1]} inputs, and the outputs move in "
            f"{100 * periods.moves:.0f} % of them. That is too few to find a repetition: {FEWEST} "
            f"are needed, and more if the inputs move more; give longer records, or another guess"
        )
    estimate = periods.estimate(*ends)
    if not periods.tells(estimate, span):
        raise ValueError(
            f"no fundamental frequency stands out within {100 * span:.2g} % of omega={omega:.6g} "
            f"rad/s; widen the span, or check that the record is periodic"
        )
    return estimate


def omega_mismatch(inputs, outputs, sample_time, omega, starts=None):
    """The estimate, if the record says clearly that the frequency given is another's.

    To be clear, the estimate has to be five standard deviations away (or drift by as many),
    half of it has to be left unexplained, and the phase has to go astray by a thousandth of a
    turn. A fraction that explains the record better is no mismatch: slow motion may look like it.

    Arguments are as in :func:`estimate_omega`. It is None where there is no mismatch,
    or nothing to tell it from.
    """
    periods = _Periods(inputs, outputs, sample_time, omega, starts)
    if not periods.moves:
        return None
    home = periods.at_home()
    if home and not periods.may_gain():
        return None
    ends = periods.beside() if home else periods.search(SPAN)
    if ends is None:
        return None
    found = periods.estimate(*ends)
    off = abs(found.omega - omega) > BEYOND * found.std or found.drift != 0.0
    clear = found.residual_given > CLEAR * found.residual and found.turns > ASTRAY
    return found if periods.tells(found, SPAN) and off and clear else None


def comb_in_spectrum(outputs, sample_time):
    """Frequency, rad/s, whose harmonics stand out most in the spectrum of the outputs.

    The harmonic product spectrum (Schroeder 1968, J. Acoust. Soc. Am. 43(4), 829-834) above
    what is spread about the lines; later harmonics count less, so that a single line is
    not taken for the second harmonic of another.
    """
    longest = max(map(len, outputs))
    n = 1 << int(np.ceil(np.log2(8 * longest)))
    power = 0.0
    for y in outputs:
        lines = periodogram(detrend(y, axis=0), window="hann", nfft=n, axis=0)[1]
        size = np.var(y, axis=0)
        power = power + lines / np.where(size > 0.0, size, 1.0)
    width = 8 * n // longest
    around = np.stack([median_filter(p, 8 * width + 1) for p in power.T], axis=1)
    heights = np.sum(np.log1p(power / np.maximum(around, max(1e-12 * power.max(), TINY))), axis=1)
    first = np.arange(FEWEST * n // longest, len(heights))
    total = np.zeros(len(first))
    for k in range(1, HARMONICS + 1):
        there = k * first < len(heights)
        total[there] += heights[k * first[there]] * 0.9 ** (k - 1)
    return 2.0 * np.pi * first[np.argmax(total)] / (n * sample_time)


def _unit(blocks):
    """Signals about their means, in parts of their largest motion."""
    mean = np.mean(np.vstack(blocks), axis=0)
    size = np.max(np.abs(np.vstack(blocks) - mean), axis=0)
    size = np.where(size > 1e-13 * np.abs(mean), size, np.inf)  # what stands still is zero
    return [(z - mean) / size for z in blocks]


def _beyond(X, rank):
    """What some patterns leave of rows."""
    U, s, V = linalg.svd(X, full_matrices=False, check_finite=False)
    return X - (U[:, :rank] * s[:rank]) @ V[:rank]


class _Fit(NamedTuple):
    """A frequency, its slope in time, and what is left of the periods beside some patterns."""

    omega: float
    slope: float
    score: float
    rank: int
    left: float


class _Periods:
    """The periods of records, one below the other, as a function of frequency and slope."""

    def __init__(self, inputs, outputs, sample_time, omega, starts=None):
        self.omega, self.n_outputs = omega, outputs[0].shape[1]
        self.given, self.starts_given = (inputs, outputs, sample_time), (starts,)
        block = int(2.0 * np.pi / (omega * sample_time * 4 * HARMONICS))
        block = int(np.clip(block, 1, max(map(len, outputs))))
        signals = [_unit(outputs), _unit(inputs)]
        signals = [np.hstack([y, u]) for y, u in zip(*signals, strict=True)]
        self.signals = [
            z[: len(z) // block * block].reshape(-1, block, z.shape[1]).mean(axis=1)
            for z in signals
        ]
        starts = np.zeros(len(outputs)) if starts is None else np.asarray(starts, float)
        self.step = block * sample_time
        self.starts = starts - starts[0] + 0.5 * (block - 1) * sample_time
        ends = self.starts + self.step * (np.array([len(z) for z in self.signals]) - 1)
        self.longest = np.max(ends - self.starts) * omega / (2.0 * np.pi)
        self.middle = 0.5 * (self.starts.min() + ends.max())
        self.length = ends.max() - self.starts.min()
        self.n_harmonics = min(HARMONICS, int(0.9 * np.pi / (omega * self.step)))
        self.stride = -(-2 * sum(map(len, self.signals)) // LARGEST)
        self.stride += {2: 3, 3: 2, 4: 1, 0: 1}.get(self.stride % 6, 0)  # meets every other turn
        self.n_turns = sum(len(i) for i in self.turns(omega)) * self.stride
        self.weights = self.reciprocal_noise()
        self.floor = FLOOR**2 * np.mean(self.weights**2)
        enough = self.n_harmonics > 0 and self.n_turns >= FEWEST
        self.here = self.fit(omega) if enough else _Fit(omega, 0.0, np.inf, 0, np.inf)
        self.moves = self.here.rank > 0

    def reciprocal_noise(self):
        """Of each output: sixth differences are those of noise, as harmonics are smooth."""
        outputs = [z[:, : self.n_outputs] for z in self.signals]
        rest = np.concatenate([np.diff(y, 6, axis=0) for y in outputs])
        power = np.sum(rest**2, axis=0) / max(len(rest), 1)
        return 1.0 / np.sqrt(np.maximum(power / math.comb(12, 6), FLOOR**2))

    def turns(self, omega, slope=0.0):
        """Numbers of the turns whose windows a segment holds, one array a segment."""
        found = []
        for start, z in zip(self.starts, self.signals, strict=True):
            t = np.array([start, start + self.step * (len(z) - 1)]) - self.middle
            first, last = (omega + 0.5 * slope * t) * t / (2.0 * np.pi)
            found.append(np.arange(np.ceil(first + 1.02), np.floor(last - 1.02) + 1, self.stride))
        return found

    def windows(self, omega, slope, turns):
        """Rows of samples, local phases and weights of each window; one triple a segment."""
        for start, z, numbers in zip(self.starts, self.signals, turns, strict=True):
            psi = 2.0 * np.pi * numbers[:, None]
            t = self.middle + 2.0 * psi / (omega + np.sqrt(omega**2 + 2.0 * slope * psi))
            speed = omega + slope * (t - self.middle)
            first = np.ceil((t - 2.0 * np.pi / speed - start) / self.step - 1e-9).astype(int)
            n = int(4.0 * np.pi / (np.min(speed, initial=np.inf) * self.step)) + 2
            rows = first + np.arange(n)
            tau = start + rows * self.step - t
            phase = (speed + 0.5 * slope * tau) * tau
            inside = (np.abs(phase) < 2.0 * np.pi) & (rows >= 0) & (rows < len(z))
            yield np.clip(rows, 0, len(z) - 1), phase, inside * np.cos(phase / 4.0) ** 2

    def coefficients(self, signals, omega, slope, turns):
        """Fourier coefficients of all windows, all of one size in white noise."""
        n, found = self.n_harmonics, []
        k = np.arange(-n, n + 1)
        for z, (rows, phase, weight) in zip(
            signals, self.windows(omega, slope, turns), strict=True
        ):
            if not len(rows):
                continue
            step, wave, values = np.exp(-1j * phase), weight.astype(complex), z[rows]
            gram, products = [], []
            for j in range(2 * n + 1):
                gram.append(wave.sum(axis=1))
                if j <= n:
                    products.append(np.matmul(wave[:, None, :], values)[:, 0])
                wave = wave * step
            gram, products = (
                np.concatenate([np.conj(a[:, :0:-1]), a], axis=1)
                for a in (np.stack(gram, axis=1), np.stack(products, axis=1))
            )
            a = np.linalg.solve(gram[:, k[:, None] - k + 2 * n], products)
            total = gram[:, 2 * n].real[:, None]
            found.append(a[:, n:] * np.sqrt(total / 1.5)[:, :, None])
        a = np.concatenate(found)
        return np.concatenate(
            [a[:, :1].real, 2**0.5 * a[:, 1:].real, 2**0.5 * a[:, 1:].imag], axis=1
        )

    def rows(self, omega, slope=0.0, turns=None):
        """Rows of the outputs, also without what inputs explain, and how many that leaves."""
        turns = self.turns(omega, slope) if turns is None else turns
        return self.beside_inputs(self.coefficients(self.signals, omega, slope, turns))

    def beside_inputs(self, a):
        """What :meth:`rows` gives, of coefficients.

        Inputs explain by ridge regression, at the noise's size: smooth in omega where an
        input begins to move at the edge of a window.
        """
        Y = (a[:, :, : self.n_outputs] * self.weights).reshape(len(a), -1)
        U = a[:, :, self.n_outputs :]
        kept = int(max(0, len(a) / (3 * max(1, U.shape[2])) - 1) / 2)  # a third of the rows
        kept = np.minimum(np.r_[0, 1 : self.n_harmonics + 1, 1 : self.n_harmonics + 1], 99) <= kept
        U = U[:, kept].reshape(len(a), -1)
        U = U - U.mean(axis=0)
        if not U.any():
            return Y, Y, len(Y)
        Q, s, _ = linalg.svd(U, full_matrices=False, check_finite=False)
        ridge = np.sum(s**2) / max(np.sum(Y**2), 1e-300)
        share = s**2 / (s**2 + ridge)
        return Y, Y - (Q * share) @ (Q.T @ Y), len(Y) - share.sum()

    def scores(self, X, n):
        """A criterion like Schwarz's for 0, 1, … patterns, and the variances that they leave.

        Of blocks with patterns of their own, too.
        """
        d = X.shape[-1]
        tails = 0.0
        for part in X if X.ndim == 3 else [X]:
            s = linalg.svdvals(part, check_finite=False) ** 2
            tails = tails + np.append(np.cumsum(s[::-1])[::-1], 0.0)
        n_parts = len(X) if X.ndim == 3 else 1
        r = np.arange(len(tails))
        spent, values = r * (n + n_parts * (d - r)), n * d
        usable = (r > 0) & (spent < 0.7 * values)
        spent = np.where(usable, spent, 0)
        scores = np.log(tails / values + self.floor) + NOISE * spent / values
        return np.where(usable, scores, np.inf), tails / (values - spent)

    def fit(self, omega, slope=0.0, rank=None):
        """How well a frequency explains the records, with the rank of least score, or a given."""
        Y, X, n = self.rows(omega, slope)
        size = np.sum(Y**2)
        if size == 0.0 or n < FEWEST / 2:
            return _Fit(omega, slope, np.inf, 0, np.inf)
        scores, left = self.scores(X, n)
        rank = int(np.argmin(scores)) if rank is None else min(rank, len(scores) - 1)
        if not np.isfinite(scores[rank]):
            rank = 0
        return _Fit(omega, slope, scores[rank], rank, left[rank])

    def residual(self, a, rank):
        """What some patterns leave of rows of coefficients, and how many rows count."""
        _, X, n = self.beside_inputs(a)
        return _beyond(X, rank), n

    def explained(self, fit, turns, a):
        """The records as the fit explains them, put together from coefficients of the windows."""
        Y, X, _ = self.beside_inputs(a)
        left = _beyond(X, fit.rank)
        n = self.n_harmonics
        a = (Y - left).reshape(len(Y), 2 * n + 1, -1) / self.weights
        told, done = [], 0
        for z, (rows, phase, weight) in zip(
            self.signals, self.windows(fit.omega, fit.slope, turns), strict=True
        ):
            here = a[done : done + len(rows)]
            done += len(rows)
            waves = phase[:, :, None] * np.arange(1, n + 1)
            waves = 2**0.5 * np.concatenate([np.cos(waves), -np.sin(waves)], axis=2)
            values = here[:, :1] + waves @ here[:, 1:]
            values *= (weight / np.sqrt(weight.sum(axis=1, keepdims=True) / 1.5))[:, :, None]
            sums, total = np.zeros((len(z), self.n_outputs)), np.full(len(z), 1e-300)
            np.add.at(sums, rows, values)
            np.add.at(total, rows, weight)
            told.append(np.hstack([sums / total[:, None], z[:, self.n_outputs :]]))
        return told

    def units(self, n):
        """Changes of omega, and of the slope, by which the phase of the last harmonic turns."""
        unit = np.array([1.0, 2.0 / self.length]) * self.omega / (self.n_turns * self.n_harmonics)
        return unit[:n]

    def around(self, fit, n):
        """Coefficients at a fit, and on either side of it for omega (and slope).

        Those beside are of the record as the fit explains it: noise that moves along with the
        windows would look like a signal that does.

        It returns those at the fit, a pair beside it for omega (and one for the slope),
        and the turns of each segment.
        """
        turns = self.turns(fit.omega, fit.slope)
        here = self.coefficients(self.signals, fit.omega, fit.slope, turns)
        told = self.explained(fit, turns, here)
        place = np.array([fit.omega, fit.slope])
        beside = [
            tuple(self.coefficients(told, *(place + side * h), turns) for side in (1.0, -1.0))
            for h in np.diag(STEP * self.units(2))[:n]
        ]
        return here, beside, turns

    def slopes(self, here, beside, rank):
        """Derivatives of the residual with respect to omega (and slope), in their units, the
        residual, and how many rows count; of coefficients around a fit."""
        left, n_rows = self.residual(here, rank)
        ends = [[self.residual(a, rank)[0] for a in pair] for pair in beside]
        J = np.stack([(after - before).ravel() for after, before in ends], axis=1)
        return J / (2.0 * STEP), left, n_rows

    def descend(self, fit, n, most=10):
        """Gauss-Newton steps for omega (and slope) at the rank of a fit."""
        for _ in range(most):
            here, beside, turns = self.around(fit, n)
            J, left, _ = self.slopes(here, beside, fit.rank)
            place, unit, step = np.array([fit.omega, fit.slope]), self.units(n), np.zeros(2)
            step[:n] = -linalg.lstsq(J, left.ravel(), cond=1e-10)[0]
            step[:n] *= unit / max(1.0, 4.0 * np.max(np.abs(step)))
            cost = np.sum(left**2)
            for share in 0.3 ** np.arange(5):
                a = self.coefficients(self.signals, *(place + share * step), turns)
                if np.sum(self.residual(a, fit.rank)[0] ** 2) < cost:
                    break
            else:
                break
            fit = fit._replace(omega=place[0] + share * step[0], slope=place[1] + share * step[1])
            if np.max(np.abs(step[:n] / unit)) < 1e-9:
                break
        return self.fit(fit.omega, fit.slope, fit.rank)

    def climb(self, fit, n):
        """The best of descents with one pattern, two, … as long as Schwarz's criterion gains."""
        best, start = None, fit
        for rank in range(1, 16):
            new = self.descend(start._replace(rank=rank), n, most=3)
            if new.rank != rank or not np.isfinite(new.score):
                break
            if best is None or new.score < best.score:
                best = start = new
            else:
                break
        return best

    def comb(self, span, slopes):
        """Omega and slope at which lines are strongest: where a trim that lasts would put them."""
        turns = self.turns(self.omega)
        a = self.coefficients(self.signals, self.omega, 0.0, turns)
        n = self.n_harmonics
        a = (a[:, 1 : n + 1] - 1j * a[:, n + 1 :])[:, :, : self.n_outputs] * self.weights
        t = 2.0 * np.pi * np.concatenate(turns) / self.omega
        offs = np.arange(-span, span, 1.0 / (3 * n * self.n_turns)) * self.omega
        best = []
        for slope in slopes:
            step = np.exp(1j * (np.outer(offs, t) + 0.5 * slope * t**2))
            power, wave = 0.0, step
            for j in range(n):
                power = power + np.sum(np.abs(wave @ a[:, j]) ** 2, axis=1)
                wave = wave * step
            best.append((np.max(power), self.omega + offs[np.argmax(power)], slope))
        return max(best)[1:]

    def at_home(self):
        """Whether a first look finds no better frequency than the one given."""
        around = self.omega * (1.0 + np.array([-0.03, -0.01, -3e-3, 3e-3, 0.01, 0.03]))
        return all(self.fit(w).score >= self.here.score for w in around)

    def may_gain(self):
        """Whether less may be left beside the frequency given, to first order, at some rank."""
        _, X, n = self.rows(self.omega)
        ranks = np.unique(np.geomspace(1, self.here.rank, RANKS).round().astype(int))
        for rank, there in zip(ranks, self.scores(X, n)[1][ranks], strict=True):
            if there <= (SLIGHT - 1.0) * self.floor:
                return False  # nor do more patterns leave more
            here, beside, _ = self.around(self.here._replace(rank=rank), 2)
            J, left, _ = self.slopes(here, beside, rank)
            gained = left.ravel() - J @ linalg.lstsq(J, left.ravel(), cond=1e-10)[0]
            share = np.sum(gained**2) / max(np.sum(left**2), 1e-300)
            if there + self.floor > SLIGHT * (there * share + self.floor):
                return True
        return False

    def beside(self):
        """The best fits beside the frequency given: of constant speed, and of any."""
        # fewer patterns may tell more
        fits = [self.climb(self.here, 1), self.descend(self.here, 1)]
        steady = min((fit for fit in fits if fit), key=lambda fit: fit.score)
        return self.descend(steady, 1), self.descend(steady, 2)

    def search(self, span):
        """The best fits within the span of the frequency given: of constant speed, and of any."""
        grid = self.omega * (1.0 + np.append(0.0, np.linspace(-span, span, 29)))
        first = min((self.fit(w) for w in grid), key=lambda fit: fit.score)
        near = (first.omega - span * self.omega / 14, first.omega + span * self.omega / 14)
        found = minimize_scalar(lambda w: self.fit(w).score, bounds=near, method="bounded").x
        slopes = np.arange(-12, 13) * self.units(2)[1]
        starts = [(found, 0.0), self.comb(span, [0.0]), self.comb(span, slopes)]
        ends = []
        for omega, slope in starts:
            if any(self.alike(end, omega, slope) for end in ends):
                continue
            ends.append(self.climb(self.fit(omega, slope), 1 + (slope != 0.0)))
        ends = [end for end in ends if end is not None]
        if not ends:
            return None
        best = min(ends, key=lambda fit: fit.score)
        steady = [end for end in ends if end.slope == 0.0] or [best._replace(slope=0.0)]
        return self.descend(min(steady, key=lambda fit: fit.score), 1), self.descend(best, 2)

    def alike(self, fit, omega, slope):
        """Whether a fit and a place are too near for another search."""
        off = np.array([fit.omega - omega, fit.slope - slope]) / self.units(2)
        return np.max(np.abs(off)) < 0.1

    def deviations(self, fit, n):
        """Standard deviations of omega (and the change over the records).

        By the jackknife: one step from the fit, without one part of the rows after the other. A
        pattern that hardly stands out of noise follows it, which slopes do not tell. Not less than
        white noise alone would give. They are too small for a record that is mostly at rest: noise
        there finds a frequency that suits it. Reference: R. G. Miller, "The jackknife: a review",
        Biometrika 61 (1974), 1-15.
        """
        here, beside, _ = self.around(fit, n)
        J, left, n_rows = self.slopes(here, beside, fit.rank)
        d = left.shape[1]
        free = n_rows * d - fit.rank * (n_rows + d - fit.rank)
        white = SHARED * np.diag(linalg.pinv(J.T @ J, rtol=1e-20)) * np.sum(left**2) / free
        ends = []
        for part in np.array_split(np.arange(len(here)), min(32, len(here))):  # parts of the rows
            pairs = [[np.delete(a, part, axis=0) for a in pair] for pair in beside]
            J, left, _ = self.slopes(np.delete(here, part, axis=0), pairs, fit.rank)
            ends.append(linalg.lstsq(J, left.ravel(), cond=1e-10)[0])
        spread = (len(ends) - 1) * np.var(ends, axis=0) * n_rows * d / free
        return np.sqrt(np.maximum(spread, white)) * self.units(n)

    def estimate(self, steady, drifting):
        """What the best fits of constant speed and of any say together."""
        drift, drift_std = np.array([drifting.slope, self.deviations(drifting, 2)[1]]) * self.length
        bent = abs(drift) / (8.0 * steady.omega)  # of the phase, in parts of all turns
        drifts = abs(drift) > BEYOND * drift_std and drifting.score < steady.score
        drifts = drifts and bent * self.longest > ASTRAY
        fit = drifting if drifts else steady
        given = self.fit(self.omega, 0.0, fit.rank)
        off = max(abs(fit.omega / self.omega - 1.0), bent * drifts)
        return OmegaEstimate(
            float(fit.omega),
            float(self.deviations(fit, 1 + drifts)[0]),
            float(drift) if drifts else 0.0,
            float(drift_std),
            self.rivals(fit),
            float(fit.left + self.floor),
            float(given.left + self.floor),
            float(off * self.longest),
            self.of_inputs(fit),
        )

    def tells(self, estimate, span):
        """Whether an estimate lies within the span, all but surely."""
        off = abs(estimate.omega / self.omega - 1.0)
        return off < 1.01 * span and estimate.std < span * self.omega

    def of_inputs(self, fit):
        """Whether inputs always move, at that frequency, and outputs have no wave of it that lasts.

        At frequencies a little off the inputs' own leave far more of them.
        """
        inputs, _, step = self.given
        a = self.coefficients(self.signals, fit.omega, fit.slope, self.turns(fit.omega, fit.slope))
        Y, U = np.split(a[:, 1:], [self.n_outputs], axis=2)
        parts = np.array([part.sum(axis=0) for part in np.array_split(Y, 4)])
        whole, each = np.sum(parts.sum(axis=0) ** 2), np.sum(parts**2) / 4.0
        motion = np.sum(U**2, axis=(1, 2))
        lasts = whole > 8.0 * each  # a wave that lasts has 16 times, chance leaves 4
        if lasts or np.mean(motion > 0.1 * motion.mean()) < 0.5:
            return False
        drive = _Periods([u[:, :0] for u in inputs], inputs, step, fit.omega, *self.starts_given)
        there, off = drive.fit(fit.omega, fit.slope), BESIDE * self.units(1)[0]
        beside = [drive.fit(fit.omega + side * off, fit.slope, there.rank) for side in (-1, 1)]
        least = min(near.left for near in beside)
        return bool(least + drive.floor > CLEAR * (there.left + drive.floor))

    def rivals(self, fit):
        """Fractions that explain the records better; multiples that these do not exclude."""
        found = []
        for m in (2, 3):
            if self.differ(fit, m):
                found.append(float(fit.omega / m))
                continue
            other = _Periods(*self.given, m * fit.omega, *self.starts_given)
            if not other.moves:
                continue
            there = other.fit(m * fit.omega, m * fit.slope)
            if not other.differ(there, m):
                found.append(float(m * fit.omega))
        return tuple(found)

    def differ(self, fit, m):
        """Whether periods resemble the m-th before them more than the last.

        They have patterns of their own, by Schwarz's criterion, or change sign (turn by
        2π/m) for as long as the record lasts, as no mode that decays does.
        """
        turns = self.turns(fit.omega, fit.slope)
        Y, X, n = self.rows(fit.omega, fit.slope, turns)
        numbers = np.concatenate(turns)
        slow = convolve1d(X, np.convolve(np.ones(m), np.ones(m)) / m**2, axis=0)
        classes = [np.stack([X, X - slow])[:, numbers % m == c] for c in range(m)]
        shortest = min(part.shape[1] for part in classes)
        if shortest < FEWEST:
            return False
        X, waves = np.stack([part[:, :shortest] for part in classes], axis=1)
        n = n * X.size / Y.size
        together = np.min(self.scores(X.reshape(-1, Y.shape[1]), n)[0])
        apart = np.min(self.scores(X, n)[0])
        if apart < together - np.sqrt(2.0 / X.size):  # a standard error of their difference
            return True
        wave = np.exp(2j * np.pi * np.arange(m) / m)
        parts = np.array_split(np.tensordot(wave, waves, axes=1), 4)
        parts = np.array([part.sum(axis=0) for part in parts])
        whole, d = np.sum(np.abs(parts.sum(axis=0)) ** 2), Y.shape[1]
        noise = (fit.left + self.floor) * SHARED**2 * (d + BEYOND * np.sqrt(2.0 * d))
        power = np.sum(np.abs(waves) ** 2) / n
        lasts = whole > 4.0 * np.max(np.sum(np.abs(parts) ** 2, axis=1))
        return bool(lasts and whole > n * (noise + 0.5 * n * power))
