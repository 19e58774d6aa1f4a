"""Records of motions so large that a linear model does not hold: exponents of small motions."""

import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import make_pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    StructuredMatcher,
    report,
)
from sklearn_hd._identify import sample
from sklearn_hd._identify.sample import Samples
from sklearn_hd._identify.sample_models import Choice
from sklearn_hd._identify.stages import Settings
from sklearn_hd._records.data import read_for_fit
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning
from sklearn_hd.systems import duffing

OMEGA, SAMPLES, TURNS = 2.0, 16, 160


def oscillator(cubic=0.0, drag=0.0, square=0.0):
    """Mathieu's equation with a spring that is not linear, or drag of the speed squared."""

    def derivative(t, x, u):
        stiffness = 1.3 + 0.5 * np.cos(OMEGA * t)
        force = square * x[0] ** 2 + cubic * x[0] ** 3 + drag * abs(x[1]) * x[1]
        return np.array([x[1], -0.2 * x[1] - stiffness * x[0] - force + u])

    return derivative


def compressor(t, x, u):
    """Flow and pressure of a compressor whose throttle pulsates (Greitzer's model)."""
    flow = x[0] / 0.5 - 1.0
    rise = 0.3 + 0.6 * (1.0 + 1.5 * flow - 0.5 * flow**3)
    through = (0.8 + 0.1 * np.cos(2.2 * t) + u) * np.sqrt(x[1])
    return np.array([0.9 * (rise - x[1]), (x[0] - through) / 0.9])


def chemostat(t, x, u):
    """Nutrient and cells in a vessel whose dilution pulsates (Monod's growth)."""
    dilution = 0.28 * (1.0 + 0.6 * np.cos(0.5 * t))
    growth = 0.75 * x[0] / (0.45 + x[0])
    return np.array([dilution * (2.0 + u - x[0]) - growth * x[1], (growth - dilution) * x[1]])


