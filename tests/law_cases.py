"""What laws are stated over: random stable systems by their poles, sampling, windows, records."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from hypothesis import assume, settings
from hypothesis import strategies as st
from scipy import linalg

from sklearn_hd.algorithms.lti.simulation import propagate

SEEDS = st.integers(0, 2**32 - 1)
UP_TO_SIX, UP_TO_THREE, UP_TO_TWO = st.integers(1, 6), st.integers(1, 3), st.integers(0, 2)
WINDOWS = [side + shape for side in ("", "centred-") for shape in ("boxcar", "triangle", "hann")]
APART = 0.05  # between poles, so that rounding does not mix their modes


def examples(count):
    """Settings for a law: so many cases by default, fifty times as many in the nightly profile."""
    return settings(max_examples=count * settings.default.max_examples // 100)


@dataclass(frozen=True)
class System:
    """State-space matrices; ``dt`` is None in continuous time."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float | None = None

    @property
    def matrices(self):
        return self.A, self.B, self.C, self.D

    def moved(self, T):
        """The same system in the states T x."""
        inverse = np.linalg.inv(T)
        return System(T @ self.A @ inverse, T @ self.B, self.C @ inverse, self.D, self.dt)

    def simulate(self, u, x0=None):
        x0 = np.zeros(len(self.A)) if x0 is None else x0
        return propagate(self.A, u @ self.B.T, x0) @ self.C.T + u @ self.D.T


def markov(A, B, C, D, count=12):
    """D, C B, C A B, …: the response to an impulse."""
    terms = [D]
    for _ in range(count):
        terms.append(C @ B)
        B = A @ B
    return np.array(terms)


