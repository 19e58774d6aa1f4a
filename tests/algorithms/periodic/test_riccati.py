"""Periodic Riccati and Lyapunov equations: by their own equations, lifted, and in closed form."""

import numpy as np
import pytest
from scipy import linalg

from sklearn_hd.algorithms.periodic.riccati import (
    composed,
    defect_and_loop,
    hamiltonian_triples,
    multipliers_of,
    riccati_triples,
    solve_periodic_lyapunov,
    solve_periodic_riccati,
    unreachable_multipliers,
)


def orthogonal(rng, n):
    return linalg.qr(rng.standard_normal((n, n)))[0]


def random_problem(seed):
    """A, B, Q, R, S of up to 12 states and 64 steps, multipliers from 1e-8 to 10."""
    rng = np.random.default_rng(seed)
    n, m, p = rng.integers(1, 13), rng.integers(1, 4), int(rng.choice([1, 2, 3, 5, 8, 16, 64]))
    sizes = 10.0 ** rng.uniform(-8.0, 1.0, n)
    bases = [
        orthogonal(rng, n) @ np.diag(10 ** rng.uniform(-0.5, 0.5, n)) @ orthogonal(rng, n)
        for _ in range(p)
    ]
    signs = [rng.choice([-1.0, 1.0], n), *np.ones((p - 1, n))]
    A = np.array(
        [
            bases[(k + 1) % p] @ np.diag(sizes ** (1 / p) * signs[k]) @ np.linalg.inv(bases[k])
            for k in range(p)
        ]
    )
    root = 10.0 ** rng.uniform(-2.0, 2.0) * rng.standard_normal((p, n + m, n + m))
    weights = root @ root.mT
    R = weights[:, n:, n:] + 1e-3 * np.eye(m)
    return A, rng.standard_normal((p, n, m)), weights[:, :n, :n], R, weights[:, :n, n:]


def relative_defect(A, B, Q, R, S, X):
    after = np.roll(X, -1, axis=0)
    L = A.mT @ after @ B + S
    defect = Q + A.mT @ after @ A - L @ np.linalg.solve(R + B.mT @ after @ B, L.mT) - X
    return np.max(np.linalg.norm(defect, axis=(1, 2)) / np.linalg.norm(X, axis=(1, 2)))


@pytest.mark.slow
def test_hundred_random_systems_satisfy_the_equation_and_are_stable():
    for seed in range(100, 200):  # 132 too: eleven states, one input, X of 2e10
        problem = random_problem(seed)
        A, G, H = riccati_triples(*problem)
        X = solve_periodic_riccati(A, G, H)
        assert relative_defect(*problem, X) < 1e-10, seed
        assert np.abs(multipliers_of(defect_and_loop(A, G, H, X)[1])[0]) < 1.0, seed
        assert np.linalg.eigvalsh(X).min() > -1e-10 * np.abs(X).max(), seed


def test_units_of_the_states_do_not_matter():
    for seed in range(20):
        A, B, Q, R, S = random_problem(seed)
        d = 10.0 ** np.random.default_rng(seed).uniform(-6.0, 6.0, A.shape[1])
        X = solve_periodic_riccati(
            *riccati_triples(A * (d / d[:, None]), B / d[:, None], Q * (d * d[:, None]), R,
                             S * d[:, None])
        )  # fmt: skip
        assert relative_defect(A, B, Q, R, S, X / (d * d[:, None])) < 1e-10


@pytest.mark.parametrize("seed", range(30))
def test_agrees_with_the_lifted_system(seed):
    rng = np.random.default_rng(seed)
    n, m, p = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 5)
    A, B = rng.standard_normal((p, n, n)), rng.standard_normal((p, n, m))
    root = rng.standard_normal((p, n + m, n + m))
    W = root @ root.mT + 0.1 * np.eye(n + m)
    problem = A, B, W[:, :n, :n], W[:, n:, n:], W[:, :n, n:]
    X = solve_periodic_riccati(*riccati_triples(*problem))
    moved, cost = np.eye(n, n + p * m), np.zeros((n + p * m, n + p * m))
    for k in range(p):  # x_k and u_k from x_0 and all inputs of the period
        both = np.vstack([moved, np.eye(m, n + p * m, n + k * m)])
        cost += both.T @ W[k] @ both
        moved = np.hstack([A[k], B[k]]) @ both
    lifted = linalg.solve_discrete_are(
        moved[:, :n], moved[:, n:], cost[:n, :n], cost[n:, n:], s=cost[:n, n:]
    )
    assert np.linalg.norm(X[0] - lifted) < 1e-9 * np.linalg.norm(lifted)


def test_a_factor_may_be_singular():
    A = np.array([[[2.0, 1.0], [0.0, 3.0]], [[1.0, 0.0], [0.0, 0.0]]])
    one = np.tile(np.eye(2), (2, 1, 1))
    problem = A, one, one, one, 0.0 * one
    assert relative_defect(*problem, solve_periodic_riccati(*riccati_triples(*problem))) < 1e-14


