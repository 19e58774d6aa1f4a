"""The paper's Table 1 by the pipeline of ``examples/reproduce_paper.py``: what it must reach."""

import importlib
import re
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from sklearn_hd.datasets import make_flapping_wing

ROOT = Path(__file__).parent.parent
EXAMPLES, PAGE = ROOT / "examples", (ROOT / "docs" / "reproduce_paper.md").read_text("utf-8")
sys.path.insert(0, str(EXAMPLES))
paper = importlib.import_module("reproduce_paper")
cases = importlib.import_module("_paper_cases")
bounds = importlib.import_module("_paper_bound")
bound_percent = bounds.bound_percent
sys.path.remove(str(EXAMPLES))

run = lru_cache(maxsize=None)(paper.run)


@pytest.fixture(autouse=True)
def one_thread():
    """As the script itself does: the matrices are small, threads only cost."""
    with threadpool_limits(limits=1):
        yield


def published(route, data, doublet):
    """e in percent as docs/reproduce_paper.md has it: guards and page cannot drift apart."""
    first, second = PAGE.split("## The second route")
    rows = re.findall(r"^\| (.+?) \| (.+?) \| (\S+) \|", first if route == 1 else second, re.M)
    (figure,) = (float(e) for name, size, e in rows if (name, size) == (data, doublet))
    return figure


@pytest.mark.parametrize(
    ("case", "row"),
    [
        (cases.LTI_SIGNAL, (1, "LTI signal + analyzer", "2 %")),
        (cases.FLAP, (1, "flap subsystem (LTI signal)", "2 % in $U_{1c}$")),
        (cases.LTP, (1, "LTP, three modes kept", "2 %")),
        (cases.RESIDUALIZED[0], (1, "LTP, three modes, others residualized", "2 %")),
        (cases.NLTP, (1, "NLTP, three modes kept", "2 %")),
        (cases.NLTP_SMALL, (1, "NLTP, three modes kept", "0.5 %")),
        (cases.RESIDUALIZED[1], (1, "NLTP, three modes, others residualized", "2 %")),
        (cases.SYNC_LTP, (2, "LTP", "2 %")),
        (cases.SYNC_NLTP, (2, "NLTP", "2 %")),
        (replace(cases.SYNC_NLTP, amplitude=0.005), (2, "NLTP", "0.5 %")),
        (cases.SYNC_PAIR, (2, "NLTP, pair of records", "± 2 %")),
        (replace(cases.SYNC_PAIR, amplitude=0.005), (2, "NLTP, pair of records", "± 0.5 %")),
    ],
    ids=lambda value: " ".join(map(str, value[1:])) if isinstance(value, tuple) else "",
)
@pytest.mark.slow
def test_rows_without_noise_stay_within_twice_their_figure(case, row):
    found = run(case)
    assert found.e_percent <= 2.0 * published(*row)
    if case.route == "synchronous":
        assert found.model["identify"].order_ == 2
    else:
        assert found.model["reduce"].n_states_ == 3


def test_perfect_coefficients_leave_rounding_alone():
    """Processors differ by twice already: ten times the figure."""
    found = run(cases.LTI)
    assert found.e_percent <= 10.0 * published(1, "LTI", "2 %")
    assert found.model["reduce"].n_states_ == 3


def test_rows_read_twice_as_often_change_nothing():
    twice = run(replace(cases.LTI_SIGNAL, rows_per_period=8))
    assert twice.e_percent <= 4.0 * published(1, "LTI signal + analyzer", "2 %")
    assert twice.model["reduce"].n_states_ == 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "way"),
    [
        (cases.LTI_SIGNAL, "modes"),
        (cases.LTP, "three modes kept"),
        (cases.NLTP, "three modes kept"),
        (cases.RESIDUALIZED[0], "three modes, others residualized"),
        (cases.SYNC_LTP, "period by period"),
    ],
    ids=lambda value: value.data if isinstance(value, cases.Case) else value,
)
def test_rows_say_where_their_matrix_comes_from(case, way):
    assert run(case).way == way
    assert paper.table_row([run(case)], seconds=0.0)["way"] == way


@pytest.mark.slow
@pytest.mark.parametrize("case", [cases.LTP, cases.NLTP], ids=["ltp", "nltp"])
def test_the_papers_own_way_keeps_modes_that_were_identified(case):
    own = run(case).model
    identified = own["reduce"].modes_["eigenvalue"].to_numpy()
    for pole in own["reduce"].system_.poles():
        assert np.min(np.abs(identified - pole)) <= 1e-6 * abs(pole)


@pytest.mark.slow
def test_a_feedthrough_that_the_form_has_not_is_warned_of():
    assert any("the feedthrough of the model" in text for text in run(cases.RESIDUALIZED[0]).warned)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "n_seeds", "row"),
    [
        (cases.LTI_NOISE, 3, (1, "LTI + noise, rms", "2 %")),
        (cases.LTI_SIGNAL_NOISE, 3, (1, "LTI signal + analyzer + noise, rms", "2 %")),
        (cases.LTP_NOISE, 1, (1, "LTP + noise, three modes kept, rms", "2 %")),
        (cases.SYNC_LTP_NOISE, 3, (2, "LTP + noise, rms of 20", "2 %")),
    ],
    ids=["lti", "lti-signal", "ltp", "synchronous ltp"],
)
def test_the_first_noisy_records_stay_within_twice_the_rms_of_twenty(case, n_seeds, row):
    seeds = range(paper.FIRST_SEED, paper.FIRST_SEED + n_seeds)
    assert paper.rms([run(case, seed).e_percent for seed in seeds]) <= 2.0 * published(*row)


