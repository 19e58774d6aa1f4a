"""Multi-blade coordinates of a rotor with three blades (Coleman's transformation).

Blade b of three stands at ψ_b = ψ + 2π (b − 1) / 3. Its coordinate is

    q_b = q_mean + q_cos cos ψ_b + q_sin sin ψ_b,       q = t(ψ) z

with z in the frame that does not turn. Rates follow, q̇ = t ż + Ω t′ z, so that the whole
state is x = T(ψ) z, and a system ẋ = A x + B u, y = C x + D u becomes

    ż = T⁻¹ (A T − Ṫ) z + T⁻¹ B T_u v,   w = T_y⁻¹ C T z + T_y⁻¹ D T_u v

Where the blades are alike and the wind does not depend on the azimuth, what is left to vary
in it repeats itself three times a turn (and 6, 9, … times), and mostly is small.
Turbines of ``sklearn_hd.systems`` need it.
"""

from typing import NamedTuple

import numpy as np

from sklearn_hd.algorithms.signals.fourier import harmonic_functions, sampled_harmonics

N_BLADES = 3


class Frame(NamedTuple):
    """Which signals turn with the blades.

    ``states``, ``inputs`` and ``outputs`` are lists of triplets: the positions of the
    same signal on blades 1, 2, 3. ``rates`` leads from a triplet of states to that of
    their rates, where these are states too.
    """

    states: list
    rates: dict
    inputs: list
    outputs: list


def coleman_matrix(psi, derivative=0):
    """t(ψ) of three blades, or a derivative of it by ψ.

    ψ is the azimuth of blade 1. ``derivative`` is the order of the derivative.

    Examples
    --------
    >>> coleman_matrix([0.0])[0].round(3).tolist()
    [[1.0, 1.0, 0.0], [1.0, -0.5, 0.866], [1.0, -0.5, -0.866]]
    """
    blades = np.asarray(psi, dtype=float)[:, None] + 2.0 * np.pi / N_BLADES * np.arange(N_BLADES)
    turned = blades + derivative * np.pi / 2.0
    mean = np.full_like(blades, float(derivative == 0))
    return np.stack([mean, np.cos(turned), np.sin(turned)], axis=-1)


def to_multiblade(matrices, psi, omega, frame):
    """Matrices of a rotor in multi-blade coordinates.

    ``matrices`` are A, B, C and D at each azimuth of blade 1,
    (n_points, rows, columns).
    """
    A, B, C, D = matrices
    T, T_dot, T_u, T_y = _transformations(matrices, psi, omega, frame)
    return (
        np.linalg.solve(T, A @ T - T_dot),
        np.linalg.solve(T, B @ T_u),
        np.linalg.solve(T_y, C @ T),
        np.linalg.solve(T_y, D @ T_u),
    )


def from_multiblade(coefficients, omega, frame):
    """Fourier coefficients of a rotor's matrices on its turning blades, exact.

    ``coefficients`` are those of A, B, C and D in multi-blade coordinates. They are the
    harmonics 0, 3c, 3s, 6c, … of the azimuth, (2 K + 1, rows, columns). Returns those
    of F, G, P and Q, (2 (3 K + 2) + 1, rows, columns), in the order 0, 1c, 1s, ….
    """
    K = len(coefficients[0]) // 2
    highest = N_BLADES * K + 2  # products of two entries of t
    n_points = 2 * highest + 2
    psi = 2.0 * np.pi * np.arange(n_points) / n_points
    functions = harmonic_functions(psi, blade_harmonics(K))
    A, B, C, D = fixed = tuple(np.tensordot(functions, M, axes=(1, 0)) for M in coefficients)
    T, T_dot, T_u, T_y = _transformations(fixed, psi, omega, frame)
    turning = (
        _right_divided(T @ A + T_dot, T),
        _right_divided(T @ B, T_u),
        _right_divided(T_y @ C, T),
        _right_divided(T_y @ D, T_u),
    )
    return tuple(sampled_harmonics(M, highest) for M in turning)


def blade_harmonics(n_harmonics):
    """Harmonics of the azimuth that three equal blades leave: 0, 3, 6, …, 3 K."""
    return [N_BLADES * k for k in range(n_harmonics + 1)]


def _transformations(matrices, psi, omega, frame):
    """T, Ṫ, T_u and T_y at each azimuth."""
    A, B, C, _ = matrices
    turns = [omega**order * coleman_matrix(psi, order) for order in range(3)]
    T = _turned(turns[0], A.shape[1], frame.states)
    T_dot = np.zeros_like(T)
    _place(T_dot, frame.states, frame.states, turns[1])
    positions, rates = list(frame.rates), list(frame.rates.values())
    _place(T, rates, positions, turns[1])
    _place(T_dot, rates, positions, turns[2])
    return (
        T,
        T_dot,
        _turned(turns[0], B.shape[2], frame.inputs),
        _turned(turns[0], C.shape[1], frame.outputs),
    )


def _turned(t, size, triplets):
    """Block-diagonal transformation: t for each triplet, one for what does not turn."""
    T = np.tile(np.eye(size), (len(t), 1, 1))
    _place(T, triplets, triplets, t)
    return T


def _place(T, rows, columns, block):
    for row, column in zip(rows, columns, strict=True):
        T[:, np.array(row)[:, None], np.array(column)] = block


def _right_divided(numerator, T):
    """numerator T⁻¹ at each azimuth."""
    return np.linalg.solve(T.transpose(0, 2, 1), numerator.transpose(0, 2, 1)).transpose(0, 2, 1)
