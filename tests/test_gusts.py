"""``criterion="prediction_error"``: records in which noise moves the machine itself."""

import pickle
import warnings
from functools import lru_cache

import numpy as np
import pandas as pd
import pytest
from periodic_cases import mathieu
from scipy.linalg import expm
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.metrics import r2_score
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    StructuredMatcher,
)
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.model_selection import BlockSplit

# Read period by period, gusts bias the start: the samples doubt it before predictions mend it.
pytestmark = pytest.mark.filterwarnings("ignore:. of . exponents are in doubt.* the samples have")

OMEGA, SAMPLES = 2.0, 16
MATHIEU = HarmonicStructure(F=1, G=0)
SHORT = "time constants of the slowest mode"
READINGS = ("period", "sample")


@lru_cache
def maps(samples, swing=1.0):
    """Steps of ÿ + 0.3 ẏ + (2 − cos 2t) y = u from sample to sample, by azimuth."""
    dt, found = 2 * np.pi / OMEGA / samples, {}

    def at(k):
        phase = round(k % samples, 9)
        if phase not in found:
            M = np.eye(3)
            for j in range(12):
                c = np.cos(OMEGA * (phase + (j + 0.5) / 12) * dt)
                F = np.array([[0, 1, 0], [-2 + swing * c, -0.3, 1], [0, 0, 0]])
                M = expm(F * dt / 12) @ M
            found[phase] = M[:2, :2], M[:2, 2]
        return found[phase]

    return at


def gusty(
    seed, *, gust=0.2, periods=60, samples=SAMPLES, noise=0.02, curved=0.0, load=0.0, swing=1.0
):
    """A record of y and ẏ; the gust moves y by a part of what u does."""
    rng, n = np.random.default_rng(seed), int(periods * samples)
    u = np.repeat(rng.choice([-1.0, 1.0], n // 12 + 1), 12)[:n]
    shake, x, at = rng.standard_normal(n), np.zeros((2, n + 1, 2)), maps(samples, swing)
    for k in range(n):
        A, b = at(k)
        x[0, k + 1] = A @ x[0, k] + b * (u[k] - curved * x[0, k, 0] ** 3)
        x[1, k + 1] = A @ x[1, k] + b * shake[k]
    still, moved = x[:, :n]
    y = still + gust * still.std() / moved.std() * moved
    y = y + noise * still.std(axis=0) * rng.standard_normal((n, 2))
    t = pd.Index(np.arange(n) * 2 * np.pi / OMEGA / samples, name="time")
    y[:, 0] += load * (1.0 + np.cos(OMEGA * t.to_numpy()))
    return pd.DataFrame({"u": u}, t), pd.DataFrame(y, t, ["y", "y_dot"])


def pipeline(reading="period", structure=MATHIEU, *, harmonics=2, analysis=None, **match):
    match = {"criterion": "prediction_error"} | match
    options = {"output_harmonics": harmonics, "reading": reading} | (analysis or {})
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(OMEGA, **options)),
            ("identify", MOESPRegressor(2)),
            ("match", StructuredMatcher(structure=structure, **match)),
        ]
    )


def fit(pipe, X, y, *, said=(SHORT,)):
    """Fit with these warnings let by, and no others."""
    with warnings.catch_warnings():
        for words in said:
            warnings.filterwarnings("ignore", f"[^$]*{words}")
        return pipe.fit(X, y)


def exponent(pipe):
    """The exponent with a positive imaginary part, and its deviation."""
    table = pipe["match"].eigenvalues_
    row = table.iloc[int(np.argmax(table["eigenvalue"].to_numpy().imag))]
    return row["eigenvalue"], row["std_real"].real, row["std_imag"].real


def truth(swing=1.0):
    F = np.zeros((3, 2, 2))
    F[0], F[1, 1, 0] = [[0.0, 1.0], [-2.0, -0.3]], swing
    found = mathieu(excitation=0.5 * swing, damping=0.15).floquet_exponents()
    return found[np.argmax(found.imag)]


