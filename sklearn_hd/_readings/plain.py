"""Plain data: each row is a sample, its signals drive the model and are its outputs.

Data without a fundamental frequency are periodic with each sample.
"""

from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._readings.basis import Timing

WARMUP_SAMPLES = 50  # three times the default block rows


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

    def rows_read(self, time, whole_windows=True):
        """Rows of one segment that models are made of: all."""
        return np.arange(len(time))

    def recomposed(self, Y, time):
        """Measured outputs of the model's: the same."""
        return Y

    def scored_rows(self, time):
        """First and last of the rows of one segment that count in a score."""
        return 0, len(time)


@dataclass(frozen=True)
class PlainReading(EveryRow):
    """The reading of data that no analyzer has seen.

    Attributes
    ----------
    drive_labels, output_labels : tuple of str
        Names of the inputs and the outputs.
    timing : Timing
        When rows were sampled.
    """

    drive_labels: tuple = ()
    output_labels: tuple = ()
    timing: Timing = field(default_factory=Timing)

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
        return WARMUP_SAMPLES
