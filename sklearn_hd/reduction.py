"""Step 4: drop the modes that the harmonic analyzer put in."""

from dataclasses import replace

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import within_range
from sklearn_hd._checks import check_choice, check_count
from sklearn_hd._continuous import refit_inputs, scaled_outputs, to_continuous
from sklearn_hd._fit_checks import warn_of_growth
from sklearn_hd._model_step import ModelStep, upstream
from sklearn_hd._progress import check_verbose, progress
from sklearn_hd._reduce.mode_choice import (
    NEARLY_ALL,
    ROUNDING,
    choose_modes,
    continuous_exponents,
    identified_modes,
    mode_table,
    verdicts,
    warn_of_doubt,
)
from sklearn_hd._reduce.raw_modes import periodic_decomposition, refined_modes
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.lti.residualization import residualize
from sklearn_hd.algorithms.lti.simulation import discrete_to_continuous
from sklearn_hd.algorithms.modes.modes import conjugate_units, family_exponents, invariant_pair
from sklearn_hd.algorithms.reporting import within
from sklearn_hd.exceptions import IdentifiabilityWarning

__all__ = ["SpuriousModeReducer"]

METHODS = ("truncate", "residualize", "both")
MULTIPLIER_ANGLE = 0.3  # rad; a multiplier turned by less may be a real one
REFINED_GAIN = 1 / 3  # by which refinement may be hoped to lower what is left
MAX_REFINED = 4  # sets that are refined, for the time it takes
WORSE_BY = 0.1  # of what is left: by which F(ψ) from mode shapes may do worse than the modes


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
    verbose : int, default=0
        1 shows a progress bar, in terminals and notebooks only: modes are refined on the
        raw record, which can take some seconds.

    Attributes
    ----------
    system_ : control.StateSpace
        Continuous-time model; a period-synchronous model passes unchanged.
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

    def __init__(self, estimator=None, *, n_states=None, method="truncate", warmup=None, verbose=0):
        self.estimator = estimator
        self.n_states = n_states
        self.method = method
        self.warmup = warmup
        self.verbose = verbose

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
        check_verbose(self.verbose)
        experiment, model = upstream(self, X, y)
        basis = experiment.basis
        self.r2_, self.left_out_ = np.nan, 0.0
        if model.dt == 0.0 or basis.reading == "period":
            reason = "period-synchronous" if model.dt else "already continuous"
            self._check_passes(model, reason)
            self._keep_all(model, reason)
        elif not basis.harmonic and self.n_states is None:
            model = self._keep_plain(model, experiment)
        else:
            with progress(self.verbose) as report:
                model = self._reduce(model, experiment, method, report)
            warn_of_growth(model, experiment)
        self.n_states_ = model.n_states
        return self._remember(model, experiment, X, y)

    @property
    def modes_(self):
        """Every mode identified, with its family, verdict and reason, as a DataFrame."""
        check_is_fitted(self)
        return mode_table(*self._modes)

    def _check_passes(self, model, reason):
        """Raise ValueError if other states are asked for than a model that passes has."""
        if self.n_states not in (None, model.n_states):
            way = f"MOESPRegressor(order={self.n_states})" if model.dt else "one reducer only"
            raise ValueError(
                f"n_states={self.n_states} cannot be kept: the model is {reason}, has nothing "
                f"spurious, and passes with its {model.n_states} states; use {way}, or leave "
                f"n_states=None"
            )

    def _keep_all(self, model, reason):
        z = np.linalg.eigvals(model.A)
        exponents = z if model.dt == 0.0 else continuous_exponents(z.astype(complex), model.dt)
        families = np.arange(len(z))
        self._modes = (exponents, families, ["genuine"] * len(z), [reason] * len(z))

    def _keep_plain(self, model, experiment):
        """All modes that have a continuous-time counterpart, as no analyzer was there."""
        z = np.linalg.eigvals(model.A).astype(complex)
        kept = np.zeros(len(z), dtype=bool)
        kept[[i for unit in conjugate_units(z) for i in unit]] = True
        self._keep_all(model, "no harmonic analyzer, nothing spurious")
        if kept.all():
            return to_continuous(model, experiment)
        verdicts = np.where(kept, "genuine", "weak")
        reasons = ["" if k else "negative real pole: no continuous-time counterpart" for k in kept]
        exponents = continuous_exponents(z, model.dt)
        self._modes = (exponents, np.arange(len(z)), verdicts.tolist(), reasons)
        warn(
            f"{int((~kept).sum())} mode(s) on the negative real axis have no continuous-time "
            f"counterpart and are dropped; sample faster, or lower the order",
            IdentifiabilityWarning,
        )
        return self._refit(model, experiment, z, kept, np.zeros(len(z), dtype=bool))

    def _reduce(self, model, experiment, method, report):
        modes = identified_modes(model, experiment)
        choice = choose_modes(modes, experiment, self.n_states)
        refined = None
        if method == "truncate" and experiment.basis.harmonic:
            choice, refined = _refined(choice, modes, experiment, report)
        self.left_out_ = choice.left_out
        self._modes = (modes.exponents, modes.families, *verdicts(modes, choice))
        warn_of_doubt(choice, self.n_states)
        if refined is not None:
            A, C = refined
            B, D, self.r2_ = refit_inputs(A, C, experiment, model.feedthrough)
            return model.in_continuous_time(A, B, C, D)
        if self.n_states is None and method == "truncate" and experiment.basis.harmonic:
            periodic = self._from_mode_shapes(model, experiment, modes, choice, report)
            if periodic is not None:
                return periodic
        kept = modes.mask(choice.units)
        fast = _to_residualize(method, kept | modes.window, modes, experiment.basis)
        return self._refit(model, experiment, modes.z, kept, fast)

    def _from_mode_shapes(self, model, experiment, modes, choice, report):
        """Harmonic decomposition of the F(ψ) behind the families, where the outputs show it.

        None where the outputs do not determine the state, no input rests long
        enough, or the modes themselves explain the raw record better.
        """
        basis = experiment.basis
        chosen = {
            frozenset(modes.families[unit[0]].item() for unit in best) for _, best in choice.tried
        }
        readings = [
            reading
            for some in chosen
            for reading in family_exponents(
                modes.z,
                modes.families,
                sorted(some),
                basis.rows_per_period,
                len(basis.outputs),
                MULTIPLIER_ANGLE,
            )
        ]
        A, C = periodic_decomposition(experiment, readings, report)
        if A is None:
            return None
        B, D, r2 = refit_inputs(A, C, experiment, model.feedthrough)
        _, _, r2_modes = _modal_refit(model, experiment, modes.z, modes.mask(choice.units))
        if not (1.0 - r2) * (1.0 - WORSE_BY) <= 1.0 - r2_modes:
            return None
        self.r2_ = r2
        exponents, families, verdicts, reasons = self._modes
        shown = "its family's mode shape gives F(ψ), and that the harmonic decomposition"
        reasons = [
            shown if verdict == "genuine" else reason
            for verdict, reason in zip(verdicts, reasons, strict=True)
        ]
        self._modes = (exponents, families, verdicts, reasons)
        return model.in_continuous_time(A, B, C, D)

    def _refit(self, model, experiment, z, kept, fast):
        """Continuous-time model of the modes kept, its inputs fitted to the raw record."""
        (A, C), (B, D), self.r2_ = _modal_refit(model, experiment, z, kept | fast)
        if fast.any():
            exponents = continuous_exponents(z, model.dt)
            A, B, C, D = residualize(A, B, C, D, exponents[kept], exponents[fast])
        feedthrough = model.feedthrough or bool(fast.any())
        return model.in_continuous_time(A, B, C, D, feedthrough=feedthrough)


