"""
A rotor in service
==================

What can you learn from the record of a rotor that could not be stopped, trimmed or tested on a
quiet day?
"""

# %%
# The record
# ----------
# A blade flaps in forward flight. Its pitch moves all the time, the air loads it with every turn,
# and gusts disturb it. The logger takes a hundred samples per second, independent of the rotor,
# and stores the azimuth beside the pitch and the flap angle: 16.2 samples per turn, at a speed
# that varies by a percent. Only a file is left.

# sphinx_gallery_thumbnail_number = 2
import tempfile
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import make_rotor
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning
from sklearn_hd.model_selection import BlockSplit, smallest_within_one_standard_error
from sklearn_hd.plotting import AzimuthDisplay

truth = make_rotor(speed_variation=0.01, random_state=13)
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder, "service.csv")
    truth.inputs.join([truth.azimuth, truth.outputs]).to_csv(file)
    record = pd.read_csv(file, index_col="time")

X, y = record[["pitch", "psi"]], record[["flap"]]
split = 2 * len(record) // 3
X_new, y_new = X.iloc[split:], y.iloc[split:]
record.head(3).round(4)

# %%
# The model
# ---------
# ``reading="sample"`` uses each row as a sample at its azimuth, so it needs neither a span in trim
# nor a whole number of samples per turn. The model's coefficients are Fourier series of the
# azimuth. The loads of the air are identified together with the dynamics. The data choose the
# order, the lags of the predictor and the numbers of harmonics; the last third of the record is
# kept for validation. The fit compares the two halves of the record, and may warn of uncertain
# modes: the last of the three here dies within a fraction of a turn.

pipe = Pipeline(
    [
        ("harmonics", HarmonicAnalyzer(azimuth="psi", reading="sample")),
        ("identify", MOESPRegressor()),
    ]
)
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always", IdentifiabilityWarning)
    pipe.fit(X.iloc[:split], y.iloc[:split])
model = pipe["identify"]
print(f"order {model.order_}, {model.n_harmonics_} harmonics, {model.block_rows_} lags")
print(*(each.message for each in told), sep="\n")

# %%
# Loads
# -----
# Most of the sensor signal is independent of the pitch. ``loads_`` holds the Fourier coefficients
# of the flapping without any input.

psi = np.linspace(0.0, 2.0 * np.pi, 361)


