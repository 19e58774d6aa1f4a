"""Laws of the time-invariant models that controllers are designed with, and of copies."""

import warnings

import control
import numpy as np
import pytest
from periodic_cases import coupled, mathieu, record
from scipy import linalg
from sklearn.exceptions import ConvergenceWarning
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.exceptions import IdentifiabilityWarning
from sklearn_hd.systems import LTPSystem, flapping_blade


def slow(**parameters):
    """An oscillator well below ω, whose copies the mean of its response does not see."""
    F = np.zeros((3, 2, 2))
    F[0], F[1, 1, 0], F[2, 1, 1] = [[0.0, 1.0], [-1.0, -0.1]], 0.8, 0.3
    return LTPSystem(F, [[0.0], [1.0]], omega=6.0, state_names=["q", "v"], **parameters)


def pbh(model):
    """Least singular value of [A − λI, B] and of [A − λI; C], balanced, over all λ."""
    A, B, C = model.A, model.B, model.C
    _, (scale, _) = linalg.matrix_balance(A, permute=False, separate=True)
    A, B, C = A * scale / scale[:, None], B / scale[:, None], C * scale
    B, C = B / linalg.norm(B), C / linalg.norm(C)
    shifted = [A - z * np.eye(len(A)) for z in linalg.eigvals(A)]
    reached = [linalg.svdvals(np.hstack([M, B]))[-1] for M in shifted]
    seen = [linalg.svdvals(np.vstack([M, C]))[-1] for M in shifted]
    return min(reached), min(seen)


def closed_loop(system, model, gain):
    """Floquet exponents under u = −K x(t), x the states that the model names."""
    rows = [system.state_names.index(label.removesuffix("_0")) for label in model.state_labels]
    K = np.zeros((system.n_inputs, system.n_states))
    K[:, rows] = gain
    feedback = LTPSystem(
        lambda psi: system.F(psi) - system.G(psi) @ K, system.G, omega=system.omega
    )
    return feedback.floquet_exponents()


@pytest.mark.parametrize("n_copies", [0, 1, 2])
@pytest.mark.parametrize(
    "system", [mathieu(), coupled(), flapping_blade()], ids=["one", "two", "b"]
)
def test_it_is_controllable_and_observable_and_its_eigenvalues_are_floquet_exponents(
    system, n_copies
):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)  # of what the base modes miss
        model = system.minimal_model(n_copies, n_output_harmonics=n_copies)
    assert min(pbh(model)) > 1e-6
    found = np.exp(model.poles() * system.period)
    wanted = np.exp(system.floquet_exponents() * system.period)
    assert np.max(np.min(np.abs(found[:, None] - wanted), axis=1)) < 1e-7
    assert model.nstates >= system.n_states * (2 * n_copies + 1)


def test_the_decomposition_itself_is_not_controllable():
    system = LTPSystem([[0.0, 1.0], [-4.0, -0.1]], [[0.0], [1.0]], omega=5.0)
    whole = system.harmonic_decomposition(5, 0, 0)
    assert whole.nstates == 22
    assert pbh(whole)[0] < 1e-12
    assert system.minimal_model().nstates == 2


def test_a_constant_system_is_its_own_minimal_model(rng):
    A, B, C, D = (rng.standard_normal(shape) for shape in ((4, 4), (4, 2), (3, 4), (3, 2)))
    for copies in (0, 2):
        system = LTPSystem(10.0 * A, B, C, D, omega=1.3)  # modes above ω are no copies
        model, loss = system.minimal_model(copies, return_loss=True)
        assert model.nstates == 4
        assert loss < 1e-12
        if copies == 0:
            for found, true in zip(
                (model.A, model.B, model.C, model.D), (10.0 * A, B, C, D), strict=True
            ):
                np.testing.assert_allclose(found, true, atol=1e-12 * np.abs(true).max())


def test_a_double_integrator_stays_one():
    model = LTPSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], omega=3.0).minimal_model()
    np.testing.assert_allclose(model.A, [[0.0, 1.0], [0.0, 0.0]], atol=1e-12)


