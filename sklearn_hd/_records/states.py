"""The state that each segment starts from, as a user may give it."""

import numpy as np
import pandas as pd


def initial_states(x0, base, n_states, state_names=None):
    """One initial state a segment.

    Parameters
    ----------
    x0 : array_like, Series, DataFrame, dict or None
        One vector for all segments, one row a segment, or one vector a record:
        in a dict, or in a DataFrame whose index holds the labels of the
        records. Labels of Series and columns of DataFrames that name the
        states put them in order. None is zero.
    base : TimeBase
    n_states : int
    state_names : sequence of str, optional

    Returns
    -------
    states : ndarray, shape (n_segments, n_states)
    """
    n_segments = len(base.segments)
    if x0 is None:
        return np.zeros((n_segments, n_states))
    if isinstance(x0, pd.Series):
        x0 = _in_order(x0.to_frame().T, state_names).iloc[0]
    if isinstance(x0, pd.DataFrame):
        x0 = _rows(_in_order(x0, state_names), base)
    if isinstance(x0, dict):
        x0 = _by_record(x0, base)
    try:
        x0 = np.asarray(x0, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"x0={x0!r} holds values that are not numbers, or states of different lengths; give "
            f"{n_states} numbers, one row of them per segment, or a dict of them by record"
        ) from None
    if not np.isfinite(x0).all():
        raise ValueError("x0 contains NaN or infinity; give finite states")
    if x0.ndim == 1:
        x0 = np.broadcast_to(x0, (n_segments, len(x0)))
    if x0.shape != (n_segments, n_states):
        raise ValueError(
            f"x0 has shape {x0.shape}; the model has {n_states} states and the data {n_segments} "
            f"segments: give ({n_states},), ({n_segments}, {n_states}) or a dict by record"
        )
    return x0


def states_by_record(states, base, state_names=None):
    """States of segments as a table that :func:`initial_states` reads.

    Parameters
    ----------
    states : sequence of ndarray, shape (n_states,)
        One a segment.
    base : TimeBase
    state_names : sequence of str, optional
        As control.StateSpace has them by default.

    Returns
    -------
    table : DataFrame, shape (n_segments, n_states)
        Indexed by record; by segment where a record has several.
    """
    once = len(set(base.records)) == len(base.records)
    index = pd.Index(base.records if once else range(len(states)))
    if index.nlevels == 1:
        index.name = "record" if once else "segment"
    n_states = len(states[0])
    columns = [f"x[{i}]" for i in range(n_states)] if state_names is None else list(state_names)
    return pd.DataFrame(np.reshape(states, (len(states), n_states)), index, columns)


def _in_order(frame, state_names):
    """Columns in the order of the states, where they bear their names."""
    if state_names is not None and set(frame.columns) == set(state_names):
        return frame[list(state_names)]
    return frame


def _rows(frame, base):
    """Rows by record where the index holds records, else one a segment as they stand."""
    labels = list(frame.index)
    if labels == list(range(len(base.segments))) and len(set(base.records)) < len(labels):
        return frame.to_numpy()  # gaps part a record
    if set(base.records) <= set(labels) and len(set(labels)) == len(labels):
        return dict(zip(labels, frame.to_numpy(), strict=True))
    if labels == list(range(len(labels))):
        return frame.to_numpy()
    raise ValueError(
        f"x0 has the rows {labels}, which are not the records {list(dict.fromkeys(base.records))}; "
        f"index it by record, or give an array with one row per segment"
    )


def _by_record(x0, base):
    """One state a segment from a dict by record."""
    records = list(dict.fromkeys(base.records))
    missing = [record for record in records if record not in x0]
    unknown = [label for label in x0 if label not in records]
    if missing or unknown:
        what = (
            f"has no state for record {missing[0]!r}"
            if missing
            else f"names the record {unknown[0]!r}, which the data do not have"
        )
        raise ValueError(
            f"x0 {what}; give one for each of {records} and no other (several levels above the "
            f"time make a tuple)"
        )
    return [x0[record] for record in base.records]
