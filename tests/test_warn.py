"""Warnings point at the line of the user's that asked for what they speak of."""

import linecache
import warnings

import numpy as np
import pytest

from sklearn_hd import HarmonicAnalyzer, MatrixStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning, TimeBaseWarning


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
