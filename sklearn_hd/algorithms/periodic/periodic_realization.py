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

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, EXACT
from sklearn_hd.algorithms.linalg.triangular import column_sizes, solve_within_rank, svd_within_rank
from sklearn_hd.algorithms.lti.simulation import propagate, real_logarithm
from sklearn_hd.algorithms.periodic.multipliers import (
    Modes,
    compact,
    orthonormal_range,
    polynomials,
)
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, sampled_harmonics, times

SHAPE_CONDITION = 1e4  # of P(ψ), beyond which outputs do not determine the state
TAIL = 1e-2  # harmonics of F this small, in parts of the noise, are left out


# ---- the Poincaré map ------------------------------------------------------------------------
INTERVALS = 8  # a period: longer ones have more signal, shorter ones a finer rule


def forced_waveform(Phi, directions, lifted):
    """Outputs of a period without inputs and states, (q,): the forced periodic response.

        y[k] = O z[k] + D w[k] + c

    by least squares over inputs (n_periods_s, r), zero in trim, and lifted outputs
    (n_periods_s, q), beside as many states as Φ has: those of the directions in which its modes
    could answer to inputs and initial states that explain most.
    """
    modes, target = Modes(directions), np.vstack(lifted)
    known = np.hstack([np.ones((len(target), 1)), modes.inputs])
    answers = modes.responses(polynomials(Phi))[1]
    Q = orthonormal_range(known)
    new = answers - Q @ (Q.T @ answers)
    size = column_sizes(new)
    U, values, Vt = svd_within_rank(new / size)
    best = linalg.svd(U.T @ target, full_matrices=False)[0][:, : len(Phi)]
    states = answers / size @ (Vt.T / values) @ best
    return linalg.lstsq(np.hstack([known, states]), target)[0][0]


def state_response(Phi, C, directions, lifted, seen):
    """What every sample of the period sees of the states of :func:`driven_states`."""
    _, states = driven_states(Phi, C, directions, lifted, seen)
    return response_to_states(states, directions, lifted)


def driven_states(Phi, C, directions, lifted, seen):
    """How inputs and initial states move the state from one period to the next.

    Alternates two linear least-squares fits, each exact where the other is: B and the
    initial states from the outputs, and the outputs' O_j and D_j from the states. C (c, n) is
    what some combinations ``seen`` (n_periods_s, c) of the lifted outputs (n_periods_s, q) see of
    the state, to start from. Returned are B (n, r), and the states at the beginning of each period.
    """
    units = _unit_responses(Phi, directions)  # (n_periods, n_unknown, n)
    few, target = compact(_off(directions, lifted)), _off(directions, seen)
    free = _off(directions, [units.reshape(len(few), -1)]).reshape(units.shape)
    sees, before = C, np.inf
    for _ in range(20):
        regressors = np.einsum("kun,cn->kcu", free, sees).reshape(target.size, -1)
        unknown = solve_within_rank(regressors, target.ravel(), cond=EXACT)
        states = np.einsum("kun,u->kn", free, unknown)
        sees = linalg.lstsq(states, few)[0].T
        left = float(np.sum((few - states @ sees.T) ** 2))
        if left >= (1.0 - 1e-6) * before or left <= EXACT**2 * np.sum(few**2):
            break
        # squares beyond what the outputs can see of states are the same whatever B is
        Q, sees = linalg.qr(sees, mode="economic")
        target, before = few @ Q, left
    n, r = len(Phi), directions[0].shape[1]
    ends = np.cumsum([len(w) for w in directions])[:-1]
    states = np.split(np.einsum("kun,u->kn", units, unknown), ends)
    return unknown[: n * r].reshape(n, r), states


def response_to_states(states, directions, lifted):
    """What every sample of the period sees of known states (n_periods_s, n) at its start.

    Returned are O (q, n), the inverse covariance (n, n) of its rows for noise of variance one, and
    the sum of squares (q,) left of each sample of the period.
    """
    states, outputs = _off(directions, states), _off(directions, lifted)
    sights = linalg.lstsq(states, outputs)[0].T
    return sights, states.T @ states, np.sum((outputs - states @ sights.T) ** 2, axis=0)


def _off(directions, blocks):
    """Stacked periods less what inputs explain."""
    W, stacked = np.vstack(directions), np.vstack(blocks)
    Q = linalg.qr(W, mode="economic")[0] if W.shape[1] else W
    return stacked - Q @ (Q.T @ stacked)


def _unit_responses(Phi, directions):
    """States for each entry of B, row by row, and of every initial state, all periods stacked."""
    n, r = len(Phi), directions[0].shape[1]
    units = []
    for s, w in enumerate(directions):
        forcing = np.einsum("ab,kq->aqkb", np.eye(n), w).reshape(n * r, len(w), n)
        forced = propagate(Phi, forcing, np.zeros((n * r, n)))
        free = np.zeros((len(directions), n, len(w), n))
        free[s] = propagate(Phi, np.zeros((n, len(w), n)), np.eye(n))
        units.append(np.concatenate([forced, free.reshape(-1, len(w), n)]).swapaxes(0, 1))
    return np.concatenate(units)


