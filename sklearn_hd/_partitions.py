"""Identification from dask DataFrames: a small statistic of each partition, merged as a tree.

The data are read where they are, twice: for the lagged products that R comes from
(:mod:`~sklearn_hd.algorithms.lag_products`; once more, in exact sums, where plain ones would
not do), and with A and C known for the equations of B, D and the initial states
(:mod:`~sklearn_hd.algorithms.record_parts`). Records may end within a partition or run
through several. Neighbours are merged where they are, and what arrives here is one statistic.
"""

import itertools
import pickle
from dataclasses import dataclass, replace
from functools import cached_property, partial, reduce

import numpy as np
import pandas as pd

from sklearn_hd._arithmetic import extremes
from sklearn_hd._data import PLAIN, as_frame, read_signals, read_values, sample
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._time import STEP_TOLERANCE
from sklearn_hd.algorithms.hankel import factor_of_products, n_hankel_columns
from sklearn_hd.algorithms.lag_products import LagProducts, stretch
from sklearn_hd.algorithms.record_parts import InputEquations, cuts, input_equations

__all__ = ["Partitions", "is_partitioned"]

FAN_IN = 8  # neighbours merged at a time


def is_partitioned(data):
    """Whether it is a collection of dask's, told without importing dask."""
    return hasattr(data, "__dask_graph__")


