"""Laws of harmonic transfer functions, of models and of records."""

import numpy as np
import pandas as pd
import pytest
from periodic_cases import meissner, vinograd
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.algorithms.periodic.floquet import transition_matrices
from sklearn_hd.algorithms.periodic.harmonic_transfer import effective_averages
from sklearn_hd.exceptions import TimeBaseWarning
from sklearn_hd.systems import (
    LTPSystem,
    coupled_oscillators,
    duffing,
    estimate_harmonic_transfer_function,
    flapping_blade,
    flapping_wing,
    mathieu,
)

FREQUENCIES = np.array([0.0, 0.31, 1.0, 2.7])


def static_gain(N=None):
    """y = (1 + cos ψ − 2 sin 2ψ) u and a state that does nothing."""
    Q = np.array([1.0, 1.0, 0.0, 0.0, -2.0]).reshape(5, 1, 1)
    return LTPSystem([[-1.0]], [[0.0]], [[0.0]], Q, omega=2.0)


def steady_state(system, frequency, harmonic, input_index):
    """H_n by collocation in time: x = X(ψ) e^{jΩt}, u = e^{jΩt} made by states of its own."""
    n, m = system.n_states, system.n_inputs

    def F(psi):
        whole = np.zeros((len(psi), n + 2, n + 2))
        whole[:, :n, :n] = system.F(psi)
        whole[:, :n, n] = system.G(psi)[:, :, input_index]
        whole[:, n, n + 1], whole[:, n + 1, n] = -frequency, frequency
        return whole

    S = 64
    psi = 2 * np.pi * np.arange(S + 1) / S
    Phi, _ = transition_matrices(F, None, psi, system.omega)
    whole = np.linalg.multi_dot(Phi[::-1])
    drive = np.array([1.0, -1j])  # Re e^{jΩt} and Re −j e^{jΩt}: their complex sum is e^{jΩt}
    turn = np.exp(1j * frequency * system.period)
    x = np.linalg.solve(turn * np.eye(n) - whole[:n, :n], whole[:n, n:] @ drive)
    total = np.zeros(system.n_outputs, dtype=complex)
    state = np.concatenate([x, drive])
    unit = np.zeros(m)
    unit[input_index] = 1.0
    for k in range(S):
        phase = np.exp(-1j * (frequency / system.omega + harmonic) * psi[k])
        u = unit * np.exp(1j * frequency * psi[k] / system.omega)
        y = system.P(psi[k : k + 1])[0] @ state[:n] + system.Q(psi[k : k + 1])[0] @ u
        total += phase * y / S
        state = Phi[k] @ state
    return total


# ---- models -----------------------------------------------------------------------------------


def test_time_invariant_system_has_no_other_harmonics():
    rng = np.random.default_rng(0)
    A, B = rng.standard_normal((3, 3)) - 2 * np.eye(3), rng.standard_normal((3, 2))
    C, D = rng.standard_normal((2, 3)), rng.standard_normal((2, 2))
    H = LTPSystem(A, B, C, D, omega=1.5).harmonic_transfer_function(FREQUENCIES, 2)
    assert H.response.shape == (4, 5, 2, 2)
    for n in range(-2, 3):
        expected = 0.0 if n else frequency_response(A, B, C, D, 1j * FREQUENCIES)
        np.testing.assert_allclose(H.harmonic(n), expected, atol=1e-13)


def test_static_periodic_gain():
    H = static_gain().harmonic_transfer_function(FREQUENCIES, 2)
    expected = np.array([-1j, 0.5, 1.0, 0.5, 1j])  # −2 sin 2ψ = j e^{2jψ} − j e^{−2jψ}
    np.testing.assert_allclose(H.response[:, :, 0, 0], np.tile(expected, (4, 1)), atol=1e-15)


