"""When inputs rest: turns in which they do nothing but noise.

Inputs of a record in flight rest but for noise; no turn is exactly still. What an input does is
its change from a turn before, d_i, which no constant and no waveform of the turn has:

    e_k = Σ_i Σ_turn k d_i(ψ)² / Σ_record d_i(ψ)²,   rests: e_k ≤ 4 × the mean of the quieter half

if what the others hold, turn for turn, is a hundred times that mean. How long a record rests does
not matter. The analyzer needs it to choose how a record is read, the period reading to find free
decays.
"""

import numpy as np

from sklearn_hd.algorithms.linalg.rounding import HALF
from sklearn_hd.algorithms.signals.resampling import interpolate

__all__ = ["changes", "energy_by_turn", "inputs_rest", "rests"]

DUST = 1e-4  # of a signal, that splines through 7 samples a turn may miss
LEAST_TURNS = 12  # of which some rest: fewer tell no Poincaré map
LIKE = 4.0  # times the mean of the quieter half: what noise gives in no turn
QUIET = 0.01  # of the energy of a turn that moves, which one at rest may hold
TURN = 2.0 * np.pi


def changes(values, psi):
    """Signals of one segment less those a turn before; in its first half, a turn after.

    Parameters
    ----------
    values : ndarray, shape (n_samples, n_signals)
    psi : ndarray, shape (n_samples,)
        Azimuth in rad, growing.

    Returns
    -------
    changes : ndarray, shape (n_samples, n_signals)
        Zero in a segment of less than two turns.
    """
    if len(psi) < 2 or psi[-1] - psi[0] < 2.0 * TURN:
        return np.zeros(values.shape)
    middle = 0.5 * (psi[0] + psi[-1])  # so that splines are asked for nothing near their ends
    other = np.where(psi < middle, psi + TURN, psi - TURN)
    before = interpolate(values, psi, other)
    apart = np.diff(psi)
    holes = apart[np.clip(np.searchsorted(psi, other), 1, len(apart)) - 1] > 2.0 * np.median(apart)
    for column, known in zip(before.T, values.T, strict=True):
        column[holes] = np.interp(other[holes], psi, known)  # a spline would swing there
    moved = values - before
    return np.where(np.abs(moved) > DUST * np.max(np.abs(values), axis=0), moved, 0.0)


def energy_by_turn(signals, psi):
    """Energy of some signals in each turn, the whole record's of each signal being one.

    Parameters
    ----------
    signals : list of ndarray, shapes (n_samples_s, n_signals)
        Of each segment.
    psi : list of ndarray, shapes (n_samples_s,)

    Returns
    -------
    energy : list of ndarray, shapes (n_turns_s,)
        Of the turns of each segment, from its first sample, that hold samples.
    turns : list of ndarray of int, shapes (n_samples_s,)
        Which of them each sample lies in.
    """
    largest = np.max([np.max(np.abs(each), axis=0, initial=0.0) for each in signals], axis=0)
    signals = [each / np.where(largest > 0.0, largest, 1.0) for each in signals]
    whole = sum(np.sum(each**2, axis=0) for each in signals)
    weights = np.where(whole > 0.0, 1.0 / np.where(whole > 0.0, whole, 1.0), 0.0)
    counts = [np.floor((p - p[:1]) / TURN + HALF) for p in psi]
    turns = [np.cumsum(np.diff(count, prepend=count[:1]) > 0.0) for count in counts]
    parts = zip(signals, turns, strict=True)
    return [np.bincount(k, each**2 @ weights) for each, k in parts], turns


def inputs_rest(inputs, psi):
    """Whether inputs rest in at least half of the turns of a record, apart from noise.

    A turn rests if the inputs do in it what they did a turn before.

    Parameters
    ----------
    inputs : list of ndarray, shapes (n_samples_s, n_inputs)
        Of each segment; those of less than two turns tell nothing.
    psi : list of ndarray, shapes (n_samples_s,)
        Azimuth in rad, growing.

    Returns
    -------
    rest : bool
        False where they never move at all, and of fewer than twelve turns.

    Examples
    --------
    >>> psi = 2 * np.pi * np.arange(320) / 16
    >>> doublet = np.repeat([0.0, 1.0, -1.0, 0.0], [64, 32, 32, 192])[:, None]
    >>> inputs_rest([doublet], [psi]), inputs_rest([np.sin(0.3 * psi)[:, None]], [psi])
    (True, False)
    """
    inputs, psi = _told(inputs, psi)
    if not inputs:
        return False
    moves = [changes(values, p) for values, p in zip(inputs, psi, strict=True)]
    energy = np.concatenate(energy_by_turn(moves, psi)[0])
    return len(energy) >= LEAST_TURNS and bool(rests(energy).any())


def _told(inputs, psi):
    """Inputs and azimuths of the segments that hold two turns or more."""
    told = [k for k, p in enumerate(psi) if len(p) > 1 and p[-1] - p[0] >= 2.0 * TURN]
    return [inputs[k] for k in told], [psi[k] for k in told]


def rests(energy):
    """Which turns are at rest.

    Parameters
    ----------
    energy : ndarray, shape (n_turns,)
        Of what inputs do in each.

    Returns
    -------
    rests : ndarray of bool, shape (n_turns,)
        False throughout where the quieter half of the turns moves, too, or nothing does.

    Examples
    --------
    >>> rests(np.array([1e-6, 1e-6, 2e-6, 1.0, 0.5, 1e-6, 1e-6])).tolist()
    [True, True, True, False, False, True, True]
    >>> bool(rests(np.array([0.7, 1.0, 0.9, 0.8])).any())
    False
    """
    quieter = np.mean(np.sort(energy)[: max(1, len(energy) // 2)])
    still = energy <= max(LIKE * quieter, HALF**2 * np.max(energy))
    if still.all() or quieter > QUIET * np.mean(energy[~still]):
        return np.zeros(len(energy), dtype=bool)
    return still
