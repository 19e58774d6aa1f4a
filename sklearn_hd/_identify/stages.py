"""The stages of a subspace fit (Verhaegen, 1994; the paper's section 2.2), for every reading.

1. The triangular factor of the block Hankel matrices (Eq. 11): ``data.factor``.
2. The future outputs, projected and weighted, and their singular values: ``decompose``.
3. The order: ``decompose``, by the gap or as the reading chooses.
4. A and C by the shift property (Eq. 13), B, D and x0 by regression: ``fit_matrices``.
5. The noise: K and the covariance of the innovations, if requested: ``fit_matrices``.

And what they ask of block rows, order and weighting, and of samples and their model.
"""

from dataclasses import dataclass, field, fields, replace

import numpy as np

from sklearn_hd._checks import (
    STANDARD_ERRORS,
    check_choice,
    check_count,
    check_flag,
    check_positive,
)
from sklearn_hd._fit_checks import grows_by
from sklearn_hd._frame import LTIModel
from sklearn_hd._guards import warn
from sklearn_hd._identify.products_cache import KeptSums
from sklearn_hd.algorithms.linalg.rounding import EXACT, OVERFLOW
from sklearn_hd.algorithms.lti.simulation import GROWN
from sklearn_hd.algorithms.periodic.periodic_predictor import SENSOR_NOISE
from sklearn_hd.algorithms.signals.fourier import ROWS_PER_COLUMN, harmonic_labels
from sklearn_hd.algorithms.subspace.hankel import n_excited, n_hankel_columns
from sklearn_hd.algorithms.subspace.order import Simulated, order_by_gap
from sklearn_hd.algorithms.subspace.projections import (
    PROJECTIONS,
    PredictorSubspace,
    Projection,
    release_idle_directions,
    rows_remembered,
)
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning, InstabilityWarning

DEFAULT_BLOCK_ROWS = 15
PREDICTOR = "pbsid"
MOST_PREDICTOR_ROWS = 60
ROWS_BEYOND = 2  # so that order="auto" has room above the order that noise-free data show
WEIGHTINGS = (*PROJECTIONS, PREDICTOR)
NOTHING = 1e-6  # share of an input beside its forced mean, below which it moves with the turn alone


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

    ``data`` are Records, Summed or Partitions, whose channels are divided by ``size``
    (n_inputs + n_outputs,). ``choose(found, bound)`` gives the order; the gap of the
    singular values does by default.
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
        warn_excitation(excited, block_rows, n_moving, data.facts.span)
    unit, y_size = 1.0, size[m:]
    if settings.weighting != "cva":
        unit = y_size.max() * np.sqrt(np.mean((y_size / y_size.max()) ** 2))
    order, bound = settings.order, (block_rows - 1) * _n_counted_outputs(data)
    if order == "auto":
        order = (choose or by_gap)(found, bound)
    values, floor = found.singular_values * unit, found.floor * unit
    return Decomposition(found, block_rows, int(order), values, floor)


def _n_counted_outputs(data):
    """How many outputs count: where periods are read, coefficients of measured ones that move.

    At least one, for checks of lengths that come before those of motion.
    """
    basis, moves = data.facts.basis, data.facts.outputs_move
    if basis.reading != "period":
        return data.n_outputs
    counts = [len(harmonic_labels(orders)) for _, orders in basis.outputs]
    return max(1, int(np.sum(counts, where=moves)))


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


def checked(settings):
    """The settings, flags as bool, memory opened; ValueError for one that is not understood."""
    if not isinstance(settings.order, str):
        check_count("order", settings.order, 1, "'auto' chooses it")
    elif settings.order != "auto":
        raise ValueError(f"order={settings.order!r} is not known; give a whole number or 'auto'")
    check_choice("weighting", settings.weighting, WEIGHTINGS)
    if settings.block_rows is not None:
        check_count("block_rows", settings.block_rows, 2, "None chooses them")
    if settings.half_life is not None and settings.half_life != np.inf:
        hint = "partial_fit then forgets old rows; None or infinity forgets nothing"
        check_positive("half_life", settings.half_life, "periods, or seconds", hint)
    free = settings.feedthrough
    if not (isinstance(free, bool | np.bool_) or (isinstance(free, str) and free == "auto")):
        raise ValueError(f"feedthrough must be True, False or 'auto', got {free!r}")
    kept = None if settings.memory is None else KeptSums(settings.memory)
    free = free if isinstance(free, str) else bool(free)
    settings = replace(settings, feedthrough=free, memory=kept)
    flags = ("disturbance_model", "scale", "stable")
    return replace(settings, **{name: check_flag(name, getattr(settings, name)) for name in flags})


