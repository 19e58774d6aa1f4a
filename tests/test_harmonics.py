"""HarmonicAnalyzer: what it keeps, what it gives back, what travels with the frame."""

import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.base import clone

from sklearn_hd import HarmonicAnalyzer, HarmonicFrame
from sklearn_hd.exceptions import TimeBaseWarning

OMEGA = 2 * np.pi  # one period a second
SPP = 16


def record(signal, n_periods=6, spp=SPP, name="u"):
    time = pd.Index(np.arange(n_periods * spp) / spp, name="time")
    return pd.DataFrame({name: signal(time.to_numpy())}, index=time)


@pytest.mark.parametrize(
    "window",
    ["boxcar", "triangle", "hann", "centred-boxcar", "centred-triangle", "centred-hann"],
)
@pytest.mark.parametrize("rows", [{"hop": 1}, {"hop": 4}, {"reading": "period"}])
def test_periodic_signals_survive_the_round_trip(window, rows):
    u = record(lambda t: 2 + np.cos(OMEGA * t) - 3 * np.sin(2 * OMEGA * t))
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=2, window=window, **rows)
    frame = analyzer.fit_transform(u)
    assert frame.index.equals(u.index)
    assert analyzer.get_feature_names_out().tolist() == frame.columns.tolist()
    pd.testing.assert_frame_equal(analyzer.inverse_transform(frame), u, rtol=1e-12)


@pytest.mark.parametrize("spp", [8, 9])
def test_whole_periods_lose_nothing(rng, spp):
    """The blockwise transform with all harmonics is invertible, whatever the signal."""
    u = record(lambda t: rng.standard_normal(len(t)), spp=spp)
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=spp // 2, reading="period")
    back = analyzer.inverse_transform(analyzer.fit_transform(u))
    pd.testing.assert_frame_equal(back, u, atol=1e-12)


def test_causal_windows_see_only_the_past(rng):
    u = record(lambda t: rng.standard_normal(len(t)))
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit(u)
    before = analyzer.transform(u)
    changed = u.copy()
    changed.iloc[50:] += 10.0
    after = analyzer.transform(changed)
    pd.testing.assert_frame_equal(pd.DataFrame(after.iloc[:50]), pd.DataFrame(before.iloc[:50]))
    assert not np.allclose(after.iloc[50:], before.iloc[50:])


def test_centred_windows_do_not_delay_a_ramp():
    ramp = record(lambda t: t)
    causal = HarmonicAnalyzer(OMEGA, hop=1).fit_transform(ramp)["u_0"].to_numpy()
    centred = HarmonicAnalyzer(OMEGA, window="centred-triangle", hop=1).fit_transform(ramp)["u_0"]
    inside = slice(2 * SPP, -2 * SPP)
    np.testing.assert_allclose(centred.to_numpy()[inside], ramp["u"].to_numpy()[inside], atol=1e-12)
    delay = (ramp["u"].to_numpy() - causal)[inside]
    np.testing.assert_allclose(delay, (SPP - 1) / 2 / SPP, atol=1e-12)


def test_phase_comes_from_the_time_not_from_the_row():
    u = record(lambda t: np.cos(OMEGA * t) + t)
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit(u)
    whole = analyzer.transform(u)
    part = analyzer.transform(u.iloc[5:])
    common = u.index[5 + SPP :]
    pd.testing.assert_frame_equal(pd.DataFrame(part.loc[common]), pd.DataFrame(whole.loc[common]))


def test_no_window_straddles_a_gap_or_a_record(rng):
    u = record(lambda t: rng.standard_normal(len(t)), n_periods=8)
    gap = pd.concat([u.iloc[: 3 * SPP], u.iloc[4 * SPP :] + 1e6])
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit(u)
    alone = analyzer.transform(u.iloc[: 3 * SPP])
    np.testing.assert_array_equal(analyzer.transform(gap).iloc[: 3 * SPP], alone)
    records = pd.concat({"a": u, "b": u + 1e6}, names=["record"])
    both = analyzer.transform(records)
    np.testing.assert_array_equal(both.loc["a"], analyzer.transform(u))


