"""Time-invariant models of a periodic system for controller design.

The harmonic decomposition has n (2 N + 1) states, of which n are the system's: the others are
copies of its modes, λ + jkω. ``LTPSystem.minimal_model`` and ``harmonic_modes`` need this.

The periodic system behind a harmonic decomposition: the inverse of Eqs. 8 and 9.

    A + ω N = T(F),   B = T(G),   C = T(P),   D = T(Q)

T is affine in the Fourier coefficients, each of which appears in several places. The result is the
nearest fit to the given matrices. ``LTPSystem.from_harmonic_decomposition`` needs it.
"""

import re
from itertools import product

import control
import numpy as np
import pandas as pd
from scipy import linalg
from scipy.optimize import linear_sum_assignment
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._checks import check_fraction, check_positive, real_array
from sklearn_hd._guards import warn
from sklearn_hd.algorithms.linalg.rounding import EXACT, HALF, PRECISION, UNKNOWN
from sklearn_hd.algorithms.lti.simulation import block_diagonal
from sklearn_hd.algorithms.periodic.floquet import state_units
from sklearn_hd.algorithms.periodic.harmonic_balance import trimmed_harmonics
from sklearn_hd.algorithms.periodic.harmonic_decomposition import (
    base_families,
    derivative_matrix,
    nearest_eigenvalues,
    shares,
    split_modes,
    toeplitz_coefficients,
    toeplitz_matrix,
)
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems.arguments import check_names, harmonic_names

MOST_STATES = 800  # of a decomposition, whose eigenvalues then take about a second
MOST_HARMONICS = 64
MOST_LOSS = 0.1  # of a response, that a model may miss without a word
CLOSE = 1e-6  # of ω: eigenvalues that are told as those of the system
_NAME = re.compile(r"(?P<signal>.+)_(?P<label>0|[1-9]\d*[cs])")


def minimal_model(system, n_copies, n_output_harmonics):
    """Controllable and observable StateSpace of the base modes and some copies, and its loss."""
    units, families = state_units(system.F), _families(system)
    wanted = [_with_copies(family, n_copies, system.omega) for family in families]
    kept = _converged(system, units, np.concatenate(wanted), n_output_harmonics, max(n_copies, 2))
    A, B, C = kept.A, kept.B, np.vstack([kept.C, units[:, None] * kept.states])
    lost = _warn_lost(kept, np.concatenate(families), n_output_harmonics, system.omega)
    stay = int(np.sum(~lost))
    if stay < len(A):
        A, B, C = block_diagonal(A, B, C, kept.eigenvalues[~lost], kept.eigenvalues[lost])
        A, B, C = A[:stay, :stay], B[:stay], C[:, :stay]
    A, B, C, states = _in_means(A, B, C, units, system.state_names)
    signals = {
        "inputs": harmonic_names(system.input_names, 0),
        "outputs": harmonic_names(system.output_names, n_output_harmonics),
    }
    model = control.StateSpace(A, B, C, kept.D, states=states, **signals)
    if kept.loss > MOST_LOSS:
        warn(
            f"the model is off by {kept.loss:.0%} of the response of an output to an input (rms "
            f"over frequency), which goes through copies of the modes; keep some "
            f"(n_copies={n_copies + 1}), or design for the periodic system itself",
            IdentifiabilityWarning,
        )
    return _without_twins(model, signals), kept.loss


def harmonic_modes(system, n_harmonics):
    """Table of the modes of the harmonic decomposition: base modes and copies."""
    families = _families(system)
    bases = np.concatenate(families)
    kept = _converged(system, state_units(system.F), bases, 0, max(n_harmonics, 2))
    reach, shown = shares(kept.reach), shares(kept.shown)
    which = linear_sum_assignment(np.abs(bases[:, None] - kept.eigenvalues))[1]
    members = np.split(which, np.cumsum([len(family) for family in families])[:-1])
    middle, rows = reach.shape[1] // 2, []
    for family in members:
        seen = []
        for k in sorted(range(-n_harmonics, n_harmonics + 1), key=abs):
            for i in family:
                base = kept.eigenvalues[i]
                z = base + 1j * k * system.omega
                if all(abs(z - other) > CLOSE * system.omega for other in seen):
                    seen.append(z)
                    rows.append((z, base, k, reach[i, middle + k], shown[i, middle + k]))
    columns = ["eigenvalue", "base", "copy", "controllability", "observability"]
    return pd.DataFrame(rows, columns=columns)


