"""Data that arrive in chunks, and the sums that ``MOESPRegressor.partial_fit`` keeps.

Rows are read as in a fit of all rows: plain rows as they are; through a sliding window those at ψ
= 0 mod hop, as soon as their windows, hops and whole periods are complete. The raw rows that this
needs are carried over to the next chunk; the rest are statistics that merge.
With a half-life the rows are weighted by their age
(:mod:`~sklearn_hd.algorithms.subspace.sums`).
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sklearn_hd._checks import FIRST, RAISE, STANDARD_ERRORS, at
from sklearn_hd._clock import STEP_TOLERANCE, resolution
from sklearn_hd._guards import warn
from sklearn_hd._identify import asked_block_rows, identify, most_block_rows
from sklearn_hd._identify.sliding import (
    largest_changes,
    modulated,
    n_modulating_harmonics,
    steps_at_one_phase,
)
from sklearn_hd._identify.stages import check_rank_bound, fewer_block_rows
from sklearn_hd._identify.statistics import REMEMBERING, Channels, Statistics, ends_of
from sklearn_hd._readings import PlainReading, Timing, first_difference
from sklearn_hd._records.data import read_experiment
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns
from sklearn_hd.algorithms.subspace.sums import Forgetting
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning

MOST_BYTES = 2**33  # of one matrix of the sums
MOST_REST = 10.0  # half-lives, after which motion weighs 2⁻¹⁰: deviations have grown 32 times


@dataclass(frozen=True)
class OpenRecord:
    """Rows of a record that the next chunk may go on with, less their trim."""

    label: object
    time: np.ndarray  # (n_carried,)
    inputs: np.ndarray  # (n_carried, m)
    outputs: np.ndarray  # (n_carried, l)
    read_until: float = -np.inf  # time of the last row added to the statistics
    # seconds by which the index is ahead of ``time``, which counts from a ψ = 0 nearby
    ahead: float = 0.0

    def extended(self, *rows):
        """With more rows of time, inputs and outputs."""
        old = {"time": self.time, "inputs": self.inputs, "outputs": self.outputs}
        longer = map(np.concatenate, zip(old.values(), rows, strict=True))
        return replace(self, **dict(zip(old, longer, strict=True)))


@dataclass(frozen=True)
class Stream:
    """Statistics of all chunks so far; a chunk makes a new one."""

    block_rows: int  # the most that a model can be made with
    basis: object  # HarmonicBasis or PlainReading
    sample_time: float
    input_names: tuple  # of str
    output_names: tuple  # of str
    channels: Channels  # of the statistics
    origin: str | None  # the instant from which dates are counted
    first: float  # time of the first row
    last: float = 0.0  # time of the last row
    statistics: Statistics | None = None
    record: OpenRecord | None = None
    # (samples_per_period, n_drive): largest changes of the drive, by phase
    changes: np.ndarray | float = 0.0
    forgetting: Forgetting = REMEMBERING  # of the analysed rows
    n_read: int = 0  # rows read
    moved: np.ndarray | float = 0.0  # (m,): rows read when each input last moved

    # ---- chunks ------------------------------------------------------------------------------

    @classmethod
    def begin(cls, experiment, block_rows, forgetting, origin=None):
        """A stream of no rows, of data such as those of an experiment."""
        basis, n_drive = experiment.basis, len(experiment.basis.drive_labels)
        channels = Channels(n_drive, len(experiment.output_names))
        if basis.harmonic:
            highest = basis.rows_per_period // 2
            channels = Channels(n_drive, len(basis.output_labels), highest)
        _check_first(experiment, block_rows, n_drive + len(experiment.output_names))
        return cls(
            block_rows,
            basis,
            experiment.base.sample_time,
            tuple(basis.input_signals),
            tuple(experiment.output_names),
            channels,
            origin,
            float(experiment.sampling.clock[0]),
            forgetting=forgetting,
        )

    def with_chunk(self, experiment):
        """The stream and one more chunk.

        It raises ValueError if the chunk has other columns, another sample time or
        basis, or does not follow on what was read before.
        """
        self._check_alike(experiment)
        base, stream = experiment.base, self
        clock = experiment.sampling.clock
        rounding = resolution(clock)
        for s, (time, label) in enumerate(zip(experiment.times(), base.records, strict=True)):
            start, ahead = clock[base.segments[s].start], clock[base.segments[s].start] - time[0]
            rows = time, experiment.inputs[s], experiment.outputs[s]
            more = stream.record is not None and stream.record.label == label
            if s == 0 and base.counted and more and start <= 0.0:  # counted from 0 again
                rows = stream._continued(*rows)
            elif more:
                rows = stream._brought(time, ahead, rounding), *rows[1:]
                ahead = stream.record.ahead
            goes_on = stream._goes_on(rows[0], label)
            if not goes_on:
                empty = OpenRecord(label, *(z[:0] for z in rows), ahead=ahead)
                stream = replace(stream, record=empty)
            stream = stream._with_rows(rows, goes_on)
        return replace(stream, last=float(stream.record.time[-1] + stream.record.ahead))

    def _check_alike(self, experiment):
        """Raise ValueError unless a chunk is sampled and analysed as those before it."""
        for what, here, there in (
            ("inputs", tuple(experiment.basis.input_signals), self.input_names),
            ("outputs", tuple(experiment.output_names), self.output_names),
        ):
            if here != there:
                raise ValueError(
                    f"this chunk has the {what} {list(here)}, the first one had {list(there)}; "
                    f"give all chunks the same columns in the same order, or begin anew with "
                    f"a clone of the estimator"
                )
        if experiment.basis.harmonic != self.basis.harmonic:
            has, had = ("a ", "no ") if experiment.basis.harmonic else ("no ", "a ")
            raise ValueError(
                f"this chunk carries {has}harmonic basis, the first one carried {had.strip()} one; "
                f"pass all chunks through the same HarmonicAnalyzer, or none"
            )
        difference = first_difference(experiment.basis, self.basis)
        if difference is not None:
            name, here, there = difference
            raise ValueError(
                f"this chunk was analysed with {name}={here!r}, the first one with "
                f"{there!r}; fit one HarmonicAnalyzer, and transform all chunks with it"
            )
        dt, base = experiment.base.sample_time, experiment.base
        single = all(s.stop - s.start == 1 for s in base.segments)  # one row tells no step
        tolerance = STEP_TOLERANCE * self.sample_time + STANDARD_ERRORS * base.uncertainty
        if not single and abs(dt - self.sample_time) > tolerance:
            raise ValueError(
                f"the rows of this chunk are {dt:.6g} s apart, those of the first one "
                f"{self.sample_time:.6g} s; resample the chunk"
            )

    def _brought(self, time, ahead, rounding):
        """Times counted from another ψ = 0 as those of the open record are.

        Rows that follow on it to the resolution of their times go on along its line.
        """
        period = 2.0 * np.pi / self.basis.omega if self.basis.harmonic else self.sample_time
        time = time + round((ahead - self.record.ahead) / period) * period
        off = time[0] - self.record.time[-1] - self.sample_time
        return time - off if abs(off) <= rounding else time

    def _continued(self, time, *signals):
        """Rows counted from 0 as they go on where the last chunk ended, trim and all."""
        later = time + self.record.time[-1] + self.sample_time
        if self.basis.harmonic:
            was, phase = self.basis.phase_index(time), self.basis.phase_index(later)
            trims = self.basis.input_trim, self.basis.output_trim
            signals = (
                values if trim is None else values + (trim[was] - trim[phase])
                for values, trim in zip(signals, trims, strict=True)
            )
        return later, *signals

    def _goes_on(self, time, label):
        """Whether rows follow on the last one read; ValueError if they lie before it."""
        if self.record is None or self.record.label != label:
            return False
        step = (time[0] - self.record.time[-1]) / self.sample_time
        if step < 0.5:
            raise ValueError(
                f"this chunk begins at t = {at(time[0] + self.record.ahead)}, before the end of "
                f"the last one (t = {at(self.record.time[-1] + self.record.ahead)}) in the same "
                f"record; give chunks in time order, or label the rows of another record in a "
                f"(record, time) MultiIndex"
            )
        return step < 1.5

    def _with_rows(self, rows, joined):
        """The stream with more rows of its open record."""
        u = np.vstack([self.record.inputs[-1:], rows[1]])
        add = self._with_complete_rows if self.basis.harmonic else self._with_plain_rows
        stream = add(rows, joined)
        changes = np.diff(u, axis=0)[::-1] != 0.0
        if not len(changes):
            return stream
        ago = np.argmax(changes, axis=0) / self.basis.hop
        moved = np.where(np.any(changes, axis=0), stream.n_read - ago, self.moved)
        return replace(stream, moved=moved)

    def _with_plain_rows(self, rows, joined):
        time, inputs, outputs = rows
        last = {"time": time[-1:], "inputs": inputs[-1:], "outputs": outputs[-1:]}
        rows = np.hstack([inputs, outputs])
        stream = self._with_read(rows, ends_of(rows), outputs, joined)
        return replace(stream, record=replace(self.record, **last))

    def _with_read(self, rows, ends, measured, joined):
        """The stream with rows read added to its statistics."""
        size = np.max(np.abs(measured), axis=0, initial=0.0)
        weighted, shift = self.forgetting.weighted(rows, self.n_read)
        of = self.channels, 2 * self.block_rows, [weighted], [ends], size, len(measured)
        more = Statistics.of(*of)
        if self.statistics is not None:
            more = self.statistics.faded(shift).merge(more, joined)
        return replace(self, statistics=more, n_read=self.n_read + len(rows))

    # ---- through a sliding window ------------------------------------------------------------

    def _with_complete_rows(self, rows, joined):
        """The stream with what the rows carried over and those that came have complete."""
        basis, record = self.basis, self.record.extended(*rows)
        complete = len(record.time)
        if any(orders != (0,) for _, orders in basis.inputs):  # coefficients of whole periods
            complete -= (basis.phase_index(record.time)[-1] + 1) % basis.samples_per_period
        drive = basis.drive(record.inputs, record.time)[:complete]
        changes = np.maximum(self.changes, largest_changes(basis, drive, record.time[:complete]))
        places = self._unread(record)
        places = places[places + basis.lead + basis.hop <= complete]
        ends = ends_of(np.hstack([drive, record.outputs[:complete]]))
        stream = self._with_read(self._rows(record, places), ends, rows[2], joined)
        if len(places):
            record = replace(record, read_until=float(record.time[places[-1]]))
        return replace(stream, changes=changes, record=self._carried(record))

    def _unread(self, record):
        """Rows with whole windows not yet added to the statistics."""
        if len(record.time) < len(self.basis.weights):
            return np.zeros(0, dtype=int)
        rows = self.basis.rows_read(record.time)
        return rows[record.time[rows] > record.read_until + 0.5 * self.sample_time]

    def _rows(self, record, places):
        """Channels of some rows of a record."""
        basis, time = self.basis, record.time
        if len(places) == 0:
            return np.zeros((0, self.channels.outputs[-1] + 1))
        drive = basis.drive(record.inputs, time)
        inputs = modulated(basis, drive, time, places, self.channels.highest)
        return np.hstack([inputs, basis.output_coefficients(record.outputs, time, places)])

    def _carried(self, record):
        """What the next row's window takes, and the whole periods that it reaches into."""
        basis, unread = self.basis, self._unread(record)
        needed = unread[0] if len(unread) else len(record.time) - 1
        needed = needed + basis.lead - len(basis.weights) - 2 * basis.samples_per_period
        starts = np.flatnonzero(basis.phase_index(record.time) == 0)
        starts = starts[starts <= needed]
        keep = slice(int(starts[-1]) if len(starts) else 0, None)
        names = "time", "inputs", "outputs"
        return replace(record, **{name: getattr(record, name)[keep] for name in names})

    # ---- what a model is made of -------------------------------------------------------------

    def data(self):
        """Data of a fit of everything so far, as if the open record were over."""
        stream, basis, highest = self, self.basis, 0
        if basis.harmonic:
            rows = self._rows(self.record, self._unread(self.record))
            nothing = ends_of(np.zeros((0, self.channels.n_drive + len(self.output_names))))
            stream = self._with_read(rows, nothing, self.record.outputs[:0], joined=True)
            if not steps_at_one_phase(self.changes):
                lengths = self.forgetting.effective_lengths(stream.statistics.lengths)
                highest = n_modulating_harmonics(basis, lengths, self.channels.n_drive)
        facts = stream.statistics.facts(
            basis,
            self.output_names,
            self.sample_time,
            f"rows from t = {at(self.first)} to {at(self.last)}",
        )
        facts = facts.without(self._forgotten())
        return stream.statistics.data(facts, highest, self.forgetting)

    def _forgotten(self):
        """Inputs that have rested for so long that their effect is forgotten."""
        rest = self.n_read - self.moved > MOST_REST * self.forgetting.half_life
        rest = np.broadcast_to(rest, len(self.input_names))
        return {name for name, forgotten in zip(self.input_names, rest, strict=True) if forgotten}


