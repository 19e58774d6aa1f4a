"""From a discrete periodic model to the continuous one whose samples it is, and back.

    x[j+1] = A_j x[j] + B_j u,   y[j] = C_j x[j] + D_j u,   q steps a turn

1. The modes of A_{q−1} … A_0 are split by their size, and each group is carried through the turn
   by itself: its states move as X(ψ) e^{Rt}, with R = log(±Φ)/T and X periodic.
2. Outputs see P(ψ) = C X. Where they determine the state, they are the states, F(ψ) =
   (P′ + P R) P⁻¹; else Floquet coordinates, in which F = R and the exponents are exact.
3. G(ψ) moves the states over each step, inputs held, as B_j does.

A structure that is asked for takes the parameters of the nearest steps: what a step does to states
and inputs is as well determined as the discrete model is; F itself is a difference of its steps.
"""

from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np
from scipy import linalg, optimize

from sklearn_hd.algorithms.linalg.rounding import EPS, EXACT, HALF
from sklearn_hd.algorithms.lti.simulation import discrete_to_continuous
from sklearn_hd.algorithms.periodic.floquet import scaled_product, separated_factors, steps_between
from sklearn_hd.algorithms.periodic.floquet_coordinates import FloquetForm, floquet_coordinates
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, trimmed_harmonics
from sklearn_hd.algorithms.periodic.periodic_realization import (
    FloquetError,
    FloquetShapes,
    floquet_logarithm,
    interpolated_shapes,
    outputs_are_states,
    tail_begins,
)
from sklearn_hd.algorithms.periodic.periodic_structure import (
    PeriodicStructure,
    held_pushes,
    n_substeps,
    sampled_response,
)
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics
from sklearn_hd.algorithms.signals.resampling import turned

FINER = 16  # azimuths for each sample, at which F is formed
FEWEST = 256  # azimuths
FASTEST = -np.log(EPS)  # time constants within a sample, of which nothing is left
MOST_CHOICES = 1000  # of outputs as states, that are tried


def behind_samples(innovations, omega):
    """The continuous model behind a discrete periodic one, outputs its states where they can be.

    It raises ValueError if a model without harmonics has an eigenvalue on the closed
    negative real axis, and FloquetError if the multipliers of one with harmonics are
    those of no periodic system.
    """
    if innovations.n_harmonics == 0:
        return time_invariant(innovations, omega)
    turn = turn_of(innovations, omega)
    return turn.model(turn.state_outputs())


@dataclass(frozen=True, eq=False)
class ContinuousModel:
    """Fourier coefficients of a continuous periodic system, in the order 0, 1c, 1s, ….

    F, G, P and Q have shapes (2 K + 1, rows, columns), each with a K of its own.
    ``rows`` are the outputs that are the states, and None in Floquet coordinates.
    ``form`` is what F may be there, or None.
    """

    F: np.ndarray
    G: np.ndarray
    P: np.ndarray
    Q: np.ndarray
    rows: list | None
    form: FloquetForm | None

    @property
    def coefficients(self):
        """Of [F G; P Q](ψ), shape (2 K + 1, n + l, n + m)."""
        n, parts = self.F.shape[1], (self.F, self.G, self.P, self.Q)
        shape = n + self.P.shape[1], n + self.G.shape[2]
        whole = np.zeros((max(map(len, parts)), *shape))
        corners = (whole[:, :n, :n], whole[:, :n, n:], whole[:, n:, :n], whole[:, n:, n:])
        for part, corner in zip(parts, corners, strict=True):
            corner[: len(part)] = part
        return whole

    def state_names(self, output_names):
        """Names of the states: the outputs that they are, else z1, z2, …."""
        if self.rows is None:
            return tuple(f"z{i + 1}" for i in range(self.F.shape[1]))
        return tuple(output_names[i] for i in self.rows)


