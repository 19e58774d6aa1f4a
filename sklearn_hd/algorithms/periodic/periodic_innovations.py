"""Discrete periodic innovations models: simulation, prediction, multipliers, continuous time.

    x[k+1] = A(ψ_k) x + B(ψ_k) u + a(ψ_k) + K(ψ_k) e,    y[k] = C(ψ_k) x + D(ψ_k) u + c(ψ_k) + e[k]

with ψ_{k+1} = ψ_k + δ, any δ. The Floquet multipliers are the eigenvalues of the product of A over
a turn. Where a turn holds no whole number of samples, each step is made a little longer, to one of
2π/q with whole q: what it passes beyond its end is a small power of the transition there. Over a
turn every azimuth is passed once, so the error is of second order in that little.

Without one of its Floquet modes, the other modes of a model span a subspace that A(ψ) carries from
sample to sample, and that turns with ψ. Its coordinates V(ψ) are orthonormal at every azimuth. They
do not turn within the subspace (parallel transport), so that they have few harmonics. After 2π they
are turned by a rotation R, which is taken back evenly,

    V_k ← V_k exp(−(k/q) log R),   k = 0 … q − 1

If R is a reflection, the subspace has no coordinates that repeat every turn. That is so where one
mode of a negative multiplier is left out, or left alone.

The reading of samples (:mod:`sklearn_hd._identify.sample`) needs it.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import EXACT, HALF, OVERFLOW, PRECISION
from sklearn_hd.algorithms.linalg.triangular import solve_within_rank
from sklearn_hd.algorithms.periodic.floquet import product_logarithms, product_of
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, sampled_harmonics

MOST_TURNS = 40  # over which the Riccati equation is stepped, where it does not forget sooner


@dataclass(frozen=True, eq=False)
class PeriodicInnovations:
    """A discrete periodic innovations model by its Fourier coefficients."""

    # (2 H + 1, n + l, n + m + 1): of [A B a; C D c](ψ), in the order 0, 1c, 1s, …
    coefficients: np.ndarray
    gain: np.ndarray  # (2 H + 1, n, l): of K(ψ)
    covariance: np.ndarray  # (l, l): of the innovations
    step: float  # δ, radians from sample to sample
    start: float = 0.0  # ψ of a sample that the model was made from

    @property
    def n_states(self):
        """Number of states."""
        return self.gain.shape[1]

    @property
    def n_outputs(self):
        """Number of outputs."""
        return self.gain.shape[2]

    @property
    def n_inputs(self):
        """Number of inputs."""
        return self.coefficients.shape[2] - self.n_states - 1

    @property
    def n_harmonics(self):
        """Highest harmonic of A, B, C, D and K that is not zero; a and c may have more."""
        parts = [self.coefficients[..., :-1], self.gain]
        moving = [np.flatnonzero(np.any(part != 0.0, axis=(1, 2))) for part in parts]
        return max((int(each[-1]) + 1) // 2 for each in moving if len(each))

    def matrices(self):
        """Fourier coefficients of A, B, C and D."""
        M, n = self.coefficients, self.n_states
        return M[:, :n, :n], M[:, :n, n:-1], M[:, n:, :n], M[:, n:, n:-1]

    def rows(self, psi):
        """The model at the samples of one segment."""
        sampled, K = evaluate_harmonics(self.coefficients, psi), evaluate_harmonics(self.gain, psi)
        n = self.n_states
        return Rows(sampled[:, :n], sampled[:, n:], K)

    def about(self, input_mean, output_mean):
        """The model of signals about whose periodic means this one is.

        Means are Fourier coefficients, (2 L + 1, m) and (2 L + 1, l).
        """
        n, L = self.n_states, len(input_mean) // 2
        H = len(self.coefficients) // 2 + L
        psi = 2.0 * np.pi * np.arange(2 * H + 1) / (2 * H + 1)
        values = evaluate_harmonics(self.coefficients, psi)
        u, y = evaluate_harmonics(input_mean, psi), evaluate_harmonics(output_mean, psi)
        values[:, :, -1] -= np.einsum("tij,tj->ti", values[:, :, n:-1], u)
        values[:, n:, -1] += y
        whole = resize_harmonics(self.coefficients, H)
        whole[:, :, -1] = sampled_harmonics(values[:, :, -1:], H)[:, :, 0]
        return replace(self, coefficients=whole, gain=resize_harmonics(self.gain, H))

    def in_units(self, u_scale, y_scale):
        """The model between signals that were divided by some scales."""
        coefficients, n = self.coefficients.copy(), self.n_states
        coefficients[:, n:] *= y_scale[:, None]
        coefficients[:, :, n:-1] /= u_scale
        covariance = self.covariance * y_scale[:, None] * y_scale
        return replace(
            self, coefficients=coefficients, gain=self.gain / y_scale, covariance=covariance
        )

    @property
    def samples_per_period(self):
        """Samples in a turn, whole or not."""
        return 2.0 * np.pi / self.step

    def whole_turn(self):
        """The model with a whole number of samples in a turn, without innovations.

        Where δ is no whole part of a turn, each step is made longer by the power
        ε = 2π/(δ q) − 1 of the transition about its own end, q the whole samples in a
        turn. Returns (psi, states, outputs): the q azimuths; [A B a] of steps of 2π/q,
        (q, n, n + m + 1); and [C D c], (q, l, n + m + 1).
        """
        q = max(1, int(np.floor(self.samples_per_period * (1.0 + PRECISION))))
        longer = self.samples_per_period / q - 1.0
        psi = self.start + 2.0 * np.pi * np.arange(q) / q
        rows = self.rows(psi)
        states = rows.states
        if abs(longer) > PRECISION:
            n = self.n_states
            rest = _power(self.rows(psi + np.pi / q).states, longer)
            states = rest[..., :n] @ states
            states[..., n:] += rest[..., n:]
        return psi, states, rows.outputs

    def multiplier_logarithms(self):
        """Logarithms of the Floquet multipliers, complex, shape (n,); the slowest first."""
        _, states, _ = self.whole_turn()
        found = product_logarithms(states[..., : self.n_states])
        return found[np.lexsort((found.imag, -found.real))]

    def multiplier_slopes(self):
        """Logarithms of the multipliers known to half of their digits, and their slopes by A.

            ∂ ln μ / ∂A_k = l[k+1] r[k]ᵀ / (μ l[0]ᵀ r[0])

        r and l being right and left eigenvectors of the transition over a turn that begins at
        ψ_k. A step made longer counts as one of its new length. Returns
        (logarithms, psi, slopes) of shapes (k,), (q,) and (k, q, n, n).
        """
        psi, states, _ = self.whole_turn()
        n, q = self.n_states, len(psi)
        right, left = np.empty((q + 1, n, n)), np.empty((q + 1, n, n))
        right[0] = left[q] = np.eye(n)
        for k in range(q):
            right[k + 1] = states[k, :, :n] @ right[k]
            left[q - 1 - k] = left[q - k] @ states[q - 1 - k, :, :n]
        values, L, R = linalg.eig(right[q], left=True)
        kept = np.abs(values) > HALF * np.max(np.abs(values))
        values, L, R = values[kept], L[:, kept].conj(), R[:, kept]
        size = values * np.einsum("ik,ik->k", L, R)
        later, before = left[1:].swapaxes(1, 2) @ L, right[:q] @ R
        slopes = np.einsum("tik,tjk->ktij", later / size, before)
        return np.log(values), psi, slopes * (self.samples_per_period / q)

    def growth(self):
        """Of the fastest growing mode, e-folds a sample; −inf if every mode dies at once."""
        steps, scale = self.whole_turn()[1][..., : self.n_states], 0.0
        while len(steps) > 1:  # neighbours multiplied: the fastest mode alone comes through
            if len(steps) % 2:
                steps = np.concatenate([steps, np.eye(self.n_states)[None]])
            steps = steps[1::2] @ steps[::2]
            size = np.max(np.abs(steps), axis=(1, 2), keepdims=True)
            size[size == 0.0] = 1.0
            steps, scale = steps / size, scale + np.sum(np.log(size))
        radius = np.max(np.abs(np.linalg.eigvals(steps[0])))
        found = np.log(radius) + scale if radius > 0.0 else -np.inf
        return float(found / self.samples_per_period)

    def multipliers(self):
        """Eigenvalues of the transition over one turn, complex, shape (n,)."""
        return np.exp(self.multiplier_logarithms())

    def filtered(self, noise):
        """The model with the gain of its Kalman filter, whose predictor is stable.

        Where a machine has more states than the model, a regression on innovations e leaves
        some of the next states, r, and of the outputs, v. With w = K(ψ) e + r the periodic
        Riccati equation is stepped from sample to sample until its start is forgotten.
        ``noise`` is the covariance of e, r and v, in this order.
        """
        n, n_outputs, H = self.n_states, self.n_outputs, len(self.gain) // 2
        H = min(H, (self.gain.any(axis=(1, 2)).nonzero()[0][-1] + 1) // 2) if self.gain.any() else 0
        shown = 4 * (2 * H + 1) + int(np.ceil(self.samples_per_period))
        R = noise[-n_outputs:, -n_outputs:]
        R = R + EXACT * np.trace(R) * np.eye(n_outputs)  # outputs may be equal
        P, start = None, np.eye(n)
        for turn in range(MOST_TURNS):
            psi = self.start + self.step * (turn * shown + np.arange(shown))
            rows = self.rows(psi)
            A, C = rows.states[..., :n], rows.outputs[..., :n]
            spread_by = np.zeros((shown, n + n_outputs, len(noise)))
            spread_by[:, :n, :n_outputs] = rows.gain
            spread_by[:, :, n_outputs:] = np.eye(n + n_outputs)
            joint = spread_by @ noise @ spread_by.swapaxes(1, 2)
            Q, S = joint[:, :n, :n], joint[:, :n, n:]
            P = np.mean(Q, axis=0) if P is None else P
            repeated, gains, spreads = np.max(np.abs(start)) < HALF, [], []
            for k in range(shown):
                spread = C[k] @ P @ C[k].T + R
                gain = np.linalg.solve(spread, (A[k] @ P @ C[k].T + S[k]).T).T
                P = A[k] @ P @ A[k].T + Q[k] - gain @ spread @ gain.T
                P = 0.5 * (P + P.T)
                start = (A[k] - gain @ C[k]) @ start
                gains.append(gain)
                spreads.append(spread)
            if repeated:
                break
        functions = harmonic_functions(psi, range(H + 1))
        found = linalg.lstsq(functions, np.reshape(gains, (shown, -1)))[0]
        gain = np.zeros_like(self.gain)
        gain[: 2 * H + 1] = found.reshape(-1, *self.gain.shape[1:])
        return replace(self, gain=gain, covariance=np.mean(spreads, axis=0))

    def is_possible(self):
        """Whether a continuous periodic system may have these multipliers: their product is
        e^{∫ tr F dt}, so that an even number is negative. True without harmonics."""
        if self.n_harmonics == 0:
            return True
        _, states, _ = self.whole_turn()
        return bool(np.prod(np.sign(np.linalg.det(states[..., : self.n_states]))) >= 0.0)

    def forced_response(self, n_harmonics):
        """Fourier coefficients of the periodic outputs without inputs, (2 n_harmonics + 1, l)."""
        return self.forced_responses(self.coefficients[..., -1:], n_harmonics)[0]

    def forced_responses(self, loads, n_harmonics):
        """The same for each of other loads (2 L + 1, n + l, r): (r, 2 n_harmonics + 1, l)."""
        n, K = self.n_states, n_harmonics
        psi = 2.0 * np.pi * np.arange(4 * K + 4) / (4 * K + 4)
        x = evaluate_harmonics(self._orbits(loads, K), psi)
        outputs = self.rows(psi).outputs[..., :n] @ x + evaluate_harmonics(loads[:, n:], psi)
        return np.moveaxis(sampled_harmonics(outputs, K), -1, 0)

    def about_orbit(self):
        """The same model, its state counted from the forced periodic motion without inputs.

        The state zero then is that of a machine that has run long without inputs. What harmonics
        leave of a(ψ) stays there, so that nothing else changes.
        """
        n, K = self.n_states, len(self.coefficients) // 2
        H = 2 * K
        psi = 2.0 * np.pi * np.arange(2 * H + 1) / (2 * H + 1)
        orbit, values = self._orbit(K), evaluate_harmonics(self.coefficients, psi)
        now, later = (evaluate_harmonics(orbit, psi + d) for d in (0.0, self.step))
        values[:, :, -1] += np.einsum("tij,tj->ti", values[:, :, :n], now)
        values[:, :n, -1] -= later
        whole = resize_harmonics(self.coefficients, H)
        whole[:, :, -1] = sampled_harmonics(values[:, :, -1:], H)[:, :, 0]
        return replace(self, coefficients=whole)

    def forced_state(self, inputs, psi):
        """State at an azimuth of the periodic motion that periodic inputs force.

        ``inputs`` are Fourier coefficients, (2 L + 1, m).
        """
        return evaluate_harmonics(self.forced_orbit(inputs), np.array([psi]))[0]

    def forced_orbit(self, inputs, n_harmonics=None):
        """Fourier coefficients of the states of that motion; all harmonics by default."""
        driven = self.about(-inputs, np.zeros((len(inputs), len(self.covariance))))
        count = len(driven.coefficients) // 2 if n_harmonics is None else n_harmonics
        return driven._orbit(count)

    def _orbit(self, n_harmonics):
        """Fourier coefficients of x_p(ψ + δ) = A(ψ) x_p(ψ) + a(ψ), (2 n_harmonics + 1, n)."""
        return self._orbits(self.coefficients[..., -1:], n_harmonics)[..., 0]

    def _orbits(self, loads, n_harmonics):
        """The same for each of other loads, (2 n_harmonics + 1, n, r): at equal steps of ψ."""
        n, K = self.n_states, n_harmonics
        psi = 2.0 * np.pi * np.arange(4 * K + 4) / (4 * K + 4)
        A, a = self.rows(psi).states[..., :n], evaluate_harmonics(loads[:, :n], psi)
        # whatever units states are in
        size = linalg.matrix_balance(np.mean(np.abs(A), axis=0), permute=False, separate=True)[1][0]
        A, a = A / size[:, None] * size, a / size[:, None]
        now, later = (harmonic_functions(psi + d, range(K + 1)) for d in (0.0, self.step))
        moved = np.einsum("tij,tk->tikj", A, now)
        kept = np.einsum("tk,ij->tikj", later, np.eye(n))
        design = (kept - moved).reshape(len(psi) * n, -1)
        # by a QR decomposition: an SVD may fail to converge
        rhs = a.reshape(len(design), -1)
        found = linalg.lstsq(design, rhs, cond=HALF, lapack_driver="gelsy")[0]
        return found.reshape(2 * K + 1, n, -1) * size[:, None]


def _power(steps, exponent):
    """Small powers of maps x ↦ A x + B v with v held: A^ε and (A^ε − I)(A − I)⁻¹ B."""
    n = steps.shape[1]
    values, vectors = np.linalg.eig(steps[..., :n])
    values = values.astype(complex)
    power = values**exponent
    near = np.abs(values - 1.0) < HALF
    held = np.where(near, exponent, (power - 1.0) / np.where(near, 1.0, values - 1.0))
    back = np.linalg.inv(vectors)
    A, hold = ((vectors * each[:, None]) @ back for each in (power, held))
    return np.concatenate([A, hold @ steps[..., n:]], axis=-1).real


@dataclass(frozen=True, eq=False)
class Rows:
    """A periodic innovations model at the samples of one segment."""

    states: np.ndarray  # (n_samples, n, n + m + 1): [A B a]
    outputs: np.ndarray  # (n_samples, l, n + m + 1): [C D c]
    gain: np.ndarray  # (n_samples, n, l)

    @property
    def n_states(self):
        return self.states.shape[1]

    @property
    def direct(self):
        """Whether inputs act on outputs of the same row."""
        return bool(self.outputs[..., self.n_states : -1].any())

    @property
    def predicting(self):
        """A − K C, shape (n_samples, n, n)."""
        n = self.n_states
        return self.states[..., :n] - self.gain @ self.outputs[..., :n]

    def some(self, rows):
        """Those at some of the samples, a slice."""
        return Rows(self.states[rows], self.outputs[rows], self.gain[rows])

    def first(self, n_samples):
        """The first samples; all where None."""
        return self.some(slice(n_samples))

    def simulated(self, inputs, x0):
        """Outputs from an initial state, shape (n_samples, l); not finite where they overflow."""
        n, u = self.n_states, _with_one(inputs)
        forcing = np.einsum("tij,tj->ti", self.states[..., n:], u)
        x = propagate_varying(self.states[..., :n], forcing[..., None], np.asarray(x0)[:, None])
        return np.einsum("tij,tj->ti", self.outputs, np.hstack([x[..., 0], u]))

    def free(self):
        """Outputs of each unit initial state, without inputs and loads, (n, n_samples, l)."""
        n = self.n_states
        x = propagate_varying(self.states[..., :n], None, np.eye(n))
        return (self.outputs[..., :n] @ x).transpose(2, 0, 1)

    def left(self, inputs, outputs):
        """What a simulation leaves, from the initial state that fits best; None if it overflows."""
        n, u = self.n_states, _with_one(inputs)
        forcing = np.zeros((len(u), n, n + 1))
        forcing[..., 0] = np.einsum("tij,tj->ti", self.states[..., n:], u)
        start = np.hstack([np.zeros((n, 1)), np.eye(n)])
        x = propagate_varying(self.states[..., :n], forcing, start)
        if not np.max(np.abs(x), initial=0.0) < OVERFLOW:
            return None
        rest = outputs - np.einsum("tij,tj->ti", self.outputs, np.hstack([x[..., 0], u]))
        free = (self.outputs[..., :n] @ x[..., 1:]).reshape(-1, n)
        start = solve_within_rank(free, rest.ravel(), cond=HALF)
        return rest - (free @ start).reshape(rest.shape)

    def ahead(self, inputs, outputs, x0, horizon):
        """Outputs predicted some rows ahead; those of the first rows from the initial state.

        ``horizon`` counts rows from the last output known to the one predicted; it is
        at least 1.
        """
        n, u = self.n_states, _with_one(inputs)
        stable, forcing = self._predictor(u, outputs)
        start = np.asarray(x0, dtype=float)[:, None]
        x = propagate_varying(stable, forcing[..., None], start)[..., 0]
        steps = min(horizon, len(x)) - 1
        if steps > 0:  # rows later, without another innovation
            pushed = np.einsum("tij,tj->ti", self.states[..., n:], u)
            begun = propagate_varying(self.states[:steps, :, :n], pushed[:steps, :, None], start)[
                ..., 0
            ]
            with np.errstate(over="ignore", invalid="ignore"):
                for s in range(steps):
                    rows = slice(s, len(pushed) - steps + s)
                    x = np.einsum("tij,tj->ti", self.states[rows, :, :n], x[: len(pushed) - steps])
                    x = x + pushed[rows]
            x = np.concatenate([begun, x])
        return np.einsum("tij,tj->ti", self.outputs, np.hstack([x, u]))

    def initial_state(self, inputs, outputs, covariance):
        """The state that leaves the least innovations over some first rows.

        Those before a predictor that is not stable overflows.
        """
        n, u = self.n_states, _with_one(inputs)
        first = self.first(len(u))
        stable, forcing = first._predictor(u, outputs)
        both = np.concatenate([forcing[..., None], np.zeros((*forcing.shape, n))], axis=-1)
        x = propagate_varying(stable, both, np.hstack([np.zeros((n, 1)), np.eye(n)]))
        grown = ~np.all(np.abs(x) < OVERFLOW, axis=(1, 2))
        some = slice(int(np.argmax(grown)) if grown.any() else len(x))
        x, u, seen = x[some], u[some], first.outputs[some]
        left = outputs[some] - np.einsum("tij,tj->ti", seen, np.hstack([x[..., 0], u]))
        free = seen[..., :n] @ x[..., 1:]
        size = np.sqrt(np.where(np.diag(covariance) > 0.0, np.diag(covariance), 1.0))
        free = (free / size[:, None]).reshape(-1, n)
        return solve_within_rank(free, (left / size).ravel(), cond=HALF)

    def innovations(self, inputs, outputs, x0):
        """States of the predictor and what it leaves, shapes (n_samples, n), (n_samples, l).

        Not finite where it overflows.
        """
        u = _with_one(inputs)
        stable, forcing = self._predictor(u, outputs)
        x = propagate_varying(stable, forcing[..., None], np.asarray(x0)[:, None])[..., 0]
        with np.errstate(over="ignore", invalid="ignore"):
            return x, outputs - np.einsum("tij,tj->ti", self.outputs, np.hstack([x, u]))

    def started(self):
        """Predictions of each unit initial state, shape (n_samples, l, n)."""
        n = self.n_states
        with np.errstate(over="ignore", invalid="ignore"):
            return self.outputs[..., :n] @ propagate_varying(self.predicting, None, np.eye(n))

    def _predictor(self, u, outputs):
        """A − K C, and what inputs and outputs push x by."""
        n = self.n_states
        direct = self.states[..., n:] - self.gain @ self.outputs[..., n:]
        forcing = np.einsum("tij,tj->ti", direct, u)
        return self.predicting, forcing + np.einsum("tij,tj->ti", self.gain, outputs)


def _with_one(inputs):
    """Inputs beside a constant one, which drives the forced response."""
    return np.hstack([inputs, np.ones((len(inputs), 1))])


@dataclass(frozen=True, eq=False)
class AtSamples:
    """A model at the samples of one segment, and what of it was fitted."""

    rows: Rows
    inputs: np.ndarray  # (n_samples, m)
    feedthrough: bool  # whether it has D
    predicts: bool  # whether it has a Kalman gain
    n_harmonics: int  # of its matrices
    n_loads: int = -1  # of its forced response; −1 where there is none, not even a mean

    @classmethod
    def of(cls, A, B, C, D, K, inputs, n_harmonics):
        """Of matrices, one a sample or constant, without loads."""
        shape, n = (len(inputs), A.shape[-1]), A.shape[-1]
        n_outputs, width = C.shape[-2], n + B.shape[-1] + 1
        states, outputs = np.zeros((*shape, width)), np.zeros((len(inputs), n_outputs, width))
        states[..., :n], states[..., n:-1] = A, B
        outputs[..., :n], outputs[..., n:-1] = C, D
        gain = np.broadcast_to(0.0 if K is None else K, (*shape, n_outputs))
        return cls(Rows(states, outputs, gain), inputs, np.any(D), K is not None, n_harmonics)

    def first(self, n_samples):
        """The first samples."""
        return replace(self, rows=self.rows.first(n_samples), inputs=self.inputs[:n_samples])


def input_slopes(rows, inputs, functions, start):
    """Simulated outputs by the initial state and the Fourier coefficients of B(ψ) and D(ψ).

    Parameters
    ----------
    rows : Rows
        The model at consecutive samples; its gain is left out.
    functions : ndarray, shape (n_samples, 2 H + 1)
        1, cos ψ, sin ψ, ….
    start : ndarray, shape (n, c), or None
        Where rows before these ended; None at the start of a segment.

    Returns
    -------
    outputs : ndarray, shape (n_samples, l, n + k + 2)
        By the initial state; by each coefficient, in the order state (then output, of D if there
        is any), harmonic, input; by all inputs, and by the loads.
    end : ndarray, shape (n, c)
    """
    n, width = rows.n_states, functions.shape[1] * inputs.shape[1]
    A, C = rows.states[..., :n], rows.outputs[..., :n]
    if start is None:
        start = np.hstack([np.eye(n), np.zeros((n, n * width + 2))])
    pushes = np.einsum("th,tj->thj", functions, inputs).reshape(len(A), width)
    known = [np.einsum("tij,tj->ti", M[..., n:-1], inputs) for M in (rows.states, rows.outputs)]
    parts = []  # of states and outputs: what is added to each
    for M, forced in zip((rows.states, rows.outputs), known, strict=True):
        a = M.shape[1]
        each = np.einsum("ik,tq->tikq", np.eye(a), pushes).reshape(len(A), a, a * width)
        parts.append((each, np.stack([forced, M[..., -1]], axis=-1)))
    forcing = np.concatenate([np.zeros((len(A), n, n)), *parts[0]], axis=-1)
    x = propagate_varying(A, forcing, start)
    with np.errstate(over="ignore", invalid="ignore"):
        end, y = A[-1] @ x[-1] + forcing[-1], C @ x
    direct, last = parts[1]
    y[..., -2:] += last
    slopes = [y[..., :-2], direct, y[..., -2:]] if rows.direct else [y]
    return np.concatenate(slopes, axis=-1), end


def propagate_varying(A, forcing, start):
    """States of x[k+1] = A[k] x[k] + v[k], several columns at once.

    In pieces of about √N samples, all pieces at once, joined by their transition matrices; many
    columns sample after sample. ``forcing`` is v, (n_samples, n, r), or None for zero;
    its last row is not used. ``start`` is x[0], (n, r).

    Examples
    --------
    >>> A = np.array([0.5, 2.0, 0.5, 2.0, 0.5])[:, None, None]
    >>> propagate_varying(A, np.ones((5, 1, 1)), np.zeros((1, 1))).ravel().tolist()
    [0.0, 1.0, 3.0, 2.5, 6.0]
    """
    n_samples, n, _ = A.shape
    r = start.shape[1]
    if r >= 128 and forcing is not None:  # columns keep a processor busy, sample after sample
        states = np.empty((n_samples, n, r))
        states[0] = start
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(n_samples - 1):
                np.matmul(A[k], states[k], out=states[k + 1])
                states[k + 1] += forcing[k]
        return states
    length = max(1, int(np.sqrt(n_samples)))
    n_pieces = -(-n_samples // length)
    spare = n_pieces * length - n_samples
    A = np.concatenate([A, np.broadcast_to(np.eye(n), (spare, n, n))])
    A = A.reshape(n_pieces, length, n, n)
    Phi = np.empty((n_pieces, length + 1, n, n))
    Phi[:, 0] = np.eye(n)
    forced = np.zeros((n_pieces, length + 1, n, r))
    if forcing is not None:
        v = np.concatenate([forcing, np.zeros((spare, n, r))])
        v = v.reshape(n_pieces, length, n, r)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(length):
            Phi[:, k + 1] = A[:, k] @ Phi[:, k]
            if forcing is not None:
                forced[:, k + 1] = A[:, k] @ forced[:, k] + v[:, k]
        starts, x = np.empty((n_pieces, n, r)), start
        for piece in range(n_pieces):
            starts[piece] = x
            x = Phi[piece, -1] @ x + forced[piece, -1]
        states = Phi[:, :-1] @ starts[:, None] + forced[:, :-1]
    return states.reshape(n_pieces * length, n, r)[:n_samples]


# ---- without a mode ------------------------------------------------------------------------------


def coordinates_without_modes(model, n_harmonics):
    """Coordinates of the other states, without each mode or complex pair of modes.

    Yields the Fourier coefficients of V(ψ), (2 n_harmonics + 1, n, k), in the order 0,
    1c, 1s, …; k states are left. ``n_harmonics`` is below half of the samples in a
    turn; what is beyond is left out.
    """
    for V, _ in _split(model):
        yield sampled_harmonics(V, n_harmonics)


def without_modes(model, n_harmonics):
    """Yields the model truncated by each mode or complex pair, its other modes as they are.

        z = L(ψ) x,   L V = I, and L is zero on the mode left out
        A ← L(ψ + δ) A V,   B, a, K ← L(ψ + δ) B, a, K,   C ← C V

    A, B, C, D and K keep ``n_harmonics``. A mode that is lost in rounding is passed
    over.
    """
    n, highest = model.n_states, max(n_harmonics, len(model.coefficients) // 2)
    for V, others in _split(model):
        most, k = (len(V) - 1) // 2, V.shape[2]
        both = np.concatenate([V, others], axis=2)
        if np.linalg.svd(both, compute_uv=False).min() < HALF:  # the mode is lost in rounding
            continue
        L = np.linalg.inv(both)[:, :k]
        n_azimuths = 4 * (most + highest) + 1
        psi = 2.0 * np.pi * np.arange(n_azimuths) / n_azimuths
        V = evaluate_harmonics(sampled_harmonics(V, most), psi)
        L = evaluate_harmonics(sampled_harmonics(L, most), psi + model.step)
        whole = evaluate_harmonics(model.coefficients, psi)
        whole = np.concatenate([L @ whole[:, :n], whole[:, n:]], axis=1)
        whole = np.concatenate([whole[..., :n] @ V, whole[..., n:]], axis=2)
        coefficients = sampled_harmonics(whole, highest)
        coefficients[2 * n_harmonics + 1 :, :, :-1] = 0.0  # loads may have more
        gain = resize_harmonics(
            sampled_harmonics(L @ evaluate_harmonics(model.gain, psi), n_harmonics), highest
        )
        yield replace(model, coefficients=coefficients, gain=gain)


def _split(model):
    """Bases of the subspaces of the other modes, and of the mode left out, for each of a model."""
    A = replace(model, start=0.0).whole_turn()[1][..., : model.n_states]
    values, vectors = np.linalg.eig(product_of(A))
    for k in np.flatnonzero(values.imag >= 0.0):  # the other one of a pair follows it
        own = [k, k + 1] if values[k].imag > 0.0 else [k]
        both = np.delete(vectors, own, axis=1), vectors[:, own]
        if both[0].size:
            starts = (linalg.svd(np.hstack([v.real, v.imag]))[0][:, : v.shape[1]] for v in both)
            others, left_out = (_carried(A, start) for start in starts)
            V = _closed(others)
            if V is not None:
                yield V, left_out[:-1]


def _carried(A, start):
    """Orthonormal bases of a subspace at the start of every step, and after the last one."""
    bases = [start]
    for each in A:
        basis = linalg.qr(each @ bases[-1], mode="economic")[0]
        left, _, right = linalg.svd(basis.T @ bases[-1])
        bases.append(basis @ (left @ right))  # the nearest one to that before
    return np.array(bases)


def _closed(bases):
    """The same bases, turned so that the last is the first, without it; None if none is."""
    turn, q = bases[0].T @ bases[-1], len(bases) - 1
    if linalg.det(turn) < 0.5:  # −1 of a reflection; 0 where a mode is lost in rounding
        return None
    return bases[:-1] @ linalg.expm(-np.arange(q)[:, None, None] / q * _logarithm(turn))


def _logarithm(rotation):
    """The real logarithm of a rotation, of the least angles."""
    blocks, vectors = linalg.schur(rotation)
    angles, reversed_axes, k, n = np.zeros_like(blocks), [], 0, len(blocks)
    while k < n:
        if k + 1 < n and blocks[k + 1, k] != 0.0:
            angles[k + 1, k] = np.arctan2(blocks[k + 1, k], blocks[k, k])
            k += 1
        elif blocks[k, k] < 0.0:
            reversed_axes.append(k)
        k += 1
    for one, other in zip(reversed_axes[::2], reversed_axes[1::2], strict=True):
        angles[other, one] = np.pi
    return vectors @ (angles - angles.T) @ vectors.T
