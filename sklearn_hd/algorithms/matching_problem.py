"""A structured matching problem: weights, frequency grid, error response and its norm.

    E(s; θ) = W_o (G_c(s) − G_s(s; θ)) W_i

Two scalings live side by side. The criterion's W_o, W_i are the user's, and the norm is
counted in units of ‖W_o G_c W_i‖_∞. Least squares over the grid uses its own, which make
all channels of G_c alike, so that a search is not blind to small ones.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.hinf import hinf_norm
from sklearn_hd.algorithms.structured_model import AffineStructure, column_sizes

__all__ = ["MatchingProblem", "channel_scales", "matching_grid"]

_POINTS_PER_SWEEP = 70  # of the logarithmic grid
_MARGIN = 30.0  # how far the grid reaches past the slowest and the fastest pole
_ZERO_CHANNEL = 1e-6  # rms, relative to the largest, to which a smaller channel is lifted
_ROUNDING = 1e-13  # of a pole, relative to the largest
_RANK = 1e-10  # singular value, relative to the largest, that counts as zero; regular
# structures were seen at 5e-3 and above, deficient ones at 2e-15 and below


def channel_scales(response):
    """Factors of outputs and inputs that make a response's channels equally large.

    Rows and columns are brought in turn to the same root mean square over frequency
    (Sinkhorn's iteration on the squared sizes).

    Parameters
    ----------
    response : complex ndarray, shape (n_points, l, m)

    Returns
    -------
    output_scales : ndarray, shape (l,)
    input_scales : ndarray, shape (m,)
        diag(output_scales) G diag(input_scales) has channels of equal size. A channel
        that is (nearly) zero is counted as 1e-6 of the largest.

    Examples
    --------
    >>> outputs, inputs = channel_scales(np.array([[[1.0], [1000.0]]]))
    >>> round(float(outputs[0] / outputs[1]), 9)
    1000.0
    """
    energy = np.mean(np.abs(response) ** 2, axis=0)
    least = max(_ZERO_CHANNEL**2 * energy.max(initial=0.0), 1e-300)
    energy[energy.mean(axis=1) < least] = least
    energy[:, energy.mean(axis=0) < least] = least
    outputs, inputs = np.ones(energy.shape[0]), np.ones(energy.shape[1])
    for _ in range(10):
        outputs /= np.sqrt(np.mean(outputs[:, None] ** 2 * energy * inputs**2, axis=1))
        inputs /= np.sqrt(np.mean(outputs[:, None] ** 2 * energy * inputs**2, axis=0))
    return outputs, inputs


def matching_grid(poles):
    """Frequencies (rad/s) that resolve the response of a model with given poles.

    0, a logarithmic sweep past the slowest and the fastest pole, a cluster as wide as
    the resonance at each lightly damped pole, and infinity.
    """
    size = np.abs(poles)
    size = size[size > 0]
    low, high = (size.min(), size.max()) if len(size) else (1.0, 1.0)
    sweep = np.geomspace(low / _MARGIN, high * _MARGIN, _POINTS_PER_SWEEP)
    resonant = poles[(poles.imag > 0) & (np.abs(poles.real) < 0.7 * np.abs(poles))]
    spread = np.tan(np.linspace(-1.3, 1.3, 11))
    clusters = (resonant.imag[:, None] + np.abs(resonant.real[:, None]) * spread).ravel()
    return np.unique(np.concatenate([[0.0], sweep, clusters[clusters > 0], [np.inf]]))


@dataclass(frozen=True, eq=False)
class MatchingProblem:
    """One model, one structure, one weighted norm.

    Attributes
    ----------
    model : AffineStructure
        G_c, as a structure without parameters.
    structure : AffineStructure
        G_s(θ).
    output_weights, input_weights : ndarray, shapes (l,), (m,)
        The criterion's, with 1 / ``criterion_unit`` in the output weights.
    criterion_unit : float
        ‖W_o G_c W_i‖_∞ with the weights as they were given.
    grid : ndarray, shape (n_points,)
        rad/s.
    output_scales, input_scales : ndarray, shapes (l,), (m,)
        Of the least squares; G_c has length 1 in them on the imaginary axis.
    """

    model: AffineStructure
    structure: AffineStructure
    output_weights: np.ndarray
    input_weights: np.ndarray
    criterion_unit: float
    grid: np.ndarray
    output_scales: np.ndarray
    input_scales: np.ndarray

    @classmethod
    def build(cls, A, B, C, D, structure, output_weights=None, input_weights=None):
        """Problem for G_c = (A, B, C, D); raises where the parts do not fit."""
        A, B, C, D = (np.asarray(matrix, dtype=float) for matrix in (A, B, C, D))
        unit = hinf_norm(A, B, C, D)[0]  # checks shapes and stability, in its own words
        _check_fit(D.shape, structure)
        outputs = _weights(output_weights, len(D), "output_weights")
        inputs = _weights(input_weights, D.shape[1], "input_weights")
        unit = hinf_norm(A, B * inputs, outputs[:, None] * C, outputs[:, None] * D * inputs)[0]
        stacked = np.block([[A, B], [C, D]])
        model = AffineStructure(stacked, np.zeros((0, *stacked.shape)), len(A), ())
        grid = matching_grid(linalg.eigvals(A) if len(A) else np.empty(0))
        response = model.response(np.empty(0), line(grid))
        output_scales, input_scales = channel_scales(response)
        length = np.linalg.norm(output_scales[:, None] * response * input_scales)
        unit, length = unit or 1.0, length or 1.0
        output_scales = output_scales / length
        return cls(
            model, structure, outputs / unit, inputs, unit, grid, output_scales, input_scales
        )

    @property
    def fastest(self):
        """Largest magnitude among the poles of G_c (rad/s)."""
        return self.grid[-2] / _MARGIN

    def peak(self, theta):
        """Exact relative norm of the error and its frequency; (inf, nan) if G_s is unstable."""
        if self.abscissa(theta) >= 0:
            return np.inf, np.nan
        A, B, C, D = self.structure.matrices(theta)
        A_c, B_c, C_c, D_c = self.model.matrices(np.empty(0))
        outputs = self.output_weights[:, None]
        return hinf_norm(
            linalg.block_diag(A_c, A) if len(A_c) and len(A) else (A_c if len(A_c) else A),
            np.vstack([B_c, B]) * self.input_weights,
            outputs * np.hstack([C_c, -C]),
            outputs * (D_c - D) * self.input_weights,
        )

    def abscissa(self, theta):
        """Largest real part among the poles of G_s(θ), plus what rounding may hide of it."""
        A = self.structure.matrices(theta)[0]
        if len(A) == 0:
            return -np.inf
        poles = linalg.eigvals(A)
        return poles.real.max() + _ROUNDING * np.abs(poles).max()

    def error_and_sensitivity(self, theta, frequencies):
        """E(jω; θ) and ∂E/∂θ in the criterion's weights and unit."""
        return self._difference(theta, line(frequencies), self.output_weights, self.input_weights)

    def error_curvature(self, theta, frequencies, left_vectors, right_vectors):
        """Σ_i Re(p_iᴴ ∂²E(jω_i)/∂θ² v_i), shape (k, k), in the criterion's weights."""
        return -self.structure.curvature(
            theta,
            line(frequencies),
            self.output_weights * left_vectors,
            self.input_weights * right_vectors,
        )

    def residual_and_jacobian(self, theta, shift=0.0):
        """Least-squares residual over the grid on the line Re s = shift, and ∂/∂θ, as reals."""
        s = line(self.grid, shift)
        error, slope = self._difference(theta, s, self.output_scales, self.input_scales)
        error, slope = error.ravel(), slope.reshape(error.size, -1)
        return np.concatenate([error.real, error.imag]), np.vstack([slope.real, slope.imag])

    def _difference(self, theta, s, outputs, inputs):
        weights = outputs[:, None] * inputs
        response, slope = self.structure.response_and_sensitivity(theta, s)
        error = self.model.response(np.empty(0), s) - response
        return weights * error, -weights[..., None] * slope

    def gains(self, theta, frequencies):
        """σ_max(E(jω; θ)), shape of the frequencies."""
        frequencies = np.asarray(frequencies)
        s = line(frequencies.ravel())
        error = self.model.response(np.empty(0), s) - self.structure.response(theta, s)
        error = self.output_weights[:, None] * error * self.input_weights
        return np.linalg.norm(error, 2, axis=(1, 2)).reshape(frequencies.shape)

    def active_frequencies(self, theta, value, extra=()):
        """Frequencies where the gain of E is within a factor 2 of F, local peaks resolved."""
        gains = self.gains(theta, self.grid)
        padded = np.concatenate([[-np.inf], gains, [-np.inf]])
        tops = np.flatnonzero((gains >= padded[:-2]) & (gains >= padded[2:]))
        low = self.grid[np.maximum(tops - 1, 0)]
        high = self.grid[np.minimum(tops + 1, len(self.grid) - 1)]
        high = np.where(np.isfinite(high), high, 10.0 * self.grid[-2])
        low = np.minimum(low, high)
        for _ in range(3):
            points = np.linspace(low, high, 9, axis=1)
            best = np.argmax(self.gains(theta, points), axis=1)
            rows = np.arange(len(points))
            low, high = points[rows, np.maximum(best - 1, 0)], points[rows, np.minimum(best + 1, 8)]
        peaks = np.concatenate([points[rows, best], low, high])
        near = self.grid[gains >= 0.5 * value]
        return np.unique(np.concatenate([near, peaks, extra]))

    def orthonormal_directions(self, theta):
        """M of θ → θ + M ζ: a unit ζ moves the response as far as the residual is long."""
        residual, jacobian = self.residual_and_jacobian(theta)
        size = column_sizes(jacobian)
        _, singular, adjoint = linalg.svd(jacobian / size, full_matrices=False)
        kept = singular > _RANK * singular.max(initial=0.0)
        return (adjoint[kept] / singular[kept, None]).T / size[:, None] * linalg.norm(residual)

    def identifiability(self, theta):
        """Singular values of the sensitivity (columns of length one), and undetermined names."""
        jacobian = self.residual_and_jacobian(theta)[1]
        if jacobian.shape[1] == 0:
            return np.empty(0), ()
        _, singular, adjoint = linalg.svd(jacobian / column_sizes(jacobian))
        singular = np.pad(singular, (0, len(adjoint) - len(singular)))
        null = adjoint[singular <= _RANK * max(singular.max(), 1e-300)]
        undetermined = np.flatnonzero(np.any(np.abs(null) > 1e-3, axis=0))
        return singular, tuple(self.structure.parameter_names[k] for k in undetermined)

    def feedthrough_floor(self):
        """Lower bound of the relative norm that fixed entries of D_s leave at ω = ∞."""
        n = self.structure.n_states
        gap = self.model.constant[self.model.n_states :, self.model.n_states :]
        gap = gap - self.structure.constant[n:, n:]
        gap = self.output_weights[:, None] * gap * self.input_weights
        free = np.any(self.structure.basis[:, n:, n:] != 0, axis=0)
        if not free.any():
            return float(linalg.norm(gap, 2))
        return float(np.abs(gap[~free]).max(initial=0.0))


def line(frequencies, shift=0.0):
    """s = shift + jω; at ω = ∞ a complex infinity (1j * inf would hold a NaN)."""
    s = np.full(np.shape(frequencies), shift, dtype=complex)
    s.imag = frequencies
    return s


def _check_fit(shape, structure):
    """Raise unless the structure has the model's inputs and outputs."""
    if shape != (structure.n_outputs, structure.n_inputs):
        raise ValueError(
            f"the structure has {structure.n_outputs} outputs and {structure.n_inputs} inputs, "
            f"the model {shape[0]} and {shape[1]}; a match compares the same channels, so give "
            f"the structure the rows of C and D and the columns of B and D that the model has"
        )


def _weights(weights, size, name):
    weights = np.ones(size) if weights is None else np.asarray(weights, dtype=float)
    if weights.shape != (size,) or not (np.all(np.isfinite(weights)) and np.all(weights > 0)):
        raise ValueError(f"{name}={weights.tolist()} must be {size} positive numbers")
    return weights
