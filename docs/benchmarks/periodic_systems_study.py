"""Do linear time-periodic models come back from other machines than the flapping wing?

A damped Mathieu oscillator, the hinged blade in forward flight, two oscillators with two
inputs, and the forced Duffing oscillator about its periodic trim, identified by the
period-synchronous route: no truth is used, the order is found from the data.

- Without noise: error of the N = 1 harmonic decomposition's state matrix, relative to its
  norm, and of the Floquet exponents, relative to the largest, from a doublet and a 3-2-1-1
  whose edges fall at random phases of the period, and from a binary signal that may change
  at every sample.
- Duffing: the same against its linearisation about the trim, from one record, from a ± pair,
  and from four amplitudes extrapolated to zero.
- White noise of 1/20 of each output's standard deviation, criterion="output_error": errors
  of the exponents in standard deviations (``eigenvalues_``), and the share of 95 % intervals
  that hold the truth. Fits that end in an exception are counted.

    python docs/benchmarks/periodic_systems_study.py --seeds 40 --first-seed 1000
"""

import argparse
import traceback
import warnings
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.systems import (
    LTPSystem,
    coupled_oscillators,
    duffing,
    flapping_blade,
    mathieu,
)

SNR = 20.0
INPUTS = {"doublet": [1, -1], "3-2-1-1": [1, 1, 1, -1, -1, 1, -1]}
SPP = {"doublet": 32, "3-2-1-1": 32, "binary": 16}
N_PERIODS = {"doublet": 60, "3-2-1-1": 60, "binary": 360}


def coupled():
    """The two oscillators with positions and rates measured."""
    system = coupled_oscillators()
    return LTPSystem(
        system.F,
        system.G,
        omega=system.omega,
        state_names=system.state_names,
        input_names=system.input_names,
    )


SYSTEMS = {
    "mathieu": mathieu,
    "flapping_blade": flapping_blade,
    "coupled_oscillators": coupled,
}


def excitation(kind, n_samples, n_inputs, spp, rng):
    """Inputs in one record: steps of some periods with edges at any sample, or binary."""
    if kind == "binary":
        return rng.choice([-1.0, 1.0], size=(n_samples, n_inputs))
    u, start = np.zeros((n_samples, n_inputs)), 2 * spp
    signs = INPUTS[kind]
    width = (n_samples - 20 * spp) // (n_inputs * len(signs))  # 20 periods of rest
    for column in u.T:
        edges = start + width * np.arange(len(signs) + 1) + rng.integers(0, spp, len(signs) + 1)
        for sign, (first, last) in zip(signs, pairwise(edges), strict=True):
            column[first:last] = sign
        start = edges[-1]
    return u


def record(system, kind, seed, n_periods=None):
    """Inputs and outputs without noise."""
    rng, spp = np.random.default_rng(seed), SPP[kind]
    n_samples = (n_periods or N_PERIODS[kind]) * spp
    t = pd.Index(np.arange(n_samples) * system.period / spp, name="time")
    u = excitation(kind, n_samples, system.n_inputs, spp, rng)
    y = system.simulate(u, t.to_numpy())
    names = list(system.input_names), list(system.output_names)
    return pd.DataFrame(u, t, names[0]), pd.DataFrame(y, t, names[1])


def pipeline(omega, criterion="hinf", order="auto", **analyzer):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, hop="period", **analyzer)),
            ("identify", MOESPRegressor(order=order)),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure(), criterion=criterion)),
        ]
    )


def nearest_exponents(found, system):
    """Pairs of found and true exponents, modulo jω; error of each."""
    true = system.floquet_exponents()
    gap = np.asarray(found)[:, None] - true
    gap -= 1j * system.omega * np.round(gap.imag / system.omega)
    rows, columns = linear_sum_assignment(np.abs(gap))
    return rows, gap[rows, columns]


def errors(pipe, system):
    """Relative errors of the N = 1 state matrix and of the exponents."""
    found = pipe["match"].ltp_
    if found.n_states != system.n_states:
        return np.nan, np.nan
    exact = system.harmonic_decomposition(1).A
    A = np.linalg.norm(found.harmonic_decomposition(1).A - exact) / np.linalg.norm(exact)
    _, gap = nearest_exponents(found.floquet_exponents(), system)
    return A, np.max(np.abs(gap)) / np.max(np.abs(system.floquet_exponents()))


def without_noise(name, kind, seed=0, n_periods=None):
    """One row: errors from one record."""
    system = SYSTEMS[name]()
    u, y = record(system, kind, seed, n_periods)
    pipe = pipeline(system.omega).fit(u, y)
    A, exponents = errors(pipe, system)
    order = pipe["identify"].order_
    return {"system": name, "input": kind, "order": order, "A": A, "exponents": exponents}


