"""Systems driven by inputs and noise, in open and in closed loop."""

from dataclasses import dataclass

import numpy as np
from conftest import random_stable
from scipy import linalg

from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations

STEP = 2 * np.pi / 7.3  # of the periodic models
N_STATES, N_INPUTS, N_OUTPUTS = 3, 2, 2


@dataclass(frozen=True)
class InnovationSystem:
    """x[k+1] = A x + B u + K e, y = C x + D u + e, cov e = E."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    K: np.ndarray
    E: np.ndarray

    def markov(self, matrix, n=8):
        """C A^j times a matrix."""
        powers = [np.linalg.matrix_power(self.A, j) for j in range(n)]
        return np.array([self.C @ P @ matrix for P in powers])

    def simulate(self, rng, n_samples, *, feedback=None, noise=1.0):
        """u, y and e, with u = v − F y[k − 1] and white v."""
        n, m, n_outputs = len(self.A), self.B.shape[1], len(self.C)
        root = np.linalg.cholesky(self.E) * noise
        e = rng.standard_normal((n_samples, n_outputs)) @ root.T
        u = rng.standard_normal((n_samples, m))
        y, x, before = np.empty((n_samples, n_outputs)), np.zeros(n), np.zeros(n_outputs)
        for k in range(n_samples):
            if feedback is not None:
                u[k] -= feedback @ before
            y[k] = self.C @ x + e[k]
            x, before = self.A @ x + self.B @ u[k] + self.K @ e[k], y[k]
        return u, y, e


def disturbed(rng, n, m, n_outputs, *, radius=0.9, strength=0.3):
    """A random system whose states white noise drives, and the optimal gain of its filter."""
    A, B, C = random_stable(rng, n, m, n_outputs, radius=radius)
    root = strength * rng.standard_normal((n, n))
    R = np.eye(n_outputs)
    P = linalg.solve_discrete_are(A.T, C.T, root @ root.T, R)
    E = C @ P @ C.T + R
    return InnovationSystem(A, B, C, A @ P @ C.T @ np.linalg.inv(E), E)


def in_closed_loop():
    """An unstable system and the feedback that holds it."""
    A = np.array([[1.05, 0.2, 0.0], [0.0, 0.8, 0.3], [0.0, 0.0, 0.5]])
    B, C = np.array([[0.5], [0.3], [1.0]]), np.array([[1.0, 0.0, 0.0]])
    Q = 0.1 * np.diag([1.0, 1.0, 0.5])
    P = linalg.solve_discrete_are(A.T, C.T, Q, np.eye(1))
    E = C @ P @ C.T + np.eye(1)
    system = InnovationSystem(A, B, C, A @ P @ C.T @ np.linalg.inv(E), E)
    feedback = np.array([[0.25]])
    whole = np.block([[A, -B @ feedback], [C, np.zeros((1, 1))]])
    assert np.max(np.abs(np.linalg.eigvals(A))) > 1.0 > np.max(np.abs(np.linalg.eigvals(whole)))
    return system, feedback


def drawn(seed=0, n_harmonics=1, size=0.5):
    """A stable model with loads of one more harmonic."""
    rng = np.random.default_rng(seed)
    shape = (2 * n_harmonics + 3, N_STATES + N_OUTPUTS, N_STATES + N_INPUTS + 1)
    coefficients = 0.3 * rng.standard_normal(shape)
    coefficients[-2:, :, :-1] = 0.0
    coefficients[:, :N_STATES, :N_STATES] *= 0.3
    coefficients[0, :N_STATES, :N_STATES] += np.diag([size, -0.4, 0.2])
    gain = 0.1 * rng.standard_normal((len(coefficients), N_STATES, N_OUTPUTS))
    gain[-2:] = 0.0
    return PeriodicInnovations(coefficients, gain, np.diag([0.04, 0.09]), STEP, 0.2)


def record(model, n_rows=80, seed=1, noise=1.0, inputs=1.0):
    """Inputs, outputs, azimuths and states, row by row."""
    rng = np.random.default_rng(seed)
    psi = model.start + model.step * np.arange(n_rows)
    u = inputs * rng.standard_normal((n_rows, N_INPUTS))
    e = noise * rng.standard_normal((n_rows, N_OUTPUTS)) @ np.sqrt(model.covariance)
    values, K = evaluate_harmonics(model.coefficients, psi), evaluate_harmonics(model.gain, psi)
    x, y, states = (
        rng.standard_normal(N_STATES),
        np.empty((n_rows, N_OUTPUTS)),
        np.empty((n_rows, N_STATES)),
    )
    for k in range(n_rows):
        states[k] = x
        both = values[k] @ np.concatenate([x, u[k], [1.0]])
        y[k], x = both[N_STATES:] + e[k], both[:N_STATES] + K[k] @ e[k]
    return u, y, psi, states


def multipliers(model):
    """Logarithms of a periodic model's multipliers, sorted."""
    return np.sort_complex(model.multiplier_logarithms())
