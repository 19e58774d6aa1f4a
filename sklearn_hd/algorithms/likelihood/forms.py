"""What a likelihood has parameters of: a sampled periodic model with its Kalman gain.

Samples of a periodic system whose inputs switch, and outputs are read, between the samples.

    ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   u_i(t) = v_i(t − τ_i),   z_j(t) = y_j(t − σ_j)

v is held from sample to sample, τ_i = (k_i + f_i) Δt with k_i whole. Over the interval that follows
sample k the input i is first v_i[k − k_i − 1], and from f_i Δt on v_i[k − k_i]: two inputs, the new
and the old, each of which is held. σ_j = (d_j − g_j) Δt, and the measured output that is advanced
by d_j samples is y_j at t_k + g_j Δt. Between the sorted f_i and g_j nothing switches and

    x⁺ = Φ_s x + Γ_s u_s,

so that their product is exact. The derivatives by the delays are exact, too. Where v_i switches,
and where y_j is read,

    ∂x(t)/∂f_i = Δt Φ(t, f_i) G_i (v_i[k − k_i − 1] − v_i[k − k_i]),
    ∂z_j/∂g_j = Δt (ω P_j′ x + P_j (F x + G u) + ω Q_j′ u).

A feedthrough passes on its input at the sampling instant, which is constant except for jumps
at whole samples of τ_i + σ_j: it does not show the fraction, and has no derivative by it.

Likelihoods of models with time delays need these.
"""

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np

