"""Predictions of a record by a sampled periodic model, and their derivatives.

    x[k+1] = Φ_k x[k] + Γ_k u[k] + K_k e[k],   y[k] = C_k x[k] + D_k u[k] + e[k]

e is what the prediction leaves. Without K the prediction is a simulation. Derivatives follow the
predictor, with z = [x; u]:

    ∂x[k+1] = (Φ_k − K_k C_k) ∂x[k] + (∂[Φ Γ]_k − K_k ∂[C D]_k) z[k] + ∂K_k e[k]
    ∂ŷ[k] = C_k ∂x[k] + ∂[C D]_k z[k]

A record is read in pieces: neither its length nor the number of parameters is bounded by memory.
The last part is for models whose Fourier coefficients are all free: coefficients of one function
of ψ share their regressors. Likelihoods, the steps of models of samples and residual tests need it.
"""

from dataclasses import dataclass

import numpy as np

from sklearn_hd.algorithms.periodic.floquet import by_phase, in_time, propagate_periodic
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import propagate_varying
from sklearn_hd.algorithms.signals.fourier import AT_ONCE, harmonic_functions, sampled_harmonics

TILE = 64  # samples of a time-invariant system that make a period


@dataclass(frozen=True, eq=False)
class Record:
    """One contiguous record."""

    inputs: np.ndarray  # (n_samples, m): held from sample to sample
    outputs: np.ndarray  # (n_samples, l)
    first_phase: int  # phase of the first sample, in samples after ψ = 0
    # (n_samples,): azimuths, where a turn holds no whole number of samples; ``first_phase`` then
    # means nothing
    psi: np.ndarray | None = None


def as_records(segments, n_outputs):
    """Records from (inputs, outputs, where); ``outputs=None`` are not told.

    ``where`` is the phase of the first sample, or the azimuths of all.
    """
    records = []
    for inputs, outputs, where in segments:
        u = np.asarray(inputs, dtype=float)
        y = np.zeros((len(u), n_outputs)) if outputs is None else np.asarray(outputs, dtype=float)
        first, psi = (int(where), None) if np.ndim(where) == 0 else (0, np.asarray(where))
        records.append(Record(u, y, first, psi))
    return records


