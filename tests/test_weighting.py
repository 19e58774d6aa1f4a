"""MOESPRegressor's weightings, its disturbance model and predictions from measured outputs."""

import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import random_stable, same_poles
from innovation_cases import disturbed, in_closed_loop
from sklearn.base import clone
from sklearn.metrics import mean_squared_error, r2_score
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning, InstabilityWarning
from sklearn_hd.model_selection import PeriodBlockSplit, simulation_scorer

WEIGHTINGS = ["moesp", "n4sid", "cva", "pbsid"]
SLOW_A = 0.95 * np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
SLOW_B, SLOW_C = np.array([[1.0], [0.3]]), np.array([[1.0, 0.5]])


def impulse_response(estimator, n=8, matrix="B"):
    model = estimator.model_
    entering = model.kalman_gain if matrix == "K" else model.B
    return np.array([model.C @ np.linalg.matrix_power(model.A, j) @ entering for j in range(n)])


def off(found, wanted):
    return np.linalg.norm(found - wanted) / np.linalg.norm(wanted)


def frames(u, y, step=0.01):
    time = np.arange(len(y)) * step
    return (
        pd.DataFrame(u, index=time, columns=[f"u{i}" for i in range(u.shape[1])]),
        pd.DataFrame(y, index=time, columns=[f"y{i}" for i in range(y.shape[1])]),
    )


# ---- closed loop ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model is unstable")
def test_in_closed_loop_only_the_predictor_is_not_biased():
    """An unstable plant held by feedback of its noisy output: error of the impulse response,
    median over seeds. Ten times the data make PBSID three times better and MOESP no better."""
    system, feedback = in_closed_loop()
    wanted, errors = system.markov(system.B), {}
    for weighting in ("moesp", "pbsid"):
        for n_samples in (1500, 15_000):
            found = []
            for seed in range(5):
                rng = np.random.default_rng(seed)
                u, y, _ = system.simulate(rng, n_samples, feedback=feedback)
                model = MOESPRegressor(3, weighting=weighting).fit(u, y)
                found.append(off(impulse_response(model), wanted))
            errors[weighting, n_samples] = np.median(found)
    assert errors["moesp", 15_000] > 0.15
    assert errors["pbsid", 15_000] < 0.02
    assert errors["pbsid", 15_000] < 0.5 * errors["pbsid", 1500]


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.parametrize("feedthrough", [False, True])
def test_every_weighting_is_exact_without_noise(rng, weighting, feedthrough):
    A, B, C = random_stable(rng, 4, 2, 3)
    D = feedthrough * rng.standard_normal((3, 2))
    u, x0 = rng.standard_normal((400, 2)), rng.standard_normal(4)
    y = propagate(A, u @ B.T, x0) @ C.T + u @ D.T
    model = MOESPRegressor(weighting=weighting, feedthrough=feedthrough)
    X, Y = frames(1e3 * u, 1e-2 * y)
    model.fit(X, Y)
    assert model.order_ == 4
    assert same_poles(model.eigenvalues_, np.linalg.eigvals(A), 1e-8)
    wanted = np.array([C @ np.linalg.matrix_power(A, j) @ B for j in range(8)])
    assert off(impulse_response(model), 1e-5 * wanted) < 1e-8
    np.testing.assert_allclose(model.model_.D, 1e-5 * D, atol=1e-13)
    np.testing.assert_allclose(model.predict(X, x0=model.x0_), Y, atol=1e-9)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_chunks_give_the_model_of_a_fit(rng, weighting):
    system = disturbed(rng, 3, 1, 2)
    u, y, _ = system.simulate(rng, 3000)
    parameters = {"weighting": weighting, "disturbance_model": True, "block_rows": 8}
    whole = MOESPRegressor(3, **parameters).fit(u, y)
    chunks = MOESPRegressor(3, **parameters)
    for rows in np.array_split(np.arange(3000), 7):
        chunks.partial_fit(u[rows], y[rows])
    for name in ("B", "K"):
        found, wanted = (impulse_response(each, matrix=name) for each in (chunks, whole))
        np.testing.assert_allclose(found, wanted, atol=1e-10 * np.abs(wanted).max())
    np.testing.assert_allclose(chunks.innovations_covariance_, whole.innovations_covariance_)
    np.testing.assert_allclose(chunks.x0_, whole.x0_, atol=1e-8 * np.abs(whole.x0_).max())


