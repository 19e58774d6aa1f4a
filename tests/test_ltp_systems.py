"""Linear time-periodic systems: laws, harmonic decompositions, shares of modes, errors."""

import numpy as np
import pandas as pd
import pytest
from scipy import linalg

from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, propagate
from sklearn_hd.systems import (
    FourierMatrix,
    LTPSystem,
)


@pytest.fixture
def random_ltp():
    rng = np.random.default_rng(7)
    F = 0.4 * rng.standard_normal((5, 3, 3))
    F[0] -= 2.0 * np.eye(3)
    return LTPSystem(
        F,
        rng.standard_normal((3, 3, 2)),
        rng.standard_normal((3, 2, 3)),
        rng.standard_normal((3, 2, 2)),
        omega=3.0,
    )


def test_default_names(random_ltp):
    assert random_ltp.state_names == ("x1", "x2", "x3")
    assert random_ltp.input_names == ("u1", "u2")
    assert random_ltp.output_names == ("y1", "y2")
    assert "omega=3" in repr(random_ltp)


def test_responses_superpose(random_ltp):
    rng = np.random.default_rng(0)
    t = np.arange(50) * random_ltp.period / 16
    u, v = rng.standard_normal((2, 50, 2))
    a, b = rng.standard_normal((2, 3))
    joint = random_ltp.simulate(2 * u - 3 * v, t, 2 * a - 3 * b)
    parts = 2 * random_ltp.simulate(u, t, a) - 3 * random_ltp.simulate(v, t, b)
    np.testing.assert_allclose(joint, parts, atol=1e-12)


def test_stacked_records_equal_single_ones(random_ltp):
    rng = np.random.default_rng(1)
    t = np.arange(40) * random_ltp.period / 8
    u, x0 = rng.standard_normal((4, 40, 2)), rng.standard_normal((4, 3))
    y, x = random_ltp.simulate(u, t, x0, return_states=True)
    for k in range(4):
        y_one, x_one = random_ltp.simulate(u[k], t, x0[k], return_states=True)
        np.testing.assert_allclose(y[k], y_one, atol=1e-13)
        np.testing.assert_allclose(x[k], x_one, atol=1e-13)


def test_constant_matrices_give_the_time_invariant_response():
    rng = np.random.default_rng(2)
    A, B = -np.eye(3) + rng.standard_normal((3, 3)), rng.standard_normal((3, 2))
    C, D = rng.standard_normal((2, 3)), rng.standard_normal((2, 2))
    system = LTPSystem(A, B, C, D, omega=5.0)
    t = np.arange(60) * system.period / 12
    u = rng.standard_normal((60, 2))
    A_d, B_d = continuous_to_discrete(A, B, t[1])
    x = propagate(A_d, u @ B_d.T, np.ones(3))
    np.testing.assert_allclose(
        system.simulate(u, t, np.ones(3)), x @ C.T + u @ D.T, rtol=1e-11, atol=1e-11
    )


def test_other_sample_times_give_the_same_trajectory(random_ltp):
    """Samples that do not repeat after a period have each interval's own transition."""
    rng = np.random.default_rng(3)
    t = np.arange(200) * random_ltp.period / 20
    kept = np.sort(rng.choice(200, 60, replace=False))
    x0, u = np.array([1.0, -2.0, 0.5]), np.ones((200, 2))
    regular, x = random_ltp.simulate(u, t, x0, return_states=True)
    irregular = random_ltp.simulate(u[kept], t[kept], x[kept[0]])
    np.testing.assert_allclose(irregular, regular[kept], atol=1e-11)


def test_records_may_begin_anywhere_in_the_period(random_ltp):
    t = np.arange(100) * random_ltp.period / 20
    u = np.sin(t)[:, None] * [1.0, -1.0]
    y, x = random_ltp.simulate(u, t, return_states=True)
    np.testing.assert_allclose(random_ltp.simulate(u[33:], t[33:], x[33]), y[33:], atol=1e-12)