def step(derivative, t, x, u, h):
    """One step of Runge and Kutta, of fourth order."""
    k1 = derivative(t, x, u)
    k2 = derivative(t + h / 2, x + h / 2 * k1, u)
    k3 = derivative(t + h / 2, x + h / 2 * k2, u)
    k4 = derivative(t + h, x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def transition(derivative, omega, orbit, size=1e-5):
    """Over one turn, about a state of the orbit, by central differences."""

    def turned(x, n=1024):
        h = 2.0 * np.pi / omega / n
        for k in range(n):
            x = step(derivative, k * h, x, 0.0, h)
        return x

    moves = size * np.eye(len(orbit))
    return np.column_stack([turned(orbit + m) - turned(orbit - m) for m in moves]) / (2.0 * size)


def oscillations(u, derivative, omega, samples, x, noise, rng):
    """Inputs and outputs as frames, noise in parts of the outputs' motion."""
    y, h = np.empty((len(u), 2)), 2.0 * np.pi / omega / samples
    for k in range(len(u)):
        y[k] = x
        for part in range(4):
            x = step(derivative, (k + part / 4) * h, x, u[k], h / 4)
    turn = y[:samples].mean(axis=0)
    y += noise * (y - turn).std(axis=0) * rng.standard_normal(y.shape)
    index = pd.Index(h * np.arange(len(u)), name="time")
    return pd.DataFrame({"u": u}, index), pd.DataFrame(y, index, ["y", "v"])


def exponent():
    """Of small motions, 1/s, with an imaginary part between 0 and ω/2."""
    multipliers = np.linalg.eigvals(transition(oscillator(), OMEGA, np.zeros(2))).astype(complex)
    found = np.log(multipliers) * OMEGA / (2.0 * np.pi)
    return found.real[0] + 1j * abs(found.imag[0])


def record(size=0.12, noise=0.01, seed=3, gust=0.0, **machine):
    """Random steps of an input, the position and the speed, as frames; a gust is not measured."""
    rng, n = np.random.default_rng(seed), SAMPLES * TURNS
    u, k = np.zeros(n), 0
    while k < n:
        width = int(rng.integers(2, 40))
        u[k : k + width] = size * rng.choice([-1, 0, 1])
        k += width
    drive = u + gust * size * rng.standard_normal(n)
    frames = oscillations(drive, oscillator(**machine), OMEGA, SAMPLES, np.zeros(2), noise, rng)
    return frames[0].assign(u=u), frames[1]


def fitted(u, y):
    frame = HarmonicAnalyzer(OMEGA, reading="sample").fit_transform(u, y)
    return MOESPRegressor().fit(frame, y)


def error(model):
    """How far the exponents are off, in parts of their decay rate."""
    found = model.ltp_.floquet_exponents()
    assert len(found) == 2
    truth = exponent()
    folded = found.real + 1j * np.abs((found.imag + OMEGA / 2) % OMEGA - OMEGA / 2)
    return np.max(np.abs(folded - truth)) / abs(truth.real)


@pytest.mark.parametrize(
    ("cubic", "noise", "most", "degree"),
    [
        (0.0, 0.01, 0.01, None),
        (0.6, 0.01, 0.01, 3),
        pytest.param(0.0, 0.0, 1e-4, None, marks=pytest.mark.slow),
        pytest.param(0.6, 0.0, 2e-3, 3, marks=pytest.mark.slow),
    ],
)
def test_exponents_are_those_of_small_motions(cubic, noise, most, degree):
    """A linear model of the same record is 20 to 30 % off where the spring is cubic."""
    model = fitted(*record(cubic=cubic, noise=noise))  # warnings are errors here
    assert error(model) < most
    assert (degree in model.nonlinear_degrees_) == (degree is not None)
    small, y = record(size=0.03, seed=9, cubic=cubic)
    frame = HarmonicAnalyzer(OMEGA, reading="sample").fit_transform(small, y)
    assert model.score(frame, y) > 0.998


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.CoordinatesWarning")
@pytest.mark.parametrize("seed", [5, 6, 7, 8])
def test_products_of_a_short_record_have_a_constant_effect(seed):
    """Thirty turns do not tell one that turns with ψ; linear models are 15, 18, 40 and 2 % off."""
    u, y = record(square=0.3, seed=seed)
    few = slice(30 * SAMPLES)
    model = fitted(u.iloc[few], y[["y"]].iloc[few])
    assert model.nonlinear_degrees_ == (2,)
    assert error(model) < 0.04


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.CoordinatesWarning")
def test_products_that_are_not_taken_up_still_have_a_word():
    """Squares pay in 30 turns, cubes do not: exponents are 27 % off, and both halves agree."""
    u, y = record(cubic=0.6, seed=1)
    few = slice(30 * SAMPLES)
    words = r"2 of 2 exponents are in doubt: .* its likelihood beside cubes of the motion has"
    with pytest.warns(IdentifiabilityWarning, match=words):
        model = fitted(u.iloc[few], y.iloc[few])
    assert model.nonlinear_degrees_ == (2,)
    assert error(model) > 0.1
    opinion = model.model_.opinion
    assert np.min(np.abs(opinion.exponents - exponent())) < 0.15 * abs(exponent().real)
    assert opinion.needed


def test_products_do_not_stand_for_gusts_that_exact_outputs_show():
    """What gusts leave of a simulation is no independent noise."""
    model = fitted(*record(noise=0.0, gust=0.02))
    assert model.nonlinear_degrees_ == ()
    assert error(model) < 0.03


@pytest.mark.slow
def test_predictions_that_are_exact_beside_products_lead_to_a_simulation():
    """Beside products of two they leave nothing for those of three, and exponents are 27 % off."""
    model = fitted(*record(seed=1, size=0.2, square=0.3, cubic=0.3, noise=0.0))
    assert model.nonlinear_degrees_ == (2, 3)
    assert error(model) < 2e-3


@pytest.mark.slow
def test_steps_go_on_while_they_move_an_exponent():
    """A doublet that shows the fast mode of a wing little: it is found after more than a few steps.

    From coordinates that turn far. With the outputs as states no steps pay beside the least noise
    of a sensor, and it is 5 % off.
    """
    doublet = {"start": 8, "width": 10, "amplitude": 0.005, "offset": 29 / 64}
    data = make_flapping_wing("nltp", n_periods=60, **doublet)
    analyzer = HarmonicAnalyzer(data.omega, reading="sample", output_harmonics=1)
    X = analyzer.fit_transform(data.inputs, data.outputs)
    own = data.ltp.floquet_exponents()
    closed = MOESPRegressor().fit(X, data.outputs).model_.exponents()
    assert np.max(np.abs(closed - own) / np.abs(own)) < 0.06
    experiment = read_for_fit(X, data.outputs)
    choice, *_ = Choice.of(sample.read(experiment, Settings()), Settings(), experiment.basis)
    far = choice.models[2] = choice._of(choice.states.known(2)[None])
    refined = choice.refined(choice.whole(far.best), far.best.stable)
    found = refined.innovations.multiplier_logarithms() * data.omega / (2.0 * np.pi)
    assert np.max(np.abs(found - own) / np.abs(own)) < 0.03


@pytest.mark.slow
def test_harmonics_stay_whose_lack_is_below_the_noise_of_a_sensor():
    """Exact data after a long doublet: three in place of eight move the slow mode by 2e-4."""
    data = make_flapping_wing("nltp", n_periods=60, start=8, width=20)
    analyzer = HarmonicAnalyzer(data.omega, reading="sample", output_harmonics=1)
    X = analyzer.fit_transform(data.inputs, data.outputs)
    model = MOESPRegressor().fit(X, data.outputs).model_
    assert model.opinion.of_small_motions
    own, found = data.ltp.floquet_exponents().real, model.exponents().real
    assert np.max(found) == pytest.approx(np.max(own), rel=5e-5)
    assert np.min(found) == pytest.approx(np.min(own), rel=3e-3)


@pytest.mark.slow
def test_loads_are_those_of_a_machine_at_rest():
    """Motions in a spring that is softer on one side shift the mean; without them nothing does."""
    u, y = record(square=0.5, size=0.1)
    analyzer = HarmonicAnalyzer(OMEGA, reading="sample")
    model = MOESPRegressor().fit(analyzer.fit_transform(u, y), y)
    assert 2 in model.nonlinear_degrees_
    assert error(model) < 0.005  # 0.04 about the mean motion
    still = model.predict(analyzer.transform(0.0 * u))
    assert abs(y["y"].mean()) > 0.015 * y["y"].std()
    assert np.max(np.sqrt(np.mean(still**2, axis=0)) / y.std()) < 0.005


@pytest.mark.slow
def test_motions_smaller_than_the_orbit_is_known_are_said_to_be():
    u, y = record(noise=0.05)
    analyzer = HarmonicAnalyzer(OMEGA, reading="sample")
    model = MOESPRegressor().fit(analyzer.fit_transform(u, y), y)
    off = np.sqrt(np.mean(model.predict(analyzer.transform(0.0 * u)) ** 2, axis=0))
    assert np.all(off < 3.0 * model.model_.orbit_deviation)
    assert np.all(model.model_.orbit_deviation < 0.01 * y.std())
    model.predict(analyzer.transform(u))  # large motions: no warning
    with pytest.warns(IdentifiabilityWarning, match="of the machine at rest only to within"):
        model.predict(analyzer.transform(0.01 * u))


@pytest.mark.slow
def test_the_report_says_that_the_model_is_of_small_motions(tmp_path):
    u, y = record(cubic=0.6)
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA, reading="sample"), MOESPRegressor()).fit(u, y)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report(pipe, u, y, tmp_path / "report.html")
    assert "the model is that of small motions" in (tmp_path / "report.html").read_text("utf-8")


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.CoordinatesWarning")  # of one output
def test_what_a_square_leaves_of_exact_data_does_not_smooth_the_effect_of_inputs():
    """It is 1e-7 of the record, and as smooth as if few rows were independent."""
    u = np.zeros(40 * 32)
    u[8 * 32 : 10 * 32 + 10], u[10 * 32 + 10 : 12 * 32 + 19] = 0.02, -0.02
    still = oscillator(square=0.1)

    def driven(t, x, u):
        return still(t, x, u * (1.0 + 0.5 * np.cos(OMEGA * t)))

    u, y = oscillations(u, driven, OMEGA, 32, np.zeros(2), 0.0, np.random.default_rng(0))
    y = y[["y"]]
    matcher = StructuredMatcher(structure=HarmonicStructure())
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA), MOESPRegressor(), matcher)
    assert pipe.fit(u, y)[0].basis_.reading == "period"
    assert pipe.score(u, y) > 0.9999


