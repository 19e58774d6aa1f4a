"""``criterion="prediction_error"`` and ``"output_error"`` of plain records, all entries free."""

import numpy as np
import pandas as pd
import pytest
from innovation_cases import InnovationSystem
from sklearn.pipeline import Pipeline

from sklearn_hd import MOESPRegressor, StructuredMatcher
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.free_form import OutputNormal, free_form
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.datasets import load_power_plant, load_slicot_example
from sklearn_hd.exceptions import IdentifiabilityWarning


def fitted(order, u, y, criterion="prediction_error", *, feedthrough=False, n_starts=0):
    pipe = Pipeline(
        [
            ("identify", MOESPRegressor(order, feedthrough=feedthrough)),
            ("match", StructuredMatcher(criterion=criterion, n_starts=n_starts)),
        ]
    )
    return pipe.fit(u, y)


def system():
    """Three states, two outputs, innovations that go together."""
    A = np.array([[0.8, 0.4, 0.0], [-0.4, 0.8, 0.2], [0.0, 0.0, 0.6]])
    B, C = np.array([[1.0], [0.5], [0.8]]), np.array([[1.0, 0.0, 0.5], [0.3, 1.0, -0.4]])
    K = np.array([[0.3, 0.1], [-0.1, 0.3], [0.1, 0.0]])
    E = np.array([[0.09, 0.06], [0.06, 0.08]])
    return InnovationSystem(A, B, C, K, E)


def loss(model, u, y, *, predicts):
    """½ log det of what predictions leave (or Σ log of what simulations do), by recursion."""
    u, y = u.to_numpy(), y.to_numpy()
    K = model.kalman_gain if predicts else np.zeros((len(model.A), y.shape[1]))
    A, B = model.A - K @ model.C, model.B - K @ model.D
    seen, forced = np.zeros((len(y), y.shape[1], len(A))), np.zeros(y.shape)
    x, power = np.zeros(len(A)), model.C
    for k in range(len(y)):
        seen[k], forced[k] = power, y[k] - model.C @ x - model.D @ u[k]
        x, power = A @ x + B @ u[k] + K @ y[k], power @ A
    spread = np.diag(np.var(y, axis=0))
    for _ in range(50):
        root = np.linalg.inv(np.linalg.cholesky(spread))
        columns, rest = (root @ seen).reshape(-1, len(A)), (forced @ root.T).ravel()
        left = forced - seen @ np.linalg.lstsq(columns, rest, rcond=1e-13)[0]
        spread = left.T @ left / len(y)
        spread = spread if predicts else np.diag(np.diag(spread))
    return 0.5 * np.linalg.slogdet(spread)[1]


# Losses of an independent optimiser (separable least squares in output-normal form with Newton
# steps at the end, about 30 starts: subspace models of four weightings and random ones), signals
# about their means. These are reached from the start of MOESPRegressor alone.
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")  # few states
@pytest.mark.parametrize(
    ("load", "order", "feedthrough", "criterion", "best"),
    [
        (load_slicot_example, 2, True, "prediction_error", -2.4971261852),
        (load_slicot_example, 2, False, "prediction_error", -2.4771824147),
        (load_slicot_example, 4, True, "output_error", -2.4833844691),
        (load_slicot_example, 4, False, "output_error", -2.4823752296),
        (load_power_plant, 2, False, "prediction_error", 11.0085897735),
        (load_power_plant, 4, True, "prediction_error", 7.2320608960),
        (load_power_plant, 2, True, "output_error", 11.2335953218),
    ],
)
@pytest.mark.slow
def test_losses_are_those_of_an_independent_optimiser(load, order, feedthrough, criterion, best):
    record = load()
    u, y = (each - each.mean() for each in (record.inputs, record.outputs))
    match = fitted(order, u, y, criterion, feedthrough=feedthrough)["match"]
    predicts = criterion == "prediction_error"
    assert loss(match.model_, u, y, predicts=predicts) == pytest.approx(best, abs=1e-4)


