"""Residuals of sampled periodic systems on records, and their Jacobians.

    x[k+1] = Ψ_k z[k],   ŷ[k] = Out_k z[k],   z = [x; u]
    ∂x[k+1] = Φ_k ∂x[k] + ∂Ψ_k z[k],   ∂ŷ[k] = Out_k [∂x[k]; 0] + ∂Out_k z[k]

Only the triangular factor of [∂ŷ/∂x0, ∂ŷ/∂θ, ŷ − y] is kept, one for each output: a
record is read in pieces, and neither its length nor the number of parameters is bounded
by memory. The factors keep the digits that JᵀJ would lose.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.periodic.floquet import propagate_periodic

__all__ = [
    "Record",
    "as_records",
    "jacobian_factors",
    "residuals",
    "simulate",
]

PIECE = 8_000_000  # numbers in the sensitivities of one piece, 64 MB
TILE = 64  # samples of a time-invariant system that make a period


@dataclass(frozen=True, eq=False)
class Record:
    """One contiguous record.

    Attributes
    ----------
    inputs : ndarray, shape (n_samples, m)
        Held from sample to sample.
    outputs : ndarray, shape (n_samples, l)
        Zero where missing.
    present : ndarray of bool, shape (n_samples, l)
    first_phase : int
        Phase of the first sample, in samples after ψ = 0.
    """

    inputs: np.ndarray
    outputs: np.ndarray
    present: np.ndarray
    first_phase: int


def as_records(segments, n_inputs, n_outputs):
    """Records from (inputs, outputs, first_phase); outputs may hold NaN where missing.

    ``outputs=None`` means that all are present, their values not told.

    Raises
    ------
    ValueError
        If shapes do not fit, inputs are not finite, or no output is there at all.
    """
    records = []
    for position, (inputs, outputs, first_phase) in enumerate(segments):
        u = np.asarray(inputs, dtype=float)
        y = np.zeros((len(u), n_outputs)) if outputs is None else np.asarray(outputs, dtype=float)
        if u.shape != (len(u), n_inputs) or y.shape != (len(u), n_outputs) or not len(u):
            raise ValueError(
                f"segment {position} has inputs of shape {u.shape} and outputs of shape "
                f"{y.shape}; the structure needs (n_samples, {n_inputs}) and "
                f"(n_samples, {n_outputs})"
            )
        if not np.all(np.isfinite(u)):
            raise ValueError(
                f"inputs of segment {position} hold NaN or infinity; only outputs may be missing: "
                f"cut the segment where an input is"
            )
        present = np.isfinite(y)
        records.append(Record(u, np.where(present, y, 0.0), present, int(first_phase)))
    counts = sum((record.present.sum(axis=0) for record in records), np.zeros(n_outputs, int))
    if not np.all(counts > 0):
        raise ValueError(
            f"outputs have {counts.tolist()} values in {len(records)} segments; each output needs "
            f"some that are not NaN"
        )
    return records


def simulate(response, record, x0):
    """States (n_samples, n) and outputs (n_samples, l) of one record, from x0 (n,)."""
    Psi, Out = (_rolled(M, record.first_phase) for M in (response.Psi, response.Out))
    n = response.n_states
    forcing = _by_phase(Psi[:, :, n:], record.inputs)
    x = _propagate(Psi[:, :, :n], forcing, x0)
    return x, _by_phase(Out, np.concatenate([x, record.inputs], axis=1))


def residuals(response, record, x0):
    """ŷ − y of one record, shape (n_samples, l); zero where y is missing."""
    difference = simulate(response, record, x0)[1] - record.outputs
    return np.where(record.present, difference, 0.0)


def jacobian_factors(response, record, x0, *, free_x0=True):
    """Triangular factors of [∂ŷ/∂x0, ∂ŷ/∂θ, ŷ − y], one for each output.

    Parameters
    ----------
    response : SampledResponse
        With its derivatives; without them there are no columns for θ.
    record : Record
    x0 : ndarray, shape (n,)
    free_x0 : bool, default=True
        Whether there are columns for x0.

    Returns
    -------
    factors : ndarray, shape (l, c, c)
        Upper triangular; c = n + k + 1, or k + 1 with x0 known.
    """
    difference = residuals(response, record, x0)
    columns = n_columns(response, free_x0=free_x0) + 1
    factors = np.zeros((difference.shape[1], columns, columns))
    for start, stop, dy in output_sensitivities(response, record, x0, free_x0=free_x0):
        block = np.concatenate([dy, difference[None, start:stop]])
        for i, factor in enumerate(factors):
            factors[i] = updated_factor(factor, block[:, :, i])
    return factors


def updated_factor(factor, columns):
    """Triangular factor (c, c) with further rows: columns (c, n_rows) of the matrix."""
    block = np.concatenate([factor.T, columns], axis=1).T  # in the order that LAPACK reads
    return linalg.qr(block, mode="r", overwrite_a=True, check_finite=False)[0][: len(factor)]


def n_columns(response, *, free_x0):
    """Number of derivatives: by x0 if it is free, and by θ."""
    n_parameters = 0 if response.dPsi is None else len(response.dPsi)
    return n_parameters + (response.n_states if free_x0 else 0)


def output_sensitivities(response, record, x0, *, free_x0=True):
    """∂ŷ/∂x0 and ∂ŷ/∂θ of one record, piece by piece.

    Yields
    ------
    start, stop : int
        Samples of the piece.
    dy : ndarray, shape (n_columns, stop − start, l)
        Zero where an output is missing.
    """
    Out = _rolled(response.Out, record.first_phase)
    n, columns = response.n_states, n_columns(response, free_x0=free_x0)
    n0 = n if free_x0 else 0
    moves = response.dOut is not None and response.dOut.any()
    z = np.concatenate([simulate(response, record, x0)[0], record.inputs], axis=1)
    carried = np.zeros((columns, n))
    carried[:n0] = np.eye(n)[:n0]
    n_phases = max(len(response.Psi), len(Out))
    for start, stop in _pieces(len(z), n_phases, columns + 1, n, Out.shape[1]):
        dx = _state_sensitivities(response, record.first_phase, z[start : stop + 1], carried)
        carried, dx = dx[:, -1], dx[:, : stop - start]
        dy = _by_phase(Out[:, :, :n], dx)
        if moves:
            dy[n0:] += _by_phase(_rolled(response.dOut, record.first_phase), z[start:stop])
        yield start, stop, np.where(record.present[start:stop], dy, 0.0)


def _state_sensitivities(response, first_phase, z, start):
    """∂x at each sample of a piece that begins at ∂x = start, (n0 + k, n_samples, n)."""
    Phi = _rolled(response.Phi, first_phase)
    forcing = np.zeros((len(start), *z[:, : response.n_states].shape))
    if response.dPsi is not None:
        n0 = len(start) - len(response.dPsi)
        forcing[n0:] = _by_phase(_rolled(response.dPsi, first_phase), z)
    return _propagate(Phi, forcing, start)


def _pieces(n_samples, n_phases, columns, n_states, n_outputs):
    """First and last sample of pieces of whole periods that fit into memory."""
    each = columns * (4 * n_states + 2 * n_outputs)
    length = n_phases * max(1, PIECE // (each * n_phases))
    return [(k, min(k + length, n_samples)) for k in range(0, n_samples, length)]


def _rolled(matrices, first_phase):
    """Matrices of one period (..., p, rows, columns), beginning at a record's first phase."""
    shift = first_phase % matrices.shape[-3]
    return np.roll(matrices, -shift, axis=-3) if shift else matrices


def _by_phase(matrices, signals):
    """M[k mod p] s[k] for matrices (..., p, a, b) and signals (..., n_samples, b)."""
    p, a, b = matrices.shape[-3:]
    *batch, n_samples, _ = signals.shape
    n_periods = -(-n_samples // p)
    padding = [(0, 0)] * len(batch) + [(0, n_periods * p - n_samples), (0, 0)]
    s = np.pad(signals, padding).reshape(*batch, n_periods, p, b)
    product = np.swapaxes(s, -2, -3) @ np.swapaxes(matrices, -1, -2)
    product = np.swapaxes(product, -2, -3)
    return product.reshape(*product.shape[:-3], n_periods * p, a)[..., :n_samples, :]


def _propagate(Phi, forcing, x0):
    """States of the periodic recursion; infinite or NaN where they overflow."""
    if len(Phi) == 1:  # √n_samples steps of many samples each instead of n_samples of one
        Phi = np.broadcast_to(Phi, (min(TILE, forcing.shape[-2]), *Phi.shape[1:]))
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        return propagate_periodic(Phi, forcing, x0)
