"""Displays of data, models and their identification, in scikit-learn's style.

Each class has ``from_estimator`` and, where it fits, ``from_data``, ``from_systems`` or
``from_cv_results``; ``plot(ax=...)`` draws again, on Axes at hand. What was drawn is kept:
``ax_`` (``axes_`` where there are several), ``figure_`` and the artists.

Importing :mod:`sklearn_hd` does not import this package.
"""

from sklearn_hd.plotting._azimuth import AzimuthDisplay
from sklearn_hd.plotting._bode import BodeDisplay
from sklearn_hd.plotting._eigenvalues import EigenvalueDisplay
from sklearn_hd.plotting._harmonic_transfer import HarmonicTransferFunctionDisplay
from sklearn_hd.plotting._harmonics import HarmonicsDisplay
from sklearn_hd.plotting._identification import (
    ConvergenceDisplay,
    OrderSelectionDisplay,
    SingularValueDisplay,
)
from sklearn_hd.plotting._periodic import ParticipationDisplay, PeriodicMatrixDisplay
from sklearn_hd.plotting._residuals import ResidualDisplay
from sklearn_hd.plotting._response import ResponseDisplay
from sklearn_hd.plotting._stabilization import StabilizationDisplay
from sklearn_hd.plotting._step import StepResponseDisplay

__all__ = [
    "AzimuthDisplay",
    "BodeDisplay",
    "ConvergenceDisplay",
    "EigenvalueDisplay",
    "HarmonicTransferFunctionDisplay",
    "HarmonicsDisplay",
    "OrderSelectionDisplay",
    "ParticipationDisplay",
    "PeriodicMatrixDisplay",
    "ResidualDisplay",
    "ResponseDisplay",
    "SingularValueDisplay",
    "StabilizationDisplay",
    "StepResponseDisplay",
]
