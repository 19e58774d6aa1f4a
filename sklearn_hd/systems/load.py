"""Load models from the JSON files of ``systems/export.py``; users call ``load_model``."""

import json

import control
import numpy as np

from sklearn_hd._checks import path_of_file, real_array
from sklearn_hd.systems.export import FORMAT, SCHEMA
from sklearn_hd.systems.ltp import LTPSystem

LTP = {"F": ("state", "state"), "G": ("state", "input")}
LTP |= {"P": ("output", "state"), "Q": ("output", "input")}
LTI = dict(zip("ABCD", LTP.values(), strict=True))


def load_model(path):
    """Load the model in a JSON file, to the last bit of its matrices.

    Parameters
    ----------
    path : str or path-like
        A file written by ``export`` of a model step, :meth:`LTPSystem.export` or
        :func:`export_model`.

    Returns
    -------
    model : LTPSystem or control.StateSpace
        Set by ``kind`` in the file. Standard deviations, trim and tables by azimuth stay in the
        file; ``json.load`` reads them.

    Raises
    ------
    TypeError
        If the path is no path.
    ValueError
        If it is a folder or not such a file, has a later schema, or something is missing or does
        not fit.
    OSError
        If the file cannot be read.

    References
    ----------
    Bray (2017), The JavaScript Object Notation (JSON) Data Interchange Format, RFC 8259.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sklearn_hd.systems import mathieu
    >>> system, path = mathieu(2.0, 0.5), Path(tempfile.mkdtemp()) / "mathieu.json"
    >>> system.export(path)
    >>> bool(np.all(load_model(path).F(0.3) == system.F(0.3)))
    True
    """
    path = path_of_file(path, "model.json")
    if path.suffix.lower() == ".mat":
        raise ValueError(f"path={str(path)!r} is for MATLAB; export to .json to load it again")
    try:
        found = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_number)
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"{str(path)!r} is not JSON: {error}") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise ValueError(f"{str(path)!r} is not a model file: its format is not {FORMAT!r}")
    if found.get("schema") != SCHEMA:
        raise ValueError(
            f"{str(path)!r} has schema {found.get('schema')!r}, but this version of sklearn_hd "
            f"reads {SCHEMA}; use the version that wrote it, or export the model again"
        )
    kind = _given(found, "kind", path)
    if kind not in ("ltp", "lti"):
        raise ValueError(f"{str(path)!r} has kind {kind!r}; 'ltp' and 'lti' are known")
    prefix = "" if kind == "ltp" else "lti_"
    sides = "state", "input", "output"
    names = {side: _names(found, f"{prefix}{side}_names", path) for side in sides}
    places = LTP if kind == "ltp" else LTI
    matrices = [_matrix(found, name, names, sides, path) for name, sides in places.items()]
    if kind == "ltp":
        by_name = {f"{side}_names": value for side, value in names.items()}
        return LTPSystem(*matrices, omega=_given(found, "omega", path), **by_name)
    dt = real_array("dt", _given(found, "dt", path), "seconds; 0 in continuous time")
    signals = {f"{side}s": value for side, value in names.items()}
    return control.StateSpace(*matrices, float(dt), remove_useless_states=False, **signals)


def _given(found, name, path):
    if name not in found:
        raise ValueError(f"{str(path)!r} has no {name!r}; export the model again")
    return found[name]


def _names(found, name, path):
    names = _given(found, name, path)
    if not isinstance(names, list) or not all(isinstance(each, str) for each in names):
        raise ValueError(f"{name} in {str(path)!r} is not a list of names")
    return names


def _matrix(found, name, names, sides, path):
    """An array with one row and column for each name."""
    rows, columns = (len(names[side]) for side in sides)
    wanted = f"rows of {rows} by {columns} numbers, as the names in the file are"
    values = real_array(f"{name} in {str(path)!r}", _given(found, name, path), wanted)
    shape = (rows, columns) if name in LTI else (len(values), rows, columns)
    if values.size != np.prod(shape):
        raise ValueError(f"{name} in {str(path)!r} has shape {values.shape}; it must have {wanted}")
    return values.reshape(shape)


def _no_number(text):
    raise ValueError(f"the file holds {text}, which is not a JSON number; write null, or a number")
