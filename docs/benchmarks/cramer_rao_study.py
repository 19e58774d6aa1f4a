"""How near do maximum-likelihood estimates come to the Cramér-Rao bound?

Records of the flapping wing with white noise of 1/20 of each output's standard deviation,
identified by the four steps with criterion="output_error":

- ``lti-signal``: data of the harmonic-decomposition model itself, by the sliding analyzer
  and a MatrixStructure (10 parameters);
- ``ltp-truncated``: data of the periodic system with F(ψ) cut after 4 harmonics, by the
  period-synchronous analyzer and HarmonicStructure(F=4, G=1): truth in the model class;
- ``ltp``: data of the flapping wing, whose F(ψ) has kinks, the number of harmonics chosen
  from each record.

e is the error of the heave matrix (Eq. 27) in percent; its bound is √trace of the bound on
the matrix; "coverage" the share of 95 % intervals that hold the true parameter.

    python docs/benchmarks/cramer_rao_study.py --seeds 100
"""

import argparse
import warnings
from collections import Counter

import numpy as np
import pandas as pd
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.prediction_error import output_error_of
from sklearn_hd.algorithms.likelihood.uncertainty import fisher_information
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.systems import LTPSystem

SNR = 20.0
SPP = 64
RECORD = {"n_periods": 60, "start": 5, "samples_per_period": SPP}
KEPT = {"w": [0], "phi_dot": [1]}
STATES = ["w_0", "phi_dot_1c", "phi_dot_1s"]
SIGNALS = ["w", "phi_dot"]
HEAVE = [0, 3, 5]  # w_0, phi_dot_1c, phi_dot_1s among the harmonics of both states


def heave_structure():
    """A free, and the one entry of B that the torque drives."""
    B = np.array([[0.0], [np.nan], [0.0]])
    return MatrixStructure(np.full((3, 3), np.nan), B, state_names=STATES, output_names=STATES)


class Case:
    """Noise-free outputs of one kind, the pipeline, and what the truth is."""

    def __init__(self, kind):
        self.kind = kind
        self.data = make_flapping_wing("lti-signal" if kind == "lti-signal" else "ltp", **RECORD)
        self.inputs, self.clean = self.data.inputs, self.data.outputs
        self.exact, self.omega = self.data.A_exact.to_numpy(), self.data.omega
        self.structure = {
            "lti-signal": heave_structure(),
            "ltp-truncated": HarmonicStructure(F=4, G=1),
            "ltp": HarmonicStructure(),
        }[kind]
        self.theta = None
        if kind == "lti-signal":
            B = self.data.B_exact.to_numpy()
            self.theta = np.append(self.exact.ravel(), B[1, 0])
        if kind == "ltp-truncated":
            self._truncate()

    def _truncate(self):
        F = self.data.ltp.fourier_coefficients(4)[0]
        G = np.zeros((3, 2, 1))
        G[1, 1, 0] = self.data.system.linearize(self.data.trim).fourier_coefficients(1)[1][1, 1, 0]
        system = LTPSystem(F, G, omega=self.omega, state_names=SIGNALS, input_names=["U"])
        y = system.simulate(self.inputs.to_numpy(), self.inputs.index.to_numpy())
        self.clean = pd.DataFrame(y, self.inputs.index, SIGNALS)
        A = system.harmonic_decomposition(1).A
        self.exact = A[np.ix_(HEAVE, HEAVE)]
        M = np.zeros((9, 4, 3))
        M[:, :2, :2], M[:3, :2, 2:], M[0, 2:, :2] = F, G, np.eye(2)
        resolved = self.periodic(4, 1)
        self.theta = resolved.nearest(M)

    @staticmethod
    def periodic(F, G):
        return HarmonicStructure().resolve(SIGNALS, ["U"], SIGNALS, {"F": F, "G": G})

    def noisy(self, seed):
        rng = np.random.default_rng(seed)
        sigma = self.clean.std(axis=0).to_numpy() / SNR
        return self.clean + sigma * rng.standard_normal(self.clean.shape), sigma

    def pipeline(self):
        rows = {"hop": 16} if self.kind == "lti-signal" else {"reading": "period"}
        return Pipeline(
            [
                (
                    "harmonics",
                    HarmonicAnalyzer(self.omega, output_harmonics=KEPT, **rows),
                ),
                ("identify", MOESPRegressor()),
                ("reduce", SpuriousModeReducer()),
                ("match", StructuredMatcher(structure=self.structure, criterion="output_error")),
            ]
        )

    def problem(self, n_harmonics=None):
        """Structure, sampling and record for the bound."""
        if self.kind == "lti-signal":
            structure = PeriodicStructure.time_invariant(heave_structure().affine)
            psi = 2 * np.pi * np.arange(SPP) / SPP
            observe = np.zeros((SPP, 2, 3))
            observe[:, 0, 0] = 1.0
            observe[:, 1, 1:] = harmonic_functions(psi, [1])
            return structure, observe
        return self.periodic(*(n_harmonics or (4, 1))), None

    def bound(self, sigma, n_harmonics=None):
        """Bound on the rms of e in percent, and what the model class leaves of e without noise."""
        structure, observe = self.problem(n_harmonics)
        record = [(self.inputs.to_numpy(), self.clean.to_numpy(), 0)]
        theta, bias = self.theta, 0.0
        if theta is None:
            start = np.zeros(structure.constant.shape)
            F = self.data.ltp.fourier_coefficients(n_harmonics[0])[0]
            G = self.data.ltp.fourier_coefficients(1)[1]
            start[: len(F), :2, :2], start[0, 2:, :2] = F, np.eye(2)
            start[: min(3, len(start)), :2, 2:] = G[: min(3, len(start))]
            theta = structure.nearest(start)
            # the fit of the class to the clean record, each output weighed as under noise
            theta = output_error_of(
                Form(structure, self.omega, SPP), record, theta, sigma=sigma
            ).theta
        form = Form(structure, self.omega, SPP, observe)
        found = fisher_information(form, theta, record, sigma)
        A, slopes = self.heave(structure, theta)
        bias = 100 * np.linalg.norm(A - self.exact) / np.linalg.norm(self.exact)
        spread = np.einsum("kij,kl,lij->", slopes, found.covariance, slopes)
        return 100 * np.sqrt(spread) / np.linalg.norm(self.exact), bias

    def heave(self, structure, theta):
        """The heave matrix, and its derivatives."""
        if self.kind == "lti-signal":
            A = structure.matrices(theta)[0][0]
            basis = structure.basis.toarray().reshape(-1, *structure.constant.shape)
            return A, basis[:, 0, :3, :3]

        def decompose(coefficients):
            system = LTPSystem(
                coefficients[:, :2, :2], np.zeros((2, 1)), omega=self.omega
            ).harmonic_decomposition(1)
            return system.A[np.ix_(HEAVE, HEAVE)]

        at = decompose(structure.coefficients(theta))
        base = decompose(structure.constant)
        rates = structure.basis.toarray().reshape(-1, *structure.constant.shape)
        return at, np.array([decompose(structure.constant + rate) - base for rate in rates])


