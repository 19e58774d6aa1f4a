"""Wrong data, wrong times and wrong moments: each ends in a message that names the way out."""

import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.model_selection import KFold, TimeSeriesSplit, cross_val_score
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import StandardScaler

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._records.sampling import outliers
from sklearn_hd.datasets import make_rotor
from sklearn_hd.exceptions import IdentifiabilityWarning, JitterWarning, TimeBaseWarning
from sklearn_hd.model_selection import fit_percent

OMEGA = 2 * np.pi
SPP = 16


@pytest.fixture
def u(rng):
    index = pd.Index(np.arange(60 * SPP) / SPP, name="time")
    return pd.DataFrame({"u": rng.standard_normal(60 * SPP)}, index=index)


@pytest.fixture
def y(u):
    lag = np.zeros(len(u))
    for k in range(len(u) - 1):
        lag[k + 1] = 0.9 * lag[k] + u.iloc[k, 0]
    return pd.DataFrame({"w": lag}, index=u.index)


@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize("reading", ["sample", None])
def test_an_output_among_the_inputs_is_told(u, y, reading, scale):
    """A copy, whatever its name; in other units it may be a signal of its own."""
    model, X = MOESPRegressor(1, block_rows=4), u.assign(copy=scale * y["w"])
    if reading is not None:
        analyzer = HarmonicAnalyzer(OMEGA, reading=reading, output_harmonics=0)
        model = make_pipeline(analyzer, model)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.fit(X, y)
    told = [str(w.message) for w in caught if "has the values of the output 'w'" in str(w.message)]
    assert len(told) == (scale == 1.0)
    assert all(words.startswith("the input 'copy'") for words in told)


def analyzer(**params):
    return HarmonicAnalyzer(**{"omega": OMEGA, "output_harmonics": 0, "hop": 4} | params)


def chain(*steps):
    return Pipeline([(f"step{k}", step) for k, step in enumerate(steps)])


# ---- containers -------------------------------------------------------------------------------

CONTAINERS = {
    "text": ("abc", TypeError, r"X is a str, which is not a table of signals"),
    "dict": ({"u": [1, 2]}, TypeError, r"X is a dict, .*; make it a DataFrame: pd.DataFrame\(X\)"),
    "ragged": ([[1, 2], [3]], ValueError, r"X has rows of different lengths; give \(n_samples"),
    "number": (5.0, ValueError, r"X has 0 dimensions; give \(n_samples, n_signals\)"),
    "text cells": ([["a"]] * 9, ValueError, r"X holds values that are not numbers.*: .*; convert"),
    "dates": (
        np.full((9, 1), np.datetime64("2026-05-01")),
        TypeError,
        r"X holds values that are not numbers.*: they are times; convert them first",
    ),
    "a column of dates": (
        pd.DataFrame({"u": [1.0] * 9, "when": pd.Timestamp("2026-05-01")}),
        TypeError,
        r"X holds values that are not numbers \(column 'when'\): they are times",
    ),
    "a column of text": (
        pd.DataFrame({"u": [1.0] * 9, "phase": "climb"}),
        ValueError,
        r"X holds values that are not numbers \(column 'phase'\)",
    ),
}


@pytest.mark.filterwarnings("ignore:the model is unstable")
def test_only_a_model_of_outputs_alone_does_without_inputs():
    with pytest.raises(
        TypeError, match=r"X is None, which is not a table of signals; give a DataFrame"
    ):
        analyzer().fit(None, np.ones(9))
    model = MOESPRegressor(order=1).fit(None, np.cumsum(np.arange(40.0) % 3))
    with pytest.raises(
        TypeError, match=r"a model of outputs alone, .* takes a frame without columns"
    ):
        model.predict(None)


@pytest.mark.parametrize("case", CONTAINERS)
@pytest.mark.parametrize("step", [analyzer(), MOESPRegressor(order=1)], ids=["analyze", "identify"])
def test_containers_that_are_no_table(case, step):
    X, error, message = CONTAINERS[case]
    with pytest.raises(error, match=message):
        step.fit(X, np.ones(9))


