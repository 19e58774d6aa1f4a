"""``reading="sample"``: a periodic innovations model of samples at their azimuths.

1. The forced periodic means of inputs and outputs are taken out, and signals brought to like size.
2. A periodic predictor by ridge regression; its lags and harmonics by Akaike's criterion.
3. States by one singular value decomposition of what it knows of the outputs to come.
4. Matrices, K and loads by least squares; order and harmonics by simulation (Schwarz's criterion).
5. Steps of the likelihood from there, which bring back what the lags have lost.
6. Products of states and inputs as further inputs, where a linear model does not hold.
"""

from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from scipy import linalg

from sklearn_hd._fit_checks import check_motion, warn_of_thinning
from sklearn_hd._guards import searching, warn
from sklearn_hd._identify.checks import (
    MOST_PREDICTOR_ROWS,
    check_outputs_move,
    check_told_from_loads,
    check_turns,
    root_mean_square,
    warn_of_growth,
    warn_of_little,
    why_no_noise,
)
from sklearn_hd._identify.predictor_layout import (
    compared_rows,
    predictor_layouts,
    rows_told,
)
from sklearn_hd._identify.stages import Settings, SubspaceFit
from sklearn_hd._identify.statistics import Facts
from sklearn_hd._opinion import DOUBT, Opinion, lasting, more_doubtful, of_halves, why_unconfirmed
from sklearn_hd._sample_model import SampleModel
from sklearn_hd.algorithms.likelihood.innovations_steps import most_likely
from sklearn_hd.algorithms.likelihood.small_motions import SmallMotions, of_small_motions
from sklearn_hd.algorithms.linalg.rounding import HALF
from sklearn_hd.algorithms.lti.simulation import GROWN
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_predictor import (
    SENSOR_NOISE,
    LagSums,
    StateSums,
    forced_mean,
    futures_known,
)
from sklearn_hd.algorithms.subspace.order import Simulated, best_of
from sklearn_hd.exceptions import IdentifiabilityWarning

MOST_STATE_HARMONICS = 8  # of the matrices, in coordinates that are no one's
MOST_STATES = 20  # tried by order="auto"
LEAST_NOISE = 1e-6  # of an output's motion, where data are exact and no steps follow
MOST_ROWS_A_TURN = 200  # whose multipliers take no time to find and to sort
PIECE = 4  # times the lags: the least piece of an unstable model that is simulated
PATIENCE = 6  # orders that may pass without a better one
MOST_SIMPLER = 3  # models with fewer states that are looked at if the best one is in doubt
AS_LITTLE = 1.1  # times what another model leaves: no more
STEPS_GAIN = 10.0  # of what a closed form leaves, at most, over what steps of likelihood leave
LITTLE = 1e-2  # of the motion's variance, which the second order of a response may explain


@dataclass(frozen=True, eq=False)
class Samples:
    """Segments of a record about their forced periodic means, in like units.

    Attributes
    ----------
    segments : list of (inputs, outputs, psi)
    means : (ndarray, ndarray)
        Fourier coefficients of what was taken out of inputs and outputs.
    scales : (ndarray, ndarray)
    facts : Facts
    step : float
        Radians from row to row, the mean.
    """

    segments: list
    means: tuple
    scales: tuple
    facts: Facts
    step: float

    @property
    def longest(self):
        """Rows of the longest segment."""
        return max(len(y) for _, y, _ in self.segments)

    def duration(self, omega):
        """Seconds of the longest segment."""
        return self.longest * self.step / omega

    @property
    def n_inputs(self):
        """Number of inputs."""
        return len(self.scales[0])

    @property
    def trim_in_inputs(self):
        """Whether the inputs' mean is larger than their motion about it."""
        return bool(np.any(np.abs(self.means[0][0]) > self.scales[0]))

    @property
    def rest(self):
        """Inputs of a machine at rest, as Fourier coefficients: zero, or their mean."""
        return -(not self.trim_in_inputs) * self.means[0] / self.scales[0]

    @property
    def n_outputs(self):
        """Number of outputs."""
        return len(self.scales[1])


def asked_block_rows(basis, settings):
    """Lags given, or the most tried."""
    return MOST_PREDICTOR_ROWS if settings.block_rows is None else int(settings.block_rows)