def _first_date(data):
    """The first of the dates that rows are indexed by, as ISO text; None where there are none."""
    index = getattr(data, "index", None)
    times = index.get_level_values(-1) if isinstance(index, pd.Index) else None
    return times.min().isoformat() if isinstance(times, pd.DatetimeIndex) else None


def with_chunk(stream, experiment, X, settings):
    """The stream and one more chunk; a new stream where there is none yet.

    It raises ValueError if the chunk does not follow on the others, or more block rows
    are asked for, or another half-life.
    """
    asked = most_block_rows(experiment.basis, settings)
    check_rank_bound(settings.order, asked, len(experiment.basis.output_labels))
    sample_time = (experiment.base if stream is None else stream).sample_time
    forgetting = Forgetting(_half_life_in_rows(experiment.basis, sample_time, settings))
    if stream is None:
        _check_half_life(experiment, settings, forgetting)
        stream = Stream.begin(experiment, asked, forgetting, _first_date(X))
    elif forgetting != stream.forgetting:
        raise ValueError(
            f"half_life={settings.half_life} differs from that of the earlier chunks, whose rows "
            f"are weighted already; begin anew with a clone of the estimator"
        )
    elif asked > stream.block_rows:
        raise ValueError(
            f"block_rows={asked} is more than the {stream.block_rows} with which the first chunk "
            f"was read; begin anew with a clone of the estimator"
        )
    return stream.with_chunk(experiment)


