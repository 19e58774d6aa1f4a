"""Convex programs with a level to press down, by the interior-point method of clarabel.

    min_{t, ζ} t + ½ ζᵀHζ   subject to   cuts ≤ t,   |ζ| ≤ Δ,   W ζ ≤ w

Cuts are planes, c_i + g_iᵀζ, or cones, |c_i + S_i ζ|.
"""

from typing import NamedTuple

import clarabel
import numpy as np
from scipy import sparse

__all__ = ["Level", "least_level"]


class Level(NamedTuple):
    """Where :func:`least_level` ended.

    Attributes
    ----------
    step : ndarray, shape (n_directions,)
        ζ.
    height : float
        The highest cut there.
    multipliers : ndarray
        p_i of the cuts, shaped as they are: Σ_i Re(p_iᴴ S_i) + H ζ = 0 wherever neither ball
        nor walls are touched.
    walls : ndarray, shape (n_walls,)
        Multipliers of the walls.
    pull : float
        That of the ball.
    """

    step: np.ndarray
    height: float
    multipliers: np.ndarray
    walls: np.ndarray
    pull: float


def least_level(cuts, rates, curvature, radius, walls, tol=1e-10):
    """The step ζ within a ball and walls after which the highest cut is lowest.

    Parameters
    ----------
    cuts : ndarray, shape (n_cuts,), or complex ndarray, shape (n_cuts, n_rows)
        c_i of planes, or of cones.
    rates : ndarray, shape (n_cuts, n_directions) or (n_cuts, n_rows, n_directions)
        g_i or S_i.
    curvature : ndarray, shape (n_directions, n_directions)
        H, positive semidefinite.
    radius : float
        Δ.
    walls : tuple of ndarray, shapes (n_walls, n_directions), (n_walls,)
        W and w.
    tol : float
        Of clarabel.

    Returns
    -------
    level : Level

    Raises
    ------
    ArithmeticError
        If the solver ends without numbers.

    Examples
    --------
    Two planes, |ζ| of one direction and a little less on the right, which is pulled further:

    >>> none = np.zeros((0, 1)), np.zeros(0)
    >>> planes = np.array([0.0, -0.5]), np.array([[-1.0], [1.0]])
    >>> least_level(*planes, np.zeros((1, 1)), 1.0, none).step.round(6).tolist()
    [0.25]
    """
    n_directions = rates.shape[-1]
    rows, offset, kinds = _planes(cuts, rates) if cuts.ndim == 1 else _cones(cuts, rates)
    ball = -np.eye(1 + n_directions)
    ball[0, 0] = 0.0
    sides = np.hstack([np.zeros((len(walls[1]), 1)), walls[0]])
    steep = np.maximum(np.linalg.norm(sides, axis=1), 1e-300)
    constraint = sparse.csc_matrix(np.vstack([rows, ball, sides / steep[:, None]]))
    offset = np.concatenate([offset, [radius], np.zeros(n_directions), walls[1] / steep])
    kinds = [*kinds, clarabel.SecondOrderConeT(1 + n_directions)]
    if len(steep):
        kinds.append(clarabel.NonnegativeConeT(len(steep)))
    quadratic = np.zeros((1 + n_directions, 1 + n_directions))
    quadratic[1:, 1:] = np.triu(curvature)
    target = np.zeros(1 + n_directions)
    target[0] = 1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tol
    quadratic = sparse.csc_matrix(quadratic)
    solver = clarabel.DefaultSolver(quadratic, target, constraint, offset, kinds, settings)
    solution = solver.solve()
    step, multipliers = np.asarray(solution.x)[1:], np.asarray(solution.z)
    if not (np.all(np.isfinite(step)) and np.all(np.isfinite(multipliers))):
        raise ArithmeticError(f"the cone solver ended with {solution.status} and no numbers")
    step = step * min(1.0, radius / max(np.linalg.norm(step), radius))
    of_cuts, of_ball, of_walls = np.split(multipliers, [len(rows), len(rows) + 1 + n_directions])
    moved = cuts + rates @ step
    if cuts.ndim == 1:
        height = moved.max()
    else:
        height = np.linalg.norm(moved, axis=1).max()
        _, real, imag = np.split(of_cuts.reshape(len(cuts), -1), [1, 1 + cuts.shape[1]], axis=1)
        of_cuts = -(real + 1j * imag)
    return Level(step, float(height), of_cuts, of_walls / steep, float(np.linalg.norm(of_ball[1:])))


def _planes(cuts, rates):
    """Rows and offsets on (t, ζ), and the cones of clarabel that hold what is left."""
    rows = np.hstack([np.full((len(cuts), 1), -1.0), rates])
    return rows, -cuts, [clarabel.NonnegativeConeT(len(cuts))]


def _cones(cuts, rates):
    n_cuts, n_rows, n_directions = rates.shape
    size = 1 + 2 * n_rows
    rows = np.zeros((n_cuts, size, 1 + n_directions))
    rows[:, 0, 0] = -1.0
    rows[:, 1 : 1 + n_rows, 1:], rows[:, 1 + n_rows :, 1:] = -rates.real, -rates.imag
    offset = np.concatenate([np.zeros((n_cuts, 1)), cuts.real, cuts.imag], axis=1)
    kinds = [clarabel.SecondOrderConeT(size)] * n_cuts
    return rows.reshape(-1, 1 + n_directions), offset.ravel(), kinds
