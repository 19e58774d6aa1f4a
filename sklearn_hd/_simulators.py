"""Simulation and prediction of a model over one segment, from the state that a user may give.

Comparison in scores: measured and simulated outputs on the rows that count, with weights.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
from scipy import linalg
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import RAISE, check_weight
from sklearn_hd._containers import without_inputs
from sklearn_hd._excitation import warn_of_another_orbit
from sklearn_hd._frame import SampleSimulator
from sklearn_hd._guards import extremes, warn
from sklearn_hd._readings import highest_harmonic
from sklearn_hd._records.delays import both_values, leads
from sklearn_hd._records.sampling import joined
from sklearn_hd.algorithms.linalg.rounding import EXACT, RANK
from sklearn_hd.algorithms.linalg.triangular import solve_within_rank
from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, propagate, simulate
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import AtSamples
from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.algorithms.signals.resampling import late
from sklearn_hd.algorithms.subspace.innovations import InnovationForm
from sklearn_hd.exceptions import InstabilityWarning, UnstableModelError

WARMUP_SHARE = 0.25  # of a segment, at most
MOST_SCORED = 1e60  # times the measured outputs: a score is their square, its spread its square


class SegmentSimulator:
    """Free simulation of a model over one segment, linear in its initial state.

    A continuous model steps at the data's own sample time. A discrete model steps from one row
    that its reading reads to the next.
    """

    def __init__(self, model, basis, drive, time, sample_time):
        self.model, self.basis, self.time = model, basis, time
        self.drive, self.rows = drive, None
        self.A, self.B = model.A, model.B
        if model.dt == 0.0:
            self.A, self.B = continuous_to_discrete(model.A, model.B, sample_time)
        else:
            self.rows = basis.simulated_rows(time)
        if self.rows is not None:
            self.drive = basis.held_drive(drive, self.rows)

    @property
    def steps_at_samples(self):
        """Whether the model is one of samples, not of whole windows or periods."""
        return self.rows is None

    @property
    def form(self):
        """The innovation form of the model."""
        model = self.model
        return InnovationForm(model.A, model.B, model.C, model.D, model.kalman_gain)

    def read(self, outputs):
        """Outputs at the rows that the model steps through."""
        return self.basis.outputs_read(outputs, self.time)

    def n_read_within(self, stop):
        """Rows of the model whose samples all lie before some sample."""
        return self.basis.n_read_within(self.time, stop)

    def at_rest(self):
        """State of a machine at rest: zero, as inputs and outputs are."""
        return np.zeros(self.model.n_states)

    def forced(self):
        """Outputs without inputs and states, trim not added: none."""
        return np.zeros((len(self.time), 1))

    def at_samples(self, some=slice(None)):
        """The model at (some) samples, whose outputs are what is measured."""
        if self.rows is not None:
            raise ValueError(
                f"this model describes whole windows or periods (reading={self.basis.reading!r}), "
                f"and their noise correlates the residuals, too; test a model of samples instead: "
                f"put SpuriousModeReducer or StructuredMatcher behind it"
            )
        R = self.basis.recomposition(self.basis.azimuth(self.time[some]))
        kept = highest_harmonic(self.basis.outputs) if self.basis.harmonic else 0
        model = self.model
        matrices = self.A, self.B, R @ model.C, R @ model.D, model.kalman_gain
        return AtSamples.of(*matrices, self.drive[some], kept)

    def outputs(self, x0, *, recompose=True, n_samples=None):
        """Outputs, or their harmonics, trim not added, of all samples or the first of them."""
        time = self.time[:n_samples]
        drive = self.drive[: self._n_steps(len(time))]
        Y = self._finite(simulate(self.A, self.B, self.model.C, self.model.D, drive, x0))
        return self.observe(Y, time, recompose)

    def free(self, n_samples):
        """Outputs of the first samples for each unit initial state, (n, n_samples, n_outputs)."""
        n, steps = self.model.n_states, self._n_steps(n_samples)
        states = propagate(self.A, np.zeros((n, steps, n)), np.eye(n))
        return self.observe(states @ self.model.C.T, self.time[:n_samples])

    def _finite(self, Y):
        """Outputs simulated, UnstableModelError where they overflow."""
        if np.isfinite(Y).all():
            return Y
        radius = np.max(np.abs(np.linalg.eigvals(self.A)))
        raise UnstableModelError(
            f"the simulation overflows: the model has a pole of size {radius:.4g} (a stable model "
            f"has less than 1) at its sample time; drop it (SpuriousModeReducer), lower the order, "
            f"or simulate a shorter span"
        )

    def _n_steps(self, n_samples):
        """Steps of the model that the first samples are made of."""
        steps = n_samples if self.rows is None else int(np.sum(self.rows < n_samples)) + 1
        return min(steps, len(self.drive))

    def observe(self, Y, time, recompose=True):
        """Model outputs brought to every sample, and recomposed to signals."""
        if self.rows is not None:
            Y = self._between_rows(Y, len(time))
        return self.basis.recomposed(Y, time) if recompose else Y

    def _between_rows(self, Y, n_samples):
        rows = self.rows[: Y.shape[-2]]
        if len(rows) == 0:
            return np.zeros((*Y.shape[:-2], n_samples, Y.shape[-1]))
        return self.basis.between_rows(Y, rows, n_samples)


class LiftedSimulator(SegmentSimulator):
    """Free simulation of a Poincaré map, and of what happens within each period.

    Harmonics, and predictions ahead, are those of whole periods.

    ``model`` has ``lifted``, and ``inputs`` are as measured, trim subtracted.
    """

    def __init__(self, model, basis, drive, time, sample_time, inputs):
        super().__init__(model, basis, drive, time, sample_time)
        spp, n_periods = basis.samples_per_period, len(self.rows)
        first = self.rows[0] if n_periods else len(inputs)
        beyond = first + n_periods * spp - len(inputs)  # of an incomplete period: held
        held = np.concatenate([inputs[first:], np.repeat(inputs[-1:], beyond, axis=0)])
        w = held.reshape(n_periods, spp * inputs.shape[1]) @ model.lifted.directions
        self.w = np.column_stack([w, np.ones(n_periods)])

    def outputs(self, x0, *, recompose=True, n_samples=None):
        """Outputs at all samples or the first of them, or harmonics of the whole periods."""
        if not recompose:
            return super().outputs(x0, recompose=False, n_samples=n_samples)
        n_samples = len(self.time[:n_samples])
        lifted, w = self.model.lifted, self.w[: self._n_steps(n_samples)]
        Y = simulate(self.A, lifted.B, lifted.C, lifted.D, w, x0)
        return self._unrolled(self._finite(Y), n_samples)

    def free(self, n_samples):
        """Outputs of the first samples for each unit initial state, (n, n_samples, n_outputs)."""
        n, steps = self.model.n_states, self._n_steps(n_samples)
        states = propagate(self.A, np.zeros((n, steps, n)), np.eye(n))
        return self._unrolled(states @ self.model.lifted.C.T, n_samples)

    def _unrolled(self, Y, n_samples):
        """The samples of whole periods one after another; before the first ψ = 0 as a turn on."""
        spp, (*before, n_periods, width) = self.basis.samples_per_period, Y.shape
        if n_periods == 0:
            return np.zeros((*before, n_samples, width // spp))
        place = np.arange(n_samples) - self.rows[0]
        samples = Y.reshape(*before, n_periods * spp, width // spp)
        return samples[..., np.where(place < 0, place % spp, place), :]


def sample_simulators(model, experiment):
    """Simulators of a model of samples at their azimuths, one a segment."""
    raw = model.input_names == tuple(experiment.basis.input_signals)
    inputs = experiment.inputs if raw else experiment.drive
    if model.split is not None and experiment.delays is not None:
        inputs = [both_values(u, model.split[0]) for u in experiment.origin.inputs]
    parts = zip(inputs, experiment.times(), experiment.phases, strict=True)
    return [SampleSimulator(model, experiment.basis, *part) for part in parts]


def without_gain(model, experiment):
    """The same of the model's simulation, which a gain would bring back to what is measured."""
    own = model.innovations
    still = replace(model, innovations=replace(own, gain=np.zeros_like(own.gain)))
    return sample_simulators(still, experiment)


