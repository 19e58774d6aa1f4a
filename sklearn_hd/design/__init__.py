"""Design from a model: the next record's inputs, regulators and Kalman filters."""

from sklearn_hd.design._input import InputDesign, design_input
from sklearn_hd.design._observer import (
    Observer,
    OutputFeedback,
    PeriodicEstimator,
    periodic_kalman,
)
from sklearn_hd.design._problem import PeriodicMatrix
from sklearn_hd.design._regulator import PeriodicRegulator, periodic_lqr

__all__ = [
    "InputDesign",
    "Observer",
    "OutputFeedback",
    "PeriodicEstimator",
    "PeriodicMatrix",
    "PeriodicRegulator",
    "design_input",
    "periodic_kalman",
    "periodic_lqr",
]
