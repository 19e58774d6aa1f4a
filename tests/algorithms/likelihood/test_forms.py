"""Laws of the forms that a likelihood has parameters of."""

from dataclasses import replace

import numpy as np
import pytest
from predictor_cases import FORMS, OMEGA, gain_of, matrices_at, oscillator, structure_of

from sklearn_hd.algorithms.likelihood.forms import FEWEST, MOST, Form, interpolating
from sklearn_hd.algorithms.likelihood.uncertainty import exponent_slopes
from sklearn_hd.algorithms.periodic.behind_samples import samples_of
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import sampled_harmonics


@pytest.mark.parametrize("name", ["whole", "awkward", "awkward constant states"])
def test_matrices_are_those_of_an_integrator(name):
    form, theta = FORMS[name]()
    response = form.response(theta, sensitivities=False)
    for psi in (0.0, 1.234, 4.2):
        if form.n_points is None:  # at the samples of a turn
            k = round(psi * 8 / (2 * np.pi))
            psi = 2 * np.pi * k / 8
            found = [M[k % len(M)] for M in (response.Psi, response.Out)]
        else:
            parts = [sampled_harmonics(M, len(M) // 2) for M in (response.Psi, response.Out)]
            found = [evaluate_harmonics(M, np.array([psi]))[0] for M in parts]
        for one, other in zip(found, matrices_at(form, theta, psi), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.parametrize("n_phases", [8, 7.3])
def test_the_steps_of_a_continuous_form_are_a_discrete_form(n_phases):
    """The same matrices at the same azimuths, whichever way they are written."""
    structure, theta = oscillator()
    form = Form(structure, OMEGA, n_phases, n_points=31 if n_phases != 8 else None)
    whole = samples_of(structure.coefficients(theta), 2, OMEGA, 2 * np.pi / n_phases)
    steps, values = structure_of(whole, np.ones(whole.shape, dtype=bool), 2)
    discrete = replace(form, structure=steps, discrete=True)
    one, other = (
        form.response(theta, sensitivities=True),
        discrete.response(values, sensitivities=True),
    )
    np.testing.assert_allclose(one.Psi, other.Psi, atol=1e-8)
    np.testing.assert_allclose(one.Out, other.Out, atol=1e-12)
    assert form.radius(one) == pytest.approx(discrete.radius(other), abs=1e-7)
    assert one.dPsi.shape == (structure.n_parameters, *one.Psi.shape)
    assert other.dPsi.shape == (steps.n_parameters, *other.Psi.shape)


def test_outputs_are_linear_in_what_linear_names_and_in_nothing_else():
    """G and Q: the last column of [F G; P Q]."""
    for steps in (False, True):
        structure, _ = oscillator(steps=steps)
        form = Form(structure, OMEGA, 8, discrete=steps)
        columns = [int(name.split(",")[2]) for name in structure.parameter_names]
        assert form.linear.tolist() == [k for k, column in enumerate(columns) if column == 2]
    # a parameter shared between F and G is not linear; one without an entry is
    constant = np.zeros((1, 2, 2))
    basis = np.zeros((3, 1, 2, 2))
    basis[0, 0, 0] = [-1.0, 1.0]
    basis[1, 0, 1, 1] = 1.0
    shared = PeriodicStructure(constant, basis, 1, ("shared", "through", "idle"))
    assert Form(shared, 1.0, 8).linear.tolist() == [1, 2]


def test_nothing_is_linear_where_nothing_is_free():
    fixed, _ = structure_of(np.ones((1, 2, 2)), np.zeros((1, 2, 2), dtype=bool), 1)
    assert Form(fixed, 1.0, 8).linear.tolist() == []


@pytest.mark.parametrize("name", FORMS)
def test_the_gain_is_a_fourier_series(name, rng):
    form, theta = FORMS[name]()
    assert form.gain(theta) is None
    assert form.n_gains == 0
    form = form.with_gain(1)
    assert form.n_gains == 3 * 2 * 2
    coefficients = gain_of(form, rng)
    response = form.response(np.concatenate([theta, coefficients]), sensitivities=False)
    points = form.n_points or int(form.n_phases)
    assert len(response.gain) == points
    psi = 2 * np.pi / points * (points // 3)
    one, c, s = coefficients.reshape(3, 2, 2)
    expected = one + c * np.cos(psi) + s * np.sin(psi)
    np.testing.assert_allclose(response.gain[points // 3], expected, atol=1e-14)
    n = form.n_states
    k = points // 3
    Phi, C = response.Psi[k % len(response.Psi), :, :n], response.Out[k % len(response.Out), :, :n]
    np.testing.assert_allclose(response.closed[k % len(response.closed)], Phi - expected @ C)


def test_radius_is_that_of_the_product_over_a_turn():
    structure, theta = oscillator()
    form = Form(structure, OMEGA, 8)
    product = np.eye(2)
    for k in range(8):
        product = matrices_at(form, theta, 2 * np.pi * k / 8)[0][:, :2] @ product
    found = form.radius(form.response(theta, sensitivities=False))
    assert found == pytest.approx(np.max(np.abs(np.linalg.eigvals(product))), rel=1e-9)
    invariant, theta = oscillator(varies="")
    one = Form(invariant, OMEGA, 8)
    Phi = matrices_at(one, theta, 0.0)[0][:, :2]
    found = one.radius(one.response(theta, sensitivities=False))
    assert found == pytest.approx(np.max(np.abs(np.linalg.eigvals(Phi))), rel=1e-9)


@pytest.mark.parametrize("n_phases", [2.4, 5.45, 7.3, 20.7])
@pytest.mark.parametrize("stiffness", [0.6, 1.0, 1.4, 3.0])
def test_at_an_awkward_clock_a_form_is_stable_where_its_machine_is(n_phases, stiffness):
    """Mathieu's equation, on both sides of the bound: samples do not make it unstable."""
    for damping in (0.02, 0.1, 0.3, 0.6):
        M = np.zeros((3, 3, 3))
        M[0] = [[0.0, 1.0, 0.0], [-stiffness, -damping, 1.0], [1.0, 0.0, 0.0]]
        M[1, 1, 0] = 0.7
        structure, theta = structure_of(M, M != 0.0, 2)
        true = Form(structure, OMEGA, 24)
        true = true.radius(true.response(theta, sensitivities=False))
        form = interpolating(Form(structure, OMEGA, n_phases), theta)
        found = form.radius(form.response(theta, sensitivities=False))
        assert abs(true - 1.0) < 0.003 or (found < 1.0) == (true < 1.0), (damping, true, found)


@pytest.mark.parametrize("n_phases", [4.4, 16.216, 31.9])
@pytest.mark.parametrize("stiffness", [1.4, 2.0])
@pytest.mark.slow
def test_exponents_of_steps_are_those_of_the_machine_at_any_clock(n_phases, stiffness):
    """And their derivatives; a step made longer errs by the square of what is added."""
    M = np.zeros((3, 3, 3))
    M[0] = [[0.0, 1.0, 0.0], [-stiffness, -0.1, 1.0], [1.0, 0.0, 0.0]]
    M[1, 1, 0] = 1.0
    structure, theta = structure_of(M, M != 0.0, 2)
    true, _ = exponent_slopes(Form(structure, OMEGA, 24), theta)
    whole = samples_of(structure.coefficients(theta), 2, OMEGA, 2 * np.pi / n_phases)
    steps, values = structure_of(whole, np.ones(whole.shape, dtype=bool), 2)
    form = interpolating(Form(steps, OMEGA, n_phases, discrete=True), values)
    found, slopes = exponent_slopes(form, values)
    np.testing.assert_allclose(found, true, atol=0.02 / n_phases)
    for name in ("1,1,0", "0,1,1"):  # those of the machine, through its steps
        k = structure.parameter_names.index(name)
        step = 1e-6 * (np.arange(len(theta)) == k)
        ends = [
            samples_of(structure.coefficients(at), 2, OMEGA, 2 * np.pi / n_phases)
            for at in (theta + step, theta - step)
        ]
        moved = slopes @ ((ends[0] - ends[1]) / 2e-6).ravel()
        expected = exponent_slopes(Form(structure, OMEGA, 24), theta)[1][:, k]
        np.testing.assert_allclose(moved, expected, atol=0.05 / n_phases)


def test_interpolating_takes_the_points_that_resolve():
    form, theta = FORMS["awkward"]()
    assert form.n_points == FEWEST
    structure, theta = _sharp(12)
    sharp = interpolating(Form(structure, OMEGA, 7.3), theta)
    assert FEWEST < sharp.n_points < MOST
    assert sharp.n_points % 2 == 1
    response = sharp.response(theta, sensitivities=False)
    at = evaluate_harmonics(
        sampled_harmonics(response.Psi, len(response.Psi) // 2), np.array([0.777])
    )[0]
    np.testing.assert_allclose(at, matrices_at(sharp, theta, 0.777)[0], atol=1e-9)


def _sharp(harmonic):
    """An oscillator whose stiffness has a high harmonic."""
    M = np.zeros((2 * harmonic + 1, 3, 3))
    M[0] = [[0.0, 1.0, 0.0], [-2.0, -0.3, 1.0], [1.0, 0.0, 0.0]]
    M[2 * harmonic, 1, 0] = 0.5
    return structure_of(M, M != 0.0, 2)


def test_interpolating_does_not_take_a_high_harmonic_for_a_low_one():
    M = np.zeros((1201, 2, 2))  # at fewer points it would pass for a low harmonic
    M[0], M[1200, 0, 1] = [[0.9, 1.0], [1.0, 0.0]], 0.5
    structure, theta = structure_of(M, M != 0.0, 1)
    form = interpolating(Form(structure, OMEGA, 7.3, discrete=True), theta)
    assert form.n_points > MOST


def test_parameters_that_samples_cannot_follow_are_told():
    structure, theta = oscillator()
    form = Form(structure, OMEGA, 8)
    assert form.resolves(theta)
    fast = theta.copy()
    fast[structure.parameter_names.index("0,1,0")] = -1e8
    assert not form.resolves(fast)
    assert not form.resolves(np.where(theta == theta[0], np.nan, theta))
    discrete = Form(structure, OMEGA, 8, discrete=True)
    assert discrete.resolves(fast)
    assert not discrete.resolves(np.full(len(theta), np.inf))
