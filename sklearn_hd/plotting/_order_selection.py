"""Scores of a search by order and block rows."""

import numpy as np
import pandas as pd
from sklearn.utils.validation import check_is_fitted

from sklearn_hd.model_selection._rule import fold_scores, searched_as, standard_error
from sklearn_hd.plotting._panels import one_axes
from sklearn_hd.plotting._style import BLACK, GREY, LEGEND, POINTS, dress, looks

__all__ = ["OrderSelectionDisplay"]

SPREAD = 0.05  # of the step from order to order, over which lines are set apart
FAR = 10.0  # below the best, in units of it or of one: beside more, the others would be one line


class OrderSelectionDisplay:
    """Cross-validated score by order, one line for each number of block rows.

    Bars are standard errors of the mean score, folds sharing their training rows
    (Nadeau and Bengio): SE² = var (1/k + q), q rows tested over rows trained on. A model
    within one standard error of the best is as good as the best.

    Parameters
    ----------
    results : DataFrame
        One row a candidate: the columns order, block_rows (text, for the legend), score
        and error (its standard error).
    chosen : int, optional
        Row of the candidate that the search took.
    metric : str, default="score"
        What the axis of the score is called.

    Attributes
    ----------
    ax_ : Axes
    figure_ : Figure
    lines_ : dict of ErrorbarContainer
        By block rows.
    chosen_ : Line2D or None
    limit_ : Line2D
        One standard error below the best score.
    failed_ : Line2D or None
        Orders of candidates that could not be fitted or scored on every fold, or whose score
        is out of all proportion (by more than ten, and ten times the best, below the best).

    References
    ----------
    Nadeau, Bengio (2003), Inference for the generalization error, Machine Learning 52,
    239-281.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.model_selection import GridSearchCV, TimeSeriesSplit
    >>> from sklearn_hd import MOESPRegressor
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.standard_normal((400, 1)), np.zeros((400, 1))
    >>> for k in range(399):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> grid = {"order": [1, 2, 3], "block_rows": [5, 8]}
    >>> search = GridSearchCV(MOESPRegressor(), grid, cv=TimeSeriesSplit(4))
    >>> search = search.fit(u, y + 0.1 * rng.standard_normal((400, 1)))
    >>> display = OrderSelectionDisplay.from_estimator(search)
    >>> list(display.lines_)
    ['5', '8']
    """

    def __init__(self, results, *, chosen=None, metric="score"):
        self.results = results
        self.chosen = chosen
        self.metric = metric

    @classmethod
    def from_estimator(cls, search, *, metric=None, misfit=False, ax=None, **names):
        """Draw a fitted search.

        Parameters
        ----------
        search : GridSearchCV, RandomizedSearchCV or the like
            Fitted.
        metric : str, optional
            With several metrics, which.
        misfit : bool, default=False
            Draw 1 − score on a logarithmic axis, which tells scores near one apart.
        ax : Axes, optional
            Those of a new figure by default.
        **names
            ``order``, ``block_rows``: see :meth:`from_cv_results`.

        Returns
        -------
        display : OrderSelectionDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If ``search`` is no search.
        NotFittedError
            If it has not been fitted.
        """
        if not hasattr(search, "get_params") or not hasattr(search, "cv"):
            raise TypeError(
                f"{cls.__name__} needs a fitted search over orders, such as GridSearchCV; "
                f"{type(search).__name__} is none"
            )
        check_is_fitted(search, "cv_results_")
        return cls.from_cv_results(
            search.cv_results_,
            chosen=getattr(search, "best_index_", None),
            metric=metric or "score",
            misfit=misfit,
            ax=ax,
            **names,
        )

    @classmethod
    def from_cv_results(
        cls,
        cv_results,
        *,
        order="order",
        block_rows="block_rows",
        metric="score",
        chosen=None,
        test_share=None,
        misfit=False,
        ax=None,
    ):
        """Draw ``cv_results_`` of a search.

        Parameters
        ----------
        cv_results : dict or DataFrame
            What a search leaves: parameters and scores of the candidates, fold by fold.
        order, block_rows : str
            Names of the parameters, alone or with their steps (``"identify__order"``).
            ``block_rows`` need not have been searched. Of candidates that differ in
            further parameters alone the best is drawn.
        metric : str, default="score"
            With several metrics, which.
        chosen : int, optional
            Index of the candidate that the search took.
        test_share : float, optional
            Rows tested over rows trained on, q; None is 1/(k − 1), as in k folds of equal
            size.
        misfit : bool, default=False
            Draw 1 − score on a logarithmic axis.
        ax : Axes, optional
            Those of a new figure by default.

        Returns
        -------
        display : OrderSelectionDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        ValueError
            If no order was searched, or the metric is unknown.
        """
        if isinstance(cv_results, pd.DataFrame):
            cv_results = cv_results.to_dict("list")
        scores = fold_scores(cv_results, metric)
        orders = _values(cv_results, order, "order")
        if orders is None:
            searched = sorted({key for p in cv_results["params"] for key in p})
            raise ValueError(
                f"{order!r} was not searched, only {searched}; name the parameter that is the "
                f"order with order="
            )
        if not all(isinstance(n, int | np.integer) for n in orders):
            raise ValueError(
                f"{order!r} was searched over {orders}; only whole numbers can be drawn"
            )
        rows = _values(cv_results, block_rows, "block_rows") or [None] * len(orders)
        results = pd.DataFrame(
            {
                "order": orders,
                "block_rows": ["default" if r is None else str(r) for r in rows],
                "score": scores.mean(axis=1),
                "error": [standard_error(row, test_share) for row in scores],
            }
        )
        return cls(results, chosen=chosen, metric=metric).plot(ax=ax, misfit=misfit)

    def plot(self, ax=None, *, misfit=False):
        """Draw, on a new figure by default.

        Parameters
        ----------
        ax : Axes, optional
            Those of a new figure by default.
        misfit : bool, default=False
            Draw 1 − score on a logarithmic axis, which tells scores near one apart.

        Returns
        -------
        display : OrderSelectionDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        ValueError
            If every candidate failed or was unstable on some fold.
        """
        good = self._comparable()
        if len(good) == 0:
            raise ValueError(
                "every candidate failed or was unstable on some fold, so that there is no score to "
                "draw; see why with error_score='raise', or search over smaller orders"
            )
        panels = one_axes(ax, (6.4, 4.0))
        self.figure_, self.ax_ = panels.figure, panels.axes[0]
        self._draw_lines(good, misfit)
        best = good.loc[good["score"].idxmax()]
        self.limit_ = self.ax_.axhline(
            _shown(best["score"] - best["error"], misfit),
            color=GREY,
            ls="--",
            lw=1.0,
            label="one standard error from the best",
        )
        self.chosen_ = None
        if self.chosen is not None and self.chosen in good.index:
            row = good.loc[self.chosen]
            style = {"color": BLACK, "mfc": "none", "ms": 14, "mew": 1.5, "ls": ""}
            (self.chosen_,) = self.ax_.plot(
                self._places[self.chosen],
                _shown(row["score"], misfit),
                "o",
                label="chosen",
                **style,
            )
        self._mark_failed(good)
        self.ax_.set_xticks(sorted(set(self.results["order"])))
        if misfit:
            self.ax_.set_yscale("log")
        label = f"1 − {self.metric} (–)" if misfit else f"{self.metric} (–)"
        dress(self.ax_, x="order of the model (–)", y=f"cross-validated {label}")
        handles = [*self.lines_.values(), self.chosen_, self.limit_, self.failed_]
        handles = [handle for handle in handles if handle is not None]
        self.legend_ = self.ax_.legend(handles=handles, **LEGEND)
        return self

    def _comparable(self):
        """Candidates with scores that one axis can show."""
        good = self.results[np.isfinite(self.results["score"])]
        best = good["score"].max()
        return good[good["score"] > best - FAR * max(1.0, abs(best))]

    def _draw_lines(self, good, misfit):
        orders = sorted(set(self.results["order"]))
        step = np.min(np.diff(orders)) if len(orders) > 1 else 1
        groups = list(dict.fromkeys(self.results["block_rows"]))
        shifts = SPREAD * step * (np.arange(len(groups)) - 0.5 * (len(groups) - 1))
        self.lines_, self._places = {}, {}
        for name, look, shift in zip(groups, looks(POINTS, len(groups)), shifts, strict=True):
            part = good[good["block_rows"] == name]
            part = part.sort_values("score").groupby("order").tail(1).sort_values("order")
            bars = part["error"].to_numpy()
            score = _shown(part["score"].to_numpy(), misfit)
            if misfit:  # a bar that reaches zero ends where the axis does
                bars = np.array([np.minimum(bars, 0.9 * score), bars])
            label = f"{name} block rows" if len(groups) > 1 or name != "default" else "mean"
            style = look | {"capsize": 3, "lw": 1.3, "ms": 5, "label": label}
            x = part["order"].to_numpy() + shift
            self.lines_[name] = self.ax_.errorbar(x, score, bars, **style)
            members = self.results.index[self.results["block_rows"] == name]
            self._places |= {i: self.results.loc[i, "order"] + shift for i in members}

    def _mark_failed(self, good):
        failed = self.results.drop(good.index)["order"]
        self.failed_ = None
        if len(failed):
            style = {"color": BLACK, "ls": "", "ms": 7, "clip_on": False}
            (self.failed_,) = self.ax_.plot(
                sorted(set(failed)),
                [0.0] * failed.nunique(),
                "x",
                transform=self.ax_.get_xaxis_transform(),
                label="failed or unstable on some fold",
                **style,
            )


def _shown(score, misfit):
    return 1.0 - score if misfit else score


def _values(cv_results, name, parameter):
    """Values of a parameter for each candidate; None where it was not searched."""
    keys = searched_as(cv_results, name, parameter)
    return [params.get(keys[0]) for params in cv_results["params"]] if keys else None
