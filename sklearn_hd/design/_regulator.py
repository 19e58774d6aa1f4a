"""Periodic linear quadratic regulator."""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import linalg

from sklearn_hd._checks import check_numbers, real_array
from sklearn_hd._guards import within_range
from sklearn_hd.algorithms.linalg.rounding import EXACT, HALF
from sklearn_hd.algorithms.periodic.riccati import hamiltonian_triples, multipliers_of
from sklearn_hd.design._problem import (
    ContinuousProblem,
    PeriodicMatrix,
    SampledProblem,
    check_weight,
    held_integral,
    samples_of,
    solved,
)
from sklearn_hd.systems import FourierMatrix, LTPSystem
from sklearn_hd.systems.arguments import check_state, precision


@dataclass(frozen=True, eq=False)
class PeriodicRegulator:
    """State feedback u = −K(ψ) x with its cost.

    Made by :func:`periodic_lqr` and :meth:`with_gain`; each parameter is an attribute.

    Parameters
    ----------
    system : LTPSystem
        What it was designed for.
    gain : PeriodicMatrix
        K, shape (p, m, n): at the samples or, in continuous time, at 256 points of a period.
    cost_to_go : PeriodicMatrix
        X, shape (p, n, n): from x at azimuth ψ on, the cost is xᵀ X(ψ) x. None if the loop
        is not stable.
    multipliers : complex ndarray, shape (n,)
        Floquet multipliers of the closed loop, the largest first.
    sample_time : float or None
        Seconds for which u is held; None in continuous time.
    loss : float
        Relative increase of the cost above that of the best gain; 0 for the best.
    problem : object
        The solved problem: the matrices of its steps, or the functions of ψ.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009.

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> regulator = periodic_lqr(mathieu(), np.eye(2), [[1.0]])
    >>> regulator.gain.values.shape, bool(abs(regulator.multipliers[0]) < 1)
    ((256, 1, 2), True)
    """

    system: LTPSystem
    gain: PeriodicMatrix
    cost_to_go: PeriodicMatrix | None = field(repr=False)
    multipliers: np.ndarray
    sample_time: float | None
    loss: float = 0.0
    problem: object = field(repr=False, default=None)

    @property
    def is_stable(self):
        """Whether all multipliers lie within the unit circle."""
        return bool(np.abs(self.multipliers[0]) < 1.0)

    def cost(self, x0, psi=0.0):
        """Cost from a state on.

            x0ᵀ X(ψ) x0

        Parameters
        ----------
        x0 : array_like, shape (n,)
            State, in the system's units; a Series is read by its names.
        psi : float, default=0.0
            Azimuth of that state, radians; for sampled designs, that of a sample.

        Returns
        -------
        cost : float
            Infinite if the loop is not stable.

        Raises
        ------
        ValueError
            If x0 does not hold n numbers, or ψ is not finite.
        """
        x0 = check_state(np.nan if x0 is None else x0, (), self.system.state_names)
        check_numbers("finite", "it is the azimuth ψ in radians", psi=psi)
        if not self.is_stable:
            return np.inf
        return float(x0 @ self.cost_to_go(np.array([psi]))[0] @ x0)

    def h2_cost(self, W):
        """Mean rate of the cost under white noise on the states: the squared H2 norm.

            J = (1/T) ∫ tr X(ψ) W(ψ) dt

        Parameters
        ----------
        W : array_like or callable, shape (n, n)
            Intensity of the noise, constant or periodic as
            :class:`~sklearn_hd.systems.LTPSystem` takes matrices. Noise that enters through a
            matrix E has the intensity E Eᵀ.

        Returns
        -------
        cost : float
            Per second. For sampled designs, the cost of noise before the next sample, which no
            controller can change, is left out. Infinite if the loop is not stable.

        Raises
        ------
        ValueError
            If W is not n by n and positive semidefinite.
        """
        return float(_noise_cost(self, _intensity(self, W)))

    def lqg_cost(self, estimator):
        """Mean rate of the cost when an estimator's states are fed back.

        Parameters
        ----------
        estimator : PeriodicEstimator
            Of the same system and sample time; its W is the process noise.

        Returns
        -------
        cost : float
            Per second, as for :meth:`h2_cost`: the cost of the regulator plus that of the
            estimation errors.

        Raises
        ------
        ValueError
            If the estimator has another system or sample time, or the gain is not the best one,
            because the two parts add up only for the best gain.

        References
        ----------
        S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009.
        """
        if estimator.system is not self.system or estimator.sample_time != self.sample_time:
            raise ValueError(
                "regulator and estimator must have the same system and sample_time; design both "
                "with the same"
            )
        self._check_best()
        K, error, T = self.gain.values, estimator.filtered.values, self.system.period
        if self.sample_time is None:
            R = self.problem.R(self.gain.azimuths)
        else:
            B, X = self.problem.B, np.roll(self.cost_to_go.values, -1, axis=0)
            R = self.problem.R + B.mT @ X @ B
        costs = np.einsum("kij,kil,klm,kjm->k", K, R, K, error)
        rate = np.mean(costs) if self.sample_time is None else np.sum(costs) / T
        return float(_noise_cost(self, estimator.noise) + rate)

    def truncated(self, n_harmonics, W=None):
        """Regulator whose gain keeps only the first harmonics, with its loss.

        Parameters
        ----------
        n_harmonics : int
            N; 0 makes the gain constant.
        W : array_like or callable, shape (n, n), optional
            As for :meth:`with_gain`.

        Returns
        -------
        regulator : PeriodicRegulator
            As from :meth:`with_gain`.

        Raises
        ------
        ValueError
            If ``n_harmonics`` is more than the samples determine, W is not an intensity, or this
            is not the best regulator.
        """
        return self.with_gain(self.gain.truncated(n_harmonics), W)

    @within_range
    def with_gain(self, gain, W=None):
        """The same loop under another gain, with its loss.

        Parameters
        ----------
        gain : PeriodicMatrix or array_like, shape (m, n)
            K with as many samples, or constant: of another model, or of another method.
        W : array_like or callable, shape (n, n), optional
            Intensity of the noise under which ``loss`` compares :meth:`h2_cost`. By default it
            compares the cost from the worst state at the worst azimuth; no noise loses more.

        Returns
        -------
        regulator : PeriodicRegulator
            With its ``loss``, infinite if the loop becomes unstable, and ``multipliers``.

        Raises
        ------
        ValueError
            If the gain has another shape, W is not an intensity, or this is not the best
            regulator.
        """
        self._check_best()
        intensity = None if W is None else _intensity(self, W)
        gain = self._same_shape(gain)
        X, steps = self.problem.evaluate(gain if self.sample_time is None else gain.values)
        multipliers = multipliers_of(steps)
        stable = np.abs(multipliers[0]) < 1.0
        cost_to_go = PeriodicMatrix(X, gain.held) if stable else None
        made = replace(self, gain=gain, cost_to_go=cost_to_go, multipliers=multipliers)
        if not stable:
            loss = np.inf
        elif intensity is None:
            loss = _worst_loss(X, self.cost_to_go.values)
        else:
            loss = _noise_cost(made, intensity) / _noise_cost(self, intensity) - 1.0
        return replace(made, loss=float(max(loss, 0.0)))

    def _check_best(self):
        if self.loss:
            raise ValueError(
                f"this regulator's gain is not the best one (loss={self.loss:.3g}); ask the "
                f"regulator that periodic_lqr returned"
            )

    def _same_shape(self, gain):
        """A given gain, at the samples of this one."""
        p, m, n = self.gain.values.shape
        wanted = f"a PeriodicMatrix of {p} samples {m} x {n}, or a matrix {m} x {n}"
        if not isinstance(gain, PeriodicMatrix):
            gain = PeriodicMatrix(np.array(real_array("gain", gain, wanted), ndmin=3))
        if gain.values.shape[1:] != (m, n) or len(gain.values) not in (1, p):
            raise ValueError(f"gain has samples of shape {gain.values.shape}; give {wanted}")
        return PeriodicMatrix(np.broadcast_to(gain.values, (p, m, n)), self.gain.held)


