"""Norms against closed forms, dense grids and each other."""

import numpy as np
import pytest
import slycot
from scipy import linalg

from sklearn_hd.algorithms.lti.hinf import hinf_norm
from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.exceptions import UnstableModelError


def oscillator(frequency, damping):
    """ω² / (s² + 2 ζ ω s + ω²)."""
    A = np.array([[0.0, 1.0], [-(frequency**2), -2 * damping * frequency]])
    return A, np.array([[0.0], [frequency**2]]), np.array([[1.0, 0.0]]), np.zeros((1, 1))


def random_model(random, n, m, p, dt=None, direct=True):
    """A stable model whose slowest pole is not far from the others."""
    A = random.standard_normal((n, n))
    if dt is None:
        A -= (linalg.eigvals(A).real.max() + 0.1) * np.eye(n)
    else:
        A *= 0.95 / np.abs(linalg.eigvals(A)).max()
    D = random.standard_normal((p, m)) * direct
    return A, random.standard_normal((n, m)), random.standard_normal((p, n)), D


def largest_on_grid(model, frequencies, dt=None):
    """Largest σ_max over a grid, then over finer ones about the best point."""
    for _ in range(6):
        s = 1j * frequencies if dt is None else np.exp(1j * frequencies * dt)
        gains = np.linalg.norm(frequency_response(*model, s), 2, axis=(1, 2))
        k = int(np.argmax(gains))
        low, high = frequencies[max(k - 1, 0)], frequencies[min(k + 1, len(frequencies) - 1)]
        frequencies = np.linspace(low, high, 201)
    return gains.max()


@pytest.mark.parametrize(("gain", "pole"), [(3.0, 2.0), (-1.0, 1e-3), (1e6, 1e4)])
def test_first_order_lag_peaks_at_rest(gain, pole):
    norm, frequency = hinf_norm([[-pole]], [[1.0]], [[gain]], [[0.0]])
    assert norm == pytest.approx(abs(gain) / pole, rel=1e-9)
    assert frequency == 0.0


@pytest.mark.parametrize("damping", [0.5, 0.1, 1e-3, 1e-6])
def test_second_order_resonance(damping):
    norm, frequency = hinf_norm(*oscillator(7.0, damping))
    assert norm == pytest.approx(1 / (2 * damping * np.sqrt(1 - damping**2)), rel=1e-8)
    assert frequency == pytest.approx(7.0 * np.sqrt(1 - 2 * damping**2), rel=1e-5)


