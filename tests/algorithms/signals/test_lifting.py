"""Laws of lifted signals and of the directions that inputs take."""

import numpy as np
import pytest

from sklearn_hd.algorithms.signals.fourier import input_directions, lift


@pytest.mark.parametrize("shift", range(5))
@pytest.mark.parametrize("n_samples", [0, 3, 4, 13, 20])
def test_lifted_rows_are_the_whole_periods(shift, n_samples, rng):
    values = rng.standard_normal((n_samples, 3))
    phase = (np.arange(n_samples) + shift) % 5
    lifted = lift(values, phase, 5)
    first = -shift % 5
    n_periods = max(0, n_samples - first) // 5
    assert lifted.shape == (n_periods, 5, 3)
    np.testing.assert_array_equal(
        lifted.reshape(-1, 3), values[first : first + 5 * n_periods].reshape(-1, 3)
    )


def step(n_periods, at, samples=8):
    return lift(
        (np.arange(n_periods * samples) >= at).astype(float)[:, None],
        np.arange(n_periods * samples) % samples,
        samples,
    )


@pytest.mark.parametrize(("edges", "count"), [((8,), 1), ((13,), 2), ((13, 34), 3), ((8, 32), 1)])
def test_each_phase_at_which_a_step_falls_is_a_direction(edges, count):
    lifted = sum(step(12, edge) for edge in edges)
    directions, n_all, left_out = input_directions([lifted])
    assert directions[0].shape == (12, count)
    assert n_all == count
    assert left_out < 1e-20


def test_directions_span_the_inputs_and_are_uncorrelated(rng):
    lifted = [rng.standard_normal((n, 6, 2)) @ np.diag([1.0, 1e6]) for n in (20, 11)]
    directions, n_all, _ = input_directions(lifted)
    W = np.vstack(directions)
    u = np.vstack([block.reshape(len(block), -1) for block in lifted])
    assert [len(block) for block in directions] == [20, 11]
    assert n_all == 12
    np.testing.assert_allclose(W.T @ W / len(W), np.eye(12), atol=1e-12)
    np.testing.assert_allclose(W @ (W.T @ u) / len(W), u, atol=1e-6)
    weaker = u[:, ::2]
    np.testing.assert_allclose(W @ (W.T @ weaker) / len(W), weaker, atol=1e-12)


def test_what_is_left_out_is_the_energy_of_the_weakest(rng):
    lifted = rng.standard_normal((30, 6, 1))
    directions, n_all, left_out = input_directions([lifted], 2)
    u = lifted.reshape(30, -1)
    rest = u - directions[0] @ (directions[0].T @ u) / 30
    assert (directions[0].shape[1], n_all) == (2, 6)
    assert left_out == pytest.approx(np.sum(rest**2) / np.sum(u**2), rel=1e-12)


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_units_do_not_matter(scale, rng):
    lifted = step(12, 13) + 0.5 * step(12, 50)
    one, n_one, _ = input_directions([lifted])
    other, n_other, _ = input_directions([scale * lifted])
    assert n_one == n_other
    np.testing.assert_allclose(np.abs(other[0]), np.abs(one[0]), atol=1e-10)


def test_noise_on_inputs_is_no_direction(rng):
    """A doublet at 1/20 of noise is one direction; changes at every sample are as many."""
    doublet = step(60, 40 * 8) - 2 * step(60, 45 * 8) + step(60, 50 * 8)
    noisy = doublet + 0.05 * doublet.std() * rng.standard_normal(doublet.shape)
    assert input_directions([noisy])[1] == 1
    assert input_directions([rng.standard_normal((60, 8, 1))])[1] == 8


def test_inputs_at_rest_have_no_direction():
    directions, n_all, left_out = input_directions([np.zeros((3, 4, 1)), np.zeros((2, 4, 1))])
    assert [block.shape for block in directions] == [(3, 0), (2, 0)]
    assert (n_all, left_out) == (0, 0.0)
