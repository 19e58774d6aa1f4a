"""Feedback once a period, and the flights of a hawkmoth that it keeps in the air."""

import pickle

import numpy as np
import pandas as pd
import pytest
from scipy import linalg
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.algorithms.periodic.integration import integrate, runge_kutta
from sklearn_hd.datasets import make_hawkmoth
from sklearn_hd.systems import HeldFeedback, PeriodicSystem, hawkmoth
from sklearn_hd.systems.held_feedback import PeriodMap, quadratic_gain

SIZES = {"state_sizes": [0.3, 0.1, 5.0, 0.2], "input_sizes": [0.06, 0.02]}


@pytest.fixture(scope="module")
def loop():
    moth = hawkmoth()
    return HeldFeedback(moth, moth.trim(40), **SIZES, samples_per_period=32)


def growing(x, u, t):
    """ẋ = 0.05 x + (1 + cos t) u₀ + u₁, T = 2π: it grows by 37 % a period."""
    return np.stack([0.05 * x[0] + (1.0 + np.cos(t)) * u[0] + u[1]])


def scalar_loop(gain=None, **given):
    system = PeriodicSystem(
        growing, period=2 * np.pi, state_names=["x"], input_names=["control", "wind"]
    )
    return HeldFeedback(system, system.trim(2), gain, inputs=["control"], **given)


# ---- maps ----------------------------------------------------------------------------------------


def test_period_map_in_closed_form():
    plant = scalar_loop(samples_per_period=64)._plant
    a, T = 0.05, 2 * np.pi
    assert plant.Phi[0, 0] == pytest.approx(np.exp(a * T), rel=1e-12)
    forced = (np.exp(a * T) - 1.0) * (1.0 / a + a / (a**2 + 1.0))
    assert plant.Gamma[0, 0] == pytest.approx(forced, rel=1e-11)
    samples = np.exp(a * T * np.arange(64) / 64)
    assert plant.M[0, 0] == pytest.approx(samples.mean(), rel=1e-12)


def test_quadratic_gain_is_the_best_of_its_neighbours(rng):
    """Cost of the closed loop from its Lyapunov equation."""
    plant = PeriodMap(1.1 * rng.standard_normal((3, 3)), rng.standard_normal((3, 2)), None, None)
    sizes = [1.0, 2.0, 0.5], [0.7, 1.5]
    Q, R = (np.diag(np.array(s) ** -2.0) for s in sizes)

    def cost(K):
        closed = plant.Phi - plant.Gamma @ K
        return np.trace(linalg.solve_discrete_lyapunov(closed.T, Q + K.T @ R @ K))

    K = quadratic_gain(plant, *sizes)
    for _ in range(10):
        step = 1e-3 * rng.standard_normal(K.shape)
        assert cost(K + step) > cost(K)
        assert cost(K + step) - cost(K) == pytest.approx(cost(K - step) - cost(K), rel=0.1)


def test_out_of_reach_is_an_error():
    plant = PeriodMap(np.diag([1.5, 0.2]), np.array([[0.0], [1.0]]), None, None)
    with pytest.raises(ValueError, match="no gain stabilises the period map"):
        quadratic_gain(plant, [1.0, 1.0], [1.0])


def test_runge_kutta_is_of_order_four():
    """Halved steps leave a sixteenth of the error."""

    def f(x, u, t):
        return np.stack([x[1], -np.sin(x[0]) + u[0] * np.cos(t)])

    x0, u = np.array([[0.5, -1.0], [0.2, 0.0]]), np.array([[1.0, 0.3]])
    exact = np.array(
        [integrate(f, x0[:, k], u[:, k] * np.ones((2, 1)), [0.0, 2.0])[-1] for k in (0, 1)]
    )
    errors = [
        np.abs(runge_kutta(f, x0, u, 0.0, 2.0 / n, n) - exact.T).max(axis=0) for n in (40, 80)
    ]
    np.testing.assert_allclose(errors[0] / errors[1], 16.0, rtol=0.15)


# ---- the loop ------------------------------------------------------------------------------------


def test_it_stabilises_what_grows(loop):
    assert np.abs(np.linalg.eigvals(loop._plant.Phi)).max() > 1.03
    assert np.abs(loop.multipliers()[0]) < 0.75
    assert len(loop.multipliers()) == 8


