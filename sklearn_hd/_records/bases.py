"""How a record is to be read: which reading suits it, on which grid, with what harmonics.

``analyzer`` is asked for its parameters alone.

ω of a record: as given, or as the record tells it where the given one is surely off.
"""

import math
import numbers
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import linalg

from sklearn_hd._checks import (
    PERIOD_TOLERANCE,
    STANDARD_ERRORS,
    check_count,
    check_harmonics,
    check_period,
    check_rate,
    whole_period,
)
from sklearn_hd._guards import searching, warn
from sklearn_hd._readings import READINGS
from sklearn_hd._records.data import given, sample
from sklearn_hd._records.sampling import runs_of
from sklearn_hd.algorithms.periodic.speed import measured_speed, speeds_apart
from sklearn_hd.algorithms.signals.fourier import MOST_ROWS, harmonic_functions
from sklearn_hd.algorithms.signals.resampling import ON_GRID
from sklearn_hd.algorithms.signals.trim import LEAST_TURNS, TURN, inputs_rest
from sklearn_hd.exceptions import FrequencyMismatchWarning

AUTO = "auto"
ROWS_PER_PERIOD = 8
ROWS_PER_TURN = 24  # kept of samples: 12 harmonics of the turn
ANGLES = {"degrees": (np.pi / 180.0, "np.deg2rad({})"), "turns": (2.0 * np.pi, "2 * np.pi * {}")}
ORBIT_ORDERS = range(5)  # harmonics of an orbit that is looked for in other units of the azimuth
HALF_OF_IT = 0.5  # of what the azimuth as it is leaves of the outputs
LISTED = 6  # records that a message names
SLIGHT = 1e-4  # of the energy of the motion, 1 % of its size: what is less is no matter


def chosen_readings(analyzer, inputs, outputs, timing, omega):
    """How model steps read the record, by what is asked for and what the inputs do.

    Two readings where both may serve: the second one if the first leaves a doubt. A segment of less
    than a turn has no period, and missing rows may leave no two turns in a row.
    """
    if analyzer.reading != AUTO:
        return (analyzer.reading,)
    if analyzer.load_harmonics is not None:
        return ("sample",)
    by_signal = isinstance(analyzer.output_harmonics, Mapping)
    held = analyzer.input_harmonics is None or np.array_equal(analyzer.input_harmonics, 0)
    if outputs is None or analyzer.hop is not None or analyzer.window != "boxcar":
        return ("sliding",)
    if by_signal or not held:
        return ("sliding",)
    if analyzer.small_signal is not None:
        return ("period",)
    psi = omega * inputs.places(omega, inputs.base.sample_time)
    u, _, present = given(inputs, outputs, timing)
    segments, step = inputs.base.segments, omega * inputs.base.sample_time
    known = [psi[segment][np.isfinite(psi[segment])] for segment in segments]
    whole = all(len(k) and np.ptp(k) + step > TURN * (1.0 - ON_GRID) for k in known)
    rows = [run for segment in segments for run in runs_of(present, segment)]
    rest = whole and inputs_rest([u[run] for run in rows], [psi[run] for run in rows])
    return ("period", "sample") if rest else ("sample",)


def record_basis(analyzer, reading, inputs, output_names, timing, omega):
    """How signals are analysed, trim aside."""
    if reading == "sample":
        return _sample_basis(analyzer, inputs, output_names, timing, omega)
    if analyzer.load_harmonics is not None:
        raise ValueError(
            f"load_harmonics={analyzer.load_harmonics!r} with reading={reading!r}: loads are "
            f"identified with reading='sample' alone; leave load_harmonics=None, and give "
            f"trim_span"
        )
    asked = 0 if analyzer.input_harmonics is None else analyzer.input_harmonics
    kept_in = check_harmonics("input_harmonics", asked, inputs.names)
    asked = 1 if analyzer.output_harmonics is None else analyzer.output_harmonics
    kept_out = check_harmonics("output_harmonics", asked, output_names) if output_names else ()
    highest = max((k for _, orders in (*kept_in, *kept_out) for k in orders), default=0)
    rows = _least_rows(highest) if reading == "sliding" else 1
    spp, step, timing = _grid(analyzer, inputs, highest, rows, timing, omega)
    return READINGS[reading](
        omega=omega,
        sample_time=step,
        samples_per_period=spp,
        window=analyzer.window,
        hop=spp if reading == "period" else _checked_hop(analyzer, spp, highest),
        inputs=kept_in,
        outputs=kept_out,
        timing=timing,
        small_signal=analyzer.small_signal,
    )


