"""Harmonic transfer functions: the frequency response of a linear time-periodic system.

An input u e^{jΩt} comes out at the frequencies Ω + nω, once the transients are gone:

    y(t) = Σ_n H_n(jΩ) u e^{j(Ω + nω)t}

With T(·) multiplication by a periodic matrix in complex harmonics, T_pq = M_{p−q},
and N = diag(jkω), the column q = 0 of

    T(P) (jΩ I + N − T(F))⁻¹ T(G) + T(Q)

holds all H_n(jΩ); that of q holds H_{p−q}(j(Ω + qω)), the same at other frequencies.

``sklearn_hd.systems`` makes :class:`HarmonicTransferFunction` of them.
"""

import numpy as np
import slycot
from scipy import signal

from sklearn_hd.algorithms.linalg.rounding import RANK
from sklearn_hd.algorithms.linalg.triangular import column_sizes
from sklearn_hd.algorithms.periodic.harmonic_decomposition import (
    complex_spectrum,
    harmonic_decomposition,
)


def harmonic_transfer(coefficients, omega, frequencies, n_harmonics, tolerance, max_harmonics):
    """H_n(jΩ) of a system given by Fourier coefficients.

    The states keep K ≥ N harmonics; K is doubled until nothing changes by more than the
    tolerance.

    Parameters
    ----------
    coefficients : callable
        k -> (F, G, P, Q), real Fourier coefficients up to harmonic k, each of shape
        (2 k + 1, rows, columns).
    n_harmonics : int
        N, harmonics of the outputs.
    tolerance : float
        Largest change on doubling K, relative to the largest entry.
    max_harmonics : int
        Bound on K.

    Returns
    -------
    response : complex ndarray, shape (n_frequencies, 2 N + 1, l, m)
        H_n(jΩ), n from −N to N.
    change : float
        Relative change at the last doubling.

    Raises
    ------
    ValueError
        If jΩ is an eigenvalue: a response that never settles.

    References
    ----------
    N. M. Wereley, S. R. Hall, "Frequency response of linear time periodic systems",
    29th IEEE Conference on Decision and Control (1990).

    Examples
    --------
    >>> def low_pass(k):  # ẋ = −x + u, y = cos ψ x
    ...     F, G, P, Q = np.zeros((4, 2 * k + 1, 1, 1))
    ...     F[0], G[0], P[1] = -1.0, 1.0, 1.0
    ...     return F, G, P, Q
    >>> H, _ = harmonic_transfer(low_pass, 5.0, [2.0], 1, 1e-8, 128)
    >>> bool(np.isclose(H[0, 2, 0, 0], 0.5 / (1.0 + 2.0j)))
    True
    """
    N = int(n_harmonics)
    K = min(N + 8, max(N, max_harmonics // 2))
    response = _truncated_response(coefficients, omega, frequencies, N, K)
    change = np.inf
    while change > tolerance and max_harmonics > K:
        K = min(2 * K, max_harmonics)
        coarse = response
        response = _truncated_response(coefficients, omega, frequencies, N, K)
        size = np.max(np.abs(response), initial=0.0)
        change = np.max(np.abs(response - coarse), initial=0.0) / (size if size > 0 else 1.0)
    return response, float(change)


def held_harmonic_transfer(Phi, Gamma, P, Q, frequencies, dt, n_harmonics):
    """H_n(jΩ) from sample to sample, for inputs held between samples.

        x[k+1] = Φ[k] x[k] + Γ[k] u[k],   y[k] = P[k] x[k] + Q[k] u[k],   u[k] = e^{jΩkΔt}

    The steady state x[k] = X[k] e^{jΩkΔt}, X of period S, is found exactly. Φ, Γ, P and
    Q are those of the S samples of one period that begins at ψ = 0, (S, rows, columns).
    ``n_harmonics`` is N, at most (S − 1) / 2. The result has shape
    (n_frequencies, 2 N + 1, l, m), n from −N to N.

    Examples
    --------
    >>> one = np.ones((2, 1, 1))
    >>> H = held_harmonic_transfer(0.5 * one, one, one, 0 * one, [0.0], 1.0, 0)
    >>> H.ravel().tolist()
    [(2+0j)]
    """
    S, n, m = Gamma.shape
    turn = np.exp(-1j * np.asarray(frequencies, dtype=float) * dt)[:, None, None]
    A, B = np.eye(n, dtype=complex), np.zeros((len(turn), n, m), dtype=complex)
    for k in range(S):
        A, B = turn * (Phi[k] @ A), turn * (Phi[k] @ B + Gamma[k])
    X = np.linalg.solve(np.eye(n) - A, B)
    values = np.zeros((len(turn), 2 * n_harmonics + 1, P.shape[1], m), dtype=complex)
    n_range = np.arange(-n_harmonics, n_harmonics + 1)
    for k in range(S):
        y = P[k] @ X + Q[k]
        values += np.exp(-2j * np.pi * n_range * k / S)[:, None, None] * y[:, None] / S
        X = turn * (Phi[k] @ X + Gamma[k])
    return values


def estimate_harmonic_transfer(
    inputs, outputs, times, omega, n_harmonics, n_segment, *, window="hann", overlap=0.5
):
    """H_n(jΩ) of measured records, by least squares over overlapping segments.

    At each output frequency the transforms of the windowed segments obey

        Y(Ω + nω) = Σ_q H_q(j(Ω + (n − q)ω)) U(Ω + (n − q)ω) + E,   |q| ≤ N

    U(Ω + sω) being the transform of u e^{−jsωt}. The coefficient of U(Ω) is H_n(jΩ).

    ``inputs``, ``outputs`` and ``times`` have one array a record. Times are evenly
    spaced, and ψ = ωt. A segment has ``n_segment`` samples, and the next one repeats
    the share ``overlap`` of it. ``window`` is as for :func:`scipy.signal.get_window`.

    Returns
    -------
    frequencies : ndarray, shape (n_frequencies,)
        Ω in rad/s, from 0 to where Ω + Nω reaches half the sampling frequency.
    values : complex ndarray, shape (n_frequencies, 2 N + 1, l, m)
        NaN where the inputs do not excite Ω by itself.
    std : ndarray, same shape
        √E|Ĥ − H|²; real and imaginary part have 1/√2 of it each.
    coherence : ndarray, shape (n_frequencies, 2 N + 1, l)
        Share of each output's power at Ω + nω that all inputs account for.
    n_averages : float
        Independent segments that the overlapping ones are worth.

    References
    ----------
    A. Siddiqi, *Identification of the Harmonic Transfer Functions of a Helicopter
    Rotor*, M.S. thesis, MIT, 2001; J. S. Bendat, A. G. Piersol, *Random Data*, 4th
    ed., 2010, chapters 7 and 9 (multiple-input spectra and their errors).
    """
    dt = float(np.mean(np.diff(times[0])))
    weights, step = segment_plan(n_segment, window, overlap)
    all_frequencies = 2.0 * np.pi * np.arange(n_segment // 2 + 1) / (n_segment * dt)
    top = np.pi / dt - n_harmonics * omega
    frequencies = all_frequencies[all_frequencies < top * (1.0 - 1e-9)]
    m, l = inputs[0].shape[1], outputs[0].shape[1]  # noqa: E741 (the field's letter)
    unit = column_sizes(np.vstack(inputs))  # or a strong input hides one in larger units
    spectra, n_averages, count = 0.0, 0.0, 0
    for u, y, t in zip(inputs, outputs, times, strict=True):
        scaled, starts = u / unit, np.arange(0, len(t) - n_segment + 1, step)
        for some in np.split(starts, range(64, len(starts), 64)):  # bounds the memory
            rows = some[:, None] + np.arange(n_segment)
            Z = _shifted_transforms(
                scaled[rows], y[rows], t[rows], omega, n_harmonics, weights, len(frequencies)
            )
            spectra = spectra + np.einsum("kfi,kfj->fij", np.conj(Z), Z, optimize=True)
        n_averages += effective_averages(weights, step, len(starts))
        count += len(starts)
    values, std, coherence = _regress(spectra / count, n_averages, n_harmonics, m, l)
    return frequencies, values / unit, std / unit, coherence, n_averages


def segment_plan(n_segment, window, overlap):
    """Window weights, shape (n_segment,), and samples from one segment to the next."""
    return signal.get_window(window, n_segment), max(1, round(n_segment * (1.0 - overlap)))


def effective_averages(weights, step, n_segments):
    """Independent segments that overlapping, windowed ones are worth.

        n / (1 + 2 Σ_d (1 − d/n) ρ_d²),   ρ_d = Σ_i w_i w_{i + d step} / Σ_i w_i²

    References
    ----------
    P. D. Welch, "The use of fast Fourier transform for the estimation of power
    spectra", IEEE Trans. Audio Electroacoustics 15 (1967).

    Examples
    --------
    >>> effective_averages(np.ones(8), 8, 5)
    5.0
    """
    if n_segments == 0:
        return 0.0
    power, spread = np.sum(weights**2), 1.0
    for d in range(1, min(n_segments, -(-len(weights) // step))):
        rho = np.sum(weights[d * step :] * weights[: len(weights) - d * step]) / power
        spread += 2.0 * (1.0 - d / n_segments) * rho**2
    return n_segments / spread


def _truncated_response(coefficients, omega, frequencies, N, K):
    """H_n(jΩ) from the harmonic decomposition with K harmonics of the states."""
    A, B, C, D = harmonic_decomposition(*coefficients(2 * K), omega, K, 0, N)
    found = _hessenberg_responses(A, B, C, frequencies) + D
    found = found.reshape(len(found), 2 * N + 1, len(D) // (2 * N + 1), D.shape[1])
    return np.swapaxes(complex_spectrum(np.swapaxes(found, 0, 1), N), 0, 1)


def _hessenberg_responses(A, B, C, frequencies):
    """C (jΩ I − A)⁻¹ B, A brought to Hessenberg form once."""
    (n, m), p = B.shape, len(C)
    values = np.empty((len(frequencies), p, m), dtype=complex)
    job = "NG"
    for k, frequency in enumerate(frequencies):
        try:
            found = slycot.tb05ad(n, m, p, 1j * float(frequency), A, B, C, job)
        except slycot.exceptions.SlycotArithmeticError:
            raise ValueError(
                f"the response at {frequency:.6g} rad/s is unbounded: a Floquet exponent lies at "
                f"that frequency on the imaginary axis; leave it out or add damping"
            ) from None
        if job == "NG":
            A, B, C, values[k] = found[:4]
            job = "NH"
        else:
            values[k] = found[0]
    return values


def _shifted_transforms(u, y, t, omega, N, weights, n_frequencies):
    """Transforms of u e^{−jsωt}, |s| ≤ 2N, then of y e^{−jnωt}, |n| ≤ N, of some segments."""
    columns = []
    for values, highest in ((u, 2 * N), (y, N)):
        for s in range(-highest, highest + 1):
            carrier = weights * np.exp(-1j * s * omega * t)
            transform = np.fft.fft(values * carrier[..., None], axis=1)
            columns.append(transform[:, :n_frequencies])
    return np.concatenate(columns, axis=2)


def _regress(spectra, n_averages, N, m, l):  # noqa: E741 (the field's letter)
    """Values, standard deviations and coherence from the spectra of the shifted signals."""
    n_inputs = (4 * N + 1) * m
    values = np.empty((len(spectra), 2 * N + 1, l, m), dtype=complex)
    std, coherence = np.empty(values.shape), np.empty(values.shape[:3])
    for n in range(-N, N + 1):
        x = np.arange(n_inputs).reshape(-1, m)[n + N : n + 3 * N + 1].ravel()
        y = n_inputs + (n + N) * l + np.arange(l)
        S_xx, S_xy = spectra[:, x[:, None], x], spectra[:, x[:, None], y]
        S_yy = np.real(spectra[:, y, y])
        inverse, known = _inverse(S_xx)
        H = inverse @ S_xy
        explained = np.real(np.sum(np.conj(S_xy) * H, axis=1))
        coherence[:, n + N] = np.clip(explained / np.where(S_yy > 0, S_yy, 1.0), 0.0, 1.0)
        noise = np.maximum(S_yy - explained, 0.0) / (n_averages - len(x))
        own = (N - n) * m + np.arange(m)  # shift s = 0
        variance = np.real(np.einsum("fii->fi", inverse))[:, own]
        spread = np.sqrt(noise[:, :, None] * variance[:, None, :])
        good = known[:, None, own]
        values[:, n + N] = np.where(good, H[:, own].mT, np.nan)
        std[:, n + N] = np.where(good, spread, np.nan)
    return values, std, coherence


def _inverse(S):
    """Pseudo-inverse of Hermitian matrices, and which unknowns they determine."""
    size = np.sqrt(np.real(np.einsum("fii->fi", S)))
    scale = np.where(size > np.sqrt(RANK) * np.max(size, initial=0.0), size, np.inf)
    scaled = S / scale[:, :, None] / scale[:, None, :]
    inverse = np.linalg.pinv(scaled, rcond=RANK, hermitian=True)
    resolved = np.real(np.einsum("fij,fji->fi", inverse, scaled))
    return inverse / scale[:, :, None] / scale[:, None, :], resolved > 1.0 - 1e-6
