"""The hawkmoth, unstable in hover, identified while its feedback flies it."""

import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import make_hawkmoth
from sklearn_hd.exceptions import InstabilityWarning

sys.path.insert(0, str(Path(__file__).parents[1] / "docs" / "benchmarks"))
import closed_loop_study as study

GUSTY = {"excitation": 3e-3, "gust": 0.05, "noise": 0.02}


@pytest.fixture(scope="module")
def gusty():
    return make_hawkmoth(
        n_records=4, n_periods=150, quiet=30, samples_per_period=32, random_state=2026, **GUSTY
    )


@pytest.fixture(scope="module")
def fitted(gusty):
    pipe = study.pipeline(gusty, "pbsid")
    with pytest.warns(InstabilityWarning, match="a Floquet exponent of the model has the real"):
        return pipe.fit(gusty.inputs, gusty.outputs)


def growing(exponents):
    above = np.asarray(exponents)[np.imag(exponents) >= 0.0]
    return above[np.argmax(above.real)]


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_only_the_predictor_sees_that_the_moth_is_unstable(gusty):
    frame = HarmonicAnalyzer(
        gusty.omega, reading="period", trim_span=gusty.trim_span
    ).fit_transform(gusty.inputs, gusty.outputs)  # fmt: skip
    found = {}
    for weighting in ("moesp", "n4sid", "cva", "pbsid"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InstabilityWarning)
            model = MOESPRegressor(4, weighting=weighting).fit(frame, gusty.outputs)
        found[weighting] = np.log(model.eigenvalues_.astype(complex)) * gusty.omega / 2 / np.pi
    wanted = growing(gusty.exponents)
    assert abs(growing(found.pop("pbsid")) - wanted) < 0.25 * abs(wanted)
    for exponents in found.values():
        assert abs(growing(exponents) - wanted) > 0.25 * abs(wanted)


@pytest.mark.slow
def test_the_periodic_model_comes_back_from_flights_in_gusts(gusty, fitted):
    ltp = fitted["match"].ltp_
    assert ltp.state_names == gusty.ltp.state_names
    same_map = np.sort_complex(np.log(fitted["identify"].eigenvalues_.astype(complex)))
    same_map = same_map * gusty.omega / (2.0 * np.pi)
    np.testing.assert_allclose(np.sort_complex(ltp.floquet_exponents()), same_map, rtol=0.02)
    found, wanted = (each.harmonic_decomposition(1).A for each in (ltp, gusty.ltp))
    assert np.linalg.norm(found - wanted) < 0.25 * np.linalg.norm(wanted)
    # the stroke's effect on heave, which it is there for
    G, G_true = (
        each.G(np.linspace(0.0, 2 * np.pi, 33)[:-1]).mean(axis=0) for each in (ltp, gusty.ltp)
    )
    assert G[1, 0] == pytest.approx(G_true[1, 0], rel=0.15)


@pytest.mark.slow
def test_one_wingbeat_ahead_is_predicted_to_within_gusts_and_noise(gusty, fitted):
    frame = fitted["harmonics"].transform(gusty.inputs)
    ahead = fitted["identify"].predict_ahead(frame, gusty.outputs)
    assert ahead.index.equals(gusty.outputs.index)
    motion = gusty.outputs - gusty.outputs.groupby(level=0).transform("mean")
    left = (gusty.outputs - ahead).std()
    assert np.all(left < 0.6 * motion.std())


@pytest.mark.slow
def test_without_gusts_the_linearisation_comes_back():
    """Steps so small that the moth is linear: exponents, F(ψ) and the harmonic decomposition."""
    data = make_hawkmoth(n_records=3, n_periods=80, quiet=10, excitation=1e-4, random_state=2027)
    by_map, by_ltp, error = study.identified(data, "pbsid")
    np.testing.assert_allclose(by_map, data.exponents, rtol=3e-3)
    np.testing.assert_allclose(by_ltp, data.exponents, rtol=3e-3)
    assert error < 5e-4


@pytest.mark.slow
def test_medians_of_the_study():
    """docs/world.md's table on fewer seeds."""
    flights = {"gusts": {"excitation": 5e-3, "gust": 0.02}}
    table = study.study(flights, seeds=range(500, 505), weightings=("pbsid",))
    medians = table.median(numeric_only=True)
    assert medians["pair"] < 0.1
    assert medians["A of HD"] < 0.12
    assert abs(medians["growth, match"] - 0.952) < 0.3
