"""Folds of whole periods."""

import numpy as np
from sklearn.model_selection import BaseCrossValidator

from sklearn_hd._data import as_container
from sklearn_hd._validation import check_count, check_positive, read_time


class PeriodBlockSplit(BaseCrossValidator):
    """Cut each record into blocks of whole periods, and test on one block after another.

    Period p of ψ = ωt holds the rows with 2πp ≤ ψ < 2π(p + 1). The whole
    periods of a record are shared among ``n_splits`` blocks as evenly as they
    go; the incomplete ones at its ends stay with their neighbours, so that
    every row is tested once. Fold k tests block k of every record and trains
    on the rest in order of time, without the ``gap`` periods on either side:
    there the outputs still move with what the tested inputs, or their window,
    left behind. Model steps read the hole as a gap in time, which starts a new
    segment.

    Parameters
    ----------
    n_splits : int, default=5
        Number of blocks, at least 2.
    omega : float
        Fundamental frequency in rad/s.
    gap : int, default=1
        Periods left out of training on either side of a test block.
    trim_span : (float, float) or None, default=None
        Index times, in seconds within each record, whose rows are trained on in
        every fold and tested in none: the ``trim_span`` of the analyzer, which
        must see the machine in trim whichever block is held out.
    sample_time : float or None, default=None
        Seconds. None reads it from the index, or is 1.0 where samples are counted.

    See Also
    --------
    sklearn.model_selection.TimeSeriesSplit : Trains on the past alone.
    sklearn.model_selection.GroupKFold : Whole records, by the record level of the index.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> u = pd.DataFrame({"u": np.zeros(24)}, index=pd.Index(np.arange(24) / 4, name="time"))
    >>> split = PeriodBlockSplit(3, omega=2 * np.pi)
    >>> for train, test in split.split(u):
    ...     print(train, test)
    [12 13 14 15 16 17 18 19 20 21 22 23] [0 1 2 3 4 5 6 7]
    [ 0  1  2  3 20 21 22 23] [ 8  9 10 11 12 13 14 15]
    [ 0  1  2  3  4  5  6  7  8  9 10 11] [16 17 18 19 20 21 22 23]
    """

    def __init__(self, n_splits=5, *, omega, gap=1, trim_span=None, sample_time=None):
        self.n_splits = n_splits
        self.omega = omega
        self.gap = gap
        self.trim_span = trim_span
        self.sample_time = sample_time

    def get_n_splits(self, X=None, y=None, groups=None):
        """Number of folds.

        Parameters
        ----------
        X, y, groups : ignored
            Present for the habits of scikit-learn.

        Returns
        -------
        n_splits : int
        """
        return check_count("n_splits", self.n_splits, 2, "a single block leaves nothing to train")

    def split(self, X, y=None, groups=None):
        """Rows to train and to test on, fold by fold, each in order of time.

        Parameters
        ----------
        X : DataFrame, Series or ndarray, shape (n_samples, n_features)
            With times in its index, or a (record, time) MultiIndex; rows of
            an array are counted from ψ = 0.
        y, groups : ignored
            Present for the habits of scikit-learn.

        Yields
        ------
        train, test : ndarray of int
            Row numbers.

        Raises
        ------
        ValueError
            If a record has fewer whole periods than blocks, or the gap leaves
            nothing of the records to train on.
        """
        n_splits = self.get_n_splits()
        gap = check_count("gap", self.gap, 0, "it counts the periods left out beside a block")
        if X is None:
            raise ValueError("X is None; PeriodBlockSplit reads the times of its rows: give X")
        base = read_time(as_container(X, "X"), self.sample_time)
        periods, least = self._periods(base)
        always = self._always_trained(base)
        block = np.empty(len(periods), dtype=int)
        for rows, label in _records(base):
            block[rows] = self._blocks(periods[rows], ~always[rows], least, n_splits, label)
        for k in range(n_splits):
            tested = (block == k) & ~always
            near = np.zeros_like(tested)
            for rows, _ in _records(base):
                own = periods[rows][tested[rows]]
                near[rows] = (periods[rows] >= own[0] - gap) & (periods[rows] <= own[-1] + gap)
            train = np.flatnonzero((~near & ~tested) | always)
            if np.sum(~near) < least:
                raise ValueError(
                    f"gap={gap} leaves no whole period to train on beside block {k} of "
                    f"n_splits={n_splits}; give longer records, a smaller gap or more blocks"
                )
            yield train, np.flatnonzero(tested)

    def _periods(self, base):
        """Number of the period of each row, and rows in a whole period."""
        omega = check_positive("omega", self.omega, "rad/s", "2π over the period in seconds")
        samples = 2.0 * np.pi / omega / base.sample_time
        if samples < 2.0:
            raise ValueError(
                f"omega={omega:.6g} rad/s and a sample time of {base.sample_time:.6g} s give "
                f"{samples:.4g} samples a period; at least two are needed: correct omega, or give "
                f"sample_time where rows carry no times"
            )
        turns = base.time * omega / (2.0 * np.pi)
        return np.floor(turns + 0.5 / samples).astype(int), int(np.floor(samples + 1e-6))

    def _always_trained(self, base):
        """Rows of the trim span."""
        if self.trim_span is None:
            return np.zeros(len(base.time), dtype=bool)
        try:
            start, stop = (float(value) for value in self.trim_span)
        except (TypeError, ValueError):
            start = stop = np.nan
        if not start < stop:
            raise ValueError(
                f"trim_span={self.trim_span!r} is no span of time; give (start, stop) in seconds, "
                f"start before stop, or None"
            )
        tolerance = 0.5 * base.sample_time
        return (base.time >= start - tolerance) & (base.time < stop - tolerance)

    def _blocks(self, periods, counted, least, n_splits, label):
        """Block of each row of one record."""
        numbers, counts = np.unique(periods[counted], return_counts=True)
        whole = numbers[counts >= least]
        if len(whole) < n_splits:
            raise ValueError(
                f"record {label!r} has {len(whole)} whole period(s) of omega={self.omega:.6g} "
                f"rad/s, too few for n_splits={n_splits} blocks; give longer records or fewer "
                f"blocks"
            )
        borders = [part[0] for part in np.array_split(whole, n_splits)[1:]]
        return np.searchsorted(borders, periods, side="right")


def _records(base):
    """Rows and label of each record, whatever gaps are in it."""
    segments, time = base.segments, base.time
    starts = [0]
    for i in range(1, len(segments)):
        again = time[segments[i].start] <= time[segments[i].start - 1]  # time begins anew
        if again or base.records[i] != base.records[i - 1]:
            starts.append(i)
    for first, following in zip(starts, [*starts[1:], len(segments)], strict=True):
        yield slice(segments[first].start, segments[following - 1].stop), base.records[first]
