"""Integration of ẋ = f(x, u, t) with inputs held from sample to sample, and shooting with it.

Simulation of nonlinear systems needs the integration, their trim the shooting: the periodic
solution as a state that returns,

    x(T; x₀, u) − x₀ = 0,   (1/T) ∫₀ᵀ x_i dt = target_i

by Newton's method on the initial state and the free inputs, with the derivative taken by
differences of integrated orbits. It needs no Fourier series, so it checks harmonic balance and
removes what truncation leaves.
"""

import warnings

import numpy as np
from scipy.integrate import ode

from sklearn_hd.exceptions import TrimError

CLOSED = 1e-10  # of each state's largest size, that an orbit may miss its start by


def integrate(f, x0, u, t, *, rtol=1e-12, atol=1e-13, first_step=None):
    """States of ẋ = f(x, u, t) at the sample times, u held between them.

    Dormand and Prince's method of order 8 with error control, restarted at every
    sample: no step crosses a jump of u, and no interpolation enters the states.

    ``f(x, u, t)`` takes x (n,), u (m,) and seconds. ``x0`` is the state at ``t[0]``,
    and ``u[k]`` acts from ``t[k]`` to ``t[k + 1]``. ``rtol`` and ``atol`` are the
    errors allowed for each step. ``first_step``, in seconds, is the longest first step
    tried in an interval; by default it is the shortest interval. The error control
    shortens it where needed. A RuntimeError says where it cannot continue.

    References
    ----------
    E. Hairer, S. P. Nørsett, G. Wanner, *Solving Ordinary Differential Equations
    I*, 1993, code DOP853.

    Examples
    --------
    >>> x = integrate(lambda x, u, t: u - x, [0.0], np.ones((3, 1)), [0.0, 1.0, 2.0])
    >>> bool(np.allclose(x[:, 0], 1 - np.exp([0.0, -1.0, -2.0]), rtol=1e-12))
    True
    """
    t = np.asarray(t, dtype=float)
    u = np.asarray(u, dtype=float)
    states = np.empty((len(t), len(x0)))
    states[0] = x0
    longest = np.inf if first_step is None else float(first_step)
    solver = ode(lambda time, x, held: f(x, held, time)).set_integrator(
        "dop853",
        rtol=rtol,
        atol=atol,
        nsteps=100_000,
        first_step=min(np.min(np.diff(t), initial=np.inf), longest),
    )
    for k in range(len(t) - 1):
        solver.set_initial_value(states[k], t[k]).set_f_params(u[k])
        states[k + 1] = _advance(solver, t[k + 1])
    return states


def _advance(solver, end):
    """State at ``end``; the solver's own warning becomes an error that names the time."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        state = solver.integrate(end)
    if not solver.successful() or not np.all(np.isfinite(state)):
        raise RuntimeError(
            f"integration stopped between t = {solver.t:.6g} s and {end:.6g} s, at the state "
            f"{np.array2string(np.asarray(state), precision=4)}: the solution diverges, f is not "
            f"finite there, or rtol is below rounding; check f, the inputs and the initial state, "
            f"or raise rtol"
        )
    return state


def runge_kutta(f, x, u, t, width, n_steps):
    """States after some steps of fixed width, of many systems at once.

    Runge's and Kutta's classical method of order 4, u held. ``f(x, u, t)`` takes x
    (n, k), u (m, k) and t (k,). All systems start at the same ``t``, and the states are
    those at t + n_steps · width.

    References
    ----------
    E. Hairer, S. P. Nørsett, G. Wanner, *Solving Ordinary Differential Equations
    I*, 1993, section II.1.

    Examples
    --------
    >>> x = runge_kutta(lambda x, u, t: u - x, np.zeros((1, 1)), np.ones((1, 1)), 0.0, 0.01, 100)
    >>> bool(np.isclose(x[0, 0], 1 - np.exp(-1.0), rtol=1e-10))
    True
    """
    times = np.full(np.shape(x)[1], float(t))
    half = 0.5 * width
    for k in range(n_steps):
        now = times + k * width
        a = f(x, u, now)
        b = f(x + half * a, u, now + half)
        c = f(x + half * b, u, now + half)
        d = f(x + width * c, u, now + width)
        x = x + width / 6.0 * (a + 2.0 * (b + c) + d)
    return x


def solve_shooting(f, period, x0, inputs, *, free=(), targets=()):
    """Initial state (and free inputs) of a periodic solution, by Newton's method.

    It takes twenty steps at most, and goes on until rounding stops it, usually near 1e-13.

    ``f(x, u, t)`` takes x (n,), u (m,) and seconds. ``x0`` is a guess of the state at
    t = 0. ``inputs`` holds all inputs, with a guess of the ``free`` ones. These are
    found with as many ``targets``: pairs of a state and its mean. Returns
    (x0, inputs, defect), where the defect is the largest one reached, relative to the
    largest size of each state. It raises TrimError if the defect does not fall to
    1e-10, or an orbit diverges within a period.

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
    for _ in range(20):
        residual = defect(z)
        newest = float(np.max(np.abs(residual), initial=0.0))
        if newest < size:
            best, size = z, newest
        if newest > 0.5 * previous or newest == 0.0:
            break
        previous = newest
        z = z - np.linalg.lstsq(_difference_matrix(defect, z, residual), residual)[0]
    if not size <= CLOSED:
        raise TrimError(
            f"shooting reached a relative defect of {size:.3g} after one period (tolerance "
            f"{CLOSED:.3g}); give a guess closer to the periodic solution, such as a "
            f"harmonic-balance trim with more harmonics"
        )
    return best[:n], inputs_of(best), size


def _relative_defect(f, period, x0, u, targets):
    """Defect after one period, with the misses of the targets, in parts of each state's size."""
    n, states = len(x0), [state for state, _ in targets]

    def with_means(x, held, t):
        rates = np.asarray(f(x[:n], held, t))
        return np.concatenate([rates, x[states] / period])

    t = np.linspace(0.0, period, 65)  # restarts on the way
    start = np.concatenate([x0, np.zeros(len(states))])
    held = np.broadcast_to(u, (len(t), len(u)))
    try:
        x = integrate(with_means, start, held, t, rtol=1e-13, atol=1e-14)
    except RuntimeError as error:
        raise TrimError(f"shooting met an orbit shorter than one period: {error}") from error
    size = np.max(np.abs(x[:, :n]), axis=0)
    size = np.where(size > 0, size, 1.0)
    misses = x[-1, n:] - [mean for _, mean in targets]
    return np.concatenate([(x[-1, :n] - x0) / size, misses / size[states]])


def _difference_matrix(defect, z, residual):
    """Derivative of the defect by forward differences."""
    steps = 1e-7 * np.where(z != 0.0, np.abs(z), 1.0)
    columns = [(defect(z + step) - residual) / np.max(step) for step in np.diag(steps)]
    return np.stack(columns, axis=1)
