"""Models of three-bladed turbines from linearizations at several azimuths."""

import re

import control
import numpy as np

from sklearn_hd._checks import check_choice, check_count
from sklearn_hd.algorithms.periodic.multiblade import (
    N_BLADES,
    Frame,
    blade_harmonics,
    from_multiblade,
    to_multiblade,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.systems.arguments import check_names
from sklearn_hd.systems.ltp import LTPSystem
from sklearn_hd.systems.openfast import OpenFASTLinearization

MULTIBLADE = ("mean", "cos", "sin")
BLADE = [  # where a name says which blade
    re.compile(r"^(.*_b)(\d)((?:_dot)?)$"),
    re.compile(r"^(.*blade )(\d)(.*)$", re.IGNORECASE),
    re.compile(r"^(BD_)(\d)(.*)$"),
    re.compile(r"^(B)(\d)(N\d.*)$"),
    re.compile(r"^(.*\D)(\d)()$"),
]


def multiblade_model(linearizations, *, inputs=None, outputs=None):
    """Time-invariant model of a three-bladed turbine in multi-blade coordinates.

    The matrices at each azimuth are written in coordinates that do not turn
    (:mod:`sklearn_hd.algorithms.periodic.multiblade`), and averaged.

    Parameters
    ----------
    linearizations : sequence of OpenFASTLinearization
        One operating point at several azimuths.
    inputs : sequence of str, optional
        Names of inputs of the files, or of rates among the states, for accelerations
        that act on these. All inputs of the files by default.
    outputs : sequence of str, optional
        Names of outputs of the files or of states. All outputs of the files by default.

    Returns
    -------
    model : control.StateSpace
        Names as in the files, except for signals that turn with the blades: ``BE1_mean``,
        ``BE1_cos``, ``BE1_sin`` for ``BE1_b1``, ``BE1_b2``, ``BE1_b3``. Its method ``damp()``
        gives frequencies and damping ratios.

    Raises
    ------
    ValueError
        If the files do not belong together, there are not three blades, or a name is unknown.

    References
    ----------
    G. Bir, "Multi-blade coordinate transformation and its application to wind turbine
    analysis", 46th AIAA Aerospace Sciences Meeting (2008), AIAA 2008-1300.

    Examples
    --------
    >>> from sklearn_hd.datasets import load_wind_turbine
    >>> model = multiblade_model(load_wind_turbine().linearizations)
    >>> omega, zeta, poles = model.damp()
    >>> k = np.argmin(np.where(poles.imag > 0, zeta, 1))
    >>> print(f"{omega[k] / (2 * np.pi):.5f} Hz, {100 * zeta[k]:.4f} %")
    0.31403 Hz, 0.4386 %
    """
    first, psi, matrices, rotor_speed, frame = _checked(linearizations)
    fixed = to_multiblade(matrices, psi, rotor_speed, frame)
    names = [
        _multiblade_names(table.index, triplets)
        for table, triplets in (
            (first.states, frame.states),
            (first.inputs, frame.inputs),
            (first.outputs, frame.outputs),
        )
    ]
    mean = [M.mean(axis=0)[None] for M in fixed]
    A, B, C, D, inputs, outputs = _chosen(mean, names, inputs, outputs, _loose(first, frame))
    if outputs and not inputs:
        raise ValueError(
            f"outputs={outputs} without inputs cannot make a control.StateSpace, and the files "
            f"have no inputs; name rates that accelerations act on, such as "
            f"inputs={_rates(names[0])[:1]}"
        )
    return control.StateSpace(
        A[0], B[0], C[0], D[0], states=names[0], inputs=inputs, outputs=outputs
    )


def rotor_system(
    linearizations, *, inputs=None, outputs=None, coordinates="multiblade", n_harmonics=0
):
    """Time-periodic model of a turbine with turning blades.

    The files give matrices at their azimuths only. In between, a Fourier series is fitted (least
    squares) either to the matrices in multi-blade coordinates, turned back onto the blades, or to
    the matrices as the files hold them.

    Parameters
    ----------
    linearizations : sequence of OpenFASTLinearization
        One operating point at several azimuths.
    inputs, outputs : sequence of str, optional
        As in :func:`multiblade_model`, by the names of the files.
    coordinates : {"multiblade", "rotating"}, default="multiblade"
        ``"multiblade"`` assumes three equal blades: the series then has only harmonics 3, 6, …,
        and its mean alone makes F(ψ) of two harmonics. ``"rotating"`` assumes nothing, but needs
        more azimuths: F(ψ) of a turbine with three blades has at least two harmonics, hence five
        azimuths.
    n_harmonics : int, default=0
        Harmonics of the series: multiples of three per turn with ``"multiblade"``, of one with
        ``"rotating"``.

    Returns
    -------
    system : LTPSystem
        States are those of the files; ψ is the azimuth of blade 1. With
        ``coordinates="multiblade"`` and ``n_harmonics=0`` its Floquet exponents are the
        eigenvalues of :func:`multiblade_model`, up to multiples of jΩ.

    Raises
    ------
    ValueError
        If the files do not belong together, the azimuths do not determine the harmonics, or a name
        is unknown.

    References
    ----------
    G. Bir, "Multi-blade coordinate transformation and its application to wind turbine
    analysis", 46th AIAA Aerospace Sciences Meeting (2008), AIAA 2008-1300.

    Examples
    --------
    >>> from sklearn_hd.datasets import load_wind_turbine
    >>> files = load_wind_turbine().linearizations
    >>> system = rotor_system(files, inputs=["TSS1_dot"], outputs=["TSS1", "BE1_b1"])
    >>> system.n_states, system.F.n_harmonics
    (30, 2)
    """
    check_choice("coordinates", coordinates, ("multiblade", "rotating"))
    K = check_count("n_harmonics", n_harmonics, 0, "0 keeps the mean alone")
    turned = coordinates == "multiblade"
    first, psi, matrices, rotor_speed, frame = _checked(linearizations, turned)
    if turned:
        matrices = to_multiblade(matrices, psi, rotor_speed, frame)
    series = _fitted(matrices, psi, blade_harmonics(K) if turned else list(range(K + 1)))
    if turned:
        series = from_multiblade(series, rotor_speed, frame)
    names = [list(table.index) for table in (first.states, first.inputs, first.outputs)]
    loose = _loose(first, frame) if turned else set()
    F, G, P, Q, inputs, outputs = _chosen(series, names, inputs, outputs, loose)
    signals = {"state_names": names[0], "input_names": inputs, "output_names": outputs}
    return LTPSystem(F, G, P, Q, omega=rotor_speed, **signals)


# ---- blades --------------------------------------------------------------------------------------


def _blade(name):
    """A name without its blade's number (#), and that number; (name, None) without."""
    for pattern in BLADE:
        found = pattern.match(name)
        if found:
            return f"{found[1]}#{found[3]}", int(found[2])
    return name, None


def _triplets(table):
    """Positions of like signals on blades 1, 2, 3, by their common name."""
    by_blade = {}
    for k, (name, turns) in enumerate(zip(table.index, table["rotating"], strict=True)):
        key, blade = _blade(name) if turns else (name, None)
        if blade is not None:
            by_blade.setdefault(key, {})[blade] = k
    wanted = range(1, N_BLADES + 1)
    return {
        key: tuple(places[b] for b in wanted)
        for key, places in by_blade.items()
        if sorted(places) == list(wanted)
    }


def _frame(file):
    """Signals that turn with the blades; ValueError for states that turn in another way."""
    states = _triplets(file.states)
    turning = set(np.flatnonzero(file.states["rotating"]))
    left = turning - {k for triplet in states.values() for k in triplet}
    rates = {
        triplet: states[f"{key}_dot"] for key, triplet in states.items() if f"{key}_dot" in states
    }
    with_rate = {k for pair in rates.items() for triplet in pair for k in triplet}
    second = set(np.flatnonzero(file.states["derivative_order"] == 2)) & turning
    wrong = sorted(left | (second - with_rate))
    if wrong:
        raise ValueError(
            f"the states {list(file.states.index[wrong])} turn with the rotor, but are not states "
            f"of three blades with a rate each, as multi-blade coordinates need; use "
            f"rotor_system(..., coordinates='rotating')"
        )
    own = (list(_triplets(table).values()) for table in (file.inputs, file.outputs))
    return Frame(list(states.values()), rates, *own)


def _loose(file, frame):
    """Names of inputs and outputs that turn but are not one for each of three blades."""
    names = set()
    for table, triplets in ((file.inputs, frame.inputs), (file.outputs, frame.outputs)):
        placed = {k for triplet in triplets for k in triplet}
        names |= {table.index[k] for k in np.flatnonzero(table["rotating"]) if k not in placed}
    return names


def _multiblade_names(names, triplets):
    names = list(names)
    for triplet in triplets:
        key = _blade(names[triplet[0]])[0]
        for k, part in zip(triplet, MULTIBLADE, strict=True):
            before, _, after = key.replace("_b#", "_#").partition("#")
            joint = "" if before.endswith((" ", "_")) else "_"
            names[k] = f"{before}{joint}{part}{after}"
    return names


# ---- several azimuths ----------------------------------------------------------------------------


def _checked(linearizations, blades=True):
    """The first file, azimuths and A, B, C, D of all, rotor speed, signals that turn (or None)."""
    files = list(linearizations) if np.iterable(linearizations) else [linearizations]
    if not files or not all(isinstance(file, OpenFASTLinearization) for file in files):
        raise ValueError(
            f"linearizations={linearizations!r} must be a list of results of read_openfast_lin"
        )
    for file in files[1:]:
        for kind in ("states", "inputs", "outputs"):
            if not getattr(file, kind).index.equals(getattr(files[0], kind).index):
                raise ValueError(
                    f"the files at azimuths {files[0].azimuth:g} and {file.azimuth:g} rad list "
                    f"different {kind}; give one turbine at one operating point"
                )
    speeds = np.array([file.rotor_speed for file in files])
    if np.ptp(speeds) > 1e-3 * speeds.max():
        raise ValueError(
            f"the rotor speeds of the files lie between {speeds.min():g} and {speeds.max():g} "
            f"rad/s; give one operating point at several azimuths"
        )
    frame = _frame(files[0]) if blades else None
    psi = np.array([file.azimuth for file in files])
    matrices = tuple(np.stack([getattr(file, name) for file in files]) for name in "ABCD")
    return files[0], psi, matrices, float(speeds.mean()), frame


def _fitted(matrices, psi, harmonics):
    """Fourier coefficients of the given harmonics; ValueError for too few azimuths."""
    functions = harmonic_functions(psi, harmonics)
    values = np.linalg.svd(functions, compute_uv=False)
    if len(psi) < functions.shape[1] or values[0] > 30.0 * values[-1]:
        period = 360.0 / harmonics[-1]
        degrees = np.unique(np.round(np.degrees(psi) % period)).tolist()
        raise ValueError(
            f"{len(psi)} azimuths do not determine the {functions.shape[1]} coefficients of "
            f"harmonics {harmonics}: modulo {period:g}°, the period of the highest, they are "
            f"{degrees}; linearise at more azimuths, or lower n_harmonics"
        )
    inverse = np.linalg.pinv(functions)
    return tuple(np.tensordot(inverse, M, axes=(1, 0)) for M in matrices)


def _chosen(matrices, names, inputs, outputs, loose):
    """The matrices with the requested inputs and outputs, and their names.

    The second kind of input is an acceleration on a rate, the second of output a state.
    """
    A, B, C, D = matrices
    n, m, n_outputs = A.shape[1], B.shape[2], C.shape[1]
    unit = np.zeros((len(A), n, n))
    unit[0] = np.eye(n)
    B = np.concatenate([B, unit], axis=2)
    C = np.concatenate([C, unit], axis=1)
    D = np.pad(D, ((0, 0), (0, n), (0, n)))
    rates = _rates(names[0])
    allowed = [*names[1], *(name if name in rates else None for name in names[0])]
    labels = [*names[2], *names[0]]
    columns = _places("inputs", inputs, m, allowed, loose)
    rows = _places("outputs", outputs, n_outputs, labels, loose)
    return (
        A,
        B[:, :, columns],
        C[:, rows],
        D[:, rows][:, :, columns],
        [allowed[k] for k in columns],
        [labels[k] for k in rows],
    )


def _rates(names):
    """Names of the states that are rates of other states."""
    return [name for name in names if name.removesuffix("_dot") in set(names) - {name}]


def _places(parameter, wanted, n_own, allowed, loose):
    """Positions of the requested names; by default those of the files' own signals."""
    wanted = allowed[:n_own] if wanted is None else check_names(wanted, parameter)
    unknown = [name for name in wanted if name not in allowed]
    if unknown:
        known = [name for name in allowed if name is not None]
        raise ValueError(f"{parameter}={unknown} are not known; choose from {known}")
    turning = [name for name in wanted if name in loose]
    if turning:
        raise ValueError(
            f"{parameter}={turning} turn with the rotor, but are not one for each of three blades; "
            f"leave them out, or use rotor_system(..., coordinates='rotating')"
        )
    return [allowed.index(name) for name in wanted]