def _in_means(A, B, C, units, names):
    """The model in the means of states, the last rows of C, if they determine its modes."""
    n, k = len(units), len(A)
    C, means = C[:-n], C[-n:]
    if 0 < k <= n:
        rows = np.sort(linalg.qr((means / units[:, None]).T, mode="r", pivoting=True)[1][:k])
        V = means[rows]
        if np.linalg.cond(V / units[rows, None]) < 1.0 / HALF:
            inverse = np.linalg.inv(V)
            names = harmonic_names([names[i] for i in rows], 0)
            return V @ A @ inverse, V @ B, C @ inverse, names
    return A, B, C, [f"z{i + 1}" for i in range(k)]


def _families(system):
    mean = system.fourier_coefficients(0)[0][0]
    return base_families(mean, system.floquet_exponents(), system.omega)


def _with_copies(family, n_copies, omega):
    """The eigenvalues of a family with those next to them, each once."""
    values = [z + 1j * k * omega for z in family for k in range(-n_copies, n_copies + 1)]
    kept = []
    for z in values:
        if not any(abs(z - other) <= CLOSE * omega for other in kept):
            kept.append(z)
    return np.array(kept)


def _converged(system, units, wanted, n_outputs, n_copies):
    """The requested modes, from a decomposition with as many harmonics as they need."""
    n, N = system.n_states, max(4, 2 * n_copies)
    most = max(2 * N, min(MOST_HARMONICS, MOST_STATES // (2 * n)))
    kept = None
    while kept is None:
        F, G, P, Q = system.fourier_coefficients(max(2 * N, N + n_copies, N + n_outputs))
        scaled = F * (units / units[:, None]), G / units[:, None], P * units, Q
        last = most < 2 * N
        A = toeplitz_matrix(scaled[0], N, N) - derivative_matrix(N, n, system.omega)
        if last or nearest_eigenvalues(wanted, linalg.eigvals(A))[1] <= HALF * system.omega:
            try:
                kept = split_modes(scaled, system.omega, wanted, N, n_outputs, n_copies)
            except (ValueError, np.linalg.LinAlgError) as error:  # at fewer harmonics, by chance
                if last:
                    raise ValueError(
                        f"base modes and copies of the harmonic decomposition of {N} harmonics "
                        f"cannot be separated to working precision ({error}); F varies too much "
                        f"for a time-invariant model: design for the periodic system itself"
                    ) from None
        if kept is None:
            N *= 2
    if kept.error > CLOSE * system.omega:
        warn(
            f"an eigenvalue of the harmonic decomposition of {N} harmonics differs by "
            f"{kept.error:.2g} rad/s from the Floquet exponent, because F has kinks or jumps, or "
            f"two exponents are equal; the model's eigenvalues have the same error",
            ConvergenceWarning,
        )
    return kept


def _warn_lost(kept, bases, n_outputs, omega):
    """Modes that inputs do not reach or outputs do not show, with a warning of base modes."""
    middle = kept.reach.shape[2] // 2
    reached = shares(kept.reach)[:, middle]
    shown = shares(kept.shown)[:, middle - n_outputs : middle + n_outputs + 1].max(axis=1)
    lost = (reached <= UNKNOWN) | (shown <= UNKNOWN)
    base = np.min(np.abs(kept.eigenvalues[:, None] - bases), axis=1) <= CLOSE * omega
    for i in np.flatnonzero(lost & base & (kept.eigenvalues.imag >= 0.0)):
        how = f"not reached by harmonic 0 of the inputs ({reached[i]:.1g} of its largest harmonic)"
        if reached[i] > UNKNOWN:
            how = f"not seen in the harmonics kept of the outputs ({shown[i]:.1g} of its largest)"
        warn(
            f"the mode {kept.eigenvalues[i]:.4g} (1/s) is {how}, so the minimal model leaves it "
            f"out: no gain from these outputs to these inputs moves it; keep copies and harmonics "
            f"(n_copies=1, n_output_harmonics=1), or design for the periodic system itself",
            IdentifiabilityWarning,
        )
    return lost


def _without_twins(model, signals):
    """The model without combinations of modes with one eigenvalue that inputs move alike."""
    least = control.minimal_realization(model, verbose=False)
    if least.nstates == model.nstates:
        return model
    warn(
        f"{model.nstates - least.nstates} combination(s) of modes with the same eigenvalue are not "
        f"reached or not seen, so the minimal model leaves them out: inputs move them alike",
        IdentifiabilityWarning,
    )
    states = [f"z{i + 1}" for i in range(least.nstates)]
    return control.StateSpace(least.A, least.B, least.C, least.D, states=states, **signals)


def read_decomposition(model, omega, names, tolerance):
    """Fourier coefficients of F, G, P and Q, and names, of the system behind a decomposition.

    ``names`` holds ``state_names``, ``input_names`` and ``output_names``: signals in the paper's
    order, or None if the labels of the model name them. The tolerance is the largest relative
    misfit.
    """
    omega = check_positive("omega", omega, "rad/s", "it is 2π over the period in seconds")
    check_fraction("tolerance", tolerance, "0.1 is usual")
    labelled = ("state_labels", "input_labels", "output_labels")
    if not all(hasattr(model, name) for name in ("A", "B", "C", "D", "dt", *labelled)):
        raise ValueError(f"model={model!r} is not a state-space model; give a control.StateSpace")
    if model.dt:
        raise ValueError(
            f"the model has a sample time of {model.dt} s; a harmonic decomposition is "
            f"continuous: bring the model to continuous time first"
        )
    wanted = "finite matrices of a control.StateSpace"
    A, B, C, D = (real_array(name, getattr(model, name), wanted) for name in "ABCD")
    sides = [
        _read_labels(name, list(getattr(model, labels)), given)
        for (name, given), labels in zip(names.items(), labelled, strict=True)
    ]
    states, inputs, outputs = sides
    given = {"F": (A, states, states), "G": (B, states, inputs)}
    given |= {"P": (C, outputs, states), "Q": (D, outputs, inputs)}
    found, misfits = {}, {}
    for name, (M, rows, columns) in given.items():
        pairs = _pairs(rows, columns)
        sizes = _sizes(M, pairs)
        if name == "F":
            scale = linalg.matrix_balance(sizes, permute=False, separate=True)[1][0]
            M = M + _rates(states, omega)
        found[name], nearest = _nearest(name, M, pairs)
        left = _sizes(M - nearest, pairs)
        misfits["ABCD"["FGPQ".index(name)]] = _misfit(name, left, sizes, scale)
    _check_misfits(misfits, tolerance)
    read = {name: tuple(side) for name, side in zip(names, sides, strict=True)}
    return [trimmed_harmonics(coefficients, EXACT) for coefficients in found.values()], read


def _read_labels(parameter, labels, given):
    """Row of each coefficient, by signal and by place in the order 0, 1c, 1s, …."""
    if given is not None:
        names = check_names(given, parameter)
        count, left = divmod(len(labels), len(names)) if names else (0, 1)
        if left or count % 2 == 0:
            raise ValueError(
                f"{parameter}={list(names)} names {len(names)} signals, but the model has "
                f"{len(labels)} coefficients: it must have 2 N + 1 of each signal"
            )
        return {s: {p: p * len(names) + i for p in range(count)} for i, s in enumerate(names)}
    found = {}
    for row, label in enumerate(labels):
        match = _NAME.fullmatch(label)
        if match is None:
            raise ValueError(
                f"{label!r} is not a harmonic of a signal, such as w_0 or w_1c; give {parameter}, "
                f"the signals in the order of Eq. 8 (all signals' harmonic 0, then 1c, 1s, …)"
            )
        k = match["label"]
        place = 0 if k == "0" else 2 * int(k[:-1]) - (k[-1] == "c")
        found.setdefault(match["signal"], {})[place] = row
    return found


def _pairs(rows, columns):
    """Names, harmonics and places in a matrix of each pair of signals, (rows, columns)."""
    pairs = np.empty((len(rows), len(columns)), dtype=object)
    for (i, (r, own)), (j, (c, its)) in product(
        enumerate(rows.items()), enumerate(columns.items())
    ):
        where = np.ix_(list(own.values()), list(its.values()))
        pairs[i, j] = (f"[{r},{c}]", (tuple(own), tuple(its)), where)
    return pairs


def _rates(states, omega):
    """ω N for some harmonics of each state."""
    n = sum(map(len, states.values()))
    highest = max(place for own in states.values() for place in own) + 1 >> 1
    rate, rates = derivative_matrix(highest, 1, omega), np.zeros((n, n))
    for own in states.values():
        rows = list(own.values())
        rates[np.ix_(rows, rows)] = rate[np.ix_(list(own), list(own))]
    return rates


def _nearest(name, M, pairs):
    """Fourier coefficients of a matrix, and the block matrix that they make."""
    alike = {}  # pairs of signals by the harmonics that they have
    for at, (_, kept, _) in np.ndenumerate(pairs):
        alike.setdefault(kept, []).append(at)
    found, nearest = np.zeros((1, *pairs.shape)), np.zeros_like(M)
    for kept, places in alike.items():
        blocks = np.array([M[pairs[at][2]] for at in places])
        coefficients, close, unseen = toeplitz_coefficients(blocks, *kept)
        if unseen:
            raise ValueError(
                f"the kept harmonics do not show harmonic(s) {unseen} of "
                f"{name}{pairs[places[0]][0]}; give a decomposition that keeps all harmonics of "
                f"each signal, from 0 up to its highest"
            )
        more = max(0, len(coefficients) - len(found))
        found = np.pad(found, ((0, more), (0, 0), (0, 0)))
        for at, one, block in zip(places, coefficients.T, close, strict=True):
            found[(slice(len(one)), *at)], nearest[pairs[at][2]] = one, block
    return found, nearest


def _sizes(M, pairs):
    """Frobenius norm of the block of each pair of signals."""
    sizes = [np.linalg.norm(M[where]) for _, _, where in pairs.ravel()]
    return np.reshape(sizes, pairs.shape).astype(float)


def _misfit(name, left, sizes, scale):
    """Residual of a matrix relative to the matrix, independent of the units of the signals.

    States are scaled so that A is balanced. An input, or an output, counts by its own size.
    """
    if name in "FG":
        left, sizes = (values / scale[:, None] for values in (left, sizes))
    if name in "FP":
        left, sizes = (values * scale for values in (left, sizes))
    axis = {"F": None, "G": 0, "P": 1, "Q": None}[name]
    left, sizes = (np.linalg.norm(values, axis=axis) for values in (left, sizes))
    return float(np.max(left / np.where(sizes > 0.0, sizes, 1.0), initial=0.0))


def _check_misfits(misfits, tolerance):
    """Refuse matrices that are not multiplications by Fourier series, or warn of them."""
    name = max(misfits, key=misfits.get)
    if misfits[name] <= PRECISION:
        return
    figures = ", ".join(f"{each} {misfit:.2g}" for each, misfit in misfits.items())
    words = (
        f"the model is not a harmonic decomposition of a periodic system at this omega: the "
        f"nearest one leaves these shares of its matrices (Frobenius norm): {figures}"
    )
    if misfits[name] > tolerance:
        raise ValueError(
            f"{words}, above tolerance={tolerance:g}; check omega and the order of the signals, or "
            f"match the model to a HarmonicStructure (StructuredMatcher), which has this pattern"
        )
    warn(f"{words}; the nearest periodic system is returned", IdentifiabilityWarning)