def test_targets_that_are_no_table(u):
    for y, error, message in (
        ("abc", TypeError, "y is a str, which is not a table of signals"),
        ({"w": 1}, TypeError, r"y is a dict, .* pd.DataFrame\(y\)"),
        ([[1], [2, 3]], ValueError, "y has rows of different lengths"),
    ):
        with pytest.raises(error, match=message):
            MOESPRegressor().fit(u, y)


def test_masked_and_nullable_values_are_missing(u, y):
    """A mask is not dropped: it is NaN, with what ``missing`` makes of that."""
    masked = np.ma.masked_array(u.to_numpy(), mask=np.arange(len(u))[:, None] == 40)
    nullable = u.astype("Float64")
    nullable.iloc[40, 0] = pd.NA
    holed = u.copy()
    holed.iloc[40, 0] = np.nan
    for X in (masked, nullable):
        with pytest.raises(
            ValueError, match=r"X contains NaN: column '.*', first at t = .* \(row 40"
        ):
            MOESPRegressor(order=1).fit(X, y.to_numpy())
    expected = analyzer(missing="gap", input_harmonics=1).fit_transform(holed)
    np.testing.assert_array_equal(
        analyzer(missing="gap", input_harmonics=1).fit_transform(nullable), expected
    )
    with pytest.warns(TimeBaseWarning):
        found = analyzer(missing="gap", input_harmonics=1, sample_time=1 / SPP).fit_transform(
            masked
        )
    np.testing.assert_array_equal(found, expected)
    whole = np.ma.masked_array(np.arange(9), mask=np.arange(9) == 3)
    with pytest.raises(ValueError, match=r"y contains NaN: column 'y0', first at .* \(row 3\)"):
        MOESPRegressor().fit(u.iloc[:9].to_numpy(), whole)


def test_fit_percent_of_text():
    with pytest.raises(ValueError, match="y_pred holds values that are not numbers"):
        fit_percent([1.0, 2.0], ["a", "b"])
    with pytest.raises(ValueError, match="sample_weight holds values that are not numbers"):
        fit_percent([1.0, 2.0], [1.0, 2.0], sample_weight=["a", "b"])


# ---- times ------------------------------------------------------------------------------------


def test_times_lost_on_the_way(u, y):
    """A step that returns arrays: before the analyzer, and between it and the model."""
    lost = r"y has times in its index, but X has none: .*set_output\(transform='pandas'\)"
    for steps in (
        (StandardScaler(), analyzer(), MOESPRegressor(order=1)),
        (analyzer(), StandardScaler(), MOESPRegressor(order=1)),
        (StandardScaler(), MOESPRegressor(order=1)),
    ):
        with pytest.raises(ValueError, match=lost):
            chain(*steps).fit(u, y)
        with pytest.raises(ValueError, match=lost):
            chain(*steps).fit(u, y["w"])
    with (
        pytest.warns(TimeBaseWarning),
        pytest.raises(
            ValueError,
            match=r"1 samples a period \(the index of X holds no times, .*set_output\(transform",
        ),
    ):
        chain(StandardScaler(), analyzer(), MOESPRegressor(order=1)).fit(u, y.to_numpy())
    kept = chain(
        StandardScaler(with_mean=False).set_output(transform="pandas"), MOESPRegressor(order=1)
    )
    assert kept.fit(u, y).score(u, y) > 0.999


def test_outputs_that_count_their_rows(u, y):
    with pytest.raises(
        ValueError, match=r"different indices \(y has no times: use y.set_axis\(X.index"
    ):
        MOESPRegressor(order=1).fit(u, y.reset_index(drop=True))
    fold = y.reset_index(drop=True).iloc[40:]  # of which a split of arrays leaves no trace in X
    with pytest.raises(ValueError, match=r"from 0, y from 40: give X the index of y, or use arr"):
        MOESPRegressor(order=1).fit(u.to_numpy()[40:], fold)


