"""Coordinates in which a periodic system of known mode shapes is as constant as can be.

With y = P(ψ) e^{Rt} q and z = e^{Rt} q, ż = R z: F is constant, and all that is periodic
stands in the outputs. Modes of negative real multipliers have shapes that change sign from
one period to the next. They come in pairs; coordinates z' that turn by half a revolution a
period make them periodic, and F a first harmonic:

    z' = S(ψ/2) z,   F = ω/2 J + S(ψ/2) R S(ψ/2)ᵀ,   J = [0 −1; 1 0]
    S diag(r1, r2) Sᵀ = (r1 + r2)/2 I + (r1 − r2)/2 [cos ψ  sin ψ; sin ψ  −cos ψ]
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EPS
from sklearn_hd.algorithms.periodic.multipliers import SEPARATION
from sklearn_hd.algorithms.periodic.periodic_realization import FloquetError
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

SINGLE, PAIR, TURNED = "single", "pair", "turned"
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])  # a turn by a quarter: J
SWING = np.array([np.zeros((2, 2)), [[1.0, 0.0], [0.0, -1.0]], [[0.0, 1.0], [1.0, 0.0]]])


@dataclass(frozen=True, eq=False)
class FloquetForm:
    """F(ψ) of a system in Floquet coordinates, by what it may be."""

    # (3, n, n): Fourier coefficients of F with all exponents zero, in the order 0, 1c, 1s
    constant: np.ndarray
    directions: dict  # (3, n, n): what one unit of each parameter adds
    values: np.ndarray  # (n,): the parameters
    columns: tuple  # of (str, int): kind of each mode or pair of modes, and its first coordinate

    @property
    def n_harmonics(self):
        """Highest harmonic of F: 1 where coordinates turn, 0 elsewhere."""
        return int(any(kind == TURNED for kind, _ in self.columns))

    def __call__(self, psi):
        """F at some phases, shape (n_points, n, n)."""
        coefficients = self.constant + np.tensordot(
            self.values, np.array(list(self.directions.values())), 1
        )
        return np.tensordot(harmonic_functions(psi, range(2)), coefficients, 1)


def floquet_coordinates(shapes, psi, omega, units=1.0):
    """F and P at some phases, in Floquet coordinates.

    Each mode's shape has an rms of one over a turn, whatever the states were that it was found
    from; without a form, all shapes together. Outputs are multiplied by ``units``,
    (l,), before their shapes have that size. Returns (F, P, form), of shapes
    (n_points, n, n) and (n_points, l, n). The form says what F may be; it is None if
    its modes are too close to be told apart. It raises FloquetError if an odd number of
    multipliers is negative.
    """
    P, _ = shapes(psi)
    n, n_flips = len(shapes.R), int(np.sum(shapes.flips))
    if n_flips % 2:
        raise FloquetError(
            f"the Floquet multipliers found hold {n_flips} negative real one(s), an odd number, "
            f"which no real system has (the product of its multipliers is positive): the order is "
            f"wrong, noise hides the fast modes, or omega is a multiple of the machine's; try "
            f"order={n + 1}{f' or {n - 1}' if n > 1 else ''}, or a longer record, and check omega"
        )
    turn = _half_turns(psi, n, n_flips)
    back = turn.mT
    spin = np.zeros((n, n))
    spin[:n_flips, :n_flips] = linalg.block_diag(*[0.5 * omega * QUARTER] * (n_flips // 2))
    n_points = 4 * shapes.coefficients.shape[1]  # for all harmonics of squares
    whole = 2.0 * np.pi * np.arange(n_points) / n_points
    seen = np.reshape(units, (-1, 1)) * shapes(whole)[0]
    modes = _modes(shapes.R, n_flips)
    if modes is None:
        size = np.sqrt(np.mean(np.sum(seen**2, axis=(1, 2))))
        return spin + turn @ shapes.R @ back, P @ back / (size or 1.0), None
    to_modal, form = _form(*modes, spin, n_flips)
    to_modal = to_modal / _sizes(seen @ to_modal, form)
    return form(psi), P @ to_modal @ back, form


def _half_turns(psi, n, n_flips):
    """Rotations by ψ/2 in the first planes, shape (n_points, n, n)."""
    turn = np.zeros((len(psi), n, n)) + np.eye(n)
    c, s = np.cos(0.5 * psi), np.sin(0.5 * psi)
    for i in range(0, n_flips, 2):
        turn[:, i, i], turn[:, i, i + 1] = c, -s
        turn[:, i + 1, i], turn[:, i + 1, i + 1] = s, c
    return turn


def _modes(R, n_flips):
    """Exponents and vectors of the modes, one of each pair; None if some are too close.

    Those whose shapes change sign come first, and of them the real ones.
    """
    exponents, V = np.zeros(0, dtype=complex), np.zeros((0, 0), dtype=complex)
    for part in (R[:n_flips, :n_flips], R[n_flips:, n_flips:]):
        found, vectors = linalg.eig(part) if len(part) else (np.zeros(0), np.zeros((0, 0)))
        size = np.max(np.abs(found), initial=0.0)
        gaps = np.abs(found[:, None] - found) + np.eye(len(found)) * size
        if np.any(gaps <= SEPARATION * size):
            return None
        order = np.lexsort((found.imag, -found.real, found.imag != 0.0))
        lead = [i for i in order if found[i].imag >= 0.0]
        exponents = np.append(exponents, found[lead])
        V = linalg.block_diag(V, vectors[:, lead]) if len(lead) else V
    return exponents, V


def _form(exponents, V, spin, n_flips):
    """The way to modal coordinates, and F in them."""
    n = len(spin)
    columns, directions, values, kinds, at = [], {}, [], [], 0
    for k, e in enumerate(exponents):
        name, place = f"exponent_{k + 1}", np.zeros((3, n, n))
        if e.imag:
            columns += [V[:, k].real, V[:, k].imag]
            pair, turned = place, place.copy()
            pair[0, at : at + 2, at : at + 2] = np.eye(2)
            turned[0, at : at + 2, at : at + 2] = -QUARTER
            directions |= {f"{name}_real": pair, f"{name}_imag": turned}
            values += [e.real, e.imag]
            kinds.append((PAIR, at))
            at += 2
            continue
        columns.append(V[:, k].real)
        if at >= n_flips:
            place[0, at, at] = 1.0
            kinds.append((SINGLE, at))
        else:
            plane = slice(at - at % 2, at - at % 2 + 2)
            place[0, plane, plane] = 0.5 * np.eye(2)
            place[:, plane, plane] += (0.5 - at % 2) * SWING
            kinds += [(TURNED, at)] * (1 - at % 2)
        directions[name] = place
        values.append(e.real)
        at += 1
    constant = np.zeros((3, n, n))
    constant[0] = spin
    form = FloquetForm(constant, directions, np.array(values), tuple(kinds))
    return np.stack(columns, axis=1), form


# ---- the scale of each mode --------------------------------------------------------------------


def _sizes(P, form):
    """The rms of each mode's shape, of both columns of a pair; one where rounding is all of it."""
    squares = np.mean(np.sum(P**2, axis=1), axis=0)
    for kind, at in form.columns:
        if kind == PAIR:
            squares[at : at + 2] = squares[at : at + 2].sum()
    sizes = np.sqrt(squares)
    return np.where(sizes > EPS * sizes.max(), sizes, 1.0)


