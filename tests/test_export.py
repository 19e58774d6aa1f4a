"""Models out of Python and back: the same to the last bit, and what files refuse."""

import json

import control
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from law_cases import SEEDS, UP_TO_THREE, UP_TO_TWO, examples
from periodic_cases import mathieu, meissner, record
from scipy.io import loadmat
from sklearn.exceptions import ConvergenceWarning, NotFittedError
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.systems import LTPSystem, export_model, load_model

NAMES = {"input_names": ["δ_e (rad), the very long name of an elevator's deflection in flight"]}


@pytest.fixture
def system():
    return LTPSystem(
        np.array([[[0.1, 1.0], [-2.0, -1 / 3]], [[0.0, 0.0], [1e-300, 0.2]], np.zeros((2, 2))]),
        [[0.0], [5e22]], [[1.0, -0.0]], omega=2.1, state_names=["q", "q_dot"], **NAMES,
    )  # fmt: skip


@pytest.fixture(scope="module")
def matched():
    """A record with a trim and noise, and the pipeline that is fitted to it."""
    machine = mathieu()
    u, y = record(machine, n_periods=60, samples=16, noise=0.01, seed=4)
    wave = np.cos(machine.omega * y.index.to_numpy())
    y, u = y + 3.0 * wave[:, None], u + 0.5
    pipe = Pipeline([
        ("harmonics", HarmonicAnalyzer(
            machine.omega, output_harmonics=1, reading="period", trim_span=(0.0, machine.period))),
        ("identify", MOESPRegressor(2)),
        ("match", StructuredMatcher(structure=HarmonicStructure(F=1, G=0),
                                    criterion="output_error")),
    ]).fit(u, y)  # fmt: skip
    return u, y, pipe


@examples(10)
@given(SEEDS, UP_TO_THREE, UP_TO_TWO, UP_TO_TWO, st.integers(0, 2))
def test_json_returns_every_bit_of_a_periodic_system(tmp_path_factory, seed, n, m, K, more):
    rng = np.random.default_rng(seed)
    shapes = ((n, n), (n, m), (more, n), (more, m))
    drawn = [
        rng.standard_normal((2 * K + 1, *shape)) * 10.0 ** rng.integers(-200, 4) for shape in shapes
    ]
    system = LTPSystem(*drawn, omega=float(rng.uniform(0.1, 500.0)))
    path = tmp_path_factory.mktemp("models") / "model.json"
    system.export(path, n_phases=3)
    back = load_model(path)
    for name, true in zip("FGPQ", drawn, strict=True):
        assert getattr(back, name).coefficients.tobytes() == true.tobytes()
    assert back.omega == system.omega
    assert back._names() == system._names()


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_json_returns_every_bit_of_a_time_invariant_model(rng, tmp_path, dt):
    matrices = [rng.standard_normal(shape) for shape in ((3, 3), (3, 2), (1, 3), (1, 2))]
    names = {"states": ["a", "b", "c"], "inputs": ["u", "δ"], "outputs": ["y"]}
    model = control.StateSpace(*matrices, dt, **names)
    export_model(model, tmp_path / "m.JSON")
    back = load_model(tmp_path / "m.JSON")
    for name in "ABCD":
        assert getattr(back, name).tobytes() == getattr(model, name).tobytes()
    assert back.dt == dt
    assert (back.state_labels, back.input_labels) == (names["states"], names["inputs"])


def test_matlab_reads_names_series_and_tables(system, tmp_path):
    system.export(str(tmp_path / "model.mat"), n_phases=12)
    found = loadmat(tmp_path / "model.mat")
    np.testing.assert_array_equal(np.moveaxis(found["F"], -1, 0), system.F.coefficients)
    np.testing.assert_array_equal(
        np.moveaxis(found["F_psi"], -1, 0), system.F(found["psi"].ravel())
    )
    assert [str(cell[0]) for cell in found["input_names"].ravel()] == NAMES["input_names"]
    assert found["omega"].item() == 2.1
    assert found["schema"].item() == 1
    assert max(len(name) for name in found) <= 31  # of MATLAB's names, in all versions


