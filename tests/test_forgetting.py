"""half_life of partial_fit: least squares of weighted rows, whatever the chunks."""

import pickle

import numpy as np
import pandas as pd
import pytest
from conftest import KEPT, random_stable

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.algorithms.subspace.sums import Forgetting
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import ExcitationWarning

HALF_LIFE = 150.0
SETTINGS = {"order": 4, "block_rows": 6, "feedthrough": True}


def simulated(rng, n_rows, noise=0.1, starts=(0,)):
    """Inputs and outputs of a random system, sampled every 0.1 s; records begin at some rows."""
    A, B, C = random_stable(rng, 4, 2, 2)
    u, D = rng.standard_normal((n_rows, 2)), rng.standard_normal((2, 2))
    y = propagate(A, u @ B.T, np.ones(4)) @ C.T + u @ D.T
    y += noise * rng.standard_normal(y.shape)
    row = np.arange(n_rows)
    label = np.searchsorted(starts, row, side="right")
    index = pd.MultiIndex.from_arrays([label, 0.1 * row], names=["record", "time"])
    return pd.DataFrame(u, index, ["a", "b"]), pd.DataFrame(y, index, ["p", "q"])


def in_chunks(X, y, size, half_life, **settings):
    model = MOESPRegressor(**SETTINGS | settings, half_life=half_life)
    for k in range(0, len(X), size):
        model.partial_fit(X.iloc[k : k + size], y.iloc[k : k + size])
    return model


def weighted_gram(signals, starts, half_life, block_rows):
    """Products of weighted Hankel columns [U_f; U_p; Y_p; Y_f], and Σw of the columns."""
    n_lags, total, weight = 2 * block_rows, 0.0, 0.0
    n = len(signals[0])
    for start, stop in zip(starts, [*starts[1:], n], strict=True):
        for k in range(start, stop - n_lags + 1):
            past, future = slice(k, k + block_rows), slice(k + block_rows, k + n_lags)
            u, y = signals
            parts = (u[future], u[past], y[past], y[future])
            column = np.concatenate([part.ravel() for part in parts])
            w = 2.0 ** (-(n - 1 - k) / half_life)
            total, weight = total + w * np.outer(column, column), weight + w
    return total, weight


# ---- the law ---------------------------------------------------------------------------------


@pytest.mark.parametrize("weighting", ["moesp", "pbsid"])
@pytest.mark.filterwarnings("ignore:inputs explain")
def test_chunks_of_any_size_give_the_same_model(rng, weighting):
    X, y = simulated(rng, 1500, starts=(0, 400))
    one, other = (in_chunks(X, y, size, 15.0, weighting=weighting) for size in (97, 1500))
    for name in "ABCD":
        a, b = (getattr(step.model_, name) for step in (one, other))
        np.testing.assert_allclose(a, b, atol=1e-10 * np.abs(b).max())
    np.testing.assert_allclose(one.x0_, other.x0_, atol=1e-9)
    assert one.n_effective_rows_ == pytest.approx(other.n_effective_rows_)


@pytest.mark.parametrize("starts", [(0,), (0, 300, 700)])
def test_the_factor_is_that_of_weighted_hankel_columns(rng, starts):
    X, y = simulated(rng, 900, starts=starts)
    model = in_chunks(X, y, 130, 0.1 * HALF_LIFE)
    data = model._stream.data()
    R = data.factor(6, np.ones(4))
    gram, weight = weighted_gram((X.to_numpy(), y.to_numpy()), starts, HALF_LIFE, 6)
    worth = sum(max(0, n - 11) for n in data.lengths)
    np.testing.assert_allclose(R.T @ R, gram * worth / weight, atol=1e-12 * np.max(R.T @ R))
    w = 2.0 ** (-np.arange(900.0)[::-1] / HALF_LIFE)
    size = np.sqrt(w @ np.hstack([X, y]) ** 2 / np.sum(w))
    np.testing.assert_allclose(data.root_mean_squares(), size)


