"""From a period-synchronous model to the linear time-periodic one behind it, in closed form.

1. The Poincaré map Φ, refined on the raw record; what every sample of the period sees of
   the state; from both the mode shapes P(ψ) and R = log(Φ)/T.
2. F(ψ) = (P′ + P R) P⁻¹ where the outputs determine the state; else Floquet coordinates,
   in which F = R and the outputs are P(ψ) x.
3. G(ψ) and Q(ψ) by linear least squares on the raw record.
"""

import warnings
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import linalg, sparse

from sklearn_hd._continuous import output_scale
from sklearn_hd._data import lifted_periods, rows_read
from sklearn_hd._periodic import PeriodicModel
from sklearn_hd.algorithms.equation_error import equation_error
from sklearn_hd.algorithms.floquet_coordinates import fixed_scale, floquet_coordinates
from sklearn_hd.algorithms.fourier import sampled_harmonics
from sklearn_hd.algorithms.lifting import input_directions
from sklearn_hd.algorithms.mode_shapes import shape_condition
from sklearn_hd.algorithms.multipliers import RefinedMap, refine_multipliers
from sklearn_hd.algorithms.periodic_realization import (
    FloquetError,
    fit_shapes,
    floquet_logarithm,
    leaves_white_noise,
    state_response,
    told_apart,
    without_noise,
)
from sklearn_hd.algorithms.periodic_structure import PeriodicStructure, sampled_response
from sklearn_hd.algorithms.sensitivity import linear_response
from sklearn_hd.algorithms.shape_exponents import refine_within_period
from sklearn_hd.algorithms.structured_model import column_sizes
from sklearn_hd.exceptions import IdentifiabilityWarning

N_INPUT_HARMONICS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
MAX_GROWTH = 100.0  # e-folds over a record
ROUNDING = 1e-28
LEAST_DECAY = 4  # periods for each state in a free decay that can stand alone
REST_SHARE = 1e-9  # of an input's largest value, below which it is at rest
SHAPE_CONDITION = 1e4  # of P(ψ), beyond which outputs do not determine the state
RANK = 1e-11  # singular values relative to the largest; deficient regressors have 1e-15
NULL_SHARE = 1e-6  # of a parameter's direction in the null space
LARGEST_FIT = 4e7  # numbers in one regressor matrix
TAIL = 1e-2  # harmonics of F this small, in parts of the noise, are left out
NOISY = 1e-6  # of the shapes: then a second way to F is tried
CLEARLY_LESS = 0.98  # left of the record by the second way, in parts of that of the first
A_TENTH_LESS = 0.9  # left by the multipliers identified, in parts of that by the refined ones
HARDLY_MORE = 1.1  # the same, where in the first way noise hides that outputs are the states
MOST_SYSTEMATIC = 1e-2  # of the record's variance, in what noise alone would leave
EQUATION_HARMONICS = 2  # of F and G in the equation-error start
LEAST_TAIL = 1e-13  # in parts of F, where there is no noise


class GrowthError(ValueError):
    """A model that grows more over a record than numbers can hold."""


@dataclass(frozen=True, eq=False)
class Realization:
    """A periodic model in closed form, and how far it can be trusted.

    Attributes
    ----------
    model : PeriodicModel
    structure : PeriodicStructure
        Whose parameters the model's coefficients are.
    theta : ndarray
    physical : bool
        Whether the states are outputs, rather than Floquet coordinates.
    r2 : float
        Share of the raw record's variance that the model explains.
    systematic : float
        Share of it that stands unexplained and is no white noise: covariance of what is
        left of neighbouring samples.
    unidentified : tuple of str
        Parameters of G and Q that the record does not determine.
    """

    model: PeriodicModel
    structure: PeriodicStructure
    theta: np.ndarray
    physical: bool
    r2: float
    systematic: float
    unidentified: tuple


