"""Periodic Kalman filter, and the observer and controller that run with it."""

import reprlib
from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._checks import check_numbers, real_array
from sklearn_hd._guards import within_range
from sklearn_hd.design._problem import (
    ContinuousProblem,
    PeriodicMatrix,
    SampledProblem,
    check_weight,
    entered_noise,
    held_integral,
    samples_of,
    solved,
)
from sklearn_hd.design._regulator import PeriodicRegulator
from sklearn_hd.systems import LTPSystem
from sklearn_hd.systems.arguments import check_state, periodic_matrix, precision


@dataclass(frozen=True, eq=False)
class PeriodicEstimator:
    """Best linear estimator of the states of a periodic system from its outputs.

    Made by :func:`periodic_kalman`; each parameter is an attribute.

    Parameters
    ----------
    system : LTPSystem
        What it was designed for.
    gain : PeriodicMatrix
        L, shape (p, n, l): x̂ ← x̂ + L (y − ŷ) at a sample; in continuous time,
        dx̂/dt = F x̂ + G u + L (y − ŷ).
    covariance : PeriodicMatrix
        P, shape (p, n, n), of the error of x̂ before y of the sample is known.
    filtered : PeriodicMatrix
        The same after y is known; in continuous time both are equal.
    multipliers : complex ndarray, shape (n,)
        Floquet multipliers of the error, the largest first.
    sample_time : float or None
        Seconds; None in continuous time.
    noise : ndarray, shape (p, n, n)
        Covariance of the process noise of one step; in continuous time its intensity.
    sensor_noise : ndarray, shape (p, l, l)
        Covariance V of the noise of y; in continuous time its intensity.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009.

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> estimator = periodic_kalman(mathieu(), np.eye(2), 0.1 * np.eye(2))
    >>> estimator.gain.values.shape, bool(abs(estimator.multipliers[0]) < 1)
    ((256, 2, 2), True)
    """

    system: LTPSystem
    gain: PeriodicMatrix
    covariance: PeriodicMatrix = field(repr=False)
    filtered: PeriodicMatrix = field(repr=False)
    multipliers: np.ndarray
    sample_time: float | None
    noise: np.ndarray = field(repr=False)
    sensor_noise: np.ndarray = field(repr=False)

    def observer(self, *, input_trim=None, output_trim=None):
        """An observer that runs with this estimator, sample by sample.

        Parameters
        ----------
        input_trim, output_trim : array_like, shapes (m,) and (l,), optional
            Or by the samples of a period, as :class:`Observer` takes them.

        Returns
        -------
        observer : Observer
            Reset to zero at ψ = 0.
        """
        return Observer(self, input_trim=input_trim, output_trim=output_trim)


@within_range
def periodic_kalman(system, W, V, *, noise_input=None, sample_time=None):
    """Periodic Kalman filter of a linear time-periodic system.

        ẋ = F(ψ) x + G(ψ) u + E(ψ) w,   y = P(ψ) x + Q(ψ) u + v

    w and v are white and independent of each other.

    Parameters
    ----------
    system : LTPSystem
        F, G, P and Q.
    W : array_like or callable, shape (n, n) or (q, q)
        Intensity of w, positive semidefinite: covariance of its integral over
        a second. Constant or periodic as :class:`~sklearn_hd.systems.LTPSystem` takes matrices.
    V : array_like or callable, shape (l, l)
        For v, positive definite: with ``sample_time`` the covariance of one sample, otherwise the
        intensity, which is that covariance times the sample time.
    noise_input : array_like or callable, shape (n, q), optional
        E. By default the identity: noise on each state.
    sample_time : float, optional
        Seconds from one y to the next, while u is held; a period must hold a whole number of
        samples. None is a continuous filter.

    Returns
    -------
    estimator : PeriodicEstimator
        Gain, covariances and multipliers.

    Raises
    ------
    ValueError
        If a covariance is not positive (semi)definite, a period does not hold a whole number of
        samples, or no output shows a motion that does not die out: the message names its
        multiplier.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009.

    Examples
    --------
    >>> from sklearn_hd.systems import hawkmoth
    >>> moth = hawkmoth()
    >>> ltp = moth.linearize(moth.trim())
    >>> estimator = periodic_kalman(
    ...     ltp, 0.01 * np.eye(4), 0.1 * np.eye(4), sample_time=ltp.period / 16
    ... )
    >>> estimator.gain.values.shape, bool(abs(estimator.multipliers[0]) < 1)
    ((16, 4, 4), True)
    """
    psi = samples_of(system, sample_time)
    E = np.eye(system.n_states) if noise_input is None else noise_input
    E, (rows, q) = periodic_matrix(E, "noise_input")
    if rows != system.n_states:
        raise ValueError(
            f"noise_input is {rows} x {q}; it must have {system.n_states} rows, one for each of "
            f"{list(system.state_names)}"
        )
    W = check_weight("W", W, q, psi[:-1], definite=False)
    V = check_weight("V", V, system.n_outputs, psi[:-1], definite=True)
    design = _continuous if sample_time is None else _sampled
    P, L, filtered, multipliers, noise = design(system, E, W, V, psi)
    held = sample_time is not None
    return PeriodicEstimator(
        system,
        *(PeriodicMatrix(M, held) for M in (L, P, filtered)),
        multipliers,
        float(sample_time) if held else None,
        noise,
        V(psi[:-1]),
    )