def test_b_d_and_the_initial_state_are_those_of_weighted_least_squares(rng):
    X, y = simulated(rng, 900)
    model = in_chunks(X, y, 130, 0.1 * HALF_LIFE, scale=False)
    A, C, growth = model.model_.A, model.model_.C, 2.0 ** (0.5 / HALF_LIFE)
    root = growth ** -np.arange(900.0)[::-1, None]
    B, D, x0 = input_matrices(growth * A, C, [root * X.to_numpy()], [root * y.to_numpy()], True)
    np.testing.assert_allclose(model.model_.B, B / growth, atol=1e-10)
    np.testing.assert_allclose(model.model_.D, D, atol=1e-10)
    np.testing.assert_allclose(model.x0_, x0 / root[0], atol=1e-8)


def test_without_noise_nothing_is_lost(rng):
    X, y = simulated(rng, 4000, noise=0.0)
    model = in_chunks(X, y, 333, 10.0, order="auto")
    whole = MOESPRegressor(**SETTINGS).fit(X, y)
    assert model.order_ == 4
    np.testing.assert_allclose(model.eigenvalues_, whole.eigenvalues_, atol=1e-9)
    np.testing.assert_allclose(model.model_.D, whole.model_.D, atol=1e-9)


@pytest.mark.parametrize("half_life", [None, np.inf])
def test_an_infinite_half_life_forgets_nothing(rng, half_life):
    X, y = simulated(rng, 700)
    parts, whole = in_chunks(X, y, 170, half_life), MOESPRegressor(**SETTINGS).fit(X, y)
    np.testing.assert_allclose(parts.model_.A, whole.model_.A, atol=1e-12)
    assert parts.n_effective_rows_ == 700.0
    np.testing.assert_allclose(parts.model_.A, in_chunks(X, y, 170, 1e12).model_.A, atol=1e-8)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ExcitationWarning")
@pytest.mark.slow
def test_half_lives_behind_an_analyzer_are_periods():
    data = make_flapping_wing("ltp", input="multisine", n_periods=30, random_state=0)
    analyzer = HarmonicAnalyzer(data.omega, output_harmonics=KEPT, hop=16, trim_span=None)
    X = analyzer.fit(data.inputs, data.outputs).transform(data.inputs)
    models = []
    for size in (500, 1930):  # in the midst of a period
        models.append(MOESPRegressor(3, block_rows=8, half_life=15.0))
        for k in range(0, len(X), size):
            chunk = analyzer.transform(data.inputs.iloc[k : k + size])
            models[-1].partial_fit(chunk, data.outputs.iloc[k : k + size])
    np.testing.assert_allclose(models[0].model_.A, models[1].model_.A, atol=1e-8)
    n_rows = models[0]._stream.data().n_rows
    assert 110 < sum(n_rows) <= 120
    worth = Forgetting(15.0 * 4).n_effective(n_rows)
    assert models[0].n_effective_rows_ == pytest.approx(worth)


# ---- what it is for ----------------------------------------------------------------------------


def test_a_pole_that_moves_is_followed_at_the_mean_age(rng):
    """A ramp is followed by h / ln 2 rows later; without forgetting by half the record."""
    n, h = 12_000, 400.0
    pole = 0.4 + 0.5 * np.arange(n) / n
    u, y = rng.standard_normal((n, 1)), np.zeros((n, 1))
    for k in range(n - 1):
        y[k + 1] = pole[k] * y[k] + u[k]
    followed, behind = (
        MOESPRegressor(order=1, block_rows=3, feedthrough=False, half_life=each)
        for each in (h, None)
    )
    for rows in np.split(np.arange(n), 10):
        for model in (followed, behind):
            model.partial_fit(u[rows], y[rows])
    lags = [(pole[-1] - m.eigenvalues_[0].real) / (0.5 / n) for m in (followed, behind)]
    assert abs(lags[0] - h / np.log(2.0)) < 0.3 * h / np.log(2.0)
    assert lags[1] > 4000.0


