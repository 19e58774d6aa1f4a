"""What all displays share: docstrings, panels, looks, and the fitted steps and records behind them.

Okabe and Ito's palette is told apart by colour-blind readers. Nothing is told by colour
alone: lines differ in dashes, points in their markers, bars in their hatches.
"""

import inspect
import math
import re
from itertools import cycle, islice

import control
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.gridspec import GridSpec, GridSpecFromSubplotSpec
from scipy.stats import norm
from sklearn.frozen import FrozenEstimator
from sklearn.pipeline import Pipeline
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import FIRST, check_span
from sklearn_hd._clock import read_time
from sklearn_hd._frame import SampleModel
from sklearn_hd._model_step import ModelStep
from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.subspace import MOESPRegressor
from sklearn_hd.systems import LTPSystem

BLACK, GREY, LIGHT = "#000000", "#8A8A8A", "#E4E4E4"
ORANGE, SKY, GREEN, BLUE, RED, PURPLE = (
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
REFERENCE = {"color": GREY, "lw": 3.0, "ls": "-", "alpha": 0.7}  # measured, or true
LINES = (
    {"color": BLUE, "lw": 1.5, "ls": "-"},
    {"color": RED, "lw": 1.5, "ls": (0, (4, 2))},
    {"color": GREEN, "lw": 1.5, "ls": (0, (5, 1, 1, 1))},
    {"color": PURPLE, "lw": 1.7, "ls": (0, (1, 1))},
    {"color": BLACK, "lw": 1.1, "ls": (0, (7, 2))},
    {"color": ORANGE, "lw": 1.5, "ls": (0, (3, 1, 1, 1, 1, 1))},
)
POINTS = (
    {"color": BLUE, "marker": "o", "ls": "-"},
    {"color": RED, "marker": "s", "ls": (0, (4, 2))},
    {"color": GREEN, "marker": "^", "ls": (0, (5, 1, 1, 1))},
    {"color": PURPLE, "marker": "D", "ls": (0, (1, 1))},
    {"color": BLACK, "marker": "v", "ls": (0, (7, 2))},
    {"color": ORANGE, "marker": "P", "ls": (0, (3, 1, 1, 1, 1, 1))},
)
BARS = (
    {"color": BLUE, "edgecolor": "white"},
    {"color": ORANGE, "edgecolor": "white", "hatch": "//"},
    {"color": GREEN, "edgecolor": "white", "hatch": ".."},
    {"color": PURPLE, "edgecolor": "white", "hatch": "xx"},
    {"color": SKY, "edgecolor": "white", "hatch": "\\\\"},
    {"color": GREY, "edgecolor": "white", "hatch": "++"},
)
SMALLEST = 6.0  # points, of letters
MOST_PAIRS = 24  # of signals: four columns of six; with more, drawing takes minutes
LEVEL = 0.95
REACH = norm.ppf(0.5 + 0.5 * LEVEL)  # standard deviations to either side
CONFIDENCE, NARROW = f"{100 * LEVEL:g} % confidence", 2.0  # points: a line's width, 1.5, and edges
TIME, SAMPLES = "time (s)", "sample (–)"
FREQUENCY = "frequency (rad/s)"
REAL, IMAGINARY = "real part (1/s)", "imaginary part (rad/s)"
LEGEND = {"fontsize": 9, "edgecolor": "none", "framealpha": 0.8}  # readable over what it covers
NAMES = {ModelStep: "MOESPRegressor, SpuriousModeReducer or StructuredMatcher"}
RESPONSES = {"BodeDisplay": "frequency response", "StepResponseDisplay": "step response"}
SHARED = {  # parameters that mean the same wherever they occur
    "record": "label, optional\n    Which record of a (record, time) index; the first by default.",
    "span": "(float, float), optional\n    Seconds to draw.",
    "units": "dict, optional\n    Unit of each signal, for the labels.",
    "ax": "Axes, optional\n    Those of a new figure by default.",
}
SEVERAL = (
    "Axes or array of Axes, optional\n    {}, or one that is divided;\n    a new figure by default."
)
UNFITTED = (
    "TypeError\n    If the estimator is, or holds, no such step.\n"
    "NotFittedError\n    If it has not been fitted."
)


class Display:
    """Base of the displays: completes the docstrings of their public methods.

    A parameter is described once: in the first method that takes it, in the class, or in
    ``SHARED``. What is returned, and what an estimator that does not fit raises, are added.
    ``axes`` says how many Axes a display with several draws on, and what each shows.
    """

    _several = None

    def __init_subclass__(cls, axes=None):
        cls._several = axes
        members = [getattr(member, "__func__", member) for member in vars(cls).values()]
        methods = [
            method
            for method in members
            if inspect.isfunction(method) and not method.__name__.startswith("_") and method.__doc__
        ]
        known = {name: f"{name} : {text}" for name, text in SHARED.items()}
        if axes is not None:
            known["ax"] = f"ax : {SEVERAL.format(axes[0].upper() + axes[1:])}"
        for described in [cls, *reversed(methods)]:
            known |= _described(described)
        for method in methods:
            method.__doc__ = cls._completed(method, known | _described(method))

    @classmethod
    def _completed(cls, method, known):
        """The docstring of a method with what it shares with others."""
        summary, sections = _sections(method)
        names = list(inspect.signature(method).parameters)[1:]
        entries = dict.fromkeys(known[name] for name in names)
        sections["Parameters"] = "----------\n" + "\n".join(entries)
        sections["Returns"] = (
            f"-------\ndisplay : {cls.__name__}\n    Drawn; what it draws stands in its attributes."
        )
        if method.__name__ == "from_estimator":
            others = sections.get("Raises", "------").removeprefix("------")
            sections["Raises"] = f"------\n{UNFITTED}{others}"
        order = [name for name in ("Parameters", "Returns", "Raises") if name in sections]
        return "\n\n".join([summary, *(f"{name}\n{sections[name]}" for name in order)]) + "\n"

    def _panels(self, ax, size, cells=((0, 0),), **grid):
        """Panels to draw on, kept as ``ax_`` or ``axes_`` and ``figure_``."""
        panels = Panels(ax, cells, size=size, names=self._several, **grid)
        self.figure_ = panels.figure
        if self._several is None:
            self.ax_ = panels.axes[0]
        else:
            self.axes_ = panels.axes
        return panels


def _sections(described):
    """Text above the sections of a docstring, and the sections by name."""
    text = inspect.cleandoc(described.__doc__ or "")
    summary, *parts = re.split(r"\n\n(?=[A-Z]\w+\n-{4,}\n)", text)
    return summary, dict(part.split("\n", 1) for part in parts)


def _described(described):
    """Entries of the section on parameters, by each name that they describe."""
    entries = re.split(r"\n(?=\S)", _sections(described)[1].get("Parameters", ""))[1:]
    return {name: e for e in entries for name in re.findall(r"\w+", re.split(r" : |\n", e)[0])}


class Panels:
    """The ``axes`` of a display on its ``figure``, which is its ``own`` if it was made here.

    ``ax`` None makes a figure of some size in inches; one Axes is divided where more than one
    panel is needed; an array holds one Axes a panel. ``cells`` has the row and column of each
    panel, ``heights`` are those of rows, relative, ``share_x`` and ``share_y`` ("all", "row" or
    None) say which panels have one axis, and ``names`` is what they show, for errors.
    """

    def __init__(self, ax, cells, *, size, heights=None, share_x=None, share_y=None, names=None):
        self.own = ax is None
        if ax is None:
            import matplotlib.pyplot as plt

            self.figure = plt.figure(figsize=size, layout="constrained")
            self.axes = self._divide(None, cells, heights, share_x, share_y)
            return
        given = np.asarray(ax, dtype=object).ravel()
        wrong = [item for item in given if not isinstance(item, Axes)]
        if wrong:
            raise TypeError(
                f"ax={wrong[0]!r} is not a matplotlib Axes; give one, an array of {len(cells)}, or "
                f"None for a new figure"
            )
        self.figure = given[0].figure
        if len(given) == len(cells):
            self.axes = given
        elif len(given) == 1:
            self.axes = self._divide(given[0], cells, heights, share_x, share_y)
        else:
            raise ValueError(
                f"ax holds {len(given)} Axes, but {len(cells)} panels are drawn"
                f"{'' if names is None else f' ({names})'}; give {len(cells)}, or one to be divided"
            )

    def _divide(self, ax, cells, heights, share_x, share_y):
        shape = tuple(1 + max(place) for place in zip(*cells, strict=True))
        if ax is None:
            grid = GridSpec(*shape, figure=self.figure, height_ratios=heights)
        elif ax.get_subplotspec() is None:
            raise ValueError(
                f"this Axes is not in a grid of subplots, so it cannot be divided into the "
                f"{len(cells)} panels needed; make it with plt.subplots, or give {len(cells)} Axes"
            )
        else:
            ax.set_axis_off()
            grid = GridSpecFromSubplotSpec(
                *shape, subplot_spec=ax.get_subplotspec(), height_ratios=heights
            )
        axes = []
        for place in cells:
            shared = {
                "sharex": _partner(share_x, place, cells, axes),
                "sharey": _partner(share_y, place, cells, axes),
            }
            axes.append(self.figure.add_subplot(grid[place], **shared))
        for ax_, place in zip(axes, cells, strict=True):
            if share_x == "all" and any(c == place[1] and r > place[0] for r, c in cells):
                ax_.tick_params(labelbottom=False)
        return np.array(axes, dtype=object)

    def legend(self, handles=None, *, columns=4, fallback=0):
        """One legend for all panels: below them, or in one of them where the figure is given."""
        if handles is None:
            handles = self.axes[fallback].get_legend_handles_labels()[0]
        if not handles:
            return None
        options = {"handles": handles, **LEGEND}
        if not self.own:
            return self.axes[fallback].legend(**options)
        for count in range(min(columns, len(handles)), 0, -1):  # as many as the figure is wide
            legend = self.figure.legend(loc="outside lower center", ncols=count, **options)
            if count == 1 or legend.get_window_extent().width <= self.figure.bbox.width:
                return legend
            legend.remove()


def _partner(share, place, cells, axes):
    """The first Axes made with which the one at some place shares an axis."""
    for (row, _), ax in zip(cells, axes, strict=False):
        if share == "all" or (share == "row" and row == place[0]):
            return ax
    return None


def grid_of(count, *, most=None):
    """Rows and columns for some panels: a stack of up to three, then two, three, four columns."""
    if most is None:
        most = 1 if count <= 3 else 2 if count <= 8 else 3
    columns = min(most, count)
    return math.ceil(count / columns), columns


def places(count, columns):
    """Places of some panels in a grid, row by row."""
    return [divmod(k, columns) for k in range(count)]


def looks(styles, count):
    """As many styles as there are things to draw; the first come again after the last."""
    return list(islice(cycle(styles), count))


def line_styles(labels, reference=None):
    """A style for each label, broad and grey for that of the truth."""
    own = [label for label in labels if label != reference]
    styles = dict(zip(own, looks(LINES, len(own)), strict=True))
    return styles if reference is None else styles | {reference: REFERENCE | {"lw": 4.0}}


def dress(ax, *, x=None, y=None, title=None, small=False):
    """Labels, a faint grid below the data, no frame at the top and on the right."""
    size = {"fontsize": 8} if small else {}
    if x is not None:
        ax.set_xlabel(x, **size)
    if y is not None:
        _beside(ax, y, **size)
    if title is not None:
        ax.set_title(title, loc="left", fontsize=8 if small else 10.5)
    if small:
        ax.tick_params(labelsize=8)
    ax.grid(True, color=LIGHT, lw=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _beside(ax, words, **size):
    """Label the y axis: the unit below, and in smaller letters, where the axis is shorter."""
    label = ax.set_ylabel(words, **size)

    def too_long():
        return label.get_window_extent().height > ax.bbox.height

    before, unit, rest = words.rpartition(" (")
    if too_long() and unit:
        label.set_text(f"{before}\n({rest}")
    while too_long() and label.get_fontsize() > SMALLEST:
        label.set_fontsize(label.get_fontsize() - 0.5)


def with_unit(name, units):
    """``w (m/s)`` where the unit of w is known, or that of the signal that w_0 belongs to."""
    unit = unit_of(name, units)
    return str(name) if unit is None else f"{name} ({unit})"


def unit_of(name, units):
    """Unit of a signal, or of a coefficient of it; None where none was given."""
    if units is not None and not isinstance(units, dict):
        raise TypeError(
            f"units={units!r} is not a dict; give the unit of each signal, as {{'w': 'm/s'}}"
        )
    signal = str(name).rsplit("_", 1)[0]
    return (units or {}).get(name, (units or {}).get(signal))


def number(value, digits=3):
    """Some digits as print has them: 7.8e8, −0.5."""
    words, _, power = f"{value:.{digits}g}".partition("e")
    return (f"{words}e{int(power)}" if power else words).replace("-", "−")


def is_real(value):
    """Whether the imaginary part of an eigenvalue is rounding."""
    return abs(value.imag) <= 1e-9 * abs(value)


def complex_number(value):
    """An eigenvalue, or the pair that it stands for, in words of a legend."""
    if is_real(value):
        return f"{number(value.real)} 1/s"
    return f"{number(value.real)} ± {number(abs(value.imag))}j 1/s"


def unbroken(signal, segments, span=None):
    """Times and values of a Series, a NaN between the segments, so that lines do not cross gaps.

    With ``span`` only those within it.
    """
    time, values = signal.index.to_numpy(), signal.to_numpy()
    times, parts = [], []
    for segment in segments:
        times += [time[segment], [np.nan]]
        parts += [values[segment], [np.nan]]
    times, parts = np.concatenate(times[:-1]), np.concatenate(parts[:-1])
    if span is None:
        return times, parts
    start, stop = check_span("span", span)
    shown = ~((times < start) | (times > stop))  # the breaks, too
    if not np.any(np.isfinite(times[shown])):
        raise ValueError(
            f"span=({start:g}, {stop:g}) contains no row; rows lie from t = {time[0]:.6g} s to "
            f"{time[-1]:.6g} s, so give times within"
        )
    return times[shown], parts[shown]


def steps_of(estimator):
    """The steps behind an estimator, last first: of pipelines, searches and meta-estimators."""
    if isinstance(estimator, Pipeline):
        for _, step in reversed(estimator.steps):
            yield from steps_of(step)
    elif isinstance(estimator, FrozenEstimator):
        yield from steps_of(estimator.estimator)
    elif hasattr(estimator, "cv") and hasattr(estimator, "refit"):
        check_is_fitted(estimator, "best_estimator_")
        yield from steps_of(estimator.best_estimator_)
    else:
        yield estimator
        inner = getattr(estimator, "estimator_", None)
        if inner is not None:
            yield from steps_of(inner)


def find_step(estimator, kinds):
    """The last step of some kinds, or None; NotFittedError where it is not fitted."""
    step = next((step for step in steps_of(estimator) if isinstance(step, kinds)), None)
    if step is not None:
        check_is_fitted(step)
    return step


def fitted_step(estimator, kinds, display):
    """The last step of some kinds; TypeError where there is none."""
    if isinstance(estimator, type):
        raise TypeError(
            f"{display} needs a fitted estimator, but {estimator.__name__} is a class; give a "
            f"fitted instance"
        )
    step = find_step(estimator, kinds)
    if step is None:
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        names = " or ".join(NAMES.get(kind, kind.__name__) for kind in kinds)
        raise TypeError(
            f"{display} needs a fitted {names}, or a Pipeline or search that holds one; "
            f"{type(estimator).__name__} holds none"
        )
    return step


class Record:
    """One record, the first by default: its ``rows`` (a mask) and their ``time`` in seconds.

    ``segments`` are slices of its consecutive rows, ``label`` and ``title`` name it (None where
    there is but one record), ``axis`` is what the time axis is called.
    """

    def __init__(self, data, record=None, timing=None):
        step = None if timing is None else timing.sample_time
        origin = FIRST if timing is None or timing.time_origin is None else timing.time_origin
        base = read_time(data, step, origin)
        self.rows, self.label = _rows_of(getattr(data, "index", None), len(data), record)
        place = np.cumsum(self.rows) - 1
        inside = [segment for segment in base.segments if self.rows[segment.start]]
        self.segments = [slice(place[s.start], place[s.stop - 1] + 1) for s in inside]
        self.time = base.time[self.rows]
        self.axis = SAMPLES if base.counted and step in (None, 1.0) else TIME
        self.title = None if self.label is None else f"record {self.label}"


def _rows_of(index, n_rows, record):
    if not isinstance(index, pd.MultiIndex):
        if record is not None:
            raise ValueError(
                f"record={record!r} was given, but the data have no (record, time) index; leave "
                f"record=None"
            )
        return np.ones(n_rows, dtype=bool), None
    labels = index.droplevel(-1)
    wanted = labels[0] if record is None else record
    rows = np.array([label == wanted for label in labels])
    if not rows.any():
        known = list(dict.fromkeys(labels))
        raise ValueError(f"record={record!r} is not among the records {known[:10]}")
    return rows, wanted


def by_label(given, default):
    """A dict of things to draw by label, from one thing or a dict."""
    return dict(given) if isinstance(given, dict) else {default: given}


def by_segment(experiment, parts, names):
    """Values of each segment of an experiment as one DataFrame by segment and seconds."""
    tables = [
        pd.DataFrame(values, pd.Index(time, name="time"), names)
        for values, time in zip(parts, experiment.times(), strict=True)
    ]
    return pd.concat(tables, keys=range(len(tables)), names=["record"])


def chosen(wanted, names, what):
    """Places of the signals to draw."""
    if wanted is None:
        return range(len(names))
    wanted = [wanted] if isinstance(wanted, str) else list(wanted)
    unknown = [name for name in wanted if name not in names]
    if unknown or not wanted:
        raise ValueError(f"{what}={wanted} are not all among {names}; give some of these")
    return [names.index(name) for name in wanted]


def chosen_pairs(inputs, outputs, display):
    """Places of (output, input) of the panels, rows and columns for them, and words for the title.

    Where there are more than ``MOST_PAIRS``, signals that were not asked for are left out: higher
    harmonics first, then the last signals. The words say so; they are empty where all are drawn.
    """
    names = display.input_names, display.output_names
    shown = [chosen(inputs, names[0], "inputs"), chosen(outputs, names[1], "outputs")]
    free = [k for k, wanted in enumerate((inputs, outputs)) if wanted is None]
    count, words = _count(shown), ""
    if free and count > MOST_PAIRS:
        for k in free:
            shown[k] = _of_lowest_harmonics(names[k])
        words = "each signal" if _count(shown) <= MOST_PAIRS else "the first signals"
        if _count(shown) < count:
            words = f"the lowest harmonic of {words}"
        for k in free:  # inputs first: of each, as many outputs as there is room for
            others = 1 if k == 0 and len(free) == 2 else len(shown[1 - k])
            shown[k] = shown[k][: max(1, MOST_PAIRS // others)]
        words = f"{_count(shown)} of {count} pairs: {words}\n"
    pairs = [(o, i) for i in shown[0] for o in shown[1]]
    return pairs, grid_of(len(pairs), most=3 if len(pairs) <= 6 else 4), words


def _count(shown):
    return len(shown[0]) * len(shown[1])


def _of_lowest_harmonics(names):
    """Places of the coefficients of each signal's lowest harmonic; all if one is no coefficient."""
    parts = [re.fullmatch(r"(.+)_(?:0|([1-9]\d*)[cs])", name) for name in names]
    if not all(parts):
        return list(range(len(names)))
    found = [(part[1], int(part[2] or 0)) for part in parts]
    lowest = {signal: min(k for s, k in found if s == signal) for signal, _ in found}
    return [place for place, (signal, k) in enumerate(found) if k == lowest[signal]]


def periodic_system(estimator, display):
    """The linear time-periodic system that a fitted estimator has identified."""
    step = find_step(estimator, (StructuredMatcher, MOESPRegressor))
    if isinstance(step, MOESPRegressor) and isinstance(step.model_, SampleModel):
        return step.ltp_
    matcher = fitted_step(estimator, StructuredMatcher, display)
    if not hasattr(matcher, "ltp_"):
        raise ValueError(
            f"{display} needs a linear time-periodic model, but this match was made with "
            f"structure={matcher.structure!r}; fit with a HarmonicStructure, or with "
            f"HarmonicAnalyzer(reading='period')"
        )
    return matcher.ltp_


def step_of_samples(estimator, what):
    """The MOESPRegressor of an estimator, whose model is one of samples at their azimuths."""
    step = fitted_step(estimator, MOESPRegressor, what)
    if not isinstance(step.model_, SampleModel):
        raise ValueError(
            f"{what} needs a model of samples at their azimuths, but this one was fitted with "
            f"reading={step.basis_.reading!r}; fit behind HarmonicAnalyzer(reading='sample')"
        )
    return step


def check_periodic(system, display, label=None):
    """Raise TypeError unless a system is linear time-periodic."""
    if not isinstance(system, LTPSystem):
        what = "this" if label is None else repr(label)
        raise TypeError(f"{display} draws LTPSystems; {what} is of type {type(system).__name__}")


def invariant_steps(estimator, display):
    """Fitted model steps by label, whose models have one response at every azimuth."""
    steps = {
        label: fitted_step(model, ModelStep, display)
        for label, model in by_label(estimator, "identified").items()
    }
    for label, step in steps.items():
        if isinstance(step.model_, SampleModel) and not step.model_.time_invariant:
            raise ValueError(
                f"{label!r} varies over the turn, with {step.model_.innovations.n_harmonics} "
                f"harmonic(s), so it has no single {RESPONSES[display]}; use "
                f"HarmonicTransferFunctionDisplay or AzimuthDisplay, or fit with "
                f"output_harmonics=0"
            )
    return steps


def compared_names(step):
    """Names of the outputs that ``score`` compares; of harmonics, the signals that they make up."""
    return list(dict(step.basis_.outputs) if step.predicts_harmonics_ else step.target_names_)


def has_confidence(step):
    """Whether a fitted step knows the covariance of its parameters."""
    return isinstance(step, StructuredMatcher) and hasattr(step, "eigenvalues_")


def between_same_signals(systems, true, display):
    """Models by label, the truth first, all control.StateSpace; and the signals they share."""
    models = dict(systems)
    systems = models if true is None else {"true": true, **models}
    for label, system in systems.items():
        if not isinstance(system, control.StateSpace):
            raise TypeError(
                f"{display} draws control.StateSpace models; {label!r} is of type "
                f"{type(system).__name__} (an LTPSystem gives one by harmonic_decomposition)"
            )
    first = next(iter(models.values()))
    names = first.input_labels, first.output_labels
    for label, system in systems.items():
        own = system.input_labels, system.output_labels
        more = label not in models and all(map(set.issuperset, map(set, own), names))
        if own != names and not more:
            raise ValueError(
                f"{label!r} has the inputs {system.input_labels} and outputs "
                f"{system.output_labels}, but the others have {names[0]} and {names[1]}; give "
                f"models between the same signals"
            )
    return systems, names


def matrices_between(system, inputs, outputs):
    """(A, B, C, D) of a system between some of its signals, by name."""
    columns = [system.input_labels.index(name) for name in inputs]
    rows = [system.output_labels.index(name) for name in outputs]
    return system.A, system.B[:, columns], system.C[rows], system.D[np.ix_(rows, columns)]


def sample_time(system):
    """Seconds between the samples of a system; 0 in continuous time."""
    return 0.0 if system.dt is None else float(system.dt)


def name_confidence(figure, bands, edges):
    """Name the first band for the legend, which says so where no band is as wide as a line.

    ``edges`` holds the Axes of each band, with its lower and upper values.
    """
    if not bands:
        return
    figure.draw_without_rendering()  # how wide a band is, depends on the layout
    widest = 0.0
    for axis, *sides in edges:
        x = np.full(len(sides[0]), np.mean(axis.get_xlim()))
        low, high = (axis.transData.transform(np.column_stack([x, y]))[:, 1] for y in sides)
        widest = max(widest, np.nanmax(high - low) * 72.0 / axis.figure.dpi)
    bands[0].set_label(CONFIDENCE if widest > NARROW else f"{CONFIDENCE}, narrower than the line")
