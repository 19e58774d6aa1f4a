"""The rule for ``refit``, on tables as a search makes them."""

import numpy as np
import pytest
from sklearn.exceptions import FitFailedWarning

from sklearn_hd.model_selection import smallest_within_one_standard_error


def results(scores, metric="score", **parameters):
    """cv_results_ as a search would hold them, from scores (n_candidates, n_folds)."""
    scores = np.asarray(scores, dtype=float)
    names = list(parameters)
    found = {
        "params": [dict(zip(names, v, strict=True)) for v in zip(*parameters.values(), strict=True)]
    }
    found |= {f"param_{name}": np.asarray(parameters[name], dtype=object) for name in names}
    found |= {f"split{f}_test_{metric}": scores[:, f] for f in range(scores.shape[1])}
    return found | {f"mean_test_{metric}": scores.mean(axis=1)}


SCORES = [[0.5, 0.6, 0.4], [0.89, 0.82, 0.66], [0.90, 0.80, 0.70], [0.88, 0.81, 0.69]]


def test_the_rule_takes_the_smallest_within_one_standard_error():
    assert smallest_within_one_standard_error(results(SCORES, order=[1, 2, 3, 4])) == 1
    assert smallest_within_one_standard_error(results(SCORES, order=[4, 3, 2, 1])) == 3
    shuffled = results(np.array(SCORES)[[2, 0, 3, 1]], identify__order=[3, 1, 4, 2])
    assert smallest_within_one_standard_error(shuffled) == 3


@pytest.mark.parametrize("test_share", [None, 0.1, 1.0])
@pytest.mark.parametrize("perfect", [0.0, 1.0, 100.0])
def test_the_standard_error_is_that_of_the_difference_for_folds_that_overlap(test_share, perfect):
    """A candidate just within is taken, one just beyond is not (Nadeau and Bengio's q)."""
    scatter = np.array([0.3, -0.1, -0.1, -0.1])
    q = 1 / 3 if test_share is None else test_share
    error = np.sqrt(np.var(scatter, ddof=1) * (1 / 4 + q))
    best = np.full(4, 0.02)  # left of each fold
    for share, chosen in ((0.999, 0), (1.001, 1)):
        left = np.array([best * np.exp(share * error + scatter), best])
        table = results(perfect - left * (perfect or 1.0), order=[1, 2])
        assert smallest_within_one_standard_error(table, test_share=test_share) == chosen


def test_what_makes_a_fold_harder_than_another_is_no_error():
    """Measured data: four points less on every fold are no noise, however folds differ."""
    best = np.array([0.95, 0.80, 0.60, 0.90])
    table = results([best - [0.04, 0.04, 0.05, 0.03], best], order=[2, 3])
    assert smallest_within_one_standard_error(table) == 1


def test_a_tiny_gain_on_every_fold_does_not_buy_a_state():
    """Far beyond the error of the difference, which is 0, but a two hundredth of what is left."""
    best = np.array([0.9974, 0.9971, 0.9969, 0.9975])
    assert smallest_within_one_standard_error(results([best - 1e-5, best], order=[3, 4])) == 0


def test_twice_what_the_best_leaves_is_never_as_good():
    """One fold of four tells, and the others scatter: an error as large as the difference."""
    table = results([[0.6, 0.99, 0.991, 0.992], [0.99, 0.992, 0.992, 0.991]], order=[1, 2])
    assert smallest_within_one_standard_error(table) == 1


@pytest.mark.parametrize("rest", [1.0, 0.0, 0.003, -0.02])
def test_folds_that_stand_still_count_for_nothing(rest):
    """Exact outputs at rest are met (1), noise has nothing to explain; one fold moves."""
    still = np.full((2, 4), rest)
    still[1] -= 0.01 * (rest < 1.0)  # more states fit more of the noise
    moving = [[0.80], [0.999]]
    table = results(np.hstack([still, moving]), order=[1, 2])
    assert smallest_within_one_standard_error(table) == 1
    better = results(np.hstack([still, [[0.9985], [0.9985]]]), order=[1, 2])
    assert smallest_within_one_standard_error(better) == 0


