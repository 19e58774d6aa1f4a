"""Periodic Riccati and Lyapunov equations, sampled and continuous.

The regulator of x_{k+1} = A_k x_k + B_k u_k with the cost

    Σ_k x_kᵀ Q_k x_k + 2 x_kᵀ S_k u_k + u_kᵀ R_k u_k,   all of period p,

has the cost to go x_kᵀ X_k x_k, where

    X_k = H_k + A_kᵀ X_{k+1} (I + G_k X_{k+1})⁻¹ A_k,   X_p = X_0               (1)

with G = B R⁻¹ Bᵀ, once A − B R⁻¹ Sᵀ stands for A and H is Q − S R⁻¹ Sᵀ. A triple (A, G, H) is the
map of X over one step. The map over two steps has a triple again,

    A = A_2 M⁻¹ A_1,   G = G_2 + A_2 M⁻¹ G_1 A_2ᵀ,   H = H_1 + A_1ᵀ H_2 M⁻¹ A_1,   M = I + G_1 H_2

so that the triples of one period make one, which is doubled until a horizon of 2^j periods leaves
nothing to add. No A is inverted: factors may be singular, and multipliers may lie far apart.

In continuous time, −Ẋ = Fᵀ X + X F − X E X + Q with E = G R⁻¹ Gᵀ has such triples as well: with
λ = X x, the Hamiltonian system

    d/dt [x; λ] = [F, −E; −Q, −Fᵀ] [x; λ]

moves by Z over an interval, and A = Z_22⁻ᵀ, H = −Z_22⁻¹ Z_21, G = −Z_12 Z_22⁻¹. With E = 0, H is
the integral of the cost over the interval; with Q = 0, G is that of the noise (Van Loan).

A Lyapunov equation is (1) with G = 0. The filter's equation is (1) with A transposed, backwards.
Designs of regulators and filters need all this.

References: E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, "Structure-preserving algorithms for
periodic discrete-time algebraic Riccati equations", Int. J. Control 77 (2004); A. Varga, "On
solving periodic Riccati equations", Numer. Linear Algebra Appl. 15 (2008); S. Bittanti, P.
Colaneri, *Periodic Systems: Filtering and Control*, 2009; C. F. Van Loan, "Computing integrals
involving the matrix exponential", IEEE Trans. Automatic Control 23 (1978).
"""

import numpy as np

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, EXACT
from sklearn_hd.algorithms.periodic.floquet import (
    ROTATION,
    product_logarithms,
    product_of,
    state_units,
    transition_matrices,
)

MAX_DOUBLINGS = 60  # 2⁶⁰ periods: beyond what a multiplier 1 − EPS needs
REFINEMENTS = 2  # Newton's method; one takes residuals of 1e-10 to 2e-12, the second for slow loops
MOST_PARTS = 4096  # of an interval, when a Hamiltonian is stiff


# ---- triples ------------------------------------------------------------------------------------


def riccati_triples(A, B, Q, R, S=None):
    """Triples (A, G, H) of the steps of a sampled regulator.

    Matrices have shapes (p, rows, columns). R is positive definite; S, (p, n, m), is
    zero by default.

    Examples
    --------
    >>> one = np.ones((1, 1, 1))
    >>> [float(M.item()) for M in riccati_triples(2 * one, one, one, 4 * one)]
    [2.0, 0.25, 1.0]
    """
    G = B @ np.linalg.solve(R, B.mT)
    if S is None:
        return A, _symmetric(G), _symmetric(Q)
    removed = np.linalg.solve(R, S.mT)
    return A - B @ removed, _symmetric(G), _symmetric(Q - S @ removed)


def hamiltonian_triples(F, E, Q, psi, omega, *, tolerance=1e-14):
    """Triples (A, G, H) of intervals of −Ẋ = Fᵀ X + X F − X E X + Q.

    F, E and Q take ψ of shape (n_points,) and give (n_points, n, n), F in 1/s. E and Q
    are symmetric; None is zero. ``psi`` holds the p + 1 ends of the intervals,
    increasing. ``tolerance`` is that of
    :func:`~sklearn_hd.algorithms.periodic.floquet.transition_matrices`.

    Examples
    --------
    x stays, the cost is x² dt, and noise of one adds one a second:

    >>> def zero(psi): return np.zeros((len(psi), 1, 1))
    >>> def one(psi): return np.ones((len(psi), 1, 1))
    >>> A, G, H = hamiltonian_triples(zero, None, one, np.array([0.0, 2.0]), 1.0)
    >>> float(A.item()), float(G.item()), round(float(H.item()), 12)
    (1.0, 0.0, 2.0)
    """
    n = F(psi[:1]).shape[-1]
    seen = np.linspace(psi[0], psi[-1], 257)
    scale = 1.0
    if E is None or Q is None:  # G or H is linear in the other, which may have any unit
        scale = _scale(F, E or Q, seen, omega)

    def hamiltonian(psi):
        Z, M = np.zeros((len(psi), 2 * n, 2 * n)), F(psi)
        Z[:, :n, :n], Z[:, n:, n:] = M, -M.mT
        if E is not None:
            Z[:, :n, n:] = -E(psi) * scale
        if Q is not None:
            Z[:, n:, :n] = -Q(psi) * scale
        return Z

    units = state_units(hamiltonian)
    values = hamiltonian(seen) * (units / units[:, None])
    size = np.max(np.linalg.norm(values, axis=(1, 2)))
    turned = size * np.max(np.diff(psi)) / omega / ROTATION
    parts = 2 ** int(np.ceil(np.log2(np.clip(turned, 1.0, MOST_PARTS))))
    shares = np.arange(parts) / parts
    fine = np.append((psi[:-1, None] + np.diff(psi)[:, None] * shares).ravel(), psi[-1])
    Z = transition_matrices(hamiltonian, None, fine, omega, tolerance=tolerance)[0]
    Z = Z.reshape(len(psi) - 1, parts, 2 * n, 2 * n)
    solved = np.linalg.inv(Z[..., n:, n:])
    triples = solved.mT, -Z[..., :n, n:] @ solved / scale, -solved @ Z[..., n:, :n] / scale
    return composed(*(np.swapaxes(M, 0, 1) for M in triples))


