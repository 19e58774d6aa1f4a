"""Second opinions: what confirms exponents, and what leaves them in doubt."""

import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm, t
from sklearn.pipeline import make_pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._identify import period
from sklearn_hd._match.periodic import realize, warn_realized
from sklearn_hd._match.trust import _beside, _of_few_parts
from sklearn_hd._opinion import (
    SURE,
    Opinion,
    contradictions,
    doubtful,
    missing,
    more_doubtful,
    of_halves,
    of_second_order,
    unchanging,
)
from sklearn_hd._records.data import read_experiment
from sklearn_hd._reduce import judge
from sklearn_hd.algorithms.periodic.harmonic_balance import resize_harmonics
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.matching import _warn_of_moves
from sklearn_hd.systems import LTPSystem

PAIR = np.array([-0.2 + 0.4j, -0.2 - 0.4j])
STILL = "of . modes neither decay nor grow"


def opinion(exponents, deviation, own=False):
    exponents = np.asarray(exponents, complex)
    return Opinion(exponents, np.full(len(exponents), deviation), 1.0, "they have", own, 500.0)


def test_shifts_by_the_turn_are_the_same_exponent():
    assert not doubtful(PAIR + 3j, opinion(PAIR, 1e-3)).any()


@pytest.mark.parametrize(
    ("deviation", "own", "doubted"),
    [(1e-3, False, False), (1e-3, True, False), (0.05, True, True), (0.05, False, False)],
)
def test_own_exponents_have_to_be_known(deviation, own, doubted):
    """A vague opinion of another way contradicts nothing; one of its own says that it is vague."""
    assert doubtful(PAIR, opinion(PAIR, deviation, own)).all() == doubted


@pytest.mark.parametrize("deviation", [0.01, 0.03, 0.045, 0.06, 0.2])
def test_chance_makes_an_opinion_of_another_way_doubt_no_more_often_than_it_says(deviation, rng):
    """In one of twenty right models: beyond two of its standard deviations."""
    right = np.array([-0.2])
    its = right * (1.0 + deviation * rng.standard_normal((4000, 1)))
    doubted = [doubtful(right, opinion(own, 0.2 * deviation)).any() for own in its]
    assert np.mean(doubted) < 0.055


@pytest.mark.parametrize(("deviation", "doubted"), [(0.1, False), (0.8, True)])
def test_a_mode_that_dies_within_a_turn_has_to_be_known_to(deviation, doubted):
    """A turn leaves 3e-4 of a motion of -1.3 1/s, and all of it if it is off by two of 0.8."""
    its = opinion([-1.3], deviation, own=True)
    assert doubtful(np.array([-1.3]), its).all() == doubted
    assert not doubtful(np.array([-1.3]), opinion([-1.3], deviation)).any()


@np.errstate(invalid="raise")
def test_a_deviation_that_is_infinite_stays_so_beside_a_second_opinion():
    """A fit failed over it, and blamed the units of the signals."""
    std = np.full(2, complex(np.inf, np.inf))
    np.testing.assert_array_equal(_beside(std, PAIR, opinion(PAIR, 1e-3)), std)


def test_another_way_contradicts_beyond_its_errors():
    assert doubtful(PAIR, opinion(1.3 * PAIR.real + 1j * PAIR.imag, 1e-3)).all()
    assert not doubtful(PAIR, opinion(1.3 * PAIR.real + 1j * PAIR.imag, 0.03)).any()


def needed(exponents, deviation=1e-3):
    return replace(opinion(exponents, deviation), needed=True, complete=True)


def test_an_opinion_that_is_needed_doubts_all_that_it_does_not_confirm():
    several = np.array([-0.2, -0.23 + 0.1j, -0.23 - 0.1j, -0.2 + 1j])  # the last a copy
    assert doubtful(several, needed([-0.2])).tolist() == [False, True, True, False]
    assert doubtful(several, needed([-0.21], 0.1)).all()


@pytest.mark.parametrize(
    ("apart", "deviation", "doubted"),
    [
        (0.04, 0.002, False),
        (0.07, 0.002, True),
        (0.06, 0.0032, False),
        (0.07, 0.007, True),
        (0.07, 0.02, False),
    ],
)
def test_a_vague_opinion_contradicts_less_than_one_that_knows(apart, deviation, doubted):
    """Beyond 5 % and four deviations (1 % each in the second row, 1.6 % in the third) it is sure;
    7 % are beyond 10 % with two of 3.5 %; one of 10 % does not know itself."""
    near = (1.0 + apart) * PAIR.real + 1j * PAIR.imag
    assert doubtful(near, opinion(PAIR, deviation)).all() == doubted