def check_rank_bound(order, block_rows, n_outputs):
    """Raise ValueError if block rows do not have the rank that an order asks for."""
    bound = (block_rows - 1) * n_outputs
    if order != "auto" and order > bound:
        raise ValueError(
            f"order={order} exceeds the rank bound {bound} of block_rows="
            f"{block_rows} with {n_outputs} output columns; lower order or raise block_rows"
        )


def fewer_block_rows(asked, least, lengths, n_channels):
    """Block rows asked for by default, or fewer where the record is short."""
    i = asked
    while i > least and n_hankel_columns(lengths, i) < 2 * i * n_channels:
        i -= 1
    return i


def allowed_block_rows(settings, data, asked, *, least=2, words=None):
    """Block rows that the order and the record allow.

    ``asked`` are the block rows given, or the default of the reading, which needs
    ``least``. ``words`` say what a row and a channel are called, and the way out.
    """
    i, n_inputs, n_outputs = asked, data.n_inputs, _n_counted_outputs(data)
    if settings.block_rows is None:
        if settings.order != "auto":
            rank = 1 + int(np.ceil(settings.order / n_outputs))
            least = min(asked, max(least, rank))
        i = fewer_block_rows(asked, least, data.lengths, n_inputs + n_outputs)
    check_rank_bound(settings.order, i, n_outputs)
    # the future inputs, i m rows, are projected out of j = n_rows − 2 i + 1 columns
    n_projected = n_inputs + (n_outputs if settings.predictor else 0)
    need = i * n_projected + 1 + (1 if settings.order == "auto" else int(settings.order))
    if n_hankel_columns(data.lengths, i) < need:
        unit, moving, way_out = words or (
            "row",
            "input(s)",
            "use a longer record, fewer block rows or a smaller hop",
        )
        rows = f"{sum(data.lengths)} {unit}(s) (n_samples = {data.facts.n_samples})"
        raise ValueError(
            f"the {data.facts.span} give {rows}, which are too few for block_rows={i}: at least "
            f"{need + 2 * i - 1} consecutive {unit}s are needed with {n_inputs} "
            f"{moving}{data.facts.why_short}; {way_out}"
        )
    return i


def warn_of_feedback(words):
    """Warn that D is zero though inputs act at once: a feedback within the row looks the same."""
    warn(
        f"{words}; this can be a feedthrough or a feedback within the row, which look alike, so D "
        f"is zero; if no feedback acts within a row, use feedthrough=True",
        IdentifiabilityWarning,
    )


def warn_excitation(excited, block_rows, n_moving, span):
    """Warn of Hankel matrices of deficient rank."""
    need = 2 * block_rows * n_moving
    if excited < need:
        warn(
            f"the inputs in the {span} excite {excited} directions, but block_rows={block_rows} "
            f"with {n_moving} input(s) needs {need}; use a richer input or fewer block rows, and "
            f"check the order with care",
            ExcitationWarning,
        )


