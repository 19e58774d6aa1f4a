"""Triangular factor of the block Hankel matrices of input-output data (Eq. 11).

Each block Hankel column holds 2i consecutive rows of the data, arranged

    Z = [U_f; U_p; Y_p; Y_f],    Z = L Q,  L lower triangular,

and only R = Lᵀ is needed afterwards (Verhaegen, 1994). The Hankel matrices never stand in
memory as a whole, and no column straddles two segments. Three ways lead to R, each taken
where the one before it would not do:

1. Cholesky factor of the Gram matrix Z Zᵀ, which follows from lagged products of the data
   (:mod:`~sklearn_hd.algorithms.subspace.lag_products`). Sums in double perturb the columns of R,
   brought to equal length, by about ε ‖R⁻¹‖² beside each other. Noise makes ‖R⁻¹‖ small:
   then this is far less than what noise does, 1/√n. Without noise R is singular, and the
   loss total, without a sign of it in the result.
2. The same from exact sums, in double-double, where there are many columns. Its errors are
   those of orthogonal transformations: ε beside the length of each column of R.
3. Orthogonal transformations of the Hankel columns, block by block, where there are few.
"""

import functools

import numpy as np

from sklearn_hd.algorithms.linalg.double_double import cholesky
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT
from sklearn_hd.algorithms.linalg.triangular import all_above_rounding, safe_cholesky, triangle
from sklearn_hd.algorithms.subspace.lag_products import lag_products

FEW_COLUMNS = 32  # times rows: fewer are faster by orthogonal transformations than exactly


def n_hankel_columns(lengths, block_rows):
    """Number of block Hankel columns that segments of some lengths give."""
    return int(sum(max(0, length - 2 * block_rows + 1) for length in lengths))


def hankel_factor(inputs, outputs, block_rows, scale=None, products=None):
    """R factor of the transposed block Hankel matrix [U_f; U_p; Y_p; Y_f].

    Each segment has inputs (n_rows_s, m) and outputs (n_rows_s, l). The past has
    ``block_rows`` i, and the future as many. Channels, inputs before outputs, are
    divided by ``scale`` (m + l,). ``products`` stands in for ``lag_products``, such as
    a cache of them. R is upper triangular of size 2 i (m + l), with RᵀR = Z Zᵀ.
    """
    products = products or lag_products
    n_inputs, n_lags = inputs[0].shape[1], 2 * block_rows
    width = n_lags * (n_inputs + outputs[0].shape[1])
    n_columns = n_hankel_columns([len(u) for u in inputs], block_rows)
    records = list(zip(inputs, outputs, strict=True))
    if n_columns >= width:
        R = factor_of_products(products(records, n_lags, exact=False), n_inputs, scale)
        if R is not None:
            return R
    if n_columns >= FEW_COLUMNS * width:
        return factor_of_products(products(records, n_lags, exact=True), n_inputs, scale)
    R = _orthogonal_factor(records, block_rows)
    if scale is not None:
        R /= np.tile(scale, n_lags)[block_order(n_lags, len(scale), n_inputs)]
    return R


def factor_of_products(products, n_inputs, scale=None):
    """R factor from lag products.

    The products are of the inputs, then the outputs, in 2i lags. Channels are divided
    by ``scale`` (m + l,). It returns None where plain sums have lost what R should say;
    exact ones never have.
    """
    n_lags = len(products.lags)
    order = block_order(n_lags, len(products.exponents), n_inputs)
    G = products.gram(order)
    R = safe_cholesky(G.high, overwrite=not products.exact)
    if R is None and products.exact:
        R = cholesky(G.high, G.low)
    if R is None:
        return None
    units = np.ldexp(1.0, products.exponents)
    units = units if scale is None else units / scale
    if np.any(units != 1.0):
        R *= np.tile(units, n_lags)[order]
    return R


def n_excited(R, block_rows, n_inputs):
    """Directions that the inputs excite of the 2 i m that their Hankel rows have.

    ``R`` is from :func:`hankel_factor`.
    """
    size = 2 * block_rows * n_inputs
    if all_above_rounding(R[:size, :size]):
        return size
    values = np.linalg.svd(R[:size, :size], compute_uv=False)
    return int(np.sum(values > DEPENDENT * np.max(values, initial=0.0)))


@functools.lru_cache(maxsize=8)
def block_order(n_lags, n_channels, n_inputs):
    """Where the rows U_f, U_p, Y_p, Y_f stand among rows ordered by time."""
    rows = np.arange(n_lags * n_channels).reshape(n_lags, n_channels)
    past, future = np.split(rows, 2)
    parts = future[:, :n_inputs], past[:, :n_inputs], past[:, n_inputs:], future[:, n_inputs:]
    return np.concatenate([part.reshape(-1) for part in parts])


def _orthogonal_factor(records, block_rows):
    """R factor by blocked QR factorisations."""
    width = 2 * block_rows * sum(signal.shape[1] for signal in records[0])
    R = np.zeros((0, width))
    chunk = max(width, 512)  # four times as many take a third less time, and twice the memory
    for u, y in records:
        n_columns = len(u) - 2 * block_rows + 1
        for start in range(0, n_columns, chunk):
            block = _columns(u, y, block_rows, start, min(start + chunk, n_columns))
            R = triangle(block, R)  # R above the block would lose more digits
    square = np.zeros((width, width))
    square[: len(R)] = R
    return square


def _columns(u, y, block_rows, start, stop):
    """Block Hankel columns start … stop − 1 of one segment, one a row."""

    def windows(signal, shift):
        rows = signal[start + shift : stop + shift + block_rows - 1]
        view = np.lib.stride_tricks.sliding_window_view(rows, block_rows, axis=0)
        return view.transpose(0, 2, 1).reshape(stop - start, -1)

    return np.hstack([windows(u, block_rows), windows(u, 0), windows(y, 0), windows(y, block_rows)])