def _modal_refit(model, experiment, z, stay):
    """(A, C) of some modes, (B, D) fitted to the raw record, and the R² reached."""
    A_d, C = invariant_pair(model.A, model.C, z[stay], z[~stay])
    A, _ = discrete_to_continuous(A_d, np.zeros((len(A_d), 0)), model.dt)
    B, D, r2 = refit_inputs(A, C, experiment, model.feedthrough)
    return (A, C), (B, D), r2


def _refined(choice, modes, experiment, report):
    """The smallest set of modes that explains all but white noise once refined, its A and C.

    The choice given, and None, where none does. Also enough is what the choice leaves:
    poles a little off are made up for by further ones.
    """
    size = sum(map(len, choice.units))
    value = next((v for v, some in choice.tried if set(some) == set(choice.units)), 0.0)
    total = sum(float(np.sum(y**2)) for y in scaled_outputs(experiment))
    rounding, nothing = ROUNDING * total, NEARLY_ALL**2 * total
    if value <= rounding or (choice.by_family and value > nothing):
        return choice, None  # nothing to gain, or nothing white: copies agree to 0.1 %
    limit, enough, tried = max(NEARLY_ALL * total, value / REFINED_GAIN), rounding, choice.tried
    if value <= nothing:  # as good as all: no more modes than these
        tried = [pair for pair in tried if sum(map(len, pair[1])) <= size]
        enough = value
    for some in [some for rest, some in tried if rest <= limit][:MAX_REFINED]:
        first = [unit[0] for unit in some]
        single = np.array([len(unit) == 1 for unit in some])
        exponents = modes.exponents[first]
        start = np.where(single, exponents.real, exponents)
        told = within(report, f"{sum(map(len, some))} states")
        A, C = refined_modes(experiment, start, modes.shapes[first], enough, told)
        if A is not None:
            return replace(choice, units=some, rivals=[]), (A, C)
    return choice, None


def _to_residualize(method, others, modes, basis):
    """Modes replaced by their static gain: neither kept nor the window's memory."""
    z = modes.z
    logarithm = ~((np.abs(z.imag) <= 1e-8 * np.abs(z)) & (z.real <= 0.0))
    fast = ~others & logarithm
    if method == "truncate":
        return np.zeros(len(z), dtype=bool)
    if method == "both" and basis.harmonic:
        return fast & (np.abs(modes.exponents) > basis.omega)
    return fast
