"""Known structure of a model: which entries are fixed, free or shared."""

from sklearn_hd.structures._harmonic import HarmonicStructure
from sklearn_hd.structures._matrix import MatrixStructure

__all__ = ["HarmonicStructure", "MatrixStructure"]
