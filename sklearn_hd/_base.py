"""What the three model steps share: data in, segments, simulation, score."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import linalg
from sklearn.base import BaseEstimator, RegressorMixin, TransformerMixin, clone
from sklearn.metrics import r2_score
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._frame import HarmonicBasis, HarmonicFrame
from sklearn_hd._validation import (
    STEP_TOLERANCE,
    TimeBase,
    check_finite,
    check_positive,
    check_same_rows,
    read_time,
    signal_names,
)
from sklearn_hd.algorithms.fourier import harmonic_labels
from sklearn_hd.algorithms.simulation import continuous_to_discrete, propagate

WARMUP_PERIODS = 5
WARMUP_SAMPLES = 50
WARMUP_SHARE = 0.25


@dataclass(frozen=True)
class Signals:
    """Values of some signals with their names and times."""

    data: np.ndarray
    names: tuple
    base: TimeBase


def read_signals(data, prefix, what, sample_time=None, expected=None):
    """Finite float values, names and time base of a frame, Series or array.

    With ``expected`` names given, a frame's columns are brought into their
    order, and a missing or unknown one is an error.
    """
    if not isinstance(data, pd.DataFrame | pd.Series):
        data = np.asarray(data)
    if data.ndim > 2 or data.ndim == 0:
        raise ValueError(
            f"{what} has {data.ndim} dimensions; give (n_samples, n_signals) or (n_samples,)"
        )
    if len(data) == 0:
        raise ValueError(f"{what} has no rows (0 sample(s)); at least 1 is required")
    names = signal_names(data, prefix)
    if expected is not None and isinstance(data, pd.DataFrame):
        data, names = _in_order(data, names, expected, what)
    elif expected is not None:
        if len(names) != len(expected):
            raise ValueError(
                f"{what} has {len(names)} signals, but {len(expected)} were there at fit: "
                f"{list(expected)}"
            )
        names = tuple(expected)
    base = read_time(data, sample_time)
    values = _to_float(data, names, what)
    check_finite(values, names, base.time, what)
    return Signals(values, names, base)


def _in_order(data, names, expected, what):
    missing = [name for name in expected if name not in names]
    unknown = [name for name in names if name not in expected]
    if missing or unknown:
        culprit = f"lacks {missing[0]!r}" if missing else f"has the unknown column {unknown[0]!r}"
        raise ValueError(
            f"{what} {culprit}; the columns at fit were {list(expected)}, select those"
        )
    return data.iloc[:, [names.index(name) for name in expected]], tuple(expected)


def _to_float(data, names, what):
    values = data.to_numpy() if isinstance(data, pd.DataFrame | pd.Series) else data
    if np.iscomplexobj(values):
        raise ValueError(
            f"Complex data not supported: {what} is complex; give real and imaginary parts as "
            f"columns of their own"
        )
    try:
        values = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(
            f"{what} holds values that are no numbers (columns {list(names)}); convert them first"
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
    X = np.asarray(X)
    X = X.reshape(len(X), -1) if X.ndim == 1 else X
    if X.ndim != 2:
        raise ValueError(f"X has {X.ndim} dimensions; give (n_samples, n_inputs)")
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


def read_experiment(X, y=None, input_names=None):
    """Segments of inputs and outputs that a model step fits or simulates."""
    frame = as_frame(X)
    basis = frame.basis
    if basis is None:
        signals = read_signals(frame, "x", "X", None, input_names)
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


def upstream(step, X, y):
    """What a reducing or matching step reads: the experiment, and the model it starts from.

    The model rides on X, or is that of ``step.estimator``, a clone of which is
    fitted here (``step.estimator_``).
    """
    if step.estimator is None:
        frame = as_frame(X)
        if frame.model is None:
            raise ValueError(
                f"{type(step).__name__} found no model riding on X; put it behind MOESPRegressor "
                f"in a Pipeline, or give it one: {type(step).__name__}(estimator=...)"
            )
        return read_experiment(frame, y), frame.model
    step.estimator_ = clone(step.estimator).fit(X, y)
    frame = step._upstream_frame(X)
    return read_experiment(frame, y), frame.model


class SegmentSimulator:
    """Free simulation of a model over one segment, linear in its initial state.

    A continuous model steps at the data's own sample time. A discrete model
    of harmonic coefficients steps from one row read to the next; between
    those rows its coefficients are interpolated (held over the period when
    analysed period by period).

    Parameters
    ----------
    model : LTIModel
    basis : HarmonicBasis or None
    drive : ndarray, shape (n_samples, n_drive)
    time : ndarray, shape (n_samples,)
    sample_time : float
    """

    def __init__(self, model, basis, drive, time, sample_time):
        self.model, self.basis, self.time = model, basis, time
        self.drive, self.rows = drive, None
        self.A, self.B = model.A, model.B
        if model.dt == 0.0:
            self.A, self.B = continuous_to_discrete(model.A, model.B, sample_time)
        elif basis is not None:
            self.rows = basis.rows_read(time, whole_windows=False)
            self.drive = hop_means(drive, self.rows, basis.hop_samples)

    def outputs(self, x0):
        """Outputs, trim not added, shape (n_samples, n_outputs)."""
        states = propagate(self.A, self.drive @ self.B.T, x0)
        return self._observe(states @ self.model.C.T + self.drive @ self.model.D.T, self.time)

    def free(self, n_samples):
        """Outputs of the first samples for each unit initial state, (n, n_samples, n_outputs)."""
        n = self.model.n_states
        time = self.time[:n_samples]
        steps = n_samples if self.rows is None else int(np.sum(self.rows < n_samples)) + 1
        states = propagate(self.A, np.zeros((n, min(steps, len(self.drive)), n)), np.eye(n))
        return self._observe(states @ self.model.C.T, time)

    def _observe(self, Y, time):
        """Model outputs brought to every sample, and recomposed where there is a basis."""
        if self.basis is None:
            return Y
        if self.rows is not None:
            Y = self._between_rows(Y, len(time))
        R = self.basis.recomposition(self.basis.azimuth(time))
        return np.einsum("tsk,...tk->...ts", R, Y)

    def _between_rows(self, Y, n_samples):
        rows = self.rows[: Y.shape[-2]]
        if len(rows) == 0:
            return np.zeros((*Y.shape[:-2], n_samples, Y.shape[-1]))
        samples = np.arange(n_samples)
        left = np.clip(np.searchsorted(rows, samples, side="right") - 1, 0, len(rows) - 1)
        if self.basis.synchronous:
            return Y[..., left, :]
        right = np.minimum(left + 1, len(rows) - 1)
        gap = np.maximum(rows[right] - rows[left], 1)
        share = np.clip((samples - rows[left]) / gap, 0.0, 1.0)[:, None]
        return (1.0 - share) * Y[..., left, :] + share * Y[..., right, :]


def hop_means(drive, rows, hop):
    """Mean of the drive over the hop that follows each row read."""
    if hop == 1 or len(rows) == 0:
        return drive[rows]
    sums = np.add.reduceat(drive, rows, axis=0)
    sums[-1] = drive[rows[-1] : rows[-1] + hop].sum(axis=0)
    counts = np.minimum(rows + hop, len(drive)) - rows
    return sums / counts[:, None]


class ModelStep(TransformerMixin, RegressorMixin, BaseEstimator):
    """A step that owns a model: it hands the frame on with it, and simulates it."""

    def _remember(self, model, experiment, X, y):
        """Store the model and what predictions have to look like."""
        self.model_ = model
        self.target_names_ = signal_names(y if hasattr(y, "ndim") else np.asarray(y), "y")
        kinds = {pd.DataFrame: "frame", pd.Series: "series"}
        self.target_kind_ = next((k for t, k in kinds.items() if isinstance(y, t)), None)
        if self.target_kind_ is None:
            self.target_kind_ = "vector" if np.ndim(y) == 1 else "array"
        self.n_features_in_ = experiment.frame.shape[1]
        if isinstance(X, pd.DataFrame):
            self.feature_names_in_ = np.asarray([str(c) for c in X.columns], dtype=object)
        return self

    def transform(self, X):
        """The same rows, with the model of this step attached.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)

        Returns
        -------
        frame : HarmonicFrame, shape (n_samples, n_features)
        """
        check_is_fitted(self)
        frame = self._upstream_frame(X)
        return HarmonicFrame.attach(frame, frame.basis, self.model_)

    def _upstream_frame(self, X):
        """X with the basis and the model of the steps before this one."""
        if getattr(self, "estimator", None) is None:
            return as_frame(X)
        return as_frame(self.estimator_.transform(X))

    def get_feature_names_out(self, input_features=None):
        """Names of the columns of ``transform``: those of the input.

        Parameters
        ----------
        input_features : array_like of str, optional

        Returns
        -------
        names : ndarray of str
        """
        check_is_fitted(self)
        default = [f"x{i}" for i in range(self.n_features_in_)]
        names = input_features if input_features is not None else default
        return np.asarray(getattr(self, "feature_names_in_", names), dtype=object)

    def predict(self, X, x0=None):
        """Free simulation of the model, in the units and the container of y at fit.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
        x0 : array_like or dict, optional
            State at the start of each segment: one vector of n_states for all,
            one row a segment, or a dict by record; zero where not given.

        Returns
        -------
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
        """
        check_is_fitted(self)
        experiment = self._experiment(X)
        starts = _initial_states(x0, experiment.base, self.model_.n_states)
        outputs = [
            simulator.outputs(start)
            for simulator, start in zip(self._simulators(experiment), starts, strict=True)
        ]
        return self._mirror(self._with_trim(np.vstack(outputs), experiment), X)

    def score(self, X, y, sample_weight=None):
        """R² of the free simulation in the units of y, averaged over the outputs.

        The initial state of each segment is fitted on its first ``warmup``
        seconds after the first whole window; those rows, and rows of
        incomplete periods, are left out.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
        sample_weight : array_like, shape (n_samples,), optional

        Returns
        -------
        score : float
        """
        check_is_fitted(self)
        truth, simulated, rows = self._fitted_simulation(X, y)
        weight = None if sample_weight is None else np.asarray(sample_weight, dtype=float)[rows]
        return float(r2_score(truth, simulated, sample_weight=weight))

    def _fitted_simulation(self, X, y):
        """Measured and simulated outputs on the rows that count, and those rows."""
        experiment = self._experiment(X, y)
        truth, simulated, rows = [], [], []
        parts = zip(
            self._simulators(experiment),
            experiment.outputs,
            experiment.base.segments,
            strict=True,
        )
        for simulator, y_segment, segment in parts:
            warm, counted = self._score_rows(simulator, experiment)
            if counted.start >= counted.stop:
                continue
            x0 = fit_initial_state(simulator, y_segment, warm)
            truth.append(y_segment[counted])
            simulated.append(simulator.outputs(x0)[counted])
            rows.append(np.arange(counted.start, counted.stop) + segment.start)
        if not truth:
            raise ValueError(
                f"no rows are left to score in {experiment.span()}: every segment is shorter than "
                f"one analysis window and the warm-up; give longer records or a smaller warmup"
            )
        return np.vstack(truth), np.vstack(simulated), np.concatenate(rows)

    def _score_rows(self, simulator, experiment):
        """Rows of one segment that the initial state is fitted on, and those scored."""
        basis, dt = experiment.basis, experiment.base.sample_time
        first, last = 0, len(simulator.time)
        if basis is not None:
            spp = basis.samples_per_period
            phase = basis.phase_index(simulator.time)
            first = len(basis.weights) - 1 - basis.lead
            first += -phase[min(first, last - 1)] % spp
            last -= (phase[-1] + 1) % spp
        warm = self._warmup_samples(basis, dt)
        warm = max(1, min(warm, int(WARMUP_SHARE * (last - first))))
        return slice(first, first + warm), slice(first + warm, last)

    def _warmup_samples(self, basis, dt):
        if self.warmup is None:
            return WARMUP_SAMPLES if basis is None else WARMUP_PERIODS * basis.samples_per_period
        hint = "None is five periods, or 50 samples without a harmonic basis"
        return round(check_positive("warmup", self.warmup, "seconds", hint) / dt)

    def _experiment(self, X, y=None):
        names = getattr(self, "feature_names_in_", None)
        if getattr(self, "estimator", None) is not None:
            X, names = self._upstream_frame(X), None
        experiment = read_experiment(X, y, None if names is None else tuple(names))
        if experiment.drive_names != self.model_.input_names:
            raise ValueError(
                f"the model is driven by {list(self.model_.input_names)}, X gives "
                f"{list(experiment.drive_names)}; use the same HarmonicAnalyzer as at fit"
            )
        dt, found = self.model_.dt, experiment.base.sample_time
        plain = experiment.basis is None and dt > 0.0 and len(experiment.base.time) > 1
        if plain and abs(dt - found) > STEP_TOLERANCE * dt:
            raise ValueError(
                f"the model was identified at a sample time of {dt:.6g} s, X has {found:.6g} s; "
                f"resample X, or bring the model to continuous time with SpuriousModeReducer"
            )
        return experiment

    def _simulators(self, experiment):
        dt = experiment.base.sample_time
        return [
            SegmentSimulator(self.model_, experiment.basis, drive, time, dt)
            for drive, time in zip(experiment.drive, experiment.times(), strict=True)
        ]

    def _with_trim(self, outputs, experiment):
        basis = experiment.basis
        if basis is None or basis.output_trim is None:
            return outputs
        return outputs + basis.output_trim[basis.phase_index(experiment.base.time)]

    def _mirror(self, values, X):
        """Predictions in the container, with the columns and the index, of y at fit."""
        index = X.index if isinstance(X, pd.DataFrame | pd.Series) else None
        if self.target_kind_ == "frame":
            return pd.DataFrame(values, index=index, columns=list(self.target_names_))
        if self.target_kind_ == "series":
            return pd.Series(values[:, 0], index=index, name=self.target_names_[0])
        return values[:, 0] if self.target_kind_ == "vector" else values

    @property
    def system_(self):
        """The model as a control.StateSpace with named signals."""
        check_is_fitted(self)
        return self.model_.to_control()


def fit_initial_state(simulator, outputs, rows):
    """Initial state whose simulation fits the outputs best over some rows."""
    forced = simulator.outputs(np.zeros(simulator.model.n_states))[rows]
    free = simulator.free(rows.stop)[:, rows]
    regressors = free.reshape(len(free), -1).T
    if regressors.shape[1] == 0:
        return np.zeros(0)
    scale = np.linalg.norm(regressors, axis=0)
    scale[scale == 0.0] = 1.0
    target = (outputs[rows] - forced).reshape(-1)
    return linalg.lstsq(regressors / scale, target, cond=1e-10)[0] / scale


def _initial_states(x0, base, n_states):
    """One initial state a segment, from a vector, an array of rows or a dict by record."""
    n_segments = len(base.segments)
    if x0 is None:
        return np.zeros((n_segments, n_states))
    if isinstance(x0, dict):
        missing = [record for record in base.records if record not in x0]
        if missing:
            raise ValueError(f"x0 has no state for record {missing[0]!r}; give one for each record")
        x0 = [x0[record] for record in base.records]
    x0 = np.asarray(x0, dtype=float)
    if x0.ndim == 1:
        x0 = np.broadcast_to(x0, (n_segments, len(x0)))
    if x0.shape != (n_segments, n_states):
        raise ValueError(
            f"x0 has shape {x0.shape}; the model has {n_states} states and the data {n_segments} "
            f"segments: give ({n_states},), ({n_segments}, {n_states}) or a dict by record"
        )
    return x0
