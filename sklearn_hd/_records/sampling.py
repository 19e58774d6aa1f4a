"""From the user's rows to the uniform grid that is analysed, and back.

Analysis, identification and simulation need rows that are evenly spaced in
time, or in azimuth over the mean speed where a rotor's speed varies. One
mechanism serves every record that is not so:

1. every row of the user's has a *place*: its time t, or ψ/ω with ω the mean
   speed, so that one period is one turn whatever the speed;
2. rows with missing samples are taken out; what is left of each segment is a
   *piece*;
3. a piece whose places are one grid step apart is its own grid, and its values
   pass unchanged, bit by bit. Any other (an azimuth, jitter, or no whole number
   of samples in a period) gets the multiples of the grid step that lie within
   it, and its signals are resampled onto them: held inputs by their means, all
   else by splines, outputs about their mean waveform of the turn: it is known at
   every azimuth, and may be a thousand times what moves about it;
4. all that comes out, coefficients and predictions, is brought back to the
   user's own rows by the same splines; rows in no piece get NaN.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from sklearn_hd._checks import RAISE, at
from sklearn_hd._clock import TimeBase, even, resolution
from sklearn_hd._guards import searching, warn
from sklearn_hd.algorithms.linalg.rounding import RANK
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.signals.fourier import MOST_ROWS, ROWS_PER_COLUMN, standing_lines
from sklearn_hd.algorithms.signals.resampling import (
    held_means,
    interpolate,
    interpolation_error,
    uniform_grid,
)
from sklearn_hd.exceptions import IdentifiabilityWarning, ResamplingWarning

MOST_HARMONICS = 50  # of a mean waveform
NEARBY = 8  # rows before and after, beside which an outlier stands out
STANDS_OUT = 6.0  # times their largest second difference


@dataclass(frozen=True, eq=False)
class Piece:
    """Consecutive rows of the user's without missing samples, and their grid."""

    rows: slice  # the user's rows
    places: np.ndarray  # (n_rows,): where they lie in the time of the grid, seconds
    # (n_grid,): times of the grid; ``places`` itself where these are evenly spaced
    grid: np.ndarray
    step: float  # of the grid, seconds

    @property
    def is_grid(self):
        """Whether the rows are the grid."""
        return self.grid is self.places

    def onto_grid(self, values, held):
        """Values of the user's rows, resampled onto the grid."""
        values = values[self.rows]
        if self.is_grid:
            return values
        result = np.empty((len(self.grid), values.shape[1]))
        result[:, held] = held_means(values[:, held], self.places, self.grid, self.step)
        result[:, ~held] = interpolate(values[:, ~held], self.places, self.grid)
        return result

    def back(self, values):
        """Values on the grid, brought to the user's rows; held beyond the first and the last."""
        if self.is_grid:
            return values
        within = np.clip(self.places, self.grid[0], self.grid[-1])
        return interpolate(values, self.grid, within)

    def rows_between(self, start, stop):
        """Which of the user's rows of this piece lie from start to before stop on the grid."""
        edges = self.grid[[start, stop - 1]] + np.array([-1e-6, 1e-6]) * self.step
        return slice(*np.searchsorted(self.places, edges).tolist())


@dataclass(frozen=True, eq=False)
class Sampling:
    """The grid that is analysed, and how the user's rows lie on it."""

    base: TimeBase  # of the grid, one segment a piece
    pieces: tuple  # of Piece
    n_rows: int  # the user's rows, those in no piece too
    clock: np.ndarray  # (n_grid,): time of the index, seconds, at each row of the grid

    def onto_grid(self, values, held=False, omega=None):
        """The user's rows of some signals on the grid, one array a segment.

        ``held`` says which signals are held from row to row; the others are smooth.
        With ``omega`` in rad/s, splines are of what signals do about their mean
        waveform.
        """
        held = np.broadcast_to(held, values.shape[1:])
        moved = [piece for piece in self.pieces if not piece.is_grid]
        if omega is None or not moved:
            return [piece.onto_grid(values, held) for piece in self.pieces]
        parts = [(values[piece.rows], omega * piece.places) for piece in moved]
        waveform, values = mean_waveform(parts), values.copy()
        for piece, (_, psi) in zip(moved, parts, strict=True):
            values[piece.rows] -= evaluate_harmonics(waveform, psi)
        found = [piece.onto_grid(values, held) for piece in self.pieces]
        for piece, block in zip(self.pieces, found, strict=True):
            if not piece.is_grid:
                block += evaluate_harmonics(waveform, omega * piece.grid)
        return found

    def back(self, blocks, beside=None):
        """Values on the grid, one array a segment, at the user's rows; NaN in no piece.

        To them is added what is known at these rows ``beside`` them, one array a segment, too.
        """
        result = np.full((self.n_rows, blocks[0].shape[1]), np.nan)
        for i, (piece, block) in enumerate(zip(self.pieces, blocks, strict=True)):
            result[piece.rows] = piece.back(block)
            if beside is not None:
                result[piece.rows] += beside[i]
        return result


