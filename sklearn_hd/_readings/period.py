"""``reading="period"``: whole periods, one after another (the blockwise Fourier transform).

Sampled once a period, a periodic system is time-invariant: its Poincaré map.
"""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._readings.basis import HarmonicBasis
from sklearn_hd.algorithms.signals.fourier import window_weights


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
        return Y[..., np.clip(_row_before(rows, n_samples), 0, len(rows) - 1), :]


def _row_before(rows, n_samples):
    return np.searchsorted(rows, np.arange(n_samples), side="right") - 1