def test_what_costs_nothing_is_mirrored_at_the_unit_circle():
    A, B = np.diag([2.0, 0.9, 0.3])[None], np.ones((1, 3, 1))
    V = orthogonal(np.random.default_rng(0), 3)
    A, B = V @ A @ V.T, V @ B
    A, G, H = riccati_triples(A, B, np.zeros((1, 3, 3)), np.ones((1, 1, 1)))
    found = multipliers_of(defect_and_loop(A, G, H, solve_periodic_riccati(A, G, H))[1])
    assert np.allclose(found, [0.9, 0.5, 0.3], atol=1e-12)


@pytest.mark.parametrize("value", [1.0, -1.0])
def test_what_costs_nothing_stays_on_the_unit_circle(value):
    A, B, Q = np.diag([value, 0.5])[None], np.ones((1, 2, 1)), np.diag([0.0, 1.0])[None]
    V = orthogonal(np.random.default_rng(0), 2)
    A, G, H = riccati_triples(V @ A @ V.T, V @ B, V @ Q @ V.T, np.ones((1, 1, 1)))
    found = multipliers_of(defect_and_loop(A, G, H, solve_periodic_riccati(A, G, H))[1])
    assert abs(found[0] - value) < 1e-8


@pytest.mark.parametrize("seed", range(10))
def test_lyapunov_equation(seed):
    A, B, Q, R, _ = random_problem(seed)
    A, G, H = riccati_triples(A, B, Q, R)
    loop = defect_and_loop(A, G, H, solve_periodic_riccati(A, G, H))[1]
    X = solve_periodic_lyapunov(loop, Q)
    defect = Q + loop.mT @ np.roll(X, -1, axis=0) @ loop - X
    assert np.max(np.abs(defect)) < 1e-12 * np.max(np.abs(X))


def test_composition_is_associative_and_maps_as_its_steps_do():
    A, G, H = riccati_triples(*random_problem(3)[:4])
    whole = composed(A, G, H)
    for joined, one in zip(
        composed(*(np.tile(M, (4, 1, 1)) for M in (A, G, H))),
        composed(*(np.tile(M, (4, 1, 1)) for M in whole)),
        strict=True,
    ):
        assert np.allclose(joined, one, rtol=1e-10, atol=1e-10 * np.abs(one).max())  # fmt: skip


@pytest.mark.parametrize("seed", range(40))
def test_a_motion_that_no_input_reaches_is_named(seed):
    A, B, _, R, _ = random_problem(seed)
    p, n, _ = A.shape
    G = B @ np.linalg.solve(R, B.mT)
    assert not len(unreachable_multipliers(A, G))
    if n == 1:
        return
    A, B = A.copy(), B.copy()
    A[:, 0, 1:], A[:, 0, 0], B[:, 0] = 0.0, 1.5 ** (1 / p), 0.0
    V = np.array([orthogonal(np.random.default_rng(seed + k), n) for k in range(p)])
    after = np.roll(V, -1, axis=0)
    A, B = after @ A @ V.mT, after @ B
    found = unreachable_multipliers(A, B @ np.linalg.solve(R, B.mT))
    assert np.min(np.abs(found - 1.5), initial=np.inf) < 1e-6


def test_one_of_two_like_motions_is_out_of_reach():
    V = orthogonal(np.random.default_rng(1), 3)
    A, B = V @ np.diag([2.0, 2.0, 0.5]) @ V.T, V @ np.array([[1.0], [1.0], [1.0]])
    assert np.allclose(unreachable_multipliers(A[None], (B @ B.T)[None]), 2.0)


def test_hamiltonian_triples_are_van_loans_integrals():
    F, E, Q = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.diag([0.0, 2.0]), np.diag([3.0, 1.0])
    psi, omega, n = np.array([0.0, 0.7, 2.0]), 2.0, 2

    def constant(M):
        return lambda psi: np.broadcast_to(M, (len(psi), 2, 2))

    triples = (
        hamiltonian_triples(constant(F), None, constant(Q), psi, omega),
        hamiltonian_triples(constant(F), constant(E), None, psi, omega),
    )
    for k, h in enumerate(np.diff(psi) / omega):
        Phi = linalg.expm(F * h)
        cost = linalg.expm(np.block([[-F.T, Q], [np.zeros((n, n)), F]]) * h)
        noise = linalg.expm(np.block([[-F, E], [np.zeros((n, n)), F.T]]) * h)
        for triple in triples:
            assert np.allclose(triple[0][k], Phi, atol=1e-13)
        assert np.allclose(triples[0][2][k], Phi.T @ cost[:n, n:], atol=1e-13)
        assert np.allclose(triples[1][1][k], Phi @ noise[:n, n:], atol=1e-13)


def test_multipliers_far_apart():
    rng = np.random.default_rng(0)
    V = [orthogonal(rng, 3) for _ in range(20)]
    factors = np.array([V[(k + 1) % 20] @ np.diag([1.05, 0.5, 1e-5]) @ V[k].T for k in range(20)])
    assert np.allclose(multipliers_of(factors), np.array([1.05, 0.5, 1e-5]) ** 20, rtol=1e-8)
