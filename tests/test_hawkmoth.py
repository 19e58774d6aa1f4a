"""A hovering hawkmoth: what holds of its model whatever the numbers, and its modes."""

import pickle
import sys

import numpy as np
import pytest
from periodic_cases import periodicity_defect

from sklearn_hd.systems import PeriodicSystem, hawkmoth

hawkmoth_module = sys.modules[hawkmoth.__module__]  # its name is the function's too

MIRROR = np.diag([-1.0, 1.0, -1.0, -1.0])  # of forward and backward
FULL = {
    "C_R": 2.0,
    "stroke_plane": 0.3,
    "pitch_offset": 0.1,
    "mean_angle": -0.2,
    "hinge_forward": 3e-3,
    "extra_inputs": ("u_gust", "w_gust"),
}


@pytest.fixture(scope="module")
def moth():
    return hawkmoth()


@pytest.fixture(scope="module")
def trim(moth):
    return moth.trim(60)


@pytest.fixture(scope="module")
def ltp(moth, trim):
    return moth.linearize(trim)


def points(rng, n_inputs=2, n_points=12):
    """States, inputs and times at random."""
    sizes = np.array([0.5, 0.5, 10.0, 0.5])[:, None]
    x = sizes * rng.standard_normal((4, n_points))
    u = 0.2 * rng.standard_normal((n_inputs, n_points))
    u[0] += 1.0
    return x, u, rng.uniform(0.0, 0.04, n_points)


def loads_in_space(system, x, u, t, n_elements=4000):
    """X, Z, M of both wings by vectors in three dimensions, element by element."""
    moth = system.f
    now = {**moth.settings, **dict(zip(system.input_names, u, strict=True))}
    phi, phi_dot, eta, eta_dot = moth.wingbeat(now, t)
    R, wing = moth.wing.length, moth.wing
    r = R * np.sin(0.5 * np.pi * (np.arange(n_elements) + 0.5) / n_elements)
    width = 0.5 * np.pi / n_elements * np.sqrt(R**2 - r**2)
    chord = 4.0 / np.pi * wing.mean_chord * np.sqrt(1.0 - (r / R) ** 2)
    b = now["stroke_plane"]
    front, up = np.array([np.cos(b), 0, np.sin(b)]), np.array([np.sin(b), 0, -np.cos(b)])
    force, moment = np.zeros(3), np.zeros(3)
    for side in (1.0, -1.0):
        out = np.array([0.0, side, 0.0])
        span = np.sin(phi) * front + np.cos(phi) * out
        stroke = np.cos(phi) * front - np.sin(phi) * out
        place = np.array([moth.hinge[0], 0.0, moth.hinge[1]]) + r[:, None] * span
        wind = np.array([now["u_gust"], 0.0, now["w_gust"]])
        turning = np.cross([0.0, x[2], 0.0], place)
        speed = np.array([x[0], 0.0, x[1]]) - wind + turning + phi_dot * r[:, None] * stroke
        speed = speed - np.outer(speed @ span, span)
        along = np.sin(eta) * stroke + np.cos(eta) * up
        size = np.linalg.norm(speed, axis=1)
        alpha = np.arccos(np.clip(speed @ along / size, -1.0, 1.0))
        lift = np.cross(side * span, speed)  # up when the wing sweeps forward
        lift *= np.sign(np.sum(np.cross(speed, along) * (side * span), axis=1))[:, None]
        C_L = wing.C_T * np.sin(2.0 * alpha)
        C_D = wing.C_D0 * np.cos(alpha) ** 2 + wing.C_D90 * np.sin(alpha) ** 2
        dF = 0.5 * (chord * size)[:, None] * (C_L[:, None] * lift - C_D[:, None] * speed)
        spin = eta_dot - x[2] * np.cos(phi)
        rotation = 0.5 * wing.C_R * chord**2 * spin
        dF += rotation[:, None] * np.cross(speed, side * span)
        dF *= (moth.air_density * width)[:, None]
        force += dF.sum(axis=0)
        moment += np.cross(place, dF).sum(axis=0)
    return force[0], force[2], moment[1]


# ---- forces ------------------------------------------------------------------------------------


def test_loads_are_those_of_vectors_in_space(rng, monkeypatch):
    monkeypatch.setattr(hawkmoth_module, "ELEMENTS", 100)
    system = hawkmoth(**FULL)
    x, u, t = points(rng, 4)
    found = np.array(system.f.loads(x, u, t))
    expected = np.array([loads_in_space(system, *point) for point in zip(x.T, u.T, t, strict=True)])
    np.testing.assert_allclose(found, expected.T, rtol=2e-5, atol=1e-9)


