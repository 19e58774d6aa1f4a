"""What does a designed record gain over a doublet of equal energy?

The flapping wing, linear and time-periodic, 60 periods, white noise of 1/20 of each output's
standard deviation under the doublet of 2 x 10 periods (the same noise for all inputs). The
inputs designed have the doublet's amplitude, energy and length. Each record is identified with
default settings (HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer) and
``StructuredMatcher(structure=..., criterion=...)``.

- ``truncated``: F(ψ) of the wing cut after 4 harmonics, structure HarmonicStructure(F=4, G=1): the
  truth lies in the model class, and the bound is that of the estimate;
- ``wing``: F(ψ) has kinks, and HarmonicStructure() leaves its harmonics to the data.

The criterion ``from_truth`` (truncated only) is the same likelihood, its search begun at the truth:
what the record holds, whatever the steps before the likelihood make of it.

- ``bound``: smallest standard deviation of an unbiased estimate, in percent of the exponent;
- ``median``, ``rms``, ``worst``: errors of the estimates in percent, over the seeds;
- ``gain``: rms (bound) of the doublet over that of the input.

    python docs/benchmarks/next_record_study.py --seeds 20
"""

import argparse
import warnings

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
from sklearn_hd.algorithms.likelihood.prediction_error import output_error_of
from sklearn_hd.algorithms.likelihood.uncertainty import exponent_slopes
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.design import design_input
from sklearn_hd.systems import LTPSystem

RECORD = {"n_periods": 60, "start": 5}
WIDTH, SNR, SPP = 10, 20.0, 64
STRUCTURE = HarmonicStructure(F=4, G=1)


def cut(ltp):
    """The system with as many harmonics as the structure has."""
    return LTPSystem(
        ltp.fourier_coefficients(4)[0],
        ltp.fourier_coefficients(1)[1],
        omega=ltp.omega,
        state_names=ltp.state_names,
        input_names=ltp.input_names,
    )


def identified(inputs, outputs, omega, structure, reading, criterion):
    """Exponents of one record, from the rightmost leftwards, and the reading taken."""
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, reading=reading)),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=structure, criterion=criterion)),
        ]
    ).fit(inputs, outputs)
    return pipe["match"].ltp_.floquet_exponents(), pipe["identify"].basis_.reading


def from_truth(inputs, outputs, system, sigma):
    """Exponents of largest likelihood near those of the system."""
    names = system.state_names, system.input_names, system.output_names
    structure = STRUCTURE.resolve(*names, {})
    whole = np.zeros(structure.constant.shape)
    whole[:, :2, :2], whole[:3, :2, 2:] = (M.coefficients for M in (system.F, system.G))
    whole[0, 2:, :2] = np.eye(2)
    theta = structure.nearest(whole)
    record = [(inputs.to_numpy(), outputs.to_numpy(), 0)]
    form = Form(structure, system.omega, SPP)
    found = output_error_of(form, record, theta, sigma=sigma)
    return exponent_slopes(form, found.theta)[0], "-"


def errors(inputs, system, sigma, seeds, *settings):
    """Relative errors (n_seeds, n_exponents) in percent, and the reading taken; NaN: no model."""
    clean = system.simulate(inputs.to_numpy(), inputs.index.to_numpy())
    truth, found, readings = system.floquet_exponents(), [], set()
    for seed in seeds:
        noise = sigma * np.random.default_rng(seed).standard_normal(clean.shape)
        outputs = pd.DataFrame(clean + noise, inputs.index, list(system.output_names))
        try:
            if settings[-1] == "from_truth":
                exponents, reading = from_truth(inputs, outputs, system, sigma)
            else:
                exponents, reading = identified(inputs, outputs, system.omega, *settings)
        except ValueError as error:
            print(f"seed {seed}: {error}")
            exponents, reading = np.full(len(truth), np.nan), "none"
        readings.add(reading)
        n = min(len(truth), len(exponents))
        row = np.full(len(truth), np.nan)
        row[:n] = 100.0 * np.abs(exponents[:n] - truth[:n]) / np.abs(truth[:n])
        found.append(row)
    return np.array(found), "/".join(sorted(readings))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--criteria", nargs="+", default=["hinf", "output_error", "from_truth"])
    parser.add_argument("--reading", default="auto")
    parser.add_argument("--machine", choices=["truncated", "wing"], default="truncated")
    parser.add_argument("--kinds", nargs="+", default=["steps", "multisine"])
    options = parser.parse_args()
    data = make_flapping_wing("ltp", width=WIDTH, **RECORD)
    system, structure = data.ltp, HarmonicStructure()
    if options.machine == "truncated":
        system, structure = cut(system), STRUCTURE
    sigma = data.outputs.std(axis=0).to_numpy() / SNR
    budget = {
        "amplitude": float(np.abs(data.inputs.to_numpy()).max()),
        "length": RECORD["n_periods"] * data.ltp.period,
        "energy": 2 * WIDTH * data.ltp.period,
    }
    inputs, bounds = {"doublet": data.inputs}, {}
    for kind in options.kinds:
        found = design_input(
            system, **budget, kind=kind, X=data.inputs, noise_std=sigma, structure=STRUCTURE
        )
        table, size = found.exponents, np.abs(found.exponents["exponent"])
        inputs[kind] = found.inputs
        bounds[kind] = 100.0 * table["std_real"] / size
        bounds["doublet"] = 100.0 * table["std_real_at_hand"] / size
        print(f"{kind}: {found.energy / data.ltp.period:.3g} periods of energy; {found.lacking}")
    rows = []
    for criterion in options.criteria:
        rms = {}
        for kind, u in inputs.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                error, reading = errors(
                    u, system, sigma, range(options.seeds), structure, options.reading, criterion
                )
            rms[kind] = np.sqrt(np.nanmean(error**2, axis=0))
            for k in range(error.shape[1]):
                rows.append(
                    {
                        "criterion": criterion,
                        "input": kind,
                        "reading": reading,
                        "exponent": k,
                        "bound_%": bounds[kind][k],
                        "median_%": np.nanmedian(error[:, k]),
                        "rms_%": rms[kind][k],
                        "worst_%": np.nanmax(error[:, k]),
                        "no_model": int(np.isnan(error[:, k]).sum()),
                        "bound_gain": bounds["doublet"][k] / bounds[kind][k],
                        "rms_gain": rms["doublet"][k] / rms[kind][k],
                    }
                )
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    main()
