"""Delays of an input and of an output of the flapping wing: error, bound and intervals.

The wing with four harmonics in F, a doublet of 2 % whose edges lie at four phases (5.3 periods a
step), 32 samples a period, 40 periods: the torque comes 6.3 samples late, φ̇ is measured 1.8 samples
late. Both delays are "auto"; all entries of F and the size of the torque's effect are parameters,
too. The noise is white, of 1/20 of each output's standard deviation.

    python docs/benchmarks/delays_study.py --seeds 200

prints, for each delay, the root mean square error, the Cramér-Rao bound at the truth, their ratio,
the mean error in parts of its standard error, and how often the 95 % interval holds.
"""

import argparse
import warnings

import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.algorithms.likelihood.delay_search import Cells
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.signals.resampling import lagged
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.systems import LTPSystem

SAMPLES, LATE = 32, {"U": 6.3, "phi_dot": 1.8}  # a period, and of delay
STRUCTURE = HarmonicStructure(F=4, G={"1c": [[0.0], ["gain"]]})
NORMAL_95 = 1.959964


def wing():
    """The linear time-periodic wing with four harmonics in F."""
    system = make_flapping_wing(n_periods=20, start=5, width=2).ltp
    F, G, P, _ = system.fourier_coefficients(4)
    names = {name: getattr(system, name) for name in ("state_names", "input_names", "output_names")}
    return LTPSystem(F, G[:3], P[:1], omega=system.omega, **names)


def record(system, n_periods):
    """Inputs, and outputs without noise, of delays that switch and read between the samples."""
    data = make_flapping_wing(n_periods=n_periods, start=4, width=5.3, samples_per_period=SAMPLES)
    time, u, dt = data.inputs.index.to_numpy(), data.inputs.to_numpy(), data.sample_time
    switches, reads = time + LATE["U"] * dt, time - LATE["phi_dot"] * dt
    instants = np.unique(np.round(np.concatenate([time, switches, reads]), 12))
    arrived = np.searchsorted(switches, instants + 1e-9, side="right") - 1
    y = system.simulate(u[np.maximum(arrived, 0)], instants)  # at rest before
    at = [np.searchsorted(instants, each - 1e-9) for each in (time, reads)]
    outputs = pd.DataFrame({"w": y[at[0], 0], "phi_dot": y[at[1], 1]}, data.inputs.index)
    return data.inputs, outputs, dt


def bound(system, inputs, outputs, dt, share):
    """Cramér-Rao bound of both delays, seconds, every other parameter being unknown."""
    F, G, P, _ = system.fourier_coefficients(4)
    names = system.state_names, system.input_names, system.output_names
    structure = STRUCTURE.resolve(*names, {"F": 4, "G": 1, "P": 0})
    coefficients = np.zeros(structure.constant.shape)
    coefficients[:, :2, :2], coefficients[:, :2, 2:] = F, G
    coefficients[0, 2:, :2] = P[0]
    cells = Cells.of([LATE["U"], 0.0, LATE["phi_dot"]], 1, [True, False, True])
    form = Form(structure, system.omega, SAMPLES, delays=cells.fractions)
    u, y = inputs.to_numpy(), lagged(outputs.to_numpy(), -cells.output_lags)
    u = np.hstack([lagged(u, cells.input_lags), lagged(u, cells.input_lags + 1)])
    first, last = 8, len(u) - 4
    segment = [(u[first:last], y[first:last], first)]
    sigma = share * outputs.std().to_numpy()
    problem = likelihood_problem(form, segment, sigma)
    theta = np.concatenate([structure.nearest(coefficients), cells.fractions.start])
    point = problem.point(theta, np.zeros((1, 2)))
    covariance, _ = problem.linearise(point).covariance()
    return np.sqrt(np.diag(covariance)[-2:]) * dt


def pipeline(omega):
    """Identification of everything, both delays among it."""
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, reading="period", output_harmonics=1)),
            ("identify", MOESPRegressor(2, input_delay="auto", output_delay={"phi_dot": "auto"})),
            ("match", StructuredMatcher(structure=STRUCTURE, criterion="output_error")),
        ]
    )


def study(seeds, n_periods=40, share=0.05):
    """Errors in parts of the bound, in parts of the deviations said, and what they are of."""
    system = wing()
    inputs, clean, dt = record(system, n_periods)
    truth = dt * np.array(list(LATE.values()))
    errors, said = [], []
    for seed in seeds:
        noise = np.random.default_rng(seed).standard_normal(clean.shape)
        outputs = clean + share * clean.std().to_numpy() * noise
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            match = pipeline(system.omega).fit(inputs, outputs)["match"]
        errors.append(match.delays_[list(LATE)].to_numpy() - truth)
        said.append(match.delay_std_[list(LATE)].to_numpy())
    return np.array(errors), np.array(said), bound(system, inputs, clean, dt, share)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--periods", type=int, default=40)
    asked = parser.parse_args()
    errors, said, least = study(range(asked.first, asked.first + asked.seeds), asked.periods)
    rms, count = np.sqrt(np.mean(errors**2, axis=0)), len(errors)
    holds = np.mean(np.abs(errors) <= NORMAL_95 * said, axis=0)
    bias = np.mean(errors, axis=0) / (rms / np.sqrt(count))
    print(
        "delay      rms error   bound       rms/bound  mean (in its error)  95 % holds  worst |z|"
    )
    for k, name in enumerate(LATE):
        print(
            f"{name:9}  {rms[k]:.3e} s {least[k]:.3e} s {rms[k] / least[k]:7.3f}   "
            f"{bias[k]:14.2f}        {100 * holds[k]:8.1f} %  "
            f"{np.max(np.abs(errors[:, k] / said[:, k])):8.2f}"
        )


if __name__ == "__main__":
    main()
