"""Choice of the order: splitters, scorers and a rule for scikit-learn's searches.

Rows of a record follow one another in time, so three habits of scikit-learn need a counterpart
here:

- folds are blocks of rows (:class:`BlockSplit`) or of whole periods
  (:class:`PeriodBlockSplit`), or whole records (``GroupKFold`` on the record level of
  the index), never random rows;
- a fold that begins in the middle of a record does not begin at rest, so scorers
  simulate from a fitted initial state, as ``score`` of the model steps does
  (:func:`simulation_scorer`, :func:`fit_percent_scorer`);
- a model with surplus states predicts as well as the true one, to within the
  noise: take the smallest within one standard error of the best
  (:func:`smallest_within_one_standard_error`).
"""

from sklearn_hd.model_selection._rule import smallest_within_one_standard_error
from sklearn_hd.model_selection._scorers import fit_percent, fit_percent_scorer, simulation_scorer
from sklearn_hd.model_selection._splitter import BlockSplit, PeriodBlockSplit

__all__ = [
    "BlockSplit",
    "PeriodBlockSplit",
    "fit_percent",
    "fit_percent_scorer",
    "simulation_scorer",
    "smallest_within_one_standard_error",
]
