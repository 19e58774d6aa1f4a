"""The smallest model that is about as good as the best."""

import numpy as np
from sklearn.exceptions import FitFailedWarning

from sklearn_hd._checks import check_positive
from sklearn_hd._guards import warn
from sklearn_hd.algorithms.subspace.order import MATERIAL

MOST_NAMED = 5  # of the candidates that failed
SIZE = ("order", "block_rows")
PERFECT = (0.0, 1.0, 100.0)  # scores of perfect models: negated errors, R², fit in percent
ROUNDING = 1e-10  # what perfect models leave


def smallest_within_one_standard_error(cv_results, *, size=SIZE, metric="score", test_share=None):
    """Index of the smallest candidate about as good as the best: a rule for ``refit``.

    On fold f the best candidate scores b_f and leaves 1 − b_f unexplained (R²). Another one, with
    scores s_f, leaves more by

        d_f = log (1 − s_f) − log (1 − b_f),   d̄ = Σ w_f d_f

    and is about as good if d̄ is within one standard error,

        d̄ ≤ SE,   SE² = (1 + k q) k / (k − 1) Σ w_f² (d_f − d̄)²,   f = 1 … k

    or if it leaves only a hundredth more; never if it leaves twice as much. Differences on the
    same fold do not depend on how hard the fold is. The weight w_f is the best explained part of
    the fold, −log (1 − b_f), and zero if every candidate is perfect: a fold whose outputs stand
    still, or are all noise, does not separate candidates. Folds share their training rows, which
    makes the variance of a mean over them too small; q, rows tested over rows trained on, corrects
    for that (Nadeau and Bengio). Among the candidates within one standard error, the rule takes
    the smallest in the first parameter of ``size``, then in the second, …, then the one of least
    d̄. A perfect model scores 1, as for R²; 100 if a score is above 1, as for the fit in percent; 0
    if none is above 0, as for errors. For errors all folds have equal weight.

    Parameters
    ----------
    cv_results : dict
        ``cv_results_`` of a search; ``GridSearchCV(refit=rule)`` passes it.
    size : str or sequence of str, default=("order", "block_rows")
        Parameters that make a model large, the most important first. Names of parameters, alone or
        with their steps (``"identify__order"``); those that were not searched are ignored. The
        first searched one needs a number for every candidate, or one value for all
        (``order="auto"``). A later one that has none for some (``block_rows=None``) is not
        compared. If only choices without a size were searched (a window, a method), the best is
        taken.
    metric : str, default="score"
        With several metrics, the one that decides. (Like every callable
        ``refit``, the rule leaves a search without ``best_score_``, which is
        ``cv_results_["mean_test_score"][search.best_index_]``).
    test_share : float or None, default=None
        Rows tested over rows trained on, q. None is 1/(k − 1), as in k folds of equal size.

    Returns
    -------
    index : int
        Index into ``cv_results_["params"]``.

    Raises
    ------
    ValueError
        If no fold has a score of every remaining candidate, there are fewer than two folds, a
        score is above that of a perfect model, or the candidates cannot be compared by size.

    Warns
    -----
    FitFailedWarning
        For candidates that failed on some fold (their score is NaN or +inf; −inf, that of an
        unstable model, is a score). Candidates that failed on more folds than others are ignored,
        and then the folds on which one of the others failed.

    References
    ----------
    Breiman, Friedman, Olshen, Stone (1984), Classification and Regression
    Trees, section 3.4.3 (the rule).
    Nadeau, Bengio (2003), Inference for the generalization error, Machine
    Learning 52, 239-281.
    Cochran (1977), Sampling Techniques, section 6.4 (the variance of a weighted mean).

    Examples
    --------
    >>> from functools import partial
    >>> from sklearn.model_selection import GridSearchCV
    >>> from sklearn_hd import MOESPRegressor
    >>> from sklearn_hd.model_selection import BlockSplit
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.standard_normal((400, 1)), np.zeros((400, 1))
    >>> for k in range(399):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> search = GridSearchCV(
    ...     MOESPRegressor(block_rows=5),
    ...     {"order": [3, 2, 1]},
    ...     cv=BlockSplit(4),
    ...     refit=partial(smallest_within_one_standard_error, size="order"),
    ... )
    >>> search.fit(u, y + 0.1 * rng.standard_normal((400, 1))).best_params_
    {'order': 1}
    """
    scores = fold_scores(cv_results, metric)
    share = _share(scores.shape[1], test_share)
    sizes = _sizes(cv_results, (size,) if isinstance(size, str) else tuple(size))
    candidates, folds = _comparable(scores, cv_results["params"])
    worse, error = _behind_best(*_left(scores[np.ix_(candidates, folds)]), share)
    enough = np.maximum(np.log(MATERIAL), np.minimum(error, np.log(2.0)))
    within = np.flatnonzero(worse <= enough)
    best = min(within.tolist(), key=lambda i: (*sizes[candidates[i]], worse[i], i))
    return int(candidates[best])


