"""Displays of signals: harmonics, responses, and how orders and structures were chosen."""

import numpy as np
import pandas as pd
import plotting_cases as cases
import pytest

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, StructuredMatcher
from sklearn_hd._simulators import scored_simulation
from sklearn_hd.exceptions import TimeBaseWarning
from sklearn_hd.model_selection import fit_percent, fit_percent_scorer
from sklearn_hd.plotting import (
    ConvergenceDisplay,
    HarmonicsDisplay,
    OrderSelectionDisplay,
    ResponseDisplay,
    StabilizationDisplay,
)


def finite(line):
    """Times and values of a line but for its breaks."""
    t, values = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    return t[np.isfinite(t)], values[np.isfinite(t)]


# ---- harmonics --------------------------------------------------------------------------------


def test_harmonics_are_those_of_the_analyzer():
    data, pipe = cases.wing(), cases.sliding()
    display = HarmonicsDisplay.from_estimator(pipe, data.inputs, data.outputs)
    for line, signal in zip(display.signal_lines_, ("U", "w", "phi_dot"), strict=True):
        signals = data.inputs if signal == "U" else data.outputs
        np.testing.assert_array_equal(line.get_ydata(), signals[signal])
        np.testing.assert_allclose(line.get_xdata(), signals.index)
    kept = {"w": [0], "phi_dot": [1]}
    alone = HarmonicAnalyzer(data.omega, input_harmonics=kept, hop=8).fit_transform(data.outputs)
    assert list(display.coefficient_lines_) == ["U_0", "w_0", "phi_dot_1c", "phi_dot_1s"]
    for name in ("w_0", "phi_dot_1c", "phi_dot_1s"):
        np.testing.assert_allclose(display.coefficient_lines_[name].get_ydata(), alone[name])


def test_harmonics_are_drawn_about_the_trim_that_the_fit_has_learned():
    signals = cases.many_signals(1) * 0.0 + 3.0
    options = {"omega": 2 * np.pi, "harmonics": 1, "trim_span": (0.0, 2.0)}
    display = HarmonicsDisplay.from_data(signals, **options, units={"blade_0": "m"})
    assert np.abs(display.coefficient_lines_["blade_0_0"].get_ydata()).max() < 1e-12
    assert display.signal_lines_[0].get_ydata().min() == 3.0
    assert display.axes_[0].get_ylabel() == "blade_0 (m)"
    assert display.axes_[1].get_ylabel() == "coefficients\nabout trim (m)"


def test_lines_break_at_gaps_and_keep_to_one_record():
    signals = cases.many_signals(1)
    gap = signals.drop(signals.index[100:130])
    display = HarmonicsDisplay.from_data(gap, 2 * np.pi, missing="gap")
    t = display.signal_lines_[0].get_xdata()
    assert np.flatnonzero(np.isnan(t)).tolist() == [100]
    both = pd.concat({"a": signals, "b": 2 * signals}, names=["record", "time"])
    display = HarmonicsDisplay.from_data(both, 2 * np.pi, record="b")
    np.testing.assert_array_equal(display.signal_lines_[0].get_ydata(), 2 * signals["blade_0"])
    assert display.axes_[0].get_title("left") == "record b"
    with pytest.raises(ValueError, match=r"record='c' is not among the records \['a', 'b'\]"):
        HarmonicsDisplay.from_data(both, 2 * np.pi, record="c")
    with pytest.raises(ValueError, match=r"record='a' was given, but the data have no"):
        HarmonicsDisplay.from_data(signals, 2 * np.pi, record="a")


def test_harmonics_in_a_span():
    signals = cases.many_signals(2)
    display = HarmonicsDisplay.from_data(signals, 2 * np.pi, span=(2.0, 3.0))
    t = display.coefficient_lines_["blade_1_1c"].get_xdata()
    assert t[0] == pytest.approx(2.0)
    assert t[-1] == pytest.approx(3.0)
    with pytest.raises(ValueError, match=r"span=\(90, 91\) contains no row"):
        display.plot(span=(90.0, 91.0))


@pytest.mark.parametrize("samples", [16.19, 50.3])
@pytest.mark.filterwarnings("error")
def test_a_turn_may_hold_any_number_of_samples_without_a_warning(samples):
    t = pd.Index(np.arange(20 * int(samples)) / samples, name="time")
    signal = pd.DataFrame({"y": 1 + np.cos(2 * np.pi * t)}, index=t)
    display = HarmonicsDisplay.from_data(signal, 2 * np.pi)
    np.testing.assert_array_equal(display.coefficient_lines_["y_0"].get_xdata(), t)
    for name, size in [("y_0", 1.0), ("y_1c", 1.0), ("y_1s", 0.0)]:
        found = display.coefficient_lines_[name].get_ydata()[3 * int(samples) :]
        np.testing.assert_allclose(found, size, atol=1e-3)


