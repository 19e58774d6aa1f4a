"""Which identified modes belong to the system, and which to the harmonic analyzer.

A mode λ of the system with harmonic vector v leaves, through a window of
transfer function Ĥ, the coefficients

    Ŷ_k(t) = Σ_m Ĥ(λ + j(m−k)ω) v_m e^{(λ + j(m−k)ω) t}

so the identified modes are the genuine ones, copies of them shifted by
multiples of jω, which share the Floquet multiplier e^{λT}, and the window's
finite memory: a nilpotent block that rounding and noise spread to small |z|.

Sampled r times a period, z^r = e^{λT} is the same for a mode and its copies:
that groups the families. Which members stand for a family is decided by how
well they explain the raw signals (:mod:`sklearn_hd.algorithms.modes.selection`).
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import HALF

__all__ = [
    "agreeing_copies",
    "complete_families",
    "conjugate_units",
    "expected_members",
    "floquet_families",
    "invariant_pair",
    "is_window_pole",
    "real_block",
]

FAINT = 1e-6  # what is left at a window's end of a mode that rounding still tells from its memory
COPY_TOLERANCES = (1e-3, 3e-3, 1e-2, 3e-2)  # of its decay, by which a family's members differ


def is_window_pole(z, window_rows, decay):
    """Whether discrete poles die within the analysis window, |z|^n_window ≤ decay.

    Parameters
    ----------
    z : complex ndarray, shape (n,)
        Eigenvalues of the discrete A.
    window_rows : int
        Rows read within one window.
    decay : float
        A response that falls below this share within the window is its memory.

    Returns
    -------
    mask : ndarray of bool, shape (n,)
    """
    return np.abs(z) ** window_rows <= decay


def floquet_families(z, rows_per_period, tolerance):
    """Number of the family {λ + jpω} of each pole; conjugate families count as one.

    Poles whose Floquet multipliers z^r, folded to the upper half plane, differ
    by less than the tolerance on a logarithmic scale share a family.

    Parameters
    ----------
    z : complex ndarray, shape (n,)
    rows_per_period : int
    tolerance : float
        Largest |Δ ln z^r| between neighbours of one family.

    Returns
    -------
    family : ndarray of int, shape (n,)
        Slowest family first.

    Examples
    --------
    >>> z = np.exp(np.array([-0.1, -0.1 + 1j * np.pi / 2, -0.3]))
    >>> floquet_families(z, 4, 0.05).tolist()
    [0, 0, 1]
    """
    multipliers = np.asarray(z, dtype=complex) ** rows_per_period
    folded = np.log(multipliers.real + 1j * np.abs(multipliers.imag))
    near = np.abs(folded[:, None] - folded[None, :]) <= tolerance
    while True:  # transitive closure: chains of neighbours are one family
        wider = (near.astype(int) @ near.astype(int)) > 0
        if np.array_equal(wider, near):
            break
        near = wider
    first = np.array([np.flatnonzero(row)[0] for row in near], dtype=int)
    heads = sorted(set(first.tolist()), key=lambda i: -folded[i].real)
    return np.array([heads.index(i) for i in first], dtype=int)


def expected_members(output_harmonics, rows_per_period):
    """Members λ + jpω of one family that a window shows of a harmonic decomposition.

    Coefficient k of an output holds its harmonics m as copies shifted by p = m − k;
    shifts that differ by the rows in a period are one. A periodic system, whose
    harmonics do not end, shows all of them.

    Examples
    --------
    >>> expected_members([(0, 1)], 8), expected_members([(0,), (1,)], 8)
    (5, 3)
    """
    shifts = set()
    for orders in output_harmonics:
        signed = {sign * k for k in orders for sign in (1, -1)}
        shifts |= {(m - k) % rows_per_period for m in signed for k in signed}
    return len(shifts)


def complete_families(z, families, rows_per_period, n_members, tolerance):
    """Families with as many members as a mode of the system must have.

    The members of a genuine family, that is a mode and its copies, share their Floquet
    multiplier to the precision of the data; what noise, the window's memory or inputs
    between the rows add to a model does not come in such sets.

    Parameters
    ----------
    z : complex ndarray, shape (n,)
    families : ndarray of int, shape (n,)
        Negative for poles of no family.
    rows_per_period, n_members : int
    tolerance : float
        Largest distance of ln z^r from the family's median, relative to its decay.

    Returns
    -------
    members : ndarray of bool, shape (n,)
        Poles that agree with a complete family.
    """
    members = np.zeros(len(z), dtype=bool)
    for family in range(max(families, default=-1) + 1):
        own = np.flatnonzero(families == family)
        logarithms = rows_per_period * np.log(z[own])
        angles = (logarithms.imag + np.pi) % (2.0 * np.pi) - np.pi
        folded = logarithms.real + 1j * np.abs(angles)
        centre = np.median(folded.real) + 1j * np.median(folded.imag)
        agree = np.abs(folded - centre) <= tolerance * abs(centre.real)
        # a real multiplier, of either sign, has one member a shift, a pair two
        from_real = min(abs(centre.imag), np.pi - abs(centre.imag))
        pair = from_real > tolerance * abs(centre.real)
        if agree.sum() >= (2 if pair else 1) * n_members:
            members[own[agree]] = True
    return members


def agreeing_copies(z, output_harmonics, rows_per_period, tolerance=COPY_TOLERANCES[0]):
    """Poles that belong to a complete family.

    Parameters
    ----------
    z : complex ndarray, shape (n,)
        Not those of the window's memory.
    output_harmonics : list of sequence of int
    rows_per_period : int
    tolerance : float

    Returns
    -------
    members : ndarray of bool, shape (n,)

    Examples
    --------
    A mode and its copies in harmonics 0 and 1 agree; another pole stands alone:

    >>> z = np.exp(-0.1 + 0.25j * np.pi * np.arange(-2, 3))
    >>> agreeing_copies(np.append(z, 0.8), [(0, 1)], 8).tolist()
    [True, True, True, True, True, False]
    """
    if len(z) == 0:
        return np.zeros(0, dtype=bool)
    families = floquet_families(z, rows_per_period, tolerance)
    n_members = expected_members(output_harmonics, rows_per_period)
    return complete_families(z, families, rows_per_period, n_members, tolerance)


def conjugate_units(z):
    """Conjugate-closed units that can be kept or dropped: a real pole, or a pair.

    Poles on the negative real axis have no continuous-time counterpart of
    their own and give no unit.

    Returns
    -------
    units : list of tuple of int
        Index of a real pole, or of the upper and lower member of a pair.
    """
    z = np.asarray(z)
    real = np.abs(z.imag) <= HALF * np.abs(z)
    units = [(int(i),) for i in np.flatnonzero(real & (z.real > 0))]
    lower = list(np.flatnonzero(~real & (z.imag < 0)))
    for i in np.flatnonzero(~real & (z.imag > 0)):
        if not lower:
            break
        j = min(lower, key=lambda k: abs(z[k] - np.conj(z[i])))
        lower.remove(j)
        units.append((int(i), int(j)))
    return units


def invariant_pair(A, C, kept, dropped):
    """A and C restricted to the invariant subspace of some eigenvalues.

    An ordered real Schur form splits the subspace off, so that repeated or
    defective eigenvalues (such as those of a window's memory) do no harm.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    kept, dropped : complex ndarray
        Eigenvalues of A, conjugate-closed.

    Returns
    -------
    A_kept : ndarray, shape (n_kept, n_kept)
    C_kept : ndarray, shape (l, n_kept)
    """
    if len(dropped) == 0:
        return A, C
    if len(kept) == 0:
        return A[:0, :0], C[:, :0]

    def wanted(real, imag):
        z = real + 1j * imag
        return np.min(np.abs(z - kept)) < np.min(np.abs(z - dropped))

    T, Q, n_kept = linalg.schur(A, output="real", sort=wanted)
    if n_kept != len(kept):
        raise ValueError(
            f"{len(kept)} modes cannot be separated from the others: their eigenvalues coincide "
            f"to working precision; change n_states or the order"
        )
    return T[:n_kept, :n_kept], C @ Q[:, :n_kept]


def real_block(exponents):
    """Real block-diagonal R of some real exponents and complex pairs.

    Parameters
    ----------
    exponents : sequence of complex
        Real ones, and one member of each pair.

    Examples
    --------
    >>> real_block([-1.0, -0.5 + 2j]).tolist()
    [[-1.0, 0.0, 0.0], [0.0, -0.5, 2.0], [0.0, -2.0, -0.5]]
    """
    blocks = [
        np.array([[e.real, e.imag], [-e.imag, e.real]]) if e.imag else np.array([[e.real]])
        for e in np.asarray(exponents, dtype=complex)
    ]
    return linalg.block_diag(*blocks) if blocks else np.zeros((0, 0))
