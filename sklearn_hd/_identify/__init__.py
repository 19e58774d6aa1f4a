"""Step 3 by reading, one module each: ``read`` a record, ``identify`` a model from data.

``identify(data, settings)`` is a pure function of data (:mod:`~sklearn_hd._identify.statistics`:
arrays in memory, sums over chunks, dask's partitions) and settings, and gives a ``SubspaceFit``.

Time delays with a subspace fit: a search over whole samples, refined for plain data.

1. The lag at which each output first responds to each input, by the criterion of a regression
   (:func:`~sklearn_hd.algorithms.likelihood.delay_search.first_answers`).
2. Delays of inputs and outputs; these lags are their sums.
3. Plain data: the likelihood of the time-invariant model with all entries free, and the delays.
   Other models are refined in :class:`~sklearn_hd.StructuredMatcher`.
4. The model, by the subspace method of its reading, in the machine's own time.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy import sparse

from sklearn_hd._checks import DECISIVE, LITTLE
from sklearn_hd._fit_checks import warn_of_data
from sklearn_hd._frame import read_as
from sklearn_hd._guards import held_back, searching, warn
from sklearn_hd._identify import period, plain, sample, sliding
from sklearn_hd._identify.stages import (
    DEFAULT_BLOCK_ROWS,
    MOST_PREDICTOR_ROWS,
    PREDICTOR,
    Settings,
    SubspaceFit,
    checked,
)
from sklearn_hd._opinion import DOUBT, decays_at_rest, of_free_decays
from sklearn_hd._records.data import as_frame, is_decomposed, output_scale, read_for_fit
from sklearn_hd._records.delays import (
    as_measured,
    asked_delays,
    in_machine_time,
    most_samples,
    warn_of_doubt,
)
from sklearn_hd._records.likelihood import RecordData, SearchSettings
from sklearn_hd.algorithms.likelihood.delay_search import first_answers
from sklearn_hd.algorithms.lti.simulation import discrete_to_continuous, simulate
from sklearn_hd.algorithms.modes.free_decay import free_decay, smooth_parts, without_products
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning

MODULES = {"plain": plain, "sliding": sliding, "period": period, "sample": sample}


def without_delays(experiment, delays, settings):
    """The fit of a record in the machine's own time, its model with the delays.

    ``experiment`` is as measured. The fit comes with the experiment that it is of.
    """
    direct, plain = None, experiment.basis.reading == "plain"
    if delays.free.any():
        delays = _searched(experiment, delays)
        if settings.feedthrough == "auto":  # D and fractions of a sample make up for each other
            if plain:
                direct = _at(experiment, delays, replace(settings, feedthrough=True))
            settings = replace(settings, feedthrough=False)
    found = _at(experiment, delays, settings)
    if delays.free.any() and plain and not found[0].model.feedthrough:
        refined = _refined(*found[:2])
        if refined is not None:
            found = _at(experiment, refined, settings)
    needs_feedthrough = False
    if direct is not None:  # a fraction of a sample explains the same, but for little
        left, least = (_left(*each[:2]) for each in (found, direct))
        needs_feedthrough = np.any((left > LITTLE) & (left > DECISIVE * least))
    fit, machine, held = direct if needs_feedthrough else found
    for message, category in held:
        warn(message, category)
    if needs_feedthrough:
        _warn_of_whole_samples(delays)
    elif machine.delays is not delays:
        warn_of_doubt(machine.delays)
    return fit, machine


def _warn_of_whole_samples(delays):
    """Warn of delays of a record with a feedthrough."""
    found = ", ".join(
        f"{name} {seconds:.4g} s"
        for name, seconds, free in zip(delays.names, delays.seconds, delays.free, strict=True)
        if free
    )
    warn(
        f"a model with a feedthrough leaves less of the record than fractions of a sample do, so "
        f"the delays are the whole samples after which outputs first answer ({found}): those of "
        f"outputs that begin slowly may be some samples less; give the delays that you know",
        IdentifiabilityWarning,
    )


def _at(experiment, delays, settings):
    """The fit of a record without some delays, its model with them; that record; its warnings."""
    machine = in_machine_time(experiment, delays)
    with held_back() as held:
        fit = _of_record(machine, settings)
    return replace(fit, model=replace(fit.model, delays=delays)), machine, held


def _left(fit, machine):
    """Share of each output's motion that a simulation of a plain model leaves."""
    model, squares, total = fit.model, 0.0, 0.0
    for u, y, x0 in zip(machine.inputs, machine.outputs, fit.x0, strict=True):
        left = y - simulate(model.A, model.B, model.C, model.D, u, x0)
        squares, total = squares + np.sum(left**2, axis=0), total + np.sum(y**2, axis=0)
    return squares / np.where(total > 0.0, total, np.inf)


