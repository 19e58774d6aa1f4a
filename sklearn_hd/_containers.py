"""Anything that users give as a table of signals, as a frame or an array of floats."""

import numpy as np
import pandas as pd
from scipy.sparse import issparse


def as_container(data, what):
    """A frame or Series as it is, anything else as an array of a shape that has rows."""
    if issparse(data):
        raise TypeError(
            f"{what} is sparse, which is not supported: signals are dense; give {what}.toarray()"
        )
    if not isinstance(data, pd.DataFrame | pd.Series):
        if hasattr(data, "__dask_graph__"):
            raise TypeError(
                f"{what} is a dask {type(data).__name__}, which MOESPRegressor.fit alone reads; "
                f"give one record, or one span, at a time in memory: {what}.partitions[0].compute()"
            )
        if hasattr(data, "__dataframe__") or hasattr(data, "to_pandas"):
            raise TypeError(
                f"{what} is a {type(data).__module__.split('.')[0]} {type(data).__name__}, which "
                f"carries no index of times; give {what}.to_pandas() with its times as the index"
            )
        data = _as_array(data, what)
        if data.ndim == 1 and what == "X":
            raise ValueError(
                "Expected 2D array, got 1D array instead. Reshape your data with "
                "X.reshape(-1, 1) if it is one signal, X.reshape(1, -1) if it is one sample"
            )
    if data.ndim > 2 or data.ndim == 0:
        raise ValueError(
            f"{what} has {data.ndim} dimensions; give (n_samples, n_signals) or (n_samples,)"
        )
    if len(data) == 0:
        raise ValueError(f"{what} has no rows: 0 sample(s), while at least 1 is required")
    if what != "X" or not isinstance(data, pd.DataFrame):  # of outputs alone, on its index
        check_has_signals(data, what)
    return data


def check_has_signals(data, what):
    """Raise ValueError if a table has no columns."""
    if data.ndim == 2 and data.shape[1] == 0:
        raise ValueError(
            f"{what} has no signals: 0 feature(s) (shape={data.shape}) while a minimum of 1 is "
            f"required; MOESPRegressor alone identifies from outputs only, with X=None or a "
            f"DataFrame of no columns"
        )


def without_inputs(y):
    """A frame of no columns on the rows of outputs, the inputs of an output-only model."""
    y = as_container(y, "y")
    return pd.DataFrame(index=getattr(y, "index", pd.RangeIndex(len(y))))


def _as_array(data, what):
    """An array of anything that has rows, NaN where it is masked."""
    if data is None or isinstance(data, str | bytes | dict):
        way = f"; make a frame of it: pd.DataFrame({what})" if isinstance(data, dict) else ""
        if data is None and what == "X":
            way = "; MOESPRegressor's models of outputs alone take a frame without columns: y[[]]"
        raise TypeError(
            f"{what} is {'None' if data is None else 'a ' + type(data).__name__}, which is no "
            f"table of signals; give a DataFrame, or an array of shape (n_samples, n_signals){way}"
        )
    if isinstance(data, np.ma.MaskedArray):
        return data.astype(np.result_type(data.dtype, np.float32)).filled(np.nan)
    try:
        return np.asarray(data)
    except ValueError:
        raise ValueError(
            f"{what} has rows of different lengths; give (n_samples, n_signals), every row as long"
        ) from None


def to_float(data, what):
    """Float values, (n_samples, n_signals), of a container."""
    types = list(data.dtypes) if isinstance(data, pd.DataFrame) else [data.dtype]
    kinds = {getattr(dtype, "kind", "O") for dtype in types}
    if "c" in kinds:
        raise ValueError(
            f"Complex data not supported: {what} is complex; give real and imaginary parts as "
            f"columns of their own"
        )
    try:
        if kinds & {"m", "M"}:
            raise TypeError("they are times")
        if isinstance(data, pd.DataFrame | pd.Series):
            values = data.to_numpy(dtype=float, na_value=np.nan)
        else:
            values = np.asarray(data, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(
            f"{what} holds values that are no numbers{_culprit(data)}: {error}; convert them first"
        ) from None
    return values.reshape(len(values), -1)


def _culprit(data):
    """The first column of a frame that holds no numbers, worded for messages."""
    if not isinstance(data, pd.DataFrame):
        return ""
    for name, column in data.items():
        try:
            if column.dtype.kind in "mM":
                return f" (column {str(name)!r})"
            column.to_numpy(dtype=float, na_value=np.nan)
        except (TypeError, ValueError, OverflowError):
            return f" (column {str(name)!r})"
    return ""
