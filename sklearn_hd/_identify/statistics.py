"""Data of a fit: one protocol, for arrays in memory and for sums that merge.

``Records`` holds the arrays of all segments. ``Statistics`` are sums over rows: those of a chunk
are merged with those of the rows before it, those of a partition with its neighbours', in any
grouping; ``data`` makes ``Summed`` of them. Both, and dask's partitions, use this protocol, so the
identification after them is the same.
"""

from dataclasses import dataclass, replace

import numpy as np

from sklearn_hd._checks import COMMON
from sklearn_hd._clock import why_short
from sklearn_hd._guards import extremes, square_sums
from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.signals.fourier import InputDirections
from sklearn_hd.algorithms.subspace.hankel import (
    block_order,
    factor_of_products,
    hankel_factor,
    n_hankel_columns,
)
from sklearn_hd.algorithms.subspace.innovations import InnovationForm
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.algorithms.subspace.sums import (
    Forgetting,
    Sums,
    initial_states_of_heads,
    input_matrices_of_factor,
    input_matrices_of_heads,
    input_matrices_of_sums,
    row_sums,
)

REMEMBERING = Forgetting()
FIRST_ROWS = 512  # which tell, mostly, whether a signal moves


# ---- what checks and messages read ---------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Facts:
    """What checks and messages need to know of the data of a fit."""

    basis: object  # a HarmonicBasis, or PlainReading
    output_names: tuple  # of str
    sample_time: float  # seconds
    n_samples: int
    span: str  # first and last time, for messages
    moving: np.ndarray  # bool, (n_drive,): which of the drive move within some segment
    still: tuple  # of str: measured inputs that never do
    outputs_move: np.ndarray  # bool, (l,): which outputs move
    outputs_off: np.ndarray  # bool, (l,): which are ever other than zero
    why_short: str = ""  # what made segments short, for messages; empty where nothing did
    # of str: measured inputs of which some combination never moves: copies, say
    together: tuple = ()

    @classmethod
    def of(cls, experiment, inputs):
        """Of an experiment, whose rows read have some inputs."""
        moving = _moving(inputs)
        seen, signals = moving, experiment.basis.drive_signals
        if experiment.basis.reading == "period":
            # what has no mean over any period may move within it all the same
            seen, signals = _moving(experiment.inputs), experiment.basis.input_signals
        size = np.sqrt(square_sums(experiment.measured))
        outputs_move = outputs_off = _spread(experiment.outputs[0][:FIRST_ROWS]) > EXACT * size
        if not outputs_move.all():  # no value is larger than the length of its column
            size = np.array([np.fmax.reduce(np.abs(column)) for column in experiment.measured.T])
            ends = np.array([extremes(y) for y in experiment.outputs])
            outputs_move, outputs_off = _output_motion(ends, size)
        return cls(
            experiment.basis,
            tuple(experiment.output_names),
            experiment.base.sample_time,
            len(experiment.base.time),
            experiment.span(),
            moving,
            _still(signals, seen),
            outputs_move,
            outputs_off,
            why_short(experiment.base),
            _together(experiment),
        )

    def without(self, names):
        """The same, some measured inputs counted as at rest."""
        if not names:
            return self
        moving = self.moving & [name not in names for name in self.basis.drive_signals]
        return replace(self, moving=moving, still=_still(self.basis.drive_signals, moving))


def _together(experiment):
    """Names of the inputs that never move apart."""
    names = experiment.basis.input_signals
    if len(names) < 2:
        return ()
    loads = experiment.basis.reading == "sample"
    inputs = [u[:, None] for u in experiment.inputs]
    found = InputDirections.of(inputs, about_mean=loads).together
    return tuple(names[i] for i in found)


def ends_of(rows):
    """Smallest and largest values, shape (2, n); of no rows those that any row replaces."""
    if len(rows) == 0:
        return np.outer([np.inf, -np.inf], np.ones(rows.shape[1]))
    return np.array(extremes(rows))


def _spread(rows):
    low, high = extremes(rows)
    return high - low


def _moving(blocks):
    """Which columns move within some block; looking at the first rows will mostly do."""
    moving = _spread(blocks[0][:FIRST_ROWS]) > 0.0
    if not moving.all():
        moving = np.any([_spread(block) > 0.0 for block in blocks], axis=0)
    return moving


