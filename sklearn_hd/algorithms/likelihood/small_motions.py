"""Small motions of a machine that is not linear, from records of large ones.

A linear model takes on what it can of the response's higher orders, and its exponents are off by
that. So products q of two states or inputs, then of three, become further inputs where they pay
(Akaike's criterion):

    x[k+1] = A(ψ_k) x + B(ψ_k) u + N(ψ_k) q + a(ψ_k) + K(ψ_k) e,    q = ∏ (z_i − z̄_i(ψ_k)) − q̄(ψ_k)

z being x and u. With q of the states that a model has predicted, that is linear. Products are
about the periodic means z̄ first. Large motions shift these, so in a last pass they are about the
orbit of a machine at rest, to which the same polynomial leads by Newton's steps:

    ∏ (z_i + d_i) = Σ_S ∏_{i ∈ S} z_i ∏_{i ∉ S} d_i        (S all parts of the product's factors)

A, B, C and D then are those of small motions about that orbit.

Exact outputs tell a predictor where the states are, whatever drives them: one-step predictions
then leave nothing for products to take up. Products of such a record are those of a simulation
(K = 0), if all together take up half of what it leaves.

The reading of samples (:mod:`sklearn_hd._identify.sample`) needs it.

Reference: J. Paduart et al., "Identification of nonlinear systems using polynomial nonlinear state
space models", Automatica 46 (2010), for time-invariant machines.
"""

from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement
from math import comb

import numpy as np

from sklearn_hd.algorithms.likelihood.innovations_steps import MOST_NUMBERS, fitted, most_likely
from sklearn_hd.algorithms.linalg.rounding import OVERFLOW
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.signals.fourier import fitted_harmonics, sampled_harmonics

