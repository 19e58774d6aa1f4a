"""Laws of the weighted projections, of the predictor's subspace and of the Kalman gain."""

import numpy as np
import pytest
from conftest import random_stable, same_poles
from innovation_cases import disturbed, in_closed_loop
from scipy import linalg

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace.hankel import hankel_factor, n_hankel_columns
from sklearn_hd.algorithms.subspace.innovations import InnovationForm, gain_of_covariances
from sklearn_hd.algorithms.subspace.order import order_by_gap
from sklearn_hd.algorithms.subspace.projections import (
    PROJECTIONS,
    PredictorSubspace,
    Projection,
    rows_remembered,
)


def hankel(signal, start, block_rows, n_columns):
    """Block Hankel matrix of some rows, as its definition has it."""
    return np.vstack([signal[start + r : start + r + n_columns].T for r in range(block_rows)])


def off(rows, others):
    """Rows with the span of others projected out."""
    return rows - linalg.lstsq(others.T, rows.T)[0].T @ others


def record(rng, n=3, m=2, n_outputs=2, n_samples=300, noise=0.1):
    A, B, C = random_stable(rng, n, m, n_outputs)
    u = np.cumsum(rng.standard_normal((n_samples, m)), axis=0) * 0.1  # coloured
    u += rng.standard_normal(u.shape)
    y = propagate(A, u @ B.T, rng.standard_normal(n)) @ C.T
    return A, u, y + noise * rng.standard_normal(y.shape)


def blocks(u, y, i):
    j = n_hankel_columns([len(u)], i)
    past = np.vstack([hankel(u, 0, i, j), hankel(y, 0, i, j)])
    return hankel(u, i, i, j), past, hankel(y, i, i, j)


@pytest.mark.parametrize("weighting", PROJECTIONS)
def test_projections_are_what_their_definitions_say(rng, weighting):
    """Singular values and directions by explicit Hankel matrices (Van Overschee, De Moor, 1995)."""
    _, u, y = record(rng)
    i = 4
    U_f, W_p, Y_f = blocks(u, y, i)
    along = linalg.lstsq(np.vstack([W_p, U_f]).T, Y_f.T)[0].T[:, : len(W_p)]
    oblique = along @ W_p
    if weighting == "cva":
        root = linalg.sqrtm(off(Y_f, U_f) @ Y_f.T).real
        U, values, _ = linalg.svd(linalg.solve(root, off(oblique, U_f)), full_matrices=False)
        U = root @ U
        angles = linalg.subspace_angles(off(Y_f, U_f).T, off(W_p, U_f).T)
        np.testing.assert_allclose(np.sort(np.cos(angles)), np.sort(values), atol=1e-10)
    else:
        product = off(oblique, U_f) if weighting == "moesp" else oblique
        U, values, _ = linalg.svd(product, full_matrices=False)
    R = hankel_factor([u], [y], i)
    found = Projection.of(R, i, 2, n_hankel_columns([len(u)], i), weighting)
    np.testing.assert_allclose(found.singular_values, values, rtol=1e-8)
    first = found.directions[:, :3]
    np.testing.assert_allclose(np.abs(np.sum(first * U[:, :3], axis=0)), np.sum(first**2, axis=0))


def test_canonical_correlations_know_no_units_nor_mixtures_of_outputs(rng):
    _, u, y = record(rng)
    mixed = y @ np.array([[1e3, 2.0], [-5.0, 1e-2]])
    values = [
        Projection.of(hankel_factor([u], [signal], 4), 4, 2, 293, "cva").singular_values
        for signal in (y, mixed)
    ]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-6)


def decomposed(weighting, R, block_rows, n_inputs, n_columns):
    if weighting == "pbsid":
        return PredictorSubspace.of(R, block_rows, n_inputs, n_columns, False)
    return Projection.of(R, block_rows, n_inputs, n_columns, weighting)


@pytest.mark.parametrize("weighting", [*PROJECTIONS, "pbsid"])
def test_all_find_the_system_without_noise(rng, weighting):
    A, u, y = record(rng, noise=0.0)
    found = decomposed(weighting, hankel_factor([u], [y], 5), 5, 2, n_hankel_columns([len(u)], 5))
    order = order_by_gap(found.singular_values, found.floor, 8)
    assert order == 3
    assert same_poles(np.linalg.eigvals(found.state_matrices(3)[0]), np.linalg.eigvals(A), 1e-9)


