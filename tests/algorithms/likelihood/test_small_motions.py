"""Small motions of machines that are not linear."""

import numpy as np
import pytest
from innovation_cases import STEP, multipliers

from sklearn_hd.algorithms.likelihood import small_motions
from sklearn_hd.algorithms.likelihood.innovations_steps import most_likely
from sklearn_hd.algorithms.likelihood.small_motions import (
    LargeMotions,
    _Products,
    _told_as_factors,
)
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_predictor import Layout

SEEN = Layout(1, 2, 2, 1, 1, 0, feedthrough=False)
REST = np.zeros((1, 1))


def seen(n_products=0):
    """An oscillation whose states are outputs, its frequency varying over the turn."""
    coefficients = np.zeros((3, 4, 4 + n_products))
    coefficients[0, :2, :3] = [[0.9, 0.3, 0.5], [-0.3, 0.8, 1.0]]
    coefficients[1, 1, 0], coefficients[0, 2:, :2] = 0.1, np.eye(2)
    gain = np.zeros((3, 2, 2))
    gain[0] = 0.1 * np.eye(2)
    return PeriodicInnovations(coefficients, gain, 1e-4 * np.eye(2), STEP, 0.0)


def bent(model, degree, bend, n_rows, seed, mean=0.0, centre=0.0):
    """A record of a model to whose second state a power of the first is added.

    The power is about a centre, and zero where the state is. Inputs are given about their mean.
    """
    rng = np.random.default_rng(seed)
    psi, u = STEP * np.arange(n_rows), 0.1 * rng.standard_normal((n_rows, 1))
    e = 0.01 * rng.standard_normal((n_rows, 2))
    values, x, y = evaluate_harmonics(model.coefficients, psi), np.zeros(2), np.empty((n_rows, 2))
    for k in range(n_rows):
        y[k] = x + e[k]
        driven = values[k, :2] @ [*x, *(u[k] + mean), 1.0]
        force = bend * ((x[0] - centre) ** degree - (-centre) ** degree)
        x = driven + 0.1 * e[k] + [0.0, force]
    return u, y, psi


def off(model, true):
    return np.max(np.abs(multipliers(model) - multipliers(true)))


@pytest.mark.parametrize(("degree", "bend"), [(2, 0.2), (3, -0.1)])
@pytest.mark.slow
def test_beside_products_exponents_are_those_of_small_motions(degree, bend):
    true = seen()
    some = [bent(true, degree, bend, 1500, seed) for seed in (1, 2)]
    linear, _ = most_likely(true, some, SEEN, 1e-3)
    large = LargeMotions.of(linear, some, SEEN, 1e-3, np.inf)
    small = large.small_motions(REST)
    assert off(small.innovations, true) < 0.25 * off(linear, true)
    assert degree in large.products.degrees
    np.testing.assert_allclose(np.diag(large.covariance), 1e-4, rtol=0.1)  # that of e
    assert np.max(np.diag(linear.covariance)) > 1.1e-4
    assert small.innovations.n_inputs == 1
    known, deviations = small.of_smaller
    assert np.all(np.abs(np.sort_complex(known) - multipliers(true)) < 5.0 * deviations)


@pytest.mark.slow
def test_small_motions_are_those_about_inputs_at_rest():
    """Inputs that have a mean hold the machine where its spring is harder."""
    true, mean = seen(), 0.06
    some = [bent(true, 2, 0.2, 1500, seed, mean) for seed in (1, 2)]
    linear, _ = most_likely(true, some, SEEN, 1e-3)
    large = LargeMotions.of(linear, some, SEEN, 1e-3, np.inf)
    held, free = (large.small_motions(rest) for rest in (REST, REST - mean))
    deviations = free.ahead[1]
    assert off(free.innovations, true) < 4.0 * np.max(deviations)
    assert off(held.innovations, true) > 10.0 * off(free.innovations, true)
    at_zero = free.at_rest.about(mean + REST, np.zeros((1, 2))).forced_response(0)
    assert np.max(np.abs(at_zero)) < 0.02  # of outputs that have a mean of 0.26 in the record
    assert free.about_rest
    assert not large.small_motions(REST - 20.0 * mean).about_rest  # the motion does not reach it


