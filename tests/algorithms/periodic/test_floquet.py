"""Laws of transition matrices, Floquet exponents and harmonic decomposition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg

from sklearn_hd.algorithms.periodic.floquet import (
    monodromy_matrix,
    on_branch,
    propagate_periodic,
    transition_matrices,
)
from sklearn_hd.algorithms.periodic.harmonic_balance import (
    evaluate_harmonics,
)
from sklearn_hd.algorithms.periodic.harmonic_decomposition import (
    complex_spectrum,
    derivative_matrix,
    fourier_coefficients,
    harmonic_decomposition,
    toeplitz_matrix,
)
from sklearn_hd.algorithms.signals.fourier import recompose, sampled_harmonics

OMEGA = 2.0


def periodic(coefficients):
    return lambda psi: evaluate_harmonics(coefficients, psi)


def exponents_of(monodromy):
    logarithms = np.log(linalg.eigvals(monodromy).astype(complex))
    return on_branch(logarithms * OMEGA / (2 * np.pi), OMEGA)


def switched(first, second, at=1.0):
    """Matrix that is ``first`` up to azimuth ``at``, then ``second`` to the end of the period."""

    def matrix(psi):
        early = np.mod(psi, 2 * np.pi) < at
        return np.where(early[:, None, None], first, second)

    return matrix


@pytest.fixture
def random_coefficients():
    rng = np.random.default_rng(3)
    return rng.standard_normal((7, 3, 3)) / (1 + np.arange(7))[:, None, None] - 0.5 * np.eye(3)


def test_switched_matrix_gives_the_product_of_exponentials():
    rng = np.random.default_rng(0)
    first, second = rng.standard_normal((2, 2, 2))
    monodromy = monodromy_matrix(switched(first, second), OMEGA)
    expected = linalg.expm(second * (2 * np.pi - 1) / OMEGA) @ linalg.expm(first / OMEGA)
    np.testing.assert_allclose(monodromy, expected, rtol=1e-12)


def test_switched_input_matrix_gives_its_integral():
    G = switched(np.array([[1.0], [0.0]]), np.array([[0.0], [3.0]]))
    _, Gamma = transition_matrices(lambda psi: np.zeros((len(psi), 2, 2)), G, [0.0, 4.0], OMEGA)
    np.testing.assert_allclose(Gamma[0, :, 0], [1.0 / OMEGA, 9.0 / OMEGA], rtol=1e-13)


def test_input_integral_of_constant_matrices_is_the_zero_order_hold():
    F, G = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.0], [2.0]])
    Phi, Gamma = transition_matrices(
        lambda psi: np.broadcast_to(F, (len(psi), 2, 2)),
        lambda psi: np.broadcast_to(G, (len(psi), 2, 1)),
        [0.3, 0.9],
        OMEGA,
    )
    h = 0.6 / OMEGA
    np.testing.assert_allclose(Phi[0], linalg.expm(F * h), rtol=1e-13)
    integral = linalg.solve(F, (linalg.expm(F * h) - np.eye(2)) @ G)
    np.testing.assert_allclose(Gamma[0], integral, rtol=1e-13)


def test_transition_over_neighbouring_intervals_is_the_product(random_coefficients):
    F = periodic(random_coefficients)
    parts, _ = transition_matrices(F, None, [0.2, 1.1, 2.5], OMEGA)
    whole, _ = transition_matrices(F, None, [0.2, 2.5], OMEGA)
    np.testing.assert_allclose(parts[1] @ parts[0], whole[0], rtol=1e-13, atol=1e-14)


def test_determinant_follows_the_trace(random_coefficients):
    """Liouville: det Φ(T) = exp ∫ tr F dt."""
    monodromy = monodromy_matrix(periodic(random_coefficients), OMEGA)
    trace = np.trace(random_coefficients[0])
    assert linalg.det(monodromy) == pytest.approx(np.exp(trace * 2 * np.pi / OMEGA), rel=1e-12)


def test_units_of_the_states_do_not_matter(random_coefficients):
    scale = np.array([1e-6, 1.0, 1e5])
    rescaled = random_coefficients * scale[:, None] / scale
    monodromy = monodromy_matrix(periodic(random_coefficients), OMEGA)
    other = monodromy_matrix(periodic(rescaled), OMEGA)
    np.testing.assert_allclose(other / scale[:, None] * scale, monodromy, rtol=1e-11, atol=1e-13)


def test_noisy_matrix_is_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="free of noise"):
        monodromy_matrix(lambda psi: rng.standard_normal((len(psi), 1, 1)), OMEGA)


def test_matrix_with_nan_is_refused():
    with pytest.raises(ValueError, match="hold NaN or infinity"):
        monodromy_matrix(lambda psi: np.full((len(psi), 1, 1), np.nan), OMEGA)


def test_exponents_of_constant_matrices_are_eigenvalues_on_the_branch():
    block = [[-0.1, 3.3], [-3.3, -0.1]]
    F = linalg.block_diag(block, [[-0.4]])
    monodromy = monodromy_matrix(lambda psi: np.broadcast_to(F, (len(psi), 3, 3)), OMEGA)
    folded = 2 * OMEGA - 3.3  # ±3.3j moved by multiples of ω into (−ω/2, ω/2]
    exponents = exponents_of(monodromy)
    expected = [-0.1 - folded * 1j, -0.1 + folded * 1j, -0.4]
    np.testing.assert_allclose(exponents, expected, atol=1e-12)


def test_negative_multipliers_lie_on_the_upper_edge_of_the_branch():
    exponents = exponents_of(np.diag([-0.5, -0.25]))
    np.testing.assert_allclose(exponents.imag, OMEGA / 2)


def test_exponents_do_not_depend_on_the_origin_of_azimuth(random_coefficients):
    F = periodic(random_coefficients)
    exponents = exponents_of(monodromy_matrix(F, OMEGA))
    shifted = exponents_of(monodromy_matrix(F, OMEGA, start=1.234))
    np.testing.assert_allclose(shifted, exponents, atol=1e-12)


@pytest.mark.parametrize("n_samples", [1, 3, 5, 11, 23])
def test_periodic_recursion_equals_the_loop(n_samples):
    rng = np.random.default_rng(n_samples)
    Phi, v = rng.standard_normal((5, 2, 2)), rng.standard_normal((4, n_samples, 2))
    x = rng.standard_normal((4, 2))
    states = propagate_periodic(Phi, v, x)
    for k in range(n_samples):
        np.testing.assert_allclose(states[:, k], x, rtol=1e-10, atol=1e-10)
        x = x @ Phi[k % 5].T + v[:, k]


def test_fourier_coefficients_of_a_switched_matrix():
    at = 1.0
    coefficients = fourier_coefficients(switched([[1.0]], [[0.0]], at), 40)[:, 0, 0]
    k = np.arange(1, 41)
    assert coefficients[0] == pytest.approx(at / (2 * np.pi), rel=1e-12)
    np.testing.assert_allclose(coefficients[1::2], np.sin(k * at) / (k * np.pi), atol=1e-12)
    np.testing.assert_allclose(coefficients[2::2], (1 - np.cos(k * at)) / (k * np.pi), atol=1e-12)


def test_fourier_coefficients_of_a_series_are_its_own(random_coefficients):
    found = fourier_coefficients(periodic(random_coefficients), 5)
    np.testing.assert_allclose(found[:7], random_coefficients, atol=1e-14)
    np.testing.assert_allclose(found[7:], 0.0, atol=1e-14)


def test_rounding_in_an_entry_is_not_resolved():
    """An entry that is rounding noise beside the others must not be bisected for ever."""
    rng = np.random.default_rng(0)

    def matrix(psi):
        noise = 1e-17 * rng.standard_normal(len(psi))
        return np.stack([np.cos(psi), noise], axis=-1)[:, None, :]

    np.testing.assert_allclose(fourier_coefficients(matrix, 1)[1, 0], [1.0, 0.0], atol=1e-13)


@given(n=st.integers(0, 5), seed=st.integers(0, 2**16))
def test_complex_and_real_coefficients_are_the_same_signal(n, seed):
    rng = np.random.default_rng(seed)
    real = rng.standard_normal(2 * n + 1)
    psi = rng.uniform(0, 2 * np.pi, 7)
    spectrum = complex_spectrum(real, n)
    exponentials = np.exp(1j * np.outer(psi, np.arange(-n, n + 1)))
    signal = recompose(np.broadcast_to(real, (7, len(real))), psi, range(n + 1))
    np.testing.assert_allclose(exponentials @ spectrum, signal, atol=1e-12)


def test_toeplitz_matrix_multiplies(random_coefficients):
    """T X are the harmonics of M(ψ) x(ψ)."""
    rng = np.random.default_rng(1)
    X = rng.standard_normal((5, 3))
    psi = 2 * np.pi * np.arange(64) / 64
    M, x = evaluate_harmonics(random_coefficients, psi), evaluate_harmonics(X, psi)
    product = sampled_harmonics(np.einsum("kij,kj->ki", M, x), 5)
    T = toeplitz_matrix(random_coefficients, 5, 2)
    np.testing.assert_allclose((T @ X.ravel()).reshape(11, 3), product, atol=1e-13)


def test_toeplitz_matrix_in_complex_coefficients(random_coefficients):
    """W T W⁻¹ has the blocks M_{p−q}."""
    T = toeplitz_matrix(random_coefficients[:, :1, :1], 2, 2)
    W = complex_spectrum(np.eye(5), 2)
    blocks = W @ T @ np.linalg.inv(W)
    spectrum = complex_spectrum(random_coefficients[:, 0, 0], 3)
    expected = linalg.toeplitz(
        np.r_[spectrum[3:], 0.0][[0, 1, 2, 3, 4]], np.r_[spectrum[3::-1], 0.0][[0, 1, 2, 3, 4]]
    )
    np.testing.assert_allclose(blocks, expected, atol=1e-14)


def test_derivative_matrix_differentiates():
    rng = np.random.default_rng(2)
    X = rng.standard_normal((9, 2))
    psi, h = np.linspace(0, 6, 7), 1e-5
    rates = (evaluate_harmonics(X, psi + h) - evaluate_harmonics(X, psi - h)) / (2 * h) * OMEGA
    derivative = (derivative_matrix(4, 2, OMEGA) @ X.ravel()).reshape(9, 2)
    np.testing.assert_allclose(evaluate_harmonics(derivative, psi), rates, rtol=1e-7)


def test_zero_harmonics_keep_the_mean(random_coefficients):
    matrices = harmonic_decomposition(*[random_coefficients] * 4, OMEGA, 0, 0, 0)
    for matrix in matrices:
        np.testing.assert_array_equal(matrix, random_coefficients[0])


def test_hd_eigenvalues_tend_to_exponents_and_their_copies(random_coefficients):
    exponents = exponents_of(monodromy_matrix(periodic(random_coefficients), OMEGA))
    zero = np.zeros((1, 3, 0))
    A, *_ = harmonic_decomposition(
        random_coefficients, zero, zero.swapaxes(1, 2), np.zeros((1, 0, 0)), OMEGA, 25, 0, 0
    )
    eigenvalues = linalg.eigvals(A)
    for p in range(-3, 4):
        for exponent in exponents:
            assert np.min(np.abs(eigenvalues - exponent - 1j * p * OMEGA)) < 1e-9
