"""Periodic regulators, Kalman filters, observers and controllers, by laws and by control's own."""

import pickle

import control
import numpy as np
import pytest
from scipy import linalg

from sklearn_hd.algorithms.periodic.floquet import transition_matrices
from sklearn_hd.algorithms.periodic.riccati import solve_periodic_lyapunov
from sklearn_hd.design import (
    Observer,
    OutputFeedback,
    PeriodicMatrix,
    periodic_kalman,
    periodic_lqr,
)
from sklearn_hd.systems import LTPSystem, mathieu

RNG = np.random.default_rng(0)
F0, G0, P0 = RNG.standard_normal((4, 4)), RNG.standard_normal((4, 2)), RNG.standard_normal((2, 4))
CONSTANT = LTPSystem(F0, G0, P0, omega=3.0)
Q4, R2 = np.diag([1.0, 2.0, 3.0, 4.0]), np.array([[1.0, 0.3], [0.3, 2.0]])
SCALE = np.array([2.0, 1.0, 1.0, 0.3, 0.3])[:, None, None]
SYSTEM = LTPSystem(
    RNG.standard_normal((5, 3, 3)) * SCALE, RNG.standard_normal((3, 3, 1)), np.eye(2, 3), omega=4.0
)
Q3, R1, V2 = np.eye(3), np.array([[0.5]]), 0.1 * np.eye(2)


def held(system, p):
    psi = 2.0 * np.pi * np.arange(p + 1) / p
    return transition_matrices(system.F, system.G, psi, system.omega)


# ---- against control --------------------------------------------------------------------------


def test_constant_system_in_continuous_time_is_control_lqr_and_lqe():
    K, X, _ = control.lqr(F0, G0, Q4, R2)
    regulator = periodic_lqr(CONSTANT, Q4, R2)
    np.testing.assert_allclose(regulator.gain.values, np.tile(K, (256, 1, 1)), atol=1e-11)
    np.testing.assert_allclose(regulator.cost_to_go.values[7], X, atol=1e-10)
    L, P, _ = control.lqe(F0, np.eye(4), P0, Q4, R2)
    estimator = periodic_kalman(CONSTANT, Q4, R2)
    np.testing.assert_allclose(estimator.gain.values, np.tile(L, (256, 1, 1)), atol=1e-11)
    np.testing.assert_allclose(estimator.covariance.values[7], P, atol=1e-10)
    expected = np.exp(CONSTANT.period * linalg.eigvals(F0 - L @ P0))
    assert np.allclose(np.sort(np.abs(expected)), np.sort(np.abs(estimator.multipliers)))


