"""Inputs whose record tells Floquet exponents best.

From rest the sensitivities J = ∂ŷ/∂θ of a linear system are linear in its inputs u, so the Fisher
matrix and the Cramér-Rao bound of the exponents λ(θ) follow for any u before it is flown:

    I(u) = J(u)ᵀ Σ⁻¹ J(u),    I(a u) = a² I(u),    σ_i(u)² = |∂λ_i/∂θ|² in I(u)⁻¹

with the initial state eliminated, as an experiment does not know it. The inputs sought minimise

    cost(u) = mean_i log σ_i(u)

the logarithm of the geometric mean of the deviations, which no unit of time changes. Levels are
bounded by ±1 and their energy Σ u² by some budget: u is scaled down to it, which multiplies all
σ by the same factor.

The cost has many valleys. The search is an exchange (Fedorov, 1972): from the best of some usual
inputs one edge, one level, one line of a spectrum is changed at random at a time, and kept
where the cost falls. It ends in a local optimum. ``sklearn_hd.design.design_input`` needs this.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.predictor import as_records, output_sensitivities
from sklearn_hd.algorithms.likelihood.uncertainty import (
    exponent_slopes,
    fisher_information,
    propagate_std,
)
from sklearn_hd.algorithms.linalg.rounding import EPS

STEPS_3211 = (1.0, 1.0, 1.0, -1.0, -1.0, 1.0, -1.0)
BANDS = (0.25, 0.5, 1.0, 2.0)  # cycles a period, up to which spectra to start from are flat
MOST_LINES = 40  # of a spectrum: more take a longer search
LEVELS = np.array([-1.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class ExponentBound:
    """Cramér-Rao bound of the exponents for any records of a system that starts about rest."""

    form: Form
    theta: np.ndarray  # (k,)
    sigma: np.ndarray  # (l,): standard deviations of the outputs' noise

    @cached_property
    def _slopes(self):
        exponents, slopes = exponent_slopes(self.form, self.theta)
        unseen = len(self.theta) - slopes.shape[1]  # loads, which move no exponent
        return exponents, np.pad(slopes, [(0, 0), (0, max(0, unseen))])

    @property
    def exponents(self):
        """From the rightmost leftwards, complex, 1/s."""
        return self._slopes[0]

    def information(self, segments):
        """Of θ, as :class:`~.uncertainty.FisherInformation` has it."""
        return fisher_information(self.form, self.theta, segments, self.sigma)

    def std(self, segments):
        """Smallest standard deviations of exponents that segments (inputs, outputs, where) allow.

        They are complex (n,): the deviation of the real part + j times that of the
        imaginary part. They are infinite where not determined.
        """
        return self.std_of(self.information(segments))

    def std_of(self, found):
        """The same from the information of θ."""
        return propagate_std(self._slopes[1], found.covariance)

    def cost(self, inputs, which=slice(None)):
        """Mean logarithm of the deviations of some exponents; infinite where one is unknown."""
        with np.errstate(over="ignore", invalid="ignore"):
            std = np.abs(self.std([(inputs, None, 0)])[which])
        if not (np.all(np.isfinite(std)) and np.all(std > 0.0)):
            return np.inf
        return float(np.mean(np.log(std)))

    def doubts(self, found, pulses):
        """What is not known of the motion that pulses make, in parts of it.

        It is the root mean square of the motion's deviation, outputs in parts of their
        noise, for each of the pulses (n_samples, m). ``found`` is the information on θ.
        Nothing is known of a motion with a doubt beyond 1. The doubt is NaN where a
        pulse moves nothing.
        """
        size = np.sqrt(np.diag(found.information))
        size = np.where(size > 0.0, size, 1.0)
        strength, directions = linalg.eigh(found.information / np.outer(size, size))
        least = len(size) * EPS * strength[-1]  # below it a direction's own is rounding
        root = directions / np.sqrt(np.maximum(strength, least)) / size[:, None]
        response = self.form.response(self.theta, sensitivities=True)
        doubts = []
        for u in pulses:
            (record,) = as_records([(u, None, 0)], self.form.n_outputs)
            start = np.zeros(self.form.n_states)
            pieces = output_sensitivities(response, record, start, free_x0=False)
            dy = np.concatenate([dy for _, _, dy in pieces], axis=1) / self.sigma
            moved = dy.reshape(len(dy), -1)
            spread, motion = np.linalg.norm(moved[:-1].T @ root), np.linalg.norm(moved[-1])
            doubts.append(spread / motion if motion > 0.0 else np.nan)
        return np.array(doubts)


def exchange(family, cost, n_trials, rng):
    """The best member of a family that changes of one part at a time lead to.

    ``cost(inputs)`` takes inputs as the family, Steps or Multisines, makes them. It
    returns the best member, its cost, and the number of evaluations. The cost is
    infinite where no member tells anything.

    Examples
    --------
    Levels that are most like some others, held over steps of 4 rows:

    >>> wanted = np.repeat([1.0, 0.0, -1.0, 0.0], 4)[:, None]
    >>> rng = np.random.RandomState(0)
    >>> best, left, _ = exchange(Steps(16, 1, 4), lambda u: np.sum((u - wanted) ** 2), 300, rng)
    >>> bool(np.all(best == wanted)), float(left)
    (True, 0.0)
    """
    members = list(family.starts(rng))
    costs = [cost(family.inputs(member)) for member in members]
    first = int(np.argmin(costs))
    best, lowest = members[first], costs[first]
    for _ in range(n_trials if np.isfinite(lowest) else 0):
        trial = family.changed(best, rng)
        reached = cost(family.inputs(trial))
        if reached < lowest:
            best, lowest = trial, reached
    return best, lowest, len(members) + n_trials


@dataclass(frozen=True)
class Steps:
    """Inputs held at −1, 0 or 1 between edges that are free."""

    n_rows: int
    n_inputs: int
    per_period: int  # rows of a period

    def starts(self, rng):
        """Doublets, 3-2-1-1 and random steps of several widths, (n_rows, n_inputs) each."""
        for periods in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0):  # that a step lasts
            width = max(1, round(periods * self.per_period))
            if 2 * width > self.n_rows:
                break
            for pattern in ((1.0, -1.0), STEPS_3211):
                steps = np.repeat(pattern, width)
                yield self._one_after_the_other(steps[: self.n_rows])
                yield self._one_after_the_other(np.resize(steps, self.n_rows))
            count = -(-self.n_rows // width)
            signs = rng.choice([-1.0, 1.0], (count, self.n_inputs))
            yield np.repeat(signs, width, axis=0)[: self.n_rows]

    def _one_after_the_other(self, steps):
        """The same steps for each input, later by equal parts of the rows."""
        levels = np.zeros((self.n_rows, self.n_inputs))
        for j in range(self.n_inputs):
            first = j * self.n_rows // self.n_inputs
            levels[first : first + len(steps), j] = steps[: self.n_rows - first]
        return levels

    def changed(self, levels, rng):
        """With one edge moved, or some rows of one input at another level."""
        levels, j = levels.copy(), rng.randint(self.n_inputs)
        column = levels[:, j]
        edges = np.flatnonzero(np.diff(column)) + 1
        kind = rng.randint(3) if len(edges) else 2
        ends = np.concatenate([[0], edges, [self.n_rows]])
        if kind == 0:
            at = rng.randint(len(edges)) + 1
            edge = ends[at] + rng.choice([-1, 1]) * 2 ** rng.randint(5)
            edge = int(np.clip(edge, ends[at - 1], ends[at + 1]))
            before, after = column[ends[at] - 1], column[ends[at]]
            column[ends[at] : edge], column[edge : ends[at]] = before, after
            return levels
        if kind == 1:
            at = rng.randint(len(edges) + 1)
            start, stop = ends[at], ends[at + 1]
        else:
            width = int(np.exp(rng.uniform(0.0, np.log(max(2, self.n_rows // 2)))))
            start = rng.randint(self.n_rows)
            stop = start + width
        others = LEVELS[column[start] != LEVELS]
        column[start:stop] = others[rng.randint(2)]
        return levels

    def inputs(self, levels, finer=1):
        """Levels at each row, or at more rows a period."""
        return np.repeat(levels, finer, axis=0)


@dataclass(frozen=True)
class Multisines:
    """Inputs made of lines that are harmonics of the whole, of largest value 1."""

    n_rows: int
    n_inputs: int
    per_period: int  # rows of a period

    @cached_property
    def lines(self):
        """Cycles over all rows."""
        most = max(1, int(min(BANDS[-1] * self.n_rows / self.per_period, (self.n_rows - 1) // 2)))
        return np.unique(np.round(np.linspace(1, most, min(most, MOST_LINES)))).astype(int)

    def starts(self, rng):
        """Flat spectra up to several frequencies, (amplitudes, phases) of each line and input."""
        shape, flat = (len(self.lines), self.n_inputs), np.arange(len(self.lines))
        for band in BANDS:
            kept = self.lines <= max(band * self.n_rows / self.per_period, self.lines[0])
            amplitudes = np.repeat(np.where(kept, 1.0, 0.0)[:, None], self.n_inputs, axis=1)
            schroeder = -np.pi * flat * (flat + 1) / max(1, np.sum(kept))  # low peaks
            yield amplitudes, schroeder[:, None] * (1.0 + np.arange(self.n_inputs))
            for _ in range(2):
                yield amplitudes, rng.uniform(0.0, 2.0 * np.pi, shape)

    def changed(self, member, rng):
        """With the amplitude or the phase of one line changed."""
        amplitudes, phases = (part.copy() for part in member)
        at = rng.randint(len(self.lines)), rng.randint(self.n_inputs)
        if rng.randint(2) and amplitudes[at] > 0.0:
            phases[at] = rng.uniform(0.0, 2.0 * np.pi)
        elif amplitudes[at] == 0.0:
            amplitudes[at] = rng.choice([0.5, 1.0, 2.0])
        else:
            amplitudes[at] *= rng.choice([0.0, 0.5, 2.0])
        return amplitudes, phases

    def inputs(self, member, finer=1):
        """Values at each row, or at more rows a period."""
        amplitudes, phases = member
        angle = 2.0 * np.pi * np.arange(self.n_rows * finer) / (self.n_rows * finer)
        cosines, sines = (wave(np.outer(angle, self.lines)) for wave in (np.cos, np.sin))
        u = cosines @ (amplitudes * np.cos(phases)) - sines @ (amplitudes * np.sin(phases))
        largest = np.max(np.abs(u), axis=0)
        return u / np.where(largest > 0.0, largest, 1.0)
