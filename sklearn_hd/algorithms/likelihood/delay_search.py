"""Time delays as parameters: the sample that each of them lies in, and where in it.

A likelihood is smooth in a delay within one sample, and across its ends: there the input that was
new is the old one of the next. So a search is bounded to the samples in which the delays lie, its
cells, and where it ends at a bound it goes on from there in the next cells. The first ones come
from :func:`first_answers`: outputs by their own past and by inputs not younger than d,

    y[k] = Σ_{s=1…p} a_s(ψ_k) y[k−s] + Σ_{s=d…d_max} b_s(ψ_k) u[k−s] + c(ψ_k) + e[k],

with the d of least Bayesian criterion; the inputs of all larger lags are the leading columns of
one triangular factor, so that every d is read from the same one.

References: G. Schwarz (1978), Annals of Statistics 6(2), 461-464; L. Ljung, *System
Identification*, 1999, section 14.4 and page 510 (orders and delays of ARX models).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.likelihood.forms import Fractions
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EXACT, PRECISION
from sklearn_hd.algorithms.linalg.triangular import column_sizes
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, times
from sklearn_hd.algorithms.signals.resampling import first_lag

SHALLOW = 0.03  # of the range of costs, by which what is tried may be above the least
LAGS_BEHIND = 4  # of an input, after the largest delay tried
ROWS_PER_COLUMN = 4  # at least, of the regression


@dataclass(frozen=True, eq=False)
class Cells:
    """Whole samples of delays, and the rest of them."""

    input_lags: np.ndarray  # int, (m,): k_i: an input is late by k_i + f_i samples
    output_lags: np.ndarray  # int, (l,): d_j: an output is read d_j − g_j samples late
    fractions: Fractions

    @classmethod
    def of(cls, samples, n_inputs, free=False):
        """Of some delays in samples, inputs first; ``free`` says which are parameters."""
        samples = np.asarray(samples, dtype=float)
        free = np.broadcast_to(np.asarray(free, dtype=bool), samples.shape)
        k, f = first_lag(samples[:n_inputs])
        whole, rest = first_lag(samples[n_inputs:])
        d = whole + ((rest > 0.0) | (free[n_inputs:] & (whole == 0)))
        e = samples[n_inputs:] - (d - 1)
        return cls(k, d, Fractions(f, e, np.flatnonzero(free)))

    @property
    def lags(self):
        """Whole samples, of outputs one less than they are advanced by."""
        return np.concatenate([self.input_lags, self.output_lags - 1])

    @property
    def samples(self):
        """The delays."""
        return self.lags + self.fractions.whole

    def at(self, values):
        """The same cells with other values of the parameters."""
        return replace(self, fractions=self.fractions.at(values))

    def with_constant(self):
        """With one more input, last, that is constant."""
        f = self.fractions
        free = f.free + (f.free >= len(f.inputs))
        fractions = Fractions(np.append(f.inputs, 0.0), f.outputs, free)
        return replace(self, input_lags=np.append(self.input_lags, 0), fractions=fractions)

    def beyond(self):
        """Cells beyond the bounds at which parameters are: all at once, then one after another."""
        free, values = self.fractions.free, self.fractions.start
        step = np.where(values >= 1.0 - PRECISION, 1, 0)
        step = np.where((values <= PRECISION) & (self.lags[free] > 0), -1, step)
        single = [np.where(np.arange(len(step)) == k, step, 0) for k in np.flatnonzero(step)]
        return [self._moved(each) for each in ([step] if len(single) > 1 else []) + single]

    def _moved(self, step):
        """The cells some steps on, free delays where they are."""
        free, m = self.fractions.free, len(self.input_lags)
        whole, lags = self.fractions.whole, self.lags
        lags[free] += step
        whole[free] = np.where(step == 0, whole[free], step < 0)
        return Cells(lags[:m], lags[m:] + 1, Fractions(whole[:m], whole[m:], free))


def scanned(samples, free, most, cost):
    """Whole samples of the delays at which a cost has minima, one delay after another.

    Where an input acts by a cosine of the azimuth, it does so in two phases alike, and there are
    two of them, or one between them that is shallow: its ends, too, are to be tried.

    ``samples`` (k,) are the delays to start from. ``free`` has the places of those that
    are looked for, and ``most`` is the largest one tried. ``cost(samples)`` takes all
    delays. It returns five arrays of all delays at most, that of least cost first.

    Examples
    --------
    >>> scanned(np.array([0.0, 2.0]), np.array([0]), 30, lambda s: min(abs(s[0] - [17.0, 4.0])))
    [array([4., 2.]), array([17.,  2.])]
    """
    best, known = np.array(samples, dtype=float), {}

    def at(place, value):
        trial = np.where(np.arange(len(best)) == place, value, best)
        if tuple(trial) not in known:
            known[tuple(trial)] = cost(trial), trial
        return known[tuple(trial)]

    def least_of(pairs):
        return min(pairs, key=lambda pair: pair[0])

    least, step = at(0, best[0])[0], max(1, most // 16)  # 16 places for a start
    places = np.arange(0, most + 1, step)
    for _ in range(2):  # through all delays
        before = least
        for place in free:
            least, best = least_of([(least, best), *(at(place, value) for value in places)])
            finer = step
            while finer > 1:
                finer //= 2
                sides = [best[place] - finer, best[place] + finer]
                tried = [at(place, value) for value in sides if 0 <= value <= most]
                least, best = least_of([(least, best), *tried])
        if least >= before:
            break
    minima, highest = [(least, best)], max(pair[0] for pair in known.values() if pair[0] < np.inf)
    for place in free:
        profile = [at(place, value) for value in places]
        costs = np.pad([pair[0] for pair in profile], 1, constant_values=np.inf)
        lower = (costs[1:-1] < costs[:-2]) & (costs[1:-1] <= costs[2:])
        shallow = costs[1:-1] - least <= SHALLOW * (highest - least)
        ends = np.isin(places, places[shallow][[0, -1]]) if shallow.any() else shallow
        some = np.flatnonzero(shallow & (lower | ends))
        minima += [profile[k] for k in some if abs(places[k] - best[place]) > step]
    return [pair[1] for pair in sorted(minima, key=lambda pair: pair[0])[:5]]  # to start from


def through_cells(cells, fit):
    """The most likely fit whose delays lie in their cells, from some cells to those beside them.

    It comes with its cells.

    ``fit(cells, before)`` searches within some cells, from where the best fit before
    ended (None at first). It gives that fit, cells at its values, and its cost a value.
    """
    seen, ahead, best = set(), [cells], (None, cells, np.inf)
    while ahead and len(seen) < 60:  # cells: a search goes through no more
        cells = ahead.pop(0)
        if tuple(cells.lags) in seen:
            continue
        seen.add(tuple(cells.lags))
        found = fit(cells, best[0])
        if found[2] < best[2]:
            best, ahead = found, found[1].beyond()
    return best[:2]


def most_likely(cells, most, cost, alike, search):
    """The most likely fit, from all minima of a scan, and its cells.

    The search starts in ``cells`` if no delay is a parameter. Else delays are scanned
    up to ``most`` samples by ``cost(cells)``, that of a model of which little is
    fitted. ``alike`` and ``search`` are as ``fit`` of :func:`through_cells`. The first
    begins at the start and weighs outputs alike: one that is met before the others
    would hold the delays where they are. The second goes on from there.
    """
    free, starts = cells.fractions.free, [cells]
    if len(free):
        m, which = len(cells.input_lags), np.isin(np.arange(len(cells.samples)), free)
        minima = scanned(
            cells.samples, free, most, lambda samples: cost(Cells.of(samples, m, which))
        )
        starts = [Cells.of(samples, m, which) for samples in minima]
    found = [through_cells(start, alike) for start in starts]
    first, cells = min(found, key=lambda pair: pair[0].result.own_cost)
    return through_cells(cells, lambda cells, before: search(cells, before or first))


def first_answers(segments, most, n_own, n_harmonics=0):
    """Samples after which each output first answers to each input.

    ``segments`` have inputs (n_samples, m), outputs (n_samples, l) and psi
    (n_samples,). Inputs take part up to LAGS_BEHIND lags beyond ``most``, the largest
    delay looked for. ``n_own`` is p, lags of the output's own past; a short record has
    fewer. Coefficients have ``n_harmonics`` harmonics over ψ. The result (l, m) is NaN
    where an output answers to none of the lags tried, or the record is too short to
    tell.

    Examples
    --------
    >>> u = np.random.default_rng(0).standard_normal((300, 1))
    >>> y = np.zeros((300, 1))
    >>> for k in range(4, 300):
    ...     y[k] = 0.8 * y[k - 1] + u[k - 4]
    >>> first_answers([(u, y, np.zeros(300))], 10, 5)
    array([[4.]])
    """
    m, n_outputs = segments[0][0].shape[1], segments[0][1].shape[1]
    q, n_rows = 2 * n_harmonics + 1, sum(len(u) for u, _, _ in segments)
    last = most + LAGS_BEHIND
    n_own = max(2, min(n_own, n_rows // (ROWS_PER_COLUMN * q) - m * (last + 1) - 1))
    found = np.full((n_outputs, m), np.nan)
    for j in range(n_outputs):
        blocks = [_columns(u, y[:, j], psi, n_own, last, n_harmonics) for u, y, psi in segments]
        parts = [np.vstack(each) for each in zip(*blocks, strict=True)]
        if len(parts[0]) <= n_own * q + m * (last + 1) * q:
            continue
        for i in range(m):
            found[j, i] = _first_answer(*parts, i, q, last)
    return found


def _columns(u, y, psi, n_own, last, n_harmonics):
    """Own past and the mean, each input's lags from the last to 0, and the output."""
    rows = np.arange(max(n_own, last), len(y))
    functions = harmonic_functions(psi[rows], range(n_harmonics + 1))
    own = np.column_stack([y[rows - s] for s in range(1, n_own + 1)])
    late = (np.column_stack([v[rows - s] for s in range(last, -1, -1)]) for v in u.T)
    inputs = np.hstack([times(each, functions) for each in late])
    return np.hstack([times(own, functions), functions]), inputs, y[rows][:, None]


