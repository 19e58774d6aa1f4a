"""From the Poincaré map back to the periodic system, in closed form.

A period-synchronous model knows Φ and the outputs O(ψ) z that a state z at ψ = 0 leaves
within the period. With real logarithms of Φ (of −Φ on the subspace of negative
multipliers, whose shapes change sign from one period to the next),

    R = log(±Φ) / T,    P(ψ) = O(ψ) e^{−Rt},    F(ψ) = (P′(ψ) + P(ψ) R) P(ψ)⁻¹

is the state matrix where the outputs determine the state. Neither needs eigenvectors, so
repeated and defective multipliers are no special case.

Of measured states F(ψ) also follows by linear least squares, the equation-error method
(V. Klein, E. A. Morelli, *Aircraft System Identification*, 2006, chapter 5):

    x[k+m] − x[k] = ∫ F(ψ) x + G(ψ) u dt,   F, G of a few harmonics

Noise of x enters the regressors, too, and biases least squares; states almost free of noise
as instruments take the bias away (T. Söderström, P. Stoica, *System Identification*, 1989,
chapter 8). A start where a period forgets the state and noise hides what is left.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, EXACT, UNKNOWN
from sklearn_hd.algorithms.lti.simulation import propagate, real_logarithm
from sklearn_hd.algorithms.lti.structured_model import column_sizes
from sklearn_hd.algorithms.periodic.multipliers import (
    LARGEST_RESPONSE,
    compact,
    mode_responses,
    mode_steps,
    orthonormal_range,
    refine_multipliers,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

BIC_PATIENCE = 2
SHAPE_CONDITION = 1e4  # of P(ψ), beyond which outputs do not determine the state
WHITE_MARGIN = 1.3  # above it something stands out of the noise
TRACY_WIDOM = 3.27  # what one in a thousand exceeds; M. Prähofer's tables, β = 1
NOTHING_LEFT = 1e-9  # of the outputs: no systematic error to speak of
SWEEPS = 20


# ---- the Poincaré map ------------------------------------------------------------------------
INTERVALS = 8  # a period: longer ones have more signal, shorter ones a finer rule


def order_by_residual(candidates, directions, lifted, told=None):
    """Which of some maps Φ, of rising order, the lifted outputs call for.

    The order of the least Bayesian information criterion, or the next one that leaves white
    noise. Systematic errors (a nonlinear system's) call for ever more states: then the last order
    that brought down the sum of squares left by half a decade.

    Parameters
    ----------
    candidates : list of ndarray, shapes (n, n), n = 1, 2, …
    directions, lifted : list of ndarray
        As in :func:`~sklearn_hd.algorithms.periodic.multipliers.refine_multipliers`.
    told : callable, optional
        ``told(done, note)``, with the candidates tried.

    Returns
    -------
    Phi : ndarray, shape (n, n)
        The candidate chosen.
    """
    n_columns, r = lifted[0].shape[1], directions[0].shape[1]
    target = compact(np.vstack(lifted))
    n_free = (len(target) - r) * n_columns
    per_state = n_columns + r + len(lifted)  # its column of O, its row of B, initial states
    left, bic = [_left_by(np.zeros((0, 0)), directions, target)], [np.inf]
    for Phi in candidates:
        refined = refine_multipliers(Phi, directions, lifted)
        if not _is_possible(refined, max(map(len, lifted))):
            left.append(target)
            bic.append(np.inf)
        else:
            left.append(_left_by(refined, directions, target))
            rss = max(float(np.sum(left[-1] ** 2)), EXACT**2 * float(np.sum(target**2)))
            bic.append(n_free * np.log(rss / n_free) + len(Phi) * per_state * np.log(n_free))
        if told is not None:
            told(len(left) - 1, f"best so far {np.argmin(bic)}")
        if len(bic) > BIC_PATIENCE and np.argmin(bic) < len(bic) - BIC_PATIENCE:
            break
    best = int(np.argmin(bic))
    white = [
        n
        for n in range(max(best, 1), len(left))
        if _is_noise(left[n], len(target) - r - n, n_columns)
    ]
    if white:  # more states than the criterion pays for, if fewer leave what is no noise
        best = white[0]
    elif not _is_white(left[best], n_columns):
        sizes = np.array([np.linalg.norm(rest) for rest in left])
        drops = np.flatnonzero(sizes[:-1] >= 10.0**0.25 * sizes[1:])
        best = min(best, int(drops[-1]) + 1 if len(drops) else 1)
    return candidates[max(best, 1) - 1]


def _is_possible(Phi, n_periods):
    """Whether a periodic system may have this map: one state alone cannot change sign from period
    to period, and what outgrows numbers within a record was not recorded."""
    if Phi.size == 1 and Phi.item() < 0.0:
        return False
    largest = np.max(np.abs(linalg.eigvals(Phi)))
    return n_periods * np.log(max(largest, 1.0)) <= np.log(LARGEST_RESPONSE)


def _left_by(Phi, directions, target):
    """Lifted outputs less what inputs and as many states as Φ has can explain.

    The states move in n of the directions in which n modes could answer to every input and
    initial state: the best n of them (reduced-rank regression, Anderson, 1951). All of
    them together would fit the noise, the more the more directions the inputs have.
    """
    regressors, r = np.vstack(mode_responses(mode_steps(Phi), directions)), len(directions[0].T)
    Q = orthonormal_range(regressors[:, :r])
    left = target - Q @ (Q.T @ target)
    Q = orthonormal_range(regressors[:, r:], beyond=Q)
    within = Q.T @ left
    U = linalg.svd(within, full_matrices=False)[0][:, : len(Phi)]
    return left - Q @ (U @ (U.T @ within))


def leaves_white_noise(Phi, directions, lifted):
    """Whether what the multipliers of Φ leave of the lifted outputs is white noise, or rounding.

    If so, :func:`~sklearn_hd.algorithms.periodic.multipliers.refine_multipliers` is the estimate of
    largest likelihood; if not, the squares it minimises are systematic errors, and it has no
    claim to be the better one.
    """
    target = compact(np.vstack(lifted))
    rest = _left_by(Phi, directions, target)
    rounding = np.linalg.norm(rest) <= NOTHING_LEFT * np.linalg.norm(target)
    return bool(rounding) or _is_white(rest, lifted[0].shape[1])


def without_noise(Phi, directions, lifted):
    """Lifted outputs as far as inputs and the modes of Φ explain them, whatever O is.

    With Φ but roughly right still close to the truth where a period forgets most.

    Returns
    -------
    explained : list of ndarray, shapes (n_periods_s, q)
    """
    steps = mode_steps(Phi / max(1.0, np.max(np.abs(linalg.eigvals(Phi)))))
    Q = orthonormal_range(np.vstack(mode_responses(steps, directions)))
    edges = np.cumsum([len(block) for block in lifted])[:-1]
    return np.split(Q @ (Q.T @ np.vstack(lifted)), edges)


def told_apart(Phi, lifted):
    """Whether free decays move in as many directions as Φ has multipliers.

    One decay cannot show both modes of a double multiplier.
    """
    none = [np.zeros((len(block), 0)) for block in lifted]
    regressors = np.vstack(mode_responses(mode_steps(Phi), none))
    seen = linalg.svdvals(regressors / column_sizes(regressors))
    return len(seen) >= len(Phi) and seen[len(Phi) - 1] > UNKNOWN * seen[0]


def _is_white(rest, n_columns, margin=WHITE_MARGIN):
    """Whether no direction stands out of what is left (Marchenko and Pastur, 1967)."""
    sigma = np.linalg.norm(rest) / np.sqrt(len(rest) * n_columns)
    largest = np.linalg.norm(rest, 2)
    return largest <= margin * sigma * (np.sqrt(len(rest)) + np.sqrt(n_columns))


def _is_noise(rest, n_rows, n_columns):
    """Whether the strongest direction of what is left may be white noise's (Johnstone, 2001).

    Its variance in parts of the noise's, less its expectation, in parts of its spread has
    Tracy and Widom's distribution.

    Parameters
    ----------
    rest : ndarray, shape (n_periods, n_columns or fewer)
        Of the same scalar products as what is left.
    n_rows : int
        Periods less the directions taken out.
    n_columns : int
    """
    variance = float(np.sum(rest**2)) / (n_rows * n_columns)
    a, b = np.sqrt(n_rows - 1.0), np.sqrt(n_columns)
    spread = (a + b) * (1.0 / a + 1.0 / b) ** (1.0 / 3.0)
    return bool(np.linalg.norm(rest, 2) ** 2 <= variance * ((a + b) ** 2 + TRACY_WIDOM * spread))


def state_response(Phi, C, directions, lifted, seen):
    """How the state moves, and what every sample of the period sees of it.

    Alternates two linear least-squares fits, each exact where the other is: B and the
    initial states from the outputs, and the outputs' O_j and D_j from the states.

    Parameters
    ----------
    Phi : ndarray, shape (n, n)
    C : ndarray, shape (c, n)
        What some combinations of the lifted outputs see of the state, to start from.
    directions : list of ndarray, shapes (n_periods_s, r)
    lifted : list of ndarray, shapes (n_periods_s, q)
    seen : list of ndarray, shapes (n_periods_s, c)
        Those combinations.

    Returns
    -------
    sights : ndarray, shape (q, n)
        O: what each sample of the period sees of the state at its start.
    information : ndarray, shape (n, n)
        Inverse covariance of the rows of O for noise of variance one.
    residual : ndarray, shape (q,)
        Sum of squares left of each sample of the period.
    """
    project = _off(directions)
    units, outputs = _unit_responses(Phi, directions), project(np.vstack(lifted))
    units = np.stack([project(unit) for unit in units], axis=1)  # (n_periods, n_unknown, n)
    target, sees, before = project(np.vstack(seen)), C, np.inf
    few = compact(outputs)
    for _ in range(SWEEPS):
        regressors = np.einsum("kun,cn->kcu", units, sees).reshape(target.size, -1)
        size = column_sizes(regressors)
        unknown = linalg.lstsq(regressors / size, target.ravel(), cond=EXACT)[0] / size
        states = np.einsum("kun,u->kn", units, unknown)
        sees = linalg.lstsq(states, few)[0].T
        left = float(np.sum((few - states @ sees.T) ** 2))
        if left >= (1.0 - 1e-6) * before or left <= EXACT**2 * np.sum(few**2):
            break
        target, before = few, left
    return _seen_of(states, outputs)


def response_to_states(states, directions, lifted):
    """What every sample of the period sees of known states.

    Parameters
    ----------
    states : list of ndarray, shapes (n_periods_s, n)
        At the beginning of each period.
    directions, lifted : list of ndarray
        As for :func:`state_response`.

    Returns
    -------
    sights, information, residual
        As of :func:`state_response`.
    """
    project = _off(directions)
    return _seen_of(project(np.vstack(states)), project(np.vstack(lifted)))


def _off(directions):
    """Projection of stacked periods off the inputs."""
    W = np.vstack(directions)
    Q = linalg.qr(W, mode="economic")[0] if W.shape[1] else W
    return lambda block: block - Q @ (Q.T @ block)


def _seen_of(states, outputs):
    sights = linalg.lstsq(states, outputs)[0].T
    return sights, states.T @ states, np.sum((outputs - states @ sights.T) ** 2, axis=0)


def _unit_responses(Phi, directions):
    """States for each entry of B, row by row, and of every initial state, all periods stacked."""
    n, r = len(Phi), directions[0].shape[1]
    lengths = [len(w) for w in directions]
    units = []
    for s, w in enumerate(directions):
        forcing = np.einsum("ab,kq->aqkb", np.eye(n), w).reshape(n * r, len(w), n)
        forced = propagate(Phi, forcing, np.zeros((n * r, n)))
        free = np.zeros((len(directions), n, len(w), n))
        free[s] = propagate(Phi, np.zeros((n, lengths[s], n)), np.eye(n))
        units.append(np.concatenate([forced, free.reshape(-1, len(w), n)]))
    return np.concatenate(units, axis=1)


# ---- Floquet form ----------------------------------------------------------------------------


def floquet_logarithm(Phi, period):
    """Real R and coordinates in which Φ = S e^{RT}, S = ±1 a coordinate.

    Parameters
    ----------
    Phi : ndarray, shape (n, n)
    period : float
        T in seconds.

    Returns
    -------
    R : ndarray, shape (n, n)
        1/s; block diagonal, the subspace of negative real multipliers first.
    to_original : ndarray, shape (n, n)
        z = to_original z_new.
    flips : ndarray of bool, shape (n,)
        Coordinates whose shapes change sign from one period to the next.

    Raises
    ------
    FloquetError
        If a multiplier is zero, which no periodic system has.

    Examples
    --------
    >>> R, _, flips = floquet_logarithm(np.diag([-0.5, 0.25]), 1.0)
    >>> np.exp(np.diag(R)).round(6).tolist(), flips.tolist()
    ([0.5, 0.25], [True, False])
    """
    multipliers = linalg.eigvals(Phi)
    size = np.max(np.abs(multipliers), initial=0.0)
    if np.min(np.abs(multipliers), initial=np.inf) <= 1e-14 * size or size == 0.0:
        raise FloquetError(
            f"a Floquet multiplier is zero (they are {np.array2string(multipliers, precision=3)}): "
            f"no periodic system forgets a state within one period; lower the order"
        )
    upper, Z, n_flips = linalg.schur(
        Phi, output="real", sort=lambda re, im: abs(im) <= 1e-12 * size and re < 0.0
    )
    upper_right = upper[:n_flips, n_flips:]
    X = np.zeros_like(upper_right)
    if 0 < n_flips < len(Phi):
        X = linalg.solve_sylvester(
            upper[:n_flips, :n_flips], -upper[n_flips:, n_flips:], -upper_right
        )
    to_original = Z.copy()
    to_original[:, n_flips:] += Z[:, :n_flips] @ X
    parts = [-upper[:n_flips, :n_flips], upper[n_flips:, n_flips:]]
    logarithms = [real_logarithm(part) / period if len(part) else part for part in parts]
    flips = np.arange(len(Phi)) < n_flips
    return linalg.block_diag(*logarithms)[-len(Phi) :, -len(Phi) :], to_original, flips


def shape_functions(psi, n_harmonics, flips):
    """Functions that shapes are made of, and their derivatives with respect to ψ.

    1, cos ψ, sin ψ, … for shapes that repeat; cos ψ/2, sin ψ/2, cos 3ψ/2, … for those that
    change sign from one period to the next.

    Returns
    -------
    values, slopes : ndarray, shape (n_points, n_functions)
    """
    orders = np.arange(max(n_harmonics, 1)) + 0.5 if flips else np.arange(n_harmonics + 1)
    angles = np.multiply.outer(psi, orders)
    values = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    slopes = orders[:, None] * np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
    nothing = [] if flips else [1]  # sin 0ψ
    return tuple(np.delete(f.reshape(len(psi), -1), nothing, axis=1) for f in (values, slopes))


class FloquetError(ValueError):
    """Multipliers that no periodic system has: zero, or an odd number of negative ones."""


@dataclass(frozen=True, eq=False)
class FloquetShapes:
    """Mode shapes P(ψ) of a periodic system as series in ψ.

    Attributes
    ----------
    R : ndarray, shape (n, n)
        1/s; the free response is y = P(ψ) e^{Rt} q.
    flips : ndarray of bool, shape (n,)
    coefficients : tuple of ndarray, shapes (n_functions_a, l), one for each state a
    n_harmonics : int
    noise : float
        Standard deviation of what the shapes were fitted to, in parts of its size.
    """

    R: np.ndarray
    flips: np.ndarray
    coefficients: tuple
    n_harmonics: int
    noise: float = 0.0

    def __call__(self, psi):
        """P(ψ) and dP/dψ, shapes (n_points, l, n)."""
        parts = [
            [f @ c for f in shape_functions(psi, self.n_harmonics, flips)]
            for flips, c in zip(self.flips, self.coefficients, strict=True)
        ]
        return np.stack([p for p, _ in parts], axis=2), np.stack([s for _, s in parts], axis=2)

    def state_matrix(self, psi, omega, rows):
        """F(ψ) = (P′ + P R) P⁻¹ with some rows of P as states, shape (n_points, n, n)."""
        P, slope = self(psi)
        P, slope = P[:, rows], omega * slope[:, rows]
        scale = np.linalg.norm(P, axis=(0, 2))[:, None]  # outputs in like units
        inverse = np.linalg.inv(P / scale) / scale.T
        return (slope + P @ self.R) @ inverse


def fit_shapes(sights, information, residual, R, flips, period, n_rows):
    """Mode shapes behind what each sample of the period sees of the state.

    P(ψ_j) e^{R t_j} = O_j in the least-squares sense that the noise of O asks for, with as
    many harmonics as stand out of it (Akaike's criterion).

    Parameters
    ----------
    sights : ndarray, shape (n_phases, l, n)
        O, in the coordinates of R.
    information : ndarray, shape (n, n)
    residual : ndarray, shape (n_phases, l)
        Sum of squares left.
    R : ndarray, shape (n, n)
    flips : ndarray of bool, shape (n,)
    period : float
    n_rows : int
        Periods less parameters behind each sum of squares.

    Returns
    -------
    shapes : FloquetShapes
    """
    n_phases, n_outputs, n = sights.shape
    psi = 2.0 * np.pi * np.arange(n_phases) / n_phases
    step = linalg.expm(R * period / n_phases)
    decays = np.empty((n_phases, n, n))
    decays[0] = np.eye(n)
    for j in range(1, n_phases):
        decays[j] = step @ decays[j - 1]
    root = _root(information)
    weighted = decays @ root
    target = (sights @ root).transpose(0, 2, 1).reshape(n_phases * n, n_outputs)
    variance = residual.sum(axis=0) / (n_phases * max(1, n_rows))
    rounding = (4.0 * EPS * np.linalg.norm(target, axis=0)) ** 2
    variance = np.where(variance > rounding, variance, np.where(rounding > 0, rounding, 1.0))
    functions = [
        [shape_functions(psi, count, flip)[0] for flip in flips]
        for count in range(n_phases // 2 + 1)
    ]
    left, n_columns = _left_by_count(functions, weighted, target)
    chosen = int(np.argmin(np.sum(left / variance, axis=1) + 2.0 * n_columns * n_outputs))
    design = _shape_design(functions[chosen], weighted)
    size = np.linalg.norm(design, axis=0)
    size[size < DEPENDENT * size.max()] = np.inf  # the sine that is zero at every sample
    solution = linalg.lstsq(design / size, target)[0] / size[:, None]
    edges = np.cumsum([f.shape[1] for f in functions[chosen]])[:-1]
    noise = float(np.sqrt(len(target) * np.sum(variance) / np.sum(target**2)))
    return FloquetShapes(R, flips, tuple(np.split(solution, edges)), chosen, noise)


def shapes_determine_state(P):
    """Whether P(ψ) can be inverted at every phase, rows and columns scaled over the period.

    Parameters
    ----------
    P : ndarray, shape (n_phases, n, n)
    """
    scaled = P / np.max(np.abs(P)) if P.any() else P
    for _ in range(20):
        rows = np.linalg.norm(scaled, axis=(0, 2))[:, None]
        columns = np.linalg.norm(scaled, axis=(0, 1))
        if not (rows.all() and columns.all()):
            return False
        scaled = scaled / rows
        scaled = scaled / np.linalg.norm(scaled, axis=(0, 1))
    return bool(np.max(np.linalg.cond(scaled)) <= SHAPE_CONDITION)


def _shape_design(functions, weighted):
    """Regressors of the coefficients of P: functions of ψ times what each state has become."""
    columns = [f[:, None, :] * weighted[:, a, :, None] for a, f in enumerate(functions)]
    return np.concatenate(columns, axis=2).reshape(len(weighted) * weighted.shape[2], -1)


def _left_by_count(functions, weighted, target):
    """Sums of squares that more and more functions leave, and how many coefficients they have.

    Those of fewer harmonics are the first of those of more: one factorisation serves all.
    """
    blocks, n_columns, before = [], [], [0] * len(functions[0])
    for each in functions:
        new = [f[:, seen:] for f, seen in zip(each, before, strict=True)]
        before = [f.shape[1] for f in each]
        blocks.append(_shape_design(new, weighted))
        n_columns.append(sum(before))
    design = np.hstack(blocks)
    size = np.linalg.norm(design, axis=0)
    size[size < DEPENDENT * size.max()] = np.inf
    Q, R = linalg.qr(design / size, mode="economic")
    Q = Q * (np.abs(np.diag(R)) > DEPENDENT)
    taken = Q.T @ target
    beyond = np.sum((target - Q @ taken) ** 2, axis=0)
    later = np.cumsum(np.vstack([beyond, taken[::-1] ** 2]), axis=0)[::-1]  # no cancellation
    return later[np.minimum(np.cumsum([b.shape[1] for b in blocks]), len(taken))], np.array(
        n_columns
    )


def _root(information):
    """L with L Lᵀ = information, by its eigenvalues."""
    values, vectors = linalg.eigh(information)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def equation_error(segments, period, n_phases, n_harmonics, instruments=None):
    """Fourier coefficients of F(ψ) and G(ψ) from measured states.

    Parameters
    ----------
    segments : list of (states, inputs, first_phase)
        (n_samples, n), (n_samples, m), held, and the first sample's phase in samples.
    period : float
        Seconds.
    n_phases : int
        Samples a period.
    n_harmonics : int
        Highest harmonic of F and G.
    instruments : list of ndarray, shapes (n_samples, n), optional
        States of less noise, of every segment; the measured ones by default.

    Returns
    -------
    F : ndarray, shape (2 n_harmonics + 1, n, n)
    G : ndarray, shape (2 n_harmonics + 1, n, m)

    Examples
    --------
    >>> x = np.exp(-0.5 * np.arange(0, 8, 0.01))[:, None]
    >>> F, _ = equation_error([(x, np.zeros((800, 0)), 0)], 1.0, 100, 0)
    >>> F.round(3).tolist()
    [[[-0.5]]]
    """
    m, step = max(1, n_phases // INTERVALS), period / n_phases
    shown = [x for x, _, _ in segments] if instruments is None else instruments
    X, Z, target = [], [], []
    for (x, u, first), z in zip(segments, shown, strict=True):
        functions = harmonic_functions(
            2.0 * np.pi / n_phases * (first + np.arange(len(x))), range(n_harmonics + 1)
        )
        X.append(step * _integrals(functions, x, u, m))
        Z.append(step * _integrals(functions, z, u, m))
        target.append(x[m:] - x[:-m])
    X, Z, target = map(np.vstack, (X, Z, target))
    size = column_sizes(Z)
    Q = linalg.qr(Z / size, mode="economic")[0]
    solution = linalg.lstsq(Q.T @ X / size, Q.T @ target, cond=1e-9)[0] / size[:, None]
    n, count = target.shape[1], 2 * n_harmonics + 1
    F = solution[: count * n].reshape(count, n, n).transpose(0, 2, 1)
    return F, solution[count * n :].reshape(count, -1, n).transpose(0, 2, 1)


def _integrals(functions, x, u, m):
    """Of harmonics times states and held inputs, over m samples, in samples."""

    def products(values, functions):
        return (functions[:, :, None] * values[:, None, :]).reshape(len(values), -1)

    ends = products(x, functions)
    held = products(u[:-1], functions[:-1]) + products(u[:-1], functions[1:])
    rates = 0.5 * np.hstack([ends[1:] + ends[:-1], held])
    sums = np.vstack([np.zeros(rates.shape[1]), np.cumsum(rates, axis=0)])
    return sums[m:] - sums[:-m]