def test_what_it_misses_is_the_difference_of_the_responses_and_falls_with_copies():
    system, losses = slow(), []
    for copies in (0, 1, 2):
        model, loss = system.minimal_model(copies, return_loss=True)
        losses.append(loss)
        exact = system.harmonic_decomposition(12, 0, 0)
        steady = [(each(0.0) if callable(each) else each) for each in (exact, model)]
        np.testing.assert_allclose(*steady, atol=1e-9)  # residualized: nothing at rest
        s = 0.7j
        off = np.abs(exact(s) - model(s)) / np.abs(exact(s))
        assert np.max(off) < 5.0 * loss
    assert losses[0] > 20.0 * losses[1] > 20.0 * losses[2]


def test_lqr_speeds_the_periodic_machine_up():
    system = slow()
    model = system.minimal_model()
    gain, _, poles = control.lqr(model, np.eye(2), [[1.0]])
    closed = closed_loop(system, model, gain)
    assert system.floquet_exponents().real.max() > -0.06
    assert closed.real.max() < -0.6
    np.testing.assert_allclose(np.sort(closed.real), np.sort(poles.real), rtol=1e-3)
    whole = system.harmonic_decomposition(4, 0, 0)  # an LQR on this moves no copy
    cost = whole.C.T @ whole.C
    left = linalg.eigvals(whole.A - whole.B @ control.lqr(whole, cost, [[1.0]])[0])
    assert left.real.max() > -0.051


def test_lqr_stabilises_an_unstable_machine():
    F = np.zeros((3, 2, 2))
    F[0], F[1, 1, 0] = [[0.0, 1.0], [0.5, -0.2]], 0.4
    system = LTPSystem(F, [[0.0], [1.0]], omega=8.0, state_names=["q", "v"])
    model = system.minimal_model()
    assert model.state_labels == ["q_0", "v_0"]
    assert model.input_labels == ["u1_0"]
    gain, _, poles = control.lqr(model, np.eye(2), [[1.0]])
    assert system.floquet_exponents().real.max() > 0.5
    np.testing.assert_allclose(
        np.sort(closed_loop(system, model, gain).real), np.sort(poles.real), rtol=0.02
    )


def test_copies_have_the_residues_of_the_decomposition():
    F = np.zeros((3, 2, 2))
    F[0], F[1], F[2, 1, 0] = [[0.0, 1.0], [-2.0, -0.3]], [[0.1, 0.0], [0.4, 0.2]], -0.3
    G = np.array([[[0.0], [1.0]], [[0.2], [0.5]], [[0.0], [-0.3]]])
    system = LTPSystem(F, G, [[1.0, 0.3]], omega=3.0)
    whole = system.harmonic_decomposition(15, 0, 0)
    values, left, right = linalg.eig(whole.A, left=True)
    residues = (whole.C @ right)[0] * (left.conj().T @ whole.B)[:, 0]
    residues = np.abs(residues / np.sum(left.conj() * right, axis=0))
    table = system.harmonic_modes(2)
    assert len(table) == 10
    table["product"] = table["controllability"] * table["observability"]
    for _, mode in table.groupby("base"):
        at = [np.argmin(np.abs(values - z)) for z in mode["eigenvalue"]]
        assert np.max(np.abs(values[at] - mode["eigenvalue"])) < 1e-8
        wanted = residues[at] / residues[at][0]
        np.testing.assert_allclose(mode["product"] / mode["product"].iloc[0], wanted, rtol=1e-6)


def test_a_negative_multiplier_has_two_eigenvalues_and_they_are_told_once():
    system = mathieu(stiffness=1.0)  # the first region of instability, multipliers negative
    table = system.harmonic_modes(1)
    assert len(table) == 8  # of each: ± ω/2 and ± 3ω/2
    assert (table["copy"] == 0).sum() == 4
    assert system.minimal_model().nstates == 4