@dataclass(frozen=True, eq=False)
class Turn:
    """A turn of a discrete periodic model in Floquet form."""

    psi: np.ndarray  # (q,)
    omega: float
    shapes: FloquetShapes  # of the outputs, then of the discrete states
    B: np.ndarray  # (q, n, m)
    D: np.ndarray  # (2 K + 1, l, m)

    @property
    def n_outputs(self):
        """Number of outputs."""
        return self.D.shape[1]

    @property
    def fine(self):
        """Azimuths, from 0, that tell the harmonics of F."""
        n_points = max(FEWEST, FINER * len(self.psi))
        return 2.0 * np.pi * np.arange(n_points) / n_points

    def state_outputs(self):
        """The first outputs that can be the states; None if no choice of them can."""
        return next((rows for rows in self.choices() if self.determined_by(rows)), None)

    def choices(self):
        """As many outputs as there are states; those without a feedthrough before the others."""
        n, direct = len(self.shapes.R), np.any(self.D != 0.0, axis=(0, 2))
        for wanted in (False, True):
            for rows in map(list, islice(combinations(range(self.n_outputs), n), MOST_CHOICES)):
                if np.any(direct[rows]) == wanted:
                    yield rows

    def determined_by(self, rows):
        """Whether some outputs, except for a feedthrough, can be the states: F(ψ) is resolved, and
        moves no faster than samples can show."""
        if len(rows) != len(self.shapes.R):
            return False
        P = self.shapes(self.fine)[0][:, rows]
        if not outputs_are_states(P, self.shapes.flips):
            return False
        F = self.shapes.state_matrix(self.fine, self.omega, rows)
        if tail_begins(F, 0.0) >= len(F) // 4:
            return False
        F = _resolved(F)
        structure = PeriodicStructure(F, np.zeros((0, F.size)), len(rows), ())
        return n_substeps(structure, [], self.omega, len(self.psi)) <= FASTEST

    def model(self, rows=None):
        """The continuous model, with some outputs as states or in Floquet coordinates.

        In Floquet coordinates, it raises FloquetError if an odd number of multipliers
        is negative.
        """
        F, seen, form = self._in_coordinates(self.fine, rows)
        now = self._in_coordinates(self.psi, rows)[1][:, self.n_outputs :]
        Gamma = np.linalg.solve(np.roll(now, -1, axis=0), self.B)
        F, P = (_resolved(values) for values in (F, seen[:, : self.n_outputs]))
        G = input_matrix(F, Gamma, self.psi[0], self.omega)
        return ContinuousModel(F, G, P, self.D, rows, form)

    def _in_coordinates(self, psi, rows):
        """F, what outputs and discrete states see, and the Floquet form."""
        if rows is None:
            units = np.repeat([1.0, 0.0], [self.n_outputs, len(self.shapes.R)])  # not of states
            return floquet_coordinates(self.shapes, psi, self.omega, units)
        seen, _ = self.shapes(psi)
        F = self.shapes.state_matrix(psi, self.omega, rows)
        return F, seen @ np.linalg.inv(seen[:, rows]), None


def turn_of(innovations, omega):
    """The Turn of a discrete periodic model: its Floquet form.

    Arguments are those of :func:`behind_samples`. It raises FloquetError if a step from
    one sample to the next forgets a state.
    """
    n = innovations.n_states
    psi, states, outputs = innovations.whole_turn()
    A, B, C = states[..., :n], states[..., n:-1], outputs[..., :n]
    X, R, flips = floquet_states(A, 2.0 * np.pi / omega)
    seen = np.concatenate([C @ X, X], axis=1)
    shapes = interpolated_shapes(seen, psi, R, flips)
    return Turn(psi, omega, shapes, B, trimmed_harmonics(innovations.matrices()[3]))


def floquet_states(A, period):
    """Periodic states X_j, and R, of x[j+1] = A_j x[j]: x moves as X e^{Rt}.

    A holds the q equal steps of one turn, which takes ``period`` seconds. Returns
    (X, R, flips): R is in 1/s, and ``flips`` tells which columns of X change sign from
    one turn to the next; they come first. It raises FloquetError if a step forgets a
    state.

    Examples
    --------
    >>> _, R, flips = floquet_states(np.tile(np.diag([0.5, 1e-3]), (20, 1, 1)), 20.0)
    >>> np.exp(np.diag(R)).round(9).tolist(), bool(flips.any())
    ([0.5, 0.001], False)
    """
    q, n, _ = A.shape
    size = np.linalg.norm(A, axis=(1, 2))
    rank = np.linalg.svd(A, compute_uv=False)[:, -1] if n else np.ones(q)
    if not np.all(rank > EXACT * size):
        raise FloquetError(
            f"the step from one sample to the next forgets a state (its matrix has a singular "
            f"value of {np.min(rank):.2g} beside one of {np.max(size):.2g}), which no continuous "
            f"system does; use order={n - 1}"
        )
    bases, groups, own = separated_factors(A)
    X, R, flips = np.empty_like(A), np.zeros((n, n)), np.zeros(n, dtype=bool)
    for group, factors in zip(groups, own, strict=True):
        X[:, :, group], R[group, group], flips[group] = _group(bases[:, :, group], factors, period)
    order = np.argsort(~flips, kind="stable")
    return X[:, :, order], R[np.ix_(order, order)], flips[order]


def _group(bases, factors, period):
    """X, R and flips of modes of like size."""
    q, (product, logarithm) = len(factors), scaled_product(factors)
    R, shape, flips = floquet_logarithm(product, period)
    R = R + logarithm / period * np.eye(len(R))
    back, X = linalg.expm(-R * period / q), np.empty(bases.shape)
    for j in range(q):
        X[j] = bases[j] @ shape
        shape = factors[j] @ shape @ back
    return X, R, flips


