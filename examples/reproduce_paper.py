"""Does the five-step method recover the heave dynamics of a flapping wing, and how well?

Hayajnh, Saetti and Prasad (Aerospace 2024, 11(11), 875) identify the subsystem
(w_0, φ̇_1c, φ̇_1s) of a flapping-wing micro air vehicle from the response to one doublet of
the flapping torque, and print in Table 1 how far the matrix A found lies from the exact one:

    e = ‖A(θ*) − A_exact‖_F / ‖A_exact‖_F                                         (Eq. 27)

This script runs each row of that table through one scikit-learn Pipeline,

    HarmonicAnalyzer → MOESPRegressor → SpuriousModeReducer → StructuredMatcher

with data of rising difficulty: harmonic coefficients as a perfect analyzer would give them
(lti), the same put together to signals in time (lti-signal), the linear time-periodic system
(ltp), the nonlinear one (nltp), and white noise on top. It prints e beside the paper's, R² on
a doublet that no model has seen, and a search for order and block rows by cross-validation.
It writes two tables and the paper's figures.

The column "way" says where A comes from:

- "modes": modes that the subspace step identified; under noise refined by maximum likelihood.
- "three modes kept" and "three modes, others residualized": the paper's own way on LTP and
  NLTP data, SpuriousModeReducer(n_states=3) and with method="both". The second has a
  feedthrough, and the matcher brings it to D = 0.
- "period by period": a second route (reading="period", which the default pipeline takes where
  inputs rest). Sampled once a period, a periodic system is time-invariant, so that no spurious
  modes arise; F(ψ) follows in closed form, and under noise by maximum likelihood.

Noise rows are the rms over records that differ in their noise alone, beside the largest e and
the Cramér-Rao bound. Their seeds begin at 1000; nothing was tuned on them.

Nothing is tuned by the truth: order, modes to keep and parameters come from the data, the
known ω, the harmonics kept and the known form (C = I, D = 0). The paper's own way is told
besides that three modes are to be kept. A_exact serves to compute e.

    python examples/reproduce_paper.py --out results          # two noisy records a row
    python examples/reproduce_paper.py --out results --full   # twenty, as the page has them
"""

import argparse
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import _paper_figures as figures
import numpy as np
import pandas as pd
from _paper_bound import bound_percent, periodic_bound_percent
from _paper_cases import (
    CASES,
    FLAP,
    LTI,
    LTI_NOISE,
    LTI_SIGNAL,
    LTP,
    LTP_NOISE,
    NLTP,
    NLTP_SMALL,
    SNR,
    STATES,
    VALIDATION,
    Case,
    build_pipeline,
    build_synchronous,
    measured,
    simulate,
)
from _paper_report import NOISE_NOTES, ORDER_NOTES, TABLE_NOTES, report_warnings, show
from sklearn.exceptions import ConvergenceWarning
from sklearn.metrics import r2_score
from sklearn.model_selection import GridSearchCV, GroupKFold
from sklearn.pipeline import Pipeline
from threadpoolctl import threadpool_limits

from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning

N_SEEDS, N_SEEDS_FULL = 2, 20  # noisy records in each noise row
FIRST_SEED = 1000
EXPECTED = (ExcitationWarning, IdentifiabilityWarning, ConvergenceWarning)


@dataclass
class Run:
    """One record identified."""

    case: Case
    data: object
    model: Pipeline
    warned: list

    @property
    def matched(self):
        return self.model["match"].system_

    @property
    def e_percent(self):
        return error_percent(self.matched.A, self.data.A_exact.to_numpy())

    @property
    def way(self):
        """Where A comes from."""
        if self.case.route == "synchronous":
            return "period by period"
        if self.case.n_states is not None:
            others = " kept" if self.case.method == "truncate" else ", others residualized"
            return "three modes" + others
        return "modes"


# ---- one run ---------------------------------------------------------------------------------


def fit(estimator, X, y, **kwargs):
    """Fit, and return what the package warned of; warnings of others pass on."""
    with warnings.catch_warnings(record=True) as caught:
        for category in EXPECTED:
            warnings.filterwarnings("always", category=category)
        estimator.fit(X, y, **kwargs)
    for w in caught:
        if not issubclass(w.category, EXPECTED):
            warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)
    return [str(w.message) for w in caught if issubclass(w.category, EXPECTED)]


def run(case, seed=None, noise_on="outputs"):
    """Simulate a record and identify the model."""
    data = simulate(case, seed, noise_on)
    build = build_synchronous if case.route == "synchronous" else build_pipeline
    model = build(case, data)
    return Run(case, data, model, fit(model, data.inputs, measured(case, data)))