def _still(signals, moving):
    """Measured signals of which nothing moves."""
    seen = {s for s, m in zip(signals, moving, strict=True) if m}
    return tuple(s for s in dict.fromkeys(signals) if s not in seen)


def _output_motion(ends, size):
    """Which outputs move, and which are other than zero, beside their size: EXACT is rounding."""
    low, high = ends[:, 0], ends[:, 1]
    moves = np.any(high - low > EXACT * size, axis=0)
    return moves, np.any((np.maximum(high, -low) > EXACT * size) & (high >= low), axis=0)


# ---- arrays in memory ----------------------------------------------------------------------


class _Data:
    """What both kinds of data have in common: ``raw`` where the drive itself is projected."""

    most_block_rows = np.inf

    def scales(self, scale):
        """What channels are divided by: projected, (n_inputs + n_outputs,), and (drive, outputs).

        The drive and the outputs stay in their units if ``scale`` is False.
        """
        size, drive = self.root_mean_squares(), self.drive_sizes()
        if not scale:
            size[0 if self.raw else self.n_inputs :] = 1.0
            drive = np.ones_like(drive)
        return size, (drive, size[self.n_inputs :])

    def projection(self, make, scale, *choices):
        """What ``make`` makes of the factor, which depends on some choices and nothing else."""
        return make()


class Records(_Data):
    """Inputs and outputs of all segments, in memory.

    ``inputs`` and ``outputs`` are the drive and the outputs at the analysed rows.
    ``kept`` is where products are kept (:mod:`~sklearn_hd._identify.products_cache`).
    ``excitation`` is what is projected in place of the inputs, brought to equal size.
    """

    def __init__(self, inputs, outputs, facts, kept=None, excitation=None):
        self.inputs, self.outputs, self.facts, self.kept = inputs, outputs, facts, kept
        self.raw = excitation is None or excitation is inputs
        self.excitation = inputs if self.raw else excitation
        self.lengths = [len(u) for u in inputs]
        self.n_inputs, self.n_outputs = self.excitation[0].shape[1], outputs[0].shape[1]

    def with_excitation(self, excitation):
        """The same with other inputs projected."""
        return Records(self.inputs, self.outputs, self.facts, self.kept, excitation)

    def drive_sizes(self):
        """Root mean square of each input; one where it is zero."""
        return _root_mean_squares(self.inputs)

    def root_mean_squares(self):
        """Of each channel projected, inputs first; one where it is zero."""
        drive = self.drive_sizes() if self.raw else np.ones(self.n_inputs)
        return np.concatenate([drive, _root_mean_squares(self.outputs)])

    def factor(self, block_rows, scale):
        """:func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`."""
        if self.kept is None:
            return hankel_factor(self.excitation, self.outputs, block_rows, scale)
        return self.kept.factor(self.excitation, self.outputs, block_rows, scale)

    def projection(self, make, scale, *choices):
        """What ``make`` makes of the factor, perhaps from the cache."""
        if self.kept is None:
            return make()
        return self.kept.projection(self.excitation, self.outputs, scale, make, *choices)

    def input_matrices(self, A, C, feedthrough, scales):
        """:func:`~sklearn_hd.algorithms.subspace.input_matrices.input_matrices`."""
        signals, found = (self.inputs, self.outputs), None
        if self.kept is not None and signals[0][0].shape[1] > 0:
            found = input_matrices_of_sums(A, C, self.kept.sums(*signals), feedthrough, scales)
        if found is not None:
            return found
        return input_matrices(A, C, *signals, feedthrough, scales=scales)

    def initial_states(self, A, B, C, D, K, covariance, scales):
        """Those that leave the least innovations, of a model driven by what is projected."""
        form, pairs = InnovationForm(A, B, C, D, K), zip(self.excitation, self.outputs, strict=True)
        return np.array(
            [form.initial_state(u / scales[0], y / scales[1], covariance) for u, y in pairs]
        )


def _root_mean_squares(signals):
    """Root mean square of each channel over all segments; one where a channel is zero."""
    n_samples = sum(map(len, signals))
    squares = sum(map(square_sums, signals))
    if np.all((squares > 1.0 / COMMON) & (squares < COMMON)):
        return np.sqrt(squares / n_samples)
    scale = np.ones(signals[0].shape[1])
    for c, largest in enumerate(np.max(np.abs([extremes(z) for z in signals]), axis=(0, 1))):
        if largest > 0.0:
            squares = (np.sum((z[:, c] / largest) ** 2) for z in signals)
            scale[c] = largest * np.sqrt(sum(squares) / n_samples)
    return scale


