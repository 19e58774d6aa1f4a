"""
A cluster, and a worker that dies
=================================

How do you identify a model from more flights than one machine holds, on machines that may fail?
"""

# %%
# The flights
# -----------
# A wing has two lightly damped modes and flies in gusts: 200 flights of a minute each, ten per
# Parquet file, with the flight and the time as its index. Such files may lie anywhere that
# ``pandas.read_parquet`` reads.

import logging
import os
import signal
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from scipy.signal import lfilter

from sklearn_hd import MOESPRegressor
from sklearn_hd.plotting import EigenvalueDisplay

N_FILES, FLIGHTS, STEP = 20, 10, 0.02
INPUTS, OUTPUTS = ["elevator", "gust"], ["pitch", "bending", "acceleration"]
POLES = np.array([-0.6 + 4.0j, -0.5 + 19.0j])  # 1/s, and their conjugates


def write_flights(folder):
    """Simulate all flights, and write them to files."""
    rng = np.random.default_rng(11)
    b, c = (rng.standard_normal((2, n, 2)) @ [1.0, 1.0j] for n in (2, 3))  # of each mode
    paths, seconds = [], np.arange(3000) * STEP
    for first in range(0, N_FILES * FLIGHTS, FLIGHTS):
        u = rng.standard_normal((FLIGHTS, len(seconds), 2))
        modes = [
            lfilter([0.0, 1.0], [1.0, -z], u @ own, axis=-1)
            for z, own in zip(np.exp(POLES * STEP), b, strict=True)
        ]
        y = np.real(np.stack(modes, axis=-1) @ c)
        y += 0.05 * np.std(y, axis=(0, 1)) * rng.standard_normal(y.shape)
        labels = [range(first, first + FLIGHTS), seconds]
        index = pd.MultiIndex.from_product(labels, names=["flight", "time"])
        signals = np.concatenate([u, y], axis=-1).reshape(len(index), -1)
        paths.append(Path(folder, f"{first:03d}.parquet"))
        pd.DataFrame(signals, index=index, columns=INPUTS + OUTPUTS).to_parquet(paths[-1])
    return paths


# %%
# The failing worker
# ------------------
# A scheduler gives work to two workers, each a process of its own. This plugin watches the
# scheduler, and kills one of them (``SIGKILL``, without warning) when a third of the tasks are
# done. The results of that worker are lost.


def killer(victim, after):
    """A plugin that kills a process after some tasks, and notes when."""
    from dask.distributed import SchedulerPlugin

    class Killer(SchedulerPlugin):
        done, killed_at = 0, None

        def transition(self, key, start, finish, *args, **kwargs):
            self.done += start == "processing" and finish == "memory"
            if self.done == after and self.killed_at is None:
                os.kill(victim, signal.SIGKILL)
                self.killed_at = time.time()

    return Killer()


# %%
# The model
# ---------
# ``fit`` accepts dask DataFrames like those of pandas. Nothing is read before ``fit``, and then
# the workers read. Each partition is read where it is and gives one small statistic. Neighbours
# are merged, eight at a time, and one statistic arrives here: first for A and C, and then, with
# these known, for B, D and the initial states.


def fit_on_cluster(paths):
    """The model, the tasks that were run, and when a worker was killed."""
    import dask.dataframe as dd
    from dask.distributed import Client, LocalCluster, get_task_stream

    flights = dd.from_map(pd.read_parquet, paths)
    options = {
        "preload": ["sklearn_hd"],  # imported before the first task
        "dashboard_address": None,
        "silence_logs": logging.CRITICAL,
    }
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, **options) as cluster,
        Client(cluster) as client,
    ):
        victim = next(iter(client.run(os.getpid).values()))
        plugin = killer(victim, after=2 * len(paths))
        cluster.scheduler.add_plugin(plugin)
        with get_task_stream(client) as stream:
            model = MOESPRegressor(block_rows=8).fit(flights[INPUTS], flights[OUTPUTS])
    return model, stream.data, plugin.killed_at


def compare(found, expected):
    """Largest difference of the matrices, beside their largest entries."""
    pairs = [(getattr(found.model_, M), getattr(expected.model_, M)) for M in "ABC"]
    return max(np.abs(a - b).max() / np.abs(b).max() for a, b in pairs)


# %%
# Workers start by importing the script that created them, and must not run it; hence the
# condition. In a notebook, or with workers on other machines, you do not need it.

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        paths = write_flights(folder)
        model, tasks, killed_at = fit_on_cluster(paths)
        flights = pd.concat(map(pd.read_parquet, paths))
    single = MOESPRegressor(block_rows=8).fit(flights[INPUTS], flights[OUTPUTS])
    difference = compare(model, single)
    statistics = [t for t in tasks if str(t["key"]).startswith(("partition", "merged"))]
    n_bytes = sum(t["nbytes"] for t in statistics)

    print(f"order {model.order_}, {len(model.x0_)} flights, {len(flights):,} rows")
    print(f"{len(tasks)} tasks, on {len({t['worker'] for t in tasks})} workers")
    print(f"data        {flights.to_numpy().nbytes / 1e6:6.1f} MB, read where they are")
    print(f"statistics  {n_bytes / 1e6:6.1f} MB, the most that was moved")
    print(f"largest difference from a single process: {difference:.1e}")
    assert difference < 1e-10

# %%
# What happened
# -------------
# Each worker has a line. The line of the killed worker ends, and the other worker continues alone
# and repeats the lost work, until a new one has started (which may take longer than the remaining
# work). The lagged products come first, then the equations of B, D and the initial states. The
# poles are those of the wing.

if __name__ == "__main__":
    figure, (timeline, plane) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
    workers = list(dict.fromkeys(t["worker"] for t in tasks))
    kinds = {"partition": "a partition's statistic", "merged": "merging", "": "reading"}
    drawn = [next(k for k in kinds if str(t["key"]).startswith(k)) for t in tasks]
    steps = [next(s for s in t["startstops"] if s["action"] == "compute") for t in tasks]
    start = min(step["start"] for step in steps)
    for (kind, label), color in zip(kinds.items(), ["tab:blue", "tab:orange", "0.75"], strict=True):
        for task, step, k in zip(tasks, steps, drawn, strict=True):
            if k == kind:
                bar = [(step["start"] - start, step["stop"] - step["start"])]
                row = (workers.index(task["worker"]) - 0.4, 0.8)
                timeline.broken_barh(bar, row, color=color, label=label)
                label = None
    timeline.axvline(killed_at - start, color="tab:red", label="killed")
    timeline.set(
        xlabel="seconds",
        yticks=range(len(workers)),
        yticklabels=[f"worker {row + 1}" for row in range(len(workers))],
    )
    timeline.legend(ncols=2, fontsize="small")
    EigenvalueDisplay.from_estimator(model, ax=plane, true=[*POLES, *POLES.conj()])
    plt.show()

# %%
# What was learned
# ----------------
# The data stay where they are. The statistics that were moved have at most a quarter of their
# size, and less for longer flights. A machine that fails costs the time to repeat the work in its
# memory, but does not change a digit of the model.
#
# * Requirements on partitions: :doc:`/cluster`.
# * Records that arrive one by one: :class:`~sklearn_hd.MOESPRegressor`, ``partial_fit``.
