"""Multipliers from free decays: exact where linear, unbiased by what is of second order."""

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest
from scipy import linalg
from scipy.signal import lfilter

from sklearn_hd.algorithms.modes.free_decay import (
    free_decay,
    offsets,
    periods_at_rest,
    smooth_parts,
    without_products,
)

PHASES = 16


def pulses(*moving, n_periods=20, noise=0.0, seed=0):
    """Inputs of one segment that move within some periods."""
    u = noise * np.random.default_rng(seed).standard_normal((n_periods, PHASES, 1))
    u[list(moving), 3:9] += 1.0
    return u


def decays_of(multipliers, n_periods=30, noise=0.0, curved=0.0, seed=0, n_decays=1):
    """Lifted outputs of free decays, with products of two modes in them."""
    rng = np.random.default_rng(seed)
    z = np.asarray(multipliers, complex)
    one_of = np.flatnonzero(z.imag >= 0.0)
    shapes = rng.standard_normal((len(one_of), PHASES)) + 1j * rng.standard_normal(
        (len(one_of), PHASES)
    )
    second = rng.standard_normal((len(one_of), PHASES))
    found = []
    for _ in range(n_decays):
        start = 1.0 + rng.random(len(one_of))
        powers = start * z[one_of] ** np.arange(n_periods)[:, None]
        y = (powers @ shapes).real + curved * (np.abs(powers) ** 2) @ second
        found.append(y + noise * y.std() * rng.standard_normal(y.shape))
    return found


def nearest(found, multipliers):
    return np.abs(found.multipliers[:, None] - np.asarray(multipliers)).min(axis=0)


# ---- periods at rest -----------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-3, 1e-2])
def test_decays_begin_with_the_period_after_the_last_motion(noise):
    assert periods_at_rest([pulses(4, 5, noise=noise)]) == [(0, slice(6, 20))]


def test_each_rest_that_follows_on_motion_counts():
    found = periods_at_rest([pulses(2, 9), pulses(0), np.zeros((6, PHASES, 1))])
    assert found == [(0, slice(3, 9)), (0, slice(10, 20)), (1, slice(1, 20)), (2, slice(0, 6))]


def test_inputs_rest_at_any_level_and_in_any_unit():
    u = np.concatenate([1e9 * pulses(4) + 7e12, 1e-9 * pulses(4) - 3e-9], axis=2)
    assert periods_at_rest([u]) == [(0, slice(5, 20))]


def test_of_a_record_that_rests_for_a_third_only_the_last_decay_counts(rng):
    u = rng.standard_normal((30, PHASES, 1))
    u[[0, 1, 14, 15, *range(24, 30)]] = 0.0
    assert periods_at_rest([u]) == [(0, slice(24, 30))]
    assert periods_at_rest([u[:24]]) == []


def test_inputs_that_always_move_leave_no_decay(rng):
    assert periods_at_rest([rng.standard_normal((40, PHASES, 2))]) == []


# ---- their multipliers ---------------------------------------------------------------------------

SYSTEMS = [[0.9], [0.9, 0.3], [0.5 + 0.4j, 0.5 - 0.4j], [-0.6, -0.2, 0.7], [1.05, 0.4]]


@pytest.mark.parametrize("multipliers", SYSTEMS)
@pytest.mark.parametrize("n_decays", [1, 3])
def test_exact_decays_give_exact_multipliers(multipliers, n_decays):
    found = free_decay(decays_of(multipliers, n_decays=n_decays))
    assert len(found.multipliers) == len(multipliers)
    assert nearest(found, multipliers).max() < 1e-8
    np.testing.assert_allclose(
        np.sort_complex(linalg.eigvals(found.Phi)), np.sort_complex(found.multipliers), atol=1e-8
    )


def test_what_a_trim_is_off_by_is_no_mode():
    decays = [y + np.linspace(-1.0, 1.0, PHASES) for y in decays_of([0.8, 0.4])]
    assert nearest(free_decay(decays), [0.8, 0.4]).max() < 1e-8
    assert len(free_decay(decays).multipliers) == 2


def test_states_are_those_of_the_map():
    (y,) = decays_of([0.9, 0.3])
    found = free_decay([y])
    x = found.states[0]
    np.testing.assert_allclose(x[1:], x[:-1] @ found.Phi.T, atol=1e-8 * np.abs(x).max())