def rows_of_predictor(data, first, size, settings):
    """Block rows after which the predictor has forgotten its state, and the order fits in.

    Beyond the directions that the inputs excite there are many predictors, whose states are no
    one's.

    ``first`` are those of the shortest predictor tried.
    """
    n_inputs, n_outputs, lengths = data.n_inputs, data.n_outputs, data.lengths
    lifted = data.facts.basis.reading == "period"  # inputs act at once, all directions excited
    most = first
    longest = min(MOST_PREDICTOR_ROWS, data.most_block_rows)
    while most < longest and n_hankel_columns(lengths, most + 1) >= (
        10 * (most + 1) * (n_inputs + n_outputs)  # for each coefficient
    ):
        most += 1
    R = data.factor(most, size)
    if not lifted and n_inputs:
        excited = n_excited(R, most, n_inputs)
        if excited < 2 * most * n_inputs:
            most = max(2, excited // (2 * n_inputs))
            warn(
                f"the inputs excite only {excited} directions, so a predictor can use at most "
                f"{most} past rows: dynamics that last longer are lost; use a richer input",
                ExcitationWarning,
            )
            R = data.factor(most, size)
    columns = n_hankel_columns(lengths, most)
    order = 1 if settings.order == "auto" else int(settings.order)
    rows = rows_remembered(R, most, n_inputs, columns, settings.direct or lifted)
    rows = min(most, max(rows, -(-order // n_outputs)) + ROWS_BEYOND)
    check_rank_bound(settings.order, rows, n_outputs)
    return rows


def root_mean_square(signals):
    """Of some signals of all segments."""
    return np.sqrt(np.mean(np.vstack(signals) ** 2, axis=0))


def check_turns(experiment):
    """Raise ValueError if the record is no turn long, where anything may depend on the turn."""
    basis = experiment.basis
    turns = sum(len(y) for y in experiment.outputs) / basis.samples_per_period
    if turns < 1.0 and (basis.most_loads or basis.n_harmonics != 0):
        raise ValueError(
            f"the {experiment.span()} cover only {turns:.3g} of a turn (omega={basis.omega:.4g} "
            f"rad/s), so nothing repeats itself; check omega, use a longer record, or give "
            f"output_harmonics=0 and load_harmonics=0 in HarmonicAnalyzer{or_hop(basis)}"
        )


def or_hop(basis):
    """A smaller hop as a way out, where rows were left out."""
    return f", or hop below {basis.hop}" if basis.hop > 1 else ""


def check_outputs_move(still, facts):
    """Raise ValueError if outputs repeat themselves with every turn; warn of those that do."""
    names = [name for name, rests in zip(facts.output_names, still, strict=True) if rests]
    if len(names) == len(still):
        raise ValueError(
            f"the outputs {names} repeat themselves with every turn in the {facts.span}: there "
            f"is no response to inputs to identify; check the columns of y, subtract offsets "
            f"beside which rounding hides their motion, or use a record in which inputs move them"
        )
    if names:
        warn(
            f"the outputs {names} repeat themselves with every turn in the {facts.span}: no "
            f"input moves them (or rounding hides it: subtract large offsets), so their model is "
            f"only their loads",
            IdentifiabilityWarning,
        )


def check_told_from_loads(waves, left, experiment):
    """Raise ValueError if an input does the same at every turn: then loads look the same.

    ``waves`` (n, m) is the mean turn of the inputs, as measured, and ``left`` (m,) are
    root mean squares of the inputs beside it.
    """
    constant = waves.mean(axis=0)
    varies = np.sqrt(np.mean((waves - constant) ** 2, axis=0))
    # times that are rounded move what varies within a turn, not a constant
    least, size = np.maximum(NOTHING * varies, EXACT * np.abs(constant)), np.hypot(varies, constant)
    way = "or drop it"
    if experiment.basis.reading == "sample":
        way = "drop it, subtract its rest value, or give load_harmonics below those of the input"
    for k, name in enumerate(experiment.basis.input_signals):
        if size[k] > 0.0 and left[k] <= least[k]:
            raise ValueError(
                f"input {name!r} repeats itself with every turn in the {experiment.span()} (except "
                f"for {left[k] / size[k]:.2g} of its size), so its effect cannot be separated from "
                f"periodic loads; use a record in which it changes from turn to turn, {way}"
            )


def warn_of_little(layout, n_rows, best, basis):
    """Of a record too short for its predictor, and of a model that explains nothing."""
    if n_rows < ROWS_PER_COLUMN * layout.n_columns:
        warn(
            f"{n_rows} rows determine {layout.n_columns} coefficients of the predictor of each "
            f"output ({layout.n_lags} lags, {layout.n_harmonics} harmonic(s), loads of "
            f"{layout.n_loads}): with fewer than {ROWS_PER_COLUMN} rows for each the model is "
            f"largely noise; use a longer record, or reduce block_rows, output_harmonics or "
            f"load_harmonics{or_hop(basis)}",
            IdentifiabilityWarning,
        )
    if best.bic >= 0.0:  # which loads alone have
        warn(
            f"no model explains the outputs better than their loads alone (by Schwarz's "
            f"criterion): the simulation of the best one leaves {best.variance:.3g} times "
            f"their variance about the forced periodic response; check that outputs follow "
            f"inputs, that omega (or the azimuth) is that of the machine, and that {n_rows} rows "
            f"are enough for order {best.order} with {best.n_harmonics} harmonic(s)",
            IdentifiabilityWarning,
        )


def why_no_noise(segments, innovations, predictor, covariance=None):
    """Why what predictions leave is no noise: so much more than the predictor they come from.

    The predictor knows more coefficients. By Schwarz's criterion it is the better model all the
    same where states, order or harmonics have lost what it knew. Of a predictor that knows fewer,
    the difference has to be beyond chance.

    Segments are (inputs, outputs, psi). ``covariance`` is that of what products of
    states and inputs leave, where these are further inputs. The words are empty where
    nothing speaks against the model.
    """
    layout, n = predictor.layout, innovations.n_states
    if sum(len(y) for _, y, _ in segments) < ROWS_PER_COLUMN * layout.n_columns:
        return ""  # the predictor itself is noise
    m, n_outputs = layout.n_inputs, layout.n_outputs
    left, first = [], slice(0, 4 * layout.n_lags)
    for u, y, psi in segments:
        rows = innovations.rows(psi)
        x0 = rows.initial_state(u[first], y[first], innovations.covariance)
        left.append(rows.innovations(u, y, x0)[1])
    n_rows = sum(map(len, left))
    if not all(np.max(np.abs(e), initial=0.0) < OVERFLOW for e in left):
        return ""  # an InstabilityWarning says so
    covariance = sum(e.T @ e for e in left) / n_rows if covariance is None else covariance
    floor = SENSOR_NOISE**2 * np.eye(n_outputs)
    own, its = (np.linalg.slogdet(M + floor)[1] for M in (covariance, predictor.covariance))
    more = own - its
    spent = (n * (2 * n_outputs + m) + layout.feedthrough * n_outputs * m) * layout.n_functions
    saved = n_outputs * (layout.n_columns - 2 * layout.n_loads - 1) - spent
    if not n_rows * more > max(saved * np.log(n_rows), STANDARD_ERRORS**2):
        return ""
    return (
        f"the model's residuals are not noise: its one-step predictions leave "
        f"{np.exp(more / n_outputs):.3g} times the variance that its own starting predictor "
        f"({layout.n_lags} lags) leaves; states are missing or inaccurate: raise order=, change "
        f"the number of harmonics or block_rows, and see residual_tests"
    )


def warn_of_growth(model, best, data, settings):
    """Of a model that grows e-fold over the longest segment."""
    if best.stable:
        return
    radius = np.max(np.abs(model.innovations.multipliers()))
    turns = data.longest * data.step / (2.0 * np.pi)
    folds = turns * np.log(max(radius, 1e-300))
    if folds < GROWN:
        return
    way_out = "stable=True where the machine is stable, or another order"
    if best.feedthrough and settings.feedthrough == "auto":  # feedback looks the same
        way_out = f"weighting='pbsid' if feedback held it (D may be that feedback), {way_out}"
    warn(
        f"the model has a Floquet multiplier of size {radius:.4g}, so it "
        f"{grows_by(folds)} over the longest segment ({turns:.4g} turns): predict "
        f"overflows, or leaves the record where feedback held the machine; use predict_ahead "
        f"there, {way_out}",
        InstabilityWarning,
    )
