"""make_flapping_wing: one truth for all kinds, inputs as asked, noise as defined."""

import pickle

import numpy as np
import pandas as pd
import pytest

from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, propagate
from sklearn_hd.datasets import make_flapping_wing

KINDS = ["lti", "lti-signal", "ltp", "nltp"]
SHORT = {"n_periods": 24, "start": 4, "width": 4}
HEAVE = ["w_0", "phi_dot_1c", "phi_dot_1s"]
FLAP = ["phi_dot_0", "w_1c", "w_1s"]


def r2(y, reference):
    """Coefficient of determination of each column."""
    y, reference = np.asarray(y), np.asarray(reference)
    return 1 - np.sum((y - reference) ** 2, 0) / np.sum((reference - reference.mean(0)) ** 2, 0)


def perturbation(data):
    """Outputs of kind "nltp" without the trim."""
    psi = data.omega * data.outputs.index.to_numpy()
    return data.outputs - data.trim.states(psi)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("subsystem", "states"), [("heave", HEAVE), ("flap", FLAP)])
def test_shapes_names_and_truth(kind, subsystem, states):
    data = make_flapping_wing(kind, subsystem=subsystem, **SHORT)
    n_samples = 24 * 64
    assert list(data.inputs.columns) == ["U"]
    assert list(data.outputs.columns) == (states if kind == "lti" else ["w", "phi_dot"])
    assert data.inputs.index.equals(data.outputs.index)
    assert data.inputs.index.name == "time"
    np.testing.assert_allclose(data.outputs.index, np.arange(n_samples) * data.sample_time)
    assert data.sample_time == pytest.approx(2 * np.pi / data.omega / 64)
    assert list(data.A_exact.index) == list(data.A_exact.columns) == states
    hd = data.ltp.harmonic_decomposition(1)
    rows = [hd.state_labels.index(name) for name in states]
    np.testing.assert_array_equal(data.A_exact, hd.A[np.ix_(rows, rows)])
    column = hd.input_labels.index("U_0" if subsystem == "heave" else "U_1c")
    np.testing.assert_array_equal(data.B_exact.iloc[:, 0], hd.B[rows, column])


def test_truth_is_the_same_for_all_kinds():
    matrices = [make_flapping_wing(kind, **SHORT).A_exact for kind in KINDS]
    for other in matrices[1:]:
        pd.testing.assert_frame_equal(other, matrices[0])
    assert matrices[0].loc["phi_dot_1c", "phi_dot_1c"] == pytest.approx(-55.269, abs=1e-3)


def test_returned_matrices_are_copies():
    data = make_flapping_wing("lti", **SHORT)
    data.A_exact *= 0.0
    assert make_flapping_wing("lti", **SHORT).A_exact.iloc[0, 0] < -4


def test_default_record_is_the_papers_doublet():
    data = make_flapping_wing("lti")
    u, T = data.inputs["U"], 2 * np.pi / data.omega
    assert len(u) == 220 * 64
    size = 0.02 * data.trim.inputs[0]
    for first, last, value in [(0, 132, 0), (132, 142, size), (142, 152, -size), (152, 220, 0)]:
        np.testing.assert_array_equal(u.iloc[first * 64 : last * 64], value)
    assert data.trim_span == pytest.approx((0.0, 132 * T))
    assert data.trim_span[1] == pytest.approx(5.0, abs=0.02)


def test_hd_response_follows_equation_8():
    data = make_flapping_wing("lti", **SHORT)
    A_d, B_d = continuous_to_discrete(
        data.A_exact.to_numpy(), data.B_exact.to_numpy(), data.sample_time
    )
    x = propagate(A_d, data.inputs.to_numpy() @ B_d.T, np.zeros(3))
    np.testing.assert_array_equal(data.outputs, x)


def test_signal_is_put_together_by_equation_7():
    for subsystem, mean, first in [("heave", "w", "phi_dot"), ("flap", "phi_dot", "w")]:
        X = make_flapping_wing("lti", subsystem=subsystem, **SHORT)
        y = make_flapping_wing("lti-signal", subsystem=subsystem, **SHORT)
        psi = y.omega * y.outputs.index.to_numpy()
        c, s = X.outputs[f"{first}_1c"], X.outputs[f"{first}_1s"]
        np.testing.assert_array_equal(y.outputs[mean], X.outputs[f"{mean}_0"])
        np.testing.assert_allclose(y.outputs[first], c * np.cos(psi) + s * np.sin(psi), atol=1e-12)


def test_exact_hd_model_predicts_the_time_periodic_response():
    """R² of the N = 1 heave model on LTP data: 0.9997 for w, 0.9977 for φ̇."""
    signal, ltp = (make_flapping_wing(kind).outputs for kind in ("lti-signal", "ltp"))
    np.testing.assert_allclose(r2(signal, ltp), [0.9997, 0.9977], atol=1e-4)


