"""What a partition of dask's leaves behind for a fit, and how neighbours are merged."""

import pickle
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
import pandas as pd

from sklearn_hd._arithmetic import extremes
from sklearn_hd._identify.modulation import largest_changes, modulated
from sklearn_hd._readings import first_difference
from sklearn_hd._records.data import (
    PLAIN,
    as_frame,
    is_decomposed,
    read_experiment,
    rows_read,
)
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._time import STEP_TOLERANCE, read_time
from sklearn_hd.algorithms.subspace.lag_products import LagProducts, stretch
from sklearn_hd.algorithms.subspace.record_parts import InputEquations, input_equations

__all__ = ["partition_changes", "partition_equations", "partition_sums", "worded"]


@dataclass(frozen=True)
class Run:
    """Consecutive rows of a record.

    Attributes
    ----------
    record : object
        Label.
    first, last : float, int, Timedelta or Timestamp
        Times of the first and of the last row, as the index has them.
    extremes : ndarray, shape (2, m + l)
        Smallest and largest value of each input and output.
    size : ndarray, shape (l,)
        Largest magnitude of each output as measured.
    parts : tuple of (int, int)
        Partitions that the rows read lie in, and how many in each.
    n_samples : int
        Rows of the record's own.
    windowed : bool
        Whether rows are read through a window.
    """

    record: object
    first: object
    last: object
    extremes: np.ndarray
    size: np.ndarray
    parts: tuple
    n_samples: int
    windowed: bool

    @property
    def n_rows(self):
        """Number of rows."""
        return sum(size for _, size in self.parts)

    def join(self, later):
        """With the rows right after it."""
        both = self.extremes, later.extremes
        low, high = np.minimum(*both)[0], np.maximum(*both)[1]
        return replace(
            self,
            last=later.last,
            extremes=np.array([low, high]),
            size=np.maximum(self.size, later.size),
            n_samples=self.n_samples + later.n_samples,
            parts=self.parts + later.parts,
        )


@dataclass(frozen=True)
class PartitionSums:
    """What R and the checks of a fit need of some consecutive partitions.

    Attributes
    ----------
    runs : tuple of Run
    ends : tuple of Stretch
        Lag products of the first and the last run, that rows may be joined to; one if they
        are the same.
    between : LagProducts or None
        Of the runs between these.
    steps : tuple of (float, int)
        Sample times found, seconds, and from how many steps.
    head : tuple
        A row of X and one of y.
    """

    runs: tuple
    ends: tuple
    between: LagProducts | None
    steps: tuple
    head: tuple

    @classmethod
    def of(cls, segments, runs, n_lags, exact, steps, head):
        """Of the segments of one partition."""
        sums = [stretch(signals, n_lags, exact) for signals in segments]
        between = [each.closed() for each in sums[1:-1]]
        ends = tuple(sums[:1] + sums[1:][-1:])
        total = sum(between[1:], between[0]) if between else None
        return cls(tuple(runs), ends, total, steps, head)

    def __add__(self, later):
        """With the partitions right after these."""
        steps = self.steps + later.steps
        _check_columns(self.head, later.head, later.runs[0].parts[0][0])
        _check_steps(steps, later.runs[0].parts[0][0])
        runs, ends = self.runs + later.runs, self.ends + later.ends
        closed = [self.between, later.between]
        meet = len(self.ends) - 1
        if _follows(self.runs[-1], later.runs[0], steps):
            joined = self.runs[-1].join(later.runs[0])
            runs = (*self.runs[:-1], joined, *later.runs[1:])
            seam = ends[meet].join(ends[meet + 1])
            ends = (*ends[:meet], seam, *ends[meet + 2 :])
        closed += [each.closed() for each in ends[1:-1]]
        ends = (ends[0], ends[-1]) if len(ends) > 1 else ends
        closed = [each for each in closed if each is not None]
        between = sum(closed[1:], closed[0]) if closed else None
        return PartitionSums(runs, ends, between, steps, self.head)

    @cached_property
    def products(self):
        """Lag products of all runs."""
        closed = [each.closed() for each in self.ends]
        closed += [] if self.between is None else [self.between]
        return sum(closed[1:], closed[0])

    @property
    def sample_time(self):
        """Seconds: the median step."""
        return _median_step(self.steps)


