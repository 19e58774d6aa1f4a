"""Do stated standard deviations hold where the machine itself is shaken?

- ``mathieu``: ÿ + 0.1 ẏ + (2 − cos 2t) y = u + gust, input of random steps, 32 samples a period,
  2 % noise on both outputs. The gust is not measured, white from sample to sample, and moves the
  outputs by the given part of what u does. F=1 and G=0 harmonics, as in truth.
- ``hawkmoth``: two flights of 60 wingbeats of 32 samples under feedback, steps of 5e-3 rad, noise
  of 2 %, gusts of 0.02 m/s, F=3 and G=3 harmonics; the growing pair of exponents of the moth
  without feedback. The moth is not in this model class: its F(ψ) has kinks.

Printed are, over seeds and for the real and the imaginary part of the Floquet exponent, the rms
error, the rms of error over stated deviation, and the share of 95 % intervals that hold; how often
a fit warned; and the rms of error over the Cramér-Rao bound of the innovations form: its
information at the true parameters, with the gain of the true periodic Kalman filter.

    python docs/benchmarks/gusts_study.py --seeds 40 --periods 160 640
    python docs/benchmarks/gusts_study.py --machine hawkmoth --seeds 20
"""

import argparse
import time
import warnings
from collections import Counter

import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.likelihood.search import start
from sklearn_hd.algorithms.likelihood.uncertainty import exponent_slopes, propagate_std
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics
from sklearn_hd.datasets import make_hawkmoth
from sklearn_hd.systems import mathieu

SAMPLES = 32  # a period
NOISE = 0.02
HELD = 64  # samples of a step of the input
HARMONICS = 4  # of the gain, in the bound
TURNS = 200  # of the Riccati equation
MACHINE = mathieu(2.0, 0.5, damping=0.1)
CRITERIA = ("output_error", "prediction_error")


