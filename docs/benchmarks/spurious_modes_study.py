"""Does the reducer find the genuine modes of random systems? The table of docs/spurious_modes.md.

Random systems of three kinds, four excitations, several windows and hops, read through
HarmonicAnalyzer, MOESPRegressor and SpuriousModeReducer with default parameters: only ω and
the harmonics to keep are told.

    python docs/benchmarks/spurious_modes_study.py --systems 240

What is right was settled before anything was tuned:

- ``hd``: signals of a time-invariant model of 2 to 6 states whose outputs are harmonic
  coefficients. Its eigenvalues are definite; they are matched one to one.
- ``ltp, l = n``: a periodic system of n states measured by n outputs. Kept modes are right if
  they are eigenvalues of the system's own harmonic decomposition HD(N), one to one; or members
  λ + jpω, |p| ≤ N, of its Floquet families, each at most once, all families being found if each
  has a member.
- ``ltp, l < n``: the same, by families alone.

A match is closer than a tolerance times the decay rate |Re λ| of the true mode. Precision is the
share of modes kept that are right, recall the share of true modes (or families) found.
"""

import argparse
import time
import warnings
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import linalg
from scipy.optimize import linear_sum_assignment
from sklearn.pipeline import Pipeline
from threadpoolctl import threadpool_limits

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, propagate
from sklearn_hd.algorithms.signals.fourier import recompose
from sklearn_hd.exceptions import (
    ExcitationWarning,
    IdentifiabilityWarning,
    InstabilityWarning,
)
from sklearn_hd.systems import LTPSystem

KINDS = ("hd", "ltp, l = n", "ltp, l < n")
INPUTS = ("doublet", "doublet, any phase", "prbs", "multisine")
READINGS = (("boxcar", 1), ("boxcar", 1), ("boxcar", 2), ("hann", 1), ("centred-boxcar", 1))
SPP = 24  # samples a period
EXACT, NOISY = 0.01, 0.25  # tolerance of a match, as a share of |Re λ|


@dataclass
class Trial:
    """One record with its truth, and how it is to be read."""

    kind: str
    excitation: str
    window: str
    hop: int | None
    n_states: int
    omega: float
    kept: dict
    u: pd.DataFrame
    y: pd.DataFrame
    exponents: np.ndarray  # of the model, or the Floquet exponents
    hd: np.ndarray | None = None  # eigenvalues of HD(N), where the outputs are the states

    @property
    def highest(self):
        return max(k for orders in self.kept.values() for k in orders)


# ---- random systems ----------------------------------------------------------------------------


def random_exponents(rng, n, omega, widest):
    """Decay by 0.05 to 3 e-folds a period; half of the modes in pairs, up to ``widest`` ω."""
    values = []
    while len(values) < n:
        decay = -np.exp(rng.uniform(np.log(0.05), np.log(3.0))) * omega / (2 * np.pi)
        if n - len(values) >= 2 and rng.random() < 0.5:
            pair = complex(decay, rng.uniform(0.03, widest) * omega)
            values += [pair, pair.conjugate()]
        else:
            values.append(complex(decay))
    return np.array(values)


def real_form(exponents):
    blocks = []
    for e in exponents[exponents.imag >= 0]:
        blocks.append([[e.real, e.imag], [-e.imag, e.real]] if e.imag else [[e.real]])
    return linalg.block_diag(*blocks)


def regular(rng, n, rows=None):
    """A random matrix whose condition is below 20."""
    while True:
        T = rng.standard_normal((rows or n, n))
        if np.linalg.cond(T) < 20.0:
            return T


def random_harmonics(rng, n):
    """Harmonics kept of signals whose coefficients are n in number."""
    kept = {}
    while n:
        some = [(0,)] + [(k,) for k in (1, 2, 3) if n >= 2] + [(0, k) for k in (1, 2) if n >= 3]
        orders = some[rng.integers(len(some))]
        kept[f"y{len(kept) + 1}"] = list(orders)
        n -= sum(1 if k == 0 else 2 for k in orders)
    return kept


def hd_trial(rng, reading, excitation):
    n, omega = int(rng.integers(2, 7)), 2 * np.pi * 10 ** rng.uniform(-1, 1.5)
    if rng.random() < 0.5:  # the states are the coefficients
        while True:
            kept = random_harmonics(rng, n)
            highest = max(k for orders in kept.values() for k in orders)
            if highest:
                break
        C = np.eye(n)
    else:
        n_signals, highest = int(rng.integers(1, 3)), int(rng.integers(1, 4))
        kept = {f"y{i + 1}": list(range(highest + 1)) for i in range(n_signals)}
        C = rng.standard_normal((n_signals * (2 * highest + 1), n))
    exponents = random_exponents(rng, n, omega, highest)
    T = regular(rng, n)
    A = T @ real_form(exponents) @ np.linalg.inv(T)
    u, t = random_input(rng, excitation, omega, 10 * n + 50)
    B = rng.standard_normal((n, u.shape[1]))
    A_d, B_d = continuous_to_discrete(A, B, t[1])
    coefficients = propagate(A_d, u @ B_d.T, np.zeros(n)) @ C.T
    columns, start = [], 0
    for orders in kept.values():
        width = sum(1 if k == 0 else 2 for k in orders)
        columns.append(recompose(coefficients[:, start : start + width], omega * t, orders))
        start += width
    return make_trial("hd", reading, excitation, n, omega, kept, u, columns, t, exponents)


