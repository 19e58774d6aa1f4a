"""Step 3: subspace identification of a discrete-time state-space model."""

import copy

import numpy as np
from scipy import linalg
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import within_range
from sklearn_hd._checks import check_outputs_given, signal_names
from sklearn_hd._containers import as_container, without_inputs
from sklearn_hd._continuous import output_scale
from sklearn_hd._fit_checks import (
    check_motion,
    warn_of_growing_data,
    warn_of_growth,
    warn_of_mismatch,
)
from sklearn_hd._frame import LTIModel
from sklearn_hd._identify.checks import MOST_PREDICTOR_ROWS, PREDICTOR, SubspaceChecks, is_lifted
from sklearn_hd._identify.chunks import Stream, first_date, read_chunk
from sklearn_hd._identify.innovation_model import InnovationModel
from sklearn_hd._identify.modulation import modulated_inputs
from sklearn_hd._identify.more_rows import MoreRows, is_sliding
from sklearn_hd._identify.partitions import Partitions, is_partitioned
from sklearn_hd._identify.statistics import Facts, Records
from sklearn_hd._model_step import ModelStep
from sklearn_hd._progress import progress
from sklearn_hd._records.amplitudes import read_for_fit
from sklearn_hd._records.data import beside_trim, check_features, lifted_periods, rows_read
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.periodic.periodic_realization import order_by_residual
from sklearn_hd.algorithms.reporting import stage
from sklearn_hd.algorithms.signals.lifting import input_directions
from sklearn_hd.algorithms.subspace.hankel import n_excited, n_hankel_columns
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.algorithms.subspace.predictor_subspace import PredictorSubspace
from sklearn_hd.algorithms.subspace.projections import (
    Projection,
    order_by_gap,
    order_by_wide_gap,
    release_idle_directions,
)
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning

__all__ = ["MOESPRegressor"]

MOST_STATES = 12  # tried by order="auto", period by period
MOST_LEFT_OUT = 1e-3  # of the inputs' energy within the period