def _solved(problem):
    return solved(
        problem,
        "no output sees this motion, which does not die out by itself, so its estimate never "
        "settles; measure something that it moves, or remove the motion from the model",
        "the noise W does not drive this motion, so the filter stops correcting it; give W "
        "a part in the states that it moves",
    )


def _sampled(system, E, W, V, psi):
    """The regulator of the transposed steps, in reverse order."""
    noise, A = held_integral(E, system, W, psi)
    C, V = system.P(psi[:-1]), V(psi[:-1])
    zero = np.zeros((len(A), system.n_states, system.n_outputs))
    back = (M[::-1] for M in (A.mT, C.mT, noise, V, zero))
    X, _, multipliers = _solved(SampledProblem(*back))
    P = np.roll(X[::-1], 1, axis=0)
    return P, *_corrected(P, C, V), multipliers, noise


def _corrected(P, C, V):
    """Kalman gain, and the covariance P of the state's error once y is known."""
    seen = C @ P
    L = np.linalg.solve(seen @ C.mT + V, seen).mT
    kept = np.eye(P.shape[-1]) - L @ C
    return L, kept @ P @ kept.mT + L @ V @ L.mT


def _continuous(system, E, W, V, psi):
    """The regulator of the transposed system, backwards."""
    noise = entered_noise(E, W)
    F, C = _backwards(system.F, transpose=True), _backwards(system.P, transpose=True)
    problem = ContinuousProblem(F, C, _backwards(noise), _backwards(V), system.omega)
    X, K, multipliers = _solved(problem)
    backwards = -np.arange(len(X))
    P = X[backwards]
    return P, K[backwards].mT, P, multipliers, noise(psi[:-1])


def _backwards(matrix, *, transpose=False):
    """M(−ψ), optionally transposed."""

    def turned(psi):
        values = matrix(-psi)
        return values.mT if transpose else values

    turned.precision = precision(matrix)
    return turned


