"""Sums over records that merge in any grouping, from which models are made at any time.

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

Rows that follow others (a chunk in time, a partition elsewhere) are joined to them: what is
added is T across the seam, from the last K rows before it and the first K after it. So the
memory taken does not grow with a record: some thousand rows, and the sums.

Chunks in time and partitions of dask's are identified from these sums; ``memory=`` keeps T.

Exponential forgetting: rows of a record weighted by their age.

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

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS
from sklearn_hd.algorithms.linalg.triangular import safe_cholesky
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.innovations import REACH, InnovationForm
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.algorithms.subspace.lag_products import LagProducts, Stretch, stretch
from sklearn_hd.algorithms.subspace.responses import (
    ResponseProducts,
    alike_states,
    normal_equations,
    output_normal,
    split,
)

ROUND = 16384  # rows added up at a time: with K before them, a Fourier transform of 5 · 2¹²
FIRST_ROWS = 256  # that a slow model's initial state is found from


@dataclass(frozen=True)
class RecordEnds:
    """The first and last rows of a record."""

    head: np.ndarray  # (min(n_rows, K), p): of inputs and outputs
    tail: np.ndarray  # (min(n_rows, K), m): of inputs
    n_rows: int

    def faded(self, shift):
        """The same of rows divided by 2 to the power of ``shift``."""
        return replace(self, head=np.ldexp(self.head, -shift), tail=np.ldexp(self.tail, -shift))


@dataclass(frozen=True)
class Sums:
    """Sums over whole records."""

    products: LagProducts | None  # of all channels
    lags: np.ndarray  # (K + 1, m, p): t[d], of inputs with inputs and outputs
    squares: np.ndarray  # (l,): of the outputs
    ends: tuple  # of RecordEnds: of each record

    def of_inputs(self, which):
        """T and ends for some of the inputs, and all outputs."""
        n_inputs, n_signals = self.lags.shape[1:]
        signals = np.concatenate([which, np.arange(n_inputs, n_signals)])
        ends = (replace(e, head=e.head[:, signals], tail=e.tail[:, which]) for e in self.ends)
        return replace(self, lags=self.lags[:, which][:, :, signals], ends=tuple(ends))

    def faded(self, shift):
        """The same of rows divided by 2 to the power of ``shift``, which a later row outweighs."""
        ends = tuple(record.faded(shift) for record in self.ends)
        return _faded(self, shift, ends)

    def __add__(self, other):
        return Sums(
            self.products + other.products,
            self.lags + other.lags,
            self.squares + other.squares,
            self.ends + other.ends,
        )


@dataclass(frozen=True)
class RowSums:
    """Sums over consecutive rows of a record, that others may follow."""

    products: Stretch  # of all channels
    lags: np.ndarray  # as of ``Sums``
    squares: np.ndarray  # the same
    ends: RecordEnds  # of these rows

    def join(self, later):
        """These rows and those right after them, as one."""
        here, there = self.ends, later.ends
        before = np.concatenate([here.tail, np.zeros((len(there.head), here.tail.shape[1]))])
        ends = RecordEnds(
            np.concatenate([here.head, there.head])[:REACH],
            np.concatenate([here.tail, there.tail])[-REACH:],
            here.n_rows + there.n_rows,
        )
        return RowSums(
            self.products.join(later.products),
            self.lags + later.lags + _lagged(before, there.head),
            self.squares + later.squares,
            ends,
        )

    def faded(self, shift):
        """The same of rows divided by 2 to the power of ``shift``."""
        return _faded(self, shift, self.ends.faded(shift))

    def closed(self):
        """The whole record as a summand."""
        return Sums(self.products.closed(), self.lags, self.squares, (self.ends,))


def _faded(sums, shift, ends):
    """Sums, of one record or several, of rows divided by 2 to the power of ``shift``."""
    lags, squares = (np.ldexp(each, -2 * shift) for each in (sums.lags, sums.squares))
    products = sums.products.faded(shift)
    return replace(sums, products=products, lags=lags, squares=squares, ends=ends)


def row_sums(rows, n_lags, inputs, outputs):
    """Sums over consecutive rows (n_rows, n_channels) of a record.

    The Hankel matrix to come has ``n_lags`` (2i) block rows; B, D and the initial state are found
    from some channels as inputs and outputs.
    """
    return RowSums(stretch((rows,), n_lags), *_correlated(rows[:, inputs], rows[:, outputs]))


def correlations(records):
    """Sums over whole records (inputs, outputs) without their lag products."""
    lags, squares, ends = zip(*(_correlated(u, y) for u, y in records), strict=True)
    return Sums(None, sum(lags), sum(squares), ends)


def _correlated(u, y):
    """T, squares of the outputs and ends of consecutive rows."""
    z, lags = np.hstack([u, y]), np.zeros((REACH + 1, u.shape[1], u.shape[1] + y.shape[1]))
    for start in range(0, len(z), ROUND):
        stop = start + ROUND
        lags += _lagged(u[max(0, start - REACH) : stop], z[start:stop])
    ends = RecordEnds(z[:REACH].copy(), u[-REACH:].copy(), len(z))
    return lags, np.sum(y**2, axis=0), ends


def _lagged(before, z):
    """Σ_k u_{k-d} z_k' for d = 0 … K, (K + 1, m, p), over rows z.

    Their inputs are the last of ``before`` (n_before + n_rows, m), at most K rows of which come
    before z.
    """
    if len(z) == 0:
        return np.zeros((REACH + 1, before.shape[1], z.shape[1]))
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


def input_matrices_of_sums(A, C, sums, feedthrough, scales):
    """B, D and the initial states (n_records, n) by least squares over all rows of all records.

    Inputs and outputs are divided by ``scales``. None where the model remembers more rows than
    the sums reach, or rounding would show.
    """
    A, C, size = alike_states(A, C)
    model = output_normal(A, C)
    if model is None or len(scales[0]) == 0:
        return None
    records = _record_products(model.basis, sums, scales)
    if records is None:
        return None
    n, m, n_outputs = len(A), len(scales[0]), len(C)
    shared, starts, loss = 0.0, [], 0.0
    for products in records:
        G, _ = normal_equations(model, products, feedthrough)
        G = np.triu(G) + np.triu(G, 1).T
        seen, directions = linalg.eigh(G[:n, :n])
        inverse = np.where(seen > DEPENDENT, 1.0 / np.maximum(seen, DEPENDENT), 0.0)
        inverse = (directions * inverse) @ directions.T
        starts.append((inverse @ G[:n, n:-1], inverse @ G[:n, -1]))
        loss = loss + np.diagonal(G)[n : n + n * m]
        shared = shared + G[n:, n:] - G[n:, :n] @ inverse @ G[:n, n:]
    whole = np.tile(np.diagonal(records[0].inputs), n)
    if not np.all(loss > 0.0):
        return None
    R = safe_cholesky(shared[:-1, :-1], model.error * np.max(whole / loss))
    if R is None:
        return None
    theta = linalg.cho_solve((R, False), shared[:-1, -1])
    x0 = np.array([right - coupling @ theta for coupling, right in starts])
    B, D = split(theta, n, m, n_outputs)
    B, x0 = linalg.solve_triangular(model.T, B), linalg.solve_triangular(model.T, x0.T).T
    return B / size[:, None], D, x0 / size


def _record_products(basis, sums, scales):
    """Products of each record with responses; those that only their sum is known of in the first.

    Normal equations are linear in these.
    """
    m, scale, reach = len(scales[0]), np.concatenate(scales), len(sums.lags) - 1
    answers = propagate(basis.F, np.zeros((reach, len(basis.g))), basis.g)
    if np.max(np.abs(answers[-1])) > DEPENDENT and any(e.n_rows > reach for e in sums.ends):
        return None
    forced = np.tensordot(answers, sums.lags[1:], ((0,), (0,))).transpose(1, 0, 2)
    lags = sums.lags[0] / scales[0][:, None] / scale
    first = ResponseProducts(
        forced=forced / scales[0][:, None, None] / scale,
        free=np.zeros((len(basis.g), len(scale))),
        last=np.zeros((m, len(basis.g))),
        inputs=lags,
        outputs=float(np.sum(sums.squares / scales[1] ** 2)),
        n_samples=0,
    )
    nothing = replace(first, forced=0.0 * first.forced, inputs=0.0 * lags, outputs=0.0)
    records = []
    for k, ends in enumerate(sums.ends):
        free = answers[: len(ends.head)].T @ ends.head / scale
        last = ends.tail[::-1].T @ answers[: len(ends.tail)] / scales[0][:, None]
        common = nothing if k else first
        records.append(replace(common, free=free, last=last, n_samples=ends.n_rows))
    return records


def input_matrices_of_heads(A, C, ends, feedthrough, scales):
    """The same of records that are no longer than their first rows kept; None where one is."""
    if any(record.n_rows > len(record.head) for record in ends):
        return None
    pairs = (np.split(record.head, [len(scales[0])], axis=1) for record in ends)
    inputs, outputs = zip(*pairs, strict=True)
    return input_matrices(A, C, inputs, outputs, feedthrough, scales=scales)


def input_matrices_of_factor(A, C, R, block_rows, n_inputs, feedthrough):
    """B and D from the triangular factor alone (Verhaegen, 1994).

    What is orthogonal to the extended observability matrix Γ sees the future inputs only,
    through the block Toeplitz matrix H of D, C B, C A B, …

        Γ⊥' Y_f = Γ⊥' H(B, D) U_f + noise

    Each column of the Hankel matrix has an initial state of its own: less is asked of the
    model than of one that is simulated, and less said of B and D where it is slow. R is that of
    :func:`~sklearn_hd.algorithms.subspace.hankel.factor_of_products`.
    """
    n, n_outputs, i, m = len(A), len(C), block_rows, n_inputs
    if m == 0:
        return np.zeros((n, 0)), np.zeros((n_outputs, 0))
    gamma = [C]
    for _ in range(i - 1):
        gamma.append(gamma[-1] @ A)
    across = linalg.qr(np.vstack(gamma))[0][:, n:]
    beside = across.reshape(i, n_outputs, -1)  # block row, output, direction
    maps = np.zeros((i, beside.shape[-1], n_outputs + n))  # of [D; B], for each block of inputs
    for k in range(i):
        maps[k, :, :n_outputs] = beside[k].T
        if k < i - 1:
            later = np.stack(gamma[: i - 1 - k])
            maps[k, :, n_outputs:] = np.einsum("jod,jon->dn", beside[k + 1 :], later)
    if not feedthrough:
        maps = maps[..., n_outputs:]
    inputs = R[: i * m, : i * m].reshape(i * m, i, m)
    regressors = np.einsum("rkc,kdz->rdzc", inputs, maps, optimize=True)
    target = R[: i * m, -i * n_outputs :] @ across
    width = maps.shape[-1]
    regressors = regressors.reshape(-1, width * m)
    theta = linalg.lstsq(regressors, target.ravel(), cond=DEPENDENT, lapack_driver="gelsy")
    theta = theta[0].reshape(width, m)
    D = theta[:n_outputs] if feedthrough else np.zeros((n_outputs, m))
    return theta[width - n :], D


def initial_states_of_heads(A, B, C, D, ends, scales, noise=(None, None)):
    """Initial states (n_records, n) by least squares over the first rows of each record.

    The model is in the units that ``scales`` make; with ``noise``, the Kalman gain and the
    covariance of the innovations, outputs tell the rows before.
    """
    K, covariance = noise
    m, rows = B.shape[1], slice(None) if K is not None else slice(FIRST_ROWS)
    form = InnovationForm(A, B, C, D, np.zeros((len(A), len(C))) if K is None else K)
    heads = (record.head[rows] / np.concatenate(scales) for record in ends)
    return np.array([form.initial_state(head[:, :m], head[:, m:], covariance) for head in heads])


@dataclass(frozen=True)
class Forgetting:
    """Weights of consecutive rows."""

    half_life: float = np.inf  # h, in rows; infinite forgets nothing

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

        In units in which the newest row weighs between a half and one.

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
        """Σw over the rows of consecutive segments, the newest last, but the last few of each."""
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
        """Rows alike that segments are worth, by their shares of Σw."""
        if self.half_life == np.inf:
            return list(lengths)
        own = self.weights(lengths)
        return [round(each) for each in own * self.n_effective(lengths) / np.sum(own)]

    def first(self, lengths):
        """What the first row of each segment is multiplied by in z̃; NaN where rounding hides it."""
        lengths = np.asarray(lengths, dtype=float)
        ages = np.cumsum(lengths[::-1])[::-1] - 1.0
        factors = np.exp2(-ages / (2.0 * self.half_life))
        return np.where(factors < EPS, np.nan, factors) * self.newest(int(np.sum(lengths)))
