"""Step 4: remove the modes that the harmonic analyzer added."""

from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import check_choice, check_count
from sklearn_hd._guards import one_blas_thread, within_range
from sklearn_hd._model_step import ModelStep
from sklearn_hd._reduce import mode_table, reduced

__all__ = ["SpuriousModeReducer"]

METHODS = ("truncate", "residualize", "both")


class SpuriousModeReducer(ModelStep):
    """Keep the genuine modes of an identified model, in continuous time.

    Through a window, a mode λ appears together with its copies λ + jpω and the window's own
    memory. The reducer

    1. removes the poles that die within the window, by an ordered Schur form;
    2. groups the others into families of one Floquet multiplier e^{λT};
    3. keeps the smallest conjugate-closed set of modes that explains the raw
       signals as well as all modes do (or the best set of ``n_states``), with no
       more modes than output coefficients unless more halve what is left
       unexplained. It calls the other members of their families copies;
    4. refines these modes on the raw record by maximum likelihood, if white noise
       is all that they then leave;
    5. fits B, D and the initial states to the raw record through the exact
       response of the kept modes, so no effect of the window remains;
    6. compares them with the second opinion that the model carries. A mode is
       ambiguous if that has another exponent, or if another set of modes explains
       the record as well.

    The modes of a window only approximate the harmonic decomposition of a time-periodic
    machine: for the decomposition itself use the default pipeline, which reads period by
    period (``HarmonicAnalyzer(reading="period")``) where inputs rest.

    Models of whole periods (``HarmonicAnalyzer(reading="period")``) and of samples
    (``reading="sample"``) use no window: they pass unchanged, and every mode is genuine.

    The other modes are truncated or residualized (Eqs. 16-19):

        Â = A_s,   D̂ = D − C_f A_f⁻¹ B_f     in modal coordinates.

    Parameters
    ----------
    estimator : estimator or None, default=None
        Estimator whose model to reduce; it is fitted here. None takes the model that X carries.
    n_states : int or None, default=None
        Number of states to keep, always of the identified modes (step 3); None lets the data
        decide as above.
    method : {"truncate", "residualize", "both"}, default="truncate"
        Treatment of the other modes: ``"truncate"`` drops them, ``"residualize"`` replaces them by
        their static gain (a feedthrough), and ``"both"``, as in the paper, drops those slower than
        ω and residualizes the faster ones. The window's memory does not exist in continuous time
        and is always dropped.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data.

    Attributes
    ----------
    system_ : control.StateSpace
        Continuous-time model; models of whole periods and of samples pass unchanged. A model of
        samples with harmonics has none: use ``ltp_`` of :class:`MOESPRegressor` or
        :class:`StructuredMatcher`, the model in continuous time.
    modes_ : DataFrame
        One row per identified mode: ``eigenvalue`` (rad/s, continuous; of a kept mode that of the
        model), ``family``, ``verdict`` (genuine, copy, window, weak, ambiguous or second-order)
        and ``reason``.
    n_states_ : int
    r2_ : float
        R² of the fit to the raw record, with fitted initial states; NaN if nothing was refitted.
    left_out_ : float
        Share of the variance left by the kept modes that all modes together would explain.
    delays_, delay_std_ : Series
        Delays of the signals, seconds, as identified.
    n_features_in_ : int
    feature_names_in_ : ndarray of str

    Raises
    ------
    ValueError
        At ``fit``, if there is no model, or no set of modes has ``n_states``.

    Warns
    -----
    IdentifiabilityWarning
        If a kept mode is in doubt (ambiguous or second-order), naming it and what speaks against
        it; if the second opinion has a mode that the model lacks; if the modes left out explain
        most of what the others leave.
    InstabilityWarning
        If a kept mode grows, so that the periodic orbit is unstable.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, section 2.3.
    Kokotović, Khalil, O'Reilly (1999), Singular Perturbation Methods in Control.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn_hd import MOESPRegressor
    >>> u = np.random.default_rng(0).standard_normal((300, 1))
    >>> y = np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> reducer = SpuriousModeReducer(MOESPRegressor(order=1, block_rows=5)).fit(u, y)
    >>> round(float(reducer.system_.poles()[0].real), 6) == round(float(np.log(0.8)), 6)
    True
    """

    def __init__(self, estimator=None, *, n_states=None, method="truncate", warmup=None):
        self.estimator = estimator
        self.n_states = n_states
        self.method = method
        self.warmup = warmup

    @one_blas_thread
    @within_range
    def fit(self, X, y):
        """Separate genuine from spurious modes, and fit the effect of inputs to the raw record.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            Must carry a model, unless ``estimator`` is given.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time.

        Returns
        -------
        self : SpuriousModeReducer
            Fitted.
        """
        method = check_choice("method", self.method, METHODS)
        if self.n_states is not None:
            check_count("n_states", self.n_states, 1, "None decides by the data")
        experiment, model = self._upstream(X, y)
        found = reduced(model, experiment, method, self.n_states)
        self._modes, self.n_states_ = found.modes, found.model.n_states
        self.r2_, self.left_out_ = found.r2, found.left_out
        return self._remember(found.model, experiment.basis, X, y, experiment)

    @property
    def modes_(self):
        """Every identified mode, with its family, verdict and reason, as a DataFrame."""
        check_is_fitted(self)
        return mode_table(*self._modes)
