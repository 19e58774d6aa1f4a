"""The order of a model: by a gap of the singular values, or by simulation residuals.

Singular values show the order of exact data by a gap of decades. Measured data with noise, gusts
and nonlinearity have no gap: there models of rising order are simulated over the record, and
compared by the Bayesian information criterion of their residuals (Schwarz, 1978),

    BIC(n) = N Σ_j log(Σ_k e_j[k]² / N) + p log N,   e = y − ŷ

with p = n (m + l) + l m free entries; each initial state costs n times the logarithm of its own
segment's rows. Among models whose residuals agree to a hundredth, the smallest is taken. Each
output counts by its own residual, whatever its unit, also where outputs are sums of others. The
criterion asks nothing of how states were found: one rule serves all weightings. Plain data need it
(:mod:`sklearn_hd._identify.plain`); :mod:`~sklearn_hd.algorithms.periodic.multipliers` has the
like for Poincaré maps.
"""

from dataclasses import dataclass

import numpy as np

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS
from sklearn_hd.algorithms.lti.simulation import GROWN, growth, simulate
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices, pieces_of

GAP_REACH = np.sqrt(10.0)  # above the floor: where the lower side of a gap may lie
CLEAR_GAP = 2.0  # below which ratios scatter by noise
WIDE_GAP = 1e3  # that decides by itself
MATERIAL = 1.01  # ratio of variances left, from which on a smaller model is worse
PATIENCE = 8  # orders that may pass without a better one: four pairs of modes
UNSTABLE_GAIN = 2.0  # by which an unstable model must lower variances, beyond what its order does


def order_by_gap(singular_values, floor, max_order):
    """Order at the gap by which singular values stand above a floor.

    Of the ratios σ_n / max(σ_{n+1}, floor) the widest decides, if it spans
    three decades. A lesser gap far above the floor parts strong modes from
    weak ones, not modes from noise: then only ratios count whose lower side
    is within half a decade of the floor. Where the widest of these is less
    than a factor of two there is no gap, and all values above the floor count.

    Singular values descend, and ``floor`` is the size of those that rounding or noise
    alone would give. The order is at least 1.

    Examples
    --------
    >>> order_by_gap(np.array([9.0, 5.0, 2.0, 1e-15, 5e-16]), floor=1e-14, max_order=4)
    3
    """
    order = order_by_wide_gap(singular_values, floor, max_order)
    if order is not None:
        return order
    values = np.maximum(singular_values, floor)
    ratios = (values[:-1] / values[1:])[:max_order]
    near = np.where(values[1:][:max_order] <= GAP_REACH * floor, ratios, 0.0)
    if np.max(near, initial=0.0) >= CLEAR_GAP:
        return int(np.argmax(near)) + 1
    return int(np.clip(np.sum(singular_values > floor), 1, max_order))


def order_by_wide_gap(singular_values, floor, max_order):
    """Order at a gap of three decades or more, the widest; None if there is none."""
    values = np.maximum(singular_values, floor)
    ratios = (values[:-1] / values[1:])[:max_order]
    return int(np.argmax(ratios)) + 1 if np.max(ratios, initial=0.0) >= WIDE_GAP else None


@dataclass(frozen=True)
class Simulated:
    """What the simulation of a model leaves of a record."""

    order: int
    feedthrough: bool  # whether D is free
    stable: bool  # whether no mode grows e-fold over the longest segment
    share: float  # of the outputs, root mean square, that is left
    variance: float  # geometric mean of the shares of the outputs' variances that are left
    bic: float
    n_harmonics: int = 0  # of the coefficients of a periodic model


