"""Linear time-periodic systems of which some Fourier coefficients are parameters."""

import copy
import numbers
import re
import reprlib
from collections.abc import Mapping

import numpy as np
from scipy import sparse

from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import harmonic_labels
from sklearn_hd.structures._structure import (
    FREE,
    Structure,
    Table,
    axis_names,
    check_known,
    check_places,
    describe,
    fill_all,
    matrix_shape,
    name_places,
    parameter_names,
    read_cells,
    read_fixed,
    read_names,
)

MOST_HARMONICS = 10_000  # no record tells more apart
_PLACE = re.compile(r"(?P<matrix>[FGPQ])\[.*\]_(?P<label>0|[1-9]\d*[cs])")


class HarmonicStructure(Structure):
    """Linear time-periodic system whose Fourier coefficients are the parameters.

        ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt                  (Eq. 6)
        F(ψ) = F_0 + Σ_k (F_kc cos kψ + F_ks sin kψ),   and so for G, P, Q

    In the harmonic decomposition each coefficient appears in several places, by the block pattern
    of Eq. 9, next to the known ω. Here each coefficient is one parameter.

    Parameters
    ----------
    F, G, P, Q : int, dict or None
        A number of harmonics, with every entry of every coefficient free. Or a dict by label,
        ``{"0": M_0, "1c": M_1c, …}``, of the coefficients that are not zero, each a matrix (or
        DataFrame) of entries as in :class:`MatrixStructure`: a number is fixed, NaN is a separate
        parameter, a text such as ``"1 - 2*k"`` is affine in parameters shared by name. Labels of a
        DataFrame must be the names of states, inputs and outputs, in their order. None lets the
        data decide: the number of harmonics of F and G, and those rows of P whose outputs are not
        states; Q is zero, unless the data show a feedthrough (by whole periods only if F, G, P, Q
        and ``states`` are all None).
    states : sequence of str, optional
        Outputs that are the states, if as many outputs as states determine the state. By default
        the first ones that do. If none do, the states are Floquet coordinates, in which F is
        constant, and P(ψ) holds the mode shapes, each with an rms of one over a turn (before a
        likelihood or ``fixed`` changes it).
    fixed : mapping of str to float, optional
        Parameters with a known value; they become numbers. ``"F[w,phi_dot]_1c"`` is the place of
        an entry.

    Attributes
    ----------
    n_states : int or None
    fixed : dict of str to float

    Raises
    ------
    ValueError
        If a label, a shape, an entry or a name is not understood.

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
    >>> print(structure.fix({"gain": 2}))
    F: 4 harmonics, every entry free
    G_1c = [ 0 ]
           [ 2 ]
    P: outputs that are states measure them; the data decide for the others
    Q: zero, unless the data show a feedthrough
    gain = 2, fixed
    """

    def __init__(self, F=None, G=None, P=None, Q=None, *, states=None, fixed=None):
        given = {"F": F, "G": G, "P": P, "Q": Q}
        self._specs = {name: read_specification(name, value) for name, value in given.items()}
        self.states = None if states is None else read_names("states", states)
        if self.states is not None and len(set(self.states)) != len(self.states):
            raise ValueError(f"states={list(self.states)} must be different outputs")
        self._check_shapes()
        self._fixed = read_fixed(fixed)
        self._check_fixed("fixed", self._fixed)

    def _check_shapes(self):
        n = self.n_states
        if self.states is not None and len(self.states) != n:
            raise ValueError(
                f"F has {n} states, but states={list(self.states)} names {len(self.states)}; give "
                f"one name for each row of F"
            )
        for name, sides in {"F": (n, n), "G": (n, None), "P": (None, n), "Q": (None, None)}.items():
            spec = self._specs[name]
            if not isinstance(spec, dict):
                continue
            shapes = {label: shape_of(cells) for label, (cells, *_) in spec.items()}
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
        """Number of states that the structure needs; None if it accepts any."""
        if isinstance(self._specs["F"], dict):
            return shape_of(next(iter(self._specs["F"].values()))[0])[0]
        return None if self.states is None else len(self.states)

    def given_entries(self):
        """Those of F, G, P and Q whose entries are given, not only a number of harmonics.

        Returns
        -------
        names : list of str
            Among ``"F"``, ``"G"``, ``"P"`` and ``"Q"``.
        """
        fixed = {place["matrix"] for place in map(_PLACE.fullmatch, self._fixed) if place}
        return [
            name for name, spec in self._specs.items() if isinstance(spec, dict) or name in fixed
        ]

    @property
    def left_open(self):
        """Whether nothing is asked for: no harmonics, no entries, no states."""
        given = self.states is not None or bool(self._fixed)
        return not given and all(spec is None for spec in self._specs.values())

    def n_harmonics(self, name):
        """Highest harmonic of F, G, P or Q; None if the data decide.

        Parameters
        ----------
        name : {"F", "G", "P", "Q"}
            Which matrix.

        Returns
        -------
        n_harmonics : int or None
            K, of coefficients 0, 1c, 1s, … Kc, Ks.
        """
        spec = self._specs[name]
        if isinstance(spec, dict):
            return max(order_of(label) for label in spec)
        return spec

    def parameter_names(self, states, inputs, outputs=None, **n_harmonics):
        """Names of the parameters for some states, inputs and outputs.

        Parameters
        ----------
        states, inputs : sequence of str
            Their names.
        outputs : sequence of str, optional
            The states by default.
        **n_harmonics : int
            Of ``F``, ``G``, ``P`` and ``Q``, where the structure leaves it to the data.

        Returns
        -------
        names : tuple of str
            In the order of ``theta_``; without those fixed.
        """
        outputs = states if outputs is None else outputs
        return self.resolve(states, inputs, outputs, n_harmonics).parameter_names

    def _with_fixed(self, fixed):
        new = copy.copy(self)
        new._fixed = fixed
        return new

    def _named(self):
        """Names used in the given coefficients."""
        specs = [spec for spec in self._specs.values() if isinstance(spec, dict)]
        cells = [cells for spec in specs for cells, *_ in spec.values()]
        return tuple(name for name in parameter_names(cells) if name is not None)

    def _check_fixed(self, what, fixed):
        """Raise ValueError for names that cannot become parameters with any signals."""
        named = self._named()
        for name in fixed:
            if name in named:
                continue
            place = _PLACE.fullmatch(str(name))
            if place is None:
                raise ValueError(
                    f"{what} names {name!r}, which is not a parameter; give one of {list(named)}, "
                    f"or the place of a free entry, such as 'F[w,phi_dot]_1c'"
                )
            matrix, order = place["matrix"], order_of(place["label"])
            spec = self._specs[matrix]
            labels = spec if isinstance(spec, dict) else labels_up_to(spec)
            if place["label"] not in labels:
                raise ValueError(
                    f"{what} names {name!r}, but {_written(matrix, spec)} does not include it; "
                    f"give {matrix} harmonic {order}, as a number or in a dict, to fix an entry of "
                    f"it"
                )

    def resolve(self, states, inputs, outputs, n_harmonics, *, form=None):
        """The form that the algorithms work on, for signals of some names.

        Parameters
        ----------
        states, inputs, outputs : sequence of str
            Outputs that are also states measure them.
        n_harmonics : dict
            Number of harmonics of F, G, P, Q where the structure leaves it to the data.
        form : FloquetForm, optional
            Form of F in Floquet coordinates; it replaces F.

        Returns
        -------
        structure : PeriodicStructure
            The coefficients of F, G, P and Q, affine in the parameters.

        Raises
        ------
        ValueError
            If shapes or labels do not fit the signals, or two of a kind share a name.
        """
        for kind, names in (("states", states), ("inputs", inputs), ("outputs", outputs)):
            twice = sorted({name for name in names if list(names).count(name) > 1})
            if twice:
                raise ValueError(
                    f"{kind}={list(names)} names {twice} more than once, and entries would share "
                    f"parameters; give each a name of its own"
                )
        sides = {"F": (states, states), "G": (states, inputs)}
        sides |= {"P": (outputs, states), "Q": (outputs, inputs)}
        if form is not None:
            del sides["F"]
        cells = {name: self._terms(name, sides[name], n_harmonics.get(name)) for name in sides}
        highest = max((order_of(label) for part in cells.values() for label in part), default=0)
        size = 1 + 2 * max(highest, 0 if form is None else form.n_harmonics)
        n = len(states)
        constant = np.zeros((size, n + len(outputs), n + len(inputs)))
        names, known, places, entries = {}, {}, {}, []
        corners = {"F": (0, 0), "G": (0, n), "P": (n, 0), "Q": (n, n)}
        for name, label in ((name, label) for name, part in cells.items() for label in part):
            (top, left), (rows, columns) = corners[name], sides[name]
            named, own = name_places(cells[name][label], name, rows, columns, f"_{label}")
            places |= own
            for i, j in np.ndindex(len(rows), len(columns)):
                at = place_of(label), top + i, left + j
                constant[at], terms = named[i][j]
                for parameter, scale in terms:
                    known[parameter] = True
                    if parameter in self._fixed:
                        constant[at] += scale * self._fixed[parameter]
                    else:
                        entries.append((names.setdefault(parameter, len(names)), *at, scale))
        check_places(places)
        check_known("fixed", self._fixed, known)
        if form is not None:
            count = min(size, len(form.constant))
            constant[:count, :n, :n] = form.constant[:count]
            for parameter, direction in form.directions.items():
                column = names.setdefault(parameter, len(names))
                entries += [(column, *at, direction[tuple(at)]) for at in np.argwhere(direction)]
        table = np.array(entries, dtype=float).reshape(-1, 5)
        where = np.ravel_multi_index(tuple(table[:, 1:4].T.astype(int)), constant.shape)
        shape = len(names), constant.size
        basis = sparse.coo_array((table[:, 4], (table[:, 0].astype(int), where)), shape).tocsr()
        _check_independent(basis, tuple(names))
        return PeriodicStructure(constant, basis, n, tuple(names))

    def _terms(self, name, sides, chosen):
        """Cells of each coefficient of one matrix, by label."""
        spec, (rows, columns) = self._specs[name], sides
        if isinstance(spec, dict):
            found = shape_of(next(iter(spec.values()))[0])
            if found != (len(rows), len(columns)):
                raise ValueError(
                    f"the coefficients of {name} have shape {found}, but {len(rows)} x "
                    f"{len(columns)} are needed for {list(rows)} by {list(columns)}"
                )
            for label, (_, *labels) in spec.items():
                check_labels(f"{name}_{label}", labels, sides)
            return {label: given for label, (given, *_) in spec.items()}
        labels = labels_up_to(chosen if spec is None else spec)
        if name != "P" or spec is not None:
            return dict.fromkeys(labels, [[FREE] * len(columns)] * len(rows))
        cells = {}
        for label in labels or ["0"]:  # states that are outputs are measured as they are
            cells[label] = [[FREE if labels else (0.0, ())] * len(columns) for _ in rows]
            for i in np.flatnonzero(np.isin(rows, columns)):
                cells[label][i] = [(float(rows[i] == x and label == "0"), ()) for x in columns]
        return cells

    def _key(self):
        specs = tuple(
            tuple(spec.items()) if isinstance(spec, dict) else spec for spec in self._specs.values()
        )
        return specs, self.states, tuple(sorted(self._fixed.items()))

    def __repr__(self):
        words = [_written(name, spec) for name, spec in self._specs.items() if spec is not None]
        if self.states is not None:
            words.append(f"states={list(self.states)}")
        if self._fixed:
            words.append(f"fixed={self._fixed}")
        return f"HarmonicStructure({', '.join(words)})"

    def _shown(self):
        """Tables of the given coefficients, and a line for each matrix without them."""
        shown = []
        for name, spec in self._specs.items():
            if not isinstance(spec, dict):
                shown.append(f"{name}: {_OPEN[name] if spec is None else _counted(spec)}")
                continue
            for label, (cells, rows, columns) in spec.items():
                rows = self.states if rows is None and name in "FG" else rows
                columns = self.states if columns is None and name in "FP" else columns
                named, _ = name_places(cells, name, rows, columns, f"_{label}")
                shown.append(Table(name, fill_all(named, self._fixed), rows, columns, label))
        return shown

    def _notes(self):
        return describe(self._fixed, self._fixed)


