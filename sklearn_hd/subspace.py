"""Step 3: subspace identification of a discrete-time state-space model."""

from collections.abc import Mapping
from dataclasses import fields

import numpy as np
import pandas as pd
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import check_outputs_given
from sklearn_hd._containers import is_partitioned, without_inputs
from sklearn_hd._frame import SampleModel
from sklearn_hd._guards import one_blas_thread, within_range
from sklearn_hd._identify import (
    PREDICTOR,
    Settings,
    checked,
    identify,
    identify_frame,
    most_block_rows,
)
from sklearn_hd._identify.chunks import model_so_far, read_chunk, with_chunk
from sklearn_hd._identify.partitions import Partitions
from sklearn_hd._model_step import ModelStep
from sklearn_hd._records.data import check_features
from sklearn_hd.algorithms.signals.fourier import harmonic_labels

__all__ = ["MOESPRegressor"]


class MOESPRegressor(ModelStep):
    """Subspace identification of a discrete state-space model: past-output MOESP, and others.

        x[k+1] = A x[k] + B u[k],   y[k] = C x[k] + D u[k]               (Eq. 10)

    On a frame from :class:`HarmonicAnalyzer` the outputs are decomposed with the basis that the
    frame carries, and k counts the analysed rows (every ``hop``-th sample). The raw inputs drive
    the model, or the coefficients of whole periods if harmonics other than 0 are kept. On plain
    data it is ordinary subspace identification, sample by sample.

    Behind ``HarmonicAnalyzer(reading="sample")`` the model is a periodic innovations model,

        x[k+1] = A(ψ_k) x[k] + B(ψ_k) u[k] + a(ψ_k) + K(ψ_k) e[k]
        y[k] = C(ψ_k) x[k] + D(ψ_k) u[k] + c(ψ_k) + e[k]

    It is found from a predictor of each row by the rows before it (ridge regression), and from
    there by a few steps of the likelihood of one-step predictions; a and c drive the forced
    periodic response.

    Behind ``HarmonicAnalyzer(reading="auto")`` the estimator may change the reading. If inputs
    rest, it identifies whole periods first. If something speaks against that model, or one of its
    exponents may be off by more than 5 % of its rate, it also identifies the samples, and keeps
    the surer model (of two that nothing speaks against, the samples only if they know their
    exponents to 5 %). In a search, or if ``block_rows`` is given, it tries the samples only if the
    first reading raises an error. ``basis_.reading`` says which reading was kept.

    Parameters
    ----------
    order : int or "auto", default="auto"
        Number of states. ``"auto"`` takes a gap of decades between singular values, if there is
        one, as exact data have it. For plain data in memory without such a gap, it simulates
        models of rising order over the record and takes the smallest Bayesian information
        criterion of the residuals (``order_search_``). A model that grows e-fold over the longest
        segment must halve the variance left by the best other one, beyond the gain of its order.
        Among models whose residuals agree to a hundredth of that variance, the smallest is taken.
        Other data (frames of an analyzer, chunks, dask, outputs alone) use the widest gap that
        reaches down to the noise floor. Plain data too short for any dynamics give 0, a static
        gain. For samples at their azimuths, orders and numbers of harmonics are simulated in the
        same way. If something speaks against the model chosen, it is truncated by the modes that
        it does not need. If something still does, or a turn forgets one of its modes, simpler
        models take the same steps of the likelihood: up to three with fewer states, the smallest
        first, then one with as many and fewer harmonics. The first is kept that nothing speaks
        against, and that leaves about as little, or less than a hundredth of the motion's variance
        and has no mode that the other has not. If there is none and the model is in doubt, the
        criterion after these steps chooses between it and those that leave noise (and have
        products, if it has any). Where products of states pay (``nonlinear_degrees_``), simpler
        models are compared by their predictions beside these. A search leaves this out.
    block_rows : int or None, default=None
        Block rows i of the past, and of the future. None takes twice the rows in the analysis
        window, plus two; 15 on plain data (fewer if the record is short); up to 60 with
        ``weighting="pbsid"``, chosen by Akaike's criterion. With ``reading="sample"`` it is the
        number of past rows that the predictor uses, chosen in the same way; where inputs are so
        smooth that earlier rows predict them, two and three times as many are tried, too.
    weighting : {"moesp", "n4sid", "cva", "pbsid"}, default="moesp"
        Projection of the future outputs that is decomposed. ``"moesp"`` and ``"cva"`` (canonical
        correlations: each output counts by its information, whatever its unit) project the future
        inputs out; ``"n4sid"`` is the oblique projection. All three are biased if inputs react to
        noisy outputs: for data measured in closed loop use ``"pbsid"`` (predictor-based). It needs
        plain data, or ``reading="period"`` with feedback from earlier periods; with
        ``feedthrough=True``, feedback from earlier rows. ``reading="sample"`` is always
        predictor-based and refuses ``"n4sid"`` and ``"cva"``; there ``"pbsid"`` only sets D to
        zero.
    feedthrough : bool or "auto", default="auto"
        Whether D is free; otherwise it is zero. For plain data in memory ``"auto"`` simulates
        both, and D is free if that lowers the criterion, and the residuals by a hundredth. For
        chunks and dask, D is free if the inputs explain a part of the outputs of their own row
        that earlier rows do not explain. ``feedthrough_reason_`` has the figures. With
        ``weighting="pbsid"``, ``"auto"`` is zero, because a feedback within the row looks the
        same; a warning says so. Through a sliding window D is zero. With ``reading="period"`` D is
        always free, because inputs act within their period. For samples at their azimuths D is
        free if that lowers the predictor's Bayesian information criterion. Where inputs are so
        smooth that earlier rows predict them, this criterion cannot tell D. Models with D = 0 and
        with D free are then simulated, and the best is kept: that of the fewest states where all
        leave but noise.
    disturbance_model : bool, default=False
        Whether the Kalman gain K of the innovation form is identified, for ``predict_ahead`` (on
        plain data or ``reading="period"``). With ``weighting="pbsid"`` and ``reading="sample"`` it
        is always identified.

            x[k+1] = A x[k] + B u[k] + K e[k],   y[k] = C x[k] + D u[k] + e[k]
    stable : bool, default=False
        Whether A is replaced by the nearest stable matrix, where each state counts by how much the
        outputs see of it: unstable eigenvalues are mirrored at the unit circle, λ → 1/λ̄, and the
        others stay. B, D and K are fitted to that A. With ``reading="sample"`` only stable models
        are compared; a ValueError reports if there is none. There, a model in doubt that grows as
        no record in open loop does gives way to a stable one in any case, with a warning.
    scale : bool, default=True
        Divide each signal by its root mean square before the projection, so that units do not
        decide what counts as large. With one output nothing changes. With several, the outputs get
        other weights, and eigenvalues move within the limits of noise and nonlinearity. With
        ``reading="sample"`` signals are always scaled, by their motion about the periodic mean.
    input_delay, output_delay : float, dict or "auto", default=0.0
        Delays in seconds, whole samples or not: from the command of an input to its effect on the
        machine, and from the motion of an output to its measurement. A dict gives delays to some
        signals; the others have none. ``"auto"`` (for all, or in a dict) searches whole samples,
        at most 50 or half a period, and for plain data refines them by the likelihood. Other
        models are refined in ``StructuredMatcher(criterion="output_error")``. The data show only
        sums of an input's and an output's delay: with both ``"auto"`` the first output has none.
        Models use the machine's own time; ``predict`` adds the delays.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data, and
        never more than a quarter of the segment.
    memory : str, joblib.Memory or None, default=None
        Folder in which lag products of the data are kept. One file serves all orders and all block
        rows up to 32, 64 or 128, so a search over both reads each of its folds once (twice for
        data without noise). A process also keeps up to 64 MB of the products it used last, and as
        much of the data, by which it recognises them. Reading these files can run code: give only
        folders to which nobody else writes. Not for ``reading="sample"``.
    half_life : float or None, default=None
        For ``partial_fit`` only: the age at which a row weighs half as much as the newest one, so
        that the model follows a machine that changes. The unit is periods behind a
        :class:`HarmonicAnalyzer`, and seconds on plain data (samples, without times). Rows count;
        gaps between them do not. None forgets nothing.

    Attributes
    ----------
    basis_ : HarmonicBasis or PlainReading
        How the outputs were read. ``basis_.reading`` is the reading of the model that was kept;
        ``"plain"`` without an analyzer.
    system_ : control.StateSpace
        Discrete-time model with named inputs and outputs. With ``reading="sample"`` it exists if
        no coefficient varies, and does not include the forced response.
    ltp_ : LTPSystem
        With ``reading="sample"``: the continuous linear time-periodic system behind the samples.
    loads_ : DataFrame, shape (2 L + 1, n_outputs)
        With ``reading="sample"``: Fourier coefficients of the outputs' forced periodic response.
    n_harmonics_ : int
        With ``reading="sample"``: highest harmonic of A, B, C, D and K.
    order_ : int
    block_rows_ : int
    singular_values_ : ndarray, shape (block_rows * n_outputs,)
        Singular values of the projected future outputs; canonical correlations with
        ``weighting="cva"``.
    noise_floor_ : float
        Largest singular value that rounding or white noise would give.
    eigenvalues_ : complex ndarray, shape (order,)
        Eigenvalues of A; Floquet multipliers over one turn if A varies with the azimuth.
    x0_ : ndarray, shape (n_segments, order)
        Initial state of each segment of the fitted data; NaN if a half-life has forgotten it.
    n_effective_rows_ : float
        After ``partial_fit``: rows read so far. With a half-life it is (Σw)² / Σw² of their
        weights w: the number of equally weighted rows with the same information.
    feedthrough_ : bool
        Whether D is free.
    feedthrough_reason_ : str
        Reason for that choice, with the figures that decided.
    order_search_ : dict of ndarray, shape (n_simulated,)
        Of each simulated model: ``order``, ``feedthrough``, ``stable`` (no mode grows e-fold),
        ``share`` of the outputs that is left (root mean square), ``variance`` left (geometric mean
        over outputs), ``bic``, ``n_harmonics``. Empty if none was simulated.
    nonlinear_degrees_ : tuple of int
        With ``reading="sample"``: degrees of products of states and inputs that were further
        inputs of the fit, because a linear model alone leaves more (Akaike's criterion). The model
        is that of small motions then, about the orbit with each input at zero (at its periodic
        mean, if that is larger than its motion), and its score on a record of large ones is
        lower. Empty if a linear model holds.
    kalman_gain_ : ndarray, shape (order, n_outputs)
        K, if identified; Fourier coefficients, shape (2 H + 1, order, n_outputs), if it varies.
    innovations_covariance_ : ndarray, shape (n_outputs, n_outputs)
        Exists if the Kalman gain is identified; in the units of the outputs.
    delays_, delay_std_ : Series
        Delay of each input and output in seconds, and its standard deviation; NaN if it was given,
        or found in whole samples.
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Raises
    ------
    ValueError
        At ``fit``, if the record is too short for the block rows; if an input or all outputs are
        constant; if the block rows do not exceed the window; if the order exceeds the rank that
        the block rows allow; if a delay is negative, not finite, longer than the record or names
        no signal.

    Warns
    -----
    CacheWarning
        If files in the folder ``memory`` are not what was stored; they are computed anew.
    ExcitationWarning
        If the inputs excite fewer directions than the block rows need, or a coefficient of an
        input never moves (its column of B is zero).
    IdentifiabilityWarning
        If inputs never move separately (the warning names them); if an output rests at a value
        other than zero; if records begin with outputs at rest at zero and inputs at rest
        elsewhere; if, with ``weighting="pbsid"``, there is a feedthrough or a feedback within the
        row, and D is zero; if, with ``reading="sample"``, the record is short, nothing is
        explained, or the residuals of predictions are not noise.
    FrequencyMismatchWarning
        If the data repeat themselves at another frequency than ``omega``; the warning names it.
    InstabilityWarning
        If the model of plain data grows e-fold over the longest segment (no warning for candidates
        of a search); if the outputs grow so much that rounding hides the other modes; if a Floquet
        exponent is positive (``reading="period"``; through a sliding window
        :class:`SpuriousModeReducer` gives the warning).

    References
    ----------
    Verhaegen (1994), Automatica 30(1), 61-74 (PO-MOESP).
    Van Overschee, De Moor (1996), Subspace Identification for Linear Systems (N4SID, CVA).
    Chiuso (2007), Automatica 43(6), 1034-1048 (optimised PBSID).
    van Wingerden, Verhaegen (2009), Automatica 45(2), 372-381 (predictors of varying systems).
    Golub, Heath, Wahba (1979), Technometrics 21(2), 215-223 (generalised cross-validation).
    Schwarz (1978), Annals of Statistics 6(2), 461-464 (Bayesian information criterion).
    Jongeneel, Sutter, Kuhn (2023), IEEE Transactions on Automatic Control 68(5), 2790-2804
    (the nearest stable matrix).

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
        feedthrough="auto",
        disturbance_model=False,
        stable=False,
        scale=True,
        input_delay=0.0,
        output_delay=0.0,
        warmup=None,
        memory=None,
        half_life=None,
    ):
        self.order = order
        self.block_rows = block_rows
        self.weighting = weighting
        self.feedthrough = feedthrough
        self.disturbance_model = disturbance_model
        self.stable = stable
        self.scale = scale
        self.input_delay = input_delay
        self.output_delay = output_delay
        self.warmup = warmup
        self.memory = memory
        self.half_life = half_life

    @one_blas_thread
    @within_range
    def fit(self, X, y):
        """Identify the model.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs, plain or as a frame that carries a harmonic basis; also a dask DataFrame,
            partitioned by record or, if plain, by time. None, or a DataFrame without columns, to
            identify from outputs alone.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time; a dask collection in the same partitions if X is one.

        Returns
        -------
        self : MOESPRegressor
            Fitted.
        """
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        settings = self._settings()
        if settings.half_life not in (None, np.inf):
            raise ValueError(
                f"half_life={settings.half_life} is only for partial_fit, and fit weights all rows "
                f"equally; call partial_fit, or leave half_life=None"
            )
        for chunks in ("_stream", "n_effective_rows_"):  # of a partial_fit before
            self.__dict__.pop(chunks, None)
        if is_partitioned(X) or is_partitioned(y):
            self._refuse_delays("dask's partitions")
            data = Partitions(X, y, lambda basis: most_block_rows(basis, settings))
            found, (X, y) = identify(data, settings), data.head
            return self._store(found, data.facts.basis, X, y)
        delays = self.input_delay, self.output_delay
        found, experiment, basis = identify_frame(X, y, settings, *delays)
        return self._store(found, basis, X, y, experiment)

    @one_blas_thread
    @within_range
    def partial_fit(self, X, y):
        """Identify the model from all chunks so far and this one.

        Chunks are consecutive rows of a record, in order, or whole records. Only sums are kept, so
        memory does not grow with the rows of a record (it grows by some thousand rows with each
        record). The model is that of ``fit`` on all rows with the same ``order`` and
        ``block_rows``, except that the block rows of a sliding window stay as they began. ``fit``
        forgets all chunks.

        If a mode lasts longer than some thousand rows, and a record is longer, only the triangular
        factor gives B and D, which are then less certain than those of ``fit``.

        With a ``half_life`` h, a row that is a periods (or seconds) old has the weight 2^(−a/h),
        and the model is that of ``fit`` by weighted least squares, however the rows are cut into
        chunks. It follows a machine that changes with a lag of about h / ln 2: the mean age of the
        rows it remembers. The trim that the analyzer has learned is not forgotten.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs (None if there are none), plain or as a frame that carries a harmonic basis
            (from ``HarmonicAnalyzer.transform``; not with ``reading="period"``). Rows whose index
            counts from 0 continue where the last chunk ended. Other rows follow it by one sample
            time, or after a gap.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time.

        Returns
        -------
        self : MOESPRegressor
            With the model of all rows so far, as soon as there are enough.

        Raises
        ------
        ValueError
            If a chunk has other columns, another sample time or another basis than the first, or
            begins before the end of the last. Earlier chunks are kept.

        Warns
        -----
        ExcitationWarning
            If an input, or all outputs, have not moved so far: there is no model yet. With a
            half-life, also if an input has rested for ten half-lives: the model stays as it is.
        IdentifiabilityWarning
            If all chunks so far give no model of this order. The chunks and the previous model are
            kept.

        References
        ----------
        Verhaegen (1994), Automatica 30(1), 61-74 (B and D from the factor).
        Kish (1965), Survey Sampling, section 11.7 (the effective number of rows).

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

        The pole moves from 0.8 to 0.6. With a half-life of 40 samples, 300 samples later:

        >>> for k in range(299):
        ...     y[k + 1] = 0.6 * y[k] + u[k]
        >>> forgetful = MOESPRegressor(order=1, block_rows=5, half_life=40.0)
        >>> for start, pole in ((300, "0.8"), (0, "0.6")):
        ...     rows = np.arange(start, start + 300)
        ...     forgetful = forgetful.partial_fit(u[rows], y[rows])
        >>> print(f"{forgetful.eigenvalues_[0].real:.2f}, {forgetful.n_effective_rows_:.0f} rows")
        0.60, 115 rows
        """
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        self._refuse_delays("chunks")
        settings, stream = self._settings(), getattr(self, "_stream", None)
        experiment = read_chunk(X, y, stream)
        check_features(self, X, reset=stream is None)
        stream = with_chunk(stream, experiment, X, settings)
        found, n_effective_rows = model_so_far(stream, settings)
        if found is not None:
            self._store(found, experiment.basis, X, y)
            self.n_effective_rows_ = n_effective_rows
        self._stream = stream
        return self

    def _refuse_delays(self, what):
        """Raise ValueError if sums over rows would need delayed signals."""
        for name in ("input_delay", "output_delay"):
            value = getattr(self, name)
            parts = list(value.values()) if isinstance(value, Mapping) else [value]
            if any(part != 0 for part in parts):
                raise ValueError(
                    f"{name}={value!r} needs records in memory, but {what} are processed in "
                    f"pieces; use fit with pandas or arrays, or shift the signals by whole samples "
                    f"before"
                )

    def _settings(self):
        """The parameters of the method, checked."""
        self._check_warmup()
        return checked(Settings(**{f.name: getattr(self, f.name) for f in fields(Settings)}))

    def _store(self, found, basis, X, y, experiment=None):
        self.order_, self.block_rows_, self.x0_ = found.order, found.block_rows, found.x0
        self.singular_values_, self.noise_floor_ = found.singular_values, found.noise_floor
        self.feedthrough_reason_ = found.feedthrough_reason
        self.order_search_, self.nonlinear_degrees_ = found.order_search, found.degrees
        return self._remember(found.model, basis, X, y, experiment)

    @property
    def eigenvalues_(self):
        """Eigenvalues of the discrete A."""
        check_is_fitted(self)
        return self.model_.eigenvalues()

    @property
    def n_harmonics_(self):
        """Harmonics of A, B, C, D and K of a model of samples."""
        return self._of_samples("n_harmonics_").n_harmonics

    @property
    def loads_(self):
        """Fourier coefficients of the outputs' forced periodic response, as a DataFrame."""
        model = self._of_samples("loads_")
        n_harmonics = max(1, self.basis_.most_loads)
        labels = pd.Index(harmonic_labels(range(n_harmonics + 1)), name="coefficient")
        values = model.forced_response(n_harmonics)
        return pd.DataFrame(values, labels, list(self.model_.output_names))

    @property
    def ltp_(self):
        """The linear time-periodic system behind samples, in continuous time: an LTPSystem."""
        self._of_samples("ltp_")
        return self.model_.to_ltp()

    def _of_samples(self, what):
        check_is_fitted(self)
        if not isinstance(self.model_, SampleModel):
            raise AttributeError(
                f"{what} exists only for a model of samples; fit behind "
                f"HarmonicAnalyzer(reading='sample'), or use "
                f"StructuredMatcher(structure=HarmonicStructure())"
            )
        return self.model_.innovations

    @property
    def feedthrough_(self):
        """Whether D is free."""
        check_is_fitted(self)
        return self.model_.feedthrough

    @property
    def kalman_gain_(self):
        """K of the innovation form."""
        return self._noise("kalman_gain")

    @property
    def innovations_covariance_(self):
        """Covariance of the innovations, in the units of the outputs."""
        return self._noise("innovations_covariance")

    def _predicts_ahead(self):
        if hasattr(self, "model_"):
            return self.model_.kalman_gain is not None
        return bool(self.disturbance_model) or self.weighting == PREDICTOR

    def _noise(self, name):
        check_is_fitted(self)
        found = getattr(self.model_, name)
        if found is None:
            raise AttributeError(
                f"no {name} was identified; fit with disturbance_model=True or weighting='pbsid'"
            )
        return found
