"""Defaults of MOESPRegressor on the measured records that are shipped, plain data.

    python docs/benchmarks/plain_defaults_study.py

Each record is identified from its first 60 %, means removed, and simulated over the rest; beside it
the best of all orders and feedthroughs, chosen by the very rows that validate it.
"""

import warnings

import numpy as np

from sklearn_hd import MOESPRegressor
from sklearn_hd.datasets import (
    load_cd_player_arm,
    load_power_plant,
    load_robot_arm,
    load_slicot_example,
)

RECORDS = {
    "robot arm": load_robot_arm,
    "CD player arm": load_cd_player_arm,
    "SLICOT's example": load_slicot_example,
    "power plant": load_power_plant,
}
WEIGHTINGS = ("moesp", "n4sid", "cva", "pbsid")
MOST = 18  # states tried


def halves(data):
    """Inputs and outputs of the first 60 %, then of the rest; means of the first removed."""
    n = int(0.6 * len(data.inputs))
    tables = [table - table.iloc[:n].mean() for table in (data.inputs, data.outputs)]
    return [t.iloc[:n] for t in tables], [t.iloc[n:] for t in tables]


def fit(model, u, y):
    """100 (1 − √(1 − R²)) of a simulation, its start fitted; NaN where it runs away."""
    r2 = model.score(u, y)
    return 100.0 * (1.0 - np.sqrt(max(0.0, 1.0 - r2))) if np.isfinite(r2) else np.nan


def best(weighting, first, rest, **given):
    """The best fit of all orders with and without D."""
    found = []
    for order in range(1, MOST + 1):
        for feedthrough in (False, True):
            model = MOESPRegressor(order, weighting=weighting, feedthrough=feedthrough, **given)
            try:
                found.append((fit(model.fit(*first), *rest), order))
            except ValueError as error:  # the rank bound of few block rows
                if "exceeds the rank bound" not in str(error) and "too few" not in str(error):
                    raise
    return max(found, key=lambda each: -np.inf if np.isnan(each[0]) else each[0])


def row(name, weighting, data):
    """One line of the table."""
    first, rest = halves(data)
    half = MOESPRegressor(weighting=weighting).fit(*first)
    u, y = data.inputs - data.inputs.mean(), data.outputs - data.outputs.mean()
    cells = []
    for scale in (True, False):
        whole = MOESPRegressor(weighting=weighting, scale=scale).fit(u, y)
        left = y.to_numpy() - np.asarray(whole.predict(u, x0=whole.x0_[0]))
        share = 100.0 * (1.0 - left.var(axis=0) / y.to_numpy().var(axis=0))
        size = np.max(np.abs(whole.eigenvalues_))
        cells.append(f"{whole.order_}, {size:.3f}, {' / '.join(f'{s:.1f}' for s in share)}")
    of_best, order = best(weighting, first, rest)
    D = "D" if half.feedthrough_ else "no D"
    return (
        f"| {name} | {weighting} | {half.order_}, {D} | {fit(half, *rest):.1f} | {of_best:.1f} "
        f"({order}) | {cells[0]} | {cells[1]} |"
    )


def main():
    """Print the table."""
    warnings.simplefilter("ignore")
    heads = "record", "weighting", "order", "validated fit", "best (order)"
    print("|", " | ".join([*heads, "all: order, spectral radius, VAF", "scale=False"]), "|")
    print("|---|---|---|---|---|---|---|")
    for name, load in RECORDS.items():
        for weighting in WEIGHTINGS:
            print(row(name, weighting, load()), flush=True)


if __name__ == "__main__":
    main()
