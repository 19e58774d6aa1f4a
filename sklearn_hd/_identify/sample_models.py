"""Models of samples of some order and harmonics: matrices, and steps of the likelihood.

Steps 3 to 6 of :mod:`~sklearn_hd._identify.sample`, which chooses among these models. The layouts
of the predictor of step 2 are here, too: Akaike's criterion chooses lags and harmonics, Schwarz's
whether D is free. A record that is too short for any is refused.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sklearn_hd._checks import LITTLE
from sklearn_hd._identify.stages import (
    MOST_PREDICTOR_ROWS,
    or_hop,
    warn_of_feedback,
    why_no_noise,
)
from sklearn_hd.algorithms.likelihood.innovations_steps import fitted, most_likely
from sklearn_hd.algorithms.likelihood.small_motions import AS_LITTLE, LEAST_TAKEN_UP, LargeMotions
from sklearn_hd.algorithms.lti.simulation import GROWN
from sklearn_hd.algorithms.periodic.harmonic_balance import (
    evaluate_harmonics,
    product,
    resize_harmonics,
)
from sklearn_hd.algorithms.periodic.periodic_innovations import (
    PeriodicInnovations,
    coordinates_without_modes,
    without_modes,
)
from sklearn_hd.algorithms.periodic.periodic_predictor import (
    SENSOR_NOISE,
    LagSums,
    Layout,
    States,
    StateSums,
    spread_rows,
    with_noise,
)
from sklearn_hd.algorithms.signals.fourier import ROWS_PER_COLUMN
from sklearn_hd.algorithms.subspace.order import Simulated, best_of

MOST_STATE_HARMONICS = 8  # of the matrices, in coordinates that are no one's
MOST_STATES = 20  # tried by order="auto"
LEAST_NOISE = 1e-6  # of an output's motion, where data are exact and no steps follow
PIECE = 4  # times the lags: the least piece of an unstable model that is simulated
PATIENCE = 6  # orders that may pass without a better one
MOST_SIMPLER = 3  # smaller orders that are looked at beside the best one
MOST_COLUMNS = 1000  # of the largest regression tried: its sums take seconds
MOST_HARMONICS = 3  # of the predictor, where the data choose
ROWS_COMPARED = 10_000  # of a longer record, choices are made on


def _left(innovations):
    """Logarithm of the variance that one-step predictions leave, beside the least noise."""
    return np.linalg.slogdet(with_noise(innovations.covariance))[1]


@dataclass(frozen=True, eq=False)
class Refined:
    """A model after steps of its likelihood."""

    linear: PeriodicInnovations  # without products
    # (ndarray, ndarray), or None: where a further step leads the logarithms of its multipliers, and
    # their deviations; None without steps
    linear_ahead: tuple | None
    rest: np.ndarray  # (2 L + 1, m): inputs of a machine at rest
    no_noise: str = ""  # why what a linear model leaves is no noise, "" if it is
    # where products of states and inputs pay; their linear part is the model then
    large: LargeMotions | None = None
    # the linear model, no products beside it yet; None without steps
    without: LargeMotions | None = None

    @cached_property
    def small(self):
        """The linear part beside products: SmallMotions; None without them."""
        return None if self.large is None else self.large.small_motions(self.rest)

    @property
    def innovations(self):
        """The linear model, or the linear part."""
        return self.linear if self.small is None else self.small.innovations

    @property
    def at_rest(self):
        """The same with the loads of a machine at rest."""
        return self.linear if self.small is None else self.small.at_rest

    @property
    def ahead(self):
        """Where a further step leads it."""
        return self.linear_ahead if self.small is None else self.small.ahead

    @cached_property
    def beside(self):
        """What products of other degrees would do, as ``LargeMotions.of_other_degrees`` has it."""
        base = self.large or self.without
        return ((), None, None) if base is None else base.of_other_degrees(self.rest)

    @property
    def degrees(self):
        """Of products that are further inputs."""
        return () if self.large is None else self.large.products.degrees

    @property
    def simulates(self):
        """Whether these are fitted to a simulation."""
        return self.large is not None and self.large.gain is not None


@dataclass(frozen=True, eq=False)
class _Models:
    """Models of some order with more and more harmonics."""

    # (2 H + 1, bound, n): of their states among constant ones, Fourier coefficients
    coordinates: np.ndarray
    tried: list  # of (Simulated, bool): and whether a machine may have such multipliers
    best: Simulated

    @property
    def order(self):
        return self.best.order

    @property
    def is_possible(self):
        """Whether a machine may have the best one's multipliers."""
        return (self.best, True) in self.tried


