"""Step 4: drop the modes that the harmonic analyzer put in."""

import warnings

import numpy as np
import pandas as pd
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import within_range
from sklearn_hd._base import ModelStep, upstream
from sklearn_hd._continuous import (
    input_scale,
    observations,
    output_scale,
    refit_inputs,
    to_continuous,
)
from sklearn_hd._fit_checks import warn_of_growth
from sklearn_hd._progress import check_verbose, progress
from sklearn_hd._raw_modes import periodic_decomposition, refined_modes
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._validation import check_choice, check_count
from sklearn_hd.algorithms.modes import (
    FAINT,
    agreeing_copies,
    best_modes,
    conjugate_units,
    family_exponents,
    floquet_families,
    invariant_pair,
    is_window_pole,
    residual,
    unit_regressors,
)
from sklearn_hd.algorithms.reporting import within
from sklearn_hd.algorithms.residualization import residualize
from sklearn_hd.algorithms.simulation import discrete_to_continuous
from sklearn_hd.exceptions import IdentifiabilityWarning

__all__ = ["SpuriousModeReducer"]

METHODS = ("truncate", "residualize", "both")
FAMILY_TOLERANCE = 0.05
COPY_TOLERANCES = (1e-3, 3e-3, 1e-2, 3e-2)  # of a family's decay, by which its members may differ
WINDOW_DECAY = 1e-3
MULTIPLIER_ANGLE = 0.3  # rad; a multiplier turned by less may be a real one
MAX_GROWTH = 20.0  # e-folds over the longest segment: such a mode would show
WHOLE_SHARE = 0.1  # of the variance, at most unexplained by families taken for all
ROUNDING = 1e-14  # of the variance
NEARLY_ALL = 1e-4  # of the variance: what a set whose poles are a little off may leave
OWN_SHARE = 1e-3  # of next to nothing, that is left once a mode of the system's own is added
REFINED_GAIN = 1 / 3  # by which refinement may be hoped to lower what is left
MAX_REFINED = 4  # sets that are refined, for the time it takes
DECISIVE_SHARE = 0.5  # the same for more modes than output coefficients
MATERIAL_SHARE = 0.1  # of the unexplained variance that more modes must remove to be kept
RIVAL_SHARE = 0.05  # a set that explains as much within this share is a rival


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
        if model.dt == 0.0 or (basis is not None and basis.synchronous):
            reason = "period-synchronous" if model.dt else "already continuous"
            self._check_passes(model, reason)
            self._keep_all(model, reason)
        elif basis is None and self.n_states is None:
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
        return _table(*self._modes)

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
        exponents = z if model.dt == 0.0 else np.log(z.astype(complex)) / model.dt
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
        exponents = np.log(np.where(z == 0.0, np.finfo(float).tiny, z)) / model.dt
        self._modes = (exponents, np.arange(len(z)), verdicts.tolist(), reasons)
        warnings.warn(
            f"{int((~kept).sum())} mode(s) on the negative real axis have no continuous-time "
            f"counterpart and are dropped; sample faster, or lower the order",
            IdentifiabilityWarning,
            stacklevel=5,
        )
        return self._refit(model, experiment, z, kept, np.zeros(len(z), dtype=bool))

    def _reduce(self, model, experiment, method, report):
        basis = experiment.basis
        z, V = np.linalg.eig(model.A)
        z = z.astype(complex)
        shapes = (model.C @ V).T
        exponents = np.log(np.where(z == 0.0, np.finfo(float).tiny, z)) / model.dt
        window = np.zeros(len(z), dtype=bool)
        families = np.arange(len(z))
        if basis is not None:
            window = _window_memory(z, basis)
            families = np.full(len(z), -1)
            families[~window] = floquet_families(
                z[~window], basis.rows_per_period, FAMILY_TOLERANCE
            )
        wild = self._beyond_bounds(exponents, experiment)
        units = [unit for unit in conjugate_units(z) if not (window | wild)[list(unit)].any()]
        whole = _whole_families(units, z, window, basis) if self.n_states is None else []
        kept_units, rivals, tried = self._choose(units, exponents, shapes, experiment, dict(whole))
        refined = None
        if method == "truncate" and basis is not None:
            kept_units, refined = self._refined(
                kept_units, tried, exponents, shapes, experiment, report, exact=bool(whole)
            )
            rivals = rivals if refined is None else []
        kept = np.zeros(len(z), dtype=bool)
        kept[[i for unit in kept_units for i in unit]] = True
        doubtful = set(kept_units) - set.intersection(set(kept_units), *map(set, rivals))
        verdicts = _verdicts(kept, window, wild, families, exponents, doubtful)
        self._modes = (exponents, families, *verdicts)
        if self.left_out_ > DECISIVE_SHARE and self.n_states is None:
            warnings.warn(
                f"the {int(kept.sum())} modes kept explain much less than all modes do (of what "
                f"they leave, the others explain {self.left_out_:.0%}); give n_states, or change "
                f"the order of the identified model",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if doubtful:
            warnings.warn(
                f"{len(rivals)} other set(s) of {int(kept.sum())} modes explain the data as well "
                f"as the one kept; see modes_, change n_states, or use a richer record",
                IdentifiabilityWarning,
                stacklevel=5,
            )
        if refined is not None:
            A, C = refined
            B, D, self.r2_ = refit_inputs(A, C, experiment, model.feedthrough)
            return model.in_continuous_time(A, B, C, D)
        if self.n_states is None and method == "truncate" and basis is not None:
            chosen = {frozenset(families[unit[0]].item() for unit in best) for _, best in tried}
            periodic = self._from_mode_shapes(model, experiment, z, families, kept, chosen, report)
            if periodic is not None:
                return periodic
        fast = _to_residualize(method, kept | window, exponents, z, basis)
        return self._refit(model, experiment, z, kept, fast)

    @staticmethod
    def _beyond_bounds(exponents, experiment):
        """Modes that cannot be the system's own as the harmonics kept show it.

        A coefficient of harmonic k turns by less than half the way to the next: members
        further out are copies. And a mode that grows by e^20 within a segment would show.
        """
        longest = max(segment.stop - segment.start for segment in experiment.base.segments)
        grows = exponents.real * longest * experiment.base.sample_time > MAX_GROWTH
        if experiment.basis is None:
            return grows
        highest = max(k for _, orders in experiment.basis.outputs for k in orders)
        turns = np.abs(exponents.imag) > (highest + 0.5) * experiment.basis.omega
        return grows | turns

    def _choose(self, units, exponents, shapes, experiment, whole):
        """Units to keep, rival sets that explain the data as well, and the best of each size."""
        sizes = [len(unit) for unit in units]
        scale = output_scale(experiment)
        observe = observations(experiment, shapes.shape[1])
        R, columns = unit_regressors(
            units,
            exponents,
            shapes,
            [u / input_scale(experiment) for u in experiment.drive],
            [y / scale for y in experiment.outputs],
            experiment.base.sample_time,
            [R_psi / scale[:, None] for R_psi in observe],
        )
        total = float(R[:, -1] @ R[:, -1])
        rounding = ROUNDING * total
        floor = residual(R, columns, tuple(range(len(units))))
        open_units = [i for i, unit in enumerate(units) if unit in whole]
        floor_whole = residual(R, columns, tuple(open_units))
        # complete families that explain most are the system's own; what explains more beside
        # them makes up for harmonics not kept, or for inputs that change between rows; unless
        # all modes leave next to nothing, as those of a harmonic decomposition do
        nothing = NEARLY_ALL**2 * total
        if floor_whole <= WHOLE_SHARE * total + rounding and not floor <= nothing < floor_whole:
            units, sizes = [units[i] for i in open_units], [sizes[i] for i in open_units]
            columns, floor = [columns[i] for i in open_units], floor_whole
        wanted = range(1, sum(sizes) + 1) if self.n_states is None else [int(self.n_states)]
        ranking, rankings, tried = [], [], []
        for n_states in wanted:
            smaller = [best[0] for best in rankings[-2:] if best]
            ranking = best_modes(R, columns, sizes, n_states, smaller) or ranking
            rankings.append(ranking)
            tried += [(value, [units[i] for i in best]) for value, best in ranking[:1]]
            # in harmonic-decomposition form the output coefficients are the states: more are
            # kept only where so many leave out what matters (noise can pair a real pole)
            share = MATERIAL_SHARE if n_states < shapes.shape[1] else DECISIVE_SHARE
            if ranking and ranking[0][0] <= floor / (1.0 - share) + rounding:
                break
        ranking = _without_trifles(rankings, nothing)
        if not ranking:
            asked = "no mode" if self.n_states is None else f"n_states={self.n_states}"
            raise ValueError(
                f"{asked} cannot be kept: {sum(sizes)} states in {len(units)} real poles or "
                f"conjugate pairs are left once the window's memory and modes that turn or grow "
                f"too fast are split off (pairs stay together); change n_states, keep more "
                f"harmonics, or raise the order of the identified model"
            )
        slack = nothing if ranking[0][0] <= nothing else rounding
        self.left_out_ = 1.0 - min(1.0, (floor + slack) / max(ranking[0][0], slack))
        limit = ranking[0][0] * (1.0 + RIVAL_SHARE) + rounding
        rivals = [rival for value, rival in ranking[1:] if value <= limit]
        picked = _every_family(R, columns, ranking[0][1], [whole.get(unit) for unit in units])
        pick = [units[i] for i in picked]
        return pick, [[units[i] for i in rival] for rival in rivals], tried

    def _from_mode_shapes(self, model, experiment, z, families, kept, chosen, report):
        """Harmonic decomposition of the F(ψ) behind the families, where the outputs show it.

        None where the outputs do not determine the state, no input rests long
        enough, or the modes themselves explain the raw record better.
        """
        rows = experiment.basis.rows_per_period
        choices = [
            choice
            for some in chosen
            for choice in family_exponents(
                z, families, sorted(some), rows, len(experiment.basis.outputs), MULTIPLIER_ANGLE
            )
        ]
        A, C = periodic_decomposition(experiment, choices, report)
        if A is None:
            return None
        B, D, r2 = refit_inputs(A, C, experiment, model.feedthrough)
        _, _, r2_modes = self._modal_refit(model, experiment, z, kept)
        if not (1.0 - r2) * (1.0 - MATERIAL_SHARE) <= 1.0 - r2_modes:
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

    @staticmethod
    def _refined(kept_units, tried, exponents, shapes, experiment, report, exact):
        """The smallest set of modes that explains all but white noise once refined, its A and C.

        The set given, and None, where none does. Also enough is what the set given leaves:
        poles a little off are made up for by further ones.
        """
        value = next((v for v, some in tried if set(some) == set(kept_units)), 0.0)
        total = sum(float(np.sum(y**2)) for y in _scaled_outputs(experiment))
        rounding = ROUNDING * total
        if value <= rounding or (exact and value > NEARLY_ALL**2 * total):
            return kept_units, None  # nothing to gain, or nothing white: copies agree to 0.1 %
        limit = max(NEARLY_ALL * total, value / REFINED_GAIN)
        if value <= NEARLY_ALL**2 * total:  # as good as all: no more modes than these
            tried = [pair for pair in tried if sum(map(len, pair[1])) <= sum(map(len, kept_units))]
        enough = max(value, rounding) if value <= NEARLY_ALL**2 * total else rounding
        for some in [some for rest, some in tried if rest <= limit][:MAX_REFINED]:
            first = [unit[0] for unit in some]
            single = np.array([len(unit) == 1 for unit in some])
            start = np.where(single, exponents[first].real, exponents[first])
            told = within(report, f"{sum(map(len, some))} states")
            A, C = refined_modes(experiment, start, shapes[first], enough, told)
            if A is not None:
                return some, (A, C)
        return kept_units, None

    def _refit(self, model, experiment, z, kept, fast):
        """Continuous-time model of the modes kept, its inputs fitted to the raw record."""
        (A, C), (B, D), self.r2_ = self._modal_refit(model, experiment, z, kept | fast)
        if fast.any():
            exponents = np.log(z) / model.dt
            A, B, C, D = residualize(A, B, C, D, exponents[kept], exponents[fast])
        feedthrough = model.feedthrough or bool(fast.any())
        return model.in_continuous_time(A, B, C, D, feedthrough=feedthrough)

    @staticmethod
    def _modal_refit(model, experiment, z, stay):
        """(A, C) of some modes, (B, D) fitted to the raw record, and the R² reached."""
        A_d, C = invariant_pair(model.A, model.C, z[stay], z[~stay])
        A, _ = discrete_to_continuous(A_d, np.zeros((len(A_d), 0)), model.dt)
        B, D, r2 = refit_inputs(A, C, experiment, model.feedthrough)
        return (A, C), (B, D), r2


def _scaled_outputs(experiment):
    scale = output_scale(experiment)
    return [y / scale for y in experiment.outputs]


def _whole_families(units, z, window, basis):
    """Units of complete families and their families; none where no family is complete.

    A weak family's copies agree less well than a strong one's: of the poles that belong to
    no family by the strictest tolerance the next are made.
    """
    if basis is None:
        return []
    rows, orders = basis.rows_per_period, [orders for _, orders in basis.outputs]
    whole, rest, count = np.full(len(z), -1), np.flatnonzero(~window), 0
    for tolerance in COPY_TOLERANCES:
        members = rest[agreeing_copies(z[rest], orders, rows, tolerance)]
        if not count and not len(members):
            return []
        if len(members):
            whole[members] = floquet_families(z[members], rows, tolerance) + count
        count = int(whole.max()) + 1
        rest = np.setdiff1d(rest, members)
    return [(unit, int(whole[unit[0]])) for unit in units if (whole[list(unit)] >= 0).all()]


def _window_memory(z, basis):
    """Poles that die within the window, but for those whose copies agree."""
    window = is_window_pole(z, basis.window_rows, WINDOW_DECAY)
    told = np.flatnonzero(~is_window_pole(z, basis.window_rows, FAINT))
    orders = [orders for _, orders in basis.outputs]
    window[told[agreeing_copies(z[told], orders, basis.rows_per_period)]] = False
    return window


def _every_family(R, columns, picked, families):
    """The units picked, and of each family without one that which explains most."""
    for family in sorted(set(families) - {families[i] for i in picked} - {None}):
        own = [i for i, f in enumerate(families) if f == family]
        best = min(own, key=lambda i: residual(R, columns, (*picked, i)))
        picked = (*picked, best)
    return picked


def _without_trifles(rankings, nothing):
    """The ranking of the smallest size that leaves next to nothing; else that of the largest.

    Poles that are a little off leave a trace, which more modes make up for by and by; one of
    the system's own would lower what is left by decades.
    """
    last = rankings[-1] if rankings else []
    small = [r for r in rankings if r and r[0][0] <= nothing]
    return next((r for r in small if last[0][0] >= OWN_SHARE * r[0][0]), last)


def _to_residualize(method, others, exponents, z, basis):
    """Modes replaced by their static gain: neither kept nor the window's memory."""
    logarithm = ~((np.abs(z.imag) <= 1e-8 * np.abs(z)) & (z.real <= 0.0))
    fast = ~others & logarithm
    if method == "truncate":
        return np.zeros(len(z), dtype=bool)
    if method == "both" and basis is not None:
        return fast & (np.abs(exponents) > basis.omega)
    return fast


def _verdicts(kept, window, wild, families, exponents, doubtful):
    """Verdict and reason of each mode."""
    doubt = {i for unit in doubtful for i in unit}
    verdicts, reasons = [], []
    for i, exponent in enumerate(exponents):
        if window[i]:
            verdict, reason = "window", "dies within the analysis window"
        elif i in doubt:
            verdict, reason = "ambiguous", "kept, but another set explains the data as well"
        elif kept[i]:
            verdict, reason = "genuine", "needed to explain the raw signals"
        elif np.any(kept & (families == families[i])):
            relatives = np.flatnonzero(kept & (families == families[i]))
            near = min(relatives, key=lambda j: abs(exponents[j].imag - exponent.imag))
            verdict = "copy"
            reason = f"same Floquet multiplier as the mode at {exponents[near]:.4g} rad/s"
        elif wild[i]:
            verdict = "weak"
            reason = "turns faster than the harmonics kept, or grows faster than the record shows"
        else:
            verdict, reason = "weak", "adds nothing material to the raw signals"
        verdicts.append(verdict)
        reasons.append(reason)
    return verdicts, reasons


def _table(exponents, families, verdicts, reasons):
    table = pd.DataFrame(
        {"eigenvalue": exponents, "family": families, "verdict": verdicts, "reason": reasons}
    )
    order = np.lexsort((exponents.imag, np.abs(exponents.imag), -exponents.real))
    return table.iloc[order].reset_index(drop=True)
