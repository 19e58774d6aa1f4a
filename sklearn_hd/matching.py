"""Step 5: the identified model brought to the structure of the physics (Eqs. 20-22)."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import within_range
from sklearn_hd._checks import check_choice, check_count, check_flag, check_positive
from sklearn_hd._continuous import to_continuous
from sklearn_hd._match.match import Match, NormReport, ParameterReport, periodic_match
from sklearn_hd._match.norm_matching import NORMS, NormSettings
from sklearn_hd._match.periodic import PeriodicModel, PeriodicSimulator
from sklearn_hd._match.realization import realize
from sklearn_hd._match.refinement import refine
from sklearn_hd._match.warned import (
    warn_closed_loop,
    warn_growing,
    warn_matched,
    warn_realized,
    warn_refined,
)
from sklearn_hd._model_step import ModelStep, upstream
from sklearn_hd._progress import check_verbose, progress
from sklearn_hd._readings import highest_harmonic
from sklearn_hd._threads import one_blas_thread
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.reporting import stage
from sklearn_hd.structures import HarmonicStructure, MatrixStructure

__all__ = ["StructuredMatcher"]

CRITERIA = (*NORMS, "output_error")
SEARCH = ("n_starts", "n_jobs", "max_iter", "tol", "random_state")  # told to every search


class StructuredMatcher(NormReport, ParameterReport, ModelStep):
    """Bring the identified model to the structure of the physics.

        θ* = arg min_θ ‖W_o(s) (G_c(s) − G_s(s; θ)) W_i(s)‖_∞             (Eq. 22)
        θ* = arg max_θ  likelihood of the measured y(t)        (criterion="output_error")

    With a :class:`MatrixStructure` the model is time-invariant. With a
    :class:`HarmonicStructure` it is the linear time-periodic system behind the
    harmonics: ``ltp_``, which ``predict`` then simulates, and ``system_``, its harmonic
    decomposition. A model identified period by period (``HarmonicAnalyzer(reading="period")``)
    is brought to periodic form in closed form first, whatever the structure.

    Parameters
    ----------
    estimator : estimator or None, default=None
        Whose model to match, fitted here; None takes the model that rides on X.
    structure : MatrixStructure, HarmonicStructure or None, default=None
        The structure. None leaves every entry free: the model as it is, or the periodic
        system if the model was identified period by period.
    criterion : {"hinf", "h2", "least_squares", "output_error"}, default="hinf"
        In what the model identified is matched: ``"hinf"``, the largest error over
        frequency; ``"h2"``, the size of the error's impulse response, for which D_s must
        be able to equal D_c; ``"least_squares"``, the mean square over a grid of
        frequencies in which all channels count alike, usually the better estimate of
        parameters where no exact match exists. Where a closed form is exact there is
        nothing left to minimise. ``"output_error"`` goes on from the latter to the
        parameters of largest likelihood for the raw record, if the noise on the outputs
        is white: no bias by windows, and standard deviations beside the parameters. It
        chooses the numbers of harmonics that a HarmonicStructure leaves open (Akaike's
        criterion).
    input_noise : float, dict or None, default=None
        Standard deviation of white noise on the measured inputs (a dict: by input, in
        their units), which the system does not feel. Maximum likelihood then is a total
        least squares, without the bias that noisy inputs give. None: they are exact.
    output_weights, input_weights : float, sequence, dict or linear system, default=None
        W_o and W_i, by channel of the model (a dict: by name; what is not named weighs 1).
        A weight is a positive number, or a stable continuous transfer function of one
        channel or of all: from control or scipy.signal, or a tuple A, B, C, D.
    scale : bool, default=True
        Whether to scale the channels beside these weights, each output by the size of its
        row of G_c, each input by that of its column; without, the units of the model
        decide which channel is matched. In the mean square channels always count alike,
        but for the numbers given as weights.
    n_starts : int, default=6
        Largest number of starts tried where no exact match is found.
    n_jobs : int or None, default=None
        Starts tried at once, in processes of their own; the match is the same.
    random_state : int, default=0
        Seed of the starts.
    max_iter : int, default=100
        Largest number of iterations of each stage. Searches over more than 1000 parameters
        times states also end where 20 steps earn less than 1e-4 of the norm.
    tol : float, default=1e-8
        Relative decrease of the norm at which to stop.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data.
    verbose : int, default=0
        1 shows a progress bar, in terminals and notebooks only: starts tried, steps of the
        search, and where it stands. With ``n_jobs`` above one it counts the starts that
        have ended.

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
        ‖W_o (G_c − G_s(θ)) W_i‖_∞, channel scales included in the weights; NaN where
        nothing was matched in a norm.
    hinf_error_relative_ : float
        The same divided by ‖W_o G_c W_i‖_∞.
    h2_error_ : float
        ‖W_o (G_c − G_s(θ)) W_i‖_2; infinite where the feedthroughs differ.
    peak_frequency_ : float
        rad/s, where the error is largest.
    peaks_ : DataFrame, columns frequency (rad/s), error and weight
        The peaks of the error that hold the H∞ norm where it is, relative to
        ‖W_o G_c W_i‖_∞, and the weights of their gradients in the convex combination that
        vanishes at the optimum. Empty where the match is exact or in another norm.
    optimality_ : float
        By how much, relative to itself, the criterion could still fall at first order,
        within a step that moves the response by as much as the error. 0: stationary.
    history_ : DataFrame, columns stage and error
        The search, step by step: ``"least squares"`` (relative length of the error over
        the grid), then ``"minimax"`` (relative H∞ norm) or ``"h2"``.
    sensitivity_ : Series
        Singular values of the sensitivity of the response to the parameters.
    rank_ : int
        How many combinations of parameters the outputs determine.
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
    InstabilityWarning
        If the closed form for models identified period by period makes a stable one unstable.
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
        input_noise=None,
        output_weights=None,
        input_weights=None,
        scale=True,
        n_starts=6,
        n_jobs=None,
        random_state=0,
        max_iter=100,
        tol=1e-8,
        warmup=None,
        verbose=0,
    ):
        self.estimator = estimator
        self.structure = structure
        self.criterion = criterion
        self.input_noise = input_noise
        self.output_weights = output_weights
        self.input_weights = input_weights
        self.scale = scale
        self.n_starts = n_starts
        self.n_jobs = n_jobs
        self.random_state = random_state
        self.max_iter = max_iter
        self.tol = tol
        self.warmup = warmup
        self.verbose = verbose

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
            Fitted.
        """
        self._check_settings()
        experiment, model = upstream(self, X, y)
        if model.closed_loop and self.criterion == "output_error":
            warn_closed_loop()
        structure = self.structure
        if structure is not None and not isinstance(structure, MatrixStructure | HarmonicStructure):
            raise ValueError(
                f"structure={structure!r} is not understood; give a MatrixStructure, a "
                f"HarmonicStructure, or None to leave every entry free"
            )
        lifted = experiment.basis.reading == "period" and model.dt > 0.0
        periodic = isinstance(structure, HarmonicStructure) or (lifted and structure is None)
        noise = self._input_noise(experiment, periodic)
        self._check_weights(closed_form=periodic and lifted)
        with progress(self.verbose) as report:
            if periodic:
                match = self._match_periodic(model, experiment, lifted, report)
            else:
                if lifted:
                    model = self._realize(model, experiment, HarmonicStructure(), report).model
                match = self._match(to_continuous(model, experiment), report)
            if self.criterion == "output_error":
                match = self._refine(match, experiment, noise, report)
        return self._store(match)._remember(match.model, experiment, X, y)

    def _check_settings(self):
        check_choice("criterion", self.criterion, CRITERIA)
        check_count("n_starts", self.n_starts, 0, "0 tries none beyond the first")
        if self.n_jobs is not None and self.n_jobs != -1:
            check_count("n_jobs", self.n_jobs, 1, "None is one process, -1 all processors")
        check_count("max_iter", self.max_iter, 1, "100 is usual")
        check_positive("tol", self.tol, "units of the norm", "1e-8 is usual")
        check_flag("scale", self.scale)
        check_verbose(self.verbose)
        if self.input_noise is not None:
            noise = self.input_noise
            hint = "None is none, and a dict gives each input its own, {'u': 0.1}"
            for value in noise.values() if isinstance(noise, Mapping) else [noise]:
                check_positive("input_noise", value, "units of the input", hint)
        if self.random_state is not None:
            check_count("random_state", self.random_state, 0, "it is the seed of the starts")

    def _check_weights(self, closed_form):
        """Refuse weights where no norm is minimised."""
        if self.output_weights is None and self.input_weights is None:
            return
        if self.criterion == "output_error":
            raise ValueError(
                "criterion='output_error' weighs each output by its noise; output_weights and "
                "input_weights are those of a norm, so leave them None, or use criterion='hinf', "
                "'h2' or 'least_squares'"
            )
        if closed_form:
            raise ValueError(
                "a model identified period by period is brought to periodic form in closed form, "
                "where nothing is weighed; leave output_weights and input_weights None, or use "
                "criterion='output_error', which weighs each output by its noise"
            )

    def _store(self, match):
        self._periodic = match.periodic
        self._parameter_names, self._theta = match.names, match.theta
        least_squares = match.theta_least_squares
        self._theta_least_squares = match.theta if least_squares is None else least_squares
        self._store_found(match.found)
        self.n_iter_, self._uncertainty = match.n_iter, match.uncertainty
        return self

    # ---- time-invariant structures -----------------------------------------------------------

    def _match(self, model, report):
        """The structure matched to a continuous model in the norm of the criterion."""
        if self.structure is None:
            return _unchanged(model)
        structure = self._checked_structure(model)
        bounds = structure.lower, structure.upper
        result = self._match_affine(model, structure.affine, report, structure.initial, bounds)
        matrices = (result.A, result.B, result.C, result.D)
        return Match(
            model.in_continuous_time(*matrices, state_names=_state_names(structure, model)),
            structure.parameter_names,
            result.theta,
            PeriodicStructure.time_invariant(structure.affine),
        ).by(result)

    def _match_affine(self, model, affine, report, initial=None, bounds=None):
        if affine.n_parameters == 0:
            raise ValueError(
                f"the structure has no free parameter, so there is nothing to match: let entries "
                f"be NaN or names, or free some of those fixed, {list(self.structure.fixed)}"
            )
        settings = NormSettings(
            criterion="least_squares" if self.criterion == "output_error" else self.criterion,
            scale=self.scale,
            output_weights=self.output_weights,
            input_weights=self.input_weights,
            search={name: getattr(self, name) for name in SEARCH},
        )
        result = settings.match(model, affine, initial, bounds, report)
        warn_matched(result, settings, np.linalg.eigvals(model.A), affine)
        return result

    # ---- periodic structures -----------------------------------------------------------------

    def _match_periodic(self, model, experiment, lifted, report):
        """The linear time-periodic system behind the model."""
        if not experiment.basis.harmonic:
            raise ValueError(
                "a HarmonicStructure needs the fundamental frequency, and no harmonic basis rides "
                "on X; put a HarmonicAnalyzer before the model"
            )
        structure = HarmonicStructure() if self.structure is None else self.structure
        if lifted:
            return self._realize(model, experiment, structure, report)
        model = to_continuous(model, experiment)
        return self._match_decomposition(model, experiment, structure, report)

    def _realize(self, model, experiment, structure, report):
        """In closed form, from a model identified period by period."""
        stage(report, "periodic model in closed form")
        found = realize(model, experiment, structure)
        warn_realized(found)
        if self.criterion != "output_error":  # which simulates the record
            warn_growing(found.model, model, experiment)
        return periodic_match(found.structure, found.theta, found.model, model, experiment.basis)

    def _match_decomposition(self, model, experiment, structure, report):
        """In the norm of the criterion, from a model in harmonic-decomposition form."""
        basis = experiment.basis
        inputs, outputs = (tuple(s for s, _ in kept) for kept in (basis.inputs, basis.outputs))
        if structure.states is not None and set(structure.states) != set(outputs):
            raise ValueError(
                f"states={list(structure.states)} are not the outputs {list(outputs)}, whose "
                f"coefficients are the states of a harmonic decomposition; name these, or use "
                f"HarmonicAnalyzer(reading='period')"
            )
        driven, measured = map(highest_harmonic, (basis.inputs, basis.outputs))
        n_harmonics = {"F": 2 * measured, "G": driven + measured, "P": None}
        full = structure.resolve(outputs, inputs, outputs, n_harmonics)
        zero = np.zeros(full.n_parameters)
        periodic = PeriodicModel(full.coefficients(zero), basis.omega, outputs, inputs, outputs)
        affine, seen = periodic.decomposed_structure(full, basis)
        result = self._match_affine(model, affine, report)
        if self.criterion == "output_error":  # the raw record sees them all
            resolved, theta = full, zero
            theta[seen] = result.theta
        else:
            resolved, theta = full.restricted(seen), result.theta
        periodic = replace(periodic, coefficients=resolved.coefficients(theta))
        return periodic_match(resolved, theta, periodic, model, basis, result)

    @property
    def ltp_(self):
        """The linear time-periodic system, as an LTPSystem."""
        check_is_fitted(self)
        if self._periodic is None:
            raise AttributeError(
                "ltp_ is there for a HarmonicStructure only; this match was made with "
                f"structure={self.structure!r}"
            )
        return self._periodic.to_system()

    def _simulators(self, experiment):
        if self._periodic is None or self.predicts_harmonics_:
            return super()._simulators(experiment)
        basis = experiment.basis
        response = self._periodic.sampled(basis.samples_per_period)
        return [
            PeriodicSimulator(self._periodic, response, basis.phase_index(time), u, time)
            for u, time in zip(experiment.inputs, experiment.times(), strict=True)
        ]

    # ---- maximum likelihood ------------------------------------------------------------------

    def _refine(self, match, experiment, input_noise, report):
        """The same structure, its parameters those of the largest likelihood of the record."""
        if match.structure is None:
            raise ValueError(
                "criterion='output_error' needs a structure whose parameters the record "
                "determines; give a MatrixStructure or a HarmonicStructure"
            )
        structure = HarmonicStructure() if self.structure is None else self.structure
        refined, result = refine(match, structure, experiment, self.max_iter, input_noise, report)
        warn_refined(result)
        return refined

    def _input_noise(self, experiment, periodic):
        """Standard deviation of the noise of each input, or None."""
        given, basis = self.input_noise, experiment.basis
        if given is None:
            return None
        if self.criterion != "output_error":
            raise ValueError(
                f"input_noise={given!r} is allowed for by maximum likelihood only; fit with "
                f"criterion='output_error', or leave input_noise=None"
            )
        names = basis.input_signals
        if not periodic and not np.all(basis.held):
            raise ValueError(
                "input_noise is that of the measured inputs, but this model is driven by their "
                "harmonics; keep harmonic 0 of the inputs alone, or use a HarmonicStructure"
            )
        values = given if isinstance(given, Mapping) else dict.fromkeys(names, given)
        unknown = [name for name in values if name not in names]
        if unknown or len(values) != len(names):
            raise ValueError(
                f"input_noise={given!r} must give a standard deviation for each of the inputs "
                f"{list(names)}"
            )
        return np.array([float(values[name]) for name in names])

    # ---- details -----------------------------------------------------------------------------

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


def _state_names(structure, model):
    """Names of the states: the structure's, or those of the outputs where C is the identity."""
    if structure.state_names is not None:
        return tuple(structure.state_names)
    n = structure.n_states
    C = structure.affine.constant[n:, :n]
    fixed = not structure.affine.basis[:, n:, :n].any()
    return model.output_names if fixed and np.array_equal(C, np.eye(n)) else None


def _unchanged(model):
    """No structure: every entry is a parameter, and the model stays as it is."""
    matrices = (model.A, model.B, model.C, model.D)
    names = tuple(
        f"{name}[{i},{j}]"
        for name, M in zip("ABCD", matrices, strict=True)
        for i, j in np.ndindex(M.shape)
    )
    theta = np.concatenate([M.ravel() for M in matrices])
    return Match(model, names, theta, None)
