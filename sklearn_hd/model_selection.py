"""Choosing the order: a splitter, scorers and a rule for scikit-learn's searches.

Rows of a record follow one another in time, so three of scikit-learn's habits
need a counterpart here:

- folds are blocks of whole periods (:class:`PeriodBlockSplit`), or whole
  records (``GroupKFold`` on the record level of the index), never random rows;
- a fold that begins in mid-record does not begin at rest, so that scorers
  simulate from a fitted initial state, as ``score`` of the model steps does
  (:func:`simulation_scorer`, :func:`fit_percent_scorer`);
- a model with states to spare predicts as well as the true one, to within the
  noise: the smallest within one standard error of the best is the one to take
  (:func:`smallest_within_one_standard_error`).
"""

import inspect

import numpy as np
import pandas as pd
from sklearn.frozen import FrozenEstimator
from sklearn.model_selection import BaseCrossValidator
from sklearn.pipeline import Pipeline

from sklearn_hd._base import ModelStep, scored_simulation
from sklearn_hd._data import as_container
from sklearn_hd._validation import check_count, check_positive, read_time

__all__ = [
    "PeriodBlockSplit",
    "fit_percent",
    "fit_percent_scorer",
    "simulation_scorer",
    "smallest_within_one_standard_error",
]

ROUNDING = 1e-10  # share of the best score below which a difference says nothing
SIZE = ("order", "block_rows")


# ---- splitter ---------------------------------------------------------------------------------


