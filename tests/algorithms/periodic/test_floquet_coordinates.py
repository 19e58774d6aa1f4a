"""Laws of the coordinates in which a periodic system is as constant as can be."""

from dataclasses import replace

import numpy as np
import pytest
from periodic_cases import similar
from scipy import linalg, sparse

from sklearn_hd.algorithms.periodic.floquet_coordinates import (
    _half_turns,
    fixed_scale,
    floquet_coordinates,
)
from sklearn_hd.algorithms.periodic.periodic_realization import FloquetShapes
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, sampled_harmonics
from sklearn_hd.systems import LTPSystem

OMEGA = 1.7
PAIR = [[-0.1, 0.4], [-0.4, -0.1]]


CASES = {  # R of shapes that change sign, R of the others
    "real": (np.zeros((0, 0)), np.diag([-0.1, -0.5, -0.9])),
    "pair": (np.zeros((0, 0)), similar(PAIR)),
    "negative": (similar(np.diag([-0.2, -0.7])), np.zeros((0, 0))),
    "negative pair": (similar(PAIR), np.zeros((0, 0))),
    "four negative": (similar(np.diag([-0.1, -0.2, -0.7, -0.4])), np.zeros((0, 0))),
    "all kinds": (
        similar(linalg.block_diag(-0.2, PAIR, -0.6)),
        similar(linalg.block_diag(PAIR, -0.3), 1),
    ),
}


def shapes_of(name, n_outputs=2, n_harmonics=2):
    """Random shapes of those exponents."""
    turned, straight = CASES[name]
    R = linalg.block_diag(*[part for part in (turned, straight) if len(part)])
    flips, rng = np.arange(len(R)) < len(turned), np.random.default_rng(1)
    coefficients = rng.standard_normal((len(R), n_harmonics + 1, 2, n_outputs))
    coefficients[flips, -1] = 0.0
    return FloquetShapes(R, flips, coefficients, n_harmonics)


@pytest.mark.parametrize("name", CASES)
def test_the_free_response_is_that_of_the_shapes(name):
    """P(ψ) Φ(ψ) P(0)⁺ y: the same outputs, from the same start."""
    shapes = shapes_of(name, n_outputs=len(shapes_of(name).R))
    n, t = len(shapes.R), np.linspace(0.0, 3 * np.pi / OMEGA, 25)
    _, P, form = floquet_coordinates(shapes, OMEGA * t, OMEGA)
    y = np.array(
        [S @ linalg.expm(shapes.R * s) for S, s in zip(shapes(OMEGA * t)[0], t, strict=True)]
    )
    system = LTPSystem(form, np.zeros((n, 1)), omega=OMEGA)
    start = np.linalg.solve(P[0], y[0])
    for column in range(n):
        _, z = system.simulate(np.zeros(len(t)), t, x0=start[:, column], return_states=True)
        found = np.einsum("tln,tn->tl", P, z)
        np.testing.assert_allclose(found, y[:, :, column], atol=1e-10 * np.abs(y).max())


@pytest.mark.parametrize("name", CASES)
def test_coordinates_repeat_with_the_period(name):
    shapes, psi = shapes_of(name), np.linspace(0, 6, 11)
    here = floquet_coordinates(shapes, psi, OMEGA)
    later = floquet_coordinates(shapes, psi + 2 * np.pi, OMEGA)
    for one, other in zip(here[:2], later[:2], strict=True):
        np.testing.assert_allclose(other, one, atol=1e-12)
    assert len(here[2].directions) == len(shapes.R)
    assert here[2].n_harmonics == int(name in ("negative", "four negative", "all kinds"))


@pytest.mark.parametrize("units", [1.0, np.array([1e3, 0.0])])
@pytest.mark.parametrize("name", CASES)
def test_each_mode_has_a_shape_of_size_one(name, units):
    """Of two that change sign together each has, too, and a pair has; whatever the states were."""
    shapes, psi = shapes_of(name), 2.0 * np.pi * np.arange(32) / 32
    n, n_flips = len(shapes.R), int(np.sum(shapes.flips))
    _, P, form = floquet_coordinates(shapes, psi, OMEGA, units)
    modal = P @ _half_turns(psi, n, n_flips) * np.reshape(units, (-1, 1))
    squares = np.mean(np.sum(modal**2, axis=1), axis=0)
    pairs = [at for kind, at in form.columns if kind == "pair"]
    alone = np.setdiff1d(np.arange(n), [*pairs, *(at + 1 for at in pairs)])
    np.testing.assert_allclose(squares[pairs] + squares[[at + 1 for at in pairs]], 1.0, rtol=1e-9)
    np.testing.assert_allclose(squares[alone], 1.0, rtol=1e-9)
    larger = replace(shapes, coefficients=1e5 * shapes.coefficients)
    np.testing.assert_allclose(floquet_coordinates(larger, psi, OMEGA, units)[1], P, atol=1e-9)


def test_a_mode_that_no_output_sees_keeps_its_size():
    shapes = shapes_of("real")
    unseen = replace(
        shapes, coefficients=shapes.coefficients * np.array([1, 0, 1])[:, None, None, None]
    )
    assert np.isfinite(floquet_coordinates(unseen, np.zeros(1), OMEGA)[1]).all()


