"""A record as a likelihood sees it, and the settings of the search.

It holds inputs and outputs of each segment with the phases of their samples, a constant input if
there is a forced response, and both values of an input within a sample if delays are not whole
samples, or are parameters (:mod:`sklearn_hd.algorithms.likelihood.delay_search`).
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import sparse

from sklearn_hd._frame import SampleModel
from sklearn_hd._records.data import Experiment, output_scale
from sklearn_hd._records.delays import in_whole_samples, most_samples
from sklearn_hd.algorithms.likelihood.delay_search import Cells, most_likely, through_cells
from sklearn_hd.algorithms.likelihood.forms import Form, interpolating
from sklearn_hd.algorithms.likelihood.prediction_error import (
    fit_gain,
    output_error_of,
    prediction_error,
)
from sklearn_hd.algorithms.likelihood.search import LikelihoodResult, cost_of_best_inputs
from sklearn_hd.algorithms.periodic.behind_samples import samples_of
from sklearn_hd.algorithms.periodic.harmonic_balance import resize_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_realization import tail_begins
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import harmonic_labels, sampled_harmonics
from sklearn_hd.algorithms.signals.resampling import ON_GRID, turned

FEW_STEPS = 30  # of a search with more harmonics: one that takes longer is not determined
FEW_STEPS_IN_CELLS = 10  # of a search for the samples in which delays lie
COARSE = 0.1  # of the likelihood, in all, by which a candidate may miss its best


@dataclass(frozen=True, eq=False)
class SearchSettings:
    """How the largest likelihood is searched."""

    criterion: str = "output_error"
    max_iter: int = 50
    input_noise: np.ndarray | None = None  # (m,)

    @property
    def predicts(self):
        """Whether the model has a Kalman gain."""
        return self.criterion == "prediction_error"


@dataclass(frozen=True, eq=False)
class Fit:
    """A fit of a structure, with the form and the record that it was fitted to.

    ``into`` (k, k') says how the structure's parameters change with those of the search, where
    these are others.
    """

    structure: PeriodicStructure  # without loads
    form: Form  # with loads and gain
    result: LikelihoodResult
    data: "RecordData"  # with the delays found
    into: np.ndarray | None = None

    @property
    def places(self):
        """Of the structure's parameters, and of free delays, among those of the search."""
        k = self.structure.n_parameters, self.form.structure.n_parameters, self.form.n_model
        return np.concatenate([np.arange(k[0]), np.arange(k[1], k[2])])

    @property
    def theta(self):
        """Parameters of the structure."""
        return self.result.theta[: self.structure.n_parameters]

    @property
    def covariance(self):
        """Their covariance, and that of free delays."""
        if self.into is not None:
            return self.result.covariance
        return self.result.covariance[np.ix_(self.places, self.places)]


@dataclass(frozen=True, eq=False)
class RecordData:
    """A record as a likelihood sees it."""

    segments: list  # (inputs, outputs, first phase or azimuths); a constant input last with loads
    omega: float  # rad/s
    n_phases: float  # samples a period
    observe: np.ndarray | None  # what is measured of harmonic coefficients at each phase
    start: SampleModel | None  # whose forced response is where loads start from
    discrete: bool
    experiment: Experiment  # what the segments are of
    n_loads: int = -1  # harmonics of the forced response; -1 without one
    cells: Cells | None = None  # delays, if not all are whole samples or some are parameters
    raw: bool = True  # inputs as measured, not their harmonics
    input_size: np.ndarray | None = None  # (n, m): about that of each entry of G(ψ)
    gauge: bool = False  # whether the states may be any coordinates

    @classmethod
    def of(cls, experiment, raw, start, *, discrete=False, input_size=None, gauge=False):
        """Of a record without its delays; of how it was measured, if these are to be refined."""
        cells = None if discrete else _cells(experiment, raw)
        data = replace(cls._of(experiment, raw, start, discrete, input_size), gauge=gauge)
        return data if cells is None else data._in_cells(cells)

    def _in_cells(self, cells, least=0):
        """The same as it was measured, late by whole samples."""
        origin = self.experiment.origin
        moved = in_whole_samples(origin, cells.input_lags, cells.output_lags, least)
        moved = replace(moved, origin=origin)
        data = self._of(moved, self.raw, self.start, False, self.input_size)
        return replace(data, cells=cells, gauge=self.gauge)

    @classmethod
    def _of(cls, experiment, raw, start, discrete, input_size):
        basis = experiment.basis
        inputs = experiment.inputs if raw else experiment.drive
        omega, n_phases = sampling(experiment)
        if start is None:
            observe = None
            if basis.harmonic and not raw:
                observe = basis.recomposition(2.0 * np.pi * np.arange(n_phases) / n_phases)
            where = [int(basis.phase_index(time)[0]) for time in experiment.times()]
            n_loads = -1
        else:
            where = _where(experiment.phases, n_phases)
            inputs = [_with_constant(u, start.innovations.n_inputs) for u in inputs]
            observe, n_loads = None, basis.most_loads
        segments = list(zip(inputs, experiment.outputs, where, strict=True))
        own = {"n_loads": n_loads, "raw": raw, "input_size": input_size}
        return cls(segments, omega, n_phases, observe, start, discrete, experiment, **own)

    def fit(self, structure, theta, settings, *, bounds=None, like=None, coarse=False):
        """A structure of the inputs and outputs, fitted from some start.

        ``like`` is a fit of another structure, of whose gain, loads and delays this one has as
        many harmonics, and starts from. A coarse one is to be compared with others.
        """
        options = {"bounds": bounds, "coarse": coarse}
        data = self if like is None else like.data
        if data.cells is None:
            return data._fit(structure, theta, settings, like=like, **options)

        def within(cells, before, settings=settings, sigma=None):
            own = data._in_cells(cells)
            start, near = (theta, like) if before is None else (before.theta, before)
            known = {"like": near, "sigma": sigma, **options}
            found = own._fit(structure, start, settings, **known)
            own = replace(own, cells=cells.at(found.result.delays))
            value = found.result.cost / found.result.n_residuals
            return replace(found, data=own), own.cells, value

        if like is not None:
            return through_cells(data.cells, within)[0]
        few, size = min(FEW_STEPS_IN_CELLS, settings.max_iter), output_scale(data.experiment)
        quick = {"criterion": "output_error", "max_iter": few, "input_noise": None}
        alike = partial(within, settings=replace(settings, **quick), sigma=size)
        cost = partial(data._least, structure, theta, size)
        return most_likely(data.cells, most_samples(data.experiment.origin), cost, alike, within)[0]

    def _least(self, structure, theta, size, cells):
        """Cost of a model with the best effect of its inputs, late by some delays."""
        origin = self.experiment.origin
        own = self._in_cells(cells, most_samples(origin) + 1)
        form, start = own._started(*own._with_loads(structure, theta, None))
        return cost_of_best_inputs(form, own.segments, start, size)

    def _with_loads(self, structure, theta, like):
        """The structure with loads, where there are some, and where to start."""
        start = np.asarray(theta, dtype=float)
        if self.n_loads < 0:
            return structure, start
        if like is None:
            loads = self.start.innovations.forced_response(max(1, self.n_loads))
            loads = loads[: 2 * self.n_loads + 1].ravel()
        else:
            loads = like.result.theta[like.structure.n_parameters :]
        return with_loads(structure, self.n_loads), np.concatenate([start, loads])

    def _started(self, whole, start):
        """The form of a structure, with its delays, and where to start."""
        form = self.form(whole, start)
        if self.cells is None:
            return form, start
        cells = self.cells.with_constant() if self.n_loads >= 0 else self.cells
        return replace(form, delays=cells.fractions), np.append(start, cells.fractions.start)

    def _fit(self, structure, theta, settings, *, bounds, like, coarse, sigma=None):
        form, start = self._started(*self._with_loads(structure, theta, like))
        if settings.input_noise is not None:  # total least squares take the trim for known
            form = replace(form, waveform=False)
        else:
            form = replace(form, input_size=self.input_size)
        n_late = form.n_model - form.structure.n_parameters
        if bounds is not None or n_late:
            own = (np.full(len(theta), -np.inf), np.full(len(theta), np.inf))
            wide = np.full(len(start) - len(theta) - n_late, np.inf)
            (lower, upper), late = own if bounds is None else bounds, np.arange(n_late)
            bounds = np.r_[lower, -wide, 0.0 * late], np.r_[upper, wide, 1.0 + 0.0 * late]
        options = {"bounds": bounds, "max_iter": settings.max_iter}
        if coarse:
            size = sum(y.size for _, y, _ in self.segments)
            options |= {"max_iter": min(FEW_STEPS, settings.max_iter), "tol": COARSE / size}
        if settings.predicts and like is not None:
            form = form.with_gain(like.form.n_gain_harmonics)
            found = fit_gain(form, self.segments, start, like.result.gain, **options)
            return Fit(structure, form, found, self)
        if settings.predicts:
            found = prediction_error(form, self.segments, start, **options)
            return Fit(structure, found.problem.form, found, self)
        result = output_error_of(
            form, self.segments, start, sigma=sigma, input_sigma=settings.input_noise, **options
        )
        return Fit(structure, form, result, self)

    def form(self, structure, theta):
        """A structure at the clock of the record."""
        between = any(np.ndim(where) for *_, where in self.segments)
        n_phases = self.n_phases if between else round(self.n_phases)
        trim = self.start is None and self.experiment.basis.output_trim is not None
        form = Form(structure, self.omega, n_phases, self.observe, self.discrete, waveform=trim)
        form = replace(form, gauge=self.gauge)
        if between and self.discrete:  # products of two matrices have twice the harmonics
            return replace(form, n_points=4 * max(structure.n_harmonics, self.n_loads) + 1)
        return interpolating(form, theta) if between else form

    def sampled(self, fit, match):
        """The predictor at samples, or the simulation of models of samples; else None."""
        gain = fit.result.gain
        structure, theta, n = fit.form.structure, fit.result.theta, fit.structure.n_states
        step = 2.0 * np.pi / self.n_phases
        if self.observe is not None or self.cells is not None:
            response = fit.form.response(fit.result.point.theta, sensitivities=False)
            moved = _coefficients(response)
            if self.cells is not None and self.n_loads >= 0:  # a constant is late by nothing
                last = n + structure.n_inputs - 1
                constant = np.delete(moved[..., n:-1], last - n, axis=2)
                moved = np.concatenate([moved[..., :n], constant, moved[..., [last]]], axis=2)
        else:
            moved = samples_of(structure.coefficients(theta), n, self.omega, step)
        if self.n_loads < 0:
            moved = np.concatenate([moved, np.zeros((*moved.shape[:2], 1))], axis=2)
        gain = np.zeros((1, n, moved.shape[1] - n)) if gain is None else gain
        innovations = PeriodicInnovations(moved, gain, fit.result.spread, step)
        cells = self.cells
        split = None if cells is None else (cells.input_lags, cells.output_lags)
        if match.sampled is not None:
            mean = self._split_mean(match.sampled)
            return replace(match.sampled, innovations=innovations, split=split, input_mean=mean)
        model, dt = match.model, 2.0 * np.pi / self.omega / self.n_phases
        named = model if match.periodic is None else match.periodic
        names = named.input_names, named.output_names
        known = {"n_loads": -1, "delays": model.delays, "split": split}
        return SampleModel(innovations, self.omega, dt, *names, model.feedthrough, **known)

    def _split_mean(self, model):
        """Fourier coefficients of the periodic mean of the inputs that the samples now have."""
        mean, step = model.input_mean, 2.0 * np.pi / self.n_phases
        if mean is None or self.cells is None:
            return mean
        samples = model.delays.seconds / self.experiment.base.sample_time
        before = Cells.of(samples, mean.shape[1])
        lags, f = before.input_lags, before.fractions.inputs
        orders = np.arange(1, len(mean) // 2 + 1)[:, None]
        blend = 1.0 - f + f * np.exp(-1j * orders * step)
        sent = np.array(mean, dtype=float)
        waves = (sent[1::2] - 1j * sent[2::2]) / blend
        sent[1::2], sent[2::2] = waves.real, -waves.imag
        now = self.cells.input_lags - lags
        return np.hstack([turned(sent, step * each) for each in (now, now + 1)])

    def delays_of(self, delays):
        """The delays found, in seconds, their deviations not yet known."""
        if self.cells is None:
            return delays
        return delays.at(self.cells.samples * self.experiment.base.sample_time)

    def deviations(self, delays, rows):
        """The same with standard deviations from rows of a covariance in samples."""
        std = np.full(len(delays.seconds), np.nan)
        free = self.cells.fractions.free
        variance = np.diag(rows[:, rows.shape[1] - len(free) :])
        std[free] = np.sqrt(variance) * self.experiment.base.sample_time
        return delays.at(delays.seconds, std)


def _cells(experiment, raw):
    """Cells of the delays of a record that are parameters, or no whole samples; else None."""
    delays = experiment.delays
    if delays is None or not delays.n_inputs:
        return None
    samples = delays.seconds / experiment.base.sample_time
    cells = Cells.of(samples, delays.n_inputs, delays.free)
    if not delays.free.any() and np.all(np.isin(cells.fractions.whole, (0.0, 1.0))):
        return None
    if raw or np.all(experiment.basis.held):
        return cells
    if delays.free.any():
        raise ValueError(
            "estimated delays need inputs as they were measured, but this model is driven by their "
            "harmonics; keep only harmonic 0 of the inputs, use a HarmonicStructure, or give the "
            "delays in seconds"
        )
    return None


def _with_constant(inputs, n_inputs):
    """Inputs with one that is 1, behind each n of them."""
    ones = np.ones((len(inputs), 1))
    parts = [inputs[:, k : k + n_inputs] for k in range(0, max(1, inputs.shape[1]), n_inputs or 1)]
    return np.hstack([each for part in parts for each in (part, ones)])


def _coefficients(response):
    """Fourier coefficients of [A B; C D](ψ) from the samples of a turn, without rounding."""
    parts = [sampled_harmonics(M, tail_begins(M, 0.0)) for M in (response.Psi, response.Out)]
    highest = max(map(len, parts)) // 2
    return np.concatenate([resize_harmonics(part, highest) for part in parts], axis=1)


def _where(phases, n_phases):
    """First phase of each segment where all samples lie on those of a whole number; else all ψ."""
    first = np.array([psi[0] for psi in phases]) * n_phases / (2.0 * np.pi)
    drift = abs(n_phases - round(n_phases)) / n_phases * max(map(len, phases))
    if max(drift, np.max(np.abs(first - np.round(first)))) <= ON_GRID:
        return [round(each) for each in first]
    return list(phases)


def with_loads(structure, n_loads):
    """A structure with one more input, which is 1, and moves the outputs by a Fourier series.

    Of ``n_loads`` harmonics; each coefficient of each output is a parameter, after the others.
    """
    size, rows, columns = structure.constant.shape
    n, size_all = structure.n_states, max(size, 2 * n_loads + 1)
    constant = np.zeros((size_all, rows, columns + 1))
    constant[:size, :, :-1] = structure.constant
    basis = structure.basis.tocoo()
    place = np.unravel_index(basis.coords[1], structure.constant.shape)
    moved = np.ravel_multi_index(place, constant.shape)
    h, i = np.divmod(np.arange((2 * n_loads + 1) * (rows - n)), rows - n)
    loads = np.ravel_multi_index((h, n + i, np.full(len(h), columns)), constant.shape)
    k = structure.n_parameters
    table = sparse.coo_array(
        (
            np.concatenate([basis.data, np.ones(len(loads))]),
            (
                np.concatenate([basis.coords[0], k + np.arange(len(loads))]),
                np.concatenate([moved, loads]),
            ),
        ),
        shape=(k + len(loads), constant.size),
    )
    labels = harmonic_labels(range(n_loads + 1))
    names = tuple(f"load[{j}]_{labels[which]}" for which, j in zip(h, i, strict=True))
    return PeriodicStructure(constant, table.tocsr(), n, structure.parameter_names + names)


def sampling(experiment):
    """Fundamental frequency and samples a period; plain data count one sample a period."""
    basis = experiment.basis
    if not basis.harmonic:
        return 2.0 * np.pi / experiment.base.sample_time, 1
    return basis.omega, basis.samples_per_period
