"""Habits of scikit-learn and its neighbours that users bring along."""

import pickle
import warnings

import control
import joblib
import numpy as np
import pandas as pd
import pytest
from conftest import KEPT, heave_pipeline
from periodic_cases import mathieu, record, synchronous
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.inspection import permutation_importance
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    RandomizedSearchCV,
    TimeSeriesSplit,
    cross_val_predict,
    cross_val_score,
    validation_curve,
)
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import FunctionTransformer, MinMaxScaler, StandardScaler

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicFrame,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing


@pytest.fixture(scope="module")
def short():
    """Three noisy doublet records of sixty periods."""
    return make_flapping_wing("ltp", n_records=3, n_periods=60, start=5, snr=50, random_state=7)


@pytest.fixture(scope="module")
def groups(short):
    return short.inputs.index.get_level_values("record")


@pytest.fixture(scope="module")
def fitted(short):
    steps = heave_pipeline(short.omega, n_states=3).steps
    pipe = Pipeline([*steps, ("match", StructuredMatcher())])
    return pipe.fit(short.inputs, short.outputs)


@pytest.mark.slow
def test_scalers_and_functions_before_the_analyzer(short, fitted):
    """A change of the inputs' units before the analyzer changes B alone."""
    for step in (
        FunctionTransformer(lambda u: u * 1e3).set_output(transform="pandas"),
        StandardScaler(with_mean=False).set_output(transform="pandas"),
    ):
        pipe = clone(fitted)
        pipe.steps.insert(0, ("units", step))
        pipe.fit(short.inputs, short.outputs)
        assert pipe.score(short.inputs, short.outputs) == pytest.approx(
            fitted.score(short.inputs, short.outputs), abs=1e-9
        )


@pytest.mark.parametrize("shift", [0.5, -1e-3, 0.0])
@pytest.mark.parametrize("analyzed", [True, False])
def test_inputs_that_were_shifted_from_rest_are_told(short, analyzed, shift):
    """A linear model rests where its inputs are zero: R² fell from 0.996 to 0.845."""
    u, y = short.inputs, short.outputs
    steps = [("shift", FunctionTransformer(lambda u: u + shift * np.ptp(short.inputs)))]
    if analyzed:
        steps += [("harmonics", HarmonicAnalyzer(short.omega, reading="period"))]
    pipe = Pipeline([*steps, ("identify", MOESPRegressor(order=2))])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pipe.fit(u, y)
    told = [str(w.message) for w in told if "begin with outputs at rest" in str(w.message)]
    assert len(told) == (shift != 0.0)
    assert all("('U' at " in text for text in told)


def test_a_trim_span_takes_away_what_a_scaler_shifts(short):
    u, y = short.inputs, short.outputs
    analyzer = HarmonicAnalyzer(short.omega, reading="period", trim_span=short.trim_span)
    scaler = MinMaxScaler().set_output(transform="pandas")
    scaled = Pipeline([("a", scaler), ("b", clone(analyzer)), ("c", MOESPRegressor(order=2))])
    plain = Pipeline([("b", analyzer), ("c", MOESPRegressor(order=2))])
    assert scaled.fit(u, y).score(u, y) == pytest.approx(plain.fit(u, y).score(u, y), abs=1e-4)


def test_a_scaler_behind_the_analyzer_is_refused(short):
    steps = heave_pipeline(short.omega).steps
    steps.insert(1, ("units", StandardScaler().set_output(transform="pandas")))
    steps[0][1].set_params(input_harmonics=1)
    with pytest.raises(ValueError, match="dropped it"):
        Pipeline(steps).fit(short.inputs, short.outputs)


def test_pandas_output_keeps_the_model(short, fitted):
    pipe = clone(fitted).set_output(transform="pandas").fit(short.inputs, short.outputs)
    np.testing.assert_array_equal(pipe["match"].model_.A, fitted["match"].model_.A)
    frame = pipe[:3].transform(short.inputs)
    assert isinstance(frame, HarmonicFrame)
    assert frame.model is pipe["reduce"].model_


def test_containers_that_would_drop_the_model_are_refused():
    for step in (
        HarmonicAnalyzer(1.0),
        MOESPRegressor(),
        SpuriousModeReducer(),
        StructuredMatcher(),
    ):
        with pytest.raises(
            ValueError,
            match=r"'polars' is not 'pandas', 'default' or None: no other container",
        ):
            step.set_output(transform="polars")
        assert step.set_output(transform="pandas") is step
        assert step.set_output(transform=None) is step


