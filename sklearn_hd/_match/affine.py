"""Step 5 in a norm: a structure affine in its parameters, matched to a continuous model (Eq. 22).

A MatrixStructure is affine itself; a HarmonicStructure is affine in the harmonic decomposition of
its periodic system. The matcher takes this route for all models except those of whole periods, and
for the start of maximum likelihood.

Closed form from a model of samples at their azimuths to the continuous one behind it.

1. The continuous model with these samples; its states are outputs if possible.
2. The parameters of a structure whose steps over a turn are closest to it.
3. Its samples, about the forced response of the identified model, for ``predict``.
"""

from collections.abc import Mapping
from dataclasses import replace
from numbers import Real

import numpy as np
import pandas as pd
from scipy import linalg
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._checks import LITTLE
from sklearn_hd._fit_checks import grows_by
from sklearn_hd._guards import first_of, warn
from sklearn_hd._match import Match, PeriodicModel, periodic_match
from sklearn_hd._match.periodic import check_n_states, state_outputs, warn_coordinates
from sklearn_hd._readings import highest_harmonic
from sklearn_hd._records.data import input_scale, output_scale, to_continuous
from sklearn_hd._simulators import sample_simulators
from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.lti.hinf import check_stable
from sklearn_hd.algorithms.lti.simulation import GROWN, frequency_response
from sklearn_hd.algorithms.matching.matching import match_structure
from sklearn_hd.algorithms.matching.matching_problem import channel_scales, matching_grid
from sklearn_hd.algorithms.periodic.behind_samples import nearest_steps, turn_of
from sklearn_hd.algorithms.periodic.floquet_coordinates import fixed_scale
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning, UnstableModelError
from sklearn_hd.structures import HarmonicStructure, MatrixStructure

POOR_MATCH = 1e-2  # relative error of a match between different orders worth a warning
RUNAWAY = 1e4  # speed of a pole, relative to the model's fastest, that is a feedthrough's
FLOOR = 0.5  # share of the error that fixed entries of D leave, above which they decide it
MOST_ROWS = 10_000  # of a segment, on which responses are compared


def match_affine(model, experiment, structure, settings):
    """The structure matched to a continuous LTIModel in the norm of the criterion.

    A structure of None leaves the model as it is.
    """
    if structure is None:
        return _unchanged(model)
    if isinstance(structure, HarmonicStructure):
        return _match_decomposition(model, experiment, structure, settings)
    _check_channels(structure, model)
    bounds = structure.lower, structure.upper
    found = _matched(model, structure.affine, settings, structure.initial, bounds)
    matrices = found.A, found.B, found.C, found.D
    return Match(
        model.in_continuous_time(*matrices, state_names=_state_names(structure, model)),
        structure.parameter_names,
        found.theta,
        PeriodicStructure.time_invariant(structure.affine),
    ).by(found)


def _matched(model, affine, settings, initial=None, bounds=None):
    """The MatchResult of an affine structure, channels scaled alike beside their weights."""
    if affine.n_parameters == 0:
        raise ValueError(
            "the structure has no free parameter, so there is nothing to match: set entries to NaN "
            "or names, or free some of the fixed ones"
        )
    outputs = read_weights("output_weights", settings.output_weights, model.output_names)
    inputs = read_weights("input_weights", settings.input_weights, model.input_names)
    check_stable(model.A, None)
    poles = np.linalg.eigvals(model.A)
    grid = matching_grid(poles)
    s = 1j * grid[np.isfinite(grid)]
    scales = channel_scales(frequency_response(model.A, model.B, model.C, model.D, s))
    found = match_structure(
        model.A,
        model.B,
        model.C,
        model.D,
        affine,
        criterion="hinf" if settings.criterion == "hinf" else "least_squares",
        theta0=initial,
        bounds=bounds,
        output_weights=scales[0] * outputs,
        input_weights=scales[1] * inputs,
        emphasis=(outputs, inputs),
        n_starts=settings.n_starts,
        random_state=settings.random_state,
        max_iter=settings.max_iter,
    )
    warn_matched(found, settings.criterion, poles, affine)
    return found


