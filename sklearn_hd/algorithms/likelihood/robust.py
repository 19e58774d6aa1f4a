"""Deviations that hold where what a fit leaves is no white noise, or the system not linear.

At the optimum θ̂ the scores s_c = −J_cᵀ r_c of some parts c of the record sum to zero. White noise
gives them the covariance of the information I_c = J_cᵀ J_c that the parts hold. For one quantity
λ = gᵀθ, with v = I⁻¹ g, a part by itself would put λ at

    λ̂_c = λ̂ + (vᵀ s_c) gᵀv / (vᵀ I_c v)     ± gᵀv / √(vᵀ I_c v),

and λ̂ is their mean, weighed by vᵀ I_c v. Of blocks in time the scores themselves give the
covariance, whatever colours the noise (the sandwich I⁻¹ Σ s_b s_bᵀ I⁻¹). Of parts that differ in
the size or the direction of the motion they tell whether one linear model holds for all: where
they differ by more than their deviations, their spread is that of λ (DerSimonian and Laird, 1986).

References: H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50
(1982); W. K. Newey, K. D. West, "A simple, positive semi-definite, heteroskedasticity and
autocorrelation consistent covariance matrix", Econometrica 55 (1987).
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.signal import welch
from scipy.stats import chi2

N_BLOCKS = 40  # of a record, in time
LEVELS = 3  # of the size of the motion, of which each holds as much of its square
FEWEST = 10  # rows of a block
N_STRETCHES = 8  # of a segment, half over each other, whose periodograms are averaged
BY_CHANCE = 0.01  # of spectra of white noise have a larger peak than is taken for none


@dataclass(frozen=True, eq=False)
class Parts:
    """Scores and information of the parts of a record.

    Attributes
    ----------
    scores : ndarray, shape (c, k)
    information : ndarray, shape (c, k, k)
    """

    scores: np.ndarray
    information: np.ndarray

    def sandwich(self, covariance):
        """Covariance of θ from the scores of blocks in time, neighbours at half their weight."""
        s = self.scores - self.scores.mean(axis=0)
        beside = 0.5 * s[1:].T @ s[:-1]
        meat = (s.T @ s + beside + beside.T) * len(s) / max(1, len(s) - 1)
        return covariance @ meat @ covariance

    def compared(self, covariance, gradients, excess):
        """What each part would have some quantities be, against each other.

        Parameters
        ----------
        covariance : ndarray, shape (k, k)
            Of θ, if white noise is left.
        gradients : ndarray, shape (r, k)
            Of the quantities.
        excess : ndarray, shape (r,)
            Their variance in parts of that of white noise.

        Returns
        -------
        comparison : Comparison
        """
        v = gradients @ covariance
        size = np.einsum("rk,rk->r", v, gradients)
        told = np.einsum("rk,ckj,rj->rc", v, self.information, v)
        pull = v @ self.scores.T
        weight = np.where(told > 0.0, told, np.inf)
        statistic = np.sum(pull**2 / weight, axis=1) / excess
        degrees, total = max(1, len(self.scores) - 1), told.sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = excess * (statistic - degrees) * size**2
            spread = spread / (total - np.sum(told**2, axis=1) / total)
        spread = np.where(np.isfinite(spread), np.maximum(spread, 0.0), 0.0)
        return Comparison(pull * size[:, None] / weight, spread, chi2.sf(statistic, degrees))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Quantities as the parts of a record tell them.

    Attributes
    ----------
    offsets : ndarray, shape (r, c)
        From the estimate of all.
    variance : ndarray, shape (r,)
        Between the parts, beyond what noise explains.
    p_value : ndarray, shape (r,)
    """

    offsets: np.ndarray
    variance: np.ndarray
    p_value: np.ndarray


