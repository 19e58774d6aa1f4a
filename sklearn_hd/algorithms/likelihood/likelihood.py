"""Likelihood of records under a sampled periodic model, and its least-squares approximation.

    −log L = Σ_k ½ (log det 2πS + e[k]ᵀ S⁻¹ e[k]),   e[k] = y[k] − ŷ[k; θ, x0]

S, the covariance of what predictions leave, is diagonal for simulations, whose outputs have noise
of their own, and full for the innovations form; its own optimum is Σ e eᵀ / N.

A step of Gauss and Newton minimises |[X J] [δx0; δθ] + r|², rows weighed by S^{-1/2}. Each
segment's δx0 is eliminated first: r and J without their projection on the range of X
leave a small triangular system for δθ, and δx0 = −X⁺ (J δθ + r). Of [X J r] only the triangular
factor is kept, so that digits last that JᵀJ would lose.

A trim that was subtracted is off by a waveform c(ψ) that nobody knows. Of a simulation it is added
to e, of a predictor its periodic answer is, beside initial states that are free: in both cases the
most likely c takes the mean over the turns out of e at each phase. Steps get there turn by turn
(Helmert, 1876), as pieces come: row k of a phase becomes (e_k − mean of those before) √((k−1)/k).

What the records do not tell of some parameters may be known beforehand, ½ |known θ|² more: with
[J r] at the start, J/stiffness = U diag(s) Vᵀ over them when all others are free, stiffness θ along
v_j counts as white noise of variance 1 + s_j². So it counts where the records tell less (s_j < 1),
and hardly moves what they tell.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.predictor import (
    as_records,
    output_sensitivities,
    residuals,
)
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, HALF, UNKNOWN
from sklearn_hd.algorithms.linalg.triangular import column_sizes
from sklearn_hd.algorithms.matching.least_squares import BoundedSteps, FreeSteps

ROUNDING = 64.0 * EPS  # of an output, what simulation leaves of exactness
NOISELESS = 1e-10  # of the outputs: less noise may be what rounding leaves in simulation
WORTH_A_TURN = 1e-3  # of the likelihood, a row


@dataclass(frozen=True, eq=False)
class Point:
    """Parameters, initial states, and how well they fit."""

    theta: np.ndarray
    x0: np.ndarray  # (n_segments, n)
    moments: np.ndarray  # (l, l), Σ e eᵀ
    cost: float
    radius: float  # of the monodromy matrix's spectrum

    @property
    def rss(self):
        """Sum of squares that each output leaves."""
        return np.diag(self.moments)


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """Weighted least squares for a step, the initial states eliminated."""

    # (k + 1, k + 1): triangular factor of the weighted [J r], its projection on x0 taken out
    R: np.ndarray
    squares: np.ndarray  # (k,): those of J's columns before that, summed
    states: list  # of ndarray, shape (n, k + 1): the best change of x0 is −states [step; 1]
    promised_by_states: float
    bounds: tuple | None = None  # tuple of ndarray, shape (k,), or None: least and largest steps

    @cached_property
    def steps(self):
        """Those within bounds; free ones count J's columns by their length, without rounding."""
        if self.bounds is not None:
            return BoundedSteps(self.R[:, -1], self.R[:, :-1], *self.bounds)
        size = np.sqrt(np.where(self.squares > 0.0, self.squares, 1.0))
        return FreeSteps(self.R[:, :-1] / size, self.R[:, -1], size, DEPENDENT)

    @property
    def promised(self):
        """Fall of the weighted sum of squares to first order."""
        return float(self.steps.promised) + self.promised_by_states

    def step(self, damping):
        """Change of θ, of least norm in scaled coordinates."""
        return self.steps.damped(damping)[0]

    def fall(self, step):
        """Fall of the weighted sum of squares by a step if the outputs were linear in it."""
        left = float(np.sum((self.R @ np.append(step, 1.0)) ** 2))
        return float(np.sum(self.R[:, -1] ** 2)) - left + self.promised_by_states

    def beside(self, rows):
        """The same with further rows of [J r], (q, k + 1), in which no initial state is."""
        R = linalg.qr(np.vstack([self.R, rows]), mode="r", check_finite=False)[0]
        squares = self.squares + np.sum(rows[:, :-1] ** 2, axis=0)
        return replace(self, R=R[: len(squares) + 1], squares=squares)

    def untold(self, stiffness):
        """Rows of what is known of θ beforehand, (q, k), from the stiffness of each θ_j."""
        J, stiff = self.R[:, :-1], stiffness > 0.0
        free, own = _range(J[:, ~stiff])[0], J[:, stiff] / stiffness[stiff]
        for _ in range(2):
            own = own - free @ (free.T @ own)
        _, told, Vt = linalg.svd(own, full_matrices=False)
        rows = np.zeros((len(Vt), len(stiff)))
        rows[:, stiff] = Vt / np.hypot(1.0, told)[:, None] * stiffness[stiff]
        return rows

    def within(self, lower, upper):
        """The same for steps between bounds."""
        if not (np.any(np.isfinite(lower)) or np.any(np.isfinite(upper))):
            return self
        return replace(self, bounds=(lower, upper))

    def covariance(self, *, gauge=False):
        """(JᵀJ)⁻¹, and which parameters are not identified.

        With a gauge, directions that move no output do not count: (JᵀJ)⁺.
        """
        kept, adjoint = self.steps.kept, self.steps.adjoint
        root = adjoint[kept].T / self.steps.singular[kept] / self.steps.size[:, None]
        covariance = root @ root.T
        unknown = np.linalg.norm(adjoint[~kept], axis=0) > UNKNOWN
        if gauge:
            return covariance, np.zeros_like(unknown)
        covariance[unknown, :] = covariance[:, unknown] = np.nan
        covariance[unknown, unknown] = np.inf
        return covariance, unknown


