"""The frame passed between the steps, with its harmonic basis and the model so far.

A model is one of coefficients (:class:`LTIModel`) or of samples (:class:`SampleModel`).
"""

import sys
from dataclasses import dataclass, replace
from functools import cached_property

import control
import numpy as np
import pandas as pd
from scipy import linalg
from sklearn.base import TransformerMixin

from sklearn_hd.algorithms.lti.simulation import continuous_poles
from sklearn_hd.algorithms.periodic.behind_samples import behind_samples, samples_of
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import (
    OVERFLOW,
    AtSamples,
    PeriodicInnovations,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, sampled_harmonics
from sklearn_hd.algorithms.signals.trim import QUIET, TURN, changes, energy_by_turn
from sklearn_hd.exceptions import UnstableModelError
from sklearn_hd.systems import LTPSystem


@dataclass(frozen=True, eq=False)
class Lifted:
    """A Poincaré map between all samples of a period, including the motion within it.

        z[k+1] = A z[k] + B w[k],   y[k] = C z[k] + D w[k],   w[k] = (u[k] directions, 1)

    u[k] and y[k] hold the samples of period k one after another, all signals of each, trim
    subtracted. A is that of the model, its multipliers refined on all samples.
    """

    B: np.ndarray  # (n, r + 1): its last column is for a constant error of the trim
    C: np.ndarray  # (samples_per_period * n_outputs, n)
    D: np.ndarray  # (samples_per_period * n_outputs, r + 1)
    # (samples_per_period * n_inputs, r): directions in which the inputs moved at fit. Others have
    # no effect.
    directions: np.ndarray
    left: float  # share of the record's energy that it leaves, each output in parts of its scale


@dataclass(frozen=True, eq=False)
class LTIModel:
    """State-space matrices with their names, as a value that pickles and hashes."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float  # sample time in seconds; 0.0 for continuous time
    input_names: tuple  # of str
    output_names: tuple  # of str
    state_names: tuple | None = None  # tuple of str or None
    feedthrough: bool = False  # whether D was free
    # whether the outputs are coefficients as seen through the analysis window (an identified model)
    # rather than the harmonics themselves
    windowed: bool = False
    kalman_gain: np.ndarray | None = None  # (n, l): K of the innovation form, if it was identified
    innovations_covariance: np.ndarray | None = None  # (l, l)
    closed_loop: bool = False  # whether it was identified as if inputs reacted to outputs
    at_rest: bool = False  # whether A is that of free decays alone (period by period)
    # complex ndarray: multipliers of other motions in these decays: the response is not linear
    second_order: np.ndarray | tuple = ()
    opinion: object = None  # Opinion or None: its exponents as estimated in another way
    lifted: Lifted | None = None  # motion within a period, if the model is one of whole periods
    # Delays or None: delays of its signals, which the matrices do not include
    delays: object = None

    @property
    def n_states(self):
        """Number of states."""
        return len(self.A)

    def eigenvalues(self):
        """Of A."""
        return np.linalg.eigvals(self.A)

    def exponents(self):
        """Eigenvalues in continuous time, 1/s."""
        return continuous_poles(self.eigenvalues(), self.dt)

    def in_continuous_time(self, A, B, C, D, **changes):
        """The continuous-time model of some matrices between the same signals."""
        of_rows = dict.fromkeys(("kalman_gain", "innovations_covariance", "lifted"))
        matrices = {"A": A, "B": B, "C": C, "D": D}
        return replace(self, **matrices, dt=0.0, windowed=False, **of_rows, **changes)

    def to_control(self):
        """The model as a control.StateSpace with named signals.

        Of outputs alone, whose inputs are the innovations e (which have names such as e@y).
        """
        B, D, input_names = self.B, self.D, list(self.input_names)
        if not input_names:
            if self.kalman_gain is None:
                raise AttributeError(
                    "a model without inputs and without a Kalman gain cannot be written as a "
                    "control.StateSpace; fit with disturbance_model=True, or use model_.A and "
                    "model_.C"
                )
            B, D = self.kalman_gain, np.eye(len(self.C))
            input_names = [f"e@{name}" for name in self.output_names]
        names = {} if self.state_names is None else {"states": list(self.state_names)}
        return control.StateSpace(
            self.A,
            B,
            self.C,
            D,
            self.dt,
            inputs=input_names,
            outputs=list(self.output_names),
            name="identified",
            remove_useless_states=False,
            **names,
        )


class HarmonicFrame(pd.DataFrame):
    """A DataFrame that carries the harmonic basis and the model identified so far.

    Its columns are the raw inputs and their harmonic coefficients
    ``u_0, u_1c, u_1s, …``, on the user's own index. Slicing, copying and
    pickling keep both attributes; concatenation and joins drop them.

    Parameters
    ----------
    data, index, columns, dtype, copy : optional
        As for ``pandas.DataFrame``. Such a frame carries nothing yet. :class:`HarmonicAnalyzer`
        makes frames with a basis, and the model steps make frames with a model.

    Attributes
    ----------
    basis : HarmonicBasis or None
        The basis of the decomposition.
    model : LTIModel or None
        The model identified so far.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 7 (the coefficients).

    Examples
    --------
    >>> frame = HarmonicFrame({"u": [0.0, 1.0]})
    >>> frame.iloc[:1].basis is None
    True
    """

    _metadata = ["basis", "model"]  # noqa: RUF012 - the protocol of pandas
    basis = None
    model = None

    @property
    def _constructor(self):
        return HarmonicFrame

    @property
    def is_analysed(self):
        """Whether its columns are those of HarmonicAnalyzer."""
        return self.basis is not None

    @property
    def is_laden(self):
        """Whether it carries a basis or a model."""
        return self.is_analysed or self.model is not None

    @classmethod
    def attach(cls, data, basis, model):
        """A frame of some data that carries a basis and a model.

        Parameters
        ----------
        data : DataFrame
            Taken as it is, not copied.
        basis : HarmonicBasis or None
            How its coefficients were made.
        model : LTIModel or None
            The model identified so far.

        Returns
        -------
        frame : HarmonicFrame
            The same rows and columns.
        """
        _tell_dask()
        frame = cls(data, copy=False)
        frame.basis, frame.model = basis, model
        return frame


def read_as(frame, reading):
    """A frame that carries the basis of some reading, if it has that, and the columns of that."""
    basis = frame.basis
    if basis is None or basis.of_reading(reading) is basis:
        return frame
    basis = basis.of_reading(reading)
    columns = [*basis.measured, *basis.coefficient_labels]
    return HarmonicFrame.attach(frame[columns], basis, frame.model)


def _tell_dask():
    """Let dask, if it is loaded, distinguish frames also by their basis and model.

    Dask treats collections with equal parts as the same, and would continue with the frame without
    a basis that ``map_partitions(meta=...)`` was given by mistake before.
    """
    dask = sys.modules.get("dask.base")
    if dask is not None:
        dask.normalize_token.register(HarmonicFrame, _dask_token)


def _dask_token(frame):
    """Identity of a frame for dask."""
    normalize = sys.modules["dask.base"].normalize_token
    return "HarmonicFrame", normalize(pd.DataFrame(frame)), normalize((frame.basis, frame.model))


class FrameTransformer(TransformerMixin):
    """A transformer whose output carries more than its columns, so it is always a frame."""

    def fit_transform(self, X, y=None, **params):
        """Fit, then transform the same rows.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            As for ``fit``.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs), optional
            As for ``fit``.
        **params
            Handed on to ``fit``.

        Returns
        -------
        frame : HarmonicFrame
            As ``transform`` makes it.

        Raises
        ------
        ValueError
            As ``fit`` and ``transform``.
        """
        return self.fit(X, y, **params).transform(X)

    def set_output(self, *, transform=None):
        """Set the container of ``transform``: a frame, always.

        Parameters
        ----------
        transform : {"default", "pandas", None}
            All give the same. Other containers would drop the basis and the model.

        Returns
        -------
        self : estimator
            As it was.

        Raises
        ------
        ValueError
            If another container is given.
        """
        if transform not in (None, "default", "pandas"):
            raise ValueError(
                f"transform={transform!r} is not 'pandas', 'default' or None: no other container "
                f"carries the harmonic basis and the model"
            )
        return super().set_output(transform=transform)


@dataclass(frozen=True, eq=False)
class SampleModel:
    """A periodic innovations model between named signals."""

    innovations: PeriodicInnovations  # in the units of the signals, forced response included
    omega: float  # rad/s
    dt: float  # seconds from row to row
    input_names: tuple  # of str
    output_names: tuple  # of str
    feedthrough: bool = False  # whether D is free
    n_loads: int = -1  # harmonics of the forced response; −1 where there is none, not even a mean
    # (2 L + 1, m): Fourier coefficients of the inputs' periodic mean at fit; None is zero
    input_mean: np.ndarray | None = None
    # whether that is larger than the inputs' motion about it: they were given as measured
    trim_in_inputs: bool = False
    opinion: object = None  # Opinion or None: what another way has found of its exponents
    delays: object = None  # Delays or None: of its signals
    # tuple of ndarray of int, or None: whole samples of the delays of inputs and outputs, where the
    # matrices hold the rest: there are two of each input then, its new value and the old one
    split: tuple | None = None
    state_names: tuple | None = None  # tuple of str, or None
    n_harmonics: int | None = None  # that were fitted; those of the samples by default
    # (l,): how far outputs of a machine at rest may be off, root mean square over a turn: large
    # motions shift their mean
    orbit_deviation: np.ndarray | None = None

    windowed = False
    closed_loop = True  # its predictor holds, feedback or none

    @property
    def n_states(self):
        """Number of states."""
        return self.innovations.n_states

    @property
    def time_invariant(self):
        """Whether A, B, C, D and K are constant."""
        return self.innovations.n_harmonics == 0

    @property
    def kalman_gain(self):
        """K, or its Fourier coefficients where it varies."""
        gain = self.innovations.gain[: 2 * self.innovations.n_harmonics + 1]
        return gain[0] if self.time_invariant else gain

    @property
    def innovations_covariance(self):
        """Covariance of the innovations."""
        return self.innovations.covariance

    def eigenvalues(self):
        """Of A where it is constant; else the Floquet multipliers."""
        if self.time_invariant:
            return np.linalg.eigvals(self.innovations.matrices()[0][0])
        return self.innovations.multipliers()

    def exponents(self):
        """Eigenvalues in continuous time, 1/s; Floquet exponents where A varies."""
        if self.time_invariant:
            return continuous_poles(self.eigenvalues(), self.dt)
        return self.innovations.multiplier_logarithms() * self.omega / (2.0 * np.pi)

    def moving(self, inputs, psi):
        """Inputs about their periodic mean at fit, of samples at some azimuths."""
        if self.input_mean is None:
            return inputs
        return inputs - evaluate_harmonics(self.input_mean, psi)

    def forced(self, psi):
        """The forced periodic response while inputs do their mean, shape (n_samples, l)."""
        innovations, mean = self.innovations, self.input_mean
        if mean is not None:
            none = np.zeros((len(mean), len(innovations.covariance)))
            innovations = innovations.about(-mean, none).about_orbit()
        return innovations.rows(psi).outputs[..., -1]

    def outputs_at_rest(self, psi):
        """Outputs without inputs, or while they hold their trim, shape (n_samples, l)."""
        if self.trim_in_inputs:
            return self.forced(psi)
        return self.innovations.about_orbit().rows(psi).outputs[..., -1]

    def to_ltp(self):
        """The continuous model whose samples these are, as an LTPSystem.

        Its states are outputs where they determine the state, named after them; else Floquet
        coordinates (those of the discrete model where it is constant).
        """
        found = behind_samples(self.innovations, self.omega)
        return LTPSystem(
            found.F,
            found.G,
            found.P,
            found.Q,
            omega=self.omega,
            state_names=found.state_names(self.output_names),
            input_names=self.input_names,
            output_names=self.output_names,
        )

    def to_lti(self):
        """The constant matrices as an LTIModel, without the forced response."""
        A, B, C, D = (M[0] for M in self.innovations.matrices())
        names = self.input_names, self.output_names
        how = {"feedthrough": self.feedthrough, "closed_loop": True, "delays": self.delays}
        return LTIModel(A, B, C, D, self.dt, *names, **how)

    def of_matched(self, coefficients, n_states):
        """The samples of a continuous model about the forced periodic response of this one.

        ``coefficients`` (2 K + 1, n + l, n + m) are those of its [F G; P Q](ψ).
        """
        moved = samples_of(coefficients, n_states, self.omega, self.innovations.step)
        K = max(len(moved), len(self.innovations.coefficients)) // 2
        whole = resize_harmonics(np.pad(moved, [(0, 0), (0, 0), (0, 1)]), K)
        gain = np.zeros((1, n_states, whole.shape[1] - n_states))

        def at(whole):
            innovations = replace(self.innovations, coefficients=whole, gain=gain)
            return replace(self, innovations=innovations)

        psi = TURN * np.arange(4 * K + 1) / (4 * K + 1)
        loads = whole.copy()
        loads[:, n_states:, -1] = sampled_harmonics(self.forced(psi) - at(whole).forced(psi), K)
        return at(loads)

    def to_control(self):
        """The discrete model as a control.StateSpace, without its forced response."""
        if not self.time_invariant:
            raise AttributeError(
                f"the model has coefficients of up to {self.innovations.n_harmonics} harmonic(s) "
                f"of the turn, so it has no time-invariant system_; use ltp_ of MOESPRegressor or "
                f"StructuredMatcher, its harmonic_decomposition(n_harmonics), or "
                f"HarmonicAnalyzer(output_harmonics=0)"
            )
        return self.to_lti().to_control()


class SampleSimulator:
    """Free simulation of such a model over one segment, affine in its initial state."""

    def __init__(self, model, basis, drive, time, psi):
        self.model, self.basis, self.drive, self.time, self.psi = model, basis, drive, time, psi

    steps_at_samples = True

    @cached_property
    def form(self):
        """The model at the samples of the segment."""
        return self.model.innovations.rows(self.psi)

    def outputs(self, x0, *, recompose=True, n_samples=None):
        """Outputs, trim not added, of all samples or the first of them."""
        return self._checked(self.form.first(n_samples).simulated(self.drive[:n_samples], x0))

    def at_rest(self):
        """State of a machine at rest: zero, or, where inputs hold their trim, that in trim.

        The trim is what the inputs do in the first two turns if they rest there, else their
        periodic mean at fit.
        """
        model, psi, inputs = self.model, self.psi, self.model.input_mean
        if not model.trim_in_inputs:
            return np.zeros(model.n_states)
        first = psi < psi[:1] + 2.0 * TURN
        (energy,), _ = energy_by_turn([changes(self.drive, psi)], [psi])
        if not first.all() and energy[0] <= QUIET * np.mean(energy):
            functions = harmonic_functions(psi[first], range(len(inputs) // 2 + 1))
            inputs = linalg.lstsq(functions, self.drive[first])[0]
        return model.innovations.forced_state(inputs, psi[0])

    def free(self, n_samples):
        """Outputs of the first samples for each unit initial state, (n, n_samples, n_outputs)."""
        return self.form.first(n_samples).free()

    def read(self, outputs):
        """Outputs at the rows that the model steps through: all."""
        return outputs

    def n_read_within(self, stop):
        """Rows of the model before some sample."""
        return stop

    def forced(self):
        """The forced periodic response, trim not added, shape (n_samples, n_outputs)."""
        return self.model.forced(self.psi)

    def observe(self, Y, time, recompose=True):
        """The same: outputs of the model are what is measured."""
        return Y

    def at_samples(self, some=slice(None)):
        """The model at (some of) its samples, and what of it was fitted."""
        model, innovations = self.model, self.model.innovations
        count = innovations.n_harmonics if model.n_harmonics is None else model.n_harmonics
        counts = count, model.n_loads
        form = self.form if some == slice(None) else innovations.rows(self.psi[some])
        return AtSamples(
            form, self.drive[some], model.feedthrough, bool(innovations.gain.any()), *counts
        )

    def _checked(self, Y):
        if not np.max(np.abs(Y), initial=0.0) < OVERFLOW:
            innovations = self.model.innovations
            radius = np.max(np.abs(innovations.multipliers()))
            ahead = (
                "use predict_ahead, fit with stable=True or" if innovations.gain.any() else "fit"
            )
            raise UnstableModelError(
                f"the simulation overflows: the largest Floquet multiplier is {radius:.4g} (a "
                f"stable model has less than 1); {ahead} another order, or simulate a shorter span"
            )
        return Y