def test_units_of_signals_change_nothing_but_units(rng):
    system = disturbed(rng, 3, 1, 2)
    u, y, _ = system.simulate(rng, 3000)
    model = MOESPRegressor(3, weighting="pbsid", block_rows=10)
    here, there = clone(model).fit(u, y), clone(model).fit(1e3 * u, y * [1.0, 1e-4])
    assert same_poles(here.eigenvalues_, there.eigenvalues_, 1e-9)
    ratio = np.array([1.0, 1e-4])
    np.testing.assert_allclose(
        there.innovations_covariance_, here.innovations_covariance_ * np.outer(ratio, ratio)
    )
    np.testing.assert_allclose(there.predict_ahead(1e3 * u, y * ratio) / ratio,
                               here.predict_ahead(u, y), atol=1e-8)  # fmt: skip


def test_block_rows_of_the_predictor_follow_its_memory(rng):
    u, e = rng.standard_normal((2, 8000, 1))
    y = np.zeros((8000, 1))
    for k in range(7, 8000):
        y[k] = 0.7 * y[k - 7] + u[k - 1] + e[k]
    model = MOESPRegressor(weighting="pbsid").fit(u, y)
    assert 9 <= model.block_rows_ <= 13
    assert model.order_ == 7


def test_simulation_of_what_was_taken_for_a_closed_loop_is_warned_of(rng):
    X, Y = frames(*disturbed(rng, 1, 1, 1).simulate(rng, 600)[:2])
    structure = MatrixStructure([[np.nan]], [[np.nan]])
    for weighting in ("pbsid", "moesp"):
        upstream = SpuriousModeReducer(MOESPRegressor(1, weighting=weighting))
        matcher = StructuredMatcher(upstream, structure=structure, criterion="output_error")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            matcher.fit(X, Y)
        told = [w for w in said if "'output_error' simulates the record" in str(w.message)]
        assert len(told) == (weighting == "pbsid")
        assert all(w.category is IdentifiabilityWarning for w in told)
        assert all(w.filename == __file__ for w in told)


def outputs_of_low_rank(rng, kind):
    system = disturbed(rng, 3, 1, 2)
    u, y, _ = system.simulate(rng, 1500)
    exact = propagate(system.A, u @ system.B.T, np.zeros(3)) @ system.C.T
    return u, {
        "their sum": np.c_[y, y.sum(axis=1)],
        "the same twice": y[:, [0, 0]],
        "one at rest": np.c_[y, 0.0 * u],
        "one without noise": np.c_[exact[:, 0], y[:, 1]],
    }[kind]


@pytest.mark.parametrize(
    "kind", ["their sum", "the same twice", "one at rest", "one without noise"]
)
@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_outputs_of_low_rank_have_a_gain_too(rng, weighting, kind):
    """Noise of fewer dimensions than outputs: the covariances are singular."""
    u, y = outputs_of_low_rank(rng, kind)
    model = MOESPRegressor(3, weighting=weighting, disturbance_model=True).fit(u, y)
    K = model.kalman_gain_
    assert np.max(np.abs(np.linalg.eigvals(model.model_.A - K @ model.model_.C))) < 1.0
    left = y - model.predict_ahead(u, y)
    simulated = y - model.predict(u, x0=model.x0_)
    assert np.sum(left**2) <= 1.001 * np.sum(simulated**2)


@pytest.mark.parametrize("kind", ["their sum", "the same twice", "one without noise"])
def test_orders_by_correlations_of_outputs_of_low_rank(rng, kind):
    u, y = outputs_of_low_rank(rng, kind)
    assert MOESPRegressor(weighting="cva").fit(u, y).order_ <= 6  # three of u, three of noise


