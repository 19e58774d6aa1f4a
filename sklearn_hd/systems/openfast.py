"""Linearization files of OpenFAST (.lin), read into arrays and names."""

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from sklearn_hd._checks import real_array

__all__ = ["OpenFASTLinearization", "read_openfast_lin"]

RATE = "First time derivative of "
HEADER = {
    "simulation_time": "Simulation time",
    "rotor_speed": "Rotor Speed",
    "azimuth": "Azimuth",
    "wind_speed": "Wind Speed",
}
SECTIONS = {"Order of continuous states": "x", "Order of inputs": "u", "Order of outputs": "y"}
ROW = re.compile(r"\s*\d+\s+(?P<value>[-+.\dEeDd, ]+?)\s+(?P<turns>[TF])\s+(?P<rest>.*)")
SHORT_EXPONENT = re.compile(r"(\d)([+-]\d{3})\b")  # 1.234-101, as Fortran prints it
MATRIX = re.compile(r"([ABCD]):\s*(\d+)\s*x\s*(\d+)\s*$")
DEGREE_OF_FREEDOM = re.compile(r"DOF_(\w+)(?:\((\d+),(\d+)\))?\)")


@dataclass(frozen=True, eq=False)
class OpenFASTLinearization:
    """A turbine linearised at one azimuth: what one .lin file holds.

        ẋ = A x + B u,   y = C x + D u

    Parameters
    ----------
    description : str
        Of the model, from its input file.
    simulation_time : float
        In seconds.
    rotor_speed : float
        Ω in rad/s.
    azimuth : float
        Of blade 1, ψ in radians.
    wind_speed : float
        In m/s.
    A, B, C, D : ndarray, shapes (n, n), (n, m), (l, n), (l, m)
        In the units of the file.
    states, inputs, outputs : DataFrame
        Index: short names. Columns: ``description``, ``operating_point``, ``rotating``
        (whether a signal turns with the blades), ``derivative_order``.

    References
    ----------
    J. M. Jonkman, B. J. Jonkman, "FAST modularization framework for wind turbine
    simulation: full-system linearization", Journal of Physics: Conference Series 753
    (2016) 082010.

    Examples
    --------
    >>> from sklearn_hd.datasets import load_wind_turbine
    >>> turbine = load_wind_turbine().linearizations[0]
    >>> turbine.rotor_speed, turbine.wind_speed
    (0.7301, 3.0)
    >>> bool(turbine.states.rotating["BE1_b2"]), bool(turbine.states.rotating["TFA1"])
    (True, False)
    """

    description: str
    simulation_time: float
    rotor_speed: float
    azimuth: float
    wind_speed: float
    A: np.ndarray = field(repr=False)
    B: np.ndarray = field(repr=False)
    C: np.ndarray = field(repr=False)
    D: np.ndarray = field(repr=False)
    states: pd.DataFrame = field(repr=False)
    inputs: pd.DataFrame = field(repr=False)
    outputs: pd.DataFrame = field(repr=False)


