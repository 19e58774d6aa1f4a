"""The predictor of a periodic machine, and the states behind it, from samples at any azimuth.

In sample k, at azimuth ψ_k, with all coefficients Fourier series in ψ, a machine in service is

    x[k+1] = A(ψ_k) x + B(ψ_k) u + K(ψ_k) e + a(ψ_k),    y[k] = C(ψ_k) x + D(ψ_k) u + c(ψ_k) + e[k]

where a and c drive the forced periodic response: trim, loads at n per turn. Seen from the outputs
it forgets its state, and

    y[k] = Σ_{s=1…p} Φ_s(ψ_k) z[k−s] + D(ψ_k) u[k] + c̄(ψ_k) + e[k],   z = [u; y]

is one linear regression, for each Φ_s is a product of periodic matrices, and periodic itself. What
of the next f outputs, f ≤ p, is known from data before k alone is

    O_k = (Σ_{s>j} Φ_s(ψ_{k+j}) z[k+j−s])_{j=0…f−1} = Γ(ψ_k) x_k

and x_k = VᵀO_k is the state in coordinates T(ψ) = VᵀΓ(ψ), V the first n vectors of one singular
value decomposition over all k. Γ has rows C (A − K C) … (A − K C): slow modes and fast ones are
forgotten alike. With each prediction as an output for those after it, rows are C A … A, in which
slow modes stand out. Where Γ turns so far with ψ that T is singular at some azimuth, this
takes more states than the machine has, and modes of a model that no input moves; without these
V turns, too. Each output of O_k is measured in its innovations, or a large channel decides all; and
its periodic mean is taken out first, or V spans the orbit instead of the motion about it.

Exact data leave the coefficients of a long predictor open, and what nonlinearity leaves of the
outputs would decide. So lagged outputs are taken to hold white noise of 0.3 % of their motion: the
regression then tends to the Kalman predictor for that noise.

Two more regressions give C, and A, B, K, a. Sums of products over rows are all that is kept: any
number of lags, and of harmonics, is read from the same sums. The reading of samples
(:mod:`sklearn_hd._identify.sample`) needs it.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EPS, EXACT, HALF
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.signals.fourier import AT_ONCE, fitted_harmonics, harmonic_functions

SENSOR_NOISE = 3e-3  # of an output's motion, which lagged outputs are taken to hold at least
MOVED = 1e-4  # rad, by which azimuths are moved to see what that changes
RIDGES = np.concatenate([[0.0], 10.0 ** np.arange(-12.0, 0.5, 0.5)])  # of the largest eigenvalue


@dataclass(frozen=True)
class Layout:
    """Columns of the regression: lags, inputs of the same row, forced response."""

    n_inputs: int
    n_outputs: int
    n_lags: int  # p
    n_harmonics: int  # highest harmonic of what multiplies outputs
    n_input_harmonics: int  # the same of what multiplies inputs
    n_loads: int  # highest harmonic of c̄
    feedthrough: bool

    @property
    def n_functions(self):
        """Functions 1, cos ψ, sin ψ, … of the largest number of harmonics."""
        return 2 * max(self.n_harmonics, self.n_input_harmonics) + 1

    @property
    def n_first(self):
        """Columns before those of the lags."""
        direct = self.n_inputs * (2 * self.n_input_harmonics + 1) if self.feedthrough else 0
        return 2 * self.n_loads + 1 + direct

    @property
    def per_lag(self):
        """Columns of one lag."""
        own = self.n_outputs * (2 * self.n_harmonics + 1)
        return self.n_inputs * (2 * self.n_input_harmonics + 1) + own

    @property
    def n_columns(self):
        """All columns."""
        return self.n_first + self.n_lags * self.per_lag

    def _of_channels(self):
        """Channel and function of each column of one lag."""
        counts = [2 * self.n_input_harmonics + 1] * self.n_inputs
        counts += [2 * self.n_harmonics + 1] * self.n_outputs
        channels = np.repeat(np.arange(len(counts)), counts)
        functions = np.concatenate([np.arange(count) for count in counts])
        return channels, functions

    def places_in(self, larger):
        """Where the columns of this layout stand among those of a larger one."""
        loads = np.arange(2 * self.n_loads + 1)
        own, theirs = self._of_channels(), larger._of_channels()
        place = {pair: k for k, pair in enumerate(zip(*theirs, strict=True))}
        one = np.array([place[pair] for pair in zip(*own, strict=True)], dtype=int)
        direct = one[own[0] < self.n_inputs] if self.feedthrough else one[:0]
        lags = larger.n_first + larger.per_lag * np.arange(self.n_lags)[:, None] + one
        return np.concatenate([loads, 2 * larger.n_loads + 1 + direct, lags.ravel()])

    def design(self, inputs, outputs, psi, rows):
        """Regressors of some rows of one segment, shape (n_rows, n_columns)."""
        functions = harmonic_functions(
            psi[rows], range(max(self.n_loads, (self.n_functions - 1) // 2) + 1)
        )
        channels, which = self._of_channels()
        X = np.empty((len(rows), self.n_columns))
        width = 2 * self.n_loads + 1
        X[:, :width] = functions[:, :width]
        z = np.hstack([inputs, outputs])
        if self.feedthrough:
            own = channels < self.n_inputs
            X[:, width : self.n_first] = z[rows][:, channels[own]] * functions[:, which[own]]
        factors = functions[:, which]
        for s in range(1, self.n_lags + 1):
            start = self.n_first + (s - 1) * self.per_lag
            X[:, start : start + self.per_lag] = z[rows - s][:, channels] * factors
        return X

    def split(self, coefficients):
        """c̄, D and Φ by function: (2 L + 1, l), (q, m, l), (p, q, m + l, l)."""
        channels, which = self._of_channels()
        width, m = 2 * self.n_loads + 1, self.n_inputs
        n_outputs = coefficients.shape[1]
        D = np.zeros((self.n_functions, m, n_outputs))
        own = channels < m
        if self.feedthrough:
            D[which[own], channels[own]] = coefficients[width : self.n_first]
        lags = np.zeros((self.n_lags, self.n_functions, m + self.n_outputs, n_outputs))
        lags[:, which, channels] = coefficients[self.n_first :].reshape(
            self.n_lags, self.per_lag, n_outputs
        )
        return coefficients[:width], D, lags


def forced_mean(segments, n_harmonics):
    """Fourier coefficients (2 H + 1, …) of the periodic means of inputs and outputs.

    By least squares over all rows of the segments (inputs, outputs, psi).
    """
    found = fitted_harmonics([(np.hstack([u, y]), psi) for u, y, psi in segments], n_harmonics)
    return np.split(found, [segments[0][0].shape[1]], axis=1)


def spread_rows(lengths, most, n_places=8):
    """Rows (segment, slice) to look at: all, or pieces that lie evenly over a long record.

    A long record may begin at rest. All pieces together have at most ``most`` rows.
    """
    ends = np.cumsum(lengths)
    if ends[-1] <= most:
        return [(s, slice(0, n)) for s, n in enumerate(lengths)]
    length = most // n_places
    starts = np.linspace(0, ends[-1] - length, n_places).astype(int)
    found = []
    for s, n in enumerate(lengths):
        for start in starts - (ends[s] - n):
            rows = slice(max(0, start), min(start + length, n))
            found += [(s, rows)] if rows.stop > rows.start else []
    return found


@dataclass(frozen=True, eq=False)
class LagSums:
    """Sums of squares and products of one regression, from which smaller ones are read."""

    layout: Layout
    gram: np.ndarray  # (d, d)
    products: np.ndarray  # (d, l)
    squares: np.ndarray  # (l, l)
    n_rows: int

    @classmethod
    def of(cls, segments, layout):
        """Sums over the rows of some segments that have p rows before them."""
        d, n_outputs = layout.n_columns, layout.n_outputs
        gram, products = np.zeros((d, d)), np.zeros((d, n_outputs))
        squares, n_rows, first = np.zeros((n_outputs, n_outputs)), 0, np.zeros(layout.n_first)
        for u, y, psi in segments:
            for rows in _chunks(layout.n_lags, len(y), d):
                X = layout.design(u, y, psi, rows)
                gram += X.T @ X
                products += X.T @ y[rows]
                squares += y[rows].T @ y[rows]
                n_rows += len(rows)
        measured = np.tile(layout._of_channels()[0] >= layout.n_inputs, layout.n_lags)
        gram[np.diag_indices(d)] += SENSOR_NOISE**2 * n_rows * np.append(first, measured)
        return cls(layout, gram, products, squares, n_rows)

    def part(self, layout):
        """The sums of a smaller layout."""
        if layout == self.layout:
            return self
        own = layout.places_in(self.layout)
        gram, products = self.gram[np.ix_(own, own)], self.products[own]
        return LagSums(layout, gram, products, self.squares, self.n_rows)

    def criteria(self, least_lags):
        """Akaike's criterion of each number of lags from some on, and the same of Schwarz."""
        scaled, products, _ = self._scaled()
        scaled[np.diag_indices(len(scaled))] += EXACT * len(scaled)
        upper = linalg.cholesky(scaled)
        taken = linalg.solve_triangular(upper, products, trans="T")
        layout, n = self.layout, self.n_rows
        information, counts = [], []
        for p in range(least_lags, layout.n_lags + 1):
            d = layout.n_first + p * layout.per_lag
            left = self.squares - taken[:d].T @ taken[:d]
            information.append(n * _log_volume(left / n, self.squares / n))
            counts.append(d * layout.n_outputs)
        information, counts = np.array(information), np.array(counts)
        return information + 2.0 * counts, information + np.log(n) * counts

    def tells_feedthrough(self):
        """Whether these rows tell a feedthrough as large as outputs are beside inputs.

        Not if what earlier rows leave of an input is so little that what it explains of an output
        is not worth its coefficients.
        """
        layout, m = self.layout, self.layout.n_inputs
        gram, products, _ = self._scaled()
        gram[np.diag_indices(len(gram))] += EXACT * len(gram)
        width = 2 * layout.n_input_harmonics + 1
        direct = slice(2 * layout.n_loads + 1, layout.n_first, width)
        others = np.delete(np.arange(len(gram)), np.s_[direct.start : direct.stop])
        upper = linalg.cholesky(gram[np.ix_(others, others)])
        now = np.hstack([gram[:, direct], products])[others]
        known = np.sum(linalg.solve_triangular(upper, now, trans="T") ** 2, axis=0)
        total = np.append(np.ones(m), np.diag(self.squares))
        left = np.maximum(total - known, EXACT * total) / np.where(total > 0.0, total, 1.0)
        share, noise = left[:m].min(initial=1.0), left[m:][total[m:] > 0.0].min()
        return bool(self.n_rows * np.log1p(share / noise) > width * np.log(self.n_rows))

    def _scaled(self):
        """The Gram matrix and the products by columns of one size, and that size."""
        size = np.sqrt(np.maximum(np.diag(self.gram), EPS * np.max(np.diag(self.gram))))
        return self.gram / size / size[:, None], self.products / size[:, None], size

    def predictor(self):
        """The regression with the ridge of least generalised cross-validation."""
        scaled, products, size = self._scaled()
        values, vectors = linalg.eigh(scaled)
        values = np.maximum(values, 0.0)
        along = vectors.T @ products
        kept = values > EXACT * values[-1]
        total, best = np.diag(self.squares), None
        moves = total > 0.0
        for ridge in RIDGES * values[-1]:
            shrunk = np.where(kept, 1.0, 0.0) / np.where(kept, values + ridge, 1.0)
            found = shrunk[:, None] * along
            left = total - 2.0 * np.sum(found * along, axis=0) + values @ found**2
            left = np.maximum(left, EXACT * total)[moves]
            spent = np.sum(values * shrunk) / self.n_rows
            score = np.sum(np.log(left)) - 2.0 * len(left) * np.log(max(1.0 - spent, EPS))
            if best is None or score < best[0]:
                best = score, found
        _, found = best
        coefficients = vectors @ found / size[:, None]
        crossed = coefficients.T @ self.products
        left = self.squares - crossed - crossed.T + coefficients.T @ self.gram @ coefficients
        loads, D, lags = self.layout.split(coefficients)
        of_lags = lags[:, :, self.layout.n_inputs :].reshape(-1, len(left))
        covariance = left / self.n_rows
        as_measured = np.diag(covariance) - SENSOR_NOISE**2 * np.sum(of_lags**2, axis=0)
        return Predictor(self.layout, coefficients, loads, D, lags, covariance, as_measured)