def _scale(F, weight, psi, omega):
    """Power of two that makes a weight as large as F in the states' units."""
    units = state_units(F)
    rates = np.max(np.abs(F(psi) * (units / units[:, None])), initial=0.0)
    size = 0.0 if weight is None else np.max(np.abs(weight(psi)))
    largest = max(rates, omega / np.ptp(psi))
    return 2.0 ** np.round(np.log2(largest / size)) if size > 0.0 else 1.0


def composed(A, G, H):
    """Triple of all steps in a row, the first axis; further axes are a batch.

    Examples
    --------
    >>> one = np.ones((3, 1, 1))
    >>> [float(M.item()) for M in composed(one, 0.0 * one, one)]  # costs add up
    [1.0, 0.0, 3.0]
    """
    while len(A) > 1:
        pairs = len(A) // 2 * 2
        joined = _joined(*((M[0:pairs:2], M[1:pairs:2]) for M in (A, G, H)))
        A, G, H = (
            np.concatenate([new, old[pairs:]]) for new, old in zip(joined, (A, G, H), strict=True)
        )
    return A[0], G[0], H[0]


def _joined(A, G, H):
    """Triples of pairs (first, second) of steps."""
    n = A[0].shape[-1]
    right = np.concatenate(np.broadcast_arrays(A[0], G[0]), axis=-1)
    solved = np.linalg.solve(np.eye(n) + G[0] @ H[1], right)
    W, V = solved[..., :n], solved[..., n:]
    return (
        A[1] @ W,
        _symmetric(G[1] + A[1] @ V @ A[1].mT),
        _symmetric(H[0] + A[0].mT @ H[1] @ W),
    )


# ---- the periodic solution ------------------------------------------------------------------


def solve_periodic_riccati(A, G, H):
    """Stabilising periodic solution X of (1).

    A, G and H are triples of the steps of one period, (p, n, n); G and H are symmetric,
    positive semidefinite. X, (p, n, n), is the cost to go from each step. Where no
    solution stabilises, what is returned leaves a multiplier of the loop that it closes
    on the unit circle or beyond.

    Examples
    --------
    An unstable step at no cost of the state: the pole 2 is mirrored at the unit circle.

    >>> A, G, H = (np.full((1, 1, 1), value) for value in (2.0, 1.0, 0.0))
    >>> X = solve_periodic_riccati(A, G, H)
    >>> round(float(X.item()), 12), round(float(defect_and_loop(A, G, H, X)[1].item()), 12)
    (3.0, 0.5)
    """
    A, G, H, units = _balanced(A, G, H)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        X = _swept(A, G, H, _doubled(*composed(A, G, H)))
        for _ in range(REFINEMENTS):
            defect, loop = defect_and_loop(A, G, H, X)
            correction = solve_periodic_lyapunov(loop, defect)
            if not np.all(np.isfinite(correction)):
                break
            X = X + correction
    return X / (units * units[:, None])


def solve_periodic_lyapunov(A, H):
    """Periodic solution of X_k = H_k + A_kᵀ X_{k+1} A_k, all multipliers within the unit circle.

    X is infinite or NaN where a multiplier is not within.

    Examples
    --------
    >>> A, H = np.full((1, 1, 1), 0.5), np.full((1, 1, 1), 3.0)
    >>> float(solve_periodic_lyapunov(A, H).item())
    4.0
    """
    G = np.zeros_like(A)
    with np.errstate(over="ignore", invalid="ignore"):
        return _swept(A, G, H, _doubled(*composed(A, G, H)))


def multipliers_of(factors):
    """Eigenvalues of the product of factors (p, n, n), the largest first, however far apart.

    Examples
    --------
    >>> multipliers_of(np.tile(np.diag([0.5, 1e-9]), (40, 1, 1))).real.tolist()[1] < 1e-300
    True
    """
    with np.errstate(under="ignore"):
        values = np.exp(product_logarithms(factors))
    return values[np.lexsort((values.imag, -np.abs(values)))]


