"""The orbit of a machine in predictions: at every row, in every reading, in any unit, at any ω."""

import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.exceptions import FrequencyMismatchWarning
from sklearn_hd.systems import mathieu

SYSTEM = mathieu()  # ω = 2
PERIOD = np.pi


def orbit(t, n_harmonics):
    """Two large waveforms, their harmonics falling like 1 / k."""
    k = np.arange(1, n_harmonics + 1)
    psi = 2.0 * t[:, None] * k
    return np.column_stack([5 + np.sum(np.cos(psi) / k, 1), 9 * np.sum(np.sin(psi + 0.3) / k, 1)])


def doublet(t):
    turns = t / PERIOD
    return 1.0 * ((turns >= 8.3) & (turns < 12.1)) - ((turns >= 12.1) & (turns < 15.7))


def steps(t):
    return np.repeat(np.random.default_rng(0).choice([-1.0, 0.0, 1.0], len(t) // 9 + 1), 9)[
        : len(t)
    ]


def record(samples, inputs, n_harmonics, n_turns=60, size=0.05, scale=(1.0, 1.0)):
    """Input and outputs, and the orbit alone, a hundred times as large."""
    t = np.arange(int(n_turns * samples)) * PERIOD / samples
    u = inputs(t)
    still = orbit(t, n_harmonics)
    y = (still + size * SYSTEM.simulate(u[:, None], t)) * scale
    index = pd.Index(t, name="time")
    frames = (pd.DataFrame(z, index, ["a", "b"]) for z in (y, still * scale))
    return pd.DataFrame({"u": u}, index), *frames


def pipeline(omega=2.0, **analysis):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(omega, **analysis)),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure())),
        ]
    )


@pytest.mark.filterwarnings("ignore:.*samples a period, not a whole number")
@pytest.mark.parametrize(
    ("samples", "inputs", "n_harmonics"),
    [
        (32, doublet, 10),
        (27.3, doublet, 6),
        (16.21, steps, 6),
        (61, steps, 25),
        (60.7, steps, 25),
    ],
)
@pytest.mark.slow
def test_every_row_is_on_the_orbit_the_last_one_too(samples, inputs, n_harmonics):
    """Errors of a thousandth of the motion, which is a fiftieth of the orbit."""
    X, y, still = record(samples, inputs, n_harmonics, 60 if inputs is doublet else 200)
    pipe = pipeline().fit(X, y)
    at_rest = pipe.predict(X.assign(u=0.0))
    motion = (y - still).std()
    assert ((at_rest - still).abs().max() < 5e-3 * motion).all()
    assert pipe.score(X, y) > 1 - 1e-4


@pytest.mark.parametrize("inputs", [doublet, pytest.param(steps, marks=pytest.mark.slow)])
@pytest.mark.parametrize("scale", [(1e-6, 1e3), (1e4, 1e-9)])
def test_units_of_outputs_change_predictions_by_these_alone(inputs, scale):
    X, y, _ = record(32, inputs, 10)
    plain = pipeline().fit(X, y)
    X, z, _ = record(32, inputs, 10, scale=scale)
    other = pipeline().fit(X, z)
    error = (other.predict(X) / list(scale) - plain.predict(X)).abs().max()
    assert (error < 1e-5 * (y - y.mean()).std()).all()


@pytest.mark.parametrize("off", [1e-6, -1e-5, 1e-4, 3e-3])
@pytest.mark.parametrize("inputs", [doublet, steps])
@pytest.mark.slow
def test_a_frequency_that_is_off_costs_a_word_and_nothing_else(inputs, off):
    X, y, still = record(32, inputs, 10, 120)
    exact = pipeline().fit(X, y)
    pipe = pipeline(2.0 * (1 + off))
    with pytest.warns(FrequencyMismatchWarning, match=r"±.*is used"):
        pipe.fit(X, y)
    assert pipe["harmonics"].basis_.omega == pytest.approx(2.0, rel=1e-8)
    found, true = (np.sort(each["match"].ltp_.floquet_exponents().real) for each in (pipe, exact))
    np.testing.assert_allclose(found, true, rtol=1e-2)
    at_rest = pipe.predict(X.assign(u=0.0))
    assert ((at_rest - still).abs().max() < 1e-2 * (y - still).std()).all()