def test_predictors_of_orders_too_low_are_stable(rng):
    A, B, C = random_stable(rng, 4, 1, 2)
    u = rng.standard_normal((800, 1))
    y = propagate(A, u @ B.T, np.zeros(4)) @ C.T
    for weighting in WEIGHTINGS:
        model = MOESPRegressor(2, weighting=weighting, disturbance_model=True).fit(u, y)
        found = model.model_
        assert np.max(np.abs(np.linalg.eigvals(found.A - found.kalman_gain @ found.C))) < 1.0
        assert np.abs(y - model.predict_ahead(u, y)).max() < 3.0 * np.abs(y).max()


def test_a_few_sines_excite_fewer_directions_than_block_rows(rng):
    """Past inputs that future ones repeat are rounding once these are projected out."""
    k = np.arange(2000.0)
    u = sum(np.sin(2.0 * np.pi * f * k + f) for f in (0.05, 0.11, 0.23))[:, None]
    y = propagate(SLOW_A, u @ SLOW_B.T, np.array([5.0, 0.0])) @ SLOW_C.T
    y = y + 0.3 * rng.standard_normal((2000, 1))
    for weighting in WEIGHTINGS:
        message, worst = r"input\(s\) needs", 0.45 if weighting == "n4sid" else 0.34
        if weighting == "pbsid":
            message = (
                "the inputs excite only 6 directions, so a predictor can use at most 3 past rows"
            )
            worst = 0.55
        model = MOESPRegressor(2, weighting=weighting, disturbance_model=True)
        with pytest.warns(ExcitationWarning, match=message):
            model.fit(u, y)
        assert model.singular_values_[0] < 1e3
        assert np.std(y - model.predict_ahead(u, y)) < worst < np.std(y)
    with (
        pytest.warns(ExcitationWarning, match="at most 3 past rows"),
        pytest.raises(ValueError, match="order=4 exceeds the rank bound 2 of block_rows=3"),
    ):
        MOESPRegressor(4, weighting="pbsid").fit(u, y)


def test_periodic_inputs_bound_how_far_back_a_predictor_reaches(rng):
    """Twenty values that repeat: beyond the directions that they excite a predictor is any."""
    u = np.tile(rng.choice([-1.0, 1.0], 20), 150)[:, None]
    y = propagate(SLOW_A, u @ SLOW_B.T, np.zeros(2)) @ SLOW_C.T
    y = y + 0.3 * rng.standard_normal((3000, 1))
    with pytest.warns(ExcitationWarning, match="a predictor can use at most"):
        model = MOESPRegressor(2, weighting="pbsid").fit(u, y)
    wanted = np.array([SLOW_C @ np.linalg.matrix_power(SLOW_A, j) @ SLOW_B for j in range(8)])
    assert off(impulse_response(model), wanted) < 0.05


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@pytest.mark.slow
def test_trims_and_gains_go_together_period_by_period(weighting):
    """The constant direction of an averaged trim repeats itself in every block row."""
    data = make_flapping_wing("ltp", snr_db=40, random_state=100)
    analyzer = HarmonicAnalyzer(data.omega, reading="period", trim_span=data.trim_span)
    frame = analyzer.fit_transform(data.inputs, data.outputs)
    model = MOESPRegressor(2, weighting=weighting, disturbance_model=True)
    model.fit(frame, data.outputs)
    exponents = np.log(model.eigenvalues_.astype(complex)) * data.omega / (2.0 * np.pi)
    truth = np.sort(data.ltp.floquet_exponents().real)
    np.testing.assert_allclose(np.sort(exponents.real), truth, rtol=0.25)
    ahead = model.predict_ahead(frame, data.outputs)
    assert r2_score(data.outputs, ahead) > 0.95


@pytest.mark.slow
def test_a_gain_alone_does_not_change_the_periodic_model():
    """The matcher takes a record for one of a closed loop by the weighting."""
    data = make_flapping_wing("ltp", snr_db=40, random_state=101)
    models = []
    for disturbance_model in (False, True):
        pipe = Pipeline(
            [
                ("harmonics", HarmonicAnalyzer(data.omega, reading="period")),
                ("identify", MOESPRegressor(2, disturbance_model=disturbance_model)),
                ("match", StructuredMatcher(structure=HarmonicStructure())),
            ]
        )
        models.append(pipe.fit(data.inputs, data.outputs)["match"].theta_)
    pd.testing.assert_series_equal(*models)


