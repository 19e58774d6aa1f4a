"""Multipliers of a Poincaré map, from what is seen once a period and from what is seen within.

    z[k+1] = Φ z[k] + B w[k],   y_j[k] = O_j z[k] + D_j w[k],   O_j = P(ψ_j) e^{R t_j}

The outputs of many periods tell multipliers near one; what a period forgets is told by the
samples within it: P(ψ) has few harmonics for the right R only.
"""

import numpy as np
from scipy import linalg
from scipy.optimize import least_squares
from scipy.signal import lfilter

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EXACT, PRECISION, TINY
from sklearn_hd.algorithms.linalg.triangular import column_sizes

LASTING = 1e-3  # of a motion, left after a period: what is less is not judged
LEAST_RATE = 0.02  # e-folds a period: smaller rates are judged as if they were as large
SURE = 2.0  # standard deviations that an estimate may be off by
SEPARATION = 1e-3  # multipliers or exponents nearer than this, relative, are not told apart
LARGEST_RESPONSE = 1e70  # alternating fits may come to its fourth power, and 1e308 overflows
PATIENCE = 2  # orders that may pass without a better one
WHITE_MARGIN = 1.3  # above it something stands out of the noise
TRACY_WIDOM = 3.27  # what one in a thousand exceeds; M. Prähofer's tables, β = 1


def refine_multipliers(Phi, directions, lifted, largest=None):
    """Φ whose multipliers explain the lifted outputs best, whatever else is.

    Every sample of the period answers to one Φ: with all else (how inputs and initial
    states enter, how outputs see the state) eliminated by projection (Golub and Pereyra,
    1973), the multipliers are left as the only unknowns. Two of them enter by the
    coefficients of z² − s z + p, so that a complex pair which noise has split into two real
    multipliers finds back, and the other way round. A start beyond 1 (noise alone makes one of
    multipliers of 0.04) has no way down: then smaller ones are tried, too.

    Parameters
    ----------
    Phi : ndarray, shape (n, n)
        To start from; keeps its eigenvectors, or the planes of pairs whose kind changes.
    directions : list of ndarray, shapes (n_periods_s, r)
        Inputs, from :func:`~sklearn_hd.algorithms.signals.fourier.input_directions`.
    lifted : list of ndarray, shapes (n_periods_s, q)
        Outputs of whole periods, in like units.
    largest : float, optional
        Size that multipliers may have; by default what a record can show, and a start
        beyond that is left as it is.

    Returns
    -------
    Phi : ndarray, shape (n, n)
        As given where multipliers are too close to be told apart, or the periods too few.
    """
    multipliers = linalg.eigvals(Phi)
    n, r = len(Phi), directions[0].shape[1]
    n_periods = sum(len(block) for block in lifted)
    size = np.max(np.abs(multipliers))
    gaps = np.abs(multipliers[:, None] - multipliers) + np.eye(n) * size
    seen = min(1e3 ** (1.0 / n_periods) + 0.5, LARGEST_RESPONSE ** (1.0 / max(map(len, lifted))))
    few = 2 * (r + n * (r + len(lifted))) > n_periods
    wild = largest is None and size >= seen
    if few or wild or not np.all(gaps > SEPARATION * size):
        return Phi
    largest = seen if largest is None else min(largest, seen)
    basis, blocks = invariant_blocks(Phi)
    edges = np.cumsum([len(block) for block in blocks])[:-1]
    elimination = _Elimination(edges, Modes(directions), compact(np.vstack(lifted)), largest)
    best = None
    starts = (size, 0.9, 0.3, 0.05) if size > 1.0 else (size,)  # of the largest multiplier
    for wanted in starts[int(size >= largest) :]:
        start = np.concatenate([characteristic(block * (wanted / size)) for block in blocks])
        found = least_squares(
            lambda c: elimination.factor(c)[:, -1],
            start,
            lambda c: elimination.factor(c)[:, :-1],
            x_scale="jac",
            xtol=1e-15,
            ftol=1e-12,
            gtol=1e-15,
            max_nfev=25,  # what is found takes ten; modes of noise would go on for hundreds
        )
        best = found if best is None or found.cost < best.cost else best
    moved = map(with_characteristic, blocks, np.split(best.x, edges))
    return basis @ linalg.block_diag(*moved) @ linalg.inv(basis)


