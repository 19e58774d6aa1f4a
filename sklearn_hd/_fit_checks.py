"""Checks of the data of a fit: no motion, another fundamental frequency, growth."""

import numpy as np

from sklearn_hd._checks import STANDARD_ERRORS
from sklearn_hd._guards import searching, warn
from sklearn_hd.algorithms.linalg.rounding import EXACT, HALF
from sklearn_hd.algorithms.lti.simulation import GROWN, growth
from sklearn_hd.algorithms.periodic.multipliers import SURE
from sklearn_hd.algorithms.signals.fourier import MOST_ROWS, ROWS_PER_COLUMN, harmonic_functions
from sklearn_hd.algorithms.signals.fundamental import FEWEST, omega_mismatch
from sklearn_hd.exceptions import (
    ExcitationWarning,
    FrequencyMismatchWarning,
    IdentifiabilityWarning,
    InstabilityWarning,
)

HALF_KEPT = 0.5  # of what neighbouring samples share, that rows read have to
LINES = 20  # harmonics of an orbit that are looked for
MOST_OF_IT = 0.5  # of an output's variance
LOST = 1e8  # times growth beside which rounding leaves half of the digits of what decays
MIN_PERIODS = 6  # to see a rate in
CALM = 1e6  # times growth that leaves most of them


def warn_of_data(experiment):
    """Warn of what a record shows by itself: a copy, another frequency, an offset, growth.

    Samples take an offset for a load, and growth for an unstable mode.
    """
    _warn_of_copies(experiment)
    warn_of_mismatch(experiment)
    if experiment.basis.reading != "sample":
        warn_of_offset(experiment)
        warn_of_growing_data(experiment)
    if not experiment.basis.harmonic:
        _warn_of_mean(experiment)


