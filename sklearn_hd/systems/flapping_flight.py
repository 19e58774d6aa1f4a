"""Flapping flight: the wing that the paper identifies, and a hovering hawkmoth."""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._checks import check_numbers, check_positive
from sklearn_hd.systems.arguments import check_names
from sklearn_hd.systems.periodic import PeriodicSystem, states_measured

TRIMMED = ("amplitude", "mean_angle")  # the inputs that hover is found with
EXTRAS = ("pitch_offset", "stroke_plane", "u_gust", "w_gust")
ELEMENTS = 8  # Gauss points of the span: exponents to 2e-4 of 64 of them


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
    flapping torque. The trim finds the U for which the mean of w is zero.

    Parameters
    ----------
    k_d1, k_d2, k_d3, k_L : float
        Coefficients of drag and lift: k_d1 in 1/rad, k_d2 dimensionless, k_d3 in 1/m, k_L in m.
        Drag may be zero; lift must be positive to carry the weight.
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


def hawkmoth(
    *,
    mass=1.648e-3,
    pitch_inertia=2.08e-7,
    hinge_forward=2e-3,
    hinge_height=2e-3,
    wing_length=51.9e-3,
    mean_chord=18.26e-3,
    omega=2.0 * np.pi * 26.3,
    amplitude=np.pi / 3.0,
    mean_angle=0.0,
    pitch_amplitude=np.pi / 3.6,
    pitch_sharpness=2.0,
    pitch_offset=0.0,
    stroke_plane=0.0,
    C_T=1.678,
    C_D0=0.07,
    C_D90=3.06,
    C_R=0.0,
    air_density=1.225,
    gravity=9.81,
    extra_inputs=(),
):
    """Surge, heave and pitch of a hovering hawkmoth (*Manduca sexta*).

        u̇ = −q w − g sin θ + X / m,   ẇ = q u + g cos θ + Z / m,
        q̇ = M / I_yy,   θ̇ = q

    States and outputs are the speeds u (forward) and w (down) in m/s, the pitch rate q
    (rad/s) and the pitch angle θ (rad, nose up), in body axes: ``u``, ``w``, ``q``,
    ``theta``. The wings follow the prescribed motion

        φ = φ̄ − Φ cos ωt,   η = η̄ + η_m tanh(C sin ωt) / tanh C

    φ forward in the stroke plane, η the chord's angle from the normal of that plane
    (η = 0 stands upright, the geometric angle of attack of the forward stroke is
    π/2 − η). The inputs are the stroke amplitude Φ and the mean stroke angle φ̄, both in
    rad, ``amplitude`` and ``mean_angle``; the trim finds those for which the means of u and w are
    zero. With equal wings on both sides, X, Z and M are twice the integrals over
    one wing of

        dF_c = ρ (Γ v_n − c (C_D0 v_c² + C_D90 v_n²) v_c / 2V) dr
        dF_n = −ρ (Γ v_c + c (C_D0 v_c² + C_D90 v_n²) v_n / 2V) dr
        Γ = C_T c v_c v_n / V − C_R c² (η̇ − q cos φ) / 2

    along and across the chord, where v_c, v_n are the speeds of the element at radius r
    through the air, V² = v_c² + v_n², from the wingbeat and from u, w and q. That is
    C_L = C_T sin 2α and C_D = C_D0 cos² α + C_D90 sin² α at the local angle of attack.

    Parameters
    ----------
    mass : float
        Mass m in kg, wings included.
    pitch_inertia : float
        I_yy about the centre of mass, kg m².
    hinge_forward, hinge_height : float
        Point where the line of the forces meets the plane of symmetry: ahead of and above the
        centre of mass, in m along the body axes.
    wing_length, mean_chord : float
        R and c̄ of one wing, m; the chord is c = (4 c̄/π) √(1 − (r/R)²).
    omega : float
        Wingbeat frequency in rad/s.
    amplitude, mean_angle : float
        Φ and φ̄ at the start of the trim search, rad.
    pitch_amplitude, pitch_sharpness, pitch_offset : float
        Pitch of the wings: η_m in rad, C (small for a sine, large for a square wave)
        and η̄ in rad.
    stroke_plane : float
        Angle of the stroke plane to the body's x axis in rad, its front edge down.
    C_T, C_D0, C_D90, C_R : float
        Coefficients of translational lift, of drag along and across the chord, and of
        rotational lift.
    air_density, gravity : float
        Density ρ in kg/m³, g in m/s².
    extra_inputs : sequence of str, default=()
        Further inputs: ``"pitch_offset"``, ``"stroke_plane"`` (in place of the
        parameters) and ``"u_gust"``, ``"w_gust"``, the velocity of the air in body axes
        in m/s. Trim with ``inputs={"u_gust": 0.0, ...}``.

    Returns
    -------
    system : PeriodicSystem
        With exact derivatives, and the guess and the targets of its trim.

    Raises
    ------
    ValueError
        If a parameter is out of its range or an extra input unknown.

    Notes
    -----
    Sources of the defaults:

    =================== ========================== ====================================
    parameter           default                    source
    =================== ========================== ====================================
    m, R, c̄, chord      1.648 g, 51.9, 18.26 mm,   Berman, Wang (2007), Table 2 and
                        half an ellipse            Eq. 2.9
    C_T, C_D0, C_D90    1.678, 0.07, 3.06          Berman, Wang (2007), Table 2
    C_R                 0 (no rotational lift)     choice; their Table 2 has π, see below
    η(t)                tanh of a sine             Berman, Wang (2007), Eq. 2.12
    C, η̄                2, 0                       choice
    η_m                 50° (40° at mid-stroke)    choice; Willmott, Ellington (1997)
                                                   measured incidences of 30° to 40°
    ω                   2π 26.3 rad/s              Hayajnh et al. (2024); as in
                                                   :func:`flapping_wing`
    I_yy                2.08e-7 kg m²              choice: that of a uniform rod of mass m
                                                   and 39 mm
    hinge               2 mm ahead, 2 mm above     choice, see below
    stroke plane        0                          choice; another angle turns θ
    ρ, g                1.225 kg/m³, 9.81 m/s²     standard atmosphere
    =================== ========================== ====================================

    The figures of Berman and Wang come from a program that reproduces their paper, not from the
    paper itself.

    The model leaves out added mass, the wings' inertia (two wings weigh 6 % of the moth), induced
    flow, wake capture, the body's own drag, flow along the span, and the distance from the hinge
    axis to the centre of pressure, which hangs below the hinge while the wing flaps.
    ``hinge_height`` is therefore the height of the forces. It decides how fast the instability
    grows, because the drag of surging acts there: M_u = ∂M/∂u / I_yy is 49 1/(m s) at 2 mm, and 26
    more for each mm; at 1 mm the moth is stable. Rotational lift with C_R = π adds 300 1/(m s).

    A change of Φ or φ̄ within a wingbeat moves the wings at once, and the model ignores the speed
    of that jump. Hold inputs over whole wingbeats, from the reversal at t = 0.

    References
    ----------
    G. J. Berman, Z. J. Wang, "Energy-minimizing kinematics in hovering insect flight",
    Journal of Fluid Mechanics 582 (2007), 153-168; A. P. Willmott, C. P. Ellington, "The
    mechanics of flight in the hawkmoth Manduca sexta II", Journal of Experimental
    Biology 200 (1997), 2723-2745; M. Sun, Y. Xiong, "Dynamic flight stability of a
    hovering bumblebee", Journal of Experimental Biology 208 (2005), 447-459; M. Sun,
    J. K. Wang, "Flight stabilization control of a hovering model insect", Journal of
    Experimental Biology 210 (2007), 2714-2722 (inputs).

    Examples
    --------
    >>> system = hawkmoth()
    >>> trim = system.trim()
    >>> np.degrees(trim.inputs).round(1).tolist()
    [54.7, -3.6]
    >>> system.linearize(trim).floquet_exponents().round(2).tolist()
    [(0.95-5.67j), (0.95+5.67j), (-2.56+0j), (-9.72+0j)]
    """
    check_numbers(
        "positive",
        "the moth has none without it",
        mass=mass,
        pitch_inertia=pitch_inertia,
        wing_length=wing_length,
        mean_chord=mean_chord,
        amplitude=amplitude,
        pitch_sharpness=pitch_sharpness,
        C_T=C_T,
        air_density=air_density,
        gravity=gravity,
    )
    check_numbers("nonnegative", "it is a coefficient", C_D0=C_D0, C_D90=C_D90, C_R=C_R)
    check_numbers(
        "finite",
        "lengths in m, angles in rad",
        hinge_forward=hinge_forward,
        hinge_height=hinge_height,
        mean_angle=mean_angle,
        pitch_amplitude=pitch_amplitude,
        pitch_offset=pitch_offset,
        stroke_plane=stroke_plane,
    )
    omega = check_positive("omega", omega, "rad/s", "it is the wingbeat frequency")
    inputs = _check_inputs(extra_inputs)
    settings = {
        "amplitude": amplitude,
        "mean_angle": mean_angle,
        "pitch_offset": pitch_offset,
        "stroke_plane": stroke_plane,
        "u_gust": 0.0,
        "w_gust": 0.0,
    }
    moth = _Hawkmoth(
        mass=mass,
        pitch_inertia=pitch_inertia,
        hinge=(hinge_forward, -hinge_height),
        pitch_amplitude=pitch_amplitude,
        pitch_sharpness=pitch_sharpness,
        wing=_Wing(wing_length, mean_chord, C_T, C_D0, C_D90, C_R),
        omega=omega,
        air_density=air_density,
        gravity=gravity,
        inputs=inputs,
        settings=settings,
    )
    return PeriodicSystem(
        moth,
        period=2.0 * np.pi / omega,
        state_names=["u", "w", "q", "theta"],
        input_names=inputs,
        jacobian=moth.jacobian,
        trim_guess=(np.zeros((1, 4)), [settings[name] for name in inputs]),
        trim_targets={"u": 0.0, "w": 0.0},
    )