def test_matlab_simulates_by_the_table(system, tmp_path):
    system.export(tmp_path / "model.mat", n_phases=12)
    found, u = loadmat(tmp_path / "model.mat"), np.random.default_rng(0).standard_normal(40)
    x, y = np.zeros((2, 1)), []
    for k in range(40):  # the snippet of the manual
        i = k % 12
        y.append(found["P_psi"][..., i] @ x + found["Q_psi"][..., i] * u[k])
        x = found["Phi"][..., i] @ x + found["Gamma"][..., i] * u[k]
    t = np.arange(40) * system.period / 12
    np.testing.assert_allclose(np.ravel(y), system.simulate(u, t)[:, 0], rtol=1e-9)


@pytest.mark.parametrize("suffix", [".json", ".mat"])
def test_a_fitted_step_says_how_sure_it_is_and_what_surrounds_it(matched, tmp_path, suffix):
    _, y, pipe = matched
    step, path = pipe["match"], tmp_path / f"m{suffix}"
    step.export(path)
    found = loadmat(path) if suffix == ".mat" else json.loads(path.read_text())
    std, table = step.eigenvalues_["std_real"].to_numpy(), step.eigenvalues_["eigenvalue"]
    if suffix == ".mat":
        told, exponents = found["exponents_std"].ravel().real, found["exponents"].ravel()
    else:
        told = np.array(found["exponents_std"])[:, 0]
        exponents = np.array(found["exponents"]) @ [1.0, 1j]
    np.testing.assert_array_equal(told, std)
    np.testing.assert_array_equal(exponents, table)
    np.testing.assert_array_equal(found["output_trim"], step.basis_.output_trim)
    np.testing.assert_array_equal(found["A"], step.system_.A)
    names = [str(np.ravel(name)[0]) for name in np.ravel(found["trim_output_names"])]
    assert names == list(y.columns)


def test_a_fitted_step_comes_back_and_predicts_alike(matched, tmp_path):
    u, _, pipe = matched
    pipe["match"].export(tmp_path / "m.json")
    back, found = load_model(tmp_path / "m.json"), json.loads((tmp_path / "m.json").read_text())
    turn = np.arange(len(u)) % len(found["trim_psi"])
    moved = u.to_numpy() - np.array(found["input_trim"])[turn]
    outputs = back.simulate(moved, u.index) + np.array(found["output_trim"])[turn]
    np.testing.assert_allclose(outputs, pipe.predict(u), atol=1e-9)


def test_steps_before_it_are_time_invariant(matched, tmp_path):
    pipe = matched[2]
    pipe["identify"].export(tmp_path / "m.json")
    back, system = load_model(tmp_path / "m.json"), pipe["identify"].system_
    assert back.dt == system.dt
    np.testing.assert_array_equal(back.A, system.A)
    assert back.output_labels == system.output_labels


def test_models_of_samples_have_their_loads(tmp_path):
    machine = mathieu()
    u, y = record(machine, n_periods=60, samples=16, noise=0.01, n_changes=40)
    y = y + np.outer(np.cos(machine.omega * y.index.to_numpy()), [2.0, 0.0])
    pipe = Pipeline([
        ("harmonics", HarmonicAnalyzer(machine.omega, output_harmonics=1, reading="sample")),
        ("identify", MOESPRegressor(2)),
    ]).fit(u, y)  # fmt: skip
    pipe["identify"].export(tmp_path / "m.json")
    found = json.loads((tmp_path / "m.json").read_text())
    loads = np.array(found["forced_response"])
    np.testing.assert_allclose(loads[:3], pipe["identify"].loads_.iloc[:3], atol=1e-9)
    assert abs(loads[1, 0] - 2.0) < 0.05
    assert load_model(tmp_path / "m.json").n_states == 2


def test_functions_with_kinks_say_what_their_series_leaves(tmp_path):
    with pytest.warns(
        ConvergenceWarning, match=r"F\(psi\) has kinks or jumps, so its Fourier series"
    ):
        meissner().export(tmp_path / "m.mat")


def test_smooth_functions_are_written_as_their_series(tmp_path):
    system = LTPSystem(lambda psi: np.exp(np.sin(psi))[:, None, None] - 3.0, [[1.0]], omega=1.0)
    system.export(tmp_path / "m.json")
    psi = np.linspace(0.0, 6.0, 50)
    np.testing.assert_allclose(load_model(tmp_path / "m.json").F(psi), system.F(psi), atol=1e-8)


