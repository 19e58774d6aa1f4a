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
- White noise of 1/20 of each output's standard deviation, criterion="output_error", the
  numbers of harmonics of F and G given (truth inside the model class), then chosen from each
  record: error of the N = 1 state matrix relative to its Cramér-Rao bound, errors of the
  parameters (``theta_``) and of the exponents (``eigenvalues_``) in standard deviations, and
  the share of 95 % intervals that hold the truth. Fits that end in an exception are counted.

    python docs/benchmarks/periodic_systems_study.py --seeds 40 --first-seed 1000
"""

import argparse
import traceback
import warnings
from collections import Counter
from functools import cache
from itertools import pairwise

import numpy as np
import pandas as pd
from joblib import Parallel, delayed
from scipy.optimize import linear_sum_assignment
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.uncertainty import fisher_information
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
    analyzer = {"reading": "period", "trim_span": None} | analyzer  # systems that rest at zero
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, **analyzer)),
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


def true_harmonics(system):
    """Highest harmonics of F and G."""
    return {"F": len(system.F.coefficients) // 2, "G": len(system.G.coefficients) // 2}


def true_parameters(system, harmonics):
    """Truth by the names of theta_, zero where the system has no such harmonic."""
    states, inputs = system.state_names, system.input_names
    structure = HarmonicStructure().resolve(states, inputs, states, harmonics)
    n, truth = system.n_states, np.zeros(structure.constant.shape)
    for block, part in ((truth[:, :n, :n], system.F), (truth[:, :n, n:], system.G)):
        count = min(len(block), len(part.coefficients))
        block[:count] = part.coefficients[:count]
    truth[0, n:, :n] = np.eye(n)
    return structure, pd.Series(structure.nearest(truth), structure.parameter_names)


@cache
def state_matrix_slopes(name):
    """Derivatives of the N = 1 state matrix by the parameters of the truth's structure."""
    system = SYSTEMS[name]()
    structure, _ = true_parameters(system, true_harmonics(system))
    n = system.n_states

    def decompose(coefficients):
        F, G = coefficients[:, :n, :n], coefficients[:, :n, n:]
        return LTPSystem(F, G, omega=system.omega).harmonic_decomposition(1).A

    rates = structure.basis.toarray().reshape(-1, *structure.constant.shape)
    origin = decompose(structure.constant)
    return np.array([decompose(structure.constant + rate) - origin for rate in rates])


def bound(name, u, sigma, spp):
    """Cramér-Rao bound on the rms error of the N = 1 state matrix, the start not known."""
    system, slopes = SYSTEMS[name](), state_matrix_slopes(name)
    structure, theta = true_parameters(system, true_harmonics(system))
    found = fisher_information(Form(structure, system.omega, spp), theta, [(u, None, 0)], sigma)
    return np.sqrt(np.einsum("kij,kl,lij->", slopes, found.covariance, slopes))


def noisy_record(name, seed, kind="3-2-1-1", n_periods=160):
    """Inputs, outputs with noise, and its standard deviations."""
    u, clean = record(SYSTEMS[name](), kind, seed, n_periods)
    sigma = clean.std().to_numpy() / SNR
    noise = np.random.default_rng([seed, 1]).standard_normal(clean.shape)
    return u, clean + sigma * noise, sigma


def noisy_fits(name, seed, ways=("given", "chosen"), kind="3-2-1-1"):
    """Errors of the fits to one record; where there is none, what was raised.

    The numbers of harmonics of F and G are given to the fit, or chosen by it.
    """
    system = SYSTEMS[name]()
    u, y, sigma = noisy_record(name, seed, kind)
    smallest = bound(name, u.to_numpy(), sigma, SPP[kind])
    fits = [{"name": name, "seed": seed, "way": way, "bound": smallest} for way in ways]
    pipe = pipeline(system.omega, "output_error")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            frame = pipe[:3].fit(u, y).transform(u)
        except Exception:
            return [{**fit, "failure": traceback.format_exc(limit=-1)} for fit in fits]
        for fit in fits:
            given = true_harmonics(system) if fit["way"] == "given" else {}
            pipe["match"].set_params(structure=HarmonicStructure(**given))
            try:
                fit |= errors_under_noise(pipe["match"].fit(frame, y), system)
            except Exception:
                fit["failure"] = traceback.format_exc(limit=-1)
    return fits