from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.periodic.floquet import product_of
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.harmonic_decomposition import derivative_matrix
from sklearn_hd.algorithms.periodic.periodic_realization import tail_begins
from sklearn_hd.algorithms.periodic.periodic_structure import (
    MAX_SUBSTEPS,
    PeriodicStructure,
    SampledResponse,
    by_parameter,
    evaluated_response,
    n_substeps,
    radius_of,
    sampled_response,
    transitions,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, sampled_harmonics

FEWEST = 63  # azimuths of a turn between which matrices are interpolated, odd
MOST = 2047  # of them
MOST_TURNS = 40  # of which one comes nearest to whole samples


@dataclass(frozen=True, eq=False)
class Fractions:
    """What of some delays is no whole number of samples, and which of them are parameters."""

    inputs: np.ndarray  # (m,): f_i, between 0 and 1: from then on an input has its new value
    outputs: np.ndarray  # (l,): 1 − g_j, between 0 and 1: delays beyond d_j − 1 samples
    # int, (k,): places of those, inputs and outputs one after another, that are parameters
    free: np.ndarray

    @property
    def whole(self):
        """All of them, inputs first."""
        return np.concatenate([self.inputs, self.outputs])

    @property
    def start(self):
        """Those that are parameters."""
        return self.whole[self.free]

    def at(self, values):
        """The same with other values of the parameters."""
        whole = self.whole
        whole[self.free] = np.clip(values, 0.0, 1.0)
        return Fractions(whole[: len(self.inputs)], whole[len(self.inputs) :], self.free)


def delayed_response(
    structure,
    theta,
    fractions,
    omega,
    n_phases,
    observe=None,
    *,
    sensitivities=True,
    n_points=None,
):
    """Transition and output matrices of samples between which inputs switch and outputs are read.

    ``fractions`` are those of the m inputs, and of the l' outputs measured. Other
    arguments are as for
    :func:`sklearn_hd.algorithms.periodic.periodic_structure.sampled_response`. The
    SampledResponse has the inputs [new; old], 2 m of them, and derivatives by θ, then
    by the free fractions.

    Examples
    --------
    A lag ẋ = −x + u whose input comes a quarter of a sample late:

    >>> from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
    >>> lag = PeriodicStructure([[[-1.0, 1.0], [1.0, 0.0]]], np.zeros((0, 1, 2, 2)), 1, ())
    >>> late = Fractions(np.array([0.25]), np.array([1.0]), np.arange(0))
    >>> response = delayed_response(lag, [], late, 2 * np.pi, 1)
    >>> new, old = 1.0 - np.exp(-0.75), np.exp(-0.75) - np.exp(-1.0)
    >>> bool(np.allclose(response.Psi[0, 0, 1:], [new, old], rtol=1e-14))
    True
    """
    theta = np.asarray(theta, dtype=float)
    way = _Way(structure, theta, omega, n_phases, n_points or n_phases, observe, sensitivities)
    reads, n_inputs = 1.0 - fractions.outputs, structure.n_inputs
    of_input = {place: k for k, place in enumerate(fractions.free)}
    breaks = np.unique(np.concatenate([[0.0, 1.0], fractions.inputs, reads]))
    x = _Partial.start(way, len(fractions.free))
    out = _Partial.nothing(way, len(reads), len(fractions.free))
    for here, there in zip(breaks, [*breaks[1:], None], strict=True):
        held = way.held(here < fractions.inputs)
        for j in np.flatnonzero(reads == here):
            way.read(out, x, held, here, j, of_input.get(n_inputs + j))
        for i in np.flatnonzero(fractions.inputs == here):
            way.switch(x, here, i, of_input.get(i))
        if there is not None:
            x = way.go_on(x, held, here, there)
    return SampledResponse(x.value, out.value, x.slopes, out.slopes)


@dataclass(eq=False)
class _Partial:
    """A matrix from [x[k]; new; old] to something within the interval, and its derivatives."""

    value: np.ndarray  # (p, rows, n + 2 m)
    slopes: np.ndarray | None  # (k, p, rows, n + 2 m)

    @classmethod
    def nothing(cls, way, rows, n_free):
        shape = (way.count, rows, way.width)
        slopes = np.zeros((len(way.theta) + n_free, *shape)) if way.sensitivities else None
        return cls(np.zeros(shape), slopes)

    @classmethod
    def start(cls, way, n_free):
        found = cls.nothing(way, way.n, n_free)
        found.value[:, :, : way.n] = np.eye(way.n)
        return found


class _Way:
    """The way through one interval of every sample of a turn."""

    def __init__(self, structure, theta, omega, n_phases, n_points, observe, sensitivities):
        self.structure, self.theta, self.omega, self.n_phases = structure, theta, omega, n_phases
        self.sensitivities, self.n, self.m = sensitivities, structure.n_states, structure.n_inputs
        self.width, self.n_points, self.observe = self.n + 2 * self.m, n_points, None
        if observe is not None:
            self.observe = sampled_harmonics(observe, (len(observe) - 1) // 2)
        varies = any(structure.varies) or (observe is not None and len(observe) > 1)
        self.count, self.step = n_points if varies else 1, 2.0 * np.pi / n_phases
        self.dt = self.step / omega
        self.coefficients = structure.coefficients(theta)

    def held(self, old):
        """What of [new; old] each input is, shape (m, 2 m)."""
        return np.hstack([np.diag(~old), np.diag(old)]).astype(float)

    def psi(self, here):
        """Azimuths of an instant within the interval of each sample."""
        return 2.0 * np.pi * np.arange(self.count) / self.n_points + self.step * here

    def go_on(self, x, held, here, there):
        """The states at the end of an interval in which nothing switches."""
        n, n_theta = self.n, len(self.theta)
        Psi, dPsi = transitions(
            self.structure,
            self.theta,
            self.omega,
            self.n_phases / (there - here),
            self.n_points,
            self.sensitivities,
            self.step * here,
        )
        Psi = np.broadcast_to(Psi, (self.count, *Psi.shape[1:]))
        Phi, value = Psi[..., :n], Psi[..., :n] @ x.value
        value[..., n:] += Psi[..., n:] @ held
        if not self.sensitivities:
            return _Partial(value, None)
        slopes = Phi @ x.slopes
        slopes[:n_theta] += dPsi[..., :n] @ x.value
        slopes[:n_theta, ..., n:] += dPsi[..., n:] @ held
        return _Partial(value, slopes)

    def switch(self, x, here, i, parameter):
        """What a later switching of an input leaves: it has been the old one for longer."""
        if parameter is None or not self.sensitivities:
            return
        G = evaluate_harmonics(self.coefficients[:, : self.n, self.n + i], self.psi(here))
        own = x.slopes[len(self.theta) + parameter]
        own[..., self.n + i] -= self.dt * G
        own[..., self.n + self.m + i] += self.dt * G

    def read(self, out, x, held, here, j, parameter):
        """One row of the outputs, at an instant."""
        n, n_theta, psi = self.n, len(self.theta), self.psi(here)
        row, shown = self._row(psi, j)
        self._set(out.value[:, j], row, x.value, held)
        if not self.sensitivities:
            return
        out.slopes[:, :, j] = np.einsum("pa,kpab->kpb", row[:, :n], x.slopes)
        harmonic, which, column, rates = self.structure.output_entries
        functions = harmonic_functions(psi, range(self.structure.n_harmonics + 1))
        moved = np.zeros((len(which), self.count, n + self.m))
        moved[np.arange(len(which)), :, column] = (shown[:, which] * functions[:, harmonic]).T
        moved = by_parameter(rates, moved)
        slopes = moved[..., None, :n] @ x.value
        slopes[..., 0, n:] += moved[..., n:] @ held
        out.slopes[:n_theta, :, j] += slopes[..., 0, :]
        if parameter is not None:  # a longer delay reads the output earlier
            M = evaluate_harmonics(self.coefficients[:, :n], psi)
            rate = self._row(psi, j, derivative=True) * self.omega
            rate = rate + np.einsum("pa,pab->pb", row[:, :n], M)
            own = np.zeros((self.count, self.width))
            self._set(own, rate, x.value, held)
            out.slopes[n_theta + parameter, :, j] -= self.dt * own

    def _set(self, target, row, x, held):
        target[:] = np.einsum("pa,pab->pb", row[:, : self.n], x)
        target[:, self.n :] += row[:, self.n :] @ held

    def _row(self, psi, j, derivative=False):
        """[P_j Q_j] at some azimuths, and what is measured of the model's outputs there."""
        own = self.coefficients[:, self.n :]
        values = evaluate_harmonics(own, psi)
        if self.observe is None:
            shown = np.broadcast_to(np.eye(own.shape[1])[j], (len(psi), own.shape[1]))
            if derivative:
                return evaluate_harmonics(_by_azimuth(own), psi)[:, j]
            return values[:, j], shown
        shown = evaluate_harmonics(self.observe[:, j], psi)
        row = np.einsum("pi,pib->pb", shown, values)
        if not derivative:
            return row, shown
        turned = evaluate_harmonics(_by_azimuth(self.observe[:, j]), psi)
        row = np.einsum("pi,pib->pb", turned, values)
        return row + np.einsum("pi,pib->pb", shown, evaluate_harmonics(_by_azimuth(own), psi))


def _by_azimuth(coefficients):
    """Fourier coefficients of the derivative by ψ."""
    return np.tensordot(derivative_matrix(len(coefficients) // 2, 1, 1.0), coefficients, 1)


@dataclass(frozen=True, eq=False)
class Form:
    """A model affine in its parameters, sampled, and the gain of its predictor.

    Its parameters are those of the structure, then free delays, then the Fourier coefficients of
    K(ψ) in the order harmonic, state, output.
    """

    structure: PeriodicStructure  # of a system in continuous time, or of the steps themselves
    omega: float  # rad/s
    n_phases: float  # samples a period, whole or not
    # (n_phases, l, l_model): what is measured of the model's outputs at each phase
    observe: np.ndarray | None = None
    discrete: bool = False  # whether the structure is one of steps, [A B; C D](ψ)
    n_gain_harmonics: int | None = None  # of K(ψ); None for a simulation, without K
    # azimuths of a turn between which matrices are interpolated, odd; None for the samples'
    n_points: int | None = None
    # of a sample, of what is late; inputs are then given as the new ones, and the old ones
    delays: Fractions | None = None
    # whether coordinates are free, so that directions that move no output do not count
    gauge: bool = False
    # whether each record has a waveform of the turn of its own, which is unknown: what a trim that
    # was subtracted is off by. Turns then hold whole samples.
    waveform: bool = False
    # (n, m): about the size of each entry of G, which changes smoothly with ψ, for inputs but the
    # last few; None if it may change in any way
    input_size: np.ndarray | None = None

    @property
    def n_states(self):
        return self.structure.n_states

    @property
    def n_outputs(self):
        return self.structure.n_outputs if self.observe is None else self.observe.shape[1]

    @property
    def n_model(self):
        """Number of parameters except for those of K."""
        return self.structure.n_parameters + (0 if self.delays is None else len(self.delays.free))

    @property
    def n_gains(self):
        """Number of coefficients of K."""
        if self.n_gain_harmonics is None:
            return 0
        return (2 * self.n_gain_harmonics + 1) * self.n_states * self.n_outputs

    @cached_property
    def linear(self):
        """Places of the parameters of G and Q alone, in which outputs are linear."""
        columns = np.unravel_index(self.structure.basis.indices, self.structure.constant.shape)[2]
        drives = np.add.reduceat(
            np.append(columns < self.n_states, False), self.structure.basis.indptr[:-1]
        )
        return np.flatnonzero(drives == 0)

    def stiffness(self, squares):
        """How stiff G(ψ) is in each parameter, where it is a cubic smoothing spline of its size.

            s_ij G_ij,k ~ N(0, (g_j / k²)²),   g_j = rms_i (s_ij G_ij)

        G_ij,k are coefficients of harmonic k, and s_ij is the size of what a constant push makes
        of the records. Inputs that switch at few azimuths tell some sums of harmonics alone, and a
        likelihood by itself follows noise in the others without end.

        ``squares`` (k,) are sums of what each parameter makes of the records. The
        stiffness (k,) is zero but for harmonics of single entries of G, of inputs that
        do something.

        References
        ----------
        G. Wahba, *Spline Models for Observational Data*, 1990, chapter 2.
        """
        n, m = self.input_size.shape
        entries, constant = self.structure.basis.tocoo(), self.structure.constant
        place, share = entries.coords[0], entries.data**2
        harmonic, row, column = np.unravel_index(entries.coords[1], constant.shape)
        own = (row < n) & (column >= n) & (column < n + m) & (share > 0.0)
        own &= (np.bincount(place)[place] == 1) & (constant[harmonic, row, column] == 0.0)
        place, share, i, j = place[own], share[own], row[own], column[own] - n
        pushes = np.zeros((n, m))  # s²: constants make the most of the records
        np.maximum.at(pushes, (i, j), squares[place] / share)
        effects = pushes * self.input_size**2
        effect = effects.sum(axis=0) / np.maximum(np.count_nonzero(effects, axis=0), 1)  # g²
        seen, effect = effect > EXACT**2 * np.max(effect, initial=0.0), effect[j]
        stiff = np.divide(pushes[i, j], effect, out=np.zeros(len(j)), where=seen[j])
        stiff *= share * ((harmonic[own] + 1) // 2) ** 4
        return np.sqrt(np.bincount(place, stiff, len(squares)))

    def with_gain(self, n_harmonics):
        """The same with a gain of some harmonics, or None."""
        return replace(self, n_gain_harmonics=n_harmonics)

    def gain(self, parameters):
        """Fourier coefficients of K, shape (2 H + 1, n, l); None for a simulation."""
        if self.n_gain_harmonics is None:
            return None
        shape = (2 * self.n_gain_harmonics + 1, self.n_states, self.n_outputs)
        return np.asarray(parameters)[self.n_model :].reshape(shape)

    def response(self, parameters, *, sensitivities):
        """Its matrices at the samples of a turn, or between samples, and derivatives."""
        theta = np.asarray(parameters, dtype=float)[: self.structure.n_parameters]
        n_points = self.n_phases if self.n_points is None else self.n_points
        if self.discrete:
            found = evaluated_response(self.structure, theta, n_points, sensitivities=sensitivities)
        elif self.delays is not None:
            found = delayed_response(
                self.structure,
                theta,
                self.delays.at(parameters[self.structure.n_parameters : self.n_model]),
                self.omega,
                self.n_phases,
                self.observe,
                sensitivities=sensitivities,
                n_points=n_points,
            )
        else:
            found = sampled_response(
                self.structure,
                theta,
                self.omega,
                self.n_phases,
                self.observe,
                sensitivities=sensitivities,
                n_points=n_points,
            )
        gain, H = self.gain(parameters), self.n_gain_harmonics
        if gain is not None:
            psi = 2.0 * np.pi * np.arange(n_points if H else 1) / n_points
            gain = evaluate_harmonics(gain, psi)
        return replace(found, gain=gain, n_gain_harmonics=H, n_phases=self.n_phases)

    @cached_property
    def turns(self):
        """Samples of as many turns as come nearest to whole samples, and these turns."""
        return Fraction(self.n_phases).limit_denominator(MOST_TURNS).as_integer_ratio()

    def through(self, tables):
        """Matrices of the samples of these turns, of those at the azimuths between which to go."""
        if len(tables) == 1 or self.n_points is None:
            return tables
        psi = 2.0 * np.pi * np.arange(self.turns[0]) / self.n_phases
        return evaluate_harmonics(sampled_harmonics(tables, len(tables) // 2), psi)

    def radius(self, response):
        """Size of the largest multiplier of the predictor over a turn, or a sample."""
        with np.errstate(over="ignore", invalid="ignore"):
            return radius_of(product_of(self.through(response.closed))) ** (1.0 / self.turns[1])

    def resolves(self, parameters):
        """Whether the samples can follow the states at these parameters."""
        if self.discrete:
            return bool(np.all(np.isfinite(parameters)))
        theta = parameters[: self.structure.n_parameters]
        return np.all(np.isfinite(parameters)) and (
            n_substeps(self.structure, theta, self.omega, self.n_phases) <= MAX_SUBSTEPS
        )


def interpolating(form, theta):
    """The form at as many azimuths of a turn as tell its matrices at others."""
    n_points = max(FEWEST, 4 * form.structure.n_harmonics + 3)
    while n_points < MOST:
        response = replace(form, n_points=n_points).response(theta, sensitivities=False)
        moving = [M for M in (response.Psi, response.Out) if len(M) > 1]
        if all(tail_begins(M, 0.0) < n_points // 4 for M in moving):
            break
        n_points = 2 * n_points + 1
    return replace(form, n_points=n_points)
