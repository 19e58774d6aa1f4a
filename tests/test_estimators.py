"""scikit-learn's own checks of the four estimators."""

import numpy as np
import pytest
from sklearn.utils.estimator_checks import parametrize_with_checks

from sklearn_hd import HarmonicAnalyzer, MOESPRegressor, SpuriousModeReducer, StructuredMatcher

IN_TIME = "rows are ordered in time: their order and their neighbours matter"
EXPECTED_FAILURES = {
    "check_methods_sample_order_invariance": IN_TIME,
    "check_methods_subset_invariance": IN_TIME,
}
ESTIMATORS = [
    HarmonicAnalyzer(np.pi),
    MOESPRegressor(),
    SpuriousModeReducer(MOESPRegressor()),
    StructuredMatcher(SpuriousModeReducer(MOESPRegressor()), n_starts=1),
]
OTHERS = [
    HarmonicAnalyzer(np.pi, window="centred-boxcar", output_harmonics=0),
    HarmonicAnalyzer(np.pi / 2, input_harmonics=1, reading="period"),
    HarmonicAnalyzer(np.pi, missing="gap"),
    HarmonicAnalyzer(np.pi, window="hann"),
    HarmonicAnalyzer(np.pi, small_signal="odd", hop=1),
    MOESPRegressor(feedthrough=True, scale=False),
    MOESPRegressor(warmup=2.0),
    SpuriousModeReducer(MOESPRegressor(), method="both"),
    SpuriousModeReducer(MOESPRegressor(), method="residualize"),
    StructuredMatcher(SpuriousModeReducer(MOESPRegressor(feedthrough=True)), max_iter=50),
    StructuredMatcher(SpuriousModeReducer(MOESPRegressor()), n_starts=0, random_state=None),
]


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.TimeBaseWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ExcitationWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.InstabilityWarning")  # of noise
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks(ESTIMATORS, expected_failed_checks=lambda estimator: EXPECTED_FAILURES)
def test_scikit_learn_habits(estimator, check):
    check(estimator)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.TimeBaseWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.ExcitationWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.InstabilityWarning")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
@parametrize_with_checks(OTHERS, expected_failed_checks=lambda estimator: EXPECTED_FAILURES)
def test_scikit_learn_habits_whatever_the_parameters(estimator, check):
    check(estimator)