def test_modulated_output_shifts_the_frequency():
    """ẋ = −x + u, y = cos ψ x: H_±1 = 1 / (2 (1 + jΩ)); modulated input: at Ω ± ω."""
    cosine = np.array([0.0, 1.0, 0.0]).reshape(3, 1, 1)
    after = LTPSystem([[-1.0]], [[1.0]], cosine, omega=4.0)
    before = LTPSystem([[-1.0]], cosine, [[1.0]], omega=4.0)
    H = after.harmonic_transfer_function(FREQUENCIES, 1)
    for n in (-1, 1):
        np.testing.assert_allclose(H.harmonic(n)[:, 0, 0], 0.5 / (1 + 1j * FREQUENCIES))
        moved = before.harmonic_transfer_function(FREQUENCIES, 1).harmonic(n)[:, 0, 0]
        np.testing.assert_allclose(moved, 0.5 / (1 + 1j * (FREQUENCIES + 4.0 * n)))


@pytest.mark.parametrize(
    "system", [coupled_oscillators(), flapping_blade(mu=0.4), vinograd(), mathieu()], ids=repr
)
def test_modulated_inputs_come_out_as_at_shifted_frequencies(system):
    """Of cos ψ u: (H_{n−1}(j(Ω + ω)) + H_{n+1}(j(Ω − ω))) / 2."""
    omega = system.omega
    modulated = LTPSystem(
        system.F, lambda psi: np.cos(psi)[:, None, None] * system.G(psi), system.P, omega=omega
    ).harmonic_transfer_function(FREQUENCIES, 1)
    above, below = (
        system.harmonic_transfer_function(FREQUENCIES + shift, 2) for shift in (omega, -omega)
    )
    for n in (-1, 0, 1):
        expected = 0.5 * (above.harmonic(n - 1) + below.harmonic(n + 1))
        np.testing.assert_allclose(
            modulated.harmonic(n), expected, atol=1e-7 * np.max(np.abs(above.response))
        )


@pytest.mark.parametrize(
    "system", [coupled_oscillators(), flapping_blade(mu=0.4), vinograd(), mathieu()], ids=repr
)
def test_negative_frequencies_have_the_conjugate_response(system):
    """H_n(−jΩ) is the conjugate of H_−n(jΩ)."""
    H = system.harmonic_transfer_function(FREQUENCIES, 2)
    scale = np.max(np.abs(H.response))
    mirrored = system.harmonic_transfer_function(-FREQUENCIES, 2)
    difference = mirrored.response[:, ::-1] - np.conj(H.response)
    assert np.max(np.abs(difference)) < 1e-9 * scale


@pytest.mark.parametrize(
    "system", [coupled_oscillators(), flapping_blade(mu=0.4), mathieu()], ids=repr
)
def test_response_to_a_complex_exponential_in_time(system):
    H = system.harmonic_transfer_function([0.37, 1.45], 2)
    scale = np.max(np.abs(H.response))
    for k, frequency in enumerate((0.37, 1.45)):
        for n in (-2, 0, 1):
            expected = steady_state(system, frequency, n, 0)
            assert np.max(np.abs(H.harmonic(n)[k, :, 0] - expected)) < 1e-8 * scale


def test_held_response_is_that_of_a_simulation():
    """u = cos Ωt held between samples, after the transients are gone."""
    system, S, n_periods = coupled_oscillators(), 12, 200
    dt = system.period / S
    t = np.arange(S * n_periods) * dt
    frequency = 7 * system.omega / 40  # 7 turns in 40 periods
    H = system.harmonic_transfer_function([frequency], 5, sample_time=dt)
    u = np.zeros((len(t), 2))
    u[:, 1] = np.cos(frequency * t)
    y = system.simulate(u, t)[-40 * S :]
    carriers = np.exp(-1j * np.outer(np.arange(-5, 6) * system.omega + frequency, t[-40 * S :]))
    found = 2 * carriers @ y / len(y)  # half of it belongs to −Ω
    np.testing.assert_allclose(found, H.response[0, :, :, 1], atol=2e-6)


def test_held_response_tends_to_the_continuous_one():
    system = mathieu()
    dt, frequencies = system.period / 4096, np.array([0.5, -1.5])
    exact = system.harmonic_transfer_function(frequencies, 1)
    fine = system.harmonic_transfer_function(frequencies, 1, sample_time=dt)
    delay = np.exp(-0.5j * frequencies * dt)[:, None, None, None]  # of the hold, at the input
    np.testing.assert_allclose(fine.response, exact.response * delay, atol=2e-6)


