"""Identification from dask DataFrames: statistics of each partition, merged as a tree.

The workers read the data once (with an analysis window once more before that, for the phases at
which inputs change). Records may end within a partition or run through several; those read through
a window lie within one. Neighbours are merged by the workers, and only one statistic is returned.
"""

import pickle
from dataclasses import dataclass
from functools import cached_property, partial, reduce

import numpy as np
import pandas as pd

from sklearn_hd._checks import FIRST, at
from sklearn_hd._clock import STEP_TOLERANCE, read_time, resolution
from sklearn_hd._containers import is_partitioned
from sklearn_hd._guards import one_blas_thread
from sklearn_hd._identify.sliding import (
    changes_of,
    modulated_rows,
    n_modulating_harmonics,
    steps_at_one_phase,
)
from sklearn_hd._identify.statistics import Channels, Statistics, ends_of
from sklearn_hd._readings import PlainReading, first_difference
from sklearn_hd._records.data import as_frame, is_decomposed, read_experiment, rows_read

FAN_IN = 8  # neighbours merged at a time


class Partitions:
    """Data of a fit in the partitions of two dask DataFrames.

    What :mod:`~sklearn_hd._identify.statistics` promises, of sums that are made once asked for,
    and anew for more block rows.

    ``block_rows(basis)`` gives the most that are probably asked for. ValueError is
    raised if the analysis, the partitions or their rows do not allow it, or there are
    none.
    """

    most_block_rows = np.inf

    def __init__(self, X, y, block_rows):
        self.delayed = _delayed()
        self.basis = _basis_of(X)
        self.parts = _matched(X, y)
        self.block_rows = block_rows(self.basis)

    def _tree(self, function):
        """The merged values of all partitions."""
        nodes = [self.delayed(partial(function, k))(X, y) for k, (X, y) in enumerate(self.parts)]
        while len(nodes) > 1:
            nodes = [
                self.delayed(_merged)(*nodes[a : a + FAN_IN]) for a in range(0, len(nodes), FAN_IN)
            ]
        return nodes[0].compute()

    @cached_property
    def highest(self):
        """Harmonics that inputs are multiplied by, as ``modulated_inputs`` has it."""
        if not self.basis.harmonic:
            return 0
        found = self._tree(partial(_changes, basis=self.basis))
        if found is None or steps_at_one_phase(found.changes):
            return 0
        return n_modulating_harmonics(self.basis, found.lengths, found.changes.shape[1])

    @cached_property
    def found(self):
        """Statistics of all partitions."""
        how = {"basis": self.basis, "highest": self.highest, "n_lags": 2 * self.block_rows}
        found = self._tree(partial(_partition, **how))
        if found is None:
            raise ValueError("X has no rows in any partition, while at least 1 is required")
        return found

    @cached_property
    def summed(self):
        """Data of a fit."""
        found = self.found
        drive, names = (tuple(map(str, pd.DataFrame(each).columns)) for each in found.head)
        basis = self.basis if self.basis.harmonic else PlainReading(drive, names)
        words = f"rows from t = {_worded(found.first.time)} to {_worded(found.last.time)}"
        step = _median_step(found.steps) or 1.0
        facts = found.statistics.facts(basis, names, step, words)
        return found.statistics.data(facts, self.highest)

    @property
    def head(self):
        """A row of X and one of y."""
        return self.found.head

    facts = property(lambda self: self.summed.facts)
    lengths = property(lambda self: self.summed.lengths)
    n_inputs = property(lambda self: self.summed.n_inputs)
    n_outputs = property(lambda self: self.summed.n_outputs)
    raw = property(lambda self: self.summed.raw)
    scales = property(lambda self: self.summed.scales)
    input_matrices = property(lambda self: self.summed.input_matrices)
    initial_states = property(lambda self: self.summed.initial_states)

    def projection(self, make, scale, *choices):
        """What ``make`` makes of the factor."""
        return make()

    def factor(self, block_rows, scale):
        """R factor of the block Hankel matrices, as ``hankel_factor`` gives."""
        if block_rows > self.block_rows:
            self.block_rows = block_rows
            del self.found, self.summed
        return self.summed.factor(block_rows, scale)


