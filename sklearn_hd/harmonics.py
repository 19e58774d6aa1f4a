"""Step 2: the harmonic analyzer, from signals in time to Fourier coefficients."""

from dataclasses import replace

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import (
    RAISE,
    check_choice,
    check_missing,
    check_phase,
)
from sklearn_hd._clock import why_short
from sklearn_hd._containers import check_has_signals, check_upright, warn_if_counted
from sklearn_hd._fit_checks import lasting_hop, motion_kept
from sklearn_hd._frame import FrameTransformer, HarmonicFrame
from sklearn_hd._guards import warn, within_range
from sklearn_hd._readings import READINGS, Timing, coefficient_names
from sklearn_hd._records.bases import AUTO, chosen_readings, record_basis, settled_omega, with_trim
from sklearn_hd._records.data import (
    check_features,
    is_decomposed,
    read_signals,
    read_values,
    sample,
    warn_of_jitter,
    without_trim,
)
from sklearn_hd._records.sampling import lay_grid, warn_of_outliers, warn_of_resampling
from sklearn_hd.algorithms.signals.fourier import WINDOW_PERIODS, recompose
from sklearn_hd.exceptions import TimeBaseWarning

__all__ = ["HarmonicAnalyzer"]

SMALL_SIGNAL = ("odd", "extrapolate")
WINDOWS = (*WINDOW_PERIODS, *(f"centred-{window}" for window in WINDOW_PERIODS))


