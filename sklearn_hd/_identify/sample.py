"""``reading="sample"``: a periodic innovations model of samples at their azimuths.

1. The forced periodic means of inputs and outputs are taken out, and signals brought to like size.
2. A periodic predictor by ridge regression; its lags and harmonics by Akaike's criterion.
3. States by a singular value decomposition of what it knows of the outputs to come, in coordinates
   that are constant or turn with the azimuth.
4. Matrices, K and loads by least squares; order and harmonics by simulation (Schwarz's criterion).
5. Steps of the likelihood from there, with a gain or without, bring back what the lags have lost.
6. Products of states and inputs as further inputs, where a linear model does not hold.
7. One state more or fewer, where that serves as well after these steps; modes that it does not
   need are truncated. Without products, or stable, where a model in doubt does not simulate.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sklearn_hd._checks import DECISIVE, LITTLE, STANDARD_ERRORS
from sklearn_hd._fit_checks import check_motion, warn_of_thinning
from sklearn_hd._frame import SampleModel
from sklearn_hd._guards import held_back, searching, warn
from sklearn_hd._identify.sample_models import Choice, rows_told
from sklearn_hd._identify.stages import (
    MOST_PREDICTOR_ROWS,
    Settings,
    SubspaceFit,
    check_outputs_move,
    check_told_from_loads,
    check_turns,
    root_mean_square,
    warn_of_growth,
    warn_of_little,
)
from sklearn_hd._identify.statistics import Facts
from sklearn_hd._opinion import DOUBT, Opinion, lasting, more_doubtful, of_halves, why_unconfirmed
from sklearn_hd._readings import SampleBasis
from sklearn_hd._residuals import why_coloured, why_incomplete
from sklearn_hd._simulators import sample_simulators, without_gain
from sklearn_hd.algorithms.likelihood.small_motions import AS_LITTLE
from sklearn_hd.algorithms.linalg.rounding import EPS, EXACT, HALF
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_predictor import LagSums, forced_mean
from sklearn_hd.algorithms.signals.fourier import MOST_ROWS, mean_square
from sklearn_hd.algorithms.subspace.order import Simulated
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning

MOST_ROWS_A_TURN = 200  # whose multipliers take no time to find and to sort
STEPS_GAIN = 10.0  # of what a closed form leaves, at most, over what steps of likelihood leave
ABOUT_MEAN = (
    "the machine is not linear, and its orbit at rest (inputs at zero, or at their mean where that "
    "is larger than their motion) is not to be had from the record: the model is about the mean "
    "motion; let the motion pass the orbit at rest, or move the inputs about zero"
)
TOO_LARGE = (
    "products of states and inputs predict better than a linear model, but their linear part does "
    "not simulate the record: the machine is not linear and its motions are too large to tell the "
    "small ones, or states are missing; the model is one linear model of the whole record; use "
    "smaller motions, or raise order="
)
POWERS = {2: "squares", 3: "cubes"}
MOST_LEFT = 0.5  # of the outputs' variance, that a model of small motions in doubt may leave


@dataclass(frozen=True, eq=False)
class Samples:
    """Segments of a record about their forced periodic means, in like units."""

    segments: list  # of (inputs, outputs, psi)
    # (ndarray, ndarray): Fourier coefficients of what was taken out of inputs and outputs
    means: tuple
    scales: tuple  # (ndarray, ndarray)
    facts: Facts
    step: float  # radians from row to row, the mean

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
        """Whether the inputs' periodic mean is larger than their motion about it."""
        return bool(np.any(self._trimmed))

    @property
    def rest(self):
        """Inputs of a machine at rest, as Fourier coefficients: zero, or their mean."""
        return -np.where(self._trimmed, 0.0, self.means[0] / self.scales[0])

    @property
    def _trimmed(self):
        return np.sqrt(mean_square(self.means[0])) > self.scales[0]

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
    turn = basis.input_trim if basis.about_trim else means[0]
    waves = evaluate_harmonics(turn, np.linspace(0.0, 2.0 * np.pi, 4 * len(turn), endpoint=False))
    check_told_from_loads(waves, u_scale, experiment)
    taken = basis.output_trim if basis.about_trim else means[1]
    constant = taken.mean(axis=0) if basis.about_trim else taken[0]
    waves = taken - constant if basis.about_trim else taken[1:]
    still = HALF * np.max(np.abs(waves), axis=0, initial=0.0)  # what rounding of ψ leaves
    still = y_scale <= np.maximum(still, EXACT * np.abs(constant))
    check_outputs_move(still, facts)
    warn_of_thinning(experiment, taken)
    y_scale = np.where(still, 1.0, y_scale)
    segments = [(u / u_scale, np.where(still, 0.0, y / y_scale), psi) for u, y, psi in segments]
    step = basis.omega * basis.sample_time
    return Samples(segments, means, (u_scale, y_scale), facts, step)