@pytest.mark.parametrize("own", [False, True])
def test_a_mode_that_does_not_change_is_in_doubt_whatever_is_known_of_it(own):
    rates = np.array([-1.9e-4, -2.1e-4, 1.9e-4]) + 0.3j  # in 500 s 0.095, 0.105, 0.095 of them
    known = replace(opinion(rates, 0.0), own=own)
    assert doubtful(rates, known).tolist() == [True, False, True]
    words = contradictions(rates, known)
    assert words.startswith("2 of 3 modes neither decay nor grow: the model has ")
    assert "500 s are only 0.095 of its time constants" in words
    assert "in doubt" not in words


def test_a_slow_mode_whose_rate_chance_may_have_made_does_not_change():
    """A drift of a sensor gives a mode of 8 records, 0.13 of a time constant known to a third."""
    rates = np.array([-2.6e-4, -1.9e-3, -2.1e-3])  # in 500 s 0.13, 0.95, 1.05
    assert doubtful(rates, opinion(rates, 9e-5, own=True)).tolist() == [True, False, False]
    assert doubtful(rates, opinion(rates, 6e-5, own=True)).tolist() == [False, False, False]
    assert unchanging(rates, opinion(rates, 9e-4)).tolist() == [True, True, False]


def test_modes_that_are_more_than_a_complete_opinion_has_are_too_many():
    several = np.array([-0.2, -0.23 + 0.1j, -0.23 - 0.1j, -0.2 + 1j])  # the last a copy
    vague = opinion([-0.21], 0.1)
    assert not doubtful(several, vague).any()
    complete = replace(vague, complete=True)
    assert doubtful(several, complete).tolist() == [False, True, True, False]


def test_distance_and_error_count_together():
    near = 1.045 * PAIR.real + 1j * PAIR.imag
    assert not doubtful(near, needed(PAIR, 0.002)).any()
    assert doubtful(near, needed(PAIR, 0.006)).all()
    own = opinion(PAIR, 0.006, own=True)  # of a further step: it is taken when it is needed
    assert not doubtful(near, own).any()
    assert doubtful(near, replace(own, needed=True)).all()


@pytest.mark.parametrize(("apart", "moved"), [(0.03, False), (0.05, True)])
def test_an_opinion_moves_an_exponent_that_lasts_by_more_than_four_deviations(apart, moved):
    its = opinion((1.0 + apart) * PAIR.real + 1j * PAIR.imag, 0.002)
    assert its.moves(PAIR) == moved
    assert not opinion([-8.0], 1e-3).moves(np.array([-9.0 + 0j]))  # a turn leaves nothing of it


@pytest.mark.parametrize(("deviation", "told"), [(0.002, True), (0.02, False)])
def test_a_mode_that_a_match_moves_to_where_nothing_is_judged_is_missed(deviation, told):
    """A turn leaves nothing of -9 1/s: no exponent of the match is in doubt, but one is lost."""
    identified, found = np.array([-0.2, -0.5 + 0j]), np.array([-9.0, -0.5 + 0j])
    its = opinion([-0.201, -0.5], deviation, own=True)
    model = SimpleNamespace(opinion=its, exponents=lambda: identified, n_states=2)
    match = SimpleNamespace(periodic=None, model=SimpleNamespace(exponents=lambda: found))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        _warn_of_moves(model, match, likely=True)
    words = "lacks 1 of 2 exponents: the map identified has -0.2+0j ± 0.004 1/s, the model has -0.5"
    assert [words in str(w.message) for w in said] == [True] * told


def test_a_sure_mode_that_a_match_moves_is_missed_beside_one_in_doubt():
    identified, found = np.array([-0.02, -0.5 + 0j]), np.array([-0.05, -0.5 + 0j])
    its = replace(opinion([-0.02, -0.5], 0.0, own=True), deviations=np.array([1e-4, 0.2]))
    model = SimpleNamespace(opinion=its, exponents=lambda: identified, n_states=2)
    match = SimpleNamespace(periodic=None, model=SimpleNamespace(exponents=lambda: found))
    assert contradictions(identified, its)  # of the other one
    with pytest.warns(IdentifiabilityWarning, match="has -0.02.* nearest to it, where the match"):
        _warn_of_moves(model, match, likely=False)


