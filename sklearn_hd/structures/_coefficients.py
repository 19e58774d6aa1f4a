"""Fourier coefficients of F, G, P and Q as they are given: by label, or by number of harmonics."""

import numbers
import reprlib
from collections.abc import Mapping

from sklearn_hd.algorithms.signals.fourier import harmonic_labels
from sklearn_hd.structures._cells import axis_names, matrix_shape, read_cells

MOST_HARMONICS = 10_000


def read_specification(name, value):
    """A number of harmonics, a dict of coefficients by label, or None.

    Of a coefficient there are the cells, and the names of its rows and columns or None.
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
    """Raise ValueError if a DataFrame is labelled otherwise than the signals are named."""
    for found, names in zip(labels, sides, strict=True):
        if found is not None and list(found) != list(names):
            raise ValueError(
                f"{what} is labelled {list(found)} where the signals are {list(names)}; "
                f"give the same names in the same order, or an array"
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
        f"{label!r} is no label of {name}; labels are '0', '1c', '1s', '2c', … (mean, cosine, sine)"
    )


def _check_order(name, harmonic):
    """Raise ValueError for harmonics that no record shows."""
    if harmonic > MOST_HARMONICS:
        raise ValueError(
            f"harmonic {reprlib.repr(harmonic)} of {name} is beyond {MOST_HARMONICS}, more than "
            f"any record tells apart; give fewer harmonics"
        )


def labels_up_to(count):
    """Labels of the coefficients up to some harmonic; none if it is None."""
    return [] if count is None else harmonic_labels(range(count + 1))


def place_of(label):
    """Place of a coefficient in the order 0, 1c, 1s, 2c, …."""
    k = order_of(label)
    return 2 * k - (label[-1] == "c") if k else 0
