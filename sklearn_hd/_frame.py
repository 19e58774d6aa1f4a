"""The frame passed between the steps, with its harmonic basis and the model so far."""

import sys
from dataclasses import dataclass, replace

import control
import numpy as np
import pandas as pd
from sklearn.base import TransformerMixin

from sklearn_hd.algorithms.lti.simulation import continuous_poles


@dataclass(frozen=True, eq=False)
class Lifted:
    """A Poincaré map between all samples of a period, including the motion within it.

        z[k+1] = A z[k] + B w[k],   y[k] = C z[k] + D w[k],   w[k] = (u[k] directions, 1)

    u[k] and y[k] hold the samples of period k one after another, all signals of each, trim
    subtracted.
    """

    A: np.ndarray  # (n, n): that of the model, its multipliers refined on all samples
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
