"""Maximum likelihood of linear models with all entries free.

    x[k+1] = A x[k] + B u[k] + K y[k],   ŷ[k] = C x[k] + D u[k]

A and B are those of the predictor, stable whatever the machine is; without K, of a simulation. In
B, K, D and x[0] predictions are linear: these are at their own optimum wherever A and C are, and
the innovations' covariance with them (Golub, Pereyra, 1973). A and C move in local coordinates:
similarities leave predictions alone, and with the one that makes the columns of [A/ρ; C]
orthonormal, l n parameters X remain of the (n + l) n entries, each of which moves them,

    [A/ρ; C] = (Q + Q⊥ X) (I + XᵀX)^{-1/2},     Q the present one,   QᵀQ⊥ = 0

(output-normal form; ρ = 1 in Bruls et al.). Eigenvalues that a step would move out of the unit
circle stay on it. Where A or C vary with the azimuth, all their coefficients are parameters, and
steps out of stability are refused.

Steps are those of Gauss and Newton. What their Hessian leaves out is learned from how slopes
change (Dennis, Gay, Welsch, 1981; here by updates of rank one).

References: J. Bruls, C. T. Chou, B. R. J. Haverkamp, M. Verhaegen, "Linear and non-linear system
identification using separable least squares", European Journal of Control 5 (1999); T. McKelvey,
A. Helmersson, T. Ribarits, "Data driven local coordinates for multivariable linear systems and
their application to system identification", Automatica 40 (2004).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.likelihood.likelihood import (
    NOISELESS,
    Point,
    Problem,
    likelihood_problem,
    updated_factor,
)
from sklearn_hd.algorithms.likelihood.predictor import output_sensitivities
from sklearn_hd.algorithms.likelihood.search import (
    DAMPING_LIMIT,
    FIRST_DAMPING,
    LikelihoodResult,
    Search,
    result_of,
    search,
)
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EPS, EXACT, HALF
from sklearn_hd.algorithms.linalg.triangular import column_sizes
from sklearn_hd.algorithms.periodic.harmonic_balance import product, resize_harmonics
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure

SETTLED = 1e-11  # fall of the cost, a row, that another turn is worth
POOR = 0.25  # of the fall expected: what earlier steps told of the curvature no longer holds
WARM = 5  # steps that a start is given before it is judged
MOST_ROWS = 2500  # on which starts are judged
RHO = 1.01  # more than one: modes that do not decay have coordinates, too
DRAWS = 8  # of which the most likely is a start


@dataclass(frozen=True, eq=False)
class FreeFit:
    """The most likely model, in innovations form."""

    coefficients: np.ndarray  # (2 H + 1, n + l, n + m): of [A B; C D](ψ), in the order 0, 1c, 1s, …
    gain: np.ndarray | None  # (2 H' + 1, n, l): of K(ψ); None for a simulation
    # (k, size of the coefficients): how all coefficients, one after another, change with the
    # parameters of the search
    slopes: np.ndarray
    result: LikelihoodResult  # its ``theta`` and ``covariance`` are those of local coordinates


def free_form(
    form,
    segments,
    coefficients,
    free,
    *,
    gain=None,
    predicts=True,
    max_iter=100,
    n_starts=0,
    random_state=0,
):
    """The model of largest likelihood, every entry of its matrices free.

    The form's structure has the sizes. To start from are the coefficients (2 H + 1, n + l, n + m)
    of [A B; C D](ψ) and the gain (2 H'' + 1, n, l) of K(ψ); ``free`` (2 H' + 1, n + l, m) says what
    is free of [B; D](ψ), the rest being zero, H' perhaps above H. If the model predicts, it has a
    gain where that pays (Schwarz's criterion). Time-invariant ones have ``n_starts`` further starts
    at random, each of at most ``max_iter`` Jacobians. Without a stable predictor to start from, a
    ValueError says so.
    """
    n, count = form.n_states, len(coefficients)
    size = likelihood_problem(form, segments).size
    A, C = coefficients[:, :n, :n], coefficients[:, n:, :n] / size[:, None]
    columns = np.concatenate([A, C], axis=1)
    closed = columns
    if gain is not None:
        closed = columns.copy()
        closed[:, :n] -= product(gain * size, C)[:count]
    settings = {"max_iter": max_iter, "tol": 1e-8}
    family = _family(form, segments, free, size, count if predicts else 0, predicts)
    order = (closed, columns) if predicts else (columns, closed)
    charts = _charts(family, order)
    if count == 1:
        charts = family.starts(charts, **settings, n_starts=n_starts, random_state=random_state)
    found = family.best(charts, **settings)
    problem = found[0].problem
    if not np.isfinite(found[0].point.cost):
        raise ValueError(
            f"the identified model, of order {n}, has no stable predictor from which maximum "
            f"likelihood could start; lower the order, or use a longer record"
        )
    exact = found[0].point.rss <= problem.n_rows * (NOISELESS * problem.size) ** 2
    if exact.any() and not exact.all():  # an output without noise outweighs all others
        alike = replace(family, problem=replace(family.problem, sigma=family.problem.size))
        charts = [alike.best(_charts(family, order), **settings)[0].chart]
        found = family.best(charts, **settings)
    if predicts:
        without = _family(form, segments, free, size, 0, predicts)
        more = len(np.flatnonzero(family.drives)) - len(np.flatnonzero(without.drives))
        beat = found[0].point.cost + 0.5 * more * np.log(problem.n_residuals)
        simple = without.best(_charts(without, (columns,)), **settings, beat=beat)
        if simple[0].point.cost <= beat:
            found, predicts = simple, False
    return _in_innovations_form(*found, size, predicts)


def _family(form, segments, free, size, n_gains, correlated):
    """All models of some order between signals; outputs, in parts of their size, drive them."""
    n, rows = form.n_states, free.shape[1]
    drives = np.concatenate([np.zeros((len(free), rows, n), dtype=bool), free], axis=2)
    scaled = [(u, y / size, where) for u, y, where in segments]
    if n_gains:
        gains = np.zeros((max(len(free), n_gains), rows, rows - n), dtype=bool)
        gains[:n_gains, :n] = True
        wider = np.zeros((len(gains), *drives.shape[1:]), dtype=bool)
        wider[: len(drives)] = drives
        drives = np.concatenate([wider, gains], axis=2)
        scaled = [(np.hstack([u, y]), y, where) for u, y, where in scaled]
    unused = PeriodicStructure(np.zeros(drives.shape), np.zeros((0, drives.size)), n, ())
    problem = likelihood_problem(replace(form, structure=unused), scaled, correlated=correlated)
    return FreeForm(problem, drives)


def _charts(family, several):
    """Where to start; models that are not stable are moved until they are."""
    form, drives = family.problem.form, family.drives
    n, charts = form.n_states, []
    for columns in several:
        if len(columns) == 1:
            charts.append(OutputNormal.of(columns[0, :n], columns[0, n:]))
            continue
        constant = np.zeros((len(columns), *drives.shape[1:]))
        constant[..., :n] = columns
        alone = PeriodicStructure(constant, np.zeros((0, constant.size)), n, ())
        one = replace(form, structure=alone)
        radius = one.radius(one.response([], sensitivities=False))
        slower = np.ones((drives.shape[1], 1))
        slower[:n] = min(1.0, 1.0 / radius) ** (1.0 / form.n_phases)
        charts.append(AllEntries(slower * columns))
    return charts


def _in_innovations_form(model, search, size, predicts):
    """From the predictor's matrices, in parts of the outputs' size, to the model's."""
    problem, n = model.problem, model.problem.form.n_states
    structure, result = problem.form.structure, result_of(problem, search)
    m = structure.n_inputs - (len(size) if predicts else 0)
    now = structure.coefficients(model.point.theta)
    slopes = structure.basis.toarray().reshape(-1, *now.shape)
    for each in (now, slopes):
        each[..., n:, :] *= size[:, None]
    gain = None
    if predicts:
        gain = now[:, :n, n + m :] / size
        fed = product(gain, now[:, n:, : n + m])
        slopes = np.array([_opened(each, now, n, m, size) for each in slopes])
        now = resize_harmonics(now[..., : n + m], len(fed) // 2)
        now[:, :n] += fed
        gain = gain[: 2 * highest(gain) + 1]
    most = 2 * max(highest(now), highest(slopes.swapaxes(0, 1))) + 1
    now, slopes = now[:most], slopes[:, :most]
    spread = result.spread * size[:, None] * size
    cost = result.cost + problem.n_rows * float(np.sum(np.log(size)))
    result = replace(result, spread=spread, cost=cost)
    return FreeFit(now, gain, slopes.reshape(len(slopes), -1), result)


def _opened(change, now, n, m, size):
    """How [A + K C, B + K D; C, D](ψ) changes with [A B K; C D ·](ψ)."""
    fed = product(change[:, :n, n + m :] / size, now[:, n:, : n + m])
    fed += product(now[:, :n, n + m :] / size, change[:, n:, : n + m])
    opened = resize_harmonics(change[..., : n + m], len(fed) // 2)
    opened[:, :n] += fed
    return opened


def highest(coefficients):
    """Highest harmonic that is not rounding."""
    sizes = np.max(np.abs(coefficients), axis=tuple(range(1, coefficients.ndim)), initial=0.0)
    return (int(np.flatnonzero(sizes > EXACT * np.max(sizes, initial=EPS))[-1]) + 1) // 2


@dataclass(frozen=True, eq=False)
class Model:
    """One of the models, what predictions are linear in at its optimum."""

    chart: object  # OutputNormal or AllEntries
    problem: Problem  # whose parameters are what predictions are linear in, then those of the chart
    point: Point

    @property
    def coefficients(self):
        return self.problem.form.structure.coefficients(self.point.theta)


@dataclass(frozen=True, eq=False)
class FreeForm:
    """Models of some order."""

    problem: Problem  # its structure is not used
    # bool, (2 H + 1, n + l, n + m): what predictions are linear in, of [A B; C D](ψ)
    drives: np.ndarray

    def model(self, chart, like=None):
        """The model at a chart's origin, near another with the same inputs."""
        n, places = self.problem.form.n_states, np.flatnonzero(self.drives)
        count, tangents = len(places), chart.tangents
        constant, basis = np.zeros(self.drives.shape), np.zeros((count, *self.drives.shape))
        constant[: len(chart.columns), :, :n] = chart.columns
        basis.reshape(count, constant.size)[np.arange(count), places] = 1.0
        basis = np.concatenate([basis, np.zeros((len(tangents), *self.drives.shape))])
        basis[count:, : len(chart.columns), :, :n] = tangents
        structure = PeriodicStructure(constant, basis, n, tuple(map(str, range(len(basis)))))
        problem = replace(self.problem, form=replace(self.problem.form, structure=structure))
        theta, x0 = np.zeros(len(basis)), np.zeros((len(problem.records), n))
        spread = np.diag(problem.size**2)
        if like is not None:
            theta[:count], x0 = like.point.theta[:count], like.point.x0
            spread = problem.spread(like.point.moments)
        radius = problem.form.radius(problem.form.response(theta, sensitivities=False))
        if radius > 1.0 + HALF:
            return Model(chart, problem, Point(theta, x0, None, np.inf, radius))
        return Model(chart, problem, _with_best_inputs(problem, theta, x0, spread, count))

    def search(self, model, max_iter, tol, beat=np.inf):
        """The most likely model from one, given up where it cannot beat a cost."""
        if not np.isfinite(model.point.cost):  # no stable model to begin with
            return model, Search(model.point, 0, False)
        if isinstance(model.chart, AllEntries):
            options = {"tol": tol, "keep_stable": True, "bounds": None}
            found = search(model.problem, model.point, max_iter=WARM, **options)
            reach = 2.0 * found.point.cost - model.point.cost  # as far again as it came
            if not found.converged and reach <= beat:
                found = search(model.problem, found.point, max_iter=max_iter, **options)
            return replace(model, point=found.point), found
        damping, before, curvature = FIRST_DAMPING, None, 0.0
        n_residuals, count = self.problem.n_residuals, int(self.drives.sum())
        for n_iter in range(1, max_iter + 1):
            point, walls = model.point, model.chart.walls
            R = model.problem.linearise(point).R[count:, count:]
            J, left = R[:, :-1], R[:, -1]
            slope, hessian = J.T @ left, J.T @ J
            curvature = _learned(curvature, hessian, slope, None if len(walls) else before)
            plain = Quadratic(hessian, slope, walls)
            quadratic = Quadratic(hessian + curvature, slope, walls)
            promised = min(plain.promised, quadratic.promised)
            converged = promised <= tol * n_residuals
            if converged or (n_iter > WARM and point.cost - promised > beat):
                return model, Search(point, n_iter, converged)
            trial, damping, step, poor = self._damped(model, quadratic, damping)
            if trial is None:
                converged = self.problem.at_rounding(point)
                return model, Search(point, n_iter, converged)
            before, curvature = (step, slope), 0.0 if poor else curvature
            model = trial
        return model, Search(model.point, max_iter, False)

    def _damped(self, model, quadratic, damping):
        """The next model, damping and step, and whether little came of it; None if none pays."""
        growth = 2.0
        while damping < DAMPING_LIMIT:
            step, expected = quadratic.step(damping)
            step = step * min(1.0, 1.0 / max(linalg.norm(step), EPS))
            trial = self.model(model.chart.moved(step), model)
            if trial.point.cost < model.point.cost:
                gain = (model.point.cost - trial.point.cost) / max(expected, EPS)
                fall = max(0.1, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
                return trial, max(damping * fall, 1e-12), step, gain < POOR
            damping, growth = damping * growth, 2.0 * growth
        return None, damping, None, True

    def best(self, charts, max_iter, tol, beat=np.inf):
        """The most likely model from several starts."""
        best, n_iter = None, 0
        for chart in charts:
            start = self.model(chart)
            known = beat if best is None else min(beat, best[0].point.cost)
            found = self.search(start, max_iter, tol, known - tol * self.problem.n_residuals)
            n_iter += found[1].n_iter
            if best is None or found[0].point.cost < best[0].point.cost:
                best = found
        return best[0], replace(best[1], n_iter=n_iter)

    def starts(self, charts, max_iter, tol, n_starts, random_state):
        """The best of some charts, and of others at random, on part of the record."""
        records, n_rows = [], 0
        for record in self.problem.records:
            rows = slice(0, MOST_ROWS - n_rows)
            psi = None if record.psi is None else record.psi[rows]
            some = {"inputs": record.inputs[rows], "outputs": record.outputs[rows], "psi": psi}
            records.append(replace(record, **some))
            n_rows += len(records[-1].inputs)
            if n_rows >= MOST_ROWS:
                break
        part = replace(self, problem=replace(self.problem, records=records))
        random = np.random.default_rng(random_state)
        best = part.best(charts, max_iter, tol)[0]
        n_samples = max(len(record.inputs) for record in records)
        for number in range(n_starts):
            if number % 3 < 2:
                charts = [best.chart.anywhere(n_samples, number % 3, random) for _ in range(DRAWS)]
            else:
                charts = [best.chart.about(random)]
            drawn = [part.model(chart) for chart in charts]
            chart = min(drawn, key=lambda model: model.point.cost).chart
            found = part.best([chart], max_iter, tol, best.point.cost)[0]
            best = found if found.point.cost < best.point.cost else best
        return [best.chart]


@dataclass(frozen=True, eq=False)
class Quadratic:
    """½ Xᵀ H X + gᵀ X, between walls that X may not pass."""

    hessian: np.ndarray
    slope: np.ndarray
    walls: np.ndarray

    @property
    def promised(self):
        """Twice the fall at its minimum."""
        step, _ = self.step(0.0)
        return -float(self.slope @ step)

    def step(self, damping):
        """Where it is least, and its fall there; damped in parts of the largest curvature."""
        top = linalg.norm(self.hessian, 2)
        touched, before = np.zeros(len(self.walls), dtype=bool), None
        while before is None or np.any(touched != before):
            free = (
                linalg.null_space(self.walls[touched]) if touched.any() else np.eye(len(self.slope))
            )
            values, vectors = linalg.eigh(free.T @ self.hessian @ free)
            values = np.maximum(np.abs(values), EXACT * top) + damping * top
            basis = free @ vectors
            step = -basis @ ((basis.T @ self.slope) / values)
            out = self.walls @ step > HALF * linalg.norm(self.walls, axis=1) * linalg.norm(step)
            before, touched = touched, touched | out
        return step, -float(self.slope @ step + 0.5 * step @ self.hessian @ step)


def _learned(curvature, hessian, slope, before):
    """What Gauss and Newton leave out of the Hessian, from how the slope changed (rank one)."""
    if before is None:
        return 0.0
    step, old = before
    missing = slope - old - (hessian + curvature) @ step
    size = missing @ step
    if abs(size) <= HALF * linalg.norm(missing) * linalg.norm(step):
        return curvature
    return curvature + np.outer(missing, missing) / size


def _with_best_inputs(problem, theta, x0, spread, count):
    """The point with the best of the first parameters, initial states and S.

    S and they are found in turn, by sums over time of products of outputs.
    """
    columns, left = _joined(_compressed(problem, theta, x0, count), problem.form.n_states)
    root = linalg.inv(linalg.cholesky(spread, lower=True))
    white = (columns @ root.T).reshape(len(columns), -1)
    size = column_sizes(white.T)
    R = np.linalg.qr(white.T / size, mode="r")
    _, singular, adjoint = np.linalg.svd(R, full_matrices=False)
    kept = singular > DEPENDENT
    basis = (adjoint[kept] / singular[kept][:, None]) / size  # that of orthonormal columns
    columns = np.tensordot(basis, columns, 1)
    products = np.einsum("atj,bti->jiab", columns, columns, optimize=True)
    pushes, still = np.einsum("ati,tj->ija", columns, left), left.T @ left
    step, cost = np.zeros(len(basis)), np.inf
    for _ in range(50):  # of S and inputs in turn
        weights = np.linalg.inv(spread)
        trial = -np.linalg.solve(
            np.tensordot(weights, products, 2), np.tensordot(weights, pushes, 2)
        )
        moved = pushes @ trial
        spread = problem.spread(still + moved + moved.T + products @ trial @ trial)
        before, cost = cost, 0.5 * np.linalg.slogdet(spread)[1]
        if not cost < before:
            break
        step = trial
        if before - cost < SETTLED:
            break
    found = step @ basis
    at, n0 = theta.copy(), x0.size
    at[:count] += found[n0:]
    return problem.point(at, x0 + found[:n0].reshape(x0.shape))


def _joined(blocks, n0):
    """Columns of all segments' initial states, then of what they share, and ŷ − y of all."""
    n_rows = [block.shape[1] for block in blocks]
    shared = np.concatenate([block[n0:] for block in blocks], axis=1)
    own = np.zeros((len(blocks), n0, *shared.shape[1:]))
    ends = np.cumsum(n_rows)
    for k, block in enumerate(blocks):
        own[k, :, ends[k] - n_rows[k] : ends[k]] = block[:n0]
    columns = np.concatenate([own.reshape(-1, *shared.shape[1:]), shared[:-1]])
    return columns, shared[-1]


def _compressed(problem, theta, x0, count):
    """Rows (columns, n_rows, l) of [∂ŷ/∂x0, ∂ŷ/∂θ, ŷ − y] with the same sums over time."""
    response = problem.form.response(theta, sensitivities=True)
    response = replace(response, dPsi=response.dPsi[:count], dOut=response.dOut[:count])
    blocks = []
    for record, start in zip(problem.records, x0, strict=True):
        factor = None
        for _, _, dy in output_sensitivities(response, record, start):
            n_columns, n_rows, n_outputs = dy.shape
            if factor is None:
                factor = np.zeros((n_columns * n_outputs,) * 2)
            factor = updated_factor(factor, dy.transpose(0, 2, 1).reshape(-1, n_rows))
        blocks.append(factor.reshape(-1, n_columns, n_outputs).transpose(1, 0, 2))
    return blocks


# ---- local coordinates -------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OutputNormal:
    """Time-invariant models about one."""

    frame: np.ndarray  # (n + l, n): [A/ρ; C], its columns orthonormal
    across: np.ndarray  # (n + l, l): orthonormal to it

    @classmethod
    def of(cls, A, C):
        """From any A and C; an A that is not stable is moved to the unit circle."""
        frame = _normal(_within_circle(A)[0], C)
        return cls(frame, linalg.svd(frame)[0][:, len(A) :])

    @property
    def size(self):
        return np.array([RHO] * self.frame.shape[1] + [1.0] * self.across.shape[1])[:, None]

    @property
    def columns(self):
        """[A; C], shape (1, n + l, n)."""
        return (self.size * self.frame)[None]

    @property
    def tangents(self):
        """What one unit of each parameter adds to the columns, shape (k, 1, n + l, n)."""
        n = self.frame.shape[1]
        across = self.size * self.across
        return np.einsum("ia,jb->abij", across, np.eye(n)).reshape(-1, 1, *self.frame.shape)

    @property
    def walls(self):
        """Slopes of the sizes of the eigenvalues that lie on the unit circle, (n_walls, k)."""
        n = self.frame.shape[1]
        values, left, right = linalg.eig(RHO * self.frame[:n], left=True)
        there = (np.abs(values) > 1.0 - HALF) & (values.imag >= 0.0)
        left, right, values = left[:, there], right[:, there], values[there]
        slopes = np.einsum("ie,kij,je->ek", left.conj(), self.tangents[:, 0, :n], right)
        return (slopes * (values.conj() / np.sum(left.conj() * right, axis=0))[:, None]).real

    def moved(self, step):
        """Those about the one at some parameters."""
        n = self.frame.shape[1]
        frame = _orthonormal(self.frame + self.across @ step.reshape(-1, n))
        A, clipped = _within_circle(RHO * frame[:n])
        frame = _normal(A, frame[n:]) if clipped else frame
        return replace(
            self, frame=frame, across=_orthonormal(self.across - frame @ (frame.T @ self.across))
        )

    def about(self, random):
        """Those at random at about distance one."""
        size = self.frame.shape[1] * self.across.shape[1]
        return self.moved(random.standard_normal(size) / np.sqrt(size))

    def anywhere(self, n_samples, slow, random):
        """Those at random: any frame, or modes that last, and turn once in, up to n_samples."""
        n, n_outputs = self.frame.shape[1], self.across.shape[1]
        if not slow:
            frame = _orthonormal(random.standard_normal(self.frame.shape))
            return self.of(frame[:n], frame[n:])
        A = np.zeros((n, n))
        for i in range(0, n, 2):
            last, turn = n_samples ** random.random(2)
            a, b = np.exp(-1.0 / last) * np.array([np.cos(np.pi / turn), np.sin(np.pi / turn)])
            A[i : i + 2, i : i + 2] = np.array([[a, b], [-b, a]])[: n - i, : n - i]
        return self.of(A, random.standard_normal((n_outputs, n)))


@dataclass(frozen=True, eq=False)
class AllEntries:
    """Periodic models about one."""

    columns: np.ndarray  # (2 H + 1, n + l, n): Fourier coefficients of [A; C]

    @property
    def tangents(self):
        return np.eye(self.columns.size).reshape(-1, *self.columns.shape)


def _normal(A, C):
    """Orthonormal [A/ρ; C] of the same model, its states changed as little as may be."""
    P = linalg.solve_discrete_lyapunov(A.T / RHO, C.T @ C)
    values, vectors = linalg.eigh(0.5 * (P + P.T))
    root = np.sqrt(np.maximum(values, EPS * values[-1]))
    T, back = (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
    return _orthonormal(np.vstack([T @ A @ back / RHO, C @ back]))


def _orthonormal(columns):
    left, _, right = linalg.svd(columns, full_matrices=False)
    return left @ right


def _within_circle(A):
    """A with the eigenvalues beyond the unit circle moved to it, and whether there are any."""
    values, vectors = np.linalg.eig(A)
    size = np.abs(values)
    if not np.max(size, initial=0.0) > 1.0:
        return A, False
    moved = vectors * (values / np.maximum(size, 1.0))
    return np.linalg.solve(vectors.T, moved.T).T.real, True
