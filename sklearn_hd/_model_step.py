"""Base of the three model steps: the model behind them, simulation, score."""

from dataclasses import replace

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator, RegressorMixin, clone
from sklearn.metrics import r2_score
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import (
    STANDARD_ERRORS,
    check_count,
    check_fraction,
    check_output_names,
    check_outputs_given,
    check_positive,
    signal_names,
)
from sklearn_hd._clock import STEP_TOLERANCE
from sklearn_hd._containers import as_container, from_elsewhere, is_pandas, without_inputs
from sklearn_hd._excitation import Excitation, warn_of_orbit
from sklearn_hd._exported import contents
from sklearn_hd._frame import FrameTransformer, HarmonicFrame, SampleModel, read_as
from sklearn_hd._guards import one_blas_thread, warn, within_range
from sklearn_hd._readings import HarmonicBasis, first_difference
from sklearn_hd._records.data import (
    as_frame,
    check_features,
    is_decomposed,
    read_experiment,
    read_for_fit,
    read_signals,
)
from sklearn_hd._records.delays import in_machine_time, leads, with_delayed_inputs
from sklearn_hd._residuals import left_of, scored
from sklearn_hd._simulators import (
    LiftedSimulator,
    SegmentSimulator,
    as_seen,
    compared,
    fit_initial_state,
    initial_states,
    power_of_two,
    predicted_ahead,
    sample_simulators,
    score_rows,
    states_by_record,
    steady,
)
from sklearn_hd.algorithms.signals.resampling import late
from sklearn_hd.algorithms.signals.trim import LEVEL
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems.export import write


def _has_gain(step):
    """Whether a Kalman gain was, or will be, identified; AttributeError names the way to one."""
    if not step._predicts_ahead():
        raise AttributeError(
            "predict_ahead needs a Kalman gain: of MOESPRegressor with disturbance_model=True, "
            "weighting='pbsid' or behind HarmonicAnalyzer(reading='sample'), or of "
            "StructuredMatcher with criterion='prediction_error'"
        )
    return True