def read(experiment, settings):
    """The samples of an experiment."""
    basis = experiment.basis
    check_turns(experiment)
    facts = Facts.of(experiment, experiment.drive)
    check_motion(facts)
    parts = zip(experiment.drive, experiment.outputs, experiment.phases, strict=True)
    segments = list(parts)
    means = forced_mean(segments, basis.most_loads)
    if basis.about_trim:
        means = tuple(np.zeros_like(mean) for mean in means)
    segments = [
        (u - evaluate_harmonics(means[0], psi), y - evaluate_harmonics(means[1], psi), psi)
        for u, y, psi in segments
    ]
    u_scale, y_scale = (root_mean_square(parts) for parts in list(zip(*segments, strict=True))[:2])
    check_told_from_loads(u_scale, experiment)
    taken = basis.output_trim if basis.about_trim else means[1]
    still = y_scale <= HALF * np.max(np.abs(taken), axis=0)  # what rounding of ψ leaves
    check_outputs_move(still, facts)
    warn_of_thinning(experiment, taken)
    y_scale = np.where(still, 1.0, y_scale)
    segments = [(u / u_scale, np.where(still, 0.0, y / y_scale), psi) for u, y, psi in segments]
    step = basis.omega * basis.sample_time
    return Samples(segments, means, (u_scale, y_scale), facts, step)


def identify(data, settings, experiment):
    """Identify a periodic innovations model from samples.

    Parameters
    ----------
    data : Samples
    settings : Settings
    experiment : Experiment

    Returns
    -------
    fit : SubspaceFit
    """
    if settings.weighting in ("n4sid", "cva"):
        raise ValueError(
            f"weighting={settings.weighting!r} with reading='sample': states are those of a "
            f"predictor there, whatever the weighting; leave weighting='moesp', or 'pbsid', or use "
            f"HarmonicAnalyzer(reading='period')"
        )
    choice, best, reason, tried = _Choice.of(data, settings, experiment.basis)
    layout, found = choice.layout, _Found.of(choice, best)
    if settings.order == "auto" and not searching():
        found = _or_simpler(found, choice)
    model, chosen = found.model, found.chosen
    for message in found.against:
        warn(message, IdentifiabilityWarning)
    warn_of_little(layout, choice.n_rows, chosen, experiment.basis)
    warn_of_growth(model, chosen, data, settings)
    x0 = np.array([choice.start(model.innovations, s) for s in range(len(data.segments))])
    floor = float(np.sqrt(layout.n_columns / max(choice.n_rows, 1)))
    return SubspaceFit(
        model,
        x0,
        layout.n_lags,
        chosen.order,
        choice.states.singular_values,
        floor,
        reason,
        tried,
        doubt=0.0 if model.opinion is None else model.opinion.doubt(model.exponents()),
        degrees=found.degrees,
    )


def opinion(experiment):
    """The closed form's exponents, known as well as the halves of the record have them.

    Returns
    -------
    opinion : Opinion or None
        None where they tell none, or the closed form is unstable.
    """
    settings = Settings()
    data, basis = read(experiment, settings), experiment.basis
    choice, best, *_ = _Choice.of(data, settings, basis, steps=False)
    model = _Found.of(choice, best).model
    if model.opinion is None or not best.stable:
        return None
    return model.opinion.of(model.exponents(), "the samples have")


