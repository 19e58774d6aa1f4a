"""Against the world: figures that others published or computed, each with its source."""

import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from periodic_cases import vinograd
from scipy import linalg, signal
from scipy.optimize import linear_sum_assignment
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.datasets import (
    load_cd_player_arm,
    load_power_plant,
    load_robot_arm,
    load_slicot_example,
    load_wind_turbine,
)
from sklearn_hd.systems import LTPSystem, multiblade_model, rotor_system

sys.path.insert(0, str(Path(__file__).parents[1] / "docs" / "benchmarks"))
import wind_turbine_study as study

REFERENCE = json.loads((Path(__file__).parent / "reference" / "daisy.json").read_text())
LOADERS = {
    "robot_arm": load_robot_arm,
    "powerplant": load_power_plant,
    "CD_player_arm": load_cd_player_arm,
}
DIGITS = 0.00005 * (1 + 1e-9)  # half of the last of four printed digits
SLICOT_A = np.array(  # IB01BD.res
    [
        [0.8924, 0.3887, 0.1285, 0.1716],
        [-0.0837, 0.6186, -0.6273, -0.4582],
        [0.0052, 0.1307, 0.6685, -0.6755],
        [0.0055, 0.0734, -0.2148, 0.4788],
    ]
)


def identify(data, block_rows, order, *, detrend=False, scale=False):
    """MOESP on plain data, unscaled and with feedthrough as SLICOT has it."""
    u, y = data.inputs.to_numpy(), data.outputs.to_numpy()
    if detrend:
        u, y = signal.detrend(u, axis=0), signal.detrend(y, axis=0)
    model = MOESPRegressor(order=order, block_rows=block_rows, feedthrough=True, scale=scale)
    return model.fit(u, y), u, y


def variance_accounted_for(model, u, y):
    left = y - model.predict(u, x0=model.x0_[0])
    return 100.0 * (1.0 - left.var(axis=0) / y.var(axis=0))


def farthest(found, wanted, omega=None):
    """Largest distance of two sets of eigenvalues, modulo jω where ω is given."""
    gap = np.asarray(found)[:, None] - np.asarray(wanted)
    if omega is not None:
        gap = gap - 1j * omega * np.round(gap.imag / omega)
    rows, columns = linear_sum_assignment(np.abs(gap))
    return np.abs(gap[rows, columns]).max()


# ---- what is shipped -----------------------------------------------------------------------------


@pytest.mark.parametrize("load", [*LOADERS.values(), load_slicot_example])
def test_records_come_with_their_source_and_licence(load):
    data = load()
    assert "BSD 3-Clause" in data.licence or "Redistribution and use" in data.licence
    assert "SLICOT" in data.source
    assert str(len(data.inputs)) in data.DESCR
    assert data.inputs.index.equals(data.outputs.index)
    assert np.all(np.isfinite(data.inputs.join(data.outputs)))
    assert load.__name__.removeprefix("load_") in data.filename


def test_only_the_power_plant_has_a_sample_time():
    assert [load().sample_time for load in LOADERS.values()] == [None, 1228.8, None]
    index = load_power_plant().inputs.index
    np.testing.assert_allclose(np.diff(index), 1228.8)
    assert isinstance(load_robot_arm().inputs.index, pd.RangeIndex)


@pytest.mark.parametrize("wind_speed", [5, "3", None])
def test_two_turbines_are_shipped(wind_speed):
    assert "Apache License" in load_wind_turbine(8).licence
    with pytest.raises(ValueError, match="is not shipped; use 3 or 8"):
        load_wind_turbine(wind_speed)


# ---- subspace identification ---------------------------------------------------------------------


def test_slicot_example_has_the_singular_values_printed():
    """SLICOT Library, example of IB01AD (15 block rows): IB01AD.res, order and singular values."""
    printed = [69.8841, 14.9963, 3.6675, 1.9677, 0.3000, 0.2078, 0.1651, 0.1373]
    printed += [0.1133, 0.1059, 0.0856, 0.0784, 0.0733, 0.0678, 0.0571]
    model, _, _ = identify(load_slicot_example(), 15, "auto")
    assert model.order_ == 4
    np.testing.assert_allclose(model.singular_values_, printed, rtol=0, atol=DIGITS)


