"""Base of the three model steps: the model behind them, simulation, score."""

from dataclasses import replace

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.metrics import r2_score
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import (
    check_count,
    check_output_names,
    check_outputs_given,
    check_positive,
    signal_names,
)
from sklearn_hd._containers import from_elsewhere, is_pandas
from sklearn_hd._delayed import Delayed
from sklearn_hd._excitation import Excitation
from sklearn_hd._exported import Exported
from sklearn_hd._frame import FrameTransformer, HarmonicFrame
from sklearn_hd._guards import one_blas_thread, within_range
from sklearn_hd._readings import first_difference
from sklearn_hd._records.data import (
    as_frame,
    check_features,
    is_decomposed,
    read_experiment,
    read_signals,
)
from sklearn_hd._records.delays import leads, with_delayed_inputs
from sklearn_hd._records.sampling import joined
from sklearn_hd._records.states import initial_states, states_by_record
from sklearn_hd._residuals import ResidualTests
from sklearn_hd._sample_model import SampleModel
from sklearn_hd._scoring import compared, meet_at_rest, power_of_two
from sklearn_hd._simulators import (
    LiftedSimulator,
    SegmentSimulator,
    as_seen,
    fit_initial_state,
    predicted_ahead,
    sample_simulators,
)
from sklearn_hd._tables import STEP_TOLERANCE, as_container, without_inputs
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.signals.late_signals import advanced, late
from sklearn_hd.exceptions import IdentifiabilityWarning

WARMUP_SHARE = 0.25


def _has_gain(step):
    """Whether a Kalman gain was, or will be, identified."""
    return step._predicts_ahead()