def _sample_basis(analyzer, inputs, output_names, timing, omega):
    """The basis of samples with their azimuths."""
    if analyzer.small_signal is not None:
        raise ValueError(
            f"small_signal={analyzer.small_signal!r} combines records at the same phases, which "
            f"reading='sample' does not ask for; use reading='period', or small_signal=None"
        )
    named = ("output_harmonics", "input_harmonics", "load_harmonics")
    asked = {name: getattr(analyzer, name) for name in named}
    for name, count in asked.items():
        if count is not None:
            hint = "with reading='sample' it is one number for all signals, None chooses it"
            check_count(name, count, 0, hint)
    step = inputs.base.sample_time
    samples = 2.0 * np.pi / omega / step
    highest = max((count for count in asked.values() if count is not None), default=1)
    words = f"omega={omega:.6g} rad/s and a sample time of {step:.4g} s give {samples:.4g}"
    check_rate(samples, highest, f"{words} samples a turn")
    hop = kept_every(samples) if analyzer.hop is None else analyzer.hop
    hop = check_count("hop", hop, 1, "1 reads every sample")
    thinned = "" if hop == 1 else f", of which hop={hop} leaves {samples / hop:.4g}"
    check_rate(samples / hop, highest, f"{words} samples a turn{thinned}")
    basis = replace(
        _samples(inputs, omega, hop, timing),
        window=analyzer.window,
        outputs=tuple((name, (0,)) for name in output_names),
        n_harmonics=asked["output_harmonics"],
        n_input_harmonics=asked["input_harmonics"],
        n_load_harmonics=asked["load_harmonics"],
    )
    if highest > max(basis.most_harmonics, 1):
        raise ValueError(
            f"{words} samples a turn{thinned}, which tell harmonics up to "
            f"{basis.most_harmonics} apart; {highest} were asked for: ask for fewer, or sample "
            f"faster"
        )
    return basis


def _grid(analyzer, inputs, highest, rows, timing, omega):
    """Samples in a period, their distance in seconds, and when rows were sampled."""
    if analyzer.azimuth is not None:
        return *_varying_speed(analyzer, inputs, highest, rows, omega), timing
    spp, step, resampled = _constant_speed(analyzer, inputs.base, highest, rows, omega)
    own = inputs.base.sample_time if resampled else step
    return spp, step, replace(timing, sample_time=own, resampled=resampled)


def _constant_speed(analyzer, base, highest, rows, omega):
    """Samples in a period of the grid, their distance, and whether all is resampled."""
    if base.counted and analyzer.sample_time is None:  # times that were lost are no times
        check_period(omega, base.sample_time, highest, counted=True)
    samples, whole = whole_period(omega, base, highest)
    if not whole:
        near = abs(samples - round(samples)) <= 0.1  # such a grid is not worth making finer
        spp = round(samples) if near else _samples_on_grid(analyzer, samples, rows)
        return spp, 2.0 * np.pi / omega / spp, True
    spp = round(samples)
    step = 2.0 * np.pi / omega / spp
    told = abs(step - base.sample_time) > STANDARD_ERRORS * base.uncertainty
    even = base.jitter[1] == 0.0  # else resampled, to fit the period exactly
    return spp, base.sample_time if even and told else step, False


def _samples_on_grid(analyzer, samples, rows):
    """Samples in a period of the grid: those given, rounded up to whole hops, or rows read."""
    least = samples - PERIOD_TOLERANCE
    whole = isinstance(analyzer.hop, numbers.Integral) and 1 <= analyzer.hop <= np.ceil(least)
    unit = int(analyzer.hop) if whole else 1
    if analyzer.hop is None:
        unit = rows
    return unit * int(np.ceil(least / unit))


def _varying_speed(analyzer, inputs, highest, rows, omega):
    """Samples on the grid in a turn, and their distance in seconds."""
    samples, _ = inputs.mean_speed(analyzer.azimuth)
    check_rate(
        samples,
        highest,
        f"azimuth column {analyzer.azimuth!r} shows {samples:.4g} samples a turn in the mean",
    )
    spp = _samples_on_grid(analyzer, samples, rows)
    return spp, 2.0 * np.pi / omega / spp


