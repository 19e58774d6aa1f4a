"""A structured matching problem: weights, frequency grid, error response and its norm.

    E(s; θ) = W_o (G_c(s) − G_s(s; θ)) W_i,   lower ≤ θ ≤ upper,   W_o, W_i diagonal

Two weightings live side by side. The criterion's W_o, W_i are the user's, and the norm is
counted in units of ‖W_o G_c W_i‖_∞. Least squares over the grid has constants of its own
that make all channels alike, so that a search is not blind to small ones. Starts, the
least-squares matches and the descent in the norm all ask this one value.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EXACT, RANK, UNKNOWN
from sklearn_hd.algorithms.linalg.triangular import column_sizes, triangle
from sklearn_hd.algorithms.lti.hinf import hinf_norm, refine_peaks
from sklearn_hd.algorithms.lti.structured_model import AffineStructure
from sklearn_hd.exceptions import UnstableModelError

_MARGIN = 30.0  # how far the grid reaches past the slowest and the fastest pole
_ZERO_CHANNEL = 1e-6  # rms, relative to the largest, to which a smaller channel is lifted
_RIVAL = 0.9  # gain on the grid, relative to the norm, of a peak that may be the highest
_FARTHEST = 30.0  # sizes of a parameter, or of the residual, that a unit step moves at most
_OWN = 10.0  # times the fastest pole of G_s to begin with


def channel_scales(response):
    """Factors of outputs and inputs that make a response's channels equally large.

    Of a response (n_points, l, m). Rows and columns are brought in turn to the same root mean
    square over frequency (Sinkhorn's iteration on the squared sizes).

    diag(output_scales) G diag(input_scales) then has channels of equal size. A channel
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
    sweep = np.geomspace(low / _MARGIN, high * _MARGIN, 70)  # of the logarithmic grid
    resonant = poles[(poles.imag > 0) & (np.abs(poles.real) < 0.7 * np.abs(poles))]
    spread = np.tan(np.linspace(-1.3, 1.3, 11))
    clusters = (resonant.imag[:, None] + np.abs(resonant.real[:, None]) * spread).ravel()
    return np.unique(np.concatenate([[0.0], sweep, clusters[clusters > 0], [np.inf]]))


@dataclass(frozen=True, eq=False)
class MatchingProblem:
    """One model, one structure, one weighted norm."""

    model: AffineStructure  # g_c, as a structure without parameters
    structure: AffineStructure  # g_s(θ)
    outputs: np.ndarray  # (l,): diagonal of the criterion's W_o / ``unit``
    inputs: np.ndarray  # (m,): diagonal of its W_i
    unit: float  # ‖W_o G_c W_i‖_∞ with the weights as they were given
    grid: np.ndarray  # (n_points,): rad/s
    # (l,): the same of the least squares; G_c has length 1 in them on the imaginary axis
    output_scales: np.ndarray
    input_scales: np.ndarray  # (m,): as the outputs'
    lower: np.ndarray  # (k,): bound of θ; infinite where there is none
    upper: np.ndarray  # (k,): the same
    speed_limit: float = np.inf  # rad/s; G_s with faster poles counts as unstable

    @classmethod
    def build(cls, A, B, C, D, structure, weights=(None, None), bounds=None, emphasis=None):
        """Problem for G_c = (A, B, C, D), stable."""
        A, B, C, D = (np.asarray(matrix, dtype=float) for matrix in (A, B, C, D))
        hinf_norm(A, B, C, D)  # checks shapes and stability, in its own words
        W_o, W_i = (
            np.ones(size) if given is None else np.asarray(given, dtype=float)
            for given, size in zip(weights, D.shape, strict=True)
        )
        unit = hinf_norm(A, B * W_i, W_o[:, None] * C, W_o[:, None] * D * W_i)[0] or 1.0
        model = AffineStructure.fixed(A, B, C, D)
        grid = matching_grid(linalg.eigvals(A) if len(A) else np.empty(0))
        response = model.response(np.empty(0), line(grid))
        outputs, inputs = channel_scales(response)
        if emphasis is not None:
            outputs, inputs = outputs * emphasis[0], inputs * emphasis[1]
        length = np.linalg.norm(outputs[:, None] * response * inputs) or 1.0
        scales = outputs / length, inputs
        wide = np.full(structure.n_parameters, np.inf)
        lower, upper = (-wide, wide) if bounds is None else bounds
        return cls(model, structure, W_o / unit, W_i, unit, grid, *scales, lower, upper)

    @property
    def fastest(self):
        """Largest magnitude among the poles of G_c (rad/s)."""
        return np.abs(self.model.poles(np.empty(0))).max(initial=0.0) or 1.0

    def limited(self, theta, factor):
        """The same with a limit to poles: so many times the fastest of G_c.

        Where the best match has a feedthrough that D_s excludes, a pole runs to infinity, and
        rounding in it would hide the stability of the others. Fast poles of G_s(θ) raise
        the limit.
        """
        own = np.abs(self.structure.poles(theta)).max(initial=0.0)
        return replace(self, speed_limit=max(factor * self.fastest, _OWN * own))

    def inside(self, theta):
        """The parameters nearest to θ within the bounds."""
        return np.clip(theta, self.lower, self.upper)

    @property
    def bounded(self):
        return bool(np.any(np.isfinite(self.lower)) or np.any(np.isfinite(self.upper)))

    def error_model(self, theta):
        """State-space matrices of W_o (G_c − G_s(θ)) W_i, in units of the criterion."""
        A, B, C, D = self.structure.matrices(theta)
        A_c, B_c, C_c, D_c = self.model.matrices(np.empty(0))
        drive, seen = np.vstack([B_c, B]), np.hstack([C_c, -C])
        outputs = self.outputs[:, None]
        direct = outputs * (D_c - D) * self.inputs
        return linalg.block_diag(A_c, A), drive * self.inputs, outputs * seen, direct

    def peak(self, theta):
        """Exact relative norm of the error and its frequency; (inf, nan) if G_s is unstable.

        The same where G_s is so far off that the norm cannot be computed.
        """
        if self.abscissa(theta) >= 0:
            return np.inf, np.nan
        try:
            value, peak = hinf_norm(*self.error_model(theta))
        except (ArithmeticError, UnstableModelError):  # a pole that rounding moves across
            return np.inf, np.nan
        gains = self.gains(theta, self.grid)
        low, high = self._brackets(gains, _RIVAL * value)
        if len(low) == 0:
            return value, peak
        frequencies, values = refine_peaks(lambda w: self.gains(theta, w), low, high)
        frequencies, values = np.append(frequencies, np.inf), np.append(values, gains[-1])
        if np.isfinite(peak):
            frequencies = np.append(frequencies, peak)
            values = np.append(values, self.gains(theta, [peak]))
        best = np.argmax(values)
        return float(values[best]), float(frequencies[best])

    def abscissa(self, theta):
        """Largest real part among the poles of G_s(θ), plus what rounding may hide of it.

        Infinite beyond the speed limit.
        """
        poles = self.structure.poles(theta)
        if len(poles) == 0:
            return -np.inf
        fastest = np.abs(poles).max()
        return poles.real.max() + EXACT * fastest if fastest <= self.speed_limit else np.inf

    def error_and_sensitivity(self, theta, frequencies):
        """E(jω; θ) and ∂E/∂θ in the criterion's weights and unit."""
        return self._difference(theta, line(frequencies), self.outputs[:, None] * self.inputs)

    def error_curvature(self, theta, frequencies, left_vectors, right_vectors):
        """Σ_i Re(p_iᴴ ∂²E(jω_i)/∂θ² v_i), shape (k, k), in the criterion's weights."""
        vectors = self.outputs * left_vectors, self.inputs * right_vectors
        return -self.structure.curvature(theta, line(frequencies), *vectors)

    def residual_and_jacobian(self, theta, shift=0.0):
        """Least-squares residual over the grid on the line Re s = shift, and ∂/∂θ, as reals."""
        scales = self.output_scales[:, None] * self.input_scales
        return _as_reals(*self._difference(theta, line(self.grid, shift), scales))

    def _difference(self, theta, s, weights):
        response, slope = self.structure.response_and_sensitivity(theta, s)
        return (self._given(s) - response) * weights, -slope * weights[..., None]

    def _given(self, s):
        """G_c(s), remembered for a few arrays of points."""
        return _remembered_response(self.model, s.tobytes())

    def gains(self, theta, frequencies):
        """σ_max(E(jω; θ)), shape of the frequencies."""
        frequencies = np.asarray(frequencies)
        return self.singular_values(theta, frequencies.ravel())[:, 0].reshape(frequencies.shape)

    def error(self, theta, frequencies):
        """E(jω; θ), shape (n_points, l, m)."""
        s = line(frequencies)
        gap = self._given(s) - self.structure.response(theta, s)
        return self.outputs[:, None] * gap * self.inputs

    def singular_values(self, theta, frequencies):
        """Those of E(jω; θ), shape (n_points, min(l, m)), largest first."""
        return np.linalg.svd(self.error(theta, frequencies), compute_uv=False)

    def _resolved(self, theta, gains):
        """Tops between the points of the grid, where E has some gains, and their flanks."""
        low, high = self._brackets(gains, 0.0)
        peaks, _ = refine_peaks(lambda w: self.gains(theta, w), low, high)
        width = 0.02 * (high - low)
        return np.concatenate([peaks, np.maximum(peaks - width, 0.0), peaks + width])

    def sampling(self, theta, extra=()):
        """The grid, then the tops between its points at θ, their flanks and some more."""
        tops = self._resolved(theta, self.gains(theta, self.grid))
        return np.concatenate([self.grid, np.setdiff1d(np.concatenate([tops, extra]), self.grid)])

    def linearised(self, theta, frequencies):
        """E, its slopes and the directions of steps (:meth:`_step_directions`).

        ``frequencies`` are the grid, then others. Slopes have shape
        (n_points, l, m, k), and directions (k, n_directions).
        """
        error, slope = self.error_and_sensitivity(theta, frequencies)
        scale = (self.output_scales / self.outputs)[:, None] * (self.input_scales / self.inputs)
        n = len(self.grid)
        scaled = _as_reals(error[:n] * scale, slope[:n] * scale[..., None])
        return error, slope, self._step_directions(theta, *scaled)

    def _brackets(self, gains, least):
        """Between what neighbours on the grid its local maxima above some gain lie."""
        padded = np.concatenate([[-np.inf], gains, [-np.inf]])
        tops = np.flatnonzero((gains >= padded[:-2]) & (gains >= padded[2:]) & (gains >= least))
        low = self.grid[np.maximum(tops - 1, 0)]
        high = self.grid[np.minimum(tops + 1, len(self.grid) - 1)]
        high = np.where(np.isfinite(high), high, 10.0 * self.grid[-2])
        return np.minimum(low, high), high

    def moving_scales(self, theta):
        """By how much each parameter alone moves the response as far as the residual is long."""
        residual, jacobian = self.residual_and_jacobian(theta)
        return max(linalg.norm(residual), 1e-300) / column_sizes(jacobian)

    def _step_directions(self, theta, residual, jacobian):
        """M of θ → θ + M ζ: a unit ζ moves the response as far as the residual is long, or less.

        Less where parameters would move by more than many times their own size: on the way to
        infinity (a pole that becomes a feedthrough) the response saturates, and one such
        direction would hold up the others.
        """
        size, length = column_sizes(jacobian), linalg.norm(residual)
        _, singular, adjoint = linalg.svd(triangle(jacobian / size), full_matrices=False)
        kept = singular > RANK * singular.max(initial=0.0)
        if length == 0.0 or not kept.any():
            return np.zeros((len(theta), np.sum(kept)))
        reach = _FARTHEST * np.maximum(size * np.abs(theta), length)
        metric = np.vstack([np.diag(singular[kept] / length), adjoint[kept].T / reach[:, None]])
        return linalg.solve_triangular(triangle(metric), adjoint[kept], trans=1).T / size[:, None]

    def identifiability(self, theta):
        """Singular values of the sensitivity (columns of length one), and undetermined names."""
        jacobian = self.residual_and_jacobian(theta)[1]
        if jacobian.shape[1] == 0:
            return np.empty(0), ()
        _, singular, adjoint = linalg.svd(triangle(jacobian / column_sizes(jacobian)))
        singular = np.pad(singular, (0, len(adjoint) - len(singular)))
        null = adjoint[numerical_rank(singular) :]
        undetermined = np.flatnonzero(np.any(np.abs(null) > UNKNOWN, axis=0))
        return singular, tuple(self.structure.parameter_names[k] for k in undetermined)

    def feedthrough_floor(self):
        """Lower bound of the relative norm that fixed entries of D_s leave at ω = ∞."""
        n = self.structure.n_states
        gap = self.model.constant[self.model.n_states :, self.model.n_states :]
        gap = gap - self.structure.constant[n:, n:]
        free = np.any(self.structure.basis[:, n:, n:] != 0, axis=0)
        weighted = self.outputs[:, None] * np.where(free, 0.0, gap) * self.inputs
        if not free.any():
            return float(linalg.norm(weighted, 2))
        return float(np.abs(weighted).max(initial=0.0))


def numerical_rank(singular_values):
    """Number of singular values, largest first, that do not count as zero."""
    return int(np.sum(singular_values > RANK * max(np.max(singular_values, initial=0.0), 1e-300)))


def line(frequencies, shift=0.0):
    """s = shift + jω; at ω = ∞ a complex infinity (1j * inf would hold a NaN)."""
    s = np.full(np.shape(frequencies), shift, dtype=complex)
    s.imag = frequencies
    return s


@lru_cache(maxsize=8)
def _remembered_response(model, points):
    return model.response(np.empty(0), np.frombuffer(points, dtype=complex))


def _as_reals(error, slope):
    """Residual and Jacobian: real and imaginary parts of each entry side by side."""
    by_parameter = np.ascontiguousarray(np.moveaxis(slope, -1, 0))
    jacobian = by_parameter.view(float).reshape(len(by_parameter), 2 * error.size).T
    return np.ascontiguousarray(error).view(float).ravel(), jacobian