@pytest.mark.slow
def test_nonlinear_perturbation_is_the_linear_one_for_small_doublets():
    for subsystem in ("heave", "flap"):
        small = {**SHORT, "subsystem": subsystem, "amplitude": 1e-4}
        nonlinear = perturbation(make_flapping_wing("nltp", **small))
        linear = make_flapping_wing("ltp", **small).outputs
        assert np.all(r2(nonlinear, linear) > 1 - 1e-4)


def test_nonlinear_record_rests_on_the_exact_orbit():
    data = make_flapping_wing("nltp", n_periods=24, start=20, width=1)
    y = data.outputs.to_numpy()[: 20 * 64].reshape(20, 64, 2)
    size = np.max(np.abs(y), axis=(0, 1))
    assert np.max(np.abs(y - y[:1]) / size) < 2e-10  # what 20 periods make of rounding
    np.testing.assert_array_equal(data.inputs.iloc[: 20 * 64], data.trim.inputs[0])
    assert np.max(np.abs(perturbation(data).iloc[: 20 * 64]).to_numpy() / size) < 2e-9


def test_flap_input_is_the_modulated_one():
    kinds = ("lti", "ltp", "nltp")
    lti, ltp, nltp = (make_flapping_wing(kind, subsystem="flap", **SHORT) for kind in kinds)
    amplitude = lti.inputs["U"]
    assert set(np.sign(amplitude)) == {-1.0, 0.0, 1.0}
    raw = amplitude * np.cos(ltp.omega * amplitude.index.to_numpy())
    pd.testing.assert_series_equal(ltp.inputs["U"], raw, rtol=0, atol=1e-18)
    np.testing.assert_allclose(nltp.inputs["U"] - nltp.trim.inputs[0], raw, atol=1e-17)


@pytest.mark.parametrize("offset", [0.0, 0.25, 13 / 64, -0.5])
def test_offset_moves_the_edges(offset):
    u = make_flapping_wing("lti", offset=offset, **SHORT).inputs["U"].to_numpy()
    edges = np.flatnonzero(np.diff(u)) + 1
    shift = round(offset * 64)
    np.testing.assert_array_equal(edges, 64 * np.array([4, 8, 12]) + shift)


def test_trim_span_needs_a_period():
    assert make_flapping_wing("lti", n_periods=24, start=0.5, width=4).trim_span is None
    data = make_flapping_wing("lti", n_periods=24, start=1, width=4)
    assert data.trim_span == pytest.approx((0.0, 2 * np.pi / data.omega))


def test_3211_steps():
    data = make_flapping_wing("lti", input="3211", n_periods=40, width=2)
    u = data.inputs["U"].to_numpy() / (0.02 * data.trim.inputs[0])
    np.testing.assert_array_equal(u[: 4 * 64], 0.0)
    lengths = np.diff(np.flatnonzero(np.diff(u, prepend=0.0)))
    np.testing.assert_array_equal(lengths[:8], 64 * 2 * np.array([3, 2, 1, 1] * 2))
    assert set(u[4 * 64 :]) == {-1.0, 1.0}
    assert data.trim_span == pytest.approx((0.0, 4 * 2 * np.pi / data.omega))


def test_multisine_holds_one_value_a_period_up_to_its_peak():
    data = make_flapping_wing("lti", input="multisine", n_periods=104, random_state=0)
    u = data.inputs["U"].to_numpy().reshape(104, 64)
    np.testing.assert_array_equal(u, u[:, :1].repeat(64, axis=1))
    np.testing.assert_array_equal(u[:4], 0.0)
    values = u[4:, 0]
    assert np.max(np.abs(values)) == pytest.approx(0.02 * data.trim.inputs[0])
    power = np.abs(np.fft.rfft(values)) ** 2
    np.testing.assert_allclose(power[1:41], power[1])
    assert max(power[0], power[41:].max()) < 1e-20 * power[1]


def test_array_is_the_change_itself():
    rng = np.random.default_rng(0)
    du = 1e-4 * rng.standard_normal((3, 5 * 16))
    data = make_flapping_wing("ltp", input=du, n_periods=5, samples_per_period=16)
    np.testing.assert_array_equal(data.inputs["U"].to_numpy().reshape(3, 80), du)
    one = make_flapping_wing("ltp", input=du[1], n_periods=5, samples_per_period=16)
    np.testing.assert_allclose(data.outputs.loc[1], one.outputs, atol=1e-12)
    assert one.trim_span is None


@pytest.mark.parametrize("input", ["doublet", "3211", "multisine"])
def test_records_differ_and_begin_at_zero(input):
    data = make_flapping_wing(
        "ltp", input=input, n_records=3, n_periods=60, start=4, random_state=1
    )
    assert data.inputs.index.names == ["record", "time"]
    records = [data.inputs.loc[k, "U"].to_numpy() for k in range(3)]
    assert all(data.outputs.loc[k].index[0] == 0.0 for k in range(3))
    assert not np.array_equal(records[0], records[1])
    assert not np.array_equal(records[1], records[2])
    assert max(np.abs(u).max() for u in records) <= 0.02 * data.trim.inputs[0] * (1 + 1e-12)
    assert data.trim_span[1] == pytest.approx(4 * 2 * np.pi / data.omega)


