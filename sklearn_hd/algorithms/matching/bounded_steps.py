"""Damped least-squares steps between bounds."""

import numpy as np
from scipy import linalg, optimize

from sklearn_hd.algorithms.lti.structured_model import column_sizes

_LEAST_DAMPING = 1e-14  # of a step that counts as free of damping
_WIDTH = 1e-300  # between a bound and a parameter on it: the routine wants an interval


class BoundedSteps:
    """Steps s that minimise |r + J s|² + damping |s|² subject to lower ≤ s ≤ upper.

    In |s|² columns of J count as if they had length one.

    Parameters
    ----------
    residual : ndarray, shape (n_rows,)
    jacobian : ndarray, shape (n_rows, k)
    lower, upper : ndarray, shape (k,)
        Infinite where there is no bound; zero lies between.

    Attributes
    ----------
    promised : float
        Decrease of |r + J s|² without damping.

    References
    ----------
    P. B. Stark and R. L. Parker, "Bounded-variable least-squares: an algorithm and
    applications", Computational Statistics 10 (1995), 129-141.

    Examples
    --------
    >>> steps = BoundedSteps(np.array([-2.0, -3.0]), np.eye(2), np.full(2, -1.0), np.ones(2))
    >>> step, decrease = steps.damped(0.0)
    >>> step.tolist(), float(decrease)
    ([1.0, 1.0], 8.0)
    """

    def __init__(self, residual, jacobian, lower, upper):
        self._size = column_sizes(jacobian)
        orthogonal, self._factor = linalg.qr(jacobian / self._size, mode="economic")
        self._target = -(orthogonal.T @ residual)
        lower, upper = np.minimum(lower, 0.0) * self._size, np.maximum(upper, 0.0) * self._size
        self._bounds = lower - _WIDTH * (lower == 0), upper + _WIDTH * (upper == 0)
        self.promised = self.damped(_LEAST_DAMPING)[1]

    def damped(self, damping):
        """Step and the decrease of |r + J s|² that it promises."""
        k = self._factor.shape[1]
        system = np.vstack([self._factor, np.sqrt(damping) * np.eye(k)])
        target = np.concatenate([self._target, np.zeros(k)])
        step = optimize.lsq_linear(system, target, self._bounds, method="bvls", tol=1e-14).x
        left = self._target - self._factor @ step
        return step / self._size, self._target @ self._target - left @ left
