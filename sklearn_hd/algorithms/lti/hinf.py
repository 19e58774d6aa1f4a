"""H∞ norm of state-space models, ‖G‖_∞ = sup_ω σ_max(G(jω)).

In discrete time z = e^{jω dt} takes the place of jω.
"""

import numpy as np
import slycot
from scipy import linalg

from sklearn_hd._checks import real_array
from sklearn_hd.algorithms.linalg.rounding import PRECISION
from sklearn_hd.exceptions import UnstableModelError


def hinf_norm(A, B, C, D, dt=None):
    """H∞ norm of a stable model, and the frequency where it is reached.

        ‖G‖_∞ = sup_ω σ_max(C (jωI − A)⁻¹ B + D)

    The level-set iteration of Bruinsma and Steinbuch (1990) as SLICOT's AB13DD
    has it finds the highest peak with no frequency grid; its top is refined on the
    response itself, to about ten digits.

    Parameters
    ----------
    A, B, C, D : array_like, shapes (n, n), (n, m), (l, n), (l, m)
        State-space matrices; n = 0 (a static gain) is allowed.
    dt : float, True or None
        Sample time in seconds; None or 0 for continuous time, True for a
        discrete model whose sample time is not stated (taken as 1).

    Returns
    -------
    norm : float
        Largest gain in the units of the outputs over those of the inputs.
    peak_frequency : float
        In rad/s, ≥ 0, and at most π/dt in discrete time. ``inf`` where the supremum
        is only approached at high frequency; 0 for a static gain. Of several
        frequencies with the same gain, one.

    Raises
    ------
    UnstableModelError
        If a pole lies on or outside the stability boundary, hidden (uncontrollable
        or unobservable) poles included.
    ArithmeticError
        If the entries span so many decades that eigenvalues do not converge.

    Notes
    -----
    The tolerance, 1e-10, is relative to the norm of this model. Where the model is a
    difference of two that nearly cancel, rounding in the parts is what is left: a
    difference that is zero comes back as about 1e-10 of its parts rather than 0.
    Judge "the same" by a residual, not by this norm. The peak frequency of a flat
    peak is far less certain than its height.

    References
    ----------
    N. A. Bruinsma and M. Steinbuch, "A fast algorithm to compute the H∞-norm of a
    transfer function matrix", Systems & Control Letters 14 (1990), 287-293.

    Examples
    --------
    The gain of 3/(s + 2) is largest at rest:

    >>> norm, frequency = hinf_norm([[-2.0]], [[1.0]], [[3.0]], [[0.0]])
    >>> round(norm, 9), frequency
    (1.5, 0.0)
    """
    A, B, C, D = _matrices(A, B, C, D)
    sample_time = _sample_time(dt)
    if D.size == 0:
        return 0.0, 0.0
    if len(A) == 0:
        return float(linalg.norm(D, 2)), 0.0
    check_stable(A, dt)
    n, m, p = len(A), B.shape[1], len(C)
    domain = "C" if sample_time is None else "D"
    rate = 1.0  # of time, so that poles are of size one
    if sample_time is None:
        rate = float(np.exp(np.mean(np.log(np.abs(linalg.eigvals(A))))))
        A, B = A / rate, B / rate
    try:
        norm, peak = slycot.ab13dd(domain, "I", "S", "D", n, m, p, A, np.eye(n), B, C, D)
    except slycot.exceptions.SlycotArithmeticError as error:
        raise ArithmeticError(
            "the H∞ norm of this model cannot be computed: the eigenvalues of its Hamiltonian "
            "matrix do not converge; its entries may span too many decades, so scale its states"
        ) from error
    peak, unit = float(peak), rate / (sample_time or 1.0)
    if not 0.0 < peak < (np.inf if sample_time is None else np.pi):
        return float(norm), peak * unit

    def gains(frequencies):
        s = 1j * frequencies.ravel() if sample_time is None else np.exp(1j * frequencies.ravel())
        response = C @ np.linalg.solve(s[:, None, None] * np.eye(n) - A, B) + D
        return np.linalg.norm(response, 2, axis=(1, 2)).reshape(frequencies.shape)

    reach = np.array([peak * (1.0 - _BRACKET)]), np.array([peak * (1.0 + _BRACKET)])
    peaks, values = refine_peaks(gains, *reach)
    if values[0] > norm * (1.0 - _BRACKET) or not np.isfinite(norm):
        norm, peak = values[0], peaks[0]
    return float(norm), float(peak) * unit


_BRACKET = 1e-3  # how far AB13DD's peak may lie from the top, relative


