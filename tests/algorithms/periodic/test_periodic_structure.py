"""Laws of sampled periodic systems and of their sensitivities."""

import numpy as np
import pytest
from scipy import linalg, sparse

from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.algorithms.periodic.floquet import transition_matrices
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_structure import (
    PeriodicStructure,
    functions_of_turn,
    held_pushes,
    radius_of,
    sampled_response,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

OMEGA = 3.0


def free_structure(rng, n, m, n_outputs, K, *, outputs=0):
    """Every coefficient of F and G free, and those of [P Q] up to harmonic ``outputs``."""
    shape = (2 * K + 1, n + n_outputs, n + m)
    constant = rng.standard_normal(shape) / (1 + np.arange(2 * K + 1))[:, None, None]
    constant[2 * outputs + 1 :, n:] = 0.0
    free = np.ones(shape, dtype=bool)
    free[2 * outputs + 1 :, n:] = False
    moved = np.flatnonzero(free)
    k = len(moved)
    basis = sparse.csr_array((np.ones(k), (np.arange(k), moved)), shape=(k, constant.size))
    return PeriodicStructure(constant, basis, n, tuple(f"t{i}" for i in range(k)))


def central_differences(structure, theta, function, step=1e-6):
    moves = step * np.eye(structure.n_parameters)
    return np.array([(function(theta + d) - function(theta - d)) / (2 * step) for d in moves])


@pytest.mark.parametrize(("n", "K", "n_phases"), [(1, 0, 8), (2, 4, 64), (3, 2, 8), (4, 1, 5)])
def test_samples_are_the_transition_matrices(rng, n, K, n_phases):
    structure = free_structure(rng, n, 2, 1, K)
    theta = 0.2 * rng.standard_normal(structure.n_parameters)
    found = sampled_response(structure, theta, OMEGA, n_phases, sensitivities=False)
    F, G, P, Q = structure.matrices(theta)
    psi = 2 * np.pi * np.arange(n_phases + 1) / n_phases
    Phi, Gamma = transition_matrices(
        lambda psi: evaluate_harmonics(F, psi), lambda psi: evaluate_harmonics(G, psi), psi, OMEGA
    )
    assert len(found.Psi) == (n_phases if K else 1)
    exact = np.concatenate([Phi, Gamma], axis=2)[: len(found.Psi)]
    np.testing.assert_allclose(found.Psi, exact, rtol=0, atol=1e-13 * np.abs(exact).max())
    np.testing.assert_array_equal(found.Out, np.concatenate([P, Q], axis=2)[:1])
    assert found.dPsi is None
    assert found.dOut is None


@pytest.mark.slow
@pytest.mark.parametrize(("n", "K", "n_phases"), [(1, 0, 8), (2, 4, 64), (3, 2, 8), (2, 1, 3)])
def test_sensitivities_are_central_differences(rng, n, K, n_phases):
    structure = free_structure(rng, n, 2, 2, K, outputs=K)
    theta = 0.2 * rng.standard_normal(structure.n_parameters)
    found = sampled_response(structure, theta, OMEGA, n_phases)
    for name in ("Psi", "Out"):
        differences = central_differences(
            structure,
            theta,
            lambda t, name=name: getattr(sampled_response(structure, t, OMEGA, n_phases), name),
        )
        exact = getattr(found, f"d{name}")
        np.testing.assert_allclose(exact, differences, rtol=0, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize(("K", "n_phases"), [(0, 16), (2, 16), (2, 5)])
def test_held_pushes_are_what_harmonics_of_the_inputs_add(rng, K, n_phases):
    """Of more harmonics than F has, and of a single input as of each of two."""
    n, m, highest = 3, 2, (n_phases - 1) // 2
    constant = np.zeros((2 * highest + 1, n + 1, n + m))
    constant[: 2 * K + 1, :n, :n] = rng.standard_normal((2 * K + 1, n, n))
    basis = np.zeros((2 * highest + 1, n, m, *constant.shape))
    for place in np.ndindex(basis.shape[:3]):
        harmonic, row, column = place
        basis[(*place, harmonic, row, n + column)] = 1.0
    free = basis.reshape(-1, *constant.shape)
    structure = PeriodicStructure(constant, free, n, tuple(map(str, range(len(free)))))
    wanted = sampled_response(structure, np.zeros(len(free)), OMEGA, n_phases).dPsi
    wanted = wanted.reshape(*basis.shape[:3], n_phases, n, n + m)
    known = PeriodicStructure(constant[: 2 * K + 1], free[:0, : 2 * K + 1], n, ())
    found = held_pushes(known, [], OMEGA, n_phases, highest)
    expected = np.zeros_like(wanted)
    for column in range(m):
        expected[:, :, column, :, :, n + column] = found.transpose(0, 3, 1, 2)
    np.testing.assert_allclose(wanted, expected, atol=1e-13 * np.abs(wanted).max())


def test_sensitivities_are_integrals(rng):
    """Halving the intervals leaves their products' derivatives alone, to rounding."""
    structure = free_structure(rng, 3, 1, 1, 3)
    theta = 0.1 * rng.standard_normal(structure.n_parameters)
    whole = sampled_response(structure, theta, OMEGA, 16)
    halves = sampled_response(structure, theta, OMEGA, 32)
    first, second = halves.Phi[::2], halves.Phi[1::2]
    d = halves.dPsi[:, :, :, :3]
    joined = d[:, 1::2] @ first + second @ d[:, ::2]
    np.testing.assert_allclose(whole.dPsi[..., :3], joined, rtol=0, atol=1e-14)


def test_time_invariant_sensitivity_is_that_of_the_matrix_exponential(rng):
    n, m, n_phases = 4, 1, 16
    basis = rng.standard_normal((3, n + 2, n + m))
    affine = AffineStructure(rng.standard_normal((n + 2, n + m)), basis, n, ("a", "b", "c"))
    structure = PeriodicStructure.time_invariant(affine)
    theta = np.array([0.3, -0.2, 0.1])
    found = sampled_response(structure, theta, OMEGA, n_phases)
    dt = 2 * np.pi / OMEGA / n_phases
    A, B, C, D = affine.matrices(theta)
    stacked, direction = np.zeros((2, n + m, n + m))
    stacked[:n] = np.hstack([A, B])
    for k in range(3):
        direction[:n] = basis[k, :n]
        exact = linalg.expm_frechet(stacked * dt, direction * dt)
        np.testing.assert_allclose(found.Psi[0], exact[0][:n], rtol=0, atol=1e-13)
        np.testing.assert_allclose(found.dPsi[k, 0], exact[1][:n], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.Out[0], np.hstack([C, D]), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(found.dOut[:, 0], basis[:, n:])


def test_stiff_and_badly_scaled_states():
    """Rates of 40 time constants a sample, states in units a million apart."""
    constant = np.zeros((3, 3, 3))
    F = constant[:, :2, :2]
    F[0] = [[-150.0, 3e6], [1e-6, -2.0]]
    F[1] = [[20.0, 1e6], [0.0, 0.3]]
    structure = PeriodicStructure(constant, np.zeros((0, 3, 3, 3)), 2, ())
    found = sampled_response(structure, [], OMEGA, 8)
    psi = 2 * np.pi * np.arange(9) / 8
    Phi, _ = transition_matrices(lambda psi: evaluate_harmonics(F, psi), None, psi, OMEGA)
    units = np.array([1e6, 1.0])
    scale = units / units[:, None]
    np.testing.assert_allclose(found.Phi * scale, Phi * scale, rtol=0, atol=1e-14)


def test_observed_harmonics_put_the_signal_together(rng):
    """A model whose outputs are y_0, y_1c, y_1s, seen through Eq. 7."""
    n, n_phases = 2, 12
    structure = free_structure(rng, n, 1, 3, 0)
    psi = 2 * np.pi * np.arange(n_phases) / n_phases
    functions = harmonic_functions(psi, [0, 1])
    theta = rng.standard_normal(structure.n_parameters)
    found = sampled_response(structure, theta, OMEGA, n_phases, functions[:, None, :])
    plain = sampled_response(structure, theta, OMEGA, n_phases)
    assert found.Psi.shape[0] == 1
    assert found.Out.shape == (n_phases, 1, n + 1)
    np.testing.assert_allclose(found.Out[:, 0], functions @ plain.Out[0], atol=1e-14)
    exact = np.einsum("pl,kli->kpi", functions, plain.dOut[:, 0])
    np.testing.assert_allclose(found.dOut[:, :, 0], exact, atol=1e-14)


def test_parameters_may_be_shared_and_the_basis_sparse(rng):
    free = free_structure(rng, 2, 1, 1, 1)
    theta = rng.standard_normal(2)
    mixing = rng.standard_normal((2, free.n_parameters))
    dense = (mixing @ free.basis.toarray()).reshape(2, *free.constant.shape)
    shared = PeriodicStructure(free.constant, dense, 2, ("a", "b"))
    mixed = PeriodicStructure(free.constant, sparse.csr_array(mixing) @ free.basis, 2, ["a", "b"])
    expected = sampled_response(free, theta @ mixing, OMEGA, 8)
    for structure in (shared, mixed):
        found = sampled_response(structure, theta, OMEGA, 8)
        np.testing.assert_allclose(found.Psi, expected.Psi, atol=1e-14)
        exact = np.tensordot(mixing, expected.dPsi, 1)
        np.testing.assert_allclose(found.dPsi, exact, atol=1e-13)
    assert (shared.n_parameters, shared.n_inputs, shared.n_outputs, shared.n_harmonics) == (
        2, 1, 1, 1,
    )  # fmt: skip


def test_the_nearest_parameters(rng):
    """Their own come back, too many harmonics are cut off, missing ones are zero."""
    structure = free_structure(rng, 2, 1, 2, 2, outputs=2)
    theta = rng.standard_normal(structure.n_parameters)
    M = structure.coefficients(theta)
    np.testing.assert_allclose(structure.nearest(M), theta, atol=1e-13)
    longer = np.concatenate([M, rng.standard_normal((4, *M.shape[1:]))])
    np.testing.assert_allclose(structure.nearest(longer), theta, atol=1e-13)
    fewer = structure.coefficients(structure.nearest(M[:3]))
    np.testing.assert_allclose(fewer, np.concatenate([M[:3], 0.0 * M[3:]]), atol=1e-13)
    shared = PeriodicStructure(np.zeros((1, 2, 1)), [[[[1.0], [-1.0]]]], 1, ("rate",))
    np.testing.assert_allclose(shared.nearest(np.array([[[3.0], [-1.0]]])), [2.0])
    none = PeriodicStructure(np.zeros((1, 2, 1)), np.zeros((0, 1, 2, 1)), 1, ())
    assert none.nearest(np.zeros((1, 2, 1))).shape == (0,)


def test_a_system_without_inputs_or_parameters(rng):
    constant = rng.standard_normal((3, 3, 2))
    structure = PeriodicStructure(constant, np.zeros((0, 3, 3, 2)), 2, ())
    found = sampled_response(structure, [], OMEGA, 6)
    assert found.dPsi.shape == (0, 6, 2, 2)
    assert found.dOut.shape == (0, 6, 1, 2)
    exact = np.linalg.multi_dot(found.Phi[::-1])
    np.testing.assert_allclose(found.monodromy, exact, atol=1e-14)
    assert radius_of(exact) == pytest.approx(np.max(np.abs(np.linalg.eigvals(exact))))


def test_errors_say_what_is_needed(rng):
    structure = free_structure(rng, 2, 1, 1, 1)
    theta = np.zeros(structure.n_parameters)
    with pytest.raises(ValueError, match=r"basis has 2 parameters of 27 entries; 1 parameter name"):
        PeriodicStructure(structure.constant, np.zeros((2, 3, 3, 3)), 2, ("a",))
    with pytest.raises(ValueError, match=r"observe has shape \(3, 1, 1\); with 8 phases and 1 out"):
        sampled_response(structure, theta, OMEGA, 8, np.ones((3, 1, 1)))
    with pytest.raises(ValueError, match=r"time constants in one sample; start closer"):
        sampled_response(structure, theta - 1e5, OMEGA, 8)


# ---- functions of the turn ---------------------------------------------------------------------


@pytest.mark.parametrize("n_phases", [4, 16, 17, 17.3, 64])
def test_functions_of_the_turn_are_zero_where_they_are(n_phases):
    """Of half the sampling frequency no sample shows the sine."""
    n, highest = 2 * int(n_phases), int(n_phases // 2)
    functions = functions_of_turn(n, n_phases, highest)
    psi = 2.0 * np.pi * np.arange(n) / n_phases
    np.testing.assert_allclose(functions, harmonic_functions(psi, range(highest + 1)), atol=1e-12)
    if n_phases == 2 * highest:
        assert not functions[:, -1].any()
    assert not np.any((functions != 0.0) & (np.abs(functions) < 1e-3))
