"""Step 2: the harmonic analyzer, from signals in time to Fourier coefficients."""

import numbers
import warnings

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._data import as_container, check_features, read_signals
from sklearn_hd._frame import (
    PERIOD,
    FrameTransformer,
    HarmonicBasis,
    HarmonicFrame,
    coefficient_names,
    phase_index,
)
from sklearn_hd._validation import (
    check_choice,
    check_harmonics,
    check_period,
    check_positive,
    check_same_rows,
)
from sklearn_hd.algorithms.fourier import WINDOW_PERIODS, recompose
from sklearn_hd.exceptions import TimeBaseWarning

__all__ = ["HarmonicAnalyzer"]

WINDOWS = (*WINDOW_PERIODS, *(f"centred-{window}" for window in WINDOW_PERIODS))


class HarmonicAnalyzer(FrameTransformer, BaseEstimator):
    """Decompose signals into time-varying Fourier coefficients of a fundamental.

    With ψ = ωt and a window h of unit sum, harmonic k of a signal s is
    estimated as (Eq. 7 read backwards)

        s_0(n) = Σ_i h_i s(n−i),   s_kc(n) = 2 Σ_i h_i s(n−i) cos kψ(n−i),

    and s_ks with sin. The transformer keeps its rows and its index; how the
    outputs are to be decomposed travels with the frame, as its ``basis``.

    Parameters
    ----------
    omega : float
        Fundamental frequency in rad/s.
    input_harmonics : int or dict, default=0
        Harmonics kept of the inputs: N for 0 … N, or such as ``{"U": [0, 1]}``.
    output_harmonics : int or dict, default=1
        The same for the outputs.
    window : str, default="boxcar"
        ``"boxcar"`` (one period), ``"triangle"`` or ``"hann"`` (two periods)
        end at the row that they are for, as a causal analyzer must;
        ``"centred-boxcar"``, ``"centred-triangle"`` and ``"centred-hann"``
        are centred on it.
    hop : int or "period", default=1
        Samples from one row read by the model steps to the next, a divisor of
        the samples in a period. ``"period"`` decomposes whole periods, one
        after another (the blockwise Fourier transform), whatever the window.
    trim_span : (float, float) or None, default=None
        Index times, in seconds within each record, between which the machine
        is in periodic trim. The waveforms averaged over that span are
        subtracted before decomposition, and added again by ``predict``.
    sample_time : float or None, default=None
        Seconds. None reads it from the index, or is 1.0 where samples are counted.

    Attributes
    ----------
    basis_ : HarmonicBasis
        All that is needed to repeat the decomposition.
    feature_names_in_ : ndarray of str
        Names of the inputs.
    n_features_in_ : int

    Raises
    ------
    ValueError
        At ``fit``, if ω is not positive, the samples in a period are too few
        for the harmonics kept or not a whole number, a signal is unknown, or
        data are not finite.

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
    """

    def __init__(
        self,
        omega,
        *,
        input_harmonics=0,
        output_harmonics=1,
        window="boxcar",
        hop=1,
        trim_span=None,
        sample_time=None,
    ):
        self.omega = omega
        self.input_harmonics = input_harmonics
        self.output_harmonics = output_harmonics
        self.window = window
        self.hop = hop
        self.trim_span = trim_span
        self.sample_time = sample_time

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.transformer_tags.preserves_dtype = []  # frames have a type a column
        return tags

    def fit(self, X, y=None):
        """Learn the time base, the names of the signals and their trim waveforms.

        Parameters
        ----------
        X : DataFrame, Series or ndarray, shape (n_samples, n_inputs)
            Inputs u.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs), optional
            Outputs; without them the model steps cannot use the basis.

        Returns
        -------
        self : HarmonicAnalyzer
        """
        hint = "it is 2π over the period, such as 2 * np.pi * 26.3 for 26.3 beats a second"
        omega = check_positive("omega", self.omega, "rad/s", hint)
        window = check_choice("window", self.window, WINDOWS)
        X = check_features(self, X, reset=True)
        inputs = read_signals(X, "x", "X", self.sample_time)
        outputs = None
        if y is not None:
            y = as_container(y, "y")
            outputs = read_signals(y, "y", "y", self.sample_time)
            check_same_rows(X, y)
        if inputs.base.counted:
            warnings.warn(
                f"no times given: samples are counted, {inputs.base.sample_time:g} s apart and "
                f"one contiguous record from psi = 0; use a DataFrame indexed by seconds",
                TimeBaseWarning,
                stacklevel=2,
            )
        kept_in = check_harmonics("input_harmonics", self.input_harmonics, inputs.names)
        kept_out = ()
        if outputs is not None:
            kept_out = check_harmonics("output_harmonics", self.output_harmonics, outputs.names)
        highest = max((k for _, orders in (*kept_in, *kept_out) for k in orders), default=0)
        spp = check_period(omega, inputs.base.sample_time, highest)
        self.basis_ = HarmonicBasis(
            omega=omega,
            sample_time=inputs.base.sample_time,
            samples_per_period=spp,
            window=window,
            hop=_check_hop(self.hop, spp),
            inputs=kept_in,
            outputs=kept_out,
            input_trim=self._trim(inputs, omega, spp),
            output_trim=None if outputs is None else self._trim(outputs, omega, spp),
        )
        return self

    def _trim(self, signals, omega, spp):
        """Phase-averaged waveforms over the trim span, pooled over records."""
        if self.trim_span is None:
            return None
        try:
            start, stop = (float(edge) for edge in self.trim_span)
        except (TypeError, ValueError):
            raise ValueError(
                f"trim_span={self.trim_span!r} is not a pair of times; give (start, stop) in "
                f"seconds"
            ) from None
        base = signals.base
        sums, counts = np.zeros((spp, len(signals.names))), np.zeros(spp)
        tolerance = 1e-6 * base.sample_time
        inside = (base.time >= start - tolerance) & (base.time < stop - tolerance)
        for segment in base.segments:
            rows = np.flatnonzero(inside[segment]) + segment.start
            rows = rows[: len(rows) // spp * spp]  # whole periods: each phase counts alike
            phase = phase_index(base.time[rows], omega, spp)
            np.add.at(sums, phase, signals.data[rows])
            np.add.at(counts, phase, 1)
        if not counts.all():
            raise ValueError(
                f"trim_span=({start:g}, {stop:g}) holds less than one whole period "
                f"({spp * base.sample_time:.4g} s) of any record; widen it"
            )
        return sums / counts[:, None]

    def transform(self, X):
        """Inputs with their harmonic coefficients, on the same rows.

        Parameters
        ----------
        X : DataFrame, Series or ndarray, shape (n_samples, n_inputs)

        Returns
        -------
        frame : HarmonicFrame, shape (n_samples, n_inputs + n_coefficients)
            The raw inputs, then ``u_0, u_1c, u_1s, …``.
        """
        check_is_fitted(self)
        X, signals = self._read(X)
        columns = dict(zip((name for name, _ in self.basis_.inputs), signals.data.T, strict=True))
        columns |= self._coefficients(signals)
        index = X.index if isinstance(X, pd.DataFrame | pd.Series) else pd.RangeIndex(len(X))
        return HarmonicFrame.attach(pd.DataFrame(columns, index=index), self.basis_, None)

    def _read(self, X):
        X = check_features(self, X, reset=False)
        signals = read_signals(X, "x", "X", self.basis_.sample_time)
        short = min((s.stop - s.start for s in signals.base.segments), default=0)
        if short < len(self.basis_.weights):
            raise ValueError(
                f"the shortest segment has {short} rows, less than the {len(self.basis_.weights)} "
                f"of the analysis window; drop it, or use a window of fewer periods"
            )
        return X, signals

    def _coefficients(self, signals):
        """Harmonic coefficients of the inputs kept, as a dict of columns."""
        basis = self.basis_
        values = signals.data.copy()
        if basis.input_trim is not None:
            values -= basis.input_trim[basis.phase_index(signals.base.time)]
        blocks = [
            basis.coefficients(
                values[segment],
                signals.base.time[segment],
                basis.inputs,
                np.arange(segment.stop - segment.start),
            )
            for segment in signals.base.segments
        ]
        return dict(zip(basis.drive_labels, np.vstack(blocks).T, strict=True))

    def inverse_transform(self, X):
        """Signals put together again from their coefficients (Eq. 7), trim added.

        Exact for periodic signals that hold only the harmonics kept, lossless
        for ``hop="period"`` with all harmonics kept; otherwise the signal as
        seen through the window.

        Parameters
        ----------
        X : DataFrame
            With the columns of coefficients that ``transform`` gives.

        Returns
        -------
        signals : DataFrame, shape (n_samples, n_inputs_kept)
        """
        check_is_fitted(self)
        basis = self.basis_
        missing = [name for name in basis.drive_labels if name not in getattr(X, "columns", ())]
        if missing:
            raise ValueError(
                f"X lacks the coefficient column {missing[0]!r}; give a frame as transform "
                f"returns it"
            )
        time = read_signals(X, "x", "X", basis.sample_time).base.time
        phase = basis.phase_index(time)
        columns = {}
        for column, (signal, harmonics) in enumerate(basis.inputs):
            labels = list(coefficient_names([(signal, harmonics)]))
            columns[signal] = recompose(X[labels].to_numpy(), basis.azimuth(time), harmonics)
            if basis.input_trim is not None:
                columns[signal] += basis.input_trim[phase, column]
        return pd.DataFrame(columns, index=X.index)

    def get_feature_names_out(self, input_features=None):
        """Names of the columns of ``transform``: raw inputs, then coefficients.

        Parameters
        ----------
        input_features : ignored
            Present for the habits of scikit-learn.

        Returns
        -------
        names : ndarray of str
        """
        check_is_fitted(self)
        raw = [signal for signal, _ in self.basis_.inputs]
        return np.asarray([*raw, *self.basis_.drive_labels], dtype=object)


def _check_hop(hop, spp):
    if hop == PERIOD and isinstance(hop, str):
        return PERIOD
    whole = isinstance(hop, numbers.Integral) and not isinstance(hop, bool)
    if not whole or hop < 1 or spp % hop:
        divisors = [d for d in range(1, spp + 1) if spp % d == 0]
        raise ValueError(
            f"hop={hop!r} does not divide the {spp} samples of a period; use one of {divisors} "
            f"or 'period'"
        )
    return int(hop)
