"""HarmonicAnalyzer(reading="auto"): inputs that rest are read by periods, others by samples."""

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone
from sklearn.pipeline import make_pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._identify import _is_surer
from sklearn_hd._identify.stages import SubspaceFit
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning, TimeBaseWarning
from sklearn_hd.systems import LTPSystem

OMEGA = 2.0 * np.pi
SPP = 16


def answer(u, psi):
    """A slow lag that drives itself once a period."""
    y = np.zeros(len(u))
    for k in range(len(u) - 1):
        y[k + 1] = 0.97 * y[k] + 0.1 * (1.0 + 0.3 * np.cos(psi[k])) * u[k]
    return y


def record(moves=False, n_turns=60, samples=SPP, index=None):
    t = np.arange(int(n_turns * samples)) / samples
    u = 1.0 * ((t >= 5) & (t < 7)) - ((t >= 7) & (t < 9))
    if moves:
        u = np.repeat(np.random.default_rng(0).standard_normal(len(t)), 5)[: len(t)]
    index = pd.Index(t, name="time") if index is None else index(t)
    y = answer(u, OMEGA * t)
    return pd.DataFrame({"u": u}, index), pd.DataFrame({"y": y}, index)


def reading(X, y, **params):
    return HarmonicAnalyzer(**{"omega": OMEGA} | params).fit(X, y).basis_.reading


@pytest.mark.parametrize(("moves", "expected"), [(False, "period"), (True, "sample")])
@pytest.mark.parametrize(
    ("index", "params"),
    [
        (pd.Index, {}),
        (lambda t: pd.Index(1.7e9 + t), {}),
        (lambda t: pd.to_timedelta(t, unit="s"), {}),
        (lambda t: pd.Timestamp("2026-01-01") + pd.to_timedelta(t, unit="s"),
         {"time_origin": "2026-01-01"}),
        (lambda t: pd.Timestamp("2026-01-01") + pd.to_timedelta(t, unit="s"),
         {"time_origin": "1970-01-01"}),
        (lambda t: pd.Index(t + 0.1 / SPP * np.sin(7.0 * t)), {}),
    ],
    ids=["seconds", "unix", "timedelta", "dates", "far origin", "jitter"],
)  # fmt: skip
def test_the_clock_of_the_index_does_not_matter(moves, expected, index, params):
    assert reading(*record(moves, index=index), **params) == expected


@pytest.mark.parametrize(("moves", "expected"), [(False, "period"), (True, "sample")])
def test_arrays_are_read_as_frames_are(moves, expected):
    X, y = record(moves)
    with pytest.warns(TimeBaseWarning, match="rows count as samples"):
        assert reading(X.to_numpy(), y.to_numpy().ravel(), sample_time=1 / SPP) == expected


@pytest.mark.parametrize(("moves", "expected"), [(False, "period"), (True, "sample")])
def test_missing_samples_and_gaps_do_not_matter(moves, expected):
    X, y = record(moves, n_turns=200)
    holes = np.random.default_rng(1).integers(0, len(X), 20)
    X.iloc[holes] = np.nan
    assert reading(X, y, missing="gap") == reading(X, y, missing=0.1) == expected
    kept = np.ones(len(X), dtype=bool)
    kept[400:900] = False
    X, y = record(moves, n_turns=200)
    assert reading(X[kept], y[kept]) == expected
    X[~kept] = np.nan
    y.iloc[50] = np.nan
    assert reading(X, y, missing="gap") == expected


def test_samples_are_read_if_missing_ones_leave_no_two_turns():
    X, y = record(n_turns=200)
    y.iloc[::20] = np.nan
    assert reading(X, y, missing="gap") == "sample"
    assert reading(X, y, missing=1.5 / SPP) == "period"  # bridged