class _AboutWaveform:
    """Rows of a record about a waveform of the turn that is free: an orthogonal change of them."""

    def __init__(self, n_phases):
        self.n_phases, self.begin, self.total, self.count = n_phases, 0, 0.0, 0.0

    def rows(self, values):
        """Those of the next piece, (n_columns, n_rows, l)."""
        begin, n_rows = self.begin, values.shape[1]
        x = by_turn(values, self.n_phases, begin)
        there = by_turn(np.ones((n_rows, 1)), self.n_phases, begin)
        count = self.count + np.cumsum(there, axis=0) - there
        before = self.total + np.cumsum(x, axis=1) - x
        self.total = self.total + x.sum(axis=1, keepdims=True)
        self.count, self.begin = self.count + there.sum(axis=0), (begin + n_rows) % self.n_phases
        x = np.where(there, x - before / np.maximum(count, 1.0), 0.0)
        x *= np.sqrt(count / (count + 1.0))
        return x.reshape(len(values), -1, values.shape[2])[:, begin : begin + n_rows]


def by_turn(values, n_phases, begin=0):
    """Rows (…, n_rows, l) as (…, n_turns, n_phases, l), from some phase on; zeros elsewhere."""
    *batch, n_rows, n_outputs = values.shape
    fill = [(0, 0)] * len(batch) + [(begin, -(begin + n_rows) % n_phases), (0, 0)]
    return np.pad(values, fill).reshape(*batch, -1, n_phases, n_outputs)


