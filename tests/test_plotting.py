"""Displays: what is drawn is what was found, on Axes that may be given, labelled with units."""

from itertools import combinations

import control
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import plotting_cases as cases
import pytest
from periodic_cases import coupled, mathieu
from scipy.stats import chi2, norm
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer, StructuredMatcher
from sklearn_hd._base import scored_simulation
from sklearn_hd.algorithms.simulation import frequency_response
from sklearn_hd.exceptions import TimeBaseWarning
from sklearn_hd.model_selection import fit_percent, fit_percent_scorer
from sklearn_hd.plotting import (
    BodeDisplay,
    ConvergenceDisplay,
    EigenvalueDisplay,
    HarmonicsDisplay,
    HarmonicTransferFunctionDisplay,
    OrderSelectionDisplay,
    ParticipationDisplay,
    PeriodicMatrixDisplay,
    ResponseDisplay,
    SingularValueDisplay,
    StabilizationDisplay,
)
from sklearn_hd.systems import LTPSystem, estimate_harmonic_transfer_function


@pytest.fixture(autouse=True)
def _no_figures_left():
    yield
    plt.close("all")


def axes_of(display):
    """The Axes of a display, one or several."""
    return np.atleast_1d(display.ax_ if hasattr(display, "ax_") else display.axes_)


def points(line):
    """Complex numbers that a line shows in the plane."""
    return line.get_xdata() + 1j * line.get_ydata()


def finite(line):
    """Times and values of a line but for its breaks."""
    t, values = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
    return t[np.isfinite(t)], values[np.isfinite(t)]


