"""Floquet analysis and harmonic decomposition of linear time-periodic systems.

    ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt                  (Eq. 6)

Over an interval in which u is held, x moves to Φ x + Γ u; over one period Φ is
the monodromy matrix, whose eigenvalues e^{λT} give the Floquet exponents λ.
Written for the harmonics of x, u and y, the same system is time-invariant:

    Ẋ = A X + B U,   Y = C X + D U                                        (Eq. 8)

Matrices of the periodic system are callables of ψ: an array of shape
``(n_points,)`` in, an array of shape ``(n_points, rows, columns)`` out. They may
jump (sgn of a speed that reverses): whatever is integrated here is integrated by
bisection, which closes in on a jump until nothing is lost.
"""

from functools import lru_cache

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.fourier import harmonic_functions
from sklearn_hd.algorithms.simulation import propagate

__all__ = [
    "fourier_coefficients",
    "harmonic_decomposition",
    "monodromy_exponents",
    "monodromy_matrix",
    "on_branch",
    "participation_factors",
    "propagate_periodic",
    "state_units",
    "toeplitz_matrix",
    "transition_matrices",
]

N_STAGES = 7  # collocation of order 14, quadrature exact up to degree 13
MAX_BISECTIONS = 50  # 2⁻⁵⁰ of a period: closer to a jump than rounding tells
MAX_ROUGH = 4096  # intervals open at one time; a few jumps and kinks never come near
BLOCK = 256  # intervals integrated together; bounds the memory
SMALL = 1e-2  # entries below this part of the largest are resolved to the same absolute error
COUPLED = 1e-10  # product of two states' couplings, beside the largest, that is not rounding


def transition_matrices(F, G, psi, omega, *, tolerance=1e-14):
    """Transition matrices and input integrals of some intervals of azimuth.

    With u held over interval k,

        x(ψ_{k+1}) = Φ_k x(ψ_k) + Γ_k u_k,   dX/dt = F X,  Φ_k = X(ψ_{k+1}) X(ψ_k)⁻¹

    Each interval is integrated by Gauss collocation and halved until its two
    halves agree with the whole.

    Parameters
    ----------
    F : callable
        ψ of shape (n_points,) -> (n_points, n, n), in 1/s.
    G : callable or None
        ψ of shape (n_points,) -> (n_points, n, m); None if there is no input.
    psi : array_like, shape (n_intervals + 1,)
        Ends of the intervals in radians, increasing.
    omega : float
        Fundamental frequency, rad/s.
    tolerance : float, default=1e-14
        Largest difference of an interval and its halves, relative to Φ (with the
        states in units that balance F) and to the largest Γ of the input.

    Returns
    -------
    Phi : ndarray, shape (n_intervals, n, n)
    Gamma : ndarray, shape (n_intervals, n, m)

    References
    ----------
    E. Hairer, S. P. Nørsett, G. Wanner, *Solving Ordinary Differential Equations
    I*, 1993, section II.7 (Gauss collocation).

    Examples
    --------
    >>> def F(psi):
    ...     return -np.cos(psi)[:, None, None]
    >>> Phi, Gamma = transition_matrices(F, None, [0.0, 0.5 * np.pi], 1.0)
    >>> bool(np.isclose(Phi[0, 0, 0], np.exp(-1.0), rtol=1e-14))
    True
    """
    psi = np.asarray(psi, dtype=float)
    units = state_units(F)

    def rule(left, right):
        return _collocation_step(F, G, left, right, omega, units)

    steps = np.concatenate(
        [
            _bisected(rule, _compose, _transition_weights, left, right, tolerance)
            for left, right in _blocks(psi)
        ]
    )
    n = len(units)
    steps *= units[:, None]
    return steps[:, :, :n] / units, steps[:, :, n:]


def monodromy_matrix(F, omega, *, start=0.0, tolerance=1e-14):
    """Transition matrix over one period, from azimuth ``start`` (radians)."""
    psi = start + np.linspace(0.0, 2.0 * np.pi, 33)
    Phi, _ = transition_matrices(F, None, psi, omega, tolerance=tolerance)
    return _product(Phi)


