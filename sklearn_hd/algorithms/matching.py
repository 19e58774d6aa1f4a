"""Structured models matched to a given one in the H∞ norm (step 5, Eqs. 20-22).

    θ* = arg min ‖W_o (G_c − G_s(θ)) W_i‖_∞,   G_s(θ): A, B, C, D affine in θ

The stages, each a function: channels are scaled alike; where C_s is known and invertible
a change of state gives θ in closed form; otherwise Levenberg-Marquardt brings starts to
the least-squares match over a frequency grid; the best one goes downhill in the exact
norm by a prox-linear trust region; the singular values of the sensitivity at the end say
which parameters the outputs determine.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.least_squares import Start, levenberg_marquardt, local_fits
from sklearn_hd.algorithms.matching_problem import MatchingProblem
from sklearn_hd.algorithms.minimax import MinimaxResult, minimise_peak
from sklearn_hd.algorithms.structured_model import AffineStructure, column_sizes

__all__ = ["AffineStructure", "MatchResult", "match_structure"]


@dataclass(frozen=True, eq=False)
class MatchResult:
    """What :func:`match_structure` found.

    Attributes
    ----------
    theta : ndarray, shape (k,)
    A, B, C, D : ndarray
        The structured model at θ; stable.
    hinf_error : float
        ‖W_o (G_c − G_s) W_i‖_∞, in the outputs' unit per input's unit.
    relative_error : float
        The same divided by ‖W_o G_c W_i‖_∞.
    peak_frequency : float
        rad/s; where the error is largest.
    theta_least_squares : ndarray, shape (k,)
        The match in the mean square over frequency: where the model does not lie in the
        structure, usually the better estimate of the parameters.
    hinf_error_least_squares : float
        ‖W_o (G_c − G_s) W_i‖_∞ there.
    feedthrough_floor : float
        Lower bound of ``hinf_error`` that the fixed entries of D_s leave: the error at
        infinite frequency. 0 where D_s can equal D_c.
    exact : bool
        True if the match holds to ``exact_tol``, judged by the residual.
    converged : bool
        True if exact, or if no direction lowers the norm at first order.
    predicted_decrease : float
        By how much, relative to itself, the norm could still fall at first order.
    n_iter : int
        Least-squares and minimax iterations, all starts together.
    history : tuple of float
        The norm after each minimax step, the least-squares start first.
    singular_values : ndarray, shape (k,)
        Of the sensitivity of the response, its columns scaled to length one.
    unidentified : tuple of str
        Parameters in the null space of the sensitivity: this response does not determine
        them (only some combinations), and they stay near where they started.
    """

    theta: np.ndarray
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    hinf_error: float
    relative_error: float
    peak_frequency: float
    theta_least_squares: np.ndarray
    hinf_error_least_squares: float
    feedthrough_floor: float
    exact: bool
    converged: bool
    predicted_decrease: float
    n_iter: int
    history: tuple
    singular_values: np.ndarray
    unidentified: tuple


def match_structure(
    A,
    B,
    C,
    D,
    structure,
    *,
    theta0=None,
    output_weights=None,
    input_weights=None,
    closed_form=True,
    n_starts=6,
    max_iter=100,
    tol=1e-8,
    exact_tol=1e-9,
    random_state=0,
):
    """Structured model nearest to a stable continuous one in the H∞ norm.

        min_θ ‖W_o (G_c − G_s(θ)) W_i‖_∞

    Parameters
    ----------
    A, B, C, D : array_like, shapes (n, n), (n, m), (l, n), (l, m)
        G_c, stable; its order may differ from the structure's.
    structure : AffineStructure
        G_s(θ), with m inputs and l outputs.
    theta0 : array_like, shape (k,), optional
        Where to start; need not be stable. Without it, and where neither it nor the
        closed form leads to an exact match, changes of state that agree with C_s are
        tried as starts.
    output_weights, input_weights : array_like, shapes (l,), (m,), optional
        Diagonals of W_o and W_i; ones by default, the norm as Eq. 22 has it. Outputs in
        different units call for :func:`channel_scales`: otherwise the largest decides.
    closed_form : bool
        False leaves the closed form out where theta0 is given (for studies of the search).
    n_starts : int
        Largest number of starts by a change of state.
    max_iter : int
        Largest number of iterations of each stage.
    tol : float
        Relative decrease of the norm promised at first order, at which to stop.
    exact_tol : float
        Relative residual below which the match is called exact and the minimax stage
        left out: AB13DD does not resolve the norm of such a difference.
    random_state : int
        Seed of the changes of state tried.

    Returns
    -------
    result : MatchResult
        Never worse in the norm than the best least-squares match found, and stable. The
        problem is not convex: "converged" promises a stationary point, not the global one.

    Raises
    ------
    UnstableModelError
        If G_c is unstable, or if no start led to a stable G_s.
    ValueError
        If shapes do not fit.

    References
    ----------
    A. S. Lewis and S. J. Wright, "A proximal method for composite minimization",
    Mathematical Programming 158 (2016), 501-546.

    Examples
    --------
    A model in other coordinates returns to those of its states:

    >>> entries = np.array([[-1.0, 2.0, 0.0], [-2.0, -3.0, 1.0]])
    >>> stacked = np.vstack([entries, np.eye(2, 3)])
    >>> basis = np.zeros((4, 4, 3))
    >>> basis[[0, 1, 2, 3], [0, 0, 1, 1], [0, 1, 0, 1]] = 1.0
    >>> free_A = AffineStructure(np.where(basis.any(axis=0), 0.0, stacked), basis, 2, tuple("abcd"))
    >>> T = np.array([[1.0, 1.0], [0.0, 2.0]])
    >>> A, B = T @ entries[:, :2] @ np.linalg.inv(T), T @ entries[:, 2:]
    >>> result = match_structure(A, B, np.linalg.inv(T), np.zeros((2, 1)), free_A)
    >>> [round(value, 9) for value in result.theta.tolist()], result.exact
    ([-1.0, 2.0, -2.0, -3.0], True)
    """
    problem = MatchingProblem.build(A, B, C, D, structure, output_weights, input_weights)
    theta0 = _check_theta(theta0, structure)
    starts = starting_points(problem, theta0, closed_form, n_starts, random_state)
    fits = local_fits(problem, starts, max_iter=max_iter, exact_tol=exact_tol)
    exact = fits[0].residual <= exact_tol
    if exact or structure.n_parameters == 0:
        value = problem.peak(fits[0].theta)[0]
        found = MinimaxResult(fits[0].theta, value, 0.0, exact, (value,), 0)
    else:
        found = minimax_from_fits(problem, fits, max_iter, tol)
        last = levenberg_marquardt(problem, found.theta, max_iter=max_iter)
        if last.residual < fits[0].residual:  # the minimax steps have left a poor valley
            fits, exact = [last, *fits], last.residual <= exact_tol
        if exact:
            value = problem.peak(last.theta)[0]
            found = replace(found, theta=last.theta, value=value, converged=True)
    return _result(problem, fits, found, exact)


def minimax_from_fits(problem, fits, max_iter, tol):
    """Least norm reached from the least-squares matches: short runs, the best one finished.

    The ranking by squares is not the ranking by peaks, so the match best in squares and
    the three best in peaks have their short runs.
    """
    short = min(_SCREENING, max_iter)
    ranked = sorted(fits[1:], key=lambda fit: problem.peak(fit.theta)[0])
    runs = [
        minimise_peak(problem, fit.theta, max_iter=short, tol=tol) for fit in [fits[0], *ranked[:3]]
    ]
    best = min(runs, key=lambda run: run.value)
    if best.converged or short == max_iter:
        return best
    rest = minimise_peak(problem, best.theta, max_iter=max_iter - short, tol=tol)
    history, n_iter = best.history + rest.history[1:], best.n_iter + rest.n_iter
    return replace(rest, history=history, n_iter=n_iter)


_SCREENING = 20  # convex steps of a short run


def _result(problem, fits, found, exact):
    """The result in the user's units."""
    unit = problem.criterion_unit
    singular_values, unidentified = problem.identifiability(found.theta)
    return MatchResult(
        found.theta,
        *problem.structure.matrices(found.theta),
        hinf_error=found.value * unit,
        relative_error=found.value,
        peak_frequency=problem.peak(found.theta)[1],
        theta_least_squares=fits[0].theta,
        hinf_error_least_squares=problem.peak(fits[0].theta)[0] * unit,
        feedthrough_floor=problem.feedthrough_floor() * unit,
        exact=exact,
        converged=bool(found.converged),
        predicted_decrease=float(found.predicted_decrease),
        n_iter=sum(fit.n_iter for fit in fits) + found.n_iter,
        history=tuple(value * unit for value in found.history),
        singular_values=singular_values,
        unidentified=unidentified,
    )