def read_openfast_lin(path):
    """Read a linearization file of OpenFAST (``.lin``).

    Parameters
    ----------
    path : str or path
        Of the file.

    Returns
    -------
    linearization : OpenFASTLinearization
        Degrees of freedom are named as OpenFAST numbers them: ``TFA1`` is the first
        fore-aft mode of the tower, ``BE1_b2`` the first edgewise mode of blade 2,
        ``BE1_b2_dot`` its rate. Other signals go by their description.

    Raises
    ------
    ValueError
        If the file holds no state matrix, or not what its headings promise.

    References
    ----------
    J. M. Jonkman, B. J. Jonkman, "FAST modularization framework for wind turbine
    simulation: full-system linearization", Journal of Physics: Conference Series 753
    (2016) 082010.

    Examples
    --------
    >>> from sklearn_hd.datasets import load_wind_turbine
    >>> path = load_wind_turbine().filenames[0]
    >>> turbine = read_openfast_lin(path)
    >>> turbine.A.shape, turbine.rotor_speed
    ((30, 30), 0.7301)
    >>> list(turbine.states.index[:8])
    ['TFA1', 'TSS1', 'TFA2', 'TSS2', 'Yaw', 'DrTr', 'BF1_b1', 'BF1_b2']
    """
    lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    header = {key: _number(lines, label, path) for key, label in HEADER.items()}
    tables = {"x": _table([]), "u": _table([]), "y": _table([])}
    for k, line in enumerate(lines):
        section = SECTIONS.get(line.strip().removesuffix(":"))
        if section:
            tables[section] = _table(_rows(lines, k + 3, path))
    n, m, n_outputs = (len(tables[key]) for key in "xuy")
    shapes = {"A": (n, n), "B": (n, m), "C": (n_outputs, n), "D": (n_outputs, m)}
    matrices = {name: np.zeros(shape) for name, shape in shapes.items()}
    found = dict(_matrices(lines, path))
    if "A" not in found:
        raise ValueError(f"{path} holds no state matrix A; give a .lin file that OpenFAST wrote")
    for name, matrix in found.items():
        if matrix.shape != shapes[name]:
            raise ValueError(
                f"{path}: {name} is {matrix.shape[0]} x {matrix.shape[1]}, but the file lists {n} "
                f"states, {m} inputs and {n_outputs} outputs; write it anew with OpenFAST"
            )
    matrices |= found
    about = [line for line in lines if line.startswith("Description")]
    return OpenFASTLinearization(
        description=about[0].partition(":")[2].strip() if about else "",
        **header,
        **matrices,
        states=tables["x"],
        inputs=tables["u"],
        outputs=tables["y"],
    )


def _number(lines, label, path):
    """The number behind a label of the header."""
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() == label:
            return float(value.split()[0])
    raise ValueError(f"{path} does not say {label!r}; give a .lin file that OpenFAST wrote")


def _rows(lines, start, path):
    """Rows of a table of signals, up to the first line that is none."""
    rows = []
    for line in lines[start:]:
        if not line.strip():
            break
        row = ROW.match(line)
        if row is None:
            raise ValueError(f"{path}: the row {line.strip()!r} lists no signal")
        order, _, text = row["rest"].partition(" ")
        if not order.isdigit():  # files of FAST 8 have no such column
            order, text = "0", row["rest"]
        value = row["value"].split(",")[0]  # orientations have three numbers
        rows.append((text.strip(), float(value), row["turns"] == "T", int(order)))
    return rows


def _table(rows):
    """Signals by short names, all different."""
    columns = {"description": object, "operating_point": float, "rotating": bool}
    columns["derivative_order"] = int
    texts = [row[0] for row in rows]
    names = _where_repeated([_short_name(text) for text in texts], texts)
    names = _where_repeated(names, [f"{name} ({k})" for k, name in enumerate(names, 1)])
    table = pd.DataFrame(rows, pd.Index(names, name="name", dtype=object), list(columns))
    return table.astype(columns)


def _where_repeated(names, others):
    """The names, or the others in place of those that occur more than once."""
    count = Counter(names)
    return [other if count[name] > 1 else name for name, other in zip(names, others, strict=True)]


def _short_name(description):
    """TFA1, BE1_b2_dot, RootMyc1, …"""
    rate = "_dot" if RATE in description else ""
    degree = DEGREE_OF_FREEDOM.search(description)
    if degree:
        name, blade, mode = degree.groups()
        return f"{name}{mode}_b{blade}{rate}" if blade else f"{name}{rate}"
    text = description.replace(RATE, "").rpartition(",")[0] or description
    module, _, rest = text.partition(" ")
    return (rest.strip() if rest and module.isalpha() and len(module) <= 4 else text) + rate


def _matrices(lines, path):
    """A, B, C, D by name, as far as the file holds them."""
    for k, line in enumerate(lines):
        head = MATRIX.match(line)
        if head is None:
            continue
        name, shape = head[1], (int(head[2]), int(head[3]))
        rows = [
            SHORT_EXPONENT.sub(r"\1E\2", row).split() for row in lines[k + 1 : k + 1 + shape[0]]
        ]
        if len(rows) < shape[0] or any(len(row) != shape[1] for row in rows):
            raise ValueError(f"{path}: {name} has fewer entries than {shape[0]} x {shape[1]}")
        wanted = "a .lin file of a linearization that succeeded"
        yield name, real_array(f"{path}: {name}", np.array(rows, dtype=float), wanted)
