"""
Noise, confidence and the Cramér-Rao bound
==========================================

How far can you trust an identified model if there is only one noisy record?
"""

# %%
# The record
# ----------
# A flapping wing responds to a doublet. The outputs contain white noise of a twentieth of each
# output's standard deviation.

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
from sklearn_hd.plotting import BodeDisplay, EigenvalueDisplay, HarmonicsDisplay

kept = {"w": [0], "phi_dot": [1]}
states = ["w_0", "phi_dot_1c", "phi_dot_1s"]
units = {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}


def fly(seed):
    """The same flight; seeds differ in their noise."""
    return make_flapping_wing("lti-signal", n_periods=60, start=5, snr=20, random_state=seed)


data = fly(0)
HarmonicsDisplay.from_data(data.outputs, data.omega, kept, span=(0.1, 2.0), units=units)

# %%
# Parameters and their intervals
# ------------------------------
# ``criterion="output_error"`` finds the parameters under which the record is most likely. The
# curvature of the likelihood there shows how certain they are.

B = [[0.0], ["gain"], [0.0]]  # the torque drives the cosine part of φ̇
structure = MatrixStructure(np.full((3, 3), np.nan), B, state_names=states, input_names=["U_0"])


def identify(data):
    """All steps."""
    steps = [
        ("harmonics", HarmonicAnalyzer(data.omega, output_harmonics=kept, hop=16)),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer(n_states=3)),
        ("match", StructuredMatcher(structure=structure, criterion="output_error")),
    ]
    return Pipeline(steps).fit(data.inputs, data.outputs)["match"]


match = identify(data)
true = pd.Series(
    [*data.A_exact.to_numpy().ravel(), data.B_exact.loc["phi_dot_1c", "U_0"]], match.theta_.index
)
table = pd.DataFrame({"estimate": match.theta_, "std": match.theta_std_, "true": true})
table.join(match.confidence_interval(0.95)).map("{:.4g}".format)

# %%
# The noise was estimated, too:

print("noise, estimated:", match.noise_std_.round(5).to_dict())
print("noise, true:     ", (data.outputs_clean.std() / 20).round(5).to_dict())

# %%
# Frequency responses also have intervals; the shading is 95 % confidence:

frequencies = np.geomspace(1.0, 2000.0, 200)
exact = data.ltp.harmonic_decomposition(1)
BodeDisplay.from_estimator(match, frequencies, true=exact, units=units)

# %%
# Do they hold?
# -------------
# Twelve further flights test the intervals. The *Cramér-Rao bound* is the smallest standard
# deviation that an unbiased estimate can have. ``theta_std_`` is that bound, taken at the
# estimate. An estimator that reaches it has errors of one such deviation, root mean square.

with warnings.catch_warnings():
    warnings.simplefilter("ignore", IdentifiabilityWarning)  # of single records; all are judged
    others = [identify(fly(seed)) for seed in range(1, 13)]
z = pd.DataFrame([(one.theta_ - true) / one.theta_std_ for one in others])
inside = z.abs() < 1.96
print(f"errors over the bound, root mean square: {np.sqrt((z**2).to_numpy().mean()):.2f}")
print(f"95 % intervals that hold the truth: {100 * inside.to_numpy().mean():.0f} %")

# %%
# The dots are the fast eigenvalue from the twelve flights, and the ellipse is the region from the
# first record alone:

eigenvalues = np.concatenate([one.system_.poles() for one in others])
exact = np.linalg.eigvals(data.A_exact)
display = EigenvalueDisplay.from_estimator(match, true=exact)
display.ax_.plot(eigenvalues.real, eigenvalues.imag, "k.", ms=4, zorder=0, label="twelve flights")
display.ax_.legend(loc="lower left")
display.ax_.set(xlim=(-82, -70), ylim=(156, 168))

# %%
# What was learned
# ----------------
# One record gives the model and its uncertainty, and twelve more agree. This holds if the noise is
# white and the structure is true: standard deviations do not include a wrong model.
#
# * How often intervals hold, over hundreds of records: :doc:`/periodic_models`.
# * Noise on the inputs: ``input_noise`` of :class:`~sklearn_hd.StructuredMatcher`.
# * Likelihood beside other criteria: :ref:`sphx_glr_auto_examples_plot_05_match_a_structure.py`.