class Observer:
    """Kalman filter on line: reads inputs and outputs, sample by sample, and gives the states.

        x̂⁻ = Φ_k x̂ + Γ_k u_k,   x̂ = x̂⁻ + L_k (y_k − ŷ_k)

    It holds one estimate and one covariance, however long it runs.

    Parameters
    ----------
    estimator : PeriodicEstimator
        For sampled outputs (``sample_time``).
    input_trim, output_trim : array_like, optional
        Values of u and y in trim, shapes (m,) and (l,), or (p, m) and (p, l) at the samples of a
        period. They are subtracted from the data. Zero by default.

    Attributes
    ----------
    state : ndarray, shape (n,)
        x̂, the departure from the trim.
    covariance : ndarray, shape (n, n)
        Of its error.
    psi : float
        Azimuth of the next sample, radians.

    Raises
    ------
    ValueError
        If the estimator is continuous, or a shape does not fit.

    References
    ----------
    R. E. Kalman, "A new approach to linear filtering and prediction problems", Journal of
    Basic Engineering 82 (1960).

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> mass = mathieu()
    >>> estimator = periodic_kalman(
    ...     mass, np.eye(2), 1e-6 * np.eye(2), sample_time=mass.period / 16
    ... )
    >>> observer = estimator.observer()
    >>> observer.reset(psi=np.pi)
    >>> observer.step([0.0], [1.0, 0.5]).round(3).tolist()
    [1.0, 0.5]
    """

    def __init__(self, estimator, *, input_trim=None, output_trim=None):
        if not isinstance(estimator, PeriodicEstimator) or estimator.sample_time is None:
            raise ValueError(
                f"estimator={reprlib.repr(estimator)} does not run on line; give the result of "
                f"periodic_kalman(..., sample_time=...)"
            )
        self.estimator = estimator
        system, psi = estimator.system, samples_of(estimator.system, estimator.sample_time)
        self._steps = system._transition_matrices(psi)
        self._measured = system.P(psi[:-1]), system.Q(psi[:-1])
        self._input_trim = trim_samples("input_trim", input_trim, len(psi) - 1, system.input_names)
        self._output_trim = trim_samples(
            "output_trim", output_trim, len(psi) - 1, system.output_names
        )
        self.reset()

    @property
    def psi(self):
        """Azimuth of the sample that comes next, radians."""
        return float(self.estimator.gain.azimuths[self._k])

    def reset(self, x0=None, covariance=None, psi=0.0):
        """Start again before a first sample.

        Parameters
        ----------
        x0 : array_like, shape (n,), optional
            Estimate of the departure from trim at that sample, before y is known; zero by default.
            A Series is read by its names.
        covariance : array_like, shape (n, n), optional
            Covariance of its error; gains then follow from it and approach the periodic ones. By
            default the periodic gains are used from the first sample on.
        psi : float, default=0.0
            Azimuth of the first sample in radians, one of ``estimator.gain.azimuths``.

        Raises
        ------
        ValueError
            If shapes do not fit, the covariance is not one, or no sample is at ψ.
        """
        system, azimuths = self.estimator.system, self.estimator.gain.azimuths
        n, p = system.n_states, len(azimuths)
        check_numbers("finite", "it is the azimuth ψ in radians", psi=psi)
        place = psi * p / (2.0 * np.pi)
        if abs(place - round(place)) > 1e-6:
            raise ValueError(
                f"psi={psi:.6g} rad lies between the {p} samples of a period; give a multiple of "
                f"{2.0 * np.pi / p:.6g}"
            )
        x0 = check_state(x0, (), system.state_names)
        k = round(place) % p
        self._follows = covariance is not None
        if self._follows:
            start = check_weight("covariance", covariance, n, np.zeros(1), definite=False)
            self.covariance = start(np.zeros(1))[0]
        else:
            self.covariance = self.estimator.covariance.values[k]
        self._k, self._first, self.state = k, True, np.array(x0)

    def step(self, u, y):
        """States at a sample, from the inputs held since the one before and its outputs.

        Parameters
        ----------
        u : array_like, shape (m,)
            Inputs held from the last sample to this one. The first step after :meth:`reset` uses
            them only for outputs on which they act at once (Q).
        y : array_like, shape (l,), or None
            Outputs at this sample, before the inputs change; None if they are missing.

        Returns
        -------
        state : ndarray, shape (n,)
            Departure from trim at this sample, x̂.

        Raises
        ------
        ValueError
            If a shape does not fit, or a value is not finite.
        """
        system, k = self.estimator.system, self._k
        before = (k - 1) % len(self._input_trim)
        u = signals("u", u, system.input_names) - self._input_trim[before]
        if not self._first:
            Phi, Gamma = self._steps[0][before], self._steps[1][before]
            self.state = Phi @ self.state + Gamma @ u
            if self._follows:
                self.covariance = Phi @ self.covariance @ Phi.T + self.estimator.noise[before]
            else:
                self.covariance = self.estimator.covariance.values[k]
        if y is not None:
            y = signals("y", y, system.output_names) - self._output_trim[k]
            self._correct(k, u, y)
        self._k, self._first = (k + 1) % len(self._input_trim), False
        return self.state.copy()

    def _correct(self, k, u, y):
        C, D = self._measured[0][k], self._measured[1][k]
        if self._follows:
            V = self.estimator.sensor_noise[k]
            L, self.covariance = _corrected(self.covariance, C, V)
        else:
            L = self.estimator.gain.values[k]
            self.covariance = self.estimator.filtered.values[k]
        self.state = self.state + L @ (y - C @ self.state - D @ u)


