"""Which way leads to the Hankel factor, and that each is as good as orthogonal transformations."""

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from conftest import random_stable
from scipy import linalg, optimize, signal

from sklearn_hd import HarmonicAnalyzer
from sklearn_hd._identify.sliding import modulated_inputs
from sklearn_hd._records.data import read_experiment, rows_read
from sklearn_hd.algorithms.linalg import triangular
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.subspace import hankel
from sklearn_hd.algorithms.subspace.hankel import factor_of_products, hankel_factor
from sklearn_hd.algorithms.subspace.lag_products import lag_products, stretch
from sklearn_hd.algorithms.subspace.projections import observability_subspace, state_matrices
from sklearn_hd.datasets import make_flapping_wing

BLOCK_ROWS = 15


def pole_error(R, A, n_outputs, n_inputs, block_rows=BLOCK_ROWS):
    """Largest distance of an identified pole from its true one."""
    U, values = observability_subspace(R, block_rows, n_inputs)
    found = linalg.eigvals(state_matrices(U, values, len(A), n_outputs)[0])
    distance = np.abs(linalg.eigvals(A)[:, None] - found)
    return distance[optimize.linear_sum_assignment(distance)].max()


@pytest.fixture(scope="module")
def hard():
    """Low-pass input, a double pole at 0.98, one weak mode, no noise."""
    rng = np.random.default_rng(3)
    poles = [(0.9, 0.3), (0.8, 1.0), (0.7, 2.0), (0.95, 0.6)]
    turns = [r * np.array([[np.cos(f), np.sin(f)], [-np.sin(f), np.cos(f)]]) for r, f in poles]
    A = linalg.block_diag(0.98, 0.98, *turns)
    B, C = rng.standard_normal((10, 3)), rng.standard_normal((3, 10))
    C[:, -2:] *= 1e-6
    T = linalg.qr(rng.standard_normal((10, 10)))[0]
    u = signal.lfilter(*signal.butter(4, 0.1), rng.standard_normal((20_000, 3)), axis=0)
    states = propagate(A, u @ B.T, np.zeros(10))
    return T @ A @ T.T, u, states @ C.T + u @ rng.standard_normal((3, 3)).T


@pytest.fixture(scope="module")
def noisy(hard):
    A, u, y = hard
    rng = np.random.default_rng(4)
    return A, u + 0.1 * rng.standard_normal(u.shape), y + 0.1 * rng.standard_normal(y.shape)


def test_plain_products_of_the_hard_case_are_refused(hard):
    """Taken all the same, with a shift that lets Cholesky pass, they lose the poles."""
    A, u, y = hard
    products = lag_products([(u, y)], 2 * BLOCK_ROWS, exact=False)
    assert factor_of_products(products, 3) is None
    G = products.gram().high
    order = hankel.block_order(2 * BLOCK_ROWS, 6, 3)
    G = (np.triu(G) + np.triu(G, 1).T)[np.ix_(order, order)]
    size = np.sqrt(np.diagonal(G))
    shifted = G / size / size[:, None] + 1e-14 * np.eye(len(G))
    assert pole_error(linalg.cholesky(shifted) * size, A, 3, 3) > 1e-4


def test_the_hard_case_is_as_exact_as_orthogonal_transformations(hard):
    A, u, y = hard
    found = pole_error(hankel_factor([u], [y], BLOCK_ROWS), A, 3, 3)
    reference = pole_error(hankel._orthogonal_factor([(u, y)], BLOCK_ROWS), A, 3, 3)
    assert found <= max(3.0 * reference, 1e-11)
    assert found <= 3e-10


def test_chunks_of_the_hard_case_merge_to_the_same_poles(hard):
    A, u, y = hard
    cuts = [0, 17, 6000, 6010, 20_000]
    chunks = [stretch((u[a:b], y[a:b]), 2 * BLOCK_ROWS) for a, b in pairwise(cuts)]
    tree = chunks[0].join(chunks[1]).join(chunks[2].join(chunks[3]))
    assert pole_error(factor_of_products(tree.closed(), 3), A, 3, 3) <= 3e-10


