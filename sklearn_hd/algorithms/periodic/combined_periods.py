"""Outputs of known F and P by parameters of G and Q, in few combinations of periods.

Period by period, whatever the parameters θ,

    z[k+1] = Φ z[k] + b(θ) w[k],   y[k] = O z[k] + h(θ) w[k],

w being the coordinates of an input's samples of a period in the directions that they move
in. Over k, all that θ and z[0] can do lies in the span of w and of what Φ answers to w and
z[0]. Linear combinations of periods that span it hold all that the record says of θ, and
least squares on more and more of its coefficients tell how many of them it shows.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, EXACT, TINY
from sklearn_hd.algorithms.linalg.triangular import column_sizes, svd_within_rank
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.periodic.multipliers import orthonormal_range

LEAST_SQUARE = 1e-28  # of the sum of squares: what rounding leaves
RATIOS = 2.0 ** np.arange(-104, 11)  # of variances, from rounding to nothing but noise


@dataclass(frozen=True, eq=False)
class CombinedPeriods:
    """Combinations of the periods of one segment."""

    directions: np.ndarray  # (r, n_phases, m): that inputs move in within a period
    mix: np.ndarray  # (d, r): inputs of each combination in these directions
    # (d, r, n, n): first state of each combination for each state that a period in one direction
    # leaves
    answers: np.ndarray
    # (d, n, s): first state of each combination for each unknown of the initial state
    starts: np.ndarray
    outputs: np.ndarray  # (n_phases, l, d)
    # bool, (n_phases, d): what of the combinations was measured; a segment's last period may be cut
    # short
    seen: np.ndarray
    first_phase: int = 0  # of the first sample of each period

    def columns(self, response, gains, direct, scale):
        """Outputs by the parameters and by the initial state, in parts of their scale.

        Parameters
        ----------
        response : SampledResponse
            Ψ and Out at θ = 0, both at all phases.
        gains : ndarray, shape (k, n_phases, n, m)
            What one unit of each parameter adds to Γ.
        direct : ndarray, shape (k, n_phases, l, m), or None
            What it adds to Q; nothing by default.

        Returns
        -------
        forced : ndarray, shape (n_rows, k)
            Per unit parameter.
        left : ndarray, shape (n_rows,)
            The outputs measured less what parameters of zero leave.
        free : ndarray, shape (n_rows, s)
        """
        n, k = response.n_states, len(gains)
        Psi, Out, gains = (
            np.roll(M, -self.first_phase, axis=-3) for M in (response.Psi, response.Out, gains)
        )
        gains = np.concatenate([gains, Psi[None, :, :, n:]])
        within, ends, sights = self._within(Psi[:, :, :n], Out[:, :, :n], gains)
        within[:, :, k:] += self._by_direction(Out[None, :, :, n:])
        if direct is not None:
            within[:, :, :k] += self._by_direction(np.roll(direct, -self.first_phase, axis=-3))
        begun = np.tensordot(ends, self.answers, ((0, 2), (2, 1)))  # (k + 1, d, n)
        forced = within @ self.mix.T + np.tensordot(sights, begun, (2, 2))
        free = np.tensordot(sights, self.starts, (2, 1)).swapaxes(2, 3)
        # samples of a combination one after the other
        rows = np.concatenate([forced, self.outputs[:, :, None], free], axis=2)
        rows = rows.transpose(3, 0, 1, 2)[self.seen.T] / scale[:, None]
        rows = rows.reshape(-1, rows.shape[2])
        return rows[:, :k], rows[:, k + 1] - rows[:, k], rows[:, k + 2 :]

    def unfolded(self, rows):
        """Rows of one column, where they stand in each combination, (n_phases, l, d)."""
        whole = np.zeros((self.seen.shape[1], len(self.seen), self.outputs.shape[1]))
        whole[self.seen.T] = rows.reshape(-1, self.outputs.shape[1])
        return whole.transpose(1, 2, 0)

    def _by_direction(self, gains):
        """What some gains (k, n_phases, a, m) make of each direction, (n_phases, a, k, r)."""
        return (gains @ self.directions.transpose(1, 2, 0)).transpose(1, 2, 0, 3)

    def _within(self, Phi, P, gains):
        """Outputs (n_phases, l, k, r) of a period from rest, its end (n, k, r), and what each
        sample sees of the state at its start, (n_phases, l, n)."""
        forcing = self._by_direction(gains)
        n, k_and_r = Phi.shape[1], forcing.shape[2:]
        v = forcing.reshape(len(Phi), n, -1)
        states, x = np.empty((len(Phi), n, v.shape[2] + n)), np.eye(n, v.shape[2] + n, v.shape[2])
        for j, factor in enumerate(Phi):
            states[j] = x
            x = factor @ x
            x[:, :-n] += v[j]
        outputs = P @ states
        within = outputs[..., :-n].reshape(*P.shape[:2], *k_and_r)
        return within, x[:, :-n].reshape(n, *k_and_r), outputs[..., -n:]


def combined_periods(Phi, u, y, n_phases, first_phase):
    """The combinations of a segment's periods in which Φ lets states move.

    ``Phi`` is that over a period from the first sample of the segment on. Returns
    (periods, combinations, rest). The ``starts`` of the periods are by the segment's
    own initial state. The combinations, (n_periods, d), are orthonormal. The rest,
    (n_periods, n_phases, l), is what of the outputs is in no combination.
    """
    n, whole = len(Phi), len(u) // n_phases
    size = column_sizes(u)
    n_periods = -(-len(u) // n_phases)
    filled = np.zeros((n_periods * n_phases, u.shape[1] + y.shape[1]))
    filled[: len(u)] = np.hstack([u / size, y])
    inputs, outputs = np.split(filled.reshape(n_periods, n_phases, -1), [u.shape[1]], axis=2)
    flat = inputs.reshape(n_periods, -1)
    W, values, Vt = svd_within_rank(flat, EPS * max(flat.shape))
    directions = (values[:, None] * Vt).reshape(-1, *inputs.shape[1:]) * size
    forcing = W.T[:, None, :, None] * np.eye(n)[:, None]
    forced = propagate(Phi, forcing, np.zeros((len(W.T), n, n))).transpose(2, 0, 1, 3)
    free = propagate(Phi, np.zeros((n, n_periods, n)), np.eye(n)).transpose(1, 2, 0)
    moves = np.hstack([M.reshape(n_periods, -1) for M in (W, forced, free)])[:whole]
    Q = orthonormal_range(moves, rank=EXACT) if whole else np.zeros((0, 0))
    T = linalg.block_diag(Q, np.eye(n_periods - whole))  # a period cut short stands alone
    flat = outputs.reshape(n_periods, -1)
    combined = T.T @ flat
    seen = np.ones((n_phases, T.shape[1]), dtype=bool)
    if whole < n_periods:
        seen[len(u) % n_phases :, -1] = False
    periods = CombinedPeriods(
        directions,
        T.T @ W,
        np.tensordot(T.T, forced, 1),
        np.tensordot(T.T, free, 1),
        combined.reshape(-1, *outputs.shape[1:]).transpose(1, 2, 0),
        seen,
        first_phase,
    )
    return periods, T, (flat - T @ combined).reshape(outputs.shape)


# ---- least squares ------------------------------------------------------------------------------


class NestedLeastSquares:
    """min |y − X b|², solved again after columns have been added to X.

    X = Q R grows by blocks: what is new in a block is found off Q, twice (Daniel and others,
    1976), so that no column is orthogonalised again. ``target`` is y.

    References
    ----------
    J. W. Daniel, W. B. Gragg, L. Kaufman, G. W. Stewart, "Reorthogonalization and stable
    algorithms for updating the Gram-Schmidt QR factorization", Mathematics of Computation 30
    (1976), 772-795.

    Examples
    --------
    >>> line = NestedLeastSquares(np.array([1.0, 2.0, 4.0]))
    >>> line.extend(np.ones((3, 1)))
    >>> line.solve()[0].round(6).tolist()
    [2.333333]
    >>> line.extend(np.array([[0.0], [1.0], [2.0]]))
    >>> line.solve()[0].round(6).tolist()
    [0.833333, 1.5]
    """

    def __init__(self, target):
        self.target, none = target, np.zeros((len(target), 0))
        self.columns, self.base, self.factor = none, none, np.zeros((0, 0))  # X, Q and R
        self.size, self.seen = np.zeros(0), np.zeros(0)

    def extend(self, columns):
        """Add columns (n_rows, k) to X."""
        size = column_sizes(columns)
        rest, inside = columns / size, np.zeros((len(self.factor), columns.shape[1]))
        for _ in range(2):
            share = self.base.T @ rest
            rest -= self.base @ share
            inside += share
        Q, own, order = linalg.qr(
            rest, mode="economic", pivoting=True, overwrite_a=True, check_finite=False
        )
        new = np.sum(np.abs(np.diagonal(own)) > EXACT)  # of what is none, Q would hold what it has
        R, below = np.zeros((new, len(order))), np.zeros((new, self.factor.shape[1]))
        Q, R[:, order] = Q[:, :new], own[:new]
        self.factor = np.block([[self.factor, inside], [below, R]])
        self.size, self.seen = np.append(self.size, size), np.append(self.seen, Q.T @ self.target)
        self.columns = np.hstack([self.columns, columns])
        self.base = np.hstack([self.base, Q])

    @property
    def undetermined(self):
        """Directions of b that y leaves open, in orthonormal rows, columns being of one length."""
        _, values, Vt = np.linalg.svd(self.factor)
        return Vt[np.sum(values > DEPENDENT * np.max(values, initial=0.0)) :]

    def solve(self, stiffness=None, beyond=0.0, n_rows=None):
        """The smoothest solution that explains y: stiffness_j b_j is white noise of variance τ².

        b_j is free where its stiffness is zero: the shortest solution, columns counted as of one
        length. Of y − X b, of variance σ², and of τ, the marginal likelihood is greatest.

        ``stiffness`` is zero by default: plain least squares. ``beyond`` is the sum of
        squares of rows that are in no column, and ``n_rows`` is the number of
        independent rows in all, by default that of y. Returns (b, y − X b, misfit). The
        misfit is −2 log of the marginal likelihood, but for a constant, plus log n_rows
        for τ where there is one (Schwarz).
        """
        stiffness = np.zeros(len(self.size)) if stiffness is None else stiffness
        n_rows = len(self.target) if n_rows is None else n_rows
        stiff = stiffness > 0.0
        free, held = self.factor[:, ~stiff], self.factor[:, stiff]
        held = held * (self.size[stiff] / stiffness[stiff])
        U, values, Vt = svd_within_rank(free)
        off = [each - U @ (U.T @ each) for each in (held, self.seen)]
        V, sizes, Wt = svd_within_rank(off[0])
        shown = V.T @ off[1]
        open_ = self.target - self.base @ self.seen, off[1] - V @ shown
        rest = beyond + sum(np.sum(each**2) for each in open_)
        ratio = np.max(sizes, initial=0.0) ** 2 * RATIOS[:, None]  # σ²/τ²
        squares = rest + np.sum(shown**2 * ratio / (sizes**2 + ratio), axis=1)
        least = LEAST_SQUARE * (np.sum(self.target**2) + beyond)
        misfit = n_rows * np.log(np.maximum(squares, max(least, TINY)))
        misfit += np.sum(np.log1p(sizes**2 / ratio), axis=1)
        best = np.argmin(misfit)
        solution = np.zeros(len(stiff))
        solution[stiff] = Wt.T @ (sizes * shown / (sizes**2 + ratio[best]))
        solution[~stiff] = Vt.T @ (U.T @ (self.seen - held @ solution[stiff]) / values)
        solution /= np.where(stiff, stiffness, self.size)
        misfit = misfit[best] + np.log(n_rows) * stiff.any()  # τ is a parameter
        return solution, self.target - self.columns @ solution, misfit
