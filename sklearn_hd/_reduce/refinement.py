"""Modes of largest likelihood for the raw record, where white noise is all that they leave."""

import numpy as np
from scipy import sparse

from sklearn_hd._continuous import input_scale, output_scale
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import is_white, likelihood_problem
from sklearn_hd.algorithms.likelihood.predictor import residuals
from sklearn_hd.algorithms.likelihood.search import search, start
from sklearn_hd.algorithms.modes.families import real_block
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure

__all__ = ["most_likely", "refined_modes"]

STEPS = 20  # of the search; a start 0.13 1/s off needs more than 10
WORTH = 0.01  # variances of the noise that a step has to gain: a tenth of a standard deviation


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
    spp, u_scale = basis.samples_per_period, input_scale(experiment)
    y_scale = output_scale(experiment)
    first = [int(basis.phase_index(time)[0]) for time in experiment.times()]
    segments = [
        (u / u_scale, y / y_scale, phase)
        for u, y, phase in zip(experiment.drive, experiment.outputs, first, strict=True)
    ]
    observe = basis.recomposition(2.0 * np.pi * np.arange(spp) / spp)
    counts = [sum(2 if k else 1 for k in orders) for _, orders in basis.outputs]
    units = np.repeat(y_scale, counts)[:, None]
    columns = []
    for exponent, shape in zip(exponents, shapes, strict=True):
        columns += [shape.real, -shape.imag] if exponent.imag else [shape.real]
    C = np.stack(columns, axis=1) / units
    A, C, left = most_likely(segments, exponents, C, basis.omega, spp, observe)
    if np.sum(left**2) > enough and not is_white(left, spp):
        return None, None
    return A, units * C


def most_likely(segments, exponents, C, omega, n_phases, observe=None):
    """A, C, B and initial states of largest likelihood, A in real blocks of some exponents.

        ẋ = A x + B u,   y = O(ψ) C x

    Parameters
    ----------
    segments : list of (inputs, outputs, first_phase)
        In like units; inputs held from sample to sample.
    exponents : complex ndarray, shape (n_units,)
        To start from, 1/s: real ones, and one member of each pair.
    C : ndarray, shape (n_coefficients, n)
        To start from.
    omega : float
    n_phases : int
    observe : ndarray, shape (n_phases, l, n_coefficients), optional
        O at each phase.

    Returns
    -------
    A, C : ndarray
    left : ndarray, shape (n_samples, l)
        The outputs of the model less those measured.
    """
    A, m = real_block(exponents), segments[0][0].shape[1]
    n, size = len(A), sum(y.size for _, y, _ in segments)
    near = np.zeros((1, n + len(C), n + m))
    near[0, :n, :n], near[0, n:, :n] = A, C
    structure = _modal_structure(exponents, near.shape)
    problem = likelihood_problem(Form(structure, omega, n_phases, observe), segments, True)
    point = problem.with_best_inputs(start(problem, structure.nearest(near)))
    point = search(
        problem, point, max_iter=STEPS, tol=WORTH / size, keep_stable=False, bounds=None
    ).point
    response = problem.form.response(point.theta, sensitivities=False)
    left = [residuals(response, *each) for each in zip(problem.records, point.x0, strict=True)]
    A, _, C, _ = structure.matrices(point.theta)
    return A[0], C[0], np.concatenate(left)


def _modal_structure(exponents, shape):
    """Parameters of [A B; C 0]: the exponents of A, and all entries of B and C."""
    n, at, directions = int(np.sum(1 + (exponents.imag != 0.0))), 0, []
    for exponent in exponents:
        turns = [[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [-1.0, 0.0]]]
        for block in turns if exponent.imag else [[[1.0]]]:
            direction = np.zeros(shape)
            direction[0, at : at + len(block), at : at + len(block)] = block
            directions.append(direction.ravel())
        at += len(block)
    free = np.ones(shape, dtype=bool)
    free[0, :n, :n], free[0, n:, n:] = False, False
    entries = sparse.eye_array(free.size, format="csr")[np.flatnonzero(free)]
    basis = sparse.vstack([sparse.csr_array(np.array(directions)), entries])
    return PeriodicStructure(np.zeros(shape), basis, n, tuple(map(str, range(basis.shape[0]))))