def _check_inputs(extra_inputs):
    extra = check_names(extra_inputs, "extra_inputs")
    unknown = [name for name in extra if name not in EXTRAS]
    if unknown:
        raise ValueError(f"extra_inputs names {unknown}; there are {list(EXTRAS)}")
    return (*TRIMMED, *extra)


@dataclass(frozen=True)
class _Wing:
    """One wing as a line of elements."""

    length: float
    mean_chord: float
    C_T: float
    C_D0: float
    C_D90: float
    C_R: float

    def __post_init__(self):
        nodes, weights = np.polynomial.legendre.leggauss(ELEMENTS)
        angle, weights = 0.25 * np.pi * (nodes + 1.0), 0.25 * np.pi * weights  # r = R sin(angle)
        radius = self.length * np.sin(angle)
        chord = 4.0 / np.pi * self.mean_chord * np.cos(angle)
        area = chord * self.length * np.cos(angle) * weights
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "chord", chord)
        object.__setattr__(self, "moments", np.array([area, radius * area]))

    def forces(self, along, across, spin):
        """∫ dF and ∫ r dF along and across the chord, over the air's density.

        ``along`` and ``across`` are the chord's speed at the root and its slope over the
        radius.
        """
        shape = (-1, *(1,) * np.ndim(spin))
        r, chord = self.radius.reshape(shape), self.chord.reshape(shape)
        v_c, v_n = along[0] + along[1] * r, across[0] + across[1] * r
        c_2, n_2 = v_c * v_c, v_n * v_n
        speed = np.sqrt(c_2 + n_2 + 1e-200)  # it may vanish
        drag = (0.5 * self.C_D0 * c_2 + 0.5 * self.C_D90 * n_2) / speed
        circulation = self.C_T * v_c * v_n / speed
        if self.C_R:
            circulation = circulation - 0.5 * self.C_R * spin * chord
        F_c = self.moments @ (circulation * v_n - drag * v_c)
        F_n = self.moments @ (-circulation * v_c - drag * v_n)
        return F_c, F_n


