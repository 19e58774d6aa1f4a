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
def test_the_standard_error_is_that_of_the_best_for_folds_that_overlap(test_share):
    """A candidate just within is taken, one just beyond is not (Nadeau and Bengio's q)."""
    best = np.array([0.9, 0.7, 0.8, 0.6])
    q = 1 / 3 if test_share is None else test_share
    error = np.sqrt(np.var(best, ddof=1) * (1 / 4 + q))
    for share, chosen in ((0.999, 0), (1.001, 1)):
        table = results([best - share * error, best], order=[1, 2])
        assert smallest_within_one_standard_error(table, test_share=test_share) == chosen


def test_a_tiny_gain_on_every_fold_does_not_buy_a_state():
    """Far beyond the error of the difference, which is 0, but nothing beside that of the score."""
    best = np.array([0.9974, 0.9971, 0.9969, 0.9975])
    assert smallest_within_one_standard_error(results([best - 1e-5, best], order=[3, 4])) == 0


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
    with pytest.warns(FitFailedWarning, match="2 of 4 candidates failed on some fold and") as told:
        chosen = smallest_within_one_standard_error(results(scores, order=[1, 2, 3, 4]))
    assert chosen == smallest_within_one_standard_error(results(SCORES[1:3], order=[2, 3])) + 1
    (told,) = told
    assert "{'order': 1} on folds [2]; {'order': 4} on folds [0, 1, 2]; " in str(told.message)
    assert "error_score='raise'" in str(told.message)
    assert told.filename == __file__


@pytest.mark.parametrize("n_candidates", [1, 2, 9])
def test_where_no_candidate_is_whole_some_that_failed_are_named(n_candidates):
    scores = np.full((n_candidates, 3), 0.5)
    scores[:, 1] = np.nan
    scores[-1, 1] = -np.inf if n_candidates > 1 else np.nan  # the largest is unstable
    orders = list(range(1, n_candidates + 1))
    n_failed = max(1, n_candidates - 1)
    with pytest.raises(ValueError, match=rf"and {n_failed} of {n_candidates} failed") as raised:
        smallest_within_one_standard_error(results(scores, order=orders))
    assert str(raised.value).count(" on folds [1]") == min(n_failed, 5)
    assert ("; …;" in str(raised.value)) == (n_failed > 5)


def test_unstable_candidates_are_passed_over():
    scores = np.array(SCORES)
    chosen = smallest_within_one_standard_error(results(scores, order=[1, 2, 3, 4]))
    unstable = np.vstack([scores, scores[-1]])
    unstable[4, 1] = -np.inf
    table = results(unstable, order=[1, 2, 3, 4, 5])
    assert smallest_within_one_standard_error(table) == chosen
    table = results(np.full((2, 3), -np.inf), order=[1, 2])
    with pytest.raises(ValueError, match="all 2 candidates are unstable on some fold and score -i"):
        smallest_within_one_standard_error(table)


@pytest.mark.parametrize(
    ("table", "kwargs", "message"),
    [
        (results(SCORES, window=list("abcd")), {"size": "order"}, r"none of size=\['order'\] was"),
        (results(SCORES, n_states=[1, 2, 3, 4]), {}, r"none of size=\['order', 'block_rows'\] was"),
        (results(SCORES[:2], order=[2, "auto"]), {}, "order='auto' of candidate .* is no size"),
        (results(SCORES[:2], block_rows=[4, None]), {}, "block_rows=None of candidate .* is no s"),
        (
            results(SCORES[:2], a__order=[1, 2], b__order=[1, 2]),
            {},
            r"size='order' could be any of \['a__order', 'b__order'\]; give the whole name",
        ),
        (results([[0.9], [0.8]], order=[1, 2]), {}, r"the search has 1 fold\(s\), and a standard"),
        (results(SCORES, order=[1, 2, 3, 4]), {"test_share": -1}, "test_share must be a positive"),
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