def standard_error(scores, test_share=None):
    """Standard error of the mean of the scores on some folds, which share training rows.

    NaN if one of them is not finite.
    """
    n_folds = len(scores)
    share = _share(n_folds, test_share)
    if not np.all(np.isfinite(scores)):
        return np.nan
    return float(scores.std(ddof=1) * np.sqrt(1.0 / n_folds + share))


def _share(n_folds, test_share):
    """Rows tested over rows trained on."""
    share = 1.0 / (n_folds - 1) if test_share is None else test_share
    check_positive("test_share", share, "rows tested over rows trained on", "None is 1/(k − 1)")
    return share


def _left(scores):
    """Logarithm of what each score leaves unexplained, and the weights of the folds."""
    most = np.max(scores)
    perfect = next((p for p in PERFECT if most <= p), None)
    if perfect is None:
        raise ValueError(
            f"a score of {most:.6g} is above that of a perfect model, {PERFECT[-1]:g}; use a "
            f"metric that has one: R², the fit in percent, or the negative of an error"
        )
    left, some = perfect - scores, perfect > 0.0
    unit = perfect if some else np.median(left) or 1.0
    left = np.log(np.clip(left / unit, ROUNDING, 1.0 if some else None))
    told = left.max(axis=0) > np.log(ROUNDING)  # some candidate leaves something
    weights = -left.min(axis=0) * told if some and told.any() else np.ones(left.shape[1])
    return left, weights / weights.sum()


def _behind_best(left, weights, share):
    """Excess that candidates leave above the best one, and its standard error."""
    k, best = len(weights), np.argmin(left @ weights)
    differences = left - left[best]
    worse = differences @ weights
    spread = (differences - worse[:, None]) ** 2 @ weights**2
    return worse, np.sqrt((1.0 + k * share) * k / max(1, k - 1) * spread)


def fold_scores(cv_results, metric):
    """Test scores, (n_candidates, n_folds); NaN where a candidate failed, −inf where it grew."""
    metrics = [key.removeprefix("mean_test_") for key in cv_results if key.startswith("mean_test_")]
    if metric not in metrics:
        raise ValueError(
            f"metric={metric!r} is not among the metrics of the search, {metrics}; name one of "
            f"them, as in refit=partial(smallest_within_one_standard_error, "
            f"metric={metrics[0] if metrics else 'score'!r})"
        )
    n_folds = 0
    while f"split{n_folds}_test_{metric}" in cv_results:
        n_folds += 1
    if n_folds < 2:
        raise ValueError(
            f"the search has {n_folds} fold(s), but a standard error needs at least two; use a cv "
            f"with more folds"
        )
    folds = [cv_results[f"split{f}_test_{metric}"] for f in range(n_folds)]
    return np.asarray(folds, dtype=float).T


