"""Step responses, pole maps and picks of modes: what is drawn is right."""

import control
import numpy as np
import plotting_cases as cases
import pytest
from matplotlib.backend_bases import MouseEvent

from sklearn_hd.plotting import BodeDisplay, EigenvalueDisplay, StepResponseDisplay


def lag(pole=-2.0, gain=3.0, direct=0.5, **options):
    names = {"inputs": ["u"], "outputs": ["y"]}
    return control.ss([[pole]], [[gain]], [[1.0]], [[direct]], **names, **options)


@pytest.mark.parametrize("kind", ["step", "impulse"])
def test_responses_are_those_of_the_closed_form(kind):
    display = StepResponseDisplay.from_systems(lag(), kind=kind, duration=3.0)
    t, y = display.times["model"], display.responses["model"][:, 0, 0]
    exact = 3.0 * np.exp(-2.0 * t)
    if kind == "step":
        exact = 0.5 + 1.5 * (1.0 - np.exp(-2.0 * t))
    np.testing.assert_allclose(y, exact, rtol=1e-9)
    np.testing.assert_array_equal(display.lines_["model", "y", "u"].get_ydata(), y)


def test_discrete_models_agree_with_control_and_an_impulse_has_area_one():
    discrete = control.c2d(lag(), 0.1)
    both = {"discrete": discrete, "continuous": lag()}
    step = StepResponseDisplay.from_systems(both, duration=2.0)
    expected = control.step_response(discrete, step.times["discrete"]).y[0, 0]
    np.testing.assert_allclose(step.responses["discrete"][:, 0, 0], expected, rtol=1e-9)
    assert step.held == {"discrete"}
    impulse = StepResponseDisplay.from_systems(discrete, kind="impulse", duration=2.0)
    expected = control.forced_response(discrete, impulse.times["model"], np.eye(1, 21)).y[0]
    np.testing.assert_allclose(
        impulse.responses["model"][:, 0, 0], expected.ravel() / 0.1, rtol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["step", "impulse"])
def test_bands_are_those_of_parameters_drawn_from_their_covariance(kind):
    pipe = cases.sliding(20, "output_error")
    display = StepResponseDisplay.from_estimator(pipe, kind=kind)
    matcher, std = pipe["match"], display.std["identified"]
    found, time = matcher.match_, display.times["identified"]
    rng = np.random.default_rng(0)
    size = found.theta_std  # parameters differ by 1e8 in size
    alike = found.uncertainty.covariance / np.outer(size, size)
    drawn = found.theta + size * rng.multivariate_normal(np.zeros(len(size)), alike, 500)
    systems = {
        str(k): control.ss(*found.uncertainty.affine.matrices(theta[found.uncertainty.seen]))
        for k, theta in enumerate(drawn)
    }
    cloud = StepResponseDisplay.from_systems(
        {label: _named(system, matcher.system_) for label, system in systems.items()},
        kind=kind,
        duration=time[-1],
    )
    spread = np.std([cloud.responses[label] for label in systems], axis=0)
    places = slice(5, None, 40)  # 500 draws tell a deviation within 3 % (one sigma)
    np.testing.assert_allclose(std[places], spread[places], rtol=0.2)
    band = display.bands_["identified", "w_0", "U_0"].get_paths()[0].vertices
    response = display.responses["identified"][:, 0, 0]
    assert np.isclose(band[:, 1].max(), np.max(response + 1.959964 * std[:, 0, 0]))


def _named(system, like):
    names = {"inputs": like.input_labels, "outputs": like.output_labels}
    return control.ss(system.A, system.B, system.C, system.D, **names)


@pytest.mark.slow
def test_a_band_that_no_one_sees_is_named_in_the_legend():
    time, y = np.linspace(0.0, 1.0, 20), np.linspace(0.0, 1.0, 20)[:, None, None]
    names = {"input_names": ["u"], "output_names": ["y"]}
    for share, words in ((1e-3, ", narrower than the line"), (0.1, "")):
        std = {"model": np.full(y.shape, share)}
        display = StepResponseDisplay({"model": time}, {"model": y}, std=std, **names).plot()
        shown = [text.get_text() for text in display.legend_.get_texts()]
        assert shown == ["model", f"95 % confidence{words}"]
    pipe = cases.sliding(20, "output_error")
    bode = BodeDisplay.from_estimator(pipe, np.geomspace(0.5, 2000.0, 40))
    assert "95 % confidence" in [t.get_text() for t in bode.legend_.get_texts()]