def test_samples_that_are_counted_are_called_so():
    signals = pd.DataFrame({"u": np.cos(np.arange(80) * np.pi / 8)})
    with pytest.warns(TimeBaseWarning, match="rows count as samples"):
        display = HarmonicsDisplay.from_data(signals, np.pi / 8)
    assert display.axes_[-1].get_xlabel() == "sample (–)"


@pytest.mark.filterwarnings("ignore:the outputs repeat themselves")
def test_outputs_with_an_azimuth_beside_the_inputs():
    t = pd.Index(np.arange(256) / 32, name="time")
    psi = 2 * np.pi * (t + t**2 / 160)
    X = pd.DataFrame({"u": np.ones(256), "psi": psi}, index=t)
    y = pd.DataFrame({"y": 2 + np.cos(psi)}, index=t)
    analyzer = HarmonicAnalyzer(azimuth="psi", output_harmonics=1, reading="sliding")
    analyzer = analyzer.set_params(trim_span=None).fit(X, y)
    display = HarmonicsDisplay.from_estimator(analyzer, X, y)
    assert display.coefficient_lines_["y_0"].get_ydata()[-1] == pytest.approx(2.0, abs=1e-3)
    assert display.coefficient_lines_["y_1c"].get_ydata()[-1] == pytest.approx(1.0, abs=1e-3)


def test_outputs_need_an_analyzer_that_knows_them():
    signals = cases.many_signals(1)
    analyzer = HarmonicAnalyzer(2 * np.pi).fit(signals)
    with pytest.raises(ValueError, match="was fitted without outputs"):
        HarmonicsDisplay.from_estimator(analyzer, signals, signals)


# ---- responses --------------------------------------------------------------------------------


def test_the_response_is_that_which_is_scored():
    u, y = cases.periodic_record()
    pipe = cases.periodic()
    display = ResponseDisplay.from_estimator(pipe, u, y)
    step, X = pipe[-1], pipe[:-1].transform(u)
    truth, simulated, rows, _ = scored_simulation(step, X, y)
    for k, name in enumerate(y):
        t, values = finite(display.simulated_lines_["simulated", name])
        np.testing.assert_allclose(t, u.index[rows])
        np.testing.assert_allclose(values, simulated[:, k])
        np.testing.assert_allclose(finite(display.measured_lines_[name])[1], truth[:, k])
        score = fit_percent_scorer(output=name)(pipe, u, y)
        assert display.fit_.loc["simulated", name] == pytest.approx(score)
        assert display.axes_[1 + k].get_title("left") == f"fit of {name}: {score:.1f} %"
    np.testing.assert_array_equal(display.input_lines_["u1"].get_ydata(), u["u1"])


def test_fit_within_and_outside_the_validation_span():
    y = cases.many_signals(2)
    model = y.copy()
    model.loc[4.0:] *= 0.5
    display = ResponseDisplay.from_data(y, {"half": model}, validation_span=(4.0, 8.0))
    assert display.fit_.to_numpy().min() == 100.0
    inside = y.index >= 4.0
    np.testing.assert_allclose(
        display.validation_fit_.loc["half"], fit_percent(y[inside], 0.5 * y[inside])
    )
    assert [span.get_x() for span in display.spans_] == [4.0, 4.0]
    with pytest.raises(ValueError, match=r"validation_span=\(20, 30\) contains no drawn row"):
        ResponseDisplay.from_data(y, model, validation_span=(20, 30))


def test_several_models_share_the_panels():
    u, y = cases.periodic_record()
    models = {"two": cases.periodic(), "again": cases.periodic()}
    display = ResponseDisplay.from_estimator(models, u, y, show_inputs=False, span=(40.0, 60.0))
    assert list(display.fit_.index) == ["two", "again"]
    assert len(display.axes_) == 2
    t, _ = finite(display.simulated_lines_["again", "y"])
    assert 40.0 <= t.min() < t.max() <= 60.0
    labels = [text.get_text() for text in display.legend_.get_texts()]
    assert labels == ["measured", "two", "again"]