def error_percent(A, exact):
    """Eq. 27 in percent."""
    return 100.0 * np.linalg.norm(A - exact) / np.linalg.norm(exact)


# ---- noise: seeds, and the bound that no unbiased estimator passes ---------------------------


def run_noisy(case, n_seeds, noise_on="outputs"):
    """Records that differ in their noise alone; a dot for each."""
    allowed = ", allowed for" * case.input_noise
    print(f"  {case.data}, {case.route}, noise on {noise_on}{allowed} ", end="", flush=True)
    runs = []
    for seed in range(FIRST_SEED, FIRST_SEED + n_seeds):
        runs.append(run(case, seed, noise_on))
        print(".", end="", flush=True)
    print()
    return runs


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def noise_bound(run_):
    """Cramér-Rao bound on the rms of e, percent, of the record and the model of its route."""
    bound = periodic_bound_percent if run_.case.route == "synchronous" else bound_percent
    return bound(run_.data, SNR)


def noise_row(runs, noise_on):
    """Spread of e over the seeds beside the bounds."""
    e = np.array([r.e_percent for r in runs])
    case, data = runs[0].case, runs[0].data
    synchronous, bound = case.route == "synchronous", noise_bound(runs[0])
    return {
        "data": case.data,
        "route": case.route,
        "noise_on": noise_on + ", allowed for" * case.input_noise,
        "snr": SNR,
        "seeds": len(e),
        "rms_e_percent": rms(e),
        "largest_e_percent": e.max(),
        "median_e_percent": np.median(e),
        "bound_percent": bound,
        "bound_one_input_entry_percent": np.nan
        if synchronous
        else bound_percent(data, SNR, free_inputs=1),
        "rms_over_bound": rms(e) / bound,
    }


def median_run(runs):
    """The run whose e is nearest to the median: the one drawn."""
    e = np.array([r.e_percent for r in runs])
    return runs[np.argmin(np.abs(e - np.median(e)))]


# ---- the table -------------------------------------------------------------------------------


def table_row(runs, seconds):
    """The row of Table 1 for one run, or for several that differ in their noise."""
    case, e = runs[0].case, [r.e_percent for r in runs]

    def usual(values):
        return pd.Series(list(values)).mode().iloc[0]

    return {
        "data": case.data,
        "route": case.route,
        "way": usual(r.way for r in runs),
        "subsystem": case.subsystem,
        "amplitude": case.amplitude,
        "seeds": len(runs) if case.noise else 0,
        "e_percent": rms(e),
        "largest_e_percent": max(e) if case.noise else np.nan,
        "bound_percent": noise_bound(runs[0]) if case.noise else np.nan,
        "paper_percent": case.paper_percent,
        "order_identified": int(usual(r.model["identify"].order_ for r in runs)),
        "states_kept": int(usual(r.model["reduce"].n_states_ for r in runs)),
        "seconds": seconds,
    }


def full_row(heave, flap, seconds):
    """The 6 x 6 matrix of Eq. 26 put together from both subsystems."""
    exact = heave.data.ltp.harmonic_decomposition(1)
    order = [exact.state_labels.index(name) for part in STATES.values() for name in part]
    A = np.zeros((6, 6))
    A[:3, :3], A[3:, 3:] = heave.matched.A, flap.matched.A
    row = table_row([heave], seconds)
    identified = [r.model["identify"].order_ for r in (heave, flap)]
    return row | {
        "subsystem": "full",
        "e_percent": error_percent(A, exact.A[np.ix_(order, order)]),
        "paper_percent": np.nan,
        "order_identified": sum(identified),
        "states_kept": 6,
    }


def run_table(n_seeds):
    """All rows; the runs by case, and what was warned of."""
    rows, runs = [], {}
    for case in CASES:
        start = time.perf_counter()
        runs[case] = run_noisy(case, n_seeds) if case.noise else [run(case)]
        rows.append(table_row(runs[case], time.perf_counter() - start))
        progress(rows[-1])
    seconds = sum(rows[CASES.index(case)]["seconds"] for case in (LTI_SIGNAL, FLAP))
    rows.append(full_row(runs[LTI_SIGNAL][0], runs[FLAP][0], seconds))
    progress(rows[-1])
    return pd.DataFrame(rows), runs


def progress(row):
    name = f"{row['data']}, {row['subsystem']}, doublet {100 * row['amplitude']:g} %"
    print(
        f"  {name:38s} {row['way']:31s} e = {row['e_percent']:.3g} %   ({row['seconds']:.1f} s)",
        flush=True,
    )


