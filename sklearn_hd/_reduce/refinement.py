"""What the raw record says of modes that are identified already.

Two ways. Where white noise is all that some modes leave, exponents, shapes, inputs and
initial states of largest likelihood. Where the outputs determine the state of a periodic
system, while the inputs rest,

    y(t) = P(ψ) e^{Rt} q,   F(ψ) = (P′(ψ) + P(ψ) R) P(ψ)⁻¹,

and the harmonic decomposition of F(ψ), whichever of the exponents λ + jpω R holds: the
shapes P take up the difference.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from sklearn_hd._continuous import input_scale, output_scale
from sklearn_hd._opinion import decays_at_rest
from sklearn_hd._records.data import lifted_periods
from sklearn_hd._reduce.choice import MAX_GROWTH
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import is_white
from sklearn_hd.algorithms.likelihood.output_error import output_error_of
from sklearn_hd.algorithms.likelihood.predictor import as_records, residuals
from sklearn_hd.algorithms.linalg.rounding import EPS
from sklearn_hd.algorithms.modes.families import real_block
from sklearn_hd.algorithms.periodic.harmonic_decomposition import derivative_matrix, toeplitz_matrix
from sklearn_hd.algorithms.periodic.multipliers import refine_multipliers
from sklearn_hd.algorithms.periodic.periodic_realization import (
    FloquetShapes,
    fit_shapes,
    response_to_states,
    shapes_determine_state,
)
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure, sampled_response
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics

__all__ = ["LikelyModes", "harmonic_form", "most_likely", "refined_modes"]

AT_ZERO = 0.1  # of an input's largest value: no level of a step
STEPS = 20  # of the search; a start 0.13 1/s off needs more than 10
WORTH = 0.01  # variances of the noise that a step has to gain: a tenth of a standard deviation
HARMONICS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)  # of shapes: a fourth more each costs no likelihood


@dataclass(frozen=True, eq=False)
class LikelyModes:
    """Modes of largest likelihood.

    Attributes
    ----------
    exponents : complex ndarray, shape (n_units,)
        1/s; real ones, and one member of each pair.
    P : ndarray, shape (2 K + 1, n_coefficients, n)
        Fourier coefficients of the output vectors, by the states of ``real_block``.
    left : ndarray, shape (n_samples, l)
        The outputs of the model less those measured.
    B : ndarray, shape (2 K + 1, n, m)
    x0 : list of ndarray, shape (n,)
    aic : float
        Akaike's criterion.
    """

    exponents: np.ndarray
    P: np.ndarray
    left: np.ndarray
    B: np.ndarray
    x0: list
    aic: float


def most_likely(segments, exponents, P, omega, n_phases, observe=None, start=None):
    """Exponents, output vectors, inputs and initial states of largest likelihood.

        ż = R z + B(ψ) u,   y = O(ψ) P(ψ) z,   R real, of some exponents

    Parameters
    ----------
    segments : list of (inputs, outputs, first_phase)
        In like units; inputs held from sample to sample.
    exponents : complex ndarray, shape (n_units,)
        To start from, 1/s: real ones, and one member of each pair.
    P : ndarray, shape (2 K + 1, n_coefficients, n)
        To start from. B has as many harmonics.
    omega : float
    n_phases : int
    observe : ndarray, shape (n_phases, l, n_coefficients), optional
        O at each phase.
    start : LikelyModes, optional
        Of no more harmonics: its B and initial states are where to start from; by default they
        are fitted to the modes given.

    Returns
    -------
    modes : LikelyModes
    """
    R, m = real_block(exponents), segments[0][0].shape[1]
    n, size = len(R), sum(y.size for _, y, _ in segments)
    near = np.zeros((len(P), n + P.shape[1], n + m))
    near[0, :n, :n], near[:, n:, :n] = R, P
    given = (omega, n_phases)
    options = {"tol": WORTH / size, "keep_stable": False}
    if start is None:
        driven = _modal_structure(near, [], n, ["B"])
        nothing = np.zeros(driven.n_parameters)
        form = Form(driven, *given, observe)
        linear = output_error_of(form, segments, nothing, max_iter=1, **options)
        near, x0 = driven.coefficients(linear.theta), linear.x0
    else:
        near[: len(start.B), :n, n:], x0 = start.B, start.x0
    free = _modal_structure(np.zeros(near.shape), exponents, n, ["B", "P"])
    form, nearest = Form(free, *given, observe), free.nearest(near)
    result = output_error_of(form, segments, nearest, x0=x0, max_iter=STEPS, **options)
    response = sampled_response(free, result.theta, *given, observe, sensitivities=False)
    records = as_records(segments, m, segments[0][1].shape[1])
    left = [residuals(response, *each) for each in zip(records, result.x0, strict=True)]
    F, B, P, _ = free.matrices(result.theta)
    return LikelyModes(
        _exponents(F[0], exponents), P, np.concatenate(left), B, result.x0, result.aic
    )


def _modal_structure(constant, exponents, n, free):
    """R of some exponents, and all entries of the parts named, as parameters."""
    directions, at = [], 0
    for exponent in exponents:
        turns = [[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [-1.0, 0.0]]]
        for block in turns if exponent.imag else [[[1.0]]]:
            direction = np.zeros(constant.shape)
            direction[0, at : at + len(block), at : at + len(block)] = block
            directions.append(direction.ravel())
        at += len(block)
    parts = {
        "B": (slice(None), slice(n), slice(n, None)),
        "P": (slice(None), slice(n, None), slice(n)),
    }
    entries = np.zeros(constant.shape, dtype=bool)
    for name in free:
        entries[parts[name]] = True
    units = sparse.eye_array(constant.size, format="csr")[np.flatnonzero(entries)]
    basis = sparse.vstack([sparse.csr_array(np.array(directions)), units]) if directions else units
    return PeriodicStructure(constant, basis, n, tuple(map(str, range(basis.shape[0]))))


def _exponents(R, like):
    """The exponents in real blocks."""
    paired = np.asarray(like).imag != 0.0
    at = np.cumsum(1 + paired) - 1 - paired
    return R[at, at] + 1j * np.where(paired, R[at, np.minimum(at + 1, len(R) - 1)], 0.0)


def _segments(experiment):
    """The raw record in parts of its scale, with the phase of each segment's first sample."""
    u_scale, y_scale = input_scale(experiment), output_scale(experiment)
    first = [int(experiment.basis.phase_index(time)[0]) for time in experiment.times()]
    return [
        (u / u_scale, y / y_scale, phase)
        for u, y, phase in zip(experiment.drive, experiment.outputs, first, strict=True)
    ]


