"""Which reading for which record: exponents and predictions of each on six kinds of records.

    python docs/benchmarks/readings_study.py [--seeds 10] [--first 100] [--only rotor]

Each model is fitted to one record, everything chosen by the data, and answers for another of the
same kind, of which the response to the input alone is known. Printed are, over seeds, the root mean
square of the error of the slowest Floquet exponent (relative, modulo jω), that of the share of the
response that is not predicted (mean over outputs), the worst share predicted, and what fits ended
in. Beside the readings: a time-invariant model with harmonics of the turn as further inputs.

Of the rotor nothing rests. Its mean is taken out for the time-invariant model, and the mean
waveforms over the whole record for the two readings that need a span in trim: the best that is
known for them.
"""

import argparse
import time
import warnings
from collections import Counter
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing, make_rotor


@dataclass(frozen=True)
class Case:
    """A record to fit, and what is known of it and of another.

    Attributes
    ----------
    u, y : DataFrame
        To fit.
    u_new, u_rest, response : DataFrame
        Input of another record, the same at rest, and what the difference does.
    exponents : ndarray
    omega : float
    trim_span : (float, float) or None
    """

    u: pd.DataFrame
    y: pd.DataFrame
    u_new: pd.DataFrame
    u_rest: pd.DataFrame
    response: pd.DataFrame
    exponents: np.ndarray
    omega: float
    trim_span: tuple | None


def doublet(seed):
    """The nonlinear wing: 10 periods in trim, a doublet of 1 %, 60 in all; noise of 1/50."""
    data = make_flapping_wing(
        "nltp", n_periods=60, start=10, amplitude=0.01, n_records=2, snr=50, random_state=seed
    )
    new = data.inputs.loc[1]
    trim = data.trim.states(data.omega * new.index.to_numpy())
    return Case(
        data.inputs.loc[0],
        data.outputs.loc[0],
        new,
        0.0 * new + data.trim.inputs,
        data.outputs_clean.loc[1] - trim,
        data.ltp.floquet_exponents(),
        data.omega,
        data.trim_span,
    )


