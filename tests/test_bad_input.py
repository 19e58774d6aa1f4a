"""Wrong uses end in an error that names what was given, what is allowed and the way out."""

import numpy as np
import pandas as pd
import pytest
from sklearn.compose import ColumnTransformer
from sklearn.metrics import mean_squared_error
from sklearn.pipeline import FeatureUnion, Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.exceptions import (
    ExcitationWarning,
    FrequencyMismatchWarning,
    InstabilityWarning,
    UnstableModelError,
)
from sklearn_hd.model_selection import fit_percent_scorer, simulation_scorer

OMEGA = 2 * np.pi
SPP = 16


@pytest.fixture
def u():
    """Sixty periods of a doublet, held over whole periods."""
    time = pd.Index(np.arange(60 * SPP) / SPP, name="time")
    values = np.zeros(len(time))
    values[10 * SPP : 15 * SPP], values[15 * SPP : 20 * SPP] = 1.0, -1.0
    return pd.DataFrame({"u": values}, index=time)


@pytest.fixture
def y(u):
    """A slow first-order lag, modulated once a period."""
    lag = np.zeros(len(u))
    for k in range(len(u) - 1):
        lag[k + 1] = 0.99 * lag[k] + u.iloc[k, 0]
    psi = OMEGA * u.index.to_numpy()
    return pd.DataFrame({"w": lag, "v": lag * np.cos(psi)}, index=u.index)


def analyze(u, y=None, **kwargs):
    params = {"omega": OMEGA, "output_harmonics": {"w": [0], "v": [1]}, "hop": 4} | kwargs
    return HarmonicAnalyzer(**params).fit(u, y)


def identify(u, y, analyzer=None, **kwargs):
    steps = [("harmonics", HarmonicAnalyzer(OMEGA, output_harmonics={"w": [0], "v": [1]}, hop=4))]
    return Pipeline([*steps, ("identify", MOESPRegressor(**kwargs))]).fit(u, y)


def spoil(frame, row, column, value):
    frame = frame.copy()
    frame.iloc[row, column] = value
    return frame


