"""When rows were sampled: the index as seconds, records and gaps, jitter and rounding."""

import itertools
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd

from sklearn_hd._checks import FIRST, STANDARD_ERRORS, at, check_positive
from sklearn_hd._guards import warn
from sklearn_hd.exceptions import JitterWarning

STEP_TOLERANCE = 1e-3  # share of the sample time by which a step may differ
ROUNDED = 1e-9  # share of the sample time by which rounded times may move it
REPRESENTATIVE = 1001  # of steps that are alike
SHORT = 8  # rows from gap to gap, below which the gaps are no accident
MOST_DECIMALS = 9  # of times in seconds, whose rounding is told from jitter
ROUNDS_BY = 0.6  # of a clock's unit: a half, and what a fitted line may be off
SEVERAL = 20  # steps that are longer or shorter, by which a clock shows
WHOLE = 0.01  # of a clock's unit, by which the floats of a time may miss it
JITTER_LIMIT = 0.2  # of the sample time, by which the instant of a row may be off


@dataclass(frozen=True)
class TimeBase:
    """When each row was sampled, and where rows stop being consecutive."""

    time: np.ndarray  # (n_samples,): seconds
    # of slice: runs of consecutive rows; a new record or a gap starts a new one. Their steps may
    # jitter.
    segments: tuple
    records: tuple  # label of the record of each segment (0 where there is but one)
    sample_time: float  # seconds
    counted: bool  # True if rows count as samples because no times were given
    # (float, float): seconds by which rows are off evenly spaced instants: root mean square,
    # largest
    jitter: tuple = (0.0, 0.0)
    uncertainty: float = 0.0  # standard error of ``sample_time`` that the jitter leaves, seconds

    def even_steps(self):
        """The step of each segment of several rows, seconds, if all of them are even; else none."""
        bounds = [(rows.start, rows.stop) for rows in self.segments if rows.stop - rows.start > 1]
        if not all(_alike(self.time, each) for each in bounds):
            return []
        return [float(np.median(np.diff(self.time[a:b]))) for a, b in bounds]

    def rows_of_records(self):
        """Rows and label of each record, whatever gaps are in it."""
        segments, time = self.segments, self.time
        starts = [0]
        for i in range(1, len(segments)):
            again = time[segments[i].start] <= time[segments[i].start - 1]  # time begins anew
            if again or self.records[i] != self.records[i - 1]:
                starts.append(i)
        for first, following in itertools.pairwise([*starts, len(segments)]):
            rows = slice(segments[first].start, segments[following - 1].stop)
            yield rows, self.records[first]


