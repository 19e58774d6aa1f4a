"""A second opinion: exponents of the same record, found in a way of their own.

The free decays of inputs that rest, or the two halves of a record whose inputs always move. Where
a model's exponents and these are apart, or these do not tell, neither is sure.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from sklearn_hd._checks import STANDARD_ERRORS
from sklearn_hd._fit_checks import longest_span
from sklearn_hd._guards import searching, warn
from sklearn_hd._records.data import lifted_periods, moving_periods
from sklearn_hd.algorithms.modes.free_decay import SURE, logarithms, periods_at_rest
from sklearn_hd.algorithms.periodic.multipliers import LASTING, LEAST_RATE
from sklearn_hd.exceptions import IdentifiabilityWarning

DOUBT = 0.1  # of a rate, within which it has to be known: an engineer has another answer beyond
WAY_OUT = (
    "use a longer record, smaller motions, less noise or another order, and check omega (rad/s)"
)


@dataclass(frozen=True, eq=False)
class Opinion:
    """Exponents, each known but for multiples of jω."""

    exponents: np.ndarray  # complex, (k,): 1/s
    deviations: np.ndarray  # (k,): standard deviations, 1/s
    omega: float  # rad/s
    way: str  # where they come from
    own: bool = False  # whether they are the model's, too: then their deviations are its own
    duration: float = np.inf  # seconds of the longest segment
    # whether exponents that it does not confirm are in doubt, not just those it contradicts
    needed: bool = False
    # whether it has every mode that lasts: more are too many, and those that it is sure of and a
    # model has not are missing
    complete: bool = False
    # whether a linear model of this record, whose motions are large, is off by what is apart
    of_small_motions: bool = False
    # (k,): real parts of the slowest that the record or its parts have for each; None of one whole
    slowest: np.ndarray | None = None

    def of(self, exponents, way):
        """The opinion that some exponents are, known as well as this one knows them."""
        return replace(self, exponents=exponents, way=way, own=False, slowest=None)

    def of_identified(self, exponents):
        """That exponents are as identified: what moves them has to say so."""
        known = np.zeros(len(exponents))
        return replace(self.of(exponents, "the map identified has"), deviations=known, own=True)

    def of_whole(self, exponents):
        """That exponents identified are all there are, each known as well as the nearest here."""
        known = self.of(exponents, "the map identified has")
        return replace(known, deviations=self.beside(exponents)[1], complete=True)

    def about(self, exponents):
        """The nearest exponent to each of some, its distance and deviation, in parts of its rate.

        The nearest one is shifted by a multiple of jω to the exponent's side.
        """
        apart, deviations = self.beside(exponents)
        size = _rates(exponents, self.omega)
        return exponents + apart, np.abs(apart) / size, deviations / size

    def doubt(self, exponents):
        """How far the least certain of some exponents may be off, in parts of its rate.

        Of those that last; 0 where none does.
        """
        exponents = np.asarray(exponents, complex)
        _, apart, spread = self.about(exponents)
        size = (apart + SURE * spread)[lasting(exponents, self.omega)]
        return float(np.max(np.nan_to_num(size, nan=np.inf), initial=0.0))

    @property
    def tells(self):
        """Whether it knows any mode that lasts to within its rate."""
        known = SURE * self.deviations < _rates(self.exponents, self.omega)
        return bool(np.any(known & lasting(self.exponents, self.omega)))

    def beside(self, exponents):
        """Where the nearest exponent to each of some is beside it, and its deviation, 1/s."""
        if not len(self.exponents):
            nowhere = np.full(len(exponents), np.inf)
            return nowhere + 0j, nowhere
        gap = self._gaps(exponents)
        k, rows = np.abs(gap).argmin(axis=1), np.arange(len(exponents))
        return gap[rows, k], self.deviations[k]

    def moves(self, exponents):
        """Whether one of some exponents that last is off by more than chance explains."""
        apart, deviations = self.beside(exponents)
        moved = np.abs(apart) > STANDARD_ERRORS * deviations
        return bool(np.any(moved & lasting(exponents, self.omega)))

    def _gaps(self, exponents):
        """From each of some exponents to each of its own, nearest of the multiples of jω."""
        gap = self.exponents - np.asarray(exponents)[:, None]
        return gap - 1j * self.omega * np.round(gap.imag / self.omega)

    def judges(self, exponents):
        """Which exponents it judges: those that last, or may by what it knows of the model's own.

        By the slowest that parts of the record have, of which all may forget a mode within a
        period and none may know how fast; by its deviations where there are no parts, or where
        all of these forget all modes.
        """
        slowest = np.real(exponents)
        if not self.own or not len(self.exponents):
            return lasting(slowest, self.omega)
        if self.slowest is not None:
            nearest = np.abs(self._gaps(exponents)).argmin(axis=1)
            lasts = lasting(np.maximum(slowest, self.slowest[nearest]), self.omega)
            if lasts.any():
                return lasts
        return lasting(slowest + SURE * self.beside(exponents)[1], self.omega)


def _rates(exponents, omega):
    """Decay rates that errors are compared with, 1/s."""
    return np.maximum(np.abs(exponents.real), LEAST_RATE * omega / (2.0 * np.pi))


def lasting(exponents, omega):
    """Which exponents are judged: a period leaves something of their motion."""
    return np.real(exponents) * 2.0 * np.pi / omega >= np.log(LASTING)


def decays_at_rest(experiment):
    """Outputs of the periods of free decay, in like units, and which periods they are.

    Outputs have shape (n_periods_s, samples_per_period, l), and the periods are given
    as pairs of a segment and a slice.
    """
    stretches = periods_at_rest(lifted_periods(experiment, experiment.inputs))
    lifted = moving_periods(experiment)
    return [lifted[s][rows] for s, rows in stretches], stretches


def of_free_decays(found, experiment, own=False):
    """The opinion of free decays; None where there are none."""
    if found is None:
        return None
    way = "the free decays at rest have"
    return of_multipliers(found.multipliers, found.deviations, experiment, way, own)


def of_multipliers(multipliers, deviations, experiment, way, own):
    """The opinion that multipliers are, with the standard deviations of their logarithms."""
    omega, longest = experiment.basis.omega, longest_span(experiment)
    rate = omega / (2.0 * np.pi)
    exponents = logarithms(multipliers) * rate
    return Opinion(exponents, deviations * rate, omega, way, own, longest)


def of_halves(exponents, halves, omega, duration):
    """The opinion of both halves of a record: the whole's exponents, known as well as the halves
    have one near to each.

    Of independent halves with parts f and 1 − f of what the whole knows to within σ,

        λ = f λ_1 + (1 − f) λ_2,
        E f |λ_1 − λ|² + (1 − f) |λ_2 − λ|² = E |λ_1 − λ| |λ_2 − λ| = σ².

    Both are larger where more than chance is between them. The first needs the parts, which are as
    1 / σ_1² and 1 / σ_2². It counts where both halves know an exponent to within its rate and are
    off by no more than their own deviations explain; else the larger does. If one half alone knows
    it so well, and chance explains how far off the other is, σ is no more than the deviation of
    that half, or its distance if larger.

    Each of ``halves`` has its exponents (n,) and their standard deviations, or None
    where it has no likelihood. The parts are equal if neither has one, and not known if
    one has none.
    """
    own, known = [], np.full((2, len(exponents)), np.inf)
    for deviations, (half, its) in zip(known, halves, strict=True):
        shifted = half + 1j * omega * np.round((exponents[:, None] - half).imag / omega)
        rows, columns = linear_sum_assignment(np.abs(exponents[:, None] - shifted))
        own.append(shifted[rows, columns])
        deviations[:] = np.inf if its is None else its[columns]
    apart, tells = np.abs(np.array(own) - exponents), SURE * known < _rates(exponents, omega)
    squares, by_chance = apart[0] * apart[1], apart <= STANDARD_ERRORS * known
    if sum(its is None for _, its in halves) != 1:
        with np.errstate(all="ignore"):
            parts = 1.0 / (1.0 + (known / known[::-1]) ** 2)
        parts = np.nan_to_num(parts, nan=0.5)  # of two that tell nothing
        weighted = np.sum(parts * apart**2, axis=0)
        both = np.all(tells & by_chance, axis=0)
        squares = np.where(both, weighted, np.maximum(weighted, squares))
    one = (tells.sum(axis=0) == 1) & np.all(tells | by_chance, axis=0)
    alone = np.max(np.where(tells, np.maximum(apart, known), 0.0), axis=0)
    spread = np.sqrt(np.where(one, np.minimum(squares, alone**2), squares))
    slowest = np.max(np.real([exponents, *own]), axis=0)
    pair = _conjugates(exponents, omega)  # halves may be near to either of a pair
    spread, slowest = np.hypot(spread, spread[pair]) / 2**0.5, np.maximum(slowest, slowest[pair])
    way = "the two halves of the record have"
    return Opinion(exponents, spread, omega, way, True, duration, slowest=slowest)


def _conjugates(exponents, omega):
    """Places of the conjugates of exponents, but for multiples of jω; their own where real."""
    gap = exponents.conj() - exponents[:, None]
    return np.abs(gap - 1j * omega * np.round(gap.imag / omega)).argmin(axis=1)


def doubtful(exponents, opinion):
    """Which exponents an opinion does not confirm.

    - It has to know them, and to agree: to DOUBT, distance and error apart where it is their own
      and not needed, together else. Of another way that is not needed, modes within its error
      pass, too; those within the record do if it does not know.
    - Of another way, it contradicts from DOUBT / 2 on if chance does not explain that. If it is
      complete, those that are more than it has are in doubt.
    - What does not change within the record is in doubt whatever else is known of it.

    What a period forgets is not judged, unless it may last by what is known of it.
    """
    _, apart, spread = opinion.about(exponents)
    error = SURE * spread
    if opinion.needed:
        sure = apart + error <= DOUBT
    elif opinion.own:
        sure = (apart <= DOUBT) & (error <= DOUBT)
    else:
        within = (np.abs(exponents.real) >= 1.0 / opinion.duration) & np.isfinite(apart)
        sure = np.where(error <= DOUBT, apart <= np.maximum(DOUBT - error, error), within)
    vague = ~sure | unchanging(exponents, opinion)
    if not opinion.own:
        vague |= apart > np.maximum(DOUBT / 2.0, STANDARD_ERRORS * spread)
        if opinion.complete:
            vague |= _too_many(exponents, apart, opinion)
    return vague & opinion.judges(exponents)


def unchanging(exponents, opinion):
    """Which modes neither decay nor grow within the record: a drift, or a tone, looks the same.

    Nor do those slower than the record whose rate is zero but for chance.
    """
    slowest = 1.0 / opinion.duration
    chance = STANDARD_ERRORS * opinion.beside(exponents)[1]
    return np.abs(exponents.real) < np.clip(chance, DOUBT * slowest, slowest)


def more_doubtful(exponents, *opinions):
    """Of several opinions that which doubts most of some exponents, the first of equals.

    Those that last come first.
    """

    def doubts(opinion):
        doubt = doubtful(exponents, opinion)
        return np.sum(doubt & lasting(exponents, opinion.omega)), np.sum(doubt)

    return max((each for each in opinions if each is not None), key=doubts, default=None)


def _too_many(exponents, apart, opinion):
    """Which exponents are more than the opinion has, those nearest to it counted first.

    Copies of one family, a multiple of jω apart, count once; each may be off by a doubt.
    """
    rates, counted, beyond = _rates(exponents, opinion.omega), [], np.zeros(len(exponents), bool)
    for i in np.argsort(apart):
        gap = exponents[counted] - exponents[i]
        gap = gap - 1j * opinion.omega * np.round(gap.imag / opinion.omega)
        if np.all(np.abs(gap) > 2.0 * DOUBT * rates[i]):
            beyond[i] = len(counted) >= len(opinion.exponents)
            counted += [] if beyond[i] else [i]
    return beyond


def missing(exponents, opinion):
    """Which of an opinion's exponents it is sure of, and no mode, nor the sum of two, is near."""
    if not opinion.complete or opinion.own:
        return np.zeros(len(opinion.exponents), bool)
    has = opinion.of_identified(np.append(exponents, _sums(exponents)))
    its, spread = opinion.exponents, opinion.deviations / _rates(opinion.exponents, opinion.omega)
    known = lasting(its, opinion.omega) & (SURE * spread <= DOUBT)
    return known & (has.about(its)[1] > np.maximum(DOUBT, STANDARD_ERRORS * spread))