def realize(model, experiment, structure):
    """Periodic model behind a period-synchronous one, in closed form.

    Parameters
    ----------
    model : LTIModel
        Discrete, from one period to the next.
    experiment : Experiment
    structure : HarmonicStructure

    Returns
    -------
    realization : Realization

    Raises
    ------
    FloquetError, GrowthError
        If the multipliers or F(ψ) are those of no periodic system, or of one that outgrows
        numbers, and measured states lead to no better ones.
    """
    if structure.n_states not in (None, model.n_states):
        raise ValueError(
            f"the structure has {structure.n_states} states, the identified model "
            f"{model.n_states}; identify with MOESPRegressor(order={structure.n_states}), or "
            f"change the structure"
        )
    _check_harmonics(structure, experiment.basis.samples_per_period)
    scale = output_scale(experiment)
    try:
        found, noise = _in_closed_form(model, experiment, structure, scale)
    except (FloquetError, GrowthError) as error:
        other = _from_equation_error(model, experiment, structure, scale)
        if other is None or other.systematic > MOST_SYSTEMATIC:
            raise  # not noise, but the order is at fault
        return _told(other, model, f"is that of no periodic system ({error})")
    if len(structure.states or experiment.basis.outputs) != model.n_states:
        if structure.n_states is None and found.systematic > MOST_SYSTEMATIC:
            other = _from_equation_error(model, experiment, structure, scale)
            if other is not None and other.systematic <= MOST_SYSTEMATIC:
                return _told(other, model, f"leaves {found.systematic:.2g} of the variance")
    elif noise > NOISY and 1.0 - found.r2 > NOISY**2:
        other = _from_equation_error(model, experiment, structure, scale)
        enough = CLEARLY_LESS if found.physical else HARDLY_MORE
        if other is not None and 1.0 - other.r2 < enough * (1.0 - found.r2):
            return other
    return found


