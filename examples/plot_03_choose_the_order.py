"""
Identify a model and choose its order
=====================================

How many states does a model need, if you have only a noisy record?
"""

# %%
# The record
# ----------
# The record shows a flapping wing under a repeated 3-2-1-1 input, with white noise of a twentieth
# of each output's standard deviation. The last part is kept for validation.

# sphinx_gallery_thumbnail_number = 3
import warnings

from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer, StructuredMatcher
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import InstabilityWarning
from sklearn_hd.model_selection import PeriodBlockSplit, smallest_within_one_standard_error
from sklearn_hd.plotting import (
    HarmonicsDisplay,
    OrderSelectionDisplay,
    ResponseDisplay,
    SingularValueDisplay,
)

data = make_flapping_wing("ltp", input="3211", n_periods=160, width=4, snr=20, random_state=0)
units = {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}
split = data.outputs.index[120 * 64]  # after 120 wingbeats of 64 samples
fit = data.outputs.index < split
u, y = data.inputs[fit], data.outputs[fit]

kept = {"U": [0], "w": [0], "phi_dot": [1]}
signals = data.inputs.join(data.outputs)
HarmonicsDisplay.from_data(signals, data.omega, kept, span=(0.0, 2.0), units=units)

# %%
# One fit, and a look at it
# -------------------------
# ``reading="period"`` takes one step per wingbeat. A periodic system is then exactly
# time-invariant and keeps its own number of states. Singular values above the gap belong to
# states, the others to noise.

analyzer = HarmonicAnalyzer(data.omega, output_harmonics=3, reading="period")
pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())]).fit(u, y)
SingularValueDisplay.from_estimator(pipe)

# %%
# Cross-validation
# ----------------
# That was one fit, and the gap is narrow. Data that a model has not seen are a sharper test:
# blocks of whole wingbeats are left out in turn, and every candidate simulates them. Among the
# candidates within one standard error of the best, the smallest is taken.

search = GridSearchCV(
    pipe,
    {"identify__order": [1, 2, 3, 4, 5], "identify__block_rows": [4, 6]},
    cv=PeriodBlockSplit(5, omega=data.omega),
    refit=smallest_within_one_standard_error,
)
with warnings.catch_warnings():
    warnings.simplefilter("ignore", InstabilityWarning)  # candidates too large; their score tells
    search.fit(u, y)
print(search.best_params_)
OrderSelectionDisplay.from_estimator(search, misfit=True)

# %%
# The part kept for the end
# -------------------------
# The order is set, and the following steps turn the model into a continuous one.

order = search.best_params_["identify__order"]
model = Pipeline(
    [
        ("harmonics", analyzer),
        ("identify", MOESPRegressor(order=order)),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher()),
    ]
).fit(u, y)
end = data.outputs.index[-1]
ResponseDisplay.from_estimator(
    model,
    data.inputs,
    data.outputs,
    span=(split - 0.5, end),
    validation_span=(split, end),
    units=units,
)

# %%
# What was learned
# ----------------
# The true wing has two states, and the search found two. The fit is the same on data that the
# model has not seen; the remaining misfit is the noise.
#
# * Cross-validation by periods, records and azimuth: :doc:`/order_selection`.
# * The rule: :func:`~sklearn_hd.model_selection.smallest_within_one_standard_error`.
# * Several rows per period give more states than the system has:
#   :ref:`sphx_glr_auto_examples_plot_04_spurious_modes.py`.
