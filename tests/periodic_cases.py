"""Linear time-periodic systems with known truth, and the period-synchronous route to them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.algorithms.periodic.integration import integrate
from sklearn_hd.systems import LTPSystem


def mathieu(stiffness=2.0, excitation=0.5, damping=0.1, **measured):
    """ÿ + 2 d ẏ + (a − 2 q cos ψ) y = u with ω = 2; a = 1 has negative real multipliers."""
    F = np.zeros((3, 2, 2))
    F[0] = [[0.0, 1.0], [-stiffness, -2.0 * damping]]
    F[1, 1, 0] = 2.0 * excitation
    options = {"omega": 2.0, "state_names": ["y", "v"]} | measured
    return LTPSystem(F, [[0.0], [1.0]], **options)


def deflection_only(**parameters):
    """The same oscillator of which y alone is measured."""
    return mathieu(P=[[1.0, 0.0]], output_names=["y"], **parameters)


@dataclass(frozen=True)
class SwitchedStiffness:
    """F(ψ) of Meissner's equation."""

    stiffness: float
    modulation: float
    share: float
    damping: float

    def __call__(self, psi):
        early = np.mod(psi, 2.0 * np.pi) <= 2.0 * np.pi * self.share
        F = np.zeros((len(psi), 2, 2))
        F[:, 0, 1], F[:, 1, 1] = 1.0, -self.damping
        F[:, 1, 0] = -self.stiffness + self.modulation * np.where(early, 1.0, -1.0)
        return F


def meissner(*, stiffness=1.0, modulation=0.2, share=1.0 / 3.0, period=np.pi, damping=0.0):
    """ÿ + d ẏ + (s − m ψ) y = u, ψ = +1 for t ≤ p T, else −1.

    E. Meissner, "Über Schüttelerscheinungen in Systemen mit periodisch veränderlicher
    Elastizität", Schweizerische Bauzeitung 72 (1918), 95–98.
    """
    F = SwitchedStiffness(stiffness, modulation, share, damping)
    names = {"state_names": ["y", "y_dot"], "input_names": ["u"]}
    return LTPSystem(F, [[0.0], [1.0]], omega=2.0 * np.pi / period, **names)


def bittanti_colaneri():
    """ẋ = [[−1 + sin t, 0], [1 − cos t, −3]] x + [1, 1]ᵀ u, of exponents −1 and −3.

    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, Springer, 2009,
    chapter 1, without the input.
    """
    F = np.zeros((3, 2, 2))
    F[0] = [[-1.0, 0.0], [1.0, -3.0]]
    F[1, 1, 0] = -1.0
    F[2, 0, 0] = 1.0
    return LTPSystem(F, [[1.0], [1.0]], omega=1.0)


def vinograd():
    """Unstable, of exponents 2 and −13, with the eigenvalues −1 and −10 at every instant.

        ẋ = [[−1 − 9c² + 12sc, 12c² + 9sc], [−12s² + 9sc, −1 − 9s² − 12sc]] x + [1, 1]ᵀ u

    with c = cos 6t and s = sin 6t. R. E. Vinograd, "On a criterion of instability in the sense
    of Lyapunov of the solutions of a linear system of ordinary differential equations",
    Doklady Akademii Nauk SSSR 84 (1952), 201–204, without the input.
    """
    F = np.zeros((5, 2, 2))  # c² = (1 + cos 12t) / 2, s² = (1 − cos 12t) / 2, sc = sin 12t / 2
    F[0] = [[-5.5, 6.0], [-6.0, -5.5]]
    F[3] = [[-4.5, 6.0], [6.0, 4.5]]
    F[4] = [[6.0, 4.5], [4.5, -6.0]]
    return LTPSystem(F, [[1.0], [1.0]], omega=6.0)


