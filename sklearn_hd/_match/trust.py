"""Checks of the standard deviations of a fit: residual tests, and parts of the record.

What a nonlinear machine leaves is never white. Robust deviations, widened by what parts of the
record disagree on, and by what the second opinion is apart, allow for that. A model is in doubt
only where an exponent is then not known, the second opinion contradicts it, or what is left beside
noise is a part of the motion.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.stats import norm, t
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._checks import LITTLE, STANDARD_ERRORS
from sklearn_hd._guards import warn
from sklearn_hd._match import Uncertainty
from sklearn_hd._opinion import SURE, doubtful, lasting, what_it_has
from sklearn_hd._residuals import ALARM, remainder, scored
from sklearn_hd._simulators import sample_simulators, without_gain
from sklearn_hd.algorithms.likelihood.noisy_inputs import NoisyInputProblem
from sklearn_hd.algorithms.likelihood.predictor import simulate
from sklearn_hd.algorithms.likelihood.uncertainty import (
    blocks_in_time,
    by_direction,
    by_size,
    exponent_slopes,
    part_scores,
    propagate_std,
)
from sklearn_hd.algorithms.signals.trim import LEVEL
from sklearn_hd.exceptions import IdentifiabilityWarning, UnstableModelError

WORDS = {
    "size": "from small to large motions",
    "direction": "from one side of the motion to the other",
    "record": "from the first record to the last",
}
TIME_CONSTANTS = 50  # of the slowest mode in a record, below which intervals are short


def trusted(fit, experiment, sampled, parameters, settings, opinion):
    """The Uncertainty of a fit that holds even if its residuals are not white noise.

    ``sampled`` is the fitted model, ``parameters`` are all of the form, and the opinion is the
    second one of the record, or None. The covariance is that of the structure's parameters, then
    of free delays; there is no model yet.
    """
    result, places = fit.result, fit.places
    exponents, slopes = exponent_slopes(fit.form, parameters)
    k, n, own = len(places), len(slopes), fit.structure.n_parameters
    slopes = np.pad(slopes[:, :own], [(0, 0), (0, k - own)])
    plain = propagate_std(slopes, fit.covariance)
    into = np.eye(len(result.point.theta))[places] if fit.into is None else fit.into
    gradients = np.vstack([np.eye(k), slopes.real, slopes.imag]) @ into
    moves = gradients[k:] @ result.ahead.step(0.0)
    of_fit = result.sigma, result.aic, result.bic, exponents
    stopped = partial(_warn_of_steps, result, settings, exponents, moves, omega=fit.form.omega)
    if isinstance(result.problem, NoisyInputProblem):  # its parts answer for each other's inputs
        stopped(plain, 0.0)
        return Uncertainty(fit.covariance, *of_fit, plain)
    tests, part, alike = _tests(experiment, sampled)
    parts = part_scores(result, _divisions(result))
    white = result.system.covariance(gauge=True)[0] * result.correction
    robust = tests is not None and not tests["passed"].all()
    found = parts["time"].sandwich(white) if robust else white
    own, by_noise = (
        np.maximum(np.einsum("rk,kj,rj->r", gradients, C, gradients), 0.0) for C in (found, white)
    )
    own = np.maximum(own, by_noise)  # few blocks tell few things: never less than noise alone
    excess = np.maximum(1.0, own / np.where(by_noise > 0.0, by_noise, np.inf))
    more, apart = np.zeros(len(own)), {}
    for name in WORDS:
        comparison = parts[name].compared(white, gradients, excess)
        differ = comparison.p_value < LEVEL / (len(WORDS) * len(own))
        more = np.maximum(more, np.where(differ, comparison.variance, 0.0))
        apart[name] = comparison.offsets[k:], differ[k:]
    if robust and _coloured(tests.index[~tests["passed"]]):
        own[k:] *= np.tile(_of_few_parts(exponents, experiment) ** 2, 2)
    kind = "robust" if robust else "information"
    covariance = into @ found @ into.T
    variance = np.diag(covariance)
    wider = np.sqrt((own + more)[:k] / np.where(variance > 0.0, variance, np.inf))
    covariance = covariance * wider[:, None] * wider
    std = np.sqrt(own + more)[k:]
    std = np.where(np.isfinite(plain), std[:n] + 1j * std[n:], plain)
    std = _beside(std, exponents, opinion)
    stopped(std, part)
    systematic = _systematic(alike, experiment, sampled) if robust else 0.0
    doubt = _doubt(exponents, std, opinion, systematic)
    if doubt is None and robust and not tests["passed"].get("inputs", True):
        doubt = "what is left goes with earlier inputs, as the motion of a missing state does"
    if doubt and robust and np.all(more[k:] <= own[k:]):
        _warn_of_tests(tests, result.gain is None, doubt)
    elif doubt:
        _warn_of_parts(exponents, apart, own[k:], more[k:], doubt)
    known = np.isfinite(fit.covariance)
    covariance = np.where(known, covariance, fit.covariance)
    stored = None if tests is None else tests.reset_index().to_dict("list")
    return Uncertainty(covariance, *of_fit, std, kind=kind, tests=stored, doubt=doubt)


def _of_few_parts(exponents, experiment):
    """By how much exponents are known worse than blocks of a long record say, if noise moves them.

    Blocks shorter than a time constant are not independent. In a time T a mode has T |Re λ| / 2
    parts that are. With so many degrees of freedom Student's t replaces the normal deviate.
    """
    parts = 0.5 * np.abs(exponents.real) * sum(_spans(experiment))
    return t.ppf(norm.cdf(SURE), np.maximum(parts, 1.0)) / SURE


def _spans(experiment):
    """Seconds of each segment."""
    return [time[-1] - time[0] for time in experiment.times()]


def _beside(std, exponents, opinion):
    """Deviations of exponents, wider by what a second opinion is apart by more than both may err.

    A bias that all parts of a record share shows in no comparison of these. By all that it is
    apart where it is known that a linear model does not hold.
    """
    if opinion is None:
        return std
    apart, deviations = opinion.beside(exponents)
    told = np.abs(apart) > STANDARD_ERRORS * np.hypot(np.abs(std), deviations)
    told |= opinion.of_small_motions
    more = np.where(told & lasting(exponents, opinion.omega), apart, 0.0)
    wider = np.empty_like(std)  # 1j times infinity would be NaN
    wider.real, wider.imag = np.hypot(std.real, more.real), np.hypot(std.imag, more.imag)
    return wider


def _tests(experiment, sampled):
    """Residual tests, and the residuals' variance and the covariance of neighbours in parts of
    the motion's variance; None, and nothing, where there is nothing to test."""
    try:
        left = remainder(experiment, sample_simulators(sampled, experiment))
        return scored(left, None, ALARM), left.part_of_motion(), left.part_of_motion(lag=1)
    except (UnstableModelError, ValueError) as reason:  # it overflows, or rows are too few
        warn(
            f"the residuals of the fit could not be tested: {reason}; the standard deviations hold "
            f"only if the residuals are white noise",
            IdentifiabilityWarning,
        )
        return None, 0.0, 0.0


