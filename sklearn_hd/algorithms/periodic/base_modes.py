"""The base modes of a periodic system, and which modes of its harmonic decomposition are copies.

A mode p(ψ) e^{λt} of ẋ = F(ψ) x stands in the harmonic decomposition as λ + jkω for every k. The
base one is that which the mean of F continues: the eigenvalue of F_0 nearest to the family. The
others are copies. With left and right eigenvectors of the decomposition at the base eigenvalue,
and B(ψ), C(ψ) the input and the output of the mode (Floquet coordinates),

    ż_{−k} = (λ + jkω) z_{−k} + B_{−k} u,   y_0 = Σ_k C_k z_{−k} + …         u = u_0 alone

A signal u without harmonics of its own reaches the copy k by the harmonic −k of B(ψ) alone, and
its effect shows in y_0 by the harmonic k of C(ψ) alone. Where these are zero, no feedback from y_0
to u moves λ + jkω: the decomposition is neither controllable nor observable from there.
``LTPSystem.minimal_model`` and ``LTPSystem.harmonic_modes`` need it.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.optimize import linear_sum_assignment

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, HALF, UNKNOWN
from sklearn_hd.algorithms.lti.residualization import block_diagonal
from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.algorithms.periodic.harmonic_decomposition import (
    derivative_matrix,
    harmonic_decomposition,
    toeplitz_matrix,
)

N_FREQUENCIES = 16  # at which two responses are compared: some ten in a decade of frequency


def base_families(mean, exponents, omega):
    """The base eigenvalue of each family of modes, closed under conjugation.

    Parameters
    ----------
    mean : ndarray, shape (n, n)
        F_0, the mean of F.
    exponents : complex ndarray, shape (n,)
        Floquet exponents, imaginary parts in (−ω/2, ω/2].
    omega : float
        rad/s.

    Returns
    -------
    families : list of complex ndarray
        Of a real exponent itself; of a conjugate pair both. Of a negative multiplier σ ± jω/2, two
        eigenvalues of one mode: a time-invariant model cannot have one without the other.

    Examples
    --------
    A mode at 7 rad/s, of which the exponent shows 7 − 2 · 3 = 1, and a lag:

    >>> mean = np.array([[0.0, 7.0, 0.0], [-7.0, 0.0, 0.0], [0.0, 0.0, -0.5]])
    >>> [f.tolist() for f in base_families(mean, np.array([1j, -1j, -0.5]), 3.0)]
    [[7j, -7j], [(-0.5+0j)]]
    """
    exponents = np.asarray(exponents, dtype=complex)
    apart = linalg.eigvals(mean)[:, None] - exponents
    shifts = np.round(apart.imag / omega)
    cost = np.abs(apart - 1j * omega * shifts)
    rows, columns = linear_sum_assignment(cost)
    chosen = np.empty(len(exponents), dtype=int)
    chosen[columns] = rows
    own = shifts[chosen, np.arange(len(exponents))]
    price = cost[chosen, np.arange(len(exponents))]
    edge = HALF * omega
    lower = [j for j in range(len(exponents)) if exponents[j].imag < -edge]
    families = []
    for j, exponent in enumerate(exponents):
        if exponent.imag < -edge:
            continue
        value = exponent + 1j * omega * own[j]
        if abs(exponent.imag) > edge and abs(exponent.imag) < 0.5 * omega - edge:
            twin = min(lower, key=lambda i, z=exponent: abs(exponents[i] - np.conj(z)))
            lower.remove(twin)
            if price[twin] < price[j]:
                value = exponent - 1j * omega * own[twin]
        real = abs(value.imag) <= edge
        families.append(np.array([value.real + 0j] if real else [value, np.conj(value)]))
    return families


@dataclass(frozen=True, eq=False)
class ModesKept:
    """Some modes of a harmonic decomposition, split off from the others.

    Attributes
    ----------
    A, B, C, D : ndarray
        From u_0 to the harmonics of y kept; D has the steady response of all other modes.
    states : ndarray, shape (n, n_kept)
        Harmonic 0 of the states by those of A.
    eigenvalues : complex ndarray, shape (n_kept,)
        Of A.
    reach : ndarray, shape (n_kept, m, 2 K + 1)
        Size of the effect of each input's harmonic −k (complex) on each mode, k from −K to K: what
        u_0 has on its copy k.
    shown : ndarray, shape (n_kept, l, 2 K + 1)
        Size of each mode in each output's harmonic k: what its copy k has in y_0.
    error : float
        Largest distance of an eigenvalue from the one that was asked for, rad/s.
    loss : float
        What replacing the others by their steady response leaves, as a share of the response of an
        output and its harmonics to an input: rms over frequencies up to ω/2 or the fastest mode
        wanted, of the worst pair.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: np.ndarray
    eigenvalues: np.ndarray
    reach: np.ndarray
    shown: np.ndarray
    error: float
    loss: float


