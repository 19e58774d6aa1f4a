"""Closed form from a period-synchronous model to the linear time-periodic one behind it.

1. The identified Poincaré map Φ and the outputs that each sample of the period makes of the
   state give the mode shapes P(ψ) and R = log(Φ)/T.
2. F(ψ) = (P′ + P R) P⁻¹ if the outputs determine the state; otherwise Floquet coordinates,
   in which F = R and the outputs are P(ψ) x.
3. The smoothest G(ψ), and Q(ψ), by linear least squares on the raw record.
"""

from itertools import combinations

import numpy as np
from scipy import linalg

from sklearn_hd._checks import DECISIVE, LITTLE, STANDARD_ERRORS
from sklearn_hd._fit_checks import grows, grows_by, longest_span
from sklearn_hd._guards import first_of, searching, warn
from sklearn_hd._match import periodic_match
from sklearn_hd._match.input_problem import MAX_GROWTH, GrowthError, InputProblem
from sklearn_hd._opinion import DOUBT, lasting, of_multipliers
from sklearn_hd._records.data import beside_trim, lifted_periods, output_scale, rows_read
from sklearn_hd._residuals import why_incomplete
from sklearn_hd._simulators import sample_simulators
from sklearn_hd.algorithms.likelihood.small_motions import AS_LITTLE
from sklearn_hd.algorithms.linalg.triangular import column_rms
from sklearn_hd.algorithms.lti.simulation import GROWN, growth, propagate
from sklearn_hd.algorithms.modes.free_decay import offsets, periods_at_rest
from sklearn_hd.algorithms.periodic.behind_samples import FINER
from sklearn_hd.algorithms.periodic.floquet_coordinates import floquet_coordinates
from sklearn_hd.algorithms.periodic.multipliers import multiplier_deviations, without_noise
from sklearn_hd.algorithms.periodic.periodic_realization import (
    FloquetError,
    equation_error,
    fit_shapes,
    floquet_logarithm,
    outputs_are_states,
    response_to_states,
    state_response,
    tail_begins,
)
from sklearn_hd.algorithms.signals.fourier import input_directions, sampled_harmonics
from sklearn_hd.algorithms.signals.trim import NOTABLE
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.exceptions import CoordinatesWarning, IdentifiabilityWarning, InstabilityWarning

NOISY = 1e-6  # of the shapes: then a second way to F is tried
CLEARLY_LESS = 0.98  # left of the record by the second way, in parts of that of the first
POOR_FIT = 0.5  # share of the raw record's variance below which a closed form is not trusted
LARGER_LEFT = 2.0  # times what the map leaves: beyond what fitting its freedom to noise explains
EQUATION_HARMONICS = 2  # of F and G in the equation-error start


def match_periodic(model, experiment, structure, simulated=True):
    """The match of an LTIModel from one period to the next, in closed form.

    ``simulated`` says whether it is the one that will be simulated: False before it is refined.
    """
    found = realize(model, experiment, structure)
    warn_coordinates(found.model)
    warn_feedthrough(found)
    if simulated:  # what it is refined to is tested by itself
        warn_realized(found, model)
        warn_incomplete(found, experiment)
        warn_growing(found.model, model, experiment)
    return periodic_match(found.structure, found.theta, found.model, model, experiment.basis)


def realize(model, experiment, structure):
    """The realization of the periodic model behind an LTIModel from one period to the next.

    Raises FloquetError or GrowthError if the multipliers or F(ψ) are those of no periodic system,
    or of one that outgrows numbers, and measured states lead to no better ones.
    """
    check_n_states(structure, model)
    _check_harmonics(structure, experiment.basis.samples_per_period)
    scale = output_scale(experiment)
    found = _without_feedthrough(model, experiment, structure, scale)
    # a fraction of a sample, or harmonics that the structure forbids, look like a feedthrough
    alone = experiment.delays is None and structure.left_open
    n_values = sum(y.size for y in experiment.outputs)
    chance = STANDARD_ERRORS * (1.0 - found.r2) / np.sqrt(n_values)  # what noise alone gives
    much = found.systematic > LITTLE
    if not alone or not (much or found.systematic > max(LITTLE**2, chance)):
        return found
    other, _ = _in_closed_form(model, experiment, structure, scale, feedthrough=True)
    enough = 1.0 if much else DECISIVE  # of little, states that are missing may explain a part
    return other if enough * other.systematic < found.systematic else found