def _match_decomposition(model, experiment, structure, settings):
    """The periodic system whose harmonic decomposition is nearest to the model."""
    basis = experiment.basis
    if not basis.harmonic:
        raise ValueError(
            "a HarmonicStructure needs the fundamental frequency, but X carries no harmonic basis; "
            "put a HarmonicAnalyzer before the model"
        )
    inputs, outputs = (tuple(s for s, _ in kept) for kept in (basis.inputs, basis.outputs))
    if structure.states is not None and set(structure.states) != set(outputs):
        raise ValueError(
            f"states={list(structure.states)} are not the outputs {list(outputs)}, whose "
            f"coefficients are the states of a harmonic decomposition; name these, or use "
            f"HarmonicAnalyzer(reading='period')"
        )
    driven, measured = map(highest_harmonic, (basis.inputs, basis.outputs))
    n_harmonics = {"F": 2 * measured, "G": driven + measured, "P": None}
    full = structure.resolve(outputs, inputs, outputs, n_harmonics)
    zero = np.zeros(full.n_parameters)
    periodic = PeriodicModel(full.coefficients(zero), basis.omega, outputs, inputs, outputs)
    affine, seen = periodic.decomposed_structure(full, basis)
    found = _matched(model, affine, settings)
    if settings.likely:  # the raw record sees them all
        resolved, theta = full, zero
        theta[seen] = found.theta
    else:
        resolved, theta = full.restricted(seen), found.theta
    periodic = replace(periodic, coefficients=resolved.coefficients(theta))
    if not settings.likely:  # which goes on from here
        _check_record(periodic, experiment, found.relative_error)
    return periodic_match(resolved, theta, periodic, model, basis, found)


def _check_record(periodic, experiment, error):
    """Raise ValueError if a periodic model explains less of the record than nothing at all."""
    sampled, left, there = periodic.sampled(experiment.base.sample_time), 0.0, 0.0
    for simulator, y in zip(
        sample_simulators(sampled, experiment), experiment.outputs, strict=True
    ):
        rest = simulator.form.left(simulator.drive, y)
        left = left + (np.full(y.shape[1], np.inf) if rest is None else np.sum(rest**2, axis=0))
        there = there + np.sum(y**2, axis=0)
    share = np.max(left[there > 0.0] / there[there > 0.0], initial=0.0)
    if share > 1.0:
        radius = np.max(np.abs(sampled.eigenvalues()))
        kind = ValueError if radius < 1.0 else UnstableModelError
        raise kind(
            f"the matched periodic model leaves {share:.3g} times the variance of an output in its "
            f"own training record, even from the best initial state (largest Floquet multiplier "
            f"{radius:.3g}), although its harmonic decomposition is within {error:.2g} of the "
            f"identified model: too few harmonics are kept to determine the periodic model; "
            f"identify with HarmonicAnalyzer(reading='period'), fit to the record itself "
            f"(criterion='output_error'), or keep the model as it is (structure=None)"
        )


def read_weights(name, given, channels):
    """Array of positive numbers by channel; what is not named in a mapping weighs 1.

    Given may be None, a number, a sequence or a mapping; ``name`` is the parameter's, for messages.
    """
    channels = list(channels)
    allowed = "a positive number, one for each channel, or a dict of them by channel"
    if given is None or _is_number(given):
        by_channel = dict.fromkeys(channels, 1.0 if given is None else given)
    elif isinstance(given, Mapping | pd.Series):
        by_channel = dict(given)
    elif isinstance(given, list | tuple | np.ndarray) and len(given) == len(channels):
        by_channel = dict(zip(channels, given, strict=True))
    else:
        raise ValueError(f"{name}={given!r} is not understood for {channels}; give {allowed}")
    unknown = [channel for channel in by_channel if channel not in channels]
    if unknown:
        raise ValueError(f"{name} names {unknown}, but the model has the channels {channels}")
    for channel, weight in by_channel.items():
        if not _is_number(weight):
            raise ValueError(f"{name}[{channel!r}]={weight!r} is not understood; give {allowed}")
    weights = np.array([float(by_channel.get(channel, 1.0)) for channel in channels])
    if not (np.all(np.isfinite(weights)) and np.all(weights > 0)):
        raise ValueError(f"{name}={given!r}: weights must be positive and finite; give {allowed}")
    return weights


def _is_number(value):
    return isinstance(value, Real) and not isinstance(value, bool)


def _check_channels(structure, model):
    """Raise unless the structure has the model's inputs and outputs."""
    for what, given, there in (
        ("inputs", structure.n_inputs, model.input_names),
        ("outputs", structure.n_outputs, model.output_names),
    ):
        if given != len(there):
            raise ValueError(
                f"the structure has {given} {what}, but the identified model has {len(there)}: "
                f"{list(there)}; give B, C and D of that size, or change the harmonics kept"
            )
    for what, given, there in (
        ("inputs", structure.input_names, model.input_names),
        ("outputs", structure.output_names, model.output_names),
    ):
        if given is not None and tuple(given) != tuple(there):
            raise ValueError(
                f"the structure names its {what} {list(given)}, but the identified model has "
                f"{list(there)}; give the same names in the same order"
            )


