"""Common part of both structures: entries, knowledge of named parameters, display.

Entries are affine in named parameters: "1.5 - 0.5*k1 + 2*k2" is the cell
(1.5, (("k1", -0.5), ("k2", 2.0))), a constant and terms, each a name and its factor; a name of
None stands for a parameter named after its place. A parameter may have a fixed value, a start
value and bounds.
"""

import ast
import math
import operator
import re
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from numbers import Real

import numpy as np
import pandas as pd

FREE = (0.0, ((None, 1.0),))
_NUMBER = r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
_NAME = r"(?P<name>[^\W\d]\w*(?:\[[^\]]*\]\w*)?)"
_TOKEN = re.compile(f"{_NUMBER}|{_NAME}")
_RESERVED = {"nan", "inf", "infinity"}
_SUMS = {ast.Add: operator.add, ast.Sub: operator.sub}
_PRODUCTS = {ast.Mult: ("multiplies", "product"), ast.Div: ("divides", "quotient")}
_FREE_CELL = ' style="text-align:right; font-weight:bold; background:rgba(70,130,180,0.2)"'
_NUMBER_CELL = ' style="text-align:right"'
_NAME_CELL = ' style="text-align:right; font-weight:normal"'
_TABLE = ' style="color:inherit"'
_CAPTION = ' style="caption-side:top; text-align:center"'
_ROW = ' style="display:flex; flex-wrap:wrap; gap:1.5em; align-items:flex-start"'


def read_cells(name, matrix, rows, columns, tail=""):
    """Tuples of the cells of a matrix, row by row; its rows and columns may have names."""
    matrix = np.asarray(matrix, dtype=object)
    rows = range(matrix.shape[0]) if rows is None else rows
    columns = range(matrix.shape[1]) if columns is None else columns
    return tuple(
        tuple(
            _cell(value, f"{name}[{row},{column}]{tail}")
            for value, column in zip(line, columns, strict=True)
        )
        for line, row in zip(matrix, rows, strict=True)
    )


def _cell(value, place):
    if isinstance(value, str):
        return _text(value, place)
    if value is None or value is pd.NA or (isinstance(value, Real) and value != value):
        return FREE
    number = finite_number(value)
    if number is not None:
        return number + 0.0, ()  # no negative zero
    raise ValueError(
        f"{place} = {value!r} is not an entry; give a finite number (fixed), NaN (free) or a text "
        f"of numbers and parameters, such as 'k' or '1.5 - 2*k'"
    )


def finite_number(value):
    """A float; None if the value is no finite number."""
    try:
        real = isinstance(value, Real) and not isinstance(value, bool)
        number = float(value) if real else math.nan
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def _text(text, place):
    try:
        number = float(text)
    except ValueError:
        return _expression(text, place)
    return _cell(number, place)


def _expression(text, place):
    """Cell of a text such as '(k1 + k2)/2'; names are cut out before Python reads it."""
    names = []

    def placeholder(token):
        if token["number"]:
            return token["number"]
        if token["name"] not in names:
            names.append(token["name"])
        return f"p{names.index(token['name'])}"

    source = _TOKEN.sub(placeholder, text).strip()
    try:
        tree = ast.parse(source, mode="eval").body
        if not _RESERVED.isdisjoint(name.lower() for name in names):
            raise ValueError
        constant, terms = _value(tree, names)
    except _NotAffineError as error:
        raise ValueError(f"{place} = {text!r} {error}") from None
    except ArithmeticError:
        constant, terms = math.inf, {}
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ValueError(
            f"{place} = {text!r} is not understood; write numbers and parameters with + - * / and "
            f"parentheses, such as 'k', '-k', '2*k' or '1.5 - (k1 + k2)/2'; a name begins with a "
            f"letter"
        ) from None
    if not all(map(math.isfinite, (constant, *terms.values()))):
        raise ValueError(f"{place} = {text!r} is not an entry: its numbers must be finite")
    for name, scale in terms.items():
        if scale == 0.0:
            raise ValueError(f"{place} = {text!r} does not depend on {name!r}; leave it out")
    return constant + 0.0, tuple(terms.items())


class _NotAffineError(Exception):
    """A product of parameters, or a quotient by one."""


def _value(node, names):
    """(constant, {name: factor}) of a piece of an expression."""
    match node:
        case ast.Constant(value=int() | float() as number):
            return float(number), {}
        case ast.Name(id=key):
            return 0.0, {names[int(key[1:])]: 1.0}
        case ast.UnaryOp(op=ast.UAdd(), operand=operand):
            return _value(operand, names)
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return _scaled(_value(operand, names), -1.0, operator.mul)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
            return _sum(_value(left, names), _value(right, names), _SUMS[type(op)])
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as op, right=right):
            return _product(_value(left, names), _value(right, names), type(op))
    raise ValueError


