"""The fundamental frequency that records show by themselves, and fits at a wrong one."""

import re
import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import KEPT
from scipy.linalg import block_diag, expm
from scipy.signal import lfilter
from sklearn.pipeline import Pipeline, make_pipeline

import sklearn_hd
from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd._fit_checks import _share_in_lines
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.signals.fundamental import estimate_omega, omega_mismatch
from sklearn_hd.datasets import make_flapping_wing, make_rotor
from sklearn_hd.exceptions import FrequencyMismatchWarning, IdentifiabilityWarning
from sklearn_hd.systems import LTPSystem


def wing(kind="ltp", **kwargs):
    return make_flapping_wing(kind, **{"n_periods": 60, "start": 5, "random_state": 0} | kwargs)


def arrays(data):
    """Inputs and outputs of each record, the sample time and the true frequency."""
    frames = [data.inputs, data.outputs]
    if data.inputs.index.nlevels > 1:
        frames = [[one for _, one in frame.groupby(level=0)] for frame in frames]
    else:
        frames = [[frame] for frame in frames]
    inputs, outputs = ([one.to_numpy() for one in frame] for frame in frames)
    return inputs, outputs, data.sample_time, data.omega


KINDS = {
    "ltp": ("ltp", {}),
    "ltp, 3211": ("ltp", {"input": "3211"}),
    "ltp, records": ("ltp", {"n_records": 3}),
    "ltp, noise": ("ltp", {"snr": 20}),
    "lti-signal": ("lti-signal", {}),
    "lti-signal, noise": ("lti-signal", {"snr": 20}),
    "nltp": ("nltp", {}),
    "nltp, noise": ("nltp", {"snr": 20}),
    "nltp, large": ("nltp", {"amplitude": 0.1}),
}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.slow
def test_a_wrong_frequency_is_found_out_and_the_right_one_is_not(name):
    """Off by 1 % or by 0.3 %, in turn."""
    kind, kwargs = KINDS[name]
    inputs, outputs, dt, omega = arrays(wing(kind, samples_per_period=32, **kwargs))
    assert omega_mismatch(inputs, outputs, dt, omega) is None
    off = (0.01, -0.003)[list(KINDS).index(name) % 2]
    found = omega_mismatch(inputs, outputs, dt, omega * (1 + off))
    assert abs(found.omega / omega - 1) < 1e-3
    assert found.residual < found.residual_given


@pytest.mark.slow
def test_noise_on_the_inputs_too():
    """A twentieth of each: 1 % off is found out, to a thousandth."""
    for seed in range(2):
        data = wing(snr=20, noise_on="both", random_state=seed)
        inputs, outputs, dt, omega = arrays(data)
        assert omega_mismatch(inputs, outputs, dt, omega) is None
        found = omega_mismatch(inputs, outputs, dt, 1.01 * omega)
        assert abs(found.omega / omega - 1) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("n_samples", [16, 64])
def test_noise_free_records_give_their_frequency(n_samples):
    """Inputs explain but what is above the least noise that a record is taken to have."""
    inputs, outputs, dt, omega = arrays(wing(samples_per_period=n_samples))
    estimate = estimate_omega(inputs, outputs, dt, 1.01 * omega)
    assert abs(estimate.omega / omega - 1) < 1e-5


@pytest.mark.slow
def test_scatter_under_noise_of_a_twentieth():
    off = []
    for seed in range(4):
        inputs, outputs, dt, omega = arrays(wing(snr=20, random_state=seed))
        off.append(estimate_omega(inputs, outputs, dt, 1.01 * omega).omega / omega - 1)
    assert np.sqrt(np.mean(np.square(off))) < 3e-4


@pytest.mark.parametrize("kind", ["ltp", "lti-signal", "nltp"])
@pytest.mark.parametrize("kwargs", [{"input": "multisine"}, {"subsystem": "flap"}])
@pytest.mark.slow
def test_the_right_frequency_is_right_for_any_input(kind, kwargs):
    """Also where nothing rests, or nothing lasts, so that nothing can be said."""
    inputs, outputs, dt, omega = arrays(wing(kind, **kwargs))
    assert omega_mismatch(inputs, outputs, dt, omega) is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* explain the records")  # of multiples