def test_a_mode_that_another_way_has_is_missed():
    has = needed([*PAIR, -0.05])
    assert missing(PAIR, has).tolist() == [False, False, True]
    assert not missing(np.append(PAIR, -0.05 + 3j), has).any()
    assert not missing(PAIR, replace(has, complete=False)).any()
    words = contradictions(PAIR, has)
    assert words.startswith("the model lacks 1 of 3 exponents: they have -0.05+0j ± 0.002 1/s, the")


@pytest.mark.parametrize("kept", ["vague", "forgotten", "second-order"])
def test_what_is_vague_or_forgotten_or_of_second_order_is_not_missed(kept):
    other = {"vague": -0.05, "forgotten": -3.0, "second-order": 2 * PAIR[0].real}[kept]
    has = needed([*PAIR, other], 0.01 if kept == "vague" else 1e-3)
    assert contradictions(PAIR, has) == ""


def test_a_wrong_exponent_is_not_named_twice():
    words = contradictions(1.5 * PAIR, needed(PAIR))
    assert words.startswith("2 of 2 exponents are in doubt")
    assert "lacks" not in words


@pytest.mark.parametrize(
    ("deviations", "known"),
    [((1e-3, 1e-3, 0.9), 2), ((0.05, 1e-3, 0.9), 1), ((0.05, 0.05, 0.9), 0), ((1e-3,) * 3, None)],
)
def test_how_many_are_known_beside_those_in_doubt(deviations, known):
    """A turn leaves 3e-6 of -2 1/s, which with a deviation of 0.9 1/s may last."""
    exponents = np.array([-0.2 + 0j, -0.3, -2.0])
    own = replace(opinion(exponents, 0.0, own=True), deviations=np.array(deviations))
    words = contradictions(exponents, own)
    assert ("a turn leaves less than 0.001 of their motion" in words) == (known == 2)
    told = re.findall(r"others known to within 10% of their rate: (\d)", words)
    assert told == ([str(known)] if known else [])
    assert bool(words) == (known is not None)


def test_what_another_way_does_not_have_is_not_called_known():
    """-0.05 is within the error of a vague exponent: not in doubt, and not confirmed."""
    exponents = np.array([-0.2 + 0j, -0.05])
    vague = Opinion(np.array([-0.4 + 0j, -0.05]), np.array([1e-3, 0.03]), 1.0, "it has")
    words = contradictions(exponents, vague)
    assert "1 of 2 exponents are in doubt" in words
    assert "known" not in words


def test_of_two_opinions_that_of_a_mode_that_lasts_is_heard():
    exponents = np.array([-0.2 + 0j, -2.0, -2.3])
    several, slow = (
        replace(opinion(exponents, 0.0, own=True), deviations=np.array(each))
        for each in ((1e-3, 0.9, 1.0), (0.05, 0.1, 0.1))
    )
    assert more_doubtful(exponents, several, slow) is slow
    assert more_doubtful(exponents, several, replace(slow, deviations=np.zeros(3))) is several


def test_the_square_of_a_motion_is_known_by_its_exponent():
    found = np.array([-0.4 + 0.8j, -0.4, -0.2 + 0.8j])
    assert of_second_order(found, PAIR, opinion(PAIR, 1e-3)).tolist() == [True, True, False]


def test_what_a_turn_forgets_is_not_judged():
    assert not doubtful(np.array([-3.0]), opinion([-9.0], 1e-3)).any()


def test_the_table_says_which_rates_are_not_judged():
    exponents = np.append(PAIR, -3.0)
    verdicts, reasons = ["genuine"] * 3, ["needed"] * 3
    judge(verdicts, reasons, exponents, np.arange(3), opinion(exponents, 1e-3))
    assert verdicts == ["genuine"] * 3
    unjudged = "needed; a turn leaves less than 0.001 of it: its rate is not judged"
    assert reasons == ["needed", "needed", unjudged]


def test_the_opinion_that_doubts_more_is_taken():
    sure, vague = opinion(PAIR, 1e-3, True), opinion(PAIR, 0.1, True)
    assert more_doubtful(PAIR, sure, None, vague) is vague
    assert more_doubtful(PAIR, sure, sure.of_identified(PAIR)) is sure
    assert more_doubtful(PAIR, None) is None


