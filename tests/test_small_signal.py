"""Records at several amplitudes: their linear part, and models fitted to it."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import KEPT, same_poles
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._records.amplitudes import (
    extrapolation_weights,
    n_distinct,
    odd_weights,
    same_waveform,
)
from sklearn_hd._records.data import read_for_fit
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning

OMEGA, SPP = 2 * np.pi, 16
AMPLITUDES = st.lists(st.integers(1, 8), min_size=2, max_size=4, unique=True)


# ---- laws ---------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(AMPLITUDES, st.randoms(use_true_random=False))
def test_extrapolation_leaves_the_linear_term_of_any_polynomial(sizes, random):
    a = np.array(sizes) / 4.0 * np.array([random.choice([-1.0, 1.0]) for _ in sizes])
    terms = np.random.default_rng(len(a)).standard_normal((len(a), 50))
    responses = a[:, None] ** np.arange(1, len(a) + 1) @ terms
    weights = extrapolation_weights(a)
    largest = a[np.argmax(np.abs(a))]
    size = np.linalg.norm(weights) * np.abs(responses).max()
    np.testing.assert_allclose(weights @ responses, largest * terms[0], atol=1e-11 * size)


def test_a_pair_extrapolated_is_its_odd_part():
    assert extrapolation_weights([1.0, -1.0]).tolist() == [0.5, -0.5]
    assert odd_weights([1.0, -1.0])[0].tolist() == [[0.5, -0.5]]


def test_even_terms_cancel_in_pairs_of_unequal_size():
    a = np.array([1.0, -0.97, -1.01, 0.5, -0.5])
    weights, single = odd_weights(a)
    assert weights.shape == (2, 5)
    assert single == []
    even = a**2
    even[[1, 2]] = np.mean(a[[1, 2]]) ** 2  # those of one sign are averaged
    np.testing.assert_allclose(weights @ even, 0.0, atol=1e-13)
    np.testing.assert_allclose(weights @ a, [1.0, 0.5], atol=1e-2)


def test_noise_of_repeated_records_is_averaged():
    weights = extrapolation_weights([1.0, 1.0, -1.0, -1.0])
    np.testing.assert_allclose(weights, [0.25, 0.25, -0.25, -0.25], atol=1e-14)
    assert n_distinct([1.0, 1.01, -1.0, 0.5]) == 3


def test_waveforms_are_told_apart_under_noise(rng):
    waves = rng.standard_normal((2, 400, 2))
    inputs = [a * waves[w] for a, w in ((0.5, 0), (-1, 0), (2, 1), (1, 0), (-2, 1))]
    inputs = [u + 0.05 * np.std(u) * rng.standard_normal(u.shape) for u in inputs]
    groups = {frozenset(rows.tolist()): a for rows, a in same_waveform(inputs)}
    assert set(groups) == {frozenset({0, 1, 3}), frozenset({2, 4})}
    np.testing.assert_allclose(sorted(np.abs(groups[frozenset({0, 1, 3})])), [0.5, 1, 1], rtol=0.05)


# ---- models -------------------------------------------------------------------------------------


def pipeline(data, small_signal=None, **kwargs):
    analyzer = HarmonicAnalyzer(
        data.omega,
        output_harmonics=KEPT,
        hop=8,
        trim_span=data.trim_span,
        small_signal=small_signal,
        **kwargs,
    )
    return Pipeline(
        [
            ("harmonics", analyzer),
            ("identify", MOESPRegressor(order=16)),
            ("reduce", SpuriousModeReducer()),
        ]
    )


def error(pipe, data):
    """Relative error of A in the paper's coordinates, per cent."""
    system, exact = pipe["reduce"].system_, data.A_exact.to_numpy()
    A = system.C @ system.A @ np.linalg.inv(system.C)
    return 100 * np.linalg.norm(A - exact) / np.linalg.norm(exact)


def nltp(*amplitudes, **kwargs):
    return make_flapping_wing("nltp", n_periods=60, start=5, amplitude=list(amplitudes), **kwargs)


@pytest.fixture(scope="module")
def pair():
    return nltp(0.02, -0.02)


