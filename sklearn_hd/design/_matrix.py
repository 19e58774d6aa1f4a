"""A periodic matrix given by its samples: gains, costs to go, covariances."""

from dataclasses import dataclass, field

import numpy as np

from sklearn_hd._checks import check_count, real_array
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics


@dataclass(frozen=True, eq=False)
class PeriodicMatrix:
    """Matrix M(ψ) known at equal steps of one period.

        M(ψ) = M_0 + Σ_k (M_kc cos kψ + M_ks sin kψ)

    Called with azimuths ψ of shape (n_points,), it returns values (n_points, rows, columns): of
    the trigonometric polynomial through its samples or, with ``held``, of the latest sample. It
    can therefore be F, G, P or Q of an :class:`~sklearn_hd.systems.LTPSystem`.

    Parameters
    ----------
    values : ndarray, shape (p, rows, columns)
        M at ψ = 2πk / p.
    held : bool, default=False
        Whether a value holds until the next sample.

    References
    ----------
    S. Bittanti, P. Colaneri, *Periodic Systems: Filtering and Control*, 2009.

    Examples
    --------
    >>> psi = 2 * np.pi * np.arange(8) / 8
    >>> K = PeriodicMatrix(2.0 + np.cos(psi).reshape(8, 1, 1))
    >>> K.coefficients(1).ravel().round(12).tolist()
    [2.0, 1.0, 0.0]
    >>> K(np.array([np.pi])).ravel().round(12).tolist()
    [1.0]
    """

    values: np.ndarray = field(repr=False)
    held: bool = False

    def __post_init__(self):
        values = np.array(real_array("values", self.values, "samples (p, rows, columns)"))
        if values.ndim != 3 or not len(values):
            raise ValueError(f"values has shape {values.shape}; give samples (p, rows, columns)")
        values.flags.writeable = False
        object.__setattr__(self, "values", values)

    @property
    def azimuths(self):
        """Azimuths ψ of the samples, shape (p,), in radians."""
        return 2.0 * np.pi * np.arange(len(self.values)) / len(self.values)

    @property
    def max_harmonics(self):
        """Highest harmonic that p samples determine, the largest whole number below p / 2."""
        return (len(self.values) - 1) // 2

    def __call__(self, psi):
        """Values at azimuths psi, shape (n_points,) -> (n_points, rows, columns)."""
        psi = real_array("psi", psi, "azimuths in radians")
        p = len(self.values)
        if self.held:
            # rounding of ωt must not put a sample before its own azimuth
            return self.values[np.floor(psi * p / (2.0 * np.pi) + 1e-6).astype(int) % p]
        values = evaluate_harmonics(self.coefficients(self.max_harmonics), psi)
        if p % 2 == 0:  # the harmonic p / 2, of which samples show the cosine alone
            alternating = np.mean(self.values * (-1.0) ** np.arange(p)[:, None, None], axis=0)
            values = values + np.cos(p / 2 * psi)[..., None, None] * alternating
        return values

    def coefficients(self, n_harmonics):
        """Real Fourier coefficients up to some harmonic.

        Parameters
        ----------
        n_harmonics : int
            N, at most ``max_harmonics``.

        Returns
        -------
        coefficients : ndarray, shape (2 N + 1, rows, columns)
            In the order 0, 1c, 1s, …, of the samples.

        Raises
        ------
        ValueError
            If ``n_harmonics`` is negative, not whole or more than the samples determine.
        """
        N = check_count("n_harmonics", n_harmonics, 0, "0 keeps the mean alone")
        if self.max_harmonics < N:
            raise ValueError(
                f"n_harmonics={N} is more than the {len(self.values)} samples of a period "
                f"determine; give {self.max_harmonics} at most"
            )
        return sampled_harmonics(self.values, N)

    def truncated(self, n_harmonics):
        """The matrix of only the first harmonics, at the same samples.

        Parameters
        ----------
        n_harmonics : int
            N, at most ``max_harmonics``; 0 keeps the mean.

        Returns
        -------
        matrix : PeriodicMatrix
            With as many samples.

        Raises
        ------
        ValueError
            As for :meth:`coefficients`.
        """
        kept = evaluate_harmonics(self.coefficients(n_harmonics), self.azimuths)
        return PeriodicMatrix(kept, self.held)
