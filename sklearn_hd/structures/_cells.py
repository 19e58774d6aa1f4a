"""Entries of structures as people write them: affine in named parameters.

    "1.5 - 0.5*k1 + 2*k2"   is   (1.5, (("k1", -0.5), ("k2", 2.0)))

A cell is (constant, terms), each term a name and its factor. A name of None stands for a
parameter that is called after its place.
"""

import ast
import math
import operator
import re
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


def read_cells(name, matrix, rows=None, columns=None, tail=""):
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
        f"{place} = {value!r} is no entry; give a finite number (fixed), NaN (free) or a text of "
        f"numbers and parameters, such as 'k' or '1.5 - 2*k'"
    )


def finite_number(value):
    """A float; None if the value is no finite number."""
    try:
        number = float(value) if isinstance(value, Real) else math.nan
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
        raise ValueError(f"{place} = {text!r} is no entry: its numbers must be finite")
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


def name_places(cells, head, rows=None, columns=None, tail=""):
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
            f"{name}={given!r} is no sequence of names; give a list such as ['w', 'phi_dot'], or "
            f"None"
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