class PeriodBlockSplit(BaseCrossValidator):
    """Cut each record into blocks of whole periods, and test on one block after another.

    Period p of ψ = ωt holds the rows with 2πp ≤ ψ < 2π(p + 1). The whole
    periods of a record are shared among ``n_splits`` blocks as evenly as they
    go; the incomplete ones at its ends stay with their neighbours, so that
    every row is tested once. Fold k tests block k of every record and trains
    on the rest in order of time, without the ``gap`` periods on either side:
    there the outputs still move with what the tested inputs, or their window,
    left behind. Model steps read the hole as a gap in time, which starts a new
    segment.

    Parameters
    ----------
    n_splits : int, default=5
        Number of blocks, at least 2.
    omega : float
        Fundamental frequency in rad/s.
    gap : int, default=1
        Periods left out of training on either side of a test block.
    trim_span : (float, float) or None, default=None
        Index times, in seconds within each record, whose rows are trained on in
        every fold and tested in none: the ``trim_span`` of the analyzer, which
        must see the machine in trim whichever block is held out.
    sample_time : float or None, default=None
        Seconds. None reads it from the index, or is 1.0 where samples are counted.

    See Also
    --------
    sklearn.model_selection.TimeSeriesSplit : Trains on the past alone.
    sklearn.model_selection.GroupKFold : Whole records, by the record level of the index.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> u = pd.DataFrame({"u": np.zeros(24)}, index=pd.Index(np.arange(24) / 4, name="time"))
    >>> split = PeriodBlockSplit(3, omega=2 * np.pi)
    >>> for train, test in split.split(u):
    ...     print(train, test)
    [12 13 14 15 16 17 18 19 20 21 22 23] [0 1 2 3 4 5 6 7]
    [ 0  1  2  3 20 21 22 23] [ 8  9 10 11 12 13 14 15]
    [ 0  1  2  3  4  5  6  7  8  9 10 11] [16 17 18 19 20 21 22 23]
    """

    def __init__(self, n_splits=5, *, omega, gap=1, trim_span=None, sample_time=None):
        self.n_splits = n_splits
        self.omega = omega
        self.gap = gap
        self.trim_span = trim_span
        self.sample_time = sample_time

    def get_n_splits(self, X=None, y=None, groups=None):
        """Number of folds.

        Parameters
        ----------
        X, y, groups : ignored
            Present for the habits of scikit-learn.

        Returns
        -------
        n_splits : int
        """
        return check_count("n_splits", self.n_splits, 2, "a single block leaves nothing to train")

    def split(self, X, y=None, groups=None):
        """Rows to train and to test on, fold by fold, each in order of time.

        Parameters
        ----------
        X : DataFrame, Series or ndarray, shape (n_samples, n_features)
            With times in its index, or a (record, time) MultiIndex; rows of
            an array are counted from ψ = 0.
        y, groups : ignored
            Present for the habits of scikit-learn.

        Yields
        ------
        train, test : ndarray of int
            Row numbers.

        Raises
        ------
        ValueError
            If a record has fewer whole periods than blocks, or the gap leaves
            nothing of the records to train on.
        """
        n_splits = self.get_n_splits()
        gap = check_count("gap", self.gap, 0, "it counts the periods left out beside a block")
        if X is None:
            raise ValueError("X is None; PeriodBlockSplit reads the times of its rows: give X")
        base = read_time(as_container(X, "X"), self.sample_time)
        periods, least = self._periods(base)
        always = self._always_trained(base)
        block = np.empty(len(periods), dtype=int)
        for rows, label in _records(base):
            block[rows] = self._blocks(periods[rows], ~always[rows], least, n_splits, label)
        for k in range(n_splits):
            tested = (block == k) & ~always
            near = np.zeros_like(tested)
            for rows, _ in _records(base):
                own = periods[rows][tested[rows]]
                near[rows] = (periods[rows] >= own[0] - gap) & (periods[rows] <= own[-1] + gap)
            train = np.flatnonzero((~near & ~tested) | always)
            if np.sum(~near) < least:
                raise ValueError(
                    f"gap={gap} leaves no whole period to train on beside block {k} of "
                    f"n_splits={n_splits}; give longer records, a smaller gap or more blocks"
                )
            yield train, np.flatnonzero(tested)

    def _periods(self, base):
        """Number of the period of each row, and rows in a whole period."""
        omega = check_positive("omega", self.omega, "rad/s", "2π over the period in seconds")
        samples = 2.0 * np.pi / omega / base.sample_time
        if samples < 2.0:
            raise ValueError(
                f"omega={omega:.6g} rad/s and a sample time of {base.sample_time:.6g} s give "
                f"{samples:.4g} samples a period; at least two are needed: correct omega, or give "
                f"sample_time where rows carry no times"
            )
        turns = base.time * omega / (2.0 * np.pi)
        return np.floor(turns + 0.5 / samples).astype(int), int(np.floor(samples + 1e-6))

    def _always_trained(self, base):
        """Rows of the trim span."""
        if self.trim_span is None:
            return np.zeros(len(base.time), dtype=bool)
        try:
            start, stop = (float(value) for value in self.trim_span)
        except (TypeError, ValueError):
            start = stop = np.nan
        if not start < stop:
            raise ValueError(
                f"trim_span={self.trim_span!r} is no span of time; give (start, stop) in seconds, "
                f"start before stop, or None"
            )
        tolerance = 0.5 * base.sample_time
        return (base.time >= start - tolerance) & (base.time < stop - tolerance)

    def _blocks(self, periods, counted, least, n_splits, label):
        """Block of each row of one record."""
        numbers, counts = np.unique(periods[counted], return_counts=True)
        whole = numbers[counts >= least]
        if len(whole) < n_splits:
            raise ValueError(
                f"record {label!r} has {len(whole)} whole period(s) of omega={self.omega:.6g} "
                f"rad/s, too few for n_splits={n_splits} blocks; give longer records or fewer "
                f"blocks"
            )
        borders = [part[0] for part in np.array_split(whole, n_splits)[1:]]
        return np.searchsorted(borders, periods, side="right")


def _records(base):
    """Rows and label of each record, whatever gaps are in it."""
    segments, time = base.segments, base.time
    starts = [0]
    for i in range(1, len(segments)):
        again = time[segments[i].start] <= time[segments[i].start - 1]  # time begins anew
        if again or base.records[i] != base.records[i - 1]:
            starts.append(i)
    for first, following in zip(starts, [*starts[1:], len(segments)], strict=True):
        yield slice(segments[first].start, segments[following - 1].stop), base.records[first]