@pytest.mark.parametrize("frequency", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("damping", [1e-9, 1e-12])
def test_pole_next_to_the_axis(frequency, damping):
    norm, peak = hinf_norm(*oscillator(frequency, damping))
    assert norm == pytest.approx(1 / (2 * damping), rel=1e-3)  # the pole itself is rounded
    assert peak == pytest.approx(frequency, rel=1e-6)


def test_static_gain_has_the_norm_of_its_matrix():
    D = np.array([[3.0, 0.0], [0.0, -4.0], [0.0, 0.0]])
    norm, frequency = hinf_norm(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((3, 0)), D)
    assert (norm, frequency) == (pytest.approx(4.0), 0.0)


def test_peak_at_infinite_frequency():
    norm, frequency = hinf_norm([[-2.0]], [[1.0]], [[-1.0]], [[1.0]])  # (s + 1)/(s + 2)
    assert norm == pytest.approx(1.0)
    assert frequency == np.inf


def test_uncoupled_resonances_the_highest_wins():
    parts = [oscillator(1.0, 0.05), oscillator(10.0, 0.001), oscillator(100.0, 0.002)]
    A, B, C, D = (linalg.block_diag(*matrices) for matrices in zip(*parts, strict=True))
    norm, frequency = hinf_norm(A, B, C, D)
    assert norm == pytest.approx(1 / (2 * 0.001 * np.sqrt(1 - 0.001**2)), rel=1e-8)
    assert frequency == pytest.approx(10.0, rel=1e-4)


@pytest.mark.parametrize(("pole", "peak"), [(0.5, 0.0), (-0.5, np.pi / 0.1)])
def test_discrete_first_order(pole, peak):
    norm, frequency = hinf_norm([[pole]], [[1.0]], [[1.0]], [[0.0]], dt=0.1)
    assert norm == pytest.approx(2.0, rel=1e-9)
    assert frequency == pytest.approx(peak)


def test_unstated_sample_time_counts_samples():
    assert hinf_norm([[-0.5]], [[1.0]], [[1.0]], [[0.0]], dt=True)[1] == pytest.approx(np.pi)


@pytest.mark.parametrize("dt", [None, 0.02])
@pytest.mark.parametrize(("n", "m", "p"), [(1, 1, 1), (3, 1, 3), (6, 4, 2), (12, 2, 5)])
def test_agrees_with_a_dense_grid(n, m, p, dt):
    random = np.random.default_rng(n)
    for _ in range(5):
        model = random_model(random, n, m, p, dt)
        top = 50.0 * np.abs(linalg.eigvals(model[0])).max() if dt is None else np.pi / dt
        grid = np.concatenate([[0.0], np.geomspace(1e-4 * top, top, 4000)])
        dense = largest_on_grid(model, grid, dt)
        dense = max(dense, linalg.norm(model[3], 2)) if dt is None else dense
        assert hinf_norm(*model, dt=dt)[0] == pytest.approx(dense, rel=1e-6)


def test_norm_is_reached_at_the_peak_frequency():
    random = np.random.default_rng(3)
    for _ in range(10):
        model = random_model(random, 5, 2, 3, direct=False)
        norm, frequency = hinf_norm(*model)
        response = frequency_response(*model, [1j * frequency])[0]
        assert linalg.norm(response, 2) == pytest.approx(norm, rel=1e-8)


def test_the_norm_does_not_see_a_change_of_state_and_scales_with_outputs():
    def norm(*model):
        return hinf_norm(*model)[0]

    random = np.random.default_rng(4)
    A, B, C, D = random_model(random, 4, 2, 3, direct=False)
    T = random.standard_normal((4, 4))
    changed = norm(T @ A @ linalg.inv(T), T @ B, C @ linalg.inv(T), D)
    assert changed == pytest.approx(norm(A, B, C, D), rel=1e-8)
    assert norm(A, B, -7 * C, D) == pytest.approx(7 * norm(A, B, C, D), rel=1e-9)


def test_unstable_model_names_its_pole():
    A = np.array([[0.3, 2.0], [-2.0, 0.3]])
    with pytest.raises(UnstableModelError, match=r"pole at 0\.3 ± 2j, outside the open left half"):
        hinf_norm(A, np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))
    with pytest.raises(UnstableModelError, match=r"pole at -1\.5, outside the open unit disc"):
        hinf_norm([[-1.5]], [[1.0]], [[1.0]], [[0.0]], dt=0.1)


def test_hidden_unstable_pole_and_pole_on_the_axis_are_refused():
    with pytest.raises(UnstableModelError, match="pole at 1,"):
        hinf_norm(np.diag([1.0, -1.0]), [[0.0], [1.0]], [[0.0, 1.0]], [[0.0]])
    with pytest.raises(UnstableModelError, match="pole at 0,"):
        hinf_norm([[0.0]], [[1.0]], [[1.0]], [[0.0]])


def test_bad_matrices_and_sample_times():
    with pytest.raises(ValueError, match="do not make a state-space model"):
        hinf_norm(np.eye(2), np.ones((3, 1)), np.ones((1, 2)), np.zeros((1, 1)))
    with pytest.raises(ValueError, match="B holds NaN"):
        hinf_norm([[-1.0]], [[np.nan]], [[1.0]], [[0.0]])
    with pytest.raises(ValueError, match=r"dt=-0\.1 is not a sample time"):
        hinf_norm([[0.5]], [[1.0]], [[1.0]], [[0.0]], dt=-0.1)


def test_difference_of_equal_models_is_small_but_not_zero():
    A, B, C, D = random_model(np.random.default_rng(6), 4, 1, 2, direct=False)
    norm, _ = hinf_norm(
        linalg.block_diag(A, A), np.vstack([B, B]), np.hstack([C, -C]), np.zeros_like(D)
    )
    assert norm <= 1e-8 * hinf_norm(A, B, C, D)[0]


def test_eigenvalues_that_do_not_converge_are_said(monkeypatch):
    def failing(*args):
        raise slycot.exceptions.SlycotArithmeticError("did not converge", 3)

    monkeypatch.setattr(slycot, "ab13dd", failing)
    with pytest.raises(ArithmeticError, match=r"cannot be computed: .* scale its states"):
        hinf_norm(*oscillator(1.0, 0.1))
