"""Likelihood of records under a periodic structure, and its least-squares approximation.

    −log L = Σ_i N_i log (√2π σ_i) + Σ_i RSS_i(θ, x0) / (2σ_i²)

A step of Gauss and Newton minimises |[X J] [δx0; δθ] + r|², rows weighed by 1/σ_i. Each
segment's δx0 is eliminated first: r and J without their projection on the range of X
leave a small triangular system for δθ, and δx0 = −X⁺ (J δθ + r). Of
[X J r] only the triangular factor is kept, one for each output,

    ∂x[k+1] = Φ_k ∂x[k] + ∂Ψ_k z[k],   ∂ŷ[k] = Out_k [∂x[k]; 0] + ∂Out_k z[k],   z = [x; u]

and a record is read in pieces: neither its length nor the number of parameters is bounded
by memory, and the factors keep the digits that JᵀJ would lose.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, UNKNOWN
from sklearn_hd.algorithms.lti.structured_model import column_sizes
from sklearn_hd.algorithms.matching.bounded_steps import BoundedSteps
from sklearn_hd.algorithms.periodic.floquet import propagate_periodic
from sklearn_hd.algorithms.periodic.periodic_structure import (
    MAX_SUBSTEPS,
    PeriodicStructure,
    n_substeps,
    sampled_response,
)

PIECE = 1_000_000  # numbers in the sensitivities of one piece, 8 MB: a cache
TILE = 64  # samples of a time-invariant system that make a period
NOISELESS = 1e-10  # of the outputs: less noise may be what rounding leaves in simulation


@dataclass(frozen=True, eq=False)
class Record:
    """One contiguous record.

    Attributes
    ----------
    inputs : ndarray, shape (n_samples, m)
        Held from sample to sample.
    outputs : ndarray, shape (n_samples, l)
        Zero where missing.
    present : ndarray of bool, shape (n_samples, l)
    first_phase : int
        Phase of the first sample, in samples after ψ = 0.
    """

    inputs: np.ndarray
    outputs: np.ndarray
    present: np.ndarray
    first_phase: int


def as_records(segments, n_inputs, n_outputs):
    """Records from (inputs, outputs, first_phase); outputs may hold NaN where missing.

    ``outputs=None`` means that all are present, their values not told.

    Raises
    ------
    ValueError
        If shapes do not fit, inputs are not finite, or no output is there at all.
    """
    records = []
    for position, (inputs, outputs, first_phase) in enumerate(segments):
        u = np.asarray(inputs, dtype=float)
        y = np.zeros((len(u), n_outputs)) if outputs is None else np.asarray(outputs, dtype=float)
        if u.shape != (len(u), n_inputs) or y.shape != (len(u), n_outputs) or not len(u):
            raise ValueError(
                f"segment {position} has inputs of shape {u.shape} and outputs of shape "
                f"{y.shape}; the structure needs (n_samples, {n_inputs}) and "
                f"(n_samples, {n_outputs})"
            )
        if not np.all(np.isfinite(u)):
            raise ValueError(
                f"inputs of segment {position} hold NaN or infinity; only outputs may be missing: "
                f"cut the segment where an input is"
            )
        present = np.isfinite(y)
        records.append(Record(u, np.where(present, y, 0.0), present, int(first_phase)))
    counts = sum((record.present.sum(axis=0) for record in records), np.zeros(n_outputs, int))
    if not np.all(counts > 0):
        raise ValueError(
            f"outputs have {counts.tolist()} values in {len(records)} segments; each output needs "
            f"some that are not NaN"
        )
    return records


def simulate(response, record, x0):
    """States (n_samples, n) and outputs (n_samples, l) of one record, from x0 (n,)."""
    Psi, Out = (_rolled(M, record.first_phase) for M in (response.Psi, response.Out))
    n = response.n_states
    forcing = _by_phase(Psi[:, :, n:], record.inputs)
    x = _propagate(Psi[:, :, :n], forcing, x0)
    return x, _by_phase(Out, np.concatenate([x, record.inputs], axis=1))


def residuals(response, record, x0):
    """ŷ − y of one record, shape (n_samples, l); zero where y is missing."""
    difference = simulate(response, record, x0)[1] - record.outputs
    return np.where(record.present, difference, 0.0)


def jacobian_factors(response, record, x0, *, free_x0=True):
    """Triangular factors of [∂ŷ/∂x0, ∂ŷ/∂θ, ŷ − y], one for each output.

    Parameters
    ----------
    response : SampledResponse
        With its derivatives; without them there are no columns for θ.
    record : Record
    x0 : ndarray, shape (n,)
    free_x0 : bool, default=True
        Whether there are columns for x0.

    Returns
    -------
    factors : ndarray, shape (l, c, c)
        Upper triangular; c = n + k + 1, or k + 1 with x0 known.
    """
    difference = residuals(response, record, x0)
    columns = n_columns(response, free_x0=free_x0) + 1
    factors = np.zeros((difference.shape[1], columns, columns))
    for start, stop, dy in output_sensitivities(response, record, x0, free_x0=free_x0):
        block = np.concatenate([dy, difference[None, start:stop]])
        for i, factor in enumerate(factors):
            factors[i] = updated_factor(factor, block[:, :, i])
    return factors


def updated_factor(factor, columns):
    """Triangular factor (c, c) with further rows: columns (c, n_rows) of the matrix."""
    block = np.concatenate([factor.T, columns], axis=1).T  # in the order that LAPACK reads
    return linalg.qr(block, mode="r", overwrite_a=True, check_finite=False)[0][: len(factor)]


def n_columns(response, *, free_x0):
    """Number of derivatives: by x0 if it is free, and by θ."""
    n_parameters = 0 if response.dPsi is None else len(response.dPsi)
    return n_parameters + (response.n_states if free_x0 else 0)


def output_sensitivities(response, record, x0, *, free_x0=True):
    """∂ŷ/∂x0 and ∂ŷ/∂θ of one record, piece by piece.

    Yields
    ------
    start, stop : int
        Samples of the piece.
    dy : ndarray, shape (n_columns, stop − start, l)
        Zero where an output is missing.
    """
    Out = _rolled(response.Out, record.first_phase)
    n, columns = response.n_states, n_columns(response, free_x0=free_x0)
    n0 = n if free_x0 else 0
    acting, seen = _nonzero(response.dPsi), _nonzero(response.dOut)
    moving = np.concatenate([np.arange(n0), n0 + acting])  # columns that the states depend on
    z = np.concatenate([simulate(response, record, x0)[0], record.inputs], axis=1)
    carried = np.zeros((len(moving), n))
    carried[:n0] = np.eye(n)[:n0]
    n_phases = max(len(response.Psi), len(Out))
    Phi = _rolled(response.Phi, record.first_phase)
    dPsi = _rolled(response.dPsi[acting], record.first_phase) if len(acting) else None
    dOut = _rolled(response.dOut[seen], record.first_phase) if len(seen) else None
    for start, stop in _pieces(len(z), n_phases, columns + 1, n, Out.shape[1]):
        now = z[start : stop + 1]
        forcing = np.zeros((len(moving), len(now), n))
        if dPsi is not None:
            forcing[n0:] = _by_phase(dPsi, now)
        dx = _propagate(Phi, forcing, carried)
        carried, dx = dx[:, -1], dx[:, : stop - start]
        dy = np.zeros((columns, stop - start, Out.shape[1]))
        dy[moving] = _by_phase(Out[:, :, :n], dx)
        if dOut is not None:
            dy[n0 + seen] += _by_phase(dOut, z[start:stop])
        yield start, stop, np.where(record.present[start:stop], dy, 0.0)


def _nonzero(derivatives):
    """Parameters that move something: those of the outputs alone leave states where they are."""
    if derivatives is None:
        return np.zeros(0, dtype=int)
    return np.flatnonzero(derivatives.any(axis=(1, 2, 3)))


def _pieces(n_samples, n_phases, columns, n_states, n_outputs):
    """First and last sample of pieces of whole periods that fit into memory."""
    each = columns * (4 * n_states + 2 * n_outputs)
    length = n_phases * max(1, PIECE // (each * n_phases))
    return [(k, min(k + length, n_samples)) for k in range(0, n_samples, length)]


def _rolled(matrices, first_phase):
    """Matrices of one period (..., p, rows, columns), beginning at a record's first phase."""
    shift = first_phase % matrices.shape[-3]
    return np.roll(matrices, -shift, axis=-3) if shift else matrices


