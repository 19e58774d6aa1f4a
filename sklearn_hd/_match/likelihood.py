"""Maximum likelihood on the raw record, which refines a structured model.

It minimises the residuals of a simulation (``criterion="output_error"``) or of a prediction one
sample ahead (``"prediction_error"``), for periodic and time-invariant models, their steps, and
models of samples about a forced periodic response, whose Fourier coefficients are parameters too.

Maximum likelihood of discrete models with all entries free: plain ones, and those of samples
(:mod:`sklearn_hd.algorithms.likelihood.free_form`).
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sklearn_hd._fit_checks import longest_span
from sklearn_hd._frame import SampleModel
from sklearn_hd._guards import first_of, warn
from sklearn_hd._match import Match, periodic_match
from sklearn_hd._match.affine import decomposed_basis, match_samples
from sklearn_hd._match.input_problem import PATIENCE
from sklearn_hd._match.periodic import warn_in_place_of_states
from sklearn_hd._match.trust import trusted, warn_of_slow
from sklearn_hd._records.delays import as_measured, warn_of_doubt
from sklearn_hd._records.likelihood import Fit, RecordData
from sklearn_hd.algorithms.likelihood.free_form import free_form, highest
from sklearn_hd.algorithms.likelihood.search import OverflowingStartError
from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete
from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.structures import HarmonicStructure

N_HARMONICS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48)
AFFORDABLE = 4.0  # times the parameters of a fit that does not converge, for all of the start's
FIRST_HARMONICS = 2  # of G, and P in Floquet coordinates: more are tried afterwards


def match_likelihood(match, structure, experiment, settings, opinion):
    """A match refined to the largest likelihood of the record, in the same structure.

    Numbers of harmonics that the structure asked for leaves open are chosen here. The opinion is
    the second one of the record, or None.
    """
    if match.structure is None:
        raise ValueError(
            f"criterion={settings.criterion!r} needs a structure whose parameters the record "
            f"determines; give a MatrixStructure or a HarmonicStructure"
        )
    periodic, delays = match.periodic, match.model.delays
    size = None if periodic is None else periodic.input_size
    data = RecordData.of(experiment, periodic is not None, match.sampled, input_size=size)
    if data.cells is not None and settings.input_noise is not None:
        raise ValueError(
            "input_noise needs inputs that switch at samples, but delays that are 'auto' or not "
            "whole samples make them switch in between; give delays of whole samples, or leave "
            "input_noise=None"
        )
    wanted = HarmonicStructure() if structure is None else structure
    bounds = (structure.lower, structure.upper) if periodic is None else None
    open_to = _open_counts(match, wanted)
    if open_to:
        fit = _refine_harmonics(match, wanted, open_to, data, settings)
    else:
        fit = data.fit(match.structure, match.theta, settings, bounds=bounds)
    data, delays = fit.data, fit.data.delays_of(delays)
    experiment, sampled = data.experiment, data.sampled(fit, match)
    trust = trusted(fit, experiment, sampled, fit.result.point.theta, settings, opinion)
    warn_of_slow(fit, trust, experiment)
    if data.cells is not None:
        delays = data.deviations(delays, trust.covariance[fit.structure.n_parameters :])
        warn_of_doubt(delays)
        sampled = replace(sampled, delays=delays)
    trust = _without_delays(fit, trust)
    if periodic is None:
        refined = _invariant(match, structure, fit, trust)
    else:
        basis = experiment.basis
        if match.sampled is not None:
            basis = decomposed_basis(match.sampled, basis)
        refined = _periodic(match, fit, basis, trust)
        if trust.kind == "robust" and match.sampled is None and "G" in open_to:
            why = "the residuals of the fit are not white noise"
            warn_in_place_of_states(refined.periodic, why)
    warn_unidentified(fit.result)
    model = replace(refined.model, delays=delays)
    waveform = _trim_error(fit, trust, experiment, delays)
    return replace(
        refined, model=model, n_iter=fit.result.n_iter, sampled=sampled, waveform=waveform
    )


def _without_delays(fit, trust):
    """What a fit says of the parameters of its structure alone."""
    k = fit.structure.n_parameters
    return replace(trust, covariance=trust.covariance[:k, :k])


def _trim_error(fit, trust, experiment, delays):
    """What the trim that was subtracted is off by, at the rows where it was measured; or None.

    A mode that lasts longer than the record is such a waveform itself: nothing parts them.
    """
    waveform = fit.result.problem.waveform(fit.result.point)
    slowest, longest = np.max(trust.exponents.real, initial=-np.inf), longest_span(experiment)
    if waveform is None or -slowest * longest < 1.0:
        return None
    cells = fit.data.cells
    if cells is not None:  # of which the model holds the fractions
        lags = np.concatenate([cells.input_lags, cells.output_lags])
        delays = delays.at(lags * experiment.base.sample_time)
    return as_measured(waveform, delays, experiment.basis)


def _periodic(match, fit, basis, trust):
    periodic = replace(match.periodic, coefficients=fit.structure.coefficients(fit.theta))
    affine, seen = periodic.decomposed_structure(fit.structure, basis)
    refined = periodic_match(fit.structure, fit.theta, periodic, match.model, basis)
    return replace(refined, uncertainty=replace(trust, affine=affine, seen=seen))


def _invariant(match, structure, fit, trust):
    matrices = [M[0] for M in fit.structure.matrices(fit.theta)]
    everything = np.arange(fit.structure.n_parameters)
    return replace(
        match,
        model=match.model.in_continuous_time(*matrices, state_names=match.model.state_names),
        theta=fit.theta,
        found=None,  # that of the start
        uncertainty=replace(trust, affine=structure.affine, seen=everything),
    )


def _open_counts(match, structure):
    """Names of the matrices whose number of harmonics the data choose, first things first.

    In Floquet coordinates F is constant, and shapes take up the difference.
    """
    if match.periodic is None:
        return ""
    names = "FG" if match.periodic.physical else "PG"
    return "".join(name for name in names if structure.n_harmonics(name) is None)


def _structures(match, structure, open_to):
    """Structures by their numbers of harmonics."""
    periodic = match.periodic
    signals = periodic.state_names, periodic.input_names, periodic.output_names
    if periodic.physical:
        fixed = {name: structure.n_harmonics(name) for name in "FGP" if name not in open_to}
        if fixed["P"] is None and set(periodic.state_names) != set(periodic.output_names):
            fixed["P"] = periodic.highest("P")  # else P is the identity
        fixed["Q"] = periodic.highest("Q") if periodic.matrices()[3].any() else None
        return lambda counts: structure.resolve(*signals, {**fixed, **counts})
    full, n = match.structure, periodic.n_states
    entries = full.basis.tocoo()
    harmonic, row, column = np.unravel_index(entries.coords[1], full.constant.shape)
    own = (row >= n) if "P" in open_to else np.zeros(len(row), dtype=bool)
    highest = {"P": own & (column < n), "G": (row < n) & (column >= n)}

    def restricted(counts):
        beyond = np.zeros(full.n_parameters, dtype=bool)
        for name, count in counts.items():
            beyond[entries.coords[0][highest[name] & (harmonic > 2 * count)]] = True
        return full.restricted(np.flatnonzero(~beyond))

    return restricted


def _refine_harmonics(match, structure, open_to, data, settings):
    """The fit of a periodic structure with as many harmonics as the data show.

    From the number of the start up and down, as long as Akaike's criterion falls: first
    of F (of P in Floquet coordinates), then of G. It takes a harmonic too many now and then,
    which widens the intervals; Schwarz's leaves out some that are there, and the intervals then
    miss the truth (the rotor blade's by four standard deviations). Noise on the inputs, where it
    is allowed for, looks like harmonics of G if it is not: it comes in before G is judged.

    Few harmonics may not converge where the start's own do: then it begins with all of these.
    """
    start, of_counts = match.periodic, _structures(match, structure, open_to)
    highest = int(np.ceil(data.n_phases / 2.0)) - 1
    every = {name: min(start.highest(name), highest) for name in open_to}
    first = {
        name: count // 2 if name == "F" else min(count, FIRST_HARMONICS)
        for name, count in every.items()
    }

    def fit(counts, near, settings, like=None):
        chosen = of_counts(counts)
        found = data.fit(chosen, chosen.nearest(near), settings, like=like, coarse=True)
        return _Candidate(counts, found)

    exact = replace(settings, input_noise=None)
    best = begun = fit(first, start.coefficients, exact)
    if not begun.fit.result.converged:  # others would not be judged beside it
        if of_counts(every).n_parameters <= AFFORDABLE * begun.fit.structure.n_parameters:
            best = fit(every, start.coefficients, exact)
        if not best.fit.result.converged:
            return min(begun.fit, best.fit, key=lambda each: each.result.aic)
        begun = best
    for name in open_to:
        if name == "G" and settings.input_noise is not None:
            exact = settings
            best = fit(best.counts, best.coefficients, exact)
        for step in (1, -1):
            now = best.counts[name]
            most = highest if start.physical else every[name]
            ahead = [k for k in N_HARMONICS if k <= most and (k - now) * step > 0][::step]
            best = _climb(best, name, ahead, partial(fit, settings=exact))
    if settings.predicts and best is not begun:  # K answers for what a structure cannot
        again = fit(best.counts, best.coefficients, settings)
        best = min(best, again, key=lambda candidate: candidate.fit.result.aic)
    return data.fit(best.fit.structure, best.fit.theta, settings, like=best.fit)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A fit with some numbers of harmonics."""

    counts: dict
    fit: Fit

    @property
    def coefficients(self):
        """Of its model."""
        return self.fit.structure.coefficients(self.fit.theta)


def _climb(best, name, ahead, fit):
    """The best candidate on the way through some numbers of harmonics."""
    at, worse = best, 0
    for count in ahead:
        try:
            at = fit({**at.counts, name: count}, at.coefficients, like=at.fit)
        except OverflowingStartError:
            break
        if not at.fit.result.converged:
            break
        worse = 0 if at.fit.result.aic < best.fit.result.aic else worse + 1
        best = at if worse == 0 else best
        # still fewer harmonics fit worse, if anything, so none has a smaller criterion
        hopeless = count < best.counts[name] and 2.0 * at.fit.result.cost >= best.fit.result.aic
        if worse == PATIENCE or hopeless:
            break
    return best


def warn_closed_loop():
    """Of maximum likelihood of a simulation, after a model identified in closed loop."""
    warn(
        "criterion='output_error' simulates the record and treats all residuals as noise of the "
        "sensors; this is biased where disturbances move the machine and feedback reacts to them, "
        "and weighting='pbsid' indicated that inputs may react to outputs: use "
        "criterion='prediction_error', or ignore this if only the sensors are noisy",
        IdentifiabilityWarning,
    )


def warn_unidentified(result):
    """Of parameters that a fit by maximum likelihood leaves open."""
    if result.unidentified:
        warn(
            f"the record does not determine {first_of(result.unidentified)} (only some "
            f"combinations of them): their standard deviation is infinite; fix some, share a name, "
            f"or use a richer record",
            IdentifiabilityWarning,
        )


def match_free(model, experiment, settings):
    """The match of a model refined, every entry of its matrices free.

    It is an LTIModel of rows, or a SampleModel of samples at their azimuths.
    """
    of_samples = isinstance(model, SampleModel)
    if not of_samples and model.dt == 0.0:  # behind a reducer
        dt = experiment.base.sample_time
        A, B = continuous_to_discrete(model.A, model.B, dt)
        model = replace(model, A=A, B=B, dt=dt)
    start = model if of_samples else _as_samples(model)
    data = RecordData.of(experiment, True, model if of_samples else None, discrete=True)
    fit, sampled = _free(start, data, settings)
    trust = trusted(fit, experiment, sampled, fit.theta, settings, model.opinion)
    warn_of_slow(fit, trust, experiment)
    uncertainty, structure = _without_delays(fit, trust), fit.structure
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
    structure = PeriodicStructure.all_free(own.shape, n, start.feedthrough)
    theta = structure.nearest(own)
    where = np.unravel_index(structure.basis.indices, structure.constant.shape)
    places = np.ravel_multi_index(where, found.coefficients.shape)  # loads are among these
    into = found.slopes[:, places].T
    covariance = into @ found.result.covariance @ into.T
    result = replace(found.result, theta=theta, gain=found.gain, covariance=covariance)
    return Fit(structure, replace(form, structure=structure), result, data, into), sampled


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
