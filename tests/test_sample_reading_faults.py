"""Faults that the reading of samples had: awkward data, and what it says of them."""

import re
import warnings
from functools import partial
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import Pipeline, make_pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd._identify.sample import _Found, _or_fuller, _or_simpler
from sklearn_hd._identify.sample_models import Choice, Refined
from sklearn_hd._identify.stages import warn_of_growth
from sklearn_hd._opinion import Opinion
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import FrequencyMismatchWarning, IdentifiabilityWarning
from sklearn_hd.systems import flapping_blade

STEP = 0.01


def speed(samples):
    """ω with so many samples in a turn."""
    return 2.0 * np.pi / samples / STEP


def record(samples=16.216, rows=2000, noise=0.02, seed=0):
    """A damped oscillation whose stiffness varies over the turn, with loads, as frames."""
    rng = np.random.default_rng(seed)
    t = STEP * np.arange(rows)
    psi = speed(samples) * t
    u, e = rng.standard_normal((2, rows))
    x, y = np.zeros(2), np.empty(rows)
    for k in range(rows):
        c, s = np.cos(psi[k]), np.sin(psi[k])
        y[k] = x[0] + 1.0 + 2.0 * c + 0.5 * s**2 + noise * e[k]
        A = np.array([[0.9, 0.3], [-0.3, 0.8]]) + 0.1 * np.array([[0.3 * c, 0.2 * s], [0.5 * s, 0]])
        x = A @ x + np.array([1.0, 0.5 + 0.4 * c]) * u[k]
    index = pd.Index(t, name="time")
    return pd.DataFrame({"u": u}, index), pd.DataFrame({"y": y}, index)


def fitted(u, y, samples=16.216, **parameters):
    """The pipeline of two steps, fitted."""
    analyzer = HarmonicAnalyzer(speed(samples), reading="sample", **parameters)
    return Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())]).fit(u, y)


def multipliers(pipe):
    """Floquet multipliers by size."""
    return np.sort(np.abs(pipe["identify"].eigenvalues_))


@pytest.mark.slow
def test_equal_outputs_leak_no_warning():
    """A covariance of innovations without an inverse is no news to a user."""
    u, y = record()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        both = fitted(u, y.assign(same=y["y"]))
    np.testing.assert_allclose(multipliers(both), multipliers(fitted(u, y)), rtol=0.02)


@pytest.mark.parametrize(
    "load",
    [
        "rest",
        "wave",
        "zero",
    ],
)
@pytest.mark.slow
def test_an_output_of_loads_alone_leaves_the_others_their_model(load):
    """What rounding leaves of an output that only repeats itself was identified like motion."""
    u, y = record()
    psi = speed(16.216) * y.index.to_numpy()
    values = {"rest": 5.0, "wave": 5e3 + 3e3 * np.cos(psi), "zero": 0.0}[load]
    with pytest.warns(IdentifiabilityWarning, match=r"\['c'\] repeat themselves with every turn"):
        pipe = fitted(u, y.assign(c=values))
    assert pipe["identify"].order_ == 2
    predicted = pipe.predict(u)
    np.testing.assert_allclose(predicted["c"], values, atol=1e-9 * max(1.0, np.max(values)))
    assert np.std(predicted["y"] - y["y"]) < 0.05 * np.std(y["y"])


def test_outputs_of_loads_alone_have_no_response():
    """A model of rounding scored 1 and said nothing."""
    u, y = record()
    loads = pd.DataFrame({"c": np.cos(speed(16.216) * y.index.to_numpy())}, y.index)
    with pytest.raises(ValueError, match="no response to inputs to identify"):
        fitted(u, loads)


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_noise_alone_is_named():
    """A model that leaves 0.997 of the outputs explains nothing either."""
    u, y = record()
    y["y"] = np.random.default_rng(1).standard_normal(len(y))
    with pytest.warns(IdentifiabilityWarning, match="better than their loads alone"):
        fitted(u, y)


