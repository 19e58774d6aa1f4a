"""Floquet exponents where the multipliers span more decades than a product holds."""

import numpy as np
import pytest
from scipy import linalg

from sklearn_hd.algorithms.periodic.floquet import (
    floquet_exponents,
    monodromy_matrix,
    on_branch,
    product_logarithms,
)
from sklearn_hd.systems import LTPSystem

OMEGA = 3.0
PERIOD = 2 * np.pi / OMEGA


def transformed(R, seed=0):
    """F = (P′ + P R) P⁻¹ of periodic coordinates P(ψ): its exponents are eigenvalues of R."""
    n = len(R)
    rng = np.random.default_rng(seed)
    cosine, sine = 0.25 * rng.standard_normal((2, n, n)) / np.sqrt(n)

    def F(psi):
        c, s = np.cos(psi)[:, None, None], np.sin(psi)[:, None, None]
        P = np.eye(n) + c * cosine + s * sine
        rate = OMEGA * (c * sine - s * cosine)
        return (rate + P @ R) @ np.linalg.inv(P)

    return F


def folded(exponents):
    """Known exponents moved to the branch that is returned."""
    exponents = np.asarray(exponents, dtype=complex)
    turns = np.round(exponents.imag / OMEGA)
    return on_branch(exponents - 1j * OMEGA * turns, OMEGA)


def relative_error(found, expected):
    expected = folded(expected)
    return np.max(np.abs(found - expected) / np.abs(expected))


@pytest.mark.parametrize(
    "exponents",
    [
        [-1.0, -140.0 * OMEGA / (2 * np.pi)],
        [-0.01, -2.0, -60.0, -300.0],
        [2.0, -1.0, -1.5, -500.0, -501.0],
        [-1e-3, -900.0],
    ],
    ids=["61 decades", "272 decades", "456 decades", "818 decades"],
)
@pytest.mark.slow
def test_slow_and_fast_modes_together(exponents):
    F = transformed(np.diag(exponents))
    assert relative_error(floquet_exponents(F, OMEGA), exponents) < 1e-11
    multipliers = np.abs(linalg.eigvals(monodromy_matrix(F, OMEGA)))
    smallest = np.exp(min(exponents) * PERIOD)  # which the monodromy matrix does not show
    if smallest > 0.0:
        assert np.min(multipliers) != pytest.approx(smallest, rel=0.5, abs=0.0)


def test_complex_pairs_far_apart():
    blocks = [[[-0.3, 0.9], [-0.9, -0.3]], [[-80.0, 1.1], [-1.1, -80.0]], [[-81.0]]]
    F = transformed(linalg.block_diag(*blocks), seed=1)
    expected = [-0.3 + 0.9j, -0.3 - 0.9j, -80 + 1.1j, -80 - 1.1j, -81]
    found = floquet_exponents(F, OMEGA)
    assert relative_error(found, expected) < 1e-11
    np.testing.assert_array_equal(found[0::2][:2], np.conj(found[1::2]))


def test_defective_exponents_far_apart():
    """Two Jordan blocks: each pair to the square root of rounding, its mean to rounding."""
    R = np.diag([-0.5, -0.5, -90.0, -90.0]) + np.diag([1.0, 0.0, 1.0], 1)
    found = floquet_exponents(transformed(R, seed=2), OMEGA)
    np.testing.assert_allclose(found, [-0.5, -0.5, -90.0, -90.0], atol=1e-6)
    np.testing.assert_allclose(found.reshape(2, 2).mean(axis=1), [-0.5, -90.0], rtol=1e-11)


def test_negative_multipliers_far_apart():
    """Coordinates that turn by half a turn a period: both multipliers are negative."""
    R = np.diag([-1.0, -150.0])

    def F(psi):
        c, s = np.cos(psi / 2), np.sin(psi / 2)
        turn = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
        spin = 0.5 * OMEGA * np.array([[0.0, -1.0], [1.0, 0.0]])
        return turn @ R @ turn.mT + spin

    found = floquet_exponents(F, OMEGA)
    np.testing.assert_allclose(found, np.array([-1, -150]) + 0.5j * OMEGA, rtol=1e-11)


@pytest.mark.parametrize("seed", range(5))
def test_moderate_multipliers_agree_with_the_monodromy_matrix(seed):
    rng = np.random.default_rng(seed)
    F = transformed(0.3 * rng.standard_normal((4, 4)), seed)
    logarithms = np.log(linalg.eigvals(monodromy_matrix(F, OMEGA)).astype(complex))
    expected = on_branch(logarithms / PERIOD, OMEGA)
    np.testing.assert_allclose(floquet_exponents(F, OMEGA), expected, atol=1e-11)


def test_units_of_the_states_do_not_matter():
    R = np.diag([-0.2, -3.0, -70.0])
    scale = np.array([1e-8, 1.0, 1e6])
    F = transformed(R, seed=4)
    found = floquet_exponents(lambda psi: F(psi) * scale[:, None] / scale, OMEGA)
    assert relative_error(found, np.diag(R)) < 1e-10


@pytest.mark.parametrize("n", [1, 2, 5])
def test_eigenvalues_of_a_product_of_one_factor(n):
    A = np.random.default_rng(n).standard_normal((n, n))
    found = np.exp(product_logarithms(A[None]))
    expected = linalg.eigvals(A)
    np.testing.assert_allclose(
        np.sort_complex(np.round(found, 12)), np.sort_complex(np.round(expected, 12)), atol=1e-11
    )


def test_many_close_multipliers_part_sweep_by_sweep():
    """Twelve multipliers, each 0.3 of the last: 6e-7 of the first, in one block at first."""
    exponents = np.log(0.3) * np.arange(12) / PERIOD
    found = floquet_exponents(transformed(np.diag(exponents), seed=5), OMEGA)
    np.testing.assert_allclose(found, exponents, atol=1e-10)


def test_multipliers_too_close_to_part_stay_in_one_block():
    """Forty multipliers, each 0.8 of the last: no two part within the sweeps allowed."""
    exponents = np.log(0.8) * np.arange(40) / PERIOD
    found = floquet_exponents(transformed(np.diag(exponents), seed=6), OMEGA)
    np.testing.assert_allclose(found, exponents, atol=1e-11)


def test_no_states_no_exponents():
    assert product_logarithms(np.empty((3, 0, 0))).shape == (0,)


def test_ltp_system_uses_them():
    system = LTPSystem(transformed(np.diag([-1.0, -80.0])), np.ones((2, 1)), omega=OMEGA)
    np.testing.assert_allclose(system.floquet_exponents(), [-1.0, -80.0], rtol=1e-11)