LEAST_TAKEN_UP = 0.5  # of the variance that a simulation leaves: its rows are not independent
DEGREES = (2, 3)  # of products of states and inputs, by which a machine is not linear
NEWTON_STEPS = 4  # to the orbit at rest: each doubles the digits


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
    innovations, segments, layout, sensor_noise, most_growth, rest, degrees=None, gain=None
):
    """The linear part of a model to which products of states and inputs are further inputs.

    Parameters
    ----------
    innovations : PeriodicInnovations
        A model after steps of its likelihood.
    segments, layout, sensor_noise, most_growth
        As for :func:`~.innovations_steps.most_likely`.
    rest : ndarray, shape (2 L + 1, m)
        Inputs of a machine at rest, as Fourier coefficients.
    degrees : sequence of int, optional
        Of the products; those that pay by default, and only then smaller motions are asked, too.
    gain : ndarray, optional
        Of a predictor, for a model that simulates; the model's by default.

    Returns
    -------
    small : SmallMotions or None
        None where no products pay, or steps are not to be had.
    """
    n, m, L = innovations.n_states, innovations.n_inputs, layout.n_loads
    layout = replace(layout, n_input_harmonics=innovations.n_harmonics)
    per_input = (n + (layout.n_outputs if layout.feedthrough else 0)) * layout.n_functions
    n_values = sum(y.size for _, y, _ in segments)

    def stepped(model, driven, **options):
        wide = replace(layout, n_inputs=model.n_inputs)
        return most_likely(model, driven, wide, sensor_noise, most_growth, **options)

    def motion_of(model, driven):
        predictor = model if gain is None else _predicting(model, driven, gain, sensor_noise)
        return _motion(predictor, driven, m)

    model, ahead, products, driven = innovations, None, None, segments
    for degree in DEGREES if degrees is None else degrees:
        motion, more = motion_of(model, driven), comb(n + m + degree - 1, degree)
        if motion is None or more * per_input * n_values > MOST_NUMBERS:
            break
        taken = (degree,) if products is None else (*products.degrees, degree)
        wider = _Products.of(motion, taken, L)
        least = more * per_input if degrees is None else 0.0
        beside = wider.beside(segments, motion)
        found = stepped(_with_inputs(model, model.n_inputs, more), beside, least_fall=least)
        if found is not None:
            (model, ahead), products, driven = found, wider, beside
    if products is None:
        return None
    least = 1.0 - LEAST_TAKEN_UP if gain is not None and degrees is None else np.inf
    if _left(model, sensor_noise) > least * _left(innovations, sensor_noise):
        return None
    motion, smaller = motion_of(model, driven), None
    if motion is not None:
        about_rest = products.about_rest(model, motion, rest)
        if about_rest is not None:
            start, moved = about_rest
            beside = moved.beside(segments, motion)
            found = stepped(start, beside)
            if found is not None:
                (model, ahead), products, driven = found, moved, beside
        if degrees is None:
            smaller = stepped(model, driven, counted=_smaller_half(motion, products.centre))
    if gain is not None:
        model = _predicting(model, driven, gain, sensor_noise)
    linear = _with_inputs(model, m, 0)
    linear = _predicting(linear, segments, innovations.gain if gain is None else gain, sensor_noise)
    at_rest = _with_inputs(products.with_means(model), m, 0)
    gain = resize_harmonics(linear.gain, len(at_rest.coefficients) // 2)
    at_rest = replace(at_rest, gain=gain, covariance=linear.covariance)
    known = model.covariance, model.n_inputs, products.degrees
    return SmallMotions(linear, at_rest, ahead, None if smaller is None else smaller[1], *known)


@dataclass(frozen=True, eq=False)
class _Products:
    """Products of states and inputs, in like size and without their means: inputs beside others.

    Attributes
    ----------
    degrees : tuple of int
    which : list of tuple of int
        The factors of each product.
    centre : ndarray, shape (2 L + 1, n + m)
        z̄, Fourier coefficients of what states and inputs are counted from.
    size : ndarray, shape (k,)
        By which products are divided.
    means : ndarray, shape (2 L + 1, k)
        q̄, in that size.
    """

    degrees: tuple
    which: list
    centre: np.ndarray
    size: np.ndarray
    means: np.ndarray

    @classmethod
    def of(cls, motion, degrees, n_loads, centre=None, size=None):
        """Products of some degrees, about the means of the motion by default."""
        centre = fitted_harmonics(motion, n_loads) if centre is None else centre
        places = range(motion[0][0].shape[1])
        which = [w for d in degrees for w in combinations_with_replacement(places, d)]
        products = [(_values(which, centre, z, psi), psi) for z, psi in motion]
        means = fitted_harmonics(products, n_loads)
        if size is None:
            size = _sizes([q - evaluate_harmonics(means, psi) for q, psi in products])
        return cls(tuple(degrees), which, centre, size, means / size)

    def beside(self, segments, motion):
        """Segments whose inputs have the products of a motion beside them."""
        wider = []
        for (u, y, psi), (z, _) in zip(segments, motion, strict=True):
            q = _values(self.which, self.centre, z, psi) / self.size
            wider.append((np.hstack([u, q - evaluate_harmonics(self.means, psi)]), y, psi))
        return wider

    def with_means(self, model, sign=1.0):
        """The model of products with their means: its loads are those of a machine at rest."""
        n_inputs = model.n_inputs - len(self.which)
        means = np.hstack([np.zeros((len(self.means), n_inputs)), self.means])
        return model.about(sign * means, np.zeros((len(means), model.n_outputs)))

    def about_rest(self, model, motion, rest):
        """The same model with products about the orbit at rest, and these.

        None where that is not within the motion.
        """
        m, L = rest.shape[1], len(rest) // 2
        moved = self.with_means(model)
        for _ in range(NEWTON_STEPS):
            orbit = _with_inputs(moved, m, 0).forced_orbit(rest, L)
            centre = np.hstack([orbit, rest])
            if not self._reaches(centre, motion):
                return None
            moved = self._moved(model, centre)
        products = _Products.of(motion, self.degrees, L, centre, self.size)
        moved = products.with_means(moved, -1.0)
        H = model.n_harmonics
        whole = resize_harmonics(moved.coefficients, max(H, L))
        whole[2 * H + 1 :, :, :-1], whole[2 * L + 1 :, :, -1] = 0.0, 0.0
        gain = resize_harmonics(model.gain, max(H, L))
        return replace(model, coefficients=whole, gain=gain), products

    def _moved(self, model, centre):
        """The model of products about another centre, with their means."""
        model, n_signals = self.with_means(model), centre.shape[1]
        H = len(model.coefficients) // 2 + max(self.degrees) * (len(centre) // 2)
        psi = 2.0 * np.pi * np.arange(2 * H + 1) / (2 * H + 1)
        values = evaluate_harmonics(model.coefficients, psi)
        about, before = (evaluate_harmonics(each, psi) for each in (centre, self.centre))
        shift = about - before
        places = {(i,): (i, 1.0) for i in range(n_signals)} | {(): (-1, 1.0)}
        for k, (factors, size) in enumerate(zip(self.which, self.size, strict=True)):
            places[factors] = n_signals + k, size
        moved = values.copy()
        for factors in self.which:
            own, size = places[factors]
            column = values[..., own] / size
            for kept in range(len(factors)):
                for some in combinations(range(len(factors)), kept):
                    stays = tuple(factors[i] for i in some)
                    others = [f for i, f in enumerate(factors) if i not in some]
                    if stays not in places:  # products of a degree that is not taken
                        continue
                    at, its_size = places[stays]
                    part = column * np.prod(shift[:, others], axis=1)[:, None]
                    moved[..., at] += its_size * part
                    if kept == 1:  # of the whole state or input
                        moved[..., -1] -= part * about[:, stays]
        coefficients = sampled_harmonics(moved, H)
        return replace(model, coefficients=coefficients, gain=resize_harmonics(model.gain, H))

    def _reaches(self, centre, motion):
        """Whether the motion about the present centre goes as far as another one."""
        psi = np.linspace(0.0, 2.0 * np.pi, 4 * len(centre), endpoint=False)
        far = np.max(np.abs(evaluate_harmonics(centre - self.centre, psi)), axis=0)
        about = [z - evaluate_harmonics(self.centre, at) for z, at in motion]
        return bool(np.all(far <= np.max(np.abs(np.vstack(about)), axis=0)))


def _values(which, centre, z, psi):
    """Products of some factors of signals about their centre."""
    z = z - evaluate_harmonics(centre, psi)
    return np.column_stack([np.prod(z[:, list(factors)], axis=1) for factors in which])


def _predicting(innovations, segments, gain, sensor_noise):
    """A model with another gain and what it leaves, or as it is if that is less."""
    own = fitted(innovations, segments, sensor_noise)
    below = np.inf if own is None else own.cost
    at = fitted(replace(innovations, gain=gain), segments, sensor_noise, below=below)
    at = own if at is None else at
    return innovations if at is None else replace(at.innovations, covariance=at.covariance)


def _left(innovations, sensor_noise):
    """The variance that a model leaves of all outputs, beside that of their sensors."""
    return np.trace(innovations.covariance) + innovations.n_outputs * sensor_noise**2


def _motion(innovations, segments, m):
    """States that a model predicts and the first m inputs, beside ψ; None where they overflow."""
    motion = []
    for u, y, psi in segments:
        rows = innovations.rows(psi)
        x0 = rows.initial_state(u, y, innovations.covariance)
        motion.append((np.hstack([rows.innovations(u, y, x0)[0], u[:, :m]]), psi))
    finite = all(np.max(np.abs(z), initial=0.0) < OVERFLOW for z, _ in motion)
    return motion if finite else None


def _smaller_half(motion, centre):
    """Rows of each segment in which the motion about some centre is below its median."""
    about = [z - evaluate_harmonics(centre, psi) for z, psi in motion]
    size = _sizes(about)
    square = [np.sum((z / size) ** 2, axis=1) for z in about]
    median = np.median(np.concatenate(square))
    return [each <= median for each in square]


def _sizes(signals):
    """Root mean squares of signals over all segments; one where there is no motion."""
    size = np.sqrt(np.mean(np.vstack(signals) ** 2, axis=0))
    return np.where(size > 0.0, size, 1.0)


def _with_inputs(innovations, kept, more):
    """A model of its first inputs, and of more that have no effect."""
    M, n = innovations.coefficients, innovations.n_states
    without = np.zeros((*M.shape[:2], more))
    return replace(innovations, coefficients=np.dstack([M[..., : n + kept], without, M[..., -1:]]))
