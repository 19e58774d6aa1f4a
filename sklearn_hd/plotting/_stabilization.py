"""Modes of models of growing order: the stabilization diagram, and what is picked from it."""

import warnings
from dataclasses import KW_ONLY, dataclass

import numpy as np
import pandas as pd
from scipy.signal import welch
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd._checks import check_positive
from sklearn_hd._guards import candidates
from sklearn_hd._records.data import read_experiment
from sklearn_hd.algorithms.linalg.rounding import TINY
from sklearn_hd.algorithms.lti.simulation import continuous_poles
from sklearn_hd.plotting._display import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    Display,
    by_segment,
    dress,
)
from sklearn_hd.subspace import MOESPRegressor

MARKS = {  # what is as at the order before: marker, size, colour, words
    "none": ("x", 4.0, GREY, "new or moved"),
    "frequency": ("D", 4.0, SKY, "steady: frequency only"),
    "frequency and damping": ("s", 4.5, PURPLE, "steady: frequency, damping"),
    "frequency and shape": ("^", 5.5, GREEN, "steady: frequency, shape"),
    "all": ("o", 5.0, BLUE, "steady: frequency, damping, shape"),
}


@dataclass(eq=False, repr=False)
class StabilizationDisplay(Display, axes="two Axes, of frequency and of decay"):
    """Modes of models of growing order: genuine ones come back, others wander.

    A mode λ is compared with the nearest one, λ′, of the order tried before:

        |Δω_n| ≤ tol ω_n′,   |Δζ| ≤ tol |ζ′|,   1 − MAC ≤ tol,
        MAC = |φᴴ φ′|² / (φᴴφ · φ′ᴴφ′),   ω_n = |λ|,   ζ = −Re λ / |λ|

    where φ = C v is the shape that the outputs show, each in units of its standard deviation.
    The shape of a single output is always the same, and a model that varies over the turn has no
    one shape: there, two comparisons decide. Copies λ + jpω that the analyzer makes are
    steady, too.

    Parameters
    ----------
    modes : DataFrame
        One row a mode of a model: the columns order, eigenvalue (1/s), and the bools
        frequency_steady, damping_steady, shape_steady; steady where all are.
    order : int, optional
        The order chosen.
    spectrum : Series, optional
        Power density of the outputs to which models are fitted, each divided by its variance,
        summed; by frequency in rad/s.

    Attributes
    ----------
    picked_ : DataFrame
        The modes clicked on in an interactive window: order, eigenvalue, frequency (``|λ|``, rad/s)
        and damping_ratio. A second click takes a mode away. Keep the display in a variable:
        clicks are lost with it.
    axes_ : ndarray of Axes, shape (2,)
        Frequency, and decay.
    figure_ : Figure
    points_ : dict of list of Line2D
        In each panel, by what is steady: "all", "frequency and damping", "frequency and shape",
        "frequency" or "none".
    steady_, wandering_ : list of Line2D
        Those of "all" and "none".
    chosen_ : list of Line2D
    spectrum_line_ : Line2D or None
        On an axis of its own, in the panel of frequency.
    picks_ : list of Line2D
        Rings round the modes picked.

    References
    ----------
    Peeters, De Roeck (1999), Reference-based stochastic subspace identification for
    output-only modal analysis, Mechanical Systems and Signal Processing 13(6), 855-878.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.standard_normal((300, 1)), np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> y += 0.01 * rng.standard_normal((300, 1))
    >>> display = StabilizationDisplay.from_data(u, y, orders=[1, 2, 3], block_rows=5)
    >>> bool(display.modes.query("steady and order == 3")["eigenvalue"].size >= 1)
    True
    """

    modes: pd.DataFrame
    _: KW_ONLY
    order: int | None = None
    spectrum: pd.Series | None = None

    @classmethod
    def from_data(
        cls,
        X,
        y,
        *,
        orders=None,
        frequency_tol=0.01,
        damping_tol=0.05,
        shape_tol=0.02,
        ax=None,
        **parameters,
    ):
        """Identify models of several orders by :class:`~sklearn_hd.MOESPRegressor`.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Inputs, plain or as HarmonicAnalyzer hands them on.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time.
        orders : sequence of int, optional
            From 1 to four beyond the order found at first by default.
        frequency_tol, damping_tol : float, default=0.01 and 0.05
            Share by which the natural frequency and the damping ratio of a steady mode may
            differ from those at the order before.
        shape_tol : float, default=0.02
            How far the modal assurance criterion (MAC) of a steady shape may be from one.
        **parameters
            Of MOESPRegressor.
        """
        estimator = MOESPRegressor(**parameters)
        tolerances = {
            "frequency_tol": frequency_tol,
            "damping_tol": damping_tol,
            "shape_tol": shape_tol,
        }
        return cls.from_estimator(estimator, X, y, orders=orders, ax=ax, **tolerances)

    @classmethod
    def from_estimator(
        cls,
        estimator,
        X,
        y,
        *,
        orders=None,
        frequency_tol=0.01,
        damping_tol=0.05,
        shape_tol=0.02,
        ax=None,
    ):
        """Fit clones of an estimator at several orders.

        Parameters
        ----------
        estimator : MOESPRegressor, or Pipeline, search or step that holds one
            Fitted or not. A clone is fitted once as it is, for its order and block rows;
            warnings are those of this fit.
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Inputs, as the estimator takes them.
        orders : sequence of int, optional
            From 1 to four beyond the order of the estimator by default.

        Raises
        ------
        TypeError
            If there is no MOESPRegressor.
        ValueError
            If an order cannot be identified from these data.
        """
        tolerances = (
            check_positive("frequency_tol", frequency_tol, "shares of |λ|", "0.01 is usual"),
            check_positive("damping_tol", damping_tol, "shares of ζ", "0.05 is usual"),
            check_positive("shape_tol", shape_tol, "1 − MAC", "0.02 is usual"),
        )
        identifier, X = _identifier(estimator, X, y)
        first = clone(identifier).fit(X, y)
        block_rows, n_outputs = first.block_rows_, len(first.model_.output_names)
        if orders is None:
            orders = range(1, min(first.order_ + 4, (block_rows - 1) * n_outputs) + 1)
        experiment = read_experiment(X, y)
        signals = by_segment(experiment, experiment.outputs, list(experiment.output_names))
        sizes = signals.std()
        found, orders = {}, sorted(set(orders))
        with warnings.catch_warnings(), candidates():
            warnings.simplefilter("ignore", UserWarning)  # what the first fit said
            for n in orders:
                model = clone(identifier).set_params(order=n, block_rows=block_rows).fit(X, y)
                found[n] = _modes_of(model.model_, sizes)
        modes = _table(found, tolerances)
        return cls(modes, order=first.order_, spectrum=_spectrum(signals)).plot(ax=ax)

    def plot(self, ax=None):
        """Draw, on a new figure by default."""
        orders = sorted(set(self.modes["order"]))
        height = min(8.0, max(3.6, 1.6 + 0.22 * len(orders)))
        panels = self._panels(ax, (8.0, height), [(0, 0), (0, 1)], share_y="all")
        upper = self.modes[self.modes["eigenvalue"].to_numpy(complex).imag >= 0.0]
        told = _told(upper)
        self.points_, self.chosen_ = {}, []
        self._rows, self.picks_ = {}, []
        self.picked_ = _picked(self.modes.loc[[]])
        for axis, part in zip(self.axes_, ("imag", "real"), strict=True):
            for what, (marker, size, colour, words) in MARKS.items():
                modes = upper[told == what]
                values = getattr(modes["eigenvalue"].to_numpy(complex), part)
                style = {"marker": marker, "ms": size, "color": colour, "ls": "", "label": words}
                (line,) = axis.plot(values, modes["order"].to_numpy(), picker=6, **style)
                self.points_.setdefault(what, []).append(line)
                self._rows[line] = modes.index
            if self.order is not None:
                label = f"order chosen: {self.order}"
                self.chosen_.append(axis.axhline(self.order, color=ORANGE, lw=1.2, label=label))
        dress(self.axes_[0], x="frequency |Im λ| (rad/s)", y="order of the model (–)")
        dress(self.axes_[1], x="decay Re λ (1/s)")
        if panels.own:
            self.axes_[1].tick_params(labelleft=False)
        self.axes_[0].yaxis.get_major_locator().set_params(integer=True)
        self.steady_, self.wandering_ = self.points_["all"], self.points_["none"]
        self._limit_decay(upper[told == "all"])
        self.spectrum_line_ = None if self.spectrum is None else self._draw_spectrum()
        self.axes_[1].axvline(0.0, color=BLACK, lw=0.8, zorder=0.5)
        handles = [
            line for lines in self.points_.values() for line in lines[:1] if len(line.get_xdata())
        ]
        handles += [*self.chosen_[:1], *filter(None, [self.spectrum_line_])]
        self.legend_ = panels.legend(handles, columns=3)
        self._connection = self.figure_.canvas.mpl_connect("pick_event", self._pick)
        return self

    def _draw_spectrum(self):
        """The spectrum of the outputs on an axis of its own, beneath the modes."""
        axis, beneath = self.axes_[0], self.axes_[0].twinx()
        axis.set_zorder(beneath.get_zorder() + 1)
        axis.patch.set_visible(False)
        limits = axis.get_xlim()
        shown = self.spectrum[(self.spectrum > 0.0) & (self.spectrum.index <= limits[1])]
        style = {"color": GREY, "lw": 1.0, "alpha": 0.8, "label": "spectrum of the outputs"}
        (line,) = beneath.semilogy(shown.index, shown.to_numpy(), **style)
        axis.set_xlim(limits)
        beneath.set_ylabel("spectrum, in variances (s/rad)", color=GREY, fontsize=9)
        beneath.tick_params(axis="y", which="both", colors=GREY, labelsize=8)
        beneath.spines[["top", "left"]].set_visible(False)
        return line

    def _pick(self, event):
        """Take a mode that was clicked on, or take it away."""
        if event.artist not in self._rows:
            return
        row = self._rows[event.artist][event.ind[0]]
        rows = list(self.picked_.index)
        rows = [r for r in rows if r != row] if row in rows else [*rows, row]
        self.picked_ = _picked(self.modes.loc[rows])
        for ring in self.picks_:
            ring.remove()
        z, orders = self.picked_["eigenvalue"].to_numpy(complex), self.picked_["order"].to_numpy()
        style = {"color": RED, "marker": "o", "ms": 11, "mfc": "none", "mew": 1.6, "ls": ""}
        self.picks_ = [
            axis.plot(getattr(z, part), orders, **style)[0]
            for axis, part in zip(self.axes_, ("imag", "real"), strict=True)
        ]
        self.figure_.canvas.draw_idle()

    def _limit_decay(self, steady):
        """The view of decays: as far left as steady modes are, for memory may die at once."""
        if len(steady) == 0:
            return
        real = steady["eigenvalue"].to_numpy(complex).real
        size = np.abs(real).max()
        self.axes_[1].set_xlim(
            min(real.min(), 0.0) * 1.15 - 0.05 * size, max(real.max(), 0.0) + 0.15 * size
        )


