"""Step 5: bring the identified model to the structure of the physics (Eqs. 20-22)."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.stats import norm
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import check_choice, check_count, check_fraction, check_positive
from sklearn_hd._frame import SampleModel
from sklearn_hd._guards import one_blas_thread, searching, warn, within_range
from sklearn_hd._match import LIKELIHOODS, MatchSettings
from sklearn_hd._match.affine import match_affine, match_samples
from sklearn_hd._match.likelihood import match_free, match_likelihood, warn_closed_loop
from sklearn_hd._match.periodic import match_periodic
from sklearn_hd._model_step import ModelStep
from sklearn_hd._opinion import WAY_OUT, contradictions, doubtful, lacks, warn_unconfirmed
from sklearn_hd._records.data import to_continuous
from sklearn_hd._records.delays import in_whole_samples
from sklearn_hd._simulators import sample_simulators
from sklearn_hd.algorithms.matching.matching_problem import numerical_rank
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.structures import HarmonicStructure, MatrixStructure

__all__ = ["StructuredMatcher"]

CRITERIA = ("hinf", "least_squares", *LIKELIHOODS)


class StructuredMatcher(ModelStep):
    """Bring the identified model to the structure of the physics.

        θ* = arg min_θ ‖W_o (G_c(s) − G_s(s; θ)) W_i‖_∞                   (Eq. 22)
        θ* = arg max_θ  likelihood of the measured y(t)        ("output_error", "prediction_error")

    With a :class:`MatrixStructure` the model is time-invariant. With a :class:`HarmonicStructure`
    it is the linear time-periodic system behind the harmonics: ``ltp_``, which ``predict`` then
    simulates, and ``system_``, its harmonic decomposition. A model of whole periods
    (``HarmonicAnalyzer(reading="period")``) is first brought to periodic form in closed form,
    whatever the structure.

    A model of samples (``reading="sample"``) is brought to continuous time in closed form.
    ``structure=None`` keeps all of it, with outputs as states if they determine the state. A
    :class:`HarmonicStructure` takes the parameters whose one-step predictions are closest to the
    model's, in units of its innovations. A :class:`MatrixStructure` needs a model without
    harmonics (``output_harmonics=0``). States are counted from the identified forced periodic
    response, which ``predict`` adds.

    Two criteria are likelihoods of the raw record. ``"output_error"`` simulates the record and
    treats all residuals as noise of the sensors. ``"prediction_error"`` predicts it one sample
    ahead, so that gusts and other process noise may move the states (innovations form):

        x[k+1] = Φ(ψ_k; θ) x[k] + Γ(ψ_k; θ) u[k] + K(ψ_k) e[k],   K(ψ) = K_0 + Σ_h K_hc cos hψ + …
        y[k] = C(ψ_k; θ) x[k] + D(ψ_k; θ) u[k] + e[k],            e white, of covariance S

        (θ, K)* = arg min ½ N log det S(θ, K),   S(θ, K) = Σ_k e[k] e[k]ᵀ / N

    S is concentrated out: it is at its own optimum for each θ and K. Akaike's criterion chooses
    the number of harmonics of K, and Schwarz's whether there is a K. Use ``"prediction_error"``
    for unstable machines measured in closed loop, because their simulation diverges;
    ``predict_ahead`` then predicts. Samples may be missing. Models of samples
    (``reading="sample"``) accept both likelihoods, which also estimate their forced periodic
    response. Of other readings both estimate what a trim that was subtracted is off by: a waveform
    of the turn, one for each record (not with ``input_noise``).

    Parameters
    ----------
    estimator : estimator or None, default=None
        Estimator whose model to match; it is fitted here. None takes the model that X carries.
    structure : MatrixStructure, HarmonicStructure or None, default=None
        The structure. None leaves every entry free: the model stays as it is, or becomes the
        periodic system if it is of whole periods, or of samples with harmonics. With a likelihood
        on plain data all entries are free, and the model stays discrete.
    criterion : {"hinf", "least_squares", "output_error", "prediction_error"}, default="hinf"
        Measure of the match. ``"hinf"`` is the largest error over frequency. ``"least_squares"``
        is the mean square over a grid of frequencies, usually the better estimate of parameters if
        no exact match exists. Where a closed form is exact, nothing is left to minimise.
        ``"output_error"`` and ``"prediction_error"`` continue from ``"least_squares"`` to the
        parameters of largest likelihood for the raw record, with noise on the outputs alone, or
        also on the states. They have no bias from windows, give standard deviations, and choose
        the numbers of harmonics that a HarmonicStructure leaves open (Akaike's criterion).
    input_noise : float, dict or None, default=None
        Standard deviation of white noise on the measured inputs, which the system does not feel (a
        dict: by input, in their units). ``"output_error"`` is then a total least squares, without
        the bias from noisy inputs. None: the inputs are exact.
    output_weights, input_weights : float, sequence or dict, default=None
        Positive numbers for the channels of the model (a dict: by name; others have weight 1), the
        diagonals of W_o and W_i. They multiply scales that give all channels of G_c equal weight,
        whatever their units.
    n_starts : int, default=6
        Number of random starts if no exact match is found before, and for likelihoods of
        time-invariant models with all entries free, which may have several maxima.
    random_state : int, default=0
        Seed of the starts.
    max_iter : int, default=100
        Largest number of iterations of each stage.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data.

    Attributes
    ----------
    system_ : control.StateSpace
        The matched model, in continuous time; the structure names its states.
    ltp_ : LTPSystem
        The linear time-periodic system, for periodic structures. ``system_``, its decomposition,
        has copies of its modes. For design use ``ltp_.minimal_model()``, which has none.
    theta_ : Series, shape (n_parameters,)
        The parameters by name.
    theta_std_ : Series, shape (n_parameters,)
        Their standard deviations; NaN without maximum likelihood. If the residuals pass the tests
        for white noise, they are the Cramér-Rao bound at the estimate.
    covariance_ : DataFrame, shape (n_parameters, n_parameters)
    covariance_type_ : {"information", "robust"}
        Origin of the standard deviations: the information of white noise, or, if the residuals are
        not white, the scores of some forty blocks of the record (the sandwich). Those of exponents
        then allow for a record of few time constants, those of parameters do not.
    residual_tests_ : DataFrame or None
        Tests of the fitted record, as :meth:`residual_tests` gives them at the level 1e-4
        (1e-3 by default): nobody asked for them, so fewer right models may fail. None with
        ``input_noise``, with too few rows, or if the simulation overflows.
    eigenvalues_ : DataFrame
        Eigenvalues, or Floquet exponents, with the standard deviations of their real and
        imaginary parts, 1/s.
    noise_std_ : Series, shape (n_outputs,)
        Standard deviation of the noise of each output, in the units of y.
    theta_least_squares_ : Series, shape (n_parameters,)
        The match in the mean square over frequency, usually the better estimate of parameters if
        no exact match exists.
    kalman_gain_ : ndarray, shape (n_states, n_outputs)
        K of the innovations form, for ``criterion="prediction_error"``; Fourier coefficients,
        shape (2 H + 1, n_states, n_outputs), if it varies.
    innovations_covariance_ : ndarray, shape (n_outputs, n_outputs)
        For ``criterion="prediction_error"``; in the units of the outputs.
    hinf_error_ : float
        ‖W_o (G_c − G_s(θ)) W_i‖_∞, with the channel scales in the weights; NaN if nothing was
        matched in a norm.
    hinf_error_relative_ : float
        The same divided by ‖W_o G_c W_i‖_∞.
    peak_frequency_ : float
        Frequency of the largest error, rad/s.
    peaks_ : DataFrame, columns frequency (rad/s), error and weight
        The peaks of the error that prevent a smaller H∞ norm, relative to ‖W_o G_c W_i‖_∞, and the
        weights of their gradients in the convex combination that vanishes at the optimum. Empty if
        the match is exact or in another norm.
    optimality_ : float
        Upper bound of the relative decrease of the criterion that is still possible at first
        order, within a step that moves the response by as much as the error. 0: stationary.
    history_ : DataFrame, columns stage and error
        The search, step by step: ``"least squares"`` (relative length of the error over
        the grid), then ``"minimax"`` (relative H∞ norm).
    sensitivity_ : Series
        Singular values of the sensitivity of the response to the parameters.
    rank_ : int
        Number of parameter combinations that the outputs determine.
    n_iter_ : int
    delays_, delay_std_ : Series
        Delays of the signals, seconds; those that MOESPRegressor left open are parameters of the
        likelihoods.
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Raises
    ------
    ValueError
        At ``fit``, if there is no model, or the structure or criterion does not fit it. Also if the
        periodic model of a HarmonicStructure, matched in a norm, leaves more of its own record than
        there was.
    UnstableModelError
        If the model is unstable: it has no H∞ norm, and ``"output_error"`` cannot simulate it over
        a record. Also if the periodic model that leaves more than there was is unstable.

    Warns
    -----
    IdentifiabilityWarning
        If these outputs do not determine some parameters (the warning names them); if model and
        structure differ in order and match poorly; if the outputs do not determine the state of a
        periodic system, which is then in Floquet coordinates; if a structure behind samples leaves
        more than a hundredth of the response's variance (a structure that asks for nothing is then
        set aside: ``predict`` simulates the identified model); if a model of whole periods needs a
        feedthrough Q that the structure does not name. After a likelihood: if the residuals are
        not white noise, or parts of the record (small and large motions, one side and the other)
        put an exponent at different places. This warning comes only if one of these holds as well:
        an exponent is not known to a tenth of its rate; the second opinion contradicts it or is
        missing; the part of a simulation's residuals that is not noise exceeds a hundredth of the
        motion's variance. Also after a likelihood: if residuals are not white noise and G needs
        more than twice the harmonics of F and P, so that it stands for states that the model lacks;
        if a mode lasts longer than the record; if a record with process noise (a Kalman gain, or
        residuals that are correlated and leave such a doubt) lasts fewer than 50 time constants of
        the slowest mode; if ``"output_error"`` follows ``weighting="pbsid"``.
    InstabilityWarning
        If the closed form for models of whole periods, or a structure behind samples, makes a
        stable model unstable.
    ConvergenceWarning
        If a likelihood's search stopped where another step would move an exponent by more than its
        standard deviation, or explain a hundredth of the motion's variance; if that of a norm
        stopped before it met its tolerance, 2e-5 between the H∞ norm and the smooth bound that is
        minimised.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, section 2.4.
    Jategaonkar (2006), Flight Vehicle System Identification, chapter 4 (output error).
    Ljung (1999), System Identification, sections 4.3 and 7.4 (prediction error).
    White (1982), Econometrica 50, 1-25 (robust covariance).

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

    The same lag, moved by process noise of standard deviation 0.09 in this record. A simulation
    misses all effects of the noise; a prediction one sample ahead misses only its last value:

    >>> shaken, e = y.copy(), 0.1 * np.random.default_rng(1).standard_normal((300, 1))
    >>> for k in range(299):
    ...     shaken[k + 1] = 0.8 * shaken[k] + u[k] + e[k]
    >>> matcher.set_params(criterion="prediction_error").fit(u, shaken).covariance_type_
    'information'
    >>> [round(float(np.std(shaken - each)), 2) for each in
    ...  (matcher.predict(u), matcher.predict_ahead(u, shaken))]
    [0.12, 0.09]
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
        n_starts=6,
        random_state=0,
        max_iter=100,
        warmup=None,
    ):
        self.estimator = estimator
        self.structure = structure
        self.criterion = criterion
        self.input_noise = input_noise
        self.output_weights = output_weights
        self.input_weights = input_weights
        self.n_starts = n_starts
        self.random_state = random_state
        self.max_iter = max_iter
        self.warmup = warmup

    @one_blas_thread
    @within_range
    def fit(self, X, y):
        """Match the structure to the model that X carries.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Must carry a model, unless ``estimator`` is given.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Used if the model has to be brought to continuous time here.

        Returns
        -------
        self : StructuredMatcher
            Fitted.
        """
        self._check_settings()
        experiment, model = self._upstream(X, y)
        of_samples = isinstance(model, SampleModel)
        match = self._of_samples if of_samples else self._of_rows
        match = match(model, experiment)
        if match.sampled is not model:  # which is then what predicts
            _warn_of_moves(model, match, self._likely)
        self.match_, self.n_iter_ = match.stored(), match.n_iter
        basis = experiment.basis
        if match.waveform is not None:
            basis = replace(basis, output_trim=basis.output_trim + match.waveform)
        n_input_harmonics = None
        if of_samples and not self._likely and match.periodic is not None:
            found = match.periodic.highest("G")  # some came with the coordinates
            n_input_harmonics = min(found, model.innovations.n_harmonics)
        return self._remember(match.model, basis, X, y, experiment, n_input_harmonics)

    def _of_samples(self, model, experiment):
        """Match a model of samples at their azimuths."""
        periodic = isinstance(self.structure, HarmonicStructure) or not model.time_invariant
        settings = self._settings(_checked_together(self, experiment.basis, periodic, periodic))
        if settings.likely and self.structure is None:
            return match_free(model, experiment, settings)
        match = match_samples(model, experiment, self.structure, settings)
        if settings.likely:
            match = match_likelihood(match, self.structure, experiment, settings, model.opinion)
        return match

    def _of_rows(self, model, experiment):
        """Match a time-invariant model of rows, harmonics or whole periods."""
        if model.closed_loop and self.criterion == "output_error":
            warn_closed_loop()
        lifted = experiment.basis.reading == "period" and model.dt > 0.0
        structure = HarmonicStructure() if lifted and self.structure is None else self.structure
        periodic = isinstance(structure, HarmonicStructure)
        settings = self._settings(_checked_together(self, experiment.basis, lifted, periodic))
        if settings.likely and structure is None and not experiment.basis.harmonic:
            return match_free(model, experiment, settings)
        opinion = model.opinion
        if lifted:
            simulated = not (periodic and settings.likely)
            route = structure if periodic else HarmonicStructure()
            match = match_periodic(model, experiment, route, simulated)
            model = match.model
        if not (lifted and periodic):
            model = to_continuous(model, experiment)
            match = match_affine(model, experiment, structure, settings)
        if settings.likely:
            match = match_likelihood(match, structure, experiment, settings, opinion)
        return match

    _likely = MatchSettings.likely  # of its own criterion

    def _settings(self, input_noise):
        names = ("criterion", "output_weights", "input_weights")
        names += ("n_starts", "random_state", "max_iter")
        known = {name: getattr(self, name) for name in names}
        return MatchSettings(**known, input_noise=input_noise)

    def _check_settings(self):
        check_choice("criterion", self.criterion, CRITERIA)
        check_count("n_starts", self.n_starts, 0, "0 tries none beyond the first")
        check_count("max_iter", self.max_iter, 1, "100 is usual")
        if self.random_state is not None:
            check_count("random_state", self.random_state, 0, "it is the seed of the starts")
        structure = self.structure
        if structure is not None and not isinstance(structure, MatrixStructure | HarmonicStructure):
            raise ValueError(
                f"structure={structure!r} is not understood; give a MatrixStructure, a "
                f"HarmonicStructure, or None to leave every entry free"
            )
        if self.input_noise is not None:
            noise = self.input_noise
            hint = "None means no noise; a dict gives each input its own, {'u': 0.1}"
            for value in noise.values() if isinstance(noise, Mapping) else [noise]:
                check_positive("input_noise", value, "units of the input", hint)

    def _simulators(self, experiment, *, exact=True):
        sampled = self.match_.sampled
        if sampled is not None and not self.predicts_harmonics_:
            if exact or sampled.split is None:
                return sample_simulators(sampled, experiment)
            if experiment.basis.reading == "sample":  # whose turns hold no whole samples
                return None
        periodic = self.match_.periodic
        if periodic is None or self.predicts_harmonics_:
            return super()._simulators(experiment, exact=exact)
        return sample_simulators(periodic.sampled(experiment.base.sample_time), experiment)

    @property
    def _split(self):
        """Delays of inputs and outputs in whole samples, if the model of samples holds the
        rest."""
        return None if self.match_.sampled is None else self.match_.sampled.split

    def _samples_late(self, experiment):
        return super()._samples_late(experiment) if self._split is None else self._split[1]

    def _compared(self, experiment):
        if self._split is None:
            return super()._compared(experiment)
        return in_whole_samples(experiment.origin, *self._split)

    def _n_input_harmonics(self):
        periodic = self.match_.periodic
        return super()._n_input_harmonics() if periodic is None else periodic.highest("G")

    def _predicts_ahead(self):
        return self.criterion == "prediction_error"

    # ---- what the match found ----------------------------------------------------------------

    @property
    def ltp_(self):
        """The linear time-periodic system, as an LTPSystem."""
        check_is_fitted(self)
        if self.match_.periodic is None:
            raise AttributeError(
                f"ltp_ exists only for a HarmonicStructure; this match was made with "
                f"structure={self.structure!r}"
            )
        return self.match_.periodic.to_system()

    @property
    def kalman_gain_(self):
        """K of the innovations form; its Fourier coefficients if it varies."""
        return self._noise("kalman_gain")

    @property
    def innovations_covariance_(self):
        """Covariance of the innovations, in the units of the outputs."""
        return self._noise("innovations_covariance")

    def _noise(self, name):
        check_is_fitted(self)
        if self.criterion != "prediction_error":
            raise AttributeError(
                f"{name}_ exists only for criterion='prediction_error'; this match was made with "
                f"criterion={self.criterion!r}"
            )
        return getattr(self.match_.sampled, name)

    @property
    def theta_(self):
        """Parameters by name, as a Series."""
        return self._by_name("theta", lambda match: match.theta)

    @property
    def theta_least_squares_(self):
        """Parameters of the match in the mean square, as a Series."""
        return self._by_name(
            "theta_least_squares",
            lambda m: m.theta if m.theta_least_squares is None else m.theta_least_squares,
        )

    @property
    def theta_std_(self):
        """Standard deviation of each parameter, as a Series; NaN without maximum likelihood."""
        return self._by_name("theta_std", lambda match: match.theta_std)

    def _by_name(self, name, values):
        check_is_fitted(self)
        return pd.Series(values(self.match_), index=list(self.match_.names), name=name)

    @property
    def covariance_(self):
        """Covariance of the parameters, as a DataFrame."""
        covariance, names = self._likelihood("covariance_").covariance, list(self.match_.names)
        return pd.DataFrame(covariance, index=names, columns=names)

    @property
    def covariance_type_(self):
        """``"information"``: for white noise; ``"robust"``: from blocks of the record."""
        return self._likelihood("covariance_type_").kind

    @property
    def residual_tests_(self):
        """Residual tests of the fitted record, by :meth:`residual_tests` with ``level=1e-4``."""
        tests = self._likelihood("residual_tests_").tests
        return None if tests is None else pd.DataFrame(tests).set_index("test")

    @property
    def noise_std_(self):
        """Standard deviation of each output's noise, as a Series, in the units of y."""
        found, names = self._likelihood("noise_std_"), list(self.target_names_)
        if self.predicts_harmonics_:
            names = [signal for signal, _ in self.basis_.outputs]
        return pd.Series(found.noise_std, index=names, name="noise_std")

    @property
    def eigenvalues_(self):
        """Eigenvalues (Floquet exponents of a periodic model), 1/s, and their deviations."""
        found = self._likelihood("eigenvalues_")
        std = found.exponents_std
        return pd.DataFrame(
            {"eigenvalue": found.exponents, "std_real": std.real, "std_imag": std.imag}
        )

    def confidence_interval(self, level=0.95):
        """Bounds θ ± z σ that contain each parameter with a given probability.

        σ is ``theta_std_``, for white noise or robust (``covariance_type_``). The normal
        distribution holds for long records.

        Parameters
        ----------
        level : float, default=0.95
            The probability, between 0 and 1.

        Returns
        -------
        interval : DataFrame, shape (n_parameters, 2)
            Columns ``lower`` and ``upper``.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If ``level`` is not a probability.
        AttributeError
            Without ``criterion="output_error"`` or ``"prediction_error"``.
        """
        level = check_fraction("level", level, "it is a probability, such as 0.95")
        self._likelihood("confidence_interval")
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
            Standard deviation of the real part + j times that of the imaginary part, from
            ``covariance_`` to first order.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        AttributeError
            Without ``criterion="output_error"`` or ``"prediction_error"``.
        """
        found = self._likelihood("frequency_response")
        return found.frequency_response(self.match_.theta, frequencies)

    def _likelihood(self, what):
        check_is_fitted(self)
        if self.match_.uncertainty is None:
            raise AttributeError(
                f"{what} exists only after maximum likelihood; fit with criterion='output_error' "
                f"or 'prediction_error'"
            )
        return self.match_.uncertainty

    @property
    def hinf_error_(self):
        """‖W_o (G_c − G_s(θ)) W_i‖_∞; NaN if nothing was matched in a norm."""
        return self._in_norm("hinf_error")

    @property
    def hinf_error_relative_(self):
        """The same divided by ‖W_o G_c W_i‖_∞."""
        return self._in_norm("relative_error")

    @property
    def peak_frequency_(self):
        """Frequency of the largest error, rad/s."""
        return self._in_norm("peak_frequency")

    @property
    def optimality_(self):
        """Relative decrease of the criterion that is still possible at first order."""
        return self._in_norm("predicted_decrease")

    def _in_norm(self, name):
        check_is_fitted(self)
        found = self.match_.found
        return np.nan if found is None else getattr(found, name)

    @property
    def peaks_(self):
        """Peaks of the error that prevent a smaller H∞ norm, as a DataFrame."""
        check_is_fitted(self)
        proof = None if self.match_.found is None else self.match_.found.certificate
        parts = ([], [], []) if proof is None else (proof.frequencies, proof.errors, proof.weights)
        columns = ["frequency", "error", "weight"]
        return pd.DataFrame(dict(zip(columns, parts, strict=True)), dtype=float)

    @property
    def history_(self):
        """Stage and error after each step of the search, as a DataFrame."""
        check_is_fitted(self)
        steps = () if self.match_.found is None else self.match_.found.history
        history = pd.DataFrame(list(steps), columns=["stage", "error"])
        return history.rename_axis("iteration")

    @property
    def sensitivity_(self):
        """Singular values of the response's sensitivity to the parameters, as a Series."""
        return pd.Series(self._singular_values("sensitivity_"), name="singular_value")

    @property
    def rank_(self):
        """Number of independent combinations of parameters that the outputs determine."""
        return numerical_rank(self._singular_values("rank_"))

    def _singular_values(self, what):
        check_is_fitted(self)
        if self.match_.found is None:
            raise AttributeError(
                f"{what} exists only after a match in a norm; fit with a structure and "
                f"criterion='hinf' or 'least_squares'"
            )
        return self.match_.found.singular_values


