"""The score of the first steps agrees with that of the whole pipeline, order by order."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from periodic_cases import coupled, mathieu
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.model_selection import PeriodBlockSplit, smallest_within_one_standard_error

SAMPLES = 32


def steps_3211(n_periods, rng, offset):
    """3-2-1-1 sequences of two periods a unit, some periods apart, from some sample on."""
    u, at = np.zeros(n_periods * SAMPLES), 3 * SAMPLES + offset
    while at < len(u) - 18 * SAMPLES:
        sign = rng.choice([-1.0, 1.0])
        for units in (3, 2, 1, 1):
            u[at : at + 2 * units * SAMPLES] = sign
            sign, at = -sign, at + 2 * units * SAMPLES
        at += int(rng.integers(2, 6)) * SAMPLES
    return u


def record(system, seed, noise, n_periods=120, offset=7):
    """Inputs and outputs, noise in parts of each output's deviation."""
    rng = np.random.default_rng(seed)
    time = pd.Index(np.arange(n_periods * SAMPLES) * system.period / SAMPLES, name="time")
    m = len(system.input_names)
    u = np.column_stack([steps_3211(n_periods, rng, offset + 5 * i) for i in range(m)])
    y = pd.DataFrame(np.asarray(system.simulate(u, time.to_numpy())), time).add_prefix("y")
    y += noise * y.std().to_numpy() * rng.standard_normal(y.shape)
    return pd.DataFrame(u, time).add_prefix("u"), y


def first_two(omega, order, **options):
    analyzer = HarmonicAnalyzer(omega, reading="period", output_harmonics=1, **options)
    return Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(order))])


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.filterwarnings("ignore:an odd number of multipliers")  # of three states for two
def test_a_map_is_scored_at_every_sample_of_the_period():
    """Coefficients held over the period gave 0.79 at the true order, and more above it."""
    u, y = record(mathieu(), 0, 0.02)
    found = [first_two(2.0, n).fit(u, y).score(u, y) for n in (1, 2, 3)]
    assert found[0] < 0.9
    assert found[1] == pytest.approx(1 - 4e-4, abs=1e-4)
    assert found[2] == pytest.approx(found[1], abs=2e-5)


@pytest.mark.slow
def test_the_first_steps_score_as_the_whole_pipeline():
    u, y = record(mathieu(), 1, 0.02)
    pipe = first_two(2.0, 2)
    pipe.steps += [("reduce", SpuriousModeReducer())]
    pipe.steps += [("match", StructuredMatcher(structure=HarmonicStructure()))]
    pipe.fit(u[:2560], y[:2560])
    u, y = u[2560:], y[2560:]
    whole = 1.0 - pipe.score(u, y)
    for part in (pipe[:2], pipe[:3]):
        assert 1.0 - part.score(u, y) == pytest.approx(whole, rel=0.1)


@pytest.mark.parametrize("predictor", [False, True])
@pytest.mark.slow
def test_exact_data_of_several_inputs_are_met_at_every_sample(predictor):
    system = coupled()
    u, y = record(system, 2, 0.0, n_periods=160)
    pipe = first_two(system.omega, 4)
    if predictor:
        pipe["identify"].set_params(weighting="pbsid", block_rows=8)
    pipe.fit(u, y)
    assert pipe.score(u, y) > 1 - (1e-4 if predictor else 1e-12)
    again = pickle.loads(pickle.dumps(pipe))
    pd.testing.assert_frame_equal(again.predict(u), pipe.predict(u))


@pytest.mark.parametrize(("first", "last"), [(0, 32 * 40), (5, 32 * 40 + 9), (0, 40), (31, 70)])
def test_new_rows_may_begin_and_end_anywhere(first, last):
    """An input held over what is missing of a period is what it was; rest comes before."""
    u, y = record(mathieu(), 3, 0.0)
    pipe = first_two(2.0, 2).fit(u, y)
    rows = slice(first, last)
    found = pipe.predict(u[rows])
    assert found.index.equals(u[rows].index)
    assert np.isfinite(found.to_numpy()).all()
    start = -first % SAMPLES  # the first whole period; y and u rest until the fourth
    np.testing.assert_allclose(found[start:], y[rows][start:], atol=1e-9 * y.abs().max().max())


@pytest.mark.slow
def test_what_a_trim_is_off_by_is_no_state():
    """Noise of the trim waveforms repeats itself: part of the model, and none of its order."""
    data = make_flapping_wing(
        "nltp", input="3211", width=4, n_periods=160, samples_per_period=32, random_state=0
    )
    clean = data.outputs - data.trim.states(data.omega * data.outputs.index.to_numpy())
    noise = 0.02 * clean.std().to_numpy()
    y = data.outputs + noise * np.random.default_rng(0).standard_normal(clean.shape)
    pipe = first_two(data.omega, 2, trim_span=data.trim_span).fit(data.inputs, y)
    assert 1.0 - pipe.score(data.inputs, y) == pytest.approx(4e-4, rel=0.1)


@pytest.mark.slow
def test_a_search_finds_the_order_of_noisy_records():
    """Right in 6 of 10 before."""
    for seed in range(3):
        u, y = record(mathieu(), 10 + seed, 0.02)
        search = GridSearchCV(
            first_two(2.0, 2),
            {"identify__order": [1, 2, 3, 4], "identify__block_rows": [4, 6]},
            cv=PeriodBlockSplit(4, omega=2.0),
            refit=smallest_within_one_standard_error,
        ).fit(u, y)
        assert search.best_params_["identify__order"] == 2


@pytest.mark.slow
def test_through_a_sliding_window_scores_are_those_of_what_it_shows():
    """A causal window delays: compared with y itself the score fell as models improved."""
    data = make_flapping_wing(
        "ltp", input="3211", width=4, n_periods=120, samples_per_period=16, snr=50, random_state=0
    )
    u, y, found = data.inputs, data.outputs, []
    for order in (4, 8, 16):
        pipe = Pipeline([
            ("harmonics", HarmonicAnalyzer(data.omega, reading="sliding", output_harmonics=1)),
            ("identify", MOESPRegressor(order)),
            ("reduce", SpuriousModeReducer()),
        ])  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pipe.fit(u[:1280], y[:1280])
        found.append([part.score(u[1280:], y[1280:]) for part in (pipe[:2], pipe)])
    first, whole = np.transpose(found)
    assert (np.diff([first, whole]) > 0).all()
    assert first[-1] > 0.999


def test_outputs_at_rest_are_met_to_rounding():
    """R² of an output without variance is 1 or 0; rounding beside its size is no miss."""
    u, y = record(mathieu(), 4, 0.0)
    u, y = pd.concat([u, 0.0 * u[:0]]), y + 1e3  # what rests is known to 1e-13 of its size
    trim_span = (0.0, y.index[3 * SAMPLES])
    pipe = first_two(2.0, 2, trim_span=trim_span).fit(u, y)
    rest = slice(0, 3 * SAMPLES)
    assert pipe.score(u[rest], y[rest]) == 1.0
