"""Multipliers of a Poincaré map, from what is seen once a period and from what is seen within.

    z[k+1] = Φ z[k] + B w[k],   y_j[k] = O_j z[k] + D_j w[k],   O_j = P(ψ_j) e^{R t_j}

The outputs of many periods tell multipliers near one; what a period forgets is told by the
samples within it: P(ψ) has few harmonics for the right R only.
"""

import numpy as np
from scipy import linalg
from scipy.optimize import least_squares
from scipy.signal import lfilter

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.lti.structured_model import column_sizes

SEPARATION = 1e-3  # multipliers or exponents nearer than this, relative, are not told apart
LARGEST_RESPONSE = 1e100  # squares of more than 1e154 overflow
SMALLER = (0.9, 0.3, 0.05)  # sizes of the largest multiplier to start from where it is above 1
MAX_STEPS = 25  # what is found takes ten; modes of noise would go on for hundreds


def refine_multipliers(Phi, directions, lifted):
    """Φ whose multipliers explain the lifted outputs best, whatever else is.

    Every sample of the period answers to one Φ: with all else (how inputs and initial
    states enter, how outputs see the state) eliminated by projection (Golub and Pereyra,
    1973), the multipliers are left as the only unknowns. Two of them enter by the
    coefficients of z² − s z + p, so that a complex pair which noise has split into two real
    multipliers finds back, and the other way round.

    Parameters
    ----------
    Phi : ndarray, shape (n, n)
        To start from; keeps its eigenvectors, or the planes of pairs whose kind changes.
    directions : list of ndarray, shapes (n_periods_s, r)
        Inputs, from :func:`~sklearn_hd.algorithms.signals.lifting.input_directions`.
    lifted : list of ndarray, shapes (n_periods_s, q)
        Outputs of whole periods, in like units.

    Returns
    -------
    Phi : ndarray, shape (n, n)
        As given where multipliers are too close to be told apart, or the periods too few.
    """
    multipliers = linalg.eigvals(Phi)
    n, r = len(Phi), directions[0].shape[1]
    n_periods = sum(len(block) for block in lifted)
    gaps = np.abs(multipliers[:, None] - multipliers) + np.eye(n) * np.max(np.abs(multipliers))
    if 2 * (r + n * (r + len(lifted))) > n_periods or not np.all(
        gaps > SEPARATION * np.max(np.abs(multipliers))
    ):
        return Phi
    largest = min(1e3 ** (1.0 / n_periods) + 0.5, LARGEST_RESPONSE ** (1.0 / max(map(len, lifted))))
    if np.max(np.abs(multipliers)) >= largest:
        return Phi
    basis, blocks = invariant_blocks(Phi)
    elimination = _Elimination(blocks, directions, compact(np.vstack(lifted)), largest)
    found = _best_of(elimination, blocks)
    moved = [
        with_characteristic(block, values)
        for block, values in zip(blocks, elimination.by_block(found.x), strict=True)
    ]
    return basis @ linalg.block_diag(*moved) @ linalg.inv(basis)


