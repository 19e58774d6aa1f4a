"""Laws of the way back from a Poincaré map to the periodic system."""

import numpy as np
import pytest
from periodic_cases import shape, similar
from scipy import linalg

from sklearn_hd.algorithms.periodic.multipliers import order_by_residual, refine_multipliers
from sklearn_hd.algorithms.periodic.periodic_realization import (
    FloquetShapes,
    fit_shapes,
    floquet_logarithm,
    state_response,
)

MAPS = {
    "real": (similar(np.diag([0.9, 0.2, 1e-3])), 0),
    "complex": (similar([[0.3, 0.8], [-0.8, 0.3]]), 0),
    "negative": (similar(np.diag([-0.5, -0.1])), 2),
    "one negative": (similar(np.diag([-0.5, 0.1, 0.7])), 1),
    "negative beside complex": (similar(linalg.block_diag(-0.4, [[0.3, 0.8], [-0.8, 0.3]])), 1),
    "repeated": (0.3 * np.eye(3), 0),
    "defective": (similar([[0.5, 1.0], [0.0, 0.5]]), 0),
    "negative, repeated": (-0.3 * np.eye(2), 2),
    "negative, defective": (np.array([[-0.5, 1.0], [0.0, -0.5]]), 2),
    "opposite": (similar(np.diag([0.5, -0.5])), 1),
    "growing": (similar(np.diag([1.2, 0.4])), 0),
}


@pytest.mark.parametrize("name", MAPS)
def test_the_exponential_of_the_logarithm_is_the_map(name):
    Phi, n_flips = MAPS[name]
    R, to_original, flips = floquet_logarithm(Phi, 0.7)
    signs = np.where(flips, -1.0, 1.0)
    back = to_original @ (signs[:, None] * linalg.expm(0.7 * R)) @ np.linalg.inv(to_original)
    assert np.isrealobj(R)
    assert flips.sum() == n_flips
    assert flips[:n_flips].all()
    np.testing.assert_allclose(back, Phi, atol=1e-12)
    np.testing.assert_array_equal(R[flips][:, ~flips], 0.0)
    np.testing.assert_array_equal(R[~flips][:, flips], 0.0)


@pytest.mark.parametrize("Phi", [np.zeros((1, 1)), np.diag([0.5, 0.0])])
def test_no_system_forgets_a_state_within_a_period(Phi):
    with pytest.raises(ValueError, match=r"multiplier is zero .* lower the order"):
        floquet_logarithm(Phi, 1.0)


@pytest.mark.parametrize("flips", [False, True])
def test_shapes_repeat_or_change_sign(rng, flips):
    psi, h = np.linspace(0.0, 2 * np.pi, 9), 1e-6
    coefficients = rng.standard_normal((1, 4, 2, 2))
    shapes = FloquetShapes(np.zeros((1, 1)), np.array([flips]), coefficients, 3)
    values, slopes = shapes(psi)
    sign = -1.0 if flips else 1.0
    np.testing.assert_allclose(shapes(psi + 2 * np.pi)[0], sign * values, atol=1e-12)
    numeric = (shapes(psi + h)[0] - shapes(psi - h)[0]) / (2 * h)
    np.testing.assert_allclose(slopes, numeric, atol=1e-7)


# ---- shapes ------------------------------------------------------------------------------------

PERIOD, N_PHASES = 2 * np.pi, 24
PSI = 2 * np.pi * np.arange(N_PHASES) / N_PHASES
RATES = np.array([[-0.2, 0.3], [0.0, -0.2]])  # defective


def sights(R=RATES):
    """O(ψ) = P(ψ) e^{Rt} of the shapes of the test systems."""
    P, _ = shape(PSI)
    return np.array([P_j @ linalg.expm(R * t) for P_j, t in zip(P, PSI, strict=True)])


def fitted(seen, R=RATES, flips=(False, False), **options):
    nothing = np.zeros(seen.shape[:2])
    return fit_shapes(seen, np.eye(2), nothing, R, np.array(flips), PERIOD, 50, **options)


