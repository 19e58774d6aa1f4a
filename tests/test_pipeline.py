"""The literal flat Pipeline: what composes, what rides, what comes out."""

import pickle
import tracemalloc
import warnings

import control
import numpy as np
import pandas as pd
import pytest
from conftest import KEPT, heave_pipeline, random_stable, same_poles
from sklearn.base import clone
from sklearn.metrics import r2_score
from sklearn.model_selection import GridSearchCV, GroupKFold
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
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning

FREE_HEAVE = MatrixStructure(np.full((3, 3), np.nan), np.full((3, 1), np.nan))


def whole_pipeline(omega, **kwargs):
    pipe = heave_pipeline(omega, **kwargs)
    return Pipeline([*pipe.steps, ("match", StructuredMatcher(structure=FREE_HEAVE))])


def error(found, exact):
    return np.linalg.norm(found - exact) / np.linalg.norm(exact)


@pytest.fixture(scope="module")
def fitted(lti_signal):
    return whole_pipeline(lti_signal.omega).fit(lti_signal.inputs, lti_signal.outputs)


def test_every_part_of_the_pipeline_predicts_and_scores(fitted, lti_signal):
    u, y = lti_signal.inputs, lti_signal.outputs
    for stop, at_least in ((2, 0.9), (3, 1 - 1e-12), (4, 1 - 1e-12)):
        part = fitted[:stop]
        assert part.score(u, y) > at_least
        predicted = part.predict(u)
        assert predicted.index.equals(y.index)
        assert predicted.columns.tolist() == y.columns.tolist()
        assert np.isfinite(predicted.to_numpy()).all()


def test_matched_system_is_the_harmonic_decomposition(fitted, lti_signal):
    system = fitted["match"].system_
    assert isinstance(system, control.StateSpace)
    assert system.dt == 0
    assert system.state_labels == ["w_0", "phi_dot_1c", "phi_dot_1s"]
    assert system.output_labels == system.state_labels
    assert system.input_labels == ["U_0"]
    assert error(system.A, lti_signal.A_exact.to_numpy()) < 1e-8
    theta = fitted["match"].theta_
    assert theta["A[0,0]"] == pytest.approx(lti_signal.A_exact.iloc[0, 0], rel=1e-6)
    assert fitted["match"].hinf_error_relative_ < 1e-9


def test_modes_are_told_apart_without_the_truth(fitted, lti_signal):
    modes = fitted["reduce"].modes_
    assert modes["verdict"].value_counts().to_dict() == {"window": 8, "copy": 6, "genuine": 3}
    genuine = modes.loc[modes["verdict"] == "genuine", "eigenvalue"]
    assert same_poles(genuine, np.linalg.eigvals(lti_signal.A_exact), 1e-8)
    assert fitted["reduce"].r2_ == pytest.approx(1.0, abs=1e-12)


def test_clone_pickle_and_parameters(fitted, lti_signal):
    u = lti_signal.inputs.iloc[8000:9000]
    again = pickle.loads(pickle.dumps(fitted))
    pd.testing.assert_frame_equal(again.predict(u), fitted.predict(u))
    fresh = clone(fitted)
    assert fresh.get_params()["identify__order"] == "auto"
    fresh.set_params(identify__order=5, harmonics__hop=16)
    assert fresh["harmonics"].hop == 16


def test_memory_gives_the_same_model(tmp_path, fitted, lti_signal):
    pipe = clone(fitted).set_params(memory=str(tmp_path))
    for _ in range(2):
        pipe.fit(lti_signal.inputs, lti_signal.outputs)
        np.testing.assert_array_equal(pipe["match"].model_.A, fitted["match"].model_.A)


def test_passthrough_for_the_reducer_says_why_it_cannot(fitted, lti_signal):
    """A copy at half the rows' frequency is a negative real pole: no logarithm."""
    pipe = clone(fitted).set_params(reduce="passthrough", harmonics__hop=16)
    with pytest.raises(ValueError, match="closed negative real axis"):
        pipe.fit(lti_signal.inputs, lti_signal.outputs)