# ---- the rule ---------------------------------------------------------------------------------


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
        that were not searched are passed over, but not all of them.
    metric : str, default="score"
        With several metrics, the one to decide by. (Like every callable
        ``refit``, the rule leaves a search without ``best_score_``; read
        ``cv_results_["mean_test_score"][search.best_index_]``.)
    test_share : float or None, default=None
        q. None is 1/(k − 1), as in k folds of equal size.

    Returns
    -------
    index : int
        Of ``cv_results_["params"]``.

    Raises
    ------
    ValueError
        If a candidate failed on some fold (its score is not finite), there are
        fewer than two folds, or the candidates have no size.

    References
    ----------
    Breiman, Friedman, Olshen, Stone (1984), Classification and Regression
    Trees, section 3.4.3 (the rule).
    Nadeau, Bengio (2003), Inference for the generalization error, Machine
    Learning 52, 239-281.

    Examples
    --------
    >>> from functools import partial
    >>> from sklearn.model_selection import GridSearchCV, TimeSeriesSplit
    >>> from sklearn_hd import MOESPRegressor
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.standard_normal((400, 1)), np.zeros((400, 1))
    >>> for k in range(399):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> search = GridSearchCV(
    ...     MOESPRegressor(block_rows=5),
    ...     {"order": [3, 2, 1]},
    ...     cv=TimeSeriesSplit(4),
    ...     refit=partial(smallest_within_one_standard_error, size="order"),
    ... )
    >>> search.fit(u, y + 0.1 * rng.standard_normal((400, 1))).best_params_
    {'order': 1}
    """
    scores = _fold_scores(cv_results, metric)
    sizes = _sizes(cv_results, (size,) if isinstance(size, str) else tuple(size))
    n_folds = scores.shape[1]
    share = 1.0 / (n_folds - 1) if test_share is None else test_share
    check_positive("test_share", share, "rows tested over rows trained on", "None is 1/(k − 1)")
    means = scores.mean(axis=1)
    best = int(np.argmax(means))
    error = scores[best].std(ddof=1) * np.sqrt(1.0 / n_folds + share)
    within = means[best] - means <= error + ROUNDING * abs(means[best])
    return min(np.flatnonzero(within).tolist(), key=lambda i: (*sizes[i], -means[i], i))


def _fold_scores(cv_results, metric):
    """Test scores, (n_candidates, n_folds); ValueError where one is missing."""
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
    scores = np.asarray(folds, dtype=float).T
    if not np.all(np.isfinite(scores)):
        failed = [
            f"{params} on folds {np.flatnonzero(~np.isfinite(row)).tolist()}"
            for params, row in zip(cv_results["params"], scores, strict=True)
            if not np.all(np.isfinite(row))
        ]
        raise ValueError(
            f"{len(failed)} of {len(scores)} candidates failed, so that there is no mean score to "
            f"compare: {'; '.join(failed)}; take them out of the search, or see why they fail with "
            f"error_score='raise'"
        )
    return scores


def _sizes(cv_results, names):
    """One tuple of numbers a candidate, in the order of the names."""
    keys = [key for key in cv_results if key.startswith("param_")]
    columns = []
    for name in names:
        found = [key for key in keys if key == f"param_{name}" or key.endswith(f"__{name}")]
        if len(found) > 1:
            searched = [key.removeprefix("param_") for key in found]
            raise ValueError(f"size={name!r} could be any of {searched}; give the whole name")
        columns += found
    if not columns:
        searched = [key.removeprefix("param_") for key in keys]
        raise ValueError(
            f"none of size={list(names)} was searched, only {searched}; name the parameters that "
            f"make a model large with size="
        )
    sizes = [tuple(params.get(key.removeprefix("param_")) for key in columns)
             for params in cv_results["params"]]  # fmt: skip
    for params, values in zip(cv_results["params"], sizes, strict=True):
        for key, value in zip(columns, values, strict=True):
            if isinstance(value, bool) or not isinstance(value, int | float | np.number):
                raise ValueError(
                    f"{key.removeprefix('param_')}={value!r} of candidate {params} is no size: "
                    f"candidates can be compared by numbers only; search over numbers, or leave "
                    f"that parameter out of size={list(names)}"
                )
    return sizes


# ---- scorers ----------------------------------------------------------------------------------


def simulation_scorer(metric, *, greater_is_better=True, **kwargs):
    """A scorer that simulates as ``score`` does, for any metric of scikit-learn.

    Plain ``scoring="r2"`` compares with ``predict``, which starts at rest; in
    the middle of a record that can be far off. This one calls

        ± metric(y, ŷ, **kwargs)

    with ŷ the free simulation from an initial state fitted on each segment's
    warm-up, on the rows after it and in whole periods, the periodic trim taken
    from both: ``simulation_scorer(r2_score)`` is the estimator's own ``score``.

    Parameters
    ----------
    metric : callable
        ``metric(y_true, y_pred, **kwargs)``, a number.
    greater_is_better : bool, default=True
        False for errors: the scorer then returns −metric.
    **kwargs
        Handed on to the metric.

    Returns
    -------
    scorer : callable
        ``scorer(estimator, X, y, sample_weight=None)``, for ``scoring=``. The
        estimator is a model step, or a Pipeline, search or FrozenEstimator
        that ends in one.

    Examples
    --------
    >>> from sklearn.metrics import mean_absolute_error
    >>> from sklearn_hd import MOESPRegressor
    >>> scorer = simulation_scorer(mean_absolute_error, greater_is_better=False)
    >>> u, y = np.random.default_rng(0).standard_normal((300, 1)), np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.9 * y[k] + u[k]
    >>> model = MOESPRegressor(order=1, block_rows=5).fit(u[:200], y[:200])
    >>> bool(scorer(model, u[200:], y[200:]) > -1e-12)
    True
    """
    if not callable(metric):
        raise ValueError(
            f"metric={metric!r} is not callable; give a function such as sklearn.metrics.r2_score, "
            f"not its name"
        )
    return _SimulationScorer(metric, 1.0 if greater_is_better else -1.0, kwargs)


class _SimulationScorer:
    """What :func:`simulation_scorer` returns."""

    def __init__(self, metric, sign, kwargs):
        self.metric, self.sign, self.kwargs = metric, sign, kwargs

    def __call__(self, estimator, X, y, sample_weight=None):
        step, truth, simulated, weight = _simulate(estimator, X, y, sample_weight)
        if step.target_kind_ in ("series", "vector"):
            truth, simulated = truth[:, 0], simulated[:, 0]
        kwargs = dict(self.kwargs)
        if weight is not None:
            self._check_takes_weight()
            kwargs["sample_weight"] = weight
        return self.sign * float(self.metric(truth, simulated, **kwargs))

    def _check_takes_weight(self):
        parameters = inspect.signature(self.metric).parameters.values()
        if not any(p.name == "sample_weight" or p.kind is p.VAR_KEYWORD for p in parameters):
            raise TypeError(
                f"sample_weight was given, but {_name(self.metric)} takes none; leave it out or "
                f"use a metric that does"
            )

    def __repr__(self):
        given = "".join(f", {key}={value!r}" for key, value in self.kwargs.items())
        sign = "" if self.sign > 0 else ", greater_is_better=False"
        return f"simulation_scorer({_name(self.metric)}{sign}{given})"


def _name(function):
    return getattr(function, "__name__", repr(function))


def _simulate(estimator, X, y, sample_weight):
    """Last model step, measured and simulated outputs on the rows that score counts, weights."""
    step = estimator
    while not isinstance(step, ModelStep):
        if isinstance(step, Pipeline):
            if len(step) > 1:
                X = step[:-1].transform(X)
            step = step[-1]
        elif isinstance(step, FrozenEstimator):
            step = step.estimator
        elif hasattr(step, "best_estimator_"):
            step = step.best_estimator_
        else:
            raise TypeError(
                f"{type(estimator).__name__} does not end in a model step of sklearn_hd but in "
                f"{step!r}, which cannot simulate from a fitted initial state; give "
                f"MOESPRegressor, SpuriousModeReducer, StructuredMatcher or a Pipeline that ends "
                f"in one, or use scikit-learn's own scorers"
            )
    truth, simulated, rows = scored_simulation(step, X, y)
    weight = None if sample_weight is None else np.asarray(sample_weight, dtype=float)[rows]
    return step, truth, simulated, weight


def fit_percent(y_true, y_pred, *, sample_weight=None):
    """Fit of each output in percent, the NRMSE fit of system identification.

        fit = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖)

    100 for a perfect model, 0 for one no better than the mean, negative for a
    worse one; R² = 1 − (1 − fit/100)². An output that never moves has 100
    where it is met exactly, else 0 (as ``r2_score`` has 1 and 0).

    Parameters
    ----------
    y_true, y_pred : DataFrame, Series or ndarray, shape (n_samples, n_outputs) or (n_samples,)
    sample_weight : array_like, shape (n_samples,), optional
        Weights of the squares in both norms.

    Returns
    -------
    fit : ndarray, shape (n_outputs,)
        Percent.

    Raises
    ------
    ValueError
        If shapes or indices differ, or a value is not finite.

    References
    ----------
    Ljung (1999), System Identification, section 16.4; ``compare`` of MATLAB's
    System Identification Toolbox prints the same number.

    Examples
    --------
    >>> fit_percent([[1.0, 0.0], [3.0, 1.0]], [[1.0, 0.0], [3.0, 0.5]]).round(2).tolist()
    [100.0, 29.29]
    """
    truth, predicted = (
        as_container(values, name) for values, name in ((y_true, "y_true"), (y_pred, "y_pred"))
    )
    _check_comparable(truth, predicted)
    y, y_hat = (np.asarray(v, dtype=float).reshape(len(v), -1) for v in (truth, predicted))
    for values, name in ((y, "y_true"), (y_hat, "y_pred")):
        if not np.all(np.isfinite(values)):
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise ValueError(
                f"{name} is not finite in row {row}, output {column}; drop those rows from both"
            )
    weight = _check_weight(sample_weight, len(y))
    mean = np.average(y, axis=0, weights=weight)
    error = np.sqrt(weight @ (y - y_hat) ** 2)
    spread = np.sqrt(weight @ (y - mean) ** 2)
    constant = np.ptp(y[weight > 0.0], axis=0) == 0.0
    share = error / np.where(constant, 1.0, spread)
    return 100.0 * np.where(constant, error == 0.0, 1.0 - share)


def _check_comparable(truth, predicted):
    if truth.shape != predicted.shape:
        raise ValueError(
            f"y_true has shape {truth.shape} and y_pred {predicted.shape}; give the same rows and "
            f"outputs of both"
        )
    both = all(isinstance(data, pd.DataFrame | pd.Series) for data in (truth, predicted))
    if both and not truth.index.equals(predicted.index):
        raise ValueError("y_true and y_pred have different indices; align them first")


def _check_weight(sample_weight, n_samples):
    if sample_weight is None:
        return np.ones(n_samples)
    weight = np.asarray(sample_weight, dtype=float)
    if weight.shape != (n_samples,) or not np.all(weight >= 0.0) or not np.any(weight > 0.0):
        raise ValueError(
            f"sample_weight of shape {weight.shape} must hold {n_samples} numbers of at least 0, "
            f"not all of them 0"
        )
    return weight


def fit_percent_scorer(output=None):
    """A scorer of the fit in percent, simulated as ``score`` does.

        fit = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖)

    Parameters
    ----------
    output : str, int or None, default=None
        Name or position of the output that alone counts; None is the mean over
        all of them.

    Returns
    -------
    scorer : callable
        ``scorer(estimator, X, y, sample_weight=None)``, for ``scoring=``.

    See Also
    --------
    fit_percent : The same number, per output, of any two signals.
    simulation_scorer : The same simulation, for other metrics.

    Examples
    --------
    >>> from sklearn_hd import MOESPRegressor
    >>> u, y = np.random.default_rng(0).standard_normal((300, 1)), np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.9 * y[k] + u[k]
    >>> model = MOESPRegressor(order=1, block_rows=5).fit(u, y)
    >>> round(fit_percent_scorer(output=0)(model, u, y), 6)
    100.0
    """
    return _FitPercentScorer(output)


class _FitPercentScorer:
    """What :func:`fit_percent_scorer` returns."""

    def __init__(self, output):
        self.output = output

    def __call__(self, estimator, X, y, sample_weight=None):
        step, truth, simulated, weight = _simulate(estimator, X, y, sample_weight)
        fit = fit_percent(truth, simulated, sample_weight=weight)
        return float(fit.mean() if self.output is None else fit[self._position(step)])

    def _position(self, step):
        names = list(step.target_names_)
        if self.output in names:
            return names.index(self.output)
        whole = isinstance(self.output, int | np.integer) and not isinstance(self.output, bool)
        if not whole or not 0 <= self.output < len(names):
            raise ValueError(
                f"output={self.output!r} is not among the outputs {names}; give one of these "
                f"names, a position from 0 to {len(names) - 1}, or None for the mean of all"
            )
        return int(self.output)

    def __repr__(self):
        return f"fit_percent_scorer(output={self.output!r})"