def error_by_period(data, small_signal=None):
    """The same of the decomposition of the periodic model, read period by period."""
    pipe = pipeline(data, small_signal).set_params(
        harmonics__hop=None, harmonics__reading="period", identify__order="auto"
    )
    pipe.steps.append(("match", StructuredMatcher(structure=HarmonicStructure())))
    pipe.fit(data.inputs, data.outputs)
    A, heave = pipe["match"].ltp_.harmonic_decomposition(1).A, [0, 3, 5]
    exact = data.A_exact.to_numpy()
    return 100 * np.linalg.norm(A[np.ix_(heave, heave)] - exact) / np.linalg.norm(exact)


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "goal"), [(0.02, 0.006), (0.005, 0.0004)])
def test_a_pair_of_doublets_gives_the_model_of_small_motions(amplitude, goal):
    data = nltp(amplitude, -amplitude)
    single, odd = error_by_period(nltp(amplitude)), error_by_period(data, "odd")
    assert odd < goal
    assert odd < single / 10


@pytest.mark.slow
def test_four_amplitudes_reach_the_linear_data():
    data = nltp(0.02, -0.02, 0.01, -0.01)
    linear = make_flapping_wing("ltp", n_periods=60, start=5)
    floor = error(pipeline(linear).fit(linear.inputs, linear.outputs), linear)
    pipe = pipeline(data, "extrapolate").fit(data.inputs, data.outputs)
    assert error(pipe, data) < floor + 1e-6


@pytest.mark.slow
def test_two_amplitudes_of_one_sign_take_out_the_quadratic_term():
    data = nltp(0.02, 0.01)
    assert error_by_period(data, "extrapolate") < 0.01


@pytest.mark.slow
def test_predictions_and_scores_read_records_as_they_are(pair):
    pipe = pipeline(pair, "odd").fit(pair.inputs, pair.outputs)
    predicted = pipe.predict(pair.inputs)
    assert predicted.index.equals(pair.outputs.index)
    assert np.all((predicted - pair.outputs).std() < 0.05 * pair.outputs.std())
    one = pair.inputs.loc[[1]], pair.outputs.loc[[1]]  # a record without its partner
    assert pipe.score(*one) > 0.9
    again = pickle.loads(pickle.dumps(pipe))
    np.testing.assert_array_equal(again.predict(one[0]), predicted.loc[[1]])


@pytest.mark.slow
def test_linear_records_are_left_as_they_are():
    """On linear data the pair's odd part is the first record, and so is the model."""
    data = make_flapping_wing("ltp", n_periods=60, start=5, amplitude=[0.02, -0.02])
    odd = pipeline(data, "odd").fit(data.inputs, data.outputs)
    alone = pipeline(data).fit(data.inputs.loc[0], data.outputs.loc[0])
    assert same_poles(odd["reduce"].system_.poles(), alone["reduce"].system_.poles(), 1e-9)
    assert odd["identify"].x0_.shape == (1, 16)
    whole = clone(odd[:2]).set_params(identify__order=2)
    whole.set_params(harmonics__reading="period", harmonics__hop=None)
    assert whole.fit(data.inputs, data.outputs)["identify"].x0_.shape == (1, 2)


# ---- records ------------------------------------------------------------------------------------


def quadratic(amplitudes, n_periods=20, lengths=None, starts=None, gap=None):
    """Records of y = u + u² − 0.3 u³ at some amplitudes."""
    inputs, outputs = {}, {}
    for r, a in enumerate(amplitudes):
        n = n_periods * SPP if lengths is None else lengths[r]
        first = 0 if starts is None else starts[r]
        time = pd.Index((first + np.arange(n)) / SPP, name="time")
        u = a * np.sin(0.1 * np.arange(n))
        keep = np.ones(n, dtype=bool)
        if gap is not None:
            keep[gap] = False
        inputs[f"r{r}"] = pd.DataFrame({"u": u}, index=time)[keep]
        outputs[f"r{r}"] = pd.DataFrame({"y": u + u**2 - 0.3 * u**3}, index=time)[keep]
    return [pd.concat(frames, names=["record"]) for frames in (inputs, outputs)]


def odd_part(u):
    return u - 0.3 * u**3


def read(X, y, small_signal):
    return read_for_fit(HarmonicAnalyzer(OMEGA, small_signal=small_signal).fit_transform(X, y), y)


