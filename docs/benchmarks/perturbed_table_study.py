"""Table 1 with perturbed records: is each figure as good as the published one, or warned of?

    python docs/benchmarks/perturbed_table_study.py [--only default sliding] [--seed 0]

Each row changes one thing of the record: samples per period, where the edges of the doublet fall
within the period, its width, its amplitude, the length of the record, the harmonics kept, noise on
the measured input. "default" chooses nothing: HarmonicAnalyzer(omega), and the decomposition of
the periodic model. "sliding" is the paper's way: the harmonics of the heave subsystem through a
window. A cell is good if e is within three times the published figure, "told" if a fit warns or
refuses, else SILENT. Printed beside e are its ratio to the published one, and what was said.
"""

import argparse
import warnings

import numpy as np
from sklearn.pipeline import make_pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing

HEAVE = ["w_0", "phi_dot_1c", "phi_dot_1s"]
KEPT = {"w": [0], "phi_dot": [1]}
RECORD = {"n_periods": 60, "start": 8, "width": 10}
PUBLISHED = {  # in percent; the default was published with 0.18 % of NLTP data, and now has 0.045 %
    ("default", "ltp"): 5.5e-5,
    ("default", "nltp"): 0.18,
    ("sliding", "lti-signal"): 6.7e-9,
    ("sliding", "ltp"): 0.592,
    ("sliding", "nltp"): 1.71,
}
WITHIN = 3.0  # times the published figure
TOLD = (
    "IdentifiabilityWarning",
    "InstabilityWarning",
    "ExcitationWarning",
    "ConvergenceWarning",
    "FrequencyMismatchWarning",
)


def perturbations(rng):
    """Words, options of the record, harmonics kept and noise on the input of each row."""
    yield "as published", {}, 1, 0.0
    for samples in (48, 57, 100):
        yield f"{samples} samples", {"samples_per_period": samples}, 1, 0.0
    for offset in (13, 29, 50):
        yield f"edges at sample {offset}", {"offset": offset / 64}, 1, 0.0
    for width in (1, 3, 6, 14, 20):
        yield f"width {width}", {"width": width}, 1, 0.0
    for percent in (0.5, 5, 10, 20):
        yield f"amplitude {percent} %", {"amplitude": percent / 100}, 1, 0.0
    yield "30 periods", {"n_periods": 30, "width": 6}, 1, 0.0
    for harmonics in (2, 3):
        yield f"{harmonics} harmonics", {}, harmonics, 0.0
    for noise in (1e-6, 1e-5, 1e-4, 1e-3):
        yield f"input noise {noise:g}", {}, 1, noise


def pipeline(way, omega, harmonics):
    """The default with nothing chosen but the harmonics, or the paper's way."""
    steps = MOESPRegressor(), SpuriousModeReducer()
    if way == "default":
        analyzer = HarmonicAnalyzer(omega, output_harmonics=harmonics)
        return make_pipeline(analyzer, *steps, StructuredMatcher(structure=HarmonicStructure()))
    kept = {"w": list(range(0, harmonics, 2)), "phi_dot": list(range(1, harmonics + 1, 2))}
    names = [
        f"{s}_{k}{part}"
        for s, orders in kept.items()
        for k in orders
        for part in (("c", "s") if k else ("",))
    ]
    n = len(names)
    free = MatrixStructure(
        np.full((n, n), np.nan), np.full((n, 1), np.nan), state_names=names, output_names=names
    )
    analyzer = HarmonicAnalyzer(omega, reading="sliding", output_harmonics=kept)
    return make_pipeline(analyzer, *steps, StructuredMatcher(structure=free))


def error(pipe, exact):
    """‖A − A_exact‖_F / ‖A_exact‖_F of the heave subsystem, in percent."""
    system = pipe[-1].system_
    rows = [list(system.state_labels).index(name) for name in HEAVE]
    A = system.A[np.ix_(rows, rows)]
    return 100.0 * float(np.linalg.norm(A - exact) / np.linalg.norm(exact))


def cell(way, kind, options, harmonics, noise, rng):
    """e in percent, and the warnings."""
    data = make_flapping_wing(kind, **{**RECORD, **options})
    size = np.ptp(data.inputs.to_numpy())
    u = data.inputs + noise * size * rng.standard_normal(data.inputs.shape)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            pipe = pipeline(way, data.omega, harmonics).fit(u, data.outputs)
            e = error(pipe, data.A_exact)
        except ValueError as refusal:
            return np.nan, [f"{type(refusal).__name__}: {refusal}"]
    return e, [str(w.message) for w in caught if w.category.__name__ in TOLD]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", nargs="+", default=["default", "sliding"], choices=["default", "sliding"]
    )
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    counts = {}
    for (way, kind), published in PUBLISHED.items():
        if way not in given.only:
            continue
        rng = np.random.default_rng(given.seed)
        for words, options, harmonics, noise in perturbations(rng):
            e, said = cell(way, kind, options, harmonics, noise, rng)
            verdict = "good" if e <= WITHIN * published else "told" if said else "SILENT"
            counts[way, verdict] = counts.get((way, verdict), 0) + 1
            row = f"{way:8s} {kind:10s} {words:20s} {verdict:6s} e {e:9.3g} %"
            print(f"{row}, {e / published:8.3g} times  {' | '.join(said)[:110]}", flush=True)
    for (way, verdict), count in sorted(counts.items()):
        print(f"{way}: {verdict} {count}")
