"""Harmonic decomposition of linear time-periodic systems.

Written for the harmonics of x, u and y, a periodic system is time-invariant:

    Ẋ = A X + B U,   Y = C X + D U                                        (Eq. 8)

Its matrices are multiplications by Fourier series, of which this file has the coefficients
(jumps of the matrices included), the Toeplitz form, and the way back from it.
``LTPSystem``, trims and harmonic transfer functions need them.

The base modes of a periodic system, and which modes of its harmonic decomposition are copies.

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
from sklearn_hd.algorithms.lti.simulation import block_diagonal, frequency_response
from sklearn_hd.algorithms.periodic.floquet import (
    by_bisection,
    gauss_tableau,
    neighbours,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

N_FREQUENCIES = 16  # at which two responses are compared: some ten in a decade of frequency


def fourier_coefficients(matrix, n_harmonics, *, tolerance=1e-13):
    """Real Fourier coefficients of a periodic matrix, jumps included.

    M(ψ) = M_0 + Σ_k (M_kc cos kψ + M_ks sin kψ), with the integrals taken by
    Gauss quadrature on panels that are halved until nothing changes.

    ``matrix`` takes ψ of shape (n_points,) and gives (n_points, rows, columns).
    Coefficients have shape (2 n_harmonics + 1, rows, columns), in the order 0, 1c, 1s,
    2c, …. ``tolerance`` is the largest change of a panel's integrals on halving it,
    relative to the largest size of the entry.

    Examples
    --------
    A square wave has the sine coefficients 4 / (πk), k odd.

    >>> def square(psi):
    ...     return np.sign(np.sin(psi - 1.0) * np.ones((1, 1)) ).T[:, :, None]
    >>> c = fourier_coefficients(square, 1)
    >>> bool(np.isclose(np.hypot(c[1, 0, 0], c[2, 0, 0]), 4 / np.pi, rtol=0, atol=1e-12))
    True
    """
    K = int(n_harmonics)
    edges = np.linspace(0.0, 2.0 * np.pi, max(16, K) + 1)  # panels resolve cos Kψ

    def rule(left, right):
        return _panel_integrals(matrix, K, left, right)

    integrals = sum(
        by_bisection(rule, np.add, _integral_weights, left, right, tolerance).sum(axis=0)
        for left, right in neighbours(edges)
    )
    integrals[0] /= 2.0
    return integrals / np.pi


def toeplitz_matrix(coefficients, n_row_harmonics, n_column_harmonics):
    """Real block Toeplitz matrix: multiplication by M(ψ), written for harmonics.

    If y = M(ψ) x, then Y = T X, where X and Y hold the real coefficients in the
    order 0, 1c, 1s, …, each a block of all signals (Eq. 9). In complex
    coefficients the blocks are T_pq = M_{p−q}; the change to real ones uses
    s_kc = S_k + S_{−k} and s_ks = j (S_k − S_{−k}).

    ``coefficients`` of M have shape (2 K + 1, rows, columns). Row harmonics are those
    of y, and column harmonics are those of x. Harmonics of M up to their sum matter;
    those beyond K are zero.

    Examples
    --------
    cos ψ turns a constant into a first harmonic, and half of it comes back:

    >>> cosine = np.array([0.0, 1.0, 0.0])[:, None, None]
    >>> toeplitz_matrix(cosine, 1, 1).tolist()
    [[0.0, 0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    Ny, Nx = int(n_row_harmonics), int(n_column_harmonics)
    _, rows, columns = coefficients.shape
    spectrum = complex_spectrum(coefficients, Ny + Nx)
    shift = np.arange(-Ny, Ny + 1)[:, None] - np.arange(-Nx, Nx + 1)
    T = spectrum[shift + Ny + Nx]  # (2 Ny + 1, 2 Nx + 1, rows, columns)
    T = _real_parts(T, Ny, 1.0, 1j)
    T = np.swapaxes(_real_parts(np.swapaxes(T, 0, 1), Nx, 0.5, -0.5j), 0, 1)
    return T.real.transpose(0, 2, 1, 3).reshape((2 * Ny + 1) * rows, (2 * Nx + 1) * columns)


def toeplitz_coefficients(T, row_places, column_places):
    """Fourier coefficients of the multiplication that is nearest to a matrix.

    M* = arg min_M ‖T − T(M)‖, with T(M) between the harmonics that two signals have
    (:func:`toeplitz_matrix`), the Frobenius norm, and entries of M each on their own.

    T stands between one pair of signals; leading axes are further pairs with the same
    harmonics. ``row_places`` and ``column_places`` tell which coefficients each signal
    has, as places in the order 0, 1c, 1s, …. Returns (coefficients, nearest, unseen).
    Coefficients have shape (2 K + 1, ...); K is the sum of the highest harmonics of the
    two signals. The nearest matrix is T(M*). Harmonics that T does not determine are
    unseen: their coefficients are not unique.

    Examples
    --------
    >>> T = np.array([[0.0, 0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    >>> M, nearest, unseen = toeplitz_coefficients(T, range(3), range(3))
    >>> M.round(12).tolist(), bool(np.allclose(nearest, T)), unseen
    ([0.0, 1.0, 0.0, 0.0, 0.0], True, [])
    """
    rows, columns = list(row_places), list(column_places)
    Ny, Nx = (max(places, default=0) + 1 >> 1 for places in (rows, columns))
    K = Ny + Nx
    units = np.eye(2 * K + 1)[:, :, None, None]
    patterns = np.array([toeplitz_matrix(e, Ny, Nx)[np.ix_(rows, columns)] for e in units])
    patterns = patterns.reshape(len(patterns), -1).T
    flat = T.reshape(-1, patterns.shape[0]).T
    coefficients, _, rank, _ = linalg.lstsq(patterns, flat)
    unseen = []
    if rank < patterns.shape[1]:
        blind = linalg.null_space(patterns)
        places = np.flatnonzero(np.linalg.norm(blind, axis=1) > 1e-10)
        unseen = sorted({(int(place) + 1) // 2 for place in places})
    nearest = (patterns @ coefficients).T.reshape(T.shape)
    return coefficients.reshape(-1, *T.shape[:-2]), nearest, unseen


def harmonic_decomposition(F, G, P, Q, omega, n_states, n_inputs, n_outputs):
    """Time-invariant model (A, B, C, D) of the harmonics of a periodic system.

    A = T(F) − ω N, B = T(G), C = T(P), D = T(Q): T is :func:`toeplitz_matrix` and
    ω N the derivative of the harmonic functions, x_kc' ← −kω x_ks, x_ks' ← +kω x_kc.

    F, G, P and Q hold real Fourier coefficients, (2 K + 1, rows, columns).
    ``n_states``, ``n_inputs`` and ``n_outputs`` are the harmonics N, M, L kept of x, u
    and y: A has n (2N+1) rows, B has m (2M+1) columns, and C and D have l (2L+1) rows.

    References
    ----------
    Aerospace 2024, 11(11), 875, Eqs. 8 and 9; M. Lopez, J. V. R. Prasad, "Linear
    Time Invariant Approximations of Linear Time Periodic Systems", J. American
    Helicopter Society 62 (2017).

    Examples
    --------
    >>> F = np.array([[[-1.0]]])
    >>> A, B, C, D = harmonic_decomposition(F, F, F, F, 5.0, 1, 0, 0)
    >>> A.tolist()
    [[-1.0, 0.0, 0.0], [0.0, -1.0, -5.0], [0.0, 5.0, -1.0]]
    """
    A = toeplitz_matrix(F, n_states, n_states) - derivative_matrix(n_states, F.shape[1], omega)
    return (
        A,
        toeplitz_matrix(G, n_states, n_inputs),
        toeplitz_matrix(P, n_outputs, n_states),
        toeplitz_matrix(Q, n_outputs, n_inputs),
    )


def derivative_matrix(n_harmonics, n_signals, omega):
    """Time derivative of Σ (s_kc cos kψ + s_ks sin kψ) with s held, in coefficients.

    Examples
    --------
    >>> derivative_matrix(1, 1, 2.0).tolist()
    [[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, -2.0, 0.0]]
    """
    N = np.zeros((2 * n_harmonics + 1, 2 * n_harmonics + 1))
    for k in range(1, n_harmonics + 1):
        N[2 * k - 1, 2 * k], N[2 * k, 2 * k - 1] = k * omega, -k * omega
    return np.kron(N, np.eye(n_signals))


def harmonic_sizes(vectors):
    """|c_k| + |c_−k| of each harmonic from real-order coefficients (2N + 1, …)."""
    cosines, sines = vectors[1::2], vectors[2::2]
    pairs = 0.5 * (np.abs(cosines - 1j * sines) + np.abs(cosines + 1j * sines))
    return np.concatenate([np.abs(vectors[:1]), pairs])


# ---- Fourier integrals ---------------------------------------------------------------------


def _panel_integrals(matrix, n_harmonics, left, right):
    """∫ M(ψ) (1, cos ψ, sin ψ, …) dψ over each panel by Gauss quadrature."""
    c, _, b = gauss_tableau()
    width = right - left
    nodes = left[:, None] + width[:, None] * c
    values = matrix(nodes.ravel())
    functions = harmonic_functions(nodes, range(n_harmonics + 1)) * b[:, None]
    flat = values.reshape(len(left), len(c), -1) * width[:, None, None]
    integrals = functions.mT @ flat
    return integrals.reshape(len(left), -1, *values.shape[1:])


def _integral_weights(integrals):
    """Weights that make the largest integral of each entry one.

    Entries below a hundredth of the largest are resolved to one absolute error.
    """
    size = np.max(np.abs(integrals), axis=(0, 1))
    size = np.maximum(size, 0.01 * np.max(size, initial=0.0))
    return 1.0 / np.where(size > 0, size, 1.0)


# ---- real and complex harmonics -----------------------------------------------------------


def complex_spectrum(coefficients, n_harmonics):
    """Complex coefficients −K … K of real ones, cut or padded to K harmonics."""
    K = int(n_harmonics)
    kept = min(K, (len(coefficients) - 1) // 2)
    cosines, sines = coefficients[1 : 2 * kept : 2], coefficients[2 : 2 * kept + 1 : 2]
    spectrum = np.zeros((2 * K + 1, *coefficients.shape[1:]), dtype=complex)
    spectrum[K] = coefficients[0]
    spectrum[K + 1 : K + 1 + kept] = 0.5 * (cosines - 1j * sines)
    spectrum[K - kept : K] = 0.5 * (cosines + 1j * sines)[::-1]
    return spectrum


def _real_parts(T, n_harmonics, cosine, sine):
    """Parts S_{−N} … S_N of the first axis turned into those of s_0, s_1c, s_1s, …."""
    parts = np.empty_like(T)
    positive, negative = T[n_harmonics + 1 :], T[:n_harmonics][::-1]
    parts[0] = T[n_harmonics]
    parts[1::2], parts[2::2] = cosine * (positive + negative), sine * (positive - negative)
    return parts


def base_families(mean, exponents, omega):
    """The base eigenvalue of each family of modes, closed under conjugation.

    ``mean`` is F_0, and ``exponents`` have imaginary parts in (−ω/2, ω/2]. A real
    exponent has one base eigenvalue, and a conjugate pair has two. A negative
    multiplier, of the exponent σ + jω/2, has two as well, though it is one mode: a
    time-invariant model cannot have one without the other.

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
    """Some modes of a harmonic decomposition, split off from the others."""

    # A to D: from u_0 to the harmonics of y kept; D has the steady response of all other modes
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: np.ndarray  # (n, n_kept): harmonic 0 of the states by those of A
    eigenvalues: np.ndarray  # complex, (n_kept,): of A
    # (n_kept, m, 2 K + 1): size of the effect of each input's harmonic −k (complex) on each mode, k
    # from −K to K: what u_0 has on its copy k
    reach: np.ndarray
    # (n_kept, l, 2 K + 1): size of each mode in each output's harmonic k: what its copy k has in
    # y_0
    shown: np.ndarray
    error: float  # largest distance of an eigenvalue from the one that was asked for, rad/s
    # what replacing the others by their steady response leaves, as a share of the response of an
    # output and its harmonics to an input: rms over frequencies up to ω/2 or the fastest mode
    # wanted, of the worst pair
    loss: float


def nearest_eigenvalues(wanted, found):
    """Which eigenvalues are nearest to those wanted, and the largest distance."""
    distance = np.abs(wanted[:, None] - found)
    rows, places = linear_sum_assignment(distance)
    return places, float(np.max(distance[rows, places], initial=0.0))


def split_modes(coefficients, omega, wanted, n_harmonics, n_outputs, n_copies):
    """Some modes of a harmonic decomposition without the others, as ModesKept.

    ``coefficients`` are the real Fourier coefficients of F, G, P and Q. ``wanted`` has
    the eigenvalues of the modes, closed under conjugation. The decomposition has
    N = ``n_harmonics`` harmonics of the states, and the model L = ``n_outputs``
    harmonics of y. Reach and shown are told of K = ``n_copies`` copies. It raises
    ValueError if a mode wanted and another have the same eigenvalue.
    """
    F, G, P, Q = coefficients
    n, m, l = F.shape[1], G.shape[2], P.shape[1]  # noqa: E741 (the field's letter)
    K, L = max(n_copies, 0), max(n_copies, n_outputs)
    A, B, C, D = harmonic_decomposition(F, G, P, Q, omega, n_harmonics, K, L)
    found = linalg.eigvals(A)
    places, error = nearest_eigenvalues(wanted, found)
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
    return np.abs(whole.mT)


def shares(sizes):
    """Size of each harmonic over the largest of its mode and signal, the best of the signals.

    ``sizes`` has shape (n_modes, n_signals, 2 K + 1). Shares, (n_modes, 2 K + 1), go
    from 0 to 1; a signal that no harmonic connects with a mode counts for nothing.
    """
    largest = np.max(sizes, axis=2, keepdims=True)
    signal = np.max(largest, axis=0, keepdims=True)
    there = largest > DEPENDENT * signal
    return np.max(np.where(there, sizes / np.where(there, largest, 1.0), 0.0), axis=1)
