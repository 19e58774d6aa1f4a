"""Continuous periodic models behind discrete ones: known systems, sampled exactly, come back."""

import numpy as np
import pytest
from scipy import linalg

from sklearn_hd.algorithms.periodic.behind_samples import (
    behind_samples,
    floquet_states,
    turn_of,
)
from sklearn_hd.algorithms.periodic.floquet import floquet_exponents, transition_matrices
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_realization import FloquetError
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics

OMEGA = 3.0
SYSTEMS = {  # F and G of few harmonics
    "stable": (
        [[[0.0, 1.0], [-4.0, -0.5]], [[0.0, 0.0], [-0.8, 0.1]], [[0.0, 0.0], [0.3, -0.2]]],
        [[[0.0], [1.0]], [[0.1], [0.3]], [[0.0], [0.0]]],
    ),
    "unstable": (
        [[[0.0, 1.0], [-1.0, 0.2]], [[0.0, 0.0], [0.2, 0.0]], [[0.0, 0.1], [0.0, 0.0]]],
        [[[1.0, 0.0], [0.0, 1.0]]],
    ),
    "negative multipliers": (  # the first resonance of Mathieu's equation
        [[[0.0, 1.0], [-2.25, -0.2]], [[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]],
        [[[0.0], [1.0]]],
    ),
    "one fast": (
        [[[-0.5, 1.0], [0.4, -9.0]], [[0.2, 0.3], [0.0, 0.5]], [[0.0, 0.4], [-0.3, 0.0]]],
        [[[1.0], [2.0]]],
    ),
}


def sampled(F, G, samples, C=None, start=0.4, n_points=129):
    """The discrete model of a system of few harmonics, its coefficients of as many as it has."""
    F, G = np.asarray(F), np.asarray(G)
    n, m = G.shape[1:]
    C = np.eye(n) if C is None else C
    step = 2 * np.pi / samples
    steps = [
        np.concatenate(
            transition_matrices(
                lambda psi: evaluate_harmonics(F, psi),
                lambda psi: evaluate_harmonics(G, psi),
                [psi, psi + step],
                OMEGA,
            ),
            axis=2,
        )[0]
        for psi in 2 * np.pi * np.arange(n_points) / n_points
    ]
    values = np.zeros((n_points, n + len(C), n + m + 1))
    values[:, :n, :-1], values[:, n:, :n] = steps, C
    coefficients = sampled_harmonics(values, n_points // 2)
    gain = np.zeros((len(coefficients), n, len(C)))
    return PeriodicInnovations(coefficients, gain, np.eye(len(C)), step, start)


def padded(coefficients, like):
    whole = np.zeros(like.shape)
    whole[: len(coefficients)] = np.asarray(coefficients)[: len(whole)]
    return whole


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize(("samples", "digits"), [(64, 1e-11), (16, 1e-5), (16.216, 1e-3)])
def test_measured_states_give_back_their_system(name, samples, digits):
    F, G = SYSTEMS[name]
    found = behind_samples(sampled(F, G, samples), OMEGA)
    assert found.rows == [0, 1]
    size = np.max(np.abs(F))
    assert np.max(np.abs(found.F - padded(F, found.F))) < digits * size
    assert np.max(np.abs(found.G - padded(G, found.G))) < 10 * digits
    np.testing.assert_allclose(found.P, np.eye(2)[None], atol=1e-12)


@pytest.mark.parametrize(
    "samples",
    [
        pytest.param(16.0, marks=pytest.mark.slow),
        16.216,
        pytest.param(7.3, marks=pytest.mark.slow),
        7.0,
    ],
)
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("rows", [None, [0, 1]])
def test_exponents_are_those_of_the_discrete_model(name, samples, rows):
    innovations = sampled(*SYSTEMS[name], samples)
    found = turn_of(innovations, OMEGA).model(rows)
    exponents = floquet_exponents(lambda psi: evaluate_harmonics(found.F, psi), OMEGA)
    wanted = np.exp(innovations.multiplier_logarithms())
    np.testing.assert_allclose(
        np.sort_complex(np.exp(exponents * 2 * np.pi / OMEGA)), np.sort_complex(wanted), rtol=1e-9
    )


@pytest.mark.parametrize("samples", [16.0, 7.0, 25.0])
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("C", [np.eye(2), [[1.0, 0.5]]], ids=["states", "one output"])
def test_its_samples_are_those_of_the_discrete_model(name, samples, C):
    """From rest, whatever the coordinates, at the azimuths of a whole number of samples."""
    innovations = sampled(*SYSTEMS[name], samples, np.asarray(C))
    found = behind_samples(innovations, OMEGA)
    psi = innovations.start + innovations.step * np.arange(3 * int(samples))
    F, G = (lambda at, M=M: evaluate_harmonics(M, at) for M in (found.F, found.G))
    Phi, Gamma = transition_matrices(F, G, psi, OMEGA)
    u = np.random.default_rng(0).standard_normal((len(psi), Gamma.shape[2]))
    x, y = np.zeros(2), np.empty((len(psi), len(C)))
    for k, P in enumerate(evaluate_harmonics(found.P, psi)):
        y[k] = P @ x
        x = Phi[k] @ x + Gamma[k] @ u[k] if k < len(Phi) else x
    wanted = innovations.rows(psi).simulated(u, np.zeros(2))
    np.testing.assert_allclose(y, wanted, atol=1e-10 * np.max(np.abs(wanted)))


@pytest.mark.parametrize("spread", [1e-3, 1e-8, 1e-20, 1e-60])
def test_fast_modes_do_not_spoil_slow_ones(spread):
    """Multipliers decades apart, in coordinates that turn: each mode's states repeat."""
    rng, q = np.random.default_rng(1), 24
    wanted = np.array([0.9, 0.7, spread, -0.4 * spread, -0.3 * spread])
    turned = linalg.expm(np.triu(rng.standard_normal((5, 5)), 1) * 0.5)
    coordinates = [
        turned + 0.2 * np.cos(2 * np.pi * j / q) * np.diag(np.ones(4), 1) for j in range(q)
    ]
    steps = np.tile(np.diag(np.abs(wanted) ** (1 / q)), (q, 1, 1))
    steps[0] *= np.sign(wanted)
    A = np.array(
        [coordinates[(j + 1) % q] @ steps[j] @ linalg.inv(coordinates[j]) for j in range(q)]
    )
    X, R, flips = floquet_states(A, 1.0)
    assert flips.sum() == 2
    found = linalg.eigvals(R).real
    np.testing.assert_allclose(np.sort(found), np.sort(np.log(np.abs(wanted))), rtol=1e-7)
    step = linalg.expm(R / q)
    moved = X[1:] @ step
    for group in (slice(0, 2), slice(2, 5)):  # in parts of the group's own size
        gap = (A[:-1] @ X[:-1] - moved)[:, :, group]
        assert np.max(np.abs(gap)) < 1e-9 * np.max(np.abs(moved[:, :, group]))


def test_a_step_that_forgets_a_state_is_refused():
    innovations = sampled(*SYSTEMS["stable"], 16)
    coefficients = innovations.coefficients.copy()
    coefficients[:, 1, :2] = coefficients[:, 0, :2]
    forgetful = PeriodicInnovations(
        coefficients, innovations.gain, innovations.covariance, innovations.step
    )
    with pytest.raises(FloquetError, match=r"forgets a state.*use order=1"):
        behind_samples(forgetful, OMEGA)


def test_an_odd_number_of_negative_multipliers_is_refused():
    coefficients = np.zeros((3, 3, 4))
    coefficients[0, :2, :2], coefficients[0, 2, :2] = np.diag([0.9, -0.8]), [1.0, 1.0]
    coefficients[1, 0, 1] = 0.1
    odd = PeriodicInnovations(coefficients, np.zeros((3, 2, 1)), np.eye(1), 2 * np.pi / 7)
    with pytest.raises(FloquetError, match=r"odd number.*try order=3 or 1"):
        behind_samples(odd, OMEGA)


def test_a_model_without_harmonics_is_time_invariant():
    F, G = [[[0.0, 1.0], [-4.0, -0.5]]], [[[0.0], [1.0]]]
    innovations = sampled(F, G, 7.3, np.eye(2))
    coefficients = innovations.coefficients[:1]
    constant = PeriodicInnovations(
        coefficients, np.zeros((1, 2, 2)), np.eye(2), innovations.step, 0.4
    )
    found = behind_samples(constant, OMEGA)
    for M, wanted in ((found.F, F), (found.G, G), (found.P, [np.eye(2)])):
        np.testing.assert_allclose(M, wanted, atol=1e-12)


def test_outputs_without_a_feedthrough_are_states_before_others():
    C = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]
    innovations = sampled(*SYSTEMS["stable"], 16, np.asarray(C))
    innovations.coefficients[0, 2, 2] = 0.5
    found = behind_samples(innovations, OMEGA)
    assert found.rows == [1, 2]
    assert found.Q[0, 0, 0] == 0.5
    innovations.coefficients[0, 3:, 2] = 0.5
    assert behind_samples(innovations, OMEGA).rows == [0, 1]  # but for their feedthrough
