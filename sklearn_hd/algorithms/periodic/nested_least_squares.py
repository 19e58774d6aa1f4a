"""Linear least squares of one target on more and more regressors."""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.structured_model import column_sizes

__all__ = ["NestedLeastSquares"]

RANK = 1e-11  # singular values relative to the largest; deficient regressors have 1e-15
NEW = 1e-13  # of a column's length: rounding is what is left of one that Q spans
NULL_SHARE = 1e-6  # of a parameter's direction in the null space


class NestedLeastSquares:
    """min |y − X b|², solved again after columns have been added to X.

    X = Q R grows by blocks: what is new in a block is found off Q, twice (Daniel and others,
    1976), so that no column is orthogonalised again.

    Parameters
    ----------
    target : ndarray, shape (n_rows,)
        y.

    References
    ----------
    J. W. Daniel, W. B. Gragg, L. Kaufman, G. W. Stewart, "Reorthogonalization and stable
    algorithms for updating the Gram-Schmidt QR factorization", Mathematics of Computation 30
    (1976), 772-795.

    Examples
    --------
    >>> line = NestedLeastSquares(np.array([1.0, 2.0, 4.0]))
    >>> line.extend(np.ones((3, 1)))
    >>> line.solve()[0].round(6).tolist()
    [2.333333]
    >>> line.extend(np.array([[0.0], [1.0], [2.0]]))
    >>> line.solve()[0].round(6).tolist()
    [0.833333, 1.5]
    """

    def __init__(self, target):
        self.target = target
        self.columns, self.bases = [], []  # X and Q, by blocks
        self.size, self.factor, self.seen = np.zeros(0), np.zeros((0, 0)), np.zeros(0)

    def extend(self, columns):
        """Add columns to X.

        Parameters
        ----------
        columns : ndarray, shape (n_rows, k)
        """
        size = column_sizes(columns)
        rest, inside = columns / size, np.zeros((len(self.factor), columns.shape[1]))
        for _ in range(2):
            shares = [Q.T @ rest for Q in self.bases]
            for Q, share in zip(self.bases, shares, strict=True):
                rest -= Q @ share
            if shares:
                inside += np.vstack(shares)
        Q, own, order = linalg.qr(
            rest, mode="economic", pivoting=True, overwrite_a=True, check_finite=False
        )
        new = np.sum(np.abs(np.diagonal(own)) > NEW)  # of what is none, Q would hold what it has
        R, below = np.zeros((new, len(order))), np.zeros((new, self.factor.shape[1]))
        Q, R[:, order] = Q[:, :new], own[:new]
        self.factor = np.block([[self.factor, inside], [below, R]])
        self.size, self.seen = np.append(self.size, size), np.append(self.seen, Q.T @ self.target)
        self.columns.append(columns)
        self.bases.append(Q)

    def solve(self):
        """The shortest solution, columns counted as of one length.

        Returns
        -------
        solution : ndarray, shape (k,)
            b.
        left : ndarray, shape (n_rows,)
            y − X b.
        unknown : ndarray of bool, shape (k,)
            What y does not determine.
        """
        U, values, Vt = np.linalg.svd(self.factor)
        rank = np.sum(values > RANK * np.max(values, initial=0.0))
        solution = Vt[:rank].T @ (U[:, :rank].T @ self.seen / values[:rank]) / self.size
        left = self.target.copy()
        edges = np.cumsum([columns.shape[1] for columns in self.columns])[:-1]
        for columns, part in zip(self.columns, np.split(solution, edges), strict=True):
            left -= columns @ part
        return solution, left, np.linalg.norm(Vt[rank:], axis=0) > NULL_SHARE