def test_passthrough_for_the_reducer_without_harmonics(rng):
    A, B, C = random_stable(rng, 3, 1, 3)
    A = A @ A  # no pole on the negative real axis
    u = rng.standard_normal((400, 1))
    y = propagate(A, u @ B.T, np.zeros(3)) @ C.T
    steps = [("identify", MOESPRegressor(order=3)), ("reduce", "passthrough")]
    pipe = Pipeline([*steps, ("match", StructuredMatcher())]).fit(u, y)
    assert pipe.score(u, y) > 1 - 1e-12
    assert same_poles(np.exp(pipe["match"].system_.poles()), np.linalg.eigvals(A), 1e-8)
    assert pipe["match"].theta_.size == 9 + 3 + 9 + 3


def test_zero_harmonics_of_a_unit_window_is_plain_moesp(rng):
    """Degenerate analyzer: one period is two samples, only the mean kept; against plain data."""
    A, B, C = random_stable(rng, 2, 1, 2)
    u = rng.standard_normal((300, 1))
    y = propagate(A, u @ B.T, np.zeros(2)) @ C.T
    plain = MOESPRegressor(order=2, block_rows=6).fit(u, y)
    assert same_poles(plain.eigenvalues_, np.linalg.eigvals(A), 1e-9)
    assert plain.system_.dt == 1.0


def test_several_records_fit_together():
    data = make_flapping_wing("lti-signal", n_records=2, random_state=3)
    pipe = heave_pipeline(data.omega).fit(data.inputs, data.outputs)
    assert same_poles(
        pipe["reduce"].system_.poles(), np.linalg.eigvals(data.A_exact.to_numpy()), 1e-6
    )
    assert pipe["identify"].x0_.shape == (2, pipe["identify"].order_)
    assert pipe.score(data.inputs, data.outputs) > 1 - 1e-9


@pytest.mark.slow
def test_nothing_crosses_a_gap_or_the_border_of_a_record(ltp):
    """A record cut in mid-motion, twice: the jump between the two must not move the model."""
    cut = slice(64 * 120, 64 * 150)
    u, y = ltp.inputs.iloc[cut], ltp.outputs.iloc[cut]
    assert np.abs(y.iloc[-1] - y.iloc[0]).max() > 0.1 * np.abs(y).to_numpy().max()
    later = u.index + 64 * 2 * np.pi / ltp.omega  # whole periods: the phase stays
    pipe = heave_pipeline(ltp.omega)[:2]
    pipe["identify"].set_params(order=16)
    once = clone(pipe).fit(u, y)["identify"].eigenvalues_
    once = once[np.abs(once) > 0.1]  # without the window's nilpotent memory, which rounding moves
    by_gap = [pd.concat([part, part.set_axis(later)]) for part in (u, y)]
    by_label = [pd.concat({0: part, 1: part}, names=["record"]) for part in (u, y)]
    for twice in (by_gap, by_label):
        found = clone(pipe).fit(*twice)["identify"].eigenvalues_
        assert np.abs(found[:, None] - once).min(axis=0).max() < 1e-8


@pytest.mark.slow
def test_grid_search_over_order_and_block_rows():
    data = make_flapping_wing("ltp", n_records=4, n_periods=60, start=5, random_state=1)
    pipe = heave_pipeline(data.omega, n_states=3)
    grid = {"identify__order": [8, 16], "identify__block_rows": [12, 18]}
    groups = data.inputs.index.get_level_values("record")
    search = GridSearchCV(pipe, grid, cv=GroupKFold(2)).fit(
        data.inputs, data.outputs, groups=groups
    )
    assert search.best_params_["identify__order"] == 16
    assert search.best_score_ > 0.99
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()


