"""Step 5: the identified model brought to the structure of the physics (Eqs. 20-22)."""

import warnings
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.stats import norm
from sklearn.exceptions import ConvergenceWarning
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import within_range
from sklearn_hd._base import ModelStep, upstream
from sklearn_hd._continuous import to_continuous
from sklearn_hd._frame import LTIModel
from sklearn_hd._periodic import PeriodicModel, PeriodicSimulator
from sklearn_hd._realization import realize
from sklearn_hd._refinement import (
    Uncertainty,
    refine_harmonics,
    refine_invariant,
    refine_periodic,
    uncertainty,
)
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._validation import check_choice, check_count, check_flag, check_positive
from sklearn_hd.algorithms.matching import match_structure
from sklearn_hd.algorithms.matching_problem import channel_scales, matching_grid
from sklearn_hd.algorithms.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.simulation import frequency_response
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.structures import HarmonicStructure, MatrixStructure

__all__ = ["StructuredMatcher"]

CRITERIA = ("hinf", "output_error")
POOR_MATCH = 1e-2  # relative error of a match between different orders worth a warning
MOST_SYSTEMATIC = 0.01  # share of that variance left in a rest that is not white
POOR_FIT = 0.5  # share of the raw record's variance below which a closed form is not trusted


@dataclass(frozen=True, eq=False)
class _Match:
    """A structured model: its parameters, and how it came about.

    ``structure`` and ``observed`` say how the parameters make the outputs, for the
    maximum-likelihood refinement; ``periodic`` is there for periodic structures only.
    """

    model: LTIModel
    names: tuple
    theta: np.ndarray
    structure: PeriodicStructure | None
    periodic: PeriodicModel | None = None
    theta_least_squares: np.ndarray | None = None
    hinf_error: float = np.nan
    relative_error: float = np.nan
    peak_frequency: float = np.nan
    n_iter: int = 1
    uncertainty: Uncertainty | None = None