@pytest.mark.parametrize(("moves", "expected"), [(False, "period"), (True, "sample")])
def test_a_measured_azimuth_is_the_clock_where_there_is_one(moves, expected):
    X, y = record(moves)
    t = X.index.to_numpy()
    psi = OMEGA * (t + 0.3 * np.sin(0.5 * t))
    X["u"] += 20.0 * np.cos(psi)
    for azimuth in (psi, np.mod(psi, OMEGA)):
        assert reading(X.assign(psi=azimuth), y, omega=None, azimuth="psi") == expected
    psi[300:340] = np.nan
    assert reading(X.assign(psi=psi), y, omega=None, azimuth="psi", missing="gap") == expected


def test_several_records_are_judged_together():
    still, moving = record(), record(moves=True)
    for each, expected in ((still, "period"), (moving, "sample")):
        X, y = (pd.concat({"a": z, "b": -z}, names=["record"]) for z in each)
        assert reading(X, y) == expected


def held(edges, levels, samples=64, noise=0.0):
    """An input that takes these levels from these turns on."""
    t = np.arange(60 * samples) / samples
    u = np.append(0.0, levels)[np.searchsorted(edges, t, side="right")]
    u = u + noise * np.random.default_rng(0).standard_normal(len(t))
    index = pd.Index(t, name="time")
    y = answer(u, OMEGA * t)
    return pd.DataFrame({"u": u}, index), pd.DataFrame({"y": y}, index)


EDGES = {
    "a doublet": [5.0, 6.37, 7.81],
    "steps at one azimuth": 5.0 + np.cumsum([3, 1, 4, 1, 5, 9, 2, 6]),
    "steps at many azimuths": 5.0 + np.cumsum([3.1, 1.4, 1.5, 9.2, 6.5, 3.5, 2.8, 1.9]),
}


@pytest.mark.parametrize("noise", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize("name", EDGES)
def test_inputs_that_rest_are_read_by_periods_wherever_they_moved(name, noise):
    edges = EDGES[name]
    levels = np.resize([1.0, -1.0], len(edges)) * (np.arange(len(edges)) % 3 < 2)
    X, y = held(edges, levels, noise=noise)
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA), MOESPRegressor()).fit(X, y)
    assert pipe[0].basis_.reading == pipe[1].basis_.reading == "period"
    (exponent,) = pipe[1].model_.exponents()
    assert exponent == pytest.approx(64 * np.log(0.97), rel=1e-6 + 0.5 * noise)


def shaken(noise, seed=0):
    """A lag that noise drives: between the pulses of its input nothing decays freely."""
    X, _ = held(5.0 + np.cumsum([3.1, 1.4, 5.5, 1.2, 6.5, 1.5, 9.8, 1.9]), np.resize([1.0, 0.0], 8))
    e, y = np.random.default_rng(seed).standard_normal(len(X)), np.zeros(len(X))
    for k, u in enumerate(X["u"].to_numpy()[:-1]):
        y[k + 1] = 0.99 * y[k] + 0.1 * u + noise * e[k]
    return X, pd.DataFrame({"y": y}, X.index)


