"""Lag products kept on disk: one for all orders, and for many block rows."""

import hashlib
import os
from functools import partial

import numpy as np
from sklearn.utils.validation import check_memory

from sklearn_hd.algorithms.lag_products import lag_products

__all__ = ["cached_lag_products"]

LEAST_LAGS = 32  # that are kept: 16 block rows of the past, and of the future
MOST_LAGS = 256  # more are not kept


def cached_lag_products(memory):
    """``lag_products`` of a cache.

    Parameters
    ----------
    memory : str, joblib.Memory or None
        None keeps nothing.

    Returns
    -------
    products : callable
        With the arguments of :func:`~sklearn_hd.algorithms.lag_products.lag_products`.

    Raises
    ------
    ValueError
        If the folder cannot be written, or ``memory`` is something else.
    """
    if memory is None:
        return lag_products
    if isinstance(memory, str | os.PathLike):
        memory = os.fspath(memory)
        try:
            os.makedirs(memory, exist_ok=True)
            writable = os.access(memory, os.W_OK)
        except OSError:
            writable = False
        if not writable:
            raise ValueError(
                f"memory={memory!r} cannot be written; give a folder that can, or None to keep "
                f"nothing"
            )
    return partial(_looked_up, check_memory(memory).cache(_kept, ignore=["records"]))


def _looked_up(kept, records, n_lags, exact):
    """Lag products of some records, from those of as many lags or more."""
    if n_lags > MOST_LAGS:
        return lag_products(records, n_lags, exact)
    lags = max(LEAST_LAGS, 1 << (n_lags - 1).bit_length())
    return kept(_digest(records), lags, exact, records).fewer(n_lags)


def _kept(digest, n_lags, exact, records):
    """Lag products, stored under what their data are."""
    return lag_products(records, n_lags, exact)


def _digest(records):
    """What no other records have: their numbers, shapes and order."""
    digest = hashlib.blake2b(digest_size=20)
    for signals in records:
        for z in signals:
            digest.update(repr((z.shape, z.dtype.str)).encode())
            digest.update(np.ascontiguousarray(z))
    return digest.hexdigest()
