"""Laws of systems and signals, each over systems, sampling, windows and records drawn at random.

``HYPOTHESIS_PROFILE=nightly`` draws fifty times as many, new ones at each run.
"""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from law_cases import (
    SEEDS,
    examples,
    laid_out,
    markov,
    periodic_matrices,
    record_layouts,
    same_modulo,
    samplings,
    systems,
    well_conditioned,
)
from scipy import linalg

from sklearn_hd import HarmonicAnalyzer
from sklearn_hd.algorithms.lti.hinf import hinf_norm
from sklearn_hd.algorithms.lti.simulation import (
    continuous_to_discrete,
    discrete_to_continuous,
    frequency_response,
    propagate,
)
from sklearn_hd.algorithms.signals.fourier import recompose
from sklearn_hd.systems import FourierMatrix, LTPSystem

# ---- time-invariant systems ---------------------------------------------------------------------


@examples(25)
@given(systems(min_inputs=0), SEEDS)
def test_similarity_leaves_response_and_markov_parameters_alone(system, seed):
    moved = system.moved(well_conditioned(np.random.default_rng(seed), len(system.A)))
    z = np.exp(1j * np.linspace(0.0, np.pi, 7))
    response = frequency_response(*system.matrices, z)
    size = np.abs(response).max(initial=1.0)
    np.testing.assert_allclose(frequency_response(*moved.matrices, z), response, atol=1e-10 * size)
    np.testing.assert_allclose(markov(*moved.matrices), markov(*system.matrices), atol=1e-10)


@examples(25)
@given(systems(), systems(discrete=False, feedthrough=False), SEEDS)
def test_similarity_leaves_the_norm_alone(sampled, continuous, seed):
    for system in (sampled, continuous):
        moved = system.moved(well_conditioned(np.random.default_rng(seed), len(system.A)))
        found, true = (hinf_norm(*model.matrices, model.dt)[0] for model in (moved, system))
        np.testing.assert_allclose(found, true, rtol=1e-8)


@examples(25)
@given(systems(min_inputs=0), st.floats(0.0, 2.0 * np.pi))
def test_no_response_exceeds_the_norm(system, angle):
    """σ_max(G) ≤ ‖G‖_∞ everywhere."""
    largest, _ = hinf_norm(*system.matrices, system.dt)
    response = frequency_response(*system.matrices, np.exp(1j * angle))[0]
    gain = np.max(np.linalg.svd(response, compute_uv=False), initial=0.0)  # also of no input
    assert gain <= largest * (1.0 + 1e-9)


@examples(40)
@given(systems(discrete=False, min_inputs=0), st.floats(0.01, 0.5))
def test_sampling_and_its_inverse(system, dt):
    A, B = system.A, system.B
    A_d, B_d = continuous_to_discrete(A, B, dt)
    np.testing.assert_allclose(A_d, linalg.expm(A * dt), rtol=1e-10, atol=1e-12)
    A_again, B_again = discrete_to_continuous(A_d, B_d, dt)
    np.testing.assert_allclose(A_again, A, atol=1e-9)
    np.testing.assert_allclose(B_again, B, atol=1e-9)


@examples(25)
@given(systems(), st.integers(1, 300), SEEDS)
def test_batched_is_looped(system, n_samples, seed):
    rng = np.random.default_rng(seed)
    forcing = rng.standard_normal((2, 3, n_samples, len(system.A)))
    x0 = rng.standard_normal((2, 3, len(system.A)))
    together = propagate(system.A, forcing, x0)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(together[i], propagate(system.A, forcing[i], x0[i]), atol=1e-10)
    z = np.exp(1j * rng.uniform(0.0, np.pi, 5))
    together = frequency_response(*system.matrices, z)
    alone = [frequency_response(*system.matrices, point)[0] for point in z]
    np.testing.assert_allclose(together, alone, rtol=1e-10, atol=1e-12)


# ---- periodic systems ---------------------------------------------------------------------------


def ltp(F, omega, **others):
    return LTPSystem(F, np.ones((F(np.zeros(1)).shape[1], 1)), omega=omega, **others)


def tolerance(matrix):
    """Of exponents, from the size of F over a turn."""
    return 1e-9 * max(1.0, np.abs(matrix(np.linspace(0.0, 2.0 * np.pi, 50))).max())