@pytest.mark.slow
def test_deviations_hold_under_noise():
    """Exponents are off by their deviation: root mean square, 60 records."""
    truth, z = np.log([0.8, 0.4]), []
    for seed in range(60):
        found = free_decay(decays_of([0.8, 0.4], noise=0.02, seed=seed), order=2)
        order = np.argsort(-found.multipliers.real)
        z.append((np.log(found.multipliers[order]).real - truth) / found.deviations[order])
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3


@pytest.mark.parametrize("lengths", [[40], [40, 3]])
@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize(("rate", "drag"), [(0.0, 0.1), (0.02, 0.2), (0.1, 0.5), (-0.004, 0.1)])
def test_slow_modes_say_what_they_change_by_until_the_motion_is_gone(rate, drag, noise, lengths):
    """A drag that goes with the motion: da/dt = −(rate + drag a) a; the record tells a trend."""
    rng = np.random.default_rng(3)
    size = [0.1]
    for _ in range(40 * 64):
        size.append(size[-1] * np.exp(-(rate + drag * size[-1]) / 64))
    turned = np.array(size[:-1:64]) * np.exp(0.7j * np.arange(40))
    shape = rng.standard_normal(PHASES) + 1j * rng.standard_normal(PHASES)
    y = np.outer(turned, shape).real
    y = [y[:n] + noise * y.std() * rng.standard_normal((n, PHASES)) for n in lengths]
    found = free_decay(y, 2)
    off = np.abs(np.log(np.abs(found.multipliers)) + rate)
    assert np.all(off > 5e-3)  # the motion is large
    assert np.all(off < 2.0 * found.deviations)
    assert np.all(found.deviations < 2.0 * off)


@pytest.mark.parametrize("slow", [0.99, 1.0])
def test_slow_modes_of_a_linear_machine_do_not_change(slow):
    pair = slow * np.exp(0.7j * np.array([1, -1]))
    assert free_decay(decays_of(pair, n_periods=40)).deviations.max() < 1e-6
    for seed in range(20):
        noisy = free_decay(decays_of(pair, n_periods=40, noise=1e-3, seed=seed), 2)
        assert noisy.deviations.max() < 1e-3


def test_decays_that_are_gone_after_a_period():
    assert free_decay([np.outer(np.arange(20) == 0, np.ones(PHASES))], 1).deviations.size == 1


def test_what_is_not_known_at_all_does_not_end_a_fit():
    """Deviations may be infinite: zero times one is no number, and errors of numpy end a fit."""
    decays = decays_of([0.8, 0.64])
    found = replace(free_decay(decays), deviations=np.full(2, np.inf))
    with np.errstate(invalid="raise"):
        assert len(without_products(found, decays).multipliers) == 2


@pytest.mark.slow
def test_the_order_under_noise():
    orders = [
        len(free_decay(decays_of([0.8, 0.4], noise=0.02, seed=s)).multipliers) for s in range(20)
    ]
    assert orders.count(2) >= 19


@pytest.mark.parametrize("noise", [0.0, 1e-5])
@pytest.mark.parametrize("multipliers", SYSTEMS[1:3])
def test_a_response_of_second_order_is_no_mode(multipliers, noise):
    """Products of two multipliers, weaker than they are, belong to the motion's square."""
    decays = decays_of(multipliers, curved=0.02, noise=noise)
    found = without_products(free_decay(decays), decays)
    assert len(found.multipliers) == len(multipliers)
    assert nearest(found, multipliers).max() < 1e-3
    assert len(found.beside) == len(np.unique(found.beside)) > 0
    x, Phi = found.states[0], found.Phi
    np.testing.assert_allclose(x[1:], x[:-1] @ Phi.T, atol=1e-2 * np.abs(x).max())


@pytest.mark.parametrize("noise", [3e-3, 1e-2])
@pytest.mark.slow
def test_one_mode_fitted_to_several_products_is_known_no_better_than_they_are_told_apart(noise):
    """It lies between their multipliers, and its scatter does not show that it is none."""
    pairs = np.array([0.9 * np.exp(2j), 0.85 * np.exp(1j)])
    true = np.log(np.concatenate([pairs, pairs.conj()]))
    between = 0
    for seed in range(10):
        decays = decays_of(np.exp(true), n_periods=48, noise=noise, curved=0.05, seed=seed)
        found = without_products(free_decay(decays), decays)
        logs = np.log(found.multipliers.astype(complex))
        wrong = np.abs(logs[:, None] - true).min(axis=1) > -0.1 * logs.real
        known = 2.0 * found.deviations < -0.1 * logs.real
        assert not np.any(wrong & known)
        assert known[~wrong].all()
        between += wrong.any()
    assert between >= 8