def test_trim_is_learned_subtracted_and_given_back():
    u = record(lambda t: 5 + np.cos(OMEGA * t) + np.where(t >= 3, t - 3, 0.0))
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=1, trim_span=(0, 3))
    frame = analyzer.fit_transform(u)
    waveform = 5 + np.cos(2 * np.pi * np.arange(SPP) / SPP)
    np.testing.assert_allclose(analyzer.basis_.input_trim[:, 0], waveform, atol=1e-12)
    np.testing.assert_allclose(frame[["u_0", "u_1c", "u_1s"]].iloc[: 3 * SPP], 0.0, atol=1e-12)
    back = analyzer.inverse_transform(frame)
    np.testing.assert_allclose(back.iloc[: 3 * SPP], u.iloc[: 3 * SPP], atol=1e-12)


def test_trim_is_pooled_over_records_in_their_own_time(rng):
    noise = rng.standard_normal((2, 6 * SPP))
    records = {r: record(lambda t, r=r: np.sin(OMEGA * t) + noise[r]) for r in (0, 1)}
    u = pd.concat(records, names=["record"])
    analyzer = HarmonicAnalyzer(OMEGA, trim_span=(0, 6)).fit(u)
    expected = np.sin(2 * np.pi * np.arange(SPP) / SPP) + noise.reshape(12, SPP).mean(axis=0)
    np.testing.assert_allclose(analyzer.basis_.input_trim[:, 0], expected, atol=1e-12)


def test_basis_and_model_ride_through_slices_and_pickles():
    frame = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit_transform(record(np.cos))
    for other in (frame.iloc[3:40], frame.copy(), frame[["u", "u_0"]], frame.loc[1.0:2.0]):
        assert isinstance(other, HarmonicFrame)
        assert other.basis is frame.basis
    again = pickle.loads(pickle.dumps(frame))
    assert again.basis.omega == OMEGA
    pd.testing.assert_frame_equal(pd.DataFrame(again), pd.DataFrame(frame))


def test_timedelta_index_is_time():
    u = record(np.cos)
    frame = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit_transform(u)
    stamped = u.set_axis(pd.to_timedelta(u.index, unit="s"))
    again = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit_transform(stamped)
    np.testing.assert_allclose(again.to_numpy(), frame.to_numpy(), atol=1e-9)


def test_counted_samples_are_said_to_be_so():
    u = record(np.cos)
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=1, sample_time=1 / SPP)
    with pytest.warns(TimeBaseWarning, match="rows count as samples, 0.0625 s apart"):
        frame = analyzer.fit_transform(u.to_numpy())
    named = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit_transform(u)
    np.testing.assert_allclose(frame.to_numpy(), named.to_numpy(), atol=1e-12)
    assert frame.columns.tolist() == ["x0", "x0_0", "x0_1c", "x0_1s"]


def test_harmonics_can_differ_from_signal_to_signal():
    u = record(np.cos).assign(v=1.0)
    frame = HarmonicAnalyzer(OMEGA, input_harmonics={"u": [2], "v": 0}).fit_transform(u)
    assert frame.columns.tolist() == ["u", "v", "u_2c", "u_2s", "v_0"]
    np.testing.assert_allclose(frame["v_0"], 1.0)


def test_clones_and_parameters():
    analyzer = HarmonicAnalyzer(OMEGA, hop=4, window="hann")
    assert clone(analyzer).get_params() == analyzer.get_params()


def test_a_frame_without_the_coefficients_cannot_be_put_together():
    u = record(np.cos)
    analyzer = HarmonicAnalyzer(OMEGA, input_harmonics=1).fit(u)
    with pytest.raises(ValueError, match="lacks the coefficient column 'u_0'"):
        analyzer.inverse_transform(u)


@pytest.mark.parametrize(("spp", "highest", "hop"), [(64, 1, 8), (60, 1, 6), (64, 3, 4), (7, 1, 1)])
def test_default_hop_reads_about_eight_rows_a_period(spp, highest, hop):
    u = record(np.cos, spp=spp)
    analyzer = HarmonicAnalyzer(OMEGA, output_harmonics=highest, reading="sliding").fit(
        u, u.rename(columns={"u": "y"})
    )
    assert analyzer.basis_.hop == hop
