"""Errors about parameters, period, shape and finite values, in one place."""

import math
import numbers
import os
import reprlib
from pathlib import Path

import numpy as np
import pandas as pd
from pandas.api.types import (
    is_datetime64_any_dtype,
    is_float_dtype,
    is_integer_dtype,
    is_timedelta64_dtype,
)

from sklearn_hd._guards import square_sums

STANDARD_ERRORS = 4.0  # by which chance does not move what is estimated
LITTLE = 1e-2  # of a variance: less is no matter
DECISIVE = 4.0  # times the variance that another model leaves, which tells more than doubts
PERIOD_TOLERANCE = 1e-3  # samples by which a period may miss a whole number
MOST_SAMPLES = 1e7  # in a period
MOST = 2**32 - 1  # of anything counted
DRIFT_LIMIT = 0.25  # samples by which the periods of a segment may miss one
FIRST = "first sample"  # the time origin of dates that fix no azimuth
SMALLEST = 1e-200  # signals nowhere larger are zero; 1 over it is the largest allowed
COMMON = 1e300  # above any sum of squares of a signal of common size; 1 over it is below
NO_TIMES = (
    " (the index of X holds no times, so rows are counted; give sample_time or index X by seconds; "
    "if an earlier step dropped the index, keep it with that step's "
    ".set_output(transform='pandas'))"
)
RAISE, GAP = "raise", "gap"  # what becomes of missing samples


def at(time):
    """A time worded for messages, to six digits, or to the millisecond (Unix seconds)."""
    return f"{time:.3f} s" if 1e5 <= abs(time) < 1e12 else f"{time:.6g} s"


def check_positive(name, value, unit, hint):
    """Return a float if it is a positive finite number."""
    return _check_number(name, value, "positive", f" in {unit}", hint)


def check_numbers(kind, hint, **values):
    """Raise ValueError unless all values are numbers of a kind.

    The kind is "finite", "nonnegative" or "positive", the last two finite as well.
    """
    for name, value in values.items():
        _check_number(name, value, kind, "", hint)


def _check_number(name, value, kind, unit, hint):
    allowed = _is_real(value) and (
        kind == "finite" or value > 0 or (kind == "nonnegative" and value == 0)
    )
    if not allowed:
        raise ValueError(f"{name} must be a {kind} number{unit}, got {value!r}; {hint}")
    return float(value)


