"""Choosing the order: folds in time, scorers that simulate, the rule, scikit-learn's searches."""

import pickle
from functools import partial

import numpy as np
import pandas as pd
import pytest
from conftest import heave_pipeline
from sklearn.base import clone
from sklearn.decomposition import PCA
from sklearn.experimental import enable_halving_search_cv  # noqa: F401 - makes the next import work
from sklearn.frozen import FrozenEstimator
from sklearn.metrics import (
    max_error,
    mean_absolute_error,
    mean_squared_error,
    r2_score,
)
from sklearn.model_selection import (
    GridSearchCV,
    GroupKFold,
    HalvingGridSearchCV,
    LeaveOneGroupOut,
    RandomizedSearchCV,
    TimeSeriesSplit,
    cross_val_predict,
    cross_val_score,
    cross_validate,
)
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import FunctionTransformer

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.model_selection import (
    PeriodBlockSplit,
    fit_percent,
    fit_percent_scorer,
    simulation_scorer,
    smallest_within_one_standard_error,
)

SPP = 8
OMEGA = 2 * np.pi  # one period a second


def record(n_periods, *, first=0, spp=SPP):
    """Rows of some periods of OMEGA, the first of them sample ``first``."""
    time = (first + np.arange(n_periods * spp)) / spp
    return pd.DataFrame({"u": np.sin(time)}, index=pd.Index(time, name="time"))


def periods(data, rows, omega=OMEGA):
    """Number of the period of some rows."""
    return np.floor(data.index.get_level_values(-1)[rows] * omega / (2 * np.pi) + 1e-9).astype(int)


@pytest.fixture(scope="module")
def lti():
    """Noisy coefficients of a third-order system, excited throughout."""
    return make_flapping_wing(
        "lti", input="multisine", n_periods=80, samples_per_period=16, snr=20, random_state=0
    )


@pytest.fixture(scope="module")
def ltp_records():
    return make_flapping_wing(
        "ltp", n_records=4, n_periods=40, start=5, width=6, samples_per_period=16, snr=20,
        random_state=1,
    )  # fmt: skip


def synchronous(omega, **kwargs):
    analyzer = HarmonicAnalyzer(omega, output_harmonics=3, hop="period", **kwargs)
    return Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(block_rows=4))])


def labels(data):
    return data.inputs.index.get_level_values("record")


# ---- PeriodBlockSplit ------------------------------------------------------------------------


@pytest.mark.parametrize("first", [0, 3, -21])
@pytest.mark.parametrize(("n_splits", "gap"), [(2, 0), (3, 1), (5, 2)])
def test_blocks_are_whole_periods_and_test_every_row_once(n_splits, gap, first):
    data = record(17, first=first)
    split = PeriodBlockSplit(n_splits, omega=OMEGA, gap=gap)
    folds = list(split.split(data))
    assert len(folds) == split.get_n_splits() == n_splits
    tested = np.concatenate([test for _, test in folds])
    np.testing.assert_array_equal(tested, np.arange(len(data)))
    borders = [test[0] for _, test in folds[1:]]
    assert not np.any((first + np.array(borders)) % SPP)  # ψ = 0, wherever the record begins
    for train, test in folds:
        for rows in (train, test):
            assert np.all(np.diff(rows) > 0)
        p_test, p_train = periods(data, test), periods(data, train)
        distance = np.where(p_train < p_test[0], p_test[0] - p_train, p_train - p_test[-1])
        assert distance.min() == gap + 1
        left_out = len(data) - len(train) - len(test)
        sides = int(test[0] > 0) + int(test[-1] < len(data) - 1)
        assert left_out == sides * gap * SPP
    sizes = [len(np.unique(periods(data, test))) for _, test in folds]
    assert max(sizes) - min(sizes) <= 2  # whole periods shared evenly; ends may add an incomplete


def test_period_borders_survive_times_that_are_not_exact():
    """Hawkmoth's ω, a late start and rounded times: borders fall on the sample of ψ = 0."""
    omega = 2 * np.pi * 26.3
    dt = 2 * np.pi / omega / 64
    time = np.round(dt * np.arange(640_000, 640_000 + 64 * 30), 9)
    data = pd.DataFrame({"u": time}, index=time)
    for _, test in PeriodBlockSplit(5, omega=omega).split(data):
        assert test[0] % 64 == 0
        assert len(test) == 64 * 6