def test_modes_that_inputs_do_not_reach_are_named_and_left_out():
    G = np.zeros((3, 2, 1))
    G[0, 1], G[1, 0] = 1.0, 1.0  # the first state by the cosine alone
    system = LTPSystem(np.diag([-1.0, -2.0]), G, omega=5.0, state_names=["a", "b"])
    with pytest.warns(IdentifiabilityWarning, match=r"the mode -1\+0j .* is not reached"):
        model = system.minimal_model()
    assert model.state_labels == ["b_0"]
    np.testing.assert_allclose(model.poles(), [-2.0])
    with pytest.warns(IdentifiabilityWarning, match="is not reached"):
        model = system.minimal_model(1, 1)  # by its copies it is, and they show
    assert min(pbh(model)) > 1e-3
    assert {-1 + 5j, -2 + 0j} <= set(model.poles().round(9))


def test_modes_that_outputs_do_not_show_are_named():
    system = LTPSystem(np.diag([-1.0, -2.0]), [[1.0], [1.0]], [[0.0, 1.0]], omega=5.0)
    with pytest.warns(IdentifiabilityWarning, match=r"the mode -1\+0j .* not seen"):
        assert system.minimal_model().nstates == 1


def test_twins_that_one_input_moves_alike_are_one():
    A = np.array([[0.0, 1.0], [-1.0, -0.2]])
    twins = LTPSystem(linalg.block_diag(A, A), [[0.0], [1.0], [0.0], [1.0]], omega=3.0)
    with pytest.warns(IdentifiabilityWarning, match=r"2 combination\(s\) of modes"):
        model = twins.minimal_model()
    assert model.nstates == 2
    np.testing.assert_allclose(model(0.5j)[0, 0], 1.0 / (0.75 + 0.1j), rtol=1e-9)


def test_what_goes_through_copies_is_said():
    system = mathieu(3.0, 1.0)  # 1.6 rad/s at an ω of 2: a copy at 0.4
    with pytest.warns(IdentifiabilityWarning, match=r"off by \d\d% of the response"):
        _, loss = system.minimal_model(return_loss=True)
    assert loss > 0.1


def test_units_do_not_matter():
    system, scale = slow(), np.array([1e6, 1e-5])
    model = system.minimal_model()
    F, G, _, _ = system.fourier_coefficients(1)
    other = LTPSystem(F * scale[:, None] / scale, G * scale[:, None], omega=6.0).minimal_model()
    np.testing.assert_allclose(other.A / scale[:, None] * scale, model.A, atol=1e-9)


def test_eigenvalues_that_do_not_converge_are_said(monkeypatch):
    def F(psi):
        stiff = 20.0 + 15.0 * np.sign(np.sin(psi))
        one, zero = np.ones_like(psi), np.zeros_like(psi)
        return np.array([[zero, one], [-stiff, -0.1 * one]]).transpose(2, 0, 1)

    machine = LTPSystem(F, [[0.0], [1.0]], omega=2.0)
    monkeypatch.setattr("sklearn_hd.systems.minimal.MOST_HARMONICS", 4)
    with (
        pytest.warns(ConvergenceWarning, match="from the Floquet exponent, because F has kinks"),
        pytest.warns(IdentifiabilityWarning, match="off by 111%"),
    ):
        machine.minimal_model()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_copies": -1}, "n_copies must be a whole number of at least 0"),
        ({"n_output_harmonics": 0.5}, "n_output_harmonics must be a whole number"),
        ({"return_loss": 1}, "return_loss must be True or False"),
    ],
)
def test_it_refuses(arguments, message):
    with pytest.raises(ValueError, match=message):
        mathieu().minimal_model(**arguments)


def test_an_identified_machine_is_made_faster():
    machine = slow()
    u, y = record(machine, n_periods=60, samples=16, noise=0.01, seed=1)
    pipe = Pipeline([
        ("harmonics", HarmonicAnalyzer(machine.omega, output_harmonics=1, reading="period")),
        ("identify", MOESPRegressor(2)),
        ("match", StructuredMatcher(structure=HarmonicStructure(F=1, G=0),
                                    criterion="output_error")),
    ]).fit(u, y)  # fmt: skip
    model = pipe["match"].ltp_.minimal_model()
    gain, _, poles = control.lqr(model, np.eye(2), [[1.0]])
    closed = closed_loop(machine, model, gain)  # the true machine
    np.testing.assert_allclose(np.sort(closed.real), np.sort(poles.real), rtol=0.05)
    assert closed.real.max() < -0.6
    assert machine.floquet_exponents().real.max() > -0.06
