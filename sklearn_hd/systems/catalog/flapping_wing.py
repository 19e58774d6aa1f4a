"""The flapping wing whose identification the paper reports."""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._checks import check_numbers, check_positive
from sklearn_hd.systems.linearization import states_measured
from sklearn_hd.systems.periodic import PeriodicSystem

__all__ = ["flapping_wing"]


def flapping_wing(
    *,
    k_d1=0.0355222804,
    k_d2=0.335296893,
    k_d3=16.6471651,
    k_L=6.27088723e-4,
    inverse_inertia=7.256e6,
    omega=2.0 * np.pi * 26.3,
    gravity=9.81,
):
    """Vertical flight of a flapping-wing micro air vehicle the size of a hawkmoth.

        ẇ  = g − k_d1 |φ̇| w − k_L φ̇²                                     (Eq. 23)
        φ̈  = −k_d2 |φ̇| φ̇ − k_d3 w φ̇ + (U / I_f) cos ωt

    States and outputs are the vertical speed w (m/s, positive down) and the flapping
    speed φ̇ (rad/s), ``w`` and ``phi_dot``; the input ``U`` is the amplitude of the
    flapping torque. The trim asks for a mean w of zero and finds U.

    Parameters
    ----------
    k_d1, k_d2, k_d3, k_L : float
        Coefficients of drag and lift: k_d1 in 1/rad, k_d2 dimensionless, k_d3 in 1/m,
        k_L in m. Drag may be zero, lift must be positive: it carries the weight.
    inverse_inertia : float
        1 / I_f in 1/(kg m²).
    omega : float
        Flapping frequency in rad/s.
    gravity : float
        In m/s².

    Returns
    -------
    system : PeriodicSystem
        With its derivatives, and the guess and the target of its trim.

    Raises
    ------
    ValueError
        If a coefficient is out of its range.

    Notes
    -----
    The paper does not print its parameters. The defaults were recovered from its
    printed matrices: a trim of two harmonics, decomposed with N = 1, gives all digits
    of its Eqs. 25 and 26 (which are truncated). They are one feasible set.

    References
    ----------
    M. A. Hayajnh, U. Saetti, J. V. R. Prasad, Aerospace 2024, 11(11), 875, Eq. 23.

    Examples
    --------
    >>> system = flapping_wing()
    >>> trim = system.trim(n_harmonics=2)
    >>> print(f"U* = {trim.inputs[0]:.8f}")
    U* = 0.00421696
    >>> hd = system.linearize(trim).harmonic_decomposition(1)
    >>> print(f"{hd.A[0, 0]:.3f}")
    -4.000
    """
    check_numbers("nonnegative", "it is a coefficient of drag", k_d1=k_d1, k_d2=k_d2, k_d3=k_d3)
    hint = "without it no trim carries the weight"
    check_numbers("positive", hint, k_L=k_L, inverse_inertia=inverse_inertia, gravity=gravity)
    omega = check_positive("omega", omega, "rad/s", "it is the flapping frequency")
    wing = _FlappingWing(k_d1, k_d2, k_d3, k_L, inverse_inertia, omega, gravity)
    return PeriodicSystem(
        wing,
        period=2.0 * np.pi / omega,
        state_names=["w", "phi_dot"],
        input_names=["U"],
        jacobian=wing.jacobian,
        trim_guess=wing.trim_guess(),
        trim_targets={"w": 0.0},
    )


@dataclass(frozen=True)
class _FlappingWing:
    """Right-hand side of the flapping wing and its derivatives."""

    k_d1: float
    k_d2: float
    k_d3: float
    k_L: float
    inverse_inertia: float
    omega: float
    gravity: float

    def __call__(self, x, u, t):
        w, speed = x
        size = abs(speed)
        torque = self.inverse_inertia * u[0] * np.cos(self.omega * t)
        return np.array(
            [
                self.gravity - self.k_d1 * size * w - self.k_L * speed * speed,
                -self.k_d2 * size * speed - self.k_d3 * w * speed + torque,
            ]
        )

    def jacobian(self, x, u, t):
        w, speed = x
        size, sign = np.abs(speed), np.sign(speed)
        F = np.empty((len(t), 2, 2))
        F[:, 0, 0] = -self.k_d1 * size
        F[:, 0, 1] = -self.k_d1 * sign * w - 2.0 * self.k_L * speed
        F[:, 1, 0] = -self.k_d3 * speed
        F[:, 1, 1] = -2.0 * self.k_d2 * size - self.k_d3 * w
        G = np.zeros((len(t), 2, 1))
        G[:, 1, 0] = self.inverse_inertia * np.cos(self.omega * t)
        return states_measured(F, G)

    def trim_guess(self):
        """First harmonic of φ̇ whose mean lift carries the weight, and its torque.

        φ̇ ≈ a cos(ψ − δ) with k_L a² / 2 = g; |φ̇| φ̇ has the first harmonic 8 a² / 3π.
        """
        amplitude = np.sqrt(2.0 * self.gravity / self.k_L)
        inertia, drag = self.omega * amplitude, self.k_d2 * 8.0 / (3.0 * np.pi) * amplitude**2
        torque = np.hypot(inertia, drag)
        coefficients = np.zeros((3, 2))
        coefficients[1:, 1] = amplitude * np.array([drag, inertia]) / torque
        return coefficients, np.array([torque / self.inverse_inertia])
