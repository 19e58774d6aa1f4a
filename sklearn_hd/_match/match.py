"""A structured model with its parameters: what matching leaves, and how it is reported."""

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.stats import norm
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import check_fraction, check_frequencies
from sklearn_hd._frame import LTIModel
from sklearn_hd._match.periodic import PeriodicModel
from sklearn_hd.algorithms.likelihood.uncertainty import propagate_std
from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.algorithms.matching.matching import MatchResult
from sklearn_hd.algorithms.matching.matching_problem import numerical_rank
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


class NormReport:
    """How near a fitted match came in its norm, and what certifies it."""

    def _store_found(self, found):
        """Keep the figures of a MatchResult as numbers and arrays; NaN where there is none."""
        self.hinf_error_ = self.hinf_error_relative_ = self.h2_error_ = np.nan
        self.peak_frequency_ = self.optimality_ = np.nan
        self._peaks, self._history = np.empty((0, 3)), ()
        self._singular_values = np.empty(0)
        if found is None:
            return
        self.hinf_error_, self.hinf_error_relative_ = found.hinf_error, found.relative_error
        self.h2_error_, self.peak_frequency_ = found.h2_error, found.peak_frequency
        self._history, self._singular_values = found.history, found.singular_values
        self.optimality_ = found.predicted_decrease
        if found.certificate is not None:
            proof = found.certificate
            self.optimality_ = max(proof.distance, proof.predicted_decrease)
            self._peaks = np.stack([proof.frequencies, proof.errors, proof.weights], axis=1)

    @property
    def peaks_(self):
        """Peaks of the error that hold the H∞ norm where it is, as a DataFrame."""
        check_is_fitted(self)
        return pd.DataFrame(self._peaks, columns=["frequency", "error", "weight"])

    @property
    def history_(self):
        """Stage and error after each step of the search, as a DataFrame."""
        check_is_fitted(self)
        history = pd.DataFrame(list(self._history), columns=["stage", "error"])
        return history.rename_axis("iteration")

    @property
    def sensitivity_(self):
        """Singular values of the response's sensitivity to the parameters, as a Series."""
        return pd.Series(self._sizes("sensitivity_"), name="singular_value")

    @property
    def rank_(self):
        """Number of independent combinations of parameters that the outputs determine."""
        return numerical_rank(self._sizes("rank_"))

    def _sizes(self, what):
        check_is_fitted(self)
        if len(self._singular_values) == 0:
            raise AttributeError(
                f"{what} is there after a match in a norm only; fit with a structure and "
                f"criterion='hinf', 'h2' or 'least_squares'"
            )
        return self._singular_values


class ParameterReport:
    """Parameters of a fitted step by name, and how well the record determines them."""

    @property
    def theta_(self):
        """Parameters by name, as a Series."""
        check_is_fitted(self)
        return pd.Series(self._theta, index=list(self._parameter_names), name="theta")

    @property
    def theta_least_squares_(self):
        """Parameters of the match in the mean square, as a Series."""
        check_is_fitted(self)
        names = list(self._parameter_names)
        return pd.Series(self._theta_least_squares, index=names, name="theta_least_squares")

    @property
    def theta_std_(self):
        """Standard deviation of each parameter, as a Series; NaN without maximum likelihood."""
        check_is_fitted(self)
        std = np.full(len(self._theta), np.nan)
        if self._uncertainty is not None:
            std = np.sqrt(np.diag(self._uncertainty.covariance))
        return pd.Series(std, index=list(self._parameter_names), name="theta_std")

    @property
    def covariance_(self):
        """Covariance of the parameters, as a DataFrame."""
        names = list(self._parameter_names)
        return pd.DataFrame(self._bounds("covariance_").covariance, index=names, columns=names)

    @property
    def noise_std_(self):
        """Standard deviation of each output's noise, as a Series, in the units of y."""
        names = list(self.target_names_)
        if self.predicts_harmonics_:
            names = [signal for signal, _ in self.basis_.outputs]
        return pd.Series(self._bounds("noise_std_").noise_std, index=names, name="noise_std")

    @property
    def eigenvalues_(self):
        """Eigenvalues (Floquet exponents of a periodic model), 1/s, and their deviations."""
        found = self._bounds("eigenvalues_")
        return pd.DataFrame(
            {
                "eigenvalue": found.exponents,
                "std_real": found.exponents_std.real,
                "std_imag": found.exponents_std.imag,
            }
        )

    def confidence_interval(self, level=0.95):
        """Bounds θ ± z σ between which each parameter lies with some probability.

        Parameters
        ----------
        level : float, default=0.95
            That probability, between 0 and 1.

        Returns
        -------
        interval : DataFrame, shape (n_parameters, 2)
            Columns ``lower`` and ``upper``.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If ``level`` is no probability.
        AttributeError
            Without ``criterion="output_error"``.
        """
        level = check_fraction("level", level, "it is a probability, such as 0.95")
        self._bounds("confidence_interval")
        reach = norm.ppf(0.5 + 0.5 * level) * self.theta_std_
        return pd.DataFrame({"lower": self.theta_ - reach, "upper": self.theta_ + reach})

    def frequency_response(self, frequencies):
        """Frequency response of ``system_`` with its standard deviation.

        Parameters
        ----------
        frequencies : array_like, shape (n_frequencies,)
            In rad/s.

        Returns
        -------
        response : complex ndarray, shape (n_frequencies, n_outputs, n_inputs)
            G(jΩ) between the signals of ``system_``.
        std : complex ndarray, of the same shape
            Standard deviation of the real part + j times that of the imaginary part.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        AttributeError
            Without ``criterion="output_error"``.
        """
        found = self._bounds("frequency_response")
        return found.frequency_response(self._theta, frequencies)

    def _bounds(self, what):
        check_is_fitted(self)
        if self._uncertainty is None:
            raise AttributeError(
                f"{what} is there after maximum likelihood only; fit with criterion='output_error'"
            )
        return self._uncertainty
