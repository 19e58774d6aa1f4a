"""Frames, arrays and whatever else may be given for signals, drawn at random and spoilt."""

import numpy as np
import pandas as pd
from scipy import sparse

from sklearn_hd.algorithms.lti.simulation import propagate

LENGTHS = [1, 2, 3, 5, 17, 40, 120, 200, 300]
OFTEN = [0.01, 0.01, 0.01, 0.02, 0.02, 0.06, 0.17, 0.35, 0.35]
SAMPLES_PER_PERIOD = 8
DT = 1.0 / SAMPLES_PER_PERIOD


def pick(rng, choices):
    """One of some values, whatever they are."""
    return choices[int(rng.integers(len(choices)))]


def chance(rng, share):
    return rng.uniform() < share


# ---- records as users mean them -----------------------------------------------------------------


def draw_record(rng):
    """Inputs and the outputs of a stable system, as frames on times."""
    n = int(rng.choice(LENGTHS, p=OFTEN))
    m, n_outputs, order = (int(k) for k in rng.integers(1, 4, 3))
    A = rng.standard_normal((order, order))
    A *= rng.uniform(0.3, 0.98) / np.max(np.abs(np.linalg.eigvals(A)))
    u = rng.standard_normal((n, m))
    if chance(rng, 0.3):  # held over some samples, with spans at rest
        u = np.repeat(u, 16, axis=0)[:n]
        u[: n // 4] = 0.0
    B, C = rng.standard_normal((order, m)), rng.standard_normal((n_outputs, order))
    y = propagate(A, u @ B.T, np.zeros(order)) @ C.T
    if chance(rng, 0.7):
        y += 0.02 * rng.standard_normal(y.shape)
    if chance(rng, 0.3):
        y += rng.uniform(-5, 5) + np.cos(2 * np.pi * DT * np.arange(n))[:, None]
    index = pd.Index(DT * np.arange(n), name="time")
    inputs = pd.DataFrame(u, index, [f"u{k}" for k in range(m)])
    return inputs, pd.DataFrame(y, index, [f"y{k}" for k in range(n_outputs)])


# ---- times --------------------------------------------------------------------------------------


def _records(rng, n):
    cut = int(rng.integers(0, n + 1))
    label = np.where(np.arange(n) < cut, *pick(rng, [("a", "b"), (0, 1), (1.5, 2.5)]))
    time = DT * np.where(np.arange(n) < cut, np.arange(n), np.arange(n) - cut)
    return pd.MultiIndex.from_arrays([label, time], names=["record", "time"])


def _with(rng, n, change):
    time = DT * np.arange(n)
    change(time)
    return pd.Index(time)


def _gap(rng, n):
    time = DT * np.arange(n)
    time[int(rng.integers(0, n + 1)) :] += pick(rng, [DT, 5 * DT, 1e6, 0.37 * DT])
    return pd.Index(time)


def _azimuth_of_nothing(time):
    time[len(time) // 2 :] = np.nan


def _to_infinity(time):
    time[-1:] = np.inf


def _backwards(time):
    time[:] = time[::-1].copy()


def _repeated(time):
    time[len(time) // 2 :] -= DT


def _tiny(time):
    time *= 1e-310


def _huge(time):
    time *= 1e300


def _far(time):
    time += 1e9


def _still(time):
    time[:] = 0.0


SPOILT_TIMES = [
    _azimuth_of_nothing, _to_infinity, _backwards, _repeated, _tiny, _huge, _far, _still
]  # fmt: skip


def draw_index(rng, n):
    """Times of some rows: mostly as meant, else counted, of other types, or spoilt."""
    kinds = {
        "records": lambda: _records(rng, n),
        "gap": lambda: _gap(rng, n),
        "jitter": lambda: pd.Index(DT * (np.arange(n) + rng.uniform(-0.15, 0.15, n))),
        "random": lambda: pd.Index(rng.uniform(0, n * DT, n)),
        "sorted": lambda: pd.Index(np.sort(rng.uniform(0, n * DT, n))),
        "counted": lambda: pd.RangeIndex(n),
        "integers": lambda: pd.Index(rng.integers(-5, n, n)),
        "shuffled": lambda: pd.Index(DT * rng.permutation(n)),
        "timedelta": lambda: pd.to_timedelta(DT * np.arange(n), unit="s"),
        "missing timedelta": lambda: pd.TimedeltaIndex([pd.NaT] * n),
        "dates": lambda: pd.date_range("2026-05-01", periods=n, freq="125ms"),
        "zoned": lambda: pd.date_range("2026-05-01", periods=n, freq="125ms", tz="UTC"),
        "missing dates": lambda: pd.DatetimeIndex([pd.NaT] * n),
        "periods": lambda: pd.period_range("2026-05", periods=n, freq="D"),
        "texts": lambda: pd.Index([f"{DT * k}" for k in range(n)]),
        "objects": lambda: pd.Index(list(DT * np.arange(n)), dtype=object),
        "categories": lambda: pd.CategoricalIndex(np.arange(n) % 3),
        "complex": lambda: pd.Index(np.arange(n) * 1j),
        "bools": lambda: pd.Index(np.arange(n) % 2 == 0),
        "float32": lambda: pd.Index((DT * np.arange(n)).astype(np.float32)),
        "nullable": lambda: pd.Index(pd.array(DT * np.arange(n), dtype="Float64")),
        "levels": lambda: pd.MultiIndex.from_arrays([np.arange(n)] * 3),
        "time first": lambda: pd.MultiIndex.from_arrays([DT * np.arange(n), np.zeros(n, int)]),
        "intervals": lambda: pd.interval_range(0, periods=n),
        "spoilt": lambda: _with(rng, n, pick(rng, SPOILT_TIMES)),
    }
    common = ["records", "gap", "jitter", "timedelta", "dates", "counted"]
    return kinds[pick(rng, common) if chance(rng, 0.5) else pick(rng, list(kinds))]()


# ---- values -------------------------------------------------------------------------------------

CELLS = [np.nan, np.inf, -np.inf, 1e300, 1e-310, 1e160, 1e16, 0.0, np.finfo(float).max]
COLUMNS = {
    "objects": lambda z: z.astype(object),
    "texts": lambda z: z.astype(str),
    "numbers in texts": lambda z: z.round(3).astype(str).astype("string"),
    "none": lambda z: z.astype(object).where(z > 0, None),
    "categories": lambda z: (z > 0).astype("category"),
    "categories of texts": lambda z: z.gt(0).map({True: "a", False: "b"}).astype("category"),
    "dates": lambda z: pd.to_datetime(z.abs(), unit="s"),
    "timedeltas": lambda z: pd.to_timedelta(z, unit="s"),
    "sparse": lambda z: z.where(z > 0, 0.0).astype(pd.SparseDtype(float, 0.0)),
    "nullable": lambda z: z.astype("Float64").mask(z > 1.0),
    "nullable integers": lambda z: z.round().astype("Int64").mask(z > 2.0),
    "nullable bools": lambda z: (z > 0).astype("boolean"),
    "complex": lambda z: z + 1j,
    "bools": lambda z: z > 0,
    "integers": lambda z: (10 * z).round().astype(int),
    "int8": lambda z: z.clip(-100, 100).astype("int8"),
    "float32": lambda z: z.astype("float32"),
    "float16": lambda z: z.clip(-6e4, 6e4).astype("float16"),
    "longdouble": lambda z: z.astype(np.longdouble),
    "constant": lambda z: z * 0.0 + 3.0,
    "zero": lambda z: z * 0.0,
    "negative zero": lambda z: z * -0.0,
    "missing": lambda z: z * np.nan,
    "huge": lambda z: z * 1e300,
    "large": lambda z: z * 1e120,
    "small": lambda z: z * 1e-160,
    "subnormal": lambda z: z * 1e-310,
    "nearly constant": lambda z: 1.0 + 1e-15 * z,
    "offset": lambda z: z + 1e12,
    "step": lambda z: (pd.Series(np.arange(len(z)), z.index) > len(z) // 2).astype(float),
    "impulse": lambda z: (pd.Series(np.arange(len(z)), z.index) == 3).astype(float),
    "growing": lambda z: z + np.exp(np.minimum(np.arange(len(z)) * 0.5, 200.0)),
}


def _spoil_cells(rng, z):
    """Other values here and there, in a column of whatever type holds them."""
    columns = [z.iloc[:, k] for k in range(z.shape[1])]
    for _ in range(int(rng.integers(1, 4))):
        own = int(rng.integers(len(columns)))
        rows = rng.integers(0, len(z), int(pick(rng, [1, 1, 3, max(1, len(z) // 3)])))
        column = columns[own].astype(object)
        column.iloc[rows] = pick(rng, CELLS)
        columns[own] = column if columns[own].dtype != float else column.astype(float)
    return pd.concat(columns, axis=1)


def _spoil_column(rng, z):
    own = int(rng.integers(z.shape[1]))
    change = COLUMNS[pick(rng, list(COLUMNS))]
    return pd.concat(
        [change(z.iloc[:, k]) if k == own else z.iloc[:, k] for k in range(z.shape[1])], axis=1
    )


def _spoil_all(rng, z):
    change = COLUMNS[pick(rng, list(COLUMNS))]
    return pd.concat([change(z.iloc[:, k]) for k in range(z.shape[1])], axis=1)


def _same_columns(rng, z):
    return pd.concat([z, z.iloc[:, :1]], axis=1)


def _names(rng, z):
    width = z.shape[1]
    names = [
        list(range(width)),
        [("a", k) for k in range(width)],
        pd.MultiIndex.from_product([["a"], range(width)]),
        [None, "b", "c"][:width],
        [1, "1", "x"][:width],
        ["", " ", "ü"][:width],
        ["u", "u_0", "u_1c"][:width],
        pd.date_range("2026", periods=width),
        [np.nan, 0.5, -1.0][:width],
    ]
    z = z.copy()
    z.columns = pick(rng, names)
    return z


def _no_rows(rng, z):
    return z.iloc[:0]


def _no_columns(rng, z):
    return z.iloc[:, :0]


SPOILERS = [_spoil_cells, _spoil_cells, _spoil_column, _spoil_column, _spoil_all]
ODD = [_same_columns, _names, _names, _no_rows, _no_columns]


def spoil(rng, z):
    """Some of the values, a column, all of them, or the names."""
    changes = SPOILERS if chance(rng, 0.8) else ODD
    change = pick(rng, changes)
    try:
        return change(rng, z) if len(z) else z
    except (TypeError, ValueError, ArithmeticError, AttributeError, RuntimeError):
        # spoilt before, in a way that bars this one
        return z


# ---- containers ---------------------------------------------------------------------------------


def _sparse(z):
    return sparse.csr_array(z.to_numpy(dtype=float))


CONTAINERS = {
    "array": lambda z: z.to_numpy(),
    "first column": lambda z: z.iloc[:, 0],
    "vector": lambda z: z.iloc[:, 0].to_numpy(),
    "list": lambda z: z.to_numpy().tolist(),
    "fortran": lambda z: np.asfortranarray(z.to_numpy()),
    "masked": lambda z: np.ma.masked_invalid(z.to_numpy(dtype=float)),
    "sparse": _sparse,
    "object array": lambda z: z.to_numpy(dtype=object),
    "cube": lambda z: z.to_numpy()[None],
    "scalar": lambda z: 3.0,
    "text": lambda z: "signals",
    "none": lambda z: None,
    "dict": lambda z: {"u": [1.0, 2.0]},
    "ragged": lambda z: [[1.0, 2.0], [3.0]],
    "bytes": lambda z: b"12",
    "set": lambda z: {1.0, 2.0},
    "generator": lambda z: range(7),
    "records array": lambda z: np.zeros(5, dtype=[("a", float), ("b", float)]),
    "read only": lambda z: _read_only(z.to_numpy(dtype=float)),
    "strided": lambda z: z.to_numpy()[::-1],
}


def _read_only(values):
    values = values.copy()
    values.flags.writeable = False
    return values


def in_container(rng, z):
    """As a frame, or as something else that it could be given as."""
    if chance(rng, 0.9):
        return z
    name = pick(rng, ["array", "first column", "vector", "list"])
    if chance(rng, 0.4):
        name = pick(rng, list(CONTAINERS))
    try:
        return CONTAINERS[name](z)
    except (TypeError, ValueError, IndexError):  # what it holds fits into no such container
        return z


def draw_signals(rng):
    """X and y: as meant, or spoilt in up to three ways."""
    X, y = draw_record(rng)
    if chance(rng, 0.3):
        index = draw_index(rng, len(X))
        X, y = X.set_axis(index), y.set_axis(index)
    for _ in range(int(rng.choice([0, 1, 2], p=[0.6, 0.3, 0.1]))):
        if chance(rng, 0.5):
            X = spoil(rng, X)
        else:
            y = spoil(rng, y)
    if chance(rng, 0.05):
        y = pick(rng, [y.iloc[1:], y.set_axis(y.index[::-1]), y.reset_index(drop=True), X])
    return in_container(rng, X), in_container(rng, y)
