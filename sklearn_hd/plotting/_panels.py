"""Axes to draw on: a new figure's, one given, or a given one divided into panels."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec, GridSpecFromSubplotSpec

from sklearn_hd.plotting._style import LEGEND


class Panels:
    """The panels of a display.

    Parameters
    ----------
    ax : Axes, array of Axes or None
        None makes a figure; one Axes is divided where more than one panel is
        needed; an array holds one Axes a panel.
    cells : list of (int, int)
        Row and column of each panel.
    size : (float, float)
        Of a new figure, inches.
    heights, widths : sequence of float, optional
        Of rows and columns, relative.
    share_x, share_y : "all", "column", "row", "stack" or None
        Which panels have one axis; ``"stack"`` is those of a column without a row between.

    Attributes
    ----------
    axes : ndarray of Axes, shape (n_panels,)
    figure : Figure
    own : bool
        Whether the figure was made here.
    """

    def __init__(
        self, ax, cells, *, size, heights=None, widths=None, share_x=None, share_y=None, names=None
    ):
        self.own = ax is None
        if ax is None:
            import matplotlib.pyplot as plt

            self.figure = plt.figure(figsize=size, layout="constrained")
            self.axes = self._divide(None, cells, heights, widths, share_x, share_y)
            return
        given = np.asarray(ax, dtype=object).ravel()
        wrong = [item for item in given if not isinstance(item, Axes)]
        if wrong:
            raise TypeError(
                f"ax={wrong[0]!r} is no matplotlib Axes; give one, an array of {len(cells)}, or "
                f"None for a new figure"
            )
        self.figure = given[0].figure
        if len(given) == len(cells):
            self.axes = given
        elif len(given) == 1:
            self.axes = self._divide(given[0], cells, heights, widths, share_x, share_y)
        else:
            raise ValueError(
                f"ax holds {len(given)} Axes, but {len(cells)} panels are drawn"
                f"{'' if names is None else f' ({names})'}; give {len(cells)}, or one to be divided"
            )

    def _divide(self, ax, cells, heights, widths, share_x, share_y):
        shape = tuple(1 + max(place) for place in zip(*cells, strict=True))
        ratios = {"height_ratios": heights, "width_ratios": widths}
        if ax is None:
            grid = GridSpec(*shape, figure=self.figure, **ratios)
        elif ax.get_subplotspec() is None:
            raise ValueError(
                f"this Axes stands in no grid of subplots and cannot be divided into the "
                f"{len(cells)} panels needed; make it with plt.subplots, or give {len(cells)} Axes"
            )
        else:
            ax.set_axis_off()
            grid = GridSpecFromSubplotSpec(*shape, subplot_spec=ax.get_subplotspec(), **ratios)
        axes = []
        for place in cells:
            shared = {
                "sharex": _partner(share_x, place, cells, axes),
                "sharey": _partner(share_y, place, cells, axes),
            }
            axes.append(self.figure.add_subplot(grid[place], **shared))
        for ax_, place in zip(axes, cells, strict=True):
            below = {"all": 1, "column": 1}.get(share_x)
            if below and any(c == place[1] and r > place[0] for r, c in cells):
                ax_.tick_params(labelbottom=False)
        return np.array(axes, dtype=object)

    def legend(self, handles=None, *, columns=4, fallback=0):
        """One legend for all panels: below them, or in one of them where the figure is given."""
        if handles is None:
            handles = self.axes[fallback].get_legend_handles_labels()[0]
        if not handles:
            return None
        options = {"handles": handles, **LEGEND}
        if not self.own:
            return self.axes[fallback].legend(**options)
        for count in range(min(columns, len(handles)), 0, -1):  # as many as the figure is wide
            legend = self.figure.legend(loc="outside lower center", ncols=count, **options)
            if count == 1 or legend.get_window_extent().width <= self.figure.bbox.width:
                return legend
            legend.remove()


def _partner(share, place, cells, axes):
    """The first Axes made with which the one at some place shares an axis."""
    keep = {
        "all": lambda other: True,
        "column": lambda other: other[1] == place[1],
        "row": lambda other: other[0] == place[0],
    }.get(share, lambda other: False)
    made = zip(cells, axes, strict=False)
    return next((ax for other, ax in made if keep(other)), None)


def one_axes(ax, size):
    """Panels of a display that draws on a single Axes."""
    return Panels(ax, [(0, 0)], size=size)


def grid_of(count, *, most=None):
    """Rows and columns for some panels: a stack of up to three, then two, three, four columns."""
    if most is None:
        most = 1 if count <= 3 else 2 if count <= 8 else 3
    columns = min(most, count)
    return math.ceil(count / columns), columns


def places(count, columns):
    """Places of some panels in a grid, row by row."""
    return [divmod(k, columns) for k in range(count)]
