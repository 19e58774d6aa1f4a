"""How well parameters can be known, and what follows from them.

The Fisher matrix of y[k] = ŷ[k; θ, x0] + e[k], e_i white and normal, is JᵀΣ⁻¹J; no
unbiased estimate has a smaller covariance than its inverse (Cramér and Rao). Functions of
θ inherit their covariance to first order. An interval of confidence is θ ± z θ_std.

Deviations that hold where what a fit leaves is no white noise, or the system not linear.

At the optimum θ̂ the scores s_c = −J_cᵀ r_c of some parts c of the record sum to zero. White noise
gives them the covariance of the information I_c = J_cᵀ J_c that the parts hold. For one quantity
λ = gᵀθ, with v = I⁻¹ g, a part by itself would put λ at

    λ̂_c = λ̂ + (vᵀ s_c) gᵀv / (vᵀ I_c v)     ± gᵀv / √(vᵀ I_c v),

and λ̂ is their mean, weighed by vᵀ I_c v. Of blocks in time the scores themselves give the
covariance, whatever colours the noise (the sandwich I⁻¹ Σ s_b s_bᵀ I⁻¹). Of parts that differ in
the size or the direction of the motion they tell whether one linear model holds for all: where
they differ by more than their deviations, their spread is that of λ (DerSimonian and Laird, 1986).

References: H. White, "Maximum likelihood estimation of misspecified models", Econometrica 50
(1982); W. K. Newey, K. D. West, "A simple, positive semi-definite, heteroskedasticity and
autocorrelation consistent covariance matrix", Econometrica 55 (1987).
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.ndimage import uniform_filter1d
from scipy.stats import chi2

from sklearn_hd.algorithms.likelihood.likelihood import Point, likelihood_problem
from sklearn_hd.algorithms.periodic.floquet import on_branch
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_structure import sampled_response

N_BLOCKS = 40  # of a record, in time
LEVELS = 3  # of the size of the motion, of which each holds as much of its square
FEWEST = 10  # rows of a block


@dataclass(frozen=True, eq=False)
class FisherInformation:
    """What records can tell of parameters."""

    information: np.ndarray  # (k, k): Fisher matrix of θ, the initial states eliminated
    # (k, k): its inverse, the Cramér-Rao bound; infinite on the diagonal and NaN off it for
    # parameters that are not identified
    covariance: np.ndarray
    unidentified: tuple  # of str


def fisher_information(form, theta, segments, sigma):
    """Fisher matrix and Cramér-Rao bound of the parameters of a periodic system.

        I = Σ_k (∂ŷ[k]/∂θ)ᵀ Σ⁻¹ (∂ŷ[k]/∂θ),   Σ = diag(σ_i²)

    about rest, the initial states unknown, at θ (the truth for the bound). Outputs of the
    segments (inputs, outputs, where) may be None (Ljung, *System Identification*, 1999,
    section 9.3 and Eq. 7.91).

    Examples
    --------
    The gain of a static system, of input 1, over 4 samples: σ / √4.

    >>> from sklearn_hd.algorithms.likelihood.forms import Form
    >>> from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
    >>> gain = PeriodicStructure(np.zeros((1, 2, 2)), [[[[0.0, 0.0], [0.0, 1.0]]]], 1, ["gain"])
    >>> record = [(np.ones((4, 1)), None, 0)]
    >>> bound = fisher_information(Form(gain, 1.0, 8), [2.0], record, [0.1])
    >>> round(float(np.sqrt(bound.covariance[0, 0])), 12)
    0.05
    """
    problem = likelihood_problem(form, segments)
    starts = np.zeros((len(segments), form.n_states))
    point = Point(np.asarray(theta, dtype=float), starts, None, 0.0, 0.0)
    system = problem.linearise(point, np.diag(np.asarray(sigma, dtype=float) ** 2))
    covariance, unknown = system.covariance()
    J = system.R[:, :-1]
    names = form.structure.parameter_names
    names = tuple(name for name, bad in zip(names, unknown, strict=True) if bad)
    return FisherInformation(J.T @ J, covariance, names)


def propagate_std(jacobian, covariance):
    """Standard deviations of functions f(θ) to first order, √diag(J C Jᵀ).

    ``jacobian`` (..., k) is ∂f/∂θ, real or complex. ``covariance`` (k, k) of θ is
    infinite and NaN for parameters that are not identified, and the result is infinite
    where f depends on one. That of a complex jacobian is complex: the deviation of the
    real part + j times that of the imaginary part.

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

    with left and right eigenvectors w and v of the monodromy matrix M, in which multipliers more
    than some ten decades below the largest are lost.

    ``form`` is at any clock, in continuous time or of steps. Parameters after θ do not
    count. The exponents (n,) are in 1/s, from the rightmost leftwards. Their imaginary
    parts are known up to multiples of ω, or up to the sampling frequency if F is
    constant. The slopes (n, k) are not finite for repeated exponents, which have no
    derivative.
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
    multipliers, left, right = linalg.eig(response.monodromy, left=True)
    logarithms = np.log(multipliers.astype(complex))
    exponents = on_branch(logarithms * frequency / (2.0 * np.pi), frequency)
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
        step = 1e-6 * max(1.0, abs(theta[k])) * (np.arange(len(theta)) == k)
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