def test_free_decay_shrinks_by_the_floquet_multipliers(random_ltp):
    t = np.arange(2) * random_ltp.period
    u = np.zeros((2, 2))
    columns = [random_ltp.simulate(u, t, e, return_states=True)[1][1] for e in np.eye(3)]
    multipliers = linalg.eigvals(np.transpose(columns))
    exponents = random_ltp.floquet_exponents()
    np.testing.assert_allclose(
        np.sort_complex(multipliers),
        np.sort_complex(np.exp(exponents * random_ltp.period)),
        rtol=1e-10,
    )


def test_hd_model_reproduces_the_response_as_harmonics_are_added(random_ltp):
    """A step from rest, recomposed by Eq. 7, tends to the time-periodic response."""
    t = np.arange(200) * random_ltp.period / 32
    u = np.ones((200, 2))
    exact = random_ltp.simulate(u, t)
    errors = []
    for N in (1, 3, 9):
        hd = random_ltp.harmonic_decomposition(N, 0)
        A_d, B_d = continuous_to_discrete(hd.A, hd.B, t[1])
        Y = propagate(A_d, u @ B_d.T, np.zeros(len(A_d))) @ hd.C.T + u @ hd.D.T
        y = [
            np.sum(FourierMatrix(row.reshape(2 * N + 1, 2, 1))(np.array([random_ltp.omega * time])))
            for row, time in zip(Y, t, strict=True)
        ]
        errors.append(np.max(np.abs(y - exact.sum(axis=1))))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-6


def test_harmonics_of_inputs_and_outputs_are_chosen_apart(random_ltp):
    hd = random_ltp.harmonic_decomposition(2, 0, 1)
    assert hd.A.shape == (15, 15)
    assert hd.input_labels == ["u1_0", "u2_0"]
    assert hd.output_labels == ["y1_0", "y2_0", "y1_1c", "y2_1c", "y1_1s", "y2_1s"]
    full = random_ltp.harmonic_decomposition(2)
    np.testing.assert_array_equal(hd.B, full.B[:, :2])
    np.testing.assert_array_equal(hd.C, full.C[:6])


def test_fourier_coefficients_of_callables_equal_the_given_ones(random_ltp):
    same = LTPSystem(
        *(_Called(M) for M in (random_ltp.F, random_ltp.G, random_ltp.P, random_ltp.Q)),
        omega=random_ltp.omega,
    )
    for found, expected in zip(
        same.fourier_coefficients(4), random_ltp.fourier_coefficients(4), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-13)
    np.testing.assert_allclose(
        same.harmonic_decomposition(2).A, random_ltp.harmonic_decomposition(2).A, atol=1e-12
    )


class _Called:
    def __init__(self, matrix):
        self.matrix = matrix

    def __call__(self, psi):
        return self.matrix(psi)


def test_system_without_inputs_decays():
    system = LTPSystem([[-1.0]], np.zeros((1, 0)), omega=1.0)
    y = system.simulate(np.zeros((3, 0)), [0.0, 0.5, 1.7], [1.0])
    np.testing.assert_allclose(y[:, 0], np.exp([0.0, -0.5, -1.7]), rtol=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"omega": 0.0}, "omega must be a positive number in rad/s, got 0.0"),
        ({"omega": np.nan}, "omega must be a positive number in rad/s, got nan"),
        ({"F": np.zeros((2, 3))}, "F is 2 x 3 and G is 2 x 1; F must be square"),
        ({"F": np.zeros(2)}, r"F has shape \(2,\); give a matrix"),
        ({"F": np.zeros((2, 2, 2))}, r"shape \(2, 2, 2\); give an array of shape \(2 K \+ 1"),
        ({"F": np.sin}, "F returned an array of shape"),
        ({"P": np.zeros((1, 3))}, "P must have 2 columns"),
        ({"Q": np.zeros((1, 1))}, "Q as many rows as P"),
        ({"state_names": ["a"]}, r"state_names=\['a'\] must hold 2 different names"),
        ({"input_names": ["a", "a"]}, "input_names=.* must hold 1 different names"),
    ],
)
def test_ltp_system_refuses(arguments, message):
    given = {"F": -np.eye(2), "G": np.ones((2, 1)), "omega": 1.0} | arguments
    with pytest.raises(ValueError, match=message):
        LTPSystem(**given)