def test_shapes_come_back_with_their_harmonics():
    shapes = fitted(sights())
    between = PSI + 0.1
    P, slope = shape(between)
    assert shapes.n_harmonics == 1
    np.testing.assert_allclose(shapes(between), (P, slope), atol=1e-12)
    F = (slope + P @ RATES) @ np.linalg.inv(P)
    np.testing.assert_allclose(shapes.state_matrix(between, 1.0, slice(None)), F, atol=1e-12)


def test_coordinates_do_not_change_the_state_matrix():
    T = np.array([[1.0, 2.0], [-0.5, 3.0]])
    R = np.linalg.inv(T) @ RATES @ T
    one, other = fitted(sights()), fitted(sights() @ T, R)
    np.testing.assert_allclose(
        other.state_matrix(PSI, 1.0, slice(None)),
        one.state_matrix(PSI, 1.0, slice(None)),
        atol=1e-12,
    )
    np.testing.assert_allclose(other(PSI)[0], one(PSI)[0] @ T, atol=1e-12)


def test_units_of_the_outputs_scale_shapes_and_state_matrix():
    units = np.array([[1e5], [1e-3]])
    one, other = fitted(sights()), fitted(units * sights())
    np.testing.assert_allclose(other(PSI)[0] / units, one(PSI)[0], atol=1e-12)
    F = other.state_matrix(PSI, 1.0, slice(None)) / units * units.T
    np.testing.assert_allclose(F, one.state_matrix(PSI, 1.0, slice(None)), atol=1e-10)


def test_shapes_that_change_sign():
    """A half turn of the axes: negative multipliers, and a constant F."""
    c, s = np.cos(0.5 * PSI), np.sin(0.5 * PSI)
    turn = np.array([[c, -s], [s, c]]).transpose(2, 0, 1)
    R = np.diag([-0.1, -0.3])
    seen = turn @ np.array([linalg.expm(R * t) for t in PSI])
    shapes = fitted(seen, R, (True, True))
    later = PSI + 2 * np.pi
    np.testing.assert_allclose(shapes(later)[0], -shapes(PSI)[0], atol=1e-12)
    F = 0.5 * np.array([[0.0, -1.0], [1.0, 0.0]]) + turn @ R @ turn.transpose(0, 2, 1)
    np.testing.assert_allclose(shapes.state_matrix(PSI, 1.0, slice(None)), F, atol=1e-12)


def test_noise_costs_harmonics(rng):
    noise = 1e-3 * rng.standard_normal((N_PHASES, 2, 2))
    residual = np.full((N_PHASES, 2), 50 * 1e-6)
    shapes = fit_shapes(
        sights() + noise, np.eye(2), residual, RATES, np.array([False, False]), PERIOD, 50
    )
    assert shapes.n_harmonics <= 3
    size = np.sqrt(np.mean(sights() ** 2))
    assert shapes.noise == pytest.approx(1e-3 / size, rel=0.3)
    np.testing.assert_allclose(shapes(PSI)[0], shape(PSI)[0], atol=5e-3)


# ---- the Poincaré map ----------------------------------------------------------------------------


def recorded(Phi, rng, *, lengths=(40, 25), n_directions=2, n_columns=12, noise=0.0):
    """Lifted records z[k+1] = Φ z + B w, Y = O z + D w, and what they were made of."""
    n = len(Phi)
    B = rng.standard_normal((n, n_directions))
    sight, D = rng.standard_normal((n_columns, n)), rng.standard_normal((n_columns, n_directions))
    directions, lifted = [], []
    for length in lengths:
        w, z = rng.standard_normal((length, n_directions)), rng.standard_normal(n)
        rows = []
        for w_k in w:
            rows.append(sight @ z + D @ w_k)
            z = Phi @ z + B @ w_k
        directions.append(w)
        lifted.append(np.array(rows) + noise * rng.standard_normal((length, n_columns)))
    return directions, lifted, sight


PHI = similar(linalg.block_diag([[0.5, 0.6], [-0.6, 0.5]], -0.4), seed=3)
ORBIT = similar(linalg.block_diag([[0.5, 0.6], [-0.6, 0.5]], 0.4), seed=3)  # det > 0 (Liouville)


