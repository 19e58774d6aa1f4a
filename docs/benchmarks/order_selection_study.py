"""How often does cross-validation find the true order? The table of docs/order_selection.md.

Records of six periodic systems, fresh excitation and noise of 2 % for each seed, analysed period
by period. GridSearchCV over order and block rows of the analyzer and the identification,
PeriodBlockSplit(5), the rule smallest_within_one_standard_error; beside it order="auto".

    python docs/benchmarks/order_selection_study.py --seeds 20 --first-seed 9100
"""

import argparse
import warnings
from collections import Counter

import numpy as np
import pandas as pd
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline
from threadpoolctl import threadpool_limits

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.model_selection import PeriodBlockSplit, smallest_within_one_standard_error
from sklearn_hd.systems import LTPSystem, coupled_oscillators, duffing, flapping_blade, mathieu

NOISE = 0.02  # of the standard deviation of each output's perturbation
ORDERS, BLOCK_ROWS = [1, 2, 3, 4, 5, 6], [4, 6, 8]
N_PERIODS, SAMPLES, QUIET = 160, 32, 16  # QUIET: periods in trim, where there is one
UNIT = 2  # periods, of a 3-2-1-1


def sequences(rng, n_inputs, size=1.0, quiet=3):
    """3-2-1-1 sequences, edges anywhere in the period, some periods apart, inputs by turns."""
    u, unit = np.zeros((N_PERIODS * SAMPLES, n_inputs)), UNIT * SAMPLES
    at = quiet * SAMPLES + int(rng.integers(SAMPLES))
    column = 0
    while at < len(u) - 9 * unit:
        sign = rng.choice([-size, size])
        for units in (3, 2, 1, 1):
            u[at : at + units * unit, column] = sign
            sign, at = -sign, at + units * unit
        at += int(rng.integers(2, 6)) * SAMPLES
        column = (column + 1) % n_inputs
    return u


def random_system(rng):
    """Three states of which two are measured, every Floquet multiplier between 0.1 and 0.95."""
    while True:
        F = 0.15 * rng.standard_normal((3, 3, 3))
        F[0] = 0.4 * rng.standard_normal((3, 3)) - 0.2 * np.eye(3)
        G = rng.standard_normal((3, 1))
        system = LTPSystem(F, G, np.eye(3)[:2], omega=2.0 * np.pi / rng.uniform(0.8, 1.5))
        size = np.abs(np.linalg.eigvals(system.monodromy()))
        if size.min() >= 0.1 and size.max() <= 0.95:
            return system


def linear(system):
    """Records of a linear system, or of a new one each time."""

    def make(rng):
        drawn = system(rng) if callable(system) else system
        t = np.arange(N_PERIODS * SAMPLES) * drawn.period / SAMPLES
        u = sequences(rng, len(drawn.input_names))
        y = np.asarray(drawn.simulate(u, t))
        return t, u, y, y, 2.0 * np.pi / drawn.period, None

    return make


def hardening(rng):
    """Raw measurements of Duffing's oscillator about its orbit, driven by half a percent more."""
    system = duffing()
    trim, t = system.trim(n_harmonics=16), np.arange(N_PERIODS * SAMPLES) * system.period / SAMPLES
    u = sequences(rng, 1, size=0.005, quiet=QUIET)
    orbit = np.asarray(trim.states(system.omega * t))
    y = np.asarray(system.simulate(u, t, x0=orbit[0], rtol=1e-9, atol=1e-10))
    return t, u, y, y - orbit, system.omega, (0.0, t[QUIET * SAMPLES])


def wing(rng):
    """Raw measurements of the nonlinear flapping wing, driven by 2 % of its torque."""
    data = make_flapping_wing(
        "nltp", input="3211", width=4, n_periods=N_PERIODS, samples_per_period=SAMPLES,
        random_state=int(rng.integers(2**31)),
    )  # fmt: skip
    t, y = data.inputs.index.to_numpy(), data.outputs.to_numpy()
    orbit = np.asarray(data.trim.states(data.omega * t))
    return t, data.inputs.to_numpy(), y, y - orbit, data.omega, data.trim_span


SYSTEMS = {
    "mathieu": (2, linear(mathieu())),
    "flapping_blade(gamma=4)": (2, linear(flapping_blade(gamma=4.0))),
    "coupled_oscillators": (4, linear(coupled_oscillators())),
    "random, one a record": (3, linear(random_system)),
    "duffing, raw": (2, hardening),
    "flapping_wing, raw": (2, wing),
}


def chosen(make, seed):
    """Orders by search and by ``order="auto"`` of one record."""
    rng = np.random.default_rng(seed)
    t, u, y, perturbation, omega, trim_span = make(rng)
    y = y + NOISE * perturbation.std(axis=0) * rng.standard_normal(y.shape)
    index = pd.Index(t, name="time")
    u, y = pd.DataFrame(u, index).add_prefix("u"), pd.DataFrame(y, index).add_prefix("y")
    analyzer = HarmonicAnalyzer(omega, reading="period", output_harmonics=1, trim_span=trim_span)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())])
    search = GridSearchCV(
        pipe,
        {"identify__order": ORDERS, "identify__block_rows": BLOCK_ROWS},
        cv=PeriodBlockSplit(5, omega=omega, trim_span=trim_span),
        refit=smallest_within_one_standard_error,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of states too many, fitted to noise
        found = search.fit(u, y).best_params_["identify__order"]
        return found, pipe.fit(u, y)["identify"].order_


def parse_arguments():
    parser = argparse.ArgumentParser(description="How often the true order is found.")
    parser.add_argument("--seeds", type=int, default=20, help="records a system (default 20)")
    parser.add_argument("--first-seed", type=int, default=9100, help="the first (default 9100)")
    parser.add_argument("--only", default="", help="part of a system's name")
    return parser.parse_args()


def main():
    arguments = parse_arguments()
    print("| system | states | orders by search (times) | right | orders by auto | right |")
    print("|---|---|---|---|---|---|")
    for name, (n_states, make) in SYSTEMS.items():
        if arguments.only not in name:
            continue
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
        orders = zip(*(chosen(make, seed) for seed in seeds), strict=True)
        row = [name, n_states]
        for found in map(Counter, orders):
            row.append(", ".join(f"{order} ({times})" for order, times in sorted(found.items())))
            row.append(f"{100 * found[n_states] / len(seeds):.0f} %")
        print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(limits=1):  # the matrices are small: threads cost more than they save
        main()