def halves_have(whole, *halves, known=(None, None)):
    """The opinion of two halves with some exponents, and their deviations."""
    pairs = zip(map(np.asarray, halves), known, strict=True)
    return of_halves(whole, list(pairs), 1.0, 500.0)


def test_halves_are_told_apart_one_exponent_each():
    """Two exponents of the whole that one of a half explains: the other has no counterpart."""
    whole = np.array([-0.3, -0.33])
    found = halves_have(whole, [-0.3, -0.9], [-0.3, -0.8])
    assert doubtful(whole, found).tolist() == [False, True]


def test_halves_know_both_of_a_pair_alike():
    """Though a real exponent of a half is given to one of them: the pair is one mode."""
    whole = np.append(PAIR, -0.4)
    found = halves_have(whole, np.append(PAIR, -0.41), [-0.1, PAIR[0], -0.35])
    assert found.deviations[0] == found.deviations[1] > 0.01
    assert found.slowest[0] == found.slowest[1]
    assert doubtful(whole, found)[0] == doubtful(whole, found)[1]


def test_halves_that_agree_with_each_other_alone_do_not_confirm():
    found = halves_have(PAIR, 1.2 * PAIR, 1.2 * PAIR)
    np.testing.assert_allclose(found.deviations, 0.2 * np.abs(PAIR))
    assert doubtful(PAIR, found).all()


@pytest.mark.parametrize("part", [0.5, 0.9, 0.999])
def test_halves_know_as_much_as_the_whole_whatever_part_each_tells(part):
    """λ = f λ_1 + (1 − f) λ_2: of a variance of 1/f and 1/(1 − f) times that of the whole."""
    apart = 0.01 / np.sqrt(part * (1.0 - part))
    halves = [PAIR + (1.0 - part) * apart, PAIR - part * apart]
    size = np.full(2, 0.01)
    for known in ([size / part**0.5, size / (1.0 - part) ** 0.5], [None, size]):
        found = halves_have(PAIR, *halves, known=known)
        np.testing.assert_allclose(found.deviations, 0.01)
    if part == 0.5:
        np.testing.assert_allclose(halves_have(PAIR, *halves).deviations, 0.01)


def test_a_half_that_tells_little_is_asked_little():
    """A sweep through other frequencies: what is far off there is known to be."""
    chance, known = 0.3 * PAIR.real, np.full(2, 0.1)
    found = halves_have(PAIR, PAIR + chance, PAIR * 1.001, known=[100.0 * known, known])
    assert not doubtful(PAIR, found).any()
    assert doubtful(PAIR, halves_have(PAIR, PAIR + chance, PAIR * 1.001)).all()
    found = halves_have(PAIR, PAIR * 1.001, PAIR + chance, known=[100.0 * known, known])
    assert doubtful(PAIR, found).all()


def test_a_part_that_halves_do_not_have_silences_none():
    """One is 1000 times as far off as the other, not 100: their geometric mean tells."""
    known = np.full(2, 0.1)
    found = halves_have(PAIR, PAIR + 2.0, PAIR + 0.002, known=[100.0 * known, known])
    np.testing.assert_allclose(found.deviations, np.sqrt(2.0 * 0.002))
    unknown = halves_have(PAIR, PAIR + 0.02, PAIR + 0.01, known=[np.inf * known, np.inf * known])
    assert np.all(unknown.deviations == halves_have(PAIR, PAIR + 0.02, PAIR + 0.01).deviations)


@pytest.mark.parametrize(("off", "spread"), [(0.001, 0.005), (0.007, 0.007)])
@pytest.mark.parametrize("vague", [None, np.full(2, 3.0)])
def test_where_one_half_alone_knows_an_exponent_the_other_may_be_anywhere(off, spread, vague):
    """A doublet with half of its decay in one half: of the rest the closed form is no mode."""
    known = [vague, np.full(2, 0.005)]
    found = halves_have(PAIR, PAIR - 3.0, PAIR + off, known=known)
    np.testing.assert_allclose(found.deviations, spread)
    found = halves_have(PAIR, PAIR - 3.0, PAIR + off, known=known[::-1])
    assert np.all(found.deviations > 0.05)  # that which knows is far off
    if vague is None:
        found = halves_have(PAIR, PAIR - 1e-3, PAIR + 1e-3, known=known)
        np.testing.assert_allclose(found.deviations, 1e-3)


