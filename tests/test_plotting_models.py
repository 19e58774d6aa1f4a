"""Displays of models: singular values, eigenvalues, frequency responses, periodic matrices."""

import copy
import itertools
from dataclasses import replace
from types import SimpleNamespace

import control
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import plotting_cases as cases
import pytest
from periodic_cases import coupled, mathieu
from scipy.stats import chi2, norm
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, StructuredMatcher
from sklearn_hd._opinion import Opinion
from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.plotting import (
    BodeDisplay,
    EigenvalueDisplay,
    HarmonicTransferFunctionDisplay,
    ParticipationDisplay,
    PeriodicMatrixDisplay,
    SingularValueDisplay,
    StepResponseDisplay,
)
from sklearn_hd.plotting._display import chosen_pairs
from sklearn_hd.systems import LTPSystem, estimate_harmonic_transfer_function


def points(line):
    """Complex numbers that a line shows in the plane."""
    return line.get_xdata() + 1j * line.get_ydata()


# ---- singular values --------------------------------------------------------------------------


def test_what_simulations_left_is_drawn_where_they_decided(rng):
    """Instead of a floor and a gap, which did not."""
    u, y = rng.standard_normal((300, 1)), np.zeros((300, 1))
    for k in range(299):
        y[k + 1] = 0.8 * y[k] + u[k]
    model = MOESPRegressor(block_rows=5).fit(u, y + 0.1 * rng.standard_normal((300, 1)))
    display = SingularValueDisplay.from_estimator(model)
    search = model.order_search_
    drawn = search["stable"] & search["feedthrough"]  # orders are compared with D free
    np.testing.assert_array_equal(display.left_.get_ydata(), search["share"][drawn])
    assert display.floor_ is None
    assert display.gap_.get_label() == "order chosen"


def test_singular_values_are_those_of_the_model():
    model = cases.sliding(20)["identify"]
    display = SingularValueDisplay.from_estimator(cases.sliding(20), count=20)
    drawn = [*display.kept_.get_ydata(), *display.left_out_.get_ydata()]
    np.testing.assert_array_equal(drawn, model.singular_values_[:20])
    np.testing.assert_array_equal(display.kept_.get_xdata(), np.arange(1, model.order_ + 1))
    assert display.floor_.get_ydata()[0] == model.noise_floor_
    assert display.ax_.get_yscale() == "log"


@pytest.mark.parametrize("least", [0.6, 0.02, 2e-4, 1e-5, 1e-12])
def test_labels_of_what_simulations_left_are_there_and_apart(least):
    order, every = np.arange(1, 9), np.ones(8, dtype=bool)
    search = {"order": order, "feedthrough": every, "stable": every, "bic": -order}
    search["share"] = np.geomspace(1.0, least, 8)
    display = SingularValueDisplay(np.geomspace(100.0, 1.0, 20), 4, search=search).plot()
    display.figure_.draw_without_rendering()
    axis = display.left_.axes
    low, high = axis.get_ylim()
    ticks = [*axis.yaxis.get_major_ticks(), *axis.yaxis.get_minor_ticks()]
    labels = [tick.label2 for tick in ticks if low <= tick.get_loc() <= high]
    boxes = [label.get_window_extent() for label in labels if label.get_text()]
    boxes.sort(key=lambda box: box.y0)
    assert len(boxes) >= 2
    assert all(upper.y0 > lower.y1 for lower, upper in itertools.pairwise(boxes))


def test_a_search_that_lacks_something_is_refused():
    with pytest.raises(
        ValueError, match=r"search lacks \['bic', 'feedthrough', 'share', 'stable'\]; give"
    ):
        SingularValueDisplay([3.0, 2.0], 1, search={"order": [1, 2]})


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


@pytest.mark.parametrize("own", [True, False])
def test_exponents_in_doubt_stand_beside_the_second_opinion(own):
    """One of its own says how well it knows them; another has a value, and may be surer."""
    step = copy.deepcopy(cases.periodic()[1])
    model, z = step.model_, step.model_.exponents()
    assert EigenvalueDisplay.from_estimator(step).doubt_points_ is None
    other = z if own else 1.2 * z.real + 1j * z.imag
    spread = np.full(len(z), 0.2 if own else 1e-3) * np.abs(z)
    opinion = Opinion(other, spread, 2.0, "halves of the record have", own)
    step.model_ = replace(model, opinion=opinion)
    display = EigenvalueDisplay.from_estimator(step)
    np.testing.assert_allclose(points(display.doubt_points_), z)
    if own:
        assert display.opinion_points_ is None
    else:
        np.testing.assert_allclose(points(display.opinion_points_), other)


def test_every_verdict_of_the_reducer_has_a_look():
    modes = pd.DataFrame({"eigenvalue": np.arange(-6.0, 0.0), "family": range(6)})
    modes["verdict"] = ["genuine", "copy", "window", "weak", "ambiguous", "second-order"]
    assert set(EigenvalueDisplay(modes).plot().mode_points_) == set(modes["verdict"])