def test_html_shows_the_steps(fitted):
    html = fitted._repr_html_()
    for name in ("HarmonicAnalyzer", "MOESPRegressor", "SpuriousModeReducer", "StructuredMatcher"):
        assert name in html


@pytest.mark.slow
def test_randomized_search_and_two_processes(short, groups):
    pipe = heave_pipeline(short.omega, n_states=3)
    search = RandomizedSearchCV(
        pipe,
        {"identify__order": [12, 16, 18], "harmonics__window": ["boxcar", "centred-boxcar"]},
        n_iter=3,
        cv=GroupKFold(3),
        n_jobs=2,
        random_state=0,
    ).fit(short.inputs, short.outputs, groups=groups)
    assert search.best_score_ > 0.98
    one = clone(search).set_params(n_jobs=1).fit(short.inputs, short.outputs, groups=groups)
    np.testing.assert_allclose(
        one.cv_results_["mean_test_score"], search.cv_results_["mean_test_score"], rtol=1e-6
    )


@pytest.mark.slow
def test_time_series_split_on_one_long_record():
    data = make_flapping_wing("ltp", input="3211", n_periods=160, width=4)
    pipe = heave_pipeline(data.omega, n_states=3)
    scores = cross_val_score(pipe, data.inputs, data.outputs, cv=TimeSeriesSplit(3))
    assert scores.min() > 0.98


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_cross_val_predict_mirrors_the_rows(short, groups):
    pipe = heave_pipeline(short.omega, n_states=3)
    predicted = cross_val_predict(
        pipe, short.inputs, short.outputs, groups=groups, cv=GroupKFold(3)
    )
    assert predicted.shape == short.outputs.shape
    rest = short.outputs.to_numpy() - predicted
    assert 1 - np.var(rest) / np.var(short.outputs.to_numpy()) > 0.98


@pytest.mark.slow
def test_validation_curve_over_the_order(short, groups):
    pipe = heave_pipeline(short.omega, n_states=3)
    _, test = validation_curve(
        pipe,
        short.inputs,
        short.outputs,
        param_name="identify__order",
        param_range=[10, 16],
        groups=groups,
        cv=GroupKFold(2),
    )
    assert test.shape == (2, 2)
    assert np.isfinite(test).all()


def test_permutation_importance_of_an_input_channel(rng):
    u = rng.standard_normal((400, 2))
    y = np.zeros(400)
    for k in range(399):
        y[k + 1] = 0.7 * y[k] + u[k, 0]
    model = MOESPRegressor(order=1, block_rows=5).fit(u, y)
    importance = permutation_importance(model, u, y, n_repeats=2, random_state=0)
    assert importance.importances_mean[0] > 1.0
    assert abs(importance.importances_mean[1]) < 1e-6


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_permutation_importance_through_a_pipeline(short, rng):
    """The command explains the outputs, a column of noise beside it nothing."""
    u = short.inputs.assign(noise=rng.standard_normal(len(short.inputs)))
    pipe = heave_pipeline(short.omega, n_states=3).fit(u, short.outputs)
    importance = permutation_importance(pipe, u, short.outputs, n_repeats=2, random_state=0)
    assert importance.importances_mean[0] > 0.9
    assert abs(importance.importances_mean[1]) < 1e-4


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_frozen_models_are_not_fitted_again(short):
    u, y = short.inputs, short.outputs
    analyzer = HarmonicAnalyzer(short.omega, output_harmonics=KEPT, hop=8)
    inner = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(order=16))]).fit(u, y)
    reducer = SpuriousModeReducer(FrozenEstimator(inner), n_states=3).fit(u, y)
    assert reducer.estimator_.estimator is inner
    matcher = StructuredMatcher(FrozenEstimator(reducer)).fit(u, y)
    np.testing.assert_array_equal(matcher.model_.A, reducer.model_.A)


