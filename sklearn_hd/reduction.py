"""Step 4: drop the modes that the harmonic analyzer put in."""

from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import check_choice, check_count
from sklearn_hd._guards import one_blas_thread, within_range
from sklearn_hd._model_step import ModelStep
from sklearn_hd._reduce.choice import mode_table
from sklearn_hd._reduce.reduction import reduced
from sklearn_hd._upstream import upstream

__all__ = ["SpuriousModeReducer"]

METHODS = ("truncate", "residualize", "both")


class SpuriousModeReducer(ModelStep):
    """Keep the genuine modes of an identified model, in continuous time.

    Seen through a window, a mode λ appears beside its copies λ + jpω and the
    window's own memory. The reducer

    1. splits off the poles that die within the window, by an ordered Schur form;
    2. groups the others into families of one Floquet multiplier e^{λT};
    3. keeps the smallest conjugate-closed set of modes that explains the raw
       signals as well as all of them do, and no more of them than there are
       output coefficients unless more halve what is left unexplained (or the
       best set of ``n_states``), and calls the rest of their families copies;
    4. where some families make as many states as there are outputs and the
       inputs come to rest, refines their exponents on the raw free decay,
       takes the mode shapes P(ψ) from it, F(ψ) = (P′ + P R) P⁻¹ from them,
       and from that the harmonic decomposition, which no choice within a
       family can bias; it replaces the modes of 3. if it explains the raw
       signals as well;
    5. fits B, D and the initial states to the raw record through the exact
       response of what is kept, so that the window leaves no trace. Where
       another set of modes does as well, the verdict is ambiguous.

    Models of whole periods (``HarmonicAnalyzer(reading="period")``) and of samples
    (``reading="sample"``) saw no window: they pass unchanged, every mode genuine.

    Modes that are dropped are truncated, or residualized (Eqs. 16-19):

        Â = A_s,   D̂ = D − C_f A_f⁻¹ B_f     in modal coordinates.

    Parameters
    ----------
    estimator : estimator or None, default=None
        Whose model to reduce, fitted here; None takes the model that rides on X.
    n_states : int or None, default=None
        States to keep, always of the modes identified (3.); None decides by
        the data as above.
    method : {"truncate", "residualize", "both"}, default="truncate"
        What becomes of the other modes: dropped, replaced by their static
        gain (a feedthrough), or, with ``"both"``, dropped where slower than ω
        and residualized where faster, as in the paper. The window's memory,
        which has no place in continuous time, is always dropped.
    warmup : float or None, default=None
        Seconds at the start of each segment on which ``score`` fits the
        initial state; None is five periods, or 50 samples on plain data.

    Attributes
    ----------
    system_ : control.StateSpace
        Continuous-time model; models of whole periods and of samples pass unchanged. Of
        samples whose model has harmonics there is none: ``ltp_`` of
        :class:`MOESPRegressor` or :class:`StructuredMatcher` is the model in continuous time.
    modes_ : DataFrame
        One row a mode identified: ``eigenvalue`` (rad/s, continuous),
        ``family``, ``verdict`` (genuine, copy, window, weak or ambiguous) and
        ``reason``.
    n_states_ : int
    r2_ : float
        R² of the fit to the raw record, initial states fitted too; NaN where
        nothing had to be refitted.
    left_out_ : float
        Share of the variance that the modes kept leave unexplained which all
        modes together would explain.
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
        If another set of modes explains the data as well.
    InstabilityWarning
        If a mode kept grows: the periodic orbit is unstable.

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
        """Tell genuine from spurious modes, and fit the inputs' effect to the raw record.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features)
            With a model riding on it, unless ``estimator`` is given.
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
        experiment, model = upstream(self, X, y)
        found = reduced(model, experiment, method, self.n_states)
        self._modes, self.n_states_ = found.modes, found.model.n_states
        self.r2_, self.left_out_ = found.r2, found.left_out
        return self._remember(found.model, experiment.basis, X, y, experiment)

    @property
    def modes_(self):
        """Every mode identified, with its family, verdict and reason, as a DataFrame."""
        check_is_fitted(self)
        return mode_table(*self._modes)
