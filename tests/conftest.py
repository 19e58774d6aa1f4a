"""Records that many tests read, simulated once; how many cases are drawn at random, and threads."""

import os

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import settings
from sklearn.pipeline import Pipeline
from threadpoolctl import threadpool_limits

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer
from sklearn_hd.datasets import make_flapping_wing

KEPT = {"w": [0], "phi_dot": [1]}

# the same cases at every run by default; new ones, and fifty times as many, with "nightly"
settings.register_profile("default", deadline=None, derandomize=True)
settings.register_profile(
    "nightly", deadline=None, derandomize=False, max_examples=5000, print_blob=True
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))
NIGHTLY = settings.default.max_examples > 100

if "PYTEST_XDIST_WORKER" in os.environ:  # workers share the processors: BLAS would take them twice
    threadpool_limits(1)


@pytest.fixture(autouse=True)
def _no_figures_left():
    """Tests of one worker share pyplot: none leaves a figure to the next."""
    yield
    plt.close("all")


@pytest.fixture
def synchronous_dask():
    """dask computes in this thread alone."""
    with pytest.importorskip("dask").config.set(scheduler="synchronous"):
        yield


@pytest.fixture(scope="session")
def lti_signal():
    return make_flapping_wing("lti-signal")


@pytest.fixture(scope="session")
def ltp():
    return make_flapping_wing("ltp")


@pytest.fixture(scope="session")
def nltp():
    return make_flapping_wing("nltp", amplitude=0.005)


@pytest.fixture(scope="session")
def lti():
    """Noisy coefficients of a third-order system, excited throughout."""
    return make_flapping_wing(
        "lti", input="multisine", n_periods=80, samples_per_period=16, snr=20, random_state=0
    )


@pytest.fixture
def rng():
    return np.random.default_rng(20241018)


def heave_pipeline(omega, *, rows_per_period=8, trim_span=None, **reduce):
    """Analyzer, identification and reduction as for the heave subsystem."""
    return Pipeline(
        [
            (
                "harmonics",
                HarmonicAnalyzer(
                    omega, output_harmonics=KEPT, hop=64 // rows_per_period, trim_span=trim_span
                ),
            ),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer(**reduce)),
        ]
    )


def random_stable(rng, n, m, n_outputs, *, radius=0.9):
    """A random discrete model with poles of known size, and its matrices."""
    A = rng.standard_normal((n, n))
    A *= radius / np.max(np.abs(np.linalg.eigvals(A)))
    return A, rng.standard_normal((n, m)), rng.standard_normal((n_outputs, n))


def same_poles(found, true, rtol):
    """Whether two sets of poles agree, each with its nearest."""
    found, true = np.asarray(found), np.asarray(true)
    assert len(found) == len(true)
    distance = np.abs(found[:, None] - true[None, :])
    return distance.min(axis=0).max() <= rtol * np.abs(true).max()
