"""Steps of parameters along curves that are straight in sinh coordinates.

    θ = w sinh z,   dθ/dz = √(θ² + w²),   w > 0

Below w a parameter moves by sums, above it by factors. Where states change their scale, or
a pole runs to infinity, many parameters grow together and their products stay: a straight
line in z, a curve in θ along which straight steps must be short.
"""

import numpy as np

__all__ = ["CurvedSteps"]

_FARTHEST = 3.0  # change of z in one step: a factor of 20


class CurvedSteps:
    """Steps from θ that bend as sinh coordinates do.

    Parameters
    ----------
    scale : ndarray, shape (k,)
        w, in the parameters' units.

    Examples
    --------
    A small step is a sum; a parameter far beyond its scale is multiplied:

    >>> steps = CurvedSteps(np.array([1.0, 1.0]))
    >>> steps.move(np.array([0.0, 1e6]), np.array([1e-3, 1e6])).round(3).tolist()
    [0.001, 2718281.828]
    """

    def __init__(self, scale):
        self.scale = scale

    def move(self, theta, step):
        """Where a step ends that leaves θ with the velocity ``step``, after time one."""
        z, speed = np.arcsinh(theta / self.scale), np.hypot(theta, self.scale)
        return self.scale * np.sinh(z + np.clip(step / speed, -_FARTHEST, _FARTHEST))

    def bend(self, theta):
        """d²θ/ds² for dθ/ds = 1, shape (k,)."""
        return theta / (theta**2 + self.scale**2)
