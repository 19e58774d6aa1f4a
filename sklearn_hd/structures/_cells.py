"""Entries of structures as people write them: a number, NaN, or the name of a parameter."""

import re
from numbers import Number

import numpy as np
import pandas as pd

_TERM = re.compile(r"\s*(?P<sign>[+-])?\s*(?:(?P<scale>[^*\s]+)\s*\*)?\s*(?P<name>\S.*?)\s*")
_NAME = re.compile(r"[^\W\d]\w*(\[[^\]]*\])?")


def read_cells(name, matrix, rows, columns):
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


def read_names(name, given):
    """Names as texts, from any sequence of them; a single text is no sequence of letters."""
    if isinstance(given, str) or not np.iterable(given):
        raise ValueError(
            f"{name}={given!r} is no sequence of names; give a list such as ['w', 'phi_dot'], or "
            f"None"
        )
    return tuple(map(str, given))


def read_numbers(what, values, names):
    """One finite float for each name, in their order."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        numbers = None
    if numbers is None or numbers.shape != (len(names),) or not np.all(np.isfinite(numbers)):
        raise ValueError(
            f"{what} must hold {len(names)} finite numbers, one for each of {list(names)}; got "
            f"{values!r}"
        )
    return numbers


def write_cells(part):
    """Cells as texts: 1.5, k, -k, 2*k."""
    texts = {1.0: "", -1.0: "-"}
    return [
        [repr(x) if name is None else texts.get(x, f"{x:g}*") + name for x, name in line]
        for line in part
    ]


def layout(name, texts):
    width = max((len(text) for line in texts for text in line), default=0)
    lines = ["[ " + "  ".join(text.rjust(width) for text in line) + " ]" for line in texts]
    return "\n".join(
        f"{name} = {line}" if k == 0 else f"    {line}" for k, line in enumerate(lines)
    )


def matrix_shape(matrix, name):
    """Shape of a matrix given as array, nested list or DataFrame."""
    try:
        shape = np.shape(np.asarray(matrix, dtype=object))
    except ValueError:
        shape = ()
    if len(shape) != 2:
        raise ValueError(f"{name} must be a matrix, rows of equal length; got shape {shape}")
    return shape
