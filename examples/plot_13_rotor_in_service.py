"""
A rotor in service
==================

What does a record tell of a rotor that nobody could stop, hold in trim or test on a quiet day?
"""

# %%
# The record
# ----------
# A blade flaps in forward flight. Its pitch is moved all the time; the air that it meets changes
# with every turn and loads it; gusts shake it. The logger takes a hundred samples a second, knows
# nothing of the rotor, and notes the azimuth beside the pitch and the flap angle: 16.2 samples a
# turn, at a speed that varies by a percent. All that is left is a file.

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
# ``reading="sample"`` takes each row as a sample at its azimuth, so that neither a span in trim nor
# a whole number of samples in a turn is needed. The model's coefficients are Fourier series of the
# azimuth; what the air does at every turn is identified together with the dynamics. Order, lags of
# the predictor and numbers of harmonics are left to the data, of which the last third is kept
# for later. The fit compares the two halves of the record, and may warn of modes that it does not
# know well: the last of the three here dies within a fraction of a turn.

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
# Loads apart
# -----------
# Most of what the sensor shows has nothing to do with the pitch. ``loads_`` are the Fourier
# coefficients of the flapping without any input.

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
# Until now such records were given to time-invariant identification, with cosines and sines of
# the azimuth as further inputs. These carry the loads, but the blade answers to its pitch as if
# all azimuths were alike.

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
# The Floquet multipliers say what is left of each mode a turn later. ``ltp_`` is the linear
# time-periodic system behind the samples, in continuous time; its exponents are the logarithms of
# the multipliers, per second. Of a blade and its actuator there are three.

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
# :class:`~sklearn_hd.plotting.AzimuthDisplay` shows at a glance what changes over a turn: the
# loads, and the blade's answer to a pulse of its pitch by the azimuth at which it is given.

AzimuthDisplay.from_estimator(pipe)

# %%
# A sample ahead
# --------------
# ``predict`` simulates: inputs in, outputs out, gusts unknown. ``predict_ahead`` also reads the
# flapping up to the sample before, and so knows of the gust that has just arrived.

simulated = pipe.predict(X_new)
ahead = model.predict_ahead(pipe[:1].transform(X_new), y_new)
for name, predicted in {"simulated": simulated, "one sample ahead": ahead}.items():
    left = np.rad2deg((predicted - y_new).std()["flap"])
    print(f"{name}: {left:.3f} degrees left of {np.rad2deg(y_new.std()['flap']):.2f}")

# %%
# Cross-validated
# ---------------
# Folds may cut the record anywhere, for no turn has to be whole. Below is R² on the folds held
# out, by order and by harmonics of the predictor.

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
# - Loads come out apart from the dynamics, ``loads_`` of :class:`~sklearn_hd.MOESPRegressor`.
# - A time-invariant model carries the loads as further inputs, and misses how the blade's answer
#   changes over the turn.
# - Which reading for which record: :doc:`the user guide </guide/1_data>`; the algorithm:
#   :doc:`theory </theory>`.