_OPEN = {
    "F": "the data decide how many harmonics",
    "G": "the data decide how many harmonics",
    "P": "outputs that are states measure them; the data decide for the others",
    "Q": "zero, unless the data show a feedthrough",
}


def _counted(number):
    return f"{number} harmonic{'s' * (number != 1)}, every entry free"


def _written(name, spec):
    return f"{name}={'{' + ', '.join(spec) + '}' if isinstance(spec, dict) else spec}"


def _check_independent(basis, names):
    """Raise ValueError if the entries cannot determine some parameters separately."""
    counts = np.bincount(basis.indices, minlength=basis.shape[1])
    mixed = np.unique(sparse.coo_array(basis[:, counts > 1]).row)
    if not len(mixed):
        return
    rows = basis[mixed].toarray()
    R = np.linalg.qr((rows / np.linalg.norm(rows, axis=1)[:, None]).T, mode="r")
    U, values, _ = np.linalg.svd(R.T)  # of a matrix as wide as high at most
    rank = int(np.sum(values > 1e-10 * values[0]))
    if rank < len(mixed):
        alike = [names[k] for k in mixed[np.linalg.norm(U[:, rank:], axis=1) > 1e-10]]
        raise ValueError(
            f"the entries determine only combinations of {alike}; give each its own entry, or fix "
            f"some"
        )


