"""Structured models matched to a given one (step 5, Eqs. 20-22).

    θ* = arg min ‖W_o (G_c − G_s(θ)) W_i‖,   G_s(θ): A, B, C, D affine in θ,  l ≤ θ ≤ u

in the H∞ norm, or in the mean square over a frequency grid. Start, descend, certify: where
C_s is known and invertible a change of state gives θ in closed form; from there, from the
user's start and from several random ones Levenberg-Marquardt goes to least-squares matches
over the grid, which is where the mean square stops. The best of them in different valleys go
down to the H∞ norm. The singular values of the sensitivity at the end say which parameters
the outputs determine, the certificate how much the norm could still fall. The matcher's
affine route (time-invariant structures, harmonic decompositions) needs it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import PRECISION
from sklearn_hd.algorithms.matching.least_squares import (
    NEAR,
    TOLERANCE,
    GridFit,
    draw_transformation,
    levenberg_marquardt,
    local_fits,
    output_transformation,
    project_transformed,
    solve_similarity,
)
from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem
from sklearn_hd.algorithms.matching.smooth_peak import GAP, Certificate, smooth_descent


@dataclass(frozen=True, eq=False)
class MatchResult:
    """What :func:`match_structure` found."""

    theta: np.ndarray  # (k,)
    # A to D: the structured model at θ; stable
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    hinf_error: float  # ‖W_o (G_c − G_s) W_i‖_∞, in the outputs' unit per input's unit
    relative_error: float  # the same divided by ‖W_o G_c W_i‖_∞
    peak_frequency: float  # rad/s; where the error is largest
    # (k,): the match in the mean square over frequency: where the model does not lie in the
    # structure, usually the better estimate of the parameters
    theta_least_squares: np.ndarray
    # lower bound of ``hinf_error`` that the fixed entries of D_s leave: the error at infinite
    # frequency. 0 where D_s can equal D_c.
    feedthrough_floor: float
    exact: bool  # True if the match holds to rounding, judged by the residual
    converged: bool  # True if exact, or if ``left`` is within ``tolerance``
    # by how much at most, relative to itself, the criterion could still fall at first order
    predicted_decrease: float
    # first-order conditions of the least H∞ norm; None in the mean square and for exact matches
    certificate: Certificate | None
    n_iter: int  # steps of the least-squares matches kept and of the descents in the norm
    # of (str, float): stage and its measure after each step on the way here: ``"least squares"``
    # (length of the error over the grid, relative to that of G_c), ``"minimax"`` (relative H∞ norm,
    # after each tightening of its smooth bound)
    history: tuple
    # what is left of the search: ``predicted_decrease`` in the mean square; how far the smooth
    # bound lies above the H∞ norm, relative to it
    left: float
    tolerance: float  # where that counts as none
    # (k,): of the sensitivity of the response, its columns scaled to length one
    singular_values: np.ndarray
    # of str: parameters in the null space of the sensitivity: this response does not determine them
    # (only some combinations), and they stay near where they started
    unidentified: tuple


def match_structure(
    A,
    B,
    C,
    D,
    structure,
    *,
    criterion="hinf",
    theta0=None,
    bounds=None,
    output_weights=None,
    input_weights=None,
    emphasis=None,
    n_starts=6,
    max_iter=100,
    random_state=0,
):
    """Structured model nearest to a stable continuous one.

        min_θ ‖W_o (G_c − G_s(θ)) W_i‖,   lower ≤ θ ≤ upper

    in the H∞ norm, or (``criterion="least_squares"``) in the mean square over a grid of
    frequencies, in which all channels count alike, but for ``emphasis``. The order of G_c may
    differ from the structure's, W_o and W_i are diagonal, and theta0 need not be stable. Where
    neither it nor the closed form leads to an exact match, changes of state that agree with
    C_s are tried as starts.

    The result is stable, and never worse in the norm than the best least-squares match found.
    The problem is not convex: "converged" promises a stationary point. UnstableModelError says
    that G_c is unstable, or that no start led to a stable G_s.

    Examples
    --------
    A model in other coordinates returns to those of its states:

    >>> from sklearn_hd.algorithms.lti.structured_model import AffineStructure
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
    weights = output_weights, input_weights
    problem = MatchingProblem.build(A, B, C, D, structure, weights, bounds, emphasis)
    theta0 = None if theta0 is None else np.asarray(theta0, dtype=float)
    starts = list(starting_points(problem, theta0, n_starts, random_state))
    fits = local_fits(problem, starts, max_iter=max_iter)
    fit, exact = exact_match(problem, fits[0])
    if exact or structure.n_parameters == 0 or criterion == "least_squares":
        return _result(problem, fit, fits, exact)
    start, descent = least_norm(problem, fits, starts, max_iter)
    near = problem.limited(descent.theta, 1.0)
    last = levenberg_marquardt(near, descent.theta, max_iter=max_iter)
    if last.residual < fit.residual:  # the descent has left a poor valley
        fit, exact = exact_match(problem, last)
        if exact:
            return _result(problem, fit, fits, exact)
    return _result(problem, fit, fits, False, start, descent)


