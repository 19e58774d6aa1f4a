"""Choosing the order: scorers that simulate, scikit-learn's searches."""

import dataclasses
import pickle
from functools import partial

import numpy as np
import pandas as pd
import pytest
from conftest import heave_pipeline
from sklearn import config_context
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.exceptions import FitFailedWarning
from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - makes the next import work
from sklearn.frozen import FrozenEstimator
from sklearn.metrics import (
    max_error,
    mean_absolute_error,
    mean_squared_error,
    r2_score,
)
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    HalvingGridSearchCV,
    LeaveOneGroupOut,
    RandomizedSearchCV,
    TimeSeriesSplit,
    cross_val_predict,
    cross_val_score,
    cross_validate,
)
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import InstabilityWarning
from sklearn_hd.model_selection import (
    PeriodBlockSplit,
    fit_percent,
    fit_percent_scorer,
    simulation_scorer,
    smallest_within_one_standard_error,
)


@pytest.fixture(scope="module")
def ltp_records():
    return make_flapping_wing(
        "ltp", n_records=4, n_periods=40, start=5, width=6, samples_per_period=16, snr=20,
        random_state=1,
    )  # fmt: skip


def synchronous(omega, **kwargs):
    analyzer = HarmonicAnalyzer(omega, output_harmonics=3, reading="period", **kwargs)
    return Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(block_rows=4))])


def labels(data):
    return data.inputs.index.get_level_values("record")


# ---- scorers -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_r2_by_simulation_is_the_estimators_own_score(lti, ltp_records):
    scorer = simulation_scorer(r2_score)
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    assert scorer(model, lti.inputs, lti.outputs) == model.score(lti.inputs, lti.outputs)
    data = ltp_records
    pipe = synchronous(data.omega).fit(data.inputs, data.outputs)
    weight = np.linspace(0.0, 1.0, len(data.inputs))
    for estimator in (pipe, make_pipeline(pipe), FrozenEstimator(pipe), make_pipeline(*pipe)):
        assert scorer(estimator, data.inputs, data.outputs) == pipe.score(data.inputs, data.outputs)
        found = scorer(estimator, data.inputs, data.outputs, sample_weight=weight)
        assert found == pipe.score(data.inputs, data.outputs, sample_weight=weight)


@pytest.mark.slow
def test_raw_measurements_score_as_their_pipeline_does(nltp):
    """The periodic trim is taken from both, as in score."""
    pipe = heave_pipeline(nltp.omega, trim_span=nltp.trim_span, n_states=3)
    pipe.fit(nltp.inputs, nltp.outputs)
    found = simulation_scorer(r2_score)(pipe, nltp.inputs, nltp.outputs)
    assert found == pipe.score(nltp.inputs, nltp.outputs)


def test_starting_at_rest_spoils_a_fold_in_mid_record():
    """A slow, lightly damped system, tested from the middle of its motion."""
    rng = np.random.default_rng(0)
    turn = 0.999 * np.array([[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]])
    u = rng.standard_normal((1200, 1))
    x, y = np.zeros(2), np.empty(1200)
    for k in range(1200):
        y[k], x = x[1], turn @ x + [u[k, 0], 0.0]
    cv = TimeSeriesSplit(3)
    model = MOESPRegressor(order=2, block_rows=6)
    at_rest = cross_val_score(model, u, y, cv=cv, scoring="r2")
    simulated = cross_val_score(model, u, y, cv=cv, scoring=simulation_scorer(r2_score))
    np.testing.assert_array_equal(simulated, cross_val_score(model, u, y, cv=cv))
    assert simulated.min() > 1 - 1e-9
    assert at_rest.max() < 0.9