@dataclass(frozen=True, eq=False)
class Parts:
    """Scores and information of the parts of a record."""

    scores: np.ndarray  # (c, k)
    information: np.ndarray  # (c, k, k)

    def sandwich(self, covariance):
        """Covariance of θ from the scores of blocks in time, neighbours at half their weight."""
        s = self.scores - self.scores.mean(axis=0)
        beside = 0.5 * s[1:].T @ s[:-1]
        meat = (s.T @ s + beside + beside.T) * len(s) / max(1, len(s) - 1)
        return covariance @ meat @ covariance

    def compared(self, covariance, gradients, excess):
        """Comparison of what the parts would have some quantities be, against each other.

        ``covariance`` (k, k) is that of θ if white noise is left. The quantities have
        ``gradients`` (r, k), and ``excess`` (r,) is their variance in parts of that of
        white noise.
        """
        v = gradients @ covariance
        size = np.einsum("rk,rk->r", v, gradients)
        told = np.einsum("rk,ckj,rj->rc", v, self.information, v)
        pull, total = v @ self.scores.T, told.sum(axis=1)
        pull -= told * (pull.sum(axis=1) / np.where(total > 0.0, total, np.inf))[:, None]
        weight = np.where(told > 0.0, told, np.inf)
        statistic = np.sum(pull**2 / weight, axis=1) / excess
        degrees = max(1, len(self.scores) - 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = excess * (statistic - degrees) * size**2
            spread = spread / (total - np.sum(told**2, axis=1) / total)
        spread = np.where(np.isfinite(spread), np.maximum(spread, 0.0), 0.0)
        return Comparison(pull * size[:, None] / weight, spread, chi2.sf(statistic, degrees))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Quantities as the parts of a record tell them."""

    offsets: np.ndarray  # (r, c): from the estimate of all
    variance: np.ndarray  # (r,): between the parts, beyond what noise explains
    p_value: np.ndarray  # (r,)


def part_scores(result, divisions):
    """Parts by the name of each of several divisions of a record: their scores and information.

    Each of ``divisions`` has the part of each row (int) of each record.
    """
    problem, point, system = result.problem, result.point, result.system
    width = system.R.shape[1]
    sums = {
        name: np.zeros((1 + max(int(part.max()) for part in parts), width, width))
        for name, parts in divisions.items()
    }
    for segment, begin, block in problem.whitened(point, problem.spread(point.moments)):
        states = system.states[segment]
        start = block[: len(block) - width]
        rest = block[len(block) - width :]
        if len(start):
            rest = rest - np.tensordot(states.T, start, 1)
        for name, parts in divisions.items():
            which = parts[segment][begin : begin + rest.shape[1]]
            for part in np.unique(which):
                some = rest[:, which == part].reshape(width, -1)
                sums[name][part] += some @ some.T
    return {name: Parts(-G[:, :-1, -1], G[:, :-1, :-1]) for name, G in sums.items()}


def blocks_in_time(motions):
    """Part of each row: some forty blocks of rows that follow each other, none over two records.

    Each holds as much of the motion's square, and with it of what the record tells.
    """
    squares = [np.sum(each, axis=1) for each in _squares(motions)]
    total, rows = sum(map(np.sum, squares)) or 1.0, sum(map(len, squares))
    first, found = 0, []
    for square in squares:
        weight = square / total + 1.0 / rows  # where nothing moves, too
        count = max(1, min(round(N_BLOCKS * np.sum(weight) / 2.0), len(square) // FEWEST))
        held = np.cumsum(weight) / np.sum(weight)
        found.append(first + np.minimum((held * count).astype(int), count - 1))
        first += count
    return found


def _squares(motions):
    """Squares of motions in parts of their mean."""
    size = np.mean(np.concatenate(motions) ** 2, axis=0)
    return [each**2 / np.where(size > 0.0, size, 1.0) for each in motions]


def by_size(motions, window):
    """Part of each row: thirds of the motion's square, by its size over some rows."""
    squares = [
        uniform_filter1d(np.mean(square, axis=1), window, mode="nearest")
        for square in _squares(motions)
    ]
    ordered = np.sort(np.concatenate(squares))
    held = np.cumsum(ordered)
    edges = ordered[np.searchsorted(held, held[-1] * np.arange(1, LEVELS) / LEVELS)]
    return [np.searchsorted(edges, each) for each in squares]


def by_direction(motions):
    """Part of each row: on which side of its middle the motion is, along its largest extent."""
    size = np.sqrt(np.mean(np.concatenate(motions) ** 2, axis=0))
    scaled = [motion / np.where(size > 0.0, size, 1.0) for motion in motions]
    along = np.linalg.eigh(sum(each.T @ each for each in scaled))[1][:, -1]
    return [(each @ along > 0.0).astype(int) for each in scaled]
