"""Is the remainder noise? Right models pass at their rate, wrong ones fail."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from periodic_cases import mathieu, record, synchronous
from plotting_cases import plain_record, sampled, service_record, sliding, wing
from sklearn.exceptions import NotFittedError
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd._residuals import Remainder, Segment
from sklearn_hd.exceptions import IdentifiabilityWarning, UnstableModelError
from sklearn_hd.plotting import ResidualDisplay

A = np.array([[0.7, 0.5, 0.0], [-0.5, 0.7, 0.0], [0.0, 0.0, 0.6]])
B, C, K = (
    np.array([[1.0], [0.5], [1.0]]),
    np.array([[1.0, 1.0, 1.0]]),
    np.array([[0.3], [0.1], [0.2]]),
)


def innovations(seed, *, n=1500, feedthrough=0.0, curved=0.0, noise=0.5, offset=0.0):
    """A third-order record; ``curved`` adds squares of its first state to the output."""
    rng = np.random.default_rng(seed)
    u, e, x = rng.standard_normal((n, 1)), noise * rng.standard_normal(n), np.zeros(3)
    y = np.empty((n, 1))
    for k in range(n):
        y[k] = C @ x + feedthrough * u[k] + curved * x[0] ** 2 + e[k] + offset
        x = A @ x + B @ u[k] + K[:, 0] * e[k]
    return u, y


def predictor(order=3, **options):
    return MOESPRegressor(order, weighting="pbsid", **options)


def in_service(order=2, **options):
    analyzer = HarmonicAnalyzer(2.0, reading="sample", **options)
    return Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(order))])


def table(pipe, u, y, **options):
    return pipe[-1].residual_tests(pipe[:-1].transform(u), y, **options)


def failed(tests):
    return set(tests.index[~tests["passed"]])


@pytest.mark.slow
def test_p_values_of_right_models_are_spread_evenly():
    p = []
    for seed in range(120):
        u, y = innovations(seed, n=1000)
        p.append(predictor().fit(u, y).residual_tests(u, y)["p_value"])
    p = pd.DataFrame(p)
    assert not (p < 0.00025).any(axis=None)
    for name in ("autocorrelation", "inputs", "mean"):
        for level in (0.1, 0.5):
            expected, spread = 120 * level, np.sqrt(120 * level * (1.0 - level))
            assert abs((p[name] < level).sum() - expected) < 3.0 * spread, (name, level)


@pytest.mark.parametrize("seed", range(4))
def test_wrong_models_fail(seed):
    u, y = innovations(seed)
    assert "inputs" in failed(predictor(2).fit(u, y).residual_tests(u, y))
    u, y = innovations(seed, feedthrough=0.3)
    assert "inputs" in failed(predictor(feedthrough=False).fit(u, y).residual_tests(u, y))
    u, y = innovations(seed, curved=0.1)
    assert "nonlinearity" in failed(predictor().fit(u, y).residual_tests(u, y))
    u, y = innovations(seed)
    assert "mean" in failed(predictor().fit(u, y).residual_tests(u, y + 0.2))


def test_simulations_under_process_noise_are_coloured_but_of_the_right_inputs():
    u, y = innovations(0, n=4000)
    model = MOESPRegressor(3).fit(u, y)
    tests = model.residual_tests(u, y)
    assert failed(tests) == {"autocorrelation"}
    u, y = innovations(0, n=4000, feedthrough=0.3)
    tests = MOESPRegressor(3, feedthrough=False).fit(u, y).residual_tests(u, y)
    assert "inputs" in failed(tests)


@pytest.mark.parametrize("change", ["units", "states", "lengths"])
def test_what_does_not_matter(change):
    u, y = innovations(1)
    model = predictor().fit(u, y)
    before = model.residual_tests(u, y)
    if change == "units":
        model, u, y = predictor().fit(1e-3 * u, 1e3 * y), 1e-3 * u, 1e3 * y
    if change == "states":
        T = np.random.default_rng(0).standard_normal((3, 3)) + 2.0 * np.eye(3)
        m, back = model.model_, np.linalg.inv(T)
        turned = {"A": T @ m.A @ back, "B": T @ m.B, "C": m.C @ back}
        model.model_ = replace(m, **turned, kalman_gain=T @ m.kalman_gain)
    if change == "lengths":  # a short record more, which tells little
        index = pd.MultiIndex.from_arrays([[0] * 1490 + [1] * 10, [*range(1490), *range(10)]])
        u, y = (pd.DataFrame(v, index) for v in (u, y))
        model = predictor().fit(u, y)
        assert failed(model.residual_tests(u, y)) == set()
        return
    after = model.residual_tests(u, y)
    assert np.allclose(before["statistic"], after["statistic"], rtol=1e-4)
    assert before["degrees"].equals(after["degrees"])


def test_exact_data_leave_rounding_which_is_not_tested():
    u, y = innovations(2, noise=0.0)
    tests = MOESPRegressor(3).fit(u, y).residual_tests(u, y)
    assert (tests["degrees"] == 0).all()
    assert tests["passed"].all()


def test_lags_and_level():
    u, y = innovations(3)
    model = predictor().fit(u, y)
    few, many = (model.residual_tests(u, y, lags=lags)["degrees"]["inputs"] for lags in (7, 30))
    assert 0 < few <= 7 < many <= 30
    strict = model.residual_tests(u, y, level=0.99)
    assert (strict["passed"] == (strict["p_value"] >= 0.99 / 4)).all()
    assert (strict["level"] == 0.99 / 4).all()  # two tables that differ in passed alone say why


def test_a_matched_model_has_as_many_coefficients_as_were_fitted():
    """Its samples have more harmonics, which left no residuals of a short record to test."""
    u, y = record(mathieu(), n_periods=30, samples=8, noise=0.01)
    pipe = synchronous(2.0, order=2).fit(u, y)
    assert (table(pipe, u, y)["degrees"] > 0).all()


@pytest.mark.slow
def test_models_of_samples_at_their_azimuths():
    u, y = service_record()
    assert failed(table(sampled(), u, y)) == set()
    with pytest.warns(IdentifiabilityWarning):
        few = in_service(output_harmonics=0).fit(u, y)
    assert {"autocorrelation", "autocorrelation by phase"} <= failed(table(few, u, y))
    with pytest.warns(IdentifiabilityWarning):
        few = in_service(load_harmonics=0).fit(u, y)
    assert "loads" in failed(table(few, u, y))


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_a_fit_of_samples_warns_of_states_that_are_missing():
    u, y = service_record()
    with pytest.warns(IdentifiabilityWarning, match=r"predictions leave [\d.]+ times the variance"):
        in_service(1).fit(u, y)
    in_service(2).fit(u, y)  # warnings are errors here
    exact = pd.DataFrame({"y": np.convolve(u["u1"], 0.5 ** np.arange(60))[:3000]}, u.index)
    in_service(1).fit(u, exact)


@pytest.mark.slow
def test_matched_periodic_models_by_their_simulations():
    u, y = record(mathieu(), noise=0.02)
    assert (
        failed(table(synchronous(2.0, order=2, criterion="output_error").fit(u, y), u, y)) == set()
    )
    u, y = record(mathieu(), n_periods=200, noise=0.02)
    moved = y + 0.01 * y.std() * (y / y.std()) ** 2
    pipe = synchronous(2.0, order=2, criterion="output_error").fit(u, moved)
    assert "nonlinearity" in failed(table(pipe, u, moved))
    assert pipe["match"].covariance_type_ == "robust"  # no warning: samples confirm the exponents


@pytest.mark.slow
def test_a_trim_is_no_load_and_its_noise_no_failure():
    u, y = record(mathieu(), noise=0.02)
    analyzer = {"trim_span": (0.0, np.pi)}  # one period
    tests = table(synchronous(2.0, order=2, analyzer=analyzer).fit(u, y + 1.0), u, y + 1.0)
    assert failed(tests) == set()
    assert "loads" not in tests.index
    assert "autocorrelation by phase" in tests.index


def test_refusals():
    u, y = innovations(4)
    model = predictor()
    with pytest.raises(NotFittedError):
        model.residual_tests(u, y)
    model.fit(u, y)
    with pytest.raises(ValueError, match="lags must be a whole number of at least 1, got 0"):
        model.residual_tests(u, y, lags=0)
    with pytest.raises(ValueError, match="lags=1000000 is more than"):
        model.residual_tests(u, y, lags=10**6)
    with pytest.raises(ValueError, match="level must be a number between 0 and 1, got 2"):
        model.residual_tests(u, y, level=2)
    with pytest.raises(ValueError, match=r"12 rows of 1 output.*leave no residuals to test"):
        model.residual_tests(u[:12], y[:12])
    u, y = innovations(4, n=1500)
    grown = MOESPRegressor(3).fit(u, y)
    grown.model_ = replace(grown.model_, A=2.0 * grown.model_.A)
    with pytest.raises(UnstableModelError, match="no residuals to test"):
        grown.residual_tests(u, y)
    data = wing()
    pipe = sliding()[:2]
    with pytest.raises(ValueError, match=r"whole windows or periods \(reading='sliding'"):
        table(pipe, data.inputs, data.outputs)


def test_a_reduced_model_is_tested_too():
    u, y = innovations(5)
    reducer = SpuriousModeReducer(MOESPRegressor(3)).fit(u, y)
    assert "inputs" not in failed(reducer.residual_tests(u, y))


def test_display_of_plain_data_has_two_panels_and_the_correlations_of_the_definition():
    u, y = plain_record()
    model = MOESPRegressor(2, disturbance_model=True).fit(u, y)
    display = ResidualDisplay.from_estimator(model, u, y, lags=5)
    assert len(display.axes_) == 2
    e = (y - model.predict_ahead(u, y))[:, 0]
    assert np.isclose(display.autocorrelation["y0"][2], e[2:] @ e[:-2] / (e @ e), atol=5e-3)
    v = u[:, 0] - u.mean()
    size = np.sqrt((e @ e) * (v @ v))
    for lag, found in ((3, e[3:] @ v[:-3]), (-2, e[:-2] @ v[2:])):
        assert np.isclose(display.cross_correlation["y0", "x0"][lag], found / size, atol=5e-3)
    assert np.isclose(display.bands["y0"], 2.5758 / np.sqrt(600), rtol=1e-3)


@pytest.mark.parametrize("outputs", [["y"], ["y", "v"]])
def test_titles_of_the_display_name_the_tests_that_fail_once(outputs):
    p = {"autocorrelation": 0.2, "inputs": 0.03, "nonlinearity": 2e-5, "mean": 0.5}
    tests = pd.DataFrame({"p_value": p, "passed": {name: p[name] > 1e-3 for name in p}})
    pairs = pd.MultiIndex.from_product([outputs, ["u"]])
    own = pd.DataFrame(0.01, range(1, 4), outputs)
    crossed = pd.DataFrame(0.01, range(-3, 4), pairs)
    bands = dict.fromkeys([*outputs, *pairs], 0.1)
    display = ResidualDisplay(tests, own, crossed, bands=bands, n_rows=600).plot()
    between = ": " if len(outputs) == 1 else "\nall outputs: "
    assert [axis.get_title("left") for axis in display.axes_[:2]] == [
        f"simulation errors{between}noise (p = 0.2)",
        f"with u{between}not noise\nnonlinearity: p = 2e−5",
    ]
    rest = [axis.get_title("left") for axis in display.axes_[2:]]
    assert rest == ["simulation errors", "with u"] * (len(outputs) - 1)


@pytest.mark.slow
def test_display_by_azimuth_shows_loads_left_out():
    u, y = service_record()
    with pytest.warns(IdentifiabilityWarning):
        pipe, whole = in_service(load_harmonics=0).fit(u, y), in_service().fit(u, y)
    display, allowed_for = (ResidualDisplay.from_estimator(each, u, y) for each in (pipe, whole))
    assert "not noise" in display.axes_[2].get_title("left")
    shown, rest = (np.ptp(each.by_phase["y", "mean"]) for each in (display, allowed_for))
    assert shown > 3.0 * rest
    exact, v = innovations(2, noise=0.0)
    with pytest.raises(ValueError, match="only rounding of this record"):
        ResidualDisplay.from_estimator(MOESPRegressor(3).fit(exact, v), exact, v)


@pytest.mark.parametrize(("kind", "alike"), [("noise", 0.0), ("motion", 1.0)])
def test_what_neighbours_share_is_no_noise(kind, alike):
    """A burst that a model misses correlates little over the record, but with its neighbours."""
    t = np.arange(4000.0)
    y = np.sin(0.05 * t)[:, None]
    burst = (np.exp(-0.5 * ((t - 2000.0) / 30.0) ** 2) * np.cos(0.1 * t))[:, None]
    noise = np.random.default_rng(0).standard_normal(y.shape)
    e = 0.1 * {"noise": noise, "motion": burst}[kind]
    nothing = np.zeros((len(t), 1, 0))
    segment = Segment(e, y - e, nothing[:, 0], 0.3 * t, nothing, nothing)
    left = Remainder([segment], ("y",), (), False, None, -1, False)
    part = np.sum(e**2) / np.sum(y**2)
    assert left.part_of_motion() == pytest.approx(part, rel=0.05)
    assert left.part_of_motion(lag=1) == pytest.approx(alike * part, abs=0.05 * part)