def test_one_record_of_several_is_drawn():
    u, y = cases.periodic_record()
    us = pd.concat({1: u, 2: u}, names=["record", "time"])
    ys = pd.concat({1: y, 2: 1.5 * y}, names=["record", "time"])
    display = ResponseDisplay.from_estimator(cases.periodic(), us, ys, record=2)
    _, values = finite(display.measured_lines_["y"])
    np.testing.assert_allclose(values, 1.5 * y["y"].to_numpy()[-len(values) :])
    assert display.axes_[0].get_title("left").startswith("record 2")
    assert display.fit_.loc["simulated", "y"] < 70.0


def test_bad_responses():
    u, y = cases.periodic_record()
    with pytest.raises(TypeError, match="ResponseDisplay needs a fitted MOESPRegressor, Sp"):
        ResponseDisplay.from_estimator(HarmonicAnalyzer(2.0), u, y)
    with pytest.raises(ValueError, match=r"'short' has shape \(10, 2\)"):
        ResponseDisplay.from_data(y, {"short": y.iloc[:10]})
    with pytest.raises(ValueError, match="have different indices; align them first"):
        ResponseDisplay.from_data(y, y.set_axis(y.index + 1.0))


# ---- stabilization ----------------------------------------------------------------------------


@pytest.mark.slow
def test_modes_of_each_order_are_those_of_its_model():
    data, pipe = cases.wing(), cases.sliding()
    orders = [3, 9, 10]
    display = StabilizationDisplay.from_estimator(pipe, data.inputs, data.outputs, orders=orders)
    frame = pipe[:1].transform(data.inputs)
    rows = pipe["identify"].block_rows_
    for n in orders:
        model = MOESPRegressor(order=n, block_rows=rows).fit(frame, data.outputs)
        found = display.modes.loc[display.modes["order"] == n, "eigenvalue"]
        z = np.exp(found.to_numpy() * model.model_.dt)
        np.testing.assert_allclose(np.sort(np.abs(z)), np.sort(np.abs(model.eigenvalues_)))
    assert display.order == pipe["identify"].order_


def test_the_true_modes_are_steady():
    display = cases.stabilization(snr=None)
    true = np.linalg.eigvals(cases.wing().A_exact)
    highest = display.modes[display.modes["order"] == 12]
    steady = highest.loc[highest["steady"], "eigenvalue"].to_numpy()
    assert np.abs(steady[:, None] - true).min(axis=0).max() < 1e-3 * np.abs(true).max()
    assert not display.modes.loc[display.modes["order"] == 1, "steady"].any()
    shown = sum(len(lines[0].get_ydata()) for lines in display.points_.values())
    assert shown == sum(z.imag >= 0 for z in display.modes["eigenvalue"])


def test_stabilization_by_default_goes_beyond_the_order_chosen():
    display = StabilizationDisplay.from_data(*cases.plain_record())
    assert display.order == 2
    assert display.modes["order"].max() == 6


def test_stabilization_needs_a_regressor():
    with pytest.raises(TypeError, match="StabilizationDisplay needs a MOESPRegressor"):
        StabilizationDisplay.from_estimator(HarmonicAnalyzer(2.0), None, None)
    with pytest.raises(ValueError, match="damping_tol must be a positive number in shares"):
        StabilizationDisplay.from_data(np.zeros(4), np.zeros(4), damping_tol=0)


# ---- searches and matches ---------------------------------------------------------------------


def test_scores_and_errors_are_those_of_the_folds():
    search = cases.search()
    display = OrderSelectionDisplay.from_estimator(search)
    results = search.cv_results_
    folds = np.array([results[f"split{f}_test_score"] for f in range(4)])
    error = folds.std(axis=0, ddof=1) * np.sqrt(1 / 4 + 1 / 3)  # Nadeau and Bengio, q = 1/(k − 1)
    for rows in (6, 10):
        at = [k for k, p in enumerate(results["params"]) if p["block_rows"] == rows]
        line, caps, (bars,) = display.lines_[str(rows)]
        np.testing.assert_allclose(line.get_ydata(), results["mean_test_score"][at])
        np.testing.assert_array_equal(np.rint(line.get_xdata()), [1, 2, 3, 4])
        half = [np.ptp(segment[:, 1]) / 2 for segment in bars.get_segments()]
        np.testing.assert_allclose(half, error[at], rtol=1e-6, atol=1e-12)
        assert len(caps) == 2
    best = search.best_index_
    assert display.chosen_.get_ydata()[0] == results["mean_test_score"][best]
    limit = results["mean_test_score"][best] - error[best]
    assert display.limit_.get_ydata()[0] == pytest.approx(limit)


