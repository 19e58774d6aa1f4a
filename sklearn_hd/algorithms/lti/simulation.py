"""Responses of linear time-invariant models, and the way between their time domains.

x[k+1] = A x[k] + B u[k],   y[k] = C x[k] + D u[k]                    (Eq. 10)
ẋ = A x + B u,              y = C x + D u                             (Eq. 8)

Predictions and scores, data sets and all that turns discrete models into continuous ones need
them.

The stable matrix nearest to an unstable one, in closed form.

Of all stable A′ the one with the least stationary tr(W (A′ − A) X (A′ − A)ᵀ), X the covariance of
the states that noise of some size gives under A′ (Jongeneel, Sutter and Kuhn, 2023). With states
as little disturbed as need be, it mirrors each unstable eigenvalue λ at the unit circle to 1/λ̄,
and leaves the stable ones, with their modes, as they are:

    A′ = A − W⁻¹ Vᵀ (X + V W⁻¹ Vᵀ)⁻¹ V A,   X = A_u⁻¹ (X + V W⁻¹ Vᵀ) A_u⁻ᵀ,   V A = A_u V

with V the left invariant subspace of the unstable eigenvalues. ``MOESPRegressor(stable=True)``
needs it.

Model-order reduction by residualization (Eqs. 16-19). With the fast states at rest, ẋ_f = 0,

    Â = A_s − A_sf A_f⁻¹ A_fs,    B̂ = B_s − A_sf A_f⁻¹ B_f,
    Ĉ = C_s − C_f A_f⁻¹ A_fs,     D̂ = D − C_f A_f⁻¹ B_f,

and in block-diagonal coordinates, A_sf = A_fs = 0, only D̂ differs from truncation.
"""

import threading
import warnings

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, TINY

BLOCK = 16  # steps whose states, or outputs, follow at once from the state before them
LEAST_BLOCKS = 8  # with fewer, doubling takes about half the time (3 to 30 states)
_GLOBAL_RANDOM = threading.Lock()
GROWN = 1.0  # e-folds over a segment; fewer may be the error of an integrator's pole
ON_THE_CIRCLE = 1.0 + DEPENDENT  # of an integrator, to within rounding


def propagate(A, forcing, x0):
    """States of x[k+1] = A x[k] + v[k] from x[0] = x0.

    In blocks of some steps: their responses from rest take one matrix product a step for
    all blocks at once, and the states at their starts follow from the same recursion with
    a power of A. Few samples go by recursive doubling (Kogge and Stone, 1973).
    ``forcing``, (..., n_samples, n), holds v[k]; its last row is not used. ``x0`` has
    shape (..., n). The states are infinite or NaN where an unstable A makes them
    overflow.

    Examples
    --------
    >>> propagate(np.array([[0.5]]), np.ones((4, 1)), np.zeros(1)).ravel().tolist()
    [0.0, 1.0, 1.5, 1.75]
    """
    A, forcing, x0 = np.asarray(A), np.asarray(forcing), np.asarray(x0)
    x = np.empty(forcing.shape, dtype=np.result_type(A, forcing, x0, float))
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        _propagate(A, forcing, x0, x)
    return x


def _propagate(A, forcing, x0, x):
    """Write the states into x."""
    *batch, n_samples, n = x.shape
    n_blocks = n_samples // BLOCK
    if n_blocks < LEAST_BLOCKS:
        return _double(A, forcing, x0, x)
    whole = n_blocks * BLOCK
    split = (*batch, n_blocks, BLOCK, n)
    v, out = forcing[..., :whole, :].reshape(split), x[..., :whole, :].reshape(split)
    ends, starts = np.zeros((2, *batch, n_blocks + 1, n), dtype=x.dtype)
    # 1024 blocks at a time, whose states fit into a cache
    groups = [slice(b, min(b + 1024, n_blocks)) for b in range(0, n_blocks, 1024)]
    for blocks in groups:
        end = v[..., blocks, 0, :]
        for k in range(1, BLOCK):
            end = end @ A.T + v[..., blocks, k, :]
        ends[..., blocks, :] = end
    _propagate(np.linalg.matrix_power(A, BLOCK), ends, x0, starts)
    for blocks in groups:
        out[..., blocks, 0, :] = state = starts[..., blocks, :]
        for k in range(1, BLOCK):
            state = state @ A.T + v[..., blocks, k - 1, :]
            out[..., blocks, k, :] = state
    if whole < n_samples:
        _double(A, forcing[..., whole:, :], starts[..., n_blocks, :], x[..., whole:, :])


