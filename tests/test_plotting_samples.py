"""Displays of models of samples at their azimuths: what they draw is the model's, and true."""

import numpy as np
import plotting_cases as cases
import pytest
from periodic_cases import mathieu
from sklearn.base import clone
from sklearn.pipeline import Pipeline, make_pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd._frame import SampleModel
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.plotting import (
    AzimuthDisplay,
    BodeDisplay,
    EigenvalueDisplay,
    HarmonicsDisplay,
    HarmonicTransferFunctionDisplay,
    ParticipationDisplay,
    PeriodicMatrixDisplay,
    ResponseDisplay,
    SingularValueDisplay,
    StabilizationDisplay,
)
from sklearn_hd.systems import estimate_harmonic_transfer_function


def true_loads(time):
    return np.cos(2.0 * time + 0.5) + 0.3 * np.sin(6.0 * time)


# ---- loads and dynamics over a turn -----------------------------------------------------------


def test_loads_over_azimuth_and_their_harmonics_are_true():
    display = cases.azimuth()
    line = display.load_lines_["y"]
    expected = true_loads(np.radians(line.get_xdata()) / 2.0)
    np.testing.assert_allclose(line.get_ydata(), expected, atol=0.03)
    np.testing.assert_allclose(display.amplitudes_["y"][:4], [1.0, 0.0, 0.3, 0.0], atol=0.02)
    heights = [bar.get_height() for bar in display.bars_["y"]]
    np.testing.assert_array_equal(heights, display.amplitudes_["y"])
    assert display.axes_[1].get_title("left").startswith("largest: harmonic 1, ")


def test_loads_are_measured_against_innovations():
    """Without that, an axis magnifies loads that are none."""
    display = cases.azimuth()
    assert display.noise_lines_["y"].get_ydata()[0] == pytest.approx(0.05, rel=0.1)
    quiet = AzimuthDisplay(
        1e-3 * display.loads, display.pulses, display.step, input_names=["u1"], noise=display.noise
    ).plot()
    assert quiet.axes_[1].get_ylim()[1] > display.noise["y"]
    low, high = quiet.axes_[0].get_ylim()
    assert high - low >= 2.0 * display.noise["y"]


def test_a_pulse_gives_what_it_changes_in_a_simulation():
    (u, _), pipe, display = cases.service_record(), cases.sampled(), cases.azimuth()
    for row, psi in ((18, 90), (36, 180), (0, 0)):  # 25 degrees from row to row
        line = display.pulse_lines_["y", "u1", psi].get_ydata()
        pushed = u.copy()
        pushed.iloc[row] += 1.0
        change = (pipe.predict(pushed) - pipe.predict(u))["y"].to_numpy()
        np.testing.assert_allclose(line, change[row : row + len(line)], atol=1e-9)


def test_shares_of_harmonics_are_of_the_whole_response():
    display = cases.azimuth()
    shares = display.shares_["y", "u1"]
    assert np.sum(shares**2) == pytest.approx(1.0, abs=1e-6)
    assert shares[0] > shares[1] > 0.2 > shares[2]
    mean = np.mean(display.pulses, axis=0)
    expected = np.sqrt(np.sum(mean**2) / np.mean(np.sum(display.pulses**2, axis=1)))
    assert shares[0] == pytest.approx(expected)


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_constant_dynamics_are_alike_at_each_azimuth():
    display = AzimuthDisplay.from_estimator(cases.sampled(output_harmonics=0))
    lines = [line.get_ydata() for line in display.pulse_lines_.values()]
    np.testing.assert_allclose(lines, [lines[0]] * 4, atol=1e-12)
    assert display.axes_[3].get_title("left") == "0 % of the response varies over the turn"


def test_azimuths_turns_and_signals_may_be_chosen():
    display = AzimuthDisplay.from_estimator(
        cases.sampled(), turns=1.5, azimuths=[30, -60], outputs=["y"], inputs="u1"
    )
    assert list(display.pulse_lines_) == [("y", "u1", 30), ("y", "u1", -60)]
    assert display.axes_[2].get_xlim() == pytest.approx((0.0, 550.0))  # 22 rows of 25 degrees
    with pytest.raises(
        ValueError, match="turns must be a positive number in revolutions, got 0; 2 is"
    ):
        AzimuthDisplay.from_estimator(cases.sampled(), turns=0)
    with pytest.raises(ValueError, match=r"azimuths=\(0.5, 90\) must be whole degrees"):
        display.plot(azimuths=(0.5, 90))
    with pytest.raises(ValueError, match=r"outputs=\['z'\] are not all among \['y'\]"):
        display.plot(outputs=["z"])