def test_held_inputs_repeat_at_the_frequency_of_their_samples():
    system = flapping_blade()
    dt = system.period / 16
    H, beyond = (
        system.harmonic_transfer_function(FREQUENCIES + shift, 2, sample_time=dt)
        for shift in (0.0, 2.0 * np.pi / dt)
    )
    np.testing.assert_allclose(H.response, beyond.response, atol=1e-12)


def test_kinks_that_truncation_cannot_resolve_are_reported():
    system = meissner(damping=0.5)
    with pytest.warns(ConvergenceWarning, match=r"still changes by .* 32 internal harmonics"):
        H = system.harmonic_transfer_function([0.4], 1, max_internal_harmonics=32)
    for n in (-1, 0, 1):
        expected = steady_state(system, 0.4, n, 0)
        np.testing.assert_allclose(H.harmonic(n)[0, :, 0], expected, atol=2e-3)


def test_flapping_wing_responds_at_the_harmonics_of_its_hd_model():
    wing = flapping_wing()
    system = wing.linearize(wing.trim(20))
    H = system.harmonic_transfer_function([5.0], 1, tolerance=1e-5)
    hd = system.harmonic_decomposition(20, 0, 1)
    G = frequency_response(hd.A, hd.B, hd.C, hd.D, [5.0j])[0]
    first = 0.5 * (G[2:4, 0] - 1j * G[4:6, 0])  # (1c − j 1s) / 2
    scale = np.max(np.abs(H.response), axis=(0, 1, 3))
    assert np.max(np.abs(H.harmonic(0)[0, :, 0] - G[:2, 0]) / scale) < 1e-4
    assert np.max(np.abs(H.harmonic(1)[0, :, 0] - first) / scale) < 1e-4


def test_unbounded_response_is_refused():
    system = LTPSystem([[0.0, 1.0], [-4.0, 0.0]], [[0.0], [1.0]], omega=5.0)
    with pytest.raises(ValueError, match=r"response at 2 rad/s is unbounded"):
        system.harmonic_transfer_function([1.0, 2.0], 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frequencies": [np.nan]}, "frequencies holds NaN or infinity; give finite real numbers"),
        ({"frequencies": [[1.0]]}, r"frequencies has shape \(1, 1\); give finite real"),
        ({"n_harmonics": -1}, "n_harmonics must be a whole number of at least 0, got -1"),
        ({"max_internal_harmonics": 2}, "at least 3, got 2; it must exceed n_harmonics=2"),
        ({"sample_time": 0.1}, "samples a period, not a whole number"),
        ({"sample_time": -0.1}, "sample_time must be a positive number in seconds"),
    ],
)
def test_model_refuses(arguments, message):
    given = {"frequencies": [1.0], "n_harmonics": 2} | arguments
    with pytest.raises(ValueError, match=message):
        mathieu().harmonic_transfer_function(**given)


# ---- records ----------------------------------------------------------------------------------


def record(system, n_periods, S, seed, noise=0.0, first=0):
    """Inputs that change at random every sample, and noisy outputs."""
    rng = np.random.default_rng(seed)
    t = (first + np.arange(S * n_periods)) * system.period / S
    u = rng.choice([-1.0, 1.0], size=(len(t), system.n_inputs))
    y = system.simulate(u, t)
    y += noise * np.std(y, axis=0) * rng.standard_normal(y.shape)
    index = pd.Index(t, name="time")
    return (
        pd.DataFrame(u, index, list(system.input_names)),
        pd.DataFrame(y, index, list(system.output_names)),
    )


