"""Maximum likelihood on the raw record: what a structured model is refined to.

What a simulation leaves (``criterion="output_error"``), or a prediction one sample ahead
(``"prediction_error"``), of periodic and time-invariant models, of their steps, and of models of
samples about a forced periodic response, whose Fourier coefficients are parameters too.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy import sparse
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._match.match import Uncertainty, periodic_match
from sklearn_hd._match.samples import decomposed_basis
from sklearn_hd._match.trust import trusted, warn_of_slow
from sklearn_hd._sample_model import SampleModel
from sklearn_hd._simulators import sample_simulators
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.likelihood.forms import Form, interpolating
from sklearn_hd.algorithms.likelihood.output_error import output_error_of
from sklearn_hd.algorithms.likelihood.prediction_error import fit_gain, prediction_error
from sklearn_hd.algorithms.likelihood.search import LikelihoodResult, OverflowingStartError
from sklearn_hd.algorithms.periodic.behind_samples import samples_of
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import harmonic_labels, sampled_harmonics
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.structures import HarmonicStructure

N_HARMONICS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48)
FIRST_HARMONICS = 2  # of G, and P in Floquet coordinates: more are tried afterwards
FEW_STEPS = 30  # of a search with more harmonics: one that takes longer is not determined
COARSE = 0.1  # of the likelihood, in all, by which a candidate may miss its best
PATIENCE = 2  # numbers of harmonics that do not improve on the best before the search ends
ALIGNED = 1e-6  # of a sample, by which the first may miss a phase


@dataclass(frozen=True, eq=False)
class LikelihoodSettings:
    """How to fit.

    Attributes
    ----------
    criterion : {"output_error", "prediction_error"}
    max_iter : int
    input_noise : ndarray, shape (m,), or None
    n_starts, random_state : int
        Further starts at random, of models with all entries free.
    """

    criterion: str
    max_iter: int
    input_noise: np.ndarray | None = None
    n_starts: int = 0
    random_state: int | None = 0

    @property
    def predicts(self):
        """Whether the model has a Kalman gain."""
        return self.criterion == "prediction_error"


@dataclass(frozen=True, eq=False)
class Fit:
    """A fit of a structure, with the form and the record that it was fitted to.

    Attributes
    ----------
    structure : PeriodicStructure
        Without loads.
    form : Form
        With loads and gain.
    result : LikelihoodResult
    into : ndarray, shape (k, k'), or None
        How the structure's parameters change with those of the search, where these are others.
    """

    structure: PeriodicStructure
    form: Form
    result: LikelihoodResult
    into: np.ndarray | None = None

    @property
    def theta(self):
        """Parameters of the structure."""
        return self.result.theta[: self.structure.n_parameters]

    @property
    def covariance(self):
        """Their covariance."""
        k = self.structure.n_parameters
        return self.result.covariance[:k, :k]

    @property
    def aic(self):
        """Akaike's criterion."""
        return self.result.aic


def match_likelihood(match, structure, experiment, settings):
    """A match refined to the largest likelihood of the record, in the same structure.

    Parameters
    ----------
    match : Match
        To start from.
    structure : MatrixStructure, HarmonicStructure or None
        As asked for; numbers of harmonics that it leaves open are chosen here.
    experiment : Experiment
    settings : LikelihoodSettings

    Returns
    -------
    match : Match
    """
    if match.structure is None:
        raise ValueError(
            f"criterion={settings.criterion!r} needs a structure whose parameters the record "
            f"determines; give a MatrixStructure or a HarmonicStructure"
        )
    periodic = match.periodic
    data = RecordData.of(experiment, periodic is not None, match.sampled)
    wanted = HarmonicStructure() if structure is None else structure
    bounds, given = None, match.structure
    if periodic is None:
        bounds = structure.lower, structure.upper
    open_to = _open_counts(match, wanted)
    if open_to:
        fit = _refine_harmonics(match, wanted, open_to, data, settings)
    else:
        fit = data.fit(given, match.theta, settings, bounds=bounds)
    sampled = data.sampled(fit, match)
    trust = trusted(fit, experiment, sample_simulators(sampled, experiment), all_parameters(fit))
    warn_of_slow(fit, trust, experiment)
    if periodic is None:
        refined = _invariant(match, structure, fit, trust)
    else:
        basis = experiment.basis if match.sampled is None else decomposed_basis(match, experiment)
        refined = _periodic(match, fit, basis, trust)
    warn_refined(fit.result, settings)
    return replace(refined, n_iter=fit.result.n_iter, sampled=sampled)


def _periodic(match, fit, basis, trust):
    periodic = replace(match.periodic, coefficients=fit.structure.coefficients(fit.theta))
    affine, seen = periodic.decomposed_structure(fit.structure, basis)
    refined = periodic_match(fit.structure, fit.theta, periodic, match.model, basis)
    return replace(refined, uncertainty=uncertainty_of(fit, trust, affine, seen))


def _invariant(match, structure, fit, trust):
    matrices = [M[0] for M in fit.structure.matrices(fit.theta)]
    everything = np.arange(fit.structure.n_parameters)
    return replace(
        match,
        model=match.model.in_continuous_time(*matrices, state_names=match.model.state_names),
        theta=fit.theta,
        found=None,  # that of the start
        uncertainty=uncertainty_of(fit, trust, structure.affine, everything),
    )


@dataclass(frozen=True, eq=False)
class RecordData:
    """A record as a likelihood sees it.

    Attributes
    ----------
    segments : list of (inputs, outputs, first phase or azimuths)
        A constant input last where there are loads.
    omega, n_phases : float
    observe : ndarray or None
    start : SampleModel or None
        Whose forced response is where loads start from; None without.
    discrete : bool
    """

    segments: list
    omega: float
    n_phases: float
    observe: np.ndarray | None
    start: SampleModel | None
    discrete: bool
    n_loads: int = -1

    @classmethod
    def of(cls, experiment, raw, start, *, discrete=False):
        basis = experiment.basis
        inputs = experiment.inputs if raw else experiment.drive
        omega, n_phases = sampling(experiment)
        if start is None:
            observe = None if raw or not basis.harmonic else _observation(basis)
            where = [int(basis.phase_index(time)[0]) for time in experiment.times()]
            n_loads = -1
        else:
            where = _where(experiment.phases, n_phases)
            inputs = [np.hstack([u, np.ones((len(u), 1))]) for u in inputs]
            observe, n_loads = None, basis.most_loads
        segments = list(zip(inputs, experiment.outputs, where, strict=True))
        return cls(segments, omega, n_phases, observe, start, discrete, n_loads)

    def fit(self, structure, theta, settings, *, bounds=None, gain0=None, like=None, coarse=False):
        """A structure of the inputs and outputs, fitted from some start.

        ``like`` is a fit of another structure, of whose gain and loads this one has as many
        harmonics, and starts from. A coarse one is to be compared with others.
        """
        whole, start = structure, np.asarray(theta, dtype=float)
        if self.n_loads >= 0:
            whole = with_loads(structure, self.n_loads)
            if like is None:
                loads = self.start.innovations.forced_response(max(1, self.n_loads))
                loads = loads[: 2 * self.n_loads + 1].ravel()
            else:
                loads = like.result.theta[like.structure.n_parameters :]
            start = np.concatenate([start, loads])
            if bounds is not None:
                wide = np.full(len(start) - len(theta), np.inf)
                bounds = np.append(bounds[0], -wide), np.append(bounds[1], wide)
        form = self.form(whole, start)
        options = {"bounds": bounds, "max_iter": settings.max_iter}
        if coarse:
            size = sum(y.size for _, y, _ in self.segments)
            options |= {"max_iter": min(FEW_STEPS, settings.max_iter), "tol": COARSE / size}
        if settings.predicts and like is not None:
            form = form.with_gain(like.form.n_gain_harmonics)
            found = fit_gain(form, self.segments, start, like.result.gain, **options)
            return Fit(structure, form, found.result)
        if settings.predicts:
            found = prediction_error(form, self.segments, start, gain0=gain0, **options)
            return Fit(structure, found.form, found.result)
        result = output_error_of(
            form, self.segments, start, input_sigma=settings.input_noise, **options
        )
        return Fit(structure, form, result)

    def form(self, structure, theta):
        """A structure at the clock of the record."""
        between = any(np.ndim(where) for *_, where in self.segments)
        n_phases = self.n_phases if between else round(self.n_phases)
        form = Form(structure, self.omega, n_phases, self.observe, self.discrete)
        if between and self.discrete:  # products of two matrices have twice the harmonics
            return replace(form, n_points=4 * max(structure.n_harmonics, self.n_loads) + 1)
        return interpolating(form, theta) if between else form

    def sampled(self, fit, match):
        """The predictor at samples, or the simulation of models of samples; else None."""
        gain = fit.result.gain
        structure, theta, n = fit.form.structure, fit.result.theta, fit.structure.n_states
        step = 2.0 * np.pi / self.n_phases
        if self.discrete:
            moved = structure.coefficients(theta)
        elif self.observe is not None:
            moved = _coefficients(fit.form.response(all_parameters(fit), sensitivities=False))
        else:
            moved = samples_of(structure.coefficients(theta), n, self.omega, step)
        if self.n_loads < 0:
            moved = np.concatenate([moved, np.zeros((*moved.shape[:2], 1))], axis=2)
        gain = np.zeros((1, n, moved.shape[1] - n)) if gain is None else gain
        innovations = PeriodicInnovations(moved, gain, fit.result.spread, step)
        if match.sampled is not None:
            return replace(match.sampled, innovations=innovations)
        model, dt = match.model, 2.0 * np.pi / self.omega / self.n_phases
        names = self._names(match)
        return SampleModel(innovations, self.omega, dt, *names, model.feedthrough, n_loads=-1)

    def _names(self, match):
        if match.periodic is not None:
            return match.periodic.input_names, match.periodic.output_names
        return match.model.input_names, match.model.output_names


def all_parameters(fit):
    gain = fit.result.gain
    return np.concatenate([fit.result.theta, [] if gain is None else gain.ravel()])


def _coefficients(response):
    """Fourier coefficients of [A B; C D](ψ) from the samples of a turn."""
    parts = [
        sampled_harmonics(M, (len(M) - 1) // 2) if len(M) > 1 else M
        for M in (response.Psi, response.Out)
    ]
    whole = np.zeros(
        (max(map(len, parts)), parts[0].shape[1] + parts[1].shape[1], parts[0].shape[2])
    )
    whole[: len(parts[0]), : parts[0].shape[1]] = parts[0]
    whole[: len(parts[1]), parts[0].shape[1] :] = parts[1]
    return whole


def _where(phases, n_phases):
    """First phase of each segment where all samples lie on those of a whole number; else all ψ."""
    first = np.array([psi[0] for psi in phases]) * n_phases / (2.0 * np.pi)
    drift = abs(n_phases - round(n_phases)) / n_phases * max(map(len, phases))
    if max(drift, np.max(np.abs(first - np.round(first)))) <= ALIGNED:
        return [round(each) for each in first]
    return list(phases)


def with_loads(structure, n_loads):
    """A structure with one more input, which is 1, and moves the outputs by a Fourier series.

    Parameters
    ----------
    structure : PeriodicStructure
    n_loads : int
        Harmonics; each coefficient of each output is a parameter, after the structure's own.
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


def _n_harmonics_of_outputs(match, structure):
    """Highest harmonic of P in a match; None where P is the identity."""
    asked, periodic = structure.n_harmonics("P"), match.periodic
    if asked is not None or set(periodic.state_names) == set(periodic.output_names):
        return asked
    return periodic.highest("P")


def uncertainty_of(fit, trust, affine, seen):
    """What a fit says of its own precision."""
    result = fit.result
    return Uncertainty(
        trust.covariance,
        result.sigma,
        result.aic,
        result.bic,
        trust.exponents,
        trust.exponents_std,
        affine,
        seen,
        kind=trust.kind,
        tests=trust.tests,
    )


def sampling(experiment):
    """Fundamental frequency and samples a period; plain data count one sample a period."""
    basis = experiment.basis
    if not basis.harmonic:
        return 2.0 * np.pi / experiment.base.sample_time, 1
    return basis.omega, basis.samples_per_period


def _observation(basis):
    """What is measured of harmonic coefficients at each phase."""
    spp = basis.samples_per_period
    return basis.recomposition(2.0 * np.pi * np.arange(spp) / spp)


def _open_counts(match, structure):
    """Names of the matrices whose number of harmonics the data choose, first things first.

    In Floquet coordinates F is constant, and shapes take up the difference.
    """
    if match.periodic is None:
        return ""
    names = "FG" if match.periodic.physical else "PG"
    return "".join(name for name in names if structure.n_harmonics(name) is None)


def _structures(match, structure, open_to):
    """Structures by their numbers of harmonics."""
    periodic = match.periodic
    signals = periodic.state_names, periodic.input_names, periodic.output_names
    if periodic.physical:
        fixed = {name: structure.n_harmonics(name) for name in "FG" if name not in open_to}
        fixed["P"] = _n_harmonics_of_outputs(match, structure)
        return lambda counts: structure.resolve(*signals, {**fixed, **counts})
    full, n = match.structure, periodic.n_states
    entries = full.basis.tocoo()
    harmonic, row, column = np.unravel_index(entries.coords[1], full.constant.shape)
    own = (row >= n) if "P" in open_to else np.zeros(len(row), dtype=bool)
    highest = {"P": own & (column < n), "G": (row < n) & (column >= n)}

    def restricted(counts):
        beyond = np.zeros(full.n_parameters, dtype=bool)
        for name, count in counts.items():
            beyond[entries.coords[0][highest[name] & (harmonic > 2 * count)]] = True
        return full.restricted(np.flatnonzero(~beyond))

    return restricted


def _refine_harmonics(match, structure, open_to, data, settings):
    """A periodic structure with as many harmonics as the data show.

    From the number of the start up and down, as long as Akaike's criterion falls: first
    of F (of P in Floquet coordinates), then of G. It takes a harmonic too many now and then,
    which widens the intervals; Schwarz's leaves out some that are there, and the intervals then
    miss the truth (the rotor blade's by four standard deviations). Noise on the inputs, where it
    is allowed for, looks like harmonics of G if it is not: it comes in before G is judged.

    Parameters
    ----------
    match : Match
        To start from.
    structure : HarmonicStructure
    open_to : str
        Names of the matrices whose number of harmonics is chosen.
    data : RecordData
    settings : LikelihoodSettings

    Returns
    -------
    fit : Fit
    """
    start, of_counts = match.periodic, _structures(match, structure, open_to)
    highest = int(np.ceil(data.n_phases / 2.0)) - 1
    first = {name: min(start.highest(name), FIRST_HARMONICS) for name in open_to}
    if "F" in first:
        first["F"] = start.highest("F") // 2

    def fit(counts, near, settings, like=None):
        chosen = of_counts(counts)
        found = data.fit(chosen, chosen.nearest(near), settings, like=like, coarse=True)
        return _Candidate(counts, found)

    exact = replace(settings, input_noise=None)
    best = begun = fit(first, start.coefficients, exact)
    if not begun.fit.result.converged:  # more harmonics would not be judged
        return begun.fit
    for name in open_to:
        if name == "G" and settings.input_noise is not None:
            exact = settings
            best = fit(best.counts, best.coefficients, exact)
        for step in (1, -1):
            now = best.counts[name]
            most = highest if start.physical else start.highest(name)
            ahead = [k for k in N_HARMONICS if k <= most and (k - now) * step > 0][::step]
            best = _climb(best, name, ahead, partial(fit, settings=exact))
    if settings.predicts and best is not begun:  # K answers for what a structure cannot
        again = fit(best.counts, best.coefficients, settings)
        best = min(best, again, key=lambda candidate: candidate.fit.aic)
    return data.fit(best.fit.structure, best.fit.theta, settings, like=best.fit)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A fit with some numbers of harmonics."""

    counts: dict
    fit: Fit

    @property
    def coefficients(self):
        """Of its model."""
        return self.fit.structure.coefficients(self.fit.theta)


def _climb(best, name, ahead, fit):
    """The best candidate on the way through some numbers of harmonics."""
    at, worse = best, 0
    for count in ahead:
        try:
            at = fit({**at.counts, name: count}, at.coefficients, like=at.fit)
        except OverflowingStartError:
            break
        if not at.fit.result.converged:
            break
        worse = 0 if at.fit.aic < best.fit.aic else worse + 1
        best = at if worse == 0 else best
        if worse == PATIENCE or (count < best.counts[name] and _hopeless(at.fit, best.fit)):
            break
    return best


def _hopeless(at, best):
    """Whether no part of a model class can have a smaller criterion: it fits worse, if anything."""
    return 2.0 * at.result.cost >= best.aic


def warn_closed_loop():
    """Of maximum likelihood of a simulation, after a model identified in closed loop."""
    warn(
        "criterion='output_error' simulates the record and takes all that is left for noise of the "
        "sensors; where disturbances move the machine and feedback answers, this is biased, and "
        "weighting='pbsid' has told that inputs may answer to outputs: use "
        "criterion='prediction_error', or ignore this where nothing but sensors is noisy",
        IdentifiabilityWarning,
    )


def warn_refined(result, settings, *, named=True):
    """Of a fit by maximum likelihood."""
    if named and result.unidentified:
        warn(
            f"the record does not determine {', '.join(result.unidentified)} (only some "
            f"combinations of them): their standard deviation is infinite; fix some, share a name, "
            f"or use a richer record",
            IdentifiabilityWarning,
        )
    if not result.converged:
        way = "raise max_iter"
        if result.n_iter < settings.max_iter:
            way = (
                "the start may be of another order or unstable, or the record does not determine "
                "the parameters: change the order, or give numbers of harmonics, "
                "HarmonicStructure(F=..., G=...)"
            )
        warn(
            f"maximum likelihood stopped after {result.n_iter} iterations; another step would "
            f"lower the sum of squares by {result.relative_decrease:.2g} of itself; {way}",
            ConvergenceWarning,
        )