def _double(A, forcing, x0, x):
    """Recursive doubling: log2(n_samples) products of everything."""
    if x.shape[-2] == 0:
        return
    x[..., 0, :] = x0
    x[..., 1:, :] = forcing[..., :-1, :]
    power, step = A.T.copy(), 1
    while step < x.shape[-2]:
        if not np.any(power):
            break  # nilpotent, or decayed below the smallest number
        x[..., step:, :] += x[..., :-step, :] @ power
        power, step = power @ power, 2 * step


def simulate(A, B, C, D, inputs, x0):
    """Outputs of x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k] from x[0] = x0.

    In blocks of T samples, all at once: y is linear in the state before a block and in the
    inputs of the block, and so is the state after it; only states at the starts of blocks are
    found one after the other. Outputs, (n_samples, l), are infinite or NaN where an
    unstable A makes the states overflow.

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> simulate(0.5 * one, one, one, 0.0 * one, np.ones((4, 1)), np.zeros(1)).ravel().tolist()
    [0.0, 1.0, 1.5, 1.75]
    """
    (n, m), n_outputs = B.shape, len(C)
    T = _outputs_block(n, m, n_outputs, len(inputs))
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        if T < 2:
            return propagate(A, inputs @ B.T, x0) @ C.T + inputs @ D.T
        y_unit, u_unit = _units(C, axis=1), _units(B, axis=0)
        B, C = B / u_unit, C / y_unit[:, None]
        seen, reached = np.empty((T, n_outputs, n)), np.empty((T, n, m))
        last, ahead = C, B
        for k in range(T):
            seen[k], reached[T - 1 - k] = last, ahead
            last, ahead = last @ A, A @ ahead
        pulses = (seen[:-1] @ B).transpose(2, 0, 1)  # outputs of a pulse, k + 1 samples later
        within = np.zeros((T, m, T, n_outputs))
        for k in range(T - 1):
            within[k, :, k + 1 :] = pulses[:, : T - 1 - k]
        whole = len(inputs) // T * T
        u, rest = inputs[:whole].reshape(-1, T * m) * np.tile(u_unit, T), inputs[whole:] * u_unit
        forcing = u @ reached.transpose(0, 2, 1).reshape(T * m, n)
        forcing = np.concatenate([forcing, np.zeros((1, n))])
        states = propagate(np.linalg.matrix_power(A, T), forcing, x0)
        outputs = np.empty((len(inputs), n_outputs))
        blocks = outputs[:whole].reshape(len(u), T * n_outputs)
        np.matmul(u, within.reshape(T * m, -1), out=blocks)
        blocks += states[:-1] @ seen.reshape(-1, n).T
        blocks *= np.tile(y_unit, T)
        outputs[whole:] = propagate(A, rest @ B.T, states[-1]) @ C.T * y_unit
        outputs += inputs @ D.T
    return outputs


def _units(matrix, axis):
    """About the largest entry of each row or column, as a power of two; one where all are zero.

    Divided by it, inputs in small units do not make the matrix exponential of
    [[A, B], [0, 0]] scale A with them: 1e-100 cost ten digits.
    """
    _, exponent = np.frexp(np.max(np.abs(matrix), axis=axis, initial=0.0))
    return np.ldexp(1.0, exponent)


def _outputs_block(n_states, n_inputs, n_outputs, n_samples):
    """Samples in a block, for the least work; 1 where there are too few."""

    def work(T):
        return T * n_inputs * n_outputs + 5 * n_states * (n_states + n_inputs) / T

    blocks = [T for T in (1, 2, 4, 8, BLOCK) if n_samples >= 4 * T * LEAST_BLOCKS]
    return min(blocks, key=work, default=1) if n_states and n_inputs and n_outputs else 1


def continuous_to_discrete(A, B, dt):
    """Zero-order-hold equivalent (A_d, B_d) of (A, B) at sample time dt."""
    n, m = B.shape
    block = np.zeros((n + m, n + m), dtype=np.result_type(A, B, float))
    size = _units(B, axis=0) * dt
    block[:n, :n], block[:n, n:] = A * dt, B / size * dt
    power = linalg.expm(block)
    return power[:n, :n], power[:n, n:] * size