class _Elimination:
    """What is left of the lifted outputs once all but the multipliers is eliminated.

    With the responses M(c) of the modes to every input and initial state, r = P⊥ T, P⊥ = 1 − M M⁻,

        ∂r/∂c = −P⊥ ∂M M⁻ T − (P⊥ ∂M M⁻)ᵀ T              (Golub and Pereyra, 1973)

    A mode of z² − s z + p answers to w[k] by x[k+1] = s x[k] − p x[k−1] + w[k]; x[k] and x[k−1]
    are its coordinates. ∂x/∂s is its answer to x itself, ∂x/∂p to −x[k−1].

    Parameters
    ----------
    blocks : list of ndarray
        Whose characteristic polynomials have the coefficients c.
    directions : list of ndarray, shapes (n_periods_s, r)
    target : ndarray, shape (n_periods, q)
        T.
    largest : float
        Size of a multiplier from which on no mode is simulated.
    """

    def __init__(self, blocks, directions, target, largest):
        self.edges = np.cumsum([len(block) for block in blocks])[:-1]
        self.target, self.largest = target, largest
        ends = np.cumsum([len(w) for w in directions])
        self.segments = [
            slice(end - len(w), end) for w, end in zip(directions, ends, strict=True) if len(w)
        ]
        self.inputs = np.vstack(directions)
        starts = np.zeros((len(target), len(self.segments)))
        starts[[segment.start for segment in self.segments], range(len(self.segments))] = 1.0
        self.sources = np.hstack([self._later(self.inputs), starts])
        self._last = None, None

    def by_block(self, coefficients):
        """The coefficients of each block's polynomial."""
        return np.split(coefficients, self.edges)

    def left(self, coefficients):
        """r, shape (n_periods q,), and ∂r/∂c, shape (n_periods q, n)."""
        n, q = len(coefficients), self.target.shape[1]
        found = self._project(coefficients)
        if found is None:
            return self.target.ravel(), np.zeros((self.target.size, n))
        states, Q, R, kept, explained, left = found
        inverse = linalg.solve_triangular(R, np.eye(len(R)), check_finite=False)
        weights = np.zeros((self.inputs.shape[1] + n * self.sources.shape[1], q))
        weights[kept] = inverse @ explained
        moved, reached = np.zeros((n, *self.target.shape)), np.zeros((n, *weights.shape))
        i, at = 0, self.inputs.shape[1]
        for values, x in zip(self.by_block(coefficients), states, strict=True):
            rate = self._answer(values, self._later(x))
            for _ in values:  # x[k], then x[k−1]
                place = slice(at, at + rate.shape[1])
                moved[i] += rate @ weights[place]
                reached[i, place] = rate.T @ left
                rate, at = self._later(rate), place.stop
                if len(values) == 2:
                    reached[i + 1, place] = -(rate.T @ left)
            if len(values) == 2:
                moved[i + 1] = -self._later(moved[i])
            i += len(values)
        inside = inverse.T @ reached[:, kept] - Q.T @ moved
        return left.ravel(), -(moved + Q @ inside).reshape(n, -1).T

    def factor(self, coefficients):
        """Triangular factor of [∂r/∂c r], shape (n + 1, n + 1): few numbers, the same products."""
        asked, factor = self._last
        if asked is None or not np.array_equal(asked, coefficients):
            left, jacobian = self.left(coefficients)
            factor = np.linalg.qr(np.column_stack([jacobian, left]), mode="r")
            self._last = coefficients.copy(), factor
        return factor

    def _project(self, coefficients):
        """Answers of each block, Q R of independent columns of M and which they are, what they
        explain and what they leave; None beyond what is simulated."""
        steps = self.by_block(coefficients)
        if not max(map(_largest_root, steps)) < self.largest:
            return None
        states = [self._answer(values, self.sources) for values in steps]
        columns = [self.inputs]
        for values, x in zip(steps, states, strict=True):
            columns += [x, self._later(x)][: len(values)]
        M = np.hstack(columns)
        size = column_sizes(M)
        Q, R, order = linalg.qr(M / size, mode="economic", pivoting=True, check_finite=False)
        kept = np.abs(np.diag(R)) > DEPENDENT
        Q, R, order = Q[:, kept], R[np.ix_(kept, kept)], order[kept]
        explained = Q.T @ self.target
        return states, Q, R * size[order], order, explained, self.target - Q @ explained

    def _answer(self, coefficients, sources):
        """x of the mode of some characteristic polynomial, shape (n_periods, n_sources)."""
        signs = [-1.0, 1.0][: len(coefficients)]
        polynomial, x = np.append(1.0, signs * coefficients), np.empty_like(sources)
        for segment in self.segments:
            x[segment] = lfilter([1.0], polynomial, sources[segment], axis=0)
        return x

    def _later(self, x):
        """Each row where the next one of its segment is; zero in a segment's first."""
        later = np.zeros_like(x)
        for segment in self.segments:
            later[segment.start + 1 : segment.stop] = x[segment.start : segment.stop - 1]
        return later


