"""Coordinates of the states that are left without a mode."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import ortho_group, special_ortho_group

from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import (
    PeriodicInnovations,
    _logarithm,
    coordinates_without_modes,
    without_modes,
)
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics

STEP = 2 * np.pi / 16
PSI = 2 * np.pi * np.arange(64) / 64


def axes(psi, n_turns=1):
    """Three axes, of which the first two turn."""
    c, s, zero, one = np.cos(n_turns * psi), np.sin(n_turns * psi), 0 * psi, 1 + 0 * psi
    rows = [np.stack(row, axis=-1) for row in ((c, -s, zero), (s, c, zero), (zero, zero, one))]
    return np.stack(rows, axis=-2)


def turning(transition, n_turns=1):
    """A model whose states are constant ones, seen in turning axes."""
    A = axes(PSI + STEP, n_turns) @ transition @ axes(PSI, n_turns).swapaxes(1, 2)
    coefficients = np.zeros((4 * n_turns + 1, 4, 5))
    coefficients[:, :3, :3] = sampled_harmonics(A, 2 * n_turns)
    coefficients[0, 3, :3] = 1.0
    return PeriodicInnovations(coefficients, np.zeros((1, 3, 1)), np.eye(1), STEP, start=0.3)


@pytest.mark.parametrize("n_turns", [1, 2])
def test_the_states_of_the_other_modes_are_kept(n_turns):
    model = turning(np.diag([0.95, 0.5, 0.8]), n_turns)
    kept = [[0, 1], [0, 2], [1, 2]]
    found = list(coordinates_without_modes(model, n_turns))
    assert len(found) == 3
    for V in found:
        V = evaluate_harmonics(V, PSI)
        np.testing.assert_allclose(V.swapaxes(1, 2) @ V, np.tile(np.eye(2), (64, 1, 1)), atol=1e-9)
        own = [np.linalg.svd(axes(PSI, n_turns)[..., k].swapaxes(1, 2) @ V)[1].min() for k in kept]
        kept.pop(int(np.argmax(own)))  # each pair is that of one of them
        assert max(own) > 1.0 - 1e-9
    assert not kept


def test_a_pair_is_left_out_as_one():
    model = turning(np.array([[0.9, 0.0, 0.0], [0.0, 0.5, 0.2], [0.0, -0.2, 0.5]]))
    sizes = [V.shape for V in coordinates_without_modes(model, 1)]
    assert sorted(sizes) == [(3, 3, 1), (3, 3, 2)]


def test_a_mode_of_a_negative_multiplier_has_no_coordinates_of_its_own():
    """It comes back as its mirror image; so do the modes beside it."""
    half = axes(PSI + STEP, 0.5) @ np.diag([0.95, 0.5, 0.8]) @ axes(PSI, 0.5).swapaxes(1, 2)
    coefficients = np.zeros((31, 4, 5))
    coefficients[:, :3, :3] = sampled_harmonics(half, 15)
    model = PeriodicInnovations(coefficients, np.zeros((1, 3, 1)), np.eye(1), STEP)
    assert np.sum(model.multipliers().real < 0.0) == 2
    (left,) = coordinates_without_modes(model, 1)
    np.testing.assert_allclose(left[0] @ left[0].T, np.diag([1.0, 1.0, 0.0]), atol=1e-9)
    np.testing.assert_allclose(left[1:], 0.0, atol=1e-9)


def test_truncation_leaves_the_other_modes_and_what_inputs_do_to_them():
    """Inputs and innovations move two of three modes; without the third nothing changes."""
    model = turning(np.array([[0.95, 0.1, 0.2], [0.0, 0.5, 0.3], [0.0, 0.0, 0.8]]))
    moved = axes(PSI + STEP) @ np.array([[0.7, 0.1], [0.3, -0.2], [0.0, 0.0]])
    coefficients = model.coefficients.copy()
    coefficients[:, :3, 3:4] = sampled_harmonics(moved[..., :1], 2)
    coefficients[0, 3] = [1.0, -0.5, 0.4, 0.2, 0.0]
    gain = sampled_harmonics(moved[..., 1:], 2)
    model = replace(model, coefficients=coefficients, gain=gain)
    found, size = list(without_modes(model, 4)), np.array([0.5, 0.8, 0.95]) ** 16
    own = [np.sort(each.multipliers().real) for each in found]
    for k in range(3):
        assert sum(np.allclose(each, np.delete(size, k), rtol=1e-9) for each in own) == 1
    (few,) = (f for f, each in zip(found, own, strict=True) if np.allclose(each, size[[0, 2]]))
    rng, psi = np.random.default_rng(0), 0.1 + STEP * np.arange(40)
    u, y = rng.standard_normal((2, 40, 1))
    for answer in ("simulated", "innovations"):
        signals = (u,) if answer == "simulated" else (u, y)
        ours, wanted = (
            getattr(each.rows(psi), answer)(*signals, np.zeros(each.n_states))
            for each in (few, model)
        )
        ours, wanted = (np.asarray(z[-1] if len(signals) > 1 else z) for z in (ours, wanted))
        np.testing.assert_allclose(ours, wanted, atol=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_a_mode_that_a_turn_forgets_beyond_rounding_does_no_harm(size):
    """Carried on, its direction turns to those that last; the model without it may be none."""
    model = turning(np.array([[0.95, 0.1, 0.2], [0.0, size, 0.3], [0.0, 0.0, 0.8]]))
    found = list(without_modes(model, 4))
    assert len(found) >= 1
    for each in found:
        assert np.isfinite(each.coefficients).all()
        assert np.isfinite(each.gain).all()


@pytest.mark.parametrize("n", [2, 3, 6])
def test_the_exponential_of_the_logarithm_is_the_rotation(n):
    for rotation in [special_ortho_group.rvs(n, random_state=k) for k in range(5)]:
        skew = _logarithm(rotation)
        np.testing.assert_allclose(skew, -skew.T, atol=1e-12)
        np.testing.assert_allclose(expm(skew), rotation, atol=1e-12)
        assert np.abs(np.linalg.eigvals(skew)).max() <= np.pi + 1e-12


def test_two_axes_that_are_reversed_are_turned_by_half_a_turn():
    V = ortho_group.rvs(4, random_state=0)
    rotation = V @ np.diag([-1.0, 1.0, -1.0, 1.0]) @ V.T
    np.testing.assert_allclose(expm(_logarithm(rotation)), rotation, atol=1e-12)