def read_time(data, sample_time=None, time_origin=None, row_time=None, of_fit=False):
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
        Seconds; None reads it from the index, or is ``row_time`` where samples are counted.
    time_origin : str, optional
        The instant from which dates are counted, as ISO text, or FIRST for the
        first of them; None refuses dates.
    row_time : float, optional
        Seconds from one counted sample to the next; 1.0 by default.
    of_fit : bool, default=False
        Whether ``sample_time`` is that of the data at fit, for messages.
    """
    if sample_time is not None:
        hint = "None reads it from the index"
        sample_time = check_positive("sample_time", sample_time, "seconds", hint)
    index = getattr(data, "index", None)
    if not isinstance(index, pd.Index):
        index = pd.RangeIndex(len(data))
    if isinstance(index, pd.MultiIndex) and index.nlevels == 1:
        index = index.get_level_values(0)
    bounds = _record_bounds(index)
    times = index
    if isinstance(index, pd.MultiIndex):
        times = index.get_level_values(-1)
        _check_last_level(index)
    seconds, counted = _seconds(times, sample_time or row_time or 1.0, time_origin)
    first = _first_steps(seconds, bounds)
    if _alike(seconds, bounds) and (not counted or sample_time in (None, first[0])):
        found = float(np.median(first))
        if sample_time is None:
            sample_time = found
        _check_sample_time(sample_time, found, 0.0, of_fit)
        segments = tuple(slice(a, b) for a, b in itertools.pairwise(bounds))
        records = tuple(_label(index, a) for a in bounds[:-1])
        return TimeBase(seconds, segments, records, sample_time, counted)
    for a, b in itertools.pairwise(bounds):
        _check_increasing(seconds, a, b)
    steps = np.concatenate([np.diff(seconds[a:b]) for a, b in itertools.pairwise(bounds)])
    unit, uncertainty = float(np.median(steps)) if steps.size else 1.0, 0.0
    if counted:
        unit = unit if sample_time is None else sample_time
    else:
        if sample_time is None:
            _tell_of_coarse_clock(seconds, bounds, steps)
        near = [run for a, b in itertools.pairwise(bounds) for run in _near(seconds, a, b, unit)]
        unit, _, uncertainty = _mean_step(seconds, near, unit)
    segments, records = [], []
    for a, b in itertools.pairwise(bounds):
        for segment in _runs(seconds, a, b, unit, uncertainty):
            segments.append(segment)
            records.append(_label(index, a))
    found, jitter, uncertainty = _mean_step(seconds, segments, unit)
    if sample_time is None:
        sample_time = found
    if not counted and steps.size:
        _check_sample_time(sample_time, found, uncertainty, of_fit)
    return TimeBase(
        seconds, tuple(segments), tuple(records), sample_time, counted, jitter, uncertainty
    )


def _tell_of_coarse_clock(seconds, bounds, steps):
    """Say so if times are even ones that are rounded to a unit nearly as long as their steps.

    Steps then are n or n + 1 units (1, 2 or 5 of a decimal), n being one or two, the rarer of them
    about as many rows apart, and rows are within half a unit of a line. Rows lost at random are
    not; rows of which every so many is lost are, and may be both.
    """
    n, unit = _coarse_unit(steps)
    parts = [part for ends in itertools.pairwise(bounds) for part in _even(seconds, *ends, n, unit)]
    rows, every, short = max(parts, key=lambda part: len(part[1]), default=(None, [], 1.0))
    if len(every) < SEVERAL or (n == 2 and short < 0.5):
        return
    k = np.arange(rows.stop - rows.start) - 0.5 * (rows.stop - rows.start - 1)
    own = seconds[rows] - seconds[rows].mean()
    step = float(k @ own / (k @ k))
    if np.ptp(own - step * k) > 2.0 * ROUNDS_BY * unit:
        return
    told = (
        f"steps from row to row are {n} or {n + 1} times {unit:.6g} s, as those of times are that "
        f"are {step:.6g} s apart and rounded to {unit:.6g} s"
    )
    way = (
        f"if they are rounded, give each record even times, start + np.arange(n_rows) * "
        f"{step:.9g}; if rows are missing, give sample_time={unit:.6g}"
    )
    alternating = abs(short - 0.5) < 0.05  # every third row may be missing
    if n == 2 or np.ptp(every) > 0 or not (short > 0.5 or alternating):
        raise ValueError(f"{told}, or of rows that are missing: {way}")
    warn(
        f"{told}; they are read as rows {unit:.6g} s apart, of which one in {every[0] + 1} is "
        f"missing: {way}",
        JitterWarning,
    )


def _coarse_unit(steps):
    """n and the unit of a clock, of which the shortest steps are one or two; 0 and 0 if none is."""
    least = steps.min() if steps.size else 0.0
    for n in (1, 2) if least > 0.0 else ():
        unit = least / n
        decimals = 10.0 ** np.floor(np.log10(unit)) * np.array([1.0, 2.0, 5.0, 10.0])
        unit = float(decimals[np.argmin(np.abs(decimals - unit))])
        if np.max(np.abs(steps / unit - np.rint(steps / unit))) <= WHOLE:
            return n, unit
    return 0, 0.0


def _even(seconds, start, stop, n, unit):
    """Parts of a record whose steps are n or n + 1 units, the rarer about as many rows apart.

    Yields their rows, from one of the rarer steps to another, how many rows are between these, and
    the share of the short ones.
    """
    counts = np.rint(np.diff(seconds[start:stop]) / unit) if n else np.zeros(0)
    if not len(counts):
        return
    short = float(np.mean(counts == n))
    places = np.flatnonzero(counts == (n if short < 0.5 else n + 1))
    if len(places) < 2:
        return
    every = np.diff(places)
    even = np.abs(every - np.median(every)) <= 2.0  # one, and one where halves are rounded to even
    even &= np.maximum.reduceat(counts, places)[:-1] <= n + 1
    edges = [-1, *np.flatnonzero(~even).tolist(), len(even)]
    for a, b in itertools.pairwise(edges):
        if b > a + 1:
            yield slice(start + places[a + 1], start + places[b] + 1), every[a + 1 : b], short


def _first_steps(seconds, bounds):
    """Steps from row to row of the first records, as many as represent them."""
    found, n_found = [], 0
    for a, b in itertools.pairwise(bounds):
        found.append(np.diff(seconds[a : min(b, a + REPRESENTATIVE - n_found + 1)]))
        n_found += len(found[-1])
        if n_found >= REPRESENTATIVE:
            break
    return np.concatenate(found)


def _alike(seconds, bounds):
    """Whether all steps are one and the same, except for rounding."""
    steps = (np.diff(seconds[a:b]) for a, b in itertools.pairwise(bounds) if b - a > 1)
    ends = [(each.min(), each.max()) for each in steps]
    if not ends:
        return False
    least, most = np.min(ends), np.max(ends)
    return bool(least > 0.0 and most - least <= ROUNDED * least)


def _check_sample_time(given, found, uncertainty, of_fit):
    """Raise ValueError if a sample time, given or of the data at fit, is not that of the index."""
    if abs(found - given) <= STEP_TOLERANCE * given + STANDARD_ERRORS * uncertainty:
        return
    if of_fit:
        raise ValueError(
            f"the model was fitted to rows {given:.6g} s apart, but those of X are {found:.6g} s "
            f"apart; resample X to {given:.6g} s, use simulate of ltp_, or fit with "
            f"HarmonicAnalyzer(reading='sample'), whose models are predicted at any clock (if the "
            f"times of X are in another unit, give seconds)"
        )
    raise ValueError(
        f"sample_time={given:.6g} s, but the rows of the index are {found:.6g} s apart; leave "
        f"sample_time at None, which reads it from the index, or give the times in seconds"
    )


def why_short(base):
    """Reason for short segments, for messages; empty if there is none."""
    n_rows, n_segments = len(base.time), len(base.segments)
    n_gaps = n_segments - len(set(base.records))
    if n_gaps > 2 and n_rows < SHORT * n_gaps:
        step = np.median(np.diff(base.time)) / base.sample_time
        return (
            f" (the {n_rows} rows fall into {n_segments} segments: they are {step:.3g} samples of "
            f"{base.sample_time:.6g} s apart in the median; they may have been drawn at random, as "
            f"by a shuffled split, or thinned out: split with BlockSplit, PeriodBlockSplit or "
            f"GroupKFold, and keep the sample time of the data at fit)"
        )
    return ""


def _record_bounds(index):
    """First row of each record, and the number of rows."""
    if not isinstance(index, pd.MultiIndex):
        return [0, len(index)]
    codes = np.array([index.codes[level] for level in range(index.nlevels - 1)])
    if codes.size and codes.min() < 0:
        row = int(np.argmax(codes.min(axis=0) < 0))
        raise ValueError(
            f"the label of the record is missing in row {row} of the index; give every row the "
            f"label of its record, or drop it"
        )
    starts = np.flatnonzero(np.any(np.diff(codes, axis=1) != 0, axis=0)) + 1
    if 2 * (len(starts) + 1) > len(index) and len(np.unique(codes, axis=1).T) <= len(starts):
        raise ValueError(
            f"the records of the index are mixed (rows 0 and {int(starts[0])} are of "
            f"{_label(index, 0)!r} and {_label(index, int(starts[0]))!r}). If they are sorted by "
            f"time, use data.sort_index(), which sorts by record first. If they were drawn at "
            f"random (HalvingGridSearchCV over n_samples, a shuffled split), they have no "
            f"dynamics: halve over another resource, and split with BlockSplit, PeriodBlockSplit "
            f"or GroupKFold"
        )
    return [0, *starts.tolist(), len(index)]


def _check_last_level(index):
    """Raise ValueError if the times stand above the records."""
    *above, last = [_may_be_time(level) for level in index.levels]
    if last or not any(above):
        return
    counted = pd.api.types.is_integer_dtype(index.levels[-1].dtype)
    if not counted or len(index.droplevel(-1).unique()) * SHORT > len(index):
        raise ValueError(
            f"the last level of the index, {index.names[-1]!r}, has dtype "
            f"{index.levels[-1].dtype}, but a level above it looks like the times; the order is "
            f"(record, time): data.swaplevel().sort_index()"
        )


def _may_be_time(level):
    dates = isinstance(level, pd.DatetimeIndex | pd.TimedeltaIndex)
    return dates or pd.api.types.is_float_dtype(level.dtype)


def _label(index, row):
    """Label of the record of a row: a tuple where there are several levels above the time."""
    if not isinstance(index, pd.MultiIndex):
        return 0
    *label, _ = (x.item() if isinstance(x, np.generic) else x for x in index[row])
    return label[0] if len(label) == 1 else tuple(label)


def _seconds(times, step, time_origin):
    """Times in seconds, and whether samples were counted, which are some step apart."""
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
        return times.to_numpy() * step, True
    if not pd.api.types.is_float_dtype(times.dtype):
        raise ValueError(
            f"the index has dtype {times.dtype}, which is not a time{_conversion(times)}; use "
            f"seconds (float), Timedelta, dates, integers that count samples, or a (record, time) "
            f"MultiIndex"
        )
    return times.to_numpy(dtype=float), False


def _conversion(times):
    """The code that converts labels to times, for messages."""
    kind, way = pd.api.types.infer_dtype(times), None
    to_dates = partial(pd.to_datetime, format="ISO8601")
    if kind in ("floating", "integer", "mixed-integer-float", "decimal") or (
        kind == "string" and _reads(pd.to_numeric, times)
    ):
        way = "data.index.astype(float)"
    elif kind in ("datetime", "date") or (kind == "string" and _reads(to_dates, times)):
        way = "pd.to_datetime(data.index)"
    elif kind == "period":
        way = "data.index.to_timestamp()"
    return "" if way is None else f" (though its labels read as one: data.set_axis({way}))"


def _reads(convert, times):
    try:
        convert(times)
    except (TypeError, ValueError):
        return False
    return True


def _since(times, origin):
    """Seconds from an instant to each date."""
    if origin is None:
        raise ValueError(
            "the index holds dates, which do not define the azimuth; give the instant of ψ = 0 as "
            "time_origin, such as time_origin=data.index[0]; give HarmonicAnalyzer and "
            "PeriodBlockSplit the same"
        )
    origin = times.min() if origin == FIRST else pd.Timestamp(origin)
    if (origin.tzinfo is None) != (times.tz is None):
        aware, naive = "time_origin", "index"
        if times.tz is not None:
            aware, naive = naive, aware
        raise ValueError(
            f"the {aware} has a time zone but the {naive} has none (time_origin={origin}, index of "
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
            f"time must increase within a record: t = {at(seconds[row])} (row {row}) is {word}; "
            f"sort the rows, drop duplicates, or give each record its own label in a "
            f"(record, time) MultiIndex. Rows drawn at random (HalvingGridSearchCV over "
            f"n_samples, a shuffled split) have no dynamics: halve over another resource, and "
            f"split with BlockSplit, PeriodBlockSplit or GroupKFold"
        )


def _near(seconds, start, stop, sample_time):
    """Runs of one record whose steps are about as long as most."""
    step = np.diff(seconds[start:stop]) / sample_time
    far = np.abs(step - 1.0) > 2.0 * JITTER_LIMIT
    edges = [start, *(np.flatnonzero(far) + start + 1).tolist(), stop]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def _runs(seconds, start, stop, sample_time, uncertainty):
    """Consecutive runs of one record, whose steps may jitter.

    How many samples a long gap holds is known no better than the sample time:
    n samples are uncertain by n times its (four) standard errors.
    """
    step = np.diff(seconds[start:stop]) / sample_time
    tolerance = 2.0 * JITTER_LIMIT + STANDARD_ERRORS * uncertainty / sample_time * step
    odd = np.abs(step - np.maximum(np.rint(step), 1.0)) > tolerance
    if np.any(odd):
        row = start + int(np.argmax(odd)) + 1
        raise ValueError(
            f"the step to t = {at(seconds[row])} (row {row}) is {step[row - start - 1]:.4g} "
            f"samples of {sample_time:.6g} s: too uneven for jitter (0.6 to 1.4 samples), and not "
            f"a whole number, as a gap would be; resample the data, drop the stray rows, or label "
            f"parts with clocks of their own as separate records in a (record, time) MultiIndex"
        )
    edges = [start, *(np.flatnonzero(np.rint(step) > 1.0) + start + 1).tolist(), stop]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def resolution(time):
    """Seconds from one float to the next at the largest time (2.4e-7 in Unix seconds)."""
    return float(np.spacing(np.max(np.abs(time))))


def clock_rounding(time, segments):
    """Seconds that rows may be off a line by the unit and the floats of their clock.

    Times since the first of each segment are multiples of the unit, 1, 2 or 5 of some decimal, and
    steps are one of two neighbouring numbers of them: an even clock that is rounded has no others.
    """
    floats = 2.0 * resolution(time)
    since = np.concatenate([time[segment] - time[segment.start] for segment in segments])
    steps = np.concatenate([np.diff(time[segment]) for segment in segments])
    few = since[:REPRESENTATIVE]
    for unit in np.outer(10.0 ** -np.arange(MOST_DECIMALS + 1), [1.0, 0.5, 0.2]).ravel():
        if floats >= 0.5 * unit or not len(steps):
            break
        if all(np.max(np.abs(z - unit * np.rint(z / unit))) <= floats for z in (few, since)):
            counts = np.rint(steps / unit)
            if JITTER_LIMIT * counts.min() >= ROUNDS_BY and np.ptp(counts) <= 1.0:
                return ROUNDS_BY * unit + floats
    return floats


def even(places, step, rounding):
    """Whether neighbours are one step apart, so that nothing need be resampled."""
    if len(places) < 2:
        return True
    off = np.max(np.abs(np.diff(places) - step))
    return bool(off <= STEP_TOLERANCE * step + rounding)


def straightened(places, base, step):
    """Places of evenly spaced rows, each segment on its line: their rounding would be noise.

    The line is ``step`` a row where the slope is that to four of its standard errors.
    """
    if base.jitter[1] > 0.0 or base.uncertainty == 0.0:
        return places
    rounding = clock_rounding(base.time, base.segments)
    most = max(STEP_TOLERANCE * step + resolution(base.time), rounding)
    for segment in base.segments:
        own = places[segment]
        n, middle = len(own), own.mean()
        rows = np.arange(n) - 0.5 * (n - 1)
        spread = max(rows @ rows, 1.0)
        slope = rows @ own / spread
        off = own - middle - slope * rows
        if np.max(np.abs(off)) <= most:
            error = np.sqrt(max(off @ off / max(n - 2, 1), rounding**2 / 3.0) / spread)
            slope = step if abs(slope - step) <= STANDARD_ERRORS * error else slope
            places[segment] = middle + slope * rows
    return places


def _mean_step(seconds, segments, found):
    """Sample time, jitter (rms, largest) and standard error of the sample time.

    Lines of one slope are fitted to all segments by least squares. A step found
    that is as good to rounding is kept, and rows a step apart have no jitter, nor
    have those that are off the line by what a clock of some unit leaves.
    """
    counts, times = [], []
    for segment in segments:
        rows = np.arange(segment.stop - segment.start, dtype=float)
        counts.append(rows - rows.mean())
        times.append(seconds[segment] - seconds[segment].mean())
    counts, times = np.concatenate(counts), np.concatenate(times)
    spread = float(counts @ counts)
    if spread == 0.0:
        return found, (0.0, 0.0), 0.0
    slope = float(counts @ times / spread)
    off = times - slope * counts
    freedom = max(len(off) - len(segments) - 1, 1)
    uncertainty = float(np.sqrt(off @ off / freedom / spread))
    if abs(slope - found) <= ROUNDED * found:
        slope = found
    rounding = resolution(seconds)
    steady = all(even(seconds[segment], slope, rounding) for segment in segments)
    if steady or np.max(np.abs(off)) <= clock_rounding(seconds, segments):
        return slope, (0.0, 0.0), uncertainty
    return slope, (float(np.sqrt(np.mean(off**2))), float(np.max(np.abs(off)))), uncertainty