class Choice:
    """The order and the harmonics of the matrices, by what simulations of the record leave.

    ``steps`` says whether steps of the likelihood follow, ``skipped`` how many rows of a segment
    are left out of simulations; at least the lags.
    """

    def __init__(self, data, sums, settings, basis, steps, skipped=0):
        layout = sums.layout
        self.data, self.settings, self.basis, self.steps = data, settings, basis, steps
        self.layout, self.n_rows, self.predictor = layout, sums.n_rows, sums.predictor()
        noise = SENSOR_NOISE if steps else LEAST_NOISE  # which steps take to be there, too
        most = min(MOST_STATE_HARMONICS, basis.most_harmonics)
        self.most = most if layout.n_harmonics else 0
        self.states = self._states(noise)
        self.models = {}  # by order: _Models
        self.simulated = list(_simulated(data.segments, max(skipped, layout.n_lags)))
        total = sum(np.sum(y**2, axis=0) for _, y, _ in self.simulated)
        self.total = np.where(total > 0.0, total, 1.0)  # of an output at rest nothing is left

    def _states(self, noise):
        """States that the predictor makes of the data, whose outputs have some noise at least."""
        asked = 1 if self.settings.order == "auto" else self.settings.order
        n_lags, n_outputs = self.layout.n_lags, self.data.n_outputs
        most = n_lags * n_outputs
        if asked > most:
            raise ValueError(
                f"order={asked} exceeds the {most} that {n_lags} lags with {n_outputs} "
                f"output(s) tell; lower order or raise block_rows"
            )
        most = min(most, max(asked, MOST_STATES))
        return States.of(self.data.segments, self.predictor, most, noise)

    @classmethod
    def of(cls, data, settings, basis, steps=True):
        """With lags and harmonics of the predictor that suit the data; the best model; why D is
        free or not; and all models tried, those with its D first."""
        layouts, reason = predictor_layouts(data, settings, basis)
        skipped = max(layout.n_lags for layout in layouts)  # so that all simulate the same rows
        choices = [
            cls(data, LagSums.of(data.segments, layout), settings, basis, steps, skipped)
            for layout in layouts
        ]
        bests = [each.best() for each in choices]
        found = [one for one in bests if one is not None]
        if not found:
            orders = [one.order for one in choices[0].tried]
            raise ValueError(
                f"stable=True, but no model of the orders tried ({orders[0]} to {orders[-1]}) is "
                f"stable; use stable=False and predict_ahead, another order, or fewer harmonics"
            )
        best = best_of(found, choices[0].n_values)
        both = zip(bests, choices, strict=True)
        if all(one is not None and one.stable and each.leaves_noise(one) for one, each in both):
            best = min(found, key=lambda one: (one.order, one.bic))  # D, or states instead of it
        if not best.stable:
            best = _as_fairly_compared(best, choices)
        choices.sort(key=lambda each: best not in each.tried)
        tried = tuple(one for each in choices for one in each.tried)
        return choices[0], best, reason.format("D free" if best.feedthrough else "D = 0"), tried

    def sums(self, order, some=True):
        """Sums of which models of some order are made, with any number of harmonics.

        Over the rows that choices are made on, or over all.
        """
        return self._sums(self.models[order].coordinates, some)

    def _sums(self, coordinates, some=True):
        rows = self._rows(coordinates, some)
        return StateSums.of(rows, self.most, self.basis.most_loads)

    def _rows(self, coordinates, some=True):
        """Rows of the states that choices are made on, or all; as ``States.rows`` gives them."""
        segments = self.data.segments
        whole = [(s, slice(0, len(y))) for s, (_, y, _) in enumerate(segments)]
        return self.states.rows(segments, coordinates, compared_rows(segments) if some else whole)

    @property
    def tried(self):
        """What all models leave that are kept: Simulated."""
        return [one for models in self.models.values() for one, _ in models.tried]

    @property
    def n_values(self):
        """Rows times outputs that are simulated."""
        return sum(y.size for _, y, _ in self.simulated)

    @property
    def noise(self):
        """What one-step predictions of the predictor leave, as ``Simulated.variance`` counts it."""
        left = self.predictor.left[self.total > 0.0]
        return float(np.exp(np.mean(np.log(left + SENSOR_NOISE**2))))

    def leaves_noise(self, one):
        """Whether a simulation leaves as little as one-step predictions of the predictor."""
        return one.variance <= AS_LITTLE * self.noise

    def best(self):
        """What the model of the least criterion leaves: a Simulated; None if none may be kept."""
        asked, found = self.settings.order, None
        for order in range(1, self.states.bound + 1) if asked == "auto" else [asked]:
            self.models[order] = self._constant(order)
            kept = self.kept()
            found = best_of(kept, self.n_values) if kept else None
            if found is not None and found.order <= order - PATIENCE:
                break
        if found is None or not (found.stable and self.most):
            return found
        return self._without_spurious_modes(found) if asked == "auto" else self._of_more(found)

    def _constant(self, order):
        """Models in constant coordinates: of all that is known of outputs to come, or, where there
        are enough of them, of a row's own outputs, which turn no more than C(ψ) does; of all with
        predictions as outputs, where these leave more than noise."""
        every = [self.states.known(order)]
        moving = sum(np.any([np.any(y, axis=0) for _, y, _ in self.data.segments], axis=0))
        if self.most and order <= moving:
            every.append(self.states.of_outputs[:, :order])
        models = [self._of(V[None]) for V in every]
        if not any(self.leaves_noise(each.best) for each in models):
            models.append(self._of(self.states.free(order)[None]))
        models = [each for each in models if each.is_possible] or models
        best = best_of([each.best for each in models], self.n_values)
        return next(each for each in models if each.best is best)

    def _of(self, coordinates):
        """Models in some coordinates."""
        sums, order, tried = self._sums(coordinates), coordinates.shape[2], []
        for count in self._counts():
            innovations = self.model(sums, count)
            one = self.compared(order, count, innovations)
            tried.append((one, innovations.is_possible()))
            if len(tried) > 1 and one.bic >= tried[-2][0].bic:
                break
        kept = self._kept(tried) or [one for one, _ in tried]
        return _Models(coordinates, tried, best_of(kept, self.n_values))

    def _without_spurious_modes(self, found):
        """The best model, without the modes that constant coordinates have brought in.

        A model in coordinates that turn with the states may be as good with fewer of them.
        """
        orders = found.order, found.order + 1
        ahead = [self.models[order] for order in orders if order in self.models]
        while ahead:
            fewer = sorted(self._without_a_mode(ahead.pop()), key=lambda one: one.best.bic)
            for one in fewer:
                known = self.models.get(one.order)
                if known is None or one.best.bic < known.best.bic:
                    self.models[one.order] = one
            if fewer and fewer[0].best.bic < found.bic:
                found, ahead = fewer[0].best, fewer[:1]
        return found

    def _of_more(self, found):
        """The model asked for, by way of more states where constant coordinates take more."""
        asked, rival = found.order, None
        for order in range(asked + 1, min(asked + PATIENCE, self.states.bound) + 1):
            rival = self._constant(order)
            if self.leaves_noise(rival.best):
                break
        while rival is not None and rival.order > asked:
            fewer = (one for one in self._without_a_mode(rival) if one.order >= asked)
            rival = min(fewer, key=lambda one: one.best.bic, default=None)
        if rival is None or rival.best.bic >= found.bic:
            return found
        self.models[asked] = rival
        return rival.best

    def _without_a_mode(self, models):
        """Models of what is left of the best one's states without each of its modes.

        Of a stable one, stable ones that a machine may have.
        """
        if not models.best.stable:
            return
        coordinates, turning = models.coordinates, self.layout.n_harmonics
        whole = self.model(self._sums(coordinates), models.best.n_harmonics)
        n_harmonics = min(len(coordinates) // 2 + turning, self.most)
        for V in coordinates_without_modes(whole, turning):
            found = self._of(resize_harmonics(product(coordinates, V), n_harmonics))
            if found.best.stable and found.is_possible:
                yield found

    def whole(self, chosen):
        """The model of some order and harmonics, of all rows."""
        return self.model(self.sums(chosen.order, some=False), chosen.n_harmonics)

    def simpler(self, chosen, most_left):
        """Of each smaller order the best model tried, if it leaves little; the smallest first.

        A few; and that of the same order with fewer harmonics.
        """
        few = [one for one in self.kept() if one.stable and one.variance <= most_left]
        each = [[one for one in few if one.order == order] for order in range(1, chosen.order + 1)]
        fewer = [one for one in each.pop() if one.n_harmonics < chosen.n_harmonics]
        orders = [some for some in each if some]
        for some in (*orders[:MOST_SIMPLER], fewer):
            if some:
                yield min(some, key=lambda one: one.bic)

    def refined(self, innovations, stable, like=None):
        """A model with the gain of its Kalman filter, after steps of its likelihood.

        Products of states and inputs are further inputs, those of another one refined, or where
        they pay (None) and the linear predictor knows no more than they do: else states or
        harmonics are missing.
        """
        start = innovations.filtered(self._noise(innovations))
        return self.after_steps(start, stable, like)

    def truncated(self, innovations, n_harmonics):
        """The model without the mode that a simulation misses least, and what that leaves."""
        few = [
            (self.compared(one.n_states, n_harmonics, one), one)
            for one in without_modes(innovations, n_harmonics)
        ]
        few = [(left, one) for left, one in few if left.stable and one.is_possible()]
        return min(few, key=lambda pair: pair[0].bic, default=None)

    def after_steps(self, start, stable, like=None):
        """A model that has a gain, after steps of its likelihood, as :meth:`refined` gives it."""
        asked, count = self.basis.n_input_harmonics, start.n_harmonics
        layout = replace(self.layout, n_input_harmonics=count if asked is None else asked)
        most_growth = GROWN / self.data.longest if stable else np.inf
        likelihood = self.data.segments, layout, SENSOR_NOISE, most_growth
        found = self._stepped(start, likelihood, stable, like) if self.steps else None
        model, ahead = (start, None) if found is None else found
        large, without = None, found and LargeMotions.without(model, *likelihood)
        if found is not None and (like is None or like.degrees):
            large = self._large_motions(model, start, likelihood, stable, like)
        compared, no_noise = (self.simulated, model, self.predictor), ""
        if like is None and (large is None or why_no_noise(*compared, large.covariance)):
            large, no_noise = None, why_no_noise(*compared)
        return Refined(model, ahead, self.data.rest, no_noise, large, without)

    def _stepped(self, start, likelihood, stable, like):
        """The model of largest likelihood near a start: with a gain, or as another one has it.

        If simulations leave more than noise, it may be one without: white noise of sensors needs
        no gain, but steps that have one may end where it stands for slow modes, since no step
        leads over a predictor that does not forget. Steps without are taken if the first promises
        as much as the gain does, or half of what a simulation leaves; their model is kept if it
        leaves no more than predictions with the gain.
        """
        gain = 0.0 * start.gain
        if like is not None and not like.linear.gain.any():
            return most_likely(replace(start, gain=gain), *likelihood)
        found = most_likely(start, *likelihood)
        if found is None or not stable:
            return found
        model = found[0]
        left = self.compared(model.n_states, model.n_harmonics, model)
        still = fitted(replace(model, gain=gain), self.data.segments, SENSOR_NOISE)
        if still is None or self.leaves_noise(left):
            return found
        n_rows = sum(len(y) for _, y, _ in self.data.segments)
        of_gain = 0.5 * n_rows * (_left(still) - _left(model))  # −log L
        half = 0.5 * n_rows * self.data.n_outputs * LEAST_TAKEN_UP
        least = min(of_gain, half)
        simulated = most_likely(still.innovations, *likelihood, least_fall=least)
        return found if simulated is None or _left(simulated[0]) > _left(model) else simulated

    def _large_motions(self, model, start, likelihood, stable, like):
        """The model with products as further inputs, those of another one or where they pay.

        If predictions leave less than the noise of a sensor, products are those of a simulation,
        where these take up half of what it leaves.
        """
        degrees = None if like is None else like.degrees
        simulates = stable and self._is_exact(model.covariance) if like is None else like.simulates
        large = None if simulates else LargeMotions.of(model, *likelihood, degrees)
        if like is None and large is not None:
            simulates = stable and self._is_exact(large.model.covariance)
        if simulates:
            simulated = most_likely(replace(start, gain=0.0 * start.gain), *likelihood)
            if simulated is not None:
                large = LargeMotions.of(simulated[0], *likelihood, degrees, start.gain) or large
        return large

    def _is_exact(self, covariance):
        """Whether one-step predictions leave less of each output than the least noise of a sensor.

        Those of a model or of the predictor, whichever leave less of it.
        """
        least = np.minimum(np.diag(covariance), self.predictor.left)
        return bool(np.all(least <= SENSOR_NOISE**2))

    def kept(self):
        """Models to choose from: stable ones if asked for, and of them those of a machine."""
        return self._kept([pair for models in self.models.values() for pair in models.tried])

    def _kept(self, models):
        kept = [pair for pair in models if pair[0].stable or not self.settings.stable]
        return [one for one, possible in kept if possible] or [one for one, _ in kept]

    def _noise(self, innovations):
        """Covariance of innovations, and of what is left of next states and of outputs."""
        n, total, n_rows = innovations.n_states, 0.0, 0
        for x, following, u, y, e, psi in self._rows(self.models[n].coordinates):
            form = innovations.rows(psi)
            known = np.hstack([x, u, np.ones((len(u), 1))])[..., None]
            rest = following - (form.states @ known + form.gain @ e[..., None])[..., 0]
            noise = np.hstack([e, rest, y - (form.outputs @ known)[..., 0]])
            total, n_rows = total + noise.T @ noise, n_rows + len(noise)
        noise = total / n_rows
        n_outputs = self.data.n_outputs
        noise[-n_outputs:, -n_outputs:] = with_noise(noise[-n_outputs:, -n_outputs:])
        return noise

    def _counts(self):
        """Numbers of harmonics tried, of which each has to better the one before."""
        first = self.layout.n_harmonics
        return sorted({first, *(min(k * first, self.most) for k in (2, 3)), self.most})

    def model(self, sums, count):
        """The closed form of some number of harmonics."""
        asked = self.basis.n_input_harmonics
        coefficients, gain = sums.matrices(
            count,
            count if asked is None else min(count, asked),
            self.basis.most_loads,
            self.layout.feedthrough,
        )
        start = self.data.segments[0][2][0]
        covariance, step = self.predictor.covariance, self.data.step
        return PeriodicInnovations(coefficients, gain, covariance, step, float(start))

    def compared(self, order, count, innovations, rate=None):
        """What simulations of one model leave, in pieces that suit its growth or a given one."""
        D, longest = self.layout.feedthrough, self.data.longest
        own = innovations.growth()
        least = PIECE * self.layout.n_lags  # so long that no initial state explains it
        rate = own if rate is None else rate
        pieces = [piece for s in self.simulated for piece in _pieces(s, rate, least)]
        left = [innovations.rows(psi).left(u, y) for u, y, psi in pieces]
        if any(each is None for each in left):
            return Simulated(order, D, False, np.inf, np.inf, np.inf, count)
        moves = self.total > 0.0
        shares = sum(np.sum(each**2, axis=0) for each in left)[moves] / self.total[moves]
        logs = np.log(shares + SENSOR_NOISE**2)
        n_rows = sum(len(y) for _, y, _ in pieces)
        bic = n_rows * np.sum(logs) + self._spent(order, count, self.data.n_inputs, n_rows)
        bic += order * sum(np.log(len(y)) for _, y, _ in pieces)
        share, variance = np.sqrt(np.mean(shares)), np.exp(np.mean(logs))
        stable = longest * own < GROWN
        return Simulated(order, D, bool(stable), *map(float, (share, variance, bic)), count)

    def _spent(self, order, count, n_inputs, n_rows):
        """What the criterion counts for coefficients of so many states, harmonics and inputs."""
        D, n_outputs = self.layout.feedthrough, self.data.n_outputs
        n_free = order * (order + n_inputs + n_outputs) + D * n_inputs * n_outputs
        first = self.layout.n_harmonics  # those beyond belong to the coordinates
        return n_free * ((2 * first + 1) * np.log(n_rows) + 4 * (count - first))

    def bic_of_predictions(self, chosen, refined):
        """The criterion of one-step predictions, with products as inputs where these pay."""
        large, linear = refined.large, refined.linear
        found = linear if large is None else large
        n_inputs = linear.n_inputs if large is None else large.model.n_inputs
        n_rows = sum(len(y) for _, y, _ in self.data.segments)
        return n_rows * _left(found) + self._spent(
            chosen.order, chosen.n_harmonics, n_inputs, n_rows
        )

    def start(self, innovations, s):
        """State at the first row of a segment, in the units of the signals."""
        u, y, psi = self.data.segments[s]
        (u_mean, y_mean), (u_scale, y_scale) = self.data.means, self.data.scales
        rows = slice(0, 4 * self.layout.n_lags)
        u = u[rows] * u_scale + evaluate_harmonics(u_mean, psi[rows])
        y = y[rows] * y_scale + evaluate_harmonics(y_mean, psi[rows])
        return innovations.rows(psi[rows]).initial_state(u, y, innovations.covariance)


def _as_fairly_compared(unstable, choices):
    """The best stable model, if it leaves as little as an unstable one.

    That is simulated in short pieces, each from a state of its own; so is the stable one then.
    """
    kept = [(each, one) for each in choices for one in each.kept() if one.stable]
    if not kept:
        return unstable
    choice, rival = min(kept, key=lambda pair: pair[1].bic)
    own = next(each for each in choices if unstable in each.tried)
    rate = own.model(own.sums(unstable.order), unstable.n_harmonics).growth()
    innovations = choice.model(choice.sums(rival.order), rival.n_harmonics)
    again = choice.compared(rival.order, rival.n_harmonics, innovations, rate)
    return unstable if best_of([unstable, again], choice.n_values) is unstable else rival


def _simulated(segments, skipped):
    """Rows that choices are made on, those without a whole predictor left out."""
    for s, rows in compared_rows(segments):
        u, y, psi = (z[rows] for z in segments[s])
        if len(y) > 2 * skipped:
            yield u[skipped:], y[skipped:], psi[skipped:]


def _pieces(segment, rate, least):
    """A segment, in pieces in which a model of some growth a row does not outgrow the outputs."""
    u, y, psi = segment
    n = len(y)
    length = n if rate * n < GROWN else max(int(GROWN / rate), least)
    n_pieces = max(1, n // length)
    for k in range(n_pieces):
        rows = slice(k * n // n_pieces, (k + 1) * n // n_pieces)
        yield u[rows], y[rows], psi[rows]


# ---- lags, harmonics and feedthrough of the predictor --------------------------------------------


def compared_rows(segments):
    """Segments, and slices of them, that choices are made on."""
    return spread_rows([len(y) for _, y, _ in segments], ROWS_COMPARED)


def predictor_layouts(data, settings, basis):
    """Lags, harmonics and feedthrough of the predictor, and why D is free or zero.

    Several where inputs are so smooth that a predictor cannot tell: with D = 0 and with D free, and
    each with more lags and with half of them, too. Few lags predict the next row then, but do not
    tell what comes later; many of a record without noise are large and cancel each other.
    """
    most, lags = _most(data, settings, basis)
    shortest = _shortest(data, settings)
    auto = settings.feedthrough == "auto"

    def layout(count, feedthrough):
        return Layout(
            data.n_inputs,
            data.n_outputs,
            lags,
            count,
            count if basis.n_input_harmonics is None else min(count, basis.n_input_harmonics),
            basis.most_loads,
            feedthrough,
        )

    compared = [[z[rows] for z in data.segments[s]] for s, rows in compared_rows(data.segments)]
    sums = LagSums.of(compared, layout(most, auto or settings.direct))
    least = lags if settings.block_rows is not None else shortest
    found = {}
    for count in range(most + 1):
        for feedthrough in (False, True) if auto else (settings.direct,):
            own = layout(count, feedthrough)
            aic, bic = sums.part(own).criteria(least)
            k = int(np.argmin(aic))
            found[count, feedthrough] = aic[k], bic[k], least + k
    fed_back = auto and settings.predictor  # D may stand for feedback within a row
    allowed = [key for key in found if not (fed_back and key[1])]
    count = min(allowed, key=lambda key: found[key][0])[0]

    def whole(feedthrough, lags):
        return replace(layout(count, feedthrough), n_lags=lags)

    if not auto:
        lags, reason = found[count, settings.direct][2], "feedthrough={} was asked for"
        return [whole(settings.direct, lags)], reason.format(settings.feedthrough)
    # a whole set of coefficients, which has to be worth it
    gain = found[count, False][1] - found[count, True][1]
    reason = f"the Bayesian information criterion of the predictor is {abs(gain):.3g} lower with "
    lags = [found[count, feedthrough][2] for feedthrough in (False, True)]
    tells = sums.part(whole(True, lags[1])).tells_feedthrough()
    if not tells:
        reason = (
            "earlier rows predict an input almost exactly, so that the predictor cannot tell D; of "
            "the models with D = 0 and with D free, the best has "
        )
    if fed_back:
        zero = [whole(False, lags[0])]
        if not tells or gain <= LITTLE * sums.n_rows:
            return zero, "weighting='pbsid' takes {}"
        warn_of_feedback(f"{reason}D free")
        return zero, f"{reason}D free, but feedback within a row looks the same: {{}}"
    if not tells:
        own, longest = max(lags), sums.layout.n_lags
        several = (k for k in (own, own // 2, 2 * own, 3 * own) if least <= k <= longest)
        both = [whole(feedthrough, each) for each in several for feedthrough in (False, True)]
        return both, reason + "{}"
    return [whole(bool(gain > 0.0), lags[int(gain > 0.0)])], reason + "{}"


def rows_told(data, lags):
    """Rows with so many before them: short segments have few, or none."""
    return sum(max(0, len(y) - lags) for _, y, _ in data.segments)


def _shortest(data, settings):
    """Fewest lags, which have to tell as many states as asked for."""
    return 2 if settings.order == "auto" else max(2, -(-settings.order // data.n_outputs))


def _most(data, settings, basis):
    """Most harmonics and lags that the record allows, of those asked for."""
    n_rows, longest = sum(len(y) for _, y, _ in data.segments), data.longest
    asked, shortest = settings.block_rows, _shortest(data, settings)
    if asked is not None and asked < shortest:
        raise ValueError(
            f"order={settings.order} exceeds the {asked * data.n_outputs} that block_rows={asked} "
            f"with {data.n_outputs} output(s) tell; lower order, or raise block_rows"
        )
    if asked is None and shortest > MOST_PREDICTOR_ROWS:
        raise ValueError(
            f"order={settings.order} with {data.n_outputs} output(s) takes {shortest} lags, and "
            f"{MOST_PREDICTOR_ROWS} are tried at most; lower order, or give block_rows={shortest} "
            f"or more"
        )
    given = basis.n_harmonics
    most = min(MOST_HARMONICS if given is None else given, basis.most_harmonics)
    least = asked or shortest
    for count in range(most, -1 if given is None else most - 1, -1):
        per_lag = (data.n_inputs + data.n_outputs) * (2 * count + 1)
        first = 2 * basis.most_loads + 1
        lags = min(
            MOST_PREDICTOR_ROWS, max((MOST_COLUMNS - first) // per_lag, shortest), longest // 3
        )
        while lags > shortest and rows_told(data, lags) < ROWS_PER_COLUMN * (
            first + lags * per_lag
        ):
            lags -= 1
        lags = lags if asked is None else asked
        if lags >= shortest and n_rows >= 2 * lags * per_lag and longest >= 3 * lags:
            return count, lags
    need = max(2 * least * per_lag, 3 * least)
    raise ValueError(
        f"the {data.facts.span} give {n_rows} rows, the longest segment {longest}, too few for "
        f"a predictor of {least} lags with {count} harmonic(s) of "
        f"{data.n_inputs + data.n_outputs} signals: {need} rows in one segment would do"
        f"{data.facts.why_short}; use a longer record, fewer block_rows, a lower order, or a "
        f"smaller output_harmonics in HarmonicAnalyzer{or_hop(basis)}"
    )