def simulate(response, record, x0):
    """States (n_samples, n) and outputs (n_samples, l) of one record, from x0 (n,).

    With a gain they are predictions one sample ahead.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return _Course(response, record).predicted(x0)


def residuals(response, record, x0):
    """ŷ − y of one record, shape (n_samples, l)."""
    return simulate(response, record, x0)[1] - record.outputs


def n_columns(response, *, free_x0):
    """Number of derivatives: by x0 if it is free, by θ, and by the coefficients of K."""
    n_parameters = 0 if response.dPsi is None else len(response.dPsi) + response.n_gains
    return n_parameters + (response.n_states if free_x0 else 0)


def output_sensitivities(response, record, x0, *, free_x0=True):
    """∂ŷ/∂x0, ∂ŷ/∂θ and ∂ŷ/∂K of one record, and ŷ − y, piece by piece.

    Each piece comes as ``start``, ``stop`` and an array
    (n_columns + 1, stop − start, l), with ŷ − y in the last place.
    """
    n, columns = response.n_states, n_columns(response, free_x0=free_x0)
    n0, with_gain = n if free_x0 else 0, response.gain is not None
    course = _Course(response, record)
    states, predicted = course.predicted(x0)
    z = np.concatenate([states, record.inputs], axis=1)
    left = predicted - record.outputs
    slopes = _Slopes(response, record)
    seen = slopes.seen
    acting = np.union1d(slopes.acting, seen) if with_gain else slopes.acting
    gains = np.arange(n0 + slopes.n_parameters, columns)
    moving = np.concatenate([np.arange(n0), n0 + acting, gains])  # columns that move the states
    carried = np.zeros((len(moving), n))
    carried[:n0] = np.eye(n)[:n0]
    own, others = n0 + np.searchsorted(acting, slopes.acting), n0 + np.searchsorted(acting, seen)
    for start, stop in _pieces(len(z), course.n_phases, columns + 1, n, left.shape[1]):
        some = slice(start, stop + 1)
        forcing = np.zeros((len(moving), len(z[some]), n))
        if len(own):
            forcing[own] += slopes.of_steps(z, some)
        direct = slopes.of_outputs(z, some) if len(seen) else None
        if with_gain and direct is not None:
            forcing[others] -= course.at(course.gain, direct, some)
        if len(gains):
            forcing[n0 + len(acting) :] = -slopes.of_gain(left, some)
        dx = course.propagate(forcing, carried, some)
        carried, dx = dx[:, -1], dx[:, : stop - start]
        dy = np.zeros((columns + 1, stop - start, left.shape[1]))
        dy[moving] = course.at(course.C, dx, slice(start, stop))
        if direct is not None:
            dy[n0 + seen] += direct[:, : stop - start]
        dy[-1] = left[start:stop]
        yield start, stop, dy


class _Course:
    """The matrices of a model along a record: those of a turn that repeats, or of each sample."""

    def __init__(self, response, record):
        self.record, n = record, response.n_states
        Psi, Out = (_along(M, record) for M in (response.Psi, response.Out))
        self.Psi, self.Out, self.C, self.gain = Psi, Out, Out[..., :n], None
        self.closed = Psi[..., :n]
        if response.gain is not None:
            gain = _along(response.gain, record)
            self.gain, both = gain, _alike(gain, self.C, self.closed)
            self.closed = both[2] - both[0] @ both[1]
        self.repeats = len(self.closed) == 1 or record.psi is None
        turn = response.Psi, response.Out, response.closed
        self.n_phases = max(map(len, turn)) if record.psi is None else 1  # pieces end with a turn

    def predicted(self, x0):
        """States and predictions from an initial state."""
        record, n = self.record, self.closed.shape[-1]
        everything = slice(0, len(record.inputs))
        forcing = self.at(self.Psi[..., n:], record.inputs, everything)
        if self.gain is not None:
            known = record.outputs - self.at(self.Out[..., n:], record.inputs, everything)
            forcing = forcing + self.at(self.gain, known, everything)
        x = self.propagate(forcing, x0, everything)
        return x, self.at(self.Out, np.concatenate([x, record.inputs], axis=1), everything)

    def at(self, matrices, signals, rows):
        """M[k] s[k] for signals (..., n_rows, b) of some rows, which begin a turn."""
        return _times_phases(self._some(matrices, rows), signals)

    def propagate(self, forcing, x0, rows):
        """States of the predictor over some rows; infinite or NaN where they overflow."""
        closed = self._some(self.closed, rows)
        with np.errstate(over="ignore", invalid="ignore", under="ignore"):
            if not self.repeats:
                return _varying(closed, forcing, x0)
            if len(closed) == 1:  # √n_samples steps of many samples each instead of n_samples
                closed = np.broadcast_to(closed, (min(TILE, forcing.shape[-2]), *closed.shape[1:]))
            return propagate_periodic(closed, forcing, x0)

    def _some(self, matrices, rows):
        """Those of some rows, where each has its own."""
        return matrices[rows] if len(matrices) == len(self.record.inputs) else matrices


class _Slopes:
    """Derivatives of a model along a record.

    They are tables of a turn, or their harmonics where no sample is at an azimuth of the tables.
    """

    def __init__(self, response, record):
        self.record, self.response = record, response
        none = np.zeros((0, 1, response.n_states, 1))
        dPsi, dOut = (none if M is None else M for M in (response.dPsi, response.dOut))
        self.n_parameters = len(dPsi)
        self.acting, self.seen = _nonzero(dPsi), _nonzero(dOut)
        both = dPsi[self.acting], dOut[self.seen]
        self._dPsi, self._dOut = both if record.psi is None else map(_harmonics, both)

    def of_steps(self, z, rows):
        """∂[Φ Γ] z of the parameters that have it, shape (…, n_rows, n)."""
        return self._at(self._dPsi, z[rows], rows)

    def of_outputs(self, z, rows):
        """∂[C D] z of the parameters that have it."""
        return self._at(self._dOut, z[rows], rows)

    def of_gain(self, left, rows):
        """∂K (ŷ − y) of the coefficients of K, in the order harmonic, state, output."""
        n, (_, n_outputs) = self.response.n_states, left.shape
        psi = _azimuths(self.response, self.record)[rows]
        functions = harmonic_functions(psi, range(self.response.n_gain_harmonics + 1))
        pushes = np.einsum("th,tl->hlt", functions, left[rows])
        whole = np.zeros((len(pushes), n, n_outputs, len(psi), n))
        for i in range(n):
            whole[:, i, :, :, i] = pushes
        return whole.reshape(-1, len(psi), n)

    def _at(self, tables, z, rows):
        if self.record.psi is None or tables.shape[1] == 1:
            return _times_phases(_rolled(tables, self.record.first_phase), z)
        k, size, a, b = tables.shape
        harmonics = tables.transpose(1, 0, 2, 3).reshape(size, -1)
        values = evaluate_harmonics(harmonics, self.record.psi[rows]).reshape(-1, k * a, b)
        return (values @ z[..., None])[..., 0].reshape(-1, k, a).transpose(1, 0, 2)


def _along(table, record):
    """Matrices of one period (p, …) from a record's first phase, or of each of its samples."""
    if record.psi is None or len(table) == 1:
        return _rolled(table, record.first_phase)
    harmonics = _harmonics(table.reshape(1, len(table), -1))[0]
    return evaluate_harmonics(harmonics, record.psi).reshape(-1, *table.shape[1:])


