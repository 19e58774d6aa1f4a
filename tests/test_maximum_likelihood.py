"""StructuredMatcher(criterion="output_error") with time-invariant structures."""

import re
import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import heave_pipeline
from periodic_cases import mathieu, record, synchronous
from sklearn.exceptions import ConvergenceWarning
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.lti.simulation import simulate
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning

LAG = MatrixStructure([["-a"]], [["b"]])
TRUE_LAG = {"a": -np.log(0.8), "b": -np.log(0.8) / 0.2}  # of y[k+1] = 0.8 y + u


def lag_record(seed, noise=0.1, n_samples=400, pole=0.8):
    rng = np.random.default_rng(seed)
    u, y = rng.standard_normal((n_samples, 1)), np.zeros((n_samples, 1))
    for k in range(n_samples - 1):
        y[k + 1] = pole * y[k] + u[k]
    return u, y + noise * rng.standard_normal(y.shape)


def matched_lag(u, y, **options):
    options = {"structure": LAG, "criterion": "output_error"} | options
    return StructuredMatcher(
        MOESPRegressor(order=1, feedthrough=False, block_rows=5), **options
    ).fit(u, y)


@pytest.mark.parametrize("seed", range(3))
def test_plain_data(seed):
    match = matched_lag(*lag_record(seed))
    z = (match.theta_ - pd.Series(TRUE_LAG)) / match.theta_std_
    assert z.abs().max() < 3.5
    assert match.noise_std_.iloc[0] == pytest.approx(0.1, rel=0.15)
    found = match.eigenvalues_.iloc[0]
    assert found["eigenvalue"] == pytest.approx(-match.theta_["a"])
    assert found["std_real"] == pytest.approx(match.theta_std_["a"], rel=1e-6)
    assert found["std_imag"] == 0.0
    assert match.system_.A[0, 0] == -match.theta_["a"]


def test_the_static_gain_and_its_deviation():
    """b / a, its slope known."""
    match = matched_lag(*lag_record(0))
    (response,), (std,) = match.frequency_response([0.0])
    a, b = match.theta_
    slope = np.array([-b / a**2, 1 / a])
    assert response[0, 0] == pytest.approx(b / a)
    assert std[0, 0].real == pytest.approx(np.sqrt(slope @ match.covariance_ @ slope), rel=1e-9)


def test_without_noise_the_truth_comes_back():
    match = matched_lag(*lag_record(0, noise=0.0))
    np.testing.assert_allclose(match.theta_, pd.Series(TRUE_LAG), rtol=1e-10)


def test_units_of_the_output_scale_gain_and_deviation():
    u, y = lag_record(0)
    one, other = matched_lag(u, y), matched_lag(u, 1e6 * y)
    units = np.array([1.0, 1e6])
    np.testing.assert_allclose(other.theta_, one.theta_ * units, rtol=1e-6)
    np.testing.assert_allclose(other.theta_std_, one.theta_std_ * units, rtol=1e-5)


@pytest.mark.slow
def test_intervals_of_plain_data_hold_the_truth_as_often_as_they_say():
    inside = []
    for seed in range(200):
        interval, true = matched_lag(*lag_record(seed)).confidence_interval(), pd.Series(TRUE_LAG)
        inside.append((interval["lower"] < true) & (true < interval["upper"]))
    assert 0.92 < np.mean(inside) < 0.98


def free_heave(names):
    return MatrixStructure(pd.DataFrame(np.nan, names, names), pd.DataFrame(np.nan, names, ["U_0"]))


