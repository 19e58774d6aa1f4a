"""Inputs that move as no record showed: predictions say so; right extrapolations do not."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from scipy.linalg import expm
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.periodic.periodic_innovations import (
    PeriodicInnovations,
    input_slopes,
)
from sklearn_hd.algorithms.signals.fourier import InputDirections, harmonic_functions
from sklearn_hd.exceptions import CoordinatesWarning, ExcitationWarning, IdentifiabilityWarning
from sklearn_hd.systems import LTPSystem, PeriodicSystem, duffing

SPP, TRIM = 32, 8  # samples a period of 2π; periods at rest before the inputs
PSI = 2.0 * np.pi * (np.arange(SPP) + 0.5) / SPP


def doublet(n_periods, width, size, offset=0):
    """Up, then down, from some sample of the period on."""
    u, first = np.zeros((n_periods * SPP, 1)), TRIM * SPP + offset
    u[first : first + width * SPP] = size
    u[first + width * SPP : first + 2 * width * SPP] = -size
    return u


def oscillator(u, stiffness=0.0, gain=0.0):
    """Position and speed of an oscillator, of a stiffness and a gain that may go with ψ."""
    steps = []
    for psi in PSI:
        F = np.zeros((3, 3))
        F[:2, :2] = [[0.0, 1.0], [-0.3 - stiffness * np.cos(psi), -0.15]]
        F[1, 2] = 1.0 + gain * np.cos(psi)
        steps.append(expm(F * 2.0 * np.pi / SPP))
    x, states = np.zeros(2), np.empty((len(u), 2))
    for k, push in enumerate(u[:, 0]):
        states[k] = x
        x = (steps[k % SPP] @ np.append(x, push))[:2]
    return states


def frames(u, y):
    time = pd.Index(2.0 * np.pi / SPP * np.arange(len(u)), name="time")
    names = ([f"u{i}" for i in range(u.shape[1])], [f"y{i}" for i in range(y.shape[1])])
    return tuple(pd.DataFrame(z, time, n) for z, n in zip((u, y), names, strict=True))


def record(outputs, **machine):
    """One doublet whose edges are all at ψ = 0, with 1 % noise."""
    u = doublet(60, 6, 1.0)
    y = oscillator(u, **machine)[:, :outputs]
    noise = 0.01 * y.std(axis=0) * np.random.default_rng(1).standard_normal(y.shape)
    return frames(u, y + noise)


def pipeline(reading, n_steps, criterion="hinf"):
    steps = [
        ("harmonics", HarmonicAnalyzer(1.0, output_harmonics=1, reading=reading)),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
        ("match", StructuredMatcher(structure=HarmonicStructure(), criterion=criterion)),
    ]
    steps[0][1].set_params(trim_span=(0.0, TRIM * 2.0 * np.pi))
    return Pipeline(steps[:n_steps])


def fitted(pipe, data):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of coordinates, and of what is left
        return pipe.fit(*data)


def predicted(pipe, offset, **machine):
    """R² of a shorter doublet, and what was said of its inputs."""
    u = doublet(40, 3, -0.7, offset)
    X, _ = frames(u, u)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        y = pipe.predict(X).to_numpy()
    truth = oscillator(u, **machine)[:, : y.shape[1]]
    return 1.0 - np.sum((y - truth) ** 2) / np.sum(truth**2), [
        str(w.message) for w in told if w.category is ExcitationWarning
    ]


@pytest.mark.parametrize("reading", ["period", "sample"])
@pytest.mark.slow
def test_a_hidden_state_pushed_at_phases_never_excited_is_said_to_be(reading):
    """Position alone of Mathieu's equation: F(ψ) is told, G(ψ) at one phase only."""
    machine = {"stiffness": 0.2}
    pipe = fitted(pipeline(reading, {"period": 4, "sample": 2}[reading]), record(1, **machine))
    same, silent = predicted(pipe, 0, **machine)
    other, told = predicted(pipe, 10, **machine)
    assert same > 0.9999
    assert silent == []
    assert other < 0.99
    assert len(told) == 1
    assert "inputs ['u0'] move at phases of the period" in told[0]
    assert "record inputs" in told[0]