@pytest.mark.parametrize(("turned", "silenced"), [(0.1, True), (0.11, False)])
def test_a_half_that_knows_no_rate_has_a_word_of_the_frequency(turned, silenced):
    """Slow modes: a deviation of half the rate is little beside the imaginary part."""
    slow, known = np.array([-0.05 + 0.2j, -0.05 - 0.2j]), [np.full(2, 0.026), np.full(2, 0.002)]
    found = halves_have(slow, slow + turned * np.array([1j, -1j]), slow + 0.001, known=known)
    np.testing.assert_allclose(found.deviations, 0.002 if silenced else np.sqrt(turned * 0.001))


@pytest.mark.parametrize(("apart", "counted"), [(0.19, False), (0.21, True)])
def test_the_geometric_mean_counts_where_chance_does_not_explain_a_half(apart, counted):
    known = [np.full(2, 0.05), np.full(2, 0.005)]
    found = halves_have(PAIR, PAIR + apart, PAIR + 0.01, known=known)
    weighted = np.sqrt((0.01 * apart**2 + 0.01**2) / 1.01)
    mean = np.sqrt(0.01 * apart)
    np.testing.assert_allclose(found.deviations, mean if counted else weighted)


@pytest.mark.parametrize(("slower", "doubted"), [(-8.0, False), (-1.5, False), (-0.5, True)])
def test_a_mode_that_every_half_forgets_within_a_turn_is_not_judged(slower, doubted):
    """How fast it is, halves do not know; whether it lasts, they do (1e-3 are -1.1 at ω = 1)."""
    whole = np.append(PAIR, -3.0)
    found = halves_have(whole, np.append(PAIR, -9.0), np.append(PAIR, slower))
    assert doubtful(whole, found).tolist() == [False, False, doubted]
    assert found.of(whole[::-1], "they have").slowest is None  # of these, in this order
    assert not len(replace(found, exponents=whole[:0]).judges(whole[:0]))


@pytest.mark.parametrize(("halves", "doubted"), [((-5.0, -7.0), True), ((-2.9, -3.1), False)])
def test_where_a_turn_forgets_all_modes_those_that_may_last_are_judged(halves, doubted):
    """-3 ± 2.8 1/s may be a mode that lasts, and no other of the model does."""
    whole = np.array([-3.0 + 0j])
    found = halves_have(whole, *([half] for half in halves))
    assert doubtful(whole, found).tolist() == [doubted]
    assert ("1 of 1 exponents are in doubt" in contradictions(whole, found)) == doubted
    assert ("a turn leaves less than 0.001" in contradictions(whole, found)) == doubted


def record(noise, n_periods=60, samples=32):
    """One doublet of a system with a slow mode and one that a turn leaves 2 % of."""
    F = np.zeros((3, 2, 2))
    F[0], F[1] = [[-0.1, 0.2], [0.0, -0.6]], [[0.02, 0.1], [0.05, 0.0]]
    system = LTPSystem(F, [[0.3], [1.0]], omega=1.0)
    t = np.arange(n_periods * samples) * 2 * np.pi / samples
    u = np.zeros((len(t), 1))
    u[8 * samples : 11 * samples], u[11 * samples : 14 * samples] = 1.0, -1.0
    y = system.simulate(u, t)
    y = y + noise * y.std(axis=0) * np.random.default_rng(0).standard_normal(y.shape)
    index = pd.Index(t, name="time")
    return pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index, ["a", "b"]), system


def test_a_model_of_the_whole_record_is_held_against_its_own_likelihood():
    u, y, _ = record(0.3)
    frame = HarmonicAnalyzer(1.0, reading="period").fit_transform(u, y)
    with pytest.warns(IdentifiabilityWarning, match="in doubt: .* its own likelihood has .* ±"):
        MOESPRegressor(2).fit(frame, y)


def test_a_model_that_is_known_is_not_in_doubt():
    u, y, system = record(0.001)
    frame = HarmonicAnalyzer(1.0, reading="period").fit_transform(u, y)
    found = MOESPRegressor(2).fit(frame, y)  # warnings are errors here
    multipliers = np.exp(system.floquet_exponents() * 2 * np.pi)
    np.testing.assert_allclose(
        np.sort_complex(found.eigenvalues_), np.sort_complex(multipliers), atol=2e-3
    )


