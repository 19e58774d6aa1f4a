"""Step 3: subspace identification of a discrete-time state-space model."""

import numpy as np
from scipy import linalg
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import extremes, square_sums, within_range
from sklearn_hd._checks import COMMON, check_outputs_given, signal_names
from sklearn_hd._containers import as_container, without_inputs
from sklearn_hd._continuous import output_scale
from sklearn_hd._fit_checks import (
    check_outputs_move,
    moving_inputs,
    warn_idle,
    warn_of_growing_data,
    warn_of_growth,
    warn_of_mismatch,
)
from sklearn_hd._frame import LTIModel
from sklearn_hd._identify.checks import PREDICTOR, SubspaceChecks, is_lifted
from sklearn_hd._identify.innovation_model import InnovationModel
from sklearn_hd._identify.modulation import modulated_inputs
from sklearn_hd._identify.more_rows import MoreRows, is_sliding
from sklearn_hd._identify.partitioned_fit import PartitionedFit
from sklearn_hd._identify.partitions import is_partitioned
from sklearn_hd._identify.products_cache import KeptSums
from sklearn_hd._identify.streamed_fit import StreamedFit
from sklearn_hd._model_step import ModelStep
from sklearn_hd._progress import progress
from sklearn_hd._records.amplitudes import read_for_fit
from sklearn_hd._records.data import beside_trim, lifted_periods, rows_read
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.periodic.periodic_realization import order_by_residual
from sklearn_hd.algorithms.reporting import stage
from sklearn_hd.algorithms.signals.lifting import input_directions
from sklearn_hd.algorithms.subspace.hankel import n_excited, n_hankel_columns
from sklearn_hd.algorithms.subspace.innovations import InnovationForm
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.algorithms.subspace.moesp import (
    order_by_gap,
    order_by_wide_gap,
    release_idle_directions,
)
from sklearn_hd.algorithms.subspace.predictor_subspace import PredictorSubspace
from sklearn_hd.algorithms.subspace.projections import Projection
from sklearn_hd.exceptions import ExcitationWarning

__all__ = ["MOESPRegressor"]

MOST_STATES = 12  # tried by order="auto", period by period
MOST_LEFT_OUT = 1e-3  # of the inputs' energy within the period


