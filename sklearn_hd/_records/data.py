"""Data in: frames, Series and arrays, read as signals, segments and experiments.

Conversion of an identified discrete model to a continuous one that fits the raw record.
"""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import linalg
from sklearn.utils.validation import validate_data

from sklearn_hd._checks import (
    GAP,
    RAISE,
    at,
    check_azimuth,
    check_output_names,
    check_same_rows,
    check_values,
    check_wrap,
    signal_names,
)
from sklearn_hd._clock import STEP_TOLERANCE, TimeBase, read_time, straightened
from sklearn_hd._containers import as_container, check_upright, is_pandas, to_float, without_inputs
from sklearn_hd._frame import HarmonicFrame
from sklearn_hd._guards import warn
from sklearn_hd._readings import HarmonicBasis, PlainReading, first_difference
from sklearn_hd._records.amplitudes import small_signal
from sklearn_hd._records.sampling import Sampling, lay_grid
from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, discrete_to_continuous
from sklearn_hd.algorithms.signals.fourier import lift, seconds_from_zero_phase
from sklearn_hd.algorithms.signals.resampling import bridge, unwrap
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.exceptions import JitterWarning

PLAIN = PlainReading()


@dataclass(frozen=True)
class Signals:
    """Values of some signals with their names and times."""

    data: np.ndarray  # (n_rows, n_signals): as given: NaN where a sample is missing
    names: tuple  # of str
    base: TimeBase
    # (n_rows,): ψ in radians, unwrapped within each segment; not among the signals
    azimuth: np.ndarray | None = None

    def places(self, omega, step):
        """Where the rows lie in the time that is analysed, seconds from a ψ = 0 near each record.

        Rows that are evenly spaced lie on a line, whatever their times were rounded to: one of
        ``step`` a row, the grid's, where that is their sample time for all they tell.
        """
        if self.azimuth is not None:
            return self.azimuth / omega
        places = self.base.time.copy()
        for record, _ in self.base.rows_of_records():
            first = places[record.start]
            near = seconds_from_zero_phase(first, omega)
            if near != first:
                places[record] = places[record] - first + near
        return straightened(places, self.base, step)

    def mean_speed(self, name):
        """Samples in a turn, and ω, in the mean over the rows, by the azimuth of that name."""
        turned, passed, steps = 0.0, 0.0, 0
        for segment in self.base.segments:
            known = np.flatnonzero(np.isfinite(self.azimuth[segment])) + segment.start
            if len(known) > 1:
                first, last = known[0], known[-1]
                turned += self.azimuth[last] - self.azimuth[first]
                passed += self.base.time[last] - self.base.time[first]
                steps += last - first
        if steps == 0:
            raise ValueError(
                f"azimuth column {name!r} shows no motion: no segment has two rows at "
                f"which it is known; give a longer record"
            )
        return 2.0 * np.pi * steps / turned, float(turned / passed)


def read_signals(X, timing=PLAIN.timing):
    """Float values, names and time base of a frame, Series or array.

    The column that ``timing`` names as the azimuth is set apart.
    """
    X = as_container(X, "X")
    names = signal_names(X, "x")
    base = read_time(X, timing.sample_time, timing.time_origin, timing.row_time, timing.of_fit)
    values = check_values(to_float(X, "X"), names, base.time, "X", timing.missing)
    signals = Signals(values, names, base)
    return signals if timing.azimuth is None else _set_azimuth_apart(signals, timing)


def _set_azimuth_apart(signals, timing):
    name, base = timing.azimuth, signals.base
    if signals.names == (name,):
        raise ValueError(f"X holds only the azimuth {name!r}; give the inputs beside it")
    psi = _azimuth(signals.data, signals.names, base, name)
    keep = [i for i, other in enumerate(signals.names) if other != name]
    data, names = signals.data[:, keep], tuple(signals.names[i] for i in keep)
    return Signals(data, names, base, _bridged(psi[:, None], base, timing)[:, 0])


def _azimuth(data, names, base, name):
    """ψ of each row, unwrapped and checked within each segment; NaN where it is missing."""
    if name not in names:
        raise ValueError(
            f"azimuth={name!r} is not among the columns {list(names)} of X; name the column that "
            f"holds ψ in rad"
        )
    psi = data[:, names.index(name)].copy()
    for segment in base.segments:
        check_wrap(psi[segment], name)
        psi[segment] = unwrap(psi[segment], base.time[segment])
        check_azimuth(psi[segment], base.time[segment], name)
    return psi


def read_azimuth(X, base, name):
    """The azimuth among the columns of X, unwrapped within each segment."""
    names = signal_names(X, "x")
    return _azimuth(to_float(X, "X"), names, base, name)


