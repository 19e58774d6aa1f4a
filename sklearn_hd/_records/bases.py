"""How a record is to be read: which reading suits it, on which grid, with what harmonics and trim.

``analyzer`` is asked for its parameters alone.

ω of a record: as given, or as the record tells it where the given one is surely off.

The trim: periodic waveforms of rows at rest, and what rows say against them.
"""

import math
import numbers
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import linalg

from sklearn_hd._checks import (
    LITTLE,
    PERIOD_TOLERANCE,
    STANDARD_ERRORS,
    check_count,
    check_harmonics,
    check_period,
    check_rate,
    check_span,
    whole_period,
)
from sklearn_hd._clock import resolution
from sklearn_hd._guards import searching, warn
from sklearn_hd._readings import READINGS
from sklearn_hd._records.data import given, sample
from sklearn_hd._records.sampling import MOST_HARMONICS, runs_of
from sklearn_hd.algorithms.linalg.rounding import PRECISION
from sklearn_hd.algorithms.linalg.triangular import column_rms
from sklearn_hd.algorithms.periodic.speed import measured_speed, speeds_apart
from sklearn_hd.algorithms.signals.fourier import (
    MOST_ROWS,
    ROWS_PER_COLUMN,
    harmonic_functions,
    lift,
    standing_lines,
)
from sklearn_hd.algorithms.signals.resampling import ON_GRID
from sklearn_hd.algorithms.signals.trim import (
    LEAST_TURNS,
    TURN,
    drift,
    in_trim,
    inputs_rest,
    motion_of,
    stands_out,
    turns_at_rest,
)
from sklearn_hd.exceptions import FrequencyMismatchWarning, IdentifiabilityWarning

AUTO = "auto"
ROWS_PER_PERIOD = 8
ROWS_PER_TURN = 24  # kept of samples: 12 harmonics of the turn
ANGLES = {"degrees": (np.pi / 180.0, "np.deg2rad({})"), "turns": (2.0 * np.pi, "2 * np.pi * {}")}
ORBIT_ORDERS = range(5)  # harmonics of an orbit that is looked for in other units of the azimuth
LISTED = 6  # records that a message names
SLIGHT = 1e-4  # of the energy of the motion, 1 % of its size: what is less is no matter
MOST_WAVEFORM = 0.5  # of the energy of an output: a waveform that holds more is a trim
PARTS = 8  # of a record, by which a waveform is told from its motion


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
    return spp, step, replace(timing, sample_time=own, resampled=resampled, of_fit=True)


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

    It is the mean speed by the azimuth where there is one. The analyzer is asked for
    ``omega`` and ``azimuth`` alone.
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

    ``labels`` has the record of each segment (inputs, outputs, time). Speeds are looked
    for about ``omega``, of orbits with ``n_harmonics`` harmonics. It returns a list of
    ω and its standard deviation, rad/s, of each record with an orbit. The list is empty
    where they are one.
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
    y = y / column_rms(y)

    def left(radians):
        functions = harmonic_functions(radians * azimuth, ORBIT_ORDERS)
        return np.sum((y - functions @ linalg.lstsq(functions, y)[0]) ** 2)

    own, span = left(1.0), np.ptp(azimuth)
    for unit, (radians, way) in ANGLES.items():
        turns = radians * span / TURN
        if turns >= LEAST_TURNS and left(radians) < 0.5 * own:
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


def with_trim(basis, signals, outputs, trim_span):
    """The basis with the waveforms of inputs and outputs in trim, as ``trim_span`` says.

    ``signals`` are the inputs. ``trim_span`` is (start, stop) in seconds, "auto" or
    None.
    """
    span = None if trim_span is None else check_span("trim_span", trim_span, AUTO)
    samples = basis.reading == "sample"  # which identifies its forced response with the dynamics
    if span in (None, AUTO):
        if outputs is None:
            return basis
        if samples:
            asked = basis.n_load_harmonics is not None
            return basis if asked else _with_fast_waveform(basis, signals, outputs)
        sampling, *blocks = sample(signals, basis, outputs)
        found = _found(sampling, blocks, basis, named=span is not None)
        if found is None:
            return basis
        if basis.reading == "sliding" and not found["trim_known"]:
            _warn_of_no_rest()
        return replace(basis, **found)
    start, stop = span
    sampling, *blocks = sample(signals, basis, outputs)
    given = [values for values in blocks if values is not None]
    waveforms = [_waveform(sampling, values, basis, start, stop) for values in given]
    if not samples:
        _warn_of_drift(sampling, given, basis, start, stop)
    return replace(basis, **dict(zip(("input_trim", "output_trim"), waveforms, strict=False)))


