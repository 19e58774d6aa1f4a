"""Linear time-periodic systems of which some Fourier coefficients are parameters."""

import copy
import numbers
from collections.abc import Mapping

import numpy as np
import pandas as pd
from scipy import sparse

from sklearn_hd.algorithms.fourier import harmonic_labels
from sklearn_hd.algorithms.periodic_structure import PeriodicStructure
from sklearn_hd.structures._cells import matrix_shape, read_cells, read_names

__all__ = ["HarmonicStructure"]


class HarmonicStructure:
    """Linear time-periodic system whose Fourier coefficients are the parameters.

        ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt                  (Eq. 6)
        F(ψ) = F_0 + Σ_k (F_kc cos kψ + F_ks sin kψ),   and so for G, P, Q

    In the harmonic decomposition each coefficient stands in several places, by the block
    pattern of Eq. 9, and ω itself stands where it is known: all that is one parameter here.

    Parameters
    ----------
    F, G, P, Q : int, dict or None
        A number of harmonics, every entry of every coefficient free. A dict by label,
        ``{"0": M_0, "1c": M_1c, …}``, of the coefficients that are not zero, each a matrix
        (or DataFrame) of entries as in :class:`MatrixStructure`: a number is fixed, NaN
        a parameter of its own, a text such as ``"-k"`` a parameter shared by name. Labels
        of a DataFrame must be the names of states, inputs and outputs, in their order.
        None lets the data decide: the number of harmonics of F and G; of P only those
        rows whose outputs are not states; Q is zero.
    states : sequence of str, optional
        Outputs that are the states, where as many outputs as states determine the state.
        By default the first that do. Where none do, the states are Floquet coordinates, in
        which F is constant, and P(ψ) holds the mode shapes.

    Raises
    ------
    ValueError
        If a label, a shape or an entry is not understood.

    References
    ----------
    Lopez, Prasad (2017), J. American Helicopter Society 62; Aerospace 2024, 11(11), 875,
    Eqs. 6 to 9.

    Examples
    --------
    The flapping torque acts on the second state only, as a cosine:

    >>> structure = HarmonicStructure(F=4, G={"1c": [[0.0], ["gain"]]})
    >>> structure.parameter_names(["w", "phi_dot"], ["U"])[-3:]
    ('F[phi_dot,w]_4s', 'F[phi_dot,phi_dot]_4s', 'gain')
    """

    def __init__(self, F=None, G=None, P=None, Q=None, *, states=None):
        given = {"F": F, "G": G, "P": P, "Q": Q}
        self._specs = {name: _specification(name, value) for name, value in given.items()}
        self.states = None if states is None else read_names("states", states)
        if self.states is not None and len(set(self.states)) != len(self.states):
            raise ValueError(f"states={list(self.states)} must be different outputs")
        self._check_shapes()

    def _check_shapes(self):
        n = self.n_states
        if self.states is not None and len(self.states) != n:
            raise ValueError(
                f"F is of {n} states, but states={list(self.states)} names {len(self.states)}; "
                f"give one name for each row of F"
            )
        for name, sides in {"F": (n, n), "G": (n, None), "P": (None, n), "Q": (None, None)}.items():
            spec = self._specs[name]
            if not isinstance(spec, dict):
                continue
            shapes = {label: matrix_shape(M, f"{name}_{label}") for label, M in spec.items()}
            if len(set(shapes.values())) > 1:
                raise ValueError(f"the coefficients of {name} differ in shape: {shapes}")
            shape = next(iter(shapes.values()))
            for found, wanted, side in zip(shape, sides, ("rows", "columns"), strict=True):
                if wanted is not None and found != wanted:
                    raise ValueError(
                        f"the coefficients of {name} have shape {shape}; with {n} states {name} "
                        f"must have {wanted} {side}"
                    )

    @property
    def n_states(self):
        """States that the structure calls for; None if any number is right."""
        if isinstance(self._specs["F"], dict):
            return matrix_shape(next(iter(self._specs["F"].values())), "F")[0]
        return None if self.states is None else len(self.states)

    def given_entries(self):
        """Those of F, G, P and Q whose entries are given, rather than a number of harmonics."""
        return [name for name, spec in self._specs.items() if isinstance(spec, dict)]

    def n_harmonics(self, name):
        """Highest harmonic of F, G, P or Q; None if the data decide."""
        spec = self._specs[name]
        if isinstance(spec, dict):
            return max(_order(label) for label in spec)
        return spec

    def parameter_names(self, states, inputs, outputs=None, **n_harmonics):
        """Names of the parameters for some states, inputs and outputs.

        ``F=``, ``G=``, ``P=`` give the number of harmonics where the data decide.
        """
        outputs = states if outputs is None else outputs
        return self.resolve(states, inputs, outputs, n_harmonics).parameter_names

    def resolve(self, states, inputs, outputs, n_harmonics, *, form=None):
        """The form that the algorithms work on, for signals of some names.

        Parameters
        ----------
        states, inputs, outputs : sequence of str
            Outputs among the states measure them.
        n_harmonics : dict
            Number of harmonics of F, G, P where the structure leaves it to the data.
        form : FloquetForm, optional
            What F may be in Floquet coordinates; takes the place of F.

        Returns
        -------
        structure : PeriodicStructure
        """
        sides = {"F": (states, states), "G": (states, inputs)}
        sides |= {"P": (outputs, states), "Q": (outputs, inputs)}
        terms = {
            name: self._terms(name, sides[name], n_harmonics.get(name))
            for name in "FGPQ"
            if name != "F" or form is None
        }
        highest = max([_order(label) for part in terms.values() for label in part], default=0)
        size = 1 + 2 * max(highest, 0 if form is None else form.n_harmonics)
        n = len(states)
        constant = np.zeros((size, n + len(outputs), n + len(inputs)))
        corners = {"F": (0, 0), "G": (0, n), "P": (n, 0), "Q": (n, n)}
        names, entries = {}, []
        for name, part in terms.items():
            top, left = corners[name]
            for label, cells in part.items():
                place = _place(label)
                for i, line in enumerate(cells):
                    for j, (number, parameter) in enumerate(line):
                        if parameter is None:
                            constant[place, top + i, left + j] = number
                        else:
                            column = names.setdefault(parameter, len(names))
                            entries.append((column, (place, top + i, left + j), number))
        if form is not None:
            places = range(min(size, len(form.constant)))
            constant[places, :n, :n] = form.constant[places]
            for parameter, direction in form.directions.items():
                column = names.setdefault(parameter, len(names))
                entries += [
                    (column, tuple(place), direction[tuple(place)])
                    for place in np.argwhere(direction)
                ]
        rows = [column for column, _, _ in entries]
        where = [np.ravel_multi_index(place, constant.shape) for _, place, _ in entries]
        values = [value for _, _, value in entries]
        basis = sparse.coo_array((values, (rows, where)), shape=(len(names), constant.size))
        return PeriodicStructure(constant, basis.tocsr(), n, tuple(names))

    def _terms(self, name, sides, chosen):
        """Cells of each coefficient of one matrix, by label."""
        spec, (rows, columns) = self._specs[name], sides
        if isinstance(spec, dict):
            found = matrix_shape(next(iter(spec.values())), name)
            if found != (len(rows), len(columns)):
                raise ValueError(
                    f"the coefficients of {name} have shape {found}, but {len(rows)} x "
                    f"{len(columns)} are needed for {list(rows)} by {list(columns)}"
                )
            for label, matrix in spec.items():
                _check_labels(f"{name}_{label}", matrix, rows, columns)
            return {
                label: _cells(name, label, matrix, rows, columns) for label, matrix in spec.items()
            }
        count = chosen if spec is None else spec
        if count is None:
            return {} if name != "P" else {"0": _measured(rows, columns)}
        labels = harmonic_labels(range(count + 1))
        free = np.full((len(rows), len(columns)), np.nan)
        terms = {label: _cells(name, label, free, rows, columns) for label in labels}
        if name == "P" and spec is None:
            identity = _measured(rows, columns)
            for label, cells in terms.items():
                for i, row in enumerate(rows):
                    if row in columns:
                        cells[i] = identity[i] if label == "0" else [(0.0, None)] * len(columns)
        return terms

    def _key(self):
        specs = tuple(
            (
                name,
                tuple(
                    (label, repr(np.asarray(M, dtype=object).tolist())) for label, M in spec.items()
                ),
            )
            if isinstance(spec, dict)
            else (name, spec)
            for name, spec in self._specs.items()
        )
        return specs, self.states

    def __eq__(self, other):
        if not isinstance(other, HarmonicStructure):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self):
        return hash(self._key())

    def __repr__(self):
        words = [
            f"{name}={spec if not isinstance(spec, dict) else '{' + ', '.join(spec) + '}'}"
            for name, spec in self._specs.items()
            if spec is not None
        ]
        if self.states is not None:
            words.append(f"states={list(self.states)}")
        return f"HarmonicStructure({', '.join(words)})"