def apart(pipe):
    """Errors of the exponent in parts of their deviations."""
    found, real, imaginary = exponent(pipe)
    other = min((truth(), -truth().conjugate() + 0j), key=lambda t: abs(found.imag - t.imag))
    folded = [(found.imag - s * truth().imag + 1.0) % 2.0 - 1.0 for s in (1, -1)]
    return (found.real - other.real) / real, min(folded, key=abs) / imaginary


@pytest.fixture(scope="module")
def recorded():
    return gusty(0)


@pytest.fixture(scope="module")
def fitted(recorded):
    return fit(pipeline(), *recorded)


@pytest.fixture(scope="module")
def refused(recorded):
    """Fits the match of a pipeline behind a model that all share, as its fit does, and fails."""
    frames = {each: pipeline(each)[:2].fit(*recorded).transform(recorded[0]) for each in READINGS}

    def check(words, reading="period", structure=MATHIEU, **match):
        with pytest.raises(ValueError, match=words):
            pipeline(reading, structure, **match)["match"].fit(frames[reading], recorded[1])

    return check


# ---- what is found ------------------------------------------------------------------------


@pytest.mark.parametrize("structure", [MATHIEU, HarmonicStructure(), None])
@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.slow
def test_a_machine_in_gusts_is_found_within_its_deviations(reading, structure, recorded):
    pipe = fit(pipeline(reading, structure), *recorded)
    assert np.max(np.abs(apart(pipe))) < 3.5
    match = pipe["match"]
    assert match.covariance_type_ == "information"
    assert match.residual_tests_["passed"].all()
    assert match.match_.sampled.innovations.gain.any()
    if structure is MATHIEU:
        theta = match.theta_
        assert len(theta) == len(match.theta_std_) == 14
        assert np.all(match.theta_std_ > 0)
        np.testing.assert_allclose(
            np.sqrt(np.diag(match.covariance_)), match.theta_std_.to_numpy(), rtol=1e-12
        )
        interval = match.confidence_interval()
        assert np.all(interval["lower"] < theta)


@pytest.mark.slow
def test_named_parameters_are_the_machines_own(fitted):
    theta, std = fitted["match"].theta_, fitted["match"].theta_std_
    F = fitted["match"].match_.periodic.matrices()[0]
    np.testing.assert_allclose(F[0], [[0.0, 1.0], [-2.0, -0.3]], atol=0.15)
    assert F[1, 1, 0] == pytest.approx(1.0, abs=0.15)
    assert set(theta.index) == set(std.index)