@pytest.mark.parametrize(
    ("reading", "frequency", "words"),
    [
        ("period", 0.37, STILL),
        ("period", 0.0, "in doubt: .* the free decays"),
        ("sample", 0.37, STILL),
        ("sample", 0.0, STILL),
    ],
)
@pytest.mark.filterwarnings("ignore:.*(in doubt|do not determine)")
@pytest.mark.slow
def test_a_drift_or_a_tone_of_the_outputs_is_no_mode_without_a_word(reading, frequency, words):
    u, y, _ = record(0.01)
    psi = y.index.to_numpy()
    disturbance = np.cos(frequency * psi) * (1.0 + (frequency == 0.0) * psi / psi[-1])
    y = y + 0.3 * y.std().to_numpy() * disturbance[:, None]
    frame = HarmonicAnalyzer(1.0, reading=reading).fit_transform(u, y)
    with pytest.warns(IdentifiabilityWarning, match=words):
        MOESPRegressor().fit(frame, y)


@pytest.mark.parametrize(
    ("left", "known", "harmonics", "told"),
    [(7e-3, 2.4e-3, 24, True), (4e-3, 2.4e-3, 24, False), (7e-3, 2.4e-3, 2, False)],
)
@pytest.mark.filterwarnings("ignore:the outputs .* do not determine")
def test_a_periodic_model_that_loses_what_its_map_knew_is_told(left, known, harmonics, told):
    """Too few states move within the turn as no record shows, and G makes up for them.

    Noise alone makes no difference; nor does a machine that is not linear while inputs move it.
    """
    u, y, _ = record(0.001)
    frame = HarmonicAnalyzer(1.0, reading="period").fit_transform(u, y)
    model = MOESPRegressor(2).fit(frame, y).model_
    model = replace(model, lifted=replace(model.lifted, left=known))
    found = realize(model, read_experiment(frame, y), HarmonicStructure())
    coefficients = resize_harmonics(found.model.coefficients, 24)
    coefficients[2 * harmonics, : model.n_states, model.n_states :] = 1.0
    own = replace(found.model, coefficients=coefficients)
    found = replace(found, model=own, r2=1.0 - left)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_realized(found, model)
    words = [str(w.message) for w in said]
    assert [("but the map of whole periods" in each) for each in words] == [True] * told


@pytest.mark.filterwarnings("ignore:.* in doubt")
def test_what_the_map_of_whole_periods_leaves_is_noise():
    u, y, _ = record(0.05)
    frame = HarmonicAnalyzer(1.0, reading="period").fit_transform(u, y)
    model = MOESPRegressor(2).fit(frame, y).model_
    assert model.lifted.left == pytest.approx(0.05**2, rel=0.15)


@pytest.mark.parametrize(("order", "told"), [(1, True), (2, False)])
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
@pytest.mark.filterwarnings("ignore:the outputs .* do not determine")
@pytest.mark.slow
def test_a_likelihood_says_where_g_stands_for_states_that_are_missing(order, told):
    """Two slow modes as one: its exponent is known well, and wrong."""
    F = np.array([[[-0.23, 0.0], [0.3, -0.36]], [[0.0, 0.0], [0.05, 0.0]], np.zeros((2, 2))])
    system = LTPSystem(F, [[1.0], [0.0]], [[0.0, 1.0]], omega=0.8)
    u = np.zeros((60 * 64, 1))
    u[8 * 64 : 14 * 64], u[14 * 64 : 20 * 64] = 1.0, -1.0
    t = pd.Index(np.arange(len(u)) * system.period / 64, name="time")
    y = system.simulate(u, t.to_numpy()) + np.cos(0.8 * t.to_numpy())[:, None]
    y += 0.01 * np.random.default_rng(0).standard_normal(y.shape)
    pipe = make_pipeline(
        HarmonicAnalyzer(0.8, reading="period"),
        MOESPRegressor(order),
        StructuredMatcher(structure=HarmonicStructure(), criterion="output_error"),
    )
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        pipe.fit(pd.DataFrame(u, t, ["u"]), pd.DataFrame(y, t, ["y"]))
    assert any("they stand for what 1 state" in str(w.message) for w in said) == told