@examples(10)
@given(periodic_matrices(), st.floats(-20.0, 20.0))
def test_floquet_exponents_do_not_depend_on_the_origin_of_the_phase(case, origin):
    F, omega = case
    matrix = FourierMatrix(F)
    here = ltp(matrix, omega).floquet_exponents()
    there = ltp(lambda psi: matrix(psi + origin), omega).floquet_exponents()
    assert same_modulo(there, here, omega, 1e2 * tolerance(matrix))
    multipliers = np.linalg.eigvals(ltp(matrix, omega).monodromy(start=origin))
    expected = np.exp(here * 2.0 * np.pi / omega)
    gap = np.abs(multipliers[:, None] - expected)
    assert gap.min(axis=0).max() <= 1e-8 * np.abs(multipliers).max()


@examples(10)
@given(periodic_matrices(), SEEDS)
def test_a_periodic_change_of_states_leaves_the_exponents_alone(case, seed):
    """z = T(ψ) x has F_z = (ω T′ + T F) T⁻¹ (Lyapunov)."""
    F, omega = case
    n, rng = F.shape[1], np.random.default_rng(seed)
    matrix = FourierMatrix(F)
    waves = rng.standard_normal((2, n, n))
    waves *= 0.3 / np.linalg.norm(waves, 2, axis=(1, 2))[:, None, None]  # T stays regular
    T = FourierMatrix(np.concatenate([np.eye(n)[None], waves]))
    slope = FourierMatrix(np.concatenate([np.zeros((1, n, n)), waves[1:], -waves[:1]]))

    def changed(psi):
        return (omega * slope(psi) + T(psi) @ matrix(psi)) @ np.linalg.inv(T(psi))

    here = ltp(matrix, omega).floquet_exponents()
    there = ltp(changed, omega).floquet_exponents()
    assert same_modulo(there, here, omega, 1e2 * max(tolerance(matrix), tolerance(changed)))


@examples(20)
@given(periodic_matrices())
def test_exponents_add_up_to_the_mean_trace(case):
    """Liouville: det Φ(T) = exp ∫ tr F dt."""
    F, omega = case
    matrix = FourierMatrix(F)
    exponents = ltp(matrix, omega).floquet_exponents()
    assert abs(exponents.sum().real - np.trace(F[0])) <= tolerance(matrix) * len(exponents)


@examples(10)
@given(periodic_matrices())
@pytest.mark.slow
def test_the_harmonic_decomposition_holds_the_exponents(case):
    """Harmonics kept until the mode shapes have died out: bandwidth over ω, and then some."""
    F, omega = case
    system = ltp(FourierMatrix(F), omega)
    reach = np.abs(F).sum(axis=(1, 2)).max() / omega
    decomposed = system.harmonic_decomposition(int(12 + 3 * reach))
    found = linalg.eigvals(decomposed.A)
    exponents = system.floquet_exponents()
    gap = np.abs(found[:, None] - exponents).min(axis=0)
    assert gap.max() <= 1e-6 * max(1.0, np.abs(exponents).max())


@examples(15)
@given(periodic_matrices(), st.integers(3, 40), SEEDS)
def test_records_of_a_periodic_system_simulate_together_as_alone(case, samples, seed):
    F, omega = case
    rng = np.random.default_rng(seed)
    system = ltp(FourierMatrix(F), omega)
    t = system.period / samples * (rng.integers(0, 50) + np.arange(2 * samples))
    u, x0 = rng.standard_normal((3, len(t), 1)), rng.standard_normal((3, system.n_states))
    together = system.simulate(u, t, x0)
    for one, inputs, start in zip(together, u, x0, strict=True):
        alone = system.simulate(inputs, t, start)
        np.testing.assert_allclose(one, alone, atol=1e-9 * np.abs(alone).max())
    later = system.simulate(u, t + 7 * system.period, x0)
    np.testing.assert_allclose(later, together, atol=1e-8 * np.abs(together).max())


# ---- harmonics of signals -----------------------------------------------------------------------


