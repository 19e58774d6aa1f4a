"""All displays: figures and Axes, units, letters that cover none, the steps they are made from."""

from functools import lru_cache
from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np
import plotting_cases as cases
import pytest
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer, StructuredMatcher
from sklearn_hd.plotting import (
    AzimuthDisplay,
    BodeDisplay,
    ConvergenceDisplay,
    EigenvalueDisplay,
    HarmonicsDisplay,
    HarmonicTransferFunctionDisplay,
    ParticipationDisplay,
    PeriodicMatrixDisplay,
    ResponseDisplay,
    SingularValueDisplay,
    StabilizationDisplay,
)


@lru_cache
def made(name):
    """A display on a figure of its own, and how many figures that made."""
    before = len(plt.get_fignums())
    return cases.DISPLAYS[name][0](), len(plt.get_fignums()) - before


def axes_of(display):
    """The Axes of a display, one or several."""
    return np.atleast_1d(display.ax_ if hasattr(display, "ax_") else display.axes_)


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
@pytest.mark.slow
def test_a_new_figure_is_made_and_kept(name):
    display, n_figures = made(name)
    n_panels = cases.DISPLAYS[name][1]
    assert n_figures == 1
    assert len(axes_of(display)) == n_panels
    assert all(axis.figure is display.figure_ for axis in axes_of(display))
    assert display.figure_.get_layout_engine() is not None
    display.figure_.draw_without_rendering()  # warnings, of collapsed panels too, are errors
    check_texts(display.figure_)


@pytest.mark.parametrize("name", cases.DISPLAYS)
@pytest.mark.slow
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
@pytest.mark.slow
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
    with pytest.raises(TypeError, match="is not a matplotlib Axes; give one"):
        make("left")


def test_axes_outside_a_grid_cannot_be_divided():
    with pytest.raises(ValueError, match="is not in a grid of subplots, so it cannot be divided"):
        cases.participation(plt.figure().add_axes((0.1, 0.1, 0.8, 0.8)))


@pytest.mark.parametrize("name", cases.DISPLAYS)
def test_every_outer_axis_is_labelled_with_its_unit(name):
    display = made(name)[0]
    axes = axes_of(display)
    bottom = min(axis.get_subplotspec().get_position(display.figure_).y0 for axis in axes)
    lowest = [a for a in axes if a.get_subplotspec().get_position(display.figure_).y0 == bottom]
    for axis in lowest:
        assert axis.get_xlabel().split("(")[1] in ("s)", "–)", "1/s)", "rad/s)", "deg)")
    for axis in axes:
        assert axis.get_ylabel() or axis.get_title("left") or axis is not axes[0]


@pytest.mark.parametrize("name", cases.DISPLAYS)
def test_nothing_is_told_by_colour_alone(name):
    for axis in axes_of(made(name)[0]):
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


def test_a_legend_below_is_no_wider_than_its_figure():
    name = "identified from the second flight of Tuesday, in calm air, at 2 % of the trim torque"
    display = EigenvalueDisplay(model=[-1.0], true=[-1.1], model_name=name).plot()
    display.figure_.draw_without_rendering()
    check_texts(display.figure_)
    assert len(display.legend_.get_texts()) == 2
    assert display.figure_.legends == [display.legend_]


def of_signals(count):
    signals = cases.many_signals(count)
    yield HarmonicsDisplay.from_data(signals, 2 * np.pi)
    yield ResponseDisplay.from_data(signals, 0.9 * signals)
    yield ResponseDisplay(signals, {"model": 0.9 * signals}, loads=0.0501 * signals).plot()
    yield StabilizationDisplay(cases.modes_of(range(1, count + 1)), order=count).plot()


def of_states(count):
    system = cases.large_system(count)
    yield ParticipationDisplay.from_system(system)
    yield PeriodicMatrixDisplay.from_systems(system, "G")
    yield HarmonicTransferFunctionDisplay.from_systems(system, 1, [0.5, 1.0, 2.0])


@pytest.mark.parametrize("make", [of_signals, of_states])
@pytest.mark.parametrize("count", [1, 4, 12])
@pytest.mark.slow
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
    AzimuthDisplay: "MOESPRegressor",
    HarmonicsDisplay: "HarmonicAnalyzer",
    SingularValueDisplay: "MOESPRegressor",
    EigenvalueDisplay: "MOESPRegressor, SpuriousModeReducer or StructuredMatcher",
    ConvergenceDisplay: "StructuredMatcher",
    BodeDisplay: "MOESPRegressor, SpuriousModeReducer or StructuredMatcher",
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
    with pytest.raises(TypeError, match="is a class; give a fitted instance"):
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