def test_arrays_count_samples_and_timedeltas_are_seconds():
    data = record(12)
    expected = list(PeriodBlockSplit(3, omega=OMEGA).split(data))
    moments = data.set_axis(pd.to_timedelta(data.index, unit="s"))
    for X, sample_time in ((data.to_numpy(), 1 / SPP), (moments, None), (data["u"], None)):
        found = PeriodBlockSplit(3, omega=OMEGA, sample_time=sample_time).split(X)
        for (train, test), (train_0, test_0) in zip(found, expected, strict=True):
            np.testing.assert_array_equal(train, train_0)
            np.testing.assert_array_equal(test, test_0)


def test_dates_count_from_their_origin():
    data = record(12, first=3)
    expected = list(PeriodBlockSplit(3, omega=OMEGA, trim_span=(1, 3)).split(data))
    origin = pd.Timestamp("2026-05-01 12:00", tz="UTC")
    dated = data.set_axis(origin + pd.to_timedelta(data.index, unit="s"))
    split = PeriodBlockSplit(3, omega=OMEGA, trim_span=(1, 3), time_origin=origin)
    for found, (train, test) in zip(split.split(dated), expected, strict=True):
        np.testing.assert_array_equal(found[0], train)
        np.testing.assert_array_equal(found[1], test)
    with pytest.raises(ValueError, match=r"index holds dates, which fix no azimuth; .*PeriodBlock"):
        list(PeriodBlockSplit(3, omega=OMEGA).split(dated))


@pytest.mark.parametrize("wrapped", [False, True])
def test_blocks_of_a_rotor_whose_speed_varies(wrapped):
    """Whole turns by the azimuth, of 76 rows at first and 54 at last, missing instants or not."""
    time = np.arange(64 * 24) / 64
    psi = OMEGA * (0.85 * time + 0.3 * time**2 / 48) + 0.2
    data = pd.DataFrame({"u": np.sin(time), "psi": psi % OMEGA if wrapped else psi}, index=time)
    data.iloc[200:203, 1] = np.nan
    data.iloc[500:510, 0] = np.nan  # what the analyzer's missing= is for
    hole = data.drop(data.index[800:1000])
    for given, own in ((data, psi), (hole, np.delete(psi, slice(800, 1000)))):
        folds = list(PeriodBlockSplit(4, azimuth="psi", gap=1).split(given))
        assert np.concatenate([test for _, test in folds]).tolist() == list(range(len(given)))
        turns = own / (2 * np.pi)
        for train, test in folds:
            if test[0] > 0:
                assert turns[test[0]] % 1 < 1.2 / 54  # a block begins with a turn
            beyond = np.maximum(
                np.floor(turns[test[0]]) - turns[train], turns[train] - np.ceil(turns[test[-1]])
            )
            assert beyond.min() > 1 - 2 / 54
    by_speed = PeriodBlockSplit(4, omega=OMEGA).split(data)
    starts = np.array([psi[test[0]] / (2 * np.pi) % 1 for _, test in list(by_speed)[1:]])
    assert np.all((starts > 0.03) & (starts < 0.97))  # which the mean speed does not find


def test_every_record_is_cut_by_itself():
    parts = {"a": record(9), "b": record(12), "c": record(7)}
    data = pd.concat(parts, names=["record"])
    folds = list(PeriodBlockSplit(3, omega=OMEGA).split(data))
    starts = {"a": 0, "b": 9 * SPP, "c": 21 * SPP}
    for name, part in parts.items():
        alone = PeriodBlockSplit(3, omega=OMEGA).split(part)
        for (train, test), (train_0, test_0) in zip(folds, alone, strict=True):
            mine = slice(starts[name], starts[name] + len(part))
            for rows, own in ((train, train_0), (test, test_0)):
                inside = rows[(rows >= mine.start) & (rows < mine.stop)] - mine.start
                np.testing.assert_array_equal(inside, own)


