"""Measured against simulated responses."""

from dataclasses import KW_ONLY, dataclass
from functools import reduce

import numpy as np
import pandas as pd

from sklearn_hd._checks import check_span, signal_names
from sklearn_hd._containers import to_float
from sklearn_hd._model_step import ModelStep
from sklearn_hd._simulators import scored_simulation
from sklearn_hd.model_selection import fit_percent
from sklearn_hd.model_selection._scorers import last_model_step
from sklearn_hd.plotting._display import (
    BLACK,
    LINES,
    ORANGE,
    REFERENCE,
    TIME,
    Display,
    Record,
    by_label,
    compared_names,
    dress,
    fitted_step,
    grid_of,
    looks,
    number,
    places,
    step_of_samples,
    unbroken,
    with_unit,
)


@dataclass(eq=False, repr=False)
class ResponseDisplay(Display, axes="one Axes an input, then one an output, or two with loads"):
    """Measured outputs and those that models simulate, with the fit of each in percent.

        fit = 100 (1 − ‖y − ŷ‖ / ‖m − m̄‖)

    The fit is that of the motion m, as in ``score``: y less what repeats from turn to turn while
    inputs stand at their mean. A model of samples knows this part, its loads. Then what an output
    is made of can be drawn below it: loads, the response to the inputs (simulation less loads),
    and the residual (measured less simulation).

    Parameters
    ----------
    measured : DataFrame, shape (n_samples, n_outputs)
        One record, indexed by seconds.
    simulated : dict of DataFrame
        By label, on the same rows.
    inputs : DataFrame, shape (n_rows, n_inputs), optional
        Drawn above the outputs, on times of their own.
    segments : list of slice, optional
        Runs of consecutive rows; lines are broken between them. By default one.
    validation_span : (float, float), optional
        Seconds; rows not used for the fit, shaded, with a fit of their own.
    axis : str, default="time (s)"
        Label of the time axis.
    title : str, optional
        Above the first panel.
    measured_name : str, default="measured"
        What the legend calls the measured outputs.
    loads : DataFrame, shape (n_samples, n_outputs), optional
        Periodic outputs of the model at the mean of its inputs, on the same rows; goes with one
        model.
    motion : dict of DataFrame, optional
        By label, on the same rows: what the fit of a model is a share of; by default ``measured``.

    Attributes
    ----------
    fit_ : DataFrame, shape (n_models, n_outputs)
        Percent, of all rows drawn outside the validation span.
    validation_fit_ : DataFrame or None
        The same within the validation span.
    parts_ : dict of DataFrame
        Loads, response to the inputs and residual, where loads are drawn.
    axes_ : ndarray of Axes, shape (n_inputs + n_outputs,)
        Of the inputs, then of the outputs, then of the parts of each output where there are loads.
    figure_ : Figure
    measured_lines_ : dict of Line2D
        By output.
    simulated_lines_ : dict of Line2D
        By label and output.
    input_lines_ : dict of Line2D
    part_lines_ : dict of Line2D
        By what the part is and output.
    spans_ : list
        Shading of the validation span in each panel.
    legend_ : Legend
    part_legend_ : Legend or None
        Of the parts, on Axes that were given.

    Raises
    ------
    ValueError
        If loads are given beside several models.

    References
    ----------
    Ljung (1999), System Identification, section 16.4.

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> t = pd.Index(np.arange(200) / 50, name="time")
    >>> y = pd.DataFrame({"y": np.exp(-t) * np.cos(6 * t)}, index=t)
    >>> display = ResponseDisplay.from_data(y, {"model": 0.9 * y}, validation_span=(2, 4))
    >>> display.axes_[0].get_title("left")
    'fit of y: 90.0 %, validation 89.9 %'
    """

    measured: pd.DataFrame
    simulated: dict
    _: KW_ONLY
    inputs: pd.DataFrame | None = None
    segments: list | None = None
    validation_span: tuple | None = None
    axis: str = TIME
    title: str | None = None
    measured_name: str = "measured"
    loads: pd.DataFrame | None = None
    motion: dict | None = None

    def __post_init__(self):
        self.segments = self.segments or [slice(0, len(self.measured))]
        self.motion = self.motion or dict.fromkeys(self.simulated, self.measured)
        self.parts_ = {}
        if self.loads is not None:
            if len(self.simulated) != 1:
                raise ValueError(
                    f"loads belong to one model, but {len(self.simulated)} are drawn: "
                    f"{list(self.simulated)}; give one, or no loads"
                )
            (simulated,) = self.simulated.values()
            self.parts_ = {
                "loads": self.loads,
                "response to the inputs": simulated - self.loads,
                "residual": self.measured - simulated,
            }

    @classmethod
    def from_estimator(
        cls,
        estimator,
        X,
        y,
        *,
        record=None,
        validation_span=None,
        span=None,
        show_inputs=True,
        loads=False,
        units=None,
        ax=None,
    ):
        """Simulate a fitted model as its ``score`` does, and draw it beside the record.

        The initial state of each segment is fitted on its first ``warmup`` seconds, which
        are not drawn; the periodic trim is taken from both.

        Parameters
        ----------
        estimator : model step of sklearn_hd, or Pipeline or search that ends in one
            Fitted. Several, in a dict by label, are drawn together.
        X : DataFrame, Series or ndarray, shape (n_samples, n_inputs)
            Inputs.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Measured outputs, on the same rows.
        validation_span : (float, float), optional
            Seconds; rows not used for the fit.
        span : (float, float), optional
            Seconds to draw; the fit is that of all rows all the same.
        show_inputs : bool, default=True
            Whether to draw the inputs above the outputs.
        loads : bool, default=False
            Whether to draw below each output its loads, its response to the inputs and the
            residual, of a model fitted behind ``HarmonicAnalyzer(reading="sample")``.

        Raises
        ------
        ValueError
            If no rows of the record can be scored, or the loads are asked for of a model that has
            none.
        """
        estimators = by_label(estimator, "simulated")
        runs = {label: _simulate(model, X, y, cls.__name__) for label, model in estimators.items()}
        step = next(iter(runs.values()))[0]
        whole = Record(X, record, step.basis_.timing)
        rows = _rows_of_all([run[-1] for run in runs.values()], whole)
        names = compared_names(step)
        time = np.full(len(whole.rows), np.nan)
        time[whole.rows] = whole.time
        index = pd.Index(time[rows], name="time")
        motion, simulated, periodic = (
            {
                label: pd.DataFrame(run[part][np.searchsorted(run[-1], rows)], index, names)
                for label, run in runs.items()
            }
            for part in (1, 2, 3)
        )
        first = next(iter(runs))
        measured = motion[first] + periodic[first]
        if loads:
            step_of_samples(estimators[first], cls.__name__)
        inputs = None
        if show_inputs:
            azimuth = step.basis_.timing.azimuth
            inputs = _table(X, "X", "x", whole).drop(columns=[azimuth], errors="ignore")
        display = cls(
            measured,  # about the first model's trim; what others leave is about their own
            {label: measured - (motion[label] - table) for label, table in simulated.items()},
            inputs=inputs,
            segments=_runs(rows),
            validation_span=validation_span,
            axis=whole.axis,
            title=whole.title,
            loads=periodic[first] if loads else None,
            motion=motion,
        )
        return display.plot(ax=ax, span=span, units=units)

    @classmethod
    def from_data(
        cls,
        measured,
        simulated,
        *,
        inputs=None,
        record=None,
        validation_span=None,
        span=None,
        units=None,
        measured_name="measured",
        ax=None,
    ):
        """Draw outputs that are at hand.

        Parameters
        ----------
        measured : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            In time, one record or several.
        simulated : the same, or a dict of them by label
            On the same rows.
        inputs : DataFrame, Series or ndarray, shape (n_samples, n_inputs), optional
            On the same rows, drawn above the outputs.
        measured_name : str, default="measured"
            What the legend calls the measured outputs.

        Raises
        ------
        ValueError
            If rows or outputs differ.
        """
        whole = Record(measured, record)
        truth = _table(measured, "measured", "y", whole)
        models = {}
        for label, values in by_label(simulated, "simulated").items():
            _check_alike(measured, values, label)
            models[label] = _table(values, f"simulated {label!r}", "y", whole)
            models[label].columns = truth.columns
        if inputs is not None:
            _check_alike(measured, inputs, "inputs", columns=False)
            inputs = _table(inputs, "inputs", "x", whole)
        display = cls(
            truth,
            models,
            inputs=inputs,
            segments=whole.segments,
            validation_span=validation_span,
            axis=whole.axis,
            title=whole.title,
            measured_name=measured_name,
        )
        return display.plot(ax=ax, span=span, units=units)

    def plot(self, ax=None, *, span=None, units=None):
        """Draw, on a new figure by default."""
        self._score()
        inputs = [] if self.inputs is None else list(self.inputs)
        outputs = list(self.measured)
        panels, bottom = self._stacked(ax, len(inputs), len(outputs))
        self.input_lines_, self.measured_lines_, self.simulated_lines_ = {}, {}, {}
        self.part_lines_, self.part_legend_, self.spans_ = {}, None, []
        split = len(inputs) + len(outputs)
        for name, axis in zip(inputs, self.axes_[: len(inputs)], strict=True):
            style = {"color": BLACK, "lw": 1.2, "drawstyle": "steps-post"}
            drawn = unbroken(self.inputs[name], [slice(None)], span)
            self.input_lines_[name] = axis.plot(*drawn, **style)[0]
            dress(axis, y=with_unit(name, units))
        for name, axis in zip(outputs, self.axes_[len(inputs) : split], strict=True):
            self._draw(name, axis, span, units)
        for name, axis in zip(outputs if self.parts_ else [], self.axes_[split:], strict=True):
            self._draw_parts(name, axis, span, units)
        for axis in self.axes_:
            self._shade(axis, span)
        for k in bottom:
            self.axes_[k].set_xlabel(self.axis)
        if self.title is not None:
            first = self.axes_[0]
            first.set_title(
                "  ".join(filter(None, (self.title, first.get_title("left")))), loc="left"
            )
        handles = self.axes_[len(inputs)].get_legend_handles_labels()[0]
        of_parts = [self.part_lines_[what, outputs[0]] for what in self.parts_]
        if panels.own:
            handles += of_parts
        else:
            self.part_legend_ = panels.legend(of_parts, fallback=split)
        self.legend_ = panels.legend(handles, columns=5, fallback=len(inputs))
        return self

    def _stacked(self, ax, n_inputs, n_outputs):
        """Panels of inputs and outputs, and which of them stand at the bottom."""
        rows, columns = grid_of(n_outputs)
        above, each = -(-n_inputs // columns), 2 if self.parts_ else 1
        cells = places(n_inputs, columns)
        for part in range(each):
            cells += [(each * r + part + above, c) for r, c in places(n_outputs, columns)]
        rows *= each
        size = max(7.0, 4.3 * columns), 0.9 + 0.9 * above + max(1.5, 2.4 - 0.3 * rows) * rows
        heights = [0.5] * above + [1.0] * rows
        panels = self._panels(ax, size, cells, heights=heights, share_x="all")
        lowest = {c: max(r for r, other in cells if other == c) for _, c in cells}
        return panels, [k for k, (r, c) in enumerate(cells) if lowest[c] == r]

    def _score(self):
        """Fit in percent of each model and output, within and outside the validation span."""
        index, names = list(self.simulated), list(self.measured)
        inside = np.zeros(len(self.measured), dtype=bool)
        if self.validation_span is not None:
            start, stop = check_span("validation_span", self.validation_span)
            time = self.measured.index.to_numpy()
            inside = (time >= start) & (time < stop)
            if not inside.any():
                raise ValueError(
                    f"validation_span=({start:g}, {stop:g}) contains no drawn row; rows lie from t "
                    f"= {time[0]:.6g} s to {time[-1]:.6g} s, so give times within"
                )

        def fits(rows):
            values = []
            for label, table in self.simulated.items():
                m, left = self.motion[label][rows], (self.measured - table)[rows]
                values.append(fit_percent(m.to_numpy(), (m - left).to_numpy()))
            return pd.DataFrame(values, index, names)

        self.fit_ = fits(~inside) if not inside.all() else fits(inside)
        self.validation_fit_ = fits(inside) if inside.any() else None

    def _draw(self, name, axis, span, units):
        def line(table, style):
            return axis.plot(*unbroken(table[name], self.segments, span), **style)[0]

        style = REFERENCE | {"lw": 2.6, "label": self.measured_name}
        self.measured_lines_[name] = line(self.measured, style)
        styles = looks(LINES, len(self.simulated))
        for (label, table), look in zip(self.simulated.items(), styles, strict=True):
            style = look | {"lw": 1.2, "label": label}
            self.simulated_lines_[label, name] = line(table, style)
        small = len(self.measured.columns) > 4
        dress(axis, y=with_unit(name, units), title=self._words(name), small=small)

    def _draw_parts(self, name, axis, span, units):
        sizes = []
        for (what, table), look in zip(self.parts_.items(), looks(LINES[1:], 3), strict=True):
            line = unbroken(table[name], self.segments, span)
            self.part_lines_[what, name] = axis.plot(*line, **look | {"label": what})[0]
            sizes.append(number(float(f"{np.std(table[name]):.2g}")))
        words = "std: loads {}, inputs {}, residual {}".format(*sizes)
        small = len(self.measured.columns) > 3
        dress(axis, y=with_unit(name, units), title=words, small=small)

    def _words(self, name):
        """Fit of an output in words; of several models each by its label."""
        lines = [f"fit of {name}: {_percent(self.fit_[name])}"]
        if self.validation_fit_ is not None:
            lines.append(f"validation {_percent(self.validation_fit_[name])}")
        return (", " if len(self.simulated) == 1 else "\n").join(lines)

    def _shade(self, axis, span):
        if self.validation_span is None:
            return
        start, stop = self.validation_span
        if span is not None:
            start, stop = max(start, span[0]), min(stop, span[1])
        if start < stop:
            style = {"color": ORANGE, "alpha": 0.15, "lw": 0, "zorder": 0}
            self.spans_.append(axis.axvspan(start, stop, label="validation", **style))


def _simulate(estimator, X, y, display):
    """Last model step; motion, simulated motion and forced response on the rows scored; those."""
    fitted_step(estimator, ModelStep, display)
    step, handed = last_model_step(estimator, X)
    motion, simulated, rows, forced = scored_simulation(step, handed, y)
    return step, motion, simulated, forced, rows


def _percent(fits):
    """Fits in words: one, several by label, or many in the order of the legend."""
    values = [f"{value:.1f}" for value in fits]
    if len(values) == 1:
        return f"{values[0]} %"
    words = ", ".join(f"{label} {value} %" for label, value in zip(fits.index, values, strict=True))
    return words if len(words) <= 60 else " / ".join(values) + " %, as in the legend"


def _rows_of_all(rows, record):
    """Rows of a record that every model answers for."""
    common = reduce(np.intersect1d, rows)
    common = common[record.rows[common]]
    if len(common) == 0:
        raise ValueError(
            f"no rows of record {record.label!r} can be scored, because it is shorter than one "
            f"analysis window and the warm-up; give a longer record or a smaller warmup"
        )
    return common


def _runs(rows):
    """Slices of consecutive rows."""
    edges = np.flatnonzero(np.diff(rows) != 1) + 1
    return [slice(a, b) for a, b in zip([0, *edges], [*edges, len(rows)], strict=True)]


def _table(data, what, prefix, record):
    """Values of one record as floats, indexed by seconds."""
    values = to_float(data, what)
    values = values.reshape(len(values), -1)[record.rows]
    index = pd.Index(record.time, name="time")
    return pd.DataFrame(values, index, list(signal_names(data, prefix)))


def _check_alike(measured, values, label, columns=True):
    shape, expected = np.shape(values), np.shape(measured)
    if shape[:1] != expected[:1] or (columns and shape != expected):
        raise ValueError(
            f"{label!r} has shape {shape}, but the measured outputs have {expected}; give the same "
            f"rows{' and outputs' if columns else ''}"
        )
    indices = [getattr(data, "index", None) for data in (measured, values)]
    if all(isinstance(index, pd.Index) for index in indices) and not indices[0].equals(indices[1]):
        raise ValueError(
            f"{label!r} and the measured outputs have different indices; align them first"
        )