@dataclass(frozen=True, eq=False)
class Problem:
    """Form, records and what is known of the noise.

    ``sigma`` (l,) are the standard deviations of the noise, where they are known.
    ``correlated`` says whether what is left of outputs may go together. Products of the
    rows of ``known`` (q, k) with θ are white noise of variance one, known beforehand.
    """

    form: Form
    records: list
    sigma: np.ndarray | None = None
    correlated: bool = False
    known: np.ndarray | None = None
    size: np.ndarray = field(init=False)  # (l,) rms of each output

    def __post_init__(self):
        squares = sum(np.sum(record.outputs**2, axis=0) for record in self.records)
        size = np.sqrt(squares / self.n_rows)
        largest = np.max(size) if np.max(size) > 0 else 1.0
        object.__setattr__(self, "size", np.where(size > 0, size, largest))

    @property
    def n_rows(self):
        """Rows of all records."""
        return sum(len(record.outputs) for record in self.records)

    @property
    def n_residuals(self):
        return self.n_rows * self.form.n_outputs

    @property
    def n_waveforms(self):
        """Values of the waveforms that are free."""
        return sum(map(self._turns, self.records)) * self.form.n_phases * self.form.n_outputs

    def _turns(self, record):
        """Whether the record has a waveform of its own: two turns are needed to tell one."""
        return self.form.waveform and len(record.outputs) >= 2 * self.form.n_phases

    def _waveform(self, left):
        """Mean over the turns of what is left of a record, and rows of each phase."""
        counts = by_turn(np.ones((len(left), 1)), self.form.n_phases).sum(axis=0)
        return by_turn(left, self.form.n_phases).sum(axis=0) / counts, counts

    def _about(self, left):
        """What is left of a record about its waveform."""
        mean, _ = self._waveform(left)
        return left - mean[np.arange(len(left)) % len(mean)]

    def waveform(self, point):
        """What a trim that was subtracted is off by, (n_phases, l) from ψ = 0; None if none is.

        Of all records, each by the number of its turns.
        """
        response, total, counts = self.form.response(point.theta, sensitivities=False), 0.0, 0
        for record, x0 in zip(self.records, point.x0, strict=True):
            if self._turns(record):
                mean, own = self._waveform(residuals(response, record, x0))
                total = total - np.roll(own * mean, record.first_phase, axis=0)
                counts = counts + np.roll(own, record.first_phase, axis=0)
        if np.ndim(counts) == 0:
            return None
        mean = _outputs_of(response, total / counts)
        return np.where(np.max(np.abs(mean), axis=0) > NOISELESS * self.size, mean, 0.0)

    def spread(self, moments):
        """S: as given, or of largest likelihood."""
        if self.sigma is not None:
            return np.diag(self.sigma**2)
        floor = (ROUNDING * self.size) ** 2
        S = moments / self.n_rows
        if not self.correlated:
            return np.diag(np.maximum(np.diag(S), floor))
        return S + HALF * np.diag(np.diag(S)) + np.diag(floor)  # outputs may be equal

    def cost(self, moments):
        """Negative logarithm of the likelihood, with S at its own optimum."""
        L = linalg.cholesky(self.spread(moments), lower=True)
        left = linalg.solve_triangular(L, moments, lower=True)
        left = linalg.solve_triangular(L, left.T, lower=True)
        cost = self.n_rows * np.sum(np.log(np.sqrt(2.0 * np.pi) * np.diag(L)))
        return float(cost + 0.5 * np.trace(left))

    def at_rounding(self, point):
        return bool(np.all(point.rss <= self.n_rows * (NOISELESS * self.size) ** 2))

    def point(self, theta, x0):
        """Residuals at some parameters and initial states."""
        response = self.form.response(theta, sensitivities=False)
        with np.errstate(over="ignore", invalid="ignore"):
            left = [
                residuals(response, record, start)
                for record, start in zip(self.records, x0, strict=True)
            ]
            left = [
                self._about(each) if self._turns(record) else each
                for record, each in zip(self.records, left, strict=True)
            ]
            moments = sum(each.T @ each for each in left)
        cost = self.cost(moments) if np.all(np.isfinite(moments)) else np.inf
        if self.known is not None:
            cost += 0.5 * float(np.sum((self.known @ theta) ** 2))
        return Point(theta, x0, moments, cost, self.form.radius(response))

    def whitened(self, point, spread, only=None):
        """[∂ŷ/∂x0, ∂ŷ/∂θ, ŷ − y] times S^{-1/2}, piece by piece; of some parameters where told.

        Each piece comes as its segment, its first sample, and a block of shape
        (n_columns + 1, n_samples, l).
        """
        response = self.form.response(point.theta, sensitivities=only is None or len(only) > 0)
        if only is not None:
            response = _of_some(response, only)
        L = linalg.cholesky(spread, lower=True)
        root = linalg.solve_triangular(L, np.eye(len(L)), lower=True)
        for segment, (record, x0) in enumerate(zip(self.records, point.x0, strict=True)):
            pieces = output_sensitivities(response, record, x0)
            about = _AboutWaveform(self.form.n_phases) if self._turns(record) else None
            for start, _, dy in pieces:
                yield segment, start, (dy if about is None else about.rows(dy)) @ root.T

    def factors(self, point, spread, only=None):
        """Triangular factor of the whitened columns of each segment."""
        factors = [None] * len(self.records)
        for segment, _, block in self.whitened(point, spread, only):
            columns = block.reshape(len(block), -1)
            if factors[segment] is None:
                factors[segment] = np.zeros((len(block), len(block)))
            factors[segment] = updated_factor(factors[segment], columns)
        return factors

    def linearise(self, point, spread=None, only=None):
        """Least-squares system for a step from a point, of some parameters where told."""
        spread = self.spread(point.moments) if spread is None else spread
        system = eliminate_states(self.factors(point, spread, only), self.form.n_states)
        return system if self.known is None else system.beside(self.known_rows(point, only))

    def known_rows(self, point, only=None):
        """Rows of [J r] of what is known beforehand."""
        rows = self.known if only is None else self.known[:, only]
        return np.column_stack([rows, self.known @ point.theta])

    def with_best_inputs(self, point):
        """The same F and P with the G, Q and initial states of largest likelihood.

        Outputs are linear in these (Golub and Pereyra, 1973); S in turn with them.
        """
        linear = self.form.linear
        for _ in range(5):  # of S and inputs in turn
            system = self.linearise(point, only=linear)
            step, theta = system.step(0.0), point.theta.copy()
            theta[linear] += step
            x0 = point.x0 - [states @ np.append(step, 1.0) for states in system.states]
            trial = self.point(theta, x0)
            if not trial.cost < point.cost:
                break
            fall, point = point.cost - trial.cost, trial
            if not self.correlated or fall < WORTH_A_TURN * self.n_residuals:
                break
        return point