@pytest.mark.slow
@pytest.mark.parametrize("machine", [{}, {"stiffness": 0.2}, {"gain": 0.8}], ids=str)
@pytest.mark.parametrize("criterion", ["hinf", "output_error"])
def test_measured_states_show_the_effect_of_inputs_at_all_phases(machine, criterion):
    pipe = fitted(pipeline("period", 4, criterion), record(2, **machine))
    share, told = predicted(pipe, 10, **machine)
    assert share > 0.999
    assert told == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reading", "n_steps"), [("period", 4), ("sliding", 3), ("sample", 2), ("sample", 4)]
)
def test_few_harmonics_that_are_right_extrapolate_in_silence(reading, n_steps):
    """A time-invariant oscillator, of which the position is measured."""
    pipe = fitted(pipeline(reading, n_steps), record(1))
    share, told = predicted(pipe, 10)
    assert share > 0.9999
    assert told == []


@pytest.mark.parametrize("n_steps", [2, 3])
@pytest.mark.slow
def test_a_model_of_whole_periods_says_what_share_of_the_motion_is_new(n_steps):
    """Edges 10 of 32 samples later: 1 (1 + 4 + 1) f (1 − f) of 6 periods."""
    pipe = fitted(pipeline("period", n_steps), record(1))
    assert predicted(pipe, 0)[1] == []
    (told,) = predicted(pipe, 10)[1]
    f = 10 / SPP
    assert told.startswith(f"{6 * f * (1 - f) / 6:.2g} of the energy of the inputs ['u0']")
    assert "StructuredMatcher" in told


@pytest.mark.slow
def test_what_was_shown_survives_pickle_and_clone_and_is_silent_in_searches():
    data = record(1, stiffness=0.2)
    pipe = fitted(pipeline("period", 4), data)
    again = pickle.loads(pickle.dumps(pipe))
    assert predicted(again, 10)[1] == predicted(pipe, 10)[1] != []
    assert predicted(fitted(clone(again), data), 10)[1] != []
    u = doublet(40, 3, -0.7, 10)
    late = frames(u, oscillator(u, stiffness=0.2)[:, :1])
    with pytest.warns(ExcitationWarning, match="standard deviation of the predicted motion"):
        pipe.score(*late)
    X, y = (pd.concat([a, b], keys=["first", "second"]) for a, b in zip(data, late, strict=True))
    first = np.arange(len(X)) < len(data[0])
    folds = [(np.flatnonzero(first), np.flatnonzero(~first))]
    search = GridSearchCV(pipeline("period", 2), {"identify__order": [1, 2]}, cv=folds, refit=False)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        search.fit(X, y)
    assert [w for w in told if "energy of the inputs" in str(w.message)] == []


# ---- inputs that move together ---------------------------------------------------------------


def steps(n, seed=0):
    rng, u, k = np.random.default_rng(seed), np.zeros((n, 1)), TRIM * SPP
    while k < n:
        width = int(rng.integers(5, 40))
        u[k : k + width] = rng.choice([-1, 0, 1])
        k += width
    return u


@pytest.mark.parametrize(
    ("reading", "n_steps", "factor", "offset"),
    [
        *(("plain", 1, factor, 0.0) for factor in (1.0, -2.5, 1.0 + 1e-9)),
        *(("period", 2, factor, 0.0) for factor in (1.0, -2.5, 1.0 + 1e-9)),
        *(("sample", 2, factor, 0.0) for factor in (1.0, -2.5, 1.0 + 1e-9)),
        ("sample", 2, 1.8, 32.0),
        ("period", 4, -2.5, 0.0),
        ("sliding", 3, -2.5, 0.0),
    ],
)
@pytest.mark.slow
def test_twin_inputs_are_named_and_share_their_effect(reading, n_steps, factor, offset):
    """Each by itself has no effect that the record tells; together they have the right one."""
    u = steps(80 * SPP)
    y = oscillator(u)[:, :1]
    y += 1e-3 * y.std() * np.random.default_rng(0).standard_normal(y.shape)
    X, y = frames(np.hstack([u, factor * u + offset]), y)
    pipe = pipeline(reading, n_steps)
    if reading == "plain":
        pipe = Pipeline([("identify", MOESPRegressor())])
    alone = fitted(clone(pipe), (X[["u0"]], y)).score(X[["u0"]], y)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pipe.fit(X, y)
    words = [str(w.message) for w in told if w.category is IdentifiabilityWarning]
    assert any("['u0', 'u1'] never move separately" in text and "drop" in text for text in words)
    assert pipe.score(X, y) > alone - 0.01
    apart = X.assign(u1=offset)
    with pytest.warns(ExcitationWarning, match=r"of the energy of the inputs \['u0', 'u1'\]"):
        moved = pipe.predict(apart).to_numpy()
    assert np.max(np.abs(moved)) < 2.0 * np.max(np.abs(y.to_numpy()))


