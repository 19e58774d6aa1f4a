"""Real measurements: dates, rotors whose speed varies, uneven clocks, missing samples."""

import pickle
import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import same_poles
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd._records.data import read_signals, sample
from sklearn_hd.exceptions import JitterWarning

OMEGA = 2 * np.pi * 5  # mean speed, rad/s
SPP = 64
DT = 2 * np.pi / OMEGA / SPP
# few harmonics of a machine that turns unevenly, read at its mean speed, are in doubt, and are
pytestmark = pytest.mark.filterwarnings("ignore:.*exponents")
A = np.array([[-0.08, 0.05, 0.0], [0.0, -0.05, 0.3], [-0.04, -0.3, -0.06]])  # per radian
B = np.array([1.0, 0.3, -0.2])
POLES = np.linalg.eigvals(A)
KEPT = {"w": [0], "v": [1]}
UTC = pd.Timestamp("2026-05-01 12:00", tz="UTC")


def spin_up(n_periods=120, deviation=0.05):
    """Times, and the azimuth of a rotor that speeds up from 95 % to 105 % of its mean speed."""
    t = np.arange(n_periods * SPP) * DT
    return t, OMEGA * (t * (1 - deviation) + deviation * t**2 / (n_periods * SPP * DT))


def response(psi, u):
    """Outputs, exact at every row, of dynamics in azimuth: dx/dψ = A x + B u, u held."""
    values, V = np.linalg.eig(A)
    step = np.exp(np.outer(np.diff(psi), values))
    forced = (step - 1) / values * np.linalg.solve(V, B)
    modes = np.zeros((len(psi), 3), dtype=complex)
    for k in range(len(psi) - 1):
        modes[k + 1] = step[k] * modes[k] + forced[k] * u[k]
    x = (modes @ V.T).real
    return np.column_stack([x[:, 0], x[:, 1] * np.cos(psi) + x[:, 2] * np.sin(psi)])


def multisine(psi, seed=1):
    rng = np.random.default_rng(seed)
    waves = [np.cos(f * psi + rng.uniform(0, 6)) for f in rng.uniform(0.02, 0.4, 12)]
    return np.sum(waves, axis=0) * (psi < 0.8 * psi[-1])


def record(t, psi, index=None):
    """Inputs, with the azimuth beside, and outputs."""
    index = pd.Index(t, name="time") if index is None else index
    u = multisine(psi)
    inputs = pd.DataFrame({"u": u, "psi": psi}, index=index)
    return inputs, pd.DataFrame(response(psi, u), index=index, columns=["w", "v"])


@pytest.fixture(scope="module")
def spun():
    return record(*spin_up())


@pytest.fixture(scope="module")
def steady():
    """At constant speed, without the azimuth."""
    X, y = record(*spin_up(deviation=0.0))
    return X[["u"]], y


def pipeline(n_states=3, **harmonics):
    params = {"output_harmonics": KEPT, "hop": 8} | harmonics
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(**params)),
            ("identify", MOESPRegressor(order=12)),
            ("reduce", SpuriousModeReducer(n_states=n_states)),
        ]
    )


@pytest.fixture(scope="module")
def by_seconds(steady):
    return pipeline(omega=OMEGA).fit(*steady)


@pytest.fixture(scope="module")
def by_azimuth(spun):
    return pipeline(azimuth="psi").fit(*spun)


def pole_error(pipe):
    """Largest error of the poles per turn, beside the largest pole."""
    found = pipe[-1].system_.poles() / pipe[0].basis_.omega
    return np.max(np.min(np.abs(found[:, None] - POLES), axis=0)) / np.max(np.abs(POLES))


def dated(data, origin):
    return data.set_axis(origin + pd.to_timedelta(data.index, unit="s"))


# ---- dates ------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [UTC, UTC.tz_convert("Europe/Rome"), UTC.tz_localize(None)])
@pytest.mark.slow
def test_dates_are_times_since_their_origin(steady, by_seconds, origin):
    X, y = steady
    pipe = pipeline(omega=OMEGA, time_origin=origin).fit(dated(X, origin), dated(y, origin))
    predicted = pipe.predict(dated(X, origin))
    assert isinstance(predicted.index, pd.DatetimeIndex)
    assert predicted.index.equals(dated(y, origin).index)
    np.testing.assert_allclose(predicted, by_seconds.predict(X), atol=1e-5)
    assert same_poles(pipe[-1].system_.poles(), by_seconds[-1].system_.poles(), 1e-6)
    later = dated(X, origin).iloc[1000:3000]  # phase comes from the date, not from the row
    np.testing.assert_allclose(
        pipe["harmonics"].transform(later)["u_0"].iloc[SPP:],
        by_seconds["harmonics"].transform(X)["u_0"].iloc[1000 + SPP : 3000],
        atol=1e-6,
    )


