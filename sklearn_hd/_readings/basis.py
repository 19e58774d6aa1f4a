"""The harmonic readings: coefficients from signals, and back.

``reading="sliding"``, the method of the paper: coefficients through a window, each hop. Their
models are time-invariant, and contain the window's own modes beside the machine's.

``reading="period"``: whole periods, one after another (the blockwise Fourier transform). Sampled
once a period, a periodic system is time-invariant: its Poincaré map.
"""

from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._checks import FIRST, RAISE
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.signals.fourier import (
    WINDOW_PERIODS,
    all_harmonics,
    harmonic_functions,
    harmonic_labels,
    window_weights,
    windowed_coefficients,
)
from sklearn_hd.algorithms.signals.resampling import ON_GRID

DUST = 1e-12  # share of a signal, or of the trim that was subtracted, that is rounding
WARMUP_PERIODS = 5


@dataclass(frozen=True)
class Timing:
    """How rows are read: when each was sampled, and what becomes of missing samples."""

    sample_time: float | None = None  # seconds from row to row; None reads it from the index
    # the instant from which dates are counted, as ISO text, or FIRST for the first of them; None
    # refuses dates
    time_origin: str | None = FIRST
    azimuth: str | None = None  # name of the column that holds ψ
    # "raise", "gap" or float: what becomes of NaN; a number is the longest run to bridge, in
    # seconds
    missing: float | str = RAISE
    # whether rows are resampled even if evenly spaced, as no whole number of them makes a period
    resampled: bool = False
    # seconds from row to row at fit, of rows that come without times later; None where those at fit
    # had none
    row_time: float | None = None
    of_fit: bool = False  # whether sample_time is that of the data at fit, not one that was given