def _identifier(estimator, X, y):
    """The MOESPRegressor of an estimator, and X as the steps before it hand it on."""
    if isinstance(estimator, MOESPRegressor):
        return estimator, X
    if isinstance(estimator, Pipeline):
        for k, (_, step) in enumerate(estimator.steps):
            if any(isinstance(part, MOESPRegressor) for part in _inside(step)):
                head = estimator[:k]
                return _identifier(step, clone(head).fit_transform(X, y) if k else X, y)
    elif getattr(estimator, "best_estimator_", None) is not None:
        return _identifier(estimator.best_estimator_, X, y)
    elif getattr(estimator, "estimator", None) is not None:
        return _identifier(estimator.estimator, X, y)
    raise TypeError(
        f"StabilizationDisplay needs a MOESPRegressor, or a Pipeline or search that holds one; "
        f"{type(estimator).__name__} holds none"
    )


def _inside(step):
    """An estimator and those that it holds."""
    while step is not None:
        yield step
        if isinstance(step, Pipeline):
            for _, part in step.steps:
                yield from _inside(part)
        step = getattr(step, "estimator", None)


def _modes_of(model, sizes):
    """Eigenvalues of a model, and the shapes that its outputs show; None where there is no one."""
    A, C = getattr(model, "A", None), getattr(model, "C", None)
    if A is None or np.ndim(C) != 2 or len(C) < 2:
        return model.exponents(), None
    z, vectors = np.linalg.eig(A)
    names = [n if n in sizes else n.rsplit("_", 1)[0] for n in model.output_names]
    scale = sizes.reindex(names).to_numpy()
    return continuous_poles(z, model.dt), C @ vectors / np.where(scale > 0.0, scale, 1.0)[:, None]


