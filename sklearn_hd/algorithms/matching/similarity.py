"""Exact matches as changes of state.

G_s(θ) has the response of G_c if some T makes

    T A_c = A_s(θ) T,   T B_c = B_s(θ),   C_c = C_s(θ) T,   D_c = D_s(θ)

Where C_s is known and invertible, T follows at once. Otherwise T and θ are unknowns of
these bilinear equations, which Gauss-Newton solves to rounding from a θ that is near:
responses over a grid lose digits where states of very different size are mixed, the
equations do not.
"""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.structured_model import column_sizes

_NOTHING = np.empty(0)  # the parameters of G_c


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


def solve_similarity(problem, theta, max_iter=10):
    """Parameters near θ, and T, that solve the equations of an exact match.

    Parameters
    ----------
    problem : MatchingProblem
    theta : ndarray, shape (k,)
        Near the solution (response within 1e-6, say).
    max_iter : int
        Gauss-Newton steps.

    Returns
    -------
    theta : ndarray, shape (k,)
    residual : float
        Length of what is left of the equations, relative to their terms; inf where
        G_c has another number of states.
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
    for _ in range(max_iter):
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
    size = column_sizes(jacobian)
    step = linalg.lstsq(jacobian / size, -(weights * (given - made)).ravel())[0] / size
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
