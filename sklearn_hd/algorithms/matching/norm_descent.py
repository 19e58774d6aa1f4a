"""The least H∞ norm in reach of some least-squares matches: which valleys, and their ground."""

import itertools
from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed, effective_n_jobs
from scipy import linalg

from sklearn_hd.algorithms.matching.minimax import MinimaxResult, minimise_peak
from sklearn_hd.algorithms.matching.peak_newton import newton_descent
from sklearn_hd.algorithms.matching.smooth_peak import smooth_descent
from sklearn_hd.algorithms.reporting import stage

__all__ = ["least_norm"]

_RUNAWAY = 1e8  # times the fastest pole: an error within 1e-7 or so of that with a feedthrough
_FIRSTS = (3.0, 1.5, 10.0)  # bounds, over the norm, where smooth descents begin
_SMALL = 200  # parameters times states up to which all of them cost a second or two
_LARGE = 1000  # from which a convex step costs a second, and the last digits minutes
_SMOOTH = 0.6  # Newton steps of a first descent, over the largest number of iterations
_TURNS = 2  # of smooth descents to the ground
_DEEP = 10  # of a descent to the ground, over the convex steps there
_NEWTON = 3  # steps on single peaks, over the convex steps that go on where they do not end
_RIVAL = 1.02  # norm, relative to the lowest, from which a run may still end lowest
_CLOSE = 1.001  # bound, over the norm, where further descents begin
_GROUND = 1e-4  # relative distance of its bound from the norm, where a descent ends
_ABOVE = 1e-4  # of another's end, from where nothing lower is found any more
_VALLEY = 0.1  # distance of responses, relative to the error, within one valley
_CREEP = 1e-6, 1e-4  # of the norm that a round of steps must earn; in a large structure
_SCREENING = 20  # convex steps of a round


def least_norm(problem, fits, max_iter, tol, n_jobs=None, report=None):
    """Least norm reached from the least-squares matches, by several ways into the valleys.

    The ranking by squares is not the ranking by peaks, so the match best in squares and
    those best in peaks go down in smooth bounds of the norm; where such a descent begins
    decides on the valley, so the first has several. Those that come near the lowest go on
    to the ground, where steps in the norm itself end and certify.

    Parameters
    ----------
    problem : MatchingProblem
    fits : list of GridFit
        The best first.
    max_iter : int
        Largest number of convex steps.
    tol : float
        As :func:`minimise_peak` has it.
    n_jobs : int, optional
        Descents at once, in processes of their own; the result is the same.
    report : callable, optional
        As :func:`match_structure` has it.

    Returns
    -------
    start : GridFit
        Where the way began.
    run : MinimaxResult
        Where it ended, with the norms on the whole way.
    """
    problem = problem.limited(fits[0].theta, _RUNAWAY)
    size = problem.structure.n_parameters * problem.structure.n_states
    ways = _ways(problem, fits, small=size <= _SMALL)
    descents = _first_descents(problem, ways, round(_SMOOTH * max_iter) or 1, n_jobs, report)
    near = sorted(range(len(descents)), key=lambda k: descents[k].value)
    near = near[: 2 if size <= _SMALL else 1]
    lowest = descents[near[0]].value
    near = [k for k in near if descents[k].value <= _RIVAL * lowest]
    n_steps = min(_SCREENING, max_iter)
    runs = _runs(problem, {k: descents[k] for k in near}, n_steps, tol, report)
    best = min(runs, key=lambda k: runs[k].value)
    run, passed = runs[best], descents[best].history + runs[best].history[1:]
    n_left, creeps = max_iter - n_steps, False
    while not (run.converged or creeps) and n_left > 0:
        before, n_steps = run.value, min(_SCREENING, n_left)
        told = stage(report, "minimax, steps from the best", _most(n_steps))
        run = _to_the_ground(problem, run.theta, _CLOSE, n_steps, tol, told)
        creeps = run.value > (1.0 - _CREEP[size > _LARGE]) * before
        passed += run.history[1:]
        n_left -= n_steps
    return ways[best][0], replace(run, history=passed)


def _ways(problem, fits, small):
    """Matches to start from, and bounds, over the norm, where their descents begin."""
    firsts, n_others = (_FIRSTS, 3) if small else (_FIRSTS[:2], 1)
    others = sorted(fits[1:], key=lambda fit: problem.peak(fit.theta)[0])[:n_others]
    return [(fits[0], first) for first in firsts] + [(fit, _FIRSTS[0]) for fit in others]


def _first_descents(problem, ways, max_iter, n_jobs, report):
    """Smooth descents in the order of the ways, all at once, or in batches that are told of."""
    tasks = (
        delayed(smooth_descent)(problem, fit.theta, first=first, max_iter=max_iter)
        for fit, first in ways
    )
    told = stage(report, "minimax, smooth descents", len(ways))
    size, descents = len(ways) if told is None else effective_n_jobs(n_jobs), []
    while len(descents) < len(ways):
        descents += Parallel(n_jobs)(itertools.islice(tasks, size))
        if told is not None:
            told(len(descents), f"error {min(each.value for each in descents):.3g}")
    return descents


def _runs(problem, descents, n_steps, tol, report):
    """Ways from some descents to the ground, by number; none twice in one valley.

    A run that converged speaks for all points of its valley: over twenty seeds no second
    one, from a response as near as that, ended elsewhere.
    """
    runs, errors, lowest = {}, {}, np.inf
    for count, (k, start) in enumerate(descents.items()):
        error = problem.residual_and_jacobian(start.theta)[0]
        near = _VALLEY * linalg.norm(error)
        if any(runs[i].converged and linalg.norm(error - errors[i]) <= near for i in runs):
            continue
        name = f"minimax, steps from descent {count + 1} of {len(descents)}"
        told = stage(report, name, _most(n_steps))
        runs[k] = _to_the_ground(problem, start.theta, start.ratio, n_steps, tol, told, lowest)
        lowest, errors[k] = min(lowest, runs[k].value), error
    return runs


def _to_the_ground(problem, theta, first, n_steps, tol, told, lowest=np.inf):
    """Steps on single peaks and smooth descents by turns, unless one ends above the lowest.

    Convex steps where the turns do not converge.
    """
    most = _NEWTON * n_steps
    run = newton_descent(problem, theta, max_iter=most, tol=tol, report=told)
    passed, n_done = run.history, run.n_iter
    for bound in (first, *[_CLOSE] * _TURNS)[:_TURNS]:
        if run.converged:
            return replace(run, history=passed)
        n_deep = _DEEP * n_steps
        descent = smooth_descent(problem, run.theta, first=bound, gap=_GROUND, max_iter=n_deep)
        passed += descent.history[1:]
        if descent.value > (1.0 + _ABOVE) * lowest:
            return MinimaxResult(descent.theta, descent.value, np.inf, False, passed, 0)
        after = _after(told, n_done)
        run = newton_descent(problem, descent.theta, max_iter=most, tol=tol, report=after)
        passed, n_done = passed + run.history[1:], n_done + run.n_iter
    if not run.converged:
        after = _after(told, n_done)
        run = minimise_peak(problem, run.theta, max_iter=n_steps, tol=tol, report=after)
        passed += run.history[1:]
    return replace(run, history=passed)


def _most(n_steps):
    """Steps in the norm that a way to the ground can have."""
    return (1 + _TURNS) * _NEWTON * n_steps + n_steps


def _after(told, n_done):
    """The callback of steps that come after others; None stays None."""
    return told and (lambda done, note: told(n_done + done, note))
