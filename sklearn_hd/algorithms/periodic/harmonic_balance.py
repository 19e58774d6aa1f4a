"""Harmonic balance: the periodic solution of ẋ = f(x, u, t) as a Fourier series.

With x(ψ) = x_0 + Σ_{k ≤ N} (x_kc cos kψ + x_ks sin kψ) and constant u, the
Galerkin equations ask that the residual ẋ − f has no harmonic up to N:

    R(X, u) = N_ω X − 𝓕{f(x(ψ), u, ψ/ω)} = 0,   N_ω X the harmonics of ẋ

Newton's matrix is ∂R/∂X = N_ω − T(F), minus the harmonic-decomposition matrix of
the linearisation about the iterate. Free inputs are determined by as many targets,
each the mean of a state. ``PeriodicSystem.trim`` needs it.
"""

import numpy as np

from sklearn_hd.algorithms.periodic.harmonic_decomposition import derivative_matrix, toeplitz_matrix
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics
from sklearn_hd.exceptions import TrimError

BLOCK = 1024  # azimuths at a time: bounds the memory


def solve_harmonic_balance(
    f,
    jacobian,
    omega,
    coefficients,
    inputs,
    *,
    free=(),
    targets=(),
    n_points=None,
    tolerance=1e-12,
    max_iterations=50,
):
    """Periodic solution of ẋ = f(x, u, t) by Newton's method on the Galerkin equations.

    Parameters
    ----------
    f : callable
        f(x, u, t), vectorised: x (n, k), u (m, k), t (k,) -> (n, k).
    jacobian : callable
        (x, u, t) -> (F, G, …), F of shape (k, n, n) and G of shape (k, n, m).
    coefficients : ndarray, shape (2 N + 1, n)
        Guess of the states' coefficients, in the order 0, 1c, 1s, …; its length
        sets the number of harmonics.
    inputs : ndarray, shape (m,)
        Inputs; the guess of the free ones.
    free : sequence of int
        Inputs to be found.
    targets : sequence of (int, float)
        State and its mean, as many as there are free inputs.
    n_points : int, optional
        Points a period of the Galerkin integrals, by default 4096 or 128 a
        harmonic, whichever is more: where f has kinks, the error of the integrals
        falls only with the square of their number.
    tolerance : float, default=1e-12
        Residual at which to stop, relative to the size of each state's rate.

    Returns
    -------
    coefficients : ndarray, shape (2 N + 1, n)
    inputs : ndarray, shape (m,)
    residual : float
        Largest relative Galerkin residual reached.

    Raises
    ------
    TrimError
        If Newton's method does not get there.
    ValueError
        If n_points is too few for the harmonics, or f is not vectorised.

    References
    ----------
    M. Urabe, "Galerkin's Procedure for Nonlinear Periodic Systems", Archive for
    Rational Mechanics and Analysis 20 (1965).

    Examples
    --------
    ẋ = −x + cos t has the solution (cos t + sin t) / 2.

    >>> def f(x, u, t):
    ...     return -x + np.cos(t)
    >>> def jacobian(x, u, t):
    ...     return -np.ones((len(t), 1, 1)), np.zeros((len(t), 1, 0))
    >>> X, _, _ = solve_harmonic_balance(f, jacobian, 1.0, np.zeros((3, 1)), np.zeros(0))
    >>> bool(np.allclose(X[:, 0], [0.0, 0.5, 0.5]))
    True
    """
    X, u = np.array(coefficients, dtype=float), np.array(inputs, dtype=float)
    free, targets = list(free), list(targets)
    n_points = _check_points(n_points, (len(X) - 1) // 2)
    residual, scale = _residual(f, omega, X, u, targets, n_points)
    history = [_size(residual, scale)]
    while history[-1] > tolerance:
        if len(history) > max_iterations:
            raise _failure(history, tolerance, f"after {max_iterations} iterations")
        matrix = _newton_matrix(jacobian, omega, X, u, free, targets, n_points)
        step = _newton_step(matrix, residual, scale)
        for halving in range(13):  # to 2e-4 of a step
            X_new, u_new = _moved(X, u, free, step * 0.5**halving)
            residual, scale = _residual(f, omega, X_new, u_new, targets, n_points)
            if _size(residual, scale) < history[-1]:
                break
        else:
            raise _failure(history, tolerance, "where no step lowers it any more")
        X, u = X_new, u_new
        history.append(_size(residual, scale))
    return X, u, history[-1]


def evaluate_harmonics(coefficients, psi):
    """Periodic signals of real coefficients at any azimuths, (*psi.shape, *coefficients.shape[1:]).

    e^{j(n+k)ψ} = e^{jnψ} e^{jkψ}: one exponential at each azimuth, for they take time.
    Coefficients stand along the first axis, in the order 0, 1c, 1s, ….

    Examples
    --------
    >>> evaluate_harmonics(np.array([1.0, 0.5, 0.0]), [0.0, np.pi]).tolist()
    [1.5, 0.5]
    """
    psi = np.asarray(psi, dtype=float)
    flat, n = coefficients.reshape(len(coefficients), -1), len(coefficients) // 2
    values = np.empty((psi.size, flat.shape[1]))
    for start in range(0, psi.size, BLOCK):
        some = psi.ravel()[start : start + BLOCK]
        waves, done = np.empty((len(some), n), dtype=complex), min(n, 1)
        waves[:, :done] = np.exp(1j * some)[:, None]
        while done < n:
            more = min(done, n - done)
            waves[:, done : done + more] = waves[:, :more] * waves[:, done - 1 : done]
            done += more
        np.matmul(waves.view(float), flat[1:], out=values[start : start + BLOCK])
    values += flat[0]
    return values.reshape(*psi.shape, *coefficients.shape[1:])


def product(left, right):
    """Fourier coefficients of the product of two periodic matrices."""
    H = len(left) // 2 + len(right) // 2
    psi = 2.0 * np.pi * np.arange(2 * H + 1) / (2 * H + 1)
    return sampled_harmonics(evaluate_harmonics(left, psi) @ evaluate_harmonics(right, psi), H)


def resize_harmonics(coefficients, n_harmonics):
    """Coefficients (2 K + 1, n) cut or padded with zeros to n_harmonics."""
    resized = np.zeros((2 * n_harmonics + 1, *np.shape(coefficients)[1:]))
    kept = min(len(resized), len(coefficients))
    resized[:kept] = coefficients[:kept]
    return resized


def trimmed_harmonics(coefficients, least=0.0):
    """Fourier coefficients (2 H + 1, a, b) without the harmonics above the highest that counts.

    One counts if an entry of it is more than ``least`` times the largest of that entry.
    """
    sizes = np.abs(coefficients)
    moving = np.flatnonzero(np.any(sizes > least * np.max(sizes, axis=0), axis=(1, 2)))
    highest = (moving[-1] + 1) // 2 if len(moving) else 0
    return coefficients[: 2 * highest + 1]


def sample_harmonics(coefficients, n_points):
    """Signals (n, n_points) of given real coefficients (2 N + 1, n) at equal steps of a period."""
    cosines, sines = coefficients[1::2], coefficients[2::2]
    spectrum = np.zeros((n_points // 2 + 1, coefficients.shape[1]), dtype=complex)
    spectrum[0] = coefficients[0]
    spectrum[1 : len(cosines) + 1] = 0.5 * (cosines - 1j * sines)
    return n_points * np.fft.irfft(spectrum, n_points, axis=0).T


def _check_points(n_points, n_harmonics):
    if n_points is None:
        return max(4096, 128 * n_harmonics)
    if n_points <= 4 * n_harmonics:
        raise ValueError(
            f"n_points={n_points} cannot separate the {2 * n_harmonics} harmonics of the "
            f"linearisation; give more than {4 * n_harmonics}"
        )
    return int(n_points)


def _orbit(omega, X, u, n_points):
    """x, u and t along the iterate, for the vectorised f."""
    t = 2.0 * np.pi / omega * np.arange(n_points) / n_points
    return sample_harmonics(X, n_points), np.broadcast_to(u[:, None], (len(u), n_points)), t


def _residual(f, omega, X, u, targets, n_points):
    """Galerkin residual with the targets below it, and the size of each row."""
    x, u, t = _orbit(omega, X, u, n_points)
    with np.errstate(over="ignore", invalid="ignore"):  # a step too long is refused anyway
        rates = np.asarray(f(x, u, t))
    if rates.shape != x.shape:
        raise ValueError(
            f"f returned an array of shape {rates.shape} for states of shape {x.shape}; it must "
            f"take many points at once, x (n, k), u (m, k), t (k,), and return the shape of x"
        )
    N = (len(X) - 1) // 2
    derivative = derivative_matrix(N, 1, omega) @ X
    balance = derivative - sampled_harmonics(rates.T, N)
    amplitude = np.max(np.abs(x), axis=1, initial=0.0)
    row = np.max(np.abs(rates), axis=1, initial=0.0) + omega * amplitude
    misses = [X[0, state] - mean for state, mean in targets]
    sizes = [max(amplitude[state], abs(mean)) for state, mean in targets]
    scale = np.concatenate([np.tile(row, len(X)), sizes])
    return np.concatenate([balance.ravel(), misses]), np.where(scale > 0, scale, 1.0)


def _newton_matrix(jacobian, omega, X, u, free, targets, n_points):
    """Derivative of the residual by the coefficients and the free inputs."""
    F, G = jacobian(*_orbit(omega, X, u, n_points))[:2]
    N, n = (len(X) - 1) // 2, X.shape[1]
    matrix = np.zeros((X.size + len(targets), X.size + len(free)))
    matrix[: X.size, : X.size] = derivative_matrix(N, n, omega) - toeplitz_matrix(
        sampled_harmonics(F, 2 * N), N, N
    )
    matrix[: X.size, X.size :] = -sampled_harmonics(G[:, :, free], N).reshape(X.size, -1)
    for row, (state, _) in enumerate(targets):
        matrix[X.size + row, state] = 1.0
    return matrix


def _newton_step(matrix, residual, scale):
    """Newton's correction, from rows scaled to the same size; the shortest if singular."""
    rows, rest = matrix / scale[:, None], residual / scale
    try:
        return -np.linalg.solve(rows, rest)
    except np.linalg.LinAlgError:
        return -np.linalg.lstsq(rows, rest)[0]


def _moved(X, u, free, step):
    """Iterate after a step."""
    moved = u.copy()
    moved[free] += step[X.size :]
    return X + step[: X.size].reshape(X.shape), moved


def _size(residual, scale):
    size = np.max(np.abs(residual) / scale, initial=0.0)
    return float(size) if np.isfinite(size) else np.inf


def _failure(history, tolerance, where):
    return TrimError(
        f"harmonic balance reached a relative residual of {history[-1]:.3g} {where} (tolerance "
        f"{tolerance:.3g}); give a guess closer to the periodic solution, start with fewer "
        f"harmonics and pass that trim as the guess, or raise n_points if f has kinks"
    )
