"""The order by what simulations leave of a record."""

import numpy as np
import pytest

from sklearn_hd.algorithms.lti.simulation import simulate
from sklearn_hd.algorithms.subspace.order import PATIENCE, Comparison


def comparison(models, u, y, **fed_back):
    """Of given models, A, B, C, D by order."""
    return Comparison(lambda order, feedthrough: (*models[order], None), [u], [y], **fed_back)


def nested(rng, n_orders, true_order, noise):
    """The first states of one diagonal system; those beyond the true order have no outputs."""
    poles = rng.uniform(0.3, 0.95, n_orders) * rng.choice([-1.0, 1.0], n_orders)
    B, C = rng.uniform(0.5, 1.5, (n_orders, 2)), rng.uniform(0.5, 1.5, (2, n_orders))
    C[:, true_order:] = 1e-4 * rng.standard_normal((2, n_orders - true_order))
    models = {
        n: (np.diag(poles[:n]), B[:n], C[:, :n], np.zeros((2, 2))) for n in range(1, n_orders + 1)
    }
    u = rng.standard_normal((800, 2))
    y = simulate(*models[true_order], u, rng.standard_normal(true_order))
    return models, u, y + noise * rng.standard_normal(y.shape)


@pytest.mark.parametrize("true_order", [1, 2, 4])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_order_of_the_record_is_found(rng, true_order, noise):
    models, u, y = nested(rng, 9, true_order, noise)
    assert comparison(models, u, y).order(9, False) == true_order


def test_units_do_not_matter(rng):
    models, u, y = nested(rng, 6, 3, 0.1)
    size = np.array([1e-6, 1e4])
    scaled = {n: (A, B, C * size[:, None], D) for n, (A, B, C, D) in models.items()}
    found, other = comparison(models, u, y), comparison(scaled, u, y * size)
    assert found.order(6, False) == other.order(6, False) == 3
    for one, two in zip(found.tried, other.tried, strict=True):
        assert one.share == pytest.approx(two.share)
        assert one.bic == pytest.approx(two.bic)


def test_what_is_left_is_what_noise_is(rng):
    models, u, y = nested(rng, 4, 3, 0.2)
    size = np.sqrt(np.mean(y**2, axis=0))
    left = comparison(models, u, y).simulated(3, False)
    assert left.share == pytest.approx(np.sqrt(np.mean((0.2 / size) ** 2)), rel=0.05)
    assert left.variance == pytest.approx(np.exp(np.mean(np.log((0.2 / size) ** 2))), rel=0.1)


def test_an_unstable_model_of_a_stable_record_is_passed_over(rng):
    """It fits 500 rows no worse, by a mode that outputs hardly see."""
    models, u, y = nested(rng, 3, 2, 0.1)
    A, B, C, D = models[2]
    B0, C0 = np.zeros((1, 2)), 1e-6 * np.ones((2, 1))
    block = np.diag([*np.diagonal(A), 1.02])
    models = {1: models[1], 2: (block, np.vstack([B, B0]), np.hstack([C, C0]), D), 3: (A, B, C, D)}
    found = comparison(models, u, y)
    assert found.order(3, False) == 3  # two states, and stable
    assert [each.stable for each in found.tried] == [True, False, True]


def test_an_unstable_system_is_found_where_outputs_grow(rng):
    A, B, C = np.diag([1.02, 0.5]), np.ones((2, 1)), np.ones((1, 2))
    models = {
        1: (A[1:, 1:], B[1:], C[:, 1:], np.zeros((1, 1))),
        2: (A, B, C, np.zeros((1, 1))),
    }
    u = rng.standard_normal((300, 1))
    y = simulate(*models[2], u, np.zeros(2)) + 0.1 * rng.standard_normal((300, 1))
    assert comparison(models, u, y).order(2, False) == 2


def test_feedback_may_hold_an_unstable_system(rng):
    A, B, C = np.array([[1.1]]), np.ones((1, 1)), np.ones((1, 1))
    models = {1: (0.9 * np.eye(1), B, C, np.zeros((1, 1))), 2: (A, B, C, np.zeros((1, 1)))}
    x, u, y = 0.0, np.zeros((3000, 1)), np.zeros((3000, 1))
    for k in range(3000):
        y[k] = x + 0.1 * rng.standard_normal()
        u[k] = -0.5 * y[k] + rng.standard_normal()
        x = 1.1 * x + u[k, 0]
    assert comparison(models, u, y, fed_back=True).order(2, False) == 2
    alone = comparison(models, u, y)  # in open loop it would have grown by 1e124
    assert alone.order(2, False) == 1
    assert alone.simulated(2, False).share > 1e6


def test_the_search_ends_some_orders_after_the_best(rng):
    models, u, y = nested(rng, 12, 2, 0.1)
    found = comparison(models, u, y)
    assert found.order(12, False) == 2
    assert len(found.tried) == 2 + PATIENCE


def test_nothing_finite_is_no_order(rng):
    u, one = rng.standard_normal((4000, 1)), np.ones((1, 1))
    wild = {1: (2.0 * one, one, one, 0.0 * one)}
    assert comparison(wild, u, u).order(1, False) is None


def test_many_initial_states_do_not_outweigh_an_order(rng):
    """Each costs what its own segment's rows can tell: 60 of these have two states or four."""
    models, u, y = nested(rng, 6, 4, 0.1)
    parts = [slice(k, k + 13) for k in range(0, 780, 13)]
    found = Comparison(
        lambda order, feedthrough: (*models[order], None),
        [u[rows] for rows in parts],
        [y[rows] for rows in parts],
    )
    assert found.order(6, False) == 4


def test_an_integrator_is_taken_for_stable_whatever_side_its_pole_is_on(rng):
    """Its growth over the record is below e-fold; order 1 leaves but little more."""
    models, u, y = nested(rng, 2, 2, 0.1)
    A, B, C, D = models[2]
    integrator = np.array([[1.0004]]), np.ones((1, 2)), 0.1 * np.ones((2, 1))
    with_it = (np.diag([*np.diagonal(A), 1.0004]), np.vstack([B, integrator[1]]), None, D)
    C = np.hstack([C, integrator[2]])
    models = {1: models[1], 2: models[2], 3: (*with_it[:2], C, D)}
    y = simulate(*models[3], u, np.zeros(3)) + 0.1 * rng.standard_normal(y.shape)
    found = comparison(models, u, y)
    assert found.order(3, False) == 3
    assert found.simulated(3, False).stable


def test_what_makes_no_material_difference_is_left_out(rng):
    """A state that outputs see by a thousandth of the noise, over rows enough to tell it."""
    models, u, _ = nested(rng, 3, 2, 0.1)
    u = rng.standard_normal((200_000, 2))
    A, B, C, D = models[3]
    C = C * np.array([1.0, 1.0, 90.0])  # 0.9 % of what the others are
    models[3] = A, B, C, D
    y = simulate(A, B, C, D, u, np.zeros(3)) + 0.5 * rng.standard_normal((200_000, 2))
    found = comparison(models, u, y)
    assert found.order(3, False) == 2
    assert found.simulated(3, False).bic < found.simulated(2, False).bic
