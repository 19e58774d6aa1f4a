"""Triangular factor of the block Hankel matrices of input-output data (Eq. 11).

Each block Hankel column holds 2i consecutive rows of the data, arranged

    Z = [U_f; U_p; Y_p; Y_f],    Z = L Q,  L lower triangular,

and only R = Lᵀ is needed afterwards (Verhaegen, 1994). It is built block by
block, so that the Hankel matrices never stand in memory as a whole, and no
column straddles two segments.
"""

import numpy as np
from scipy import linalg

__all__ = ["hankel_factor", "n_hankel_columns"]


def n_hankel_columns(lengths, block_rows):
    """Number of block Hankel columns that segments of some lengths give."""
    return int(sum(max(0, length - 2 * block_rows + 1) for length in lengths))


def _columns(u, y, block_rows, start, stop):
    """Block Hankel columns start … stop − 1 of one segment, one a row."""

    def windows(signal, shift):
        rows = signal[start + shift : stop + shift + block_rows - 1]
        view = np.lib.stride_tricks.sliding_window_view(rows, block_rows, axis=0)
        return view.transpose(0, 2, 1).reshape(stop - start, -1)

    return np.hstack([windows(u, block_rows), windows(u, 0), windows(y, 0), windows(y, block_rows)])


def hankel_factor(inputs, outputs, block_rows):
    """R factor of the transposed block Hankel matrix [U_f; U_p; Y_p; Y_f].

    Parameters
    ----------
    inputs : list of ndarray, shapes (n_rows_s, m)
        One array a segment.
    outputs : list of ndarray, shapes (n_rows_s, l)
    block_rows : int
        Block rows i of the past, and as many of the future.

    Returns
    -------
    R : ndarray, shape (2 i (m + l), 2 i (m + l))
        Upper triangular; RᵀR = Z Zᵀ.
    """
    width = 2 * block_rows * (inputs[0].shape[1] + outputs[0].shape[1])
    R = np.zeros((0, width))
    chunk = max(4 * width, 512)
    for u, y in zip(inputs, outputs, strict=True):
        n_columns = len(u) - 2 * block_rows + 1
        for start in range(0, n_columns, chunk):
            block = _columns(u, y, block_rows, start, min(start + chunk, n_columns))
            R = linalg.qr(np.vstack([R, block]), mode="r", overwrite_a=True)[0][:width]
    square = np.zeros((width, width))
    square[: len(R)] = R
    return square