def errors_under_noise(match, system):
    """Order; of the right one: error of the N = 1 state matrix, and others in deviations."""
    table = match.eigenvalues_
    if len(table) != system.n_states:
        return {"order": len(table)}
    gap = match.ltp_.harmonic_decomposition(1).A - system.harmonic_decomposition(1).A
    harmonics = {part: getattr(match.ltp_, part).n_harmonics for part in "FG"}
    truth = true_parameters(system, harmonics)[1]
    rows, exponents = nearest_exponents(table["eigenvalue"], system)
    exponents = np.column_stack([exponents.real, exponents.imag])
    std = table[["std_real", "std_imag"]].to_numpy()[rows]
    return {
        "order": system.n_states,
        "e": np.linalg.norm(gap),
        "harmonics": "F {F}, G {G}".format(**harmonics),
        "z": ((match.theta_ - truth) / match.theta_std_).to_numpy(),
        "z_exponents": exponents[std > 0.0] / std[std > 0.0],
    }


def inside(z):
    """Share of 95 % intervals that hold the truth."""
    return np.mean(np.abs(z) < 1.959964)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def summary(name, fits):
    """One row of the table of noise."""
    right = [fit for fit in fits if "e" in fit]
    z, exponents = (np.concatenate([fit[key] for fit in right]) for key in ("z", "z_exponents"))
    counts = Counter(fit["harmonics"] for fit in right)
    usual, times = counts.most_common(1)[0]
    return {
        "system": name,
        "seeds": len(fits),
        "rms_e/bound": rms([fit["e"] / fit["bound"] for fit in right]),
        "rms_z": rms(z),
        "coverage": inside(z),
        "rms_z_exponents": rms(exponents),
        "coverage_exponents": inside(exponents),
        "harmonics": f"{usual} ({times / len(right):.0%})",
        "wrong_order": sum("order" in fit for fit in fits) - len(right),
        "failures": sum("failure" in fit for fit in fits),
    }


def with_noise(seeds, ways=("given", "chosen"), names=tuple(SYSTEMS), n_jobs=1):
    """Rows by way of taking the harmonics: one for each system, one for all of them pooled."""
    jobs = [delayed(noisy_fits)(name, seed, ways) for name in names for seed in seeds]
    fits = [fit for pair in Parallel(n_jobs=n_jobs)(jobs) for fit in pair]
    for fit in fits:
        if "failure" in fit:
            print(fit["name"], fit["seed"], fit["way"], fit["failure"])
    tables = {}
    for way in ways:
        own = [fit for fit in fits if fit["way"] == way]
        rows = [summary(name, [fit for fit in own if fit["name"] == name]) for name in names]
        tables[way] = [*rows, {**summary("all", own), "harmonics": ""}]
    return tables


def show(rows):
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.3g}".format), flush=True)
    print()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--parts", nargs="+", default=["clean", "nonlinear", "noise"])
    parser.add_argument("--jobs", type=int, default=1, help="processes for the fits under noise")
    options = parser.parse_args()
    first = options.first_seed
    if "clean" in options.parts:
        show([without_noise(name, kind, first) for name in SYSTEMS for kind in SPP])
    if "nonlinear" in options.parts:
        show([small_signal(how, a, first) for a in (0.02, 0.005) for how in AMPLITUDES])
    if "noise" in options.parts:
        seeds = range(first, first + options.seeds)
        for way, rows in with_noise(seeds, n_jobs=options.jobs).items():
            print(f"harmonics {way}")
            show(rows)


if __name__ == "__main__":
    main()
