"""Laws of samples between which inputs switch and outputs are read."""

import numpy as np
import pytest
from scipy.linalg import expm

from sklearn_hd.algorithms.likelihood.forms import Fractions, delayed_response
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure, sampled_response

RNG = np.random.default_rng(0)
COEFFICIENTS = 0.3 * RNG.standard_normal((5, 4, 4))
COEFFICIENTS[0] += np.eye(4)
EVERYTHING = PeriodicStructure(
    np.zeros((5, 4, 4)), np.eye(80).reshape(-1, 5, 4, 4), 2, tuple(map(str, range(80)))
)
THETA = COEFFICIENTS.ravel()
LATE = Fractions(np.array([0.3, 0.8]), np.array([0.45, 0.9]), np.arange(4))
NOT = Fractions(np.zeros(2), np.ones(2), np.arange(0))
CLOCKS = [(12, None), (12.3, 41)]


@pytest.mark.parametrize(("n_phases", "n_points"), CLOCKS)
def test_without_delays_it_is_the_response_of_held_inputs(n_phases, n_points):
    own = delayed_response(EVERYTHING, THETA, NOT, 2.0, n_phases, n_points=n_points)
    held = sampled_response(EVERYTHING, THETA, 2.0, n_phases, n_points=n_points)
    for name in ("Psi", "Out", "dPsi", "dOut"):
        np.testing.assert_allclose(getattr(own, name)[..., :4], getattr(held, name), atol=1e-14)
        assert not getattr(own, name)[..., 4:].any()


def test_time_invariant_systems_have_closed_forms():
    A, B, C = np.array([[-1.0, 2.0], [-2.0, -0.5]]), np.array([[1.0], [0.3]]), np.eye(2)
    whole = np.block([[A, B], [C, np.zeros((2, 1))]])
    fixed = PeriodicStructure(whole[None], np.zeros((0, 1, 4, 3))[:, :, :, :], 2, ())
    dt, f, g = 0.4, 0.35, 0.6
    late = Fractions(np.array([f]), np.array([1.0 - g, 1.0]), np.arange(0))
    found = delayed_response(fixed, [], late, 2 * np.pi / dt, 1, sensitivities=False)

    def moved(share):
        return expm(A * share * dt), np.linalg.solve(A, (expm(A * share * dt) - np.eye(2)) @ B)

    new, before, read = moved(1.0 - f), moved(f), moved(g - f)
    np.testing.assert_allclose(found.Psi[0, :, :2], moved(1.0)[0], rtol=1e-13)
    np.testing.assert_allclose(found.Psi[0, :, [2]].T, new[1], rtol=1e-13)
    np.testing.assert_allclose(found.Psi[0, :, [3]].T, new[0] @ before[1], rtol=1e-13)
    np.testing.assert_allclose(found.Out[0, 0, :2], moved(g)[0][0], rtol=1e-13)
    np.testing.assert_allclose(found.Out[0, 0, 2], read[1][0, 0], rtol=1e-13)
    np.testing.assert_allclose(found.Out[0, 0, 3], (read[0] @ before[1])[0, 0], rtol=1e-13)
    np.testing.assert_allclose(found.Out[0, 1], [0.0, 1.0, 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize(("n_phases", "n_points"), CLOCKS)
@pytest.mark.parametrize("measured", [False, True])
def test_derivatives_are_those_of_differences(n_phases, n_points, measured):
    observe, clock = None, (2.0, n_phases)
    if measured:
        psi = 2 * np.pi * np.arange(n_points or n_phases) / (n_points or n_phases)
        observe = np.stack([np.ones_like(psi), np.cos(psi), np.sin(psi), 0.5 + 0 * psi], -1)
        observe = observe.reshape(-1, 2, 2)
    options = {"n_points": n_points, "observe": observe}
    found = delayed_response(EVERYTHING, THETA, LATE, *clock, **options)
    options["sensitivities"] = False
    for k in [0, 3, 17, 42, 63, 79]:
        step = 1e-6 * (np.arange(80) == k)
        up, down = (
            delayed_response(EVERYTHING, THETA + s * step, LATE, *clock, **options) for s in (1, -1)
        )
        np.testing.assert_allclose((up.Psi - down.Psi) / 2e-6, found.dPsi[k], atol=1e-8)
        np.testing.assert_allclose((up.Out - down.Out) / 2e-6, found.dOut[k], atol=1e-8)
    for k in range(4):
        step = 1e-6 * (np.arange(4) == k)
        up, down = (
            delayed_response(EVERYTHING, THETA, LATE.at(LATE.start + s * step), *clock, **options)
            for s in (1, -1)
        )
        np.testing.assert_allclose((up.Psi - down.Psi) / 2e-6, found.dPsi[80 + k], atol=1e-8)
        np.testing.assert_allclose((up.Out - down.Out) / 2e-6, found.dOut[80 + k], atol=1e-8)


def test_a_whole_sample_later_the_new_input_is_the_old_one():
    late = [Fractions(np.array([f, 0.4]), np.array([0.7, 1.0]), np.arange(0)) for f in (0.0, 1.0)]
    none, whole = (
        delayed_response(EVERYTHING, THETA, each, 2.0, 12, sensitivities=False) for each in late
    )
    np.testing.assert_allclose(whole.Psi[..., 4], none.Psi[..., 2], atol=1e-14)
    np.testing.assert_allclose(whole.Psi[..., 2], none.Psi[..., 4], atol=1e-14)
