"""B and D of unstable models, whose records fall into many short pieces."""

import numpy as np
import pytest
from conftest import random_stable

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace import input_matrices as module
from sklearn_hd.algorithms.subspace import short_pieces
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices, pieces_of
from sklearn_hd.algorithms.subspace.running_equations import input_matrices_of_sums
from sklearn_hd.algorithms.subspace.running_products import correlations

GROWN = 1e-5  # rounding of responses that grow e²⁰ times within a piece


def one_by_one(monkeypatch):
    monkeypatch.setattr(module, "is_short", lambda *_: False)
    orthogonal_only(monkeypatch)


def orthogonal_only(monkeypatch):
    monkeypatch.setattr(module, "products_of_pieces", lambda *_: None)


def unstable(rng, n, radius):
    A = random_stable(rng, n, 2, 3)[0]
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    return A, rng.standard_normal((n, 2)), rng.standard_normal((3, n)), rng.standard_normal((3, 2))


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("radius", [1.2, 1.5, 4.0])  # fewer pieces than entries of one, and more
@pytest.mark.parametrize("ways", ["products", "orthogonal"])
def test_pieces_found_together_are_those_one_by_one(rng, monkeypatch, ways, radius, feedthrough):
    if ways == "orthogonal":
        orthogonal_only(monkeypatch)
    A, _, C, _ = unstable(rng, 4, radius)
    u = [rng.standard_normal((n, 2)) for n in (2000, 130, 3)]
    y = [rng.standard_normal((len(z), 3)) for z in u]
    scales = np.array([2.0, 0.3]), np.array([1.0, 5.0, 0.1])
    assert len(pieces_of(A, [2000])[0]) > module.FEWEST
    found = input_matrices(A, C, u, y, feedthrough, scales=scales, return_residual=True)
    one_by_one(monkeypatch)
    expected = input_matrices(A, C, u, y, feedthrough, scales=scales, return_residual=True)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=GROWN, atol=GROWN * np.max(np.abs(other)))


@pytest.mark.parametrize("radius", [1.1, 1.5])
def test_an_unstable_model_without_noise_is_given_back(rng, radius):
    A, B, C, D = unstable(rng, 5, radius)
    u, y = rng.standard_normal((4000, 2)), np.empty((4000, 3))
    pieces, _ = pieces_of(A, [len(u)])
    starts = rng.standard_normal((len(pieces), 5))  # anew, or it would overflow
    for x0, (_, rows) in zip(starts, pieces, strict=True):
        y[rows] = propagate(A, u[rows] @ B.T, x0) @ C.T + u[rows] @ D.T
    found = input_matrices(A, C, [u], [y], True)
    for one, other in zip(found, (B, D, starts[:1]), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def all_equations(pieces, u, y, A, C):
    """All equations at once, in extended precision, initial states projected out."""
    rows, n = [], len(A)
    for _, own in pieces:
        length = own.stop - own.start
        free = np.zeros((length, len(C), n), np.longdouble)
        forced = np.zeros((*free.shape, u.shape[1]), np.longdouble)
        free[0] = C
        for k in range(1, length):
            free[k] = free[k - 1] @ A.astype(np.longdouble)
        for k in range(length - 1):
            forced[k + 1 :] += free[: length - 1 - k][..., None] * u[own][k]
        beside = orthonormal(free.reshape(-1, n))
        left = np.hstack([forced.reshape(len(beside), -1), y[own].reshape(-1, 1)])
        for _ in range(3):
            left -= beside @ (beside.T @ left)
        rows.append(left)
    return np.vstack(rows)


def orthonormal(X):
    Q = np.zeros_like(X)
    for k in range(X.shape[1]):
        v = X[:, k]
        for _ in range(3):
            v = v / np.sqrt(v @ v)
            v = v - Q[:, :k] @ (Q[:, :k].T @ v)
        Q[:, k] = v / np.sqrt(v @ v)
    return Q


@pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="long double is double here")
@pytest.mark.parametrize("radius", [1.2, 4.0])
def test_products_are_as_exact_as_extended_precision_tells(rng, radius):
    A, _, C, _ = unstable(rng, 4, radius)
    u, y = rng.standard_normal((600, 2)), rng.standard_normal((600, 3))
    equations = all_equations(pieces_of(A, [600])[0], u, y, A, C)
    Q = orthonormal(equations[:, :-1])
    B, _, _ = input_matrices(A, C, [u], [y], False)
    residual = equations[:, -1] - equations[:, :-1] @ B.reshape(-1)
    off = Q.T @ residual  # of the least-squares solution this is zero
    assert np.max(np.abs(off)) < 1e-9 * np.sqrt(residual @ residual)