def refine_peaks(gains, low, high):
    """Tops of a gain between bounds: frequencies, and heights to ten digits after three rounds.

    ``gains`` takes frequencies of any shape; ``low`` and ``high`` have shape
    (n_peaks,).
    """
    rows = np.arange(len(low))
    for _ in range(3):  # in each the bounds close in on the top by a factor of four
        points = np.linspace(low, high, 9, axis=1)
        values = gains(points)
        best = np.argmax(values, axis=1)
        low, high = points[rows, np.maximum(best - 1, 0)], points[rows, np.minimum(best + 1, 8)]
    inner = np.clip(best, 1, 7)
    left, middle, right = (values[rows, inner + k] for k in (-1, 0, 1))
    bend = left - 2.0 * middle + right
    vertex = 0.5 * (left - right) / np.where(bend < 0, bend, -np.inf)
    vertex = points[rows, inner] + np.clip(vertex, -1.0, 1.0) * (points[:, 1] - points[:, 0])
    frequencies = np.stack([points[rows, best], vertex], axis=1)
    values = np.stack([values[rows, best], gains(vertex)], axis=1)
    top = np.argmax(values, axis=1)
    return frequencies[rows, top], values[rows, top]


def tops_between(frequencies, gains):
    """Where parabolas through three neighbours have their top, and how high.

    Points come in any order; infinite frequencies are left out. Returns the frequencies
    of tops that are none of the points, the heights of the parabolas there, and the
    largest gain of the three neighbours.

    Examples
    --------
    >>> tops, heights, sampled = tops_between(np.array([0.0, 1.0, 3.0]), np.array([0.0, 3.0, 3.0]))
    >>> tops.tolist(), heights.tolist(), sampled.tolist()
    ([2.0], [4.0], [3.0])
    """
    order = np.argsort(frequencies)
    order = order[np.isfinite(frequencies[order])]
    w, y = frequencies[order], gains[order]
    new = np.concatenate([[True], np.diff(w) > PRECISION * w[1:]])  # the same point else
    w, y = w[new], y[new]
    k = 1 + np.flatnonzero((y[1:-1] >= y[:-2]) & (y[1:-1] >= y[2:]))
    left, right = w[k - 1] - w[k], w[k + 1] - w[k]
    rise, fall = (y[k - 1] - y[k]) / left, (y[k + 1] - y[k]) / right
    bend = (fall - rise) / (right - left)
    slope = rise - bend * left
    move = -0.5 * slope / np.where(bend < 0, bend, -np.inf)
    apart = np.abs(move) > PRECISION * w[k]
    tops = w[k] + np.clip(move, 0.9 * left, 0.9 * right)
    return tops[apart], (y[k] + 0.5 * slope * move)[apart], y[k][apart]


def check_stable(A, dt):
    """Raise unless every eigenvalue of A is strictly inside the stability region.

    That is the left half plane where ``dt`` is None or 0, else the unit disc. The
    UnstableModelError names the worst pole.
    """
    poles = linalg.eigvals(A) if len(A) else np.empty(0)
    continuous = _sample_time(dt) is None
    excess = poles.real if continuous else np.abs(poles) - 1.0
    if np.any(excess >= 0):
        worst = poles[np.argmax(excess)]
        text = (
            f"{worst.real:.6g}" if worst.imag == 0 else f"{worst.real:.6g} ± {abs(worst.imag):.6g}j"
        )
        region = "left half plane" if continuous else "unit disc"
        raise UnstableModelError(
            f"the model has a pole at {text}, outside the open {region}, so its response is not "
            f"bounded and has no norm; drop or stabilise that mode first"
        )


def _sample_time(dt):
    """None for continuous time, else a positive number of seconds."""
    if dt is None or (dt is not True and dt == 0):
        return None
    if not (dt > 0 and np.isfinite(dt)):
        raise ValueError(f"dt={dt!r} is not a sample time; give seconds > 0, True, or None")
    return float(dt)


def _matrices(A, B, C, D):
    """The four matrices as finite floats of shapes that fit."""
    wanted = "finite real numbers"
    A, B, C, D = (real_array(*given, wanted) for given in zip("ABCD", (A, B, C, D), strict=True))
    shapes = [matrix.shape for matrix in (A, B, C, D)]
    n, m, p = len(A) if A.ndim else 0, D.shape[-1] if D.ndim else 0, len(D) if D.ndim else 0
    if shapes != [(n, n), (n, m), (p, n), (p, m)]:
        raise ValueError(
            f"A, B, C, D of shapes {shapes} do not make a state-space model; "
            f"they must be (n, n), (n, m), (l, n), (l, m)"
        )
    return A, B, C, D