class Comparison:
    """Models of rising order, with D free or zero, simulated over a record.

    ``model(order, feedthrough)`` gives A, B, C, D and the initial state of each
    segment, or None for these. It gives None where its outputs would overflow.
    ``fed_back`` says whether feedback may have held the outputs of an unstable system:
    it is then simulated in pieces, each with an initial state of its own. In open loop
    outputs grow with it.
    """

    def __init__(self, model, inputs, outputs, fed_back=False):
        self.model, self.inputs, self.outputs = model, inputs, outputs
        self.fed_back = fed_back
        squares = sum(np.sum(y**2, axis=0) for y in outputs)
        self.size = np.sqrt(np.where(squares > 0.0, squares, 1.0))
        self._simulated = {}

    def order(self, most, feedthrough):
        """The order that leaves least, up to some; None if all leave more than there is."""
        tried = []
        for n in range(1, most + 1):
            tried.append(self.simulated(n, feedthrough))
            best = best_of(tried, sum(y.size for y in self.outputs))
            if best.order <= n - PATIENCE:
                break
        if best.variance >= 1.0:
            return None
        alike = (m.order for m in tried if m.stable >= best.stable and not differ(m, best))
        return min(alike)

    @property
    def tried(self):
        """All models simulated so far."""
        return tuple(self._simulated.values())

    def simulated(self, order, feedthrough):
        """What the model of some order leaves, with D free or zero: a :class:`Simulated`."""
        key = order, feedthrough
        if key not in self._simulated:
            self._simulated[key] = self._simulate(order, feedthrough)
        return self._simulated[key]

    def _simulate(self, order, feedthrough):
        model = self.model(order, feedthrough)
        if model is None:
            return Simulated(order, feedthrough, False, np.inf, np.inf, np.inf)
        A, B, C, D, starts = model
        (n, m), n_outputs = B.shape, len(C)
        lengths = [len(y) for y in self.outputs]
        pieces = [(s, slice(0, length)) for s, length in enumerate(lengths)]
        if self.fed_back:
            pieces = pieces_of(A, lengths)[0]
        if starts is None or growth(A) > 0.0:
            starts = [None] * len(pieces)
        C, D = C / self.size[:, None], D / self.size[:, None]
        records = [
            (self.inputs[s][rows], self.outputs[s][rows] / self.size, x0)
            for (s, rows), x0 in zip(pieces, starts, strict=True)
        ]
        with np.errstate(over="ignore", invalid="ignore"):
            shares = sum(np.sum(_left(A, B, C, D, *record) ** 2, axis=0) for record in records)
        if not np.all(np.isfinite(shares)):
            return Simulated(order, feedthrough, False, np.inf, np.inf, np.inf)
        logs = np.log(shares + EPS)  # of exact data rounding is left, which tells nothing
        n_rows = sum(lengths)
        n_free = n * (m + n_outputs) + feedthrough * m * n_outputs
        bic = n_rows * np.sum(logs) + n_free * np.log(n_rows)
        bic += n * sum(np.log(len(y)) for _, y, _ in records)
        share, variance = np.sqrt(np.mean(shares)), np.exp(np.mean(logs))
        stable = max(lengths) * growth(A) < GROWN
        return Simulated(order, feedthrough, stable, *map(float, (share, variance, bic)))


def best_of(tried, n_values):
    """The one of the least criterion; an unstable one only where it leaves far less.

    ``n_values`` is the number of rows times outputs that were simulated.
    """
    best = min(tried, key=lambda each: each.bic)
    stable = min((each for each in tried if each.stable), key=lambda each: each.bic, default=best)
    return best if best.bic + n_values * np.log(UNSTABLE_GAIN) < stable.bic else stable


def differ(simpler, other):
    """Whether a simpler model leaves materially more than another.

    A and C are not those of least squares. Long records let a criterion see what further states,
    or D, mend of their error: parts in a thousand of what noise leaves.
    """
    return simpler.variance > MATERIAL * other.variance


def _left(A, B, C, D, u, y, x0):
    """What a simulation leaves of a piece, from the initial state that fits best or is given."""
    if x0 is not None:
        return y - simulate(A, B, C, D, u, x0)
    rest = y - simulate(A, B, C, D, u, np.zeros(len(A)))
    if not np.all(np.isfinite(rest)):
        return np.full_like(rest, np.inf)
    rows, rate = len(y), growth(A)
    if rate < 0.0:  # after some rows the initial state is forgotten
        rows = min(rows, int(len(A) + np.log(DEPENDENT) / rate) + 1)
    none = u[:rows, :0]
    x0 = input_matrices(A, C, [none], [rest[:rows]], False)[2][0]
    rest[:rows] -= simulate(A, B[:, :0], C, D[:, :0], none, x0)
    return rest
