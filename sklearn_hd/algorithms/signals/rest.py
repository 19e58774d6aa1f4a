"""When inputs rest: turns in which they do nothing but noise.

Inputs of a record in flight rest but for noise; no turn is exactly still. Of turns whose quieter
half holds next to nothing of what the inputs do, those like that half are at rest:

    e_k = Σ_i Σ_turn k d_i(ψ)² / Σ_record d_i(ψ)²,   rests: e_k ≤ 4 × the mean of the quieter half

The analyzer needs it to choose how a record is read, the period reading to find free decays.
"""

import numpy as np

from sklearn_hd.algorithms.linalg.rounding import HALF

__all__ = ["changes", "energy_by_turn", "rests"]

QUIET = 0.01  # of the energy, that the quieter half of the turns may hold where inputs rest
LIKE = 4.0  # times the mean of the quieter half: what noise gives in no turn


def changes(values, psi):
    """Signals of one segment less those a turn before; of the first turn, a turn after.

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
    turn = 2.0 * np.pi
    if len(psi) < 2 or psi[-1] - psi[0] < 2.0 * turn:
        return np.zeros(values.shape)
    other = np.where(psi - psi[0] < turn, psi + turn, psi - turn)
    return values - np.stack([np.interp(other, psi, column) for column in values.T], axis=1)


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
        Of the turns of each segment, from its first sample.
    turns : list of ndarray of int, shapes (n_samples_s,)
        Which of them each sample lies in.
    """
    largest = np.max([np.max(np.abs(each), axis=0, initial=0.0) for each in signals], axis=0)
    signals = [each / np.where(largest > 0.0, largest, 1.0) for each in signals]
    whole = sum(np.sum(each**2, axis=0) for each in signals)
    weights = np.where(whole > 0.0, 1.0 / np.where(whole > 0.0, whole, 1.0), 0.0)
    turns = [((p - p[:1]) / (2.0 * np.pi) + HALF).astype(int) for p in psi]
    parts = zip(signals, turns, strict=True)
    return [np.bincount(k, each**2 @ weights) for each, k in parts], turns


def rests(energy):
    """Which turns are at rest.

    Parameters
    ----------
    energy : ndarray, shape (n_turns,)
        Of what inputs do in each.

    Returns
    -------
    rests : ndarray of bool, shape (n_turns,)
        False throughout where the quieter half of the turns moves, too.

    Examples
    --------
    >>> rests(np.array([1e-6, 1e-6, 2e-6, 1.0, 0.5, 1e-6, 1e-6])).tolist()
    [True, True, True, False, False, True, True]
    >>> bool(rests(np.array([0.7, 1.0, 0.9, 0.8])).any())
    False
    """
    quieter = np.sort(energy)[: max(1, len(energy) // 2)]
    if not np.sum(quieter) < QUIET * np.sum(energy):
        return np.zeros(len(energy), dtype=bool)
    return energy <= max(LIKE * np.mean(quieter), HALF**2 * np.max(energy))