def _basis_of(X):
    """The basis that a dask DataFrame carries, as its meta shows; that of plain rows without.

    It raises ValueError if the basis is of an analysis that partitions are not read
    through.
    """
    basis = getattr(getattr(X, "_meta", None), "basis", None) or PlainReading()
    whole = basis.reading in ("period", "sample")
    if whole or basis.small_signal is not None:
        what = f"small_signal={basis.small_signal!r}"
        if whole:
            what = f"reading={basis.reading!r}"
        raise ValueError(
            f"X was analysed with {what}, which needs all records at once; load the data into "
            f"memory with X.compute() and y.compute(), or analyse with reading='sliding' and "
            f"small_signal=None"
        )
    return basis


def _delayed():
    """dask.delayed, or an error that says what to install."""
    try:
        from dask import delayed
    except ImportError as error:
        raise ImportError(
            "data in partitions are read by dask, which is not installed: pip install "
            '"sklearn_hd[dask]"'
        ) from error
    return delayed


def _matched(X, y):
    """Pairs of partitions of X and y.

    It raises TypeError unless both are dask DataFrames (y a Series perhaps), and
    ValueError unless they have as many partitions.
    """
    for what, data in (("X", X), ("y", y)):
        if not is_partitioned(data):
            raise TypeError(
                f"{what} is a {type(data).__name__} in memory, but the other of X and y is a dask "
                f"collection; take both from one dask DataFrame (X = data[[...]], y = "
                f"data[[...]]), or compute both"
            )
        if not hasattr(data, "divisions"):
            raise TypeError(
                f"{what} is a dask {type(data).__name__}, which has no index of times; give a dask "
                f"DataFrame"
            )
    if X.npartitions != y.npartitions:
        raise ValueError(
            f"X has {X.npartitions} partitions and y has {y.npartitions}: they must match one to "
            f"one; take both from one dask DataFrame (X = data[[...]], y = data[[...]])"
        )
    return list(zip(X.to_delayed(), y.to_delayed(), strict=True))


@dataclass(frozen=True)
class Place:
    """Where a segment begins or ends: label of its record, time as the index has it, partition."""

    record: object
    time: object
    partition: int


@dataclass(frozen=True)
class Neighbours:
    """What some consecutive partitions leave behind.

    It tells how large it is, by which dask decides what to move where.
    """

    statistics: Statistics
    first: Place  # where the first segment begins
    last: Place  # where the last one ends
    steps: tuple  # of (float, int): sample times found, seconds, and from how many steps
    head: tuple  # a row of X and one of y
    windowed: bool

    def __sizeof__(self):
        return len(pickle.dumps(self))

    def __add__(self, later):
        """With the partitions right after these."""
        steps, partition = self.steps + later.steps, later.first.partition
        _check_columns(self.head, later.head, partition)
        _check_steps(steps, partition)
        joined = _follows(self.last, later.first, steps, self.windowed)
        merged = self.statistics.merge(later.statistics, joined)
        return Neighbours(merged, self.first, later.last, steps, self.head, self.windowed)


@dataclass(frozen=True)
class Changes:
    """How records move through a window: rows read of each, largest changes of inputs by phase."""

    lengths: tuple
    changes: np.ndarray

    def __add__(self, later):
        return Changes(self.lengths + later.lengths, np.maximum(self.changes, later.changes))


def _merged(*neighbours):
    """The sum of neighbours, in their order; None if all are empty."""
    found = [each for each in neighbours if each is not None]
    return reduce(lambda a, b: a + b, found) if found else None


def _worded(time):
    """A time of an index as messages have it."""
    return at(time) if isinstance(time, float) else str(time)


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


