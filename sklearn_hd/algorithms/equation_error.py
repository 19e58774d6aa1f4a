"""State matrix of a periodic system whose states are measured, by linear least squares.

    x[k+m] − x[k] = ∫ F(ψ) x + G(ψ) u dt,   F, G of a few harmonics

(the equation-error method; V. Klein, E. A. Morelli, *Aircraft System Identification*, 2006,
chapter 5). Noise of x enters the regressors, too: by the trapezoidal rule the noise of an
interval's two ends drops out of the first order of the bias, which leaves noise² / signal².
A start for maximum likelihood, where a period forgets the state and noise hides what is left.
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.fourier import harmonic_functions
from sklearn_hd.algorithms.structured_model import column_sizes

__all__ = ["equation_error"]

INTERVALS = 8  # a period: longer ones have more signal, shorter ones a finer rule


def equation_error(segments, period, n_phases, n_harmonics):
    """Fourier coefficients of F(ψ) and G(ψ) from measured states.

    Parameters
    ----------
    segments : list of (states, inputs, first_phase)
        (n_samples, n), (n_samples, m), held, and the first sample's phase in samples.
    period : float
        Seconds.
    n_phases : int
        Samples a period.
    n_harmonics : int
        Highest harmonic of F and G.

    Returns
    -------
    F : ndarray, shape (2 n_harmonics + 1, n, n)
    G : ndarray, shape (2 n_harmonics + 1, n, m)

    Examples
    --------
    >>> x, t = np.exp(-0.5 * np.arange(0, 8, 0.01))[:, None], None
    >>> F, _ = equation_error([(x, np.zeros((800, 0)), 0)], 1.0, 100, 0)
    >>> F.round(3).tolist()
    [[[-0.5]]]
    """
    m, step = max(1, n_phases // INTERVALS), period / n_phases
    left, right = [], []
    for x, u, first in segments:
        psi = 2.0 * np.pi / n_phases * (first + np.arange(len(x)))
        functions = harmonic_functions(psi, range(n_harmonics + 1))[:, :, None]
        states = (functions * x[:, None, :]).reshape(len(x), -1)
        inputs = (functions * u[:, None, :]).reshape(len(x), -1)
        ahead = (np.roll(functions, -1, axis=0) * u[:, None, :]).reshape(len(x), -1)
        rates = [0.5 * (states[1:] + states[:-1]), 0.5 * (inputs[:-1] + ahead[:-1])]
        integral = step * np.cumsum(np.hstack(rates), axis=0)
        integral = np.vstack([np.zeros(integral.shape[1]), integral])
        left.append(integral[m:] - integral[:-m])
        right.append(x[m:] - x[:-m])
    regressors, target = np.vstack(left), np.vstack(right)
    size = column_sizes(regressors)
    solution = linalg.lstsq(regressors / size, target, cond=1e-9)[0] / size[:, None]
    n, count = target.shape[1], 2 * n_harmonics + 1
    F = solution[: count * n].reshape(count, n, n).transpose(0, 2, 1)
    return F, solution[count * n :].reshape(count, -1, n).transpose(0, 2, 1)
