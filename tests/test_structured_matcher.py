"""StructuredMatcher in a norm: criteria, weights, bounds, and what it reports."""

import pickle
import warnings
from types import SimpleNamespace

import control
import numpy as np
import pandas as pd
import pytest
from periodic_cases import mathieu, synchronous
from periodic_cases import record as oscillator_record
from scipy import linalg, signal
from sklearn.base import clone
from sklearn.exceptions import ConvergenceWarning
from sklearn.frozen import FrozenEstimator

from sklearn_hd import MatrixStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd._match.affine import warn_matched
from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.algorithms.matching.matching_problem import channel_scales, matching_grid
from sklearn_hd.exceptions import IdentifiabilityWarning

NAN = np.nan
SAMPLE_TIME = 0.02
A = np.array([[-0.3, 2.0, 0.1], [-2.0, -0.2, 0.4], [0.3, 0.2, -6.0]])
B = np.array([[1.0, 0.2], [0.4, -1.0], [3.0, 2.0]])
C = np.array([[1.0, 0.0, 0.4], [0.2, 1.0, -0.3]])
INITIAL = {"a": 0.3, "w": 2.0, "b": 0.2, "g": 0.2, "h": 0.4}
CELLS = [[["-a", "w"], ["-w", "-b"]], [[1.0, "g"], ["h", -1.0]]]
STRUCTURE = MatrixStructure(*CELLS, initial=INITIAL)


@pytest.fixture(scope="module")
def record():
    """Inputs held from sample to sample, outputs of three states without noise."""
    random = np.random.default_rng(0)
    time = SAMPLE_TIME * np.arange(2000)
    u = pd.DataFrame(random.standard_normal((2000, 2)), time, ["left", "right"])
    discrete = signal.cont2discrete((A, B, C, np.zeros((2, 2))), SAMPLE_TIME)[:4]
    _, y, _ = signal.dlsim((*discrete, SAMPLE_TIME), u.to_numpy())
    return u, pd.DataFrame(y, time, ["x", "v"])


@pytest.fixture(scope="module")
def identified(record):
    return FrozenEstimator(MOESPRegressor(order=3, block_rows=8).fit(*record))


@pytest.fixture(scope="module")
def fed_through(record):
    """A model with a feedthrough, which the structure has not, and its record."""
    u, y = record
    y = y + 5.0 * u.to_numpy()
    model = MOESPRegressor(order=3, block_rows=8, feedthrough=True).fit(u, y)
    return FrozenEstimator(model), (u, y)


def match(identified, record, structure=STRUCTURE, **options):
    matcher = StructuredMatcher(identified, structure=structure, **options)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the model has 3 states, the structure has 2")
        return matcher.fit(*record)


def gap(matcher, frequencies):
    """G_c − G_s at some frequencies."""
    system, s = matcher.system_, 1j * np.atleast_1d(frequencies)
    found = frequency_response(system.A, system.B, system.C, system.D, s)
    return frequency_response(A, B, C, np.zeros((2, 2)), s) - found


@pytest.mark.parametrize("criterion", ["hinf", "least_squares"])
def test_what_a_match_reports(identified, record, criterion):
    matcher = match(identified, record, criterion=criterion)
    frequencies = np.concatenate([[0.0], np.geomspace(1e-3, 1e3, 20_000)])
    grid = matching_grid(linalg.eigvals(A))
    s = 1j * grid[np.isfinite(grid)]
    outputs, inputs = channel_scales(frequency_response(A, B, C, np.zeros((2, 2)), s))
    scales = outputs[:, None] * inputs
    largest = np.linalg.norm(scales * gap(matcher, frequencies), 2, axis=(1, 2)).max()
    assert matcher.hinf_error_ == pytest.approx(largest, rel=1e-6)
    top = linalg.norm(scales * gap(matcher, matcher.peak_frequency_)[0], 2)
    assert top == pytest.approx(largest, rel=1e-6)
    assert matcher.optimality_ < 1e-3
    assert matcher.rank_ == len(matcher.sensitivity_) == 5
    history = matcher.history_
    assert list(history.columns) == ["stage", "error"]
    assert history.index.name == "iteration"
    assert len(history) > 2
    peaks = matcher.peaks_
    assert list(peaks.columns) == ["frequency", "error", "weight"]
    if criterion == "hinf":
        np.testing.assert_allclose(peaks.error, matcher.hinf_error_relative_, rtol=1e-3)
        assert peaks.weight.sum() == pytest.approx(1.0)
        assert history.error.iloc[-1] == pytest.approx(matcher.hinf_error_relative_)
    else:
        assert peaks.empty


@pytest.mark.slow
def test_each_criterion_is_best_in_its_own_norm(identified, record):
    found = {c: match(identified, record, criterion=c) for c in ("hinf", "least_squares")}
    assert min(found, key=lambda c: found[c].hinf_error_) == "hinf"
    pd.testing.assert_series_equal(
        found["least_squares"].theta_, found["hinf"].theta_least_squares_, check_names=False
    )


@pytest.mark.parametrize("criterion", ["hinf", "least_squares"])
@pytest.mark.parametrize(
    "weight", [{"v": 50.0}, [1.0, 50.0], pd.Series({"v": 50.0, "x": 1.0})], ids=type
)
@pytest.mark.slow
def test_a_channel_that_weighs_more_is_matched_better(identified, record, weight, criterion):
    frequencies = np.geomspace(1e-2, 1e2, 500)
    errors = {}
    for name, weights in {"plain": None, "weighed": weight}.items():
        matcher = match(identified, record, output_weights=weights, criterion=criterion)
        errors[name] = np.abs(gap(matcher, frequencies)).max(axis=(0, 2))
    assert errors["weighed"][1] < errors["plain"][1]
    assert errors["weighed"][0] > errors["plain"][0]