def test_deviations_hold_for_a_rotor_that_turbulence_shakes():
    """χ² of twenty degrees of freedom, within its central 99.9 %. A drift would be an error."""
    off = []
    for seed in range(100, 120):
        rotor = make_rotor(n_turns=100, random_state=seed)
        found = sklearn_hd.estimate_omega(rotor.inputs, rotor.outputs)
        off.append((found.omega - rotor.omega) / found.std)
        assert found.std < 1e-5 * rotor.omega
    assert 0.54 < np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.slow
def test_random_periodic_systems():
    """No false alarm, and every frequency off by 1 % found out."""
    rng = np.random.default_rng(1)
    spp, omega = 32, 2 * np.pi
    t = np.arange(60 * spp) / spp
    u = np.zeros((len(t), 1))
    u[5 * spp : 15 * spp], u[15 * spp : 25 * spp] = 1.0, -1.0
    tried = 0
    while tried < 4:
        F = RandomHarmonics(rng, n=int(rng.integers(2, 5)), n_harmonics=int(rng.integers(1, 4)))
        system = LTPSystem(F, lambda psi, n=F.n: np.ones((*np.shape(psi), n, 1)), omega=omega)
        if max(system.floquet_exponents().real) > -0.02:
            continue
        tried += 1
        y = system.simulate(u, t)
        y += 0.05 * np.std(y, axis=0) * (tried % 2) * rng.standard_normal(y.shape)
        assert omega_mismatch([u], [y], 1 / spp, omega) is None
        found = omega_mismatch([u], [y], 1 / spp, 1.01 * omega)
        assert abs(found.omega / omega - 1) < 2e-3


class RandomHarmonics:
    """A random F(ψ)."""

    def __init__(self, rng, n, n_harmonics):
        self.n = n
        self.mean = rng.standard_normal((n, n)) - 2 * np.eye(n) * rng.uniform(0.3, 1.5)
        self.waves = 0.8 * rng.standard_normal((n_harmonics, 2, n, n))

    def __call__(self, psi):
        psi = np.asarray(psi)[..., None, None]
        waves = enumerate(self.waves, start=1)
        return self.mean + sum(c * np.cos(k * psi) + s * np.sin(k * psi) for k, (c, s) in waves)


def test_to_a_system_that_is_not_periodic_any_frequency_is_right():
    A = expm(block_diag([[-0.2]], [[-0.1, 2.0], [-2.0, -0.1]]) / 32)
    u = np.zeros((60 * 32, 1))
    u[160:480], u[480:800] = 1.0, -1.0
    y = propagate(A, u @ np.ones((1, 3)), np.zeros(3))[:, :2]
    assert omega_mismatch([u], [y], 1 / 32, 2 * np.pi) is None