def monodromy_exponents(monodromy, omega):
    """Floquet exponents λ = log(μ) / T of a monodromy matrix with eigenvalues μ.

    Multipliers more than some ten decades below the largest are lost in the matrix
    already; :mod:`~sklearn_hd.algorithms.floquet_exponents` keeps them.

    Known only up to multiples of jω; the branch with imaginary part in
    (−ω/2, ω/2] is returned, sorted from the rightmost leftwards, conjugate pairs
    with the negative imaginary part first.

    Parameters
    ----------
    monodromy : ndarray, shape (n, n)
    omega : float
        Fundamental frequency, rad/s.

    Returns
    -------
    exponents : complex ndarray, shape (n,)

    Examples
    --------
    >>> monodromy_exponents(np.diag([np.exp(-2.0), 1.0]), 2 * np.pi).real.tolist()
    [0.0, -2.0]
    """
    multipliers = linalg.eigvals(monodromy).astype(complex)
    return on_branch(np.log(multipliers) * omega / (2.0 * np.pi), omega)


def on_branch(exponents, omega):
    """Exponents with imaginary part in [−ω/2, ω/2], its lower edge moved to the upper, sorted."""
    exponents = np.array(exponents, dtype=complex)
    edge = exponents.imag <= -0.5 * omega * (1.0 - 1e-12)
    exponents[edge] += 1j * omega
    return exponents[np.lexsort((exponents.imag, -exponents.real))]