@pytest.mark.parametrize(
    ("u", "t", "x0", "message"),
    [
        (np.zeros((4, 2)), [0.0, 1.0, 2.0], None, r"u has shape \(4, 2\); with 3 times"),
        (np.zeros(3), [0.0, 1.0, 2.0], None, r"inputs \['u1', 'u2'\] it must have shape \(3, 2\)"),
        (np.zeros((3, 2)), [0.0, 2.0, 1.0], None, "increasing times in seconds; sort it"),
        (np.zeros((3, 2)), [0.0, 1.0, np.nan], None, "t holds NaN or infinity; give two or more"),
        (np.full((3, 2), np.nan), [0.0, 1.0, 2.0], None, "u holds NaN or infinity"),
        (np.zeros((3, 2)), [0.0, 1.0, 2.0], [1.0], r"x0 has shape \(1,\); it must hold one value"),
    ],
)
def test_simulate_refuses(random_ltp, u, t, x0, message):
    with pytest.raises(ValueError, match=message):
        random_ltp.simulate(u, t, x0)


def test_inputs_and_states_of_pandas_go_by_their_names(random_ltp, rng):
    """In whatever order; names of other signals are refused, and none at all go by place."""
    t = 0.1 * np.arange(20)
    u, x0 = rng.standard_normal((20, 2)), rng.standard_normal(random_ltp.n_states)
    y = random_ltp.simulate(u, t, x0)
    named = pd.DataFrame(u, t, list(random_ltp.input_names))
    states = pd.Series(x0, list(random_ltp.state_names))
    given = random_ltp.simulate(named.iloc[:, ::-1], t, states.iloc[::-1])
    np.testing.assert_array_equal(given, y)
    np.testing.assert_array_equal(random_ltp.simulate(pd.DataFrame(u), t, x0), y)
    polars = pytest.importorskip("polars")
    polar = polars.DataFrame(u[:, ::-1], schema=["u2", "u1"])
    np.testing.assert_array_equal(random_ltp.simulate(polar, t, x0), y)
    with pytest.raises(
        ValueError, match=r"u has the columns \['u1', 'thrust'\], but \['u1', 'u2'\]"
    ):
        random_ltp.simulate(named.rename(columns={"u2": "thrust"}), t)


def test_a_matrix_of_a_single_azimuth_says_what_it_has_to_take():
    with pytest.raises(
        ValueError, match=r"F fails for two azimuths at once .* must return \(n_poi"
    ):
        LTPSystem(
            lambda p: np.array([[0.0, 1.0], [-2.0 - np.cos(p), -0.3]]), np.ones((2, 1)), omega=1.0
        )


@pytest.mark.parametrize("value", [-1, 1.5, True, "2"])
def test_number_of_harmonics_is_checked(random_ltp, value):
    with pytest.raises(ValueError, match=r"n_harmonics must be a whole number .*; 0 keeps"):
        random_ltp.harmonic_decomposition(value)


def test_a_mode_that_does_not_move_a_state_has_no_share_in_it():
    system = LTPSystem(np.diag([-1.0, -2.0]), [[1.0], [1.0]], [[1.0, 1.0]], omega=1.0)
    shares = system.modal_participation(1).groupby("state").sum()
    np.testing.assert_allclose(np.sort(shares.to_numpy(), axis=None), [0.0, 0.0, 1.0, 1.0])


def test_shares_do_not_depend_on_units(random_ltp):
    unit = np.array([1e-3, 1.0, 10.0, 1e4])[: random_ltp.n_states]
    F, G = (lambda psi: unit[:, None] * random_ltp.F(psi) / unit), np.ones((3, 1))
    scaled = LTPSystem(F, G, omega=random_ltp.omega)
    found, expected = scaled.modal_participation(2), random_ltp.modal_participation(2)
    np.testing.assert_allclose(found, expected, atol=1e-8)
