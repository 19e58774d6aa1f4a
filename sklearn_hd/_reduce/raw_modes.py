"""Genuine modes taken from, or refined on, the raw record behind an identified model."""

import numpy as np
from scipy import linalg

from sklearn_hd._continuous import input_scale, observations, output_scale
from sklearn_hd.algorithms.modes.modal_response import Record, fit_modal_model, is_white, residuals
from sklearn_hd.algorithms.modes.mode_shapes import (
    harmonic_state_matrix,
    mode_shapes,
    real_block,
    refine_exponents,
    shape_condition,
    state_matrix_samples,
    strongest_free_decay,
)
from sklearn_hd.algorithms.reporting import within
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

REST_SHARE = 1e-9  # of an input's largest value, below which it counts as at rest
SHAPE_CONDITION = 1e4
EXACT_SHARE = 1e-16  # of the variance: nothing but rounding is left unexplained
HARMONICS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # of mode shapes, tried in turn


def periodic_decomposition(experiment, choices, report=None):
    """A and C of the harmonic decomposition of the F(ψ) behind some families.

    Parameters
    ----------
    experiment : Experiment
    choices : list of complex ndarray
        λT of as many exponents as there are outputs, each a way to read the families.
    report : callable, optional
        ``report(stage, most, done, note)``.

    Returns
    -------
    A, C : ndarray
        None, None where no input rests long enough, the outputs do not determine the
        state, or F(ψ) is too rough to be one.
    """
    basis, scale = experiment.basis, output_scale(experiment)
    spp, omega = basis.samples_per_period, basis.omega
    phases = [basis.phase_index(time) for time in experiment.times()]
    outputs = [y / scale for y in experiment.outputs]
    decay = strongest_free_decay(experiment.drive, outputs, phases, spp, REST_SHARE)
    if not choices or decay is None or len(decay) < 2 * len(scale) * spp:
        return None, None
    refined = [refine_exponents(decay, choice, spp) for choice in choices]
    exponents = min(refined, key=lambda pair: pair[1])[0] * omega / (2.0 * np.pi)
    R = real_block(exponents)
    P = mode_shapes(decay, R, basis.sample_time, spp)
    if _noise_left(decay, P, R, basis):
        P, R = _likely_shapes(experiment, exponents, P, report)
    if shape_condition(P) > SHAPE_CONDITION:
        return None, None
    F = state_matrix_samples(P, R, omega)
    highest = max(k for _, orders in basis.outputs for k in orders)
    where = _kept_states(basis)
    A = harmonic_state_matrix(F, highest, omega)[np.ix_(where, where)]
    if np.max(np.linalg.eigvals(A).real) > max(0.0, np.max(np.linalg.eigvals(R).real)):
        return None, None  # noise, or too few harmonics: a decay that grows
    return A, np.diag(np.repeat(scale, _coefficient_counts(basis)))


