"""Named periodic systems of the literature: oscillators and a rotor blade.

Tests, documentation and examples need them; parameters are keyword arguments.
"""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._checks import check_numbers, check_positive, real_array
from sklearn_hd.systems.ltp import LTPSystem
from sklearn_hd.systems.periodic import PeriodicSystem, states_measured


def mathieu(a=2.0, q=0.5, *, damping=0.1):
    """Damped Mathieu oscillator, driven by a force.

        ÿ + d ẏ + (a − 2q cos 2t) y = u

    States and outputs are ``y`` and ``y_dot``, the input is ``u``; the period is π s.
    With ν(a, q) the characteristic exponent of the undamped equation, the Floquet
    exponents are −d/2 ± j ν(a − d²/4, q), up to multiples of 2j.

    Parameters
    ----------
    a, q : float
        Mean stiffness and half the amplitude of its change.
    damping : float, default=0.1
        Damping d in 1/s; 0 gives Mathieu's own equation, and a negative number growth.

    Returns
    -------
    system : LTPSystem
        States y and y_dot, of period π s.

    Raises
    ------
    ValueError
        If a number is not finite.

    References
    ----------
    N. W. McLachlan, *Theory and Application of Mathieu Functions*, Oxford, 1947;
    NIST Digital Library of Mathematical Functions, section 28.2.

    Examples
    --------
    >>> exponents = mathieu(2.0, 0.5, damping=0.0).floquet_exponents()
    >>> print(f"{abs(exponents[0].imag):.10f}")
    0.6304914303
    """
    check_numbers("finite", "a and q are in 1/s², the damping in 1/s", a=a, q=q, damping=damping)
    F = np.zeros((3, 2, 2))
    F[0] = [[0.0, 1.0], [-a, -damping]]
    F[1, 1, 0] = 2.0 * q
    return LTPSystem(F, [[0.0], [1.0]], omega=2.0, state_names=["y", "y_dot"], input_names=["u"])


def coupled_oscillators(
    *,
    frequencies=(1.0, 1.7),
    damping_ratios=(0.06, 0.04),
    coupling=((0.2, 0.4), (0.5, 0.3)),
    omega=2.3,
):
    """Two oscillators coupled by a periodic stiffness, each driven by a force.

        ẍ_i + 2 ζ_i ω_i ẋ_i + ω_i² x_i + cos ψ Σ_j e_ij x_j = u_i,   i = 1, 2

    States ``x1``, ``x2``, ``x1_dot``, ``x2_dot``; outputs the positions ``x1`` and
    ``x2``; inputs ``u1`` and ``u2``. The exponents sum to −2 Σ ζ_i ω_i. Near
    ω = ω_1 + ω_2 the two resonate together: undamped, and for small e, solutions
    grow like e^{σt} with σ = √(e_12 e_21 / (ω_1 ω_2)) / 4.

    Parameters
    ----------
    frequencies : pair of float
        Natural frequencies ω_1 and ω_2 in rad/s, positive.
    damping_ratios : pair of float
        Shares ζ_1 and ζ_2 of the critical damping; a negative number gives growth.
    coupling : array_like, shape (2, 2)
        Amplitudes e_ij of the coupling in 1/s².
    omega : float
        Frequency of the excitation in rad/s.

    Returns
    -------
    system : LTPSystem
        With ω that of the excitation.

    Raises
    ------
    ValueError
        If shapes differ from those above, or a frequency is not positive.

    References
    ----------
    C. S. Hsu, "On the Parametric Excitation of a Dynamic System Having Multiple
    Degrees of Freedom", Journal of Applied Mechanics 30 (1963), 367–372; A. H.
    Nayfeh, D. T. Mook, *Nonlinear Oscillations*, Wiley, 1979, section 5.4.

    Examples
    --------
    >>> system = coupled_oscillators()
    >>> system.n_states, system.n_inputs
    (4, 2)
    >>> bool(np.isclose(system.floquet_exponents().sum().real, -2 * (0.06 * 1.0 + 0.04 * 1.7)))
    True
    """
    natural = real_array("frequencies", frequencies, "two natural frequencies in rad/s")
    ratios = real_array("damping_ratios", damping_ratios, "two damping ratios")
    coupling = real_array("coupling", coupling, "stiffnesses in 1/s², of shape (2, 2)")
    if natural.shape != (2,) or ratios.shape != (2,) or coupling.shape != (2, 2):
        raise ValueError(
            f"frequencies, damping_ratios and coupling have shapes {natural.shape}, "
            f"{ratios.shape} and {coupling.shape}; two oscillators take (2,), (2,) and (2, 2)"
        )
    for i, frequency in enumerate(natural):
        check_positive(f"frequencies[{i}]", float(frequency), "rad/s", "oscillators have one each")
    F = np.zeros((3, 4, 4))
    F[0, :2, 2:] = np.eye(2)
    F[0, 2:, :2] = -np.diag(natural**2)
    F[0, 2:, 2:] = -np.diag(2.0 * ratios * natural)
    F[1, 2:, :2] = -coupling
    return LTPSystem(
        F,
        np.vstack([np.zeros((2, 2)), np.eye(2)]),
        np.hstack([np.eye(2), np.zeros((2, 2))]),
        omega=omega,
        state_names=["x1", "x2", "x1_dot", "x2_dot"],
        output_names=["x1", "x2"],
    )


