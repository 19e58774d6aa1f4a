"""The rows of ``reproduce_paper.py``: which data, and the pipeline that identifies them."""

from dataclasses import dataclass, replace

import numpy as np
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing

SAMPLES_PER_PERIOD = 64
SNR = 20.0  # ratio of standard deviations; the paper prints "20" without saying of what
DOUBLET = {"start": 132, "width": 10, "n_periods": 220}  # 132 periods are the paper's 5 s
SYNCHRONOUS = {"start": 5, "width": 10, "n_periods": 60}  # of the second route
VALIDATION = {"start": 30, "width": 6, "n_periods": 80, "amplitude": -0.015}

# what is kept of the outputs, in the order that makes the coefficients those of Eq. 26
STATES = {"heave": ["w_0", "phi_dot_1c", "phi_dot_1s"], "flap": ["phi_dot_0", "w_1c", "w_1s"]}
SIGNALS = {"heave": {"w": [0], "phi_dot": [1]}, "flap": {"phi_dot": [0], "w": [1]}}
DRIVEN_BY = {"heave": {"U": [0]}, "flap": {"U": [1]}}
N_INPUTS = {"heave": 1, "flap": 2}  # U_0; U_1c and U_1s


@dataclass(frozen=True)
class Case:
    """One row: which data, how often a period they are read, and what the paper printed."""

    kind: str
    rows_per_period: int = 8
    noise: bool = False
    amplitude: float = 0.02
    subsystem: str = "heave"
    paper_percent: float = np.nan
    paper_gap: int | None = None
    route: str = "paper"
    pair: bool = False  # two records, up first and down first: their odd part
    n_states: int | None = None  # modes kept of those identified; None lets the data decide
    method: str = "truncate"  # what becomes of the other modes
    input_noise: bool = False  # whether the noise on the input, if there is any, is allowed for

    @property
    def data(self):
        return self.kind + " pair" * self.pair + "+noise" * self.noise


LTI = Case("lti", paper_percent=9.0843e-7, paper_gap=3)
LTI_NOISE = Case("lti", noise=True, paper_percent=0.0767, paper_gap=3)
LTI_SIGNAL = Case("lti-signal", 4, paper_percent=0.0026, paper_gap=11)
LTI_SIGNAL_NOISE = Case("lti-signal", 4, noise=True)
# the paper's own way: three of the modes identified; the others dropped, or made static
LTP = Case("ltp", paper_percent=0.328, paper_gap=7, n_states=3)
LTP_NOISE = replace(LTP, noise=True, paper_percent=0.4514)
NLTP = Case("nltp", paper_percent=4.1337, paper_gap=9, n_states=3)
NLTP_SMALL = replace(NLTP, amplitude=0.005)
FLAP = Case("lti-signal", 4, subsystem="flap")
RESIDUALIZED = [replace(case, method="both") for case in (LTP, NLTP)]
SYNC_LTP = replace(LTP, route="synchronous", n_states=None)
SYNC_LTP_NOISE = replace(LTP_NOISE, route="synchronous", n_states=None)
SYNC_NLTP = replace(NLTP, route="synchronous", n_states=None)
SYNC_PAIR = replace(SYNC_NLTP, pair=True)
CASES = [
    *(LTI, LTI_NOISE, LTI_SIGNAL, LTI_SIGNAL_NOISE, LTP, LTP_NOISE, NLTP, NLTP_SMALL, FLAP),
    *RESIDUALIZED,
    SYNC_LTP,
    SYNC_LTP_NOISE,
    SYNC_NLTP,
    replace(SYNC_NLTP, amplitude=0.005),
    SYNC_PAIR,
    replace(SYNC_PAIR, amplitude=0.005),
]


def simulate(case, seed=None, noise_on="outputs", **kwargs):
    """A record of the case, by default the response to the doublet."""
    record = SYNCHRONOUS if case.route == "synchronous" else DOUBLET
    amplitude = [case.amplitude, -case.amplitude] if case.pair else case.amplitude
    options = {"amplitude": amplitude, **record, **kwargs}
    return make_flapping_wing(
        case.kind,
        subsystem=case.subsystem,
        samples_per_period=SAMPLES_PER_PERIOD,
        snr=SNR if case.noise else None,
        noise_on=noise_on,
        random_state=seed,
        **options,
    )


def build_pipeline(case, data, order="auto", block_rows=None):
    """The method as one estimator; a perfect analyzer (lti) leaves the first step out."""
    n_inputs = 1 if case.kind == "lti" else N_INPUTS[case.subsystem]
    states = STATES[case.subsystem]
    structure = MatrixStructure(
        np.full((3, 3), np.nan),
        np.full((3, n_inputs), np.nan),
        state_names=states,
        output_names=states,
    )
    analyzer = HarmonicAnalyzer(
        data.omega,
        input_harmonics=DRIVEN_BY[case.subsystem],
        output_harmonics=SIGNALS[case.subsystem],
        hop=SAMPLES_PER_PERIOD // case.rows_per_period,
        trim_span=data.trim_span if case.kind == "nltp" else None,
    )
    steps = [] if case.kind == "lti" else [("harmonics", analyzer)]
    steps += [
        ("identify", MOESPRegressor(order=order, block_rows=block_rows)),
        ("reduce", SpuriousModeReducer(n_states=case.n_states, method=case.method)),
        ("match", StructuredMatcher(structure=structure)),
    ]
    return Pipeline(steps)


def build_synchronous(case, data):
    """The second route: one row a period, the periodic system, its decomposition."""
    input_std = data.inputs_clean.to_numpy().std() / SNR if case.input_noise else None
    return Pipeline(
        [
            (
                "harmonics",
                HarmonicAnalyzer(
                    data.omega,
                    output_harmonics=SIGNALS[case.subsystem],
                    reading="period",
                    trim_span=data.trim_span if case.kind == "nltp" else None,
                    small_signal="odd" if case.pair else None,
                ),
            ),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            (
                "match",
                StructuredMatcher(
                    # under noise it pays to say that the torque U cos ωt is one harmonic
                    structure=HarmonicStructure(G=1 if case.noise else None),
                    criterion="output_error" if case.noise else "hinf",
                    input_noise=input_std,
                ),
            ),
        ]
    )


def measured(case, data):
    """Outputs in the order of the states."""
    return data.outputs if case.kind == "lti" else data.outputs[list(SIGNALS[case.subsystem])]