@pytest.mark.parametrize("noise", [0.0, 1e-6, pytest.param(1e-3, marks=pytest.mark.slow)])
def test_what_is_known_of_a_linear_machine_stays(noise):
    modes = [0.9 * np.exp(2j), 0.9 * np.exp(-2j), 0.78, 0.5]
    for seed in range(10):
        decays = decays_of(modes, n_periods=48, noise=noise, seed=seed)
        found = free_decay(decays)
        np.testing.assert_array_equal(without_products(found, decays).deviations, found.deviations)


def nonlinear_decay(multipliers, sizes, second, seed=0, n_periods=48):
    """A lifted output of pairs of modes with all products of two and three of them."""
    rng, pairs = np.random.default_rng(seed), list(zip(np.log(multipliers), sizes, strict=True))
    both = pairs + [(log.conj(), size) for log, size in pairs]
    terms = list(pairs)
    for degree in (2, 3):
        for some in combinations_with_replacement(both, degree):
            size = second ** (degree - 1) * np.prod([each for _, each in some])
            terms.append((sum(log for log, _ in some), size))
    k, y = np.arange(n_periods)[:, None], 0.0
    for log, size in terms:
        shape = rng.standard_normal(PHASES) + 1j * rng.standard_normal(PHASES)
        y = y + (size * np.exp(k * log) * shape).real
    return [y]


def drawn_pairs(rng):
    """One pair of modes that last, and a weak one, faster or not."""
    size = np.array([rng.uniform(0.4, 0.92), rng.uniform(0.1, 0.6)])
    return size * np.exp(1j * rng.uniform(0.3, 2.8, 2))


@pytest.mark.slow
def test_fits_of_more_states_take_products_out_of_the_modes():
    """A fit of the two pairs alone has both shifted by these."""
    z, ratios = [0.8 * np.exp(1.2j), 0.7 * np.exp(2.5j)], []
    for seed in range(5):
        decays = nonlinear_decay(z, [1.0, 1.0], 0.01, seed)
        found, alone = free_decay(decays), free_decay(decays, 4)
        assert len(found.multipliers) == 4
        ratios.append(nearest(found, z) / nearest(alone, z))
    assert np.exp(np.mean(np.log(ratios))) < 0.15


def test_a_mode_that_fits_of_more_states_do_not_have_is_in_doubt():
    """One real mode stands for the weak pair, and its scatter does not show it."""
    z = drawn_pairs(np.random.default_rng(14))
    decays = nonlinear_decay(z, [1.0, 0.01], 0.03, seed=14)
    found, alone = free_decay(decays), free_decay(decays, 3)
    np.testing.assert_array_equal(found.multipliers, alone.multipliers)
    real = found.multipliers.imag == 0.0
    assert real.sum() == 1
    assert nearest(found, z)[1] > 0.1
    assert (found.deviations > 2.5 * alone.deviations)[real].all()
    np.testing.assert_array_equal(found.deviations[~real], alone.deviations[~real])


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
@pytest.mark.slow
def test_fits_of_more_states_tell_nothing_where_noise_moves_a_linear_machine(noise):
    """What few modes leave is not white then, and more modes leave almost as much."""
    a, n = 0.7 ** (1.0 / PHASES), 48 * PHASES
    for seed in range(8):
        moved = noise * np.random.default_rng(seed).standard_normal(n)
        decays = [lfilter([1.0], [1.0, -a], np.append(1.0, moved[1:])).reshape(48, PHASES)]
        found, alone = free_decay(decays), free_decay(decays, 1)
        np.testing.assert_array_equal(found.multipliers, alone.multipliers)
        np.testing.assert_array_equal(found.deviations, alone.deviations)


def test_motions_beside_the_modes_are_columns_of_each_decay():
    decays = [np.zeros((9, 2)), np.zeros((12, 2))]
    z = np.array([0.5 + 0.2j, 0.5 - 0.2j, 0.4])
    first, second = offsets(decays, z)
    assert (first.shape, second.shape) == ((9, 8), (12, 8))
    k = np.arange(12)[:, None]
    own = np.hstack([np.ones((12, 1)), (z[[0, 2]] ** k).real, (z[[0]] ** k).imag])
    np.testing.assert_allclose(second, np.hstack([np.zeros((12, 4)), own]), atol=1e-15)
    few = offsets([y[:5] for y in decays], z)
    np.testing.assert_array_equal(few[0], np.eye(2)[[0] * 5])


