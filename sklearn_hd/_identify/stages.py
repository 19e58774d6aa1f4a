"""The stages of a subspace fit (Verhaegen, 1994; the paper's section 2.2), for every reading.

1. The triangular factor of the block Hankel matrices (Eq. 11): ``data.factor``.
2. The future outputs, projected and weighted, and their singular values: ``decompose``.
3. The order: ``decompose``, by the gap or as the reading chooses.
4. A and C by the shift property (Eq. 13), B, D and x0 by regression: ``fit_matrices``.
5. The noise: K and the covariance of the innovations, if requested: ``fit_matrices``.
"""

from dataclasses import dataclass, field, fields

import numpy as np

from sklearn_hd._frame import LTIModel
from sklearn_hd._identify.checks import PREDICTOR, warn_excitation
from sklearn_hd.algorithms.subspace.hankel import n_excited, n_hankel_columns
from sklearn_hd.algorithms.subspace.order import Simulated, order_by_gap
from sklearn_hd.algorithms.subspace.projections import (
    PredictorSubspace,
    Projection,
    release_idle_directions,
)


@dataclass(frozen=True)
class Settings:
    """Parameters of the subspace method, as MOESPRegressor has them."""

    order: int | str = "auto"
    block_rows: int | None = None
    weighting: str = "moesp"
    feedthrough: bool | str = "auto"
    disturbance_model: bool = False
    stable: bool = False
    scale: bool = True
    memory: object = None
    half_life: float | None = None

    @property
    def direct(self):
        """Whether D is asked to be free."""
        return self.feedthrough is True

    @property
    def predictor(self):
        """Whether the states are those of a predictor."""
        return self.weighting == PREDICTOR

    @property
    def chooses(self):
        """Whether both order and block rows are left to the data."""
        return self.order == "auto" and self.block_rows is None


@dataclass(frozen=True)
class SubspaceFit:
    """What identification finds."""

    model: LTIModel  # in the units of the signals
    x0: np.ndarray  # (n_segments, order)
    block_rows: int
    order: int
    singular_values: np.ndarray = field(default_factory=lambda: np.zeros(0))
    noise_floor: float = 0.0
    feedthrough_reason: str = ""  # why D is free, or zero
    # of Simulated: the models that the order was chosen from; none where singular values told it
    tried: tuple = ()
    # (samples_per_period, n_outputs): what the trim of the outputs is off by, where it is
    # identified together with the dynamics
    forced: np.ndarray | None = None
    # how far an exponent may be off, in parts of its rate, by the opinion that doubts most
    doubt: float = 0.0
    # of int: of products of states and inputs, beside which the model is that of small motions
    degrees: tuple = ()
    # share of the outputs' variance, about their periodic means, that a simulation leaves
    left: float = 0.0

    @property
    def order_search(self):
        """What the models tried leave, an array of each figure by its name."""
        names = [f.name for f in fields(Simulated)]
        return {name: np.array([getattr(model, name) for model in self.tried]) for name in names}


@dataclass(frozen=True)
class Decomposition:
    """The future outputs, decomposed with some block rows."""

    found: Projection | PredictorSubspace
    block_rows: int
    order: int
    singular_values: np.ndarray  # in the units of the outputs; canonical correlations have none
    noise_floor: float


def decompose(data, block_rows, size, settings, choose=None):
    """Project the future outputs and choose the order.

    Parameters
    ----------
    data : Records, Summed or Partitions
    block_rows : int
    size : ndarray, shape (n_inputs + n_outputs,)
        What the channels are divided by.
    settings : Settings
    choose : callable, optional
        ``choose(found, bound)`` gives the order; the gap of the singular values by default.
    """
    columns, m = n_hankel_columns(data.lengths, block_rows), data.n_inputs
    lifted = data.facts.basis.reading == "period"
    counted = data.raw and not lifted
    feedthrough = settings.direct or lifted

    def project():
        R = data.factor(block_rows, size)
        excited = n_excited(R, block_rows, m) if counted else None
        if settings.predictor:
            return PredictorSubspace.of(R, block_rows, m, columns, feedthrough), excited
        if m > 0:
            R = release_idle_directions(R, block_rows * m)
        return Projection.of(R, block_rows, m, columns, settings.weighting), excited

    found, excited = data.projection(
        project, size, block_rows, settings.weighting, feedthrough, lifted, counted
    )
    if counted:
        n_moving = int(data.facts.moving.sum())
        warn_excitation(excited, block_rows, n_moving, data.facts.span())
    unit, y_size = 1.0, size[m:]
    if settings.weighting != "cva":
        unit = y_size.max() * np.sqrt(np.mean((y_size / y_size.max()) ** 2))
    order, bound = settings.order, (block_rows - 1) * data.n_outputs
    if order == "auto":
        order = (choose or by_gap)(found, bound)
    values, floor = found.singular_values * unit, found.floor * unit
    return Decomposition(found, block_rows, int(order), values, floor)


def by_gap(found, bound):
    """The order by which singular values stand above the noise floor."""
    return order_by_gap(found.singular_values, found.floor, bound)


def fit_matrices(data, decomposition, size, scales, settings, feedthrough):
    """A, B, C, D, the noise (K and the innovations' covariance, or None) and initial states."""
    found, order = decomposition.found, decomposition.order
    if settings.predictor:
        A, B, C, D, K, covariance = found.model(order, settings.stable)
        own = size[: data.n_inputs], scales[1]
        x0 = data.initial_states(A, B, C, D, K, covariance, own)
        if data.raw:
            B, D = (_of_all_inputs(M, data.facts.moving) for M in (B, D))
        return (A, B, C, D), (K, covariance), x0
    A, C = found.state_matrices(order, settings.stable)
    B, D, x0 = data.input_matrices(A, C, feedthrough, scales)
    noise = found.kalman_gain(order, settings.stable) if settings.disturbance_model else None
    return (A, B, C, D), noise, x0


def _of_all_inputs(M, moving):
    """Columns of the inputs that move, where sums leave the others out, among those of all."""
    if M.shape[1] == len(moving):
        return M
    whole = np.zeros((len(M), len(moving)))
    whole[:, moving] = M
    return whole


def subspace_fit(decomposition, fitted, scales, facts, settings, feedthrough, **choice):
    """The frozen result, its model in the units of the signals, and how it was chosen."""
    ((A, B, C, D), noise, x0), (u_scale, y_scale) = fitted, scales
    K = covariance = None
    if noise is not None:
        K, covariance = noise
        K, covariance = K / y_scale, covariance * y_scale[:, None] * y_scale
    model = LTIModel(
        A=A,
        B=B / u_scale,
        C=C * y_scale[:, None],
        D=D * (y_scale[:, None] / u_scale),
        dt=facts.sample_time * facts.basis.hop,
        input_names=facts.basis.drive_labels,
        output_names=facts.basis.output_labels,
        feedthrough=feedthrough,
        windowed=facts.basis.harmonic,
        kalman_gain=K,
        innovations_covariance=covariance,
        closed_loop=settings.predictor,
    )
    found = decomposition
    values, floor = found.singular_values, found.noise_floor
    return SubspaceFit(model, x0, found.block_rows, found.order, values, floor, **choice)
