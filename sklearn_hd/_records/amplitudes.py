"""Records at several amplitudes, replaced by the small-signal records that models are fitted to.

Models are fitted to these; ``predict`` and ``score`` read records as they are.
"""

from dataclasses import fields

import numpy as np

from sklearn_hd._guards import warn
from sklearn_hd._records.sampling import regrouped
from sklearn_hd.algorithms.signals.amplitudes import (
    extrapolation_weights,
    n_distinct,
    odd_weights,
    same_waveform,
)
from sklearn_hd.exceptions import IdentifiabilityWarning

NOISE_GAIN = 10.0  # noise of a twentieth of the signal becomes half of it


def small_signal(experiment, how):
    """The experiment whose segments are the small-signal part of groups of records."""
    records = _segments_by_record(experiment)
    labels = list(records)
    combinations = []
    for same_times in _on_the_same_grid(records, experiment):
        inputs = [_joined(experiment.inputs, records[label], same_times) for label in same_times]
        for members, amplitudes in same_waveform(inputs):
            group = [list(same_times)[r] for r in members]
            _check_moves(how, group, amplitudes, labels)
            lengths = np.min([same_times[label] for label in group], axis=0)
            for row in _weights(how, group, amplitudes, labels):
                # named after the record that it comes closest to
                lead = group[int(np.argmax(np.where(row != 0.0, amplitudes, -np.inf)))]
                combinations.append((row, group, lead, lengths))
    return _combined(experiment, records, combinations)


def _segments_by_record(experiment):
    """Indices of the segments of each record."""
    base, records = experiment.base, {}
    for s, record in enumerate(base.records):
        records.setdefault(record, []).append(s)
    return records


def _on_the_same_grid(records, experiment):
    """Records whose segments start alike, in time since the record's start and in phase.

    Lengths may differ by less than a period, as those of flights do.

    Returns
    -------
    groups : list of dict
        Label of each record to the lengths of its segments.
    """
    basis, times = experiment.basis, experiment.times()
    found = {}
    for label, segments in records.items():
        first = times[segments[0]][0]
        starts = [round((times[s][0] - first) / basis.sample_time) for s in segments]
        phase = int(basis.phase_index(times[segments[0]])[0])
        lengths = np.array([len(times[s]) for s in segments])
        groups = found.setdefault((phase, *starts), [])
        for group in groups:
            every = np.array([*group.values(), lengths])
            if np.all(np.ptp(every, axis=0) < basis.samples_per_period):
                group[label] = lengths
                break
        else:
            groups.append({label: lengths})
    return [group for groups in found.values() for group in groups]


def _joined(blocks, segments, same_times):
    """Segments of one record end to end, cut to the shortest of the records."""
    lengths = np.min(list(same_times.values()), axis=0)
    return np.concatenate([blocks[s][:n] for s, n in zip(segments, lengths, strict=True)])


def _check_moves(how, group, amplitudes, labels):
    """Raise ValueError if the input of a record is at rest."""
    if amplitudes[0] == 0.0:
        raise ValueError(
            f"small_signal={how!r} found that the input of record {group[0]!r} is at rest (after "
            f"the trim is subtracted), so it has no amplitude; leave that record out of {labels}, "
            f"or use small_signal=None"
        )


def _weights(how, group, amplitudes, labels):
    """Weights of the records of a group, one row for each record that replaces them."""
    if how == "odd":
        rows, single = odd_weights(amplitudes)
        if single:
            r = single[0]
            raise ValueError(
                f"small_signal='odd' found no partner for record {group[r]!r} among {labels}: "
                f"{_beside(group, amplitudes, r)}, and no record is {-amplitudes[r]:.3g} times it "
                f"at the same times and phases; give pairs of records +u and -u (of equal length, "
                f"to within a period), leave {group[r]!r} out, or use small_signal='extrapolate' "
                f"(several amplitudes) or None"
            )
        return rows
    if n_distinct(amplitudes) < 2:
        raise ValueError(
            f"small_signal='extrapolate' found only one amplitude for record {group[0]!r} among "
            f"{labels}: no other record has a multiple of its input at the same times and phases; "
            f"give records of one waveform at two amplitudes or more (±a, or a and a/2), leave "
            f"{group[0]!r} out, or use small_signal=None"
        )
    weights = extrapolation_weights(amplitudes)
    gain = float(np.linalg.norm(weights))
    if gain > NOISE_GAIN:
        warn(
            f"extrapolating records {group} of amplitudes {np.round(amplitudes, 3).tolist()} to "
            f"zero multiplies the noise by {gain:.3g}; leave the smallest amplitudes out, or give "
            f"pairs of both signs and use small_signal='odd'",
            IdentifiabilityWarning,
        )
    return weights[None]


def _beside(group, amplitudes, r):
    if len(group) == 1:
        return "no other record has a multiple of its input"
    return f"its input is {amplitudes[r]:.3g} times that of {group[0]!r}"


def _combined(experiment, records, combinations):
    """The experiment of some linear combinations of records."""
    times, clocks = experiment.times(), _clocks(experiment)
    blocks = [f.name for f in fields(experiment) if isinstance(getattr(experiment, f.name), list)]
    values, labels, grids, clock = {name: [] for name in blocks}, [], [], []
    for weights, group, lead, lengths in combinations:
        for place, n in enumerate(lengths):
            parts = [records[label][place] for label in group]
            for name in blocks:
                block = getattr(experiment, name)
                values[name].append(
                    sum(w * block[s][:n] for w, s in zip(weights, parts, strict=True) if w)
                )
            labels.append(lead)
            grids.append(times[records[lead][place]][:n])
            clock.append(clocks[records[lead][place]][:n])
    return regrouped(experiment, values, grids, clock, labels)  # outputs without their trim


def _clocks(experiment):
    return [experiment.sampling.clock[segment] for segment in experiment.base.segments]
