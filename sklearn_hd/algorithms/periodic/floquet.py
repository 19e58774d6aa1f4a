"""Floquet analysis of linear time-periodic systems.

    ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt                  (Eq. 6)

Over an interval in which u is held, x moves to Φ x + Γ u; over one period Φ is
the monodromy matrix, whose eigenvalues e^{λT} give the Floquet exponents λ.

Matrices of the periodic system are callables of ψ: an array of shape
``(n_points,)`` in, an array of shape ``(n_points, rows, columns)`` out. They may
jump (sgn of a speed that reverses): whatever is integrated here is integrated by
bisection, which closes in on a jump until nothing is lost.

The multipliers of Φ = Φ_p … Φ_2 Φ_1 may span more decades than a product holds:
beside one of size 1, rounding leaves nothing of one of size 1e-60. Orthogonal
bases Q_k carried through the factors, Φ_k Q_{k−1} = Q_k R_k with R_k upper
triangular, split the product without forming it. Once the last basis spans what the
first one did, column by column or block by block,

    Φ Q_0 = Q_0 (Q_0ᵀ Q_p) R_p … R_1

is block triangular, and each block's multipliers follow from its own small factors,
whose sizes are summed as logarithms. (SLICOT's periodic Schur form, MB03WD, was
tried first: its eigenvalues are those of the rounded product, and of 16 factors with
multipliers 1 and 1e-18, its triangular factors gave 0.012 and 1e-18.)
"""

import math
from functools import cache

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, EXACT
from sklearn_hd.algorithms.lti.simulation import propagate

N_STAGES = 7  # collocation of order 14, quadrature exact up to degree 13
BLOCK = 256  # intervals integrated together; bounds the memory
ROTATION = 2.0  # ∫‖F‖ dt of one factor: its condition stays below e⁴
MIN_FACTORS, MAX_FACTORS = 32, 8192
WIDE = 1e-3  # ratio of multipliers in one block below which sweeps go on


def neighbours(edges):
    """Left and right ends of neighbouring intervals, some hundred at a time."""
    for k in range(0, len(edges) - 1, BLOCK):
        block = edges[k : k + BLOCK + 1]
        yield block[:-1], block[1:]


def by_bisection(rule, compose, weights, left, right, tolerance):
    """What ``rule`` gives for each interval, the intervals halved until it settles.

    ``rule(left, right)`` returns one array per interval, ``compose(second, first)``
    joins those of two neighbours, ``weights(whole)`` scales their differences.
    """
    whole = rule(left, right)
    if not np.all(np.isfinite(whole)):
        raise ValueError("the matrices hold NaN or infinity at some azimuths; make them finite")
    weight = weights(whole)

    def settle(left, right, whole, depth):
        middle = 0.5 * (left + right)
        first, second = rule(left, middle), rule(middle, right)
        halves = compose(second, first)
        axes = tuple(range(1, halves.ndim))
        error = np.max(np.abs(halves - whole) * weight, axis=axes, initial=0.0)
        size = np.max(np.abs(halves) * weight, axis=axes, initial=1.0)
        rough = np.flatnonzero(~(error <= tolerance * size))
        if rough.size > 4096:  # a few jumps and kinks never leave as many intervals open
            raise ValueError(
                f"{rough.size} intervals of a period are still not resolved to {tolerance:g}; the "
                f"matrices must be smooth in psi except for a few jumps, and free of noise"
            )
        if rough.size and depth:
            ends = np.concatenate([left[rough], middle[rough], right[rough]])
            wholes = np.concatenate([first[rough], second[rough]])
            k = rough.size
            fine = settle(ends[: 2 * k], ends[k:], wholes, depth - 1)
            halves[rough] = compose(fine[k:], fine[:k])
        return halves

    return settle(left, right, whole, 50)  # 2⁻⁵⁰ of a period: closer to a jump than rounding tells


