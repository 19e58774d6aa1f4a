"""Steps of a periodic innovations model to the largest likelihood of a record.

    −log L = ½ N log det (Σ e eᵀ / N + σ² I) + const,   σ the least noise of a sensor

Regressions on a few lags lose what noise hides in them. Gauss-Newton steps in all Fourier
coefficients of A, B, C, D, K and the loads, damped while they do not pay (Levenberg, Marquardt),
bring it back. Coordinates are free: damping holds them. Initial states are fitted at each step.

A linear model of a machine that is not linear takes on what it can of the response's higher
orders, and its exponents are off by that. So products q of two states or inputs, then of three,
about their periodic means, become further inputs where they pay (Akaike's criterion):

    x[k+1] = A(ψ_k) x + B(ψ_k) u + N(ψ_k) q + a(ψ_k) + K(ψ_k) e

A, B, C and D then are those of small motions. With q of the states known before, that is linear.

Exact outputs tell a predictor where the states are, whatever drives them: one-step predictions
then leave nothing for products to take up. Products of such a record are those of a simulation
(K = 0), if all together take up half of what it leaves.

The reading of samples (:mod:`sklearn_hd._identify.sample`) needs it.

References: L. Ljung, *System Identification*, 1999, sections 7.4 and 10.2; J. Paduart et al.,
"Identification of nonlinear systems using polynomial nonlinear state space models", Automatica 46
(2010), for time-invariant machines.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from math import comb

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.likelihood.residual_tests import sensitivities
from sklearn_hd.algorithms.linalg.rounding import OVERFLOW, RANK
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.signals.fourier import fitted_harmonics, harmonic_functions

MOST_STEPS = 8  # of exact data, whose likelihood has no end
MOST_NUMBERS = 5e6  # sensitivities of a record: of more, each step takes a second
VALUES_PER_PARAMETER = 5  # below which a fit is largely noise
ENOUGH = 0.1  # fall of −log L, in all, below which parameters move within their deviations
FIRST_DAMPING = 1e-3  # of the largest eigenvalue of the information
DAMPING_LIMIT = 1e2
LEAST_TAKEN_UP = 0.5  # of the variance that a simulation leaves: its rows are not independent
DEGREES = (2, 3)  # of products of states and inputs, by which a machine is not linear


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
    innovations : PeriodicInnovations
        To start from.
    segments : list of (inputs, outputs, psi)
    layout : Layout
        Harmonics of the inputs' effect and of the loads, and whether D is free.
    sensor_noise : float
        σ.
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
        their standard deviations, √(σ²_real + σ²_imag). None where the record is so long, or the
        model so large, that steps would take long, where the record is too short for so many
        coefficients, where the predictor forgets nothing, and where steps are not worth it.
    """
    H = max(len(innovations.coefficients) // 2, layout.n_loads)
    coefficients = resize_harmonics(innovations.coefficients, H)
    innovations = replace(innovations, coefficients=coefficients)
    form = _Form.of(innovations, layout)
    counted = [slice(None)] * len(segments) if counted is None else counted
    n_values = sum(y[some].size for (_, y, _), some in zip(segments, counted, strict=True))
    n_free = len(form.places)
    if n_free * n_values > MOST_NUMBERS or n_values < VALUES_PER_PARAMETER * n_free:
        return None
    at = _fitted(innovations, segments, sensor_noise, counted)
    if at is None:
        return None
    damping, system, first = FIRST_DAMPING, form.system(at), at.cost
    if system.promised < least_fall:
        return None
    for _ in range(MOST_STEPS):
        trial = None
        while trial is None and damping < DAMPING_LIMIT and system.promised > ENOUGH:
            moved = form.moved(at.innovations, system.step(damping))
            with np.errstate(over="ignore", invalid="ignore"):  # of a step too far
                if moved.growth() < most_growth and moved.is_possible():
                    trial = _fitted(moved, segments, sensor_noise, counted, at.cost)
            damping *= 10.0 if trial is None else 0.1
        if trial is None:
            break
        fall, at = at.cost - trial.cost, trial
        system = form.system(at)
        if fall < ENOUGH:
            break
    if first - at.cost < least_fall:
        return None
    logarithms, slopes = form.slopes(at.innovations)
    deviations = at.left * np.sqrt(np.sum(np.abs(slopes @ system.root) ** 2, axis=1))
    ahead = logarithms + slopes @ system.step(damping)
    return replace(at.innovations, covariance=at.covariance), (ahead, deviations)


@dataclass(frozen=True, eq=False)
class SmallMotions:
    """The linear part of a model to which products of states and inputs are further inputs.

    Attributes
    ----------
    innovations : PeriodicInnovations
        K is that of the model without products, for which they are noise, or that of the
        simulation (0), whichever leaves less.
    at_rest : PeriodicInnovations
        The same with the loads of a machine at rest: those above hold the products' means, too.
    ahead, of_smaller : (ndarray, ndarray)
        Where a further step leads the logarithms of its multipliers, and their deviations. By all
        rows, and by the half of them with the smaller motion (None if they are too few).
    covariance : ndarray, shape (l, l)
        Of what products leave, too.
    n_inputs : int
        Inputs and products.
    degrees : tuple of int
        Of the products.
    """

    innovations: PeriodicInnovations
    at_rest: PeriodicInnovations
    ahead: tuple
    of_smaller: tuple | None
    covariance: np.ndarray
    n_inputs: int
    degrees: tuple


def of_small_motions(
    innovations, segments, layout, sensor_noise, most_growth, degrees=None, gain=None
):
    """The linear part of a model to which products of states and inputs are further inputs.

    Parameters
    ----------
    innovations : PeriodicInnovations
        A model after steps of its likelihood.
    segments, layout, sensor_noise, most_growth
        As for ``most_likely``.
    degrees : sequence of int, optional
        Of the products; those that pay by default, and only then smaller motions are asked, too.
    gain : ndarray, optional
        Of a predictor, for a model that simulates; the model's by default.

    Returns
    -------
    small : SmallMotions or None
        None where no products pay, or steps are not to be had.
    """
    n, m = innovations.n_states, innovations.n_inputs
    layout = replace(layout, n_input_harmonics=innovations.n_harmonics)
    per_input = (n + (layout.n_outputs if layout.feedthrough else 0)) * layout.n_functions
    n_values = sum(y.size for _, y, _ in segments)
    model, ahead, driven, taken = innovations, None, segments, ()
    means = np.zeros((2 * layout.n_loads + 1, m))
    for degree in DEGREES if degrees is None else degrees:
        predictor = model if gain is None else _predicting(model, driven, gain, sensor_noise)
        motion = _motion(predictor, driven, m, layout.n_loads)
        if motion is None or comb(n + m + degree - 1, degree) * per_input * n_values > MOST_NUMBERS:
            break
        wider, its_means = _with_products(driven, motion, layout.n_loads, degree)
        n_inputs = wider[0][0].shape[1]
        more = n_inputs - model.n_inputs
        found = most_likely(
            _with_inputs(model, model.n_inputs, more),
            wider,
            replace(layout, n_inputs=n_inputs),
            sensor_noise,
            most_growth,
            least_fall=more * per_input if degrees is None else 0.0,
        )
        if found is not None:
            (model, ahead), driven, taken = found, wider, (*taken, degree)
            means = np.hstack([means, its_means])
    if ahead is None:
        return None
    least = 1.0 - LEAST_TAKEN_UP if gain is not None and degrees is None else np.inf
    if _left(model, sensor_noise) > least * _left(innovations, sensor_noise):
        return None
    smaller = None
    if degrees is None and motion is not None:
        smaller = most_likely(
            model,
            driven,
            replace(layout, n_inputs=model.n_inputs),
            sensor_noise,
            most_growth,
            counted=_smaller_half(motion),
        )
    if gain is not None:
        model = _predicting(model, driven, gain, sensor_noise)
    linear = _with_inputs(model, m, 0)
    linear = _predicting(linear, segments, innovations.gain if gain is None else gain, sensor_noise)
    at_rest = _with_inputs(model.about(means, np.zeros((len(means), layout.n_outputs))), m, 0)
    gain = resize_harmonics(linear.gain, len(at_rest.coefficients) // 2)
    at_rest = replace(at_rest, gain=gain, covariance=linear.covariance)
    of_smaller = None if smaller is None else smaller[1]
    return SmallMotions(linear, at_rest, ahead, of_smaller, model.covariance, model.n_inputs, taken)


def _predicting(innovations, segments, gain, sensor_noise):
    """A model with another gain and what it leaves, or as it is if that is less."""
    everything = [slice(None)] * len(segments)
    own = _fitted(innovations, segments, sensor_noise, everything)
    below = np.inf if own is None else own.cost
    at = _fitted(replace(innovations, gain=gain), segments, sensor_noise, everything, below)
    at = own if at is None else at
    return innovations if at is None else replace(at.innovations, covariance=at.covariance)


def _left(innovations, sensor_noise):
    """The variance that a model leaves of all outputs, beside that of their sensors."""
    return np.trace(innovations.covariance) + innovations.n_outputs * sensor_noise**2


def _motion(innovations, segments, m, n_loads):
    """States that a model predicts and the first m inputs about their periodic means, beside ψ.

    None where they overflow.
    """
    motion = []
    for u, y, psi in segments:
        rows = innovations.rows(psi)
        x0 = rows.initial_state(u, y, innovations.covariance)
        motion.append((np.hstack([rows.innovations(u, y, x0)[0], u[:, :m]]), psi))
    finite = all(np.max(np.abs(z), initial=0.0) < OVERFLOW for z, _ in motion)
    return _about_means(motion, n_loads) if finite else None


def _with_products(segments, motion, n_loads, degree):
    """Segments whose inputs have all products of so many signals of their motion beside them.

    Returns
    -------
    segments : list of (inputs, outputs, psi)
        Products are about their periodic means, and of like size.
    means : ndarray, shape (2 L + 1, n_products)
        What was taken out of them, as Fourier coefficients.
    """
    which = np.array(list(combinations_with_replacement(range(motion[0][0].shape[1]), degree)))
    products = [(np.prod(z[:, which], axis=2), psi) for z, psi in motion]
    means = fitted_harmonics(products, n_loads)
    products = [q - evaluate_harmonics(means, psi) for q, psi in products]
    size = _sizes(products)
    both = zip(segments, products, strict=True)
    return [(np.hstack([u, q / size]), y, psi) for (u, y, psi), q in both], means / size


def _smaller_half(motion):
    """Rows of each segment in which the motion is below its median."""
    size = _sizes([z for z, _ in motion])
    square = [np.sum((z / size) ** 2, axis=1) for z, _ in motion]
    median = np.median(np.concatenate(square))
    return [each <= median for each in square]


def _sizes(signals):
    """Root mean squares of signals over all segments; one where there is no motion."""
    size = np.sqrt(np.mean(np.vstack(signals) ** 2, axis=0))
    return np.where(size > 0.0, size, 1.0)


def _about_means(signals, n_harmonics):
    """Signals of all segments without their periodic means."""
    means = fitted_harmonics(signals, n_harmonics)
    return [(z - evaluate_harmonics(means, psi), psi) for z, psi in signals]


def _with_inputs(innovations, kept, more):
    """A model of its first inputs, and of more that have no effect."""
    M, n = innovations.coefficients, innovations.n_states
    without = np.zeros((*M.shape[:2], more))
    return replace(innovations, coefficients=np.dstack([M[..., : n + kept], without, M[..., -1:]]))


@dataclass(frozen=True, eq=False)
class _Form:
    """Which coefficients of a model are free.

    Attributes
    ----------
    n_harmonics, n_loads : int
    feedthrough : bool
    places : ndarray of int, shape (k,)
        Of the free ones, in [A B a; C D c] and then K, flattened.
    kept : ndarray of bool
        Which sensitivities are theirs.
    of_states : ndarray of int, shape (2 H + 1, n, n)
        Places of A.
    """

    n_harmonics: int
    n_loads: int
    feedthrough: bool
    places: np.ndarray
    kept: np.ndarray
    of_states: np.ndarray

    @classmethod
    def of(cls, innovations, layout):
        own, H, L = innovations, innovations.n_harmonics, layout.n_loads
        n, size = own.n_states, own.coefficients.size
        place, gain = np.arange(size).reshape(own.coefficients.shape), np.zeros(0, dtype=int)
        if own.gain.any():
            gain = size + np.arange(own.gain.size).reshape(own.gain.shape)
        places, kept = [], []
        for h in range(2 * H + 1):
            driven = place[h, :n, :-1]
            moved = np.hstack([driven, gain[h]]) if own.gain.any() else driven
            seen = place[h, n:, : -1 if layout.feedthrough else n]
            places += [moved.ravel(), seen.ravel()]
            for block in (moved, seen):
                free = np.ones(block.shape, dtype=bool)
                free[:, n : n + own.n_inputs] = h <= 2 * layout.n_input_harmonics
                kept.append(free.ravel())
        loads = place[: 2 * L + 1, :, -1].T
        places += [loads[:n].ravel(), loads[n:].ravel()]
        kept.append(np.ones(loads.size, dtype=bool))
        places, kept = np.concatenate(places), np.concatenate(kept)
        return cls(H, L, layout.feedthrough, places[kept], kept, place[: 2 * H + 1, :n, :n])

    def system(self, at):
        """Normal equations of a step, initial states eliminated."""
        W, k = at.weights, len(self.places)
        gram, slope = np.zeros((k, k)), np.zeros(k)
        for (rows, u, x, e, psi), some in zip(at.parts, at.counted, strict=True):
            functions = harmonic_functions(psi, range(self.n_harmonics + 1))
            loads = harmonic_functions(psi, range(self.n_loads + 1))
            J = sensitivities(rows, u, x, e, functions, loads, feedthrough=self.feedthrough)
            J, free, left = J[some][..., self.kept], rows.started()[some], e[some]
            J, free = ((W @ each).reshape(left.size, each.shape[-1]) for each in (J, free))
            start = linalg.qr(free, mode="economic")[0]
            J, left = J - start @ (start.T @ J), (left @ W.T).ravel()
            gram, slope = gram + J.T @ J, slope + J.T @ left
        return _System.of(gram, slope)

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


@dataclass(frozen=True, eq=False)
class _System:
    """Normal equations in parameters of like size, by the eigenvectors of their matrix.

    Attributes
    ----------
    values, vectors : ndarray
    slope : ndarray, shape (k,)
        Of the likelihood, along the eigenvectors.
    size : ndarray, shape (k,)
        By which parameters were multiplied.
    """

    values: np.ndarray
    vectors: np.ndarray
    slope: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, gram, slope):
        size = np.sqrt(np.diag(gram))
        size = np.where(size > 0.0, size, np.inf)
        values, vectors = linalg.eigh(gram / size / size[:, None])
        return cls(np.maximum(values, 0.0), vectors, vectors.T @ (slope / size), size)

    @property
    def known(self):
        """Directions that are no change of coordinates alone."""
        return self.values > RANK * self.values[-1]

    @cached_property
    def promised(self):
        """Fall of −log L that a whole step would bring if residuals were linear."""
        return 0.5 * float(np.sum(self.slope[self.known] ** 2 / self.values[self.known]))

    @cached_property
    def root(self):
        """Of the parameters' covariance, root rootᵀ."""
        return self.vectors[:, self.known] / np.sqrt(self.values[self.known]) / self.size[:, None]

    def step(self, damping):
        """A step, damped by some part of the largest eigenvalue."""
        return self.vectors @ (self.slope / (self.values + damping * self.values[-1])) / self.size


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A model, what it leaves of each segment, and the cost of that.

    Attributes
    ----------
    innovations : PeriodicInnovations
    parts : list of (rows, inputs, states, residuals, psi)
    counted : list of slice, or of ndarray of bool
        Which rows of them count.
    covariance, weights : ndarray, shape (l, l)
        Of the residuals, and what makes them white beside the least noise.
    cost : float
        −log L.
    """

    innovations: PeriodicInnovations
    parts: list
    counted: list
    covariance: np.ndarray
    weights: np.ndarray
    cost: float

    @property
    def left(self):
        """Size of the residuals, weighted: below one where they are less than a sensor's noise."""
        weighted = self.weights @ self.covariance @ self.weights.T
        return float(np.sqrt(np.trace(weighted) / len(weighted)))


def _fitted(innovations, segments, sensor_noise, counted, below=np.inf):
    """A model with the initial states that fit best; None if it does not cost less."""
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
    if not np.isfinite(left).all():
        return None
    covariance = left.T @ left / len(left)
    floor = covariance + sensor_noise**2 * np.eye(len(covariance))
    root = linalg.cholesky(floor, lower=True)
    cost = len(left) * float(np.sum(np.log(np.diag(root))))
    if not cost < below:
        return None
    return _Fitted(innovations, parts, counted, covariance, linalg.inv(root), cost)