def _state_names(structure, model):
    """Names of the states: the structure's, or those of the outputs where C is the identity."""
    if structure.state_names is not None:
        return tuple(structure.state_names)
    n = structure.n_states
    C = structure.affine.constant[n:, :n]
    fixed = not structure.affine.basis[:, n:, :n].any()
    return model.output_names if fixed and np.array_equal(C, np.eye(n)) else None


def _unchanged(model):
    """No structure: every entry is a parameter, and the model stays as it is."""
    matrices = (model.A, model.B, model.C, model.D)
    names = tuple(
        f"{name}[{i},{j}]"
        for name, M in zip("ABCD", matrices, strict=True)
        for i, j in np.ndindex(M.shape)
    )
    theta = np.concatenate([M.ravel() for M in matrices])
    return Match(model, names, theta, None)


def warn_matched(result, criterion, poles, affine):
    """Of a match in a norm of an affine structure to a model with some poles."""
    n_found, n_wanted = len(poles), affine.n_states
    if n_found != n_wanted and result.relative_error > POOR_MATCH:
        warn(
            f"the model has {n_found} states, the structure has {n_wanted}, and the match leaves a "
            f"relative error of {result.relative_error:.2g}; the structure may not be that of the "
            f"system, or SpuriousModeReducer(n_states={n_wanted}) is needed",
            IdentifiabilityWarning,
        )
    if result.feedthrough_floor > FLOOR * result.hinf_error and not result.exact:
        warn(
            f"the structure cannot have the feedthrough of the model: fixed entries of D leave "
            f"{result.feedthrough_floor / result.hinf_error:.0%} of the error at infinite "
            f"frequency, whatever the parameters; free them, or give high frequencies less weight "
            f"(output_weights)",
            IdentifiabilityWarning,
        )
    fastest = np.abs(poles).max(initial=0.0)
    speed, halfway = (
        np.abs(affine.poles(share * result.theta)).max(initial=0.0) for share in (1.0, 0.5)
    )
    held_by_parameters = abs(speed - halfway) > 0.01 * speed
    if speed > RUNAWAY * fastest > 0 and held_by_parameters and not result.exact:
        warn(
            f"the match has a pole of {speed:.2g} rad/s, {speed / fastest:.1g} times the fastest "
            f"pole of the model: the best match lies at infinity, where that pole becomes a "
            f"feedthrough; free entries of D, or give bounds to the parameters that grew",
            IdentifiabilityWarning,
        )
    if result.unidentified:
        warn(
            f"these outputs do not determine {first_of(result.unidentified)} (only some "
            f"combinations of them): fix some, share a name, or measure more outputs",
            IdentifiabilityWarning,
        )
    if not result.converged:
        name = "H-infinity" if criterion == "hinf" else "least-squares"
        warn(
            f"the {name} match stopped after {result.n_iter} steps at a relative error of "
            f"{result.relative_error:.3g}, which could still fall by a share of "
            f"{result.left:.2g} ({result.tolerance:g} counts as converged); raise max_iter or "
            f"n_starts",
            ConvergenceWarning,
        )


