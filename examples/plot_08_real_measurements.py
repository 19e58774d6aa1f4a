"""
Records, gaps and trim in real measurements
===========================================

What has to be done to flight records with lost samples, a dropout and the trim still in them
before a model can be identified?
"""

# %%
# The records
# -----------
# Three flights of the nonlinear wing, as a logger leaves them: raw signals with the periodic trim
# inside, a little noise, one table for all flights. The index says which flight and what time.

# sphinx_gallery_thumbnail_number = 3
import textwrap

import numpy as np
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.plotting import EigenvalueDisplay, HarmonicsDisplay, ResponseDisplay

data = make_flapping_wing(
    "nltp", n_periods=60, start=20, width=8, n_records=3, snr=50, random_state=11
)
flights = data.inputs.join(data.outputs)
time = flights.index.get_level_values("time")
flight = flights.index.get_level_values("record")

rng = np.random.default_rng(0)
lost = rng.choice(flights.index, 40, replace=False)  # single samples of w
flights.loc[list(lost), "w"] = np.nan
flights.loc[(flight == 1) & (time > 1.5) & (time < 1.6), ["w", "phi_dot"]] = np.nan  # a dropout
flights.groupby("record").agg(["count", "std"])

# %%
# A file of your own is read with ``pd.read_csv("flights.csv", index_col=["record", "time"])``.
# Here is the flight with the dropout:

units = {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}
kept = {"U": [0], "w": [0], "phi_dot": [1]}
options = {"missing": "gap", "units": units, "record": 1}
HarmonicsDisplay.from_data(flights, data.omega, kept, **options)

# %%
# What is wrong is said
# ---------------------
# Nothing is filled in or thrown away unasked.

u, y = flights[["U"]], flights[["w", "phi_dot"]]
analyzer = HarmonicAnalyzer(data.omega, output_harmonics={"w": [0], "phi_dot": [1]}, hop=8)
try:
    analyzer.fit(u, y)
except ValueError as error:
    print(textwrap.fill(str(error), 90))

# %%
# So say it: bridge what is shorter than 3 ms, and make a gap of the rest. A gap, like a new
# flight, starts a new segment; nothing is averaged across it. And say where the wing was in trim:
# the waveforms over that span are averaged, phase by phase, and taken off.

analyzer.set_params(missing=0.003, trim_span=data.trim_span).fit(u, y)
print(f"trim from {data.trim_span[0]:g} to {data.trim_span[1]:.2f} s of each flight")
HarmonicsDisplay.from_estimator(analyzer, u, y, record=1, units=units)

# %%
# Identify from two flights
# -------------------------
# From here on nothing is different. The third flight is kept for validation.

free = MatrixStructure(np.full((3, 3), np.nan), np.full((3, 1), np.nan))
pipe = Pipeline(
    [
        ("harmonics", analyzer),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher(structure=free)),
    ]
).fit(u.loc[:1], y.loc[:1])
print(f"R² on flights 0 and 1: {pipe.score(u.loc[:1], y.loc[:1]):.4f}")
print(f"R² on flight 2:        {pipe.score(u.loc[2:], y.loc[2:]):.4f}")
ResponseDisplay.from_estimator(pipe, u, y, record=2, units=units)

# %%
# Did the holes do harm? Here the same flights are at hand without any, and so is the truth.

whole = clone(pipe).fit(data.inputs.loc[:1], data.outputs.loc[:1])
for name, model in {"with holes": pipe, "without": whole}.items():
    error = np.linalg.norm(model["match"].system_.A - data.A_exact) / np.linalg.norm(data.A_exact)
    print(f"{name:10}: error of A {100 * error:.1f} %")
EigenvalueDisplay.from_estimator(pipe, true=np.linalg.eigvals(data.A_exact))

# %%
# ``predict`` answers in the units of the record, with the trim put back, and wherever the input is
# known: in the dropout, too.

predicted = pipe.predict(u)
print(f"rows of y with holes: {y.isna().any(axis=1).sum()}")
print(f"rows of the prediction without an answer: {predicted.isna().any(axis=1).sum()}")

# %%
# What was learned
# ----------------
# Three words about the data do: the index (flight and time), ``missing`` and ``trim_span``.
#
# * Dates, varying rotor speed, uneven time stamps, pairs of flights that cancel what is not linear:
#   :doc:`/guide/1_data`.
# * Whole flights left out in turn (``GroupKFold``): :doc:`/order_selection`.
