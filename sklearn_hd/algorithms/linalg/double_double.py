"""Sums and a Cholesky factor in double-double: numbers as unevaluated pairs, high + low.

A pair carries 106 bits. What is needed of its arithmetic are error-free sums (Knuth,
1969; Dekker, 1971), and products by BLAS that round nothing: entries cut into slices of
18 bits give products of 36 bits, and 2¹⁷ of these fit into the 53 bits of a double
(Ozaki, Ogita, Oishi and Rump, 2012).

    a = a_1 + a_2 + …,   |a_q| ≤ 2^{−18 (q−1)},   a_q a whole multiple of 2^{−18 q}
    Σ_k a_k b_k = Σ_s ( Σ_{q+r=s} Σ_k a_{q,k} b_{r,k} )     (the inner sums are exact)
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

SLICE_BITS = 18
N_SLICES = 3  # of a double: 54 bits
PAIR_SLICES = 6  # of a pair: 108 bits
RANK_TOLERANCE = 2.0**-86  # of a diagonal entry: what is left of nothing, with a margin


@dataclass(frozen=True)
class Pair:
    """An array in double-double; without the lower half, in double."""

    high: np.ndarray
    low: np.ndarray | None = None

    def __len__(self):
        return len(self.high)

    def __getitem__(self, key):
        return Pair(self.high[key], None if self.low is None else self.low[key])

    def __setitem__(self, key, other):
        for half, new in zip(self.halves(), other.halves(), strict=True):
            half[key] = new

    def __add__(self, other):
        if self.low is None or other.low is None:
            return Pair(self.high + other.high)
        return Pair(*add(self.high, self.low, other.high, other.low))

    def __neg__(self):
        return self.map(np.negative)

    def __sub__(self, other):
        if self.low is None or other.low is None:
            return Pair(self.high - other.high)
        return self + (-other)

    def subtract(self, key, other):
        """Subtract from a part, in place."""
        if self.low is None:
            self.high[key] -= other.high
        else:
            self[key] = self[key] - other

    def total(self):
        """Sum along the first axis."""
        if self.low is None:
            return Pair(self.high.sum(axis=0))
        return sum(self[1:], start=self[0])

    def accumulate(self):
        """Turn parts along the first axis into the sums up to them, in place."""
        if self.low is None:
            for before, part in pairwise(self.high):  # np.cumsum walks through memory in strides
                part += before
            return
        for k in range(1, len(self)):
            self[k] = self[k] + self[k - 1]

    def halves(self):
        """The arrays that there are."""
        return [self.high] if self.low is None else [self.high, self.low]

    def map(self, change, *others):
        """The same exact change of both halves: of shape, sign or scale."""
        highs = (other.high for other in others)
        lows = (other.low for other in others)
        low = None if self.low is None else change(self.low, *lows)
        return Pair(change(self.high, *highs), low)


def two_sum(a, b):
    """Sum of doubles, and what rounding took from it.

    Examples
    --------
    >>> two_sum(1.0, 2.0**-60)
    (1.0, 8.673617379884035e-19)
    """
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def add(high, low, other_high, other_low=0.0):
    """Sum of two pairs, as a pair."""
    total, rest = two_sum(high, other_high)
    return _fast_two_sum(total, rest + (low + other_low))


def _fast_two_sum(large, small):
    total = large + small
    return total, small - (total - large)


def slices(values, count):
    """Values up to one in size in slices of 18 bits, (count, *shape); the rest is left out."""
    parts = np.empty((count, *np.shape(values)))
    rest = np.array(values, dtype=float)
    for q in range(count):
        # added to it, anything below the unit 2^{-18 (q + 1)} is rounded away
        anchor = 1.5 * 2.0 ** (52 - SLICE_BITS * (q + 1))
        np.add(rest, anchor, out=parts[q])
        parts[q] -= anchor
        rest -= parts[q]
    return parts


def sum_of_slices(products):
    """Products of slices, [slice, slice, …], as one pair.

    Those of equal size add up in doubles without rounding; those below 108 bits are left out.
    """
    count = len(products)
    total = None
    for order in range(min(2 * count - 1, PAIR_SLICES)):
        pairs = range(max(0, order - count + 1), min(order + 1, count))
        exact = sum(products[q][order - q] for q in pairs)
        total = (exact, np.zeros_like(exact)) if total is None else add(*total, exact)
    return Pair(*total)


def all_slices(values):
    """Values up to one in size, cut into as many slices as hold all that 108 bits do."""
    parts = slices(values, PAIR_SLICES)
    used = np.flatnonzero(parts.reshape(PAIR_SLICES, -1).any(axis=1))
    return parts[: used[-1] + 1 if len(used) else 1]


def product(left, right, exact):
    """leftᵀ right over common rows, of entries up to one in size: a Pair.

    ``left`` and ``right`` have n rows, up to 2¹⁷. If ``exact``, the product is in
    double-double, without rounding; else it is in double.
    """
    if not exact:
        return Pair(left.T @ right)
    left, right = slices(left, PAIR_SLICES), slices(right, PAIR_SLICES)
    return sum_of_slices([[a.T @ b for b in right] for a in left])


def _times(a_high, a_low, scalar_high, scalar_low):
    """Pairs times one pair."""
    product = a_high * scalar_high
    a_big, b_big = _halves(a_high), _halves(scalar_high)
    a_small, b_small = a_high - a_big, scalar_high - b_big
    rest = ((a_big * b_big - product) + a_big * b_small + a_small * b_big) + a_small * b_small
    return _fast_two_sum(product, rest + (a_high * scalar_low + a_low * scalar_high))


def _halves(a):
    """The upper 26 bits (Veltkamp)."""
    wide = 134217729.0 * a
    return wide - (wide - a)


def _inverse_root(high, low):
    """1 / √a of a pair, by one Newton step in pairs."""
    guess = 1.0 / np.sqrt(high)
    square = _times(guess, 0.0, guess, 0.0)
    product = _times(*square, high, low)
    rest = add(-product[0], -product[1], 1.0)
    return _fast_two_sum(guess, 0.5 * guess * rest[0])


def cholesky(high, low):
    """Upper triangular R, RᵀR = G, of a positive semidefinite matrix of pairs.

    A row of zeros stands where a diagonal entry is but the rounding of 106 bits. G is
    high + low, of which the upper triangle is read. R is rounded to double: it is as
    good as the factor by orthogonal transformations.

    Examples
    --------
    >>> G = np.array([[1.0, 1.0], [1.0, 1.0]])
    >>> cholesky(G, np.diag([0.0, 2.0**-80])).tolist()
    [[1.0, 1.0], [0.0, 9.094947017729282e-13]]
    """
    n = len(high)
    exponent = np.frexp(np.sqrt(np.maximum(np.diagonal(high), 0.0)))[1]
    exponent = np.where(np.diagonal(high) > 0.0, exponent, 0)
    high, low = (np.ldexp(np.ldexp(half, -exponent), -exponent[:, None]) for half in (high, low))
    R = np.zeros((n, n))
    parts = np.zeros((PAIR_SLICES, n, n))  # of the rows found, [slice, row, column]
    for j in range(n):
        row = add(high[j, j:], low[j, j:], *_minus_products(parts, j))
        if row[0][0] <= RANK_TOLERANCE * high[j, j]:
            continue
        row = _times(*row, *_inverse_root(row[0][0], row[1][0]))
        R[j, j:] = row[0]
        parts[:, j, j:] = _pair_slices(*row)
    return np.ldexp(R, exponent)


def _pair_slices(high, low):
    """Slices of pairs: those of the upper half, then what is left, with the lower."""
    upper = slices(high, N_SLICES)
    rest, last = two_sum(high - upper.sum(axis=0), low)
    bits = N_SLICES * SLICE_BITS
    lower = slices(np.ldexp(rest, bits), N_SLICES)
    lower[-1] += np.rint(np.ldexp(last, 2 * bits)) * 2.0**-bits
    return np.concatenate([upper, np.ldexp(lower, -bits)])


def _minus_products(parts, j):
    """−Σ_t R[t, j] R[t, j:] over the rows t < j, as a pair.

    One product gives the sums of all orders s: row s of the left side holds, beside
    slice r of R[t, j:], slice s − r of R[t, j].
    """
    q, n = PAIR_SLICES, parts.shape[1]
    if j == 0:
        return 0.0, 0.0
    left = np.zeros((q, q, j))
    for order in range(q):
        left[order, : order + 1] = parts[order::-1, :j, j]
    sums = np.zeros((q, n - j))
    for r in range(q):
        sums[r:] -= left[r:, r] @ parts[r, :j, j:]
    high, low = sums[0], np.zeros(n - j)
    for order in sums[1:]:
        high, low = add(high, low, order)
    return high, low
