"""The smallest model that is about as good as the best."""

import numpy as np
from sklearn.exceptions import FitFailedWarning

from sklearn_hd._checks import check_positive
from sklearn_hd._warn import warn

MOST_NAMED = 5  # of the candidates that failed
SIZE = ("order", "block_rows")


def smallest_within_one_standard_error(cv_results, *, size=SIZE, metric="score", test_share=None):
    """Index of the smallest candidate about as good as the best: a rule for ``refit``.

    With b_f the scores of the candidate of best mean on folds f = 1 … k, a
    candidate of mean score s̄ is within one standard error of the best if

        b̄ − s̄ ≤ SE,   SE² = var(b_f) (1/k + q).

    Folds share their training rows, which makes var/k too small; q, rows
    tested over rows trained on, corrects for that (Nadeau and Bengio). Of the
    candidates within, the one smallest in the first parameter of ``size`` is
    taken, then in the second, …, then the one of best score.

    The error is that of the best score, not of the difference b_f − s_f: a
    state too many makes up for what the states before it were estimated
    wrong, a gain that is tiny but the same on every fold.

    Parameters
    ----------
    cv_results : dict
        ``cv_results_`` of a search; ``GridSearchCV(refit=rule)`` hands it over.
    size : str or sequence of str, default=("order", "block_rows")
        Parameters that make a model large, the first above all. Names of
        parameters, alone or with their steps (``"identify__order"``); those
        that were not searched are passed over. The first that was needs a
        number for every candidate, or one value for all (``order="auto"``); a later one that has
        none for some (``block_rows=None``) parts nobody. Where nothing but choices without
        a size were searched (a window, a method), the best score is taken.
    metric : str, default="score"
        With several metrics, the one to decide by. (Like every callable
        ``refit``, the rule leaves a search without ``best_score_``, which is
        ``cv_results_["mean_test_score"][search.best_index_]``).
    test_share : float or None, default=None
        Rows tested over rows trained on, q. None is 1/(k − 1), as in k folds of equal size.

    Returns
    -------
    index : int
        Of ``cv_results_["params"]``.

    Raises
    ------
    ValueError
        If no candidate has a finite mean, there are fewer than two folds, or the
        candidates cannot be told apart by size.

    Warns
    -----
    FitFailedWarning
        Of candidates that failed on some fold (their score is NaN or +inf; −inf, that of
        an unstable model, is a score). They are passed over.

    References
    ----------
    Breiman, Friedman, Olshen, Stone (1984), Classification and Regression
    Trees, section 3.4.3 (the rule).
    Nadeau, Bengio (2003), Inference for the generalization error, Machine
    Learning 52, 239-281.

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
    whole = _comparable(scores, cv_results["params"])
    sizes = _sizes(cv_results, (size,) if isinstance(size, str) else tuple(size))
    means = np.full(len(scores), -np.inf)
    means[whole] = scores[whole].mean(axis=1)
    best = int(np.argmax(means))
    error = standard_error(scores[best], test_share)
    within = means[best] - means <= error + 1e-10 * abs(means[best])  # rounding
    return min(np.flatnonzero(within).tolist(), key=lambda i: (*sizes[i], -means[i], i))


def standard_error(scores, test_share=None):
    """Standard error of the mean of the scores on some folds, which share training rows.

    NaN where one of them is not finite.
    """
    n_folds = len(scores)
    share = 1.0 / (n_folds - 1) if test_share is None else test_share
    check_positive("test_share", share, "rows tested over rows trained on", "None is 1/(k − 1)")
    if not np.all(np.isfinite(scores)):
        return np.nan
    return float(scores.std(ddof=1) * np.sqrt(1.0 / n_folds + share))


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
            f"the search has {n_folds} fold(s), and a standard error needs at least two; use a cv "
            f"of more folds"
        )
    folds = [cv_results[f"split{f}_test_{metric}"] for f in range(n_folds)]
    return np.asarray(folds, dtype=float).T


def _comparable(scores, candidates):
    """Which candidates have a score on every fold, with a warning of those that have not.

    Raises ValueError where none has a finite one on all.
    """
    bad = np.isnan(scores) | np.isposinf(scores)
    failed, finite = np.any(bad, axis=1), np.all(np.isfinite(scores), axis=1)
    if not np.any(failed | finite):
        raise ValueError(
            f"all {len(scores)} candidates are unstable on some fold and score -inf; search over "
            f"smaller orders, or drop growing modes (SpuriousModeReducer)"
        )
    if np.any(failed):
        named = [
            f"{candidates[i]} on folds {np.flatnonzero(bad[i]).tolist()}"
            for i in np.flatnonzero(failed)
        ]
        named = "; ".join([*named[:MOST_NAMED], *["…"] * (len(named) > MOST_NAMED)])
        if not np.any(finite):
            raise ValueError(
                f"no candidate has a finite score on every fold, and {failed.sum()} of "
                f"{len(scores)} failed: {named}; see why with error_score='raise', or give folds "
                f"of more rows to train on"
            )
        warn(
            f"{failed.sum()} of {len(scores)} candidates failed on some fold and are passed over: "
            f"{named}; see why with error_score='raise', or take them out of the search",
            FitFailedWarning,
        )
    return ~failed


def _sizes(cv_results, names):
    """One tuple of numbers a candidate, in the order of the names; empty where all are alike."""
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
    """The parameter of a search that is called so, alone or after its step: at most one."""
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
    """Raise ValueError unless the candidates differ in nothing that may be a size."""
    searched = sorted({key for params in candidates for key in params})
    numbers = [key for key in searched if any(_is_number(p.get(key)) for p in candidates)]
    if names != SIZE or numbers:
        raise ValueError(
            f"none of size={list(names)} was searched, only {searched}; name the parameters that "
            f"make a model large with size="
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
                f"{key}={params[key]!r} of candidate {params} is no size: candidates can be "
                f"compared by numbers only; search over numbers, or leave that parameter out of "
                f"size={list(names)}"
            )
