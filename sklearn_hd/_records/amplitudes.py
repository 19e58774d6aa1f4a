"""Records at several amplitudes, replaced by the small-signal records that models are fitted to.

Models are fitted to these; ``predict`` and ``score`` read records as they are.

A nonlinear system answers the input a·u(t) with a power series in a,

    y(t; a) = a y_1(t) + a² y_2(t) + … ,

of which only y_1 is the response of its linearisation. Records at amplitudes
a_1, a_2, … hold y_1 in a combination that no other power enters:

    Σ_r w_r a_r = a_max,   Σ_r w_r a_r^p = 0  (p = 2 … q)
        ⇒   Σ_r w_r y(t; a_r) = a_max y_1(t) + O(a^{q+1}).

For the pair ±a, w = (½, −½): the odd part, wrong by a³ y_3 only. The same
combination is taken of the inputs, so that amplitudes need not be known
exactly for input and output to belong together. White noise of one size in
each record becomes ‖w‖ times as large (0.71 for a pair).
"""

from dataclasses import fields

import numpy as np

from sklearn_hd._guards import warn
from sklearn_hd._records.sampling import regrouped
from sklearn_hd.algorithms.linalg.triangular import column_rms
from sklearn_hd.exceptions import IdentifiabilityWarning

SAME_WAVEFORM = 0.1  # share of an input that may be no multiple: noise of 1/20 on both gives 0.07
SAME_SIZE = 0.05  # share by which two amplitudes differ that were meant to be alike
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

    Each group has the lengths of the segments of each record, by its label.
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
    times = experiment.times()
    clocks = [experiment.sampling.clock[segment] for segment in experiment.base.segments]
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


# ---- the linear part of responses ----------------------------------------------------------------


def same_waveform(inputs):
    """Records whose inputs are multiples of one waveform, and the multiples.

    Each record has an array, and all are on the same grid from the first row on.
    Lengths may differ: the rows that two records share are compared. Groups are pairs
    of indices and amplitudes, multiples of the largest input of the group, which comes
    first with amplitude 1. A record at rest stands alone with amplitude 0.

    Examples
    --------
    >>> u = np.array([[0.0], [1.0], [-1.0]])
    >>> [(rows.tolist(), a.tolist()) for rows, a in same_waveform([u, -2 * u, 0 * u])]
    [([1, 0], [1.0, -0.5]), ([2], [0.0])]
    """
    scale = column_rms(np.vstack(inputs))
    inputs = [u / scale for u in inputs]
    left = sorted(range(len(inputs)), key=lambda r: -np.linalg.norm(inputs[r]))
    groups = []
    while left:
        waveform, members, amplitudes = inputs[left[0]], [], []
        for r in left:
            n = min(len(waveform), len(inputs[r]))
            u, v = inputs[r][:n], waveform[:n]
            a = float(np.vdot(v, u) / (np.vdot(v, v) or 1.0))
            if r == left[0] or np.linalg.norm(u - a * v) <= SAME_WAVEFORM * np.linalg.norm(u):
                members.append(r)
                amplitudes.append(a)
        moving = np.array(amplitudes) != 0.0  # zero is a multiple of anything
        if moving[0]:
            members = [r for r, moves in zip(members, moving, strict=True) if moves]
            amplitudes = [a for a in amplitudes if a != 0.0]
        else:
            members, amplitudes = members[:1], amplitudes[:1]
        groups.append((np.array(members), np.array(amplitudes)))
        left = [r for r in left if r not in members]
    return groups


def extrapolation_weights(amplitudes):
    """Weights w of the records that leave the linear term, at the largest amplitude.

    As many powers are told apart as there are distinct amplitudes; records of
    one amplitude are averaged.

    Amplitudes have signs, and none is zero.

    Examples
    --------
    >>> extrapolation_weights([1.0, -1.0]).tolist()
    [0.5, -0.5]
    >>> extrapolation_weights([2.0, 1.0]).round(12).tolist()
    [-1.0, 4.0]
    """
    amplitudes = np.asarray(amplitudes, dtype=float)
    largest = amplitudes[np.argmax(np.abs(amplitudes))]
    a = amplitudes / largest
    powers = a[:, None] ** np.arange(1, n_distinct(a) + 1)
    # rounded to what the amplitudes are known to, so that ± pairs give ± ½ to the last digit
    return np.linalg.pinv(powers)[0].round(14)


def n_distinct(amplitudes):
    """Number of amplitudes that differ by more than what two meant to be alike do.

    Examples
    --------
    >>> n_distinct([1.0, 0.98, -1.0, 0.5])
    3
    """
    a = np.sort(np.asarray(amplitudes, dtype=float))
    size = np.maximum(np.abs(a[:-1]), np.abs(a[1:]))
    return 1 + int(np.sum(np.diff(a) > SAME_SIZE * size))


def odd_weights(amplitudes):
    """Weights of the records for each pair ±a, and the records without a partner.

    Records of one amplitude and sign are averaged. Sizes that differ by up to
    5 % make a pair; their quadratic terms cancel all the same.

    Amplitudes are as for :func:`extrapolation_weights`, and weights have shape
    (n_pairs, n_records). Single records are those whose amplitude stands there with one
    sign only.

    Examples
    --------
    >>> weights, single = odd_weights([1.0, -1.0, 0.5])
    >>> weights.tolist(), single
    ([[0.5, -0.5, 0.0]], [2])
    """
    a = np.asarray(amplitudes, dtype=float)
    order = np.argsort(-np.abs(a), kind="stable")
    sizes = np.abs(a[order])
    breaks = np.flatnonzero(sizes[:-1] - sizes[1:] > SAME_SIZE * sizes[:-1]) + 1
    rows, single = [], []
    for members in np.split(order, breaks):
        if np.all(a[members] > 0.0) or np.all(a[members] < 0.0):
            single += members.tolist()
            continue
        row = np.zeros(len(a))
        for sign, mean in zip((1.0, -1.0), _pair_weights(a[members]), strict=True):
            side = members[np.sign(a[members]) == sign]
            row[side] = mean / len(side)
        rows.append(row)
    return np.array(rows).reshape(-1, len(a)), sorted(single)


def _pair_weights(a):
    """Weights of the mean positive and the mean negative record."""
    plus, minus = float(np.mean(a[a > 0.0])), float(np.mean(a[a < 0.0]))
    weights = extrapolation_weights([plus, minus]) if plus != -minus else np.array([0.5, -0.5])
    return weights if plus >= -minus else -weights