def test_twin_inputs_in_chunks_have_finite_effects():
    u = steps(3000)
    y = oscillator(u)
    X = np.hstack([u, -2.5 * u])
    model = MOESPRegressor(2, block_rows=8)
    for rows in np.split(np.arange(3000), 3):
        with pytest.warns(ExcitationWarning):
            model.partial_fit(X[rows], y[rows])
    assert np.max(np.abs(model.model_.B)) < 1.0
    assert model.score(X, y) > 0.999


# ---- the mathematics -------------------------------------------------------------------------


def test_slopes_times_coefficients_are_what_inputs_make(rng):
    """Outputs are linear in the coefficients of B(ψ) and D(ψ), in pieces as in one."""
    n, m, n_outputs, H = 3, 2, 2, 1
    coefficients = 0.2 * rng.standard_normal((2 * H + 1, n + n_outputs, n + m + 1))
    gain = np.zeros((1, n, n_outputs))
    model = PeriodicInnovations(coefficients, gain, np.eye(n_outputs), 0.3)
    psi, u, x0 = 0.3 * np.arange(50), rng.standard_normal((50, m)), rng.standard_normal(n)
    pieces, end = [], None
    for some in (slice(0, 20), slice(20, 50)):
        functions = harmonic_functions(psi[some], range(H + 1))
        piece, end = input_slopes(model.rows(psi[some]), u[some], functions, end)
        pieces.append(piece)
    slopes = np.concatenate(pieces)
    B = coefficients[:, :n, n:-1].transpose(1, 0, 2).ravel()
    D = coefficients[:, n:, n:-1].transpose(1, 0, 2).ravel()
    np.testing.assert_allclose(slopes[..., n:-2] @ np.append(B, D), slopes[..., -2], atol=1e-12)
    simulated = model.rows(psi).simulated(u, x0)
    parts = slopes[..., :n] @ x0 + slopes[..., -2] + slopes[..., -1]
    np.testing.assert_allclose(parts, simulated, atol=1e-12)


def test_directions_of_inputs_are_those_that_they_moved_in(rng):
    """Whatever the units; rounding and what may be noise are no directions."""
    shapes = rng.standard_normal((2, 8, 2))
    rows = np.einsum("kr,rpm->kpm", rng.standard_normal((30, 2)), shapes) * [1.0, 1e6]
    found = InputDirections.of([rows[:10], rows[10:]])
    assert found.moved.shape == (16, 2)
    assert found.outside([rows])[0] < 1e-20
    other = rng.standard_normal((1, 8, 2)) * found.size
    flat = (other / found.size).ravel()
    left = flat - found.moved @ (found.moved.T @ flat)
    share, each = found.outside([other])
    assert share == pytest.approx(left @ left / (flat @ flat))
    np.testing.assert_allclose(each, np.sum(left.reshape(8, 2) ** 2, axis=0))
    noisy = rows + 1e-4 * found.size * rng.standard_normal(rows.shape)
    assert InputDirections.of([noisy], left_out=1e-4).moved.shape == (16, 2)


def test_inputs_that_are_sums_of_others_are_told_from_those_that_are_not(rng):
    a, b, c = rng.standard_normal((3, 200))
    u = np.stack([a, c, b, 1e3 * a - b], axis=1)[:, None]
    assert InputDirections.of([u]).together.tolist() == [0, 2, 3]
    assert InputDirections.of([u[..., :3]]).together.tolist() == []
    fahrenheit = np.stack([a, c, 1.8 * a + 32.0], axis=1)[:, None]
    assert InputDirections.of([fahrenheit]).together.tolist() == []
    found = InputDirections.of([fahrenheit], about_mean=True)
    assert found.together.tolist() == [0, 2]
    assert found.outside([fahrenheit + 5.0 * np.array([1.0, 3.0, 1.8])])[0] < 1e-12