def _searched(experiment, delays):
    """Whole samples of the delays that are left to the data."""
    basis, dt, m = experiment.basis, experiment.base.sample_time, delays.n_inputs
    if not m:
        raise ValueError("a delay 'auto' is found from inputs, and there are none; give seconds")
    most, count = most_samples(experiment), int(basis.harmonic)
    segments = list(zip(experiment.inputs, experiment.outputs, experiment.phases, strict=True))
    lags = first_answers(segments, most, DEFAULT_BLOCK_ROWS, count)
    samples, told = delays.seconds / dt, np.isfinite(lags)
    names = np.array(delays.names)
    silent = np.concatenate([~told.any(axis=0), ~told.any(axis=1)]) & delays.free
    if silent.any() and basis.harmonic:  # of plain data the likelihood tells
        warn(
            f"no output answers the inputs within {most} samples ({most * dt:.3g} s), so the "
            f"delays of {names[silent].tolist()} are taken as zero; refine them with "
            f"StructuredMatcher(criterion='output_error'), use inputs that move more, or give them",
            IdentifiabilityWarning,
        )
    free_inputs, free_outputs = delays.free[:m], delays.free[m:]
    sums = np.where(told, lags, np.inf)
    if free_outputs.any():
        known = np.where(free_inputs, 0.0, samples[:m])
        first = np.min(sums - known, axis=1)
        if free_inputs.all() and free_outputs.all():  # only sums are told
            first = first - first[0]
        first = np.where(np.isfinite(first), first, 0.0)
        samples[m:] = np.where(free_outputs, np.maximum(first, 0.0), samples[m:])
    if free_inputs.any():
        first = np.min(sums - samples[m:, None], axis=0)
        first = np.where(np.isfinite(first), first, 0.0)
        samples[:m] = np.where(free_inputs, np.maximum(np.rint(first), 0.0), samples[:m])
    free = delays.free.copy()
    if free.all():  # a common shift is seen by nobody
        free[m], samples[m] = False, 0.0
    return replace(delays, free=free).at(samples * dt)


def _refined(fit, machine):
    """Delays of largest likelihood of plain data, with their deviations; None where none is."""
    model, delays = fit.model, machine.delays
    if not model.n_states:
        return None
    try:
        A, B = discrete_to_continuous(model.A, model.B, model.dt)
    except ValueError:  # no continuous model: fractions of a sample mean nothing
        return None
    whole = np.block([[A, B], [model.C, model.D]])[None]
    structure = PeriodicStructure.all_free(whole.shape, model.n_states)
    data = RecordData.of(machine, True, None, gauge=True)
    found = data.fit(structure, structure.nearest(whole), SearchSettings())
    of_delays = found.covariance[structure.n_parameters :]
    return found.data.deviations(found.data.delays_of(delays), of_delays)


def identify_frame(X, y, settings, *delays):
    """Identify a model from a frame and outputs in memory, by the reading that they confirm.

    A frame may carry two readings. The second one is tried if something speaks against the model
    of the first, or if that may be far off by half of what counts as doubt. A model that nothing
    speaks against is kept; of two of them, or of two in doubt, the one that may be less far off,
    unless the first of those in doubt leaves far more of the record.
    In a search, and with block rows given, which are others for each reading, the second one is
    tried only if the first one fails.

    It returns what :func:`identify_record` does.
    """
    other = None if isinstance(X, np.ndarray) else getattr(X, "basis", None)
    other = None if other is None or is_decomposed(y) else other.alternative
    if other is None:
        return identify_record(read_for_fit(X, y), settings, *delays)
    first, doubts, error = _attempt(X, y, settings, delays)
    asked = settings.block_rows is None and not searching()
    if first is None or (asked and _asks_for_another(_far_off(first, doubts))):
        second, others, _ = _attempt(read_as(as_frame(X), other.reading), y, settings, delays)
        if second and (first is None or _is_surer(second, others, first, doubts)):
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


def _far_off(found, held):
    """Whether warnings say that a model is in doubt, how far its exponents may be off, up to all
    of a rate, beyond which no number tells anything, and what it leaves."""
    doubtful = IdentifiabilityWarning, InstabilityWarning
    told = any(category in doubtful for _, category in held)
    return told, min(found[0].doubt, 1.0), found[0].left


def _asks_for_another(far):
    """Whether a model, as :func:`_far_off` has it, is in doubt or may be off by half a doubt."""
    return far > (False, DOUBT / 2.0)


def _is_surer(second, others, first, doubts):
    """Whether the second of two models is to be kept.

    Of two in doubt it is if the first leaves far more of the record. Not the other way round: many
    parameters for the inputs' effect within a period leave less, whatever the multipliers are. Of
    two that nothing speaks against, it has to be known better than asks for another: how far a
    model may be off is itself not well known.
    """
    far, farther = _far_off(second, others), _far_off(first, doubts)
    if far[0] and farther[0] and farther[-1] > DECISIVE * far[-1]:
        return True
    if not farther[0] and _asks_for_another(far):
        return False
    return far < farther


def identify_record(experiment, settings, input_delay=0.0, output_delay=0.0):
    """Identify a model from an experiment in memory, as its reading says.

    It returns the fit, the experiment that the fit is of, in the machine's own time,
    and the basis with the trim that was identified together with the dynamics.
    """
    delays = asked_delays(input_delay, output_delay, experiment)
    if delays is None:
        fit = _of_record(experiment, settings)
    else:
        fit, experiment = without_delays(experiment, delays, settings)
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

    The free decays where inputs rest, else the samples.
    """
    decays, _ = decays_at_rest(experiment)
    if decays:
        parts = smooth_parts(decays)
        found = free_decay(parts)
        return of_free_decays(found and without_products(found, parts), experiment)
    return sample.opinion(experiment)


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
