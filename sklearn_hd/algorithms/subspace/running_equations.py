"""B, D and the initial states from sums over records (:mod:`~.running_products`)."""

from dataclasses import replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import safe_cholesky
from sklearn_hd.algorithms.subspace.innovations import InnovationForm
from sklearn_hd.algorithms.subspace.input_matrices import alike_states, input_matrices
from sklearn_hd.algorithms.subspace.response_basis import pulses
from sklearn_hd.algorithms.subspace.response_products import (
    ResponseProducts,
    normal_equations,
    output_normal,
)

__all__ = [
    "initial_states_of_heads",
    "input_matrices_of_factor",
    "input_matrices_of_heads",
    "input_matrices_of_sums",
]

FORGOTTEN = 1e-13  # of a response, K rows later
UNSEEN = 1e-12  # share of an initial state's outputs that is rounding
FIRST_ROWS = 256  # that a slow model's initial state is found from


def input_matrices_of_sums(A, C, sums, feedthrough, scales):
    """B, D and the initial states by least squares over all rows of all records.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    sums : RunningSums
    feedthrough : bool
        Whether D is free (else zero).
    scales : tuple of ndarray, shapes (m,), (l,)
        What inputs and outputs are divided by.

    Returns
    -------
    B : ndarray, shape (n, m)
    D : ndarray, shape (l, m)
    x0 : ndarray, shape (n_records, n)
        None instead of all three where the model remembers more rows than the sums reach,
        or rounding would show.
    """
    A, C, size = alike_states(A, C)
    model = output_normal(A, C)
    if model is None or len(scales[0]) == 0:
        return None
    records = _record_products(model.basis, sums, scales)
    if records is None:
        return None
    n, m, n_outputs = len(A), len(scales[0]), len(C)
    shared, starts, loss = 0.0, [], 0.0
    for products in records:
        G, _ = normal_equations(model, products, feedthrough)
        G = np.triu(G) + np.triu(G, 1).T
        seen, directions = linalg.eigh(G[:n, :n])
        inverse = np.where(seen > UNSEEN, 1.0 / np.maximum(seen, UNSEEN), 0.0)
        inverse = (directions * inverse) @ directions.T
        starts.append((inverse @ G[:n, n:-1], inverse @ G[:n, -1]))
        loss = loss + np.diagonal(G)[n : n + n * m]
        shared = shared + G[n:, n:] - G[n:, :n] @ inverse @ G[:n, n:]
    whole = np.tile(np.diagonal(records[0].inputs), n)
    if not np.all(loss > 0.0):
        return None
    R = safe_cholesky(shared[:-1, :-1], model.error * np.max(whole / loss))
    if R is None:
        return None
    theta = linalg.cho_solve((R, False), shared[:-1, -1])
    x0 = np.array([right - coupling @ theta for coupling, right in starts])
    B, D = theta[: n * m].reshape(n, m), np.zeros((n_outputs, m))
    if feedthrough:
        D = theta[n * m :].reshape(n_outputs, m)
    B, x0 = linalg.solve_triangular(model.T, B), linalg.solve_triangular(model.T, x0.T).T
    return B / size[:, None], D, x0 / size


def _record_products(basis, sums, scales):
    """Products of each record with responses; those that only their sum is known of in the first.

    Normal equations are linear in these.
    """
    m, scale, reach = len(scales[0]), np.concatenate(scales), len(sums.lags) - 1
    answers = pulses(basis.F, basis.g, reach)
    if np.max(np.abs(answers[-1])) > FORGOTTEN and any(e.n_rows > reach for e in sums.ends):
        return None
    forced = np.tensordot(answers, sums.lags[1:], ((0,), (0,))).transpose(1, 0, 2)
    lags = sums.lags[0] / scales[0][:, None] / scale
    first = ResponseProducts(
        forced=forced / scales[0][:, None, None] / scale,
        free=np.zeros((len(basis.g), len(scale))),
        last=np.zeros((m, len(basis.g))),
        inputs=lags,
        outputs=float(np.sum(sums.squares / scales[1] ** 2)),
        n_samples=0,
    )
    nothing = replace(first, forced=0.0 * first.forced, inputs=0.0 * lags, outputs=0.0)
    records = []
    for k, ends in enumerate(sums.ends):
        free = answers[: len(ends.head)].T @ ends.head / scale
        last = ends.tail[::-1].T @ answers[: len(ends.tail)] / scales[0][:, None]
        common = nothing if k else first
        records.append(replace(common, free=free, last=last, n_samples=ends.n_rows))
    return records


