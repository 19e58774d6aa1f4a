"""Maximum likelihood on the raw record: what a structured model is refined to."""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._realization import project
from sklearn_hd.algorithms.output_error import OutputErrorResult, output_error
from sklearn_hd.algorithms.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.structured_model import AffineStructure
from sklearn_hd.algorithms.uncertainty import floquet_exponent_std, propagate_std

N_HARMONICS = (0, 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48)
FIRST_INPUT_HARMONICS = 2  # more of G are tried afterwards
PATIENCE = 2  # numbers of harmonics that do not improve on the best before the search ends


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How well the record determines a model: the Cramér-Rao bound at the estimate.

    Attributes
    ----------
    covariance : ndarray, shape (k, k)
        Of the parameters; infinite and NaN where the record does not determine them.
    noise_std : ndarray, shape (l,)
        Of the outputs' noise, in their units.
    aic, bic : float
    exponents, exponents_std : complex ndarray, shape (n,)
        Eigenvalues or Floquet exponents, 1/s; standard deviation of the real part + j
        times that of the imaginary part.
    affine : AffineStructure
        The time-invariant model, affine in some of the parameters.
    seen : ndarray of int
        Which parameters.
    """

    covariance: np.ndarray
    noise_std: np.ndarray
    aic: float
    bic: float
    exponents: np.ndarray
    exponents_std: np.ndarray
    affine: AffineStructure
    seen: np.ndarray

    def frequency_response(self, theta, frequencies):
        """Response at some frequencies (rad/s) and its standard deviation, (n, l, m) each."""
        points = 1j * np.asarray(frequencies, dtype=float)
        response, slopes = self.affine.response_and_sensitivity(theta[self.seen], points)
        return response, propagate_std(slopes, self.covariance[np.ix_(self.seen, self.seen)])


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
    if basis is None:
        return 2.0 * np.pi / experiment.base.sample_time, 1
    return basis.omega, basis.samples_per_period


def records(experiment, inputs):
    """(inputs, outputs, first phase) of each segment."""
    basis = experiment.basis
    phases = [0 if basis is None else int(basis.phase_index(t)[0]) for t in experiment.times()]
    return list(zip(inputs, experiment.outputs, phases, strict=True))


def observation(experiment):
    """What is measured of harmonic coefficients at each phase; None on plain data."""
    basis = experiment.basis
    if basis is None:
        return None
    return basis.recomposition(
        2.0 * np.pi * np.arange(basis.samples_per_period) / basis.samples_per_period
    )


def refine_invariant(structure, theta, experiment, max_iter):
    """A time-invariant structure between the drive and the (harmonics of the) outputs."""
    return output_error(
        structure,
        records(experiment, experiment.drive),
        *sampling(experiment),
        theta,
        observe=observation(experiment),
        max_iter=max_iter,
    )


def refine_periodic(structure, theta, experiment, max_iter):
    """A periodic structure between the raw inputs and outputs."""
    return output_error(
        structure,
        records(experiment, experiment.inputs),
        *sampling(experiment),
        theta,
        max_iter=max_iter,
    )


def refine_harmonics(structure, start, fixed, experiment, max_iter):
    """A periodic structure with as many harmonics of F and G as the data show.

    From the number of the start up and down, as long as Akaike's criterion falls: first
    of F, then of G.

    Parameters
    ----------
    structure : HarmonicStructure
    start : PeriodicModel
    fixed : dict
        Number of harmonics of those among F, G and P that are not to be chosen.
    experiment : Experiment
    max_iter : int

    Returns
    -------
    resolved : PeriodicStructure
    result : OutputErrorResult
    """
    names = start.state_names, start.input_names, start.output_names
    highest = (experiment.basis.samples_per_period - 1) // 2
    counts = {"F": start.highest("F") // 2, "G": min(start.highest("G"), FIRST_INPUT_HARMONICS)}

    def fit(counts, near):
        resolved = structure.resolve(*names, counts)
        theta = project(resolved, near)
        return _Candidate(counts, resolved, refine_periodic(resolved, theta, experiment, max_iter))

    best = fit({**counts, **fixed}, start.coefficients)
    for name in [name for name in "FG" if name not in fixed]:
        for step in (1, -1):
            now = best.counts[name]
            ahead = [k for k in N_HARMONICS if k <= highest and (k - now) * step > 0][::step]
            best = _climb(best, name, ahead, fit)
    return best.resolved, best.result


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A fit with some numbers of harmonics."""

    counts: dict
    resolved: PeriodicStructure
    result: OutputErrorResult


def _climb(best, name, ahead, fit):
    """The best candidate on the way through some numbers of harmonics."""
    at, worse = best, 0
    for count in ahead:
        at = fit({**at.counts, name: count}, at.resolved.coefficients(at.result.theta))
        worse = 0 if at.result.aic < best.result.aic else worse + 1
        best = at if worse == 0 else best
        if worse == PATIENCE:
            break
    return best
