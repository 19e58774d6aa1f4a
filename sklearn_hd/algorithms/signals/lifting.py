"""Periodic systems seen once a period: lifted signals and the directions inputs take.

Sampled once a period, a linear time-periodic system is time-invariant, its inputs and
outputs being all the samples of the period (the lifted signals):

    z[k+1] = Φ z[k] + B w[k],    y_j[k] = O_j z[k] + D_j w[k]     (sample j of period k)

w holds an input's samples of a whole period. Mostly they move in few directions (a step at
a period's start in one, at any other phase in two), and only those have to be told apart.
The period-synchronous reading and match need them.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import HALF, UNKNOWN


def lift(values, phase, samples_per_period):
    """Whole periods of a segment, one a row.

    Parameters
    ----------
    values : ndarray, shape (n_samples, n_signals)
    phase : ndarray of int, shape (n_samples,)
        Sample within the period of each row; consecutive.
    samples_per_period : int

    Returns
    -------
    lifted : ndarray, shape (n_periods, samples_per_period, n_signals)
        From the first ψ = 0.

    Examples
    --------
    >>> lift(np.arange(6.0)[:, None], np.array([1, 0, 1, 0, 1, 0]), 2)[:, :, 0].tolist()
    [[1.0, 2.0], [3.0, 4.0]]
    """
    spp = samples_per_period
    first = int(-phase[0] % spp) if len(phase) else 0
    n_periods = max(0, len(values) - first) // spp
    return values[first : first + n_periods * spp].reshape(n_periods, spp, values.shape[1])


def input_directions(lifted, most=None):
    """Inputs of each period in the fewest directions, the strongest first.

    Each input counts in parts of its root mean square. Directions no stronger than white
    noise on the inputs would give are left out, where the weaker half of all looks like
    such noise and it holds but little energy.

    Parameters
    ----------
    lifted : list of ndarray, shapes (n_periods_s, samples_per_period, m)
    most : int, optional
        Largest number of directions kept.

    Returns
    -------
    directions : list of ndarray, shapes (n_periods_s, r)
        Uncorrelated, of mean square one over all periods.
    n_all : int
        Directions that the inputs move in, except for noise.
    left_out : float
        Share of the inputs' energy in directions not kept.

    Examples
    --------
    A step at a period's start moves in one direction, one in mid-period in another, too:

    >>> u = np.repeat([0.0, 1.0], [5, 7])[:, None]
    >>> input_directions([lift(u, np.arange(12) % 4, 4)])[1]
    2
    """
    stacked = np.concatenate(lifted)
    largest = np.max(np.abs(stacked), axis=(0, 1), initial=0.0)
    if not largest.any():
        return [np.zeros((len(block), 0)) for block in lifted], 0, 0.0
    stacked = stacked / np.where(largest > 0.0, largest, 1.0)
    size = np.sqrt(np.mean(stacked**2, axis=(0, 1)))
    stacked = (stacked / np.where(size > 0.0, size, 1.0)).reshape(len(stacked), -1)
    U, s, _ = linalg.svd(stacked, full_matrices=False)
    n_all = int(np.sum(s > max(1e-10 * s[0], _noise_level(s, stacked.shape))))
    kept = n_all if most is None else min(n_all, most)
    W = U[:, :kept] * np.sqrt(len(stacked))
    edges = np.cumsum([len(block) for block in lifted])[:-1]
    return np.split(W, edges), n_all, float(np.sum(s[kept:] ** 2) / np.sum(s**2))


@dataclass(frozen=True, eq=False)
class InputDirections:
    """What inputs moved in: combinations of their samples within a row.

    Attributes
    ----------
    size : ndarray, shape (m,)
        Root mean square of each input; one where it is zero.
    moved : ndarray, shape (n_phases m, r)
        Orthonormal, of inputs in parts of their size.
    """

    size: np.ndarray
    moved: np.ndarray

    @classmethod
    def of(cls, lifted, left_out=0.0):
        """Of rows of one sample or more, the strongest.

        Parameters
        ----------
        lifted : list of ndarray, shapes (n_rows_s, n_phases, m)
        left_out : float, default=0.0
            Share of the energy, noise say, that may lie in directions left out. What is but
            rounding is left out in any case.
        """
        stacked = np.concatenate(lifted)
        size = np.max(np.abs(stacked), axis=(0, 1), initial=0.0)
        size = np.where(size > 0.0, size, 1.0)
        size = size * np.sqrt(np.mean((stacked / size) ** 2, axis=(0, 1)))
        size = np.where(size > 0.0, size, 1.0)
        flat = (stacked / size).reshape(len(stacked), -1)
        R = linalg.qr(flat, mode="r")[0][: flat.shape[1]]
        _, s, Vt = linalg.svd(R, full_matrices=False)
        beyond = np.cumsum(s[::-1] ** 2)[::-1]  # in this direction and weaker ones
        return cls(size, Vt[(s > HALF * s[0]) & (beyond > left_out * beyond[0])].T)

    def outside(self, lifted):
        """Share of the energy of some inputs that moves otherwise, and each input's part of it.

        Parameters
        ----------
        lifted : list of ndarray, shapes (n_rows_s, n_phases, m)

        Returns
        -------
        share : float
        each : ndarray, shape (m,)

        Examples
        --------
        >>> row = np.array([[[0.0], [0.0], [1.0], [1.0]]])
        >>> InputDirections.of([np.ones((1, 4, 1))]).outside([row])[0]
        0.5
        """
        stacked = np.concatenate(lifted) / self.size
        flat = stacked.reshape(len(stacked), -1)
        rest = flat - (flat @ self.moved) @ self.moved.T
        each = np.sum(rest.reshape(stacked.shape) ** 2, axis=(0, 1))
        energy = np.sum(flat**2)
        return float(np.sum(each) / energy) if energy > 0.0 else 0.0, each

    @property
    def together(self):
        """Inputs of which some combination never moved, places in ascending order."""
        idle = np.eye(len(self.moved)) - self.moved @ self.moved.T
        part = np.sqrt(np.maximum(np.diag(idle), 0.0)).reshape(-1, len(self.size))
        return np.flatnonzero(part.max(axis=0) > UNKNOWN)


def _noise_level(singular_values, shape):
    """Largest singular value of white noise whose smaller half these are; 0 if it is signal."""
    if len(singular_values) < 8:  # too few to see a level of noise from
        return 0.0
    weaker = singular_values[len(singular_values) // 2 :]
    sigma = np.sqrt(np.mean(weaker**2) / max(shape))
    level = 1.5 * sigma * (np.sqrt(shape[0]) + np.sqrt(shape[1]))
    below = np.sum(singular_values[singular_values <= level] ** 2)
    return level if below < 0.1 * np.sum(singular_values**2) else 0.0
