"""
Motions too large for a linear model
====================================

What are the modes of small motions, if the record only shows large ones?
"""

# %%
# The records
# -----------
# The stiffness of this oscillator varies over the turn, and its spring hardens with the cube of
# the deflection. An input steps at random and never rests. Four records differ only in the size of
# these steps.

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
from sklearn_hd.systems import PeriodicSystem

OMEGA, SAMPLES, TURNS = 2.0, 16, 160
SIZES = [0.03, 0.06, 0.12, 0.2]


def hardening(x, u, t):
    deflection, rate = x
    stiffness = 1.3 + 0.5 * np.cos(OMEGA * t)
    force = stiffness * deflection + 0.6 * deflection**3
    return np.array([rate, u[0] - 0.2 * rate - force])


machine = PeriodicSystem(
    hardening, period=2.0 * np.pi / OMEGA, state_names=["deflection", "rate"], input_names=["force"]
)
exact = machine.linearize(machine.trim(4)).floquet_exponents()


def record(size, seed=3):
    """A record of random steps of some size, with 1 % noise on both outputs."""
    rng, n = np.random.default_rng(seed), SAMPLES * TURNS
    levels = np.repeat(rng.choice([-1.0, 0.0, 1.0], n), rng.integers(2, 40, n))[:n]
    time = pd.Index(np.arange(n) * machine.period / SAMPLES, name="time")
    y = machine.simulate(size * levels, time, rtol=1e-9, atol=1e-11)
    y += 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    u = pd.DataFrame({"force": size * levels}, time)
    return u, pd.DataFrame(y, time, ["deflection", "rate"])


records = {size: record(size) for size in SIZES}
fig, ax = plt.subplots(layout="constrained")
for size in (SIZES[0], SIZES[-1]):
    first = records[size][1]["deflection"].iloc[: 20 * SAMPLES]
    ax.plot(first.index, first / size, label=f"steps of {size}")
ax.set_xlabel("time, s")
ax.set_ylabel("deflection / size of the steps")
ax.legend()

# %%
# The response to larger steps is not a larger copy of the response to small ones: it is faster,
# because the spring is harder.

# %%
# Two models of each record
# -------------------------
# The default pipeline finds that a linear model leaves more than noise. So it takes products of two
# and three states and inputs as further inputs of the fit where they pay, and keeps the linear
# part. ``nonlinear_degrees_`` tells which. Maximum likelihood (``criterion="output_error"``) fits
# one linear model to the large motions instead.


def five_steps(**options):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(OMEGA)),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure(), **options)),
        ]
    )


def oscillation(exponents):
    """The exponent with the frequency next to that of the mean stiffness; others are jω apart."""
    folded = (exponents.imag + OMEGA / 2.0) % OMEGA - OMEGA / 2.0
    return exponents.real[0] + 1j * (OMEGA - np.abs(folded[0]))


rows = []
for size, (u, y) in records.items():
    small = five_steps().fit(u, y)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        linear = five_steps(criterion="output_error").fit(u, y)
    doubts = [str(w.message) for w in told if "exponents are in doubt" in str(w.message)]
    rows.append(
        {
            "steps": size,
            "degrees": small["identify"].nonlinear_degrees_,
            "small motions": oscillation(small["match"].ltp_.floquet_exponents()),
            "one linear model": oscillation(linear["match"].ltp_.floquet_exponents()),
            "R² of the smallest record": small.score(*records[SIZES[0]]),
            "R² of its own": small.score(u, y),
            "linear, of the smallest": linear.score(*records[SIZES[0]]),
            "linear, of its own": linear.score(u, y),
            "doubts of the linear model": "; ".join(doubts),
        }
    )
found = pd.DataFrame(rows).set_index("steps")
print(found.drop(columns="doubts of the linear model").round(4).T.to_string())

# %%
# The exponents
# -------------
# A harder spring raises the frequency of the one linear model. The pipeline stays with that of
# small motions.

fig, axes = plt.subplots(2, 1, sharex=True, layout="constrained")
truth = oscillation(exact)
for name, marker in (("small motions", "o"), ("one linear model", "s")):
    exponents = found[name].to_numpy()
    axes[0].plot(found.index, -exponents.real, marker, label=name)
    axes[1].plot(found.index, exponents.imag, marker, label=name)
for ax, value, label in zip(
    axes, (-truth.real, truth.imag), ("decay rate, 1/s", "frequency, rad/s"), strict=True
):
    ax.axhline(value, color="0.3", lw=1.0, label="exact, small motions")
    ax.set_ylabel(label)
axes[0].set_ylim(0.0, 0.15)
axes[0].legend()
axes[1].set_xlabel("size of the steps")

# %%
# The likelihood says so by itself. It is held against the exponents of small motions:

print(found["doubts of the linear model"].iloc[-1])

# %%
# What was learned
# ----------------
# - From records of large motions, ``reading="sample"`` of :class:`~sklearn_hd.HarmonicAnalyzer`
#   (which the default takes, as the input never rests) finds the modes of small ones, and predicts
#   a record of these. ``nonlinear_degrees_`` of :class:`~sklearn_hd.MOESPRegressor` says so.
# - One linear model, by ``criterion="output_error"`` of :class:`~sklearn_hd.StructuredMatcher`,
#   simulates motions as large as those of the record better. Its exponents are in doubt, and a
#   warning names both.
# - The equations: :doc:`theory </theory>`.
