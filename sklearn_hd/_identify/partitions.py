"""Identification from dask DataFrames: a small statistic of each partition, merged as a tree.

The data are read where they are, twice: for the lagged products that R comes from
(:mod:`~sklearn_hd.algorithms.subspace.lag_products`); once more, in exact sums, where needed
and with A and C known for the equations of B, D and the initial states
(:mod:`~sklearn_hd.algorithms.subspace.record_parts`). Records may end within a partition or run
through several; those that are read through a window lie within one. Neighbours are merged
where they are, and what arrives here is one statistic.
"""

import copy
import itertools
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import pandas as pd

from sklearn_hd._identify.modulation import n_modulating_harmonics, steps_at_one_phase
from sklearn_hd._identify.partition_statistics import (
    Statistic,
    partition_changes,
    partition_equations,
    partition_sums,
    worded,
)
from sklearn_hd._readings import HarmonicBasis, PlainReading
from sklearn_hd.algorithms.subspace.hankel import factor_of_products, n_hankel_columns
from sklearn_hd.algorithms.subspace.record_parts import cuts

__all__ = ["Partitions", "basis_of", "is_partitioned"]

FAN_IN = 8  # neighbours merged at a time


def is_partitioned(data):
    """Whether it is a collection of dask's, told without importing dask."""
    return hasattr(data, "__dask_graph__")


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
    measured : ndarray, shape (n_segments, l)
        Largest magnitudes of the outputs.
    basis : HarmonicBasis or PlainReading
    """

    inputs: list
    outputs: list
    drive_names: tuple
    output_names: tuple
    base: RowCount
    words: str
    measured: np.ndarray
    basis: HarmonicBasis | PlainReading

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
        self.basis = basis_of(X)

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

    @cached_property
    def highest(self):
        """Harmonics that inputs are multiplied by, as ``modulated_inputs`` has it."""
        if not self.basis.harmonic:
            return 0
        found = self._tree(partial(partition_changes, basis=self.basis))
        if found is None or steps_at_one_phase(found.changes):
            return 0
        return n_modulating_harmonics(self.basis, found.lengths, found.changes.shape[1])

    def _sums(self, exact):
        how = {"basis": self.basis, "highest": self.highest}
        return self._tree(partial(partition_sums, **how, n_lags=self.n_lags, exact=exact))

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
        drive, names = (tuple(map(str, pd.DataFrame(each).columns)) for each in self.head)
        basis = self.basis
        if not basis.harmonic:
            basis = PlainReading(drive, names)
        ends = [run.extremes for run in sums.runs]
        n_samples = sum(run.n_samples for run in sums.runs)
        return Condensed(
            inputs=[each[:, : len(basis.drive_labels)] for each in ends],
            outputs=[each[:, len(basis.drive_labels) :] for each in ends],
            drive_names=basis.drive_labels,
            output_names=names,
            base=RowCount(range(n_samples), sums.sample_time or 1.0),
            words=f"rows from t = {worded(sums.runs[0].first)} to {worded(sums.runs[-1].last)}",
            measured=np.array([run.size for run in sums.runs]),
            basis=basis,
        )

    @property
    def n_inputs(self):
        """Channels that are projected out of the future."""
        return len(self.experiment.drive_names) * (2 * self.highest + 1)

    def with_lags(self, n_lags):
        """The same for other lags; what is known already is kept."""
        other = copy.copy(self)
        other.__dict__.pop("sums", None)
        other.n_lags = n_lags
        return other

    def root_mean_squares(self):
        """Of each channel, inputs first; one where it is zero."""
        return self.sums.products.root_mean_squares()

    def factor(self, block_rows, scale):
        """R factor of the block Hankel matrices, as ``hankel_factor`` gives."""
        n_lags, n_inputs = 2 * block_rows, self.n_inputs
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
        equations = self._tree(partial(partition_equations, basis=self.basis, model=model), pieces)
        shape = len(A), len(scales[0]), len(C)
        return equations.solve(shape, [(r, 0) for r in range(len(self.sums.runs))])


def _pieces(runs, edges, n_partitions):
    """For each partition its pieces: segment, rows of it, key, and rows of the whole piece."""
    pieces, n_segments = [[] for _ in range(n_partitions)], [0] * n_partitions
    for r, run in enumerate(runs):
        start = 0
        for partition, size in run.parts:
            if size == 0:  # too short for a window
                pieces[partition].append((n_segments[partition], slice(0, 0), (r, 0), 0))
            within = np.unique(np.clip(edges[r], start, start + size))
            for a, b in itertools.pairwise(within):
                p = int(np.searchsorted(edges[r], a, side="right")) - 1
                whole = int(edges[r][p + 1] - edges[r][p])
                rows = slice(int(a) - start, int(b) - start)
                pieces[partition].append((n_segments[partition], rows, (r, p), whole))
            n_segments[partition] += 1
            start += size
    return pieces


def basis_of(X):
    """The harmonic basis that rides on a dask DataFrame, as its meta shows; None without.

    Raises
    ------
    ValueError
        If it is of an analysis that partitions are not read through.
    """
    basis = getattr(getattr(X, "_meta", None), "basis", None) or PlainReading()
    if basis.reading == "period" or basis.small_signal is not None:
        what = (
            "reading='period'"
            if basis.reading == "period"
            else f"small_signal={basis.small_signal!r}"
        )
        raise ValueError(
            f"X was analysed with {what}, which looks at all records at once; give frames in "
            f"memory, X.compute() and y.compute()"
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