def _sum(left, right, sign):
    names = dict.fromkeys([*left[1], *right[1]])
    terms = {name: sign(left[1].get(name, 0.0), right[1].get(name, 0.0)) for name in names}
    return sign(left[0], right[0]), terms


def _product(left, right, kind):
    """Product or quotient, one factor of which must be a number."""
    if not right[1]:
        return _scaled(left, right[0], operator.truediv if kind is ast.Div else operator.mul)
    if kind is ast.Mult and not left[1]:
        return _scaled(right, left[0], operator.mul)
    verb, noun = _PRODUCTS[kind]
    raise _NotAffineError(
        f"{verb} by {' and '.join(map(repr, right[1]))}; entries must be affine in the parameters, "
        f"sums of numbers and multiples of them: give the {noun} a name of its own"
    )


def _scaled(value, factor, operation):
    terms = {name: operation(scale, factor) for name, scale in value[1].items()}
    return operation(value[0], factor), terms


def name_places(cells, head, rows, columns, tail=""):
    """The same cells, nameless parameters called after their place, and the cell at each place."""
    rows = range(len(cells)) if rows is None else rows
    named, places = [], {}
    for line, row in zip(cells, rows, strict=True):
        labels = range(len(line)) if columns is None else columns
        named_line = []
        for cell, column in zip(line, labels, strict=True):
            place = f"{head}[{row},{column}]{tail}"
            places[place] = (0.0, ((place, 1.0),)) if cell == FREE else cell
            named_line.append(places[place])
        named.append(tuple(named_line))
    return tuple(named), places


def check_places(places):
    """Raise ValueError where a parameter is called after the place of another entry."""
    used = {name for _, terms in places.values() for name, _ in terms}
    for place in sorted(used & places.keys()):
        if places[place] != (0.0, ((place, 1.0),)):
            raise ValueError(
                f"{place!r} is used as the name of a parameter, but the entry at that place is "
                f"{format_cell(places[place])}; leave that entry free (NaN), or use another name"
            )


def fill(cell, fixed):
    """The cell with numbers in place of some parameters."""
    constant, terms = cell
    constant += sum(scale * fixed[name] for name, scale in terms if name in fixed)
    return constant, tuple((name, scale) for name, scale in terms if name not in fixed)


def fill_all(cells, fixed):
    """Cells of a matrix with numbers in place of some parameters."""
    return tuple(tuple(fill(cell, fixed) for cell in line) for line in cells)


def format_cell(cell):
    """Text of a cell: 1.5 - 0.5*k."""
    constant, terms = cell
    parts = [(constant, "")] if constant or not terms else []
    parts += [(scale, name) for name, scale in terms]
    text = ""
    for number, name in parts:
        sign = "-" if number < 0 else "+"
        text += f" {sign} " if text else sign.strip("+")
        size = f"{abs(number):.6g}"
        text += size if not name else name if size == "1" else f"{size}*{name}"
    return text


def parameter_names(matrices):
    """Names in the order of their first appearance, by rows."""
    return tuple(
        dict.fromkeys(
            name for cells in matrices for line in cells for _, terms in line for name, _ in terms
        )
    )


def read_names(name, given):
    """Names as texts, from any sequence of them; a single text is no sequence of letters."""
    if isinstance(given, str) or not np.iterable(given):
        raise ValueError(
            f"{name}={given!r} is not a sequence of names; give a list such as ['w', 'phi_dot'], "
            f"or None"
        )
    return tuple(map(str, given))


def axis_names(matrix, axis):
    """Labels of a DataFrame's index or columns; None without, or if they merely count."""
    labels = getattr(matrix, axis) if isinstance(matrix, pd.DataFrame) else None
    if labels is None or isinstance(labels, pd.RangeIndex):
        return None
    return tuple(map(str, labels))


def matrix_shape(matrix, name):
    """Shape of a matrix given as array, nested list or DataFrame."""
    try:
        shape = np.shape(np.asarray(matrix, dtype=object))
    except ValueError:
        shape = ()
    if len(shape) != 2:
        raise ValueError(f"{name} must be a matrix, rows of equal length; got shape {shape}")
    return shape


