"""Maximum likelihood on the raw record: what a structured model is refined to."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._match.match import Uncertainty, periodic_match
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.likelihood.output_error import output_error
from sklearn_hd.algorithms.likelihood.search import LikelihoodResult
from sklearn_hd.algorithms.likelihood.uncertainty import floquet_exponent_std
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.structures import HarmonicStructure

N_HARMONICS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48)
FIRST_INPUT_HARMONICS = 2  # more of G are tried afterwards
PATIENCE = 2  # numbers of harmonics that do not improve on the best before the search ends


def match_likelihood(match, structure, experiment, max_iter, input_noise):
    """A match refined to the largest likelihood of the record, in the same structure.

    Parameters
    ----------
    match : Match
        To start from.
    structure : MatrixStructure, HarmonicStructure or None
        As asked for; numbers of harmonics that it leaves open are chosen here.
    experiment : Experiment
    max_iter : int
    input_noise : ndarray, shape (m,), or None

    Returns
    -------
    match : Match
    """
    if match.structure is None:
        raise ValueError(
            "criterion='output_error' needs a structure whose parameters the record "
            "determines; give a MatrixStructure or a HarmonicStructure"
        )
    refine = _refine_invariant if match.periodic is None else _refine_periodic
    structure = HarmonicStructure() if structure is None else structure
    refined, result = refine(match, structure, experiment, max_iter, input_noise)
    warn_refined(result)
    return refined


def _refine_periodic(match, structure, experiment, max_iter, input_noise):
    resolved = match.structure
    if match.periodic.physical and None in map(structure.n_harmonics, "FG"):
        fixed = {name: structure.n_harmonics(name) for name in "FG"}
        fixed = {name: count for name, count in fixed.items() if count is not None}
        fixed["P"] = _n_harmonics_of_outputs(match, structure)
        resolved, result = refine_harmonics(
            structure, match.periodic, fixed, experiment, max_iter, input_noise
        )
    else:
        result = refine_periodic(resolved, match.theta, experiment, max_iter, input_noise)
    periodic = replace(match.periodic, coefficients=resolved.coefficients(result.theta))
    affine, seen = periodic.decomposed_structure(resolved, experiment.basis)
    refined = periodic_match(resolved, result.theta, periodic, match.model, experiment.basis)
    found = uncertainty(resolved, result, experiment, affine, seen)
    return replace(refined, n_iter=result.n_iter, uncertainty=found), result


def _refine_invariant(match, structure, experiment, max_iter, input_noise):
    bounds = structure.lower, structure.upper
    result = refine_invariant(
        match.structure, match.theta, experiment, max_iter, input_noise, bounds
    )
    matrices = [M[0] for M in match.structure.matrices(result.theta)]
    names = match.model.state_names
    everything = np.arange(match.structure.n_parameters)
    refined = replace(
        match,
        model=match.model.in_continuous_time(*matrices, state_names=names),
        theta=result.theta,
        found=None,  # that of the start
        n_iter=result.n_iter,
        uncertainty=uncertainty(match.structure, result, experiment, structure.affine, everything),
    )
    return refined, result


def _n_harmonics_of_outputs(match, structure):
    """Highest harmonic of P in a match; None where P is the identity."""
    asked, periodic = structure.n_harmonics("P"), match.periodic
    if asked is not None or set(periodic.state_names) == set(periodic.output_names):
        return asked
    return periodic.highest("P")


def uncertainty(structure, result, experiment, affine, seen):
    """What a fit by output error says of its own precision."""
    exponents, std = floquet_exponent_std(
        structure, result.theta, result.covariance, *sampling(experiment)
    )
    return Uncertainty(
        result.covariance, result.sigma, result.aic, result.bic, exponents, std, affine, seen
    )


def sampling(experiment):
    """Fundamental frequency and samples a period; plain data count one sample a period."""
    basis = experiment.basis
    if not basis.harmonic:
        return 2.0 * np.pi / experiment.base.sample_time, 1
    return basis.omega, basis.samples_per_period


def records(experiment, inputs):
    """(inputs, outputs, first phase) of each segment."""
    basis = experiment.basis
    phases = [int(basis.phase_index(t)[0]) for t in experiment.times()]
    return list(zip(inputs, experiment.outputs, phases, strict=True))


def observation(experiment):
    """What is measured of harmonic coefficients at each phase; None on plain data."""
    basis = experiment.basis
    if not basis.harmonic:
        return None
    return basis.recomposition(
        2.0 * np.pi * np.arange(basis.samples_per_period) / basis.samples_per_period
    )


def refine_invariant(structure, theta, experiment, max_iter, input_noise=None, bounds=None):
    """A time-invariant structure between the drive and the (harmonics of the) outputs."""
    return output_error(
        structure,
        records(experiment, experiment.drive),
        *sampling(experiment),
        theta,
        observe=observation(experiment),
        input_sigma=input_noise,
        bounds=bounds,
        max_iter=max_iter,
    )


def refine_periodic(structure, theta, experiment, max_iter, input_noise=None):
    """A periodic structure between the raw inputs and outputs."""
    return output_error(
        structure,
        records(experiment, experiment.inputs),
        *sampling(experiment),
        theta,
        input_sigma=input_noise,
        max_iter=max_iter,
    )


def refine_harmonics(structure, start, fixed, experiment, max_iter, input_noise=None):
    """A periodic structure with as many harmonics of F and G as the data show.

    From the number of the start up and down, as long as Akaike's criterion falls: first
    of F, then of G. It takes a harmonic too many now and then, which widens the intervals;
    Schwarz's leaves out some that are there, and the intervals then miss the truth (the
    rotor blade's by four standard deviations). Noise on the inputs, where it is allowed
    for, looks like harmonics of G if it is not: it comes in before G is judged.

    Parameters
    ----------
    structure : HarmonicStructure
    start : PeriodicModel
    fixed : dict
        Number of harmonics of those among F, G and P that are not to be chosen.
    experiment : Experiment
    max_iter : int
    input_noise : ndarray, shape (m,), optional

    Returns
    -------
    resolved : PeriodicStructure
    result : LikelihoodResult
    """
    names = start.state_names, start.input_names, start.output_names
    highest = (experiment.basis.samples_per_period - 1) // 2
    counts = {"F": start.highest("F") // 2, "G": min(start.highest("G"), FIRST_INPUT_HARMONICS)}

    def fit(counts, near, noise=None):
        resolved = structure.resolve(*names, counts)
        theta = resolved.nearest(near)
        result = refine_periodic(resolved, theta, experiment, max_iter, noise)
        return _Candidate(counts, resolved, result)

    best = fit({**counts, **fixed}, start.coefficients)
    for name in "FG":
        if name == "G" and input_noise is not None:
            fit = partial(fit, noise=input_noise)
            best = fit(best.counts, best.resolved.coefficients(best.result.theta))
        for step in () if name in fixed else (1, -1):
            now = best.counts[name]
            ahead = [k for k in N_HARMONICS if k <= highest and (k - now) * step > 0][::step]
            best = _climb(best, name, ahead, fit)
    return best.resolved, best.result


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A fit with some numbers of harmonics."""

    counts: dict
    resolved: PeriodicStructure
    result: LikelihoodResult


