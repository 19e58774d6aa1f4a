"""Warnings and errors of sklearn_hd's own."""


class UnstableModelError(ValueError):
    """A norm or a match was asked of a model whose response is not bounded."""


class TrimError(RuntimeError):
    """No periodic solution was found from the guess given."""


class ExcitationWarning(UserWarning):
    """Inputs excite fewer directions than block rows or predictions ask for."""


class IdentifiabilityWarning(UserWarning):
    """Some parameters or modes are not determined by these data."""


class TimeBaseWarning(UserWarning):
    """The time base was assumed (samples counted) rather than read from an index."""


class JitterWarning(UserWarning):
    """Rows were not evenly spaced, and signals were resampled onto a uniform grid."""


class ResamplingWarning(UserWarning):
    """A period held no whole number of samples, and signals were resampled to one."""


class FrequencyMismatchWarning(UserWarning):
    """The data repeat themselves at another frequency than the one given."""


class CacheWarning(UserWarning):
    """A file in the folder given as ``memory``, or the folder, could not be used."""


class InstabilityWarning(UserWarning):
    """A model, or the periodic orbit that the data are taken about, is unstable."""
