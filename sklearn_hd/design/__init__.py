"""From the model to the controller: periodic regulators and Kalman filters."""

from sklearn_hd.design._matrix import PeriodicMatrix
from sklearn_hd.design._observer import (
    Observer,
    OutputFeedback,
    PeriodicEstimator,
    periodic_kalman,
)
from sklearn_hd.design._regulator import PeriodicRegulator, periodic_lqr

__all__ = [
    "Observer",
    "OutputFeedback",
    "PeriodicEstimator",
    "PeriodicMatrix",
    "PeriodicRegulator",
    "periodic_kalman",
    "periodic_lqr",
]