def test_it_rests_in_the_trim(loop):
    u, y = loop.simulate(np.zeros((20, 2)))
    np.testing.assert_allclose(u, np.tile(loop.trim.inputs, (640, 1)), atol=3e-5)
    orbit = np.tile(loop.trim_samples(), (20, 1))
    np.testing.assert_allclose(y, orbit, atol=1e-4 * np.ptp(orbit, axis=0).max())


def test_inputs_are_what_the_equation_says(loop, rng):
    """u_k = u* + v_k − K (ȳ_{k−1} − ȳ*), noise of the sensors in ȳ."""
    v = 0.01 * rng.standard_normal((3, 8, 2))
    noise = 0.01 * rng.standard_normal((3, 8 * 32, 4))
    u, y = loop.simulate(v, noise=noise)
    u, y = u.reshape(3, 8, 32, 2), y.reshape(3, 8, 32, 4)
    np.testing.assert_array_equal(u, np.broadcast_to(u[:, :, :1], u.shape))
    means = y.mean(axis=2) - loop.trim_samples().mean(axis=0)
    expected = loop.trim.inputs + v[:, 1:] - means[:, :-1] @ loop.gain.T
    np.testing.assert_allclose(u[:, 1:, 0], expected, atol=1e-14)
    np.testing.assert_allclose(u[:, 0, 0], loop.trim.inputs + v[:, 0], atol=1e-15)


@pytest.mark.slow
def test_small_motions_follow_the_linear_map(loop, rng):
    v = 1e-5 * rng.standard_normal((15, 2))
    _, rest = loop.simulate(np.zeros((15, 2)))
    _, y = loop.simulate(v)
    means = (y - rest).reshape(15, 32, 4).mean(axis=1)
    plant, x, before = loop._plant, np.zeros(4), np.zeros(4)
    for k in range(15):
        u = v[k] - loop.gain @ before
        before = plant.M @ x + plant.N @ u
        x = plant.Phi @ x + plant.Gamma @ u
        np.testing.assert_allclose(means[k], before, atol=2e-4 * np.abs(means).max())


def test_records_at_once_or_one_by_one(loop, rng):
    v, noise = 0.01 * rng.standard_normal((2, 5, 2)), 1e-3 * rng.standard_normal((2, 160, 4))
    u, y = loop.simulate(v, noise=noise)
    for k in range(2):
        alone_u, alone_y = loop.simulate(v[k], noise=noise[k])
        np.testing.assert_allclose(alone_u, u[k], rtol=1e-9)
        np.testing.assert_allclose(alone_y, y[k], rtol=1e-9, atol=1e-9)


def test_disturbances_come_in_through_the_other_inputs():
    loop = scalar_loop(samples_per_period=16)
    assert loop.disturbances == ("wind",)
    wind = 0.3 * np.ones((120 * 16, 1))
    u, y = loop.simulate(np.zeros((120, 1)), disturbances=wind)
    np.testing.assert_array_equal(u[:, 1], 0.3)
    steady = y[-16:].mean()  # proportional feedback leaves an offset, and no growth
    assert steady == pytest.approx(y[-32:-16].mean(), rel=1e-6)
    assert u[-1, 0] == pytest.approx(-loop.gain[0, 0] * steady, rel=1e-6)


def test_outputs_of_its_own_need_a_gain():
    def doubled(x, u, t):
        return 2.0 * x

    system = PeriodicSystem(
        growing, doubled, period=2 * np.pi, state_names=["x"], input_names=["control", "wind"]
    )
    trim = system.trim(2)
    with pytest.raises(ValueError, match="gain=None assumes that the outputs are the states"):
        HeldFeedback(system, trim, inputs=["control"])
    same = scalar_loop(gain=[[0.2]])
    half = HeldFeedback(system, trim, [[0.1]], inputs=["control"])
    np.testing.assert_allclose(half.multipliers(), same.multipliers(), rtol=1e-9)


def test_too_weak_a_feedback_diverges_by_name():
    loop = scalar_loop(gain=[[0.0]], samples_per_period=2)
    with pytest.raises(RuntimeError, match=r"diverged in period \d+ of 2500; .* is 1\.37"):
        loop.simulate(np.ones((2500, 1)), substeps=1)


