"""Laws of the least squares for B, D and the initial states."""

import tracemalloc

import numpy as np
import pytest
from conftest import random_stable
from scipy import linalg

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace import input_matrices as module
from sklearn_hd.algorithms.subspace import responses
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices, response_regressors
from sklearn_hd.algorithms.subspace.responses import (
    output_normal,
    powers_of,
    response_basis,
    run,
)

JORDAN = linalg.block_diag([[0.98, 1.0], [0.0, 0.98]], [[0.6, 0.4], [-0.4, 0.6]], -0.3)
SPLIT = JORDAN + np.diag([0.0, 1e-7, 0.0, 0.0, 0.0])
TWINS = np.diag([0.9, 0.9, 0.5, 0.5, -0.2])
SLOW = np.diag([0.99999, 0.9, 0.2, -0.7, 0.4])
INTEGRATOR = np.diag([1.0, 0.9, 0.2, -0.7, 0.4])


def model(rng, A, feedthrough, m=2, n_outputs=3):
    n = len(A)
    T = linalg.qr(rng.standard_normal((n, n)))[0]
    D = rng.standard_normal((n_outputs, m)) * feedthrough
    return T @ A @ T.T, rng.standard_normal((n, m)), rng.standard_normal((n_outputs, n)), D


def simulate(A, B, C, D, u, x0):
    return propagate(A, u @ B.T, x0) @ C.T + u @ D.T


def dense(A, C, inputs, outputs, feedthrough):
    """The whole least-squares problem at once: B, D and every initial state."""
    n, m, count = len(A), inputs[0].shape[1], len(inputs)
    rows = []
    for s, u in enumerate(inputs):
        free, forced = response_regressors(A, C, u, feedthrough)
        own = np.zeros((*free.shape[:2], n * count))
        own[..., n * s : n * (s + 1)] = free
        rows.append(
            np.concatenate([forced, own], axis=-1).reshape(-1, forced.shape[-1] + n * count)
        )
    X, y = np.vstack(rows), np.concatenate([y.reshape(-1) for y in outputs])
    theta, rest = linalg.lstsq(X, y)[:2]
    n_forced = X.shape[1] - n * count
    D = theta[n * m : n_forced].reshape(-1, m) if feedthrough else np.zeros((len(C), m))
    return theta[: n * m].reshape(n, m), D, theta[n_forced:].reshape(count, n), float(rest)


def orthogonal_only(monkeypatch):
    monkeypatch.setattr(module, "_product_factor", lambda *_: None)