# ---- prediction ----------------------------------------------------------------------------------


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_one_step_errors_are_the_innovations(rng, weighting):
    system = disturbed(rng, 3, 1, 2)
    u, y, e = system.simulate(rng, 6000)
    X, Y = frames(u, y)
    model = MOESPRegressor(3, weighting=weighting, disturbance_model=True).fit(X, Y)
    left = (Y - model.predict_ahead(X, Y)).to_numpy()
    assert np.mean(left**2) < 1.01 * np.mean(e**2)
    np.testing.assert_allclose(model.innovations_covariance_, np.cov(left.T), atol=0.1)
    simulated = model.predict(X, x0=model.x0_)
    errors = [np.mean((Y - model.predict_ahead(X, Y, h)).to_numpy() ** 2) for h in (1, 2, 5, 40)]
    assert np.all(np.diff(errors) > 0.0)
    assert errors[-1] == pytest.approx(np.mean((Y - simulated).to_numpy() ** 2), rel=0.02)


@pytest.mark.slow
def test_predictions_hold_for_unstable_plants_where_simulation_does_not(rng):
    system, feedback = in_closed_loop()
    u, y, e = system.simulate(rng, 20_000, feedback=feedback)
    with pytest.warns(InstabilityWarning, match="over the 20000 rows of the longest segment"):
        model = MOESPRegressor(weighting="pbsid").fit(u, y)
    assert model.order_ == 3
    assert not model.feedthrough_
    left = y - model.predict_ahead(u, y)
    assert np.mean(left**2) < 1.01 * np.mean(e**2)
    with pytest.raises(ValueError, match="the simulation overflows: the model has a pole of size"):
        model.predict(u)


def test_predictions_come_in_the_container_of_y_and_segment_by_segment(rng):
    system = disturbed(rng, 2, 1, 1)
    X, Y = frames(*system.simulate(rng, 1200)[:2])
    X, Y = (pd.concat({"a": z.iloc[:700], "b": z.iloc[700:1200]}) for z in (X, Y["y0"]))
    model = MOESPRegressor(2, weighting="pbsid", block_rows=8).fit(X, Y)
    found = model.predict_ahead(X, Y)
    assert isinstance(found, pd.Series)
    assert found.index.equals(Y.index)
    alone = model.predict_ahead(X.loc["b"], Y.loc["b"])
    np.testing.assert_allclose(found.loc["b"], alone, atol=1e-10)
    given = model.predict_ahead(X, Y, x0={"a": np.zeros(2), "b": np.ones(2)})
    assert given.loc["b"].iloc[0] == pytest.approx(float(model.model_.C.sum()))
    assert given.loc["a"].iloc[0] == 0.0
    np.testing.assert_allclose(given.iloc[-50:], found.iloc[-50:], atol=1e-6)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
def test_a_horizon_of_a_reduced_model_is_refused(rng):
    u, y, _ = disturbed(rng, 2, 1, 1).simulate(rng, 400)
    reducer = SpuriousModeReducer(MOESPRegressor(2)).fit(u, y)
    with pytest.raises(ValueError, match="this SpuriousModeReducer has no Kalman gain; use"):
        simulation_scorer(r2_score, horizon=1)(reducer, u, y)


def test_predictions_want_a_gain(rng):
    u, y, _ = disturbed(rng, 2, 1, 1).simulate(rng, 400)
    model = MOESPRegressor(2)
    assert not hasattr(model, "predict_ahead")
    model.fit(u, y)
    assert not hasattr(model, "predict_ahead")
    with pytest.raises(AttributeError, match="fit with disturbance_model=True or weighting='pbsid"):
        _ = model.kalman_gain_
    assert hasattr(clone(model).set_params(weighting="pbsid"), "predict_ahead")
    with pytest.raises(ValueError, match="horizon must be a whole number of at least 1, got 0"):
        clone(model).set_params(disturbance_model=True).fit(u, y).predict_ahead(u, y, horizon=0)