def starting_points(problem, theta0, closed_form, n_starts, random_state):
    """Starts in the order of their promise, made as they are asked for.

    The closed form; theta0; changes of state that agree with C_s, first as the states at
    theta0 suggest, then at random; where C_s leaves no choice, the first start shaken
    by half.
    """
    if problem.structure.n_parameters == 0:
        yield Start(np.empty(0), near=True)
        return
    first = theta0
    transformation = output_transformation(problem) if closed_form or theta0 is None else None
    if transformation is not None:
        projected = project_transformed(problem, transformation)
        first = projected if first is None else first
        yield Start(projected, near=True)
    if theta0 is not None:
        yield Start(theta0, near=False)
        yield Start(theta0, near=True)
    random = np.random.default_rng(random_state)
    for k in range(n_starts):
        transformation = draw_transformation(problem, theta0, random, spread=float(k > 0))
        if transformation is not None:
            yield Start(project_transformed(problem, transformation), near=k % 2 == 0)
        elif first is not None:
            shaken = first * (1.0 + random.uniform(-0.5, 0.5, len(first)))
            yield Start(shaken, near=k % 2 == 1)


def output_transformation(problem):
    """T of x_s = T x_c where the outputs fix it, C_s T = C_c; None where they do not.

    That takes a C_s without parameters and of full column rank. Where G_c has another
    number of states, T is not square and the form a start only.
    """
    n = problem.structure.n_states
    C_s = problem.structure.constant[n:, :n]
    if problem.structure.basis[:, n:, :n].any() or n == 0 or problem.model.n_states == 0:
        return None
    if len(C_s) < n or np.linalg.matrix_rank(C_s) < n:
        return None
    C_c = problem.model.matrices(np.empty(0))[2]
    return _regular(linalg.lstsq(C_s, C_c)[0])