def run(kind, n_seeds, first_seed=0):
    """One row of the table."""
    case = Case(kind)
    errors, ratios, inside, counts, scores = [], [], [], Counter(), []
    bounds = {}
    for seed in range(first_seed, first_seed + n_seeds):
        y, sigma = case.noisy(seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pipe = case.pipeline().fit(case.inputs, y)
        match = pipe["match"]
        e = 100 * np.linalg.norm(match.system_.A - case.exact) / np.linalg.norm(case.exact)
        chosen = None
        if kind == "ltp":
            chosen = match.ltp_.F.n_harmonics, match.ltp_.G.n_harmonics
        if chosen not in bounds:
            bounds[chosen] = case.bound(sigma, chosen)
        bound, bias = bounds[chosen]
        errors.append(e)
        ratios.append(e / np.hypot(bound, bias))
        counts[chosen] += 1
        scores.append(pipe.score(case.inputs, case.clean))
        if case.theta is not None:
            z = (match.theta_.to_numpy() - case.theta) / match.theta_std_.to_numpy()
            inside.append(np.abs(z) < 1.959964)
    rms = np.sqrt(np.mean(np.square(errors)))
    usual = counts.most_common(1)[0][0]
    return {
        "data": kind,
        "seeds": n_seeds,
        "median_e": np.median(errors),
        "rms_e": rms,
        "largest_e": np.max(errors),
        "bound": bounds[usual][0],
        "bias": bounds[usual][1],
        "rms_over_bound": np.sqrt(np.mean(np.square(ratios))),
        "coverage": np.mean(inside) if inside else np.nan,
        "harmonics": ""
        if usual is None
        else "F {}, G {} ({:.0%})".format(*usual, counts[usual] / n_seeds),
        "lowest_r2": np.min(scores),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="+", default=["lti-signal", "ltp-truncated", "ltp"])
    options = parser.parse_args()
    rows = [run(kind, options.seeds, options.first_seed) for kind in options.kinds]
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.4g}".format))


if __name__ == "__main__":
    main()
