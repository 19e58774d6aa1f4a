"""How a model identified through a window becomes the machine's own, in continuous time.

1. Split off the window's memory.      2. Group the other modes into families.
3. Choose the smallest set of modes that explains the raw record.
4. Refine it on the record, where white noise is all that it leaves.
5. Fit B, D and the initial states to the record through what is kept.
6. Hold what is kept against the second opinion of the record.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from sklearn_hd._fit_checks import warn_of_growth
from sklearn_hd._frame import LTIModel
from sklearn_hd._guards import warn
from sklearn_hd._records.data import input_scale, output_scale, refit_inputs, to_continuous
from sklearn_hd._reduce.choice import (
    HALF_KNOWN,
    NEARLY_ALL,
    choose_modes,
    identified_modes,
    judge,
    verdicts,
    warn_of_doubt,
)
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import is_white, likelihood_problem
from sklearn_hd.algorithms.likelihood.predictor import residuals
from sklearn_hd.algorithms.likelihood.search import search, start
from sklearn_hd.algorithms.lti.simulation import block_diagonal, discrete_to_continuous, residualize
from sklearn_hd.algorithms.modes.families import real_block
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.exceptions import IdentifiabilityWarning

MOST_LEFT = 3.0  # times what a choice leaves, from which refinement may get below it
MAX_REFINED = 4  # sets that are refined: seconds each
STEPS = 20  # of the search; a start 0.13 1/s off needs more than 10
WORTH = 0.01  # variances of the noise that a step has to gain: a tenth of a standard deviation


def refined_modes(experiment, exponents, shapes, enough):
    """A and C of some modes by maximum likelihood, if white noise is all that they leave.

    None, None where it is not: then the model's structure is at fault, and likelihood would make
    the modes answer for it. The exponents (n_units,), in 1/s, are real ones and one member of each
    pair; the shapes (n_units, n_coefficients) are output vectors. ``enough`` is the sum of squares
    (outputs divided by their scale) that may be left, white or not.
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
    """A and C of largest likelihood, and the outputs of the model less those measured.

        ẋ = A x + B u,   y = O(ψ) C x

    Starts from exponents (n_units,), in 1/s, real ones and one member of each pair, of which A is
    made in real blocks, and from C (n_coefficients, n). Segments are (inputs, outputs, first
    phase) in like units, inputs held from sample to sample; ``observe`` is O at each phase,
    (n_phases, l, n_coefficients).
    """
    A, m = real_block(exponents), segments[0][0].shape[1]
    n, size = len(A), sum(y.size for _, y, _ in segments)
    near = np.zeros((1, n + len(C), n + m))
    near[0, :n, :n], near[0, n:, :n] = A, C
    structure = _modal_structure(exponents, near.shape)
    problem = likelihood_problem(Form(structure, omega, n_phases, observe), segments)
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


@dataclass(frozen=True, eq=False)
class Reduction:
    """What is kept of a model, and why."""

    model: LTIModel
    modes: tuple  # exponents, families, verdicts and reasons of every mode identified
    r2: float = np.nan  # of the fit to the raw record; NaN where nothing was fitted
    left_out: float = 0.0  # share of what is left unexplained that all modes would explain


def reduced(model, experiment, method, n_states=None):
    """The Reduction of a model to its genuine part, in continuous time."""
    reason = "already continuous" if model.dt == 0.0 else experiment.basis.nothing_spurious
    if reason is not None:
        return _passed(model, n_states, reason)
    modes = identified_modes(model, experiment)
    if n_states is None and not modes.omega:
        found = _all_convertible(model, experiment, modes)
    else:
        found = _chosen(model, experiment, modes, method, n_states)
    warn_of_growth(found.model, experiment)
    return found


def _passed(model, n_states, reason):
    """A model with nothing spurious, as it is."""
    if n_states not in (None, model.n_states):
        way = f"MOESPRegressor(order={n_states})" if model.dt else "one reducer only"
        raise ValueError(
            f"n_states={n_states} cannot be kept: the model is {reason}, has nothing spurious, and "
            f"keeps all its {model.n_states} states; use {way}, or leave n_states=None"
        )
    exponents, families, verdicts, reasons = _all_genuine(model.exponents(), reason)
    if model.opinion is not None:
        judge(verdicts, reasons, exponents, families, model.opinion)
    return Reduction(model, (exponents, families, verdicts, reasons))


def _all_genuine(exponents, reason):
    n = len(exponents)
    return exponents, np.arange(n), ["genuine"] * n, [reason] * n


