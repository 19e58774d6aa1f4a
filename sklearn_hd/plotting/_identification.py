"""How identification went: singular values, scores of a search over orders, and the match."""

from dataclasses import KW_ONLY, dataclass
from itertools import groupby

import numpy as np
import pandas as pd
from sklearn.utils.validation import check_is_fitted

from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.model_selection._rule import fold_scores, searched_as, standard_error
from sklearn_hd.plotting._display import (
    BLACK,
    BLUE,
    GREY,
    LEGEND,
    ORANGE,
    POINTS,
    RED,
    Display,
    dress,
    fitted_step,
    looks,
    number,
)
from sklearn_hd.subspace import MOESPRegressor


@dataclass(eq=False, repr=False)
class SingularValueDisplay(Display):
    """Singular values that the order of a model is read from.

    An exact record of a system of order n leaves n values above the noise floor; the
    widest gap σ_n / σ_n+1 is where ``order="auto"`` cuts. Where simulations decided instead
    (plain data without a gap), what they left of the outputs is drawn beside.

    Parameters
    ----------
    singular_values : array_like, shape (n_values,)
        Descending.
    order : int
        The order chosen.
    noise_floor : float, optional
        Largest value that rounding or white noise would give.
    search : dict of ndarray, shape (n_simulated,), optional
        ``order_search_`` of a MOESPRegressor.

    Attributes
    ----------
    ax_ : Axes
    figure_ : Figure
    kept_, left_out_ : Line2D
        The values up to the order chosen, and beyond.
    floor_ : Line2D or None
        None where simulations decided.
    left_ : Line2D or None
        What the simulations of stable models left of the outputs, on an axis of its own; of
        models that differ in their harmonics alone, that with the least criterion.
    gap_ : Line2D
        After the order chosen; its label says how wide the gap is.
    marks_ : dict of Line2D
        Further orders marked, by label.

    Raises
    ------
    ValueError
        If the search lacks an entry.

    References
    ----------
    Verhaegen (1994), Automatica 30(1), 61-74.

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn_hd import MOESPRegressor
    >>> rng = np.random.default_rng(0)
    >>> u, y = rng.standard_normal((300, 1)), np.zeros((300, 1))
    >>> for k in range(299):
    ...     y[k + 1] = 0.8 * y[k] + u[k]
    >>> model = MOESPRegressor(block_rows=5).fit(u, y + 0.01 * rng.standard_normal((300, 1)))
    >>> display = SingularValueDisplay.from_estimator(model)
    >>> display.order
    1
    """

    singular_values: np.ndarray
    order: int
    noise_floor: float | None = None
    search: dict | None = None

    def __post_init__(self):
        self.singular_values = np.asarray(self.singular_values, dtype=float)
        missing = {"order", "feedthrough", "stable", "share", "bic"} - set(self.search or ())
        if self.search is not None and missing:
            raise ValueError(
                f"search lacks {sorted(missing)}; give order_search_ of a MOESPRegressor, or None"
            )

    @classmethod
    def from_estimator(cls, estimator, *, count=30, marks=None, ax=None):
        """Draw the singular values of a fitted model.

        Parameters
        ----------
        estimator : MOESPRegressor, or Pipeline or search that holds one
            Fitted.
        count : int, default=30
            Largest number of values drawn; the one after the order always is.
        marks : dict, optional
            Further orders to mark, by label: ``{"paper": 7}``.

        Raises
        ------
        ValueError
            If the record was too short for singular values (a static gain).
        """
        step = fitted_step(estimator, MOESPRegressor, cls.__name__)
        search = step.order_search_ if len(set(step.order_search_["order"])) > 1 else None
        display = cls(step.singular_values_, step.order_, step.noise_floor_, search)
        return display.plot(count=count, marks=marks, ax=ax)

    def plot(self, ax=None, *, count=30, marks=None):
        """Draw, on a new figure by default.

        Raises
        ------
        ValueError
            If no singular value is positive.
        """
        values = self.singular_values[: max(count, self.order + 1)]
        if not np.any(values > 0.0):
            raise ValueError(
                "there are no singular values to draw, because the record was too short for any "
                "dynamics, or is zero; use a longer one"
            )
        self._panels(ax, (6.4, 4.0))
        ax, n = self.ax_, np.arange(1, len(values) + 1)
        positive, kept = values > 0.0, n <= self.order
        inside, outside = positive & kept, positive & ~kept
        style = {"ls": "", "ms": 6}
        (self.kept_,) = ax.semilogy(
            n[inside], values[inside], "o", color=BLUE, label=f"order {self.order}", **style
        )
        (self.left_out_,) = ax.semilogy(
            n[outside], values[outside], "o", color=GREY, mfc="white", label="left out", **style
        )
        self.floor_ = self.left_ = None
        if self.search is not None:
            self._draw_left(ax.twinx())
        elif self.noise_floor is not None and self.noise_floor > 0.0:
            floor = {"color": RED, "ls": "--", "lw": 1.2, "label": "noise floor"}
            self.floor_ = ax.axhline(self.noise_floor, **floor)
        self.gap_ = ax.axvline(self.order + 0.5, color=BLUE, lw=1, label=self._gap(values))
        self.marks_ = {
            label: ax.axvline(order + 0.5, color=ORANGE, ls=":", lw=1.8, label=f"{label}: {order}")
            for label, order in (marks or {}).items()
        }
        dress(ax, x="number (–)", y="singular value (scaled outputs)")
        ax.set_xlim(0, len(values) + 1)
        ax.xaxis.get_major_locator().set_params(integer=True)
        handles = [*ax.get_legend_handles_labels()[0], *([self.left_] if self.left_ else [])]
        ax.legend(handles=handles, loc="upper right", **LEGEND)
        return self

    def _draw_left(self, ax):
        search = pd.DataFrame(self.search)
        drawn = search[search["stable"] & (search["feedthrough"] == search["feedthrough"][0])]
        drawn = drawn.loc[drawn.groupby("order")["bic"].idxmin()]  # of numbers of harmonics
        order, share = drawn["order"], drawn["share"]
        style = {"color": ORANGE, "lw": 1.3, "ms": 5, "label": "left by simulations"}
        (self.left_,) = ax.semilogy(order, share, "s-", **style)
        span = share.max() / share.min()
        if span < 1e4:  # else powers of ten are enough
            subs = (1.0, 2.0, 5.0) if span > 4.0 else np.arange(1.0, 10.0)
            ax.yaxis.get_major_locator().set_params(subs=subs)
        ax.yaxis.set_major_formatter("{x:.3g}")
        ax.yaxis.set_minor_formatter("")  # letters would cover each other
        ax.set_ylabel("share of the outputs left (–)")

    def _gap(self, values):
        """Width of the gap, in words."""
        cut_by_gap = self.search is None and 0 < self.order < len(values)
        if not cut_by_gap or values[self.order] <= 0.0:
            return "order chosen"
        return f"gap ×{number(values[self.order - 1] / values[self.order])}"


