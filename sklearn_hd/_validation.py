"""The one place that words errors about time, period, shape and finite values."""

import itertools
import numbers
from dataclasses import dataclass

import numpy as np
import pandas as pd

PERIOD_TOLERANCE = 1e-3  # samples by which a period may miss a whole number
STEP_TOLERANCE = 1e-3  # share of the sample time by which a step may differ
JITTER_LIMIT = 0.2  # of the sample time, by which the instant of a row may be off
FIRST = "first sample"  # the time origin of dates that fix no azimuth
RAISE, GAP = "raise", "gap"  # what becomes of missing samples


@dataclass(frozen=True)
class TimeBase:
    """When each row was sampled, and where rows stop being consecutive.

    Attributes
    ----------
    time : ndarray, shape (n_samples,)
        Seconds.
    segments : tuple of slice
        Runs of consecutive rows; a new record or a gap starts a new one. Their
        steps may jitter.
    records : tuple
        Label of the record of each segment (0 where there is but one).
    sample_time : float
        Seconds.
    counted : bool
        True where samples were counted because no times were given.
    jitter : (float, float)
        Seconds by which rows are off evenly spaced instants: root mean square, largest.
    uncertainty : float
        Standard error of ``sample_time`` that the jitter leaves, seconds.
    """

    time: np.ndarray
    segments: tuple
    records: tuple
    sample_time: float
    counted: bool
    jitter: tuple = (0.0, 0.0)
    uncertainty: float = 0.0


def check_positive(name, value, unit, hint):
    """Return a float if it is a positive finite number."""
    if (
        isinstance(value, bool)
        or not isinstance(value, numbers.Real)
        or not np.isfinite(value)
        or value <= 0
    ):
        raise ValueError(f"{name} must be a positive number in {unit}, got {value!r}; {hint}")
    return float(value)


def check_choice(name, value, allowed):
    """Return the value if it is one of the choices."""
    if not isinstance(value, str) or value not in allowed:
        choices = ", ".join(repr(choice) for choice in allowed)
        raise ValueError(f"{name}={value!r} is not known; use one of {choices}")
    return value