def read_values(y, X, base, timing):
    """Float values and names of outputs sampled at the times of the inputs."""
    given, y = y, as_container(y, "y")
    lost = is_pandas(y) and not is_pandas(given) and isinstance(y.index, pd.RangeIndex)
    if lost and is_pandas(X) and len(X) == len(y):  # of polars, which keeps none
        y = y.set_axis(X.index)
    check_same_rows(X, y)
    names = signal_names(y, "y")
    values = to_float(y, "y")
    return check_values(values, names, base.time, "y", timing.missing), names


def _bridged(values, base, timing, held=False):
    """Values whose short runs of NaN are interpolated, where that was asked for.

    Linearly where signals are held (a spline overshoots their steps), by
    cubic splines where they are smooth.
    """
    if timing.missing in (RAISE, GAP) or not np.isnan(values).any():
        return values
    longest = int(np.floor(timing.missing / base.sample_time + 1e-6))
    values = values.copy()
    held = np.broadcast_to(held, values.shape[1:])
    for segment in base.segments:
        for column in np.flatnonzero(np.isnan(values[segment]).any(axis=0)):
            degree = 1 if held[column] else 3
            values[segment, column] = bridge(
                values[segment, column], base.time[segment], longest, degree
            )
    return values


def warn_of_jitter(base, step):
    """Say by how much the rows are off the uniform grid that they are resampled onto.

    In few digits: Python shows a warning once for each text, and the folds of a
    cross-validation differ in the others.
    """
    rms, largest = (float(f"{100.0 * off / step:.1g}") for off in base.jitter)  # percent
    steps = base.even_steps()
    if largest > 0.0 and steps and max(steps) > (1.0 + STEP_TOLERANCE) * min(steps):
        warn(
            f"the records have sample times of {min(steps):.4g} to {max(steps):.4g} s: signals are "
            f"resampled onto a grid of {step:.4g} s, and results brought back to the rows given; "
            f"what lies between rows is interpolated, so that residuals may not look like noise",
            JitterWarning,
        )
    elif largest > 0.0:
        warn(
            f"the rows are not evenly spaced: they are off a grid of {step:.4g} s by "
            f"{rms / 100.0 * step:.2g} s rms ({rms:g} % of a sample) and by "
            f"{largest / 100.0 * step:.2g} s at most ({largest:g} %); signals are resampled onto "
            f"that grid, and results brought back to the rows given",
            JitterWarning,
        )


def check_features(estimator, X, *, reset):
    """X as a container, after scikit-learn's own check of its columns against those at fit."""
    X = as_container(X, "X")
    signal_names(X, "x")  # each only once
    columns = X.to_frame() if isinstance(X, pd.Series) else X
    validate_data(estimator, columns, reset=reset, skip_check_array=True)
    return X


@dataclass(frozen=True)
class Experiment:
    """Inputs, and outputs where given, of every segment, as the model steps read them."""

    base: TimeBase  # of the uniform grid that models are fitted and simulated on
    basis: HarmonicBasis | PlainReading
    drive: list  # (n_samples_s, n_drive): what drives the model, trim subtracted
    inputs: list  # (n_samples_s, n_inputs): measured inputs on the grid, trim subtracted
    sampling: Sampling  # how the user's rows lie on the grid
    # (n_samples_s, n_outputs): measured outputs on the grid, trim subtracted
    outputs: list | None = None
    measured: np.ndarray | None = None  # (n_rows, n_outputs): outputs at the user's rows, as given
    output_names: tuple = ()  # of str: of the columns of ``measured``
    # Experiment or None: the record as it was measured, where this is one without its delays
    origin: object = None
    delays: object = None  # Delays or None: what was taken out of it

    def times(self):
        """Time of the rows of each segment, seconds."""
        return [self.base.time[segment] for segment in self.base.segments]

    @property
    def phases(self):
        """ψ of the rows of each segment, radians."""
        return [self.basis.azimuth(time) for time in self.times()]

    def output_trim(self):
        """Periodic waveforms of the outputs on each segment; None where none were learned."""
        basis = self.basis
        if basis.output_trim is None:
            return None
        return [basis.waveform(basis.output_trim, time) for time in self.times()]

    def output_trim_at_rows(self):
        """The same at the user's rows of each segment."""
        basis, trim = self.basis, self.basis.output_trim
        if trim is None:
            return None
        pieces = self.sampling.pieces
        return [
            basis.waveform(trim, piece.grid)
            if piece.is_grid
            else basis.waveform_between(trim, piece.places)
            for piece in pieces
        ]

    def span(self):
        """First and last time, worded for messages."""
        clock = self.sampling.clock
        return f"rows from t = {at(clock[0])} to {at(clock[-1])}"