# ---- sums that merge -----------------------------------------------------------------------


@dataclass(frozen=True)
class Channels:
    """What the sums are of: each of the drive times 1, cos ψ, sin ψ, …, then the outputs."""

    n_drive: int
    n_outputs: int
    highest: int = 0  # harmonic that the drive is multiplied by

    @property
    def outputs(self):
        """Places of the outputs."""
        return self.n_drive * (2 * self.highest + 1) + np.arange(self.n_outputs)

    def waves(self, highest, which=slice(None)):
        """Places of some of the drive times harmonics up to some."""
        width = 2 * self.highest + 1
        places = np.arange(self.n_drive * width).reshape(self.n_drive, width)
        return places[which, : 2 * highest + 1].ravel()


@dataclass(frozen=True)
class Statistics:
    """Sums over consecutive rows of one or more segments, that others may follow."""

    channels: Channels
    # of RowSums: of the first and the last segment, that rows may be joined to; one if they are the
    # same
    open: tuple
    closed: Sums | None  # of the segments between these
    # (2, n_drive + n_measured): smallest and largest values of drive and measured outputs in each
    # segment
    extremes: tuple
    size: np.ndarray  # (n_measured,): largest magnitudes of the outputs as measured
    n_samples: int  # rows as given, of which not all may have been read

    @classmethod
    def of(cls, channels, n_lags, rows, extremes, size, n_samples):
        """Of the analysed rows of some segments, each shape (n_rows_s, n_channels)."""
        alone, outputs = channels.waves(0), channels.outputs
        total = cls(channels, (), None, (), np.zeros_like(size), 0)
        for segment, ends in zip(rows, extremes, strict=True):
            own = row_sums(segment, n_lags, alone, outputs)
            total = total.merge(cls(channels, (own,), None, (ends,), size, 0))
        return replace(total, n_samples=n_samples)

    def merge(self, later, joined=False):
        """With the rows that follow; ``joined`` where they go on with the last segment."""
        ends, extremes_ = self.open + later.open, self.extremes + later.extremes
        if joined:
            at = len(self.open) - 1
            ends = (*ends[:at], ends[at].join(ends[at + 1]), *ends[at + 2 :])
            a, b = self.extremes[-1], later.extremes[0]
            both = np.array([np.minimum(a[0], b[0]), np.maximum(a[1], b[1])])
            extremes_ = (*self.extremes[:-1], both, *later.extremes[1:])
        between = [self.closed, *(each.closed() for each in ends[1:-1]), later.closed]
        return Statistics(
            self.channels,
            (ends[0], ends[-1]) if len(ends) > 1 else ends,
            _total(between),
            extremes_,
            np.fmax(self.size, later.size),
            self.n_samples + later.n_samples,
        )

    def faded(self, shift):
        """The same of rows divided by 2 to the power of ``shift``, before others are merged."""
        if shift == 0:
            return self
        closed = None if self.closed is None else self.closed.faded(shift)
        return replace(self, open=tuple(each.faded(shift) for each in self.open), closed=closed)

    def total(self):
        """Sums over all segments, as if the last were over."""
        first, *last = (each.closed() for each in self.open)
        return _total([first, self.closed, *last])

    @property
    def lengths(self):
        """Rows read of each segment."""
        middle = [ends.n_rows for ends in self.closed.ends] if self.closed is not None else []
        first, *last = (each.ends.n_rows for each in self.open)
        return [first, *middle, *last]

    def facts(self, basis, output_names, sample_time, words):
        """What checks read."""
        signals, ends = basis.drive_signals, np.array(self.extremes)
        m = len(signals)
        moved = np.max(ends[:, 1, :m] - ends[:, 0, :m], axis=0, initial=0.0)
        # coefficients no larger than rounding beside others of their signal do not move
        largest = {
            s: max(d for d, o in zip(moved, signals, strict=True) if o == s) for s in signals
        }
        moving = np.array(
            [d > EXACT * largest[s] for d, s in zip(moved, signals, strict=True)], bool
        )
        return Facts(
            basis,
            tuple(output_names),
            sample_time,
            self.n_samples,
            words,
            moving,
            _still(signals, moving),
            *_output_motion(ends[:, :, m:], self.size),
        )

    def data(self, facts, highest, forgetting=REMEMBERING):
        """Data of a fit, the drive times harmonics up to some projected."""
        return Summed(self.total(), self.channels, facts, highest, forgetting)


