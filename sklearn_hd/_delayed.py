"""Delays of the signals of a model, as the steps report them."""

import numpy as np
import pandas as pd
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._records.delays import in_machine_time

__all__ = ["Delayed"]


class Delayed:
    """A step whose model may have delays, which its matrices do not include."""

    @property
    def delays_(self):
        """Delay of each input and output, seconds, as a Series."""
        return self._delays("seconds", 0.0, "delay")

    @property
    def delay_std_(self):
        """Standard deviation of each delay, as a Series; NaN if it was given."""
        return self._delays("std", np.nan, "delay_std")

    def _delays(self, what, none, name):
        check_is_fitted(self)
        delays = self.model_.delays
        if delays is None:
            names = [*self.basis_.input_signals, *self.target_names_]
            return pd.Series(none, names, name=name)
        return delays.table(what).rename(name)

    def _samples_late(self, experiment):
        """Samples by which each output is measured after the simulators have it."""
        delays = self.model_.delays
        if delays is None:
            return np.zeros(1)
        if self.predicts_harmonics_ and delays.outputs.any():
            raise ValueError(
                "y was given as a HarmonicFrame of coefficients, and coefficients cannot be "
                "shifted in time; give y in time at fit, or use output_delay=0"
            )
        return delays.outputs / experiment.base.sample_time

    def _compared(self, experiment):
        """The same, outputs in the machine's own time, where only what is known is left."""
        delays = self.model_.delays
        return experiment if delays is None else in_machine_time(experiment.origin, delays)

    def _samples_ahead(self, experiment):
        """Samples by which outputs are late, which have to be alike where they tell the state."""
        samples = self._samples_late(experiment)
        if np.ptp(samples) > 0.0:
            raise ValueError(
                f"the outputs have different delays ({self.model_.delays.outputs.tolist()} s), so "
                f"a prediction ahead would use values measured later; give one output_delay for "
                f"all outputs, or simulate (predict, horizon=None)"
            )
        return samples