class ModelStep(FrameTransformer, RegressorMixin, BaseEstimator):
    """A step that owns a model: it passes the frame on with it, and simulates it."""

    def __sklearn_is_fitted__(self):
        return hasattr(self, "model_")

    def _predicts_ahead(self):
        """Whether a Kalman gain was, or will be, identified."""
        return False

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.target_tags.required = True
        tags.target_tags.multi_output = True
        tags.target_tags.single_output = True
        tags.transformer_tags.preserves_dtype = []  # frames have a type a column
        tags.regressor_tags.poor_score = True  # rows in random order have no dynamics
        return tags

    def _remember(self, model, basis, X, y, experiment=None, n_input_harmonics=None):
        """Store the model, what predictions have to look like, and what inputs showed.

        Of an effect of so many harmonics of the inputs; by default as many as the model's has.
        """
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
            if n_input_harmonics is None:
                n_input_harmonics = self._n_input_harmonics()
            told = Excitation.of(experiment, told, n_input_harmonics)
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
            The values unchanged. If the analyzer left the reading open, the columns are those of
            the reading that the model chose.

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
            read_signals(frame)  # finite numbers on increasing times
        frame = self._as_read(frame)
        return HarmonicFrame.attach(frame, frame.basis, self.model_)

    def _as_read(self, frame):
        """A frame with the basis of this model: its reading, of those the analyzer left open, and
        the outputs' trim, which the dynamics may have told."""
        if frame.basis is None:
            return frame
        frame = read_as(frame, self.basis_.reading)
        labels = list(frame.basis.coefficient_labels)
        if labels and frame[labels].isna().all(axis=None):
            raise ValueError(
                "a segment of X is shorter than a period, and this model reads whole periods; give "
                "longer segments, or use HarmonicAnalyzer(reading='sample'), which has no window"
            )
        basis = replace(frame.basis, alternative=None)
        if basis.output_trim is not None:
            basis = replace(basis, output_trim=self.basis_.output_trim)
        return HarmonicFrame.attach(frame, basis, frame.model)

    def _upstream_frame(self, X):
        """X with the basis and the model of the steps before this one."""
        if getattr(self, "estimator", None) is None:
            return as_frame(X)
        return as_frame(self.estimator_.transform(X))

    def _upstream(self, X, y):
        """The experiment of a fit, in the machine's own time, and the model that it starts from.

        X carries the model, or it is that of ``estimator``, a clone of which is fitted here
        (``estimator_``).
        """
        check_outputs_given(y)
        self._check_warmup()
        if self.estimator is None:
            frame, name = as_frame(X), type(self).__name__
            problem = (
                f"{name} found no model on X; put it behind MOESPRegressor in a Pipeline (without "
                f"a step between them that rebuilds the frame), or give it one: "
                f"{name}(estimator=...)"
            )
        else:
            problem = (
                f"estimator={self.estimator!r} does not make a model; give a MOESPRegressor or "
                f"SpuriousModeReducer, or a Pipeline that ends in one"
            )
            made = all(hasattr(self.estimator, name) for name in ("get_params", "transform"))
            if isinstance(self.estimator, type) or not made:
                raise ValueError(problem)
            self.estimator_ = clone(self.estimator).fit(X, y)
            frame = self._upstream_frame(X)
        if frame.model is None:
            raise ValueError(problem)
        experiment, delays = read_for_fit(frame, y), frame.model.delays
        return experiment if delays is None else in_machine_time(experiment, delays), frame.model

    def get_feature_names_out(self, input_features=None):
        """Names of the columns of ``transform``: those of the input, in the model's reading.

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
        names = list(getattr(self, "feature_names_in_", names))
        if isinstance(self.basis_, HarmonicBasis):
            read = [*self.basis_.measured, *self.basis_.coefficient_labels]
            names = read if set(read) < set(names) else names
        return np.asarray(names, dtype=object)

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
            if several index levels precede the time. None is rest: zero, or, for a model of samples
            whose inputs at fit held their trim (their periodic mean is larger than their motion),
            the state in trim: of the inputs in the first two turns if they rest there, else of
            their mean at fit.

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
        IdentifiabilityWarning
            If the record tells the orbit (``reading="sample"``) less well than a tenth of the
            motion predicted about it.
        """
        check_is_fitted(self)
        experiment = self._experiment(X)
        simulators = self._simulators(experiment)
        self._warn_of_inputs(experiment, simulators)
        starts = self._starts(x0, experiment, simulators)
        outputs = [
            simulator.outputs(start, recompose=not self.predicts_harmonics_)
            for simulator, start in zip(simulators, starts, strict=True)
        ]
        warn_of_orbit(simulators, outputs)
        outputs = [late(y, self._samples_late(experiment)) for y in outputs]
        return self._mirror(self._at_rows(outputs, simulators, experiment), X)

    def _warn_of_inputs(self, experiment, simulators):
        """Warn of inputs whose effect the record of the fit did not show."""
        if self._excitation is not None:
            if experiment.delays is not None:
                simulators = self._simulators(experiment, exact=False)
            self._excitation.warn(experiment, simulators)

    def _starts(self, x0, experiment, simulators):
        """One initial state a segment; at rest if none is given."""
        if x0 is None:
            return [simulator.at_rest() for simulator in simulators]
        model = simulators[0].model
        return initial_states(x0, experiment.base, model.n_states, model.state_names)

    def _at_rows(self, outputs, simulators, experiment):
        """Outputs on the grid, trim added, at the user's rows.

        Only what moves about the trim and the forced response is interpolated.
        """
        sampling = experiment.sampling
        if self.predicts_harmonics_:
            return sampling.back(outputs)
        samples, trim = self._samples_late(experiment), experiment.output_trim_at_rows()
        moving, known = [], []
        for i, (y, *each) in enumerate(zip(outputs, simulators, sampling.pieces, strict=True)):
            on_grid, at_rows = steady(*each, y.shape[1], samples)
            moving.append(y - on_grid)
            known.append(at_rows if trim is None else at_rows + trim[i])
        return sampling.back(moving, known)

    @one_blas_thread
    @within_range
    def score(self, X, y, sample_weight=None):
        """R² of the free simulation of the motion, in the units of y, averaged over the outputs.

            R² = 1 − Σ (y − ŷ)² / Σ (y − w − mean)²

        w is the subtracted trim, or the identified forced periodic response
        (``reading="sample"``), so a waveform that repeats itself with every turn does not count.
        If no trim was found or given, w is zero. The initial state of each segment is
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
        IdentifiabilityWarning
            Likewise, of a record about another orbit than the model's, and of one as ``predict``.
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
            measured = late(outputs, -samples)
            warm, counted = score_rows(self, simulator, experiment)
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
            X = self._as_read(X)
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
        if told and abs(dt - found) > STEP_TOLERANCE * dt + STANDARD_ERRORS * base.uncertainty:
            raise ValueError(
                f"the model was identified at a sample time of {dt:.6g} s, but X has {found:.6g} "
                f"s; resample X, or bring the model to continuous time with SpuriousModeReducer"
            )

    def _check_basis(self, basis):
        """Raise ValueError if X was analysed in another way than at fit."""
        difference = first_difference(basis, self.basis_)
        if difference is not None:
            name, here, there = difference
            if self.basis_.harmonic and not basis.harmonic:
                raise ValueError(
                    "X is raw signals, but the data at fit were analysed; give what the fitted "
                    "HarmonicAnalyzer makes of X: pipe[:-1].transform(X)"
                )
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
            starts = self._starts(x0, experiment, simulators)
        parts = zip(simulators, experiment.outputs, starts, strict=True)
        outputs = [
            late(
                predicted_ahead(
                    simulator,
                    late(measured, -samples),
                    horizon,
                    start,
                    rows=slice(0, len(measured) - unread),
                    recompose=recompose,
                ),
                samples,
            )
            for simulator, measured, start in parts
        ]
        return self._mirror(self._at_rows(outputs, simulators, experiment), X)

    @one_blas_thread
    @within_range
    def residual_tests(self, X, y, *, lags=None, level=LEVEL):
        """Test whether the residuals of a record are noise, with one row per test.

        Residuals are the errors of one-step predictions if the model has a Kalman gain, otherwise
        those of simulations. They are noise if they correlate with nothing known beforehand,
        beyond what a small change of the parameters would remove (score tests, which account for
        fitted parameters and the colour of the inputs):

        - *autocorrelation*: residuals of earlier rows. For simulations this test requires more
          than a correct effect of the inputs: the noise must be white and on the outputs.
        - *inputs*: those of the same row and of earlier rows; of a machine that turns, their sums
          over intervals that reach back three turns.
        - *nonlinearity*: squares (also times the first harmonic of the turn) and cubes of
          predictions and inputs about their periodic means. A wrong order may fail it, too.
        - *mean*, or *loads* of a machine that turns: a constant, or harmonics of the turn (not
          if a trim was subtracted).
        - *autocorrelation by phase*, *inputs by phase*: the first two, times the first two
          harmonics of the turn.

        The variance of residuals may depend on time and azimuth.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs as at fit; None if there were none. Only the first 20 000 rows are used.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Measured outputs on the rows of X.
        lags : int, optional
            Number of earlier rows in the tests; by default 20, or fewer with several outputs or
            few rows, and three turns of inputs.
        level : float, default=0.001
            Share of correct models that fail one of the tests; it is divided among the tests.

        Returns
        -------
        tests : DataFrame, shape (n_tests, 6)
            By test: ``statistic``; ``degrees`` of freedom of its χ² distribution (0 if nothing is
            left to test, because the model has parameters for it); ``p_value``; ``share`` of the
            residuals' variance that is not noise; ``level``, the test's share of that given;
            ``passed``, unless ``p_value`` is below it.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        UnstableModelError
            If a simulation overflows.
        ValueError
            If the model is one of whole windows or periods, there are too few rows for its
            parameters, or X, y, ``lags`` or ``level`` do not fit.

        References
        ----------
        Ljung (1999), System Identification, section 16.6.
        Godfrey (1978), Econometrica 46(6), 1293-1301 (autocorrelation).
        Neyman (1959), C(α) tests, which allow for fitted parameters.

        Examples
        --------
        >>> import numpy as np
        >>> from sklearn_hd import MOESPRegressor
        >>> rng = np.random.default_rng(0)
        >>> u, e, y = rng.standard_normal((3, 2000))
        >>> y[:2] = 0.0
        >>> for k in range(2, 2000):
        ...     y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + e[k]
        >>> right = MOESPRegressor(order=2, disturbance_model=True).fit(u[:, None], y)
        >>> bool(right.residual_tests(u[:, None], y)["passed"].all())
        True
        >>> wrong = MOESPRegressor(order=1, disturbance_model=True).fit(u[:, None], y)
        >>> wrong.residual_tests(u[:, None], y)["passed"].to_dict()
        {'autocorrelation': False, 'inputs': False, 'nonlinearity': False, 'mean': True}
        """
        level = check_fraction("level", level, "it is a probability, such as 0.001")
        if lags is not None:
            check_count("lags", lags, 1, "20 is usual")
        return scored(left_of(self, X, y), lags, level)

    def export(self, path, *, n_phases=64):
        """Write the model to a file for MATLAB (.mat) or any program (.json).

        The file has the periodic system, where there is one, and the time-invariant matrices A,
        B, C, D of ``system_``; names and units as in the record; exponents with their standard
        deviations; waveforms of the trim, and the forced periodic response; delays in seconds.
        :func:`~sklearn_hd.systems.load_model` reads JSON back.

        Parameters
        ----------
        path : str or path-like
            Ends in ``.json`` or ``.mat``; a file that is there is replaced.
        n_phases : int, default=64
            Azimuths in a period at which periodic matrices are tabulated, too.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If the suffix is another, a number is not finite, or the folder does not exist.
        OSError
            If the file cannot be written.
        """
        check_is_fitted(self)
        write(contents(self, n_phases), path)

    @property
    def system_(self):
        """The model as a control.StateSpace with named signals."""
        check_is_fitted(self)
        return self.model_.to_control()

    @property
    def delays_(self):
        """Delay of each input and output, seconds, as a Series."""
        return self._delays("seconds", 0.0, "delay")

    @property
    def delay_std_(self):
        """Standard deviation of each delay, as a Series; NaN if it was given."""
        return self._delays("std", np.nan, "delay_std")

    def _delays(self, what, none, name):
        check_is_fitted(self)
        delays = self.model_.delays
        if delays is None:
            names = [*self.basis_.input_signals, *self.target_names_]
            return pd.Series(none, names, name=name)
        return delays.table(what).rename(name)

    # ---- delays, which the matrices do not include -------------------------------------------

    def _samples_late(self, experiment):
        """Samples by which each output is measured after the simulators have it."""
        delays = self.model_.delays
        if delays is None:
            return np.zeros(1)
        if self.predicts_harmonics_ and delays.outputs.any():
            raise ValueError(
                "y was given as a HarmonicFrame of coefficients, and coefficients cannot be "
                "shifted in time; give y in time at fit, or use output_delay=0"
            )
        return delays.outputs / experiment.base.sample_time

    def _compared(self, experiment):
        """An experiment with outputs in the machine's own time, as far as they are known there."""
        delays = self.model_.delays
        return experiment if delays is None else in_machine_time(experiment.origin, delays)

    def _samples_ahead(self, experiment):
        """Samples by which outputs are late, which have to be alike where they tell the state."""
        samples = self._samples_late(experiment)
        if np.ptp(samples) > 0.0:
            raise ValueError(
                f"the outputs have different delays ({self.model_.delays.outputs.tolist()} s), so "
                f"a prediction ahead would use values measured later; give one output_delay for "
                f"all outputs, or simulate (predict, horizon=None)"
            )
        return samples


def _float_types(y, n_outputs):
    """Name of the type of each prediction: that of y where it is one of floats, else float64."""
    given = y.dtypes if isinstance(y, pd.DataFrame) else [y.dtype]
    given = [getattr(dtype, "subtype", dtype) for dtype in given]  # of sparse columns
    types = [
        str(dtype) if pd.api.types.is_float_dtype(dtype) and str(dtype) != "float16" else "float64"
        for dtype in given
    ]
    return types if len(types) == n_outputs else types[:1] * n_outputs