def without_noise_growth(Phi, directions, lifted):
    """Φ as given where the lifted outputs tell that multipliers are beyond 1, else refined within.

    A mode that grows has to pay for what a state costs in the Bayesian information criterion: of
    modes that a period forgets noise makes what it will, growth too. Arguments are
    those of :func:`refine_multipliers`.
    """
    free = refine_multipliers(Phi, directions, lifted)
    if np.max(np.abs(linalg.eigvals(free))) <= 1.0:
        return free
    held = refine_multipliers(Phi, directions, lifted, 1.0)
    target = compact(np.vstack(lifted))
    n_free, price = cost_of_a_state(directions, lifted)
    least = EXACT**2 * float(np.sum(target**2))
    with_growth, without = (
        max(float(np.sum(left_by(M, directions, target) ** 2)), least) for M in (free, held)
    )
    return Phi if n_free * np.log(without / with_growth) > price else held


def multiplier_deviations(Phi, directions, lifted):
    """Multipliers of a map, and the standard deviations of their logarithms, refined or not.

    The noise is white. Its variance is the sum of squares left of the lifted outputs over the
    numbers that inputs and the modes' answers to them leave free. Of z² − s z + p an error
    e = z δs − δp moves a root by δz, δz² + (2 z − s) δz = e: by √e where the root is double, and
    by more towards the other root than away from it.

    Arguments are those of :func:`refine_multipliers`. The deviations are
    √(σ²_real + σ²_imag), infinite where no number is left free.
    """
    blocks, modes = invariant_blocks(Phi)[1], Modes(directions)
    edges = np.cumsum([len(block) for block in blocks])[:-1]
    target = compact(np.vstack(lifted))
    elimination = _Elimination(edges, modes, target, LARGEST_RESPONSE)
    coefficients = [characteristic(block) for block in blocks]
    R = elimination.factor(np.concatenate(coefficients))
    n_free = len(target) - modes.answers(coefficients).shape[1]
    if not n_free:
        return linalg.eigvals(Phi), np.full(len(Phi), np.inf)
    variance = np.sum(R[:, -1] ** 2) / (n_free * lifted[0].shape[1])
    spread = linalg.pinv(R[: len(Phi), : len(Phi)]) * np.sqrt(variance)
    found = []
    for own, rows in zip(coefficients, np.split(spread, edges), strict=True):
        for z in np.roots(np.append([1.0, -own[0]], own[1:])).astype(complex):
            moved = np.linalg.norm(np.array([1.0] if len(own) == 1 else [z, -1.0]) @ rows)
            if len(own) == 2:
                gap = abs(2.0 * z - own[0])
                away = 2.0 * moved / max(gap + np.sqrt(gap**2 + 4.0 * moved), TINY)
                far = SURE * moved
                meet = gap**2 <= 4.0 * far
                near = np.sqrt(far) if meet else 0.5 * (gap - np.sqrt(gap**2 - 4.0 * far))
                moved = max(away, near / SURE)
            found.append((z, moved / abs(z) if abs(z) > TINY else np.inf))
    multipliers, deviations = zip(*found, strict=True)
    return np.array(multipliers), np.array(deviations)


