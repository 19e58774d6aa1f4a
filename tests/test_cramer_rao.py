"""Under noise, the output-error fit reaches the Cramér-Rao bound.

The truth lies inside the model class: the flapping wing with four harmonics in F, and
its heave model of harmonics. One doublet of 2 % of U*, 60 periods of 64 samples, noise
of 1/20 of each output's standard deviation.
"""

import numpy as np
import pytest
from predictor_cases import deviations
from scipy import sparse, stats

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.prediction_error import output_error_of
from sklearn_hd.algorithms.likelihood.predictor import as_records, simulate
from sklearn_hd.algorithms.likelihood.uncertainty import fisher_information
from sklearn_hd.algorithms.periodic.harmonic_decomposition import harmonic_decomposition
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure, sampled_response
from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.systems import flapping_wing

N_PHASES, N_PERIODS = 64, 60


@pytest.fixture(scope="module")
def wing():
    """Linearised flapping wing, and a doublet that begins at period 5."""
    system = flapping_wing()
    trim = system.trim(n_harmonics=64)
    u = np.zeros((N_PERIODS * N_PHASES, 1))
    u[5 * N_PHASES : 15 * N_PHASES], u[15 * N_PHASES : 25 * N_PHASES] = 1.0, -1.0
    return system.linearize(trim), 0.02 * trim.inputs[0] * u


def ltp_case(ltp):
    """F with four harmonics and the scale of G free: 37 parameters."""
    F, G, _, _ = ltp.fourier_coefficients(4)
    truth, free = np.zeros((9, 4, 3)), np.zeros((9, 4, 3), dtype=bool)
    truth[:, :2, :2], truth[1, 1, 2], truth[0, 2:, :2] = F, G[1, 1, 0], np.eye(2)
    free[:, :2, :2] = free[1, 1, 2] = True
    moved = np.flatnonzero(free)
    basis = sparse.csr_array((np.ones(37), (np.arange(37), moved)), shape=(37, truth.size))
    names = [str(entry) for entry in np.argwhere(free)]
    return PeriodicStructure(np.where(free, 0.0, truth), basis, 2, names), truth[free], None


def heave_case(ltp):
    """States w_0, φ̇_1c, φ̇_1s seen through w and φ̇: 8 parameters in A (ω known), 1 in B."""
    A, B, _, _ = harmonic_decomposition(*ltp.fourier_coefficients(2), ltp.omega, 1, 0, 1)
    kept = [0, 3, 5]  # of w_0, φ̇_0, w_1c, φ̇_1c, w_1s, φ̇_1s
    truth = np.hstack([A[np.ix_(kept, kept)], B[kept]])
    constant = np.zeros((1, 6, 4))
    constant[0, 3:, :3] = np.eye(3)
    constant[0, 1, 2], constant[0, 2, 1] = -ltp.omega, ltp.omega
    entries = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0), (2, 2), (1, 3), (1, 2)]
    basis = np.zeros((9, 1, 6, 4))
    for k, (row, column) in enumerate(entries):
        basis[k, 0, row, column] = 1.0
    basis[8, 0, 2, 1] = 1.0
    theta = np.array([(truth - constant[0, :3])[entry] for entry in entries])
    functions = harmonic_functions(2 * np.pi * np.arange(N_PHASES) / N_PHASES, [1])
    observe = np.zeros((N_PHASES, 2, 3))
    observe[:, 0, 0], observe[:, 1, 1:] = 1.0, functions
    return PeriodicStructure(constant, basis, 3, [str(e) for e in entries]), theta, observe


CASES = {"ltp": ltp_case, "lti-signal": heave_case}


def errors_and_intervals(case, wing, n_seeds):
    """Errors (n_seeds, k) and standard errors of fits from perturbed truths, and the bound."""
    ltp, u = wing
    structure, theta, observe = CASES[case](ltp)
    response = sampled_response(structure, theta, ltp.omega, N_PHASES, observe)
    record = as_records([(u, None, 0)], 2)[0]
    clean = simulate(response, record, np.zeros(structure.n_states))[1]
    noise = clean.std(axis=0) / 20
    form = Form(structure, ltp.omega, N_PHASES, observe)
    bound = fisher_information(form, theta, [(u, None, 0)], noise)
    size = np.max(np.abs(structure.coefficients(theta)), axis=0)
    errors, stds = [], []
    for seed in range(n_seeds):
        rng = np.random.default_rng(seed)
        y = clean + noise * rng.standard_normal(clean.shape)
        start = 0.02 * size * rng.standard_normal(structure.constant.shape)
        result = output_error_of(form, [(u, y, 0)], theta + structure.basis @ start.ravel())
        assert result.converged
        errors.append(result.theta - theta)
        stds.append(deviations(result))
    return np.array(errors), np.array(stds), bound


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_errors_are_distributed_as_the_bound_says(case, wing):
    """Σ eᵀ I e over seeds is χ² distributed; within its central 99.9 %."""
    n_seeds = 10
    errors, stds, bound = errors_and_intervals(case, wing, n_seeds)
    distance = np.einsum("si,ij,sj->", errors, bound.information, errors)
    low, high = stats.chi2.interval(0.999, errors.size)
    assert low < distance < high
    np.testing.assert_allclose(stds.mean(axis=0), deviations(bound), rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_rms_is_the_bound_and_intervals_cover(case, wing):
    """Over 600 seeds: rms / bound 0.994 (LTP) and 0.971 (heave), coverage 95.0 and 95.6 %."""
    errors, stds, bound = errors_and_intervals(case, wing, 150)
    relative = errors / deviations(bound)
    assert np.sqrt(np.mean(relative**2)) < 1.1
    assert np.max(np.sqrt(np.mean(relative**2, axis=0))) < 1.2  # 3.5 standard deviations of an rms
    assert 0.93 < np.mean(np.abs(errors) < stats.norm.ppf(0.975) * stds) < 0.97