def test_modes_too_close_have_no_form():
    R = np.array([[-0.3, 1.0], [0.0, -0.3]])
    shapes = FloquetShapes(R, np.array([False, False]), np.eye(4).reshape(4, 2, 2, 1)[:2], 1)
    F, P, form = floquet_coordinates(shapes, np.zeros(3), OMEGA)
    assert form is None
    np.testing.assert_array_equal(F, np.broadcast_to(R, (3, 2, 2)))
    turn = floquet_coordinates(shapes, np.linspace(0.0, 2.0 * np.pi, 9)[1:], OMEGA)[1]
    assert np.mean(np.sum(turn**2, axis=(1, 2))) == pytest.approx(1.0)  # of both together
    assert P.shape == (3, 1, 2)


def test_an_odd_number_of_negative_multipliers_is_refused():
    shapes = FloquetShapes(np.array([[-0.3]]), np.array([True]), np.ones((1, 1, 2, 1)), 1)
    with pytest.raises(ValueError, match=r"1 negative real .* odd number.*; try order=2, or"):
        floquet_coordinates(shapes, np.zeros(3), OMEGA)


# ---- scale -------------------------------------------------------------------------------------


def free_structure(form, n_outputs, n_harmonics, rng):
    """All of P free, F of the form, and parameters."""
    n = len(form.constant[0])
    constant = np.zeros((2 * n_harmonics + 1, n + n_outputs, n + 1))
    constant[:3, :n, :n] = form.constant
    rows = []
    for direction in form.directions.values():
        rows.append(np.zeros(constant.shape))
        rows[-1][:3, :n, :n] = direction
    for place in np.ndindex(2 * n_harmonics + 1, n_outputs, n):
        rows.append(np.zeros(constant.shape))
        rows[-1][place[0], n + place[1], place[2]] = 1.0
    names = tuple(f"p{k}" for k in range(len(rows)))
    theta = np.concatenate([form.values, rng.standard_normal(len(rows) - n)])
    basis = sparse.csr_array(np.array(rows).reshape(len(rows), -1))
    return PeriodicStructure(constant, basis, n, names), theta


@pytest.mark.parametrize("name", CASES)
def test_holding_the_scale_takes_a_parameter_a_mode_and_moves_nothing(name, rng):
    _, _, form = floquet_coordinates(shapes_of(name), np.zeros(1), OMEGA)
    structure, theta = free_structure(form, 2, 2, rng)
    fixed, fewer = fixed_scale(structure, theta, form)
    assert len(fewer) == len(theta) - structure.n_states
    np.testing.assert_allclose(fixed.coefficients(fewer), structure.coefficients(theta), atol=1e-12)
    assert set(fixed.parameter_names) < set(structure.parameter_names)
    places = [structure.parameter_names.index(p) for p in fixed.parameter_names]
    np.testing.assert_array_equal(fewer, theta[places])


@pytest.mark.parametrize("name", CASES)
def test_no_change_of_scale_is_left(name, rng):
    """P(ψ) S(ψ) D S(ψ)ᵀ for no D that leaves F as it is."""
    _, _, form = floquet_coordinates(shapes_of(name), np.zeros(1), OMEGA)
    structure, theta = free_structure(form, 2, 3, rng)
    n = structure.n_states
    P = structure.coefficients(theta)[:, n:, :n].copy()
    P[-2:] = 0.0  # room for the harmonic that a turned plane adds
    theta[n:] = P.ravel()
    fixed, _ = fixed_scale(structure, theta, form)
    allowed = fixed.basis.toarray().reshape(-1, *structure.constant.shape)[:, :, n:, :n]
    allowed = allowed.reshape(len(allowed), -1)
    moves = np.array([move.ravel() for move in gauge_moves(form, P)])
    assert len(moves) == n
    both = np.linalg.matrix_rank(np.vstack([allowed, moves]), tol=1e-9)
    assert both == np.linalg.matrix_rank(allowed, tol=1e-9) + n


def gauge_moves(form, P):
    """Changes of P by a change of scale (or a turn) of each mode."""
    n_harmonics, psi = len(P) // 2, 2 * np.pi * np.arange(16) / 16
    values = np.tensordot(harmonic_functions(psi, range(n_harmonics + 1)), P, 1)
    one, zero, c, s = np.ones(16), np.zeros(16), np.cos(psi), np.sin(psi)
    planes = {
        "pair": [[[one, zero], [zero, one]], [[zero, one], [-one, zero]]],
        "turned": [
            [[0.5 * (one + k * c), 0.5 * k * s], [0.5 * k * s, 0.5 * (one - k * c)]]
            for k in (1, -1)
        ],
        "single": [[[one]]],
    }
    for kind, at in form.columns:
        for plane in planes[kind]:
            D = np.array(plane).transpose(2, 0, 1)
            moved = np.zeros(values.shape)
            moved[:, :, at : at + D.shape[1]] = values[:, :, at : at + D.shape[1]] @ D
            yield sampled_harmonics(moved, n_harmonics)