def announced(estimator, X, y):
    """The estimator's score, and a dot for it."""
    print(".", end="", flush=True)
    return estimator.score(X, y)


# ---- validation and cross-validation ---------------------------------------------------------


def validate(run_):
    """Perturbations measured and predicted for the doublet that no model has seen, and R²."""
    clean = replace(run_.case, noise=False)
    scale = run_.case.amplitude / 0.02
    unseen = simulate(clean, **{**VALIDATION, "amplitude": scale * VALIDATION["amplitude"]})
    predicted = run_.model.predict(unseen.inputs)
    true, predicted = (perturbation(clean, unseen, y) for y in (unseen.outputs, predicted))
    r2 = r2_score(true, predicted, multioutput="raw_values")
    return unseen, true, predicted, dict(zip(true.columns, r2, strict=True))


def perturbation(case, data, y):
    """Outputs less the periodic trim."""
    if case.kind != "nltp":
        return y
    return y - data.trim.states(data.omega * y.index.to_numpy())


def search_order():
    """Order and block rows by cross-validation over six noisy records, two held out at a time."""
    case = LTP_NOISE
    print("GridSearchCV over order and block rows ", end="", flush=True)
    data = simulate(case, seed=0, n_records=6, n_periods=60, start=8, width=8)
    grid = {"identify__order": [8, 12, 16, 20], "identify__block_rows": [18, 26]}
    pipe = build_pipeline(case, data)
    # the first two steps are what the grid changes; the others would cost ten times as much
    search = GridSearchCV(pipe[:2], grid, cv=GroupKFold(3), scoring=announced)
    records = data.inputs.index.get_level_values("record")
    fit(search, data.inputs, data.outputs, groups=records)
    print()
    results = pd.DataFrame(search.cv_results_)
    folds = results.filter(regex=r"split\d_test_score")
    found = pd.DataFrame(
        {
            "order": results["param_identify__order"].astype(int),
            "block_rows": results["param_identify__block_rows"].astype(int),
            "score": results["mean_test_score"],
            "worst": folds.min(axis=1),
            "best": folds.max(axis=1),
        }
    )
    fit(pipe.set_params(**search.best_params_), data.inputs, data.outputs)
    return search, found, error_percent(pipe["match"].system_.A, data.A_exact)


# ---- figures ---------------------------------------------------------------------------------


def draw_cases(runs, out):
    """Singular values and eigenvalues of each kind of data (Figs. 3 to 10 and 12 to 15)."""
    numbers = {LTI: 3, LTI_NOISE: 5, LTI_SIGNAL: 7, LTP: 9, LTP_NOISE: 12, NLTP: 14}
    for case, number in numbers.items():
        run_ = median_run(runs[case])
        steps, name = run_.model, case.data.replace("+", "_").replace("-", "_")
        title = f"{case.data} data"
        figure = figures.singular_values(steps["identify"], title, case.paper_gap)
        figures.save(figure, out, number, f"singular_values_{name}")
        exact = np.linalg.eigvals(run_.data.A_exact.to_numpy())
        modes, matched = steps["reduce"].modes_, run_.matched.poles()
        figure = figures.eigenvalues(modes, matched, exact, title)
        figures.save(figure, out, number + 1, f"eigenvalues_{name}")


def draw_responses(runs, out):
    """The systems' responses to the doublet used for identification (Fig. 2)."""
    cases = {"NLTP": NLTP, "LTP": LTP, "LTI (Eq. 7)": LTI_SIGNAL}
    data = {label: runs[case][0].data for label, case in cases.items()}
    records = {k: perturbation(cases[k], d, d.outputs) for k, d in data.items()}
    percent = input_percent(LTP, data["LTP"])
    figures.save(figures.responses(percent, records, 1.6), out, 2, "doublet_responses")


def draw_validation(runs, out):
    """Prediction of the unseen doublet (Figs. 11 and 16); R² by data and output."""
    rows = []
    for case, number in ((LTP, 11), (NLTP, 16), (NLTP_SMALL, None), (LTP_NOISE, None)):
        unseen, true, predicted, r2 = validate(median_run(runs[case]))
        rows.append({"data": case.data, "amplitude": case.amplitude} | r2)
        if number is not None:
            records = {f"{case.kind.upper()} system": true, "identified, 3 states": predicted}
            figure = figures.responses(input_percent(case, unseen), records, 1.2)
            figures.save(figure, out, number, f"validation_{case.kind}")
    return pd.DataFrame(rows)


def input_percent(case, data):
    """Change of the input in percent of its trim value."""
    torque = data.trim.inputs[0]
    return 100.0 * (data.inputs["U"] - torque * (case.kind == "nltp")) / torque


