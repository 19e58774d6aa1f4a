"""The speed that a record tells: exact where it is exact, and never worse than the one given."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sklearn_hd.algorithms.periodic.speed import measured_speed, orbit_drift, orbit_speed
from sklearn_hd.datasets import make_flapping_wing

OMEGA = 2 * np.pi
T = np.arange(3000) / 20.3  # 148 turns


def orbit(psi):
    return np.column_stack([3 + np.cos(psi) + 0.2 * np.sin(3 * psi), np.sin(psi - 0.4)])


def answer(u, size=0.02, seed=0, noise=1e-3):
    """What an input does, and the sensors' noise: a lag, seen by both outputs."""
    x = np.zeros(len(u))
    for k in range(len(u) - 1):
        x[k + 1] = 0.9 * x[k] + 0.1 * u[k]
    e = np.random.default_rng(seed).standard_normal((len(u), 2))
    return size * (x[:, None] * [1.0, -0.5] + noise * e)


def steps(seed=0):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.choice([-1.0, 0.0, 1.0], 300), 10)


def told(y, given, u=None, time=T):
    u = steps() if u is None else u
    return measured_speed([(u[:, None], y, time)], given, 9)


@pytest.mark.parametrize("off", [1e-6, 1e-5, -1e-4, 1e-3, -0.01, 0.02])
def test_any_speed_nearby_leads_to_the_true_one(off):
    y = orbit(OMEGA * T) + answer(steps())
    found = told(y, OMEGA * (1 + off))
    assert abs(found.omega / OMEGA - 1) < 5e-8
    assert abs(found.omega - OMEGA) < 5 * found.std
    assert found.turns == pytest.approx(abs(off) * T[-1], rel=0.1)


@pytest.mark.slow
def test_the_true_speed_stays_to_the_last_digit():
    for seed in range(20):
        u = steps(seed)
        assert told(orbit(OMEGA * T) + answer(u, seed=seed), OMEGA, u) is None


@pytest.mark.slow
def test_the_standard_deviation_holds():
    """Errors over deviations of 30 records: rms 1, of which 0.7 to 1.3 is what chance gives."""
    scores = []
    for seed in range(30):
        u = steps(seed)
        y = orbit(OMEGA * T) + answer(u, seed=seed, noise=0.05)
        found = told(y, OMEGA * (1 + 1e-4), u)
        scores.append((found.omega - OMEGA) / found.std)
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3


@pytest.mark.parametrize("off", [-1e-4, -1e-3, 5e-3])
@pytest.mark.parametrize("samples", [18.0, 18.00002])
def test_a_harmonic_at_half_the_sampling_rate_tells_no_speed(samples, off):
    """Harmonic 9: its phase tells nothing; the others do as before."""
    near, other = (
        told(orbit(OMEGA * time) + answer(steps(), noise=0.05), OMEGA * (1 + off), time=time)
        for time in (np.arange(3000) / samples, np.arange(3000) / 18.4)
    )
    assert abs(near.omega - OMEGA) < 3 * near.std
    assert near.std == pytest.approx(other.std, rel=0.1)


def test_an_orbit_tells_its_speed_where_that_given_is_right_too():
    found, std = orbit_speed([(steps()[:, None], orbit(OMEGA * T) + answer(steps()), T)], OMEGA, 9)
    assert abs(found - OMEGA) < 4 * std < 1e-6


@pytest.mark.parametrize("drift", [0.0, 1e-3, -1e-2])
def test_a_drift_is_told_by_the_two_halves(drift):
    psi = OMEGA * T + 0.5 * drift * T**2 / T[-1]  # from ω to ω + drift
    segments = [
        (steps()[p, None], (orbit(psi) + answer(steps()))[p], T[p])
        for p in (slice(0, 1490), slice(1495, 1497), slice(1505, 3000))
    ]
    found, std = orbit_drift(segments, OMEGA + 0.5 * drift, 9)
    assert abs(found - drift) < max(4 * std, 0.02 * abs(drift))
    assert std < 1e-4
    assert orbit_drift([(u, y - orbit(OMEGA * t), t) for u, y, t in segments], OMEGA, 9) is None


@pytest.mark.parametrize("scale", [1e-140, 1e-9, 1e12, 1e140])
def test_units_do_not_matter(scale):
    y = orbit(OMEGA * T) + answer(steps())
    one, other = (told(each, OMEGA * (1 + 1e-5)) for each in (y, scale * y))
    assert other.omega == pytest.approx(one.omega, rel=1e-12)
    assert other.moved == pytest.approx(one.moved, rel=1e-6)