def input_matrices_of_heads(A, C, ends, feedthrough, scales):
    """B, D and the initial states of records that are no longer than their first rows kept.

    Parameters
    ----------
    A, C, feedthrough, scales
        As for :func:`input_matrices_of_sums`.
    ends : tuple of RecordEnds

    Returns
    -------
    B : ndarray, shape (n, m)
    D : ndarray, shape (l, m)
    x0 : ndarray, shape (n_records, n)
        None instead of all three where a record is longer.
    """
    if any(record.n_rows > len(record.head) for record in ends):
        return None
    pairs = (np.split(record.head, [len(scales[0])], axis=1) for record in ends)
    inputs, outputs = zip(*pairs, strict=True)
    return input_matrices(A, C, inputs, outputs, feedthrough, scales=scales)


def input_matrices_of_factor(A, C, R, directions, block_rows, n_inputs, feedthrough):
    """B and D from the triangular factor alone (Verhaegen, 1994).

    What is orthogonal to the extended observability matrix Γ sees the future inputs only,
    through the block Toeplitz matrix H of D, C B, C A B, …

        Γ⊥' Y_f = Γ⊥' H(B, D) U_f + noise

    Each column of the Hankel matrix has an initial state of its own: less is asked of the
    model than of one that is simulated, and less said of B and D where it is slow.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    C : ndarray, shape (l, n)
    R : ndarray
        From :func:`~sklearn_hd.algorithms.subspace.hankel.factor_of_products`.
    directions : ndarray, shape (i l, i l)
        The first n of them span Γ.
    block_rows, n_inputs : int
    feedthrough : bool

    Returns
    -------
    B : ndarray, shape (n, m)
    D : ndarray, shape (l, m)
    """
    n, n_outputs, i, m = len(A), len(C), block_rows, n_inputs
    if m == 0:
        return np.zeros((n, 0)), np.zeros((n_outputs, 0))
    across = linalg.qr(directions[:, :n])[0][:, n:]
    beside = across.reshape(i, n_outputs, -1)  # block row, output, direction
    gamma = [C]
    for _ in range(i - 1):
        gamma.append(gamma[-1] @ A)
    maps = np.zeros((i, beside.shape[-1], n_outputs + n))  # of [D; B], for each block of inputs
    for k in range(i):
        maps[k, :, :n_outputs] = beside[k].T
        if k < i - 1:
            later = np.stack(gamma[: i - 1 - k])
            maps[k, :, n_outputs:] = np.einsum("jod,jon->dn", beside[k + 1 :], later)
    if not feedthrough:
        maps = maps[..., n_outputs:]
    inputs = R[: i * m, : i * m].reshape(i * m, i, m)
    regressors = np.einsum("rkc,kdz->rdzc", inputs, maps, optimize=True)
    target = R[: i * m, -i * n_outputs :] @ across
    width = maps.shape[-1]
    theta = linalg.lstsq(regressors.reshape(-1, width * m), target.ravel(), lapack_driver="gelsy")
    theta = theta[0].reshape(width, m)
    D = theta[:n_outputs] if feedthrough else np.zeros((n_outputs, m))
    return theta[width - n :], D


def initial_states_of_heads(A, B, C, D, ends, scales, noise=(None, None)):
    """Initial states by least squares over the first rows of each record.

    Parameters
    ----------
    A, B, C, D : ndarray
        In the units that ``scales`` make.
    ends : tuple of RecordEnds
    scales : tuple of ndarray, shapes (m,), (l,)
    noise : tuple of ndarray, shapes (n, l), (l, l), optional
        Kalman gain and covariance of the innovations, where the rows before are to be known by
        their outputs.

    Returns
    -------
    x0 : ndarray, shape (n_records, n)
    """
    K, covariance = noise
    m, rows = B.shape[1], slice(None) if K is not None else slice(FIRST_ROWS)
    form = InnovationForm(A, B, C, D, np.zeros((len(A), len(C))) if K is None else K)
    heads = (record.head[rows] / np.concatenate(scales) for record in ends)
    return np.array([form.initial_state(head[:, :m], head[:, m:], covariance) for head in heads])