def as_frame(X):
    """X as a HarmonicFrame; plain data get neither basis nor model."""
    if isinstance(X, HarmonicFrame) and X.is_laden:
        return X
    X = X if is_pandas(X) else as_container(X, "X")
    if isinstance(X, pd.DataFrame):
        _refuse_lost_basis(X)
        return HarmonicFrame(X)
    if isinstance(X, pd.Series):
        return HarmonicFrame(X.to_frame())
    return HarmonicFrame(X, columns=[f"x{i}" for i in range(X.shape[1])])


def _refuse_lost_basis(X):
    names = {str(column) for column in X.columns}
    lost = sorted(s for s in names if f"{s}_0" in names)
    if lost:
        raise ValueError(
            f"column {lost[0]!r} appears beside its own coefficients ({lost[0]}_0, …), but the "
            f"frame carries no harmonic basis: a step between HarmonicAnalyzer and this one has "
            f"dropped it (concatenation, a scaler), or scikit-learn's transform_output='polars' "
            f"has; apply such steps before the analyzer, and leave transform_output to pandas"
        )


def sample(signals, basis, outputs=None):
    """Grid for some rows, and the inputs and outputs on it, one array a segment.

    ``signals`` are the inputs. What is missing of the outputs is missing of the record.
    """
    base, timing, held = signals.base, basis.timing, basis.held
    inputs, outputs, present = given(signals, outputs, timing, held)
    step, shortest, places = basis.grid(signals)
    sampling = lay_grid(base, places, present, step, timing, shortest)
    if outputs is None:
        return sampling, sampling.onto_grid(inputs, held), None
    moved = base.jitter[1] > 0.0 or timing.resampled or timing.azimuth is not None
    omega = basis.omega if basis.harmonic and moved else None
    return sampling, sampling.onto_grid(inputs, held), sampling.onto_grid(outputs, omega=omega)


def given(signals, outputs, timing, held=False):
    """Inputs and outputs, short runs of NaN bridged where asked for, and rows without any.

    The rows are a mask of those that hold all samples; None is all of them.
    """
    inputs = _bridged(signals.data, signals.base, timing, held)
    outputs = None if outputs is None else _bridged(outputs, signals.base, timing)
    if timing.missing == RAISE:
        return inputs, outputs, None
    columns = [z for z in (inputs, signals.azimuth, outputs) if z is not None]
    finite = [np.isfinite(z.reshape(len(z), -1)).all(axis=1) for z in columns]
    return inputs, outputs, np.logical_and.reduce(finite)


def without_trim(blocks, times, basis, trim):
    """Signals on the grid less their periodic waveforms, one array a segment."""
    if trim is None:
        return blocks
    return [block - basis.waveform(trim, time) for block, time in zip(blocks, times, strict=True)]


def is_decomposed(y):
    """Whether y is a frame of harmonics, as HarmonicAnalyzer makes it."""
    return isinstance(y, HarmonicFrame) and y.is_analysed


def read_for_fit(X, y):
    """Segments of inputs and outputs that a model is fitted to.

    As :func:`read_experiment`, with records at several amplitudes combined where the analyzer was
    asked to.
    """
    check_upright(X, "X")
    check_upright(y, "y")
    experiment = read_experiment(X, y)
    how = experiment.basis.small_signal
    return experiment if how is None else small_signal(experiment, how)


def read_experiment(X, y=None, decomposition=None, plain=PLAIN):
    """Segments of inputs and outputs that a model step fits or simulates.

    Where y has been decomposed already, its own basis says which harmonics of
    which outputs are kept; ``decomposition`` repeats that of an earlier fit. Without a basis
    rows are read as ``plain`` says.
    """
    if not isinstance(X, np.ndarray):  # of which a frame would be no more than names
        X = as_frame(X)
    basis = getattr(X, "basis", None) or plain
    if is_decomposed(y):
        decomposition = replace(y.basis, outputs=y.basis.inputs, output_trim=y.basis.input_trim)
        y = pd.DataFrame(y)[list(y.basis.input_signals)]
    if decomposition is not None:
        basis = _with_outputs_of(basis, decomposition)
    signals = read_signals(basis.select(X), basis.timing)
    measured, output_names = None, ()
    if y is not None:
        indexed = isinstance(y, pd.DataFrame | pd.Series)
        given = without_inputs(X) if indexed and isinstance(X, np.ndarray) else X
        measured, output_names = read_values(y, given, signals.base, basis.timing)
        if basis.harmonic:
            expected = tuple(signal for signal, _ in basis.outputs)
            check_output_names(output_names, expected, "the harmonic basis")
    sampling, values, outputs = sample(signals, basis, measured)
    if not basis.harmonic:
        warn_of_jitter(signals.base, sampling.base.sample_time)
        basis = replace(basis, drive_labels=signals.names, output_labels=output_names)
    times = [sampling.base.time[segment] for segment in sampling.base.segments]
    inputs = without_trim(values, times, basis, basis.input_trim)
    drive = [basis.drive(u, time) for u, time in zip(inputs, times, strict=True)]
    if outputs is not None:
        outputs = without_trim(outputs, times, basis, basis.output_trim)
    return Experiment(
        sampling.base, basis, drive, inputs, sampling, outputs, measured, output_names
    )