def test_a_regulator_too_slow_for_what_grows_is_refused(loop):
    """Cheap states: the gain of the means, which are old, would leave a growing pair."""
    with pytest.raises(ValueError, match=r"leaves a multiplier of size 1\.04.*change state_sizes"):
        HeldFeedback(
            loop.system, loop.trim, state_sizes=[0.1, 0.1, 10, 0.2], input_sizes=[0.15, 0.05]
        )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"trim": None}, "trim=None must be a PeriodicSystem and the result of its trim"),
        ({"inputs": ["thrust"]}, r"inputs=\['thrust'\] must be among those of the system"),
        ({"inputs": []}, r"inputs=\[\] must be among those"),
        ({"gain": [[1.0, 2.0]]}, r"gain has shape \(1, 2\); it must be \(2, 4\)"),
        ({"state_sizes": [1.0, 0.0, 1.0, 1.0]}, "state_sizes=.* must hold 4 positive sizes"),
        ({"input_sizes": [1.0]}, "input_sizes=.* must hold 2 positive sizes"),
        ({"samples_per_period": 1}, "samples_per_period must be a whole number of at least 2"),
    ],
)
def test_bad_settings_are_named(loop, given, message):
    settings = {"system": loop.system, "trim": loop.trim, **given}
    with pytest.raises(ValueError, match=message):
        HeldFeedback(**settings)


@pytest.mark.parametrize(
    ("v", "given", "message"),
    [
        (np.zeros((5, 3)), {}, r"v has shape \(5, 3\); it must be \(n_periods, 2\)"),
        (np.zeros((5, 2)), {"noise": np.zeros((5, 4))}, r"noise has shape \(5, 4\); .* \(160, 4\)"),
        (np.zeros((5, 2)), {"substeps": 0}, "substeps must be a whole number of at least 1"),
    ],
)
def test_bad_records_are_named(loop, v, given, message):
    with pytest.raises(ValueError, match=message):
        loop.simulate(v, **given)


# ---- make_hawkmoth -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flight():
    return make_hawkmoth(
        n_records=3, n_periods=30, samples_per_period=32, noise=0.05, gust=0.02, random_state=4
    )


def test_shapes_names_and_truth(flight):
    assert list(flight.inputs.columns) == list(flight.excitation.columns)
    assert list(flight.outputs.columns) == ["u", "w", "q", "theta"]
    assert len(flight.inputs) == len(flight.outputs) == 3 * 30 * 32
    assert flight.inputs.index.names == ["record", "time"]
    times = flight.outputs.loc[0].index
    np.testing.assert_allclose(np.diff(times), flight.sample_time, rtol=1e-9)
    np.testing.assert_allclose(flight.exponents, flight.ltp.floquet_exponents())
    assert flight.trim_span == pytest.approx((0.0, 8 * flight.trim.period))
    assert "0.02 m/s" in flight.DESCR


def test_excitation_begins_after_the_quiet_beats(flight):
    v = flight.excitation.to_numpy().reshape(3, 30, 32, 2)
    assert not v[:, :8].any()
    np.testing.assert_array_equal(np.abs(v[:, 8:]), 0.01)
    assert len(np.unique(v[:, 8:, 0].reshape(-1, 2), axis=0)) > 1


def test_the_flight_obeys_its_gain(flight):
    u, v = (flight[name].to_numpy().reshape(3, 30, 32, 2) for name in ("inputs", "excitation"))
    y = flight.outputs.to_numpy().reshape(3, 30, 32, 4).mean(axis=2)
    fed_back = u[:, 1:, 0] - v[:, 1:, 0] + y[:, :-1] @ flight.gain.T
    constant = fed_back.mean(axis=(0, 1))  # u* + K ȳ*
    np.testing.assert_allclose(fed_back - constant, 0.0, atol=1e-13)