def test_rows_of_arrays_are_taken_in_the_order_given(u):
    with pytest.warns(TimeBaseWarning, match=r"one contiguous record that starts at psi = 0"):
        analyzer(sample_time=1 / SPP).fit(u.to_numpy())


def test_a_shuffled_split_is_named(u, y):
    pipe = chain(analyzer(), MOESPRegressor(order=1))
    for step in (pipe, MOESPRegressor(order=1, block_rows=8)):
        with pytest.raises(ValueError, match=r"drawn at random, as by a shuffled split"):
            cross_val_score(
                step, u, y, cv=KFold(3, shuffle=True, random_state=0), error_score="raise"
            )


@pytest.mark.parametrize("revolve", [lambda psi: psi % 360, lambda psi: (psi + 180) % 360 - 180])
def test_wrapped_degrees(u, revolve):
    psi = np.rad2deg(OMEGA * u.index.to_numpy())
    X = u.assign(psi=revolve(psi))
    with pytest.raises(
        ValueError, match=r"'psi' jumps back after 360, not after 2π rad; .*np.deg2rad"
    ):
        HarmonicAnalyzer(azimuth="psi").fit(X)
    whole = X.assign(psi=np.deg2rad(X["psi"]))
    assert HarmonicAnalyzer(azimuth="psi").fit(whole).basis_.omega == pytest.approx(OMEGA)


SPANS = {
    "backwards": (5, 2),
    "empty": (2, 2),
    "nan": (0.0, np.nan),
    "text": "03",
    "texts": ("0", "3"),
    "three": (0, 1, 2),
    "truths": (False, True),
    "number": 4.0,
}


@pytest.mark.parametrize("case", SPANS)
def test_trim_spans(u, case):
    with pytest.raises(
        ValueError, match=r"is not a pair of times; give \(start, stop\) in seconds, sta"
    ):
        analyzer(trim_span=SPANS[case]).fit(u)


def test_trim_spans_are_no_dates(u):
    start = pd.Timestamp("2026-05-01")
    for span in ((start, start + pd.Timedelta("4s")), (pd.Timedelta("1s"), pd.Timedelta("4s"))):
        with pytest.raises(
            ValueError, match=r"of dates, \(start - time_origin\).total_seconds\(\)"
        ):
            analyzer(trim_span=span).fit(u)


def test_a_fold_without_the_trim_names_the_splitter(u, y):
    pipe = chain(analyzer(trim_span=(0.0, 5.0)), MOESPRegressor(order=1))
    with pytest.raises(
        ValueError, match=r"less than one whole period .* PeriodBlockSplit\(..., trim_"
    ):
        cross_val_score(pipe, u, y, cv=KFold(4), error_score="raise")


def test_a_search_says_once_that_rows_jitter(u, y, rng):
    """Python shows a warning once for each text: folds share it, but for a last digit or two."""
    index = u.index + rng.uniform(-0.1, 0.1, len(u)) / SPP
    pipe = chain(analyzer(), MOESPRegressor(order=1))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cross_val_score(pipe, u.set_axis(index), y.set_axis(index), cv=TimeSeriesSplit(5))
    said = [str(w.message) for w in caught if w.category is JitterWarning]
    assert len(said) == 10
    assert len(set(said)) <= 4


# ---- the wrong moment -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "names"),
    [
        (HarmonicAnalyzer(OMEGA), []),
        (MOESPRegressor(), ["system_", "eigenvalues_"]),
        (SpuriousModeReducer(), ["system_", "modes_"]),
        (StructuredMatcher(), ["system_", "theta_", "theta_least_squares_"]),
    ],
)
def test_nothing_is_answered_before_fit(u, step, names):
    for method in ("transform", "predict", "score"):
        if hasattr(step, method):
            args = (u, u) if method == "score" else (u,)
            with pytest.raises(NotFittedError, match="not fitted yet"):
                getattr(step, method)(*args)
    with pytest.raises(NotFittedError, match="not fitted yet"):
        step.get_feature_names_out()
    for name in names:
        with pytest.raises(NotFittedError, match="not fitted yet"):
            getattr(step, name)