def _with_fast_waveform(basis, signals, outputs):
    """The basis with the waveform of the outputs in harmonics that are faster than the forced
    response which samples are fitted with.

    Those whose lines stand out of the motion between them.
    """
    step = signals.base.sample_time
    highest = int(np.ceil(np.pi / basis.omega / step * (1.0 - PRECISION))) - 1
    highest = min(MOST_HARMONICS, highest)
    psi = basis.omega * signals.places(basis.omega, step)
    known = np.isfinite(outputs).all(axis=1) & np.isfinite(psi)
    if highest <= basis.most_loads or known.sum() < ROWS_PER_COLUMN * (4 * highest + 1):
        return basis
    fast = standing_lines([(outputs[known], psi[known])], highest)
    fast[: 2 * basis.most_loads + 1] = 0.0
    if not fast.any():
        return basis
    return replace(basis, output_trim=fast, trim_known=False)


def _found(sampling, blocks, basis, named):
    """Waveforms of turns in trim; None where those of the outputs are no more than noise.

    Where nothing rests those of all turns, if outputs hold little else, or of those in which the
    inputs alone rest: what that of the outputs is off by is identified with the dynamics. Period
    by period the trim of inputs is then zero, unless their mean is larger than their motion.

    ``named`` is False for ``trim_span=None``, by which the outputs are about their trim. Period by
    period a waveform is then identified with the dynamics all the same, unless the mean of the
    inputs may make it; that, and what sliding windows show, is told and left as it is.
    """
    units = [_exponent(values) for values in blocks]
    inputs, outputs = (
        _lifted(sampling, [np.ldexp(z, -unit) for z in values], basis)
        for values, unit in zip(blocks, units, strict=True)
    )
    u, y = (np.concatenate(signals) for signals in (inputs, outputs))
    if len(y) < 2:
        return None
    motion = motion_of(outputs)
    rest = np.concatenate(in_trim(inputs, outputs))
    sliding = basis.reading == "sliding"
    known = bool(rest.any()) and (named or sliding)
    if known:
        stands = stands_out(y[rest], motion)
    else:
        rest = np.concatenate(turns_at_rest(inputs))
        rest = rest if rest.any() else ~rest
        stands = len(y) >= PARTS and _share(y.mean(axis=0), y) > MOST_WAVEFORM
        if stands:
            parts = [part.mean(axis=0) for part in np.array_split(y, PARTS)]
            stands = stands_out(np.array(parts), motion)
    waveform = y[rest].mean(axis=0)
    if not stands or np.max(np.abs(waveform)) <= PRECISION * np.max(np.abs(y)):
        return None
    level = u[rest].mean(axis=0)
    if not known and basis.reading == "period":  # which identifies what that brings about
        level = np.where(_in_square(level) > _in_square(u - level), level, 0.0)
    if not named and (sliding or level.any()):
        _warn_of_no_trim(_share(waveform, y))
        return None
    trim = (np.ldexp(z, unit) for z, unit in zip((level, waveform), units, strict=True))
    return dict(zip(("input_trim", "output_trim"), trim, strict=True), trim_known=known)


def _in_square(turns):
    """Mean square of each signal."""
    return np.mean(turns**2, axis=tuple(range(turns.ndim - 1)))


def _exponent(values):
    """Of the power of two near the largest of some signals: squares of their parts stay numbers."""
    return int(np.frexp(max(np.max(np.abs(z), initial=0.0) for z in values))[1])


