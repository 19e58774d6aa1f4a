"""The trim of a record: found where nothing is said, and what is said against one that is given."""

import warnings

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm
from sklearn.model_selection import cross_val_score
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd._records.bases import _share
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.model_selection import PeriodBlockSplit

SPP, OMEGA = 16, 2 * np.pi
STEP = np.array([[-0.4, 3.0], [-3.0, -0.4]]) / SPP  # e-fold in 2.5 turns
LEVEL, DEPTH = 5.0, 3.0  # of the inputs and the outputs in trim


def machine(n_turns, doublets, *, noise=0.0, x0=(0.0, 0.0), seed=0, trim=1.0, first=0.0):
    """A linear machine about a periodic trim, disturbed by doublets that begin at some turns."""
    n = n_turns * SPP
    t = pd.Index((np.arange(n) + first * SPP) / SPP, name="time")
    u = np.zeros(n)
    for start in doublets:
        u[start * SPP : (start + 1) * SPP] += 1.0
        u[(start + 1) * SPP : (start + 2) * SPP] -= 1.0
    A, x, y = expm(STEP), np.array(x0, dtype=float), np.zeros((n, 2))
    for k in range(n):
        y[k] = [x[0], x[1] + 0.5 * np.cos(OMEGA * t[k]) * x[0]]
        x = A @ x + np.array([0.0, 1.0]) * u[k] / SPP
    wave = trim * DEPTH * np.stack([1.0 + np.cos(OMEGA * t), np.sin(2 * OMEGA * t)], axis=1)
    y += noise * y.std(axis=0) * np.random.default_rng(seed).standard_normal(y.shape)
    u = u + trim * LEVEL * (1.0 + 0.1 * np.sin(OMEGA * t))
    return pd.DataFrame({"u": u}, t), pd.DataFrame(y + wave, t, ["a", "b"]), wave[:SPP]


def analyzer(**options):
    return HarmonicAnalyzer(OMEGA, **({"reading": "period"} | options))


def pipeline(order="auto", **options):
    return Pipeline([("harmonics", analyzer(**options)), ("identify", MOESPRegressor(order))])