def _first_answer(own, inputs, target, i, q, last):
    """The lag of one input from which on the others are worth their number."""
    width = (last + 1) * q
    mine = slice(i * width, (i + 1) * width)
    others = np.delete(inputs, np.arange(mine.start, mine.stop), axis=1)
    X = np.hstack([own, others, inputs[:, mine]])
    X = X / column_sizes(X)
    first, n_rows = X.shape[1] - width, len(X)
    Q, R, kept = np.zeros((n_rows, 0)), target.astype(float), 0
    total = float(np.sum((target - target.mean()) ** 2))
    if not total > 0.0:
        return np.nan
    criteria = []
    for lag in range(last + 1, -1, -1):  # none of them, then the last, then those before
        columns = X[:, :first] if lag == last + 1 else X[:, first : first + q]
        if lag <= last:
            first += q
        for _ in range(2):
            columns = columns - Q @ (Q.T @ columns)
        left, singular, _ = linalg.svd(columns, full_matrices=False)
        new = left[:, singular > np.sqrt(DEPENDENT)]
        Q, kept = np.hstack([Q, new]), kept + new.shape[1]
        R = R - new @ (new.T @ R)
        rest = max(float(np.sum(R**2)), EXACT**2 * total) / n_rows
        criteria.append(n_rows * np.log(rest) + kept * np.log(n_rows))
    best = int(np.argmin(criteria))
    return np.nan if best == 0 else float(last + 1 - best)