class ModelStep(FrameTransformer, ResidualTests, Exported, Delayed, RegressorMixin, BaseEstimator):
    """A step that owns a model: it passes the frame on with it, and simulates it."""

    def __sklearn_is_fitted__(self):
        return hasattr(self, "model_")

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.target_tags.required = True
        tags.target_tags.multi_output = True
        tags.target_tags.single_output = True
        tags.transformer_tags.preserves_dtype = []  # frames have a type a column
        tags.regressor_tags.poor_score = True  # rows in random order have no dynamics
        return tags

    def _remember(self, model, basis, X, y, experiment=None):
        """Store the model, what predictions have to look like, and what inputs showed."""
        check_features(self, X, reset=True)
        self.model_, self.basis_ = model, basis
        y = as_container(y, "y")
        self.predicts_harmonics_ = is_decomposed(y)
        labels = basis.output_labels if self.predicts_harmonics_ else None
        self.target_names_ = labels or signal_names(y, "y")
        self.target_columns_ = list(labels or getattr(y, "columns", self.target_names_))
        self.target_levels_ = list(y.columns.names) if isinstance(y, pd.DataFrame) else [None]
        self.target_dtypes_ = _float_types(y, len(self.target_names_))
        if isinstance(y, pd.Series):
            self.target_columns_ = [y.name]
        kinds = {pd.DataFrame: "frame", pd.Series: "series"}
        self.target_kind_ = next((k for t, k in kinds.items() if isinstance(y, t)), None)
        if self.target_kind_ is None:
            self.target_kind_ = "vector" if y.ndim == 1 else "array"
        told = None if experiment is None else self._simulators(experiment, exact=False)
        if told is not None:
            told = Excitation.of(experiment, told, self._n_input_harmonics())
        self._excitation = told
        return self

    def _n_input_harmonics(self):
        """Harmonics that the inputs' effect has."""
        at_azimuths = isinstance(self.model_, SampleModel)
        return self.model_.innovations.n_harmonics if at_azimuths else 0

    def transform(self, X):
        """The same rows, with the model of this step attached.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Inputs as at fit, plain or as a frame with a harmonic basis.

        Returns
        -------
        frame : HarmonicFrame, shape (n_samples, n_features)
            The values unchanged.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If X differs from that at fit in its columns, or is not finite.
        """
        check_is_fitted(self)
        frame = self._upstream_frame(check_features(self, X, reset=False))
        if not frame.is_analysed:
            read_signals(frame, "x", "X")  # finite numbers on increasing times
        return HarmonicFrame.attach(frame, self._own_basis(frame.basis), self.model_)

    def _own_basis(self, basis):
        """A basis with the outputs' trim of this model, which the dynamics may have told."""
        if basis is None or basis.output_trim is None:
            return basis
        return replace(basis, output_trim=self.basis_.output_trim)

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
            Names to give the columns of an array; x0, x1, … by default.

        Returns
        -------
        names : ndarray of str
            Those of the columns at fit, where they had names.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        """
        check_is_fitted(self)
        default = [f"x{i}" for i in range(self.n_features_in_)]
        names = input_features if input_features is not None else default
        return np.asarray(getattr(self, "feature_names_in_", names), dtype=object)

    @one_blas_thread
    @within_range
    def predict(self, X, x0=None):
        """Free simulation of the model, in the units and the container of y at fit.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Inputs as at fit, plain or as a frame with a harmonic basis.
        x0 : array_like or dict, optional
            State at the start of each segment: one vector, shape (n_states,), for all; one row per
            segment; or a dict (or a DataFrame's rows) by record. The label of a record is a tuple
            if several index levels precede the time. Zero by default.

        Returns
        -------
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Harmonics instead, without the trim, if y was a HarmonicFrame at fit.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        UnstableModelError
            If the simulation overflows.
        ValueError
            If X was analysed or sampled differently than at fit, or x0 does not fit.

        Warns
        -----
        ExcitationWarning
            If inputs move separately that never did so in the record of the fit; if, for a model
            of whole periods, they move within the period as they never did; or if the effect of
            inputs at these phases is so uncertain that the standard deviation of the predicted
            motion is more than the fit left. The warning names the inputs and the share.
        """
        check_is_fitted(self)
        experiment = self._experiment(X)
        simulators = self._simulators(experiment)
        self._warn_of_inputs(experiment, simulators)
        starts = self._starts(x0, experiment, simulators[0].model)
        outputs = [
            late(
                simulator.outputs(start, recompose=not self.predicts_harmonics_),
                self._samples_late(experiment),
            )
            for simulator, start in zip(simulators, starts, strict=True)
        ]
        return self._mirror(self._with_trim(outputs, experiment), X)

    def _warn_of_inputs(self, experiment, simulators):
        """Warn of inputs whose effect the record of the fit did not show."""
        if self._excitation is not None:
            if experiment.delays is not None:
                simulators = self._simulators(experiment, exact=False)
            self._excitation.warn(experiment, simulators)

    def _starts(self, x0, experiment, model=None):
        """One initial state a segment."""
        model = self.model_ if model is None else model
        return initial_states(x0, experiment.base, model.n_states, model.state_names)

    def _with_trim(self, outputs, experiment):
        """Outputs on the grid, trim added, at the user's rows."""
        trim = experiment.output_trim()
        if trim is not None and not self.predicts_harmonics_:
            outputs = [y + waveform for y, waveform in zip(outputs, trim, strict=True)]
        return experiment.sampling.back(outputs)

    @one_blas_thread
    @within_range
    def score(self, X, y, sample_weight=None):
        """R² of the free simulation of the motion, in the units of y, averaged over the outputs.

            R² = 1 − Σ (y − ŷ)² / Σ (y − w − mean)²

        w is the subtracted trim, or the identified forced periodic response
        (``reading="sample"``), so a waveform that repeats itself with every turn does not count.
        If no trim is known (``trim_span=None``), w is zero. The initial state of each segment is
        fitted on its first ``warmup`` seconds after the first whole window. Those rows, and rows
        of incomplete periods, are not scored. A model identified through a sliding window is
        compared with y as that window shows it, because it describes no more; any other with y
        itself.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Inputs as at fit, plain or as a frame with a harmonic basis.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Measured outputs on the rows of X.
        sample_weight : array_like, shape (n_samples,), optional
            Weight of each row; rows that are not scored have no effect.

        Returns
        -------
        score : float
            1 for a perfect model, 0 for one no better than the mean, −inf for an unstable one
            whose simulation grows beyond 1e60 times y (with an InstabilityWarning).

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If fewer than two rows are left to score, or X and y do not fit the model.

        Warns
        -----
        ExcitationWarning
            As ``predict``; not within a search or a cross-validation.
        """
        check_is_fitted(self)
        check_outputs_given(y)
        found = compared(self, X, y, sample_weight)
        if found is None:
            return -np.inf
        truth, simulated, weight = found
        if len(truth) < 2:
            raise ValueError(
                "only one row is left to score, which has no R²; give longer records or a smaller "
                "warmup"
            )
        unit = power_of_two(truth)  # R² is the same, and its squares do not overflow
        return float(r2_score(truth / unit, simulated / unit, sample_weight=weight))

    @one_blas_thread
    @within_range
    def initial_state(self, X, y):
        """State at the start of each segment, fitted to its first rows as ``score`` does.

            x0 = arg min Σ (y − ŷ(x0))²   over the first ``warmup`` seconds

        after the first whole window, with each output divided by its size. ``predict(X, x0=x0)``
        then gives the simulation that ``score`` compares.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs as at fit; None if there were none.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Measured outputs on the rows of X.

        Returns
        -------
        x0 : DataFrame or ndarray, shape (n_segments, n_states)
            A DataFrame by record, or by segment if gaps divide a record; an array if X is one. Its
            columns are named as the states of the model that ``predict`` simulates.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If X and y do not fit the model.

        Warns
        -----
        IdentifiabilityWarning
            If segments are too short to be scored: their states are then the smallest that fit all
            their rows.
        """
        check_is_fitted(self)
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        experiment = self._experiment(X, y)
        simulators, states, short = self._simulators(experiment), [], []
        samples, unread = self._samples_late(experiment), leads(experiment)[1]
        for simulator, outputs in zip(simulators, experiment.outputs, strict=True):
            measured = advanced(outputs, samples)
            warm, counted = self._score_rows(simulator, experiment)
            if counted.start >= counted.stop:
                short.append(len(measured))
                warm = slice(0, max(1, len(measured) - unread))
            states.append(fit_initial_state(simulator, as_seen(simulator, measured), warm))
        if short:
            warn(
                f"{len(short)} of {len(states)} segment(s) are shorter than one analysis window "
                f"and the warm-up (the longest of {max(short)} rows): their initial states are the "
                f"smallest that fit these rows; give longer records or a smaller warmup",
                IdentifiabilityWarning,
            )
        named = states_by_record(states, experiment.base, simulators[0].model.state_names)
        return named if is_pandas(from_elsewhere(X, "X")) else named.to_numpy()

    def _fitted_simulation(self, X, y, horizon=None):
        """Measured and simulated (or predicted) outputs on the rows that count, and those rows.

        Both without the forced periodic response, which comes last.
        """
        experiment = self._experiment(without_inputs(y) if X is None else X, y)
        trim, sampling = experiment.output_trim(), experiment.sampling
        truth, simulated, rows, forced = [], [], [], []
        simulators = self._simulators(experiment)
        self._warn_of_inputs(experiment, simulators)
        samples = (self._samples_late if horizon is None else self._samples_ahead)(experiment)
        parts = zip(simulators, experiment.outputs, sampling.pieces, strict=True)
        for i, (simulator, y_segment, piece) in enumerate(parts):
            y_segment = advanced(y_segment, samples)
            warm, counted = self._score_rows(simulator, experiment)
            if counted.start >= counted.stop:
                continue
            within = piece.rows_between(counted.start, counted.stop)
            measured = experiment.measured[piece.rows][within]
            own = np.arange(within.start, within.stop)
            if experiment.has_gaps:  # rows that were bridged do not count
                kept = np.isfinite(measured).all(axis=1)
                measured, own = measured[kept], own[kept]
                within = own
            seen = as_seen(simulator, y_segment)
            outputs = self._fitted_outputs(simulator, seen, warm, horizon)
            loads = np.broadcast_to(simulator.forced(), outputs.shape)
            if seen is y_segment:
                outputs, loads = (late(each, samples) for each in (outputs, loads))
                known = loads if trim is None else trim[i] + loads
                truth.append(measured - piece.back(known)[within])
            else:
                truth.append(piece.back(seen - loads)[within])
            simulated.append(piece.back(outputs - loads)[within])
            forced.append(piece.back(loads)[within])
            rows.append(own + piece.rows.start)
        if not truth:
            raise ValueError(
                f"no rows are left to score in {experiment.span()}: every segment is shorter than "
                f"one analysis window and the warm-up; give longer records or a smaller warmup"
            )
        truth, simulated = (np.asfortranarray(joined(parts)) for parts in (truth, simulated))
        rows, forced = joined(rows), joined(forced)  # by columns, which are quick to sum
        meet_at_rest(truth, simulated, experiment.measured[rows])
        return truth, simulated, rows, forced

    def _fitted_outputs(self, simulator, outputs, rows, horizon):
        """Outputs from the initial state that fits best over some rows."""
        if horizon is None:
            return simulator.outputs(fit_initial_state(simulator, outputs, rows))
        if not _has_gain(self):
            raise ValueError(
                f"horizon={horizon!r} asks for predictions from measured outputs, but this "
                f"{type(self).__name__} has no Kalman gain; use "
                f"MOESPRegressor(disturbance_model=True) or "
                f"StructuredMatcher(criterion='prediction_error') as the last step, or horizon=None"
            )
        recompose = not self.predicts_harmonics_
        return predicted_ahead(simulator, outputs, horizon, rows=rows, recompose=recompose)

    def _predicts_ahead(self):
        """Whether a Kalman gain was, or will be, identified."""
        return False

    def _score_rows(self, simulator, experiment):
        """Rows of one segment that the initial state is fitted on, and those scored."""
        first, last = experiment.basis.scored_rows(simulator.time)
        unknown, unread = leads(experiment)
        first += unknown
        warm = self._warmup_samples(experiment)
        warm = max(1, min(warm, int(WARMUP_SHARE * (last - first - 2 * unread))))
        return slice(first, first + warm), slice(first + warm + unread, last - unread)

    def _warmup_samples(self, experiment):
        if self._check_warmup() is None:
            return experiment.basis.warmup_samples
        return round(self.warmup / experiment.base.sample_time)

    def _check_warmup(self):
        if self.warmup is None:
            return None
        hint = "None is five periods, or 50 samples without a harmonic basis"
        return check_positive("warmup", self.warmup, "seconds", hint)

    def _experiment(self, X, y=None):
        X = check_features(self, X, reset=False)
        decomposition = self.basis_ if self.predicts_harmonics_ else None
        if getattr(self, "estimator", None) is not None:
            X = self._upstream_frame(X)
        if isinstance(X, HarmonicFrame):
            X = HarmonicFrame.attach(X, self._own_basis(X.basis), X.model)
        experiment = read_experiment(X, y, decomposition)
        self._check_basis(experiment.basis)
        if y is not None and not self.predicts_harmonics_:
            check_output_names(experiment.output_names, self.target_names_, "the model")
        if not experiment.basis.harmonic:
            self._check_step(experiment.base)
        delays = self.model_.delays
        return experiment if delays is None else with_delayed_inputs(experiment, delays)

    def _check_step(self, base):
        """Raise ValueError if plain rows are another step apart than those of a discrete model."""
        dt, found = self.model_.dt, base.sample_time
        told = dt > 0.0 and len(base.time) > 1
        if told and abs(dt - found) > STEP_TOLERANCE * dt + 4.0 * base.uncertainty:
            raise ValueError(
                f"the model was identified at a sample time of {dt:.6g} s, but X has {found:.6g} "
                f"s; resample X, or bring the model to continuous time with SpuriousModeReducer"
            )

    def _check_basis(self, basis):
        """Raise ValueError if X was analysed in another way than at fit."""
        difference = first_difference(basis, self.basis_)
        if difference is not None:
            name, here, there = difference
            raise ValueError(
                f"X was analysed with {name}={here!r}, but the data at fit with {there!r}; use the "
                f"same HarmonicAnalyzer"
            )

    def _simulators(self, experiment, *, exact=True):
        """Simulators of each segment; fractions of delays ``exact`` where the model holds them."""
        if isinstance(self.model_, SampleModel):
            return sample_simulators(self.model_, experiment)
        basis, dt, times = experiment.basis, experiment.base.sample_time, experiment.times()
        if self.model_.lifted is not None:
            parts = zip(experiment.drive, times, experiment.inputs, strict=True)
            return [LiftedSimulator(self.model_, basis, u, t, dt, raw) for u, t, raw in parts]
        parts = zip(experiment.drive, times, strict=True)
        return [SegmentSimulator(self.model_, basis, drive, time, dt) for drive, time in parts]

    def _mirror(self, values, X):
        """Predictions in the container, with the columns and the index, of y at fit."""
        X = from_elsewhere(X, "X")
        index = X.index if is_pandas(X) else None
        types = self.target_dtypes_
        with np.errstate(over="ignore"):  # beyond float32 is infinity, as NumPy has it
            if self.target_kind_ == "frame":
                levels = len(self.target_levels_)
                columns = pd.Index(self.target_columns_, tupleize_cols=levels > 1)
                frame = pd.DataFrame(values, index=index, columns=range(len(columns)))
                frame = frame.astype(dict(enumerate(types)))
                return frame.set_axis(columns.set_names(self.target_levels_), axis=1)
            if self.target_kind_ == "series":
                name = self.target_columns_[0]
                return pd.Series(values[:, 0], index=index, name=name).astype(types[0])
            values = values.astype(types[0])
        return values[:, 0] if self.target_kind_ == "vector" else values

    @available_if(_has_gain)
    @one_blas_thread
    @within_range
    def predict_ahead(self, X, y, horizon=1, x0=None):
        """Predict outputs some rows ahead from the outputs before them.

            x̂[k+1] = A x̂[k] + B u[k] + K e[k],   ŷ[k] = C x̂[k] + D u[k],   e = y − ŷ

        These equations predict one row ahead; further ahead the model continues without e.
        ``predict`` simulates from the inputs alone. ``predict_ahead`` also accounts for past
        disturbances, and works for unstable models.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs as at fit; None if there were none.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Measured outputs on the rows of X.
        horizon : int, default=1
            Rows (periods with ``reading="period"``) from the last output used to the predicted
            one.
        x0 : array_like or dict, optional
            As in ``predict``; by default the state with the smallest innovations over the first
            rows of the segment, as many as depend on it.

        Returns
        -------
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            In the container of y at fit.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If X, y, ``horizon`` or x0 do not fit the model.

        References
        ----------
        Ljung (1999), System Identification, Eq. 3.31 (predictions k steps ahead).

        Examples
        --------
        >>> from sklearn_hd import MOESPRegressor
        >>> e = np.random.default_rng(0).standard_normal(2000)
        >>> y = np.zeros(2000)
        >>> for k in range(1999):
        ...     y[k + 1] = 0.9 * y[k] + e[k + 1]
        >>> model = MOESPRegressor(1, block_rows=5, disturbance_model=True).fit(None, y)
        >>> round(float(np.std(y - model.predict_ahead(None, y)) / np.std(e)), 2)
        1.0
        """
        check_is_fitted(self)
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        horizon = check_count("horizon", horizon, 1, "1 is the next row")
        experiment = self._experiment(X, y)
        simulators, recompose = self._simulators(experiment), not self.predicts_harmonics_
        samples = self._samples_ahead(experiment)
        starts, unread = [None] * len(simulators), leads(experiment)[1]
        if x0 is not None:
            starts = self._starts(x0, experiment, simulators[0].model)
        parts = zip(simulators, experiment.outputs, starts, strict=True)
        outputs = [
            late(
                predicted_ahead(
                    simulator,
                    advanced(measured, samples),
                    horizon,
                    start,
                    rows=slice(0, len(measured) - unread),
                    recompose=recompose,
                ),
                samples,
            )
            for simulator, measured, start in parts
        ]
        return self._mirror(self._with_trim(outputs, experiment), X)

    @property
    def system_(self):
        """The model as a control.StateSpace with named signals."""
        check_is_fitted(self)
        return self.model_.to_control()


def _float_types(y, n_outputs):
    """Name of the type of each prediction: that of y where it is one of floats, else float64."""
    given = y.dtypes if isinstance(y, pd.DataFrame) else [y.dtype]
    given = [getattr(dtype, "subtype", dtype) for dtype in given]  # of sparse columns
    types = [
        str(dtype) if pd.api.types.is_float_dtype(dtype) and str(dtype) != "float16" else "float64"
        for dtype in given
    ]
    return types if len(types) == n_outputs else types[:1] * n_outputs