def distance_from(F, omega, wanted, n_harmonics):
    """How far a harmonic decomposition is from having some eigenvalues.

    Parameters
    ----------
    F : ndarray, shape (2 K + 1, n, n)
        Real Fourier coefficients.
    omega : float
        rad/s.
    wanted : complex ndarray
    n_harmonics : int
        N, of the states.

    Returns
    -------
    error : float
        The largest distance of one, rad/s.
    """
    n = F.shape[1]
    A = toeplitz_matrix(F, n_harmonics, n_harmonics) - derivative_matrix(n_harmonics, n, omega)
    return _nearest(wanted, linalg.eigvals(A))[1]


def _nearest(wanted, found):
    """Which eigenvalues are nearest to those wanted, and the largest distance."""
    distance = np.abs(wanted[:, None] - found)
    rows, places = linear_sum_assignment(distance)
    return places, float(np.max(distance[rows, places], initial=0.0))


def split_modes(coefficients, omega, wanted, n_harmonics, n_outputs, n_copies):
    """Some modes of a harmonic decomposition without the others.

    Parameters
    ----------
    coefficients : sequence of ndarray
        Real Fourier coefficients of F, G, P and Q.
    omega : float
        rad/s.
    wanted : complex ndarray
        Their eigenvalues, closed under conjugation.
    n_harmonics : int
        N, of the states of the decomposition.
    n_outputs : int
        L, harmonics of y that the model has.
    n_copies : int
        K, copies of which reach and shown are told.

    Returns
    -------
    kept : ModesKept

    Raises
    ------
    ValueError
        If a mode wanted and another have the same eigenvalue.
    """
    F, G, P, Q = coefficients
    n, m, l = F.shape[1], G.shape[2], P.shape[1]  # noqa: E741 (the field's letter)
    K, L = max(n_copies, 0), max(n_copies, n_outputs)
    A, B, C, D = harmonic_decomposition(F, G, P, Q, omega, n_harmonics, K, L)
    found = linalg.eigvals(A)
    places, error = _nearest(wanted, found)
    means = np.eye(n, len(A))
    A, B, C = block_diagonal(A, B, np.vstack([C, means]), found[places], np.delete(found, places))
    k, out = len(wanted), (2 * n_outputs + 1) * l
    own = A[:k, :k], B[:k, :m], C[:-n, :k]
    rest = A[k:, k:], B[k:, :m], C[:-n, k:]
    change = -rest[2] @ linalg.solve(rest[0], rest[1])
    s = _frequencies(found, max(0.5 * omega, np.max(np.abs(wanted), initial=0.0)))
    left = frequency_response(*rest, -change, s)
    whole = left + frequency_response(*own, D[:, :m] + change, s)
    left, whole = (
        np.linalg.norm(values.reshape(-1, l, m), axis=0) for values in (left[:, :out], whole)
    )
    there = whole > DEPENDENT * np.max(whole, initial=0.0)
    loss = float(np.max(left[there] / whole[there], initial=0.0))
    own, steady = (own[0], own[1], own[2][:out]), (D[:, :m] + change)[:out]
    eigenvalues, from_left, from_right = linalg.eig(own[0], left=True)
    reach = _by_harmonic(from_left.conj().T @ B[:k], m, K, 1j)
    shown = _by_harmonic((C[:-n, :k] @ from_right).T, l, K, -1j)
    return ModesKept(*own, steady, C[-n:, :k], eigenvalues, reach, shown, error, loss)


def _frequencies(poles, highest):
    """An even grid and the resonances, up to some frequency, except for poles on the axis."""
    grid = highest * np.arange(1, N_FREQUENCIES + 1) / N_FREQUENCIES
    resonances = np.abs(poles.imag)
    s = 1j * np.unique(np.concatenate([grid, resonances[resonances <= highest]]))
    return s[np.min(np.abs(s[:, None] - poles), axis=1, initial=np.inf) > UNKNOWN * highest]


def _by_harmonic(effects, n_signals, n_copies, turn):
    """Sizes of the effects of complex harmonics −K to K from those of real ones, by signal."""
    effects = effects.reshape(len(effects), -1, n_signals)[:, : 2 * n_copies + 1]
    cosines, sines = effects[:, 1::2], effects[:, 2::2]
    up, down = cosines + turn * sines, cosines - turn * sines
    if turn == -1j:  # outputs: Y_k = (y_kc − j y_ks) / 2
        up, down = up / 2.0, down / 2.0
    whole = np.concatenate([down[:, ::-1], effects[:, :1], up], axis=1)
    return np.abs(np.swapaxes(whole, 1, 2))


def shares(sizes):
    """Size of each harmonic over the largest of its mode and signal, the best of the signals.

    Parameters
    ----------
    sizes : ndarray, shape (n_modes, n_signals, 2 K + 1)

    Returns
    -------
    shares : ndarray, shape (n_modes, 2 K + 1)
        From 0 to 1; a signal that no harmonic connects with a mode counts for nothing.
    """
    largest = np.max(sizes, axis=2, keepdims=True)
    signal = np.max(largest, axis=0, keepdims=True)
    there = largest > DEPENDENT * signal
    return np.max(np.where(there, sizes / np.where(there, largest, 1.0), 0.0), axis=1)