class HarmonicAnalyzer(FrameTransformer, BaseEstimator):
    """Decompose signals into time-varying Fourier coefficients of a fundamental.

    With ψ = ωt and a window h of unit sum, harmonic k of a signal s is estimated as (the inverse
    of Eq. 7)

        s_0(n) = Σ_i h_i s(n−i),   s_kc(n) = 2 Σ_i h_i s(n−i) cos kψ(n−i),

    and s_ks with sin. The transformer keeps the rows and the index. The ``basis`` of the returned
    frame tells the model steps how to decompose the outputs.

    Parameters
    ----------
    omega : float or None, default=None
        Fundamental frequency in rad/s, constant. Give this or ``azimuth``. If the orbit in y shows
        that it is surely off, ``fit`` takes the frequency that the record tells
        (``basis_.omega``). A warning says so if the difference matters (1 % of the motion).
    input_harmonics : int, dict or None, default=None
        Harmonics kept of the inputs: N for 0 … N, or a dict such as ``{"U": [0, 1]}``; None is 0.
        With ``reading="sample"`` it is the highest harmonic that B(ψ) and D(ψ) may have; None sets
        no separate limit.
    output_harmonics : int, dict or None, default=None
        The same for the outputs; None is 1. With ``reading="sample"`` it is the highest harmonic
        that the coefficients of the predictor may have (0: a time-invariant model); None is 3.
    load_harmonics : int or None, default=None
        With ``reading="sample"``, the highest harmonic of the forced periodic response (trim,
        loads at n per turn), which is identified together with the dynamics; None is as many as
        the samples can separate, at most 12.
    window : str, default="boxcar"
        ``"boxcar"`` (one period), ``"triangle"`` and ``"hann"`` (two periods) end at the row that
        they describe, so they are causal; ``"centred-boxcar"``, ``"centred-triangle"`` and
        ``"centred-hann"`` are centred on that row.
    reading : {"auto", "period", "sample", "sliding"}, default="auto"
        How model steps analyse the record (the *reading*). ``"period"`` decomposes whole periods,
        one after another (the blockwise Fourier transform), whatever the window: sampled once per
        period, a periodic system is time-invariant. ``"sample"`` uses each row as a sample with
        its azimuth and decomposes nothing. It is for records in service: inputs that always move,
        loads at every turn, turbulence, any number of samples per turn. ``"sliding"`` is the
        method of the paper: coefficients through the window, every ``hop`` samples. ``"auto"``
        takes the first of these that applies:

        - ``"sample"``, if ``load_harmonics`` is given;
        - ``"sliding"``, if there is no y, or if a hop, another window than ``"boxcar"``, harmonics
          of inputs or harmonics by signal are given;
        - ``"period"``, if ``small_signal`` is given;
        - ``"period"``, if the inputs rest: in at least half of the turns, and of 12 turns or more,
          they do what they did a turn before, except for noise, and no segment is shorter than a
          period. ``basis_.alternative`` is then the reading of the samples. :class:`MOESPRegressor`
          tries it if something speaks against the model of periods, or that may be off by 5 %, and
          keeps the surer one;
        - ``"sample"``, if the inputs move in more turns than that, or there are fewer turns.

        ``basis_.reading`` holds the choice.
    hop : int or None, default=None
        Samples from one analysed row to the next. With ``reading="sliding"`` it divides the number
        of samples per period; None reads at least eight rows per period, and at least three more
        than twice the highest harmonic. With ``reading="sample"`` any number is allowed; None
        keeps 24 rows per turn, and more if the outputs lose half of their motion from row to row
        (see ``basis_.hop``). Inputs are averaged in between.
    trim_span : "auto", (float, float) or None, default="auto"
        Span in which the machine is in periodic trim: index times, in seconds within each record
        (for dates: since ``time_origin``). The mean waveforms there are subtracted before
        decomposition, and ``predict`` adds them again. ``"auto"`` takes the turns in which inputs
        rest and outputs repeat themselves, except for noise: those that begin the record, else the
        most at one level of the inputs. It subtracts nothing if the outputs are zero there, except
        for noise. If nothing rests, and a waveform is more than half of the energy of an output,
        this forced response is identified together with the dynamics, as ``reading="sample"``
        always does; ``reading="sliding"`` subtracts the mean waveform, with a warning. None says
        that outputs are about their trim, and subtracts nothing. If a waveform is more than half of
        the energy of an output all the same, ``reading="period"`` identifies it together with the
        dynamics; where inputs have a mean that may make it, and with ``reading="sliding"``, there
        is a warning.
    sample_time : float or None, default=None
        Seconds. None reads it from the index; without times it is 1.0.
    azimuth : str or None, default=None
        Column of X that holds the azimuth ψ in rad of a rotor whose speed varies. It increases, or
        starts again at each turn, and is not an input of the model. The analysis then uses a
        uniform grid in azimuth (see Notes).
    time_origin : date or None, default=None
        The instant of ψ = 0 (``pd.Timestamp``, ``datetime`` or text), for an index of dates; it
        needs a time zone if the index has one. With ``azimuth`` it only sets the zero of
        ``trim_span``; None is then the first sample.
    missing : "raise", "gap" or float, default="raise"
        Treatment of NaN in the inputs, the outputs or the azimuth. ``"raise"`` refuses them.
        ``"gap"`` makes each a gap, after which a new segment starts. A number is the longest run,
        in seconds, that is bridged (inputs linearly, the rest by cubic splines); longer runs, and
        runs at the ends of a segment, become gaps. Rows in gaps, and pieces between gaps that are
        shorter than the window, are neither fitted nor scored. Bridged outputs are fitted but not
        scored. ``predict`` returns values wherever the inputs are known, and NaN elsewhere.

    small_signal : {"odd", "extrapolate"} or None, default=None
        Combination of records before the fit, if the records of a (record, time) index hold one
        input waveform at several amplitudes, at the same times and phases. ``"odd"``: pairs +u, −u
        become the record (u₊ − u₋)/2, (y₊ − y₋)/2. ``"extrapolate"``: records at q amplitudes a
        become their linear term y_1, scaled to the largest a, of y(a) = Σ_{p=1…q} a^p y_p. Both
        reduce the bias of a response that is not linear in u. ``predict`` and ``score`` use every
        record as it is.

    Attributes
    ----------
    basis_ : HarmonicBasis
        Everything that is needed to repeat the decomposition.
    feature_names_in_ : ndarray of str
        Names of the inputs.
    n_features_in_ : int

    Raises
    ------
    ValueError
        At ``fit``, if ω is not positive, the samples in a period are too few
        for the harmonics kept, a signal is unknown, data are not finite, steps
        are too uneven, or dates have no origin.

    Warns
    -----
    TimeBaseWarning
        If no times are given, so that rows count as samples.
    FrequencyMismatchWarning
        If the record repeats itself at another frequency than ``omega``, which is then used
        instead, and the difference matters (1 % of the motion).
    JitterWarning
        If rows are not evenly spaced in time.
    ResamplingWarning
        If a period does not hold a whole number of samples.

    Notes
    -----
    *Uneven rows.* Steps of the index between 0.6 and 1.4 samples (instants off an even grid by up
    to a fifth of a sample) are jitter. Signals are then resampled onto the multiples of the sample
    time, and results are brought back to the rows given; a ``JitterWarning`` states the size. A
    longer step that is a whole number of samples, within twice the jitter, starts a new segment.

    *A period without a whole number of samples* (64.02, if ω was rounded or the clock is not tied
    to the machine; 50.3) is resampled onto one: the nearest within 0.1 of a sample, otherwise the
    next higher one, and a multiple of ``hop``. A ``ResamplingWarning`` bounds the interpolation
    error by leaving out every second sample. Deviations up to 0.001 samples per period and 0.25
    over a segment count as a whole number: the rows are then used as they are, each with its own
    ψ.

    *Azimuth.* The grid holds a whole number of samples per turn: the mean over the rows at fit,
    rounded up to a whole number and to a multiple of ``hop``. Its time is ψ/ω with ω the mean
    speed at fit (``basis_.omega``), so every later step works as at constant speed. The model is
    then time-invariant *per turn*: with x′ = dx/dψ, ω x′ = A x + B u. This describes a system
    whose dynamics scale with the rotor speed (blade aerodynamics: damping in proportion to speed).
    Dynamics fixed in time (structural modes, a rigid-body mode) have eigenvalues per turn that
    vary as ω/ω(t), and are identified at their mean: for ±5 % of speed, to within ±5 % at any
    instant.

    *Accuracy.* Splines of degree five resample smooth signals with errors below 1e-5, 1e-7, 1e-8
    of the amplitude for 16, 32, 64 samples in a period of the highest frequency. Inputs of which
    only the mean is kept are held from row to row, as models assume, and their held means are
    taken on the grid. Rows that are already even stay unchanged.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 7 and section 4.2.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> t = pd.Index(np.arange(64) / 16, name="time")
    >>> u = pd.DataFrame({"u": 3 + np.cos(2 * np.pi * t)}, index=t)
    >>> frame = HarmonicAnalyzer(2 * np.pi, input_harmonics=1).fit_transform(u)
    >>> frame.columns.tolist()
    ['u', 'u_0', 'u_1c', 'u_1s']
    >>> [round(float(abs(value)), 6) for value in frame.iloc[-1, 1:]]
    [3.0, 1.0, 0.0]

    A rotor that speeds up by a tenth, by its azimuth:

    >>> psi = 2 * np.pi * (t + t**2 / 80)
    >>> u = pd.DataFrame({"u": 3 + np.cos(psi), "psi": psi}, index=t)
    >>> frame = HarmonicAnalyzer(azimuth="psi", input_harmonics=1).fit_transform(u)
    >>> [round(float(abs(value)), 3) for value in frame.iloc[-1, 2:]]
    [3.0, 1.0, 0.0]
    """

    def __init__(
        self,
        omega=None,
        *,
        input_harmonics=None,
        output_harmonics=None,
        load_harmonics=None,
        window="boxcar",
        reading=AUTO,
        hop=None,
        trim_span=AUTO,
        sample_time=None,
        azimuth=None,
        time_origin=None,
        missing=RAISE,
        small_signal=None,
    ):
        self.omega = omega
        self.input_harmonics = input_harmonics
        self.output_harmonics = output_harmonics
        self.load_harmonics = load_harmonics
        self.window = window
        self.reading = reading
        self.hop = hop
        self.trim_span = trim_span
        self.sample_time = sample_time
        self.azimuth = azimuth
        self.time_origin = time_origin
        self.missing = missing
        self.small_signal = small_signal

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = []  # frames have a type a column
        tags.input_tags.allow_nan = self.missing != RAISE
        return tags

    def __sklearn_is_fitted__(self):
        return hasattr(self, "basis_")

    @within_range
    def fit(self, X, y=None):
        """Learn the time base, the names of the signals and their trim waveforms.

        Parameters
        ----------
        X : DataFrame, Series or ndarray, shape (n_samples, n_inputs)
            Inputs u.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs), optional
            Outputs. Without them the model steps can use the basis only if they receive harmonics
            of y themselves (a HarmonicFrame).

        Returns
        -------
        self : HarmonicAnalyzer
            Fitted.
        """
        timing = self._checked_timing()
        _check_raw(X)
        X = check_features(self, X, reset=True)
        check_has_signals(X, "X")
        inputs = read_signals(X, timing)
        _check_rows(inputs)
        outputs, output_names = None, ()
        if y is not None and not is_decomposed(y):
            outputs, output_names = read_values(y, X, inputs.base, timing)
        warn_if_counted(inputs.base)
        if not inputs.base.counted:
            timing = replace(timing, row_time=inputs.base.sample_time)
        omega = settled_omega(self, inputs, outputs, timing)
        if outputs is not None:
            samples = 2.0 * np.pi / omega / inputs.base.sample_time
            warn_of_outliers(inputs, outputs, output_names, samples)

        def basis_of(reading):
            basis = record_basis(self, reading, inputs, output_names, timing, omega)
            if reading == "sample" and self.hop is None and outputs is not None:
                basis = _without_loss(basis, inputs, outputs)
            return with_trim(basis, inputs, outputs, self.trim_span)

        first, *others = chosen_readings(self, inputs, outputs, timing, omega)
        self.basis_ = basis_of(first)
        if others:
            self.basis_ = replace(self.basis_, alternative=basis_of(*others))
        if self.basis_.timing.resampled:
            warn_of_resampling(self.basis_, inputs, outputs)
        return self

    def _checked_timing(self):
        """Times of the rows, as the parameters give them; ValueError if one is not understood."""
        check_choice("window", self.window, WINDOWS)
        check_choice("reading", self.reading, (AUTO, *READINGS))
        if self.small_signal is not None:
            check_choice("small_signal", self.small_signal, SMALL_SIGNAL)
        words = isinstance(self.hop, str) and self.reading != "sample"
        if self.hop is not None and (self.reading == "period" or words):
            raise ValueError(
                f"hop={self.hop!r} with reading={self.reading!r}: a hop is a number of samples "
                f"between rows of a sliding window; leave hop=None for reading='period'"
            )
        origin = check_phase(self.omega, self.azimuth, self.time_origin)
        return Timing(self.sample_time, origin, self.azimuth, check_missing(self.missing))

    @within_range
    def transform(self, X):
        """Inputs with their harmonic coefficients, on the same rows.

        Parameters
        ----------
        X : DataFrame, Series or ndarray, shape (n_samples, n_inputs)
            Inputs of the names at fit, with the azimuth where there is one.

        Returns
        -------
        frame : HarmonicFrame, shape (n_samples, n_inputs + n_coefficients)
            The raw inputs, then ``u_0, u_1c, u_1s, …``. Where the reading is left open, and a
            segment is shorter than the window, these are NaN: only models of samples predict it.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If a segment is shorter than the window and the reading is not left open, or the
            inputs are not those of fit.
        """
        check_is_fitted(self)
        basis = self.basis_
        X = check_features(self, X, reset=False)
        signals = read_signals(X, basis.timing)
        if basis.timing.row_time is not None:
            warn_if_counted(signals.base, "X had times at fit, but has none now", " as at fit")
        sampling, inputs, _ = sample(signals, basis)
        lengths = [len(piece.grid) for piece in sampling.pieces]
        few = sum(length < len(basis.weights) for length in lengths)
        if few and basis.alternative is None:
            raise ValueError(
                f"the shortest segment has {min(lengths)} rows, less than the {len(basis.weights)} "
                f"of the analysis window, and {few} of {len(lengths)} are too "
                f"short{why_short(signals.base)}; drop them, use a window of fewer periods, or "
                f"reading='sample', which has no window"
            )
        if self.azimuth is None:
            warn_of_jitter(signals.base, basis.sample_time)
            _warn_of_few(signals.base, basis.omega)
        columns = dict(zip(basis.input_signals, signals.data.T, strict=True))
        if basis.timing.azimuth is not None:
            columns[basis.timing.azimuth] = signals.azimuth
        if few:  # for a model that reads samples
            columns |= dict.fromkeys(basis.coefficient_labels, np.nan)
        elif basis.coefficient_labels:
            times = [piece.grid for piece in sampling.pieces]
            inputs = without_trim(inputs, times, basis, basis.input_trim)
            coefficients = sampling.back(
                [
                    basis.coefficients(values, time, basis.inputs, np.arange(len(time)))
                    for values, time in zip(inputs, times, strict=True)
                ]
            )
            columns |= dict(zip(basis.coefficient_labels, coefficients.T, strict=True))
        index = X.index if isinstance(X, pd.DataFrame | pd.Series) else pd.RangeIndex(len(X))
        return HarmonicFrame.attach(pd.DataFrame(columns, index=index), basis, None)

    @within_range
    def inverse_transform(self, X):
        """Reconstruct signals from their coefficients (Eq. 7), with the trim added.

        This is exact for periodic signals that hold only the harmonics kept, and lossless for
        ``reading="period"`` with all harmonics kept; otherwise it is the signal as seen through
        the window.

        Parameters
        ----------
        X : DataFrame
            With the columns of coefficients that ``transform`` gives.

        Returns
        -------
        signals : DataFrame, shape (n_samples, n_inputs_kept)
            In the units of the inputs.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If X lacks a column of coefficients, or the azimuth.
        """
        check_is_fitted(self)
        basis = self.basis_
        if not basis.coefficient_labels:
            raise ValueError(
                f"reading={basis.reading!r} makes no coefficients, so there is nothing to "
                f"reconstruct; the frame holds the signals as they were given"
            )
        missing = [name for name in basis.drive_labels if name not in getattr(X, "columns", ())]
        if missing:
            raise ValueError(
                f"X lacks the coefficient column {missing[0]!r}; give a frame as transform returns "
                f"it"
            )
        azimuth = [] if basis.timing.azimuth is None else [basis.timing.azimuth]
        if not set(azimuth) <= set(X.columns):
            raise ValueError(
                f"X lacks the azimuth column {azimuth[0]!r}; give a frame as transform returns it"
            )
        given = read_signals(X[[*basis.drive_labels, *azimuth]], basis.timing)
        places = given.places(basis.omega, basis.sample_time)
        trim = 0.0
        if basis.input_trim is not None:
            present = np.isfinite(given.data).all(axis=1) & np.isfinite(places)
            timing = basis.timing
            sampling = lay_grid(given.base, places, present, basis.sample_time, timing)
            times = [piece.grid for piece in sampling.pieces]
            trim = sampling.back([basis.input_trim[basis.phase_index(time)] for time in times])
        columns, start = {}, 0
        for column, (signal, harmonics) in enumerate(basis.inputs):
            stop = start + len(coefficient_names([(signal, harmonics)]))
            coefficients = given.data[:, start:stop]
            columns[signal] = recompose(coefficients, basis.azimuth(places), harmonics)
            if basis.input_trim is not None:
                columns[signal] += trim[:, column]
            start = stop
        return pd.DataFrame(columns, index=X.index)

    def get_feature_names_out(self, input_features=None):
        """Names of the columns of ``transform``: raw inputs, then coefficients.

        Parameters
        ----------
        input_features : array-like of str, optional
            Those at fit: there are no others.

        Returns
        -------
        names : ndarray of str
            Such as ``u, u_0, u_1c, u_1s``.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If ``input_features`` are not the columns of X at fit.
        """
        check_is_fitted(self)
        known = getattr(self, "feature_names_in_", None)
        given = [] if input_features is None else list(input_features)
        same = len(given) == self.n_features_in_ if known is None else given == list(known)
        if input_features is not None and not same:
            columns = f"{self.n_features_in_} column(s)" if known is None else f"{list(known)}"
            raise ValueError(
                f"input_features={given} are not those at fit, {columns}; leave input_features=None"
            )
        names = [*self.basis_.measured, *self.basis_.coefficient_labels]
        return np.asarray(names, dtype=object)


