"""
Simulate and linearise a flapping wing
======================================

How large a disturbance of a flapping wing can a linear model still describe?

The wing is the paper's: a vehicle the size of a hawkmoth in vertical flight. It has two states,
the vertical speed *w* (positive down) and the flapping speed *φ̇*. Its input *U* is the
amplitude of the flapping torque.
"""

# %%
# Look at it first
# ----------------
# In hover the wing repeats one motion, its *trim*. ``trim`` finds that motion and the torque that
# carries the weight. Then the torque is raised for ten wingbeats and lowered for ten more: a
# doublet.

# sphinx_gallery_thumbnail_number = 5
import numpy as np
import pandas as pd

from sklearn_hd.plotting import (
    EigenvalueDisplay,
    ParticipationDisplay,
    PeriodicMatrixDisplay,
    ResponseDisplay,
)
from sklearn_hd.systems import flapping_wing

wing = flapping_wing()
trim = wing.trim(method="shooting")
torque = trim.inputs[0]
print(f"torque in trim {torque:.6f} N m, wingbeat {1e3 * wing.period:.1f} ms")

t = pd.Index(np.arange(60 * 64) * wing.period / 64, name="time")  # 64 samples a wingbeat
beat = t / wing.period
doublet = 1.0 * ((beat >= 5) & (beat < 15)) - 1.0 * ((beat >= 15) & (beat < 25))


def fly(share):
    """Flight with a doublet of a share of the trim torque."""
    y = wing.simulate(torque * (1 + share * doublet), t, trim.initial_state)
    return pd.DataFrame(y, t, ["w", "phi_dot"])


flight = pd.DataFrame({"U": torque * (1 + 0.2 * doublet)}, t).join(fly(0.2))
axes = flight.loc[:1.5].plot(subplots=True, legend=False, color="0.3", lw=1, figsize=(7, 5))
units = {"U": "N m", "w": "m/s", "phi_dot": "rad/s"}
for axis, (name, unit) in zip(axes, units.items(), strict=True):
    axis.set(ylabel=f"{name} ({unit})", xlabel="time (s)")
axes[0].figure.align_ylabels()

# %%
# Linear, with periodic matrices
# ------------------------------
# About the trim, small motions obey :math:`\dot x = F(\psi) x + G(\psi) u`. The matrices repeat
# with each wingbeat: ψ is its phase. These are the entries of *F*; they have kinks where the wing
# turns round.

ltp = wing.linearize(trim)
PeriodicMatrixDisplay.from_systems(ltp, "F", units=units)

# %%
# Linear, with constant matrices
# ------------------------------
# Take the mean and the first harmonic of each state as states of their own. They obey a
# time-invariant model, the *harmonic decomposition* (HD).

hd = ltp.harmonic_decomposition(1)
pd.DataFrame(hd.A, hd.state_labels, hd.state_labels).round(1)

# %%
# Its eigenvalues are the Floquet exponents of the periodic system, each with copies shifted up and
# down by the flapping frequency ω. With one harmonic kept, they nearly agree.

print("Floquet exponents:  ", ltp.floquet_exponents().real.round(2))
print("on the real axis:   ", np.sort(hd.poles()[abs(hd.poles().imag) < 1].real)[::-1].round(2))
EigenvalueDisplay(model=hd.poles(), true=ltp.floquet_exponents(), model_name="HD, N = 1").plot()

# %%
# Which coefficients does each mode move? The slow one, the heave, moves the mean of *w* and the
# first harmonic of *φ̇*. A model of the heave needs these three coefficients and no others.

ParticipationDisplay.from_system(ltp, n_harmonics=1)

# %%
# How small is small?
# -------------------
# Compare the nonlinear wing, without its trim, with the linear one, for doublets of four sizes.

in_trim = fly(0.0)


def linear(share):
    """The same doublet through the linear periodic model."""
    return pd.DataFrame(ltp.simulate(share * torque * doublet, t), t, ["w", "phi_dot"])


error = {
    f"{share:.0%}": (fly(share) - in_trim - linear(share)).std() / linear(share).std()
    for share in (0.01, 0.05, 0.2, 0.5)
}
print("error of the linear model, as a share of its response")
print(pd.DataFrame(error).round(4))

# %%

ResponseDisplay.from_data(
    fly(0.5) - in_trim,
    {"linear": linear(0.5)},
    measured_name="nonlinear, doublet of 50 %",
    span=(0.0, 1.5),
    units=units,
)

# %%
# What was learned
# ----------------
# The error of the linear model grows in proportion to the doublet. A doublet of one or two
# percent, as in the paper, leaves an error far below usual noise.
#
# * Your own systems: :class:`~sklearn_hd.systems.PeriodicSystem` takes any periodic right-hand
#   side; the API reference lists the other ready-made systems.
# * Records with the truth beside them: :func:`~sklearn_hd.datasets.make_flapping_wing`.
# * Next: :ref:`sphx_glr_auto_examples_plot_02_harmonic_analyzer.py`.
