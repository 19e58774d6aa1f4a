"""Least-squares matches of responses over a frequency grid, by Levenberg-Marquardt.

    min_θ Σ_i |W_o (G_c(s_i) − G_s(s_i; θ)) W_i|_F²,   s_i = α + jω_i,  α ≥ 0,  l ≤ θ ≤ u

The line Re s = α lies right of all poles of G_s; a step that moves a pole across it is
refused. α = 0 is the match proper. Starts are led there through lines α > 0: seen from
the right, resonances overlap and valleys are wide, an unstable start is as good as a
stable one, and an exact match is the same on every line.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.triangular import triangle
from sklearn_hd.algorithms.lti.structured_model import column_sizes
from sklearn_hd.algorithms.matching.bounded_steps import BoundedSteps
from sklearn_hd.exceptions import UnstableModelError

_DAMPING_LIMIT = 1e10  # times the squared singular values: steps have become rounding
_STALLED = 1e-12  # relative fall of the sum of squares in one step
_NOTHING_LEFT = 1e-31  # sum of squares, relative to that of G_c
_PATIENCE = 25  # steps that must earn a tenth; a creep goes to parameters at infinity
_RUNAWAY = 1e6  # times the fastest pole: one that has become a feedthrough
_LINES = 40  # largest number of lines Re s = α on the way to the axis
_SAME = 1e-6  # relative distance of residuals of one and the same match
_HELD_UP = 5, 0.9  # over so many lines, α must fall below this share: a pole runs along before it


@dataclass(frozen=True, eq=False)
class GridFit:
    """A least-squares match.

    Attributes
    ----------
    theta : ndarray, shape (k,)
    residual : float
        Relative to the length of G_c on the grid.
    promised : float
        By how much the sum of squares could still fall at first order, relative to it.
    history : tuple of float
        The residual after each step, on the lines Re s = α that led here.
    """

    theta: np.ndarray
    residual: float
    promised: float
    history: tuple

    @property
    def n_iter(self):
        return len(self.history)


def levenberg_marquardt(problem, theta, *, shift=0.0, max_iter=100, tol=1e-8):
    """Least-squares match on the line Re s = shift, from a start with its poles left of it.

    Parameters
    ----------
    problem : MatchingProblem
    theta : ndarray, shape (k,)
    shift : float
        α in rad/s.
    max_iter : int
        Largest number of Jacobians.
    tol : float
        Relative decrease of the sum of squares, promised to first order, at which to stop.

    Returns
    -------
    fit : GridFit
    """
    residual, jacobian = problem.residual_and_jacobian(theta, shift)
    cost, damping, growth = residual @ residual, 1e-3, 2.0
    costs = [cost]
    while len(costs) <= max_iter:
        steps = _steps(problem, theta, residual, jacobian)
        if steps.promised <= tol * cost:
            break
        accepted = False
        while not accepted and damping < _DAMPING_LIMIT:
            step, expected = steps.damped(damping)
            trial = problem.inside(theta + step)
            new_cost = np.inf
            if problem.abscissa(trial) < shift:
                new_residual, new_jacobian = problem.residual_and_jacobian(trial, shift)
                new_cost = new_residual @ new_residual
            gain = (cost - new_cost) / max(expected, 1e-300)
            accepted = new_cost < cost
            if not accepted:
                damping, growth = damping * growth, 2.0 * growth
        if not accepted:
            break
        theta, residual, jacobian, cost = trial, new_residual, new_jacobian, new_cost
        costs.append(cost)
        damping = damping * max(1e-2, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        damping, growth = max(damping, 1e-16), 2.0
        creeping = len(costs) > _PATIENCE and cost > 0.9 * costs[-_PATIENCE]
        if creeping or cost > (1.0 - _STALLED) * costs[-2] or cost <= _NOTHING_LEFT:
            break
    promised = _steps(problem, theta, residual, jacobian).promised / max(cost, _NOTHING_LEFT)
    return GridFit(theta, float(np.sqrt(cost)), float(promised), tuple(np.sqrt(costs).tolist()))


def _steps(problem, theta, residual, jacobian):
    if not problem.bounded:
        return _FreeSteps(residual, jacobian)
    return BoundedSteps(residual, jacobian, problem.lower - theta, problem.upper - theta)


class _FreeSteps:
    """Steps that minimise |r + J s|² + damping |s|², columns of J scaled to length one.

    ``promised`` is the decrease of |r + J s|² without damping.
    """

    def __init__(self, residual, jacobian):
        self._size = column_sizes(jacobian)
        # the same from the triangular factor, whose orthogonal one is never formed
        R = triangle(np.column_stack([jacobian / self._size, residual]))
        factor, rest = R[: len(self._size), :-1], R[: len(self._size), -1]
        left, self._singular, self._adjoint = linalg.svd(factor, full_matrices=False)
        self._projected = left.T @ rest
        self.promised = self._projected @ self._projected

    def damped(self, damping):
        """Step and the decrease it promises."""
        weight = self._singular / (self._singular**2 + damping)
        step = -(self._adjoint.T @ (weight * self._projected)) / self._size
        kept = 1.0 - (damping / (self._singular**2 + damping)) ** 2
        return step, self._projected**2 @ kept


def fit_from_the_right(problem, theta, max_iter=100):
    """Least-squares match on the axis, through lines that come down on it from the right.

    The lines begin at the fastest pole of G_c (further right if the start is unstable)
    and come down by a factor of 0.4. Mass-spring chains of 6 to 10 states seen through
    one output, from starts 50 % off: 98-100 % end at the exact match this way, about 35 %
    when the search begins on the axis. None if no stable model is reached.
    """
    history, fastest = (), problem.fastest
    shift = max(fastest, 2.0 * problem.abscissa(theta))
    shifts, (n_lines, share) = [], _HELD_UP
    while len(shifts) < _LINES:
        shifts.append(shift)
        fit = levenberg_marquardt(problem, theta, shift=shift, max_iter=15)
        theta, history = fit.theta, history + fit.history
        abscissa = problem.abscissa(theta)
        if abscissa < 0 and shift < 0.03 * fastest:
            fit = levenberg_marquardt(problem, theta, max_iter=max_iter)
            return replace(fit, history=history + fit.history)
        shift = max(0.4 * shift, 0.5 * (shift + abscissa))
        if shift > share * min(shifts[:-n_lines][-1:], default=np.inf):
            return None
    return None


def fit_from(problem, start, max_iter):
    """Least-squares match from a :class:`Start`, or None if no stable model is reached."""
    problem = problem.limited(start.theta, _RUNAWAY)  # once: from line to line it would grow
    if start.near and problem.abscissa(start.theta) < 0:
        return levenberg_marquardt(problem, start.theta, max_iter=max_iter)
    return fit_from_the_right(problem, start.theta, max_iter)


@dataclass(frozen=True, eq=False)
class Start:
    """Parameters to start from.

    Attributes
    ----------
    theta : ndarray, shape (k,)
    near : bool
        Whether to search in this valley: on the axis, without the lines to its right.
    """

    theta: np.ndarray
    near: bool


def local_fits(problem, starts, *, max_iter=100, near=1e-6):
    """Different least-squares matches reached from some starts, the best first.

    Stops early at an exact match.

    Parameters
    ----------
    problem : MatchingProblem
    starts : iterable of Start
    max_iter : int
        Largest number of steps from each.
    near : float
        Relative residual that counts as an exact match except for rounding.

    Returns
    -------
    fits : list of GridFit

    Raises
    ------
    UnstableModelError
        If no start led to a stable model.
    """
    fits, n_starts = [], 0
    for start in starts:
        n_starts += 1
        fit = fit_from(problem, start, max_iter)
        if fit is None or any(_same(fit, other) for other in fits):
            continue
        fits = sorted([*fits, fit], key=lambda each: each.residual)
        if fits[0].residual <= near:
            break
    if not fits:
        raise UnstableModelError(
            f"no stable model of this structure was found from {n_starts} starts; give "
            f"initial values near a stable one, within the bounds, or free entries that hold the "
            f"poles where they are"
        )
    return fits


def _same(fit, other):
    """Whether two fits lie in one valley, by how long their residuals are."""
    return abs(fit.residual - other.residual) <= _SAME * fit.residual