@pytest.mark.parametrize("noise", [0.05, 0.5])
@pytest.mark.parametrize(
    ("entry", "wrong", "periods"),
    [
        (mathieu, {"a": 2.1}, 120),
        (flapping_blade, {"mu": 0.4}, 40),
        (coupled_oscillators, {"frequencies": (1.05, 1.7)}, 120),
    ],
    ids=["mathieu", "blade", "coupled"],
)
def test_estimate_agrees_with_the_model_within_its_standard_deviation(entry, wrong, periods, noise):
    """rms of |Ĥ − H| / std is 1 for the true system, and shows one that is a little off."""
    system = entry()
    u, y = record(system, 6000, 8, seed=1, noise=noise)
    estimate = estimate_harmonic_transfer_function(
        u, y, system.omega, 2, periods_per_segment=periods
    )
    truth, other = (
        candidate.harmonic_transfer_function(estimate.frequencies, 2, sample_time=system.period / 8)
        for candidate in (system, entry(**wrong))
    )
    misfit = estimate.misfit(truth)
    assert misfit.shape == (system.n_outputs * system.n_inputs, 5)
    assert misfit.to_numpy().min() > 0.85
    assert misfit.to_numpy().max() < 1.2
    assert estimate.misfit(other).to_numpy().max() > 2.0


def test_short_segments_smear_the_resonance():
    """Leakage is no noise: segments of 3 time constants miss the peak by many std."""
    system = mathieu()
    u, y = record(system, 6000, 8, seed=1, noise=0.05)
    worst = []
    for periods in (20, 160):
        estimate = estimate_harmonic_transfer_function(
            u, y, system.omega, 0, periods_per_segment=periods
        )
        model = system.harmonic_transfer_function(
            estimate.frequencies, 0, sample_time=system.period / 8
        )
        worst.append(np.max(np.abs(estimate.response - model.response) / estimate.std))
    assert worst[0] > 2 * worst[1]


def test_pure_modulation_is_exact_in_every_record_and_phase():
    """y = (1 + cos ψ − 2 sin 2ψ) u: no dynamics, so no leakage either."""
    system = static_gain()
    first = record(system, 200, 16, seed=2, first=5)
    second = record(system, 150, 16, seed=3, first=11)
    u, y = (pd.concat({"a": a, "b": b}) for a, b in zip(first, second, strict=True))
    estimate = estimate_harmonic_transfer_function(u, y, system.omega, 2)
    expected = np.array([-1j, 0.5, 1.0, 0.5, 1j])
    np.testing.assert_allclose(
        estimate.response[:, :, 0, 0], np.tile(expected, (len(estimate.frequencies), 1)), atol=1e-9
    )
    np.testing.assert_allclose(estimate.coherence, 1.0, atol=1e-9)
    assert np.max(estimate.std) < 1e-6


def test_time_invariant_record_has_no_other_harmonics():
    system = LTPSystem([[-1.0]], [[1.0]], omega=3.0)
    u, y = record(system, 3000, 10, seed=4, noise=0.02)
    estimate = estimate_harmonic_transfer_function(u, y, 3.0, 1, periods_per_segment=20)
    for n in (-1, 1):
        share = np.abs(estimate.harmonic(n)) / estimate.std[:, 1 + n]
        assert np.sqrt(np.mean(share**2)) == pytest.approx(1.0, abs=0.2)
    low = estimate.frequencies < 1.5
    assert np.min(np.abs(estimate.harmonic(0)[low])) > 20 * np.max(estimate.std[low])


def test_samples_of_a_period_need_not_be_whole():
    """ω and the sampling are free of one another: carriers follow the time."""
    rng = np.random.default_rng(5)
    t = np.arange(20000) * 0.1
    u = rng.standard_normal((20000, 1))
    gain = 1.0 + np.cos(1.7 * t)
    y = gain[:, None] * u
    estimate = estimate_harmonic_transfer_function(
        pd.DataFrame(u, t, ["u"]), pd.DataFrame(y, t, ["y"]), 1.7, 1
    )
    np.testing.assert_allclose(
        estimate.response[:, :, 0, 0],
        np.tile([0.5, 1.0, 0.5], (len(estimate.frequencies), 1)),
        atol=1e-9,
    )