def ltp_trial(rng, reading, excitation, measured):
    """F(ψ) of four harmonics that fall by half each time, stable; outputs as asked."""
    n = int(rng.integers(2, 5 if measured else 7))
    omega, highest = 2 * np.pi * 10 ** rng.uniform(-1, 1.5), int(rng.integers(1, 4))
    n_outputs = n if measured else int(rng.integers(1, min(n, 4)))
    u, t = random_input(rng, excitation, omega, 10 * n + 50)
    m = u.shape[1]
    while True:
        T = regular(rng, n)
        F = np.zeros((9, n, n))
        F[0] = T @ real_form(random_exponents(rng, n, omega, 0.5)) @ np.linalg.inv(T)
        for k in range(1, 5):
            size = 0.3 * omega / np.sqrt(n) * 0.5 ** (k - 1)
            F[2 * k - 1 : 2 * k + 1] = size * rng.standard_normal((2, n, n))
        G = rng.standard_normal((3, n, m)) * np.array([1.0, 0.5, 0.5])[:, None, None]
        P = None
        if not measured:
            P = rng.standard_normal((3, n_outputs, n))
            P[1:] *= 0.3
        system = LTPSystem(F, G, P, omega=omega)
        exponents = system.floquet_exponents()
        decays = -exponents.real * 2 * np.pi / omega
        if decays.min() > 0.03 and decays.max() < 4.0:
            break
    y = system.simulate(u, t)
    kept = {f"y{i + 1}": list(range(highest + 1)) for i in range(n_outputs)}
    kind = KINDS[1 if measured else 2]
    trial = make_trial(kind, reading, excitation, n, omega, kept, u, list(y.T), t, exponents)
    if measured:
        trial.hd = np.linalg.eigvals(system.harmonic_decomposition(highest).A)
    return trial


def make_trial(kind, reading, excitation, n, omega, kept, u, columns, t, exponents):
    index = pd.Index(t, name="time")
    window, factor = reading
    highest = max(k for orders in kept.values() for k in orders)
    hop = None
    if factor > 1:  # more rows a period than by default
        hop = 2 if highest < 3 else None
    u = pd.DataFrame(u, index, [f"u{i + 1}" for i in range(u.shape[1])])
    y = pd.DataFrame(np.column_stack(columns), index, list(kept))
    return Trial(kind, excitation, window, hop, n, omega, kept, u, y, exponents)


def random_input(rng, excitation, omega, n_periods):
    """One or two inputs, and the times in seconds."""
    m = 2 if rng.random() < 0.3 else 1
    t = np.arange(n_periods * SPP) * (2 * np.pi / omega / SPP)
    u = np.zeros((len(t), m))
    for j in range(m):
        if excitation.startswith("doublet"):
            unit = SPP if excitation == "doublet" else 1
            width = int(rng.integers(3, 11)) * SPP + int(rng.integers(SPP)) * (unit == 1)
            start = (
                int(rng.integers(1, 5)) * SPP + 20 * SPP * j + int(rng.integers(SPP)) * (unit == 1)
            )
            u[start : start + width, j], u[start + width : start + 2 * width, j] = 1.0, -1.0
        elif excitation == "prbs":  # switches where a period begins
            u[:, j] = np.repeat(rng.choice([-1.0, 1.0], n_periods), SPP)
        else:
            frequencies = omega * rng.uniform(0.01, 0.5, 25)
            u[:, j] = np.cos(np.outer(t, frequencies) + rng.uniform(0, 2 * np.pi, 25)).sum(axis=1)
    return u, t