def project_transformed(problem, transformation):
    """Parameters of the structure nearest to T A_c T⁻¹, T B_c, C_c T⁻¹, D_c.

    Near in entries whose rows and columns are scaled by the size of the states, inputs
    and outputs they connect.
    """
    T, inverse = transformation, linalg.pinv(transformation)
    A, B, C, D = problem.model.matrices(np.empty(0))
    stacked = np.block([[T @ A @ inverse, T @ B], [C @ inverse, D]])
    states = np.sqrt(np.mean(np.abs(T @ _state_response(problem.model, problem)) ** 2, axis=(0, 2)))
    states = np.maximum(states, 1e-6 * max(states.max(), 1e-300))
    rate = np.exp(np.mean(np.log(np.maximum(np.abs(linalg.eigvals(A)), 1e-300))))
    rows = np.concatenate([1.0 / (rate * states), problem.output_scales])
    columns = np.concatenate([states, problem.input_scales])
    theta, _ = problem.structure.project(stacked, rows[:, None] * columns)
    return theta


def _state_response(structure, problem, theta=()):
    """(jωI − A)⁻¹ B W_i on the finite part of the grid, shape (n_points, n, m)."""
    A, B, _, _ = structure.matrices(np.asarray(theta, dtype=float))
    s = 1j * problem.grid[:-1]
    return np.linalg.solve(s[:, None, None] * np.eye(len(A)) - A, B * problem.input_scales)


def draw_transformation(problem, theta0, random, spread):
    """T with C_s T = C_c, its free part guessed and drawn; None if there is none to choose."""
    structure, model = problem.structure, problem.model
    n = structure.n_states
    if model.n_states == 0 or n == 0:
        return None
    C_s, C_c = structure.constant[n:, :n], model.constant[model.n_states :, : model.n_states]
    if structure.basis[:, n:, :n].any():
        C_s, C_c = C_s[:0], C_c[:0]  # C_s says nothing as yet
    fixed = linalg.lstsq(C_s, C_c)[0] if len(C_s) else np.zeros((n, model.n_states))
    hidden = linalg.null_space(C_s) if len(C_s) else np.eye(n)
    if hidden.shape[1] == 0:
        return None
    states_c = np.hstack(list(_state_response(model, problem)))
    white = linalg.svd(np.hstack([states_c.real, states_c.imag]), full_matrices=False)
    whiten = (white[0] / np.maximum(white[1], 1e-12 * white[1][0])).T
    free = random.standard_normal((hidden.shape[1], model.n_states)) @ whiten
    if theta0 is not None:
        guess = _regression(_state_response(structure, problem, theta0), states_c)
        size = linalg.norm(hidden.T @ guess @ states_c)
        free = hidden.T @ (guess - fixed) + 0.3 * spread * size * free
    else:
        free = free * np.max(white[1]) * 10.0 ** random.uniform(-3, 3)
    return _regular(fixed + hidden @ free)


def _regression(states, regressors):
    """Real matrix T with states ≈ T regressors over the grid."""
    states = np.hstack(list(states))
    left = np.hstack([states.real, states.imag])
    right = np.hstack([regressors.real, regressors.imag])
    size = column_sizes(right.T)
    return linalg.lstsq((right / size[:, None]).T, left.T)[0].T / size


def _regular(transformation):
    """The matrix itself, or None where it lacks rank once rows and columns are scaled."""
    scaled = transformation / column_sizes(transformation)
    scaled = scaled / column_sizes(scaled.T)[:, None]
    return transformation if np.linalg.cond(scaled) < 1e10 else None


def _check_theta(theta0, structure):
    if theta0 is None:
        return None
    theta0 = np.asarray(theta0, dtype=float)
    if theta0.shape != (structure.n_parameters,) or not np.all(np.isfinite(theta0)):
        raise ValueError(
            f"theta0 of shape {theta0.shape} must hold {structure.n_parameters} finite numbers, "
            f"one for each of {list(structure.parameter_names)}"
        )
    return theta0