@pytest.mark.slow
def test_the_innovations_form_is_found_with_intervals_that_hold(rng):
    truth = system()
    u, y, _ = truth.simulate(rng, 4000)
    pipe = fitted(3, u, y)
    match, model = pipe["match"], pipe["match"].model_
    assert match.system_.dt == 1.0
    markov = [model.C @ np.linalg.matrix_power(model.A, k) for k in range(8)]
    assert np.allclose(np.array(markov) @ model.B, truth.markov(truth.B), atol=0.05)
    assert np.allclose(np.array(markov) @ match.kalman_gain_, truth.markov(truth.K), atol=0.08)
    assert np.allclose(match.innovations_covariance_, truth.E, rtol=0.1)
    found, true = match.eigenvalues_, np.log(np.linalg.eigvals(truth.A))
    for value, real, imag in found.to_numpy():
        miss = value - true[np.argmin(np.abs(value - true))]
        assert abs(miss.real) < 4.0 * real.real
        assert abs(miss.imag) <= 4.0 * imag.real
    w = np.array([0.1, 0.5, 1.5])
    response, std = match.frequency_response(w)
    exact = [truth.C @ np.linalg.solve(np.exp(1j * v) * np.eye(3) - truth.A, truth.B) for v in w]
    assert np.all(np.abs((response - exact).real) < 4.5 * std.real)
    # one step ahead no other predictor of the machine leaves less
    left = np.asarray(pipe.predict(u) - y)[50:]
    ahead = match.predict_ahead(pipe[:-1].transform(u), y)[50:] - y[50:]
    assert np.all(np.std(ahead, axis=0) < np.std(left, axis=0))
    assert np.allclose(np.cov(ahead.T), truth.E, rtol=0.1)


@pytest.mark.slow
def test_an_unstable_machine_under_feedback_has_a_stable_predictor(rng):
    A, B, C = np.array([[1.1, 0.3], [0.0, 0.7]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    truth = InnovationSystem(A, B, C, np.array([[0.9], [0.1]]), np.array([[0.01]]))
    u, y, _ = truth.simulate(rng, 2000, feedback=np.array([[0.25]]))
    with pytest.warns(UserWarning, match="unstable"):
        pipe = Pipeline(
            [
                ("identify", MOESPRegressor(2, weighting="pbsid", feedthrough=False)),
                ("match", StructuredMatcher(criterion="prediction_error")),
            ]
        ).fit(u, y)
    model = pipe["match"].model_
    assert np.allclose(np.sort(np.linalg.eigvals(model.A)), [0.7, 1.1], atol=0.01)
    assert np.max(np.abs(np.linalg.eigvals(model.A - model.kalman_gain @ model.C))) < 1.0


def test_time_series_have_a_model_of_their_innovations(rng):
    A, C, K = np.array([[0.9, 0.3], [-0.3, 0.9]]), np.array([[1.0, 0.0]]), np.array([[0.5], [0.2]])
    truth = InnovationSystem(A, np.zeros((2, 1)), C, K, np.array([[1.0]]))
    y = pd.DataFrame({"y": truth.simulate(rng, 3000)[1][:, 0]})
    match = fitted(2, y[[]], y)["match"]
    assert np.allclose(
        np.sort_complex(np.linalg.eigvals(match.model_.A)), [0.9 - 0.3j, 0.9 + 0.3j], atol=0.02
    )
    markov = [match.model_.C @ np.linalg.matrix_power(match.model_.A, k) for k in range(8)]
    assert np.allclose(np.array(markov) @ match.kalman_gain_, truth.markov(K), atol=0.08)


def test_gains_are_those_of_predictions_alone(rng):
    u, y, _ = system().simulate(rng, 500)
    with pytest.warns(IdentifiabilityWarning, match="use criterion='prediction_error'"):
        match = fitted(3, u, y, "output_error")["match"]
    assert match.covariance_type_ == "robust"
    with pytest.raises(AttributeError, match="kalman_gain_ exists only for criterion='pred"):
        _ = match.kalman_gain_


def test_noise_on_the_inputs_needs_a_structure(rng):
    u, y, _ = system().simulate(rng, 400)
    with pytest.raises(ValueError, match="give a MatrixStructure, or leave input_noise=None"):
        StructuredMatcher(MOESPRegressor(3), criterion="output_error", input_noise=0.1).fit(u, y)


def test_a_start_without_a_stable_predictor_is_refused():
    """As a model of many states may be, of few rows."""
    unused = PeriodicStructure(np.zeros((1, 2, 2)), np.zeros((0, 4)), 1, ())
    form, rows = Form(unused, 1.0, 1, discrete=True), np.arange(50.0)[:, None]
    free = np.ones((1, 2, 1), dtype=bool)
    lost = OutputNormal(np.array([[np.nan], [1.0]]), np.array([[1.0], [0.0]]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutputNormal, "of", lambda A, C: lost)
        with pytest.raises(ValueError, match="order 1, has no stable predictor"):
            free_form(form, [(rows, rows, 0)], np.ones((1, 2, 2)), free, n_starts=0)