@pytest.mark.slow
def test_the_other_reading_is_taken_where_the_first_leaves_a_doubt():
    X, y = shaken(0.02)
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA), MOESPRegressor(), SpuriousModeReducer())
    pipe.fit(X, y)
    assert pipe[0].basis_.reading == "period"
    assert pipe[1].basis_.reading == pipe[2].basis_.reading == "sample"
    assert pipe[1].basis_.alternative is None
    frame = pipe[1].transform(pipe[0].transform(X))
    assert (frame.basis.reading, list(frame)) == ("sample", ["u"])
    asked = make_pipeline(HarmonicAnalyzer(OMEGA, reading="sample"), MOESPRegressor()).fit(X, y)
    pd.testing.assert_frame_equal(pipe.predict(X), asked.predict(X))
    assert pipe.score(X, y) == pytest.approx(asked.score(X, y))
    assert pipe[1].get_feature_names_out().tolist() == ["u"]
    framed = clone(pipe).set_output(transform="pandas").fit(X, y)
    pd.testing.assert_frame_equal(framed.predict(X), pipe.predict(X))
    less = X.iloc[: SPP // 2]  # of a period, which samples do not need
    pd.testing.assert_frame_equal(pipe.predict(less), asked.predict(less))


def test_rows_that_are_lost_leave_a_record_readable():
    """Between two of them lies less than a period: the others are read as samples."""
    X, y = record(n_turns=40)
    kept = ~np.isin(np.arange(len(X)), [20 * SPP, 20 * SPP + 8])
    assert (reading(X, y), reading(X[kept], y[kept])) == ("period", "sample")
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA), MOESPRegressor()).fit(X[kept], y[kept])
    assert pipe[1].model_.exponents()[0] == pytest.approx(SPP * np.log(0.97), rel=1e-3)
    whole = make_pipeline(HarmonicAnalyzer(OMEGA), MOESPRegressor()).fit(X, y)
    assert whole[1].basis_.reading == "period"
    with pytest.raises(ValueError, match="shorter than a period, and this model reads whole"):
        whole.predict(X[kept])
    with pytest.raises(ValueError, match=r"1 of 3 are too short.*reading='sample'"):
        make_pipeline(HarmonicAnalyzer(OMEGA, reading="period"), MOESPRegressor()).fit(
            X[kept], y[kept]
        )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_the_other_reading_is_taken_where_it_is_surer(seed):
    """Under 3 % noise, periods leave 8 % of a rate open and nothing in doubt; samples know 1 %."""
    F = np.array([[[-1.2, 1.0], [-1.0, -1.2]], [[0.1, 0.0], [0.2, 0.1]], [[0.0, 0.1], [0.0, 0.0]]])
    system = LTPSystem(F, [[1.0], [0.5]], np.eye(2), omega=OMEGA)
    t, u = np.arange(60 * 32) / 32, np.zeros(60 * 32)
    for start in (265, 649, 1065, 1513):
        u[start : start + 64], u[start + 64 : start + 128] = 1.0, -1.0
    y = np.asarray(system.simulate(u[:, None], t))
    y = y + 0.03 * y.std(axis=0) * np.random.default_rng(seed).standard_normal(y.shape)
    time = pd.Index(t, name="time")
    X, y = pd.DataFrame({"u": u}, time), pd.DataFrame(y, time).add_prefix("y")
    step = make_pipeline(HarmonicAnalyzer(OMEGA), MOESPRegressor()).fit(X, y)[1]
    assert step.basis_.reading == "sample"
    found, true = step.model_.exponents(), system.floquet_exponents()
    gaps = np.abs(found[:, None] - np.concatenate([true, true.conj()]))
    assert np.max(gaps.min(axis=1)) < 0.01 * np.abs(true.real).max()


@pytest.mark.parametrize(
    ("second", "first", "kept"),
    [
        ((0.03, 0.5, False), (0.04, 0.1, False), True),  # nothing speaks against either: by errors
        ((0.06, 0.5, False), (0.3, 0.1, False), False),  # unless the other's may be off, too
        ((9.0, 0.5, False), (0.3, 0.1, True), True),  # nothing speaks against one
        ((0.3, 0.1, True), (0.2, 0.01, False), False),
        ((0.3, 0.5, True), (0.4, 0.1, True), True),  # both in doubt: by errors,
        ((0.4, 0.1, True), (0.3, 0.5, True), True),  # unless the first leaves far more,
        ((0.4, 0.1, True), (0.3, 0.3, True), False),
        ((7.0, 0.1, True), (2.0, 0.2, True), True),  # or both may be off by all of a rate
        ((2.0, 0.2, True), (7.0, 0.1, True), False),
    ],
)
def test_which_of_two_models_is_kept(second, first, kept):
    """Each as the error of an exponent, the variance left, and whether it is in doubt."""

    def model(doubt, left, told):
        return (SubspaceFit(None, None, 1, 1, doubt=doubt, left=left),), [
            ("", IdentifiabilityWarning if told else TimeBaseWarning)
        ]

    assert _is_surer(*model(*second), *model(*first)) == kept


