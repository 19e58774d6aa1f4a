"""The hawkmoth identified while its feedback is on: MOESP, PBSID, and the way back to F(ψ).

Each seed has records of its own; medians over them. Run as
``python docs/benchmarks/closed_loop_study.py [--seeds 10] [--first-seed 300]``.
"""

import argparse
import warnings

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
from sklearn_hd.datasets import make_hawkmoth

FLIGHTS = {
    "steps of 1e-4 rad": {"excitation": 1e-4},
    "1e-3 rad, sensor noise of 2 %": {"excitation": 1e-3, "noise": 0.02},
    "5e-3 rad, gusts of 0.02 m/s": {"excitation": 5e-3, "gust": 0.02},
    "1e-2 rad, gusts of 0.05 m/s, noise of 2 %": {
        "excitation": 1e-2,
        "gust": 0.05,
        "noise": 0.02,
    },
}


def pipeline(data, weighting):
    """The five steps, wingbeat by wingbeat."""
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(data.omega, reading="period", trim_span=data.trim_span)),
            ("identify", MOESPRegressor(4, weighting=weighting)),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    )


def paired(found, wanted, omega):
    """Exponents found, in the order of those wanted, modulo jω."""
    gap = np.asarray(found)[None, :] - np.asarray(wanted)[:, None]
    turns = 1j * omega * np.round(gap.imag / omega)
    _, order = linear_sum_assignment(np.abs(gap - turns))
    return np.asarray(found)[order] - turns[np.arange(len(order)), order]


def identified(data, weighting):
    """Exponents of the model of the wingbeats, and of the LTP model; its error in HD form."""
    pipe = pipeline(data, weighting)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an unstable orbit, which it is
        pipe.fit(data.inputs, data.outputs)
    map_exponents = np.log(pipe["identify"].eigenvalues_.astype(complex)) * data.omega / 2 / np.pi
    ltp, wanted = pipe["match"].ltp_, data.exponents
    found, truth = (each.harmonic_decomposition(1).A for each in (ltp, data.ltp))
    states_are_outputs = ltp.state_names == data.ltp.state_names
    error = np.linalg.norm(found - truth) / np.linalg.norm(truth) if states_are_outputs else np.nan
    return (
        paired(map_exponents, wanted, data.omega),
        paired(ltp.floquet_exponents(), wanted, data.omega),
        error,
    )


def study(flights=FLIGHTS, seeds=range(300, 310), weightings=("moesp", "pbsid"), **records):
    """A table: real part of the growing pair, relative errors, by flight and weighting.

    Parameters
    ----------
    flights : dict of dict
        Arguments of ``make_hawkmoth`` by name.
    seeds : iterable of int
    weightings : tuple of str
    **records
        More arguments of ``make_hawkmoth``, in place of 4 records of 150 wingbeats.
    """
    shape = {"n_records": 4, "n_periods": 150, "quiet": 30, **records}
    rows = []
    for name, arguments in flights.items():
        for seed in seeds:
            data = make_hawkmoth(**shape, **arguments, random_state=seed)
            for weighting in weightings:
                wanted = data.exponents
                row = {"flight": name, "weighting": weighting, "seed": seed}
                try:
                    by_map, by_ltp, error = identified(data, weighting)
                except ValueError as failure:
                    rows.append({**row, "failed": str(failure)})
                    continue
                off = np.abs(by_ltp - wanted) / np.abs(wanted)
                pair = np.argmax(wanted.real)
                rows.append(
                    {
                        **row,
                        "growth, identify": by_map[pair].real,
                        "growth, match": by_ltp[pair].real,
                        "pair": off[pair],
                        "fast": off[np.argmin(wanted.real)],
                        "heave": off[np.argmin(np.abs(wanted))],
                        "A of HD": error,
                    }
                )
    return pd.DataFrame(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=300)
    given = parser.parse_args()
    table = study(seeds=range(given.first_seed, given.first_seed + given.seeds))
    by = table.groupby(["flight", "weighting"], sort=False)
    numbers = by.median(numeric_only=True).drop(columns="seed")
    numbers["fitted"] = by["A of HD"].count()
    print(numbers.to_string(float_format=lambda value: f"{value:.3g}"))