def reduced(noise, **options):
    """A reducer fitted through a sliding window, and what it warns of."""
    u, y, _ = record(noise)
    analyzer = HarmonicAnalyzer(1.0, reading="sliding", output_harmonics=1)
    frame = MOESPRegressor().fit_transform(analyzer.fit_transform(u, y), y)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        reducer = SpuriousModeReducer(**options).fit(frame, y)
    told = [str(w.message) for w in caught if issubclass(w.category, IdentifiabilityWarning)]
    return reducer, told


@pytest.mark.parametrize(
    "noise",
    [
        0.0,
        0.001,
        0.05,
        0.2,
    ],
)
@pytest.mark.slow
def test_the_verdicts_and_the_warning_agree(noise):
    reducer, told = reduced(noise)
    doubted = reducer.modes_["verdict"].isin(["ambiguous", "second-order"]).any()
    assert len(told) <= 1
    assert any(re.search("in doubt|as well as the one kept", text) for text in told) == doubted


def test_a_reducer_says_which_mode_its_model_lacks():
    _, told = reduced(0.0, n_states=1)
    (text,) = told
    assert re.search("lacks 1 of 2 exponents: the free decays at rest have .*, the model has", text)


def test_vague_decays_leave_the_word_to_the_samples(monkeypatch):
    """Four turns of rest knew one mode to 700 %, and the map explained all of its record."""
    vague, sure = opinion(PAIR, 0.2), opinion(PAIR, 1e-3)

    def heard(decays, known, samples):
        monkeypatch.setattr(period.sample, "opinion", lambda _: samples)
        return period._of_another_way(decays, known, None)

    assert sure.tells
    assert not vague.tells
    assert not opinion([-20.0], 1e-3).tells  # a period forgets it
    assert not opinion([-0.02], 0.05).tells
    assert heard(vague, True, None) is vague  # the likelihood knows it
    assert heard(None, True, sure) is sure
    assert heard(None, False, None) is None
    found = heard(sure, False, vague)
    assert (found.needed, found.way) == (True, sure.way)
    assert found.deviations is sure.deviations
    found = heard(vague, False, sure)
    assert not doubtful(PAIR, found).any()
    assert found.needed
    for samples in (None, vague):
        assert doubtful(PAIR, heard(vague, False, samples)).all()


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ExcitationWarning")
@pytest.mark.parametrize("heard", ["samples", "nothing"])
def test_inputs_that_explain_the_whole_record_leave_a_map_unconfirmed(heard, monkeypatch):
    """Sixteen directions and what two states make of them are as many as there are turns."""
    if heard == "nothing":
        monkeypatch.setattr(period.sample, "opinion", lambda _: None)
    rng, A, n = np.random.default_rng(0), np.array([[0.95, 0.2], [-0.2, 0.95]]), 48 * 16
    u, x, y = rng.standard_normal(n), np.zeros(2), np.zeros(n)
    for k in range(n):
        y[k] = x[0]
        x = A @ x + np.array([0.0, 1.0]) * u[k]
    y += 0.02 * y.std() * rng.standard_normal(n)
    t = pd.Index(np.arange(n) / 16, name="time")
    analyzer = HarmonicAnalyzer(2.0 * np.pi, reading="period", trim_span=None)
    pipe = make_pipeline(analyzer, MOESPRegressor(2))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = pipe.fit(pd.DataFrame({"u": u}, t), pd.DataFrame({"y": y}, t))[-1].model_
    words = " ".join(str(w.message) for w in said)
    if heard == "samples":
        assert model.opinion.needed
        assert model.opinion.way == "the samples have"
    else:
        assert model.opinion is None
        assert "its own likelihood has nothing that confirms it" in words


def test_few_time_constants_tell_few_things():
    """Two deviations have the normal level, by Student's t of half as many degrees."""
    rates = np.array([-1.0, -0.1, -1e-4, -100.0]) + 2.0j
    record = SimpleNamespace(times=lambda: [np.array([0.0, 12.0]), np.array([5.0, 13.0])])
    wider = _of_few_parts(rates, record)
    degrees = np.array([10.0, 1.0, 1.0, 1000.0])
    assert np.allclose(t.cdf(SURE * wider, degrees), norm.cdf(SURE))
    assert wider[1] == wider[2]
    assert 1.0 < wider[3] < 1.002
