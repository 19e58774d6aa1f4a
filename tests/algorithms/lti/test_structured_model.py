"""Responses from one triangular form: as solved point by point, whatever A is like."""

from fractions import Fraction

import numpy as np
import pytest

from sklearn_hd.algorithms.lti.structured_model import TriangularForm, triangular_form

POINTS = np.array([0.0, 0.3j, 1j, 2.0 + 30j, complex(0.0, np.inf), -4.0 + 1j])


def random_matrix(random):
    return random.standard_normal((7, 7))


def jordan_block(random):
    """Eigenvectors all alike."""
    return np.diag(np.full(6, -1.0)) + np.diag(np.ones(5), 1)


def in_other_units(random):
    units = 10.0 ** random.uniform(-6, 6, 5)
    return units[:, None] * random.standard_normal((5, 5)) / units


KINDS = [random_matrix, jordan_block, in_other_units]


@pytest.mark.parametrize("kind", KINDS)
def test_states_are_those_solved_point_by_point(kind):
    random = np.random.default_rng(5)
    A = kind(random)
    size = np.sqrt(np.abs(A).max(axis=1) / np.abs(A).max(axis=0))  # of the states
    B, C = size[:, None] * random.standard_normal((len(A), 2)), random.standard_normal((3, len(A)))
    C = C / size
    form = TriangularForm(A)
    driven, seen = form.driven(B, POINTS), form.seen(C, POINTS)
    for k, s in enumerate(POINTS):
        if not np.isfinite(s):
            assert not driven[:, k].any()
            assert not seen[:, k].any()
            continue
        resolvent = np.linalg.inv(s * np.eye(len(A)) - A)
        for made, wanted in (
            (driven[:, k] / size[:, None], resolvent @ B / size[:, None]),
            (seen[:, k].T * size, C @ resolvent * size),
        ):
            np.testing.assert_allclose(made, wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())


def test_slow_states_beside_a_fast_one_are_seen_to_the_last_digits():
    """The form rounds them beside the fast one's entry, 1e8; elimination does not."""
    A = np.array([[-1.0, 1.0, 100.0], [1.0, -1.001, 50.0], [-20.0, 10.0, -1e8]])
    B, C = np.array([[1.0], [0.5], [0.0]]), np.array([[1.0, -0.5, 0.0]])
    s = np.array([0.0, 1e-3, 2.0, np.inf], dtype=complex)
    form = TriangularForm(A)
    rounded = form._solved((form._into @ B)[:, None], form._decay(s), (3, len(s), 1), upwards=True)
    rounded = np.tensordot(form._out_of, rounded, 1)
    exact = np.array([exact_solution(at.real * np.eye(3) - A, B[:, 0]) for at in s[:-1]]).T
    size = np.abs(exact).max(axis=0)
    driven, seen = form.driven(B, s), form.seen(C, s)
    assert np.max(np.abs(rounded[:, :-1, 0] - exact) / size) > 1e-8
    assert np.max(np.abs(driven[:, :-1, 0] - exact) / size) < 1e-11
    assert not driven[:, -1].any()
    beside = form.driven(np.hstack([B, [[0.0], [0.0], [1e12]]]), s)  # a force in another unit
    assert np.max(np.abs(beside[:, :-1, 0] - exact) / size) < 1e-11
    exact = np.array([exact_solution(at.real * np.eye(3) - A.T, C[0]) for at in s[:-1]]).T
    assert np.max(np.abs(seen[:, :-1, 0] - exact) / np.abs(exact).max(axis=0)) < 1e-11


def exact_solution(matrix, right):
    """By elimination in fractions."""
    rows = np.column_stack([matrix, right])
    rows = [[Fraction(float(entry)) for entry in row] for row in rows]
    for k, row in enumerate(rows):
        row[:] = [entry / row[k] for entry in row]
        for other in rows:
            if other is not row:
                other[:] = [x - other[k] * y for x, y in zip(other, row, strict=True)]
    return [float(row[-1]) for row in rows]


@pytest.mark.parametrize("kind", KINDS)
def test_poles_are_the_eigenvalues(kind):
    A = kind(np.random.default_rng(6))
    characteristic = np.poly(TriangularForm(A).poles)
    np.testing.assert_allclose(characteristic, np.poly(A), atol=1e-9 * np.abs(characteristic).max())


def test_without_states_nothing_is_driven():
    form = TriangularForm(np.empty((0, 0)))
    assert form.driven(np.empty((0, 2)), POINTS).shape == (0, len(POINTS), 2)
    assert form.seen(np.empty((3, 0)), POINTS).shape == (0, len(POINTS), 3)


def test_a_pole_among_the_points_is_refused():
    form = TriangularForm(np.diag([-1.0, 2.0]))
    with pytest.raises(np.linalg.LinAlgError, match=r"s = 2\+0j is infinite: it is a pole"):
        form.driven(np.ones((2, 1)), np.array([1j, 2.0]))


def test_the_form_of_a_matrix_is_remembered():
    A = np.diag([-1.0, -2.0])
    form = triangular_form(A)
    assert triangular_form(A.copy()) is form
    A[0, 0] = -3.0
    np.testing.assert_array_equal(np.sort(triangular_form(A).poles.real), [-3.0, -2.0])