def test_coherence_falls_with_noise_as_it_should():
    """White input through a gain, noise of the same power: coherence 1/2 but for its bias."""
    rng = np.random.default_rng(6)
    u, e = rng.standard_normal((2, 100000, 1))
    with_noise = estimate_harmonic_transfer_function(
        u, u + e, 0.4, 0, sample_time=1.0, periods_per_segment=10
    )
    assert np.mean(with_noise.coherence) == pytest.approx(0.5, abs=0.01)
    power = np.mean(np.abs(with_noise.response - 1) ** 2) / np.mean(with_noise.std**2)
    assert power == pytest.approx(1.0, abs=0.15)
    harmonics = estimate_harmonic_transfer_function(
        u, u + e, 0.4, 1, sample_time=1.0, periods_per_segment=10
    )
    assert harmonics.n_averages == pytest.approx(with_noise.n_averages)
    assert harmonics.coherence.shape == (len(harmonics.frequencies), 3, 1)


def coloured_gains(seed):
    """y = (G + G₁ cos ψ) u + e of two inputs, one slow and one fast, and two sizes of noise."""
    rng = np.random.default_rng(seed)
    slow, fast = rng.standard_normal((2, 100_001))
    u = np.column_stack([slow[1:] + 0.9 * slow[:-1], 0.1 * (fast[1:] - 0.9 * fast[:-1])])
    G, G1 = np.array([[1.0, -2.0], [0.5, 3.0]]), np.array([[0.4, 1.0], [-0.6, 0.2]])
    modulation = np.cos(0.4 * np.arange(len(u)))[:, None]
    noise = rng.standard_normal(u.shape) * [0.1, 5.0]
    return u, u @ G.T + modulation * (u @ G1.T) + noise, np.stack([0.5 * G1, G, 0.5 * G1])


def test_each_entry_errs_by_its_own_standard_deviation():
    """Of every harmonic, output and input, where inputs are strong and where they are weak."""
    u, y, true = coloured_gains(8)
    estimate = estimate_harmonic_transfer_function(
        u, y, 0.4, 1, sample_time=1.0, periods_per_segment=40
    )
    share = (np.abs(estimate.response - true) / estimate.std) ** 2
    for band in np.array_split(share, 2):
        np.testing.assert_allclose(np.mean(band, axis=0), 1.0, atol=0.3)


def test_units_of_a_signal_scale_the_entries_that_it_is_part_of():
    u, y, _ = coloured_gains(9)
    plain, scaled = (
        estimate_harmonic_transfer_function(a, b, 0.4, 1, sample_time=1.0, periods_per_segment=10)
        for a, b in ((u, y), (u * [1e3, 0.2], y * [7.0, 1e-2]))
    )
    ratio = np.outer([7.0, 1e-2], [1e-3, 5.0])
    np.testing.assert_allclose(scaled.response, plain.response * ratio, rtol=1e-8)
    np.testing.assert_allclose(scaled.std, plain.std * ratio, rtol=1e-8)
    np.testing.assert_allclose(scaled.coherence, plain.coherence, rtol=1e-8)


def test_input_that_does_not_move_is_not_known():
    rng = np.random.default_rng(7)
    u = np.column_stack([rng.standard_normal(20000), np.zeros(20000)])
    estimate = estimate_harmonic_transfer_function(u, u[:, :1], 0.4, 1, sample_time=1.0)
    assert np.isnan(estimate.response[..., 1]).all()
    np.testing.assert_allclose(estimate.harmonic(0)[..., 0], 1.0)


def test_gap_starts_a_new_segment():
    system = static_gain()
    u, y = record(system, 400, 16, seed=8)
    kept = np.r_[0:2000, 2500:6400]
    estimate = estimate_harmonic_transfer_function(u.iloc[kept], y.iloc[kept], system.omega, 2)
    np.testing.assert_allclose(estimate.harmonic(2), 1j, atol=1e-9)


def test_tables_carry_names():
    system = coupled_oscillators()
    H = system.harmonic_transfer_function(FREQUENCIES, 1)
    table = H.to_frame()
    assert table.index.name == "frequency"
    assert table.columns.names == ["output", "input", "harmonic"]
    np.testing.assert_array_equal(table["x2", "u1", -1], H.response[:, 0, 1, 0])
    assert "input_names=('u1', 'u2')" in repr(H)
    with pytest.raises(ValueError, match="what='std' is not known"):
        H.to_frame("std")
    with pytest.raises(ValueError, match=r"harmonic 2 is not among −1 … 1"):
        H.harmonic(2)
    with pytest.raises(ValueError, match="call misfit on the estimate"):
        H.misfit(H)