def test_a_hole_in_a_record_does_not_split_it():
    data = record(20)
    holed = data.drop(data.index[5 * SPP + 3 : 7 * SPP + 2])  # periods 5 and 7 incomplete
    folds = list(PeriodBlockSplit(3, omega=OMEGA, gap=1).split(holed))
    np.testing.assert_array_equal(
        np.concatenate([test for _, test in folds]), np.arange(len(holed))
    )
    for train, test in folds:
        assert not set(periods(holed, train)) & set(periods(holed, test))


def test_the_trim_span_is_always_trained_on():
    data = record(24)
    split = PeriodBlockSplit(4, omega=OMEGA, trim_span=(0.0, 4.0))
    for train, test in split.split(data):
        assert set(range(4 * SPP)) <= set(train)
        assert test[0] >= 4 * SPP
        assert len(test) == 5 * SPP


def test_training_rows_begin_new_segments(lti):
    """What the model steps make of a fold: one segment on either side of the hole."""
    split = PeriodBlockSplit(4, omega=lti.omega)
    segments = []
    for train, _ in split.split(lti.inputs):
        model = MOESPRegressor(order=3, block_rows=6)
        model.fit(lti.inputs.iloc[train], lti.outputs.iloc[train])
        segments.append(len(model.x0_))
    assert segments == [1, 2, 2, 1]


def test_splitter_prints_clones_and_pickles(lti):
    split = PeriodBlockSplit(3, omega=OMEGA, gap=2)
    assert repr(split) == (
        "PeriodBlockSplit(azimuth=None, gap=2, n_splits=3, omega=6.283185307179586,\n"
        "         sample_time=None, time_origin=None, trim_span=None)"
    )
    search = GridSearchCV(MOESPRegressor(), {"order": [1]}, cv=split)
    assert clone(search).cv.gap == 2
    assert pickle.loads(pickle.dumps(split)).n_splits == 3


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"n_splits": 1}, "n_splits must be a whole number of at least 2, got 1"),
        ({"n_splits": 2.5}, "n_splits must be a whole number"),
        ({"n_splits": 13}, r"record 0 has 12 whole period\(s\).*too few for n_splits=13 blocks"),
        ({"gap": -1}, "gap must be a whole number of at least 0, got -1"),
        ({"gap": 0.5}, "gap must be a whole number"),
        ({"gap": 12}, "gap=12 leaves no whole period to train on beside block 0 of n_splits=5"),
        ({"omega": 0.0}, "omega must be a positive number in rad/s"),
        ({"omega": 60.0}, "0.8378 samples a period; at least two are needed: correct omega, or"),
        ({"trim_span": (3.0, 1.0)}, r"trim_span=\(3.0, 1.0\) is not a pair of times; give"),
        (
            {"omega": None},
            "omega=None and azimuth=None leave the period unknown; give omega in rad",
        ),
        ({"azimuth": "psi"}, "omega=6.28.* and azimuth='psi' are both given"),
        ({"omega": None, "azimuth": "psi"}, r"azimuth='psi' is not among the columns \['u'\] of X"),
        ({"time_origin": "2026-01-01"}, "time_origin=2026-01-01T00:00:00 is given, but the index"),
        ({"trim_span": 2.0}, "trim_span=2.0 is not a pair of times; give"),
        ({"sample_time": 0.5}, "sample_time=0.5 s, but the rows of the index are 0.125 s apart"),
    ],
)
def test_splitter_words_what_is_wrong(parameters, message):
    with pytest.raises(ValueError, match=message):
        list(PeriodBlockSplit(**{"omega": OMEGA, **parameters}).split(record(12)))


def test_splitter_needs_times_and_names_the_short_record():
    with pytest.raises(ValueError, match="X is None; PeriodBlockSplit reads the times"):
        list(PeriodBlockSplit(omega=OMEGA).split(None))
    data = pd.concat({"long": record(9), "short": record(2)}, names=["record"])
    with pytest.raises(ValueError, match=r"record 'short' has 2 whole period\(s\)"):
        list(PeriodBlockSplit(3, omega=OMEGA).split(data))
    unseen = record(9).assign(psi=np.where(np.arange(9 * SPP) < 9 * SPP - 1, np.nan, 1.0))
    with pytest.raises(
        ValueError, match=r"'psi' shows no motion in record 0: it is known at fewer"
    ):
        list(PeriodBlockSplit(3, azimuth="psi").split(unseen))


# ---- scorers -----------------------------------------------------------------------------------


