"""What must not move while the code is rebuilt, in one JSON file.

    python docs/benchmarks/freeze.py --out before.json --only table,fuzz
    python docs/benchmarks/freeze.py --compare before.json after.json

- ``table``: Table 1 of the paper, both routes: percent error of A, and the order. Under noise it is
  the root mean square over 20 seeds that no test or study uses.
- ``matching``: the H∞ norms of matches to models identified without noise, which lie in the
  structure or near it.
- ``fuzz``: what comes of 500 random pipelines on records of the fuzz tests: the error; or order,
  eigenvalues and score, and by how much they move with the last digits of the outputs.
- ``cost``: processor time of a subspace fit of 200 000 rows and of SLICOT's (package ctrlsys; null
  where it is not installed), and of the five steps.

``--only`` replaces these parts of the file. ``--compare`` prints what differs, and exits with 1
where a row without noise changes its order or its first two digits (one of rounding alone: grows
ten times), the rms under noise changes by 10 %, a norm grows by 1e-3, or a random pipeline gives
another model. Only public names of the package are used: other versions run the same file.
"""

import argparse
import json
import os
import sys
import time
import warnings
from functools import partial
from pathlib import Path

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "examples"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import _paper_cases as paper
import numpy as np
import pandas as pd
from bench_moesp import PEERS, SIZES, record
from fuzzed_data import DT, SAMPLES_PER_PERIOD, chance, draw_record, draw_signals, pick
from scipy import linalg, optimize, signal
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import make_pipeline

import sklearn_hd as hd
from sklearn_hd.datasets import make_flapping_wing

TABLE_SEEDS, MATCH_SEED, FUZZ_CASES = range(31_000, 31_020), 25_000, 500
ROUNDING_PERCENT = 1e-6  # rows of Table 1 below it are of rounding alone
EXACT = 1e-7  # relative norm below which a match is exact
MOST_PARAMETERS = 12  # of a matrix structure in a random pipeline: more take seconds
POLES_SCORE = 1e-5, 1e-4  # what may differ in a random pipeline

# Vertical flight of a flapping wing, one harmonic kept (Aerospace 2024, 11(11), 875, Eq. 26)
A_HEAVE = np.array([[-4.0, -0.032, -0.105], [-856.9, -54.747, -179.46], [-2817.0, 151.0, -96.28]])
A_FLAP = np.array([[-75.51, -428.4, -1408.0], [-0.065, -2.892, -165.9], [-0.211, 164.5, -5.107]])


def analyzer(omega, reading, hop=None, **settings):
    """A HarmonicAnalyzer of that reading, whichever parameter chooses it."""
    if "reading" in hd.HarmonicAnalyzer().get_params():
        return hd.HarmonicAnalyzer(omega, reading=reading, hop=hop, **settings)
    return hd.HarmonicAnalyzer(omega, hop="period" if reading == "period" else hop, **settings)


def error_percent(A, exact):
    """Eq. 27 in percent."""
    return 100.0 * linalg.norm(A - exact) / linalg.norm(exact)


def table():
    """Percent error of A, and order, by row."""
    rows, kept = {}, {}
    for case in paper.CASES:
        errors, orders = [], []
        for seed in TABLE_SEEDS if case.noise else [None]:
            data = paper.simulate(case, seed)
            second = case.route == "synchronous"
            pipe = (paper.build_synchronous if second else paper.build_pipeline)(case, data)
            pipe.fit(data.inputs, paper.measured(case, data))
            A = pipe["match"].system_.A
            orders.append(pipe["identify"].order_)
            errors.append(error_percent(A, data.A_exact.to_numpy()))
        found = {"percent": np.sqrt(np.mean(np.square(errors))), "order": int(np.median(orders))}
        found |= {"noise": case.noise, "median": np.median(errors)}
        rows[f"{case.route}: {case.data}, {case.subsystem}, {100 * case.amplitude:g} %"] = found
        kept[case] = data, A, orders[0]
    (data, heave, n), (_, flap, m) = kept[paper.LTI_SIGNAL], kept[paper.FLAP]
    exact = data.ltp.harmonic_decomposition(1)
    states = [exact.state_labels.index(s) for part in paper.STATES.values() for s in part]
    e = error_percent(linalg.block_diag(heave, flap), exact.A[np.ix_(states, states)])
    rows["paper: lti-signal, full 6 x 6, 2 %"] = {"percent": e, "order": n + m, "noise": False}
    return rows


# ---- H∞ norms --------------------------------------------------------------------------------