class OutputFeedback:
    """Controller on line: a regulator that acts on an observer's states.

        u_k = u* − K_k x̂_k

    Parameters
    ----------
    regulator : PeriodicRegulator
        A sampled regulator, also a truncated one.
    estimator : PeriodicEstimator
        Of the same sample time, states and inputs.
    input_trim, output_trim : array_like, shapes (m,) and (l,), optional
        Or by the samples of a period, as :class:`Observer` takes them.

    Attributes
    ----------
    observer : Observer
        With its ``state``.

    Raises
    ------
    ValueError
        If regulator and estimator do not fit each other.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009.

    Examples
    --------
    >>> from sklearn_hd.design import periodic_lqr
    >>> from sklearn_hd.systems import mathieu
    >>> mass, step = mathieu(), mathieu().period / 16
    >>> regulator = periodic_lqr(mass, np.eye(2), [[1.0]], sample_time=step)
    >>> estimator = periodic_kalman(mass, np.eye(2), 0.01 * np.eye(2), sample_time=step)
    >>> controller = OutputFeedback(regulator, estimator)
    >>> controller.control([0.0, 0.0]).tolist()
    [0.0]
    """

    def __init__(self, regulator, estimator, *, input_trim=None, output_trim=None):
        if not isinstance(regulator, PeriodicRegulator) or regulator.sample_time is None:
            raise ValueError(
                f"regulator={reprlib.repr(regulator)} does not run on line; give the result of "
                f"periodic_lqr(..., sample_time=...)"
            )
        self.observer = Observer(estimator, input_trim=input_trim, output_trim=output_trim)
        mine, other = regulator.system, estimator.system
        alike = (mine.state_names, mine.input_names) == (other.state_names, other.input_names)
        if not alike or len(regulator.gain.values) != len(estimator.gain.values):
            raise ValueError(
                f"{mine!r} with {len(regulator.gain.values)} samples a period and {other!r} with "
                f"{len(estimator.gain.values)} do not fit; design regulator and estimator for the "
                f"same states, inputs and sample_time"
            )
        self.regulator = regulator
        self.reset()

    def reset(self, x0=None, covariance=None, psi=0.0):
        """Start again before a first sample.

        Parameters
        ----------
        x0 : array_like, shape (n,), optional
            Estimate, as for :meth:`Observer.reset`.
        covariance : array_like, shape (n, n), optional
            Of its error.
        psi : float, default=0.0
            Azimuth of the first sample, radians.

        Raises
        ------
        ValueError
            As for :meth:`Observer.reset`.
        """
        self.observer.reset(x0, covariance, psi)
        before = self.observer._k - 1
        self._held = self.observer._input_trim[before].copy()

    def control(self, y, applied=None):
        """Inputs from this sample on.

        Parameters
        ----------
        y : array_like, shape (l,), or None
            Outputs at this sample, before the inputs change; None if they are missing.
        applied : array_like, shape (m,), optional
            Inputs that acted since the last sample, if a limit changed those that were returned.

        Returns
        -------
        u : ndarray, shape (m,)
            To be held until the next sample, including the trim.

        Raises
        ------
        ValueError
            If a shape does not fit, or a value is not finite.
        """
        k = self.observer._k
        x = self.observer.step(self._held if applied is None else applied, y)
        self._held = self.observer._input_trim[k] - self.regulator.gain.values[k] @ x
        return self._held.copy()


def signals(name, values, names):
    values = np.atleast_1d(real_array(name, values, f"one finite value of each of {list(names)}"))
    if values.shape != (len(names),):
        raise ValueError(f"{name} has shape {values.shape}; it must hold {list(names)}")
    return values


def trim_samples(name, values, p, names):
    """Values at the p samples of a period, shape (p, n_signals)."""
    wanted = f"one value of each of {list(names)}, or one at each of the {p} samples of a period"
    values = np.zeros(len(names)) if values is None else real_array(name, values, wanted)
    if values.shape not in ((len(names),), (p, len(names))):
        raise ValueError(f"{name} has shape {values.shape}; give {wanted}")
    return np.broadcast_to(values, (p, len(names)))
