"""Records of machines whose inputs come late and whose outputs are read late, exact."""

from functools import lru_cache

import numpy as np
import pandas as pd

from sklearn_hd.systems import LTPSystem, mathieu

F = np.array([[-0.5, 2.0, 0.0], [-2.0, -0.5, 0.0], [0.0, 0.0, -1.2]])
G = np.array([[1.0, 0.3], [0.0, 1.0], [0.7, -1.0]])
P = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 1.0]])
DT = 0.05


def late_record(system, commands, time, switches, reads):
    """Outputs of a system at rest, event by event: inputs switch and outputs are read when they do.

    Before the first row the commands hold their first value, which has to be zero.
    """
    late, early = (
        time[:, None] + sign * np.array(each) for sign, each in ((1, switches), (-1, reads))
    )
    instants = np.unique(np.round(np.concatenate([time, late.ravel(), early.ravel()]), 12))
    rows = [np.searchsorted(column, instants + 1e-9, side="right") - 1 for column in late.T]
    arrived = np.column_stack([v[np.maximum(k, 0)] for v, k in zip(commands.T, rows, strict=True)])
    y = system.simulate(arrived, instants)
    at = [np.searchsorted(instants, column - 1e-9) for column in early.T]
    return np.column_stack([y[rows, j] for j, rows in enumerate(at)])


@lru_cache
def plain_record(switches=(0.13, 0.32), reads=(0.0, 0.27), n_samples=200, seed=0):
    """A time-invariant system of three states, two inputs and two outputs."""
    system = LTPSystem(F[None], G[None], P[None], omega=1.0)
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((n_samples // 4 + 1, 2)), 4, axis=0)[:n_samples]
    u[:20] = 0.0
    time = DT * np.arange(n_samples)
    y = late_record(system, u, time, switches, reads)
    return pd.DataFrame(u, time, ["u0", "u1"]), pd.DataFrame(y, time, ["y0", "y1"])


@lru_cache
def mathieu_record(switch=2.3, read=4.6, n_periods=60, n_samples=32):
    """ÿ + 0.1 ẏ + (2 − cos 2t) y = u; the force comes late, the speed is read late, in samples."""
    dt = np.pi / n_samples
    time = dt * np.arange(n_periods * n_samples)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], len(time) // 20 + 1), 20)[: len(time), None]
    u[: 2 * n_samples] = 0.0
    y = late_record(mathieu(), u, time, [switch * dt], [0.0, read * dt])
    return pd.DataFrame(u, time, ["u"]), pd.DataFrame(y, time, ["y", "y_dot"]), dt