@pytest.mark.slow
def test_loads_are_fitted_beside_the_rest():
    X, y = gusty(0, load=3.0)
    pipe = fit(pipeline("sample"), X, y)
    assert np.max(np.abs(apart(pipe))) < 3.5
    rest = pipe.predict(X.assign(u=0.0)).to_numpy()
    expected = 3.0 * (1.0 + np.cos(OMEGA * X.index.to_numpy()))
    np.testing.assert_allclose(rest[:, 0], expected, atol=0.3)
    np.testing.assert_allclose(rest[:, 1], 0.0, atol=0.3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.parametrize("structure", [MATHIEU, pytest.param(None, marks=pytest.mark.slow)])
def test_a_turn_need_not_hold_whole_samples(structure):
    X, y = gusty(1, samples=16.25, load=1.0)
    pipe = fit(pipeline("sample", structure), X, y)
    assert np.max(np.abs(apart(pipe))) < 3.5
    assert pipe["match"].covariance_type_ == "information"


@pytest.mark.slow
def test_deviations_without_gusts_are_those_of_simulations():
    X, y = gusty(2, gust=0.0, periods=40)
    one = fit(pipeline(), X, y)["match"]
    other = fit(pipeline(criterion="output_error"), X, y)["match"]
    np.testing.assert_allclose(one.theta_, other.theta_, atol=0.02)
    np.testing.assert_allclose(one.theta_std_, other.theta_std_, rtol=0.5)
    assert not one.match_.sampled.innovations.gain.any()


LAG = MatrixStructure([["0", "1"], ["-k", "-c"]], [["0"], ["b"]], np.eye(2))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.parametrize("reading", ["sample", "sliding", "plain"])
def test_a_matrix_structure_is_refined_too(reading):
    """y″ = −2 y − 0.3 y′ + u, with nothing that turns."""
    X, y = gusty(3, swing=0.0)
    options = {} if reading == "sample" else {"analysis": {"input_harmonics": 0}}
    if reading == "plain":
        pipe = Pipeline(
            [
                ("identify", MOESPRegressor(2)),
                ("match", StructuredMatcher(structure=LAG, criterion="prediction_error")),
            ]
        )
    else:
        pipe = pipeline(reading, LAG, harmonics=0, **options)
    said = (SHORT, "not white noise", "differ in order", "does not determine")
    fit(pipe, X, y, said=said)
    match = pipe["match"]
    if reading == "sliding":  # a sliding mean is no sample: only that it is a model of them
        assert np.all(np.isfinite(match.theta_))
        return
    z = (match.theta_ - pd.Series({"k": 2.0, "c": 0.3, "b": 1.0})) / match.theta_std_
    assert np.max(np.abs(z)) < 4.0, (match.theta_, match.theta_std_)
    assert match.covariance_type_ == "information"
    assert np.all(np.real(match.eigenvalues_["std_real"]) > 0)


# ---- predictions --------------------------------------------------------------------------


def test_predictions_forget_with_the_horizon(fitted, recorded):
    """A step ahead is best; far ahead is a simulation."""
    X, y = recorded
    seen, match = fitted[:-1].transform(X), fitted["match"]
    scores = [r2_score(y, match.predict_ahead(seen, y, horizon=h)) for h in (1, 2, 5, 20)]
    assert np.all(np.diff(scores) < 0)
    assert scores[0] > match.score(seen, y)
    ahead = match.predict_ahead(seen, y)
    left = (y - ahead).to_numpy()
    stated = match.noise_std_.to_numpy()
    np.testing.assert_allclose(left[50:].std(axis=0), stated, rtol=0.1)
    assert list(ahead.columns) == list(y.columns)
    assert ahead.index.equals(y.index)
    e = left[50:] / stated
    assert np.max(np.abs(np.mean(e[1:] * e[:-1], axis=0))) < 0.12


def test_score_is_that_of_simulations(fitted, recorded):
    X, y = recorded
    assert fitted.score(X, y) == fitted["match"].score(fitted[:-1].transform(X), y)
    simulated = fitted.predict(X)
    assert 0.9 < r2_score(y, simulated) < 0.99
    moved = fitted.predict(X, x0=[1.0, 0.0])
    assert abs(moved.iloc[0, 0] - simulated.iloc[0, 0] - 1.0) < 0.2  # states are the outputs
    np.testing.assert_allclose(moved.iloc[-1], simulated.iloc[-1], atol=1e-3)
    ahead = fitted["match"].predict_ahead(fitted[:-1].transform(X), y, x0=[1.0, 0.0])
    one = fitted["match"].predict_ahead(fitted[:-1].transform(X), y, x0=[0.0, 0.0])
    assert abs(ahead.iloc[0, 0] - one.iloc[0, 0]) > 0.5
    np.testing.assert_allclose(ahead.iloc[-1], one.iloc[-1], atol=1e-6)


def test_only_predictors_predict(recorded):
    X, y = recorded
    pipe = fit(pipeline(criterion="output_error"), X, y, said=("not white noise", "time constants"))
    with pytest.raises(AttributeError, match="predict_ahead") as refused:
        pipe["match"].predict_ahead(pipe[:-1].transform(X), y)
    assert "StructuredMatcher with criterion='prediction_error'" in str(refused.value.__cause__)
    assert pipe["match"].covariance_type_ == "robust"


def test_what_is_said_before_a_fit_and_after_one_in_a_norm(recorded):
    with pytest.raises(NotFittedError):
        StructuredMatcher(criterion="prediction_error").covariance_type_  # noqa: B018
    pipe = fit(pipeline(criterion="hinf"), *recorded, said=("residuals that are not noise",))
    for name in ("covariance_type_", "residual_tests_", "eigenvalues_"):
        with pytest.raises(AttributeError, match=name):
            getattr(pipe["match"], name)


# ---- as an estimator ----------------------------------------------------------------------


@pytest.mark.slow
def test_it_is_cloned_pickled_and_searched(fitted, recorded):
    X, y = recorded
    again = pickle.loads(pickle.dumps(fitted))
    pd.testing.assert_frame_equal(again.predict(X), fitted.predict(X))
    seen = fitted[:-1].transform(X)
    pd.testing.assert_frame_equal(
        again["match"].predict_ahead(seen, y), fitted["match"].predict_ahead(seen, y)
    )
    fresh = clone(fitted)
    assert not hasattr(fresh["match"], "match_")
    assert fresh.get_params()["match__criterion"] == "prediction_error"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        grid = GridSearchCV(
            fresh,
            {"match__criterion": ["output_error", "prediction_error"]},
            cv=BlockSplit(2),
            error_score="raise",
        ).fit(X, y)
    assert np.all(np.array(grid.cv_results_["mean_test_score"]) > 0.5)


@pytest.mark.slow
def test_arrays_and_records_are_as_good_as_one_frame(recorded, fitted):
    X, y = recorded
    cut = 30 * SAMPLES
    parts = [(v[:cut], v[cut:]) for v in (X, y)]
    X2, y2 = (pd.concat(part, keys=["a", "b"], names=["record"]) for part in parts)
    for reading in ("period", "sample"):
        one, two = fit(pipeline(reading), X, y), fit(pipeline(reading), X2, y2)
        gap = (one["match"].theta_ - two["match"].theta_) / one["match"].theta_std_
        assert np.max(np.abs(gap)) < 1.0
        np.testing.assert_allclose(two["match"].theta_std_, one["match"].theta_std_, rtol=0.3)
        ahead = two["match"].predict_ahead(two[:-1].transform(X2), y2)
        assert ahead.index.equals(y2.index)
        starts = two.predict(X2, x0={"a": [1.0, 0.0], "b": [0.0, 0.0]})
        rest = two.predict(X2)
        assert abs(starts.loc["a"].iloc[0, 0] - rest.loc["a"].iloc[0, 0]) > 0.5
        np.testing.assert_allclose(starts.loc["b"], rest.loc["b"])


@pytest.mark.parametrize(
    ("criterion", "first"),
    [
        ("output_error", (0.0, 0.37)),
        ("output_error", (0.37, 0.0)),
        pytest.param("prediction_error", (0, 0.37), marks=pytest.mark.slow),
    ],
)
@pytest.mark.slow
def test_records_may_begin_on_a_phase_or_between_two(criterion, first):
    """The second record's samples lie elsewhere on the turn than the first one's."""
    system = mathieu()
    parts = []
    for seed, off in enumerate(first):
        rng = np.random.default_rng(seed)
        t = (np.arange(400) + off) * system.period / 16
        u = np.repeat(rng.choice([-1.0, 1.0], 40), 10)[:, None]
        y = system.simulate(u, t)
        y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
        index = pd.Index(t, name="time")
        parts.append((pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index, ["y", "v"])))
    X, y = (pd.concat(each, keys=["a", "b"], names=["record"]) for each in zip(*parts, strict=True))
    match = fit(pipeline("sample", criterion=criterion), X, y, said=("",))["match"]
    F = match.match_.periodic.matrices()[0]
    np.testing.assert_allclose(F[0], [[0.0, 1.0], [-2.0, -0.2]], atol=0.03)
    np.testing.assert_allclose(F[1, 1, 0], 1.0, atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("reading", READINGS)
def test_rows_without_outputs_are_gaps(reading, recorded):
    X, y = recorded
    y = y.copy()
    y.iloc[300:320] = np.nan
    pipe = fit(pipeline(reading, analysis={"missing": "gap"}), X, y)
    assert np.max(np.abs(apart(pipe))) < 3.5
    assert pipe["match"].covariance_type_ == "information"


# ---- what is said -------------------------------------------------------------------------


def test_samples_contradict_whole_periods_whose_inputs_always_move(recorded):
    """The map is off by three times what the samples are; no free decay says so."""
    with pytest.warns(IdentifiabilityWarning, match="exponents are in doubt.* the samples have"):
        pipe = pipeline()[:2].fit(*recorded)
    opinion = pipe["identify"].model_.opinion
    where, deviation = opinion.beside(np.array([truth()]))
    assert np.abs(where) < 2.0 * deviation
    off = np.min(np.abs(pipe["identify"].model_.exponents() - truth()))
    assert off > 3.0 * np.abs(where)


@pytest.mark.filterwarnings("ignore:the record lasts")
@pytest.mark.parametrize("reading", ["period", pytest.param("sample", marks=pytest.mark.slow)])
def test_gusts_name_prediction_error(reading, recorded):
    with pytest.warns(IdentifiabilityWarning, match="use criterion='prediction_error'"):
        pipeline(reading, criterion="output_error").fit(*recorded)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_short_records_are_told(recorded):
    with pytest.warns(IdentifiabilityWarning, match=r"lasts only \d+ time constants"):
        pipeline().fit(*gusty(0, periods=40))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".* the samples have")  # of the start
        pipeline().fit(*gusty(0, periods=125))