@cache
def gauss_tableau():
    """Nodes c, matrix a and weights b of Gauss collocation on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(N_STAGES)
    legendre = np.polynomial.legendre
    values = legendre.legvander(x, N_STAGES - 1)
    integrals = np.stack(
        [legendre.legval(x, legendre.legint(row, lbnd=-1.0)) for row in np.eye(N_STAGES)],
        axis=1,
    )  # ∫ of each Legendre polynomial from −1 to each node
    return 0.5 * (x + 1.0), 0.5 * integrals @ np.linalg.inv(values), 0.5 * w


def transition_matrices(F, G, psi, omega, *, tolerance=1e-14):
    """Transition matrices and input integrals of some intervals of azimuth.

    With u held over interval k,

        x(ψ_{k+1}) = Φ_k x(ψ_k) + Γ_k u_k,   dX/dt = F X,  Φ_k = X(ψ_{k+1}) X(ψ_k)⁻¹

    Each interval is integrated by Gauss collocation and halved until its two
    halves agree with the whole.

    Parameters
    ----------
    F : callable
        ψ of shape (n_points,) -> (n_points, n, n), in 1/s.
    G : callable or None
        ψ of shape (n_points,) -> (n_points, n, m); None if there is no input.
    psi : array_like, shape (n_intervals + 1,)
        Ends of the intervals in radians, increasing.
    tolerance : float, default=1e-14
        Largest difference of an interval and its halves, relative to Φ (with the
        states in units that balance F) and to the largest Γ of the input.

    Returns
    -------
    Phi : ndarray, shape (n_intervals, n, n)
    Gamma : ndarray, shape (n_intervals, n, m)

    References
    ----------
    E. Hairer, S. P. Nørsett, G. Wanner, *Solving Ordinary Differential Equations
    I*, 1993, section II.7 (Gauss collocation).

    Examples
    --------
    >>> def F(psi):
    ...     return -np.cos(psi)[:, None, None]
    >>> Phi, Gamma = transition_matrices(F, None, [0.0, 0.5 * np.pi], 1.0)
    >>> bool(np.isclose(Phi[0, 0, 0], np.exp(-1.0), rtol=1e-14))
    True
    """
    psi = np.asarray(psi, dtype=float)
    return steps_between(F, G, psi[:-1], psi[1:], omega, tolerance=tolerance)


def steps_between(F, G, left, right, omega, *, tolerance=1e-14):
    """The same of intervals that may overlap, from their left and right ends in radians."""
    units = state_units(F)

    def rule(left, right):
        return _collocation_step(F, G, left, right, omega, units)

    blocks = (slice(k, k + BLOCK) for k in range(0, max(len(left), 1), BLOCK))
    steps = np.concatenate(
        [
            by_bisection(rule, _compose, _transition_weights, left[some], right[some], tolerance)
            for some in blocks
        ]
    )
    n = len(units)
    steps *= units[:, None]
    return steps[:, :, :n] / units, steps[:, :, n:]


def monodromy_matrix(F, omega, *, start=0.0, tolerance=1e-14):
    """Transition matrix over one period, from azimuth ``start`` (radians)."""
    psi = start + np.linspace(0.0, 2.0 * np.pi, 33)
    Phi, _ = transition_matrices(F, None, psi, omega, tolerance=tolerance)
    return product_of(Phi)


def on_branch(exponents, omega):
    """Exponents with imaginary part in [−ω/2, ω/2], its lower edge moved to the upper, sorted.

    From the rightmost leftwards, conjugate pairs with the negative imaginary part first.
    """
    exponents = np.array(exponents, dtype=complex)
    edge = exponents.imag <= -0.5 * omega * (1.0 - 1e-12)
    exponents[edge] += 1j * omega
    return exponents[np.lexsort((exponents.imag, -exponents.real))]


def propagate_periodic(Phi, forcing, x0):
    """States of x[k+1] = Φ[k mod p] x[k] + v[k] from x[0] = x0.

    Each period's response to its own forcing, from rest, takes p steps for all
    periods at once; the states at the period boundaries follow from the
    time-invariant recursion of the monodromy matrix. Φ holds the matrices of one
    period, (p, n, n); p ≥ n_samples − 1 if nothing repeats. ``forcing``,
    (..., n_samples, n), holds v[k]; its last row is not used. ``x0`` has shape
    (..., n).

    Examples
    --------
    >>> Phi = np.array([[[0.5]], [[2.0]]])
    >>> propagate_periodic(Phi, np.ones((5, 1)), np.zeros(1)).ravel().tolist()
    [0.0, 1.0, 3.0, 2.5, 6.0]
    """
    *batch, _, n = forcing.shape
    v, steps = by_phase(forcing, len(Phi)), Phi.mT
    x = np.broadcast_to(x0, (*batch, n)).reshape(v.shape[1], n)
    if v.shape[2] > 1:
        x = propagate(product_of(Phi), _from_rest(steps, v), x)
    x = x.reshape(v.shape[1] * v.shape[2], n)
    for k, step in enumerate(steps):  # each forcing makes room for the state before it
        x, v[k] = x @ step + v[k].reshape(x.shape), x.reshape(v[k].shape)
    return in_time(v, forcing.shape)


def by_phase(signals, p):
    """Signals (..., n_samples, n) as (p, rows, n_periods, n), in one piece of memory.

    One product then acts on a phase of all periods. The last period is filled up with zeros.
    """
    *batch, n_samples, n = signals.shape
    rows, n_periods = math.prod(batch), -(-n_samples // p)
    whole = np.zeros((rows, n_periods * p, n))
    whole[:, :n_samples] = signals.reshape(rows, n_samples, n)
    return np.ascontiguousarray(whole.reshape(rows, n_periods, p, n).transpose(2, 0, 1, 3))


def in_time(phases, shape):
    """Phases (p, rows, n_periods, n) as signals (*shape[:-1], n): :func:`by_phase` undone."""
    p, rows, n_periods, n = phases.shape
    whole = phases.transpose(1, 2, 0, 3).reshape(rows, n_periods * p, n)
    return whole[:, : shape[-2]].reshape(*shape[:-1], n)


# ---- one interval --------------------------------------------------------------------------


def _collocation_step(F, G, left, right, omega, units):
    """[Φ, Γ] of each interval by one step of Gauss collocation, states in given units.

    Stages K_i = F_i (x + h Σ_j a_ij K_j) + G_i u; step h Σ_i b_i K_i.
    """
    c, width = gauss_tableau()[0], right - left
    nodes = (left[:, None] + width[:, None] * c).ravel()
    Fs = F(nodes)
    n = Fs.shape[-1]
    Gs = np.empty((len(nodes), n, 0)) if G is None else G(nodes)
    Fs, Gs = (M.reshape(len(left), len(c), n, -1) for M in (Fs, Gs))
    values = np.concatenate([Fs * (units / units[:, None]), Gs / units[:, None]], axis=-1)
    return collocation(width[:, None, None, None] / omega * values, adjoint=False)[2][:, :n]


def collocation(values, *, adjoint):
    """Adjoints L_q, stage states Z_q = [X_q; u] and steps [Φ Γ; 0 I] of collocation steps.

    Stages K_q = h [F_q G_q] Z_q, X_q = x + Σ_r a_qr K_r; step x + Σ_q b_q K_q. A push of K_q
    ends up as L_q times it. ``values`` holds h [F G] at the nodes, (..., n_stages, n, n + m).
    """
    _, a, b = gauss_tableau()
    *batch, Q, n, columns = values.shape
    coupling = values[..., :, :, None, :n] * a[:, None, :, None]
    system = np.eye(Q * n) - coupling.reshape(*batch, Q * n, Q * n)
    K = np.linalg.solve(system, values.reshape(*batch, Q * n, columns))
    K = K.reshape(*batch, Q, n, columns)
    steps = np.zeros((*batch, columns, columns)) + np.eye(columns)
    steps[..., :n, :] += np.einsum("q,...qij->...ij", b, K)
    if not adjoint:
        return None, None, steps
    stages = np.zeros((*batch, Q, columns, columns)) + np.eye(columns)
    stages[..., :n, :] += np.einsum("qr,...rij->...qij", a, K)
    weights = np.broadcast_to(np.kron(b[:, None], np.eye(n)), (*batch, Q * n, n))
    left = np.linalg.solve(system.mT, weights)
    return left.reshape(*batch, Q, n, n).mT, stages, steps


def _compose(second, first):
    """[Φ, Γ] of two neighbouring intervals in one, u held over both."""
    Phi = second[:, :, : second.shape[1]]
    joined = Phi @ first
    joined[:, :, second.shape[1] :] += second[:, :, second.shape[1] :]
    return joined


def _transition_weights(steps):
    """Weights that make the largest Γ of each input one."""
    n = steps.shape[1]
    weight = np.ones(steps.shape[1:])
    reach = np.max(np.abs(steps[:, :, n:]), axis=(0, 1))
    weight[:, n:] = 1.0 / np.where(reach > 0, reach, 1.0)
    return weight


def state_units(F):
    """Powers of two, shape (n,), in which the states' couplings are of the same size."""
    size = np.mean(np.abs(F(2.0 * np.pi * np.arange(16) / 16)), axis=0)
    pairs = size * size.T  # free of units
    size[~(pairs > DEPENDENT * np.max(pairs, initial=0.0))] = 0.0
    _, (units, _) = linalg.matrix_balance(size, permute=False, separate=True)
    return units