class Modes:
    """Answers of the modes of a map to inputs and initial states, by their polynomials.

    A mode of z² − s z + p answers to w[k] by x[k+1] = s x[k] − p x[k−1] + w[k]; x[k] and x[k−1]
    are its coordinates. ``directions`` are inputs, one array (n_periods_s, r) a
    segment.
    """

    def __init__(self, directions):
        self.inputs, ends = np.vstack(directions), np.cumsum([len(w) for w in directions])
        self.firsts = np.unique(np.append(0, ends[:-1])[np.diff(ends, prepend=0) > 0])
        starts = np.zeros((len(self.inputs), len(self.firsts)))
        starts[self.firsts, range(len(self.firsts))] = 1.0
        self.sources = np.hstack([self.later(self.inputs), starts])

    def responses(self, steps):
        """x of each mode for inputs and initial states, and all coordinates side by side."""
        states, columns = [], [self.inputs[:, :0]]
        for coefficients in steps:
            states.append(self.answer(coefficients, self.sources))
            columns += [states[-1], self.later(states[-1])][: len(coefficients)]
        return states, np.hstack(columns)

    def answers(self, steps):
        """Orthonormal columns of all that inputs, and the modes' answers, can explain."""
        return orthonormal_range(np.hstack([self.inputs, self.responses(steps)[1]]))

    def answer(self, coefficients, sources):
        """x of the mode of some characteristic polynomial, shape (n_periods, n_sources)."""
        polynomial, x = np.append([1.0, -coefficients[0]], coefficients[1:]), sources.copy()
        for part in np.split(x, self.firsts[1:]):
            part[:] = lfilter([1.0], polynomial, part, axis=0)
        return x

    def later(self, x):
        """Each row where the next one of its segment is; zero in a segment's first."""
        later = np.zeros_like(x)
        later[1:] = x[:-1]
        later[self.firsts] = 0.0
        return later


class _Elimination:
    """What is left of the lifted outputs once all but the multipliers is eliminated.

    With the responses M(c) of the modes to every input and initial state, r = P⊥ T, P⊥ = 1 − M M⁻,

        ∂r/∂c = −P⊥ ∂M M⁻ T − (P⊥ ∂M M⁻)ᵀ T              (Golub and Pereyra, 1973)

    ∂x/∂s is a mode's answer to x itself, ∂x/∂p to −x[k−1].

    ``edges`` says where the coefficients c are divided between the modes, and
    ``target`` is T, (n_periods, q). No mode is simulated whose multiplier has the size
    ``largest`` or more.
    """

    def __init__(self, edges, modes, target, largest):
        self.edges, self.modes, self.target, self.largest = edges, modes, target, largest
        self._last = None, None

    def left(self, coefficients):
        """r, shape (n_periods q,), and ∂r/∂c, shape (n_periods q, n)."""
        modes, target, n = self.modes, self.target, len(coefficients)
        steps = np.split(coefficients, self.edges)
        roots = [np.roots(np.append([1.0, -c[0]], c[1:])) for c in steps]
        if not np.max(np.abs(np.concatenate(roots))) < self.largest:
            return target.ravel(), np.zeros((target.size, n))
        states, answers = modes.responses(steps)
        M = np.hstack([modes.inputs, answers])
        size = column_sizes(M)
        Q, R, kept = linalg.qr(M / size, mode="economic", pivoting=True, check_finite=False)
        independent = np.abs(np.diag(R)) > DEPENDENT
        Q, R = Q[:, independent], R[np.ix_(independent, independent)]
        kept = kept[: len(independent)][independent]
        explained = Q.T @ target
        left = target - Q @ explained
        inverse = linalg.solve_triangular(R * size[kept], np.eye(len(R)), check_finite=False)
        weights = np.zeros((M.shape[1], target.shape[1]))
        weights[kept] = inverse @ explained
        moved, reached = np.zeros((n, *target.shape)), np.zeros((n, *weights.shape))
        i, at = 0, modes.inputs.shape[1]
        for values, x in zip(steps, states, strict=True):
            rate = modes.answer(values, modes.later(x))
            for _ in values:  # x[k], then x[k−1]
                place = slice(at, at + rate.shape[1])
                moved[i] += rate @ weights[place]
                reached[i, place] = rate.T @ left
                rate, at = modes.later(rate), place.stop
                if len(values) == 2:
                    reached[i + 1, place] = -(rate.T @ left)
            if len(values) == 2:
                moved[i + 1] = -modes.later(moved[i])
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


