"""Time-invariant models of a periodic system for controller design.

The harmonic decomposition has n (2 N + 1) states, of which n are the system's: the others are
copies of its modes, λ + jkω. ``LTPSystem.minimal_model`` and ``harmonic_modes`` need this.
"""

import control
import numpy as np
import pandas as pd
from scipy import linalg
from scipy.optimize import linear_sum_assignment
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._warn import warn
from sklearn_hd.algorithms.linalg.rounding import HALF, UNKNOWN
from sklearn_hd.algorithms.lti.residualization import block_diagonal
from sklearn_hd.algorithms.periodic.base_modes import (
    base_families,
    distance_from,
    shares,
    split_modes,
)
from sklearn_hd.algorithms.periodic.floquet import state_units
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems.arguments import harmonic_names

MOST_STATES = 800  # of a decomposition, whose eigenvalues then take about a second
MOST_HARMONICS = 64
MOST_LOSS = 0.1  # of a response, that a model may miss without a word
CLOSE = 1e-6  # of ω: eigenvalues that are told as those of the system


def minimal_model(system, n_copies, n_output_harmonics):
    """Controllable and observable model of the base modes and some copies, and its loss.

    Parameters
    ----------
    system : LTPSystem
    n_copies, n_output_harmonics : int

    Returns
    -------
    model : control.StateSpace
    loss : float
    """
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
            f"the model misses {kept.loss:.2g} of the response of an output to an input (rms over "
            f"frequency), which goes through copies of the modes; keep some "
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
        if last or distance_from(scaled[0], system.omega, wanted, N) <= HALF * system.omega:
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