@pytest.mark.slow
def test_a_reading_that_was_asked_for_is_kept():
    X, y = shaken(0.02)
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA, reading="period"), MOESPRegressor())
    with pytest.warns(IdentifiabilityWarning, match="in doubt|negative"):
        pipe.fit(X, y)
    assert pipe[1].basis_.reading == "period"


@pytest.mark.slow
def test_block_rows_that_were_given_are_those_of_one_reading():
    X, y = shaken(0.02)
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA), MOESPRegressor(block_rows=4))
    with pytest.warns(IdentifiabilityWarning, match="in doubt|negative"):
        pipe.fit(X, y)
    assert pipe[1].basis_.reading == "period"


@pytest.mark.parametrize("n_turns", [0.125, 1, 5, 11])
def test_few_turns_are_read_by_samples(n_turns):
    assert reading(*record(n_turns=n_turns)) == "sample"


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({"hop": 4}, "sliding"),
        ({"window": "hann"}, "sliding"),
        ({"input_harmonics": 1}, "sliding"),
        ({"input_harmonics": {"u": [0, 1]}}, "sliding"),
        ({"output_harmonics": {"y": [0, 1]}}, "sliding"),
        ({"load_harmonics": 2}, "sample"),
        ({"small_signal": "odd"}, "period"),
        ({"input_harmonics": 0, "output_harmonics": 2}, "period"),
        ({"input_harmonics": np.int64(0)}, "period"),
        ({"trim_span": (0.0, 5.0)}, "period"),
        ({"reading": "sample"}, "sample"),
        ({"reading": "sliding"}, "sliding"),
    ],
)
def test_what_is_asked_for_goes_first(params, expected):
    assert reading(*record(), **params) == expected


def test_without_outputs_there_are_coefficients_to_see():
    X, _ = record()
    assert reading(X, None) == "sliding"
    assert "u_0" in HarmonicAnalyzer(OMEGA).fit_transform(X)


@pytest.mark.parametrize("omega", [1e-300, 1e-9, 1e7, 1e12, 1e300])
def test_frequencies_beyond_reason_are_named(omega):
    with pytest.raises(
        ValueError, match=rf"omega={omega:g} rad/s and a sample time".replace("+", r"\+")
    ):
        reading(*record(), omega=omega)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda u: 0.0 * u, r"input 'u' is constant.* does not tell its effect"),
        (lambda u: 0.0 * u + 3.0, r"input 'u' is constant.* does not tell its effect"),
        (lambda u: u * np.nan, r"X has no values in column 'u': all are NaN"),
        (
            lambda u: 0.0 * u + np.cos(OMEGA * u.index.to_numpy())[:, None],
            r"repeats itself with ev",
        ),
        (lambda u: u.assign(v=3.0), r"input 'v' is constant"),
        (
            lambda u: u.assign(v=0.1 * np.cos(OMEGA * u.index.to_numpy())),
            r"input 'v' repeats itself with every turn",
        ),
    ],
    ids=["zero", "constant", "missing", "wave", "beside", "wave beside"],
)
@pytest.mark.filterwarnings("ignore:records begin with outputs at rest at zero")
def test_inputs_that_never_move_are_named_by_the_fit(spoil, message):
    X, y = record()
    X = spoil(X)
    y["y"] += 0.1 * np.random.default_rng(0).standard_normal(len(y))
    pipe = make_pipeline(HarmonicAnalyzer(OMEGA, missing="gap"), MOESPRegressor())
    with pytest.raises(ValueError, match=message):
        pipe.fit(X, y)