@pytest.mark.parametrize("size", [0.0, 1e-6])
def test_without_noise_products_are_corrected(rng, monkeypatch, size):
    """Sums alone are right to 1e-12 or so of the outputs, which grow to 1e8."""
    A, B, C, D = unstable(rng, 3, 1.3)
    u, y = rng.standard_normal((3000, 2)), np.empty((3000, 3))
    for _, rows in pieces_of(A, [len(u)])[0]:
        x0 = 1e-6 * rng.standard_normal(3)
        y[rows] = propagate(A, u[rows] @ B.T, x0) @ C.T + u[rows] @ D.T
    y += size * rng.standard_normal(y.shape)
    found = input_matrices(A, C, [u], [y], True, return_residual=True)
    one_by_one(monkeypatch)
    expected = input_matrices(A, C, [u], [y], True, return_residual=True)
    off = max(1e-17 * np.max(np.abs(y)), size)
    for one, other in zip(found[:2], (B, D), strict=True):
        np.testing.assert_allclose(one, other, atol=10.0 * off)
    np.testing.assert_allclose(found[2], expected[2], atol=100.0 * off)
    if size:
        assert found[3] == pytest.approx(expected[3], rel=0.02)


def test_short_records_of_an_unstable_model_have_starts_of_their_own(rng, monkeypatch):
    A, _, C, _ = unstable(rng, 3, 1.3)
    u = [rng.standard_normal((n, 2)) for n in (300, 20, 300)]
    y = [rng.standard_normal((len(z), 3)) for z in u]
    found = input_matrices(A, C, u, y, False)
    one_by_one(monkeypatch)
    for one, other in zip(found, input_matrices(A, C, u, y, False), strict=True):
        np.testing.assert_allclose(one, other, rtol=GROWN, atol=GROWN * np.max(np.abs(other)))


@pytest.mark.parametrize("radius", [0.9, 1.3])
def test_states_that_outputs_hardly_see_change_nothing(rng, radius):
    """As those of an order too high, without noise: sums and products take them as they are."""
    A, _, C, _ = unstable(rng, 4, radius)
    size = np.array([1.0, 1.0, 1e-7, 1e-9])
    weak = A * (size / size[:, None]), C * size
    u, y = rng.standard_normal((3000, 2)), rng.standard_normal((3000, 3))
    scales = np.ones(2), np.ones(3)
    if radius < 1.0:
        sums = correlations([(u, y)])
        found = [input_matrices_of_sums(*model, sums, True, scales) for model in ((A, C), weak)]
    else:
        found = [input_matrices(*model, [u], [y], True, scales=scales) for model in ((A, C), weak)]
    units = 1.0 / size[:, None], 1.0, 1.0 / size
    for one, other, unit in zip(*found, units, strict=True):
        np.testing.assert_allclose(one, other / unit, rtol=1e-9, atol=1e-9)


def test_states_that_are_not_seen_take_no_equations(rng, monkeypatch):
    A = np.diag([1.3, 0.5, 1.2])
    C = np.array([[1.0, 2.0, 0.0]])
    u, y = rng.standard_normal((1500, 1)), rng.standard_normal((1500, 1))
    B, D, _ = input_matrices(A, C, [u], [y], True)
    one_by_one(monkeypatch)
    expected = input_matrices(A, C, [u], [y], True)
    np.testing.assert_allclose(B, expected[0], atol=1e-8)
    np.testing.assert_allclose(D, expected[1], atol=1e-8)


@pytest.mark.parametrize("ways", ["products", "orthogonal"])
def test_rounds_of_equations_add_up(rng, monkeypatch, ways):
    if ways == "orthogonal":
        orthogonal_only(monkeypatch)
    A, _, C, _ = unstable(rng, 3, 1.3)
    u, y = rng.standard_normal((6000, 2)), rng.standard_normal((6000, 3))
    expected = input_matrices(A, C, [u], [y], True)
    monkeypatch.setattr(short_pieces, "ROUND_BYTES", 2**17)
    monkeypatch.setattr(module, "ROUND_BYTES", 2**14)
    for one, other in zip(input_matrices(A, C, [u], [y], True), expected, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
