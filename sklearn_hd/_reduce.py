"""How a model identified through a window becomes the machine's own, in continuous time.

1. Split off the window's memory.      2. Group the other modes into families.
3. Choose the smallest set of modes that explains the raw record.
4. Refine it on the record, where white noise is all that it leaves.
5. Fit B, D and the initial states to the record through what is kept.
6. Hold what is kept against the second opinion of the record.
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import sparse

from sklearn_hd._fit_checks import warn_of_growth
from sklearn_hd._frame import LTIModel
from sklearn_hd._guards import warn
from sklearn_hd._opinion import (
    WAY_OUT,
    contradictions,
    doubtful,
    of_second_order,
    unchanging,
    what_it_has,
)
from sklearn_hd._readings import highest_harmonic
from sklearn_hd._records.data import (
    input_scale,
    observations,
    output_scale,
    refit_inputs,
    scaled_outputs,
    to_continuous,
)
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import is_white, likelihood_problem
from sklearn_hd.algorithms.likelihood.predictor import residuals
from sklearn_hd.algorithms.likelihood.search import search, start
from sklearn_hd.algorithms.linalg.rounding import EPS
from sklearn_hd.algorithms.lti.simulation import (
    block_diagonal,
    continuous_poles,
    discrete_to_continuous,
    residualize,
)
from sklearn_hd.algorithms.modes.families import (
    COPY_TOLERANCES,
    FAINT,
    agreeing_copies,
    best_modes,
    conjugate_units,
    floquet_families,
    is_window_pole,
    real_block,
    residual,
    unit_regressors,
)
from sklearn_hd.algorithms.periodic.multipliers import LASTING
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.exceptions import IdentifiabilityWarning

# docs/benchmarks/reducer_thresholds.py halves and doubles them: none of them decides
FAMILY_TOLERANCE = 0.05  # of ln z^r: neighbours of one family
WINDOW_DECAY = 1e-3  # of a response, that is left at the window's end of its memory
MAX_GROWTH = 20.0  # e-folds over the longest segment: such a mode would show
HALF_KNOWN = 64 * EPS  # of the variance: poles known to half of their digits leave as much
NEARLY_ALL = 1e-4  # of the variance: what a set whose poles are a little off may leave
OWN_SHARE = 1e-3  # of next to nothing, that is left once a mode of the system's own is added
DECISIVE_SHARE = 0.5  # of the unexplained variance: for more modes than output coefficients
MATERIAL_SHARE = 0.1  # of what is left unexplained: what matters
RIVAL_SHARE = 0.05  # a set that explains as much within this share is a rival
MOST_LEFT = 3.0  # times what a choice leaves, from which refinement may get below it
MAX_REFINED = 4  # sets that are refined: seconds each
STEPS = 20  # of the search; a start 0.13 1/s off needs more than 10
WORTH = 0.01  # variances of the noise that a step has to gain: a tenth of a standard deviation


@dataclass(frozen=True)
class IdentifiedModes:
    """The n modes of an identified model, and what can be said of them without the data."""

    z: np.ndarray  # eigenvalues of the discrete A
    exponents: np.ndarray  # 1/s
    shapes: np.ndarray  # output vectors, (n, n_coefficients)
    families: np.ndarray  # number of the Floquet family, -1 of the window's memory
    window: np.ndarray  # whether it is the window's memory
    wild: np.ndarray  # whether it turns or grows too fast to be the system's own
    whole: np.ndarray  # number of the family of a pole whose copies are all there, -1 of others
    omega: float  # fundamental frequency, rad/s; zero where there is none

    @property
    def units(self):
        """Real poles and pairs that may be kept."""
        out = self.window | self.wild
        return [unit for unit in conjugate_units(self.z) if not out[list(unit)].any()]

    @property
    def convertible(self):
        """Modes that have a counterpart in continuous time."""
        return self.mask(conjugate_units(self.z))

    def mask(self, units):
        """Which modes some units are made of."""
        mask = np.zeros(len(self.z), dtype=bool)
        mask[[i for unit in units for i in unit]] = True
        return mask

    def moved(self, units, A):
        """The same with the exponents of some units as the real blocks of A have them."""
        exponents, at = self.exponents.copy(), 0
        for unit in units:
            turn = A[at, at + 1] if len(unit) == 2 else 0.0
            exponents[list(unit)] = A[at, at] + 1j * turn * np.array([1.0, -1.0])[: len(unit)]
            at += len(unit)
        return replace(self, exponents=exponents)


@dataclass(frozen=True)
class ModeChoice:
    """The modes to keep, and what speaks for other ones.

    A unit is a real pole or a pair: a tuple of the places of its modes.
    """

    units: list  # that are kept
    rivals: list  # sets of as many states that explain the data as well, lists of units
    tried: list  # (sum of squares that is left, units) of the best set of each size
    left_out: float  # share of what the units leave unexplained that all modes would explain
    by_family: bool  # whether complete families were found
    total: float  # sum of squares of the outputs, each divided by its scale

    @property
    def doubtful(self):
        """Units kept that some rival does without."""
        return set(self.units) - set.intersection(set(self.units), *map(set, self.rivals))


def identified_modes(model, experiment):
    """The modes of a discrete model, in Floquet families where they were seen through a window."""
    z, V = np.linalg.eig(model.A)
    z, exponents = z.astype(complex), continuous_poles(z, model.dt)
    longest = max(segment.stop - segment.start for segment in experiment.base.segments)
    wild = exponents.real * longest * experiment.base.sample_time > MAX_GROWTH
    shapes, basis, n = (model.C @ V).T, experiment.basis, len(z)
    if not basis.harmonic:
        whole, window = np.full(n, -1), np.zeros(n, dtype=bool)
        return IdentifiedModes(z, exponents, shapes, np.arange(n), window, wild, whole, 0.0)
    window = _window_memory(z, basis)
    families = np.full(n, -1)
    families[~window] = floquet_families(z[~window], basis.rows_per_period, FAMILY_TOLERANCE)
    # a coefficient of harmonic k turns by less than half the way to the next: members further
    # out are copies
    wild |= np.abs(exponents.imag) > (highest_harmonic(basis.outputs) + 0.5) * basis.omega
    whole = _whole_families(z, np.flatnonzero(~window), basis)
    return IdentifiedModes(z, exponents, shapes, families, window, wild, whole, basis.omega)


def choose_modes(modes, experiment, n_states=None):
    """The smallest set of modes that explains the raw signals as well as all of them do.

    With ``n_states`` the best set of so many states instead. Raises ValueError if there is none.
    """
    units = modes.units
    family = {unit: modes.whole[unit[0]] for unit in units if (modes.whole[list(unit)] >= 0).all()}
    whole = family if n_states is None else {}
    R, columns = _regressors(modes, experiment)
    total = float(R[:, -1] @ R[:, -1])
    rounding, nothing = HALF_KNOWN * total, NEARLY_ALL**2 * total
    floor = residual(R, columns, tuple(range(len(units))))
    of_families = [i for i, unit in enumerate(units) if unit in whole]
    floor_whole = residual(R, columns, tuple(of_families))
    # complete families that explain most are the system's own; what explains more beside
    # them makes up for harmonics not kept, or for inputs that change between rows; unless
    # all modes leave next to nothing, as those of a harmonic decomposition do
    if floor_whole <= MATERIAL_SHARE * total + rounding and not floor <= nothing < floor_whole:
        units, columns = [units[i] for i in of_families], [columns[i] for i in of_families]
        floor = floor_whole
    sizes = [len(unit) for unit in units]
    n_coefficients = modes.shapes.shape[1]
    rankings = _rankings(R, columns, sizes, n_states, n_coefficients, floor, rounding)
    ranking = without_trifles(rankings, nothing)
    if not ranking:
        asked = "no mode" if n_states is None else f"n_states={n_states}"
        raise ValueError(
            f"{asked} cannot be kept: {sum(sizes)} states in {len(units)} real poles or conjugate "
            f"pairs are left after the window's memory and modes that turn or grow too fast are "
            f"removed (pairs stay together); change n_states, keep more harmonics, or raise the "
            f"order of the identified model"
        )
    best, picked = ranking[0]
    slack = nothing if best <= nothing else rounding
    limit = best * (1.0 + RIVAL_SHARE) + rounding
    kept = _every_family(R, columns, picked, [whole.get(unit) for unit in units])
    return ModeChoice(
        units=[units[i] for i in kept],
        rivals=[[units[i] for i in rival] for value, rival in ranking[1:] if value <= limit],
        tried=[(r[0][0], [units[i] for i in r[0][1]]) for r in rankings if r],
        left_out=1.0 - min(1.0, (floor + slack) / max(best, slack)),
        by_family=bool(whole),
        total=total,
    )


def without_trifles(rankings, nothing):
    """The ranking of the smallest size that leaves next to nothing; else that of the largest.

    Poles that are a little off leave a trace, which more modes make up for by and by; one of
    the system's own would lower what is left by decades. The rankings are those of
    :func:`best_modes` of each size in turn; ``nothing`` is a sum of squares.
    """
    last = rankings[-1] if rankings else []
    small = [r for r in rankings if r and r[0][0] <= nothing]
    return next((r for r in small if last[0][0] >= OWN_SHARE * r[0][0]), last)


def warn_of_doubt(modes, choice, opinion, n_states):
    """One warning of the modes kept that are in doubt, those missing, and what they leave out."""
    exponents, words = modes.exponents[modes.mask(choice.units)], []
    against = "" if opinion is None else contradictions(exponents, opinion)
    if against:
        words.append(against)
    if choice.doubtful:
        unit, instead = _instead(modes, choice)
        words.append(
            f"{len(choice.rivals)} other set(s) of {len(exponents)} modes explain the data as well "
            f"as the one kept: the model has {modes.exponents[unit[0]]:.4g} 1/s, one of them "
            f"{instead:.4g} 1/s instead"
        )
    if choice.left_out > DECISIVE_SHARE and n_states is None:
        words.append(
            f"the {len(exponents)} modes kept explain much less than all modes do (the others "
            f"explain {choice.left_out:.0%} of what they leave)"
        )
    if words:
        words.append(f"see modes_, or give n_states; {WAY_OUT}")
        warn("; ".join(words), IdentifiabilityWarning)


def _instead(modes, choice):
    """The slowest unit in doubt, and the exponent nearest to it of a rival without it."""
    unit = max(choice.doubtful, key=lambda unit: modes.exponents[unit[0]].real)
    rival = next(rival for rival in choice.rivals if unit not in rival)
    new = [other for other in rival if other not in choice.units] or rival
    others = modes.exponents[[other[0] for other in new]]
    return unit, min(others, key=lambda other: abs(other - modes.exponents[unit[0]]))


def verdicts(modes, choice, opinion=None):
    """Verdicts and reasons of the modes; an opinion confirms those kept, or leaves them in doubt.

    A verdict is "window", "ambiguous", "genuine", "second-order", "copy" or "weak".
    """
    kept, doubt = modes.mask(choice.units), modes.mask(choice.doubtful)
    families, exponents = modes.families, modes.exponents
    verdicts, reasons = [], []
    for i, exponent in enumerate(exponents):
        relatives = np.flatnonzero(kept & (families == families[i]))
        if modes.window[i]:
            verdict, reason = "window", "dies within the analysis window"
        elif doubt[i]:
            verdict, reason = "ambiguous", "kept, but another set explains the data as well"
        elif kept[i]:
            verdict, reason = "genuine", "needed to explain the raw signals"
        elif len(relatives):
            near = min(relatives, key=lambda j: abs(exponents[j].imag - exponent.imag))
            verdict = "copy"
            reason = f"same Floquet multiplier as the mode at {exponents[near]:.4g} rad/s"
        elif modes.wild[i]:
            verdict = "weak"
            reason = "turns faster than the harmonics kept, or grows faster than the record shows"
        else:
            verdict, reason = "weak", "adds nothing material to the raw signals"
        verdicts.append(verdict)
        reasons.append(reason)
    if opinion is not None:
        judge(verdicts, reasons, exponents, np.flatnonzero(kept), opinion)
    return verdicts, reasons


def judge(verdicts, reasons, exponents, kept, opinion):
    """Change the verdicts of modes kept that a second opinion does not confirm.

    The reasons of those that it does not judge say so.
    """
    exponents = exponents[kept]
    doubt, still = doubtful(exponents, opinion), unchanging(exponents, opinion)
    second = of_second_order(exponents, exponents[~doubt], opinion)
    for k in np.flatnonzero(doubt):
        i, known = kept[k], "sum of two others" if second[k] else "kept, but in doubt"
        verdicts[i] = "second-order" if second[k] else "ambiguous"
        against = what_it_has(exponents, opinion, k)
        reasons[i] = f"{known}: {'it does not change within the record' if still[k] else against}"
    for i in kept[~opinion.judges(exponents)]:
        reasons[i] += f"; a turn leaves less than {LASTING:g} of it: its rate is not judged"


def mode_table(exponents, families, verdicts, reasons):
    """One row a mode, slowest first."""
    table = pd.DataFrame(
        {"eigenvalue": exponents, "family": families, "verdict": verdicts, "reason": reasons}
    )
    order = np.lexsort((exponents.imag, np.abs(exponents.imag), -exponents.real))
    return table.iloc[order].reset_index(drop=True)


def _window_memory(z, basis):
    """Poles that die within the window, except those whose copies agree."""
    window = is_window_pole(z, basis.window_rows, WINDOW_DECAY)
    told = np.flatnonzero(~is_window_pole(z, basis.window_rows, FAINT))
    orders = [orders for _, orders in basis.outputs]
    window[told[agreeing_copies(z[told], orders, basis.rows_per_period)]] = False
    return window


def _whole_families(z, rest, basis):
    """Of each pole the family whose copies are all there, -1 of others.

    A weak family's copies agree less well than a strong one's: of the poles that belong to
    no family by the strictest tolerance the next are made.
    """
    rows, orders = basis.rows_per_period, [orders for _, orders in basis.outputs]
    whole = np.full(len(z), -1)
    for tolerance in COPY_TOLERANCES:
        members = rest[agreeing_copies(z[rest], orders, rows, tolerance)]
        count = int(np.max(whole, initial=-1)) + 1
        if not count and not len(members):
            break
        if len(members):
            whole[members] = floquet_families(z[members], rows, tolerance) + count
        rest = np.setdiff1d(rest, members)
    return whole


def _regressors(modes, experiment):
    """Triangular factor of the responses of all units beside the raw outputs, and columns."""
    scale = output_scale(experiment)
    return unit_regressors(
        modes.units,
        modes.exponents,
        modes.shapes,
        [u / input_scale(experiment) for u in experiment.drive],
        scaled_outputs(experiment),
        experiment.base.sample_time,
        [part / scale[:, None] for part in observations(experiment)],
    )


def _rankings(R, columns, sizes, n_states, n_coefficients, floor, rounding):
    """The best sets of each size, up to one that leaves nothing material; of n_states alone."""
    wanted = range(1, sum(sizes) + 1) if n_states is None else [int(n_states)]
    ranking, rankings = [], []
    for n in wanted:
        smaller = [best[0] for best in rankings[-2:] if best]
        ranking = best_modes(R, columns, sizes, n, smaller) or ranking
        rankings.append(ranking)
        # in harmonic-decomposition form the output coefficients are the states: more are
        # kept only where so many leave out what matters (noise can pair a real pole)
        share = MATERIAL_SHARE if n < n_coefficients else DECISIVE_SHARE
        if ranking and ranking[0][0] <= floor / (1.0 - share) + rounding:
            break
    return rankings


def _every_family(R, columns, picked, families):
    """The units picked, and of each family without one that which explains most."""
    for family in sorted(set(families) - {families[i] for i in picked} - {None}):
        own = [i for i, f in enumerate(families) if f == family]
        best = min(own, key=lambda i: residual(R, columns, (*picked, i)))
        picked = (*picked, best)
    return picked


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
