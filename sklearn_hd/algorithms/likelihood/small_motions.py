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

Products of degrees that did not pay, or are too many for steps, may have bent the exponents all
the same: where one step beside them would lead is another opinion.

The reading of samples (:mod:`sklearn_hd._identify.sample`) needs it.

Reference: J. Paduart et al., "Identification of nonlinear systems using polynomial nonlinear state
space models", Automatica 46 (2010), for time-invariant machines.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, combinations, combinations_with_replacement
from math import comb

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.likelihood.innovations_steps import (
    fitted,
    is_told,
    most_likely,
    next_step,
)
from sklearn_hd.algorithms.linalg.rounding import OVERFLOW
from sklearn_hd.algorithms.linalg.triangular import column_rms
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_predictor import Layout
from sklearn_hd.algorithms.signals.fourier import (
    fitted_harmonics,
    harmonic_functions,
    mean_square,
    sampled_harmonics,
    times,
)

LEAST_TAKEN_UP = 0.5  # of the variance that a simulation leaves: its rows are not independent
DEGREES = (2, 3)  # of products of states and inputs, by which a machine is not linear
SETTLED = 1e-3  # of the motion: by no more may the last of them move
REACHED = 0.99  # of the rows, the motion in which counts as its reach
MOST_NUMBERS = 5e6  # sensitivities to products' coefficients: with more, steps take long
LEAST_OF_ITS_OWN = 0.05  # of a product's mean square, which states, inputs, means do not explain
AS_LITTLE = 1.1  # times what another model leaves: no more


@dataclass(frozen=True, eq=False)
class SmallMotions:
    """The linear part of a model to which products of states and inputs are further inputs."""

    # K is that of the model without products, for which they are noise, or that of the simulation
    # (0), whichever leaves less
    innovations: PeriodicInnovations
    # the same with the loads of a machine at rest: those above hold the products' means, too. Where
    # ``about_rest`` is false, as far as the linear part leads from the mean motion.
    at_rest: PeriodicInnovations
    # (ndarray, ndarray): where a further step leads the logarithms of its multipliers, and their
    # deviations
    ahead: tuple
    # the same by the half of the rows with the smaller motion; None if they are too few
    of_smaller: tuple | None
    # whether all this is about the orbit of a machine at rest, or about the mean motion
    about_rest: bool


