"""Periodic mode shapes of a free decay, and the state matrix behind them.

While the inputs rest, a linear time-periodic system with Floquet exponents λ_i answers

    y(t) = Σ_i p_i(ψ) e^{λ_i t} = P(ψ) e^{Rt} q,   R real, of eigenvalues λ_i,

so with R known, P at each phase of the period is a linear least-squares fit to the
raw samples of that phase. Where the outputs determine the state, x = y,

    F(ψ) = (P′(ψ) + P(ψ) R) P(ψ)⁻¹,   P′ = dP/dt,

is the state matrix, whichever of the exponents λ_i + jpω were taken: the shapes
take up the difference.
"""

import numpy as np
from scipy import linalg
from scipy.optimize import least_squares

from sklearn_hd.algorithms.periodic.harmonic_decomposition import derivative_matrix, toeplitz_matrix

MAX_GROWTH = 50.0  # e-folds over a decay, far below overflow

__all__ = [
    "harmonic_state_matrix",
    "mode_shapes",
    "real_block",
    "refine_exponents",
    "shape_condition",
    "state_matrix_samples",
    "strongest_free_decay",
]


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


def strongest_free_decay(inputs, outputs, phases, samples_per_period, rest_share):
    """Outputs over the whole periods in which the inputs have come to rest.

    Parameters
    ----------
    inputs, outputs : list of ndarray, shapes (n_samples_s, m) and (n_samples_s, l)
        One array a segment; outputs in like units.
    phases : list of ndarray of int, shapes (n_samples_s,)
        Sample within the period.
    samples_per_period : int
    rest_share : float
        Share of an input's largest value below which it counts as at rest.

    Returns
    -------
    decay : ndarray, shape (n_periods * samples_per_period, l), or None
        Of the segment whose decay holds the most signal, from ψ = 0; None if
        no input ever moves and comes to rest.
    """
    spp, best, energy = samples_per_period, None, 0.0
    for u, y, phase in zip(inputs, outputs, phases, strict=True):
        moving = np.abs(u) > rest_share * np.max(np.abs(u), axis=0, initial=0.0)
        if not moving.any():
            continue
        last = np.flatnonzero(moving.any(axis=1))[-1]
        start = last + spp - phase[last]  # the period after the last motion
        decay = y[start : start + max(0, len(y) - start) // spp * spp]
        found = float(np.sum(decay**2))
        if found > energy:
            best, energy = decay, found
    return best


def refine_exponents(decay, exponents, samples_per_period):
    """Exponents that explain a free decay best, whatever its mode shapes.

    From one period to the next every sample of the period decays alike, so that
    with M holding shapes and amplitudes

        y[k-th period] = (e^{R_T k} 1)ᵀ M,    R_T of eigenvalues λ_i T,

    and M is eliminated by projection (Golub and Pereyra, 1973).

    Parameters
    ----------
    decay : ndarray, shape (n_periods * samples_per_period, l)
        Outputs in like units, so that each counts alike.
    exponents : complex ndarray
        λT to start from: real ones, and one member of each pair.
    samples_per_period : int

    Returns
    -------
    exponents : complex ndarray
        λT; an exponent stays real, or one of a pair, as it was.
    residual : float
        Sum of squares left.
    """
    periods = decay.reshape(len(decay) // samples_per_period, -1)
    # the periods hold as many directions as there are of them: the rest is eliminated at once
    compact = linalg.qr(periods.T, mode="r")[0][: len(periods)].T
    paired = np.asarray(exponents).imag != 0.0
    start = np.concatenate([np.real(exponents), np.imag(exponents)[paired]])

    def unpack(parameters):
        values = parameters[: len(paired)].astype(complex)
        values[paired] += 1j * parameters[len(paired) :]
        return values

    def left(parameters):
        values = unpack(parameters)
        if not np.max(values.real) * len(periods) < MAX_GROWTH:
            return compact.ravel()  # grows beyond all bounds: explains nothing
        step = linalg.expm(real_block(values))
        states = np.empty((len(periods), len(step)))
        states[0] = 1.0
        for k in range(1, len(periods)):
            states[k] = step @ states[k - 1]
        basis = linalg.qr(states, mode="economic")[0]
        return (compact - basis @ (basis.T @ compact)).ravel()

    found = least_squares(left, start, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    return unpack(found.x), 2.0 * float(found.cost)


def shape_condition(P):
    """Largest condition number of P(ψ), its rows and columns scaled over the period.

    Parameters
    ----------
    P : ndarray, shape (n_phases, n, n)

    Returns
    -------
    condition : float
        Infinite where an output or a mode is not there at all.
    """
    scaled = P / np.max(np.abs(P)) if P.any() else P
    for _ in range(20):
        rows = np.linalg.norm(scaled, axis=(0, 2))[:, None]
        if not rows.all():
            return np.inf
        scaled = scaled / rows
        columns = np.linalg.norm(scaled, axis=(0, 1))
        if not columns.all():
            return np.inf
        scaled = scaled / columns
    return float(np.max(np.linalg.cond(scaled)))


def mode_shapes(outputs, R, sample_time, samples_per_period):
    """Mode shapes P(ψ) of a free decay, phase by phase.

    Parameters
    ----------
    outputs : ndarray, shape (n_periods * samples_per_period, n_outputs)
        Free decay over whole periods; its first sample is at ψ = 0.
    R : ndarray, shape (n, n)
        Real, with the Floquet exponents as eigenvalues, 1/s.
    sample_time : float
        Seconds.
    samples_per_period : int

    Returns
    -------
    P : ndarray, shape (samples_per_period, n_outputs, n)
        At ψ = 0, 2π/samples_per_period, …; columns carry the amplitudes.
    """
    n, spp = len(R), samples_per_period
    n_periods = len(outputs) // spp
    decays = np.array([linalg.expm(R * (k * spp * sample_time)) for k in range(n_periods)])
    coordinates = decays @ np.ones(n)  # of one free decay that moves in every mode
    by_phase = outputs.reshape(n_periods, spp, -1)
    shapes = np.empty((spp, outputs.shape[1], n))
    for j in range(spp):
        regressors = coordinates @ linalg.expm(R * (j * sample_time)).T
        shapes[j] = linalg.lstsq(regressors, by_phase[:, j])[0].T
    return shapes


def state_matrix_samples(P, R, omega):
    """F(ψ) = (P′ + P R) P⁻¹ at the phases of the shapes.

    P′ is taken by the Fourier series of P, exact for band-limited shapes.

    Parameters
    ----------
    P : ndarray, shape (n_phases, n, n)
    R : ndarray, shape (n, n)
    omega : float
        Fundamental frequency, rad/s.

    Returns
    -------
    F : ndarray, shape (n_phases, n, n)

    Raises
    ------
    numpy.linalg.LinAlgError
        If P is singular at a phase.
    """
    n_phases = len(P)
    k = np.fft.fftfreq(n_phases, 1.0 / n_phases)
    if n_phases % 2 == 0:
        k[n_phases // 2] = 0.0  # the derivative of the Nyquist cosine is unseen
    spectrum = np.fft.fft(P, axis=0)
    derivative = np.fft.ifft(1j * omega * k[:, None, None] * spectrum, axis=0).real
    scale = np.linalg.norm(P, axis=(0, 2))[:, None]  # outputs in like units
    inverse = np.linalg.inv(P / scale) / scale.T
    return (derivative + P @ R) @ inverse


def harmonic_state_matrix(F, n_harmonics, omega):
    """State matrix of the harmonic decomposition of ẋ = F(ψ) x (Eq. 8).

    Parameters
    ----------
    F : ndarray, shape (n_phases, n, n)
        At equally spaced phases, from ψ = 0.
    n_harmonics : int
        Harmonics N kept of the states.
    omega : float

    Returns
    -------
    A : ndarray, shape (n (2 N + 1), n (2 N + 1))
        States in the order x_0, x_1c, x_1s, … (Eq. 9).
    """
    n_phases = len(F)
    spectrum = np.fft.fft(F, axis=0) / n_phases
    highest = min(2 * n_harmonics, (n_phases - 1) // 2)
    coefficients = [spectrum[0].real]
    for k in range(1, highest + 1):
        coefficients += [2.0 * spectrum[k].real, -2.0 * spectrum[k].imag]
    T = toeplitz_matrix(np.array(coefficients), n_harmonics, n_harmonics)
    return T - derivative_matrix(n_harmonics, F.shape[1], omega)
