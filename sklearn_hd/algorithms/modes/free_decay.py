"""Multipliers of the Poincaré map of a machine whose inputs rest, from its free decays.

    y[k] = O Φ^k z_0 + c,   y[k]: all samples of period k, one row a period; c one for each decay

A machine that inputs hold away from its orbit is on another one, with multipliers of its own.
While it comes back, errors of the linear model die with the square of the motion. c is what the
trim is off by. The period reading needs it where a whole record is not that of one linear
system, and every reading of inputs that rest as a second opinion.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from scipy import linalg
from scipy.fft import dct

from sklearn_hd.algorithms.linalg.rounding import EPS, EXACT, TINY
from sklearn_hd.algorithms.periodic.multipliers import (
    PATIENCE,
    SURE,
    cost_of_a_state,
    is_noise,
    left_by,
    multiplier_deviations,
    orthonormal_range,
    outgrows_numbers,
    refine_multipliers,
    turned_back,
)
from sklearn_hd.algorithms.signals.trim import rests
from sklearn_hd.algorithms.subspace.order import order_by_wide_gap

AGREED = 0.05  # of a rate, within which fits of two orders have to know a mode, and have it alike
LIKE_A_PRODUCT = 0.25  # of a rate, within which fits of several products together lie
MOST_COLUMNS = 0.75  # of the periods, that regressors may be
LEAST_DECAY = 4  # periods for each state in decays that can stand alone
LEAST_AT_REST = 0.25  # of the periods, in records that end at rest
MOST_STATES = 12  # tried by order="auto": raw periods are simulated with each
ALIKE = 0.01  # of a rate, by which a product may miss two others
MOST_OF_SECOND_ORDER = 0.1  # of the decays' motion, rms
ENOUGH = 1e-3  # of a rate: modes known so well stay as they are, for products are weak
NOTHING_ELSE = 1e-4  # of what few modes leave, that more have to leave: noise is left by all
WEAK = 1e-2  # of the strongest direction: what is weaker may be of second order, if not noise
SLOW = 0.25  # of a mode's motion, left when half of the slowest one's is gone
LEAST_GONE = 0.05  # of a mode's motion, to tell what the rest of it leads to


@dataclass(frozen=True, eq=False)
class FreeDecay:
    """The modes that free decays show."""

    # (n, n): in the coordinates that outputs of a period have in the n directions they move in
    Phi: np.ndarray
    states: list  # (n_periods_s, n)
    multipliers: np.ndarray  # complex, (n,)
    # (n,): standard deviations of their logarithms. What they change by as the motion becomes
    # smaller counts, too: without the first period of each decay (all of it where more than noise
    # is left, else what is beyond the errors of the rest), and of slow modes until it is gone.
    deviations: np.ndarray
    turned: float = 0.0  # a negative multiplier that was turned back, 0 if none was
    # complex ndarray: multipliers of other motions in the decays, which are not the machine's own
    # modes
    beside: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=complex))

    def spread(self, n_deviations):
        """So many deviations; zero for none, also of what is not known at all (infinite)."""
        return n_deviations * self.deviations if n_deviations else np.zeros(len(self.deviations))


def periods_at_rest(inputs):
    """Periods of free decay: those at rest that follow on motion, or whole segments at rest.

    Where less than half of the periods rest, inputs pass the level of the rest as they pass others:
    only decays that end a segment count then. Inputs have shapes (n_periods_s,
    samples_per_period, m). Returns pairs (segment, slice) of two periods or more each.
    """
    stacked = np.concatenate(inputs)
    moved = np.abs(stacked - np.median(stacked, axis=0))
    largest = moved.max(axis=(0, 1), initial=0.0)
    energy = np.sum((moved / np.where(largest > 0.0, largest, 1.0)) ** 2, axis=(1, 2))
    edges = np.cumsum([len(u) for u in inputs])[:-1]
    most, found = rests(energy), []
    resting = most if most.any() else rests(energy, LEAST_AT_REST)
    for s, still in enumerate(np.split(resting, edges)):
        bounds = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
        for start, stop in zip(bounds[::2], bounds[1::2], strict=True):
            if stop - start > 1 and (stop == len(still) or (start > 0 and most.any())):
                found.append((s, slice(int(start), int(stop))))
    return found


def smooth_parts(decays):
    """Cosines of each period and output, without the fast ones that hold noise alone.

    Of decays (n_periods_s, samples_per_period, l), parts (n_periods_s, q). What a motion costs in
    parameters falls with the columns, so weaker motions can be told.
    """
    if not decays:
        return []
    cosines = [dct(y, axis=1, norm="ortho") for y in decays]
    about = np.vstack([c - c.mean(axis=0) for c in cosines])
    n_rows = len(about) - len(decays)
    kept = []
    for own in np.moveaxis(about, 2, 0):
        few, enough = 1, own.shape[1]
        while few < enough:
            half = (few + enough) // 2
            noise = n_rows > 1 and is_noise(own[:, half:], n_rows, own.shape[1] - half)
            few, enough = (few, half) if noise else (half + 1, enough)
        kept.append(enough)
    return [np.hstack([c[:, :k, j] for j, k in enumerate(kept)]) for c in cosines]


def offsets(decays, multipliers=()):
    """What each decay has of its own: a constant, which its level is off by, and other motions.

    There is one array a decay, (n_periods_s, c). ``multipliers`` are those of motions
    beside the modes, as a nonlinear response has them. They are left out if the decays
    are too few periods for so many columns.
    """
    first = np.asarray(multipliers, dtype=complex)
    first = first[first.imag >= 0.0]
    own, n_rows = np.eye(len(decays)), sum(map(len, decays))
    if len(decays) * (1 + np.sum(1 + (first.imag > 0.0))) > MOST_COLUMNS * n_rows:
        first = first[:0]
    columns = []
    for s, y in enumerate(decays):
        z = first ** np.arange(len(y))[:, None]
        motions = np.hstack([np.ones((len(y), 1)), z.real, z.imag[:, first.imag > 0.0]])
        columns.append(np.kron(own[s], motions))
    return columns


def free_decay(decays, order=None, compare=True):
    """The modes of some free decays; None where the decays are too short for any.

    Their number is that of a wide gap between the directions that outputs move in; else of the
    least Bayesian information criterion. Where that leaves more than noise, directions in which
    outputs move by less than a hundredth of the strongest are not counted: the second order of a
    nonlinear machine's response is of that size. Modes that fits of more states agree on then take
    their place, without products of others.

    ``decays`` hold outputs of whole periods, in like units, shapes (n_periods_s, q).
    ``order`` sets the number of modes; fits of more states are not looked at then.
    ``compare`` says whether to compare with the decays without their first periods.
    """
    if not decays:
        return None
    stacked = np.vstack(decays)
    n_rows, edges = len(stacked), np.cumsum([len(y) for y in decays])[:-1]
    most = min(MOST_STATES if order is None else order, n_rows // LEAST_DECAY, stacked.shape[1])
    about = np.vstack([y - y.mean(axis=0) for y in decays])
    if most < (order or 1) or not np.any(about):
        return None
    _, values, V = linalg.svd(about, full_matrices=False)
    ones = offsets(decays)
    orders, wide = [order], order_by_wide_gap(values, EXACT * values[0], most)
    if order is None:
        orders = range(1, most + 1) if wide is None else [wide]
    n_free, price = cost_of_a_state(ones, decays)
    rounding, best = EXACT**2 * float(np.sum(stacked**2)), None
    for n in orders:
        states = np.split(stacked @ V[:n].T, edges)
        Phi, turned = turned_back(refine_multipliers(_steps(states, ones), ones, decays))
        if outgrows_numbers(Phi, max(len(y) for y in decays)):
            continue  # no free decay
        left = left_by(Phi, ones, stacked)
        rss = max(float(np.sum(left**2)), rounding)
        bic = n_free * np.log(rss / n_free) + n * price
        if best is None or bic < best[0]:
            best = bic, n, Phi, states, left, turned
        elif n >= best[1] + PATIENCE:
            break
    if best is None:
        return None
    _, n, Phi, states, left, turned = best
    sizes = n_rows - len(decays) - n, left.shape[1]
    noise = np.sum(left**2) <= rounding or is_noise(left, *sizes)
    if len(orders) > 1 and not noise:
        told = int(np.sum(values > WEAK * values[0]))
        if n > told:
            return _agreed(free_decay(decays, told), decays)
        if n == most < MOST_STATES:
            return None  # there may be more
    found = FreeDecay(Phi, states, *multiplier_deviations(Phi, ones, decays), turned)
    if not compare:
        return found
    allowed = SURE if noise else 0.0
    moved = np.maximum(_changes(found, decays, 1, allowed), _until_no_motion(found, decays))
    found = replace(found, deviations=np.hypot(found.deviations, moved))
    return found if noise or order is not None else _agreed(found, decays)


def _changes(found, decays, start, n_deviations):
    """What logarithms change by without the first periods, beyond some deviations of the rest."""
    later = [y[start:] for y in decays if len(y) > start + 1]
    rest = free_decay(later, len(found.multipliers), False) if later else None
    if rest is None:
        return np.zeros(len(found.multipliers))
    gaps = apart(logarithms(found.multipliers), logarithms(rest.multipliers))
    return np.min(np.maximum(gaps - rest.spread(n_deviations), 0.0), axis=1)


def _until_no_motion(found, decays):
    """What logarithms of slow modes change by until the motion is gone, if they go with it.

    By their change once half of the slowest one's motion is gone, or in half of the longest decay.
    A motion that hardly shrinks tells nothing of smaller ones.
    """
    size, half = np.abs(found.multipliers), max(map(len, decays)) // 2
    slowest = np.clip(np.max(size), TINY, 1.0 - EPS)
    start = int(np.clip(np.log(0.5) / np.log(slowest), 1, max(half, 1)))
    left = size**start
    gone = np.abs(1.0 - left)
    moved = _changes(found, decays, start, SURE) / np.where(gone < LEAST_GONE, 1.0, gone)
    return np.where(left < SLOW, 0.0, moved)


def is_product(logs, factors, tolerance):
    """Which multipliers are products of two or three others, as second-order responses have them.

    ``logs``, (n,), and ``factors``, (k,), are logarithms of multipliers. ``tolerance``,
    (n,), says how far from a sum a logarithm may be, apart from multiples of 2πj.

    Examples
    --------
    >>> is_product(np.array([-0.6, -0.8 + 1j, -0.5]), np.array([-0.3, -0.5 + 1j]), 1e-9).tolist()
    [True, True, False]
    """
    two = (factors[:, None] + factors).ravel()
    sums = np.concatenate([two, (two[:, None] + factors).ravel()])
    return apart(logs, sums).min(axis=1, initial=np.inf) <= tolerance


def apart(logs, others):
    """Distances (n, k) of logarithms of multipliers, apart from multiples of 2πj."""
    gaps = np.atleast_1d(logs)[:, None] - others
    return np.abs(gaps.real + 1j * ((gaps.imag + np.pi) % (2.0 * np.pi) - np.pi))


def without_products(found, decays):
    """The modes of free decays of a nonlinear machine, without its second-order responses.

    These are products of two or three other modes, to 1 % of their rate, and weak: without one,
    the others leave less than a hundredth of the decays' energy. If one is surely such a product,
    others are that may be within two standard deviations. Weak modes in whose place squares of the
    others explain the decays stay, and are known no better than such products are told
    apart. Decays are as for :func:`free_decay`. Of a linear machine such modes would be
    its own.
    """
    ones, stacked = offsets(decays), np.vstack(decays)
    sure, known = _products(found, ALIKE), np.vstack(ones)
    sure &= found.deviations <= ALIKE * np.abs(logarithms(found.multipliers).real)
    least = np.sum((stacked - known @ linalg.lstsq(known, stacked)[0]) ** 2)
    least *= MOST_OF_SECOND_ORDER**2
    at = 0
    while sure.any() and at < len(found.multipliers):  # the fastest first
        i = np.argsort(np.abs(found.multipliers))[at]
        few = _without(found, _pair(found, i))
        drop = len(few.Phi) and _products(found, ALIKE, SURE)[i]
        if drop and np.sum(left_by(few.Phi, ones, stacked) ** 2) <= least:
            found, at = few, 0
        else:
            at += 1
    like = np.flatnonzero(_products(found, LIKE_A_PRODUCT))
    unknown = [i for i in like if _like_squares(found, i, decays, least)]
    spread = found.deviations.copy()
    spread[unknown] += LIKE_A_PRODUCT * np.abs(logarithms(found.multipliers).real[unknown])
    return replace(found, deviations=spread)


def _like_squares(found, i, decays, least):
    """Whether a mode is weak, and squares of the others explain the decays as well as it does."""
    few, ones, stacked = _without(found, _pair(found, i)), offsets(decays), np.vstack(decays)
    if not len(few.Phi) or np.sum(left_by(few.Phi, ones, stacked) ** 2) > least:
        return False
    states = np.vstack([_smooth(few.Phi, x) for x in few.states])
    states = states / np.sqrt(np.mean(states**2, axis=0))
    squares = [states[:, [i]] * states[:, i:] for i in range(states.shape[1])]
    Q = orthonormal_range(np.hstack([np.vstack(ones), states, *squares]))
    n_free = len(stacked) - Q.shape[1]
    if n_free < (1.0 - MOST_COLUMNS) * len(stacked):
        return False
    by_squares = np.sum((stacked - Q @ (Q.T @ stacked)) ** 2) / n_free
    own = np.sum(left_by(found.Phi, ones, stacked) ** 2)
    own /= len(stacked) - len(decays) - len(found.Phi)
    chance = SURE * np.sqrt(2.0 / (n_free * stacked.shape[1]))
    return by_squares <= (1.0 + chance) * own


def _smooth(Phi, states):
    """States of a decay without noise: those of the best start, beside a constant."""
    n = len(Phi)
    powers = np.array([np.linalg.matrix_power(Phi, k) for k in range(len(states))])
    known = np.hstack([powers.reshape(-1, n), np.tile(np.eye(n), (len(states), 1))])
    return powers @ linalg.lstsq(known, states.ravel())[0][:n]


def _pair(found, i):
    """A mode and its conjugate."""
    z = found.multipliers
    return np.unique([i, np.abs(z - z[i].conj()).argmin()])


def _agreed(found, decays):
    """The modes that fits of two successive orders agree on, if none that was found is lost.

    Of a machine that is not linear, products of its modes are modes of its free decays, too. Fits
    of few states are off by these, fits of many have them as modes of their own, and others that
    are different in each fit. Products of slower ones are left out; a new mode is one if it may be
    one. Deviations are at least what the two fits differ by, and the square of what they were, in
    parts of the rate: the next order of what is not linear. If the two fits know the modes found
    less well, these stay. One that the two do not have is known no better than their
    nearest. ``found`` has as many states as the directions that count; None stays None.
    """
    if found is None or _known(found, ENOUGH).all():
        return found
    fits = _of_more_states(found, decays)
    alike = [_alike(fit, more) for fit, more in pairwise(fits)]
    most = max(alike, key=lambda fit: (len(fit.Phi), -fit.deviations.sum()), default=None)
    if most is None or not len(most.Phi):
        return found
    before, logs = (logarithms(each.multipliers) for each in (found, most))
    rates, gaps = np.abs(before.real), apart(before, logs)
    off, nearest = gaps.min(axis=1), gaps.argmin(axis=1)
    kept = off <= AGREED * rates
    share = np.full(len(logs), AGREED)
    share[nearest[kept]] = ALIKE
    products = _products(most, share, SURE, of_slower=True)
    worse = np.sum(most.deviations[nearest[kept]]) > np.sum(found.deviations[kept])
    worse |= np.any(_known(found) & ~kept)
    if worse or np.sum(~products) < np.sum(~(kept & products[nearest])):
        return replace(found, deviations=np.maximum(found.deviations, np.where(kept, 0.0, off)))
    deviations = most.deviations.copy()
    np.maximum.at(deviations, nearest[kept], (found.deviations**2 / np.maximum(rates, TINY))[kept])
    return _without(replace(most, deviations=deviations), np.flatnonzero(products))


def _of_more_states(found, decays):
    """Fits that leave no more than 1e-4 of what was left: where that is noise, none does."""
    ones, stacked = offsets(decays), np.vstack(decays)
    most_left = NOTHING_ELSE * np.sum(left_by(found.Phi, ones, stacked) ** 2)
    fits = []
    for order in range(len(found.Phi) + 1, MOST_STATES + 1):
        fit = free_decay(decays, order, False)
        if fit is not None and np.sum(left_by(fit.Phi, ones, stacked) ** 2) <= most_left:
            fits.append(free_decay(decays, order))
    return fits


def _alike(fit, more):
    """The modes of a fit that one of more states has, too, known no better than these agree."""
    logs, others = (logarithms(each.multipliers) for each in (fit, more))
    off = apart(logs, others[_known(more)]).min(axis=1, initial=np.inf)
    fit = replace(fit, deviations=np.hypot(fit.deviations, off))
    stays = _known(fit)
    for i in np.argsort(-fit.deviations):  # of two that may be one, the surer stays
        rest = np.delete(logs, i)[np.delete(stays, i)]
        if apart(logs[[i]], rest).min(initial=np.inf) <= fit.spread(SURE)[i]:
            stays[_pair(fit, i)] = False
    return _without(fit, np.flatnonzero(~stays))


def _known(found, share=AGREED):
    """Which modes are known to a share of their rate, each by its deviation."""
    return SURE * found.deviations <= share * np.abs(logarithms(found.multipliers).real)


def logarithms(multipliers):
    """Logarithms, complex; those of zero are finite."""
    return np.log(np.where(multipliers == 0.0, TINY, multipliers).astype(complex))


def _products(found, share, n_deviations=0.0, of_slower=False):
    """Which modes are products of others, or of slower ones, within a share of their rate (each its
    own, perhaps) or some deviations."""
    logs = logarithms(found.multipliers)
    within = np.maximum(share * np.abs(logs.real), found.spread(n_deviations))
    others = logs[:, None].real < logs.real if of_slower else ~np.eye(len(logs), dtype=bool)
    each = zip(logs, others, within, strict=True)
    return np.array([is_product(own, logs[some], off)[0] for own, some, off in each])


def _without(found, dropped):
    """The modes without some of them, which are motions beside them then."""
    values, V = linalg.eig(found.Phi)
    stays = ~np.isin(np.abs(values[:, None] - found.multipliers).argmin(axis=1), dropped)
    first = values.imag >= 0.0  # of each pair
    spans = [
        np.stack([v.real, v.imag][: 1 + (w > 0.0)], axis=1)
        for v, w in zip(V.T[first], values[first].imag, strict=True)
    ]
    columns = np.repeat(stays[first], [span.shape[1] for span in spans])
    basis = np.hstack(spans)
    to_modal = linalg.inv(basis)
    Phi = (to_modal @ found.Phi @ basis)[np.ix_(columns, columns)]
    states = [x @ to_modal.T[:, columns] for x in found.states]
    rest = [np.delete(each, dropped) for each in (found.multipliers, found.deviations)]
    turned = found.turned if np.any(np.isclose(rest[0], -found.turned)) else 0.0
    beside = np.append(found.beside, found.multipliers[dropped])
    return FreeDecay(Phi, states, *rest, turned, beside)


def _steps(states, ones):
    """Φ of least squares from period to period, beside the constants."""
    before = np.vstack([np.hstack([x, c])[:-1] for x, c in zip(states, ones, strict=True)])
    after = np.vstack([x[1:] for x in states])
    return linalg.lstsq(before, after)[0][: states[0].shape[1]].T
