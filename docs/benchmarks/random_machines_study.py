"""Does the default pipeline find machines that nobody chose, or say that it did not?

    python docs/benchmarks/random_machines_study.py [--seeds 8] [--first 1300] [--noise 0.01 0.05]

Linear periodic machines of one to four states, drawn at random: one or two outputs, Floquet
multipliers between 0.02 and 0.95, F(ψ) and G(ψ) of one harmonic. Each is moved by 3-2-1-1, by three
doublets, by steps and by a binary sequence, about an orbit that nobody gives. A fit is

    right     every Floquet exponent within 5 % of its rate, none too many
    doubted   right, but a warning says that the model is in doubt
    warned    not right, and a warning or an error says that the model is in doubt
    SILENT    not right, and nothing was said

Beside each stands the largest deviation of an exponent, relative to its rate, that the Cramér-Rao
bound leaves to whoever knows that F and G have one harmonic, and C none. The pipeline does not.
"""

import argparse
import time
import warnings
from collections import Counter

import numpy as np
import pandas as pd
from sklearn.pipeline import make_pipeline
from threadpoolctl import threadpool_limits

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.exceptions import CoordinatesWarning
from sklearn_hd.systems import LTPSystem

OMEGA, LIMIT, TOLD_APART = 2.0, 0.05, 0.015
PERIOD = 2.0 * np.pi / OMEGA
SHAPES = {"3211": 32, "doublets": 32, "steps": 16, "binary": 16}  # samples a turn


