"""Signals and their harmonic coefficients over time."""

import warnings
from copy import copy
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np
import pandas as pd

from sklearn_hd._checks import check_output_names, signal_names
from sklearn_hd._containers import as_container
from sklearn_hd._readings import coefficient_names
from sklearn_hd.exceptions import ResamplingWarning
from sklearn_hd.harmonics import HarmonicAnalyzer
from sklearn_hd.plotting._display import (
    GREY,
    LINES,
    TIME,
    Display,
    Record,
    dress,
    fitted_step,
    grid_of,
    looks,
    places,
    unbroken,
    unit_of,
    with_unit,
)


@dataclass(eq=False, repr=False)
class HarmonicsDisplay(Display, axes="two Axes a signal, it and its coefficients"):
    """What a harmonic analyzer makes of signals: each above its coefficients over time.

        s(t) = s_0 + Σ_k (s_kc cos kψ + s_ks sin kψ),   ψ = ωt             (Eq. 7)

    Parameters
    ----------
    signals : DataFrame, shape (n_samples, n_signals)
        As measured, indexed by seconds.
    coefficients : DataFrame, shape (n_samples, n_coefficients)
        On the same rows, named ``w_0, w_1c, w_1s, …``.
    harmonics : dict
        Names of the coefficients of each signal.
    segments : list of slice, optional
        Runs of consecutive rows; lines are broken between them. By default one.
    axis : str, default="time (s)"
        Label of the time axis.
    title : str, optional
        Above the first panel.
    about_trim : bool, default=False
        Whether the periodic trim has been subtracted from the coefficients.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (2 * n_signals,)
        Signal and coefficients of the first signal, then of the second, ….
    figure_ : Figure
    signal_lines_ : list of Line2D
    coefficient_lines_ : dict of Line2D
        By name of the coefficient.
    legends_ : list of Legend

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 7.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> t = pd.Index(np.arange(256) / 32, name="time")
    >>> u = pd.DataFrame({"u": t + np.cos(2 * np.pi * t)}, index=t)
    >>> display = HarmonicsDisplay.from_data(u, omega=2 * np.pi, harmonics=1)
    >>> sorted(display.coefficient_lines_)
    ['u_0', 'u_1c', 'u_1s']
    """

    signals: pd.DataFrame
    coefficients: pd.DataFrame
    harmonics: dict
    _: KW_ONLY
    segments: list | None = None
    axis: str = TIME
    title: str | None = None
    about_trim: bool = False

    def __post_init__(self):
        self.segments = self.segments or [slice(0, len(self.signals))]

    @classmethod
    def from_data(
        cls, signals, omega=None, harmonics=1, *, record=None, span=None, ax=None, units=None, **kw
    ):
        """Analyse signals and draw them.

        A period need not hold a whole number of samples. The signals are then resampled, as
        :class:`~sklearn_hd.HarmonicAnalyzer` does it, and no warning says so.

        Parameters
        ----------
        signals : DataFrame or Series, shape (n_samples, n_signals)
            As measured, indexed by seconds.
        omega : float
            Fundamental frequency, rad/s.
        harmonics : int or dict, default=1
            Kept of the signals, as in :class:`~sklearn_hd.HarmonicAnalyzer`.
        **kw
            Further parameters of the analyzer (``window``, ``trim_span``, …).
        """
        analyzer = HarmonicAnalyzer(omega, input_harmonics=harmonics, **kw)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResamplingWarning)  # it is about fits, and none follows
            analyzer.fit(signals)
        return cls.from_estimator(analyzer, signals, record=record, span=span, ax=ax, units=units)

    @classmethod
    def from_estimator(cls, estimator, X, y=None, *, record=None, span=None, ax=None, units=None):
        """Draw inputs, and outputs where given, as a fitted analyzer decomposes them.

        Parameters
        ----------
        estimator : HarmonicAnalyzer, or Pipeline or search that holds one
            Fitted.
        X : DataFrame or Series, shape (n_samples, n_inputs)
            Inputs.
        y : DataFrame or Series, shape (n_samples, n_outputs), optional
            Outputs; the analyzer must have been fitted with outputs of these names.

        Raises
        ------
        ValueError
            If the analyzer makes no coefficients (``reading="sample"``).
        """
        analyzer = fitted_step(estimator, HarmonicAnalyzer, cls.__name__)
        basis = analyzer.basis_
        if basis.reading == "sample":
            raise ValueError(
                f"HarmonicAnalyzer(reading='sample') does not decompose signals, so there are no "
                f"coefficients to draw; use {cls.__name__}.from_data(X, omega) for those that a "
                f"window sees, or AzimuthDisplay for the model's harmonics"
            )
        record = Record(X, record, basis.timing)
        frame = pd.DataFrame(analyzer.transform(X))
        parts, harmonics = [frame], _names(basis.inputs)
        if y is not None:
            outputs = _beside(X, y, basis)
            parts.append(pd.DataFrame(_reading(outputs, analyzer).transform(outputs)))
            harmonics |= _names(basis.outputs)
        frame = pd.concat(parts, axis=1)[record.rows].set_axis(pd.Index(record.time, name="time"))
        display = cls(
            frame[list(harmonics)],
            frame[[name for names in harmonics.values() for name in names]],
            harmonics,
            segments=record.segments,
            axis=record.axis,
            title=record.title,
            about_trim=basis.input_trim is not None,
        )
        return display.plot(ax=ax, span=span, units=units)

    def plot(self, ax=None, *, span=None, units=None):
        """Draw, on a new figure by default."""
        count = len(self.harmonics)
        rows, columns = grid_of(count, most=2 if count in (3, 4) else 3)
        cells = [(2 * r + half, c) for r, c in places(count, columns) for half in (0, 1)]
        size = max(6.4, 4.2 * columns), 0.6 + 3.2 * rows if rows < 3 else 2.6 * rows
        panels = self._panels(ax, size, cells, heights=[1.0, 1.2] * rows, share_x="all")
        self.signal_lines_, self.coefficient_lines_, self.legends_ = [], {}, []
        pairs = zip(self.harmonics.items(), panels.axes.reshape(-1, 2), strict=True)
        for k, ((signal, names), (above, below)) in enumerate(pairs):
            self._draw(signal, names, above, below, span, units)
            if k >= count - columns:
                below.set_xlabel(self.axis)
        if self.title is not None:
            panels.axes[0].set_title(self.title, loc="left")
        return self

    def _draw(self, signal, names, above, below, span, units):
        line = unbroken(self.signals[signal], self.segments, span)
        self.signal_lines_ += above.plot(*line, color=GREY, lw=0.8)
        dress(above, y=with_unit(signal, units))
        for name, look in zip(names, looks(LINES, len(names)), strict=True):
            line = unbroken(self.coefficients[name], self.segments, span)
            self.coefficient_lines_[name] = below.plot(*line, label=name, **look)[0]
        what = "coefficients" if not self.about_trim else "coefficients\nabout trim"
        dress(below, y=with_unit(what, {what: unit_of(signal, units)}))
        above.tick_params(labelbottom=False)
        options = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "borderpad": 0.0}
        options |= {"ncols": min(len(names), 3), "columnspacing": 1.2, "frameon": False}
        self.legends_.append(below.legend(fontsize=8, **options))


def _names(signals):
    """Names of the coefficients kept of each signal."""
    return {signal: coefficient_names([(signal, orders)]) for signal, orders in signals}


def _reading(outputs, analyzer):
    """The same analyzer for the outputs."""
    basis, other = analyzer.basis_, copy(analyzer)
    other.basis_ = replace(basis, inputs=basis.outputs, input_trim=basis.output_trim)
    other.n_features_in_ = outputs.shape[1]
    other.feature_names_in_ = np.asarray(outputs.columns, dtype=object)
    return other


def _beside(X, y, basis):
    """Outputs with the azimuth that stands among the inputs, where there is one."""
    y = as_container(y, "y")
    if not basis.outputs:
        raise ValueError(
            "y was given, but the HarmonicAnalyzer was fitted without outputs: call its "
            "fit(X, y), or leave y out"
        )
    names = signal_names(y, "y")
    check_output_names(names, tuple(s for s, _ in basis.outputs), "the analyzer")
    y = pd.DataFrame(y).set_axis(list(dict(basis.outputs)), axis=1)
    if basis.timing.azimuth is None:
        return y
    return y.assign(**{basis.timing.azimuth: X[basis.timing.azimuth].to_numpy()})
