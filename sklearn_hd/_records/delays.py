"""Time delays of signals: what is said of them, and records brought to the machine's own time.

    u_i(t) = v_i(t − τ_i),   z_j(t) = y_j(t − σ_j)

v is commanded and z is measured, both at the times of the record; the machine feels u and moves as
y. Phases are those of the machine: ψ = ωt at its own time, whatever comes late. Steps that fit a
model read the record in that time (:func:`in_machine_time`), or in whole samples and with both
values of an input within each (:func:`in_whole_samples`), where a likelihood knows what becomes of
the rest. Predictions take delayed inputs (:func:`with_delayed_inputs`), and are brought back.

Of a time-invariant machine the sums τ_i + σ_j alone are seen, m + l − 1 of them. A periodic machine
shows a common shift as another phase of F(ψ), which nobody knows beforehand unless a structure
fixes it. So where all delays are "auto" the first output is taken for undelayed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from sklearn_hd._guards import warn
from sklearn_hd._records.sampling import regrouped
from sklearn_hd.algorithms.signals.resampling import ON_GRID, arriving, lagged, late
from sklearn_hd.exceptions import IdentifiabilityWarning

MOST_SAMPLES = 50  # of a delay that is looked for in plain data
MOST_OF_A_TURN = 0.5  # elsewhere
STEADY = 4  # samples: rows are left out by multiples, so that fits near each other share theirs


@dataclass(frozen=True, eq=False)
class Delays:
    """Delays of the signals of a model."""

    names: tuple  # of str: of the inputs, then the outputs
    n_inputs: int
    seconds: np.ndarray  # (m + l,)
    std: np.ndarray  # (m + l,): standard deviations; NaN where given, or not known
    free: np.ndarray  # bool, (m + l,): which of them the data decide

    @property
    def inputs(self):
        """τ, seconds."""
        return self.seconds[: self.n_inputs]

    @property
    def outputs(self):
        """σ, seconds."""
        return self.seconds[self.n_inputs :]

    def at(self, seconds, std=None):
        """The same with other values."""
        std = np.full(len(seconds), np.nan) if std is None else std
        return replace(self, seconds=np.asarray(seconds, dtype=float), std=std)

    def table(self, what):
        """``seconds`` or ``std``, as a Series by signal."""
        return pd.Series(getattr(self, what), list(self.names))


def asked_delays(inputs, outputs, experiment):
    """The delays asked for of the signals of an experiment; None where all are zero.

    It raises ValueError if a delay is negative, not finite, of an unknown signal, or
    outlasts the record.
    """
    signals = tuple(experiment.basis.input_signals), tuple(experiment.output_names)
    parts = [
        _by_signal(what, value, names)
        for what, value, names in zip(("input", "output"), (inputs, outputs), signals, strict=True)
    ]
    seconds, free = (np.concatenate(each) for each in zip(*parts, strict=True))
    if not (seconds.any() or free.any()):
        return None
    names = signals[0] + signals[1]
    longest = max(time[-1] - time[0] for time in experiment.times())
    if np.max(seconds) >= longest:
        place = int(np.argmax(seconds))
        raise ValueError(
            f"the delay of {names[place]!r}, {seconds[place]:g} s, is longer than the "
            f"{experiment.span()} ({longest:g} s in one segment); delays are in seconds: give a "
            f"shorter one, or a longer record"
        )
    return Delays(names, len(signals[0]), seconds, np.full(len(names), np.nan), free)


def _by_signal(what, value, names):
    """Seconds of each signal, and which are left to the data."""
    hint = (
        f"give seconds, zero or more, a dict of some of the {what}s {list(names)} with seconds "
        f"each, or 'auto'"
    )
    given = value if isinstance(value, Mapping) else dict.fromkeys(names, value)
    unknown = [name for name in given if name not in names]
    if unknown:
        raise ValueError(f"{what}_delay names {unknown[0]!r}, which is not an {what}; {hint}")
    seconds, free = np.zeros(len(names)), np.zeros(len(names), dtype=bool)
    for place, name in enumerate(names):
        own = given.get(name, 0.0)
        free[place] = isinstance(own, str) and own == "auto"
        if free[place]:
            continue
        try:
            seconds[place] = np.nan if isinstance(own, str | bool) else float(own)
        except (TypeError, ValueError, OverflowError):
            seconds[place] = np.nan
        if not (np.isfinite(seconds[place]) and seconds[place] >= 0.0):
            raise ValueError(f"{what}_delay={value!r}: {own!r} is not a delay of {name!r}; {hint}")
    if not isinstance(value, Mapping) and not names and value not in (0, 0.0, "auto"):
        raise ValueError(f"{what}_delay={value!r} has no signal to delay: there are no {what}s")
    return seconds, free


def with_delayed_inputs(experiment, delays):
    """The experiment with inputs as they arrive; outputs as measured."""
    samples = delays.inputs / experiment.base.sample_time
    inputs = [arriving(u, samples) for u in experiment.inputs]
    return _driven(replace(experiment, inputs=inputs, origin=experiment, delays=delays))


def in_machine_time(experiment, delays):
    """The experiment in the machine's own time, without rows of which something is not known.

    Fractions of a sample by means of held inputs and splines of outputs.
    """
    dt, moved = experiment.base.sample_time, with_delayed_inputs(experiment, delays)
    outputs = [late(y, -delays.outputs / dt) for y in experiment.outputs]
    return _cut(replace(moved, outputs=outputs), *leads(moved))


def in_whole_samples(experiment, input_lags, output_lags, least=0):
    """The experiment with inputs [new; old] and outputs advanced, both by whole samples.

    At least some rows are left out at both ends.
    """
    inputs = [both_values(u, input_lags) for u in experiment.inputs]
    outputs = [lagged(y, -output_lags) for y in experiment.outputs]
    first, last = (
        STEADY * -(-int(np.max(each, initial=0)) // STEADY)
        for each in (np.asarray(input_lags) + 1, output_lags)
    )
    moved = replace(experiment, inputs=inputs, drive=inputs, outputs=outputs)
    return _cut(moved, max(first, least), max(last, least))


def most_samples(experiment):
    """The largest delay that is looked for."""
    basis = experiment.basis
    most = MOST_OF_A_TURN * basis.samples_per_period if basis.harmonic else MOST_SAMPLES
    return min(int(most), max(map(len, experiment.inputs)) // 4)


def both_values(inputs, lags):
    """[new; old] of each input: what arrives within each sample."""
    return np.hstack([lagged(inputs, lags), lagged(inputs, lags + 1)])


def as_measured(waveform, delays, basis):
    """A periodic waveform of the outputs at the rows at which it is measured."""
    if delays is None or not delays.outputs.any():
        return waveform
    late, n = delays.outputs / basis.sample_time, len(waveform)
    waves = np.fft.rfft(waveform, axis=0)
    turn = np.exp(-2j * np.pi * np.arange(len(waves))[:, None] * late / n)
    return np.fft.irfft(waves * turn, n, axis=0)


def leads(experiment):
    """Rows at the start whose inputs are not known, and at the end whose outputs are not read."""
    delays = experiment.delays
    if delays is None:
        return 0, 0
    both, dt = (delays.inputs, delays.outputs), experiment.base.sample_time
    return tuple(int(np.ceil(np.max(each, initial=0.0) / dt - ON_GRID)) for each in both)


def _driven(experiment):
    """The experiment with the drive of its inputs."""
    parts = zip(experiment.inputs, experiment.times(), strict=True)
    return replace(experiment, drive=[experiment.basis.drive(u, time) for u, time in parts])


def _cut(experiment, first, last):
    """The experiment without the first and the last rows of each segment."""
    if not first and not last:
        return experiment
    times = experiment.times()
    kept = [slice(first, len(time) - last) for time in times]
    some = [s for s, rows in enumerate(kept) if rows.stop - rows.start > 1]
    if not some:
        dt = experiment.base.sample_time
        raise ValueError(
            f"delays of {first * dt:.6g} s of inputs and {last * dt:.6g} s of outputs leave "
            f"nothing of the {experiment.span()}: the longest stretch has "
            f"{max(map(len, times))} rows of {dt:.6g} s; give shorter delays (in seconds), or a "
            f"longer record"
        )
    names = ("inputs", "outputs", "drive")
    blocks = {name: [getattr(experiment, name)[s][kept[s]] for s in some] for name in names}
    grids = [times[s][kept[s]] for s in some]
    clock = [experiment.sampling.clock[experiment.base.segments[s]][kept[s]] for s in some]
    records = [experiment.base.records[s] for s in some]
    return regrouped(experiment, blocks, grids, clock, records)


def warn_of_doubt(delays):
    """Of delays that are no larger than their standard deviation."""
    doubtful = delays.free & ~(delays.std < delays.seconds)
    if doubtful.any():
        words = [
            f"{name} {value:.3g} ± {std:.2g} s"
            for name, value, std, it in zip(
                delays.names, delays.seconds, delays.std, doubtful, strict=True
            )
            if it
        ]
        warn(
            f"the record hardly separates these delays from zero: {', '.join(words)} (standard "
            f"deviation); give them as zero, or use a longer record or sharper inputs",
            IdentifiabilityWarning,
        )