def propagate_periodic(Phi, forcing, x0):
    """States of x[k+1] = Φ[k mod p] x[k] + v[k] from x[0] = x0.

    Each period's response to its own forcing, from rest, takes p steps for all
    periods at once; the states at the period boundaries follow from the
    time-invariant recursion of the monodromy matrix.

    Parameters
    ----------
    Phi : ndarray, shape (p, n, n)
        Transition matrices of one period; p ≥ n_samples - 1 if nothing repeats.
    forcing : ndarray, shape (..., n_samples, n)
        v[k]; the last row is not used.
    x0 : ndarray, shape (..., n)

    Returns
    -------
    states : ndarray, shape (..., n_samples, n)

    Examples
    --------
    >>> Phi = np.array([[[0.5]], [[2.0]]])
    >>> propagate_periodic(Phi, np.ones((5, 1)), np.zeros(1)).ravel().tolist()
    [0.0, 1.0, 3.0, 2.5, 6.0]
    """
    *batch, n_samples, n = forcing.shape
    p = len(Phi)
    n_periods = -(-n_samples // p)
    padding = [(0, 0)] * len(batch) + [(0, n_periods * p - n_samples), (0, 0)]
    v = np.pad(forcing, padding).reshape(*batch, n_periods, p, n)
    starts = np.broadcast_to(x0, (*batch, n))[..., None, :]
    if n_periods > 1:
        starts = propagate(_product(Phi), _from_rest(Phi, v), starts[..., 0, :])
    states, x = np.empty_like(v), starts
    for k in range(p):
        states[..., k, :] = x
        x = x @ Phi[k].T + v[..., k, :]
    return states.reshape(*batch, n_periods * p, n)[..., :n_samples, :]


def fourier_coefficients(matrix, n_harmonics, *, tolerance=1e-13):
    """Real Fourier coefficients of a periodic matrix, jumps included.

    M(ψ) = M_0 + Σ_k (M_kc cos kψ + M_ks sin kψ), with the integrals taken by
    Gauss quadrature on panels that are halved until nothing changes.

    Parameters
    ----------
    matrix : callable
        ψ of shape (n_points,) -> (n_points, rows, columns).
    n_harmonics : int
    tolerance : float, default=1e-13
        Largest change of a panel's integrals on halving it, relative to the
        largest size of the entry.

    Returns
    -------
    coefficients : ndarray, shape (2 n_harmonics + 1, rows, columns)
        In the order 0, 1c, 1s, 2c, ….

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
        _bisected(rule, np.add, _integral_weights, left, right, tolerance).sum(axis=0)
        for left, right in _blocks(edges)
    )
    integrals[0] /= 2.0
    return integrals / np.pi


def toeplitz_matrix(coefficients, n_row_harmonics, n_column_harmonics):
    """Real block Toeplitz matrix: multiplication by M(ψ), written for harmonics.

    If y = M(ψ) x, then Y = T X, where X and Y hold the real coefficients in the
    order 0, 1c, 1s, …, each a block of all signals (Eq. 9). In complex
    coefficients the blocks are T_pq = M_{p−q}; the change to real ones uses
    s_kc = S_k + S_{−k} and s_ks = j (S_k − S_{−k}).

    Parameters
    ----------
    coefficients : ndarray, shape (2 K + 1, rows, columns)
        Real Fourier coefficients of M. Harmonics up to
        n_row_harmonics + n_column_harmonics matter; those beyond K are zero.
    n_row_harmonics, n_column_harmonics : int
        Harmonics N of y and of x.

    Returns
    -------
    T : ndarray, shape ((2 N_y + 1) rows, (2 N_x + 1) columns)

    Examples
    --------
    cos ψ turns a constant into a first harmonic, and half of it comes back:

    >>> cosine = np.array([0.0, 1.0, 0.0])[:, None, None]
    >>> toeplitz_matrix(cosine, 1, 1).tolist()
    [[0.0, 0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    """
    Ny, Nx = int(n_row_harmonics), int(n_column_harmonics)
    _, rows, columns = coefficients.shape
    spectrum = _complex_spectrum(coefficients, Ny + Nx)
    shift = np.arange(-Ny, Ny + 1)[:, None] - np.arange(-Nx, Nx + 1)
    T = spectrum[shift + Ny + Nx]  # (2 Ny + 1, 2 Nx + 1, rows, columns)
    T = _real_rows(T, Ny)
    T = np.swapaxes(_real_columns(np.swapaxes(T, 0, 1), Nx), 0, 1)
    return T.real.transpose(0, 2, 1, 3).reshape((2 * Ny + 1) * rows, (2 * Nx + 1) * columns)


def harmonic_decomposition(F, G, P, Q, omega, n_states, n_inputs, n_outputs):
    """Time-invariant model (A, B, C, D) of the harmonics of a periodic system.

    A = T(F) − ω N, B = T(G), C = T(P), D = T(Q): T is :func:`toeplitz_matrix` and
    ω N the derivative of the harmonic functions, x_kc' ← −kω x_ks, x_ks' ← +kω x_kc.

    Parameters
    ----------
    F, G, P, Q : ndarray, shapes (2 K + 1, rows, columns)
        Real Fourier coefficients.
    omega : float
        Fundamental frequency, rad/s.
    n_states, n_inputs, n_outputs : int
        Harmonics N, M, L kept of x, u and y.

    Returns
    -------
    A, B, C, D : ndarray
        Shapes (n (2N+1), n (2N+1)), (n (2N+1), m (2M+1)), (l (2L+1), n (2N+1)) and
        (l (2L+1), m (2M+1)).

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


def participation_factors(A):
    """Participation of each state in each mode of ẋ = A x.

    p_ij = |v_ij w_ji| / Σ_i |v_ij w_ji|, with right eigenvectors v and left
    eigenvectors w; each mode's factors sum to one, and none depends on the units
    of the states.

    Parameters
    ----------
    A : ndarray, shape (n, n)

    Returns
    -------
    eigenvalues : complex ndarray, shape (n,)
        From the rightmost leftwards.
    eigenvectors : complex ndarray, shape (n, n)
        One column a mode, of unit length.
    factors : ndarray, shape (n, n)
        States by modes.

    Raises
    ------
    numpy.linalg.LinAlgError
        If A has no full set of eigenvectors.

    References
    ----------
    I. J. Pérez-Arriaga, G. C. Verghese, F. C. Schweppe, "Selective Modal
    Analysis", IEEE Trans. PAS-101 (1982).

    Examples
    --------
    >>> eigenvalues, _, factors = participation_factors(np.diag([-2.0, -1.0]))
    >>> eigenvalues.real.tolist(), factors.tolist()
    ([-1.0, -2.0], [[0.0, 1.0], [1.0, 0.0]])
    """
    eigenvalues, V = linalg.eig(A)
    order = np.lexsort((eigenvalues.imag, -eigenvalues.real))
    eigenvalues, V = eigenvalues[order], V[:, order]
    products = np.abs(V * np.linalg.inv(V).T)
    return eigenvalues, V, products / products.sum(axis=0)


# ---- integration by bisection -------------------------------------------------------------


def _blocks(edges):
    """Left and right ends of neighbouring intervals, some hundred at a time."""
    for k in range(0, len(edges) - 1, BLOCK):
        block = edges[k : k + BLOCK + 1]
        yield block[:-1], block[1:]


def _bisected(rule, compose, weights, left, right, tolerance):
    """What ``rule`` gives for each interval, the intervals halved until it settles.

    ``rule(left, right)`` returns one array per interval, ``compose(second, first)``
    joins those of two neighbours, ``weights(whole)`` scales their differences.
    """
    whole = rule(left, right)
    if not np.all(np.isfinite(whole)):
        raise ValueError("the matrices hold NaN or infinity at some azimuths; make them finite")
    weight = weights(whole)

    def settle(left, right, whole, depth):
        middle = 0.5 * (left + right)
        first, second = rule(left, middle), rule(middle, right)
        halves = compose(second, first)
        axes = tuple(range(1, halves.ndim))
        error = np.max(np.abs(halves - whole) * weight, axis=axes, initial=0.0)
        size = np.max(np.abs(halves) * weight, axis=axes, initial=1.0)
        rough = np.flatnonzero(~(error <= tolerance * size))
        if rough.size > MAX_ROUGH:
            raise ValueError(
                f"{rough.size} intervals of a period are still not resolved to {tolerance:g}; the "
                f"matrices must be smooth in psi but for a few jumps, free of noise"
            )
        if rough.size and depth:
            ends = np.concatenate([left[rough], middle[rough], right[rough]])
            wholes = np.concatenate([first[rough], second[rough]])
            k = rough.size
            fine = settle(ends[: 2 * k], ends[k:], wholes, depth - 1)
            halves[rough] = compose(fine[k:], fine[:k])
        return halves

    return settle(left, right, whole, MAX_BISECTIONS)


def _collocation_step(F, G, left, right, omega, units):
    """[Φ, Γ] of each interval by one step of Gauss collocation, states in given units.

    Stages K_i = F_i (x + h Σ_j a_ij K_j) + G_i u; step h Σ_i b_i K_i.
    """
    c, a, b = gauss_tableau(N_STAGES)
    width = right - left
    nodes = (left[:, None] + width[:, None] * c).ravel()
    Fs = F(nodes)
    n = Fs.shape[-1]
    Gs = np.empty((len(nodes), n, 0)) if G is None else G(nodes)
    Fs, Gs = (M.reshape(len(left), len(c), n, -1) for M in (Fs, Gs))
    Fs, Gs = Fs * (units / units[:, None]), Gs / units[:, None]
    h = width[:, None, None] / omega
    coupling = Fs[:, :, :, None, :] * a[None, :, None, :, None]
    size = len(c) * n
    system = np.eye(size) - h * coupling.reshape(-1, size, size)
    slopes = np.concatenate([Fs, Gs], axis=-1)
    stages = np.linalg.solve(system, slopes.reshape(len(left), size, -1)).reshape(slopes.shape)
    step = h * np.einsum("s,ksij->kij", b, stages)
    step[:, :, :n] += np.eye(n)
    return step


def _compose(second, first):
    """[Φ, Γ] of two neighbouring intervals in one, u held over both."""
    Phi = second[:, :, : second.shape[1]]
    joined = Phi @ first
    joined[:, :, second.shape[1] :] += second[:, :, second.shape[1] :]
    return joined


def _transition_weights(steps):
    """Weights that make the largest Γ of each input one."""
    n = steps.shape[1]
    weight = np.ones(steps.shape[1:])
    reach = np.max(np.abs(steps[:, :, n:]), axis=(0, 1))
    weight[:, n:] = 1.0 / np.where(reach > 0, reach, 1.0)
    return weight


def state_units(F):
    """Powers of two, shape (n,), in which the states' couplings are of the same size."""
    size = np.mean(np.abs(F(2.0 * np.pi * np.arange(16) / 16)), axis=0)
    pairs = size * size.T  # free of units
    size[~(pairs > COUPLED * np.max(pairs, initial=0.0))] = 0.0
    _, (units, _) = linalg.matrix_balance(size, permute=False, separate=True)
    return units


def _panel_integrals(matrix, n_harmonics, left, right):
    """∫ M(ψ) (1, cos ψ, sin ψ, …) dψ over each panel by Gauss quadrature."""
    c, _, b = gauss_tableau(N_STAGES)
    width = right - left
    nodes = left[:, None] + width[:, None] * c
    values = matrix(nodes.ravel())
    functions = harmonic_functions(nodes, range(n_harmonics + 1)) * b[:, None]
    flat = values.reshape(len(left), len(c), -1) * width[:, None, None]
    integrals = np.swapaxes(functions, 1, 2) @ flat
    return integrals.reshape(len(left), -1, *values.shape[1:])


def _integral_weights(integrals):
    """Weights that make the largest integral of each entry one, or less if it is small."""
    size = np.max(np.abs(integrals), axis=(0, 1))
    size = np.maximum(size, SMALL * np.max(size, initial=0.0))
    return 1.0 / np.where(size > 0, size, 1.0)


@lru_cache(maxsize=4)
def gauss_tableau(n_stages):
    """Nodes c, matrix a and weights b of Gauss collocation on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(n_stages)
    legendre = np.polynomial.legendre
    values = legendre.legvander(x, n_stages - 1)
    integrals = np.stack(
        [legendre.legval(x, legendre.legint(row, lbnd=-1.0)) for row in np.eye(n_stages)],
        axis=1,
    )  # ∫ of each Legendre polynomial from −1 to each node
    return 0.5 * (x + 1.0), 0.5 * integrals @ np.linalg.inv(values), 0.5 * w


# ---- periodic recursion -------------------------------------------------------------------


def _product(Phi):
    """Φ[p−1] … Φ[1] Φ[0]."""
    product = np.eye(Phi.shape[1])
    for factor in Phi:
        product = factor @ product
    return product


def _from_rest(Phi, v):
    """State at the end of each period, from rest at its start."""
    x = np.zeros(v[..., 0, :].shape)
    for k, factor in enumerate(Phi):
        x = x @ factor.T + v[..., k, :]
    return x


# ---- real and complex harmonics -----------------------------------------------------------


def _complex_spectrum(coefficients, n_harmonics):
    """Complex coefficients −K … K of real ones, cut or padded to K harmonics."""
    K = int(n_harmonics)
    kept = min(K, (len(coefficients) - 1) // 2)
    cosines, sines = coefficients[1 : 2 * kept : 2], coefficients[2 : 2 * kept + 1 : 2]
    spectrum = np.zeros((2 * K + 1, *coefficients.shape[1:]), dtype=complex)
    spectrum[K] = coefficients[0]
    spectrum[K + 1 : K + 1 + kept] = 0.5 * (cosines - 1j * sines)
    spectrum[K - kept : K] = 0.5 * (cosines + 1j * sines)[::-1]
    return spectrum


def _real_rows(T, n_harmonics):
    """Rows S_{−N} … S_N turned into s_0, s_1c, s_1s, …."""
    rows = np.empty_like(T)
    positive, negative = T[n_harmonics + 1 :], T[:n_harmonics][::-1]
    rows[0] = T[n_harmonics]
    rows[1::2], rows[2::2] = positive + negative, 1j * (positive - negative)
    return rows


def _real_columns(T, n_harmonics):
    """Columns that multiply S_{−N} … S_N turned into those of s_0, s_1c, s_1s, …."""
    columns = np.empty_like(T)
    positive, negative = T[n_harmonics + 1 :], T[:n_harmonics][::-1]
    columns[0] = T[n_harmonics]
    columns[1::2] = 0.5 * (positive + negative)
    columns[2::2] = -0.5j * (positive - negative)
    return columns
