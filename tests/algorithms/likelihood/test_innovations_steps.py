"""Steps of a periodic innovations model to the largest likelihood."""

from dataclasses import replace

import numpy as np
import pytest
from innovation_cases import N_INPUTS, N_OUTPUTS, N_STATES, drawn, multipliers, record

from sklearn_hd.algorithms.likelihood import innovations_steps
from sklearn_hd.algorithms.likelihood.innovations_steps import (
    _Form,
    _System,
    _telling,
    fitted,
    most_likely,
)
from sklearn_hd.algorithms.periodic.periodic_predictor import Layout

LAYOUT = Layout(N_INPUTS, N_OUTPUTS, 2, 1, 1, 2, feedthrough=True)


def moved(model, size=0.02, seed=5):
    """Another model near to one."""
    rng, own = np.random.default_rng(seed), model.coefficients
    noise = size * rng.standard_normal(own.shape)
    return replace(model, coefficients=own + np.where(own != 0.0, noise, 0.0))


def segments(model, n_rows=400, n_segments=2, **options):
    """Records of a model."""
    return [record(model, n_rows, seed, **options)[:3] for seed in range(1, 1 + n_segments)]


def cost(model, some, sensor_noise=1e-6):
    """−log L by its definition, initial states of least squares."""
    left, size = [], np.diag(np.mean(np.vstack([y for _, y, _ in some]) ** 2, axis=0))
    for u, y, psi in some:
        rows = model.rows(psi)
        left.append(rows.innovations(u, y, rows.initial_state(u, y, size))[1])
    left = np.vstack(left)
    covariance = left.T @ left / len(left) + sensor_noise**2 * np.eye(N_OUTPUTS)
    return 0.5 * len(left) * np.linalg.slogdet(covariance)[1]


def test_from_nearby_the_truth_is_found_again():
    """Without innovations a model is exact: what it leaves falls to the least noise."""
    true = drawn()
    some = segments(true, noise=1e-6)
    start = moved(true)
    found, _ = most_likely(start, some, LAYOUT, 1e-6)
    assert np.max(np.abs(multipliers(start) - multipliers(true))) > 1e-2
    np.testing.assert_allclose(multipliers(found), multipliers(true), atol=1e-4)


def test_no_step_makes_a_record_less_likely():
    true = drawn()
    some = segments(true)
    for size in (0.01, 0.1, 0.3):
        start = moved(true, size)
        found, _ = most_likely(start, some, LAYOUT, 1e-3)
        assert cost(found, some, 1e-3) <= cost(start, some, 1e-3)
    assert cost(found, some, 1e-3) < cost(start, some, 1e-3) - 10.0


def test_at_the_end_another_step_leads_nowhere():
    true = drawn()
    found, (ahead, deviations) = most_likely(moved(true), segments(true), LAYOUT, 1e-3)
    assert np.all(np.abs(np.sort_complex(ahead) - multipliers(found)) < deviations.min())


@pytest.mark.slow
def test_deviations_are_those_of_many_records():
    true = drawn()
    all_found, told = [], []
    for seed in range(24):
        some = [record(true, 500, 100 + seed)[:3]]
        found, (_, deviations) = most_likely(true, some, LAYOUT, 1e-3)
        own = found.multiplier_logarithms()
        nearest = np.abs(true.multiplier_logarithms()[:, None] - own).argmin(axis=1)
        all_found.append(own[nearest][0])  # the slowest, which is real
        told.append(deviations[np.abs(own - own[nearest][0]).argmin()])
    assert 0.7 < np.std(all_found) / np.median(told) < 1.4


def test_harmonics_that_are_not_asked_for_stay_zero():
    true = drawn()
    own = true.coefficients.copy()
    own[1:, :, N_STATES : N_STATES + N_INPUTS] = 0.0  # inputs act alike at all azimuths
    own[:, N_STATES:, N_STATES : N_STATES + N_INPUTS] = 0.0
    true = replace(true, coefficients=own)
    layout = replace(LAYOUT, n_input_harmonics=0, feedthrough=False)
    found, _ = most_likely(moved(true), segments(true), layout, 1e-3)
    B, D = found.matrices()[1], found.matrices()[3]
    assert np.all(B[1:] == 0.0)
    assert np.all(D == 0.0)
    assert not np.allclose(B[0], moved(true).matrices()[1][0], atol=1e-6)


def test_no_step_leads_beyond_the_growth_allowed():
    """A machine that grows, and a start that does not: it stays within."""
    true = drawn(size=0.95)
    start = replace(true, coefficients=true.coefficients.copy())
    start.coefficients[0, 0, 0] -= 0.3
    some = segments(true, 300, noise=0.1)
    limit = 0.5 * (start.growth() + true.growth())
    found, _ = most_likely(start, some, LAYOUT, 1e-3, limit)
    assert found.growth() < limit < true.growth()
    free, _ = most_likely(start, some, LAYOUT, 1e-3)
    assert free.growth() > limit