@pytest.mark.parametrize("scale", [False, True])
def test_slicot_example_has_the_eigenvalues_published(scale):
    """SLICOT Library, examples of IB01BD and IB01CD (15 block rows, order 4): IB01BD.res prints
    A to four decimals; its eigenvalues are 0.4758 ± 0.1999j, 0.7456, 0.9610. One input and one
    output: their units (scale) change nothing."""
    model, u, y = identify(load_slicot_example(), 15, 4, scale=scale)
    published = [0.4758 + 0.1999j, 0.4758 - 0.1999j, 0.7456, 0.9610]
    assert farthest(model.eigenvalues_, published) < 1e-4
    eigenvalues, left, right = linalg.eig(SLICOT_A, left=True)
    moved = np.abs(left.conj()).sum(axis=0) * np.abs(right).sum(axis=0)  # by a unit in any entry
    moved /= np.abs(np.sum(left.conj() * right, axis=0))
    gap = np.abs(eigenvalues[:, None] - model.eigenvalues_).min(axis=1)
    assert np.all(gap < 1.01 * DIGITS * moved)  # to first order
    assert variance_accounted_for(model, u, y).min() > 98.8


def moved_by_rounding(function, *printed):
    """How far the unprinted digits of some matrices may move a function of them."""
    here, total = function(*printed), 0.0
    for which, matrix in enumerate(printed):
        for place in np.ndindex(matrix.shape):
            there = matrix.copy()
            there[place] += DIGITS
            total = total + np.abs(function(*printed[:which], there, *printed[which + 1 :]) - here)
    return total


def test_slicot_example_has_the_kalman_gain_published():
    """SLICOT Library, IB01BD.res: A, C and the Kalman gain K, to four decimals. In no
    coordinates: responses C Aʲ K to the innovations, within what the digits not printed allow."""
    C = np.array([[-0.4442, 0.6663, 0.3961, 0.4102]])
    K = np.array([[-1.9513], [-0.1867], [0.6348], [-0.3486]])
    data = load_slicot_example()
    model = MOESPRegressor(
        4, block_rows=15, feedthrough=True, scale=False, disturbance_model=True
    ).fit(data.inputs, data.outputs)

    def responses(A, C, K):
        return np.array([(C @ np.linalg.matrix_power(A, j) @ K).item() for j in range(20)])

    printed = responses(SLICOT_A, C, K)
    gap = np.abs(responses(model.model_.A, model.model_.C, model.kalman_gain_) - printed)
    allowed = moved_by_rounding(responses, SLICOT_A, C, K)
    assert np.all(gap < 1.01 * allowed)
    assert np.all(allowed < 5e-3)
    assert gap[:8].max() < 1e-4


@pytest.mark.parametrize("name", REFERENCE)
def test_daisy_has_the_eigenvalues_of_three_implementations(name):
    """DaISy (De Moor, KU Leuven), robot arm, power plant and CD player arm: PO-MOESP by SLICOT's
    IB01 routines, singular values, eigenvalues of A and variance accounted for."""
    case = REFERENCE[name]
    wanted = case["results"]["MOESP"]
    data = LOADERS[name]()
    assert data.inputs.shape == (case["samples"], case["inputs"])
    model, u, y = identify(data, case["nobr"], case["n"], detrend=case["linear_detrend"])
    eigenvalues = [complex(*pair) for pair in wanted["eig"]]
    assert farthest(model.eigenvalues_, eigenvalues) < 1e-9  # asked for: 1e-5
    values = wanted["sv"]
    np.testing.assert_allclose(model.singular_values_[: len(values)], values, rtol=1e-9)
    accounted = variance_accounted_for(model, u, y)
    np.testing.assert_allclose(accounted, wanted["VAF_percent"], atol=1e-3)  # half a point asked


@pytest.mark.parametrize(
    ("name", "worst", "eigenvalues"),
    [("powerplant", 99.3, 0.05), ("CD_player_arm", 94.0, 0.3)],
)
def test_units_decide_where_outputs_are_several(name, worst, eigenvalues):
    """The same records (DaISy), each signal divided by its root mean square (scale=True, the
    default): another weighting of the outputs, hence other eigenvalues, and as good a fit."""
    case = REFERENCE[name]
    wanted = [complex(*pair) for pair in case["results"]["MOESP"]["eig"]]
    model, u, y = identify(
        LOADERS[name](), case["nobr"], case["n"], detrend=case["linear_detrend"], scale=True
    )
    assert farthest(model.eigenvalues_, wanted) > eigenvalues
    accounted = variance_accounted_for(model, u, y)
    assert accounted.min() > worst
    assert accounted.mean() > np.mean(case["results"]["MOESP"]["VAF_percent"]) - 0.5


# ---- 5 MW wind turbine ---------------------------------------------------------------------------