@dataclass(eq=False, repr=False)
class OrderSelectionDisplay(Display):
    """Cross-validated score by order, one line for each number of block rows.

    Bars are standard errors of the mean score, folds sharing their training rows
    (Nadeau and Bengio): SE² = var (1/k + q), q rows tested over rows trained on. They hold what
    makes one fold harder than another, too. The rule
    :func:`~sklearn_hd.model_selection.smallest_within_one_standard_error` compares candidates
    fold by fold, and tells smaller differences.

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

    results: pd.DataFrame
    _: KW_ONLY
    chosen: int | None = None
    metric: str = "score"

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
        **names
            ``order``, ``block_rows``: see :meth:`from_cv_results`.
        """
        if not hasattr(search, "get_params") or not hasattr(search, "cv"):
            raise TypeError(
                f"{cls.__name__} needs a fitted search over orders, such as GridSearchCV; "
                f"{type(search).__name__} is not one"
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
                f"{order!r} was not searched, only {searched}; give with order= the name of the "
                f"parameter that is the order"
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

        Raises
        ------
        ValueError
            If every candidate failed or was unstable on some fold.
        """
        good = self._comparable()
        if len(good) == 0:
            raise ValueError(
                "every candidate failed or was unstable on some fold, so there is no score to "
                "draw; see why with error_score='raise', or search over smaller orders"
            )
        self._panels(ax, (6.4, 4.0))
        self._draw_lines(good, misfit)
        best = good.loc[good["score"].idxmax()]
        style = {"color": GREY, "ls": "--", "lw": 1.0, "label": "one standard error from the best"}
        self.limit_ = self.ax_.axhline(_shown(best["score"] - best["error"], misfit), **style)
        self.chosen_ = None
        if self.chosen is not None and self.chosen in good.index:
            place = self._places[self.chosen], _shown(good.loc[self.chosen, "score"], misfit)
            style = {"color": BLACK, "mfc": "none", "ms": 14, "mew": 1.5, "ls": ""}
            (self.chosen_,) = self.ax_.plot(*place, "o", label="chosen", **style)
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
        """Candidates with scores that one axis can show: beside lower ones, the others would
        be one line."""
        good = self.results[np.isfinite(self.results["score"])]
        best = good["score"].max()
        return good[good["score"] > best - 10.0 * max(1.0, abs(best))]

    def _draw_lines(self, good, misfit):
        orders = sorted(set(self.results["order"]))
        step = np.min(np.diff(orders)) if len(orders) > 1 else 1
        groups = list(dict.fromkeys(self.results["block_rows"]))
        shifts = 0.05 * step * (np.arange(len(groups)) - 0.5 * (len(groups) - 1))
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
            style |= {"label": "failed or unstable on some fold"}
            orders, bottom = sorted(set(failed)), self.ax_.get_xaxis_transform()
            (self.failed_,) = self.ax_.plot(
                orders, [0.0] * len(orders), "x", transform=bottom, **style
            )


def _shown(score, misfit):
    return 1.0 - score if misfit else score


def _values(cv_results, name, parameter):
    """Values of a parameter for each candidate; None where it was not searched."""
    keys = searched_as(cv_results, name, parameter)
    return [params.get(keys[0]) for params in cv_results["params"]] if keys else None


class ConvergenceDisplay(Display):
    """Error of a match by iteration, its stages told apart.

    Parameters
    ----------
    history : DataFrame, shape (n_iterations, 2)
        ``history_`` of a StructuredMatcher: the columns stage (text) and error (relative,
        in the norm that the stage minimises), by iteration.

    Attributes
    ----------
    ax_ : Axes
    figure_ : Figure
    lines_ : dict of list of Line2D
        Of each stage; one line a run of it.
    end_ : Text
        Says the last error.

    Raises
    ------
    ValueError
        If a column is missing, or the history is empty.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 22.

    Examples
    --------
    >>> import pandas as pd
    >>> history = pd.DataFrame(
    ...     {"stage": ["least squares"] * 2 + ["H-infinity"] * 2, "error": [1, 0.1, 0.08, 0.05]}
    ... )
    >>> display = ConvergenceDisplay(history).plot()
    >>> list(display.lines_)
    ['least squares', 'H-infinity']
    """

    def __init__(self, history):
        columns = getattr(history, "columns", ())
        missing = [name for name in ("stage", "error") if name not in columns]
        if missing:
            raise ValueError(
                f"history lacks the column {missing[0]!r}; give a DataFrame with the columns "
                f"['stage', 'error'], as StructuredMatcher.history_"
            )
        if len(history) == 0:
            raise ValueError(
                "history is empty: nothing was minimised in a norm, because the match is exact, in "
                "closed form, or by a likelihood (whose number of iterations is n_iter_)"
            )
        self.history = history

    @classmethod
    def from_estimator(cls, estimator, *, ax=None):
        """Draw the history of a fitted matcher.

        Parameters
        ----------
        estimator : StructuredMatcher, or Pipeline or search that holds one
            Fitted.

        Raises
        ------
        ValueError
            If nothing was minimised.
        """
        return cls(fitted_step(estimator, StructuredMatcher, cls.__name__).history_).plot(ax=ax)

    def plot(self, ax=None):
        """Draw, on a new figure by default."""
        self._panels(ax, (6.4, 4.0))
        error = self.history["error"].to_numpy(dtype=float)
        iteration = self.history.index.to_numpy()
        stages = self.history["stage"].astype(str).tolist()
        names = list(dict.fromkeys(stages))
        styles = dict(zip(names, looks(POINTS, len(names)), strict=True))
        self.lines_ = {name: [] for name in names}
        drawn, start = _above_zero(error), 0
        for name, run in groupby(stages):
            stop = start + len(list(run))
            label = None if self.lines_[name] else name
            span = slice(start, stop)  # not joined: each stage has a norm of its own
            style = styles[name] | {"ms": 5, "lw": 1.3, "label": label}
            self.lines_[name] += self.ax_.semilogy(iteration[span], drawn[span], **style)
            start = stop
        style = {"textcoords": "offset points", "va": "center", "fontsize": 9}
        last = iteration[-1], drawn[-1]
        self.end_ = self.ax_.annotate(number(error[-1]), last, xytext=(6, 0), **style)
        dress(self.ax_, x="iteration (–)", y="relative error, in the norm of the stage (–)")
        self.ax_.xaxis.get_major_locator().set_params(integer=True)
        self.ax_.margins(x=0.08)
        self.ax_.legend(**LEGEND)
        return self


def _above_zero(error):
    """Errors as a logarithmic axis can show them: zeros well below the others."""
    positive = error[error > 0.0]
    least = 0.01 * positive.min() if len(positive) else np.finfo(float).eps
    return np.maximum(error, least)
