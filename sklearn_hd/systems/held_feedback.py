"""Feedback once per period, which stabilises a machine while it is measured."""

import reprlib
from typing import NamedTuple

import control
import numpy as np

from sklearn_hd._checks import check_count, real_array
from sklearn_hd.algorithms.periodic.integration import runge_kutta
from sklearn_hd.systems.arguments import check_names
from sklearn_hd.systems.periodic import PeriodicSystem, Trim


class HeldFeedback:
    """Periodic system whose inputs are set once per period, from the means of the last one.

        u_k = u* + v_k − K (ȳ_{k−1} − ȳ*)

    ȳ_k is the mean of the measured outputs over period k, sample by sample, and v_k is what
    excites the machine in it. u* and ȳ* are those of the trim.

    Parameters
    ----------
    system : PeriodicSystem
        The system under feedback; it may be unstable.
    trim : Trim
        Its periodic solution (u*, and the means ȳ*).
    gain : array_like, shape (m, l), optional
        K. By default the gain of the best quadratic regulator of the linear period map, from
        ``state_sizes`` and ``input_sizes``, as if the means were the state at the beginning of a
        period; the outputs must then be the states.
    inputs : sequence of str, optional
        The m inputs that the feedback sets; the others are disturbances. By default all.
    state_sizes, input_sizes : array_like, optional
        Departures with equal weight in the regulator, array of floats of shape (n,) and (m,). By
        default 1.
    samples_per_period : int, default=64
        Rows of one period.

    Attributes
    ----------
    gain : ndarray, shape (m, l)
        K.
    disturbances : tuple of str
        Names of the inputs that the feedback does not set.

    Raises
    ------
    ValueError
        If names or shapes do not fit, or the regulator does not stabilise the system.

    References
    ----------
    G. F. Franklin, J. D. Powell, M. L. Workman, *Digital Control of Dynamic Systems*,
    3rd edition, 1998.

    Examples
    --------
    A hawkmoth cannot hover without it:

    >>> from sklearn_hd.systems import hawkmoth
    >>> moth = hawkmoth()
    >>> loop = HeldFeedback(
    ...     moth, moth.trim(), state_sizes=[0.3, 0.1, 5.0, 0.2], input_sizes=[0.06, 0.02]
    ... )
    >>> bool(np.max(np.abs(loop.multipliers())) < 0.95)
    True
    >>> u, y = loop.simulate(np.zeros((3, 2)))
    >>> u.shape, y.shape
    ((192, 2), (192, 4))
    """

    def __init__(
        self,
        system,
        trim,
        gain=None,
        *,
        inputs=None,
        state_sizes=None,
        input_sizes=None,
        samples_per_period=64,
    ):
        if not isinstance(system, PeriodicSystem) or not isinstance(trim, Trim):
            raise ValueError(
                f"system={reprlib.repr(system)} and trim={reprlib.repr(trim)} must be a "
                f"PeriodicSystem and the result of its trim()"
            )
        self.system, self.trim = system, trim
        self.samples_per_period = check_count(
            "samples_per_period", samples_per_period, 2, "64 resolve a wingbeat"
        )
        names = system.input_names
        inputs = check_names(names if inputs is None else inputs, "inputs")
        unknown = [name for name in inputs if name not in names]
        if unknown or not inputs:
            raise ValueError(f"inputs={list(inputs)} must be among those of the system, {names}")
        self.inputs = inputs
        self.disturbances = tuple(name for name in names if name not in inputs)
        self._fed = [names.index(name) for name in inputs]
        self._disturbed = [names.index(name) for name in self.disturbances]
        self._plant = self._period_map()
        self.gain = self._gain(gain, state_sizes, input_sizes)
        self._means = self.trim_samples().mean(axis=0)

    def multipliers(self):
        """Multipliers of the linear closed loop over a period.

        Returns
        -------
        multipliers : complex ndarray, shape (n + l,)
            Of the state and of the means that are fed back, the largest first. They lie inside the
            unit circle if small departures from the trim die out.
        """
        values = np.linalg.eigvals(self._plant.closed_loop(self.gain))
        return values[np.argsort(-np.abs(values))]

    def trim_samples(self):
        """Outputs of the trim at the samples of one period.

        Returns
        -------
        outputs : ndarray, shape (samples_per_period, l)
            Their mean is ȳ*.
        """
        S = self.samples_per_period
        psi = 2.0 * np.pi * np.arange(S) / S
        u = np.tile(self.trim.inputs[:, None], S)
        return self._outputs(self.trim.states(psi).T, u, psi / self.system.omega)

    def simulate(self, v, *, disturbances=None, noise=None, substeps=2):
        """Records of the closed loop, from the trim.

        Parameters
        ----------
        v : array_like, shape (n_periods, m) or (n_records, n_periods, m)
            Added to the inputs that the feedback sets, period by period.
        disturbances : array_like, shape (..., n_samples, d), optional
            Values of the other inputs about their trim, held from sample to sample.
        noise : array_like, shape (..., n_samples, l), optional
            Noise of the sensors: in the outputs returned and in what is fed back.
        substeps : int, default=2
            Runge-Kutta steps from sample to sample.

        Returns
        -------
        u : ndarray, shape (..., n_samples, n_inputs)
            All inputs of the system, including the trim.
        y : ndarray, shape (..., n_samples, l)
            Outputs as measured.

        Raises
        ------
        ValueError
            If shapes do not fit.
        RuntimeError
            If a record diverges; the message gives the period.
        """
        v = real_array("v", v, f"one value of each of {list(self.inputs)} for each period")
        if v.ndim not in (2, 3) or v.shape[-1] != len(self.inputs):
            raise ValueError(
                f"v has shape {v.shape}; it must be (n_periods, {len(self.inputs)}) or "
                f"(n_records, n_periods, {len(self.inputs)})"
            )
        substeps = check_count("substeps", substeps, 1, "2 are usual")
        n_samples = v.shape[-2] * self.samples_per_period
        d = self._signals("disturbances", disturbances, v, n_samples, self.disturbances)
        e = self._signals("noise", noise, v, n_samples, self.system.output_names)
        one_record = v.ndim == 2
        with np.errstate(over="ignore", invalid="ignore"):
            u, y = self._run(v[None] if one_record else v, d, e, substeps)
        return (u[0], y[0]) if one_record else (u, y)

    def _run(self, v, d, e, substeps):
        n_records, n_periods, S = len(v), v.shape[1], self.samples_per_period
        u = np.empty((n_records, n_periods * S, self.system.n_inputs))
        y = np.empty((n_records, n_periods * S, self.system.n_outputs))
        x = np.tile(self.trim.initial_state[:, None], n_records)
        means = np.tile(self._means, (n_records, 1))
        for k in range(n_periods):
            rows = slice(k * S, (k + 1) * S)
            u[:, rows] = self.trim.inputs
            fed = v[:, k] - (means - self._means) @ self.gain.T
            u[:, rows, self._fed] += fed[:, None]
            u[:, rows, self._disturbed] += d[:, rows]
            x, y[:, rows] = self._period(x, u[:, rows], e[:, rows], substeps)
            means = y[:, rows].mean(axis=1)
            if not np.all(np.isfinite(means)):
                raise RuntimeError(
                    f"the closed loop diverged in period {k} of {n_periods}; excite or disturb it "
                    f"less, or change the gain: its largest multiplier is "
                    f"{np.abs(self.multipliers()[0]):.3g}"
                )
        return u, y

    def _period(self, x, u, e, substeps):
        """State after a period, and the outputs measured in it."""
        step = self.system.period / self.samples_per_period
        y = np.empty_like(e)
        for s in range(self.samples_per_period):
            held, t = u[:, s].T, s * step
            y[:, s] = self._outputs(x, held, np.full(x.shape[1], t)) + e[:, s]
            x = runge_kutta(self.system.f, x, held, t, step / substeps, substeps)
        return x, y

    def _outputs(self, x, u, t):
        return (x if self.system.g is None else np.asarray(self.system.g(x, u, t))).T

    def _period_map(self):
        ltp, S = self.system.linearize(self.trim), self.samples_per_period
        n, m = ltp.n_states, len(self._fed)
        t = ltp.period * np.arange(S + 1) / S
        x0 = np.concatenate([np.eye(n), np.zeros((m, n))])
        u = np.zeros((n + m, S + 1, ltp.n_inputs))
        u[range(n, n + m), :, self._fed] = 1.0
        y, x = ltp.simulate(u, t, x0, return_states=True)
        after, means = x[:, -1].T, y[:, :-1].mean(axis=1).T
        return PeriodMap(after[:, :n], after[:, n:], means[:, :n], means[:, n:])

    def _gain(self, gain, state_sizes, input_sizes):
        m, n, n_outputs = len(self.inputs), self.system.n_states, self.system.n_outputs
        if gain is not None:
            gain = np.array(real_array("gain", gain, f"a matrix {m} x {n_outputs}"))
            if gain.shape != (m, n_outputs):
                raise ValueError(f"gain has shape {gain.shape}; it must be ({m}, {n_outputs})")
            return gain
        if self.system.g is not None:
            raise ValueError(
                "gain=None assumes that the outputs are the states, but this system has its own "
                "outputs (g); give a gain"
            )
        gain = quadratic_gain(
            self._plant,
            _sizes("state_sizes", state_sizes, n),
            _sizes("input_sizes", input_sizes, m),
        )
        largest = np.abs(np.linalg.eigvals(self._plant.closed_loop(gain))).max()
        if largest >= 1.0:
            raise ValueError(
                f"the regulator leaves a multiplier of size {largest:.3g}, because it reads period "
                f"means, which are older than the state that it was designed for; change "
                f"state_sizes or input_sizes, or give a gain"
            )
        return gain

    def _signals(self, name, values, v, n_samples, signals):
        """Given signals as (n_records, n_samples, …), zero by default."""
        n_records = 1 if v.ndim == 2 else len(v)
        shape = (n_records, n_samples, len(signals))
        if values is None:
            return np.zeros(shape)
        values = real_array(name, values, f"finite samples of {list(signals)}")
        wanted = shape if v.ndim == 3 else shape[1:]
        if values.shape != wanted:
            raise ValueError(f"{name} has shape {values.shape}; with this v it must be {wanted}")
        return values.reshape(shape)


