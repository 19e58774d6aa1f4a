"""Periodic systems whose Fourier coefficients are affine in a vector of parameters.

    ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt                  (Eq. 6)
    [F G; P Q](ψ; θ) = S₀(ψ) + Σ_k θ_k S_k(ψ)

Sampled n_phases times a period, with u held between samples,

    [x; u] moves over interval j to x[j+1] = Ψ_j [x[j]; u[j]],   Ψ_j = [Φ_j Γ_j]

by Gauss collocation: with stage states Z_q at the nodes ψ_q, the exact derivative of the
collocation step is

    ∂Ψ_j/∂θ_k = Σ_q L_q [∂F/∂θ_k ∂G/∂θ_k](ψ_q) Z_q,

where L_q, the adjoint of the step, says where a push at node q ends up. It is of the
order of the step itself (the method is symplectic: its adjoint is the same method run
backwards), although the stages alone are not.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, sparse

from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.lti.structured_model import Sizes, parts_of
from sklearn_hd.algorithms.periodic.floquet import (
    collocation,
    gauss_tableau,
    product_of,
    state_units,
)
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, harmonic_labels

LONGEST_STEP = 1.0  # |F| h and K ω h of one collocation step; at 1 it errs by 1e-15
MAX_SUBSTEPS = 256  # within one sample; whatever moves faster was not seen by the samples


@dataclass(frozen=True, eq=False)
class PeriodicStructure(Sizes):
    """Periodic system with Fourier coefficients affine in its parameters.

    Parameters
    ----------
    constant : ndarray, shape (2 K + 1, n + l, n + m)
        Real Fourier coefficients of [F G; P Q](ψ) at θ = 0, in the order 0, 1c, 1s, ….
        K = 0 is a time-invariant system.
    basis : ndarray, shape (k, 2 K + 1, n + l, n + m), or sparse, shape (k, constant.size)
        What one unit of each parameter adds. Kept as a sparse matrix: most parameters
        are one entry of one coefficient.
    n_states : int
        n, which says where [F G; P Q] is divided.

    Examples
    --------
    A lag whose rate θ₀ cos ψ − 1 varies over the period:

    >>> constant = np.zeros((3, 2, 2))
    >>> constant[0] = [[-1.0, 1.0], [1.0, 0.0]]
    >>> basis = np.zeros((1, 3, 2, 2))
    >>> basis[0, 1, 0, 0] = 1.0
    >>> lag = PeriodicStructure(constant, basis, 1, ("swing",))
    >>> lag.matrices([0.3])[0].ravel().tolist()
    [-1.0, 0.3, 0.0]
    """

    constant: np.ndarray
    basis: sparse.csr_array
    n_states: int
    parameter_names: tuple

    def __post_init__(self):
        constant = np.asarray(self.constant, dtype=float)
        basis = self.basis
        if not sparse.issparse(basis):
            basis = np.asarray(basis, dtype=float)
            basis = basis.reshape(len(basis), constant.size)
        object.__setattr__(self, "constant", constant)
        object.__setattr__(self, "basis", sparse.csr_array(basis, dtype=float))
        object.__setattr__(self, "parameter_names", tuple(self.parameter_names))
        if self.basis.shape != (len(self.parameter_names), constant.size):
            raise ValueError(
                f"basis has {self.basis.shape[0]} parameters of {self.basis.shape[1]} entries; "
                f"{len(self.parameter_names)} parameter names and a constant of shape "
                f"{constant.shape} need {len(self.parameter_names)} of {constant.size}"
            )

    @classmethod
    def time_invariant(cls, structure):
        """The same structure as an :class:`AffineStructure`, with K = 0."""
        return cls(
            structure.constant[None],
            np.asarray(structure.basis)[:, None],
            structure.n_states,
            structure.parameter_names,
        )

    @classmethod
    def all_free(cls, shape, n, feedthrough=False):
        """[A B; C D](ψ) of a shape, every entry a parameter, of D only where it says so."""
        free = np.ones(shape, dtype=bool)
        free[:, n:, n:] = feedthrough
        places = np.flatnonzero(free)
        ones = np.ones(len(places)), (np.arange(len(places)), places)
        basis = sparse.csr_array(ones, shape=(len(places), free.size))
        labels, names = harmonic_labels(range(len(free) // 2 + 1)), []
        for h, i, j in np.argwhere(free):
            row, column = i - n * (i >= n), j - n * (j >= n)
            label = "" if len(free) == 1 else f"_{labels[h]}"
            names.append(f"{'ABCD'[2 * (i >= n) + (j >= n)]}[{row},{column}]{label}")
        return cls(np.zeros(shape), basis, n, tuple(names))

    @property
    def n_harmonics(self):
        """K, the highest harmonic of [F G; P Q]."""
        return len(self.constant) // 2

    def restricted(self, kept):
        """The structure with some of its parameters, those left out being zero."""
        names = tuple(self.parameter_names[k] for k in kept)
        return PeriodicStructure(self.constant, self.basis[kept], self.n_states, names)

    def coefficients(self, theta):
        """Fourier coefficients of [F G; P Q], shape (2 K + 1, n + l, n + m)."""
        moved = np.asarray(theta, dtype=float) @ self.basis
        return self.constant + moved.reshape(self.constant.shape)

    def nearest(self, coefficients):
        """Parameters that bring the coefficients nearest to some given ones of any number."""
        gap = resize_harmonics(coefficients, len(self.constant) // 2) - self.constant
        gram = (self.basis @ self.basis.T).toarray()
        if not len(gram):
            return np.zeros(0)
        return linalg.solve(gram, self.basis @ gap.ravel(), assume_a="pos")

    def matrices(self, theta):
        """Fourier coefficients of F, G, P and Q."""
        return parts_of(self.coefficients(theta), self.n_states)

    @cached_property
    def varies(self):
        """Whether [F G], and whether [P Q], may vary over the period."""
        touched = np.zeros(self.constant.size, dtype=bool)
        touched[self.basis.indices] = True
        touched = (touched.reshape(self.constant.shape) | (self.constant != 0))[1:]
        n = self.n_states
        return bool(touched[:, :n].any()), bool(touched[:, n:].any())

    @cached_property
    def dynamic_entries(self):
        """Harmonic, row and column of the entries of [F G] that move, and their rates (k, e)."""
        return self._entries(dynamic=True)

    @cached_property
    def output_entries(self):
        """The same of [P Q], rows counted from its first."""
        harmonic, row, column, rates = self._entries(dynamic=False)
        return harmonic, row - self.n_states, column, rates

    def _entries(self, *, dynamic):
        moved = np.unique(self.basis.indices)
        index = np.array(np.unravel_index(moved, self.constant.shape))
        chosen = (index[1] < self.n_states) == dynamic
        return *index[:, chosen], self.basis[:, moved[chosen]]


@dataclass(frozen=True, eq=False)
class SampledResponse:
    """One period of a sampled periodic system, and its derivatives.

    x[k+1] = Ψ[k mod p] [x[k]; u[k]],   y[k] = Out[k mod q] [x[k]; u[k]]
    """

    Psi: np.ndarray  # (p, n, n + m): p is 1 if F and G are constant, n_phases otherwise
    # (q, l', n + m): q is 1 if P, Q and what is measured of them are constant, n_phases otherwise
    Out: np.ndarray
    dPsi: np.ndarray | None = None  # (k, p, n, n + m)
    dOut: np.ndarray | None = None  # (k, q, l', n + m)
    # (p or 1, n, l'): K of the innovations form; None for a simulation
    gain: np.ndarray | None = None
    n_gain_harmonics: int | None = None  # of K; None where it is known
    n_phases: float = 1.0  # samples a period

    @property
    def n_gains(self):
        """Number of coefficients of K."""
        count = self.n_gain_harmonics
        return 0 if count is None else (2 * count + 1) * self.gain[0].size

    @property
    def n_states(self):
        return self.Psi.shape[1]

    @property
    def Phi(self):
        """Transition matrices, shape (p, n, n)."""
        return self.Psi[:, :, : self.n_states]

    @property
    def closed(self):
        """Transition matrices of the predictor, Φ − K C, shape (p, n, n)."""
        return (
            self.Phi if self.gain is None else self.Phi - self.gain @ self.Out[..., : self.n_states]
        )

    @cached_property
    def monodromy(self):
        """Transition matrix over the p intervals: one period, or one sample if p is 1."""
        with np.errstate(over="ignore", invalid="ignore"):
            return product_of(self.Phi)


def radius_of(monodromy):
    """Size of the largest eigenvalue; infinite where the matrix has overflowed."""
    if not np.all(np.isfinite(monodromy)):
        return np.inf
    return float(np.max(np.abs(np.linalg.eigvals(monodromy)), initial=0.0))


def evaluated_response(structure, theta, n_points, *, sensitivities):
    """SampledResponse of a structure of the steps themselves, at azimuths of a turn.

    The structure is [A B; C D](ψ) of x[k+1] = A(ψ_k) x[k] + B(ψ_k) u[k] and
    y[k] = C(ψ_k) x[k] + D(ψ_k) u[k].
    """
    n, (_, rows, _) = structure.n_states, structure.constant.shape
    coefficients, parts = structure.coefficients(theta), []
    own = (slice(0, n), structure.varies[0], structure.dynamic_entries)
    seen = (slice(n, rows), structure.varies[1], structure.output_entries)
    for which, varies, entries in (own, seen):
        functions = functions_of_turn(n_points if varies else 1, n_points, structure.n_harmonics)
        values = np.tensordot(functions, coefficients[:, which], 1)
        slopes = _moved(entries, functions, values.shape) if sensitivities else None
        parts.append((values, slopes))
    return SampledResponse(parts[0][0], parts[1][0], parts[0][1], parts[1][1])


def sampled_response(
    structure, theta, omega, n_phases, observe=None, *, sensitivities=True, n_points=None
):
    """SampledResponse: transition and output matrices of the samples of a period, and derivatives.

    Sample j lies at ψ_j = 2πj / n_phases; inputs are held over the interval that follows.

    ``observe``, (n_phases, l', l) or (1, l', l), is what is measured of the model's
    outputs at each phase: for a model of harmonic coefficients, the functions 1, cos ψ,
    sin ψ, … that put y together (Eq. 7). ``n_points`` is the number of azimuths at
    which intervals begin, 2πj / n_points, by default ``n_phases``. With it,
    ``n_phases`` may be any number: it is the length of the intervals. It raises
    ValueError if F moves the states by hundreds of time constants within one sample.

    References
    ----------
    E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2006, sections
    II.1 (Gauss collocation) and VI.4 (symplecticity).

    Examples
    --------
    >>> structure = PeriodicStructure(np.array([[[0.0, 1.0], [1.0, 0.0]]]),
    ...                               np.array([[[[-1.0, 0.0], [0.0, 0.0]]]]), 1, ("rate",))
    >>> response = sampled_response(structure, [2.0], 2 * np.pi, 4)
    >>> bool(np.isclose(response.Psi[0, 0, 0], np.exp(-0.5)))
    True
    >>> bool(np.isclose(response.dPsi[0, 0, 0, 0], -0.25 * np.exp(-0.5)))
    True
    """
    theta = np.asarray(theta, dtype=float)
    n_points = n_phases if n_points is None else n_points
    Psi, dPsi = transitions(structure, theta, omega, n_phases, n_points, sensitivities)
    Out, dOut = _outputs(structure, theta, n_points, observe, sensitivities)
    return SampledResponse(Psi, Out, dPsi, dOut)


def held_pushes(structure, theta, omega, n_phases, n_harmonics):
    """Where a push cos kψ or sin kψ of one state over one interval leaves all states.

    What one unit of a coefficient of G adds to Γ_j, whatever the number of inputs. The
    other arguments are those of :func:`sampled_response`. The pushes have harmonics up
    to ``n_harmonics``, and the shape (2 n_harmonics + 1, n_phases, n, n), in the order
    0, 1c, 1s, …; the last axis is the state pushed.
    """
    n = structure.n_states
    S = n_substeps(structure, theta, omega, n_phases, n_harmonics)
    nodes, _, left, _ = _intervals(structure, theta, omega, n_phases, n_phases, S)
    functions = harmonic_functions(nodes, range(n_harmonics + 1))
    pushes = functions.transpose(0, 2, 1) @ left.reshape(n_phases, -1, n * n)
    return pushes.reshape(n_phases, -1, n, n).transpose(1, 0, 2, 3)


def n_substeps(structure, theta, omega, n_phases, n_harmonics=0):
    """Collocation steps that resolve one sample: |F| h ≤ 1 in balanced units, K ω h ≤ 1."""
    F = structure.matrices(theta)[0]
    n_points = max(16, 4 * structure.n_harmonics)
    values = evaluate_harmonics(F, 2.0 * np.pi * np.arange(n_points) / n_points)
    units = state_units(lambda psi: evaluate_harmonics(F, psi))
    fastest = np.max(np.linalg.norm(values * (units / units[:, None]), axis=(1, 2)), initial=0.0)
    highest = max(n_harmonics, structure.n_harmonics * structure.varies[0])
    rate = max(fastest, omega * highest)
    return max(1, int(np.ceil(rate * 2.0 * np.pi / (omega * n_phases) / LONGEST_STEP)))


# ---- states -------------------------------------------------------------------------------


def transitions(structure, theta, omega, n_phases, n_points, sensitivities, offset=0.0):
    """Ψ, shape (p, n, n + m), and ∂Ψ/∂θ, shape (k, p, n, n + m), or None.

    Of intervals of 2π / n_phases that begin ``offset`` radians after the samples.
    """
    p = n_points if structure.varies[0] else 1
    S = n_substeps(structure, theta, omega, n_phases)
    if S > MAX_SUBSTEPS:
        raise ValueError(
            f"F has rates of {S * n_phases * omega / (2 * np.pi):.3g} 1/s, {S} time constants in "
            f"one sample; start closer to the truth, or sample more often than {n_phases} times "
            f"per period"
        )
    nodes, Psi, left, stages = _intervals(
        structure, theta, omega, n_phases, p, S, adjoint=sensitivities, offset=offset
    )
    if not sensitivities:
        return Psi, None
    functions = harmonic_functions(nodes, range(structure.n_harmonics + 1))
    return Psi, _entry_derivatives(structure.dynamic_entries, functions, left, stages)


def _intervals(structure, theta, omega, n_phases, p, n_substeps, *, adjoint=True, offset=0.0):
    """Nodes of p intervals, (p, q), Ψ, and L and Z of each node, (p, q, …), or None."""
    n, m = structure.n_states, structure.n_inputs
    M = structure.coefficients(theta)[:, :n]
    units = np.ones(n + m)
    units[:n] = state_units(lambda psi: evaluate_harmonics(M[:, :, :n], psi))
    scale = units / units[:n, None]
    nodes, width = _nodes(p, n_phases, n_substeps)
    nodes = nodes + offset
    values = evaluate_harmonics(M * scale, nodes)
    left, stages, steps = collocation(values * (width / omega), adjoint=adjoint)
    before, after = _chains(steps)
    Psi = (steps[:, -1] @ before[:, -1])[:, :n] / scale
    nodes = nodes.reshape(p, -1)
    if not adjoint:
        return nodes, Psi, None, None
    left = after[:, :, None, :n, :n] @ left * (width / omega * units[:n, None] / units[:n])
    stages = stages @ before[:, :, None] * (units[:, None] / units)
    left, stages = (M.reshape(p, -1, *M.shape[3:]) for M in (left, stages))
    return nodes, Psi, left, stages


def _nodes(p, n_phases, n_substeps):
    """Azimuths of the collocation nodes, shape (p, n_substeps, n_stages), and the step in rad."""
    width = 2.0 * np.pi / (n_phases * n_substeps)
    starts = 2.0 * np.pi / p * np.arange(p)[:, None] + width * np.arange(n_substeps)
    return starts[:, :, None] + width * gauss_tableau()[0], width


def _chains(steps):
    """Products of the steps before each one, and of those after it, all (p, S, n + m, n + m)."""
    before, after = np.zeros_like(steps), np.zeros_like(steps)
    before[:, 0] = after[:, -1] = np.eye(steps.shape[-1])
    for s in range(1, steps.shape[1]):
        before[:, s] = steps[:, s - 1] @ before[:, s - 1]
        after[:, -1 - s] = after[:, -s] @ steps[:, -s]
    return before, after


def _entry_derivatives(entries, functions, left, stages):
    """∂Ψ/∂θ, shape (k, p, n, n + m): Σ_q φ_h(ψ_q) L_q[:, row] Z_q[column, :] by the rates."""
    harmonic, row, column, rates = entries
    (p, _, n, _), width = left.shape, stages.shape[3]
    moved, waves = np.empty((len(row), p, n, width)), functions.transpose(0, 2, 1)
    for i, j in set(zip(row.tolist(), column.tolist(), strict=True)):
        pushed = left[:, :, :, i, None] * stages[:, :, None, j]  # (p, q, n, n + m)
        each = (waves @ pushed.reshape(p, -1, n * width)).reshape(p, -1, n, width)
        own = (row == i) & (column == j)
        moved[own] = each[:, harmonic[own]].swapaxes(0, 1)
    return by_parameter(rates, moved)


def by_parameter(rates, moved):
    """Derivatives by the parameters from those by the entries, (e, ...) -> (k, ...)."""
    flat = rates @ moved.reshape(len(moved), int(np.prod(moved.shape[1:])))
    return flat.reshape(rates.shape[0], *moved.shape[1:])


# ---- outputs ------------------------------------------------------------------------------


def _outputs(structure, theta, n_phases, observe, sensitivities):
    """Out, shape (q, l', n + m), and ∂Out/∂θ, shape (k, q, l', n + m), or None."""
    n, m, n_outputs = structure.n_states, structure.n_inputs, structure.n_outputs
    observe = np.eye(n_outputs)[None] if observe is None else np.asarray(observe, dtype=float)
    if observe.ndim != 3 or len(observe) not in (1, n_phases) or observe.shape[2] != n_outputs:
        raise ValueError(
            f"observe has shape {observe.shape}; with {n_phases} phases and {n_outputs} outputs "
            f"of the model it must be ({n_phases}, n_measured, {n_outputs})"
        )
    functions = functions_of_turn(
        n_phases if structure.varies[1] else 1, n_phases, structure.n_harmonics
    )
    Out = observe @ np.tensordot(functions, structure.coefficients(theta)[:, n:], 1)
    if not sensitivities:
        return Out, None
    harmonic, row, column, rates = structure.output_entries
    moved = np.zeros((len(row), len(Out), observe.shape[1], n + m))
    values = observe[:, :, row] * functions[:, None, harmonic]  # (q, l', e)
    moved[np.arange(len(row)), :, :, column] = values.transpose(2, 0, 1)
    return Out, by_parameter(rates, moved)


def functions_of_turn(n_points, n_phases, n_harmonics):
    """1, cos ψ, sin ψ, … at the first of some equally spaced azimuths; what is zero is 0.0.

    Of harmonic n_phases/2, no sample shows the sine: rounding would make a column of it.
    """
    orders = np.arange(1, n_harmonics + 1)
    angles = np.mod(np.outer(np.arange(n_points), orders), n_phases) * (2.0 * np.pi / n_phases)
    functions = np.ones((n_points, 2 * n_harmonics + 1))
    functions[:, 1::2], functions[:, 2::2] = np.cos(angles), np.sin(angles)
    return np.where(np.abs(functions) <= EXACT, 0.0, functions)


def _moved(entries, functions, shape):
    """Derivatives of matrices (q, rows, columns) by the parameters of their entries, (k, …)."""
    harmonic, row, column, rates = entries
    moved = np.zeros((len(row), *shape))
    moved[np.arange(len(row)), :, row, column] = functions.T[harmonic]
    return by_parameter(rates, moved)