def _told(realization, model, why):
    """A realization by measured states, after a warning if it has another number of states."""
    n = realization.model.n_states
    if n != model.n_states:
        warnings.warn(
            f"the model identified has {model.n_states} state(s), and {why}; with the {n} outputs "
            f"{list(realization.model.state_names)} as states all but noise is explained, and they "
            f"are taken; MOESPRegressor(order={n}) asks for them, HarmonicStructure(states=[...]) "
            f"for others",
            IdentifiabilityWarning,
            stacklevel=7,
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
    inputs = lifted_periods(experiment, experiment.inputs)
    outputs = lifted_periods(experiment, experiment.outputs, scale)
    directions, _, _ = input_directions(
        inputs, most_directions(sum(map(len, outputs)), model.n_states)
    )
    clean = without_noise(model.A, directions, [y.reshape(len(y), -1) for y in outputs])
    instruments = [each.reshape(-1, len(names))[:, rows] for each in clean]
    segments = [
        (y.reshape(-1, len(names))[:, rows], u.reshape(len(y) * spp, -1), 0)
        for y, u in zip(outputs, inputs, strict=True)
    ]
    count = min(EQUATION_HARMONICS, (spp - 1) // 2)
    F, _ = equation_error(segments, 2.0 * np.pi / basis.omega, spp, count, instruments)
    P = np.eye(len(names))[:, rows]
    free = {"F": F * scale[rows][:, None] / scale[rows], "P": P[None]}
    n_harmonics = {"F": given(structure, "F", count), "P": given(structure, "P", None)}
    problem = _InputProblem(structure, tuple(states), experiment, free, None, scale)
    try:
        return problem.solve(n_harmonics, physical=True)
    except GrowthError:
        return None


def _in_closed_form(model, experiment, structure, scale):
    """The realization by P(ψ) and R, and the noise of what P was fitted to."""
    basis = experiment.basis
    spp = basis.samples_per_period
    shapes = _shapes(model, experiment, scale)
    names = [name for name, _ in basis.outputs]
    rows = _state_outputs(shapes, structure, names, spp)
    psi = 2.0 * np.pi * np.arange(spp) / spp
    P, _ = shapes(psi)
    highest = (spp - 1) // 2
    count = min(shapes.n_harmonics, highest)
    if rows is None:
        F, P, form = floquet_coordinates(shapes, psi, basis.omega)
        turned = bool(shapes.flips.any())
        states = tuple(f"z{i + 1}" for i in range(len(F[0])))
        n_harmonics = {"F": int(turned), "P": min(count + turned, highest)}
    else:
        F, form = shapes.state_matrix(psi, basis.omega, rows), None
        P = P @ np.linalg.inv(P[:, rows])
        states = tuple(names[i] for i in rows)
        n_harmonics = {"F": tail_begins(F, shapes.noise), "P": tail_begins(P, shapes.noise)}
        if set(names) == set(states):
            n_harmonics["P"] = None
        F, P = F * scale[rows][:, None] / scale[rows], P / scale[rows]
    P = P * scale[:, None]
    for name in n_harmonics:
        n_harmonics[name] = given(structure, name, n_harmonics[name])
    free = {
        name: sampled_harmonics(values, n_harmonics[name] or 0)
        for name, values in (("F", F), ("P", P))
    }
    problem = _InputProblem(structure, states, experiment, free, form, scale)
    return problem.solve(n_harmonics, physical=rows is not None), shapes.noise


def tail_begins(values, noise):
    """Highest harmonic of a sampled periodic matrix that counts.

    The inverse in F = (P′ + P R) P⁻¹ has all harmonics, however few P has; they fall
    geometrically where P P₀⁻¹ stays near the identity.

    Parameters
    ----------
    values : ndarray, shape (n_phases, rows, columns)
    noise : float
        Of what the values were made from, in parts of its size.
    """
    highest = (len(values) - 1) // 2
    coefficients = sampled_harmonics(values, highest)
    sizes = np.sum(coefficients**2, axis=(1, 2))
    beyond = np.sqrt(np.cumsum(sizes[::-1])[::-1])[1::2]  # from harmonic 1, 2, … on
    counts = np.flatnonzero(beyond > max(TAIL * noise, LEAST_TAIL) * np.sqrt(np.sum(sizes)))
    return int(counts[-1]) + 1 if len(counts) else 0


def given(structure, name, default):
    """Number of harmonics that the structure asks for, or a default."""
    asked = structure.n_harmonics(name)
    return default if asked is None else asked


def _check_harmonics(structure, samples_per_period):
    """Raise ValueError if the structure has harmonics that the samples cannot tell apart."""
    most = (samples_per_period - 1) // 2
    for name in "FGPQ":
        asked = structure.n_harmonics(name)
        if asked is not None and asked > most:
            raise ValueError(
                f"the structure has harmonic {asked} of {name}, and {samples_per_period} samples a "
                f"period tell at most {most} apart; give {name} fewer harmonics, or sample faster"
            )


# ---- the free response -----------------------------------------------------------------------


def _shapes(model, experiment, scale):
    """Mode shapes of the outputs, in parts of their scale."""
    basis = experiment.basis
    spp = basis.samples_per_period
    inputs = lifted_periods(experiment, experiment.inputs)
    outputs = lifted_periods(experiment, experiment.outputs, scale)
    n_periods, n = sum(map(len, outputs)), model.n_states
    directions, _, _ = input_directions(inputs, most_directions(n_periods, n))
    lifted = [y.reshape(len(y), -1) for y in outputs]
    _, seen = rows_read(experiment)
    unit = _sizes(np.vstack(seen))
    over, C = [Y / unit for Y in seen], model.C / unit[:, None]
    refined = refine_multipliers(model.A, directions, lifted)
    refined = _unless_it_explains_less(refined, model.A, C, directions, lifted, over)
    largest = np.max(np.abs(linalg.eigvals(refined.Phi)))
    growth = max(map(len, outputs)) * np.log(max(largest, 1e-300))
    if growth > MAX_GROWTH:
        raise GrowthError(
            f"a mode of the identified model grows e^{growth:.0f} times over the record, more than "
            f"a record can show: lower the order, check omega, or cut the record shorter"
        )
    Phi = refined.Phi
    if leaves_white_noise(Phi, directions, lifted):
        Phi = refine_within_period(refined, C, directions, lifted, over, spp)
    else:
        # systematic errors, a nonlinear system's: smallest where the motion dies away
        free = free_decays(inputs)
        decays = [lifted[s][rows] for s, rows in free]
        if sum(map(len, decays)) > LEAST_DECAY * n and told_apart(Phi, decays):
            lifted, seen = ([blocks[s][rows] for s, rows in free] for blocks in (lifted, seen))
            directions = [np.zeros((len(block), 0)) for block in lifted]
            Phi = refine_multipliers(Phi, directions, lifted).Phi
            n_periods = sum(map(len, lifted))
    sights, information, residual = state_response(
        Phi, C, directions, lifted, [Y / unit for Y in seen]
    )
    R, to_original, flips = floquet_logarithm(Phi, 2.0 * np.pi / basis.omega)
    back = linalg.inv(to_original)
    sights = sights.reshape(spp, -1, n) @ to_original
    n_rows = n_periods - directions[0].shape[1] - n
    return fit_shapes(
        sights,
        back @ information @ back.T,
        residual.reshape(spp, -1),
        R,
        flips,
        2.0 * np.pi / basis.omega,
        n_rows,
    )


def _unless_it_explains_less(refined, identified, C, directions, lifted, seen):
    """The refined map, or the identified one where that leaves a tenth less of the record.

    Multipliers are refined with every mode free to answer in its own way to each direction of
    the inputs. Many modes that last but a period or two can then stand for each other, and noise
    decides; with one B for all that is seen they cannot.
    """
    if refined.basis is None:
        return refined
    left, others = (
        np.sum(state_response(Phi, C, directions, lifted, seen)[2])
        for Phi in (refined.Phi, identified)
    )
    return RefinedMap(identified) if others < A_TENTH_LESS * left else refined


def free_decays(inputs):
    """Periods of each segment after the last in which an input moves: (segment, rows)."""
    largest = np.max(np.abs(np.concatenate(inputs)), axis=(0, 1), initial=0.0)
    tails = []
    for s, u in enumerate(inputs):
        moving = np.flatnonzero(np.any(np.abs(u) > REST_SHARE * largest, axis=(1, 2)))
        tails.append((s, slice(moving[-1] + 1 if len(moving) else 0, len(u))))
    return [(s, rows) for s, rows in tails if len(inputs[s][rows])]


def most_directions(n_periods, n_states):
    """Directions of the inputs that some periods can tell from the states."""
    return max(1, n_periods // 2 - n_states)


def _sizes(columns):
    sizes = np.sqrt(np.mean(columns**2, axis=0))
    return np.where(sizes > 0.0, sizes, 1.0)


def _state_outputs(shapes, structure, names, n_phases):
    """Which outputs are the states; None if no choice of them determines the state."""
    n = len(shapes.R)
    P, _ = shapes(2.0 * np.pi * np.arange(n_phases) / n_phases)
    if structure.states is not None:
        unknown = [name for name in structure.states if name not in names]
        if unknown:
            raise ValueError(
                f"states={list(structure.states)} must be {n} of the outputs {names}, and "
                f"{unknown} are not among them"
            )
        rows = [names.index(name) for name in structure.states]
        if not _invertible(P[:, rows], shapes.flips):
            raise ValueError(
                f"the outputs {list(structure.states)} do not determine the {n} states; leave "
                f"states=None, or name others of {names}"
            )
        return rows
    for rows in combinations(range(len(names)), n):
        if _invertible(P[:, list(rows)], shapes.flips):
            return list(rows)
    if entries := structure.given_entries():
        raise ValueError(
            f"the outputs {names} do not determine the {n} states that the structure gives entries "
            f"of {', '.join(entries)} for; measure more outputs, or give numbers of harmonics (or "
            f"nothing), which leads to Floquet coordinates"
        )
    return None


def _invertible(P, flips):
    """Whether P(ψ) is, also between the samples: its determinant does not pass through zero."""
    if np.sum(flips) % 2 or not shape_condition(P) < SHAPE_CONDITION:
        return False
    return len(np.unique(np.sign(np.linalg.det(P)))) == 1


# ---- the inputs' way in ----------------------------------------------------------------------


class _InputProblem:
    """G(ψ) and Q(ψ) of a system of known F and P, by linear least squares on the raw record."""

    def __init__(self, structure, states, experiment, free, form, scale):
        basis = experiment.basis
        self.structure, self.free, self.form = structure, free, form
        self.names = states, tuple(s for s, _ in basis.inputs), tuple(s for s, _ in basis.outputs)
        self.experiment, self.scale = experiment, scale
        self.phases = [basis.phase_index(time) for time in experiment.times()]

    def solve(self, n_harmonics, physical):
        """The realization with as many harmonics of G as the data show (Schwarz's criterion).

        And as they determine: inputs that change at a few phases of the period tell more
        harmonics apart only where the outputs are the states.
        """
        spp, best, worse = self.experiment.basis.samples_per_period, None, 0
        asked = self.structure.n_harmonics("G")
        for count in N_INPUT_HARMONICS if asked is None else [asked]:
            if best is not None and (count > (spp - 1) // 2 or self._numbers(count) > LARGEST_FIT):
                break
            found = self._fit({**n_harmonics, "G": count}, physical)
            if best is not None and len(found[1].unidentified) > len(best[1].unidentified):
                break
            worse = 0 if best is None or found[0] < best[0] else worse + 1
            best = found if worse == 0 else best
            if worse == 2:
                break
        return best[1]

    def _numbers(self, count):
        n, m = len(self.names[0]), len(self.names[1])
        n_rows = sum(y.size for y in self.experiment.outputs)
        return n_rows * ((2 * count + 1) * n * m + n * len(self.phases))

    def _fit(self, n_harmonics, physical):
        """Schwarz's criterion, and the realization, with some number of harmonics of G."""
        full = self.structure.resolve(*self.names, n_harmonics, form=self.form)
        linear = self._known_states(full)
        gains, left, unknown = self._least_squares(linear)
        n_rows, rss = len(left), np.sum(left**2, axis=0)
        found = linear.coefficients(gains)
        theta = full.nearest(found)
        basis = self.experiment.basis
        model = PeriodicModel(full.coefficients(theta), basis.omega, *self.names)
        if self.form is not None:
            full, theta = fixed_scale(full, theta, self.form)
        fit = n_rows * float(np.sum(np.log(np.maximum(rss, ROUNDING * n_rows))))
        bic = fit + np.log(n_rows * len(rss)) * len(gains)
        total = sum(float(np.sum((y / self.scale) ** 2)) for y in self.experiment.outputs)
        shares = 1.0 - float(np.sum(rss)) / total, float(np.sum(left[1:] * left[:-1])) / total
        unknown = tuple(np.array(linear.parameter_names, dtype=object)[unknown])
        return bic, Realization(model, full, theta, physical, *shares, unknown)

    def _known_states(self, full):
        """The structure with F and P as found (as near as it allows), G and Q left free."""
        n = full.n_states
        guess = np.zeros(full.constant.shape)
        for name, part in (("F", guess[:, :n, :n]), ("P", guess[:, n:, :n])):
            part[: len(self.free[name])] = self.free[name][: len(part)]
        constant = full.constant.copy()
        constant[:, :, :n] = full.coefficients(full.nearest(guess))[:, :, :n]
        columns = np.unravel_index(np.arange(constant.size), constant.shape)[2]
        entries = sparse.csr_array(full.basis * (columns >= n))  # not F's that share a name
        entries.eliminate_zeros()
        drives = np.diff(entries.indptr) > 0
        names = tuple(np.array(full.parameter_names, dtype=object)[drives])
        return PeriodicStructure(constant, entries[drives], n, names)

    def _least_squares(self, linear):
        """Parameters that enter linearly, what they leave of the outputs (in parts of their
        scale), and which of them the record does not determine."""
        blocks = []
        spp = self.experiment.basis.samples_per_period
        response = sampled_response(linear, np.zeros(linear.n_parameters), self.omega, spp)
        self._check_growth(response)
        for s, (u, y, phase) in enumerate(
            zip(self.experiment.inputs, self.experiment.outputs, self.phases, strict=True)
        ):
            forced, given, free = linear_response(response, u, phase)
            rows = np.zeros(
                (*y.shape, linear.n_parameters + len(self.phases) * linear.n_states + 1)
            )
            rows[:, :, : linear.n_parameters] = forced
            start = linear.n_parameters + s * linear.n_states
            rows[:, :, start : start + linear.n_states] = free
            rows[:, :, -1] = y - given
            blocks.append(rows / self.scale[:, None])
        rows = np.concatenate(blocks)
        n_rows = len(rows)
        rows = rows.reshape(-1, rows.shape[-1])
        size = column_sizes(rows[:, :-1])
        R = linalg.qr(rows / np.append(size, 1.0), mode="r")[0][: len(size)]
        U, values, Vt = linalg.svd(R[:, :-1])
        kept = values > RANK * np.max(values, initial=0.0)
        solution = Vt[kept].T @ (U[:, kept].T @ R[:, -1] / values[kept]) / size
        left = rows[:, -1] - rows[:, :-1] @ solution
        unknown = np.linalg.norm(Vt[~kept], axis=0) > NULL_SHARE
        k = linear.n_parameters
        return solution[:k], left.reshape(n_rows, -1), unknown[:k]

    def _check_growth(self, response):
        periods = max(map(len, self.phases)) / max(len(response.Phi), 1)
        growth = periods * np.log(max(response.spectral_radius, 1e-300))
        if not growth <= MAX_GROWTH:
            raise GrowthError(
                f"F(ψ) of the states {list(self.names[0])} with the harmonics allowed makes a "
                f"model that grows e^{growth:.0f} times over the record; allow more harmonics of "
                f"F, sample more often, or change the order of the model"
            )

    @property
    def omega(self):
        return self.experiment.basis.omega