PRINTED = {  # frequency in Hz, damping ratio in per cent, and half of the last digits
    8: ([0.588, 0.722, 0.842, 0.937], [63.106, 52.529, 44.010, 1.634], 5e-4, 5e-4),
    3: ([0.31403, 0.33141, 0.62634], [0.4386, 6.0344, 2.4812], 5e-6, 5e-5),
}


@pytest.mark.parametrize("wind_speed", PRINTED)
def test_turbine_has_the_frequencies_and_damping_printed(wind_speed):
    """OpenFAST's NREL 5 MW turbine (openfast_toolbox: Main.*.lin at 8 m/s, ws03.0.*.lin at
    3 m/s), multi-blade coordinates (Bir 2008), averaged over the azimuths."""
    f_printed, zeta_printed, half_f, half_zeta = PRINTED[wind_speed]
    omega, zeta, poles = multiblade_model(load_wind_turbine(wind_speed).linearizations).damp()
    order = np.argsort(np.where(poles.imag > 0, omega, np.inf))[: len(f_printed)]
    np.testing.assert_allclose(omega[order] / (2 * np.pi), f_printed, rtol=0, atol=half_f)
    np.testing.assert_allclose(100 * zeta[order], zeta_printed, rtol=0, atol=half_zeta)


@pytest.mark.parametrize(
    "wind_speed", [8, pytest.param(3, marks=pytest.mark.slow)], ids=["8 m/s", "3 m/s"]
)
def test_floquet_exponents_of_the_turbine_are_the_multiblade_eigenvalues(wind_speed):
    """Bir (2008): for equal blades the coordinates that do not turn are a Lyapunov-Floquet
    transformation; exponents up to jkΩ."""
    data = load_wind_turbine(wind_speed)
    poles = multiblade_model(data.linearizations).poles()
    exponents = rotor_system(data.linearizations).floquet_exponents()
    assert farthest(exponents, poles, data.omega) < 1e-10


@pytest.mark.slow
def test_multipliers_of_the_turbine_are_those_of_the_multiblade_model():
    """Bir (2008), as above, for the 30 states at 3 m/s."""
    data = load_wind_turbine(3)
    system = rotor_system(data.linearizations)
    multipliers = np.linalg.eigvals(system.monodromy())
    poles = multiblade_model(data.linearizations).poles()
    assert farthest(multipliers, np.exp(poles * system.period)) < 1e-9


@pytest.mark.parametrize("n_harmonics", [1, 2])
@pytest.mark.parametrize("wind_speed", PRINTED)
def test_harmonic_decomposition_of_the_turbine_holds_the_multiblade_model(wind_speed, n_harmonics):
    """With N = 1 already: the blades' mean, cos and sin are an invariant subspace of it."""
    data = load_wind_turbine(wind_speed)
    poles = multiblade_model(data.linearizations).poles()
    hd = rotor_system(data.linearizations).harmonic_decomposition(n_harmonics)
    assert np.abs(np.linalg.eigvals(hd.A)[:, None] - poles).min(axis=0).max() < 1e-8


@pytest.mark.parametrize(("wind_speed", "same"), [(3, (0, 1)), (8, (1, 2))])
def test_equal_blades_look_alike_a_third_of_a_turn_later(wind_speed, same):
    """Two of the three azimuths are 120° apart: in multi-blade coordinates their matrices are
    one but for OpenFAST's single precision and differences; the third is 30 times farther."""
    files = load_wind_turbine(wind_speed).linearizations
    A = [multiblade_model([file]).A for file in files]
    (other,) = {0, 1, 2} - set(same)
    gap = np.linalg.norm(A[same[0]] - A[same[1]]) / np.linalg.norm(A[0])
    assert gap < 1e-4
    assert np.linalg.norm(A[other] - A[same[0]]) / np.linalg.norm(A[0]) > 20 * gap


def lightly_damped(A):
    poles = np.linalg.eigvals(A)
    return poles[(poles.imag > 0) & (-poles.real < 0.1 * np.abs(poles))]


def rest_moves_exponents(wind_speed, factor):
    """By how much what averaging leaves out, times a factor, moves lightly damped exponents."""
    data = load_wind_turbine(wind_speed)
    mean = multiblade_model(data.linearizations).A
    rest = np.array([multiblade_model([file]).A for file in data.linearizations]) - mean
    turned = 3 * np.array([file.azimuth for file in data.linearizations])
    functions = np.column_stack([np.cos(turned), np.sin(turned)])
    F = np.zeros((7, *mean.shape))
    F[0] = mean
    F[5:] = factor * np.tensordot(np.linalg.pinv(functions), rest, axes=(1, 0))
    system = LTPSystem(F, np.zeros((len(mean), 0)), omega=data.omega)
    exponents = np.log(np.linalg.eigvals(system.monodromy()).astype(complex)) / system.period
    light = lightly_damped(mean)
    gap = exponents[:, None] - light
    return np.abs(gap - 1j * data.omega * np.round(gap.imag / data.omega)).min(axis=0)


