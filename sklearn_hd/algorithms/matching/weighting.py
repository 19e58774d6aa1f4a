"""Weights of a matching error: constants by channel, and filters over frequency.

W_o(s) E(s) W_i(s),   W_o = F_o(s) diag(outputs),   W_i = diag(inputs) F_i(s)
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.hinf import check_stable
from sklearn_hd.algorithms.lti.structured_model import AffineStructure

__all__ = ["Weighting", "fixed_model", "in_series"]

_NOTHING = np.empty(0)  # the parameters of a fixed model


def fixed_model(A, B, C, D):
    """A state-space model as a structure without parameters."""
    stacked = np.block([[A, B], [C, D]])
    return AffineStructure(stacked, np.zeros((0, *stacked.shape)), len(A), ())


def in_series(first, second):
    """(A, B, C, D) of second(s) first(s): first feeds second."""
    A_1, B_1, C_1, D_1 = first
    A_2, B_2, C_2, D_2 = second
    A = np.block([[A_1, np.zeros((len(A_1), len(A_2)))], [B_2 @ C_1, A_2]])
    return A, np.vstack([B_1, B_2 @ D_1]), np.hstack([D_2 @ C_1, C_2]), D_2 @ D_1


@dataclass(frozen=True, eq=False)
class Weighting:
    """W_o and W_i.

    Attributes
    ----------
    outputs, inputs : ndarray, shapes (l,), (m,)
        Positive constants, next to E.
    output_filter, input_filter : AffineStructure or None
        F_o (l × l) and F_i (m × m), stable and without parameters.
    """

    outputs: np.ndarray
    inputs: np.ndarray
    output_filter: AffineStructure | None = None
    input_filter: AffineStructure | None = None

    @classmethod
    def build(cls, shape, outputs=None, inputs=None, output_filter=None, input_filter=None):
        """Weights for a response of some shape (l, m), after checking that they fit it."""
        filters = (
            _filter(given, size, name)
            for given, size, name in (
                (output_filter, shape[0], "output_filter"),
                (input_filter, shape[1], "input_filter"),
            )
        )
        constants = (
            _constants(outputs, shape[0], "output_weights"),
            _constants(inputs, shape[1], "input_weights"),
        )
        return cls(*constants, *filters)

    @property
    def poles(self):
        """Of the filters, rad/s."""
        filters = [each for each in (self.output_filter, self.input_filter) if each is not None]
        matrices = [each.matrices(_NOTHING)[0] for each in filters]
        return np.concatenate([_NOTHING, *(linalg.eigvals(A) for A in matrices if len(A))])

    def with_constants(self, outputs, inputs):
        """The same filters, other constants."""
        return replace(self, outputs=outputs, inputs=inputs)

    def apply(self, response, s):
        """W_o(s) E(s) W_i(s) for E of shape (n_points, l, m) or (n_points, l, m, k)."""
        constants = self.outputs[:, None] * self.inputs
        trailing = (1,) * (response.ndim - 3)
        weighted = response * constants.reshape(constants.shape + trailing)
        if self.output_filter is not None:
            gains = self.output_filter.response(_NOTHING, s)
            weighted = np.einsum("fpl,flm...->fpm...", gains, weighted)
        if self.input_filter is not None:
            gains = self.input_filter.response(_NOTHING, s)
            weighted = np.einsum("flm...,fmq->flq...", weighted, gains)
        return weighted

    def pull_back(self, left, right, s):
        """p, v for which pᴴ W_o E W_i v is that of left and right, (n_points, …, l) and (…, m)."""
        if self.output_filter is not None:
            gains = self.output_filter.response(_NOTHING, s)
            left = np.einsum("fpl,f...p->f...l", gains.conj(), left)
        if self.input_filter is not None:
            right = np.einsum("fmq,f...q->f...m", self.input_filter.response(_NOTHING, s), right)
        return self.outputs * left, self.inputs * right

    def realize(self, A, B, C, D):
        """State-space matrices of W_o G W_i."""
        outputs = self.outputs[:, None]
        weighted = A, B * self.inputs, outputs * C, outputs * D * self.inputs
        if self.input_filter is not None:
            weighted = in_series(self.input_filter.matrices(_NOTHING), weighted)
        if self.output_filter is not None:
            weighted = in_series(weighted, self.output_filter.matrices(_NOTHING))
        return weighted


def _constants(weights, size, name):
    weights = np.ones(size) if weights is None else np.asarray(weights, dtype=float)
    if weights.shape != (size,) or not (np.all(np.isfinite(weights)) and np.all(weights > 0)):
        raise ValueError(f"{name}={weights.tolist()} must be {size} positive numbers")
    return weights


def _filter(given, size, name):
    """A square stable filter as a structure without parameters; None if there is none."""
    if given is None:
        return None
    matrices = A, B, C, D = [np.asarray(matrix, dtype=float) for matrix in given]
    shapes, n = [matrix.shape for matrix in matrices], len(A)
    if shapes != [(n, n), (n, size), (size, n), (size, size)]:
        raise ValueError(
            f"{name} has matrices of shapes {shapes}, where a filter of {size} channels has "
            f"(n, n), (n, {size}), ({size}, n), ({size}, {size})"
        )
    check_stable(A, what=name)
    return fixed_model(A, B, C, D)
