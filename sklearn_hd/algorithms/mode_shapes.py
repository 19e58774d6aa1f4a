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

from sklearn_hd.algorithms.floquet import derivative_matrix, toeplitz_matrix

__all__ = [
    "harmonic_state_matrix",
    "mode_shapes",
    "real_block",
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
    rows = np.linalg.norm(P, axis=(0, 2))[:, None]
    columns = np.linalg.norm(P / np.where(rows > 0, rows, 1.0), axis=(0, 1))
    if not (rows.all() and columns.all()):
        return np.inf
    return float(np.max(np.linalg.cond(P / rows / columns)))


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
