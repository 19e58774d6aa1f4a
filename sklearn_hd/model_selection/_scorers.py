"""Scorers that simulate as ``score`` of the model steps does."""

import inspect

import numpy as np
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline
from sklearn.utils.metadata_routing import MetadataRequest

from sklearn_hd._checks import check_count, check_weight
from sklearn_hd._containers import as_container, is_pandas, to_float
from sklearn_hd._model_step import ModelStep
from sklearn_hd._simulators import compared, power_of_two


def simulation_scorer(metric, *, greater_is_better=True, horizon=None, **kwargs):
    """Scorer that simulates as ``score`` does, for any metric of scikit-learn.

    Plain ``scoring="r2"`` compares with ``predict``, which starts at rest. In the middle of a
    record that can be far off. This scorer computes

        ± metric(y, ŷ, **kwargs)

    with ŷ the free simulation from an initial state fitted on each segment's warm-up. It compares
    the rows after the warm-up, in whole periods, without the periodic trim:
    ``simulation_scorer(r2_score)`` is the estimator's own ``score``.

    Parameters
    ----------
    metric : callable
        ``metric(y_true, y_pred, **kwargs)``, a number.
    greater_is_better : bool, default=True
        False for errors: the scorer then returns −metric.
    horizon : int or None, default=None
        None compares free simulations. A whole number compares predictions so many rows ahead of
        the measured outputs (:meth:`MOESPRegressor.predict_ahead`), for models that disturbances
        drive.
    **kwargs
        Passed to the metric.

    Returns
    -------
    scorer : callable
        ``scorer(estimator, X, y, sample_weight=None)``, for ``scoring=``; with metadata routing,
        with ``set_score_request(sample_weight=True)``. The estimator is a model step, or
        a Pipeline, search or FrozenEstimator that ends in one. As with ``score``, an unstable
        model whose simulation grows beyond 1e60 times y scores −inf.

    Raises
    ------
    ValueError
        If ``metric`` is not callable, or ``horizon`` less than 1.

    References
    ----------
    Ljung (1999), System Identification, section 16.5 (models judged by simulation).

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
    if horizon is not None:
        horizon = check_count("horizon", horizon, 1, "None is free simulation")
    return _SimulationScorer(metric, 1.0 if greater_is_better else -1.0, horizon, kwargs)


class _Scorer:
    """Says to scikit-learn's metadata routing whether it wants ``sample_weight``."""

    takes_weight = True
    _wants_weight = None  # where weights are given, an error then asks for set_score_request

    def set_score_request(self, *, sample_weight):
        """True, False or another name, as of scikit-learn's own scorers."""
        self._wants_weight = sample_weight
        return self

    def get_metadata_routing(self):
        request = MetadataRequest(owner=repr(self))
        if self.takes_weight:
            request.score.add_request(param="sample_weight", alias=self._wants_weight)
        return request


class _SimulationScorer(_Scorer):
    """What :func:`simulation_scorer` returns."""

    def __init__(self, metric, sign, horizon, kwargs):
        self.metric, self.sign, self.horizon, self.kwargs = metric, sign, horizon, kwargs

    def __call__(self, estimator, X, y, sample_weight=None):
        found = _simulate(estimator, X, y, sample_weight, horizon=self.horizon)
        if found is None:
            return -np.inf
        step, truth, simulated, weight = found
        if step.target_kind_ in ("series", "vector"):
            truth, simulated = truth[:, 0], simulated[:, 0]
        kwargs = dict(self.kwargs)
        if weight is not None:
            kwargs["sample_weight"] = weight
            if not self.takes_weight:
                raise TypeError(
                    f"sample_weight was given, but {_name(self.metric)} does not accept it; leave "
                    f"it out or use a metric that does"
                )
        return self.sign * float(self.metric(truth, simulated, **kwargs))

    @property
    def takes_weight(self):
        parameters = inspect.signature(self.metric).parameters.values()
        return any(p.name == "sample_weight" or p.kind is p.VAR_KEYWORD for p in parameters)

    def __repr__(self):
        given = "".join(f", {key}={value!r}" for key, value in self.kwargs.items())
        sign = "" if self.sign > 0 else ", greater_is_better=False"
        ahead = "" if self.horizon is None else f", horizon={self.horizon}"
        return f"simulation_scorer({_name(self.metric)}{sign}{ahead}{given})"


