"""What one period makes of states and of inputs held over it."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

__all__ = ["PeriodMap", "quadratic_gain"]


@dataclass(frozen=True)
class PeriodMap:
    """Period to period, with the outputs' means on the way.

        x_{k+1} = Φ x_k + Γ u_k,   ȳ_k = M x_k + N u_k

    Parameters
    ----------
    Phi, Gamma : ndarray, shapes (n, n) and (n, m)
        From the state at the beginning of a period to the next.
    M, N : ndarray, shapes (l, n) and (l, m)
        To the mean of the outputs over the period.

    Examples
    --------
    >>> plant = PeriodMap(*np.array([[[1.2]], [[1.0]], [[1.0]], [[0.0]]]))
    >>> plant.closed_loop(np.array([[0.4]])).round(1).tolist()
    [[1.2, -0.4], [1.0, 0.0]]
    """

    Phi: np.ndarray
    Gamma: np.ndarray
    M: np.ndarray
    N: np.ndarray

    def closed_loop(self, K):
        """Map of (x_k, ȳ_{k−1}) under u_k = −K ȳ_{k−1}.

        Parameters
        ----------
        K : ndarray, shape (m, l)
            Gain.

        Returns
        -------
        closed : ndarray, shape (n + l, n + l)
            Stable if its eigenvalues lie within the unit circle.
        """
        return np.block([[self.Phi, -self.Gamma @ K], [self.M, -self.N @ K]])


def quadratic_gain(plant, state_sizes, input_sizes):
    """Gain K of u_k = −K x_k that is best for the sum of squares of x and u, over their sizes.

    Parameters
    ----------
    plant : PeriodMap
        Or anything with Phi and Gamma.
    state_sizes, input_sizes : array_like, shapes (n,) and (m,)
        Departures that count alike (Bryson's rule).

    Returns
    -------
    K : ndarray, shape (m, n)
        From the stabilising solution of the discrete algebraic Riccati equation.

    Raises
    ------
    ValueError
        If no gain stabilises, as where an unstable mode is out of the inputs' reach.

    References
    ----------
    A. E. Bryson, Y.-C. Ho, *Applied Optimal Control*, 1975.

    Examples
    --------
    >>> plant = PeriodMap(*np.array([[[1.2]], [[1.0]], [[1.0]], [[0.0]]]))
    >>> K = quadratic_gain(plant, [1.0], [0.01])  # dear inputs: the pole goes to 1 / 1.2
    >>> print(f"{1.2 - K[0, 0]:.2f}")
    0.83
    """
    Q = np.diag(np.asarray(state_sizes, dtype=float) ** -2.0)
    R = np.diag(np.asarray(input_sizes, dtype=float) ** -2.0)
    try:
        P = linalg.solve_discrete_are(plant.Phi, plant.Gamma, Q, R)
    except ValueError as error:  # LinAlgError, or pencils too ill-conditioned to be ordered
        raise ValueError(
            f"no gain stabilises the period map ({error}); an unstable mode may be out of reach "
            f"of the inputs"
        ) from error
    return linalg.solve(R + plant.Gamma.T @ P @ plant.Gamma, plant.Gamma.T @ P @ plant.Phi)
