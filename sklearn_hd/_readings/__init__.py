"""How model steps analyse a record: one class per reading, chosen by HarmonicAnalyzer.

All readings answer the same questions: which rows models use, what drives them, how
harmonics come back to samples. :class:`PlainReading` is for data without an analyzer.
"""

from sklearn_hd._readings.basis import (
    HarmonicBasis,
    PeriodBasis,
    SlidingBasis,
    Timing,
    coefficient_names,
    first_difference,
    highest_harmonic,
)
from sklearn_hd._readings.sample import PlainReading, SampleBasis

READINGS = {kind.reading: kind for kind in (SlidingBasis, PeriodBasis, SampleBasis)}