def _largest_root(coefficients):
    """Size of the largest root of z − c₀, or of z² − c₀ z + c₁."""
    if len(coefficients) == 1:
        return abs(coefficients[0])
    half, product = 0.5 * coefficients[0], coefficients[1]
    square = half * half - product
    return np.sqrt(product) if square < 0.0 else abs(half) + np.sqrt(square)


def _best_of(elimination, blocks):
    """Least squares from the multipliers given, and from smaller ones where they are too large.

    A start beyond 1 (noise alone makes one of multipliers of 0.04) has no way down.
    """
    size = max(np.max(np.abs(linalg.eigvals(block))) for block in blocks)
    wanted = [size] + [value for value in SMALLER if size > 1.0]
    searches = []
    for value in wanted:
        start = np.concatenate([characteristic(block * (value / size)) for block in blocks])
        searches.append(
            least_squares(
                lambda c: elimination.factor(c)[:, -1],
                start,
                lambda c: elimination.factor(c)[:, :-1],
                x_scale="jac",
                xtol=1e-15,
                ftol=1e-12,
                gtol=1e-15,
                max_nfev=MAX_STEPS,
            )
        )
    return min(searches, key=lambda search: search.cost)


def invariant_blocks(M):
    """Real coordinates in which M is block diagonal: complex pairs, real pairs, one single.

    Real eigenvalues pair up with their neighbours; of an odd number the largest stays alone.

    Returns
    -------
    basis : ndarray, shape (n, n)
        M basis = basis diag(blocks); columns of a pair are orthonormal.
    blocks : list of ndarray, shapes (2, 2) and (1, 1)
    """
    values, V = linalg.eig(M)
    real = np.flatnonzero(values.imag == 0.0)
    real = real[np.argsort(values[real].real)]
    if len(real) % 2:
        single = np.argmax(np.abs(values[real]))
        real = np.append(np.delete(real, single), real[single])
    spans = [V[:, [i]] for i in np.flatnonzero(values.imag > 0.0)]
    spans = [np.hstack([v.real, v.imag]) for v in spans]
    spans += [V[:, real[i : i + 2]].real for i in range(0, len(real), 2)]
    basis = np.hstack([linalg.qr(span, mode="economic")[0] for span in spans])
    inside, at, blocks = linalg.solve(basis, M @ basis), 0, []
    for span in spans:
        rows = slice(at, at + span.shape[1])
        blocks.append(inside[rows, rows])
        at = rows.stop
    return basis, blocks


def characteristic(block):
    """Of the characteristic polynomial: the eigenvalue, or trace and determinant of a pair.

    The determinant by its eigenvalues: ad − bc cancels where one of them is tiny.
    """
    values = linalg.eigvals(block)
    return np.array([np.sum(values).real, np.prod(values).real][: len(block)])


def with_characteristic(block, coefficients):
    """The block with another characteristic polynomial, and its eigenvectors if they can stay.

    M = s/2 I + N, N² = (s²/4 − p) I: a pair that stays real, or complex, has N scaled. For
    one that changes, N = [0 b; c 0] in coordinates of equal diagonal keeps the larger of
    b and c: near the double eigenvalue in between, the other one is all that matters.

    Parameters
    ----------
    block : ndarray, shape (1, 1) or (2, 2)
    coefficients : ndarray, shape (1,) or (2,)
        Eigenvalue; or trace s and determinant p.

    Returns
    -------
    block : ndarray, of the same shape
    """
    if len(block) == 1:
        return np.reshape(coefficients, (1, 1))
    trace, determinant = coefficients
    N = _traceless(block - 0.5 * np.trace(block) * np.eye(2), 0.25 * trace**2 - determinant)
    return 0.5 * trace * np.eye(2) + N


