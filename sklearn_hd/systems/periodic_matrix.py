"""Periodic matrices: callables of azimuth, and Fourier series among them."""

import numpy as np

from sklearn_hd._checks import real_array
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.periodic.harmonic_decomposition import fourier_coefficients

__all__ = ["FourierMatrix"]


class FourierMatrix:
    """Periodic matrix M(ψ) = M_0 + Σ_k (M_kc cos kψ + M_ks sin kψ).

    Parameters
    ----------
    coefficients : array_like, shape (2 K + 1, rows, columns)
        Real coefficients in the order 0, 1c, 1s, ….

    Raises
    ------
    ValueError
        If the coefficients are of another shape, or not finite.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 9.

    Examples
    --------
    >>> M = FourierMatrix(np.array([1.0, 0.5, 0.0]).reshape(3, 1, 1))
    >>> M(np.array([0.0, np.pi])).ravel().tolist()
    [1.5, 0.5]
    >>> M.n_harmonics
    1
    """

    def __init__(self, coefficients):
        wanted = "an array of shape (2 K + 1, rows, columns) in the order 0, 1c, 1s, …"
        self.coefficients = np.array(real_array("coefficients", coefficients, wanted))
        if self.coefficients.ndim != 3 or len(self.coefficients) % 2 == 0:
            raise ValueError(
                f"Fourier coefficients have shape {self.coefficients.shape}; give {wanted}"
            )

    @property
    def n_harmonics(self):
        """K, the highest harmonic."""
        return len(self.coefficients) // 2

    def __call__(self, psi):
        """Values at azimuths psi, shape (n_points,) -> (n_points, rows, columns)."""
        return evaluate_harmonics(self.coefficients, psi)

    def __repr__(self):
        return f"FourierMatrix(shape={self.coefficients.shape})"


def periodic_matrix(matrix, name):
    """Callable of ψ and the shape of its value."""
    if not callable(matrix):
        wanted = (
            "a matrix (rows, columns), Fourier coefficients (2 K + 1, rows, columns), or a "
            "callable of psi"
        )
        values = real_array(name, matrix, wanted)
        if values.ndim not in (2, 3):
            raise ValueError(f"{name} has shape {values.shape}; give {wanted}")
        matrix = FourierMatrix(values[None] if values.ndim == 2 else values)
    shape = np.shape(matrix(np.zeros(2)))
    if len(shape) != 3 or shape[0] != 2:
        raise ValueError(
            f"{name} returned an array of shape {shape} for two azimuths; a callable of psi with "
            f"shape (n_points,) must return (n_points, rows, columns)"
        )
    return matrix, shape[1:]


def matrix_coefficients(matrix, n_harmonics):
    if isinstance(matrix, FourierMatrix):
        return resize_harmonics(matrix.coefficients, n_harmonics)
    tolerance = max(1e-13, precision(matrix))
    return fourier_coefficients(matrix, n_harmonics, tolerance=tolerance)


def precision(*matrices):
    """Relative error of the values themselves, where a matrix states it (differences do)."""
    return max(getattr(matrix, "precision", 0.0) for matrix in matrices)


def measure(matrix, signals, psi):
    """M(ψ_k) s_k for each sample, the samples taken in blocks."""
    if isinstance(matrix, FourierMatrix) and len(matrix.coefficients) == 1:
        return signals @ matrix.coefficients[0].T
    blocks = [
        np.einsum("kij,...kj->...ki", matrix(psi[k : k + 4096]), signals[..., k : k + 4096, :])
        for k in range(0, len(psi), 4096)
    ]
    return np.concatenate(blocks, axis=-2)
