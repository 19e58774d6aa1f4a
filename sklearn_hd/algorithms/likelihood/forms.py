"""What a likelihood has parameters of: a sampled periodic model with its Kalman gain."""

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np

from sklearn_hd.algorithms.periodic.delayed_response import Fractions, delayed_response
from sklearn_hd.algorithms.periodic.floquet import product_of
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_realization import tail_begins
from sklearn_hd.algorithms.periodic.periodic_structure import (
    MAX_SUBSTEPS,
    PeriodicStructure,
    evaluated_response,
    n_substeps,
    radius_of,
    sampled_response,
)
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics

FEWEST = 63  # azimuths of a turn between which matrices are interpolated, odd
MOST = 2047  # of them
MOST_TURNS = 40  # of which one comes nearest to whole samples


@dataclass(frozen=True, eq=False)
class Form:
    """A model affine in its parameters, sampled, and the gain of its predictor.

    Its parameters are those of the structure, then free delays, then the Fourier coefficients of
    K(ψ) in the order harmonic, state, output.

    Attributes
    ----------
    structure : PeriodicStructure
        Of a system in continuous time, or of the steps themselves.
    omega : float
        rad/s.
    n_phases : float
        Samples a period, whole or not.
    observe : ndarray, shape (n_phases, l, l_model), or None
        What is measured of the model's outputs at each phase.
    discrete : bool
        Whether the structure is one of steps, [A B; C D](ψ).
    n_gain_harmonics : int or None
        Of K(ψ); None for a simulation, without K.
    n_points : int or None
        Azimuths of a turn between which matrices are interpolated, odd; None for the samples'.
    delays : Fractions or None
        Of a sample, of what is late; inputs are then given as the new ones, and the old ones.
    gauge : bool
        Whether coordinates are free, so that directions that move no output do not count.
    waveform : bool
        Whether each record has a waveform of the turn of its own, which is unknown: what a trim
        that was subtracted is off by. Turns then hold whole samples.
    """

    structure: PeriodicStructure
    omega: float
    n_phases: float
    observe: np.ndarray | None = None
    discrete: bool = False
    n_gain_harmonics: int | None = None
    n_points: int | None = None
    delays: Fractions | None = None
    gauge: bool = False
    waveform: bool = False

    @property
    def n_states(self):
        return self.structure.n_states

    @property
    def n_outputs(self):
        return self.structure.n_outputs if self.observe is None else self.observe.shape[1]

    @property
    def n_inputs(self):
        """Inputs of its records."""
        return self.structure.n_inputs * (1 if self.delays is None else 2)

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