ANALYZER = {
    "zero omega": ({"omega": 0.0}, r"omega must be a positive number in rad/s, got 0.0; it is 2π"),
    "negative omega": ({"omega": -1.0}, r"omega must be a positive number in rad/s, got -1.0"),
    "nan omega": ({"omega": np.nan}, r"omega must be a positive number in rad/s, got nan"),
    "text omega": ({"omega": "fast"}, r"omega must be a positive number in rad/s, got 'fast'"),
    "true omega": ({"omega": True}, r"omega must be a positive number in rad/s, got True"),
    "tiny omega": (
        {"omega": 1e-9},
        r"omega=1e-09 rad/s .* samples a period, more than 1e\+07, .*; correct omega \(rad/s\)",
    ),
    "sampling": (
        {"input_harmonics": 9},
        r"give 16 samples a period, too few for harmonic 9: .*\(here 18\); .* sample faster",
    ),
    "window": ({"window": "hamming"}, r"window='hamming' is not known; use one of 'boxcar'"),
    "hop": ({"hop": 5}, r"hop=5 does not divide the 16 samples of a period; use one of \[1, 2, 4"),
    "hop text": ({"hop": "beat"}, r"hop='beat' with reading='auto': a hop is a number of samp"),
    "hop by periods": ({"hop": 4, "reading": "period"}, r"hop=4 with .*; leave hop=None"),
    "reading": ({"reading": "beat"}, r"reading='beat' is not known; use one of 'auto', 'sliding'"),
    "hop zero": ({"hop": 0}, r"hop=0 does not divide"),
    "unknown input": (
        {"input_harmonics": {"x": 0}},
        r"input_harmonics names the signal 'x', which is not among \['u'\]",
    ),
    "unknown output": (
        {"output_harmonics": {"w": [0], "v": [1], "q": [1]}},
        r"output_harmonics names the signal 'q', which is not among \['w', 'v'\]",
    ),
    "output left out": (
        {"output_harmonics": {"w": [0]}},
        r"output_harmonics gives no harmonics for the signal 'v'; add them, or drop",
    ),
    "negative harmonic": ({"input_harmonics": -1}, r"input_harmonics=-1 is negative; use 0"),
    "half a harmonic": ({"input_harmonics": 0.5}, r"input_harmonics=0.5 is not understood; give"),
    "harmonic twice": (
        {"input_harmonics": {"u": [1, 1]}},
        r"harmonics of 'u' are \[1, 1\]; give distinct whole numbers",
    ),
    "no harmonic": ({"input_harmonics": {"u": []}}, r"harmonics of 'u' are \[\]; give distinct"),
    "trim span": ({"trim_span": 3.0}, r"trim_span=3.0 is not a pair of times"),
    "short trim span": (
        {"trim_span": (0, 0.5)},
        r"trim_span=\(0, 0.5\) holds less than one whole period \(1 s\) of any record; widen it",
    ),
    "sample time": (
        {"sample_time": 0.1},
        r"sample_time=0.1 s, but the rows of the index are 0.0625 s apart; leave sample_time",
    ),
    "no omega": (
        {"omega": None},
        r"omega=None and azimuth=None leave the period unknown; give omega in rad/s, or azimuth",
    ),
    "omega and azimuth": (
        {"azimuth": "psi"},
        r"omega=6.28.* and azimuth='psi' are both given; keep omega for a constant speed",
    ),
    "azimuth elsewhere": (
        {"omega": None, "azimuth": "psi"},
        r"azimuth='psi' is not among the columns \['u'\] of X; name the column",
    ),
    "azimuth alone": (
        {"omega": None, "azimuth": "u"},
        r"X holds only the azimuth 'u'; give the inputs beside it",
    ),
    "azimuth no name": (
        {"omega": None, "azimuth": 3},
        r"azimuth=3 is not a name; give the name of the column of X that holds ψ in rad",
    ),
    "missing": ({"missing": "drop"}, r"missing must be a positive number in seconds, got 'drop'"),
    "missing nothing": (
        {"missing": 0},
        r"missing must be a positive number in seconds, got 0; it is the longest run of NaN to",
    ),
    "origin of seconds": (
        {"time_origin": "2026-01-01"},
        r"time_origin=2026-01-01T00:00:00 is given, but the index has dtype float64, which holds",
    ),
    "origin no date": (
        {"time_origin": "noon-ish"},
        r"time_origin='noon-ish' is not understood; give the instant of ψ = 0 as a date",
    ),
    "origin a number": ({"time_origin": 3.0}, r"time_origin=3.0 is not understood; give the"),
    "negative sample time": (
        {"sample_time": -1},
        r"sample_time must be a positive number in seconds, got -1; None reads it",
    ),
}


@pytest.mark.parametrize("case", ANALYZER)
def test_analyzer_parameters(u, y, case):
    params, message = ANALYZER[case]
    with pytest.raises(ValueError, match=message):
        analyze(u, y, **params)


DATA = {
    "nan": (
        lambda u: spoil(u, 37, 0, np.nan),
        r"X contains NaN: column 'u', first at t = 2.3125 s",
    ),
    "infinity": (lambda u: spoil(u, 5, 0, np.inf), r"X contains infinity: column 'u', .*\(row 5\)"),
    "unsorted": (
        lambda u: u.iloc[[0, 2, 1, *range(3, len(u))]],
        r"t = 0.0625 s \(row 2\) is smaller than the one before it; sort the rows",
    ),
    "duplicate": (
        lambda u: u.iloc[[0, 1, 1, *range(2, len(u))]],
        r"t = 0.0625 s \(row 2\) is repeated; sort the rows, drop duplicates",
    ),
    "dates": (
        lambda u: u.set_axis(pd.Timestamp("2026-01-01") + pd.to_timedelta(u.index, unit="s")),
        r"the index holds dates, which do not define the azimuth; give the "
        r"instant of ψ = 0 as time_origin",
    ),
    "text index": (
        lambda u: u.set_axis([f"row{i}" for i in range(len(u))]),
        r"the index has dtype .*, which is not a time; use seconds \(float\)",
    ),
    "nan in the index": (
        lambda u: u.set_axis([np.nan, *u.index[1:]]),
        r"the time index contains NaN or infinity; drop those rows",
    ),
    "complex": (lambda u: u * 1j, r"X is complex; give real and imaginary parts as columns"),
    "text": (
        lambda u: u.astype(object).replace(0.0, "rest"),
        r"X holds values that are not numbers",
    ),
    "column twice": (
        lambda u: pd.concat([u, u], axis=1),
        r"column 'u' appears more than once; give each signal a name of its own",
    ),
    "no rows": (lambda u: u.iloc[:0], r"X has no rows: 0 sample\(s\)"),
    "three dimensions": (lambda u: np.zeros((4, 3, 2)), r"X has 3 dimensions; give"),
}


