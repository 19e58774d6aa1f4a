"""MatrixStructure against models of every shape, continuous and discrete."""

import numpy as np
import pandas as pd
import pytest
from scipy.signal import cont2discrete
from sklearn.model_selection import GridSearchCV
from sklearn.pipeline import Pipeline

from sklearn_hd import MatrixStructure, MOESPRegressor, SpuriousModeReducer, StructuredMatcher
from sklearn_hd.algorithms.matching.matching import match_structure

NAN = np.nan
SAMPLE_TIME = 0.05
SHAPES = {
    "tall": MatrixStructure(
        [["-a", "w"], ["-w", "-a - b"]],
        [[1], ["g"]],
        C=[[1, 0], [0, 1], ["c1", "c1 + c2"]],
        D=[[0], [0], [NAN]],
    ),
    "wide": MatrixStructure(
        [["-a", "w"], ["-w", "-b"]],
        [[1, "g1", 0], [0, "g2", "g1 - g2"]],
        C=[[1, 0.5]],
        D=[[0, NAN, "1 - g1"]],
    ),
    "fewer states than outputs": MatrixStructure(
        [["-a"]], [[1, "b"]], C=[["c1"], [1], ["c2"]], D=[[NAN, 0], ["d", "-d"], [0, NAN]]
    ),
    "fewer outputs than states": MatrixStructure(
        [[0, 1, 0], [0, 0, 1], ["-a0", "-a1", "-a2"]],
        [[0], [0], [1]],
        C=[["b0", "b1", 0]],
        D=[["1.5 - 0.5*d"]],
    ),
    "free feedthrough": MatrixStructure(
        [["-a", 1], [0, "-b"]], np.eye(2), D=[[NAN, NAN], [NAN, NAN]]
    ),
    "static gain": MatrixStructure(
        np.zeros((0, 0)), np.zeros((0, 2)), C=np.zeros((1, 0)), D=[[NAN, "2 - d"]]
    ),
}


def stable_parameters(structure, rng):
    """Random parameters of a stable member."""
    while True:
        theta = rng.uniform(0.5, 3.0, structure.n_parameters)
        poles = np.linalg.eigvals(structure.matrices(theta)[0])
        if poles.real.max(initial=-1.0) < -0.05:
            return theta


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("case", SHAPES)
def test_a_member_is_found_in_any_coordinates(case, seed):
    structure, rng = SHAPES[case], np.random.default_rng(seed)
    theta = stable_parameters(structure, rng)
    A, B, C, D = structure.matrices(theta)
    T = rng.standard_normal(A.shape) + 2.0 * np.eye(len(A))
    turned = T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), D
    start = theta * rng.uniform(0.7, 1.3, len(theta))
    result = match_structure(*turned, structure.affine, theta0=start)
    assert result.exact
    np.testing.assert_allclose(result.theta, theta, rtol=1e-9)


def test_fixed_parameters_leave_the_others_where_they_are():
    structure, rng = SHAPES["wide"], np.random.default_rng(3)
    theta = stable_parameters(structure, rng)
    values = dict(zip(structure.parameter_names, theta, strict=True))
    fixed = structure.fix({name: values[name] for name in ("w", "g1")})
    result = match_structure(*structure.matrices(theta), fixed.affine)
    assert result.exact
    np.testing.assert_allclose(result.theta, [values[name] for name in fixed.parameter_names])


# ---- in a pipeline -------------------------------------------------------------------------------

DYNAMICS = {"a": 0.8, "w": 3.0, "b": 0.6, "g": 2.0, "c1": 1.5, "c2": -0.7, "D[2,0]": 0.4}


@pytest.fixture(scope="module")
def data():
    """A random record of the tall structure, its inputs held from sample to sample."""
    structure = SHAPES["tall"]
    continuous = structure.matrices([DYNAMICS[name] for name in structure.parameter_names])
    A, B, C, D, _ = cont2discrete(continuous, SAMPLE_TIME)
    u = np.random.default_rng(0).standard_normal((600, 1))
    x = np.zeros((601, 2))
    for k in range(600):
        x[k + 1] = A @ x[k] + B @ u[k]
    index = pd.Index(SAMPLE_TIME * np.arange(600), name="time")
    y = x[:-1] @ C.T + u @ D.T
    return pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index, ["y1", "y2", "sum"])


def pipeline(upstream, structure):
    steps = [("identify", MOESPRegressor(order=2, block_rows=6, feedthrough=True))]
    if upstream == "continuous":
        steps.append(("reduce", SpuriousModeReducer()))
    return Pipeline([*steps, ("match", StructuredMatcher(structure=structure))])


@pytest.mark.parametrize("upstream", ["discrete", "continuous"])
def test_models_of_either_time_are_matched(upstream, data):
    u, y = data
    pipe = pipeline(upstream, SHAPES["tall"]).fit(u, y)
    assert (pipe[-2].system_.dt == 0) == (upstream == "continuous")
    match = pipe["match"]
    assert match.theta_.to_dict() == pytest.approx(DYNAMICS, rel=1e-8)
    assert match.system_.dt == 0
    assert pipe.score(u, y) > 1 - 1e-9


@pytest.mark.slow
def test_structures_with_other_values_fixed_are_values_of_a_grid(data):
    u, y = data
    free = SHAPES["tall"]
    structures = [free.fix({"w": value}) for value in (2.0, 3.0, 4.0)]
    halves = np.arange(len(u)) < 300
    search = GridSearchCV(
        pipeline("discrete", free),
        {"match__structure": structures},
        cv=[(np.flatnonzero(halves), np.flatnonzero(~halves))],
        error_score="raise",
    ).fit(u, y)
    assert search.best_params_["match__structure"].fixed == {"w": 3.0}
    assert search.best_score_ > 1 - 1e-9
    assert search.best_estimator_["match"].structure == structures[1]
    assert "w" not in search.best_estimator_["match"].theta_


@pytest.mark.parametrize("criterion", ["hinf", "output_error"])
@pytest.mark.slow
def test_maximum_likelihood_takes_affine_entries_too(criterion, data):
    u, y = data
    noisy = y + 1e-3 * np.random.default_rng(1).standard_normal(y.shape)
    structure = SHAPES["tall"].fix({"D[2,0]": 0.4})
    match = StructuredMatcher(
        MOESPRegressor(order=2, block_rows=6, feedthrough=True),
        structure=structure,
        criterion=criterion,
    ).fit(u, noisy)
    expected = {name: value for name, value in DYNAMICS.items() if name != "D[2,0]"}
    assert match.theta_.to_dict() == pytest.approx(expected, rel=1e-2)
    if criterion == "output_error":
        off = match.theta_ - pd.Series(expected)
        assert (np.abs(off) < 5 * match.theta_std_).all()