@pytest.mark.slow
def test_a_machine_that_is_not_linear_is_said_to_be_so():
    X, y = gusty(0, gust=0.0, curved=0.3)
    for criterion in ("output_error", "prediction_error"):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            match = pipeline(criterion=criterion).fit(X, y)["match"]
        words = " ".join(str(each.message) for each in said)
        assert "the residuals of the fit are not white noise" in words
        assert match.covariance_type_ == "robust"
        assert not match.residual_tests_["passed"].all()


@pytest.mark.slow
def test_parts_of_a_record_that_disagree_are_told():
    """Small motions of one machine, large ones of another: two records, of the same noise."""
    small, large = gusty(0, gust=0.67, noise=0.067, periods=250), gusty(1, swing=1.6)
    small = [0.3 * each for each in small]
    pairs = zip(small, large, strict=True)
    X, y = (pd.concat(each, keys=["a", "b"], names=["record"]) for each in pairs)
    with pytest.warns(
        IdentifiabilityWarning, match="parts of the record disagree: from the first record"
    ) as w:
        match = pipeline().fit(X, y)["match"]
    words = " ".join(str(each.message) for each in w)
    stated = float(words.split("its standard deviation is widened to ")[1].split(";")[0])
    assert stated == pytest.approx(exponent({"match": match})[2], rel=0.05)
    assert stated > 0.02  # its two machines lie 0.09 apart
    assert match.covariance_type_ == "information"