def test_a_fit_that_failed_leaves_nothing_fitted(u, y):
    model, analysis = MOESPRegressor(order=40, block_rows=12), analyzer(hop=5)
    for step in (model, analysis):
        with pytest.raises(ValueError, match=r"order=40 exceeds|hop=5 does not divide"):
            step.fit(u, y)
        with pytest.raises(NotFittedError):
            step.transform(u)


@pytest.mark.parametrize("warmup", [-1, 0, "5s", np.nan, True])
def test_warmup_is_checked_at_fit(u, y, warmup):
    message = r"warmup must be a positive number in seconds, got .*; None is five periods"
    with pytest.raises(ValueError, match=message):
        MOESPRegressor(warmup=warmup).fit(u, y)
    for step in (SpuriousModeReducer, StructuredMatcher):
        with pytest.raises(ValueError, match=message):
            step(MOESPRegressor(order=1), warmup=warmup).fit(u, y)


@pytest.mark.parametrize("name", ["feedthrough", "scale", "stable", "disturbance_model"])
@pytest.mark.parametrize("value", ["no", 1, None, 0.5])
def test_switches_are_switches(u, y, name, value):
    allowed = "True, False or 'auto'" if name == "feedthrough" else "True or False"
    with pytest.raises(ValueError, match=rf"{name} must be {allowed}, got {value!r}"):
        MOESPRegressor(**{name: value}).fit(u, y)


# ---- found by the fuzz ------------------------------------------------------------------------


def test_one_row_is_no_record(u, y):
    with pytest.raises(ValueError, match="X has n_samples=1, and one row is no record"):
        analyzer().fit(u[:1], y[:1])


def test_one_row_at_prediction_is_not_said_to_be_far_from_the_next(u, y):
    fitted = chain(HarmonicAnalyzer(OMEGA, reading="sample"), MOESPRegressor(order=1)).fit(u, y)
    with warnings.catch_warnings():
        warnings.simplefilter("error", TimeBaseWarning)
        assert fitted.predict(u[:1]).shape == (1, 1)


def test_a_column_without_values_is_named(u, y):
    with pytest.raises(ValueError, match=r"y has no values in column 'w': all are NaN; drop it"):
        analyzer(missing="gap").fit(u, np.nan * y)


def test_names_of_other_columns_are_refused(u, y):
    fitted = analyzer().fit(u, y)
    assert fitted.get_feature_names_out(["u"]).tolist() == fitted.get_feature_names_out().tolist()
    with pytest.raises(ValueError, match=r"\['other'\] are not those at fit, \['u'\]"):
        fitted.get_feature_names_out(["other"])
    with pytest.warns(TimeBaseWarning, match="rows count as samples"):
        fitted = analyzer(sample_time=1 / SPP).fit(u.to_numpy(), y.to_numpy())
    assert len(fitted.get_feature_names_out(["any"])) == len(fitted.get_feature_names_out())
    with pytest.raises(ValueError, match=r"\[\] are not those at fit, 1 column"):
        fitted.get_feature_names_out([])
    with pytest.raises(
        ValueError, match=r"\['a', 'b'\] are not those at fit, 1 column\(s\); leave"
    ):
        fitted.get_feature_names_out(["a", "b"])


def test_a_first_chunk_of_one_row_tells_no_sample_time(u, y):
    """It was taken for 1 s, and the second chunk refused for having another one."""
    model = MOESPRegressor(order=1, block_rows=5)
    with pytest.raises(ValueError, match=r"no record of the first chunk has two rows .* longer ch"):
        model.partial_fit(u.iloc[:1], y.iloc[:1])
    for rows in (slice(0, 2), slice(2, 3), slice(3, None)):
        model.partial_fit(u.iloc[rows], y.iloc[rows])
    assert model.score(u, y) > 0.999