def _all_convertible(model, experiment, modes):
    """All modes that have a continuous-time counterpart, as no analyzer was there."""
    kept = modes.convertible
    if kept.all():
        table = _all_genuine(modes.exponents, "no harmonic analyzer, nothing spurious")
        return Reduction(to_continuous(model, experiment), table)
    warn(
        f"{int((~kept).sum())} mode(s) on the negative real axis have no continuous-time "
        f"counterpart and are dropped; sample faster, or lower the order",
        IdentifiabilityWarning,
    )
    reasons = ["" if k else "negative real pole: no continuous-time counterpart" for k in kept]
    found = np.where(kept, "genuine", "weak").tolist()
    A, C = _modal_pair(model, modes.z, kept)
    B, D, r2 = refit_inputs(A, C, experiment, model.feedthrough)
    table = modes.exponents, modes.families, found, reasons
    return Reduction(model.in_continuous_time(A, B, C, D), table, r2)


def _chosen(model, experiment, modes, method, n_states):
    """The modes that the raw record calls for, refined on it where they are only truncated."""
    choice, found = choose_modes(modes, experiment, n_states), None
    if method == "truncate" and modes.omega:
        choice, modes, found = _most_likely(choice, modes, experiment)
    kept, feedthrough = modes.mask(choice.units), model.feedthrough
    fast = _to_residualize(method, kept, modes)
    A, C = _modal_pair(model, modes.z, kept | fast) if found is None else found
    B, D, r2 = refit_inputs(A, C, experiment, feedthrough)
    if fast.any():
        A, B, C, D = residualize(A, B, C, D, modes.exponents[kept], modes.exponents[fast])
        feedthrough = True
    model, opinion = model.in_continuous_time(A, B, C, D, feedthrough=feedthrough), model.opinion
    if opinion is not None:
        # a record of which nothing is left speaks for itself; so do white noise, and copies
        something = 1.0 - r2 > NEARLY_ALL**2
        agreeing = found is not None or np.all(modes.whole[kept] >= 0)
        opinion = replace(opinion, needed=something and not agreeing, complete=something)
        model = replace(model, opinion=opinion)
    warn_of_doubt(modes, choice, opinion, n_states)
    table = modes.exponents, modes.families, *verdicts(modes, choice, opinion)
    return Reduction(model, table, r2, choice.left_out)


def _modal_pair(model, z, kept):
    """(A, C) of some modes in continuous time."""
    n, none = np.sum(kept), np.zeros((len(z), 0))
    try:
        A, _, C = block_diagonal(model.A, none, model.C, z[kept], z[~kept])
    except ValueError:
        raise ValueError(
            f"{n} modes cannot be separated from the others: their eigenvalues coincide to "
            f"working precision; change n_states or the order"
        ) from None
    return discrete_to_continuous(A[:n, :n], none[:n], model.dt)[0], C[:, :n]


def _most_likely(choice, modes, experiment):
    """The smallest set of modes that explains all but white noise once refined, its A and C.

    The choice and the modes given, and None, where none does. Also enough is what the choice
    leaves: poles a little off are made up for by further ones.
    """
    size = sum(map(len, choice.units))
    value = next((v for v, some in choice.tried if set(some) == set(choice.units)), 0.0)
    rounding, nothing = HALF_KNOWN * choice.total, NEARLY_ALL**2 * choice.total
    if value <= rounding or (choice.by_family and value > nothing):
        return choice, modes, None  # nothing to gain, or nothing white: copies agree to 0.1 %
    limit, enough, tried = max(NEARLY_ALL * choice.total, MOST_LEFT * value), rounding, choice.tried
    if value <= nothing:  # as good as all: no more modes than these
        tried = [pair for pair in tried if sum(map(len, pair[1])) <= size]
        enough = value
    for some in [some for rest, some in tried if rest <= limit][:MAX_REFINED]:
        first = [unit[0] for unit in some]
        single = np.array([len(unit) == 1 for unit in some])
        exponents = modes.exponents[first]
        start = np.where(single, exponents.real, exponents)
        A, C = refined_modes(experiment, start, modes.shapes[first], enough)
        if A is not None:
            return replace(choice, units=some, rivals=[]), modes.moved(some, A), (A, C)
    return choice, modes, None


def _to_residualize(method, kept, modes):
    """Modes replaced by their static gain: neither kept nor the window's memory."""
    if method == "truncate":
        return np.zeros(len(kept), dtype=bool)
    fast = ~(kept | modes.window) & modes.convertible
    return fast & (np.abs(modes.exponents) > modes.omega) if method == "both" else fast