def invariant_blocks(M):
    """Real coordinates in which M is block diagonal: complex pairs, real pairs, one single.

    Real eigenvalues pair up with their neighbours; of an odd number the largest stays
    alone. Returns (basis, blocks): M basis = basis diag(blocks). Blocks have shapes
    (2, 2) and (1, 1). The columns of a pair are orthonormal.
    """
    values, V = linalg.eig(M)
    real = np.flatnonzero(values.imag == 0.0)
    real = real[np.argsort(values[real].real)]
    if len(real) % 2:
        single = np.argmax(np.abs(values[real]))
        real = np.append(np.delete(real, single), real[single])
    spans = [np.stack([v.real, v.imag], axis=1) for v in V.T[values.imag > 0.0]]
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

    The coefficients of a block (1, 1) are its eigenvalue, those of a block (2, 2) are
    trace s and determinant p.
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

    ``beyond`` has orthonormal columns; what they span is left out. ``rank`` is how much
    has to be new in a column of length one that counts as independent.

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


def polynomials(Phi):
    """Coefficients of the polynomial of each real mode and each complex pair of Φ."""
    values = linalg.eigvals(Phi) if len(Phi) else np.zeros(0)
    return [
        np.array([2.0 * z.real, abs(z) ** 2] if z.imag else [z.real])
        for z in values[values.imag >= 0.0]
    ]


# ---- how many there are --------------------------------------------------------------------------


def order_by_residual(candidates, directions, lifted):
    """Which of some maps Φ, of rising order, the lifted outputs call for.

    The order of the least Bayesian information criterion, or the next one that leaves white
    noise. Systematic errors (a nonlinear system's) call for ever more states: then the last order
    that brought down the sum of squares left by half a decade.

    ``candidates`` have the orders 1, 2, …; ``directions`` and ``lifted`` are those of
    :func:`refine_multipliers`. The candidate chosen is returned as given, not refined.
    """
    n_columns, r = lifted[0].shape[1], directions[0].shape[1]
    target = compact(np.vstack(lifted))
    n_free, price = cost_of_a_state(directions, lifted)
    left, bic = [left_by(np.zeros((0, 0)), directions, target)], [np.inf]
    for Phi in candidates:
        refined = refine_multipliers(Phi, directions, lifted)
        left.append(left[-1])
        bic.append(np.inf)
        if not turned_back(refined)[1] and not outgrows_numbers(refined, max(map(len, lifted))):
            left[-1] = left_by(refined, directions, target)
            rss = max(float(np.sum(left[-1] ** 2)), EXACT**2 * float(np.sum(target**2)))
            bic[-1] = n_free * np.log(rss / n_free) + len(Phi) * price
        if min(bic) < np.inf and np.argmin(bic) < len(bic) - PATIENCE:
            break
    best = int(np.argmin(bic))
    for n in range(max(best, 1), len(left)):
        if is_noise(left[n], len(target) - r - n, n_columns):
            return candidates[n - 1]  # more states than the criterion pays for
    if not _is_white(left[best], n_columns):
        sizes = np.linalg.norm(left, axis=(1, 2))
        drops = np.flatnonzero(sizes[:-1] >= 10.0**0.25 * sizes[1:])
        best = min(best, int(drops[-1]) + 1 if len(drops) else 1)
    return candidates[max(best, 1) - 1]


def cost_of_a_state(directions, lifted):
    """Numbers that inputs leave free, and what a state costs in the Bayesian criterion."""
    n_columns, r = lifted[0].shape[1], directions[0].shape[1]
    n_free = (sum(map(len, lifted)) - r) * n_columns
    # its column of O, its row of B, initial states
    return n_free, (n_columns + r + len(lifted)) * np.log(n_free)