# ---- a machine that is not linear ---------------------------------------------------------------


@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.01])
def test_of_inputs_at_one_phase_the_smoothest_input_matrix_is_good_at_another(noise):
    """Position alone leaves G open; what the linear model leaves is not white."""
    system = duffing()
    orbit = system.trim()

    def flown(n_periods, width, size, offset=0):
        u = doublet(n_periods, width, size, offset)
        time = pd.Index(system.period / SPP * np.arange(len(u)), name="time")
        y = system.simulate(u, time, orbit.initial_state, rtol=1e-9, atol=1e-11)[:, [0]]
        motion = y - np.tile(y[:SPP], (n_periods, 1))
        return pd.DataFrame(u, time, ["u"]), pd.DataFrame(y, time, ["x"]), motion

    u, y, motion = flown(60, 6, 0.05)
    y += noise * motion.std() * np.random.default_rng(0).standard_normal(y.shape)
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(system.omega, trim_span=(0.0, TRIM * system.period))),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Floquet coordinates, and of these inputs
        pipe.fit(u, y)
        u, y, motion = flown(40, 3, -0.035, offset=5 * SPP // 16)
        off = pipe.predict(u).to_numpy() - y.to_numpy()
    assert np.sum(off**2) < 0.1 * np.sum(motion**2)


def roll(x, u, t):
    """A ship in waves, heeled by wind; damping goes with the square of the rate."""
    phi, rate = x
    waves = 0.12 * np.cos(0.8 * t + 0.4) - 0.3 * np.cos(0.8 * t) * phi
    return np.array(
        [rate, waves - phi + 0.5 * phi**3 - 0.1 * rate - 0.25 * rate * abs(rate) + 0.08 + u[0]]
    )


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["output_error", "prediction_error"])
def test_likelihoods_do_not_follow_noise_where_no_phase_tells_the_input_matrix(criterion):
    """Their edges are at two phases: without a prior, predictions are at least 1e4 times off."""
    ship = PeriodicSystem(
        roll,
        lambda x, u, t: x[:1],
        period=2.0 * np.pi / 0.8,
        state_names=["roll", "rate"],
        input_names=["heel"],
        output_names=["roll"],
    )
    trim, samples = ship.trim(), 17.3

    def sailed(n_turns, *moves):
        t = np.arange(int(n_turns * samples)) * ship.period / samples
        u = np.zeros((len(t), 1))
        for begin, end, size in moves:
            u[int(begin * samples) : int(end * samples)] = size
        y, rest = (
            ship.simulate(each, t, trim.initial_state, rtol=1e-8, atol=1e-10)
            for each in (u, 0.0 * u)
        )
        index = pd.Index(t, name="time")
        return pd.DataFrame(u, index, ["heel"]), pd.DataFrame(y, index, ["roll"]), y - rest

    def multistep(begin, size):
        for width in (4.5, 3.0, 1.5, 1.5):
            yield begin, begin + width, size
            begin, size = begin + width, -size

    u, y, motion = sailed(120, *multistep(6.3, 0.01), *multistep(28.8, -0.01))
    y += 0.01 * motion.std() * np.random.default_rng(0).standard_normal(y.shape)
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(0.8, reading="sample", trim_span=(0, 6 * ship.period))),
            ("identify", MOESPRegressor()),
            ("match", StructuredMatcher(structure=HarmonicStructure(), criterion=criterion)),
        ]
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Floquet coordinates, and of these inputs
        pipe.fit(u, y)
        u, y, motion = sailed(30, (3.37, 5.9, 0.01), (5.9, 9.2, -0.01), (9.2, 9.9, 0.01))
        off = pipe.predict(u).to_numpy() - y.to_numpy()
    assert np.sum(off**2) < 0.02 * np.sum(motion**2)


