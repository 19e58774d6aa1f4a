"""Small fitted models that the displays draw, and one way to make each display from them."""

from functools import lru_cache

import numpy as np
import pandas as pd
from periodic_cases import coupled, mathieu, record, synchronous
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.plotting import (
    AzimuthDisplay,
    BodeDisplay,
    ConvergenceDisplay,
    EigenvalueDisplay,
    HarmonicsDisplay,
    HarmonicTransferFunctionDisplay,
    OrderSelectionDisplay,
    ParticipationDisplay,
    PeriodicMatrixDisplay,
    ResidualDisplay,
    ResponseDisplay,
    SingularValueDisplay,
    StabilizationDisplay,
    StepResponseDisplay,
)
from sklearn_hd.systems import LTPSystem

STATES = ["w_0", "phi_dot_1c", "phi_dot_1s"]
FREE = {"A": np.full((3, 3), np.nan), "B": np.full((3, 1), np.nan)}


@lru_cache
def wing(snr=None):
    """Sixty flaps; two of each wingbeat's coefficients are the states of three."""
    options = {"n_periods": 60, "start": 10, "width": 6, "samples_per_period": 32}
    return make_flapping_wing("lti-signal", snr=snr, random_state=0, **options)


@lru_cache
def sliding(snr=None, criterion="hinf"):
    """All four steps, fitted to that record."""
    data = wing(snr)
    kept = {"w": [0], "phi_dot": [1]}
    structure = MatrixStructure(**FREE, state_names=STATES)
    return Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(data.omega, output_harmonics=kept, hop=8)),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=structure, criterion=criterion)),
        ]
    ).fit(data.inputs, data.outputs)


@lru_cache
def periodic_record():
    """Mathieu's equation under steps, with a little noise."""
    return record(mathieu(), noise=0.002)


@lru_cache
def periodic():
    """The linear time-periodic system identified from it."""
    u, y = periodic_record()
    return synchronous(2.0, order=2).fit(u, y)


@lru_cache
def random_steps():
    """A record of Mathieu's equation long enough for its frequency response."""
    rng = np.random.default_rng(3)
    u = rng.choice([-1.0, 1.0], (16 * 1000, 1))
    return record(mathieu(), n_periods=1000, samples=16, u=u, noise=0.05)


@lru_cache
def service_record():
    """Mathieu's equation whose input always moves, under loads, at 14.4 samples a turn (25 deg)."""
    rng = np.random.default_rng(4)
    index = pd.Index(np.arange(3000) * np.pi / 14.4, name="time")
    u = rng.choice([-1.0, 1.0], (3000, 1))
    y = _deflection().simulate(u, index.to_numpy())
    loads = np.cos(2.0 * index.to_numpy() + 0.5) + 0.3 * np.sin(6.0 * index.to_numpy())
    y = y + loads[:, None] + 0.05 * rng.standard_normal(y.shape)
    return pd.DataFrame(u, index, ["u1"]), pd.DataFrame(y, index, ["y"])


@lru_cache
def sampled(**harmonics):
    """The model of its samples at their azimuths."""
    analyzer = HarmonicAnalyzer(2.0, reading="sample", **harmonics)
    pipe = Pipeline([("harmonics", analyzer), ("identify", MOESPRegressor())])
    return pipe.fit(*service_record())


