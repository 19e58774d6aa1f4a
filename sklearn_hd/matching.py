"""Step 5: the identified model brought to the structure of the physics (Eqs. 20-22)."""

import re
import warnings
from collections.abc import Mapping
from numbers import Number

import numpy as np
import pandas as pd
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import within_range
from sklearn_hd._base import ModelStep, upstream
from sklearn_hd._continuous import to_continuous
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._validation import check_count, check_positive
from sklearn_hd.algorithms.matching import match_structure
from sklearn_hd.algorithms.matching_problem import channel_scales, matching_grid
from sklearn_hd.algorithms.simulation import frequency_response
from sklearn_hd.algorithms.structured_model import AffineStructure
from sklearn_hd.exceptions import IdentifiabilityWarning

__all__ = ["MatrixStructure", "StructuredMatcher"]

POOR_MATCH = 1e-2  # relative error of a match between different orders worth a warning

_TERM = re.compile(r"\s*(?P<sign>[+-])?\s*(?:(?P<scale>[^*\s]+)\s*\*)?\s*(?P<name>\S.*?)\s*")
_NAME = re.compile(r"[^\W\d]\w*(\[[^\]]*\])?")


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
        n, m = _shape(A, "A")[0], _shape(B, "B")[1]
        C = np.eye(n) if C is None else C
        D = np.zeros((_shape(C, "C")[0], m)) if D is None else D
        p = _shape(C, "C")[0]
        for name, matrix, shape in zip("ABCD", (A, B, C, D), _shapes(n, m, p), strict=True):
            if _shape(matrix, name) != shape:
                raise ValueError(
                    f"{name} has shape {_shape(matrix, name)} where A of {_shape(A, 'A')}, B of "
                    f"{_shape(B, 'B')} and C of {_shape(C, 'C')} call for {shape}"
                )
        states = _labels("state", n, state_names, (A, "index"), (A, "columns"), (B, "index"))
        states = _labels("state", n, states, (C, "columns"))
        inputs = _labels("input", m, input_names, (B, "columns"), (D, "columns"))
        outputs = _labels("output", p, output_names, (C, "index"), (D, "index"))
        self.state_names, self.input_names, self.output_names = states, inputs, outputs
        sides = {"A": (states, states), "B": (states, inputs)}
        sides |= {"C": (outputs, states), "D": (outputs, inputs)}
        cells = [
            _read(name, matrix, *sides[name])
            for name, matrix in zip("ABCD", (A, B, C, D), strict=True)
        ]
        self._texts = tuple(tuple(map(tuple, _write(part))) for part in cells)
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
        theta = np.asarray(theta, dtype=float)
        if theta.shape != (self.n_parameters,):
            raise ValueError(
                f"theta of shape {theta.shape} must hold {self.n_parameters} numbers, one for "
                f"each of {list(self.parameter_names)}"
            )
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
        return "\n".join(_layout(name, t) for name, t in zip("ABCD", self._texts, strict=True))


def _shapes(n, m, p):
    return (n, n), (n, m), (p, n), (p, m)


def _places(n):
    """Where A, B, C and D begin in [A B; C D]."""
    return (0, 0), (0, n), (n, 0), (n, n)


def _shape(matrix, name):
    """Shape of a matrix given as array, nested list or DataFrame."""
    try:
        shape = np.shape(np.asarray(matrix, dtype=object))
    except ValueError:
        shape = ()
    if len(shape) != 2:
        raise ValueError(f"{name} must be a matrix, rows of equal length; got shape {shape}")
    return shape


def _labels(what, size, given, *sources):
    """Names given, else those of the DataFrames' axes, which must agree; None if none."""
    found = None if given is None else tuple(map(str, given))
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


def _read(name, matrix, rows, columns):
    """Each cell as (number, None) or (scale, parameter name)."""
    matrix = np.asarray(matrix, dtype=object)
    rows, columns = rows or range(matrix.shape[0]), columns or range(matrix.shape[1])
    return [
        [
            _cell(value, f"{name}[{row},{column}]")
            for value, column in zip(line, columns, strict=True)
        ]
        for line, row in zip(matrix, rows, strict=True)
    ]


def _cell(value, place):
    """(number, None) for a fixed entry, (scale, name) for a free one."""
    if isinstance(value, str):
        return _text(value, place)
    if value is None or value is pd.NA or (isinstance(value, Number) and value != value):
        return 1.0, place
    if isinstance(value, Number) and not isinstance(value, complex) and np.isfinite(value):
        return float(value), None
    raise ValueError(
        f"{place} = {value!r} is no entry; give a finite number (fixed), NaN (free) or the name "
        f"of a parameter"
    )


def _text(text, place):
    try:
        number = float(text)
    except ValueError:
        return _term(text, place)
    return _cell(number, place)


