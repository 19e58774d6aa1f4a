"""Checks of the standard deviations of a fit: residual tests, and parts of the record."""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._residuals import LEVEL, remainder, scored
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.likelihood.noisy_inputs import NoisyInputProblem
from sklearn_hd.algorithms.likelihood.predictor import simulate
from sklearn_hd.algorithms.likelihood.robust import (
    blocks_in_time,
    by_direction,
    by_size,
    part_scores,
    whole_covariance,
)
from sklearn_hd.algorithms.likelihood.uncertainty import exponent_slopes, propagate_std
from sklearn_hd.exceptions import IdentifiabilityWarning, UnstableModelError

WORDS = {
    "size": "from small to large motions",
    "direction": "from one side of the motion to the other",
    "record": "from the first record to the last",
}
ALARM = 1e-4  # level of the tests at fit: a tenth of that of residual_tests, which are asked for
ONE_TIME_CONSTANT = 1.0  # a mode has to last less than the record
TIME_CONSTANTS = 50  # of the slowest mode in a record, below which intervals are short


@dataclass(frozen=True, eq=False)
class Trust:
    """Deviations, and what they rest on.

    Attributes
    ----------
    covariance : ndarray, shape (k, k)
        Of the structure's parameters, then of free delays.
    exponents, exponents_std : complex ndarray, shape (n,)
    kind : {"information", "robust"}
    tests : dict of list, or None
        Columns of the residual tests; None where a simulation overflows, or rows are few.
    """

    covariance: np.ndarray
    exponents: np.ndarray
    exponents_std: np.ndarray
    kind: str
    tests: dict | None

    @property
    def coloured(self):
        """Whether what is left is noise that goes with the noise before."""
        return self.kind == "robust" and _coloured(
            name
            for name, passed in zip(self.tests["test"], self.tests["passed"], strict=True)
            if not passed
        )


def trusted(fit, experiment, simulators, parameters):
    """Standard deviations of a fit that hold even if its residuals are not white noise.

    Parameters
    ----------
    fit : Fit
    experiment : Experiment
    simulators : list
        Of the fitted model, one a segment.
    parameters : ndarray
        All of the form.

    Returns
    -------
    trust : Trust
    """
    result, places = fit.result, fit.places
    exponents, slopes = exponent_slopes(fit.form, parameters)
    k, n, own = len(places), len(slopes), fit.structure.n_parameters
    slopes = np.pad(slopes[:, :own], [(0, 0), (0, k - own)])
    plain = propagate_std(slopes, fit.covariance)
    if isinstance(result.problem, NoisyInputProblem):  # its parts answer for each other's inputs
        return Trust(fit.covariance, exponents, plain, "information", None)
    tests = _tests(experiment, simulators)
    divisions = _divisions(result)
    parts = part_scores(result.problem, result.point, divisions)
    white = whole_covariance(result)
    robust = tests is not None and not tests["passed"].all()
    found = parts["time"].sandwich(white) if robust else white
    into = np.eye(len(white))[places] if fit.into is None else fit.into
    gradients = np.vstack([np.eye(k), slopes.real, slopes.imag]) @ into
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
    kind = "robust" if robust else "information"
    _warn_of_tests(tests, kind, result.gain is None)
    _warn_of_parts(exponents, apart, own[k:], more[k:])
    covariance = into @ found @ into.T
    variance = np.diag(covariance)
    wider = np.sqrt((own + more)[:k] / np.where(variance > 0.0, variance, np.inf))
    covariance = covariance * wider[:, None] * wider
    std = np.sqrt(own + more)[k:]
    std = np.where(np.isfinite(plain), std[:n] + 1j * std[n:], plain)
    known = np.isfinite(fit.covariance)
    covariance = np.where(known, covariance, fit.covariance)
    stored = None if tests is None else tests.reset_index().to_dict("list")
    return Trust(covariance, exponents, std, kind, stored)


def _tests(experiment, simulators):
    """Residual tests; None where there is nothing to test."""
    try:
        return scored(remainder(experiment, simulators), None, ALARM)
    except (UnstableModelError, ValueError) as reason:  # it overflows, or rows are too few
        warn(
            f"the residuals of the fit could not be tested: {reason}; the standard deviations hold "
            f"only if the residuals are white noise",
            IdentifiabilityWarning,
        )
        return None


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


def _warn_of_tests(tests, kind, simulated):
    """Warn of residuals that are not noise, with the figure that shows it."""
    if kind == "information":
        return
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
        f"{worst['share']:.2g} of the residuals' variance; standard deviations come from comparing "
        f"blocks of the record (robust), and miss errors that all blocks share; {way}",
        IdentifiabilityWarning,
    )


def _coloured(failed):
    """Whether tests of noise against the noise before are all that failed."""
    return all(name.startswith("autocorrelation") for name in failed)


def _warn_of_parts(exponents, apart, own, more):
    """Warn of parts of the record that put an exponent elsewhere."""
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
        f"goes from {centre + offsets[0]:.5g} to {centre + offsets[-1]:.5g} 1/s (standard "
        f"deviation {np.sqrt(own[r]):.2g}), so the response is not that of one linear system; its "
        f"standard deviation is widened to {np.sqrt(own[r] + more[r]):.2g}; use smaller motions, "
        f"or fit the parts separately",
        IdentifiabilityWarning,
    )


def warn_of_slow(fit, trust, experiment):
    """Warn of modes that last longer than the record, and of intervals of a short record."""
    spans = [time[-1] - time[0] for time in experiment.times()]
    slowest = np.max(trust.exponents.real, initial=-np.inf)
    decays = -slowest * max(spans)
    if abs(decays) < ONE_TIME_CONSTANT:
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
    total = -slowest * sum(spans)
    if (fit.result.gain is not None or trust.coloured) and 0.0 < total < TIME_CONSTANTS:
        warn(
            f"the record lasts only {total:.0f} time constants of the slowest mode ({slowest:.3g} "
            f"1/s), which noise excites: intervals assume a long record and cover less than "
            f"stated; {TIME_CONSTANTS} time constants are enough",
            IdentifiabilityWarning,
        )
