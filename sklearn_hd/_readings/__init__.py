"""How model steps analyse a record: one class per reading, chosen by HarmonicAnalyzer.

All readings answer the same questions: which rows models use, what drives them, how
harmonics come back to samples. :class:`PlainReading` is for data without an analyzer.
"""

from sklearn_hd._readings.basis import (
    HarmonicBasis,
    Timing,
    coefficient_names,
    first_difference,
    highest_harmonic,
)
from sklearn_hd._readings.period import PeriodBasis
from sklearn_hd._readings.plain import PlainReading
from sklearn_hd._readings.sample import SampleBasis
from sklearn_hd._readings.sliding import SlidingBasis

READINGS = {kind.reading: kind for kind in (SlidingBasis, PeriodBasis, SampleBasis)}