class MOESPRegressor(SubspaceChecks, MoreRows, InnovationModel, ModelStep):
    """Past-output MOESP identification of a linear time-invariant model.

        x[k+1] = A x[k] + B u[k],   y[k] = C x[k] + D u[k]               (Eq. 10)

    On a frame from :class:`HarmonicAnalyzer` the outputs are decomposed with
    the basis that rides on it, and k counts the rows read (every ``hop``-th
    sample); the model is driven by the raw inputs, or by the coefficients of
    whole periods where harmonics other than 0 are kept. On plain data it is
    ordinary subspace identification, sample by sample.

    Parameters
    ----------
    order : int or "auto", default="auto"
        Number of states. ``"auto"`` takes the widest gap between consecutive
        singular values that reaches down to the noise floor; 0, a static gain, on
        plain data too short for any dynamics.
    block_rows : int or None, default=None
        Block rows i of the past, and of the future. None takes twice the rows
        in the analysis window, plus two; 15 on plain data (fewer where the
        record is short); with ``weighting="pbsid"`` up to 60, as far back as the data say
        (Akaike's criterion).
    weighting : {"moesp", "n4sid", "cva", "pbsid"}, default="moesp"
        What of the future outputs is decomposed. ``"moesp"`` and ``"cva"`` (canonical
        correlations: each output counts by its information, whatever its unit) project the
        future inputs out; ``"n4sid"`` is the oblique projection. All three are biased where
        inputs answer to noisy outputs: for data measured in closed loop use ``"pbsid"``
        (predictor-based; on plain data, or ``reading="period"`` where the feedback is of earlier
        periods; with ``feedthrough=True``, of earlier rows).
    feedthrough : bool, default=False
        Whether D is free, else zero. Period by period (``reading="period"``) D
        always is, for inputs act within the period that they belong to.
    disturbance_model : bool, default=False
        Whether the Kalman gain K of the innovation form is identified, for ``predict_ahead``
        (on plain data or ``reading="period"``); with ``weighting="pbsid"`` it always is.

            x[k+1] = A x[k] + B u[k] + K e[k],   y[k] = C x[k] + D u[k] + e[k]
    scale : bool, default=True
        Divide each signal by its root mean square before the projection, so
        that units do not decide what counts as large.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data, and
        never more than a quarter of the segment.
    memory : str, joblib.Memory or None, default=None
        Folder in which lag products of the data are kept: one for all orders and for all
        block rows up to 32, 64 or 128, so that a search over both goes through each of its
        folds once (twice without noise: exactly, too). Up to 64 MB of what a process asked for
        last stay in its memory, and as much of the data, by which it knows them again.
    verbose : int, default=0
        1 shows how far ``partial_fit`` is with a chunk, and ``order="auto"`` with orders
        period by period: a progress bar in terminals and notebooks.

    Attributes
    ----------
    system_ : control.StateSpace
        Discrete-time model with named inputs and outputs.
    order_ : int
    block_rows_ : int
    singular_values_ : ndarray, shape (block_rows * n_outputs,)
        Of the projected future outputs; canonical correlations with ``weighting="cva"``.
    noise_floor_ : float
        Largest singular value that rounding or white noise would give.
    eigenvalues_ : complex ndarray, shape (order,)
        Of A.
    x0_ : ndarray, shape (n_segments, order)
        Initial state of each segment of the data fitted.
    kalman_gain_ : ndarray, shape (order, n_outputs)
        Where identified.
    innovations_covariance_ : ndarray, shape (n_outputs, n_outputs)
        Where the Kalman gain is identified; in the units of the outputs.
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Raises
    ------
    ValueError
        At ``fit``, if the record is too short for the block rows, an input or
        all outputs are constant, the block rows do not exceed the window, or the order
        exceeds the rank that block rows allow.

    Warns
    -----
    ExcitationWarning
        If the inputs excite fewer directions than the block rows ask for, or a
        coefficient of an input never moves (its column of B is zero).
    IdentifiabilityWarning
        If an output rests at a value other than zero.
    FrequencyMismatchWarning
        If the data repeat themselves at another frequency than ``omega``; it
        says at which.
    InstabilityWarning
        If the outputs grow beyond what rounding lets see beside them, or a
        Floquet exponent is positive (``reading="period"``; else
        :class:`SpuriousModeReducer` warns of it).

    References
    ----------
    Verhaegen (1994), Automatica 30(1), 61-74 (PO-MOESP).
    Van Overschee, De Moor (1996), Subspace Identification for Linear Systems (N4SID, CVA).
    Chiuso (2007), Automatica 43(6), 1034-1048 (optimised PBSID).

    Examples
    --------
    >>> import numpy as np
    >>> u = np.random.default_rng(0).standard_normal((300, 1))
    >>> y = np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> model = MOESPRegressor(order="auto", block_rows=5).fit(u, y)
    >>> model.order_, round(float(model.eigenvalues_[0].real), 6)
    (1, 0.8)
    """

    def __init__(
        self,
        order="auto",
        *,
        block_rows=None,
        weighting="moesp",
        feedthrough=False,
        disturbance_model=False,
        scale=True,
        warmup=None,
        memory=None,
        verbose=0,
    ):
        self.order = order
        self.block_rows = block_rows
        self.weighting = weighting
        self.feedthrough = feedthrough
        self.disturbance_model = disturbance_model
        self.scale = scale
        self.warmup = warmup
        self.memory = memory
        self.verbose = verbose

    @one_blas_thread
    @within_range
    def fit(self, X, y):
        """Identify the model.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs, with a harmonic basis riding on them or plain; also as a dask DataFrame,
            partitioned by record or, plain, by time. None, or a DataFrame without columns, to
            identify from outputs alone.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time; of dask's where X is, in the same partitions.

        Returns
        -------
        self : MOESPRegressor
            Fitted.
        """
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        scale, feedthrough = self._check_parameters()
        self.__dict__.pop("_stream", None)  # chunks of a partial_fit before
        if is_partitioned(X) or is_partitioned(y):
            data = Partitions(X, y, self._block_rows_asked)
            model = self._identified(data, data.head[1], scale, feedthrough)
            return self._remember(model, data.facts, *data.head)
        experiment = read_for_fit(X, y)
        warn_of_mismatch(experiment)
        warn_of_growing_data(experiment)
        inputs, outputs = rows_read(experiment)
        facts, excitation = Facts.of(experiment, inputs), self._excitation(experiment, inputs)
        data = Records(inputs, outputs, facts, self.memory, excitation)
        model = self._identified(data, y, scale, feedthrough, experiment)
        if is_lifted(experiment):  # else the window's own poles may grow
            warn_of_growth(model, experiment)
        return self._remember(model, experiment, X, y)

    def _identified(self, data, y, scale, feedthrough, experiment=None):
        """The model of data, wherever they are; ``experiment`` where they are in memory."""
        facts, lengths = data.facts, data.lengths
        n_inputs, n_outputs = data.n_inputs, data.n_outputs
        self.block_rows_ = self._check_block_rows(facts, lengths, n_inputs, n_outputs)
        check_motion(facts)
        if n_hankel_columns(lengths, self.block_rows_) <= self.block_rows_ * n_inputs:
            return self._static_model(facts, y, experiment)
        size, scales = data.scales(scale)
        lifted = is_lifted(facts)
        if self.weighting == PREDICTOR and self.block_rows is None:
            self.block_rows_ = self._rows_of_predictor(
                lambda rows: data.factor(rows, size),
                lengths,
                n_inputs,
                n_outputs,
                lifted,
            )
        found = self._decompose(data, size, experiment)
        while self._wants_more_rows(facts, data):
            self.block_rows_ += (self.block_rows_ + 1) // 2
            found = self._decompose(data, size, experiment)
        free = self.block_rows is None and self.order == "auto"
        if free and experiment is not None and is_sliding(experiment):
            found = self._exact_map(data, found, experiment, size)
        feedthrough = feedthrough or lifted
        if self.weighting == PREDICTOR:
            parts = self._predictor_matrices(found, data, size, scales)
        else:
            A, C = found.state_matrices(self.order_)
            B, D, self.x0_ = data.input_matrices(A, C, feedthrough, scales)
            parts = A, B, C, D, *self._noise_model(found)
        return self._model(parts, scales, facts, y, feedthrough)

    @one_blas_thread
    @within_range
    def partial_fit(self, X, y):
        """Identify the model from all chunks so far and this one.

        Chunks are consecutive rows of a record, in order, or whole records. What they leave
        behind are sums; memory does not grow with the rows of a record (it does by some
        thousand rows with each record). The model is that of ``fit`` on all rows with the same
        ``order`` and ``block_rows``, but that a sliding window's block rows stay where they
        began; ``fit`` forgets all chunks.

        Where a mode outlasts some thousand rows, and a record is longer, B and D come from the
        triangular factor alone, and are less certain than those of ``fit``.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs (None where there are none), with a harmonic basis riding on them (from
            ``HarmonicAnalyzer.transform``; not period by period) or plain. Rows whose index
            counts from 0 go on where the last chunk ended; others follow it by one sample
            time, or a gap lies between.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time.

        Returns
        -------
        self : MOESPRegressor
            With the model of everything so far, once there are rows enough.

        Raises
        ------
        ValueError
            If a chunk has other columns, another sample time or basis than the first, or
            begins before the end of the last. What was read before is kept.

        Warns
        -----
        ExcitationWarning
            If an input, or all outputs, have not moved so far: there is no model yet.
        IdentifiabilityWarning
            If all chunks so far have no model of this order. They are kept, this one too, and so
            is the model before.

        References
        ----------
        Verhaegen (1994), Automatica 30(1), 61-74 (B and D from the factor).

        Examples
        --------
        >>> from sklearn_hd import MOESPRegressor
        >>> u = np.random.default_rng(0).standard_normal((900, 1))
        >>> y = np.zeros((900, 1))
        >>> for k in range(899):
        ...     y[k + 1] = 0.8 * y[k] + u[k]
        >>> model = MOESPRegressor(order=1, block_rows=5)
        >>> for rows in np.split(np.arange(900), 3):
        ...     model = model.partial_fit(u[rows], y[rows])
        >>> round(float(model.eigenvalues_[0].real), 6)
        0.8
        """
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        scale, feedthrough = self._check_parameters()
        stream = getattr(self, "_stream", None)
        origin = first_date(X) if stream is None else stream.origin
        experiment = read_chunk(X, y, origin)
        check_features(self, X, reset=stream is None)
        asked = self._block_rows_asked(experiment.basis)
        if self.weighting == PREDICTOR and self.block_rows is None:
            asked = MOST_PREDICTOR_ROWS  # some of which are chosen once more data are there
        self._check_rank_bound(asked, len(self._output_names(experiment.basis, y)))
        if stream is None:
            stream = Stream.begin(experiment, asked, origin)
        elif asked > stream.block_rows:
            raise ValueError(
                f"block_rows={asked} asks for more than the {stream.block_rows} that the first "
                f"chunk was read with; begin anew with a clone of the estimator"
            )
        result = copy.copy(self)
        result._stream = stream.with_chunk(experiment)
        data = result._stream.data()
        if self._suffices(data):
            try:
                model = result._identified(data, y, scale, feedthrough)
            except ValueError as error:  # which rows to come may mend
                warn(f"no model of the {data.facts.span()}: {error}", IdentifiabilityWarning)
                self._stream = result._stream
                return self
            result._remember(model, experiment, X, y)
        self.__dict__.update(result.__dict__)  # at once: an interrupted call changes nothing
        return self

    def _suffices(self, data):
        """Whether chunks so far allow for a model; what is at rest is told."""
        facts, n_inputs, n_outputs = data.facts, data.n_inputs, data.n_outputs
        if facts.still or not facts.outputs_move.any():
            what = f"the inputs {list(facts.still)} are" if facts.still else "all outputs are"
            warn(
                f"{what} at rest in the {facts.span()}: there is no model until a chunk comes in "
                f"which they move",
                ExcitationWarning,
            )
            return False
        asked = self._block_rows_asked(facts.basis)
        i = self._fewer_block_rows(asked, facts.basis, data.lengths, n_inputs, n_outputs)
        order = 1 if self.order == "auto" else int(self.order)
        enough = n_hankel_columns(data.lengths, i) >= i * (n_inputs + n_outputs) + order
        return enough and order <= (i - 1) * n_outputs

    def _predictor_matrices(self, found, data, size, scales):
        """The innovation form, driven by the inputs where they are not what excites.

        Period by period: as the mean input stands for what moves within the period.
        """
        A, B, C, D, K, covariance = found.model(self.order_)
        own = size[: data.n_inputs], scales[1]
        self.x0_ = data.initial_states(A, B, C, D, K, covariance, own)
        if not data.raw:
            u = np.vstack(data.inputs)
            offset = np.ones((len(u), 1))  # of the trim, which is no input
            share = linalg.lstsq(np.hstack([u / scales[0], offset]), np.vstack(data.excitation))[0]
            B, D = (M @ share[:-1].T for M in (B, D))
        return A, B, C, D, K, covariance

    def _noise_model(self, found):
        """Kalman gain and covariance of the innovations; None where they were not asked for."""
        return found.kalman_gain(self.order_) if self.disturbance_model else (None, None)

    def _model(self, parts, scales, facts, y, feedthrough):
        """The model in the units of the signals."""
        (A, B, C, D, K, covariance), (u_scale, y_scale) = parts, scales
        basis = facts.basis
        if K is not None:
            K, covariance = K / y_scale, covariance * y_scale[:, None] * y_scale
        return LTIModel(
            A=A,
            B=B / u_scale,
            C=C * y_scale[:, None],
            D=D * (y_scale[:, None] / u_scale),
            dt=facts.sample_time * basis.hop,
            input_names=facts.drive_names,
            output_names=self._output_names(basis, y),
            feedthrough=feedthrough,
            windowed=basis.harmonic,
            kalman_gain=K,
            innovations_covariance=covariance,
            closed_loop=self.weighting == PREDICTOR,
        )

    def _excitation(self, experiment, inputs):
        """What is projected out of the future: the inputs, as they move within each period.

        Period by period the outputs answer to every sample of the inputs, whatever
        harmonics of them are kept. Through a sliding window they answer at each phase in
        another way, which matters where inputs change at more than one.
        """
        if not is_lifted(experiment):
            modulated = None
            if is_sliding(experiment):
                modulated = modulated_inputs(experiment, [len(u) for u in inputs])
            return inputs if modulated is None else modulated
        lifted = lifted_periods(experiment, experiment.inputs)
        rows = 2 if self.block_rows is None else self.block_rows
        states = 1 if self.order == "auto" else self.order
        lengths = [len(u) for u in lifted]
        most = max(1, (n_hankel_columns(lengths, rows) - 1 - states) // rows)
        directions, n_all, left_out = input_directions(lifted, most)
        if n_all > most:
            need = rows * n_all + 1 + states + 2 * rows - 1
            words = (
                f"the inputs in the {experiment.span()} move in {n_all} directions within the "
                f"period, of which {sum(lengths)} periods tell {most} apart at block_rows={rows}: "
                f"{left_out:.2g} of their energy is taken for noise; {need} consecutive periods "
                f"would do"
            )
            if left_out > MOST_LEFT_OUT:
                raise ValueError(
                    f"{words}; use a longer record, inputs that change less often, or analyse "
                    f"with reading='sliding' and refine with StructuredMatcher(structure="
                    f"HarmonicStructure(), criterion='output_error')"
                )
            warn(words, ExcitationWarning)
        return beside_trim(directions, experiment.basis)

    def _decompose(self, data, scale, experiment):
        """Project the future outputs, look at the singular values and settle the order."""
        i, facts = self.block_rows_, data.facts
        columns = n_hankel_columns(data.lengths, i)
        choices = i, self.weighting, bool(self.feedthrough), is_lifted(facts)
        projected = data.projection(
            lambda: self._project(data.factor(i, scale), columns, data),
            scale,
            *choices,
        )
        n_moving = int(facts.moving.sum()) if data.raw else data.n_inputs
        found = self._look_at(*projected, n_moving, facts, scale[data.n_inputs :])
        self.order_ = self._choose_order(found, data, experiment)
        return found

    def _project(self, R, n_columns, data):
        """What the future outputs share with the past, and the directions that inputs excite.

        Not counted period by period, where a step in mid-period moves in a direction that
        occurs but once, and what cannot be told apart is projected out as a whole; nor
        where inputs are multiplied by harmonics, whose idle directions are released.
        """
        i, lifted, n_inputs = self.block_rows_, is_lifted(data.facts), data.n_inputs
        excited = None
        if not lifted and data.raw:
            excited = n_excited(R, i, n_inputs)
        if self.weighting == PREDICTOR:
            feedthrough = bool(self.feedthrough) or lifted
            return PredictorSubspace.of(R, i, n_inputs, n_columns, feedthrough), excited
        if not lifted and n_inputs > 0:
            R = release_idle_directions(R, i * n_inputs)
        return Projection.of(R, i, n_inputs, n_columns, self.weighting), excited

    def _look_at(self, found, excited, n_moving, facts, y_scale):
        """Keep the singular values, and warn of Hankel matrices of deficient rank."""
        self._warn_excitation(excited, n_moving, facts)
        unit = 1.0  # of canonical correlations
        if self.weighting != "cva":
            unit = y_scale.max() * np.sqrt(np.mean((y_scale / y_scale.max()) ** 2))
        self.singular_values_ = found.singular_values * unit
        self.noise_floor_ = found.floor * unit
        return found

    def _choose_order(self, found, data, experiment):
        """The order asked for, or that of the singular values, or of the raw periods."""
        bound = (self.block_rows_ - 1) * data.n_outputs
        if self.order != "auto":
            return int(self.order)
        values, floor = found.singular_values, found.floor
        by_gap = order_by_gap(values, floor, bound)
        if not is_lifted(data.facts) or order_by_wide_gap(values, floor, bound) is not None:
            return by_gap
        if self.weighting == PREDICTOR:  # raw periods would be simulated, as in open loop
            return by_gap
        lifted = lifted_periods(experiment, experiment.outputs, output_scale(experiment))
        lifted = [y.reshape(len(y), -1) for y in lifted]
        # half as many as the periods left once the inputs' directions are projected out
        directions = data.excitation
        left = sum(map(len, lifted)) - directions[0].shape[1]
        most = min(bound, MOST_STATES, left // 2)
        if most < 1:
            return by_gap
        candidates = [found.state_matrices(n + 1)[0] for n in range(most)]
        with progress(self.verbose) as report:
            told = stage(report, "orders tried", most)
            return len(order_by_residual(candidates, directions, lifted, told))

    def _static_model(self, facts, y, experiment):
        """Gain without states, all that a record too short for any dynamics gives."""
        if experiment is None:
            raise ValueError(
                f"the {facts.span()} are too few to identify dynamics from "
                f"{len(facts.drive_names)} input(s); give frames in memory, X.compute() and "
                f"y.compute(), from which a static gain is fitted"
            )
        inputs, outputs = experiment.drive, experiment.outputs
        n_outputs = outputs[0].shape[1]
        warn(
            f"the {experiment.span()} are too few to identify dynamics from "
            f"{inputs[0].shape[1]} input(s): a static gain is fitted; use a longer record",
            ExcitationWarning,
        )
        self.singular_values_, self.noise_floor_, self.order_ = np.zeros(0), 0.0, 0
        A, C = np.zeros((0, 0)), np.zeros((n_outputs, 0))
        B, D, self.x0_ = input_matrices(A, C, inputs, outputs, True)
        left = np.vstack(outputs) - np.vstack(inputs) @ D.T
        noise = {}
        if self.disturbance_model or self.weighting == PREDICTOR:
            noise["kalman_gain"] = np.zeros((0, n_outputs))
            noise["innovations_covariance"] = left.T @ left / len(left)
        return LTIModel(
            A=A,
            B=B,
            C=C,
            D=D,
            dt=experiment.base.sample_time,
            input_names=experiment.drive_names,
            output_names=experiment.basis.output_labels,
            feedthrough=True,
            **noise,
        )

    @property
    def eigenvalues_(self):
        """Eigenvalues of the discrete A."""
        check_is_fitted(self)
        return np.linalg.eigvals(self.model_.A)

    @staticmethod
    def _output_names(basis, y):
        return basis.output_labels or signal_names(as_container(y, "y"), "y")