def draw_frequency_responses(runs, out):
    """Matched models against the exact one, from U_0 to the three coefficients (Fig. 17)."""
    cases = {"lti-signal": LTI_SIGNAL, "ltp": LTP, "nltp, 2 %": NLTP}
    systems = {label: runs[case][0].matched for label, case in cases.items()}
    data = runs[LTP][0].data
    exact = data.A_exact.to_numpy(), data.B_exact.to_numpy()
    figures.save(figures.frequency_responses(exact, systems), out, 17, "frequency_response")


# ---- main ------------------------------------------------------------------------------------


def identified_orders():
    """Order found without noise, by the rows read in a period."""
    found = {}
    for case in (LTI_SIGNAL, LTP):
        found[case.data] = [identified_order(replace(case, rows_per_period=r)) for r in (4, 8, 16)]
    return pd.DataFrame(found, index=pd.Index([4, 8, 16], name="rows per period")).T


def identified_order(case):
    """Order that the first two steps find."""
    data = simulate(case)
    steps = build_pipeline(case, data)[:2]
    fit(steps, data.inputs, measured(case, data))
    return steps["identify"].order_


def noise_table(runs, n_seeds, full):
    """Noise on the outputs, and in full on the input, too, beside the bounds."""
    rows = []
    for case in (c for c in CASES if c.noise):
        rows.append(noise_row(runs[case], "outputs"))
        if full:
            rows.append(noise_row(run_noisy(case, n_seeds, "both"), "both"))
        if full and case.route == "synchronous":
            allowing = replace(case, input_noise=True)
            rows.append(noise_row(run_noisy(allowing, n_seeds, "both"), "both"))
    return pd.DataFrame(rows)


def parse_arguments():
    parser = argparse.ArgumentParser(
        description="Table 1 and Figures 1 to 16 of Aerospace 2024, 11(11), 875.",
    )
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder to write to")
    parser.add_argument(
        "--full",
        action="store_true",
        help=f"{N_SEEDS_FULL} noisy records a row, not {N_SEEDS}; noise on the input, too",
    )
    return parser.parse_args()


def main():
    started, arguments = time.perf_counter(), parse_arguments()
    out, n_seeds = arguments.out, N_SEEDS_FULL if arguments.full else N_SEEDS
    out.mkdir(parents=True, exist_ok=True)
    print(f"Table 1 of Aerospace 2024, 11(11), 875; noise rows over {n_seeds} seeds")
    table, runs = run_table(n_seeds)
    table.to_csv(out / "table_1.csv", index=False)
    print()
    show(
        table.drop(columns=["route", "amplitude", "seconds"])
        .assign(doublet=(100 * table["amplitude"]).map("{:g} %".format))
        .rename(columns=lambda name: name.removesuffix("_percent")),
        3,
    )
    data = runs[LTP][0].data
    print(TABLE_NOTES.format(entry=data.A_exact.iloc[1, 1]))
    orders = (runs[case][0].model["identify"].order_ for case in (LTI, LTI_SIGNAL, LTP, NLTP))
    print(ORDER_NOTES.format(ours=", ".join(map(str, orders))))
    print(identified_orders().to_string(), end="\n\n", flush=True)
    report_warnings(runs)

    print(
        f"Noise: spread over {n_seeds} seeds, and the Cramér-Rao bound (all in percent)", flush=True
    )
    noise = noise_table(runs, n_seeds, arguments.full)
    noise.to_csv(out / "noise_bounds.csv", index=False)
    brief = noise.drop(columns=["snr", "seeds", "median_e_percent"])
    show(brief.rename(columns=lambda name: name.removesuffix("_percent")), 3)
    print(NOISE_NOTES)

    print("drawing figures ", end="", flush=True)
    shares = data.ltp.modal_participation(1)
    figures.save(figures.participation(shares), out, 1, "participation_factors")
    draw_responses(runs, out)
    draw_cases(runs, out)
    draw_frequency_responses(runs, out)
    scores = draw_validation(runs, out)
    print()
    print("R² of y(t) on a doublet not used for identification (6 + 6 periods, begun downwards)")
    show(scores, 5)

    search, found, e = search_order()
    figures.save(figures.order_search(search), out, 18, "order_search")
    print()
    print("GridSearchCV on six noisy ltp records, two held out at a time, mean R² of y(t)")
    show(found, 4)
    print(f"best: {search.best_params_}, e = {e:.2g} % on all six records\n")
    print(f"tables and figures are in {out}; {time.perf_counter() - started:.0f} s in all")


if __name__ == "__main__":
    with threadpool_limits(limits=1):  # the matrices are small: threads cost more than they save
        main()
