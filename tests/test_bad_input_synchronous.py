"""Wrong uses of records read period by period end in an error or a warning that says so."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from periodic_cases import deflection_only, mathieu, record, steps, synchronous

from sklearn_hd import HarmonicFrame, HarmonicStructure, SpuriousModeReducer, StructuredMatcher
from sklearn_hd.exceptions import (
    FrequencyMismatchWarning,
    IdentifiabilityWarning,
    InstabilityWarning,
)


@pytest.fixture(scope="module")
def oscillation():
    return record(mathieu())


SYNCHRONOUS = {
    "order text": ({"order": "many"}, r"order='many' is not known; give a whole number or 'auto'"),
    "order zero": ({"order": 0}, r"order must be a whole number of at least 1, got 0"),
    "block_rows zero": ({"block_rows": 0}, r"block_rows must be a whole number of at least 2"),
    "block_rows text": ({"block_rows": "few"}, r"block_rows must be .* got 'few'; None chooses"),
    "order above the rank": ({"order": 40}, r"order=40 exceeds the rank bound|too few for"),
}


@pytest.mark.parametrize("case", SYNCHRONOUS)
def test_identification_parameters_period_by_period(oscillation, case):
    options, message = SYNCHRONOUS[case]
    pipe = synchronous(2.0)
    pipe["identify"].set_params(**options)
    with pytest.raises(ValueError, match=message):
        pipe.fit(*oscillation)


PERIODIC = {
    "harmonics of F": (
        {"structure": HarmonicStructure(F=16)},
        r"harmonic 16 of F, but 32 samples per period separate at most 15; give F fewer harmonics",
    ),
    "harmonics of G": (
        {"structure": HarmonicStructure(G={"20c": [[0.0], [np.nan]]})},
        r"harmonic 20 of G, but 32 samples",
    ),
    "noise beside a norm": (
        {"input_noise": "some"},
        r"input_noise must be a positive number in units of the input, got 'some'; .* a dict gives",
    ),
    "noise in a list": (
        {"input_noise": [0.1]},
        r"input_noise must .* got \[0.1\]; None means no noise",
    ),
    "noise in a dict": ({"input_noise": {"u1": -1}}, r"input_noise must be a positive .* got -1"),
    "noise of others": (
        {"input_noise": {"v": 0.1}, "criterion": "output_error"},
        r"input_noise={'v': 0.1} must give a standard deviation for each of the inputs \['u1'\]",
    ),
}


@pytest.fixture(scope="module")
def identified(oscillation):
    u, y = oscillation
    return synchronous(2.0, order=2)[:2].fit(u, y).transform(u)


@pytest.mark.parametrize("case", PERIODIC)
def test_matching_parameters_period_by_period(identified, oscillation, case):
    options, message = PERIODIC[case]
    with pytest.raises(ValueError, match=message):
        synchronous(2.0, **options)["match"].fit(identified, oscillation[1])


def test_states_to_keep_of_a_model_that_passes(identified, oscillation):
    frame, y = identified, oscillation[1]
    message = r"n_states=1 cannot be kept: the model is period-synchronous, .* its 2 states; use "
    with pytest.raises(ValueError, match=message + r"MOESPRegressor\(order=1\), or leave"):
        SpuriousModeReducer(n_states=1).fit(frame, y)
    reducer = SpuriousModeReducer(n_states=2).fit(frame, y)
    assert reducer.n_states_ == 2
    matcher = StructuredMatcher(structure=HarmonicStructure()).fit(reducer.transform(frame), y)
    with pytest.raises(ValueError, match=r"n_states=\d+ .* already continuous.* one reducer only"):
        SpuriousModeReducer(n_states=3).fit(matcher.transform(frame), y)


SHORT = {
    1: r"shorter than|too few",
    3: r"give 3 period\(s\) .* at least 7 consecutive periods are needed with 1 direction\(s\)",
    6: r"6 periods can separate 1 of .* 9 consecutive periods would be enough; use a longer record",
}


@pytest.mark.parametrize("n_periods", SHORT)
def test_records_of_few_periods(oscillation, n_periods):
    u, y = (frame.iloc[: 32 * n_periods] for frame in oscillation)
    if n_periods == 1:
        u = u + np.linspace(0, 1, 32)[:, None]
    with pytest.raises(ValueError, match=SHORT[n_periods]):
        synchronous(2.0).fit(u, y)


def test_twelve_periods_are_enough_for_two_states(oscillation):
    u, y = (frame.iloc[: 32 * 12] for frame in oscillation)
    found = synchronous(2.0).fit(u, y)["match"].ltp_
    np.testing.assert_allclose(found.F.coefficients[:2], mathieu().F.coefficients[:2], atol=1e-8)


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_an_order_that_no_real_system_has():
    """One negative multiplier of two: the product of all is positive."""
    system = deflection_only(stiffness=1.0, excitation=0.3, damping=0.2)
    with pytest.raises(ValueError, match=r"1 negative real one.* try order=2, or a longer record"):
        synchronous(2.0, order=1).fit(*record(system))


def test_a_model_that_outgrows_the_record_is_mended_on_it(oscillation):
    """Multipliers twenty times too large are but a start: the raw record says better."""
    u, y = oscillation
    frame = synchronous(2.0)[:2].fit(u, y).transform(u)
    growing = replace(frame.model, A=20.0 * frame.model.A)
    frame = HarmonicFrame.attach(frame, frame.basis, growing)
    found = StructuredMatcher(structure=HarmonicStructure()).fit(frame, y).ltp_
    np.testing.assert_allclose(found.F.coefficients[:2], mathieu().F.coefficients[:2], atol=0.01)


def test_fixed_entries_that_outgrow_the_record(oscillation):
    structure = HarmonicStructure(F={"0": np.eye(2)}, G=0)
    with pytest.raises(ValueError, match=r"the allowed harmonics makes a model that grows e\^188"):
        synchronous(2.0, structure).fit(*oscillation)


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.filterwarnings("ignore:the periodic orbit is unstable")  # by noise, or not
@pytest.mark.slow
def test_outputs_of_noise_for_the_most_part():
    with pytest.warns(IdentifiabilityWarning, match=r"explains only \d+% of the record's variance"):
        synchronous(2.0, order=2).fit(*record(mathieu(), noise=2.0))


@pytest.mark.filterwarnings("ignore:.*(exponents are in doubt|the model lacks)")
def test_harmonics_of_F_too_few_for_the_system(oscillation):
    """A constant F for a Mathieu oscillator is said to explain little, or refused."""
    pipe = synchronous(2.0, HarmonicStructure(F=0))
    with pytest.warns(
        IdentifiabilityWarning, match=r"residuals that are not noise .* harmonics that the"
    ):
        pipe.fit(*oscillation)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*(exponents are in doubt|neither decay nor grow)")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.CoordinatesWarning")
def test_a_frequency_that_is_off_by_one_percent():
    """The rotor turns at 2.02 rad/s, 2 is given: said, one way or the other."""
    system = mathieu(omega=2.02)
    t = np.arange(60 * 32) * np.pi / 32
    u = steps(np.random.default_rng(0), len(t), 1, 32)
    y = pd.DataFrame(system.simulate(u, t), t, ["y", "v"])
    u = pd.DataFrame(u, t, ["u1"])
    for order in ("auto", 2):
        pipe = synchronous(2.0, order=order)
        with (
            pytest.warns(FrequencyMismatchWarning, match=r"at 2\.02\d+ ± .* not at omega=2 rad"),
            pytest.warns(IdentifiabilityWarning, match="are not noise|neither decay nor grow"),
        ):
            pipe.fit(u, y)


@pytest.mark.slow
def test_a_wildly_growing_record_is_exact_or_said():
    """Multipliers of 2.6: 24 decades over the record hide what the inputs did."""
    system = mathieu(damping=-0.3)
    u, y = record(system)
    pipe = synchronous(2.0)
    with (
        pytest.warns(InstabilityWarning),  # of the outputs, and of the model
        pytest.warns(IdentifiabilityWarning, match="does not determine G"),
    ):
        pipe.fit(u, y)
    found = pipe["match"].ltp_.floquet_exponents()
    np.testing.assert_allclose(found, system.floquet_exponents(), rtol=1e-6)


@pytest.mark.parametrize(
    ("value", "tolerance"),
    [(0.0, 1e-9), (3.1, 5e-3)],  # constants of all outputs are fitted then
)
def test_outputs_that_never_move_are_told_and_change_nothing(value, tolerance):
    """Their zeros do not count as rows that a model explains: twelve states would do for these."""
    u, y = record(mathieu(), n_periods=40, noise=0.02)
    pipe = synchronous(2.0)[:2]
    alone = pipe.fit(u, y)["identify"].eigenvalues_
    resting = {"a": value, "b": value, "c": value}
    with pytest.warns(IdentifiabilityWarning, match=r"the outputs \['a', 'b', 'c'\] never move"):
        pipe.fit(u, y.assign(**resting))
    np.testing.assert_allclose(pipe["identify"].eigenvalues_, alone, rtol=tolerance)
    assert np.max(np.abs(pipe.predict(u)[list(resting)] - value)) < 1e-9