def test_gain_goes_no_further_than_the_rows_that_it_is_of(rng):
    """Reduction to continuous time leaves it behind."""
    X, Y = frames(*disturbed(rng, 2, 1, 1).simulate(rng, 2000)[:2])
    step = SpuriousModeReducer(MOESPRegressor(2, disturbance_model=True)).fit(X, Y)
    assert step.model_.kalman_gain is None
    assert step.estimator_.model_.kalman_gain is not None


def test_searches_choose_by_prediction(rng):
    """Of a system that noise alone drives, free simulation tells nothing."""
    system = disturbed(rng, 3, 0, 2, strength=1.0)
    _, y, _ = system.simulate(rng, 3000)
    X, Y = frames(np.zeros((3000, 0)), y)
    search = GridSearchCV(
        MOESPRegressor(weighting="pbsid", block_rows=10),
        {"order": [1, 2, 3]},
        cv=PeriodBlockSplit(3, omega=2 * np.pi / 0.1),
        scoring=simulation_scorer(r2_score, horizon=1),
    ).fit(X, Y)
    assert search.best_params_ == {"order": 3}
    one, five = (
        simulation_scorer(mean_squared_error, greater_is_better=False, horizon=h)(search, X, Y)
        for h in (1, 5)
    )
    assert five < one < 0.0
    assert "horizon=1" in repr(simulation_scorer(r2_score, horizon=1))


def test_scores_ahead_want_a_gain(rng):
    X, Y = frames(*disturbed(rng, 2, 1, 1).simulate(rng, 400)[:2])
    model = MOESPRegressor(2).fit(X, Y)
    scorer = simulation_scorer(r2_score, horizon=3)
    with pytest.raises(ValueError, match="but this MOESPRegressor has no Kalman gain"):
        scorer(model, X, Y)
    with pytest.raises(ValueError, match="horizon must be a whole number of at least 1"):
        simulation_scorer(r2_score, horizon=0)


# ---- outputs alone -------------------------------------------------------------------------------


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_outputs_alone_show_modes_and_noise(rng, weighting):
    A = np.array([[0.9, 0.3], [-0.3, 0.9]])
    root = np.array([[1.0, 0.0], [0.5, 0.5]])
    x = propagate(A, rng.standard_normal((30_000, 2)) @ root.T, np.zeros(2))
    y = pd.Series(x[:, 0], index=np.arange(30_000) * 0.1, name="strain")
    model = MOESPRegressor(weighting=weighting, disturbance_model=True).fit(None, y)
    assert model.order_ == 2
    assert model.system_.input_labels == ["e@strain"]
    assert same_poles(model.eigenvalues_, np.linalg.eigvals(A), 0.01)
    frame = y.to_frame()[[]]
    again = clone(model).fit(frame, y)
    np.testing.assert_array_equal(again.model_.A, model.model_.A)
    left = y - model.predict_ahead(None, y)
    assert left.std() == pytest.approx(
        float(np.sqrt(model.innovations_covariance_[0, 0])), rel=0.01
    )
    # where the next x is known but for its noise, that is all that is left
    assert left.std() < 1.15
    x0, found = np.array([1.0, -2.0]), model.model_
    free = [(found.C @ np.linalg.matrix_power(found.A, k) @ x0).item() for k in range(20)]
    np.testing.assert_allclose(model.predict(frame, x0=x0).iloc[:20], free, rtol=1e-9, atol=1e-9)
    assert model.score(None, y) == model.score(frame, y)
    modes = SpuriousModeReducer(clone(model)).fit(frame, y).modes_
    assert abs(modes["eigenvalue"].iloc[0].imag) == pytest.approx(
        np.arctan2(0.3, 0.9) / 0.1, rel=0.01
    )


def test_outputs_alone_in_chunks(rng):
    _, y, _ = disturbed(rng, 2, 0, 2, strength=1.0).simulate(rng, 2000)
    whole = MOESPRegressor(2, block_rows=6, disturbance_model=True).fit(None, y)
    chunks = MOESPRegressor(2, block_rows=6, disturbance_model=True)
    for rows in np.split(np.arange(2000), 4):
        chunks.partial_fit(None, y[rows])
    np.testing.assert_allclose(
        impulse_response(chunks, matrix="K"), impulse_response(whole, matrix="K"), rtol=1e-9
    )