def _warn_of_copies(experiment):
    """Warn of an input that has the values of an output, by some of the rows."""
    inputs, outputs = (  # halves, whose differences do not overflow
        np.vstack([0.5 * z[:: 1 + len(z) // MOST_ROWS] for z in each])
        for each in (experiment.inputs, experiment.outputs)
    )
    moves, size = np.ptp(inputs, axis=0), np.ptp(outputs, axis=0)
    for j, k in np.argwhere(np.abs(moves[:, None] - size) <= EXACT * size):
        if size[k] > 0.0 and np.ptp(inputs[:, j] - outputs[:, k]) <= EXACT * size[k]:
            warn(
                f"the input {experiment.basis.input_signals[j]!r} has the values of the output "
                f"{experiment.output_names[k]!r}: the model repeats them, and R² of that output "
                f"says nothing; take it out of X, or out of y",
                IdentifiabilityWarning,
            )


def warn_of_mismatch(experiment):
    """Warn if the data repeat themselves at another frequency than omega, and return whether.

    No check is possible if inputs never rest for some periods, and none is needed if the azimuth
    was measured. In a search the fit of all data gives the warning.
    """
    basis = experiment.basis
    if not basis.harmonic or basis.timing.azimuth is not None or searching():
        return False
    if _warn_of_hertz(experiment):
        return True
    outputs, trim = experiment.outputs, experiment.output_trim()
    if trim is not None and basis.small_signal is None:
        # a trim averaged at the wrong period is no trim: back to what was measured
        outputs = [y + waveform for y, waveform in zip(outputs, trim, strict=True)]
    step = experiment.base.sample_time
    starts = [time[0] for time in experiment.times()]
    estimate = omega_mismatch(experiment.drive, outputs, step, basis.omega, starts=starts)
    if estimate is None:
        return False
    worse = np.sqrt(estimate.residual_given / estimate.residual)
    warn(
        f"the data repeat themselves {words_of_omega(estimate, basis.omega)}; at "
        f"omega={basis.omega:.9g}, {worse:.3g} times as much of them (rms) stays unexplained from "
        f"period to period, and the phase error grows to {estimate.turns:.2g} periods over the "
        f"longest segment ({experiment.span()}); {way_out(estimate)}",
        FrequencyMismatchWarning,
    )
    return True


def _warn_of_hertz(experiment):
    """Warn if most of an output is an orbit of 2π times omega, and return whether."""
    piece = max(experiment.sampling.pieces, key=lambda piece: len(piece.places))
    rows, omega = slice(0, MOST_ROWS), experiment.basis.omega
    y, places = np.nan_to_num(experiment.measured[piece.rows][rows]), piece.places[rows]
    if (places[-1] - places[0]) * omega < 2.0 * np.pi * FEWEST:
        return False  # any few waves make a short record
    there = _share_in_lines(y, places, 2.0 * np.pi * omega)
    if not np.any(there > MOST_OF_IT):
        return False
    here = _share_in_lines(y, places, omega)
    told = (there > MOST_OF_IT) & (here < there / 2.0)
    if not told.any():
        return False
    k = int(np.argmax(np.where(told, there, 0.0)))
    warn(
        f"{there[k]:.0%} of the variance of the output {experiment.output_names[k]!r} has the "
        f"frequency {2.0 * np.pi * omega:.6g} rad/s and its harmonics, 2π times omega={omega:.6g}, "
        f"and {max(here[k], 0.0):.0%} has that of omega: omega is in rad/s; if it was given in Hz, "
        f"multiply it by 2π",
        FrequencyMismatchWarning,
    )
    return True


def _share_in_lines(y, places, omega):
    """Share of the variance of each output in waves of a frequency and its harmonics, that last
    from the first row to the last; as many as there are below half the sampling rate."""
    n, count = len(y), 0
    if n >= ROWS_PER_COLUMN:
        count = min(LINES, int(0.9 * np.pi / (omega * np.median(np.diff(places)))))
    if count == 0 or n < ROWS_PER_COLUMN * (2 * count + 1):
        return np.zeros(y.shape[1])
    size = np.max(np.abs(y), axis=0)
    y = y / np.where(size > 0.0, size, 1.0)
    waves = harmonic_functions(omega * places, range(count + 1))
    left = y - waves @ np.linalg.lstsq(waves, y, rcond=None)[0]
    total = np.var(y, axis=0)
    left = np.mean(left**2, axis=0) * n / (n - waves.shape[1])  # as noise would leave
    return 1.0 - left / np.where(total > 0.0, total, np.inf)


def words_of_omega(estimate, omega):
    """The frequency at which data repeat themselves, for messages."""
    slower = [rival for rival in estimate.rivals if rival < estimate.omega]
    if slower:
        return f"at {slower[0]:.9g} rad/s; omega={estimate.omega:.9g} rad/s is a multiple of that"
    if estimate.drift:
        start, end = (estimate.omega + share * estimate.drift for share in (-0.5, 0.5))
        return (
            f"at a speed that drifts by {estimate.drift / estimate.omega:.2%}, from {start:.7g} to "
            f"{end:.7g} rad/s (a change of {estimate.drift:.3g} ± {estimate.drift_std:.2g}); it is "
            f"not constant at omega={omega:.7g} rad/s"
        )
    off = omega / estimate.omega - 1.0
    return (
        f"at {estimate.omega:.9g} ± {estimate.std:.2g} rad/s, not at omega={omega:.9g} rad/s, "
        f"which is {abs(off):.2{'%' if abs(off) > 1e-4 else 'g'}} {'more' if off > 0.0 else 'less'}"
    )


def way_out(estimate):
    """The way out of a wrong frequency, for messages."""
    slower = [rival for rival in estimate.rivals if rival < estimate.omega]
    if slower:
        return f"set omega={slower[0]:.9g}"
    if estimate.of_inputs:
        return (
            "the inputs, too, repeat themselves so, and the outputs have no motion of that "
            "frequency beside them: it may be the clock of the inputs; keep omega if it is known, "
            "and hold inputs for uneven times"
        )
    if estimate.drift:
        return "measure the azimuth and give azimuth=, or use records of constant speed"
    return f"set omega={estimate.omega:.9g}, or check the clock"


def warn_of_offset(experiment):
    """Warn if records begin with inputs that rest, but not at zero, and outputs that rest at zero.

    Long enough for a response to show: as many rows as a score fits an initial state on.
    """
    heads = [_head(u, experiment.basis.warmup_samples) for u in experiment.inputs]
    rests = [
        (u[0], np.max(np.abs(u), axis=0), y[:n])
        for u, y, n in zip(experiment.inputs, experiment.outputs, heads, strict=True)
        if n > 0
    ]
    trim = experiment.basis.input_trim
    trim = 0.0 if trim is None else np.max(np.abs(trim), axis=0)  # which leaves rounding
    off = [np.abs(rest) > EXACT * (size + trim) for rest, size, _ in rests]
    if not rests or not np.any(off) or not all(_is_zero(y) for _, _, y in rests):
        return
    names = experiment.basis.input_signals or experiment.basis.drive_labels
    which = np.flatnonzero(np.any(off, axis=0))
    found = ", ".join(
        f"{names[i]!r} at {max((r[i] for r, _, _ in rests), key=abs):.3g}" for i in which
    )
    warn(
        f"records begin with outputs at rest at zero and inputs at rest elsewhere ({found}), but a "
        f"linear model rests only where its inputs are zero: subtract the rest values, and scale "
        f"inputs without shifting them (StandardScaler(with_mean=False), MaxAbsScaler), or give "
        f"HarmonicAnalyzer a trim_span of rows at rest",
        IdentifiabilityWarning,
    )


def _warn_of_mean(experiment):
    """Warn of plain outputs whose mean is larger than their motion, if inputs have none but chance.

    A slow machine makes such a mean even of a small one of its inputs.
    """
    u, y = np.vstack(experiment.inputs), np.vstack(experiment.outputs)
    if searching() or not u.size or len(y) < LINES:
        return
    (u_mean, u_size), (y_mean, y_size) = ((z.mean(axis=0), z.std(axis=0)) for z in (u, y))
    held = np.any(np.abs(u_mean) > SURE * u_size / np.sqrt(len(u)))
    halves = np.array([half.mean(axis=0) for half in np.array_split(y, 2)])
    lasting = np.ptp(halves, axis=0) < y_size  # else outputs drift, or grow
    off = (np.abs(y_mean) > y_size) & lasting & (y_size > 0.0)
    if held or not np.any(off):
        return
    found = ", ".join(
        f"{experiment.output_names[i]!r} {y_mean[i]:.3g} ± {y_size[i]:.2g}"
        for i in np.flatnonzero(off)
    )
    warn(
        f"outputs have a mean larger than their motion ({found}), and the inputs have none: a "
        f"linear model rests at zero, and may need a mode for that mean; subtract what the outputs "
        f"are at rest",
        IdentifiabilityWarning,
    )


def _head(inputs, least):
    """Rows at the start of a segment in which inputs are constant; 0 where they are too few."""
    moves = np.any(inputs != inputs[:1], axis=1)
    n = int(np.argmax(moves)) if moves.any() else 0
    return n if n >= least else 0


def _is_zero(outputs):
    """Whether some rows are zero, or noise about it: neighbours are not alike."""
    n, size = len(outputs), np.maximum(np.std(outputs, axis=0), np.finfo(float).tiny)
    mean, alike = outputs.mean(axis=0), np.mean(outputs[1:] * outputs[:-1], axis=0)
    within = STANDARD_ERRORS / np.sqrt(n)
    noise = (np.abs(mean) <= within * size) & (np.abs(alike / size) <= within * size)
    return bool(np.all(noise | ~outputs.any(axis=0)))


def warn_of_growing_data(experiment):
    """Warn if outputs grow so much that rounding hides the decaying modes."""
    basis = experiment.basis
    if not basis.harmonic:
        return
    spp, period = basis.samples_per_period, basis.samples_per_period * basis.sample_time
    for y in experiment.outputs:
        rate = _growth_rate(y, spp)
        if rate * (len(y) // spp) < np.log(LOST):
            continue
        warn(
            f"the outputs grow by a factor of {np.exp(rate):.3g} per period up to the last of the "
            f"{experiment.span()}: the periodic orbit is unstable, and rounding hides the modes "
            f"that decay; use records of at most {np.log(CALM) / rate * period:.3g} s "
            f"({int(np.log(CALM) / rate)} periods), or fly with a controller that holds the orbit",
            InstabilityWarning,
        )
        return


def _growth_rate(y, spp):
    """By how many e-folds a period outputs grow to the end of a segment; 0 where they do not."""
    n = len(y) // spp
    largest = np.max(np.abs(y), initial=0.0)
    if n < MIN_PERIODS or largest == 0.0:
        return 0.0
    size = (y / largest)[len(y) - n * spp :].reshape(n, spp, -1)
    size = np.sqrt(np.mean(size**2, axis=1))
    size = size[:, np.argmax(size[-1])]
    marks = [n // 2, (3 * n) // 4, n - 1]
    if size[-1] < np.max(size) or np.min(size[marks]) == 0.0:
        return 0.0  # it does not grow to the end, or was at rest for half of the segment
    first, second = np.diff(np.log(size[marks])) / np.diff(marks)
    steady = 0.5 * first < second < 2.0 * first  # growth by its own, not by an input that begins
    return float(np.log(size[-1] / size[marks[0]]) / (n - 1 - marks[0])) if steady else 0.0


def warn_of_growth(model, experiment):
    """Warn if a model of periodic motion has a mode that grows e-fold within a segment."""
    if not experiment.basis.harmonic or model.n_states == 0 or searching():
        return
    rate, longest = growth_rate(model.A, model.dt), longest_span(experiment)
    period = 2.0 * np.pi / experiment.basis.omega
    folds, multiplier = rate * longest, np.exp(min(rate * period, 700.0))
    if folds > GROWN:
        warn(
            f"the periodic orbit is unstable: a Floquet exponent of the model has the real part "
            f"{rate:.4g} 1/s (a multiplier of size {multiplier:.4g}), so the model "
            f"{grows_by(folds)} over the longest segment of the {experiment.span()}; simulate "
            f"short spans from known states, or lower the order if the orbit is known to be stable",
            InstabilityWarning,
        )


def warn_of_unstable(model, n_rows):
    """Warn if a model of plain data has a mode that grows over its longest segment.

    Candidates of a search are not checked: their scores show it, and the final model is fitted
    outside.
    """
    folds = growth(model.A)
    if folds * n_rows < GROWN or searching():
        return
    warn(
        f"the model is unstable: an eigenvalue of A has the size {np.exp(folds):.6g}, so the model "
        f"{grows_by(folds * n_rows)} over the {n_rows} rows of the longest segment; if the system "
        f"is known to be stable, use stable=True or another order",
        InstabilityWarning,
    )


def growth_rate(A, dt):
    """Largest real part of the exponents of a model, 1/s; less than any without states."""
    return growth(A) / dt if dt > 0.0 else np.max(np.linalg.eigvals(A).real, initial=-np.inf)


def grows_by(folds):
    """By what factor a model grows, for messages."""
    return f"grows by a factor of {np.exp(min(folds, 700.0)):.3g}"


def grows(A, dt, experiment):
    """Whether a mode of a model grows e-fold within the longest segment."""
    return growth_rate(A, dt) * longest_span(experiment) > GROWN


def longest_span(experiment):
    """Length of the longest segment, in seconds."""
    return max(len(u) for u in experiment.drive) * experiment.base.sample_time


def check_motion(facts):
    """Raise ValueError if an input or all outputs rest; warn of those that rest in part."""
    if facts.still:
        raise ValueError(
            f"input {facts.still[0]!r} is constant in the {facts.span}, so the record does not "
            f"tell its effect; choose a span in which it moves, or drop that input"
            f"{facts.why_short}"
        )
    moves, off = facts.outputs_move, facts.outputs_off
    if not moves.any():
        raise ValueError(
            f"all outputs are {'constant' if off.any() else 'zero'} in the {facts.span} (after "
            f"the trim is subtracted): there is no response to identify; check the columns of y, "
            f"their units and trim_span"
        )
    resting = [n for n, m, o in zip(facts.output_names, moves, off, strict=True) if o and not m]
    if resting and facts.basis.reading != "sample":  # which takes it for a load
        warn(
            f"the outputs {resting} are constant, but not zero, in the {facts.span}: no input "
            f"explains them; subtract their rest values (trim_span), or drop them",
            IdentifiabilityWarning,
        )
    zero = [n for n, m, o in zip(facts.output_names, moves, off, strict=True) if not (m or o)]
    if zero and facts.basis.reading == "period":
        warn(
            f"the outputs {zero} never move in the {facts.span} (after the trim is subtracted), "
            f"so the model has them at rest; check their sensors, or drop them",
            IdentifiabilityWarning,
        )
    if facts.together:
        warn(
            f"the inputs {list(facts.together)} never move separately in the {facts.span} (they "
            f"are copies or sums of each other): the record determines only their joint effect, "
            f"and the smallest coefficients are taken; drop all but one, or record each moving by "
            f"itself",
            IdentifiabilityWarning,
        )
    names = facts.basis.drive_labels
    idle = [name for name, moves in zip(names, facts.moving, strict=True) if not moves]
    if idle:
        effect = "their effect is not identified, and their columns of B are zero"
        if facts.basis.reading == "period":
            effect = (
                "their columns of B are zero; StructuredMatcher fits the effect of inputs within "
                "the period"
            )
        warn(f"the inputs {idle} are at rest in the {facts.span}: {effect}", ExcitationWarning)


def motion_kept(measured, sampling, basis, taken):
    """Motion that samples share with earlier ones, as a share of that of neighbours.

    Neighbouring samples share motion, whatever their noise; so do samples further apart, for as
    long as it lasts.

    ``measured`` are outputs as given, and ``taken`` (2 L + 1, l) are Fourier
    coefficients of their forced periodic mean. The result (hop, l) is that of samples
    1, 2, … hop apart. It is 1 for outputs that are noise alone.
    """
    shared, n_rows = 0.0, 0
    unit = np.nanmax(np.abs(measured), axis=0)
    unit[unit == 0.0] = 1.0
    for piece in sampling.pieces:
        y = np.nan_to_num((measured[piece.rows] - basis.waveform(taken, piece.places)) / unit)
        lags = range(min(len(y), basis.hop + 1))
        sums = [np.sum(y[lag:] * y[: len(y) - lag], axis=0) for lag in lags]
        shared = shared + np.array(sums + [0.0 * y[0]] * (basis.hop + 1 - len(sums)))
        n_rows += len(y)
    still = np.sqrt(shared[0] / n_rows) * unit <= HALF * np.max(np.abs(taken), axis=0)
    told = ~still & (shared[1] > STANDARD_ERRORS * shared[0] / np.sqrt(n_rows))
    return np.where(told, shared[1:] / np.where(told, shared[1], 1.0), 1.0)


def lasting_hop(kept):
    """Largest distance in samples at which every output keeps half of its motion."""
    less = kept < HALF_KEPT
    return int(np.min(np.where(less.any(axis=0), np.argmax(less, axis=0), len(kept))))


def warn_of_thinning(experiment, taken):
    """Warn of outputs whose motion is lost from one analysed row to the next."""
    basis = experiment.basis
    if basis.hop == 1:
        return
    kept = motion_kept(experiment.measured, experiment.sampling, basis, taken)
    lost = kept[-1] < HALF_KEPT
    if lost.any():
        names = [name for name, each in zip(experiment.output_names, lost, strict=True) if each]
        warn(
            f"hop={basis.hop}: from one analysed row to the next, the outputs {names} keep only "
            f"{max(0.0, np.min(kept[-1])):.2g} of the motion that neighbouring samples share, so "
            f"faster motion is lost; give HarmonicAnalyzer hop={lasting_hop(kept)}, which keeps "
            f"half of it, or a smaller hop",
            IdentifiabilityWarning,
        )