def _table(found, tolerances):
    """Modes of all orders, each compared with the nearest one of the order before."""
    within_frequency, within_damping, within_shape = tolerances
    rows, before, old = [], np.zeros(0), None
    for order, (z, shapes) in found.items():
        for k, value in enumerate(z):
            same = [False] * 3
            if len(before):
                j = int(np.abs(value - before).argmin())
                other, size = before[j], abs(before[j])
                damping, earlier = (-w.real / max(abs(w), TINY) for w in (value, other))
                same = [
                    abs(abs(value) - size) <= within_frequency * size,
                    abs(damping - earlier) <= within_damping * abs(earlier),
                    shapes is None
                    or old is None
                    or 1.0 - _assurance(shapes[:, k], old[:, j]) <= within_shape,
                ]
            rows.append((order, value, *same, all(same)))
        before, old = z, shapes
    told = ["frequency_steady", "damping_steady", "shape_steady", "steady"]
    table = pd.DataFrame(rows, columns=["order", "eigenvalue", *told])
    return table.astype(dict.fromkeys(told, bool))


def _assurance(shape, other):
    """Modal assurance criterion of two shapes; of none at all, zero."""
    sizes = np.vdot(shape, shape).real * np.vdot(other, other).real
    return abs(np.vdot(shape, other)) ** 2 / sizes if sizes > 0.0 else 0.0