def part_scores(problem, point, divisions):
    """Scores and information of the parts of several divisions of a record.

    Parameters
    ----------
    problem : Problem
    point : Point
        Where a search ended.
    divisions : dict of list of ndarray of int, shapes (n_samples,)
        Part of each row of each record.

    Returns
    -------
    parts : dict of Parts
    """
    spread = problem.spread(point.moments)
    system = problem.linearise(point, spread)
    width = system.R.shape[1]
    sums = {
        name: np.zeros((1 + max(int(part.max()) for part in parts), width, width))
        for name, parts in divisions.items()
    }
    for segment, begin, block in problem.whitened(point, spread):
        states = system.states[segment]
        start = block[: len(block) - width]
        rest = block[len(block) - width :]
        if len(start):
            rest = rest - np.tensordot(states.T, start, 1)
        for name, parts in divisions.items():
            which = parts[segment][begin : begin + rest.shape[1]]
            for part in np.unique(which):
                some = rest[:, which == part].reshape(width, -1)
                sums[name][part] += some @ some.T
    return {name: Parts(-G[:, :-1, -1], G[:, :-1, :-1]) for name, G in sums.items()}


def whole_covariance(result):
    """Covariance of all parameters, gain and loads included, if white noise is left."""
    problem, point = result.problem, result.point
    covariance, _ = problem.linearise(point).covariance(gauge=True)
    return covariance * result.correction


def spectral_peak(segments):
    """The largest part of a spectrum over its mean, beyond what chance makes of white noise.

    By the mean periodogram of eight stretches of the longest segment, half over each other
    (Welch, 1967): of white noise it is χ² with 36 K² / (19 K − 1) degrees of freedom.

    Parameters
    ----------
    segments : list of ndarray, shapes (n_samples_s, l)

    Returns
    -------
    peak : float
        The largest of all outputs, at least 1; 1 where a segment is too short to tell.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal((4000, 1))
    >>> wave = 3.0 * np.cos(np.arange(4000) * 0.3)[:, None]
    >>> round(spectral_peak([noise]), 1), round(spectral_peak([noise + wave]))
    (1.0, 62)
    """
    rows = max(segments, key=len)
    length = 2 * len(rows) // (N_STRETCHES + 1)
    if length < FEWEST:
        return 1.0
    _, spectrum = welch(rows, nperseg=length, detrend="constant", axis=0)
    spectrum, degrees = spectrum[1:], 36.0 * N_STRETCHES**2 / (19.0 * N_STRETCHES - 1.0)
    mean = spectrum.mean(axis=0)
    shares = spectrum.max(axis=0) / np.where(mean > 0.0, mean, np.inf)
    chance = chi2.isf(BY_CHANCE / len(spectrum), degrees) / degrees
    return float(max(1.0, np.max(shares, initial=0.0) / chance))


def blocks_in_time(motions):
    """Part of each row: some forty blocks of rows that follow each other, none over two records.

    Each holds as much of the motion's square, and with it of what the record tells.
    """
    squares = [np.sum(each, axis=1) for each in _squares(motions)]
    total, rows = sum(map(np.sum, squares)) or 1.0, sum(map(len, squares))
    first, found = 0, []
    for square in squares:
        weight = square / total + 1.0 / rows  # where nothing moves, too
        count = max(1, min(round(N_BLOCKS * np.sum(weight) / 2.0), len(square) // FEWEST))
        held = np.cumsum(weight) / np.sum(weight)
        found.append(first + np.minimum((held * count).astype(int), count - 1))
        first += count
    return found


def _squares(motions):
    """Squares of motions in parts of their mean."""
    size = np.mean(np.concatenate(motions) ** 2, axis=0)
    return [each**2 / np.where(size > 0.0, size, 1.0) for each in motions]


def by_size(motions, window):
    """Part of each row: thirds of the motion's square, by its size over some rows."""
    squares = [
        uniform_filter1d(np.mean(square, axis=1), window, mode="nearest")
        for square in _squares(motions)
    ]
    ordered = np.sort(np.concatenate(squares))
    held = np.cumsum(ordered)
    edges = ordered[np.searchsorted(held, held[-1] * np.arange(1, LEVELS) / LEVELS)]
    return [np.searchsorted(edges, each) for each in squares]


def by_direction(motions):
    """Part of each row: on which side of its middle the motion is, along its largest extent."""
    size = np.sqrt(np.mean(np.concatenate(motions) ** 2, axis=0))
    scaled = [motion / np.where(size > 0.0, size, 1.0) for motion in motions]
    along = np.linalg.eigh(sum(each.T @ each for each in scaled))[1][:, -1]
    return [(each @ along > 0.0).astype(int) for each in scaled]