def test_equal_orders_are_parted_by_block_rows_or_by_score():
    table = results(
        [[0.9, 0.8], [0.9, 0.8], [0.91, 0.79]], order=[2, 2, 2], identify__block_rows=[9, 5, 7]
    )
    assert smallest_within_one_standard_error(table) == 1
    assert smallest_within_one_standard_error(table, size="block_rows") == 1
    better = results([[0.90, 0.80], [0.91, 0.80]], order=[2, 2], block_rows=[5, 9])
    assert smallest_within_one_standard_error(better) == 0
    assert smallest_within_one_standard_error(better, size=["order"]) == 1


def test_rounding_is_no_difference():
    """Scores of noise-free data: 1 − 1e-14 is as good as 1 − 1e-16, on every fold."""
    table = results([[0.9] * 3, [1 - 1e-13] * 3, [1 - 1e-15] * 3], order=[2, 3, 4])
    assert smallest_within_one_standard_error(table) == 1


def test_several_metrics_need_one_to_decide_by():
    table = results(SCORES, order=[1, 2, 3, 4]) | results(SCORES[::-1], "fit", order=[1, 2, 3, 4])
    assert smallest_within_one_standard_error(table, metric="fit") == 0
    only = results(SCORES, "fit", order=[1, 2, 3, 4])
    with pytest.raises(ValueError, match=r"metric='score' is not among.*\['fit'\]; name one"):
        smallest_within_one_standard_error(only)


def test_failed_candidates_are_passed_over_and_named_with_their_folds():
    scores = np.array(SCORES)
    scores[0, 2] = np.nan
    scores[3] = np.nan, np.inf, np.nan
    with pytest.warns(FitFailedWarning, match="2 of 4 candidates failed on some fold: ") as told:
        chosen = smallest_within_one_standard_error(results(scores, order=[1, 2, 3, 4]))
    assert chosen == smallest_within_one_standard_error(results(SCORES[1:3], order=[2, 3])) + 1
    (told,) = told
    assert "{'order': 1} on folds [2]; {'order': 4} on folds [0, 1, 2]; " in str(told.message)
    assert "error_score='raise'" in str(told.message)
    assert told.filename == __file__


def test_a_fold_or_a_corner_that_fails_does_not_refuse_the_search():
    """No input moves in fold 1, and each candidate but one fails somewhere else."""
    scores = np.array([[0.5, 0.6, 0.4, 0.5], [0.9, 0.9, 0.9, 0.9], [0.9, 0.9, 0.9, 0.9]])
    nothing = scores.copy()
    nothing[:, 1] = np.nan
    nothing[2, 2] = -np.inf
    only = r"2 that failed least .* on folds \[0, 2, 3\]; .* failed on folds \[1\]: .* is 0\.9\)"
    with pytest.warns(FitFailedWarning, match=only):
        assert smallest_within_one_standard_error(results(nothing, order=[1, 2, 3])) == 1
    holes = scores.copy()
    holes[[0, 1, 2], [0, 1, 2]] = np.nan
    with pytest.warns(FitFailedWarning, match=r"the 3 that failed least .* on folds \[3\]"):
        assert smallest_within_one_standard_error(results(holes, order=[1, 2, 3])) == 1


@pytest.mark.parametrize("n_candidates", [1, 2, 9])
def test_where_nothing_can_be_compared_some_that_failed_are_named(n_candidates):
    scores = np.full((n_candidates, 3), np.nan)
    scores[-1] = -np.inf if n_candidates > 1 else np.nan  # the largest is unstable
    orders = list(range(1, n_candidates + 1))
    n_failed = max(1, n_candidates - 1)
    with pytest.raises(ValueError, match=rf"and {n_failed} of {n_candidates} candid") as raised:
        smallest_within_one_standard_error(results(scores, order=orders))
    assert str(raised.value).count(" on folds [0, 1, 2]") == min(n_failed, 5)
    assert ("; …;" in str(raised.value)) == (n_failed > 5)