def _sizes(name, sizes, count):
    sizes = np.ones(count) if sizes is None else real_array(name, sizes, f"{count} positive sizes")
    if sizes.shape != (count,) or not np.all(sizes > 0):
        raise ValueError(f"{name}={reprlib.repr(sizes)} must hold {count} positive sizes")
    return sizes


class PeriodMap(NamedTuple):
    """Map from period to period, including the means of the outputs.

    x_{k+1} = Φ x_k + Γ u_k,   ȳ_k = M x_k + N u_k
    """

    Phi: np.ndarray
    Gamma: np.ndarray
    M: np.ndarray
    N: np.ndarray

    def closed_loop(self, K):
        """Map of (x_k, ȳ_{k−1}) under u_k = −K ȳ_{k−1}; its eigenvalues are the multipliers."""
        return np.block([[self.Phi, -self.Gamma @ K], [self.M, -self.N @ K]])


def quadratic_gain(plant, state_sizes, input_sizes):
    """Gain K of u_k = −K x_k that is best for the sum of squares of x and u, over their sizes.

    From the stabilising solution of the discrete algebraic Riccati equation; sizes are
    departures that count alike (Bryson, Ho, *Applied Optimal Control*, 1975).

    Examples
    --------
    >>> plant = PeriodMap(*np.array([[[1.2]], [[1.0]], [[1.0]], [[0.0]]]))
    >>> K = quadratic_gain(plant, [1.0], [0.01])  # dear inputs: the pole goes to 1 / 1.2
    >>> print(f"{1.2 - K[0, 0]:.2f}")
    0.83
    """
    Q = np.diag(np.asarray(state_sizes, dtype=float) ** -2.0)
    R = np.diag(np.asarray(input_sizes, dtype=float) ** -2.0)
    try:
        return control.dlqr(plant.Phi, plant.Gamma, Q, R, method="scipy")[0]
    except ValueError as error:  # LinAlgError, or pencils too ill-conditioned to be ordered
        raise ValueError(
            f"no gain stabilises the period map ({error}); perhaps the inputs do not reach an "
            f"unstable mode"
        ) from error