def worded(time):
    """A time of an index as messages have it."""
    return f"{time:.6g} s" if isinstance(time, float) else str(time)


def _median_step(steps):
    """Median of the sample times found, each counted as often as it was; None if none was."""
    if not steps:
        return None
    found = np.array(steps)
    found = found[np.argsort(found[:, 0])]
    half = np.searchsorted(np.cumsum(found[:, 1]), 0.5 * found[:, 1].sum())
    return float(found[half, 0])


def _check_steps(steps, partition):
    """Raise ValueError if neighbouring partitions have other sample times."""
    found = [step for step, _ in steps]
    if found and max(found) - min(found) > STEP_TOLERANCE * min(found):
        raise ValueError(
            f"the partitions up to {partition} have sample times from {min(found):.6g} s to "
            f"{max(found):.6g} s; resample them to one, as with X.map_partitions(...), before "
            f"they are identified from together"
        )


def _check_columns(head, other, partition):
    """Raise ValueError if a partition has other columns than those before it."""
    for what, here, there in zip(("X", "y"), head, other, strict=True):
        names = [list(map(str, pd.DataFrame(each).columns)) for each in (here, there)]
        if names[0] != names[1]:
            raise ValueError(
                f"partition {partition} of {what} has the columns {names[1]}, those before it have "
                f"{names[0]}; give all partitions the same columns in the same order"
            )


def _follows(run, later, steps):
    """Whether a run goes on in the next partition, one sample later."""
    if run.record != later.record:
        return False
    place = f"partition {later.parts[0][0]} starts at t = {worded(later.first)}"
    apart = later.first - run.last
    apart = apart.total_seconds() if hasattr(apart, "total_seconds") else float(apart)
    if apart <= 0.0:
        raise ValueError(
            f"time must increase within a record: {place}, and the one before it ends at t = "
            f"{worded(run.last)}; order the partitions by time, or give each record its own "
            f"label in a (record, time) MultiIndex: "
            f"X.map_partitions(pd.DataFrame.set_index, ['record', 'time'])"
        )
    step = _median_step(steps)
    if step is None:
        raise ValueError(
            f"{place}, after one of a single row, which tells no sample time; give fewer, larger "
            f"partitions: X.repartition(npartitions=...)"
        )
    samples = apart / step
    if abs(samples - 1.0) <= STEP_TOLERANCE and not run.windowed:
        return True
    if run.windowed and samples < 1.5:
        raise ValueError(
            f"{place}, where record {run.record!r} goes on: rows read through a window depend on "
            f"those before; give whole records to each partition"
        )
    if round(samples) < 2 or abs(samples - round(samples)) > STEP_TOLERANCE * samples:
        raise ValueError(
            f"{place}, {samples:.5g} samples of {step:.6g} s after the end of the one before it: "
            f"neither the next sample nor a gap of a whole number of them; resample the data "
            f"before they are partitioned"
        )
    return False


@dataclass(frozen=True)
class Changes:
    """How records move through a window: rows read of each, largest changes of inputs by phase."""

    lengths: tuple
    changes: np.ndarray

    def __add__(self, later):
        return Changes(self.lengths + later.lengths, np.maximum(self.changes, later.changes))


@dataclass(frozen=True)
class Statistic:
    """What neighbouring partitions leave behind, None if they are empty.

    It tells how large it is, by which dask decides what to move where.
    """

    value: PartitionSums | Changes | InputEquations | None

    def __sizeof__(self):
        return len(pickle.dumps(self.value))

    @classmethod
    def merged(cls, *neighbours):
        """The sum of neighbours, in their order."""
        found = [each.value for each in neighbours if each.value is not None]
        return cls(reduce(lambda a, b: a + b, found) if found else None)


# ---- what is done where the data are -------------------------------------------------------