@pytest.mark.slow
def test_system_goes_straight_into_python_control(fitted):
    system = fitted["match"].system_
    assert system.ninputs == 1
    response = control.step_response(system, np.linspace(0, 1, 200))
    assert np.isfinite(response.outputs).all()
    magnitude = control.frequency_response(system, [1.0, 100.0]).magnitude
    assert np.isfinite(magnitude).all()
    reduced = control.balred(system, 2, method="truncate")
    assert reduced.nstates == 2
    gain, _, poles = control.lqr(system, np.eye(3), [[1e6]])
    assert gain.shape == (1, 3)
    assert poles.real.max() < 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import matplotlib as mpl

        mpl.use("Agg")
        control.bode_plot(system, [1.0, 10.0])


def test_skops_saves_and_loads_without_pickle(tmp_path, fitted, short):
    skops = pytest.importorskip("skops.io")
    path = tmp_path / "pipe.skops"
    skops.dump(fitted, path)
    trusted = skops.get_untrusted_types(file=path)
    assert set(trusted) <= {
        "sklearn_hd._excitation.Excitation",
        "sklearn_hd._excitation.Information",
        "sklearn_hd.algorithms.signals.fourier.InputDirections",
        "sklearn_hd._opinion.Opinion",
        "sklearn_hd._readings.basis.SlidingBasis",
        "sklearn_hd._frame.LTIModel",
        "sklearn_hd._match.Match",
        "sklearn_hd._readings.basis.Timing",
        "sklearn_hd.harmonics.HarmonicAnalyzer",
        "sklearn_hd.matching.StructuredMatcher",
        "sklearn_hd.reduction.SpuriousModeReducer",
        "sklearn_hd.subspace.MOESPRegressor",
    }
    loaded = skops.load(path, trusted=trusted)
    pd.testing.assert_frame_equal(loaded.predict(short.inputs), fitted.predict(short.inputs))


@pytest.mark.slow
def test_skops_keeps_a_structure(tmp_path, short):
    skops = pytest.importorskip("skops.io")
    names = ["w_0", "phi_dot_1c", "phi_dot_1s"]
    structure = MatrixStructure(
        np.full((3, 3), np.nan),
        [["b"], [np.nan], ["-b/2"]],
        state_names=names,
        fixed={"b": 0.0},
        bounds={"A[w_0,w_0]": (None, 0.0)},
    )
    steps = heave_pipeline(short.omega, n_states=3).steps
    pipe = Pipeline([*steps, ("match", StructuredMatcher(structure=structure))])
    pipe.fit(short.inputs, short.outputs)
    path = tmp_path / "pipe.skops"
    skops.dump(pipe, path)
    trusted = skops.get_untrusted_types(file=path)
    assert set(trusted) == {
        "sklearn_hd._excitation.Excitation",
        "sklearn_hd._excitation.Information",
        "sklearn_hd.algorithms.signals.fourier.InputDirections",
        "sklearn_hd._opinion.Opinion",
        "sklearn_hd._readings.basis.SlidingBasis",
        "sklearn_hd._frame.LTIModel",
        "sklearn_hd._match.Match",
        "sklearn_hd.algorithms.matching.matching.MatchResult",
        "sklearn_hd.algorithms.matching.smooth_peak.Certificate",
        "sklearn_hd._readings.basis.Timing",
        "sklearn_hd.harmonics.HarmonicAnalyzer",
        "sklearn_hd.structures._matrix.MatrixStructure",
        "sklearn_hd.matching.StructuredMatcher",
        "sklearn_hd.reduction.SpuriousModeReducer",
        "sklearn_hd.subspace.MOESPRegressor",
    }
    loaded = skops.load(path, trusted=trusted)
    assert loaded["match"].structure == structure
    pd.testing.assert_series_equal(loaded["match"].theta_, pipe["match"].theta_)
    pd.testing.assert_frame_equal(loaded.predict(short.inputs), pipe.predict(short.inputs))


@pytest.mark.slow
def test_all_records_from_one_csv_file(tmp_path, short, fitted):
    """The one line of docs/guide/1_data.md, for several records."""
    pd.concat([short.inputs, short.outputs], axis=1).to_csv(tmp_path / "flights.csv")
    flights = pd.read_csv(tmp_path / "flights.csv", index_col=["record", "time"])
    u, y = flights[["U"]], flights[["w", "phi_dot"]]
    assert fitted.score(u, y) == pytest.approx(fitted.score(short.inputs, short.outputs), abs=1e-12)
    again = clone(fitted).fit(u, y)
    np.testing.assert_allclose(again["match"].model_.A, fitted["match"].model_.A, rtol=1e-6)