def _share(waveform, turns):
    """Of the energy of an output that is a waveform which repeats itself, the largest."""
    whole, left = (np.sum(each**2, axis=(0, 1)) for each in (turns, turns - waveform))
    return float(np.max((whole - left) / np.where(whole > 0.0, whole, 1.0)))


def _lifted(sampling, values, basis, inside=None):
    """Whole turns of each segment, those inside a span alone where one is given."""
    parts = zip(sampling.base.segments, values, strict=True)
    spp = basis.samples_per_period
    found = []
    for segment, block in parts:
        phase = basis.phase_index(sampling.base.time[segment])
        turns = lift(block, phase, spp)
        if inside is not None:
            turns = turns[lift(inside[segment][:, None], phase, spp).all(axis=(1, 2))]
        found.append(turns)
    return found


def _inside(sampling, basis, start, stop):
    """Which rows of the grid lie between two times."""
    tolerance = max(1e-6 * basis.sample_time, resolution(sampling.clock))
    return (sampling.clock >= start - tolerance) & (sampling.clock < stop - tolerance)


def _waveform(sampling, blocks, basis, start, stop):
    """Periodic waveforms over the trim span, pooled over records."""
    spp = basis.samples_per_period
    inside, kept = _inside(sampling, basis, start, stop), []
    for segment, values in zip(sampling.base.segments, blocks, strict=True):
        rows = np.flatnonzero(inside[segment])
        rows = rows[: int(len(rows) // spp * spp)]  # whole periods: each phase counts alike
        kept.append((values[rows], sampling.base.time[segment][rows]))
    waveforms = basis.mean_waveforms(kept)
    if waveforms is None:
        raise ValueError(
            f"trim_span=({start:g}, {stop:g}) holds less than one whole period "
            f"({spp * basis.sample_time:.4g} s) of any record; widen it. If a fold of a "
            f"cross-validation leaves it out, keep it in all folds: PeriodBlockSplit(..., "
            f"trim_span=...)"
        )
    return waveforms


def _warn_of_drift(sampling, given, basis, start, stop):
    """Of a span in which inputs move, or outputs have not come to rest."""
    inside = _inside(sampling, basis, start, stop)
    whole, within = (
        [_lifted(sampling, values, basis, *rows) for values in given] for rows in ((), (inside,))
    )
    motions = [motion_of(turns) for turns in whole]
    n_turns = sum(map(len, within[0]))
    if n_turns < 2:
        return
    moved = motion_of(within[0]) / np.where(motions[0] > 0.0, motions[0], 1.0) / n_turns
    still = np.concatenate(turns_at_rest(whole[0]))  # inputs of noise alone rest nowhere
    if still.any() and np.max(moved) > LITTLE:
        what, share = "inputs move", np.max(moved)
    else:
        pairs = zip(within, motions, strict=True)
        share = max(drift(turns, motion) for parts, motion in pairs for turns in parts)
        what = "outputs are not at rest"
    if share > LITTLE:
        warn(
            f"the {what} within trim_span=({start:g}, {stop:g}): the waveform subtracted as trim "
            f"holds {np.sqrt(share):.2g} of the motion in the record (rms); give a span that "
            f"begins when outputs have settled and ends before inputs move, or trim_span='auto'",
            IdentifiabilityWarning,
        )


def _warn_of_no_trim(share):
    """Of outputs that are mostly a periodic waveform which nobody subtracts."""
    if share > MOST_WAVEFORM:
        warn(
            f"the outputs repeat themselves from turn to turn: a periodic waveform is {share:.4g} "
            f"of the energy of an output, but trim_span=None subtracts none; unless the inputs "
            f"make it, the waveform is identified as a multiplier at 1 and dominates R²; give "
            f"trim_span='auto', or the times of the trim",
            IdentifiabilityWarning,
        )


def _warn_of_no_rest():
    """Of a trim that a sliding window's models know no better than the mean over the record."""
    warn(
        "trim_span='auto': no turn is in trim, where inputs rest and outputs repeat themselves, so "
        "the mean waveform of turns in which outputs move is subtracted instead; use a record with "
        "a span in trim, or reading='sample' or 'period', which identify the trim together with "
        "the dynamics",
        IdentifiabilityWarning,
    )