def draw(seed):
    """F, G and P of a machine: Fourier coefficients of one harmonic."""
    rng, n = np.random.default_rng(10_000 + seed), 1 + seed % 4
    while True:
        A, k = np.zeros((n, n)), 0
        while k < n:
            rate = np.log(rng.uniform(0.02, 0.95)) / PERIOD
            pair = k + 1 < n and rng.random() < 0.5
            spin = rng.uniform(0.2, 2.5) if pair else 0.0
            block = [[rate, spin], [-spin, rate]] if pair else [[rate]]
            A[k : k + 1 + pair, k : k + 1 + pair] = block
            k += 1 + pair
        V = np.linalg.qr(rng.standard_normal((n, n)))[0] * rng.uniform(0.5, 2.0, n)
        F = np.stack([V @ A @ np.linalg.inv(V), *(0.4 * rng.standard_normal((2, n, n)))])
        G = rng.standard_normal((3, n, 1)) * np.array([1.0, 0.4, 0.4])[:, None, None]
        P = rng.standard_normal((1, min(1 + seed // 4 % 2, n), n))
        size = np.abs(np.linalg.eigvals(LTPSystem(F, G, P, omega=OMEGA).monodromy()))
        if size.min() > 0.02 and size.max() < 0.95:
            return F, G, P


def moved(shape, rng):
    """An input."""
    if shape == "binary":
        return np.repeat(rng.choice([-1.0, 1.0], 800), 4)
    u, width = np.zeros(60 * SHAPES[shape]), int(rng.integers(30, 60))
    if shape == "3211":
        held = np.repeat([1.0, -1.0, 1.0, -1.0], width * np.array([3, 2, 1, 1]))
        u[256 : 256 + len(held)] = held
    elif shape == "doublets":
        for start in (256, 800, 1300):
            u[start : start + 2 * width] = np.repeat([1.0, -1.0], width)
    else:
        widths = rng.integers(2, 40, 400)
        u = np.repeat(rng.choice([-1.0, 0.0, 1.0], 400), widths)[: 200 * SHAPES[shape]]
    return u


def rates(exponents):
    """What errors are relative to: rates, at least 0.02 a turn."""
    return np.maximum(np.abs(exponents.real), 0.02 / PERIOD)


def simulated(parts, u, t, x0=None):
    return np.asarray(LTPSystem(*parts, omega=OMEGA).simulate(u[:, None], t, x0=x0))


def bound(parts, u, t, noise):
    """Largest deviation of an exponent that the Cramér-Rao bound leaves, relative to its rate."""
    exponents = np.asarray(LTPSystem(*parts, omega=OMEGA).floquet_exponents())
    y, slopes, gradients, step = simulated(parts, u, t), [], [], 1e-5
    for i, part in enumerate(parts):
        for at in np.ndindex(part.shape):
            other = [each.copy() for each in parts]
            other[i][at] += step
            slopes.append(((simulated(other, u, t) - y) / step / noise).ravel())
            near = np.asarray(LTPSystem(*other, omega=OMEGA).floquet_exponents())
            nearest = np.abs(near[:, None] - exponents).argmin(axis=0)
            gradients.append((near[nearest] - exponents) / step)
    for start in np.eye(parts[0].shape[1]):
        slopes.append((simulated(parts, 0.0 * u, t, start) / noise).ravel())
        gradients.append(0.0 * exponents)
    J, g = np.array(slopes), np.array(gradients)
    size = np.linalg.norm(J, axis=1)
    J, g = J / size[:, None], g / size[:, None]
    inverse = np.linalg.pinv(J @ J.T, rcond=1e-9, hermitian=True)
    variance = np.einsum("ik,ij,jk->k", g.conj(), inverse, g).real
    return float(np.max(np.sqrt(variance) / rates(exponents)))


def error(found, true):
    """Largest of an exponent that was to be found, or that was; relative to its rate."""
    gap = found[:, None] - true
    apart = np.abs(gap.real + 1j * ((gap.imag + OMEGA / 2) % OMEGA - OMEGA / 2)) / rates(true)
    lasting = np.exp(found.real * PERIOD) >= 1e-3
    return max(apart.min(axis=0).max(), apart[lasting].min(axis=1).max(initial=0.0))


def run(seed, shape, noise):
    """Verdict, error, order and bound of one fit."""
    parts, rng = draw(seed), np.random.default_rng(seed)
    u = moved(shape, rng)
    t = np.arange(len(u)) * PERIOD / SHAPES[shape]
    y = simulated(parts, u, t)
    least = bound(parts, u, t, noise * y.std(axis=0))
    orbit = np.cos(OMEGA * t)[:, None] * rng.standard_normal(y.shape[1])
    y = y + orbit + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    time_index = pd.Index(t, name="time")
    pipe = make_pipeline(
        HarmonicAnalyzer(OMEGA),
        MOESPRegressor(),
        SpuriousModeReducer(),
        StructuredMatcher(structure=HarmonicStructure()),
    )
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warnings.simplefilter("ignore", CoordinatesWarning)
        try:
            pipe.fit(
                pd.DataFrame({"u": u}, time_index), pd.DataFrame(y, time_index).add_prefix("y")
            )
        except ValueError:
            return "warned", np.inf, 0, least
    found = np.asarray(pipe[-1].ltp_.floquet_exponents(), complex)
    off = error(found, np.asarray(LTPSystem(*parts, omega=OMEGA).floquet_exponents(), complex))
    words = ("doubted", "warned") if said else ("right", "SILENT")
    return words[int(off > LIMIT)], off, len(found), least


def main():
    parser = argparse.ArgumentParser(description="Random linear periodic machines.")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first", type=int, default=1300)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.01, 0.05])
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=list(SHAPES))
    given, verdicts, easy = parser.parse_args(), {}, Counter()
    for seed in range(given.first, given.first + given.seeds):
        for shape in given.shapes:
            for noise in given.noise:
                start = time.process_time()
                verdict, off, order, least = run(seed, shape, noise)
                verdicts.setdefault(shape, Counter())[verdict] += 1
                easy[verdict] += least < TOLD_APART
                print(
                    f"{seed} {shape:8s} noise {noise:<5} {verdict:7s} off {off:8.2g}, bound "
                    f"{least:8.2g}, {order} states, {time.process_time() - start:.1f} s",
                    flush=True,
                )
    print("\n| input | right | right, but doubted | warned | SILENT |\n|---|---|---|---|---|")
    for shape, counts in [*verdicts.items(), (f"all whose bound is below {TOLD_APART:.1%}", easy)]:
        row = [counts[word] for word in ("right", "doubted", "warned", "SILENT")]
        print(f"| {shape} | " + " | ".join(map(str, row)) + " |")


if __name__ == "__main__":
    with threadpool_limits(limits=1):  # the matrices are small: threads cost more than they save
        main()