def fixed_scale(structure, theta, form):
    """A structure in Floquet coordinates whose states' scale is fixed, and its parameters.

    Scaling a mode's coordinate (turning it, for a pair) changes P and G against each other,
    and no output: what is largest of each mode's shape is held at its value. The
    parameters become fewer by n.
    """
    n = structure.n_states
    shapes = structure.coefficients(theta)[:, n:, :n]
    for kind, at in form.columns:
        for weights in _SCALES[kind](shapes, at):
            functional = np.zeros(structure.constant.shape)
            functional[:, n:, :n] = weights
            structure, theta = _held(structure, theta, functional)
    return structure, theta


def _largest(shapes, at):
    """The largest coefficient of one column."""
    place = np.unravel_index(np.argmax(np.abs(shapes[:, :, at])), shapes.shape[:2])
    weights = np.zeros(shapes.shape)
    weights[(*place, at)] = 1.0
    return [weights]


def _largest_of_pair(shapes, at):
    """The same coefficient of both columns of a pair."""
    (first,) = _largest(shapes, at)
    return [first, np.roll(first, 1, axis=2)]


def _largest_values(shapes, at):
    """Each mode of a turned plane where it is largest: p1 = c P_1 + s P_2, p2 = c P_2 − s P_1."""
    n_harmonics = len(shapes) // 2
    psi = 2.0 * np.pi * np.arange(4 * n_harmonics + 4) / (4 * n_harmonics + 4)
    functions = harmonic_functions(psi, range(n_harmonics + 1))
    P = np.tensordot(functions, shapes[:, :, at : at + 2], 1)  # (n_points, l, 2)
    c, s = np.cos(0.5 * psi), np.sin(0.5 * psi)
    found = []
    for shares in (np.stack([c, s], axis=1), np.stack([-s, c], axis=1)):
        mode = np.einsum("plj,pj->pl", P, shares)
        point, output = np.unravel_index(np.argmax(np.abs(mode)), mode.shape)
        weights = np.zeros(shapes.shape)
        weights[:, output, at : at + 2] = np.outer(functions[point], shares[point])
        found.append(weights)
    return found


_SCALES = {SINGLE: _largest, PAIR: _largest_of_pair, TURNED: _largest_values}


def _held(structure, theta, functional):
    """A structure on which one linear functional of its coefficients keeps its value.

    The parameter that moves it most is eliminated; the others keep their meaning.
    """
    slopes = structure.basis @ functional.ravel()
    k = int(np.argmax(np.abs(slopes)))
    if slopes[k] == 0.0:
        return structure, theta
    rest = np.arange(len(theta)) != k
    own = structure.basis[[k]].toarray()
    moved = (slopes @ theta / slopes[k]) * own.reshape(structure.constant.shape)
    basis = structure.basis[rest] - structure.basis[[k] * int(rest.sum())].multiply(
        (slopes[rest] / slopes[k])[:, None]
    )
    names = tuple(np.array(structure.parameter_names, dtype=object)[rest])
    return PeriodicStructure(structure.constant + moved, basis, structure.n_states, names), theta[
        rest
    ]
