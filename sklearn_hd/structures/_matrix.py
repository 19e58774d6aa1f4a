"""State-space matrices of which some entries are known and some are parameters."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from sklearn_hd.algorithms.structured_model import AffineStructure
from sklearn_hd.structures._cells import (
    layout,
    matrix_shape,
    read_cells,
    read_names,
    read_numbers,
    write_cells,
)

__all__ = ["MatrixStructure"]


class MatrixStructure:
    """State-space matrices of which some entries are known and some are parameters.

        ẋ = A(θ) x + B(θ) u,   y = C(θ) x + D(θ) u

    Parameters
    ----------
    A : array_like or DataFrame, shape (n, n)
    B : array_like or DataFrame, shape (n, m)
    C : array_like or DataFrame, shape (l, n), optional
        The identity by default: every state is an output.
    D : array_like or DataFrame, shape (l, m), optional
        Zero by default.

        In all four a number is a fixed entry, NaN a parameter of its own, and a text a
        named parameter: ``"k"``, ``"-k"``, ``"2*k"``. A name that recurs, in whichever
        matrix, is one parameter.
    state_names, input_names, output_names : sequence of str, optional
        By default the labels of the DataFrames. NaN entries are called after them,
        ``"A[w_0,phi_dot_1c]"``; without names after their position, ``"A[0,1]"``.
    initial : mapping of str to float, or array_like of shape (k,), optional
        Where a search may start; every parameter must be given.

    Attributes
    ----------
    parameter_names : tuple of str
        In the order of their first appearance in A, B, C, D, read by rows.
    n_parameters, n_states, n_inputs, n_outputs : int
    initial : ndarray of shape (k,) or None
    affine : AffineStructure
        The form that the algorithms work on.

    Raises
    ------
    ValueError
        If shapes or labels do not fit together, or a cell is neither a number, NaN, nor
        the text of a parameter.

    Examples
    --------
    An oscillator of unknown frequency and damping (the same number stands twice):

    >>> oscillator = MatrixStructure([["-d", "w"], ["-w", "-d"]], [[0], [np.nan]], C=[[1, 0]])
    >>> oscillator.parameter_names
    ('d', 'w', 'B[1,0]')
    >>> A, B, C, D = oscillator.matrices([0.1, 2.0, 3.0])
    >>> A.tolist()
    [[-0.1, 2.0], [-2.0, -0.1]]
    """

    def __init__(
        self,
        A,
        B,
        C=None,
        D=None,
        *,
        state_names=None,
        input_names=None,
        output_names=None,
        initial=None,
    ):
        n, m = matrix_shape(A, "A")[0], matrix_shape(B, "B")[1]
        C = np.eye(n) if C is None else C
        D = np.zeros((matrix_shape(C, "C")[0], m)) if D is None else D
        p = matrix_shape(C, "C")[0]
        for name, matrix, shape in zip("ABCD", (A, B, C, D), _shapes(n, m, p), strict=True):
            if matrix_shape(matrix, name) != shape:
                found = {key: matrix_shape(M, key) for key, M in zip("ABC", (A, B, C), strict=True)}
                raise ValueError(
                    f"{name} has shape {matrix_shape(matrix, name)} where A of {found['A']}, B of "
                    f"{found['B']} and C of {found['C']} call for {shape}"
                )
        states = _labels("state", n, state_names, (A, "index"), (A, "columns"), (B, "index"))
        states = _labels("state", n, states, (C, "columns"))
        inputs = _labels("input", m, input_names, (B, "columns"), (D, "columns"))
        outputs = _labels("output", p, output_names, (C, "index"), (D, "index"))
        self.state_names, self.input_names, self.output_names = states, inputs, outputs
        sides = {"A": (states, states), "B": (states, inputs)}
        sides |= {"C": (outputs, states), "D": (outputs, inputs)}
        cells = [
            read_cells(name, matrix, *sides[name])
            for name, matrix in zip("ABCD", (A, B, C, D), strict=True)
        ]
        self._texts = tuple(tuple(map(tuple, write_cells(part))) for part in cells)
        self.affine = _affine(cells, n, m, p)
        self.initial = _initial(initial, self.affine.parameter_names)

    @property
    def parameter_names(self):
        return self.affine.parameter_names

    @property
    def n_parameters(self):
        return self.affine.n_parameters

    @property
    def n_states(self):
        return self.affine.n_states

    @property
    def n_inputs(self):
        return self.affine.n_inputs

    @property
    def n_outputs(self):
        return self.affine.n_outputs

    def matrices(self, theta):
        """(A, B, C, D) at the parameters θ, shape (k,) in the order of parameter_names."""
        theta = read_numbers("theta", theta, self.parameter_names)
        return tuple(matrix.copy() for matrix in self.affine.matrices(theta))

    def _key(self):
        initial = None if self.initial is None else tuple(self.initial.tolist())
        return self._texts, self.state_names, self.input_names, self.output_names, initial

    def __eq__(self, other):
        return self._key() == other._key() if isinstance(other, MatrixStructure) else NotImplemented

    def __hash__(self):
        return hash(self._key())

    def __repr__(self):
        return (
            f"MatrixStructure({self.n_states} states, {self.n_inputs} inputs, "
            f"{self.n_outputs} outputs, parameters={list(self.parameter_names)})"
        )

    def __str__(self):
        return "\n".join(layout(name, t) for name, t in zip("ABCD", self._texts, strict=True))


def _shapes(n, m, p):
    return (n, n), (n, m), (p, n), (p, m)


def _places(n):
    """Where A, B, C and D begin in [A B; C D]."""
    return (0, 0), (0, n), (n, 0), (n, n)


def _labels(what, size, given, *sources):
    """Names given, else those of the DataFrames' axes, which must agree; None if none."""
    found = None if given is None else read_names(f"{what}_names", given)
    for frame, axis in sources:
        if not isinstance(frame, pd.DataFrame):
            continue
        labels = tuple(map(str, getattr(frame, axis)))
        if found is not None and labels != found:
            raise ValueError(
                f"{what} names disagree: {list(found)} in one place, {list(labels)} in another; "
                f"label the matrices alike, in one order"
            )
        found = labels
    if found is not None and (len(found) != size or len(set(found)) != size):
        raise ValueError(f"{what}_names={list(found)} must be {size} different names")
    return found


def _affine(cells, n, m, p):
    """The affine form of four matrices of cells."""
    constant, names, entries = np.zeros((n + p, n + m)), {}, []
    for (top, left), part in zip(_places(n), cells, strict=True):
        for i, line in enumerate(part):
            for j, (number, name) in enumerate(line):
                if name is None:
                    constant[top + i, left + j] = number
                else:
                    entries.append((names.setdefault(name, len(names)), top + i, left + j, number))
    basis = np.zeros((len(names), n + p, n + m))
    for k, i, j, scale in entries:
        basis[k, i, j] = scale
    return AffineStructure(constant, basis, n, tuple(names))


def _initial(initial, names):
    if initial is None:
        return None
    if isinstance(initial, (Mapping, pd.Series)):
        initial = dict(initial)
        unknown = [name for name in initial if name not in names]
        missing = [name for name in names if name not in initial]
        if unknown or missing:
            raise ValueError(
                f"initial must give every parameter and no other; missing {missing}, unknown "
                f"{unknown}, allowed {list(names)}"
            )
        initial = [initial[name] for name in names]
    return read_numbers("initial", initial, names)