def identify(data, settings, experiment):
    """Identify a periodic innovations model from samples."""
    if settings.weighting in ("n4sid", "cva"):
        raise ValueError(
            f"weighting={settings.weighting!r} with reading='sample': states are those of a "
            f"predictor there, whatever the weighting; leave weighting='moesp', or 'pbsid', or use "
            f"HarmonicAnalyzer(reading='period')"
        )
    found, reason, tried = _or_stable(*_chosen(data, settings, experiment.basis))
    choice, model, chosen = found.choice, found.model, found.chosen
    layout = choice.layout
    words = list(found.against)
    held = experiment.basis.hop == 1  # else inputs move between rows, which goes with inputs, too
    if held and not (searching() or found.refined.no_noise):
        words.append(why_incomplete(model, experiment, without_gain))
        little = found.left.variance <= LITTLE and not found.leaves_noise  # more may be gusts
        if little and not (any(words) or found.refined.degrees):
            words.append(why_coloured(model, experiment, sample_simulators))
    for message in filter(None, words):
        warn(message, IdentifiabilityWarning)
    left = found.left_at_rest if found.refined.degrees else chosen
    warn_of_little(layout, choice.n_rows, left, experiment.basis)
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
        degrees=found.refined.degrees,
        left=found.left.share**2,
    )


def opinion(experiment):
    """What the samples of a record have that is read otherwise.

    The closed form's exponents, known as well as the halves of the record have them. Its warnings
    are of another model than the one asked for.

    It is None where they tell none, the closed form is unstable, or the record would
    take more than some tenths of a second.
    """
    if sum(map(len, experiment.outputs)) > MOST_ROWS:
        return None
    settings, basis = Settings(), SampleBasis.of_others(experiment.basis)
    with held_back():
        try:
            data = read(replace(experiment, basis=basis, drive=experiment.inputs), settings)
            choice, best, *_ = Choice.of(data, settings, basis, steps=False)
            model = _Found.of(choice, best).model
        except ValueError:
            return None
    if model.opinion is None or not best.stable:
        return None
    return model.opinion.of(model.exponents(), "the samples have")