def over_azimuth(coefficients):
    """A waveform in degrees of its Fourier coefficients 0, 1c, 1s, …"""
    k = np.arange(1, len(coefficients) // 2 + 1)
    waves = np.stack([np.cos(np.outer(psi, k)), np.sin(np.outer(psi, k))], axis=-1)
    functions = np.hstack([np.ones((len(psi), 1)), waves.reshape(len(psi), -1)])
    return np.rad2deg(functions @ coefficients["flap"])


figure, ax = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
ax.plot(np.rad2deg(X["psi"]), np.rad2deg(y["flap"]), ".", color="0.8", ms=2, label="measured")
ax.plot(np.rad2deg(psi), over_azimuth(model.loads_), "C1", lw=2, label="loads found")
ax.plot(np.rad2deg(psi), over_azimuth(truth.loads), "k--", lw=1, label="true")
ax.set(xlabel="azimuth, degrees", ylabel="flap angle, degrees", xticks=range(0, 361, 90))
ax.legend(loc="upper right", ncols=3)

# %%
# The response to the pitch
# -------------------------
# A usual method for such records is time-invariant identification, with cosines and sines of the
# azimuth as further inputs. These represent the loads, but the response of the blade to its pitch
# is then the same at all azimuths.

LAST = slice(-65, None)  # four turns


def with_turns(X):
    """The pitch beside three harmonics of the turn."""
    waves = {
        f"{name}{k}": function(k * X["psi"])
        for k in (1, 2, 3)
        for name, function in {"cos": np.cos, "sin": np.sin}.items()
    }
    return X[["pitch"]].assign(**waves)


with warnings.catch_warnings():
    warnings.simplefilter("ignore", ExcitationWarning)  # sines excite few directions
    invariant = MOESPRegressor().fit(
        with_turns(X.iloc[:split]), y.iloc[:split] - y.iloc[:split].mean()
    )

still = X_new.assign(pitch=0.0)
responses = {
    "LTI beside the turn": invariant.predict(with_turns(X_new))
    - invariant.predict(with_turns(still)),
    "samples at their azimuths": pipe.predict(X_new) - pipe.predict(still),
}
true = truth.response.iloc[split:]
for name, response in responses.items():
    share = 1.0 - ((response - true) ** 2).sum() / (true**2).sum()
    print(f"{name}: {share['flap']:.1%} of the response on new turns")

# %%
# The modes
# ---------
# A Floquet multiplier is the share of a mode that is left a turn later. ``ltp_`` is the linear
# time-periodic system behind the samples, in continuous time; its exponents are the logarithms of
# the multipliers, per second. A blade with its actuator has three.

exponents = model.ltp_.floquet_exponents()
pd.DataFrame({"found": np.sort_complex(exponents), "true": np.sort_complex(truth.exponents)}).round(
    1
)

# %%

figure, (ax, plane) = plt.subplots(
    1, 2, figsize=(10, 3.8), width_ratios=[3, 2], layout="constrained"
)
ax.plot(np.rad2deg(true["flap"].iloc[LAST]), "k", lw=3, alpha=0.3, label="true")
for (name, response), color in zip(responses.items(), ["C0", "C1"], strict=True):
    ax.plot(np.rad2deg(response["flap"].iloc[LAST]), color, lw=1.5, label=name)
ax.set(xlabel="time, s", ylabel="response to the pitch, degrees")
ax.legend(loc="lower left", fontsize="small")
plane.add_patch(plt.Circle((0, 0), 1, fill=False, color="0.5"))
multipliers = np.exp(truth.exponents * 2.0 * np.pi / truth.omega)
plane.plot(multipliers.real, multipliers.imag, "k+", ms=12, label="true")
found = model.eigenvalues_
plane.plot(found.real, found.imag, "C1o", mfc="none", ms=8, label="found")
plane.set(xlabel="real", ylabel="imaginary", aspect="equal", title="Floquet multipliers")
plane.legend(loc="upper right")

# %%
# :class:`~sklearn_hd.plotting.AzimuthDisplay` shows what changes over a turn: the loads, and the
# blade's response to a pulse of its pitch, for each azimuth of the pulse.

AzimuthDisplay.from_estimator(pipe)

# %%
# A sample ahead
# --------------
# ``predict`` simulates: it computes outputs from inputs and knows no gusts. ``predict_ahead`` also
# reads the flapping up to the sample before, and therefore knows the gust that has just arrived.

simulated = pipe.predict(X_new)
ahead = model.predict_ahead(pipe[:1].transform(X_new), y_new)
for name, predicted in {"simulated": simulated, "one sample ahead": ahead}.items():
    left = np.rad2deg((predicted - y_new).std()["flap"])
    print(f"{name}: {left:.3f} degrees left of {np.rad2deg(y_new.std()['flap']):.2f}")

# %%
# Cross-validated
# ---------------
# Folds may cut the record anywhere, because no turn has to be whole. The table shows R² on the
# test folds, by order and by harmonics of the predictor.

search = GridSearchCV(
    pipe,
    {"identify__order": [2, 3, 4], "harmonics__output_harmonics": [0, 1, 2]},
    cv=BlockSplit(3),
    refit=smallest_within_one_standard_error,
)
with warnings.catch_warnings():
    warnings.simplefilter("ignore", IdentifiabilityWarning)  # of the same mode
    search.fit(X.iloc[:split], y.iloc[:split])
print(search.best_params_)
scores = pd.DataFrame(search.cv_results_)
scores.pivot_table(
    index="param_identify__order",
    columns="param_harmonics__output_harmonics",
    values="mean_test_score",
).round(4)

# %%
# What was learned
# ----------------
# - A record in service needs no trim and no clock tied to the rotor:
#   ``HarmonicAnalyzer(azimuth="psi", reading="sample")``, or ``omega`` where the speed is constant.
# - Loads are separate from the dynamics: ``loads_`` of :class:`~sklearn_hd.MOESPRegressor`.
# - A time-invariant model represents the loads as further inputs, and misses how the blade's
#   response changes over the turn.
# - Which reading for which record: :doc:`the user guide </guide/1_data>`; the algorithm:
#   :doc:`theory </theory>`.
