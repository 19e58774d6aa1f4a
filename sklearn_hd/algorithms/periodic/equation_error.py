"""State matrix of a periodic system whose states are measured, by linear least squares.

    x[k+m] − x[k] = ∫ F(ψ) x + G(ψ) u dt,   F, G of a few harmonics

(the equation-error method; V. Klein, E. A. Morelli, *Aircraft System Identification*, 2006,
chapter 5). Noise of x enters the regressors, too, and biases least squares; states almost
free of noise as instruments take the bias away (T. Söderström, P. Stoica, *System
Identification*, 1989, chapter 8). A start for maximum likelihood where a period forgets the
state and noise hides what is left.
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.structured_model import column_sizes
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

__all__ = ["equation_error"]

INTERVALS = 8  # a period: longer ones have more signal, shorter ones a finer rule


def equation_error(segments, period, n_phases, n_harmonics, instruments=None):
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
    instruments : list of ndarray, shapes (n_samples, n), optional
        States of less noise, of every segment; the measured ones by default.

    Returns
    -------
    F : ndarray, shape (2 n_harmonics + 1, n, n)
    G : ndarray, shape (2 n_harmonics + 1, n, m)

    Examples
    --------
    >>> x = np.exp(-0.5 * np.arange(0, 8, 0.01))[:, None]
    >>> F, _ = equation_error([(x, np.zeros((800, 0)), 0)], 1.0, 100, 0)
    >>> F.round(3).tolist()
    [[[-0.5]]]
    """
    m, step = max(1, n_phases // INTERVALS), period / n_phases
    shown = [x for x, _, _ in segments] if instruments is None else instruments
    X, Z, target = [], [], []
    for (x, u, first), z in zip(segments, shown, strict=True):
        functions = harmonic_functions(
            2.0 * np.pi / n_phases * (first + np.arange(len(x))), range(n_harmonics + 1)
        )
        X.append(step * _integrals(functions, x, u, m))
        Z.append(step * _integrals(functions, z, u, m))
        target.append(x[m:] - x[:-m])
    X, Z, target = map(np.vstack, (X, Z, target))
    size = column_sizes(Z)
    Q = linalg.qr(Z / size, mode="economic")[0]
    solution = linalg.lstsq(Q.T @ X / size, Q.T @ target, cond=1e-9)[0] / size[:, None]
    n, count = target.shape[1], 2 * n_harmonics + 1
    F = solution[: count * n].reshape(count, n, n).transpose(0, 2, 1)
    return F, solution[count * n :].reshape(count, -1, n).transpose(0, 2, 1)


def _integrals(functions, x, u, m):
    """Of harmonics times states and held inputs, over m samples, in samples."""

    def products(values, functions):
        return (functions[:, :, None] * values[:, None, :]).reshape(len(values), -1)

    ends = products(x, functions)
    held = products(u[:-1], functions[:-1]) + products(u[:-1], functions[1:])
    rates = 0.5 * np.hstack([ends[1:] + ends[:-1], held])
    sums = np.vstack([np.zeros(rates.shape[1]), np.cumsum(rates, axis=0)])
    return sums[m:] - sums[:-m]