@pytest.mark.parametrize("case", DATA)
def test_analyzer_data(u, case):
    change, message = DATA[case]
    with pytest.raises(ValueError, match=message):
        HarmonicAnalyzer(OMEGA).fit(change(u))


SPUN = {
    "stands still": (
        lambda psi: np.where(np.arange(len(psi)) == 40, psi[39], psi),
        r"azimuth column 'psi' must increase with time, but does not at t = 2.5 s, where ψ = 15.3",
    ),
    "turns back": (lambda psi: -psi, r"must increase with time, .* \(if ψ always decreases"),
    "degrees": (np.rad2deg, r"'psi' grows by up to 22.5 rad .*; give it in radians, not degrees"),
    "wrapped degrees": (lambda psi: np.rad2deg(psi) % 360, r"azimuth column 'psi' "),
    "nan": (
        lambda psi: np.where(psi > 3.0, np.nan, psi),
        r"X contains NaN: column 'psi', first at t = 0.5 s",
    ),
}


@pytest.mark.parametrize("case", SPUN)
def test_azimuth_column(u, case):
    change, message = SPUN[case]
    X = u.assign(psi=change(OMEGA * u.index.to_numpy()))
    with pytest.raises(ValueError, match=message):
        HarmonicAnalyzer(azimuth="psi").fit(X)


@pytest.mark.parametrize(("unit", "scale"), [("degrees", 180.0 / np.pi), ("turns", 0.5 / np.pi)])
def test_an_azimuth_in_another_unit_is_told_by_the_orbit(unit, scale):
    psi = 2.0 * np.pi * np.arange(12_000) / 150
    rng = np.random.default_rng(3)
    y = pd.DataFrame({"flap": np.cos(psi) + 0.3 * np.sin(2.0 * psi)}) + 0.3 * rng.standard_normal(
        (12_000, 1)
    )
    index = pd.Index(0.01 * np.arange(12_000), name="time")
    inputs = rng.standard_normal(12_000)
    analyzer = HarmonicAnalyzer(azimuth="psi", reading="sample")
    analyzer.fit(pd.DataFrame({"u": inputs, "psi": psi}, index), y.set_index(index))  # no warning
    X = pd.DataFrame({"u": inputs, "psi": scale * psi}, index)
    message = rf"column 'psi' if that is in {unit} \(79.99 turns in the record\), .* give radians"
    with pytest.warns(FrequencyMismatchWarning, match=message):
        analyzer.fit(X, y.set_index(index))


def test_azimuth_sampled_too_slowly(u):
    X = u.assign(psi=OMEGA * u.index.to_numpy())
    message = r"azimuth column 'psi' shows 16 samples a turn in the mean, too few for harmonic 9"
    with pytest.raises(ValueError, match=message):
        HarmonicAnalyzer(azimuth="psi", input_harmonics=9).fit(X)
    with pytest.raises(ValueError, match=r"'psi' shows no motion: no segment has two rows"):
        HarmonicAnalyzer(azimuth="psi").fit(X.iloc[:1])
    analyzer = HarmonicAnalyzer(azimuth="psi", input_harmonics=1).fit(X)
    frame = pd.DataFrame(analyzer.transform(X).drop(columns="psi"))
    with pytest.raises(ValueError, match=r"X lacks the azimuth column 'psi'; give a frame as"):
        analyzer.inverse_transform(frame)