def test_a_model_of_another_reading_has_no_loads():
    needs = "needs a model of samples at their azimuths, but this one was fitted with reading="
    with pytest.raises(ValueError, match=f"AzimuthDisplay {needs}'period'; fit behind"):
        AzimuthDisplay.from_estimator(cases.periodic())
    with pytest.raises(ValueError, match=f"PeriodicMatrixDisplay {needs}"):
        PeriodicMatrixDisplay.from_estimator(cases.periodic(), "K")
    with pytest.raises(ValueError, match=f"ResponseDisplay {needs}"):
        ResponseDisplay.from_estimator(cases.periodic(), *cases.periodic_record(), loads=True)


# ---- measured against simulated ---------------------------------------------------------------


def test_an_output_is_drawn_in_its_parts():
    display = cases.response_with_loads()
    parts = display.parts_
    total = parts["loads"] + parts["response to the inputs"] + parts["residual"]
    np.testing.assert_allclose(total, display.measured, atol=1e-12)
    time = display.measured.index.to_numpy()
    np.testing.assert_allclose(parts["loads"]["y"], true_loads(time), atol=0.03)
    u, _ = cases.service_record()
    caused = cases._deflection().simulate(u.to_numpy(), u.index.to_numpy())[-len(time) :, 0]
    left = parts["response to the inputs"]["y"].to_numpy() - caused
    assert np.std(left) < 0.05 * np.std(caused)
    drawn = display.part_lines_["loads", "y"]
    assert 100.0 <= min(drawn.get_xdata()) <= max(drawn.get_xdata()) <= 120.0
    assert display.axes_[2].get_title("left").startswith("std: loads 0.73, inputs 0.6")


@pytest.mark.slow
def test_models_about_different_trims_are_judged_each_by_its_own():
    """A model of samples has loads in it, another reading subtracts the trim: errors are theirs."""
    u, y = cases.periodic_record()
    y = y + np.outer(2.0 * np.cos(2.0 * y.index.to_numpy()), [1.0, 0.5])
    models = {"sampled": cases.sampled(), "synchronous": cases.periodic()}
    models = {label: clone(model).fit(u, y) for label, model in models.items()}
    both = ResponseDisplay.from_estimator(models, u, y)
    assert both.fit_.to_numpy().min() > 90.0
    for label, model in models.items():
        t = both.simulated_lines_[label, "y"].get_xdata()
        alone = ResponseDisplay.from_estimator(model, u.loc[: t[-1]], y.loc[: t[-1]])
        np.testing.assert_allclose(both.fit_.loc[label], alone.fit_.loc["simulated"], atol=1.0)


def test_loads_go_with_one_model():
    pipe = cases.sampled()
    with pytest.raises(ValueError, match="loads belong to one model, but 2 are drawn"):
        ResponseDisplay.from_estimator({"a": pipe, "b": pipe}, *cases.service_record(), loads=True)


# ---- the other displays -----------------------------------------------------------------------


@pytest.mark.parametrize("matrix", "ABCDK")
def test_matrices_from_sample_to_sample(matrix):
    display = PeriodicMatrixDisplay.from_estimator(cases.sampled(), matrix)
    innovations = cases.sampled()["identify"].model_.innovations
    parts = dict(zip("ABCD", innovations.matrices(), strict=True)) | {"K": innovations.gain}
    expected = evaluate_harmonics(parts[matrix], display.psi)
    shape = expected.shape[1:]
    assert (len(display.row_names), len(display.column_names)) == shape
    for (i, j), axis in zip(np.ndindex(shape), display.axes_, strict=True):
        np.testing.assert_array_equal(axis.lines[0].get_ydata(), expected[:, i, j])
    with pytest.raises(ValueError, match=f"matrix='{matrix}' has states of its own"):
        PeriodicMatrixDisplay.from_estimator(cases.sampled(), matrix, true=mathieu())
    with pytest.raises(ValueError, match="matrix='Z' is not known"):
        PeriodicMatrixDisplay.from_estimator(cases.sampled(), "Z")