@pytest.mark.slow
def test_parquet_files_keep_index_and_types(tmp_path, short, fitted):
    pytest.importorskip("pyarrow")
    path = tmp_path / "flights.parquet"
    pd.concat([short.inputs, short.outputs.astype("float32")], axis=1).to_parquet(path)
    flights = pd.read_parquet(path)
    pd.testing.assert_frame_equal(flights[["U"]], short.inputs)
    again = clone(fitted).fit(flights[["U"]], flights[["w", "phi_dot"]])
    predicted = again.predict(flights[["U"]])
    assert predicted.dtypes.astype(str).tolist() == ["float32", "float32"]
    pd.testing.assert_index_equal(predicted.index, short.inputs.index)
    np.testing.assert_allclose(predicted, fitted.predict(short.inputs), atol=1e-3)
    arrow = pd.read_parquet(path, dtype_backend="pyarrow")
    backed = clone(fitted).fit(arrow[["U"]], arrow[["w", "phi_dot"]]).predict(arrow[["U"]])
    assert backed.dtypes.astype(str).tolist() == ["float[pyarrow]", "float[pyarrow]"]
    np.testing.assert_array_equal(backed.to_numpy(dtype="float32"), predicted.to_numpy())


@pytest.fixture(scope="module", params=["hinf", "output_error"])
def periodic(request):
    """A periodic model in either criterion, and the record that it comes from."""
    u, y = record(mathieu(), n_periods=30, noise=0.01)
    structure = HarmonicStructure(F={"0": [[0, 1], ["-a", "-d"]], "1c": [[0, 0], ["q", 0]]}, G=0)
    pipe = synchronous(2.0, structure, order=2, criterion=request.param)
    return pipe.fit(u, y), u, y


@pytest.mark.slow
def test_periodic_models_clone_pickle_and_hash(periodic):
    pipe, u, y = periodic
    twin, again = pickle.loads(pickle.dumps(pipe)), clone(pipe).fit(u, y)
    assert again["match"].structure == pipe["match"].structure
    for other in (twin, again):
        pd.testing.assert_frame_equal(other.predict(u), pipe.predict(u))
        pd.testing.assert_series_equal(other["match"].theta_std_, pipe["match"].theta_std_)
        np.testing.assert_array_equal(
            other["match"].ltp_.F.coefficients, pipe["match"].ltp_.F.coefficients
        )
    assert joblib.hash(clone(pipe)) == joblib.hash(clone(twin))


def test_skops_saves_periodic_models(tmp_path, periodic):
    skops = pytest.importorskip("skops.io")
    pipe, u, _ = periodic
    path = tmp_path / "pipe.skops"
    skops.dump(pipe, path)
    trusted = skops.get_untrusted_types(file=path)
    expected = {
        "sklearn_hd._readings.basis.PeriodBasis",
        "sklearn_hd._excitation.Excitation",
        "sklearn_hd._excitation.Information",
        "sklearn_hd.algorithms.signals.fourier.InputDirections",
        "sklearn_hd._frame.Lifted",
        "sklearn_hd._frame.LTIModel",
        "sklearn_hd._readings.basis.Timing",
        "sklearn_hd._match.Match",
        "sklearn_hd._match.PeriodicModel",
        "sklearn_hd._opinion.Opinion",
        "sklearn_hd.harmonics.HarmonicAnalyzer",
        "sklearn_hd.matching.StructuredMatcher",
        "sklearn_hd.structures._harmonic.HarmonicStructure",
        "sklearn_hd.subspace.MOESPRegressor",
    }
    if pipe["match"].criterion == "output_error":
        expected |= {
            "sklearn_hd._match.Uncertainty",
            "sklearn_hd._frame.SampleModel",
            "sklearn_hd.algorithms.lti.structured_model.AffineStructure",
            "sklearn_hd.algorithms.periodic.periodic_innovations.PeriodicInnovations",
        }
    assert set(trusted) == expected
    loaded = skops.load(path, trusted=trusted)
    pd.testing.assert_frame_equal(loaded.predict(u), pipe.predict(u))
    pd.testing.assert_series_equal(loaded["match"].theta_std_, pipe["match"].theta_std_)
    assert loaded["match"].structure == pipe["match"].structure


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.slow
def test_grid_search_over_structures_and_harmonics(periodic):
    _, u, y = periodic
    halves = np.arange(len(u)) < len(u) // 2
    search = GridSearchCV(
        synchronous(2.0, order=2),
        {"match__structure": [HarmonicStructure(F=1, G=0), HarmonicStructure(F=0, G=0)]},
        cv=[(np.flatnonzero(halves), np.flatnonzero(~halves))],
        error_score="raise",
    ).fit(u, y)
    assert search.best_params_["match__structure"] == HarmonicStructure(F=1, G=0)
    assert search.best_score_ > 0.9