def test_less_than_a_turn_is_refused():
    """An input that moved was called constant, where hop had left one row of a record."""
    u, y = record()
    with pytest.raises(ValueError, match=r"of a turn .* hop below 4166"):
        fitted(u, y, samples=1e5)
    with pytest.raises(ValueError, match=r"only 0\.2 of a turn"):
        fitted(u, y, samples=1e4, hop=1)


def test_few_rows_by_thinning_name_the_hop():
    """Rows were few because hop had left them out, which no word said."""
    u, y = record(samples=1000.0)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fitted(u, y, samples=1000.0, hop=41)
    assert any("hop below 41" in str(each.message) for each in told)


@pytest.mark.parametrize("noise", [0.02, 2.0])
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.slow
def test_motion_that_thinning_loses_is_named(noise):
    """A response of 20 samples, read at every eighth, left 0.2 unexplained without a word."""
    u, y = record(samples=200.0, rows=6000, noise=noise)
    with pytest.warns(IdentifiabilityWarning, match=r"hop=8: .* \['y'\] keep only") as told:
        fitted(u, y, samples=200.0, hop=8)
    hop = int(re.search(r"HarmonicAnalyzer hop=(\d+)", str(told[0].message))[1])
    assert 2 <= hop <= 4
    chosen = fitted(u, y, samples=200.0)  # which asks the outputs
    assert chosen["harmonics"].basis_.hop == hop
    if noise < 1.0:
        assert fitted(u, y, samples=200.0, hop=1).score(u, y) > 0.99


@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_noise_alone_loses_nothing_by_thinning():
    """Neighbouring samples share nothing either."""
    u, y = record(samples=200.0, rows=6000)
    y["y"] = np.random.default_rng(1).standard_normal(len(y))
    with pytest.warns(IdentifiabilityWarning, match="better than their loads") as told:
        fitted(u, y, samples=200.0)
    assert not any("hop=8" in str(each.message) for each in told)


@pytest.mark.parametrize(
    ("no_noise", "about_rest", "words"),
    [
        ("", True, ""),
        ("", False, "the model is about the mean motion"),
        ("no noise", False, "no noise"),
    ],
)
def test_a_model_about_the_mean_motion_says_so_if_nothing_else_is_said(no_noise, about_rest, words):
    choice = SimpleNamespace(basis=SimpleNamespace(samples_per_period=1000.0))  # modes not sorted
    small = SimpleNamespace(about_rest=about_rest)
    found = _Found(choice, None, SimpleNamespace(no_noise=no_noise, small=small))
    assert words in "".join(found.against)
    assert len(found.against) == bool(words)


@pytest.mark.slow
def test_modes_are_not_sorted_while_models_are_compared(monkeypatch):
    """With 3000 samples a turn that took 22 s of 6000 rows."""

    def sorting(self):
        raise AssertionError("modes are sorted")

    monkeypatch.setattr(PeriodicInnovations, "multiplier_logarithms", sorting)
    u, y = record(samples=3000.0, rows=6000)
    pipe = fitted(u, y, samples=3000.0, hop=1)
    assert pipe.score(u, y) > 0.99


@pytest.mark.parametrize(("multiplier", "stable", "grows"), [
    (0.996, False, False), (1.004, False, False), (1.02, False, True), (1.02, True, False)
])  # fmt: skip
def test_growth_is_told_of_the_model_after_its_steps(multiplier, stable, grows, recwarn):
    """Of 120 turns: steps of the likelihood may end at a stable model."""
    model = SimpleNamespace(innovations=SimpleNamespace(multipliers=lambda: [multiplier, 0.5]))
    data, best = SimpleNamespace(longest=120, step=2.0 * np.pi), SimpleNamespace(stable=stable)
    best.feedthrough = False
    warn_of_growth(model, best, data, None)
    assert ["so it grows by a factor of 10.8" in str(w.message) for w in recwarn] == [True] * grows


@pytest.mark.slow
def test_growth_is_that_of_the_largest_multiplier():
    """Formed from products of neighbours, scaled on the way."""
    model = fitted(*record())["identify"].model_.innovations
    largest = np.max(model.multiplier_logarithms().real)
    assert model.growth() * model.samples_per_period == pytest.approx(largest, rel=1e-9)