def warned(run):
    """What warnings say of trim_span."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run()
    return [str(w.message) for w in caught if "trim_span" in str(w.message)]


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
@pytest.mark.parametrize(
    "record",
    [
        {"doublets": [8]},
        {"doublets": [6, 30]},
        {"doublets": [5], "x0": (1.0, 1.0)},  # in motion at first
        {"doublets": [0]},
        {"doublets": [30], "x0": (1.0, 1.0)},
    ],
    ids=["one doublet", "two doublets", "begins in motion", "at once", "rests, then moves"],
)
@pytest.mark.parametrize("reading", ["period", "sliding"])
@pytest.mark.slow
def test_the_trim_is_found_whenever_it_is(record, noise, reading):
    u, y, wave = machine(60, **record, noise=noise)
    pipe = pipeline(reading=reading)
    assert not warned(lambda: pipe.fit(u, y))
    basis, size = pipe[0].basis_, (y - np.tile(wave, (60, 1))).std().to_numpy()
    assert np.max(np.abs(basis.output_trim - wave) / size) < 4 * max(noise / np.sqrt(8), 0.005)
    assert np.max(np.abs(basis.input_trim[:, 0] - u["u"].to_numpy()[-SPP:])) < 1e-12
    if reading == "period":
        error = np.abs(np.abs(pipe[1].eigenvalues_) - np.exp(-0.4))
        assert np.max(error) < 0.01 + noise


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_noise_on_the_inputs_and_several_records(noise, rng):
    parts = [machine(40, [start], noise=noise, seed=start)[:2] for start in (5, 9)]
    u, y = (pd.concat(dict(enumerate(z)), names=["record"]) for z in zip(*parts, strict=True))
    u += 0.1 * noise * rng.standard_normal(u.shape)
    wave = machine(1, [])[2]
    basis = analyzer().fit(u, y).basis_
    size = (y - np.tile(wave, (80, 1))).std().to_numpy()
    assert np.max(np.abs(basis.output_trim - wave) / size) < 0.01 + 2 * noise


def test_a_plateau_is_another_orbit():
    u, y, wave = machine(60, [6])
    push = np.repeat([0.0, 1.0, 0.0], [30 * SPP, 9 * SPP, 21 * SPP])
    u["u"] += push
    y["a"] += push  # at once, so that outputs rest there, too
    np.testing.assert_allclose(analyzer().fit(u, y).basis_.output_trim, wave, atol=0.02)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_record_that_begins_at_rest_begins_in_trim(noise):
    """However long it rests at another level afterwards; predictions of it begin there, too."""
    X, y, _ = machine(60, [], noise=0.0)
    step = np.where(np.arange(len(X)) < 10 * SPP, 0.0, 1.0)
    A, x, moved = expm(STEP), np.zeros(2), np.zeros(y.shape)
    for k, u in enumerate(step):
        moved[k] = [x[0], x[1] + 0.5 * np.cos(OMEGA * X.index[k]) * x[0]]
        x = A @ x + np.array([0.0, 1.0]) * u / SPP
    still = y + noise * moved.std(axis=0) * np.random.default_rng(0).standard_normal(y.shape)
    pipe = pipeline(2).fit(X.add(step, axis=0), still + moved)
    np.testing.assert_allclose(pipe[0].basis_.input_trim, X[:SPP], atol=1e-9)
    left = pipe.predict(X.add(step, axis=0))[: 8 * SPP] - y[: 8 * SPP]
    assert np.max(np.abs(left.to_numpy())) <= (1e-6 + noise) * np.max(np.abs(moved))


def test_a_speed_that_varies_and_gaps(rng):
    u, y, wave = machine(60, [6], noise=0.01)
    psi = OMEGA * u.index.to_numpy()
    t = (psi + 0.05 * np.sin(psi / 10.0)) / OMEGA
    index = pd.Index(t, name="time")
    u, y = u.set_axis(index).assign(psi=psi), y.set_axis(index)
    y.iloc[40 * SPP + 3 : 41 * SPP] = np.nan
    options = {"azimuth": "psi", "reading": "period", "missing": "gap"}
    basis = HarmonicAnalyzer(**options).fit(u, y).basis_
    assert np.max(np.abs(basis.output_trim[:SPP] - wave)) < 0.05 * y.std().max()


@pytest.mark.parametrize("kind", ["lti-signal", "ltp"])
@pytest.mark.parametrize("start", [0, 5, 132])
def test_a_linear_record_is_as_it_is(kind, start):
    data = make_flapping_wing(kind, n_periods=60 if start < 100 else 220, start=start, width=4)
    basis = HarmonicAnalyzer(data.omega, reading="period").fit(data.inputs, data.outputs).basis_
    assert basis.output_trim is None
    assert basis.input_trim is None


def test_the_wing_as_with_its_span(nltp):
    u, y = nltp.inputs, nltp.outputs
    found, given = (
        HarmonicAnalyzer(nltp.omega, reading="period", trim_span=span).fit(u, y).basis_
        for span in ("auto", nltp.trim_span)
    )
    size = (y - given.waveform(given.output_trim, u.index.to_numpy())).std().to_numpy()
    assert np.max(np.abs(found.output_trim - given.output_trim) / size) < 1e-5


def test_samples_identify_their_forced_response():
    u, y, _ = machine(60, [8])
    assert analyzer(reading="sample").fit(u, y).basis_.output_trim is None


@pytest.mark.slow
def test_every_fold_finds_its_own():
    u, y, _ = machine(60, [8, 38], noise=0.01)  # each fold leaves a doublet to the fit
    scores = cross_val_score(pipeline(), u, y, cv=PeriodBlockSplit(4, omega=OMEGA))
    assert np.isfinite(scores).all()


def multipliers(pipe):
    return np.sort_complex(np.exp(pipe["identify"].model_.exponents() * 2 * np.pi / OMEGA))


TRUE = np.sort_complex(np.linalg.eigvals(np.linalg.matrix_power(expm(STEP), SPP)))


def test_a_trim_that_nobody_names_is_no_multiplier_at_one():
    """Outputs about their trim are left alone; a waveform that is most of them is no mode.

    Sliding windows cannot identify it, and say so.
    """
    u, y, _ = machine(60, [8], noise=0.01)
    u -= LEVEL * (1.0 + 0.1 * np.sin(OMEGA * u.index.to_numpy()[:, None]))
    (said,) = warned(lambda: analyzer(reading="sliding", trim_span=None).fit(u, y))
    assert "a periodic waveform is 0.9" in said
    assert "trim_span=None subtracts none" in said
    short = analyzer(reading="sliding", trim_span=None)
    assert len(warned(lambda: short.fit(u.iloc[: 7 * SPP], y.iloc[: 7 * SPP]))) == 1
    found = pipeline(trim_span=None).fit(u, y)
    assert not found["harmonics"].basis_.trim_known
    assert np.allclose(multipliers(found), TRUE, atol=0.02)
    u, y, _ = machine(120, range(2, 110, 3), noise=0.01)
    u -= LEVEL * (1.0 + 0.1 * np.sin(OMEGA * u.index.to_numpy()[:, None]))
    assert np.allclose(multipliers(pipeline(trim_span=None).fit(u, y)), TRUE, atol=0.02)
    u, y, _ = machine(60, [8], noise=0.01, trim=0.0)
    for reading in ("period", "sliding"):
        silent = analyzer(reading=reading, trim_span=None)
        assert not warned(lambda silent=silent: silent.fit(u, y))
        assert silent.basis_.output_trim is None


@pytest.mark.parametrize("kind", ["held", "mean", "levels"])
def test_outputs_about_their_trim_stay_so_if_inputs_make_the_waveform(kind):
    """A step that is held, inputs with a mean, steps between zero and one."""
    rng, n = np.random.default_rng(3), 60 * SPP
    inputs = {
        "held": np.where(np.arange(n) < SPP, 0.0, 1.0),
        "mean": 1.0 + 0.1 * rng.standard_normal(n),
        "levels": np.repeat(rng.integers(0, 2, n // 40 + 1), 40)[:n].astype(float),
    }
    t, x, y = pd.Index(np.arange(n) / SPP, name="time"), np.zeros(2), np.zeros((n, 2))
    for k, each in enumerate(inputs[kind]):
        y[k] = [x[0], x[1] + 0.5 * np.cos(OMEGA * t[k]) * x[0]]
        x = expm(STEP) @ x + np.array([0.0, 1.0]) * each / SPP
    y += 1e-3 * y.std(axis=0) * rng.standard_normal(y.shape)
    u, y = pd.DataFrame({"u": inputs[kind]}, t), pd.DataFrame(y, t, ["a", "b"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = pipeline(trim_span=None).fit(u, y)
        at_rest = found.predict(0.0 * u)
    assert np.max(np.abs(at_rest)) < 0.02 * np.max(np.abs(y.to_numpy()))


@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize(
    ("span", "words"),
    [
        ((0.0, 9.0), "the inputs move within trim_span=(0, 9)"),
        ((0.0, 12.0), "the inputs move within trim_span=(0, 12)"),
        ((10.0, 20.0), "the outputs are not at rest within trim_span=(10, 20)"),
        ((0.0, 8.0), None),
        ((1.0, 7.0), None),
        ((35.0, 60.0), None),
    ],
)
def test_a_span_that_is_no_trim(span, words, noise):
    u, y, _ = machine(60, [8], noise=noise)
    said = warned(lambda: analyzer(trim_span=span).fit(u, y))
    assert [one[: len(words or "")] for one in said] == ([words] if words else [])


@pytest.mark.filterwarnings("ignore:.* exponents are in doubt")
@pytest.mark.filterwarnings("ignore:.* of the energy of the inputs")  # of their rounding
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_without_rest_the_trim_is_identified_with_the_dynamics(noise):
    """The record begins with the doublet and ends in mid-decay."""
    u, y, wave = machine(24, [2], noise=noise, first=3.0, x0=(0.5, 0.0))
    u, y = u.iloc[: 11 * SPP], y.iloc[: 11 * SPP]
    pipe = pipeline(2).fit(u, y)
    assert not pipe[0].basis_.trim_known
    size = (y - np.tile(wave, (11, 1))).std().to_numpy()
    assert np.max(np.abs(pipe[1].basis_.output_trim - wave) / size) < 0.001 + 10 * noise
    assert np.max(np.abs(np.abs(pipe[1].eigenvalues_) - np.exp(-0.4))) < 1e-4 + 2 * noise
    whole, *_ = machine(30, [])
    np.testing.assert_allclose(
        pipe.predict(whole), np.tile(wave, (30, 1)), atol=(0.002 + 20 * noise) * size.max()
    )


@pytest.mark.parametrize("reading", ["period", "sample"])
def test_inputs_about_zero_leave_a_machine_in_trim_at_zero(reading):
    """Not at their mean over a record in which they never rest for long."""
    still, trim, _ = machine(60, [])
    still = 0.0 * still
    levels = [1.0, 0.0, -0.5, 0.0, 0.0, 1.0, 0.0, -0.5, 0.0, 0.5, 1.0, 0.5]
    held = np.repeat(levels, 5 * SPP)
    A, x, answer = expm(STEP), np.zeros(2), np.zeros((len(held), 2))
    for k, value in enumerate(held):
        answer[k] = [x[0], x[1] + 0.5 * np.cos(OMEGA * still.index[k]) * x[0]]
        x = A @ x + np.array([0.0, 1.0]) * value / SPP
    assert abs(held.mean()) > 0.2
    pipe = pipeline(reading=reading).fit(still.assign(u=held), trim + answer)
    off = np.abs(pipe.predict(still) - trim)
    assert np.max(off) < 1e-3 * np.max(np.abs(answer))


def test_a_sliding_window_says_that_nothing_rests():
    u, y, _ = machine(24, [2], x0=(0.5, 0.0))
    pipe = pipeline(reading="sliding")
    (said,) = warned(lambda: pipe[0].fit(u.iloc[: 11 * SPP], y.iloc[: 11 * SPP]))
    assert "no turn is in trim" in said


@pytest.mark.filterwarnings("ignore:.* exponents are in doubt")
@pytest.mark.parametrize("reading", ["period", pytest.param("sample", marks=pytest.mark.slow)])
def test_the_score_is_a_share_of_the_motion(reading):
    """A forced response ten times larger changes the score of no reading."""
    scores = []
    for trim in (1.0, 10.0):
        u, y, _ = machine(60, [8, 30], noise=0.1, trim=trim)
        u["u"] += 0.05 * np.sin(3.3 * u.index.to_numpy()) * (reading == "sample")
        scores.append(pipeline(reading=reading).fit(u, y).score(u, y))
    np.testing.assert_allclose(scores[1], scores[0], atol=1e-3)
    assert scores[0] < 0.999


@pytest.mark.parametrize("criterion", ["output_error", "prediction_error"])
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")  # of the span
@pytest.mark.slow
def test_likelihoods_correct_a_trim_that_was_not_settled(criterion):
    """The span holds a motion of the record: exponents and trim are those of the machine."""
    u, y, wave = machine(60, [12, 30], noise=0.01, x0=(0.3, 0.0))
    steps = [("m", StructuredMatcher(structure=HarmonicStructure(), criterion=criterion))]
    pipe = Pipeline(pipeline(2, trim_span=(0.0, 3.0)).steps + steps).fit(u, y)
    before, after = (
        np.sqrt(np.mean((step.basis_.output_trim - wave) ** 2)) for step in (pipe[0], pipe[-1])
    )
    assert after < 0.2 * before
    found = pipe[-1].ltp_.floquet_exponents()
    np.testing.assert_allclose(found.real, -0.4, rtol=0.02)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")  # the order
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.InstabilityWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.CoordinatesWarning")
@pytest.mark.slow
def test_a_mode_that_outlasts_the_record_does_not_carry_the_trim_away():
    """One state too many stands for a constant: trim and state could cancel at any size."""
    u, y, _ = machine(40, [12], noise=0.01)
    steps = [("m", StructuredMatcher(structure=HarmonicStructure(), criterion="output_error"))]
    pipe = Pipeline(pipeline(3).steps + steps).fit(u, y)
    largest = np.abs(pipe[0].basis_.output_trim).max()
    assert np.abs(pipe[-1].basis_.output_trim).max() < 1.1 * largest
    assert np.abs(pipe.predict(u).to_numpy()).max() < 3.0 * np.abs(y.to_numpy()).max()


def test_no_waveform_is_more_than_an_output(rng):
    turns = rng.standard_normal((20, 16, 2)) + 3.0
    assert 0.85 < _share(turns.mean(axis=0), turns) < _share(np.full((16, 2), 3.0), turns) + 0.01
    assert _share(1.1 * turns.mean(axis=0), turns) < 1.0