@pytest.mark.slow
def test_a_grid_point_that_cannot_be_fitted_is_nan_not_a_crash():
    data = make_flapping_wing("ltp", n_records=2, n_periods=60, start=5, random_state=1)
    pipe = heave_pipeline(data.omega, n_states=3)
    groups = data.inputs.index.get_level_values("record")
    search = GridSearchCV(pipe, {"identify__block_rows": [18, 9]}, cv=GroupKFold(2))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        search.fit(data.inputs, data.outputs, groups=groups)
    said = "\n".join(str(warning.message) for warning in caught)
    assert "must exceed the 8 rows in the analysis window" in said
    assert np.isnan(search.cv_results_["mean_test_score"][1])
    assert search.best_params_["identify__block_rows"] == 18


def test_raw_measurements_with_trim_inside(nltp):
    pipe = heave_pipeline(nltp.omega, trim_span=nltp.trim_span, n_states=3)
    pipe.fit(nltp.inputs, nltp.outputs)
    predicted = pipe.predict(nltp.inputs)
    assert r2_score(nltp.outputs, predicted) > 0.999
    trim = nltp.outputs.iloc[:64].to_numpy()
    np.testing.assert_allclose(predicted.iloc[:64], trim, atol=1e-6 * np.abs(trim).max())


def decomposition_by_period(omega, data):
    """A of the heave subsystem, read period by period."""
    analyzer = HarmonicAnalyzer(
        omega, reading="period", output_harmonics=KEPT, trim_span=data.trim_span
    )
    pipe = Pipeline(
        [
            ("harmonics", analyzer),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    ).fit(data.inputs, data.outputs)
    A = pipe["match"].ltp_.harmonic_decomposition(1).A
    heave = [0, 3, 5]  # of w_0, φ̇_0, w_1c, φ̇_1c, w_1s, φ̇_1s
    return A[np.ix_(heave, heave)]


@pytest.mark.parametrize("width", [3, 6, 20])
@pytest.mark.slow
def test_whole_periods_decompose_nonlinear_data_of_any_doublet(width):
    """Not the doublet of the paper's table alone: a 0.5 % doublet of any width."""
    data = make_flapping_wing("nltp", amplitude=0.005, width=width, start=40, n_periods=110)
    assert error(decomposition_by_period(data.omega, data), data.A_exact.to_numpy()) < 0.003


@pytest.mark.parametrize("window", ["hann", "centred-boxcar", "centred-triangle", "centred-hann"])
@pytest.mark.parametrize("rows_per_period", [4, 8])
@pytest.mark.slow
def test_every_window_gives_the_same_matrix(lti_signal, window, rows_per_period):
    pipe = whole_pipeline(lti_signal.omega, rows_per_period=rows_per_period)
    pipe.set_params(harmonics__window=window).fit(lti_signal.inputs, lti_signal.outputs)
    assert error(pipe["match"].system_.A, lti_signal.A_exact.to_numpy()) < 1e-6


def test_a_slightly_wrong_frequency_does_little_harm(ltp):
    A = decomposition_by_period(ltp.omega * (1 + 1.4e-6), ltp)
    assert error(A, ltp.A_exact.to_numpy()) < 1e-4


@pytest.mark.slow
def test_extreme_units(ltp):
    """Factors of 1e±9 between the channels, and signals whose squares underflow."""
    plain = whole_pipeline(ltp.omega).fit(ltp.inputs, ltp.outputs)["reduce"].system_.poles()
    for u_scale, y_scale in ((1e12, [1e-9, 1e9]), (1e-180, [1e-180, 1e-180])):
        pipe = heave_pipeline(ltp.omega).fit(ltp.inputs * u_scale, ltp.outputs * y_scale)
        assert same_poles(pipe["reduce"].system_.poles(), plain, 1e-6)


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_a_poor_match_between_different_orders_is_said(ltp):
    two_states = MatrixStructure(
        [["a", 0], [0, "b"]], np.full((2, 1), np.nan), np.vstack([np.eye(2), [[0, np.nan]]])
    )
    pipe = whole_pipeline(ltp.omega).set_params(match__structure=two_states)
    with pytest.warns(IdentifiabilityWarning, match="the model has 3 states, the structure has 2"):
        pipe.fit(ltp.inputs, ltp.outputs)


@pytest.mark.slow
def test_choosing_modes_alone_is_bounded_by_three_modes(ltp):
    """The system's own three modes are 0.58 % from its N = 1 decomposition."""
    pipe = whole_pipeline(ltp.omega, n_states=3).fit(ltp.inputs, ltp.outputs)
    assert 0.0057 < error(pipe["match"].system_.A, ltp.A_exact.to_numpy()) < 0.0065


def test_flap_subsystem_through_its_own_input_harmonic():
    data = make_flapping_wing("lti-signal", subsystem="flap")
    y = data.outputs[["phi_dot", "w"]]
    structure = MatrixStructure(np.full((3, 3), np.nan), np.full((3, 2), np.nan))
    harmonics = HarmonicAnalyzer(
        data.omega,
        input_harmonics={"U": [1]},
        output_harmonics={"phi_dot": [0], "w": [1]},
        hop=16,
    )
    steps = [
        ("harmonics", harmonics),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher(structure=structure)),
    ]
    with pytest.warns(ExcitationWarning, match=r"\['U_1s'\] are at rest"):
        pipe = Pipeline(steps).fit(data.inputs, y)
    assert error(pipe["match"].system_.A, data.A_exact.to_numpy()) < 1e-8
    assert pipe.score(data.inputs, y) > 1 - 1e-12


