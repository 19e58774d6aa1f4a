"""Step 3 by reading, one module each: ``read`` a record, ``identify`` a model from data.

``identify(data, settings)`` is a pure function of data (:mod:`~sklearn_hd._identify.statistics`:
arrays in memory, sums over chunks, dask's partitions) and settings, and gives a ``SubspaceFit``.
"""

from sklearn_hd._identify import period, plain, sliding
from sklearn_hd._identify.stages import Settings, SubspaceFit

__all__ = ["Settings", "SubspaceFit", "asked_block_rows", "identify", "identify_record"]

MODULES = {"plain": plain, "sliding": sliding, "period": period}


def identify_record(experiment, settings):
    """Identify a model from an experiment in memory, as its reading says."""
    module = MODULES[experiment.basis.reading]
    return module.identify(module.read(experiment, settings), settings, experiment)


def identify(data, settings):
    """Identify a model from data that are not in memory: sums over chunks, or partitions."""
    return MODULES[data.facts.basis.reading].identify(data, settings)


def asked_block_rows(basis, settings):
    """Block rows given, or the default of a reading."""
    return MODULES[basis.reading].asked_block_rows(basis, settings)
