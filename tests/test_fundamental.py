"""The fundamental frequency that records show by themselves, and fits at a wrong one."""

import warnings

import numpy as np
import pandas as pd
import pytest
from conftest import KEPT
from scipy.linalg import block_diag, expm
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.signals.fundamental import estimate_omega, omega_mismatch
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import FrequencyMismatchWarning
from sklearn_hd.systems import LTPSystem

OFF = [0.01, -0.01, 0.003, -0.003]


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
    "ltp, 16 samples": ("ltp", {"samples_per_period": 16}),
    "ltp, 3211": ("ltp", {"input": "3211"}),
    "ltp, records": ("ltp", {"n_records": 3}),
    "ltp, noise": ("ltp", {"snr": 20}),
    "lti-signal": ("lti-signal", {}),
    "lti-signal, noise": ("lti-signal", {"snr": 20}),
    "nltp": ("nltp", {}),
    "nltp, noise": ("nltp", {"snr": 20}),
    "nltp, large": ("nltp", {"amplitude": 0.1}),
}


@pytest.mark.parametrize(("kind", "kwargs"), KINDS.values(), ids=KINDS)
def test_a_wrong_frequency_is_found_out_and_the_right_one_is_not(kind, kwargs):
    inputs, outputs, dt, omega = arrays(wing(kind, **kwargs))
    assert omega_mismatch(inputs, outputs, dt, omega) is None
    for off in OFF:
        found = omega_mismatch(inputs, outputs, dt, omega * (1 + off))
        assert abs(found.omega / omega - 1) < 1e-3
        assert found.residual < found.residual_given


def test_noise_on_the_inputs_too():
    """A twentieth of each: 1 % off is found out, to a thousandth."""
    for seed in range(3):
        data = wing(snr=20, noise_on="both", random_state=seed)
        inputs, outputs, dt, omega = arrays(data)
        assert omega_mismatch(inputs, outputs, dt, omega) is None
        found = omega_mismatch(inputs, outputs, dt, 1.01 * omega)
        assert abs(found.omega / omega - 1) < 1e-3


@pytest.mark.parametrize("n_samples", [16, 64])
def test_noise_free_records_give_their_frequency_to_a_millionth(n_samples):
    inputs, outputs, dt, omega = arrays(wing(samples_per_period=n_samples))
    estimate = estimate_omega(inputs, outputs, dt, 1.01 * omega)
    assert abs(estimate.omega / omega - 1) < 1e-7


def test_scatter_under_noise_of_a_twentieth():
    off = []
    for seed in range(6):
        inputs, outputs, dt, omega = arrays(wing(snr=20, random_state=seed))
        off.append(estimate_omega(inputs, outputs, dt, 1.01 * omega).omega / omega - 1)
    assert np.sqrt(np.mean(np.square(off))) < 3e-4


@pytest.mark.parametrize("kind", ["ltp", "lti-signal", "nltp"])
@pytest.mark.parametrize("kwargs", [{"input": "multisine"}, {"subsystem": "flap"}])
def test_the_right_frequency_is_right_for_any_input(kind, kwargs):
    """Also where nothing rests, or nothing lasts, so that nothing can be said."""
    inputs, outputs, dt, omega = arrays(wing(kind, **kwargs))
    assert omega_mismatch(inputs, outputs, dt, omega) is None


def test_random_periodic_systems():
    """No false alarm, and every frequency off by 1 % found out."""
    rng = np.random.default_rng(1)
    spp, omega = 32, 2 * np.pi
    t = np.arange(60 * spp) / spp
    u = np.zeros((len(t), 1))
    u[5 * spp : 15 * spp], u[15 * spp : 25 * spp] = 1.0, -1.0
    tried = 0
    while tried < 8:
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


def test_nothing_to_tell_it_from():
    u = np.random.default_rng(0).choice([-1.0, 1.0], (2000, 1))
    with pytest.raises(ValueError, match=r"the inputs rest nowhere for the 3 periods of"):
        estimate_omega([u], [u], 1 / 32, 2 * np.pi)
    still = np.zeros((2000, 1))
    with pytest.raises(ValueError, match="the inputs rest nowhere"):
        estimate_omega([still[:100]], [u[:100]], 1 / 32, 2 * np.pi)
    psi = 1.06 * 2 * np.pi * np.arange(2000)[:, None] / 32
    wave = np.cos(psi) + 0.5 * np.cos(2 * psi) + 0.3 * np.sin(3 * psi) + 0.2 * np.cos(4 * psi)
    with pytest.raises(ValueError, match=r"no fundamental frequency stands out within 3.5 % of"):
        estimate_omega([still], [wave], 1 / 32, 2 * np.pi)
    assert omega_mismatch([still], [wave], 1 / 32, 2 * np.pi) is None


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


@pytest.mark.parametrize(("kind", "snr"), [("ltp", None), ("nltp", None), ("nltp", 20)])
def test_a_fit_at_a_wrong_frequency_names_the_right_one(kind, snr):
    data = wing(kind, snr=snr)
    assert fit(data, 0.0) == []
    for off, said in ((0.01, r"0.99% more|1.00% more"), (-0.003, r"0.30% less")):
        (message,) = fit(data, off)
        assert np.any([words in message for words in said.split("|")])
        named = float(message.split("set omega=")[1].split(",")[0])
        assert named == pytest.approx(data.omega, rel=1e-5 if snr is None else 1e-4)


def test_pairs_and_azimuths_at_a_wrong_frequency():
    data = wing("nltp", amplitude=[0.02, -0.02])
    assert fit(data, 0.0, small_signal="odd") == []
    (message,) = fit(data, 0.01, small_signal="odd")
    assert "set omega=165.2" in message
    single = wing()
    turning = single.inputs.assign(psi=1.01 * single.omega * single.inputs.index)
    analyzer = HarmonicAnalyzer(azimuth="psi", output_harmonics=KEPT)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor(order=8))])
    assert isinstance(pipe.fit(turning, single.outputs).predict(turning), pd.DataFrame)


@pytest.mark.parametrize("seed", range(3))
def test_what_repeats_itself_goes_on_over_gaps(seed):
    """A trim left in the outputs keeps its phase over a gap of no whole number of periods."""
    t = np.arange(3000) / 32
    y = np.cos(2 * np.pi * t) + np.exp(-0.1 * t) * (1 + 0.5 * np.sin(2 * np.pi * t))
    y += 0.1 * np.random.default_rng(seed).standard_normal(3000)
    parts = [slice(0, 1500), slice(1512, 3000)]
    outputs, still = [y[p, None] for p in parts], [np.zeros((len(y[p]), 1)) for p in parts]
    starts = [t[p.start] for p in parts]
    each_anew = estimate_omega(still, outputs, 1 / 32, 6.28)
    found = estimate_omega(still, outputs, 1 / 32, 6.28, starts=starts)
    assert found.residual < 0.7 * each_anew.residual
    assert abs(found.omega / (2 * np.pi) - 1) < 1e-4