@within_range
def periodic_lqr(system, Q, R, *, sample_time=None):
    """Best periodic state feedback of a linear time-periodic system.

        u = −K(ψ) x   minimises   J = ∫ xᵀ Q(ψ) x + uᵀ R(ψ) u dt

    Parameters
    ----------
    system : LTPSystem
        F and G are used.
    Q, R : array_like or callable, shapes (n, n) and (m, m)
        Weights of states and inputs, constant or periodic as
        :class:`~sklearn_hd.systems.LTPSystem` takes matrices. Q is positive semidefinite, R
        positive definite.
    sample_time : float, optional
        Seconds for which inputs are held; a period must hold a whole number of samples. The cost
        is still the integral, also between samples. None is continuous feedback.

    Returns
    -------
    regulator : PeriodicRegulator
        Gain, cost to go and closed-loop multipliers.

    Raises
    ------
    ValueError
        If a weight is not positive (semi)definite, a period does not hold a whole number of
        samples, or no gain stabilises the system: the message names the multiplier.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009; E. K.-W. Chu,
    H.-Y. Fan, W.-W. Lin, C.-S. Wang, "Structure-preserving algorithms for periodic discrete-time
    algebraic Riccati equations", International Journal of Control 77 (2004).

    Examples
    --------
    A mass with a periodic stiffness, sixteen samples per period:

    >>> from sklearn_hd.systems import mathieu
    >>> mass = mathieu()
    >>> regulator = periodic_lqr(mass, np.eye(2), [[1.0]], sample_time=mass.period / 16)
    >>> regulator.gain.values.shape
    (16, 1, 2)
    >>> mean = regulator.truncated(0)  # a constant gain
    >>> mean.is_stable, bool(0.0 < mean.loss < 0.2)
    (True, True)
    """
    psi = samples_of(system, sample_time)
    Q = check_weight("Q", Q, system.n_states, psi[:-1], definite=False)
    R = check_weight("R", R, system.n_inputs, psi[:-1], definite=True)
    if sample_time is None:
        problem = ContinuousProblem(system.F, system.G, Q, R, system.omega)
    else:
        problem = _held_problem(system, Q, R, psi)
    X, K, multipliers = solved(
        problem,
        "no input reaches this motion, which does not die out by itself, so no gain stabilises "
        "the system; add an input that reaches it, or remove the motion from the model",
        "Q does not see this motion, or R is too large for the gain to reach it within "
        "floating-point numbers; give weight to the states that it moves, or lower R",
    )
    held = sample_time is not None
    return PeriodicRegulator(
        system,
        PeriodicMatrix(K, held),
        PeriodicMatrix(X, held),
        multipliers,
        None if sample_time is None else float(sample_time),
        problem=problem,
    )


