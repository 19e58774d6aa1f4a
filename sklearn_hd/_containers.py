"""Tables that users give, of pandas and others: what they may be, and their values as floats."""

import re

import numpy as np
import pandas as pd
from scipy.sparse import issparse

from sklearn_hd._guards import searches, warn
from sklearn_hd.exceptions import TimeBaseWarning

Table = pd.DataFrame | pd.Series
CLOCK = re.compile(
    r"(t|(?i:time|timestamp|datetime|date))([ _]?[\[(](?P<unit>.*)[\])]|[ _](?P<tail>\w+))?"
)
IN_A_SECOND = {"": 1, "s": 1, "sec": 1, "seconds": 1, "ms": 1000, "us": 1e6, "µs": 1e6, "ns": 1e9}
RECORD = 8  # rows, at least, between the restarts of a clock


def is_pandas(data):
    """Whether it is a frame or a Series of pandas."""
    return isinstance(data, Table)


def is_partitioned(data):
    """Whether it is a collection of dask's, told without importing dask."""
    return hasattr(data, "__dask_graph__") and not hasattr(data, "dims")  # xarray's has both


def from_elsewhere(data, what):
    """A table of another library as a pandas object; other things stay as they are.

    Frames without an index (polars, pyarrow) get their column of times as the index, behind their
    column ``record`` if they have one.
    """
    if hasattr(data, "to_dataframe") and hasattr(data, "dims"):
        raise TypeError(_of_xarray(data, what))
    if hasattr(data, "collect") and not hasattr(data, "to_pandas"):
        raise TypeError(f"{what} is a {type(data).__name__}, not read yet; give {what}.collect()")
    if is_pandas(data) or hasattr(data, "__dask_graph__") or not hasattr(data, "to_pandas"):
        return data
    if hasattr(data, "index"):
        return data.to_pandas()
    names = list(getattr(data, "column_names", getattr(data, "columns", ())))
    if not names:
        return pd.Series(data.to_numpy(), name=getattr(data, "name", None))
    frame = pd.DataFrame({name: data[name].to_numpy() for name in names})
    clocks = [name for name in names if _is_clock(frame, name)][:1]
    if not clocks:
        return frame
    unit = _in_a_second(clocks[0])
    if unit != 1 and getattr(frame[clocks[0]].dtype, "kind", "O") in "iuf":
        frame[clocks[0]] = frame[clocks[0]] / unit
    return frame.set_index([name for name in ("record", *clocks) if name in names])


def _in_a_second(name):
    """Number of a clock's units per second, by its name; None if it is not a clock's."""
    found = CLOCK.fullmatch(str(name))
    return found and IN_A_SECOND.get(found["unit"] or found["tail"] or "")


def _is_clock(frame, name):
    """Whether a column is named as a clock, and runs as one."""
    if _in_a_second(name) is None or frame[name].ndim > 1:
        return False
    starts = _starts(frame[name])
    return starts == 1 or starts * RECORD <= len(frame)


def _of_xarray(data, what):
    """The line that converts xarray data to a frame, for messages."""
    dims = sorted(map(str, data.dims), key=lambda dim: _in_a_second(dim) is not None)
    if hasattr(data, "data_vars"):
        way = f"{what}.to_dataframe(dim_order={dims})"
    elif len(dims) == 1:
        way = f"{what}.to_pandas()"
    else:
        signals = [dim for dim in dims[:-1] if dim != "record"][-1:] or dims[:1]
        order = [dim for dim in dims if dim not in signals]
        signals = signals[0]
        way = f"{what}.to_dataset(dim={signals!r}).to_dataframe(dim_order={order})"
        if len(dims) == 2:
            way += f", or {what}.to_series() if {signals!r} are the records of one signal"
    return (
        f"{what} is an xarray {type(data).__name__} with the dimensions {list(data.dims)}; convert "
        f"it to a DataFrame with one column per signal and the times as the last index level: {way}"
    )


