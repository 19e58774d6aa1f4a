"""
Tell spurious modes from genuine ones
=====================================

Why does a system of three states come back from identification with ten, and which three are
its own?
"""

# %%
# The record
# ----------
# Signals of a model with three states: the mean of *w*, and the cosine and sine parts of *φ̇*.
# There is no noise, so nothing here is an accident.

# sphinx_gallery_thumbnail_number = 3
import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.plotting import (
    EigenvalueDisplay,
    HarmonicsDisplay,
    ResponseDisplay,
    SingularValueDisplay,
    StabilizationDisplay,
)

data = make_flapping_wing("lti-signal", n_periods=100, start=20)
kept = {"w": [0], "phi_dot": [1]}
units = {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}
HarmonicsDisplay.from_data(data.outputs, data.omega, kept, span=(0.5, 2.5), units=units)

# %%
# Ten states
# ----------
# The coefficients are read four times a wingbeat. Ten singular values stand above rounding.


def identify(window="boxcar", hop=16):
    """Steps 2 to 4."""
    steps = [
        ("harmonics", HarmonicAnalyzer(data.omega, output_harmonics=kept, window=window, hop=hop)),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
    ]
    return Pipeline(steps).fit(data.inputs, data.outputs)


pipe = identify()
SingularValueDisplay.from_estimator(pipe)

# %%
# Three are the system's own
# --------------------------
# A window adds two kinds of modes. *Copies* stand straight above and below a genuine mode, at λ +
# jpω. The *memory* of the window dies within its length, so it lies far to the left, out of view
# here. ``SpuriousModeReducer`` tells them apart by this. It knows nothing of the machine.

true = np.linalg.eigvals(data.A_exact)
EigenvalueDisplay.from_estimator(pipe, true=true)

# %%
# Every mode has a verdict, and the reason for it:

pd.options.display.max_colwidth = 80
modes = pipe["reduce"].modes_
modes.assign(eigenvalue=modes["eigenvalue"].map("{:.2f}".format))

# %%
# Does it help to look at models of growing order, as is usual in modal analysis, and to keep what
# comes back? Not here. Once there are ten states, copies come back as surely as genuine modes do.

StabilizationDisplay.from_estimator(pipe, data.inputs, data.outputs, orders=range(1, 13))

# %%
# Another window, other spurious modes
# ------------------------------------
# What a window brings in changes with the window and with the rows read. What belongs to the
# system stays.

rows = {}
for window, hop in [("boxcar", 16), ("boxcar", 8), ("hann", 16), ("centred-boxcar", 16)]:
    reducer = identify(window, hop)["reduce"]
    kept_modes = np.sort_complex(reducer.system_.poles())
    rows[f"{window}, {64 // hop} rows a wingbeat"] = {
        **reducer.modes_["verdict"].value_counts(),
        "error of the genuine (1/s)": f"{abs(kept_modes - np.sort_complex(true)).max():.1e}",
    }
pd.DataFrame(rows).T

# %%
# What it costs to keep them
# --------------------------
# The model with all ten states answers for the coefficients as the window shows them, one row at a
# time. The three genuine ones answer for the raw signals.

ResponseDisplay.from_estimator(
    {"all ten states": pipe[:2], "three genuine": pipe},
    data.inputs,
    data.outputs,
    span=(0.7, 1.3),
    units=units,
)

# %%
# What was learned
# ----------------
# The analyzer's copies and memory can be told from the modes of the machine by where they lie, and
# what is kept is as exact as if there had been no analyzer. Under noise the choice is harder, and
# the verdict may be *ambiguous*.
#
# * The formula, and how often the choice is right on random systems: :doc:`/spurious_modes`.
# * The step itself: :class:`~sklearn_hd.SpuriousModeReducer`.
# * Read period by period there is nothing to remove:
#   :ref:`sphx_glr_auto_examples_plot_06_periodic_model.py`.