def test_eigenvalues_of_nothing():
    with pytest.raises(ValueError, match="there is nothing to draw"):
        EigenvalueDisplay().plot()
    with pytest.raises(ValueError, match="level=2 must be a probability"):
        EigenvalueDisplay(true=[-1.0]).plot(level=2)
    with pytest.raises(ValueError, match="with the columns eigenvalue and opinion"):
        EigenvalueDisplay(model=[-1.0], doubts=pd.DataFrame({"eigenvalue": [-1.0]}))


# ---- frequency responses ----------------------------------------------------------------------


def test_bode_curves_are_those_of_the_system():
    hd = mathieu().harmonic_decomposition(1)
    frequencies = np.geomspace(0.1, 10.0, 30)
    display = BodeDisplay.from_systems({"hd": hd}, frequencies, inputs=["u1_0"], outputs=["y_1c"])
    g = hd(1j * frequencies)[hd.output_labels.index("y_1c"), hd.input_labels.index("u1_0")]
    key = "hd", "y_1c", "u1_0"
    np.testing.assert_allclose(display.magnitude_lines_[key].get_ydata(), np.abs(g))
    phase = np.exp(1j * np.radians(display.phase_lines_[key].get_ydata()))
    np.testing.assert_allclose(phase, g / np.abs(g), atol=1e-12)
    assert np.abs(np.diff(display.phase_lines_[key].get_ydata())).max() < 180.0
    assert display.axes_[0].get_title("left") == "u1_0 → y_1c"


@pytest.mark.parametrize("display", [BodeDisplay, StepResponseDisplay])
def test_of_many_pairs_those_of_the_lowest_harmonics_are_drawn(display):
    hd = mathieu().harmonic_decomposition(3)
    count = len(hd.output_labels) * len(hd.input_labels)
    lowest = [name for name in hd.output_labels if name.endswith("_0")]
    drawn = display.from_systems(hd)
    lines = drawn.lines_ if display is StepResponseDisplay else drawn.magnitude_lines_
    assert list(lines) == [("model", name, "u1_0") for name in lowest]
    told = f"{len(lowest)} of {count} pairs: the lowest harmonic of each signal\n"
    assert [axis.get_title("left").startswith(told) for axis in drawn.axes_].count(True) == 1
    assert drawn.axes_[0].get_title("left").startswith(told)
    asked = display.from_systems(hd, outputs=["y_1c"]).axes_[0].get_title("left")
    assert "pairs" not in asked


@pytest.mark.parametrize(
    ("inputs", "outputs", "n_asked", "shown", "words"),
    [
        (30, 40, 0, (24, 1), "24 of 1200 pairs: the first signals\n"),
        (4, 40, 0, (4, 6), "24 of 160 pairs: the first signals\n"),
        (40, 30, 30, (1, 30), "30 of 1200 pairs: the first signals\n"),
        (4, 6, 0, (4, 6), ""),
    ],
)
def test_of_many_pairs_without_harmonics_the_first_are_drawn(
    inputs, outputs, n_asked, shown, words
):
    names = [f"u_{i}" for i in range(inputs)], [f"y_{o}" for o in range(outputs)]
    display = SimpleNamespace(input_names=names[0], output_names=names[1])
    pairs, _, told = chosen_pairs(None, names[1][:n_asked] or None, display)
    assert told == words
    assert len(pairs) == shown[0] * shown[1]
    assert {i for _, i in pairs} == set(range(shown[0]))
    assert {o for o, _ in pairs} == set(range(shown[1]))


def test_a_signal_without_a_mean_is_drawn_at_its_own_lowest_harmonic():
    outputs = ["w_0", "phi_1c", "phi_1s"] + [f"w_{k}{cs}" for k in range(1, 6) for cs in "cs"]
    display = SimpleNamespace(input_names=["u_0", "v_0"], output_names=outputs)
    pairs, _, told = chosen_pairs(None, None, display)
    assert pairs == [(o, i) for i in range(2) for o in range(3)]
    assert told == "6 of 26 pairs: the lowest harmonic of each signal\n"


def test_the_truth_may_have_more_signals_than_the_models():
    hd, frequencies = mathieu().harmonic_decomposition(1), np.geomspace(0.1, 10.0, 30)
    row, column = hd.output_labels.index("y_1c"), hd.input_labels.index("u1_1s")
    part = control.StateSpace(
        hd.A, hd.B[:, [column]], hd.C[[row]], [[0.0]], inputs=["u1_1s"], outputs=["y_1c"]
    )
    display = BodeDisplay.from_systems(part, frequencies, true=hd)
    expected = hd(1j * frequencies)[row, column]
    np.testing.assert_allclose(display.responses["true"][:, 0, 0], expected, rtol=1e-9)
    np.testing.assert_allclose(display.responses["model"][:, 0, 0], expected, rtol=1e-9)


def test_bode_of_a_discrete_model_ends_at_half_the_sampling_frequency():
    model = cases.search().best_estimator_
    display = BodeDisplay.from_estimator(model)
    assert display.frequencies[-1] == pytest.approx(np.pi / model.model_.dt)
    z = np.exp(1j * display.frequencies * model.model_.dt)
    m = model.model_
    expected = frequency_response(m.A, m.B, m.C, m.D, z)
    np.testing.assert_allclose(display.responses["identified"], expected)