def _by_phase(matrices, signals):
    """M[k mod p] s[k] for matrices (..., p, a, b) and signals (..., n_samples, b)."""
    p, a, b = matrices.shape[-3:]
    *batch, n_samples, _ = signals.shape
    n_periods = -(-n_samples // p)
    padding = [(0, 0)] * len(batch) + [(0, n_periods * p - n_samples), (0, 0)]
    s = np.pad(signals, padding).reshape(*batch, n_periods, p, b)
    product = np.swapaxes(s, -2, -3) @ np.swapaxes(matrices, -1, -2)
    product = np.swapaxes(product, -2, -3)
    return product.reshape(*product.shape[:-3], n_periods * p, a)[..., :n_samples, :]


def _propagate(Phi, forcing, x0):
    """States of the periodic recursion; infinite or NaN where they overflow."""
    if len(Phi) == 1:  # √n_samples steps of many samples each instead of n_samples of one
        Phi = np.broadcast_to(Phi, (min(TILE, forcing.shape[-2]), *Phi.shape[1:]))
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        return propagate_periodic(Phi, forcing, x0)


@dataclass(frozen=True, eq=False)
class Point:
    """Parameters, initial states, and how well they fit."""

    theta: np.ndarray
    x0: np.ndarray  # (n_segments, n)
    rss: np.ndarray  # (l,)
    cost: float
    radius: float  # of the monodromy matrix's spectrum


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """Weighted least squares for a step, the initial states eliminated.

    Attributes
    ----------
    factors : list of ndarray, shape (l, c, c)
        Of each segment, not weighted.
    R : ndarray, shape (k + 1, k + 1)
        Triangular factor of the weighted [J r], its projection on x0 taken out.
    size : ndarray, shape (k,)
        Length of J's columns before that.
    states : list of ndarray, shape (n, k + 1)
        The best change of x0 is −states [step; 1].
    """

    factors: list
    R: np.ndarray
    size: np.ndarray
    states: list
    promised_by_states: float
    left: np.ndarray = field(init=False)
    singular: np.ndarray = field(init=False)
    adjoint: np.ndarray = field(init=False)

    def __post_init__(self):
        scaled = self.R[:, :-1] / self.size
        left, singular, adjoint = linalg.svd(scaled, full_matrices=False)
        object.__setattr__(self, "left", left)
        object.__setattr__(self, "singular", singular)
        object.__setattr__(self, "adjoint", adjoint)

    @property
    def kept(self):
        """Singular values that are not rounding; J's columns have length one or less."""
        return self.singular > DEPENDENT

    @property
    def projected(self):
        return np.where(self.kept, self.left.T @ self.R[:, -1], 0.0)

    @property
    def promised(self):
        """Fall of the weighted sum of squares to first order."""
        return float(self.projected @ self.projected) + self.promised_by_states

    def step(self, damping):
        """Change of θ, of least norm in scaled coordinates."""
        weight = self.singular / (self.singular**2 + damping)
        weight = np.where(self.kept, weight, 0.0)
        return -(self.adjoint.T @ (weight * self.projected)) / self.size

    def within(self, lower, upper):
        """The same for steps between bounds."""
        if not (np.any(np.isfinite(lower)) or np.any(np.isfinite(upper))):
            return self
        steps = BoundedSteps(self.R[:, -1], self.R[:, :-1], lower, upper)
        return BoundedSystem(self.factors, self.states, self.promised_by_states, steps)

    def covariance(self):
        """(JᵀJ)⁻¹, and which parameters are not identified."""
        kept = self.kept
        root = self.adjoint[kept].T / self.singular[kept] / self.size[:, None]
        covariance = root @ root.T
        unknown = np.linalg.norm(self.adjoint[~kept], axis=0) > UNKNOWN
        covariance[unknown, :] = covariance[:, unknown] = np.nan
        covariance[unknown, unknown] = np.inf
        return covariance, unknown


@dataclass(frozen=True, eq=False)
class BoundedSystem:
    """A :class:`LinearSystem` for steps between bounds."""

    factors: list
    states: list
    promised_by_states: float
    steps: BoundedSteps

    @property
    def promised(self):
        return self.steps.promised + self.promised_by_states

    def step(self, damping):
        return self.steps.damped(damping)[0]


@dataclass(frozen=True, eq=False)
class Problem:
    """Structure, records and what is known of the noise."""

    structure: PeriodicStructure
    records: list
    omega: float
    n_phases: int
    observe: np.ndarray | None
    free_x0: bool
    sigma: np.ndarray | None
    counts: np.ndarray  # (l,) values of each output
    size: np.ndarray  # (l,) rms of each output

    @property
    def n_residuals(self):
        return int(self.counts.sum())

    def response(self, theta, *, sensitivities):
        return sampled_response(
            self.structure,
            theta,
            self.omega,
            self.n_phases,
            self.observe,
            sensitivities=sensitivities,
        )

    def noise(self, rss):
        """Standard deviations given, or those of largest likelihood."""
        if self.sigma is not None:
            return self.sigma
        return np.maximum(np.sqrt(rss / self.counts), 4.0 * EPS * self.size)

    def cost(self, rss):
        """Negative logarithm of the likelihood."""
        noise = self.noise(rss)
        return float(
            np.sum(self.counts * np.log(np.sqrt(2.0 * np.pi) * noise) + 0.5 * rss / noise**2)
        )

    def at_rounding(self, point):
        return bool(np.all(point.rss <= self.counts * (NOISELESS * self.size) ** 2))

    def resolves(self, theta):
        """Whether the samples can follow the states at these parameters."""
        finite = np.all(np.isfinite(theta))
        return finite and (
            n_substeps(self.structure, theta, self.omega, self.n_phases) <= MAX_SUBSTEPS
        )

    def point(self, theta, x0):
        """Residuals at some parameters and initial states."""
        response = self.response(theta, sensitivities=False)
        with np.errstate(over="ignore", invalid="ignore"):
            rss = sum(
                np.sum(residuals(response, record, start) ** 2, axis=0)
                for record, start in zip(self.records, x0, strict=True)
            )
            cost = self.cost(rss) if np.all(np.isfinite(rss)) else np.inf
        return Point(theta, x0, rss, cost, response.spectral_radius)

    def factors(self, point, *, parameters=True):
        """Triangular factors of [∂ŷ/∂x0, ∂ŷ/∂θ, ŷ − y], one array (l, c, c) a segment."""
        response = self.response(point.theta, sensitivities=parameters)
        return [
            jacobian_factors(response, record, start, free_x0=self.free_x0)
            for record, start in zip(self.records, point.x0, strict=True)
        ]

    def linearise(self, point, noise=None, *, parameters=True):
        """Least-squares system for a step from a point."""
        noise = self.noise(point.rss) if noise is None else noise
        n0 = self.structure.n_states if self.free_x0 else 0
        return eliminate_states(self.factors(point, parameters=parameters), noise, n0)

    def predicted_cost(self, system, step, x0_step):
        """Cost at a step if the outputs were linear in it."""
        rss = 0.0
        for factors, states in zip(system.factors, x0_step, strict=True):
            rss = rss + np.sum((factors @ np.concatenate([states, step, [1.0]])) ** 2, axis=1)
        return self.cost(rss)


def eliminate_states(factors, noise, n0):
    """Weigh the outputs' factors, and take the projection on the initial states out.

    Parameters
    ----------
    factors : list of ndarray, shape (l, c, c)
        Of each segment, from :func:`sklearn_hd.algorithms.likelihood.likelihood.jacobian_factors`.
    noise : ndarray, shape (l,)
    n0 : int
        Columns of x0: n, or 0.

    Returns
    -------
    system : LinearSystem
    """
    width = factors[0].shape[2] - n0
    R, squares, states, promised = np.zeros((0, width)), np.zeros(width), [], 0.0
    for each in factors:
        stacked = (each / noise[:, None, None]).reshape(-1, n0 + width)
        rest = stacked[:, n0:]
        squares += np.sum(rest**2, axis=0)
        basis, inverse = _range(stacked[:, :n0])
        shares = np.zeros((basis.shape[1], width))
        for _ in range(2):  # the second time for the digits that the first one left
            share = basis.T @ rest
            rest, shares = rest - basis @ share, shares + share
        states.append(inverse @ shares)
        promised += shares[:, -1] @ shares[:, -1]
        R = linalg.qr(np.vstack([R, rest]), mode="r", check_finite=False)[0][:width]
    size = np.sqrt(squares[:-1])
    return LinearSystem(factors, R, np.where(size > 0, size, 1.0), states, float(promised))


def _range(matrix):
    """Orthonormal basis U of a matrix's range, and M⁺U."""
    size = column_sizes(matrix)
    left, singular, adjoint = linalg.svd(matrix / size, full_matrices=False)
    kept = singular > DEPENDENT
    return left[:, kept], adjoint[kept].T / singular[kept] / size[:, None]


def likelihood_problem(structure, segments, omega, n_phases, observe, free_x0, sigma):
    """The problem, its records checked."""
    n_outputs = structure.n_outputs if observe is None else np.shape(observe)[1]
    records = as_records(segments, structure.n_inputs, n_outputs)
    if sigma is not None:
        sigma = np.asarray(sigma, dtype=float)
        if sigma.shape != (n_outputs,) or not np.all(sigma > 0):
            raise ValueError(
                f"sigma={sigma.tolist()} must hold a positive standard deviation for each of "
                f"{n_outputs} outputs; leave it out to have them estimated"
            )
    counts = sum(record.present.sum(axis=0) for record in records)
    size = np.sqrt(sum(np.sum(record.outputs**2, axis=0) for record in records) / counts)
    largest = np.max(size) if np.max(size) > 0 else 1.0
    size = np.where(size > 0, size, largest)
    return Problem(structure, records, omega, n_phases, observe, free_x0, sigma, counts, size)


def is_white(left, lags):
    """Whether residuals look like white noise over some lags, each output by itself.

    With ρ_k the autocorrelation at lag k of n samples, n Σ ρ_k² has mean L and variance
    2 L over L lags of white noise (Box and Pierce, 1970); four spreads above the mean it
    is none.

    Parameters
    ----------
    left : ndarray, shape (n_samples, l)
    lags : int

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal((2000, 1))
    >>> is_white(noise, 20), is_white(np.cumsum(noise, axis=0), 20)
    (True, False)
    """
    n = len(left)
    products = [np.sum(left[k:] * left[: n - k], axis=0) for k in range(min(lags, n - 1) + 1)]
    if not products[0].all():
        return False
    statistic = n * np.sum((np.array(products[1:]) / products[0]) ** 2, axis=0)
    return bool(np.all(statistic <= lags + 4.0 * np.sqrt(2.0 * lags)))
