"""The frequency of a machine, estimated from its records."""

import math

import numpy as np

from sklearn_hd._checks import check_missing
from sklearn_hd._guards import warn
from sklearn_hd._readings import PlainReading
from sklearn_hd._readings.basis import Timing
from sklearn_hd._readings.sample import MOST_LOADS
from sklearn_hd._records.bases import kept_every, warn_of_speeds
from sklearn_hd._records.data import read_experiment
from sklearn_hd.algorithms.modes.free_decay import SURE
from sklearn_hd.algorithms.periodic.speed import (
    ORBIT,
    orbit_drift,
    orbit_share,
    orbit_speed,
    speeds_apart,
)
from sklearn_hd.algorithms.signals import fundamental
from sklearn_hd.algorithms.signals.fundamental import OmegaEstimate
from sklearn_hd.exceptions import (
    FrequencyMismatchWarning,
    IdentifiabilityWarning,
    TimeBaseWarning,
)

__all__ = ["OmegaEstimate", "estimate_omega"]

PARTS = 4  # of the longest segment, that are compared


def estimate_omega(X, y, guess=None, *, span=fundamental.SPAN, sample_time=None, missing="raise"):
    """Frequency at which records repeat themselves, with its standard deviation.

    Write the periods one below the other: the matrix has low rank at the true frequency, whatever
    the trim, slow transients and amplitudes are. Inputs may move. If the records show an orbit, and
    no drift, the speed at which it repeats itself is the estimate: rows before explain what inputs
    and disturbances move beside it. If half of the records contradicts that speed, the value by
    the periods stays, and the distance between both is its deviation.

    Parameters
    ----------
    X : DataFrame, Series or ndarray, shape (n_samples, n_inputs)
        Inputs, as :meth:`HarmonicAnalyzer.fit` takes them.
    y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
        Outputs, as measured or with the trim subtracted.
    guess : float, optional
        Centre of the search, rad/s. By default it is the strongest comb of lines in the spectrum
        of the outputs, or twice or three times that where all periods of an orbit are alike then.
    span : float, default=0.035
        Width of the search to either side of the guess, as a share of it.
    sample_time : float, optional
        Seconds from row to row, for arrays and for frames without times.
    missing : {"raise", "gap"} or float, default="raise"
        Treatment of NaN, as in :class:`HarmonicAnalyzer`.

    Returns
    -------
    estimate : OmegaEstimate
        The frequency with its standard deviation, and how much it drifts.

    Raises
    ------
    ValueError
        If X and y cannot be read, the records are too short, or no frequency within the span
        is better than the others, or the outputs' orbit lies beyond the span of the guess.

    Warns
    -----
    FrequencyMismatchWarning
        If the speed drifts, or the records have speeds of their own (the estimate is then their
        mean), or parts of the longest segment have. The standard deviation is at least that of
        these speeds.
    TimeBaseWarning
        If neither the records nor ``sample_time`` say when rows were sampled.
    IdentifiabilityWarning
        If a fraction of the frequency explains the records better, or a multiple explains them as
        well; if no guess was given and the outputs show no orbit at it; if it may be the clock of
        inputs that always move.

    References
    ----------
    Kanjilal, Palit (1995), On multiple pattern extraction using singular value
    decomposition, IEEE Trans. Signal Processing 43(6), 1536-1540.

    Golub, Pereyra (1973), The differentiation of pseudo-inverses and nonlinear least
    squares problems whose variables separate, SIAM J. Numerical Analysis 10(2), 413-432.

    Examples
    --------
    >>> from sklearn_hd import estimate_omega
    >>> from sklearn_hd.datasets import make_rotor
    >>> rotor = make_rotor(n_turns=100, random_state=0)
    >>> estimate = estimate_omega(rotor.inputs, rotor.outputs)
    >>> bool(abs(estimate.omega - rotor.omega) < 3.0 * estimate.std)
    True
    """
    timing = Timing(sample_time, missing=check_missing(missing))
    experiment = read_experiment(X, y, plain=PlainReading(timing=timing))
    segments = list(zip(experiment.inputs, experiment.outputs, experiment.times(), strict=True))
    step = experiment.base.sample_time
    starts = [time[0] for _, _, time in segments]
    inputs, outputs = experiment.inputs, experiment.outputs
    found = fundamental.estimate_omega(inputs, outputs, step, guess, span, starts)
    found = _by_orbit(found, segments, step, guess, span)
    while guess is None and (times := _times_as_fast(found, segments, step)):
        about = times * found.omega
        found = fundamental.estimate_omega(inputs, outputs, step, about, span, starts)
        found = _by_orbit(found, segments, step, guess, span)
    if experiment.base.counted and sample_time is None:
        warn(
            "no times given: rows count as seconds, so omega is in rad per row; give sample_time=, "
            "or use a DataFrame indexed by seconds",
            TimeBaseWarning,
        )
    slower = any(rival < found.omega for rival in found.rivals)
    some = _thinned(segments, found.omega, step)
    speeds = [] if slower else warn_of_speeds(experiment.base.records, *some)
    if speeds:
        omegas, stds = np.transpose(speeds)
        std = float(max(*stds, np.std(omegas)))
        found = _at(found, float(np.mean(omegas)), std)._replace(drift=0.0, rivals=())
    elif not found.drift and not slower:
        found = _as_parts_have_it(found, *some)
    if found.drift and not slower:
        warn(
            f"the speed drifts by {found.drift / found.omega:.2%} over the records "
            f"({found.drift:.3g} ± {found.drift_std:.2g} rad/s from start to end, about "
            f"{found.omega:.7g}), so no constant omega fits them; measure the azimuth and give "
            f"azimuth= to HarmonicAnalyzer, or use records of constant speed",
            FrequencyMismatchWarning,
        )
    if found.of_inputs:
        warn(
            f"the inputs, too, repeat themselves at {found.omega:.7g} rad/s, and the outputs have "
            f"no motion of that frequency beside them: it is the clock of the inputs, or the "
            f"machine's if inputs are given once a turn; hold inputs for uneven times, or leave "
            f"them at rest for some periods",
            IdentifiabilityWarning,
        )
    if guess is None and not speeds:
        _warn_without_orbit(found, segments, step)
    if found.rivals:
        others = ", ".join(f"{rival:.7g}" for rival in found.rivals)
        better = "better than" if slower else "as well as"
        way_out = (
            "give the frequency at which the machine turns as guess"
            if guess is None
            else f"keep it only if the machine turns at about guess={guess:.7g} rad/s"
        )
        warn(
            f"{others} rad/s explain the records {better} {found.omega:.7g} rad/s: a multiple of "
            f"the machine's frequency looks like it if every second (third) period is alike; "
            f"{way_out}",
            IdentifiabilityWarning,
        )
    return found