def test_exponents_are_drawn_with_and_without_a_reducer():
    pipe, (u, y) = cases.sampled(), cases.service_record()
    exponents = pipe["identify"].model_.exponents()
    display = EigenvalueDisplay.from_estimator(pipe, true=mathieu())
    drawn = display.model_points_.get_xdata() + 1j * display.model_points_.get_ydata()
    np.testing.assert_array_equal(drawn, exponents)
    true = mathieu().floquet_exponents()
    np.testing.assert_allclose(np.sort_complex(drawn), np.sort_complex(true), rtol=0.1)
    reduced = SpuriousModeReducer().fit(pipe.transform(u), y)
    genuine = EigenvalueDisplay.from_estimator(Pipeline([("reduce", reduced)]))
    shown = genuine.mode_points_["genuine"]
    np.testing.assert_array_equal(shown.get_xdata() + 1j * shown.get_ydata(), exponents)


def test_an_order_is_drawn_once_though_its_harmonics_were_tried():
    step = cases.sampled()["identify"]
    search = step.order_search_
    assert len(set(search["order"])) < len(search["order"])
    display = SingularValueDisplay.from_estimator(cases.sampled())
    orders, shares = display.left_.get_xdata(), display.left_.get_ydata()
    assert list(orders) == sorted(set(search["order"][search["stable"]]))
    for order, share in zip(orders, shares, strict=True):
        tried = np.flatnonzero((search["order"] == order) & search["stable"])
        assert share == search["share"][tried[np.argmin(search["bic"][tried])]]


@pytest.mark.slow
def test_modes_come_back_at_the_orders_beyond():
    u, y = cases.service_record()
    near = {"frequency_tol": 0.1, "damping_tol": 0.3}
    display = StabilizationDisplay.from_estimator(cases.sampled(), u, y, orders=[2, 3], **near)
    steady = display.modes.query("steady and order == 3")["eigenvalue"]
    true = mathieu().floquet_exponents()
    assert np.abs(steady.to_numpy()[:, None] - true).min(axis=0).max() < 0.1 * np.abs(true[0])


def test_what_samples_do_not_have_is_refused_with_a_way_out():
    u, y = cases.service_record()
    with pytest.raises(ValueError, match=r"no coefficients to draw; use HarmonicsDisplay.from_da"):
        HarmonicsDisplay.from_estimator(cases.sampled(), u, y)
    with pytest.raises(ValueError, match=r"'identified' varies over the turn, with \d harmonic"):
        BodeDisplay.from_estimator(cases.sampled())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_a_constant_model_of_samples_has_a_bode_plot():
    constant = BodeDisplay.from_estimator(cases.sampled(output_harmonics=0))
    assert list(constant.magnitude_lines_) == [("identified", "y", "u1")]


@pytest.mark.slow
def test_periodic_systems_behind_samples_are_drawn(monkeypatch):
    truth = cases._deflection()
    monkeypatch.setattr(SampleModel, "to_ltp", lambda self: truth, raising=False)
    pipe = cases.sampled()
    display = PeriodicMatrixDisplay.from_estimator(pipe, true=truth)
    assert np.array_equal(display.values["identified"], display.values["true"])
    assert len(ParticipationDisplay.from_estimator(pipe).axes_) == 2
    display = HarmonicTransferFunctionDisplay.from_estimator(pipe)
    assert ("identified", "y", "u1", 1) in display.magnitude_lines_
    u, y = cases.service_record()
    with pytest.raises(ValueError, match=r"the record has 14.4 samples a turn, .* draw the model"):
        HarmonicTransferFunctionDisplay.from_estimator(pipe, u, y)
    turning = u.assign(psi=2.0 * u.index)
    analyzer = HarmonicAnalyzer(azimuth="psi", reading="sample")
    pipe = make_pipeline(analyzer, MOESPRegressor(order=2)).fit(turning, y)
    with pytest.raises(ValueError, match="the record has turns of varying length"):
        HarmonicTransferFunctionDisplay.from_estimator(pipe, turning, y)


@pytest.mark.slow
def test_responses_of_a_record_are_those_about_its_loads(monkeypatch):
    truth = cases._deflection()
    monkeypatch.setattr(SampleModel, "to_ltp", lambda self: truth, raising=False)
    u, y = cases.random_steps()
    u, y = u.iloc[:4800], y.iloc[:4800][["y"]]
    loads = 5.0 * np.cos(2.0 * u.index.to_numpy())[:, None]
    pipe = clone(cases.sampled()).fit(u, y + loads)
    display = HarmonicTransferFunctionDisplay.from_estimator(pipe, u, y + loads)
    drawn = display.magnitude_lines_["measured", "y", "u1", 0].get_ydata()
    without = estimate_harmonic_transfer_function(u, y, 2.0, 1)
    good = without.coherence[:, 1, 0] > 0.9
    assert good.sum() > 10
    np.testing.assert_allclose(drawn[good], np.abs(without.harmonic(0)[good, 0, 0]), rtol=0.01)
