"""What MOESPRegressor chooses on plain data: order, feedthrough, stability."""

import numpy as np
import pandas as pd
import pytest
from conftest import random_stable
from scipy.signal import lfilter
from sklearn.model_selection import GridSearchCV

from sklearn_hd import MOESPRegressor
from sklearn_hd.algorithms.lti.simulation import simulate
from sklearn_hd.datasets import load_cd_player_arm, load_robot_arm, load_slicot_example
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning, InstabilityWarning
from sklearn_hd.model_selection import BlockSplit

WEIGHTINGS = ("moesp", "n4sid", "cva", "pbsid")
RECORDS = (load_robot_arm, load_cd_player_arm, load_slicot_example)


def noisy(seed, direct, n_rows=1500, noise=0.05):
    """A stable system with coloured inputs; D is as large as the response, or zero."""
    rng = np.random.default_rng(seed)
    A, B, C = random_stable(rng, 3, 2, 2)
    u = lfilter([1.0], [1.0, -0.7], rng.standard_normal((n_rows, 2)), axis=0)
    y = simulate(A, B, C, np.zeros((2, 2)), u, np.zeros(3))
    if direct:
        y = y + u * (np.std(y) / np.std(u))
    return u, y + noise * np.std(y, axis=0) * rng.standard_normal(y.shape)


def validated(model, u, y):
    """100 (1 − √(1 − R²)) of rows that the model has not seen."""
    return 100.0 * (1.0 - np.sqrt(1.0 - model.score(u, y)))


def test_outputs_with_a_mean_that_inputs_have_not_are_told():
    u, y = noisy(1, False)
    MOESPRegressor(order=3).fit(u, y)  # no warning
    MOESPRegressor(order=3).fit(u + 10.0, y + 1.0)  # a gain may make it
    slow = lfilter([0.0, 0.01], [1.0, -0.99], u[:, :1] + 0.3 * np.std(u), axis=0)
    assert abs(slow.mean()) > slow[len(slow) // 4 :].std()
    MOESPRegressor(order=1).fit(u[:, :1] + 0.3 * np.std(u), slow)  # it lasts beside the motion
    with pytest.warns(
        IdentifiabilityWarning, match=r"outputs have a mean larger .* \('y1' 1e\+03 ±"
    ):
        MOESPRegressor(order=3).fit(u, y + np.array([0.0, 1e3]))


# ---- measured records ------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:inputs explain outputs of their own row")
@pytest.mark.parametrize("load", RECORDS)
@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_a_measured_record_has_a_stable_model(load, weighting):
    """The suite makes warnings errors: of an unstable one there would be one."""
    data = load()
    u, y = data.inputs - data.inputs.mean(), data.outputs - data.outputs.mean()
    model = MOESPRegressor(weighting=weighting).fit(u, y)
    assert np.all(np.abs(model.eigenvalues_) < 1.0)
    left = y.to_numpy() - np.asarray(model.predict(u, x0=model.x0_[0]))
    assert np.all(left.var(axis=0) < 0.1 * y.to_numpy().var(axis=0))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:inputs explain outputs of their own row")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.InstabilityWarning")
@pytest.mark.parametrize("load", RECORDS)
@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_the_order_chosen_foretells_as_well_as_the_best(load, weighting):
    """Within 3 points of the best of 18 orders, chosen by the very rows that validate it."""
    data = load()
    n = int(0.6 * len(data.inputs))
    u, y = (table - table.iloc[:n].mean() for table in (data.inputs, data.outputs))
    first, rest = (u.iloc[:n], y.iloc[:n]), (u.iloc[n:], y.iloc[n:])
    chosen = validated(MOESPRegressor(weighting=weighting).fit(*first), *rest)
    for order in range(1, 15 if y.shape[1] == 1 else 19):
        for feedthrough in (False, True):
            other = MOESPRegressor(order, weighting=weighting, feedthrough=feedthrough)
            if np.isfinite(other.fit(*first).score(*rest)):
                assert chosen > validated(other, *rest) - 3.0


