"""Small forms of every kind, and what their predictor must do, sample by sample."""

import numpy as np
from scipy import sparse
from scipy.integrate import solve_ivp

from sklearn_hd.algorithms.likelihood.forms import Form, interpolating
from sklearn_hd.algorithms.likelihood.predictor import as_records
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure

OMEGA = 2.0


def structure_of(coefficients, free, n_states):
    """Structure whose free entries are those of a mask, and their values."""
    moved = np.flatnonzero(free)
    k = len(moved)
    basis = sparse.csr_array((np.ones(k), (np.arange(k), moved)), shape=(k, coefficients.size))
    names = tuple(",".join(map(str, entry)) for entry in np.argwhere(free))
    structure = PeriodicStructure(np.where(free, 0.0, coefficients), basis, n_states, names)
    return structure, coefficients[free]


def oscillator(*, steps=False, varies="FGPQ"):
    """Two states, two outputs, one input; of [F G; P Q], or of the steps, any part varying."""
    M = np.zeros((3, 4, 3))
    M[0, :2] = [[0.0, 1.0, 0.3], [-3.0, -0.5, 1.0]]
    if steps:
        M[0, :2] = [[0.85, 0.2, 0.3], [-0.3, 0.8, 1.0]]
    M[0, 2:] = [[1.0, 0.2, 0.1], [0.0, 1.0, 0.0]]
    if "F" in varies:
        M[1, 1, 0], M[2, 1, 0] = (0.1, -0.05) if steps else (1.0, -0.4)
    if "G" in varies:
        M[1, 1, 2], M[2, 0, 2] = 0.3, 0.2
    if "P" in varies:
        M[1, 2, 0], M[2, 3, 1] = 0.3, -0.2
    if "Q" in varies:
        M[2, 2, 2] = 0.4
    free = M != 0.0
    free[0, 0, 1] = steps  # the rate of a position is its velocity
    return structure_of(M, free, 2)


FORMS = {
    "whole": lambda: _form(oscillator(), 8),
    "awkward": lambda: _form(oscillator(), 7.3),
    "constant": lambda: _form(oscillator(varies=""), 8),
    "constant states": lambda: _form(oscillator(varies="PQ"), 8),
    "constant outputs": lambda: _form(oscillator(varies="FG"), 8),
    "awkward constant states": lambda: _form(oscillator(varies="PQ"), 7.3),
    "steps": lambda: _form(oscillator(steps=True), 8, discrete=True),
    "awkward steps": lambda: _form(oscillator(steps=True), 7.3, discrete=True),
    "constant steps": lambda: _form(oscillator(steps=True, varies=""), 1, discrete=True),
}


def _form(case, n_phases, **options):
    structure, theta = case
    form = Form(structure, OMEGA, n_phases, **options)
    return (form if n_phases == round(n_phases) else interpolating(form, theta)), theta


def deviations(found):
    """Standard deviation of each parameter, infinite if it is not identified."""
    return np.sqrt(np.diag(found.covariance))


def gain_of(form, rng, size=0.1):
    """Coefficients of a small gain, in the order of the form's parameters."""
    return size * rng.standard_normal(form.n_gains)


def azimuths(form, n_samples, first=3):
    """Of the samples of a record: its own where a turn holds no whole number of them."""
    return 2.0 * np.pi * (first + np.arange(n_samples)) / form.n_phases


def record_of(form, rng, n_samples=60, *, first=3):
    """A record of noise, and its azimuths."""
    u = rng.standard_normal((n_samples, form.structure.n_inputs))
    y = rng.standard_normal((n_samples, form.n_outputs))
    psi = azimuths(form, n_samples, first)
    where = first if form.n_points is None else psi
    return as_records([(u, y, where)], form.n_outputs)[0], psi


def matrices_at(form, theta, psi):
    """[Φ Γ] and [C D] of one sample, by another way than the form's: an integrator."""
    M, n = form.structure.coefficients(theta), form.n_states
    at = evaluate_harmonics(M, np.array([psi]))[0]
    if form.discrete:
        return at[:n], at[n:]
    width = n + form.structure.n_inputs

    def slope(t, flat):
        whole = np.zeros((width, width))
        whole[:n] = evaluate_harmonics(M, np.array([psi + form.omega * t]))[0, :n]
        return (whole @ flat.reshape(width, width)).ravel()

    dt = 2.0 * np.pi / form.omega / form.n_phases
    found = solve_ivp(
        slope, (0.0, dt), np.eye(width).ravel(), method="DOP853", rtol=1e-12, atol=1e-13
    )
    return found.y[:, -1].reshape(width, width)[:n], at[n:]


def plain_predictions(form, parameters, record, psi, x0):
    """x[k+1] = Φ x + Γ u + K e, ŷ = C x + D u, in a loop."""
    k, n = form.structure.n_parameters, form.n_states
    gain, predicted, x = form.gain(parameters), [], np.array(x0)
    for j, angle in enumerate(psi):
        Psi, Out = matrices_at(form, parameters[:k], angle)
        z = np.concatenate([x, record.inputs[j]])
        predicted.append(Out @ z)
        e = record.outputs[j] - predicted[-1]
        x = Psi @ z
        if gain is not None:
            x = x + evaluate_harmonics(gain, np.array([angle]))[0] @ e
        assert len(x) == n
    return np.array(predicted)