def test_eigenvalues_that_are_no_finite_exponents_are_null(tmp_path):
    export_model(control.StateSpace([[0.0]], [[1.0]], [[1.0]], [[0.0]], 0.1), tmp_path / "m.json")
    assert json.loads((tmp_path / "m.json").read_text())["exponents"] == [[None, 0.0]]


@pytest.mark.parametrize(
    ("model", "name", "message"),
    [
        ("system", "m.txt", "ends in '.txt'; give a name that ends in .json, or in .mat"),
        ("system", "m", "ends in ''"),
        (control.StateSpace([[0.5]], [[1.0]], [[1.0]], [[np.inf]]), "m.json", "D holds NaN"),
        (control.StateSpace([[0.5]], [[1.0]], [[1.0]], [[np.nan]]), "m.mat", "D holds NaN"),
        (control.StateSpace([[0.5]], [[1.0]], [[1.0]], 0.0, True), "m.mat", "not a sample time"),
        (1.0, "m.json", "model=1.0 is not a model; give LTPSystem or control.StateSpace"),
    ],
)
def test_export_refuses(system, tmp_path, model, name, message):
    with pytest.raises(ValueError, match=message):
        export_model(system if isinstance(model, str) else model, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_export_refuses_before_fit_and_where_there_is_no_folder(system, tmp_path):
    with pytest.raises(NotFittedError):
        MOESPRegressor().export(tmp_path / "m.json")
    for name in ("m.json", "m.mat"):
        with pytest.raises(ValueError, match=r"the folder .*nowhere' does not exist; make it"):
            system.export(tmp_path / "nowhere" / name)
    with pytest.raises(ValueError, match="n_phases must be a whole number of at least 1"):
        system.export(tmp_path / "m.json", n_phases=0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 2}, "has schema 2, but this version of sklearn_hd reads 1"),
        ({"format": "x"}, "not a model file: its format is not 'sklearn_hd model'"),
        ({"kind": "x"}, "kind 'x'; 'ltp' and 'lti' are known"),
        ({"F": None}, "F in .* is not an array of real numbers"),
        ({"F": [[[1.0]]]}, r"F in .* has shape \(1, 1, 1\); it must have rows of 2 by 2"),
        ({"G": float("nan")}, "holds NaN, which is not a JSON number"),
        ({"state_names": "q"}, "state_names in .* is not a list of names"),
        ({"omega": "x"}, "omega must be a positive number"),
    ],
)
def test_loading_refuses(system, tmp_path, change, message):
    path = tmp_path / "m.json"
    system.export(path)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ValueError, match=message):
        load_model(path)


def test_loading_refuses_what_is_no_model(system, tmp_path):
    path = tmp_path / "m.json"
    system.export(path)
    contents = json.loads(path.read_text())
    del contents["G"]
    path.write_text(json.dumps(contents))
    with pytest.raises(ValueError, match="has no 'G'; export the model again"):
        load_model(path)
    for text in (path.read_text()[:-5], "\x00"):
        path.write_text(text)
        with pytest.raises(ValueError, match="is not JSON"):
            load_model(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="is not JSON"):
        load_model(path)
    with pytest.raises(ValueError, match=r"is for MATLAB; export to \.json"):
        load_model(tmp_path / "m.mat")


def test_a_plain_model_has_no_omega(rng, tmp_path):
    u = pd.DataFrame({"u": rng.standard_normal(200)}, index=pd.Index(0.1 * np.arange(200)))
    y = pd.DataFrame({"y": np.convolve(u["u"], 0.5 ** np.arange(8))[:200]}, index=u.index)
    MOESPRegressor(1).fit(u, y).export(tmp_path / "m.json")
    assert "omega" not in json.loads((tmp_path / "m.json").read_text())


def test_paths_that_are_none(tmp_path):
    system = mathieu(2.0, 0.5)
    for path in (None, 5):
        for ask in (system.export, load_model):
            with pytest.raises(TypeError, match=f"path={path} is no path; give the name of a file"):
                ask(path)
    with pytest.raises(ValueError, match="is a folder; give the name of a file"):
        load_model(tmp_path)