def _told(modes):
    """What is steady of each mode, in words; no more counts where the frequency moved."""
    frequency, damping, shape = (
        modes[f"{what}_steady"].to_numpy(bool) for what in ("frequency", "damping", "shape")
    )
    words = ["all", "frequency and damping", "frequency and shape", "frequency"]
    cases = [frequency & damping & shape, frequency & damping, frequency & shape, frequency]
    return np.select(cases, words, "none")


def _picked(modes):
    """Modes as a table to work on."""
    z = modes["eigenvalue"].to_numpy(complex)
    table = modes[["order", "eigenvalue"]].copy()
    table["frequency"] = np.abs(z)
    table["damping_ratio"] = -z.real / np.maximum(np.abs(z), TINY)
    return table


def _spectrum(signals):
    """Power density of outputs, in variances, against rad/s; None where they are short."""
    size, total, rows = signals.std().to_numpy(), 0.0, 0
    segments = [part.droplevel(0) for _, part in signals.groupby(level=0)]
    length = min(512, max(map(len, segments)))
    for part in segments:
        if len(part) < length or length < 8:
            continue
        step = float(np.median(np.diff(part.index)))
        scaled = part.to_numpy() / np.where(size > 0.0, size, 1.0)
        hertz, power = welch(scaled, 1.0 / step, nperseg=length, axis=0)
        total, rows = total + len(part) * power.sum(axis=1), rows + len(part)
    if not rows:
        return None
    return pd.Series(total / rows / (2.0 * np.pi), index=2.0 * np.pi * hertz, name="spectrum")
