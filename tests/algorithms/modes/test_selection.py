"""The best set of modes is the best of all sets."""

import itertools

import numpy as np
import pytest

from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.modes import families as kernel
from sklearn_hd.algorithms.modes.families import (
    best_modes,
    mode_regressors,
    residual,
    unit_regressors,
)


@pytest.mark.parametrize("exponent", [-0.7 + 0j, -0.4 + 3.0j])
def test_regressors_span_the_response_of_the_mode(rng, exponent):
    """Any response of the mode, driven from any state, is a combination of them."""
    dt, u = 0.05, rng.standard_normal((80, 2))
    z = np.exp(exponent * dt)
    A = np.array([[z.real, z.imag], [-z.imag, z.real]]) if exponent.imag else np.array([[z.real]])
    shape = rng.standard_normal(3) + (1j * rng.standard_normal(3) if exponent.imag else 0)
    C = np.column_stack([shape.real, shape.imag]) if exponent.imag else shape.real[:, None]
    x = propagate(A, u @ rng.standard_normal((2, len(A))), rng.standard_normal(len(A)))
    y = (x @ C.T).reshape(-1)
    X = mode_regressors(exponent, shape, u, dt)[0].reshape(len(y), -1)
    solution = np.linalg.lstsq(X, y, rcond=None)[0]
    np.testing.assert_allclose(X @ solution, y, atol=1e-9)


def test_pieces_of_a_record_give_the_factor_of_the_whole(rng, monkeypatch):
    """Of segments with initial amplitudes of their own, which no other segment's columns see."""
    units, exponents = [(0,), (1, 2)], np.array([-0.7, -0.4 + 3.0j, -0.4 - 3.0j])
    shapes = rng.standard_normal((3, 2)) + 0j
    inputs = [rng.standard_normal((n, 1)) for n in (300, 7, 200)]
    outputs, observe = ([rng.standard_normal((len(u), 2, *w)) for u in inputs] for w in ((), (2,)))
    given = units, exponents, shapes, inputs, outputs, 0.05, observe
    whole, columns = unit_regressors(*given)
    monkeypatch.setattr(kernel, "PIECE", 0)
    pieces, same = unit_regressors(*given)
    assert [c.tolist() for c in columns] == [c.tolist() for c in same]
    np.testing.assert_allclose(pieces.T @ pieces, whole.T @ whole, rtol=1e-9, atol=1e-9)
    responses = [
        [mode_regressors(exponents[unit[0]], shapes[unit[0]], u, 0.05, o)[0] for u, o in each]
        for unit in units
        for each in [list(zip(inputs, observe, strict=True))]
    ]
    X = np.zeros((2 * 507, whole.shape[1]))
    first = np.cumsum([0, 600, 14, 400])
    for k, parts in enumerate(responses):
        for s, part in enumerate(parts):
            rows = slice(first[s], first[s + 1])
            own = columns[k][: part.shape[-1]].copy()
            if s:
                wide = len(units[k])
                own[1::2] = columns[k][part.shape[-1] + (s - 1) * wide :][:wide]
            X[rows, own] = part.reshape(-1, part.shape[-1])
    X[:, -1] = np.concatenate([y.reshape(-1) for y in outputs])
    np.testing.assert_allclose(whole.T @ whole, X.T @ X, rtol=1e-9, atol=1e-9)


def test_best_set_is_the_best_of_all(rng):
    sizes = [1, 2, 1, 2, 1]
    edges = np.cumsum([0, *(2 * size for size in sizes)])
    columns = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    data = rng.standard_normal((60, edges[-1] + 1))
    R = np.linalg.qr(data, mode="r")
    value, units = best_modes(R, columns, sizes, 4)[0]
    brute = [
        (residual(R, columns, some), some)
        for k in range(1, 6)
        for some in itertools.combinations(range(5), k)
        if sum(sizes[i] for i in some) == 4
    ]
    assert (value, units) == min(brute)
    target = data[:, -1]
    X = data[:, np.concatenate([columns[i] for i in units])]
    fit = X @ np.linalg.lstsq(X, target, rcond=None)[0]
    assert value == pytest.approx(np.sum((target - fit) ** 2), rel=1e-9)


def test_search_by_exchange_finds_what_all_sets_would(rng, monkeypatch):
    sizes = [1, 2, 1, 2, 1, 2]
    edges = np.cumsum([0, *(2 * size for size in sizes)])
    columns = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    data = rng.standard_normal((200, edges[-1] + 1))
    data[:, -1] = data[:, columns[1]].sum(axis=1) + 2 * data[:, columns[4]].sum(axis=1)
    R = np.linalg.qr(data, mode="r")
    full = best_modes(R, columns, sizes, 3)[0]
    monkeypatch.setattr(kernel, "MAX_SUBSETS", 0)
    value, units = best_modes(R, columns, sizes, 3)[0]
    assert units == full[1] == (1, 4)
    assert value < 1e-20
    assert value == pytest.approx(full[0], abs=1e-20)


def test_many_states_grow_from_fewer(rng, monkeypatch):
    """Each set holds a smaller one, and is the best of those that do."""
    sizes = [1, 2, 1, 2, 1, 2, 2, 1]
    edges = np.cumsum([0, *(2 * size for size in sizes)])
    columns = [np.arange(a, b) for a, b in itertools.pairwise(edges)]
    R = np.linalg.qr(rng.standard_normal((200, edges[-1] + 1)), mode="r")
    grown = [best_modes(R, columns, sizes, n)[0] for n in (3, 4)]
    monkeypatch.setattr(kernel, "MANY", 4)
    monkeypatch.setattr(kernel, "FEW_SUBSETS", 1)
    for n in range(5, 12):
        smaller = [set(units) for _, units in grown[-2:]]
        grown += best_modes(R, columns, sizes, n, grown[-2:])
        all_sets = itertools.chain(*(itertools.combinations(range(8), k) for k in range(2, 9)))
        best = min(
            (residual(R, columns, units), units)
            for units in all_sets
            if sum(sizes[i] for i in units) == n
            and any(less < set(units) and len(units) == len(less) + 1 for less in smaller)
        )
        assert grown[-1][0] == pytest.approx(best[0], rel=1e-9)
        assert grown[-1][1] == best[1]


def test_no_set_of_pairs_has_an_odd_number_of_states():
    assert best_modes(np.eye(5), [np.arange(2), np.arange(2, 4)], [2, 2], 3) == []