@pytest.mark.slow
def test_harmonics_that_coordinates_bring_need_no_record():
    """Floquet coordinates give G more harmonics than the samples determined, or can."""
    F = [[[-1.0, 0.0], [0.0, -3.0]], [[0.3, 0.2], [0.0, 0.5]], [[0.0, 0.4], [0.3, 0.0]]]
    system = LTPSystem(F, [[1.0], [0.5]], [[1.0, 0.5]], omega=6.0)

    def held_steps(seed):
        rng, t = np.random.default_rng(seed), np.arange(3000) * system.period / 40
        u = np.repeat(rng.choice([-1.0, 0.0, 1.0], 100), 33)[:3000, None]
        y = np.asarray(system.simulate(u, t)) + 2e-3 * rng.standard_normal((3000, 1))
        return (pd.DataFrame(z, pd.Index(t, name="time"), [n]) for n, z in (("u", u), ("y", y)))

    steps = [
        ("harmonics", HarmonicAnalyzer(system.omega, reading="sample")),
        ("identify", MOESPRegressor(2)),
        ("match", StructuredMatcher(structure=HarmonicStructure())),
    ]
    with pytest.warns(CoordinatesWarning, match="Floquet coordinates"):
        pipe = Pipeline(steps).fit(*held_steps(0))
    match, identify = pipe["match"], pipe["identify"]
    assert match.match_.periodic.highest("G") > identify.n_harmonics_
    assert match._excitation.n_harmonics == identify.n_harmonics_
    assert pipe.score(*held_steps(1)) > 0.999
    few = Pipeline([*steps[:2], ("match", StructuredMatcher(structure=HarmonicStructure(G=0)))])
    with pytest.warns(CoordinatesWarning):
        few.fit(*held_steps(0))
    assert few["match"]._excitation.n_harmonics == 0  # a structure that allows fewer keeps its own


@pytest.fixture(scope="module")
def flown():
    """A model of an oscillator about an orbit that is larger than its motion; the record."""
    u, y = record(2)
    orbit = 2.0 + np.cos(y.index.to_numpy()[:, None] + [0.0, 0.5])
    y = y + 3.0 * y.std().to_numpy() * orbit
    return fitted(pipeline("sample", 2).set_params(harmonics__trim_span="auto"), (u, y)), u, y


OTHER_ORBIT = "the record scored has a waveform that repeats with every turn and that the model"


@pytest.mark.parametrize(
    "other",
    [
        lambda y: np.pi / 180.0 * y,
        lambda y: -y,
        lambda y: y.set_axis(y.index + 1.0),
        lambda y: y[["y1", "y0"]].set_axis(["y0", "y1"], axis=1),
    ],
    ids=["units", "sign", "clock", "swapped"],
)
def test_a_record_about_another_orbit_is_told(flown, other):
    pipe, u, y = flown
    assert pipe.score(u, y) > 0.999
    y = other(y)
    with pytest.warns(IdentifiabilityWarning, match=OTHER_ORBIT):
        score = pipe.score(u.set_axis(y.index), y)
    assert score < 0.6


@pytest.mark.parametrize(
    "other",
    [
        lambda y: y + np.array([0.0, 5.0]),
        lambda y: y + 0.01 * y.index.to_numpy()[:, None],
        lambda y: y + np.exp(0.1 * y.index.to_numpy()[:, None]),
        lambda y: y + 1e-9 * np.cos(2.0 * y.index.to_numpy()[:, None]),
    ],
    ids=["mean", "drift", "growth", "little"],
)
def test_a_bad_model_is_not_said_to_be_about_another_orbit(flown, other):
    pipe, u, y = flown
    pipe.score(u, other(y))  # warnings are errors


def test_few_turns_and_searches_tell_of_no_orbit(flown):
    pipe, u, y = flown
    assert pipe.score(u[: 4 * SPP], -y[: 4 * SPP]) < 0.6  # of which warm-up takes some
    with pytest.warns(IdentifiabilityWarning, match=OTHER_ORBIT):
        pipe.score(u[: 12 * SPP], -y[: 12 * SPP])
    first, later = np.array_split(np.arange(len(u)), 2)
    other = pd.concat([y.iloc[first], -y.iloc[later]])
    search = GridSearchCV(pipe, {"identify__order": [2]}, cv=[(first, later)], refit=False)
    assert search.fit(u, other).cv_results_["mean_test_score"][0] < 0.6