def _name(function):
    return getattr(function, "__name__", repr(function))


def last_model_step(estimator, X):
    """The model step at the end of an estimator, and X as the earlier steps transform it."""
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
    return step, X


def _simulate(estimator, X, y, sample_weight, horizon=None):
    """Last model step, measured and simulated outputs on the rows that score counts, weights.

    None if the simulation grows too far to be scored.
    """
    step, X = last_model_step(estimator, X)
    found = compared(step, X, y, sample_weight, horizon)
    return None if found is None else (step, *found)


def fit_percent(y_true, y_pred, *, sample_weight=None):
    """Fit of each output in percent, the NRMSE fit of system identification.

        fit = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖)

    100 means a perfect model, 0 one no better than the mean, and negative numbers a worse one; R²
    = 1 − (1 − fit/100)². An output that never moves has 100 if it is met exactly, and 0 otherwise
    (as ``r2_score`` has 1 and 0).

    Parameters
    ----------
    y_true, y_pred : DataFrame, Series or ndarray, shape (n_samples, n_outputs) or (n_samples,)
        Measured and simulated outputs, on the same rows.
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
    y, y_hat = to_float(truth, "y_true"), to_float(predicted, "y_pred")
    for values, name in ((y, "y_true"), (y_hat, "y_pred")):
        if not np.all(np.isfinite(values)):
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise ValueError(
                f"{name} is not finite in row {row}, output {column}; drop those rows from both"
            )
    weight = check_weight(sample_weight, len(y))
    if weight is None:
        weight = np.ones(len(y))
    elif not weight.any():
        raise ValueError(f"sample_weight is zero on all {len(y)} rows; give some of them a weight")
    units = power_of_two(np.vstack([y, y_hat])), power_of_two(y)  # so that squares are numbers
    weight = weight / weight.max()
    error = np.sqrt(weight @ (y / units[0] - y_hat / units[0]) ** 2)
    y = y / units[1]
    spread = np.sqrt(weight @ (y - np.average(y, axis=0, weights=weight)) ** 2)
    constant = np.ptp(y[weight > 0.0], axis=0) == 0.0
    with np.errstate(over="ignore"):
        share = error / np.where(constant, 1.0, spread) * (units[0] / units[1])
    return 100.0 * np.where(constant, error == 0.0, 1.0 - share)


def _check_comparable(truth, predicted):
    if truth.shape != predicted.shape:
        raise ValueError(
            f"y_true has shape {truth.shape} and y_pred {predicted.shape}; give the same rows and "
            f"outputs of both"
        )
    both = is_pandas(truth) and is_pandas(predicted)
    if both and not truth.index.equals(predicted.index):
        raise ValueError("y_true and y_pred have different indices; align them first")


def fit_percent_scorer(output=None):
    """Scorer of the fit in percent, simulated as ``score`` does.

        fit = 100 (1 − ‖y − ŷ‖ / ‖y − ȳ‖)

    Parameters
    ----------
    output : str, int or None, default=None
        Name or position of the only output that counts; None is the mean over all of them.

    Returns
    -------
    scorer : callable
        ``scorer(estimator, X, y, sample_weight=None)``, for ``scoring=``; −inf where ``score`` is.

    See Also
    --------
    fit_percent : The same number, per output, of any two signals.
    simulation_scorer : The same simulation, for other metrics.

    References
    ----------
    Ljung (1999), System Identification, section 16.4.

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


class _FitPercentScorer(_Scorer):
    """What :func:`fit_percent_scorer` returns."""

    def __init__(self, output):
        self.output = output

    def __call__(self, estimator, X, y, sample_weight=None):
        found = _simulate(estimator, X, y, sample_weight)
        if found is None:
            return -np.inf
        step, truth, simulated, weight = found
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
