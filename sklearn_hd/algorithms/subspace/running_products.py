"""Sums over records that grow, from which models are made at any time.

What identification needs of a record of inputs u and outputs y are sums over its rows:

- the lagged products that block Hankel matrices leave behind
  (:mod:`~sklearn_hd.algorithms.subspace.lag_products`), in exact sums, for no later row may show
  that plain ones would not have done;
- for B, D and the initial state, the products of y and u with the responses to u. These
  depend on A, which no row but the last settles. But a stable A forgets: with

      T[d] = Σ_k u_{k-d} z_k',    d = 0 … K,

  the responses' products are Σ_d A^{d-1} T[d] once A^K is nothing beside rounding. T comes by
  Fourier transforms of some thousand rows at a time. At both ends of a record, K rows tell
  what the initial state and the last response were.

So the memory taken does not grow with a record: some thousand rows, and the sums.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from sklearn_hd.algorithms.subspace.lag_products import LagProducts, Stretch, lag_products, stretch

__all__ = ["RecordEnds", "RunningRecord", "RunningSums", "correlations"]

REACH = 4096  # rows K that responses are followed over
ROUND = 16384  # rows added up at a time: with K before them, a Fourier transform of 5 · 2¹²
MANY = 4096  # rows that do not wait for more: each model made meanwhile would add them up anew


@dataclass(frozen=True)
class RecordEnds:
    """The first and last rows of a record.

    Attributes
    ----------
    head : ndarray, shape (min(n_rows, K), p)
        Of inputs and outputs.
    tail : ndarray, shape (min(n_rows, K), m)
        Of inputs.
    n_rows : int
    """

    head: np.ndarray
    tail: np.ndarray
    n_rows: int


@dataclass(frozen=True)
class RunningSums:
    """Sums over whole records.

    Attributes
    ----------
    products : LagProducts or None
        Of all channels.
    lags : ndarray, shape (K + 1, m, p)
        T[d], of inputs with inputs and outputs.
    squares : ndarray, shape (l,)
        Of the outputs.
    ends : tuple of RecordEnds
        Of each record.
    """

    products: LagProducts | None
    lags: np.ndarray
    squares: np.ndarray
    ends: tuple

    def of_inputs(self, which):
        """T and ends for some of the inputs, and all outputs.

        Parameters
        ----------
        which : ndarray of int
        """
        n_inputs, n_signals = self.lags.shape[1:]
        signals = np.concatenate([which, np.arange(n_inputs, n_signals)])
        ends = (replace(e, head=e.head[:, signals], tail=e.tail[:, which]) for e in self.ends)
        return replace(self, lags=self.lags[:, which][:, :, signals], ends=tuple(ends))

    def __add__(self, other):
        return RunningSums(
            self.products + other.products,
            self.lags + other.lags,
            self.squares + other.squares,
            self.ends + other.ends,
        )


@dataclass(frozen=True)
class RunningRecord:
    """Sums over the rows so far of a record that others may follow.

    Attributes
    ----------
    n_lags : int
        Block rows 2i of the Hankel matrix to come.
    inputs, outputs : ndarray of int, shapes (m,), (l,)
        Channels that B, D and the initial state are found from.
    waiting : ndarray, shape (n_waiting, n_channels)
        Rows not yet added up.
    sums : Stretch or None
        Lag products of the rows before these.
    before : ndarray, shape (≤ K, m)
        The last of the inputs added up.
    head : ndarray, shape (≤ K, p)
        The first of the rows added up.
    lags, squares : ndarray or None
        As of ``RunningSums``.
    n_rows : int
        Waiting or added up.
    """

    n_lags: int
    inputs: np.ndarray
    outputs: np.ndarray
    waiting: np.ndarray
    sums: Stretch | None = None
    before: np.ndarray | None = None
    head: np.ndarray | None = None
    lags: np.ndarray | None = None
    squares: np.ndarray | None = None
    n_rows: int = 0

    @classmethod
    def begin(cls, n_lags, inputs, outputs, n_channels):
        """A record of no rows.

        Parameters
        ----------
        n_lags : int
        inputs, outputs : array_like of int
        n_channels : int
        """
        inputs, outputs = np.asarray(inputs), np.asarray(outputs)
        m, p = len(inputs), len(inputs) + len(outputs)
        return cls(
            n_lags,
            inputs,
            outputs,
            waiting=np.zeros((0, n_channels)),
            before=np.zeros((0, m)),
            head=np.zeros((0, p)),
            lags=np.zeros((REACH + 1, m, p)),
            squares=np.zeros(len(outputs)),
        )

    def extended(self, rows):
        """The same with more rows.

        Parameters
        ----------
        rows : ndarray, shape (n_more, n_channels)

        Returns
        -------
        record : RunningRecord
        """
        waiting = np.concatenate([self.waiting, rows])
        record = replace(self, waiting=waiting, n_rows=self.n_rows + len(rows))
        while len(record.waiting) >= max(MANY, self.n_lags):
            record = record._added_up(min(ROUND, len(record.waiting)))
        return record

    def closed(self):
        """Sums over the record, as it stands.

        Returns
        -------
        sums : RunningSums
        """
        if self.sums is None and len(self.waiting) < self.n_lags:  # too short for all lags
            record = self._correlated(self.waiting)
            products = lag_products([(self.waiting,)], self.n_lags, exact=True)
        else:
            record = self._added_up(len(self.waiting)) if len(self.waiting) else self
            products = record.sums.closed()
        ends = RecordEnds(record.head, record.before, self.n_rows)
        return RunningSums(products, record.lags, record.squares, (ends,))

    def _added_up(self, count):
        """The same with some of the waiting rows added up."""
        rows, left = self.waiting[:count], self.waiting[count:]
        sums = stretch((rows,), self.n_lags, exact=True)
        if self.sums is not None:
            sums = self.sums.join(sums)
        return replace(self._correlated(rows), sums=sums, waiting=left)

    def _correlated(self, rows):
        """The same with T, squares and ends of some more rows."""
        u, y = rows[:, self.inputs], rows[:, self.outputs]
        z = np.hstack([u, y])
        before = np.concatenate([self.before, u])
        return replace(
            self,
            lags=self.lags + _lagged(before, z),
            squares=self.squares + np.sum(y**2, axis=0),
            head=np.concatenate([self.head, z])[:REACH] if len(self.head) < REACH else self.head,
            before=before[-REACH:],
        )


def correlations(records):
    """Sums over whole records without their lag products.

    Parameters
    ----------
    records : list of tuple of ndarray, shapes (n_rows_s, m), (n_rows_s, l)

    Returns
    -------
    sums : RunningSums
        ``products`` is None.
    """
    lags, squares, ends = 0.0, 0.0, []
    for u, y in records:
        z, m = np.hstack([u, y]), u.shape[1]
        record = RunningRecord.begin(2, range(m), range(m, z.shape[1]), z.shape[1])
        for start in range(0, len(z), ROUND):
            record = record._correlated(z[start : start + ROUND])
        lags, squares = lags + record.lags, squares + record.squares
        ends.append(RecordEnds(record.head, record.before, len(z)))
    return RunningSums(None, lags, squares, tuple(ends))


def _lagged(before, z):
    """Σ_k u_{k-d} z_k' for d = 0 … K, over rows z whose inputs are the last of ``before``.

    Parameters
    ----------
    before : ndarray, shape (n_before + n_rows, m)
        At most K rows before those of z.
    z : ndarray, shape (n_rows, p)

    Returns
    -------
    lags : ndarray, shape (K + 1, m, p)
    """
    n_before = len(before) - len(z)
    n_within = max(0, min(len(z) - 1, REACH - n_before))  # lags beyond the first of all rows
    size = fft.next_fast_len(len(before) + n_within, real=True)
    left, right = fft.rfft(before, size, axis=0), fft.rfft(z, size, axis=0).conj()
    sums = np.zeros((REACH + 1, before.shape[1], z.shape[1]))
    for c in range(before.shape[1]):
        shifts = fft.irfft(left[:, [c]] * right, size, axis=0)
        sums[: n_before + 1, c] = shifts[n_before::-1]
        sums[n_before + 1 : n_before + 1 + n_within, c] = shifts[: size - n_within - 1 : -1]
    return sums