def _without_feedthrough(model, experiment, structure, scale):
    """The realization in closed form, or by measured states where these do better."""
    if model.closed_loop or model.at_rest:  # the other way takes inputs for independent of noise
        return _in_closed_form(model, experiment, structure, scale)[0]
    try:
        found, noise = _in_closed_form(model, experiment, structure, scale)
    except (FloquetError, GrowthError) as error:
        other = _from_equation_error(model, experiment, structure, scale)
        if other is None or other.systematic > LITTLE:
            raise  # not noise, but the order is at fault
        return _told(other, model, f"belongs to no periodic system ({error})")
    n_measured = len(structure.states or experiment.basis.outputs)
    if n_measured != model.n_states or grows(model.A, model.dt, experiment):  # maybe by noise
        if structure.n_states in (None, n_measured) and found.systematic > LITTLE:
            other = _from_equation_error(model, experiment, structure, scale)
            if other is not None and other.systematic <= LITTLE:
                return _told(other, model, f"leaves {found.systematic:.2g} of the variance")
    elif noise > NOISY and 1.0 - found.r2 > NOISY**2:
        other = _from_equation_error(model, experiment, structure, scale)
        enough = CLEARLY_LESS if found.physical else AS_LITTLE
        if other is not None and 1.0 - other.r2 < enough * (1.0 - found.r2):
            # noise in its regressors biases the modes
            known = _modes_known(model, experiment, scale)
            return other if has_modes(other.model.to_system(), known) else found
    return found


def _modes_known(model, experiment, scale):
    """The exponents of a map, each known as well as the whole record has it."""
    _, lifted, directions = _raw_periods(experiment, model.n_states, scale)
    found = multiplier_deviations(model.A, directions, lifted)
    return of_multipliers(*found, experiment, "its own likelihood has", own=True)


def has_modes(system, known):
    """Whether exponents of an LTPSystem are those known, to a tenth or within chance."""
    exponents = system.floquet_exponents()
    _, apart, spread = known.about(exponents)
    near = apart <= np.maximum(DOUBT, STANDARD_ERRORS * spread)
    return bool(np.all(near[lasting(exponents, system.omega)]))


def _told(realization, model, why):
    """A realization by measured states, after a warning if it has another number of states."""
    n = realization.model.n_states
    if n != model.n_states:
        warn(
            f"the identified model has {model.n_states} state(s), and it {why}; with the {n} "
            f"outputs {list(realization.model.state_names)} as states only noise stays "
            f"unexplained, so these are used; ask for them with MOESPRegressor(order={n}), or for "
            f"others with HarmonicStructure(states=[...])",
            IdentifiabilityWarning,
        )
    return realization


