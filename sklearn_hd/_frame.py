"""What travels between the steps: the frame, its harmonic basis, the model identified so far."""

import sys
from dataclasses import dataclass, field, replace

import control
import numpy as np
import pandas as pd
from sklearn.base import TransformerMixin

from sklearn_hd._checks import FIRST, RAISE
from sklearn_hd.algorithms.signals.fourier import (
    WINDOW_PERIODS,
    harmonic_functions,
    harmonic_labels,
    window_weights,
    windowed_coefficients,
)

__all__ = ["HarmonicBasis", "HarmonicFrame", "LTIModel", "Reading"]

PERIOD = "period"
DUST = 1e-12  # share of a signal, or of the trim that was subtracted, that is rounding
HALF = 1e-6  # of a sample, so that rows halfway between two phases all go to the same side


@dataclass(frozen=True)
class Reading:
    """How rows are read: when each was sampled, and what becomes of missing samples.

    Attributes
    ----------
    sample_time : float or None
        Seconds from row to row; None reads it from the index.
    time_origin : str or None
        The instant from which dates are counted, as ISO text, or FIRST for the
        first of them; None refuses dates.
    azimuth : str or None
        Name of the column that holds ψ.
    missing : "raise", "gap" or float
        What becomes of NaN; a number is the longest run to bridge, in seconds.
    resampled : bool
        Whether rows are resampled even if evenly spaced, as no whole number of
        them makes a period.
    """

    sample_time: float | None = None
    time_origin: str | None = FIRST
    azimuth: str | None = None
    missing: float | str = RAISE
    resampled: bool = False