# ---- what is refused ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"input_noise": 0.1}, "'prediction_error' predicts; fit with criterion='output_error'"),
        ({"output_weights": 2.0}, "criterion='prediction_error' weights each output"),
        ({"input_weights": {"u": 1.0}}, "criterion='prediction_error' weights each output"),
    ],
)
@pytest.mark.parametrize("reading", READINGS)
def test_what_predictions_cannot_use_is_refused(reading, options, words, refused):
    refused(words, reading, **options)


def test_noise_on_the_inputs_of_samples_is_refused(refused):
    refused("use HarmonicAnalyzer", "sample", criterion="output_error", input_noise=0.1)


def test_an_invariant_structure_of_a_machine_that_turns_is_refused(refused):
    refused("give a HarmonicStructure", "sample", LAG)


# ---- over many records --------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("gust", [0.0, 0.2])
def test_right_models_raise_no_alarm(reading, gust):
    """At most one of ten; and 95 % intervals hold.

    Before the likelihood, in some of these records both halves tell the damping to more than 10 %.
    """
    expected, alarms, z = (SHORT, "exponents are in doubt"), 0, []
    for seed in range(10):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            pipe = pipeline(reading).fit(*gusty(seed, gust=gust, periods=120))
        words = [str(each.message) for each in said]
        alarms += any(not any(short in each for short in expected) for each in words)
        z.append(apart(pipe))
    assert alarms <= 1
    assert np.mean(np.abs(z) < 1.96) >= 0.85
