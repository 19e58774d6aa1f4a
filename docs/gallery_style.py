"""One look for the figures of the examples that draw their own: that of the displays."""

import matplotlib as mpl
from cycler import cycler

from sklearn_hd.plotting import _display as looks


def apply(gallery_conf, fname):
    """Before each example, after matplotlib was reset: colours, grid, letters, frame."""
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