@pytest.mark.parametrize("moving", [2000, 300])
def test_some_rows_of_a_long_record_tell_its_second_derivatives(monkeypatch, moving):
    """A fifth of them, of inputs that always move, and of those that rest after 300 rows: the same
    model as by all rows, of which the slowest mode is known as well."""
    true, inputs = drawn(), (np.arange(2000) < moving)[:, None]
    some = segments(true, 2000, noise=0.1, inputs=inputs)
    start, asked, pieces = moved(true), [], innovations_steps.sensitivity_pieces
    all_rows, by_all = most_likely(start, some, LAYOUT, 1e-3)

    def counting(rows, *args):
        asked.append(len(rows.states))
        return pieces(rows, *args)

    monkeypatch.setattr(innovations_steps, "sensitivity_pieces", counting)
    n_free = len(_Form.of(true, LAYOUT).places)
    monkeypatch.setattr(innovations_steps, "MOST_NUMBERS", 800 * N_OUTPUTS * n_free)
    found, by_some = most_likely(start, some, LAYOUT, 1e-3)
    assert set(asked) <= {800, *range(1, 800)}
    slowest = max(multipliers(all_rows), key=lambda each: each.real)
    (_, known), (_, told) = (
        min(zip(*by, strict=True), key=lambda each: abs(each[0] - slowest))
        for by in (by_all, by_some)
    )
    assert np.min(np.abs(multipliers(found) - slowest)) < 0.3 * known
    assert told == pytest.approx(known, rel=0.3)
    falls = [cost(start, some, 1e-3) - cost(each, some, 1e-3) for each in (found, all_rows)]
    assert falls[0] > 0.99 * falls[1] > 100.0


def test_the_stretch_told_is_that_in_which_outputs_move_most(rng):
    y = 0.1 * rng.standard_normal((3, 100, 2))
    y[1, 80:] += 1.0
    y[2, :10] -= 1.0
    some = [(None, each, None) for each in y]
    all_rows = [slice(None)] * 3
    told = [(each.start, each.stop) for each in _telling(some, all_rows, 30)]
    assert told[0][1] - told[0][0] == 0
    assert told[1:] == [(80, 100), (0, 10)]
    assert [(each.start, each.stop) for each in _telling(some, all_rows, 999)] == [(0, 100)] * 3
    first = [slice(None), slice(0), slice(0)]  # of which alone rows count
    assert [each.stop - each.start for each in _telling(some, first, 30)] == [30, 0, 0]


@pytest.mark.parametrize("why", ["short", "overflowing"])
def test_steps_are_not_taken_where_they_lead_nowhere(why):
    true = drawn()
    some = segments(true, 300)
    if why == "short":  # fewer than five values for each coefficient
        assert most_likely(true, some, LAYOUT, 1e-3) is not None
        assert most_likely(true, segments(true, 50), LAYOUT, 1e-3) is None
    else:
        wild = replace(true, gain=1e3 * true.gain)  # its predictor forgets nothing
        assert most_likely(wild, some, LAYOUT, 1e-3) is None


def test_a_step_so_far_that_rounding_hides_the_least_noise_costs_more():
    """All outputs are the same multiple of one input: their covariance has rank one."""
    true = drawn()
    some, whole = segments(true, 300), true.coefficients.copy()
    best = fitted(true, some, 1e-3).cost
    for size in 10.0 ** np.append(np.arange(5.0, 40.0), 200.0):
        whole[0, N_STATES:, N_STATES] = size
        far = fitted(replace(true, coefficients=whole), some, 1e-3)
        assert far is None or far.cost > best
    assert far is None  # its squares overflow


@pytest.mark.parametrize("moved", [0.0, 3.0])
def test_slopes_of_noise_are_told_whatever_the_others_are(moved):
    """Normal deviations of mean 0 and size 1, also where others are not the most likely ones."""
    rng, some, found = np.random.default_rng(0), np.arange(12) < 5, []
    root = rng.standard_normal((12, 12))
    gram = root @ root.T
    for _ in range(400):
        slope = root @ rng.standard_normal(12) + gram @ np.where(some, 0.0, moved)
        found.append(_System.of(np.tril(gram), slope).beyond_noise(some))
    np.testing.assert_allclose([np.mean(found), np.std(found)], [0.0, 1.0], atol=0.15)
    slope = gram @ np.where(some, 8.0, 0.0)  # an effect
    assert _System.of(np.tril(gram), slope).beyond_noise(some) > 4.0


def test_slopes_of_what_others_tell_say_nothing():
    gram = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-13]])
    assert _System.of(gram, np.array([0.1, 0.1])).beyond_noise(np.array([False, True])) == -np.inf
