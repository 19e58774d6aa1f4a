"""
A helicopter blade and a wind turbine
=====================================

How well damped are machines with turning blades, such as a helicopter blade in forward flight and
a 5 MW wind turbine?
"""

# %%
# A blade in forward flight
# -------------------------
# An advancing blade meets more wind than a retreating one. Stiffness and damping of its flapping
# therefore change within each turn, and more so at higher flight speed (advance ratio μ). Here a
# blade at μ = 0.4 responds to collective pitch that changes sign at random, four times per turn;
# noise is a fiftieth of each signal.

# sphinx_gallery_thumbnail_number = 2
import warnings

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.datasets import load_wind_turbine
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning
from sklearn_hd.plotting import HarmonicsDisplay, SingularValueDisplay
from sklearn_hd.systems import flapping_blade, multiblade_model, rotor_system

rng = np.random.default_rng(0)
gamma, spp, n_turns = 12.0, 16, 400


def fly(mu):
    """Pitch and flapping of the blade at one advance ratio."""
    blade = flapping_blade(gamma=gamma, mu=mu)
    t = pd.Index(np.arange(n_turns * spp) * blade.period / spp, name="time")
    pitch = pd.DataFrame({"theta_0": rng.choice([-0.02, 0.02], 4 * n_turns).repeat(spp // 4)}, t)
    flap = pd.DataFrame(blade.simulate(pitch, t), t, list(blade.output_names))
    flap += 0.02 * flap.std().to_numpy() * rng.standard_normal(flap.shape)
    return pitch, flap


pitch, flap = fly(mu=0.4)
units = {"theta_0": "rad", "beta": "rad", "beta_dot": "rad/s"}
HarmonicsDisplay.from_data(pitch.join(flap), 1.0, 0, span=(0, 100), units=units)

# %%
# Analysed turn by turn, the record gives the blade's equation of motion, with coefficients as
# Fourier series of the azimuth, and from these the Floquet exponents with standard deviations.

pipe = Pipeline(
    [
        ("harmonics", HarmonicAnalyzer(1.0, output_harmonics=1, reading="period")),
        ("identify", MOESPRegressor(order=2)),
        (
            "match",
            StructuredMatcher(structure=HarmonicStructure(F=2, G=2), criterion="output_error"),
        ),
    ]
)


def exponents(pitch, flap):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InstabilityWarning)  # of the first guess, under noise
        warnings.simplefilter("ignore", IdentifiabilityWarning)  # the intervals tell, below
        return pipe.fit(pitch, flap)["match"].eigenvalues_


found = exponents(pitch, flap)
found.assign(true=flapping_blade(gamma=gamma, mu=0.4).floquet_exponents()).map("{:.3f}".format)

# %%
# In hover, theory gives a pair, −γ/16 ± j √(ν² − (γ/16)²) in rotor frequencies. With growing μ its
# frequency moves to one half. There the pair splits into two exponents, one less damped than in
# hover and one more; their sum stays −γ/8. Four flights, with intervals of 95 %:

ratios = np.linspace(0.0, 0.5, 101)
theory = [flapping_blade(gamma=gamma, mu=mu).floquet_exponents().real for mu in ratios]
figure, ax = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
ax.plot(ratios, np.sort(theory), color="C0", label=["theory", None])
for mu in (0.1, 0.3, 0.4, 0.5):
    flight = found if mu == 0.4 else exponents(*fly(mu))
    real, spread = flight["eigenvalue"].to_numpy().real, 1.96 * flight["std_real"]
    label = "identified, 95 %" if mu == 0.4 else None
    ax.errorbar([mu, mu], real, spread, fmt="o", color="C1", capsize=4, label=label)
ax.set(xlabel="advance ratio μ", ylabel="real part of the exponents / Ω")
ax.legend(loc="lower left")

# %%
# A 5 MW wind turbine
# -------------------
# OpenFAST has linearised the NREL 5 MW turbine at three azimuths of the rotor, with 30 states;
# those of the blades turn with them. In multi-blade coordinates the three matrices are nearly
# equal.

turbine = load_wind_turbine(wind_speed=3)
print(turbine.DESCR)
frequency, damping, poles = multiblade_model(turbine.linearizations).damp()
light = (poles.imag > 0) & (damping < 0.1) & (frequency < 2 * np.pi * 2.0)
truth = poles[light][np.argsort(frequency[light])]


def hertz_and_percent(modes):
    """Frequency and damping ratio of eigenvalues."""
    return np.abs(modes) / (2 * np.pi), -100 * modes.real / np.abs(modes)


names = ["tower side-to-side", "tower fore-aft", "drivetrain", "edgewise ↓", "edgewise ↑"]
table = pd.DataFrame(np.transpose(hertz_and_percent(truth)), names, ["Hz", "%"])
table.round(3)

# %%
# In the coordinates of the turning blades this is a periodic system. Its Floquet exponents are
# these eigenvalues up to multiples of *jΩ*. Forces on the tower top and on one blade move it: one
# waveform per turn, of random sign. Five rates are measured, with one percent of noise.

tower, edges = ["TFA1_dot", "TSS1_dot"], ["BE1_b1_dot", "BE1_b2_dot", "BE1_b3_dot"]
system = rotor_system(
    turbine.linearizations, inputs=[*tower, "BE1_b1_dot"], outputs=[*tower, *edges]
)
spp, n_turns = 32, 300
t = pd.Index(np.arange(n_turns * spp) * system.period / spp, name="time")
harmonics = np.arange(2, 13)
phases = np.pi * np.arange(len(harmonics)) ** 2 / len(harmonics)
wave = 0.1 * np.cos(harmonics * (system.omega * t.to_numpy()[:spp, None]) - phases).mean(axis=1)
signs = rng.choice([-1.0, 1.0], (n_turns, 1, 3))
force = pd.DataFrame((signs * wave[:, None]).reshape(-1, 3), t, ["F_fore", "F_side", "F_blade"])
motion = pd.DataFrame(system.simulate(force, t), t, list(system.output_names))
motion += 0.01 * motion.std().to_numpy() * rng.standard_normal(motion.shape)
HarmonicsDisplay.from_data(motion[[*tower, "BE1_b1_dot"]], system.omega, 0, span=(0, 120))

# %%
# The analysis works turn by turn and keeps, of each signal, the harmonics in which its modes show:
# tower modes at 2.7 and 2.8 times the rotor frequency, the drivetrain at 5.4, the blades' edgewise
# modes at 9.4. Five modes last longer than a turn. They make ten states, behind which the singular
# values fall to the noise.

kept = {name: [2, 3] for name in tower} | {name: [5, 9, 10] for name in edges}
pipe = Pipeline(
    [
        ("harmonics", HarmonicAnalyzer(system.omega, output_harmonics=kept, reading="period")),
        ("identify", MOESPRegressor(order=10, block_rows=3)),
    ]
)
with warnings.catch_warnings():
    warnings.simplefilter("ignore", IdentifiabilityWarning)  # the truth stands beside them, below
    pipe.fit(force, motion)
SingularValueDisplay.from_estimator(pipe)

# %%
# The eigenvalues are Floquet multipliers; as exponents they are known up to multiples of *jΩ*.
# Compared with the truth, frequencies agree to a few parts in ten thousand and damping ratios to
# some hundredths of a percent.

found = np.log(pipe["identify"].eigenvalues_.astype(complex)) / system.period
gap = found[:, None] - truth
turns = np.round(gap.imag / system.omega)
nearest = np.abs(gap - 1j * system.omega * turns).argmin(axis=0)
modes = truth + (gap - 1j * system.omega * turns)[nearest, np.arange(len(truth))]
table["Hz, found"], table["%, found"] = hertz_and_percent(modes)
table.round(3)

# %%
figure, ax = plt.subplots(figsize=(6.4, 3.8), layout="constrained")
ax.plot(table["Hz"], table["%"], "o", ms=11, mfc="none", mew=2, label="multi-blade model")
ax.plot(table["Hz, found"], table["%, found"], "x", ms=8, mew=2, label="identified")
for name, row in table.iterrows():
    place = (-10, 8) if row["Hz"] > 1 else (10, 6)
    ax.annotate(
        name,
        (row["Hz"], row["%"]),
        place,
        textcoords="offset points",
        ha="right" if row["Hz"] > 1 else "left",
    )
ax.set(xlabel="frequency (Hz)", ylabel="damping ratio (%)", xlim=(0.2, 1.4), ylim=(0, 7))
ax.legend(loc="upper right")

# %%
# What was learned
# ----------------
# A machine that turns needs no special theory: sampled once per turn it is time-invariant. Modes
# that last longer than a turn come back with their damping. Faster ones do not, because they die
# out within a turn.
#
# * Figures over many records, and the limits of three azimuths: :doc:`/world`.
# * Read your own ``.lin`` files: :func:`~sklearn_hd.systems.read_openfast_lin`.
# * When to use ``reading="period"``: :doc:`/periodic_models`.