def _from_equation_error(model, experiment, structure, scale):
    """The realization of measured states' F(ψ) by linear least squares; None if there is none."""
    basis = experiment.basis
    names = [name for name, _ in basis.outputs]
    states = list(structure.states or names)
    if structure.n_states not in (None, len(states)) or set(states) != set(names):
        return None
    rows = [names.index(name) for name in states]
    spp = basis.samples_per_period
    inputs, lifted, directions = _raw_periods(experiment, model.n_states, scale)
    segments, instruments = [], []
    for u, y, clean in zip(inputs, lifted, without_noise(model.A, directions, lifted), strict=True):
        measured, shown = (each.reshape(-1, len(names))[:, rows] for each in (y, clean))
        segments.append((measured, u.reshape(-1, u.shape[2])))
        instruments.append(shown)
    count = min(EQUATION_HARMONICS, (spp - 1) // 2)
    F = equation_error(segments, 2.0 * np.pi / basis.omega, spp, count, instruments)
    P = np.eye(len(names))[:, rows]
    free = {"F": F * scale[rows][:, None] / scale[rows], "P": P[None]}
    n_harmonics = {"F": given(structure, "F", count), "P": given(structure, "P", None)}
    problem = InputProblem(structure, tuple(states), experiment, free, None, scale)
    try:
        return problem.solve(n_harmonics, physical=True)
    except GrowthError:
        return None


def _in_closed_form(model, experiment, structure, scale, feedthrough=False):
    """The realization by P(ψ) and R, and the noise of what P was fitted to."""
    basis = experiment.basis
    spp = basis.samples_per_period
    starts = predictor_states(model, experiment) if model.closed_loop else None
    shapes = output_shapes(model, experiment, scale, starts)
    names = [name for name, _ in basis.outputs]
    psi = 2.0 * np.pi * np.arange(FINER * spp) / (FINER * spp)  # F has more harmonics than P
    P, _ = shapes(psi)
    n, choices = len(shapes.R), combinations(range(len(names)), len(shapes.R))
    rows = state_outputs(
        structure, names, n, choices, lambda rows: outputs_are_states(P[:, rows], shapes.flips)
    )
    highest = (spp - 1) // 2
    count = min(shapes.n_harmonics, highest)
    if rows is None:
        F, P, form = floquet_coordinates(shapes, psi, basis.omega, scale)
        turned = bool(shapes.flips.any())
        states = tuple(f"z{i + 1}" for i in range(len(F[0])))
        n_harmonics = {"F": int(turned), "P": min(count + turned, highest)}
    else:
        F, form = shapes.state_matrix(psi, basis.omega, rows), None
        P = P @ np.linalg.inv(P[:, rows])
        states = tuple(names[i] for i in rows)
        n_harmonics = {
            name: min(tail_begins(values, shapes.noise), highest)
            for name, values in (("F", F), ("P", P))
        }
        if set(names) == set(states):
            n_harmonics["P"] = None
        F, P = F * scale[rows][:, None] / scale[rows], P / scale[rows]
    P = P * scale[:, None]
    n_harmonics = {name: given(structure, name, found) for name, found in n_harmonics.items()}
    free = {
        name: sampled_harmonics(values, n_harmonics[name] or 0)
        for name, values in (("F", F), ("P", P))
    }
    problem = InputProblem(structure, states, experiment, free, form, scale, starts)
    return problem.solve(n_harmonics, rows is not None, feedthrough), shapes.noise


def given(structure, name, default):
    """Number of harmonics that the structure asks for, or a default."""
    asked = structure.n_harmonics(name)
    return default if asked is None else asked


def check_n_states(structure, model):
    """Raise ValueError if a HarmonicStructure has another number of states than a model."""
    if structure.n_states not in (None, model.n_states):
        raise ValueError(
            f"the structure has {structure.n_states} states, but the identified model has "
            f"{model.n_states}; identify with MOESPRegressor(order={structure.n_states}), or "
            f"change the structure"
        )


def _check_harmonics(structure, samples_per_period):
    """Raise ValueError if the structure has harmonics that the samples cannot tell apart."""
    most = (samples_per_period - 1) // 2
    for name in "FGPQ":
        asked = structure.n_harmonics(name)
        if asked is not None and asked > most:
            raise ValueError(
                f"the structure has harmonic {asked} of {name}, but {samples_per_period} samples "
                f"per period separate at most {most}; give {name} fewer harmonics, or sample faster"
            )


def state_outputs(structure, names, n, choices, determined):
    """Which outputs are the n states, if ``determined`` by them; None if no choice of them is."""
    if structure.states is not None:
        unknown = [name for name in structure.states if name not in names]
        if unknown:
            raise ValueError(
                f"states={list(structure.states)} must be {n} of the outputs {names}, but "
                f"{unknown} are not among them"
            )
        rows = [names.index(name) for name in structure.states]
        if not determined(rows):
            raise ValueError(
                f"the outputs {list(structure.states)} do not determine the {n} states; leave "
                f"states=None, or name others of {names}"
            )
        return rows
    for rows in choices:
        if determined(list(rows)):
            return list(rows)
    if entries := structure.given_entries():
        raise ValueError(
            f"the outputs {names} do not determine the {n} states for which the structure gives "
            f"entries of {', '.join(entries)}; measure more outputs, or give numbers of harmonics "
            f"(or nothing), which leads to Floquet coordinates"
        )
    return None


def output_shapes(model, experiment, scale, states=None):
    """Mode shapes of the outputs (FloquetShapes), in parts of their scale (n_outputs,).

    The states at the beginning of each period are those of :func:`predictor_states`, or else
    simulated. Raises FloquetError or GrowthError if the multipliers are those of no periodic
    system, or of one that outgrows numbers.
    """
    basis = experiment.basis
    spp, period = basis.samples_per_period, 2.0 * np.pi / basis.omega
    inputs, lifted, directions = _raw_periods(experiment, model.n_states, scale)
    if states is None:
        seen, unit = _seen(experiment)
        C = model.C / unit[:, None]
        response, n_rows = _simulated(model, C, inputs, directions, lifted, seen)
    else:
        directions = beside_trim(directions, basis)
        response = response_to_states(states, directions, lifted)
        n_rows = sum(map(len, lifted)) - directions[0].shape[1] - model.n_states
    sights, information, residual = response
    R, to_original, flips = floquet_logarithm(model.A, period)
    back = linalg.inv(to_original)
    sights = sights.reshape(spp, -1, model.n_states) @ to_original
    information, residual = back @ information @ back.T, residual.reshape(spp, -1)
    return fit_shapes(sights, information, residual, R, flips, period, n_rows)


def predictor_states(model, experiment):
    """States of a model with a Kalman gain at the beginning of each period, by its predictor.

    Its predictor is stable, and its errors are independent of inputs that answer to outputs of
    earlier periods. B − K D, D and the initial states are those that leave the least innovations:
    a linear least-squares fit, with regressors that do not grow. A list of (n_periods_s, n).
    """
    _, _, directions = _raw_periods(experiment, model.n_states)
    inputs, (seen, unit) = beside_trim(directions, experiment.basis), _seen(experiment)
    C, K = model.C / unit[:, None], model.kalman_gain * unit
    stable, rest = model.A - K @ C, np.zeros(len(model.A))
    corrected = [propagate(stable, y @ K.T, rest) for y in seen]
    left = [y - x @ C.T for x, y in zip(corrected, seen, strict=True)]
    B, _, x0 = input_matrices(stable, C, inputs, left, True)
    driven = [propagate(stable, u @ B.T, start) for u, start in zip(inputs, x0, strict=True)]
    return [x + y for x, y in zip(corrected, driven, strict=True)]


def _simulated(model, C, inputs, directions, lifted, seen):
    """What every sample of the period sees of the states, and the rows left for noise."""
    Phi, n = model.A, model.n_states
    folds = max(map(len, lifted)) * growth(Phi)
    if folds > MAX_GROWTH:
        raise GrowthError(
            f"a mode of the identified model grows e^{folds:.0f} times over the record, more than "
            f"a record can show: lower the order, check omega, or use a shorter record"
        )
    if model.at_rest:
        stretches = periods_at_rest(inputs)
        lifted, seen = ([each[s][rows] for s, rows in stretches] for each in (lifted, seen))
        directions = offsets(lifted)
    response = state_response(Phi, C, directions, lifted, seen)
    if len(model.second_order):  # beside it, but as well known as without: it is no noise
        beside = offsets(lifted, model.second_order)
        response = state_response(Phi, C, beside, lifted, seen)[0], *response[1:]
    return response, sum(map(len, lifted)) - directions[0].shape[1] - n


def _raw_periods(experiment, n_states, scale=1.0):
    """Inputs and outputs of each period, (n_periods_s, n_phases, m) and (n_periods_s, q), and
    as many directions of the inputs as the record can tell from some states."""
    inputs = lifted_periods(experiment, experiment.inputs)
    lifted = lifted_periods(experiment, experiment.outputs, scale)
    most = max(1, sum(map(len, lifted)) // 2 - n_states)
    lifted = [y.reshape(len(y), -1) for y in lifted]
    return inputs, lifted, input_directions(inputs, most)[0]


def _seen(experiment):
    """What the model was identified from, one row a period, in parts of its size, and that."""
    _, seen = rows_read(experiment)
    unit = column_rms(np.vstack(seen))
    return [Y / unit for Y in seen], unit


def warn_realized(found, model):
    """Of a periodic model in closed form, made of a map that was identified."""
    left, known = 1.0 - found.r2, np.inf if model.lifted is None else model.lifted.left
    if found.r2 < POOR_FIT:
        warn(
            f"the periodic model explains only {max(0.0, found.r2):.0%} of the record's variance; "
            f"check the order, omega and the length of the record, or refine the model with "
            f"criterion='output_error'",
            IdentifiabilityWarning,
        )
    elif found.systematic > LITTLE:
        warn(
            f"the periodic model leaves {found.systematic:.2g} of the record's variance in "
            f"residuals that are not noise (neighbouring samples are alike); check order, omega, "
            f"the harmonics that the structure allows, and whether the response is linear",
            IdentifiabilityWarning,
        )
    elif left > LARGER_LEFT * known and left - known > NOTABLE:
        warn_in_place_of_states(
            found.model,
            f"the periodic model leaves {left:.2g} of the record's energy, but the map of whole "
            f"periods that it was made from {known:.2g}",
        )
    if found.unidentified:
        warn(
            f"the record does not determine {first_of(found.unidentified)} (only some "
            f"combinations of them): of all that fit, the smoothest G(ψ) is taken; record inputs "
            f"that change at more phases of the period, or give G and Q fewer harmonics",
            IdentifiabilityWarning,
        )


def warn_incomplete(found, experiment):
    """Of states that a periodic model lacks, where what it leaves is little and tells so."""
    if searching() or found.systematic > LITTLE:
        return
    sampled = found.model.sampled(experiment.base.sample_time)
    words = why_incomplete(sampled, experiment, sample_simulators)
    if words:
        warn(words, IdentifiabilityWarning)


def warn_in_place_of_states(periodic, why):
    """Of inputs that act with more harmonics than the states move with: G = T⁻¹ B, P = C T."""
    if periodic.highest("G") > 2 * max(periodic.highest("F"), periodic.highest("P"), 1):
        warn(
            f"{why}, and G has {periodic.highest('G')} harmonics, more than twice those of F and "
            f"P: they stand for what {periodic.n_states} state(s) cannot do within the turn; raise "
            f"order=, or use a longer record",
            IdentifiabilityWarning,
        )


def warn_feedthrough(found):
    """Of a realization with a Q that nobody asked for: states may be missing instead."""
    if found.without is not None:
        count = found.model.highest("Q")
        warn(
            f"without a feedthrough the periodic model leaves {found.without:.2g} of the record's "
            f"variance in residuals that are not noise, so it has a Q of {count} harmonic(s). If "
            f"the outputs feel the inputs at once, ask for it: HarmonicStructure(Q={count}); if "
            f"not, states are missing: raise order=",
            IdentifiabilityWarning,
        )


def warn_coordinates(periodic):
    """Of a periodic model in Floquet coordinates."""
    if not periodic.physical:
        warn(
            f"the outputs {list(periodic.output_names)} do not determine the "
            f"{periodic.n_states} states: the model is in Floquet coordinates, in which its "
            f"states have no physical meaning; measure more outputs for that",
            CoordinatesWarning,
        )


def warn_growing(periodic, model, experiment):
    """Of a periodic model that grows e-fold within a segment, where that identified does not."""
    if grows(model.A, model.dt, experiment):  # it has been warned of
        return
    fastest = np.max(periodic.to_system().floquet_exponents().real)
    radius = np.exp(fastest * 2.0 * np.pi / periodic.omega)
    folds = fastest * longest_span(experiment)
    if folds > GROWN:
        warn(
            f"the matched periodic model has a Floquet multiplier of size {radius:.4g}, so it "
            f"{grows_by(folds)} over the longest segment, although the identified model is "
            f"stable: noise has moved it; refine it with criterion='output_error' and "
            f"structure=HarmonicStructure(), or change the order",
            InstabilityWarning,
        )