@lru_cache
def plain_record():
    """A second-order system under white noise, sample by sample."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((600, 1)), np.zeros((600, 1))
    for k in range(2, 600):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1]
    return u, y + 0.1 * rng.standard_normal(y.shape)


@lru_cache
def search():
    """Its orders, cross-validated."""
    grid = {"order": [1, 2, 3, 4], "block_rows": [6, 10]}
    return GridSearchCV(MOESPRegressor(), grid, cv=TimeSeriesSplit(4)).fit(*plain_record())


def history():
    """What StructuredMatcher.history_ looks like."""
    stages = ["least squares"] * 5 + ["H-infinity"] * 8
    error = np.concatenate([np.geomspace(1.0, 0.06, 5), 0.05 + 0.008 * 0.5 ** np.arange(8)])
    index = pd.RangeIndex(1, 14, name="iteration")
    return pd.DataFrame({"stage": stages, "error": error}, index=index)


def modes_of(orders):
    """Modes as a stabilization display draws them: one pair at every order, others that move."""
    rows = [(n, z, n > 1) for n in orders for z in (-1 + 4j, -1 - 4j)]
    rows += [(n, complex(-k, n * k), False) for n in orders for k in range(1, n)]
    table = pd.DataFrame(rows, columns=["order", "eigenvalue", "steady"])
    told = [f"{what}_steady" for what in ("frequency", "damping", "shape")]
    return table.assign(**dict.fromkeys(told, table["steady"]))


def many_signals(count):
    """Some decaying oscillations at one frequency, each with a phase of its own."""
    t = pd.Index(np.arange(240) / 30, name="time")
    waves = {f"blade_{k}": np.exp(-t / 4) * np.sin(2 * np.pi * t + k) for k in range(count)}
    return pd.DataFrame(waves, index=t)


def large_system(n):
    """A linear time-periodic system of n states and one input."""
    F = np.zeros((3, n, n))
    k = np.arange(n)
    F[0] = -np.diag(1.0 + 0.2 * k) + 0.3 * np.eye(n, k=1)
    F[1], F[2] = 0.2 * np.eye(n, k=-1), 0.1 * np.eye(n)
    return LTPSystem(F, np.ones((n, 1)), omega=3.0)


def harmonics(ax=None):
    data, units = wing(), {"w": "m/s", "phi_dot": "rad/s", "U": "N m"}
    span = (10.0 / data.omega, 170.0 / data.omega)
    return HarmonicsDisplay.from_estimator(
        sliding(), data.inputs, data.outputs, span=span, units=units, ax=ax
    )


def singular_values(ax=None):
    return SingularValueDisplay.from_estimator(sliding(20), marks={"paper": 11}, ax=ax)


def eigenvalues(ax=None):
    true = np.linalg.eigvals(wing().A_exact)
    return EigenvalueDisplay.from_estimator(sliding(), true=true, ax=ax)


def eigenvalues_with_confidence(ax=None):
    true = np.linalg.eigvals(wing().A_exact)
    model = sliding(20, "output_error")["match"]
    return EigenvalueDisplay.from_estimator(model, true=true, ax=ax)


def stabilization(ax=None, snr=20):
    """Orders beyond the true one; without noise they show how a processor rounds."""
    data, orders = wing(snr), range(1, 13)
    pipe = sliding() if snr is None else sliding(snr, "output_error")
    return StabilizationDisplay.from_estimator(
        pipe, data.inputs, data.outputs, orders=orders, ax=ax
    )


def response(ax=None):
    u, y = periodic_record()
    end = y.index[-1] + 0.1
    units = {"u1": "N", "y": "m", "v": "m/s"}
    return ResponseDisplay.from_estimator(
        periodic(), u, y, validation_span=(0.7 * end, end), units=units, ax=ax
    )


def response_with_loads(ax=None):
    units = {"u1": "N", "y": "m"}
    return ResponseDisplay.from_estimator(
        sampled(), *service_record(), loads=True, span=(100.0, 120.0), units=units, ax=ax
    )


def residuals(ax=None):
    return ResidualDisplay.from_estimator(
        periodic(), *periodic_record(), units={"y": "m", "v": "m/s"}, ax=ax
    )


def azimuth(ax=None):
    return AzimuthDisplay.from_estimator(sampled(), units={"u1": "N", "y": "m"}, ax=ax)


def bode(ax=None):
    system = sliding(20, "output_error")
    true = wing().ltp.harmonic_decomposition(1)  # more signals than the model's
    units = {"U": "N m", "w": "m/s", "phi_dot": "rad/s"}
    frequencies = np.geomspace(0.5, 2000.0, 120)
    return BodeDisplay.from_estimator(system, frequencies, true=true, units=units, ax=ax)


def step_response(ax=None):
    system = sliding(20, "output_error")
    true = wing().ltp.harmonic_decomposition(1)
    units = {"U": "N m", "w": "m/s", "phi_dot": "rad/s"}
    return StepResponseDisplay.from_estimator(system, true=true, units=units, ax=ax)


def harmonic_transfer(ax=None):
    u, y = random_steps()
    return HarmonicTransferFunctionDisplay.from_data(
        u, y[["y"]], 2.0, 1, systems={"model": _deflection()}, periods_per_segment=30, ax=ax
    )


def _deflection():
    return mathieu(P=[[1.0, 0.0]], output_names=["y"], input_names=["u1"])


def participation(ax=None):
    return ParticipationDisplay.from_system(coupled(), 2, ax=ax)


def periodic_matrix(ax=None):
    return PeriodicMatrixDisplay.from_estimator(periodic(), "F", true=mathieu(), ax=ax)


def order_selection(ax=None):
    return OrderSelectionDisplay.from_estimator(search(), ax=ax)


def convergence(ax=None):
    return ConvergenceDisplay(history()).plot(ax=ax)


DISPLAYS = {  # how to make it, panels
    "harmonics": (harmonics, 6),
    "singular_values": (singular_values, 1),
    "eigenvalues": (eigenvalues, 1),
    "eigenvalues_with_confidence": (eigenvalues_with_confidence, 1),
    "stabilization": (stabilization, 2),
    "response": (response, 3),
    "response_with_loads": (response_with_loads, 3),
    "residuals": (residuals, 6),
    "azimuth": (azimuth, 4),
    "bode": (bode, 6),
    "step_response": (step_response, 3),
    "harmonic_transfer": (harmonic_transfer, 6),
    "participation": (participation, 4),
    "periodic_matrix": (periodic_matrix, 4),
    "order_selection": (order_selection, 1),
    "convergence": (convergence, 1),
}