@pytest.mark.filterwarnings("ignore:.* explain the records")  # of multiples
@pytest.mark.slow
def test_the_clock_of_an_input_is_said_to_be_one():
    """Steps held for a third of 51 samples; the turn has 52.4."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], (360, 2)), 17, axis=0)
    A = expm(block_diag([[-0.2]], [[-0.1, 2.0], [-2.0, -0.1]]) / 100)
    psi = 12.0 * np.arange(len(u)) / 100
    y = propagate(A, u @ rng.standard_normal((2, 3)), np.zeros(3))[:, :2]
    y = y + 0.01 * y.std(axis=0) * rng.standard_normal(y.shape)
    found = omega_mismatch([u], [y], 0.01, 12.0)
    assert found.omega == pytest.approx(2 * np.pi / 0.51, rel=1e-3)
    assert found.of_inputs
    assert estimate_omega([u], [y], 0.01, 2 * np.pi / 0.51).of_inputs
    X, y = pd.DataFrame(u, psi / 12.0, ["u", "v"]), pd.DataFrame(y, psi / 12.0, ["y", "z"])
    with pytest.warns(IdentifiabilityWarning, match="it is the clock of the inputs, or the mach"):
        sklearn_hd.estimate_omega(X, y, 12.0)
    pipe = make_pipeline(HarmonicAnalyzer(12.0, reading="sample"), MOESPRegressor(3))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pipe.fit(X, y)
    told = [str(w.message) for w in caught if w.category is FrequencyMismatchWarning]
    assert all("keep omega if it is known" in words for words in told)


@pytest.mark.slow
def test_nothing_to_tell_it_from():
    still, rng = np.zeros((2000, 1)), np.random.default_rng(0)
    with pytest.raises(ValueError, match="too few to find a repetition"):
        estimate_omega([still[:100]], [rng.standard_normal((100, 1))], 1 / 32, 2 * np.pi)
    with pytest.raises(ValueError, match="too few to find a repetition"):
        estimate_omega([still], [still], 1 / 32, 2 * np.pi)
    short = [rng.standard_normal((60, 1))] * 40
    assert omega_mismatch([still[:60]] * 40, short, 1 / 32, 2 * np.pi) is None
    rows = [rng.standard_normal((4, 1))] * 600
    assert omega_mismatch([still[:4]] * 600, rows, 1 / 32, 2 * np.pi) is None
    wave = np.cos(np.pi / 2 * np.arange(7200) + 0.3) + 0.02 * rng.standard_normal(7200)
    parts = [slice(18 * k, 18 * k + 15) for k in range(400)]  # of four rows a turn
    moved = [rng.standard_normal((15, 1)) for _ in parts]
    starts = [float(part.start) for part in parts]
    found = estimate_omega(moved, [wave[part, None] for part in parts], 1.0, 1.57, starts=starts)
    assert abs(found.omega - np.pi / 2) < 4.0 * found.std < 1e-5
    with pytest.raises(
        ValueError, match="longest of 600 segments holds 4 rows, and 8 periods take"
    ):
        estimate_omega([still[:4]] * 600, rows, 1 / 32)
    with pytest.raises(ValueError, match="too few to find a repetition"):
        estimate_omega([still], [rng.standard_normal((2000, 1))], 1 / 32, 1e-300)


# ---- sines, ramps, multiples, scatter ---------------------------------------------------------

T = np.arange(2000) * 1.03 / 32  # 31.07 samples a turn
STILL = np.zeros((2000, 1))


def wave(psi):
    return np.cos(psi + 0.3) + 0.3 * np.sin(2 * psi) + 0.1 * np.cos(3 * psi)


def of_one(y, guess, **kwargs):
    return estimate_omega([STILL], [y[:, None]], 1.03 / 32, guess, **kwargs)


@pytest.mark.parametrize("off", [0.0, 0.01, -0.003, 0.03])
@pytest.mark.parametrize("per_second", [1.0, 0.7123, 3.3])
@pytest.mark.slow
def test_a_pure_sine_is_exact(off, per_second):
    omega = 2 * np.pi * per_second
    estimate = of_one(np.cos(omega * T + 0.3), omega * (1 + off))
    assert estimate.omega == pytest.approx(omega, rel=1e-12)
    assert estimate.drift == 0.0


@pytest.mark.parametrize("shape", [0.2 + T / 60, 1 - np.exp(-T / 20), 1 + 0.5 * np.sin(T / 5)])
@pytest.mark.slow
def test_an_amplitude_that_varies_is_no_frequency(shape):
    estimate = of_one(shape * wave(2 * np.pi * T), 6.3)
    assert estimate.omega == pytest.approx(2 * np.pi, rel=1e-7)
    assert (estimate.drift, estimate.rivals) == (0.0, ())


@pytest.mark.parametrize(("shape", "noise"), [(np.cos, 0.05), (wave, 0.0), (wave, 0.05)])
@pytest.mark.slow
def test_multiples_and_fractions_are_told_from_the_frequency(shape, noise):
    y = shape(2 * np.pi * T) + noise * np.random.default_rng(0).standard_normal(2000)
    assert of_one(y, 6.3).rivals == ()
    for factor in (2, 1 / 2):
        found = of_one(y, 6.3 * factor)
        assert abs(found.omega / (2 * np.pi * factor) - 1) < 0.035
        assert np.min(np.abs(np.array(found.rivals) / found.omega * factor - 1)) < 1e-6
    assert of_one(y, None).omega == pytest.approx(2 * np.pi, rel=1e-12 if noise == 0.0 else 1e-4)


SLOW = [pytest.param(shape, marks=pytest.mark.slow) for shape in ("ramp", "transient")]


@pytest.mark.parametrize("shape", ["steady", *SLOW, "decay"])
@pytest.mark.slow
def test_the_standard_deviation_holds(shape):
    """Errors over deviations of 12 records: rms 1, of which 0.5 to 1.6 is what chance gives."""
    y = {
        "steady": wave(2 * np.pi * T),
        "ramp": (0.2 + T / 60) * wave(2 * np.pi * T),
        "transient": wave(2 * np.pi * T) + 2 * np.exp(-T / 15) * (1 + np.cos(2 * np.pi * T)),
        "decay": np.exp(-T / 15) * (2 + 1.6 * np.cos(2 * np.pi * T)),
    }[shape]
    scores = []
    for seed in range(12):
        noise = 0.05 * np.std(y) * np.random.default_rng(seed).standard_normal(2000)
        found = of_one(y + noise, 6.28, span=0.01)
        scores.append((found.omega - 2 * np.pi) / found.std)
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6


@pytest.mark.parametrize("change", [-0.003, 0.01])
def test_a_drift_is_told_from_an_offset(change):
    middle = 0.5 * T[-1]
    psi = 2 * np.pi * (T + 0.5 * change * (T - middle) ** 2 / T[-1])
    y = wave(psi) + 0.02 * np.random.default_rng(0).standard_normal(2000)
    found = of_one(y, 6.3)
    assert found.drift / found.omega == pytest.approx(change, rel=0.1)
    assert found.omega == pytest.approx(2 * np.pi, rel=1e-4)


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 3, 7))])
def test_inputs_with_many_lines_are_no_half_or_third_of_a_frequency(seed):
    """Their lines make the comb of 2π/2, or 2π/3, the strongest; the orbit has that of 2π."""
    rng, psi = np.random.default_rng(seed), 2 * np.pi * 0.08 * np.arange(2500)
    lines, phases = rng.uniform(0.03, 2.3, 24), rng.uniform(0, 2 * np.pi, 24)
    u = np.cos(np.outer(psi, lines) + phases).sum(axis=1) / 50
    y = np.zeros(2500)
    for k in range(2499):
        force = (1 + 0.4 * np.sin(psi[k])) * u[k] + np.cos(psi[k]) + 0.3 * np.cos(2 * psi[k])
        y[k + 1] = np.exp(-0.04 - 0.024 * np.cos(psi[k])) * y[k] + 0.08 * force
    y += 0.01 * y.std() * rng.standard_normal(2500)
    time = pd.Index(0.08 * np.arange(2500))
    found = sklearn_hd.estimate_omega(pd.Series(u, time, name="u"), pd.Series(y, time, name="y"))
    assert abs(found.omega - 2 * np.pi) < 4 * found.std < 1e-4
    assert found.rivals == ()


def test_a_drift_by_a_ten_thousandth_of_a_turn_is_none():
    """Noise-free records tell it, and it matters to no one."""
    middle, change = 0.5 * T[-1], 1e-6
    psi = 2 * np.pi * (T + 0.5 * change * (T - middle) ** 2 / T[-1])
    assert of_one(wave(psi), 6.3).drift == 0.0


@pytest.mark.filterwarnings("ignore:.* explain the records")  # of a multiple
@pytest.mark.slow
def test_a_speed_that_goes_to_and_fro_is_told():
    """Twice in the record: no drift, and quarters have speeds of their own."""
    psi = 2 * np.pi * T - 0.8 * np.cos(4 * np.pi * T / T[-1])
    y = wave(psi) + 0.02 * np.random.default_rng(0).standard_normal(2000)
    u, y = pd.Series(0.0, T, name="u"), pd.Series(y, T, name="y")
    with pytest.warns(FrequencyMismatchWarning, match="the speed varies about .* azimuth="):
        found = sklearn_hd.estimate_omega(u, y, 6.3)
    assert found.drift == 0.0
    assert abs(found.omega - 2 * np.pi) < found.std < 0.2


def beside_resonance(omega, seed, size=0.8, n=1200, dt=0.08):
    """An orbit, and beside it a light resonance that random steps of an input keep in motion."""
    rng, t = np.random.default_rng(seed), np.arange(n) * dt
    u = np.repeat(rng.standard_normal(n // 10), 10)
    pole = np.exp((-0.6 + 7.7j) * dt)
    moved = lfilter([dt], np.poly([pole, pole.conj()]).real, u)
    y = wave(omega * t) + size * moved / moved.std() + 0.01 * rng.standard_normal(n)
    return pd.Series(u, t, name="u"), pd.Series(y, t, name="y")


@pytest.mark.filterwarnings("ignore:.* explain the records")  # of multiples
@pytest.mark.slow
def test_deviations_hold_beside_a_light_resonance():
    errors = []
    for seed in range(8):
        found = sklearn_hd.estimate_omega(*beside_resonance(5.0, seed), 5.0)
        errors.append((found.omega - 5.0) / found.std)
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.5, errors


@pytest.mark.filterwarnings("ignore:.* explain the records")  # of multiples
@pytest.mark.slow
def test_a_speed_that_no_part_has_is_told():
    """Patterns of what the input moves look like another speed; each quarter has the orbit's."""
    with pytest.warns(FrequencyMismatchWarning, match="parts of the longest segment"):
        found = sklearn_hd.estimate_omega(*beside_resonance(5.0, 2, 1.2), 5.0)
    assert abs(found.omega - 5.0) < 2.0 * found.std


