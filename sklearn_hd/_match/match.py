"""A structured model with its parameters: what each route of matching returns."""

from dataclasses import dataclass, replace

import numpy as np

from sklearn_hd._checks import check_frequencies
from sklearn_hd._frame import LTIModel
from sklearn_hd._match.periodic_model import PeriodicModel
from sklearn_hd.algorithms.likelihood.uncertainty import propagate_std
from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.algorithms.matching.matching import MatchResult
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure


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
        points = 1j * check_frequencies(frequencies)
        response, slopes = self.affine.response_and_sensitivity(theta[self.seen], points)
        return response, propagate_std(slopes, self.covariance[np.ix_(self.seen, self.seen)])


@dataclass(frozen=True, eq=False)
class Match:
    """A structured model: its parameters, and how it came about.

    Attributes
    ----------
    model : LTIModel
        Time-invariant, in continuous time; the harmonic decomposition of a periodic one.
    names : tuple of str
    theta : ndarray, shape (n_parameters,)
    structure : PeriodicStructure or None
        How the parameters make the matrices, for the maximum-likelihood refinement; None
        where every entry is one.
    periodic : PeriodicModel or None
        The linear time-periodic model, of periodic structures only.
    theta_least_squares : ndarray, shape (n_parameters,), or None
        The match in the mean square over frequency; None where it is ``theta``.
    found : MatchResult or None
        What the search in a norm left; None where nothing was minimised in one.
    n_iter : int
    uncertainty : Uncertainty or None
        After maximum likelihood only.
    """

    model: LTIModel
    names: tuple
    theta: np.ndarray
    structure: PeriodicStructure | None
    periodic: PeriodicModel | None = None
    theta_least_squares: np.ndarray | None = None
    found: MatchResult | None = None
    n_iter: int = 1
    uncertainty: Uncertainty | None = None

    @property
    def in_mean_square(self):
        """The parameters of the match in the mean square over frequency."""
        return self.theta if self.theta_least_squares is None else self.theta_least_squares

    @property
    def theta_std(self):
        """Standard deviations of the parameters; NaN without maximum likelihood."""
        if self.uncertainty is None:
            return np.full(len(self.theta), np.nan)
        return np.sqrt(np.diag(self.uncertainty.covariance))

    def stored(self):
        """The same without what only maximum likelihood needs."""
        return replace(self, structure=None)

    def by(self, found):
        """The same with what a search in a norm left."""
        least_squares = found.theta_least_squares
        return replace(self, theta_least_squares=least_squares, found=found, n_iter=found.n_iter)


def periodic_match(structure, theta, periodic, model, basis, found=None):
    """The match of a periodic structure; its time-invariant model is the decomposition."""
    matrices, state_names = periodic.time_invariant(basis)
    matched = model.in_continuous_time(*matrices, state_names=state_names)
    match = Match(matched, structure.parameter_names, theta, structure, periodic)
    return match if found is None else match.by(found)
