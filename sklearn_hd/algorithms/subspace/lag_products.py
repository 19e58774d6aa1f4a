"""Lagged products of records: all that block Hankel matrices leave behind in RᵀR.

With the channels z_k of row k (inputs, then outputs), the product of the Hankel matrix
of 2i block rows and j columns with itself has the p × p blocks

    G[a, b] = Σ_{k=0}^{j-1} z_{k+a} z_{k+b}ᵀ,    0 ≤ a ≤ b < 2i,   j = n − 2i + 1

which is constant along block diagonals except for the ends of the record:

    G[0, b]     = T[b] − Σ_{k=j}^{n-1-b} z_k z_{k+b}ᵀ,     T[b] = Σ_{k=0}^{n-1-b} z_k z_{k+b}ᵀ
    G[a+1, b+1] = G[a, b] − z_a z_bᵀ + z_{j+a} z_{j+b}ᵀ

So it takes the lag products T, n · 2i · p² products instead of n · (2i p)² / 2, and the
products of the first and of the last 2i − 1 rows of each record among themselves. All three
are sums over records (of the last two, the rows are kept): they add up in any order, and for
fewer block rows they are parts of the same arrays. Records too short for all lags are kept as
they are.

Chunks of one record
    Each row belongs to one chunk (a ``Stretch``), which is rounded once and on its own.
    It takes its first and last 2i − 1 rows along; from these come the products across the
    seam with the next chunk: ``join`` is associative, and ``closed`` turns the chunks of a
    record into a summand.

Sums in double are enough where noise keeps the columns of the factor apart. Exact sums,
for data where these almost coincide, cut each channel into three slices of 18 bits beside
its largest value, so that BLAS rounds nothing, and add up in double-double; what is left
is one rounding of the data, 2⁻⁵⁴ of the channel's largest value.

Three products of half the length do for four. With e_j = z_{2j} and o_j = z_{2j+1}

    T[2b]     = Σ_j (e_j + o_j) o_{j+b}ᵀ + e_j (e_{j+b} − o_{j+b})ᵀ
    T[2b + 1] = Σ_j (e_j + o_j) o_{j+b}ᵀ + o_j (e_{j+b+1} − o_{j+b})ᵀ

where the first is the same (Karatsuba's way, for the lags of a sum: Winograd, 1980). It mixes no
channels, and slices of 18 bits leave room for sums of two.

Work is done in chunks of some thousand rows, each seen by BLAS as matrices of overlapping
rows in place: samples from row r, r + s, r + 2 s, … on do not overlap for s rows or fewer.
Products of several rows at a time keep a processor busier than those of one.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np

from sklearn_hd._guards import extremes
from sklearn_hd.algorithms.linalg.double_double import (
    N_SLICES,
    Pair,
    all_slices,
    product,
    slices,
    sum_of_slices,
)

CHUNK = 6144  # pairs of rows, which fit into a cache; sums of their slices' products: 51 bits
LEAST_SQUARE = 1e-200  # whose rounding is no smaller than numbers can be
TOGETHER = 24  # channels times rows on the left side of one product
REMEMBERED_ROWS = 256  # of a Gram matrix, whose table of places is kept for the next (0.5 MB)
PLACED_ROWS = 32  # of a larger one at a time, which is put in order where it stands
BLOCK_BYTES = 2**19  # of products at a time


@dataclass(frozen=True)
class LagProducts:
    """Summed lag products of whole records."""

    # Pair, shape (n_lags, p, p): t[b], of channels divided by 2 to the power of ``exponents``
    lags: Pair
    # (n_records, (n_lags - 1) p): the first n_lags − 1 rows of each record side by side, as they
    # were multiplied
    head: np.ndarray
    tail: np.ndarray  # (n_records, (n_lags - 1) p): the same of the last rows
    exponents: np.ndarray  # int, (p,)
    n_rows: int  # of the records summed
    short: tuple = ()  # (n_rows_s, p): records of fewer rows than lags, as they are

    @property
    def exact(self):
        """Whether nothing but one rounding of the data was lost."""
        return self.lags.low is not None

    def __add__(self, other):
        """Sum over the records of both, in any order."""
        e = np.maximum(self.exponents, other.exponents)
        return LagProducts(
            lags=self._lags_in(e) + other._lags_in(e),
            head=np.vstack([self.head, other.head]),
            tail=np.vstack([self.tail, other.tail]),
            exponents=e,
            n_rows=self.n_rows + other.n_rows,
            short=self.short + other.short,
        )

    def _lags_in(self, exponents):
        return _times_powers(self.lags, self.exponents - exponents)

    def faded(self, shift):
        """The same of rows divided by 2 to the power of ``shift``."""
        return replace(
            self,
            head=np.ldexp(self.head, -shift),
            tail=np.ldexp(self.tail, -shift),
            exponents=self.exponents - shift,
            short=tuple(np.ldexp(z, -shift) for z in self.short),
        )

    def n_columns(self, n_block_rows):
        """Number of Hankel columns that 2i block rows leave."""
        short = sum(max(0, len(z) - n_block_rows + 1) for z in self.short)
        return self.n_rows - len(self.head) * (n_block_rows - 1) + short

    def fewer(self, n_lags):
        """The same for fewer lags, for which short records may be long enough.

        It raises ValueError if there are not so many lags.
        """
        if n_lags > len(self.lags):
            raise ValueError(
                f"products of {len(self.lags)} lags are too few for a Hankel matrix of {n_lags} "
                f"block rows; make them with n_lags={n_lags} or more"
            )
        if n_lags == len(self.lags):
            return self
        w = (n_lags - 1) * len(self.exponents)
        kept = replace(
            self,
            lags=self.lags[:n_lags],
            head=self.head[:, :w],
            tail=self.tail[:, self.tail.shape[1] - w :],
            short=tuple(z for z in self.short if len(z) < n_lags),
        )
        longer = [(z,) for z in self.short if len(z) >= n_lags]
        return kept + lag_products(longer, n_lags, self.exact) if longer else kept

    def channels(self, which):
        """The same for some of the channels, by their numbers."""
        rows = np.arange(self.head.shape[1]).reshape(-1, len(self.exponents))[:, which].ravel()
        return replace(
            self,
            lags=self.lags.map(lambda half: half[:, which][:, :, which]),
            head=self.head[:, rows],
            tail=self.tail[:, rows],
            exponents=self.exponents[which],
            short=tuple(z[:, which] for z in self.short),
        )

    def root_mean_squares(self):
        """Of each channel over all rows; one where a channel is zero."""
        n_rows = self.n_rows + sum(map(len, self.short))
        squares = np.diagonal(self.lags.high[0]).copy()
        for z in self.short:
            squares += np.sum(np.ldexp(z, -self.exponents) ** 2, axis=0)
        size = np.ldexp(np.sqrt(squares / max(n_rows, 1)), self.exponents)
        return np.where(size > 0.0, size, 1.0)

    def gram(self, order=None):
        """Product of the Hankel matrix with itself.

        ``order`` has all rows: that which is to stand first, second, …. They stand by
        lag, then by channel, by default. Then block (a, b) is Σ_k z_{k+a} z_{k+b}ᵀ, of
        channels divided by their powers of two.
        """
        blocks, p = self._by_lag(), len(self.exponents)
        n_rows = len(self.lags) * p
        order = np.arange(n_rows) if order is None else order
        if n_rows <= REMEMBERED_ROWS:
            place = _places_remembered(p, order.tobytes())
            return blocks.map(lambda half: half.take(place))
        return blocks.map(lambda half: _in_order(half.reshape(n_rows, n_rows), p, order))

    def _by_lag(self):
        """Blocks of the same, [a, c, (b − a) p + d], shape (n_lags, p, n_lags p)."""
        n_lags, p = self.lags.high.shape[:2]
        head, tail = (self._slices(rows) for rows in (self.head, self.tail))
        blocks = self.lags.map(lambda half: np.empty((n_lags, p, n_lags * p)))
        some = max(1, BLOCK_BYTES // blocks.high[0].nbytes)
        spans = [(a, min(a + some, n_lags - 1)) for a in range(0, n_lags - 1, some)]
        for start, stop in spans:
            blocks[start + 1 : stop + 1] = _end_products(tail, p, start, stop, self.exact)
        first = self.lags.map(lambda half: half.transpose(1, 0, 2).reshape(p, -1))
        blocks[0] = first - blocks[1:].total()
        for start, stop in spans:
            ends = _end_products(head, p, start, stop, self.exact)
            blocks.subtract(np.s_[start + 1 : stop + 1], ends)
        blocks.accumulate()
        return blocks

    def _slices(self, rows):
        """Rows at one end of the records, as they were multiplied; in slices if exact."""
        powers = np.tile(self.exponents, len(self.lags) - 1)
        rows = np.ldexp(rows, -powers) if powers.any() else rows
        return all_slices(rows) if self.exact else rows[None]


def _end_products(parts, p, start, stop, exact):
    """Σ over records of r rᵀ, by lags, for rows r at one end side by side.

    Of channel c of row a and channel d of row b ≥ a, at [a, c, (b − a) p + d], for the a from one
    to another, zeros after the last b.
    """
    products = [[_of_windows(a, b, p, start, stop) for b in parts] for a in parts]
    return sum_of_slices(products) if exact else Pair(products[0][0])


def _of_windows(left, right, p, start, stop):
    """Products of p entries of each row with all entries from there on."""
    n_records, width = right.shape
    if n_records == 0:
        return np.zeros((stop - start, p, width + p))
    padded = np.zeros((n_records, width + stop * p))
    padded[:, :width] = right
    item, shape = padded.itemsize, (stop - start, n_records, width + p)
    strides = p * item, padded.strides[0], item
    windows = np.ndarray(shape, buffer=padded, offset=start * p * item, strides=strides)
    left = left.reshape(n_records, -1, p)[:, start:stop].transpose(1, 2, 0)
    return left * windows if n_records == 1 else left @ windows  # the same, in less time


def _times_powers(products, exponents):
    """A pair [.., i, j] times 2 to the powers of both."""
    if not exponents.any():
        return products
    shift = exponents[:, None] + exponents
    return products.map(lambda half: np.ldexp(half, shift))


@functools.lru_cache(maxsize=1)
def _places_remembered(p, order):
    """Where blocks [a, c, (b − a) p + d], in one row, hold a symmetric matrix, order as bytes."""
    order = np.frombuffer(order, int)
    row = order * len(order) - order // p * p
    place = np.minimum.outer(row, row)
    place += np.maximum.outer(order, order)
    return place


def _in_order(blocks, p, order):
    """The symmetric matrix that blocks [a, c, (b − a) p + d] are, in the memory they have."""
    n_rows = len(blocks)
    for start in range(p, n_rows, p):
        block_row = blocks[start : start + p]
        block_row[:, start:] = block_row[:, : n_rows - start].copy()
    for start in range(0, n_rows - p, p):
        block_row = blocks[start : start + p]
        blocks[start + p :, start : start + p] = block_row[:, start + p :].T
    for start in range(0, n_rows, PLACED_ROWS):
        some = blocks[start : start + PLACED_ROWS]
        some[:] = some.take(order, axis=1)
    to_come = set(range(n_rows))
    while to_come:  # rows, each where another has just gone
        first = row = to_come.pop()
        spare = blocks[first].copy()
        while order[row] != first:
            blocks[row] = blocks[order[row]]
            row = order[row]
            to_come.remove(row)
        blocks[row] = spare
    return blocks


@dataclass(frozen=True)
class Stretch:
    """Lag products of consecutive rows of a record, that others may follow.

    ``lags`` (n_lags, p, p) are of channels divided by 2 to the power of ``exponents``.
    ``first`` and ``last`` are the min(n_rows, n_lags − 1) rows at both ends, as they
    were multiplied: rounded beside the largest value of their own chunk, which may be
    smaller than that of others.
    """

    lags: Pair
    first: np.ndarray
    last: np.ndarray
    exponents: np.ndarray
    n_rows: int

    def faded(self, shift):
        """The same of rows divided by 2 to the power of ``shift``."""
        first, last = (np.ldexp(rows, -shift) for rows in (self.first, self.last))
        return replace(self, first=first, last=last, exponents=self.exponents - shift)

    def join(self, later):
        """This stretch and the rows right after it, as one."""
        e = np.maximum(self.exponents, later.exponents)
        kept, changes = len(self.lags) - 1, (self.exponents - e, later.exponents - e)
        lags = _times_powers(self.lags, changes[0]) + _times_powers(later.lags, changes[1])
        shift = changes[0][:, None] + changes[1]
        seam = _seam(self, later).map(lambda half: np.ldexp(half, shift))
        return Stretch(
            lags=lags + seam,
            first=np.vstack([self.first, later.first])[:kept],
            last=np.vstack([self.last, later.last])[-kept:],
            exponents=e,
            n_rows=self.n_rows + later.n_rows,
        )

    def closed(self):
        """The whole record as a summand."""
        if self.n_rows < len(self.lags):
            return _nothing(len(self.lags), self.exponents, exact=True, short=(self.first,))
        ends = (rows.reshape(1, -1) for rows in (self.first, self.last))
        return LagProducts(self.lags, *ends, self.exponents, self.n_rows)


def _seam(earlier, later):
    """Lag products of rows before the seam with rows after it, shape (n_lags, p, p)."""
    before = np.ldexp(earlier.last, -earlier.exponents)
    after = np.ldexp(later.first, -later.exponents)
    n_before, n_after = len(before), len(after)
    lags = []
    for lag in range(len(earlier.lags)):
        start = max(0, n_before - lag)
        stop = max(start, min(n_before, n_before + n_after - lag))
        to = slice(start + lag - n_before, stop + lag - n_before)
        lags.append(product(before[start:stop], after[to], exact=True))
    return lags[0].map(lambda *halves: np.stack(halves), *lags[1:])


def stretch(signals, n_lags):
    """Lag products of consecutive rows of one record, in exact sums.

    Signals side by side are the channels. ``n_lags``, at least 2, are the block rows
    2i, past and future, of the Hankel matrix to come.
    """
    exponents = _power_exponents([signals])
    ends = [_rounded([signals], part, exponents, exact=True)[0] for part in _ends(n_lags)]
    lags = _lag_sums([signals], n_lags, exponents, exact=True)
    return Stretch(lags, *ends, exponents, len(signals[0]))


def lag_products(records, n_lags, exact):
    """Lag products of whole records.

    The arrays of a record, side by side, are its channels. ``n_lags``, at least 2, are
    the block rows 2i, past and future, of the Hankel matrix to come. ``exact`` asks for
    exact sums instead of sums in double.

    Examples
    --------
    >>> z = np.array([[1.0], [2.0], [3.0], [4.0]])
    >>> products = lag_products([(z,)], 2, exact=True)  # of 1, 2, 3 and 4 in parts of 8
    >>> (64 * products.gram().high).tolist()
    [[14.0, 20.0], [20.0, 29.0]]
    """
    short = tuple(np.hstack(signals) for signals in records if len(signals[0]) < n_lags)
    long = [signals for signals in records if len(signals[0]) >= n_lags]
    units = long or records  # short ones are kept, not multiplied
    n_channels = sum(z.shape[1] for z in records[0])
    exponents = _power_exponents(units) if exact else np.zeros(n_channels, int)
    if not long:
        return _nothing(n_lags, exponents, exact, short)
    lags = _lag_sums(long, n_lags, exponents, exact)
    if not exact and not _within_range(lags.high[0]):
        exponents = _power_exponents(units)
        if np.max(np.abs(exponents)) > 300:  # else a channel is at rest
            lags = _lag_sums(long, n_lags, exponents, exact)
        else:
            exponents = np.zeros_like(exponents)
    ends = [_rounded(long, part, exponents, exact) for part in _ends(n_lags)]
    ends = (rows.reshape(len(long), -1) for rows in ends)
    n_rows = sum(len(signals[0]) for signals in long)
    return LagProducts(lags, *ends, exponents, n_rows, short)


def _rounded(records, part, exponents, exact):
    """Rows at one end of records, as they are multiplied."""
    rows = np.array([np.hstack([z[part] for z in signals]) for signals in records])
    if not exact:
        return rows
    return np.ldexp(slices(np.ldexp(rows, -exponents), N_SLICES).sum(axis=0), exponents)


def _within_range(products):
    """Whether squares have neither over- nor underflown."""
    squares = np.diagonal(products)
    return np.all((squares > LEAST_SQUARE) & (squares < 1.0 / LEAST_SQUARE))


def _power_exponents(records):
    """Whole powers of two just above the largest value of each channel."""
    ends = [np.hstack([extremes(z) for z in signals]) for signals in records]
    largest = np.max(np.abs(ends), axis=(0, 1))
    return np.where(largest > 0.0, np.frexp(largest)[1], 0)


def _ends(n_lags):
    return slice(0, n_lags - 1), slice(-(n_lags - 1), None)


def _nothing(n_lags, exponents, exact, short):
    """The sum over no record of all lags."""

    def zeros(*shape):
        return Pair(np.zeros(shape), np.zeros(shape) if exact else None)

    p = len(exponents)
    ends = np.zeros((0, (n_lags - 1) * p))
    return LagProducts(zeros(n_lags, p, p), ends, ends, exponents, 0, short)


def _lag_sums(records, n_lags, exponents, exact):
    """Σ_k z_k z_{k+b}ᵀ within each record, b = 0 … n_lags − 1."""
    p, n_pairs = len(exponents), -(-n_lags // 2)
    width = p * N_SLICES if exact else p
    together = max(4, min(TOGETHER // width, n_pairs // 4))
    span = n_pairs + together - 1
    period = -(-span // together) * together
    chunk = max(CHUNK // period, 1) * period
    factor = np.ldexp(1.0, -exponents) if exponents.any() else None
    buffers = np.empty((3, chunk + span + 1, p))
    zeros = np.zeros((2 * n_pairs, p, p))
    total = Pair(zeros, zeros if exact else None)
    for signals in records:
        n = -(-len(signals[0]) // 2)
        for start in range(0, n, chunk):
            size = min(chunk, -(-(n - start) // period) * period)
            even, odd = _fill(buffers[:2, : size + span + 1], signals, 2 * start, factor)
            spare = buffers[2, : size + span]
            if exact:
                even, odd = _side_by_side(even), _side_by_side(odd)
                spare = np.empty((size + span, width))
            grid = size // period, period, together, span
            with np.errstate(over="ignore", invalid="ignore", under="ignore"):  # seen to after
                sums = _pair_products(even, odd, spare, grid)
            sums = sums.reshape(together, width, span, 2, width)
            sums = sum(sums[a, :, a : a + n_pairs] for a in range(together))
            total = total + _by_lag(sums.reshape(width, 2 * n_pairs, width), p, exact)
    if not exact:  # else it is symmetric as it stands
        total.high[0] = 0.5 * (total.high[0] + total.high[0].T)
    return total[:n_lags]


def _fill(buffers, signals, start, factor):
    """Rows of all signals from one on, those at even places and those at odd; zeros after."""
    for first, buffer in enumerate(buffers, start):
        rows = min(len(buffer), len(signals[0][first::2]))
        channels = [channel for z in signals for channel in z[first::2].T]
        for c, channel in enumerate(channels):  # each by itself: 5 × faster
            buffer[:rows, c] = channel[:rows]
            if factor is not None:
                buffer[:rows, c] *= factor[c]
        buffer[rows:] = 0.0
    return buffers


def _side_by_side(rows):
    """Slices of the channels as channels."""
    return np.stack(slices(rows, N_SLICES), axis=1).reshape(len(rows), -1)


def _pair_products(even, odd, spare, grid):
    """Sums of products of rows that are 2b (first) and 2b + 1 (second) apart, of three.

    Shape (together width, span, 2, width).
    """
    now, after, odd = even[:-1], even[1:], odd[:-1]
    both = _overlapping(np.add(now, odd, out=spare), odd, *grid)
    own = _overlapping(now, np.subtract(now, odd, out=spare), *grid)
    across = _overlapping(odd, np.subtract(after, odd, out=spare), *grid)
    return np.stack([both + own, both + across], axis=2)


def _overlapping(left, right, n_periods, period, together, span):
    """Sums of the products of each ``together`` rows with ``span`` rows of another array.

    Shape (together width, span, width).
    """
    width, item = left.shape[1], left.itemsize
    strides = (together * width * item, period * width * item, item)

    def windows(rows, length):
        shape = (period // together, n_periods, length * width)
        return np.ndarray(shape, buffer=rows, strides=strides)

    left, right = windows(left, together).transpose(0, 2, 1), windows(right, span)
    some = max(1, BLOCK_BYTES // (together * width * span * width * item))
    sums = 0.0  # of some products at a time: together they may be as large as a factor
    for start in range(0, len(left), some):
        part = slice(start, start + some)
        sums += np.matmul(left[part], right[part]).sum(axis=0)
    return sums.reshape(-1, span, width)


def _by_lag(sums, p, exact):
    """[channel, lag, channel] as [lag, channel, channel], slices put together."""
    sums = sums.transpose(1, 0, 2)
    if not exact:
        return Pair(sums)
    parts = sums.reshape(len(sums), N_SLICES, p, N_SLICES, p).transpose(1, 3, 0, 2, 4)
    return sum_of_slices(parts)