def of_second_order(exponents, sure, opinion):
    """Which exponents are the sum of two that are sure: the square of a motion, and no mode."""
    return opinion.of_identified(_sums(sure)).about(exponents)[1] <= DOUBT


def _sums(exponents):
    return (exponents[:, None] + exponents).ravel()


def contradictions(exponents, opinion):
    """What a second opinion has against the exponents of a model: words, "" where it has nothing.

    Of those in doubt, of those that do not change within the record, and of those missing beside
    what is next to them, the worst is named. It says how many are known beside those in doubt.
    """
    nearest, apart, spread = opinion.about(exponents)
    doubt, words = doubtful(exponents, opinion), []
    still = doubt & unchanging(exponents, opinion)
    if still.any():
        k = int(np.argmin(np.where(still, np.abs(exponents.real), np.inf)))
        words.append(
            f"{int(still.sum())} of {len(exponents)} modes neither decay nor grow: the model has "
            f"{exponents[k]:.4g} 1/s, and {opinion.duration:.3g} s are only "
            f"{abs(exponents[k].real) * opinion.duration:.2g} of its time constants; it may be a "
            f"drift of the outputs, or a tone that no input makes"
        )
    if (doubt & ~still).any():
        k = int(np.argmax(np.where(doubt & ~still, apart + SURE * spread, -1.0)))
        words.append(
            f"{int(np.sum(doubt & ~still))} of {len(exponents)} exponents are in doubt: the model "
            f"has {exponents[k]:.4g} 1/s, {what_it_has(exponents, opinion, k)}"
        )
    lasts = lasting(exponents, opinion.omega)
    if doubt.any() and not np.any(doubt & lasts):  # by its own deviations alone
        words.append(f"as the model has them, a turn leaves less than {LASTING:g} of their motion")
    known = int(np.sum(lasts & ~doubt & (apart + SURE * spread <= DOUBT)))
    if doubt.any() and known:
        words.append(f"others known to within {DOUBT:.0%} of their rate: {known}")
    words.append(lacks(exponents, opinion, nearest[doubt]))
    return "; ".join(filter(None, words))