def _held_problem(system, Q, R, psi):
    """Sampled problem of inputs held over each step, its cost integrated between samples."""
    n, m = system.n_states, system.n_inputs
    costs = np.einsum("kii->i", R(psi[:-1])) / (len(psi) - 1)
    units = 2.0 ** np.round(-0.5 * np.log2(costs))  # in which inputs cost one

    def rates(psi):
        M = np.zeros((len(psi), n + m, n + m))
        M[:, :n, :n], M[:, :n, n:] = system.F(psi), system.G(psi) * units
        return M

    def weights(psi):
        M = np.zeros((len(psi), n + m, n + m))
        M[:, :n, :n], M[:, n:, n:] = Q(psi), R(psi) * (units * units[:, None])
        return M

    tolerance = precision(system.F, system.G, Q, R)
    A, _, H = hamiltonian_triples(rates, None, weights, psi, system.omega, tolerance=tolerance)
    Gamma, S, R = A[:, :n, n:] / units, H[:, :n, n:] / units, H[:, n:, n:]
    inputs = system.G(np.linspace(psi[0], psi[-1], 257))
    size = np.max(np.abs(inputs), axis=0) * system.period / (len(psi) - 1)
    Gamma = np.where(np.abs(Gamma) > EXACT * size, Gamma, 0.0)  # an integral of nothing is rounding
    return SampledProblem(A[:, :n, :n], Gamma, H[:, :n, :n], R / (units * units[:, None]), S)


def _intensity(regulator, W):
    """Noise of one step (sampled), or its intensity at the points (continuous)."""
    system = regulator.system
    psi = samples_of(system, regulator.sample_time)
    W = check_weight("W", W, system.n_states, psi[:-1], definite=False)
    if regulator.sample_time is None:
        return W(psi[:-1])
    identity = FourierMatrix(np.eye(system.n_states)[None])
    return held_integral(identity, system, W, psi)[0]


def _noise_cost(regulator, noise):
    if not regulator.is_stable:
        return np.inf
    X = regulator.cost_to_go.values
    if regulator.sample_time is None:
        return np.mean(np.einsum("kij,kji->k", X, noise))
    return np.einsum("kij,kji->", np.roll(X, -1, axis=0), noise) / regulator.system.period


def _worst_loss(X, best):
    """Largest relative increase of xᵀ X x above xᵀ X_best x over all x and samples."""
    worst = 0.0
    for now, least in zip(X, best, strict=True):
        size = np.sqrt(np.diagonal(least))
        size = np.where(size > 0.0, size, 1.0)
        sizes, vectors = linalg.eigh(least / (size * size[:, None]))
        costly = sizes > HALF * sizes[-1]
        T = vectors[:, costly] / np.sqrt(sizes[costly]) / size[:, None]
        worst = max(worst, np.linalg.eigvalsh(T.T @ now @ T)[-1] - 1.0)
    return float(worst)