def _without_loss(basis, inputs, outputs):
    """A basis of samples with a hop at which outputs keep half of what neighbours share."""
    if basis.hop == 1:
        return basis
    sampling, _, values = sample(inputs, basis, outputs)
    times = [piece.grid for piece in sampling.pieces]
    taken = basis.mean_waveforms(list(zip(values, times, strict=True)))
    if taken is None:
        return basis
    hop = lasting_hop(motion_kept(outputs, sampling, basis, taken))
    more = basis.hop / hop
    return replace(
        basis,
        hop=hop,
        sample_time=basis.sample_time / more,
        samples_per_period=basis.samples_per_period * more,
    )


def _check_raw(X):
    if isinstance(X, HarmonicFrame) and X.is_laden:
        raise ValueError(
            "X comes from a HarmonicAnalyzer or a model step already; use each step once, in the "
            "order HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer, StructuredMatcher"
        )
    check_upright(X, "X")


def _check_rows(inputs):
    if inputs.azimuth is None and len(inputs.data) == 1:
        raise ValueError("X has n_samples=1, and one row is no record; give many periods")


def _warn_of_few(base, omega):
    """Where a model is predicted at another clock than that of the fit."""
    samples = 2.0 * np.pi / omega / base.sample_time
    if samples < 2.0 and len(base.time) > len(base.segments):  # single rows tell no step
        warn(
            f"the rows of X are {base.sample_time:.4g} s apart, {1.0 / samples:.3g} turns of "
            f"omega={omega:.4g} rad/s, so they do not show what happens in a turn; give the times "
            f"of X in seconds, as at fit",
            TimeBaseWarning,
        )
