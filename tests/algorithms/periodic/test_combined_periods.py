"""Few combinations of periods hold what all samples say of G and Q."""

import numpy as np
import pytest

from sklearn_hd.algorithms.likelihood.predictor import Record, simulate
from sklearn_hd.algorithms.periodic.combined_periods import NestedLeastSquares, combined_periods
from sklearn_hd.algorithms.periodic.periodic_structure import (
    PeriodicStructure,
    SampledResponse,
    sampled_response,
)

PHASES, OMEGA = 6, 2.0
N, M, L = 2, 2, 3


@pytest.fixture
def structure(rng):
    """Known F and P of one harmonic; each entry of G and Q is a parameter."""
    constant = np.zeros((3, N + L, N + M))
    constant[0, :N, :N] = [[0.0, 1.0], [-2.0, -0.4]]
    constant[1, 1, 0] = 0.5
    constant[:, N:, :N] = rng.standard_normal((3, L, N))
    constant[2, :, N:] = rng.standard_normal((N + L, M))  # inputs enter without parameters, too
    places = np.argwhere(np.ones((3, N + L, M)))
    basis = np.zeros((len(places), *constant.shape))
    for k, (harmonic, row, column) in enumerate(places):
        basis[k, harmonic, row, N + column] = 1.0
    return PeriodicStructure(constant, basis, N, tuple(map(str, range(len(places)))))


def at_all_phases(response):
    return SampledResponse(
        *(
            np.broadcast_to(M, (*M.shape[:-3], PHASES, *M.shape[-2:]))
            for M in (response.Psi, response.Out, response.dPsi, response.dOut)
        )
    )


def outputs(structure, theta, u, first_phase, x0):
    response = sampled_response(structure, theta, OMEGA, PHASES, sensitivities=False)
    record = Record(u, np.zeros((len(u), L)), first_phase)
    return simulate(response, record, x0)[1]


def inputs(rng, n_samples, n_levels):
    """Steps at a period's start and in mid-period: few directions."""
    levels = rng.standard_normal((n_levels, M))
    u = np.zeros((n_samples, M))
    for k, level in enumerate(levels):
        u[2 + 9 * k :] = level
    return u


@pytest.mark.parametrize(
    ("n_samples", "first_phase"), [(20 * PHASES, 0), (20 * PHASES + 4, 5), (PHASES - 1, 2)]
)
def test_least_squares_are_those_of_all_samples(rng, structure, n_samples, first_phase):
    u = inputs(rng, n_samples, 3)
    y = rng.standard_normal((n_samples, L))
    k = structure.n_parameters
    rest = outputs(structure, np.zeros(k), u, first_phase, np.zeros(N))
    still = np.zeros_like(u)
    every = [outputs(structure, np.zeros(k), still, first_phase, x0) for x0 in np.eye(N)]
    every += [outputs(structure, unit, u, first_phase, np.zeros(N)) - rest for unit in np.eye(k)]
    X = np.stack([column.ravel() for column in every], axis=1)
    response = at_all_phases(sampled_response(structure, np.zeros(k), OMEGA, PHASES))
    turned = np.roll(response.Psi, -first_phase, axis=0)
    Phi = SampledResponse(turned, response.Out).monodromy
    periods, combinations, off = combined_periods(Phi, u, y, PHASES, first_phase)
    added = response.dPsi[..., N:], response.dOut[..., N:]
    forced, target, free = periods.columns(response, *added, np.ones(L))
    few = np.hstack([free, forced])
    size = np.abs(X).max()
    np.testing.assert_allclose(few.T @ few, X.T @ X, atol=1e-12 * size**2 * len(X))
    wanted = (y - rest).ravel()
    np.testing.assert_allclose(few.T @ target, X.T @ wanted, atol=1e-12 * size * len(X))
    np.testing.assert_allclose(np.sum(target**2) + np.sum(off**2), wanted @ wanted, rtol=1e-12)
    unfolded = off + np.tensordot(combinations, periods.unfolded(target), (1, 2))
    np.testing.assert_allclose(unfolded.reshape(-1, L)[:n_samples].ravel(), wanted, atol=1e-12)


def test_few_changes_of_the_inputs_take_few_combinations(rng, structure):
    u = inputs(rng, 200 * PHASES, 3)
    response = at_all_phases(sampled_response(structure, np.zeros(30), OMEGA, PHASES))
    y = rng.standard_normal((len(u), L))
    periods, combinations, _ = combined_periods(response.monodromy, u, y, PHASES, 0)
    r = len(periods.directions)
    assert r <= 6
    assert combinations.shape[1] <= r + N * (r + 1)


def test_parameters_come_back_from_them(rng, structure):
    theta, x0 = rng.standard_normal(structure.n_parameters), rng.standard_normal(N)
    u = rng.standard_normal((15 * PHASES + 1, M))
    y = outputs(structure, theta, u, 3, x0)
    response = at_all_phases(sampled_response(structure, 0.0 * theta, OMEGA, PHASES))
    Phi = SampledResponse(np.roll(response.Psi, -3, axis=0), response.Out).monodromy
    periods, _, off = combined_periods(Phi, u, y, PHASES, 3)
    added = response.dPsi[..., N:], response.dOut[..., N:]
    forced, target, free = periods.columns(response, *added, np.array([1.0, 10.0, 0.1]))
    fit = NestedLeastSquares(target)
    fit.extend(np.hstack([free, forced]))
    solution, left, _ = fit.solve()
    assert not len(fit.undetermined)
    np.testing.assert_allclose(solution, np.append(x0, theta), rtol=1e-9)
    assert np.abs(left).max() <= 1e-10 * np.abs(target).max()
    assert np.abs(off).max() <= 1e-12 * np.abs(y).max()


def test_inputs_at_rest_leave_the_initial_state(rng, structure):
    x0 = rng.standard_normal(N)
    u = np.zeros((8 * PHASES, M))
    y = outputs(structure, np.zeros(structure.n_parameters), u, 0, x0)
    response = at_all_phases(
        sampled_response(structure, np.zeros(structure.n_parameters), OMEGA, PHASES)
    )
    periods, combinations, _ = combined_periods(response.monodromy, u, y, PHASES, 0)
    assert len(periods.directions) == 0
    assert combinations.shape == (8, N)
    added = response.dPsi[..., N:], response.dOut[..., N:]
    forced, target, free = periods.columns(response, *added, np.ones(L))
    assert not forced.any()
    np.testing.assert_allclose(np.linalg.lstsq(free, target)[0], x0, rtol=1e-10)
