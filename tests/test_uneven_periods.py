"""Periods that are no whole number of samples, resampled to one."""

import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import KEPT, same_poles
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._readings import SlidingBasis
from sklearn_hd.algorithms.signals.resampling import interpolate, interpolation_error
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import JitterWarning, ResamplingWarning

OMEGA = 2 * np.pi * 5


@pytest.fixture(scope="module")
def wing():
    return make_flapping_wing("ltp", n_periods=60, start=5)


def record(wing, samples, n_periods=60):
    """The doublet of five to 25 periods on a clock of its own, edges at the next sample."""
    t = np.arange(int(n_periods * samples)) * wing.ltp.period / samples
    first, middle, last = (int(np.ceil(p * samples)) for p in (5, 15, 25))
    u = np.zeros(len(t))
    u[first:middle], u[middle:last] = 8e-5, -8e-5
    index = pd.Index(t, name="time")
    y = wing.ltp.simulate(u[:, None], t)
    return pd.DataFrame({"U": u}, index), pd.DataFrame(y, index, ["w", "phi_dot"])


def pipeline(omega, hop=None):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, output_harmonics=KEPT, hop=hop)),
            ("identify", MOESPRegressor(order=16)),
            ("reduce", SpuriousModeReducer()),
        ]
    )


def by_period(omega):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, reading="period")),
            ("identify", MOESPRegressor()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    )


def periodic(samples, n_periods=20):
    t = np.arange(int(n_periods * samples)) * 2 * np.pi / OMEGA / samples
    u = 2 + np.cos(OMEGA * t) - 0.5 * np.sin(2 * OMEGA * t)
    return pd.DataFrame({"u": u}, index=t)


@pytest.mark.parametrize(
    ("samples", "rows", "grid"),
    [
        (50.3, {}, 56),
        (50.3, {"hop": 7}, 56),
        (50.3, {"reading": "period"}, 51),
        (63.97, {}, 64),
        (64.05, {"hop": 8}, 64),
    ],
)
def test_coefficients_of_a_periodic_signal_are_those_of_a_whole_number(samples, rows, grid):
    X = periodic(samples)
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=2, **rows)
    with pytest.warns(ResamplingWarning, match=rf"give {samples} .* onto {grid} a period"):
        frame = analyzer.fit_transform(X)
    assert analyzer.basis_.samples_per_period == grid
    assert frame.index.equals(X.index)
    np.testing.assert_allclose(frame.iloc[:, 1:] - [2, 1, 0, 0, -0.5], 0.0, atol=1e-6)
    np.testing.assert_allclose(analyzer.inverse_transform(frame)["u"], X["u"], atol=3e-6)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [50.3, 64.0185])
def test_the_model_is_that_of_a_whole_number_of_samples(wing, samples):
    whole = by_period(wing.omega).fit(wing.inputs, wing.outputs)
    X, y = record(wing, samples)
    with pytest.warns(ResamplingWarning, match=r"The interpolation error is at most .* of 'w'"):
        pipe = by_period(wing.omega).fit(X, y)
    found, same = (each["match"].ltp_ for each in (pipe, whole))
    assert same_poles(found.floquet_exponents(), same.floquet_exponents(), 3e-4)
    A, heave = found.harmonic_decomposition(1).A, [0, 3, 5]
    exact = wing.A_exact.to_numpy()
    assert np.linalg.norm(A[np.ix_(heave, heave)] - exact) < 3e-4 * np.linalg.norm(exact)
    predicted = pipe.predict(X)
    assert predicted.index.equals(y.index)
    assert np.isfinite(predicted.to_numpy()).all()
    assert pipe.score(X, y) == pytest.approx(whole.score(wing.inputs, wing.outputs), abs=1e-4)


def test_omega_rounded_to_four_digits_warns_of_its_digits(wing):
    """165.2 for 165.248 rad/s: the grid is that of the ω given, the warning names the other."""
    analyzer = HarmonicAnalyzer(165.2, output_harmonics=KEPT)
    with pytest.warns(ResamplingWarning, match=r"64 samples a period would mean omega=165\.2477"):
        analyzer.fit(wing.inputs, wing.outputs)
    assert analyzer.basis_.samples_per_period == 64
    assert analyzer.basis_.omega == 165.2