@pytest.mark.slow
def test_periodic_models_in_two_processes(periodic):
    """Structure, criterion and noise of the inputs are values of a grid like any other."""
    pipe, u, y = periodic
    rows = np.arange(len(u))
    search = GridSearchCV(
        pipe,
        [
            {"match__criterion": ["hinf"], "match__input_noise": [None]},
            {"match__criterion": ["output_error"], "match__input_noise": [None, {"u1": 0.01}]},
        ],
        cv=[(rows, rows)],
        n_jobs=2,
        error_score="raise",
    ).fit(u, y)
    one = clone(search).set_params(n_jobs=1).fit(u, y)
    scores = search.cv_results_["mean_test_score"]
    np.testing.assert_allclose(scores, one.cv_results_["mean_test_score"], rtol=1e-9)
    assert scores.min() > 0.99


@pytest.mark.slow
def test_memory_tells_the_options_of_a_synchronous_analysis_apart(tmp_path):
    """A cache that took one for the other would hand on the wrong records."""
    u, y = record(mathieu(), n_periods=30, noise=0.01)
    pair = pd.concat({0: u, 1: -u}, names=["record"])
    outputs = pd.concat({0: y + 0.1 * y**2, 1: -y + 0.1 * y**2}, names=["record"])
    for how in (None, "odd", None, "odd"):
        pipe = synchronous(2.0, order=2, analyzer={"small_signal": how})
        plain = clone(pipe).fit(pair, outputs)
        pipe.set_params(memory=str(tmp_path)).fit(pair, outputs)
        pd.testing.assert_series_equal(pipe["match"].theta_, plain["match"].theta_)
        assert pipe["harmonics"].basis_.small_signal == how


def test_records_from_a_csv_file(tmp_path, short, fitted):
    record = pd.concat([short.inputs.loc[0], short.outputs.loc[0]], axis=1)
    record.to_csv(tmp_path / "flight.csv")
    flight = pd.read_csv(tmp_path / "flight.csv", index_col="time")
    predicted = fitted.predict(flight[["U"]])
    pd.testing.assert_frame_equal(predicted, fitted.predict(short.inputs.loc[0]), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_two_records_equal_one_only_where_they_should(short):
    """The same record twice gives the model of one; another record moves it."""
    u, y = short.inputs.loc[0], short.outputs.loc[0]
    pipe = heave_pipeline(short.omega, n_states=3)
    pipe["identify"].set_params(order=16)
    one = clone(pipe).fit(u, y)["identify"].eigenvalues_
    twice = clone(pipe).fit(pd.concat({0: u, 1: u}), pd.concat({0: y, 1: y}))["identify"]
    other = clone(pipe).fit(short.inputs.loc[[0, 1]], short.outputs.loc[[0, 1]])["identify"]
    near = np.abs(twice.eigenvalues_[:, None] - one).min(axis=1).max()
    far = np.abs(other.eigenvalues_[:, None] - one).min(axis=1).max()
    assert near < 1e-9
    assert far > 1e-4


def test_structures_survive_clone_and_grid(short, groups):
    structure = MatrixStructure(np.full((3, 3), np.nan), np.full((3, 1), np.nan))
    matcher = StructuredMatcher(structure=structure)
    assert clone(matcher).structure == structure


def test_columns_without_an_analyzer_keep_their_names(rng):
    t = np.arange(200) / 8.0
    u = pd.DataFrame({"throttle": rng.standard_normal(200)}, pd.Index(t, name="time"))
    step = MOESPRegressor(order=1).set_output(transform="pandas")
    step.fit(u, u.ewm(alpha=0.2).mean().rename(columns={"throttle": "speed"}))
    assert step.get_feature_names_out().tolist() == step.transform(u).columns.tolist()
    assert step.get_feature_names_out().tolist() == ["throttle"]