@pytest.mark.slow
def test_eight_elements_are_enough(ltp, monkeypatch):
    monkeypatch.setattr(hawkmoth_module, "ELEMENTS", 64)
    fine = hawkmoth()
    found = fine.linearize(fine.trim(60)).floquet_exponents()
    np.testing.assert_allclose(ltp.floquet_exponents(), found, rtol=2e-4)


def test_one_point_or_many(rng):
    system = hawkmoth(**FULL)
    x, u, t = points(rng, 4)
    one_by_one = [system.f(*point) for point in zip(x.T, u.T, t, strict=True)]
    np.testing.assert_allclose(system.f(x, u, t).T, one_by_one, rtol=1e-12)


def at_rest(moth, t, moved, step=1e-6):
    """Slopes of X, Z, M by one of the states, about the body at rest."""
    u = np.tile([[1.0], [0.0]], len(t))
    x = np.zeros((4, len(t)))
    x[moved] = step
    return (np.array(moth.f.loads(x, u, t)) - moth.f.loads(-x, u, t)) / (2.0 * step)


def test_damping_at_rest_in_closed_form(moth):
    """∂Z/∂w = −ρ S₁ |φ̇| (C_L′ + C_D), ∂X/∂u = −2 ρ S₁ |φ̇| C_D cos² φ, S₁ = ∫ c r dr."""
    t = moth.period * np.array([0.1, 0.2, 0.33, 0.45, 0.6, 0.9])
    now = {**moth.f.settings, "amplitude": 1.0, "mean_angle": 0.0}
    phi, phi_dot, eta, _ = moth.f.wingbeat(now, t)
    alpha = 0.5 * np.pi - np.abs(eta)
    first_moment = 4.0 / (3.0 * np.pi) * 18.26e-3 * 51.9e-3**2
    drag = 0.07 * np.cos(alpha) ** 2 + 3.06 * np.sin(alpha) ** 2
    slope = 2.0 * 1.678 * np.cos(2.0 * alpha)
    scale = -1.225 * first_moment * np.abs(phi_dot)
    np.testing.assert_allclose(at_rest(moth, t, 1)[1], scale * (slope + drag), rtol=1e-7)
    np.testing.assert_allclose(
        at_rest(moth, t, 0)[0], 2.0 * scale * drag * np.cos(phi) ** 2, rtol=1e-7
    )


def test_lift_at_rest_in_closed_form(moth):
    """Z = −ρ S₂ φ̇² C_T sin 2α with S₂ = c̄ R³ / 4."""
    t = moth.period * np.array([0.1, 0.2, 0.45, 0.7])
    _, phi_dot, eta, _ = moth.f.wingbeat({**moth.f.settings, "amplitude": 1.0}, t)
    Z = moth.f.loads(np.zeros((4, 4)), np.tile([[1.0], [0.0]], 4), t)[1]
    second_moment = 18.26e-3 * 51.9e-3**3 / 4.0
    expected = -1.225 * second_moment * phi_dot**2 * 1.678 * np.sin(2.0 * np.abs(eta))
    np.testing.assert_allclose(Z, expected, rtol=1e-9)


# ---- laws ----------------------------------------------------------------------------------------


def test_the_wingbeat_repeats(rng):
    system = hawkmoth(**FULL)
    x, u, t = points(rng, 4)
    np.testing.assert_allclose(
        system.f(x, u, t + system.period), system.f(x, u, t), rtol=1e-9, atol=1e-9
    )


def test_half_a_beat_later_forward_is_backward(rng):
    """Hinge above the centre of mass, stroke plane level: S f(x, u, t) = f(S x, S u, t + T/2)."""
    system = hawkmoth(hinge_forward=0.0, C_R=1.0)
    x, u, t = points(rng)
    found = system.f(MIRROR @ x, u * [[1.0], [-1.0]], t + 0.5 * system.period)
    np.testing.assert_allclose(found, MIRROR @ system.f(x, u, t), rtol=1e-9, atol=1e-9)


def test_a_symmetric_moth_heaves_apart():
    """Its trim has a mean angle of zero, and w moves neither u, q nor θ over a wingbeat."""
    system = hawkmoth(hinge_forward=0.0)
    trim = system.trim(20)
    assert trim.inputs[1] == pytest.approx(0.0, abs=1e-12)
    half = system.linearize(trim).F([0.4, 0.4 + np.pi])
    np.testing.assert_allclose(half[1], MIRROR @ half[0] @ MIRROR, atol=1e-6)