def check_no_records(data, what):
    """Raise TypeError for several tables in a list or a dict, which should be one frame."""
    parts = list(data.values() if isinstance(data, dict) else data)
    named, given = isinstance(data, dict), what
    if not any(isinstance(part, pd.DataFrame if named else Table) for part in parts):
        if named or not any(isinstance(part, np.ndarray) and part.ndim == 2 for part in parts):
            return
        given = f"[pd.DataFrame(record) for record in {what}]"
    keys = "" if named else f"keys=range({len(parts)}), "
    raise TypeError(
        f"{what} is a {type(data).__name__} of {len(parts)} tables; join them to one DataFrame "
        f'whose index names the record of each row: pd.concat({given}, {keys}names=["record"])'
    )


def check_no_clock(data, what):
    """Raise ValueError if a column of a frame is named as a clock, and runs as one."""
    for name in data.columns:
        few = len(data) < RECORD and getattr(data.dtypes.get(name), "kind", "O") in "iuf"
        if few or not _is_clock(data, name):
            continue
        raise ValueError(
            f"column {str(name)!r} of {what} looks like a clock and would be used as a signal "
            f"(rename it if it is one); {_way(data, name, what, _starts(data[name]))}"
        )


def _starts(column):
    """Number of times a column starts to grow again; 1 for a clock of one record."""
    kind = getattr(column.dtype, "kind", "O")
    if kind not in "iufmM":
        return len(column) if kind in "bc" else 1  # of texts
    floats = {} if kind in "mM" else {"dtype": float, "na_value": np.nan}
    values = column.to_numpy(**floats)
    return max(2 - len(values), 0) + 1 + int(np.sum(~(values[1:] > values[:-1])))


def _way(data, name, what, starts):
    """The code that makes a clock the index, for messages."""
    index, key, unit = data.index, repr(name), _in_a_second(name)
    seconds = key if unit == 1 else f"{what}.pop({key}) / {unit:g}"
    counts = pd.api.types.is_integer_dtype(index.get_level_values(-1).dtype)
    if index.is_unique and not counts:
        return f"the index holds times already: {what}.drop(columns={key})"
    if not index.is_unique:  # the records alone
        way = f"{what}.set_index({seconds}, append=True)"
    elif isinstance(index, pd.MultiIndex):
        way = f"{what}.droplevel(-1).set_index({seconds}, append=True)"
    elif starts > 1:
        way = f"{what}.set_index([record, {seconds}]), with the name of the column of records"
    elif getattr(data[name].dtype, "kind", "O") in "iufmM":
        way = f"{what}.set_index({seconds})"
    else:
        way = f"{what}.drop(columns={key}).set_axis(pd.to_datetime({what}[{key}]))"
    beside = "" if what == "y" else f", and y = y.set_axis({what}.index)"
    return f"make it the index, in seconds or as dates: {what} = {way}{beside}"


def as_container(data, what):
    """A frame or Series as it is, anything else as an array of a shape that has rows."""
    if issparse(data):
        raise TypeError(
            f"{what} is sparse, which is not supported: signals are dense; give {what}.toarray()"
        )
    given, data = data, from_elsewhere(data, what)
    if not is_pandas(data):
        if hasattr(data, "__dask_graph__"):
            raise TypeError(
                f"{what} is a dask {type(data).__name__}, which only MOESPRegressor.fit accepts; "
                f"load one record, or one span, at a time into memory: "
                f"{what}.partitions[0].compute()"
            )
        if hasattr(data, "__dataframe__"):
            raise TypeError(
                f"{what} is a {type(data).__module__.split('.')[0]} {type(data).__name__}, which "
                f"has no index of times; give a pandas DataFrame with its times as the index"
            )
        data = _as_array(data, what)
        if data.ndim == 1 and what == "X":
            raise ValueError(
                "Expected 2D array, got 1D array instead. Reshape your data with "
                "X.reshape(-1, 1) if it is one signal, X.reshape(1, -1) if it is one sample"
            )
    if data.ndim > 2 or data.ndim == 0:
        records = ", or one record below the other: pd.concat("
        records += f"[pd.DataFrame(record) for record in {what}], "
        records += f'keys=range(len({what})), names=["record"])'
        raise ValueError(
            f"{what} has {data.ndim} dimensions; give (n_samples, n_signals) or (n_samples,)"
            f"{records if data.ndim == 3 else ''}"
        )
    if isinstance(data, pd.DataFrame):
        check_no_clock(data, what)
    if what == "X" and not keeps_times(given, data):
        _warn_of_joined_rows(data)
    if len(data) == 0:
        raise ValueError(f"{what} has no rows: 0 sample(s), while at least 1 is required")
    if what != "X" or not isinstance(data, pd.DataFrame):  # of outputs alone, on its index
        check_has_signals(data, what)
    return data