def test_a_mismatch_that_moves_no_row_is_none():
    """A millionth of ω: a quarter of a sample only after 2500 periods of 100."""
    for n_periods, resampled in ((2000, False), (3000, True)):
        X = periodic(100, n_periods)
        analyzer = HarmonicAnalyzer(OMEGA * (1 + 1e-6))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            analyzer.fit(X)
        assert analyzer.basis_.timing.resampled == resampled
        assert len(caught) == resampled
        assert analyzer.basis_.samples_per_period == 100


def test_rows_halfway_between_phases_are_counted_one_by_one():
    basis = SlidingBasis(OMEGA, 2 * np.pi / OMEGA / 16, 16, "boxcar", 4, (("u", (0,)),), ())
    time = (np.arange(200) + 0.5) * basis.sample_time
    np.testing.assert_array_equal(basis.phase_index(time), (np.arange(200) + 1) % 16)
    drifting = time * (1 + 1e-5)
    np.testing.assert_array_equal(basis.phase_index(drifting), basis.phase_index(time))
    assert len(basis.phase_index(time[:0])) == 0


def test_jitter_and_an_uneven_period_together(rng):
    t = periodic(50.3).index.to_numpy()
    t = t + 0.1 * t[1] * rng.uniform(-1, 1, len(t))
    noisy = pd.DataFrame({"u": 2 + np.cos(OMEGA * t) - 0.5 * np.sin(2 * OMEGA * t)}, index=t)
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=2)
    with pytest.warns(ResamplingWarning), pytest.warns(JitterWarning):
        frame = analyzer.fit_transform(noisy)
    np.testing.assert_allclose(frame.iloc[:, 1:] - [2, 1, 0, 0, -0.5], 0.0, atol=1e-5)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ResamplingWarning")
def test_other_records_are_read_on_the_grid_of_the_fit():
    X = periodic(50.3)
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=2).fit(X)
    later = X.iloc[317:]
    whole = analyzer.transform(X).iloc[317:]
    np.testing.assert_allclose(analyzer.transform(later).iloc[:, 1:], whole.iloc[:, 1:], atol=1e-6)
    words = r"fitted to rows 0\.0\d+ s apart, but those of X are 0\.0\d+ s apart;.* resample X to 0"
    with pytest.raises(ValueError, match=words):  # no sample_time was given
        analyzer.transform(periodic(64))


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ResamplingWarning")
@pytest.mark.filterwarnings("ignore:.* within trim_span=")
def test_gaps_and_trim_on_the_resampled_grid():
    X = periodic(50.3)
    X.iloc[400:420] = np.nan
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=2, missing="gap", trim_span=(0.0, 1.0)).fit(
        X, X.rename(columns={"u": "y"})
    )
    frame = analyzer.transform(X)
    assert frame.iloc[405:415, 1:].isna().all(axis=None)
    np.testing.assert_allclose(frame.dropna().iloc[:, 1:], 0.0, atol=1e-6)


def test_held_inputs_alone_have_no_interpolation_error():
    with pytest.warns(ResamplingWarning) as caught:
        HarmonicAnalyzer(OMEGA).fit(periodic(50.3))
    assert "errs" not in str(caught[0].message)


@pytest.mark.parametrize("samples", [16.3, 32.3, 50.3])
@pytest.mark.slow
def test_the_bound_of_the_interpolation_error_holds(wing, samples):
    """At the kinks of a doublet's edges, and in the free decay."""
    X, y = record(wing, samples)
    t, fine = y.index.to_numpy(), 8
    between = (np.arange(len(t) * fine) / fine) * t[1]
    truth = wing.ltp.simulate(np.repeat(X.to_numpy(), fine, axis=0), between)
    for rows in (slice(None), slice(int(27 * samples), None)):
        y_rows, places = y.to_numpy()[rows], t[rows]
        inside = (between >= places[0]) & (between <= places[-1])
        off = interpolate(y_rows, places, between[inside]) - truth[inside]
        true = np.sqrt(np.mean(off**2, axis=0))
        bound = interpolation_error(y_rows, places)
        assert np.all(true < bound)
        assert np.all(bound < 10 * true)


def test_too_few_samples_tell_no_error():
    values = np.array([[3.0], [4.0]])
    assert interpolation_error(values, np.arange(2.0))[0] == pytest.approx(np.sqrt(12.5))