def mean_waveform(parts):
    """Fourier coefficients of the mean waveform of signals, of the lines that stand out.

    Others belong to what moves about the orbit: splines would miss more of them than they hold.

    ``parts`` are pairs of values (n_rows_s, n_signals) and azimuths (n_rows_s,).
    """
    steps = np.concatenate([np.diff(psi) for _, psi in parts])
    told = np.pi / np.max(steps) if len(steps) else 1.0  # of the widest step, too
    n_rows = sum(len(psi) for _, psi in parts)
    most = min(told, n_rows / (4 * ROWS_PER_COLUMN), MOST_HARMONICS + 1)
    return standing_lines(_first_rows(parts), max(int(np.ceil(most)) - 1, 0))


def _first_rows(parts):
    """Parts of a record until there are enough rows."""
    before = np.cumsum([0, *(len(psi) for _, psi in parts)])
    kept = [max(0, MOST_ROWS - int(n)) for n in before[:-1]]
    return [(values[:n], psi[:n]) for (values, psi), n in zip(parts, kept, strict=True)]


def lay_grid(base, places, present, step, timing, shortest=1):
    """Grid for some rows.

    Parameters
    ----------
    base : TimeBase
        Of the user's rows.
    places : ndarray, shape (n_rows,)
        Where they lie in the time of the grid, seconds.
    present : ndarray of bool, shape (n_rows,), or None
        Rows of which no sample is missing; None is all.
    step : float
        Of the grid, seconds.
    shortest : int
        Rows of the grid below which a piece is left out, if samples may be missing.
    """
    pieces, records = [], []
    rounding = resolution(base.time)
    moved = timing.azimuth or timing.resampled
    as_read = not moved and step == base.sample_time and base.jitter[1] == 0.0
    for segment, record in zip(base.segments, base.records, strict=True):
        for rows in runs_of(present, segment):
            own = places[rows]
            uniform = not moved and (as_read or even(own, step, rounding))
            grid = own if uniform else uniform_grid(own[0], own[-1], step)
            if len(grid) >= shortest or timing.missing == RAISE:
                pieces.append(Piece(rows, own, grid, step))
                records.append(record)
    if not pieces:
        raise ValueError(
            f"the analysis window needs {shortest} consecutive row(s) without missing samples, and "
            f"none are left between t = {at(base.time[0])} and {at(base.time[-1])}; bridge longer "
            f"runs of NaN (missing, in seconds), or use a shorter window"
        )
    edges = np.cumsum([0, *(len(piece.grid) for piece in pieces)])
    clock = [
        base.time[piece.rows]
        if timing.azimuth is None and piece.is_grid
        else np.interp(piece.grid, piece.places, base.time[piece.rows])
        for piece in pieces
    ]
    grid_base = replace(
        base,
        time=joined([piece.grid for piece in pieces]),
        segments=tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(edges)),
        records=tuple(records),
        sample_time=step,
    )
    return Sampling(grid_base, tuple(pieces), len(base.time), joined(clock))