def model_so_far(stream, settings):
    """The fit of all chunks so far, and what rows they are worth.

    None for the fit, which is said, where they do not suffice.
    """
    data = stream.data()
    if not _suffices(data, settings):
        return None, data.n_effective_rows
    try:
        return identify(data, settings), data.n_effective_rows
    except ValueError as error:  # which rows to come may mend
        warn(f"no model of the {data.facts.span}: {error}", IdentifiabilityWarning)
        return None, data.n_effective_rows


def _half_life_in_rows(basis, sample_time, settings):
    """The given half-life (periods, or seconds of plain data) in analysed rows."""
    if settings.half_life is None:
        return np.inf
    rows_per_unit = basis.rows_per_period if basis.harmonic else 1.0 / sample_time
    return float(settings.half_life) * rows_per_unit


def _check_half_life(experiment, settings, forgetting):
    """Raise ValueError if rows are forgotten before there are enough for any model."""
    if forgetting.half_life == np.inf:
        return
    basis, most = experiment.basis, forgetting.most_rows
    p = len(basis.drive_labels) + len(basis.output_labels)
    i = _block_rows(basis, settings, [round(most)], p)
    need = i * p + 1 + 2 * i
    if most < need:
        unit = "periods" if basis.harmonic else "seconds"
        raise ValueError(
            f"half_life={settings.half_life} {unit} keeps a memory of only {most:.3g} rows, too "
            f"few for block_rows={i} with {p} signals, which need {need}; use "
            f"half_life={1.01 * need / most * settings.half_life:.3g} or more, or fewer block rows"
        )