def test_noise_makes_plain_sums_safe(noisy):
    _, u, y = noisy
    R = factor_of_products(lag_products([(u, y)], 2 * BLOCK_ROWS, exact=False), 3)
    np.testing.assert_array_equal(R, hankel_factor([u], [y], BLOCK_ROWS))
    reference = hankel._orthogonal_factor([(u, y)], BLOCK_ROWS)
    reference *= np.sign(np.diagonal(reference))[:, None]
    np.testing.assert_allclose(R, reference, atol=1e-10 * np.abs(reference).max())


@pytest.mark.slow
def test_inputs_that_move_seldom_cost_exact_sums_nothing():
    """Doublets times harmonics: most directions of the inputs are nothing but rounding."""
    data = make_flapping_wing("ltp", n_records=4, random_state=1, width=7.3, snr=50)
    analyzer = HarmonicAnalyzer(data.omega, output_harmonics={"w": [0], "phi_dot": [1]}, hop=8)
    frame = analyzer.fit_transform(data.inputs, data.outputs)
    experiment = read_experiment(frame, data.outputs)
    outputs = rows_read(experiment)[1]
    records = list(zip(modulated_inputs(experiment, list(map(len, outputs))), outputs, strict=True))
    R = factor_of_products(lag_products(records, 40, exact=True), 9)
    reference = hankel._orthogonal_factor(records, 20)
    size = np.linalg.norm(reference, axis=0)
    both = [(each / size).T @ (each / size) for each in (R, reference)]
    np.testing.assert_allclose(*both, atol=1e-12)


def test_faint_noise_is_no_excuse(hard):
    """Noise of 1e-9: plain sums see nothing of it, and are refused."""
    _, u, y = hard
    y = y + 1e-9 * np.random.default_rng(5).standard_normal(y.shape)
    assert factor_of_products(lag_products([(u, y)], 30, exact=False), 3) is None


@pytest.mark.parametrize("way", ["plain", "exact", "orthogonal"])
@pytest.mark.parametrize("scale", [None, np.array([2.0, 0.5, 3.0])])
def test_every_way_squares_to_the_hankel_products(rng, monkeypatch, way, scale):
    u, y = rng.standard_normal((2000, 2)), rng.standard_normal((2000, 1))
    if way != "plain":
        monkeypatch.setattr(hankel, "safe_cholesky", lambda G, overwrite: None)
    if way == "exact":
        monkeypatch.setattr(hankel, "FEW_COLUMNS", 1)
    R = hankel_factor([u, u[:25]], [y, y[:25]], 4, scale)
    if scale is not None:
        u, y = u / scale[:2], y / scale[2:]
    parts = [hankel._columns(u, y, 4, 0, 1993), hankel._columns(u[:25], y[:25], 4, 0, 18)]
    Z = np.vstack(parts)
    np.testing.assert_allclose(R.T @ R, Z.T @ Z, atol=1e-9)
    np.testing.assert_array_equal(R, np.triu(R))


def test_all_smaller_block_rows_come_from_the_same_products(rng):
    records = [(rng.standard_normal((n, 2)), rng.standard_normal((n, 1))) for n in (400, 9, 250)]
    products = lag_products(records, 12, exact=True)
    for block_rows in (6, 4, 3):
        R = factor_of_products(products.fewer(2 * block_rows), 2)
        own = hankel._orthogonal_factor(records, block_rows)
        np.testing.assert_allclose(R.T @ R, own.T @ own, atol=1e-10)


def test_fewer_columns_than_rows(rng):
    u, y = rng.standard_normal((12, 1)), rng.standard_normal((12, 1))
    R, Z = hankel_factor([u], [y], 4), hankel._columns(u, y, 4, 0, 5)
    assert R.shape == (16, 16)
    np.testing.assert_allclose(R.T @ R, Z.T @ Z, atol=1e-12)


