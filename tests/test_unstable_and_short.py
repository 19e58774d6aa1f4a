"""Periodic orbits that are unstable, and records too short for the period-synchronous Hankel."""

import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd.exceptions import InstabilityWarning
from sklearn_hd.systems import LTPSystem

OMEGA, SPP = 2 * np.pi, 32


class Growing:
    """F(ψ) with one Floquet exponent near a given rate, the other near −1."""

    def __init__(self, rate):
        self.rate = rate

    def __call__(self, psi):
        F = np.empty((*np.shape(psi), 2, 2))
        F[..., 0, 0], F[..., 0, 1] = self.rate + 0.3 * np.cos(psi), 0.4 * np.sin(psi)
        F[..., 1, 0], F[..., 1, 1] = 0.5 * np.cos(psi), -1.0 + 0.2 * np.sin(psi)
        return F


def orbit(rate):
    G = np.array([[1.0], [0.5]])
    return LTPSystem(
        Growing(rate), lambda psi: np.broadcast_to(G, (*np.shape(psi), 2, 1)), omega=OMEGA
    )


def record(system, n_periods):
    t = np.arange(n_periods * SPP) / SPP
    u = np.zeros((len(t), 1))
    u[2 * SPP : 5 * SPP], u[5 * SPP : 8 * SPP] = 1.0, -1.0
    index = pd.Index(t, name="time")
    y = system.simulate(u, t)
    return pd.DataFrame(u, index, ["u"]), pd.DataFrame(y, index, ["a", "b"])


def pipeline(hop, kept, order):
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(OMEGA, output_harmonics=kept, hop=hop)),
            ("identify", MOESPRegressor(order=order)),
            ("reduce", SpuriousModeReducer()),
        ]
    )


def synchronous():
    return pipeline("period", 15, 2)


def messages(pipe, X, y):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pipe.fit(X, y)
    return [str(w.message) for w in caught if w.category is InstabilityWarning]


@pytest.mark.parametrize(("rate", "n_periods"), [(0.1, 20), (0.1, 60), (0.5, 20)])
def test_an_unstable_orbit_is_identified_and_named(rate, n_periods):
    system = orbit(rate)
    exponents = np.sort(system.floquet_exponents().real)
    X, y = record(system, n_periods)
    pipe = synchronous()
    (message,) = messages(pipe, X, y)
    assert f"has the real part {exponents[1]:.4g} 1/s" in message
    found = np.sort(np.log(np.abs(pipe["identify"].eigenvalues_)))
    np.testing.assert_allclose(found, exponents, rtol=1e-6)
    assert pipe.score(X, y) > 0.999
    assert np.isfinite(pipe.predict(X).to_numpy()).all()


def test_an_unstable_orbit_through_the_sliding_analyzer():
    system = orbit(0.1)
    X, y = record(system, 60)
    pipe = pipeline(None, 1, 12)
    (message,) = messages(pipe, X, y)
    assert "the periodic orbit is unstable: a Floquet exponent of the model" in message
    poles = pipe["reduce"].system_.poles()
    assert np.max(poles.real) == pytest.approx(np.max(system.floquet_exponents().real), rel=1e-4)


@pytest.mark.parametrize("pipe", [synchronous(), pipeline(None, 1, 12)])
def test_growth_that_hides_the_rest_is_the_reason_named(pipe):
    X, y = record(orbit(0.5), 60)
    first = messages(pipe, X, y)[0]
    assert "outputs grow 1.67 times a period up to the last of the rows" in first
    assert "use records of at most 26.8 s (26 periods), or fly with a controller" in first
    X, y = X.loc[:26], y.loc[:26]
    assert not any("outputs grow" in message for message in messages(pipe, X, y))


def test_an_input_that_begins_late_is_no_growth():
    X, y = record(orbit(-0.05), 60)
    late = X.to_numpy()[::-1].copy()  # ends in the middle of its last step
    late[-5 * SPP :] = 1.0
    y[:] = orbit(-0.05).simulate(late, y.index.to_numpy())
    assert messages(synchronous(), X.assign(u=late), y) == []


def test_a_stable_orbit_is_not_called_unstable():
    X, y = record(orbit(-0.05), 60)
    noisy = y + 0.05 * y.std().to_numpy() * np.random.default_rng(0).standard_normal(y.shape)
    for outputs in (y, noisy):
        assert messages(synchronous(), X, outputs) == []
    assert messages(MOESPRegressor(order=2, block_rows=4), X, y) == []  # nothing periodic there


def test_too_few_periods_are_counted():
    X, y = record(orbit(-0.05), 12)
    message = (
        r"give 12 period\(s\) .* too few for block_rows=8: at least 26 consecutive periods are "
        r"needed with 1 direction\(s\) of inputs; use a longer record, or fewer block rows"
    )
    pipe = synchronous()[:2].set_params(identify__block_rows=8)
    with pytest.raises(ValueError, match=message):
        pipe.fit(X, y)
    assert pipe.set_params(identify__block_rows=3).fit(X, y)["identify"].order_ == 2