def test_only_the_speed_through_the_air_counts(rng):
    system = hawkmoth(**FULL)
    x, u, t = points(rng, 4)
    moved, drift = x.copy(), rng.standard_normal((2, 12))
    moved[:2] += drift
    with_wind = u.copy()
    with_wind[2:] += drift
    np.testing.assert_allclose(
        system.f.loads(moved, with_wind, t), system.f.loads(x, u, t), rtol=1e-9, atol=1e-12
    )


def test_a_tilted_body_is_the_same_moth(trim, ltp):
    """Stroke plane and hinge turned in body axes: the pitch angle answers, nothing else."""
    b, (x, z) = 0.4, (2e-3, -2e-3)
    turned = hawkmoth(
        stroke_plane=b,
        hinge_forward=x * np.cos(b) - z * np.sin(b),
        hinge_height=-(x * np.sin(b) + z * np.cos(b)),
    )
    found = turned.trim(60)
    np.testing.assert_allclose(found.inputs, trim.inputs, rtol=1e-9)
    assert found.coefficients[0, 3] == pytest.approx(trim.coefficients[0, 3] + b, abs=1e-9)
    np.testing.assert_allclose(
        turned.linearize(found).floquet_exponents(), ltp.floquet_exponents(), rtol=1e-7
    )


def test_units_do_not_matter(trim, ltp):
    """Lengths × 100, masses × 1000, times × 7: angles stay, exponents are those over 7."""
    L, m, s = 100.0, 1000.0, 7.0
    scaled = hawkmoth(
        mass=1.648e-3 * m,
        pitch_inertia=2.08e-7 * m * L**2,
        hinge_forward=2e-3 * L,
        hinge_height=2e-3 * L,
        wing_length=51.9e-3 * L,
        mean_chord=18.26e-3 * L,
        omega=2.0 * np.pi * 26.3 / s,
        air_density=1.225 * m / L**3,
        gravity=9.81 * L / s**2,
    )
    found = scaled.trim(60)
    np.testing.assert_allclose(found.inputs, trim.inputs, rtol=1e-8)
    exponents = scaled.linearize(found).floquet_exponents()
    np.testing.assert_allclose(exponents, ltp.floquet_exponents() / s, rtol=1e-7)


def test_jacobian_is_the_derivative(rng):
    system = hawkmoth(**FULL)
    numeric = PeriodicSystem(
        system.f,
        period=system.period,
        state_names=system.state_names,
        input_names=system.input_names,
    )
    x, u, t = points(rng, 4)
    for found, expected in zip(system.jacobian(x, u, t), numeric.jacobian(x, u, t), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())


def test_survives_pickling(moth, trim):
    again = pickle.loads(pickle.dumps(moth))
    np.testing.assert_array_equal(
        again.f(trim.initial_state, trim.inputs, 0.01),
        moth.f(trim.initial_state, trim.inputs, 0.01),
    )


# ---- hover ---------------------------------------------------------------------------------------


def test_forces_of_a_wingbeat_carry_the_weight(moth, trim):
    """The velocity over the ground repeats, hence so does momentum: −F̄_vertical = m g."""
    psi = 2.0 * np.pi * np.arange(512) / 512
    x = trim.states(psi).T
    X, Z, M = moth.f.loads(x, np.tile(trim.inputs[:, None], 512), psi / moth.omega)
    sin, cos = np.sin(x[3]), np.cos(x[3])
    weight = 1.648e-3 * 9.81
    assert np.mean(X * sin - Z * cos) == pytest.approx(weight, rel=1e-6)
    assert abs(np.mean(X * cos + Z * sin)) < 1e-6 * weight
    assert abs(np.mean(M)) < 1e-6 * weight * 51.9e-3


@pytest.mark.slow
def test_hover_is_a_periodic_solution_that_stands_still(moth, trim):
    assert np.all(np.abs(periodicity_defect(moth, trim)) < [1e-8, 1e-9, 1e-6, 1e-7])
    np.testing.assert_allclose(trim.coefficients[0, :3], 0.0, atol=1e-12)
    exact = moth.trim(60, method="shooting", n_points=1024)
    np.testing.assert_allclose(exact.inputs, trim.inputs, rtol=1e-6)
    x = trim.states(2.0 * np.pi * np.arange(256) / 256)
    over_ground = x[:, 0] * np.exp(-1j * x[:, 3]) + 1j * x[:, 1] * np.exp(-1j * x[:, 3])
    assert abs(over_ground.mean()) < 2e-3  # m/s; θ and the speeds beat together


