"""Structured models matched in the H2 norm.

    min_θ ‖E(θ)‖_2² = (1/π) ∫₀^∞ |E(jω; θ)|_F² dω,   E = W_o (G_c − G_s(θ)) W_i,  E(∞) = 0

E is rational, so on ω = ω₀ tan(φ/2) Gauss' rule converges geometrically, at a rate set by
how near the poles of E come to a panel: panels are halved until none comes near. The sum
of squares over its nodes is what Levenberg-Marquardt wants, with analytic slopes; the
nodes follow the poles of G_s.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.matching.least_squares import levenberg_marquardt
from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem, line
from sklearn_hd.algorithms.reporting import stage
from sklearn_hd.exceptions import UnstableModelError

__all__ = ["H2Fit", "h2_error", "minimise_h2", "quadrature"]

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_ELLIPSE = 2.2  # size of the Bernstein ellipse that holds no pole: the error is its power −32
_FAR = 1e-9  # of 1 + (ω/ω₀)²: below it a pole is far from the path, at φ = ±j∞
_EQUAL = 1e-10  # weighted feedthrough, relative to ‖W_o G_c W_i‖_∞, that counts as zero
_STARTS = 4  # least-squares matches to go on from
_ROUNDS = 6  # times that the nodes follow the poles
_SETTLED = 1e-9  # relative change of the norm from round to round at which they have


@dataclass(frozen=True, eq=False)
class H2Fit:
    """Where :func:`minimise_h2` ended.

    Attributes
    ----------
    theta : ndarray, shape (k,)
    predicted_decrease : float
        By how much the square of the norm could still fall at first order, relative to it.
    history : tuple of float
        The norm after each step, relative to ‖W_o G_c W_i‖_∞ in rad/s^½.
    start : int
        Which of the starts led here.
    """

    theta: np.ndarray
    predicted_decrease: float
    history: tuple
    start: int


def quadrature(poles):
    """Nodes ω (rad/s) and weights of ∫₀^∞ f dω for a rational f with poles at ±p, ±p̄.

    Parameters
    ----------
    poles : complex ndarray, shape (n,)
        None on the imaginary axis.

    Returns
    -------
    frequencies, weights : ndarray, shape (n_points,)

    Examples
    --------
    ∫₀^∞ dω / (1 + ω²) = π/2:

    >>> frequencies, weights = quadrature(np.array([-1.0]))
    >>> round(float(np.sum(weights / (1.0 + frequencies**2)) / np.pi), 12)
    0.5
    """
    size = np.abs(poles)
    middle = np.exp(np.mean(np.log(size))) if len(size) else 1.0
    points = np.concatenate([poles, -poles]) / (1j * middle)
    points = 2.0 * np.arctan(points[np.abs(1.0 + points**2) > _FAR])
    points = np.concatenate([points + 2.0 * np.pi * turn for turn in (-1, 0, 1)])
    edges = np.linspace(0.0, np.pi, 5)
    low, high = edges[:-1], edges[1:]
    done = []
    while len(low):
        centre, half = (low + high) / 2, (high - low) / 2
        z = (points - centre[:, None]) / half[:, None]
        root = np.sqrt(z - 1.0) * np.sqrt(z + 1.0)
        fine = np.all(np.abs(z + root) >= _ELLIPSE, axis=1)
        done.append(np.stack([centre[fine], half[fine]]))
        low, high = (
            np.concatenate([low[~fine], centre[~fine]]),
            np.concatenate([centre[~fine], high[~fine]]),
        )
    centre, half = np.concatenate(done, axis=1)[:, :, None]
    angle = (centre + half * _NODES).ravel()
    order = np.argsort(angle)
    weights = (half * _WEIGHTS).ravel() * 0.5 * middle / np.cos(angle / 2) ** 2
    return middle * np.tan(angle[order] / 2), weights[order]


def h2_error(problem, theta):
    """‖W_o (G_c − G_s) W_i‖_2 in the criterion's unit; infinite where E(∞) ≠ 0.

    By quadrature, which keeps the digits of a small difference where a Gramian of both
    models loses half of them.
    """
    if linalg.norm(problem.error_model(theta)[3]) > _EQUAL:
        return np.inf
    return linalg.norm(_on_quadrature(problem, theta).residual_and_jacobian(theta)[0])


def minimise_h2(problem, starts, *, max_iter=100, tol=1e-8, report=None):
    """Parameters of least H2 matching error, reached from some starts.

    Parameters
    ----------
    problem : MatchingProblem
    starts : list of ndarray, shape (k,)
    max_iter : int
        Largest number of steps from each.
    tol : float
        Relative decrease of the square, promised at first order, at which to stop.
    report : callable, optional
        ``report(stage, most, done, note)``, told the starts that have ended.

    Returns
    -------
    fit : H2Fit

    Raises
    ------
    ValueError
        If D_s cannot equal D_c: no norm is finite.
    UnstableModelError
        If no start with D_s = D_c is stable.
    """
    equal = _EqualFeedthrough.build(problem)
    found, starts = [], starts[:_STARTS]
    told = stage(report, "H2, starts", len(starts))
    for k, start in enumerate(starts):
        zeta = equal.problem.inside(equal.coordinates(start))
        if equal.problem.abscissa(zeta) < 0:
            found.append((k, *_descend(equal.problem, zeta, max_iter, tol)))
        if told is not None:
            reached = min((fit.residual for _, fit, _ in found), default=np.inf)
            told(k + 1, f"error {reached:.3g}")
    if not found:
        raise UnstableModelError(
            "no start with the feedthrough of the model is stable; give initial values near a "
            "stable one"
        )
    start, fit, history = min(found, key=lambda each: each[1].residual)
    return H2Fit(equal.parameters(fit.theta), fit.promised, history, start)


def _descend(problem, theta, max_iter, tol):
    history = ()
    for _ in range(_ROUNDS):
        fit = levenberg_marquardt(_on_quadrature(problem, theta), theta, max_iter=max_iter, tol=tol)
        before, theta = history[-1:] or (np.inf,), fit.theta
        history += fit.history
        if abs(before[0] - fit.residual) <= _SETTLED * fit.residual:
            break
    return fit, history


def _on_quadrature(problem, theta):
    """The problem with the criterion's weights at the nodes of ‖E(θ)‖_2²."""
    frequencies, weights = quadrature(linalg.eigvals(problem.error_model(theta)[0]))
    scaled = np.sqrt(weights / np.pi)
    return replace(problem, grid=frequencies, grid_weights=scaled, scaling=problem.weighting)


