"""Multipliers that a period forgets, from the samples within the period.

What sample j of a period sees of the state at its start, O_j = P(ψ_j) e^{R t_j}, and what
one period leaves for the next, Φ = ±e^{RT}, are one R: with the right one the shapes
P(ψ) repeat, and few harmonics make them; with a wrong one they jump between the periods.

    min over R, P:  Σ |O_j − P(ψ_j) e^{R t_j}|² / σ² + (c(R) − ĉ)ᵀ M (c(R) − ĉ) + 2 · parameters

in the metric of the noise of O; ĉ are the coefficients of Φ's characteristic polynomials as
seen once a period, and M their inverse covariance.
"""

import numpy as np
from scipy import linalg
from scipy.optimize import least_squares

from sklearn_hd.algorithms.lti.simulation import logarithm
from sklearn_hd.algorithms.periodic.multipliers import (
    block_and_slopes,
    characteristic,
    with_characteristic,
)
from sklearn_hd.algorithms.periodic.periodic_realization import shape_functions, state_response

__all__ = ["refine_within_period"]

WELL_KNOWN = 1e-7  # relative standard deviation of multipliers that need no help
SWEEPS = 3  # R from O, and O from R
HARMONICS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
PATIENCE = 2
FASTEST = 25.0  # |λ| T of exponents tried; e^-25 is beyond what samples can show
ROUNDING = 1e-15
WALL = 1e100  # residuals beyond FASTEST
UNSEEN = 1e-9
RANK = 1e-11  # of columns of length one; dependent ones leave 1e-15


def refine_within_period(refined, C, directions, lifted, seen, n_phases):
    """Φ with the multipliers that the samples within the period call for, too.

    Parameters
    ----------
    refined : RefinedMap
        From what is seen once a period.
    C, directions, lifted, seen
        As in :func:`~sklearn_hd.algorithms.periodic.periodic_realization.state_response`.
    n_phases : int
        Samples a period.

    Returns
    -------
    Phi : ndarray, shape (n, n)
        As given where it is known well enough, or has a single negative multiplier.
    """
    if refined.basis is None or _well_known(refined):
        return refined.Phi
    blocks, signs = _admissible(refined.blocks)
    if any(len(block) == 1 and sign < 0 for block, sign in zip(blocks, signs, strict=True)):
        return refined.Phi
    basis, inverse = refined.basis, linalg.inv(refined.basis)
    Phi = basis @ linalg.block_diag(*blocks) @ inverse
    for _ in range(SWEEPS):
        sights, information, residual = state_response(Phi, C, directions, lifted, seen)
        problem = _ShapeProblem(
            (sights @ basis).reshape(n_phases, -1, len(Phi)),
            inverse @ information @ inverse.T,
            residual.reshape(n_phases, -1),
            sum(map(len, lifted)) - directions[0].shape[1] - len(Phi),
            refined,
            blocks,
            signs,
        )
        blocks = problem.solve()
        before, Phi = Phi, basis @ linalg.block_diag(*blocks) @ inverse
        if np.linalg.norm(Phi - before) <= 1e-3 * WELL_KNOWN * np.linalg.norm(Phi):
            break
    return Phi


def _well_known(refined):
    """Whether every coefficient is known to many digits."""
    covariance = linalg.pinvh(refined.information)
    deviation = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return bool(np.all(deviation <= WELL_KNOWN * np.abs(refined.coefficients)))


def _admissible(blocks):
    """Blocks whose real eigenvalues have one sign each, and that sign.

    A pair of one positive and one negative multiplier is no pair of any periodic system of
    two states: the smaller one's sign is noise.
    """
    found, signs = [], []
    for block in blocks:
        values = linalg.eigvals(block)
        sign = np.sign(values[np.argmax(np.abs(values))].real)
        if np.isrealobj(values) or np.all(values.imag == 0.0):
            if len(block) == 2 and np.prod(values.real) <= 0.0:
                size = np.max(np.abs(values))
                moved = sign * np.maximum(np.abs(values), 1e-2 * size)
                moved[np.argmin(np.abs(values))] *= 1.0 - 1e-3  # not a double one
                block = with_characteristic(block, [moved.sum(), moved.prod()])
        else:
            sign = 1.0
        found.append(block)
        signs.append(sign if sign else 1.0)
    return found, signs


class _ShapeProblem:
    """Exponents of the shapes that O calls for, in units of 1/T."""

    def __init__(self, sights, information, residual, n_rows, refined, blocks, signs):
        self.n_phases, self.n_outputs, self.n = sights.shape
        values, vectors = linalg.eigh(information)
        self.root = vectors * np.sqrt(np.maximum(values, 0.0))
        target = (sights @ self.root).transpose(0, 2, 1).reshape(-1, self.n_outputs)
        variance = residual.sum(axis=0) / (self.n_phases * max(1, n_rows))
        floor = (ROUNDING * np.linalg.norm(target, axis=0)) ** 2
        self.sigma = np.sqrt(np.maximum(variance, np.where(floor > 0.0, floor, 1.0)))
        self.target = target / self.sigma
        self.blocks, self.signs = blocks, signs
        self.wanted = refined.coefficients
        values, vectors = linalg.eigh(refined.information)
        self.prior = (vectors * np.sqrt(np.maximum(values, 0.0))).T
        self.logarithms = [
            _logarithm(block, sign) for block, sign in zip(blocks, signs, strict=True)
        ]
        flips = [sign < 0 for sign in signs]
        self.flips = np.repeat(flips, [len(block) for block in blocks])

    def solve(self):
        """Blocks of Φ for the number of harmonics of the least Akaike criterion."""
        start = np.concatenate([characteristic(L) for L in self.logarithms])
        best, found, worse = np.inf, start, 0
        for count in HARMONICS:
            if count > self.n_phases // 2 - 1:
                break
            functions = [
                shape_functions(2.0 * np.pi * np.arange(self.n_phases) / self.n_phases, count, f)[0]
                for f in self.flips
            ]
            left = _Left(self, functions)
            search = least_squares(
                lambda c, left=left: left(c)[0],
                start,
                lambda c, left=left: left(c)[1],
                x_scale="jac",
                xtol=1e-12,
                ftol=1e-10,
                max_nfev=60,
            )
            n_parameters = self.n_outputs * sum(f.shape[1] for f in functions)
            value = 2.0 * search.cost + 2.0 * n_parameters
            worse = 0 if value < best else worse + 1
            if worse == 0:
                best, found = value, search.x
            if worse == PATIENCE:
                break
        return [
            sign * linalg.expm(block)
            for sign, (block, _) in zip(self.signs, self.rates(found), strict=True)
        ]

    def rates(self, values):
        """Blocks of R of some characteristic coefficients, and their derivatives by these."""
        edges = np.cumsum([len(L) for L in self.logarithms])[:-1]
        return [
            block_and_slopes(L, part)
            for L, part in zip(self.logarithms, np.split(values, edges), strict=True)
        ]


