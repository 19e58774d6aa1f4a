"""Export of models to JSON and to MATLAB's .mat files. Nothing is pickled.

Both formats use one table of names. A file has those that the model has. The axis of harmonics, or
of azimuths, is the first in JSON and the last in .mat:

    F, G, P, Q                  Fourier coefficients in the order 0, 1c, 1s, …
    psi, F_psi, …, Phi, Gamma   the same at azimuths, and x[k+1] = Phi_k x[k] + Gamma_k u[k]
    A, B, C, D, dt              time-invariant matrices; dt = 0 in continuous time

JSON stores decimals that read back as the same floats (Python's repr). Complex numbers are pairs
(real, imaginary). Exponents and their deviations that are not finite are null; any other NaN or
infinity is refused. ``LTPSystem``, the model steps and ``load_model`` need this.
"""

import json
from io import BytesIO

import control
import numpy as np
from scipy.io import savemat
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._checks import check_count, path_to_write
from sklearn_hd._guards import warn
from sklearn_hd.algorithms.linalg.rounding import PRECISION
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.systems.arguments import FourierMatrix, matrix_coefficients

FORMAT, SCHEMA = "sklearn_hd model", 1
SERIES = (4, 8, 16, 32, 64)  # harmonics tried of matrices that are no Fourier series
MAY_BE_NULL = ("exponents", "exponents_std")


def export_model(model, path, *, n_phases=64):
    """Write a model to a file for MATLAB (.mat) or any program (.json).

    A control.StateSpace, such as :meth:`LTPSystem.minimal_model` gives, is written as A, B, C, D
    and dt; an :class:`LTPSystem` as by its own :meth:`LTPSystem.export`.

    Parameters
    ----------
    model : LTPSystem or control.StateSpace
        The model to write.
    path : str or path-like
        Ends in ``.json`` or ``.mat``; an existing file is replaced.
    n_phases : int, default=64
        Number of azimuths per period at which periodic matrices are also tabulated.

    Raises
    ------
    ValueError
        If the suffix is another, a number is not finite, the sample time is not given, or the
        folder does not exist.
    OSError
        If the file cannot be written.

    Warns
    -----
    ConvergenceWarning
        If 64 harmonics do not represent matrices given as functions of ψ; the warning states the
        error.

    References
    ----------
    Bray (2017), The JavaScript Object Notation (JSON) Data Interchange Format, RFC 8259.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from sklearn_hd.systems import load_model, mathieu
    >>> path = Path(tempfile.mkdtemp()) / "mathieu.json"
    >>> export_model(mathieu(2.0, 0.5), path)
    >>> load_model(path)
    LTPSystem(omega=2, states=['y', 'y_dot'], inputs=['u'], outputs=['y', 'y_dot'])
    """
    lti = isinstance(model, control.StateSpace)
    if not lti and not all(hasattr(model, name) for name in ("F", "G", "P", "Q", "omega")):
        raise ValueError(f"model={model!r} is not a model; give LTPSystem or control.StateSpace")
    write(lti_contents(model) if lti else ltp_contents(model, n_phases), path)


def ltp_contents(system, n_phases=64):
    """Contents of a file for an LTPSystem at so many phases of the period, by name."""
    n_phases = check_count("n_phases", n_phases, 1, "64 is usual")
    matrices = {name: getattr(system, name) for name in "FGPQ"}
    psi = 2.0 * np.pi * np.arange(n_phases + 1) / n_phases
    steps = system._transition_matrices(psi)
    contents = {"kind": "ltp", "omega": system.omega, **system._names()}
    contents |= {name: _series(name, M) for name, M in matrices.items()}
    contents["psi"] = psi[:-1]
    contents |= {f"{name}_psi": M(psi[:-1]) for name, M in matrices.items()}
    contents |= dict(zip(("Phi", "Gamma"), steps, strict=True))
    contents["exponents"] = system.floquet_exponents()
    return contents


def lti_contents(model):
    """Contents of a file for a control.StateSpace, by name."""
    if model.dt is None or model.dt is True:
        raise ValueError(
            f"the model has dt={model.dt}, which is not a sample time; give it one in seconds, or "
            f"0 for continuous time"
        )
    exponents = np.linalg.eigvals(model.A).astype(complex)
    if model.dt:
        dead = exponents == 0.0  # within one step, at no finite rate
        exponents = np.log(np.where(dead, 1.0, exponents)) / model.dt
        exponents[dead] = -np.inf
    return {
        "kind": "lti",
        "dt": float(model.dt),
        "lti_state_names": list(model.state_labels),
        "lti_input_names": list(model.input_labels),
        "lti_output_names": list(model.output_labels),
        **{name: np.asarray(getattr(model, name), dtype=float) for name in "ABCD"},
        "exponents": exponents,
    }


def write(contents, path):
    """Write the contents of a model to a file, whose suffix sets the format.

    They are texts, numbers, sequences of names, and arrays, each by its name.
    """
    path = path_to_write(path, "model.json")
    kinds = {".json": _write_json, ".mat": _write_mat}
    if path.suffix.lower() not in kinds:
        raise ValueError(
            f"path={str(path)!r} ends in {path.suffix!r}; give a name that ends in .json, or in "
            f".mat for MATLAB"
        )
    for name, value in contents.items():
        told = isinstance(value, np.ndarray | float) and name not in MAY_BE_NULL
        if told and not np.isfinite(value).all():
            raise ValueError(f"{name} holds NaN or infinity, which a model file cannot store")
    kinds[path.suffix.lower()]({"format": FORMAT, "schema": SCHEMA} | contents, path)


def _series(name, matrix):
    """Fourier coefficients of a matrix: those it has, or as many as resolve it."""
    if isinstance(matrix, FourierMatrix):
        return matrix.coefficients
    psi = 2.0 * np.pi * (np.arange(256) + 0.5) / 256
    values = matrix(psi)
    size = np.max(np.abs(values), initial=0.0)
    for K in SERIES:
        coefficients = matrix_coefficients(matrix, K)
        left = np.max(np.abs(evaluate_harmonics(coefficients, psi) - values), initial=0.0)
        if left <= PRECISION * size:
            return coefficients
    warn(
        f"{name}(psi) has kinks or jumps, so its Fourier series of {K} harmonics errs by up to "
        f"{left / size:.2g} of its largest entry; F_psi to Q_psi, Phi and Gamma in the file do not "
        f"use this series and are exact",
        ConvergenceWarning,
    )
    return coefficients


def _write_json(contents, path):
    lines = [f"{json.dumps(name)}: {_decimals(value)}" for name, value in contents.items()]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def _decimals(value):
    if isinstance(value, np.ndarray) and np.iscomplexobj(value):
        pairs = np.stack([value.real, value.imag], axis=-1).astype(object)
        pairs[~np.isfinite(pairs.astype(float))] = None
        value = pairs
    value = value.tolist() if isinstance(value, np.ndarray) else value
    return json.dumps(value, allow_nan=False, ensure_ascii=False)


def _write_mat(contents, path):
    variables = {}
    for name, value in contents.items():
        if isinstance(value, list | tuple):  # a cell array
            variables[name] = np.array([*value, None], dtype=object)[:-1]
        elif isinstance(value, np.ndarray) and value.ndim == 3:
            variables[name] = np.moveaxis(value, 0, -1)
        else:
            variables[name] = value
    whole = BytesIO()  # so that no half of a file is left
    savemat(whole, variables, do_compression=True, oned_as="column")
    path.write_bytes(whole.getvalue())