def test_chunks_of_more_block_rows_than_memory(u, y):
    with pytest.raises(ValueError, match=r"block_rows=1000000 with 2 signals needs sums of 1.3"):
        MOESPRegressor(order=1, block_rows=10**6).partial_fit(u, y)


def test_counts_beyond_32_bits(u, y):
    message = r"order must be a whole number of at most 4294967295, got 1000.*000; 'auto' chooses"
    with pytest.raises(ValueError, match=message):
        MOESPRegressor(order=10**400).fit(u, y)


def test_one_row_has_no_r2(u, y):
    """scikit-learn warned, and NaN came back."""
    model = MOESPRegressor(order=1, block_rows=3, warmup=1 / SPP).fit(u, y)
    with pytest.raises(ValueError, match=r"one row is left to score, which has no R²; give longer"):
        model.score(u.iloc[:2], y.iloc[:2])


def test_numbers_beyond_floats(u, y):
    """Python's whole numbers have no end; floats have."""
    huge = 10**400
    with pytest.raises(ValueError, match=r"X holds values that are not numbers.*too large to conv"):
        MOESPRegressor(order=1).fit(u.astype(object).where(u > -1, huge), y)
    model = MOESPRegressor(order=1).fit(u, y)
    with pytest.raises(
        ValueError, match=r"holds values that are not numbers, or states of different lengths"
    ):
        model.predict(u, x0=[huge])
    with pytest.raises(ValueError, match=r"sample_weight holds values that are not numbers"):
        model.score(u, y, sample_weight=[huge] * len(u))
    with pytest.raises(ValueError, match=r"initial must hold 1 finite numbers, one for each of"):
        MatrixStructure([["a"]], [[1.0]], initial=[huge])


def test_columns_named_by_tuples_are_one_level(u, y):
    """pandas makes two of them, to which the one name of the columns does not fit."""
    for names in (pd.Index([("w", 0)], tupleize_cols=False), pd.MultiIndex.from_tuples([("w", 0)])):
        outputs = y.set_axis(names, axis=1)
        predicted = MOESPRegressor(order=1).fit(u, outputs).predict(u)
        pd.testing.assert_index_equal(predicted.columns, outputs.columns)


def test_a_pipeline_without_outputs_says_so(u):
    pipe = chain(MOESPRegressor(order=1), SpuriousModeReducer())
    with pytest.raises(ValueError, match=r"requires y to be passed, but the target y is None"):
        pipe.fit(u)


def test_sparse_columns_of_outputs_are_predicted_dense(u, y):
    sparse = y.astype(pd.SparseDtype(float, 0.0))
    predicted = MOESPRegressor(order=1).fit(u, sparse).predict(u)
    pd.testing.assert_frame_equal(predicted, MOESPRegressor(order=1).fit(u, y).predict(u))


def test_arrays_that_lie_on_their_side_are_refused(rng):
    u, y = rng.standard_normal((2, 3, 200))
    words = r"has 3 rows and 200 columns, more signals than samples: .* transposed"
    with pytest.raises(ValueError, match="X " + words):
        MOESPRegressor().fit(u, y)
    with pytest.raises(ValueError, match="y " + words):
        MOESPRegressor().fit(np.zeros((3, 1)), y)
    with pytest.raises(ValueError, match="X " + words):
        HarmonicAnalyzer(1.0).fit(u)


# ---- outliers ------------------------------------------------------------------------------------