def _specification(name, value):
    """A number of harmonics, a dict of coefficients by label, or None."""
    if value is None:
        return None
    if isinstance(value, Mapping) and value:
        for label in value:
            _order(label, name)
        return {label: copy.copy(matrix) for label, matrix in value.items()}
    if isinstance(value, numbers.Integral) and not isinstance(value, bool) and value >= 0:
        return int(value)
    raise ValueError(
        f"{name}={value!r} is not understood; give a number of harmonics, a dict of coefficients "
        f"by label such as {{'0': …, '1c': …}}, or None"
    )


def _check_labels(what, matrix, rows, columns):
    """Raise ValueError if a DataFrame is labelled otherwise than the signals are named."""
    if not isinstance(matrix, pd.DataFrame):
        return
    for axis, names in ((matrix.index, rows), (matrix.columns, columns)):
        if not isinstance(axis, pd.RangeIndex) and [str(x) for x in axis] != list(names):
            raise ValueError(
                f"{what} is labelled {[str(x) for x in axis]} where the signals are {list(names)}; "
                f"give the same names in the same order, or an array"
            )


def _order(label, name="a coefficient"):
    """Harmonic k of a label 0, kc or ks."""
    text = label if isinstance(label, str) else ""
    if text == "0":
        return 0
    if text[:-1].isdecimal() and int(text[:-1]) > 0 and text[-1] in "cs":
        return int(text[:-1])
    raise ValueError(
        f"{label!r} is no label of {name}; labels are '0', '1c', '1s', '2c', … (mean, cosine, sine)"
    )


def _place(label):
    """Place of a coefficient in the order 0, 1c, 1s, 2c, …."""
    k = _order(label)
    return 2 * k - (label[-1] == "c") if k else 0


def _cells(name, label, matrix, rows, columns):
    """(number, None) or (scale, parameter name) of each entry, NaN named after its place."""
    cells = read_cells(name, matrix, rows, columns)
    return [
        [
            (
                number,
                f"{parameter}_{label}" if parameter == f"{name}[{row},{column}]" else parameter,
            )
            for (number, parameter), column in zip(line, columns, strict=True)
        ]
        for line, row in zip(cells, rows, strict=True)
    ]


def _measured(outputs, states):
    """Cells of a P that measures those states that are outputs."""
    return [[(float(output == state), None) for state in states] for output in outputs]
