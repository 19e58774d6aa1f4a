"""Laws of models with all entries free, and of the coordinates in which they move."""

import numpy as np
import pytest
from conftest import random_stable

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.free_form import FreeForm, OutputNormal, free_form, product
from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure


def stable(rng, n):
    return random_stable(rng, n, 1, 1)[0]


def form_of(n, n_outputs, n_inputs, n_phases=1, harmonics=0):
    shape = (2 * harmonics + 1, n + n_outputs, n + n_inputs)
    return Form(
        PeriodicStructure(np.zeros(shape), np.zeros((0, np.prod(shape))), n, ()),
        1.0,
        n_phases,
        discrete=True,
    )


def innovations(rng, n, n_outputs, n_samples, *, noise=0.1, root=None, gain=0.3, A=None):
    """A system, its K with a stable predictor, and a record."""
    A = stable(rng, n) if A is None else A
    B, C = rng.standard_normal((n, 1)), rng.standard_normal((n_outputs, n))
    K = gain * rng.standard_normal((n, n_outputs))
    while np.max(np.abs(np.linalg.eigvals(A - K @ C))) > 0.95:
        K = 0.8 * K
    root = np.eye(n_outputs) if root is None else root
    u, e = rng.standard_normal((n_samples, 1)), rng.standard_normal((n_samples, n_outputs))
    e = noise * e @ root.T
    y, x = np.zeros((n_samples, n_outputs)), rng.standard_normal(n)
    for k in range(n_samples):
        y[k] = C @ x + e[k]
        x = A @ x + B @ u[k] + K @ e[k]
    return (A, B, C, K), u, y


def whole(A, B, C):
    return np.block([[A, B], [C, np.zeros((len(C), B.shape[1]))]])[None]


def drives(n, n_outputs, n_inputs):
    """B and K free, D zero."""
    free = np.zeros((1, n + n_outputs, n + n_inputs), dtype=bool)
    free[:, :n, n:] = True
    return free


@pytest.mark.parametrize(("n", "n_outputs"), [(1, 1), (2, 1), (3, 2), (4, 3), (2, 4)])
def test_coordinates_move_stable_models_and_all_that_similarities_do_not(rng, n, n_outputs):
    A, C = stable(rng, n), rng.standard_normal((n_outputs, n))
    chart = OutputNormal.of(A, C)
    own = chart.columns[0]
    markov = [C @ np.linalg.matrix_power(A, k) for k in range(2 * n)]
    again = [own[n:] @ np.linalg.matrix_power(own[:n], k) for k in range(2 * n)]
    gram = [a.T @ b for a, b in zip(markov, markov, strict=True)]
    assert np.allclose(np.linalg.eigvals(own[:n]).sum(), np.linalg.eigvals(A).sum())
    state = np.linalg.lstsq(np.vstack(again), np.vstack(markov), rcond=None)[0]
    assert np.allclose(np.vstack(again) @ state, np.vstack(markov), atol=1e-9 * np.max(gram))
    # tangents and similarities together are all directions
    turned = [
        np.vstack([own[:n] @ T - T @ own[:n], own[n:] @ T]).ravel()
        for T in np.eye(n * n).reshape(-1, n, n)
    ]
    everything = np.vstack([chart.tangents.reshape(n * n_outputs, -1), turned])
    assert np.linalg.matrix_rank(everything) == n * (n + n_outputs)
    for size in (0.1, 1.0, 10.0):
        moved = chart.moved(size * rng.standard_normal(n * n_outputs))
        assert np.max(np.abs(np.linalg.eigvals(moved.columns[0, :n]))) <= 1.0 + 1e-7
        assert np.allclose(moved.frame.T @ moved.across, 0.0, atol=1e-12)


def test_walls_are_slopes_of_the_sizes_of_eigenvalues_on_the_unit_circle(rng):
    A = np.zeros((3, 3))
    A[:2, :2], A[2, 2] = [[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]], 0.5
    chart = OutputNormal.of(A, rng.standard_normal((2, 3)))
    (wall,) = chart.walls
    step = 1e-6 * rng.standard_normal(len(wall))
    step *= -np.sign(wall @ step)
    change = np.max(np.abs(np.linalg.eigvals(chart.moved(step).columns[0, :3]))) - 1.0
    assert change == pytest.approx(wall @ step, rel=1e-3)
    assert len(OutputNormal.of(0.9 * A, np.ones((1, 3))).walls) == 0


@pytest.mark.parametrize("correlated", [True, False])
def test_slopes_are_those_of_the_likelihood_with_all_else_at_its_optimum(rng, correlated):
    (A, _, C, K), u, y = innovations(rng, 3, 2, 300, root=np.array([[1.0, 0.0], [0.9, 0.2]]))
    inputs = np.hstack([u, y]) if correlated else u
    form = form_of(3, 2, inputs.shape[1])
    problem = likelihood_problem(form, [(inputs, y, 0)], correlated=correlated)
    family = FreeForm(problem, drives(3, 2, inputs.shape[1]))
    model = family.model(OutputNormal.of(A - 0.5 * K @ C, C).moved(0.1 * np.ones(6)))
    count = int(family.drives.sum())
    R = model.problem.linearise(model.point).R[count:, count:]
    slope, h = R[:, :-1].T @ R[:, -1], 1e-5
    found = [
        family.model(model.chart.moved(h * d)).point.cost
        - family.model(model.chart.moved(-h * d)).point.cost
        for d in np.eye(6)
    ]
    assert np.allclose(
        slope, np.array(found) / (2 * h), rtol=1e-4, atol=1e-4 * np.max(np.abs(slope))
    )


