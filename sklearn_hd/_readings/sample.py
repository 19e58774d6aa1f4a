"""``reading="sample"``: rows as they were sampled, each at its azimuth.

Their models are periodic innovations models. They need no window, no whole number of samples per
period and no span at rest.

Plain data have no fundamental frequency: each row is a sample, its signals drive the model and are
its outputs.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._readings.basis import WARMUP_PERIODS, HarmonicBasis, Timing
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.algorithms.signals.resampling import ON_GRID

_SIGNALS = ("inputs", "outputs")
MOST_LOADS = 12  # harmonics of the forced response, where the samples tell more


class EveryRow:
    """What readings share that take each row as a sample."""

    window_rows = 0

    def drive(self, values, time):
        """What drives the model at every sample."""
        return values

    def read(self, drive, outputs, time):
        """Inputs and outputs of one segment at the rows that models are made of."""
        return drive, outputs

    def outputs_read(self, outputs, time):
        """Outputs of one segment at the rows that models are made of."""
        return outputs

    def n_read_within(self, time, stop):
        """Rows read whose samples all lie before some sample."""
        return stop

    def recomposed(self, Y, time):
        """Measured outputs of the model's: the same."""
        return Y

    def scored_rows(self, time):
        """First and last of the rows of one segment that count in a score."""
        return 0, len(time)


@dataclass(frozen=True)
class PlainReading(EveryRow):
    """The reading of data that no analyzer has seen."""

    drive_labels: tuple = ()  # of str: names of the inputs
    output_labels: tuple = ()  # of str: names of the outputs
    timing: Timing = field(default_factory=Timing)  # when rows were sampled

    reading = "plain"
    harmonic = False
    hop = samples_per_period = 1
    held = True
    small_signal = input_trim = output_trim = nothing_spurious = None
    about_trim = False

    @property
    def drive_signals(self):
        """The measured signal of each input."""
        return self.drive_labels

    @property
    def input_signals(self):
        """Names of the measured inputs."""
        return self.drive_labels

    def grid(self, signals):
        """Step, fewest rows of a piece, and places of some signals."""
        return signals.base.sample_time, 1, signals.base.time

    def select(self, frame):
        """The columns of X that are read."""
        return frame

    def simulated_rows(self, time):
        """Rows that a discrete model steps through; None is every sample."""
        return None

    def azimuth(self, time):
        """ψ of each sample, in whole periods: zero."""
        return np.zeros(len(time))

    def phase_index(self, time):
        """Sample within the period: the first."""
        return np.zeros(len(time), dtype=int)

    def recomposition(self, psi):
        """Matrices from the outputs of the model to what is measured: identities."""
        identity = np.eye(len(self.output_labels))
        return np.broadcast_to(identity, (len(psi), *identity.shape))

    @property
    def warmup_samples(self):
        """Samples on which a score fits the initial state, by default."""
        return 50  # three times the default block rows


@dataclass(frozen=True, eq=False)
class SampleBasis(EveryRow, HarmonicBasis):
    """Samples with their azimuths.

    Attributes
    ----------
    sample_time : float
        Seconds from one row that models read to the next, ``hop`` samples of the record.
    samples_per_period : float
        Rows that models read in a turn, the mean where the speed varies.
    input_trim, output_trim : ndarray, shapes (2 L + 1, n_signals), or None
        Fourier coefficients of the waveforms subtracted. If no trim is known, those of the outputs
        that are faster than the forced response of a model can be.
    n_harmonics, n_input_harmonics : int or None
        The most harmonics that coefficients may have, and those of inputs; None lets the data
        choose.
    n_load_harmonics : int or None
        Highest harmonic of the forced periodic response.
    """

    n_harmonics: int | None = None
    n_input_harmonics: int | None = None
    n_load_harmonics: int | None = None

    reading = "sample"
    nothing_spurious = "identified from samples, without a window"
    lead = 0
    coefficient_labels = ()

    @classmethod
    def of_others(cls, basis):
        """Of another reading's grid."""
        kept = ("omega", "sample_time", "samples_per_period", "window", "timing")
        bare = {name: tuple((s, (0,)) for s, _ in getattr(basis, name)) for name in _SIGNALS}
        trim = {}
        for name in ("input_trim", "output_trim"):
            waveform = getattr(basis, name)
            trim[name] = None if waveform is None else np.zeros((1, waveform.shape[1]))
        return cls(**{name: getattr(basis, name) for name in kept}, hop=1, **bare, **trim)

    @property
    def about_trim(self):
        """Whether signals are those about a trim that is no part of the models."""
        return self.output_trim is not None and self.trim_known

    @property
    def weights(self):
        """The window: a sample."""
        return np.ones(1)

    @property
    def drive_labels(self):
        """Names of the inputs."""
        return self.input_signals

    @property
    def output_labels(self):
        """Names of the outputs."""
        return tuple(signal for signal, _ in self.outputs)

    def grid(self, signals):
        """Step of the grid, fewest rows of a piece, and places of some signals on it."""
        places = signals.places(self.omega, self.sample_time / self.hop)
        return self.sample_time, 1, places

    def waveform(self, trim, time):
        """A periodic waveform at the rows of one segment."""
        return evaluate_harmonics(trim, self.azimuth(time))

    waveform_between = waveform

    def mean_waveforms(self, pieces):
        """Fourier coefficients of (values, times) of some rows; None of less than a turn."""
        if sum(len(values) for values, _ in pieces) < int(self.samples_per_period):
            return None
        orders = range(self.most_loads + 1)
        functions = [harmonic_functions(self.azimuth(time), orders) for _, time in pieces]
        values = [values for values, _ in pieces]
        return np.linalg.lstsq(np.vstack(functions), np.vstack(values))[0]

    @property
    def most_harmonics(self):
        """Highest harmonic that the samples of a turn tell from others."""
        return max(0, math.ceil(0.5 * self.samples_per_period * (1.0 - ON_GRID)) - 1)

    @property
    def most_loads(self):
        """Highest harmonic of the forced response."""
        asked = self.n_load_harmonics
        return min(MOST_LOADS, self.most_harmonics) if asked is None else asked

    @property
    def warmup_samples(self):
        """Samples on which a score fits the initial state, by default."""
        return round(WARMUP_PERIODS * self.samples_per_period)