def _systematic(alike, experiment, sampled):
    """What a simulation leaves and is no noise, in parts of the motion's variance.

    Of white noise neighbouring samples have nothing in common. A predictor follows a machine that
    its model does not explain, so a model with a gain is simulated without it. What colours its
    residuals then is noise that moves the machine, and the other tests tell.
    """
    if not sampled.innovations.gain.any():
        return alike
    try:
        left = remainder(experiment, without_gain(sampled, experiment))
    except UnstableModelError:  # feedback holds it
        return 0.0
    tests = scored(left, None, ALARM)
    told = ~tests["passed"] & ~tests.index.str.startswith("autocorrelation")
    return left.part_of_motion() * tests["share"].where(told, 0.0).max()


def _doubt(exponents, std, opinion, systematic):
    """What of a model does not stand, whatever its residuals are, in words; None if it stands."""
    if systematic > LITTLE:
        return f"what is left and is no noise has {systematic:.3g} of the motion's variance"
    if opinion is None:
        return "no second opinion confirms the exponents"
    own = replace(opinion.of(exponents, opinion.way), deviations=np.abs(std), own=True)
    other = replace(opinion, own=False)
    spread, vague = own.about(exponents)[2], doubtful(exponents, own)
    if vague.any():
        k = np.argmax(np.where(vague, spread, 0.0))
        known = f"the exponent {exponents[k]:.4g} 1/s is known to"
        return f"{known} {SURE * spread[k]:.3g} of its rate, {SURE:.0f} standard deviations"
    _, gap, error = other.about(exponents)
    apart = doubtful(exponents, other)
    if apart.any():
        k = np.argmax(np.where(apart, gap + SURE * error, -1.0))
        return f"the model has {exponents[k]:.4g} 1/s, {what_it_has(exponents, other, k)}"
    return None


def _warn_of_steps(result, settings, exponents, moves, std, part, omega):
    """Warn of a search that stopped where another step would change the model."""
    if result.converged:
        return
    n, deviations = len(exponents), np.concatenate([std.real, std.imag])
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.where(moves == 0.0, 0.0, np.abs(moves) / deviations)
    steps = np.where(np.tile(lasting(exponents, omega), 2), steps, 0.0)
    more = result.ahead.promised / result.n_residuals * part
    if np.all(steps <= 1.0) and more <= LITTLE:
        return
    share = f"another {more:.2g}" if more < 1.0 else "more than all"  # if residuals were linear
    words = f"explain {share} of the motion's variance"
    if not np.all(steps <= 1.0):
        r = int(np.argmax(steps))
        words = (
            f"move the exponent {exponents[r % n]:.4g} 1/s by {abs(moves[r]):.2g} 1/s, "
            f"{steps[r]:.2g} of its standard deviations"
        )
    way = "raise max_iter"
    if result.n_iter < settings.max_iter:
        way = (
            "the start may have the wrong order or be unstable, or the record does not "
            "determine the parameters: change the order, or give numbers of harmonics, "
            "HarmonicStructure(F=..., G=...)"
        )
    warn(
        f"maximum likelihood stopped after {result.n_iter} iterations; another step would "
        f"{words}; {way}",
        ConvergenceWarning,
    )


