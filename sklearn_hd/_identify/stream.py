"""Data that arrive in chunks: what ``MOESPRegressor.partial_fit`` keeps of them.

Rows are read as a fit would read them all at once: plain rows as they are; through a sliding
window those at ψ = 0 mod hop, once their windows, hops and whole periods are complete. The raw
rows that this takes are carried over to the next chunk.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from sklearn_hd._checks import FIRST, RAISE
from sklearn_hd._identify.modulation import (
    largest_changes,
    modulated,
    n_modulating_harmonics,
    steps_at_one_phase,
)
from sklearn_hd._readings import PlainReading, Timing, first_difference
from sklearn_hd._records.data import read_experiment
from sklearn_hd._time import STEP_TOLERANCE
from sklearn_hd.algorithms.subspace.running_products import RunningRecord, RunningSums

__all__ = ["Stream", "first_date", "read_chunk"]

DUST = 1e-12  # share of an input's size that is rounding
PART = 2**17  # rows read at a time
MOST_BYTES = 2**33  # of one matrix of the sums


@dataclass(frozen=True)
class OpenRecord:
    """A record that the next chunk may go on with.

    Attributes
    ----------
    label : object
    time, inputs, outputs : ndarray, shapes (n_carried,), (n_carried, m), (n_carried, l)
        Rows carried over, less their trim.
    sums : RunningRecord
    read_until : float
        Time of the last row added to the sums.
    """

    label: object
    time: np.ndarray
    inputs: np.ndarray
    outputs: np.ndarray
    sums: RunningRecord
    read_until: float = -np.inf


@dataclass(frozen=True)
class Stream:
    """Sums over all chunks so far; a chunk makes a new one.

    Attributes
    ----------
    block_rows : int
        The most that a model can be made with.
    basis : HarmonicBasis or None
    sample_time : float
    input_names, drive_names, output_names : tuple of str
    origin : str or None
        The instant from which dates are counted.
    closed : RunningSums or None
        Of records that are over.
    record : OpenRecord or None
    n_rows : int
        Of all chunks.
    first, last : float
        Times of the first and the last of them.
    smallest, largest : ndarray, shapes (n_drive + l,)
        Of any row.
    changes : ndarray, shape (samples_per_period, n_drive), or None
        Largest changes of the drive, by phase.
    """

    block_rows: int
    basis: object
    sample_time: float
    input_names: tuple
    drive_names: tuple
    output_names: tuple
    origin: str | None = None
    closed: RunningSums | None = None
    record: OpenRecord | None = None
    n_rows: int = 0
    first: float = 0.0
    last: float = 0.0
    smallest: np.ndarray = field(default=None)
    largest: np.ndarray = field(default=None)
    changes: np.ndarray | None = None

    # ---- chunks ------------------------------------------------------------------------------

    @classmethod
    def begin(cls, experiment, block_rows, origin=None):
        """A stream of no rows, of data such as those of an experiment."""
        basis, n = experiment.basis, len(experiment.drive_names) + len(experiment.output_names)
        _check_first(experiment, block_rows, n)
        changes = None
        if basis.harmonic:
            changes = np.zeros((basis.samples_per_period, len(experiment.drive_names)))
        return cls(
            block_rows,
            basis,
            experiment.base.sample_time,
            _input_names(experiment),
            tuple(experiment.drive_names),
            tuple(experiment.output_names),
            origin,
            first=float(experiment.sampling.clock[0]),
            smallest=np.full(n, np.inf),
            largest=np.full(n, -np.inf),
            changes=changes,
        )

    def with_chunk(self, experiment, told=None):
        """The stream and one more chunk.

        Parameters
        ----------
        experiment : Experiment
        told : callable, optional
            ``told(done, note)``, with the rows of the chunk done.

        Raises
        ------
        ValueError
            If the chunk has other columns, another sample time or basis, or does not
            follow on what was read before.
        """
        self._check_alike(experiment)
        base, stream, done = experiment.base, self, 0
        for s, (time, label) in enumerate(zip(experiment.times(), base.records, strict=True)):
            rows = time, experiment.inputs[s], experiment.outputs[s]
            if s == 0 and base.counted and stream._counts_on(time, label):
                rows = stream._continued(*rows)
            time, inputs, outputs = rows
            if s > 0 or not stream._goes_on(time, label):
                stream = stream._with_record_closed(label)
            for first in range(0, len(time), PART):
                part = slice(first, first + PART)
                stream = stream._with_rows(time[part], inputs[part], outputs[part])
                done += len(time[part])
                if told is not None:
                    told(done, f"{self.n_rows + done} rows so far")
        return replace(
            stream, n_rows=self.n_rows + len(base.time), last=float(stream.record.time[-1])
        )

    def _check_alike(self, experiment):
        """Raise ValueError unless a chunk is sampled and analysed as those before it."""
        for what, here, there in (
            ("inputs", _input_names(experiment), self.input_names),
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
                f"this chunk carries {has}harmonic basis, the first one {had.strip()} one; pass "
                f"all chunks through the same HarmonicAnalyzer, or none"
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
        tolerance = STEP_TOLERANCE * self.sample_time + 4.0 * base.uncertainty
        if not single and abs(dt - self.sample_time) > tolerance:
            raise ValueError(
                f"the rows of this chunk are {dt:.6g} s apart, those of the first one "
                f"{self.sample_time:.6g} s; resample the chunk"
            )

    def _counts_on(self, time, label):
        """Whether rows are counted from 0 where a record goes on."""
        return self.record is not None and self.record.label == label and time[0] <= 0.0

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
                f"this chunk begins at t = {time[0]:.6g} s, before the end of the last one "
                f"(t = {self.record.time[-1]:.6g} s) in the same record; give chunks in order, or "
                f"rows of other records a label of their own in a (record, time) MultiIndex"
            )
        return step < 1.5

    def _with_record_closed(self, label):
        """The stream with its open record added to those that are over, and a new one begun."""
        n_inputs, n_outputs = self._n_channels()
        sums = RunningRecord.begin(
            2 * self.block_rows,
            inputs=self._wave_channels(0),
            outputs=n_inputs + np.arange(n_outputs),
            n_channels=n_inputs + n_outputs,
        )
        empty = [np.zeros((0, k)) for k in (len(self.input_names), len(self.output_names))]
        return replace(
            self, closed=self.sums(), record=OpenRecord(label, np.zeros(0), *empty, sums)
        )

    def _with_rows(self, time, inputs, outputs):
        """The stream with more rows of its open record."""
        old = self.record
        parts = ((old.time, time), (old.inputs, inputs), (old.outputs, outputs))
        record = replace(
            old, **dict(zip(("time", "inputs", "outputs"), map(np.concatenate, parts), strict=True))
        )
        if self.basis.harmonic:
            return self._with_complete_rows(record)
        rows = np.hstack([inputs, outputs])
        last = {name: getattr(record, name)[-1:] for name in ("time", "inputs", "outputs")}
        record = replace(record, sums=old.sums.extended(rows), **last)
        return replace(self._with_extremes(rows), record=record)

    def _with_extremes(self, rows):
        """The stream with the smallest and largest values of more rows."""
        return replace(
            self,
            smallest=np.minimum(self.smallest, rows.min(axis=0, initial=np.inf)),
            largest=np.maximum(self.largest, rows.max(axis=0, initial=-np.inf)),
        )

    # ---- through a sliding window ------------------------------------------------------------

    def _drive(self, record):
        return self.basis.drive(record.inputs, record.time)

    def _with_complete_rows(self, record):
        """The stream with what the rows carried over and those that came have complete."""
        basis = self.basis
        complete = len(record.time)
        if any(orders != (0,) for _, orders in basis.inputs):  # coefficients of whole periods
            complete -= (basis.phase_index(record.time)[-1] + 1) % basis.samples_per_period
        drive = self._drive(record)
        done = slice(0, complete)
        changes = largest_changes(basis, drive[done], record.time[done])
        stream = replace(self, changes=np.maximum(self.changes, changes))
        stream = stream._with_extremes(np.hstack([drive[done], record.outputs[done]]))
        rows = self._unread(record)
        rows = rows[rows + basis.lead + basis.hop <= complete]
        record = self._with_read(record, drive, rows)
        # the next row's window, and the whole periods that it reaches into
        unread = self._unread(record)
        needed = unread[0] if len(unread) else len(record.time) - 1
        needed = needed + basis.lead - len(basis.weights) - 2 * basis.samples_per_period
        starts = np.flatnonzero(basis.phase_index(record.time) == 0)
        starts = starts[starts <= needed]
        keep = slice(int(starts[-1]) if len(starts) else 0, None)
        record = replace(
            record,
            time=record.time[keep],
            inputs=record.inputs[keep],
            outputs=record.outputs[keep],
        )
        return replace(stream, record=record)

    def _unread(self, record):
        """Rows with whole windows not yet added to the sums."""
        if len(record.time) < len(self.basis.weights):
            return np.zeros(0, dtype=int)
        rows = self.basis.rows_read(record.time)
        return rows[record.time[rows] > record.read_until + 0.5 * self.sample_time]

    def _with_read(self, record, drive, rows):
        """The record with some rows added to its sums."""
        if len(rows) == 0:
            return record
        basis, time = self.basis, record.time
        inputs = modulated(basis, drive, time, rows, basis.rows_per_period // 2)
        outputs = basis.output_coefficients(record.outputs, time, rows)
        sums = record.sums.extended(np.hstack([inputs, outputs]))
        return replace(record, sums=sums, read_until=float(time[rows[-1]]))

    def _n_channels(self):
        """Channels of the sums: what inputs become, and what outputs become."""
        m, basis = len(self.drive_names), self.basis
        if not basis.harmonic:
            return m, len(self.output_names)
        return m * (2 * (basis.rows_per_period // 2) + 1), len(basis.output_labels)

    def _wave_channels(self, highest, which=slice(None)):
        """Channels of the inputs times 1, cos ψ, sin ψ, … up to some harmonic."""
        m, n_channels = len(self.drive_names), self._n_channels()[0]
        channels = np.arange(n_channels).reshape(m, n_channels // max(m, 1))
        return channels[which, : 2 * highest + 1].ravel()

    # ---- what a model is made of -------------------------------------------------------------

    def sums(self):
        """Sums over everything so far, as if the open record were over; None of no rows."""
        record = self.record
        if record is None or (not self.basis.harmonic and record.sums.n_rows == 0):
            return self.closed
        if self.basis.harmonic:
            record = self._with_read(record, self._drive(record), self._unread(record))
            if record.sums.n_rows == 0:
                return self.closed
        sums = record.sums.closed()
        return sums if self.closed is None else self.closed + sums

    def moving(self):
        """Which of the drive has moved so far, and whether any output has.

        Coefficients of an input no larger than rounding beside others of it have not.
        """
        moved = np.maximum(self.largest - self.smallest, 0.0)
        drive, outputs = moved[: len(self.drive_names)], moved[len(self.drive_names) :]
        signals = self.drive_signals()
        size = {s: max(d for d, o in zip(drive, signals, strict=True) if o == s) for s in signals}
        moving = [d > DUST * size[s] for d, s in zip(drive, signals, strict=True)]
        return np.array(moving, dtype=bool), bool(outputs.any())

    def drive_signals(self):
        """The measured signal that each entry of ``drive_names`` comes from."""
        return self.basis.drive_signals

    def channels(self, sums, moving):
        """Channels of inputs projected out of the future, of inputs alone, and of outputs.

        As a fit chooses them: inputs alone where they change at one phase of the period.
        """
        n_inputs, n_outputs = self._n_channels()
        highest = 0
        if self.basis.harmonic and not steps_at_one_phase(self.changes):
            lengths = [ends.n_rows for ends in sums.ends]
            highest = n_modulating_harmonics(self.basis, lengths, len(self.drive_names))
        wide, alone = (self._wave_channels(k, moving) for k in (highest, 0))
        return wide, alone, n_inputs + np.arange(n_outputs)

    def span(self):
        """First and last time, worded for messages."""
        return f"rows from t = {self.first:.6g} s to {self.last:.6g} s"


def first_date(data):
    """The first of the dates that rows are indexed by, as ISO text; None where there are none."""
    index = getattr(data, "index", None)
    times = index.get_level_values(-1) if isinstance(index, pd.Index) else None
    return times.min().isoformat() if isinstance(times, pd.DatetimeIndex) else None


def read_chunk(X, y, origin=None):
    """The experiment of one chunk, whose rows are those of the grid; dates from an origin on."""
    experiment = read_experiment(
        X, y, plain=PlainReading(timing=Timing(time_origin=origin or FIRST))
    )
    basis = experiment.basis
    if basis.reading == "period":
        raise ValueError(
            "partial_fit reads rows one by one or through a sliding window, not period by period "
            "(reading='period'), where a model depends on which directions inputs take over the "
            "whole record; use fit, or an analyzer with reading='sliding'"
        )
    if basis.small_signal is not None:
        raise ValueError(
            f"small_signal={basis.small_signal!r} combines whole records at several amplitudes; "
            f"use fit, or an analyzer with small_signal=None"
        )
    if basis.timing.missing != RAISE:
        raise ValueError(
            f"partial_fit takes no missing samples (missing={basis.timing.missing!r}): what is "
            f"bridged at the end of a chunk depends on the next; fill them before, or use fit"
        )
    if not all(piece.is_grid for piece in experiment.sampling.pieces):
        raise ValueError(
            "the rows of this chunk would have to be resampled (an azimuth, jitter, or no whole "
            "number of samples in a period), which depends on rows of the next; resample the "
            "record before it is cut into chunks, or use fit"
        )
    return experiment


def _check_first(experiment, block_rows, n_channels):
    """Raise ValueError if a first chunk tells no sample time, or its sums fill no memory."""
    base = experiment.base
    single = all(s.stop - s.start == 1 for s in base.segments)
    if not experiment.basis.harmonic and single and not base.counted:
        raise ValueError(
            f"no record of the first chunk has two rows (n_samples = {len(base.time)}), from which "
            f"the sample time could be told; begin with a longer chunk"
        )
    size = 8.0 * (2.0 * block_rows * n_channels) ** 2
    if size > MOST_BYTES:
        raise ValueError(
            f"block_rows={block_rows} with {n_channels} signals asks for sums of {size:.2g} bytes; "
            f"use fewer block rows"
        )


def _input_names(experiment):
    """Names of the raw inputs."""
    return tuple(experiment.basis.input_signals)