def steady(simulator, piece, n_outputs, samples):
    """What repeats itself of the outputs of a segment, trim aside, some samples late.

    It returns these on the grid (n_samples, n_outputs) and at the user's rows
    (n_rows, n_outputs), there by Fourier series: splines would need more samples in a
    turn.
    """
    forced = np.broadcast_to(simulator.forced(), (len(piece.grid), n_outputs))
    forced = late(forced, samples)
    if piece.is_grid:
        return forced, forced
    basis, orders = simulator.basis, range(1)
    psi = basis.azimuth(piece.grid)
    if forced.any():
        orders = range(min(basis.most_harmonics, (len(psi) - 1) // 4) + 1)
    coefficients = linalg.lstsq(harmonic_functions(psi, orders), forced)[0]
    at = psi, basis.azimuth(piece.places)
    return tuple(evaluate_harmonics(coefficients, each) for each in at)


def as_seen(simulator, outputs):
    """Outputs as far as a model can tell them: of one of coefficients, through its window."""
    if type(simulator) is not SegmentSimulator or simulator.rows is None:
        return outputs
    basis, time = simulator.basis, simulator.time
    return basis.recomposed(basis.output_coefficients(outputs, time, np.arange(len(time))), time)


def fit_initial_state(simulator, outputs, rows):
    """Initial state whose simulation fits the outputs best over some rows."""
    largest = np.max(np.abs(extremes(outputs)), axis=0)
    unit = np.where(largest > 0.0, largest, 1.0)  # so that each output counts alike
    zero = np.zeros(simulator.model.n_states)
    forced = simulator.outputs(zero, n_samples=rows.stop)[rows]
    if simulator.model.n_states == 0:
        return np.zeros(0)
    free = simulator.free(rows.stop)[:, rows] / unit
    regressors = free.reshape(len(free), -1).T
    target = ((outputs[rows] - forced) / unit).reshape(-1)
    return solve_within_rank(regressors, target, cond=RANK)


def predicted_ahead(simulator, outputs, horizon, x0=None, *, rows, recompose):
    """Outputs of one segment, predicted some rows ahead.

    ``outputs`` are as measured, trim subtracted. ``horizon`` counts rows of the model
    from the last output used to the one predicted. Without ``x0`` the state is that
    with the least innovations over the samples ``rows``. It gives harmonics if
    ``recompose`` is False.
    """
    model, u, form = simulator.model, simulator.drive, simulator.form
    Y = simulator.read(outputs)
    if x0 is None:
        seen = max(1, simulator.n_read_within(rows.stop))
        x0 = form.initial_state(u[: len(Y)][:seen], Y[:seen], model.innovations_covariance)
    return simulator.observe(form.ahead(u, Y, x0, horizon), simulator.time, recompose)


# ---- initial states as a user gives them -----------------------------------------------------


def initial_states(x0, base, n_states, state_names=None):
    """One initial state a segment, (n_segments, n_states).

    ``x0`` is one vector for all segments, one row a segment, or one vector a record: in
    a dict, or in a DataFrame whose index holds the labels of the records. Labels of
    Series and columns of DataFrames that name the states put them in order.
    """
    n_segments = len(base.segments)
    if isinstance(x0, pd.Series):
        x0 = _in_order(x0.to_frame().T, state_names).iloc[0]
    if isinstance(x0, pd.DataFrame):
        x0 = _rows(_in_order(x0, state_names), base)
    if isinstance(x0, dict):
        x0 = _by_record(x0, base)
    try:
        x0 = np.asarray(x0, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"x0={x0!r} holds values that are not numbers, or states of different lengths; give "
            f"{n_states} numbers, one row of them per segment, or a dict of them by record"
        ) from None
    if not np.isfinite(x0).all():
        raise ValueError("x0 contains NaN or infinity; give finite states")
    if x0.ndim == 1:
        x0 = np.broadcast_to(x0, (n_segments, len(x0)))
    if x0.shape != (n_segments, n_states):
        raise ValueError(
            f"x0 has shape {x0.shape}; the model has {n_states} states and the data {n_segments} "
            f"segments: give ({n_states},), ({n_segments}, {n_states}) or a dict by record"
        )
    return x0


def states_by_record(states, base, state_names=None):
    """States of segments as a table that :func:`initial_states` reads.

    The table is indexed by record, or by segment where a record has several. Names of
    the states are those of control.StateSpace by default.
    """
    once = len(set(base.records)) == len(base.records)
    index = pd.Index(base.records if once else range(len(states)))
    if index.nlevels == 1:
        index.name = "record" if once else "segment"
    n_states = len(states[0])
    columns = [f"x[{i}]" for i in range(n_states)] if state_names is None else list(state_names)
    return pd.DataFrame(np.reshape(states, (len(states), n_states)), index, columns)


def _in_order(frame, state_names):
    """Columns in the order of the states, where they bear their names."""
    if state_names is not None and set(frame.columns) == set(state_names):
        return frame[list(state_names)]
    return frame


def _rows(frame, base):
    """Rows by record where the index holds records, else one a segment as they stand."""
    labels = list(frame.index)
    if labels == list(range(len(base.segments))) and len(set(base.records)) < len(labels):
        return frame.to_numpy()  # gaps part a record
    if set(base.records) <= set(labels) and len(set(labels)) == len(labels):
        return dict(zip(labels, frame.to_numpy(), strict=True))
    if labels == list(range(len(labels))):
        return frame.to_numpy()
    raise ValueError(
        f"x0 has the rows {labels}, which are not the records {list(dict.fromkeys(base.records))}; "
        f"index it by record, or give an array with one row per segment"
    )


def _by_record(x0, base):
    """One state a segment from a dict by record."""
    records = list(dict.fromkeys(base.records))
    missing = [record for record in records if record not in x0]
    unknown = [label for label in x0 if label not in records]
    if missing or unknown:
        what = (
            f"has no state for record {missing[0]!r}"
            if missing
            else f"names the record {unknown[0]!r}, which the data do not have"
        )
        raise ValueError(
            f"x0 {what}; give one for each of {records} and no other (several levels above the "
            f"time make a tuple)"
        )
    return [x0[record] for record in base.records]


def scored_simulation(step, X, y, horizon=None):
    """Measured and simulated outputs on the rows that ``step.score`` counts, and those rows.

    With a horizon, outputs predicted so many rows ahead. Last the forced response of models of
    samples, which both are without.
    """
    check_is_fitted(step)
    experiment = step._experiment(without_inputs(y) if X is None else X, y)
    trim, sampling = experiment.output_trim_at_rows(), experiment.sampling
    truth, simulated, rows, forced, places = [], [], [], [], []
    simulators = step._simulators(experiment)
    step._warn_of_inputs(experiment, simulators)
    samples = (step._samples_late if horizon is None else step._samples_ahead)(experiment)
    parts = zip(simulators, experiment.outputs, sampling.pieces, strict=True)
    for i, (simulator, y_segment, piece) in enumerate(parts):
        y_segment = late(y_segment, -samples)
        warm, counted = score_rows(step, simulator, experiment)
        if counted.start >= counted.stop:
            continue
        within = piece.rows_between(counted.start, counted.stop)
        measured = experiment.measured[piece.rows][within]
        own = np.arange(within.start, within.stop)
        if experiment.basis.timing.missing != RAISE:  # rows that were bridged do not count
            kept = np.isfinite(measured).all(axis=1)
            measured, own = measured[kept], own[kept]
            within = own
        seen = as_seen(simulator, y_segment)
        outputs = _fitted_outputs(step, simulator, seen, warm, horizon)
        if seen is y_segment:
            outputs = late(outputs, samples)
            on_grid, loads = steady(simulator, piece, outputs.shape[1], samples)
            known = loads if trim is None else trim[i] + loads
            truth.append(measured - known[within])
        else:
            on_grid, loads = steady(simulator, piece, outputs.shape[1], 0.0)
            truth.append(piece.back(seen - on_grid)[within])
        simulated.append(piece.back(outputs - on_grid)[within])
        forced.append(loads[within])
        rows.append(own + piece.rows.start)
        places.append(piece.places[own])
    if not truth:
        raise ValueError(
            f"no rows are left to score in {experiment.span()}: every segment is shorter than "
            f"one analysis window and the warm-up; give longer records or a smaller warmup"
        )
    truth, simulated = (np.asfortranarray(joined(parts)) for parts in (truth, simulated))
    rows, forced = joined(rows), joined(forced)  # by columns, which are quick to sum
    _meet_at_rest(truth, simulated, experiment.measured[rows])
    if experiment.basis.harmonic and not step.predicts_harmonics_:
        at_rows = experiment.measured[rows]
        warn_of_another_orbit(truth, simulated, at_rows, joined(places), experiment)
    return truth, simulated, rows, forced


def score_rows(step, simulator, experiment):
    """Rows of one segment that the initial state is fitted on, and those scored."""
    first, last = experiment.basis.scored_rows(simulator.time)
    unknown, unread = leads(experiment)
    first += unknown
    seconds = step._check_warmup()
    warm = experiment.basis.warmup_samples
    if seconds is not None:
        warm = round(seconds / experiment.base.sample_time)
    warm = max(1, min(warm, int(WARMUP_SHARE * (last - first - 2 * unread))))
    return slice(first, first + warm), slice(first + warm + unread, last - unread)


def _fitted_outputs(step, simulator, outputs, rows, horizon):
    """Outputs from the initial state that fits best over some rows."""
    if horizon is None:
        return simulator.outputs(fit_initial_state(simulator, outputs, rows))
    if not step._predicts_ahead():
        raise ValueError(
            f"horizon={horizon!r} asks for predictions from measured outputs, but this "
            f"{type(step).__name__} has no Kalman gain; use MOESPRegressor(disturbance_model=True) "
            f"or StructuredMatcher(criterion='prediction_error') as the last step, or horizon=None"
        )
    recompose = not step.predicts_harmonics_
    return predicted_ahead(simulator, outputs, horizon, rows=rows, recompose=recompose)


def compared(step, X, y, sample_weight=None, horizon=None):
    """Measured and simulated outputs on the rows that count, and the rows' weights.

    None, and a warning, if outputs grow so much that the spread of such scores over folds would
    not be finite. A search over orders continues with that candidate as the worst.
    """
    try:
        truth, simulated, rows, _ = scored_simulation(step, X, y, horizon)
        weight = weights_of(rows, sample_weight, len(y))
        with np.errstate(over="ignore"):
            grown = np.max(np.abs(extremes(simulated)) / power_of_two(truth))
    except UnstableModelError:
        grown = np.inf
    if grown < MOST_SCORED:
        return truth, simulated, weight
    warn(
        f"a {type(step).__name__} scores -inf: its model is unstable, or was fitted to other "
        f"outputs, and its simulation grows beyond {MOST_SCORED:.0e} times the outputs; drop the "
        f"growing modes (SpuriousModeReducer), lower the order, or score a shorter span",
        InstabilityWarning,
    )
    return None


def _meet_at_rest(truth, simulated, measured):
    """Treat outputs that rest, to rounding, as met if the simulation rests, too."""
    dust = EXACT * np.max(np.abs(extremes(measured)), axis=0)
    for j in np.flatnonzero(np.ptp(truth, axis=0) <= dust):
        if np.max(np.abs(simulated[:, j] - truth[:, j])) <= dust[j]:
            simulated[:, j] = truth[:, j]


def power_of_two(values):
    """About the largest magnitude of each column, as a power of two: dividing rounds nothing."""
    _, exponent = np.frexp(np.max(np.abs(extremes(values)), axis=0))
    return np.ldexp(1.0, np.clip(exponent, -1000, 1000))


def weights_of(rows, sample_weight, n_samples):
    """Weights of the rows that count, after checking that there is one for each row."""
    weight = check_weight(sample_weight, n_samples)
    if weight is None:
        return None
    if not weight[rows].any():
        raise ValueError(
            f"sample_weight is zero on all {len(rows)} rows that are scored (warm-up and "
            f"incomplete periods are not scored); give some of them a weight"
        )
    return weight[rows]
