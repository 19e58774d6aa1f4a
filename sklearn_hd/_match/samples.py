"""Closed form from a model of samples at their azimuths to the continuous one behind it.

1. The continuous model with these samples; its states are outputs if possible.
2. The parameters of a structure whose steps over a turn are closest to it.
3. Its samples, about the forced response of the identified model, for ``predict``.
"""

from dataclasses import replace

import numpy as np
from scipy import linalg

from sklearn_hd._continuous import input_scale, output_scale, to_continuous
from sklearn_hd._match.affine import match_affine
from sklearn_hd._match.match import PeriodicModel, periodic_match
from sklearn_hd._match.periodic import state_outputs, warn_coordinates
from sklearn_hd._readings import coefficient_names
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.periodic.behind_samples import nearest_steps, turn_of
from sklearn_hd.algorithms.periodic.floquet_coordinates import fixed_scale
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning
from sklearn_hd.structures import HarmonicStructure, MatrixStructure

MOST_ROWS = 10_000  # of a segment, on which responses are compared
UNLIKE = 1e-2  # of the response's variance, that a structure may leave without a word


def match_samples(model, experiment, structure, settings):
    """The match of a model of samples.

    Parameters
    ----------
    model : SampleModel
    experiment : Experiment
    structure : MatrixStructure, HarmonicStructure or None
        None leaves the model as it is.
    settings : NormSettings

    Returns
    -------
    match : Match
    """
    if isinstance(structure, HarmonicStructure) or not model.time_invariant:
        match = _periodic(model, experiment, structure)
        coefficients, n = match.periodic.coefficients, match.periodic.n_states
    else:
        continuous = to_continuous(model.to_lti(), experiment)
        match = match_affine(continuous, experiment, structure, settings)
        found = match.model
        coefficients, n = np.block([[found.A, found.B], [found.C, found.D]])[None], found.n_states
    sampled = model.of_matched(coefficients, n, max(1, experiment.basis.most_loads))
    _warn_unlike(sampled, model, experiment, structure)
    return replace(match, sampled=sampled)


