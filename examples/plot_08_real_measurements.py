"""
Records, gaps and trim in real measurements
===========================================

How do you prepare flight records with lost samples, a dropout and the periodic trim for
identification?
"""

# %%
# The records
# -----------
# These are three flights of the nonlinear wing, as from a logger: raw signals with the periodic
# trim and a little noise, in one table. The index gives the flight and the time.

# sphinx_gallery_thumbnail_number = 3
import textwrap

import numpy as np
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
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
# Read your own file with ``pd.read_csv("flights.csv", index_col=["record", "time"])``.
# Here is the flight with the dropout:

units = {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}
kept = {"U": [0], "w": [0], "phi_dot": [1]}
options = {"missing": "gap", "units": units, "record": 1}
HarmonicsDisplay.from_data(flights, data.omega, kept, **options)

# %%
# Errors name the problem
# -----------------------
# The package fills in or drops nothing unless you ask for it.

u, y = flights[["U"]], flights[["w", "phi_dot"]]
analyzer = HarmonicAnalyzer(data.omega)
try:
    analyzer.fit(u, y)
except ValueError as error:
    print(textwrap.fill(str(error), 90))

# %%
# Here you ask for two things. First, bridge gaps shorter than 3 ms and keep the rest as gaps. A
# gap, like a new flight, starts a new segment, and nothing is averaged across it. Second, state
# where the wing was in trim: the waveforms over that span are averaged, phase by phase, and
# subtracted.

analyzer.set_params(missing=0.003, trim_span=data.trim_span).fit(u, y)
print(f"trim from {data.trim_span[0]:g} to {data.trim_span[1]:.2f} s of each flight")
HarmonicsDisplay.from_estimator(analyzer, u, y, record=1, units=units)

# %%
# Identify from two flights
# -------------------------
# The steps from here on are the usual ones. The third flight is kept for validation.

pipe = Pipeline(
    [
        ("harmonics", analyzer),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher(structure=HarmonicStructure())),
    ]
).fit(u.loc[:1], y.loc[:1])
print(f"R² on flights 0 and 1: {pipe.score(u.loc[:1], y.loc[:1]):.4f}")
print(f"R² on flight 2:        {pipe.score(u.loc[2:], y.loc[2:]):.4f}")
ResponseDisplay.from_estimator(pipe, u, y, record=2, units=units)

# %%
# How much did the gaps cost? Here the same flights exist without gaps, and the truth is known.

whole = clone(pipe).fit(data.inputs.loc[:1], data.outputs.loc[:1])
exact = data.ltp.floquet_exponents().real
print(f"{'exact':10}: Floquet exponents {exact.round(2)} 1/s")
for name, model in {"with holes": pipe, "without": whole}.items():
    found = model["match"].ltp_.floquet_exponents().real
    print(f"{name:10}: Floquet exponents {found.round(2)} 1/s")
EigenvalueDisplay.from_estimator(pipe, true=data.ltp.floquet_exponents())

# %%
# ``predict`` returns the outputs in the units of the record, with the trim added, wherever the
# input is known, including the dropout.

predicted = pipe.predict(u)
print(f"rows of y with holes: {y.isna().any(axis=1).sum()}")
print(f"rows of the prediction without an answer: {predicted.isna().any(axis=1).sum()}")

# %%
# What was learned
# ----------------
# Three settings are enough: the index (flight and time), ``missing`` and ``trim_span``.
#
# * Dates, varying rotor speed, uneven time stamps, pairs of flights that cancel nonlinear effects:
#   :doc:`/guide/1_data`.
# * Whole flights left out in turn (``GroupKFold``): :doc:`/order_selection`.