def _comparable(scores, candidates):
    """Candidates and folds that are compared, with a warning about the others.

    Raises ValueError if none are left.
    """
    finite, failed = np.isfinite(scores), np.isnan(scores) | np.isposinf(scores)
    n_bad = np.sum(~finite, axis=1)
    kept = np.flatnonzero(n_bad == n_bad.min())
    folds = np.flatnonzero(finite[kept].all(axis=0))
    several = np.flatnonzero(failed.any(axis=1))
    named = [f"{candidates[i]} on folds {np.flatnonzero(failed[i]).tolist()}" for i in several]
    named = "; ".join([*named[:MOST_NAMED], *["…"] * (len(named) > MOST_NAMED)])
    told = f"{len(several)} of {len(scores)} candidates failed on some fold: {named}"
    if len(folds) == 0 and len(several) == 0:
        raise ValueError(
            f"the {len(kept)} candidates that are stable on most folds have no fold in common on "
            f"which all are stable, and the others score -inf; search over smaller orders, or drop "
            f"growing modes (SpuriousModeReducer)"
        )
    if len(folds) == 0:
        raise ValueError(
            f"no fold has a score of all {len(kept)} candidates that failed least, and {told}; see "
            f"why with error_score='raise', or give folds with more rows to train on"
        )
    if len(several):
        way = "see why with error_score='raise', or remove failing candidates from the search"
        nowhere = np.flatnonzero(failed.all(axis=0))
        if len(nowhere):
            best = np.max(scores[np.ix_(kept, folds)])
            way = (
                f"{way}; all failed on folds {nowhere.tolist()}: if each holds motion that the "
                f"others lack, as a single doublet does, scores on the others tell little (the "
                f"best is {best:.3g}): give records that move in every block, or use order='auto'"
            )
        warn(
            f"{told}; the {len(kept)} that failed least are compared on folds {folds.tolist()}; "
            f"{way}",
            FitFailedWarning,
        )
    return kept, folds


def _sizes(cv_results, names):
    """One tuple of numbers per candidate, in the order of the names; empty if all are alike."""
    columns = [key for name in names for key in searched_as(cv_results, name)]
    candidates = cv_results["params"]
    if not columns:
        _check_alike(candidates, names)
        return [()] * len(candidates)
    if not _is_the_same(candidates, columns[0]):
        _check_numbers(candidates, columns[0], names)
    parting = [key for key in columns if all(_is_number(p.get(key)) for p in candidates)]
    return [tuple(params[key] for key in parting) for params in candidates]


def searched_as(cv_results, name, parameter="size"):
    """The parameter of a search with this name, alone or after its step: at most one."""
    keys = [key.removeprefix("param_") for key in cv_results if key.startswith("param_")]
    found = [key for key in keys if key == name or key.endswith(f"__{name}")]
    if len(found) > 1:
        raise ValueError(f"{parameter}={name!r} could be any of {found}; give the whole name")
    return found


def _is_the_same(candidates, key):
    """Whether a parameter has one value for all, be it a number or not (``order="auto"``)."""
    values = [np.asarray(p[key]).tolist() for p in candidates if key in p]
    return len(values) == len(candidates) and all(value == values[0] for value in values)


def _is_number(value):
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _check_alike(candidates, names):
    """Raise ValueError if the candidates differ in something that may be a size."""
    searched = sorted({key for params in candidates for key in params})
    numbers = [key for key in searched if any(_is_number(p.get(key)) for p in candidates)]
    if names != SIZE or numbers:
        raise ValueError(
            f"size={list(names)} names no parameter that was searched; searched were {searched}; "
            f"name with size= the parameters that make a model large"
        )


def _check_numbers(candidates, key, names):
    """Raise ValueError unless every candidate has a number for the parameter that decides."""
    for params in candidates:
        if key not in params:
            raise ValueError(
                f"{key} was not searched for this candidate: {params}; give it a value in every "
                f"grid of the list, or leave it out of size={list(names)}"
            )
        if not _is_number(params[key]):
            raise ValueError(
                f"{key}={params[key]!r} of candidate {params} is not a size: only numbers can be "
                f"compared; search over numbers, or leave that parameter out of size={list(names)}"
            )
