"""B and D of unstable models, whose records fall into many short pieces."""

import numpy as np
import pytest
from conftest import random_stable

from sklearn_hd.algorithms import input_matrices as module
from sklearn_hd.algorithms import short_pieces
from sklearn_hd.algorithms.input_matrices import input_matrices, pieces_of
from sklearn_hd.algorithms.simulation import propagate
from sklearn_hd.algorithms.two_sided import products_of_pieces

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


def test_without_noise_products_are_refused(rng, monkeypatch):
    A, B, C, D = unstable(rng, 3, 1.3)
    u, y = rng.standard_normal((3000, 2)), np.empty((3000, 3))
    for _, rows in pieces_of(A, [len(u)])[0]:
        y[rows] = propagate(A, u[rows] @ B.T, rng.standard_normal(3)) @ C.T + u[rows] @ D.T
    found = []

    def watched(*arguments):
        found.append(products_of_pieces(*arguments))
        return found[-1]

    monkeypatch.setattr(module, "products_of_pieces", watched)
    input_matrices(A, C, [u], [y], True)
    assert found == [None]


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
