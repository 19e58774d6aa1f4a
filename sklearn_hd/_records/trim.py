"""The trim of records: periodic waveforms of rows at rest, and what rows say against them."""

from dataclasses import replace

import numpy as np

from sklearn_hd._checks import check_span
from sklearn_hd._clock import resolution
from sklearn_hd._guards import warn
from sklearn_hd._records.bases import AUTO
from sklearn_hd._records.data import sample
from sklearn_hd._records.sampling import MOST_HARMONICS
from sklearn_hd.algorithms.linalg.rounding import PRECISION
from sklearn_hd.algorithms.signals.fourier import ROWS_PER_COLUMN, lift, standing_lines
from sklearn_hd.algorithms.signals.trim import drift, in_trim, motion_of, stands_out, turns_at_rest
from sklearn_hd.exceptions import IdentifiabilityWarning

MOST_MOTION = 0.01  # of its energy, that a trim may hold
MOST_WAVEFORM = 0.5  # of the energy of an output: a waveform that holds more is a trim
PARTS = 8  # of a record, by which a waveform is told from its motion


def with_trim(basis, signals, outputs, trim_span):
    """The basis with the waveforms of inputs and outputs in trim, as ``trim_span`` says.

    Parameters
    ----------
    basis : HarmonicBasis
    signals : Signals
        Inputs.
    outputs : ndarray, shape (n_rows, n_outputs), or None
    trim_span : (float, float), "auto" or None
    """
    span = None if trim_span is None else check_span("trim_span", trim_span, AUTO)
    samples = basis.reading == "sample"  # which identifies its forced response with the dynamics
    if span in (None, AUTO):
        if outputs is None:
            return basis
        if samples:
            asked = basis.n_load_harmonics is not None
            return basis if asked else _with_fast_waveform(basis, signals, outputs)
        sampling, *blocks = sample(signals, basis, outputs)
        found = _found(sampling, blocks, basis, named=span is not None)
        if found is None:
            return basis
        if basis.reading == "sliding" and not found["trim_known"]:
            _warn_of_no_rest()
        return replace(basis, **found)
    start, stop = span
    sampling, *blocks = sample(signals, basis, outputs)
    given = [values for values in blocks if values is not None]
    waveforms = [_waveform(sampling, values, basis, start, stop) for values in given]
    if not samples:
        _warn_of_drift(sampling, given, basis, start, stop)
    return replace(basis, **dict(zip(("input_trim", "output_trim"), waveforms, strict=False)))


def _with_fast_waveform(basis, signals, outputs):
    """The basis with the waveform of the outputs in harmonics that are faster than the forced
    response which samples are fitted with.

    Those whose lines stand out of the motion between them.
    """
    step = signals.base.sample_time
    highest = int(np.ceil(np.pi / basis.omega / step * (1.0 - PRECISION))) - 1
    highest = min(MOST_HARMONICS, highest)
    psi = basis.omega * signals.places(basis.omega, step)
    known = np.isfinite(outputs).all(axis=1) & np.isfinite(psi)
    if highest <= basis.most_loads or known.sum() < ROWS_PER_COLUMN * (4 * highest + 1):
        return basis
    fast = standing_lines([(outputs[known], psi[known])], highest)
    fast[: 2 * basis.most_loads + 1] = 0.0
    if not fast.any():
        return basis
    return replace(basis, output_trim=fast, trim_known=False)


def _found(sampling, blocks, basis, named):
    """Waveforms of turns in trim; None where those of the outputs are no more than noise.

    Where nothing rests those of all turns, if outputs hold little else, or of those in which the
    inputs alone rest: what that of the outputs is off by is identified with the dynamics. Period
    by period the trim of inputs is then zero, unless their mean is larger than their motion.

    ``named`` is False for ``trim_span=None``, by which the outputs are about their trim. Period by
    period a waveform is then identified with the dynamics all the same, unless the mean of the
    inputs may make it; that, and what sliding windows show, is told and left as it is.
    """
    units = [_exponent(values) for values in blocks]
    inputs, outputs = (
        _lifted(sampling, [np.ldexp(z, -unit) for z in values], basis)
        for values, unit in zip(blocks, units, strict=True)
    )
    u, y = (np.concatenate(signals) for signals in (inputs, outputs))
    if len(y) < 2:
        return None
    motion = motion_of(outputs)
    rest = np.concatenate(in_trim(inputs, outputs))
    sliding = basis.reading == "sliding"
    known = bool(rest.any()) and (named or sliding)
    if known:
        stands = stands_out(y[rest], motion)
    else:
        rest = np.concatenate(turns_at_rest(inputs))
        rest = rest if rest.any() else ~rest
        stands = len(y) >= PARTS and _share(y.mean(axis=0), y) > MOST_WAVEFORM
        if stands:
            parts = [part.mean(axis=0) for part in np.array_split(y, PARTS)]
            stands = stands_out(np.array(parts), motion)
    waveform = y[rest].mean(axis=0)
    if not stands or np.max(np.abs(waveform)) <= PRECISION * np.max(np.abs(y)):
        return None
    level = u[rest].mean(axis=0)
    if not known and basis.reading == "period":  # which identifies what that brings about
        level = np.where(_in_square(level) > _in_square(u - level), level, 0.0)
    if not named and (sliding or level.any()):
        _warn_of_no_trim(_share(waveform, y))
        return None
    trim = (np.ldexp(z, unit) for z, unit in zip((level, waveform), units, strict=True))
    return dict(zip(("input_trim", "output_trim"), trim, strict=True), trim_known=known)


