"""Maximum likelihood of parameters from measured outputs: the output-error method.

    y[k] = ŷ[k; θ, x0] + e[k],   e_i white, normal, of standard deviation σ_i
    −log L = Σ_i N_i/2 (log 2πσ_i²) + Σ_i RSS_i / (2σ_i²)

With the σ_i unknown, σ_i² = RSS_i / N_i at the optimum, which leaves
min Σ_i N_i/2 log RSS_i: weighted least squares whose weights follow the residuals, solved
by Gauss-Newton steps that are damped (Levenberg-Marquardt) while they do not pay. The
initial state of each record enters linearly and is eliminated from each step.

References: R. K. Mehra, "Identification of stochastic linear dynamic systems using Kalman
filter representation", AIAA J. 9 (1971); R. V. Jategaonkar, *Flight Vehicle System
Identification*, 2006, chapter 4.
"""

from dataclasses import replace

import numpy as np

from sklearn_hd.algorithms.likelihood.likelihood import likelihood_problem
from sklearn_hd.algorithms.likelihood.noisy_inputs import noisy_input_problem
from sklearn_hd.algorithms.likelihood.search import Search, result_of, search, start

SETTLED = 1e-3  # relative change of noise levels; far below their own error
SMALLEST_SHARE = 1e-3  # of the residual that is left to the output's own noise


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
    return _with_noisy_inputs(problem, found, input_sigma, options)


def _with_noisy_inputs(problem, found, input_sigma, options):
    """Total least squares from where least squares ended, the outputs' noise in turn with it."""
    sigma = np.sqrt(np.diag(problem.spread(found.point.moments)))
    n_iter, settled = found.n_iter, False
    smallest = SMALLEST_SHARE * sigma
    for _ in range(options["max_iter"]):
        noisy = noisy_input_problem(problem, sigma, input_sigma)
        begin = noisy.point(found.point.theta, found.point.x0)
        found = search(noisy, begin, **options)
        n_iter += found.n_iter
        if problem.sigma is not None:
            settled = True
            break
        old, sigma = sigma, np.maximum(noisy.updated_output_sigma(found.point), smallest)
        settled = bool(np.all(np.abs(sigma - old) <= SETTLED * old))
        if settled:
            break
    found = Search(found.point, n_iter, found.converged and settled)
    result = result_of(noisy, found)
    return replace(
        result,
        spread=np.diag(sigma**2),
        cost=noisy.likelihood(found.point),
        n_parameters=result.n_parameters + (len(sigma) if problem.sigma is None else 0),
    )
