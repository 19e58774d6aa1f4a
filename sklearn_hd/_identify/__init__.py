"""Step 3 by reading, one module each: ``read`` a record, ``identify`` a model from data.

``identify(data, settings)`` is a pure function of data (:mod:`~sklearn_hd._identify.statistics`:
arrays in memory, sums over chunks, dask's partitions) and settings, and gives a ``SubspaceFit``.
"""

from dataclasses import replace

import numpy as np

from sklearn_hd._fit_checks import warn_of_data
from sklearn_hd._frame import read_as
from sklearn_hd._guards import searching
from sklearn_hd._identify import period, plain, sample, sliding
from sklearn_hd._identify.checks import MOST_PREDICTOR_ROWS, PREDICTOR, checked
from sklearn_hd._identify.delays import without_delays
from sklearn_hd._identify.stages import Settings, SubspaceFit
from sklearn_hd._opinion import decays_at_rest, of_free_decays
from sklearn_hd._readings import SampleBasis
from sklearn_hd._records.data import as_frame, is_decomposed, read_for_fit
from sklearn_hd._records.delays import as_measured, asked_delays
from sklearn_hd._warn import held_back, warn
from sklearn_hd.algorithms.modes.free_decay import free_decay, smooth_parts, without_products
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning

__all__ = [
    "PREDICTOR",
    "Settings",
    "SubspaceFit",
    "asked_block_rows",
    "checked",
    "identify",
    "identify_frame",
    "identify_record",
    "most_block_rows",
]

MOST_ROWS = 20_000  # of samples read for a second opinion: some tenths of a second
MODULES = {"plain": plain, "sliding": sliding, "period": period, "sample": sample}


def identify_frame(X, y, settings, *delays):
    """Identify a model from a frame and outputs in memory, by the reading that they confirm.

    A frame may carry two readings. The second one is tried if something speaks against the model
    of the first; of two that are in doubt the one that may be less far off is kept. In a search,
    and with block rows given, which are others for each reading, it is tried only if the first
    one fails.

    Returns
    -------
    fit : SubspaceFit
    experiment : Experiment
    basis : HarmonicBasis or PlainReading
        As :func:`identify_record` gives them.
    """
    other = None if isinstance(X, np.ndarray) else getattr(X, "basis", None)
    other = None if other is None or is_decomposed(y) else other.alternative
    if other is None:
        return identify_record(read_for_fit(X, y), settings, *delays)
    first, doubts, error = _attempt(X, y, settings, delays)
    if first is None or (_in_doubt(doubts) and settings.block_rows is None and not searching()):
        second, others, _ = _attempt(read_as(as_frame(X), other.reading), y, settings, delays)
        surer = second is not None and (first is None or not _in_doubt(others))
        if surer or (second is not None and second[0].doubt < first[0].doubt):
            first, doubts = second, others
    if first is None:
        raise error
    for message, category in doubts:
        warn(message, category)
    fit, experiment, basis = first
    return fit, experiment, replace(basis, alternative=None)


def _attempt(X, y, settings, delays):
    """What :func:`identify_record` gives, its warnings, and the error where there is one."""
    with held_back() as held:
        try:
            return identify_record(read_for_fit(X, y), settings, *delays), held, None
        except ValueError as error:
            return None, held, error


def _in_doubt(held):
    return any(category in (IdentifiabilityWarning, InstabilityWarning) for _, category in held)


def identify_record(experiment, settings, input_delay=0.0, output_delay=0.0):
    """Identify a model from an experiment in memory, as its reading says.

    Returns
    -------
    fit : SubspaceFit
    experiment : Experiment
        That the fit is of: in the machine's own time.
    basis : HarmonicBasis or PlainReading
        With the trim that was identified together with the dynamics.
    """
    delays = asked_delays(input_delay, output_delay, experiment)
    if delays is None:
        fit = _of_record(experiment, settings)
    else:
        fit, experiment = without_delays(experiment, delays, settings, _of_record)
    basis = experiment.basis
    if fit.forced is not None:
        forced = as_measured(fit.forced, fit.model.delays, basis)
        basis = replace(basis, output_trim=basis.output_trim + forced)
    return fit, experiment, basis


def _of_record(experiment, settings):
    """The fit of an experiment in the machine's own time, with a second opinion."""
    module = MODULES[experiment.basis.reading]
    data = module.read(experiment, settings)
    warn_of_data(experiment)
    fit = module.identify(data, settings, experiment)
    if module is not sliding or searching():
        return fit
    return replace(fit, model=replace(fit.model, opinion=_opinion(experiment)))


def _opinion(experiment):
    """Exponents of a record by another reading than its own; None where that finds none.

    The free decays where inputs rest, else the samples, whose warnings are of another model.
    """
    decays, _ = decays_at_rest(experiment)
    if decays:
        parts = smooth_parts(decays)
        found = free_decay(parts)
        return of_free_decays(found and without_products(found, parts), experiment)
    if sum(map(len, experiment.outputs)) > MOST_ROWS:
        return None
    at_samples = replace(
        experiment, basis=SampleBasis.of_others(experiment.basis), drive=experiment.inputs
    )
    with held_back():
        try:
            return sample.opinion(at_samples)
        except ValueError:
            return None


def identify(data, settings):
    """Identify a model from data that are not in memory: sums over chunks, or partitions.

    Period by period the raw periods are simulated, too: that reading takes records in memory.
    """
    return MODULES[data.facts.basis.reading].identify(data, settings)


def asked_block_rows(basis, settings):
    """Block rows given, or the default of a reading."""
    return MODULES[basis.reading].asked_block_rows(basis, settings)


def most_block_rows(basis, settings):
    """The most block rows that sums over data should be made for, before they are seen."""
    asked = asked_block_rows(basis, settings)  # which says what a reading refuses
    chosen = settings.predictor and settings.block_rows is None
    return MOST_PREDICTOR_ROWS if chosen else asked