def _term(text, place):
    """(scale, name) of 'k', '-k', '2*k'."""
    term = _TERM.fullmatch(text)
    try:
        scale = float(term["scale"] or 1.0) * (-1.0 if term["sign"] == "-" else 1.0)
    except (TypeError, ValueError):
        scale = np.nan
    if not (np.isfinite(scale) and scale != 0 and _NAME.fullmatch(term["name"])):
        raise ValueError(
            f"{place} = {text!r} is not understood; write a parameter as 'k', '-k' or '2*k', its "
            f"name beginning with a letter"
        )
    return scale, term["name"]


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
    initial = np.asarray(initial, dtype=float)
    if initial.shape != (len(names),) or not np.all(np.isfinite(initial)):
        raise ValueError(f"initial must hold {len(names)} finite numbers, for {list(names)}")
    return initial


def _write(part):
    """Cells as texts: 1.5, k, -k, 2*k."""
    texts = {1.0: "", -1.0: "-"}
    return [
        [repr(x) if name is None else texts.get(x, f"{x:g}*") + name for x, name in line]
        for line in part
    ]


def _layout(name, texts):
    width = max((len(text) for line in texts for text in line), default=0)
    lines = ["[ " + "  ".join(text.rjust(width) for text in line) + " ]" for line in texts]
    return "\n".join(
        f"{name} = {line}" if k == 0 else f"    {line}" for k, line in enumerate(lines)
    )


