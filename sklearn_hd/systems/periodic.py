"""Nonlinear time-periodic systems (Eq. 1): trim, linearisation along it, simulation."""

import inspect
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._checks import (
    check_choice,
    check_count,
    check_flag,
    check_numbers,
    check_positive,
    real_array,
)
from sklearn_hd.algorithms.linalg.rounding import HALF
from sklearn_hd.algorithms.periodic.harmonic_balance import (
    evaluate_harmonics,
    resize_harmonics,
    solve_harmonic_balance,
)
from sklearn_hd.algorithms.periodic.integration import integrate, solve_shooting
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics, times_near_zero_phase
from sklearn_hd.systems.arguments import (
    NamedSignals,
    check_inputs,
    check_names,
    check_state,
    check_times,
)
from sklearn_hd.systems.ltp import LTPSystem

STEPS_PER_PERIOD = 64  # longest first step of the integrator
ANOTHER = 0.01  # of its terms, from which on f is not the same


@dataclass(frozen=True, eq=False)
class Trim:
    """Periodic solution x*(t) = x*(t + T) of a system under constant inputs.

    Made by :meth:`PeriodicSystem.trim`; each parameter is an attribute.

    Parameters
    ----------
    omega : float
        Fundamental frequency, rad/s.
    coefficients : ndarray, shape (2 N + 1, n)
        Fourier coefficients of the states in the order 0, 1c, 1s, ….
    inputs : ndarray, shape (m,)
        Constant values u*.
    initial_state : ndarray, shape (n,)
        State at ψ = 0, from the Fourier series (harmonic balance) or on the exact orbit
        (shooting).
    residual : float
        Relative residual at which the solver stopped.
    method : str
        ``"harmonic_balance"`` or ``"shooting"``.
    state_names, input_names : tuple of str
        Those of the system.

    References
    ----------
    Urabe (1965), Galerkin's procedure for nonlinear periodic systems, Archive for
    Rational Mechanics and Analysis 20.

    Examples
    --------
    >>> from sklearn_hd.systems import duffing
    >>> trim = duffing().trim(5)
    >>> trim.n_harmonics, trim.state_names
    (5, ('x', 'x_dot'))
    >>> trim.states([0.0, np.pi]).shape
    (2, 2)
    """

    omega: float
    coefficients: np.ndarray = field(repr=False)
    inputs: np.ndarray
    initial_state: np.ndarray
    residual: float
    method: str
    state_names: tuple
    input_names: tuple

    def __post_init__(self):
        for name in ("coefficients", "inputs", "initial_state"):
            values = np.array(getattr(self, name), dtype=float)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def n_harmonics(self):
        """Highest harmonic N of the states."""
        return (len(self.coefficients) - 1) // 2

    @property
    def period(self):
        """Period T = 2π / ω in seconds."""
        return 2.0 * np.pi / self.omega

    def states(self, psi):
        """States x*(ψ) at some azimuths.

        Parameters
        ----------
        psi : array_like, shape (...,)
            Radians.

        Returns
        -------
        states : ndarray, shape (..., n)
            Sum of the Fourier series.

        Raises
        ------
        ValueError
            If an azimuth is not a finite number.
        """
        psi = real_array("psi", psi, "azimuths in radians")
        return evaluate_harmonics(self.coefficients, psi)