@pytest.mark.slow
def test_duffing_orbit_in_the_frequency_domain():
    """Small noise about the orbit of a nonlinear system: its linearisation is what is seen."""
    system = duffing(amplitude=0.5, damping=0.4)
    trim = system.trim(20)
    S, rng = 16, np.random.default_rng(9)
    t = np.arange(S * 600) * system.period / S
    u = 1e-3 * rng.choice([-1.0, 1.0], size=(len(t), 1))
    y = system.simulate(u, t, trim.initial_state, rtol=1e-8, atol=1e-10)
    y -= trim.states(system.omega * t)
    estimate = estimate_harmonic_transfer_function(
        pd.DataFrame(u, t, ["u"]), pd.DataFrame(y, t, ["x", "x_dot"]), system.omega, 2
    )
    model = system.linearize(trim).harmonic_transfer_function(
        estimate.frequencies, 2, sample_time=t[1]
    )
    low = estimate.frequencies < 2 * system.omega
    error = np.abs(estimate.response - model.response)[low].max(axis=(0, 1, 3))
    assert np.max(error / np.abs(model.response).max(axis=(0, 1, 3))) < 0.05


def test_misfit_wants_the_same_axes():
    system = static_gain()
    u, y = record(system, 100, 16, seed=10)
    estimate = estimate_harmonic_transfer_function(u, y, system.omega, 1)
    with pytest.raises(ValueError, match="differ in signals, harmonics or frequencies"):
        estimate.misfit(system.harmonic_transfer_function([1.0], 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"omega": 0.0}, "omega must be a positive number in rad/s"),
        ({"n_harmonics": -1}, "n_harmonics must be a whole number of at least 0"),
        ({"n_harmonics": 9}, "harmonic 9 of omega=0.4 rad/s lies beyond half the sampling"),
        ({"overlap": 1.0}, "overlap must be a number from 0 to below 1, got 1.0; it is a share"),
        ({"periods_per_segment": 0}, "periods_per_segment must be a whole number of at least 1"),
        ({"periods_per_segment": 30}, r"independent segments of 30 periods.* 3 unknowns"),
        ({"periods_per_segment": 900}, r"hold 0 independent segments"),
        ({"periods_per_segment": 10**9}, r"hold 0 independent segments"),
    ],
)
def test_estimate_refuses(change, message):
    rng = np.random.default_rng(0)
    u = pd.DataFrame(rng.standard_normal((1000, 1)), np.arange(1000.0), ["u"])
    arguments = {"omega": 0.4, "n_harmonics": 1} | change
    with pytest.raises(ValueError, match=message):
        estimate_harmonic_transfer_function(u, u, **arguments)


def test_estimate_refuses_uneven_rows_and_missing_values():
    rng = np.random.default_rng(0)
    t = np.arange(1000.0) + rng.uniform(-0.05, 0.05, 1000)
    u = pd.DataFrame(rng.standard_normal((1000, 1)), t, ["u"])
    with pytest.raises(ValueError, match="rows are unevenly spaced"):
        estimate_harmonic_transfer_function(u, u, 0.4, 1)
    u = pd.DataFrame(np.where(np.arange(1000) == 7, np.nan, 1.0), columns=["u"])
    with pytest.raises(ValueError, match=r"u contains NaN: column .u.*drop those rows, or fill"):
        estimate_harmonic_transfer_function(u, u, 0.4, 1, sample_time=1.0)


def test_rows_without_times_are_said_to_count_as_seconds():
    u = np.random.default_rng(1).standard_normal((2000, 1))
    with pytest.warns(TimeBaseWarning, match=r"rows count as samples, 1 s apart"):
        estimate_harmonic_transfer_function(u, u, 0.4, 1)


def test_overlap_is_worth_less_than_its_count():
    hann = np.hanning(513)[:-1]
    assert effective_averages(hann, 512, 10) == pytest.approx(10.0)
    assert effective_averages(hann, 256, 1000) == pytest.approx(1000 / (1 + 2 / 36), rel=1e-3)
    assert effective_averages(hann, 256, 0) == 0.0
