"""
An unstable moth in gusts
=========================

How unstable is a machine that you can only measure while a stabiliser flies it?
"""

# %%
# The record
# ----------
# A hawkmoth in hover is a nonlinear periodic system and tumbles within seconds if it is left
# alone. Its feedback uses the means of each wingbeat to set the stroke of the next. Small
# additional steps excite it, while gusts blow and the sensors are noisy.

# sphinx_gallery_thumbnail_number = 2
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_hawkmoth
from sklearn_hd.exceptions import InstabilityWarning

moth = make_hawkmoth(
    n_records=4, n_periods=150, quiet=30, excitation=0.003, gust=0.05, noise=0.02, random_state=7
)
wingbeat = 2.0 * np.pi / moth.omega

first = slice(0, 60 * 64)
fig, axes = plt.subplots(3, 1, sharex=True, layout="constrained")
signals = {
    "stroke, rad": moth.inputs["amplitude"],
    "surge, m/s": moth.outputs["u"],
    "pitch, rad": moth.outputs["theta"],
}
for ax, (label, signal) in zip(axes, signals.items(), strict=True):
    flight = signal.loc[0].iloc[first]
    ax.plot(flight.index / wingbeat, flight)
    ax.set_ylabel(label)
axes[0].plot(
    np.arange(60),
    moth.trim.inputs[0] + moth.excitation.loc[0]["amplitude"].iloc[first].iloc[::64],
    ".",
    label="trim and excitation",
)
axes[0].legend(loc="lower left")
axes[-1].set_xlabel("wingbeats")

# %%
# The stroke moves far more than the steps that excite it (dots). Most of its motion is feedback,
# which reacts to gusts and noise of earlier wingbeats.

# %%
# Two methods
# -----------
# Subspace methods that project future inputs out assume that these are independent of past noise.
# PBSID (``weighting="pbsid"``) does not: it first fits a long predictor of the next wingbeat, and
# its residuals are new information, with or without feedback.


def five_steps(weighting):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(moth.omega, reading="period", trim_span=moth.trim_span)),
            ("identify", MOESPRegressor(order=4, weighting=weighting)),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    )


with warnings.catch_warnings():
    warnings.simplefilter("ignore", InstabilityWarning)  # that it is unstable is the point
    maps = {w: five_steps(w)[:2].fit(moth.inputs, moth.outputs) for w in ("moesp", "pbsid")}
    pipe = five_steps("pbsid").fit(moth.inputs, moth.outputs)

exponents = {
    name: np.log(fitted["identify"].eigenvalues_.astype(complex)) / wingbeat
    for name, fitted in maps.items()
}
exponents["pbsid, LTP model"] = pipe["match"].ltp_.floquet_exponents()
exponents["truth"] = moth.exponents
table = pd.DataFrame({name: np.sort_complex(values) for name, values in exponents.items()})
table.round(2)

# %%

fig, ax = plt.subplots(layout="constrained")
marks = {"truth": "k+", "moesp": "C3s", "pbsid": "C0o", "pbsid, LTP model": "C0."}
for name, mark in marks.items():
    values = np.asarray(exponents[name])
    ax.plot(values.real, values.imag, mark, mfc="none", ms=10, label=name)
ax.axvline(0.0, lw=0.8, color="0.5")
ax.set(xlabel="growth, 1/s", ylabel="frequency, rad/s")
ax.legend()

# %%
# MOESP gets the growth wrong. Its pair grows almost three times as fast as the moth's, and it turns
# the two real modes into a pair. It takes the work of the stabiliser for a part of the moth. PBSID
# is near the truth.

# %%
# The model behind
# ----------------
# From the predictor's states at the beginning of each wingbeat, ``StructuredMatcher`` finds the
# linear time-periodic model, whose states are the measured outputs. Compare its mean and first
# harmonics with those of the moth's equations of motion, linear about the trim:

found, true = pipe["match"].ltp_, moth.ltp
A, A_true = (model.harmonic_decomposition(1).A for model in (found, true))
error = np.linalg.norm(A - A_true) / np.linalg.norm(A_true)
print(f"error of A in harmonic-decomposition form: {error:.1%}")

names = list(found.state_names)
parts = {"found": A[:4, :4], "true": A_true[:4, :4]}
pd.concat({key: pd.DataFrame(F, names, names).round(2) for key, F in parts.items()}, axis=1)

# %%
# What was learned
# ----------------
# - With the stabiliser on, give :class:`~sklearn_hd.MOESPRegressor` ``weighting="pbsid"``; more
#   data do not remove MOESP's bias.
# - For feedback that acts wingbeat by wingbeat use ``reading="period"``; feedback that
#   acts within the wingbeat would be identified with the moth.
# - The model describes the moth without its stabiliser, so you can design a better one with it.
#   Results over many flights: :doc:`against the world </world>`; the conditions of PBSID:
#   :doc:`the user guide </guide/3_subspace>`.
