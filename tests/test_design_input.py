"""design_input: the bound falls, the budget is kept, and what excites nothing is refused."""

import copy
import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.prediction_error import output_error_of
from sklearn_hd.algorithms.likelihood.uncertainty import (
    exponent_slopes,
    fisher_information,
    propagate_std,
)
from sklearn_hd.design import design_input
from sklearn_hd.systems import LTPSystem, mathieu

SYSTEM, SPP, N_PERIODS = mathieu(damping=0.3), 16, 20
PERIOD, NOISE = SYSTEM.period, 0.05
BUDGET = {"amplitude": 1.0, "length": N_PERIODS * PERIOD, "energy": 2.0 * PERIOD}
SETTINGS = {"noise_std": NOISE, "samples_per_period": SPP, "n_trials": 40}


def doublet(columns=("u",)):
    t = PERIOD / SPP * np.arange(N_PERIODS * SPP)
    period = np.arange(len(t)) // SPP
    u = np.where(period == 4, 1.0, 0.0) - np.where(period == 5, 1.0, 0.0)
    return pd.DataFrame(dict.fromkeys(columns, u), index=t)


def wide():
    """Mathieu's equation with two inputs and a force that varies."""
    F, G, *_ = SYSTEM.fourier_coefficients(1)
    G = np.concatenate([G, np.zeros_like(G)], axis=2)
    G[1, 1, 1] = 0.5
    G[0, 1, 1] = 1.0
    return LTPSystem(F, G, omega=SYSTEM.omega, state_names=["y", "v"], input_names=["a", "b"])


@pytest.fixture(scope="module")
def designed():
    return design_input(SYSTEM, **BUDGET, **SETTINGS, X=doublet())


@pytest.mark.slow
def test_the_bound_and_the_errors_fall_at_equal_energy(designed):
    """Estimates of six records each, by maximum likelihood, deviate less, as predicted."""
    assert designed.exponents["gain"].min() > 2.0
    structure = HarmonicStructure(F=1, G=0).resolve(*SIGNALS, {})
    theta, errors = structure.nearest(COEFFICIENTS), []
    for X in (doublet(), designed.inputs):
        clean = SYSTEM.simulate(X.to_numpy(), X.index.to_numpy())
        errors.append([])
        for seed in range(6):
            y = clean + NOISE * np.random.default_rng(seed).standard_normal(clean.shape)
            record = [(X.to_numpy(), y, 0)]
            form = Form(structure, SYSTEM.omega, SPP)
            found = output_error_of(form, record, theta, sigma=[NOISE] * 2)
            exponents, _ = exponent_slopes(form, found.theta)
            errors[-1].append(np.abs(exponents - SYSTEM.floquet_exponents()))
    rms = np.sqrt(np.mean(np.square(errors), axis=1))
    assert np.all(rms[1] < 0.7 * rms[0])
    bound = np.hypot(designed.exponents["std_real"], designed.exponents["std_imag"])
    assert np.all((rms[1] > 0.4 * bound) & (rms[1] < 2.0 * bound))


SIGNALS = SYSTEM.state_names, SYSTEM.input_names, SYSTEM.output_names
COEFFICIENTS = np.zeros((3, 4, 3))
COEFFICIENTS[:, :2, :2], COEFFICIENTS[:, :2, 2:] = SYSTEM.fourier_coefficients(1)[:2]
COEFFICIENTS[0, 2:, :2] = np.eye(2)


def test_the_deviations_are_the_bound_of_the_record(designed):
    structure = HarmonicStructure(F=1, G=0).resolve(*SIGNALS, {})
    theta = structure.nearest(COEFFICIENTS)
    for X, name in ((designed.inputs, ""), (doublet(), "_at_hand")):
        record = [(X.to_numpy(), None, 0)]
        form, sigma = Form(structure, SYSTEM.omega, SPP), [NOISE] * 2
        found = fisher_information(form, theta, record, sigma)
        exponents, slopes = exponent_slopes(form, theta)
        std = propagate_std(slopes, found.covariance)
        np.testing.assert_allclose(designed.exponents["exponent"], exponents, rtol=1e-9)
        np.testing.assert_allclose(designed.exponents[f"std_real{name}"], std.real, rtol=1e-9)
        np.testing.assert_allclose(designed.exponents[f"std_imag{name}"], std.imag, rtol=1e-9)