@pytest.mark.slow
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
    with pytest.raises(
        TypeError, match=r"'model' is of type LTPSystem \(an LTPSystem gives one by"
    ):
        BodeDisplay.from_systems(mathieu())
    with pytest.raises(ValueError, match=r"outputs=\['z'\] are not all among"):
        BodeDisplay.from_systems(hd, outputs=["z"])
    with pytest.raises(ValueError, match="give models between the same signals"):
        BodeDisplay.from_systems({"one": hd, "other": mathieu().harmonic_decomposition(0)})
    with pytest.raises(ValueError, match=r"'true' has the inputs .* give models between the same"):
        BodeDisplay.from_systems(hd, true=mathieu().harmonic_decomposition(0))
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


@pytest.mark.slow
def test_the_record_is_taken_about_its_trim():
    u, y = cases.random_steps()
    u, y = u.iloc[: 16 * 300].copy(), y.iloc[: 16 * 300].copy()
    u.iloc[: 16 * 60] = 0.0  # in trim
    t = u.index.to_numpy()
    y.iloc[:] = mathieu().simulate(u, t)
    waveform = np.cos(2.0 * t)[:, None] * [3.0, -2.0]
    span = (0.0, 16 * 60 * np.pi / 16)
    analyzer = HarmonicAnalyzer(2.0, output_harmonics=1, reading="period", trim_span=span)
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
    with pytest.raises(TypeError, match="'x' is of type str"):
        HarmonicTransferFunctionDisplay({"x": "y"})
    with pytest.raises(ValueError, match="responses must have the same signals"):
        HarmonicTransferFunctionDisplay({"one": one, "other": other})
    with pytest.raises(TypeError, match="draws LTPSystems; 'model' is of type StateSpace"):
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


def test_entries_of_matrices_have_units():
    units = {"y": "m", "v": "m/s", "u": "N"}
    for matrix, expected in {
        "F": ["1/s", "m/s per m/s", "(m/s)/s per m", "1/s"],
        "G": ["m/s per N", "(m/s)/s per N"],
        "P": ["", "m per m/s"],
    }.items():
        system = LTPSystem(
            np.eye(2), [[0.0], [1.0]], [[1.0, 0.0]], omega=2.0,
            state_names=["y", "v"], input_names=["u"], output_names=["y"],
        )  # fmt: skip
        display = PeriodicMatrixDisplay.from_systems(system, matrix, units=units)
        assert [axis.get_ylabel().replace("\n", " ") for axis in display.axes_] == expected
    assert display.plot(units={"y": "m"}).axes_[1].get_ylabel() == ""
    with pytest.raises(TypeError, match="units='m' is not a dict"):
        display.plot(units="m")


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


def test_ticks_of_small_panels_are_those_of_the_layout():
    """The layout gives panels another height, and the room for letters that they had before."""
    display = PeriodicMatrixDisplay.from_systems(cases.large_system(4))
    display.figure_.draw_without_rendering()
    ticks = [axis.get_yticks() for axis in display.axes_]
    width, height = display.figure_.get_size_inches()
    display.figure_.set_size_inches(width, 1.4 * height)
    display.figure_.draw_without_rendering()
    for axis, before in zip(display.axes_, ticks, strict=True):
        np.testing.assert_array_equal(axis.get_yticks(), before)
    labels = [label for axis in display.axes_[::4] for label in axis.get_yticklabels()]
    assert min(label.get_window_extent().x0 for label in labels) >= 0.0


def test_matrices_of_other_coordinates_are_not_compared():
    with pytest.raises(ValueError, match="entries in different coordinates cannot be compared"):
        PeriodicMatrixDisplay.from_systems(mathieu(), "F", true=mathieu(state_names=["a", "b"]))
    with pytest.raises(TypeError, match="draws LTPSystems; 'model' is of type int"):
        PeriodicMatrixDisplay.from_systems(3)
    with pytest.raises(ValueError, match="matrix='A'"):
        PeriodicMatrixDisplay.from_systems(mathieu(), "A")
    with pytest.raises(ValueError, match="needs a linear time-periodic model"):
        PeriodicMatrixDisplay.from_estimator(cases.sliding())


def test_a_discrete_truth_is_drawn_where_the_logarithm_of_its_poles_lies():
    system = control.ss([[0.5]], [[1.0]], [[1.0]], [[0.0]], 0.1)
    display = EigenvalueDisplay.from_systems(system, true=system)
    np.testing.assert_allclose(display.true, np.log(0.5) / 0.1)


def test_bode_axes_that_do_not_share_x_are_all_logarithmic():
    system = control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]])
    _, axes = plt.subplots(2, 1)
    BodeDisplay.from_systems(system).plot(ax=axes)
    assert [axis.get_xscale() for axis in axes] == ["log", "log"]
    np.testing.assert_allclose(axes[1].get_xlim(), axes[0].get_xlim())
    assert axes[0].get_xlim()[1] > 10.0