def test_first_doublet_record_is_the_one_asked_for():
    many = make_flapping_wing("lti", n_records=4, random_state=3, **SHORT)
    one = make_flapping_wing("lti", **SHORT)
    np.testing.assert_array_equal(many.inputs.loc[0], one.inputs)


def test_same_seed_same_data():
    given = {"input": "multisine", "n_periods": 20, "snr": 10, "noise_on": "both"}
    first, again = (make_flapping_wing("ltp", random_state=5, **given) for _ in range(2))
    pd.testing.assert_frame_equal(first.outputs, again.outputs)
    pd.testing.assert_frame_equal(first.inputs, again.inputs)
    other = make_flapping_wing("ltp", random_state=6, **given)
    assert not other.outputs.equals(first.outputs)


@pytest.mark.parametrize("kind", KINDS)
def test_noise_is_a_part_of_the_perturbations_deviation(kind):
    data = make_flapping_wing(kind, snr=20, random_state=0, **SHORT)
    clean = data.outputs_clean
    if kind == "nltp":
        clean = clean - data.trim.states(data.omega * clean.index.to_numpy())
    noise = data.outputs - data.outputs_clean
    np.testing.assert_allclose(noise.std(), clean.std() / 20, rtol=0.1)
    pd.testing.assert_frame_equal(data.inputs, data.inputs_clean)


@pytest.mark.slow
def test_noise_on_both_and_in_decibels():
    decibels = make_flapping_wing("nltp", snr_db=20, noise_on="both", random_state=0, **SHORT)
    plain = make_flapping_wing("nltp", snr=10, noise_on="both", random_state=0, **SHORT)
    pd.testing.assert_frame_equal(decibels.outputs, plain.outputs)
    noise = (plain.inputs - plain.inputs_clean)["U"]
    assert noise.std() == pytest.approx(plain.inputs_clean["U"].std() / 10, rel=0.1)


def test_bunch_can_be_pickled():
    data = pickle.loads(pickle.dumps(make_flapping_wing("nltp", **SHORT)))
    assert "U* = 0.00422995" in data.DESCR
    assert data.ltp.floquet_exponents()[0] == pytest.approx(-3.527185, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"kind": "lpv"}, "kind='lpv' is not known; use one of 'lti', 'lti-signal', 'ltp', 'nltp'"),
        ({"subsystem": "pitch"}, "subsystem='pitch' is not known; use one of 'heave', 'flap'"),
        ({"noise_on": "inputs"}, "noise_on='inputs' is not known; use one of 'outputs', 'both'"),
        ({"input": "step"}, "input='step' is not known; use one of 'doublet', '3211', 'multisine'"),
        ({"n_periods": 0}, "n_periods must be a whole number of at least 1, got 0"),
        ({"n_periods": 140}, "from period 132 to 152 does not fit in 140 periods"),
        ({"start": -1}, "doublet from period -1 to 19 does not fit"),
        ({"width": 0.0}, r"width=0.0 is shorter than a sample"),
        (
            {"samples_per_period": 2},
            "samples_per_period must be a whole number of at least 3, got 2",
        ),
        ({"n_records": 1.5}, "n_records must be a whole number of at least 1, got 1.5"),
        ({"snr": 10, "snr_db": 20}, "both given; give one of them"),
        ({"snr": 0}, "snr=0 must be a positive ratio"),
        ({"offset": np.nan}, "offset must be a finite number, got nan"),
        ({"start": "a"}, "start must be a finite number, got 'a'"),
        ({"amplitude": np.inf}, "amplitude=inf must be a finite number"),
        ({"snr_db": np.nan}, "snr_db=nan must be a positive ratio"),
        ({"input": "3211", "n_periods": 4}, "n_periods=4 leaves nothing of the 3211"),
        ({"input": "multisine", "n_periods": 6}, "a multisine needs three periods or more"),
        ({"input": np.zeros(7)}, r"input has shape \(1, 7\).* = 14080 samples"),
        ({"input": np.full(14080, np.nan)}, "input holds NaN or infinity"),
        ({"input": np.zeros(14080), "n_records": 2}, "one row for each of n_records=2 records"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_flapping_wing(**arguments)


@pytest.mark.slow
def test_raw_records_begin_with_a_tenth_in_trim():
    """Their trim waveforms are averaged over it; perturbations need none."""
    T = 1 / 26.3
    raw = make_flapping_wing("nltp", input="3211", n_periods=80, width=2)
    assert raw.trim_span == pytest.approx((0.0, 8 * T))
    assert make_flapping_wing("ltp", input="3211", n_periods=80, width=2).trim_span[1] < 5 * T
