"""How often does cross-validation choose the true order? The table of docs/order_selection.md.

Flapping-wing records of three kinds and three excitations, white noise of 1/20 on the
outputs, GridSearchCV over the order with the rule smallest_within_one_standard_error:
how many of the seeds give the order that was expected beforehand?

    python docs/benchmarks/order_selection_study.py --seeds 20
"""

import argparse
import time
import warnings
from collections import Counter
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import Pipeline
from threadpoolctl import threadpool_limits

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import ExcitationWarning, InstabilityWarning
from sklearn_hd.model_selection import PeriodBlockSplit, smallest_within_one_standard_error

SNR = 20.0
ORDERS = [1, 2, 3, 4, 5, 6]
N_PERIODS, N_BLOCKS, STEP = 220, 5, 4  # of a record excited throughout; STEP: unit of a 3-2-1-1
DOUBLETS = {"n_records": 6, "n_periods": 60, "start": 6, "width": 8}
N_EXCITATIONS = 4  # records without noise, simulated once; every seed has its own noise


@dataclass(frozen=True)
class Row:
    """One row of the table: which data, and the order expected."""

    kind: str
    excitation: str
    expected: int

    @property
    def periodic(self):
        """Excited throughout, one record."""
        return self.excitation != "doublets"

    @property
    def samples_per_period(self):
        return 16 if self.kind == "lti" else 64


ROWS = [
    Row(kind, excitation, expected)
    for kind, expected in (("lti", 3), ("ltp", 2), ("nltp", 2))
    for excitation in ("multisine", "3211", "doublets")
]


@lru_cache
def clean_record(row, excitation_seed):
    """A record without noise, and the standard deviation of each output's perturbation."""
    options = {"samples_per_period": row.samples_per_period, "random_state": excitation_seed}
    if not row.periodic:
        data = make_flapping_wing(row.kind, **DOUBLETS, **options)
    else:
        options |= {"n_periods": N_PERIODS, "width": STEP}
        data = make_flapping_wing(row.kind, input=row.excitation, **options)
    perturbation = data.outputs
    if row.kind == "nltp":
        seconds = data.outputs.index.get_level_values("time").to_numpy()
        perturbation = perturbation - data.trim.states(data.omega * seconds)
    return data, perturbation.std(ddof=0)


def search_order(row, seed):
    """The search for one noisy record, fitted."""
    data, deviation = clean_record(row, seed % N_EXCITATIONS)
    noise = np.random.default_rng(seed).standard_normal(data.outputs.shape)
    y = data.outputs + noise * deviation.to_numpy() / SNR
    trim_span = data.trim_span if row.kind == "nltp" else None
    if row.kind == "lti":
        model = MOESPRegressor()
        grid = {"order": ORDERS, "block_rows": [10, 15]}
    else:
        analyzer = HarmonicAnalyzer(
            data.omega, output_harmonics=3, reading="period", trim_span=trim_span
        )
        model = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())])
        grid = {"identify__order": ORDERS, "identify__block_rows": [4, 6]}
    groups, cv = None, PeriodBlockSplit(N_BLOCKS, omega=data.omega, trim_span=trim_span)
    if not row.periodic:
        groups = data.inputs.index.get_level_values("record")
        cv = GroupKFold(DOUBLETS["n_records"])
    search = GridSearchCV(model, grid, cv=cv, refit=smallest_within_one_standard_error)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExcitationWarning)
        warnings.simplefilter("ignore", InstabilityWarning)  # of states too many, fitted to noise
        return search.fit(data.inputs, y, groups=groups)


def chosen_order(row, seed):
    """The order chosen, or "refused" where a candidate failed on some fold."""
    try:
        search = search_order(row, seed)
    except ValueError as error:
        if "candidates failed" not in str(error):
            raise
        return "refused"
    return search.best_params_["order" if row.kind == "lti" else "identify__order"]


def run(row, seeds):
    """One row of the table."""
    started = time.perf_counter()
    orders = Counter(chosen_order(row, seed) for seed in seeds)
    found = sorted(orders.items(), key=str)
    return {
        "data": row.kind.upper(),
        "excitation": row.excitation,
        "expected": row.expected,
        "orders chosen (times)": ", ".join(f"{order} ({times})" for order, times in found),
        "as expected": f"{100 * orders[row.expected] / len(seeds):.0f} %",
        "seconds": f"{time.perf_counter() - started:.0f}",
    }


def parse_arguments():
    parser = argparse.ArgumentParser(description="How often the true order is chosen.")
    parser.add_argument("--seeds", type=int, default=20, help="noisy records a row (default 20)")
    parser.add_argument("--first-seed", type=int, default=1000, help="the first (default 1000)")
    return parser.parse_args()


def main():
    arguments = parse_arguments()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    for number, row in enumerate(ROWS):
        found = run(row, seeds)
        if number == 0:
            print("|" + "|".join(found) + "|\n" + "|---" * len(found) + "|")
        print("| " + " | ".join(str(value) for value in found.values()) + " |", flush=True)


if __name__ == "__main__":
    with threadpool_limits(limits=1):  # the matrices are small: threads cost more than they save
        main()
