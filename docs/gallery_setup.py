"""What holds before each example: the look of its figures, and which warnings are errors."""

import warnings

import matplotlib as mpl
from cycler import cycler

from sklearn_hd import exceptions
from sklearn_hd.plotting import _display as looks


def before_each(gallery_conf, fname):
    """After matplotlib was reset: colours, grid, letters and frame are those of the displays.

    An example that warns must say so itself.
    """
    for category in vars(exceptions).values():
        if isinstance(category, type) and issubclass(category, Warning):
            warnings.simplefilter("error", category)
    mpl.rcParams.update(
        {
            "axes.prop_cycle": cycler(color=[style["color"] for style in looks.LINES]),
            "axes.grid": True,
            "axes.axisbelow": True,
            "grid.color": looks.LIGHT,
            "grid.linewidth": 0.6,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.titlesize": 10.5,
            "axes.titlelocation": "left",
            "legend.fontsize": looks.LEGEND["fontsize"],
            "legend.edgecolor": looks.LEGEND["edgecolor"],
            "legend.framealpha": looks.LEGEND["framealpha"],
            "lines.linewidth": 1.5,
        }
    )