@pytest.mark.filterwarnings("ignore:records begin with outputs at rest at zero")
def test_a_wave_is_no_excitation_and_an_offset_hides_none(ltp):
    """Times that are rounded to nanoseconds leave 1e-7 of a wave beside its mean turn."""
    u, rng = ltp.inputs, np.random.default_rng(0)
    t = u.index.to_numpy()
    u = u - u.iloc[0]
    wave = np.cos(ltp.omega * (t + 1e-9 * rng.standard_normal(len(t))))
    pipe = make_pipeline(HarmonicAnalyzer(ltp.omega, reading="period"), MOESPRegressor())
    for loads in (0.0, 5.0 * np.cos(ltp.omega * t)[:, None]):
        with pytest.raises(ValueError, match=r"input 'v' repeats itself with every turn"):
            pipe.fit(u.assign(v=wave), ltp.outputs + loads)
    plain = pipe.fit(u, ltp.outputs)[-1].eigenvalues_
    offset = pipe.fit(u + 1e6 * u.abs().max(), ltp.outputs)[-1].eigenvalues_
    np.testing.assert_allclose(np.sort_complex(offset), np.sort_complex(plain), rtol=1e-6)


def test_no_inputs_are_a_matter_of_the_next_step():
    X, y = record()
    with pytest.raises(ValueError, match="X has no signals"):
        reading(X[[]], y)


@pytest.mark.parametrize(("moves", "harmonics"), [(False, None), (True, None), (False, 0)])
def test_nothing_but_omega_is_chosen(moves, harmonics):
    """The same four steps for either kind of record, and what was read is said."""
    X, y = record(moves)
    pipe = make_pipeline(
        HarmonicAnalyzer(OMEGA, output_harmonics=harmonics),
        MOESPRegressor(),
        SpuriousModeReducer(),
        StructuredMatcher(structure=HarmonicStructure()),
    ).fit(X, y)
    assert pipe.score(*record(not moves, n_turns=80)) > 0.95  # a record of the other kind
    exponents = pipe[-1].ltp_.floquet_exponents()
    assert np.min(np.abs(exponents - SPP * np.log(0.97))) < 0.02


@pytest.mark.parametrize("options", [{"samples_per_period": 48}, {"width": 1}])
@pytest.mark.slow
def test_second_order_responses_are_no_states(options):
    """Without noise 2 λ₁, λ₁ + λ₂ and more of the nonlinear wing stand out from rounding."""
    data = make_flapping_wing("nltp", **{"n_periods": 60, "start": 8, "width": 10, **options})
    frame = HarmonicAnalyzer(data.omega).fit_transform(data.inputs, data.outputs)
    found = MOESPRegressor().fit(frame, data.outputs)  # warnings are errors here
    exact = np.sort(data.ltp.floquet_exponents().real) * 2.0 * np.pi / data.omega
    np.testing.assert_allclose(np.log(np.sort(found.eigenvalues_.real)), exact, rtol=3e-3)


@pytest.mark.parametrize("order", ["auto", 2])
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_linear_machine_keeps_a_mode_whose_rate_is_twice_another(order, noise):
    system = LTPSystem(
        np.diag([-0.3, -0.6]), [[1.0], [1.0]], [[1.0, 0.05], [0.3, 0.05]], omega=OMEGA
    )
    t = np.arange(60 * SPP) / SPP
    u = np.zeros((len(t), 1))
    u[3 * SPP : 8 * SPP], u[20 * SPP : 26 * SPP] = 1.0, -0.7
    y = system.simulate(u, t)
    y = y + noise * y.std(axis=0) * np.random.default_rng(0).standard_normal(y.shape)
    index = pd.Index(t, name="time")
    u, y = pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index, ["a", "b"])
    frame = HarmonicAnalyzer(OMEGA, reading="period").fit_transform(u, y)
    found = MOESPRegressor(order).fit(frame, y).model_.exponents()
    np.testing.assert_allclose(np.sort(found.real), [-0.6, -0.3], rtol=1e-2)