def test_segments_go_on_from_one_another():
    y, u = orbit(OMEGA * T) + answer(steps()), steps()
    parts = [slice(0, 900), slice(1111, 2000), slice(2050, 3000)]
    segments = [(u[p, None], y[p], T[p]) for p in parts]
    found = measured_speed(segments, OMEGA * (1 + 3e-5), 9)
    assert abs(found.omega / OMEGA - 1) < 1e-7


def test_a_long_record_is_looked_at_in_places():
    time = np.arange(60_000) / 20.3
    u = np.resize(steps(), len(time))
    found = told(orbit(OMEGA * time) + answer(u), OMEGA * (1 + 1e-4), u, time)
    assert abs(found.omega / OMEGA - 1) < 1e-9


@pytest.mark.parametrize("kind", ["lti", "ltp", "lti-signal"])
@pytest.mark.parametrize(
    "off",
    [
        0.0,
        1e-5,
        1e-3,
        0.01,
    ],
)
@pytest.mark.slow
def test_without_an_orbit_speeds_stay_as_given(kind, off):
    data = make_flapping_wing(kind, n_periods=60, start=5, random_state=0)
    u, y = (frame.to_numpy() for frame in (data.inputs, data.outputs))
    given = data.omega * (1 + off)
    assert measured_speed([(u, y, data.inputs.index.to_numpy())], given, 9) is None


def test_what_is_too_short_or_still_tells_nothing():
    y, u = orbit(OMEGA * T) + answer(steps()), steps()
    assert measured_speed([(u[:50, None], y[:50], T[:50])], OMEGA * 1.01, 9) is None
    assert measured_speed([(u[:, None], y, T)], OMEGA * 1.01, 0) is None
    assert told(np.ones((3000, 2)), OMEGA * 1.01) is None
    noise = np.random.default_rng(0).standard_normal((3000, 2))
    assert told(noise, OMEGA * 1.01) is None


def stepped_shaft(per_turn=24, n_turns=60, steps=(8, 36)):
    """An asymmetric shaft that stiffens as it bends; forces that stay move its whole orbit."""
    period, begin = 2 * np.pi / 100.0, 30 * per_turn  # settled
    time = np.arange(begin, begin + n_turns * per_turn) * period / per_turn
    edges = time[0] + np.array(steps) * period

    def slopes(t, z):
        q, v, psi = z[:2], z[2:], 100.0 * t
        c, s = np.cos(2 * psi), np.sin(2 * psi)
        stiff = 4900.0 * ((1 + 0.8e-6 * q @ q) * q + 0.18 * np.array([[c, s], [s, -c]]) @ q)
        damped = 8.2 * v + 120.0 * np.array([q[1], -q[0]])
        force = 3e5 * np.array([np.cos(psi), np.sin(psi)]) + 5e4 * (t >= edges) - [0.0, 4e5]
        return np.concatenate([v, force - stiff - damped])

    limits = {"max_step": period / 24, "rtol": 1e-8, "atol": 1e-6}
    run = solve_ivp(slopes, (0.0, time[-1]), np.zeros(4), t_eval=time, **limits)
    return (time[:, None] >= edges).astype(float), run.y[:2].T, time


def test_the_orbit_of_another_input_is_not_another_speed():
    u, y, time = stepped_shaft()
    for seed in range(3):
        noise = 0.003 * y.std(axis=0) * np.random.default_rng(seed).standard_normal(y.shape)
        assert measured_speed([(u, y + noise, time)], 100.0, 9) is None
    found = measured_speed([(u, y + noise, time)], 100.1, 9)
    assert abs(found.omega / 100.0 - 1.0) < 2e-5


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bend", [0.0, 0.3, 1.0])
def test_one_motion_of_a_few_turns_is_no_other_speed(bend, seed):
    """Its frequency bends with its size: a predictor was sure of others by 400 deviations."""
    psi = 2.0 * np.pi / 36 * np.arange(36 * 50)
    since = psi - 11.0 * 2.0 * np.pi
    size = np.where(since >= 0.0, 0.5 * np.exp(-0.15 * np.maximum(since, 0.0)), 0.0)
    y = np.cos(psi) + 0.3 * np.cos(2.0 * psi + 1.0) + size * np.cos(0.37 * since + bend * size**2)
    y = y[:, None] + 0.01 * np.random.default_rng(seed).standard_normal((len(psi), 1))
    u = np.zeros_like(y)
    u[360:396] = 1.0
    assert measured_speed([(u, y, psi)], 1.0, 3) is None
    found = orbit_speed([(u, y, psi)], 1.0, 3)
    assert found is None or abs(found[0] - 1.0) < 6.0 * found[1]
