"""Linear time-invariant and time-periodic models from periodic nonlinear responses.

Five steps (Hayajnh, Saetti, Prasad, 2024):

1. data from a nonlinear time-periodic system, simulated (:mod:`sklearn_hd.systems`,
   :mod:`sklearn_hd.datasets`) or measured;
2. :class:`HarmonicAnalyzer`: signals to time-varying Fourier coefficients;
3. :class:`MOESPRegressor`: coefficients to a discrete state-space model;
4. :class:`SpuriousModeReducer`: removes the modes that the analyzer added;
5. :class:`StructuredMatcher`: the model in harmonic-decomposition form.

Steps 2 to 5 compose in a scikit-learn ``Pipeline``.
"""

from sklearn_hd._frame import HarmonicFrame
from sklearn_hd._report import report
from sklearn_hd.frequency import OmegaEstimate, estimate_omega
from sklearn_hd.harmonics import HarmonicAnalyzer
from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.reduction import SpuriousModeReducer
from sklearn_hd.structures import HarmonicStructure, MatrixStructure
from sklearn_hd.subspace import MOESPRegressor

__version__ = "0.1.0"

__all__ = [
    "HarmonicAnalyzer",
    "HarmonicFrame",
    "HarmonicStructure",
    "MOESPRegressor",
    "MatrixStructure",
    "OmegaEstimate",
    "SpuriousModeReducer",
    "StructuredMatcher",
    "estimate_omega",
    "report",
]