def _checked_together(step, basis, lifted, periodic):
    """Refuse parameters that exclude each other; the noise of each input, or None."""
    if step.output_weights is not None or step.input_weights is not None:
        if step._likely:
            raise ValueError(
                f"criterion={step.criterion!r} weights each output by its noise; output_weights "
                f"and input_weights belong to a norm, so leave them None, or use criterion='hinf' "
                f"or 'least_squares'"
            )
        if lifted and periodic:
            raise ValueError(
                "this model is brought to periodic form in closed form, which uses no weights; "
                "leave output_weights and input_weights None, or, with reading='period', use "
                "criterion='output_error', which weights each output by its noise"
            )
    given = step.input_noise
    if given is None:
        return None
    if not step._likely:
        raise ValueError(
            f"input_noise={given!r} needs maximum likelihood; fit with criterion='output_error', "
            f"or leave input_noise=None"
        )
    if step.criterion == "prediction_error":
        raise ValueError(
            f"input_noise={given!r} needs simulations, but criterion='prediction_error' predicts; "
            f"fit with criterion='output_error', or leave input_noise=None, where noise on the "
            f"inputs counts as gusts"
        )
    if step.structure is None and not basis.harmonic:
        raise ValueError(
            f"input_noise={given!r} needs the parameters of a structure, but structure=None leaves "
            f"every entry free; give a MatrixStructure, or leave input_noise=None"
        )
    if basis.reading == "sample":
        raise ValueError(
            f"input_noise={given!r} cannot be separated from the loads that a model of samples "
            f"has; use HarmonicAnalyzer(reading='period'), or leave input_noise=None"
        )
    if not periodic and not np.all(basis.held):
        raise ValueError(
            "input_noise is the noise of the measured inputs, but this model is driven by their "
            "harmonics; keep only harmonic 0 of the inputs, or use a HarmonicStructure"
        )
    names = basis.input_signals
    values = given if isinstance(given, Mapping) else dict.fromkeys(names, given)
    if set(values) != set(names):
        raise ValueError(
            f"input_noise={given!r} must give a standard deviation for each of the inputs "
            f"{list(names)}"
        )
    return np.array([float(values[name]) for name in names])


def _warn_of_moves(model, match, likely):
    """Warn of exponents that the match moved away from what a second opinion confirms."""
    opinion = model.opinion
    if opinion is None or searching():
        return
    exponents, periodic = model.exponents(), match.periodic
    found = periodic.to_system().floquet_exponents() if periodic else match.model.exponents()
    if not contradictions(exponents, opinion):
        warn_unconfirmed(found, opinion)
        unconfirmed = doubtful(found, replace(opinion, own=True))
        if not likely and unconfirmed.any():
            warn_unconfirmed(found[unconfirmed], opinion.of_identified(exponents))
    lost = lacks(found, opinion.of_whole(exponents[~doubtful(exponents, opinion)]))
    if lost and len(found) == model.n_states:
        warn(f"{lost}, where the match has moved it; {WAY_OUT}", IdentifiabilityWarning)