@dataclass(frozen=True, eq=False)
class _Found:
    """A model after steps of its likelihood, and what speaks against it.

    Attributes
    ----------
    chosen : Simulated
        What it was chosen by.
    left : Simulated
        What it leaves after the steps.
    model : SampleModel
    no_noise : str
        Why what it leaves is no noise, "" if it is.
    unconfirmed : str
        What the second opinion does not confirm, "" if it confirms all.
    lasts : bool
        Whether a turn leaves something of every mode: others may stand for noise.
    degrees : tuple of int
        Of products of states and inputs that are further inputs; empty where they do not pay.
    bic_of_predictions : float
        With products; infinite without them.
    """

    chosen: Simulated
    left: Simulated
    model: SampleModel
    no_noise: str
    unconfirmed: str
    lasts: bool
    degrees: tuple = ()
    bic_of_predictions: float = np.inf

    @property
    def against(self):
        """What speaks against it."""
        return [words for words in (self.no_noise, self.unconfirmed) if words]

    def serves_for(self, other):
        """Whether nothing speaks against it, and it leaves as little or has modes of the other.

        A mode between two that are too near for the record to tell is neither of them.
        """
        if self.against or self.left.variance <= AS_LITTLE * other.left.variance:
            return not self.against
        exponents, omega = other.model.exponents(), other.model.omega
        known = Opinion(exponents, np.zeros(len(exponents)), omega, "")
        return bool(np.all(known.about(self.model.exponents())[1] <= DOUBT))

    @classmethod
    def of(cls, choice, chosen, most_left=np.inf):
        """The model of one of the orders and numbers of harmonics tried; None if it leaves more."""
        data, basis, layout = choice.data, choice.basis, choice.layout
        refined = choice.refined(choice.whole(chosen), chosen.stable)
        innovations = refined.innovations
        left = choice.compared(chosen.order, chosen.n_harmonics, innovations)
        if not left.variance <= most_left:
            return None
        model = SampleModel(
            refined.at_rest.in_units(*data.scales).about(*data.means).about_orbit(),
            basis.omega,
            basis.sample_time,
            basis.input_signals,
            basis.output_labels,
            layout.feedthrough,
            basis.most_loads,
            data.means[0],
            data.trim_in_inputs,
        )
        unconfirmed, lasts, no_noise = "", True, "" if searching() else refined.no_noise
        if not searching() and basis.samples_per_period <= MOST_ROWS_A_TURN:
            exponents = model.exponents()
            lasts = bool(lasting(exponents, basis.omega).all())
            halves = _of_halves(model, choice, chosen, refined)
            opinions = [halves, *_of_its_likelihood(refined, data, basis.omega)]
            if refined.degrees:  # whose exponents are those of small motions
                opinions = [*opinions[1:], halves]
            model = replace(model, opinion=more_doubtful(exponents, *opinions))
            unconfirmed = why_unconfirmed(exponents, model.opinion)
        bic = choice.bic_of_predictions(chosen, refined)
        return cls(chosen, left, model, no_noise, unconfirmed, lasts, refined.degrees, bic)


def _or_simpler(found, choice):
    """A model of fewer states that serves for one in doubt, or is better by the criterion.

    After steps of the likelihood: before them, a model of as many states as the machine may leave
    more than one of too many. Without products, states stand for the second order of the response:
    where these pay, the criterion of predictions beside them comes first. An unstable model was
    simulated in pieces, and is not compared.
    """
    most_left = max(AS_LITTLE * found.left.variance, LITTLE)
    simpler = (
        _Found.of(choice, one, np.inf if found.degrees else most_left)
        for one in islice(choice.simpler(found.chosen, STEPS_GAIN * most_left), MOST_SIMPLER)
    )
    if found.degrees:
        simpler = list(simpler)
        found = min([found, *simpler], key=lambda one: one.bic_of_predictions)
    if not found.against and found.lasts:
        return found
    rivals = [found]
    for one in simpler:
        if one is None or one.chosen.order >= found.chosen.order or one.left.variance > most_left:
            continue
        if one.serves_for(found):
            return one
        if found.against and found.left.stable and not one.no_noise:
            rivals.append(one)
    return min(rivals, key=lambda rival: rival.left.bic)