@dataclass(frozen=True, eq=False)
class LargeMotions:
    """A model to which products of states and inputs are further inputs."""

    linear: PeriodicInnovations  # without products
    # with products, whose states are those that ``linear`` (then ``model`` of fewer degrees)
    # predicts
    model: PeriodicInnovations
    ahead: tuple | None  # (ndarray, ndarray): as :func:`~.innovations_steps.most_likely` has it
    products: "_Products | None"
    segments: list  # of (inputs, outputs, psi): without products among the inputs
    driven: list  # of (inputs, outputs, psi): with them
    layout: Layout  # of the model without them, whose inputs' effect turns with ψ
    turning: bool  # whether the effect of products does, too; else it is a constant one
    sensor_noise: float  # as for :func:`~.innovations_steps.most_likely`
    most_growth: float  # the same
    gain: np.ndarray | None  # of a predictor, for a model that simulates
    asked: bool  # whether the degrees were given

    @classmethod
    def without(
        cls, innovations, segments, layout, sensor_noise, most_growth, gain=None, asked=False
    ):
        """No products yet; arguments as for :meth:`of`.

        Their effect will turn with ψ as B does; of a record too short for squares of that kind, it
        is a constant one.
        """
        n, m = innovations.n_states, innovations.n_inputs
        layout = replace(layout, n_input_harmonics=innovations.n_harmonics)
        squares = _with_inputs(innovations, m, comb(n + m + 1, 2))
        turning = is_told(squares, segments, replace(layout, n_inputs=squares.n_inputs))
        how = layout, turning, sensor_noise, most_growth, gain, asked
        return cls(innovations, innovations, None, None, segments, segments, *how)

    @classmethod
    def of(cls, innovations, segments, layout, sensor_noise, most_growth, degrees=None, gain=None):
        """The model with products; None where none pay, or steps are not to be had.

        ``innovations`` is a model after steps of its likelihood. Other arguments are as
        for :func:`~.innovations_steps.most_likely`. The products have ``degrees``, by
        default those that pay. ``gain`` is that of a predictor, for a model that
        simulates.
        """
        asked = degrees is not None
        likelihood = segments, layout, sensor_noise, most_growth
        found = cls.without(innovations, *likelihood, gain, asked)
        for tried in [degrees] if asked else [(degree,) for degree in DEGREES]:
            motion = found._motion_beside(tried, found.turning)
            if motion is None:
                break
            if found.products is not None:  # of the same states as those to come
                products = found._products(motion)
                found = found._with(found.model, products, motion)
            products = found._products(motion, tried)
            if products is not None:
                start = found._beside(products)
                more = start.n_inputs - found.model.n_inputs
                least = 0.0 if asked else more * found._per_product(found.turning)
                found = found._with(start, products, motion, least)
        if found.products is None:
            return None
        least = 1.0 - LEAST_TAKEN_UP if gain is not None and not asked else np.inf
        left, before = (_left(each, sensor_noise) for each in (found.model, innovations))
        return found if left <= least * before else None

    def of_other_degrees(self, rest):
        """Where products of the degrees that it has not would lead, with a constant effect.

        ``rest`` (2 L + 1, m) are inputs of a machine at rest, as Fourier coefficients.
        It returns the degrees (empty where none are to be had), the NextStep or None,
        and how far the outputs of a machine at rest may be off, (l,) or None. This is
        the root mean square over a turn: by what products and loads beside the model
        move them, and as far as these are known.
        """
        before = () if self.products is None else self.products.degrees
        tried = tuple(degree for degree in DEGREES if degree not in before)
        motion = self._motion_beside(tried, turning=False) if tried else None
        products = None if motion is None else self._products(motion, tried)
        if products is None:
            return (), None, None
        driven = products.beside(self.segments, motion)
        layout = replace(self.layout, n_inputs=self._n_turning(self.model))
        start, n_inputs = self._beside(products), self.model.n_inputs
        beside = next_step(start, driven, layout, self.sensor_noise, n_inputs)
        if beside is None:
            return tried, None, None
        forced, *moved = products.outputs_at_rest([start, *beside.of_loads], rest)
        off = np.sum([mean_square(each - forced) for each in moved], axis=0)
        return tried, beside, np.sqrt(off)

    def _motion_beside(self, degrees, turning):
        """The motion, if products of further degrees are not too many numbers; else None."""
        n, m = self.linear.n_states, self.linear.n_inputs
        more = sum(comb(n + m + degree - 1, degree) for degree in degrees)
        n_values = sum(y.size for _, y, _ in self.segments)
        if more * self._per_product(turning) * n_values > MOST_NUMBERS:
            return None
        return self.motion()

    def _per_product(self, turning):
        """Coefficients of a product's effect."""
        layout = self.layout
        each = self.linear.n_states + (layout.n_outputs if layout.feedthrough else 0)
        return each * (layout.n_functions if turning else 1)

    def _n_turning(self, model):
        """Inputs of a model whose effect turns with ψ, the first ones."""
        return model.n_inputs if self.turning else self.linear.n_inputs

    def _products(self, motion, further=()):
        """Products of some motion of the same degrees and of further ones; None if of these all
        are left out."""
        before, left_out = (), ()
        if self.products is not None:
            before, left_out = self.products.degrees, self.products.left_out
        if further:
            left_out += _told_as_factors(motion, further, self.layout.n_loads)
            if set(_factors(motion, further)) <= set(left_out):
                return None
        return _Products.of(motion, before + further, self.layout.n_loads, left_out=left_out)

    def _beside(self, products):
        """The model with products on which it has no effect yet."""
        before = self.model.n_inputs
        more = self.linear.n_inputs + len(products.which) - before
        return _with_inputs(self.model, before, more)

    def _stepped(self, model, driven, **options):
        """Steps of its likelihood; None where they are not to be had."""
        if not model.growth() < self.most_growth:
            return None
        layout = replace(self.layout, n_inputs=self._n_turning(model))
        return most_likely(model, driven, layout, self.sensor_noise, self.most_growth, **options)

    @cached_property
    def _predictor(self):
        """The model with the gain of a predictor, if it simulates and that leaves less."""
        return self.model if self.gain is None else self._predicting(self.model, self.driven)

    @property
    def covariance(self):
        """Of what predictions leave beside products."""
        return self._predictor.covariance

    def motion(self):
        """States that are predicted and inputs, beside ψ; None where they overflow."""
        predictor, motion = self._predictor, []
        for u, y, psi in self.driven:
            rows = predictor.rows(psi)
            x0 = rows.initial_state(u, y, predictor.covariance)
            x, u = rows.innovations(u, y, x0)[0], u[:, : self.linear.n_inputs]
            motion.append((np.hstack([x, u]), psi))
        finite = all(np.max(np.abs(z), initial=0.0) < OVERFLOW for z, _ in motion)
        return motion if finite else None

    def small_motions(self, rest):
        """The linear part, about the orbit of a machine at rest if the motion reaches it.

        ``rest`` is as for :meth:`of_other_degrees`.
        """
        motion, found, smaller = self.motion(), self, None
        if motion is not None:
            start = replace(self.model, gain=self.linear.gain)  # by which any A near it forgets
            about_rest = self.products.about_rest(start, motion, rest)
            found = self if about_rest is None else self._with(*about_rest, motion)
            left, before = (_left(each.model, self.sensor_noise) for each in (found, self))
            found = found if left <= AS_LITTLE * before else self
            if not self.asked:
                counted = _smaller_half(motion, found.products.centre)
                smaller = self._stepped(found.model, found.driven, counted=counted)
        model, m = found._predictor, self.linear.n_inputs
        gain = self.linear.gain if self.gain is None else self.gain
        linear = self._predicting(_with_inputs(model, m, 0), self.segments, gain)
        at_rest = _with_inputs(found.products.with_means(model), m, 0)
        gain = resize_harmonics(linear.gain, len(at_rest.coefficients) // 2)
        at_rest = replace(at_rest, gain=gain, covariance=linear.covariance)
        of_smaller = None if smaller is None else smaller[1]
        return SmallMotions(linear, at_rest, found.ahead, of_smaller, found is not self)

    def _with(self, start, products, motion, least_fall=0.0):
        """After steps from a start beside other products; the same if there are none."""
        driven = products.beside(self.segments, motion)
        found = self._stepped(start, driven, least_fall=least_fall)
        if found is None:
            return self
        return replace(self, model=found[0], ahead=found[1], products=products, driven=driven)

    def _predicting(self, model, driven, gain=None):
        """A model with a predictor's gain and what it leaves, or as it is if that is less."""
        gain = self.gain if gain is None else gain
        own = fitted(model, driven, self.sensor_noise)
        below = np.inf if own is None else own.cost
        at = fitted(replace(model, gain=gain), driven, self.sensor_noise, below=below)
        at = own if at is None else at
        return model if at is None else replace(at.innovations, covariance=at.covariance)


@dataclass(frozen=True, eq=False)
class _Products:
    """Products of states and inputs, in like size and without their means: inputs beside others."""

    degrees: tuple  # of int
    # of tuple of int: products that are not among them: they tell the same as their factors, or
    # hardly move about q̄, as the square of an input about the level half way between its two
    left_out: tuple
    which: list  # of tuple of int: the factors of each product
    # (2 L + 1, n + m): z̄, Fourier coefficients of what states and inputs are counted from
    centre: np.ndarray
    size: np.ndarray  # (k,): by which products are divided
    means: np.ndarray  # (2 L + 1, k): q̄, in that size

    @classmethod
    def of(cls, motion, degrees, n_loads, centre=None, left_out=()):
        """Products of some degrees, about the means of the motion by default."""
        centre = fitted_harmonics(motion, n_loads) if centre is None else centre
        which = [w for w in _factors(motion, degrees) if w not in left_out]
        products = [(_values(which, centre, z, psi), psi) for z, psi in motion]
        means = fitted_harmonics(products, n_loads)
        size = column_rms(np.vstack([q - evaluate_harmonics(means, psi) for q, psi in products]))
        return cls(tuple(degrees), left_out, which, centre, size, means / size)

    def some(self, moving):
        """Those of some of the products; the others are left out."""
        both = list(zip(self.which, moving, strict=True))
        others = tuple(w for w, moves in both if not moves)
        return replace(
            self,
            left_out=self.left_out + others,
            which=[w for w, moves in both if moves],
            size=self.size[moving],
            means=self.means[:, moving],
        )

    def moving(self, motion):
        """Which products move about their means."""
        whole = [_values(self.which, self.centre, z, psi) for z, psi in motion]
        return self.size**2 > LEAST_OF_ITS_OWN * column_rms(np.vstack(whole)) ** 2

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

    def outputs_at_rest(self, models, rest):
        """Fourier coefficients of the outputs of a machine at rest, (r, 2 K + 1, l).

        Models are alike but for their loads and the effects of products. K is that of the models
        at rest: cut to fewer harmonics, another origin of the state would move the outputs.
        """
        still = [_with_inputs(self.with_means(model), rest.shape[1], 0) for model in models]
        still = [each.about(-rest, np.zeros((len(rest), each.n_outputs))) for each in still]
        loads = np.stack([each.coefficients[..., -1] for each in still], axis=-1)
        return still[0].forced_responses(loads, len(loads) // 2)

    def about_rest(self, model, motion, rest):
        """The same model with products about the orbit at rest, and these.

        Of all degrees up to the highest: a power about one centre is a sum of powers about another.
        None where the motion does not reach that orbit, or has no products about it.
        """
        m, L, far = rest.shape[1], len(rest) // 2, self._distance(motion)
        centre, moved = self.centre, self.with_means(model)
        for _ in range(20):  # most take 3, those cut to few harmonics up to 10
            before, orbit = centre, _with_inputs(moved, m, 0).forced_orbit(rest, L)
            centre = np.hstack([orbit, rest])
            moved = self._moved(model, centre, self)
            if far(centre - before) <= SETTLED:
                break
        if not (far(centre - before) <= SETTLED and far(centre - self.centre) <= 1.0):
            return None
        degrees = tuple(range(2, max(self.degrees) + 1))
        others = tuple(degree for degree in degrees if degree not in self.degrees)
        left_out = self.left_out + (_told_as_factors(motion, others, L) if others else ())
        products = _Products.of(motion, degrees, L, centre, left_out)
        products = products.some(products.moving(motion))
        if not products.which:
            return None
        moved = products.with_means(self._moved(model, centre, products), -1.0)
        H = model.n_harmonics
        whole = resize_harmonics(moved.coefficients, max(H, L))
        whole[2 * H + 1 :, :, :-1], whole[2 * L + 1 :, :, -1] = 0.0, 0.0
        gain = resize_harmonics(model.gain, max(H, L))
        return replace(model, coefficients=whole, gain=gain), products

    def _moved(self, model, centre, products):
        """The model of products about another centre, with their means."""
        model, n_signals = self.with_means(model), centre.shape[1]
        H = len(model.coefficients) // 2 + max(self.degrees) * (len(centre) // 2)
        psi = 2.0 * np.pi * np.arange(2 * H + 1) / (2 * H + 1)
        values = evaluate_harmonics(model.coefficients, psi)
        about, before = (evaluate_harmonics(each, psi) for each in (centre, self.centre))
        shift = about - before
        moved = np.zeros((*values.shape[:2], n_signals + len(products.which) + 1))
        moved[..., :n_signals], moved[..., -1] = values[..., :n_signals], values[..., -1]
        places = {(i,): (i, 1.0) for i in range(n_signals)} | {(): (-1, 1.0)}
        for k, (factors, size) in enumerate(zip(products.which, products.size, strict=True)):
            places[factors] = n_signals + k, size
        for k, (factors, size) in enumerate(zip(self.which, self.size, strict=True)):
            column = values[..., n_signals + k] / size
            for some in chain(
                *(combinations(range(len(factors)), n) for n in range(len(factors) + 1))
            ):
                stays = tuple(factors[i] for i in some)
                if stays not in places:  # of a degree that those products have not
                    continue
                others = [f for i, f in enumerate(factors) if i not in some]
                at, its_size = places[stays]
                part = column * np.prod(shift[:, others], axis=1)[:, None]
                moved[..., at] += its_size * part
                if len(stays) == 1:  # of the whole state or input
                    moved[..., -1] -= part * about[:, stays]
        coefficients = sampled_harmonics(moved, H)
        return replace(model, coefficients=coefficients, gain=resize_harmonics(model.gain, H))

    def _distance(self, motion):
        """How far periodic signals go, in parts of how far the motion about the centre goes."""
        about = np.vstack([z - evaluate_harmonics(self.centre, psi) for z, psi in motion])
        inverse = np.linalg.pinv(about.T @ about)
        most = np.quantile(np.einsum("ti,ij,tj->t", about, inverse, about), REACHED)
        psi = np.linspace(0.0, 2.0 * np.pi, 4 * len(self.centre), endpoint=False)

        def far(coefficients):
            x = evaluate_harmonics(coefficients, psi)
            return np.sqrt(np.max(np.einsum("ti,ij,tj->t", x, inverse, x)) / most)

        return far


def _factors(motion, degrees):
    """Factors of all products of some degrees of states and inputs."""
    places = range(motion[0][0].shape[1])
    return [w for degree in degrees for w in combinations_with_replacement(places, degree)]


def _told_as_factors(motion, degrees, n_loads):
    """Products that go with states and inputs, by factors that turn with ψ, or are constant.

    u³ of steps to −a, 0 and a is a² u, and u² of steps to −a and a is a²; about its mean ū(ψ) that
    is a² + ū² − 2 ū u. Noise would decide what is whose, and with it the linear part.
    """
    products = _Products.of(motion, degrees, n_loads)
    products = products.some(products.moving(motion))
    if not products.which:
        return products.left_out
    moved = []
    for z, psi in motion:
        about = z - evaluate_harmonics(products.centre, psi)
        moved.append(times(harmonic_functions(psi, range(n_loads + 1)), about))
    beside = products.beside([(z[:, :0], None, psi) for z, psi in motion], motion)
    q, moved = np.vstack([own for own, *_ in beside]), np.vstack(moved)
    left = q - moved @ linalg.lstsq(moved, q)[0]
    whole = [_values(products.which, products.centre, z, psi) / products.size for z, psi in motion]
    least = LEAST_OF_ITS_OWN * np.mean(np.vstack(whole) ** 2, axis=0)
    told = np.mean(left**2, axis=0) <= least
    told = (w for w, goes in zip(products.which, told, strict=True) if goes)
    return products.left_out + tuple(told)


def _values(which, centre, z, psi):
    """Products of some factors of signals about their centre."""
    z = z - evaluate_harmonics(centre, psi)
    values = [np.prod(z[:, list(factors)], axis=1) for factors in which]
    return np.array(values).reshape(-1, len(z)).T


def _left(innovations, sensor_noise):
    """The variance that a model leaves of all outputs, beside that of their sensors."""
    return np.trace(innovations.covariance) + innovations.n_outputs * sensor_noise**2


def _smaller_half(motion, centre):
    """Rows of each segment in which the motion about some centre is below its median."""
    about = [z - evaluate_harmonics(centre, psi) for z, psi in motion]
    size = column_rms(np.vstack(about))
    square = [np.sum((z / size) ** 2, axis=1) for z in about]
    median = np.median(np.concatenate(square))
    return [each <= median for each in square]


def _with_inputs(innovations, kept, more):
    """A model of its first inputs, and of more that have no effect."""
    M, n = innovations.coefficients, innovations.n_states
    without = np.zeros((*M.shape[:2], more))
    return replace(innovations, coefficients=np.dstack([M[..., : n + kept], without, M[..., -1:]]))
