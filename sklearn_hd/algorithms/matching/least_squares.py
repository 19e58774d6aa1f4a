"""Least-squares matches of responses over a frequency grid, by Levenberg-Marquardt.

    min_θ Σ_i |W_o (G_c(s_i) − G_s(s_i; θ)) W_i|_F²,   s_i = α + jω_i,  α ≥ 0,  l ≤ θ ≤ u

The line Re s = α lies right of all poles of G_s; a step that moves a pole across it is
refused. α = 0 is the match proper. Starts are led there through lines α > 0: seen from
the right, resonances overlap and valleys are wide, an unstable start is as good as a
stable one, and an exact match is the same on every line.

Damped least-squares steps between bounds.

Exact matches as changes of state.

G_s(θ) has the response of G_c if some T makes

    T A_c = A_s(θ) T,   T B_c = B_s(θ),   C_c = C_s(θ) T,   D_c = D_s(θ)

Where C_s is known and invertible, T follows at once. Otherwise T and θ are unknowns of
these bilinear equations, which Gauss-Newton solves to rounding from a θ that is near:
responses over a grid lose digits where states of very different size are mixed, the
equations do not.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, optimize

from sklearn_hd.algorithms.linalg.rounding import EPS
from sklearn_hd.algorithms.linalg.triangular import column_sizes, solve_within_rank, triangle
from sklearn_hd.exceptions import UnstableModelError

NEAR = 1e-6  # relative residual of a match that may be exact, and needs no other start
TOLERANCE = 1e-8  # relative decrease of the sum of squares that counts as none
_DAMPING_LIMIT = 1e10  # times the squared singular values: steps have become rounding
_STALLED = 1e-12  # relative fall of the sum of squares in one step
_NOTHING_LEFT = 1e-31  # sum of squares, relative to that of G_c
_PATIENCE = 25  # steps that must earn a tenth; a creep goes to parameters at infinity
_RUNAWAY = 1e6  # times the fastest pole: one that has become a feedthrough
_SAME = 1e-6  # relative distance of residuals of one and the same match
_HELD_UP = 5, 0.9  # over so many lines, α must fall below this share: a pole runs along before it
_WIDTH = 1e-300  # between a bound and a parameter on it: the routine wants an interval
_NOTHING = np.empty(0)  # the parameters of G_c


class FreeSteps:
    """Steps s that minimise |r + J s|² + damping |s|².

    In |s|² columns of J count as if they had length one.

    ``factor`` is the triangular factor of J, whose columns are divided by their lengths
    ``size``, and ``rest`` is r in the same coordinates. ``singular`` and ``adjoint``
    are the singular values of the factor and their right vectors, as rows. Directions
    whose value is below ``least`` are left out, and ``kept`` marks the others.
    ``promised`` is the decrease of |r + J s|² without damping.
    """

    def __init__(self, factor, rest, size, least=0.0):
        left, self.singular, self.adjoint = linalg.svd(factor, full_matrices=False)
        self.size, self.kept = size, self.singular >= least
        self._projected = np.where(self.kept, left.T @ rest, 0.0)
        self.promised = self._projected @ self._projected

    def damped(self, damping):
        """Step and the decrease of |r + J s|² that it promises."""
        known = np.where(self.kept, self.singular, 1.0)
        weight = np.where(self.kept, known / (known**2 + damping), 0.0)
        step = -(self.adjoint.T @ (weight * self._projected)) / self.size
        kept = 1.0 - (damping / (known**2 + damping)) ** 2
        return step, self._projected**2 @ kept


class BoundedSteps:
    """Steps s that minimise |r + J s|² + damping |s|² subject to lower ≤ s ≤ upper.

    In |s|² columns of J count as if they had length one.

    Bounds are infinite where there is none, and zero lies between them. ``promised`` is
    the decrease of |r + J s|² without damping.

    References
    ----------
    P. B. Stark and R. L. Parker, "Bounded-variable least-squares: an algorithm and
    applications", Computational Statistics 10 (1995), 129-141.

    Examples
    --------
    >>> steps = BoundedSteps(np.array([-2.0, -3.0]), np.eye(2), np.full(2, -1.0), np.ones(2))
    >>> step, decrease = steps.damped(0.0)
    >>> step.tolist(), float(decrease)
    ([1.0, 1.0], 8.0)
    """

    def __init__(self, residual, jacobian, lower, upper):
        self._size = column_sizes(jacobian)
        orthogonal, self._factor = linalg.qr(jacobian / self._size, mode="economic")
        self._target = -(orthogonal.T @ residual)
        lower, upper = np.minimum(lower, 0.0) * self._size, np.maximum(upper, 0.0) * self._size
        self._bounds = lower - _WIDTH * (lower == 0), upper + _WIDTH * (upper == 0)
        self.promised = self.damped(1e-14)[1]  # as good as free of damping

    def damped(self, damping):
        """Step and the decrease of |r + J s|² that it promises."""
        k = self._factor.shape[1]
        system = np.vstack([self._factor, np.sqrt(damping) * np.eye(k)])
        target = np.concatenate([self._target, np.zeros(k)])
        step = optimize.lsq_linear(system, target, self._bounds, method="bvls", tol=1e-14).x
        left = self._target - self._factor @ step
        return step / self._size, self._target @ self._target - left @ left


@dataclass(frozen=True, eq=False)
class GridFit:
    """A least-squares match."""

    theta: np.ndarray  # (k,)
    residual: float  # relative to the length of G_c on the grid
    # by how much the sum of squares could still fall at first order, relative to it
    promised: float
    history: tuple  # of float: the residual after each step, on the lines Re s = α that led here

    @property
    def n_iter(self):
        return len(self.history)


def levenberg_marquardt(problem, theta, *, shift=0.0, max_iter=100):
    """Least-squares match on the line Re s = shift, from a start with its poles left of it.

    ``shift`` is in rad/s, and ``max_iter`` the largest number of Jacobians.
    """
    residual, jacobian = problem.residual_and_jacobian(theta, shift)
    cost, damping, growth = residual @ residual, 1e-3, 2.0
    costs = [cost]
    while len(costs) <= max_iter:
        steps = _steps(problem, theta, residual, jacobian)
        if steps.promised <= TOLERANCE * cost:
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
        size = column_sizes(jacobian)
        # the same from the triangular factor, whose orthogonal one is never formed
        R = triangle(np.column_stack([jacobian / size, residual]))[: len(size)]
        return FreeSteps(R[:, :-1], R[:, -1], size)
    return BoundedSteps(residual, jacobian, problem.lower - theta, problem.upper - theta)


def fit_from_the_right(problem, theta, max_iter):
    """Least-squares match on the axis, through lines that come down on it from the right.

    The lines begin at the fastest pole of G_c (further right if the start is unstable)
    and come down by a factor of 0.4. Mass-spring chains of 6 to 10 states seen through
    one output, from starts 50 % off: 98-100 % end at the exact match this way, about 35 %
    when the search begins on the axis. None if no stable model is reached.
    """
    history, fastest = (), problem.fastest
    shift = max(fastest, 2.0 * problem.abscissa(theta))
    shifts, (n_lines, share) = [], _HELD_UP
    while len(shifts) < 40:  # lines Re s = α on the way to the axis
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


def fit_from(problem, theta, near, max_iter):
    """Least-squares match from a start, or None if no stable model is reached.

    A near one is searched in its valley: on the axis, without the lines to its right.
    """
    problem = problem.limited(theta, _RUNAWAY)  # once: from line to line it would grow
    if near and problem.abscissa(theta) < 0:
        return levenberg_marquardt(problem, theta, max_iter=max_iter)
    return fit_from_the_right(problem, theta, max_iter)


def local_fits(problem, starts, *, max_iter):
    """Different least-squares matches reached from some starts, the best first.

    Stops early at an exact match.

    ``starts`` are pairs of θ and whether it is near, as for :func:`fit_from`. Each
    takes ``max_iter`` steps or fewer. It raises UnstableModelError if none led to a
    stable model.
    """
    fits, n_starts = [], 0
    for theta, is_near in starts:
        n_starts += 1
        fit = fit_from(problem, theta, is_near, max_iter)
        if fit is None or any(_same(fit, other) for other in fits):
            continue
        fits = sorted([*fits, fit], key=lambda each: each.residual)
        if fits[0].residual <= NEAR:
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


def output_transformation(problem):
    """T of x_s = T x_c where the outputs fix it, C_s T = C_c; None where they do not.

    That takes a C_s without parameters and of full column rank. Where G_c has another
    number of states, T is not square and serves as a start only.
    """
    n = problem.structure.n_states
    C_s = problem.structure.constant[n:, :n]
    if problem.structure.basis[:, n:, :n].any() or n == 0 or problem.model.n_states == 0:
        return None
    if len(C_s) < n or np.linalg.matrix_rank(C_s) < n:
        return None
    return _regular(linalg.lstsq(C_s, problem.model.matrices(_NOTHING)[2])[0])


def draw_transformation(problem, theta0, random, spread):
    """T with C_s T = C_c, its free part guessed and drawn; None if there is none to choose.

    The guess regresses the states at theta0 on those of G_c; ``spread`` (0 or 1) adds
    a random part of a third of its size. Without theta0 all of it is random, its size
    drawn over six decades.
    """
    structure, model = problem.structure, problem.model
    n = structure.n_states
    if model.n_states == 0 or n == 0:
        return None
    C_s, C_c = structure.constant[n:, :n], model.matrices(_NOTHING)[2]
    if structure.basis[:, n:, :n].any():
        C_s, C_c = C_s[:0], C_c[:0]  # C_s says nothing as yet
    fixed = linalg.lstsq(C_s, C_c)[0] if len(C_s) else np.zeros((n, model.n_states))
    hidden = linalg.null_space(C_s) if len(C_s) else np.eye(n)
    if hidden.shape[1] == 0:
        return None
    states_c = _state_response(model, problem)
    vectors, sizes, _ = linalg.svd(states_c, full_matrices=False)
    whiten = (vectors / np.maximum(sizes, 1e-12 * sizes[0])).T
    free = random.standard_normal((hidden.shape[1], len(whiten))) @ whiten
    if theta0 is None:
        free = free * sizes[0] * 10.0 ** random.uniform(-3, 3)
    else:
        guess = _regression(_state_response(structure, problem, theta0), states_c)
        size = linalg.norm(hidden.T @ guess @ states_c)
        free = hidden.T @ (guess - fixed) + 0.3 * spread * size * free
    return _regular(fixed + hidden @ free)


def project_transformed(problem, T):
    """Parameters of the structure nearest to T A_c T⁻¹, T B_c, C_c T⁻¹, D_c.

    Near in entries whose rows and columns are scaled by the size of the states, inputs
    and outputs they connect.
    """
    inverse = linalg.pinv(T)
    A, B, C, D = problem.model.matrices(_NOTHING)
    stacked = np.block([[T @ A @ inverse, T @ B], [C @ inverse, D]])
    states = _sizes(T @ _state_response(problem.model, problem))
    rows = np.concatenate([1.0 / (_rate(A) * states), problem.output_scales])
    columns = np.concatenate([states, problem.input_scales])
    return problem.structure.project(stacked, rows[:, None] * columns)[0]


def solve_similarity(problem, theta):
    """Parameters near θ, and T, that solve the equations of an exact match.

    It takes ten steps of Gauss and Newton, or fewer.

    θ has to be near the solution (response within 1e-6, say). It returns θ and the
    length of what is left of the equations, relative to their terms: inf where G_c has
    another number of states.
    """
    structure, model = problem.structure, problem.model
    n = structure.n_states
    if model.n_states != n or n == 0:
        return theta, np.inf
    states_c, states = (_state_response(model, problem), _state_response(structure, problem, theta))
    T = _regression(states, states_c)
    rate = _rate(model.matrices(_NOTHING)[0])
    rows = np.concatenate([1.0 / (rate * _sizes(states)), problem.output_scales])
    columns = np.concatenate([_sizes(states_c), problem.input_scales])
    weights = rows[:, None] * columns
    best = theta, _similarity_residual(problem, theta, T, weights)
    for _ in range(10):
        theta, T = _gauss_newton_step(problem, theta, T, weights)
        residual = _similarity_residual(problem, theta, T, weights)
        if not residual < 0.5 * best[1]:
            break
        best = theta, residual
    return best


def _sides(problem, theta, T):
    """[T 0; 0 I] [A_c B_c; C_c D_c] and [A_s B_s; C_s D_s] [T 0; 0 I]."""
    left = linalg.block_diag(T, np.eye(problem.structure.n_outputs))
    right = linalg.block_diag(T, np.eye(problem.structure.n_inputs))
    stacked = problem.structure.constant + np.tensordot(theta, problem.structure.basis, 1)
    return left @ problem.model.constant, stacked @ right, right, stacked


def _similarity_residual(problem, theta, T, weights):
    given, made, _, _ = _sides(problem, theta, T)
    return linalg.norm(weights * (given - made)) / linalg.norm(weights * given)


def _gauss_newton_step(problem, theta, T, weights):
    """θ and T after one linearised solution of the equations."""
    n = len(T)
    given, made, right, stacked = _sides(problem, theta, T)
    units = np.eye(n * n).reshape(n * n, n, n)
    by_T = np.zeros((n * n, *given.shape))
    by_T[:, :n] = units @ problem.model.constant[:n]
    by_T[:, :, :n] -= stacked[:, :n] @ units
    by_theta = -(problem.structure.basis @ right)
    jacobian = (weights * np.concatenate([by_T, by_theta])).reshape(n * n + len(theta), -1).T
    step = solve_within_rank(jacobian, -(weights * (given - made)).ravel(), cond=EPS)
    return theta + step[n * n :], T + step[: n * n].reshape(n, n)


def _state_response(structure, problem, theta=_NOTHING):
    """(jωI − A)⁻¹ B W_i over the grid, real and imaginary parts side by side, n rows."""
    A, B, _, _ = structure.matrices(theta)
    s = 1j * problem.grid[:-1]
    states = np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B * problem.input_scales)
    states = np.concatenate(list(states), axis=1)
    return np.hstack([states.real, states.imag])


def _sizes(states):
    """Root mean square of each state, lifted to 1e-6 of the largest."""
    sizes = np.sqrt(np.mean(states**2, axis=1))
    return np.maximum(sizes, 1e-6 * max(sizes.max(), 1e-300))


def _rate(A):
    """Geometric mean of the poles' magnitudes (rad/s)."""
    return np.exp(np.mean(np.log(np.maximum(np.abs(linalg.eigvals(A)), 1e-300))))


def _regression(states, regressors):
    """Real matrix T with states ≈ T regressors over the grid."""
    size = column_sizes(regressors.T)
    return linalg.lstsq((regressors / size[:, None]).T, states.T)[0].T / size


def _regular(T):
    """The matrix itself, or None where it lacks rank once rows and columns are scaled."""
    scaled = T / column_sizes(T)
    scaled = scaled / column_sizes(scaled.T)[:, None]
    return T if np.linalg.cond(scaled) < 1e10 else None