@pytest.mark.parametrize("weighting", [*PROJECTIONS, "pbsid"])
@pytest.mark.parametrize("n_inputs", [0, 2])
def test_white_noise_stays_below_the_floor(rng, weighting, n_inputs):
    u, y = rng.standard_normal((4000, n_inputs)), rng.standard_normal((4000, 2))
    R = hankel_factor([u], [y], 8)
    found = decomposed(weighting, R, 8, n_inputs, n_hankel_columns([4000], 8))
    assert found.singular_values[0] < 1.05 * found.floor
    assert found.singular_values[0] > 0.6 * found.floor


def test_floor_of_correlations_beyond_the_columns():
    """More rows than columns: all correlations are one, and none stands out."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((60, 1)), rng.standard_normal((60, 1))
    found = Projection.of(hankel_factor([u], [y], 15), 15, 1, 31, "cva")
    assert found.floor == 1.0


# ---- noise ---------------------------------------------------------------------------------------


def test_gain_of_one_state_in_closed_form():
    """x[k+1] = a x + w, y = x + v: P² + (1 − a² − q) P − q = 0 for r = 1 (textbook Riccati)."""
    a, q = 0.7, 0.4
    K, E = gain_of_covariances(np.array([[a]]), np.eye(1), np.diag([q, 1.0]), np.ones(1))
    P = np.roots([1.0, 1.0 - a**2 - q, -q]).max()
    assert K.item() == pytest.approx(a * P / (P + 1.0), rel=1e-12)
    assert E.item() == pytest.approx(P + 1.0, rel=1e-12)


def test_gain_without_noise_leaves_a_stable_model_alone_and_mirrors_an_unstable_one():
    C = np.eye(1)
    for a, expected in ((0.5, 0.0), (2.0, 1.5)):  # A − K C = 1 / a where a is unstable
        K, _ = gain_of_covariances(np.array([[a]]), C, np.zeros((2, 2)), np.ones(1))
        assert K.item() == pytest.approx(expected, abs=1e-9)


def test_outputs_that_are_zero_have_no_gain():
    """Neither noise nor a size to compare it with: no 0 / 0."""
    K, E = gain_of_covariances(np.diag([0.5, 2.0]), np.zeros((1, 2)), np.zeros((3, 3)), np.zeros(1))
    assert K.tolist() == [[0.0], [0.0]]
    assert E.tolist() == [[0.0]]


def test_integrator_that_nothing_drives_is_no_obstacle():
    K, E = gain_of_covariances(np.eye(1), np.eye(1), np.diag([0.0, 1.0]), np.ones(1))
    assert 0.0 <= K.item() < 1e-3
    assert E.item() == pytest.approx(1.0, rel=1e-3)


def test_no_gain_holds_an_unstable_mode_that_is_not_seen():
    with pytest.raises(ValueError, match="growing mode that the outputs hardly"):
        gain_of_covariances(np.array([[2.0]]), np.zeros((1, 1)), np.eye(2), np.ones(1))


@pytest.mark.slow
@pytest.mark.parametrize("n_inputs", [0, 1])
@pytest.mark.parametrize("weighting", [*PROJECTIONS, "pbsid"])
def test_gain_of_a_long_record_is_that_of_the_system(rng, weighting, n_inputs):
    system = disturbed(rng, 3, n_inputs, 2)
    u, y, _ = system.simulate(rng, 60_000)
    R = hankel_factor([u], [y], 12)
    found = decomposed(weighting, R, 12, n_inputs, n_hankel_columns([len(u)], 12))
    if weighting == "pbsid":
        A, _, C, _, K, E = found.model(3)
    else:
        (A, C), (K, E) = found.state_matrices(3), found.kalman_gain(3)
    response = [C @ np.linalg.matrix_power(A, j) @ K for j in range(8)]
    wanted = system.markov(system.K)
    assert np.linalg.norm(response - wanted) < 0.06 * np.linalg.norm(wanted)
    np.testing.assert_allclose(E, system.E, atol=0.04 * np.linalg.norm(system.E))


# ---- the predictor -------------------------------------------------------------------------------


def test_predictor_of_the_true_system_leaves_its_innovations(rng):
    system, feedback = in_closed_loop()
    u, y, e = system.simulate(rng, 400, feedback=feedback)
    form = InnovationForm(system.A, system.B, system.C, np.zeros((1, 1)), system.K)
    np.testing.assert_allclose(y - form.ahead(u, y, np.zeros(3), 1), e, atol=1e-9)
    left = y - form.ahead(u, y, form.initial_state(u, y), 1)
    assert np.sum(left**2) < np.sum(e**2)


def test_predictions_two_ahead_know_nothing_of_the_last_output(rng):
    system = disturbed(rng, 2, 1, 1)
    u, y, e = system.simulate(rng, 200)
    form = InnovationForm(system.A, system.B, system.C, np.zeros((1, 1)), system.K)
    left = y - form.ahead(u, y, np.zeros(2), 2)
    lost = e.copy()
    lost[1:] += e[:-1] @ (system.C @ system.K).T
    np.testing.assert_allclose(left, lost, atol=1e-10)


def test_far_ahead_is_simulation(rng):
    system = disturbed(rng, 2, 1, 1)
    u, y, _ = system.simulate(rng, 50)
    form = InnovationForm(system.A, system.B, system.C, np.zeros((1, 1)), system.K)
    x0 = rng.standard_normal(2)
    free = propagate(system.A, u @ system.B.T, x0) @ system.C.T
    np.testing.assert_allclose(form.ahead(u, y, x0, 50), free, atol=1e-12)
    np.testing.assert_allclose(form.ahead(u, y, x0, 10**9), free, atol=1e-12)


def test_initial_state_without_noise_is_the_true_one(rng):
    A, B, C = random_stable(rng, 3, 1, 2)
    u, x0 = rng.standard_normal((80, 1)), rng.standard_normal(3)
    y = propagate(A, u @ B.T, x0) @ C.T
    gain = gain_of_covariances(A, C, np.eye(5), np.ones(2))[0]
    form = InnovationForm(A, B, C, np.zeros((2, 1)), gain)
    np.testing.assert_allclose(form.initial_state(u, y), x0, atol=1e-8)


def test_rows_remembered_grow_with_the_memory_of_the_predictor(rng):
    """An ARX model of p rows: Akaike's criterion finds p, give or take what it overfits."""
    rows = []
    for p in (1, 4, 9):
        u, e = rng.standard_normal((2, 20_000, 1))
        y = np.zeros((20_000, 1))
        for k in range(p, len(y)):
            y[k] = 0.6 * y[k - p] + u[k - 1] + e[k]
        R = hankel_factor([u], [y], 20)
        rows.append(rows_remembered(R, 20, 1, n_hankel_columns([len(u)], 20), False))
    assert all(p <= found <= p + 3 for p, found in zip((1, 4, 9), rows, strict=True))