def _follows(here, later, steps, windowed):
    """Whether a segment goes on in the next partition, one sample later."""
    if here.record != later.record:
        return False
    place = f"partition {later.partition} starts at t = {_worded(later.time)}"
    apart = later.time - here.time
    dated = hasattr(apart, "total_seconds")
    apart, rounding = (apart.total_seconds(), 0.0) if dated else (apart, resolution(later.time))
    if apart <= 0.0:
        raise ValueError(
            f"time must increase within a record: {place}, and the one before it ends at t = "
            f"{_worded(here.time)}; order the partitions by time, or give each record its own "
            f"label in a (record, time) MultiIndex: "
            f"X.map_partitions(pd.DataFrame.set_index, ['record', 'time'])"
        )
    step = _median_step(steps)
    if step is None:
        raise ValueError(
            f"{place}, after one of a single row, which gives no sample time; use fewer, larger "
            f"partitions: X.repartition(npartitions=...)"
        )
    samples, tolerance = apart / step, STEP_TOLERANCE + rounding / step
    if abs(samples - 1.0) <= tolerance and not windowed:
        return True
    if windowed and samples < 1.5:
        raise ValueError(
            f"{place}, inside record {here.record!r}, but rows read through a window depend on the "
            f"rows before; keep each record in one partition"
        )
    if round(samples) < 2 or abs(samples - round(samples)) > tolerance * samples:
        raise ValueError(
            f"{place}, {samples:.5g} samples of {step:.6g} s after the end of the partition "
            f"before: this is neither the next sample nor a gap of a whole number of samples; "
            f"resample the data before you partition them"
        )
    return False


# ---- what is done where the data are -------------------------------------------------------


@one_blas_thread
def _changes(partition, X, y, basis):
    """How the records of one partition move through a window."""
    if len(X) == len(y) == 0:
        return None
    experiment = _read(partition, X, y, basis)
    lengths = tuple(len(basis.rows_read(time)) for time in experiment.times())
    return Changes(lengths, changes_of(experiment))


@one_blas_thread
def _partition(partition, X, y, basis, highest=0, *, n_lags):
    """What one partition leaves behind, inputs times the harmonics of ψ up to the highest."""
    if len(X) == len(y) == 0:
        return None
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        experiment = _read(partition, X, y, basis)
        inputs, outputs = rows_read(experiment)
        channels = Channels(inputs[0].shape[1], outputs[0].shape[1], highest)
        ends = [
            np.hstack([ends_of(u), ends_of(z)])
            for u, z in zip(inputs, experiment.outputs, strict=True)
        ]
        if highest:
            inputs = modulated_rows(experiment, highest)
        rows = [np.hstack(pair) for pair in zip(inputs, outputs, strict=True)]
        size = np.array([np.fmax.reduce(np.abs(column)) for column in experiment.measured.T])
        base, times = experiment.base, X.index.get_level_values(-1)
        pieces = experiment.sampling.pieces
        n_steps = len(base.time) - len(set(base.records))
        return Neighbours(
            Statistics.of(channels, n_lags, rows, ends, size, len(experiment.measured)),
            Place(base.records[0], times[pieces[0].rows.start], partition),
            Place(base.records[-1], times[pieces[-1].rows.stop - 1], partition),
            ((base.sample_time, n_steps),) if n_steps else (),
            (X.iloc[:1], y.iloc[:1]),
            basis.harmonic,
        )


def _read(partition, X, y, basis):
    """The experiment of one partition; errors name it."""
    try:
        found = as_frame(X).basis
        if (found is not None) != basis.harmonic:
            given, had = ("no", "one") if found is None else ("a", "none")
            raise ValueError(
                f"its frame carries {given} harmonic basis, but X had {had} when the graph was "
                f"built; give the analyzer's frame as meta: "
                f"X.map_partitions(analyzer.transform, meta=analyzer.transform(u).iloc[:0])"
            )
        return _windowed(X, y, found, basis) if basis.harmonic else _plain(X, y)
    except (TypeError, ValueError) as error:
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"partition {partition}: {error}") from error


def _plain(X, y):
    base = read_time(X, time_origin=FIRST)
    if base.jitter[1] > 0.0:
        raise ValueError(
            f"the rows are off an even grid of {base.sample_time:.4g} s by up to "
            f"{base.jitter[1]:.2g} s, and partitions are not resampled: resample the records, or "
            f"load them into memory with X.compute() and y.compute()"
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
