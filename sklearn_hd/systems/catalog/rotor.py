"""Rotor blades."""

import numpy as np

from sklearn_hd._checks import check_numbers, check_positive
from sklearn_hd.systems.ltp import LTPSystem

__all__ = ["flapping_blade"]


def flapping_blade(*, gamma=8.0, mu=0.3, nu=1.0, omega=1.0):
    """Flapping of a rigid, hinged rotor blade in forward flight.

        β″ + γ/8 (1 + 4/3 μ sin ψ) β′ + (ν² + γ/8 (4/3 μ cos ψ + μ² sin 2ψ)) β
            = γ/8 (1 + 8/3 μ sin ψ + 2 μ² sin² ψ) θ

    with ′ = d/dψ and ψ = Ωt, ψ = 0 over the tail. States and outputs are the flap
    angle β (rad) and its rate dβ/dt (rad/s), ``beta`` and ``beta_dot``; the input
    ``theta_0`` is the collective pitch (rad).

    The exponents sum to −γ Ω / 8 for every μ; in hover (μ = 0) they are
    Ω (−γ/16 ± j √(ν² − (γ/16)²)), up to multiples of jΩ.

    Parameters
    ----------
    gamma : float, default=8.0
        Lock number γ.
    mu : float, default=0.3
        Advance ratio μ, forward speed over tip speed.
    nu : float, default=1.0
        Flap frequency ν in the vacuum, per revolution: 1 with the hinge on the
        axis, more with an offset or a spring.
    omega : float, default=1.0
        Rotor speed Ω in rad/s.

    Returns
    -------
    system : LTPSystem
        Of period 2π / Ω.

    Raises
    ------
    ValueError
        If γ, μ or ν is negative, or Ω not positive.

    Notes
    -----
    The blade has constant chord, its hinge on the axis of rotation and no root cut
    or tip loss; lift is linear and quasi-steady, and the airfoil is taken to meet
    the flow with its leading edge all over the disc (normal flow). Inside the
    reversed-flow circle, of diameter μ R on the retreating side, that gives lift of
    the wrong sign. What it misses in the flap moment is of the order of μ⁴, hence
    the model is used up to μ ≈ 0.5; results beyond are those of the equation, not of
    a rotor. With reversed flow the mean damping exceeds γ/8, and the sum rule above
    no longer holds.

    References
    ----------
    W. Johnson, *Helicopter Theory*, Princeton University Press, 1980, sections 5-5
    and 12-1 (coefficients of the normal-flow blade); J. C. Biggers, "Some
    Approximations to the Flapping Stability of Helicopter Rotors", Journal of the
    American Helicopter Society 19(4), 1974.

    Examples
    --------
    >>> hover = flapping_blade(gamma=8.0, mu=0.0, nu=1.1)
    >>> exponent = hover.floquet_exponents()[1]
    >>> bool(np.isclose(exponent.real, -0.5)), bool(np.isclose(abs(exponent.imag), 1 - 0.96**0.5))
    (True, True)
    """
    check_numbers("nonnegative", "the blade has none below zero", gamma=gamma, mu=mu, nu=nu)
    omega = check_positive("omega", omega, "rad/s", "it is the rotor speed")
    lift = gamma / 8.0
    F = np.zeros((5, 2, 2))  # harmonics 0, 1c, 1s, 2c, 2s
    F[0] = [[0.0, 1.0], [-(omega**2) * nu**2, -omega * lift]]
    F[1, 1, 0] = -(omega**2) * lift * 4.0 / 3.0 * mu
    F[2, 1, 1] = -omega * lift * 4.0 / 3.0 * mu
    F[4, 1, 0] = -(omega**2) * lift * mu**2
    G = np.zeros((5, 2, 1))
    G[0, 1, 0] = omega**2 * lift * (1.0 + mu**2)  # 2 sin² ψ = 1 − cos 2ψ
    G[2, 1, 0] = omega**2 * lift * 8.0 / 3.0 * mu
    G[3, 1, 0] = -(omega**2) * lift * mu**2
    return LTPSystem(F, G, omega=omega, state_names=["beta", "beta_dot"], input_names=["theta_0"])
