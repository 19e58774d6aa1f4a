"""Shooting: the periodic solution of ẋ = f(x, u, t) as a state that returns.

    x(T; x₀, u) − x₀ = 0,   (1/T) ∫₀ᵀ x_i dt = target_i

Newton's method on the initial state and the free inputs, with the derivative taken
by differences of integrated orbits. It needs no Fourier series, so it checks
harmonic balance and removes what truncation leaves.
"""

import numpy as np

from sklearn_hd.algorithms.periodic.integration import integrate
from sklearn_hd.exceptions import TrimError

__all__ = ["solve_shooting"]

N_INTERVALS = 64  # restarts in a period


def solve_shooting(
    f, period, x0, inputs, *, free=(), targets=(), tolerance=1e-10, max_iterations=20
):
    """Initial state (and free inputs) of a periodic solution, by Newton's method.

    Parameters
    ----------
    f : callable
        f(x, u, t) -> dx/dt, x of shape (n,), u of shape (m,), t in seconds.
    period : float
        T in seconds.
    x0 : ndarray, shape (n,)
        Guess of the state at t = 0.
    inputs : ndarray, shape (m,)
        Inputs; the guess of the free ones.
    free : sequence of int
        Inputs to be found.
    targets : sequence of (int, float)
        State and its mean, as many as there are free inputs.
    tolerance : float, default=1e-10
        Largest defect accepted, relative to the largest size of each state. The
        iteration goes on until rounding stops it, usually near 1e-13.
    max_iterations : int, default=20

    Returns
    -------
    x0 : ndarray, shape (n,)
    inputs : ndarray, shape (m,)
    defect : float
        Largest relative defect reached.

    Raises
    ------
    TrimError
        If the defect does not fall to the tolerance, or an orbit diverges within a period.

    Examples
    --------
    >>> def f(x, u, t):
    ...     return -x + np.cos(t)
    >>> x0, _, _ = solve_shooting(f, 2 * np.pi, np.zeros(1), np.zeros(0))
    >>> bool(np.allclose(x0, 0.5, rtol=1e-11))
    True
    """
    n, free = len(x0), list(free)
    z = np.concatenate([x0, np.asarray(inputs, dtype=float)[free]])

    def inputs_of(z):
        u = np.array(inputs, dtype=float)
        u[free] = z[n:]
        return u

    def defect(z):
        return _relative_defect(f, period, z[:n], inputs_of(z), targets)

    best, size, previous = z, np.inf, np.inf
    for _ in range(max_iterations):
        residual = defect(z)
        newest = float(np.max(np.abs(residual), initial=0.0))
        if newest < size:
            best, size = z, newest
        if newest > 0.5 * previous or newest == 0.0:
            break
        previous = newest
        z = z - np.linalg.lstsq(_difference_matrix(defect, z, residual), residual)[0]
    if not size <= tolerance:
        raise TrimError(
            f"shooting reached a relative defect of {size:.3g} after one period (tolerance "
            f"{tolerance:.3g}); give a guess nearer to the periodic solution, such as a "
            f"harmonic-balance trim with more harmonics"
        )
    return best[:n], inputs_of(best), size


def _relative_defect(f, period, x0, u, targets):
    """Defect after one period, with the misses of the targets, in parts of each state's size."""
    n, states = len(x0), [state for state, _ in targets]

    def with_means(x, held, t):
        rates = np.asarray(f(x[:n], held, t))
        return np.concatenate([rates, x[states] / period])

    t = np.linspace(0.0, period, N_INTERVALS + 1)
    start = np.concatenate([x0, np.zeros(len(states))])
    held = np.broadcast_to(u, (len(t), len(u)))
    try:
        x = integrate(with_means, start, held, t, rtol=1e-13, atol=1e-14)
    except RuntimeError as error:
        raise TrimError(f"shooting met an orbit that does not last a period: {error}") from error
    size = np.max(np.abs(x[:, :n]), axis=0)
    size = np.where(size > 0, size, 1.0)
    misses = x[-1, n:] - [mean for _, mean in targets]
    return np.concatenate([(x[-1, :n] - x0) / size, misses / size[states]])


def _difference_matrix(defect, z, residual):
    """Derivative of the defect by forward differences."""
    steps = 1e-7 * np.where(z != 0.0, np.abs(z), 1.0)
    columns = [(defect(z + step) - residual) / np.max(step) for step in np.diag(steps)]
    return np.stack(columns, axis=1)
