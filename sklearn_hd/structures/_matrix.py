"""State-space matrices of which some entries are known and some are parameters."""

import copy
from functools import cached_property

import numpy as np

from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.structures._structure import (
    Structure,
    Table,
    axis_names,
    bound_array,
    check_known,
    check_places,
    check_within,
    describe,
    fill_all,
    matrix_shape,
    name_places,
    parameter_names,
    read_bounds,
    read_cells,
    read_fixed,
    read_initial,
    read_names,
    read_numbers,
)


class MatrixStructure(Structure):
    """State-space matrices of which some entries are known and some are parameters.

        ẋ = A(θ) x + B(θ) u,   y = C(θ) x + D(θ) u

    Parameters
    ----------
    A : array_like or DataFrame, shape (n, n)
        State matrix, in 1/s where x and its derivative have one unit.
    B : array_like or DataFrame, shape (n, m)
        Input matrix.
    C : array_like or DataFrame, shape (l, n), optional
        The identity by default: every state is an output.
    D : array_like or DataFrame, shape (l, m), optional
        Zero by default.

        In all four matrices a number is a fixed entry, NaN is a separate parameter, and a text is
        affine in named parameters: ``"k"``, ``"-k"``, ``"2*k"``, ``"1.5 - (k1 + k2)/2"``. A name
        that appears several times, in any matrix, is one parameter.
    state_names, input_names, output_names : sequence of str, optional
        By default the labels of the DataFrames. NaN entries get their names from them,
        ``"A[w_0,phi_dot_1c]"``, or without labels from their position, ``"A[0,1]"``.
    initial : mapping of str to float, or array_like of shape (k,), optional
        Initial values for a search: for all parameters that are not fixed, or for none.
    bounds : mapping of str to (low, high), optional
        Lower and upper limit of a parameter; None is an open end.
    fixed : mapping of str to float, optional
        Parameters with a known value; they become numbers.

    Attributes
    ----------
    parameter_names : tuple of str
        In the order of their first appearance in A, B, C, D, row by row, without the fixed ones.
    n_parameters, n_states, n_inputs, n_outputs : int
    initial : ndarray of shape (k,) or None
    bounds : dict of str to (float or None, float or None)
        As given, including those of fixed parameters.
    lower, upper : ndarray, shape (k,)
        The bounds in the order of parameter_names, infinite where open.
    fixed : dict of str to float
    affine : AffineStructure
        The form that the algorithms work on.

    Raises
    ------
    ValueError
        If shapes or labels do not fit together, an entry is not a number, NaN or affine text, or
        values by name contradict each other.

    References
    ----------
    Bellman, Åström (1970), On structural identifiability, Mathematical Biosciences 7,
    329-339 (which structures the outputs determine).

    Examples
    --------
    An oscillator of unknown frequency and damping (each name appears twice):

    >>> oscillator = MatrixStructure([["-d", "w"], ["-w", "-d"]], [[0], [np.nan]], C=[[1, 0]],
    ...                              bounds={"d": (0, None)})
    >>> oscillator.parameter_names
    ('d', 'w', 'B[1,0]')
    >>> A, B, C, D = oscillator.matrices([0.1, 2.0, 3.0])
    >>> A.tolist()
    [[-0.1, 2.0], [-2.0, -0.1]]
    >>> print(oscillator.fix({"w": 2}))
    A = [ -d   2 ]
        [ -2  -d ]
    B = [      0 ]
        [ B[1,0] ]
    C = [ 1  0 ]
    D = [ 0 ]
    0 <= d
    w = 2, fixed
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
        bounds=None,
        fixed=None,
    ):
        n, m = matrix_shape(A, "A")[0], matrix_shape(B, "B")[1]
        C = np.eye(n) if C is None else C
        p = matrix_shape(C, "C")[0]
        D = np.zeros((p, m)) if D is None else D
        given = dict(zip("ABCD", (A, B, C, D), strict=True))
        _check_shapes(given, n, m, p)
        states = _labels("state", n, state_names, (A, "index"), (A, "columns"), (B, "index"))
        states = _labels("state", n, states, (C, "columns"))
        inputs = _labels("input", m, input_names, (B, "columns"), (D, "columns"))
        outputs = _labels("output", p, output_names, (C, "index"), (D, "index"))
        self.state_names, self.input_names, self.output_names = states, inputs, outputs
        self._shape = n, m, p
        self._cells = self._read(given)
        self._say(fixed, initial, bounds)

    def _read(self, given):
        """Cells of A, B, C and D, every parameter by its name."""
        cells, places = [], {}
        for name, matrix in given.items():
            sides = self._sides(name)
            named, at = name_places(read_cells(name, matrix, *sides), name, *sides)
            cells.append(named)
            places |= at
        check_places(places)
        return tuple(cells)

    def _sides(self, name):
        """Names of the rows and of the columns of A, B, C or D."""
        rows = self.state_names if name in "AB" else self.output_names
        return rows, self.state_names if name in "AC" else self.input_names

    def _say(self, fixed, initial, bounds):
        """Take what is known of the parameters by name."""
        names = parameter_names(self._cells)
        self._fixed = read_fixed(fixed, names)
        self._bounds = read_bounds(bounds, names)
        self._initial = read_initial(initial, self.parameter_names, self._fixed)
        check_within("fixed", self._fixed, self._bounds)
        check_within("initial", self._initial or {}, self._bounds)
        return self

    @property
    def parameter_names(self):
        """Names of the parameters, without those fixed, in the order of θ."""
        return tuple(name for name in parameter_names(self._cells) if name not in self._fixed)

    @property
    def n_parameters(self):
        """Number k of parameters, without those fixed."""
        return len(self.parameter_names)

    @property
    def n_states(self):
        """Number n of states."""
        return self._shape[0]

    @property
    def n_inputs(self):
        """Number m of inputs."""
        return self._shape[1]

    @property
    def n_outputs(self):
        """Number l of outputs."""
        return self._shape[2]

    @property
    def initial(self):
        """Initial values for a search, shape (k,); None if none were given."""
        return None if self._initial is None else np.array(list(self._initial.values()))

    @property
    def bounds(self):
        """Bounds by name as given, including those of fixed parameters."""
        return dict(self._bounds)

    @property
    def lower(self):
        """Lower bounds of the parameters, shape (k,); −inf where open."""
        return bound_array(self._bounds, self.parameter_names, 0, -np.inf)

    @property
    def upper(self):
        """Upper bounds of the parameters, shape (k,); inf where open."""
        return bound_array(self._bounds, self.parameter_names, 1, np.inf)

    @cached_property
    def affine(self):
        """The matrices as an AffineStructure: the form that the algorithms work on."""
        return _affine(self._filled(), *self._shape)

    def _filled(self):
        """Cells of A, B, C and D with numbers where parameters are fixed."""
        return [fill_all(cells, self._fixed) for cells in self._cells]

    def matrices(self, theta):
        """A, B, C and D at some values of the parameters.

        Parameters
        ----------
        theta : array_like, shape (k,)
            In the order of ``parameter_names``.

        Returns
        -------
        A, B, C, D : ndarray, shapes (n, n), (n, m), (l, n), (l, m)
            New arrays, which you may change.

        Raises
        ------
        ValueError
            If θ does not hold one finite number for each parameter.
        """
        theta = read_numbers("theta", theta, self.parameter_names)
        return tuple(matrix.copy() for matrix in self.affine.matrices(theta))

    def _check_fixed(self, what, fixed):
        check_known(what, fixed, parameter_names(self._cells))

    def _with_fixed(self, fixed):
        """The same with other fixed values; a freed parameter starts at its former value."""
        initial = self._initial
        if initial is not None:
            known = {**initial, **self._fixed}
            initial = {name: x for name, x in known.items() if name not in fixed}
        return copy.copy(self)._say(fixed, initial, self._bounds)

    def __getstate__(self):
        return {name: value for name, value in vars(self).items() if name != "affine"}

    def _key(self):
        known = [
            None if each is None else tuple(sorted(each.items()))
            for each in (self._fixed, self._initial, self._bounds)
        ]
        names = self.state_names, self.input_names, self.output_names
        return self._cells, self._shape, names, *known

    def __repr__(self):
        known = [
            f", {name}={value}"
            for name, value in (("bounds", self._bounds), ("fixed", self._fixed))
            if value
        ]
        return (
            f"MatrixStructure({self.n_states} states, {self.n_inputs} inputs, {self.n_outputs} "
            f"outputs, parameters={list(self.parameter_names)}{''.join(known)})"
        )

    def _shown(self):
        return [
            Table(name, cells, *self._sides(name))
            for name, cells in zip("ABCD", self._filled(), strict=True)
        ]

    def _notes(self):
        names = parameter_names(self._cells)
        return describe(names, self._fixed, self._initial, self._bounds)


def _check_shapes(given, n, m, p):
    shapes = {"A": (n, n), "B": (n, m), "C": (p, n), "D": (p, m)}
    found = {name: matrix_shape(matrix, name) for name, matrix in given.items()}
    for name, shape in shapes.items():
        if found[name] != shape:
            raise ValueError(
                f"{name} has shape {found[name]}, but A of {found['A']}, B of {found['B']} and C "
                f"of {found['C']} need {shape}"
            )
    if m == 0 or p == 0:
        raise ValueError(
            f"B has shape {found['B']} and C {found['C']}: without inputs, or without outputs, "
            f"there is no response to match; give at least one of each"
        )


def _labels(what, size, given, *sources):
    """Given names, or those of the DataFrames' axes, which must agree; None if none."""
    found = None if given is None else read_names(f"{what}_names", given)
    for labels in (axis_names(*source) for source in sources):
        if labels is None:
            continue
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
    names = {name: k for k, name in enumerate(parameter_names(cells))}
    constant, basis = np.zeros((n + p, n + m)), np.zeros((len(names), n + p, n + m))
    corners = (0, 0), (0, n), (n, 0), (n, n)
    for (top, left), part in zip(corners, cells, strict=True):
        for i, line in enumerate(part):
            for j, (number, terms) in enumerate(line):
                constant[top + i, left + j] = number
                for name, scale in terms:
                    basis[names[name], top + i, left + j] = scale
    return AffineStructure(constant, basis, n, tuple(names))