@pytest.mark.slow
def test_a_cube_about_the_mean_is_not_one_about_the_orbit_at_rest():
    """Squares come with it, although products of two did not pay."""
    centre, mean, bend = 0.3, 0.089, -0.3
    true = seen()
    true.coefficients[0, 1, 0] += 3.0 * bend * centre**2
    some = [bent(seen(), 3, bend, 1500, seed, mean, centre) for seed in (1, 2)]
    linear, _ = most_likely(seen(), some, SEEN, 1e-3)
    large = LargeMotions.of(linear, some, SEEN, 1e-3, np.inf)
    small = large.small_motions(REST - mean)
    assert large.products.degrees == (3,)
    assert small.about_rest
    assert off(small.innovations, true) < 4.0 * np.max(small.ahead[1])
    assert off(linear, true) > 4.0 * np.max(small.ahead[1])


@pytest.mark.slow
def test_no_pass_begins_at_a_model_that_grows():
    true, mean = seen(), 0.06
    some = [bent(true, 2, 0.2, 1500, seed, mean) for seed in (1, 2)]
    linear, _ = most_likely(true, some, SEEN, 1e-3)
    at_zero = LargeMotions.of(linear, some, SEEN, 1e-3, np.inf).small_motions(REST - mean)
    limit = 0.5 * (linear.growth() + at_zero.innovations.growth())
    assert at_zero.innovations.growth() > limit > linear.growth()
    held = LargeMotions.of(linear, some, SEEN, 1e-3, limit).small_motions(REST - mean)
    assert not held.about_rest
    assert held.innovations.growth() < limit


def test_products_about_another_centre_are_the_same_polynomial():
    """Law: what a state is led to does not depend on what products are counted from."""
    rng, psi = np.random.default_rng(8), STEP * np.arange(300)
    z = 0.3 * rng.standard_normal((300, 3))
    before = _Products.of([(z, psi)], (2, 3), 0)
    after = _Products.of([(z, psi)], (2, 3), 0, 0.2 * rng.standard_normal((1, 3)))
    model = seen(len(before.which))
    model.coefficients[:, :2, 3:] = rng.standard_normal(model.coefficients[:, :2, 3:].shape)

    def led_to(products, uncentred):
        u = products.beside([(z[:, 2:], None, psi)], [(z, psi)])[0][0]
        u[:, 1:] += products.means
        signals = np.hstack([z[:, :2], u, np.ones((300, 1))])
        return np.einsum("tij,tj->ti", uncentred.rows(psi).states, signals)

    same = led_to(before, before.with_means(model))
    moved = led_to(after, before._moved(model, after.centre, after))
    np.testing.assert_allclose(moved, same, rtol=0.0, atol=1e-11 * np.max(np.abs(same)))


def test_a_power_that_goes_with_its_input_is_left_out():
    """u³ of steps to −1, 0 and 1 is u: noise would decide which of them moves the machine."""
    rng, psi = np.random.default_rng(5), STEP * np.arange(2000)
    x, u = rng.standard_normal((2000, 1)), rng.choice([-1.0, 0.0, 1.0], (2000, 1))
    motion = [(np.hstack([x, u]), psi)]
    assert _told_as_factors(motion, (3,), 0) == ((1, 1, 1),)
    assert _told_as_factors(motion, (2,), 0) == ()  # x², x u and u² tell more
    motion = [(np.hstack([x, rng.choice([-1.0, 1.0], (2000, 1))]), psi)]
    for n_loads in (0, 2):  # about a mean at each phase, which chance gives to u, u² moves
        assert _told_as_factors(motion, (2, 3), n_loads) == ((1, 1), (0, 1, 1), (1, 1, 1))
    products = _Products.of(motion, (2, 3), 0, left_out=((1, 1), (0, 1, 1), (1, 1, 1)))
    assert products.which == [(0, 0), (0, 1), (0, 0, 0), (0, 0, 1)]