class MOESPRegressor(
    SubspaceChecks, MoreRows, StreamedFit, PartitionedFit, InnovationModel, ModelStep
):
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
            return self._fit_partitions(X, y, scale, feedthrough)
        experiment = read_for_fit(X, y)
        warn_of_mismatch(experiment)
        warn_of_growing_data(experiment)
        inputs, outputs = rows_read(experiment)
        excitation = self._excitation(experiment, inputs)
        raw = excitation is inputs
        n_outputs, n_inputs = outputs[0].shape[1], excitation[0].shape[1]
        lengths = [len(u) for u in inputs]
        self.block_rows_ = self._check_block_rows(experiment, lengths, n_inputs, n_outputs)
        moving = moving_inputs(inputs, experiment)
        check_outputs_move(experiment)
        warn_idle(moving, experiment)
        if n_hankel_columns(lengths, self.block_rows_) <= self.block_rows_ * n_inputs:
            return self._remember(self._static_model(experiment, y), experiment, X, y)
        u_scale, y_scale = (
            _scales(signals) if scale else np.ones(signals[0].shape[1])
            for signals in (inputs, outputs)
        )
        scale = np.concatenate([u_scale if raw else np.ones(n_inputs), y_scale])
        n_moving, kept = int(moving.sum()) if raw else n_inputs, KeptSums(self.memory)
        if self.weighting == PREDICTOR and self.block_rows is None:
            self.block_rows_ = self._rows_of_predictor(
                lambda rows: kept.factor(excitation, outputs, rows, scale),
                lengths,
                n_inputs,
                n_outputs,
                is_lifted(experiment),
            )
        found = self._decompose(kept, excitation, outputs, n_moving, experiment, scale)
        while self._wants_more_rows(experiment, lengths, excitation[0].shape[1], n_outputs):
            self.block_rows_ += (self.block_rows_ + 1) // 2
            found = self._decompose(kept, excitation, outputs, n_moving, experiment, scale)
        if self.block_rows is None and self.order == "auto" and is_sliding(experiment):
            found = self._exact_map(kept, found, experiment, excitation, outputs, scale)
        scales = u_scale, y_scale
        feedthrough = feedthrough or is_lifted(experiment)
        if self.weighting == PREDICTOR:
            parts = self._predictor_matrices(found, excitation, inputs, outputs, scales)
        else:
            A, C = found.state_matrices(self.order_)
            B, D, self.x0_ = kept.input_matrices(A, C, inputs, outputs, feedthrough, scales)
            parts = A, B, C, D, *self._noise_model(found)
        dt = experiment.base.sample_time
        model = self._model(parts, scales, experiment, dt, y, feedthrough)
        if is_lifted(experiment):  # else the window's own poles may grow
            warn_of_growth(model, experiment)
        return self._remember(model, experiment, X, y)

    def _predictor_matrices(self, found, excitation, inputs, outputs, scales):
        """The innovation form, driven by the inputs where they are not what excites.

        Period by period: as the mean input stands for what moves within the period.
        """
        A, B, C, D, K, covariance = found.model(self.order_)
        form = InnovationForm(A, B, C, D, K)
        u_scale, y_scale = scales
        raw = excitation is inputs
        size = u_scale if raw else 1.0
        pairs = zip(excitation, outputs, strict=True)
        self.x0_ = np.array(
            [form.initial_state(u / size, y / y_scale, covariance) for u, y in pairs]
        )
        if not raw:
            u = np.vstack(inputs)
            offset = np.ones((len(u), 1))  # of the trim, which is no input
            share = linalg.lstsq(np.hstack([u / u_scale, offset]), np.vstack(excitation))[0]
            B, D = (M @ share[:-1].T for M in (B, D))
        return A, B, C, D, K, covariance

    def _noise_model(self, found):
        """Kalman gain and covariance of the innovations; None where they were not asked for."""
        return found.kalman_gain(self.order_) if self.disturbance_model else (None, None)

    def _model(self, parts, scales, experiment, sample_time, y, feedthrough):
        """The model in the units of the signals."""
        (A, B, C, D, K, covariance), (u_scale, y_scale) = parts, scales
        basis = experiment.basis
        if K is not None:
            K, covariance = K / y_scale, covariance * y_scale[:, None] * y_scale
        return LTIModel(
            A=A,
            B=B / u_scale,
            C=C * y_scale[:, None],
            D=D * (y_scale[:, None] / u_scale),
            dt=sample_time * basis.hop,
            input_names=experiment.drive_names,
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

    def _decompose(self, kept, inputs, outputs, n_moving, experiment, scale):
        """Project the future outputs, look at the singular values and settle the order."""
        i, n_inputs, n_outputs = self.block_rows_, inputs[0].shape[1], outputs[0].shape[1]
        columns = n_hankel_columns([len(u) for u in inputs], i)
        choices = i, self.weighting, bool(self.feedthrough), is_lifted(experiment)
        projected = kept.projection(
            inputs,
            outputs,
            scale,
            lambda: self._project(
                kept.factor(inputs, outputs, i, scale), columns, n_outputs, experiment
            ),
            *choices,
        )
        found = self._look_at(*projected, n_moving, experiment, scale[n_inputs:])
        self.order_ = self._choose_order(found, inputs, experiment, n_outputs)
        return found

    def _project(self, R, n_columns, n_outputs, experiment):
        """What the future outputs share with the past, and the directions that inputs excite.

        Not counted period by period, where a step in mid-period moves in a direction that
        occurs but once, and what cannot be told apart is projected out as a whole; nor
        where inputs are multiplied by harmonics, whose idle directions are released.
        """
        i, lifted = self.block_rows_, is_lifted(experiment)
        n_inputs, excited = len(R) // (2 * i) - n_outputs, None
        if not lifted and n_inputs == len(experiment.drive_names):
            excited = n_excited(R, i, n_inputs)
        if self.weighting == PREDICTOR:
            feedthrough = bool(self.feedthrough) or lifted
            return PredictorSubspace.of(R, i, n_inputs, n_columns, feedthrough), excited
        if not lifted and n_inputs > 0:
            R = release_idle_directions(R, i * n_inputs)
        return Projection.of(R, i, n_inputs, n_columns, self.weighting), excited

    def _look_at(self, found, excited, n_moving, experiment, y_scale):
        """Keep the singular values, and warn of Hankel matrices of deficient rank."""
        self._warn_excitation(excited, n_moving, experiment)
        unit = 1.0  # of canonical correlations
        if self.weighting != "cva":
            unit = y_scale.max() * np.sqrt(np.mean((y_scale / y_scale.max()) ** 2))
        self.singular_values_ = found.singular_values * unit
        self.noise_floor_ = found.floor * unit
        return found

    def _choose_order(self, found, directions, experiment, n_outputs):
        """The order asked for, or that of the singular values, or of the raw periods."""
        bound = (self.block_rows_ - 1) * n_outputs
        if self.order != "auto":
            return int(self.order)
        values, floor = found.singular_values, found.floor
        by_gap = order_by_gap(values, floor, bound)
        if not is_lifted(experiment) or order_by_wide_gap(values, floor, bound) is not None:
            return by_gap
        if self.weighting == PREDICTOR:  # raw periods would be simulated, as in open loop
            return by_gap
        lifted = lifted_periods(experiment, experiment.outputs, output_scale(experiment))
        lifted = [y.reshape(len(y), -1) for y in lifted]
        # half as many as the periods left once the inputs' directions are projected out
        left = sum(map(len, lifted)) - directions[0].shape[1]
        most = min(bound, MOST_STATES, left // 2)
        if most < 1:
            return by_gap
        candidates = [found.state_matrices(n + 1)[0] for n in range(most)]
        with progress(self.verbose) as report:
            told = stage(report, "orders tried", most)
            return len(order_by_residual(candidates, directions, lifted, told))

    def _static_model(self, experiment, y):
        """Gain without states, all that a record too short for any dynamics gives."""
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


def _scales(signals):
    """Root mean square of each channel over all segments; one where a channel is zero."""
    n_samples = sum(map(len, signals))
    squares = sum(map(square_sums, signals))
    if np.all((squares > 1.0 / COMMON) & (squares < COMMON)):
        return np.sqrt(squares / n_samples)
    scale = np.ones(signals[0].shape[1])
    for c, largest in enumerate(np.max(np.abs([extremes(z) for z in signals]), axis=(0, 1))):
        if largest > 0.0:
            squares = (np.sum((z[:, c] / largest) ** 2) for z in signals)
            scale[c] = largest * np.sqrt(sum(squares) / n_samples)
    return scale