@dataclass(frozen=True, eq=False)
class Predictor:
    """Coefficients of the regression, by function 1, cos ψ, sin ψ, …."""

    layout: Layout
    coefficients: np.ndarray  # (d, l): of all regressors; the others are parts of it
    loads: np.ndarray  # (2 L + 1, l)
    D: np.ndarray  # (q, m, l)
    lags: np.ndarray  # (p, q, m + l, l)
    # (l, l): of what the regression leaves, if lagged outputs have SENSOR_NOISE
    covariance: np.ndarray
    # (l,): variance that it leaves of the outputs as measured; not below zero but for rounding
    left: np.ndarray


def azimuth_drift(segments, means, predictor):
    """By how much, relative to itself, the azimuth of some rows seems to run too slowly.

    The score test (C. R. Rao, Proc. Cambridge Philosophical Society 44, 1948, 50-57) of δ in
    ψ + δ (ψ − ψ̄): what the predictor leaves of the outputs, regressed on what that would change of
    its predictions, to first order. Segments (inputs, outputs, psi) are about their periodic means,
    whose Fourier coefficients are ``means``. Returned are δ, the same in standard errors, and the
    number of rows.
    """
    layout, middle = predictor.layout, np.mean(np.concatenate([psi for *_, psi in segments]))
    slope = information = n_rows = 0.0
    for u, y, psi in segments:
        for rows in _chunks(layout.n_lags, len(y), layout.n_columns):
            around = np.arange(rows[0] - layout.n_lags, rows[-1] + 1)
            own = np.arange(layout.n_lags, len(around))
            left = []
            for moved in (0.0, MOVED):
                at = psi[around] + moved
                back = [
                    evaluate_harmonics(m, psi[around]) - evaluate_harmonics(m, at) for m in means
                ]
                X = layout.design(u[around] + back[0], y[around] + back[1], at, own)
                left.append((y[around] + back[1])[own] - X @ predictor.coefficients)
            change = (left[0] - left[1]) / MOVED * (psi[rows] - middle)[:, None]
            white = np.maximum(np.diag(predictor.covariance), EXACT)
            slope += np.sum(change * left[0] / white)
            information += np.sum(change**2 / white)
            n_rows += len(rows)
    if information == 0.0:
        return 0.0, 0.0, int(n_rows)
    return slope / information, slope / np.sqrt(information), int(n_rows)