def test_r2_by_simulation_is_the_estimators_own_score(lti, ltp_records):
    scorer = simulation_scorer(r2_score)
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    assert scorer(model, lti.inputs, lti.outputs) == model.score(lti.inputs, lti.outputs)
    data = ltp_records
    pipe = synchronous(data.omega).fit(data.inputs, data.outputs)
    weight = np.linspace(0.0, 1.0, len(data.inputs))
    for estimator in (pipe, make_pipeline(pipe), FrozenEstimator(pipe), make_pipeline(*pipe)):
        assert scorer(estimator, data.inputs, data.outputs) == pipe.score(data.inputs, data.outputs)
        found = scorer(estimator, data.inputs, data.outputs, sample_weight=weight)
        assert found == pipe.score(data.inputs, data.outputs, sample_weight=weight)


def test_raw_measurements_score_as_their_pipeline_does(nltp):
    """The periodic trim is taken from both, as in score."""
    pipe = heave_pipeline(nltp.omega, trim_span=nltp.trim_span, n_states=3)
    pipe.fit(nltp.inputs, nltp.outputs)
    found = simulation_scorer(r2_score)(pipe, nltp.inputs, nltp.outputs)
    assert found == pipe.score(nltp.inputs, nltp.outputs)


def test_starting_at_rest_spoils_a_fold_in_mid_record():
    """A slow, lightly damped system, tested from the middle of its motion."""
    rng = np.random.default_rng(0)
    turn = 0.999 * np.array([[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]])
    u = rng.standard_normal((1200, 1))
    x, y = np.zeros(2), np.empty(1200)
    for k in range(1200):
        y[k], x = x[1], turn @ x + [u[k, 0], 0.0]
    cv = TimeSeriesSplit(3)
    model = MOESPRegressor(order=2, block_rows=6)
    at_rest = cross_val_score(model, u, y, cv=cv, scoring="r2")
    simulated = cross_val_score(model, u, y, cv=cv, scoring=simulation_scorer(r2_score))
    np.testing.assert_array_equal(simulated, cross_val_score(model, u, y, cv=cv))
    assert simulated.min() > 1 - 1e-9
    assert at_rest.max() < 0.9