def _traceless(N, wanted):
    """The matrix nearest in kind to N whose square is a wanted number."""
    square = N[0, 0] ** 2 + N[0, 1] * N[1, 0]
    if square * wanted > 0.0:
        return N * np.sqrt(wanted / square)
    angle = 0.5 * np.arctan2(-2.0 * N[0, 0], N[0, 1] + N[1, 0])
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    b, c = (turn.T @ N @ turn)[[0, 1], [1, 0]]
    kept = b if abs(b) >= abs(c) else c
    kept = np.copysign(max(abs(kept), np.sqrt(abs(wanted))), kept)
    moved = np.array([[0.0, kept], [wanted / kept if kept else 0.0, 0.0]])
    return turn @ (moved if abs(b) >= abs(c) else moved.T) @ turn.T


def compact(stacked):
    """Rows with the same scalar products, as few columns as there are rows."""
    if stacked.shape[1] <= len(stacked):
        return stacked
    return linalg.qr(stacked.T, mode="r")[0][: len(stacked)].T


def orthonormal_range(columns, beyond=None, rank=DEPENDENT):
    """Orthonormal columns that span what some columns do, dependent ones left out.

    What a mode answers to a step is the step less its answers to the step's edges: nothing
    new where edges have directions of their own. An orthonormal column in its place would
    be any direction, would fit noise, and would jump as multipliers move.

    Parameters
    ----------
    columns : ndarray, shape (n_rows, n_columns)
    beyond : ndarray, shape (n_rows, n_known), optional
        Orthonormal; what they span is left out.
    rank : float, default=1.5e-11
        Of columns of length one, what is new in one that counts as independent.

    Returns
    -------
    Q : ndarray, shape (n_rows, n_independent)

    Examples
    --------
    >>> orthonormal_range(np.array([[2.0, 1.0], [2.0, 1.0]])).round(6).tolist()
    [[-0.707107], [-0.707107]]
    """
    columns = columns / column_sizes(columns)
    if beyond is not None:
        columns = columns - beyond @ (beyond.T @ columns)
    if not columns.size:
        return columns
    Q, R, _ = linalg.qr(columns, mode="economic", pivoting=True)
    return Q[:, np.abs(np.diag(R)) > rank]


def mode_steps(Phi):
    """Step of each real mode and each complex pair of Φ."""
    values = linalg.eigvals(Phi) if len(Phi) else np.zeros(0, dtype=complex)
    return [
        np.array([[z.real, z.imag], [-z.imag, z.real]]) if z.imag else np.array([[z.real]])
        for z in values[values.imag >= 0.0]
    ]


def mode_responses(steps, directions):
    """Inputs, and the responses of each mode to each of them and to each initial state.

    Returns
    -------
    responses : list of ndarray, shapes (n_periods_s, r + (r + n_segments) n)
    """
    return _beside(directions, mode_states(steps, directions))


def _beside(directions, states):
    return [np.hstack([w, x.reshape(len(w), -1)]) for w, x in zip(directions, states, strict=True)]


def mode_states(steps, directions):
    """States of each mode for each input, and for each segment's initial state.

    Pushed in the last coordinate of its step, the coordinates of a pair span what it can do.

    Returns
    -------
    states : list of ndarray, shapes (n_periods_s, r + n_segments, n)
    """
    step = linalg.block_diag(*steps) if steps else np.zeros((0, 0))
    push = np.concatenate([[0.0] * (len(each) - 1) + [1.0] for each in steps] or [np.zeros(0)])
    n, states = len(step), []
    for s, w in enumerate(directions):
        forced = propagate(step, w.T[:, :, None] * push, np.zeros((w.shape[1], n)))
        free = np.zeros((len(directions), len(w), n))
        free[s] = propagate(step, np.zeros((len(w), n)), push)
        states.append(np.concatenate([forced, free]).transpose(1, 0, 2))
    return states
