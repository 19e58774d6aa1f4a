"""The turns of a record in periodic trim.

In trim inputs rest, and outputs repeat themselves: turns after a motion do only when it has died
away. What two groups of turns differ by is told from noise by Dempster's test, which takes turns
as vectors of more entries than there are turns:

    F = |ȳ₁ − ȳ₂|² / ((1/n₁ + 1/n₂) tr S),   F(r, r (n₁ + n₂ − 2)),   r = (tr Σ)² / tr Σ²

The analyzer needs it.

References: Dempster (1960), A significance test for the separation of two highly multivariate
small samples, Biometrics 16(1), 41-50; r by Bai and Saranadasa (1996), Statistica Sinica 6.

When inputs rest: turns in which they do nothing but noise.

Inputs of a record in flight rest but for noise; no turn is exactly still. What an input does is
its change from a turn before, d_i, which no constant and no waveform of the turn has:

    e_k = Σ_i Σ_turn k d_i(ψ)² / Σ_record d_i(ψ)²,   rests: e_k ≤ 4 × the mean of the quieter half

if what the others hold, turn for turn, is a hundred times that mean. How long a record rests does
not matter. The analyzer needs it to choose how a record is read, the period reading to find free
decays.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f

from sklearn_hd.algorithms.linalg.rounding import HALF
from sklearn_hd.algorithms.signals.resampling import interpolate

LEVEL = 1e-3  # of tests: share of noise taken for a drift, or of linear machines for others
NOTABLE = 1e-3  # of the energy of the motion: a drift of 3 % of it
DUST = 1e-4  # of a signal, that splines through 7 samples a turn may miss
LEAST_TURNS = 12  # of which some rest: fewer tell no Poincaré map
LIKE = 4.0  # times the mean of the quieter half: what noise gives in no turn
QUIET = 0.01  # of the energy of a turn that moves, which one at rest may hold
TURN = 2.0 * np.pi


def changes(values, psi):
    """Signals of one segment less those a turn before; in its first half, a turn after.

    ``psi`` grows, in rad. Changes are zero in a segment of less than two turns.
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

    It returns the energy (n_turns_s,) of the turns of each segment that hold samples,
    counted from its first one, and which of them each sample lies in.
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

    ``psi`` grows, in rad. Segments of less than two turns tell nothing. It is False for
    inputs that never move at all, and for fewer than twelve turns.

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


def rests(energy, least=0.5):
    """Which turns are at rest.

    ``energy`` is that of what inputs do in each turn. ``least`` is the share of the
    turns that are judged by: the quietest. No turn is at rest where these move, too, or
    nothing does.

    Examples
    --------
    >>> rests(np.array([1e-6, 1e-6, 2e-6, 1.0, 0.5, 1e-6, 1e-6])).tolist()
    [True, True, True, False, False, True, True]
    >>> bool(rests(np.array([0.7, 1.0, 0.9, 0.8])).any())
    False
    """
    quieter = np.mean(np.sort(energy)[: max(1, int(least * len(energy)))])
    still = energy <= max(LIKE * quieter, HALF**2 * np.max(energy))
    if still.all() or quieter > QUIET * np.mean(energy[~still]):
        return np.zeros(len(energy), dtype=bool)
    return still


def turns_at_rest(inputs):
    """Whole turns of each segment in which inputs repeat those of the turn before.

    Of inputs (n_turns_s, samples_per_turn, m), a bool for each turn.
    """
    if not sum(map(len, inputs)):
        return [np.zeros(0, dtype=bool) for _ in inputs]
    moves, psi = [], []
    for u in inputs:
        n, q, m = u.shape
        before = np.minimum(np.abs(np.arange(n) - 1), n - 1)  # of the first turn the one after it
        moves.append((u - u[before]).reshape(n * q, m))
        psi.append(TURN * np.arange(n * q) / q)
    energy = np.concatenate(energy_by_turn(moves, psi)[0])
    still = rests(energy) | (energy <= QUIET * np.mean(energy))
    return np.split(still, np.cumsum([len(u) for u in inputs])[:-1])


def in_trim(inputs, outputs):
    """Whole turns of each segment in which inputs rest and outputs repeat themselves.

    Of turns at rest that begin a segment all, or the later half; of those that follow on a motion
    the later half, if the motion has died away by then, and noise would not hide that it has not:
    the mean waveform has to be known to a tenth of the motion. The trim are those in which outputs
    are zero, else those that begin a segment and are known as well, else the most at one level of
    the inputs: others are another orbit's.

    Inputs and outputs have an array (n_turns_s, samples_per_turn, n_signals) a segment.
    No turn is in trim where nothing rests.
    """
    motions = [motion_of(signals) for signals in (inputs, outputs)]
    groups, memory = [], 0
    for s, still in enumerate(turns_at_rest(inputs)):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            later = (start + stop) // 2
            for begin in (later,) if start else (0, later):
                own = [signals[s][begin:stop] for signals in (inputs, outputs)]
                off = max(drift(*each) for each in zip(own, motions, strict=True))
                seen = not begin or max(map(_uncertainty, own, motions)) <= QUIET
                if stop - begin > 1 and off <= NOTABLE and seen:
                    groups.append(_Group(s, slice(begin, stop), begin > 0, off, own))
                    break
            else:
                memory = max(memory, stop - later)
    # what a longer wait has not settled, a shorter one has not
    groups = [g for g in groups if not g.waited or g.size > memory]
    found = [np.zeros(len(u), dtype=bool) for u in inputs]
    if groups:
        most = max(groups, key=lambda g: (g.is_zero(motions[1]), g.is_start(motions), g.size))
        for g in groups:
            apart = [_gap(*each) for each in zip(most.signals, g.signals, motions, strict=True)]
            found[g.segment][g.turns] = g is most or (g.drift == 0.0 and not any(apart))
    return found