def _checked_hop(analyzer, spp, highest):
    """The hop; None stands for about eight rows a period, more for high harmonics."""
    small = [d for d in range(1, math.isqrt(spp) + 1) if spp % d == 0]
    divisors = sorted({*small, *(spp // d for d in small)})
    hop = analyzer.hop
    if hop is None:
        rows = _least_rows(highest)
        return max((d for d in divisors if spp // d >= rows), default=1)
    whole = isinstance(hop, numbers.Integral) and not isinstance(hop, bool)
    if not whole or hop < 1 or spp % hop:
        raise ValueError(
            f"hop={hop!r} does not divide the {spp} samples of a period; use one of "
            f"{divisors}, None for about {ROWS_PER_PERIOD} rows a period, or reading='period'"
        )
    return int(hop)


def _least_rows(highest):
    """Rows of a sliding window in a period, for the highest harmonic kept."""
    return max(ROWS_PER_PERIOD, 2 * highest + 3)


def settled_omega(analyzer, inputs, outputs, timing):
    """The fundamental frequency at which a record is analysed, rad/s.

    Parameters
    ----------
    analyzer : HarmonicAnalyzer
        Asked for ``omega`` and ``azimuth`` alone.
    inputs : Signals
    outputs : ndarray, shape (n_rows, n_outputs), or None
    timing : Timing

    Returns
    -------
    omega : float
        The mean speed by the azimuth where there is one.
    """
    if analyzer.azimuth is not None:
        omega = inputs.mean_speed(analyzer.azimuth)[1]
        if outputs is not None:
            _warn_of_unit(analyzer.azimuth, inputs.azimuth, outputs)
        return omega
    omega, step = float(analyzer.omega), inputs.base.sample_time
    samples = 2.0 * np.pi / omega / step
    if outputs is None or not np.isfinite(samples) or samples <= 2.0:
        return omega
    basis = _samples(inputs, omega, kept_every(samples), timing)
    sampling, u, y = sample(inputs, basis, outputs)
    segments = list(zip(u, y, (piece.grid for piece in sampling.pieces), strict=True))
    if warn_of_speeds(sampling.base.records, segments, omega, basis.most_loads):
        return omega
    found = measured_speed(segments, omega, basis.most_loads)
    if found is None:
        return omega
    if found.moved > SLIGHT:
        _warn_of_another(found, omega)
    return found.omega


def warn_of_speeds(labels, segments, omega, n_harmonics):
    """The speeds of records that have speeds of their own by their orbits, with a warning.

    Folds of a search are not checked; the final fit is.

    Parameters
    ----------
    labels : sequence of label
        The record of each segment.
    segments : list of (inputs, outputs, time)
    omega : float
        rad/s, about which they are looked for.
    n_harmonics : int
        Of the orbits.

    Returns
    -------
    speeds : list of (float, float)
        ω and its standard deviation, rad/s, of each record with an orbit; empty where they are one.
    """
    records = {}
    for label, segment in zip(labels, segments, strict=True):
        records.setdefault(label, []).append(segment)
    if len(records) == 1 or searching():
        return []
    speeds = speeds_apart([*records.values()], omega, n_harmonics)
    if speeds is None:
        return []
    told = {label: speed for label, speed in zip(records, speeds, strict=True) if speed}
    some = sorted(told.items(), key=lambda each: each[1])[:LISTED]
    listed = ", ".join(f"record {label} at {own:.5g} ± {std:.2g}" for label, (own, std) in some)
    more = ", …" if len(told) > LISTED else ""
    warn(
        f"the records repeat themselves at speeds of their own: {listed}{more} rad/s, and no "
        f"constant omega fits them; fit the records of each speed by themselves, each at its "
        f"omega, or measure the azimuth and give azimuth= to HarmonicAnalyzer",
        FrequencyMismatchWarning,
    )
    return list(told.values())


def _warn_of_unit(name, azimuth, outputs):
    """Warn of an azimuth by which outputs repeat themselves only if it is not in radians."""
    known = np.isfinite(azimuth) & np.all(np.isfinite(outputs), axis=1)
    azimuth, y = azimuth[known][:MOST_ROWS], outputs[known][:MOST_ROWS]
    if not len(y):
        return
    y = y - y.mean(axis=0)
    size = np.sqrt(np.mean(y**2, axis=0))
    y = y / np.where(size > 0.0, size, 1.0)

    def left(radians):
        functions = harmonic_functions(radians * azimuth, ORBIT_ORDERS)
        return np.sum((y - functions @ linalg.lstsq(functions, y)[0]) ** 2)

    own, span = left(1.0), np.ptp(azimuth)
    for unit, (radians, way) in ANGLES.items():
        turns = radians * span / TURN
        if turns >= LEAST_TURNS and left(radians) < HALF_OF_IT * own:
            column = f"X[{name!r}]"
            warn(
                f"the outputs repeat themselves with the azimuth column {name!r} if that is in "
                f"{unit} ({turns:.4g} turns in the record), not if it is in radians "
                f"({span / TURN:.4g} turns): give radians, {way.format(column)}",
                FrequencyMismatchWarning,
            )


def kept_every(samples):
    """Which of so many samples a turn are kept to have some 24 of it: every first, second, …."""
    return max(1, int(samples / ROWS_PER_TURN))


def _samples(inputs, omega, hop, timing):
    """A basis of samples with their azimuths, some of which are left out."""
    step = inputs.base.sample_time * hop
    return READINGS["sample"](
        omega=omega,
        sample_time=step,
        samples_per_period=2.0 * np.pi / omega / step,
        window="boxcar",
        hop=hop,
        inputs=tuple((name, (0,)) for name in inputs.names),
        outputs=(),
        timing=timing,
    )


def _warn_of_another(found, omega):
    off = omega / found.omega - 1.0
    warn(
        f"the data repeat themselves at {found.omega:.9g} ± {found.std:.2g} rad/s, not at "
        f"omega={omega:.9g} rad/s, which is {abs(off):.2{'%' if abs(off) > 1e-4 else 'g'}} "
        f"{'more' if off > 0.0 else 'less'}: the azimuth would go astray by {found.turns:.2g} "
        f"turns, {np.sqrt(found.moved):.2g} of the size of the motion; {found.omega:.9g} is used "
        f"instead; set omega={found.omega:.9g}, or check the clock",
        FrequencyMismatchWarning,
    )