def _is_real(value):
    """Whether it is a finite number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def check_fraction(name, value, hint, *, zero=False):
    """Return a float if it lies between 0 and 1, or may be 0 as well."""
    if not _is_real(value) or not (0.0 < value < 1.0 or (zero and value == 0.0)):
        allowed = "from 0 to below 1" if zero else "between 0 and 1"
        raise ValueError(f"{name} must be a number {allowed}, got {value!r}; {hint}")
    return float(value)


def path_of_file(path, example):
    """The path of a file; an error says if it is none, or a folder."""
    if not isinstance(path, str | os.PathLike):
        raise TypeError(f"path={path!r} is no path; give the name of a file, such as {example!r}")
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"path={str(path)!r} is a folder; give the name of a file within it")
    return path


def path_to_write(path, example):
    """The path of a file in a folder that exists; an error names what is in the way."""
    path = path_of_file(path, example)
    if not path.parent.is_dir():
        raise ValueError(
            f"path={str(path)!r}: the folder {str(path.parent)!r} does not exist; make it, or give "
            f"a path in a folder that exists"
        )
    return path


def real_array(name, values, wanted):
    """Finite real numbers as an array of floats; ``wanted`` words what they should be."""
    try:
        array = np.asarray(values)
        texts = array.dtype.kind == "O" and any(v is None or isinstance(v, str) for v in array.flat)
        if array.dtype.kind not in "biufO" or texts:
            raise TypeError("no real numbers")
        array = array.astype(float, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"{name}={reprlib.repr(values)} is not an array of real numbers; give {wanted}"
        ) from None
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} holds NaN or infinity; give {wanted}")
    return array


def check_weight(sample_weight, n_samples):
    """Weights as an array of floats, one for each row, or None."""
    if sample_weight is None:
        return None
    try:
        weight = np.asarray(sample_weight, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("sample_weight holds values that are not numbers") from None
    if weight.shape != (n_samples,) or not np.all((weight >= 0.0) & np.isfinite(weight)):
        raise ValueError(
            f"sample_weight has shape {weight.shape}; give one finite weight of at least zero for "
            f"each of the {n_samples} rows"
        )
    return weight


def check_frequencies(frequencies):
    """Frequencies as a finite array of one dimension."""
    wanted = "finite real numbers in rad/s, in one dimension"
    array = np.atleast_1d(real_array("frequencies", frequencies, wanted))
    if array.ndim != 1:
        raise ValueError(f"frequencies has shape {array.shape}; give {wanted}")
    return array


def check_choice(name, value, allowed):
    """Return the value if it is one of the choices."""
    if not isinstance(value, str) or value not in allowed:
        choices = ", ".join(repr(choice) for choice in allowed)
        raise ValueError(f"{name}={value!r} is not known; use one of {choices}")
    return value


def check_flag(name, value):
    """Return a bool if it is one."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_count(name, value, minimum, hint):
    """Return an int if it is a whole number, at least some minimum and of 32 bits at most."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < minimum:
        raise ValueError(
            f"{name} must be a whole number of at least {minimum}, got {value!r}; {hint}"
        )
    if value > MOST:
        raise ValueError(
            f"{name} must be a whole number of at most {MOST}, got {reprlib.repr(value)}; {hint}"
        )
    return int(value)


def signal_names(data, prefix):
    """Column names of a frame, Series or array; arrays are numbered from x0."""
    if isinstance(data, pd.DataFrame):
        names = [str(column) for column in data.columns]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ValueError(
                f"column {repeated[0]!r} appears more than once; give each signal a name of its own"
            )
        return tuple(names)
    if isinstance(data, pd.Series):
        return (str(data.name) if data.name is not None else f"{prefix}0",)
    width = 1 if data.ndim == 1 else data.shape[1]
    return tuple(f"{prefix}{i}" for i in range(width))


def check_values(values, names, time, what, missing=RAISE):
    """Return the values, once they are neither NaN nor infinite, too large nor too small.

    NaN is let through where ``missing`` has a rule for it, unless a column holds nothing else. With
    None, the message names no parameter ``missing``. See ``check_size``, too; a sum of squares of a
    common size says as much.
    """
    squares = square_sums(values)
    if np.all((squares > 1.0 / COMMON) & (squares < COMMON)):
        return values
    empty = np.isnan(values).all(axis=0) & (len(values) > 0)
    if empty.any() and missing not in (RAISE, None):
        raise ValueError(
            f"{what} has no values in column {names[int(np.argmax(empty))]!r}: all are NaN; drop it"
        )
    bad = ~np.isfinite(values) if missing in (RAISE, None) else np.isinf(values)
    if bad.any():
        row = int(np.argmax(bad.any(axis=1)))
        column = int(np.argmax(bad[row]))
        nan = np.isnan(values[row, column])
        kind, way = ("NaN", "") if nan else ("infinity", "set such values to NaN and ")
        rule = (
            f"{way}give HarmonicAnalyzer missing=seconds, the longest run of NaN to bridge, or "
            f"missing='gap' if runs are long (each starts a new segment); or fill them, or drop "
            f"those rows"
        )
        raise ValueError(
            f"{what} contains {kind}: column {names[column]!r}, first at t = {at(time[row])} "
            f"(row {row}); {'drop those rows, or fill them' if missing is None else rule}"
        )
    return check_size(values, names, what)


def check_size(values, names, what):
    """Return the values, with signals too small for squares of them set to zero.

    Raises ValueError naming a signal that is too large.
    """
    largest = np.array([np.fmax.reduce(np.abs(column), initial=0.0) for column in values.T])
    for name, size in zip(names, largest, strict=True):
        if size > 1.0 / SMALLEST:
            raise ValueError(
                f"{what} reaches {size:.3g} in column {name!r}, too large to be squared: at most "
                f"{1.0 / SMALLEST:g} is allowed; give it in other units"
            )
    tiny = (largest > 0.0) & (largest < SMALLEST)
    return np.where(tiny, 0.0, values) if tiny.any() else values


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


def check_phase(omega, azimuth, time_origin):
    """Return the origin of dates, after checking what says where in the period a row is.

    Exactly one of ω and the name of an azimuth column does.
    """
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
    origin = check_time_origin(time_origin)
    if azimuth is None:
        hint = "it is 2π over the period, such as 2 * np.pi * 26.3 for 26.3 beats a second"
        check_positive("omega", omega, "rad/s", hint)
        return origin
    if not isinstance(azimuth, str):
        raise ValueError(
            f"azimuth={azimuth!r} is not a name; give the name of the column of X that holds ψ in "
            f"rad (the columns of an array are called x0, x1, …)"
        )
    return FIRST if origin is None else origin


def check_span(name, span, *words):
    """Return (start, stop) as floats if they are seconds, the first before the second.

    Some words stand for spans, too.
    """
    if isinstance(span, str) and span in words:
        return span
    edges = () if isinstance(span, str) or not np.iterable(span) else tuple(span)
    number = [isinstance(e, numbers.Real) and not isinstance(e, bool) for e in edges]
    if len(edges) != 2 or not all(number) or not edges[0] < edges[1]:
        hint = ""
        if any(hasattr(edge, "timestamp") or hasattr(edge, "total_seconds") for edge in edges):
            hint = "; of dates, (start - time_origin).total_seconds() and so on"
        raise ValueError(
            f"{name}={span!r} is not a pair of times; give (start, stop) in seconds, start before "
            f"stop, {''.join(f'{word!r} ' for word in words)}or None{hint}"
        )
    return float(edges[0]), float(edges[1])


def check_wrap(psi, name):
    """Raise ValueError if ψ jumps back at each turn, but not after 2π."""
    known = psi[np.isfinite(psi)]
    drops = np.diff(known)[np.diff(known) < 0.0]
    wrapped = len(drops) and np.ptp(known) > 4.0 * np.pi and -np.median(drops) > 4.0 * np.pi
    if wrapped:
        raise ValueError(
            f"azimuth column {name!r} jumps back after {np.ptp(known):.4g}, not after 2π rad; give "
            f"it in radians, not degrees: np.deg2rad(X[{name!r}])"
        )


def check_azimuth(psi, time, name):
    """Raise ValueError unless ψ grows from row to row, by less than half a turn."""
    known = np.flatnonzero(np.isfinite(psi))
    steps = np.diff(psi[known])
    if np.any(steps <= 0.0):
        row = known[int(np.argmax(steps <= 0.0)) + 1]
        raise ValueError(
            f"azimuth column {name!r} must increase with time, but does not at t = "
            f"{at(time[row])}, where ψ = {psi[row]:.6g} rad; drop the rows where the rotor stands "
            f"still or turns back (if ψ always decreases, change its sign)"
        )
    consecutive = np.diff(known) == 1
    if np.any(steps[consecutive] >= np.pi):
        largest = steps[consecutive].max()
        raise ValueError(
            f"azimuth column {name!r} grows by up to {largest:.4g} rad from row to row, which is "
            f"half a turn or more; give it in radians, not degrees, and sample at least twice per "
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
                f"{name} gives no harmonics for the signal {missing[0]!r}; add them, or drop that "
                f"column from the data"
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
    if not isinstance(y, pd.DataFrame | pd.Series):
        return
    index = X.index if isinstance(X, pd.DataFrame | pd.Series) else pd.RangeIndex(len(X))
    counts = [is_integer_dtype(each.dtype) for each in (index, y.index)]
    if counts == [True, False]:
        raise ValueError(
            "y has times in its index, but X has none: X may have lost its times in a step before "
            "this one; keep them with that step's .set_output(transform='pandas'), or give X the "
            "index of y"
        )
    if not index.equals(y.index) and isinstance(X, pd.DataFrame | pd.Series):
        hint = " (y has no times: use y.set_axis(X.index) if its rows are those of X)" * counts[1]
        if all(counts) and index.equals(pd.RangeIndex(len(X))):  # an array, cut by a split
            hint = f" (X counts from 0, y from {y.index[0]}: give X the index of y, or use arrays)"
        way = "align them first, for example with X, y = X.align(y, axis=0, join='inner')"
        apart = _small_distance(index, y.index)
        if apart is not None:
            way = f"they differ by {apart} at most: use y.set_axis(X.index) if rows go together"
        raise ValueError(
            f"X and y have different indices{hint}: inputs and outputs must be sampled at the same "
            f"times; {way}"
        )


def _small_distance(index, other):
    """The largest distance of the times of two clocks, if less than half a step; else None."""
    if len(index) != len(other) or len(index) < 2 or index.dtype != other.dtype:
        return None
    seconds = is_float_dtype(index)
    if not (seconds or is_datetime64_any_dtype(index) or is_timedelta64_dtype(index)):
        return None
    apart = np.max(np.abs(np.asarray(index - other)))
    if 2 * apart >= np.min(np.abs(np.diff(index))):
        return None
    return f"{apart:.2g} s" if seconds else pd.Timedelta(apart)


def check_output_names(names, expected, where):
    """Raise ValueError unless outputs are those expected, in their order; arrays have no names."""
    numbered = tuple(f"y{i}" for i in range(len(expected)))
    if len(names) != len(expected):
        raise ValueError(
            f"y has {len(names)} columns, but {where} was fitted with {len(expected)}: "
            f"{list(expected)}; give the same outputs"
        )
    if names != expected and numbered not in (names, expected):
        way = f"y[{list(expected)}]" if set(names) == set(expected) else "the same columns"
        raise ValueError(
            f"y has the columns {list(names)}, but {where} was fitted with {list(expected)}; "
            f"give {way}"
        )


def check_period(omega, sample_time, highest_harmonic, counted=False):
    """Samples in a period, a whole number and enough for the harmonics kept.

    ``counted`` says that there were no times.
    """
    lost = NO_TIMES if counted else ""
    samples, whole = _samples(omega, sample_time, highest_harmonic, 0.0, lost)
    if not whole:
        step = 2.0 * np.pi / omega / round(samples)
        raise ValueError(
            f"omega={omega:.9g} rad/s and a sample time of {sample_time:.9g} s give {samples:.6g} "
            f"samples a period{lost}, not a whole number; resample to {round(samples)} samples a "
            f"period (a sample time of {step:.9g} s) or correct omega"
        )
    return round(samples)


def whole_period(omega, base, highest_harmonic):
    """Samples in a period, and whether they may be taken for the nearest whole number.

    They may if they miss it by less than the uncertainty of the sample time
    and a thousandth of a sample, and by less than a quarter over a segment.
    """
    samples, whole = _samples(omega, base.sample_time, highest_harmonic, base.uncertainty)
    if base.jitter[1] == 0.0:  # else rows are placed by their own times
        step = 2.0 * np.pi / omega / round(samples)
        drift = [
            (base.time[s.stop - 1] - base.time[s.start]) / step - (s.stop - 1 - s.start)
            for s in base.segments
        ]
        whole = whole and np.max(np.abs(drift)) <= DRIFT_LIMIT
    return samples, bool(whole)


def _samples(omega, sample_time, highest_harmonic, uncertainty, hint=""):
    """Samples in a period, checked to be enough, and whether they are a whole number."""
    samples = 2.0 * np.pi / omega / sample_time
    check_rate(
        samples,
        highest_harmonic,
        f"omega={omega:.6g} rad/s and a sample time of {sample_time:.6g} s give {samples:.4g} "
        f"samples a period{hint}",
    )
    tolerance = PERIOD_TOLERANCE + STANDARD_ERRORS * samples * uncertainty / sample_time
    return samples, abs(samples - round(samples)) <= min(tolerance, 0.1)


def check_rate(samples, highest_harmonic, given):
    """Raise ValueError if there are too few samples in a period for the harmonics kept."""
    need = max(2 * highest_harmonic, 2)
    if samples < need - PERIOD_TOLERANCE:
        raise ValueError(
            f"{given}, too few for harmonic {highest_harmonic}: at least two samples in a "
            f"period of the highest harmonic kept are needed (here {need}); check the units (omega "
            f"in rad/s, times in seconds), sample faster, or keep fewer harmonics"
        )
    if samples > MOST_SAMPLES:
        raise ValueError(
            f"{given}, more than {MOST_SAMPLES:g}, which no record holds; correct omega (rad/s) "
            f"or the times (seconds)"
        )
