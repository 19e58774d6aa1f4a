"""
Back to the periodic system
===========================

Can a record give the time-periodic system itself, and not only a model of its harmonics?
"""

# %%
# The record
# ----------
# The record shows the linear time-periodic flapping wing under a repeated 3-2-1-1 input, first
# without noise.

# sphinx_gallery_thumbnail_number = 3
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
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.plotting import (
    HarmonicsDisplay,
    HarmonicTransferFunctionDisplay,
    PeriodicMatrixDisplay,
)

record = {"kind": "ltp", "input": "3211", "n_periods": 100, "width": 3}
data = make_flapping_wing(**record)
wing, omega = data.ltp, data.omega  # the truth, to compare with
units = {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}
kept = {"U": [0], "w": [0], "phi_dot": [1]}
signals = data.inputs.join(data.outputs)
HarmonicsDisplay.from_data(signals, omega, kept, span=(0.0, 2.0), units=units)

# %%
# Period by period
# ----------------
# ``reading="period"`` takes one step per wingbeat. From one wingbeat to the next a
# periodic system is exactly time-invariant: no spurious modes, and as many states as the system
# has. The motion within a wingbeat then gives its matrices.


def identify(data, structure, criterion):
    """All steps, period by period."""
    steps = [
        ("harmonics", HarmonicAnalyzer(omega, output_harmonics=2, reading="period")),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher(structure=structure, criterion=criterion)),
    ]
    return Pipeline(steps).fit(data.inputs, data.outputs)


clean = identify(data, HarmonicStructure(), "hinf")
print("states:", clean["identify"].order_)
print("Floquet exponents, identified:", clean["match"].ltp_.floquet_exponents().real)
print("                         true:", wing.floquet_exponents().real)

# %%
# The result contains all of *F(ψ)*, including its kinks:

PeriodicMatrixDisplay.from_estimator(clean, "F", true=wing, units=units)

# %%
# With noise
# ----------
# White noise of a twentieth of each output's standard deviation hides details. State how many
# harmonics *F* may have, and that the torque drives *φ̇* through one harmonic, and search for the
# parameters of largest likelihood.

noisy = make_flapping_wing(**record, snr=20, random_state=0)
structure = HarmonicStructure(F=4, G={"1c": [[0.0], ["gain"]]})
pipe = identify(noisy, structure, "output_error")
PeriodicMatrixDisplay.from_estimator(pipe, "F", true=wing, units=units)

# %%
# Four harmonics round off the kinks, and *F[w, w]* affects the outputs too little for a good
# estimate. The
# exponents, with their standard deviations:

pipe["match"].eigenvalues_.map("{:.3f}".format)

# %%
# This system has a harmonic decomposition for any number of harmonics:

ltp = pipe["match"].ltp_
for n in (1, 2, 3):
    A, exact = ltp.harmonic_decomposition(n).A, wing.harmonic_decomposition(n).A
    error = np.linalg.norm(A - exact) / np.linalg.norm(exact)
    print(f"N = {n}: {len(A)} states, error of A {100 * error:.2f} %")

# %%
# Is a periodic model needed?
# ---------------------------
# A new record, with an input that changes at random, answers that without any model. An input at a
# frequency Ω causes outputs at Ω + nω. For a time-invariant system only the panel *n = 0* has a
# response; there the wing's *φ̇* shows nothing but noise.

rng = np.random.default_rng(1)
t = pd.Index(np.arange(1000 * 32) * wing.period / 32, name="time")
u = pd.DataFrame({"U": np.repeat(rng.choice([-1e-4, 1e-4], len(t) // 4), 4)}, t)
y = pd.DataFrame(wing.simulate(u, t), t, ["w", "phi_dot"])
y += 0.05 * y.std().to_numpy() * rng.standard_normal(y.shape)
display = HarmonicTransferFunctionDisplay.from_data(
    u, y, omega, systems={"identified": ltp}, plotted={"outputs": ["phi_dot"], "units": units}
)
display.axes_[0].set_xlim(0, 3 * omega)

# %%
# What was learned
# ----------------
# A record without noise gives the whole periodic system. A noisy one gives its exponents and the
# entries that move the outputs most, and each number has a standard deviation.
#
# * When to use this way, and when the sliding analyzer: :doc:`/periodic_models`.
# * Frequency responses of periodic systems: :doc:`/frequency_domain`.
# * Further results: :class:`~sklearn_hd.systems.LTPSystem`.
