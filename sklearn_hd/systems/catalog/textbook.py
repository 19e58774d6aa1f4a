"""Linear time-periodic systems whose Floquet exponents are known in closed form."""

import numpy as np

from sklearn_hd.systems.ltp import LTPSystem

__all__ = ["bittanti_colaneri", "vinograd"]


def bittanti_colaneri():
    """Triangular system whose exponents are the means of its diagonal.

        ẋ = [[−1 + sin t, 0], [1 − cos t, −3]] x + [1, 1]ᵀ u

    The Floquet exponents are −1 and −3. The outputs are both states.

    Returns
    -------
    system : LTPSystem
        Of period 2π s.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, Springer,
    2009, chapter 1. The input is an addition of this package.

    Examples
    --------
    >>> bittanti_colaneri().floquet_exponents().real.round(12).tolist()
    [-1.0, -3.0]
    """
    F = np.zeros((3, 2, 2))
    F[0] = [[-1.0, 0.0], [1.0, -3.0]]
    F[1, 1, 0] = -1.0
    F[2, 0, 0] = 1.0
    return LTPSystem(F, [[1.0], [1.0]], omega=1.0)


def vinograd():
    """Unstable system whose matrix has the eigenvalues −1 and −10 at every instant.

        ẋ = [[−1 − 9c² + 12sc, 12c² + 9sc], [−12s² + 9sc, −1 − 9s² − 12sc]] x + [1, 1]ᵀ u

    with c = cos 6t and s = sin 6t. The Floquet exponents are +2 and −13: the
    eigenvalues of the frozen matrix tell nothing. The outputs are both states.

    Returns
    -------
    system : LTPSystem
        With omega = 6 rad/s, the frequency of c and s. The matrix repeats after
        half of that period already, over which both multipliers are negative.

    References
    ----------
    R. E. Vinograd, "On a criterion of instability in the sense of Lyapunov of the
    solutions of a linear system of ordinary differential equations", Doklady
    Akademii Nauk SSSR 84 (1952), 201–204. The input is an addition of this package.

    Examples
    --------
    >>> system = vinograd()
    >>> np.linalg.eigvals(system.F(np.array([0.7]))[0]).real.round(9).tolist()
    [-1.0, -10.0]
    >>> system.floquet_exponents().real.round(9).tolist()
    [2.0, -13.0]
    """
    F = np.zeros((5, 2, 2))  # c² = (1 + cos 12t) / 2, s² = (1 − cos 12t) / 2, sc = sin 12t / 2
    F[0] = [[-5.5, 6.0], [-6.0, -5.5]]
    F[3] = [[-4.5, 6.0], [6.0, 4.5]]
    F[4] = [[6.0, 4.5], [4.5, -6.0]]
    return LTPSystem(F, [[1.0], [1.0]], omega=6.0)