# ---- what a partition leaves behind --------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """Consecutive rows of a record.

    Attributes
    ----------
    record : object
        Label.
    first, last : float, int, Timedelta or Timestamp
        Times of the first and of the last row, as the index has them.
    extremes : ndarray, shape (2, p)
        Smallest and largest value of each channel, inputs first.
    parts : tuple of (int, int)
        Partitions that the rows lie in, and how many in each.
    """

    record: object
    first: object
    last: object
    extremes: np.ndarray
    parts: tuple

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


def _worded(time):
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
    place = f"partition {later.parts[0][0]} starts at t = {_worded(later.first)}"
    apart = later.first - run.last
    apart = apart.total_seconds() if hasattr(apart, "total_seconds") else float(apart)
    if apart <= 0.0:
        raise ValueError(
            f"time must increase within a record: {place}, and the one before it ends at t = "
            f"{_worded(run.last)}; order the partitions by time, or give each record its own "
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
    if abs(samples - 1.0) <= STEP_TOLERANCE:
        return True
    if round(samples) < 2 or abs(samples - round(samples)) > STEP_TOLERANCE * samples:
        raise ValueError(
            f"{place}, {samples:.5g} samples of {step:.6g} s after the end of the one before it: "
            f"neither the next sample nor a gap of a whole number of them; resample the data "
            f"before they are partitioned"
        )
    return False


@dataclass(frozen=True)
class Statistic:
    """What neighbouring partitions leave behind, None if they are empty.

    It tells how large it is, by which dask decides what to move where.
    """

    value: PartitionSums | InputEquations | None

    def __sizeof__(self):
        return len(pickle.dumps(self.value))

    @classmethod
    def merged(cls, *neighbours):
        """The sum of neighbours, in their order."""
        found = [each.value for each in neighbours if each.value is not None]
        return cls(reduce(lambda a, b: a + b, found) if found else None)


# ---- what is done where the data are -------------------------------------------------------


def _read(partition, X, y):
    """Segments of one partition: their signals, records and first and last times.

    Raises
    ------
    ValueError
        That names the partition.
    """
    try:
        frame = as_frame(X)
        if frame.basis is not None:
            raise ValueError(
                "X carries a harmonic basis, which fit reads from frames in memory: give it "
                "X.compute() and y.compute(), or one partition after the other to partial_fit"
            )
        signals = read_signals(frame, "x", "X")
        measured, _ = read_values(y, X, signals.base, PLAIN)
        if signals.base.jitter[1] > 0.0:
            raise ValueError(
                f"the rows are off an even grid of {signals.base.sample_time:.4g} s by up to "
                f"{signals.base.jitter[1]:.2g} s; partitions are not resampled: resample the "
                f"records, or give frames in memory, X.compute() and y.compute()"
            )
        sampling, inputs, outputs = sample(signals, None, measured)
    except (TypeError, ValueError) as error:
        raise type(error)(f"partition {partition}: {error}") from error
    segments = list(zip(inputs, outputs, strict=True))
    return segments, sampling.base, X.index.get_level_values(-1)


@one_blas_thread
def partition_sums(partition, X, y, n_lags, exact):
    """What lagged products, scales and checks need of one partition."""
    if len(X) == len(y) == 0:
        return Statistic(None)
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        segments, base, times = _read(partition, X, y)
        runs = [
            Run(
                record,
                times[rows.start],
                times[rows.stop - 1],
                np.hstack([extremes(z) for z in signals]),
                ((partition, rows.stop - rows.start),),
            )
            for signals, record, rows in zip(segments, base.records, base.segments, strict=True)
        ]
        n_steps = len(base.time) - len(set(base.records))
        steps = ((base.sample_time, n_steps),) if n_steps else ()
        head = X.iloc[:1], y.iloc[:1]
        return Statistic(PartitionSums.of(segments, runs, n_lags, exact, steps, head))


@one_blas_thread
def partition_equations(partition, pieces, X, y, model):
    """Equations of B, D and the initial states in one partition."""
    if not pieces:
        return Statistic(None)
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        segments, _, _ = _read(partition, X, y)
        parts = [
            (key, size, *(z[rows] for z in segments[segment]))
            for segment, rows, key, size in pieces
        ]
        return Statistic(input_equations(*model, parts))


# ---- what is done here ---------------------------------------------------------------------


@dataclass(frozen=True)
class RowCount:
    """Stands for a time base of which only the number of rows is known."""

    time: range
    sample_time: float
    segments: tuple = ()
    records: tuple = ()


@dataclass(frozen=True)
class Condensed:
    """Stands for an experiment: of each segment the smallest and the largest values.

    Attributes
    ----------
    inputs, outputs : list of ndarray, shapes (2, m), (2, l)
    drive_names, output_names : tuple of str
    base : RowCount
    words : str
    """

    inputs: list
    outputs: list
    drive_names: tuple
    output_names: tuple
    base: RowCount
    words: str
    basis: None = None

    @property
    def measured(self):
        """Outputs of the largest and smallest size."""
        return np.vstack(self.outputs)

    def drive_signals(self):
        """Names of the inputs."""
        return self.drive_names

    def span(self):
        """First and last time, worded for messages."""
        return self.words


class Partitions:
    """Inputs and outputs in the partitions of two dask DataFrames.

    Parameters
    ----------
    X, y : dask DataFrame (or Series)
    n_lags : int
        Block rows 2i, past and future, that lag products are made for.
    """

    def __init__(self, X, y, n_lags):
        self.delayed = _delayed()
        self.parts = _matched(X, y)
        self.n_lags = n_lags

    def _tree(self, function, *each):
        """The merged statistic of all partitions."""
        nodes = [
            self.delayed(partial(function, k, *(values[k] for values in each)))(X, y)
            for k, (X, y) in enumerate(self.parts)
        ]
        while len(nodes) > 1:
            nodes = [
                self.delayed(Statistic.merged)(*nodes[a : a + FAN_IN])
                for a in range(0, len(nodes), FAN_IN)
            ]
        return nodes[0].compute().value

    def _sums(self, exact):
        return self._tree(partial(partition_sums, n_lags=self.n_lags, exact=exact))

    @cached_property
    def sums(self):
        """Plain sums of all partitions.

        Raises
        ------
        ValueError
            If there are no rows.
        """
        sums = self._sums(exact=False)
        if sums is None:
            raise ValueError("X has no rows in any partition, while at least 1 is required")
        return sums

    @property
    def lengths(self):
        """Rows of each segment."""
        return [run.n_rows for run in self.sums.runs]

    @property
    def head(self):
        """A row of X and one of y."""
        return self.sums.head

    @cached_property
    def experiment(self):
        """What checks of the data read."""
        sums = self.sums
        names = [tuple(map(str, pd.DataFrame(each).columns)) for each in self.head]
        m = len(names[0])
        ends = [run.extremes for run in sums.runs]
        return Condensed(
            inputs=[each[:, :m] for each in ends],
            outputs=[each[:, m:] for each in ends],
            drive_names=names[0],
            output_names=names[1],
            base=RowCount(range(sum(self.lengths)), sums.sample_time or 1.0),
            words=f"rows from t = {_worded(sums.runs[0].first)} to {_worded(sums.runs[-1].last)}",
        )

    def root_mean_squares(self):
        """Of each channel, inputs first; one where it is zero."""
        return self.sums.products.root_mean_squares()

    def factor(self, block_rows, scale):
        """R factor of the block Hankel matrices, as ``hankel_factor`` gives."""
        n_lags, n_inputs = 2 * block_rows, len(self.experiment.drive_names)
        R = None
        if n_hankel_columns(self.lengths, block_rows) >= n_lags * len(scale):
            R = factor_of_products(self.sums.products.fewer(n_lags), n_inputs, scale)
        if R is None:
            products = self._sums(exact=True).products.fewer(n_lags)
            R = factor_of_products(products, n_inputs, scale)
        return R

    def input_matrices(self, A, C, feedthrough, scales):
        """B, D and the initial states of all segments, as ``input_matrices`` gives."""
        model = A, C, feedthrough, tuple(scales)
        pieces = _pieces(self.sums.runs, cuts(A, self.lengths), len(self.parts))
        equations = self._tree(partial(partition_equations, model=model), pieces)
        shape = len(A), len(scales[0]), len(C)
        return equations.solve(shape, [(r, 0) for r in range(len(self.sums.runs))])


def _pieces(runs, edges, n_partitions):
    """For each partition its pieces: segment, rows of it, key, and rows of the whole piece."""
    pieces, n_segments = [[] for _ in range(n_partitions)], [0] * n_partitions
    for r, run in enumerate(runs):
        start = 0
        for partition, size in run.parts:
            within = np.unique(np.clip(edges[r], start, start + size))
            for a, b in itertools.pairwise(within):
                p = int(np.searchsorted(edges[r], a, side="right")) - 1
                whole = int(edges[r][p + 1] - edges[r][p])
                rows = slice(int(a) - start, int(b) - start)
                pieces[partition].append((n_segments[partition], rows, (r, p), whole))
            n_segments[partition] += 1
            start += size
    return pieces


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

    Raises
    ------
    TypeError, ValueError
        Unless both are dask DataFrames (y a Series perhaps) of as many partitions.
    """
    for what, data in (("X", X), ("y", y)):
        if not is_partitioned(data):
            raise TypeError(
                f"{what} is a {type(data).__name__} in memory, and the other of X and y a dask "
                f"collection; take both from one dask DataFrame (X = data[[...]], y = "
                f"data[[...]]), or compute both"
            )
        if not hasattr(data, "divisions"):
            raise TypeError(
                f"{what} is a dask {type(data).__name__}, which carries no index of times; give a "
                f"dask DataFrame"
            )
    if X.npartitions != y.npartitions:
        raise ValueError(
            f"X has {X.npartitions} partitions and y has {y.npartitions}: they must match one to "
            f"one; take both from one dask DataFrame (X = data[[...]], y = data[[...]])"
        )
    return list(zip(X.to_delayed(), y.to_delayed(), strict=True))