@pytest.mark.parametrize("ways", ["products", "orthogonal"])
@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("A", [JORDAN, SPLIT, TWINS, SLOW, INTEGRATOR], ids=str)
def test_records_give_the_least_squares_solution(rng, monkeypatch, A, feedthrough, ways):
    """Long records beside short ones; noise, so that all weights count."""
    if ways == "orthogonal":
        orthogonal_only(monkeypatch)
    A, B, C, D = model(rng, A, feedthrough)
    inputs = [rng.standard_normal((n, 2)) for n in (3003, 40, 2000)]
    starts = rng.standard_normal((3, 5))
    outputs = [simulate(A, B, C, D, u, x) for u, x in zip(inputs, starts, strict=True)]
    outputs = [y + 0.1 * rng.standard_normal(y.shape) for y in outputs]
    found = input_matrices(A, C, inputs, outputs, feedthrough, return_residual=True)
    for one, other in zip(found, dense(A, C, inputs, outputs, feedthrough), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("A", [TWINS, 0.9 * INTEGRATOR], ids=str)
def test_one_record_is_solved_by_its_own_factor(rng, monkeypatch, A, feedthrough):
    """Where its normal equations are safe, without the equations left for other records."""
    A, B, C, D = model(rng, A, feedthrough)
    u = rng.standard_normal((1500, 2))
    y = simulate(A, B, C, D, u, rng.standard_normal(5)) + 0.1 * rng.standard_normal((1500, 3))
    expected = dense(A, C, [u], [y], feedthrough)
    monkeypatch.setattr(module, "_without_start", None)
    found = input_matrices(A, C, [u], [y], feedthrough, return_residual=True)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-8)
    for one, other in zip(input_matrices(A, C, [u], [y], feedthrough), found[:3], strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("A", [JORDAN, TWINS, SLOW], ids=str)
def test_records_without_noise_give_the_model_back(rng, A):
    A, B, C, D = model(rng, A, True)
    u, x0 = rng.standard_normal((4000, 2)), rng.standard_normal(5)
    y = simulate(A, B, C, D, u, x0)
    found = input_matrices(A, C, [u], [y], True, return_residual=True)
    responses = [simulate(A, b, C, d, u[:300], x[0]) for b, d, x in [found[:3]]]
    np.testing.assert_allclose(responses[0], y[:300], atol=1e-9 * np.abs(y).max())
    np.testing.assert_allclose(found[1], D, atol=1e-9)
    assert found[3] < (1e-10 * linalg.norm(y)) ** 2


def test_powers_are_those_of_the_basis(rng):
    """A^k in the numbers of the basis: F^k g, for eigenvalues that no diagonal form parts."""
    A, _, _, _ = model(rng, JORDAN, False)
    basis = response_basis(A)
    assert len(basis.g) == 5
    for k in (0, 1, 7, 60):
        numbers = np.linalg.matrix_power(basis.F, k) @ basis.g
        np.testing.assert_allclose(powers_of(basis.F, k)[k] @ basis.g, numbers, atol=1e-12)
        power = np.einsum("sij,s->ij", basis.units, numbers)
        np.testing.assert_allclose(power, np.linalg.matrix_power(A, k), atol=1e-9)


@pytest.mark.parametrize("steps", [2, 3, 16, 100])
def test_the_recursion_is_the_same_in_any_steps(rng, monkeypatch, steps):
    monkeypatch.setattr(responses, "STEPS", steps)
    F = random_stable(rng, 4, 1, 1)[0]
    forcing, start = rng.standard_normal((83, 2, 4)), rng.standard_normal((2, 4))
    expected = [start]
    for v in forcing:
        expected.append(expected[-1] @ F.T + v)
    x = np.zeros((83, 2, 9))[..., 2:6]  # in place in what is wider
    x[:] = forcing
    last = run(F, x, start)
    np.testing.assert_allclose(x, expected[:-1], atol=1e-12)
    np.testing.assert_allclose(last, expected[-1], atol=1e-12)


def test_eigenvalues_too_many_to_part_have_no_basis():
    assert response_basis(np.eye(8, k=1) + 0.5 * np.eye(8)) is None


def test_a_static_gain_needs_no_states(rng):
    u = rng.standard_normal((2000, 2))
    D = rng.standard_normal((1, 2))
    B, found, x0 = input_matrices(np.zeros((0, 0)), np.zeros((1, 0)), [u], [u @ D.T], True)
    np.testing.assert_allclose(found, D, atol=1e-12)
    assert B.shape == (0, 2)
    assert x0.shape == (1, 0)


@pytest.mark.parametrize("observed", [False, True])
@pytest.mark.parametrize("parted", [False, True])
def test_chunks_give_the_same_as_all_rows_at_once(rng, monkeypatch, parted, observed):
    A, B, C = random_stable(rng, 4, 2, 3)
    u = rng.standard_normal((900, 2))
    y = simulate(A, B, C, np.zeros((3, 2)), u, rng.standard_normal(4))
    observe = None
    if observed:
        observe = [rng.standard_normal((900, 1, 3))]
        y = np.einsum("kqo,ko->kq", observe[0], y)
    y = y + 0.1 * rng.standard_normal(y.shape)
    orthogonal_only(monkeypatch)
    whole = input_matrices(A, C, [u], [y], True, observe, return_residual=True)
    monkeypatch.setattr(module, "CHUNK_BYTES", 0)
    if not parted:
        monkeypatch.setattr(module, "response_basis", lambda _: None)
    for one, other in zip(
        input_matrices(A, C, [u], [y], True, observe, return_residual=True), whole, strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


def test_scales_weigh_outputs_and_units_of_inputs_alike(rng):
    A, B, C = random_stable(rng, 4, 2, 3)
    for n in (300, 3000):
        u = rng.standard_normal((n, 2))
        y = simulate(A, B, C, np.zeros((3, 2)), u, np.zeros(4)) + rng.standard_normal((n, 3))
        scales = np.array([1e-3, 7.0]), np.array([1e3, 1.0, 0.3])
        expected = input_matrices(A, C, [u / scales[0]], [y / scales[1]], True)
        for one, other in zip(
            input_matrices(A, C, [u], [y], True, scales=scales), expected, strict=True
        ):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_a_start_that_one_sample_cannot_tell_is_the_smallest(rng):
    A, B, C = random_stable(rng, 4, 1, 2)
    inputs = [rng.standard_normal((200, 1)), np.zeros((1, 1))]
    outputs = [simulate(A, B, C, np.zeros((2, 1)), inputs[0], np.ones(4)), np.ones((1, 2))]
    B_found, _, x0 = input_matrices(A, C, inputs, outputs, False)
    np.testing.assert_allclose(B_found, B, atol=1e-9)
    np.testing.assert_allclose(C @ x0[1], np.ones(2), atol=1e-9)
    assert linalg.norm(x0[1]) < 10 * linalg.norm(linalg.pinv(C) @ np.ones(2))


def test_no_equation_as_long_as_the_record_is_kept(rng):
    A, B, C = random_stable(rng, 6, 2, 2)
    u = rng.standard_normal((100_000, 2))
    y = simulate(A, B, C, np.zeros((2, 2)), u, np.zeros(6)) + rng.standard_normal((100_000, 2))
    tracemalloc.start()
    input_matrices(A, C, [u], [y], True)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * y.size * (6 * 2 + 2 * 2 + 6) / 5


@pytest.mark.parametrize("rows_in_a_round", [responses.ROUND, 256])
@pytest.mark.parametrize("n_samples", [2, 7, 300, 3001])
@pytest.mark.parametrize("A", [JORDAN, TWINS, SLOW], ids=str)
def test_normal_equations_are_those_of_all_rows(rng, monkeypatch, A, n_samples, rows_in_a_round):
    """To the last digits beside the lengths of columns, for any length of record."""
    monkeypatch.setattr(responses, "ROUND", rows_in_a_round)
    A, _, C, _ = model(rng, A, True)
    u, y = rng.standard_normal((n_samples, 2)), rng.standard_normal((n_samples, 3))
    scales = np.array([2.0, 0.1]), np.array([1.0, 3.0, 0.5])
    normal = output_normal(A, C)
    products = responses.response_products(normal.basis, u, y, scales)
    G, rounding = responses.normal_equations(normal, products, True)
    free, forced = response_regressors(normal.A, normal.C, u / scales[0], True)
    rows = np.concatenate([free, forced, (y / scales[1])[..., None]], axis=-1)
    rows = rows.reshape(-1, rows.shape[-1])
    expected = rows.T @ rows
    size = np.sqrt(np.diagonal(expected))
    off = np.triu(G - expected) / np.outer(size, size)
    assert np.max(np.abs(off)) < max(rounding, 1e-13)


@pytest.mark.parametrize("A", [INTEGRATOR, 1.01 * INTEGRATOR], ids=str)
def test_models_that_keep_everything_have_no_output_normal_coordinates(rng, A):
    assert output_normal(A, rng.standard_normal((2, 5))) is None


def test_models_that_show_less_than_all_states_have_no_output_normal_coordinates():
    assert output_normal(np.diag([0.5, 0.2]), np.array([[1.0, 0.0]])) is None


def test_records_without_noise_are_not_squared(rng):
    """Their last column is zero but for rounding: products in double would not show it."""
    A, B, C, D = model(rng, JORDAN, True)
    u = rng.standard_normal((3000, 2))
    y = simulate(A, B, C, D, u, np.zeros(5))
    scales = np.ones(2), np.ones(3)
    normal = output_normal(A, C)
    assert module._product_factor(normal, u, y, True, scales) is None
    noisy = y + rng.standard_normal(y.shape)
    assert module._product_factor(normal, u, noisy, True, scales) is not None


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_coordinates_are_output_normal_for_more_outputs_than_states_and_fewer(rng, n):
    A, _, C = random_stable(rng, n, 1, 3)
    model = output_normal(A, C)
    np.testing.assert_allclose(model.A.T @ model.A + model.C.T @ model.C, np.eye(n), atol=1e-14)
    np.testing.assert_allclose(model.A @ model.T, model.T @ A, atol=1e-12 * linalg.norm(model.T))
    np.testing.assert_allclose(model.C @ model.T, C, atol=1e-12 * linalg.norm(C))


@pytest.mark.parametrize("radius", [0.9, 1.0, 1.3])
@pytest.mark.parametrize("n_inputs", [0, 2])
def test_records_without_rows_say_nothing(rng, radius, n_inputs):
    A, C = radius * np.eye(2), rng.standard_normal((1, 2))
    inputs = [rng.standard_normal((n, n_inputs)) for n in (80, 0, 33)]
    outputs = [rng.standard_normal((len(u), 1)) for u in inputs]
    B, D, x0 = input_matrices(A, C, inputs, outputs, True)
    expected = input_matrices(A, C, inputs[::2], outputs[::2], True)
    for found, each in zip((B, D, x0[::2]), expected, strict=True):
        np.testing.assert_allclose(found, each, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(x0[1], 0.0)


# ---- unstable models, whose records fall into short pieces -----------------------------------


def grown(rng, n, radius):
    A = random_stable(rng, n, 2, 3)[0]
    return A * (radius / np.max(np.abs(np.linalg.eigvals(A))))


@pytest.mark.parametrize("radius", [1.1, 1.5])
def test_an_unstable_model_without_noise_is_given_back(rng, radius):
    A, B, C, D = model(rng, grown(rng, 5, radius), True)
    u, y = rng.standard_normal((4000, 2)), np.empty((4000, 3))
    pieces, _ = module.pieces_of(A, [len(u)])
    starts = rng.standard_normal((len(pieces), 5))  # anew, or it would overflow
    for x0, (_, rows) in zip(starts, pieces, strict=True):
        y[rows] = simulate(A, B, C, D, u[rows], x0)
    found = input_matrices(A, C, [u], [y], True)
    for one, other in zip(found, (B, D, starts[:1]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_states_that_outputs_hardly_see_change_nothing(rng):
    """As those of an order too high, without noise."""
    A, _, C, _ = model(rng, grown(rng, 4, 1.3), True)
    size = np.array([1.0, 1.0, 1e-7, 1e-9])
    u, y = rng.standard_normal((3000, 2)), rng.standard_normal((3000, 3))
    found = input_matrices(A, C, [u], [y], True)
    weak = input_matrices(A * (size / size[:, None]), C * size, [u], [y], True)
    for one, other, unit in zip(found, weak, (size[:, None], 1.0, size), strict=True):
        np.testing.assert_allclose(one, other * unit, rtol=1e-7, atol=1e-7)


def test_states_that_are_not_seen_take_no_equations(rng):
    A, C = np.diag([1.3, 0.5, 1.2]), np.array([[1.0, 2.0, 0.0]])
    u, y = rng.standard_normal((1500, 1)), rng.standard_normal((1500, 1))
    B, D, _ = input_matrices(A, C, [u], [y], True)
    expected = input_matrices(A[:2, :2], C[:, :2], [u], [y], True)
    np.testing.assert_allclose(B[:2], expected[0], atol=1e-8)
    np.testing.assert_allclose(D, expected[1], atol=1e-8)