@dataclass(frozen=True, eq=False)
class _Found:
    """A model after steps of its likelihood, and what speaks against it, found when asked for."""

    choice: object  # Choice
    chosen: Simulated  # what it was chosen by
    refined: object  # Refined

    @classmethod
    def of(cls, choice, chosen):
        """The model of one of the orders and numbers of harmonics tried."""
        return cls(choice, chosen, choice.refined(choice.whole(chosen), chosen.stable))

    @cached_property
    def left(self):
        """What it leaves after the steps."""
        return self._left(self.refined.innovations)

    @cached_property
    def left_at_rest(self):
        """The same about the orbit of a machine at rest."""
        return self.left if self.refined.small is None else self._left(self.refined.at_rest)

    def _left(self, innovations):
        return self.choice.compared(self.chosen.order, self.chosen.n_harmonics, innovations)

    @cached_property
    def model(self):
        """A SampleModel, with a second opinion outside of searches."""
        data, basis, refined = self.choice.data, self.choice.basis, self.refined
        model = SampleModel(
            refined.at_rest.in_units(*data.scales).about(*data.means).about_orbit(),
            basis.omega,
            basis.sample_time,
            basis.input_signals,
            basis.output_labels,
            self.choice.layout.feedthrough,
            basis.most_loads,
            data.means[0],
            data.trim_in_inputs,
        )
        if not self._is_asked:
            return model
        halves = _of_halves(model, self.choice, self.chosen, refined)
        opinions = [halves, *_of_its_likelihood(refined, data, basis.omega)]
        # where several doubt alike, that of small motions counts: its distance widens deviations
        opinions.sort(key=lambda each: each is None or not each.of_small_motions)
        opinion, orbit = more_doubtful(model.exponents(), *opinions), refined.beside[2]
        off = None if orbit is None else orbit * data.scales[1]
        return replace(model, opinion=opinion, orbit_deviation=off)

    @property
    def _is_asked(self):
        return not searching() and self.choice.basis.samples_per_period <= MOST_ROWS_A_TURN

    @cached_property
    def against(self):
        """What speaks against it: what it leaves is no noise, the second opinion is another."""
        words = [] if searching() else [self.refined.no_noise]
        if self._is_asked:
            words.append(why_unconfirmed(self.model.exponents(), self.model.opinion))
        words = [each for each in words if each]
        small = None if words or searching() else self.refined.small
        return words if small is None or small.about_rest else [ABOUT_MEAN]

    @property
    def size(self):
        """Its number of states, and of harmonics."""
        return self.chosen.order, self.chosen.n_harmonics

    @property
    def lasts(self):
        """Whether a turn leaves something of every mode: others may stand for noise."""
        if not self._is_asked:
            return True
        return bool(lasting(self.model.exponents(), self.model.omega).all())

    @property
    def bic_of_predictions(self):
        """With products, or of their simulation."""
        return self.choice.bic_of_predictions(self.chosen, self.refined)

    @property
    def leaves_noise(self):
        """Whether its simulation leaves as little as one-step predictions of the predictor."""
        return self.choice.leaves_noise(self.left)

    def stands_beside(self, other):
        """Whether it may stand for the other where its criterion of predictions is lower.

        It has as many states, or its simulation leaves no more, or the other's exponents are in
        doubt, or they confirm its own.
        """
        alike = self.chosen.order == other.chosen.order
        no_more = self.left.variance <= other.left.variance
        if alike or no_more or other.against or other.model.opinion is None:
            return True
        known = other.model.opinion.of_whole(other.model.exponents())
        return not why_unconfirmed(self.model.exponents(), known)

    def lacks_harmonics_of(self, other):
        """Whether it has as many states and leaves far more beside products.

        Both may leave less than the noise of a sensor, below which the criterion of predictions
        sees no difference.
        """
        if self.chosen.order != other.chosen.order:
            return False
        own, less = (one.refined.large.covariance for one in (self, other))
        more = np.linalg.slogdet(own)[1] - np.linalg.slogdet(less)[1]
        return more > len(own) * np.log(DECISIVE)

    def serves_for(self, other):
        """Whether nothing speaks against it, and it leaves as little or has modes of the other.

        A mode between two that are too near for the record to tell is neither of them. Where the
        other leaves but noise, the criterion of simulations knows whether its states are there;
        where it leaves far less, they are. Of its harmonics the criterion always knows.
        """
        alike = self.chosen.order == other.chosen.order
        if self.against or ((alike or other.leaves_noise) and self.left.bic > other.left.bic):
            return False
        if self.left.variance <= AS_LITTLE * other.left.variance:
            return True
        if self.left.variance > DECISIVE * other.left.variance:
            return False
        exponents, omega = other.model.exponents(), other.model.omega
        known = Opinion(exponents, np.zeros(len(exponents)), omega, "")
        return bool(np.all(known.about(self.model.exponents())[1] <= DOUBT))


def _chosen(data, settings, basis):
    """The model of the best order after steps of its likelihood, the reason for its D, all tried.

    Outside of searches also others, where something speaks against that.
    """
    choice, best, reason, tried = Choice.of(data, settings, basis)
    found, others = _Found.of(choice, best), settings.order == "auto" and not searching()
    if others:
        found = _truncated(_or_fuller(found, choice), choice)
        found = _or_simpler(found, choice)
    linear = _or_linear(found)
    if others and linear is not found:
        linear = _or_fuller(linear, choice)
    return linear, reason, tried


