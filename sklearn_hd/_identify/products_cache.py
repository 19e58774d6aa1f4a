"""Cache for searches: products of the data, and the factors made from them.

Products and factors lie in a folder, which processes share. A process also keeps the ones it used
last in memory, up to some megabytes, because reading a file takes longer than a small model.
Records in memory (:mod:`~sklearn_hd._identify.statistics`) ask for them.
"""

import functools
import hashlib
import os
import threading
from collections import OrderedDict

import numpy as np
from sklearn.utils.validation import check_memory

from sklearn_hd._guards import warn
from sklearn_hd.algorithms.subspace.hankel import hankel_factor
from sklearn_hd.algorithms.subspace.lag_products import lag_products
from sklearn_hd.algorithms.subspace.sums import correlations
from sklearn_hd.exceptions import CacheWarning

LAYOUT = 4  # of what is stored, raised with it: files of another one are not found
LEAST_LAGS = 64  # that are kept: 32 block rows of the past, and of the future
MOST_LAGS = 256  # more are not kept
AT_HAND = 2**26  # bytes that a process has at hand


class KeptSums:
    """Products of records, and what is made of them, from a cache: a folder or a joblib.Memory.

    ValueError is raised if the folder cannot be written, or ``memory`` is something
    else.
    """

    def __init__(self, memory):
        self.memory = check_memory(_writable(memory))
        self._digests = []

    def factor(self, inputs, outputs, block_rows, scale):
        """:func:`~sklearn_hd.algorithms.subspace.hankel.hankel_factor`."""
        records = list(zip(inputs, outputs, strict=True))

        def make():
            return hankel_factor(inputs, outputs, block_rows, scale, self._products)

        return self._kept(records, "factors", block_rows, _bytes(scale), make=make)

    def _products(self, records, n_lags, exact):
        """Lag products of records, of as many lags as other block rows ask for."""
        if n_lags > MOST_LAGS:
            return lag_products(records, n_lags, exact)
        lags = max(LEAST_LAGS, 1 << (n_lags - 1).bit_length())

        def make():
            return lag_products(records, lags, exact)

        return self._kept(records, "products", lags, exact, make=make).fewer(n_lags)

    def projection(self, inputs, outputs, scale, make, *choices):
        """What ``make`` makes of the factor, which depends on some choices and on nothing else."""
        records = list(zip(inputs, outputs, strict=True))
        return self._kept(records, "projection", _bytes(scale), *choices, make=make, stored=False)

    def sums(self, inputs, outputs):
        """:func:`~sklearn_hd.algorithms.subspace.sums.correlations`."""
        records = list(zip(inputs, outputs, strict=True))
        return self._kept(records, "correlations", make=lambda: correlations(records))

    def _kept(self, records, what, *choices, make, stored=True):
        """What ``make`` makes of records, unless this process, or the folder, has it already."""
        key = (what, self._digest(records), *choices)
        load = functools.partial(_from_folder, self.memory, key, make) if stored else make
        return _RECENT.get((str(getattr(self.memory, "location", "")), *key), load)

    def _digest(self, records):
        """What no other records have: their numbers, shapes and order."""
        signals = [z for pair in records for z in pair]
        for others, digest in self._digests:
            if len(others) == len(signals) and all(map(_same, others, signals)):
                return digest
        self._digests.append((signals, _digest(records)))
        return self._digests[-1][1]


class _Recent:
    """Values by key, those asked for last, up to some bytes."""

    def __init__(self, most):
        self.most, self.size = most, 0
        self.values, self.lock = OrderedDict(), threading.Lock()

    def get(self, key, make):
        with self.lock:
            if key in self.values:
                self.values.move_to_end(key)
                return self.values[key][0]
        value = make()
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        size = _n_bytes(value)
        with self.lock:
            if key not in self.values and size <= self.most:
                self.values[key] = value, size
                self.size += size
            while self.size > self.most:
                self.size -= self.values.popitem(last=False)[1][1]
        return value


_RECENT = _Recent(AT_HAND)


def _n_bytes(value):
    """Bytes of the arrays in a value, or in the tuples and attributes that it is made of."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    parts = value if isinstance(value, tuple | list) else vars(value).values()
    inside = (np.ndarray, tuple, list)
    return sum(_n_bytes(p) for p in parts if isinstance(p, inside) or hasattr(p, "__dict__"))


def _bytes(scale):
    return None if scale is None else scale.tobytes()


def _same(one, other):
    """Whether two arrays are one and the same memory."""
    return one is other or (
        one.shape == other.shape
        and one.strides == other.strides
        and one.__array_interface__["data"] == other.__array_interface__["data"]
    )


def _writable(memory):
    """A folder that can be written, or what else was given."""
    if not isinstance(memory, str | os.PathLike):
        return memory
    memory = os.fspath(memory)
    try:
        os.makedirs(memory, exist_ok=True)
        writable = os.access(memory, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        wrong = "is a file" if os.path.isfile(memory) else "cannot be written"
        raise ValueError(
            f"memory={memory!r} {wrong}; give a folder that can be written, or None to keep nothing"
        )
    return memory


def _from_folder(memory, key, make):
    """What is stored in a folder under a key, else what ``make`` makes, which is stored there.

    Its key is stored with it. A file that cannot be read, or has another key, is made anew; a
    folder that cannot be used is done without.
    """
    try:
        kept = memory.cache(_made, ignore=["make"])
        if kept.check_call_in_cache(key, make):
            shelf = kept.call_and_shelve(key, make)
            found, wrong = _read(shelf, key)
            if wrong is None:
                return found
            file = os.path.join(shelf.store_backend.location, shelf.func_id, shelf.args_id)
            warn(f"{file} is not what was kept there ({wrong}); it is computed anew", CacheWarning)
            shelf.clear()
    except (OSError, ValueError) as error:  # the latter of joblib's own notes there
        warn(
            f"the folder memory={memory.location!r} cannot be used ({error}), so nothing is kept; "
            f"clear it, give another, or None",
            CacheWarning,
        )
        return make()
    value = make()
    return kept(key, lambda: value)[1]


def _read(shelf, key):
    """What is on a shelf, or None and why it is not what was put there."""
    try:
        origin, value = shelf.get()
        if origin == key:
            return value, None
    except Exception as error:  # reading a pickle can raise anything
        return None, f"{type(error).__name__}: {error}"
    return None, "it belongs to other data or settings"


def _made(key, make):
    """A key, and what is stored under it."""
    return key, make()


def _digest(records):
    digest = hashlib.blake2b(repr(LAYOUT).encode(), digest_size=20)
    for signals in records:
        for z in signals:
            columns = z.flags.f_contiguous and not z.flags.c_contiguous
            digest.update(repr((z.shape, z.dtype.str, columns)).encode())
            digest.update(np.ascontiguousarray(z.T if columns else z))
    return digest.hexdigest()