@pytest.mark.slow
def test_deviations_are_those_of_the_effective_rows(rng):
    """200 rows alike and 200 effective ones: the same spread of a pole, within 40 %."""
    h = Forgetting(1.0).half_life * 200.0 / 2.885390
    spread = []
    for n, half_life in ((200, None), (1500, h)):
        poles = []
        for _ in range(60):
            u = rng.standard_normal((n, 1))
            y = propagate(np.array([[0.7]]), u, np.zeros(1)) + rng.standard_normal((n, 1))
            model = MOESPRegressor(order=1, block_rows=3, feedthrough=False, half_life=half_life)
            poles.append(model.partial_fit(u, y).eigenvalues_[0].real)
        spread.append(np.std(poles))
        assert model.n_effective_rows_ == pytest.approx(200.0, rel=0.01)
    assert spread[1] == pytest.approx(spread[0], rel=0.4)


def test_memory_does_not_grow_and_old_beginnings_are_forgotten(rng):
    model, sizes = MOESPRegressor(order=4, block_rows=5, half_life=100.0), []
    A, B, C = random_stable(rng, 4, 2, 3)
    for _ in range(6):
        u = rng.standard_normal((20_000, 2))
        model.partial_fit(u, propagate(A, u @ B.T, np.zeros(4)) @ C.T)
        sizes.append(len(pickle.dumps(model)))
    assert sizes[-1] < 1.01 * max(sizes[:2])
    assert np.all(np.isnan(model.x0_))
    np.testing.assert_allclose(np.sort(model.eigenvalues_), np.sort(np.linalg.eigvals(A)))


# ---- what is refused, and said -----------------------------------------------------------------


def test_an_input_at_rest_for_long_leaves_the_model_as_it_is(rng):
    X, y = simulated(rng, 900)
    model = in_chunks(X.iloc[:600], y.iloc[:600], 200, 2.0)
    before, rest = model.model_, X.copy()
    rest.iloc[600:, 0] = 0.0
    with pytest.warns(ExcitationWarning, match=r"the inputs \['a'\] are at rest"):
        model.partial_fit(rest.iloc[600:], y.iloc[600:])
    assert model.model_ is before


def test_fit_refuses_a_half_life(rng):
    X, y = simulated(rng, 300)
    with pytest.raises(ValueError, match=r"half_life=3.0 is only for partial_fit, and fit weights"):
        MOESPRegressor(**SETTINGS, half_life=3.0).fit(X, y)
    assert not hasattr(MOESPRegressor(**SETTINGS).partial_fit(X, y).fit(X, y), "n_effective_rows_")


@pytest.mark.parametrize(
    ("half_life", "words"),
    [
        (0.0, "half_life must be a positive number"),
        ("long", "half_life must be a positive number"),
        (-np.inf, "half_life must be a positive number"),
        (1.0, "half_life=1.0 seconds keeps a memory of only 28.9 rows, too few for block_rows=6"),
    ],
)
def test_half_lives_that_remember_nothing_are_refused(rng, half_life, words):
    X, y = simulated(rng, 300)
    with pytest.raises(ValueError, match=words):
        MOESPRegressor(**SETTINGS, half_life=half_life).partial_fit(X, y)


def test_the_half_life_stays_that_of_the_first_chunk(rng):
    X, y = simulated(rng, 600)
    model = in_chunks(X.iloc[:300], y.iloc[:300], 300, 20.0)
    with pytest.raises(ValueError, match=r"half_life=30.0 differs from that of the earlier chunks"):
        model.set_params(half_life=30.0).partial_fit(X.iloc[300:], y.iloc[300:])


# ---- the weights themselves ---------------------------------------------------------------------


@pytest.mark.parametrize("lengths", [[50], [20, 3, 40]])
def test_weights_are_those_of_all_rows(lengths):
    forgetting, n = Forgetting(7.0), sum(lengths)
    w = np.split(2.0 ** (-np.arange(float(n))[::-1] / 7.0), np.cumsum(lengths)[:-1])
    np.testing.assert_allclose(forgetting.weights(lengths), [np.sum(each) for each in w])
    lost = [np.sum(each[: max(0, len(each) - 5)]) for each in w]
    np.testing.assert_allclose(forgetting.weights(lengths, 5), lost)
    every = np.concatenate(w)
    worth = np.sum(every) ** 2 / np.sum(every**2)
    assert forgetting.n_effective(lengths) == pytest.approx(worth)
    assert Forgetting(7.0).n_effective([10_000]) == pytest.approx(forgetting.most_rows)
