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
# There is no noise, so nothing here is random.

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
# The coefficients are sampled four times per wingbeat. Ten singular values exceed rounding.


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
# A window adds two kinds of modes. *Copies* lie directly above and below a genuine mode, at λ +
# jpω. The *memory* of the window dies within its length, so it lies far to the left, outside this
# figure. ``SpuriousModeReducer`` uses these positions and needs no knowledge of the machine.

true = np.linalg.eigvals(data.A_exact)
EigenvalueDisplay.from_estimator(pipe, true=true)

# %%
# Every mode has a verdict with a reason:

pd.options.display.max_colwidth = 80
modes = pipe["reduce"].modes_
modes.assign(eigenvalue=modes["eigenvalue"].map("{:.2f}".format))

# %%
# In modal analysis one often looks at models of growing order and keeps the modes that come back.
# That does not help here: from ten states on, copies come back as surely as genuine modes do.

StabilizationDisplay.from_estimator(pipe, data.inputs, data.outputs, orders=range(1, 13))

# %%
# Another window, other spurious modes
# ------------------------------------
# The spurious modes change with the window and with the number of analysed rows. The modes of the
# system stay.

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
# The model with all ten states describes the coefficients as the window shows them, row by row.
# The three genuine ones describe the raw signals.

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
# The positions of the analyzer's copies and memory separate them from the modes of the machine,
# and the kept modes are as exact as if there had been no analyzer. Under noise the choice is
# harder, and the verdict may be *ambiguous*.
#
# * The formula, and how often the choice is right on random systems: :doc:`/spurious_modes`.
# * The step itself: :class:`~sklearn_hd.SpuriousModeReducer`.
# * With ``reading="period"`` there is nothing to remove:
#   :ref:`sphx_glr_auto_examples_plot_06_periodic_model.py`.
