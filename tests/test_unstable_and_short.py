"""Periodic orbits that are unstable, and records too short for the period-synchronous Hankel."""

import warnings

import numpy as np
import pandas as pd
import periodic_cases
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._frame import LTIModel
from sklearn_hd._match import MatchSettings
from sklearn_hd._match.affine import match_affine
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import (
    IdentifiabilityWarning,
    InstabilityWarning,
    UnstableModelError,
)
from sklearn_hd.systems import LTPSystem

OMEGA, SPP = 2 * np.pi, 32


class Growing:
    """F(ψ) with one Floquet exponent near a given rate, the other near −1."""

    def __init__(self, rate):
        self.rate = rate

    def __call__(self, psi):
        F = np.empty((*np.shape(psi), 2, 2))
        F[..., 0, 0], F[..., 0, 1] = self.rate + 0.3 * np.cos(psi), 0.4 * np.sin(psi)
        F[..., 1, 0], F[..., 1, 1] = 0.5 * np.cos(psi), -1.0 + 0.2 * np.sin(psi)
        return F


def orbit(rate):
    G = np.array([[1.0], [0.5]])
    return LTPSystem(
        Growing(rate), lambda psi: np.broadcast_to(G, (*np.shape(psi), 2, 1)), omega=OMEGA
    )


def record(system, n_periods):
    t = np.arange(n_periods * SPP) / SPP
    u = np.zeros((len(t), 1))
    u[2 * SPP : 5 * SPP], u[5 * SPP : 8 * SPP] = 1.0, -1.0
    index = pd.Index(t, name="time")
    y = system.simulate(u, t)
    return pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index, ["a", "b"])


def pipeline(kept, order, reading="sliding"):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(OMEGA, output_harmonics=kept, reading=reading)),
            ("identify", MOESPRegressor(order=order)),
            ("reduce", SpuriousModeReducer()),
        ]
    )


def synchronous():
    return pipeline(15, 2, reading="period")


def messages(pipe, X, y):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pipe.fit(X, y)
    return [str(w.message) for w in caught if w.category is InstabilityWarning]


@pytest.mark.parametrize(("rate", "n_periods"), [(0.1, 20), (0.1, 60), (0.5, 20)])
def test_an_unstable_orbit_is_identified_and_named(rate, n_periods):
    system = orbit(rate)
    exponents = np.sort(system.floquet_exponents().real)
    X, y = record(system, n_periods)
    pipe = synchronous()
    (message,) = messages(pipe, X, y)
    assert f"has the real part {exponents[1]:.4g} 1/s" in message
    found = np.sort(np.log(np.abs(pipe["identify"].eigenvalues_)))
    np.testing.assert_allclose(found, exponents, rtol=1e-6)
    assert pipe.score(X, y) > 0.999
    assert np.isfinite(pipe.predict(X).to_numpy()).all()


def test_an_unstable_orbit_through_the_sliding_analyzer():
    system = orbit(0.1)
    X, y = record(system, 60)
    pipe = pipeline(1, 12)
    (message,) = messages(pipe, X, y)
    assert "the periodic orbit is unstable: a Floquet exponent of the model" in message
    poles = pipe["reduce"].system_.poles()
    assert np.max(poles.real) == pytest.approx(np.max(system.floquet_exponents().real), rel=1e-4)


@pytest.mark.parametrize("pipe", [synchronous(), pipeline(1, 12)])
@pytest.mark.slow
def test_growth_that_hides_the_rest_is_the_reason_named(pipe):
    X, y = record(orbit(0.5), 60)
    first = messages(pipe, X, y)[0]
    assert "the outputs grow by a factor of 1.67 per period up to the last of the rows" in first
    assert "use records of at most 26.8 s (26 periods), or fly with a controller" in first
    X, y = X.loc[:26], y.loc[:26]
    assert not any("outputs grow" in message for message in messages(pipe, X, y))


def test_an_input_that_begins_late_is_no_growth():
    X, y = record(orbit(-0.05), 60)
    late = X.to_numpy()[::-1].copy()  # ends in the middle of its last step
    late[-5 * SPP :] = 1.0
    y[:] = orbit(-0.05).simulate(late, y.index.to_numpy())
    assert messages(synchronous(), X.assign(u=late), y) == []


@pytest.mark.slow
def test_a_stable_orbit_is_not_called_unstable():
    X, y = record(orbit(-0.05), 60)
    noisy = y + 0.05 * y.std().to_numpy() * np.random.default_rng(0).standard_normal(y.shape)
    for outputs in (y, noisy):
        assert messages(synchronous(), X, outputs) == []
    assert messages(MOESPRegressor(order=2, block_rows=4), X, y) == []  # nothing periodic there