def test_the_origin_says_where_psi_is_zero():
    t = np.arange(10 * SPP) * DT
    u = pd.DataFrame({"u": np.cos(OMEGA * t)}, index=UTC + pd.to_timedelta(t, unit="s"))
    quarter = UTC + pd.Timedelta(SPP // 4 * DT, unit="s")
    frame = HarmonicAnalyzer(OMEGA, input_harmonics=1, time_origin=quarter).fit_transform(u)
    np.testing.assert_allclose(frame[["u_1c", "u_1s"]] - [0.0, -1.0], 0.0, atol=1e-5)


@pytest.mark.slow
def test_dates_as_last_level_beside_the_record(steady):
    X, y = steady
    whole = [pd.concat({"a": dated(d, UTC), "b": dated(d, UTC)}, names=["record"]) for d in (X, y)]
    pipe = pipeline(omega=OMEGA, time_origin=UTC.isoformat()).fit(*whole)
    by_seconds = pipeline(omega=OMEGA).fit(
        *(pd.concat({"a": d, "b": d}, names=["record"]) for d in (X, y))
    )
    assert pipe.predict(whole[0]).index.equals(whole[1].index)
    assert pipe.score(*whole) == pytest.approx(by_seconds.score(*by_record(X, y)), abs=1e-6)


def by_record(*frames):
    return [pd.concat({"a": data, "b": data}, names=["record"]) for data in frames]


def test_plain_data_need_no_origin(steady):
    X, y = steady
    plain = MOESPRegressor(order=3, block_rows=4).fit(X, y[["w"]])
    by_dates = MOESPRegressor(order=3, block_rows=4).fit(dated(X, UTC), dated(y, UTC)[["w"]])
    assert by_dates.system_.dt == pytest.approx(DT, rel=1e-6)
    np.testing.assert_allclose(by_dates.predict(dated(X, UTC)), plain.predict(X), atol=1e-6)
    assert by_dates.predict(dated(X, UTC)).index.equals(dated(y, UTC).index)


# ---- a rotor whose speed varies ---------------------------------------------------------------


@pytest.mark.parametrize("wrapped", [False, True])
def test_coefficients_locked_to_azimuth_are_exact(wrapped):
    """Constant coefficients come back; at the mean speed the phase is lost."""
    t, psi = spin_up()
    u = 2 + np.cos(psi) - 0.5 * np.sin(psi) + 0.3 * np.cos(2 * psi)
    truth = np.array([2, 1, -0.5, 0.3, 0])
    X = pd.DataFrame({"u": u, "psi": psi % (2 * np.pi) if wrapped else psi}, index=t)
    analyzer = HarmonicAnalyzer(azimuth="psi", input_harmonics=2)
    frame = analyzer.fit_transform(X)
    assert frame.columns.tolist() == ["u", "psi", "u_0", "u_1c", "u_1s", "u_2c", "u_2s"]
    assert analyzer.get_feature_names_out().tolist() == frame.columns.tolist()
    assert analyzer.basis_.samples_per_period == SPP
    assert analyzer.basis_.omega == pytest.approx(OMEGA, rel=1e-4)
    assert np.abs(frame.iloc[:, 2:].to_numpy() - truth).max() < 1e-6
    np.testing.assert_allclose(analyzer.inverse_transform(frame)["u"], u, atol=1e-6)
    constant = HarmonicAnalyzer(OMEGA, input_harmonics=2).fit_transform(X[["u"]])
    wrong = np.abs(constant.iloc[:, 1:].to_numpy() - truth).max(axis=0)
    assert wrong[1] > 1.0
    assert wrong.max() > 0.1 * np.abs(truth).max()


@pytest.mark.slow
def test_identification_on_a_spin_up(spun, by_seconds, by_azimuth):
    """As good as at constant speed (4e-5), where analysis at the mean speed misses by a third."""
    X, y = spun
    constant = pipeline(omega=OMEGA).fit(X[["u"]], y)
    assert pole_error(by_seconds) < 1e-4
    assert pole_error(by_azimuth) < 2e-4
    assert pole_error(constant) > 0.1
    assert by_azimuth.score(X, y) > 1 - 1e-5
    assert constant.score(X[["u"]], y) < 0.7
    assert by_azimuth["identify"].system_.input_labels == ["u_0"]


@pytest.mark.slow
def test_predictions_answer_every_row_of_the_user(spun, by_azimuth):
    X, y = spun
    for stop in (2, 3):
        predicted = by_azimuth[:stop].predict(X)
        assert predicted.index.equals(y.index)
        assert np.isfinite(predicted.to_numpy()).all()
    scale = y.std().to_numpy()
    assert np.all(np.abs(predicted - y).max() < 0.02 * scale)
    weight = np.zeros(len(X))
    weight[4000:5000] = 1.0
    assert by_azimuth.score(X, y, sample_weight=weight) > 1 - 1e-4


@pytest.mark.slow
def test_azimuth_survives_clones_pickles_folds_and_records(spun, by_azimuth):
    X, y = spun
    pipe = clone(by_azimuth).fit(X, y)
    again = pickle.loads(pickle.dumps(pipe))
    pd.testing.assert_frame_equal(again.predict(X), pipe.predict(X))
    frame = pickle.loads(pickle.dumps(pipe[:1].transform(X)))
    assert frame.basis.timing.azimuth == "psi"
    search = GridSearchCV(pipe, {"identify__order": [8, 12]}, cv=TimeSeriesSplit(2)).fit(X, y)
    assert np.isfinite(search.cv_results_["mean_test_score"]).all()
    both = by_record(X, y)
    two = pipeline(azimuth="psi").fit(*both)
    assert two.score(*both) == pytest.approx(pipe.score(X, y), abs=1e-5)
    assert two.predict(both[0]).index.equals(both[1].index)


@pytest.mark.slow
def test_even_azimuth_is_the_analysis_at_constant_speed(steady, by_seconds):
    X, y = steady
    X_psi = X.assign(psi=OMEGA * X.index.to_numpy())
    azimuth = pipeline(azimuth="psi").fit(X_psi, y)
    assert azimuth["harmonics"].basis_.samples_per_period == SPP
    np.testing.assert_allclose(azimuth.predict(X_psi), by_seconds.predict(X), atol=1e-6)


@pytest.mark.slow
def test_trim_locked_to_azimuth(spun):
    X, y = spun
    quiet = X.index[-1] * 0.9
    waveform = np.column_stack([3 + np.cos(X["psi"]), np.sin(3 * X["psi"])])
    at_rest = X["psi"] > 0.8 * X["psi"].iloc[-1]
    loud = pd.DataFrame(np.where(at_rest.to_numpy()[:, None], 0.0, y.to_numpy()), y.index)
    raw = (loud + waveform).set_axis(["w", "v"], axis=1)
    pipe = pipeline(azimuth="psi", trim_span=(quiet, X.index[-1])).fit(X, raw)
    trim = pipe["harmonics"].basis_.output_trim
    psi = 2 * np.pi * np.arange(SPP) / SPP
    np.testing.assert_allclose(trim, np.column_stack([3 + np.cos(psi), np.sin(3 * psi)]), atol=1e-5)


@pytest.mark.parametrize("sampling", ["azimuth", "jitter"])
@pytest.mark.slow
def test_units_of_the_signals_do_not_matter(spun, by_azimuth, sampling):
    if sampling == "azimuth":
        (X, y), plain = spun, by_azimuth
    else:
        (X, y), plain = jittered(), pipeline(omega=OMEGA)
    scaled = X.assign(u=1e6 * X["u"]), y * np.array([1e6, 1e-6])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", JitterWarning)
        other = clone(plain).fit(*scaled)
        plain = plain if sampling == "azimuth" else plain.fit(X, y)
    assert other["identify"].order_ == plain["identify"].order_
    assert same_poles(other[-1].system_.poles(), plain[-1].system_.poles(), 1e-6)


# ---- uneven clocks ----------------------------------------------------------------------------


def jittered(size=0.1, seed=0):
    """A record at constant speed whose rows are off an even grid by up to ``size`` samples."""
    t, _ = spin_up()
    t = t + DT * np.random.default_rng(seed).uniform(-size, size, len(t))
    X, y = record(t, OMEGA * t)
    return X[["u"]], y


@pytest.mark.parametrize("size", [0.02, 0.2])
@pytest.mark.slow
def test_jitter_is_resampled_and_said(steady, by_seconds, size):
    X, y = jittered(size)
    said = r"off a grid of 0.003125 s by .* s rms \(.* % of a sample\) and by .* s at most"
    with pytest.warns(JitterWarning, match=said):
        pipe = pipeline(omega=OMEGA).fit(X, y)
    assert pipe["harmonics"].basis_.sample_time == pytest.approx(DT, rel=1e-12)
    with pytest.warns(JitterWarning):
        predicted = pipe.predict(X)
    assert predicted.index.equals(y.index)
    assert np.isfinite(predicted.to_numpy()).all()
    assert pole_error(pipe) < 2e-4
    with pytest.warns(JitterWarning):
        assert pipe.score(X, y) > 1 - 2e-5
    even = by_seconds.predict(steady[0])  # a model from even rows answers for uneven ones
    with pytest.warns(JitterWarning):
        uneven = by_seconds.predict(X)
    at = np.interp(X.index, even.index, even["w"])
    assert np.abs(uneven["w"] - at).iloc[2000:-5].max() < 2e-3 * even["w"].std()


def test_jitter_of_plain_data():
    X, y = jittered()
    with pytest.warns(JitterWarning, match=r"% of a sample"):
        model = MOESPRegressor(order=3, block_rows=4).fit(X, y[["w"]])
    exact = np.exp(POLES * OMEGA * DT)
    assert model.system_.dt == pytest.approx(DT, rel=1e-5)
    assert np.max(np.min(np.abs(model.eigenvalues_[:, None] - exact), axis=0)) < 2e-3
    with pytest.warns(JitterWarning):
        predicted = model.predict(X.iloc[:40])
    assert predicted.index.equals(y.index[:40])


def test_neither_jitter_nor_gap_is_an_error(steady):
    X, _ = steady
    late = X.set_axis(np.where(np.arange(len(X)) < 300, X.index, X.index + 0.5 * DT))
    with pytest.raises(ValueError, match=r"\(row 300\) is 1.5 samples of .* too uneven for jitter"):
        HarmonicAnalyzer(OMEGA).fit(late)
    gap = X.set_axis(np.where(np.arange(len(X)) < 300, X.index, X.index + 7 * DT))
    assert HarmonicAnalyzer(OMEGA).fit_transform(gap).shape == (len(X), 2)


# ---- missing samples --------------------------------------------------------------------------


def spoiled(data, *rows, column=0):
    data = data.copy()
    for some in rows:
        data.iloc[some, column] = np.nan
    return data


@pytest.mark.slow
def test_missing_outputs_become_gaps(steady):
    """As good as without them; nothing of what surrounds them is fitted or scored."""
    X, y = steady
    holed = spoiled(y, slice(1000, 1100), slice(4000, 4001), column=1)
    with pytest.raises(ValueError, match=r"y contains NaN: column 'v', first at t = 3.125 s"):
        pipeline(omega=OMEGA).fit(X, holed)
    pipe = pipeline(omega=OMEGA, missing="gap").fit(X, holed)
    assert pole_error(pipe) < 2e-3
    assert len(pipe["identify"].x0_) == 3
    assert np.isfinite(pipe.predict(X).to_numpy()).all()
    wild = holed.copy()
    wild.iloc[1000:1100, 0] = 1e9  # beside a missing sample of the other output
    other = clone(pipe).fit(X, wild)
    np.testing.assert_array_equal(other[-1].model_.A, pipe[-1].model_.A)
    assert other.score(X, wild) == pipe.score(X, holed)


@pytest.mark.slow
def test_short_runs_are_bridged_on_request(steady):
    X, y = steady
    holed = spoiled(y, slice(1000, 1002), slice(4000, 4100), column=1)
    given = spoiled(X, slice(2500, 2503))
    pipe = pipeline(omega=OMEGA, missing=5 * DT).fit(given, holed)
    assert len(pipe["identify"].x0_) == 2  # one gap: the rest is bridged
    assert pole_error(pipe) < 2e-3
    predicted = pipe.predict(given)
    assert np.isfinite(predicted.to_numpy()).all()
    np.testing.assert_allclose(predicted, pipe.predict(X), atol=2e-2)
    assert pipe.score(given, holed) > 1 - 1e-4


@pytest.mark.slow
def test_no_answer_where_the_input_is_missing(steady):
    X, y = steady
    holed = spoiled(X, slice(1000, 1100))
    pipe = pipeline(omega=OMEGA, missing="gap").fit(holed, y)
    predicted = pipe.predict(holed)
    missing = predicted.isna().any(axis=1).to_numpy()
    assert np.flatnonzero(missing).tolist() == list(range(1000, 1100))
    frame = pipe[:1].transform(holed)
    assert np.flatnonzero(frame["u_0"].isna()).tolist() == list(range(1000, 1100))
    assert pipe.score(holed, y) > 1 - 1e-4
    assert pole_error(pipe) < 2e-3


@pytest.mark.slow
def test_pieces_shorter_than_the_window_are_left_out(steady):
    X, y = steady
    holed = spoiled(X, 1000, 1030)
    predicted = pipeline(omega=OMEGA, missing="gap").fit(holed, y).predict(holed)
    missing = np.flatnonzero(predicted.isna().any(axis=1))
    assert missing.tolist() == list(range(1000, 1031))
    with pytest.raises(ValueError, match=r"needs 64 consecutive row\(s\) without missing samples"):
        pipeline(omega=OMEGA, missing="gap").fit(spoiled(X, slice(None, None, 50)), y)


@pytest.mark.slow
def test_missing_azimuth_and_inputs_on_a_spin_up(spun):
    X, y = spun
    holed = spoiled(spoiled(X, slice(1000, 1003), column=1), slice(3000, 3100))
    holed["psi"] %= 2 * np.pi
    bridged = pipeline(azimuth="psi", missing=5 * DT).fit(holed, y)
    assert pole_error(bridged) < 2e-3
    predicted = bridged.predict(holed)
    assert np.flatnonzero(predicted.isna().any(axis=1)).tolist() == list(range(3000, 3100))


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.JitterWarning")
@pytest.mark.parametrize("sampling", ["azimuth", "jitter", "record"])
def test_a_jump_beyond_a_border_moves_nothing(spun, sampling):
    """Uneven rows: no spline and no window reaches across a gap or into the next record."""
    X = jittered()[0] if sampling == "jitter" else spun[0]
    params = {"omega": OMEGA} if sampling == "jitter" else {"azimuth": "psi"}
    if sampling == "record":
        (X,) = by_record(X)
    else:
        X = X.iloc[np.r_[0:2000, 2100 : len(X)]].copy()
    border = len(X) // 2 if sampling == "record" else 2000
    other = X.copy()
    other.iloc[border:, 0] += 1e9
    analyzer = HarmonicAnalyzer(**params, input_harmonics=1)
    before, after = analyzer.fit_transform(X), analyzer.fit_transform(other)
    np.testing.assert_array_equal(before.iloc[:border], after.iloc[:border])


def test_even_rows_pass_unchanged(steady, rng):
    """Bit by bit: whatever rule for missing samples and whatever gaps there are."""
    X, _ = steady
    X = X.assign(u=rng.standard_normal(len(X))).drop(X.index[1000:1100])
    frame = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit_transform(X)
    rows = np.delete(np.arange(len(X)), slice(1000, 1000 + SPP - 1))  # whole windows only
    values = X["u"].to_numpy()
    means = np.lib.stride_tricks.sliding_window_view(values, SPP).mean(axis=1)
    inside = rows[rows >= SPP - 1]
    np.testing.assert_allclose(frame["u_0"].to_numpy()[inside], means[inside - SPP + 1], atol=1e-14)
    for missing in ("gap", 5 * DT):
        again = HarmonicAnalyzer(OMEGA, input_harmonics=1, missing=missing).fit_transform(X)
        np.testing.assert_array_equal(again, frame)
        assert again.basis.timing.missing == missing
    sampling, inputs, _ = sample(read_signals(X, frame.basis.timing), frame.basis)
    assert all(piece.is_grid for piece in sampling.pieces)
    np.testing.assert_array_equal(np.vstack(inputs), X)
    np.testing.assert_array_equal(sampling.back(inputs), X)


@pytest.mark.parametrize(
    ("rows", "samples"), [({"hop": 7}, 70), ({"hop": 8}, 72), ({"reading": "period"}, 67)]
)
def test_the_grid_in_azimuth_suits_the_hop(rows, samples):
    """66.5 samples a turn are measured; the grid has as many or more, and whole hops."""
    psi = np.arange(40 * SPP) * 2 * np.pi / 66.5
    X = pd.DataFrame({"u": np.cos(psi), "psi": psi}, index=np.arange(len(psi)) * DT)
    analyzer = HarmonicAnalyzer(azimuth="psi", input_harmonics=1, **rows)
    frame = analyzer.fit_transform(X)
    assert analyzer.basis_.samples_per_period == samples
    np.testing.assert_allclose(frame[["u_0", "u_1c", "u_1s"]] - [0.0, 1.0, 0.0], 0.0, atol=1e-6)
    with pytest.raises(ValueError, match=r"hop=80 does not divide the 67 samples of a period"):
        HarmonicAnalyzer(azimuth="psi", hop=80).fit(X)
