"""
Match a model to the structure of the physics
=============================================

How much does knowledge of the physics improve a model identified from a noisy record?
"""

# %%
# The record
# ----------
# A flapping wing with three states, *w* and the two parts of *φ̇*, responds to a doublet. The
# record contains white noise of a twentieth of each output's standard deviation.

# sphinx_gallery_thumbnail_number = 3
import warnings

import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.plotting import BodeDisplay, ConvergenceDisplay, HarmonicsDisplay


def fly(seed):
    """A record; seeds differ in their noise."""
    return make_flapping_wing("lti-signal", n_periods=100, start=10, snr=20, random_state=seed)


data = fly(0)
omega = data.omega
kept = {"w": [0], "phi_dot": [1]}
units = {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}
HarmonicsDisplay.from_data(data.outputs, omega, kept, span=(0.2, 2.0), units=units)

# %%
# Two structures
# --------------
# The states of an identified model have no physical meaning. A structure gives them one: here the
# outputs are the states (C is the identity by default). If nothing else is known, every entry of A
# and B is free, written as NaN.

states = ["w_0", "phi_dot_1c", "phi_dot_1s"]
free = MatrixStructure(np.full((3, 3), np.nan), np.full((3, 1), np.nan), state_names=states)

# %%
# The physics gives more. The torque drives only the cosine part of *φ̇*. And *φ̇* is one signal
# seen in a turning frame, so ω couples its two parts. A name that appears in two cells is one
# parameter.

A = pd.DataFrame(
    [
        [np.nan, np.nan, np.nan],
        [np.nan, np.nan, f"f - {omega}"],
        [np.nan, f"f + {omega}", np.nan],
    ],
    index=states,
    columns=states,
)
B = pd.DataFrame([[0.0], ["gain"], [0.0]], index=states, columns=["U_0"])
physics = MatrixStructure(A, B)
print(physics)

# %%
# Match
# -----
# Steps 2 to 4 are the same for both. The matcher then looks for the parameters that bring the
# largest error over frequency down (``"hinf"``), starting from least squares.


def identify(data, structure, criterion):
    """All steps; the matched model is that of the last."""
    steps = [
        ("harmonics", HarmonicAnalyzer(omega, output_harmonics=kept, hop=16)),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer(n_states=3)),
        ("match", StructuredMatcher(structure=structure, criterion=criterion)),
    ]
    return Pipeline(steps).fit(data.inputs, data.outputs)


norm = identify(data, physics, "hinf")
ConvergenceDisplay.from_estimator(norm)

# %%
# An error remains: no choice of the parameters reproduces the identified model exactly, because
# the noise does not follow the physics. ``"output_error"`` returns to the raw record instead, and
# searches for the parameters of largest likelihood.

likely = identify(data, physics, "output_error")
BodeDisplay.from_estimator(
    {"norm": norm, "likelihood": likely},
    np.geomspace(1.0, 1000.0, 200),
    true=data.ltp.harmonic_decomposition(1),
    units=units,
)

# %%
# Which is closest to the truth?
# ------------------------------
# One record proves nothing. Error of A in percent, on five. Where noise leaves a mode in doubt,
# the reducer would warn; here such a record counts like the others.

exact = data.A_exact.to_numpy()
errors = {}
with warnings.catch_warnings():
    warnings.simplefilter("ignore", IdentifiabilityWarning)
    for seed in range(5):
        record = fly(seed)
        for name, structure in {"free": free, "physics": physics}.items():
            for criterion in ("hinf", "output_error"):
                A = identify(record, structure, criterion)["match"].system_.A
                error = 100 * np.linalg.norm(A - exact) / np.linalg.norm(exact)
                errors.setdefault((name, criterion), []).append(error)
table = pd.DataFrame(errors, index=[f"record {seed}" for seed in range(5)])
table.loc["median"] = table.median()
table.round(2)

# %%
# What was learned
# ----------------
# Physics and likelihood together are closest to the truth. Physics with a norm is worse than no
# physics: fixed entries cannot absorb the noise, so the norm shifts the free entries instead.
# Match in a norm if the model is exact, or if the largest error matters, as for a controller.
# Otherwise use the likelihood.
#
# * Criteria, weights, and how to trust a match: :doc:`/matching`.
# * Everything that a cell may contain: :doc:`/structures`.
# * How sure the parameters are: :ref:`sphx_glr_auto_examples_plot_07_noise_and_confidence.py`.
