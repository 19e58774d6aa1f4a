"""Models out of Python: JSON, and the .mat files of MATLAB. Nothing is pickled.

One table of names serves both. A file has those of them that the model has; the axis of harmonics,
or of azimuths, is the first in JSON and the last in .mat:

    F, G, P, Q                  Fourier coefficients in the order 0, 1c, 1s, …
    psi, F_psi, …, Phi, Gamma   the same at azimuths, and x[k+1] = Phi_k x[k] + Gamma_k u[k]
    A, B, C, D, dt              time-invariant matrices; dt = 0 in continuous time

JSON has decimals that read back as the same floats (Python's repr). Complex numbers are pairs
(real, imaginary). Exponents and their deviations may be null, where they are no finite numbers;
any other NaN or infinity is refused. ``LTPSystem``, the model steps and ``load_model`` need this.
"""

import json
from io import BytesIO
from pathlib import Path

import control
import numpy as np
from scipy.io import savemat
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._checks import check_count
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.periodic.floquet import transition_matrices
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.systems.arguments import FourierMatrix, matrix_coefficients, precision

FORMAT, SCHEMA = "sklearn_hd model", 1
SERIES = (4, 8, 16, 32, 64)  # harmonics tried of matrices that are no Fourier series
EXACT_SERIES = 1e-9  # of a matrix, that its series may leave without a word
MAY_BE_NULL = ("exponents", "exponents_std")


def export_model(model, path, *, n_phases=64):
    """Write a model to a file for MATLAB (.mat) or any program (.json).

    A control.StateSpace, such as :meth:`LTPSystem.minimal_model` gives, is written as A, B, C, D
    and dt; an :class:`LTPSystem` as by its own :meth:`LTPSystem.export`.

    Parameters
    ----------
    model : LTPSystem or control.StateSpace
        What to write.
    path : str or path-like
        Ends in ``.json`` or ``.mat``; a file that is there is replaced.
    n_phases : int, default=64
        Azimuths in a period at which periodic matrices are tabulated, too.

    Raises
    ------
    ValueError
        If the suffix is another, a number is not finite, or the sample time is not given.
    OSError
        If the file cannot be written.

    Warns
    -----
    ConvergenceWarning
        If matrices given as functions of ψ are no Fourier series of 64 harmonics, with what is
        left.

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
        raise ValueError(f"model={model!r} is no model; give an LTPSystem or a control.StateSpace")
    write(lti_contents(model) if lti else ltp_contents(model, n_phases), path)


def ltp_contents(system, n_phases=64):
    """What a file has of a periodic system, by name.

    Parameters
    ----------
    system : LTPSystem
    n_phases : int

    Returns
    -------
    contents : dict
    """
    n_phases = check_count("n_phases", n_phases, 1, "64 is usual")
    matrices = {name: getattr(system, name) for name in "FGPQ"}
    psi = 2.0 * np.pi * np.arange(n_phases + 1) / n_phases
    tolerance = max(1e-14, precision(system.F, system.G))
    steps = transition_matrices(system.F, system.G, psi, system.omega, tolerance=tolerance)
    contents = {"kind": "ltp", "omega": system.omega, **system._names()}
    contents |= {name: _series(name, M) for name, M in matrices.items()}
    contents["psi"] = psi[:-1]
    contents |= {f"{name}_psi": M(psi[:-1]) for name, M in matrices.items()}
    contents |= dict(zip(("Phi", "Gamma"), steps, strict=True))
    contents["exponents"] = system.floquet_exponents()
    return contents


def lti_contents(model):
    """What a file has of a time-invariant model, by name.

    Parameters
    ----------
    model : control.StateSpace

    Returns
    -------
    contents : dict
    """
    if model.dt is None or model.dt is True:
        raise ValueError(
            f"the model has dt={model.dt}, no sample time; give it one in seconds, or 0 for "
            f"continuous time"
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
    """Write what a model has, by name, to a file that its suffix tells.

    Parameters
    ----------
    contents : dict
        Of texts, numbers, sequences of names, and arrays.
    path : str or path-like
    """
    path = Path(path)
    kinds = {".json": _write_json, ".mat": _write_mat}
    if path.suffix.lower() not in kinds:
        raise ValueError(
            f"path={str(path)!r} ends in {path.suffix!r}; give a name that ends in .json, or in "
            f".mat for MATLAB"
        )
    for name, value in contents.items():
        told = isinstance(value, np.ndarray | float) and name not in MAY_BE_NULL
        if told and not np.isfinite(value).all():
            raise ValueError(f"{name} holds NaN or infinity, which no model file may")
    kinds[path.suffix.lower()]({"format": FORMAT, "schema": SCHEMA} | contents, path)


def _series(name, matrix):
    """Fourier coefficients of a matrix, as many as it has or as resolve it."""
    if isinstance(matrix, FourierMatrix):
        return matrix.coefficients
    psi = 2.0 * np.pi * (np.arange(256) + 0.5) / 256
    values = matrix(psi)
    size = np.max(np.abs(values), initial=0.0)
    for K in SERIES:
        coefficients = matrix_coefficients(matrix, K)
        left = np.max(np.abs(evaluate_harmonics(coefficients, psi) - values), initial=0.0)
        if left <= EXACT_SERIES * size:
            return coefficients
    warn(
        f"{name}(psi) has kinks or jumps: its Fourier series of {K} harmonics is up to "
        f"{left / size:.2g} of its largest entry off; F_psi to Q_psi, Phi and Gamma in the file "
        f"are not of this series and are exact",
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
