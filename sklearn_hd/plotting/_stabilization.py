"""Modes against the order of the model: which come back at every order."""

import warnings

import numpy as np
import pandas as pd
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd._checks import check_positive
from sklearn_hd._progress import check_verbose, progress
from sklearn_hd.algorithms.reporting import stage
from sklearn_hd.plotting._eigenvalues import continuous_eigenvalues
from sklearn_hd.plotting._panels import Panels
from sklearn_hd.plotting._style import BLACK, BLUE, GREY, ORANGE, dress
from sklearn_hd.subspace import MOESPRegressor

__all__ = ["StabilizationDisplay"]

BEYOND = 4  # orders tried past the one chosen
LEFT = 1.15  # of the fastest steady decay, how far left the view reaches
STEADY = {"marker": "o", "ms": 4.5, "color": BLUE, "label": "steady: as at the order before"}
WANDERING = {"marker": "x", "ms": 4, "color": GREY, "label": "new or moved"}


class StabilizationDisplay:
    """Modes of models of growing order: genuine ones come back, others wander.

    A mode of order n is steady if the order tried before has one at a distance of at most
    ``tol`` times the size of λ. Copies λ + jpω that the analyzer makes are steady, too.

    Parameters
    ----------
    modes : DataFrame
        One row a mode of a model: the columns order, eigenvalue (1/s) and steady.
    order : int, optional
        The order chosen.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (2,)
        Frequency, and decay.
    figure_ : Figure
    steady_, wandering_ : list of Line2D
        In each panel.
    chosen_ : list of Line2D

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

    def __init__(self, modes, *, order=None):
        self.modes = modes
        self.order = order

    @classmethod
    def from_data(cls, X, y, *, orders=None, tol=0.02, ax=None, verbose=0, **parameters):
        """Identify models of several orders by :class:`~sklearn_hd.MOESPRegressor`.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Inputs, plain or as HarmonicAnalyzer hands them on.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time.
        orders : sequence of int, optional
            From 1 to four beyond the order found at first by default.
        tol : float, default=0.02
            Share of its size by which a steady mode may differ from the order before.
        ax : Axes or array of Axes, optional
            Two Axes, or one that is divided.
        verbose : int, default=0
            1 shows a progress bar, in terminals and notebooks only.
        **parameters
            Of MOESPRegressor.

        Returns
        -------
        display : StabilizationDisplay
            Drawn; what it draws stands in its attributes.
        """
        estimator = MOESPRegressor(**parameters)
        return cls.from_estimator(estimator, X, y, orders=orders, tol=tol, ax=ax, verbose=verbose)

    @classmethod
    def from_estimator(cls, estimator, X, y, *, orders=None, tol=0.02, ax=None, verbose=0):
        """Fit clones of an estimator at several orders.

        Parameters
        ----------
        estimator : MOESPRegressor, or Pipeline, search or step that holds one
            Fitted or not. A clone is fitted once as it is, for its order and block rows;
            warnings are those of this fit.
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Inputs, as the estimator takes them.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time.
        orders : sequence of int, optional
            From 1 to four beyond the order of the estimator by default.
        tol : float, default=0.02
            Share of its size by which a steady mode may differ from the order before.
        ax : Axes or array of Axes, optional
            Two Axes, or one that is divided.
        verbose : int, default=0
            1 shows a progress bar, in terminals and notebooks only.

        Returns
        -------
        display : StabilizationDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If there is no MOESPRegressor.
        ValueError
            If an order cannot be identified from these data.
        """
        tol = check_positive("tol", tol, "shares of |λ|", "0.02 is usual")
        check_verbose(verbose)
        identifier, X = _identifier(estimator, X, y)
        first = clone(identifier).fit(X, y)
        block_rows, n_outputs = first.block_rows_, len(first.model_.output_names)
        if orders is None:
            orders = range(1, min(first.order_ + BEYOND, (block_rows - 1) * n_outputs) + 1)
        found, orders = {}, sorted(orders)
        with warnings.catch_warnings(), progress(verbose) as report:
            warnings.simplefilter("ignore", UserWarning)  # what the first fit said
            told = stage(report, "orders", len(orders))
            for n in orders:
                model = clone(identifier).set_params(order=n, block_rows=block_rows).fit(X, y)
                found[n] = continuous_eigenvalues(model.model_)
                if told is not None:
                    told(len(found), f"order {n}")
        return cls(_table(found, tol), order=first.order_).plot(ax=ax)

    def plot(self, ax=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        ax : Axes or array of Axes, optional
            Two Axes, or one that is divided.

        Returns
        -------
        display : StabilizationDisplay
            Drawn; what it draws stands in its attributes.
        """
        orders = sorted(set(self.modes["order"]))
        height = min(8.0, max(3.6, 1.6 + 0.22 * len(orders)))
        names = "frequency, and decay"
        panels = Panels(ax, [(0, 0), (0, 1)], size=(8.0, height), share_y="all", names=names)
        self.axes_, self.figure_ = panels.axes, panels.figure
        upper = self.modes[[z.imag >= 0.0 for z in self.modes["eigenvalue"]]]
        steady, others = upper[upper["steady"]], upper[~upper["steady"]]
        self.steady_, self.wandering_, self.chosen_ = [], [], []
        for axis, part in zip(self.axes_, ("imag", "real"), strict=True):
            for modes, lines, style in (
                (others, self.wandering_, WANDERING),
                (steady, self.steady_, STEADY),
            ):
                values = [getattr(z, part) for z in modes["eigenvalue"]]
                lines += axis.plot(values, modes["order"].to_numpy(), ls="", **style)
            if self.order is not None:
                label = f"order chosen: {self.order}"
                self.chosen_.append(axis.axhline(self.order, color=ORANGE, lw=1.2, label=label))
        dress(self.axes_[0], x="frequency |Im λ| (rad/s)", y="order of the model (–)")
        dress(self.axes_[1], x="decay Re λ (1/s)")
        if panels.own:
            self.axes_[1].tick_params(labelleft=False)
        self.axes_[0].yaxis.get_major_locator().set_params(integer=True)
        self._limit_decay(steady)
        self.axes_[1].axvline(0.0, color=BLACK, lw=0.8, zorder=0.5)
        panels.legend()
        return self

    def _limit_decay(self, steady):
        """The view of decays: as far left as steady modes are, for memory may die at once."""
        if len(steady) == 0:
            return
        real = np.array([z.real for z in steady["eigenvalue"]])
        size = np.abs(real).max()
        self.axes_[1].set_xlim(
            min(real.min(), 0.0) * LEFT - 0.05 * size, max(real.max(), 0.0) + 0.15 * size
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


def _table(found, tol):
    """Modes of all orders; steady ones have a mode near at the order before."""
    rows, before = [], np.zeros(0)
    for order, z in found.items():
        gap = np.abs(z[:, None] - before[None, :]).min(axis=1, initial=np.inf)
        steady = gap <= tol * np.abs(z)
        rows += [(order, *row) for row in zip(z, steady, strict=True)]
        before = z
    table = pd.DataFrame(rows, columns=["order", "eigenvalue", "steady"])
    return table.astype({"steady": bool})