def test_errors_turn_their_sign_and_take_arguments(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    args = model, lti.inputs, lti.outputs
    error = simulation_scorer(mean_squared_error, greater_is_better=False)
    assert error(*args) < 0.0
    per_output = [
        simulation_scorer(mean_squared_error, multioutput=weights)(*args) for weights in np.eye(3)
    ]
    assert np.mean(per_output) == pytest.approx(-error(*args))


def test_one_output_reaches_the_metric_as_one_output(lti):
    """max_error takes no second dimension of more than one column; a Series gives none."""
    y = lti.outputs["w_0"]
    model = MOESPRegressor(order=3, block_rows=20).fit(lti.inputs, y)

    def shape(y_true, y_pred):
        assert y_true.shape == y_pred.shape
        return y_true.ndim

    assert simulation_scorer(shape)(model, lti.inputs, y) == 1.0
    assert simulation_scorer(max_error)(model, lti.inputs, y) > 0.0


def test_fit_percent_is_its_definition(rng):
    y = rng.standard_normal((50, 2)) + 3.0
    y_hat = y + 0.1 * rng.standard_normal((50, 2))
    fit = fit_percent(y, y_hat)
    error, spread = np.linalg.norm(y - y_hat, axis=0), np.linalg.norm(y - y.mean(axis=0), axis=0)
    np.testing.assert_allclose(fit, 100 * (1 - error / spread), rtol=1e-12)
    r2 = r2_score(y, y_hat, multioutput="raw_values")
    np.testing.assert_allclose(1 - (1 - fit / 100) ** 2, r2, rtol=1e-12)


def test_fit_percent_laws(rng):
    y, y_hat = rng.standard_normal((2, 60))
    fit = fit_percent(y, y_hat)
    assert fit.shape == (1,)
    assert fit_percent(y, y)[0] == 100.0
    assert fit_percent(y, np.full(60, y.mean()))[0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(fit_percent(7.0 * y + 2.0, 7.0 * y_hat + 2.0), fit)
    doubled = fit_percent(np.r_[y, y[:20]], np.r_[y_hat, y_hat[:20]])
    weight = np.r_[np.full(20, 2.0), np.ones(40)]
    np.testing.assert_allclose(fit_percent(y, y_hat, sample_weight=weight), doubled)
    constant = np.ones((5, 2))
    np.testing.assert_array_equal(
        fit_percent(constant, constant + np.array([0.0, 1.0])), [100.0, 0.0]
    )
    frame, series = pd.DataFrame({"w": y}), pd.Series(y_hat)
    np.testing.assert_array_equal(fit_percent(frame, series.to_frame()), fit)


def test_fit_percent_scorer_means_or_picks(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    args = model, lti.inputs, lti.outputs
    one_by_one = [fit_percent_scorer(i)(*args) for i in range(3)]
    by_name = [fit_percent_scorer(name)(*args) for name in lti.outputs.columns]
    assert one_by_one == by_name
    assert fit_percent_scorer()(*args) == pytest.approx(np.mean(one_by_one))
    r2 = simulation_scorer(r2_score, multioutput=[0.0, 1.0, 0.0])(*args)
    assert one_by_one[1] == pytest.approx(100 * (1 - np.sqrt(1 - r2)))
    # noise of 1/20 of the clean signal leaves 1 − 1/20 of the fit to a perfect model
    assert 94.0 < fit_percent_scorer()(*args) < 95.5


def test_scorers_print_and_pickle(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    error = simulation_scorer(mean_absolute_error, greater_is_better=False, multioutput=[1, 0, 0])
    assert repr(error) == (
        "simulation_scorer(mean_absolute_error, greater_is_better=False, multioutput=[1, 0, 0])"
    )
    assert repr(fit_percent_scorer("w_0")) == "fit_percent_scorer(output='w_0')"
    for scorer in (error, fit_percent_scorer("w_0")):
        again = pickle.loads(pickle.dumps(scorer))
        assert again(model, lti.inputs, lti.outputs) == scorer(model, lti.inputs, lti.outputs)


def test_scorers_word_what_is_wrong(lti):
    model = MOESPRegressor(order=3, block_rows=8).fit(lti.inputs, lti.outputs)
    args = model, lti.inputs, lti.outputs
    with pytest.raises(ValueError, match="metric='r2' is not callable; give a function such as"):
        simulation_scorer("r2")
    with pytest.raises(TypeError, match="PCA does not end in a model step of sklearn_hd"):
        simulation_scorer(r2_score)(PCA(), lti.inputs, lti.outputs)
    with pytest.raises(TypeError, match="sample_weight was given, but max_error takes none"):
        simulation_scorer(max_error)(*args, sample_weight=np.ones(len(lti.inputs)))
    for output in ("phi_dot", 3, -1, True, 0.5):
        with pytest.raises(ValueError, match=r"is not among the outputs \['w_0', 'phi_dot_1c'"):
            fit_percent_scorer(output)(*args)
    y = np.zeros((4, 2))
    with pytest.raises(ValueError, match=r"y_true has shape \(4, 2\) and y_pred \(4,\)"):
        fit_percent(y, y[:, 0])
    with pytest.raises(ValueError, match="y_pred is not finite in row 1, output 1"):
        fit_percent(y, np.where(np.arange(8).reshape(4, 2) == 3, np.nan, y))
    with pytest.raises(ValueError, match="have different indices; align them first"):
        fit_percent(pd.Series([1.0, 2.0]), pd.Series([1.0, 2.0], index=[1, 2]))
    with pytest.raises(ValueError, match=r"sample_weight of shape \(3,\) must hold 4 numbers"):
        fit_percent(y, y, sample_weight=np.ones(3))


# ---- the rule ----------------------------------------------------------------------------------


def results(scores, metric="score", **parameters):
    """cv_results_ as a search would hold them, from scores (n_candidates, n_folds)."""
    scores = np.asarray(scores, dtype=float)
    names = list(parameters)
    found = {
        "params": [dict(zip(names, v, strict=True)) for v in zip(*parameters.values(), strict=True)]
    }
    found |= {f"param_{name}": np.asarray(parameters[name], dtype=object) for name in names}
    found |= {f"split{f}_test_{metric}": scores[:, f] for f in range(scores.shape[1])}
    return found | {f"mean_test_{metric}": scores.mean(axis=1)}


SCORES = [[0.5, 0.6, 0.4], [0.89, 0.82, 0.66], [0.90, 0.80, 0.70], [0.88, 0.81, 0.69]]


def test_the_rule_takes_the_smallest_within_one_standard_error():
    assert smallest_within_one_standard_error(results(SCORES, order=[1, 2, 3, 4])) == 1
    assert smallest_within_one_standard_error(results(SCORES, order=[4, 3, 2, 1])) == 3
    shuffled = results(np.array(SCORES)[[2, 0, 3, 1]], identify__order=[3, 1, 4, 2])
    assert smallest_within_one_standard_error(shuffled) == 3


@pytest.mark.parametrize("test_share", [None, 0.1, 1.0])
def test_the_standard_error_is_that_of_the_best_for_folds_that_overlap(test_share):
    """A candidate just within is taken, one just beyond is not (Nadeau and Bengio's q)."""
    best = np.array([0.9, 0.7, 0.8, 0.6])
    q = 1 / 3 if test_share is None else test_share
    error = np.sqrt(np.var(best, ddof=1) * (1 / 4 + q))
    for share, chosen in ((0.999, 0), (1.001, 1)):
        table = results([best - share * error, best], order=[1, 2])
        assert smallest_within_one_standard_error(table, test_share=test_share) == chosen


def test_a_tiny_gain_on_every_fold_does_not_buy_a_state():
    """Far beyond the error of the difference, which is 0, but nothing beside that of the score."""
    best = np.array([0.9974, 0.9971, 0.9969, 0.9975])
    assert smallest_within_one_standard_error(results([best - 1e-5, best], order=[3, 4])) == 0


def test_equal_orders_are_parted_by_block_rows_or_by_score():
    table = results(
        [[0.9, 0.8], [0.9, 0.8], [0.91, 0.79]], order=[2, 2, 2], identify__block_rows=[9, 5, 7]
    )
    assert smallest_within_one_standard_error(table) == 1
    assert smallest_within_one_standard_error(table, size="block_rows") == 1
    better = results([[0.90, 0.80], [0.91, 0.80]], order=[2, 2], block_rows=[5, 9])
    assert smallest_within_one_standard_error(better) == 0
    assert smallest_within_one_standard_error(better, size=["order"]) == 1


def test_rounding_is_no_difference():
    """Scores of noise-free data: 1 − 1e-14 is as good as 1 − 1e-16, on every fold."""
    table = results([[0.9] * 3, [1 - 1e-13] * 3, [1 - 1e-15] * 3], order=[2, 3, 4])
    assert smallest_within_one_standard_error(table) == 1


def test_several_metrics_need_one_to_decide_by():
    table = results(SCORES, order=[1, 2, 3, 4]) | results(SCORES[::-1], "fit", order=[1, 2, 3, 4])
    assert smallest_within_one_standard_error(table, metric="fit") == 0
    only = results(SCORES, "fit", order=[1, 2, 3, 4])
    with pytest.raises(ValueError, match=r"metric='score' is not among.*\['fit'\]; name one"):
        smallest_within_one_standard_error(only)


def test_failed_candidates_are_named_with_their_folds():
    scores = np.array(SCORES)
    scores[0, 2] = np.nan
    scores[3] = np.nan
    with pytest.raises(ValueError, match="2 of 4 candidates failed") as raised:
        smallest_within_one_standard_error(results(scores, order=[1, 2, 3, 4]))
    assert "{'order': 1} on folds [2]; {'order': 4} on folds [0, 1, 2]" in str(raised.value)
    assert "error_score='raise'" in str(raised.value)


@pytest.mark.parametrize(
    ("table", "kwargs", "message"),
    [
        (results(SCORES, window=list("abcd")), {"size": "order"}, r"none of size=\['order'\] was"),
        (results(SCORES, n_states=[1, 2, 3, 4]), {}, r"none of size=\['order', 'block_rows'\] was"),
        (results(SCORES[:2], order=[2, "auto"]), {}, "order='auto' of candidate .* is no size"),
        (results(SCORES[:2], block_rows=[4, None]), {}, "block_rows=None of candidate .* is no s"),
        (
            results(SCORES[:2], a__order=[1, 2], b__order=[1, 2]),
            {},
            r"size='order' could be any of \['a__order', 'b__order'\]; give the whole name",
        ),
        (results([[0.9], [0.8]], order=[1, 2]), {}, r"the search has 1 fold\(s\), and a standard"),
        (results(SCORES, order=[1, 2, 3, 4]), {"test_share": -1}, "test_share must be a positive"),
    ],
)
def test_rule_words_what_is_wrong(table, kwargs, message):
    with pytest.raises(ValueError, match=message):
        smallest_within_one_standard_error(table, **kwargs)


def test_choices_without_a_size_are_parted_by_score():
    """A window alone, block rows left to the estimator, and grids of different parameters."""
    windows = results(SCORES, harmonics__window=["hann", "boxcar", "triangle", "centred-hann"])
    assert smallest_within_one_standard_error(windows) == 2
    left_open = results(SCORES[1:3], order=[2, 2], block_rows=[None, 14])
    assert smallest_within_one_standard_error(left_open) == 1
    lists = results(SCORES[1:3], order=[2, 2])
    lists["params"] = [{"order": 2, "block_rows": 14}, {"order": 2}]
    lists["param_block_rows"] = np.ma.array([14, 0], mask=[False, True])
    assert smallest_within_one_standard_error(lists) == 1
    lists["params"] = [{"order": 2}, {"block_rows": 9}]
    with pytest.raises(ValueError, match=r"order was not searched for this candidate: .*'block_r"):
        smallest_within_one_standard_error(lists)


def test_a_whole_name_parts_two_steps():
    table = results(SCORES[1:3], a__order=[2, 1], b__order=[1, 2])
    assert smallest_within_one_standard_error(table, size="a__order") == 1
    assert smallest_within_one_standard_error(table, size="b__order") == 0


# ---- scikit-learn's searches ---------------------------------------------------------------------


def test_grid_search_over_period_blocks(lti):
    search = GridSearchCV(
        MOESPRegressor(),
        {"order": [1, 2, 3, 4, 5], "block_rows": [8, 12]},
        cv=PeriodBlockSplit(4, omega=lti.omega),
        refit=smallest_within_one_standard_error,
        n_jobs=2,
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_["order"] == 3
    assert search.best_estimator_.order_ == 3
    assert not hasattr(search, "best_score_")  # scikit-learn's way with a callable refit
    assert clone(search).refit is smallest_within_one_standard_error


@pytest.mark.parametrize(
    "grid",
    [
        [{"order": [2, 3, 4], "block_rows": [8]}, {"order": [3, 5]}],
        {"order": [2, 3, 4], "block_rows": [None, 14]},
    ],
)
def test_grids_whose_candidates_leave_something_open(lti, grid):
    search = GridSearchCV(
        MOESPRegressor(),
        grid,
        cv=PeriodBlockSplit(3, omega=lti.omega),
        refit=smallest_within_one_standard_error,
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_["order"] == 3


def test_grid_search_with_several_metrics(lti):
    search = GridSearchCV(
        MOESPRegressor(block_rows=8),
        {"order": [2, 3, 4]},
        cv=TimeSeriesSplit(3),
        scoring={"fit": fit_percent_scorer(), "r2": simulation_scorer(r2_score)},
        refit=partial(smallest_within_one_standard_error, metric="fit"),
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_ == {"order": 3}
    assert search.best_index_ == 1


@pytest.mark.parametrize("cv", [GroupKFold(2), LeaveOneGroupOut()])
def test_grid_search_over_whole_records(ltp_records, cv):
    data = ltp_records
    search = GridSearchCV(
        synchronous(data.omega),
        {"identify__order": [1, 2, 3], "identify__block_rows": [4, 5]},
        cv=cv,
        refit=smallest_within_one_standard_error,
    ).fit(data.inputs, data.outputs, groups=labels(data))
    assert search.best_params_["identify__order"] == 2
    assert simulation_scorer(r2_score)(search, data.inputs, data.outputs) == search.score(
        data.inputs, data.outputs
    )


def test_randomized_search_and_nested_cross_validation(lti):
    search = RandomizedSearchCV(
        MOESPRegressor(),
        {"order": [2, 3, 4], "block_rows": [6, 8, 10]},
        n_iter=4,
        cv=TimeSeriesSplit(3),
        refit=smallest_within_one_standard_error,
        random_state=2,
    )
    outer = PeriodBlockSplit(2, omega=lti.omega)
    found = cross_validate(
        search, lti.inputs, lti.outputs, cv=outer, scoring=fit_percent_scorer(),
        return_estimator=True,
    )  # fmt: skip
    assert [s.best_params_["order"] for s in found["estimator"]] == [3, 3]
    assert found["test_score"].min() > 93.0


def test_cross_val_predict_takes_the_splitter(lti):
    predicted = cross_val_predict(
        MOESPRegressor(order=3, block_rows=8), lti.inputs, lti.outputs,
        cv=PeriodBlockSplit(3, omega=lti.omega),
    )  # fmt: skip
    assert predicted.shape == lti.outputs.shape
    assert np.isfinite(predicted).all()


def test_raw_measurements_keep_their_trim_in_every_fold():
    data = make_flapping_wing(
        "nltp", input="3211", width=4, n_periods=80, samples_per_period=32, amplitude=0.005, snr=20,
        random_state=0,
    )  # fmt: skip
    pipe = synchronous(data.omega, trim_span=data.trim_span).set_params(identify__order=2)
    with_trim = PeriodBlockSplit(4, omega=data.omega, trim_span=data.trim_span)
    assert cross_val_score(pipe, data.inputs, data.outputs, cv=with_trim).min() > 0.9
    without = PeriodBlockSplit(4, omega=data.omega)
    with pytest.raises(ValueError, match="holds less than one whole period"):
        cross_val_score(pipe, data.inputs, data.outputs, cv=without, error_score="raise")


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.FitFailedWarning")
@pytest.mark.filterwarnings("ignore:One or more of the test scores are non-finite")
def test_the_rule_refuses_where_grid_search_would_not(lti):
    grid = {"order": [3, 40], "block_rows": [8]}
    search = GridSearchCV(MOESPRegressor(), grid, cv=PeriodBlockSplit(3, omega=lti.omega))
    search.fit(lti.inputs, lti.outputs)
    assert search.best_params_["order"] == 3
    search.set_params(refit=smallest_within_one_standard_error)
    with pytest.raises(ValueError, match=r"1 of 2 candidates failed.*'order': 40.* on folds \[0, "):
        search.fit(lti.inputs, lti.outputs)


def test_halving_over_block_rows_works(lti):
    search = HalvingGridSearchCV(
        MOESPRegressor(),
        {"order": [1, 2, 3]},
        resource="block_rows",
        min_resources=4,
        max_resources=12,
        cv=PeriodBlockSplit(3, omega=lti.omega),
        factor=3,
    ).fit(lti.inputs, lti.outputs)
    assert search.best_params_ == {"order": 3, "block_rows": 12}


@pytest.mark.parametrize("harmonics", [False, True])
@pytest.mark.parametrize("blocks", [False, True])
def test_halving_over_rows_ends_in_an_error_about_time(lti, ltp_records, harmonics, blocks):
    """Its subsamples are rows at random, in random order."""
    if harmonics:
        data = ltp_records.inputs.loc[0], ltp_records.outputs.loc[0]
        omega, prefix = ltp_records.omega, "identify__"
        estimator = synchronous(omega)
    else:
        data, omega, prefix, estimator = (lti.inputs, lti.outputs), lti.omega, "", MOESPRegressor()
    search = HalvingGridSearchCV(
        estimator,
        {f"{prefix}order": [1, 2, 3, 4]},
        cv=PeriodBlockSplit(3, omega=omega) if blocks else TimeSeriesSplit(3),
        min_resources=200,
        random_state=0,
    )
    with pytest.raises(ValueError, match="time must increase within a record"):
        search.fit(*data)


def test_columns_made_before_the_analyzer_are_scored_too(ltp_records):
    data = ltp_records
    pipe = Pipeline(
        [("double", FunctionTransformer(lambda u: 2.0 * u)), *synchronous(data.omega).steps]
    )
    pipe.fit(data.inputs, data.outputs)
    assert simulation_scorer(r2_score)(pipe, data.inputs, data.outputs) == pipe.score(
        data.inputs, data.outputs
    )