@dataclass(frozen=True, eq=False)
class HarmonicBasis:
    """How harmonic coefficients were, and are to be, made from signals in time.

    Attributes
    ----------
    omega : float
        Fundamental frequency, rad/s; the mean speed where an azimuth is given.
    sample_time : float
        Seconds from row to row of the grid that is analysed.
    samples_per_period : int
    window : str
        Such as ``"boxcar"`` (causal) or ``"centred-boxcar"``.
    hop : int or "period"
        Samples from one row read by the model steps to the next.
    inputs, outputs : tuple of (signal, (k, …))
        Harmonics kept of each signal.
    input_trim, output_trim : ndarray, shapes (samples_per_period, n_signals), or None
        Periodic waveforms subtracted from the signals.
    reading : Reading
        How the user's rows are read.
    small_signal : "odd", "extrapolate" or None
        How records at several amplitudes are combined where a model is fitted.
    """

    omega: float
    sample_time: float
    samples_per_period: int
    window: str
    hop: int | str
    inputs: tuple
    outputs: tuple
    input_trim: np.ndarray | None = None
    output_trim: np.ndarray | None = None
    reading: Reading = field(default_factory=Reading)
    small_signal: str | None = None

    @property
    def synchronous(self):
        """Whether one row a period is read (hop="period")."""
        return self.hop == PERIOD

    @property
    def hop_samples(self):
        """Samples between the rows read."""
        return self.samples_per_period if self.synchronous else self.hop

    @property
    def rows_per_period(self):
        """Rows read in a period."""
        return self.samples_per_period // self.hop_samples

    @property
    def weights(self):
        """Window, oldest sample first, shape (n_window,)."""
        if self.synchronous:
            return window_weights("boxcar", self.samples_per_period)
        return window_weights(self.window.removeprefix("centred-"), self.samples_per_period)

    @property
    def window_rows(self):
        """Rows read within one window."""
        if self.synchronous:
            return 1
        periods = WINDOW_PERIODS[self.window.removeprefix("centred-")]
        return periods * self.rows_per_period

    @property
    def lead(self):
        """Samples by which the window runs ahead of its row, a multiple of the hop.

        Ahead by whole hops, so that inputs that change where rows are read
        still do so, seen from the end of the window.
        """
        if self.synchronous or not self.window.startswith("centred-"):
            return 0
        hops = round((len(self.weights) - 1) / 2 / self.hop_samples)
        return min(hops, (len(self.weights) - 1) // self.hop_samples) * self.hop_samples

    @property
    def output_labels(self):
        """Names of the harmonic coefficients of the outputs."""
        return coefficient_names(self.outputs)

    @property
    def measured(self):
        """Columns that the basis reads: the inputs, and the azimuth where there is one."""
        inputs = [signal for signal, _ in self.inputs]
        return inputs if self.reading.azimuth is None else [*inputs, self.reading.azimuth]

    @property
    def held(self):
        """Which inputs drive the models as they were measured, held from row to row."""
        return np.array([harmonics == (0,) for _, harmonics in self.inputs], dtype=bool)

    @property
    def drive_labels(self):
        """Names of the inputs of the identified models.

        A signal of which only harmonic 0 is kept drives the model as it was
        measured; others by the coefficients of each whole period.
        """
        return coefficient_names(self.inputs)

    def azimuth(self, time):
        """ψ = ωt in radians."""
        return self.omega * np.asarray(time)

    def phase_index(self, time):
        """Sample within the period of the rows of one segment, 0 … samples_per_period − 1.

        Counted from the first row, so that a sample time that is off by a part
        in a million moves no row into the neighbouring phase.
        """
        time = np.asarray(time)
        if len(time) == 0:
            return np.zeros(0, dtype=int)
        first = time[0] * self.omega / (2.0 * np.pi) * self.samples_per_period
        steps = np.rint((time - time[0]) / self.sample_time).astype(int)
        return (int(np.floor(first + 0.5 + HALF)) + steps) % self.samples_per_period

    def coefficients(self, values, time, signals, rows):
        """Windowed coefficients of some signals at some rows of one segment.

        Parameters
        ----------
        values : ndarray, shape (n_samples, n_signals)
            One column for each entry of ``signals``.
        time : ndarray, shape (n_samples,)
            Seconds.
        signals : tuple of (signal, (k, …))
        rows : ndarray of int, shape (n_rows,)
            Rows nearer to an end than the window reaches take the nearest
            whole window; a hop of ``"period"`` takes the period that the row is in.

        Returns
        -------
        coefficients : ndarray, shape (n_rows, n_coefficients)
        """
        ends = self._window_ends(time, rows)
        unique, where = np.unique(ends, return_inverse=True)
        psi = self.azimuth(time)
        columns = [
            windowed_coefficients(values[:, i], psi, harmonics, self.weights, unique)[where]
            for i, (_, harmonics) in enumerate(signals)
        ]
        return np.hstack(columns)

    def output_coefficients(self, outputs, time, rows):
        """Coefficients of the outputs that models are fitted to, without those that are dust.

        Each coefficient counts alike in a fit, whatever its size: rounding would, too.

        Parameters
        ----------
        outputs : ndarray, shape (n_samples, n_outputs)
            Trim subtracted.
        time : ndarray, shape (n_samples,)
        rows : ndarray of int, shape (n_rows,)

        Returns
        -------
        coefficients : ndarray, shape (n_rows, n_coefficients)
        """
        columns = self.coefficients(outputs, time, self.outputs, rows)
        start = 0
        for i, (_, harmonics) in enumerate(self.outputs):
            own = slice(start, start + len(harmonic_labels(harmonics)))
            trim = 0.0 if self.output_trim is None else np.max(np.abs(self.output_trim[:, i]))
            columns[:, own] = _without_dust(columns[:, own], DUST * trim)
            start = own.stop
        return columns

    def _window_ends(self, time, rows):
        """Last sample of the window of each row, clipped to the segment."""
        n_window, n_samples = len(self.weights), len(time)
        if self.synchronous:
            ends = rows - self.phase_index(time)[rows] + n_window - 1
        else:
            ends = np.asarray(rows) + self.lead
        return np.clip(ends, n_window - 1, n_samples - 1)

    def rows_read(self, time, whole_windows=True):
        """Rows of one segment that model steps read: ψ = 0 mod hop.

        With ``whole_windows`` only those whose window lies within the segment.
        """
        phase = self.phase_index(time)
        rows = np.flatnonzero(phase % self.hop_samples == 0)
        if not whole_windows:
            return rows
        n_window, n_samples = len(self.weights), len(time)
        if self.synchronous:
            return rows[rows + n_window <= n_samples]
        return rows[(rows + self.lead >= n_window - 1) & (rows + self.lead < n_samples)]

    def drive(self, values, time):
        """Inputs of the identified model at every sample of one segment.

        Parameters
        ----------
        values : ndarray, shape (n_samples, n_inputs)
            Raw inputs, trim subtracted, one column for each entry of ``inputs``.

        Returns
        -------
        drive : ndarray, shape (n_samples, n_drive)
            The raw signal where only harmonic 0 is kept; else the coefficients
            of the whole period that each sample lies in.
        """
        psi, spp = self.azimuth(time), self.samples_per_period
        box = window_weights("boxcar", spp)
        ends = np.arange(len(time)) - self.phase_index(time) + spp - 1
        ends, where = np.unique(np.clip(ends, spp - 1, len(time) - 1), return_inverse=True)
        columns = [
            values[:, [i]]
            if harmonics == (0,)
            else _without_dust(windowed_coefficients(values[:, i], psi, harmonics, box, ends))[
                where
            ]
            for i, (_, harmonics) in enumerate(self.inputs)
        ]
        return np.hstack(columns)

    def recomposition(self, psi):
        """Matrices R(ψ) that take the outputs' coefficients to the kept signals (Eq. 7).

        Returns
        -------
        R : ndarray, shape (n_samples, n_signals, n_coefficients)
        """
        blocks = [harmonic_functions(psi, harmonics) for _, harmonics in self.outputs]
        width = sum(block.shape[-1] for block in blocks)
        R = np.zeros((len(psi), len(blocks), width))
        start = 0
        for i, block in enumerate(blocks):
            R[:, i, start : start + block.shape[-1]] = block
            start += block.shape[-1]
        return R


def highest_harmonic(signals):
    """Highest harmonic kept of some signals."""
    return max(k for _, orders in signals for k in orders)


def _without_dust(coefficients, least=0.0):
    """Coefficients of one signal, those that are but rounding beside the others set to zero."""
    size = np.abs(coefficients).max(axis=0, initial=0.0)
    return np.where(size > max(DUST * size.max(initial=0.0), least), coefficients, 0.0)


def coefficient_names(signals):
    """Names such as u_0, u_1c, u_1s of the coefficients kept of some signals."""
    return tuple(
        f"{signal}_{label}" for signal, harmonics in signals for label in harmonic_labels(harmonics)
    )


@dataclass(frozen=True, eq=False)
class LTIModel:
    """State-space matrices with their names, as a value that pickles and hashes.

    Attributes
    ----------
    A, B, C, D : ndarray
    dt : float
        Sample time in seconds; 0.0 for continuous time.
    input_names, output_names : tuple of str
    state_names : tuple of str or None
    feedthrough : bool
        Whether D was free.
    windowed : bool
        Whether the outputs are coefficients as seen through the analysis
        window (an identified model) rather than the harmonics themselves.
    kalman_gain : ndarray, shape (n, l), or None
        K of the innovation form, where it was identified.
    innovations_covariance : ndarray, shape (l, l), or None
    closed_loop : bool
        Whether it was identified as if inputs answered to outputs.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float
    input_names: tuple
    output_names: tuple
    state_names: tuple | None = None
    feedthrough: bool = False
    windowed: bool = False
    kalman_gain: np.ndarray | None = None
    innovations_covariance: np.ndarray | None = None
    closed_loop: bool = False

    @property
    def n_states(self):
        """Number of states."""
        return len(self.A)

    def in_continuous_time(self, A, B, C, D, **changes):
        """The continuous-time model of some matrices between the same signals."""
        no_noise = {"kalman_gain": None, "innovations_covariance": None}  # of the rows read
        matrices = {"A": A, "B": B, "C": C, "D": D}
        return replace(self, **matrices, dt=0.0, windowed=False, **no_noise, **changes)

    def to_control(self):
        """The model as a control.StateSpace with named signals.

        Of outputs alone, whose inputs are the innovations e (which have names such as e@y).
        """
        B, D, input_names = self.B, self.D, list(self.input_names)
        if not input_names:
            if self.kalman_gain is None:
                raise AttributeError(
                    "a model of outputs alone, without a Kalman gain, has no inputs to make a "
                    "control.StateSpace of; fit with disturbance_model=True, or use model_.A and "
                    "model_.C"
                )
            B, D = self.kalman_gain, np.eye(len(self.C))
            input_names = [f"e@{name}" for name in self.output_names]
        names = {} if self.state_names is None else {"states": list(self.state_names)}
        return control.StateSpace(
            self.A,
            B,
            self.C,
            D,
            self.dt,
            inputs=input_names,
            outputs=list(self.output_names),
            name="identified",
            remove_useless_states=False,
            **names,
        )


class HarmonicFrame(pd.DataFrame):
    """A DataFrame that carries the harmonic basis and the model identified so far.

    Its columns are the raw inputs and their harmonic coefficients
    ``u_0, u_1c, u_1s, …``, on the user's own index. Slicing, copying and
    pickling keep both attributes; concatenation and joins drop them.

    Parameters
    ----------
    data, index, columns, dtype, copy : optional
        As for ``pandas.DataFrame``. Such a frame carries nothing yet: frames with a
        basis come from :class:`HarmonicAnalyzer`, with a model from the model steps.

    Attributes
    ----------
    basis : HarmonicBasis or None
        How the coefficients were made.
    model : LTIModel or None
        The model identified so far.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 7 (the coefficients).

    Examples
    --------
    >>> frame = HarmonicFrame({"u": [0.0, 1.0]})
    >>> frame.iloc[:1].basis is None
    True
    """

    _metadata = ["basis", "model"]  # noqa: RUF012 - the protocol of pandas
    basis = None
    model = None

    @property
    def _constructor(self):
        return HarmonicFrame

    @classmethod
    def attach(cls, data, basis, model):
        """A frame of some data, with a basis and a model riding on it.

        Parameters
        ----------
        data : DataFrame
            Taken as it is, not copied.
        basis : HarmonicBasis or None
            How its coefficients were made.
        model : LTIModel or None
            The model identified so far.

        Returns
        -------
        frame : HarmonicFrame
            The same rows and columns.
        """
        _tell_dask()
        frame = cls(data, copy=False)
        frame.basis, frame.model = basis, model
        return frame


def _tell_dask():
    """Have dask, where it is loaded, tell frames apart by what rides on them, too.

    It takes collections whose parts are alike for one and the same, and would go on with the
    frame without a basis that ``map_partitions(meta=...)`` was given by mistake before.
    """
    dask = sys.modules.get("dask.base")
    if dask is not None:
        dask.normalize_token.register(HarmonicFrame, _dask_token)


def _dask_token(frame):
    """What makes a frame the one that it is."""
    normalize = sys.modules["dask.base"].normalize_token
    return "HarmonicFrame", normalize(pd.DataFrame(frame)), normalize((frame.basis, frame.model))


class FrameTransformer(TransformerMixin):
    """A transformer whose output carries more than its columns, and so is always a frame."""

    def fit_transform(self, X, y=None, **params):
        """Fit, then transform the same rows.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            As for ``fit``.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs), optional
            As for ``fit``.
        **params
            Handed on to ``fit``.

        Returns
        -------
        frame : HarmonicFrame
            As ``transform`` makes it.

        Raises
        ------
        ValueError
            As ``fit`` and ``transform``.
        """
        return self.fit(X, y, **params).transform(X)

    def set_output(self, *, transform=None):
        """Set the container of ``transform``: a frame, always.

        Parameters
        ----------
        transform : {"default", "pandas", None}
            All the same here. Other containers would drop the basis and the model.

        Returns
        -------
        self : estimator
            As it was.

        Raises
        ------
        ValueError
            If another container is asked for.
        """
        if transform not in (None, "default", "pandas"):
            raise ValueError(
                f"transform={transform!r} would drop the harmonic basis and the model that ride on "
                f"the frame; use 'pandas' or 'default'"
            )
        return super().set_output(transform=transform)