@dataclass(frozen=True, eq=False)
class _Group:
    """Consecutive turns in which inputs rest and outputs may: after a wait, or from the first."""

    segment: int
    turns: slice
    waited: bool
    drift: float
    signals: list

    @property
    def size(self):
        return self.turns.stop - self.turns.start

    def is_start(self, motions):
        """Whether a segment begins with them, and noise leaves their mean known."""
        return not self.waited and max(map(_uncertainty, self.signals, motions)) <= QUIET

    def is_zero(self, motion):
        """Whether the outputs' mean is next to nothing."""
        return np.sum(_rows(self.signals[1], motion).mean(axis=0) ** 2) <= NOTABLE


def motion_of(signals):
    """Energy of each signal about its mean waveform, a turn.

    Each segment has an array (n_turns_s, samples_per_turn, n_signals).
    """
    stacked = np.concatenate(signals)
    if not len(stacked):
        return np.zeros(stacked.shape[-1])
    return np.mean(np.sum((stacked - stacked.mean(axis=0)) ** 2, axis=1), axis=0)


def drift(turns, motion):
    """How much further from where some turns end their first half is than their second.

    In parts of the energy of the motion; zero where it may be noise.

    ``turns`` have shape (n_turns, samples_per_turn, n_signals), and ``motion`` is as
    :func:`motion_of` has it.

    Examples
    --------
    A decay, and what is left of it:

    >>> turns = 0.5 ** np.arange(40.0)[:, None, None]
    >>> [float(f"{drift(part, np.ones(1)):.1g}") for part in (turns[:20], turns[20:])]
    [0.1, 1e-13]
    """
    rows, half = _rows(turns, motion), len(turns) // 2
    if half == 0:
        return 0.0
    first, later = rows[:half], rows[len(rows) - half :]
    before, after = (np.mean(np.sum((z - later.mean(axis=0)) ** 2, axis=1)) for z in (first, later))
    if half > 1:
        r = _freedom(later - later.mean(axis=0), half - 1)
        ratio = before / (half + 1) * (half - 1) / max(after, 1e-300)
        if f.sf(ratio, r * half, r * (half - 1)) >= LEVEL:
            return 0.0
    return float(before)


def stands_out(turns, motion):
    """Whether the mean waveform of some turns is more than their noise, and than their drift.

    Arguments are as for :func:`drift`.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal((9, 16, 1))
    >>> wave = np.cos(np.arange(16) * np.pi / 8)[:, None]
    >>> stands_out(noise, np.ones(1)), stands_out(noise + wave, np.ones(1))
    (False, True)
    """
    rows = _rows(turns, motion)
    mean = rows.mean(axis=0)
    told = _significant(mean, 1.0 / len(rows), [rows])
    return bool(told and np.sum(mean**2) > drift(turns, motion))


def _rows(turns, motion):
    """Turns as rows, each signal in parts of its motion."""
    rows = turns / np.sqrt(np.where(motion > 0.0, motion, 1.0))
    return rows.reshape(len(turns), turns[:1].size)


def _uncertainty(turns, motion):
    """Of the mean waveform of some turns, by their scatter, in parts of the motion's energy."""
    return float(np.sum(_rows(turns, motion).var(axis=0))) / max(len(turns) - 1, 1)


def _gap(first, other, motion):
    """Energy of what the means of two groups of turns differ by; zero where it may be noise."""
    first, other = (_rows(turns, motion) for turns in (first, other))
    apart = other.mean(axis=0) - first.mean(axis=0)
    told = _significant(apart, 1.0 / len(first) + 1.0 / len(other), [first, other])
    return float(np.sum(apart**2)) if told else 0.0


def _significant(difference, share, groups):
    """Whether a difference of means, of a share of the variance of a turn, is more than noise."""
    rest = np.vstack([rows - rows.mean(axis=0) for rows in groups])
    dof, energy = len(rest) - len(groups), np.sum(difference**2)
    trace = np.sum(rest**2) / max(dof, 1)
    if not energy * HALF**2 < trace:  # next to which nothing is left
        return energy > 0.0
    r = _freedom(rest, dof)
    return f.sf(energy / (share * trace), r, r * dof) < LEVEL


def _freedom(rest, dof):
    """r of the noise that some rows are: unbiased for tr Σ² of normal ones."""
    gram = rest @ rest.T / dof
    trace, square = np.trace(gram), np.sum(gram**2)
    square = (square - trace**2 / dof) * dof**2 / ((dof + 2.0) * max(dof - 1.0, 0.5))
    return np.clip(trace**2 / max(square, 1e-300), 1.0, rest.shape[1])
