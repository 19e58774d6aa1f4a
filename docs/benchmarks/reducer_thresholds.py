"""How much do the thresholds of the reducer and of the order decide?

Each threshold is halved and doubled, one at a time, on records of random doublets; the
table shows the median and the largest error e (percent, Eq. 27) of the heave matrix.

    python docs/benchmarks/reducer_thresholds.py
"""

import argparse
import warnings

import numpy as np
from sklearn.pipeline import Pipeline

import sklearn_hd._reduce as choice
import sklearn_hd.algorithms.subspace.order as gaps
from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd.datasets import make_flapping_wing

THRESHOLDS = [
    (choice, "FAMILY_TOLERANCE"),
    (choice, "WINDOW_DECAY"),
    (choice, "MATERIAL_SHARE"),
    (gaps, "GAP_REACH"),
    (gaps, "CLEAR_GAP"),
    (gaps, "WIDE_GAP"),
]


def records(n_records, seed):
    """Random doublets, noise-free, of all three kinds of signals."""
    rng = np.random.default_rng(seed)
    for k in range(n_records):
        width, start = int(rng.integers(3, 21)), int(rng.integers(10, 60))
        yield make_flapping_wing(
            ("lti-signal", "ltp", "nltp")[k % 3],
            amplitude=float(rng.choice([0.005, 0.01, 0.02])),
            width=width,
            start=start,
            n_periods=start + 2 * width + int(rng.integers(30, 80)),
        )


def error(data):
    """e in percent of one record."""
    raw = "nltp" in data.DESCR
    analyzer = HarmonicAnalyzer(
        data.omega,
        output_harmonics={"w": [0], "phi_dot": [1]},
        trim_span=data.trim_span if raw else None,
    )
    steps = [("harmonics", analyzer), ("identify", MOESPRegressor())]
    pipe = Pipeline([*steps, ("reduce", SpuriousModeReducer())]).fit(data.inputs, data.outputs)
    model, exact = pipe["reduce"].model_, data.A_exact.to_numpy()
    if model.n_states != 3:
        return np.inf
    found = model.C @ model.A @ np.linalg.inv(model.C)
    return 100 * np.linalg.norm(found - exact) / np.linalg.norm(exact)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=12)
    parser.add_argument("--seed", type=int, default=3000)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    every = list(records(arguments.records, arguments.seed))
    kinds = np.arange(len(every)) % 3
    print("| threshold | value | LTI signal | LTP | NLTP (median / largest) |")
    print("|---|---|---|---|---|")
    for module, name in THRESHOLDS:
        value = getattr(module, name)
        for factor in (0.5, 1.0, 2.0):
            setattr(module, name, factor * value)
            e = np.array([error(data) for data in every])
            cells = " | ".join(f"{e[kinds == k].max():.2g}" for k in (0, 1))
            nltp = e[kinds == 2]
            print(
                f"| {name} | {factor * value:.3g} | {cells} | "
                f"{np.median(nltp):.2g} / {nltp.max():.2g} |",
                flush=True,
            )
        setattr(module, name, value)


if __name__ == "__main__":
    main()