def steps(n_periods, snr, seed):
    """The linear wing: steps of random sign every 5 samples, from the first on; white noise."""
    rng, n = np.random.default_rng(seed), n_periods * 16
    changes = rng.choice([-1.0, 1.0], (2, n // 5)).repeat(5, axis=1)
    data = make_flapping_wing(
        "ltp",
        n_periods=n_periods,
        samples_per_period=16,
        input=1e-5 * changes,
        n_records=2,
        snr=snr,
        random_state=seed,
    )
    new = data.inputs.loc[1]
    return Case(
        data.inputs.loc[0],
        data.outputs.loc[0],
        new,
        0.0 * new,
        data.outputs_clean.loc[1],
        data.ltp.floquet_exponents(),
        data.omega,
        None,
    )


def rotor(turbulence, seed):
    """The rotor in service, 400 turns of 16.19 samples; noise of 1/100."""
    one, new = (
        make_rotor(n_turns=400, turbulence=turbulence, random_state=seed + more)
        for more in (0, 10_000)
    )
    return Case(
        one.inputs,
        one.outputs,
        new.inputs,
        0.0 * new.inputs,
        new.response,
        one.exponents,
        one.omega,
        (0.0, float(one.inputs.index[-1])),
    )


RECORDS = {
    "wing, doublet and trim": doublet,
    "wing, random steps": partial(steps, 200, 100),
    "wing, 50 noisy periods": partial(steps, 50, 5),
    "wing, 400 noisy periods": partial(steps, 400, 5),
    "rotor, gusts of 0.2 %": partial(rotor, 0.002),
    "rotor, gusts of 0.4 %": partial(rotor, 0.004),
}


def sliding(case):
    reading = HarmonicAnalyzer(
        case.omega, output_harmonics=2, reading="sliding", trim_span=case.trim_span
    )
    return reading, MOESPRegressor(), SpuriousModeReducer()


def period(case):
    reading = HarmonicAnalyzer(
        case.omega, output_harmonics=2, reading="period", trim_span=case.trim_span
    )
    return reading, MOESPRegressor(), StructuredMatcher(structure=HarmonicStructure())


def sample(case):
    return HarmonicAnalyzer(case.omega, reading="sample"), MOESPRegressor()


def beside_turns(case):
    """Time-invariant, with cos kψ and sin kψ as further inputs, about the inputs' mean."""
    mean = case.u.mean()

    def waves(u):
        psi = case.omega * u.index.to_numpy()[:, None] * np.arange(1, 4)
        turn = pd.DataFrame(np.hstack([np.cos(psi), np.sin(psi)]), u.index).add_prefix("turn")
        return (u - mean).join(turn)

    return FunctionTransformer(waves), MOESPRegressor(weighting="pbsid", feedthrough=True)


WAYS = {
    "sliding": sliding,
    "period": period,
    "sample": sample,
    "LTI and turn harmonics": beside_turns,
}


def exponents_found(pipe, sample_time):
    """Eigenvalues of the last model in 1/s."""
    last = pipe[-1]
    if isinstance(last, SpuriousModeReducer):
        return last.system_.poles()
    if isinstance(last, StructuredMatcher):
        return last.ltp_.floquet_exponents()
    if hasattr(last, "n_harmonics_"):
        return last.model_.exponents()
    return np.log(last.eigenvalues_.astype(complex)) / sample_time


def distance(found, case):
    """Of the slowest exponent from the nearest found, modulo jω, relative."""
    slowest = case.exponents[np.argmax(case.exponents.real)]
    apart, turn = found - slowest, case.omega
    apart = apart.real + 1j * (np.mod(apart.imag + 0.5 * turn, turn) - 0.5 * turn)
    return np.min(np.abs(apart)) / np.abs(slowest)


def not_predicted(pipe, case):
    """Share of the response left, the mean over outputs."""
    found = np.asarray(pipe.predict(case.u_new)) - np.asarray(pipe.predict(case.u_rest))
    left = np.sum((found - case.response.to_numpy()) ** 2, axis=0)
    return np.mean(left / np.sum(case.response.to_numpy() ** 2, axis=0))


def study(record, way, seeds):
    """Errors of the exponent and shares left, what fits ended in, CPU time of a fit."""
    found, raised, seconds = [], Counter(), 0.0
    for seed in seeds:
        case = record(seed)
        y = case.y - case.y.mean() if way is beside_turns else case.y
        start = time.process_time()
        try:
            pipe = Pipeline([(str(k), step) for k, step in enumerate(way(case))]).fit(case.u, y)
            seconds += time.process_time() - start
            error = distance(exponents_found(pipe, case.u.index[1] - case.u.index[0]), case)
            found.append((error, not_predicted(pipe, case)))
        except (ValueError, ArithmeticError, RuntimeError) as failure:
            raised[type(failure).__name__] += 1
    return np.array(found).reshape(-1, 2), raised, seconds / max(1, len(found))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    seeds = range(given.first, given.first + given.seeds)
    print("| record | reading | exponent off by | predicted | worst | errors | s |")
    print("|---|---|---|---|---|---|---|")
    for name, record in RECORDS.items():
        if given.only not in name:
            continue
        for label, way in WAYS.items():
            found, raised, seconds = study(record, way, seeds)
            error, left = np.sqrt(np.mean(found**2, axis=0)) if len(found) else (np.nan, np.nan)
            worst = np.max(found[:, 1], initial=0.0)
            told = ", ".join(f"{count} {kind}" for kind, count in raised.items()) or "–"
            print(
                f"| {name} | {label} | {error:.2%} | {1 - left:.4f} | {1 - worst:.4f} | {told} "
                f"| {seconds:.1f} |",
                flush=True,
            )