def time_invariant(innovations, omega):
    """The continuous model of one without harmonics, inputs held between samples.

    It raises ValueError if A has an eigenvalue on the closed negative real axis.
    """
    A, B, C, D = (M[0] for M in innovations.matrices())
    F, G = discrete_to_continuous(A, B, innovations.step / omega)
    return ContinuousModel(F[None], G[None], C[None], D[None], None, None)


def input_matrix(F, Gamma, start, omega):
    """G(ψ) of as few harmonics as move the states by Γ_j, held over each of the steps of a turn.

    F holds Fourier coefficients, and Γ holds one matrix a step, (q, n, m). The first
    step begins at ψ = ``start``. The coefficients of G have shape (2 K + 1, n, m).
    """
    (q, n, m), highest = Gamma.shape, len(Gamma) // 2
    structure = PeriodicStructure(turned(F, -start), np.zeros((0, F.size)), n, ())
    pushes = held_pushes(structure, [], omega, q, highest)
    size = np.sqrt(np.sum(pushes**2, axis=(0, 1, 3)))  # of each state
    size = np.where(size > 0.0, size, 1.0)
    target = (Gamma / size[:, None]).reshape(q * n, m)
    for count in range(highest + 1):
        width = 2 * count + 1
        design = (pushes[:width] / size[:, None]).transpose(1, 2, 0, 3).reshape(q * n, -1)
        found = linalg.lstsq(design, target)[0]
        if np.linalg.norm(design @ found - target) <= EXACT * np.linalg.norm(target):
            break
    return turned(found.reshape(width, n, m), start)


def nearest_steps(structure, coefficients, omega, n_phases, weights):
    """Parameters of a structure whose steps over a turn, and outputs, are nearest to a model's.

    ``coefficients`` are those of [F G; P Q](ψ) of the model, in the same coordinates,
    and ``n_phases`` is the number of steps. The first two ``weights``, (n, n) and
    (l, l), multiply errors of a step's states and of outputs from the left. The third,
    (n + m, n + m), multiplies both from the right: it is a factor of the covariance of
    states and inputs.
    """
    *lefts, right = weights
    n = structure.n_states
    given = PeriodicStructure(coefficients, np.zeros((0, coefficients.size)), n, ())

    def seen(structure, theta, *, sensitivities=False):
        found = sampled_response(structure, theta, omega, n_phases, sensitivities=sensitivities)
        both = (found.dPsi, found.dOut) if sensitivities else (found.Psi, found.Out)
        both = (
            left @ at_every_phase(M, n_phases) @ right for left, M in zip(lefts, both, strict=True)
        )
        return np.concatenate([M.reshape(*M.shape[:-3], -1) for M in both], axis=-1)

    target, start = seen(given, []), structure.nearest(coefficients)

    def left(theta):
        return seen(structure, theta) - target

    def slope(theta):
        return seen(structure, theta, sensitivities=True).T

    if not len(start) or np.linalg.norm(left(start)) <= HALF * np.linalg.norm(target):
        return start
    return optimize.least_squares(left, start, slope, x_scale="jac").x


def at_every_phase(M, n_phases):
    """Matrices of every phase, where they are constant, too."""
    return np.broadcast_to(M, (*M.shape[:-3], n_phases, *M.shape[-2:]))


def samples_of(coefficients, n_states, omega, step):
    """Fourier coefficients of the discrete model of a continuous one, inputs held over each step.

    ``coefficients`` are those of [F G; P Q](ψ), and ``step`` is any angle in radians.
    The result holds those of [A B; C D](ψ) over the step that begins at ψ. It may have
    more harmonics.
    """
    n = n_states
    F, G = trimmed_harmonics(coefficients[:, :n, :n]), trimmed_harmonics(coefficients[:, :n, n:])
    n_points = FEWEST
    while True:
        psi = 2.0 * np.pi * np.arange(n_points) / n_points
        matrices = (lambda at, M=M: evaluate_harmonics(M, at) for M in (F, G))
        steps = np.concatenate(steps_between(*matrices, psi, psi + step, omega), axis=2)
        count = tail_begins(steps, 0.0)
        if count < n_points // 4 or n_points >= 4096:  # azimuths, at most
            break
        n_points *= 2
    whole = np.zeros((max(2 * count + 1, len(coefficients)), *coefficients.shape[1:]))
    whole[: len(coefficients)] = coefficients
    whole[:, :n] = 0.0
    whole[: 2 * count + 1, :n] = sampled_harmonics(steps, count)
    return whole


def _resolved(values):
    """Fourier coefficients of a matrix at azimuths of a turn, all that count."""
    return sampled_harmonics(values, tail_begins(values, 0.0))