def test_an_order_beyond_all_lags_names_the_lags():
    """1500 rows would have done, said the message, of a record of 3000."""
    u, y = record()
    analyzer = HarmonicAnalyzer(speed(16.216), reading="sample")
    with pytest.raises(ValueError, match="takes 250 lags, and 60 are tried at most"):
        MOESPRegressor(order=250).fit(analyzer.fit(u, y).transform(u), y)


def test_an_order_too_high_is_a_question_of_rows():
    """Outputs that are explained to a thousandth were said not to follow inputs."""
    u, y = record(rows=300)
    analyzer = HarmonicAnalyzer(speed(16.216), reading="sample")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        MOESPRegressor(order=12).fit(analyzer.fit(u, y).transform(u), y)
    assert any("rows are enough for order 12" in str(each.message) for each in told)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_a_long_record_may_begin_at_rest():
    """Choices were made on the first 10 000 rows: no harmonics, of which there are two."""
    noise = 0.02 * np.random.default_rng(1).standard_normal(30000)
    t = STEP * np.arange(30000)
    rest = 1.0 + 2.0 * np.cos(speed(16.0) * t) + 0.5 * np.sin(speed(16.0) * t) ** 2
    u, y = record(samples=16.0, rows=14000, noise=0.0)  # 16 000 rows at rest are whole turns
    rest[16000:] = y["y"]
    index = pd.Index(t, name="time")
    u = pd.DataFrame({"u": np.append(np.zeros(16000), u["u"])}, index)
    pipe = fitted(u, pd.DataFrame({"y": rest + noise}, index), samples=16.0)
    assert pipe["identify"].n_harmonics_ >= 1
    moving = slice(16000, None)
    left = pipe.predict(u)["y"].to_numpy()[moving] - rest[moving]
    assert np.std(left) < 0.02 * np.std(rest[moving])


@pytest.mark.slow
def test_one_long_record_among_short_ones_takes_no_lags_that_they_lack():
    """28 lags left 172 of 3800 rows, for 302 coefficients."""
    parts = [record(rows=n, seed=seed) for seed, n in enumerate([12] * 300 + [200])]
    u, y = (pd.concat(dict(enumerate(each)), names=["record"]) for each in zip(*parts, strict=True))
    pipe = fitted(u, y)
    assert pipe["identify"].block_rows_ < 12
    assert pipe.score(*record(noise=0.0, seed=1000)) > 0.999


@pytest.mark.slow
@pytest.mark.parametrize("reading", ["sample", "period"])
def test_a_clock_that_is_slightly_off_is_told(reading):
    """One doublet: its waveform tells what its short motion does not."""
    data = make_flapping_wing("nltp", amplitude=0.02, n_periods=80, start=40)
    analyzer = HarmonicAnalyzer(data.omega * 1.0001, reading=reading)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        make_pipeline(analyzer, MOESPRegressor()).fit(data.inputs, data.outputs)
    told = [str(each.message) for each in said if each.category is FrequencyMismatchWarning]
    assert len(told) == 1
    assert "the data repeat themselves at 165.247" in told[0]


@pytest.mark.slow
def test_one_doublet_of_two_measured_states_takes_no_third():
    """With the outputs as states, two are enough before any steps of the likelihood."""
    system = flapping_blade(gamma=4.0)
    rng, n = np.random.default_rng(0), 60 * 64
    t, u = np.arange(n) * system.period / 64, np.zeros((n, 1))
    u[512:518], u[518:524] = 1.0, -1.0
    y = np.asarray(system.simulate(u, t))
    y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    time = pd.Index(t, name="time")
    u, y = pd.DataFrame(u, time, ["u"]), pd.DataFrame(y, time, ["angle", "rate"])
    analyzer = HarmonicAnalyzer(system.omega, reading="sample", output_harmonics=2)
    model = make_pipeline(analyzer, MOESPRegressor()).fit(u, y)[-1]
    tried = pd.DataFrame(model.order_search_)
    assert tried.loc[tried["bic"].idxmin(), "order"] == 2
    assert model.order_ == 2
    found = np.sort_complex(model.ltp_.floquet_exponents())
    np.testing.assert_allclose(found, [-0.25 - 0.0331j, -0.25 + 0.0331j], atol=0.01)


