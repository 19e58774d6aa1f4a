"""Quadratic problems of a period, solved by regulators and, transposed backwards, by filters.

Both kinds have ``solve() -> X, K, steps`` (the stabilising solution, its gain and the closed
loop's steps), ``evaluate(K) -> X, steps`` (the cost under another gain) and
``unreachable() -> multipliers`` that no gain can move into the unit circle.

A periodic matrix given by its samples: gains, costs to go, covariances.
"""

import reprlib
from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._checks import check_count, check_period, check_positive, real_array
from sklearn_hd.algorithms.linalg.rounding import EXACT, HALF
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.riccati import (
    defect_and_loop,
    hamiltonian_triples,
    multipliers_of,
    riccati_triples,
    solve_periodic_lyapunov,
    solve_periodic_riccati,
    unreachable_multipliers,
)
from sklearn_hd.algorithms.signals.fourier import all_harmonics, sampled_harmonics
from sklearn_hd.systems import LTPSystem
from sklearn_hd.systems.arguments import periodic_matrix, precision

POINTS = 256  # of a period in continuous time: harmonics up to 127


@dataclass(frozen=True, eq=False)
class SampledProblem:
    """x_{k+1} = A_k x_k + B_k u_k, cost Σ xᵀQx + 2xᵀSu + uᵀRu; arrays of p steps."""

    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    S: np.ndarray

    def solve(self):
        A, G, H = riccati_triples(self.A, self.B, self.Q, self.R, self.S)
        X = solve_periodic_riccati(A, G, H)
        after = np.roll(X, -1, axis=0)
        pushed = self.B.mT @ after
        K = np.linalg.solve(self.R + pushed @ self.B, pushed @ self.A + self.S.mT)
        return X, K, self.A - self.B @ K

    def evaluate(self, K):
        steps, crossed = self.A - self.B @ K, self.S @ K
        cost = self.Q - crossed - crossed.mT + K.mT @ self.R @ K
        return solve_periodic_lyapunov(steps, cost), steps

    def unreachable(self):
        _, G, _ = riccati_triples(self.A, self.B, self.Q, self.R)
        return unreachable_multipliers(self.A, G)


@dataclass(frozen=True, eq=False)
class ContinuousProblem:
    """ẋ = F x + G u, cost ∫ xᵀQx + uᵀRu dt; callables of ψ."""

    F: object
    G: object
    Q: object
    R: object
    omega: float

    def solve(self):
        A, G, H = self._triples(self.F, self._reach, self.Q)
        X, psi = solve_periodic_riccati(A, G, H), ends_of_steps(POINTS)[:-1]
        K = np.linalg.solve(self.R(psi), self.G(psi).mT @ X)
        return X, K, defect_and_loop(A, G, H, X)[1]

    def evaluate(self, K):
        def loop(psi):
            return self.F(psi) - self.G(psi) @ K(psi)

        def cost(psi):
            gain = K(psi)
            return self.Q(psi) + gain.mT @ self.R(psi) @ gain

        steps, _, H = self._triples(loop, None, cost)
        return solve_periodic_lyapunov(steps, H), steps

    def unreachable(self):
        A, G, _ = self._triples(self.F, self._reach, None)
        return unreachable_multipliers(A, G)

    def _reach(self, psi):
        G = self.G(psi)
        return G @ np.linalg.solve(self.R(psi), G.mT)

    def _triples(self, F, E, Q):
        tolerance, psi = precision(self.F, self.G, self.Q, self.R), ends_of_steps(POINTS)
        return hamiltonian_triples(F, E, Q, psi, self.omega, tolerance=tolerance)


def solved(problem, unreached, unseen):
    """X, K and multipliers of a problem, or an error that names the motion out of reach."""
    lost = problem.unreachable()
    if len(lost):
        raise ValueError(f"{_worded(lost)}: {unreached}")
    X, K, steps = problem.solve()
    finite = np.all(np.isfinite(steps))
    multipliers = multipliers_of(steps) if finite else np.array([np.nan + 0j])
    if not np.abs(multipliers[0]) < 1.0 - HALF:
        raise ValueError(f"{_worded(multipliers[:1])} stays in the closed loop: {unseen}")
    return X, K, multipliers


def _worded(multipliers):
    several = "multipliers" if len(multipliers) > 1 else "multiplier"
    values = ", ".join(
        f"{mu.real:.6g}" if abs(mu.imag) <= EXACT * abs(mu) else f"{mu:.6g}" for mu in multipliers
    )
    return f"{several} {values} of a period"


def samples_of(system, sample_time):
    """Ends in radians of the steps of one period of a design."""
    if not isinstance(system, LTPSystem):
        raise ValueError(
            f"system={reprlib.repr(system)} must be an LTPSystem: ltp_ of a fitted matcher, or the "
            f"result of PeriodicSystem.linearize"
        )
    if sample_time is None:
        return ends_of_steps(POINTS)
    dt = check_positive("sample_time", sample_time, "seconds", "inputs are held for it")
    once = abs(dt * system.omega / (2.0 * np.pi) - 1.0) < HALF  # a period, fed back once in it
    return ends_of_steps(1 if once else check_period(system.omega, dt, 0))


def ends_of_steps(p):
    """Ends in radians of p equal steps of a period, shape (p + 1,)."""
    return 2.0 * np.pi * np.arange(p + 1) / p


