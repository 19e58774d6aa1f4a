"""``reading="sliding"``, the method of the paper: coefficients through a window, each hop.

Their models are time-invariant, and contain the window's own modes beside the machine's.
"""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._readings.basis import HarmonicBasis
from sklearn_hd.algorithms.signals.fourier import WINDOW_PERIODS, window_weights


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