@pytest.mark.parametrize(
    "others",
    [
        (5.0, 5.3),
        pytest.param((5.0, 5.02, 4.8), marks=pytest.mark.slow),
        pytest.param((5.0, 5.0, 5.45), marks=pytest.mark.slow),
    ],
)
def test_records_with_speeds_of_their_own_are_told(others):
    """By the estimate and by a fit; each is named."""
    pairs = [beside_resonance(omega, seed, 0.5) for seed, omega in enumerate(others)]
    u, y = (pd.concat(some, keys=range(len(others))) for some in zip(*pairs, strict=True))
    own = "speeds of their own: .* fit the records of each speed by themselves"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = sklearn_hd.estimate_omega(u, y, 5.0)
        HarmonicAnalyzer(5.0, reading="sample").fit(u, y)
    told = [str(w.message) for w in caught if w.category is FrequencyMismatchWarning]
    assert len(told) == 2, told
    assert all(re.search(own, message) for message in told)
    named = re.findall(r"at ([0-9.]+) ± ([0-9.e-]+)", told[0])
    assert np.allclose([float(omega) for omega, _ in named], sorted(others), atol=3e-3)
    assert abs(found.omega - np.mean(others)) < found.std < 1.0


def test_an_orbit_beyond_the_span_is_named():
    y = wave(4.85 * T) + 0.02 * np.random.default_rng(0).standard_normal(2000)
    u, y = pd.Series(0.0, T, name="u"), pd.Series(y, T, name="y")
    with pytest.raises(ValueError, match=r"within 1 % of guess=5 rad/s: .* 4.85.* widen the span"):
        sklearn_hd.estimate_omega(u, y, 5.0, span=0.01)
    assert abs(sklearn_hd.estimate_omega(u, y, 5.0).omega - 4.85) < 1e-3


