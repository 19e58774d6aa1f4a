"""Coordinates of the states that a periodic model has without one of its Floquet modes.

The other modes span a subspace that A(ψ) carries from sample to sample, and that turns with ψ. Its
coordinates V(ψ) are orthonormal at every azimuth. They do not turn within the subspace (parallel
transport), so that they have few harmonics. After 2π they are turned by a rotation R, which is
taken back evenly,

    V_k ← V_k exp(−(k/q) log R),   k = 0 … q − 1

If R is a reflection, the subspace has no coordinates that repeat every turn. That is so where one
mode of a negative multiplier is left out, or left alone.

The reading of samples (:mod:`sklearn_hd._identify.sample`) needs it.
"""

from dataclasses import replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import HALF
from sklearn_hd.algorithms.periodic.floquet import product_of
from sklearn_hd.algorithms.periodic.harmonic_balance import (
    evaluate_harmonics,
    resize_harmonics,
)
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics


def coordinates_without_modes(model, n_harmonics):
    """Coordinates of the other states, without each mode or complex pair of modes.

    Parameters
    ----------
    model : PeriodicInnovations
    n_harmonics : int
        Below half of the samples in a turn; what is beyond is left out.

    Yields
    ------
    coefficients : ndarray, shape (2 n_harmonics + 1, n, k)
        Of V(ψ), in the order 0, 1c, 1s, …; k states are left.
    """
    for V, _ in _split(model):
        yield sampled_harmonics(V, n_harmonics)


def without_modes(model, n_harmonics):
    """Yields the model truncated by each mode or complex pair, its other modes as they are.

        z = L(ψ) x,   L V = I, and L is zero on the mode left out
        A ← L(ψ + δ) A V,   B, a, K ← L(ψ + δ) B, a, K,   C ← C V

    Parameters
    ----------
    model : PeriodicInnovations
    n_harmonics : int
        Kept of A, B, C, D and K.
    """
    n, highest = model.n_states, max(n_harmonics, len(model.coefficients) // 2)
    for V, others in _split(model):
        most, k = (len(V) - 1) // 2, V.shape[2]
        both = np.concatenate([V, others], axis=2)
        if np.linalg.svd(both, compute_uv=False).min() < HALF:  # the mode is lost in rounding
            continue
        L = np.linalg.inv(both)[:, :k]
        n_azimuths = 4 * (most + highest) + 1
        psi = 2.0 * np.pi * np.arange(n_azimuths) / n_azimuths
        V = evaluate_harmonics(sampled_harmonics(V, most), psi)
        L = evaluate_harmonics(sampled_harmonics(L, most), psi + model.step)
        whole = evaluate_harmonics(model.coefficients, psi)
        whole = np.concatenate([L @ whole[:, :n], whole[:, n:]], axis=1)
        whole = np.concatenate([whole[..., :n] @ V, whole[..., n:]], axis=2)
        coefficients = sampled_harmonics(whole, highest)
        coefficients[2 * n_harmonics + 1 :, :, :-1] = 0.0  # loads may have more
        gain = resize_harmonics(
            sampled_harmonics(L @ evaluate_harmonics(model.gain, psi), n_harmonics), highest
        )
        yield replace(model, coefficients=coefficients, gain=gain)


def _split(model):
    """Bases of the subspaces of the other modes, and of the mode left out, for each of a model."""
    A = replace(model, start=0.0).whole_turn()[1][..., : model.n_states]
    values, vectors = np.linalg.eig(product_of(A))
    for k in np.flatnonzero(values.imag >= 0.0):  # the other one of a pair follows it
        own = [k, k + 1] if values[k].imag > 0.0 else [k]
        both = np.delete(vectors, own, axis=1), vectors[:, own]
        if both[0].size:
            starts = (linalg.svd(np.hstack([v.real, v.imag]))[0][:, : v.shape[1]] for v in both)
            others, left_out = (_carried(A, start) for start in starts)
            V = _closed(others)
            if V is not None:
                yield V, left_out[:-1]


def _carried(A, start):
    """Orthonormal bases of a subspace at the start of every step, and after the last one."""
    bases = [start]
    for each in A:
        basis = linalg.qr(each @ bases[-1], mode="economic")[0]
        left, _, right = linalg.svd(basis.T @ bases[-1])
        bases.append(basis @ (left @ right))  # the nearest one to that before
    return np.array(bases)


def _closed(bases):
    """The same bases, turned so that the last is the first, without it; None if none is."""
    turn, q = bases[0].T @ bases[-1], len(bases) - 1
    if linalg.det(turn) < 0.5:  # −1 of a reflection; 0 where a mode is lost in rounding
        return None
    return bases[:-1] @ linalg.expm(-np.arange(q)[:, None, None] / q * _logarithm(turn))


def _logarithm(rotation):
    """The real logarithm of a rotation, of the least angles."""
    blocks, vectors = linalg.schur(rotation)
    angles, reversed_axes, k, n = np.zeros_like(blocks), [], 0, len(blocks)
    while k < n:
        if k + 1 < n and blocks[k + 1, k] != 0.0:
            angles[k + 1, k] = np.arctan2(blocks[k + 1, k], blocks[k, k])
            k += 1
        elif blocks[k, k] < 0.0:
            reversed_axes.append(k)
        k += 1
    for one, other in zip(reversed_axes[::2], reversed_axes[1::2], strict=True):
        angles[other, one] = np.pi
    return vectors @ (angles - angles.T) @ vectors.T