def _climb(best, name, ahead, fit):
    """The best candidate on the way through some numbers of harmonics."""
    at, worse = best, 0
    for count in ahead:
        at = fit({**at.counts, name: count}, at.resolved.coefficients(at.result.theta))
        worse = 0 if at.result.aic < best.result.aic else worse + 1
        best = at if worse == 0 else best
        if worse == PATIENCE or (count < best.counts[name] and _hopeless(at, best)):
            break
    return best


def _hopeless(at, best):
    """Whether no part of a model class can have a smaller criterion: it fits worse, if anything."""
    return 2.0 * at.result.cost >= best.result.aic


def warn_closed_loop():
    """Of maximum likelihood of a simulation, after a model identified in closed loop."""
    warn(
        "criterion='output_error' simulates the record and takes all that is left for noise of the "
        "sensors; where disturbances move the machine and feedback answers, this is biased, and "
        "weighting='pbsid' has told that inputs may answer to outputs: use criterion='hinf', "
        "or ignore this where nothing but sensors is noisy",
        IdentifiabilityWarning,
    )


def warn_refined(result):
    """Of a fit by maximum likelihood."""
    if result.unidentified:
        warn(
            f"the record does not determine {', '.join(result.unidentified)} (only some "
            f"combinations of them): their standard deviation is infinite; fix some, share a name, "
            f"or use a richer record",
            IdentifiabilityWarning,
        )
    if not result.converged:
        warn(
            f"maximum likelihood stopped after {result.n_iter} iterations; another step would "
            f"lower the sum of squares by {result.relative_decrease:.2g} of itself; raise max_iter",
            ConvergenceWarning,
        )