@dataclass(frozen=True, eq=False)
class HarmonicBasis:
    """How harmonic coefficients were, and are to be, made from signals in time.

    A reading adds ``weights`` (its window), ``window_rows``, ``lead``, ``window_ends``,
    ``rows_read`` and ``between_rows``.

    Attributes
    ----------
    omega : float
        Fundamental frequency, rad/s; the mean speed where an azimuth is given.
    sample_time : float
        Seconds from row to row of the grid that is analysed.
    window : str
        Such as ``"boxcar"`` (causal) or ``"centred-boxcar"``.
    hop : int
        Samples from one analysed row to the next.
    inputs, outputs : tuple of (signal, (k, …))
        Harmonics kept of each signal.
    input_trim, output_trim : ndarray, shapes (samples_per_period, n_signals), or None
        Periodic waveforms subtracted from the signals.
    trim_known : bool
        Whether these are of rows in trim. Else that of the outputs is a start, and what it is off
        by is identified together with the dynamics.
    timing : Timing
        When the user's rows were sampled.
    small_signal : "odd", "extrapolate" or None
        How records at several amplitudes are combined where a model is fitted.
    alternative : HarmonicBasis or None
        Another reading of the same record, which identification may take instead.
    """

    omega: float
    sample_time: float
    samples_per_period: int
    window: str
    hop: int
    inputs: tuple
    outputs: tuple
    input_trim: np.ndarray | None = None
    output_trim: np.ndarray | None = None
    timing: Timing = field(default_factory=Timing)
    small_signal: str | None = None
    trim_known: bool = True
    alternative: object = None

    harmonic = True
    nothing_spurious = None  # why models hold no modes but the machine's

    @property
    def about_trim(self):
        """Whether signals are those about a trim that is no part of the models."""
        return self.output_trim is not None

    @property
    def rows_per_period(self):
        """Rows read in a period."""
        return self.samples_per_period // self.hop

    @property
    def output_labels(self):
        """Names of the harmonic coefficients of the outputs."""
        return coefficient_names(self.outputs)

    @property
    def measured(self):
        """Columns that the basis reads: the inputs, and the azimuth where there is one."""
        azimuth = self.timing.azimuth
        return [*self.input_signals, *([] if azimuth is None else [azimuth])]

    @property
    def input_signals(self):
        """Names of the measured inputs."""
        return tuple(signal for signal, _ in self.inputs)

    @property
    def drive_signals(self):
        """The measured signal that each entry of ``drive_labels`` comes from."""
        return tuple(signal for signal, orders in self.inputs for _ in harmonic_labels(orders))

    @property
    def held(self):
        """Which inputs drive the models as they were measured, held from row to row."""
        return np.array([harmonics == (0,) for _, harmonics in self.inputs], dtype=bool)

    @property
    def drive_labels(self):
        """Names of the inputs of the identified models.

        A signal of which only harmonic 0 is kept drives the model as it was
        measured; others by the coefficients of each whole period.
        """
        return coefficient_names(self.inputs)

    @property
    def coefficient_labels(self):
        """Names of the columns that the analyzer adds."""
        return self.drive_labels

    def of_reading(self, reading):
        """This basis, or the alternative if that is of the reading asked for."""
        other = self.alternative
        return other if other is not None and other.reading == reading else self

    def select(self, frame):
        """The columns of X that are read; ValueError if a step has changed them."""
        found, made = [str(c) for c in frame.columns], [*self.measured, *self.coefficient_labels]
        missing = [name for name in made if name not in found]
        extra = [name for name in found if name not in made]
        if missing or extra:
            what = f"dropped {missing[0]!r}" if missing else f"added {extra[0]!r}"
            raise ValueError(
                f"a step between HarmonicAnalyzer and this one has {what}; the analyzer "
                f"made {made}: put steps that change columns before the analyzer"
            )
        return frame[self.measured]

    def grid(self, signals):
        """Step of the grid, fewest rows of a piece, and places of some signals on it."""
        places = signals.places(self.omega, self.sample_time)
        return self.sample_time, len(self.weights), places

    def waveform(self, trim, time):
        """A periodic waveform at the rows of one segment."""
        return trim[self.phase_index(time)]

    def waveform_between(self, trim, places):
        """The same at any times: the trigonometric polynomial through the samples of a period."""
        return evaluate_harmonics(all_harmonics(trim), self.azimuth(places))

    def mean_waveforms(self, pieces):
        """Periodic waveforms of (values, times) of some rows; None if a phase is missing."""
        spp = self.samples_per_period
        sums, counts = np.zeros((spp, pieces[0][0].shape[1])), np.zeros(spp)
        for values, time in pieces:
            index = self.phase_index(time)
            np.add.at(sums, index, values)
            np.add.at(counts, index, 1)
        return sums / counts[:, None] if counts.all() else None

    def azimuth(self, time):
        """ψ = ωt in radians."""
        return self.omega * np.asarray(time)

    def phase_index(self, time):
        """Sample within the period of the rows of one segment, 0 … samples_per_period − 1.

        Counted from the first row, so that a sample time that is off by a part
        in a million moves no row into the neighbouring phase.
        """
        time = np.asarray(time)
        if len(time) == 0:
            return np.zeros(0, dtype=int)
        first = time[0] * self.omega / (2.0 * np.pi) * self.samples_per_period
        steps = np.rint((time - time[0]) / self.sample_time).astype(int)
        # rows halfway between two phases all go to the same side
        return (int(np.floor(first + 0.5 + ON_GRID)) + steps) % self.samples_per_period

    def coefficients(self, values, time, signals, rows):
        """Windowed coefficients of some signals at some rows of one segment.

        ``values`` has one column for each of ``signals``, (signal, (k, …)), and
        ``time`` is in seconds. Rows nearer to an end than the window reaches take the
        nearest whole window; read by periods, they take the period that the row is in.
        """
        ends = self.window_ends(time, rows)
        unique, where = np.unique(ends, return_inverse=True)
        psi = self.azimuth(time)
        columns = [
            windowed_coefficients(values[:, i], psi, harmonics, self.weights, unique)[where]
            for i, (_, harmonics) in enumerate(signals)
        ]
        return np.hstack(columns)

    def output_coefficients(self, outputs, time, rows):
        """Coefficients of the outputs that models are fitted to, without those that are dust.

        Each coefficient counts alike in a fit, whatever its size: rounding would, too.

        The trim is subtracted from ``outputs``.
        """
        columns = self.coefficients(outputs, time, self.outputs, rows)
        start = 0
        for i, (_, harmonics) in enumerate(self.outputs):
            own = slice(start, start + len(harmonic_labels(harmonics)))
            trim = 0.0 if self.output_trim is None else np.max(np.abs(self.output_trim[:, i]))
            columns[:, own] = _without_dust(columns[:, own], DUST * trim)
            start = own.stop
        return columns

    def drive(self, values, time):
        """Inputs of the identified model at every sample of one segment.

        ``values`` are raw inputs, trim subtracted, one column for each of ``inputs``.
        The drive is the raw signal where only harmonic 0 is kept. Else it is the
        coefficients of the whole period that each sample lies in.
        """
        psi, spp = self.azimuth(time), self.samples_per_period
        box = window_weights("boxcar", spp)
        ends = np.arange(len(time)) - self.phase_index(time) + spp - 1
        ends, where = np.unique(np.clip(ends, spp - 1, len(time) - 1), return_inverse=True)
        columns = [
            values[:, [i]]
            if harmonics == (0,)
            else _without_dust(windowed_coefficients(values[:, i], psi, harmonics, box, ends))[
                where
            ]
            for i, (_, harmonics) in enumerate(self.inputs)
        ]
        return np.hstack(columns)

    def held_drive(self, drive, rows):
        """Mean of the drive over the hop that follows the end of each row's window.

        What lies beyond the segment is held at its last value.
        """
        if len(rows) == 0:
            return drive[rows]
        hop, ends = self.hop, rows + self.lead
        beyond = max(0, int(ends[-1]) + hop - len(drive))
        held = np.concatenate([drive, np.repeat(drive[-1:], beyond, axis=0)])
        return np.lib.stride_tricks.sliding_window_view(held, hop, axis=0)[ends].mean(axis=-1)

    def read(self, drive, outputs, time):
        """Inputs and coefficients of one segment at the rows that models are made of."""
        return self.held_drive(drive, self.rows_read(time)), self.outputs_read(outputs, time)

    def outputs_read(self, outputs, time):
        """Coefficients of one segment at the rows that models are made of."""
        return self.output_coefficients(outputs, time, self.rows_read(time))

    def n_read_within(self, time, stop):
        """Rows read whose windows end before some sample."""
        return int(np.sum(self.rows_read(time) + len(self.weights) <= stop))

    def simulated_rows(self, time):
        """Rows of one segment that a discrete model steps through."""
        return self.rows_read(time, whole_windows=False)

    def recomposition(self, psi):
        """Matrices R(ψ) that take the outputs' coefficients to the kept signals (Eq. 7).

        Shape (n_samples, n_signals, n_coefficients).
        """
        blocks = [harmonic_functions(psi, harmonics) for _, harmonics in self.outputs]
        width = sum(block.shape[-1] for block in blocks)
        R = np.zeros((len(psi), len(blocks), width))
        start = 0
        for i, block in enumerate(blocks):
            R[:, i, start : start + block.shape[-1]] = block
            start += block.shape[-1]
        return R

    def recomposed(self, Y, time):
        """Signals of coefficients that are known at every sample (Eq. 7)."""
        R = self.recomposition(self.azimuth(time))
        return np.einsum("tsk,...tk->...ts", R, Y)

    def scored_rows(self, time):
        """First and last of the rows of one segment that count: whole windows and periods."""
        n, phase = self.samples_per_period, self.phase_index(time)
        first = len(self.weights) - 1 - self.lead
        first += -phase[min(first, len(time) - 1)] % n
        return first, len(time) - (phase[-1] + 1) % n

    @property
    def warmup_samples(self):
        """Samples on which a score fits the initial state, by default."""
        return WARMUP_PERIODS * self.samples_per_period