def knowing(noise, **others):
    """A choice that knows the noise."""
    choice = SimpleNamespace(noise=noise, **others)
    choice.leaves_noise = partial(Choice.leaves_noise, choice)
    return choice


@pytest.mark.parametrize(
    ("own", "fuller", "degrees", "predictions", "taken"),
    [
        (4e-4, 1.05e-4, (), 0.0, True),
        (4e-4, 2e-4, (), 0.0, False),  # gusts, or not linear: both leave more than noise
        (1.05e-4, 1e-4, (), 0.0, False),  # nothing is missing
        (4e-4, 1.05e-4, (2,), 1.0, True),  # products stand for the state
        (4e-4, 1.05e-4, (2,), -1.0, False),  # the machine is not linear
    ],
)
def test_one_state_more_is_taken_where_it_alone_leaves_but_noise(
    own, fuller, degrees, predictions, taken
):
    tried = [SimpleNamespace(order=n, n_harmonics=1, bic=0.0, stable=True) for n in (2, 3)]
    left = {n: SimpleNamespace(variance=v, bic=np.log(v)) for n, v in ((2, own), (3, fuller))}
    large = SimpleNamespace(
        products=SimpleNamespace(degrees=degrees),
        small_motions=lambda rest: SimpleNamespace(innovations=None),
    )
    refined = Refined(None, None, None, large=large if degrees else None)
    choice = knowing(
        1e-4,
        kept=lambda: tried,
        bic_of_predictions=lambda chosen, refined: predictions if chosen.order == 2 else 0.0,
        whole=lambda one: one,
        refined=lambda innovations, stable, like: refined,
        compared=lambda order, count, innovations: left[order],
    )
    found = _or_fuller(_Found(choice, tried[0], refined), choice)
    assert found.chosen.order == (3 if taken else 2)


@pytest.mark.parametrize(
    ("own", "degrees", "taken"), [((2,), (2,), True), ((2,), (), False), ((), (2,), True)]
)
def test_a_linear_model_in_doubt_does_not_stand_for_small_motions(own, degrees, taken):
    """It simulates large motions better than their linear part, and has other exponents."""
    exponents = np.array([-0.2 + 1j, -0.2 - 1j])

    def found(n_harmonics, bic, degrees):
        it = _Found(None, SimpleNamespace(order=2, n_harmonics=n_harmonics), None)
        large = SimpleNamespace(covariance=1e-9 * np.eye(2))
        refined = SimpleNamespace(degrees=degrees, simulates=False, no_noise="", large=large)
        left = SimpleNamespace(variance=1e-3, bic=bic, stable=True)
        model = SimpleNamespace(exponents=lambda: exponents, omega=3.0, opinion=None)
        it.__dict__.update(refined=refined, left=left, model=model, against=["in doubt"])
        return it

    whole, other = found(4, 0.0, own), found(2, -10.0, degrees)
    choice = SimpleNamespace(simpler=lambda chosen, most_left: [other])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Found, "of", lambda choice, one: one)
        patch.setattr(_Found, "bic_of_predictions", 0.0)
        assert (_or_simpler(whole, choice) is other) == taken


@pytest.mark.parametrize(
    ("order", "more", "lacks"), [(2, 3.0, False), (2, 5.0, True), (1, 5.0, False)]
)
def test_fewer_harmonics_may_leave_four_times_as_much_below_the_noise_of_a_sensor(
    order, more, lacks
):
    def found(order, left):
        large = SimpleNamespace(covariance=left * np.eye(2))
        return _Found(None, SimpleNamespace(order=order), SimpleNamespace(large=large))

    assert found(order, 1e-9 * more).lacks_harmonics_of(found(2, 1e-9)) == lacks


