"""Warnings and errors of sklearn_hd."""


class UnstableModelError(ValueError):
    """A norm or a match was requested for a model whose response is not bounded."""


class TrimError(RuntimeError):
    """No periodic solution was found from the given guess."""


class ExcitationWarning(UserWarning):
    """Inputs excite fewer directions than the block rows or predictions need."""


class IdentifiabilityWarning(UserWarning):
    """The data do not determine some parameters or modes."""


class CoordinatesWarning(UserWarning):
    """States have no physical meaning; nothing of the model is in doubt."""


class TimeBaseWarning(UserWarning):
    """The time base was assumed (rows count as samples), not read from an index."""


class JitterWarning(UserWarning):
    """Rows were not evenly spaced, and signals were resampled onto a uniform grid."""


class ResamplingWarning(UserWarning):
    """A period did not hold a whole number of samples, and signals were resampled."""


class FrequencyMismatchWarning(UserWarning):
    """The data repeat themselves at a frequency that differs from the given one."""


class CacheWarning(UserWarning):
    """The folder given as ``memory``, or a file in it, could not be used."""


class InstabilityWarning(UserWarning):
    """A model is unstable, or the periodic orbit about which the data are taken."""