def test_residualized_modes_keep_the_static_gain(ltp):
    """Truncation and residualization differ in D alone (modal coordinates)."""
    models = {}
    for method in ("truncate", "residualize", "both"):
        pipe = heave_pipeline(ltp.omega, method=method, n_states=3)
        models[method] = pipe.fit(ltp.inputs, ltp.outputs)["reduce"].model_
    assert not models["truncate"].D.any()
    for method in ("residualize", "both"):
        assert models[method].D.any()
        assert same_poles(
            np.linalg.eigvals(models[method].A), np.linalg.eigvals(models["truncate"].A), 1e-9
        )


def test_an_ambiguous_choice_is_said_openly(rng):
    """Two modes, each the only one in its own output: either explains half of the data."""
    A, B = np.diag([0.9, 0.5]), np.ones((2, 1))
    u = rng.standard_normal((400, 1))
    y = propagate(A, u @ B.T, np.zeros(2))
    reducer = SpuriousModeReducer(MOESPRegressor(order=2, block_rows=5), n_states=1)
    with pytest.warns(IdentifiabilityWarning, match="explain the data as well"):
        reducer.fit(u, y)
    assert sorted(reducer.modes_["verdict"]) == ["ambiguous", "weak"]
    assert reducer.r2_ == pytest.approx(0.5, abs=0.1)


def test_reducer_and_matcher_as_meta_estimators(lti_signal):
    u, y = lti_signal.inputs, lti_signal.outputs
    analyzer = HarmonicAnalyzer(lti_signal.omega, output_harmonics=KEPT, hop=8)
    inner = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())])
    reducer = SpuriousModeReducer(inner)
    matcher = StructuredMatcher(reducer, structure=FREE_HEAVE).fit(u, y)
    assert error(matcher.system_.A, lti_signal.A_exact.to_numpy()) < 1e-8
    assert matcher.score(u, y) > 1 - 1e-12
    assert matcher.predict(u).columns.tolist() == ["w", "phi_dot"]