@examples(25)
@given(st.data(), SEEDS)
def test_band_limited_signals_survive_decomposition(data, seed):
    """Whatever the window, its side, the hop, where records begin and how long they are."""
    sampling = data.draw(samplings())
    layout = data.draw(record_layouts(sampling))
    highest = data.draw(st.integers(0, (sampling.samples_per_period - 1) // 2))
    rng = np.random.default_rng(seed)
    true = rng.standard_normal((2, 2 * highest + 1))

    def signals(t):
        return np.transpose([recompose(s, sampling.omega * t, range(highest + 1)) for s in true])

    u = laid_out(sampling, layout, signals, ["u", "v"])
    analyzer = HarmonicAnalyzer(sampling.omega, input_harmonics=highest, **sampling.options)
    frame = analyzer.fit_transform(u)
    size = 1e-9 * np.abs(true).sum()
    np.testing.assert_allclose(analyzer.inverse_transform(frame), u, atol=size)
    coefficients = frame.iloc[:, 2:].to_numpy()
    np.testing.assert_allclose(coefficients, np.tile(true.ravel(), (len(u), 1)), atol=size)


@examples(25)
@given(st.data(), SEEDS)
def test_whole_periods_with_all_harmonics_lose_nothing(data, seed):
    sampling = data.draw(samplings(hops=lambda divisors: ["period"]))
    layout = data.draw(record_layouts(sampling))
    rng = np.random.default_rng(seed)
    u = laid_out(sampling, layout, lambda t: rng.standard_normal((len(t), 2)), ["u", "v"])
    analyzer = HarmonicAnalyzer(
        sampling.omega, input_harmonics=sampling.samples_per_period // 2, **sampling.options
    )
    back = analyzer.inverse_transform(analyzer.fit_transform(u))
    np.testing.assert_allclose(back, u, atol=1e-9)


@examples(20)
@given(st.data(), SEEDS)
@pytest.mark.slow
def test_signals_and_records_are_analysed_each_by_itself(data, seed):
    """Linear, signal by signal, record by record; later by whole periods is the same."""
    sampling = data.draw(samplings())
    layout = data.draw(record_layouts(sampling))
    highest = data.draw(st.integers(0, (sampling.samples_per_period - 1) // 2))
    rng = np.random.default_rng(seed)
    u = laid_out(sampling, layout, lambda t: rng.standard_normal((len(t), 2)), ["u", "v"])
    options = {"input_harmonics": highest} | sampling.options

    def coefficients(frame):
        analyzer = HarmonicAnalyzer(sampling.omega, **options).fit(u[frame.columns])
        return analyzer.transform(frame).iloc[:, len(frame.columns) :].to_numpy()

    whole = coefficients(u)
    np.testing.assert_array_equal(
        whole, np.hstack([coefficients(u[["u"]]), coefficients(u[["v"]])])
    )
    one_by_one = [coefficients(u.loc[[label]]) for label in range(len(layout))]
    np.testing.assert_array_equal(whole, np.vstack(one_by_one))
    np.testing.assert_allclose(coefficients(-2.0 * u), -2.0 * whole, atol=1e-12)
    shift = data.draw(st.integers(-50, 50))
    later = [(first + shift * sampling.samples_per_period, length) for first, length in layout]
    shifted = u.set_axis(laid_out(sampling, later, lambda t: t[:, None], ["t"]).index)
    np.testing.assert_allclose(coefficients(shifted), whole, atol=1e-8)


@examples(20)
@given(st.data(), SEEDS)
def test_a_hole_in_a_record_makes_two_of_it(data, seed):
    sampling = data.draw(samplings())
    (first, length), *_ = data.draw(record_layouts(sampling))
    hole = data.draw(st.integers(1, 3 * sampling.samples_per_period))
    rng = np.random.default_rng(seed)
    layout = [(first, length), (first + length + hole, 3 * sampling.samples_per_period)]
    parts = laid_out(sampling, layout, lambda t: rng.standard_normal((len(t), 1)), ["u"])
    analyzer = HarmonicAnalyzer(sampling.omega, input_harmonics=1, **sampling.options)
    assume(sampling.samples_per_period > 2)
    separate = analyzer.fit_transform(parts).to_numpy()
    holed = analyzer.fit_transform(parts.droplevel("record")).to_numpy()
    np.testing.assert_allclose(holed, separate, atol=1e-12)