def what_it_has(exponents, opinion, k):
    """Words of what an opinion has beside one of some exponents."""
    nearest, apart, spread = (each[k] for each in opinion.about(exponents))
    error = SURE * spread
    size = error * _rates(exponents, opinion.omega)[k]
    if not np.isfinite(apart + size):
        return f"{opinion.way} nothing that confirms it"
    if apart <= spread and error > DOUBT:
        return f"{opinion.way} it only to within ± {size:.2g} 1/s"
    return f"{opinion.way} {_within(nearest, size)} 1/s nearest to it"


def lacks(exponents, opinion, told=()):
    """Words of the slowest exponent of an opinion that a model lacks, beside those told; or ""."""
    others = opinion.of_identified(np.asarray(told, complex)).about(opinion.exponents)[1]
    lacking = missing(exponents, opinion) & (others > DOUBT)
    if not lacking.any():
        return ""
    k = int(np.argmax(np.where(lacking, opinion.exponents.real, -np.inf)))
    beside = opinion.of_identified(exponents).about(opinion.exponents)[0][k]
    its = _within(opinion.exponents[k], SURE * opinion.deviations[k])
    return (
        f"the model lacks {int(lacking.sum())} of {len(lacking)} exponents: {opinion.way} "
        f"{its} 1/s, the model has {beside:.4g} 1/s nearest to it"
    )


def _within(exponent, error):
    """An exponent, and how far it may be off if it may."""
    return f"{exponent:.4g} ± {error:.2g}" if error > 0.0 else f"{exponent:.4g}"


def why_unconfirmed(exponents, opinion):
    """What of some exponents the second opinion does not confirm, and the way out; or "".

    Exponents are those of the model, in 1/s.
    """
    words = "" if opinion is None else contradictions(np.asarray(exponents, complex), opinion)
    return f"{words}; {WAY_OUT}" if words else ""


def warn_unconfirmed(exponents, opinion):
    """Warn of exponents that the second opinion does not confirm."""
    words = "" if searching() else why_unconfirmed(exponents, opinion)
    if words:
        warn(words, IdentifiabilityWarning)