def _doubled(A, G, H):
    """X_0 from the triple of a period: its horizon is doubled until nothing is added.

    The equation is that of X − c I. Without this start above zero the doubling would find a
    solution that leaves alone what is unstable and costs nothing. With G = 0 there is no other.
    """
    n = len(A)
    cost, reach = np.max(np.abs(H), initial=0.0), np.max(np.abs(G), initial=0.0)
    start = (cost or 1.0 / reach if reach else 0.0) * np.eye(n)
    W = np.linalg.solve(np.eye(n) + G @ start, np.concatenate([A, G], axis=1))
    H = _symmetric(H + A.mT @ start @ W[:, :n] - start)
    A, G = W[:, :n], _symmetric(W[:, n:])
    for _ in range(MAX_DOUBLINGS):
        A, G, new = _joined((A, A), (G, G), (H, H))
        moved, H = np.max(np.abs(new - H), initial=0.0), new
        if not moved > EPS * np.max(np.abs(H + start), initial=0.0):
            break
    return H + start


def _swept(A, G, H, X):
    """X_0 … X_{p−1}, backwards from X_p = X."""
    swept = np.empty_like(A)
    n = A.shape[-1]
    for k in range(len(A) - 1, -1, -1):
        X = _symmetric(H[k] + A[k].mT @ X @ np.linalg.solve(np.eye(n) + G[k] @ X, A[k]))
        swept[k] = X
    return swept


def defect_and_loop(A, G, H, X):
    """What (1) leaves of X, and the steps (I + G_k X_{k+1})⁻¹ A_k of the loop that X closes.

    With G = L Lᵀ neither loses digits where G X is large, as X (I + G X)⁻¹ would.

    Examples
    --------
    >>> one = np.ones((1, 1, 1))
    >>> [float(M.item()) for M in defect_and_loop(one, one, one, one)]
    [0.5, 0.5]
    """
    sizes, vectors = np.linalg.eigh(G)
    L = vectors * np.sqrt(np.maximum(sizes, 0.0))[:, None, :]
    after = np.roll(X, -1, axis=0)
    pushed = L.mT @ after
    gain = np.linalg.solve(np.eye(A.shape[-1]) + pushed @ L, pushed @ A)
    defect = H + A.mT @ after @ A - (pushed @ A).mT @ gain - X
    return _symmetric(defect), A - L @ gain


def _balanced(A, G, H):
    """Triples with the states in units, powers of two, in which they cost and are reached alike."""
    cost, reach = (np.einsum("kii->i", M) for M in (H, G))
    with np.errstate(divide="ignore", invalid="ignore"):
        exponent = 0.25 * (np.log2(reach) - np.log2(cost))
    known = np.isfinite(exponent)
    exponent = np.where(known, exponent, np.mean(exponent[known]) if known.any() else 0.0)
    units = 2.0 ** np.round(exponent)
    return (
        A * (units / units[:, None]),
        G / (units * units[:, None]),
        H * (units * units[:, None]),
        units,
    )


# ---- what cannot be stabilised ------------------------------------------------------------------


def unreachable_multipliers(A, G):
    """Multipliers on or outside the unit circle that no input reaches.

    For a left eigenvector w of Φ = A_{p−1} … A_0, and w_k what it was at step k,

        wᴴ Φ = μ wᴴ,   Σ_k w_kᴴ G_k w_k = 0      (Popov, Belevitch, Hautus)

    A holds the steps, and G holds what reaches the states in them
    (B Bᵀ, in any weights). The transposed steps in the reverse order, with CᵀC, tell
    what no output sees. The array is empty if everything can be stabilised.

    Examples
    --------
    >>> A = np.diag([2.0, 1.5, 0.1])[None]
    >>> unreachable_multipliers(A, np.diag([1.0, 0.0, 0.0])[None]).real.tolist()
    [1.5]
    """
    Phi, n = product_of(A), A.shape[-1]
    values = np.linalg.eigvals(Phi)
    lost = []
    for value in values[np.abs(values) >= 1.0 - DEPENDENT]:
        _, sizes, right = np.linalg.svd(Phi.T - value.conj() * np.eye(n))
        w = right[-max(1, int(np.sum(sizes <= DEPENDENT * np.linalg.norm(Phi)))) :].conj().T
        reached, most = 0.0, 0.0
        for Ak, Gk in zip(A[::-1], G[::-1], strict=True):
            reached = reached + w.conj().T @ Gk @ w
            most = most + np.einsum("ia,ij,ja->a", np.abs(w), np.abs(Gk), np.abs(w))
            w = Ak.T @ w
        size = np.sqrt(np.where(most > 0.0, most, 1.0))
        if np.linalg.eigvalsh(reached / (size * size[:, None]))[0] <= EXACT:
            lost.append(value)
    return np.array(lost, dtype=complex)


def _symmetric(M):
    return 0.5 * (M + M.mT)
