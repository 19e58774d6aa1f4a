"""Laws of the steps of the pipeline, over systems, records and units drawn at random."""

import pickle

import numpy as np
import pandas as pd
import pytest
from conftest import same_poles
from hypothesis import given
from hypothesis import strategies as st
from law_cases import (
    SEEDS,
    UP_TO_THREE,
    System,
    examples,
    identifiable_systems,
    markov,
    poles,
    recorded,
    samplings,
    well_conditioned,
)
from scipy import linalg
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete

LENGTHS = st.lists(st.integers(150, 400), min_size=1, max_size=4)
UNITS = st.lists(st.sampled_from([1e-6, 1e-2, 1.0, 30.0, 1e5]), min_size=6, max_size=6)


def moesp(system, **options):
    """Of the order of the system, with block rows enough whatever the outputs."""
    n = len(system.A)
    settings = {"order": n, "block_rows": n + 2, "feedthrough": True}
    return MOESPRegressor(**settings | options)


def noisy(y, rng, share=1e-3):
    """Less noise than the faintest state shows: what it drowns could have any eigenvalue."""
    return y + share * y.std().to_numpy() * rng.standard_normal(y.shape)


def impulse(step):
    model = step.model_
    return markov(model.A, model.B, model.C, model.D)


def starts(step):
    """What the initial states of the segments alone would show of the outputs, from sample 0 on."""
    model = step.model_
    A_k = np.eye(model.n_states)
    shown = []
    for _ in range(6):
        shown.append(step.x0_ @ (model.C @ A_k).T)
        A_k = model.A @ A_k
    return np.stack(shown, axis=1)


def same(found, expected, rtol):
    __tracebackhide__ = True
    found, expected = np.asarray(found), np.asarray(expected)
    np.testing.assert_allclose(found, expected, atol=rtol * np.abs(expected).max())


# ---- identification -----------------------------------------------------------------------------


@examples(20)
@given(identifiable_systems(), LENGTHS, SEEDS, st.booleans())
def test_a_system_comes_back_from_its_noise_free_record(system, lengths, seed, scale):
    X, y = recorded(system, np.random.default_rng(seed), lengths)
    model = moesp(system, scale=scale).fit(X, y)
    assert same_poles(model.eigenvalues_, linalg.eigvals(system.A), 1e-5)
    same(impulse(model), markov(*system.matrices), 1e-6)
    assert model.score(X, y) > 1.0 - 1e-9


@examples(15)
@given(identifiable_systems(), LENGTHS, SEEDS, UNITS)
def test_units_scale_b_c_and_d(system, lengths, seed, units):
    rng = np.random.default_rng(seed)
    X, y = recorded(system, rng, lengths)
    y = noisy(y, rng)
    per_input, per_output = np.array(units[: X.shape[1]]), np.array(units[3 : 3 + y.shape[1]])
    reference, model = moesp(system).fit(X, y), moesp(system).fit(X * per_input, y * per_output)
    assert same_poles(model.eigenvalues_, reference.eigenvalues_, 1e-7)
    in_units = impulse(model) / per_output[:, None] * per_input
    same(in_units, impulse(reference), 1e-8)
    score = model.score(X * per_input, y * per_output)
    assert score == pytest.approx(reference.score(X, y), rel=1e-9)


