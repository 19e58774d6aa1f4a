"""Periodic orbits under constant inputs."""

from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._checks import real_array
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics

__all__ = ["Trim"]


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
        State at ψ = 0: of the Fourier series (harmonic balance), or on the exact
        orbit (shooting).
    residual : float
        Relative residual at which the solver stopped.
    method : str
        ``"harmonic_balance"`` or ``"shooting"``.
    state_names, input_names : tuple of str
        As the system has them.

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
            If an azimuth is no finite number.
        """
        psi = real_array("psi", psi, "azimuths in radians")
        return evaluate_harmonics(self.coefficients, psi)