class _Left:
    """What shapes of some functions leave of O, and R's coefficients of Φ's, with derivatives.

    As in multipliers, P is eliminated by projection
    (Golub and Pereyra, 1973).
    """

    def __init__(self, problem, functions):
        self.problem, self.functions = problem, functions
        self._last = None, None

    def __call__(self, values):
        """Residuals, shape (p n l + n,), and their derivatives by the values, (…, n)."""
        asked, found = self._last
        if asked is None or not np.array_equal(asked, values):
            found = self._found(values)
            self._last = values.copy(), found
        return found

    def _found(self, values):
        problem, n = self.problem, len(values)
        rates = problem.rates(values)
        if max(np.max(np.abs(linalg.eigvals(block))) for block, _ in rates) > FASTEST:
            size = problem.target.size + n
            return np.full(size, WALL), np.zeros((size, n))
        decays, slopes = _decays(rates, problem.n_phases)
        left, jacobian = self._off_shapes(decays[:-1] @ problem.root, slopes[:-1] @ problem.root)
        multipliers, moved, at = np.zeros(n), np.zeros((n, n)), 0
        for sign, (rate, by) in zip(problem.signs, rates, strict=True):
            here = slice(at, at + len(rate))
            multipliers[here] = characteristic(sign * decays[-1][here, here])
            moved[at, here] = sign * np.trace(slopes[-1][here, here, here], axis1=1, axis2=2)
            if len(rate) == 2:
                moved[at + 1, here] = np.exp(np.trace(rate)) * np.trace(by, axis1=1, axis2=2)
            at = here.stop
        known = problem.prior @ (multipliers - problem.wanted)
        return np.append(left.ravel(), known), np.vstack([jacobian, problem.prior @ moved])

    def _off_shapes(self, weighted, slopes):
        """O less P e^{Rt}, and its derivatives by R's coefficients."""
        target, n = self.problem.target, weighted.shape[1]
        design = np.concatenate(
            [f[:, None, :] * weighted[:, a, :, None] for a, f in enumerate(self.functions)], axis=2
        ).reshape(len(target), -1)
        size = np.linalg.norm(design, axis=0)
        size[size < UNSEEN * size.max()] = np.inf
        Q, R, order = linalg.qr(design / size, mode="economic", pivoting=True)
        kept = np.abs(np.diag(R)) > RANK
        Q, R, order = Q[:, kept], R[np.ix_(kept, kept)] * size[order[kept]], order[kept]
        explained = Q.T @ target
        left = target - Q @ explained
        inverse = linalg.solve_triangular(R, np.eye(len(R)))
        weights = np.zeros((design.shape[1], target.shape[1]))
        weights[order] = inverse @ explained
        rest, edges = left.reshape(len(weighted), n, -1), self._edges()
        shapes = [f @ w for f, w in zip(self.functions, np.split(weights, edges), strict=True)]
        moved = np.einsum("jiak,ajl->ijkl", slopes, shapes).reshape(n, *target.shape)
        pulls = np.einsum("jiak,jkl->aijl", slopes, rest)
        reached = [f.T @ pull for f, pull in zip(self.functions, pulls, strict=True)]
        inside = inverse.T @ np.concatenate(reached, axis=1)[:, order] - Q.T @ moved
        return left, -(moved + Q @ inside).reshape(n, -1).T

    def _edges(self):
        return np.cumsum([f.shape[1] for f in self.functions])[:-1]


def _decays(rates, n_phases):
    """e^{R t} at 0, 1/n_phases, … 1, shape (n_phases + 1, n, n), and its derivatives by the
    coefficients of R, (n_phases + 1, n, n, n)."""
    n = sum(len(block) for block, _ in rates)
    both, at = np.zeros((n, 2 * n, 2 * n)), 0
    for block, slopes in rates:
        here, there = slice(at, at + len(block)), slice(n + at, n + at + len(block))
        both[:, here, here] = both[:, there, there] = block
        both[here, there, here] = slopes
        at = here.stop
    step = linalg.expm(both / n_phases)
    powers = np.broadcast_to(np.eye(2 * n), (1, *both.shape))
    while len(powers) <= n_phases:
        powers, step = np.concatenate([powers, powers @ step]), step @ step
    powers = powers[: n_phases + 1]
    return powers[:, 0, :n, :n], powers[:, :, n:, :n]


def _logarithm(block, sign):
    """log(±block), real."""
    return np.real(logarithm(sign * block))