@pytest.mark.slow
def test_what_has_no_one_step_response_is_refused():
    with pytest.raises(ValueError, match="kind='ramp' is unknown; give 'step' or 'impulse'"):
        StepResponseDisplay.from_systems(lag(), kind="ramp")
    with pytest.raises(ValueError, match="duration must be a positive number in seconds"):
        StepResponseDisplay.from_systems(lag(), duration=0)
    with pytest.raises(ValueError, match="has no single step response"):
        StepResponseDisplay.from_estimator(cases.sampled())


# ---- pole map ---------------------------------------------------------------------------------


def test_poles_of_several_systems_share_an_axis():
    systems = {"a": lag(), "b": control.c2d(lag(-4.0), 0.01)}
    display = EigenvalueDisplay.from_systems(systems)
    assert list(display.model_points_) == ["a", "b"]
    for label, pole in (("a", -2.0), ("b", -4.0)):
        assert np.isclose(display.model_points_[label].get_xdata()[0], pole)


def test_the_grid_holds_damping_ratios_frequencies_and_strips():
    poles = np.array([-1.0 + 5.0j, -1.0 - 5.0j])
    display = EigenvalueDisplay(model=poles, omega=4.0).plot(grid=True)
    ratios, sizes, edges = set(), set(), set()
    for line in display.grid_lines_:
        z = np.asarray(line.get_xdata()) + 1j * np.asarray(line.get_ydata())
        if line.get_linestyle() == "--":
            edges.add(line.get_ydata()[0])
        elif len(z) == 2:
            ratios.add(round(-z[1].real / abs(z[1]), 6))
        else:
            assert np.ptp(np.abs(z)) < 1e-9
            sizes.add(round(abs(z[0]), 6))
    assert {0.1, 0.3, 0.5, 0.7, 0.9} < ratios
    assert {1.0, 2.0, 3.0} & sizes
    assert edges == {-6.0, -2.0, 2.0, 6.0}


def test_models_of_several_pipelines_share_an_axis():
    pipes = {"clean": cases.sliding(), "noisy": cases.sliding(20, "output_error")}
    display = EigenvalueDisplay.from_estimator(pipes)
    assert list(display.model_points_) == ["clean", "noisy"]
    assert len(display.uncertainty_) == 3  # of the one with maximum likelihood


# ---- stabilization ----------------------------------------------------------------------------


def test_frequency_damping_and_shape_are_told_apart():
    display = cases.stabilization()
    told = display.modes
    steady = told[["frequency_steady", "damping_steady", "shape_steady"]].all(axis=1)
    assert (told["steady"] == steady).all()
    assert {"all", "frequency and shape", "none"} <= {
        what for what, lines in display.points_.items() if len(lines[0].get_xdata())
    }


def test_the_spectrum_integrates_to_the_variances():
    spectrum = cases.stabilization().spectrum
    area = np.trapezoid(spectrum, spectrum.index)
    assert 0.5 < area < 2.5  # two outputs; segments of the record hold less of its slow part


@pytest.mark.slow
def test_a_click_picks_a_mode_and_a_second_one_drops_it():
    display = cases.stabilization()
    figure, line = display.figure_, display.points_["all"][0]
    figure.canvas.draw()
    axis = display.axes_[0]
    place = axis.transData.transform((line.get_xdata()[-1], line.get_ydata()[-1]))
    click = MouseEvent("button_press_event", figure.canvas, *place, button=1)
    figure.canvas.callbacks.process("button_press_event", click)
    assert list(display.picked_["order"]) == [line.get_ydata()[-1]]
    z = display.picked_["eigenvalue"].iloc[0]
    assert z.imag == line.get_xdata()[-1]
    assert np.isclose(display.picked_["frequency"].iloc[0], abs(z))
    assert np.isclose(display.picked_["damping_ratio"].iloc[0], -z.real / abs(z))
    assert display.picks_[0].get_xdata()[0] == z.imag
    figure.canvas.callbacks.process("button_press_event", click)
    assert len(display.picked_) == 0
