"""Which identified modes belong to the system, and which to the harmonic analyzer.

A mode λ of the system with harmonic vector v leaves, through a window of
transfer function Ĥ, the coefficients

    Ŷ_k(t) = Σ_m Ĥ(λ + j(m−k)ω) v_m e^{(λ + j(m−k)ω) t}

so the identified modes are the genuine ones, copies of them shifted by
multiples of jω, which share the Floquet multiplier e^{λT}, and the window's
finite memory: a nilpotent block that rounding and noise spread to small |z|.

Sampled r times a period, z^r = e^{λT} is the same for a mode and its copies:
that groups the families. Which members stand for a family is decided by how
well they explain the raw signals.

Which set of modes explains the raw signals best.

The measured response to a mode λ with output vector c is linear in its participation in
each input and in its initial amplitude. So the fit with a set of modes is a linear
least-squares problem, all sets share one triangular factor, and the best set of a size
is a selection of its columns.
"""

import itertools
import math

import numpy as np
from scipy import linalg
from scipy.signal import lfilter

from sklearn_hd.algorithms.linalg.rounding import EXACT, HALF
from sklearn_hd.algorithms.linalg.triangular import (
    column_sizes,
    solve_within_rank,
    svd_within_rank,
    triangle,
)

FAINT = 1e-6  # what is left at a window's end of a mode that rounding still tells from its memory
COPY_TOLERANCES = (1e-3, 3e-3, 1e-2, 3e-2)  # of its decay, by which a family's members differ
PIECE = 250_000  # numbers in the responses of some samples: 2 MB
MAX_SUBSETS = 2_000


def is_window_pole(z, window_rows, decay):
    """Whether discrete poles die within the analysis window, |z|^n_window ≤ decay.

    A response that falls below this share within the window is its memory.
    """
    return np.abs(z) ** window_rows <= decay