class PeriodicSystem(NamedSignals):
    """Nonlinear system whose right-hand side repeats with period T.

        ẋ = f(x, u, t),   y = g(x, u, t),   f and g of period T in t      (Eqs. 1, 2)

    Parameters
    ----------
    f : callable
        Right-hand side f(x, u, t) -> dx/dt of the shape of x. It must take one point,
        x (n,), u (m,) and t a number in seconds, and many, x (n, k), u (m, k), t (k,). To be
        pickled with the system, f must be a function of a module or an object of a class.
    g : callable, optional
        Outputs g(x, u, t) -> y, of shape (l,) or (l, k) alike. None measures the states.
    period : float
        T in seconds.
    state_names, input_names : sequence of str
        One name for each state and input; the number of names sets n and m.
    output_names : sequence of str, optional
        By default the states' names without g, and y1, y2, … with it.
    jacobian : callable, optional
        Derivatives jacobian(x, u, t) -> (F, G, P, Q), for many points: F of shape
        (k, n, n), G (k, n, m), P (k, l, n), Q (k, l, m). By default central differences.
    trim_guess : tuple of array_like, optional
        (coefficients, inputs) to start :meth:`trim` from, of shapes (2 K + 1, n) in
        the order 0, 1c, 1s, …, any K, and (m,). Zero by default.
    trim_targets : dict, optional
        Mean of a state that the trim must reach, by name, such as ``{"w": 0.0}``.

    Attributes
    ----------
    omega : float
        2π / T in rad/s.
    n_states, n_inputs, n_outputs : int

    Raises
    ------
    ValueError
        If the period is not positive, names and shapes do not fit, or a function takes the time
        first, as SciPy's solvers have it.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eqs. 1 to 6.

    Examples
    --------
    A driven pendulum with damping; the drive is held at the trim:

    >>> def pendulum(x, u, t):
    ...     angle, rate = x
    ...     return np.array([rate, -np.sin(angle) - 0.5 * rate + u[0] * np.cos(2.0 * t)])
    >>> system = PeriodicSystem(
    ...     pendulum, period=np.pi, state_names=["angle", "rate"], input_names=["drive"]
    ... )
    >>> trim = system.trim(10, inputs={"drive": 1.0})
    >>> after = system.simulate([trim.inputs] * 2, [0.0, np.pi], trim.initial_state)[-1]
    >>> bool(np.max(np.abs(after - trim.initial_state)) < 1e-6)
    True
    >>> bool(system.linearize(trim).floquet_exponents().real.max() < 0)
    True
    """

    def __init__(
        self,
        f,
        g=None,
        *,
        period,
        state_names,
        input_names,
        output_names=None,
        jacobian=None,
        trim_guess=None,
        trim_targets=None,
    ):
        for name, function in (("f", f), ("g", g), ("jacobian", jacobian)):
            _check_callable(name, function, optional=name != "f")
        self.period = check_positive("period", period, "seconds", "f and g repeat after it")
        self.f, self.g = f, g
        self.state_names = check_names(state_names, "state_names")
        self.input_names = check_names(input_names, "input_names")
        if g is None and output_names is None:
            output_names = self.state_names
        self.output_names = check_names(output_names, "output_names", self._count_outputs(), "y")
        self.jacobian = CentralDifferences(f, g) if jacobian is None else jacobian
        self.trim_guess = None if trim_guess is None else self._guess(trim_guess)
        self.trim_targets = _by_name("trim_targets", trim_targets, self.state_names, "states")

    @property
    def omega(self):
        """Fundamental frequency ω = 2π / T in rad/s."""
        return 2.0 * np.pi / self.period

    def __repr__(self):
        return self._described(f"period={self.period:.6g}")

    def trim(
        self,
        n_harmonics=20,
        *,
        method="harmonic_balance",
        targets=None,
        inputs=None,
        guess=None,
        n_points=None,
    ):
        """Periodic solution under constant inputs.

        Parameters
        ----------
        n_harmonics : int, default=20
            Harmonics N of the states' Fourier series.
        method : {"harmonic_balance", "shooting"}, default="harmonic_balance"
            Newton's method on the Galerkin equations of N harmonics, or on the defect of the
            initial state after one period. The latter is exact for any N; its series is that of
            the exact orbit.
        targets : dict, optional
            Required mean of a state, by name. By default the system's own.
        inputs : dict, optional
            Values of inputs that are held, by name. With targets, the other inputs are free, as
            many as there are targets; without targets, they stay at the guess.
        guess : Trim or tuple of array_like, optional
            Initial guess, in the shapes of ``trim_guess``. By default the system's own.
        n_points : int, optional
            Points per period of the Galerkin integrals; by default 4096 or 128 per harmonic,
            whichever is more.

        Returns
        -------
        trim : Trim
            The solution, with its residual.

        Raises
        ------
        TrimError
            If Newton's method fails; the message names the residual and a way out.
        ValueError
            If names are unknown, targets and free inputs differ in number, or f is not the same
            a period later.
        """
        N = check_count("n_harmonics", n_harmonics, 0, "0 keeps the mean alone")
        check_choice("method", method, ("harmonic_balance", "shooting"))
        if n_points is not None:
            check_count("n_points", n_points, 1, "None takes enough")
        targets = self._targets(self.trim_targets if targets is None else targets)
        X, u = self._guess(self.trim_guess if guess is None else guess)
        free = self._hold(u, inputs, len(targets))
        start = N if method == "harmonic_balance" else min(N, 32)
        X, u, residual = solve_harmonic_balance(
            self.f,
            self.jacobian,
            self.omega,
            resize_harmonics(X, start),
            u,
            free=free,
            targets=targets,
            n_points=n_points,
        )
        x0 = X[0] + np.sum(X[1::2], axis=0)
        if method == "shooting":
            x0, u, residual = solve_shooting(self.f, self.period, x0, u, free=free, targets=targets)
            X = self._orbit_coefficients(x0, u, N, n_points)
        trim = Trim(self.omega, X, u, x0, residual, method, self.state_names, self.input_names)
        self._check_repeats(trim)
        return trim

    def linearize(self, trim):
        """Linear time-periodic system of small motions about a trim (Eqs. 4 to 6).

        Parameters
        ----------
        trim : Trim
            Of this system.

        Returns
        -------
        system : LTPSystem
            Perturbations of states, inputs and outputs; F, G, P, Q are the
            derivatives of f and g along x*(ψ), u*.

        Raises
        ------
        ValueError
            If the trim is not one of such a system.
        """
        self._check_trim(trim)
        jacobian = self.jacobian
        if isinstance(jacobian, CentralDifferences):
            jacobian = jacobian.along(trim)
        F, G, P, Q = (OrbitMatrix(jacobian, trim, which) for which in range(4))
        if self.g is None:
            P, Q = None, None
        return LTPSystem(F, G, P, Q, omega=self.omega, **self._names())

    def simulate(self, u, t, x0=None, *, rtol=1e-12, atol=1e-13, return_states=False):
        """Outputs at the sample times, u held between them, by error-controlled steps.

        Parameters
        ----------
        u : array_like, shape (n_samples,) or (n_samples, m)
            Inputs; ``u[k]`` acts from ``t[k]`` to ``t[k + 1]``. Columns of a DataFrame that
            are names of the inputs go by these.
        t : array_like, shape (n_samples,)
            Increasing times in seconds.
        x0 : array_like, shape (n,), optional
            State at ``t[0]``; zero by default. Start at ``trim.initial_state`` to
            begin in trim.
        rtol, atol : float
            Error allowed for each step of the integrator.
        return_states : bool, default=False
            Whether to return the states too.

        Returns
        -------
        y : ndarray, shape (n_samples, l)
            Outputs.
        x : ndarray, shape (n_samples, n)
            Only with ``return_states=True``.

        Raises
        ------
        ValueError
            If shapes do not fit, t does not increase, or a value is not finite.
        RuntimeError
            If the integrator cannot continue; the message says where.
        """
        check_flag("return_states", return_states)
        check_numbers("positive", "1e-12 is usual", rtol=rtol)
        check_numbers("nonnegative", "1e-13 is usual, in the units of the states", atol=atol)
        t = times_near_zero_phase(check_times(t), self.omega)
        u = check_inputs(u, len(t), self.input_names, batch=False)
        x0 = check_state(x0, (), self.state_names)
        first_step = self.period / STEPS_PER_PERIOD
        x = integrate(self.f, x0, u, t, rtol=rtol, atol=atol, first_step=first_step)
        y = x.copy() if self.g is None else np.asarray(self.g(x.T, u.T, t)).T
        return (y, x) if return_states else y

    def _count_outputs(self):
        if self.g is None:
            return self.n_states
        shape = np.shape(self.g(np.zeros(self.n_states), np.zeros(self.n_inputs), 0.0))
        if len(shape) != 1:
            raise ValueError(
                f"g returned an array of shape {shape} for one point; it must return the outputs, "
                f"shape (l,)"
            )
        return shape[0]

    def _targets(self, targets):
        targets = _by_name("targets", targets, self.state_names, "states")
        return [(self.state_names.index(name), mean) for name, mean in targets.items()]

    def _guess(self, guess):
        if guess is None:
            guess = np.zeros((1, self.n_states)), np.zeros(self.n_inputs)
        elif isinstance(guess, Trim):
            guess = guess.coefficients, guess.inputs
        wanted = (
            f"a Trim, or a pair of arrays: coefficients (2 K + 1, {self.n_states}) and inputs "
            f"({self.n_inputs},)"
        )
        if not isinstance(guess, tuple | list) or len(guess) != 2:
            raise ValueError(f"the trim guess is {reprlib.repr(guess)}; give {wanted}")
        X, u = (np.array(real_array("the trim guess", values, wanted)) for values in guess)
        odd = X.ndim == 2 and len(X) % 2 == 1
        if not odd or X.shape[1] != self.n_states or u.shape != (self.n_inputs,):
            raise ValueError(f"the trim guess has shapes {X.shape} and {u.shape}; give {wanted}")
        return X, u

    def _check_trim(self, trim):
        """Raise ValueError unless it is a trim, and of a system such as this one."""
        if not isinstance(trim, Trim):
            raise ValueError(f"trim={reprlib.repr(trim)} is not a trim; give the result of trim()")
        sizes = trim.coefficients.shape[1], len(trim.inputs)
        if sizes != (self.n_states, self.n_inputs) or not np.isclose(trim.omega, self.omega):
            raise ValueError(
                f"the trim has {sizes[0]} states, {sizes[1]} inputs and omega={trim.omega:.6g}, "
                f"but the system has {self.n_states}, {self.n_inputs} and {self.omega:.6g}; give "
                f"the result of this system's trim()"
            )

    def _hold(self, u, inputs, n_targets):
        """Write held inputs into u; positions of the free ones."""
        inputs = _by_name("inputs", inputs, self.input_names, "inputs")
        for name, value in inputs.items():
            u[self.input_names.index(name)] = value
        rest = [name for name in self.input_names if name not in inputs]
        if not n_targets:
            return []
        if len(rest) != n_targets:
            raise ValueError(
                f"{n_targets} targets cannot determine the free inputs {rest}; hold the others in "
                f"inputs={{name: value}}, or change targets, so that there are as many of each"
            )
        return [self.input_names.index(name) for name in rest]

    def _check_repeats(self, trim):
        """Raise ValueError if f, or its derivative, is not the same a period later.

        At most of some azimuths of a trim, by more than a part of its terms.
        """
        psi = np.arange(1, 16, 2)  # of no common part of a turn
        x, t = trim.states(psi).T, psi / self.omega
        u = np.repeat(trim.inputs[:, None], len(psi), axis=1)
        now, later = (
            (np.asarray(self.f(x, u, each), float).T, *self.jacobian(x, u, each)[:2])
            for each in (t, t + self.period)
        )
        (f, F, G), (f_later, F_later, _) = now, later
        terms = np.abs(F) @ (np.abs(x.T) + HALF)[..., None] + np.abs(G) @ np.abs(u.T)[..., None]
        size = np.max(np.abs(f), axis=0) + np.max(terms, axis=0)[:, 0]
        apart = np.abs(f_later - f) > ANOTHER * size
        apart_slopes = np.abs(F_later - F) > ANOTHER * np.max(np.abs(F))
        if np.mean(np.any(apart, axis=1) | np.any(apart_slopes, axis=(1, 2))) > 0.5:
            raise ValueError(
                f"f, or its derivative by x, is not the same a period of {self.period:.6g} s "
                f"later, at most azimuths of the trim: period is 2π/omega in seconds, not omega"
            )

    def _orbit_coefficients(self, x0, u, n_harmonics, n_points):
        """Fourier coefficients of the orbit through x0."""
        n_points = max(n_points or 4096, 16 * n_harmonics)
        t = self.period * np.arange(n_points) / n_points
        held = np.broadcast_to(u, (n_points, len(u)))
        orbit = integrate(self.f, x0, held, t, rtol=1e-13, atol=1e-14)
        return sampled_harmonics(orbit, n_harmonics)