def test_period_synchronous_rows_have_the_order_of_the_system(ltp):
    """One row a period, all of whose harmonics are kept: two states, and no copies."""
    analyzer = HarmonicAnalyzer(ltp.omega, output_harmonics=4, reading="period")
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(block_rows=3))])
    pipe.fit(ltp.inputs, ltp.outputs)
    assert pipe["identify"].order_ == 2
    multipliers = np.log(pipe["identify"].eigenvalues_) * ltp.omega / (2 * np.pi)
    assert same_poles(multipliers, [-3.527185, -76.07195], 1e-5)
    reduced = Pipeline([*pipe.steps, ("reduce", SpuriousModeReducer())])
    reduced.fit(ltp.inputs, ltp.outputs)
    assert reduced["reduce"].modes_["verdict"].tolist() == ["genuine", "genuine"]
    assert reduced["reduce"].model_.dt == pytest.approx(2 * np.pi / ltp.omega)
    assert reduced.score(ltp.inputs, ltp.outputs) > 0.99


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*in doubt.*the samples have")  # with a state too many
def test_initial_states_by_vector_rows_or_record():
    data = make_flapping_wing("lti-signal", n_records=2, n_periods=40, start=5, random_state=3)
    pipe = heave_pipeline(data.omega).fit(data.inputs, data.outputs)
    n = pipe["reduce"].n_states_
    rest = pipe.predict(data.inputs)
    x0 = np.ones(n)
    moved = pipe.predict(data.inputs, x0=x0)
    rows = pipe.predict(data.inputs, x0=np.array([x0, x0]))
    labels = data.inputs.index.get_level_values("record").unique()
    named = pipe.predict(data.inputs, x0=dict.fromkeys(labels, x0))
    assert not np.allclose(moved, rest)
    pd.testing.assert_frame_equal(rows, moved)
    pd.testing.assert_frame_equal(named, moved)
    with pytest.raises(ValueError, match=rf"the model has {n} states and the data 2 segments"):
        pipe.predict(data.inputs, x0=np.ones(n + 1))
    with pytest.raises(ValueError, match="x0 has no state for record"):
        pipe.predict(data.inputs, x0={"nowhere": x0})


def test_containers_are_mirrored(rng):
    u = rng.standard_normal((200, 1))
    y = np.zeros(200)
    for k in range(199):
        y[k + 1] = 0.7 * y[k] + u[k, 0]
    index = pd.Index(0.01 * np.arange(200), name="time")
    for X, target in (
        (u, y),
        (u, y[:, None]),
        (pd.DataFrame(u, index=index, columns=["u"]), pd.Series(y, index=index, name="height")),
    ):
        model = MOESPRegressor(order=1, block_rows=4).fit(X, target)
        predicted = model.predict(X)
        assert type(predicted) is type(target)
        assert predicted.shape == target.shape
        np.testing.assert_allclose(predicted, target, atol=1e-9)
        if isinstance(target, pd.Series):
            assert predicted.name == "height"


def test_score_takes_sample_weight(fitted, ltp):
    weight = np.ones(len(ltp.inputs))
    score = fitted.score(ltp.inputs, ltp.outputs)
    assert fitted.score(ltp.inputs, ltp.outputs, sample_weight=weight) == pytest.approx(score)
    weight[9500:] = 0.0
    assert fitted.score(ltp.inputs, ltp.outputs, sample_weight=weight) != pytest.approx(score)


@pytest.mark.slow
def test_units_of_the_signals_do_not_matter(ltp):
    plain = heave_pipeline(ltp.omega, n_states=3).fit(ltp.inputs, ltp.outputs)
    outputs = ltp.outputs * np.array([1e6, 1e-6])
    scaled = heave_pipeline(ltp.omega, n_states=3).fit(ltp.inputs * 1e5, outputs)
    assert scaled["identify"].order_ == plain["identify"].order_
    assert same_poles(scaled["reduce"].system_.poles(), plain["reduce"].system_.poles(), 1e-7)


