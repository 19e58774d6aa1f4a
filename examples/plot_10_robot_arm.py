"""
Measurements of a robot arm, and what SLICOT says
=================================================

Does :class:`~sklearn_hd.MOESPRegressor` find in plain, measured data what other software finds?
"""

# %%
# The data
# --------
# The record is of a flexible robot arm from DaISy, the identification database of KU Leuven: 1024
# samples of the reaction torque (input) and the acceleration (output) during a periodic sine
# sweep. Nothing here is periodic in the sense of the other examples, so the regressor works
# without a harmonic analyzer.

# sphinx_gallery_thumbnail_number = 3
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from sklearn_hd import MOESPRegressor
from sklearn_hd.datasets import load_robot_arm, load_slicot_example
from sklearn_hd.plotting import EigenvalueDisplay, ResponseDisplay, SingularValueDisplay

arm = load_robot_arm()
print(arm.DESCR)
figure, axes = plt.subplots(2, sharex=True, figsize=(6.4, 3.6), layout="constrained")
for ax, signal in zip(axes, (arm.inputs, arm.outputs), strict=True):
    ax.plot(signal, lw=0.8)
    ax.set_ylabel(signal.columns[0].replace("_", "\n"))
axes[1].set_xlabel("sample")

# %%
# The order
# ---------
# The fit uses twenty block rows, as in the published run. ``order="auto"`` simulates models of
# rising order over the record, and takes the one with the smallest Bayesian information criterion.
# In the table, ``share`` is the part of the acceleration that a model does not explain (root mean
# square); higher orders diverge.

free = MOESPRegressor(block_rows=20).fit(arm.inputs, arm.outputs)
print(f"order {free.order_}, {free.feedthrough_reason_}")
search = pd.DataFrame(free.order_search_).query("feedthrough and share < 1")
search.set_index("order")[["share", "bic", "stable"]].round({"share": 4, "bic": 0})

# %%
# The record is long, so the criterion resolves details: four states leave 3.6 %, and many more
# leave 3 %. After the fourth, the singular values fall by two decades. Four states are the
# published choice, and a reasonable one.

model = MOESPRegressor(order=4, block_rows=20, feedthrough=True)
model.fit(arm.inputs, arm.outputs)
SingularValueDisplay.from_estimator(model)

# %%
# The modes
# ---------
# SLICOT's routines (IB01, PO-MOESP) give 0.93294 ± 0.35739j and 0.69686 ± 0.71211j, from sample to
# sample. The display shows them in continuous time, with a second between samples.

slicot = np.array([0.93294 + 0.35739j, 0.69686 + 0.71211j])
slicot = np.concatenate([slicot, slicot.conj()])
EigenvalueDisplay.from_estimator(model, true=np.log(slicot))

# %%
gap = np.abs(model.eigenvalues_[:, None] - slicot).min(axis=1)
print(f"largest distance {gap.max():.1e} (SLICOT's are rounded to 1e-5)")

# %%
# The fit
# -------
# The model is simulated from the torque alone. The published model accounts for 99.871 % of the
# variance.

fitted = pd.DataFrame(
    model.predict(arm.inputs, x0=model.x0_[0]), arm.outputs.index, arm.outputs.columns
)
ResponseDisplay.from_data(arm.outputs, fitted, inputs=arm.inputs, span=(0, 200))

# %%
share = 100 * (1 - (arm.outputs - fitted).var() / arm.outputs.var())
print(f"variance accounted for: {share.iloc[0]:.3f} %")

# %%
# On data not used
# ----------------
# The first 600 samples give the model, and the rest tests it on unseen data.

first, rest = slice(None, 600), slice(600, None)
half = MOESPRegressor(order=4, block_rows=20, feedthrough=True)
half.fit(arm.inputs.iloc[first], arm.outputs.iloc[first])
for name, rows in {"where fitted": first, "beyond": rest}.items():
    print(f"R² {name}: {half.score(arm.inputs.iloc[rows], arm.outputs.iloc[rows]):.4f}")

# %%
# SLICOT's own example
# --------------------
# SLICOT publishes this program together with its results and prints singular values to four
# decimals. These are the first eight of both:

example = load_slicot_example()
model = MOESPRegressor(block_rows=15, feedthrough=True)
model.fit(example.inputs, example.outputs)
published = [69.8841, 14.9963, 3.6675, 1.9677, 0.3000, 0.2078, 0.1651, 0.1373]
pd.DataFrame({"SLICOT": published, "here": model.singular_values_[:8].round(4)}, range(1, 9))

# %%
# What was learned
# ----------------
# On plain data the regressor is ordinary subspace identification, and agrees with SLICOT to all
# digits that SLICOT prints. With several outputs, ``scale=False`` takes their units as they are,
# as SLICOT does; the default divides each by its size.
#
# * More records, more figures: :doc:`/world`.
# * Choosing the order: :doc:`/order_selection`.
