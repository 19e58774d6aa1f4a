"""Steps of a periodic innovations model to the largest likelihood of a record.

    −log L = ½ N log det (Σ e eᵀ / N + σ² I) + const,   σ the least noise of a sensor

Regressions on a few lags lose what noise hides in them. Gauss-Newton steps in all Fourier
coefficients of A, B, C, D, K and the loads, damped while they do not pay (Levenberg, Marquardt),
bring it back. Coordinates are free: damping holds them. Initial states are fitted at each step.
The gradient is that of all rows; of long records, some rows tell the second derivatives.

The reading of samples (:mod:`sklearn_hd._identify.sample`) needs it.

Reference: L. Ljung, *System Identification*, 1999, sections 7.4 and 10.2.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg
from scipy.sparse.linalg import eigsh
from scipy.stats import chi2, norm

from sklearn_hd.algorithms.likelihood.predictor import (
    regressors_of,
    sensitivity_pieces,
    sensitivity_sums,
)
from sklearn_hd.algorithms.linalg.rounding import OVERFLOW, RANK
from sklearn_hd.algorithms.periodic.harmonic_balance import resize_harmonics
from sklearn_hd.algorithms.periodic.multipliers import LASTING, LEAST_RATE
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.signals.fourier import ROWS_PER_COLUMN, harmonic_functions

FEW_STEPS = 8  # of exact data, whose likelihood has no end, if exponents rest
MOST_STEPS = 40  # if they do not
STILL = 0.01  # of a rate, that a step moves no exponent by
# sensitivities that second derivatives are made of: they take half a second, and are five values of
# the outputs for each of 1400 coefficients
MOST_NUMBERS = 1e7
PIECE = 2.5e5  # of them at once: what a processor keeps at hand
ENOUGH = 0.1  # fall of −log L, in all, below which parameters move within their deviations
FIRST_DAMPING = 1e-3  # of the largest eigenvalue of the information
DAMPING_LIMIT = 1e2


def most_likely(
    innovations,
    segments,
    layout,
    sensor_noise,
    most_growth=np.inf,
    *,
    least_fall=0.0,
    counted=None,
):
    """A model after steps of its likelihood, as many as pay.

    Parameters
    ----------
    segments : list of (inputs, outputs, psi)
    layout : Layout
        Harmonics of the inputs' effect and of the loads, and whether D is free. Of inputs beyond
        those that it counts, the effect is a constant one.
    most_growth : float
        Of a simulation, e-folds a sample: no step leads beyond it, nor to multipliers that no
        periodic system has.
    least_fall : float
        Of −log L, in all, for which steps are worth it.
    counted : list of ndarray of bool, optional
        Which rows of each segment count; all by default.

    Returns
    -------
    found : PeriodicInnovations, (ndarray, ndarray)
        The model; the logarithms of its multipliers to which a further step would lead, and
        their standard deviations, √(σ²_real + σ²_imag). None where the record is too short for
        so many coefficients, or these are too many for steps, where the predictor forgets nothing,
        and where steps are not worth it.
    """
    if not is_told(innovations, segments, layout, counted):
        return None
    innovations = _with_loads(innovations, layout)
    form = _Form.of(innovations, layout)
    counted, n_free = _counted(segments, counted), len(form.places)
    if MOST_NUMBERS / n_free < ROWS_PER_COLUMN * n_free:  # too few for second derivatives
        return None
    told = list(_telling(segments, counted, int(MOST_NUMBERS / n_free / layout.n_outputs)))
    at = fitted(innovations, segments, sensor_noise, counted)
    if at is None:
        return None
    damping, system, first = FIRST_DAMPING, form.system(at, told), at.cost
    if system.promised < least_fall:
        return None
    for n_steps in range(MOST_STEPS):
        if n_steps >= FEW_STEPS and form.rests(at, system, damping):
            break
        trial = None
        while trial is None and damping < DAMPING_LIMIT and system.promised > ENOUGH:
            moved = form.moved(at.innovations, system.step(damping))
            with np.errstate(over="ignore", invalid="ignore"):  # of a step too far
                if moved.growth() < most_growth and moved.is_possible():
                    trial = fitted(moved, segments, sensor_noise, counted, at.cost)
            damping *= 10.0 if trial is None else 0.1
        if trial is None:
            break
        fall, at = at.cost - trial.cost, trial
        system = form.system(at, told)
        if fall < ENOUGH:
            break
    if first - at.cost < least_fall:
        return None
    _, *ahead = form.ahead(at, system, damping)
    return replace(at.innovations, covariance=at.covariance), tuple(ahead)


@dataclass(frozen=True, eq=False)
class NextStep:
    """What another whole step of a likelihood would do beside further inputs."""

    # standard deviations of a normal variable by which the slopes of −log L by their effect, in
    # which residuals are linear, are beyond what noise explains
    beyond: float
    ahead: tuple  # (ndarray, ndarray): as :func:`most_likely` has it, of a step in all coefficients
    # of PeriodicInnovations: the model after a step of the loads and of that effect alone, and a
    # standard deviation beside it in each direction in which these are known
    of_loads: list


def next_step(innovations, segments, layout, sensor_noise, n_inputs):
    """Another whole step beside inputs further than so many, not taken.

    Other arguments are as for :func:`most_likely`. It is None where the predictor
    forgets nothing.
    """
    innovations = _with_loads(innovations, layout)
    form = _Form.of(innovations, layout)
    at = fitted(innovations, segments, sensor_noise)
    if at is None:
        return None
    n_rows = int(2.0 * MOST_NUMBERS / len(form.places) / layout.n_outputs)  # once, not each step
    system = form.system(at, list(_telling(segments, at.counted, n_rows)))
    beyond = system.beyond_noise(form.driven_beyond(innovations, n_inputs))
    step, root = system.alone(form.driven_beyond(innovations, n_inputs, loads=True))
    of_loads = [form.moved(innovations, each) for each in (step, *at.left * root.T)]
    return NextStep(beyond, form.ahead(at, system, RANK)[1:], of_loads)


def is_told(innovations, segments, layout, counted=None):
    """Whether the rows are enough for all coefficients; arguments as for :func:`most_likely`."""
    rows = zip(segments, _counted(segments, counted), strict=True)
    n_values = sum(y[some].size for (_, y, _), some in rows)
    form = _Form.of(_with_loads(innovations, layout), layout)
    return n_values >= ROWS_PER_COLUMN * len(form.places)


def _with_loads(innovations, layout):
    """A model with as many harmonics as its loads have, if these are more."""
    H = max(len(innovations.coefficients) // 2, layout.n_loads)
    return replace(innovations, coefficients=resize_harmonics(innovations.coefficients, H))


def _counted(segments, counted):
    """Rows of each segment that count: all by default."""
    return [slice(None)] * len(segments) if counted is None else counted


def _telling(segments, counted, n_rows):
    """Rows of each segment in the stretch of so many rows of which those that count move most."""
    squares = [np.zeros(len(y)) for _, y, _ in segments]
    for own, (_, y, _), some in zip(squares, segments, counted, strict=True):
        own[some] = np.sum(y[some] ** 2, axis=1)
    motion = np.cumsum(np.concatenate([[0.0], *squares]))
    n_rows = min(n_rows, len(motion) - 1)
    first, end = int(np.argmax(motion[n_rows:] - motion[: len(motion) - n_rows])), 0
    for own in squares:
        start, end = end, end + len(own)
        yield slice(*np.clip([first - start, first + n_rows - start], 0, len(own)))


@dataclass(frozen=True, eq=False)
class _Form:
    """Which coefficients of a model are free."""

    n_harmonics: int
    n_loads: int
    feedthrough: bool
    n_inputs: list  # of int: for 1, cos ψ, sin ψ, …: of how many inputs the effect is free
    places: np.ndarray  # int, (k,): of the free ones, in [A B a; C D c] and then K, flattened
    of_states: np.ndarray  # int, (2 H + 1, n, n): places of A

    @classmethod
    def of(cls, innovations, layout):
        own, H, L = innovations, innovations.n_harmonics, layout.n_loads
        n, size = own.n_states, own.coefficients.size
        place, gain = np.arange(size).reshape(own.coefficients.shape), np.zeros(0, dtype=int)
        if own.gain.any():
            gain = size + np.arange(own.gain.size).reshape(own.gain.shape)
        turning = 2 * min(H, layout.n_input_harmonics)
        n_inputs = [own.n_inputs, *turning * [layout.n_inputs], *(2 * H - turning) * [0]]
        places = []
        for h, count in enumerate(n_inputs):
            driven = place[h, :n, : n + count]
            moved = np.hstack([driven, gain[h]]) if own.gain.any() else driven
            seen = place[h, n:, : n + count if layout.feedthrough else n]
            places += [moved.ravel(), seen.ravel()]
        loads = place[: 2 * L + 1, :, -1].T
        places = np.concatenate([*places, loads.ravel()])
        return cls(H, L, layout.feedthrough, n_inputs, places, place[: 2 * H + 1, :n, :n])

    def driven_beyond(self, innovations, n_inputs, loads=False):
        """Which of the free coefficients are effects of inputs further than so many, or loads."""
        further = np.zeros(innovations.coefficients.shape, dtype=bool)
        further[:, :, innovations.n_states + n_inputs : -1] = True
        further[:, :, -1] = loads
        return np.append(further, np.zeros(innovations.gain.shape, dtype=bool))[self.places]

    def ahead(self, at, system, damping):
        """Logarithms of multipliers, where another step leads them, and their deviations."""
        logarithms, slopes = self.slopes(at.innovations)
        deviations = at.left * np.sqrt(np.sum(np.abs(slopes @ system.root) ** 2, axis=1))
        return logarithms, logarithms + slopes @ system.step(damping), deviations

    def rests(self, at, system, damping):
        """Whether another step moves no mode that lasts by more than it may be off."""
        logarithms, ahead, deviations = self.ahead(at, system, damping)
        lasting = logarithms.real > np.log(LASTING)
        size = STILL * np.maximum(np.abs(logarithms.real), LEAST_RATE)
        size = np.maximum(size, deviations)
        return bool(np.all(np.abs(ahead - logarithms)[lasting] <= size[lasting]))

    def system(self, at, told):
        """Normal equations of a step, initial states eliminated.

        Second derivatives come from the rows told, a slice of each segment. They are
        scaled to all rows by the squares of the regressors.
        """
        slope, size, whole, k = 0.0, 0.0, 0.0, len(self.places)
        gram = np.zeros((k, k), order="F")
        free = {"feedthrough": self.feedthrough, "n_inputs": self.n_inputs}
        orders = range(self.n_harmonics + 1), range(self.n_loads + 1)
        for (rows, u, x, e, psi), some, own in zip(at.parts, at.counted, told, strict=True):
            counts = np.zeros(len(e), dtype=bool)
            counts[some] = True
            functions = (harmonic_functions(psi, each) for each in orders)
            pairs = regressors_of(rows, u, x, e, *functions, **free)
            slope = slope + self._slope(at.weights, rows, pairs, counts, e)
            whole = whole + self._squares(rows, pairs, counts)
            if own.stop > own.start:
                pairs = [(drives[own], direct[own]) for drives, direct in pairs]
                part = rows.some(own), pairs, counts[own]
                size = size + self._squares(*part)
                gram = self._with_information(gram, at.weights, *part)
        size = np.sqrt(np.where(size > 0.0, whole / np.where(size > 0.0, size, 1.0), 1.0))
        return _System.of(gram * size * size[:, None], slope)

    def _squares(self, rows, pairs, counts):
        """Sums of squares of what the free coefficients are multiplied by."""
        n, n_outputs = rows.n_states, rows.outputs.shape[1]
        each = [
            np.tile(np.sum(regressors[counts] ** 2, axis=0), copies)
            for pair in pairs
            for regressors, copies in zip(pair, (n, n_outputs), strict=True)
        ]
        return np.concatenate(each)

    def _slope(self, W, rows, pairs, counts, e):
        """Of the likelihood, by the free coefficients."""
        start = _started(W, rows, counts)
        left = np.where(counts[:, None], e @ W.T, 0.0).ravel()
        left = (left - start @ (start.T @ left)).reshape(e.shape)
        return sensitivity_sums(rows, pairs, left @ W)

    def _with_information(self, gram, W, rows, pairs, counts):
        """Adds products of the sensitivities to the free coefficients: the lower triangle."""
        start, k, inside = _started(W, rows, counts), len(self.places), 0.0
        start = start.reshape(len(counts), len(W), start.shape[1])
        for piece, J in sensitivity_pieces(rows, pairs, max(int(PIECE / k / len(W)), 1), W):
            J[~counts[piece]] = 0.0
            J, free = (z.reshape(-1, z.shape[-1]) for z in (J, start[piece]))
            gram = linalg.blas.dsyrk(1.0, J.T, 1.0, gram, lower=1, overwrite_c=1)
            inside = inside + free.T @ J
        return linalg.blas.dsyrk(-1.0, inside.T, 1.0, gram, lower=1, overwrite_c=1)

    def moved(self, innovations, step):
        """The model a step further."""
        coefficients, gain = innovations.coefficients.ravel(), innovations.gain.ravel()
        values = np.concatenate([coefficients, gain])
        values[self.places] += step
        parts = np.split(values, [coefficients.size])
        shapes = innovations.coefficients.shape, innovations.gain.shape
        coefficients, gain = (v.reshape(shape) for v, shape in zip(parts, shapes, strict=True))
        return replace(innovations, coefficients=coefficients, gain=gain)

    def slopes(self, innovations):
        """Logarithms of the multipliers, and their slopes by the free coefficients."""
        logarithms, psi, by_steps = innovations.multiplier_slopes()
        functions = harmonic_functions(psi, range(self.n_harmonics + 1))
        size = innovations.coefficients.size + innovations.gain.size
        slopes = np.zeros((len(logarithms), size), dtype=complex)
        slopes[:, self.of_states] = np.einsum("tf,ktij->kfij", functions, by_steps)
        return logarithms, slopes[:, self.places]


def _started(W, rows, counts):
    """Orthonormal columns of what an initial state adds to weighted outputs of rows that count."""
    free = W @ rows.started()
    free[~counts] = 0.0
    return linalg.qr(free.reshape(-1, rows.n_states), mode="economic")[0]


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations in parameters of like size."""

    gram: np.ndarray  # (k, k): of ones on the diagonal
    slope: np.ndarray  # (k,): of the likelihood
    size: np.ndarray  # (k,): by which parameters were multiplied

    @classmethod
    def of(cls, gram, slope):
        """Of a matrix of which the lower triangle is read."""
        size = np.sqrt(np.maximum(np.diag(gram), 0.0))
        size = np.where(size > 0.0, size, np.inf)
        gram = np.tril(np.asarray_chkfinite(gram) / size / size[:, None])
        return cls(gram + np.tril(gram, -1).T, slope / size, size)

    @cached_property
    def largest(self):
        """The largest eigenvalue."""
        start = np.ones(len(self.gram))
        return float(eigsh(self.gram, 1, v0=start, tol=1e-3, return_eigenvectors=False)[0])

    @cached_property
    def eigen(self):
        """Eigenvalues, none below zero, and eigenvectors: they take ten times as long as a step."""
        values, vectors = linalg.eigh(self.gram, driver="evd")
        return np.maximum(values, 0.0), vectors

    @cached_property
    def root(self):
        """Of the parameters' covariance, root rootᵀ, but for changes of coordinates alone."""
        values, vectors = self.eigen
        known = values > RANK * values[-1]
        return vectors[:, known] / np.sqrt(values[known]) / self.size[:, None]

    @cached_property
    def promised(self):
        """Fall of −log L that a whole step would bring if residuals were linear."""
        return 0.5 * float(self.slope @ self._solved(RANK))

    def step(self, damping):
        """A step, damped by some part of the largest eigenvalue."""
        return self._solved(damping) / self.size

    def _solved(self, damping):
        damped = self.gram + damping * self.largest * np.eye(len(self.gram))
        try:
            return linalg.cho_solve(linalg.cho_factor(damped, lower=True), self.slope)
        except linalg.LinAlgError:  # of rounding, an eigenvalue is below zero
            values, vectors = self.eigen
            return vectors @ (vectors.T @ self.slope / (values + damping * self.largest))

    def alone(self, some):
        """A step in some parameters, the others held, and a root of their covariance then."""
        own = self._part(some)
        step, root = np.zeros(len(some)), np.zeros((len(some), own.root.shape[1]))
        step[some], root[some] = own.step(RANK), own.root
        return step / self.size, root / self.size[:, None]

    def _part(self, some):
        return _System.of(self.gram[np.ix_(some, some)], self.slope[some])

    def beyond_noise(self, some):
        """Normal deviations by which slopes by some parameters are beyond those of noise.

        Of their slopes g where the others are the most likely ones (Rao, 1948):

            g = g_s − J_so J_oo⁻¹ g_o,   cov g = J_ss − J_so J_oo⁻¹ J_os

        gᵀ J_ss⁻¹ g then is a sum of χ², here one of the same mean and variance (Satterthwaite,
        1946). Of a step in all parameters more is promised than kept where the others are poorly
        known. −∞ where the others tell all.
        """
        own, others = (self._part(rows).root for rows in (some, ~some))
        shared = own.T @ self.gram[np.ix_(some, ~some)] @ others
        values, V = linalg.eigh(np.eye(len(shared)) - shared @ shared.T)
        values, V = values[values > np.sqrt(RANK)], V[:, values > np.sqrt(RANK)]
        if not len(values):
            return -np.inf
        g = V.T @ (own.T @ self.slope[some] - shared @ (others.T @ self.slope[~some]))
        size = np.sum(values**2) / np.sum(values)
        return float(norm.isf(chi2.sf(np.sum(g**2) / size, np.sum(values) / size)))


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A model, what it leaves of each segment, and the cost of that."""

    innovations: PeriodicInnovations
    parts: list  # of (rows, inputs, states, residuals, psi)
    counted: list  # of slice, or of ndarray of bool: which rows of them count
    covariance: np.ndarray  # (l, l): of the residuals
    weights: np.ndarray  # (l, l): what makes them white beside the least noise
    cost: float  # −log L

    @property
    def left(self):
        """Size of the residuals, weighted: below one where they are less than a sensor's noise."""
        weighted = self.weights @ self.covariance @ self.weights.T
        return float(np.sqrt(np.trace(weighted) / len(weighted)))