def _noise_left(decay, P, R, basis):
    """Whether shapes free at every phase leave white noise of the decay, and not rounding."""
    spp = basis.samples_per_period
    times = basis.sample_time * np.arange(spp)
    states = np.array([linalg.expm(R * t) for t in times]) @ np.ones(len(R))
    step, periods = linalg.expm(R * spp * basis.sample_time), []
    for _ in range(len(decay) // spp):
        periods.append(np.einsum("tln,tn->tl", P, states))
        states = states @ step.T
    left = decay - np.concatenate(periods)
    return np.sum(left**2) > EXACT_SHARE * np.sum(decay**2) and is_white(left, spp - 1)


def _likely_shapes(experiment, exponents, P, report):
    """Shapes of few harmonics, and R, most likely by the whole record (Akaike, 1974).

    Those given where no number of harmonics leaves white noise.
    """
    basis = experiment.basis
    spp, n_outputs = P.shape[:2]
    if any(orders != (0,) for _, orders in basis.inputs):
        return P, real_block(exponents)  # the drive is not the raw input
    best, found = np.inf, None
    for n_harmonics in HARMONICS:
        if n_harmonics > spp // 2 - 1:
            break
        orders = range(n_harmonics + 1)
        azimuths = [basis.azimuth(time) for time in experiment.times()]
        observe = [_all_harmonics(psi, orders, n_outputs) for psi in azimuths]
        grid = 2.0 * np.pi * np.arange(spp) / spp
        functions = harmonic_functions(grid, orders)
        start = linalg.lstsq(functions, P.reshape(spp, -1))[0]
        C = start.reshape(-1, n_outputs, P.shape[2]).transpose(1, 0, 2).reshape(-1, P.shape[2])
        record = _record(experiment, observe, n_harmonics)
        told = within(report, f"harmonics {n_harmonics}")
        model = fit_modal_model(record, exponents, C, told)
        n_parameters = (n_outputs + record.drive[0].shape[1]) * len(C[0]) * len(functions[0])
        samples = record.outputs.size
        criterion = samples * np.log(model.residual / samples) + 2.0 * n_parameters
        if criterion >= best:
            break
        best, found = criterion, (record, model, functions)
        exponents = model.exponents
    record, model, functions = found
    if not is_white(residuals(record, model), spp):
        return P, real_block(exponents)
    C = model.C.reshape(n_outputs, -1, P.shape[2])
    return np.einsum("tk,lkn->tln", functions, C), real_block(model.exponents)


def _all_harmonics(psi, orders, n_outputs):
    """O(ψ) of the same harmonics of all outputs."""
    functions = harmonic_functions(psi, orders)
    observe = np.zeros((len(psi), n_outputs, n_outputs, functions.shape[1]))
    for i in range(n_outputs):
        observe[:, i, i] = functions
    return observe.reshape(len(psi), n_outputs, -1)


def _record(experiment, observe, n_harmonics):
    scale = output_scale(experiment)
    return Record(
        [u / input_scale(experiment) for u in experiment.drive],
        [y / scale for y in experiment.outputs],
        observe,
        [experiment.basis.azimuth(time) for time in experiment.times()],
        experiment.basis.omega,
        experiment.base.sample_time,
        n_harmonics,
    )


def refined_modes(experiment, exponents, shapes, enough=0.0, report=None):
    """A and C of some modes by maximum likelihood, if white noise is all that they leave.

    Parameters
    ----------
    experiment : Experiment
    exponents : complex ndarray, shape (n_units,)
        1/s; real ones, and one member of each pair.
    shapes : complex ndarray, shape (n_units, n_coefficients)
        Output vectors of the modes.
    enough : float, default=0.0
        Sum of squares (outputs divided by their scale) that may be left, white or not.
    report : callable, optional
        ``report(stage, most, done, note)``.

    Returns
    -------
    A, C : ndarray
        None, None where what the modes leave is not white noise: then the model's
        structure is at fault, and likelihood would make the modes answer for it.
    """
    basis = experiment.basis
    columns = []
    for exponent, shape in zip(exponents, shapes, strict=True):
        columns += [shape.real] if exponent.imag == 0.0 else [shape.real, -shape.imag]
    C = np.stack(columns, axis=1)
    units = np.repeat(output_scale(experiment), _coefficient_counts(basis))[:, None]
    C = C / units
    size = np.max(np.abs(C), axis=0)
    C = C / np.where(size == 0.0, 1.0, size)
    record = _record(experiment, observations(experiment, len(C)), 0)
    model = fit_modal_model(record, exponents, C, report)
    if model.residual > enough and not is_white(residuals(record, model), basis.samples_per_period):
        return None, None
    return real_block(model.exponents), units * model.C


def _kept_states(basis):
    """Places of the output coefficients kept among the states x_0, x_1c, x_1s, …"""
    n_signals = len(basis.outputs)
    places = []
    for i, (_, orders) in enumerate(basis.outputs):
        for k in orders:
            blocks = (0,) if k == 0 else (2 * k - 1, 2 * k)
            places += [block * n_signals + i for block in blocks]
    return places


def _coefficient_counts(basis):
    """Coefficients kept of each output."""
    return [sum(1 if k == 0 else 2 for k in orders) for _, orders in basis.outputs]
