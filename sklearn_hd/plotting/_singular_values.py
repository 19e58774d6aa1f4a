"""Singular values of subspace identification: the gap, the noise floor, the order chosen."""

import numpy as np

from sklearn_hd.plotting._fitted import fitted_step
from sklearn_hd.plotting._panels import one_axes
from sklearn_hd.plotting._style import BLUE, GREY, LEGEND, ORANGE, RED, dress, number
from sklearn_hd.subspace import MOESPRegressor

__all__ = ["SingularValueDisplay"]


class SingularValueDisplay:
    """Singular values that the order of a model is read from.

    An exact record of a system of order n leaves n values above the noise floor; the
    widest gap σ_n / σ_n+1 is where ``order="auto"`` cuts.

    Parameters
    ----------
    singular_values : array_like, shape (n_values,)
        Descending.
    order : int
        The order chosen.
    noise_floor : float, optional
        Largest value that rounding or white noise would give.

    Attributes
    ----------
    ax_ : Axes
    figure_ : Figure
    kept_, left_out_ : Line2D
        The values up to the order chosen, and beyond.
    floor_ : Line2D or None
    gap_ : Line2D
        After the order chosen; its label says how wide the gap is.
    marks_ : dict of Line2D
        Further orders marked, by label.

    References
    ----------
    Verhaegen (1994), Automatica 30(1), 61-74.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn_hd import MOESPRegressor
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.standard_normal((300, 1)), np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> model = MOESPRegressor(block_rows=5).fit(u, y + 0.01 * rng.standard_normal((300, 1)))
    >>> display = SingularValueDisplay.from_estimator(model)
    >>> display.order
    1
    """

    def __init__(self, singular_values, order, noise_floor=None):
        self.singular_values = np.asarray(singular_values, dtype=float)
        self.order = order
        self.noise_floor = noise_floor

    @classmethod
    def from_estimator(cls, estimator, *, count=30, marks=None, ax=None):
        """Draw the singular values of a fitted model.

        Parameters
        ----------
        estimator : MOESPRegressor, or Pipeline or search that holds one
            Fitted.
        count : int, default=30
            Largest number of values drawn; the one after the order always is.
        marks : dict, optional
            Further orders to mark, by label: ``{"paper": 7}``.
        ax : Axes, optional
            Those of a new figure by default.

        Returns
        -------
        display : SingularValueDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If there is no MOESPRegressor.
        NotFittedError
            If it has not been fitted.
        ValueError
            If the record was too short for singular values (a static gain).
        """
        step = fitted_step(estimator, MOESPRegressor, cls.__name__)
        display = cls(step.singular_values_, step.order_, step.noise_floor_)
        return display.plot(count=count, marks=marks, ax=ax)

    def plot(self, ax=None, *, count=30, marks=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        ax : Axes, optional
            Those of a new figure by default.
        count : int, default=30
            Largest number of values drawn; the one after the order always is.
        marks : dict, optional
            Further orders to mark, by label.

        Returns
        -------
        display : SingularValueDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        ValueError
            If no singular value is positive.
        """
        values = self.singular_values[: max(count, self.order + 1)]
        if not np.any(values > 0.0):
            raise ValueError(
                "there are no singular values to draw: the record was too short for any "
                "dynamics, or is zero; use a longer one"
            )
        panels = one_axes(ax, (6.4, 4.0))
        self.figure_, self.ax_ = panels.figure, panels.axes[0]
        ax, n = self.ax_, np.arange(1, len(values) + 1)
        positive, kept = values > 0.0, n <= self.order
        inside, outside = positive & kept, positive & ~kept
        style = {"ls": "", "ms": 6}
        (self.kept_,) = ax.semilogy(
            n[inside], values[inside], "o", color=BLUE, label=f"order {self.order}", **style
        )
        (self.left_out_,) = ax.semilogy(
            n[outside], values[outside], "o", color=GREY, mfc="white", label="left out", **style
        )
        self.floor_ = None
        if self.noise_floor is not None and self.noise_floor > 0.0:
            floor = {"color": RED, "ls": "--", "lw": 1.2, "label": "noise floor"}
            self.floor_ = ax.axhline(self.noise_floor, **floor)
        self.gap_ = ax.axvline(self.order + 0.5, color=BLUE, lw=1, label=self._gap(values))
        self.marks_ = {
            label: ax.axvline(order + 0.5, color=ORANGE, ls=":", lw=1.8, label=f"{label}: {order}")
            for label, order in (marks or {}).items()
        }
        dress(ax, x="number (–)", y="singular value (scaled outputs)")
        ax.set_xlim(0, len(values) + 1)
        ax.legend(loc="upper right", **LEGEND)
        return self

    def _gap(self, values):
        """Width of the gap, in words."""
        if not 0 < self.order < len(values) or values[self.order] <= 0.0:
            return "order chosen"
        return f"gap ×{number(values[self.order - 1] / values[self.order])}"