@st.composite
def poles(draw, *, discrete, n_states=UP_TO_SIX, positive=False):
    """Stable poles in conjugate pairs, some real, no two closer than APART.

    ``positive`` leaves out those on the negative real axis, which no sampling gives.
    """
    n = draw(n_states)
    n_pairs = draw(st.integers(0, n // 2))
    size = st.floats(0.2, 0.95) if discrete else st.floats(-4.0, -0.1)
    real, upper = [], []
    for _ in range(n - 2 * n_pairs):
        pole = draw(size)
        real.append(pole if positive or not discrete or draw(st.booleans()) else -pole)
    for _ in range(n_pairs):
        if discrete:
            upper.append(draw(size) * np.exp(1j * draw(st.floats(0.15, 2.9))))
        else:
            upper.append(draw(size) + 1j * draw(st.floats(0.2, 6.0)))
    values = np.array([*real, *upper, *np.conj(upper)], dtype=complex)
    distance = np.abs(values[:, None] - values) + np.eye(n)
    assume(distance.min() >= APART)
    return np.array(real), np.array(upper, dtype=complex)


def random_rotation(rng, n):
    return np.linalg.qr(rng.standard_normal((n, n)))[0]


def well_conditioned(rng, n):
    """A change of states of condition number 9."""
    return (
        random_rotation(rng, n) @ np.diag(np.geomspace(1.0 / 3.0, 3.0, n)) @ random_rotation(rng, n)
    )


def directions(rng, rows, columns):
    """Rows of length one to two, so that every mode is driven, or seen."""
    M = rng.standard_normal((rows, columns))
    return M * rng.uniform(1.0, 2.0, (rows, 1)) / np.linalg.norm(M, axis=1, keepdims=True)


@st.composite
def systems(draw, *, discrete=True, feedthrough=None, min_inputs=1, **which):
    """Stable systems of 1 to 6 states, up to 3 inputs and 1 to 3 outputs."""
    real, upper = draw(poles(discrete=discrete, **which))
    rng = np.random.default_rng(draw(SEEDS))
    m, n_outputs = draw(st.integers(min_inputs, 3)), draw(st.integers(1, 3))
    blocks = [[[p]] for p in real] + [[[p.real, p.imag], [-p.imag, p.real]] for p in upper]
    A = linalg.block_diag(*blocks)
    n = len(A)
    B = directions(rng, n, m) if m else np.zeros((n, 0))
    direct = draw(st.booleans()) if feedthrough is None else feedthrough
    D = rng.standard_normal((n_outputs, m)) * direct
    system = System(A, B, directions(rng, n, n_outputs).T, D, 1.0 if discrete else None)
    return system.moved(well_conditioned(rng, n))


def hankel_values(system):
    """Hankel singular values of a discrete system, the largest first."""
    reach = linalg.solve_discrete_lyapunov(system.A, system.B @ system.B.T)
    seen = linalg.solve_discrete_lyapunov(system.A.T, system.C.T @ system.C)
    return np.sqrt(np.sort(np.abs(linalg.eigvals(reach @ seen)))[::-1])


@st.composite
def identifiable_systems(draw, **which):
    """Systems of which every state shows: Hankel singular values within two decades."""
    system = draw(systems(**which))
    values = hankel_values(system)
    assume(values[-1] > 1e-2 * values[0])
    return system


def recorded(system, rng, lengths, *, dt=0.1, at_rest=False):
    """White inputs and the response, one record a length, in frames indexed by (record, time)."""
    inputs, outputs = [], []
    n, m, n_outputs = len(system.A), system.B.shape[1], len(system.C)
    for label, length in enumerate(lengths):
        u = rng.standard_normal((length, m))
        y = system.simulate(u, None if at_rest else rng.standard_normal(n))
        time = dt * np.arange(length)
        index = pd.MultiIndex.from_product([[label], time], names=["record", "time"])
        inputs.append(pd.DataFrame(u, index, [f"u{k}" for k in range(m)]))
        outputs.append(pd.DataFrame(y, index, [f"y{k}" for k in range(n_outputs)]))
    return pd.concat(inputs), pd.concat(outputs)


@dataclass(frozen=True)
class Sampling:
    """A fundamental frequency and what samples it, as HarmonicAnalyzer takes it."""

    samples_per_period: int
    period: float
    hop: int | str
    window: str

    @property
    def omega(self):
        return 2.0 * np.pi / self.period

    @property
    def dt(self):
        return self.period / self.samples_per_period

    @property
    def options(self):
        if self.hop == "period":
            return {"reading": "period", "window": self.window}
        return {"hop": self.hop, "window": self.window}

    def time(self, first, length):
        return self.dt * (first + np.arange(length))


@st.composite
def samplings(draw, *, min_samples=3, hops=None):
    spp = draw(st.integers(min_samples, 24))
    divisors = [d for d in range(1, spp + 1) if spp % d == 0]
    hop = draw(st.sampled_from([*divisors, "period"] if hops is None else hops(divisors)))
    period = draw(st.sampled_from([0.05, 1.0, 2.0 * np.pi, 17.0]))
    return Sampling(spp, period, hop, draw(st.sampled_from(WINDOWS)))


@st.composite
def record_layouts(draw, sampling, *, most=4):
    """First sample and length, in samples, of some records, each longer than two periods.

    Records may begin between two samples of the grid through ψ = 0.
    """
    spp = sampling.samples_per_period
    firsts = st.one_of(st.integers(0, 3 * spp), st.floats(0.0, 3.0 * spp))
    layouts = st.tuples(firsts, st.integers(2 * spp, 5 * spp))
    return draw(st.lists(layouts, min_size=1, max_size=most))


def laid_out(sampling, layout, signals, names):
    """Signals, a function of time, in records laid out in time."""
    frames = {}
    for label, (first, length) in enumerate(layout):
        time = pd.Index(sampling.time(first, length), name="time")
        frames[label] = pd.DataFrame(signals(time.to_numpy()), time, names)
    return pd.concat(frames, names=["record"])


@st.composite
def periodic_matrices(draw, *, n_states=UP_TO_THREE, harmonics=UP_TO_TWO):
    """Fourier coefficients of a periodic F about a stable mean, and ω."""
    real, upper = draw(poles(discrete=False, n_states=n_states))
    rng = np.random.default_rng(draw(SEEDS))
    K = draw(harmonics)
    blocks = [[[p]] for p in real] + [[[p.real, p.imag], [-p.imag, p.real]] for p in upper]
    A = linalg.block_diag(*blocks)
    n = len(A)
    T = well_conditioned(rng, n)
    F = np.zeros((2 * K + 1, n, n))
    F[0] = T @ A @ np.linalg.inv(T)
    F[1:] = 0.3 * rng.standard_normal((2 * K, n, n))
    return F, draw(st.sampled_from([0.7, 2.0, 2.0 * np.pi, 40.0]))


def same_modulo(found, true, omega, atol):
    """Whether Floquet exponents agree, each with one of the other's, modulo jω."""
    gap = np.asarray(found)[:, None] - np.asarray(true)
    gap -= 1j * omega * np.round(gap.imag / omega)
    gap = np.abs(gap)
    return len(found) == len(true) and max(gap.min(axis=0).max(), gap.min(axis=1).max()) <= atol