def turned_back(Phi):
    """A map Φ that a periodic system may have: negative real multipliers are even in number.

    det Φ = e^{∫ tr F dt} > 0 (Liouville). Noise turns the sign of what a period forgets: of an odd
    number the smallest is turned back. Returns (Phi, turned): the map, and the negative
    multiplier that was turned, 0 if none was.

    Examples
    --------
    >>> Phi, turned = turned_back(np.diag([0.5, -0.01]))
    >>> Phi.round(12).tolist(), round(turned, 12)
    ([[0.5, 0.0], [0.0, 0.01]], -0.01)
    """
    values, V = linalg.eig(Phi)
    negative = np.flatnonzero((values.imag == 0.0) & (values.real < 0.0))
    if len(negative) % 2 == 0:
        return Phi, 0.0
    k = negative[np.argmin(np.abs(values[negative]))]
    values[k] = -values[k]
    return np.real(V @ np.diag(values) @ linalg.inv(V)), -float(values[k].real)


def outgrows_numbers(Phi, n_periods):
    """Whether a mode grows within some periods beyond what numbers, and records, can hold."""
    largest = np.max(np.abs(linalg.eigvals(Phi)), initial=1.0)
    return n_periods * np.log(largest) > np.log(LARGEST_RESPONSE)


def left_by(Phi, directions, target):
    """Lifted outputs less what inputs and as many states as Φ has can explain.

    The states move in n of the directions in which n modes could answer to every input and
    initial state: the best n of them (reduced-rank regression, Anderson, 1951). All of
    them together would fit the noise, the more the more directions the inputs have.
    """
    modes = Modes(directions)
    Q = orthonormal_range(modes.inputs)
    left = target - Q @ (Q.T @ target)
    Q = orthonormal_range(modes.responses(polynomials(Phi))[1], beyond=Q)
    within = Q.T @ left
    U = linalg.svd(within, full_matrices=False)[0][:, : len(Phi)]
    return left - Q @ (U @ (U.T @ within))


def leaves_white_noise(Phi, directions, lifted):
    """Whether what the multipliers of Φ leave of the lifted outputs is white noise, or rounding.

    If so, :func:`refine_multipliers` is the estimate of largest likelihood; if not, the squares it
    minimises are systematic errors, and it has no claim to be the better one.
    """
    target = compact(np.vstack(lifted))
    rest = left_by(Phi, directions, target)
    rounding = np.linalg.norm(rest) <= PRECISION * np.linalg.norm(target)
    return bool(rounding) or _is_white(rest, lifted[0].shape[1])


def without_noise(Phi, directions, lifted):
    """Lifted outputs as far as inputs and the modes of Φ explain them, whatever O is.

    With Φ but roughly right still close to the truth where a period forgets most.
    """
    steps = Phi / max(1.0, np.max(np.abs(linalg.eigvals(Phi))))
    Q = Modes(directions).answers(polynomials(steps))
    edges = np.cumsum([len(block) for block in lifted])[:-1]
    return np.split(Q @ (Q.T @ np.vstack(lifted)), edges)


def _is_white(rest, n_columns):
    """Whether no direction stands out of what is left (Marchenko and Pastur, 1967)."""
    sigma = np.linalg.norm(rest) / np.sqrt(len(rest) * n_columns)
    largest = np.linalg.norm(rest, 2)
    return largest <= WHITE_MARGIN * sigma * (np.sqrt(len(rest)) + np.sqrt(n_columns))


def is_noise(rest, n_rows, n_columns):
    """Whether the strongest direction of what is left may be white noise's (Johnstone, 2001).

    Its variance in parts of the noise's, less its expectation, in parts of its spread has
    Tracy and Widom's distribution. ``rest`` is what is left, or fewer columns with the
    same scalar products. ``n_rows`` counts the periods less the directions taken out,
    and ``n_columns`` the columns of what is left.
    """
    variance = float(np.sum(rest**2)) / (n_rows * n_columns)
    a, b = np.sqrt(n_rows - 1.0), np.sqrt(n_columns)
    spread = (a + b) * (1.0 / a + 1.0 / b) ** (1.0 / 3.0)
    return bool(np.linalg.norm(rest, 2) ** 2 <= variance * ((a + b) ** 2 + TRACY_WIDOM * spread))