def _divisions(result):
    """Parts of the record: in time, by size and direction of the motion, and segment by segment."""
    problem, point, motions = result.problem, result.point, []
    form = problem.form
    response = form.response(point.theta, sensitivities=False)
    for record, x0 in zip(problem.records, point.x0, strict=True):
        motion = simulate(response, record, x0)[1]
        motions.append(motion - motion.mean(axis=0))
    return {
        "time": blocks_in_time(motions),
        "size": by_size(motions, max(1, round(form.n_phases))),
        "direction": by_direction(motions),
        "record": [np.full(len(motion), k) for k, motion in enumerate(motions)],
    }


def _warn_of_tests(tests, simulated, doubt):
    """Warn of residuals that are not noise, with the figure that shows it, and what it leaves."""
    failed = tests[~tests["passed"]].sort_values("share", ascending=False)
    name, worst = failed.index[0], failed.iloc[0]
    way = (
        "a higher order, more harmonics or loads, noise on the inputs (input_noise) or smaller "
        "motions may help"
    )
    if _coloured(failed.index) and simulated:
        way = "noise moves the machine itself: use criterion='prediction_error'"
    warn(
        f"the residuals of the fit are not white noise: the test {name!r} gives "
        f"{worst['statistic']:.4g} instead of {worst['degrees']:.0f} for noise, "
        f"{worst['share']:.2g} of the residuals' variance, and {doubt}; standard deviations come "
        f"from comparing blocks of the record (robust), and miss errors that all blocks share; "
        f"{way}",
        IdentifiabilityWarning,
    )


def _coloured(failed):
    """Whether tests of noise against the noise before are all that failed."""
    return all(name.startswith("autocorrelation") for name in failed)


def _by_noise(trust):
    """Whether what is left is noise that goes with the noise before."""
    return trust.kind == "robust" and _coloured(
        name
        for name, passed in zip(trust.tests["test"], trust.tests["passed"], strict=True)
        if not passed
    )


def _warn_of_parts(exponents, apart, own, more, doubt):
    """Warn of parts of the record that put an exponent elsewhere, and what that leaves."""
    n, told = len(exponents), None
    for name, (offsets, differ) in apart.items():
        for r in np.flatnonzero(differ):
            span = np.ptp(offsets[r])
            if told is None or span**2 / own[r] > told[0]:
                told = span**2 / own[r], name, r, offsets[r]
    if told is None:
        return
    _, name, r, offsets = told
    value = exponents[r % n]
    what = "real" if r < n else "imaginary"
    centre = value.real if r < n else value.imag
    warn(
        f"parts of the record disagree: {WORDS[name]} the {what} part of the exponent {value:.4g} "
        f"lies from {centre + min(offsets):.5g} to {centre + max(offsets):.5g} 1/s (standard "
        f"deviation {np.sqrt(own[r]):.2g}), so the response is not that of one linear system; its "
        f"standard deviation is widened to {np.sqrt(own[r] + more[r]):.2g}; {doubt}; use smaller "
        f"motions, or fit the parts separately",
        IdentifiabilityWarning,
    )


def warn_of_slow(fit, trust, experiment):
    """Warn of modes that last longer than the record, and of intervals of a short record."""
    spans = _spans(experiment)
    slowest = np.max(trust.exponents.real, initial=-np.inf)
    decays = -slowest * max(spans)
    if abs(decays) < 1.0:  # it lasts longer than the record
        words = "give the trim about which they were measured (trim_span), or use "
        words = f"{words}HarmonicAnalyzer(reading='sample'), which identifies it"
        if experiment.basis.output_trim is not None or experiment.basis.reading == "sample":
            words = "any slow drift looks the same; use a longer record"
        warn(
            f"a mode ({slowest:.3g} 1/s) lasts longer than the record: {max(spans):.3g} s are only "
            f"{abs(decays):.2g} of its time constants. It may be the mean of the outputs or a "
            f"drift; {words}",
            IdentifiabilityWarning,
        )
        return
    excited = fit.result.gain is not None or (trust.doubt and _by_noise(trust))
    total = -slowest * sum(spans)
    if excited and 0.0 < total < TIME_CONSTANTS:
        warn(
            f"the record lasts only {total:.0f} time constants of the slowest mode ({slowest:.3g} "
            f"1/s), which noise excites: intervals assume a long record and cover less than "
            f"stated; {TIME_CONSTANTS} time constants are enough",
            IdentifiabilityWarning,
        )
