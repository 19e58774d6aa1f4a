"""Exponential forgetting: rows of a record weighted by their age.

The row that is a rows older than the newest one has the weight

    w = 2^{−a/h} = μ^{−2a},    μ = 2^{1/(2h)},    h the half-life in rows

in every sum of squares. Sums of weighted rows are those of signals z̃_k = μ^k z_k, and x̃_k = μ^k x_k
follows a model of the same form,

    x̃[k+1] = μA x̃[k] + μB ũ[k],    ỹ[k] = C x̃[k] + D ũ[k]

so least squares for B, D and the initial state run unchanged, with μA for A. Block row a of a
Hankel matrix of z̃ is μ^a times that of z, its columns weighted. Divided by μ^a, its factor is that
of Z W Zᵀ, and A, C and the Kalman gain follow as ever. When rows arrive, all that was summed before
is multiplied by whole powers of two alone, which rounds nothing; so chunks of any size give the
same sums.

N weighted rows tell as much as (Σw)² / Σw² rows alike (Kish, 1965): with white noise the
variance of a weighted mean is σ² Σw² / (Σw)². No record has more than (1 + 2^{−1/h}) /
(1 − 2^{−1/h}) ≈ 2.9 h of them. ``MOESPRegressor.partial_fit`` needs this.
"""

from dataclasses import dataclass

import numpy as np

from sklearn_hd.algorithms.linalg.rounding import EPS


@dataclass(frozen=True)
class Forgetting:
    """Weights of consecutive rows.

    Attributes
    ----------
    half_life : float
        h, in rows; infinite forgets nothing.
    """

    half_life: float = np.inf

    @property
    def growth(self):
        """μ."""
        return 2.0 ** (0.5 / self.half_life)

    @property
    def most_rows(self):
        """Effective rows of a record without end."""
        return 1.0 / np.tanh(0.5 * np.log(2.0) / self.half_life)

    def weighted(self, rows, n_before):
        """Rows that follow ``n_before`` others, as z̃, and by what power of two these fade.

        Parameters
        ----------
        rows : ndarray, shape (n_rows, p)
        n_before : int

        Returns
        -------
        weighted : ndarray, shape (n_rows, p)
            In units in which the newest row weighs between a half and one.
        shift : int

        Examples
        --------
        >>> rows, shift = Forgetting(half_life=1.0).weighted(np.ones((4, 1)), 0)
        >>> (rows.ravel() ** 2).round(12).tolist(), shift
        ([0.0625, 0.125, 0.25, 0.5], 2)
        """
        if self.half_life == np.inf:
            return rows, 0
        before, after = (self._power(n) for n in (n_before, n_before + len(rows)))
        exponents = (n_before + np.arange(len(rows))) / (2.0 * self.half_life) - after
        return rows * np.exp2(exponents)[:, None], after - before

    def _power(self, n_rows):
        return int(np.floor(n_rows / (2.0 * self.half_life)))

    def newest(self, n_rows):
        """What the newest of all rows is multiplied by in z̃."""
        if self.half_life == np.inf:
            return 1.0
        return np.exp2((n_rows - 1) / (2.0 * self.half_life) - self._power(n_rows))

    def weights(self, lengths, n_lost=0):
        """Σw over the rows of consecutive segments, but the last few of each.

        Parameters
        ----------
        lengths : sequence of int
            Rows of each, the newest last.
        n_lost : int, default=0
            Rows at the end of each that are left out.

        Returns
        -------
        weights : ndarray, shape (n_segments,)
        """
        lengths = np.asarray(lengths, dtype=float)
        ages = np.cumsum(lengths[::-1])[::-1] - lengths  # of the last row of each
        counts = np.maximum(lengths - n_lost, 0.0)
        if self.half_life == np.inf:
            return counts
        rate = np.log(2.0) / self.half_life
        newest = np.exp(-rate * (ages + n_lost))
        return newest * np.expm1(-rate * counts) / np.expm1(-rate)

    def n_effective(self, lengths):
        """(Σw)² / Σw² over all rows.

        Examples
        --------
        >>> [round(float(Forgetting(h).n_effective([30, 70])), 1) for h in (10.0, np.inf)]
        [28.8, 100.0]
        """
        squared = Forgetting(0.5 * self.half_life)  # of half the half-life: w²
        return np.sum(self.weights(lengths)) ** 2 / np.sum(squared.weights(lengths))

    def effective_lengths(self, lengths):
        """Rows alike that segments are worth, by their shares of Σw.

        Returns
        -------
        lengths : list of int
        """
        if self.half_life == np.inf:
            return list(lengths)
        own = self.weights(lengths)
        return [round(each) for each in own * self.n_effective(lengths) / np.sum(own)]

    def first(self, lengths):
        """What the first row of each segment is multiplied by in z̃; NaN where rounding hides it.

        Returns
        -------
        factors : ndarray, shape (n_segments,)
        """
        lengths = np.asarray(lengths, dtype=float)
        ages = np.cumsum(lengths[::-1])[::-1] - 1.0
        factors = np.exp2(-ages / (2.0 * self.half_life))
        return np.where(factors < EPS, np.nan, factors) * self.newest(int(np.sum(lengths)))
