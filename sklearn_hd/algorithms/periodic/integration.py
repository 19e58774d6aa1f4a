"""Integration of ẋ = f(x, u, t) with inputs held from sample to sample."""

import warnings

import numpy as np
from scipy.integrate import ode

__all__ = ["integrate", "runge_kutta"]

MAX_STEPS = 100_000  # within one sample interval


def integrate(f, x0, u, t, *, rtol=1e-12, atol=1e-13, first_step=None):
    """States of ẋ = f(x, u, t) at the sample times, u held between them.

    Dormand and Prince's method of order 8 with error control, restarted at every
    sample: no step crosses a jump of u, and no interpolation enters the states.

    Parameters
    ----------
    f : callable
        f(x, u, t) -> dx/dt, with x of shape (n,), u of shape (m,), t in seconds.
    x0 : array_like, shape (n,)
        State at ``t[0]``.
    u : array_like, shape (n_samples, m)
        ``u[k]`` acts from ``t[k]`` to ``t[k + 1]``.
    t : array_like, shape (n_samples,)
        Increasing times in seconds.
    rtol, atol : float
        Relative and absolute error allowed for each step.
    first_step : float, optional
        Longest first step tried in an interval, in seconds; by default the whole
        interval. The error control shortens it where needed.

    Returns
    -------
    states : ndarray, shape (n_samples, n)

    Raises
    ------
    RuntimeError
        If the error control cannot continue; the message says where.

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
        nsteps=MAX_STEPS,
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

    Runge's and Kutta's classical method of order 4, u held.

    Parameters
    ----------
    f : callable
        f(x, u, t) -> dx/dt, with x of shape (n, k), u of shape (m, k), t of shape (k,).
    x : ndarray, shape (n, k)
        States at t.
    u : ndarray, shape (m, k)
        Inputs.
    t : float
        Seconds.
    width : float
        Of one step, in seconds.
    n_steps : int
        Steps taken.

    Returns
    -------
    x : ndarray, shape (n, k)
        States at t + n_steps · width.

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
