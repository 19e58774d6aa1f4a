"""Warnings point at the line of the user's that asked for what they speak of."""

import linecache
import warnings

import numpy as np
import pandas as pd
import pytest
from sklearn.model_selection import GridSearchCV, TimeSeriesSplit
from sklearn.pipeline import make_pipeline

from sklearn_hd import HarmonicAnalyzer, MatrixStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.exceptions import (
    ExcitationWarning,
    IdentifiabilityWarning,
    ResamplingWarning,
    TimeBaseWarning,
)


def sine(n=400):
    """One sine and what follows it, which tell two directions apart."""
    u, y = np.sin(0.3 * np.arange(n))[:, None], np.zeros((n, 1))
    for k in range(n - 1):
        y[k + 1] = 0.9 * y[k] + u[k]
    return u, y + 1e-3 * np.random.default_rng(0).standard_normal(y.shape)


def two_modes_seen_once():
    """A structure of which one output shows but sums."""
    structure = MatrixStructure(A=[["a", 0.0], [0.0, "a"]], B=[["b"], ["c"]], C=[[1.0, 1.0]])
    return StructuredMatcher(MOESPRegressor(order=1, block_rows=5), structure=structure)


@pytest.mark.parametrize(
    ("category", "call"),
    [
        (ExcitationWarning, lambda: MOESPRegressor(order=2, block_rows=8).fit(*sine())),
        (ExcitationWarning, lambda: MOESPRegressor(order=2, block_rows=8).partial_fit(*sine())),
        (TimeBaseWarning, lambda: HarmonicAnalyzer(0.1 * np.pi).fit(*sine())),
        (IdentifiabilityWarning, lambda: two_modes_seen_once().fit(*sine())),
    ],
    ids=["fit", "partial_fit", "analyzer", "matcher"],
)
def test_warnings_name_the_line_that_called(category, call):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        call()
    own = [warning for warning in told if warning.category is category]
    assert {warning.filename for warning in own} == {__file__}
    assert all("lambda" in linecache.getline(__file__, warning.lineno) for warning in own)


@pytest.mark.parametrize(("action", "times"), [("default", 1), ("always", 7), ("ignore", 0)])
@pytest.mark.slow
def test_a_search_says_a_thing_once_at_the_line_that_called(rng, action, times):
    """Seven fits, each with filters of scikit-learn's own, which make Python forget."""
    t = pd.Index(0.1 * np.arange(1200))
    u = pd.DataFrame({"u": np.sign(np.sin(np.arange(1200) ** 1.1))}, index=t)
    y = pd.Series(np.convolve(u["u"], 0.8 ** np.arange(30))[:1200], index=t)
    pipe = make_pipeline(
        HarmonicAnalyzer(2 * np.pi / 6.43, reading="sliding"), MOESPRegressor(order=2)
    )
    search = GridSearchCV(pipe, {"moespregressor__order": [1, 2]}, cv=TimeSeriesSplit(3))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("ignore")
        warnings.filterwarnings(action, category=ResamplingWarning)
        warnings.filterwarnings("default", "another text", ResamplingWarning)
        warnings.filterwarnings("default", module="another_module")
        search.fit(u, y)
    assert len(told) == times
    assert {warning.filename for warning in told} <= {__file__}
    assert all("search.fit" in linecache.getline(__file__, w.lineno) for w in told)


def test_each_fit_of_a_loop_has_a_warning_of_its_own():
    """Their figures differ: none of the models after the first goes by without a word."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for n in (300, 400):
            MOESPRegressor(order=2, block_rows=8).fit(*sine(n))
    assert [each.category for each in told].count(ExcitationWarning) == 2