def test_records_of_one_speed_and_records_at_rest_have_no_speeds_of_their_own():
    still = pd.Series(0.0, np.arange(1200) * 0.08)
    same = [beside_resonance(5.0, seed, 0.5) for seed in range(3)]
    for pairs in (same, [same[0], (still.rename("u"), still.rename("y"))]):
        u, y = (pd.concat(some, keys=range(len(pairs))) for some in zip(*pairs, strict=True))
        HarmonicAnalyzer(5.0, reading="sample").fit(u, y)


# ---- fits ---------------------------------------------------------------------------------------


def fit(data, off, **kwargs):
    params = {"output_harmonics": KEPT, "trim_span": data.trim_span} | kwargs
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(data.omega * (1 + off), **params)),
            ("identify", MOESPRegressor(order=8)),
        ]
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pipe.fit(data.inputs, data.outputs)
    return [str(w.message) for w in caught if w.category is FrequencyMismatchWarning]


def named_in(message):
    """The frequency that a message asks for."""
    return float(re.search(r"omega=([0-9.]+), or check the clock", message).group(1))


@pytest.mark.parametrize(("kind", "snr"), [("ltp", None), ("nltp", None), ("nltp", 20)])
@pytest.mark.slow
def test_a_fit_at_a_wrong_frequency_names_the_right_one(kind, snr):
    data = wing(kind, snr=snr)
    assert fit(data, 0.0) == []
    off, said = (-0.003, r"0.30% less") if snr else (0.01, r"0.99% more|1.00% more")
    (message,) = fit(data, off)
    assert np.any([words in message for words in said.split("|")])
    assert named_in(message) == pytest.approx(data.omega, rel=1e-5 if snr is None else 1e-4)