def same_spectrum(A, B, atol):
    a, b = (np.sort_complex(np.linalg.eigvals(M)) for M in (A, B))
    np.testing.assert_allclose(a, b, atol=atol)


def test_multipliers_are_found_from_nearby(rng):
    directions, lifted, _ = recorded(PHI, rng)
    start = PHI + 0.02 * rng.standard_normal((3, 3))
    same_spectrum(refine_multipliers(start, directions, lifted), PHI, 1e-9)
    same_spectrum(refine_multipliers(PHI, directions, lifted), PHI, 1e-12)


def test_refinement_brings_multipliers_nearer_under_noise(rng):
    directions, lifted, _ = recorded(PHI, rng, noise=0.1)
    start = PHI + 0.05 * rng.standard_normal((3, 3))

    def gap(M):
        a, b = (np.sort_complex(np.linalg.eigvals(A)) for A in (M, PHI))
        return np.abs(a - b).max()

    assert gap(refine_multipliers(start, directions, lifted)) < 0.5 * gap(start)


def test_what_cannot_be_refined_is_left(rng):
    directions, lifted, _ = recorded(PHI, rng, lengths=(12,))
    assert refine_multipliers(PHI, directions, lifted) is PHI
    double = 0.5 * np.eye(2)
    directions, lifted, _ = recorded(double, rng)
    assert refine_multipliers(double, directions, lifted) is double


@pytest.mark.parametrize("lengths", [(60,), (30, 20, 15), (40, 1, 30)])
def test_every_sample_sees_the_state(lengths, rng):
    """O comes back up to the coordinates of the state."""
    directions, lifted, sight = recorded(PHI, rng, lengths=lengths)
    seen = [Y[:, :4] for Y in lifted]
    found, information, residual = state_response(PHI, sight[:4], directions, lifted, seen)
    T = linalg.lstsq(sight, found)[0]
    np.testing.assert_allclose(sight @ T, found, atol=1e-9)
    np.testing.assert_allclose(PHI @ T, T @ PHI, atol=1e-8)
    assert np.linalg.eigvalsh(information).min() > 0
    assert residual.max() <= 1e-18 * np.sum(np.vstack(lifted) ** 2)


def candidates(rng, most=6):
    """Φ of each order: what is there, and modes that are not."""
    return [
        linalg.block_diag(
            ORBIT[:n, :n] if n < 3 else ORBIT, *(0.7 * rng.uniform(-1, 1, max(0, n - 3)))
        )
        for n in range(1, most)
    ]


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
@pytest.mark.parametrize("n_directions", [1, 12])
def test_order_of_least_information_criterion(noise, n_directions, rng):
    directions, lifted, _ = recorded(
        ORBIT, rng, lengths=(60, 60), n_directions=n_directions, n_columns=40, noise=noise
    )
    assert len(order_by_residual(candidates(rng), directions, lifted)) == 3


def test_an_order_that_no_periodic_system_has_is_not_chosen(rng):
    """A rest that changes sign from period to period: det Φ < 0 with one state for it."""
    directions, lifted, _ = recorded(ORBIT, rng, lengths=(60, 60), n_columns=40)
    for y in lifted:
        y += 0.1 * np.outer((-0.8) ** np.arange(60), np.linspace(-1, 1, 40) ** 3)
    more = linalg.block_diag(ORBIT, -0.8)
    maps = [*(ORBIT[:n, :n] for n in range(1, 4)), more, linalg.block_diag(more, 0.1)]
    assert len(order_by_residual(maps, directions, lifted)) == 3


def test_systematic_errors_are_no_states(rng):
    """A rest that is not white: the last order that halves the sum of squares by far."""
    directions, lifted, _ = recorded(ORBIT, rng, lengths=(120,), n_columns=40)
    k = np.arange(120)[:, None]
    lifted[0] += 0.05 * np.sin(k**1.5) * np.linspace(-1, 1, 40) ** 3
    assert len(order_by_residual(candidates(rng), directions, lifted)) == 3