@examples(10)
@given(identifiable_systems(), LENGTHS, SEEDS, st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_one_unit_for_all_inputs_or_outputs_needs_no_scaling(system, lengths, seed, of_u, of_y):
    rng = np.random.default_rng(seed)
    X, y = recorded(system, rng, lengths)
    y = noisy(y, rng)
    reference = moesp(system, scale=False).fit(X, y)
    model = moesp(system, scale=False).fit(X * of_u, y * of_y)
    assert same_poles(model.eigenvalues_, reference.eigenvalues_, 1e-7)
    same(impulse(model) / of_y * of_u, impulse(reference), 1e-8)


@examples(10)
@given(identifiable_systems(), LENGTHS, SEEDS)
def test_the_order_of_records_is_no_matter(system, lengths, seed):
    rng = np.random.default_rng(seed)
    X, y = recorded(system, rng, lengths)
    y = noisy(y, rng)
    order = rng.permutation(len(lengths))
    X_again, y_again = (pd.concat([z.loc[[label]] for label in order]) for z in (X, y))
    reference, model = moesp(system).fit(X, y), moesp(system).fit(X_again, y_again)
    same(impulse(model), impulse(reference), 1e-8)
    same(starts(model), starts(reference)[order], 1e-7)
    predicted = reference.predict(X)
    same(reference.predict(X_again), pd.concat([predicted.loc[[label]] for label in order]), 1e-12)


@examples(10)
@given(identifiable_systems(), LENGTHS, SEEDS, st.integers(-(10**4), 10**4))
def test_records_are_parts_at_gaps_and_begin_at_any_time(system, lengths, seed, start):
    rng = np.random.default_rng(seed)
    X, y = recorded(system, rng, lengths)
    y = noisy(y, rng)
    holes = np.cumsum(rng.integers(1, 40, len(lengths)))
    counts = start + np.arange(len(X)) + np.repeat(holes, lengths)
    time = pd.Index(0.1 * counts, name="time")
    reference = moesp(system).fit(X, y)
    model = moesp(system).fit(X.set_axis(time), y.set_axis(time))
    same(impulse(model), impulse(reference), 1e-9)
    same(starts(model), starts(reference), 1e-8)
    same(model.predict(X.set_axis(time)), model.predict(X), 1e-12)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ExcitationWarning")  # first chunks
@examples(15)
@given(identifiable_systems(), LENGTHS, SEEDS)
@pytest.mark.slow
def test_chunks_give_the_model_of_all_rows(system, lengths, seed):
    rng = np.random.default_rng(seed)
    X, y = recorded(system, rng, lengths)
    y = noisy(y, rng)
    whole, parts = moesp(system).fit(X, y), moesp(system)
    cuts = np.unique(rng.integers(2, len(X), rng.integers(1, 6)))  # one row tells no sample time
    for rows in np.split(np.arange(len(X)), cuts):
        parts.partial_fit(X.iloc[rows], y.iloc[rows])
    same(impulse(parts), impulse(whole), 1e-10)
    same(starts(parts), starts(whole), 1e-9)


@examples(10)
@given(identifiable_systems(), LENGTHS, SEEDS)
def test_a_fit_repeats_itself_to_the_last_bit(system, lengths, seed):
    rng = np.random.default_rng(seed)
    X, y = recorded(system, rng, lengths)
    given_X, given_y = X.copy(), y.copy()
    model = moesp(system, order="auto").fit(X, y)
    pd.testing.assert_frame_equal(X, given_X)
    pd.testing.assert_frame_equal(y, given_y)
    again = clone(model).fit(X, y)
    stored = pickle.loads(pickle.dumps(model))
    for other in (again, stored):
        for name in "ABCD":
            one, two = (getattr(step.model_, name).tobytes() for step in (model, other))
            assert one == two
        pd.testing.assert_frame_equal(other.predict(X), model.predict(X), check_exact=True)


# ---- simulation ---------------------------------------------------------------------------------


@examples(15)
@given(identifiable_systems(positive=True), LENGTHS, SEEDS, st.booleans())
@pytest.mark.slow
def test_predictions_add_up(system, lengths, seed, continuous):
    """Linear in the inputs and the initial state together, each record by itself."""
    rng = np.random.default_rng(seed)
    X, y = recorded(system, rng, lengths)
    model = moesp(system)
    model = (SpuriousModeReducer(model) if continuous else model).fit(X, y)
    n = model.model_.n_states
    one, two = (X * 0.0 + rng.standard_normal(X.shape) for _ in range(2))
    x0 = rng.standard_normal((2, len(lengths), n))
    together = model.predict(one - 3.0 * two, x0=x0[0] - 3.0 * x0[1])
    same(together, model.predict(one, x0=x0[0]) - 3.0 * model.predict(two, x0=x0[1]), 1e-9)
    alone = [model.predict(one.loc[[k]], x0=x0[0, k]).to_numpy() for k in range(len(lengths))]
    same(model.predict(one, x0=x0[0]), np.vstack(alone), 1e-12)


# ---- degenerate equivalences --------------------------------------------------------------------


@examples(15)
@given(identifiable_systems(positive=True), LENGTHS, SEEDS)
def test_nothing_spurious_makes_the_reduction_the_identity(system, lengths, seed):
    X, y = recorded(system, np.random.default_rng(seed), lengths)
    reducer = SpuriousModeReducer(moesp(system)).fit(X, y)
    model = reducer.model_
    assert reducer.modes_["verdict"].eq("genuine").all()
    A, B = continuous_to_discrete(model.A, model.B, 0.1)
    same(markov(A, B, model.C, model.D), markov(*system.matrices), 1e-6)
    same(reducer.predict(X), reducer.estimator_.predict(X), 1e-6)


@examples(8)
@given(poles(discrete=False, n_states=UP_TO_THREE), LENGTHS, SEEDS, st.floats(0.0, 1.0))
def test_a_model_of_the_structure_asked_for_is_matched_without_error(
    spectrum, lengths, seed, share
):
    """Some entries of A and B known, the states measured, so that the others are determined."""
    real, upper = spectrum
    rng = np.random.default_rng(seed)
    blocks = [[[p]] for p in real] + [[[p.real, p.imag], [-p.imag, p.real]] for p in upper]
    A = linalg.block_diag(*blocks)
    n = len(A)
    T = well_conditioned(rng, n)
    A, B = T @ A @ np.linalg.inv(T), rng.standard_normal((n, 2))
    sampled = System(*continuous_to_discrete(A, B, 0.1), np.eye(n), np.zeros((n, 2)), 0.1)
    X, y = recorded(sampled, rng, lengths)
    known = [np.where(rng.uniform(size=M.shape) < share, M, np.nan) for M in (A, B)]
    known[1][0, 0] = np.nan
    structure = MatrixStructure(*known)
    model = moesp(sampled, feedthrough=False)
    matcher = StructuredMatcher(model, structure=structure, n_starts=0).fit(X, y)
    size = np.abs(B).max() / np.abs(linalg.eigvals(A).real).min()
    assert matcher.hinf_error_ <= 1e-6 * size
    for found, true in zip(structure.matrices(matcher.theta_), (A, B), strict=False):
        same(found, true, 1e-5)


# ---- through the analyzer -----------------------------------------------------------------------


@examples(10)
@given(identifiable_systems(), samplings(), SEEDS)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* the samples have")  # nothing: they stand within the period
def test_signals_held_over_the_period_leave_plain_identification(system, sampling, seed):
    """Harmonic 0 alone, period by period, of signals that change between periods only."""
    rng, spp, n_periods = np.random.default_rng(seed), sampling.samples_per_period, 220
    X, y = recorded(system, rng, [n_periods])
    index = pd.Index(sampling.time(0, spp * n_periods), name="time")
    X_held, y_held = (
        pd.DataFrame(np.repeat(z.to_numpy(), spp, axis=0), index, z.columns) for z in (X, y)
    )
    plain = moesp(system).fit(X, y)
    analyzer = HarmonicAnalyzer(sampling.omega, output_harmonics=0, reading="period")
    pipe = Pipeline([("harmonics", analyzer), ("identify", moesp(system))]).fit(X_held, y_held)
    assert same_poles(pipe[-1].eigenvalues_, plain.eigenvalues_, 1e-7)
    same(impulse(pipe[-1]), impulse(plain), 1e-8)
    same(pipe.predict(X_held), np.repeat(plain.predict(X), spp, axis=0), 1e-7)


def few_rows(divisors):
    """Hops that read three to eight rows a period, so that no copies fold onto modes."""
    whole = divisors[-1]
    return [*(d for d in divisors if 3 <= whole // d <= 8), "period"]


@examples(10)
@given(
    identifiable_systems(n_states=UP_TO_THREE, feedthrough=False),
    samplings(hops=few_rows),
    SEEDS,
    st.integers(-40, 40),
)
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the data repeat themselves")  # as a ringing mode may seem to
@pytest.mark.filterwarnings("ignore:.* the samples have")  # nothing: they stand within the period
def test_whole_periods_later_nothing_changes(system, sampling, seed, shift):
    """Of a system that answers from one row read to the next."""
    rng, spp = np.random.default_rng(seed), sampling.samples_per_period
    held = spp if sampling.hop == "period" else sampling.hop
    X, y = recorded(system, rng, [300])
    n_samples = 300 * held
    X, y = (z.iloc[np.repeat(np.arange(300), held)] for z in (X, noisy(y, rng)))
    analyzer = HarmonicAnalyzer(sampling.omega, output_harmonics=1, **sampling.options)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(order=len(system.A)))])
    found = []
    for first in (0, shift * spp):
        times = pd.Index(sampling.time(first, n_samples), name="time")
        inputs, outputs = X.set_axis(times), y.set_axis(times)
        pipe.fit(inputs, outputs)
        simulated = pipe.predict(inputs).to_numpy()
        found.append((impulse(pipe[-1]), simulated, pipe.score(inputs, outputs)))
    for here, later in zip(*found, strict=True):
        same(later, here, 1e-6)
