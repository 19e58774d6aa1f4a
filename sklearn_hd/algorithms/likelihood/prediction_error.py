"""Maximum likelihood of parameters from measured outputs, by simulations or by predictions.

The output-error method: all noise is that of the sensors, white, normal, of deviation σ_i,

    y[k] = ŷ[k; θ, x0] + e[k],   −log L = Σ_i N_i/2 (log 2πσ_i²) + Σ_i RSS_i / (2σ_i²)

With the σ_i unknown, σ_i² = RSS_i / N_i at the optimum, which leaves min Σ_i N_i/2 log RSS_i.

The prediction-error method: what shakes the machine itself has a gain, in the innovations form

    x[k+1] = Φ_k x[k] + Γ_k u[k] + K(ψ_k) e[k],   y[k] = C_k x[k] + D_k u[k] + e[k]
    −log L = ½ N log det (Σ e eᵀ / N) + const

K is a Fourier series whose number of harmonics has the least of Akaike's criterion. Without K at
all it is the output error method; where no process noise is, K tends to a predictor that forgets
nothing, and takes a lasting pattern of the noise out: to have one at all has to win by Schwarz's
criterion. The first K is that of a Kalman filter: noise that moves the states so that outputs
answer alike, of the size that leaves the most likely innovations.

References: R. K. Mehra, "Identification of stochastic linear dynamic systems using Kalman filter
representation", AIAA J. 9 (1971); R. V. Jategaonkar, *Flight Vehicle System Identification*, 2006,
chapter 4; L. Ljung, *System Identification*, 1999, sections 4.3 and 7.4; T. McKelvey,
A. Helmersson, T. Ribarits, "Data driven local coordinates for multivariable linear systems and
their application to system identification", Automatica 40 (2004).
"""

from dataclasses import replace

import numpy as np

from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.likelihood.noisy_inputs import with_noisy_inputs
from sklearn_hd.algorithms.likelihood.search import (
    OverflowingStartError,
    cost_of_start,
    result_of,
    search,
    start,
)
from sklearn_hd.algorithms.linalg.rounding import HALF
from sklearn_hd.algorithms.periodic.periodic_structure import functions_of_turn

RATIOS = 10.0 ** np.arange(-8, 3, 2)  # of noise in states and outputs, in parts of their size
MOST_TURNS = 400  # of the Riccati equation


def output_error_of(
    form,
    segments,
    theta0,
    *,
    sigma=None,
    input_sigma=None,
    bounds=None,
    max_iter=50,
    tol=1e-8,
):
    """Parameters of largest likelihood for measured outputs of a periodic system.

        min Σ_i N_i/2 log RSS_i(θ, x0)

    Segments are (inputs, outputs, where), as :func:`~.predictor.as_records` takes them. Noise
    of unknown ``sigma`` (l,) is estimated; with ``input_sigma`` (m,), that of the measured
    inputs, which the system does not feel, least squares are total ones. The last step promises
    a fall of less than tol, relative to the sum of squares: it begins within √(tol N) standard
    deviations of the optimum.

    Examples
    --------
    The rate of a lag from its step response, without noise:

    >>> from sklearn_hd.algorithms.likelihood.forms import Form
    >>> from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
    >>> lag = PeriodicStructure(np.array([[[0.0, 1.0], [1.0, 0.0]]]),
    ...                         np.array([[[[-1.0, 0.0], [0.0, 0.0]]]]), 1, ("rate",))
    >>> u, t = np.ones((50, 1)), 0.1 * np.arange(50)
    >>> y = (1 - np.exp(-2.0 * t[:, None])) / 2.0
    >>> result = output_error_of(Form(lag, 2 * np.pi, 10), [(u, y, 0)], [1.0])
    >>> bool(np.isclose(result.theta[0], 2.0, rtol=1e-13))
    True
    """
    problem = likelihood_problem(form, segments, sigma)
    point = start(problem, theta0)
    options = {"max_iter": max_iter, "tol": tol, "keep_stable": True, "bounds": bounds}
    found = search(problem, point, **options)
    if input_sigma is None:
        return result_of(problem, found)
    return with_noisy_inputs(problem, found, input_sigma, options)