def _in_square(turns):
    """Mean square of each signal."""
    return np.mean(turns**2, axis=tuple(range(turns.ndim - 1)))


def _exponent(values):
    """Of the power of two near the largest of some signals: squares of their parts stay numbers."""
    return int(np.frexp(max(np.max(np.abs(z), initial=0.0) for z in values))[1])


def _share(waveform, turns):
    """Of the energy of an output that is a waveform which repeats itself, the largest."""
    whole, left = (np.sum(each**2, axis=(0, 1)) for each in (turns, turns - waveform))
    return float(np.max((whole - left) / np.where(whole > 0.0, whole, 1.0)))


def _lifted(sampling, values, basis, inside=None):
    """Whole turns of each segment, those inside a span alone where one is given."""
    parts = zip(sampling.base.segments, values, strict=True)
    spp = basis.samples_per_period
    found = []
    for segment, block in parts:
        phase = basis.phase_index(sampling.base.time[segment])
        turns = lift(block, phase, spp)
        if inside is not None:
            turns = turns[lift(inside[segment][:, None], phase, spp).all(axis=(1, 2))]
        found.append(turns)
    return found


def _inside(sampling, basis, start, stop):
    """Which rows of the grid lie between two times."""
    tolerance = max(1e-6 * basis.sample_time, resolution(sampling.clock))
    return (sampling.clock >= start - tolerance) & (sampling.clock < stop - tolerance)


def _waveform(sampling, blocks, basis, start, stop):
    """Periodic waveforms over the trim span, pooled over records."""
    spp = basis.samples_per_period
    inside, kept = _inside(sampling, basis, start, stop), []
    for segment, values in zip(sampling.base.segments, blocks, strict=True):
        rows = np.flatnonzero(inside[segment])
        rows = rows[: int(len(rows) // spp * spp)]  # whole periods: each phase counts alike
        kept.append((values[rows], sampling.base.time[segment][rows]))
    waveforms = basis.mean_waveforms(kept)
    if waveforms is None:
        raise ValueError(
            f"trim_span=({start:g}, {stop:g}) holds less than one whole period "
            f"({spp * basis.sample_time:.4g} s) of any record; widen it. If a fold of a "
            f"cross-validation leaves it out, keep it in all folds: PeriodBlockSplit(..., "
            f"trim_span=...)"
        )
    return waveforms


def _warn_of_drift(sampling, given, basis, start, stop):
    """Of a span in which inputs move, or outputs have not come to rest."""
    inside = _inside(sampling, basis, start, stop)
    whole, within = (
        [_lifted(sampling, values, basis, *rows) for values in given] for rows in ((), (inside,))
    )
    motions = [motion_of(turns) for turns in whole]
    n_turns = sum(map(len, within[0]))
    if n_turns < 2:
        return
    moved = motion_of(within[0]) / np.where(motions[0] > 0.0, motions[0], 1.0) / n_turns
    still = np.concatenate(turns_at_rest(whole[0]))  # inputs of noise alone rest nowhere
    if still.any() and np.max(moved) > MOST_MOTION:
        what, share = "inputs move", np.max(moved)
    else:
        pairs = zip(within, motions, strict=True)
        share = max(drift(turns, motion) for parts, motion in pairs for turns in parts)
        what = "outputs are not at rest"
    if share > MOST_MOTION:
        warn(
            f"the {what} within trim_span=({start:g}, {stop:g}): the waveform subtracted as trim "
            f"holds {np.sqrt(share):.2g} of the motion in the record (rms); give a span that "
            f"begins when outputs have settled and ends before inputs move, or trim_span='auto'",
            IdentifiabilityWarning,
        )


def _warn_of_no_trim(share):
    """Of outputs that are mostly a periodic waveform which nobody subtracts."""
    if share > MOST_WAVEFORM:
        warn(
            f"the outputs repeat themselves from turn to turn: a periodic waveform is {share:.4g} "
            f"of the energy of an output, but trim_span=None subtracts none; unless the inputs "
            f"make it, the waveform is identified as a multiplier at 1 and dominates R²; give "
            f"trim_span='auto', or the times of the trim",
            IdentifiabilityWarning,
        )


def _warn_of_no_rest():
    """Of a trim that a sliding window's models know no better than the mean over the record."""
    warn(
        "trim_span='auto': no turn is in trim, where inputs rest and outputs repeat themselves, so "
        "the mean waveform of turns in which outputs move is subtracted instead; use a record with "
        "a span in trim, or reading='sample' or 'period', which identify the trim together with "
        "the dynamics",
        IdentifiabilityWarning,
    )