def texts_of(figure):
    """All letters that a figure shows, with their extents in pixels."""
    parts = [text for legend in figure.legends for text in legend.get_texts()]
    for axis in figure.axes:
        if not axis.axison:
            continue
        parts += [axis.title, axis._left_title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
        for ticks, view in ((axis.xaxis, axis.get_xlim()), (axis.yaxis, axis.get_ylim())):
            parts.append(ticks.offsetText)
            low, high = sorted(view)
            parts += [
                tick.label1
                for tick in ticks.get_major_ticks()
                if tick.label1.get_visible() and low <= tick.get_loc() <= high
            ]
        if axis.get_legend() is not None:
            parts += axis.get_legend().get_texts()
    shown = [text for text in parts if text.get_visible() and text.get_text().strip()]
    return [(text.get_text(), text.get_window_extent()) for text in shown]


def check_texts(figure):
    """No letters cover others, none leave the figure."""
    found, (width, height) = texts_of(figure), figure.bbox.size
    for text, box in found:
        assert box.x0 >= -1, text
        assert box.y0 >= -1, text
        assert box.x1 <= width + 1, text
        assert box.y1 <= height + 1, text
    for (one, a), (other, b) in combinations(found, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        up = min(a.y1, b.y1) - max(a.y0, b.y0)
        assert across <= 1 or up <= 1, f"{one!r} covers {other!r}"


# ---- what all displays have in common ---------------------------------------------------------


@pytest.mark.parametrize("name", cases.DISPLAYS)
def test_a_new_figure_is_made_and_kept(name):
    make, n_panels = cases.DISPLAYS[name]
    display = make()
    assert len(plt.get_fignums()) == 1
    assert len(axes_of(display)) == n_panels
    assert all(axis.figure is display.figure_ for axis in axes_of(display))
    assert display.figure_.get_layout_engine() is not None
    display.figure_.draw_without_rendering()  # warnings, of collapsed panels too, are errors
    check_texts(display.figure_)


@pytest.mark.parametrize("name", cases.DISPLAYS)
def test_one_axes_given_is_drawn_on_or_divided(name):
    make, n_panels = cases.DISPLAYS[name]
    figure, (left, right) = plt.subplots(1, 2, layout="constrained", figsize=(16, 6))
    display = make(right)
    assert display.figure_ is figure
    assert plt.get_fignums() == [figure.number]
    assert len(axes_of(display)) == n_panels
    assert (axes_of(display)[0] is right) == (n_panels == 1)
    assert not left.has_data()
    figure.draw_without_rendering()
    whole = right.get_window_extent()
    for axis in axes_of(display):
        inside = axis.get_window_extent()
        assert inside.x0 >= whole.x0 - 1
        assert inside.x1 <= whole.x1 + 1


@pytest.mark.parametrize("name", [n for n, (_, k) in cases.DISPLAYS.items() if k > 1])
def test_an_array_of_axes_must_have_one_for_each_panel(name):
    make, n_panels = cases.DISPLAYS[name]
    _, axes = plt.subplots(2, n_panels)
    display = make(axes[0])
    assert list(display.axes_) == list(axes[0])
    with pytest.raises(ValueError, match=f"ax holds {n_panels + 1} Axes, but {n_panels} panels"):
        make(axes.ravel()[: n_panels + 1])


@pytest.mark.parametrize("name", cases.DISPLAYS)
def test_ax_must_be_axes(name):
    make, _ = cases.DISPLAYS[name]
    with pytest.raises(TypeError, match="is no matplotlib Axes; give one"):
        make("left")


def test_axes_outside_a_grid_cannot_be_divided():
    with pytest.raises(ValueError, match="stands in no grid of subplots and cannot be divided"):
        cases.participation(plt.figure().add_axes((0.1, 0.1, 0.8, 0.8)))


@pytest.mark.parametrize("name", cases.DISPLAYS)
def test_every_outer_axis_is_labelled_with_its_unit(name):
    display = cases.DISPLAYS[name][0]()
    axes = axes_of(display)
    bottom = min(axis.get_subplotspec().get_position(display.figure_).y0 for axis in axes)
    lowest = [a for a in axes if a.get_subplotspec().get_position(display.figure_).y0 == bottom]
    for axis in lowest:
        assert axis.get_xlabel().split("(")[1] in ("s)", "–)", "1/s)", "rad/s)", "deg)")
    for axis in axes:
        assert axis.get_ylabel() or axis.get_title("left") or axis is not axes[0]


@pytest.mark.parametrize("name", cases.DISPLAYS)
def test_nothing_is_told_by_colour_alone(name):
    for axis in axes_of(cases.DISPLAYS[name][0]()):
        lines = [ln for ln in axis.lines if not str(ln.get_label()).startswith("_")]
        looks = [
            (
                line.get_linestyle(),
                line.get_marker(),
                line.get_linewidth(),
                line.get_markerfacecolor() in ("white", "none"),
                str(line._dash_pattern[1]),
            )
            for line in lines
        ]
        assert len(looks) == len(set(looks))


def of_signals(count):
    signals = cases.many_signals(count)
    hd = cases.large_system(count).harmonic_decomposition(0)
    yield HarmonicsDisplay.from_data(signals, 2 * np.pi)
    yield ResponseDisplay.from_data(signals, 0.9 * signals)
    yield BodeDisplay.from_systems(hd, [0.5, 1.0, 2.0])


def of_states(count):
    system = cases.large_system(count)
    yield ParticipationDisplay.from_system(system)
    yield PeriodicMatrixDisplay.from_systems(system, "G")
    yield HarmonicTransferFunctionDisplay.from_systems(system, 1, [0.5, 1.0, 2.0])


@pytest.mark.parametrize("make", [of_signals, of_states])
@pytest.mark.parametrize("count", [1, 12])
def test_one_to_twelve_outputs_are_legible(make, count):
    for display in make(count):
        display.figure_.draw_without_rendering()
        check_texts(display.figure_)
        for axis in display.axes_:
            box = axis.get_window_extent().transformed(display.figure_.dpi_scale_trans.inverted())
            assert box.width > 1.2
            assert box.height > 0.5


# ---- finding steps ----------------------------------------------------------------------------


FROM_FITTED = {
    HarmonicsDisplay: "HarmonicAnalyzer",
    SingularValueDisplay: "MOESPRegressor",
    EigenvalueDisplay: "ModelStep",
    ConvergenceDisplay: "StructuredMatcher",
    BodeDisplay: "ModelStep",
    ParticipationDisplay: "StructuredMatcher",
    PeriodicMatrixDisplay: "StructuredMatcher",
    HarmonicTransferFunctionDisplay: "StructuredMatcher",
}


def from_estimator(display, estimator):
    data = [cases.wing().inputs] if display is HarmonicsDisplay else []
    return display.from_estimator(estimator, *data)


@pytest.mark.parametrize("display", FROM_FITTED)
def test_an_estimator_without_the_step_is_refused(display):
    needed = FROM_FITTED[display]
    pipeline = Pipeline([("analyzer", HarmonicAnalyzer(2.0))])
    wrong = MOESPRegressor() if display is HarmonicsDisplay else pipeline
    with pytest.raises(TypeError, match=f"{display.__name__} needs a fitted {needed}"):
        from_estimator(display, wrong)


@pytest.mark.parametrize("display", FROM_FITTED)
def test_an_estimator_must_be_fitted(display):
    steps = [
        ("harmonics", HarmonicAnalyzer(2.0)),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher()),
    ]
    with pytest.raises(Exception, match="not fitted yet") as raised:
        from_estimator(display, Pipeline(steps))
    assert type(raised.value).__name__ == "NotFittedError"
    with pytest.raises(TypeError, match="is a class; give an instance"):
        from_estimator(display, MOESPRegressor)


def test_steps_are_found_in_searches_frozen_and_meta_estimators():
    search = cases.search()
    best = search.best_estimator_
    u, y = cases.plain_record()
    reducer = SpuriousModeReducer(MOESPRegressor(order=2, block_rows=6)).fit(u, y)
    for estimator, order in (
        (search, best.order_),
        (FrozenEstimator(best), best.order_),
        (reducer, 2),
        (cases.sliding(20), cases.sliding(20)["identify"].order_),
    ):
        assert SingularValueDisplay.from_estimator(estimator).order == order


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
    with pytest.raises(ValueError, match=r"record='a' was asked for, but the data have no"):
        HarmonicsDisplay.from_data(signals, 2 * np.pi, record="a")


def test_harmonics_in_a_span():
    signals = cases.many_signals(2)
    display = HarmonicsDisplay.from_data(signals, 2 * np.pi, span=(2.0, 3.0))
    t = display.coefficient_lines_["blade_1_1c"].get_xdata()
    assert t[0] == pytest.approx(2.0)
    assert t[-1] == pytest.approx(3.0)
    with pytest.raises(ValueError, match=r"span=\(90, 91\) holds none of the rows"):
        display.plot(span=(90.0, 91.0))


def test_samples_that_are_counted_are_called_so():
    signals = pd.DataFrame({"u": np.cos(np.arange(80) * np.pi / 8)})
    with pytest.warns(TimeBaseWarning, match="samples are counted"):
        display = HarmonicsDisplay.from_data(signals, np.pi / 8)
    assert display.axes_[-1].get_xlabel() == "sample (–)"


def test_outputs_with_an_azimuth_beside_the_inputs():
    t = pd.Index(np.arange(256) / 32, name="time")
    psi = 2 * np.pi * (t + t**2 / 160)
    X = pd.DataFrame({"u": np.ones(256), "psi": psi}, index=t)
    y = pd.DataFrame({"y": 2 + np.cos(psi)}, index=t)
    analyzer = HarmonicAnalyzer(azimuth="psi", output_harmonics=1).fit(X, y)
    display = HarmonicsDisplay.from_estimator(analyzer, X, y)
    assert display.coefficient_lines_["y_0"].get_ydata()[-1] == pytest.approx(2.0, abs=1e-3)
    assert display.coefficient_lines_["y_1c"].get_ydata()[-1] == pytest.approx(1.0, abs=1e-3)


def test_outputs_need_an_analyzer_that_knows_them():
    signals = cases.many_signals(1)
    analyzer = HarmonicAnalyzer(2 * np.pi).fit(signals)
    with pytest.raises(ValueError, match="was fitted without outputs"):
        HarmonicsDisplay.from_estimator(analyzer, signals, signals)


# ---- singular values --------------------------------------------------------------------------


def test_singular_values_are_those_of_the_model():
    model = cases.sliding(20)["identify"]
    display = SingularValueDisplay.from_estimator(cases.sliding(20), count=20)
    drawn = [*display.kept_.get_ydata(), *display.left_out_.get_ydata()]
    np.testing.assert_array_equal(drawn, model.singular_values_[:20])
    np.testing.assert_array_equal(display.kept_.get_xdata(), np.arange(1, model.order_ + 1))
    assert display.floor_.get_ydata()[0] == model.noise_floor_
    assert display.ax_.get_yscale() == "log"


def test_the_gap_is_told_and_further_orders_are_marked():
    display = SingularValueDisplay([100.0, 20.0, 0.5, 0.4], 2, 0.6).plot(marks={"guess": 1})
    assert display.gap_.get_label() == "gap ×40"
    assert display.gap_.get_xdata()[0] == 2.5
    assert display.marks_["guess"].get_label() == "guess: 1"


def test_zeros_do_not_stand_on_a_logarithmic_axis():
    display = SingularValueDisplay([1.0, 0.0, 0.0], 1, 0.0).plot()
    assert len(display.left_out_.get_ydata()) == 0
    assert display.floor_ is None
    with pytest.raises(ValueError, match="the record was too short for any dynamics"):
        SingularValueDisplay([], 0).plot()


# ---- eigenvalues ------------------------------------------------------------------------------


def test_eigenvalues_are_drawn_by_verdict_with_families_joined():
    pipe = cases.sliding()
    modes = pipe["reduce"].modes_
    true = np.linalg.eigvals(cases.wing().A_exact)
    display = EigenvalueDisplay.from_estimator(pipe, true=true)
    for verdict, line in display.mode_points_.items():
        expected = modes.loc[modes["verdict"] == verdict, "eigenvalue"]
        np.testing.assert_array_equal(points(line), expected)
    assert sum(len(line.get_xdata()) for line in display.mode_points_.values()) == len(modes)
    np.testing.assert_array_equal(points(display.true_points_), true)
    np.testing.assert_array_equal(points(display.model_points_), pipe["match"].system_.poles())
    families = modes[modes["family"] >= 0].groupby("family")["eigenvalue"]
    joined = [set(group) for _, group in families if len(group) > 1]
    assert [set(points(line)) for line in display.family_lines_] == joined


def test_the_window_alone_may_lie_out_of_view():
    modes = pd.DataFrame(
        {
            "eigenvalue": [-1 + 5j, -1 - 5j, -2000 + 0j],
            "family": [0, 0, -1],
            "verdict": ["genuine", "copy", "window"],
        }
    )
    display = EigenvalueDisplay(modes, omega=4.0).plot()
    (left, right), (low, high) = display.ax_.get_xlim(), display.ax_.get_ylim()
    assert -5 < left < -1 < 0 < right
    assert low < -5 < 5 < high
    label = display.mode_points_["window"].get_label()
    assert label == "window's memory (1 out of view)"
    assert display.mode_points_["genuine"].get_label() == "genuine, kept"


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_ellipses_are_as_large_as_the_deviations_say(level):
    model = pd.DataFrame(
        {
            "eigenvalue": [-1 + 5j, -1 - 5j, -3 + 0j, -4 + 0j],
            "std_real": [0.1, 0.1, 0.2, np.inf],
            "std_imag": [0.3, 0.3, 0.0, 0.0],
        }
    )
    display = EigenvalueDisplay(model=model).plot(level=level)
    upper, lower, line = display.uncertainty_
    reach = np.sqrt(chi2.ppf(level, 2))
    assert upper.width == pytest.approx(2 * reach * 0.1)
    assert lower.height == pytest.approx(2 * reach * 0.3)
    alone = norm.ppf(0.5 + level / 2)
    np.testing.assert_allclose(line.get_xdata(), [-3 - 0.2 * alone, -3 + 0.2 * alone])
    assert max(display.ax_.get_ylim()) > 5 + reach * 0.3


def test_maximum_likelihood_brings_its_deviations():
    matcher = cases.sliding(20, "output_error")["match"]
    display = EigenvalueDisplay.from_estimator(matcher)
    assert display.modes is None
    pd.testing.assert_frame_equal(display.model, matcher.eigenvalues_)
    assert len(display.uncertainty_) == 3


def test_periodic_models_show_their_exponents():
    display = EigenvalueDisplay.from_estimator(cases.periodic(), true=mathieu())
    np.testing.assert_allclose(points(display.true_points_), mathieu().floquet_exponents())
    exponents = cases.periodic()["match"].ltp_.floquet_exponents()
    np.testing.assert_allclose(points(display.model_points_), exponents)


def test_a_discrete_model_is_drawn_in_continuous_time():
    model = cases.search().best_estimator_
    display = EigenvalueDisplay.from_estimator(model, true=control.tf([1], [1, 1]))
    z = np.exp(points(display.model_points_) * model.model_.dt)
    np.testing.assert_allclose(np.sort(z), np.sort(model.eigenvalues_))
    np.testing.assert_allclose(points(display.true_points_), [-1.0])


def test_eigenvalues_of_nothing():
    with pytest.raises(ValueError, match="there is nothing to draw"):
        EigenvalueDisplay().plot()
    with pytest.raises(ValueError, match="level=2 must be a probability"):
        EigenvalueDisplay(true=[-1.0]).plot(level=2)


# ---- stabilization ----------------------------------------------------------------------------


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
    display = cases.stabilization()
    true = np.linalg.eigvals(cases.wing().A_exact)
    highest = display.modes[display.modes["order"] == 12]
    steady = highest.loc[highest["steady"], "eigenvalue"].to_numpy()
    assert np.abs(steady[:, None] - true).min(axis=0).max() < 1e-3 * np.abs(true).max()
    assert not display.modes.loc[display.modes["order"] == 1, "steady"].any()
    shown = sum(len(lines[0].get_ydata()) for lines in (display.steady_, display.wandering_))
    assert shown == sum(z.imag >= 0 for z in display.modes["eigenvalue"])


def test_stabilization_by_default_goes_beyond_the_order_chosen():
    display = StabilizationDisplay.from_data(*cases.plain_record())
    assert display.order == 2
    assert display.modes["order"].max() == 6


def test_stabilization_needs_a_regressor():
    with pytest.raises(TypeError, match="StabilizationDisplay needs a MOESPRegressor"):
        StabilizationDisplay.from_estimator(HarmonicAnalyzer(2.0), None, None)
    with pytest.raises(ValueError, match="tol must be a positive number in shares"):
        StabilizationDisplay.from_data(np.zeros(4), np.zeros(4), tol=0)


# ---- responses --------------------------------------------------------------------------------


def test_the_response_is_that_which_is_scored():
    u, y = cases.periodic_record()
    pipe = cases.periodic()
    display = ResponseDisplay.from_estimator(pipe, u, y)
    step, X = pipe[-1], pipe[:-1].transform(u)
    truth, simulated, rows = scored_simulation(step, X, y)
    for k, name in enumerate(y):
        t, values = finite(display.simulated_lines_["simulated", name])
        np.testing.assert_allclose(t, u.index[rows])
        np.testing.assert_allclose(values, simulated[:, k])
        np.testing.assert_allclose(finite(display.measured_lines_[name])[1], truth[:, k])
        score = fit_percent_scorer(output=name)(pipe, u, y)
        assert display.fit_.loc["simulated", name] == pytest.approx(score)
        assert display.axes_[1 + k].get_title("left") == f"fit {score:.1f} %"
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
    with pytest.raises(ValueError, match=r"validation_span=\(20, 30\) holds none of the rows"):
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
    with pytest.raises(TypeError, match="ResponseDisplay needs a fitted ModelStep"):
        ResponseDisplay.from_estimator(HarmonicAnalyzer(2.0), u, y)
    with pytest.raises(ValueError, match=r"'short' has shape \(10, 2\)"):
        ResponseDisplay.from_data(y, {"short": y.iloc[:10]})
    with pytest.raises(ValueError, match="have different indices; align them first"):
        ResponseDisplay.from_data(y, y.set_axis(y.index + 1.0))


# ---- frequency responses ----------------------------------------------------------------------


def test_bode_curves_are_those_of_the_system():
    hd = mathieu().harmonic_decomposition(1)
    frequencies = np.geomspace(0.1, 10.0, 30)
    display = BodeDisplay.from_systems({"hd": hd}, frequencies, inputs=["u1_0"], outputs=["y_1c"])
    g = hd["y_1c", "u1_0"](1j * frequencies)
    key = "hd", "y_1c", "u1_0"
    np.testing.assert_allclose(display.magnitude_lines_[key].get_ydata(), np.abs(g))
    phase = np.exp(1j * np.radians(display.phase_lines_[key].get_ydata()))
    np.testing.assert_allclose(phase, g / np.abs(g), atol=1e-12)
    assert np.abs(np.diff(display.phase_lines_[key].get_ydata())).max() < 180.0
    assert display.axes_[0].get_title("left") == "u1_0 → y_1c"


def test_bode_of_a_discrete_model_ends_at_half_the_sampling_frequency():
    model = cases.search().best_estimator_
    display = BodeDisplay.from_estimator(model)
    assert display.frequencies[-1] == pytest.approx(np.pi / model.model_.dt)
    z = np.exp(1j * display.frequencies * model.model_.dt)
    m = model.model_
    expected = frequency_response(m.A, m.B, m.C, m.D, z)
    np.testing.assert_allclose(display.responses["identified"], expected)


def test_bands_of_confidence_follow_the_deviations():
    display = cases.bode()
    matcher = cases.sliding(20, "output_error")["match"]
    _, std = matcher.frequency_response(display.frequencies)
    magnitude, _ = display.bands_["identified", "phi_dot_1s", "U_0"]
    g, s = display.responses["identified"][:, 2, 0], std[:, 2, 0]
    along = np.hypot(g.real * s.real, g.imag * s.imag) / np.abs(g)
    upper = magnitude.get_paths()[0].vertices[:, 1].max()
    assert upper == pytest.approx(np.max(np.abs(g) + 1.959964 * along), rel=1e-6)
    assert display.axes_[0].get_ylabel() == "magnitude (m/s per N m)"
    assert ("true", "w_0", "U_0") in display.magnitude_lines_


def test_bad_bode_input():
    hd = mathieu().harmonic_decomposition(1)
    with pytest.raises(TypeError, match=r"'model' is a LTPSystem \(an LTPSystem gives one by"):
        BodeDisplay.from_systems(mathieu())
    with pytest.raises(ValueError, match=r"outputs=\['z'\] are not all among"):
        BodeDisplay.from_systems(hd, outputs=["z"])
    with pytest.raises(ValueError, match="give models between the same signals"):
        BodeDisplay.from_systems({"one": hd, "other": mathieu().harmonic_decomposition(0)})
    with pytest.raises(ValueError, match="must be positive numbers in rad/s"):
        BodeDisplay.from_systems(hd, [0.0, 1.0])


def test_harmonic_transfer_functions_are_drawn_with_coherence():
    u, y = cases.random_steps()
    display = cases.harmonic_transfer()
    measured = estimate_harmonic_transfer_function(u, y[["y"]], 2.0, 1, periods_per_segment=30)
    model = cases._deflection().harmonic_transfer_function(
        measured.frequencies, 1, sample_time=np.pi / 16
    )
    for n in (-1, 0, 1):
        for label, response in (("measured", measured), ("model", model)):
            line = display.magnitude_lines_[label, "y", "u1", n]
            np.testing.assert_allclose(line.get_ydata(), np.abs(response.harmonic(n)[:, 0, 0]))
        coherence = display.coherence_lines_["measured", "y", n].get_ydata()
        np.testing.assert_array_equal(coherence, measured.coherence[:, 1 + n, 0])
        std = display.std_lines_["measured", "y", "u1", n].get_ydata()
        np.testing.assert_array_equal(std, measured.std[:, 1 + n, 0, 0])


def test_the_record_is_taken_about_its_trim():
    u, y = cases.random_steps()
    u, y = u.iloc[: 16 * 300], y.iloc[: 16 * 300].copy()
    u.iloc[: 16 * 60] = 0.0  # in trim
    t = u.index.to_numpy()
    y.iloc[:] = mathieu().simulate(u, t)
    waveform = np.cos(2.0 * t)[:, None] * [3.0, -2.0]
    span = (0.0, 16 * 60 * np.pi / 16)
    analyzer = HarmonicAnalyzer(2.0, output_harmonics=1, hop="period", trim_span=span)
    steps = [
        ("harmonics", analyzer),
        ("identify", MOESPRegressor(order=2)),
        ("match", StructuredMatcher()),
    ]
    pipe = Pipeline(steps).fit(u, y + waveform)
    display = HarmonicTransferFunctionDisplay.from_estimator(pipe, u, y + waveform)
    about = estimate_harmonic_transfer_function(u, y, 2.0, 1)
    drawn = display.magnitude_lines_["measured", "y", "u1", 0].get_ydata()
    expected = np.abs(about.harmonic(0)[:, 0, 0])
    good = about.coherence[:, 1, 0] > 0.99
    assert good.sum() > 80
    np.testing.assert_allclose(drawn[good], expected[good], rtol=1e-3)
    with pytest.raises(ValueError, match="X was given without y"):
        HarmonicTransferFunctionDisplay.from_estimator(pipe, u)


def test_bad_harmonic_transfer_input():
    one = mathieu().harmonic_transfer_function([1.0], 1)
    other = coupled().harmonic_transfer_function([1.0], 1)
    with pytest.raises(TypeError, match="'x' is a str"):
        HarmonicTransferFunctionDisplay({"x": "y"})
    with pytest.raises(ValueError, match="responses are between different signals"):
        HarmonicTransferFunctionDisplay({"one": one, "other": other})
    with pytest.raises(TypeError, match="draws LTPSystems; 'model' is a StateSpace"):
        HarmonicTransferFunctionDisplay.from_systems(mathieu().harmonic_decomposition(1))


# ---- participation and periodic matrices ------------------------------------------------------


def test_participations_are_shares_of_one():
    display = cases.participation()
    shares = coupled().modal_participation(2)
    assert len(display.bars_) == 4 * 3  # a pair of complex and two more modes, one of a pair each
    for (state, eigenvalue), bars in display.bars_.items():
        heights = [bar.get_height() for bar in bars]
        np.testing.assert_allclose(heights, shares.loc[state, eigenvalue])
        assert sum(heights) == pytest.approx(1.0)
        assert eigenvalue.imag >= 0.0 or np.conj(eigenvalue) not in shares.columns


def test_modes_may_be_named():
    display = ParticipationDisplay.from_system(mathieu(), mode_names=["lag"])
    assert display.legend_.get_texts()[0].get_text().startswith("lag, −0.1 ± ")
    with pytest.raises(ValueError, match=r"mode_names=\['a', 'b'\] must name the 1 modes drawn"):
        ParticipationDisplay.from_system(mathieu(), mode_names=["a", "b"])


def test_matrices_are_drawn_entry_by_entry_whatever_the_order_of_states():
    system = mathieu()

    def F(psi):
        return system.F(psi)[:, ::-1, ::-1]

    swapped = LTPSystem(F, [[1.0], [0.0]], omega=2.0, state_names=["v", "y"])
    display = PeriodicMatrixDisplay.from_systems(swapped, "F", true=system)
    assert display.axes_[0].get_title("left") == "F[v, v]"
    psi = np.radians(display.lines_["true", "v", "y"].get_xdata())
    for label in ("true", "model"):
        values = display.lines_[label, "v", "y"].get_ydata()
        np.testing.assert_allclose(values, -2.0 + np.cos(psi))


def test_rounding_is_not_magnified():
    F = np.zeros((3, 1, 1))
    F[0], F[1] = -2.0, 1e-14
    display = PeriodicMatrixDisplay.from_systems(LTPSystem(F, [[1.0]], omega=1.0))
    low, high = display.axes_[0].get_ylim()
    assert high - low > 0.5


def test_matrices_of_other_coordinates_are_not_compared():
    with pytest.raises(ValueError, match="entries of different coordinates cannot be compared"):
        PeriodicMatrixDisplay.from_systems(mathieu(), "F", true=mathieu(state_names=["a", "b"]))
    with pytest.raises(TypeError, match="draws LTPSystems; 'model' is a int is none"):
        PeriodicMatrixDisplay.from_systems(3)
    with pytest.raises(ValueError, match="matrix='A'"):
        PeriodicMatrixDisplay.from_systems(mathieu(), "A")
    with pytest.raises(ValueError, match="needs a linear time-periodic model"):
        PeriodicMatrixDisplay.from_estimator(cases.sliding())


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
    results = cv_results([0.5, np.nan, 0.8], [2, 4, 6])
    display = OrderSelectionDisplay.from_cv_results(results, misfit=True)
    assert display.failed_.get_xdata() == [4]
    np.testing.assert_allclose(display.lines_["default"][0].get_ydata(), [0.5, 0.2])
    assert display.ax_.get_yscale() == "log"
    with pytest.raises(ValueError, match="every candidate failed on some fold"):
        OrderSelectionDisplay.from_cv_results(cv_results([np.nan], [2]))


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
        marked = np.arange(len(line.get_xdata()))[line.get_markevery()]
        np.testing.assert_array_equal(line.get_xdata()[marked], own.index)
        np.testing.assert_array_equal(line.get_ydata()[marked], own["error"])
    assert display.end_.get_text() == f"{history['error'].iloc[-1]:.3g}"


def test_a_match_that_became_exact_is_drawn():
    history = pd.DataFrame({"stage": ["a", "b", "a"], "error": [1.0, 0.1, 0.0]})
    display = ConvergenceDisplay(history).plot()
    assert len(display.lines_["a"]) == 2
    assert display.lines_["a"][1].get_ydata()[-1] == pytest.approx(1e-3)
    assert display.end_.get_text() == "0"


def test_the_history_of_a_fitted_matcher():
    matcher = StructuredMatcher()
    matcher.__dict__.update(cases.sliding()["match"].__dict__)
    matcher.history_ = cases.history()
    display = ConvergenceDisplay.from_estimator(Pipeline([("match", matcher)]))
    assert display.history is matcher.history_


def test_bad_histories():
    with pytest.raises(ValueError, match="history lacks the column 'error'"):
        ConvergenceDisplay(pd.DataFrame({"stage": []}))
    with pytest.raises(ValueError, match="history is empty: the match took no iteration"):
        ConvergenceDisplay(cases.history().iloc[:0])