def _check_callable(name, function, *, optional):
    if not callable(function) and not (optional and function is None):
        raise ValueError(
            f"{name}={reprlib.repr(function)} must be a function of (x, u, t)"
            f"{', or None' if optional else ''}"
        )
    try:
        first, *others = inspect.signature(function).parameters
    except (TypeError, ValueError):  # it has none, or does not tell
        return
    if first in ("t", "time") and others:
        raise ValueError(
            f"{name} takes ({', '.join([first, *others])}), and is called with (x, u, t): give "
            f"{name}=lambda x, u, t: …, the time last"
        )


def _by_name(parameter, values, names, what):
    """Finite numbers by name, as a dict; None is none."""
    if values is None:
        return {}
    if not isinstance(values, Mapping):
        raise ValueError(
            f"{parameter}={reprlib.repr(values)} must be a dict of numbers by name; the {what} are "
            f"{list(names)}"
        )
    unknown = [name for name in values if name not in names]
    if unknown:
        raise ValueError(f"{parameter} names {unknown}; the {what} are {list(names)}")
    for name, value in values.items():
        hint = f"{parameter} holds numbers by name"
        check_numbers("finite", hint, **{f"{parameter}[{name!r}]": value})
    return {name: float(value) for name, value in values.items()}


def states_measured(F, G):
    """(F, G, P, Q) of a system whose outputs are its states."""
    return F, G, np.broadcast_to(np.eye(F.shape[-1]), F.shape), np.zeros(G.shape)