@pytest.mark.slow
def test_noise_on_the_synchronous_route_costs_little_more_than_it_must():
    runs = [run(cases.SYNC_LTP_NOISE, paper.FIRST_SEED + seed) for seed in range(3)]
    row = paper.noise_row(runs, "outputs")
    # 1.08 % of noise and 0.93 % of the harmonics left out: 1.43 % rms; three seeds spread
    assert row["bound_percent"] == pytest.approx(1.08, abs=0.01)
    assert row["rms_e_percent"] <= 2.5


@pytest.mark.slow
def test_nonlinear_data_at_two_percent_beat_the_paper():
    assert run(cases.NLTP).e_percent < run(cases.NLTP).case.paper_percent


@pytest.mark.slow
def test_both_subsystems_give_the_six_by_six_matrix():
    row = paper.full_row(run(cases.LTI_SIGNAL), run(cases.FLAP), seconds=0.0)
    assert row["e_percent"] <= 2.0 * published(1, "full 6 × 6 (LTI signals)", "2 %")
    assert row["states_kept"] == 6


def test_input_matrices_come_from_the_raw_record():
    for case, states in ((cases.LTI_SIGNAL, 1), (cases.FLAP, 0)):
        found = run(case)
        expected = np.zeros(3)
        expected[states] = found.data.B_exact.to_numpy()[states, 0]
        np.testing.assert_allclose(found.matched.B[:, 0], expected, atol=1e-8 * expected.max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [cases.LTP, cases.NLTP, cases.NLTP_SMALL], ids=["ltp", "nltp 2 %", "nltp 0.5 %"]
)
def test_prediction_of_a_doublet_not_used_for_identification(case):
    """R² of 0.9994 and 0.9975 (docs/reproduce_paper.md): at most twice as much unexplained."""
    r2 = paper.validate(run(case))[3]
    assert set(r2) == {"w", "phi_dot"}
    assert 1.0 - r2["w"] <= 2.0 * 0.0006
    assert 1.0 - r2["phi_dot"] <= 2.0 * 0.0024


@pytest.mark.parametrize(
    ("case", "order"), [(cases.LTI, 3), (cases.LTI_SIGNAL, 10), (cases.LTP, 16)]
)
@pytest.mark.slow
def test_order_is_the_rank_that_the_window_gives(case, order):
    # LTI coefficients have the subsystem's own order; 10 and 16 are the exact ranks of the
    # windowed records at 4 and 8 rows a period, copies and window memory included
    assert run(case).model["identify"].order_ == order


@pytest.mark.parametrize(
    ("kind", "free_inputs", "expected"),
    [("lti", 1, 0.85), ("lti", 3, 1.01), ("lti-signal", 1, 1.73), ("lti-signal", 3, 3.96)],
)
def test_cramer_rao_bound_agrees_with_an_independent_programme(kind, free_inputs, expected):
    # computed beforehand by finite differences for this record of 60 periods, noise 1/20
    data = make_flapping_wing(kind, n_periods=60, start=5)
    assert bound_percent(data, 20.0, free_inputs) == pytest.approx(expected, abs=0.005)


@pytest.mark.slow
def test_noise_on_coefficients_costs_what_it_must():
    runs = [run(cases.LTI_NOISE, paper.FIRST_SEED + seed) for seed in range(8)]
    row = paper.noise_row(runs, "outputs")
    assert 0.7 <= row["rms_over_bound"] <= 1.5


def test_warnings_of_other_packages_pass_through_the_fit():
    class Noisy:
        def fit(self, X, y):
            np.log(np.zeros(1))

    with pytest.raises(RuntimeWarning, match="divide by zero"):
        paper.fit(Noisy(), None, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "noise_on", "published_rms"),
    [
        (cases.LTI_NOISE, "outputs", 0.47),
        (cases.LTI_NOISE, "both", 1.04),
        (cases.LTI_SIGNAL_NOISE, "outputs", 1.56),
        (cases.LTI_SIGNAL_NOISE, "both", 15.2),
        (cases.LTP_NOISE, "outputs", 18.2),
        (cases.LTP_NOISE, "both", 15.6),
    ],
)
def test_noise_rows_over_ten_seeds(case, noise_on, published_rms):
    # twice the rms of docs/reproduce_paper.md
    runs = paper.run_noisy(case, 10, noise_on)
    row = paper.noise_row(runs, noise_on)
    assert row["rms_e_percent"] <= 2.0 * published_rms
    # ten seeds spread by a quarter about the bound, which is the three-state model's for LTP too
    assert row["rms_over_bound"] >= 0.6
    # more are kept where no three explain half of what all modes do: a rare record
    assert np.mean([r.model["reduce"].n_states_ == 3 for r in runs]) >= 0.9