def test_simpler_models_have_fewer_states_or_fewer_harmonics():
    """The best of each order that leave little, three orders at most, and of its own order."""
    sizes = [(1, 4), (2, 2), (2, 4), (3, 2), (4, 2), (5, 2), (5, 4), (5, 6), (5, 8)]
    tried = [
        SimpleNamespace(order=n, n_harmonics=h, bic=-h, stable=h != 6, variance=1.0 / n)
        for n, h in sizes
    ]
    choice = SimpleNamespace(kept=lambda: tried)

    def simpler(place, most_left):
        found = Choice.simpler(choice, tried[place], most_left)
        return [(one.order, one.n_harmonics) for one in found]

    assert simpler(-1, 0.5) == [(2, 4), (3, 2), (4, 2), (5, 4)]
    assert simpler(-1, 1.0) == [(1, 4), (2, 4), (3, 2), (5, 4)]
    assert simpler(1, 0.5) == []


@pytest.mark.parametrize(
    ("exponent", "left", "bic", "noise", "against", "serves"),
    [
        (-0.14, 1.5e-3, 0.0, 1e-4, "", False),  # one mode in place of two
        (-0.225, 1.5e-3, 0.0, 1e-4, "", True),
        (-0.225 + 0.8j, 1.5e-3, 0.0, 1e-4, "", True),
        (-0.225, 1.7e-3, 0.0, 1e-4, "", False),  # four times what the other leaves
        (-0.14, 4.2e-4, 0.0, 1e-4, "", True),  # the record tells no two
        (-0.225, 1.5e-3, 0.0, 1e-4, "halves differ", False),
        (-0.225, 1.5e-3, 0.0, 4e-4, "", False),  # the other leaves but noise
        (-0.14, 4.2e-4, -1e3, 4e-4, "", True),
    ],
)
def test_a_simpler_model_has_modes_of_the_other_or_leaves_as_little(
    exponent, left, bic, noise, against, serves
):
    def found(left, bic, against, *exponents):
        model = SimpleNamespace(exponents=lambda: np.array(exponents, complex), omega=0.8)
        it = _Found(knowing(noise), SimpleNamespace(order=len(exponents)), None)
        it.__dict__.update(left=SimpleNamespace(variance=left, bic=bic), model=model)
        it.__dict__.update(against=against)
        return it

    whole = found(4e-4, -500.0, "halves differ", -0.23, -0.365)
    assert found(left, bic, against, exponent).serves_for(whole) == serves
    fewer_harmonics = found(4.1e-4, bic, against, -0.23, -0.365)
    assert fewer_harmonics.serves_for(whole) == (bic < -500.0 and not against)


@pytest.mark.parametrize(
    ("exponents", "deviation", "against", "left", "stands"),
    [
        ((-0.2,), 0.002, "", 1.1, False),  # a mode that it lacks has moved its own
        ((-0.2,), 0.002, "", 0.9, True),  # the other leaves more, with a mode more
        ((-0.231,), 0.002, "", 1.1, True),
        ((-0.2,), 0.02, "", 1.1, True),  # within chance
        ((-0.2,), 0.002, "halves differ", 1.1, True),  # the other is in doubt itself
        (
            (-0.2, -1.5),
            0.002,
            "",
            1.1,
            True,
        ),  # as many, fewer harmonics: the criterion has the word
    ],
)
def test_fewer_states_do_not_stand_beside_a_sure_model_of_others(
    exponents, deviation, against, left, stands
):
    def found(against, left, *exponents):
        exponents = np.array(exponents, complex)
        spread = np.full(len(exponents), deviation)
        opinion = Opinion(exponents, spread, 0.8, "the two halves of the record have", own=True)
        it = _Found(None, SimpleNamespace(order=len(exponents)), None)
        model = SimpleNamespace(exponents=lambda: exponents, omega=0.8, opinion=opinion)
        left = SimpleNamespace(variance=left)
        it.__dict__.update(model=model, against=against, left=left)
        return it

    whole = found(against, 1.0, -0.23, -2.0)  # of the second a turn leaves nothing
    assert found("", left, *exponents).stands_beside(whole) == stands
    assert whole.stands_beside(whole)