def first_difference(basis, other):
    """Name and both values of the first setting in which two analyses differ, or None."""
    for name in ("omega", "sample_time", "reading", "hop", "window", "inputs", "outputs"):
        here, there = getattr(basis, name, None), getattr(other, name, None)
        if here != there:
            return name, here, there
    return None


def highest_harmonic(signals):
    """Highest harmonic kept of some signals."""
    return max(k for _, orders in signals for k in orders)


def _without_dust(coefficients, least=0.0):
    """Coefficients of one signal, those that are but rounding beside the others set to zero."""
    size = np.abs(coefficients).max(axis=0, initial=0.0)
    return np.where(size > max(DUST * size.max(initial=0.0), least), coefficients, 0.0)


def coefficient_names(signals):
    """Names such as u_0, u_1c, u_1s of the coefficients kept of some signals."""
    return tuple(
        f"{signal}_{label}" for signal, harmonics in signals for label in harmonic_labels(harmonics)
    )


@dataclass(frozen=True, eq=False)
class SlidingBasis(HarmonicBasis):
    """Coefficients through a window that slides over the record."""

    reading = "sliding"

    @property
    def _shape(self):
        """The window without its side."""
        return self.window.removeprefix("centred-")

    @property
    def weights(self):
        """Window, oldest sample first, shape (n_window,)."""
        return window_weights(self._shape, self.samples_per_period)

    @property
    def window_rows(self):
        """Rows read within one window."""
        return WINDOW_PERIODS[self._shape] * self.rows_per_period

    @property
    def lead(self):
        """Samples by which the window runs ahead of its row, a multiple of the hop.

        Ahead by whole hops, so that inputs that change where rows are read
        still do so, seen from the end of the window.
        """
        if not self.window.startswith("centred-"):
            return 0
        hops = round((len(self.weights) - 1) / 2 / self.hop)
        return min(hops, (len(self.weights) - 1) // self.hop) * self.hop

    def window_ends(self, time, rows):
        """Last sample of the window of each row, clipped to the segment."""
        return np.clip(np.asarray(rows) + self.lead, len(self.weights) - 1, len(time) - 1)

    def rows_read(self, time, whole_windows=True):
        """Rows of one segment at ψ = 0 mod hop, with whole windows where asked."""
        rows = np.flatnonzero(self.phase_index(time) % self.hop == 0)
        if not whole_windows:
            return rows
        ends = rows + self.lead
        return rows[(ends >= len(self.weights) - 1) & (ends < len(time))]

    def between_rows(self, Y, rows, n_samples):
        """Coefficients at every sample, linear from row to row."""
        samples = np.arange(n_samples)
        left = np.clip(np.searchsorted(rows, samples, side="right") - 1, 0, len(rows) - 1)
        right = np.minimum(left + 1, len(rows) - 1)
        gap = np.maximum(rows[right] - rows[left], 1)
        share = np.clip((samples - rows[left]) / gap, 0.0, 1.0)[:, None]
        return (1.0 - share) * Y[..., left, :] + share * Y[..., right, :]


@dataclass(frozen=True, eq=False)
class PeriodBasis(HarmonicBasis):
    """Coefficients of whole periods, one row a period."""

    reading = "period"
    nothing_spurious = "period-synchronous"
    window_rows = 1
    lead = 0

    @property
    def weights(self):
        """Window, oldest sample first, shape (samples_per_period,)."""
        return window_weights("boxcar", self.samples_per_period)

    def window_ends(self, time, rows):
        """Last sample of the period that each row lies in, within the segment."""
        n = self.samples_per_period
        ends = rows - self.phase_index(time)[rows] + n - 1
        return np.clip(ends, n - 1, len(time) - 1)

    def rows_read(self, time, whole_windows=True):
        """First rows of the periods of one segment, of whole ones where asked."""
        rows = np.flatnonzero(self.phase_index(time) == 0)
        return rows[rows + self.samples_per_period <= len(time)] if whole_windows else rows

    def between_rows(self, Y, rows, n_samples):
        """Coefficients at every sample: those of its period."""
        before = np.searchsorted(rows, np.arange(n_samples), side="right") - 1
        return Y[..., np.clip(before, 0, len(rows) - 1), :]
