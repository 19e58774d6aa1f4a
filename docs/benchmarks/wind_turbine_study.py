"""Modes of the 5 MW turbine from noisy records of its periodic model, against the truth.

    python docs/benchmarks/wind_turbine_study.py --seeds 20 --first-seed 1000

Period by period (``reading="period"``), one percent of noise; frequencies and damping ratios
of the five lightly damped modes below 2 Hz.
"""

import argparse
import warnings

import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import load_wind_turbine
from sklearn_hd.exceptions import InstabilityWarning
from sklearn_hd.systems import multiblade_model, rotor_system

INPUTS = ["TFA1_dot", "TSS1_dot", "BE1_b1_dot"]
TOWER = ["TFA1_dot", "TSS1_dot"]
BLADES = ["BE1_b1_dot", "BE1_b2_dot", "BE1_b3_dot"]
KEPT = {name: [2, 3] for name in TOWER} | {name: [5, 9, 10] for name in BLADES}
HIGHEST_FREQUENCY = 2.0  # Hz
LIGHT = 0.1  # damping ratio
SAMPLES = 32  # a period


def turbine():
    """The turbine at 3 m/s, tower and edgewise rates measured, forces on both."""
    return rotor_system(
        load_wind_turbine(3).linearizations, inputs=INPUTS, outputs=[*TOWER, *BLADES]
    )


def true_modes():
    """Lightly damped eigenvalues in multi-blade coordinates, by frequency."""
    poles = multiblade_model(load_wind_turbine(3).linearizations).poles()
    size = np.abs(poles)
    light = (poles.imag > 0) & (-poles.real < LIGHT * size)
    light &= size < 2 * np.pi * HIGHEST_FREQUENCY
    return poles[light][np.argsort(size[light])]


def record(system, *, n_periods=300, noise=0.01, seed=0):
    """Forces of one waveform, whose sign changes from period to period at random.

    Eleven harmonics (2 to 12 a turn) of equal size and quadratic phases, within each of the
    three inputs one direction to be told apart.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(n_periods * SAMPLES) * system.period / SAMPLES
    harmonics = np.arange(2, 13)
    phases = np.pi * np.arange(len(harmonics)) ** 2 / len(harmonics)
    wave = 0.1 * np.cos(harmonics * (system.omega * t[:SAMPLES, None]) - phases).mean(axis=1)
    signs = rng.choice([-1.0, 1.0], size=(n_periods, 1, system.n_inputs))
    u = (signs * wave[:, None]).reshape(-1, system.n_inputs)
    y = system.simulate(u, t)
    y += noise * y.std(axis=0) * rng.standard_normal(y.shape)
    time = pd.Index(t, name="time")
    inputs = pd.DataFrame(u, time, list(system.input_names))
    return inputs, pd.DataFrame(y, time, list(system.output_names))


def pipeline(omega, order=10):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, output_harmonics=KEPT, reading="period")),
            ("identify", MOESPRegressor(order=order, block_rows=3)),
        ]
    )


def fixed_modes(model, omega, names):
    """Eigenvalues in the frame that does not turn.

    Seen once a turn, e^{λT} leaves Im λ unknown up to multiples of Ω. Harmonic k of the
    tower shows a mode at Im λ + kΩ; so does harmonic k of the blades with Im λ + (k − n)Ω,
    where they move as e^{jnψ_b} does: all alike (n = 0), or whirling (n = ±1). The harmonic
    in which a mode is largest decides.
    """
    multipliers, vectors = np.linalg.eig(model.A)
    exponents = np.log(multipliers.astype(complex)) * omega / (2 * np.pi)
    shifts, sizes = [], []
    for signals, patterns in ((TOWER, [0]), (BLADES, [0, 1, -1])):
        for k in KEPT[signals[0]]:
            cosine, sine = (
                model.C[[names.index(f"{name}_{k}{part}") for name in signals]] @ vectors
                for part in "cs"
            )
            for n in patterns:
                phase = np.exp(-2j * np.pi * n * np.arange(len(signals)) / len(BLADES))
                if signals is TOWER:
                    phase = np.eye(len(signals))
                for sign in (1, -1):
                    size = np.atleast_2d(phase.conj() if sign < 0 else phase) @ (
                        cosine - 1j * sign * sine
                    )
                    shifts.append(sign * (k - n))
                    sizes.append(np.linalg.norm(size, axis=0) / np.sqrt(len(signals)))
    found = exponents + 1j * omega * np.array(shifts)[np.argmax(sizes, axis=0)]
    return found[found.imag > 0]


def table(found, truth):
    """Frequency in Hz and damping ratio in per cent, beside the nearest truth."""
    rows = []
    for mode in truth:
        other = found[np.argmin(np.abs(found - mode))] if len(found) else np.nan
        rows.append([*_frequency_and_damping(mode), *_frequency_and_damping(other)])
    columns = ["f", "zeta", "f found", "zeta found"]
    return pd.DataFrame(rows, columns=columns)


def _frequency_and_damping(mode):
    return np.abs(mode) / (2 * np.pi), -100 * mode.real / np.abs(mode)


def study(seeds, **settings):
    """One table a seed."""
    system, truth = turbine(), true_modes()
    tables = []
    for seed in seeds:
        u, y = record(system, seed=seed, **settings)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InstabilityWarning)  # the yaw is free, and drifts
            fitted = pipeline(system.omega).fit(u, y)
        step = fitted["identify"]
        names = list(step.system_.output_labels)
        found = fixed_modes(step.system_, system.omega, names)
        tables.append(table(found, truth))
    return pd.concat(tables, keys=seeds, names=["seed", "mode"])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--periods", type=int, default=300)
    parser.add_argument("--noise", type=float, default=0.01)
    options = parser.parse_args()
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    result = study(seeds, n_periods=options.periods, noise=options.noise)
    result["f error, %"] = 100 * np.abs(result["f found"] / result["f"] - 1)
    result["zeta error, points"] = np.abs(result["zeta found"] - result["zeta"])
    by_mode = result.groupby("mode")
    print(by_mode.median().to_string(float_format="{:.4f}".format))
    print(by_mode[["f error, %", "zeta error, points"]].max().to_string())


if __name__ == "__main__":
    main()