def test_outputs_that_are_decomposed_already(fitted, lti_signal):
    """The same model, and predictions of harmonics instead of signals."""
    u, y = lti_signal.inputs, lti_signal.outputs
    options = {"omega": lti_signal.omega, "hop": 8}
    Y = HarmonicAnalyzer(input_harmonics=KEPT, **options).fit_transform(y)
    pipe = clone(fitted).set_params(harmonics__output_harmonics=0).fit(u, Y)
    np.testing.assert_array_equal(pipe["match"].model_.A, fitted["match"].model_.A)
    harmonics = pipe.predict(u)
    assert harmonics.columns.tolist() == ["w_0", "phi_dot_1c", "phi_dot_1s"]
    psi = lti_signal.omega * u.index.to_numpy()
    phi_dot = harmonics["phi_dot_1c"] * np.cos(psi) + harmonics["phi_dot_1s"] * np.sin(psi)
    np.testing.assert_allclose(phi_dot, fitted.predict(u)["phi_dot"], atol=1e-9)
    assert pipe.score(u, Y) == pytest.approx(fitted.score(u, y))
    other = HarmonicAnalyzer(input_harmonics=KEPT, omega=lti_signal.omega, hop=16)
    with pytest.raises(ValueError, match=r"y was decomposed with hop=16, but X with 8; use"):
        clone(pipe).fit(u, other.fit_transform(y))


def test_labels_of_the_outputs_are_mirrored(rng):
    u = rng.standard_normal((100, 1))
    y = np.column_stack([np.roll(u[:, 0], 1), np.roll(u[:, 0], 2)])
    for columns in ([0, 1], pd.MultiIndex.from_tuples([("w", "m/s"), ("q", "rad/s")])):
        frame = pd.DataFrame(y, columns=columns)
        predicted = MOESPRegressor(order=2).fit(u, frame).predict(u)
        assert predicted.columns.tolist() == frame.columns.tolist()
    unnamed = pd.Series(y[:, 0])
    assert MOESPRegressor(order=2).fit(u, unnamed).predict(u).name is None


def test_score_does_not_depend_on_units(short_noisy):
    u, y = short_noisy
    model = MOESPRegressor(order=3, block_rows=8)
    scaled = y * [1e-6, 1e6]
    plain = clone(model).fit(u, y).score(u[150:], y[150:])
    assert clone(model).fit(u, scaled).score(u[150:], scaled[150:]) == pytest.approx(plain)


@pytest.fixture
def short_noisy(rng):
    A, B, C = random_stable(rng, 3, 1, 2)
    u = rng.standard_normal((400, 1))
    y = propagate(A, u @ B.T, np.zeros(3)) @ C.T
    return u, y + 0.5 * rng.standard_normal(y.shape)


@pytest.mark.parametrize("trim", [None, 1e4])
@pytest.mark.slow
def test_harmonics_that_are_rounding_are_no_signals(trim):
    """Brought to the size of the others, as signals of their own they cost 0.1 of R²."""
    rng, spp = np.random.default_rng(0), 17
    u = np.vstack([np.zeros((5, 1)), rng.standard_normal((300, 1))])
    y = propagate(np.array([[0.9, 0.3], [-0.3, 0.6]]), u @ [[1.0, 0.5]], np.zeros(2))[:, :1]
    index = pd.Index(np.arange(len(u) * spp) / spp, name="time")
    X, y = (pd.DataFrame(np.repeat(z, spp, axis=0), index, [s]) for z, s in ((u, "u"), (y, "y")))
    analyzer = HarmonicAnalyzer(2 * np.pi, output_harmonics=1, reading="period")
    if trim is not None:
        y += trim * (1.0 + np.cos(2 * np.pi * index.to_numpy()[:, None]))
        analyzer.set_params(trim_span=(0.0, 5.0))
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())]).fit(X, y)
    assert pipe.score(X, y) > 1.0 - 1e-12
    np.testing.assert_allclose(pipe[-1].eigenvalues_, [0.75 + 0.2598j, 0.75 - 0.2598j], atol=1e-4)


@pytest.mark.parametrize("snr", [None, 20])
@pytest.mark.slow
def test_a_sliding_fit_takes_little_memory_beside_its_record(snr):
    """51 200 rows of three signals are 1.2 MB; what stands beside them does not grow with them."""
    data = make_flapping_wing("lti-signal", n_periods=800, start=5, snr=snr, random_state=0)
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(data.omega, output_harmonics=KEPT, reading="sliding")),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
        ]
    )
    tracemalloc.start()
    pipe.fit(data.inputs, data.outputs)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert pipe["reduce"].n_states_ == 3
    assert peak < 25e6