@pytest.mark.parametrize("kind", ["steps", "multisine"])
def test_the_budget_is_kept(kind):
    found = design_input(wide(), amplitude={"a": 2.0, "b": 0.5}, length=30.0, energy=6.0,
                         kind=kind, **SETTINGS | {"n_trials": 3})  # fmt: skip
    u = found.inputs.to_numpy()
    assert list(found.inputs.columns) == ["a", "b"]
    assert found.inputs.index[-1] < 30.0 < found.inputs.index[-1] + 1.01 * PERIOD
    assert np.all(np.abs(u).max(axis=0) <= np.array([2.0, 0.5]) * (1.0 + 1e-12))
    assert np.all(u[: 4 * SPP] == 0.0)
    assert np.all(np.any(u != 0.0, axis=0))
    energy = np.sum((u / [2.0, 0.5]) ** 2) * PERIOD / SPP
    assert energy == pytest.approx(found.energy)
    assert energy <= 6.0 * (1.0 + 1e-12)
    t = found.inputs.index.to_numpy()
    np.testing.assert_allclose(wide().simulate(u, t), found.outputs, atol=1e-9)
    if kind == "steps":
        assert {len(np.unique(column)) for column in u.T} <= {2, 3}


def test_the_same_seed_gives_the_same_inputs(designed):
    again = design_input(SYSTEM, **BUDGET, **SETTINGS, X=doublet())
    pd.testing.assert_frame_equal(again.inputs, designed.inputs)
    assert again.n_evaluations == designed.n_evaluations
    for twin in (pickle.loads(pickle.dumps(designed)), copy.deepcopy(designed)):
        pd.testing.assert_frame_equal(twin.exponents, designed.exponents)


def test_a_common_factor_of_noise_or_amplitude_changes_the_deviations_alone(designed):
    louder = design_input(SYSTEM, **BUDGET, **SETTINGS | {"noise_std": [0.1, 0.1]}, X=doublet())
    pd.testing.assert_frame_equal(louder.inputs, designed.inputs)
    np.testing.assert_allclose(
        louder.exponents["std_real"], 2.0 * designed.exponents["std_real"], rtol=1e-9
    )
    np.testing.assert_allclose(louder.exponents["gain"], designed.exponents["gain"], rtol=1e-9)


@pytest.mark.slow
def test_longer_searches_are_no_worse():
    costs = []
    for n_trials in (0, 60):
        found = design_input(SYSTEM, **BUDGET, **SETTINGS | {"n_trials": n_trials}, exponents=[0])
        costs.append(np.hypot(found.exponents["std_real"][0], found.exponents["std_imag"][0]))
    assert costs[1] < costs[0]


# ---- what the record at hand lacks ---------------------------------------------------------------


@pytest.mark.slow
def test_inputs_that_never_moved_apart_are_named():
    """Both moved as one: the motion that each makes by itself is unknown."""
    structure = HarmonicStructure(F=1, G=0)
    system, X = wide(), doublet(["a", "b"])
    constant = LTPSystem(system.F, system.fourier_coefficients(0)[1], omega=system.omega,
                         state_names=["y", "v"], input_names=["a", "b"])  # fmt: skip
    found = design_input(constant, amplitude=1.0, length=BUDGET["length"], structure=structure,
                         X=X, **SETTINGS)  # fmt: skip
    assert np.all(found.phases["at_hand"] > 1.0)
    assert np.all(found.phases["designed"] < 0.2)
    unknown = "at all azimuths (its motion there is unknown)"
    assert found.lacking == f"a {unknown}; b {unknown}"


def test_phases_at_which_nothing_moved_are_named():
    """Two pulses at ψ = 0 tell B there; its harmonics at other azimuths they hardly do."""
    X = 0.0 * doublet()
    X.iloc[4 * SPP : 4 * SPP + 2] = 1.0
    X.iloc[9 * SPP : 9 * SPP + 2] = -1.0
    found = design_input(SYSTEM, **BUDGET, **SETTINGS, X=X, structure=HarmonicStructure(F=1, G=3))
    doubt = found.phases["at_hand"].loc["u"]
    assert doubt.idxmin() == 0.0
    assert doubt.max() > 5.0 * doubt.min()
    assert "0°" not in found.lacking.split(" (")[0].split("= ")[-1].split(", ")
    assert found.lacking.startswith("u at ψ = ")


def test_without_a_record_at_hand_nothing_is_compared():
    found = design_input(SYSTEM, **BUDGET, **SETTINGS | {"n_trials": 0})
    assert found.lacking == ""
    assert list(found.phases) == ["designed"]
    assert "gain" not in found.exponents