def read_specification(name, value):
    """A number of harmonics, a dict of coefficients by label, or None.

    Each coefficient is given by its cells and the names of its rows and columns, or None.
    """
    if value is None:
        return None
    if isinstance(value, Mapping) and value:
        return {label: _coefficient(name, label, matrix) for label, matrix in value.items()}
    if isinstance(value, numbers.Integral) and not isinstance(value, bool) and value >= 0:
        _check_order(name, value)
        return int(value)
    raise ValueError(
        f"{name}={value!r} is not understood; give a number of harmonics, a dict of coefficients "
        f"by label such as {{'0': …, '1c': …}}, or None"
    )


def _coefficient(name, label, matrix):
    order_of(label, name)
    matrix_shape(matrix, f"{name}_{label}")
    rows, columns = axis_names(matrix, "index"), axis_names(matrix, "columns")
    return read_cells(name, matrix, rows, columns, f"_{label}"), rows, columns


def shape_of(cells):
    return len(cells), len(cells[0]) if cells else 0


def check_labels(what, labels, sides):
    """Raise ValueError if the labels of a DataFrame are not the names of the signals."""
    for found, names in zip(labels, sides, strict=True):
        if found is not None and list(found) != list(names):
            raise ValueError(
                f"{what} is labelled {list(found)}, but the signals are {list(names)}; give the "
                f"same names in the same order, or an array"
            )


def order_of(label, name="a coefficient"):
    """Harmonic k of a label 0, kc or ks."""
    text = label if isinstance(label, str) else ""
    if text == "0":
        return 0
    if text[:-1].isdecimal() and int(text[:-1]) > 0 and text[-1] in "cs":
        _check_order(name, int(text[:-1][:20]))
        return int(text[:-1])
    raise ValueError(
        f"{label!r} is not a label of {name}; labels are '0', '1c', '1s', '2c', … (mean, cosine, "
        f"sine)"
    )


def _check_order(name, harmonic):
    """Raise ValueError for harmonics that no record can show."""
    if harmonic > MOST_HARMONICS:
        raise ValueError(
            f"harmonic {reprlib.repr(harmonic)} of {name} is beyond {MOST_HARMONICS}, more than "
            f"any record determines; give fewer harmonics"
        )


def labels_up_to(count):
    """Labels of the coefficients up to some harmonic; none if it is None."""
    return [] if count is None else harmonic_labels(range(count + 1))


def place_of(label):
    """Place of a coefficient in the order 0, 1c, 1s, 2c, …."""
    k = order_of(label)
    return 2 * k - (label[-1] == "c") if k else 0