# ---- feedthrough -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "weighting",
    [
        "moesp",
        pytest.param("n4sid", marks=pytest.mark.slow),
        pytest.param("cva", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("direct", [False, True])
def test_d_is_free_where_outputs_answer_at_once(weighting, direct):
    for seed in range(10):
        model = MOESPRegressor(weighting=weighting).fit(*noisy(seed, direct))
        assert model.feedthrough_ == direct == bool(np.any(model.model_.D))


@pytest.mark.parametrize("direct", [False, True])
def test_d_in_chunks_is_decided_without_simulations(direct):
    u, y = noisy(0, direct)
    model = MOESPRegressor(3, block_rows=8)
    for rows in np.split(np.arange(1500), 3):
        model.partial_fit(u[rows], y[rows])
    assert model.feedthrough_ == direct
    words = "inputs explain outputs of their own row: " if direct else "no input acts at once: "
    assert model.feedthrough_reason_.startswith(words)


def test_a_feedthrough_that_a_predictor_leaves_out_is_warned_of():
    with pytest.warns(IdentifiabilityWarning, match="which look alike, so D is zero"):
        assert not MOESPRegressor(3, weighting="pbsid").fit(*noisy(0, True)).feedthrough_
    assert not MOESPRegressor(3, weighting="pbsid").fit(*noisy(0, False)).feedthrough_


def test_without_noise_no_d_comes_of_rounding(rng):
    A, B, C = random_stable(rng, 4, 1, 2)
    u = rng.standard_normal((400, 1))
    y = simulate(A, B, C, np.zeros((2, 1)), u, rng.standard_normal(4))
    for weighting in WEIGHTINGS:
        model = MOESPRegressor(weighting=weighting).fit(u, y)
        assert (model.order_, model.feedthrough_) == (4, False)


def test_feedback_within_the_row_is_no_feedthrough():
    rng, u, y = np.random.default_rng(0), np.zeros((4000, 1)), np.zeros((4000, 1))
    x = np.zeros(1)
    for k in range(4000):
        y[k] = x + 0.5 * rng.standard_normal()
        u[k] = -0.4 * y[k] + rng.standard_normal()
        x = 0.9 * x + u[k]
    with pytest.warns(IdentifiabilityWarning, match=r"own row: [3-8].*% .* feedback within"):
        model = MOESPRegressor(1, weighting="pbsid").fit(u, y)
    assert not model.feedthrough_
    assert model.eigenvalues_[0].real == pytest.approx(0.9, abs=0.02)
    assert (model.model_.C @ model.model_.B).item() == pytest.approx(1.0, abs=0.05)
    biased = MOESPRegressor(1, weighting="pbsid", feedthrough=True).fit(u, y)
    assert abs(biased.model_.D.item()) > 0.1  # what "auto" has kept out


def test_reasons_are_given(rng):
    u, y = noisy(0, True)
    reasons = {
        "feedthrough=False was asked for": MOESPRegressor(3, feedthrough=False).fit(u, y),
        "there are no inputs": MOESPRegressor(1).fit(None, np.cos(np.arange(80.0))[:, None]),
        "lower with D free": MOESPRegressor(3).fit(u, y),
    }
    with pytest.warns(ExcitationWarning, match="a static gain is fitted"):
        reasons["the model is D alone"] = MOESPRegressor().fit(u[:3], y[:3])
    for reason, model in reasons.items():
        assert model.feedthrough_reason_.endswith(reason)


# ---- order -----------------------------------------------------------------------------------


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_what_the_search_says_is_left_is_left(weighting):
    u, y = noisy(1, False)
    model = MOESPRegressor(weighting=weighting).fit(u, y)
    found = model.order_search_
    at = list(found["order"]).index(model.order_)
    left = y - model.predict(u, x0=model.x0_[0])
    share = np.sqrt(np.mean(np.sum(left**2, axis=0) / np.sum(y**2, axis=0)))
    assert found["share"][at] == pytest.approx(share, rel=0.01)
    assert found["stable"][at]
    compared = found["feedthrough"] == found["feedthrough"][0]
    best = np.argmin(np.where(compared & found["stable"], found["bic"], np.inf))
    assert found["order"][at] <= found["order"][best]
    assert found["variance"][at] <= 1.01 * found["variance"][best]


def test_units_change_no_choice():
    u, y = noisy(2, True)
    for weighting in ("moesp", "n4sid", "cva"):
        model = MOESPRegressor(weighting=weighting).fit(u, y)
        other = MOESPRegressor(weighting=weighting).fit(u * [1e-6, 1e3], y * [1e5, 1e-4])
        assert (model.order_, model.feedthrough_) == (other.order_, other.feedthrough_)


# ---- stability -------------------------------------------------------------------------------


@pytest.mark.parametrize("weighting", WEIGHTINGS)
def test_a_stable_model_is_given_where_asked_for(weighting):
    """Of a growing record, which without it has an unstable model, and a warning."""
    rng = np.random.default_rng(0)
    A, B, C = np.diag([1.02, 0.6]), np.ones((2, 1)), np.ones((1, 2))
    u = rng.standard_normal((200, 1))
    y = simulate(A, B, C, np.zeros((1, 1)), u, np.zeros(2)) + 0.05 * rng.standard_normal((200, 1))
    settings = {"order": 2, "block_rows": 8, "weighting": weighting, "disturbance_model": True}
    with pytest.warns(InstabilityWarning, match=r"the model is unstable: .* use stable=True"):
        free = MOESPRegressor(**settings).fit(u, y)
    model = MOESPRegressor(stable=True, **settings).fit(u, y)
    mirrored = np.sort(np.minimum(np.abs(free.eigenvalues_), 1.0 / np.abs(free.eigenvalues_)))
    np.testing.assert_allclose(np.sort(np.abs(model.eigenvalues_)), mirrored, rtol=1e-6)
    predictor = model.model_.A - model.kalman_gain_ @ model.model_.C
    assert np.max(np.abs(np.linalg.eigvals(predictor))) < 1.0
    assert np.all(np.isfinite(model.predict(np.ones((20_000, 1)))))


def test_a_stable_model_is_the_same_with_and_without():
    u, y = noisy(3, False)
    one, other = (MOESPRegressor(3, stable=stable).fit(u, y) for stable in (False, True))
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(one.model_, name), getattr(other.model_, name))


@pytest.mark.filterwarnings("ignore:the model is unstable")  # of the first rows
@pytest.mark.parametrize("weighting", ["n4sid", "cva"])
def test_in_chunks_all_weightings_have_the_order_of_the_plain_projection(weighting):
    """N4SID's noise floor lay above all singular values of the arm: order 1."""
    arm = load_robot_arm()
    u, y = arm.inputs.to_numpy(), arm.outputs.to_numpy()
    orders = []
    for name in (weighting, "moesp"):
        model = MOESPRegressor(weighting=name, block_rows=15)
        for rows in np.array_split(np.arange(len(u)), 4):
            model.partial_fit(u[rows], y[rows])
        orders.append(model.order_)
    assert orders[0] == orders[1] > 1


def test_outputs_ahead_of_their_inputs_are_told():
    """No simulation explains them: neither order nor D is decided by what is not a number."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(60), 20)[:, None]
    y = np.append(np.diff(u[:, 0]), 0.0) + 0.01 * rng.standard_normal(1200)
    with (
        pytest.warns(IdentifiabilityWarning, match="no model explains the outputs"),
        pytest.warns(InstabilityWarning),
    ):
        model = MOESPRegressor(weighting="n4sid").fit(u, y)
    assert "nan" not in model.feedthrough_reason_


@pytest.mark.slow
def test_records_with_many_gaps_keep_their_order():
    u, y = noisy(4, False, 6000, 0.1)
    rows = np.sort(np.random.default_rng(0).choice(6000, 5600, replace=False))
    X, Y = (pd.DataFrame(z, index=0.01 * np.arange(6000)).iloc[rows] for z in (u, y))
    with_gaps = MOESPRegressor(block_rows=6).fit(X.add_prefix("u"), Y.add_prefix("y"))
    assert with_gaps.order_ == MOESPRegressor(block_rows=6).fit(u, y).order_ == 3


def test_of_a_search_only_the_model_that_it_ends_with_is_warned_of():
    """Orders too high are unstable on some folds: their scores tell."""
    u, y = noisy(5, False, 300, 0.3)
    orders = {"order": [2, 3, 12, 16]}
    GridSearchCV(MOESPRegressor(block_rows=10), orders, cv=BlockSplit(4), error_score="raise").fit(
        pd.DataFrame(u).add_prefix("u"), pd.DataFrame(y).add_prefix("y")
    )
    growing = np.cumsum(1.03 ** np.arange(200.0))[:, None]
    with pytest.warns(InstabilityWarning, match="the model is unstable"):
        GridSearchCV(MOESPRegressor(block_rows=10), {"order": [1]}, cv=BlockSplit(2)).fit(
            u[:200], growing + np.cumsum(u[:200], axis=0)[:, :1]
        )