def test_errors_turn_their_sign_and_take_arguments(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    args = model, lti.inputs, lti.outputs
    error = simulation_scorer(mean_squared_error, greater_is_better=False)
    assert error(*args) < 0.0
    per_output = [
        simulation_scorer(mean_squared_error, multioutput=weights)(*args) for weights in np.eye(3)
    ]
    assert np.mean(per_output) == pytest.approx(-error(*args))


def test_one_output_reaches_the_metric_as_one_output(lti):
    """max_error takes no second dimension of more than one column; a Series gives none."""
    y = lti.outputs["w_0"]
    model = MOESPRegressor(order=3, block_rows=20).fit(lti.inputs, y)

    def shape(y_true, y_pred):
        assert y_true.shape == y_pred.shape
        return y_true.ndim

    assert simulation_scorer(shape)(model, lti.inputs, y) == 1.0
    assert simulation_scorer(max_error)(model, lti.inputs, y) > 0.0


def test_fit_percent_is_its_definition(rng):
    y = rng.standard_normal((50, 2)) + 3.0
    y_hat = y + 0.1 * rng.standard_normal((50, 2))
    fit = fit_percent(y, y_hat)
    error, spread = np.linalg.norm(y - y_hat, axis=0), np.linalg.norm(y - y.mean(axis=0), axis=0)
    np.testing.assert_allclose(fit, 100 * (1 - error / spread), rtol=1e-12)
    r2 = r2_score(y, y_hat, multioutput="raw_values")
    np.testing.assert_allclose(1 - (1 - fit / 100) ** 2, r2, rtol=1e-12)


def test_fit_percent_laws(rng):
    y, y_hat = rng.standard_normal((2, 60))
    fit = fit_percent(y, y_hat)
    assert fit.shape == (1,)
    assert fit_percent(y, y)[0] == 100.0
    assert fit_percent(y, np.full(60, y.mean()))[0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(fit_percent(7.0 * y + 2.0, 7.0 * y_hat + 2.0), fit)
    doubled = fit_percent(np.r_[y, y[:20]], np.r_[y_hat, y_hat[:20]])
    weight = np.r_[np.full(20, 2.0), np.ones(40)]
    np.testing.assert_allclose(fit_percent(y, y_hat, sample_weight=weight), doubled)
    constant = np.ones((5, 2))
    np.testing.assert_array_equal(
        fit_percent(constant, constant + np.array([0.0, 1.0])), [100.0, 0.0]
    )
    frame, series = pd.DataFrame({"w": y}), pd.Series(y_hat)
    np.testing.assert_array_equal(fit_percent(frame, series.to_frame()), fit)


def test_fit_percent_of_sizes_whose_squares_are_no_numbers():
    np.testing.assert_allclose(fit_percent([[1e300], [0.0]], [[0.0], [1.0]]), 100 * (1 - 2**0.5))
    np.testing.assert_allclose(fit_percent([[1e-320], [0.0]], [[0.0], [1e-320]]), -100.0)
    np.testing.assert_allclose(fit_percent([[1.0], [0.0]], [[0.0], [1e200]]), -(2**0.5) * 1e202)
    assert fit_percent([[1e-150], [0.0]], [[0.0], [1e200]]) == -np.inf
    with pytest.raises(ValueError, match="sample_weight holds values that are not numbers"):
        fit_percent([[1.0], [0.0]], [[0.0], [1.0]], sample_weight=[10**400, 1])
    with pytest.raises(ValueError, match="each of the 2 rows"):
        fit_percent([[1.0], [0.0]], [[0.0], [1.0]], sample_weight=[np.inf, 1])


def test_fit_percent_scorer_means_or_picks(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    args = model, lti.inputs, lti.outputs
    one_by_one = [fit_percent_scorer(i)(*args) for i in range(3)]
    by_name = [fit_percent_scorer(name)(*args) for name in lti.outputs.columns]
    assert one_by_one == by_name
    assert fit_percent_scorer()(*args) == pytest.approx(np.mean(one_by_one))
    r2 = simulation_scorer(r2_score, multioutput=[0.0, 1.0, 0.0])(*args)
    assert one_by_one[1] == pytest.approx(100 * (1 - np.sqrt(1 - r2)))
    # noise of 1/20 of the clean signal leaves 1 − 1/20 of the fit to a perfect model
    assert 94.0 < fit_percent_scorer()(*args) < 95.5


@pytest.mark.parametrize("scorer", [fit_percent_scorer, partial(simulation_scorer, r2_score)])
def test_weights_are_routed_to_scorers_that_ask_for_them(lti, scorer):
    model, cv = MOESPRegressor(order=2, block_rows=8), TimeSeriesSplit(3)
    weight = np.linspace(1.0, 3.0, len(lti.inputs))
    with config_context(enable_metadata_routing=True):
        scored = partial(cross_val_score, model, lti.inputs, lti.outputs, cv=cv)
        plain = scored(scoring=scorer(), params={})
        weighted = partial(scored, params={"sample_weight": weight})
        scores = weighted(scoring=scorer().set_score_request(sample_weight=True))
        with pytest.raises(ValueError, match=r"_scorer\(.*set_score_request\(.*=True/False"):
            weighted(scoring=scorer())
        with pytest.raises(TypeError, match="not routed to any object"):
            weighted(scoring=simulation_scorer(max_error))
    for (train, test), score, without in zip(cv.split(weight), scores, plain, strict=True):
        model.fit(lti.inputs.iloc[train], lti.outputs.iloc[train])
        rows = lti.inputs.iloc[test], lti.outputs.iloc[test]
        assert scorer()(model, *rows, sample_weight=weight[test]) == score != without


def test_scorers_print_and_pickle(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    error = simulation_scorer(mean_absolute_error, greater_is_better=False, multioutput=[1, 0, 0])
    assert repr(error) == (
        "simulation_scorer(mean_absolute_error, greater_is_better=False, multioutput=[1, 0, 0])"
    )
    assert repr(fit_percent_scorer("w_0")) == "fit_percent_scorer(output='w_0')"
    for scorer in (error, fit_percent_scorer("w_0")):
        again = pickle.loads(pickle.dumps(scorer))
        assert again(model, lti.inputs, lti.outputs) == scorer(model, lti.inputs, lti.outputs)


def test_scorers_word_what_is_wrong(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    args = model, lti.inputs, lti.outputs
    with pytest.raises(ValueError, match="metric='r2' is not callable; give a function such as"):
        simulation_scorer("r2")
    with pytest.raises(TypeError, match="PCA does not end in a model step of sklearn_hd"):
        simulation_scorer(r2_score)(PCA(), lti.inputs, lti.outputs)
    with pytest.raises(
        TypeError, match="sample_weight was given, but max_error does not accept it"
    ):
        simulation_scorer(max_error)(*args, sample_weight=np.ones(len(lti.inputs)))
    for output in ("phi_dot", 3, -1, True, 0.5):
        with pytest.raises(ValueError, match=r"is not among the outputs \['w_0', 'phi_dot_1c'"):
            fit_percent_scorer(output)(*args)
    y = np.zeros((4, 2))
    with pytest.raises(ValueError, match=r"y_true has shape \(4, 2\) and y_pred \(4,\)"):
        fit_percent(y, y[:, 0])
    with pytest.raises(ValueError, match="y_pred is not finite in row 1, output 1"):
        fit_percent(y, np.where(np.arange(8).reshape(4, 2) == 3, np.nan, y))
    with pytest.raises(ValueError, match="have different indices; align them first"):
        fit_percent(pd.Series([1.0, 2.0]), pd.Series([1.0, 2.0], index=[1, 2]))
    with pytest.raises(ValueError, match=r"sample_weight has shape \(3,\); give one .* 4 rows"):
        fit_percent(y, y, sample_weight=np.ones(3))
    with pytest.raises(ValueError, match="sample_weight is zero on all 4 rows; give some"):
        fit_percent(y, y, sample_weight=np.zeros(4))


# ---- scikit-learn's searches ---------------------------------------------------------------------


@pytest.mark.slow
def test_grid_search_over_period_blocks(lti):
    search = GridSearchCV(
        MOESPRegressor(),
        {"order": [1, 2, 3, 4, 5], "block_rows": [8, 12]},
        cv=PeriodBlockSplit(4, omega=lti.omega),
        refit=smallest_within_one_standard_error,
        n_jobs=2,
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_["order"] == 3
    assert search.best_estimator_.order_ == 3
    assert not hasattr(search, "best_score_")  # scikit-learn's way with a callable refit
    assert clone(search).refit is smallest_within_one_standard_error


@pytest.mark.parametrize(
    "grid",
    [
        [{"order": [2, 3, 4], "block_rows": [8]}, {"order": [3, 5]}],
        {"order": [2, 3, 4], "block_rows": [None, 14]},
    ],
)
def test_grids_whose_candidates_leave_something_open(lti, grid):
    search = GridSearchCV(
        MOESPRegressor(),
        grid,
        cv=PeriodBlockSplit(3, omega=lti.omega),
        refit=smallest_within_one_standard_error,
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_["order"] == 3


def test_grid_search_with_several_metrics(lti):
    search = GridSearchCV(
        MOESPRegressor(block_rows=8),
        {"order": [2, 3, 4]},
        cv=TimeSeriesSplit(3),
        scoring={"fit": fit_percent_scorer(), "r2": simulation_scorer(r2_score)},
        refit=partial(smallest_within_one_standard_error, metric="fit"),
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_ == {"order": 3}
    assert search.best_index_ == 1


@pytest.mark.parametrize("cv", [GroupKFold(2), LeaveOneGroupOut()])
@pytest.mark.slow
def test_grid_search_over_whole_records(ltp_records, cv):
    data = ltp_records
    search = GridSearchCV(
        synchronous(data.omega),
        {"identify__order": [1, 2, 3]},
        cv=cv,
        refit=smallest_within_one_standard_error,
    ).fit(data.inputs, data.outputs, groups=labels(data))
    assert search.best_params_["identify__order"] == 2
    assert simulation_scorer(r2_score)(search, data.inputs, data.outputs) == search.score(
        data.inputs, data.outputs
    )


def test_randomized_search_and_nested_cross_validation(lti):
    search = RandomizedSearchCV(
        MOESPRegressor(),
        {"order": [2, 3, 4], "block_rows": [6, 8, 10]},
        n_iter=4,
        cv=TimeSeriesSplit(3),
        refit=smallest_within_one_standard_error,
        random_state=2,
    )
    outer = PeriodBlockSplit(2, omega=lti.omega)
    found = cross_validate(
        search, lti.inputs, lti.outputs, cv=outer, scoring=fit_percent_scorer(),
        return_estimator=True,
    )  # fmt: skip
    assert [s.best_params_["order"] for s in found["estimator"]] == [3, 3]
    assert found["test_score"].min() > 93.0


def test_cross_val_predict_takes_the_splitter(lti):
    predicted = cross_val_predict(
        MOESPRegressor(order=3, block_rows=8), lti.inputs, lti.outputs,
        cv=PeriodBlockSplit(3, omega=lti.omega),
    )  # fmt: skip
    assert predicted.shape == lti.outputs.shape
    assert np.isfinite(predicted).all()


@pytest.mark.slow
def test_raw_measurements_keep_their_trim_in_every_fold():
    data = make_flapping_wing(
        "nltp", input="3211", width=4, n_periods=80, samples_per_period=32, amplitude=0.005, snr=20,
        random_state=0,
    )  # fmt: skip
    pipe = synchronous(data.omega, trim_span=data.trim_span).set_params(identify__order=2)
    with_trim = PeriodBlockSplit(4, omega=data.omega, trim_span=data.trim_span)
    assert cross_val_score(pipe, data.inputs, data.outputs, cv=with_trim).min() > 0.9
    without = PeriodBlockSplit(4, omega=data.omega)
    with pytest.raises(ValueError, match="holds less than one whole period"):
        cross_val_score(pipe, data.inputs, data.outputs, cv=without, error_score="raise")


@pytest.mark.filterwarnings("ignore:One or more of the test scores are non-finite")
def test_one_failing_corner_of_a_grid_does_not_end_a_search(lti):
    search = GridSearchCV(
        MOESPRegressor(),
        {"order": [2, 3, 25], "block_rows": [8, 12]},  # order 25 exceeds what 8 allow
        cv=PeriodBlockSplit(3, omega=lti.omega),
        refit=smallest_within_one_standard_error,
    )
    with pytest.warns(FitFailedWarning) as told:
        search.fit(lti.inputs, lti.outputs)
    assert search.best_params_["order"] == 3
    passed_over = "1 of 6 candidates failed on some fold: {'block_rows': 8, '"
    assert str(told[-1].message).startswith(passed_over)


TOO_LARGE = "ValueError: order=40 exceeds the rank bound 21 of block_rows=8 with 3 output columns"
SPLIT = "fits failed with the following error:\n"


@pytest.mark.parametrize(
    ("pipeline", "prefix"), [(False, "order"), (True, "moespregressor__order")]
)
@pytest.mark.filterwarnings("ignore:One or more of the test scores are non-finite")
def test_a_search_says_why_fits_failed_before_their_tracebacks(lti, pipeline, prefix):
    model = MOESPRegressor(block_rows=8)
    model = make_pipeline(FunctionTransformer(), model) if pipeline else model
    search = GridSearchCV(model, {prefix: [40, 41]}, cv=PeriodBlockSplit(3, omega=lti.omega))
    with pytest.raises(ValueError, match="All the 6 fits failed") as raised:
        search.fit(lti.inputs, lti.outputs)
    first, second = str(raised.value).split(SPLIT)[1:]
    assert first.startswith(TOO_LARGE)
    assert second.startswith(TOO_LARGE.replace("40", "41"))
    assert "in check_rank_bound" in first  # and where, after that
    search.set_params(param_grid={prefix: [3, 40]})
    with pytest.warns(FitFailedWarning) as warned:
        search.fit(lti.inputs, lti.outputs)
    assert str(warned[0].message).split(SPLIT)[1].startswith(TOO_LARGE)


def test_outside_searches_an_error_is_said_once(lti):
    with pytest.raises(ValueError, match="exceeds the rank bound") as raised:
        MOESPRegressor(order=40, block_rows=8).fit(lti.inputs, lti.outputs)
    assert raised.value.__cause__ is None


@pytest.mark.slow
def test_the_grid_of_sliding_windows_in_the_docs_runs():
    """docs/choosing.md states it in words; with its data, and no warning of a failed fit."""
    data = make_flapping_wing(
        "ltp", input="3211", width=4, n_periods=120, samples_per_period=16, snr=20, random_state=0
    )
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(data.omega, reading="sliding", output_harmonics=2)),
            ("identify", MOESPRegressor()),
        ]
    )
    grid = {"identify__order": [16, 20, 24], "identify__block_rows": [18, 26]}
    cv = PeriodBlockSplit(3, omega=data.omega)
    search = GridSearchCV(pipe, grid, cv=cv).fit(data.inputs, data.outputs)
    assert search.best_score_ > 0.9
    with pytest.raises(ValueError, match="block_rows=4 must exceed the 8 rows in the analysis win"):
        search.set_params(param_grid={"identify__block_rows": [4, 6]}).fit(
            data.inputs, data.outputs
        )


class Growing(MOESPRegressor):
    """Models of more than three states grow, as some do that noise has made."""

    def fit(self, X, y):
        super().fit(X, y)
        if self.order > 3:
            A = np.diag(np.full(self.order, 4.0))
            self.model_ = dataclasses.replace(self.model_, A=A)
        return self


@pytest.mark.filterwarnings("ignore:One or more of the test scores are non-finite")
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # std of -inf
def test_searches_pass_over_models_that_grow(lti):
    search = GridSearchCV(
        Growing(block_rows=8),
        {"order": [3, 4, 5]},
        cv=PeriodBlockSplit(2, omega=lti.omega),
        error_score="raise",
        refit=smallest_within_one_standard_error,
    )
    with pytest.warns(InstabilityWarning, match="a Growing scores -inf: its model is unstable"):
        search.fit(lti.inputs, lti.outputs)
    means = search.cv_results_["mean_test_score"]
    assert means[0] > 0.9
    assert means[1:].tolist() == [-np.inf, -np.inf]
    assert search.best_params_ == {"order": 3}
    search.set_params(refit=True)
    with pytest.warns(InstabilityWarning):
        assert search.fit(lti.inputs, lti.outputs).best_params_ == {"order": 3}


def test_halving_over_block_rows_works(lti):
    search = HalvingGridSearchCV(
        MOESPRegressor(),
        {"order": [1, 2, 3]},
        resource="block_rows",
        min_resources=4,
        max_resources=12,
        cv=PeriodBlockSplit(3, omega=lti.omega),
        factor=3,
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_ == {"order": 3, "block_rows": 12}


@pytest.mark.parametrize("harmonics", [False, True])
@pytest.mark.parametrize("blocks", [False, True])
def test_halving_over_rows_ends_in_an_error_about_time(lti, ltp_records, harmonics, blocks):
    """Its subsamples are rows at random, in random order."""
    if harmonics:
        data = ltp_records.inputs.loc[0], ltp_records.outputs.loc[0]
        omega, prefix = ltp_records.omega, "identify__"
        estimator = synchronous(omega)
    else:
        data, omega, prefix, estimator = (lti.inputs, lti.outputs), lti.omega, "", MOESPRegressor()
    search = HalvingGridSearchCV(
        estimator,
        {f"{prefix}order": [1, 2, 3, 4]},
        cv=PeriodBlockSplit(3, omega=omega) if blocks else TimeSeriesSplit(3),
        min_resources=200,
        random_state=0,
    )
    with pytest.raises(ValueError, match="time must increase within a record"):
        search.fit(*data)


def test_columns_made_before_the_analyzer_are_scored_too(ltp_records):
    data = ltp_records
    pipe = Pipeline(
        [("double", FunctionTransformer(lambda u: 2.0 * u)), *synchronous(data.omega).steps]
    )
    pipe.fit(data.inputs, data.outputs)
    assert simulation_scorer(r2_score)(pipe, data.inputs, data.outputs) == pipe.score(
        data.inputs, data.outputs
    )
