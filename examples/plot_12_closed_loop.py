"""
An unstable moth in gusts
=========================

How unstable is a machine that can only be measured while its stabiliser flies it?
"""

# %%
# The record
# ----------
# A hawkmoth in hover, a nonlinear periodic system, tumbles within seconds if it is left alone.
# Its feedback reads the means of each wingbeat and sets the stroke of the next; small steps on
# top of that excite it, while gusts blow and the sensors are noisy.

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
# The stroke moves far more than the steps that excite it (dots): most of it is feedback, which
# answers to gusts and noise of the wingbeats before.

# %%
# Two ways to read it
# -------------------
# Subspace methods that project future inputs out take them for independent of past noise. PBSID
# (``weighting="pbsid"``) does not: it fits a long predictor of the next wingbeat first, and
# whatever that leaves is new, feedback or none.


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
# To the eye of MOESP the moth is stable: it has identified the moth with its pilot.

# %%
# The model behind
# ----------------
# From the predictor's states at the beginning of each wingbeat, ``StructuredMatcher`` finds the
# linear time-periodic model, whose states are the measured outputs. Its mean and first harmonics
# beside those of the moth's equations of motion, linear about the trim:

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
#   data do not mend MOESP's bias.
# - Feedback that acts wingbeat by wingbeat is read wingbeat by wingbeat (``reading="period"``);
#   what acts within the wingbeat would be identified with the moth.
# - The model found is that of the moth without its pilot, of which a better pilot can be designed.
#   How well it does over many flights: :doc:`against the world </world>`; what PBSID asks:
#   :doc:`the user guide </guide/3_subspace>`.