def duffing(*, damping=0.2, stiffness=1.0, hardening=1.0, amplitude=1.0, omega=1.5):
    """Duffing oscillator under a periodic force; its trim is the forced oscillation.

        ẍ + δ ẋ + α x + β x³ = Γ cos ωt + u

    States and outputs are ``x`` and ``x_dot``. The input ``u`` is a force added to the periodic
    one; it is zero in trim. About the trim x* the stiffness α + 3β x*² is
    periodic; the Floquet exponents sum to −δ.

    Parameters
    ----------
    damping : float
        Damping δ in 1/s. It must not be negative, because no oscillation would be stable.
    stiffness, hardening : float
        Coefficients α and β, of either sign (two wells, softening).
    amplitude : float
        Amplitude Γ of the periodic force.
    omega : float
        Frequency ω of the periodic force in rad/s.

    Returns
    -------
    system : PeriodicSystem
        With the guess of its trim.

    Raises
    ------
    ValueError
        If the damping is negative, a number is not finite, or ω is not positive.

    Notes
    -----
    Near resonance there may be three periodic solutions. The trim starts from the
    smallest balance of the first harmonic,

        ((α − ω² + 3/4 β A²)² + δ² ω²) A² = Γ²

    Another ``guess`` finds the others.

    References
    ----------
    G. Duffing, *Erzwungene Schwingungen bei veränderlicher Eigenfrequenz*, Vieweg,
    1918; A. H. Nayfeh, D. T. Mook, *Nonlinear Oscillations*, Wiley, 1979, section 4.1.

    Examples
    --------
    >>> system = duffing()
    >>> ltp = system.linearize(system.trim(20))
    >>> bool(np.isclose(ltp.floquet_exponents().sum().real, -0.2))
    True
    """
    check_numbers("nonnegative", "a negative one makes every oscillation unstable", damping=damping)
    hint = "it may have either sign"
    check_numbers("finite", hint, stiffness=stiffness, hardening=hardening, amplitude=amplitude)
    omega = check_positive("omega", omega, "rad/s", "it is the frequency of the force")
    oscillator = _Duffing(damping, stiffness, hardening, amplitude, omega)
    return PeriodicSystem(
        oscillator,
        period=2.0 * np.pi / omega,
        state_names=["x", "x_dot"],
        input_names=["u"],
        jacobian=oscillator.jacobian,
        trim_guess=oscillator.trim_guess(),
    )


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
    or tip loss. Lift is linear and quasi-steady, and the air is assumed to meet the leading edge
    all over the disc (normal flow). Inside the reversed-flow circle, of diameter μ R on the
    retreating side, this gives lift of the wrong sign. The error in the flap moment is of the
    order of μ⁴, so the model is used up to μ ≈ 0.5; beyond that it describes the equation, not a
    rotor. With reversed flow the mean damping exceeds γ/8, and the sum rule above
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
    check_numbers("nonnegative", "a blade has none below zero", gamma=gamma, mu=mu, nu=nu)
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


@dataclass(frozen=True)
class _Duffing:
    """Right-hand side of Duffing's equation and its derivatives."""

    damping: float
    stiffness: float
    hardening: float
    amplitude: float
    omega: float

    def __call__(self, x, u, t):
        position, speed = x
        spring = self.stiffness * position + self.hardening * position**3
        force = self.amplitude * np.cos(self.omega * t) + u[0]
        return np.array([speed, force - self.damping * speed - spring])

    def jacobian(self, x, u, t):
        F = np.zeros((len(t), 2, 2))
        F[:, 0, 1], F[:, 1, 1] = 1.0, -self.damping
        F[:, 1, 0] = -self.stiffness - 3.0 * self.hardening * x[0] ** 2
        G = np.zeros((len(t), 2, 1))
        G[:, 1, 0] = 1.0
        return states_measured(F, G)

    def trim_guess(self):
        """Smallest first harmonic that balances the force: A cos(ψ − δ)."""
        detuning, cubic = self.stiffness - self.omega**2, 0.75 * self.hardening
        loss = self.damping * self.omega
        squares = np.roots(
            [cubic**2, 2.0 * cubic * detuning, detuning**2 + loss**2, -(self.amplitude**2)]
        )
        real = squares[(np.abs(squares.imag) < 1e-9) & (squares.real >= 0.0)].real
        square = np.min(real) if len(real) else 0.0  # none: undamped, at resonance
        size = np.copysign(np.sqrt(square), self.amplitude)
        stiffness = detuning + cubic * square
        phase = np.arctan2(loss, stiffness)
        cosine, sine = size * np.cos(phase), size * np.sin(phase)
        coefficients = np.zeros((3, 2))
        coefficients[1] = [cosine, self.omega * sine]
        coefficients[2] = [sine, -self.omega * cosine]
        return coefficients, np.zeros(1)
