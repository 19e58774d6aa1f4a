"""Laws of simulation and of the way between time domains."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, signal

from sklearn_hd.algorithms.lti.simulation import (
    continuous_to_discrete,
    discrete_to_continuous,
    frequency_response,
    propagate,
    real_logarithm,
    simulate,
)


@given(n=st.integers(0, 6), steps=st.integers(0, 70), seed=st.integers(0, 2**16))
def test_propagation_is_the_recursion(n, steps, seed):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n)) * 0.5
    forcing = rng.standard_normal((2, steps, n))
    x0 = rng.standard_normal(n)
    found = propagate(A, forcing, np.broadcast_to(x0, (2, n)))
    x = np.broadcast_to(x0, (2, n))
    for k in range(steps):
        np.testing.assert_allclose(found[:, k], x, rtol=1e-9, atol=1e-9)
        x = x @ A.T + forcing[:, k]


@pytest.mark.parametrize("steps", [127, 128, 129, 300, 2049, 40_003])
def test_blocks_propagate_as_the_recursion_does(rng, steps):
    """Short, whole and broken blocks; blocks of blocks; a defective pole."""
    A = linalg.block_diag([[0.98, 1.0], [0.0, 0.98]], -0.5)
    forcing, x0 = rng.standard_normal((2, steps, 3)), rng.standard_normal((2, 3))
    found = propagate(A, forcing, x0)
    x = np.empty_like(forcing)
    x[:, 0] = x0
    for k in range(1, steps):
        x[:, k] = x[:, k - 1] @ A.T + forcing[:, k - 1]
    np.testing.assert_allclose(found, x, rtol=1e-9, atol=1e-11 * np.abs(x).max())


def test_unstable_states_end_in_infinities_not_in_numbers(rng):
    states = propagate(2.0 * np.eye(1), np.zeros((5000, 1)), np.ones(1))[:, 0]
    np.testing.assert_array_equal(states[:1000], 2.0 ** np.arange(1000))
    assert not np.isfinite(states[1100:]).any()


def test_nilpotent_states_vanish_exactly():
    states = propagate(np.array([[0.0, 1.0], [0.0, 0.0]]), np.zeros((40, 2)), np.array([1.0, 1.0]))
    assert np.all(states[2:] == 0.0)


@pytest.mark.parametrize("steps", [0, 1, 60, 64, 1000, 1023, 4001])
@pytest.mark.parametrize("shape", [(0, 2, 3), (2, 1, 1), (5, 2, 3), (3, 0, 2), (4, 2, 12)])
def test_outputs_are_those_of_the_states(rng, steps, shape):
    n, m, n_outputs = shape
    A, B = 0.9 * linalg.orth(rng.standard_normal((n, n))), rng.standard_normal((n, m))
    C, D = rng.standard_normal((n_outputs, n)), rng.standard_normal((n_outputs, m))
    u, x0 = np.asfortranarray(rng.standard_normal((steps, m))), rng.standard_normal(n)
    expected = propagate(A, u @ B.T, x0) @ C.T + u @ D.T
    np.testing.assert_allclose(simulate(A, B, C, D, u, x0), expected, atol=1e-12)


@pytest.mark.parametrize(("u_unit", "y_unit"), [(1e170, 1e-170), (1e-170, 1e-170), (1e170, 1e170)])
def test_units_scale_outputs_alone(rng, u_unit, y_unit):
    A, B, C = 0.5 * np.eye(2), rng.standard_normal((2, 1)), rng.standard_normal((1, 2))
    u, x0, D = rng.standard_normal((2000, 1)), np.ones(2), np.zeros((1, 1))
    found = simulate(A, B / u_unit, C * y_unit, D, u * u_unit, x0)
    np.testing.assert_allclose(found / y_unit, simulate(A, B, C, D, u, x0), atol=1e-13)


def test_each_input_and_output_may_have_units_of_its_own(rng):
    """An input in 1e100 beside one in 1e-100 loses no digits, nor does a model of D alone."""
    A = 0.9 * linalg.orth(rng.standard_normal((3, 3)))
    B, C, D = rng.standard_normal((3, 3)), rng.standard_normal((3, 3)), rng.standard_normal((3, 3))
    B[:, 2], C[2] = 0.0, 0.0
    u, x0 = rng.standard_normal((600, 3)), rng.standard_normal(3)
    units, y_units = np.array([1e100, 1e-100, 1e-120]), np.array([1e-110, 1e100, 1e120])
    found = simulate(
        A, B / units, C * y_units[:, None], D / units * y_units[:, None], u * units, x0
    )
    np.testing.assert_allclose(found / y_units, simulate(A, B, C, D, u, x0), atol=1e-13)


def test_unstable_outputs_end_in_no_numbers():
    one = np.ones((1, 1))
    outputs = simulate(2.0 * one, one, one, 0.0 * one, np.zeros((5000, 1)), np.ones(1))[:, 0]
    np.testing.assert_array_equal(outputs[:1000], 2.0 ** np.arange(1000))
    assert not np.isfinite(outputs[1100:]).any()


def test_zero_order_hold_agrees_with_scipy():
    A, B = np.array([[0.0, 1.0], [-4.0, -0.4]]), np.array([[0.0], [1.0]])
    expected = signal.cont2discrete((A, B, np.eye(2), np.zeros((2, 1))), 0.1)[:2]
    for found, true in zip(continuous_to_discrete(A, B, 0.1), expected, strict=True):
        np.testing.assert_allclose(found, true, atol=1e-15)


def test_negative_real_poles_have_no_continuous_model():
    with pytest.raises(ValueError, match=r"poles at -0.5 lie on the closed negative real axis"):
        discrete_to_continuous(np.diag([-0.5, 0.5]), np.ones((2, 1)), 0.1)


def test_a_model_without_states_stays_one():
    A, B = discrete_to_continuous(np.zeros((0, 0)), np.zeros((0, 2)), 0.1)
    assert A.shape == (0, 0)
    assert B.shape == (0, 2)
    response = frequency_response(A, B, np.zeros((3, 0)), np.ones((3, 2)), [1j, 2j])
    np.testing.assert_array_equal(response, np.ones((2, 3, 2)))


@pytest.mark.parametrize("unit", [1e-150, 1e-6, 1e6, 1e150])
def test_units_of_the_inputs_scale_b_alone(rng, unit):
    """The exponential of [[A, B], [0, 0]] is not scaled with B: 1e100 cost ten digits of A."""
    A = rng.standard_normal((4, 4)) - 2.0 * np.eye(4)
    B, units = rng.standard_normal((4, 2)), np.array([unit, 1.0])
    A_ref, B_ref = continuous_to_discrete(A, B, 0.1)
    A_d, B_d = continuous_to_discrete(A, B * units, 0.1)
    np.testing.assert_allclose(A_d, A_ref, rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(B_d / units, B_ref, rtol=1e-13, atol=1e-15)
    A_again, B_again = discrete_to_continuous(A_d, B_d, 0.1)
    np.testing.assert_allclose(A_again, A, atol=1e-10)
    np.testing.assert_allclose(B_again / units, B, atol=1e-10)


def test_logarithms_are_judged_by_their_residual():
    """SciPy warns of the first, which is good to 1e-10, as of the second, which is wrong."""

    def nearly_defective(gap):
        return np.array([[1e-6, 1e3, 0.0], [0.0, 1.0, 1e3], [0.0, 0.0, 1.0 + gap]])

    matrix = nearly_defective(1e-3)
    found = linalg.expm(real_logarithm(matrix))
    assert linalg.norm(found - matrix) < 1e-8 * linalg.norm(matrix)
    with pytest.raises(ValueError, match=r"matrix logarithm of this model is accurate to .* only"):
        real_logarithm(nearly_defective(1e-12))


def test_logarithms_draw_no_random_numbers(rng):
    """SciPy draws from NumPy's global generator: the last bit differed from call to call."""
    matrices = [linalg.expm(0.3 * rng.standard_normal((5, 5))) for _ in range(40)]
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    first = [real_logarithm(matrix) for matrix in matrices]
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    for seed in range(5):
        np.random.seed(seed)  # noqa: NPY002
        for matrix, found in zip(matrices, first, strict=True):
            assert real_logarithm(matrix).tobytes() == found.tobytes()