@pytest.mark.slow
def test_a_weak_mode_beside_products_is_found_or_something_is_in_doubt():
    """Its directions are weaker than the hundredth that counts by itself."""
    right = 0
    for seed in range(10):
        z = drawn_pairs(np.random.default_rng(seed))
        decays = nonlinear_decay(z, [1.0, 1e-2], 0.01, seed)
        found = without_products(free_decay(decays), decays)
        rates = -np.log(np.abs(found.multipliers))
        known = (2.0 * found.deviations < 0.1 * rates).all()
        exact = len(rates) == 4 and nearest(found, z).max() < 0.02
        right += exact
        assert exact or not known
    assert right >= 9


def test_noise_of_a_mode_that_a_period_forgets_is_turned_to_a_real_systems():
    """A lone negative multiplier is that of no periodic system (Liouville)."""
    for seed in range(20):
        z = free_decay(decays_of([0.7, 0.01], noise=0.01, seed=seed), order=2).multipliers
        assert np.sum((z.imag == 0.0) & (z.real < 0.0)) % 2 == 0


def test_decays_too_short_to_count_tell_nothing():
    assert free_decay(decays_of([0.9, 0.3], n_periods=3)) is None
    assert free_decay([np.zeros((20, PHASES))]) is None
    assert (
        free_decay(decays_of([0.9, 0.5, 0.3 + 0.3j, 0.3 - 0.3j], n_periods=9, noise=1e-3)) is None
    )


# ---- without the columns that hold noise alone -------------------------------------------------


def smooth_decay(noise, seed=0, n_phases=32):
    """Two outputs of two modes whose shapes are slow within the period, (periods, phases, 2)."""
    rng, psi = np.random.default_rng(seed), 2 * np.pi * np.arange(n_phases) / n_phases
    shapes = np.stack([[np.cos(psi), 2 + np.sin(psi)], [1 + np.sin(2 * psi), np.cos(psi)]])
    y = np.einsum("km,mlp->kpl", np.array([0.8, 0.15]) ** np.arange(30)[:, None], shapes)
    return y + noise * rng.standard_normal(y.shape)


def test_smooth_parts_of_exact_decays_are_all_of_them():
    y = smooth_decay(0.0)
    (parts,) = smooth_parts([y])
    np.testing.assert_allclose(parts @ parts.T, y.reshape(30, -1) @ y.reshape(30, -1).T, atol=1e-9)


def test_smooth_parts_keep_the_motion_and_few_columns():
    """An orthonormal part of each period: exact decays lose what is below the noise, no more."""
    y, noise = smooth_decay(0.0), 0.02
    (parts,) = smooth_parts([y + smooth_decay(noise) - y])
    assert parts.shape[1] < 32
    lost = np.sum(y**2) - np.sum(parts**2) + parts.size * noise**2
    assert abs(lost) < 0.01 * np.sum(y**2)
    assert smooth_parts([]) == []


@pytest.mark.slow
def test_smooth_parts_tell_modes_that_all_samples_do_not():
    """The second mode is there for two periods: 10 seeds, noise of a third of its size."""
    found = {"all": 0, "smooth": 0}
    for seed in range(10):
        y = smooth_decay(0.3, seed)
        found["all"] += len(free_decay([y.reshape(30, -1)]).multipliers) == 2
        found["smooth"] += len(free_decay(smooth_parts([y])).multipliers) == 2
    assert found["smooth"] >= 9 > found["all"]


@pytest.mark.slow
def test_one_mode_for_two_says_that_it_moves():
    """Where noise hides the second, the first is off; without the first period it is elsewhere."""
    off, wide = [], []
    for seed in range(20):
        y = smooth_decay(1.0, seed)
        found = free_decay([y.reshape(30, -1)])
        if len(found.multipliers) == 1:
            off.append(np.abs(np.log(found.multipliers[0].real / 0.8)))
            wide.append(found.deviations[0])
    off, wide = np.array(off), np.array(wide)
    assert len(off) > 8
    assert np.mean(off <= 4 * wide) > 0.9
