"""Maximum likelihood of discrete models with all entries free: plain ones, and those of samples.

The search uses predictions (:mod:`sklearn_hd.algorithms.likelihood.free_form`). If some outputs of
a row are missing, outputs and inputs do not determine its predictor: all entries of A, B, C, D and
K are then parameters, and the search begins and ends at the optimum nearby.
"""

from dataclasses import replace

import numpy as np
from scipy import sparse

from sklearn_hd._match.likelihood import uncertainty_of
from sklearn_hd._match.match import Match
from sklearn_hd._match.record_data import Fit, RecordData
from sklearn_hd._match.samples import match_samples
from sklearn_hd._match.trust import trusted, warn_of_slow
from sklearn_hd._sample_model import SampleModel
from sklearn_hd.algorithms.likelihood.free_form import free_form, highest
from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import harmonic_labels


def match_free(model, experiment, settings):
    """A discrete model refined, every entry of its matrices free.

    Parameters
    ----------
    model : LTIModel or SampleModel
        Of rows, or of samples at their azimuths.
    experiment : Experiment
    settings : LikelihoodSettings

    Returns
    -------
    match : Match
    """
    of_samples = isinstance(model, SampleModel)
    start = model if of_samples else _as_samples(model)
    data = RecordData.of(experiment, True, model if of_samples else None, discrete=True)
    complete = all(np.all(np.isfinite(outputs)) for _, outputs, _ in data.segments)
    fit, sampled = (_free if complete else _near)(start, data, settings)
    trust = trusted(fit, experiment, sampled, fit.theta, settings, model.opinion)
    warn_of_slow(fit, trust, experiment)
    uncertainty, structure = uncertainty_of(fit, trust, None, None), fit.structure
    if of_samples:
        match = match_samples(sampled, experiment, None, None)
        match = replace(match, names=structure.parameter_names, theta=fit.theta)
    else:
        A, B, C, D = (M[0] for M in structure.matrices(fit.theta))
        noise = {}
        if settings.predicts:
            gain = sampled.innovations.gain[0]
            noise = {"kalman_gain": gain, "innovations_covariance": fit.result.spread}
        matched = replace(model, A=A, B=B, C=C, D=D, **noise)
        dense = structure.basis.toarray().reshape(-1, *structure.constant.shape[1:])
        affine = AffineStructure(
            structure.constant[0], dense, model.n_states, structure.parameter_names
        )
        everything = np.arange(structure.n_parameters)
        uncertainty = replace(uncertainty, affine=affine, seen=everything, dt=model.dt)
        match = Match(matched, structure.parameter_names, fit.theta, None)
    return replace(
        match, n_iter=fit.result.n_iter, uncertainty=uncertainty, sampled=sampled, structure=None
    )


def _free(start, data, settings):
    """The most likely model, by its predictor; the fit and the model of samples."""
    n, innovations = start.n_states, start.innovations
    whole = innovations.coefficients[: 2 * innovations.n_harmonics + 1]
    free = np.ones((max(len(whole), 2 * data.n_loads + 1), whole.shape[1], whole.shape[2]), bool)
    free[len(whole) :] = False
    free[:, n:, n:] &= start.feedthrough
    free[..., -1] = False
    if data.n_loads < 0:
        whole, free = whole[..., :-1], free[..., :-1]
    else:
        free[: 2 * data.n_loads + 1, n:, -1] = True
    nothing = PeriodicStructure(whole, np.zeros((0, whole.size)), n, ())
    form = data.form(nothing, [])
    found = free_form(
        form,
        data.segments,
        whole,
        free[..., n:],
        gain=innovations.gain[: 2 * innovations.n_harmonics + 1],
        predicts=settings.predicts,
        max_iter=settings.max_iter,
        n_starts=settings.n_starts,
        random_state=settings.random_state,
    )
    entries = found.coefficients.copy()
    own = entries[..., : free.shape[2] - (data.n_loads >= 0)]
    own[2 * highest(own) + 1 :] = 0.0  # rounding of products
    if data.n_loads < 0:
        entries = np.concatenate([entries, np.zeros((*entries.shape[:2], 1))], axis=2)
    gain = np.zeros((1, n, entries.shape[1] - n)) if found.gain is None else found.gain
    moved = replace(innovations, coefficients=entries, gain=gain, covariance=found.result.spread)
    sampled = replace(start, innovations=moved, n_loads=data.n_loads)
    own = entries[: 2 * moved.n_harmonics + 1, :, :-1]
    structure = _structure(own.shape, n, start.feedthrough)
    theta = structure.nearest(own)
    places = _places(structure, found.coefficients.shape)
    into = found.slopes[:, places].T
    covariance = into @ found.result.covariance @ into.T
    result = replace(found.result, theta=theta, gain=found.gain, covariance=covariance)
    return Fit(structure, replace(form, structure=structure), result, data, into), sampled


def _places(structure, shape):
    """Where parameters stand among all coefficients, loads among them."""
    entries = np.unravel_index(structure.basis.indices, structure.constant.shape)
    return np.ravel_multi_index(entries, shape)


def _near(start, data, settings):
    """The most likely model near the start, by the entries of A, B, C, D and K."""
    innovations = start.innovations
    own = innovations.coefficients[: 2 * innovations.n_harmonics + 1, :, :-1]
    structure = _structure(own.shape, start.n_states, start.feedthrough)
    gain = innovations.gain if innovations.gain.any() else None
    fit = data.fit(structure, structure.nearest(own), settings, gain0=gain)
    like = Match(None, (), fit.theta, None, sampled=start)
    return fit, data.sampled(fit, like)


def _as_samples(model):
    """A discrete model without harmonics as one of samples."""
    n, (n_outputs, n_inputs) = model.n_states, model.D.shape
    whole = np.zeros((1, n + n_outputs, n + n_inputs + 1))
    whole[0, :n, :n], whole[0, :n, n:-1] = model.A, model.B
    whole[0, n:, :n], whole[0, n:, n:-1] = model.C, model.D
    gain = np.zeros((1, n, n_outputs)) if model.kalman_gain is None else model.kalman_gain[None]
    innovations = PeriodicInnovations(whole, gain, np.eye(n_outputs), 2.0 * np.pi)
    names = model.input_names, model.output_names
    how = {"feedthrough": model.feedthrough, "delays": model.delays}
    return SampleModel(innovations, 2.0 * np.pi / model.dt, model.dt, *names, **how)


def _structure(shape, n, feedthrough):
    """[A B; C D](ψ) of some harmonics, all entries parameters, D only where there is one."""
    free = np.ones(shape, dtype=bool)
    free[:, n:, n:] = feedthrough
    places = np.flatnonzero(free)
    basis = sparse.csr_array(
        (np.ones(len(places)), (np.arange(len(places)), places)), shape=(len(places), free.size)
    )
    labels = harmonic_labels(range(len(free) // 2 + 1))
    names = []
    for h, i, j in np.argwhere(free):
        row, column = i - n * (i >= n), j - n * (j >= n)
        label = "" if len(free) == 1 else f"_{labels[h]}"
        names.append(f"{'ABCD'[2 * (i >= n) + (j >= n)]}[{row},{column}]{label}")
    return PeriodicStructure(np.zeros(shape), basis, n, tuple(names))
