"""Whether what a model leaves of a record is noise."""

from dataclasses import KW_ONLY, dataclass

import numpy as np
import pandas as pd
from scipy import stats

from sklearn_hd._checks import check_count, check_fraction
from sklearn_hd._model_step import ModelStep
from sklearn_hd._residuals import left_of, scored
from sklearn_hd.algorithms.signals.trim import LEVEL
from sklearn_hd.model_selection._scorers import last_model_step
from sklearn_hd.plotting._display import (
    BLUE,
    GREY,
    LINES,
    POINTS,
    Display,
    chosen,
    dress,
    fitted_step,
    looks,
    number,
    with_unit,
)

BAND = 0.99  # of the correlations of noise lie within
BAND_REACH = stats.norm.ppf(0.5 + 0.5 * BAND)  # standard deviations to either side


@dataclass(eq=False, repr=False)
class ResidualDisplay(Display, axes="two Axes an output, three of a machine that turns"):
    """Residuals of a fitted model: correlated with themselves, with the inputs, and by azimuth.

        r_ee(τ) = Σ e[k] e[k − τ] / Σ e²,   r_eu(τ) = Σ e[k] u[k − τ] / √(Σ e² Σ u²)

    Of noise, 99 % of the correlations lie within the shaded band. It allows for the colour of
    residuals and inputs (Ljung 1999, Eq. 16.69). Correlations with inputs yet to come (τ < 0)
    tell of feedback. By azimuth: the mean, which unmodelled loads move, with its 99 % interval,
    and the standard deviation about it. Titles of the first row have the tests of
    :meth:`MOESPRegressor.residual_tests`, which allow for the parameters fitted and take all
    outputs together: the smallest p-value, or each test that fails. Correlations may lie in the
    band where a test fails, such as that of nonlinearity.

    Parameters
    ----------
    tests : DataFrame, shape (n_tests, 6)
        As ``residual_tests`` gives them.
    autocorrelation : DataFrame, shape (n_lags, n_outputs)
        By lag, from 1.
    cross_correlation : DataFrame, shape (2 * n_lags + 1, n_outputs * n_inputs)
        By lag and (output, input).
    by_phase : DataFrame, shape (n_bins, 2 * n_outputs), optional
        Mean and std of each output's residuals, by azimuth in degrees; of a machine that turns.
    bands : dict of float
        Half width of the band by output, and by (output, input).
    n_rows : int
        Of the record that were tested.
    predicts : bool, default=False
        Whether residuals are those of one-step predictions, else of simulations.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (n_outputs * n_panels,)
        Of each output: correlation with itself, with the inputs, and by azimuth.
    figure_ : Figure
    bars_ : dict of BarContainer
        By output.
    lines_ : dict of Line2D
        By (output, input).
    phase_lines_ : dict of Line2D
        Means, by output.
    legend_ : Legend or None

    References
    ----------
    Ljung (1999), System Identification, section 16.6.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn_hd import MOESPRegressor
    >>> u, e, y = np.random.default_rng(0).standard_normal((3, 2000))
    >>> for k in range(1, 2000):
    ...     y[k] = 0.8 * y[k - 1] + u[k - 1] + e[k]
    >>> model = MOESPRegressor(order=1, disturbance_model=True).fit(u[:, None], y)
    >>> display = ResidualDisplay.from_estimator(model, u[:, None], y)
    >>> bool(display.tests["passed"].all()), round(display.bands["y0"], 3)
    (True, 0.058)
    """

    tests: pd.DataFrame
    autocorrelation: pd.DataFrame
    cross_correlation: pd.DataFrame
    by_phase: pd.DataFrame | None = None
    _: KW_ONLY
    bands: dict
    n_rows: int
    predicts: bool = False

    @classmethod
    def from_estimator(
        cls, estimator, X, y, *, lags=25, level=LEVEL, outputs=None, units=None, ax=None
    ):
        """Draw what a fitted model leaves of a record.

        Parameters
        ----------
        estimator : model step of sklearn_hd, or Pipeline or search that ends in one
            Fitted.
        X : DataFrame, Series or ndarray, shape (n_samples, n_inputs)
            Inputs; the first 20 000 rows are read.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Measured outputs, on the same rows.
        lags : int, default=25
            Rows before and after that are drawn.
        level : float, default=0.001
            Share of right models that fail one of the tests. ``residual_tests_`` of a
            StructuredMatcher were made at 1e-4: there a test may pass that fails here.

        Raises
        ------
        ValueError
            If the model is one of whole windows or periods, exact to rounding, or the record is
            too short.
        """
        fitted_step(estimator, ModelStep, cls.__name__)
        lags = check_count("lags", lags, 1, "25 is usual")
        step, handed = last_model_step(estimator, X)
        level = check_fraction("level", level, "it is a probability, such as 0.001")
        left = left_of(step, handed, y)
        if not left.output_names:
            raise ValueError(
                "the model leaves only rounding of this record: there are no residuals to draw"
            )
        own, crossed, bands = _correlations(left, lags)
        turns = left.samples_per_period is not None
        display = cls(
            scored(left, None, level),
            own,
            crossed,
            _by_phase(left) if turns else None,
            bands=bands,
            n_rows=left.n_rows,
            predicts=left.predicts,
        )
        return display.plot(ax=ax, outputs=outputs, units=units)

    def plot(self, ax=None, *, outputs=None, units=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        outputs : sequence of str, optional
            Outputs to draw; all by default.

        Raises
        ------
        ValueError
            If an output is unknown.
        """
        names = list(self.autocorrelation)
        shown = [names[i] for i in chosen(outputs, names, "outputs")]
        inputs = list(dict.fromkeys(i for _, i in self.cross_correlation))
        columns = 1 + bool(inputs) + (self.by_phase is not None)
        size = 3.6 * columns + 0.6, 0.7 + 2.3 * len(shown)
        panels = self._panels(ax, size, list(np.ndindex(len(shown), columns)))
        self.bars_, self.lines_, self.phase_lines_ = {}, {}, {}
        rows = panels.axes.reshape(len(shown), columns)
        for name, row in zip(shown, rows, strict=True):
            row = iter(row)
            self._draw_own(name, next(row))
            if inputs:
                self._draw_inputs(name, inputs, next(row))
            if self.by_phase is not None:
                self._draw_phases(name, next(row), units)
        asked = [("autocorrelation", "autocorrelation by phase")]
        asked += [("inputs", "inputs by phase", "nonlinearity")] if inputs else []
        asked += [("loads",)] if self.by_phase is not None else []
        for axis, tests in zip(rows[0], asked, strict=True):
            dress(axis, title=axis.get_title("left") + self._verdict(*tests))
        last = rows[-1]
        for axis in last[: 1 + bool(inputs)]:
            axis.set_xlabel("lag in samples (–)")
        if self.by_phase is not None:
            last[-1].set_xlabel("ψ (deg)")
        handles = [self.lines_[shown[0], i] for i in inputs] if len(inputs) > 1 else []
        if self.by_phase is not None:
            handles += last[-1].get_legend_handles_labels()[0]
        self.legend_ = panels.legend(handles, fallback=1) if handles else None
        return self

    def _verdict(self, *tests):
        """Which of some tests fail, or that all pass; they are of all outputs together."""
        asked = self.tests.loc[[name for name in tests if name in self.tests.index]]
        failed = asked.loc[~asked["passed"], "p_value"]
        lines = [f"{name}: p = {number(p, 1)}" for name, p in failed.items()]
        word = "not noise" if lines else f"noise (p = {number(asked['p_value'].min(), 1)})"
        whose = "\nall outputs: " if len(self.autocorrelation.columns) > 1 else ": "
        return whose + "\n".join([word, *lines]) if len(asked) else ""

    def _draw_own(self, name, axis):
        values = self.autocorrelation[name]
        self._shade(axis, self.bands[name])
        self.bars_[name] = axis.bar(values.index, values, 0.5, color=BLUE)
        what = "prediction errors" if self.predicts else "simulation errors"
        dress(axis, y=f"{name}: autocorrelation", title=what)

    def _draw_inputs(self, name, inputs, axis):
        self._shade(axis, max(self.bands[name, i] for i in inputs))
        axis.axvline(0.0, color=GREY, lw=0.8)
        for i, look in zip(inputs, looks(POINTS, len(inputs)), strict=True):
            values = self.cross_correlation[name, i]
            style = look | {"ms": 3.0, "lw": 0.8, "label": f"input {i}"}
            self.lines_[name, i] = axis.plot(values.index, values, **style)[0]
        words = f"with {inputs[0]}" if len(inputs) == 1 else "with the inputs"
        dress(axis, y=f"{name}: correlation", title=words)

    def _draw_phases(self, name, axis, units):
        mean, std = self.by_phase[name, "mean"], self.by_phase[name, "std"]
        psi, n = self.by_phase.index.to_numpy(), self.n_rows / len(self.by_phase)
        reach = BAND_REACH * std / np.sqrt(n)
        axis.axhline(0.0, color=GREY, lw=0.8)
        style = {"color": BLUE, "alpha": 0.25, "lw": 0, "label": f"its {BAND:.0%} interval"}
        axis.fill_between(psi, mean - reach, mean + reach, **style)
        style = LINES[0] | {"label": "mean"}
        self.phase_lines_[name] = axis.plot(psi, mean, **style)[0]
        for sign in (-1.0, 1.0):
            axis.plot(psi, sign * std, **LINES[1] | {"label": "±std" if sign > 0.0 else None})
        dress(axis, y=with_unit(name, units), title="mean, std")
        axis.set(xlim=(0, 360), xticks=range(0, 361, 90))

    @staticmethod
    def _shade(axis, band):
        axis.axhspan(-band, band, color=GREY, alpha=0.25, lw=0)
        axis.axhline(0.0, color=GREY, lw=0.8)
        axis.margins(y=0.2)


def _correlations(left, lags):
    """Of residuals with themselves and the inputs, by lag, and the bands of both."""
    outputs, inputs = left.output_names, left.input_names
    e = [s.residuals for s in left.segments]
    mean = np.mean(np.vstack([s.inputs for s in left.segments]), axis=0)
    u = [s.inputs - mean for s in left.segments]
    both = range(-lags, lags + 1)
    R = {lag: _products(e, e, lag) for lag in both}
    U = {lag: _products(u, u, lag) for lag in both}
    crossed = {lag: _products(e, u, lag) for lag in both}
    e_size, u_size = np.sqrt(np.diag(R[0])), np.sqrt(np.diag(U[0]))
    u_size = np.where(u_size > 0.0, u_size, 1.0)
    index = pd.RangeIndex(1, lags + 1, name="lag")
    own = [np.diag(R[lag]) / e_size**2 for lag in index]
    own = pd.DataFrame(own, index, list(outputs))
    pairs = pd.MultiIndex.from_product([outputs, inputs], names=["output", "input"])
    index = pd.RangeIndex(-lags, lags + 1, name="lag")
    values = [(crossed[lag] / np.outer(e_size, u_size)).ravel() for lag in both]
    crossed = pd.DataFrame(np.reshape(values, (len(both), -1)), index, pairs)
    reach = BAND_REACH / np.sqrt(left.n_rows)
    bands = {name: float(reach) for name in outputs}
    for o, i in np.ndindex(len(outputs), len(inputs)):
        alike = sum(R[k][o, o] * U[k][i, i] for k in both) / (e_size[o] * u_size[i]) ** 2
        bands[outputs[o], inputs[i]] = float(reach * np.sqrt(max(alike, 1.0)))
    return own, crossed, bands


def _products(later, sooner, lag):
    """Σ a[k] b[k − τ]ᵀ over all segments."""
    if lag < 0:
        return _products(sooner, later, -lag).T
    pairs = zip(later, sooner, strict=True)
    return sum(a[lag:].T @ b[: max(len(b) - lag, 0)] for a, b in pairs)


def _by_phase(left):
    """Mean and standard deviation of residuals in equal parts of a turn."""
    count = max(1, min(24, int(left.samples_per_period)))
    psi = np.concatenate([s.psi for s in left.segments])
    bins = np.floor(np.mod(psi / (2.0 * np.pi) + 1e-9, 1.0) * count).astype(int) % count
    e = pd.DataFrame(np.vstack([s.residuals for s in left.segments]), columns=left.output_names)
    table = e.groupby(bins).agg(["mean", "std"])
    return table.set_index(pd.Index((table.index + 0.5) * 360.0 / count, name="psi"))
