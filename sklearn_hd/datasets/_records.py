"""Tables of simulated records."""

import pandas as pd


def record_index(t, n_records):
    """Times t in seconds, repeated for each record where there are several."""
    if n_records == 1:
        return pd.Index(t, name="time")
    return pd.MultiIndex.from_product([range(n_records), t], names=["record", "time"])


def record_frame(values, names, index):
    """Signals of shape (n_records, n_samples, …) as a table with a column for each name."""
    return pd.DataFrame(values.reshape(len(index), -1), index, list(names))