# ---- Floquet form ----------------------------------------------------------------------------


def floquet_logarithm(Phi, period):
    """Real R and coordinates in which Φ = S e^{RT}, S = ±1 a coordinate.

    R (1/s) is block diagonal, the subspace of negative real multipliers first; z = to_original
    z_new; ``flips`` are the coordinates whose shapes change sign from one period to the next. A
    multiplier of zero, which no periodic system has, raises FloquetError.

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


class FloquetError(ValueError):
    """Multipliers that no periodic system has: zero, or an odd number of negative ones."""


@dataclass(frozen=True, eq=False)
class FloquetShapes:
    """Mode shapes P(ψ) of a periodic system as series in ψ.

    Of 1, cos ψ, sin ψ, … where shapes repeat; of cos ψ/2, sin ψ/2, cos 3ψ/2, … where they
    change sign from one period to the next.
    """

    R: np.ndarray  # (n, n): 1/s; the free response is y = P(ψ) e^{Rt} q
    flips: np.ndarray  # bool, (n,)
    # (n, n_orders, 2, l): of the cosine and the sine of each order, by state
    coefficients: np.ndarray
    n_harmonics: int
    noise: float = 0.0  # standard deviation of what the shapes were fitted to, in parts of its size

    def __call__(self, psi):
        """P(ψ) and dP/dψ, shapes (n_points, l, n)."""
        angles, orders = _angles(psi, self.flips, self.coefficients.shape[1])
        c, s = np.cos(angles), np.sin(angles)
        both = np.stack([c, s], axis=-1), orders[..., None] * np.stack([-s, c], axis=-1)
        return np.einsum("dpakf,akfl->dpla", both, self.coefficients)

    def state_matrix(self, psi, omega, rows):
        """F(ψ) = (P′ + P R) P⁻¹ with some rows of P as states, shape (n_points, n, n)."""
        P, slope = self(psi)
        P, slope = P[:, rows], omega * slope[:, rows]
        scale = np.linalg.norm(P, axis=(0, 2))[:, None]  # outputs in like units
        inverse = np.linalg.inv(P / scale) / scale.T
        return (slope + P @ self.R) @ inverse


def _angles(psi, flips, n_orders):
    """Angles kψ, or (k + 1/2)ψ where shapes change sign, (n_points, n, n_orders), and k."""
    orders = np.arange(n_orders) + 0.5 * np.asarray(flips)[:, None]
    return np.multiply.outer(psi, orders), orders


def interpolated_shapes(values, psi, R, flips):
    """Mode shapes through some values (n_phases, l, n) at equally spaced azimuths of a turn."""
    n_phases, n_outputs, n = values.shape
    highest = n_phases // 2
    coefficients = np.zeros((n, highest + 1, 2, n_outputs))
    angles, _ = _angles(psi, flips, highest + 1)
    for i, flipped in enumerate(flips):
        count = (n_phases + 1) // 2 if flipped else highest + 1
        own = angles[:, i, :count]
        design = np.stack([np.cos(own), np.sin(own)], axis=-1).reshape(n_phases, -1)
        found = linalg.lstsq(design, values[:, :, i], cond=DEPENDENT)[0]
        coefficients[i, :count] = found.reshape(count, 2, n_outputs)
    return FloquetShapes(R, flips, coefficients, highest)


def fit_shapes(sights, information, residual, R, flips, period, n_rows):
    """Mode shapes behind what each sample of the period sees of the state.

    P(ψ_j) e^{R t_j} = O_j in the least-squares sense that the noise of O asks for, with as
    many harmonics as stand out of it (Akaike's criterion). ``sights`` (n_phases, l, n) is O in the
    coordinates of R, ``information`` and ``residual`` (n_phases, l) are as of
    :func:`response_to_states`, and each sum of squares has ``n_rows`` periods less parameters.
    """
    n_phases, n_outputs, n = sights.shape
    psi = 2.0 * np.pi * np.arange(n_phases) / n_phases
    step = linalg.expm(R * period / n_phases)
    decays = np.empty((n_phases, n, n))
    decays[0] = np.eye(n)
    for j in range(1, n_phases):
        decays[j] = step @ decays[j - 1]
    values, vectors = linalg.eigh(information)
    root = vectors * np.sqrt(np.maximum(values, 0.0))  # root rootᵀ = information
    weighted = (decays @ root).transpose(0, 2, 1)
    target = (sights @ root).transpose(0, 2, 1).reshape(n_phases * n, n_outputs)
    variance = residual.sum(axis=0) / (n_phases * max(1, n_rows))
    rounding = (4.0 * EPS * np.linalg.norm(target, axis=0)) ** 2
    variance = np.where(variance > rounding, variance, np.where(rounding > 0, rounding, 1.0))
    # columns in the order in which more and more harmonics need them: one factorisation for all
    counts = np.arange(n_phases // 2 + 1)
    angles = _angles(psi, flips, len(counts))[0]
    since = np.repeat(np.where(flips[:, None] & (counts > 0), counts + 1, counts), 2)
    since.reshape(n, -1)[~flips, 1] = len(counts)  # sin 0ψ
    columns = np.argsort(since, kind="stable")[: np.sum(since < len(counts))]
    n_columns = np.searchsorted(since[columns], counts, side="right")
    functions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    design = functions[:, None] * weighted[..., None, None]
    design = design.reshape(len(target), -1)[:, columns]
    size = np.linalg.norm(design, axis=0)
    size[size < DEPENDENT * size.max()] = np.inf  # the sine that is zero at every sample
    Q, upper = linalg.qr(design / size, mode="economic")
    Q = Q * (np.abs(np.diag(upper)) > DEPENDENT)
    taken = Q.T @ target
    beyond = np.sum((target - Q @ taken) ** 2, axis=0)
    left = np.cumsum(np.vstack([beyond, taken[::-1] ** 2]), axis=0)[::-1]  # no cancellation
    left = left[np.minimum(n_columns, len(taken))]
    chosen = int(np.argmin(np.sum(left / variance, axis=1) + 2.0 * n_columns * n_outputs))
    columns = columns[: n_columns[chosen]]
    size = size[: len(columns), None]
    coefficients = np.zeros((len(since), n_outputs))
    coefficients[columns] = linalg.lstsq(design[:, : len(columns)] / size.T, target)[0] / size
    coefficients = coefficients.reshape(n, len(counts), 2, n_outputs)[:, : chosen + 1]
    noise = float(np.sqrt(len(target) * np.sum(variance) / np.sum(target**2)))
    return FloquetShapes(R, flips, coefficients, chosen, noise)


def outputs_are_states(P, flips):
    """Whether P(ψ) can be, also between the samples: its determinant does not pass through zero.

    Of P(ψ), (n_phases, n, n), with rows and columns scaled.
    """
    if np.sum(flips) % 2:
        return False
    scaled = P / np.max(np.abs(P)) if P.any() else P
    for _ in range(20):
        rows = np.linalg.norm(scaled, axis=(0, 2))[:, None]
        columns = np.linalg.norm(scaled, axis=(0, 1))
        if not (rows.all() and columns.all()):
            return False
        scaled = scaled / rows
        scaled = scaled / np.linalg.norm(scaled, axis=(0, 1))
    if not np.max(np.linalg.cond(scaled)) <= SHAPE_CONDITION:
        return False
    return len(np.unique(np.sign(np.linalg.det(P)))) == 1


def tail_begins(values, noise):
    """Highest harmonic of a sampled periodic matrix (n_phases, …) that counts beside noise.

    The inverse in F = (P′ + P R) P⁻¹ has all harmonics, however few P has; they fall
    geometrically where P P₀⁻¹ stays near the identity. Noise is that of what the values were made
    from, in parts of its size.
    """
    highest = (len(values) - 1) // 2
    coefficients = sampled_harmonics(values, highest)
    sizes = np.sum(coefficients**2, axis=(1, 2))
    beyond = np.sqrt(np.cumsum(sizes[::-1])[::-1])[1::2]  # from harmonic 1, 2, … on
    counts = np.flatnonzero(beyond > max(TAIL * noise, EXACT) * np.sqrt(np.sum(sizes)))
    return int(counts[-1]) + 1 if len(counts) else 0


def equation_error(segments, period, n_phases, n_harmonics, instruments):
    """Fourier coefficients (2 H + 1, n, n) of F(ψ) from measured states.

    Segments are (states, inputs) from ψ = 0 on, with held inputs; instruments are states of less
    noise.

    Examples
    --------
    >>> x = np.exp(-0.5 * np.arange(0, 8, 0.01))[:, None]
    >>> F = equation_error([(x, np.zeros((800, 0)))], 1.0, 100, 0, [x])
    >>> F.round(3).tolist()
    [[[-0.5]]]
    """
    m, step = max(1, n_phases // INTERVALS), period / n_phases
    X, Z, target = [], [], []
    for (x, u), z in zip(segments, instruments, strict=True):
        psi = 2.0 * np.pi / n_phases * np.arange(len(x))
        functions = harmonic_functions(psi, range(n_harmonics + 1))
        X.append(step * _integrals(functions, x, u, m))
        Z.append(step * _integrals(functions, z, u, m))
        target.append(x[m:] - x[:-m])
    X, Z, target = map(np.vstack, (X, Z, target))
    size = column_sizes(Z)
    Q = linalg.qr(Z / size, mode="economic")[0]
    solution = linalg.lstsq(Q.T @ X / size, Q.T @ target, cond=1e-9)[0] / size[:, None]
    n, count = target.shape[1], 2 * n_harmonics + 1
    return solution[: count * n].reshape(count, n, n).transpose(0, 2, 1)


def _integrals(functions, x, u, m):
    """Of harmonics times states and held inputs, over m samples, in samples."""
    ends = times(functions, x)
    held = times(functions[:-1], u[:-1]) + times(functions[1:], u[:-1])
    rates = 0.5 * np.hstack([ends[1:] + ends[:-1], held])
    sums = np.vstack([np.zeros(rates.shape[1]), np.cumsum(rates, axis=0)])
    return sums[m:] - sums[:-m]