def discrete_to_continuous(A, B, dt):
    """Continuous (A, B) whose zero-order-hold equivalent at dt is the given pair.

    The inverse of :func:`continuous_to_discrete`, by the principal matrix
    logarithm of the block matrix [[A, B], [0, I]]. It raises ValueError if A has an
    eigenvalue on the closed negative real axis, where no real logarithm exists, or if
    the logarithm is not accurate to 1e-6.
    """
    A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    n, m = B.shape
    z = linalg.eigvals(A) if n else np.empty(0)
    size = np.max(np.abs(z), initial=0.0)
    bad = z[(np.abs(z.imag) <= 1e-12 * size) & (z.real <= 1e-14 * max(size, 1.0))]
    if bad.size:
        poles = ", ".join(f"{value:.4g}" for value in bad.real)
        raise ValueError(
            f"discrete poles at {poles} lie on the closed negative real axis, where a real "
            f"continuous-time model does not exist; drop those modes (SpuriousModeReducer does, "
            f"except for reading='sample'), use another order, or sample faster (a smaller hop)"
        )
    if n == 0:
        return A.copy(), B.copy()
    block, columns = np.zeros((n + m, n + m)), _units(B, axis=0)
    block[:n, :n], block[:n, n:], block[n:, n:] = A, B / columns, np.eye(m)
    rates = real_logarithm(block)
    return rates[:n, :n] / dt, rates[:n, n:] * columns / dt