_RUNAWAY = 1e8  # times the fastest pole: an error within 1e-7 or so of that with a feedthrough
_CERTIFIED = 0.5  # decrease that a certificate may promise; at minima it is 1e-4 to 0.15
_FIRST_GAP = 1e-2  # of a bound over the norm, at which they are compared


def exact_match(problem, fit):
    """The match solved to rounding, and whether it is exact, by the residuals."""
    if fit.residual > NEAR:
        return fit, False
    theta, residual = solve_similarity(problem, fit.theta)
    inside = problem.inside(theta)
    kept = np.allclose(inside, theta, rtol=PRECISION, atol=0.0)
    if residual <= PRECISION and kept and problem.abscissa(inside) < 0:
        error = linalg.norm(problem.residual_and_jacobian(inside)[0])
        return replace(fit, theta=inside, residual=float(error)), True
    return fit, bool(fit.residual <= PRECISION)


def _result(problem, fit, fits, exact, start=None, descent=None):
    """The result in the user's units."""
    start = fit if start is None else start
    history = tuple(("least squares", residual) for residual in start.history or fit.history)
    theta, n_iter = start.theta, sum(each.n_iter for each in fits)
    predicted, certificate = 0.0 if exact else fit.promised, None
    left, tolerance = predicted, TOLERANCE
    if descent is not None:
        theta, certificate, n_iter = descent.theta, descent.certificate, n_iter + descent.n_iter
        history += tuple(("minimax", value) for value in descent.history)
        predicted, left, tolerance = descent.predicted_decrease, descent.ratio - 1.0, GAP
        if predicted > _CERTIFIED:  # t is down, but no minimum
            left, tolerance = predicted, _CERTIFIED
    value, peak = problem.peak(theta)
    singular_values, unidentified = problem.identifiability(theta)
    return MatchResult(
        theta,
        *problem.structure.matrices(theta),
        hinf_error=value * problem.unit,
        relative_error=value,
        peak_frequency=peak,
        theta_least_squares=fit.theta,
        feedthrough_floor=problem.feedthrough_floor() * problem.unit,
        exact=exact,
        converged=bool(left <= tolerance),
        predicted_decrease=float(predicted),
        left=float(left),
        certificate=certificate,
        n_iter=n_iter,
        history=history,
        tolerance=tolerance,
        singular_values=singular_values,
        unidentified=unidentified,
    )


def least_norm(problem, fits, starts, max_iter):
    """Least norm in reach of some matches: where the way began, and its descent.

    The ranking by squares is not the ranking by peaks, so the match best in squares and
    those best in peaks go down, first but a part of the way; the lowest goes on. Among them
    are starts as they were: where squares lead to infinity, they do not.
    """
    problem = problem.limited(fits[0].theta, _RUNAWAY)
    others = [(problem.peak(fit.theta)[0], fit) for fit in fits[1:]]
    others += [(problem.peak(theta)[0], GridFit(theta, np.inf, np.inf, ())) for theta, _ in starts]
    others = [each for each in others if np.isfinite(each[0])]
    others.sort(key=lambda each: each[0])
    ways = [fits[0], *(fit for _, fit in others[:2])]  # two more go down
    descents = [
        smooth_descent(problem, fit.theta, gap=_FIRST_GAP, max_iter=max_iter) for fit in ways
    ]
    best = min(range(len(ways)), key=lambda k: descents[k].value)
    return ways[best], descents[best].further(problem, max_iter)


def starting_points(problem, theta0, n_starts, random_state):
    """Starts within the bounds in the order of their promise, made as they are asked for.

    The closed form; theta0; changes of state that agree with C_s, first as the states at
    theta0 suggest, then at random; where C_s leaves no choice, the first start shaken
    by half.
    With each, whether it is near (:func:`~sklearn_hd.algorithms.matching.least_squares.fit_from`).
    """
    if problem.structure.n_parameters == 0:
        yield np.empty(0), True
        return
    first = theta0
    transformation = output_transformation(problem)
    if transformation is not None:
        projected = problem.inside(project_transformed(problem, transformation))
        first = projected if first is None else first
        yield projected, True
    if theta0 is not None:
        yield theta0, False
        if problem.abscissa(theta0) < 0:  # else the same again, which would count as found twice
            yield theta0, True
    if first is None:  # the parameters nearest to states that decay fast and move nothing
        n, plain = problem.structure.n_states, np.zeros_like(problem.structure.constant)
        plain[:n, :n] = -problem.fastest * np.eye(n)
        plain[n:, n:] = problem.model.matrices(np.empty(0))[3]
        yield problem.inside(problem.structure.project(plain)[0]), False
    random = np.random.default_rng(random_state)
    for k in range(n_starts):
        transformation = draw_transformation(problem, theta0, random, spread=float(k > 0))
        if transformation is not None:
            drawn = project_transformed(problem, transformation)
            yield problem.inside(drawn), k % 2 == 0
        elif first is not None:
            shaken = first * (1.0 + random.uniform(-0.5, 0.5, len(first)))
            yield problem.inside(shaken), k % 2 == 1
