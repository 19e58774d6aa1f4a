"""Data in: frames, Series and arrays, read as signals, segments and experiments."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.sparse import issparse
from sklearn.utils.validation import validate_data

from sklearn_hd._frame import HarmonicBasis, HarmonicFrame
from sklearn_hd._validation import (
    TimeBase,
    check_finite,
    check_same_rows,
    read_time,
    signal_names,
)
from sklearn_hd.algorithms.fourier import harmonic_labels


@dataclass(frozen=True)
class Signals:
    """Values of some signals with their names and times."""

    data: np.ndarray
    names: tuple
    base: TimeBase


def read_signals(data, prefix, what, sample_time=None):
    """Finite float values, names and time base of a frame, Series or array."""
    data = as_container(data, what)
    names = signal_names(data, prefix)
    base = read_time(data, sample_time)
    values = _to_float(data, names, what)
    check_finite(values, names, base.time, what)
    return Signals(values, names, base)


def check_features(estimator, X, *, reset):
    """X as a container, after scikit-learn's own check of its columns against those at fit."""
    X = as_container(X, "X")
    columns = X.to_frame() if isinstance(X, pd.Series) else X
    validate_data(estimator, columns, reset=reset, skip_check_array=True)
    return X


def as_container(data, what):
    """A frame or Series as it is, anything else as an array of a shape that has rows."""
    if issparse(data):
        raise TypeError(
            f"{what} is sparse, which is not supported: signals are dense; give {what}.toarray()"
        )
    if not isinstance(data, pd.DataFrame | pd.Series):
        if hasattr(data, "__dataframe__") or hasattr(data, "to_pandas"):
            raise TypeError(
                f"{what} is a {type(data).__module__.split('.')[0]} {type(data).__name__}, which "
                f"carries no index of times; give {what}.to_pandas() with its times as the index"
            )
        data = np.asarray(data)
        if data.ndim == 1 and what == "X":
            raise ValueError(
                "Expected 2D array, got 1D array instead. Reshape your data with "
                "X.reshape(-1, 1) if it is one signal, X.reshape(1, -1) if it is one sample"
            )
    if data.ndim > 2 or data.ndim == 0:
        raise ValueError(
            f"{what} has {data.ndim} dimensions; give (n_samples, n_signals) or (n_samples,)"
        )
    if len(data) == 0:
        raise ValueError(f"{what} has no rows: 0 sample(s), while at least 1 is required")
    if data.ndim == 2 and data.shape[1] == 0:
        raise ValueError(
            f"{what} has no signals: 0 feature(s) (shape={data.shape}) while a minimum of 1 is "
            f"required."
        )
    return data


def _to_float(data, names, what):
    values = data.to_numpy() if isinstance(data, pd.DataFrame | pd.Series) else data
    if np.iscomplexobj(values):
        raise ValueError(
            f"Complex data not supported: {what} is complex; give real and imaginary parts as "
            f"columns of their own"
        )
    try:
        values = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise type(error)(
            f"{what} holds values that are no numbers (columns {list(names)}): {error}; convert "
            f"them first"
        ) from None
    return values.reshape(len(values), -1)


@dataclass(frozen=True)
class Experiment:
    """Inputs, and outputs where given, of every segment, as the model steps read them.

    Attributes
    ----------
    frame : HarmonicFrame
        The rows as they came.
    base : TimeBase
    basis : HarmonicBasis or None
    drive : list of ndarray, shapes (n_samples_s, n_drive)
        What drives the model, trim subtracted.
    drive_names : tuple of str
    outputs : list of ndarray, shapes (n_samples_s, n_outputs), or None
        Measured outputs, trim subtracted.
    """

    frame: HarmonicFrame
    base: TimeBase
    basis: HarmonicBasis | None
    drive: list
    drive_names: tuple
    outputs: list | None = None

    def times(self):
        """Time of the rows of each segment, seconds."""
        return [self.base.time[segment] for segment in self.base.segments]

    def drive_signals(self):
        """The measured signal that each entry of ``drive_names`` comes from."""
        if self.basis is None:
            return self.drive_names
        return tuple(
            signal for signal, orders in self.basis.inputs for _ in harmonic_labels(orders)
        )

    def span(self):
        """First and last time, worded for messages."""
        return f"rows from t = {self.base.time[0]:.6g} s to {self.base.time[-1]:.6g} s"


