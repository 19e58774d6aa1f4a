"""Folds of blocks of rows, or of whole periods."""

import numpy as np
from sklearn.model_selection import BaseCrossValidator

from sklearn_hd._checks import FIRST, PERIOD_TOLERANCE, check_count, check_phase, check_span
from sklearn_hd._clock import read_time
from sklearn_hd._containers import as_container, is_pandas, keeps_times
from sklearn_hd._records.data import read_azimuth
from sklearn_hd.algorithms.signals.resampling import unwrap

SAME_TURN = 1e-6  # of a period


class BlockSplit(BaseCrossValidator):
    """Cut each record into blocks of consecutive rows, and test on one block after another.

    The rows of a record are divided into ``n_splits`` blocks as evenly as possible. Fold k tests
    block k of every record, so every row is tested once. It trains on the rest in order of time,
    without the ``gap`` rows on either side.

    The test block leaves a hole in the training rows. The index of a DataFrame shows it: model
    steps see a gap in time, which starts a new segment. An array has no times, so rows from both
    sides would close up to one record with a jump in it. For arrays each fold therefore trains
    only on the longer side of the block (on the side before it if both are equal).
    ``pd.DataFrame(u)`` trains on both sides.

    Parameters
    ----------
    n_splits : int, default=5
        Number of blocks, at least 2.
    gap : int, default=0
        Rows left out of training on either side of a test block: choose the correlation length of
        the noise.

    See Also
    --------
    PeriodBlockSplit : Blocks of whole periods, for data with a fundamental frequency.
    sklearn.model_selection.TimeSeriesSplit : Trains on the past alone.
    sklearn.model_selection.GroupKFold : Whole records, by the record level of the index.

    References
    ----------
    Burman, Chow, Nolan (1994), A cross-validatory method for dependent data, Biometrika
    81(2), 351-358 (blocks, and a gap on either side).

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> u = np.zeros((12, 1))
    >>> for train, test in BlockSplit(3).split(pd.DataFrame(u)):
    ...     print(train, test)
    [ 4  5  6  7  8  9 10 11] [0 1 2 3]
    [ 0  1  2  3  8  9 10 11] [4 5 6 7]
    [0 1 2 3 4 5 6 7] [ 8  9 10 11]
    >>> for train, test in BlockSplit(3).split(u):
    ...     print(train, test)
    [ 4  5  6  7  8  9 10 11] [0 1 2 3]
    [0 1 2 3] [4 5 6 7]
    [0 1 2 3 4 5 6 7] [ 8  9 10 11]
    """

    _unit = _whole = "row"
    _size = ""

    def __init__(self, n_splits=5, *, gap=0):
        self.n_splits = n_splits
        self.gap = gap

    def get_n_splits(self, X=None, y=None, groups=None):
        """Number of folds.

        Parameters
        ----------
        X, y, groups : ignored
            Present for the habits of scikit-learn.

        Returns
        -------
        n_splits : int
            As given.

        Raises
        ------
        ValueError
            If ``n_splits`` is not a whole number of at least 2.
        """
        return check_count("n_splits", self.n_splits, 2, "a single block leaves nothing to train")

    def split(self, X, y=None, groups=None):
        """Training and test rows, fold by fold, each in order of time.

        Parameters
        ----------
        X : DataFrame, Series or ndarray, shape (n_samples, n_features)
            With times in its index, or a (record, time) MultiIndex; the rows of an array count as
            samples (from ψ = 0, if there are periods).
        y, groups : ignored
            Present for the habits of scikit-learn.

        Yields
        ------
        train, test : ndarray of int
            Row numbers.

        Raises
        ------
        ValueError
            If a record has fewer rows, or whole periods, than blocks, or the gap leaves nothing to
            train on.
        """
        n_splits = self.get_n_splits()
        unit = self._unit
        gap = check_count("gap", self.gap, 0, f"it counts the {unit}s left out beside a block")
        if X is None:
            raise ValueError(
                f"X is None; {type(self).__name__} reads the times of its rows: give X"
            )
        given, X = X, as_container(X, "X")
        if not keeps_times(given, X):
            X = np.asarray(X)  # of a table without times, too
        base, units, share, always = self._rows_in_units(X)
        block = np.empty(len(units), dtype=int)
        for rows, label in base.rows_of_records():
            counted = np.where(always[rows], 0.0, share[rows])
            block[rows] = self._blocks(units[rows], counted, n_splits, label)
        for k in range(n_splits):
            tested = (block == k) & ~always
            away = ~tested
            for rows, _ in base.rows_of_records():
                own = units[rows][tested[rows]]
                away[rows] &= (units[rows] < own[0] - gap) | (units[rows] > own[-1] + gap)
            if not is_pandas(X):  # whose index shows the hole to model steps
                away = _longer_side(away)
            if np.sum(share[away]) < 1.0 - share.max() + SAME_TURN:
                raise ValueError(
                    f"gap={gap} leaves no {self._whole} to train on beside block {k} of "
                    f"n_splits={n_splits}; give longer records, a smaller gap or more blocks"
                )
            yield np.flatnonzero(away | always), np.flatnonzero(tested)

    def _rows_in_units(self, X):
        """Time base; of each row: number of its unit, share of one, whether always trained on."""
        base, n_rows = read_time(X, time_origin=FIRST), len(X)
        return base, np.arange(n_rows), np.ones(n_rows), np.zeros(n_rows, dtype=bool)

    def _blocks(self, units, share, n_splits, label):
        """Block of each row of one record, of which each holds some share of a unit."""
        numbers, own = np.unique(units, return_inverse=True)
        held, rows = np.bincount(own, share), np.bincount(own, share > 0.0)
        whole = numbers[held * (rows + 1.0) > rows + PERIOD_TOLERANCE]  # a row short is incomplete
        if len(whole) < n_splits:
            raise ValueError(
                f"record {label!r} has {len(whole)} {self._whole}(s){self._size}, too few for "
                f"n_splits={n_splits} blocks; give longer records or fewer blocks"
            )
        borders = [part[0] for part in np.array_split(whole, n_splits)[1:]]
        return np.searchsorted(borders, units, side="right")