def _of_halves(model, whole, chosen, refined):
    """Exponents of the two halves of a record, of the same order, lags and harmonics.

    Each half has as much of the outputs' motion: of a record that is at rest for long, and of a
    chirp, half of the rows may tell nothing. None where a half is too short for the predictor, or
    one turn does not tell exponents apart.
    """
    data, layout = whole.data, whole.layout
    ends = np.cumsum([len(y) for _, y, _ in data.segments])
    motion = np.cumsum(np.concatenate([np.sum(y**2, axis=1) for _, y, _ in data.segments]))
    least = layout.n_columns + len(ends) * layout.n_lags
    middle = np.searchsorted(motion, 0.5 * motion[-1])
    middle = int(np.clip(middle, min(least, ends[-1] // 2), max(ends[-1] - least, ends[-1] // 2)))
    halves, exponents = [[], []], []
    for segment, stop in zip(data.segments, ends, strict=True):
        cut = int(np.clip(middle - (stop - len(segment[1])), 0, len(segment[1])))
        for half, rows in zip(halves, (slice(0, cut), slice(cut, None)), strict=True):
            part = tuple(z[rows] for z in segment)
            half += [part] if len(part[1]) > 2 * layout.n_lags else []
    for segments in halves:
        if rows_told(replace(data, segments=segments), layout.n_lags) < layout.n_columns:
            return None
        half = replace(data, segments=segments)
        fixed = replace(whole.settings, order=chosen.order)
        sums = LagSums.of(segments, layout)
        choice = _Choice(half, sums, fixed, whole.basis, whole.steps)
        found = choice.model(choice.sums, chosen.order, chosen.n_harmonics)
        found = choice.refined(found, chosen.stable, refined.degrees)
        exponents.append(replace(model, innovations=found.innovations).exponents())
    omega = whole.basis.omega
    return of_halves(model.exponents(), exponents, omega, data.duration(omega))


def _of_its_likelihood(refined, data, omega):
    """Where a further step of its likelihood leads the exponents, and steps on smaller motions.

    Where steps have not come to an end, and where products have not taken up all by which a
    machine is not linear, that is elsewhere. Beside products its deviations are the model's own.
    """
    scale, about = omega / (2.0 * np.pi), {"duration": data.duration(omega)}
    small = refined.small
    if small is None:
        if refined.ahead is not None:
            way = "a further step of its likelihood has"
            yield Opinion(*(scale * each for each in refined.ahead), omega, way, **about)
        return
    about["of_small_motions"] = True
    own = (scale * each for each in refined.ahead)
    yield Opinion(*own, omega, "small motions have", own=True, **about)
    if small.of_smaller is not None:
        smaller = (scale * each for each in small.of_smaller)
        yield Opinion(*smaller, omega, "the smaller motions of the record have", **about)


# ---- states and matrices ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _States:
    """States of every row, of more orders than one: the first n columns are those of order n.

    Attributes
    ----------
    parts : list of (first, x, e)
        Of each segment: its first row with a state, states, and innovations (n_rows, l).
    singular_values : ndarray
    covariance : ndarray, shape (l, l)
    bound : int
        The most states that there are.
    """

    parts: list
    singular_values: np.ndarray
    covariance: np.ndarray
    bound: int

    @classmethod
    def of(cls, data, predictor, settings, noise):
        """States that a predictor makes of the data, whose outputs have some noise at least."""
        layout, n_outputs = predictor.layout, data.n_outputs
        asked = 1 if settings.order == "auto" else settings.order
        n_future = layout.n_lags
        bound = n_future * n_outputs
        if asked > bound:
            raise ValueError(
                f"order={asked} exceeds the {bound} that {layout.n_lags} lags with {n_outputs} "
                f"output(s) tell; lower order or raise block_rows"
            )
        root = linalg.cholesky(_with_noise(predictor.covariance, noise), lower=True)
        white = np.kron(np.eye(n_future), linalg.inv(root).T)
        known = [futures_known(segment, predictor, n_future) for segment in data.segments]
        gram = sum(white.T @ (ahead.T @ ahead) @ white for _, ahead in known)
        values, vectors = linalg.eigh(gram / sum(len(ahead) for _, ahead in known))
        n = min(bound, max(asked, MOST_STATES))
        V = white @ vectors[:, ::-1][:, :n]
        parts = []
        for (first, ahead), (u, y, psi) in zip(known, data.segments, strict=True):
            rows = slice(first, first + len(ahead))
            e = y[rows] - ahead[:, :n_outputs] - evaluate_harmonics(predictor.loads, psi[rows])
            if layout.feedthrough:
                e -= np.einsum("til,ti->tl", evaluate_harmonics(predictor.D, psi[rows]), u[rows])
            parts.append((first, ahead @ V, e))
        singular_values = np.sqrt(np.maximum(values[::-1], 0.0))
        return cls(parts, singular_values, predictor.covariance, n)

    def rows(self, data, order, some=True):
        """States, next states, inputs, outputs, innovations and azimuths, of some order.

        Of the rows that choices are made on, or of all.
        """
        whole = [(s, slice(0, len(y))) for s, (_, y, _) in enumerate(data.segments)]
        for s, rows in compared_rows(data.segments) if some else whole:
            first, x, e = self.parts[s]
            u, y, psi = data.segments[s]
            start, stop = max(rows.start, first), min(rows.stop, first + len(x) - 1)
            if stop > start:
                rows, own = slice(start, stop), slice(start - first, stop - first)
                following = x[own.start + 1 : own.stop + 1, :order]
                yield x[own, :order], following, u[rows], y[rows], e[own], psi[rows]


def _with_noise(covariance, noise=SENSOR_NOISE):
    """A covariance of outputs with some noise added, that of a sensor by default."""
    return covariance + noise**2 * np.eye(len(covariance))


@dataclass(frozen=True, eq=False)
class _Refined:
    """A model after steps of its likelihood.

    Attributes
    ----------
    innovations : PeriodicInnovations
    ahead : (ndarray, ndarray), or None
        Where a further step leads the logarithms of its multipliers, and their deviations; None
        without steps.
    no_noise : str
        Why what a linear model leaves is no noise, "" if it is.
    small : SmallMotions or None
        Where products of states and inputs pay; their linear part is the model then.
    """

    innovations: PeriodicInnovations
    ahead: tuple | None = None
    no_noise: str = ""
    small: SmallMotions | None = None

    @property
    def at_rest(self):
        """The model with the loads of a machine at rest."""
        return self.innovations if self.small is None else self.small.at_rest

    @property
    def degrees(self):
        """Of products that are further inputs."""
        return () if self.small is None else self.small.degrees


class _Choice:
    """The order and the harmonics of the matrices, by what simulations of the record leave.

    ``steps`` says whether steps of the likelihood follow.
    """

    def __init__(self, data, sums, settings, basis, steps):
        layout = sums.layout
        self.data, self.settings, self.basis, self.steps = data, settings, basis, steps
        self.layout, self.n_rows, self.predictor = layout, sums.n_rows, sums.predictor()
        noise = SENSOR_NOISE if steps else LEAST_NOISE  # which steps take to be there, too
        self.states = states = _States.of(data, self.predictor, settings, noise)
        self.tried, self.possible = [], []
        most = min(MOST_STATE_HARMONICS, basis.most_harmonics)
        self.most = most if layout.n_harmonics else 0
        self.sums = self._sums(states.bound, self.most)
        self.simulated = list(_simulated(data.segments, layout.n_lags))
        total = sum(np.sum(y**2, axis=0) for _, y, _ in self.simulated)
        self.total = np.where(total > 0.0, total, 1.0)  # of an output at rest nothing is left

    @classmethod
    def of(cls, data, settings, basis, steps=True):
        """With lags and harmonics of the predictor that suit the data; the best model; why D is
        free or not; and all models tried, those with its D first."""
        layouts, reason = predictor_layouts(data, settings, basis)
        choices = [
            cls(data, LagSums.of(data.segments, layout), settings, basis, steps)
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
        if not best.stable:
            best = _as_fairly_compared(best, choices)
        choices.sort(key=lambda each: best not in each.tried)
        tried = tuple(one for each in choices for one in each.tried)
        return choices[0], best, reason.format("D free" if best.feedthrough else "D = 0"), tried

    def _sums(self, order, count, some=True):
        rows = self.states.rows(self.data, order, some)
        return StateSums.of(rows, count, self.basis.most_loads)

    @property
    def n_values(self):
        """Rows times outputs that are simulated."""
        return sum(y.size for _, y, _ in self.simulated)

    def best(self):
        """What the model of the least criterion leaves: a Simulated; None if none may be kept."""
        asked = self.settings.order
        orders = range(1, self.states.bound + 1) if asked == "auto" else [asked]
        found = None
        for order in orders:
            before = None
            for count in self._counts():
                innovations = self.model(self.sums, order, count)
                one = self.compared(order, count, innovations)
                self.tried.append(one)
                self.possible.append(innovations.is_possible())
                if before is not None and one.bic >= before.bic:
                    break
                before = one
            kept = self.kept()
            found = best_of(kept, self.n_values) if kept else None
            if found is not None and found.order <= order - PATIENCE:
                break
        return found

    def whole(self, chosen):
        """The model of some order and harmonics, of all rows."""
        order, count = chosen.order, chosen.n_harmonics
        return self.model(self._sums(order, count, some=False), order, count)

    def simpler(self, chosen, most_left):
        """Of each smaller order the best model tried, if it leaves little; the smallest first."""
        for order in range(1, chosen.order):
            kept = [one for one in self.kept() if one.order == order and one.stable]
            best = min(kept, key=lambda one: one.bic, default=None)
            if best is not None and best.variance <= most_left:
                yield best

    def refined(self, innovations, stable, degrees=None):
        """A model with the gain of its Kalman filter, after steps of its likelihood.

        Products of states and inputs are further inputs, of some degrees, or where they pay (None)
        and the linear predictor knows no more than they do: else states or harmonics are missing.
        If predictions leave less than the noise of a sensor, products are those of a simulation,
        where these take up half of what it leaves.

        Returns
        -------
        refined : _Refined
        """
        asked, count = self.basis.n_input_harmonics, innovations.n_harmonics
        layout = replace(self.layout, n_input_harmonics=count if asked is None else asked)
        most_growth = GROWN / self.data.longest if stable else np.inf
        start = innovations.filtered(self._noise(innovations))
        likelihood = self.data.segments, layout, SENSOR_NOISE, most_growth
        found = most_likely(start, *likelihood) if self.steps else None
        model, ahead = (start, None) if found is None else found
        small, about = None, (self.data.rest, degrees)
        if found is not None and degrees != ():
            small = of_small_motions(model, *likelihood, *about)
            if stable and self._is_exact((small or model).covariance):
                simulated = most_likely(replace(start, gain=0.0 * start.gain), *likelihood)
                if simulated is not None:
                    found = of_small_motions(simulated[0], *likelihood, *about, start.gain)
                    small = found or small
        compared, no_noise = (self.simulated, model, self.predictor), ""
        if degrees is None and (small is None or why_no_noise(*compared, small)):
            small, no_noise = None, why_no_noise(*compared)
        if small is None:
            return _Refined(model, ahead, no_noise)
        return _Refined(small.innovations, small.ahead, no_noise, small)

    def _is_exact(self, covariance):
        """Whether one-step predictions leave less of each output than the least noise of a sensor.

        Those of a model or of the predictor, whichever leave less of it.
        """
        least = np.minimum(np.diag(covariance), self.predictor.left)
        return bool(np.all(least <= SENSOR_NOISE**2))

    def kept(self):
        """Models to choose from: stable ones if asked for, and of them those of a machine."""
        both = zip(self.tried, self.possible, strict=True)
        kept = [pair for pair in both if pair[0].stable or not self.settings.stable]
        return [one for one, possible in kept if possible] or [one for one, _ in kept]

    def _noise(self, innovations):
        """Covariance of innovations, and of what is left of next states and of outputs."""
        n, total, n_rows = innovations.n_states, 0.0, 0
        for x, following, u, y, e, psi in self.states.rows(self.data, n):
            form = innovations.rows(psi)
            known = np.hstack([x, u, np.ones((len(u), 1))])[..., None]
            rest = following - (form.states @ known + form.gain @ e[..., None])[..., 0]
            noise = np.hstack([e, rest, y - (form.outputs @ known)[..., 0]])
            total, n_rows = total + noise.T @ noise, n_rows + len(noise)
        noise = total / n_rows
        n_outputs = self.data.n_outputs
        noise[-n_outputs:, -n_outputs:] = _with_noise(noise[-n_outputs:, -n_outputs:])
        return noise

    def _counts(self):
        """Numbers of harmonics tried, of which each has to better the one before."""
        first = self.layout.n_harmonics
        return sorted({first, *(min(k * first, self.most) for k in (2, 3)), self.most})

    def model(self, sums, order, count):
        asked = self.basis.n_input_harmonics
        coefficients, gain = sums.matrices(
            order,
            count,
            count if asked is None else min(count, asked),
            self.basis.most_loads,
            self.layout.feedthrough,
        )
        start = self.data.segments[0][2][0]
        covariance, step = self.states.covariance, self.data.step
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
        """The criterion of one-step predictions with products as inputs; infinite without."""
        small = refined.small
        if small is None:
            return np.inf
        n_rows = sum(len(y) for _, y, _ in self.data.segments)
        left = n_rows * np.linalg.slogdet(_with_noise(small.covariance))[1]
        return left + self._spent(chosen.order, chosen.n_harmonics, small.n_inputs, n_rows)

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
    rate = own.model(own.sums, unstable.order, unstable.n_harmonics).growth()
    innovations = choice.model(choice.sums, rival.order, rival.n_harmonics)
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