class Structure:
    """What both structures share: parameters to fix and free, equality, text and HTML.

    A structure has ``_fixed``, ``_check_fixed``, ``_with_fixed``, ``_key``, ``_shown`` and
    ``_notes``.
    """

    @property
    def fixed(self):
        """Value of each parameter that is fixed, by name."""
        return dict(self._fixed)

    def fix(self, values):
        """The structure with numbers in place of some parameters.

        Parameters
        ----------
        values : mapping of str to float
            Values by the name of the parameter.

        Returns
        -------
        structure : MatrixStructure or HarmonicStructure
            A new one; this one stays as it is.

        Raises
        ------
        ValueError
            If a name is no parameter, or a value is no finite number within its bounds.
        """
        values = read_fixed(values)
        self._check_fixed("fix", values)
        return self._with_fixed(join_fixed(self._fixed, values))

    def free(self, names=None):
        """The structure with some fixed parameters free again.

        Parameters
        ----------
        names : sequence of str, optional
            All that are fixed by default.

        Returns
        -------
        structure : MatrixStructure or HarmonicStructure
            Where it has initial values, those freed start at the value they had.

        Raises
        ------
        ValueError
            If a name is not that of a fixed parameter.
        """
        names = freed(self._fixed, names)
        return self._with_fixed({k: x for k, x in self._fixed.items() if k not in names})

    def __eq__(self, other):
        return self._key() == other._key() if isinstance(other, type(self)) else NotImplemented

    def __hash__(self):
        return hash(self._key())

    def __str__(self):
        """Text of tables and of lines between and after them."""
        shown = [part if isinstance(part, str) else _text_of_table(part) for part in self._shown()]
        return "\n".join([*shown, *self._notes()])

    def _repr_html_(self):
        """HTML of tables and of lines between and after them: what is free is bold on a ground."""
        parts = self._shown()
        tables = "".join(_html_of_table(part) for part in parts if not isinstance(part, str))
        lines = [part for part in parts if isinstance(part, str)] + list(self._notes())
        below = "".join(f"<div>{escape(line)}</div>" for line in lines)
        return f"<div><div{_ROW}>{tables}</div>{below}</div>"


def read_fixed(given, names=None):
    """{name: number} of parameters that are known; the names must be among some."""
    fixed = {
        name: _number(f"fixed value of {name!r}", value)
        for name, value in _mapping("fixed", given, "{'k': 2.0}").items()
    }
    if names is not None:
        check_known("fixed", fixed, names)
    return fixed


def join_fixed(fixed, more):
    """Both, where they do not contradict each other."""
    for name, value in more.items():
        if fixed.get(name, value) != value:
            raise ValueError(
                f"{name!r} is fixed at {fixed[name]:g} already and cannot be {value:g} too; "
                f"free([{name!r}]) first"
            )
    return {**fixed, **more}


def freed(fixed, names):
    """Names to be freed, all by default, after checking that they are fixed."""
    if names is None:
        return tuple(fixed)
    if isinstance(names, str) or not np.iterable(names):
        raise ValueError(f"free({names!r}): give a list of names, such as ['k']")
    names = tuple(names)
    unknown = [name for name in names if name not in fixed]
    if unknown:
        raise ValueError(f"{unknown} are not fixed, so cannot be freed; fixed are {list(fixed)}")
    return names


def read_bounds(given, names):
    """{name: (low, high)}, None for an open end; names without any bound are left out."""
    given = _mapping("bounds", given, "{'k': (0.0, None)}")
    check_known("bounds", given, names)
    bounds = {name: _interval(name, ends) for name, ends in given.items()}
    return {name: ends for name, ends in bounds.items() if ends != (None, None)}


def _interval(name, given):
    try:
        low, high = given
        low, high = _end(low, -np.inf), _end(high, np.inf)
    except (TypeError, ValueError, OverflowError):
        low = high = np.nan
    if not low < high:
        raise ValueError(
            f"bounds of {name!r} are {given!r}; give (low, high) with low < high, and None where "
            f"it is open; use fixed for a single value"
        )
    return tuple(float(end) if np.isfinite(end) else None for end in (low, high))


def _end(value, unbounded):
    if value is None:
        return unbounded
    if isinstance(value, str | bool):
        raise TypeError
    return float(value)


