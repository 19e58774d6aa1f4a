"""The one place that words errors about time, period, shape and finite values."""

import itertools
import numbers
from dataclasses import dataclass

import numpy as np
import pandas as pd

PERIOD_TOLERANCE = 1e-3  # samples by which a period may miss a whole number
STEP_TOLERANCE = 1e-3  # share of the sample time by which a step may differ


@dataclass(frozen=True)
class TimeBase:
    """When each row was sampled, and where rows stop being consecutive.

    Attributes
    ----------
    time : ndarray, shape (n_samples,)
        Seconds.
    segments : tuple of slice
        Runs of consecutive rows; a new record or a gap starts a new one.
    records : tuple
        Label of the record of each segment (0 where there is but one).
    sample_time : float
        Seconds.
    counted : bool
        True where samples were counted because no times were given.
    """

    time: np.ndarray
    segments: tuple
    records: tuple
    sample_time: float
    counted: bool


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


def check_finite(values, names, time, what):
    """Raise ValueError naming the column and the first time of a value that is not finite."""
    bad = ~np.isfinite(values)
    if bad.any():
        row = int(np.argmax(bad.any(axis=1)))
        column = int(np.argmax(bad[row]))
        kind = "NaN" if np.isnan(values[row, column]) else "infinity"
        raise ValueError(
            f"{what} contains {kind}: column {names[column]!r}, first at t = {time[row]:.6g} s "
            f"(row {row}); drop those rows (a gap starts a new segment) or fill them before fitting"
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


def check_period(omega, sample_time, highest_harmonic):
    """Samples in a period, a whole number and enough for the harmonics kept."""
    period = 2.0 * np.pi / omega
    samples = period / sample_time
    need = max(2 * highest_harmonic, 2)
    if samples < need - PERIOD_TOLERANCE:
        raise ValueError(
            f"omega={omega:.6g} rad/s and a sample time of {sample_time:.6g} s give {samples:.4g} "
            f"samples a period, too few for harmonic {highest_harmonic}: at least two samples in a "
            f"period of the highest harmonic kept are needed (here {need}); sample faster or keep "
            f"fewer harmonics"
        )
    if abs(samples - round(samples)) > PERIOD_TOLERANCE:
        raise ValueError(
            f"omega={omega:.9g} rad/s and a sample time of {sample_time:.9g} s give {samples:.6g} "
            f"samples a period, not a whole number; resample to {round(samples)} samples a period "
            f"(a sample time of {period / round(samples):.9g} s) or correct omega"
        )
    return round(samples)


def read_time(data, sample_time=None):
    """Time base of a frame, Series or array.

    Parameters
    ----------
    data : DataFrame, Series or ndarray
        The index holds seconds (float) or Timedelta, alone or as the last
        level of a (record, time) MultiIndex; integers count samples.
    sample_time : float, optional
        Seconds; None reads it from the index, or is 1.0 where samples are counted.

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
    seconds, counted = _seconds(times, sample_time)
    bounds = [0, *starts.tolist(), len(seconds)]
    steps = np.concatenate([np.diff(seconds[a:b]) for a, b in itertools.pairwise(bounds)])
    found = float(np.median(steps)) if steps.size else 1.0
    if sample_time is None:
        sample_time = found
    elif not counted and steps.size and abs(found - sample_time) > STEP_TOLERANCE * sample_time:
        raise ValueError(
            f"sample_time={sample_time:.6g} s, but the rows of the index are {found:.6g} s apart; "
            f"leave sample_time at None, or resample the data"
        )
    segments, records = [], []
    for a, b in itertools.pairwise(bounds):
        for segment in _runs(seconds, a, b, sample_time):
            segments.append(segment)
            records.append(index[a][0] if isinstance(index, pd.MultiIndex) else 0)
    return TimeBase(seconds, tuple(segments), tuple(records), sample_time, counted)


def _seconds(times, sample_time):
    """Times in seconds, and whether samples were counted."""
    if isinstance(times, pd.DatetimeIndex):
        raise ValueError(
            "the index holds dates, which fix no azimuth; subtract the instant of ψ = 0, as in "
            "data.set_axis(data.index - origin), to get a Timedelta index"
        )
    if isinstance(times, pd.TimedeltaIndex):
        return times.total_seconds().to_numpy(), False
    if pd.api.types.is_integer_dtype(times.dtype):
        return times.to_numpy() * (1.0 if sample_time is None else sample_time), True
    if not pd.api.types.is_float_dtype(times.dtype):
        raise ValueError(
            f"the index has dtype {times.dtype}, which is no time; use seconds (float), Timedelta, "
            f"integers that count samples, or a (record, time) MultiIndex"
        )
    return times.to_numpy(dtype=float), False


def _runs(seconds, start, stop, sample_time):
    """Consecutive runs of one record, after checking that time increases."""
    step = np.diff(seconds[start:stop])
    if not np.all(np.isfinite(seconds[start:stop])):
        raise ValueError("the time index contains NaN or infinity; drop those rows")
    if np.any(step <= 0):
        row = start + int(np.argmax(step <= 0)) + 1
        word = "repeated" if step[row - start - 1] == 0 else "smaller than the one before it"
        raise ValueError(
            f"time must increase within a record: t = {seconds[row]:.6g} s (row {row}) is {word}; "
            f"sort the rows, drop duplicates, or give each record its own label in a "
            f"(record, time) MultiIndex"
        )
    breaks = np.flatnonzero(np.abs(step - sample_time) > STEP_TOLERANCE * sample_time) + start + 1
    edges = [start, *breaks.tolist(), stop]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]