class OrbitMatrix:
    """One of F, G, P, Q along a trim, as a function of azimuth."""

    def __init__(self, jacobian, trim, which):
        self.jacobian, self.trim, self.which = jacobian, trim, which
        self.precision = getattr(jacobian, "precision", 0.0)

    def __call__(self, psi):
        x = self.trim.states(psi).T
        u = np.broadcast_to(self.trim.inputs[:, None], (len(self.trim.inputs), len(psi)))
        return self.jacobian(x, u, np.asarray(psi) / self.trim.omega)[self.which]


class CentralDifferences:
    """F, G, P, Q by central differences of f and g.

    Steps of ε^{1/3} of the largest size of each variable balance truncation and rounding; the
    result is accurate to about ``precision``. The sizes are those of the given points, or of a
    whole orbit: a step fitted to a few points where a state passes through zero would be lost in
    rounding.
    """

    precision = 1e-8

    def __init__(self, f, g, sizes=None):
        self.f, self.g, self.sizes = f, g, sizes

    def along(self, trim):
        """The same with steps that fit a whole orbit."""
        psi = 2.0 * np.pi * np.arange(256) / 256
        orbit = np.max(np.abs(trim.states(psi)), axis=0)
        return CentralDifferences(self.f, self.g, (orbit, np.abs(trim.inputs)))

    def __call__(self, x, u, t):
        sizes = self.sizes or [np.max(np.abs(v), axis=1, initial=0.0) for v in (x, u)]
        x_steps, u_steps = (
            np.cbrt(np.finfo(float).eps) * np.where(size > 0, size, 1.0) for size in sizes
        )
        F = _slopes(lambda x: self.f(x, u, t), x, x_steps)
        G = _slopes(lambda u: self.f(x, u, t), u, u_steps)
        if self.g is None:
            return states_measured(F, G)
        P = _slopes(lambda x: self.g(x, u, t), x, x_steps)
        Q = _slopes(lambda u: self.g(x, u, t), u, u_steps)
        return F, G, P, Q


def _slopes(function, variables, steps):
    """Derivatives of function(variables), (l, k), by each of the variables, (m, k)."""
    columns = []
    for i, step in enumerate(steps):
        above, below = np.array(variables), np.array(variables)
        above[i] += step
        below[i] -= step
        columns.append((np.asarray(function(above)) - function(below)) / (2.0 * step))
    if not columns:
        n_rows = len(np.asarray(function(variables)))
        return np.zeros((variables.shape[1], n_rows, 0))
    return np.stack(columns, axis=-1).swapaxes(0, 1)