# ---- periodic recursion -------------------------------------------------------------------


def intervals_of_a_period(psi):
    """Intervals after which the sample azimuths repeat; all of them if they do not.

    Azimuths count as the same within 1e-10 rad: the rounding of ωt over thousands
    of periods stays below it.
    """
    n_intervals = len(psi) - 1
    p = round(2.0 * np.pi / (psi[1] - psi[0]))
    if not 1 <= p < n_intervals:
        return n_intervals
    k = np.arange(len(psi))
    expected = psi[k % p] + 2.0 * np.pi * (k // p)
    return p if np.max(np.abs(psi - expected)) < 1e-10 else n_intervals


def product_of(Phi):
    """Φ[p−1] … Φ[1] Φ[0]."""
    product = np.eye(Phi.shape[1])
    for factor in Phi:
        product = factor @ product
    return product


def scaled_product(Phi):
    """The same with one for its largest entry, and the logarithm of what it was divided by."""
    product, logarithm = np.eye(Phi.shape[1]), 0.0
    for factor in Phi:
        product = factor @ product
        size = np.max(np.abs(product))
        if size == 0.0:
            return product, -np.inf
        product, logarithm = product / size, logarithm + np.log(size)
    return product, logarithm


def _from_rest(steps, v):
    """State at the end of each period, from rest at its start."""
    x = np.zeros((v.shape[1] * v.shape[2], v.shape[3]))
    for step, forcing in zip(steps, v, strict=True):
        x = x @ step + forcing.reshape(x.shape)
    return x.reshape(v.shape[1:])


# ---- exponents of multipliers that lie far apart ----------------------------------------------


def floquet_exponents(F, omega, *, tolerance=1e-14):
    """Floquet exponents λ of ẋ = F(ψ) x, however far apart.

    F takes ψ of shape (n_points,) and gives (n_points, n, n), in 1/s; ``tolerance`` is
    that of :func:`transition_matrices`. Exponents have imaginary parts in (−ω/2, ω/2],
    and come from the rightmost leftwards, conjugate pairs with the negative imaginary
    part first.

    References
    ----------
    A. Bojanczyk, G. Golub, P. Van Dooren, "The periodic Schur decomposition:
    algorithms and applications", Proc. SPIE 1770 (1992); L. Dieci, R. D. Russell,
    E. S. Van Vleck, "On the computation of Lyapunov exponents for continuous
    dynamical systems", SIAM J. Numer. Anal. 34 (1997).

    Examples
    --------
    Multipliers e^{−1} and e^{−200}, which is 1e-87:

    >>> def F(psi):
    ...     return np.diag([-1.0, -200.0]) + 5.0 * np.sin(psi)[:, None, None] * [[0, 1], [0, 0]]
    >>> floquet_exponents(F, 2 * np.pi).real.round(9).tolist()
    [-1.0, -200.0]
    """
    period = 2.0 * np.pi / omega
    values = F(np.linspace(0.0, 2.0 * np.pi, 256, endpoint=False))
    if not values.shape[-1]:
        return np.zeros(0, dtype=complex)
    units = state_units(F)
    size = np.max(np.linalg.norm(values * (units / units[:, None]), axis=(1, 2)), initial=0.0)
    n_factors = int(np.clip(np.ceil(size * period / ROTATION), MIN_FACTORS, MAX_FACTORS))
    psi = np.linspace(0.0, 2.0 * np.pi, n_factors + 1)
    factors, _ = transition_matrices(F, None, psi, omega, tolerance=tolerance)
    return on_branch(product_logarithms(factors * (units / units[:, None])) / period, omega)


def product_logarithms(factors):
    """Logarithms of the eigenvalues of Φ_p … Φ_2 Φ_1, the product not formed.

    ``factors`` has shape (p, n, n), with Φ_1 first. Each factor is nonsingular, and
    conditioned well enough to be inverted. The logarithms have imaginary parts in
    [−π, π], and are conjugate where the eigenvalues are.

    Examples
    --------
    >>> factors = np.tile(np.diag([1.0, 1e-20]), (50, 1, 1))
    >>> (np.sort(product_logarithms(factors).real) / np.log(10)).round(9).tolist()
    [-1000.0, 0.0]
    """
    logarithms = _nested(factors)[2]
    return np.concatenate(logarithms) if logarithms else np.empty(0, dtype=complex)


def _nested(factors):
    """Bases before each factor whose first columns span the slowest modes, the blocks of modes of
    like multipliers, and the logarithms of each."""
    n = factors.shape[1]
    start = linalg.qr(np.random.default_rng(0).standard_normal((n, n)))[0]  # in no one's favour
    tolerance = max(EXACT, 2.0 * len(factors) * EPS)
    for _ in range(60):  # multipliers part in 50 if their ratio is below 0.5
        bases, triangles = _carry(factors, start)
        closing = start.T @ bases[-1]
        blocks = _blocks(closing, tolerance)
        logarithms = [_block_logarithms(closing, triangles, block) for block in blocks]
        if all(np.ptp(np.maximum(b.real, -1e300)) <= -np.log(WIDE) for b in logarithms):
            break
        start = bases[-1]
    return bases[:-1], blocks, logarithms


def separated_factors(factors):
    """Factors of the modes of like multipliers, and the bases in which they move by themselves.

        Φ_k E_k = E_{k+1} diag(factors of each group),   E_p = E_0

    A group is where what is slower never goes (right subspaces, carried forwards) and what is
    faster never comes from (left ones, carried backwards): noise in one is not blown up
    in another. Factors are given as for :func:`product_logarithms`. Returns
    (bases, groups, own): E, (p, n, n); slices of its columns, with the slowest group
    first; and the factors of each group, (p, k, k).
    """
    right, there, _ = _nested(factors)
    left, back, _ = _nested(factors.mT[::-1])
    left = np.roll(left[::-1], 1, axis=0)  # at the start of each factor, not at its end
    ends = sorted({block.stop for block in there} & {block.stop for block in back})
    groups = [slice(*pair) for pair in zip([0, *ends], ends, strict=False)]
    bases = np.empty(factors.shape)
    for group in groups:
        slow = right[:, :, : group.stop]
        barred = left[:, :, : group.start].mT @ slow
        inside = np.linalg.svd(barred)[2][:, group.start :]
        bases[:, :, group] = slow @ inside.mT
    moved = np.linalg.solve(np.roll(bases, -1, axis=0), factors @ bases)
    return bases, groups, [moved[:, group, group] for group in groups]


def _carry(factors, start):
    """Bases before and after each factor, and the triangular factors on the way."""
    bases, triangles = [start], np.empty(factors.shape)
    for k, factor in enumerate(factors):
        Q, triangles[k] = np.linalg.qr(factor @ bases[-1])
        bases.append(Q)
    return np.array(bases), triangles


def _blocks(closing, tolerance):
    """Slices of columns that span the same before and after."""
    n = len(closing)
    ends = [k for k in range(1, n) if np.max(np.abs(closing[k:, :k])) <= tolerance]
    return [slice(*pair) for pair in zip([0, *ends], [*ends, n], strict=True) if n]


def _block_logarithms(closing, triangles, block):
    """Logarithms of the eigenvalues of one diagonal block, scaled factor by factor."""
    product, scale = scaled_product(triangles[:, block, block])
    if scale == -np.inf:  # modes that a factor ends
        return np.full(len(product), -np.inf, dtype=complex)
    with np.errstate(divide="ignore"):  # what rounding has cancelled parts in a later sweep
        return np.log(linalg.eigvals(closing[block, block] @ product).astype(complex)) + scale