def test_clocks_and_zones(u):
    stamps = pd.Timestamp("2026-01-01") + pd.to_timedelta(u.index, unit="s")
    analyzer = HarmonicAnalyzer(OMEGA, time_origin="2026-01-01 00:00+01:00")
    with pytest.raises(ValueError, match=r"the time_origin has a time zone but the index has none"):
        analyzer.fit(u.set_axis(stamps))
    analyzer = HarmonicAnalyzer(OMEGA, time_origin="2026-01-01")
    with pytest.raises(ValueError, match=r"the index has a time zone but the time_origin has none"):
        analyzer.fit(u.set_axis(stamps.tz_localize("UTC")))
    wild = u.set_axis(u.index + 0.03 * (np.arange(len(u)) % 2))
    with pytest.raises(ValueError, match=r"samples of .* s: too uneven for jitter \(0.6 to 1.4"):
        HarmonicAnalyzer(OMEGA).fit(wild)


def test_outputs_are_checked_like_inputs(u, y):
    with pytest.raises(
        ValueError, match=r"y contains NaN: column 'v', first at t = 0.5 s \(row 8\)"
    ):
        analyze(u, spoil(y, 8, 1, np.nan))
    with pytest.raises(ValueError, match=r"X has 960 rows and y has 959"):
        analyze(u, y.iloc[1:])
    with pytest.raises(ValueError, match=r"X and y have different indices: .* align them first"):
        analyze(u, y.set_axis(y.index + 1.0))
    with pytest.raises(ValueError, match=r"differ by 1e-09 s at most: use y.set_axis\(X.index\)"):
        analyze(u, y.set_axis(y.index + 1e-9))
    frame = analyze(u, y).transform(u)
    with pytest.raises(ValueError, match=r"X and y have different indices"):
        MOESPRegressor().fit(frame, y.set_axis(y.index + 1.0))
    with pytest.raises(
        ValueError, match=r"y has 1 columns, but the harmonic basis was fitted with 2"
    ):
        MOESPRegressor().fit(frame, y[["w"]])
    with pytest.raises(ValueError, match=r"requires y to be passed, but the target y is None"):
        MOESPRegressor().fit(frame, None)


def test_transform_wants_the_columns_of_fit(u, y):
    analyzer = analyze(u, y)
    with pytest.raises(ValueError, match=r"feature names should match those"):
        analyzer.transform(u.rename(columns={"u": "x"}))
    with pytest.raises(ValueError, match=r"Feature names unseen at fit time:\n- more"):
        analyzer.transform(u.assign(more=1.0))
    with pytest.raises(ValueError, match=r"X has 2 features, but MOESPRegressor is expecting 1"):
        MOESPRegressor().fit(u.to_numpy(), y.to_numpy()).predict(np.zeros((64, 2)))
    with pytest.raises(ValueError, match=r"shortest segment has 10 rows, less than the 16 of the"):
        analyzer.transform(u.iloc[:10])


MOESP = {
    "order": ({"order": 0}, r"order must be a whole number of at least 1, got 0; 'auto' chooses"),
    "order text": ({"order": "many"}, r"order='many' is not known; give a whole number or 'auto'"),
    "order above the bound": (
        {"order": 24, "block_rows": 8},
        r"order=24 exceeds the rank bound 21 of block_rows=8 with 3 output columns; lower",
    ),
    "order far above": (
        {"order": 10**6, "block_rows": 8},
        r"order=1000000 exceeds the rank bound 21 of block_rows=8 with 3 output columns",
    ),
    "several orders": (
        {"order": np.array([1, 2])},
        r"order must be a whole number of at least 1, got array\(\[1, 2\]\); 'auto' chooses it",
    ),
    "block rows": (
        {"block_rows": 1.5},
        r"block_rows must be a whole number of at least 2, got 1.5",
    ),
    "block rows within the window": (
        {"block_rows": 5},
        r"block_rows=5 must exceed the 4 rows in the analysis window plus one, .* use block_rows=6",
    ),
    "short record": (
        {"block_rows": 90},
        r"give 236 row\(s\) .* too few for block_rows=90: at least 271 consecutive rows are needed",
    ),
}


