"""The linearization files of OpenFAST (.lin): tables of signals, and the matrices A, B, C, D."""

import itertools
import math
import re
import reprlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

RATE = "First time derivative of "
HEADER = {  # a label, and what turns its units into ours
    "simulation_time": ("Simulation time", {"s": 1.0}),
    "rotor_speed": ("Rotor Speed", {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30}),
    "azimuth": ("Azimuth", {"rad": 1.0, "deg": math.pi / 180}),
    "wind_speed": ("Wind Speed", {"m/s": 1.0}),
}
SECTIONS = {  # its title, and how the header counts its rows
    "Order of continuous states": ("x", "Number of continuous states"),
    "Order of inputs": ("u", "Number of inputs"),
    "Order of outputs": ("y", "Number of outputs"),
}
NUMBER = re.compile(  # also 1.5D+00 and 1.234-101, as Fortran prints them
    r"([-+]?(?:\d+(?:\.\d*)?|\.\d+))(?:[EeDd]([-+]?\d+)|([-+]\d{3}))?", re.ASCII
)
DEGREE_OF_FREEDOM = re.compile(r"(\w+)(?:\((\d+),(\d+)\))?\)")  # behind the last DOF_


@dataclass(frozen=True, eq=False)
class OpenFASTLinearization:
    """A turbine linearised at one azimuth: the contents of one .lin file.

        ẋ = A x + B u,   y = C x + D u

    Parameters
    ----------
    description : str
        Description of the model, from its input file.
    simulation_time : float
        In seconds.
    rotor_speed : float
        Ω in rad/s.
    azimuth : float
        Azimuth ψ of blade 1, in radians.
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
        ``BE1_b2_dot`` its rate. Other signals are named by their description.

    Raises
    ------
    OSError
        If there is no such file, or it cannot be read.
    ValueError
        If the file holds no state matrix, does not match its headings, or holds a number that is
        not finite or a unit other than s, rad, deg, rad/s, deg/s, rpm, m/s. The message names the
        file.

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
    try:
        text = Path(path).read_text(encoding="utf-8", errors="replace")
    except (TypeError, ValueError):
        raise ValueError(f"path={path!r} is not a path; give that of a .lin file") from None
    try:
        return _linearization(text)
    except ValueError as refusal:
        raise ValueError(f"{path}: {refusal}; give a .lin file that OpenFAST wrote") from None


def _linearization(text):
    if "\0" in text:
        raise ValueError("this is not text")
    lines = text.splitlines()
    stated = {}
    for line in lines:
        label, colon, value = line.partition(":")
        if colon:
            stated.setdefault(label.strip(), value.strip())
    header = {key: _quantity(stated, *wanted) for key, wanted in HEADER.items()}
    tables = _tables(lines, stated)
    about = [value for label, value in stated.items() if label.startswith("Description")]
    return OpenFASTLinearization(
        description=about[0] if about else "",
        **header,
        **_matrices(lines, *(len(tables[key]) for key in "xuy")),
        states=_table(tables["x"]),
        inputs=_table(tables["u"]),
        outputs=_table(tables["y"]),
    )


def _quantity(stated, label, units):
    """The number after a label of the header, in our unit."""
    if label not in stated:
        raise ValueError(f"the header does not give {label!r}")
    number, _, unit = stated[label].partition(" ")
    unit = unit.strip().lower()
    if unit not in units:
        known = " or ".join(units)
        raise ValueError(f"{label!r} has the unit {reprlib.repr(unit)}; it must be {known}")
    return _number(number, repr(label)) * units[unit]


def _number(word, what):
    """A finite number as C or Fortran print it; ``what`` names its place in messages."""
    found = NUMBER.fullmatch(word)
    value = float(f"{found[1]}e{found[2] or found[3] or 0}") if found else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{what} holds {reprlib.repr(word)}, which is not a finite number")
    return value


def _tables(lines, stated):
    """Rows of the tables of states (x), inputs (u) and outputs (y), as many as the header says."""
    tables = {}
    for k, line in enumerate(lines):
        title = line.strip().removesuffix(":")
        if title not in SECTIONS:
            continue
        key = SECTIONS[title][0]
        if key in tables:
            raise ValueError(f"{title!r} appears twice")
        if not "".join(lines[k + 2 : k + 3]).strip().startswith("---"):
            raise ValueError(f"{title!r} has no heading with a rule below it")
        tables[key] = _rows(lines, k + 3)
    for title, (key, label) in SECTIONS.items():
        rows = tables.setdefault(key, [])
        if label in stated and stated[label] != str(len(rows)):
            said = reprlib.repr(stated[label])
            raise ValueError(f"{label!r} says {said}, but {title!r} lists {len(rows)}")
    return tables


def _rows(lines, start):
    """Rows of a table of signals, numbered from 1, up to the first line that is blank."""
    rows = []
    for line in lines[start:]:
        words = line.split()
        if not words:
            break
        turns = next((k for k, word in enumerate(words) if word in ("T", "F")), 0)
        text = line.split(None, turns + 1)[turns + 1 :]
        values = " ".join(words[1:turns]).replace(",", " ").split()  # orientations have three
        if words[0] != str(len(rows) + 1) or not values or not text:
            raise ValueError(f"the row {reprlib.repr(line.strip())} lists no signal")
        order, _, name = text[0].partition(" ")
        if order not in ("0", "1", "2"):  # files of FAST 8 have no such column
            order, name = "0", text[0]
        value, *_ = (_number(word, f"row {words[0]} of a table") for word in values)
        rows.append((name.strip(), value, words[turns] == "T", int(order)))
    return rows


def _matrices(lines, n, m, n_outputs):
    """A, B, C, D by name, of the sizes that the tables give them."""
    shapes = {"A": (n, n), "B": (n, m), "C": (n_outputs, n), "D": (n_outputs, m)}
    found = {}
    lines = iter(lines)
    for line in lines:
        name, colon, size = line.strip().partition(":")
        if not colon or name not in shapes:
            continue
        if name in found:
            raise ValueError(f"{name} appears twice")
        rows, columns = shapes[name]
        if size.replace("x", " x ").split() != [str(rows), "x", str(columns)]:
            raise ValueError(
                f"{name} is {reprlib.repr(size.strip())}, but the file lists {n} states, {m} "
                f"inputs and {n_outputs} outputs"
            )
        below = list(itertools.islice(lines, rows if columns else 0))
        found[name] = _matrix(name, below, rows, columns)
    for name, shape in shapes.items():
        if name not in found and (name == "A" or all(shape)):
            raise ValueError(f"there is no matrix {name}")
        found.setdefault(name, np.zeros(shape))
    return found


def _matrix(name, lines, rows, columns):
    """The matrix of so many rows and columns that the lines below its heading hold."""
    words = [line.split() for line in lines]
    for k, row in enumerate(words, 1):
        if len(row) != columns:
            raise ValueError(f"row {k} of {name} has {len(row)} entries instead of {columns}")
    if columns and len(words) < rows:
        raise ValueError(f"{name} ends after {len(words)} of {rows} rows")
    values = [_number(word, f"row {k} of {name}") for k, row in enumerate(words, 1) for word in row]
    return np.array(values).reshape(rows, columns)


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
    degree = DEGREE_OF_FREEDOM.match(description.rpartition("DOF_")[2])
    if degree:
        name, blade, mode = degree.groups()
        return f"{name}{mode}_b{blade}{rate}" if blade else f"{name}{rate}"
    text = description.replace(RATE, "").rpartition(",")[0] or description
    module, _, rest = text.partition(" ")
    return (rest.strip() if rest and module.isalpha() and len(module) <= 4 else text) + rate