def test_each_pair_becomes_one_record():
    u, y = quadratic([1.0, -0.5, -1.0, 0.5])
    experiment = read(u, y, "odd")
    assert experiment.base.records == ("r0", "r3")
    for drive, out in zip(experiment.drive, experiment.outputs, strict=True):
        np.testing.assert_allclose(out, odd_part(drive), atol=1e-14)
    np.testing.assert_array_equal(experiment.measured, np.vstack(experiment.outputs))
    assert "t = 0 s" in experiment.span()


def test_records_of_other_lengths_and_starts_are_cut_to_what_they_share():
    lengths, starts = [320, 325], [3, 3 + 5 * SPP]
    experiment = read(*quadratic([1.0, -1.0], lengths=lengths, starts=starts), "odd")
    assert len(experiment.drive[0]) == 320
    np.testing.assert_allclose(
        experiment.outputs[0], experiment.drive[0] - 0.3 * experiment.drive[0] ** 3
    )


def test_gaps_stay_gaps():
    experiment = read(*quadratic([1.0, -1.0], gap=slice(100, 120)), "extrapolate")
    assert experiment.base.records == ("r0", "r0")
    assert [len(u) for u in experiment.drive] == [100, 200]
    np.testing.assert_allclose(
        experiment.outputs[1], experiment.drive[1] - 0.3 * experiment.drive[1] ** 3
    )


REFUSED = {
    "one record": (
        "odd",
        {"amplitudes": [1.0]},
        r"found no partner for record 'r0' among \['r0'\]",
    ),
    "one sign": (
        "odd",
        {"amplitudes": [1.0, -1.0, 0.5]},
        r"no partner for record 'r2' among .*: its input is 0.5 times that of 'r0', and no record "
        r"is -0.5 times it .* leave 'r2' out, or use small_signal='extrapolate'",
    ),
    "another phase": (
        "odd",
        {"amplitudes": [1.0, -1.0], "starts": [0, 4]},
        r"no partner for record 'r0' .* no other record has a multiple of its input",
    ),
    "another length": ("odd", {"amplitudes": [1.0, -1.0], "lengths": [320, 200]}, r"no partner"),
    "one amplitude": (
        "extrapolate",
        {"amplitudes": [1.0, 1.0]},
        r"found only one amplitude for record 'r0' .* give records of one waveform at two",
    ),
    "at rest": ("odd", {"amplitudes": [1.0, -1.0, 0.0]}, r"the input of record 'r2' is at rest"),
}


@pytest.mark.parametrize(("small_signal", "records", "message"), REFUSED.values(), ids=REFUSED)
def test_records_that_do_not_belong_together_are_named(small_signal, records, message):
    u, y = quadratic(**records)
    with pytest.raises(ValueError, match=message):
        read(u, y, small_signal)


def test_an_unknown_way_is_refused():
    u, y = quadratic([1.0, -1.0])
    with pytest.raises(ValueError, match=r"small_signal='even' is not known; use one of"):
        HarmonicAnalyzer(OMEGA, small_signal="even").fit(u, y)


def test_extrapolation_that_amplifies_noise_says_so():
    u, y = quadratic([1.0, 0.8, 0.6])
    with pytest.warns(IdentifiabilityWarning, match=r"\['r0', 'r1', 'r2'\] of amplitudes \[1.0, 0"):
        read(u, y, "extrapolate")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(*quadratic([1.0, 0.5]), "extrapolate")


def test_amplitudes_of_the_dataset():
    data = make_flapping_wing("ltp", n_periods=30, start=5, amplitude=[0.02, -0.01])
    assert data.inputs.index.get_level_values(0).unique().tolist() == [0, 1]
    np.testing.assert_allclose(data.inputs.loc[1], -0.5 * data.inputs.loc[0])
    np.testing.assert_allclose(data.outputs.loc[1], -0.5 * data.outputs.loc[0], atol=1e-10)
    for amplitude, n_records in (([0.02, 0.0], 1), ([0.02, 0.01], 3), ([], 1), ("large", 1)):
        with pytest.raises(ValueError, match=r"amplitude=.*(other than zero|finite number)"):
            make_flapping_wing(amplitude=amplitude, n_records=n_records)