def shape(psi):
    """P(ψ) of the systems below, and dP/dψ."""
    one, zero = np.ones_like(psi), np.zeros_like(psi)
    c, s = np.cos(psi), np.sin(psi)
    P = np.array([[1.0 + 0.3 * c, 0.2 * s], [0.1 * one, 1.0 - 0.2 * c]])
    slope = np.array([[-0.3 * s, 0.2 * c], [zero, 0.2 * s]])
    return P.transpose(2, 0, 1), slope.transpose(2, 0, 1)


def of_exponents(R, G=((1.0,), (0.5,)), omega=1.0, **measured):
    """The system of mode shapes P(ψ) and Floquet exponents eig(R): F = (ω P′ + P R) P⁻¹."""

    def F(psi):
        P, slope = shape(np.asarray(psi))
        return (omega * slope + P @ np.asarray(R, dtype=float)) @ np.linalg.inv(P)

    return LTPSystem(F, np.array(G), omega=omega, **measured)


def coupled(**measured):
    """Two degrees of freedom, two inputs; two of its multipliers are negative."""
    rng = np.random.default_rng(5)
    F = np.zeros((5, 4, 4))
    F[0] = [[0, 1, 0, 0], [-2, -0.3, 0.3, 0], [0, 0, 0, 1], [0.4, 0, -5, -0.4]]
    F[1:, 1::2] = 0.3 * rng.standard_normal((4, 2, 4))
    return LTPSystem(F, [[0, 0], [1, 0], [0, 0], [0, 1.0]], omega=3.0, **measured)


def steps(rng, n_samples, n_inputs, first, n_changes=6):
    """Inputs that change a few times, at random samples, and rest in the last third."""
    u = np.zeros((n_samples, n_inputs))
    for column in u.T:
        span = np.arange(first, 2 * n_samples // 3)
        edges = np.sort(rng.choice(span, size=n_changes, replace=False))
        for start, stop in pairwise(edges):
            column[start:stop] = rng.uniform(-1.0, 1.0)
    return u


def record(system, *, n_periods=60, samples=32, seed=0, noise=0.0, shift=0, n_changes=6, u=None):
    """Inputs and outputs as frames; the first sample lies ``shift`` samples after ψ = 0."""
    rng = np.random.default_rng(seed)
    n_samples = n_periods * samples
    t = (np.arange(n_samples) + shift) * system.period / samples
    if u is None:
        u = steps(rng, n_samples, system.n_inputs, samples, n_changes)
    y = system.simulate(u, t)
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    index = pd.Index(t, name="time")
    return (
        pd.DataFrame(u, index, list(system.input_names)),
        pd.DataFrame(y, index, list(system.output_names)),
    )


def periodicity_defect(system, trim):
    """x(T) − x(0) of the trim's initial state; zero for an exact periodic solution."""
    t = np.linspace(0.0, system.period, 65)
    u = np.broadcast_to(trim.inputs, (len(t), system.n_inputs))
    x = integrate(system.f, trim.initial_state, u, t, rtol=1e-13, atol=1e-14)
    return x[-1] - x[0]


def synchronous(omega, structure=None, *, order="auto", harmonics=1, analyzer=None, **match):
    """Analyzer, identification and matching, period by period."""
    options = {"output_harmonics": harmonics, "reading": "period"} | (analyzer or {})
    structure = HarmonicStructure() if structure is None else structure
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, **options)),
            ("identify", MOESPRegressor(order=order)),
            ("match", StructuredMatcher(structure=structure, **match)),
        ]
    )


def same_exponents(found, system, rtol=1e-6):
    """Whether Floquet exponents agree, each with its nearest one modulo jω."""
    true = system.floquet_exponents()
    assert len(found) == len(true)
    gap = np.asarray(found)[:, None] - true
    gap -= 1j * system.omega * np.round(gap.imag / system.omega)
    assert np.abs(gap).min(axis=0).max() <= rtol * np.abs(true).max()


def similar(M, seed=0):
    """A matrix in random coordinates."""
    T = np.random.default_rng(seed).standard_normal(np.shape(M)) + 2 * np.eye(len(M))
    return T @ M @ np.linalg.inv(T)
