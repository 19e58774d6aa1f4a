"""Tables of other libraries, lists of records, and tables with a clock among their signals."""

import re

import numpy as np
import pandas as pd

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
