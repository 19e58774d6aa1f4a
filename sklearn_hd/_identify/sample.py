"""``reading="sample"``: a periodic innovations model of samples at their azimuths.

1. The forced periodic means of inputs and outputs are taken out, and signals brought to like size.
2. A periodic predictor by ridge regression; its lags and harmonics by Akaike's criterion.
3. States by one singular value decomposition of what it knows of the outputs to come.
4. Matrices, K and loads by least squares; order and harmonics by simulation (Schwarz's criterion).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd._fit_checks import check_motion
from sklearn_hd._guards import searches
from sklearn_hd._identify.stages import SubspaceFit
from sklearn_hd._identify.statistics import Facts
from sklearn_hd._sample_model import SampleModel
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.lti.stability import GROWN
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_predictor import (
    SENSOR_NOISE,
    LagSums,
    Layout,
    StateSums,
    forced_mean,
    futures_known,
)
from sklearn_hd.algorithms.subspace.order import Simulated, best_of
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning

__all__ = ["asked_block_rows", "identify", "read"]

MOST_LAGS = 60
MOST_COLUMNS = 600  # of the largest regression tried: its sums take seconds
MOST_HARMONICS = 3  # of the predictor, where the data choose
MOST_STATE_HARMONICS = 8  # of the matrices, in coordinates that are no one's
MOST_STATES = 12  # tried by order="auto"
ROWS_PER_COLUMN = 5  # of the largest regression tried
ROWS_COMPARED = 10_000  # of a longer record, from its start, choices are made on
PIECE = 4  # times the lags: the least piece of an unstable model that is simulated
PATIENCE = 4  # orders that may pass without a better one
NOTHING = 1e-6  # share of an input beside its forced mean, below which it moves with the turn alone


@dataclass(frozen=True, eq=False)
class Samples:
    """Segments of a record about their forced periodic means, in like units.

    Attributes
    ----------
    segments : list of (inputs, outputs, psi)
    means : (ndarray, ndarray)
        Fourier coefficients of what was taken out of inputs and outputs.
    scales : (ndarray, ndarray)
    facts : Facts
    step : float
        Radians from row to row, the mean.
    """

    segments: list
    means: tuple
    scales: tuple
    facts: Facts
    step: float

    @property
    def n_inputs(self):
        """Number of inputs."""
        return len(self.scales[0])

    @property
    def n_outputs(self):
        """Number of outputs."""
        return len(self.scales[1])


def _longest(data):
    """Rows of the longest segment."""
    return max(len(y) for _, y, _ in data.segments)


def asked_block_rows(basis, settings):
    """Lags given, or the most tried."""
    return MOST_LAGS if settings.block_rows is None else int(settings.block_rows)


def read(experiment, settings):
    """The samples of an experiment."""
    facts = Facts.of(experiment, experiment.drive)
    check_motion(facts)
    basis = experiment.basis
    parts = zip(experiment.drive, experiment.outputs, experiment.phases, strict=True)
    segments = list(parts)
    means = forced_mean(segments, basis.most_loads)
    if basis.output_trim is not None:  # subtracted already
        means = tuple(np.zeros_like(mean) for mean in means)
    segments = [
        (u - evaluate_harmonics(means[0], psi), y - evaluate_harmonics(means[1], psi), psi)
        for u, y, psi in segments
    ]
    scales = tuple(_size(segments, i) for i in range(2))
    _check_told_from_loads(scales[0], experiment)
    segments = [(u / scales[0], y / scales[1], psi) for u, y, psi in segments]
    step = basis.omega * basis.sample_time
    return Samples(segments, means, scales, facts, step)


def _size(segments, i):
    """Root mean square of the inputs (0) or outputs (1) of all segments."""
    stacked = np.vstack([segment[i] for segment in segments])
    size = np.sqrt(np.mean(stacked**2, axis=0))
    return np.where(size > 0.0, size, 1.0)


def _check_told_from_loads(left, experiment):
    """Raise ValueError if an input moves with the turn alone: then loads look the same."""
    whole = np.sqrt(np.mean(np.vstack(experiment.drive) ** 2, axis=0))
    for name, size, rest in zip(experiment.basis.input_signals, whole, left, strict=True):
        if rest <= NOTHING * size:
            raise ValueError(
                f"input {name!r} repeats itself with every turn in the {experiment.span()}, so "
                f"that its effect cannot be told from periodic loads; use a record in which it "
                f"changes from turn to turn, drop it, or give load_harmonics below those of the "
                f"input"
            )


def identify(data, settings, experiment):
    """Identify a periodic innovations model from samples.

    Parameters
    ----------
    data : Samples
    settings : Settings
    experiment : Experiment

    Returns
    -------
    fit : SubspaceFit
    """
    if settings.weighting in ("n4sid", "cva"):
        raise ValueError(
            f"weighting={settings.weighting!r} with reading='sample': states are those of a "
            f"predictor there, whatever the weighting; leave weighting='moesp', or 'pbsid'"
        )
    basis = experiment.basis
    layout, reason = _layout(data, settings, basis)
    sums = LagSums.of(data.segments, layout)
    predictor = sums.predictor()
    states = _States.of(data, predictor, settings)
    choice = _Choice(data, states, settings, basis, layout)
    best, innovations = choice.best()
    _warn_of_rest(choice, innovations, predictor)
    innovations = innovations.in_units(*data.scales).about(*data.means)
    model = SampleModel(
        innovations,
        basis.omega,
        basis.sample_time,
        basis.input_signals,
        basis.output_labels,
        layout.feedthrough,
    )
    _warn_of_little(layout, sums.n_rows, best)
    _warn_of_growth(model, best, data)
    x0 = np.array([choice.start(innovations, s) for s in range(len(data.segments))])
    floor = float(np.sqrt(layout.n_columns / max(sums.n_rows, 1)))
    return SubspaceFit(
        model,
        x0,
        layout.n_lags,
        best.order,
        states.singular_values,
        floor,
        reason,
        tuple(choice.tried),
    )


# ---- the predictor ---------------------------------------------------------------------------


def _layout(data, settings, basis):
    """Lags, harmonics and feedthrough of the predictor, and why D is free or zero."""
    most, lags = _most(data, settings, basis)
    shortest = _shortest(data, settings)
    auto = settings.feedthrough == "auto"

    def layout(count, feedthrough):
        return Layout(
            data.n_inputs,
            data.n_outputs,
            lags,
            count,
            count if basis.n_input_harmonics is None else min(count, basis.n_input_harmonics),
            basis.most_loads,
            feedthrough,
        )

    sums = LagSums.of(data.segments, layout(most, auto or settings.direct), ROWS_COMPARED)
    least = lags if settings.block_rows is not None else shortest
    found = {}
    for count in range(most + 1):
        for feedthrough in (False, True) if auto else (settings.direct,):
            own = layout(count, feedthrough)
            aic, bic = sums.part(own).criteria(least)
            k = int(np.argmin(aic))
            found[count, feedthrough] = aic[k], bic[k], least + k
    count = min(found, key=lambda key: found[key][0])[0]
    if not auto:
        feedthrough, reason = settings.direct, f"feedthrough={settings.feedthrough} was asked for"
    else:  # a whole set of coefficients, which has to be worth it
        gain = found[count, False][1] - found[count, True][1]
        feedthrough = bool(gain > 0.0)
        reason = (
            f"the Bayesian information criterion of the predictor is {abs(gain):.3g} lower with "
            f"{'D free' if feedthrough else 'D = 0'}"
        )
    n_lags = found[count, feedthrough][2]
    return replace(layout(count, feedthrough), n_lags=n_lags), reason


def _shortest(data, settings):
    """Fewest lags, which have to tell as many states as asked for."""
    return 2 if settings.order == "auto" else max(2, -(-settings.order // data.n_outputs))


def _most(data, settings, basis):
    """Most harmonics and lags that the record allows, of those asked for."""
    n_rows, longest = sum(len(y) for _, y, _ in data.segments), _longest(data)
    asked, shortest = settings.block_rows, _shortest(data, settings)
    if asked is not None and asked < shortest:
        raise ValueError(
            f"order={settings.order} exceeds the {asked * data.n_outputs} that block_rows={asked} "
            f"with {data.n_outputs} output(s) tell; lower order, or raise block_rows"
        )
    given = basis.n_harmonics
    most = min(MOST_HARMONICS if given is None else given, basis.most_harmonics)
    least = asked or shortest
    for count in range(most, -1 if given is None else most - 1, -1):
        per_lag = (data.n_inputs + data.n_outputs) * (2 * count + 1)
        columns = min(n_rows // ROWS_PER_COLUMN, MOST_COLUMNS) - 2 * basis.most_loads - 1
        lags = min(MOST_LAGS, max(columns // per_lag, shortest), longest // 3)
        lags = lags if asked is None else asked
        if lags >= shortest and n_rows >= 2 * lags * per_lag and longest >= 3 * lags:
            return count, lags
    need = max(2 * least * per_lag, 3 * least)
    raise ValueError(
        f"the {data.facts.span()} give {n_rows} rows, the longest segment {longest}, too few for "
        f"a predictor of {least} lags with {count} harmonic(s) of "
        f"{data.n_inputs + data.n_outputs} signals: {need} rows in one segment would do"
        f"{data.facts.why_short}; use a longer record, fewer block_rows, a lower order, or a "
        f"smaller output_harmonics in HarmonicAnalyzer"
    )


# ---- states and matrices ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _States:
    """States of every row, of more orders than one: the first n columns are those of order n.

    Attributes
    ----------
    parts : list of (first, x, e)
        Of each segment: its first row with a state, states, and innovations (n_rows, l).
    singular_values : ndarray
    covariance : ndarray, shape (l, l)
    bound : int
        The most states that there are.
    """

    parts: list
    singular_values: np.ndarray
    covariance: np.ndarray
    bound: int

    @classmethod
    def of(cls, data, predictor, settings):
        """States that a predictor makes of the data."""
        layout, n_outputs = predictor.layout, data.n_outputs
        asked = 1 if settings.order == "auto" else settings.order
        n_future = layout.n_lags
        bound = n_future * n_outputs
        if asked > bound:
            raise ValueError(
                f"order={asked} exceeds the {bound} that {layout.n_lags} lags with {n_outputs} "
                f"output(s) tell; lower order or raise block_rows"
            )
        root = linalg.cholesky(_positive(predictor.covariance), lower=True)
        white = np.kron(np.eye(n_future), linalg.inv(root).T)
        known = [futures_known(segment, predictor, n_future) for segment in data.segments]
        gram = sum(white.T @ (ahead.T @ ahead) @ white for _, ahead in known)
        values, vectors = linalg.eigh(gram / sum(len(ahead) for _, ahead in known))
        n = min(bound, max(asked, MOST_STATES))
        V = white @ vectors[:, ::-1][:, :n]
        parts = []
        for (first, ahead), (u, y, psi) in zip(known, data.segments, strict=True):
            rows = slice(first, first + len(ahead))
            e = y[rows] - ahead[:, :n_outputs] - evaluate_harmonics(predictor.loads, psi[rows])
            if layout.feedthrough:
                e -= np.einsum("til,ti->tl", evaluate_harmonics(predictor.D, psi[rows]), u[rows])
            parts.append((first, ahead @ V, e))
        singular_values = np.sqrt(np.maximum(values[::-1], 0.0))
        return cls(parts, singular_values, predictor.covariance, n)

    def rows(self, data, order, most=None):
        """States, next states, inputs, outputs, innovations and azimuths of each segment.

        Of some order, up to a number of rows.
        """
        left = sum(len(x) for _, x, _ in self.parts) if most is None else most
        for (first, x, e), (u, y, psi) in zip(self.parts, data.segments, strict=True):
            n = min(len(x) - 1, left)
            if n > 0:
                rows, left = slice(first, first + n), left - n
                yield x[:n, :order], x[1 : n + 1, :order], u[rows], y[rows], e[:n], psi[rows]


def _positive(covariance):
    """A covariance with what rounding leaves of exact data added to its diagonal."""
    return covariance + 1e-12 * np.eye(len(covariance))


class _Choice:
    """The order and the harmonics of the matrices, by what simulations of the record leave."""

    def __init__(self, data, states, settings, basis, layout):
        self.data, self.states, self.settings = data, states, settings
        self.basis, self.layout, self.tried = basis, layout, []
        most = min(MOST_STATE_HARMONICS, basis.most_harmonics)
        self.most = most if layout.n_harmonics else 0
        self.sums = self._sums(states.bound, self.most, ROWS_COMPARED)
        self.simulated = list(_first_rows(data.segments, layout.n_lags))
        self.total = sum(np.sum(y**2, axis=0) for _, y, _ in self.simulated)

    def _sums(self, order, count, most=None):
        rows = self.states.rows(self.data, order, most)
        return StateSums.of(rows, count, self.basis.most_loads)

    def best(self):
        """The model of the least criterion: a Simulated, a PeriodicInnovations."""
        asked = self.settings.order
        orders = range(1, self.states.bound + 1) if asked == "auto" else [asked]
        n_values = sum(y.size for _, y, _ in self.simulated)
        found = None
        for order in orders:
            before = None
            for count in self._counts():
                one = self._compared(order, count, self._model(self.sums, order, count))
                self.tried.append(one)
                if before is not None and one.bic >= before.bic:
                    break
                before = one
            kept = [m for m in self.tried if m.stable] if self.settings.stable else self.tried
            found = best_of(kept, n_values) if kept else None
            if found is not None and found.order <= order - PATIENCE:
                break
        if found is None:
            raise ValueError(
                f"stable=True, but no model of the orders tried ({self.tried[0].order} to "
                f"{self.tried[-1].order}) is stable; use stable=False and predict_ahead, another "
                f"order, or fewer harmonics"
            )
        order, count = found.order, found.n_harmonics
        innovations = self._model(self._sums(order, count), order, count)  # of all rows
        return found, innovations.filtered(self._noise(innovations))

    def _noise(self, innovations):
        """Covariance of innovations, and of what is left of next states and of outputs."""
        n, total, n_rows = innovations.n_states, 0.0, 0
        for x, following, u, y, e, psi in self.states.rows(self.data, n, ROWS_COMPARED):
            form = innovations.rows(psi)
            known = np.hstack([x, u, np.ones((len(u), 1))])[..., None]
            rest = following - (form.states @ known + form.gain @ e[..., None])[..., 0]
            noise = np.hstack([e, rest, y - (form.outputs @ known)[..., 0]])
            total, n_rows = total + noise.T @ noise, n_rows + len(noise)
        return total / n_rows

    def _counts(self):
        """Numbers of harmonics tried, of which each has to better the one before."""
        first = self.layout.n_harmonics
        return sorted({first, *(min(k * first, self.most) for k in (2, 3)), self.most})

    def _model(self, sums, order, count):
        asked = self.basis.n_input_harmonics
        coefficients, gain = sums.matrices(
            order,
            count,
            count if asked is None else min(count, asked),
            self.basis.most_loads,
            self.layout.feedthrough,
        )
        start = self.data.segments[0][2][0]
        covariance, step = self.states.covariance, self.data.step
        return PeriodicInnovations(coefficients, gain, covariance, step, float(start))

    def _compared(self, order, count, innovations):
        """What simulations of one model leave."""
        D, longest = self.layout.feedthrough, _longest(self.data)
        rate = innovations.growth()
        least = PIECE * self.layout.n_lags  # so long that no initial state explains it
        pieces = [piece for s in self.simulated for piece in _pieces(s, rate, least)]
        left = [innovations.rows(psi).left(u, y) for u, y, psi in pieces]
        if any(each is None for each in left):
            return Simulated(order, D, False, np.inf, np.inf, np.inf, count)
        shares = sum(np.sum(each**2, axis=0) for each in left) / self.total
        logs = np.log(shares + SENSOR_NOISE**2)
        m, n_outputs = self.data.n_inputs, self.data.n_outputs
        n_free = order * (order + m + n_outputs) + D * m * n_outputs
        first = self.layout.n_harmonics  # those beyond belong to the coordinates
        n_rows = sum(len(y) for _, y, _ in pieces)
        spent = (2 * first + 1) * np.log(n_rows) + 4 * (count - first)
        bic = n_rows * np.sum(logs) + n_free * spent
        bic += order * sum(np.log(len(y)) for _, y, _ in pieces)
        share, variance = np.sqrt(np.mean(shares)), np.exp(np.mean(logs))
        stable = longest * rate < GROWN
        return Simulated(order, D, bool(stable), *map(float, (share, variance, bic)), count)

    def start(self, innovations, s):
        """State at the first row of a segment, in the units of the signals."""
        u, y, psi = self.data.segments[s]
        (u_mean, y_mean), (u_scale, y_scale) = self.data.means, self.data.scales
        rows = slice(0, 4 * self.layout.n_lags)
        u = u[rows] * u_scale + evaluate_harmonics(u_mean, psi[rows])
        y = y[rows] * y_scale + evaluate_harmonics(y_mean, psi[rows])
        return innovations.rows(psi[rows]).initial_state(u, y, innovations.covariance)


def _first_rows(segments, skipped):
    """Rows that choices are made on, those without a whole predictor left out."""
    left = ROWS_COMPARED
    for u, y, psi in segments:
        rows = slice(skipped, skipped + left)
        if left > skipped and len(y) > 2 * skipped:
            yield u[rows], y[rows], psi[rows]
            left -= len(y[rows])


def _pieces(segment, rate, least):
    """A segment, in pieces in which a model of some growth a row does not outgrow the outputs."""
    u, y, psi = segment
    n = len(y)
    length = n if rate * n < GROWN else max(int(GROWN / rate), least)
    n_pieces = max(1, n // length)
    for k in range(n_pieces):
        rows = slice(k * n // n_pieces, (k + 1) * n // n_pieces)
        yield u[rows], y[rows], psi[rows]


def _warn_of_little(layout, n_rows, best):
    """Of a record too short for its predictor, and of a model that explains nothing."""
    if n_rows < ROWS_PER_COLUMN * layout.n_columns:
        warn(
            f"{n_rows} rows tell {layout.n_columns} coefficients of the predictor of each output "
            f"({layout.n_lags} lags, {layout.n_harmonics} harmonic(s), loads of {layout.n_loads}): "
            f"with fewer than {ROWS_PER_COLUMN} rows for each the model is largely noise; use a "
            f"longer record, or fewer of block_rows, output_harmonics, load_harmonics",
            IdentifiabilityWarning,
        )
    if best.variance >= 1.0:
        warn(
            f"no model explains the outputs: the simulation of the best one leaves "
            f"{best.variance:.3g} of their variance about the forced periodic response; do outputs "
            f"follow inputs, and is omega (or the azimuth) that of the machine?",
            IdentifiabilityWarning,
        )


def _warn_of_rest(choice, innovations, predictor):
    """Of predictions that leave so much more than the predictor they come from that it counts.

    The predictor knows more coefficients. By Schwarz's criterion it is the better model all the
    same where states, order or harmonics have lost what it knew.
    """
    if any(frame.f_code.co_name == "_fit_and_score" for frame in searches()):
        return
    layout, n = predictor.layout, innovations.n_states
    m, n_outputs = choice.data.n_inputs, choice.data.n_outputs
    left, first = [], slice(0, 4 * layout.n_lags)
    for u, y, psi in choice.simulated:
        rows = innovations.rows(psi)
        x0 = rows.initial_state(u[first], y[first], innovations.covariance)
        left.append(rows.innovations(u, y, x0)[1])
    n_rows = sum(map(len, left))
    if not all(np.isfinite(e).all() for e in left):
        return  # an InstabilityWarning says so
    covariance = sum(e.T @ e for e in left) / n_rows
    floor = SENSOR_NOISE**2 * np.eye(n_outputs)
    own, its = (np.linalg.slogdet(M + floor)[1] for M in (covariance, predictor.covariance))
    more = own - its
    spent = (n * (2 * n_outputs + m) + layout.feedthrough * n_outputs * m) * layout.n_functions
    saved = n_outputs * (layout.n_columns - 2 * layout.n_loads - 1) - spent
    if n_rows * more > saved * np.log(n_rows):
        warn(
            f"what the model leaves is not noise: its one-step predictions leave "
            f"{np.exp(more / n_outputs):.3g} times the variance that the predictor it was made "
            f"from leaves ({layout.n_lags} lags); states are missing, or badly told: raise order= "
            f"or use another, fewer harmonics or block_rows, and see residual_tests",
            IdentifiabilityWarning,
        )


def _warn_of_growth(model, best, data):
    """Of a model that grows e-fold over the longest segment."""
    if best.stable:
        return
    radius = np.max(np.abs(model.innovations.multipliers()))
    turns = _longest(data) * data.step / (2.0 * np.pi)
    folds = turns * np.log(max(radius, 1e-300))
    warn(
        f"the model has a Floquet multiplier of size {radius:.4g}, by which it grows "
        f"{np.exp(min(folds, 700.0)):.3g} times over the longest segment ({turns:.4g} turns): "
        f"predict overflows or leaves the record where feedback held the machine; use "
        f"predict_ahead there, stable=True where the machine is stable, or another order",
        InstabilityWarning,
    )