def _block_rows(basis, settings, lengths, n_channels):
    """Block rows given, or as many as rows allow by default."""
    i = asked_block_rows(basis, settings)
    if settings.block_rows is None:
        i = fewer_block_rows(i, basis.window_rows + 2, lengths, n_channels)
    return i


def _suffices(data, settings):
    """Whether chunks so far allow for a model; what rests is said."""
    facts, n_channels = data.facts, data.n_inputs + data.n_outputs
    if facts.still or not facts.outputs_move.any():
        what = f"the inputs {list(facts.still)} are" if facts.still else "all outputs are"
        warn(
            f"{what} at rest in the {facts.span}: there is no model until they move in a later "
            f"chunk",
            ExcitationWarning,
        )
        return False
    i = _block_rows(facts.basis, settings, data.lengths, n_channels)
    order = 1 if settings.order == "auto" else int(settings.order)
    enough = n_hankel_columns(data.lengths, i) >= i * n_channels + order
    return enough and order <= (i - 1) * data.n_outputs


def read_chunk(X, y, stream=None):
    """The experiment of one chunk, whose rows are those of the grid; dates from the first on."""
    origin = _first_date(X) if stream is None else stream.origin
    experiment = read_experiment(
        X, y, plain=PlainReading(timing=Timing(time_origin=origin or FIRST))
    )
    basis = experiment.basis
    if basis.reading in ("period", "sample"):
        raise ValueError(
            f"partial_fit accepts plain rows or a sliding window. A model of "
            f"reading={basis.reading!r} depends on the record as a whole; use fit, or an analyzer "
            f"with reading='sliding'"
        )
    if basis.small_signal is not None:
        raise ValueError(
            f"small_signal={basis.small_signal!r} combines whole records at several amplitudes; "
            f"use fit, or an analyzer with small_signal=None"
        )
    if basis.timing.missing != RAISE:
        raise ValueError(
            f"partial_fit takes no missing samples (missing={basis.timing.missing!r}): filling a "
            f"gap at the end of a chunk needs the next chunk; fill them before, or use fit"
        )
    if not all(piece.is_grid for piece in experiment.sampling.pieces):
        raise ValueError(
            "the rows of this chunk need resampling (because of an azimuth, jitter, or a period "
            "without a whole number of samples), which depends on rows of the next chunk; resample "
            "the record before you cut it into chunks, or use fit"
        )
    return experiment


def _check_first(experiment, block_rows, n_channels):
    """Raise ValueError if a first chunk tells no sample time, or its sums fill no memory."""
    base = experiment.base
    single = all(s.stop - s.start == 1 for s in base.segments)
    if not experiment.basis.harmonic and single and not base.counted:
        raise ValueError(
            f"no record of the first chunk has two rows (n_samples = {len(base.time)}), so the "
            f"sample time is unknown; begin with a longer chunk"
        )
    size = 8.0 * (2.0 * block_rows * n_channels) ** 2
    if size > MOST_BYTES:
        raise ValueError(
            f"block_rows={block_rows} with {n_channels} signals needs sums of {size:.2g} bytes; "
            f"use fewer block rows"
        )