@pytest.mark.slow
def test_harmonics_of_a_sliding_analyzer():
    """Refined on the signals themselves: no analyzer bias. The reducer, whose modes are of largest
    likelihood, has left the matcher a tenth of a standard deviation to gain."""
    data = make_flapping_wing("lti-signal", n_periods=120, start=10, snr=100, random_state=0)
    names, found = list(data.A_exact.columns), []
    exact = data.A_exact.to_numpy()
    for criterion in ("hinf", "output_error"):
        matcher = StructuredMatcher(structure=free_heave(names), criterion=criterion)
        steps = heave_pipeline(data.omega, n_states=3).steps
        pipe = Pipeline([*steps, ("match", matcher)])
        pipe["identify"].set_params(order=12)
        match = pipe.fit(data.inputs, data.outputs)["match"]
        found.append(match.theta_.to_numpy()[:9])
    std = match.theta_std_.to_numpy()[:9]
    assert np.linalg.norm(found[1] - exact.ravel()) < 0.01 * np.linalg.norm(exact)
    assert np.abs((found[1] - found[0]) / std).max() < 0.1
    assert np.abs((found[1] - exact.ravel()) / std).max() < 4.5
    assert match.system_.state_labels == names


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_a_matrix_structure_period_by_period():
    """Three harmonics fit the signals of the periodic system best 9 % away from its own."""
    data = make_flapping_wing("ltp", n_periods=60, start=5, snr=100, random_state=1)
    pipe = synchronous(
        data.omega,
        free_heave(list(data.A_exact.columns)),
        order=2,
        harmonics={"w": [0], "phi_dot": [1]},
        criterion="output_error",
    )
    with pytest.warns(IdentifiabilityWarning, match="residuals of the fit are not white noise"):
        match = pipe.fit(data.inputs, data.outputs)["match"]
    assert match.covariance_type_ == "robust"  # what three harmonics leave out is no noise
    assert np.isfinite(match.theta_std_).all()
    assert np.isnan(match.hinf_error_)
    assert pipe.score(data.inputs, data.outputs) > 0.995


def test_records_of_two_machines_disagree():
    """They are told, and the interval is widened until it holds both."""
    exponents, told = [], []
    for pole in (0.8, 0.78):
        pairs = zip(lag_record(0), lag_record(1, pole=pole), strict=True)
        time = pd.Index(0.1 * np.arange(400), name="time")
        u, y = (
            pd.concat([pd.DataFrame(each, time) for each in pair], keys=[1, 2], names=["record"])
            for pair in pairs
        )
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            match = matched_lag(u, y)
        told.append(" ".join(str(each.message) for each in said))
        exponents.append(match.eigenvalues_.iloc[0].to_numpy().real)
    assert told[0] == ""
    assert "from the first record to the last" in told[1]
    (_, alike, _), (value, std, _) = exponents
    assert alike < 0.02
    for pole in (0.8, 0.78):
        assert abs(np.log(pole) / 0.1 - value) < 1.96 * std


def test_parameters_that_the_record_leaves_open_are_infinite():
    """A factor of the input matrix beside a factor of the output matrix."""
    structure = MatrixStructure([["-a"]], [["b"]], [["c"]])
    with pytest.warns(IdentifiabilityWarning) as caught:
        match = matched_lag(*lag_record(0), structure=structure)
    assert "does not determine b, c" in str(caught[-1].message)
    assert "standard deviation is infinite" in str(caught[-1].message)
    assert np.isinf(match.theta_std_[["b", "c"]]).all()
    assert np.isfinite(match.theta_std_["a"])
    assert match.confidence_interval().loc["b"].tolist() == [-np.inf, np.inf]


@pytest.mark.slow
def test_a_search_cut_short_is_said_where_it_matters():
    """Where another step moves an exponent by more than its standard deviation."""
    for noise, structure in ((0.6, HarmonicStructure()), (0.3, HarmonicStructure(F=1, G=0))):
        u, y = record(mathieu(), noise=noise, n_periods=30)
        pipe = synchronous(2.0, structure, order=2, criterion="output_error", max_iter=1)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pipe.fit(u, y)
        said = [str(w.message) for w in caught if issubclass(w.category, ConvergenceWarning)]
        if noise == 0.3:
            assert not said
            continue
        assert re.search(r"stopped after 1 iterations; .* raise max_iter", said[0])
        steps = float(re.search(r"([\d.e+]+) of its standard deviations", said[0])[1])
        assert steps > 1.0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the record lasts")
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_a_harmonic_structure_on_a_sliding_analyzer_is_refined():
    """From the decomposition with eight numbers in A to all coefficients of F that show."""
    data = make_flapping_wing("lti-signal", n_periods=120, start=10)
    steps = heave_pipeline(data.omega, n_states=3).steps
    structure = HarmonicStructure(F=1, G={"1c": [[0.0], ["gain"]]})
    matcher = StructuredMatcher(structure=structure, criterion="output_error")
    with pytest.warns(IdentifiabilityWarning, match="not white noise"):  # F has more harmonics
        match = Pipeline([*steps, ("match", matcher)]).fit(data.inputs, data.outputs)["match"]
    assert match.ltp_.state_names == ("w", "phi_dot")
    assert np.isfinite(match.noise_std_).all()