@pytest.mark.parametrize("p", [1, 5])
def test_constant_system_at_samples_is_control_dlqr_and_dlqe(p):
    h = CONSTANT.period / p
    both = linalg.expm(h * np.block([[F0, G0], [np.zeros((2, 6))]]))
    A, B = both[:4, :4], both[:4, 4:]
    nodes, weights = np.polynomial.legendre.leggauss(40)
    cost = np.zeros((6, 6))
    for node, weight in zip(nodes, weights, strict=True):
        Z = linalg.expm(0.5 * h * (node + 1.0) * np.block([[F0, G0], [np.zeros((2, 6))]]))
        cost += 0.5 * h * weight * Z.T @ linalg.block_diag(Q4, R2) @ Z
    cost = 0.5 * (cost + cost.T)
    K, X, _ = control.dlqr(A, B, cost[:4, :4], cost[4:, 4:], cost[:4, 4:])
    regulator = periodic_lqr(CONSTANT, Q4, R2, sample_time=h)
    np.testing.assert_allclose(regulator.gain.values, np.tile(K, (p, 1, 1)), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(regulator.cost_to_go.values[0], X, rtol=1e-8)
    estimator = periodic_kalman(CONSTANT, Q4, R2, sample_time=h)
    L, P, _ = control.dlqe(A, np.eye(4), P0, estimator.noise[0], R2)
    np.testing.assert_allclose(A @ estimator.gain.values[0], L, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(estimator.covariance.values[0], P, rtol=1e-8)


# ---- laws --------------------------------------------------------------------------------------


def test_cost_to_go_satisfies_the_differential_equation():
    regulator = periodic_lqr(SYSTEM, Q3, R1)
    X, K, psi = regulator.cost_to_go.values, regulator.gain.values, regulator.gain.azimuths
    waves = (1j * np.arange(129) * SYSTEM.omega)[:, None, None]
    rate = np.fft.irfft(np.fft.rfft(X, axis=0) * waves, axis=0)
    F = SYSTEM.F(psi)
    defect = rate + F.mT @ X + X @ F + Q3 - K.mT @ R1 @ K
    assert np.abs(defect).max() < 1e-11 * np.abs(rate).max()


def test_continuous_design_is_the_limit_of_sampled_ones():
    exact, filtered = periodic_lqr(SYSTEM, Q3, R1), periodic_kalman(SYSTEM, Q3, V2)
    errors = []
    for p in (64, 128):
        h = SYSTEM.period / p
        regulator = periodic_lqr(SYSTEM, Q3, R1, sample_time=h)
        estimator = periodic_kalman(SYSTEM, Q3, V2 / h, sample_time=h)
        errors.append(
            [
                np.abs(regulator.cost_to_go.values[0] - exact.cost_to_go.values[0]).max(),
                np.abs(estimator.covariance.values[0] - filtered.covariance.values[0]).max(),
            ]
        )
    ratio = np.divide(*errors)
    assert 3.9 < ratio[0] < 4.1  # of second order
    assert 1.9 < ratio[1] < 2.2  # of first: it is the covariance before a sample
    assert np.all(np.array(errors[1]) < [1e-3, 0.05])


def test_multipliers_are_those_of_the_loop():
    for regulator in (periodic_lqr(SYSTEM, Q3, R1), periodic_lqr(SYSTEM, Q3, R1).truncated(2)):
        K = regulator.gain
        loop = LTPSystem(lambda psi, K=K: SYSTEM.F(psi) - SYSTEM.G(psi) @ K(psi), Q3, omega=4.0)
        expected = np.exp(loop.floquet_exponents() * SYSTEM.period)
        assert np.allclose(np.sort_complex(regulator.multipliers), np.sort_complex(expected))


@pytest.mark.parametrize("p", [1, 16])
def test_cost_is_what_a_simulation_spends(p):
    def weight(psi):  # periodic, given as a callable
        return Q3 * (1.0 + 0.5 * np.cos(psi))[:, None, None]

    regulator = periodic_lqr(SYSTEM, weight, R1, sample_time=SYSTEM.period / p)
    x, spent, S = np.array([1.0, -0.5, 2.0]), 0.0, 2048
    predicted = regulator.cost(x)
    W, dt = weight(2.0 * np.pi * np.arange(S + 1) / S), SYSTEM.period / S
    Phi, Gamma = held(SYSTEM, S)
    for k in range(12 * S):
        if k % (S // p) == 0:
            u = -regulator.gain.values[k % S // (S // p)] @ x
        spent += 0.5 * dt * (x @ W[k % S] @ x) + dt * (u @ R1 @ u)  # trapezoidal rule
        x = Phi[k % S] @ x + Gamma[k % S] @ u
        spent += 0.5 * dt * (x @ W[k % S + 1] @ x)
    assert abs(spent / predicted - 1.0) < 1e-5


def test_h2_cost_of_other_gains_by_covariances():
    step, W = SYSTEM.period / 16, np.diag([1.0, 0.5, 0.0])
    best = periodic_lqr(SYSTEM, Q3, R1, sample_time=step)
    other = best.truncated(1, W)
    A, K, problem = best.problem.A, other.gain.values, best.problem
    loop, noise = A - problem.B @ K, periodic_kalman(SYSTEM, W, V2, sample_time=step).noise
    # covariance of x, forwards: the transposed equation, backwards
    back = solve_periodic_lyapunov(loop.mT[::-1], noise[::-1])
    covariance = np.roll(back[::-1], 1, axis=0)
    spent = problem.Q + K.mT @ problem.R @ K - problem.S @ K - (problem.S @ K).mT
    rate = np.einsum("kij,kji->", spent, covariance) / SYSTEM.period
    assert np.isclose(other.h2_cost(W), rate, rtol=1e-10)
    assert np.isclose(other.loss, rate / best.h2_cost(W) - 1.0, rtol=1e-6)
    assert 0.0 < other.loss <= best.truncated(1).loss  # that of the worst state


@pytest.mark.slow
@pytest.mark.parametrize("p", [None, 16])
def test_truncation_loses_less_with_more_harmonics(p):
    best = periodic_lqr(SYSTEM, Q3, R1, sample_time=None if p is None else SYSTEM.period / p)
    truncated = [best.truncated(N) for N in (1, 2, 4, 7)]
    losses = [kept.loss for kept in truncated]
    assert np.all(np.diff(losses) < 0.0)
    assert losses[0] > 0.1
    if p is None:
        assert best.with_gain(best.gain).loss < 1e-12
    for kept in truncated:
        assert abs(kept.multipliers[0]) < 1.0
        assert kept.cost([1.0, 0, 0]) > best.cost([1.0, 0, 0])


def test_unstable_truncation_says_so():
    best = periodic_lqr(SYSTEM, Q3, R1)
    bad = best.with_gain(np.zeros((1, 3)))
    assert not bad.is_stable
    assert bad.loss == np.inf
    assert bad.h2_cost(Q3) == np.inf
    assert bad.cost([1.0, 0.0, 0.0]) == np.inf
    assert bad.cost_to_go is None
    assert np.isclose(
        np.log(abs(bad.multipliers[0])), SYSTEM.period * SYSTEM.floquet_exponents()[0].real
    )
    with pytest.raises(ValueError, match="not the best one"):
        bad.truncated(0)


@pytest.mark.parametrize("p", [7, 8])
@pytest.mark.parametrize("is_held", [False, True])
def test_fourier_round_trip(p, is_held):
    values = np.random.default_rng(p).standard_normal((p, 2, 3))
    matrix = PeriodicMatrix(values, is_held)
    np.testing.assert_allclose(matrix(matrix.azimuths + 2.0 * np.pi * 5), values, atol=1e-12)
    if p % 2:
        kept = matrix.truncated(matrix.max_harmonics)
        np.testing.assert_allclose(kept.values, values, atol=1e-12)
    smooth = PeriodicMatrix(matrix.truncated(2).values)
    system = LTPSystem(np.zeros((2, 2)), np.zeros((2, 3)), omega=1.0)
    again = LTPSystem(system.F, smooth, omega=1.0).fourier_coefficients(2)[1]
    np.testing.assert_allclose(again, smooth.coefficients(2), atol=1e-12)
    between = matrix(np.array([2.9 * 2.0 * np.pi / p]))[0]
    assert np.array_equal(between, values[2]) == is_held


# ---- what cannot be done ------------------------------------------------------------------------


@pytest.mark.parametrize("step", [None, np.pi / 8])
def test_what_no_gain_stabilises_is_named(step):
    away = LTPSystem(np.diag([0.3, -1.0]), [[0.0], [1.0]], [[0.0, 1.0]], omega=2.0)
    with pytest.raises(ValueError, match=r"multiplier 2\.56633 of a period: no input reaches"):
        periodic_lqr(away, np.eye(2), [[1.0]], sample_time=step)
    with pytest.raises(ValueError, match=r"multiplier 2\.56633 of a period: no output sees"):
        periodic_kalman(away, np.eye(2), [[1.0]], sample_time=step)
    still = LTPSystem(np.diag([0.0, -1.0]), [[1.0], [1.0]], [[1.0, 1.0]], omega=2.0)
    with pytest.raises(ValueError, match=r"multiplier 1 .* Q does not see this motion"):
        periodic_lqr(still, np.diag([0.0, 1.0]), [[1.0]], sample_time=step)
    with pytest.raises(ValueError, match=r"multiplier 1 .* W does not drive this motion"):
        periodic_kalman(still, np.diag([0.0, 1.0]), [[1.0]], sample_time=step)


def test_an_input_out_of_phase_with_the_motion_is_found_out():
    system = LTPSystem([[0.0]], [[[0.0]], [[1.0]], [[0.0]]], omega=2.0)  # G = cos ψ
    assert periodic_lqr(system, [[1.0]], [[1.0]]).is_stable
    with pytest.raises(ValueError, match="no input reaches"):  # held for a whole period
        periodic_lqr(system, [[1.0]], [[1.0]], sample_time=np.pi)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((np.eye(2), R1), "Q is 2 x 2; it must be 3 x 3"),
        ((np.diag([1.0, 1.0, -1.0]), R1), "Q must be positive semidefinite; .* is -1"),
        ((np.triu(np.ones((3, 3))), R1), "Q is not symmetric"),
        ((Q3, [[0.0]]), "R must be positive definite"),
        ((lambda psi: Q3 * np.cos(psi)[:, None, None], R1), r"at psi = 3\.142 rad"),
    ],
)
def test_weights_that_are_none(arguments, words):
    with pytest.raises(ValueError, match=words):
        periodic_lqr(SYSTEM, *arguments)


def test_other_arguments():
    with pytest.raises(ValueError, match="not a whole number"):
        periodic_lqr(SYSTEM, Q3, R1, sample_time=0.3)
    with pytest.raises(ValueError, match="must be an LTPSystem"):
        periodic_lqr(control.ss(F0, G0, P0, 0), Q4, R2)
    with pytest.raises(ValueError, match="noise_input is 2 x 1; it must have 3 rows"):
        periodic_kalman(SYSTEM, [[1.0]], V2, noise_input=np.ones((2, 1)))
    best = periodic_lqr(SYSTEM, Q3, R1, sample_time=SYSTEM.period / 8)
    with pytest.raises(ValueError, match="give 3 at most"):
        best.truncated(4)
    with pytest.raises(ValueError, match="a PeriodicMatrix of 8 samples 1 x 3"):
        best.with_gain(np.ones((2, 3)))
    with pytest.raises(ValueError, match="x0 has shape"):
        best.cost([1.0])
    with pytest.raises(ValueError, match="design both with the same"):
        best.lqg_cost(periodic_kalman(SYSTEM, Q3, V2))
    with pytest.raises(ValueError, match="samples"):
        PeriodicMatrix(np.ones(3))


# ---- on line -------------------------------------------------------------------------------------


def pair(p=16, V=V2):
    step = SYSTEM.period / p
    regulator = periodic_lqr(SYSTEM, Q3, R1, sample_time=step)
    return regulator, periodic_kalman(SYSTEM, Q3, V, sample_time=step)


def test_lqg_cost_is_that_of_the_joint_system():
    regulator, estimator = pair()
    p, C, V = 16, np.eye(2, 3), V2
    A, B = held(SYSTEM, p)
    K, L = regulator.gain.values, estimator.gain.values
    # x and x̂⁻; u = −K (x̂⁻ + L (C x + v − C x̂⁻))
    joint, entered = np.empty((p, 6, 6)), np.empty((p, 6, 6))
    looked = [np.hstack([-K[k] @ L[k] @ C, -K[k] @ (np.eye(3) - L[k] @ C)]) for k in range(p)]
    for k in range(p):
        estimate = np.hstack([L[k] @ C, np.eye(3) - L[k] @ C])
        joint[k] = np.vstack(
            [np.hstack([A[k], np.zeros((3, 3))]) + B[k] @ looked[k],
             A[k] @ estimate + B[k] @ looked[k]]
        )  # fmt: skip
        sensed = np.vstack([-B[k] @ K[k] @ L[k], (A[k] - B[k] @ K[k]) @ L[k]])
        entered[k] = sensed @ V @ sensed.T
        entered[k, :3, :3] += estimator.noise[k]
    back = solve_periodic_lyapunov(joint.mT[::-1], entered[::-1])
    covariance = np.roll(back[::-1], 1, axis=0)
    rate, problem = 0.0, regulator.problem
    for k in range(p):
        z = np.vstack([np.eye(3, 6), looked[k]])  # x and u of the joint state
        W = np.block([[problem.Q[k], problem.S[k]], [problem.S[k].T, problem.R[k]]])
        KL = K[k] @ L[k]
        rate += np.trace(W @ z @ covariance[k] @ z.T) + np.trace(problem.R[k] @ KL @ V @ KL.T)
    assert np.isclose(rate / SYSTEM.period, regulator.lqg_cost(estimator), rtol=1e-9)


def test_continuous_lqg_cost_is_the_limit():
    exact = periodic_lqr(SYSTEM, Q3, R1).lqg_cost(periodic_kalman(SYSTEM, Q3, V2))
    rates = []
    for p in (64, 128):
        regulator, estimator = pair(p, V2 * p / SYSTEM.period)
        rates.append(regulator.lqg_cost(estimator))
    assert np.abs(np.array(rates) / exact - 1.0).max() < 0.01


def test_observer_with_a_covariance_is_least_squares():
    _, estimator = pair()
    rng, n_steps, start = np.random.default_rng(1), 12, np.diag([1.0, 4.0, 0.5])
    u, y = rng.standard_normal((n_steps, 1)), rng.standard_normal((n_steps, 2))
    observer = estimator.observer()
    observer.reset([0.1, 0.2, 0.3], start, psi=3 * 2.0 * np.pi / 16)
    for k in range(n_steps):
        found = observer.step(u[k - 1] if k else [np.pi], y[k] if k != 5 else None)
    # the same in one go: the mean and covariance of all states, given all outputs but one
    (A, B), C = held(SYSTEM, 16), np.eye(2, 3)
    mean, joint = [np.array([0.1, 0.2, 0.3])], np.zeros((3 * n_steps, 3 * n_steps))
    joint[:3, :3] = start
    for k in range(1, n_steps):
        at, now, before = (k + 2) % 16, slice(3 * k, 3 * k + 3), slice(0, 3 * k)
        mean.append(A[at] @ mean[-1] + B[at] @ u[k - 1])
        joint[now, before] = A[at] @ joint[3 * k - 3 : 3 * k, before]
        joint[before, now] = joint[now, before].T
        joint[now, now] = A[at] @ joint[3 * k - 3 : 3 * k, now] + estimator.noise[at]
    seen = np.kron(np.delete(np.eye(n_steps), 5, axis=0), C)
    known = np.delete(y, 5, axis=0).ravel()
    spread = seen @ joint @ seen.T + np.kron(np.eye(n_steps - 1), V2)
    gain = joint[-3:] @ seen.T @ np.linalg.inv(spread)
    np.testing.assert_allclose(found, mean[-1] + gain @ (known - seen @ np.concatenate(mean)))
    np.testing.assert_allclose(
        observer.covariance, joint[-3:, -3:] - gain @ seen @ joint[:, -3:], atol=1e-10
    )


def test_observer_settles_on_the_periodic_gains():
    _, estimator = pair()
    steady, starting = estimator.observer(), estimator.observer()
    starting.reset(covariance=100.0 * np.eye(3))
    for y in np.random.default_rng(2).standard_normal((96, 2)):
        last = steady.step([0.0], y), starting.step([0.0], y)
    np.testing.assert_allclose(*last, atol=1e-8)
    np.testing.assert_allclose(starting.covariance, steady.covariance, atol=1e-8)
    assert np.isclose(steady.psi, 0.0)


def test_controller_holds_the_machine_about_its_trim():
    regulator, estimator = pair()
    rng = np.random.default_rng(3)
    trim = rng.standard_normal((16, 2))
    controller = OutputFeedback(regulator, estimator, input_trim=[5.0], output_trim=trim)
    controller.reset(psi=np.pi)
    A, B = held(SYSTEM, 16)
    x = np.array([1.0, -1.0, 0.5])
    for k in range(8, 8 + 200):
        u = controller.control(x[:2] + trim[k % 16])
        x = A[k % 16] @ x + B[k % 16] @ (u - 5.0)
    assert np.abs(x).max() < 1e-8
    assert abs(u[0] - 5.0) < 1e-7


def test_a_limited_input_can_be_told():
    regulator, estimator = pair()
    told, untold = OutputFeedback(regulator, estimator), OutputFeedback(regulator, estimator)
    plain = estimator.observer()
    for controller in (told, untold):
        controller.control([1.0, 0.0])
    plain.step([0.0], [1.0, 0.0])
    told.control([0.9, 0.1], applied=[0.0])
    untold.control([0.9, 0.1])
    np.testing.assert_allclose(told.observer.state, plain.step([0.0], [0.9, 0.1]))
    assert np.abs(told.observer.state - untold.observer.state).max() > 1e-3


def test_feedthrough_is_of_the_inputs_held_until_the_sample():
    system = LTPSystem([[-1.0]], [[1.0]], [[1.0]], [[2.0]], omega=2.0)
    observer = periodic_kalman(system, [[1.0]], [[1e-12]], sample_time=np.pi / 8).observer()
    assert np.allclose(observer.step([3.0], [7.0]), 1.0)


def test_on_line_arguments():
    _, estimator = pair()
    with pytest.raises(ValueError, match="does not run on line"):
        Observer(periodic_kalman(SYSTEM, Q3, V2))
    with pytest.raises(ValueError, match="does not run on line"):
        OutputFeedback(periodic_lqr(SYSTEM, Q3, R1), estimator)
    with pytest.raises(ValueError, match="do not fit"):
        OutputFeedback(periodic_lqr(SYSTEM, Q3, R1, sample_time=SYSTEM.period / 8), estimator)
    observer = estimator.observer()
    with pytest.raises(ValueError, match="lies between the 16 samples"):
        observer.reset(psi=0.1)
    with pytest.raises(ValueError, match="y has shape"):
        observer.step([0.0], [1.0])
    with pytest.raises(ValueError, match="u holds NaN"):
        observer.step([np.nan], [1.0, 0.0])
    with pytest.raises(ValueError, match="covariance must be positive semidefinite"):
        observer.reset(covariance=-np.eye(3))
    with pytest.raises(ValueError, match="or one at each of the 16 samples"):
        estimator.observer(output_trim=np.zeros((3, 2)))


def test_designs_can_be_pickled():
    mass = mathieu()
    step = mass.period / 8
    designed = (
        periodic_lqr(mass, np.eye(2), [[1.0]], sample_time=step),
        periodic_lqr(mass, np.eye(2), [[1.0]]),
        periodic_kalman(mass, np.eye(2), np.eye(2), sample_time=step),
        periodic_kalman(mass, np.eye(2), np.eye(2)),
    )
    for each in designed:
        again = pickle.loads(pickle.dumps(each))
        assert np.array_equal(again.gain.values, each.gain.values)