def record(seed, gust, n_periods):
    """Input, outputs, and the deviations of the gust and of the noise."""
    rng, n = np.random.default_rng(seed), SAMPLES * n_periods
    t = pd.Index(np.arange(n) * MACHINE.period / SAMPLES, name="time")
    u = pd.DataFrame({"u": np.repeat(rng.choice([-1.0, 1.0], n // HELD + 1), HELD)[:n]}, t)
    shake = pd.DataFrame({"u": rng.standard_normal(n)}, t)
    still, moved = (MACHINE.simulate(each.to_numpy(), t.to_numpy()) for each in (u, shake))
    gust, noise = gust * still.std() / moved.std(), NOISE * still.std(axis=0)
    y = still + gust * moved + noise * rng.standard_normal(still.shape)
    return u, pd.DataFrame(y, t, MACHINE.output_names), gust, noise


def kalman_filter(Psi, C, gust, noise):
    """Gain and innovations' covariance at each phase, (n_phases, n, l) and (n_phases, l, l)."""
    n, R = Psi.shape[1], np.diag(noise**2)
    P, K, S = np.eye(n), np.zeros((len(Psi), n, len(R))), np.zeros((len(Psi), *R.shape))
    for _ in range(TURNS):
        for k, step in enumerate(Psi):
            Phi, Gamma = step[:, :n], step[:, n:]
            S[k] = C[k] @ P @ C[k].T + R
            K[k] = Phi @ np.linalg.solve(S[k], C[k] @ P).T
            P = Phi @ P @ Phi.T + gust**2 * Gamma @ Gamma.T - K[k] @ S[k] @ K[k].T
    return K, S


def bound(u, y, gust, noise):
    """Least standard deviations of the exponents' real + j imaginary parts, and the exponents."""
    n, omega = MACHINE.n_states, MACHINE.omega
    names = MACHINE.state_names, MACHINE.input_names, MACHINE.output_names
    structure = HarmonicStructure(F=1, G=0).resolve(*names, {"F": 1, "G": 0})
    truth = np.zeros(structure.constant.shape)
    F, G, P, _ = MACHINE.fourier_coefficients(1)
    truth[:, :n, :n], truth[0, :n, n:], truth[0, n:, :n] = F, G[0], P[0]
    theta = structure.nearest(truth)
    form, segments = Form(structure, omega, SAMPLES), [(u.to_numpy(), y.to_numpy(), 0)]
    parameters, S = theta, np.diag(noise**2)
    if gust:
        at = form.response(theta, sensitivities=False)
        C = np.broadcast_to(at.Out[..., :n], (SAMPLES, len(noise), n))
        K, S = kalman_filter(at.Psi, C, gust, noise)
        form, S = form.with_gain(HARMONICS), S.mean(axis=0)
        parameters = np.concatenate([theta, sampled_harmonics(K, HARMONICS).ravel()])
    problem = likelihood_problem(form, segments, correlated=True)
    covariance, _ = problem.linearise(start(problem, parameters), S).covariance(gauge=True)
    exponents, slopes = exponent_slopes(form, parameters)
    k = len(theta)
    return propagate_std(slopes[:, :k], covariance[:k, :k]), exponents


def fitted(pipe, u, y):
    """The fitted pipeline, and what the deviations of its likelihood rest on."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pipe.fit(u, y)
    return pipe, [pipe["match"].covariance_type_]


def nearest(table, wanted, omega):
    """Error and stated deviation of the exponent nearest to one, modulo jω, as complex numbers."""
    off = table["eigenvalue"].to_numpy() - wanted
    off = off - 1j * omega * np.round(off.imag / omega)
    row = np.argmin(np.abs(off))
    return off[row], complex(table["std_real"].iloc[row], table["std_imag"].iloc[row])


def mathieu_trial(seed, criterion, reading, gust, n_periods):
    """Error, stated deviation, bound and warnings of one record of Mathieu's equation."""
    u, y, shaken, noise = record(seed, gust, n_periods)
    least, exponents = bound(u, y, shaken, noise)
    match = StructuredMatcher(structure=HarmonicStructure(F=1, G=0), criterion=criterion)
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(MACHINE.omega, output_harmonics=2, reading=reading)),
            ("identify", MOESPRegressor(2)),
            ("reduce", SpuriousModeReducer()),
            ("match", match),
        ]
    )
    pipe, told = fitted(pipe, u, y)
    upper = np.argmax(exponents.imag)
    error, std = nearest(pipe["match"].eigenvalues_, exponents[upper], MACHINE.omega)
    return error, std, least[upper], told


def hawkmoth_trial(seed, criterion, reading, gust, n_periods):
    """The same of the hawkmoth's growing pair, the bound unknown."""
    data = make_hawkmoth(
        n_records=2,
        n_periods=n_periods,
        samples_per_period=SAMPLES,
        quiet=20,
        excitation=5e-3,
        noise=NOISE,
        gust=gust,
        random_state=seed,
    )
    analyzer = HarmonicAnalyzer(data.omega, reading=reading, trim_span=data.trim_span)
    match = StructuredMatcher(structure=HarmonicStructure(F=3, G=3), criterion=criterion)
    weighting = "pbsid" if reading == "period" else "moesp"
    steps = [analyzer, MOESPRegressor(4, weighting=weighting), match]
    pipe = Pipeline(list(zip(["harmonics", "identify", "match"], steps, strict=True)))
    pipe, told = fitted(pipe, data.inputs, data.outputs)
    growing = data.exponents[np.argmax(data.exponents.real + 1e-9 * data.exponents.imag)]
    error, std = nearest(pipe["match"].eigenvalues_, growing, data.omega)
    return error, std, complex(np.nan, np.nan), told


TRIALS = {"mathieu": mathieu_trial, "hawkmoth": hawkmoth_trial}


def study(trial, seeds, *arguments):
    """One row of the table."""
    began, found, told, failed = time.process_time(), [], Counter(), 0
    for seed in seeds:
        try:
            *numbers, words = trial(seed, *arguments)
        except (ValueError, RuntimeError):
            failed += 1
            continue
        found.append(numbers)
        told.update(words)
    error, std, least = np.array(found).reshape(-1, 3).T[..., None].view(float).swapaxes(1, 2)

    def parts(numbers, digits):
        return ", ".join(f"{number:.{digits}g}" for number in numbers.mean(axis=-1) ** 0.5)

    held = 100.0 * np.mean(np.abs(error) < 1.959964 * std, axis=-1)
    return {
        "rms error": parts(error**2, 2),
        "over the bound": parts((error / least) ** 2, 3),
        "rms z": parts((error / std) ** 2, 3),
        "95 % holds": ", ".join(f"{share:.0f}" for share in held),
        "told": ", ".join(f"{count} {word}" for word, count in told.items()) or "–",
        "failed": failed,
        "s": round((time.process_time() - began) / len(seeds), 1),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--machine", choices=TRIALS, default="mathieu")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--periods", nargs="+", type=int)
    parser.add_argument("--gust", nargs="+", type=float)
    parser.add_argument("--criterion", nargs="+", default=CRITERIA)
    parser.add_argument("--reading", default="period")
    given = parser.parse_args()
    moth = given.machine == "hawkmoth"
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    for n_periods in given.periods or ([60] if moth else [160]):
        for gust in given.gust or ([0.02] if moth else [0.0, 0.1, 0.3]):
            for criterion in given.criterion:
                arguments = criterion, given.reading, gust, n_periods
                row = study(TRIALS[given.machine], seeds, *arguments)
                cells = [n_periods, gust, criterion, *row.values()]
                print("| " + " | ".join(map(str, cells)) + " |", flush=True)


if __name__ == "__main__":
    main()