def _periodic(model, experiment, structure):
    """The periodic model, and its structure."""
    if isinstance(structure, MatrixStructure):
        raise ValueError(
            f"a MatrixStructure is time-invariant, but the identified model has coefficients of "
            f"{model.innovations.n_harmonics} harmonic(s) of the turn; give a HarmonicStructure, "
            f"or identify without them: HarmonicAnalyzer(reading='sample', output_harmonics=0)"
        )
    basis, innovations = experiment.basis, model.innovations
    asked = HarmonicStructure() if structure is None else structure
    if asked.n_states not in (None, model.n_states):
        raise ValueError(
            f"the structure has {asked.n_states} states, but the identified model has "
            f"{model.n_states}; identify with MOESPRegressor(order={asked.n_states}), or change "
            f"the structure"
        )
    turn = turn_of(innovations, model.omega)
    names = list(model.output_names)
    found = turn.model(
        state_outputs(asked, names, model.n_states, turn.choices(), turn.determined_by)
    )
    signals = found.state_names(names), model.input_names, model.output_names
    given = "FGPQ" if structure is None and model.feedthrough else "FGP"
    counts = {name: len(getattr(found, name)) // 2 for name in given}
    if structure is not None and found.rows is not None:  # no more than the data show
        counts = dict.fromkeys("FGP", innovations.n_harmonics)
    full = asked.resolve(*signals, counts, form=found.form)
    n_phases = max(len(turn.psi), 2 * full.n_harmonics + 2)
    weights = _weights(found, model, experiment)
    theta = nearest_steps(full, found.coefficients, model.omega, n_phases, weights)
    periodic = PeriodicModel(full.coefficients(theta), model.omega, *signals)
    warn_coordinates(periodic)
    if found.form is not None:
        full, theta = fixed_scale(full, theta, found.form)
    return periodic_match(full, theta, periodic, *_decomposed(model, basis))


def decomposed_basis(match, experiment):
    """The signals of the harmonic decomposition of a match of samples."""
    return _decomposed(match.sampled, experiment.basis)[1]


def _weights(found, model, experiment):
    """Of the errors of steps: those of predictions one step ahead, in parts of the innovations."""
    u, y = input_scale(experiment), output_scale(experiment)
    noise = model.innovations_covariance / y[:, None] / y
    outputs = linalg.inv(linalg.cholesky(noise + EXACT * np.eye(len(y)), lower=True)) / y
    if found.rows is None:
        seen = np.sqrt(np.mean(np.sum((found.P / y[:, None]) ** 2, axis=0), axis=0))
        seen = np.where(seen > 0.0, seen, 1.0)
        return np.diag(seen), outputs, np.diag(np.concatenate([1.0 / seen, u]))
    loads = model.innovations.forced_response(max(1, experiment.basis.most_loads))
    moving = [
        np.hstack([(Y - evaluate_harmonics(loads, psi))[:, found.rows], U])
        for U, Y, psi in zip(experiment.drive, experiment.outputs, experiment.phases, strict=True)
    ]
    R = linalg.qr(np.vstack(moving), mode="r")[0]
    R = R[: R.shape[1]] / np.sqrt(sum(map(len, moving)))
    own = noise[np.ix_(found.rows, found.rows)]
    states = linalg.inv(linalg.cholesky(own + EXACT * np.eye(len(own)), lower=True))
    return states / y[found.rows], outputs, R.T


def _decomposed(model, basis):
    """Signals of a harmonic decomposition of as many harmonics as the model has."""
    orders = tuple(range(model.innovations.n_harmonics + 1))
    basis = replace(basis, outputs=tuple((name, orders) for name, _ in basis.outputs))
    names = coefficient_names(basis.inputs), coefficient_names(basis.outputs)
    like = replace(model.to_lti(), input_names=names[0], output_names=names[1])
    return like, basis


def _warn_unlike(sampled, model, experiment, structure):
    """Of a match that grows e-fold within a segment, or responds otherwise, where the model
    identified does not."""
    longest = max(map(len, experiment.outputs))
    if longest * model.innovations.growth() > 1.0:  # it has been warned of
        return
    rate = sampled.innovations.growth()
    way = "give the structure more harmonics, Q where there is a feedthrough, or fewer fixed "
    way += "entries, or leave structure=None"
    if structure is None:
        way = (
            f"{experiment.basis.samples_per_period:.4g} samples per turn determine too few "
            f"harmonics of a model in continuous time; sample more often, or use the model of "
            f"MOESPRegressor"
        )
    if longest * rate > 1.0:
        radius = np.max(np.abs(sampled.innovations.multipliers()))
        warn(
            f"the matched model has a multiplier of size {radius:.4g} per turn, so it grows by a "
            f"factor of {np.exp(min(rate * longest, 700.0)):.3g} over the longest segment, "
            f"although the identified model is stable; {way}",
            InstabilityWarning,
        )
        return
    left, there = 0.0, 0.0
    for u, psi in zip(experiment.drive, experiment.phases, strict=True):
        found, wanted = (
            _response(each, u[:MOST_ROWS], psi[:MOST_ROWS]) for each in (sampled, model)
        )
        left = left + np.sum((found - wanted) ** 2, axis=0)
        there = there + np.sum(wanted**2, axis=0)
    share = np.max(left / np.where(there > 0.0, there, np.inf))
    if share > UNLIKE:
        warn(
            f"the match does not reproduce {share:.2g} of the variance of the identified model's "
            f"response to the inputs; {way}",
            IdentifiabilityWarning,
        )


def _response(model, u, psi):
    """What the inputs do to the outputs from rest."""
    rows, rest = model.innovations.rows(psi), np.zeros(model.n_states)
    return rows.simulated(u, rest) - rows.simulated(np.zeros_like(u), rest)