def match_samples(model, experiment, structure, settings):
    """The match of a SampleModel; a structure of None leaves it as it is."""
    if isinstance(structure, HarmonicStructure) or not model.time_invariant:
        match = _periodic(model, experiment, structure)
        coefficients, n = match.periodic.coefficients, match.periodic.n_states
    else:
        continuous = to_continuous(model.to_lti(), experiment)
        match = match_affine(continuous, experiment, structure, settings)
        found = match.model
        coefficients, n = np.block([[found.A, found.B], [found.C, found.D]])[None], found.n_states
    sampled = model.of_matched(coefficients, n)
    harmonic = isinstance(structure, HarmonicStructure)
    constrained = structure is not None and not (harmonic and structure.left_open)
    few = harmonic and not (constrained or model.time_invariant) and match.periodic.physical
    unlike = _unlike(sampled, model, experiment, within_noise=few)
    if unlike is None:
        return replace(match, sampled=sampled)
    if few:  # harmonics, which F was allowed
        return match_samples(model, experiment, None, settings)
    words, category = unlike
    if constrained:
        way = "give the structure more harmonics, Q where there is a feedthrough, or fewer fixed "
        way += "entries, or leave structure=None"
    else:
        most = model.innovations.n_harmonics
        fewer = f"fewer than {most} harmonics (output_harmonics=), " if most > 1 else ""
        way = (
            f"its {model.n_states} states change faster than "
            f"{experiment.basis.samples_per_period:.4g} samples per turn show of a continuous "
            f"model; use {fewer}a lower order, or sample more often"
        )
        if settings is None or not settings.likely:
            way = f"predict simulates the identified model; ltp_, system_ and theta_ fail: {way}"
            sampled = model
    warn(f"{words}; {way}", category)
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
    check_n_states(asked, model)
    turn = turn_of(innovations, model.omega)
    names = list(model.output_names)
    found = turn.model(
        state_outputs(asked, names, model.n_states, turn.choices(), turn.determined_by)
    )
    signals = found.state_names(names), model.input_names, model.output_names
    given = "FGPQ" if model.feedthrough else "FGP"
    counts = {name: len(getattr(found, name)) // 2 for name in given}
    if structure is not None and found.rows is not None:  # no more than the data show
        counts = dict.fromkeys(given, innovations.n_harmonics)
    full = asked.resolve(*signals, counts, form=found.form)
    n_phases = max(len(turn.psi), 2 * full.n_harmonics + 2)
    weights = _weights(found, model, experiment)
    theta = nearest_steps(full, found.coefficients, model.omega, n_phases, weights)
    periodic = PeriodicModel(full.coefficients(theta), model.omega, *signals)
    warn_coordinates(periodic)
    if found.form is not None:
        full, theta = fixed_scale(full, theta, found.form)
    return periodic_match(full, theta, periodic, model.to_lti(), decomposed_basis(model, basis))


def decomposed_basis(model, basis):
    """The signals of a decomposition of as many harmonics as a SampleModel has."""
    orders = tuple(range(model.innovations.n_harmonics + 1))
    return replace(basis, outputs=tuple((name, orders) for name, _ in basis.outputs))


def _weights(found, model, experiment):
    """Of the errors of steps: those of predictions one step ahead, in parts of the innovations."""
    u, y = input_scale(experiment), output_scale(experiment)
    noise = model.innovations_covariance / y[:, None] / y
    outputs = linalg.inv(linalg.cholesky(noise + EXACT * np.eye(len(y)), lower=True)) / y
    if found.rows is None:
        seen = np.sqrt(np.mean(np.sum((found.P / y[:, None]) ** 2, axis=0), axis=0))
        seen = np.where(seen > 0.0, seen, 1.0)
        return np.diag(seen), outputs, np.diag(np.concatenate([1.0 / seen, u]))
    moving = [
        np.hstack([(Y - model.forced(psi))[:, found.rows], model.moving(U, psi)])
        for U, Y, psi in zip(experiment.drive, experiment.outputs, experiment.phases, strict=True)
    ]
    R = linalg.qr(np.vstack(moving), mode="r")[0]
    R = R[: R.shape[1]] / np.sqrt(sum(map(len, moving)))
    own = noise[np.ix_(found.rows, found.rows)]
    states = linalg.inv(linalg.cholesky(own + EXACT * np.eye(len(own)), lower=True))
    return states / y[found.rows], outputs, R.T


def _unlike(sampled, model, experiment, within_noise):
    """Words and kind of warning of a match that grows e-fold within a segment, or responds
    otherwise, where the model identified does not; None where it is like that model.

    Responses are alike if they differ by less than a hundredth of their variance, and, if asked
    for, by no more than noise leaves unknown. The sum of squares over all rows and outputs that p
    coefficients leave unknown is p times the variance of a row.
    """
    longest = max(map(len, experiment.outputs))
    if longest * model.innovations.growth() > GROWN:  # it has been warned of
        return None
    folds = longest * sampled.innovations.growth()
    if folds > GROWN:
        radius = np.max(np.abs(sampled.innovations.multipliers()))
        return (
            f"the matched model has a multiplier of size {radius:.4g} per turn, so it "
            f"{grows_by(folds)} over the longest segment, although the identified model is stable",
            InstabilityWarning,
        )
    left, there = 0.0, 0.0
    for u, psi in zip(experiment.drive, experiment.phases, strict=True):
        found, wanted = (
            _response(each, model.moving(u, psi)[:MOST_ROWS], psi[:MOST_ROWS])
            for each in (sampled, model)
        )
        left = left + np.sum((found - wanted) ** 2, axis=0)
        there = there + np.sum(wanted**2, axis=0)
    most = LITTLE * there
    if within_noise:
        n_coefficients = np.count_nonzero(model.innovations.coefficients[..., :-1])  # but for loads
        noise = np.diag(model.innovations_covariance)
        most = np.minimum(most, n_coefficients / len(noise) * noise)
    if not np.any((left > most) & (there > 0.0)):  # an output at rest has rounding alone
        return None
    share = np.max(left / np.where(there > 0.0, there, np.inf))
    return (
        f"the matched model's response to the inputs differs from the identified model's by "
        f"{share:.2g} times its variance",
        IdentifiabilityWarning,
    )


def _response(model, u, psi):
    """What the inputs do to the outputs from rest."""
    rows, rest = model.innovations.rows(psi), np.zeros(model.n_states)
    return rows.simulated(u, rest) - rows.simulated(np.zeros_like(u), rest)
