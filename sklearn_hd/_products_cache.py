"""What searches make over and over, kept on disk: products of the data, and their factors."""

import hashlib
import os

import numpy as np
from sklearn.utils.validation import check_memory

from sklearn_hd.algorithms.hankel import hankel_factor
from sklearn_hd.algorithms.input_matrices import input_matrices
from sklearn_hd.algorithms.lag_products import lag_products
from sklearn_hd.algorithms.running_equations import input_matrices_of_sums
from sklearn_hd.algorithms.running_products import correlations

__all__ = ["KeptSums"]

LEAST_LAGS = 64  # that are kept: 32 block rows of the past, and of the future
MOST_LAGS = 256  # more are not kept


class KeptSums:
    """Products of records, and what is made of them, perhaps from a cache.

    Parameters
    ----------
    memory : str, joblib.Memory or None
        None keeps nothing.

    Raises
    ------
    ValueError
        If the folder cannot be written, or ``memory`` is something else.
    """

    def __init__(self, memory):
        self.memory = None if memory is None else check_memory(_writable(memory))

    def factor(self, inputs, outputs, block_rows, scale):
        """:func:`~sklearn_hd.algorithms.hankel.hankel_factor`."""
        if self.memory is None:
            return hankel_factor(inputs, outputs, block_rows, scale)
        records = list(zip(inputs, outputs, strict=True))
        kept = self.memory.cache(_factor, ignore=["records", "memory"])
        return kept(_digest(records), block_rows, scale, records, self.memory)

    def input_matrices(self, A, C, inputs, outputs, feedthrough, scales):
        """:func:`~sklearn_hd.algorithms.input_matrices.input_matrices`."""
        found = None
        if self.memory is not None:
            records = list(zip(inputs, outputs, strict=True))
            kept = self.memory.cache(_correlations, ignore=["records"])
            sums = kept(_digest(records), records)
            found = input_matrices_of_sums(A, C, sums, feedthrough, scales)
        if found is not None:
            return found
        return input_matrices(A, C, inputs, outputs, feedthrough, scales=scales)


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
        raise ValueError(
            f"memory={memory!r} cannot be written; give a folder that can, or None to keep nothing"
        )
    return memory


def _factor(digest, block_rows, scale, records, memory):
    """Triangular factor of records, stored under what they are."""

    def products(records, n_lags, exact):
        if n_lags > MOST_LAGS:
            return lag_products(records, n_lags, exact)
        lags = max(LEAST_LAGS, 1 << (n_lags - 1).bit_length())
        kept = memory.cache(_products, ignore=["records"])
        return kept(digest, lags, exact, records).fewer(n_lags)

    return hankel_factor(*map(list, zip(*records, strict=True)), block_rows, scale, products)


def _products(digest, n_lags, exact, records):
    """Lag products of records, stored under what they are."""
    return lag_products(records, n_lags, exact)


def _correlations(digest, records):
    """Products of records with their inputs, stored under what they are."""
    return correlations(records)


def _digest(records):
    """What no other records have: their numbers, shapes and order."""
    digest = hashlib.blake2b(digest_size=20)
    for signals in records:
        for z in signals:
            digest.update(repr((z.shape, z.dtype.str)).encode())
            digest.update(np.ascontiguousarray(z))
    return digest.hexdigest()
