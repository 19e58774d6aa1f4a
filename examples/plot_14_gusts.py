"""
A machine shaken by gusts
=========================

What do standard deviations mean if gusts move the machine itself?
"""

# %%
# The machine
# -----------
# A measured force and an unmeasured gust drive an oscillator whose stiffness changes over the
# period (Mathieu's equation). Both outputs have 2 % noise of the sensors.

# sphinx_gallery_thumbnail_number = 4
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.plotting import ResidualDisplay
from sklearn_hd.systems import mathieu

machine = mathieu(2.0, 0.5, damping=0.1)
truth = machine.floquet_exponents()[0].real
SAMPLES, PERIODS = 16, 400
t = pd.Index(np.arange(SAMPLES * PERIODS) * machine.period / SAMPLES, name="time")


def record(seed):
    """Force, and outputs without and with gust and noise."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.choice([-1.0, 1.0], len(t) // 32), 32)
    gust = 0.3 * rng.standard_normal(len(t))
    calm, shaken = (
        pd.DataFrame(machine.simulate(each, t.to_numpy()), t, machine.output_names)
        for each in (force, force + gust)
    )
    noise = 0.02 * calm.std().to_numpy() * rng.standard_normal(calm.shape)
    return pd.DataFrame({"u": force}, t), calm, shaken + noise


u, calm, y = record(0)
some = slice(100.0, 160.0)
figure, ax = plt.subplots(figsize=(8, 3), layout="constrained")
ax.plot(y["y"].loc[some], "C1", lw=1, label="measured in gusts")
ax.plot(calm["y"].loc[some], "k--", lw=1, label="by the force alone")
ax.set(xlabel="time, s", ylabel="y")
figure.legend(loc="outside upper center", ncols=2)

# %%
# Two likelihoods
# ---------------
# ``"output_error"`` simulates the record from its force, and treats all residuals as noise of the
# sensors. ``"prediction_error"`` predicts each sample from those before it, with a Kalman gain
# that is estimated together with the parameters: a gust disturbs only one prediction.


def fitted(criterion, u, y):
    """The pipeline, and what it warns of."""
    analyzer = HarmonicAnalyzer(machine.omega, output_harmonics=2, reading="period")
    match = StructuredMatcher(structure=HarmonicStructure(F=1, G=0), criterion=criterion)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(2)), ("match", match)])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", IdentifiabilityWarning)
        pipe.fit(u, y)
    return pipe, [str(each.message) for each in told]


CRITERIA = ["output_error", "prediction_error"]
pipes = {}
for criterion in CRITERIA:
    pipes[criterion], told = fitted(criterion, u, y)
    print(criterion, pipes[criterion]["match"].covariance_type_, *told, sep=" | ")

# %%
# The residuals of the first fit are not white noise (``residual_tests_``). The standard deviations
# then come from comparing blocks of the record (``covariance_type_`` is ``"robust"``). A warning
# follows if they leave the exponents in doubt.
# :class:`~sklearn_hd.plotting.ResidualDisplay` shows the residuals of the simulation: the machine
# rings on after each gust.

ResidualDisplay.from_estimator(pipes["output_error"], u, y)

# %%
# Predictions one sample ahead leave white noise.

ResidualDisplay.from_estimator(pipes["prediction_error"], u, y)

# %%
# Intervals and the truth
# -----------------------
# Six records have different gusts. The figure shows the estimated decay with its 95 % interval.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
for ax, criterion, color in zip(axes, CRITERIA, ["C0", "C1"], strict=True):
    for seed in range(6):
        pipe = pipes[criterion] if seed == 0 else fitted(criterion, *record(seed)[::2])[0]
        found, std, _ = pipe["match"].eigenvalues_.iloc[0]
        ax.errorbar(seed, found.real, 1.96 * np.real(std), fmt="o", color=color, capsize=3)
    ax.axhline(truth, color="k", ls="--", lw=1)
    ax.set(title=f'"{criterion}"', xlabel="record")
axes[0].set_ylabel("real part of the exponent, 1/s")

# %%
# The errors of ``"prediction_error"`` are smaller, and its intervals shorter, because it knows the
# effect of the gusts. Robust intervals are wide enough on average, and scatter.

# %%
# A sample ahead
# --------------
# ``predict`` simulates. ``predict_ahead`` also reads the outputs up to the sample before, here on a
# record that was not fitted.

u_new, _, y_new = record(100)
pipe = pipes["prediction_error"]
simulated = pipe.predict(u_new)
ahead = pipe["match"].predict_ahead(pipe[:-1].transform(u_new), y_new)
for name, predicted in {"simulated": simulated, "one sample ahead": ahead}.items():
    left = (y_new - predicted).std() / y_new.std()
    print(f"{name}: {left['y']:.1%} of y left, {left['y_dot']:.1%} of its rate")

figure, ax = plt.subplots(figsize=(8, 3), layout="constrained")
ax.plot(y_new["y"].loc[some], "k", lw=3, alpha=0.3, label="measured")
ax.plot(simulated["y"].loc[some], "C0", lw=1, label="simulated")
ax.plot(ahead["y"].loc[some], "C1", lw=1, label="one sample ahead")
ax.set(xlabel="time, s", ylabel="y")
figure.legend(loc="outside upper center", ncols=3)

# %%
# What was learned
# ----------------
# - If gusts move the machine, the residuals of a simulation are not white noise, and the
#   standard deviations are robust.
# - ``criterion="prediction_error"`` of :class:`~sklearn_hd.StructuredMatcher` also estimates the
#   Kalman gain. Its residuals are white, and its intervals shorter.
# - Which likelihood for which record: :doc:`the user guide </guide/5_matching>`; the equations:
#   :doc:`theory </theory>`.
