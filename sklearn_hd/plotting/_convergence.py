"""How the match of a structure went on, iteration by iteration."""

from itertools import groupby

import numpy as np

from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.plotting._fitted import fitted_step
from sklearn_hd.plotting._panels import one_axes
from sklearn_hd.plotting._style import LEGEND, POINTS, dress, looks, number

__all__ = ["ConvergenceDisplay"]

COLUMNS = ("stage", "error")
DEPTH = 1e-2  # below the smallest error that is not zero, where zeros are drawn


class ConvergenceDisplay:
    """Error of a match by iteration, its stages told apart.

    Parameters
    ----------
    history : DataFrame, shape (n_iterations, 2)
        ``history_`` of a StructuredMatcher: the columns stage (text) and error (relative,
        in the norm that the stage minimises), by iteration.

    Attributes
    ----------
    ax_ : Axes
    figure_ : Figure
    lines_ : dict of list of Line2D
        Of each stage; one line a run of it.
    end_ : Text
        Says the last error.

    Raises
    ------
    ValueError
        If a column is missing, or the history is empty.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 22.

    Examples
    --------
    >>> import pandas as pd
    >>> history = pd.DataFrame(
    ...     {"stage": ["least squares"] * 2 + ["H-infinity"] * 2, "error": [1, 0.1, 0.08, 0.05]}
    ... )
    >>> display = ConvergenceDisplay(history).plot()
    >>> list(display.lines_)
    ['least squares', 'H-infinity']
    """

    def __init__(self, history):
        missing = [name for name in COLUMNS if name not in getattr(history, "columns", ())]
        if missing:
            raise ValueError(
                f"history lacks the column {missing[0]!r}; give a DataFrame with the columns "
                f"{list(COLUMNS)}, as StructuredMatcher.history_"
            )
        if len(history) == 0:
            raise ValueError(
                "history is empty: nothing was minimised, as where the match is exact or in closed "
                "form"
            )
        self.history = history

    @classmethod
    def from_estimator(cls, estimator, *, ax=None):
        """Draw the history of a fitted matcher.

        Parameters
        ----------
        estimator : StructuredMatcher, or Pipeline or search that holds one
            Fitted.
        ax : Axes, optional
            Those of a new figure by default.

        Returns
        -------
        display : ConvergenceDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If there is no StructuredMatcher.
        NotFittedError
            If it has not been fitted.
        ValueError
            If nothing was minimised.
        """
        return cls(fitted_step(estimator, StructuredMatcher, cls.__name__).history_).plot(ax=ax)

    def plot(self, ax=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        ax : Axes, optional
            Those of a new figure by default.

        Returns
        -------
        display : ConvergenceDisplay
            Drawn; what it draws stands in its attributes.
        """
        panels = one_axes(ax, (6.4, 4.0))
        self.figure_, self.ax_ = panels.figure, panels.axes[0]
        error = self.history["error"].to_numpy(dtype=float)
        iteration = self.history.index.to_numpy()
        stages = self.history["stage"].astype(str).tolist()
        names = list(dict.fromkeys(stages))
        styles = dict(zip(names, looks(POINTS, len(names)), strict=True))
        self.lines_ = {name: [] for name in names}
        drawn, start = _above_zero(error), 0
        for name, run in groupby(stages):
            stop = start + len(list(run))
            label = None if self.lines_[name] else name
            span = slice(start, stop)  # not joined: each stage has a norm of its own
            style = styles[name] | {"ms": 5, "lw": 1.3, "label": label}
            self.lines_[name] += self.ax_.semilogy(iteration[span], drawn[span], **style)
            start = stop
        self.end_ = self.ax_.annotate(
            number(error[-1]),
            (iteration[-1], drawn[-1]),
            xytext=(6, 0),
            textcoords="offset points",
            va="center",
            fontsize=9,
        )
        dress(self.ax_, x="iteration (–)", y="relative error, in the norm of the stage (–)")
        self.ax_.xaxis.get_major_locator().set_params(integer=True)
        self.ax_.margins(x=0.08)
        self.ax_.legend(**LEGEND)
        return self


def _above_zero(error):
    """Errors as a logarithmic axis can show them: zeros well below the others."""
    positive = error[error > 0.0]
    least = positive.min() * DEPTH if len(positive) else np.finfo(float).eps
    return np.maximum(error, least)