def read_initial(given, names, fixed):
    """{name: number} of all of some names; those fixed may be there, at their value."""
    if given is None:
        return None
    if not isinstance(given, Mapping | pd.Series):
        return dict(zip(names, read_numbers("initial", given, names).tolist(), strict=True))
    initial = _mapping("initial", given, "{'k': 2.0}")
    unknown = [name for name in initial if name not in names and name not in fixed]
    missing = [name for name in names if name not in initial]
    if unknown or missing:
        raise ValueError(
            f"initial must give every parameter and no other; missing {missing}, unknown "
            f"{unknown}, allowed {list(names)}"
        )
    initial = {name: _number(f"initial value of {name!r}", x) for name, x in initial.items()}
    for name in initial.keys() & fixed.keys():
        if initial[name] != fixed[name]:
            raise ValueError(
                f"initial gives {name!r} the value {initial[name]:g}, but it is fixed at "
                f"{fixed[name]:g}; leave it out of one of the two"
            )
    return {name: initial[name] for name in names}


def check_within(what, values, bounds):
    """Raise ValueError naming the parameter whose value its bounds exclude."""
    for name, value in values.items():
        low, high = bounds.get(name, (None, None))
        if (low is not None and value < low) or (high is not None and value > high):
            raise ValueError(
                f"the {what} value {value:g} of {name!r} is outside its bounds ({low}, {high}); "
                f"change one of them"
            )


def bound_array(bounds, names, end, unbounded):
    """One end of the bounds of some names, shape (k,), infinite where open."""
    ends = (bounds.get(name, (None, None))[end] for name in names)
    return np.array([unbounded if value is None else value for value in ends], dtype=float)


def describe(names, fixed, initial=None, bounds=None):
    """A line for each parameter of which something is known."""
    lines = []
    for name in names:
        if name in fixed:
            lines.append(f"{name} = {fixed[name]:.6g}, fixed")
            continue
        low, high = (bounds or {}).get(name, (None, None))
        left = "" if low is None else f"{low:.6g} <= "
        right = "" if high is None else f" <= {high:.6g}"
        start = f", initial {initial[name]:.6g}" if initial else ""
        if left or right or start:
            lines.append(f"{left}{name}{right}{start}")
    return lines


def check_known(what, given, names):
    """Raise ValueError if a name is no parameter."""
    unknown = [name for name in given if name not in names]
    if unknown:
        raise ValueError(
            f"{what} names {unknown}, which are not parameters here; allowed are {list(names)}"
        )


def read_numbers(what, values, names):
    """One finite float for each name, in their order."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        numbers = None
    if numbers is None or numbers.shape != (len(names),) or not np.all(np.isfinite(numbers)):
        raise ValueError(
            f"{what} must hold {len(names)} finite numbers, one for each of {list(names)}; got "
            f"{values!r}"
        )
    return numbers


def _mapping(what, given, example):
    if given is None:
        return {}
    if not isinstance(given, Mapping | pd.Series):
        raise ValueError(f"{what}={given!r} is not a mapping by name; give one such as {example}")
    if isinstance(given, pd.Series) and not given.index.is_unique:
        twice = list(given.index[given.index.duplicated()].unique())
        raise ValueError(f"{what} names {twice} more than once; give every name one value")
    return dict(given)


def _number(what, value):
    number = finite_number(value)
    if number is None:
        raise ValueError(f"the {what} must be a finite number; got {value!r}")
    return number


@dataclass(frozen=True)
class Table:
    """A matrix to be shown: its letter, the harmonic it belongs to, cells, and names if any."""

    letter: str
    cells: tuple
    rows: tuple | None = None
    columns: tuple | None = None
    harmonic: str = ""


def _text_of_table(table):
    texts = [[format_cell(cell) for cell in line] for line in table.cells]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    head = f"{table.letter}_{table.harmonic} = " if table.harmonic else f"{table.letter} = "
    lines = ["[ " + "  ".join(map(str.rjust, line, widths)) + " ]" for line in texts] or ["[ ]"]
    return head + ("\n" + " " * len(head)).join(lines)


def _html_of_table(table):
    n_columns = len(table.cells[0]) if table.cells else 0
    rows = range(len(table.cells)) if table.rows is None else table.rows
    columns = range(n_columns) if table.columns is None else table.columns
    caption = f"<i>{table.letter}</i>" + (f"<sub>{table.harmonic}</sub>" if table.harmonic else "")
    head = "".join(f"<th{_NAME_CELL}>{escape(str(name))}</th>" for name in columns)
    body = "".join(
        f"<tr><th{_NAME_CELL}>{escape(str(name))}</th>{''.join(map(_html_of_cell, line))}</tr>"
        for name, line in zip(rows, table.cells, strict=True)
    )
    return (
        f"<table{_TABLE}><caption{_CAPTION}>{caption}</caption>"
        f"<thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


def _html_of_cell(cell):
    style = _FREE_CELL if cell[1] else _NUMBER_CELL
    return f"<td{style}>{escape(format_cell(cell))}</td>"