def test_motions_between_two_values_have_no_products_of_their_own():
    """x and u of a delay are −1 or 1, by turns: x², x u and u² are constant."""
    coefficients = np.array([[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]])
    delay = PeriodicInnovations(coefficients, np.zeros((1, 1, 1)), np.eye(1), STEP, 0.0)
    u, layout = np.resize([1.0, -1.0], (400, 1)), Layout(1, 1, 2, 0, 0, 0, feedthrough=False)
    some = [(u, -u, STEP * np.arange(400))]
    for degrees in (None, (2,)):
        assert LargeMotions.of(delay, some, layout, 1e-3, np.inf, degrees) is None
    base = LargeMotions.without(delay, some, layout, 1e-3, np.inf)
    assert base.of_other_degrees(REST)[1] is None


@pytest.mark.parametrize(
    ("bend", "least", "most"),
    [(0.0, 0.2, 1.0), pytest.param(0.1, 0.9, 1.4, marks=pytest.mark.slow), (0.2, 0.9, 1.4)],
)
def test_an_orbit_is_off_by_what_squares_of_the_motion_shift_it(bend, least, most):
    """Outputs of this machine at rest are zero; a linear model of its large motions has others."""
    ratios = []
    for seed in range(6):
        some = [bent(seen(), 2, bend, 1500, seed)]
        linear, _ = most_likely(seen(), some, SEEN, 1e-3)
        base = LargeMotions.without(linear, some, SEEN, 1e-3, np.inf)
        ratios.append(np.abs(linear.forced_response(0)[0]) / base.of_other_degrees(REST)[2])
    assert least < np.sqrt(np.mean(np.square(ratios))) < most


@pytest.mark.parametrize("seed", [0, 1, 13, 19])
def test_products_that_were_not_taken_up_show_a_machine_that_is_not_linear(seed):
    """One step beside them leads to the exponents of small motions, before any is taken."""
    true = seen()
    for bend, degree in ((0.0, 3), (-0.1, 3), (0.2, 2)):
        some = [bent(true, degree, bend, 1500, seed)]
        linear, _ = most_likely(true, some, SEEN, 1e-3)
        base = LargeMotions.without(linear, some, SEEN, 1e-3, np.inf)
        degrees, beside, _ = base.of_other_degrees(REST)
        assert degrees == (2, 3)
        assert (beside.beyond > 4.0) == (bend != 0.0)
        known, deviations = beside.ahead
        assert np.all(np.abs(np.sort_complex(known) - multipliers(true)) < 5.0 * deviations)
    large = LargeMotions.of(linear, some, SEEN, 1e-3, np.inf)
    degrees, beside, _ = large.of_other_degrees(REST)
    assert (large.products.degrees, degrees) == ((2,), (3,))
    assert beside.beyond < 4.0  # squares have taken up all


def test_nothing_is_said_of_products_that_are_not_to_be_had(monkeypatch):
    true = seen()
    some = [bent(true, 3, -0.1, 1500, 1)]
    linear, _ = most_likely(true, some, SEEN, 1e-3)
    base = LargeMotions.without(linear, some, SEEN, 1e-3, np.inf)
    asked = LargeMotions.of(linear, some, SEEN, 1e-3, np.inf, degrees=(2, 3))
    assert asked.of_other_degrees(REST) == ((), None, None)  # it has all
    monkeypatch.setattr(small_motions, "MOST_NUMBERS", 1e3)
    assert base.of_other_degrees(REST) == ((), None, None)  # too many numbers


def test_products_do_not_pay_for_a_linear_machine():
    true = seen()
    for seed in range(5):
        some = [bent(true, 2, 0.0, 1000, seed)]
        linear, _ = most_likely(true, some, SEEN, 1e-3)
        assert LargeMotions.of(linear, some, SEEN, 1e-3, np.inf) is None
    asked = LargeMotions.of(linear, some, SEEN, 1e-3, np.inf, degrees=(2,))
    assert asked.products.degrees == (2,)
    assert asked.small_motions(REST).of_smaller is None