@pytest.mark.parametrize("feedthrough", [False, True])
def test_predictor_subspace_is_exact_in_closed_loop_without_noise(rng, feedthrough):
    system, feedback = in_closed_loop()
    D = 0.5 * feedthrough
    x, before = np.array([0.1, -0.2, 0.3]), 0.0
    u, y = rng.standard_normal((400, 1)), np.empty((400, 1))
    for k in range(400):
        u[k] -= feedback[0] * before
        y[k] = system.C @ x + D * u[k]
        x, before = system.A @ x + system.B @ u[k], y[k]
    R = hankel_factor([u], [y], 6)
    columns = n_hankel_columns([400], 6)
    A, B, C, D_found, _, E = PredictorSubspace.of(R, 6, 1, columns, feedthrough).model(3)
    assert same_poles(np.linalg.eigvals(A), np.linalg.eigvals(system.A), 1e-9)
    assert D_found.item() == pytest.approx(D, abs=1e-10)
    for j in range(6):
        np.testing.assert_allclose(
            C @ np.linalg.matrix_power(A, j) @ B,
            system.C @ np.linalg.matrix_power(system.A, j) @ system.B,
            atol=1e-9,
        )
    assert E.item() < 1e-15


def test_equations_that_cannot_be_ordered_are_tried_with_more_noise(monkeypatch):
    """Where that happens is a matter of rounding; SciPy says so by a ValueError."""
    model = np.array([[0.5]]), np.eye(1), np.eye(2), np.ones(1)
    K, E = gain_of_covariances(*model)
    solve, calls = linalg.solve_discrete_are, []

    def fails_once(*args, **kwargs):
        calls.append(args)
        if len(calls) == 1:
            raise ValueError("Reordering of (A, B) failed")
        return solve(*args, **kwargs)

    monkeypatch.setattr(linalg, "solve_discrete_are", fails_once)
    again = gain_of_covariances(*model)
    assert len(calls) == 2
    np.testing.assert_allclose(again, (K, E), rtol=1e-6)