# ---- the nonlinear system ----------------------------------------------------------------------

AMPLITUDES = {
    "one record": ([1.0], None),
    "± pair": ([1.0, -1.0], "odd"),
    "extrapolated": ([1.0, 0.5, -0.5, -1.0], "extrapolate"),
}


def small_signal(how, amplitude, seed=0, n_periods=80, spp=32):
    """Errors of Duffing's linearisation; the amplitude is in parts of the periodic force."""
    system = duffing()
    trim = system.trim(n_harmonics=30)
    factors, option = AMPLITUDES[how]
    n_samples = n_periods * spp
    t = np.arange(n_samples) * system.period / spp
    unit = excitation("3-2-1-1", n_samples, 1, spp, np.random.default_rng(seed))
    # the first two periods are trim, which the analyzer learns and subtracts
    frames = []
    for factor in factors:
        u = amplitude * factor * unit
        y = system.simulate(u, t, x0=trim.initial_state)
        index = pd.Index(t, name="time")
        frames.append((pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index, ["x", "x_dot"])))
    u, y = (
        pd.concat(dict(enumerate(part)), names=["record"]) for part in zip(*frames, strict=True)
    )
    analyzer = {"small_signal": option, "trim_span": (0.0, 2 * system.period * (1 - 1e-9))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        omega = 2 * np.pi / system.period
        order = pipeline(omega, **analyzer)[:2].fit(u, y)["identify"].order_
        pipe = pipeline(omega, order=2, **analyzer).fit(u, y)
    A, exponents = errors(pipe, system.linearize(trim))
    return {"records": how, "amplitude": amplitude, "order": order, "A": A, "exponents": exponents}


# ---- noise -------------------------------------------------------------------------------------


def with_noise(name, seeds, kind="3-2-1-1", n_periods=160):
    """One row: errors of the exponents in standard deviations, over some seeds."""
    system, scores, inside, wrong_order, failures = SYSTEMS[name](), [], [], 0, []
    relative, counts = [], []
    for seed in seeds:
        u, clean = record(system, kind, seed, n_periods)
        noise = np.random.default_rng([seed, 1]).standard_normal(clean.shape)
        y = clean + clean.std().to_numpy() / SNR * noise
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                pipe = pipeline(system.omega, "output_error").fit(u, y)
        except Exception:
            failures.append(f"{name} {seed}: {traceback.format_exc(limit=-1)}")
            continue
        match = pipe["match"]
        if len(match.eigenvalues_) != system.n_states:
            wrong_order += 1
            continue
        table = match.eigenvalues_
        rows, gap = nearest_exponents(table["eigenvalue"], system)
        relative.append(np.max(np.abs(gap)) / np.max(np.abs(system.floquet_exponents())))
        for part, std in (
            (gap.real, table["std_real"].to_numpy()[rows]),
            (gap.imag, table["std_imag"].to_numpy()[rows]),
        ):
            moves = std > 0.0
            z = part[moves] / std[moves]
            scores.extend(z)
            inside.extend(np.abs(z) < 1.959964)
        counts.append((match.ltp_.F.n_harmonics, match.ltp_.G.n_harmonics))
    usual = max(set(counts), key=counts.count) if counts else (0, 0)
    share = counts.count(usual) / max(1, len(counts))
    for text in failures:
        print(text)
    return {
        "system": name,
        "input": kind,
        "seeds": len(seeds),
        "median_err": np.median(relative) if relative else np.nan,
        "rms_z": np.sqrt(np.mean(np.square(scores))),
        "median_abs_z": np.median(np.abs(scores)),
        "coverage": np.mean(inside),
        "harmonics": f"F {usual[0]}, G {usual[1]} ({share:.0%})",
        "wrong_order": wrong_order,
        "failures": len(failures),
    }


def show(rows):
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.3g}".format), flush=True)
    print()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--parts", nargs="+", default=["clean", "nonlinear", "noise"])
    options = parser.parse_args()
    first = options.first_seed
    if "clean" in options.parts:
        show([without_noise(name, kind, first) for name in SYSTEMS for kind in SPP])
    if "nonlinear" in options.parts:
        show([small_signal(how, a, first) for a in (0.02, 0.005) for how in AMPLITUDES])
    if "noise" in options.parts:
        seeds = range(first, first + options.seeds)
        show([with_noise(name, seeds) for name in SYSTEMS])


if __name__ == "__main__":
    main()