def _or_stable(found, reason, tried):
    """A stable model for one in doubt that grows as no record in open loop does; as _chosen.

    By more than from rounding to the outputs. Large motions may look like that.
    """
    choice, asked = found.choice, found.choice.settings
    growth = choice.data.longest * found.refined.innovations.growth()
    feedback = asked.weighting == "pbsid"
    if growth <= -np.log(EPS) or feedback or searching() or not found.against:
        return found, reason, tried
    try:
        stable = _chosen(choice.data, replace(asked, stable=True), choice.basis)
    except ValueError:  # none of those tried is stable
        return found, reason, tried
    if stable[0].left.variance >= 1.0:
        return found, reason, tried
    warn(
        f"a model of {found.chosen.order} states explains the record best, but it is in doubt, and "
        f"it grows by e^{growth:.0f} over the longest segment, which no record in open loop does: "
        f"the best stable model takes its place; use smaller motions or give order=; if feedback "
        f"held the machine, give order=, weighting='pbsid', and criterion='prediction_error' in "
        f"StructuredMatcher",
        InstabilityWarning,
    )
    return stable


def _or_linear(found):
    """One linear model of all motions, if that of small ones is in doubt and simulates too little.

    The record's motions are too large to tell the small ones then, or states are missing.
    """
    if not (found.refined.degrees and found.against):
        return found
    linear = replace(found, refined=replace(found.refined, large=None, no_noise=TOO_LARGE))
    most = max(MOST_LEFT, 2.0 * linear.left.variance)
    return linear if found.left_at_rest.variance > most else found


def _or_fuller(found, choice):
    """A linear model of one state more that leaves but noise after steps of the likelihood, if any.

    Before them, closed forms may leave so much more than noise that the state pays for nothing, and
    products of the other states stand for it. Where these predict better, they do not.
    """
    if found.leaves_noise:
        return found
    more = [one for one in choice.kept() if one.order == found.chosen.order + 1 and one.stable]
    if not more:
        return found
    one, linear = min(more, key=lambda one: one.bic), replace(found.refined, large=None)
    fuller = _Found(choice, one, choice.refined(choice.whole(one), one.stable, linear))
    if not (fuller.leaves_noise and fuller.left.bic < found.left.bic):
        return found
    if found.refined.degrees and fuller.bic_of_predictions >= found.bic_of_predictions:
        return found
    return fuller


def _truncated(found, choice):
    """A linear model in doubt, truncated by the modes that it does not need.

    The mode that a simulation misses least is left out, and steps of the likelihood follow. If
    they leave more of the record than it did, or the criterion is not lower, it stays. What that
    leaves is no more like noise than before.
    """
    while found.against and found.left.stable and not found.refined.degrees:
        linear = replace(found.refined, large=None)
        fewer = choice.truncated(linear.linear, found.chosen.n_harmonics)
        if fewer is None:
            break
        one, start = fewer
        refined = choice.after_steps(start, one.stable, linear)
        one = _Found(choice, one, replace(refined, no_noise=linear.no_noise))
        if one.left.bic >= found.left.bic or one.left.variance > AS_LITTLE * found.left.variance:
            break
        found = one
    return found


def _or_simpler(found, choice):
    """A simpler model that serves for one in doubt, or is better by the criterion.

    It has fewer states, or as many and fewer harmonics. After steps of the likelihood: before
    them, a model of as many states as the machine may leave more than one of too many. Without
    products, states (and harmonics) stand for the second order of the response: where these pay,
    the criterion of predictions beside them comes first, unless nothing speaks against more states
    and they have other exponents. An unstable model was simulated in pieces, and is not compared.
    """
    most_left = max(AS_LITTLE * found.left.variance, LITTLE)
    simpler = (
        _Found.of(choice, one) for one in choice.simpler(found.chosen, STEPS_GAIN * most_left)
    )
    if found.refined.degrees:
        simpler, way = list(simpler), found.refined.simulates
        with_products = (one for one in simpler if one.refined.degrees)
        alike = (one for one in with_products if one.refined.simulates == way)
        alike = [found, *(one for one in alike if not one.lacks_harmonics_of(found))]
        alike.sort(key=lambda one: one.bic_of_predictions)
        found = next(one for one in alike if one.stands_beside(found))
    if not found.against and found.lasts:
        return found
    rivals = [found]
    for one in simpler:
        if not (one.size < found.size and one.left.variance <= most_left):
            continue
        if one.serves_for(found):
            return one
        small = one.refined.degrees or not found.refined.degrees  # a linear one has all motions
        if found.against and found.left.stable and small and not one.refined.no_noise:
            rivals.append(one)
    return min(rivals, key=lambda rival: rival.left.bic)