def floquet_families(z, rows_per_period, tolerance):
    """Number of the family {λ + jpω} of each pole, slowest first; conjugate families count as one.

    Poles whose Floquet multipliers z^r, folded to the upper half plane, differ
    by less than the tolerance on a logarithmic scale share a family.

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


def agreeing_copies(z, output_harmonics, rows_per_period, tolerance=COPY_TOLERANCES[0]):
    """Which poles (not those of the window's memory) belong to a complete family.

    The members of a genuine family, that is a mode and its copies, share their Floquet
    multiplier to the precision of the data, and are as many as a mode of the system must have;
    what noise, the window's memory or inputs between the rows add to a model does not come in
    such sets. The tolerance is that of ln z^r from the family's median, relative to its decay.

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
    members = np.zeros(len(z), dtype=bool)
    for family in range(max(families) + 1):
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


def conjugate_units(z):
    """Conjugate-closed units that can be kept or dropped: (i,) of a real pole, (i, j) of a pair.

    Poles on the negative real axis have no continuous-time counterpart of
    their own and give no unit. The upper member of a pair comes first.
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


def real_block(exponents):
    """Real block-diagonal R of some real exponents, and one member of each complex pair.

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


FEW_SUBSETS, MANY = 100, 16  # of more states, more sets than these are not searched through


WIDE = 8_000  # columns of all units times states of those searched through


WIDE_SUBSETS = 400_000  # columns of all units times sets, each of which is a fit of its own


def mode_regressors(exponent, shape, drive, dt, observe=None, state=None):
    """Measured response to one mode, for each input and for its initial amplitude.

    A complex exponent λ (1/s) stands for the pair, ``shape`` (n_coefficients,) is its output
    vector C v, and ``observe`` (n_samples, l, n_coefficients) what is measured of the
    coefficients. ``state`` (m + 1,) is what the samples before have left. Returned are the
    regressors (n_samples, l, m + 1 or 2 (m + 1)), and the state one sample after the last.
    """
    z = np.exp(exponent * dt)
    forcing = np.pad(drive, ((0, 0), (0, 1)))
    if state is None:
        state = np.eye(forcing.shape[1], dtype=complex)[-1]
    amplitudes, state = lfilter([0.0, 1.0], [1.0, -z], forcing, axis=0, zi=state[None])
    measured = shape[None, :] if observe is None else observe @ shape
    response = measured[:, :, None] * amplitudes[:, None, :]
    if exponent.imag == 0.0:
        return response.real, state[0]
    return np.concatenate([response.real, response.imag], axis=-1), state[0]


def unit_regressors(units, exponents, shapes, inputs, outputs, dt, observe):
    """Triangular factor of the responses of all units beside the outputs, and each unit's columns.

    Exponents (n,) and output vectors (n, n_coefficients) are those of the modes; inputs,
    outputs and ``observe`` have one array a segment, which has initial amplitudes of its own.
    """
    width = inputs[0].shape[1] + 1
    edges = np.cumsum([0, *(width * len(unit) for unit in units)])
    n_states = sum(len(unit) for unit in units)
    total = int(edges[-1]) + (len(inputs) - 1) * n_states
    columns = [list(range(a, b)) for a, b in itertools.pairwise(edges)]
    R, following = np.zeros((0, total + 1)), int(edges[-1])
    length = max(4 * (total + 1), PIECE // (total + 1))  # of rows, one an output
    for s, (u, y) in enumerate(zip(inputs, outputs, strict=True)):
        states = [None] * len(units)
        some = max(1, length // y.shape[1])
        for start in range(0, len(u), some):
            piece, at = slice(start, start + some), following
            rows = np.zeros((y[piece].size, total + 1))
            for k, unit in enumerate(units):
                exponent = exponents[unit[0]]
                exponent = exponent if len(unit) == 2 else complex(exponent.real)
                response, states[k] = mode_regressors(
                    exponent, shapes[unit[0]], u[piece], dt, observe[s][piece], states[k]
                )
                response = response.reshape(len(rows), len(unit), width)
                rows[:, edges[k] : edges[k + 1]] = response.reshape(len(rows), -1)
                if s:  # the initial amplitudes move to columns of this segment's own
                    rows[:, edges[k] + np.arange(len(unit)) * width + width - 1] = 0.0
                    rows[:, at : at + len(unit)] = response[:, :, -1]
                    at += len(unit)
            rows[:, -1] = y[piece].reshape(-1)
            R = triangle(rows, R)
        if s:
            for k, unit in enumerate(units):
                columns[k] += range(following, following + len(unit))
                following += len(unit)
    return R, [np.array(column) for column in columns]


def best_modes(R, columns, sizes, n_states, smaller=()):
    """The set of units with a given number of states that explains the data best.

    From the factor R (p + 1, p + 1) of [regressors, target], the columns of each unit and its
    number of states, 1 or 2. Returned are residual sums of squares and units, best first; none
    where no set of units has that many states. All sets where they are fewer than 2000, else
    the one found by forward selection and exchange; of more than 16 states one of those
    ``smaller`` (the best sets of one and two states less) and one unit more, as exchanges take
    minutes among a hundred modes. With many inputs these numbers are smaller.
    """
    n_subsets = sum(
        math.comb(sizes.count(2), pairs) * math.comb(sizes.count(1), n_states - 2 * pairs)
        for pairs in range(n_states // 2 + 1)
    )
    if n_subsets == 0:
        return []
    if n_states > min(MANY, WIDE // len(R)) and n_subsets > FEW_SUBSETS:
        grown = _grown(R, columns, sizes, n_states, smaller)
        if grown:
            return [min(grown)]
    if n_subsets <= min(MAX_SUBSETS, WIDE_SUBSETS // len(R)):
        return sorted((residual(R, columns, units), units) for units in _subsets(sizes, n_states))
    return [_exchange(R, columns, sizes, n_states)]


def _subsets(sizes, n_states):
    singles = [i for i, size in enumerate(sizes) if size == 1]
    pairs = [i for i, size in enumerate(sizes) if size == 2]
    for n_pairs in range(n_states // 2 + 1):
        for some in itertools.combinations(pairs, n_pairs):
            for rest in itertools.combinations(singles, n_states - 2 * n_pairs):
                yield tuple(sorted((*some, *rest)))


def residual(R, columns, units):
    """Residual sum of squares of the least-squares fit with the columns of some units."""
    if not units:
        return float(R[:, -1] @ R[:, -1])
    regressors = R[:, np.concatenate([columns[i] for i in units])]
    rest = R[:, -1] - regressors @ solve_within_rank(regressors, R[:, -1], cond=EXACT)
    return float(rest @ rest)


def _grown(R, columns, sizes, n_states, smaller):
    """Each smaller set with the unit that it gains most by."""
    grown = []
    for _, units in smaller:
        left = n_states - sum(sizes[i] for i in units)
        others = [i for i in range(len(sizes)) if sizes[i] == left and i not in units]
        if others:
            values = _residuals_with(R, columns, units, others)
            best = int(np.argmin(values))
            grown.append((float(values[best]), tuple(sorted((*units, others[best])))))
    return grown


def _exchange(R, columns, sizes, n_states):
    """Forward selection, then exchanges of equal size while they help."""
    chosen, left = (), n_states
    while left:
        open_units = [i for i in range(len(sizes)) if i not in chosen and sizes[i] <= left]
        if left == 2 or not any(sizes[i] == 1 for i in open_units):
            open_units = [i for i in open_units if sizes[i] == 2] or open_units
        if not open_units:
            break
        best = open_units[int(np.argmin(_residuals_with(R, columns, chosen, open_units)))]
        chosen, left = (*chosen, best), left - sizes[best]
    value = residual(R, columns, chosen)
    improved = True
    while improved:
        improved = False
        for out in chosen:
            others = [i for i in range(len(sizes)) if i not in chosen and sizes[i] == sizes[out]]
            kept = tuple(i for i in chosen if i != out)
            values = _residuals_with(R, columns, kept, others)
            better = np.flatnonzero(values < value * (1.0 - 1e-9))
            if len(better):
                new, value = others[better[0]], values[better[0]]
                chosen, improved = tuple(new if i == out else i for i in chosen), True
                break
    return float(value), tuple(sorted(chosen))


def _residuals_with(R, columns, kept, candidates):
    """The :func:`residual` of some units and one more, for each of the candidates.

    What is kept is projected out once; each candidate is then a small problem of its own,
    some thirty times faster than a least-squares fit with all of them.
    """
    target, scaled = R[:, -1], R[:, :-1] / column_sizes(R[:, :-1])
    if kept:
        Q = svd_within_rank(scaled[:, np.concatenate([columns[i] for i in kept])], EXACT)[0]
        for _ in range(2):
            scaled, target = scaled - Q @ (Q.T @ scaled), target - Q @ (Q.T @ target)
    values = np.empty(len(candidates))
    for k, i in enumerate(candidates):
        Q = svd_within_rank(scaled[:, columns[i]], EXACT, largest=1.0)[0]
        rest = target - Q @ (Q.T @ target)
        values[k] = rest @ rest
    return values