def test_amplitude_of_hover_is_that_of_the_page(trim):
    """±54.7° about −3.6°: docs/world.md."""
    np.testing.assert_allclose(np.degrees(trim.inputs), [54.7, -3.6], atol=0.06)


def test_modes_are_those_of_hovering_insects(ltp):
    """Sun and Xiong (2005): an oscillation of surge and pitch that grows, a fast subsidence
    of the same, a slow one of heave."""
    pair, pair_too, heave, fast = ltp.floquet_exponents()
    assert pair == np.conj(pair_too)
    assert 0.0 < pair.real < 0.5 * abs(pair.imag)
    assert heave.imag == fast.imag == 0.0
    assert fast.real < 3.0 * heave.real < 0.0
    multipliers, modes = np.linalg.eig(ltp.monodromy())
    slow = modes[:, np.argmin(np.abs(multipliers - np.exp(heave * ltp.period)))]
    growing = modes[:, np.argmax(np.abs(multipliers))]
    speeds = np.abs([slow[:2], growing[:2]])
    assert speeds[0, 1] > 4.0 * speeds[0, 0]
    assert speeds[1, 0] > 4.0 * speeds[1, 1]


def test_exponents_do_not_depend_on_where_a_beat_begins(ltp):
    expected = np.sort_complex(np.exp(ltp.floquet_exponents() * ltp.period))
    for start in (0.0, 1.0, 4.0):
        found = np.linalg.eigvals(ltp.monodromy(start))
        np.testing.assert_allclose(np.sort_complex(found), expected, rtol=1e-8)


def growths(system):
    """Largest real parts: of the averaged F, and of the Floquet exponents."""
    averaged = np.linalg.eigvals(system.fourier_coefficients(0)[0][0])
    return averaged.real.max(), system.floquet_exponents()[0].real


def test_averaging_holds_for_a_heavy_moth_only(ltp):
    """100 times the mass and a hundredth of g: the wings shake it a hundredth as much."""
    heavy = hawkmoth(mass=0.1648, pitch_inertia=2.08e-5, gravity=0.0981)
    averaged, exact = growths(heavy.linearize(heavy.trim(30)))
    light_averaged, light_exact = growths(ltp)
    assert light_averaged / light_exact - 1.0 > 0.3
    assert abs(averaged / exact - 1.0) < 0.1 * (light_averaged / light_exact - 1.0)


def test_shaking_stabilises():
    """Taha and others, Science Robotics 5 (2020), eabb1502: averages call it unstable."""
    moth = hawkmoth(hinge_height=1e-3)
    averaged, exact = growths(moth.linearize(moth.trim(30)))
    assert exact < -0.3 < 0.3 < averaged


@pytest.mark.slow
def test_left_alone_it_hovers_for_a_while_and_tumbles(moth, trim, ltp):
    """A small departure grows as the linear model's; the orbit itself stays for some beats."""
    t = moth.period * np.arange(12 * 16 + 1) / 16
    u = np.tile(trim.inputs, (len(t), 1))
    orbit = trim.states(moth.omega * t)
    alone = moth.simulate(u, t, trim.initial_state, rtol=1e-10)
    assert np.max(np.abs(alone - orbit) / np.ptp(orbit, axis=0)) < 1e-5
    departure = 1e-3 * np.array([0.3, 0.1, 1.0, 0.1])
    pushed = moth.simulate(u, t, trim.initial_state + departure, rtol=1e-10)
    linear = ltp.simulate(np.zeros_like(u), t, departure)
    error = np.max(np.abs(pushed - alone - linear), axis=0)
    assert np.all(error < 5e-3 * np.max(np.abs(linear), axis=0))


# ---- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mass": 0.0}, "mass must be a positive number, got 0.0; the moth has none without it"),
        ({"C_R": -1.0}, "C_R must be a nonnegative number"),
        ({"stroke_plane": np.nan}, "stroke_plane must be a finite number"),
        ({"omega": 0}, "omega must be a positive number in rad/s"),
        ({"extra_inputs": ["wind"]}, r"extra_inputs names \['wind'\]; there are \['pitch_offset'"),
    ],
)
def test_bad_parameters_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        hawkmoth(**given)


def test_wind_must_be_held_in_a_trim():
    windy = hawkmoth(extra_inputs=("u_gust",))
    with pytest.raises(ValueError, match=r"2 targets cannot determine .*'u_gust'"):
        windy.trim()
    headwind = windy.trim(20, inputs={"u_gust": -0.3})
    assert headwind.coefficients[0, 3] < -0.02  # nose down against it