def check_count(name, value, minimum, hint):
    """Return an int if it is a whole number, at least some minimum."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < minimum:
        raise ValueError(
            f"{name} must be a whole number of at least {minimum}, got {value!r}; {hint}"
        )
    return int(value)


def signal_names(data, prefix):
    """Column names of a frame, Series or array; arrays are numbered from x0."""
    if isinstance(data, pd.DataFrame):
        names = [str(column) for column in data.columns]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(
                f"column {repeated[0]!r} stands more than once; give every signal its own name"
            )
        return tuple(names)
    if isinstance(data, pd.Series):
        return (str(data.name) if data.name is not None else f"{prefix}0",)
    width = 1 if data.ndim == 1 else data.shape[1]
    return tuple(f"{prefix}{i}" for i in range(width))


def check_finite(values, names, time, what, missing=RAISE):
    """Raise ValueError naming the column and the first time of a value that is not finite.

    NaN is let through where ``missing`` has a rule for it.
    """
    bad = ~np.isfinite(values) if missing == RAISE else np.isinf(values)
    if bad.any():
        row = int(np.argmax(bad.any(axis=1)))
        column = int(np.argmax(bad[row]))
        kind = "NaN" if np.isnan(values[row, column]) else "infinity"
        raise ValueError(
            f"{what} contains {kind}: column {names[column]!r}, first at t = {time[row]:.6g} s "
            f"(row {row}); drop those rows (a gap starts a new segment), fill them, or set them "
            f"to NaN and give HarmonicAnalyzer missing='gap', or the longest run of NaN to bridge "
            f"in seconds"
        )


def check_missing(missing):
    """Return the rule for missing samples: "raise", "gap" or seconds as a float."""
    if isinstance(missing, str) and missing in (RAISE, GAP):
        return missing
    hint = "it is the longest run of NaN to bridge; 'gap' bridges none, 'raise' refuses NaN"
    return check_positive("missing", missing, "seconds", hint)


def check_time_origin(origin):
    """Return the instant of ψ = 0 as ISO text, which any store can hold; None if there is none."""
    if origin is None:
        return None
    try:
        if isinstance(origin, numbers.Number):
            raise TypeError("a number is no date")
        stamp = pd.Timestamp(origin)
        if stamp is pd.NaT:
            raise ValueError("not a time")
    except (TypeError, ValueError):
        raise ValueError(
            f"time_origin={origin!r} is not understood; give the instant of ψ = 0 as a date, such "
            f"as pd.Timestamp('2026-05-01 12:00')"
        ) from None
    return stamp.isoformat()


def check_one_phase(omega, azimuth):
    """Raise ValueError unless exactly one of the two says where in the period a row is."""
    if omega is None and azimuth is None:
        raise ValueError(
            "omega=None and azimuth=None leave the period unknown; give omega in rad/s, or "
            "azimuth, the name of the column that holds ψ in rad"
        )
    if omega is not None and azimuth is not None:
        raise ValueError(
            f"omega={omega!r} and azimuth={azimuth!r} are both given; keep omega for a constant "
            f"speed, or azimuth for one that varies, and leave the other at None"
        )


def check_azimuth(psi, time, name):
    """Raise ValueError unless ψ grows from row to row, by less than half a turn."""
    known = np.flatnonzero(np.isfinite(psi))
    steps = np.diff(psi[known])
    if np.any(steps <= 0.0):
        row = known[int(np.argmax(steps <= 0.0)) + 1]
        raise ValueError(
            f"azimuth column {name!r} must grow with time: it does not at t = {time[row]:.6g} s, "
            f"where ψ = {psi[row]:.6g} rad; drop the rows at which the rotor stands or turns "
            f"back (its sign is yours to choose)"
        )
    consecutive = np.diff(known) == 1
    if np.any(steps[consecutive] >= np.pi):
        largest = steps[consecutive].max()
        raise ValueError(
            f"azimuth column {name!r} grows by up to {largest:.4g} rad from row to row, which is "
            f"half a turn or more; give it in radians, not degrees, and at least two samples a "
            f"revolution"
        )


def check_harmonics(name, harmonics, signals):
    """Harmonics kept of each signal, as a tuple of (signal, (k, …)).

    An int N keeps 0 … N of every signal; a dict names the harmonics of each.
    """
    if isinstance(harmonics, dict):
        unknown = [key for key in harmonics if key not in signals]
        if unknown:
            raise ValueError(
                f"{name} names the signal {unknown[0]!r}, which is not among {list(signals)}; "
                f"use the column names of the data"
            )
        missing = [signal for signal in signals if signal not in harmonics]
        if missing:
            raise ValueError(
                f"{name} says nothing of the signal {missing[0]!r}; add its harmonics, or drop "
                f"that column from the data"
            )
        items = [(signal, harmonics[signal]) for signal in signals]
    elif isinstance(harmonics, numbers.Integral) and not isinstance(harmonics, bool):
        if harmonics < 0:
            raise ValueError(f"{name}={harmonics} is negative; use 0 (the mean alone) or more")
        items = [(signal, range(int(harmonics) + 1)) for signal in signals]
    else:
        raise ValueError(
            f"{name}={harmonics!r} is not understood; give a whole number N (harmonics 0 … N) "
            f"or a dict such as {{'w': [0], 'phi_dot': [1]}}"
        )
    return tuple((signal, _check_orders(name, signal, orders)) for signal, orders in items)


def _check_orders(name, signal, orders):
    try:
        kept = tuple(orders)
    except TypeError:
        kept = (orders,)
    wrong = [k for k in kept if isinstance(k, bool) or not isinstance(k, numbers.Integral) or k < 0]
    if wrong or not kept or len(set(kept)) != len(kept):
        raise ValueError(
            f"{name}: harmonics of {signal!r} are {list(kept)!r}; give distinct whole numbers of "
            f"at least 0, such as [0, 1]"
        )
    return tuple(sorted(int(k) for k in kept))


def check_outputs_given(y):
    """Raise ValueError if there are no outputs to fit."""
    if y is None:
        raise ValueError(
            "requires y to be passed, but the target y is None: give the measured outputs"
        )


def check_same_rows(X, y):
    """Raise ValueError unless inputs and outputs have the same rows."""
    if len(X) != len(y):
        raise ValueError(
            f"X has {len(X)} rows and y has {len(y)}: inputs and outputs must be sampled at the "
            f"same times; select the rows they share"
        )
    both = all(isinstance(data, pd.DataFrame | pd.Series) for data in (X, y))
    if both and not X.index.equals(y.index):
        raise ValueError(
            "X and y have different indices: inputs and outputs must be sampled at the same "
            "times; align them first, for example with X, y = X.align(y, axis=0, join='inner')"
        )


def check_period(omega, sample_time, highest_harmonic, uncertainty=0.0):
    """Samples in a period, a whole number and enough for the harmonics kept.

    ``uncertainty`` of the sample time, in seconds, widens what counts as whole.
    """
    period = 2.0 * np.pi / omega
    samples = period / sample_time
    tolerance = PERIOD_TOLERANCE + 4.0 * samples * uncertainty / sample_time
    check_rate(
        samples,
        highest_harmonic,
        f"omega={omega:.6g} rad/s and a sample time of {sample_time:.6g} s give {samples:.4g} "
        f"samples a period",
    )
    if abs(samples - round(samples)) > min(tolerance, 0.1):
        raise ValueError(
            f"omega={omega:.9g} rad/s and a sample time of {sample_time:.9g} s give {samples:.6g} "
            f"samples a period, not a whole number; resample to {round(samples)} samples a period "
            f"(a sample time of {period / round(samples):.9g} s) or correct omega"
        )
    return round(samples)


def check_rate(samples, highest_harmonic, given):
    """Raise ValueError if there are too few samples in a period for the harmonics kept."""
    need = max(2 * highest_harmonic, 2)
    if samples < need - PERIOD_TOLERANCE:
        raise ValueError(
            f"{given}, too few for harmonic {highest_harmonic}: at least two samples in a "
            f"period of the highest harmonic kept are needed (here {need}); sample faster or keep "
            f"fewer harmonics"
        )


def read_time(data, sample_time=None, time_origin=None):
    """Time base of a frame, Series or array.

    Steps between 0.6 and 1.4 sample times are consecutive: rows whose instants
    jitter by up to a fifth of a sample. A longer step is a gap if it is a whole
    number of samples, give or take the same jitter at both of its ends.

    Parameters
    ----------
    data : DataFrame, Series or ndarray
        The index holds seconds (float), Timedelta or dates, alone or as the
        last level of a (record, time) MultiIndex; integers count samples.
    sample_time : float, optional
        Seconds; None reads it from the index, or is 1.0 where samples are counted.
    time_origin : str, optional
        The instant from which dates are counted, as ISO text, or FIRST for the
        first of them; None refuses dates.

    Returns
    -------
    base : TimeBase
    """
    if sample_time is not None:
        hint = "None reads it from the index"
        sample_time = check_positive("sample_time", sample_time, "seconds", hint)
    index = getattr(data, "index", None)
    if not isinstance(index, pd.Index):
        index = pd.RangeIndex(len(data))
    if isinstance(index, pd.MultiIndex):
        codes = [index.codes[level] for level in range(index.nlevels - 1)]
        starts = np.flatnonzero(np.any([np.diff(code) != 0 for code in codes], axis=0)) + 1
        times = index.get_level_values(-1)
    else:
        starts, times = np.empty(0, dtype=int), index
    seconds, counted = _seconds(times, sample_time, time_origin)
    bounds = [0, *starts.tolist(), len(seconds)]
    for a, b in itertools.pairwise(bounds):
        _check_increasing(seconds, a, b)
    steps = np.concatenate([np.diff(seconds[a:b]) for a, b in itertools.pairwise(bounds)])
    found = float(np.median(steps)) if steps.size else 1.0
    unit = sample_time if counted and sample_time is not None else found
    segments, records = [], []
    for a, b in itertools.pairwise(bounds):
        for segment in _runs(seconds, a, b, unit):
            segments.append(segment)
            records.append(index[a][0] if isinstance(index, pd.MultiIndex) else 0)
    found, jitter, uncertainty = _mean_step(seconds, segments, found)
    if sample_time is None:
        sample_time = found
    tolerance = STEP_TOLERANCE * sample_time + 4.0 * uncertainty
    if not counted and steps.size and abs(found - sample_time) > tolerance:
        raise ValueError(
            f"sample_time={sample_time:.6g} s, but the rows of the index are {found:.6g} s apart; "
            f"leave sample_time at None, or resample the data"
        )
    return TimeBase(
        seconds, tuple(segments), tuple(records), sample_time, counted, jitter, uncertainty
    )


def _seconds(times, sample_time, time_origin):
    """Times in seconds, and whether samples were counted."""
    if isinstance(times, pd.DatetimeIndex):
        return _since(times, time_origin), False
    if time_origin not in (None, FIRST):
        raise ValueError(
            f"time_origin={time_origin} is given, but the index has dtype {times.dtype}, which "
            f"holds no dates; leave time_origin at None (ψ = 0 at t = 0), or index by dates"
        )
    if isinstance(times, pd.TimedeltaIndex):
        return times.total_seconds().to_numpy(), False
    if pd.api.types.is_integer_dtype(times.dtype):
        return times.to_numpy() * (1.0 if sample_time is None else sample_time), True
    if not pd.api.types.is_float_dtype(times.dtype):
        raise ValueError(
            f"the index has dtype {times.dtype}, which is no time; use seconds (float), Timedelta, "
            f"dates, integers that count samples, or a (record, time) MultiIndex"
        )
    return times.to_numpy(dtype=float), False


def _since(times, origin):
    """Seconds from an instant to each date."""
    if origin is None:
        raise ValueError(
            "the index holds dates, which fix no azimuth; give HarmonicAnalyzer the instant of "
            "ψ = 0 as time_origin, such as time_origin=data.index[0]"
        )
    origin = times.min() if origin == FIRST else pd.Timestamp(origin)
    if (origin.tzinfo is None) != (times.tz is None):
        aware, naive = "time_origin", "index"
        if times.tz is not None:
            aware, naive = naive, aware
        raise ValueError(
            f"the {aware} has a time zone and the {naive} has none (time_origin={origin}, index of "
            f"dtype {times.dtype}); give both one, with tz_localize, or neither"
        )
    return (times - origin).total_seconds().to_numpy()


def _check_increasing(seconds, start, stop):
    """Raise ValueError unless time increases within one record."""
    if not np.all(np.isfinite(seconds[start:stop])):
        raise ValueError("the time index contains NaN or infinity; drop those rows")
    step = np.diff(seconds[start:stop])
    if np.any(step <= 0):
        row = start + int(np.argmax(step <= 0)) + 1
        word = "repeated" if step[row - start - 1] == 0 else "smaller than the one before it"
        raise ValueError(
            f"time must increase within a record: t = {seconds[row]:.6g} s (row {row}) is {word}; "
            f"sort the rows, drop duplicates, or give each record its own label in a "
            f"(record, time) MultiIndex. Rows drawn at random (HalvingGridSearchCV over "
            f"n_samples, a shuffled split) have no dynamics: halve over another resource, and "
            f"split with TimeSeriesSplit, GroupKFold or PeriodBlockSplit"
        )


def _runs(seconds, start, stop, sample_time):
    """Consecutive runs of one record, whose steps may jitter."""
    step = np.diff(seconds[start:stop]) / sample_time
    odd = np.abs(step - np.maximum(np.rint(step), 1.0)) > 2.0 * JITTER_LIMIT
    if np.any(odd):
        row = start + int(np.argmax(odd)) + 1
        raise ValueError(
            f"the step to t = {seconds[row]:.6g} s (row {row}) is {step[row - start - 1]:.4g} "
            f"samples of {sample_time:.6g} s: too uneven for jitter (0.6 to 1.4 samples) and not "
            f"a whole number, as a gap would be; resample the data, drop the stray rows, or give "
            f"parts with clocks of their own a label each in a (record, time) MultiIndex"
        )
    edges = [start, *(np.flatnonzero(np.rint(step) > 1.0) + start + 1).tolist(), stop]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def even(places, step):
    """Whether neighbours are one step apart, so that nothing need be resampled."""
    return bool(np.all(np.abs(np.diff(places) - step) <= STEP_TOLERANCE * step))


def _mean_step(seconds, segments, found):
    """Sample time, jitter (rms, largest) and standard error of the sample time.

    Evenly spaced rows keep the step found; else lines of one slope are fitted
    to all segments by least squares.
    """
    if all(even(seconds[segment], found) for segment in segments):
        return found, (0.0, 0.0), 0.0
    counts, times = [], []
    for segment in segments:
        rows = np.arange(segment.stop - segment.start, dtype=float)
        counts.append(rows - rows.mean())
        times.append(seconds[segment] - seconds[segment].mean())
    counts, times = np.concatenate(counts), np.concatenate(times)
    slope = float(counts @ times / (counts @ counts))
    off = times - slope * counts
    rms = float(np.sqrt(np.mean(off**2)))
    return slope, (rms, float(np.max(np.abs(off)))), rms / float(np.sqrt(counts @ counts))