def _with_outputs_of(basis, other):
    """A basis whose outputs are decomposed as those of another one of the same analysis."""
    difference = first_difference(basis, other)
    if difference is not None and difference[0] not in ("inputs", "outputs"):
        name, here, there = difference
        raise ValueError(
            f"y was decomposed with {name}={there!r}, but X with {here!r}; use the same "
            f"HarmonicAnalyzer parameters for both, or give y in time"
        )
    return replace(basis, outputs=other.outputs, output_trim=other.output_trim)


def rows_read(experiment):
    """Inputs and (decomposed) outputs of each segment at the rows that models are made of."""
    parts = zip(experiment.drive, experiment.outputs, experiment.times(), strict=True)
    pairs = [experiment.basis.read(*part) for part in parts]
    return tuple(map(list, zip(*pairs, strict=True)))


def beside_trim(directions, basis):
    """Directions of the inputs, with a constant one where the trim was averaged over a span.

    It is known as well as its span averages it: what it is off by repeats itself.
    """
    if basis.output_trim is None:
        return directions
    return [np.hstack([w, np.ones((len(w), 1))]) for w in directions]


def lifted_periods(experiment, signals, scale=1.0):
    """Whole periods of some signals of an experiment, (n_periods_s, samples, n_signals) each."""
    basis = experiment.basis
    return [
        lift(values / scale, basis.phase_index(time), basis.samples_per_period)
        for values, time in zip(signals, experiment.times(), strict=True)
    ]


def moving_periods(experiment):
    """Whole periods of the outputs, in like units, without those that rest throughout.

    Their zeros would count as rows that a model explains.
    """
    lifted = lifted_periods(experiment, experiment.outputs, output_scale(experiment))
    moves = np.any([np.any(y != 0.0, axis=(0, 1)) for y in lifted], axis=0)
    return [y[..., moves] for y in lifted]


def to_continuous(model, experiment):
    """The whole of a discrete model in continuous time, under a zero-order hold.

    A model of coefficients seen through a window gets new B and D, fitted to the raw record; any
    other model keeps its own.
    """
    if model.dt == 0.0:
        return model
    A, B = discrete_to_continuous(model.A, model.B, model.dt)
    D = model.D
    if model.windowed:
        B, D, _ = refit_inputs(A, model.C, experiment, model.feedthrough)
    return model.in_continuous_time(A, B, model.C, D)


def refit_inputs(A, C, experiment, feedthrough):
    """B and D of a continuous model that fit the raw record best, and the R² reached.

    ``A`` is in continuous time, and ``C`` is the output matrix to the coefficients.
    """
    dt = experiment.base.sample_time
    A_raw, hold = continuous_to_discrete(A, np.eye(len(A)), dt)
    scale = output_scale(experiment)
    observe = [R / scale[:, None] for R in observations(experiment)]
    outputs = scaled_outputs(experiment)
    u_scale = input_scale(experiment)
    inputs = [u / u_scale for u in experiment.drive]
    B_raw, D, _, rest = input_matrices(
        A_raw, C, inputs, outputs, feedthrough, observe, return_residual=True
    )
    B_raw, D = B_raw / u_scale, D / u_scale
    total = sum(float(np.sum(y**2)) for y in outputs)
    return linalg.solve(hold, B_raw), D, 1.0 - rest / total


def input_scale(experiment):
    """Largest value of each input over all segments, so that no square under- or overflows."""
    scale = np.max(np.abs(np.vstack(experiment.drive)), axis=0, initial=0.0)
    return np.where(scale == 0.0, 1.0, scale)


def output_scale(experiment):
    """Standard deviation of each output over all segments, so that each counts alike."""
    stacked = np.vstack(experiment.outputs)
    largest = np.max(np.abs(stacked), axis=0, initial=0.0)
    largest[largest == 0.0] = 1.0
    scale = largest * np.std(stacked / largest, axis=0)
    return np.where(scale == 0.0, largest, scale)


def scaled_outputs(experiment):
    """The outputs of each segment, divided by :func:`output_scale`."""
    scale = output_scale(experiment)
    return [y / scale for y in experiment.outputs]


def observations(experiment):
    """What is measured of the coefficients at each sample, a list of arrays."""
    basis = experiment.basis
    return [basis.recomposition(basis.azimuth(time)) for time in experiment.times()]