def _total(sums):
    found = [each for each in sums if each is not None]
    return sum(found[1:], found[0]) if found else None


class Summed(_Data):
    """Data of which there are sums.

    ``channels`` are those of the sums. What moves of the drive is projected with
    harmonics up to ``highest``. ``forgetting`` says how the rows are weighted:
    ``lengths`` and ``n_effective_rows`` count weighted rows as what they are worth.
    """

    def __init__(self, sums, channels, facts, highest, forgetting=REMEMBERING):
        self.sums, self.facts, self.raw = sums, facts, highest == 0
        self.forgetting, self.n_rows = forgetting, [ends.n_rows for ends in sums.ends]
        wide = channels.waves(highest, facts.moving)
        self.place = np.searchsorted(wide, channels.waves(0, facts.moving))
        self.products = sums.products.channels(np.concatenate([wide, channels.outputs]))
        self.lengths = forgetting.effective_lengths(self.n_rows)
        self.n_effective_rows = float(forgetting.n_effective(self.n_rows))
        self.newest = forgetting.newest(sum(self.n_rows))
        self.n_inputs, self.n_outputs = len(wide), channels.n_outputs
        self.most_block_rows = len(self.products.lags) // 2

    def root_mean_squares(self):
        """Of each channel projected, inputs first; one where it is zero."""
        mean = sum(self.n_rows) / np.sum(self.forgetting.weights(self.n_rows))
        return self.products.root_mean_squares() * np.sqrt(mean) / self.newest

    def drive_sizes(self):
        """Root mean square of each of the drive; one where it does not move."""
        sizes = np.ones(len(self.facts.moving))
        sizes[self.facts.moving] = self.root_mean_squares()[self.place]
        return sizes

    def factor(self, block_rows, scale):
        """R factor of the block Hankel matrices, as ``hankel_factor`` gives.

        Its columns are weighted, and it is as large as that of so many alike as they are worth.
        """
        n_lags, growth = 2 * block_rows, self.forgetting.growth
        R = factor_of_products(self.products.fewer(n_lags), self.n_inputs, scale)
        if growth == 1.0:
            return R
        order = block_order(n_lags, self.n_inputs + self.n_outputs, self.n_inputs)
        lag = order // (self.n_inputs + self.n_outputs)
        weight = np.sum(self.forgetting.weights(self.n_rows, n_lags - 1))
        worth = np.sqrt(n_hankel_columns(self.lengths, block_rows) / weight) / self.newest
        return R * (worth / growth**lag)

    def input_matrices(self, A, C, feedthrough, scales):
        """B, D and the initial states, over all rows of all segments where A forgets.

        Where it does not, over all rows of segments that are at hand as a whole, or else from
        the triangular factor (Verhaegen, 1994) and each segment's first rows.
        """
        which, growth = np.flatnonzero(self.facts.moving), self.forgetting.growth
        sums, own = self.sums.of_inputs(which), (scales[0][which], scales[1])
        found = input_matrices_of_sums(growth * A, C, sums, feedthrough, own)
        if found is None:
            found = input_matrices_of_heads(growth * A, C, sums.ends, feedthrough, own)
        if found is None:
            i, size = self.most_block_rows, self.root_mean_squares()
            size[self.place], size[self.n_inputs :] = own
            R = self.factor(i, size)
            B, D = input_matrices_of_factor(A, C, R, i, self.n_inputs, feedthrough)
            B, D = growth * B[:, self.place], D[:, self.place]
            found = B, D, initial_states_of_heads(growth * A, B, C, D, sums.ends, own)
        B, D = np.zeros((len(A), len(scales[0]))), np.zeros((len(C), len(scales[0])))
        B[:, which], D[:, which], x0 = found
        return B / growth, D, self._in_time(x0)

    def initial_states(self, A, B, C, D, K, covariance, scales):
        """Those that leave the least innovations."""
        growth = self.forgetting.growth
        model, noise = (growth * A, growth * B, C, D), (growth * K, covariance)
        return self._in_time(initial_states_of_heads(*model, self.sums.ends, scales, noise))

    def _in_time(self, x0):
        """Initial states of segments as they were, of those of weighted rows."""
        return x0 / self.forgetting.first(self.n_rows)[:, None]