def fitted(innovations, segments, sensor_noise, counted=None, below=np.inf):
    """A model with the initial states that fit best; None if it does not cost less.

    Takes the arguments of ``most_likely``, and gives what it leaves, weights and cost.
    """
    counted = [slice(None)] * len(segments) if counted is None else counted
    parts, outputs = [], np.vstack([y for _, y, _ in segments])
    size = np.diag(np.mean(outputs**2, axis=0))
    for u, y, psi in segments:
        rows = innovations.rows(psi)
        free, half = np.abs(rows.started()), len(psi) // 2
        if half and not np.max(free[half:]) <= np.max(free[:half]):
            return None  # no predictor that forgets
        x, e = rows.innovations(u, y, rows.initial_state(u, y, size))
        parts.append((rows, u, x, e, psi))
    left = np.vstack([e[some] for (_, _, _, e, _), some in zip(parts, counted, strict=True)])
    if not np.max(np.abs(left), initial=0.0) < OVERFLOW:
        return None
    covariance = left.T @ left / len(left)
    floor = covariance + sensor_noise**2 * np.eye(len(covariance))
    try:
        root = linalg.cholesky(floor, lower=True)
    except linalg.LinAlgError:  # of a step so far that rounding hides the least noise
        return None
    cost = len(left) * float(np.sum(np.log(np.diag(root))))
    if not cost < below:
        return None
    return _Fitted(innovations, parts, counted, covariance, linalg.inv(root), cost)