@pytest.mark.slow
def test_noise_is_a_part_of_the_motion(flight):
    e = flight.outputs - flight.outputs_clean
    calm = make_hawkmoth(
        n_records=3, n_periods=30, samples_per_period=32, gust=0.02, random_state=4
    )
    pd.testing.assert_frame_equal(calm.excitation, flight.excitation)
    orbit = flight.trim.states(2 * np.pi * np.arange(32) / 32)
    motion = calm.outputs - np.tile(orbit, (90, 1))
    ratio = e.std() / np.sqrt((motion**2).mean())
    np.testing.assert_allclose(ratio, 0.05, rtol=0.05)
    assert np.abs(calm.inputs - flight.inputs).to_numpy().max() > 1e-4  # fed back


@pytest.mark.slow
def test_gusts_move_it():
    given = {"n_periods": 12, "samples_per_period": 16, "excitation": 0.0, "random_state": 0}
    still, windy = make_hawkmoth(**given), make_hawkmoth(gust=0.1, **given)
    again = make_hawkmoth(gust=0.1, **given)
    pd.testing.assert_frame_equal(windy.outputs, again.outputs)
    moved = (windy.outputs - still.outputs).abs().max()
    assert np.all(moved[["u", "w"]] > 1e-3)
    assert np.all(moved[["u", "w"]] < 0.1)


def test_excitation_as_given_and_no_quiet():
    v = np.zeros((1, 6, 2))
    v[0, 2] = [0.02, -0.01]
    data = make_hawkmoth(n_periods=6, samples_per_period=16, excitation=v, quiet=0)
    np.testing.assert_array_equal(data.excitation.to_numpy()[::16], v[0])
    assert data.trim_span is None
    assert data.inputs.index.name == "time"


def test_bunch_can_be_pickled(flight):
    again = pickle.loads(pickle.dumps(flight))
    pd.testing.assert_frame_equal(again.outputs, flight.outputs)


def identified(random_state=7, **given):
    """Floquet exponents from one flight, with the noise taken for independent of the inputs."""
    data = make_hawkmoth(samples_per_period=32, random_state=random_state, **given)
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(data.omega, reading="period", trim_span=data.trim_span)),
            ("identify", MOESPRegressor(order=4)),
        ]
    ).fit(data.inputs, data.outputs)
    exponents = np.log(pipe["identify"].eigenvalues_.astype(complex)) / data.trim.period
    return np.sort_complex(exponents), np.sort_complex(data.exponents)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.InstabilityWarning")
@pytest.mark.slow
def test_exponents_come_back_from_a_calm_flight():
    """As well as the excitation is small: what is left is the moth's being nonlinear."""
    errors = []
    for size in (1e-3, 1e-4, 1e-5):
        found, expected = identified(n_periods=60, excitation=size)
        errors.append(np.max(np.abs(found - expected)))
    assert errors[1] < 0.2 * errors[0]
    assert errors[2] < 2e-3


@pytest.mark.filterwarnings("ignore:.* within trim_span=")
@pytest.mark.filterwarnings("ignore:the periodic orbit is unstable")
@pytest.mark.slow
def test_gusts_that_are_fed_back_bias_the_growing_pair():
    found, wanted = identified(n_periods=150, excitation=3e-3, gust=0.05, random_state=102)
    grows = wanted[np.argmax(wanted.real)]
    assert abs(found[np.argmax(found.real)] - grows) > 0.25 * abs(grows)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"n_records": 0}, "n_records must be a whole number of at least 1"),
        ({"gust": -1.0}, "gust must be a nonnegative number"),
        ({"excitation": [0.1, 0.2, 0.3]}, r"excitation has shape \(3,\); give a size in rad"),
    ],
)
def test_bad_arguments_are_named(given, message):
    with pytest.raises(ValueError, match=message):
        make_hawkmoth(**given)


@pytest.mark.slow
def test_a_moth_that_turns_over_is_an_error():
    with pytest.raises(RuntimeError, match=r"the moth turns over in wingbeat \d+; excite it less"):
        make_hawkmoth(n_periods=40, samples_per_period=16, excitation=3.0, random_state=0)
    with pytest.raises(ValueError, match="quiet=20 exceeds n_periods=10"):
        make_hawkmoth(n_periods=10, quiet=20)


def test_a_moth_blown_over_is_an_error():
    with pytest.raises(RuntimeError, match="the closed loop diverged in period"):
        make_hawkmoth(n_periods=80, samples_per_period=16, gain=np.full((2, 4), 3.0), quiet=0)