@pytest.mark.slow
def test_without_noise_the_machine_is_found(rng):
    (A, B, C, _), u, y = innovations(rng, 3, 2, 200, noise=0.0)
    start = whole(0.9 * A + 0.02, B, C)
    fit = free_form(form_of(3, 2, 1), [(u, y, 0)], start, start[:, :, 3:] != 0, predicts=False)
    found = fit.coefficients[0]
    assert np.allclose(
        np.sort(np.linalg.eigvals(found[:3, :3])), np.sort(np.linalg.eigvals(A)), atol=1e-6
    )
    for k in range(5):
        own = found[3:, :3] @ np.linalg.matrix_power(found[:3, :3], k) @ found[:3, 3:]
        assert np.allclose(own, C @ np.linalg.matrix_power(A, k) @ B, atol=1e-6)


def test_nothing_moves_the_cost_of_the_truth_much_and_the_optimum_is_below_it(rng):
    """2 (cost of the truth − cost) is chi-squared of as many degrees as there are parameters."""
    root = np.array([[1.0, 0.0], [0.8, 0.6]])
    (A, B, C, K), u, y = innovations(rng, 2, 2, 3000, root=root)
    free = np.zeros((1, 4, 1), dtype=bool)
    free[:, :2] = True
    fit = free_form(form_of(2, 2, 1), [(u, y, 0)], whole(A, B, C), free, gain=K[None])
    x, left = np.linalg.lstsq(np.eye(2), np.zeros(2), rcond=None)[0], np.zeros((3000, 2))
    for k in range(3000):
        left[k] = y[k] - C @ x
        x = A @ x + B @ u[k] + K @ left[k]
    S = left[50:].T @ left[50:] / 2950
    truth = 0.5 * 2950 * np.linalg.slogdet(S)[1]
    own = 0.5 * 2950 * np.linalg.slogdet(fit.result.spread)[1]
    n_parameters = 2 * 2 + 2 + 2 * 2 + 2 + 3  # l n, B, K, x0, S
    assert fit.result.n_parameters == n_parameters
    assert abs(truth - own) < 40.0
    assert np.allclose(fit.result.spread, 0.01 * root @ root.T, rtol=0.15)


@pytest.mark.slow
def test_records_may_be_cut_where_states_are_known(rng):
    """Units of signals and the number of records do not change what is found."""
    (A, B, C, K), u, y = innovations(rng, 2, 2, 2000)
    free = np.zeros((1, 4, 1), dtype=bool)
    free[:, :2] = True
    form, start = form_of(2, 2, 1), whole(A, B, C)
    one = free_form(form, [(u, y, 0)], start, free, gain=K[None])
    scale = np.array([1e3, 1e-4])
    other = start.copy()
    other[:, 2:] *= scale[:, None]
    units = free_form(form, [(1e-3 * u, scale * y, 0)], other, free, gain=K[None] / scale)
    assert np.allclose(
        units.result.spread, one.result.spread * scale[:, None] * scale, rtol=1e-5, atol=0.0
    )
    two = free_form(
        form, [(u[:1000], y[:1000], 0), (u[1000:], y[1000:], 0)], start, free, gain=K[None]
    )
    poles = [
        np.sort_complex(np.linalg.eigvals(fit.coefficients[0, :2, :2])) for fit in (one, units, two)
    ]
    assert np.allclose(poles[0], poles[1], atol=1e-4)
    assert np.allclose(poles[0], poles[2], atol=1e-2)


def test_no_gain_is_taken_where_only_sensors_are_noisy(rng):
    (A, B, C, _), u, y = innovations(rng, 2, 1, 1000, gain=0.0)
    free = np.zeros((1, 3, 1), dtype=bool)
    free[:, :2] = True
    fit = free_form(form_of(2, 1, 1), [(u, y, 0)], whole(A, B, C), free)
    assert fit.gain is None
    (A, B, C, _), u, y = innovations(rng, 2, 1, 1000, gain=1.0)
    fit = free_form(form_of(2, 1, 1), [(u, y, 0)], whole(A, B, C), free)
    assert fit.gain.shape == (1, 2, 1)


def test_products_of_periodic_matrices_are_those_of_their_values(rng):
    left, right = rng.standard_normal((5, 2, 3)), rng.standard_normal((3, 3, 2))
    psi = rng.uniform(0.0, 6.0, 7)
    values = evaluate_harmonics(left, psi) @ evaluate_harmonics(right, psi)
    assert np.allclose(evaluate_harmonics(product(left, right), psi), values)