@pytest.mark.parametrize("case", MOESP)
def test_identification_parameters(u, y, case):
    params, message = MOESP[case]
    with pytest.raises(ValueError, match=message):
        identify(u, y, **params)


def test_inputs_must_move(u, y):
    for still in (u * 0.0, u * 0.0 + 3.0):
        with pytest.raises(ValueError, match=r"input 'u' is constant in the rows from t = 0 s to"):
            identify(still, y)


def test_poor_excitation_is_said_with_both_ranks(u, y):
    sine = pd.DataFrame({"u": np.sin(0.3 * np.arange(len(u)))}, index=u.index)
    with pytest.warns(
        ExcitationWarning, match=r"excite 2 directions, but block_rows=6 .* needs 12"
    ):
        MOESPRegressor(order=1, block_rows=6).fit(sine, y[["w"]])


def test_a_model_is_needed_before_the_later_steps(u, y):
    frame = analyze(u, y).transform(u)
    for step in (SpuriousModeReducer(), StructuredMatcher()):
        with pytest.raises(ValueError, match=rf"{type(step).__name__} found no model on X"):
            step.fit(frame, y)


def test_reducer_parameters(u, y):
    base = identify(u, y, order=6)
    frame = base.transform(u)
    with pytest.raises(ValueError, match=r"method='drop' is not known; use one of 'truncate'"):
        SpuriousModeReducer(method="drop").fit(frame, y)
    with pytest.raises(ValueError, match=r"n_states must be a whole number of at least 1, got 0"):
        SpuriousModeReducer(n_states=0).fit(frame, y)
    with pytest.raises(ValueError, match=r"n_states=9 cannot be kept: .* raise the order"):
        SpuriousModeReducer(n_states=9).fit(frame, y)


STRUCTURES = {
    "no structure": ({"structure": 3}, r"structure=3 is not understood; give a MatrixStructure"),
    "inputs": (
        {"structure": MatrixStructure([[np.nan]], [[1, 2]])},
        r"the structure has 2 inputs, but the identified model has 1: \['u_0'\]",
    ),
    "outputs": (
        {"structure": MatrixStructure([[np.nan]], [[1]])},
        r"the structure has 1 outputs, but the identified model has 3: \['w_0', 'v_1c', 'v_1s'\]",
    ),
    "names": (
        {
            "structure": MatrixStructure(
                np.full((3, 3), np.nan), np.full((3, 1), np.nan), output_names=["a", "b", "c"]
            )
        },
        r"its outputs \['a', 'b', 'c'\], but the identified model has \['w_0', 'v_1c', 'v_1s'\]",
    ),
    "seed": ({"random_state": "x"}, r"random_state must be a whole number of at least 0, got 'x'"),
    "iterations": ({"max_iter": 0}, r"max_iter must be a whole number of at least 1, got 0"),
}


@pytest.mark.parametrize("case", STRUCTURES)
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_matcher_parameters(u, y, case):
    params, message = STRUCTURES[case]
    base = Pipeline([*identify(u, y, order=6).steps, ("reduce", SpuriousModeReducer())]).fit(u, y)
    with pytest.raises(ValueError, match=message):
        StructuredMatcher(**params).fit(base.transform(u), y)


def test_a_lost_basis_is_recognised(u, y):
    frame = analyze(u, y, input_harmonics=1).transform(u)
    lost = pd.DataFrame(pd.concat([pd.DataFrame(frame), pd.DataFrame({"more": u["u"]})], axis=1))
    with pytest.raises(
        ValueError, match=r"carries no harmonic basis: a step between .* dropped it"
    ):
        MOESPRegressor().fit(lost, y)
    names = ["theta_0", "theta_1c"]  # a helicopter's controls: such names alone are no crime
    noise = np.random.default_rng(0).standard_normal((len(u), 2))
    controls = pd.DataFrame(noise, index=u.index, columns=names)
    assert MOESPRegressor(order=1).fit(controls, y).system_.input_labels == names


