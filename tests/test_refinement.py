"""Laws of the response in modal coordinates and of its fit to raw signals."""

import numpy as np
import pytest

from sklearn_hd.algorithms.modes.modal_response import Record, fit_modal_model, is_white, residuals
from sklearn_hd.algorithms.modes.mode_shapes import real_block
from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.systems import LTPSystem

OMEGA, SPP, N_HARMONICS = 2 * np.pi, 32, 2
DT = 1.0 / SPP
EXPONENTS = np.array([-0.3, -0.6 + 1.1j])  # 1/s


def periodic_system(rng):
    """In Floquet coordinates, with two harmonics in B and P."""
    G = rng.standard_normal((2 * N_HARMONICS + 1, 3, 1))
    P = rng.standard_normal((2 * N_HARMONICS + 1, 2, 3))
    return LTPSystem(real_block(EXPONENTS), G, P, omega=OMEGA), P


def records(rng, system, noise=0.0):
    """Two segments, and the observation by all harmonics of both outputs."""
    drive, outputs, azimuths, observe = [], [], [], []
    for n_samples in (20 * SPP, 12 * SPP + 5):
        t = DT * np.arange(n_samples)
        drive.append(np.repeat(rng.standard_normal((n_samples // 7 + 1, 1)), 7, axis=0)[:n_samples])
        y = system.simulate(drive[-1], t, x0=rng.standard_normal(3))
        outputs.append(y + noise * rng.standard_normal(y.shape))
        azimuths.append(OMEGA * t)
        functions = harmonic_functions(azimuths[-1], range(N_HARMONICS + 1))
        zero = np.zeros_like(functions)
        observe.append(
            np.stack([np.hstack([functions, zero]), np.hstack([zero, functions])], axis=1)
        )
    return Record(drive, outputs, observe, azimuths, OMEGA, DT, N_HARMONICS)


def rough_start(rng, P, size):
    """Exponents and shapes off by some share; pairs of coefficients lie output by output."""
    C = P.transpose(1, 0, 2).reshape(-1, 3)
    return EXPONENTS * (1 + size), C * (1 + size * rng.standard_normal(C.shape))


def test_a_periodic_system_comes_back_from_a_rough_start(rng):
    system, P = periodic_system(rng)
    record = records(rng, system)
    model = fit_modal_model(record, *rough_start(rng, P, 0.1))
    np.testing.assert_allclose(model.exponents, EXPONENTS, rtol=1e-5)
    assert model.residual < 1e-9 * np.sum(record.outputs**2)


def test_what_is_left_under_noise_is_the_noise(rng):
    system, P = periodic_system(rng)
    record = records(rng, system, noise=0.1)
    model = fit_modal_model(record, *rough_start(rng, P, 0.1))
    left = residuals(record, model)
    assert np.sum(left**2) == pytest.approx(model.residual)
    assert model.residual / left.size == pytest.approx(0.01, rel=0.15)
    assert is_white(left, SPP)
    np.testing.assert_allclose(model.exponents, EXPONENTS, atol=0.1)


def test_a_structure_that_is_wrong_leaves_more_than_noise(rng):
    system, P = periodic_system(rng)
    record = records(rng, system, noise=0.01)
    exponents, C = rough_start(rng, P, 0.0)
    model = fit_modal_model(record, exponents[1:], C[:, 1:])
    assert not is_white(residuals(record, model), SPP)


def test_whiteness_is_rarely_denied_to_noise_and_never_granted_to_zero():
    draws = np.random.default_rng(0).standard_normal((200, 500, 2))
    assert np.mean([is_white(noise, 32) for noise in draws]) > 0.97
    assert not is_white(np.zeros((50, 1)), 5)


def test_responses_are_exact_for_inputs_held(rng):
    """Against the transition matrices of the periodic system itself."""
    system, _ = periodic_system(rng)
    one = LTPSystem(real_block(EXPONENTS[:1]), system.G.coefficients[:, :1], omega=OMEGA)
    t = DT * np.arange(3 * SPP)
    u = rng.standard_normal((len(t), 1))
    nothing = np.zeros((len(t), 1, 1))
    record = Record([u], [u], [nothing], [OMEGA * t], OMEGA, DT, N_HARMONICS)
    order = [0, 1, 3, 2, 4]  # 0, 1c, 2c, 1s, 2s
    forced = record.responses(EXPONENTS[0])[:, :5] @ system.G.coefficients[order, 0, 0]
    np.testing.assert_allclose(forced, one.simulate(u, t)[:, 0], atol=1e-11)


def test_an_exponent_that_turns_with_a_harmonic_of_the_input_has_no_pole_in_its_gain():
    t = DT * np.arange(2 * SPP)
    u = np.ones((len(t), 1))
    record = Record([u], [u], [u[..., None]], [OMEGA * t], OMEGA, DT, 1)
    response = record.responses(0.0 + 1j * OMEGA)
    assert np.isfinite(response).all()
    resonant = response[:, 1] + 1j * response[:, 2]  # driven by e^{jψ} or its conjugate
    other = response[:, 1] - 1j * response[:, 2]
    assert max(abs(resonant[-1]), abs(other[-1])) == pytest.approx(t[-1], rel=1e-9)