@pytest.mark.slow
def test_a_state_does_not_stand_for_the_second_order():
    """Without products a third state does, and both halves of the record agree on it."""
    omega, samples, rng = 2.2, 32, np.random.default_rng(26)
    start, h = np.array([0.94725932, 1.48191793]), 2.0 * np.pi / omega / 1024
    for k in range(10 * 1024):  # onto the orbit
        start = step(compressor, k * h, start, 0.0, h)
    u = np.zeros(60 * samples)
    at = samples // 2
    while at < len(u):
        width, size = int(samples * rng.uniform(0.3, 0.8)), 0.02 * rng.choice([-1, 1])
        for n, sign in ((3, 1), (2, -1), (1, 1), (1, -1)):
            u[at : at + n * width] = size * sign
            at += n * width
        at += int(samples * rng.uniform(0, 4))
    u, y = oscillations(u, compressor, omega, samples, start, 0.01, rng)
    model = MOESPRegressor().fit(HarmonicAnalyzer(omega, reading="sample").fit_transform(u, y), y)
    assert model.order_ == 2
    assert 2 in model.nonlinear_degrees_
    true = np.linalg.eigvals(transition(compressor, omega, start)).astype(complex)
    rate = np.log(np.abs(true)).mean() * omega / (2.0 * np.pi)
    np.testing.assert_allclose(model.ltp_.floquet_exponents().real, rate, rtol=0.1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_as_many_states_with_fewer_harmonics_may_do():
    """Before steps of the likelihood eight harmonics leave less: -2.35 1/s for -1.216."""
    omega, samples, start = 0.5, 64, np.array([0.51071752, 1.48928248])
    u = np.zeros(60 * samples)
    u[8 * samples : 8 * samples + 6], u[8 * samples + 6 : 8 * samples + 12] = 0.05, -0.05
    rng = np.random.default_rng(0)
    exact, still = (
        oscillations(each, chemostat, omega, samples, start, 0.0, rng)[1] for each in (u, 0.0 * u)
    )
    noise = 0.01 * np.random.default_rng(1).standard_normal(exact.shape)
    y = exact + noise * (exact - still).std().to_numpy()
    analyzer = HarmonicAnalyzer(omega, reading="sample", output_harmonics=2)
    model = MOESPRegressor().fit(analyzer.fit_transform(pd.DataFrame({"u": u}, y.index), y), y)
    assert (model.order_, model.n_harmonics_) == (2, 2)
    true = np.log(np.abs(np.linalg.eigvals(transition(chemostat, omega, start))))
    rates = np.sort(model.ltp_.floquet_exponents().real)
    np.testing.assert_allclose(rates, np.sort(true) * omega / (2.0 * np.pi), rtol=0.25)
    assert rates[1] == pytest.approx(-0.28, rel=0.01)


@pytest.mark.slow
def test_the_pass_about_rest_begins_with_the_gain_of_the_linear_model():
    """With that beside products its start forgot nothing, and A stayed about the mean."""
    u, y = record(seed=6, square=0.5)
    frame = HarmonicAnalyzer(OMEGA, reading="sample").fit_transform(u, y)
    assert error(MOESPRegressor(order=2).fit(frame, y)) < 0.01


def test_an_input_with_a_trim_is_held_and_the_others_rest_at_zero():
    """The second input's trim is a wave without a mean, as that of a blade's cyclic pitch."""
    means, scales = np.array([[2.0, 0, 0.1], [0.3, 0.6, 0], [0, 0.6, 0.2]]), np.full(3, 0.5)
    samples = Samples([], (means, None), (scales, None), None, 0.1)
    assert samples.trim_in_inputs
    np.testing.assert_array_equal(samples.rest, [[0, 0, -0.2], [0, 0, 0], [0, 0, -0.4]])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.parametrize("seed", [0, 1])
def test_smooth_inputs_have_as_many_lags_as_tell_the_states(seed):
    """A multisine is predicted by few earlier rows; with these the order came out as 5 to 8."""

    def forced(t, x, u):  # van der Pol's oscillator, whose motion begins at its orbit
        bend = 0.4 * (1.0 - x[0] ** 2) * x[1]
        return np.array([x[1], bend - x[0] + (1.2 + u) * np.cos(1.1 * t)])

    samples, turns, rng = 24, 70, np.random.default_rng(seed)
    start, h = np.array([1.0, 0.0]), 2.0 * np.pi / 1.1 / 256
    for k in range(40 * 256):
        start = step(forced, k * h, start, 0.0, h)
    waves = np.arange(1, 30) * 3.0 / turns
    t = np.arange(turns * samples) / samples
    waves = np.sin(2.0 * np.pi * np.outer(t, waves) + rng.uniform(0.0, 2.0 * np.pi, 29))
    u, y = oscillations(0.006 * waves.sum(axis=1), forced, 1.1, samples, start, 0.0, rng)
    still = oscillations(0.0 * t, forced, 1.1, samples, start, 0.0, rng)[1]
    y += 0.01 * (y - still).std().to_numpy() * rng.standard_normal(y.shape)
    frame = HarmonicAnalyzer(1.1, reading="sample").fit_transform(u, y[["y"]])
    model = MOESPRegressor().fit(frame, y[["y"]])
    assert model.order_ == 2
    true = np.linalg.eigvals(transition(forced, 1.1, start)).astype(complex)
    found = np.sort(model.ltp_.floquet_exponents().real)
    np.testing.assert_allclose(found, np.sort(np.log(np.abs(true))) * 1.1 / (2.0 * np.pi), rtol=0.1)


def bent_sensor(noise, seed):
    """A lag under steps to −1 and 1, whose sensor adds 0.3 of the square; its exponent is −0.3."""
    rng, n, dt = np.random.default_rng(seed), 100 * SAMPLES, 2.0 * np.pi / OMEGA / SAMPLES
    u, x = np.repeat(rng.choice([-1.0, 1.0], n // 4), 4), np.zeros(n)
    for k in range(n - 1):
        x[k + 1] = np.exp(-(0.3 + 0.2 * np.cos(OMEGA * dt * k)) * dt) * x[k] + dt * u[k]
    x /= x.std()
    y = x + 0.3 * x**2 + noise * rng.standard_normal(n)
    time = pd.Index(dt * np.arange(n), name="time")
    u, y = pd.DataFrame({"u": u}, time), pd.DataFrame({"y": y}, time)
    return HarmonicAnalyzer(OMEGA, reading="sample").fit_transform(u, y), y


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.filterwarnings("ignore:1 of 1 exponents:sklearn_hd.exceptions.IdentifiabilityWarning")
def test_steps_between_two_levels_have_no_square(seed):
    """It is constant but for rounding, by which the orbit at rest must not be divided."""
    frame, y = bent_sensor(0.05, seed)
    model = MOESPRegressor().fit(frame, y)
    assert model.nonlinear_degrees_
    assert abs(model.ltp_.floquet_exponents()[0] + 0.3) < 0.01
    assert model.score(frame, y) > 0.8
    assert np.max(np.abs(model.predict(frame))) < 2.0 * np.max(np.abs(y.to_numpy()))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_square_that_moves_about_periodic_means_alone_is_left_out_about_rest(seed):
    """Random steps between two levels have such means; about zero their square is constant."""
    rng, n, dt = np.random.default_rng(seed), 60 * 24, 2.0 * np.pi / 24
    t, before = dt * np.arange(n), 24 * 20
    u = 0.05 * rng.choice([-1.0, 1.0], (n, 3))[np.floor(t / (0.37 * 24 * dt)).astype(int)]

    def oven(u):
        x, u = np.zeros(before + n), np.vstack([np.zeros((before, 3)), u])
        for k in range(len(x) - 1):
            s, (a, b, c) = dt * (k - before), u[k]
            heat = 0.35 * (1.0 + 0.8 * np.cos(s)) * (a - x[k]) + 0.3 * np.cos(s)
            heat += 0.2 * (1.0 + 0.5 * np.sin(2.0 * s)) * b + 0.15 * (1.0 + 0.9 * np.sin(s)) * c
            x[k + 1] = x[k] + dt * (heat - 0.08 * ((1.0 + 0.4 * x[k]) ** 4 - 1.0))
        return x[before:]

    x, still = oven(u), oven(0.0 * u)
    time = pd.Index(t, name="time")
    u = pd.DataFrame(u, time, ["a", "b", "c"])
    y = pd.DataFrame({"y": x + 0.01 * (x - still).std() * rng.standard_normal(n)}, time)
    frame = HarmonicAnalyzer(1.0, reading="sample").fit_transform(u, y)
    model = MOESPRegressor().fit(frame, y)
    left = model.predict(frame).to_numpy().ravel() - x
    assert np.var(left) < 0.01 * np.var(x - still)


@pytest.mark.filterwarnings("ignore:1 of 1 exponents:sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.slow
def test_motions_that_hide_the_small_ones_get_one_linear_model():
    frame, y = bent_sensor(0.3, 4)
    with pytest.warns(IdentifiabilityWarning, match="too large to tell the small ones"):
        model = MOESPRegressor().fit(frame, y)
    assert model.nonlinear_degrees_ == ()
    assert model.score(frame, y) > 0.75


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:2 of 2 exponents:sklearn_hd.exceptions.IdentifiabilityWarning")
def test_large_motions_of_a_stable_machine_do_not_make_it_grow():
    """The model of least criterion has 11 states, and grows by e^200 over the record."""
    n = 100 * SAMPLES
    t = np.arange(n) / n
    u = 0.6 * np.sin(2.0 * np.pi * (2.0 * t + 60.0 * t**2)) * (t > 0.05)
    rng = np.random.default_rng(0)
    X, y = oscillations(u, oscillator(cubic=0.6), OMEGA, SAMPLES, np.zeros(2), 0.0, rng)
    with pytest.warns(InstabilityWarning, match="11 states .* e\\^200 .* the best stable model"):
        model = fitted(X, y)
    assert np.max(np.abs(model.model_.eigenvalues())) < 1.0
    frame = HarmonicAnalyzer(OMEGA, reading="sample").fit_transform(X, y)
    assert model.score(frame, y) > 0.5


@pytest.mark.slow
def test_what_products_do_not_take_up_is_told():
    """A drag that grows with the speed squared is no sum of products."""
    with pytest.warns(IdentifiabilityWarning, match="smaller motions of the record have"):
        model = fitted(*record(drag=1.2))
    assert error(model) > 0.1


@pytest.mark.filterwarnings("ignore:the outputs .* do not determine")
@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_fewer_harmonics_of_a_match_move_no_exponent(seed):
    """F of an orbit that is no sine has many: two of them moved it by 4 % without a word."""
    system, rng = duffing(damping=0.3, hardening=0.5, omega=1.3), np.random.default_rng(seed)
    t = 2.0 * np.pi / 1.3 / SAMPLES * np.arange(100 * SAMPLES)
    u = 0.03 * np.repeat(rng.choice([-1.0, 0.0, 1.0], len(t) // 16), 16)
    orbit = system.trim(20).initial_state
    y, still = system.simulate(u, t, orbit), system.simulate(0.0 * u, t, orbit)
    y = y + 0.05 * (y - still).std(axis=0) * rng.standard_normal(y.shape)
    index = pd.Index(t, name="time")
    steps = HarmonicAnalyzer(1.3, reading="sample"), MOESPRegressor()
    pipe = make_pipeline(*steps, StructuredMatcher(structure=HarmonicStructure()))
    pipe.fit(pd.DataFrame({"u": u}, index), pd.DataFrame(y, index, ["y", "v"]))
    identified, matched = (
        np.sort_complex(step.ltp_.floquet_exponents()) for step in (pipe[1], pipe[2])
    )
    assert np.max(np.abs(matched - identified)) < 0.005 * 0.15
    assert np.max(np.abs(matched - [-0.15 - 0.3355j, -0.15 + 0.3355j])) < 0.01 * 0.15


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_likelihood_whose_few_harmonics_do_not_converge_begins_with_all_of_them():
    """Three iterations are too few; from all of them it leaves less than the closed form."""
    system = duffing(damping=0.3, hardening=0.5, omega=1.3)
    t = 2.0 * np.pi / 1.3 / 64 * np.arange(64 * 60)
    u = np.repeat([0.0, 0.03, -0.03, 0.0], 64 * np.array([8, 6, 6, 40]))
    y = system.simulate(u, t, system.trim(20).initial_state)
    index = pd.Index(t, name="time")
    u, y = pd.DataFrame({"u": u}, index), pd.DataFrame(y, index, ["y", "v"])
    left = []
    for criterion in ("least_squares", "output_error"):
        match = StructuredMatcher(structure=HarmonicStructure(), criterion=criterion, max_iter=3)
        steps = HarmonicAnalyzer(1.3, reading="sample"), MOESPRegressor(), match
        off = make_pipeline(*steps).fit(u, y).predict(u) - y
        left.append(np.sum(off.to_numpy() ** 2))
    assert left[1] < left[0]


@pytest.mark.parametrize("offset", [0, 50])
@pytest.mark.slow
def test_exact_decays_show_small_motions_beside_the_second_order(offset):
    """Exponents and mode shapes of the flapping wing after one doublet of 2 %."""
    data = make_flapping_wing("nltp", n_periods=60, start=8, width=10, offset=offset / 64)
    steps = MOESPRegressor(), StructuredMatcher(structure=HarmonicStructure())
    pipe = make_pipeline(HarmonicAnalyzer(data.omega), *steps).fit(data.inputs, data.outputs)
    exact, found = data.ltp.floquet_exponents(), pipe[-1].ltp_.floquet_exponents()
    np.testing.assert_allclose(np.sort(found.real), np.sort(exact.real), rtol=2e-3)
    assert np.max(found.real) == pytest.approx(np.max(exact.real), rel=1e-6)
    names = list(data.A_exact.index)
    rows = [list(pipe[-1].system_.state_labels).index(name) for name in names]
    off = pipe[-1].system_.A[np.ix_(rows, rows)] - data.A_exact.to_numpy()
    assert np.linalg.norm(off) < 6e-4 * np.linalg.norm(data.A_exact)