def _read(partition, X, y, basis):
    """The experiment of one partition; errors name it."""
    try:
        found = as_frame(X).basis
        if (found is not None) != basis.harmonic:
            has = "no harmonic basis, which X had" if found is None else "a harmonic basis, X none"
            raise ValueError(
                f"its frame carries {has} when the graph was built; give the analyzer's frame as "
                f"meta: X.map_partitions(analyzer.transform, meta=analyzer.transform(u).iloc[:0])"
            )
        return _windowed(X, y, found, basis) if basis.harmonic else _plain(X, y)
    except (TypeError, ValueError) as error:
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"partition {partition}: {error}") from error


def _plain(X, y):
    base = read_time(X)
    if base.jitter[1] > 0.0:
        raise ValueError(
            f"the rows are off an even grid of {base.sample_time:.4g} s by up to "
            f"{base.jitter[1]:.2g} s; partitions are not resampled: resample the "
            f"records, or give frames in memory, X.compute() and y.compute()"
        )
    return read_experiment(X, y)


def _windowed(X, y, found, basis):
    difference = first_difference(found, basis)
    if difference is not None:
        name, here, there = difference
        raise ValueError(
            f"it was analysed with {name}={here!r}, others with {there!r}; fit one "
            f"HarmonicAnalyzer, and transform all partitions with it"
        )
    if is_decomposed(y):
        raise ValueError(
            "y is a frame of harmonics; give it in time: it is decomposed with the basis of X"
        )
    return read_experiment(X, y)


@one_blas_thread
def partition_changes(partition, X, y, basis):
    """How the records of one partition move through a window."""
    if len(X) == len(y) == 0:
        return Statistic(None)
    experiment = _read(partition, X, y, basis)
    times = experiment.times()
    lengths = tuple(len(basis.rows_read(time)) for time in times)
    changes = [
        largest_changes(basis, drive, time)
        for drive, time in zip(experiment.drive, times, strict=True)
    ]
    return Statistic(Changes(lengths, np.max(changes, axis=0)))


@one_blas_thread
def partition_sums(partition, X, y, basis=PLAIN, highest=0, *, n_lags, exact):
    """What lagged products, scales and checks need of one partition.

    Inputs are multiplied by the harmonics of ψ up to the highest.
    """
    if len(X) == len(y) == 0:
        return Statistic(None)
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        experiment = _read(partition, X, y, basis)
        inputs, outputs = rows_read(experiment)
        runs = _runs(experiment, inputs, partition, X.index.get_level_values(-1))
        if highest:
            inputs = [
                modulated(basis, drive, time, basis.rows_read(time), highest)
                for drive, time in zip(experiment.drive, experiment.times(), strict=True)
            ]
        base = experiment.base
        n_steps = len(base.time) - len(set(base.records))
        steps = ((base.sample_time, n_steps),) if n_steps else ()
        segments = list(zip(inputs, outputs, strict=True))
        head = X.iloc[:1], y.iloc[:1]
        return Statistic(PartitionSums.of(segments, runs, n_lags, exact, steps, head))


def _runs(experiment, inputs, partition, times):
    runs = []
    for s, piece in enumerate(experiment.sampling.pieces):
        rows = piece.rows
        measured = np.abs(experiment.measured[rows])
        runs.append(
            Run(
                experiment.base.records[s],
                times[rows.start],
                times[rows.stop - 1],
                np.hstack([extremes(inputs[s]), extremes(experiment.outputs[s])]),
                np.array([np.fmax.reduce(column) for column in measured.T]),
                ((partition, len(inputs[s])),),
                rows.stop - rows.start,
                experiment.basis.harmonic,
            )
        )
    return runs


@one_blas_thread
def partition_equations(partition, pieces, X, y, basis, model):
    """Equations of B, D and the initial states in one partition."""
    if not pieces:
        return Statistic(None)
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        segments = list(zip(*rows_read(_read(partition, X, y, basis)), strict=True))
        parts = [
            (key, size, *(z[rows] for z in segments[segment]))
            for segment, rows, key, size in pieces
        ]
        return Statistic(input_equations(*model, parts))
