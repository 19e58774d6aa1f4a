"""What do the five steps cost, and a search over orders? The last tables of docs/benchmarks.md.

Processor time on one BLAS thread, medians of some runs; factorisations are counted.

    python docs/benchmarks/bench_pipeline.py
    python docs/benchmarks/bench_pipeline.py --search-rows 20000 --runs 3

- The five steps, with estimators and DataFrames: simulated flapping wing, 60 periods of 64
  samples, period by period (with the periodic model back) and several times a period.
- ``GridSearchCV`` over 20 orders, 5 block rows and 5 folds, and the refit, with and without
  ``memory=``: records of bench_moesp.py without noise and with 1 % of it.
- ``partial_fit`` by chunks, beside ``fit``.
"""

import argparse
import os
import tempfile
import time
from functools import partial

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import numpy as np
import pandas as pd
from bench_moesp import record
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._identify import products_cache
from sklearn_hd.algorithms.subspace import hankel, lag_products
from sklearn_hd.datasets import make_flapping_wing

ORDERS, BLOCK_ROWS, FOLDS = list(range(2, 22)), [8, 10, 12, 15, 18], 5
CHUNK = 10_000


def seconds(run, count):
    """Median processor time of some runs after a first one."""
    run()
    taken = []
    for _ in range(count):
        before = time.process_time()
        run()
        taken.append(time.process_time() - before)
    return float(np.median(taken))


# ---- the five steps --------------------------------------------------------------------------


def pipelines(data):
    """The two routes, by name."""
    outputs = {"w": [0], "phi_dot": [1]}
    free = MatrixStructure(A=np.full((3, 3), np.nan), B=np.full((3, 1), np.nan))
    routes = {
        "period by period": ({"reading": "period"}, HarmonicStructure()),
        "sliding window": ({"hop": 8}, free),
    }
    return {
        name: Pipeline(
            [
                ("harmonics", HarmonicAnalyzer(
                    data.omega, output_harmonics=outputs, trim_span=data.trim_span, **analysis)),
                ("identify", MOESPRegressor()),
                ("reduce", SpuriousModeReducer()),
                ("match", StructuredMatcher(structure=structure)),
            ]
        )
        for name, (analysis, structure) in routes.items()
    }  # fmt: skip


def five_steps(runs):
    """Time of each step and of all, one row a record and route."""
    rows = []
    for kind in ("ltp", "nltp"):
        data = make_flapping_wing(kind, n_periods=60, start=20)
        for name, pipe in pipelines(data).items():
            whole = seconds(partial(pipe.fit, data.inputs, data.outputs), runs)
            parts, X = {}, data.inputs
            for step, estimator in pipe.steps:
                parts[step] = 1e3 * seconds(partial(estimator.fit, X, data.outputs), runs)
                X = estimator.transform(X)
            rows.append({"record": kind, "route": name, **parts, "all [ms]": 1e3 * whole})
    return pd.DataFrame(rows).round(1)


# ---- a search --------------------------------------------------------------------------------


class Counted:
    """Lag products that were multiplied, not looked up, while this is open."""

    def __enter__(self):
        self.count, modules = 0, (hankel, products_cache)

        def counted(records, n_lags, exact):
            self.count += 1
            return lag_products.lag_products(records, n_lags, exact)

        self.modules = [(module, module.lag_products) for module in modules]
        for module in modules:
            module.lag_products = counted
        return self

    def __exit__(self, *_):
        for module, own in self.modules:
            module.lag_products = own


def search(kind, n_rows, memory):
    """Processor time and factorisations of one whole search."""
    u, y, _ = record(kind, n_rows, seed=1)
    model = MOESPRegressor(feedthrough=True, memory=memory)
    grid = {"order": ORDERS, "block_rows": BLOCK_ROWS}
    with Counted() as products:
        before = time.process_time()
        GridSearchCV(model, grid, cv=TimeSeriesSplit(FOLDS)).fit(u, y)
        taken = time.process_time() - before
    return taken, products.count


def searches(n_rows):
    rows = []
    for kind in ("easy", "noisy"):
        plain, plain_count = search(kind, n_rows, None)
        with tempfile.TemporaryDirectory() as folder:
            kept, kept_count = search(kind, n_rows, folder)
        rows.append(
            {
                "record": kind,
                "rows": n_rows,
                "without [s]": plain,
                "products": plain_count,
                "with memory [s]": kept,
                "products kept": kept_count,
                "ratio": plain / kept,
            }
        )
    return pd.DataFrame(rows).round(2)


# ---- chunks ----------------------------------------------------------------------------------


def chunks(n_rows, runs):
    u, y, _ = record("noisy", n_rows, seed=1)

    def streamed():
        model = MOESPRegressor(10, block_rows=15, feedthrough=True)
        for k in range(0, n_rows, CHUNK):
            model.partial_fit(u[k : k + CHUNK], y[k : k + CHUNK])
        return model

    def at_once():
        return MOESPRegressor(10, block_rows=15, feedthrough=True).fit(u, y)

    one, other = streamed().model_, at_once().model_
    off = max(
        np.abs(getattr(one, name) - getattr(other, name)).max() / np.abs(getattr(other, name)).max()
        for name in "ABCD"
    )
    row = {"rows": n_rows, "chunks of": CHUNK}
    row |= {"partial_fit [s]": seconds(streamed, runs), "fit [s]": seconds(at_once, runs)}
    return pd.DataFrame([row | {"largest difference": off}])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--search-rows", type=int, default=100_000)
    parser.add_argument("--chunk-rows", type=int, default=200_000)
    options = parser.parse_args()
    print(five_steps(options.runs).to_string(index=False), "\n", flush=True)
    print(chunks(options.chunk_rows, options.runs).to_string(index=False), "\n", flush=True)
    print(searches(options.search_rows).to_string(index=False))


if __name__ == "__main__":
    main()
