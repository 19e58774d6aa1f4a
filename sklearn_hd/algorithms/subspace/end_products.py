"""Products among themselves of the rows at one end of records, which lag products take along.

With the first, or the last, rows z_0, z_1, … of a record side by side in one row r, Σ rᵀr over
records is asked for by lags: of channel c of row a and channel d of row b ≥ a, at
[a, c, (b − a) p + d]. Records that are few take less memory as they are than their product does.
"""

from dataclasses import dataclass

import numpy as np

from sklearn_hd.algorithms.linalg.double_double import (
    N_SLICES,
    Pair,
    product,
    slices,
    sum_of_slices,
)

__all__ = ["EndRows", "EndSum", "end_products", "times_powers"]

FEW = 8  # records, as many times fewer than rows have entries


def end_products(rows, exact):
    """Σ rᵀr over records.

    Parameters
    ----------
    rows : ndarray, shape (n_records, w)
        r of each record, entries up to one in size if ``exact``.
    exact : bool
        In double-double, sums without rounding.

    Returns
    -------
    products : EndRows or EndSum
    """
    ends = EndRows(rows, exact)
    return ends if FEW * len(rows) <= rows.shape[1] else ends.summed()


@dataclass(frozen=True)
class EndSum:
    """Σ rᵀr of many records.

    Attributes
    ----------
    sum : Pair, shape (w, w)
    """

    sum: Pair

    def summed(self):
        """This one."""
        return self

    def __add__(self, other):
        return EndSum(self.sum + other.summed().sum)

    def times_powers(self, exponents):
        """With entries of r times 2 to the power of ``exponents``."""
        return EndSum(times_powers(self.sum, exponents))

    def part(self, which):
        """For some of the entries of r, a slice or an array of int."""
        return EndSum(self.sum.map(lambda half: half[which][:, which]))

    def by_lag(self, p, start, stop):
        """[a, c, (b − a) p + d] for the a from one to another, zeros after the last row b."""
        return self.sum.map(lambda half: _along_diagonals(half, p, start, stop))


@dataclass(frozen=True)
class EndRows:
    """Σ rᵀr of few records, not multiplied yet.

    Attributes
    ----------
    rows : ndarray, shape (n_records, w)
    exact : bool
        In double-double, sums without rounding.
    n_slices : int
        Of the entries, 18 bits each.
    """

    rows: np.ndarray
    exact: bool
    n_slices: int = N_SLICES

    def summed(self):
        """The same, multiplied."""
        return EndSum(product(self.rows, self.rows, self.exact, self.n_slices))

    def __add__(self, other):
        return self.summed() + other

    def times_powers(self, exponents):
        """With entries of r times 2 to the power of ``exponents``, of which no bit is left out."""
        return self.summed().times_powers(exponents)

    def part(self, which):
        """For some of the entries of r, a slice or an array of int."""
        return EndRows(self.rows[:, which], self.exact, self.n_slices)

    def by_lag(self, p, start, stop):
        """[a, c, (b − a) p + d] for the a from one to another, zeros after the last row b."""
        if not self.exact:
            return Pair(_of_windows(self.rows, self.rows, p, start, stop))
        parts = slices(self.rows, self.n_slices)
        return sum_of_slices([[_of_windows(a, b, p, start, stop) for b in parts] for a in parts])


def times_powers(products, exponents):
    """A pair [.., i, j] times 2 to the powers of both."""
    shift = exponents[:, None] + exponents
    return products.map(lambda half: np.ldexp(half, shift))


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


def _along_diagonals(half, p, start, stop):
    """The upper block triangle of a symmetric matrix, by block diagonals."""
    width = len(half)
    blocks = np.zeros((stop - start, p, width + p))
    for block, a in zip(blocks, range(start * p, stop * p, p), strict=True):
        block[:, : width - a] = half[a : a + p, a:]
    return blocks