def cv_results(scores, orders, **others):
    """cv_results_ of two folds with the same scores."""
    params = [{"order": n} | {k: v[i] for k, v in others.items()} for i, n in enumerate(orders)]
    table = {f"param_{key}": [p[key] for p in params] for key in params[0]}
    folds = {f"split{f}_test_score": np.array(scores) for f in range(2)}
    return {"params": params, "mean_test_score": np.array(scores), **table, **folds}


def test_failed_candidates_are_marked():
    results = cv_results([0.5, np.nan, 0.8, -np.inf], [2, 4, 6, 8])
    display = OrderSelectionDisplay.from_cv_results(results, misfit=True)
    assert display.failed_.get_xdata().tolist() == [4, 8]
    np.testing.assert_allclose(display.lines_["default"][0].get_ydata(), [0.5, 0.2])
    assert display.ax_.get_yscale() == "log"
    with pytest.raises(ValueError, match="every candidate failed or was unstable on some fold"):
        OrderSelectionDisplay.from_cv_results(cv_results([np.nan], [2]))


@pytest.mark.parametrize("unit", [1.0, 100.0, -1e-3, -1e6])
def test_scores_out_of_all_proportion_do_not_flatten_the_others(unit):
    scores = np.sort(unit * np.array([0.5, 0.9, 3.0]))
    results = cv_results([-3e39, *scores, -1e9 * abs(unit)], [1, 2, 4, 6, 8])
    display = OrderSelectionDisplay.from_cv_results(results)
    np.testing.assert_allclose(display.lines_["default"][0].get_ydata(), scores)
    assert display.failed_.get_xdata().tolist() == [1, 8]


def test_the_best_of_candidates_alike_in_order_is_drawn():
    results = cv_results([0.5, 0.7, 0.6], [2, 2, 3], block_rows=[None, None, 9], hop=[1, 2, 1])
    display = OrderSelectionDisplay.from_cv_results(results)
    np.testing.assert_allclose(display.lines_["default"][0].get_ydata(), [0.7])
    np.testing.assert_allclose(display.lines_["9"][0].get_ydata(), [0.6])


def test_bad_searches():
    with pytest.raises(TypeError, match="needs a fitted search over orders, such as GridSearchCV"):
        OrderSelectionDisplay.from_estimator(MOESPRegressor())
    results = cv_results([0.5], [1], hop=[1])
    results["params"] = [{"hop": 1}]
    del results["param_order"]
    with pytest.raises(ValueError, match=r"'order' was not searched, only \['hop'\]"):
        OrderSelectionDisplay.from_cv_results(results)
    with pytest.raises(ValueError, match="only whole numbers can be drawn"):
        OrderSelectionDisplay.from_cv_results(cv_results([0.5], ["auto"]))


def test_every_iteration_is_drawn_under_its_stage():
    history = cases.history()
    display = cases.convergence()
    stages = history["stage"].unique()
    assert list(display.lines_) == list(stages)
    for stage in stages:
        (line,) = display.lines_[stage]
        own = history[history["stage"] == stage]
        np.testing.assert_array_equal(line.get_xdata(), own.index)
        np.testing.assert_array_equal(line.get_ydata(), own["error"])
    assert display.end_.get_text() == f"{history['error'].iloc[-1]:.3g}"


def test_a_match_that_became_exact_is_drawn():
    history = pd.DataFrame({"stage": ["a", "b", "a"], "error": [1.0, 0.1, 0.0]})
    display = ConvergenceDisplay(history).plot()
    assert len(display.lines_["a"]) == 2
    assert display.lines_["a"][1].get_ydata()[-1] == pytest.approx(1e-3)
    assert display.end_.get_text() == "0"


def test_the_history_of_a_fitted_matcher(monkeypatch):
    history = cases.history()
    monkeypatch.setattr(StructuredMatcher, "history_", property(lambda _: history), raising=False)
    assert ConvergenceDisplay.from_estimator(cases.sliding()).history is history


def test_bad_histories():
    with pytest.raises(ValueError, match="history lacks the column 'error'"):
        ConvergenceDisplay(pd.DataFrame({"stage": []}))
    with pytest.raises(ValueError, match="history is empty: nothing was minimised"):
        ConvergenceDisplay(cases.history().iloc[:0])
