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

from sklearn_hd.algorithms.multipliers import characteristic, with_characteristic
from sklearn_hd.algorithms.periodic_realization import shape_functions, state_response
from sklearn_hd.algorithms.simulation import logarithm

__all__ = ["refine_within_period"]

WELL_KNOWN = 1e-7  # relative standard deviation of multipliers that need no help
SWEEPS = 3  # R from O, and O from R
HARMONICS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
PATIENCE = 2
FASTEST = 25.0  # |λ| T of exponents tried; e^-25 is beyond what samples can show
ROUNDING = 1e-15
WALL = 1e100  # residuals beyond FASTEST
UNSEEN = 1e-9


def refine_within_period(refined, C, directions, lifted, seen, n_phases):
    """Φ with the multipliers that the samples within the period call for, too.

    Parameters
    ----------
    refined : RefinedMap
        From what is seen once a period.
    C, directions, lifted, seen
        As in :func:`~sklearn_hd.algorithms.periodic_realization.state_response`.
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
            search = least_squares(
                self._left,
                start,
                args=(functions,),
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
            for sign, block in zip(self.signs, self._rates(found), strict=True)
        ]

    def _rates(self, values):
        edges = np.cumsum([len(L) for L in self.logarithms])[:-1]
        return [
            with_characteristic(L, part)
            for L, part in zip(self.logarithms, np.split(values, edges), strict=True)
        ]

    def _left(self, values, functions):
        rates = self._rates(values)
        if max(np.max(np.abs(linalg.eigvals(block))) for block in rates) > FASTEST:
            return np.full(self.target.size + len(self.wanted), WALL)
        R = linalg.block_diag(*rates)
        step, decays = linalg.expm(R / self.n_phases), [np.eye(self.n)]
        for _ in range(self.n_phases - 1):
            decays.append(step @ decays[-1])
        weighted = np.array(decays) @ self.root
        design = np.concatenate(
            [f[:, None, :] * weighted[:, a, :, None] for a, f in enumerate(functions)], axis=2
        ).reshape(len(self.target), -1)
        size = np.linalg.norm(design, axis=0)
        size[size < UNSEEN * size.max()] = np.inf
        Q = linalg.qr(design / size, mode="economic")[0]
        left = self.target - Q @ (Q.T @ self.target)
        multipliers = [
            characteristic(sign * linalg.expm(block))
            for sign, block in zip(self.signs, rates, strict=True)
        ]
        return np.append(left.ravel(), self.prior @ (np.concatenate(multipliers) - self.wanted))


def _logarithm(block, sign):
    """log(±block), real."""
    return np.real(logarithm(sign * block))
