"""Which set of modes explains the raw signals best.

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

from sklearn_hd.algorithms.linalg.rounding import EXACT
from sklearn_hd.algorithms.linalg.triangular import triangle

__all__ = ["best_modes", "mode_regressors", "residual", "unit_regressors"]

PIECE = 250_000  # numbers in the responses of some samples: 2 MB
MAX_SUBSETS = 2_000
FEW_SUBSETS, MANY = 100, 16  # of more states, more sets than these are not searched through
WIDE = 8_000  # columns of all units times states of those searched through
WIDE_SUBSETS = 400_000  # columns of all units times sets, each of which is a fit of its own


def mode_regressors(exponent, shape, drive, dt, observe=None, state=None):
    """Measured response to one mode, for each input and for its initial amplitude.

    Parameters
    ----------
    exponent : complex
        λ in 1/s; a complex one stands for the pair.
    shape : complex ndarray, shape (n_coefficients,)
        Output vector C v of the mode.
    drive : ndarray, shape (n_samples, m)
    dt : float
        Sample time, seconds.
    observe : ndarray, shape (n_samples, n_outputs, n_coefficients), optional
        What is measured of the coefficients at each sample.
    state : complex ndarray, shape (m + 1,), optional
        What the samples before have left: the last of their ``state``. Of none by default.

    Returns
    -------
    regressors : ndarray, shape (n_samples, n_outputs, m + 1 or 2 (m + 1))
    state : complex ndarray, shape (m + 1,)
        Amplitudes one sample after the last.
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
    """Triangular factor of the responses of all units beside the outputs.

    Parameters
    ----------
    units : list of tuple of int
        From :func:`conjugate_units`.
    exponents : complex ndarray, shape (n,)
        1/s.
    shapes : complex ndarray, shape (n, n_coefficients)
        Output vectors of the modes.
    inputs, outputs : list of ndarray, shapes (n_samples_s, m) and (n_samples_s, l)
        One array a segment; each segment has initial amplitudes of its own.
    dt : float
        Sample time, seconds.
    observe : list of ndarray, shapes (n_samples_s, l, n_coefficients)

    Returns
    -------
    R : ndarray, shape (p + 1, p + 1)
    columns : list of ndarray of int
        Columns of R that belong to each unit.
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

    Parameters
    ----------
    R : ndarray, shape (p + 1, p + 1)
        Triangular factor of [regressors, target].
    columns : list of ndarray of int
        Columns of R that belong to each unit.
    sizes : list of int
        States of each unit, 1 or 2.
    n_states : int
    smaller : sequence of (float, tuple of int)
        The best sets of one and two states less, where they are known.

    Returns
    -------
    ranking : list of (float, tuple of int)
        Residual sum of squares and units, best first; empty where no set of
        units has that many states. All sets where they are fewer than 2000, else the
        one found by forward selection and exchange; of more than 16 states one of
        those smaller and one unit more, as exchanges take minutes among a hundred
        modes. With many inputs these numbers are smaller.
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
    scale = np.linalg.norm(regressors, axis=0)
    scale[scale == 0.0] = 1.0
    regressors = regressors / scale
    solution = linalg.lstsq(regressors, R[:, -1], cond=EXACT)[0]
    rest = R[:, -1] - regressors @ solution
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
    target, size = R[:, -1], np.linalg.norm(R[:, :-1], axis=0)
    scaled = R[:, :-1] / np.where(size > 0.0, size, 1.0)
    if kept:
        Q = _range(scaled[:, np.concatenate([columns[i] for i in kept])])
        for _ in range(2):
            scaled, target = scaled - Q @ (Q.T @ scaled), target - Q @ (Q.T @ target)
    values = np.empty(len(candidates))
    for k, i in enumerate(candidates):
        Q = _range(scaled[:, columns[i]], 1.0)
        rest = target - Q @ (Q.T @ target)
        values[k] = rest @ rest
    return values


def _range(columns, least=None):
    """Orthonormal columns that span what some columns do, except for rounding."""
    Q, values, _ = np.linalg.svd(columns, full_matrices=False)
    return Q[:, values > EXACT * (values[0] if least is None else least)]