def turning(n=960, noise=0.01, seed=0):
    """A waveform of a turn that swells and dies, with noise."""
    k = np.arange(n)
    y = np.exp(-(((k - n / 2) / 200.0) ** 2)) * np.sin(0.4 * k) + 0.5 * np.cos(0.2 * k)
    return (y + noise * np.random.default_rng(seed).standard_normal(n))[:, None]


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("size", [-3.0, 1.5])
def test_outliers_are_found_wherever_they_are(noise, size):
    y, rows = turning(noise=noise), [9, 333, 480, 481 + 16]
    y[rows] += size
    assert np.flatnonzero(outliers(y)).tolist() == rows
    np.testing.assert_allclose(outliers(y)[333], abs(size) / y.std(), rtol=0.15)


def test_noise_edges_and_steps_are_no_outliers(rng):
    k = np.arange(2000)
    signals = {
        "noise": rng.standard_normal(2000),
        "heavy tails": rng.standard_t(4, 2000),
        "steps": np.repeat(rng.standard_normal(100), 20),
        "a kink": np.maximum(k - 1000.0, 0.0),
        "quantised": np.round(3.0 * np.sin(0.01 * k)),
        "still": np.zeros(2000),
    }
    found = {name for name, y in signals.items() if outliers(y[:, None]).any()}
    assert not found
    assert not outliers(signals["noise"][:16, None]).any()
    lost = 5.0 + np.sin(0.05 * k)
    lost[[200, 700, 701, 1400]] = np.nan
    assert not outliers(lost[:, None]).any()


def test_outliers_are_named_with_the_way_out(rng):
    """Bridged, they leave the model as it was; those of the input are no one's error."""
    index = pd.Index(np.arange(60 * SPP) / SPP, name="time")
    u = np.repeat(rng.standard_normal(60 * SPP // 8), 8)
    u[500] += 20.0
    y = np.zeros(len(u))
    for k in range(len(u) - 1):
        y[k + 1] = 0.9 * y[k] + 0.1 * u[k]
    y = y + u + 1e-3 * rng.standard_normal(len(u))
    X, clean = pd.DataFrame({"u": u}, index), pd.DataFrame({"w": y}, index)
    spoilt, lost = clean.copy(), clean.copy()
    spoilt.iloc[[203, 700], 0] += [25.0, -30.0]
    lost.iloc[[203, 700], 0] = np.nan
    right = HarmonicAnalyzer(OMEGA).fit(X, clean)
    impacts = 30.0 * (np.arange(len(u)) % SPP == 3)[:, None]
    HarmonicAnalyzer(OMEGA).fit(X, clean + impacts)
    message = (
        r"2 value\(s\) of the outputs \['w'\] stand .* t = 43.75 s, row 700, .*missing=0.125\)"
    )
    with pytest.warns(IdentifiabilityWarning, match=message):
        HarmonicAnalyzer(OMEGA).fit(X, spoilt)
    pipe = Pipeline([("h", HarmonicAnalyzer(OMEGA, missing=0.125)), ("i", MOESPRegressor())])
    found = pipe.fit(X, lost)["i"].model_.exponents()
    assert np.min(np.abs(found - SPP * np.log(0.9))) < 0.02
    assert pipe["h"].basis_.reading == right.basis_.reading


def test_arrays_of_named_fields_are_no_signals():
    fields = pd.DataFrame({"u": np.arange(9.0), "v": 1.0}).to_records()
    with pytest.raises(TypeError, match=r"X is an array of named fields; .* pd.DataFrame\(X\)"):
        analyzer().fit(fields, np.ones(9))


@pytest.mark.parametrize("kept", [2, 3, 4])
def test_rows_lost_so_often_that_no_segment_is_long(kept):
    """Units have nothing to do with it."""
    rotor = make_rotor(n_turns=60, random_state=0)
    some = np.arange(len(rotor.inputs)) % (kept + 1) < kept
    pipe = make_pipeline(HarmonicAnalyzer(rotor.omega, reading="sample"), MOESPRegressor())
    told = pytest.raises(
        ValueError, match=r"\(the \d+ rows fall into \d+ segments: they are 1 sampl"
    )
    with pytest.warns(JitterWarning, match="is missing: if they are rounded"), told:
        pipe.fit(rotor.inputs[some], rotor.outputs[some])