class StructuredMatcher(ModelStep):
    """Bring the identified model to the structure of the physics.

        θ* = arg min_θ ‖G_c(s) − G_s(s; θ)‖_∞                            (Eq. 22)
        θ* = arg max_θ  likelihood of the measured y(t)        (criterion="output_error")

    With a :class:`MatrixStructure` the model is time-invariant. With a
    :class:`HarmonicStructure` it is the linear time-periodic system behind the
    harmonics: ``ltp_``, which ``predict`` then simulates, and ``system_``, its harmonic
    decomposition. A model identified period by period (``HarmonicAnalyzer(hop="period")``)
    is brought to periodic form in closed form first, whatever the structure.

    Parameters
    ----------
    estimator : estimator or None, default=None
        Whose model to match, fitted here; None takes the model that rides on X.
    structure : MatrixStructure, HarmonicStructure or None, default=None
        The structure. None leaves every entry free: the model as it is, or the periodic
        system if the model was identified period by period.
    criterion : {"hinf", "output_error"}, default="hinf"
        ``"hinf"`` matches the model identified; where the closed form is exact there is
        nothing left to minimise. ``"output_error"`` goes on from there to the parameters
        of largest likelihood for the raw record, if the noise on the outputs is white:
        no bias by windows, and standard deviations beside the parameters. It chooses the
        numbers of harmonics that a HarmonicStructure leaves open (Akaike's criterion).
    scale : bool, default=True
        Whether to scale the channels for the H∞ norm, each output by the size of its
        row of G_c, each input by that of its column; without, the units of the model
        decide which channel is matched.
    n_starts : int, default=6
        Largest number of starts tried where no exact match is found.
    random_state : int, default=0
        Seed of the starts.
    max_iter : int, default=100
        Largest number of iterations of each stage.
    tol : float, default=1e-8
        Relative decrease of the norm at which to stop.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data.

    Attributes
    ----------
    system_ : control.StateSpace
        The matched model, in continuous time, its states named by the structure.
    ltp_ : LTPSystem
        The linear time-periodic system, for periodic structures; its
        ``harmonic_decomposition(n_harmonics)`` gives the model for any N.
    theta_ : Series, shape (n_parameters,)
        The parameters by name.
    theta_std_ : Series, shape (n_parameters,)
        Their standard deviations, the Cramér-Rao bound at the estimate; NaN for
        ``criterion="hinf"``.
    covariance_ : DataFrame, shape (n_parameters, n_parameters)
    eigenvalues_ : DataFrame
        Eigenvalues, or Floquet exponents, with the standard deviations of their real and
        imaginary parts, 1/s.
    noise_std_ : Series, shape (n_outputs,)
        Standard deviation of the noise of each output, in the units of y.
    theta_least_squares_ : Series, shape (n_parameters,)
        The match in the mean square over frequency, usually the better
        estimate of parameters where no exact match exists.
    hinf_error_ : float
        ‖W_o (G_c − G_s(θ)) W_i‖_∞, W_o and W_i the channel scales; NaN where the match
        was not made in this norm.
    hinf_error_relative_ : float
        The same divided by ‖W_o G_c W_i‖_∞.
    peak_frequency_ : float
        rad/s, where the error is largest.
    n_iter_ : int
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Raises
    ------
    ValueError
        At ``fit``, if there is no model, or the structure does not fit it.
    UnstableModelError
        If the model is unstable: its response has no H∞ norm.

    Warns
    -----
    IdentifiabilityWarning
        If these outputs do not determine some parameters (they are named); if model and
        structure differ in order and match poorly; if the outputs do not determine the
        state of a periodic system, which is then in Floquet coordinates.
    ConvergenceWarning
        If the search stopped before the tolerance was met.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, section 2.4.
    Jategaonkar (2006), Flight Vehicle System Identification, chapter 4 (output error).

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn_hd import MOESPRegressor
    >>> u = np.random.default_rng(0).standard_normal((300, 1))
    >>> y = np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> structure = MatrixStructure([["-a"]], [["b"]])
    >>> matcher = StructuredMatcher(MOESPRegressor(order=1, block_rows=5), structure=structure)
    >>> matcher.fit(u, y).theta_.round(4).to_dict()
    {'a': 0.2231, 'b': 1.1157}
    """

    def __init__(
        self,
        estimator=None,
        *,
        structure=None,
        criterion="hinf",
        scale=True,
        n_starts=6,
        random_state=0,
        max_iter=100,
        tol=1e-8,
        warmup=None,
    ):
        self.estimator = estimator
        self.structure = structure
        self.criterion = criterion
        self.scale = scale
        self.n_starts = n_starts
        self.random_state = random_state
        self.max_iter = max_iter
        self.tol = tol
        self.warmup = warmup

    @one_blas_thread
    @within_range
    def fit(self, X, y):
        """Match the structure to the model that rides on X.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            With a model riding on it, unless ``estimator`` is given.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Used where the model has to be brought to continuous time here.

        Returns
        -------
        self : StructuredMatcher
        """
        self._check_settings()
        experiment, model = upstream(self, X, y)
        structure = self.structure
        if structure is not None and not isinstance(structure, MatrixStructure | HarmonicStructure):
            raise ValueError(
                f"structure={structure!r} is not understood; give a MatrixStructure, a "
                f"HarmonicStructure, or None to leave every entry free"
            )
        lifted = experiment.basis is not None and experiment.basis.synchronous and model.dt > 0.0
        if isinstance(structure, HarmonicStructure) or (lifted and structure is None):
            match = self._match_periodic(model, experiment, lifted)
        else:
            if lifted:
                model = self._realize(model, experiment, HarmonicStructure()).model
            match = self._match(to_continuous(model, experiment))
        if self.criterion == "output_error":
            match = self._refine(match, experiment)
        return self._store(match)._remember(match.model, experiment, X, y)

    def _check_settings(self):
        check_choice("criterion", self.criterion, CRITERIA)
        check_count("n_starts", self.n_starts, 0, "0 tries none beyond the first")
        check_count("max_iter", self.max_iter, 1, "100 is usual")
        check_positive("tol", self.tol, "units of the norm", "1e-8 is usual")
        check_flag("scale", self.scale)
        if self.random_state is not None:
            check_count("random_state", self.random_state, 0, "it is the seed of the starts")

    def _store(self, match):
        self.periodic_ = match.periodic
        self._parameter_names, self._theta = match.names, match.theta
        least_squares = match.theta_least_squares
        self._theta_least_squares = match.theta if least_squares is None else least_squares
        self.hinf_error_, self.hinf_error_relative_ = match.hinf_error, match.relative_error
        self.peak_frequency_, self.n_iter_ = match.peak_frequency, match.n_iter
        self._uncertainty = match.uncertainty
        return self

    # ---- time-invariant structures -----------------------------------------------------------

    def _match(self, model):
        """The structure matched to a continuous model in the H∞ norm."""
        if self.structure is None:
            return _unchanged(model)
        structure = self._checked_structure(model)
        result = self._match_affine(model, structure.affine, structure.initial)
        matrices = (result.A, result.B, result.C, result.D)
        return _Match(
            model.in_continuous_time(*matrices, state_names=_state_names(structure, model)),
            structure.parameter_names,
            result.theta,
            PeriodicStructure.time_invariant(structure.affine),
            None,
            *_figures(result),
        )

    def _match_affine(self, model, affine, initial=None):
        outputs, inputs = self._weights(model)
        result = match_structure(
            model.A,
            model.B,
            model.C,
            model.D,
            affine,
            theta0=initial,
            output_weights=outputs,
            input_weights=inputs,
            n_starts=self.n_starts,
            max_iter=self.max_iter,
            tol=self.tol,
            random_state=self.random_state,
        )
        self._warn(result, self.tol, model.n_states, affine.n_states)
        return result

    # ---- periodic structures -----------------------------------------------------------------

    def _match_periodic(self, model, experiment, lifted):
        """The linear time-periodic system behind the model."""
        if experiment.basis is None:
            raise ValueError(
                "a HarmonicStructure needs the fundamental frequency, and no harmonic basis rides "
                "on X; put a HarmonicAnalyzer before the model"
            )
        structure = HarmonicStructure() if self.structure is None else self.structure
        if lifted:
            return self._realize(model, experiment, structure)
        return self._match_decomposition(to_continuous(model, experiment), experiment, structure)

    def _realize(self, model, experiment, structure):
        """In closed form, from a model identified period by period."""
        found = realize(model, experiment, structure)
        if not found.physical:
            warnings.warn(
                f"the outputs {list(found.model.output_names)} do not determine the "
                f"{found.model.n_states} states: the model is in Floquet coordinates, in which "
                f"its states have no physical meaning; measure more outputs for that",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if found.r2 < POOR_FIT:
            warnings.warn(
                f"the periodic model explains only {max(0.0, found.r2):.0%} of the record's "
                f"variance; check order, omega and that the record is long enough, or refine it "
                f"with criterion='output_error'",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        elif found.systematic > MOST_SYSTEMATIC:
            warnings.warn(
                f"the periodic model leaves {found.systematic:.2g} of the record's variance in a "
                f"rest that is no noise (neighbouring samples are alike); check order, omega, the "
                f"harmonics that the structure allows, and whether the response is linear",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if found.unidentified:
            warnings.warn(
                f"the record does not determine {', '.join(found.unidentified)} (only some "
                f"combinations of them): of all values that fit, the smallest are taken; let "
                f"inputs change at more phases of the period, or give G and Q fewer harmonics",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        return _periodic_match(found.structure, found.theta, found.model, model, experiment.basis)

    def _match_decomposition(self, model, experiment, structure):
        """In the H∞ norm, from a model in harmonic-decomposition form."""
        basis = experiment.basis
        inputs, outputs = (tuple(s for s, _ in kept) for kept in (basis.inputs, basis.outputs))
        if structure.states is not None and set(structure.states) != set(outputs):
            raise ValueError(
                f"states={list(structure.states)} are not the outputs {list(outputs)}, whose "
                f"coefficients are the states of a harmonic decomposition; name these, or use "
                f"HarmonicAnalyzer(hop='period')"
            )
        highest = [
            max(k for _, orders in kept for k in orders) for kept in (basis.inputs, basis.outputs)
        ]
        n_harmonics = {"F": 2 * highest[1], "G": sum(highest), "P": None}
        full = structure.resolve(outputs, inputs, outputs, n_harmonics)
        theta = np.zeros(full.n_parameters)
        periodic = PeriodicModel(full.coefficients(theta), basis.omega, outputs, inputs, outputs)
        affine, seen = periodic.decomposed_structure(full, basis)
        result = self._match_affine(model, affine)
        theta[seen] = result.theta
        periodic = replace(periodic, coefficients=full.coefficients(theta))
        return _periodic_match(full, theta, periodic, model, basis, _figures(result, seen, theta))

    @property
    def ltp_(self):
        """The linear time-periodic system, as an LTPSystem."""
        check_is_fitted(self)
        if self.periodic_ is None:
            raise AttributeError(
                "ltp_ is there for a HarmonicStructure only; this match was made with "
                f"structure={self.structure!r}"
            )
        return self.periodic_.to_system()

    def _simulators(self, experiment):
        if self.periodic_ is None or self.predicts_harmonics_:
            return super()._simulators(experiment)
        basis = experiment.basis
        response = self.periodic_.sampled(basis.samples_per_period)
        return [
            PeriodicSimulator(self.periodic_, response, basis.phase_index(time), u, time)
            for u, time in zip(experiment.inputs, experiment.times(), strict=True)
        ]

    # ---- maximum likelihood ------------------------------------------------------------------

    def _refine(self, match, experiment):
        """The same structure, its parameters those of the largest likelihood of the record."""
        if match.structure is None:
            raise ValueError(
                "criterion='output_error' needs a structure whose parameters the record "
                "determines; give a MatrixStructure or a HarmonicStructure"
            )
        if match.periodic is None:
            return self._refine_invariant(match, experiment)
        asked = self.structure if self.structure is not None else HarmonicStructure()
        physical = set(match.periodic.state_names) <= set(match.periodic.output_names)
        structure = match.structure
        if physical and None in (asked.n_harmonics("F"), asked.n_harmonics("G")):
            fixed = {name: asked.n_harmonics(name) for name in "FG"}
            fixed = {name: count for name, count in fixed.items() if count is not None}
            fixed["P"] = self._n_harmonics_of_outputs(match, asked)
            structure, result = refine_harmonics(
                asked, match.periodic, fixed, experiment, self.max_iter
            )
        else:
            result = refine_periodic(structure, match.theta, experiment, self.max_iter)
        self._warn_refined(result)
        coefficients = structure.coefficients(result.theta)
        periodic = replace(match.periodic, coefficients=coefficients)
        basis = experiment.basis
        found = uncertainty(
            structure, result, experiment, *periodic.decomposed_structure(structure, basis)
        )
        refined = _periodic_match(structure, result.theta, periodic, match.model, basis)
        return replace(refined, n_iter=result.n_iter, uncertainty=found)

    @staticmethod
    def _n_harmonics_of_outputs(match, structure):
        """Highest harmonic of P in a match; None where P is the identity."""
        asked, periodic = structure.n_harmonics("P"), match.periodic
        if asked is not None or set(periodic.state_names) == set(periodic.output_names):
            return asked
        return periodic.highest("P")

    def _refine_invariant(self, match, experiment):
        structure = match.structure
        result = refine_invariant(structure, match.theta, experiment, self.max_iter)
        self._warn_refined(result)
        matrices = [M[0] for M in structure.matrices(result.theta)]
        names = match.model.state_names
        model = match.model.in_continuous_time(*matrices, state_names=names)
        everything = np.arange(structure.n_parameters)
        affine = self.structure.affine
        return replace(
            match,
            model=model,
            theta=result.theta,
            hinf_error=np.nan,  # those of the start
            relative_error=np.nan,
            peak_frequency=np.nan,
            n_iter=result.n_iter,
            uncertainty=uncertainty(structure, result, experiment, affine, everything),
        )

    @staticmethod
    def _warn_refined(result):
        if result.unidentified:
            warnings.warn(
                f"the record does not determine {', '.join(result.unidentified)} (only some "
                f"combinations of them): their standard deviation is infinite; fix some, share a "
                f"name, or use a richer record",
                IdentifiabilityWarning,
                stacklevel=4,
            )
        if not result.converged:
            warnings.warn(
                f"maximum likelihood stopped after {result.n_iter} iterations; another step would "
                f"lower the sum of squares by {result.relative_decrease:.2g} of itself; raise "
                f"max_iter",
                ConvergenceWarning,
                stacklevel=4,
            )

    # ---- parameters --------------------------------------------------------------------------

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

        Returns
        -------
        interval : DataFrame, shape (n_parameters, 2)
            Columns ``lower`` and ``upper``.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level={level!r} must be a probability between 0 and 1, such as 0.95")
        self._bounds("confidence_interval")
        reach = norm.ppf(0.5 + 0.5 * level) * self.theta_std_
        return pd.DataFrame({"lower": self.theta_ - reach, "upper": self.theta_ + reach})

    def frequency_response(self, frequencies):
        """Frequency response of ``system_`` with its standard deviation.

        Parameters
        ----------
        frequencies : array_like, shape (n_frequencies,)
            rad/s.

        Returns
        -------
        response : complex ndarray, shape (n_frequencies, n_outputs, n_inputs)
        std : complex ndarray, of the same shape
            Standard deviation of the real part + j times that of the imaginary part.
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

    def _checked_structure(self, model):
        """The structure, after checking that it fits the model."""
        structure = self.structure
        for what, given, there in (
            ("inputs", structure.n_inputs, model.input_names),
            ("outputs", structure.n_outputs, model.output_names),
        ):
            if given != len(there):
                raise ValueError(
                    f"the structure has {given} {what}, the identified model {len(there)}: "
                    f"{list(there)}; give B, C and D of that size, or change the harmonics kept"
                )
        for what, given, there in (
            ("inputs", structure.input_names, model.input_names),
            ("outputs", structure.output_names, model.output_names),
        ):
            if given is not None and tuple(given) != tuple(there):
                raise ValueError(
                    f"the structure names its {what} {list(given)}, the identified model "
                    f"{list(there)}; give the same names in the same order"
                )
        return structure

    def _weights(self, model):
        """Diagonals of W_o and W_i."""
        if not self.scale:
            return None, None
        grid = matching_grid(np.linalg.eigvals(model.A))
        grid = grid[np.isfinite(grid)]
        return channel_scales(frequency_response(model.A, model.B, model.C, model.D, 1j * grid))

    def _warn(self, result, tol, n_found, n_wanted):
        if n_found != n_wanted and result.relative_error > POOR_MATCH:
            warnings.warn(
                f"the model has {n_found} states, the structure {n_wanted}, and the match leaves "
                f"a relative error of {result.relative_error:.2g}; the structure may not be that "
                f"of the system, or SpuriousModeReducer(n_states={n_wanted}) is needed",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if result.unidentified:
            warnings.warn(
                f"these outputs do not determine {', '.join(result.unidentified)} (only some "
                f"combinations of them): fix some, share a name, or measure more outputs",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if not result.converged:
            warnings.warn(
                f"the H-infinity match stopped after {result.n_iter} iterations at a relative "
                f"error of {result.relative_error:.3g}; it could still fall by "
                f"{result.predicted_decrease:.2g} of itself where tol={tol:g} was asked for; raise "
                f"max_iter or n_starts",
                ConvergenceWarning,
                stacklevel=5,
            )


def _state_names(structure, model):
    """Names of the states: the structure's, or those of the outputs where C is the identity."""
    if structure.state_names is not None:
        return tuple(structure.state_names)
    n = structure.n_states
    C = structure.affine.constant[n:, :n]
    fixed = not structure.affine.basis[:, n:, :n].any()
    return model.output_names if fixed and np.array_equal(C, np.eye(n)) else None


def _figures(result, seen=None, theta=None):
    """Least-squares parameters, H∞ errors, peak and iterations of a match."""
    least_squares = result.theta_least_squares
    if seen is not None:
        least_squares = np.array(theta)
        least_squares[seen] = result.theta_least_squares
    return (
        least_squares,
        result.hinf_error,
        result.relative_error,
        result.peak_frequency,
        result.n_iter,
    )


def _unchanged(model):
    """No structure: every entry is a parameter, and the model stays as it is."""
    matrices = (model.A, model.B, model.C, model.D)
    names = tuple(
        f"{name}[{i},{j}]"
        for name, M in zip("ABCD", matrices, strict=True)
        for i, j in np.ndindex(M.shape)
    )
    theta = np.concatenate([M.ravel() for M in matrices])
    return _Match(model, names, theta, None, None, None, 0.0, 0.0, 0.0)


def _periodic_match(structure, theta, periodic, model, basis, figures=()):
    """The match of a periodic structure; its time-invariant model is the decomposition."""
    matrices, state_names = periodic.time_invariant(basis)
    matched = model.in_continuous_time(*matrices, state_names=state_names)
    return _Match(matched, structure.parameter_names, theta, structure, periodic, *figures)