def check_weight(name, matrix, size, psi, *, definite):
    """Callable of ψ of a symmetric weight, positive (semi)definite at azimuths psi."""
    function, shape = periodic_matrix(matrix, name)
    if shape != (size, size):
        raise ValueError(f"{name} is {shape[0]} x {shape[1]}; it must be {size} x {size}")
    values = function(psi)
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name} holds NaN or infinity at some azimuths; make it finite")
    largest = np.max(np.abs(values), initial=0.0)
    if np.max(np.abs(values - values.mT), initial=0.0) > HALF * largest:
        raise ValueError(f"{name} is not symmetric; give (M + M.T) / 2")
    smallest = np.linalg.eigvalsh(values)[:, 0]
    worst = int(np.argmin(smallest))
    if smallest[worst] < -EXACT * largest or (definite and not smallest[worst] > 0.0):
        kind = "definite" if definite else "semidefinite"
        raise ValueError(
            f"{name} must be positive {kind}; at psi = {psi[worst]:.4g} rad its smallest "
            f"eigenvalue is {smallest[worst]:.4g}"
        )
    return function


def held_integral(M, system, W, psi):
    """∫ Φ M W Mᵀ Φᵀ dt over each step, the covariance left by noise of intensity W; and Φ."""
    intensity = entered_noise(M, W)
    tolerance = precision(system.F, intensity)
    Phi, covariance, _ = hamiltonian_triples(
        system.F, intensity, None, psi, system.omega, tolerance=tolerance
    )
    return covariance, Phi


def entered_noise(M, W):
    """Callable of ψ of M W Mᵀ, the intensity of noise W that enters through M."""

    def intensity(psi):
        entered = M(psi)
        return entered @ W(psi) @ entered.mT

    intensity.precision = precision(M, W)
    return intensity


@dataclass(frozen=True, eq=False)
class PeriodicMatrix:
    """Matrix M(ψ) known at equal steps of one period.

        M(ψ) = M_0 + Σ_k (M_kc cos kψ + M_ks sin kψ)

    Called with azimuths ψ of shape (n_points,), it returns values (n_points, rows, columns): of
    the trigonometric polynomial through its samples or, with ``held``, of the latest sample. It
    can therefore be F, G, P or Q of an :class:`~sklearn_hd.systems.LTPSystem`.

    Parameters
    ----------
    values : ndarray, shape (p, rows, columns)
        M at ψ = 2πk / p.
    held : bool, default=False
        Whether a value holds until the next sample.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009.

    Examples
    --------
    >>> psi = 2 * np.pi * np.arange(8) / 8
    >>> K = PeriodicMatrix(2.0 + np.cos(psi).reshape(8, 1, 1))
    >>> K.coefficients(1).ravel().round(12).tolist()
    [2.0, 1.0, 0.0]
    >>> K(np.array([np.pi])).ravel().round(12).tolist()
    [1.0]
    """

    values: np.ndarray = field(repr=False)
    held: bool = False

    def __post_init__(self):
        values = np.array(real_array("values", self.values, "samples (p, rows, columns)"))
        if values.ndim != 3 or not len(values):
            raise ValueError(f"values has shape {values.shape}; give samples (p, rows, columns)")
        values.flags.writeable = False
        object.__setattr__(self, "values", values)

    @property
    def azimuths(self):
        """Azimuths ψ of the samples, shape (p,), in radians."""
        return ends_of_steps(len(self.values))[:-1]

    @property
    def max_harmonics(self):
        """Highest harmonic that p samples determine, the largest whole number below p / 2."""
        return (len(self.values) - 1) // 2

    def __call__(self, psi):
        """Values at azimuths psi, shape (n_points,) -> (n_points, rows, columns)."""
        psi = real_array("psi", psi, "azimuths in radians")
        if self.held:
            # rounding of ωt must not put a sample before its own azimuth
            p = len(self.values)
            return self.values[np.floor(psi * p / (2.0 * np.pi) + 1e-6).astype(int) % p]
        return evaluate_harmonics(all_harmonics(self.values), psi)

    def coefficients(self, n_harmonics):
        """Real Fourier coefficients up to some harmonic.

        Parameters
        ----------
        n_harmonics : int
            N, at most ``max_harmonics``.

        Returns
        -------
        coefficients : ndarray, shape (2 N + 1, rows, columns)
            In the order 0, 1c, 1s, …, of the samples.

        Raises
        ------
        ValueError
            If ``n_harmonics`` is negative, not whole or more than the samples determine.
        """
        N = check_count("n_harmonics", n_harmonics, 0, "0 keeps the mean alone")
        if self.max_harmonics < N:
            raise ValueError(
                f"n_harmonics={N} is more than the {len(self.values)} samples of a period "
                f"determine; give {self.max_harmonics} at most"
            )
        return sampled_harmonics(self.values, N)

    def truncated(self, n_harmonics):
        """The matrix of only the first harmonics, at the same samples.

        Parameters
        ----------
        n_harmonics : int
            N, at most ``max_harmonics``; 0 keeps the mean.

        Returns
        -------
        matrix : PeriodicMatrix
            With as many samples.

        Raises
        ------
        ValueError
            As for :meth:`coefficients`.
        """
        kept = evaluate_harmonics(self.coefficients(n_harmonics), self.azimuths)
        return PeriodicMatrix(kept, self.held)