def test_unstable_candidates_are_passed_over():
    scores = np.array(SCORES)
    chosen = smallest_within_one_standard_error(results(scores, order=[1, 2, 3, 4]))
    unstable = np.vstack([scores, scores[-1]])
    unstable[4, 1] = -np.inf
    table = results(unstable, order=[1, 2, 3, 4, 5])
    assert smallest_within_one_standard_error(table) == chosen
    table = results(np.full((2, 3), -np.inf), order=[1, 2])
    with pytest.raises(
        ValueError, match="the 2 candidates that are stable on most folds have no fold in common"
    ):
        smallest_within_one_standard_error(table)


@pytest.mark.parametrize(
    ("table", "kwargs", "message"),
    [
        (
            results(SCORES, window=list("abcd")),
            {"size": "order"},
            r"size=\['order'\] names no parameter",
        ),
        (results(SCORES, n_states=[1, 2, 3, 4]), {}, r"size=\['order', 'block_rows'\] names no"),
        (results(SCORES[:2], order=[2, "auto"]), {}, "order='auto' of candidate .* is not a size"),
        (
            results(SCORES[:2], block_rows=[4, None]),
            {},
            "block_rows=None of candidate .* is not a s",
        ),
        (
            results(SCORES[:2], a__order=[1, 2], b__order=[1, 2]),
            {},
            r"size='order' could be any of \['a__order', 'b__order'\]; give the whole name",
        ),
        (results([[0.9], [0.8]], order=[1, 2]), {}, r"the search has 1 fold\(s\), but a standard"),
        (results(SCORES, order=[1, 2, 3, 4]), {"test_share": -1}, "test_share must be a positive"),
        (
            results(np.multiply(SCORES, 999), order=[1, 2, 3, 4]),
            {},
            "a score of 899.1 is above that of a perfect model, 100; use",
        ),
    ],
)
def test_rule_words_what_is_wrong(table, kwargs, message):
    with pytest.raises(ValueError, match=message):
        smallest_within_one_standard_error(table, **kwargs)


def test_choices_without_a_size_are_parted_by_score():
    """A window alone, block rows left to the estimator, and grids of different parameters."""
    windows = results(SCORES, harmonics__window=["hann", "boxcar", "triangle", "centred-hann"])
    assert smallest_within_one_standard_error(windows) == 2
    left_open = results(SCORES[1:3], order=[2, 2], block_rows=[None, 14])
    assert smallest_within_one_standard_error(left_open) == 1
    automatic = results(SCORES, order=["auto"] * 4, window=["hann", "boxcar", "triangle", "kaiser"])
    assert smallest_within_one_standard_error(automatic) == 2
    automatic = results(SCORES[1:], order=["auto"] * 3, block_rows=[7, 8, 9])
    assert smallest_within_one_standard_error(automatic) == 0
    lists = results(SCORES[1:3], order=[2, 2])
    lists["params"] = [{"order": 2, "block_rows": 14}, {"order": 2}]
    lists["param_block_rows"] = np.ma.array([14, 0], mask=[False, True])
    assert smallest_within_one_standard_error(lists) == 1
    lists["params"] = [{"order": 2}, {"block_rows": 9}]
    with pytest.raises(ValueError, match=r"order was not searched for this candidate: .*'block_r"):
        smallest_within_one_standard_error(lists)


def test_a_whole_name_parts_two_steps():
    table = results(SCORES[1:3], a__order=[2, 1], b__order=[1, 2])
    assert smallest_within_one_standard_error(table, size="a__order") == 1
    assert smallest_within_one_standard_error(table, size="b__order") == 0
