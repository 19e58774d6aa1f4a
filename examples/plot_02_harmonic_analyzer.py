"""
What a harmonic analyzer does to a signal
=========================================

What is slow in a signal that repeats itself with every wingbeat?
"""

# %%
# The signals
# -----------
# A flapping wing responds to a doublet of its torque. The upper panels show the signals in grey:
# the vertical speed *w* and the flapping speed *φ̇*, which oscillates with each wingbeat. The
# lower panels show in colour what the analyzer computes from them: the mean of *w*, and the cosine
# and sine parts of *φ̇*.

# sphinx_gallery_thumbnail_number = 2
import numpy as np

from sklearn_hd import HarmonicAnalyzer
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.plotting import HarmonicsDisplay, ResponseDisplay

options = {"n_periods": 60, "start": 5, "width": 10}
data = make_flapping_wing("lti-signal", **options)
y, omega = data.outputs, data.omega
units = {"w": "m/s", "phi_dot": "rad/s"}
kept = {"w": [0], "phi_dot": [1]}  # harmonic 0 is the mean

HarmonicsDisplay.from_data(y, omega, kept, units=units)

# %%
# The coefficients are slow where the signal is fast, so a time-invariant model can describe them.
# To find them the analyzer multiplies the signal by cos ψ and sin ψ and averages over a window of
# one period: ψ = ωt is the phase of the wingbeat.
#
# How accurate are they?
# ----------------------
# These signals were made from known coefficients, so the analyzer can be checked.
# ``"boxcar"`` looks back over one period, ``"hann"`` over two; ``"centred-boxcar"`` looks to both
# sides and has no delay.

exact = make_flapping_wing("lti", **options).outputs
analyzed = {
    window: HarmonicAnalyzer(omega, input_harmonics=kept, window=window)
    .fit_transform(y)[exact.columns]
    .iloc[128:]  # whole windows
    for window in ("boxcar", "centred-boxcar", "hann")
}
coefficients = {"w_0": "m/s", "phi_dot_1c": "rad/s", "phi_dot_1s": "rad/s"}
ResponseDisplay.from_data(
    exact.iloc[128:], analyzed, measured_name="exact", span=(0.1, 1.2), units=coefficients
)

# %%
# Where a coefficient jumps, an average over a wingbeat cannot follow: the edges are rounded.
#
# What it adds
# ------------
# *w* was made without a first harmonic, but the analyzer finds one.

HarmonicsDisplay.from_data(y["w"], omega, 1, span=(1.0, 1.4), units=units)

# %%
# While *w* decays, the average of w cos ψ over a period is not quite zero. The rest turns with the
# wingbeat: the mode λ appears again at λ ± jω. Such *copies* are not modes of the wing. Their size
# follows from the window:
#
# .. math:: \frac{|w_1|}{|w|} = \frac{2\,|1 - e^{-\lambda T}|}{|\lambda - j\omega|\,T}

first = HarmonicAnalyzer(omega, input_harmonics=1).fit_transform(y["w"])
slow = max(np.linalg.eigvals(data.A_exact), key=lambda z: z.real).real
period = 2 * np.pi / omega
measured = np.hypot(first["w_1c"], first["w_1s"]) / first["w"].abs()
predicted = 2 * abs(1 - np.exp(-slow * period)) / abs(slow - 1j * omega) / period
print(f"size of the copy: measured {measured.iloc[-1]:.5f}, predicted {predicted:.5f}")

# %%
# And back
# --------
# ``inverse_transform`` reconstructs a signal from its coefficients. With one harmonic kept, the
# result is the signal as the window saw it. With all the harmonics that the samples hold, it is
# the signal itself.

for reading, harmonics in (("sliding", 1), ("sliding", 32), ("period", 1), ("period", 32)):
    analyzer = HarmonicAnalyzer(omega, input_harmonics=harmonics, reading=reading).fit(y)
    back = analyzer.inverse_transform(analyzer.transform(y))
    lost = (back - y).dropna()["phi_dot"].std() / y["phi_dot"].std()
    print(f"{reading:7} harmonics 0 to {harmonics:<3} lost of phi_dot: {lost:.1e}")

# %%
# What was learned
# ----------------
# An analyzer turns fast signals into slow ones. It also adds copies of every mode and a memory as
# long as its window; both appear in the identified model.
#
# * Every choice of window, hop and harmonics: :class:`~sklearn_hd.HarmonicAnalyzer`.
# * How to choose them: :doc:`/guide/1_data`.
# * How to separate copies from modes: :ref:`sphx_glr_auto_examples_plot_04_spurious_modes.py`.
