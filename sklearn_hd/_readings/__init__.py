"""How model steps read a record: one class a reading, chosen once by HarmonicAnalyzer.

All readings answer the same questions: which rows models see, what drives them, how
harmonics come back to samples. :class:`PlainReading` is that of data without an analyzer.
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
