"""The periodic system behind a harmonic decomposition: the inverse of Eqs. 8 and 9.

    A + ω N = T(F),   B = T(G),   C = T(P),   D = T(Q)

T is affine in the Fourier coefficients, each of which appears in several places. The result is the
nearest fit to the given matrices. ``LTPSystem.from_harmonic_decomposition`` needs it.
"""

import re
from itertools import product

import numpy as np
from scipy import linalg

from sklearn_hd._checks import check_fraction, check_positive, real_array
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.linalg.rounding import EXACT, PRECISION
from sklearn_hd.algorithms.periodic.harmonic_decomposition import (
    derivative_matrix,
    toeplitz_coefficients,
)
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems.arguments import check_names

_NAME = re.compile(r"(?P<signal>.+)_(?P<label>0|[1-9]\d*[cs])")


def read_decomposition(model, omega, names, tolerance):
    """Fourier coefficients and names of the periodic system behind a decomposition.

    Parameters
    ----------
    model : control.StateSpace
    omega : float
        rad/s.
    names : dict
        ``state_names``, ``input_names``, ``output_names``: signals in the paper's order, or None
        if the labels of the model name them.
    tolerance : float
        Largest relative misfit.

    Returns
    -------
    matrices : list of ndarray
        Coefficients of F, G, P and Q.
    names : dict
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
    return [_without_dust(coefficients) for coefficients in found.values()], read


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


def _without_dust(coefficients):
    """Coefficients without the harmonics that are only rounding."""
    sizes = np.abs(coefficients)
    unit = np.max(sizes, axis=0)
    moving = np.flatnonzero(np.any(sizes > EXACT * unit, axis=(1, 2)))
    highest = (moving[-1] + 1) // 2 if len(moving) else 0
    return coefficients[: 2 * highest + 1]