@pytest.mark.parametrize("weighting", ["moesp", "n4sid", "cva", "pbsid"])
@pytest.mark.parametrize("seed", range(5))
def test_a_hammer_is_an_input(seed, weighting):
    """Columns that hold but a few numbers are sums that rounding can make negative."""
    rng = np.random.default_rng(seed)
    u, y = np.zeros((200, 1)), np.zeros((200, 1))
    u[:6, 0] = rng.standard_normal(6)
    for k in range(199):
        y[k + 1] = 0.9 * y[k] + u[k]
    model = MOESPRegressor(order=1, block_rows=5, weighting=weighting)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an input that excites few directions
        model.fit(u, y + 1e-3 * rng.standard_normal(y.shape))
    assert model.eigenvalues_[0] == pytest.approx(0.9, abs=0.01)


@pytest.mark.slow
def test_a_record_of_one_window_is_no_obstacle(tmp_path):
    rng = np.random.default_rng(4)
    lengths, X, Y = (1600, 20, 1200), [], []
    for n in lengths:
        u, y = rng.standard_normal((n, 1)), np.zeros((n, 1))
        for k in range(n - 1):
            y[k + 1] = 0.9 * y[k] + u[k]
        index = pd.MultiIndex.from_product([[len(X)], np.arange(n) / 20.0], names=["record", "t"])
        X.append(pd.DataFrame(u, index, columns=["u"]))
        Y.append(pd.DataFrame(y, index, columns=["y"]))
    X, Y = pd.concat(X), pd.concat(Y)
    models = [
        Pipeline(
            [
                ("harmonics", HarmonicAnalyzer(2 * np.pi, reading="sliding", output_harmonics=1)),
                ("identify", MOESPRegressor(order=2, block_rows=20, memory=memory)),
            ]
        ).fit(X, Y)["identify"]
        for memory in (None, str(tmp_path))
    ]
    for model in models:
        np.testing.assert_array_equal(model.x0_[1], 0.0)
    np.testing.assert_allclose(models[0].model_.B, models[1].model_.B, rtol=1e-6, atol=1e-9)


@pytest.fixture(scope="module")
def noisy():
    return make_flapping_wing(
        "lti", snr=20, random_state=41, n_records=3, n_periods=60, start=5, samples_per_period=32
    )


def matched(data, **kwargs):
    analyzer = HarmonicAnalyzer(data.omega, output_harmonics=2, reading="period")
    steps = MOESPRegressor(order=3), StructuredMatcher(**kwargs)
    pipe = Pipeline(list(zip(("harmonics", "identify", "match"), (analyzer, *steps), strict=True)))
    return pipe.fit(data.inputs, data.outputs)


@pytest.mark.filterwarnings("ignore:.*in residuals that are not noise")
@pytest.mark.filterwarnings("ignore:the outputs .* do not determine")
@pytest.mark.slow
def test_an_order_too_high_for_the_free_decays_is_in_doubt(noisy):
    """The third mode is noise's: the match keeps the multipliers identified, and does not grow."""
    with pytest.warns(IdentifiabilityWarning, match="1 of 3 modes neither decay nor grow"):
        pipe = matched(noisy)
    found = np.exp(pipe["match"].ltp_.floquet_exponents() * 2 * np.pi / noisy.omega)
    np.testing.assert_allclose(
        np.sort_complex(found), np.sort_complex(pipe["identify"].eigenvalues_), rtol=1e-6
    )


@pytest.mark.filterwarnings("ignore:.*neither decay nor grow")  # in so few periods
def test_too_few_periods_are_counted():
    X, y = record(orbit(-0.05), 12)
    message = (
        r"give 12 period\(s\) .* too few for block_rows=8: at least 26 consecutive periods are "
        r"needed with 1 direction\(s\) of inputs; use a longer record, or fewer block rows"
    )
    pipe = synchronous()[:2].set_params(identify__block_rows=8)
    with pytest.raises(ValueError, match=message):
        pipe.fit(X, y)
    assert pipe.set_params(identify__block_rows=3).fit(X, y)["identify"].order_ == 2


# ---- is it the orbit that is unstable? -----------------------------------------------------------


def random_system(seed, slowest):
    """2 to 4 states, F(ψ) of four harmonics; the slowest Floquet exponent as given, in 1/period."""
    rng = np.random.default_rng([5, seed])
    n = int(rng.integers(2, 5))
    sizes = np.repeat(0.3 / np.sqrt(n) * 0.5 ** np.arange(4), 2)[:, None, None]
    F = np.concatenate([rng.standard_normal((1, n, n)), sizes * rng.standard_normal((8, n, n))])
    G = rng.standard_normal((3, n, 1)) * np.array([1.0, 0.5, 0.5])[:, None, None]
    F[0] -= LTPSystem(F * OMEGA, G, omega=OMEGA).floquet_exponents().real.max() / OMEGA * np.eye(n)
    F[0] += slowest / (2.0 * np.pi) * np.eye(n)
    return LTPSystem(F * OMEGA, G, omega=OMEGA)


def noisy_record(system, seed, noise, n_periods=60, samples=16):
    """A doublet of 6 + 6 periods, 16 samples a period, and the response with white noise."""
    t = np.arange(n_periods * samples) / samples
    u = np.zeros((len(t), 1))
    u[2 * samples : 8 * samples], u[8 * samples : 14 * samples] = 1.0, -1.0
    y, rng = system.simulate(u, t), np.random.default_rng(seed)
    y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
    index = pd.Index(t, name="time")
    return pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index)


