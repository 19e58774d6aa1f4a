"""Fitted steps and records behind what a display is given."""

import numpy as np
import pandas as pd
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import FIRST
from sklearn_hd._model_step import ModelStep
from sklearn_hd._time import read_time
from sklearn_hd.plotting._style import SAMPLES, TIME

NAMES = {ModelStep: "MOESPRegressor, SpuriousModeReducer or StructuredMatcher"}


def steps_of(estimator):
    """The steps behind an estimator, last first: of pipelines, searches and meta-estimators."""
    if isinstance(estimator, Pipeline):
        for _, step in reversed(estimator.steps):
            yield from steps_of(step)
    elif isinstance(estimator, FrozenEstimator):
        yield from steps_of(estimator.estimator)
    elif hasattr(estimator, "cv") and hasattr(estimator, "refit"):
        check_is_fitted(estimator, "best_estimator_")
        yield from steps_of(estimator.best_estimator_)
    else:
        yield estimator
        inner = getattr(estimator, "estimator_", None)
        if inner is not None:
            yield from steps_of(inner)


def find_step(estimator, kinds):
    """The last step of some kinds, or None; NotFittedError where it is not fitted."""
    step = next((step for step in steps_of(estimator) if isinstance(step, kinds)), None)
    if step is not None:
        check_is_fitted(step)
    return step


def fitted_step(estimator, kinds, display):
    """The last step of some kinds; TypeError where there is none."""
    if isinstance(estimator, type):
        raise TypeError(
            f"{display} needs a fitted estimator, and {estimator.__name__} is a class; give an "
            f"instance that has been fitted"
        )
    step = find_step(estimator, kinds)
    if step is None:
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        names = " or ".join(NAMES.get(kind, kind.__name__) for kind in kinds)
        raise TypeError(
            f"{display} needs a fitted {names}, or a Pipeline or search that holds one; "
            f"{type(estimator).__name__} holds none"
        )
    return step


class Record:
    """Rows of one record, and their times.

    Parameters
    ----------
    data : DataFrame, Series or ndarray
    record : label or None
        None is the first record.
    timing : Timing, optional
        When rows were sampled.

    Attributes
    ----------
    rows : ndarray of bool, shape (n_rows,)
    time : ndarray, shape (n_rows_of_record,)
        Seconds.
    segments : list of slice
        Runs of consecutive rows of the record.
    label : label or None
        None where there is but one record.
    axis : str
        What the time axis is called.
    """

    def __init__(self, data, record=None, timing=None):
        step = None if timing is None else timing.sample_time
        origin = FIRST if timing is None or timing.time_origin is None else timing.time_origin
        base = read_time(data, step, origin)
        self.rows, self.label = _rows_of(getattr(data, "index", None), len(data), record)
        place = np.cumsum(self.rows) - 1
        inside = [segment for segment in base.segments if self.rows[segment.start]]
        self.segments = [slice(place[s.start], place[s.stop - 1] + 1) for s in inside]
        self.time = base.time[self.rows]
        self.axis = SAMPLES if base.counted and step in (None, 1.0) else TIME

    def title(self, text):
        """A title that names the record where there are several."""
        return text if self.label is None else f"{text} (record {self.label})"


def _rows_of(index, n_rows, record):
    if not isinstance(index, pd.MultiIndex):
        if record is not None:
            raise ValueError(
                f"record={record!r} was asked for, but the data have no (record, time) index; "
                f"leave record=None"
            )
        return np.ones(n_rows, dtype=bool), None
    labels = index.droplevel(-1)
    wanted = labels[0] if record is None else record
    rows = np.array([label == wanted for label in labels])
    if not rows.any():
        known = list(dict.fromkeys(labels))
        raise ValueError(f"record={record!r} is not among the records {known[:10]}")
    return rows, wanted


def by_label(given, default):
    """A dict of things to draw by label, from one thing or a dict."""
    return dict(given) if isinstance(given, dict) else {default: given}