class StructuredMatcher(ModelStep):
    """Bring the identified model to the structure of the physics, in the H∞ norm.

        θ* = arg min_θ ‖G_c(s) − G_s(s; θ)‖_∞                            (Eq. 22)

    The channels are scaled alike first (each output by the size of its row of
    G_c, each input by that of its column), so that units do not decide which
    one is matched.

    Parameters
    ----------
    estimator : estimator or None, default=None
        Whose model to match, fitted here; None takes the model that rides on X.
    structure : MatrixStructure or None, default=None
        The structure; None leaves every entry free, and the model as it is.
    scale : bool, default=True
        Whether to scale the channels; without, the norm is taken in the
        units of the model, and the largest channel decides.
    n_starts : int, default=6
        Largest number of starts tried where no exact match is found.
    random_state : int, default=0
        Seed of the starts.
    max_iter : int, default=100
        Largest number of iterations of each stage.
    tol : float, default=1e-8
        Relative decrease of the norm at which to stop.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data.

    Attributes
    ----------
    system_ : control.StateSpace
        The matched model, in continuous time, its states named by the structure.
    theta_ : Series, shape (n_parameters,)
        The parameters by name.
    theta_least_squares_ : Series, shape (n_parameters,)
        The match in the mean square over frequency, usually the better
        estimate of parameters where no exact match exists.
    hinf_error_ : float
        ‖W_o (G_c − G_s(θ)) W_i‖_∞, W_o and W_i the channel scales.
    hinf_error_relative_ : float
        The same divided by ‖W_o G_c W_i‖_∞.
    peak_frequency_ : float
        rad/s, where the error is largest.
    n_iter_ : int
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Raises
    ------
    ValueError
        At ``fit``, if there is no model, or the structure does not fit it.
    UnstableModelError
        If the model is unstable: its response has no H∞ norm.

    Warns
    -----
    IdentifiabilityWarning
        If these outputs do not determine some parameters (they are named), or
        model and structure differ in order and match poorly.
    ConvergenceWarning
        If the search stopped before the tolerance was met.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, section 2.4.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn_hd import MOESPRegressor
    >>> u = np.random.default_rng(0).standard_normal((300, 1))
    >>> y = np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> structure = MatrixStructure([["-a"]], [["b"]])
    >>> matcher = StructuredMatcher(MOESPRegressor(order=1, block_rows=5), structure=structure)
    >>> matcher.fit(u, y).theta_.round(4).to_dict()
    {'a': 0.2231, 'b': 1.1157}
    """

    def __init__(
        self,
        estimator=None,
        *,
        structure=None,
        scale=True,
        n_starts=6,
        random_state=0,
        max_iter=100,
        tol=1e-8,
        warmup=None,
    ):
        self.estimator = estimator
        self.structure = structure
        self.scale = scale
        self.n_starts = n_starts
        self.random_state = random_state
        self.max_iter = max_iter
        self.tol = tol
        self.warmup = warmup

    @one_blas_thread
    @within_range
    def fit(self, X, y):
        """Match the structure to the model that rides on X.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            With a model riding on it, unless ``estimator`` is given.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Used where the model has to be brought to continuous time here.

        Returns
        -------
        self : StructuredMatcher
        """
        n_starts = check_count("n_starts", self.n_starts, 0, "0 tries none beyond the first")
        max_iter = check_count("max_iter", self.max_iter, 1, "100 is usual")
        tol = check_positive("tol", self.tol, "units of the norm", "1e-8 is usual")
        experiment, model = upstream(self, X, y)
        if experiment.basis is not None and experiment.basis.synchronous:
            raise ValueError(
                "the model was identified period by period (hop='period'): it is discrete, its "
                "states are not those of a harmonic decomposition, and no structure in continuous "
                "time can be matched to it; use a hop that divides the samples in a period"
            )
        model = to_continuous(model, experiment)
        if self.structure is None:
            return self._keep(model)._remember(model, experiment, X, y)
        structure = self._checked_structure(model)
        outputs, inputs = self._weights(model)
        result = match_structure(
            model.A,
            model.B,
            model.C,
            model.D,
            structure.affine,
            theta0=structure.initial,
            output_weights=outputs,
            input_weights=inputs,
            n_starts=n_starts,
            max_iter=max_iter,
            tol=tol,
            random_state=self.random_state,
        )
        self._warn(result, tol, model.n_states, structure.n_states)
        self._parameter_names = structure.parameter_names
        self._theta, self._theta_least_squares = result.theta, result.theta_least_squares
        self.hinf_error_, self.hinf_error_relative_ = result.hinf_error, result.relative_error
        self.peak_frequency_ = result.peak_frequency
        self.n_iter_ = result.n_iter
        matrices = (result.A, result.B, result.C, result.D)
        matched = model.in_continuous_time(*matrices, state_names=_state_names(structure, model))
        return self._remember(matched, experiment, X, y)

    def _keep(self, model):
        """No structure: every entry is a parameter, and the model stays as it is."""
        matrices = (model.A, model.B, model.C, model.D)
        self._parameter_names = tuple(
            f"{name}[{i},{j}]"
            for name, M in zip("ABCD", matrices, strict=True)
            for i, j in np.ndindex(M.shape)
        )
        self._theta = np.concatenate([M.ravel() for M in matrices])
        self._theta_least_squares = self._theta
        self.hinf_error_, self.hinf_error_relative_ = 0.0, 0.0
        self.peak_frequency_, self.n_iter_ = 0.0, 1
        return self

    @property
    def theta_(self):
        """Parameters by name, as a Series."""
        check_is_fitted(self)
        return pd.Series(self._theta, index=list(self._parameter_names), name="theta")

    @property
    def theta_least_squares_(self):
        """Parameters of the match in the mean square, as a Series."""
        check_is_fitted(self)
        names = list(self._parameter_names)
        return pd.Series(self._theta_least_squares, index=names, name="theta_least_squares")

    def _checked_structure(self, model):
        """The structure, after checking that it fits the model."""
        structure = self.structure
        if not isinstance(structure, MatrixStructure):
            raise ValueError(
                f"structure={structure!r} is not understood; give a MatrixStructure, or None to "
                f"leave every entry free"
            )
        for what, given, there in (
            ("inputs", structure.n_inputs, model.input_names),
            ("outputs", structure.n_outputs, model.output_names),
        ):
            if given != len(there):
                raise ValueError(
                    f"the structure has {given} {what}, the identified model {len(there)}: "
                    f"{list(there)}; give B, C and D of that size, or change the harmonics kept"
                )
        for what, given, there in (
            ("inputs", structure.input_names, model.input_names),
            ("outputs", structure.output_names, model.output_names),
        ):
            if given is not None and tuple(given) != tuple(there):
                raise ValueError(
                    f"the structure names its {what} {list(given)}, the identified model "
                    f"{list(there)}; give the same names in the same order"
                )
        return structure

    def _weights(self, model):
        """Diagonals of W_o and W_i."""
        if not self.scale:
            return None, None
        grid = matching_grid(np.linalg.eigvals(model.A))
        grid = grid[np.isfinite(grid)]
        return channel_scales(frequency_response(model.A, model.B, model.C, model.D, 1j * grid))

    def _warn(self, result, tol, n_found, n_wanted):
        if n_found != n_wanted and result.relative_error > POOR_MATCH:
            warnings.warn(
                f"the model has {n_found} states, the structure {n_wanted}, and the match leaves "
                f"a relative error of {result.relative_error:.2g}; the structure may not be that "
                f"of the system, or SpuriousModeReducer(n_states={n_wanted}) is needed",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if result.unidentified:
            warnings.warn(
                f"these outputs do not determine {', '.join(result.unidentified)} (only some "
                f"combinations of them): fix some, share a name, or measure more outputs",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if not result.converged:
            warnings.warn(
                f"the H-infinity match stopped after {result.n_iter} iterations at a relative "
                f"error of {result.relative_error:.3g}; it could still fall by "
                f"{result.predicted_decrease:.2g} of itself where tol={tol:g} was asked for; raise "
                f"max_iter or n_starts",
                ConvergenceWarning,
                stacklevel=5,
            )


def _state_names(structure, model):
    """Names of the states: the structure's, or those of the outputs where C is the identity."""
    if structure.state_names is not None:
        return tuple(structure.state_names)
    n = structure.n_states
    C = structure.affine.constant[n:, :n]
    fixed = not structure.affine.basis[:, n:, :n].any()
    return model.output_names if fixed and np.array_equal(C, np.eye(n)) else None