@dataclass(frozen=True, eq=False)
class _EqualFeedthrough:
    """The problem among the θ = offset + directions · ζ for which D_s(θ) = D_c."""

    problem: MatchingProblem
    offset: np.ndarray
    directions: np.ndarray

    @classmethod
    def build(cls, problem):
        structure, n = problem.structure, problem.structure.n_states
        D_c = problem.model.matrices(np.empty(0))[3]
        columns = _at_infinity(problem, structure.basis[:, n:, n:]).T
        gap = _at_infinity(problem, (D_c - structure.constant[n:, n:])[None])[0]
        offset = linalg.lstsq(columns, gap)[0] if columns.size else np.zeros(columns.shape[1])
        if linalg.norm(gap - columns @ offset) > _EQUAL:
            raise ValueError(
                f"the H2 norm is infinite: the model's D = {D_c.tolist()} cannot be that of the "
                f"structure; let those entries of D be free, or use criterion='hinf' or "
                f"'least_squares'"
            )
        tied = np.any(columns != 0, axis=0)
        lower, upper = problem.lower, problem.upper
        if not tied.any() or np.linalg.matrix_rank(columns[:, tied]) == np.count_nonzero(tied):
            directions = np.eye(len(tied))[:, ~tied]
            lower, upper = lower[~tied], upper[~tied]
        else:
            directions = linalg.null_space(columns)
            lower, upper = np.full((2, directions.shape[1]), [[-np.inf], [np.inf]])
            if problem.bounded:
                raise ValueError(
                    "criterion='h2' holds D_s at the model's D, which ties parameters to each "
                    "other here, and their bounds cannot be kept; leave the bounds out, or give "
                    "each entry of D a name of its own"
                )
        free, offset = offset, np.where(tied, problem.inside(offset), offset)
        if linalg.norm(gap - columns @ offset) > _EQUAL:
            names = [structure.parameter_names[k] for k in np.flatnonzero(offset != free)]
            raise ValueError(
                f"the H2 norm is infinite: the bounds of {names} exclude the model's D = "
                f"{D_c.tolist()}; widen them, or use criterion='hinf' or 'least_squares'"
            )
        restricted = replace(
            structure,
            constant=structure.constant + np.tensordot(offset, structure.basis, 1),
            basis=np.tensordot(directions.T, structure.basis, 1),
            parameter_names=tuple(map(str, range(directions.shape[1]))),
        )
        inner = replace(problem, structure=restricted, lower=lower, upper=upper)
        return cls(inner, offset, directions)

    def coordinates(self, theta):
        return self.directions.T @ (theta - self.offset)

    def parameters(self, zeta):
        return self.offset + self.directions @ zeta


def _at_infinity(problem, feedthroughs):
    """Feedthroughs, shape (k, l, m), as the weights let them through, one a row."""
    s = line(np.full(len(feedthroughs), np.inf))
    return problem.weighting.apply(feedthroughs, s).real.reshape(len(feedthroughs), -1)
