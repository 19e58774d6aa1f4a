"""Step and impulse responses of models of harmonics, coefficient by coefficient."""

from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from sklearn_hd._checks import check_positive
from sklearn_hd.algorithms.lti.simulation import continuous_poles, step_response
from sklearn_hd.plotting._display import (
    BLACK,
    REACH,
    TIME,
    Display,
    between_same_signals,
    by_label,
    chosen_pairs,
    dress,
    has_confidence,
    invariant_steps,
    line_styles,
    matrices_between,
    name_confidence,
    places,
    sample_time,
    with_unit,
)


@dataclass(eq=False, repr=False)
class StepResponseDisplay(Display, axes="one Axes for each pair of signals"):
    """Responses to a step or an impulse in each input, from rest.

        step     y(t) = C ∫_0^{t} e^{As} B ds + D,      impulse   y(t) = C e^{At} B

    For models in harmonic-decomposition form the signals are coefficients such as
    U_0 and w_1c; each pair of them has a panel. The impulse has the area one; a continuous
    model with a feedthrough also has an impulse D δ(t) at t = 0, which is not drawn.

    Parameters
    ----------
    times : dict of ndarray, shape (n_times,)
        In seconds, by label.
    responses : dict of ndarray, shape (n_times, n_outputs, n_inputs)
        By label.
    input_names, output_names : sequence of str
        In the order of the responses' last axes.
    std : dict of ndarray, of the same shape, optional
        Standard deviations.
    kind : {"step", "impulse"}, default="step"
        What the inputs are.
    held : set of str, optional
        Labels of discrete models, which are drawn as stairs.
    reference : str, optional
        Label of the response drawn broad and grey: the truth.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (n_pairs,)
        One for each pair of an output and an input.
    figure_ : Figure
    lines_ : dict of Line2D
        By label, output and input.
    bands_ : dict of FillBetweenPolyCollection
        95 % confidence at each time, where standard deviations are known: the covariance of
        the parameters to first order.
    legend_ : Legend or None

    References
    ----------
    Ljung (1999), System Identification, section 16.4.

    Examples
    --------
    >>> import control
    >>> lag = control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"])
    >>> display = StepResponseDisplay.from_systems({"lag": lag}, duration=10.0)
    >>> round(float(display.responses["lag"][-1, 0, 0]), 4)
    1.0
    """

    times: dict
    responses: dict
    _: KW_ONLY
    input_names: list
    output_names: list
    std: dict = field(default_factory=dict)
    kind: str = "step"
    held: set = field(default_factory=set)
    reference: str | None = None

    @classmethod
    def from_estimator(
        cls, estimator, *, kind="step", duration=None, true=None, ax=None, **plotted
    ):
        """Draw the model of a fitted step; with its confidence after maximum likelihood.

        Parameters
        ----------
        estimator : model step of sklearn_hd, or Pipeline or search that holds one
            Fitted. Several, in a dict by label, are drawn together.
        duration : float, optional
            Seconds to draw; five of the slowest time constant by default.
        true : control.StateSpace, optional
            The truth; of its signals, by name, those of the models.
        **plotted
            ``inputs``, ``outputs``, ``units``: see :meth:`plot`.

        Raises
        ------
        ValueError
            If models have different signals, one of samples varies over the turn, or ``kind``
            is unknown.
        """
        steps = invariant_steps(estimator, cls.__name__)
        systems = {label: step.system_ for label, step in steps.items()}
        display = cls._of(systems, kind, duration, true)
        for label, step in steps.items():
            if has_confidence(step):
                time, found = display.times[label], step.match_
                _, display.std[label] = found.uncertainty.step_response(
                    found.theta, time[1], len(time), impulse=kind == "impulse"
                )
        return display.plot(ax=ax, **plotted)

    @classmethod
    def from_systems(cls, systems, *, kind="step", duration=None, true=None, ax=None, **plotted):
        """Draw systems of python-control.

        Parameters
        ----------
        systems : control.StateSpace, or a dict of them by label
            Between the same signals, continuous or discrete.

        Raises
        ------
        TypeError
            If a system is no ``control.StateSpace``.
        ValueError
            If systems have different signals, ``duration`` is not positive, or ``kind`` is
            unknown.
        """
        display = cls._of(by_label(systems, "model"), kind, duration, true)
        return display.plot(ax=ax, **plotted)

    @classmethod
    def _of(cls, systems, kind, duration, true):
        if kind not in ("step", "impulse"):
            raise ValueError(f"kind={kind!r} is unknown; give 'step' or 'impulse'")
        systems, names = between_same_signals(systems, true, cls.__name__)
        if duration is None:
            duration = max(map(_duration, systems.values()))
        duration = check_positive("duration", duration, "seconds", "10.0 is an example")
        times, responses, held = {}, {}, set()
        for label, system in systems.items():
            dt = sample_time(system)
            step = dt or duration / 400  # more than the panel is wide in points
            count = max(2, int(np.floor(duration / step * (1.0 + 1e-9))) + 1)
            matrices = matrices_between(system, *names)
            times[label] = step * np.arange(count)
            responses[label] = step_response(
                *matrices, step, count, dt=dt, impulse=kind == "impulse"
            )
            held |= {label} if dt else set()
        return cls(
            times,
            responses,
            input_names=names[0],
            output_names=names[1],
            kind=kind,
            held=held,
            reference=None if true is None else "true",
        )

    def plot(self, ax=None, *, inputs=None, outputs=None, units=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        inputs, outputs : sequence of str, optional
            Coefficients to draw; by default all, and of more than 24 pairs those of each signal's
            lowest harmonic (the first 24 pairs at most), as the title of the first panel says.
        units : dict, optional
            Unit of each signal, or of its coefficients, for the labels.

        Raises
        ------
        ValueError
            If a signal asked for is not there.
        """
        pairs, (rows, columns), words = chosen_pairs(inputs, outputs, self)
        size = max(5.0, 3.4 * columns), 0.8 + 2.4 * rows
        panels = self._panels(ax, size, places(len(pairs), columns), share_x="all")
        styles = line_styles(self.responses, self.reference)
        self.lines_, self.bands_, self._edges = {}, {}, []
        for k, (o, i) in enumerate(pairs):
            axis = self.axes_[k]
            self._draw(o, i, axis, styles)
            source, target = self.input_names[i], self.output_names[o]
            dress(axis, y=with_unit(target, units), title=f"{words}{self.kind} in {source}")
            words = ""  # once
            axis.axhline(0.0, color=BLACK, lw=0.6, zorder=0.5)
            if k + columns >= len(pairs):
                axis.set_xlabel(TIME)
        name_confidence(self.figure_, list(self.bands_.values()), self._edges)
        self.legend_ = panels.legend() if len(self.responses) > 1 or self.std else None
        return self

    def _draw(self, o, i, axis, styles):
        for label, response in self.responses.items():
            key = label, self.output_names[o], self.input_names[i]
            stairs = label in self.held
            y, time = response[:, o, i], self.times[label]
            style = styles[label] | {"drawstyle": "steps-post" if stairs else "default"}
            self.lines_[key] = axis.plot(time, y, label=label, **style)[0]
            if label in self.std:
                reach = REACH * self.std[label][:, o, i]
                look = {"color": styles[label]["color"], "alpha": 0.25, "lw": 0}
                self._edges.append((axis, y - reach, y + reach))
                step = "post" if stairs else None
                self.bands_[key] = axis.fill_between(time, y - reach, y + reach, step=step, **look)


def _duration(system):
    """Seconds that show a system: until it has settled, or has grown e-fold three times."""
    dt = sample_time(system)
    poles = continuous_poles(system.poles(), dt)
    size = np.abs(poles).max(initial=0.0)
    if size == 0.0:
        return 20.0 * dt if dt else 1.0
    rates, least = poles.real, 1e-3 * size  # slower ones, and integrators, would hide the rest
    if np.any(rates > least):
        return 3.0 / rates.max()
    return 5.0 / max(np.abs(rates).min(), least)  # 0.7 % of a decay is left
