"""From a harmonic decomposition back to its periodic system, and how far a model is from one."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from law_cases import SEEDS, UP_TO_THREE, UP_TO_TWO, examples

from sklearn_hd.algorithms.periodic.harmonic_decomposition import (
    toeplitz_coefficients,
    toeplitz_matrix,
)
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems import LTPSystem, flapping_wing


def drawn(rng, n, m, l, K, omega=3.0):  # noqa: E741 (the field's letter)
    shapes = ((n, n), (n, m), (l, n), (l, m))
    return LTPSystem(*(rng.standard_normal((2 * K + 1, *shape)) for shape in shapes), omega=omega)


def shuffled(model, rng):
    """The same model, its states, inputs and outputs in another order."""
    x, u, y = (rng.permutation(k) for k in (model.nstates, model.ninputs, model.noutputs))
    return control.StateSpace(
        model.A[np.ix_(x, x)],
        model.B[np.ix_(x, u)],
        model.C[np.ix_(y, x)],
        model.D[np.ix_(y, u)],
        states=[model.state_labels[i] for i in x],
        inputs=[model.input_labels[i] for i in u],
        outputs=[model.output_labels[i] for i in y],
    )


@examples(20)
@given(SEEDS, UP_TO_THREE, UP_TO_THREE, UP_TO_TWO, st.integers(0, 2))
def test_it_returns_the_system_whenever_enough_harmonics_are_kept(seed, n, m, K, more):
    rng = np.random.default_rng(seed)
    system, N = drawn(rng, n, m, 2, K), K + more
    model = shuffled(system.harmonic_decomposition(N, K, N), rng)
    back = LTPSystem.from_harmonic_decomposition(model, 3.0)
    order = [
        [names.index(name) for name in own]
        for names, own in zip(system._names().values(), back._names().values(), strict=True)
    ]
    x, u, y = order
    pairs = zip(system.fourier_coefficients(K + 1), back.fourier_coefficients(K + 1), strict=True)
    sides = (x, x), (x, u), (y, x), (y, u)
    for (true, found), (rows, columns) in zip(pairs, sides, strict=True):
        assert np.max(np.abs(true[:, rows][:, :, columns] - found), initial=0.0) < 1e-12


def test_there_and_back_again_gives_the_same_decomposition(rng):
    model = drawn(rng, 2, 1, 2, 1).harmonic_decomposition(2, 1, 2)
    back = LTPSystem.from_harmonic_decomposition(model, 3.0).harmonic_decomposition(2, 1, 2)
    for name in "ABCD":
        np.testing.assert_allclose(getattr(back, name), getattr(model, name), atol=1e-13)
    assert back.state_labels == model.state_labels


def test_a_system_with_kinks_comes_back_as_its_fourier_series():
    wing = flapping_wing()
    system = wing.linearize(wing.trim())
    back = LTPSystem.from_harmonic_decomposition(system.harmonic_decomposition(3), system.omega)
    pairs = zip(system.fourier_coefficients(6), back.fourier_coefficients(6), strict=True)
    for true, found in pairs:
        np.testing.assert_allclose(found, true, atol=1e-12 * np.abs(true).max())


def test_signals_may_be_named_where_labels_do_not_tell(rng):
    system = drawn(rng, 2, 1, 1, 1)
    model = system.harmonic_decomposition(1)
    bare = control.StateSpace(model.A, model.B, model.C, model.D)
    with pytest.raises(ValueError, match=r"'x\[0\]' is not a harmonic of a signal"):
        LTPSystem.from_harmonic_decomposition(bare, 3.0)
    names = {"state_names": ["a", "b"], "input_names": ["u"], "output_names": ["y"]}
    back = LTPSystem.from_harmonic_decomposition(bare, 3.0, **names)
    assert back.state_names == ("a", "b")
    np.testing.assert_allclose(back.fourier_coefficients(1)[0], system.fourier_coefficients(1)[0])


def test_a_model_near_the_pattern_is_told_by_how_far(rng):
    model = drawn(rng, 2, 1, 2, 1).harmonic_decomposition(2)
    off = 1e-3 * rng.standard_normal(model.A.shape)
    near = control.StateSpace(
        model.A + off, model.B, model.C, model.D, states=model.state_labels,
        inputs=model.input_labels, outputs=model.output_labels,
    )  # fmt: skip
    with pytest.warns(IdentifiabilityWarning, match=r"A 0\.0\d+, B .*nearest"):
        back = LTPSystem.from_harmonic_decomposition(near, 3.0)
    again = back.harmonic_decomposition(2)
    left = near.A - again.A
    for change in (off, rng.standard_normal(off.shape)):  # no other pattern is nearer
        T = toeplitz_coefficients(
            change.reshape(5, 2, 5, 2).transpose(1, 3, 0, 2), range(5), range(5)
        )
        pattern = T[1].transpose(2, 0, 3, 1).reshape(off.shape)
        assert abs(np.sum(left * pattern)) < 1e-12
    with pytest.raises(ValueError, match=r"above tolerance=0\.0001; check omega"):
        LTPSystem.from_harmonic_decomposition(near, 3.0, tolerance=1e-4)


def test_units_do_not_hide_a_misfit(rng):
    system = drawn(rng, 2, 1, 2, 1)
    F, G, P, Q = system.fourier_coefficients(1)
    scale = np.array([1e6, 1.0])
    told = []
    for unit in (np.ones(2), scale):
        moved = LTPSystem(F * unit[:, None] / unit, G * unit[:, None], P / unit, Q, omega=3.0)
        model = moved.harmonic_decomposition(1)
        model.A[1, 1] += 0.05  # of the second state, of unit one in both
        with pytest.warns(IdentifiabilityWarning, match="nearest") as caught:
            LTPSystem.from_harmonic_decomposition(model, 3.0)
        told.append(str(caught[0].message).split("A ")[1].split(",")[0])
    ratio = float(told[1]) / float(told[0])
    assert 0.5 < ratio < 2.0


def test_a_free_model_is_refused(rng):
    A = rng.standard_normal((6, 6))
    names = ["a_0", "b_0", "a_1c", "b_1c", "a_1s", "b_1s"]
    free = control.StateSpace(
        A, A[:, :1], A[:1], [[0.0]], states=names, inputs=["u_0"], outputs=["y_0"]
    )
    with pytest.raises(ValueError, match="not a harmonic decomposition of a periodic system"):
        LTPSystem.from_harmonic_decomposition(free, 3.0)


def test_the_wrong_omega_is_refused(rng):
    model = drawn(rng, 2, 1, 1, 1).harmonic_decomposition(3)
    with pytest.raises(ValueError, match="check omega"):
        LTPSystem.from_harmonic_decomposition(model, 6.0)


def test_harmonics_left_out_are_named():
    names = ["w_0", "q_1c", "q_1s"]
    model = control.StateSpace(
        np.diag([-1.0, -2.0, -2.0]), np.ones((3, 1)), np.ones((1, 3)), 0.0,
        states=names, inputs=["u_0"], outputs=["y_0"],
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"do not show harmonic\(s\) \[0\] of F\[w,q\]"):
        LTPSystem.from_harmonic_decomposition(model, 3.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": 1.0}, "not a state-space model; give a control.StateSpace"),
        ({"omega": -1.0}, "omega must be a positive number"),
        ({"tolerance": 2.0}, "tolerance must be a number between 0 and 1"),
        ({"state_names": ["a", "b"]}, "it must have 2 N \\+ 1 of each signal"),
        ({"model": control.ss([[0.5]], [[1.0]], [[1.0]], 0.0, 0.1)}, "a sample time of 0.1 s"),
    ],
)
def test_it_refuses(change, message):
    model = LTPSystem([[-1.0]], [[1.0]], omega=3.0).harmonic_decomposition(1)
    with pytest.raises(ValueError, match=message):
        LTPSystem.from_harmonic_decomposition(**{"model": model, "omega": 3.0} | change)


@given(SEEDS, st.lists(st.integers(0, 4), min_size=1, unique=True))
@examples(20)
def test_the_nearest_pattern_of_a_pattern_is_itself(seed, places):
    M = np.random.default_rng(seed).standard_normal((9, 1, 1))
    T = toeplitz_matrix(M, 2, 2)[np.ix_(places, range(5))]
    _, nearest, _ = toeplitz_coefficients(T, places, range(5))
    np.testing.assert_allclose(nearest, T, atol=1e-13)