def as_frame(X):
    """X as a HarmonicFrame; plain data get neither basis nor model."""
    if isinstance(X, HarmonicFrame):
        return X
    if isinstance(X, pd.DataFrame):
        _refuse_lost_basis(X)
        return HarmonicFrame(X)
    if isinstance(X, pd.Series):
        return HarmonicFrame(X.to_frame())
    X = as_container(X, "X")
    return HarmonicFrame(X, columns=[f"x{i}" for i in range(X.shape[1])])


def _refuse_lost_basis(X):
    names = {str(column) for column in X.columns}
    lost = [s for s in names if {f"{s}_0", f"{s}_1c"} <= names]
    if lost:
        raise ValueError(
            f"column {lost[0]!r} stands beside its own coefficients ({lost[0]}_0, …), but the "
            f"frame carries no harmonic basis: a step between HarmonicAnalyzer and this one has "
            f"dropped it (concatenation, a scaler); apply such steps before the analyzer"
        )


def read_experiment(X, y=None):
    """Segments of inputs and outputs that a model step fits or simulates."""
    frame = as_frame(X)
    basis = frame.basis
    if basis is None:
        signals = read_signals(frame, "x", "X")
        drive = [signals.data[segment] for segment in signals.base.segments]
        names = signals.names
    else:
        raw = frame[[signal for signal, _ in basis.inputs]]
        signals = read_signals(raw, "x", "X", basis.sample_time)
        values, time = signals.data, signals.base.time
        if basis.input_trim is not None:
            values = values - basis.input_trim[basis.phase_index(time)]
        segments = signals.base.segments
        drive = [basis.drive(values[segment], time[segment]) for segment in segments]
        names = basis.drive_labels
    outputs = None if y is None else _read_outputs(y, frame, X, signals.base, basis)
    return Experiment(frame, signals.base, basis, drive, names, outputs)


def _read_outputs(y, frame, X, base, basis):
    y = as_container(y, "y")
    check_same_rows(X if isinstance(X, pd.DataFrame | pd.Series) else frame, y)
    sample_time = base.sample_time
    values = read_signals(y, "y", "y", sample_time if basis is not None else None).data
    if basis is not None:
        if values.shape[1] != len(basis.outputs):
            raise ValueError(
                f"y has {values.shape[1]} columns, but the harmonic basis was fitted with "
                f"{len(basis.outputs)}: {[signal for signal, _ in basis.outputs]}; fit "
                f"HarmonicAnalyzer with the same y"
            )
        if basis.output_trim is not None:
            values = values - basis.output_trim[basis.phase_index(base.time)]
    return [values[segment] for segment in base.segments]


def rows_read(experiment):
    """Inputs and (decomposed) outputs of each segment at the rows that models are made of."""
    basis = experiment.basis
    if basis is None:
        return experiment.drive, experiment.outputs
    inputs, outputs = [], []
    for drive, y, time in zip(
        experiment.drive, experiment.outputs, experiment.times(), strict=True
    ):
        rows = basis.rows_read(time)
        inputs.append(hop_means(drive, rows, basis.hop_samples))
        outputs.append(basis.coefficients(y, time, basis.outputs, rows))
    return inputs, outputs


def hop_means(drive, rows, hop):
    """Mean of the drive over the hop that follows each row read."""
    if hop == 1 or len(rows) == 0:
        return drive[rows]
    sums = np.add.reduceat(drive, rows, axis=0)
    sums[-1] = drive[rows[-1] : rows[-1] + hop].sum(axis=0)
    counts = np.minimum(rows + hop, len(drive)) - rows
    return sums / counts[:, None]