def test_warmup_and_rows_to_score(u, y):
    with pytest.raises(ValueError, match=r"warmup must be a positive number in seconds, got -1"):
        identify(u, y, order=6, warmup=-1)
    with pytest.raises(ValueError, match=r"no rows are left to score in rows from t = 0 s"):
        identify(u, y, order=6).score(u.iloc[:17], y.iloc[:17])


def test_another_analyzer_than_at_fit(u, y):
    pipe = identify(u, y, order=6)
    with pytest.raises(ValueError, match=r"Feature names unseen at fit time:\n- u_1c"):
        pipe["identify"].predict(analyze(u, y, input_harmonics=1).transform(u))
    with pytest.raises(
        ValueError, match=r"X was analysed with hop=8, but the data at fit with 4; use"
    ):
        pipe["identify"].predict(analyze(u, y, hop=8).transform(u))
    plain = pd.DataFrame(0.0, index=u.index, columns=["u", "u_0"])
    with pytest.raises(ValueError, match=r"carries no harmonic basis"):
        pipe["identify"].predict(plain)


@pytest.mark.filterwarnings("ignore:. of 2 exponents are in doubt")
def test_raw_signals_are_not_what_was_analysed_at_fit(u, y):
    frame = HarmonicAnalyzer(OMEGA, reading="sample").fit_transform(u, y)
    model = MOESPRegressor(order=2).fit(frame, y)
    for call in (model.predict_ahead, model.initial_state):
        with pytest.raises(ValueError, match=r"give what .* makes of X: pipe\[:-1\].transform"):
            call(u, y)


def test_sample_time_of_plain_data_must_not_change(u, y):
    model = MOESPRegressor(order=1).fit(u, y[["w"]])
    with pytest.raises(
        ValueError, match=r"identified at a sample time of 0.0625 s, but X has 0.125 s"
    ):
        model.predict(u.iloc[::2])


def test_unfitted_use(u):
    for step in (
        HarmonicAnalyzer(OMEGA), MOESPRegressor(), SpuriousModeReducer(), StructuredMatcher()
    ):  # fmt: skip
        with pytest.raises(ValueError, match="not fitted yet"):
            step.transform(u)


def test_outputs_must_answer(u, y):
    with pytest.raises(ValueError, match=r"all outputs are zero in the rows from t = 0 s .* check"):
        identify(u, y * 0.0)


def test_too_few_rows_a_period_fold_the_copies_onto_the_modes(u, y):
    analyzer = HarmonicAnalyzer(OMEGA, output_harmonics={"w": [0], "v": [1]}, hop=8)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())])
    with pytest.raises(ValueError, match=r"hop=8 reads 2 rows per period, too few for harmonic 1"):
        pipe.fit(u, y)


def test_an_overflowing_simulation_is_refused_and_scores_minus_infinity():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((60, 1))
    y = np.zeros(60)
    for k in range(59):
        y[k + 1] = 1.5 * y[k] + u[k, 0]
    with pytest.warns(
        InstabilityWarning, match=r"size 1.5, so the model grows by a factor of 3.68e\+10"
    ):
        model = MOESPRegressor(order=1, block_rows=3).fit(u, y)
    assert model.eigenvalues_[0].real == pytest.approx(1.5, abs=1e-6)
    with pytest.raises(UnstableModelError, match=r"overflows: the model has a pole of size 1.5"):
        model.predict(np.ones((5000, 1)))
    grown = int(90 / np.log10(1.5))  # outputs reach 1e90, R² -1e180, whose squares overflow
    for rows in (grown, 5000):
        X, noise = np.ones((rows, 1)), rng.standard_normal((rows, 1))
        scorers = (
            simulation_scorer(mean_squared_error, greater_is_better=False),
            fit_percent_scorer(),
        )
        for score in (MOESPRegressor.score, *scorers):
            with pytest.warns(
                InstabilityWarning, match="scores -inf: its model is unstable, or was"
            ):
                assert score(model, X, noise) == -np.inf
        with pytest.warns(InstabilityWarning, match=r"beyond 1e\+60 times the outputs; drop"):
            assert model.score(X, noise * 1e-300) == -np.inf
    with pytest.raises(ValueError, match="sample_weight has shape \\(3,\\); give one finite"):
        model.score(X[:grown], noise[:grown], sample_weight=np.ones(3))
    rows = int(58 / np.log10(1.5))
    assert np.isfinite(np.std([1.0, model.score(X[:rows], noise[:rows])]))