def real_logarithm(matrix):
    """Principal logarithm of a matrix that has a real one.

    It raises ValueError if its exponential misses the matrix by 1e-6 or more.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # judged below, by the residual
        found = np.real(logarithm(matrix))
    rest = linalg.norm(linalg.expm(found) - matrix) / linalg.norm(matrix)
    if not rest <= 1e-6:
        raise ValueError(
            f"the matrix logarithm of this model is accurate to {rest:.1g} only (nearly defective "
            f"or very fast poles); drop such modes (SpuriousModeReducer does) or lower the order"
        )
    return found


def logarithm(matrix):
    """Principal logarithm, possibly complex, the same to the last bit at every call.

    SciPy's chooses its approximants by norms that it estimates with vectors from NumPy's
    global generator, which is left here as it was found.
    """
    with _GLOBAL_RANDOM:
        state = np.random.get_state()  # noqa: NPY002 (SciPy draws from it)
        np.random.seed(0)  # noqa: NPY002
        try:
            return linalg.logm(matrix)
        finally:
            np.random.set_state(state)  # noqa: NPY002


def frequency_response(A, B, C, D, s):
    """Transfer matrices C (sI − A)⁻¹ B + D, (n_points, l, m), at some points of the complex plane.

    The points are s = jω in continuous time and z = e^{jω dt} in discrete time.
    """
    s = np.atleast_1d(np.asarray(s, dtype=complex))
    n = A.shape[0]
    if n == 0:
        return np.broadcast_to(D.astype(complex), (len(s), *D.shape)).copy()
    resolvent = s[:, None, None] * np.eye(n) - A
    states = np.linalg.solve(resolvent, np.broadcast_to(B.astype(complex), (len(s), *B.shape)))
    return C @ states + D


def continuous_poles(z, dt):
    """Poles in 1/s of a model of sample time dt, or of one in continuous time (dt = 0).

    A mode that is gone within one step (z = 0) decays as fast as numbers tell.
    """
    z = np.asarray(z, dtype=complex)
    return np.log(np.where(z == 0.0, TINY, z)) / dt if dt else z


def step_response(A, B, C, D, step, count, *, dt=0.0, impulse=False):
    """Response (count, l, m) to a step of one unit in each input, or to an impulse of area one.

    In continuous time (dt = 0), by the zero-order hold that is exact for a step:

        step     y(t) = C ∫_0^{t} e^{As} B ds + D,      impulse   y(t) = C e^{At} B

    In discrete time the impulse is 1/dt at the first sample. The impulse D δ(t) of a
    continuous feedthrough has no height and is left out. ``StepResponseDisplay`` draws
    both. ``step`` is the time between the values of a continuous model; a discrete one
    has its own, ``dt``. The first of ``count`` values is at t = 0.
    """
    discrete, held = (A, B) if dt else continuous_to_discrete(A, B, step)
    first = (held / dt if dt else B) if impulse else np.zeros(B.shape)
    push = np.zeros(B.shape) if impulse else held
    response = np.empty((count, *D.shape))
    direct = (0.0 if impulse else 1.0) * D
    x = first
    for k in range(count):
        response[k] = C @ x + direct
        x = discrete @ x + push
    if impulse and dt:  # the first value is that of the feedthrough, the state moves after it
        response = np.concatenate([D[None] / dt, response[:-1]])
    return response


def growth(A):
    """E-folds a row by which the fastest mode of x[k+1] = A x[k] grows; negative if none does."""
    return float(np.log(max(np.max(np.abs(linalg.eigvals(A)), initial=0.0), TINY)))


def is_stable(A):
    """Whether no mode of x[k+1] = A x[k] grows, beyond rounding."""
    return growth(A) <= np.log(ON_THE_CIRCLE)


def nearest_stable(A, weights):
    """The stable matrix nearest to A.

    ``weights``, (n,), is the diagonal of W: how much a change of each next state
    counts. A stable A is returned as given.

    References
    ----------
    Jongeneel, Sutter, Kuhn (2023), IEEE Transactions on Automatic Control 68(5), 2790-2804.

    Examples
    --------
    >>> nearest_stable(np.diag([0.5, 1.25]), np.ones(2)).diagonal().tolist()
    [0.5, 0.8]
    """
    if is_stable(A):
        return A
    T, Q, n_unstable = linalg.schur(A.T, sort=lambda re, im: np.hypot(re, im) > ON_THE_CIRCLE)
    V, own = Q[:, :n_unstable].T, T[:n_unstable, :n_unstable].T
    push = V.T / np.maximum(weights, EPS * np.max(weights))[:, None]
    # Z = X + V W⁻¹ Vᵀ in A_u Z − Z A_u⁻ᵀ = A_u V W⁻¹ Vᵀ; near-integrators make it badly scaled
    Z = linalg.solve_sylvester(own, -linalg.inv(own).T, own @ V @ push)
    size = np.sqrt(np.diagonal(Z))
    pull = linalg.solve(Z / np.outer(size, size), (V @ A) / size[:, None], assume_a="pos")
    return A - (push / size) @ pull


def block_diagonal(A, B, C, slow, fast):
    """Coordinates in which the modes of two groups of eigenvalues do not interact.

    Ordered Schur form, then a Sylvester equation (Bartels and Stewart, 1972). ``slow``
    and ``fast`` hold all eigenvalues of A, in two conjugate-closed groups. Returns A,
    B, C of the same system, whose first ``len(slow)`` states hold the slow modes.
    """
    n_slow = len(slow)
    if n_slow in (0, len(A)):
        return A, B, C

    def is_slow(real, imag):
        z = real + 1j * imag
        return np.min(np.abs(z - slow)) < np.min(np.abs(z - fast))

    T, Q, found = linalg.schur(A, output="real", sort=is_slow)
    if found != n_slow:
        raise ValueError(
            "the slow and the fast modes share an eigenvalue to working precision and cannot be "
            "separated; move it to one group"
        )
    coupling = linalg.solve_sylvester(
        T[:n_slow, :n_slow], -T[n_slow:, n_slow:], -T[:n_slow, n_slow:]
    )
    S = np.eye(len(A))
    S[:n_slow, n_slow:] = coupling
    inverse = np.eye(len(A))
    inverse[:n_slow, n_slow:] = -coupling
    return inverse @ T @ S, inverse @ Q.T @ B, C @ Q @ S


def residualize(A, B, C, D, slow, fast):
    """Slow modes A, B, C, D of a continuous-time model, fast ones replaced by their static gain.

    ``slow`` and ``fast`` hold all eigenvalues of A, in two conjugate-closed groups; no
    fast one is zero.

    Examples
    --------
    >>> A, B, C, D = np.diag([-1.0, -50.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1))
    >>> reduced = residualize(A, B, C, D, np.array([-1.0]), np.array([-50.0]))
    >>> float(reduced[0][0, 0]), float(reduced[3][0, 0])
    (-1.0, 0.02)
    """
    n = len(slow)
    A, B, C = block_diagonal(A, B, C, np.asarray(slow), np.asarray(fast))
    D = D - C[:, n:] @ linalg.solve(A[n:, n:], B[n:])
    return A[:n, :n], B[:n], C[:, :n], D