def prediction_error(form, segments, theta0, *, bounds=None, max_iter=50, tol=1e-8):
    """Parameters and Kalman gain of largest likelihood, K of as many harmonics as the data show.

    The form's own number of harmonics of K does not count; that of the result's problem is the one
    found. Segments are as for :func:`~.predictor.as_records`, bounds a pair of ndarray (k,).
    """
    settings = {"bounds": bounds, "max_iter": max_iter, "tol": tol}
    first, gain = first_gain(form, segments, theta0)
    best = fit_gain(form.with_gain(first), segments, theta0, gain, **settings)
    theta = best.without_gain
    without = form.with_gain(None)
    if without.radius(without.response(theta, sensitivities=False)) < 1.0:
        simulated = fit_gain(without, segments, theta, None, **settings)
        if simulated.bic <= best.bic:
            return simulated
    if not best.converged:  # more harmonics would not be judged
        return best
    for counts in (range(first + 1, most_harmonics(form) + 1), range(first - 1, -1, -1)):
        for count in counts:
            theta, gain = best.without_gain, best.gain
            if count < first:
                gain = first_gain(form, segments, theta, gain, [count])[1]
            try:
                found = fit_gain(form.with_gain(count), segments, theta, gain, **settings)
            except OverflowingStartError:
                break  # no gain of so few harmonics has a stable predictor
            if found.aic >= best.aic or not found.converged:
                break
            best = found
        if best.problem.form.n_gain_harmonics > first:
            break
    return best


def fit_gain(form, segments, theta0, gain0, *, bounds=None, max_iter=50, tol=1e-8):
    """The same with a number of harmonics of K that is the form's; zero beyond those given."""
    wider = np.zeros(form.n_gains)
    if gain0 is not None:
        known = np.ravel(gain0)[: len(wider)]
        wider[: len(known)] = known
    problem = likelihood_problem(form, segments, correlated=True)
    if bounds is not None:
        wide = np.full(form.n_gains, np.inf)
        bounds = np.append(bounds[0], -wide), np.append(bounds[1], wide)
    point = start(problem, np.concatenate([theta0, wider]))
    found = search(problem, point, bounds=bounds, max_iter=max_iter, tol=tol, keep_stable=True)
    return result_of(problem, found)


def most_harmonics(form):
    """Highest harmonic of K to be tried."""
    if not any(form.structure.varies) and form.observe is None:
        return 0
    return min(4, int(np.ceil(form.n_phases / 2.0)) - 1)  # harmonics of K


def first_gain(form, segments, theta0, gain0=None, counts=None):
    """Number of harmonics and coefficients of K: of several Kalman filters', the most likely.

    Akaike's criterion decides between them. Of a gain that is cut to fewer harmonics the predictor
    may be unstable: where it overflows, it is the least likely.
    """
    own = form.with_gain(None).response(theta0, sensitivities=False)
    problem = likelihood_problem(form.with_gain(0), segments, correlated=True)
    highest, best = most_harmonics(form), (np.inf, None, None)
    counts = range(highest + 1) if counts is None else counts
    coefficients = [] if gain0 is None else [gain0]
    for ratio in RATIOS:
        gain = _filter_gains(form, own, problem.size, ratio)
        most = min(highest, (len(gain) - 1) // 2)
        functions = functions_of_turn(len(gain), form.n_phases, most)
        coefficients.append(np.tensordot(np.linalg.pinv(functions), gain, 1))
    for gain in coefficients:
        for count in [count for count in counts if 2 * count < len(gain)]:
            problem = replace(problem, form=form.with_gain(count))
            some = gain[: 2 * count + 1]
            cost = cost_of_start(problem, np.concatenate([theta0, some.ravel()])) + some.size
            best = min(best, (cost, count, some), key=lambda one: one[0])
    return best[1:]


def _filter_gains(form, response, size, ratio):
    """Gains over a turn of the Kalman filter for noise of some size in the states."""
    n = form.n_states
    Phi, C = (form.through(M) for M in (response.Phi, response.Out[..., :n] / size[:, None]))
    count = max(len(Phi), len(C))
    Phi, C = (np.broadcast_to(M, (count, *M.shape[1:])) for M in (Phi, C))
    Q = ratio * _answering_alike(Phi, C)
    R, P, before, gains = np.eye(len(size)), Q, None, np.zeros((count, n, len(size)))
    for _ in range(max(2, MOST_TURNS // form.turns[1])):
        for k in range(count):
            spread = C[k] @ P @ C[k].T + R
            gains[k] = Phi[k] @ np.linalg.solve(spread, C[k] @ P).T
            P = Phi[k] @ P @ Phi[k].T + Q - gains[k] @ spread @ gains[k].T
            P = 0.5 * (P + P.T)
        if before is not None and np.max(np.abs(P - before)) <= HALF * np.max(np.abs(P)):
            break
        before = P
    return gains / size


def _answering_alike(Phi, C):
    """Covariance of states to which outputs answer alike, whatever their direction."""
    n, count = Phi.shape[1], max(len(Phi), 2 * Phi.shape[1])
    gramian, M = np.zeros((n, n)), np.eye(n)
    for k in range(count):
        seen = C[k % len(C)] @ M
        gramian += seen.T @ seen / count
        M = Phi[k % len(Phi)] @ M
    values, vectors = np.linalg.eigh(gramian)
    values = np.maximum(values, HALF * values[-1])
    return (vectors / values) @ vectors.T