def draw(seed):
    """A random trial; kinds, excitations and readings take turns."""
    rng = np.random.default_rng([20241111, seed])
    kind, excitation = KINDS[seed % 3], INPUTS[seed // 3 % 4]
    reading = READINGS[seed // 12 % len(READINGS)]
    if kind == "hd":
        return hd_trial(rng, reading, excitation)
    return ltp_trial(rng, reading, excitation, kind == KINDS[1])


# ---- identification and judgement --------------------------------------------------------------


def identify(trial, noise, seed):
    """The fitted pipeline, and whether the reducer called its choice into question."""
    y = trial.y
    if noise:
        draws = np.random.default_rng([7, seed]).standard_normal(y.shape)
        y = y + noise * draws * y.std(ddof=0).to_numpy()
    analyzer = HarmonicAnalyzer(
        trial.omega,
        output_harmonics=trial.kept,
        window=trial.window,
        hop=trial.hop,
        reading="sliding",
        trim_span=None,  # systems that rest at zero
    )
    steps = [("harmonics", analyzer), ("identify", MOESPRegressor())]
    pipe = Pipeline([*steps, ("reduce", SpuriousModeReducer())])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore", ExcitationWarning)
        warnings.simplefilter("ignore", InstabilityWarning)  # the truth is known
        warnings.filterwarnings("always", category=IdentifiabilityWarning)
        pipe.fit(trial.u, y)
    return pipe, any(issubclass(w.category, IdentifiabilityWarning) for w in caught)


def matches(found, true, tolerance):
    """Number of one-to-one matches within tolerance · |Re λ|."""
    distance = np.abs(found[:, None] - true[None, :]) / np.abs(true.real)
    rows, columns = linear_sum_assignment(np.minimum(distance, 10.0))
    return int(np.sum(distance[rows, columns] <= tolerance))


def judge(trial, found, tolerance):
    """Precision and recall of the eigenvalues kept."""
    if trial.kind == "hd":
        right = matches(found, trial.exponents, tolerance)
        return right / len(found), right / len(trial.exponents)
    shifts = 1j * trial.omega * np.arange(-trial.highest, trial.highest + 1)
    members = (trial.exponents[:, None] + shifts).ravel()
    both = np.concatenate([members, members.conj()])  # a negative multiplier has λ + jω/2
    _, first = np.unique(np.round(both / trial.omega, 9), return_index=True)
    right = matches(found, both[first], tolerance)
    distance = np.abs(found[:, None] - members) / np.abs(members.real)
    seen = (distance.min(axis=0) <= tolerance).reshape(len(trial.exponents), -1).any(axis=1)
    scores = right / len(found), float(seen.mean())
    if trial.hd is not None:
        own = matches(found, trial.hd, tolerance)
        scores = max(scores, (own / len(found), own / len(trial.hd)), key=min)
    return scores


def run(seed, noise):
    """One row of the raw table."""
    trial = draw(seed)
    started = time.perf_counter()
    row = {
        "seed": seed,
        "kind": trial.kind,
        "excitation": trial.excitation,
        "reading": f"{trial.window}, {'hop' if trial.hop else 'default'}",
        "noise": noise,
        "n": trial.n_states,
        "N": trial.highest,
    }
    try:
        pipe, doubted = identify(trial, noise, seed)
    except ValueError as error:
        return row | {"refused": str(error)[:60], "precision": np.nan, "recall": 0.0}
    reduce = pipe["reduce"]
    found = np.linalg.eigvals(reduce.model_.A)
    precision, recall = judge(trial, found, NOISY if noise else EXACT)
    return row | {
        "precision": precision,
        "recall": recall,
        "kept": len(found),
        "true": len(trial.exponents if trial.hd is None else trial.hd),
        "ambiguous": doubted,
        "refused": "",
        "order": pipe["identify"].order_,
        "r2": reduce.r2_,
        "seconds": time.perf_counter() - started,
    }


def summary(rows, by):
    """Means over groups of the raw table; precision of what was not refused."""
    columns = {
        "systems": ("seed", "size"),
        "precision": ("precision", "mean"),
        "recall": ("recall", "mean"),
        "all right": ("right", "mean"),
        "ambiguous": ("ambiguous", "mean"),
        "refused": ("refused", "mean"),
    }
    rows = rows.assign(right=(rows["precision"] == 1.0) & (rows["recall"] == 1.0))
    rows["refused"] = rows["refused"] != ""
    rows["ambiguous"] = rows["ambiguous"].eq(True)
    return rows.groupby(["noise", *by]).agg(**columns).round(3)


def parse_arguments():
    parser = argparse.ArgumentParser(description="Are the genuine modes of random systems found?")
    parser.add_argument("--systems", type=int, default=240, help="random systems (default 240)")
    parser.add_argument("--first-seed", type=int, default=1000, help="the first (default 1000)")
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.01, 0.05])
    parser.add_argument("--out", help="csv file for the raw table")
    return parser.parse_args()


def main():
    arguments = parse_arguments()
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.systems)
    rows = pd.DataFrame([run(seed, noise) for noise in arguments.noise for seed in seeds])
    if arguments.out:
        rows.to_csv(arguments.out, index=False)
    for by in (["kind"], ["kind", "excitation"], ["reading"]):
        print(summary(rows, by).to_string(), end="\n\n")


if __name__ == "__main__":
    with threadpool_limits(limits=1):  # the matrices are small: threads cost more than they save
        main()