def futures_known(segment, predictor, n_future):
    """The row of the first, and O_k (n_rows, f l) of those with p rows before and f − 1 after them.

    Row k = n_s too, the one that follows the segment (inputs, outputs, psi), where f is 1. It is
    p at most. A second O_k has each prediction as an output for those after it.
    """
    u, y, psi = segment
    layout, p, f = predictor.layout, predictor.layout.n_lags, n_future
    z = np.hstack([u, y])
    n_rows, n_outputs = len(y) - p - f + 1, y.shape[1]
    if n_rows < 1:
        return p, *np.zeros((2, 0, f * n_outputs))
    known, free = np.zeros((2, n_rows, f, n_outputs))
    orders = range((layout.n_functions - 1) // 2 + 1)
    by_lag = predictor.lags.transpose(0, 2, 1, 3)  # (p, w, q, l)

    def answer(values, lags, functions):
        lags = lags.reshape(-1, layout.n_functions * n_outputs)
        by_function = values.reshape(len(values), len(lags)) @ lags
        by_function = by_function.reshape(len(values), layout.n_functions, n_outputs)
        return np.einsum("kql,kq->kl", by_function, functions)

    at_once = AT_ONCE // (p * z.shape[1] * f + 1) + 1
    for start in range(0, n_rows, at_once):
        own = np.arange(start, min(n_rows, start + at_once))
        past = np.stack([z[own + p - r] for r in range(1, p + 1)], axis=1)  # (k, p, w)
        for j in range(f):
            functions = harmonic_functions(psi[own + p + j], orders)
            ahead = free[own, :j][:, ::-1]  # s = 1 … j: (k, j, l)
            known[own, j] = answer(past[:, : p - j], by_lag[j:], functions)
            later = answer(ahead, by_lag[:j, layout.n_inputs :], functions)
            free[own, j] = known[own, j] + later
    return p, known.reshape(n_rows, -1), free.reshape(n_rows, -1)


@dataclass(frozen=True, eq=False)
class States:
    """States of every row, in constant coordinates of two kinds.

    Of what is known of outputs to come, and of that with each prediction as an output for those
    after it, in which slow modes stand out. The first n of a kind are those of order n.
    """

    # of (first, x, e): of each segment: its first row with a state, states (n_rows, 2 bound), one
    # kind beside the other, and innovations (n_rows, l)
    parts: list
    singular_values: np.ndarray  # of the first kind
    bound: int  # the most states that there are of a kind
    # (2 bound, l): coordinates of what the predictor knows of a row's own outputs, the strongest
    # first
    of_outputs: np.ndarray

    @classmethod
    def of(cls, segments, predictor, bound, noise):
        """States that a predictor makes of segments (inputs, outputs, psi), so many of a kind.

        ``noise`` is the least noise of each output.
        """
        layout, n_outputs, f = predictor.layout, predictor.layout.n_outputs, predictor.layout.n_lags
        root = linalg.cholesky(with_noise(predictor.covariance, noise), lower=True)
        white = np.kron(np.eye(f), linalg.inv(root).T)
        firsts, *kinds = zip(*(futures_known(each, predictor, f) for each in segments), strict=True)
        values, vectors = zip(*(_strongest(kind, white) for kind in kinds), strict=True)
        parts = []
        for first, known, free, (u, y, psi) in zip(firsts, *kinds, segments, strict=True):
            rows = slice(first, first + len(known))
            e = y[rows] - known[:, :n_outputs] - evaluate_harmonics(predictor.loads, psi[rows])
            if layout.feedthrough:
                e -= np.einsum("til,ti->tl", evaluate_harmonics(predictor.D, psi[rows]), u[rows])
            both = zip((known, free), vectors, strict=True)
            states = np.hstack([ahead @ (white @ own[:, :bound]) for ahead, own in both])
            parts.append((first, states, e))
        sights = vectors[0][:n_outputs, :bound].T
        strongest = linalg.svd(values[0][:bound, None] * sights)[2]
        of_outputs = np.vstack([sights @ strongest.T, np.zeros_like(sights)])
        return cls(parts, values[0], bound, of_outputs)

    def known(self, order):
        """Coordinates of so many states of what is known of outputs to come."""
        return np.eye(2 * self.bound)[:, :order]

    def free(self, order):
        """The same with each prediction as an output for those after it."""
        return np.eye(2 * self.bound)[:, self.bound :][:, :order]

    def rows(self, segments, coordinates, where):
        """States, next states, inputs, outputs, innovations and azimuths, in some coordinates.

        These are Fourier coefficients (2 H + 1, 2 bound, n). ``where`` are the rows to
        take, as :func:`spread_rows` has them.
        """
        turning = len(coordinates) // 2 + 1
        for s, rows in where:
            first, states, e = self.parts[s]
            u, y, psi = segments[s]
            start, stop = max(rows.start, first), min(rows.stop, first + len(states) - 1)
            if stop > start:
                rows, own = slice(start, stop), slice(start - first, stop - first)
                functions = harmonic_functions(psi[start : stop + 1], range(turning))
                both = zip(functions.T, coordinates, strict=True)
                x = sum(f[:, None] * (states[own.start : own.stop + 1] @ V) for f, V in both)
                yield x[:-1], x[1:], u[rows], y[rows], e[own], psi[rows]


def with_noise(covariance, noise=SENSOR_NOISE):
    """A covariance of outputs with some noise added, that of a sensor by default."""
    return covariance + noise**2 * np.eye(len(covariance))


def _strongest(ahead, white):
    """Singular values and vectors of outputs to come, each measured in its noise."""
    gram = sum(white.T @ (each.T @ each) @ white for each in ahead)
    values, vectors = linalg.eigh(gram / sum(map(len, ahead)))
    return np.sqrt(np.maximum(values[::-1], 0.0)), vectors[:, ::-1]


@dataclass(frozen=True, eq=False)
class StateSums:
    """Sums of one regression of outputs and next states on states, inputs and innovations.

    Regressors, each with functions 1, cos ψ, …: the forced response, inputs, innovations, states.
    Those of few harmonics are part of them.
    """

    gram: np.ndarray  # (d, d): of all regressors
    outputs: np.ndarray  # (d, l): their products with what the outputs are without innovations
    following: np.ndarray  # (d, n): their products with the next states
    # int, (3, d): of each regressor: what it is (0 forced, 1 input, 2 innovation, 3 state), which,
    # and its function
    kinds: np.ndarray
    n_rows: int

    @classmethod
    def of(cls, rows, n_harmonics, n_loads):
        """Sums over rows of (states x, next states, inputs, outputs, innovations, azimuths)."""
        sums = kinds = None
        for x, following, u, y, e, psi in rows:
            if kinds is None:
                counts = (1, u.shape[1], y.shape[1], x.shape[1])
                kinds = _regressor_kinds(counts, n_harmonics, n_loads)
                d = kinds.shape[1]
                n, n_outputs = x.shape[1], y.shape[1]
                sums = [np.zeros((d, d)), np.zeros((d, n_outputs)), np.zeros((d, n)), 0]
            functions = harmonic_functions(psi, range(max(n_harmonics, n_loads) + 1))
            every = np.hstack([np.ones((len(x), 1)), u, e, x])
            column = np.cumsum([0, *counts])[kinds[0]] + kinds[1]
            for part in _chunks(0, len(x), d):
                X = every[part][:, column] * functions[part][:, kinds[2]]
                sums[0] += X.T @ X
                sums[1] += X.T @ y[part]
                sums[2] += X.T @ following[part]
            sums[3] += len(x)
        return cls(*sums[:3], kinds, sums[3])

    def matrices(self, n_harmonics, n_input_harmonics, n_loads, feedthrough):
        """Fourier coefficients of [A B a; C D c] and of K.

        Their number is that of the largest number of harmonics.
        """
        kind, which, function = self.kinds
        most = np.array([n_loads, n_input_harmonics, n_harmonics, n_harmonics])
        used = function <= 2 * most[kind]
        m = int(which[kind == 1].max(initial=-1)) + 1
        order, n_outputs = self.following.shape[1], self.outputs.shape[1]
        H = int(max(most))
        seen = used & (kind != 2) & (feedthrough | (kind != 1))
        coefficients = np.zeros((2 * H + 1, order + n_outputs, order + m + 1))
        gain = np.zeros((2 * H + 1, order, n_outputs))
        column = np.choose(kind, [order + m, order + which, 0, which])
        moved = self._solved(used, self.following)
        read = self._solved(seen, self.outputs)
        for regressors, found, rows in (
            (used, moved, slice(0, order)),
            (seen, read, slice(order, None)),
        ):
            for i, value in zip(np.flatnonzero(regressors), found, strict=True):
                if kind[i] == 2:
                    gain[function[i], :, which[i]] = value
                else:
                    coefficients[function[i], rows, column[i]] = value
        return coefficients, gain

    def _solved(self, chosen, products):
        """Least squares on some regressors."""
        gram = self.gram[np.ix_(chosen, chosen)]
        size = np.sqrt(np.diag(gram))[:, None]
        size[size == 0.0] = 1.0
        return linalg.lstsq(gram / size / size.T, products[chosen] / size, cond=EXACT)[0] / size


def _regressor_kinds(counts, n_harmonics, n_loads):
    """What each regressor is, which of its kind, and its function."""
    columns = []
    for kind, count in enumerate(counts):
        n_functions = 2 * (n_loads if kind == 0 else n_harmonics) + 1
        columns += [(kind, i, function) for i in range(count) for function in range(n_functions)]
    return np.array(columns, dtype=int).T


def _chunks(start, stop, width):
    """Rows from start to before stop, so many at a time that regressors stay in memory."""
    length = max(256, AT_ONCE // max(1, width))
    for first in range(start, stop, length):
        yield np.arange(first, min(stop, first + length))


def _log_volume(left, total):
    """Logarithm of the determinant of a covariance, not below what rounding leaves."""
    scale = np.sqrt(np.maximum(np.diag(total), np.finfo(float).tiny))
    values = linalg.eigvalsh(left / scale / scale[:, None])
    return float(np.sum(np.log(np.maximum(values, HALF**2))))