def _outputs_of(response, errors):
    """The periodic outputs of which a predictor makes errors of one turn, (n_phases, l)."""
    if response.gain is None:
        return errors
    n = response.n_states
    Phi, C, K = (
        [M[k % len(M)] for k in range(len(errors))]
        for M in (response.Psi[..., :n], response.Out[..., :n], response.gain)
    )
    moved = np.hstack([np.eye(n), np.zeros((n, 1))])  # states after a turn, of those at its start
    for A, gain, e in zip(Phi, K, errors, strict=True):
        moved = A @ moved
        moved[:, -1] += gain @ e
    x, outputs = linalg.solve(np.eye(n) - moved[:, :-1], moved[:, -1]), np.empty_like(errors)
    for k, e in enumerate(errors):
        outputs[k] = C[k] @ x + e
        x = Phi[k] @ x + K[k] @ e
    return outputs


def _of_some(response, places):
    """A response with the derivatives by some parameters alone."""
    if not len(places):
        return replace(response, dPsi=None, dOut=None, n_gain_harmonics=None)
    some = {"dPsi": response.dPsi[places], "dOut": response.dOut[places]}
    return replace(response, **some, n_gain_harmonics=None)


def updated_factor(factor, columns):
    """Triangular factor (c, c) with further rows: columns (c, n_rows) of the matrix."""
    block = min(32, len(factor))  # columns of a block of reflections
    rows = np.array(columns).T  # in the order that LAPACK reads
    R = linalg.lapack.dtpqrt(0, block, np.asfortranarray(factor), rows, overwrite_b=True)[0]
    return np.triu(R)


def eliminate_states(factors, n0):
    """The LinearSystem of whitened factors, the projection on the initial states taken out.

    Each segment has a factor (c, c), whose first ``n0`` columns are those of x0: n, or
    0.
    """
    width = factors[0].shape[1] - n0
    R, squares, states, promised = np.zeros((0, width)), np.zeros(width - 1), [], 0.0
    for each in factors:
        rest = each[:, n0:]
        squares += np.sum(rest[:, :-1] ** 2, axis=0)
        basis, inverse = _range(each[:, :n0])
        shares = np.zeros((basis.shape[1], width))
        for _ in range(2):  # the second time for the digits that the first one left
            share = basis.T @ rest
            rest, shares = rest - basis @ share, shares + share
        states.append(inverse @ shares)
        promised += shares[:, -1] @ shares[:, -1]
        R = linalg.qr(np.vstack([R, rest]), mode="r", check_finite=False)[0][:width]
    return LinearSystem(R, squares, states, float(promised))


def _range(matrix):
    """Orthonormal basis U of a matrix's range, and M⁺U."""
    size = column_sizes(matrix)
    left, singular, adjoint = linalg.svd(matrix / size, full_matrices=False)
    kept = singular > DEPENDENT
    return left[:, kept], adjoint[kept].T / singular[kept] / size[:, None]


def likelihood_problem(form, segments, sigma=None, correlated=False):
    """The problem of some segments (:func:`~.predictor.as_records`)."""
    sigma = None if sigma is None else np.asarray(sigma, dtype=float)
    return Problem(form, as_records(segments, form.n_outputs), sigma, correlated)


def is_white(left, lags):
    """Whether residuals (n_samples, l) look like white noise over some lags, each output by itself.

    With ρ_k the autocorrelation at lag k of n samples, n Σ ρ_k² has mean L and variance
    2 L over L lags of white noise (Box and Pierce, 1970); four spreads above the mean it
    is none.

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