# ---- models identified -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the matched model's response")  # the structure lacks harmonics
@pytest.mark.parametrize("reading", ["period", "sample"])
def test_of_a_pipeline_the_deviations_at_hand_are_those_of_its_fit(reading):
    t = PERIOD / SPP * np.arange(60 * SPP)
    held = np.repeat(np.random.default_rng(0).choice([-1.0, 0.0, 1.0], 30), 2 * SPP)
    held[: 4 * SPP] = 0.0
    X = pd.DataFrame({"u": held}, index=t)
    clean = SYSTEM.simulate(held[:, None], t)
    y = clean + 0.02 * np.random.default_rng(1).standard_normal(clean.shape)
    structure = HarmonicStructure(F=1, G=0)
    pipe = Pipeline([
        ("harmonics", HarmonicAnalyzer(SYSTEM.omega, reading=reading, trim_span=(0.0, 4 * PERIOD))),
        ("identify", MOESPRegressor(2)),
        ("match", StructuredMatcher(structure=structure, criterion="output_error")),
    ]).fit(X, pd.DataFrame(y, t, SYSTEM.output_names))  # fmt: skip
    found = design_input(pipe, amplitude=1.0, length=60 * PERIOD, X=X, n_trials=5)
    at_hand, fitted = found.exponents, pipe["match"].eigenvalues_
    assert pipe["match"].covariance_type_ == "information"
    np.testing.assert_allclose(at_hand["exponent"], fitted["eigenvalue"], rtol=1e-6)
    for part in ("std_real", "std_imag"):
        np.testing.assert_allclose(at_hand[f"{part}_at_hand"], fitted[part], rtol=0.02)
    again = design_input(pipe["match"], amplitude=1.0, length=60 * PERIOD, n_trials=5)
    pd.testing.assert_frame_equal(again.inputs, found.inputs)


# ---- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"amplitude": 0.0}, r"amplitude=\[0.0\] must be positive.*does not move, so drop it"),
        ({"amplitude": {"v": 1.0}}, r"amplitude={'v': 1.0} must name each of \['u'\]"),
        ({"amplitude": [1.0, 2.0]}, "amplitude has 2 values; give one"),
        ({"length": 2.0}, r"length=2 s leaves no period for inputs after quiet_periods=4"),
        ({"length": 0.0}, "length must be a positive number"),
        ({"energy": 0.0}, "energy must be a positive number"),
        ({"energy": 1e-9}, r"excite nothing above the noise: they hold 1e-09 s.* known to ± "),
        ({"kind": "chirp"}, "kind='chirp'|kind must be"),
        ({"noise_std": None}, "noise of an LTPSystem is unknown; give noise_std"),
        ({"noise_std": {"y": 1.0}}, "noise_std={'y': 1.0} must name each of"),
        ({"exponents": [2]}, r"exponents=\[2\] must be indices among the 2 exponents"),
        ({"structure": "F=1"}, "structure='F=1' is not a HarmonicStructure"),
        ({"n_trials": -1}, "n_trials"),
        (
            {"X": doublet(["a", "b"])},
            r"X has the columns \['a', 'b'\], but the system has the inputs",
        ),
        (
            {"X": doublet().iloc[::2]},
            "X has 8 samples per period, but must have samples_per_period",
        ),
        ({"structure": HarmonicStructure(F=9, G=9)}, "no input tried within this budget"),
    ],
)
def test_budgets_that_excite_nothing_and_wrong_arguments_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        design_input(SYSTEM, **BUDGET | SETTINGS | {"n_trials": 0} | change)


def test_machines_without_inputs_and_of_no_model_are_refused():
    still = LTPSystem(SYSTEM.F, np.zeros((2, 0)), omega=SYSTEM.omega)
    with pytest.raises(ValueError, match="the model has no inputs, so nothing can be designed"):
        design_input(still, **BUDGET, **SETTINGS)
    with pytest.raises(ValueError, match="is neither a StructuredMatcher, nor a Pipeline"):
        design_input(MOESPRegressor(), **BUDGET, **SETTINGS)


def test_unstable_machines_ask_for_shorter_records():
    with pytest.raises(ValueError, match=r"the model is unstable \(largest multiplier .* shorter"):
        design_input(mathieu(damping=-80.0), **BUDGET, **SETTINGS | {"n_trials": 0})