def wing(n_parts):
    """Heave, or heave and flap, of the flapping wing, and which entries are free."""
    A = linalg.block_diag(A_HEAVE, A_FLAP)[: 3 * n_parts, : 3 * n_parts]
    B = np.zeros((6, 2))
    B[1, 0], B[3, 1] = 7.256e6, 3.628e6
    B = B[: len(A), :n_parts]
    return (A, B, np.eye(len(A))), (A != 0, B != 0, np.zeros(A.shape, dtype=bool))


def sparse(random, n, k):
    """A stable sparse model; k of the entries of A, B and C that are not zero are free."""
    A = np.zeros((n, n))
    for i, w in enumerate(np.geomspace(0.5, 20.0, n // 2)):
        zeta = random.uniform(0.05, 0.3)
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = w * np.array([[-zeta, 1.0], [-1.0, -zeta]])
    A[-1, -1] -= 3.0 * (n % 2)
    coupled = (A == 0) & (random.uniform(size=(n, n)) < 2.0 / n)
    A[coupled] = random.standard_normal(coupled.sum())
    A -= max(0.0, linalg.eigvals(A).real.max() + 0.05) * np.eye(n)
    stacked = np.hstack([A, random.standard_normal((n, 6))])
    free = np.zeros(stacked.shape, dtype=bool)
    free[tuple(random.permutation(np.argwhere(stacked != 0))[:k].T)] = True
    return [(M[:, :n], M[:, n : n + 3], M[:, n + 3 :].T) for M in (stacked, free)]


def disturbed(model, size, random):
    """A stable model near, its entries off by some share of what they do."""
    A, B, C = model
    gramian = linalg.solve_continuous_lyapunov(A, -B @ B.T)
    x, y = np.sqrt(np.diag(gramian))[:, None], np.sqrt(np.diag(C @ gramian @ C.T))[:, None]
    near = A
    while near is A or linalg.eigvals(near).real.max() > -0.01:
        near = A * (1 + size * random.standard_normal(A.shape))
    B = B + size * x * np.std(B / x) * random.standard_normal(B.shape)
    return near, B, C + size * y / x.T * np.std(C * x.T / y) * random.standard_normal(C.shape)


def identified(model, random):
    """MOESPRegressor fitted to a record of the model without noise, and the record."""
    A, B, C = model
    dt, D = 0.3 / np.abs(linalg.eigvals(A)).max(), np.zeros((len(C), B.shape[1]))
    index = pd.Index(dt * np.arange(4000), name="time")
    u = random.standard_normal((len(index), B.shape[1]))
    _, y, _ = signal.dlsim((*signal.cont2discrete((A, B, C, D), dt)[:4], dt), u)
    u, y = pd.DataFrame(u, index).add_prefix("u"), pd.DataFrame(y, index).add_prefix("y")
    return FrozenEstimator(hd.MOESPRegressor(len(A), block_rows=len(A) + 5).fit(u, y)), u, y


def matching():
    """Norms and seconds; each search begins with parameters off by up to a half."""
    models = {
        "heave, 3 states": (lambda random: wing(1), 5),
        "heave + flap, 6 states": (lambda random: wing(2), 3),
        "sparse, 6 states": (lambda random: sparse(random, 6, 15), 5),
        "sparse, 15 states": (lambda random: sparse(random, 15, 33), 3),
    }
    rows = {}
    plan = [(name, size, k) for name in models for size in (0, 0.01, 0.05) for k in range(5)]
    for name, size, k in (case for case in plan if case[2] < models[case[0]][1]):
        random = np.random.default_rng(MATCH_SEED + k)
        model, free = models[name][0](random)
        initial = {
            f"{letter}[{i},{j}]": M[i, j] * (1 + random.uniform(-0.5, 0.5))
            for letter, M, F in zip("ABC", model, free, strict=True)
            for i, j in np.argwhere(F)
        }
        cells = [np.where(F, np.nan, M) for M, F in zip(model, free, strict=True)]
        source, u, y = identified(disturbed(model, size, random) if size else model, random)
        structure = hd.MatrixStructure(*cells, initial=initial)
        before = time.process_time()
        matcher = hd.StructuredMatcher(source, structure=structure).fit(u, y)
        norms = {"norm": matcher.hinf_error_, "relative": matcher.hinf_error_relative_}
        found = norms | {"seconds": time.process_time() - before}
        rows[f"{name}, {100 * size:g} % off, seed {MATCH_SEED + k}"] = found
    return rows


# ---- random pipelines ------------------------------------------------------------------------


def draw_pipeline(rng, m, n):
    """Some of the steps, with settings that all versions have; no search for an H∞ norm."""
    settings = {
        "order": pick(rng, ["auto", "auto", "auto", 1, 2, 3]),
        "block_rows": pick(rng, [None, None, None, None, 10]),
        "weighting": pick(rng, [*["moesp", "n4sid", "cva"] * 3, "pbsid"]),
        "feedthrough": chance(rng, 0.2),
    }
    steps, reading = [hd.MOESPRegressor(**settings)], pick(rng, [None, None, "sliding", "period"])
    if reading is not None:
        of_inputs, of_outputs = pick(rng, [0, 0, 0, 1]), pick(rng, [0, 0, 1])
        m, n = m * (1 + 2 * of_inputs), n * (1 + 2 * of_outputs)
        kept = {"input_harmonics": of_inputs, "output_harmonics": of_outputs}
        kept |= {"trim_span": pick(rng, [None, (0.0, 2.0)]), "missing": pick(rng, ["raise", "gap"])}
        if reading == "sliding":
            kept |= {"hop": pick(rng, [None, 1, 2]), "window": pick(rng, ["boxcar", "hann"])}
        steps.insert(0, analyzer(2.0 * np.pi / (SAMPLES_PER_PERIOD * DT), reading, **kept))
        if chance(rng, 0.6):
            steps.append(hd.SpuriousModeReducer(method=pick(rng, ["truncate", "residualize"])))
    if chance(rng, 0.4) and (reading == "period" or 0 < m * n <= MOST_PARAMETERS - n * n):
        structure = hd.HarmonicStructure(F=1, G=1)
        if reading != "period":
            structure = hd.MatrixStructure(np.full((n, n), np.nan), np.full((n, m), np.nan))
        criterion = pick(rng, ["least_squares", "output_error"])
        steps.append(hd.StructuredMatcher(structure=structure, criterion=criterion, n_starts=0))
    return make_pipeline(*steps)


def outcome(pipeline, X, y):
    """The error; or order, eigenvalues and score."""
    try:
        fitted = clone(pipeline).fit(X, y)
        poles = np.sort_complex(linalg.eigvals(fitted[-1].system_.A))
    except Exception as error:
        return {"kind": type(error).__name__, "message": str(error)[:60]}
    found = {"kind": f"order {len(poles)}", "poles": [[p.real, p.imag] for p in poles]}
    try:
        return found | {"score": float(fitted.score(X, y))}
    except Exception as error:
        return found | {"kind": f"{found['kind']}, score {type(error).__name__}", "score": 0.0}


def distances(one, other):
    """Of poles, relative to the largest, and of scores; None if they are not comparable."""
    if one["kind"] != other["kind"] or "poles" not in one:
        return None if one["kind"] != other["kind"] else [0.0, 0.0]
    p, q = (np.reshape(case["poles"], (-1, 2)) @ [1.0, 1.0j] for case in (one, other))
    gap = np.abs(p[:, None] - q) / np.abs(p).max(initial=1e-300)
    a, b = one["score"], other["score"]
    apart = 0.0 if a == b or np.isnan([a, b]).all() else abs(a - b) / (1.0 + abs(a))
    return [float(gap[optimize.linear_sum_assignment(gap)].max(initial=0.0)), float(apart)]


def fuzz():
    """Three of four cases have a record as users mean them, the others one that may be spoilt."""
    rows = {}
    for number in range(FUZZ_CASES):
        rng = np.random.default_rng([number, 19])
        X, y = draw_record(rng) if number % 4 else draw_signals(rng)
        pipeline = draw_pipeline(rng, *(getattr(z, "shape", (1, 1))[-1] for z in (X, y)))
        rows[str(number)] = row = outcome(pipeline, X, y)
        if isinstance(y, pd.DataFrame) and all(kind == float for kind in y.dtypes):  # noqa: E721
            row["spread"] = distances(row, outcome(pipeline, X, y * (1.0 + 1e-12)))
    return rows


# ---- cost ------------------------------------------------------------------------------------


def medians(runs, count):
    """Median processor time of each, run in turn after a first one."""
    seconds = {name: [] for name in runs}
    for _ in range(count + 1):
        for name, run in runs.items():
            before = time.process_time()
            run()
            seconds[name].append(time.process_time() - before)
    return {name: float(np.median(taken[1:])) for name, taken in seconds.items()}


def cost():
    """Ratios of the fit, and of the functions below it, to SLICOT; seconds of five steps."""
    rows = {}
    for kind, rival in (("noisy", "slicot-cholesky"), ("easy", "slicot-qr")):
        n, _, _, block_rows = SIZES[kind]
        u, y, _ = record(kind, 200_000, seed=20)
        runs = {}
        for name in ("MOESPRegressor", "kernel", rival):
            try:
                runs[name] = PEERS[name](u, y, n, block_rows)
            except ImportError as error:
                print(f"  {name} is left out: {error}")
        seconds = medians(runs, 5)
        rows |= {f"{kind}, {name} [s]": taken for name, taken in seconds.items()}
        for name in ("MOESPRegressor", "kernel"):
            both = rival in seconds and name in seconds
            rows[f"{kind}, {rival} / {name}"] = seconds[rival] / seconds[name] if both else None
    free = hd.MatrixStructure(A=np.full((3, 3), np.nan), B=np.full((3, 1), np.nan))
    for kind, reading in ((k, r) for k in ("ltp", "nltp") for r in ("period", "sliding")):
        data = make_flapping_wing(kind, n_periods=60, start=20)  # as in benchmarks.md
        kept = {"output_harmonics": {"w": [0], "phi_dot": [1]}, "trim_span": data.trim_span}
        matcher = hd.StructuredMatcher(structure=None if reading == "period" else free)
        first = analyzer(data.omega, reading, None if reading == "period" else 8, **kept)
        pipe = make_pipeline(first, hd.MOESPRegressor(), hd.SpuriousModeReducer(), matcher)
        taken = medians({"all": partial(pipe.fit, data.inputs, data.outputs)}, 5)
        rows[f"five steps, {kind}, {reading} [s]"] = taken["all"]
    return rows


# ---- what differs ----------------------------------------------------------------------------


def differs(part, old, new):
    """What differs in an entry, None where nothing does; and whether it may not."""
    if part == "cost":
        return f"{old} became {new}", False
    if part == "fuzz":
        return differs_in_model(old, new)
    before, after = (row["percent" if part == "table" else "relative"] for row in (old, new))
    change, reordered = after / before - 1.0, old.get("order") != new.get("order")
    if part == "matching":
        wrong = not after <= max(before * (1.0 + 1e-3), EXACT)
    elif old["noise"]:
        wrong = not abs(change) <= 0.1
    elif before < ROUNDING_PERCENT:
        wrong = reordered or not after <= 10.0 * before
    else:  # a thousandth changes no digits but those of a number that lies between two
        wrong = reordered or (f"{before:.1e}" != f"{after:.1e}" and not abs(change) <= 1e-3)
    text = f"{before:.4g} became {after:.4g} ({change:+.1e})"
    text += f", order {old.get('order')} became {new.get('order')}" * reordered
    moved = abs(change) > 1e-6 and max(before, after) > EXACT
    return text if wrong or reordered or moved else None, wrong


def differs_in_model(old, new):
    """The same for a random pipeline; messages may differ, as may what rounding decides."""
    far, spread = distances(old, new), old.get("spread", [0.0, 0.0])
    if far is None:
        return f"{old['kind']} became {new['kind']}; spread {spread}", spread is not None
    limits = np.maximum(POLES_SCORE, 100.0 * np.array(spread or [1.0, 1.0]))
    if not np.all(far <= limits):
        return f"poles off by {far[0]:.1e}, score by {far[1]:.1e}; spread {spread}", True
    said = old.get("message"), new.get("message")
    return f"{said[1]!r} is said, not {said[0]!r}" if said[0] != said[1] else None, False


def compare(old, new):
    """Print what differs; how many entries differ by more than they may."""
    n_wrong = 0
    for part in (part for part in PARTS if part in old and part in new):
        shown = bad = 0
        for name in {**old[part], **new[part]}:
            text, wrong = "is not in both files", True
            if name in old[part] and name in new[part]:
                text, wrong = differs(part, old[part][name], new[part][name])
            if text is not None:
                print(f"{'WRONG ' * wrong:6s}{part}: {name}: {text}")
                shown, bad = shown + 1, bad + wrong
        print(f"{part}: {shown} of {len(old[part])} differ, {bad} by more than they may")
        n_wrong += bad
    return n_wrong


PARTS = {"table": table, "matching": matching, "fuzz": fuzz, "cost": cost}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("freeze.json"), help="file to write to")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas between them")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("OLD", "NEW"))
    options = parser.parse_args()
    if options.compare:
        return compare(*(json.loads(path.read_text(encoding="utf-8")) for path in options.compare))
    for part in options.only.split(","):
        before = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows = PARTS[part]()
        there = options.out.exists()
        kept = json.loads(options.out.read_text(encoding="utf-8")) if there else {}
        text = json.dumps(kept | {part: rows}, indent=1, default=lambda value: value.item())
        options.out.write_text(text, encoding="utf-8")
        print(f"{part}: {len(rows)} entries, {time.process_time() - before:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main() > 0)