# ---- noise on the inputs -------------------------------------------------------------------------


def noisy_inputs(seed):
    """The wing, noise of 1/20 on everything, and that of the input."""
    data = make_flapping_wing(
        "ltp", n_periods=60, start=5, snr=20, noise_on="both", random_state=seed
    )
    return data, float(data.inputs_clean.std().iloc[0]) / 20


@pytest.mark.filterwarnings("ignore:the record lasts")
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")  # the fast one, to 10 %
@pytest.mark.slow
def test_noise_on_the_inputs_is_allowed_for_or_shown():
    """Ignored, it colours what is left: deviations are those of blocks of the record."""
    data, sigma = noisy_inputs(0)
    std = {}
    for allowed in (False, True):
        structure = HarmonicStructure(F=4, G=1)
        pipe = synchronous(
            data.omega,
            structure,
            harmonics={"w": [0], "phi_dot": [1]},
            criterion="output_error",
            input_noise={"U": sigma} if allowed else None,
        )
        pipe.fit(data.inputs, data.outputs)
        std[allowed] = pipe["match"].theta_std_
        assert pipe["match"].covariance_type_ == ("information" if allowed else "robust")
        assert allowed or not pipe["match"].residual_tests_["passed"].all()
        true = data.outputs_clean.std() / 20
        assert (abs(pipe["match"].noise_std_ / true - 1) < 0.05).all()
    ratio = std[True] / std[False]
    assert ratio.between(0.5, 3.0).all()


WRONG_NOISE = [
    ({"V": 1.0}, r"input_noise={'V': 1.0} must give a standard deviation for each .* \['x0'\]"),
    ({"x0": 1.0, "V": 1.0}, r"must give a standard deviation for each of the inputs \['x0'\]"),
    (-1.0, r"input_noise must be a positive number in units of the input, got -1.0"),
    ("much", "input_noise must be a positive number in units of the input, got 'much'"),
]


@pytest.mark.parametrize(("noise", "message"), WRONG_NOISE)
def test_wrong_noise_on_the_inputs(noise, message):
    with pytest.raises(ValueError, match=message):
        matched_lag(*lag_record(0), input_noise=noise)


def test_noise_on_the_inputs_is_for_maximum_likelihood():
    with pytest.raises(ValueError, match=r"input_noise=0.1 needs maximum likelihood"):
        matched_lag(*lag_record(0), criterion="hinf", input_noise=0.1)


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_noise_on_harmonics_of_the_inputs_is_not_that_of_the_inputs():
    data, sigma = noisy_inputs(0)
    structure = MatrixStructure(np.full((3, 3), np.nan), np.full((3, 3), np.nan))
    matcher = StructuredMatcher(structure=structure, criterion="output_error", input_noise=sigma)
    pipe = Pipeline([*heave_pipeline(data.omega).steps, ("match", matcher)])
    with pytest.raises(ValueError, match="this model is driven by their harmonics"):
        pipe.set_params(harmonics__input_harmonics=1).fit(data.inputs, data.outputs)


@pytest.mark.parametrize(
    "criterion", [pytest.param("output_error", marks=pytest.mark.slow), "prediction_error"]
)
def test_all_entries_are_free_behind_a_reducer_too(criterion):
    rng = np.random.default_rng(2)
    u = pd.DataFrame({"u": np.repeat(rng.choice([-1.0, 1.0], 100), 10)}, 0.05 * np.arange(1000))
    A, B = np.array([[0.9, 0.2], [-0.2, 0.9]]), np.array([[0.0], [0.1]])
    y = simulate(A, B, np.eye(2)[:1], np.zeros((1, 1)), u.to_numpy(), np.zeros(2))
    y = pd.DataFrame(y + 0.01 * rng.standard_normal(y.shape), u.index, ["y"])
    behind, direct = (
        Pipeline([("identify", MOESPRegressor(order=2)), ("reduce", reduce), ("match", match)]).fit(
            u, y
        )
        for reduce in (SpuriousModeReducer(), "passthrough")
        for match in [StructuredMatcher(criterion=criterion)]
    )
    found, expected = (pipe["match"].eigenvalues_["eigenvalue"] for pipe in (behind, direct))
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(expected), rtol=1e-4)
    assert behind["match"].system_.dt == pytest.approx(0.05)