def _warn_without_orbit(found, segments, step):
    """Warn if no waveform repeats itself at a frequency that the spectrum alone has proposed.

    At a speed that drifts, in neither half of the records.
    """
    some = _thinned(segments, found.omega, step)
    if orbit_share(*some) < ORBIT and not (found.drift and orbit_drift(*some)):
        warn(
            f"the outputs show no orbit at {found.omega:.7g} rad/s, a waveform that the halves of "
            f"the records share, so this frequency may be any; give outputs as measured, their "
            f"trim included, or guess=",
            IdentifiabilityWarning,
        )


def _times_as_fast(found, segments, step):
    """2 or 3 if an orbit turns so many times as fast: all its periods are alike; None if none does.

    Lines of inputs that always move make a comb of the half, or third, look the strongest.
    """
    rivals = {round(rival / found.omega) for rival in found.rivals}
    for times in sorted(rivals & {2, 3}):
        speeds = found.omega, times * found.omega
        slow, fast = (orbit_share(*_thinned(segments, omega, step)) for omega in speeds)
        if fast >= ORBIT and slow - fast < ORBIT:
            return times
    return None


def _thinned(segments, omega, step):
    """Segments with the rows that a speed needs, that speed, and the harmonics told apart."""
    samples = 2.0 * np.pi / (omega * step)
    kept = kept_every(samples)
    told = min(MOST_LOADS, math.ceil(0.5 * samples / kept) - 1)  # harmonics apart from others
    return [tuple(z[::kept] for z in segment) for segment in segments], omega, told


def _as_parts_have_it(found, segments, omega, n_harmonics):
    """The estimate as precise as parts of the longest segment agree to, with a warning.

    Parts tell if each shows an orbit: what decays, or rests, has a frequency within its noise.
    """
    longest = max(segments, key=lambda segment: len(segment[1]))
    rows = np.array_split(np.arange(len(longest[1])), PARTS)
    parts = [[tuple(z[own] for z in longest)] for own in rows]
    speeds = speeds_apart(parts, omega, n_harmonics, (found.omega, found.std))
    if speeds is None or None in speeds:
        return found
    off = np.array([own for own, _ in speeds]) - found.omega
    found = found._replace(std=float(max(found.std, np.sqrt(np.mean(off**2)))))
    listed = ", ".join(f"{own:.5g} ± {std:.2g}" for own, std in speeds)
    warn(
        f"parts of the longest segment, one after the other, repeat themselves at {listed} rad/s: "
        f"the speed varies about {found.omega:.5g} ± {found.std:.2g} rad/s, and no constant omega "
        f"fits; measure the azimuth and give azimuth= to HarmonicAnalyzer, or use records of "
        f"constant speed",
        FrequencyMismatchWarning,
    )
    return found


def _at(found, omega, std):
    """The estimate at another frequency, its rivals as many times as fast or slow as before."""
    rivals = tuple(rival * omega / found.omega for rival in found.rivals)
    return found._replace(omega=omega, std=std, rivals=rivals)


def _by_orbit(found, segments, sample_time, guess, span):
    """The estimate as precise as the orbit of the records tells it, if they show one.

    By patterns, the deviation can be a tenth of the error. The orbit's speed has to lie within the
    span of a guess. A drift that the orbit's two halves would tell from none, and do not, is none.
    """
    some, omega, told = _thinned(segments, found.omega, sample_time)
    if found.drift:
        drift, std = orbit_drift(some, omega, told) or (found.drift, 0.0)
        if abs(drift) > abs(drift - found.drift) or SURE * std > abs(found.drift):
            return found
        found = found._replace(drift=0.0, drift_std=max(found.drift_std, abs(found.drift)))
    orbit = orbit_speed(some, omega, told, span=span)
    if orbit is None:
        return found
    if guess is not None and abs(orbit[0] - guess) > span * guess + fundamental.BEYOND * orbit[1]:
        raise ValueError(
            f"no fundamental frequency stands out within {100 * span:.2g} % of guess={guess:.6g} "
            f"rad/s: the outputs' orbit repeats itself at {orbit[0]:.7g} rad/s; widen the span, or "
            f"give another guess"
        )
    return _at(found, *orbit)