def test_a_channel_at_rest_is_no_obstacle(rng):
    u, y = rng.standard_normal((3000, 2)), rng.standard_normal((3000, 1))
    u[:, 1] = 0.0
    R = hankel_factor([u], [y], 3)
    Z = hankel._columns(u, y, 3, 0, 2995)
    np.testing.assert_allclose(R.T @ R, Z.T @ Z, atol=1e-9)


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_no_array_of_hankel_size_is_ever_allocated(rng, noise):
    A, B, C = random_stable(rng, 3, 2, 2)
    u = rng.standard_normal((60_000, 2))
    y = propagate(A, u @ B.T, np.zeros(3)) @ C.T + noise * rng.standard_normal((60_000, 2))
    hankel_bytes = 8 * len(u) * 2 * BLOCK_ROWS * 4
    tracemalloc.start()
    hankel_factor([u], [y], BLOCK_ROWS)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < hankel_bytes / 8
    assert peak < 2 * (u.nbytes + y.nbytes + 8 * (2 * BLOCK_ROWS * 4) ** 2)


def test_a_large_factor_takes_twice_its_own_size(rng):
    u, y = rng.standard_normal((2, 6000, 4))
    r_bytes = 8 * (2 * 40 * 8) ** 2
    tracemalloc.start()
    hankel_factor([u], [y], 40)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2 * (u.nbytes + y.nbytes + r_bytes)


@pytest.mark.slow
def test_blocks_lose_no_more_than_one_factorisation(hard):
    """Merged below the rows so far, not above them, they lost two to six times as much."""
    A, u, y = hard
    ratios = []
    for start in range(0, 16_000, 1000):  # they scatter: quartiles of 0.6 and 2
        rows = slice(start, start + 4000)
        Z = hankel._columns(u[rows], y[rows], BLOCK_ROWS, 0, 4000 - 2 * BLOCK_ROWS + 1)
        blocked = hankel._orthogonal_factor([(u[rows], y[rows])], BLOCK_ROWS)
        errors = [pole_error(R, A, 3, 3) for R in (blocked, np.linalg.qr(Z, mode="r"))]
        ratios.append(errors[0] / errors[1])
    assert np.median(ratios) < 2.0


@pytest.mark.parametrize("column", [1, 250, 399])
def test_cholesky_is_refused_wherever_a_column_is_nearly_another(rng, column):
    X = rng.standard_normal((500, 400))
    assert triangular.safe_cholesky(X.T @ X) is not None
    X[:, column] = X[:, 0] + 1e-6 * X[:, column]
    assert triangular.safe_cholesky(X.T @ X) is None


@pytest.mark.parametrize("size", [1, 191, 193, 400])
def test_the_size_of_an_inverse_is_that_of_the_inverse(rng, size):
    L = np.tril(0.05 * rng.standard_normal((size, size)), -1)
    L += np.diag(rng.uniform(0.1, 1.0, size))
    rows = rng.uniform(0.1, 1.0, size)
    found = triangular._inverse_square(L * rows[:, None], rows)
    np.testing.assert_allclose(found, linalg.norm(linalg.inv(L)) ** 2, rtol=1e-3)
    for tiny in (1e-30, 1e-60):  # beyond single precision: squared, and itself
        L[-1, -1] = tiny
        assert triangular._inverse_square(L, np.ones(size)) == np.inf


@pytest.mark.parametrize("smallest", [0.0, 1e-300, 0.9 * DEPENDENT, 3.0 * DEPENDENT, 1e-6, 1.0])
def test_all_singular_values_are_above_rounding_only_where_they_are(rng, smallest):
    left, right = np.linalg.qr(rng.standard_normal((2, 6, 6)))[0]
    R = linalg.qr((left * [1.0, 0.9, 0.5, 0.3, 0.2, smallest]) @ right, mode="r")[0]
    values = linalg.svdvals(R)
    above = triangular.all_above_rounding(R)
    if above:
        assert values[-1] > DEPENDENT * values[0]
    assert above or smallest < 1e-6
    assert triangular.all_above_rounding(R[:0, :0])


def test_cholesky_is_refused_where_digits_are_lost(rng):
    X = rng.standard_normal((50, 3))
    R = triangular.safe_cholesky(X.T @ X)
    np.testing.assert_allclose(R, np.triu(R))
    np.testing.assert_allclose(R.T @ R, X.T @ X, rtol=1e-13)
    X[:, 2] = X[:, 1] + 1e-6 * X[:, 2]
    assert triangular.safe_cholesky(X.T @ X) is None
    assert triangular.safe_cholesky(np.diag([1.0, 0.0])) is None
    with np.errstate(all="raise"):
        assert triangular.safe_cholesky(np.diag([1.0, -1e-17])) is None