@dataclass(frozen=True)
class _Hawkmoth:
    """Right-hand side of the hovering moth and its derivatives."""

    mass: float
    pitch_inertia: float
    hinge: tuple  # forward, down
    pitch_amplitude: float
    pitch_sharpness: float
    wing: _Wing
    omega: float
    air_density: float
    gravity: float
    inputs: tuple
    settings: dict

    def __call__(self, x, u, t):
        surge, heave, rate, attitude = x
        X, Z, M = self.loads(x, u, t)
        return np.array(
            [
                X / self.mass - rate * heave - self.gravity * np.sin(attitude),
                Z / self.mass + rate * surge + self.gravity * np.cos(attitude),
                M / self.pitch_inertia,
                rate,
            ]
        )

    def loads(self, x, u, t):
        """X, Z (N) and M (N m) of both wings."""
        now = {**self.settings, **dict(zip(self.inputs, u, strict=True))}
        phi, phi_dot, eta, eta_dot = self.wingbeat(now, t)
        sin_phi, cos_phi = np.sin(phi), np.cos(phi)
        sin_eta, cos_eta = np.sin(eta), np.cos(eta)
        tilt = np.cos(now["stroke_plane"]), np.sin(now["stroke_plane"])
        rate, (forward, down) = x[2], self.hinge
        v_x = x[0] - now["u_gust"] + rate * down  # of the hinge through the air
        v_z = x[1] - now["w_gust"] - rate * forward
        stroke = cos_phi * (v_x * tilt[0] + v_z * tilt[1]), phi_dot  # root, slope over r
        normal = v_x * tilt[1] - v_z * tilt[0], rate * sin_phi
        F_c, F_n = self.wing.forces(
            [a * sin_eta + b * cos_eta for a, b in zip(stroke, normal, strict=True)],
            [a * cos_eta - b * sin_eta for a, b in zip(stroke, normal, strict=True)],
            eta_dot - rate * cos_phi,
        )
        F_stroke = cos_phi * (F_c[0] * sin_eta + F_n[0] * cos_eta)
        F_normal, root_moment = F_c * cos_eta - F_n * sin_eta
        both = 2.0 * self.air_density
        X = both * (F_stroke * tilt[0] + F_normal * tilt[1])
        Z = both * (F_stroke * tilt[1] - F_normal * tilt[0])
        return X, Z, down * X - forward * Z + both * sin_phi * root_moment

    def wingbeat(self, now, t):
        """φ, φ̇, η, η̇ of the wings."""
        cosine, sine = np.cos(self.omega * t), np.sin(self.omega * t)
        phi = now["mean_angle"] - now["amplitude"] * cosine
        phi_dot = self.omega * now["amplitude"] * sine
        wave = np.tanh(self.pitch_sharpness * sine)
        scale = self.pitch_amplitude / np.tanh(self.pitch_sharpness)
        eta = now["pitch_offset"] + scale * wave
        eta_dot = scale * (1.0 - wave * wave) * self.pitch_sharpness * self.omega * cosine
        return phi, phi_dot, eta, eta_dot

    def jacobian(self, x, u, t):
        F = _slopes(lambda x: self(x, u, t), x)
        G = _slopes(lambda u: self(x, u, t), u)
        return states_measured(F, G)


def _slopes(function, variables):
    """Derivatives of an analytic function(variables), (n, k), by each of (m, k).

    A complex step has no truncation and no cancellation, however small it is.
    """
    columns = []
    for i in range(len(variables)):
        moved = np.array(variables, dtype=complex)
        moved[i] += 1e-30j
        columns.append(function(moved).imag / 1e-30)
    return np.stack(columns, axis=-1).swapaxes(0, 1)