def joined(parts):
    """Arrays one after the other; a single one as it is."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def runs_of(present, segment):
    """Runs of rows that are present within one segment."""
    if present is None:
        return [segment]
    inside = np.concatenate([[False], present[segment], [False]]).astype(int)
    edges = np.flatnonzero(np.diff(inside)) + segment.start
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def outliers(values):
    """How far a signal of one segment leaves its neighbours for one row alone, and comes back.

        d_k = y_k − (y_{k−1} + y_{k+1}) / 2:   s at such a row, −s/2 before and after it

    s is half of the signal's spread or more, and six times every other d nearby: noise and edges
    are no outliers.

    It returns |s| in parts of the standard deviation, and zero elsewhere.

    Examples
    --------
    >>> y = np.sin(0.3 * np.arange(60))[:, None]
    >>> y[20] += 2.0
    >>> np.flatnonzero(outliers(y)).tolist()
    [20]
    """
    if len(values) <= 2 * NEARBY or np.isnan(values).all(axis=0).any():
        return np.zeros(values.shape)
    values = values - np.nanmean(values, axis=0)
    largest = np.nanmax(np.abs(values), axis=0)
    values = values / np.where(largest > 0.0, largest, 1.0)
    spread = np.nanstd(values, axis=0)
    apart = np.zeros(values.shape)  # beside a missing row, too
    apart[1:-1] = np.nan_to_num(values[1:-1] - 0.5 * (values[:-2] + values[2:]))
    apart /= np.where(spread > 0.0, spread, np.inf)
    size, around = np.abs(apart), np.ones((2 * NEARBY + 1, 1), dtype=bool)
    around[NEARBY - 1 : NEARBY + 2] = False
    others = ndimage.maximum_filter(size, footprint=around)
    before, after = (np.abs(np.roll(apart, by, axis=0) + 0.5 * apart) for by in (1, -1))
    back = np.maximum(before, after) < 0.25 * size
    return np.where((size > np.maximum(0.5, STANDS_OUT * others)) & back, size, 0.0)


def warn_of_outliers(inputs, outputs, names, samples):
    """Warn of values of the outputs that look like a sensor's errors, where no input does that.

    What comes as often as every other turn is a part of the motion: impacts.

    ``samples`` is the number of samples in a turn.
    """
    if searching():
        return
    off, base = np.zeros(outputs.shape), inputs.base
    for rows in base.segments:
        moved = ndimage.binary_dilation(outliers(inputs.data[rows]).any(axis=1))
        off[rows] = np.where(moved[:, None], 0.0, outliers(outputs[rows]))
    off[:, np.count_nonzero(off, axis=0) > 0.5 * len(off) / samples] = 0.0
    if not off.any():
        return
    k, j = np.unravel_index(np.argmax(off), off.shape)
    named = [name for name, own in zip(names, off.T, strict=True) if own.any()]
    warn(
        f"{np.count_nonzero(off)} value(s) of the outputs {named} stand out from the rows around "
        f"them, each for one row alone (the largest of {names[j]!r} at t = {at(base.time[k])}, row "
        f"{k}, by {off[k, j]:.3g} times the standard deviation of that output): outliers spoil the "
        f"model, and what is found about omega; set them to NaN and give "
        f"HarmonicAnalyzer(missing={2.0 * base.sample_time:.3g}), which bridges single rows",
        IdentifiabilityWarning,
    )


def warn_of_resampling(basis, inputs, outputs):
    """Say onto how many samples a period is resampled, and what that costs."""
    step, unless = inputs.base.sample_time, ""
    if basis.alternative is not None and not basis.alternative.timing.resampled:
        unless = f", unless fit chooses reading={basis.alternative.reading!r}"
    samples = 2.0 * np.pi / basis.omega / step
    warn(
        f"omega={basis.omega:.9g} rad/s and a sample time of {step:.9g} s give {samples:.6g} "
        f"samples a period, not a whole number: signals are resampled onto "
        f"{basis.samples_per_period} a period, and results brought back to the rows given{unless}. "
        f"{_resampling_error(basis, inputs, outputs)}{round(samples)} samples a period would mean "
        f"omega={2.0 * np.pi / step / round(samples):.9g} rad/s",
        ResamplingWarning,
    )


def _resampling_error(basis, inputs, outputs):
    """Bound of the error of the splines, in words; held inputs keep their areas."""
    rows = max(inputs.base.segments, key=lambda segment: segment.stop - segment.start)
    places = inputs.places(basis.omega, basis.sample_time)[rows]
    smooth = np.flatnonzero(~basis.held)
    names, values = [basis.inputs[i][0] for i in smooth], _filled(inputs.data[rows][:, smooth])
    if outputs is not None:
        names += [signal for signal, _ in basis.outputs]
        y, psi = _filled(outputs[rows]), basis.omega * places
        moving = y - evaluate_harmonics(mean_waveform([(y, psi)]), psi)
        values = np.hstack(
            [values, np.where(np.abs(moving) > RANK * np.abs(y).max(0), moving, 0.0)]
        )
    if not names:
        return ""
    size = np.sqrt(np.mean(values**2, axis=0))
    shares = interpolation_error(values, places) / np.where(size > 0.0, size, 1.0)
    listed = ", ".join(f"{s:.1g} of {n!r}" for n, s in zip(names, shares, strict=True))
    return (
        f"The interpolation error is at most (rms, as a share of each signal, of outputs about "
        f"their mean waveform) {listed}; standard deviations do not include it. "
    )


def _filled(values):
    """Signals about their means, zero where they are missing."""
    values = values - np.nanmean(values, axis=0)
    return np.where(np.isnan(values), 0.0, values)


def regrouped(experiment, blocks, grids, clock, records):
    """An experiment of other segments, whose rows are those of the grid.

    ``blocks`` has by name what it holds of each segment; "outputs" is also what was
    measured. ``grids`` and ``clock`` are times of each segment on the grid and by the
    index, and ``records`` has the label of the record of each.
    """
    edges = np.cumsum([0, *map(len, grids)])
    segments = tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(edges))
    base = replace(
        experiment.base, time=np.concatenate(grids), segments=segments, records=tuple(records)
    )
    pieces = tuple(
        Piece(rows, grid, grid, base.sample_time)
        for rows, grid in zip(segments, grids, strict=True)
    )
    sampling = Sampling(base, pieces, len(base.time), np.concatenate(clock))
    measured = np.vstack(blocks["outputs"])
    return replace(experiment, base=base, sampling=sampling, measured=measured, **blocks)