@pytest.mark.slow
def test_one_number_for_all_channels_changes_no_parameter(identified, record):
    plain = match(identified, record)
    weighed = match(identified, record, output_weights=7.0, input_weights=0.1)
    np.testing.assert_allclose(weighed.theta_, plain.theta_, rtol=1e-4)
    assert weighed.hinf_error_ == pytest.approx(0.7 * plain.hinf_error_, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"output_weights": {"z": 1.0}},
            r"output_weights names \['z'\], but the model has the chann",
        ),
        ({"output_weights": [1.0]}, r"output_weights=\[1.0\] is not understood for \['x', 'v'\]"),
        ({"output_weights": "x"}, "output_weights='x' is not understood"),
        ({"input_weights": -1.0}, "weights must be positive and finite; give a positive number"),
        ({"input_weights": {"left": "a"}}, r"input_weights\['left'\]='a' is not understood"),
        ({"output_weights": control.tf([1], [1, 1])}, "is not understood"),
        ({"output_weights": (1.0, 2.0, 3.0, 4.0)}, r"is not understood for \['x', 'v'\]"),
        ({"output_weights": 2.0, "criterion": "output_error"}, "weights each output by its noise"),
        ({"criterion": "H_2"}, "criterion='H_2'"),
        ({"criterion": "h2"}, "criterion='h2'"),
    ],
)
def test_settings_that_cannot_be_read_are_refused(identified, record, options, message):
    with pytest.raises(ValueError, match=message):
        match(identified, record, **options)


@pytest.mark.slow
def test_bounds_of_the_structure_are_kept(identified, record):
    free = match(identified, record)
    limit = round(float(free.theta_["w"]) - 0.1, 3)
    start = {**INITIAL, "w": limit}
    for criterion in ("hinf", "least_squares", "output_error"):
        bounded = MatrixStructure(*CELLS, initial=start, bounds={"w": (None, limit)})
        with warnings.catch_warnings():  # the truth lies beyond the bound: noise is not white
            warnings.simplefilter("ignore", IdentifiabilityWarning)
            held = match(identified, record, bounded, criterion=criterion)
            fixed = match(identified, record, STRUCTURE.fix({"w": limit}), criterion=criterion)
        assert held.theta_["w"] == pytest.approx(limit, abs=1e-9)
        np.testing.assert_allclose(held.theta_.drop("w"), fixed.theta_, atol=2e-3)


def test_a_structure_without_parameters_is_refused(identified, record):
    structure = STRUCTURE.fix(INITIAL)
    with pytest.raises(ValueError, match="no free parameter, so there is nothing to match"):
        match(identified, record, structure)


@pytest.mark.slow
def test_feedthrough_that_decides_the_error_is_named(fed_through):
    model, (u, y) = fed_through
    with warnings.catch_warnings():
        # the best parameters lie at infinity: how far the search gets hangs on rounding
        warnings.simplefilter("ignore", ConvergenceWarning)
        warnings.filterwarnings("ignore", message="the match has a pole of")
        with pytest.warns(IdentifiabilityWarning, match="fixed entries of D leave"):
            match(model, (u, y))


def test_a_pole_on_its_way_to_infinity_is_named():
    affine = MatrixStructure([["-a"]], [["b"]]).affine
    found = {"theta": np.array([1e6, 1.0]), "relative_error": 0.3, "hinf_error": 0.3}
    found |= {"exact": False, "converged": True, "unidentified": (), "feedthrough_floor": 0.0}
    with pytest.warns(
        IdentifiabilityWarning, match="times the fastest pole of the model: the best"
    ):
        warn_matched(SimpleNamespace(**found), "hinf", np.array([-1.0]), affine)


@pytest.mark.slow
def test_a_fast_pole_that_is_known_is_no_runaway(identified, record):
    A, B = CELLS
    cells = [[*A[0], 0.0], [*A[1], 0.0], [0.0, 0.0, -1e6]], [*B, [1.0, 1.0]]
    structure = MatrixStructure(*cells, [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]], initial=INITIAL)
    matcher = match(identified, record, structure)  # warnings are errors here
    assert np.abs(linalg.eigvals(matcher.system_.A)).max() == pytest.approx(1e6)


def test_a_search_cut_short_says_by_how_much(identified, record):
    said = r"the H-infinity match stopped after \d+ steps at a relative error of .*, which could "
    with pytest.warns(
        ConvergenceWarning, match=said + r"still fall by a share of .* \(2e-05 counts as converged"
    ):
        match(identified, record, n_starts=0, max_iter=3)


def test_a_fitted_match_can_be_pickled_and_cloned(identified, record):
    weights = {"x": 2.0}
    matcher = match(identified, record, output_weights=weights)
    again = pickle.loads(pickle.dumps(matcher))
    pd.testing.assert_frame_equal(again.peaks_, matcher.peaks_)
    pd.testing.assert_frame_equal(again.history_, matcher.history_)
    assert clone(matcher).output_weights.keys() == weights.keys()


def test_structure_none_reports_nothing_in_a_norm(identified, record):
    matcher = match(identified, record, None)
    assert np.isnan(matcher.hinf_error_)
    assert matcher.history_.empty
    assert matcher.peaks_.empty
    with pytest.raises(AttributeError, match="rank_ exists only after a match in a norm"):
        _ = matcher.rank_


def test_weights_have_no_part_in_the_closed_form():
    system = mathieu()
    pipe = synchronous(system.omega, output_weights=2.0)
    with pytest.raises(ValueError, match="in closed form, which uses no weights; leave"):
        pipe.fit(*oscillator_record(system))