def _of_halves(model, whole, chosen, refined):
    """Exponents of the two halves of a record, of the same order, lags and harmonics.

    Each half has as much of the outputs' motion: of a record that is at rest for long, and of a
    chirp, half of the rows may tell nothing. If one half alone has rows enough for steps of the
    likelihood, it tells more than the other. None where a half is too short for the predictor, or
    one turn does not tell exponents apart.
    """
    data, layout = whole.data, whole.layout
    ends = np.cumsum([len(y) for _, y, _ in data.segments])
    motion = np.cumsum(np.concatenate([np.sum(y**2, axis=1) for _, y, _ in data.segments]))
    least = layout.n_columns + len(ends) * layout.n_lags
    middle = np.searchsorted(motion, 0.5 * motion[-1])
    middle = int(np.clip(middle, min(least, ends[-1] // 2), max(ends[-1] - least, ends[-1] // 2)))
    halves, found = [[], []], []
    for segment, stop in zip(data.segments, ends, strict=True):
        cut = int(np.clip(middle - (stop - len(segment[1])), 0, len(segment[1])))
        for half, rows in zip(halves, (slice(0, cut), slice(cut, None)), strict=True):
            part = tuple(z[rows] for z in segment)
            half += [part] if len(part[1]) > 2 * layout.n_lags else []
    omega = whole.basis.omega
    for segments in halves:
        if rows_told(replace(data, segments=segments), layout.n_lags) < layout.n_columns:
            return None
        half = replace(data, segments=segments)
        fixed = replace(whole.settings, order=chosen.order)
        sums = LagSums.of(segments, layout)
        choice = Choice(half, sums, fixed, whole.basis, whole.steps)
        choice.best()  # of that order: its coordinates
        one = choice.model(choice.sums(chosen.order), chosen.n_harmonics)
        one = choice.refined(one, chosen.stable, refined)
        exponents = replace(model, innovations=one.innovations).exponents()
        known = None if one.ahead is None else _ahead(one.ahead, data, omega).beside(exponents)[1]
        found.append((exponents, known))
    return of_halves(model.exponents(), found, omega, data.duration(omega))


def _of_its_likelihood(refined, data, omega):
    """Where a further step of its likelihood leads the exponents, and steps on smaller motions.

    Where steps have not come to an end, and where products have not taken up all by which a
    machine is not linear, that is elsewhere. Beside products its deviations are the model's own.
    Products of degrees that did not pay, or are too many, have a word where chance does not
    explain them, or how far they move an exponent. Distance and error count together then, since
    of what saturates they may take up but a part.
    """
    small = refined.small
    if small is not None:
        way = "small motions have"
        yield _ahead(refined.ahead, data, omega, way, own=True, of_small_motions=True)
        if small.of_smaller is not None:
            way = "the smaller motions of the record have"
            yield _ahead(small.of_smaller, data, omega, way, of_small_motions=True)
    elif refined.ahead is not None:
        yield _ahead(refined.ahead, data, omega, "a further step of its likelihood has")
    degrees, beside, _ = refined.beside
    if beside is not None:
        which = " and ".join(POWERS[degree] for degree in degrees)
        way = f"its likelihood beside {which} of the motion has"
        more = {"own": True, "of_small_motions": True, "needed": True}
        other, own = (
            _ahead(beside.ahead, data, omega, way, **more),
            _ahead(refined.ahead, data, omega),
        )
        if beside.beyond > STANDARD_ERRORS or other.moves(own.exponents):
            yield other


def _ahead(ahead, data, omega, way="", **more):
    """The opinion of a further step, which has logarithms of multipliers and their deviations."""
    exponents, deviations = (omega / (2.0 * np.pi) * each for each in ahead)
    return Opinion(exponents, deviations, omega, way, duration=data.duration(omega), **more)