def test_frames_of_other_libraries_are_refused():
    class Frame:
        __dataframe__ = None

    with pytest.raises(TypeError, match="has no index of times; give a pandas DataFrame"):
        HarmonicAnalyzer(OMEGA).fit(Frame())


def test_a_step_that_changes_the_columns(u, y):
    frame = analyze(u, y).transform(u)
    for changed, what in (
        (frame.drop(columns="u"), "has dropped 'u'"),
        (frame.drop(columns="u_0"), "has dropped 'u_0'"),
        (frame.assign(z=1.0), "has added 'z'"),
    ):
        with pytest.raises(ValueError, match=rf"a step between .* {what}; .*before"):
            MOESPRegressor().fit(changed, y)


def test_unions_of_the_analyzer_are_refused(u, y):
    """They concatenate, which keeps the frame's type but not what rides on it."""
    columns = ColumnTransformer([("h", HarmonicAnalyzer(OMEGA, output_harmonics=0), ["u"])])
    union = FeatureUnion([("h", HarmonicAnalyzer(OMEGA, output_harmonics=0))])
    for step in (columns, union):
        pipe = Pipeline([("h", step.set_output(transform="pandas")), ("i", MOESPRegressor())])
        with pytest.raises(ValueError, match=r"appears beside its own coefficients .* dropped it"):
            pipe.fit(u, y)


def test_a_lost_basis_is_recognised_with_harmonic_0_alone(u, y):
    with pytest.raises(ValueError, match=r"column 'u' appears beside its own coefficients"):
        MOESPRegressor().fit(pd.DataFrame(analyze(u, y).transform(u)), y)


def test_steps_in_the_wrong_order(u, y):
    analyzer = HarmonicAnalyzer(OMEGA, output_harmonics=0, hop=4)
    for chain in ([analyzer, analyzer], [MOESPRegressor(order=1), analyzer]):
        pipe = Pipeline([(f"step{k}", step) for k, step in enumerate(chain)])
        with pytest.raises(ValueError, match=r"X comes from a HarmonicAnalyzer or a model"):
            pipe.fit(u, y[["w"]])


def test_estimators_that_make_no_model(u, y):
    for estimator in (HarmonicAnalyzer(OMEGA), "x", MOESPRegressor):
        for step in (SpuriousModeReducer, StructuredMatcher):
            with pytest.raises(ValueError, match=r"estimator=.* does not make a model; give a"):
                step(estimator).fit(u, y)


def test_weights_targets_and_initial_states(u, y):
    model = MOESPRegressor(order=1).fit(u, y[["w"]])
    with pytest.raises(ValueError, match="the target y is None"):
        model.score(u, None)
    for weight in (np.ones(5), 2.0, -np.ones(len(u)), np.full(len(u), np.nan)):
        with pytest.raises(ValueError, match=r"sample_weight has shape .* each of the 960 rows"):
            model.score(u, y[["w"]], sample_weight=weight)
    with pytest.raises(ValueError, match="sample_weight holds values that are not numbers"):
        model.score(u, y[["w"]], sample_weight=["a"] * len(u))
    with pytest.raises(ValueError, match=r"sample_weight is zero on all \d+ rows that are scored"):
        model.score(u, y[["w"]], sample_weight=np.arange(len(u)) < 5)
    with pytest.raises(ValueError, match="sample_weight holds values that are not numbers"):
        fit_percent_scorer()(model, u, y[["w"]], sample_weight=["a"] * len(u))
    for x0 in ("abc", [[1.0], [1.0, 2.0]]):
        with pytest.raises(
            ValueError, match=r"holds values that are not numbers, or states of different lengths"
        ):
            model.predict(u, x0=x0)
    with pytest.raises(ValueError, match="x0 contains NaN or infinity"):
        model.predict(u, x0=[np.nan])
