"""Does partial_fit follow a wing that changes in flight?

The flapping wing, linear and time-periodic, driven by random steps held over whole periods, noise
of 1/20 of each output. The damping of its vertical speed (the first row of F) rises by a half over
the middle third of 1200 periods. Chunks of 20 periods go through a sliding window (four rows a
period) to MOESPRegressor(order=3), once without and with several half-lives. After each chunk the
eigenvalue nearest to the slow Floquet exponent of that moment is compared with it.

- ``lag``: periods by which the estimate is behind over the drift's last half: its mean error, less
  that before the drift in percent, over the mean rate of the exponent;
- ``mean age`` is h / ln 2, what the weights promise;
- ``rms before`` and ``rms after``: of the error in percent, over the last 200 periods before the
  drift and of the record; ``bias after``: its mean;
- ``memory_growth``: size of the pickled estimator at the end, in parts of that 100 periods before.

    python docs/benchmarks/drifting_wing_study.py --seeds 5
"""

import argparse
import pickle
import warnings

import numpy as np
import pandas as pd

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.systems import LTPSystem

N_PERIODS, CHUNK, SPP, SNR = 1200, 20, 64, 20.0
START, STOP, CHANGE = 400, 800, 0.5
UPDATE = 5  # periods between changes of F


class Changed:
    """F(ψ) with the row of the vertical speed times a factor."""

    def __init__(self, F, factor):
        self.F, self.rows = F, np.array([factor, 1.0])[:, None]

    def __call__(self, psi):
        return self.F(psi) * self.rows


def factor(period):
    """Of the damping, in some period."""
    return 1.0 + CHANGE * np.clip((period - START) / (STOP - START), 0.0, 1.0)


def flown(seed):
    """Inputs and outputs of one flight, and the slow exponent by period."""
    ltp, rng = make_flapping_wing("ltp", n_periods=30, start=5).ltp, np.random.default_rng(seed)
    torque = 8.5e-5 * rng.choice([-1.0, 1.0], N_PERIODS)
    n = UPDATE * SPP
    dt, x, outputs, exponents = ltp.period / SPP, np.zeros(2), [], []
    u = np.repeat(torque, SPP)[:, None]
    for first in range(0, N_PERIODS, UPDATE):
        wing = LTPSystem(
            Changed(ltp.F, factor(first + 0.5 * UPDATE)),
            ltp.G,
            omega=ltp.omega,
            state_names=ltp.state_names,
            input_names=ltp.input_names,
        )
        own = np.vstack([u[first * SPP : first * SPP + n], [[0.0]]])
        y = wing.simulate(own, dt * np.arange(n + 1), x)
        x = y[-1]
        outputs.append(y[:-1])
        exponents += [wing.floquet_exponents()[0].real] * UPDATE
    index = pd.Index(dt * np.arange(len(u)), name="time")
    y = pd.DataFrame(np.vstack(outputs), index, list(ltp.state_names))
    y += y.std(axis=0).to_numpy() / SNR * rng.standard_normal(y.shape)
    return pd.DataFrame(u, index, list(ltp.input_names)), y, ltp.omega, np.array(exponents)


def followed(inputs, outputs, omega, truth, half_life):
    """The slow eigenvalue after each chunk, and the size of the estimator's memory."""
    analyzer = HarmonicAnalyzer(
        omega,
        reading="sliding",
        output_harmonics={"w": [0], "phi_dot": [1]},
        hop=SPP // 4,
        trim_span=None,
    )
    analyzer.fit(inputs[: CHUNK * SPP], outputs[: CHUNK * SPP])
    model = MOESPRegressor(order=3, block_rows=10, half_life=half_life)
    found, sizes = [], []
    for first in range(0, N_PERIODS, CHUNK):
        rows = slice(first * SPP, (first + CHUNK) * SPP)
        model.partial_fit(analyzer.transform(inputs.iloc[rows]), outputs.iloc[rows])
        z = model.eigenvalues_.astype(complex)
        exponents = np.log(z) / (model.model_.dt)
        now = truth[first + CHUNK - 1]
        found.append(exponents[np.argmin(np.abs(exponents - now))].real)
        sizes.append(len(pickle.dumps(model)))
    return np.array(found), sizes, model.n_effective_rows_


def run(half_life, flights):
    """One row of the table."""
    ends = np.arange(CHUNK, N_PERIODS + 1, CHUNK)
    errors, lags, memory, worth = [], [], [], []
    before, after = (ends > START - 200) & (ends <= START), ends > N_PERIODS - 200
    late = (ends > 0.5 * (START + STOP)) & (ends <= STOP)
    for inputs, outputs, omega, truth in flights:
        found, sizes, n_effective = followed(inputs, outputs, omega, truth, half_life)
        now = truth[ends - 1]
        rate = (truth[STOP] - truth[START]) / (STOP - START)
        relative = (found - now) / np.abs(now)
        errors.append(100.0 * relative)
        behind = (relative - np.mean(relative[before])) * np.abs(now)
        lags.append(-np.mean(behind[late]) / rate)
        memory.append(sizes[-1] / sizes[-6])
        worth.append(n_effective / 4.0)
    errors = np.array(errors)
    return {
        "half_life": np.inf if half_life is None else half_life,
        "mean_age": np.inf if half_life is None else half_life / np.log(2.0),
        "effective_periods": np.mean(worth),
        "lag": np.mean(lags),
        "rms_before_%": np.sqrt(np.mean(errors[:, before] ** 2)),
        "rms_after_%": np.sqrt(np.mean(errors[:, after] ** 2)),
        "bias_after_%": np.mean(errors[:, after]),
        "memory_growth": np.max(memory),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--half-lives", type=float, nargs="+", default=[20.0, 40.0, 80.0])
    options = parser.parse_args()
    flights = [flown(seed) for seed in range(options.seeds)]
    exponents = flights[0][3]
    print(f"slow exponent: {exponents[0]:.4g} 1/s before the change, {exponents[-1]:.4g} after")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = [run(half_life, flights) for half_life in (None, *options.half_lives)]
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:.3g}".format))


if __name__ == "__main__":
    main()