def _harmonics(tables):
    """Of functions (k, p, …) given at an odd number p of equally spaced azimuths of a turn."""
    values = np.moveaxis(tables, 1, 0)
    return np.moveaxis(sampled_harmonics(values, len(values) // 2), 0, 1)


def _azimuths(response, record):
    """ψ of each sample."""
    if record.psi is not None:
        return record.psi
    samples = record.first_phase + np.arange(len(record.inputs))
    return 2.0 * np.pi * samples / response.n_phases


def _nonzero(derivatives):
    """Parameters that move something: those of the outputs alone leave states where they are."""
    return np.flatnonzero(derivatives.any(axis=(1, 2, 3)))


def _pieces(n_samples, n_phases, columns, n_states, n_outputs):
    """First and last sample of pieces of whole periods that fit into memory."""
    each = columns * (4 * n_states + 2 * n_outputs)
    length = n_phases * max(1, AT_ONCE // (each * n_phases))
    return [(k, min(k + length, n_samples)) for k in range(0, n_samples, length)]


def _rolled(matrices, first_phase):
    """Matrices of one period (..., p, rows, columns), beginning at a record's first phase."""
    shift = first_phase % matrices.shape[-3]
    return np.roll(matrices, -shift, axis=-3) if shift else matrices


def _alike(*several):
    """Matrices of turns, all of one length, or constant."""
    longest = max(map(len, several))
    return [M[np.arange(longest) % len(M)] for M in several]


def _times_phases(matrices, signals):
    """M[k mod p] s[k], of one matrix a phase (p, a, b) and signals (..., n_samples, b), or of many
    (m, p, a, b) and one signal."""
    *batch, p, a, b = matrices.shape
    s = by_phase(signals, p)
    _, rows, n_periods, _ = s.shape
    s = s.reshape(p, rows * n_periods, b)
    if not batch:
        product = s @ matrices.mT
        return in_time(product.reshape(p, rows, n_periods, a), signals.shape)
    (m,) = batch
    tables = matrices.transpose(1, 0, 2, 3).reshape(p, m * a, b)
    product = s @ tables.mT
    product = product.reshape(p, n_periods, m, a).transpose(0, 2, 1, 3)
    return in_time(product, (m, *signals.shape))


def _varying(A, forcing, x0):
    """States of a recursion in which nothing repeats."""
    *batch, n_samples, n = forcing.shape
    columns = forcing.reshape(-1, n_samples, n).transpose(1, 2, 0)
    start = np.broadcast_to(x0, (*batch, n)).reshape(-1, n).T
    return propagate_varying(A, columns, start).transpose(2, 0, 1).reshape(*batch, n_samples, n)


# ---- of a model whose Fourier coefficients are all free -----------------------------------------


def sensitivities(rows, inputs, states, residuals, functions, loads, *, feedthrough):
    """Derivatives of predictions by the Fourier coefficients of [A B a; C D c] and K.

    Shape (n_samples, l, n_parameters). One-step predictions; of a model without a gain, simulated
    outputs.

    ``rows`` is the model at the samples of one segment. ``functions``
    (n_samples, 2 H + 1) are 1, cos ψ, sin ψ, … of the matrices. ``loads``
    (n_samples, 2 L + 1) are those of a and c, with no column where these are not
    fitted. ``feedthrough`` says whether D was fitted.
    """
    signals = inputs, states, residuals
    pairs = regressors_of(rows, *signals, functions, loads, feedthrough=feedthrough)
    return next(sensitivity_pieces(rows, pairs, len(states)))[1]


def regressors_of(rows, inputs, states, residuals, functions, loads, *, feedthrough, n_inputs=None):
    """What the coefficients of [A B K] and of [C D] are multiplied by, then those of a and c.

    Arguments are as for :func:`sensitivities`. ``n_inputs`` says for each function how
    many of the inputs count; all do by default. A pair of arrays (n_samples, q) comes
    for each function, and one for the loads.
    """
    n_inputs = [inputs.shape[1]] * functions.shape[1] if n_inputs is None else n_inputs
    pairs = []
    for f, count in zip(functions.T, n_inputs, strict=True):
        driven = np.hstack([states, inputs[:, :count]])
        moved = np.hstack([driven, residuals]) if rows.gain.any() else driven
        pairs.append((f[:, None] * moved, f[:, None] * (driven if feedthrough else states)))
    return [*pairs, (loads, loads)]


def sensitivity_pieces(rows, pairs, most, weights=None):
    """Sensitivities piece by piece, each of some rows: this takes little memory.

    ``pairs`` are from :func:`regressors_of`, and a piece has ``most`` rows or fewer.
    ``weights`` (l, l) combine the outputs. Each piece comes as a slice of the rows and
    their sensitivities, (n_rows, l, n_parameters).
    """
    n, K, C = rows.n_states, rows.gain, rows.outputs[..., : rows.n_states]
    W = np.eye(C.shape[1]) if weights is None else weights
    widths = [(n * drives.shape[1], len(W) * direct.shape[1]) for drives, direct in pairs]
    ends = np.cumsum([0, *np.ravel(widths)])
    places = list(zip(ends[:-1:2], ends[1::2], ends[2::2], strict=True))
    stable, start = rows.predicting, np.zeros((n, ends[-1]))
    for first in range(0, len(C), most):
        piece = slice(first, first + most)
        forcing = np.empty((len(C[piece]), n, ends[-1]))
        for (drives, direct), (a, b, c) in zip(pairs, places, strict=True):
            of_each_output(drives[piece], np.eye(n), forcing[..., a:b])
            of_each_output(direct[piece], -K[piece], forcing[..., b:c])
        x = propagate_varying(stable[piece], forcing, start)
        with np.errstate(over="ignore", invalid="ignore"):  # of a model that grows
            start = stable[piece][-1] @ x[-1] + forcing[-1]
        change = (W @ C[piece]) @ x
        for (_, direct), (_, b, c) in zip(pairs, places, strict=True):
            change[..., b:c] += of_each_output(direct[piece], W)
        yield piece, change


def sensitivity_sums(rows, pairs, directions):
    """Σ wᵀ ∂ŷ/∂θ over all rows of a segment for some directions w, without the sensitivities.

        λ[k] = (A − K C)ᵀ λ[k+1] + Cᵀ w[k]
        Σ λ[k+1]ᵀ ∂[A B a K] [x u 1 e] + (w[k] − Kᵀ λ[k+1])ᵀ ∂[C D c] [x u 1]

    ``pairs`` are from :func:`regressors_of`, and ``directions`` have shape
    (n_samples, l).
    """
    n, w = rows.n_states, directions[..., None]
    back = rows.predicting.transpose(0, 2, 1)[::-1]
    forcing = (rows.outputs[..., :n].transpose(0, 2, 1) @ w)[::-1]
    later = propagate_varying(back, forcing, np.zeros((n, 1)))[::-1]
    seen = (w - rows.gain.transpose(0, 2, 1) @ later)[..., 0]
    sums = [(later[..., 0].T @ drives, seen.T @ direct) for drives, direct in pairs]
    return np.concatenate([part.ravel() for pair in sums for part in pair])


def of_each_output(regressors, weights, out=None):
    """Regressors (n_samples, a, l q) for each output by itself; weights then combine the outputs.

    ``regressors`` have shape (n_samples, q), and ``weights`` (a, l) or
    (n_samples, a, l).
    """
    shape = len(regressors), *weights.shape[-2:], regressors.shape[1]
    out = np.empty((*shape[:2], shape[2] * shape[3])) if out is None else out
    np.multiply(weights[..., None], regressors[:, None, None, :], out=out.reshape(shape))
    return out