def refined_modes(experiment, exponents, shapes, enough=0.0):
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

    Returns
    -------
    A, C : ndarray
        None, None where what the modes leave is not white noise: then the model's
        structure is at fault, and likelihood would make the modes answer for it.
    """
    basis = experiment.basis
    columns = []
    for exponent, shape in zip(exponents, shapes, strict=True):
        columns += [shape.real, -shape.imag] if exponent.imag else [shape.real]
    spp, units = basis.samples_per_period, _coefficient_scale(experiment)[:, None]
    observe = basis.recomposition(2.0 * np.pi * np.arange(spp) / spp)
    C = np.stack(columns, axis=1) / units
    found = most_likely(_segments(experiment), exponents, C[None], basis.omega, spp, observe)
    if np.sum(found.left**2) > enough and not is_white(found.left, spp):
        return None, None
    return real_block(found.exponents), units * found.P[0]


def harmonic_form(experiment, choices):
    """A and C of the harmonic decomposition of the F(ψ) behind some families.

    Parameters
    ----------
    experiment : Experiment
    choices : list of complex ndarray
        λT of as many exponents as there are outputs, each a way to read the families.

    Returns
    -------
    A, C : ndarray
        None, None where no input rests long enough, the outputs do not determine the
        state, or F(ψ) is too rough to be one.
    """
    basis = experiment.basis
    spp, omega, n = basis.samples_per_period, basis.omega, len(basis.outputs)
    decay = _strongest_decay(experiment, 2 * n)
    if decay is None:
        return None, None
    refined = [_refined_exponents(decay, choice) for choice in choices]
    longest = max(map(len, experiment.outputs)) / spp  # periods
    found = [
        (*_decaying_shapes(decay, turns * omega / (2.0 * np.pi), omega, spp), turns)
        for turns in refined
        if turns is not None and np.max(turns.real) * longest <= MAX_GROWTH
    ]
    if not found:
        return None, None
    shapes, left, turns = min(found, key=lambda each: np.sum(each[1] ** 2))
    if np.sum(left**2) > EPS * np.sum(decay**2) and is_white(left.reshape(-1, n), spp - 1):
        shapes = _likely_shapes(experiment, turns * omega / (2.0 * np.pi), shapes)
    psi = 2.0 * np.pi * np.arange(spp) / spp
    if not shapes_determine_state(shapes(psi)[0]):
        return None, None
    F = shapes.state_matrix(psi, omega, range(n))
    highest = max(k for _, orders in basis.outputs for k in orders)
    F = sampled_harmonics(F, min(2 * highest, (spp - 1) // 2))
    A = toeplitz_matrix(F, highest, highest) - derivative_matrix(highest, n, omega)
    kept = _kept_states(basis)
    A = A[np.ix_(kept, kept)]
    if np.max(np.linalg.eigvals(A).real) > max(0.0, np.max(np.linalg.eigvals(shapes.R).real)):
        return None, None  # noise, or too few harmonics: a decay that grows
    return A, np.diag(_coefficient_scale(experiment))


def _strongest_decay(experiment, least):
    """Of the free decays about zero inputs, of least length, the strongest; None if none."""
    lifted = lifted_periods(experiment, experiment.inputs)
    largest = np.max(np.abs(np.concatenate(lifted)), axis=(0, 1), initial=0.0)
    parts = zip(*decays_at_rest(experiment), strict=True)
    about_zero = [
        y.reshape(len(y), -1)
        for y, (s, rows) in parts
        if len(y) >= least
        and np.all(np.mean(np.abs(lifted[s][rows]), axis=(0, 1)) <= AT_ZERO * largest)
    ]
    return max(about_zero, key=lambda y: np.sum(y**2), default=None)


def _refined_exponents(decay, exponents):
    """λT that explain a free decay best whatever its shapes; None if one is of no real mode."""
    Phi = linalg.expm(real_block(exponents))
    multipliers = linalg.eigvals(refine_multipliers(Phi, [np.zeros((len(decay), 0))], [decay]))
    multipliers = multipliers[multipliers.imag >= 0.0].astype(complex)
    negative = (multipliers.imag == 0.0) & (multipliers.real <= 0.0)
    return None if negative.any() else np.log(multipliers)


def _decaying_shapes(decay, exponents, omega, n_phases):
    """Shapes of a free decay of some exponents (1/s), and what shapes free at every phase leave."""
    R, period = real_block(exponents), 2.0 * np.pi / omega
    step, states = linalg.expm(R * period), np.ones((len(decay), len(R)))
    for k in range(1, len(decay)):
        states[k] = step @ states[k - 1]
    seen = response_to_states([states], [np.zeros((len(decay), 0))], [decay])
    sights, information, residual = seen
    sights, residual = (each.reshape(n_phases, -1, *each.shape[1:]) for each in (sights, residual))
    flips, n_rows = np.zeros(len(R), dtype=bool), len(decay) - len(R)
    shapes = fit_shapes(sights, information, residual, R, flips, period, n_rows)
    return shapes, decay - states @ seen[0].T


def _likely_shapes(experiment, exponents, shapes):
    """Shapes of few harmonics, and R, most likely by the whole record (Akaike, 1974).

    Those given where no number of harmonics leaves white noise.
    """
    basis, best = experiment.basis, None
    P = np.concatenate(shapes.coefficients.transpose(1, 2, 3, 0))
    P = np.delete(P, 1, axis=0)  # sin 0ψ
    spp, omega = basis.samples_per_period, basis.omega
    if any(orders != (0,) for _, orders in basis.inputs):
        return shapes  # the drive is not the raw input
    segments, highest = _segments(experiment), spp // 2 - 1
    for count in [k for k in HARMONICS if shapes.n_harmonics <= k <= highest]:
        P = np.concatenate([P, np.zeros((2 * count + 1 - len(P), *P.shape[1:]))])
        found = most_likely(segments, exponents, P, omega, spp, start=best)
        if best is not None and found.aic >= best.aic:
            break
        best, exponents, P = found, found.exponents, found.P
    if best is None or not is_white(best.left, spp):
        return shapes
    R, P = real_block(best.exponents), np.insert(best.P, 1, 0.0, axis=0).transpose(2, 0, 1)
    columns = P.reshape(len(P), -1, 2, P.shape[2])
    return FloquetShapes(R, np.zeros(len(R), dtype=bool), columns, len(best.P) // 2)


def _kept_states(basis):
    """Places of the output coefficients kept among the states x_0, x_1c, x_1s, …"""
    n_signals = len(basis.outputs)
    return [
        block * n_signals + i
        for i, (_, orders) in enumerate(basis.outputs)
        for k in orders
        for block in ((2 * k - 1, 2 * k) if k else (0,))
    ]


def _coefficient_scale(experiment):
    """Scale of the output of each coefficient kept."""
    counts = [sum(2 if k else 1 for k in orders) for _, orders in experiment.basis.outputs]
    return np.repeat(output_scale(experiment), counts)