@pytest.mark.slow
def test_pairs_and_azimuths_at_a_wrong_frequency():
    data = wing("nltp", amplitude=[0.02, -0.02])
    assert fit(data, 0.0, small_signal="odd") == []
    (message,) = fit(data, 0.01, small_signal="odd")
    assert named_in(message) == pytest.approx(data.omega, rel=1e-6)
    single = wing()
    turning = single.inputs.assign(psi=1.01 * single.omega * single.inputs.index)
    analyzer = HarmonicAnalyzer(azimuth="psi", output_harmonics=KEPT)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(order=8))])
    assert isinstance(pipe.fit(turning, single.outputs).predict(turning), pd.DataFrame)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.slow
def test_what_repeats_itself_goes_on_over_gaps(seed):
    """A trim left in the outputs keeps its phase over a gap of no whole number of periods."""
    t = np.arange(3000) / 32
    y = np.cos(2 * np.pi * t) + np.exp(-0.1 * t) * (1 + 0.5 * np.sin(2 * np.pi * t))
    y += 0.1 * np.random.default_rng(seed).standard_normal(3000)
    parts = [slice(0, 1500), slice(1512, 3000)]
    outputs, still = [y[p, None] for p in parts], [np.zeros((len(y[p]), 1)) for p in parts]
    starts = [t[p.start] for p in parts]
    found = estimate_omega(still, outputs, 1 / 32, 6.28, starts=starts)
    assert abs(found.omega / (2 * np.pi) - 1) < 1e-4
    first = estimate_omega(still[:1], outputs[:1], 1 / 32, 6.28)
    assert found.std < 0.5 * first.std


# ---- what users call ----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_where_no_waveform_repeats_itself_a_frequency_may_be_any(seed):
    """Noise has none: it is refused, or comes with a warning."""
    noise = np.random.default_rng(seed).standard_normal((2000, 3))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            sklearn_hd.estimate_omega(noise[:, :1], noise[:, 1:], sample_time=0.01)
            said = " ".join(str(each.message) for each in caught)
        except ValueError as error:
            said = str(error)
    assert re.search("no orbit at .* may be any|no fundamental frequency stands out", said)


@pytest.mark.slow
def test_a_record_beside_its_trim_holds_no_sure_frequency():
    data = make_flapping_wing(
        "ltp", n_periods=120, start=5, width=3, samples_per_period=32, random_state=0
    )
    with (
        pytest.warns(IdentifiabilityWarning, match="the outputs show no orbit at .* may be any"),
        pytest.warns(IdentifiabilityWarning, match="explain the records better than"),
    ):
        sklearn_hd.estimate_omega(data.inputs, data.outputs)


@pytest.mark.slow
def test_frames_series_arrays_and_records_give_one_frequency():
    data = wing("nltp", snr=20)
    frames = sklearn_hd.estimate_omega(data.inputs, data.outputs)
    assert abs(frames.omega - data.omega) < 5 * frames.std < 1e-4 * data.omega
    dates = pd.Timestamp("2024-03-01") + pd.to_timedelta(data.inputs.index, unit="s")
    X, y = data.inputs.set_axis(dates), data.outputs.set_axis(dates)
    assert sklearn_hd.estimate_omega(X, y).omega == pytest.approx(frames.omega, rel=1e-7)
    unix = data.inputs.index + 1.7e9
    X, y = data.inputs.set_axis(unix), data.outputs.set_axis(unix)
    assert abs(sklearn_hd.estimate_omega(X, y).omega - data.omega) < 1e-5 * data.omega
    X, y = data.inputs.to_numpy(), data.outputs.to_numpy()
    found = sklearn_hd.estimate_omega(X, y, sample_time=data.sample_time)
    assert found.omega == pytest.approx(frames.omega, rel=1e-9)
    records = wing("nltp", snr=20, n_records=2)
    found = sklearn_hd.estimate_omega(records.inputs, records.outputs, 165.0)
    assert abs(found.omega - data.omega) < 1e-4 * data.omega