def alarms(slowest):
    """Seeds of which a fit of 5 % noise, 16 samples a period, says that the orbit is unstable."""
    found = []
    for seed in range(20):
        u, y = noisy_record(random_system(seed, slowest), seed, 0.05)
        analyzer = HarmonicAnalyzer(OMEGA, reading="period", output_harmonics=2)
        pipe = Pipeline([("h", analyzer), ("i", MOESPRegressor())])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            pipe.fit(u, y)
        if any(issubclass(w.category, InstabilityWarning) for w in caught):
            found.append(seed)
    return found


@pytest.mark.slow
def test_modes_that_noise_makes_grow_are_no_false_alarm():
    """What a period forgets is seen by noise alone from period to period."""
    assert alarms(slowest=-0.2) == []


@pytest.mark.slow
def test_orbits_that_are_unstable_are_said_to_be():
    assert alarms(slowest=0.1) == list(range(20))


def with_noise(y, share, seed):
    noise = np.random.default_rng(seed).standard_normal(y.shape)
    return y + share * y.to_numpy().std(axis=0) * noise


@pytest.mark.parametrize(("seed", "order"), [(2, 4), (0, 6)])
@pytest.mark.slow
def test_growth_that_the_record_does_not_need_gives_way(seed, order):
    """States too many, of noise as large as half the motion; one of them would grow."""
    u, y = periodic_cases.record(periodic_cases.mathieu(), n_periods=40, seed=seed)
    pipe = periodic_cases.synchronous(2.0)[:2].set_params(identify__order=order)
    with pytest.warns() as caught:
        pipe.fit(u, with_noise(y, 0.5, seed))
    told = [str(w.message) for w in caught if w.category is InstabilityWarning]
    assert len(told) == 1
    assert "a stable one leaves no more of the record: that takes its place" in told[0]
    assert np.max(np.abs(pipe["identify"].eigenvalues_)) < 1.0


@pytest.mark.parametrize("order", [4, 6])
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
def test_growth_of_the_machine_stays(order):
    still, period = periodic_cases.mathieu(), np.pi
    F = still.F.coefficients.copy()
    rate = np.max(still.floquet_exponents().real)
    F[0] += (0.03 / period - rate) * np.eye(2)
    u, y = periodic_cases.record(LTPSystem(F, still.G, omega=2.0), n_periods=40)
    pipe = periodic_cases.synchronous(2.0)[:2].set_params(identify__order=order)
    with pytest.warns(InstabilityWarning, match="the periodic orbit is unstable"):
        pipe.fit(u, with_noise(y, 0.6, 0))
    found = np.abs(pipe["identify"].eigenvalues_)
    assert np.min(np.abs(found - np.exp(0.03))) < 0.02


# ---- a match that is near the model, and its periodic system that is not -------------------------


def harmonic_match(seed, **match):
    """The sliding pipeline with a HarmonicStructure behind it, and its training record."""
    u, y = noisy_record(random_system(seed, -0.2), seed, 0.0)
    matcher = StructuredMatcher(structure=HarmonicStructure(), n_starts=0, **match)
    return Pipeline([*pipeline(1, "auto").steps, ("match", matcher)]), u, y


@pytest.mark.parametrize(
    "criterion", [pytest.param("hinf", marks=pytest.mark.slow), "least_squares"]
)
@pytest.mark.parametrize(("seed", "error"), [(10, UnstableModelError), (7, ValueError)])
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_a_match_that_explodes_on_its_own_record_is_no_model(criterion, seed, error):
    """A stable one that leaves more than there was is not called unstable."""
    pipe, u, y = harmonic_match(seed, criterion=criterion)
    words = r"times the variance of an output.* own training record"
    with pytest.raises(ValueError, match=words) as raised:
        pipe.fit(u, y)
    assert raised.type is error
    with pytest.raises(NotFittedError):
        pipe[-1].predict(u)


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
def test_the_ways_out_of_a_match_that_explodes():
    pipe, u, y = harmonic_match(7)
    assert pipe.set_params(match__structure=None).fit(u, y).score(u, y) > 0.9
    lifted = {"harmonics__reading": "period", "match__structure": HarmonicStructure()}
    assert pipe.set_params(**lifted).fit(u, y).score(u, y) > 0.999


def test_a_model_that_drifts_has_no_norm():
    A, B, C = np.diag([0.0, -1.0]), np.ones((2, 1)), np.eye(2)
    model = LTIModel(A, B, C, np.zeros((2, 1)), 0.0, ("u",), ("y", "z"))
    structure = MatrixStructure(A=np.full((2, 2), np.nan), B=np.full((2, 1), np.nan))
    settings = MatchSettings(
        criterion="hinf",
        output_weights=None,
        input_weights=None,
        n_starts=0,
        random_state=0,
        max_iter=10,
    )
    with pytest.raises(UnstableModelError, match="the model has a pole at 0, outside"):
        match_affine(model, None, structure, settings)