def keeps_times(given, data):
    """Whether rows taken out of what was given leave a hole, in the index that it is read with."""
    return is_pandas(given) or (is_pandas(data) and not isinstance(data.index, pd.RangeIndex))


def _warn_of_joined_rows(data):
    """Warn if rows without times are the training rows of a fold, and were not consecutive.

    An array does not show it, but the cross-validation that has cut it does.
    """
    for frame in searches():
        train = np.asarray(frame.f_locals.get("train"))
        if train.shape == data.shape[:1] and train.dtype.kind == "i":
            seams = np.count_nonzero(np.diff(train) != 1)
            if seams:
                warn(
                    f"the training rows of a fold are joined at {seams} place(s) where others were "
                    f"left out, because an array has no times: this puts a jump into the record; "
                    f"split with sklearn_hd.model_selection.BlockSplit, or give pd.DataFrame(X), "
                    f"whose index steps before this one must keep (set_output(transform='pandas'))",
                    TimeBaseWarning,
                )


def check_has_signals(data, what):
    """Raise ValueError if a table has no columns."""
    if data.ndim == 2 and data.shape[1] == 0:
        raise ValueError(
            f"{what} has no signals: 0 feature(s) (shape={data.shape}) while a minimum of 1 is "
            f"required; MOESPRegressor alone identifies from outputs only, with X=None or a "
            f"DataFrame of no columns"
        )


def check_upright(data, what):
    """Raise ValueError for an array with more signals than samples, which is transposed."""
    if not isinstance(data, np.ndarray) or data.ndim != 2:
        return
    rows, columns = data.shape
    if 1 < rows < columns:
        raise ValueError(
            f"{what} has {rows} rows and {columns} columns, more signals than samples: it is "
            f"probably transposed; give one row per sample, {what}.T"
        )


def without_inputs(y):
    """A frame of no columns on the rows of outputs, the inputs of an output-only model."""
    y = as_container(y, "y")
    return pd.DataFrame(index=getattr(y, "index", pd.RangeIndex(len(y))))


def _as_array(data, what):
    """An array of anything that has rows, NaN where it is masked."""
    if isinstance(data, dict | list | tuple):
        check_no_records(data, what)
    if data is None or isinstance(data, str | bytes | dict):
        way = f"; make it a DataFrame: pd.DataFrame({what})" if isinstance(data, dict) else ""
        if data is None and what == "X":
            way = (
                "; a model of outputs alone, MOESPRegressor().fit(None, y) without the analyzer, "
                "takes a frame without columns for X later: y[[]]"
            )
        raise TypeError(
            f"{what} is {'None' if data is None else 'a ' + type(data).__name__}, which is not a "
            f"table of signals; give a DataFrame, or an array of shape (n_samples, n_signals){way}"
        )
    if isinstance(data, np.ma.MaskedArray):
        return data.astype(np.result_type(data.dtype, np.float32)).filled(np.nan)
    if getattr(getattr(data, "dtype", None), "names", None):
        raise TypeError(
            f"{what} is an array of named fields; make it a DataFrame: pd.DataFrame({what})"
        )
    try:
        return np.asarray(data)
    except ValueError:
        raise ValueError(
            f"{what} has rows of different lengths; give (n_samples, n_signals), with rows of "
            f"equal length"
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
            f"{what} holds values that are not numbers{_culprit(data)}: {error}; convert them first"
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


def warn_if_counted(base, why="no times given", step=""):
    """Warn of rows that count as samples."""
    if base.counted:
        warn(
            f"{why}: rows count as samples, {base.sample_time:.4g} s apart{step}, of one "
            f"contiguous record that starts at psi = 0; use a DataFrame indexed by seconds",
            TimeBaseWarning,
        )