class PeriodBlockSplit(BlockSplit):
    """Cut each record into blocks of whole periods, and test on one block after another.

    Period p holds the rows with 2πp ≤ ψ < 2π(p + 1), where ψ is ωt or a measured azimuth. The
    whole periods of a record are divided into ``n_splits`` blocks as evenly as possible. The
    incomplete ones at its ends stay with their neighbours, so every row is tested once. Fold k
    tests block k of every record and trains on the rest in order of time, without the ``gap``
    periods on either side, where the outputs still respond to the tested inputs or their window.
    Model steps see the hole as a gap in time, which starts a new segment. For arrays, which have
    no times, each fold trains only on the longer side of its block (see :class:`BlockSplit`).

    Parameters
    ----------
    n_splits : int, default=5
        Number of blocks, at least 2.
    omega : float or None, default=None
        Fundamental frequency in rad/s. Give this or ``azimuth``.
    gap : int, default=1
        Periods left out of training on either side of a test block.
    trim_span : (float, float) or None, default=None
        Index times, in seconds within each record (dates: since ``time_origin``),
        whose rows are used for training in every fold and never tested: the ``trim_span`` of the
        analyzer, which must see the machine in trim whichever block is tested.
    sample_time : float or None, default=None
        Seconds. None reads it from the index; without times it is 1.0.
    azimuth : str or None, default=None
        Column of X that holds ψ in rad of a rotor whose speed varies. It increases, or starts
        again at each turn; NaN is interpolated.
    time_origin : date or None, default=None
        The instant of ψ = 0, for an index of dates. With ``azimuth`` it only sets the zero of
        ``trim_span``; None is then the first sample.

        The last four are those of :class:`~sklearn_hd.HarmonicAnalyzer`.

    See Also
    --------
    BlockSplit : Blocks of rows, for data without a fundamental frequency.
    sklearn.model_selection.TimeSeriesSplit : Trains on the past alone.
    sklearn.model_selection.GroupKFold : Whole records, by the record level of the index.

    References
    ----------
    Burman, Chow, Nolan (1994), A cross-validatory method for dependent data, Biometrika
    81(2), 351-358 (blocks, and a gap on either side).

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

    def __init__(
        self,
        n_splits=5,
        *,
        omega=None,
        gap=1,
        trim_span=None,
        sample_time=None,
        azimuth=None,
        time_origin=None,
    ):
        self.n_splits = n_splits
        self.omega = omega
        self.gap = gap
        self.trim_span = trim_span
        self.sample_time = sample_time
        self.azimuth = azimuth
        self.time_origin = time_origin

    _unit, _whole = "period", "whole period"

    @property
    def _size(self):
        return f" of {self.azimuth or f'omega={self.omega:.6g} rad/s'}"

    def _rows_in_units(self, X):
        origin = check_phase(self.omega, self.azimuth, self.time_origin)
        base = read_time(X, self.sample_time, origin)
        turns, share = self._turns(X, base)
        return base, np.floor(turns).astype(int), share, self._always_trained(X, base)

    def _turns(self, X, base):
        """Turns made at each row, a row just short of ψ = 0 on it, and turns from row to row."""
        if self.azimuth is not None:
            return self._turns_measured(X, base)
        omega = float(self.omega)
        samples = 2.0 * np.pi / omega / base.sample_time
        if samples < 2.0:
            raise ValueError(
                f"omega={omega:.6g} rad/s and a sample time of {base.sample_time:.6g} s give "
                f"{samples:.4g} samples a period; at least two are needed: correct omega, or give "
                f"sample_time where rows carry no times"
            )
        turns = base.time * omega / (2.0 * np.pi)
        return turns + 0.5 / samples, np.full(len(turns), 1.0 / samples)

    def _turns_measured(self, X, base):
        psi = read_azimuth(X, base, self.azimuth)
        turns, share = np.empty(len(psi)), np.empty(len(psi))
        for rows, label in base.rows_of_records():
            known = np.isfinite(psi[rows])
            if known.sum() < 2:
                raise ValueError(
                    f"azimuth column {self.azimuth!r} shows no motion in record {label!r}: it is "
                    f"known at fewer than two rows; drop that record"
                )
            time = base.time[rows]
            whole = unwrap(psi[rows], time)
            turns[rows] = np.interp(time, time[known], whole[known]) / (2.0 * np.pi)
        for segment in base.segments:
            steps = np.diff(turns[segment])
            share[segment] = np.append(steps, steps[-1:] if len(steps) else 0.0)
        return turns + SAME_TURN, share

    def _always_trained(self, X, base):
        """Rows of the trim span."""
        if self.trim_span is None:
            return np.zeros(len(base.time), dtype=bool)
        start, stop = check_span("trim_span", self.trim_span)
        if not is_pandas(X):
            raise ValueError(
                f"trim_span={self.trim_span} stays in the training rows of every fold, but X is an "
                f"array without times, so its rows would close up over the gap between them; give "
                f"it times: pd.DataFrame(X, index=np.arange(len(X)) * {base.sample_time:.6g}), y "
                f"the same"
            )
        tolerance = 0.5 * base.sample_time
        return (base.time >= start - tolerance) & (base.time < stop - tolerance)


def _longer_side(away):
    """The rows on the longer side of a hole."""
    first, last = np.flatnonzero(~away)[[0, -1]]
    before = first >= len(away) - 1 - last
    row = np.arange(len(away))
    return row < first if before else row > last