@pytest.mark.slow
def test_a_frequency_in_hertz_is_recognised():
    rng, t = np.random.default_rng(0), np.arange(4000) / 100
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 100)
    y = wave(20.0 * t) + 0.1 * u + 0.01 * rng.standard_normal(4000)
    X, y = pd.DataFrame({"u": u}, t), pd.DataFrame({"y": y}, t)
    pipe = make_pipeline(HarmonicAnalyzer(20.0 / (2.0 * np.pi)), MOESPRegressor())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pipe.fit(X, y)
    told = [str(w.message) for w in caught if w.category is FrequencyMismatchWarning]
    assert len(told) == 1
    assert "has the frequency 20 rad/s and its harmonics, 2π times omega=3.1831" in told[0]


@pytest.mark.parametrize("samples", [4, 6.3, 12.5, 19, 64])
@pytest.mark.parametrize("kind", ["noise", "high line", "lasting mode"])
def test_a_right_frequency_is_not_taken_for_one_in_hertz(samples, kind):
    """Aliases, what noise leaves in few samples, and lines that 2π ω is near to."""
    rng, psi = np.random.default_rng(0), 2 * np.pi / samples * np.arange(1500)
    y = 0.2 * np.cos(psi) + 0.3 * rng.standard_normal(1500)
    if kind == "high line":
        y = 0.2 * np.cos(psi) + np.cos(19 * psi)
    elif kind == "lasting mode":
        shock = rng.standard_normal(1500)
        pole = np.exp(2 * np.pi / samples * (-0.05 + 2j * np.pi))
        y = 0.2 * np.cos(psi) + lfilter([1.0], [1.0, -2 * pole.real, abs(pole) ** 2], shock)
    share = _share_in_lines(y[:, None], psi, 2 * np.pi)
    assert np.all(share <= 1.0)
    assert np.all((share < 0.5) | (_share_in_lines(y[:, None], psi, 1.0) > share / 2.0))


@pytest.mark.slow
def test_what_decays_has_no_speed_that_varies():
    """Few turns tell the speed, and patterns hardly beside noise follow it: deviations say so."""
    off = []
    for seed in range(8):
        data = make_flapping_wing("ltp", snr=30, random_state=seed)
        found = sklearn_hd.estimate_omega(data.inputs, data.outputs, data.omega)
        off.append(abs(found.omega - data.omega) / found.std)
        assert found.drift == 0.0
        assert found.std < 2e-4 * data.omega
    assert 0.25 < np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.slow
def test_what_the_user_is_told():
    data = wing("nltp", snr=20)
    X, y = data.inputs, data.outputs
    with pytest.warns(IdentifiabilityWarning, match=r"165.2\d+ rad/s explain the records better"):
        sklearn_hd.estimate_omega(X, y, 2 * data.omega)
    with pytest.warns(
        IdentifiabilityWarning, match=r"165.2\d+.* rad/s explain the records as well"
    ):
        sklearn_hd.estimate_omega(data.inputs, data.outputs, data.omega / 2)
    u, y = pd.Series(0.0, T, name="u"), wave(2 * np.pi * T * (1 + 2e-4 * T))
    with pytest.warns(FrequencyMismatchWarning, match=r"the speed drifts by 2\.\d+% .* azimuth="):
        sklearn_hd.estimate_omega(u, pd.Series(y, T, name="y"), 6.3)


@pytest.mark.slow
def test_a_clock_that_is_a_little_off_is_told():
    """More patterns at a wrong frequency leave as little as fewer at the right one."""
    data = wing("nltp", n_periods=220, samples_per_period=32, start=132, snr=100)
    inputs, outputs, dt, omega = arrays(data)
    found = omega_mismatch(inputs, outputs, dt, omega * (1 + 1e-5))
    assert abs(found.omega / omega - 1) < 1e-6
    assert omega_mismatch(inputs, outputs, dt, float(np.float32(omega))) is None