def test_outputs_alone_without_a_gain_make_no_transfer_function(rng):
    model = MOESPRegressor(1, block_rows=4).fit(None, np.cumsum(rng.standard_normal(200)))
    with pytest.raises(AttributeError, match="without a Kalman gain cannot be written"):
        _ = model.system_


def test_a_table_without_columns_is_told_from_one_that_was_lost(rng):
    y = rng.standard_normal(100)
    with pytest.raises(ValueError, match=r"0 feature\(s\).*with X=None or a DataFrame of no col"):
        MOESPRegressor().fit(np.zeros((100, 0)), y)
    with pytest.raises(ValueError, match=r"X has no signals: 0 feature\(s\)"):
        HarmonicAnalyzer(1.0).fit(pd.DataFrame(index=np.arange(100) * 0.1), y)
    with pytest.raises(ValueError, match=r"y has no signals"):
        MOESPRegressor().fit(None, pd.DataFrame(index=np.arange(100) * 0.1))


# ---- what does not go together -------------------------------------------------------------------


def test_unknown_weighting(rng):
    with pytest.raises(ValueError, match="weighting='ssarx' is not known; use one of"):
        MOESPRegressor(weighting="ssarx").fit(*rng.standard_normal((2, 50, 1)))
    with pytest.raises(ValueError, match="disturbance_model must be True or False, got 'yes'"):
        MOESPRegressor(disturbance_model="yes").fit(*rng.standard_normal((2, 50, 1)))


@pytest.mark.parametrize("asked", [{"weighting": "pbsid"}, {"disturbance_model": True}], ids=str)
def test_a_sliding_window_leaves_no_predictor(asked):
    data = make_flapping_wing("ltp")
    frame = HarmonicAnalyzer(data.omega, hop=8).fit_transform(data.inputs, data.outputs)
    with pytest.raises(
        ValueError, match="use HarmonicAnalyzer\\(reading='period'\\), or plain data"
    ):
        MOESPRegressor(**asked).fit(frame, data.outputs)


def test_other_weightings_read_sliding_windows():
    """Without noise they agree."""
    data = make_flapping_wing("ltp")
    frame = HarmonicAnalyzer(data.omega, hop=8).fit_transform(data.inputs, data.outputs)
    models = [MOESPRegressor(weighting=w).fit(frame, data.outputs) for w in WEIGHTINGS[:3]]
    first, *others = (model.predict(frame).to_numpy() for model in models)
    for other in others:
        np.testing.assert_allclose(other, first, atol=1e-6 * np.abs(first).max())


def test_predictors_want_rows_for_past_outputs_too(rng):
    u, y = rng.standard_normal((2, 40, 1))
    with pytest.raises(ValueError, match="at least 50 consecutive rows are needed"):
        MOESPRegressor(2, weighting="pbsid", block_rows=12).fit(u, y)


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_dask_frames_are_read_by_all_weightings(rng, weighting):
    dd = pytest.importorskip("dask.dataframe")
    X, Y = frames(*disturbed(rng, 2, 1, 1).simulate(rng, 600)[:2])
    parts = [dd.from_pandas(z, npartitions=3) for z in (X, Y)]
    model = MOESPRegressor(2, block_rows=6, weighting=weighting, disturbance_model=True)
    whole, parted = clone(model).fit(X, Y), clone(model).fit(*parts)
    for name in ("B", "K"):
        found, wanted = (impulse_response(each, matrix=name) for each in (parted, whole))
        np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())


def test_a_record_too_short_for_dynamics_has_a_gain_of_no_states(rng):
    u = rng.standard_normal((4, 1))
    with pytest.warns(ExcitationWarning, match="a static gain is fitted"):
        model = MOESPRegressor(disturbance_model=True).fit(u, 2.0 * u)
    assert model.kalman_gain_.shape == (0, 1)
    np.testing.assert_allclose(model.predict_ahead(u, 2.0 * u), 2.0 * u)