@pytest.mark.parametrize(
    "wind_speed", [8, pytest.param(3, marks=pytest.mark.slow)], ids=["8 m/s", "3 m/s"]
)
def test_what_averaging_leaves_out_is_of_second_order(wind_speed):
    """The rest of the multi-blade matrices, three a turn, moves Floquet exponents by its square:
    1e-5 of their size and less, twice the rest four times as much."""
    once, twice = (rest_moves_exponents(wind_speed, factor) for factor in (1, 2))
    light = lightly_damped(multiblade_model(load_wind_turbine(wind_speed).linearizations).A)
    assert np.max(once / np.abs(light)) < 1e-5
    np.testing.assert_allclose(twice / once, 4.0, rtol=0.02)


@pytest.mark.slow
def test_three_azimuths_do_not_make_a_series_of_blade_matrices():
    """F(ψ) of blades on a tower has two harmonics, five coefficients. One harmonic through
    three azimuths of the turbine at 3 m/s invents an instability, of +0.99 1/s: 5000 times a
    turn, where the slow drift in yaw grows by 1 %."""
    files = load_wind_turbine(3).linearizations
    system = rotor_system(files, coordinates="rotating", n_harmonics=1)
    assert np.abs(np.linalg.eigvals(system.monodromy())).max() > 4000
    poles = multiblade_model(files).poles()
    assert np.exp(poles.real * system.period).max() < 1.02
    for settings in ({"n_harmonics": 1}, {"coordinates": "rotating", "n_harmonics": 2}):
        with pytest.raises(ValueError, match="azimuths do not determine the"):
            rotor_system(files, **settings)


# ---- the turbine identified ----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*exponents are in doubt")
def test_modes_of_the_turbine_come_back_from_a_noisy_record():
    """The 5 MW turbine's periodic model (OpenFAST), 300 turns, one percent of noise, read turn
    by turn: within what 20 other records (docs/world.md) had at worst, or half as much again."""
    found = study.study([7]).reset_index("seed", drop=True)
    assert len(found) == 5
    np.testing.assert_allclose(found["f found"], found["f"], rtol=1.5e-3)
    np.testing.assert_allclose(found["zeta found"], found["zeta"], rtol=0, atol=0.12)


@pytest.mark.slow
def test_without_noise_modes_of_the_turbine_come_back_closer():
    """But not exactly: ten states stand for thirty, of which the others last less than a turn."""
    found = study.study([7], noise=0.0)
    np.testing.assert_allclose(found["f found"], found["f"], rtol=3e-4)
    np.testing.assert_allclose(found["zeta found"], found["zeta"], rtol=0, atol=0.02)


# ---- a growing and a dying mode ------------------------------------------------------------------


def short_records(system, omega, *, samples, n_periods, n_records, seed):
    """Inputs new in every period; each record starts at rest, before its growth drowns the rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples * n_periods) * 2 * np.pi / omega / samples
    u = rng.choice([-1.0, 1.0], (n_records, n_periods, 1)).repeat(samples, axis=1)
    index = pd.MultiIndex.from_product([range(n_records), t], names=["record", "time"])
    y = system.simulate(u, t).reshape(len(index), -1)
    inputs = pd.DataFrame(u.reshape(len(index), 1), index, list(system.input_names))
    return inputs, pd.DataFrame(y, index, list(system.output_names))


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.InstabilityWarning")
@pytest.mark.slow
def test_vinograds_exponents_come_back_from_short_records():
    """Vinograd (1952): exponents +2 and −13. Over a period of 2π/12 s one mode grows 2.8 times,
    the other dies to a thousandth: eight periods keep six digits of it, and twenty records do."""
    u, y = short_records(vinograd(), 12.0, samples=32, n_periods=8, n_records=20, seed=3)
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(12.0, reading="period")),
            ("identify", MOESPRegressor()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    ).fit(u, y)
    assert pipe["identify"].order_ == 2
    exponents = pipe["match"].ltp_.floquet_exponents()
    np.testing.assert_allclose(exponents.real, [2.0, -13.0], rtol=1e-8)
