"""How well parameters can be known, and what follows from them.

The Fisher matrix of y[k] = ŷ[k; θ, x0] + e[k], e_i white and normal, is JᵀΣ⁻¹J; no
unbiased estimate has a smaller covariance than its inverse (Cramér and Rao). Functions of
θ inherit their covariance to first order. An interval of confidence is θ ± z θ_std.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.likelihood import Point, likelihood_problem
from sklearn_hd.algorithms.periodic.floquet import monodromy_exponents, on_branch
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_structure import sampled_response

STEP = 1e-6  # of parameters, where exponents are differenced


@dataclass(frozen=True, eq=False)
class FisherInformation:
    """What records can tell of parameters.

    Attributes
    ----------
    information : ndarray, shape (k, k)
        Fisher matrix of θ, the initial states eliminated where they are unknown.
    covariance : ndarray, shape (k, k)
        Its inverse, the Cramér-Rao bound; infinite on the diagonal and NaN off it for
        parameters that are not identified.
    unidentified : tuple of str
    """

    information: np.ndarray
    covariance: np.ndarray
    unidentified: tuple

    @property
    def theta_std(self):
        """Smallest standard deviation of an unbiased estimate of each parameter."""
        return np.sqrt(np.diag(self.covariance))


def fisher_information(
    structure,
    theta,
    segments,
    omega,
    n_phases,
    sigma,
    *,
    observe=None,
    free_initial_state=True,
    x0=None,
):
    """Fisher matrix and Cramér-Rao bound of the parameters of a periodic system.

        I = Σ_k (∂ŷ[k]/∂θ)ᵀ Σ⁻¹ (∂ŷ[k]/∂θ),   Σ = diag(σ_i²)

    Parameters
    ----------
    structure : PeriodicStructure
    theta : array_like, shape (k,)
        Where to take it: the truth for the bound.
    segments : list of (inputs, outputs, first_phase)
        As for :func:`sklearn_hd.algorithms.likelihood.output_error.output_error_of`; outputs only
        tell by NaN which samples are missing, and may be None.
    omega : float
        Fundamental frequency, rad/s.
    n_phases : int
        Samples a period.
    sigma : array_like, shape (l,)
        Standard deviations of the outputs' noise.
    observe : ndarray, shape (n_phases, l, l_model), optional
    free_initial_state : bool, default=True
        Whether the initial states are unknown.
    x0 : array_like, shape (n_segments, n), optional
        True initial states, zero by default.

    Returns
    -------
    information : FisherInformation

    References
    ----------
    L. Ljung, *System Identification*, 1999, section 9.3 and Eq. 7.91.

    Examples
    --------
    The gain of a static system, of input 1, over 4 samples: σ / √4.

    >>> from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
    >>> gain = PeriodicStructure(np.zeros((1, 2, 2)), [[[[0.0, 0.0], [0.0, 1.0]]]], 1, ["gain"])
    >>> bound = fisher_information(gain, [2.0], [(np.ones((4, 1)), None, 0)], 1.0, 8, [0.1])
    >>> float(bound.theta_std[0])
    0.05
    """
    form, theta = Form(structure, omega, n_phases, observe), np.asarray(theta, dtype=float)
    starts = np.zeros((len(segments), structure.n_states)) if x0 is None else np.asarray(x0, float)
    return information_of(form, theta, segments, sigma, free_initial_state, starts)


def information_of(form, theta, segments, sigma, free_initial_state=True, x0=None):
    """The same of a form, at any clock."""
    problem = likelihood_problem(form, segments, free_initial_state)
    starts = np.zeros((len(segments), form.n_states)) if x0 is None else x0
    point = Point(theta, starts, None, 0.0, 0.0)
    system = problem.linearise(point, np.diag(np.asarray(sigma, dtype=float) ** 2))
    covariance, unknown = system.covariance()
    J = system.R[:, :-1]
    names = form.structure.parameter_names
    names = tuple(name for name, bad in zip(names, unknown, strict=True) if bad)
    return FisherInformation(J.T @ J, covariance, names)


def propagate_std(jacobian, covariance):
    """Standard deviations of functions f(θ) to first order, √diag(J C Jᵀ).

    Parameters
    ----------
    jacobian : array_like, shape (..., k)
        ∂f/∂θ, real or complex.
    covariance : ndarray, shape (k, k)
        Of θ; infinite and NaN for parameters that are not identified.

    Returns
    -------
    std : ndarray, shape (...,)
        Infinite where f depends on a parameter that is not identified. For a complex
        jacobian complex: of the real part + j times that of the imaginary part.

    Examples
    --------
    >>> propagate_std([[1.0, 1.0], [0.0, 2.0]], np.diag([9.0, 16.0])).tolist()
    [5.0, 8.0]
    """
    jacobian = np.asarray(jacobian)
    if np.iscomplexobj(jacobian):
        std = np.empty(jacobian.shape[:-1], dtype=complex)  # 1j times infinity would be NaN
        std.real = propagate_std(jacobian.real, covariance)
        std.imag = propagate_std(jacobian.imag, covariance)
        return std
    unknown = ~np.isfinite(np.diag(covariance))
    known = np.where(unknown[:, None] | unknown, 0.0, covariance)
    variance = np.einsum("...i,ij,...j->...", jacobian, known, jacobian)
    depends = np.any(jacobian[..., unknown] != 0, axis=-1)
    return np.where(depends, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def exponent_slopes(form, parameters):
    """Floquet exponents of a form, and their derivatives by the parameters of its structure.

        λ = log(μ)/T,   ∂μ/∂θ = wᴴ ∂M/∂θ v / (wᴴ v)

    with left and right eigenvectors w and v of the monodromy matrix M.

    Parameters
    ----------
    form : Form
        At any clock, in continuous time or of steps.
    parameters : ndarray
        θ; others after it do not count.

    Returns
    -------
    exponents : complex ndarray, shape (n,)
        In 1/s, from the rightmost leftwards. Their imaginary parts are known up to
        multiples of ω, or up to the sampling frequency if F is constant.
    slopes : complex ndarray, shape (n, k)
        Not finite for repeated exponents, which have no derivative.
    """
    if form.discrete and form.n_points is not None and form.structure.varies[0]:
        return _slopes_of_longer_steps(form, np.asarray(parameters, dtype=float))
    if form.discrete:
        response = form.with_gain(None).response(parameters, sensitivities=True)
        frequency = form.omega * form.n_phases / len(response.Psi)
    else:
        theta, n_phases = parameters[: form.structure.n_parameters], int(np.ceil(form.n_phases))
        response = sampled_response(form.structure, theta, form.omega, n_phases)
        frequency = form.omega * n_phases / len(response.Psi)
    exponents = monodromy_exponents(response.monodromy, frequency)
    multipliers, left, right = linalg.eig(response.monodromy, left=True)
    own = [np.argmin(np.abs(multipliers - mu)) for mu in np.exp(exponents * 2 * np.pi / frequency)]
    left, right, multipliers = left[:, own], right[:, own], multipliers[own]
    slopes = np.einsum("ie,kij,je->ek", left.conj(), _monodromy_derivative(response), right)
    with np.errstate(divide="ignore", invalid="ignore"):
        slopes = slopes / (np.sum(left.conj() * right, axis=0) * multipliers)[:, None]
    return exponents, slopes * frequency / (2 * np.pi)


def _slopes_of_longer_steps(form, parameters):
    """The same of steps of which a turn holds no whole number, by central differences."""
    structure, found = form.structure, []
    theta, gain = parameters[: structure.n_parameters], np.zeros((1, form.n_states, form.n_outputs))

    def exponents_at(theta):
        M = np.pad(structure.coefficients(theta), [(0, 0), (0, 0), (0, 1)])
        step, noise = 2.0 * np.pi / form.n_phases, np.eye(form.n_outputs)
        logarithms = PeriodicInnovations(M, gain, noise, step).multiplier_logarithms()
        return on_branch(logarithms * form.omega / (2.0 * np.pi), form.omega)

    exponents = exponents_at(theta)
    for k in range(len(theta)):
        step = STEP * max(1.0, abs(theta[k])) * (np.arange(len(theta)) == k)
        gaps = []
        for moved in (exponents_at(theta + step), exponents_at(theta - step)):
            gap = moved - exponents[:, None]
            gap = gap - 1j * form.omega * np.round(gap.imag / form.omega)
            gaps.append(gap[np.arange(len(gap)), np.argmin(np.abs(gap), axis=1)])
        found.append((gaps[0] - gaps[1]) / (2.0 * step[k]))
    return exponents, np.array(found).reshape(len(theta), len(exponents)).T


def _monodromy_derivative(response):
    """∂M/∂θ, shape (k, n, n), by the product rule."""
    n = response.n_states
    product, derivative = np.eye(n), np.zeros((len(response.dPsi), n, n))
    for Phi, dPsi in zip(response.Phi, np.swapaxes(response.dPsi, 0, 1), strict=True):
        derivative = dPsi[:, :, :n] @ product + Phi @ derivative
        product = Phi @ product
    return derivative
