"""Frequency responses of models of harmonics, coefficient by coefficient."""

from dataclasses import KW_ONLY, dataclass, field

import numpy as np

from sklearn_hd.algorithms.lti.simulation import continuous_poles, frequency_response
from sklearn_hd.plotting._display import (
    FREQUENCY,
    REACH,
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
    unit_of,
)


@dataclass(eq=False, repr=False)
class BodeDisplay(Display, axes="two Axes for each pair of signals, magnitude and phase"):
    """Magnitude and phase from each input's harmonics to each output's.

        Y(jΩ) = G(jΩ) U(jΩ),   G = C (jΩI − A)⁻¹ B + D

    For models in harmonic-decomposition form the signals are coefficients such as
    U_0 and w_1c; each pair of them has its panels.

    Parameters
    ----------
    frequencies : ndarray, shape (n_frequencies,)
        In rad/s.
    responses : dict of complex ndarray, shape (n_frequencies, n_outputs, n_inputs)
        By label.
    input_names, output_names : sequence of str
        In the order of the responses' last axes.
    std : dict of complex ndarray, of the same shape, optional
        Standard deviation of the real part + j times that of the imaginary part.
    reference : str, optional
        Label of the response drawn broad and grey: the truth.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (2 * n_pairs,)
        Magnitude and phase of each pair of an output and an input.
    figure_ : Figure
    magnitude_lines_, phase_lines_ : dict of Line2D
        By label, output and input.
    bands_ : dict of list of FillBetweenPolyCollection
        95 % confidence of magnitude and phase, where standard deviations are known.
    legend_ : Legend or None

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eqs. 8 and 9.

    Examples
    --------
    >>> from sklearn_hd.systems import flapping_wing, mathieu
    >>> hd = mathieu().harmonic_decomposition(1, 0, 1)
    >>> display = BodeDisplay.from_systems(hd, outputs=["y_0", "y_1c"])
    >>> [axis.get_title("left") for axis in display.axes_[::2]]
    ['u_0 → y_0', 'u_0 → y_1c']
    """

    frequencies: np.ndarray
    responses: dict
    _: KW_ONLY
    input_names: list
    output_names: list
    std: dict = field(default_factory=dict)
    reference: str | None = None

    @classmethod
    def from_estimator(cls, estimator, frequencies=None, *, true=None, ax=None, **plotted):
        """Draw the model of a fitted step; with its confidence after maximum likelihood.

        Parameters
        ----------
        estimator : model step of sklearn_hd, or Pipeline or search that holds one
            Fitted. Several, in a dict by label, are drawn together.
        frequencies : array_like, shape (n_frequencies,), optional
            In rad/s; a decade beyond the poles by default.
        true : control.StateSpace, optional
            The truth; of its signals, by name, those of the models.
        **plotted
            ``inputs``, ``outputs``, ``units``: see :meth:`plot`.

        Raises
        ------
        ValueError
            If models have different signals, or one of samples varies over the turn.
        """
        steps = invariant_steps(estimator, cls.__name__)
        systems = {label: step.system_ for label, step in steps.items()}
        display = cls._of(systems, frequencies, true)
        display.std = {
            label: step.frequency_response(display.frequencies)[1]
            for label, step in steps.items()
            if has_confidence(step)
        }
        return display.plot(ax=ax, **plotted)

    @classmethod
    def from_systems(cls, systems, frequencies=None, *, true=None, ax=None, **plotted):
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
            If systems have different signals, or a frequency is not positive.
        """
        return cls._of(by_label(systems, "model"), frequencies, true).plot(ax=ax, **plotted)

    @classmethod
    def _of(cls, systems, frequencies, true):
        systems, names = between_same_signals(systems, true, cls.__name__)
        if frequencies is None:
            frequencies = default_frequencies(systems.values())
        frequencies = np.asarray(frequencies, dtype=float)
        if frequencies.ndim != 1 or not np.all(frequencies > 0.0):
            raise ValueError(
                f"frequencies of shape {frequencies.shape} must be positive numbers in rad/s, in "
                f"one dimension"
            )
        responses = {
            label: _response(system, frequencies, *names) for label, system in systems.items()
        }
        told = {"input_names": names[0], "output_names": names[1]}
        return cls(frequencies, responses, **told, reference=None if true is None else "true")

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
        cells = [(2 * r + half, c) for r, c in places(len(pairs), columns) for half in (0, 1)]
        size = max(5.0, 3.2 * columns), 0.6 + (4.4 if rows == 1 else 3.4) * rows
        panels = self._panels(ax, size, cells, heights=[1.3, 1.0] * rows, share_x="all")
        styles = line_styles(self.responses, self.reference)
        self.magnitude_lines_, self.phase_lines_, self.bands_, self._edges = {}, {}, {}, []
        first, shared = panels.axes[0], ax is None
        for axis in panels.axes[:1] if shared else panels.axes:
            axis.set_xscale("log")
        for axis in panels.axes if shared else []:  # each change would go through all of them
            axis.set_autoscalex_on(False)
        for k, (o, i) in enumerate(pairs):
            self._draw(o, i, panels.axes[2 * k : 2 * k + 2], units, styles)
            panels.axes[2 * k].tick_params(labelbottom=False)
            if k + columns >= len(pairs):
                panels.axes[2 * k + 1].set_xlabel(FREQUENCY)
            if k % columns == 0:
                panels.axes[2 * k].set_ylabel(panels.axes[2 * k].get_ylabel() or "magnitude")
                panels.axes[2 * k + 1].set_ylabel("phase (deg)")
        dress(first, title=words + first.get_title("left"))
        if shared:
            first.set_autoscalex_on(True)
            first.autoscale_view(scaley=False)
        name_confidence(
            self.figure_, [band for bands in self.bands_.values() for band in bands], self._edges
        )
        self.legend_ = panels.legend() if len(self.responses) > 1 or self.std else None
        return self

    def _draw(self, o, i, axes, units, styles):
        magnitude, phase = axes
        magnitude.set_yscale("log")
        source, target = self.input_names[i], self.output_names[o]
        for label, response in self.responses.items():
            g, style = response[:, o, i], styles[label] | {"label": label}
            key, size = (label, target, source), np.abs(g)
            angle = _degrees(g)
            self.magnitude_lines_[key] = magnitude.plot(self.frequencies, size, **style)[0]
            self.phase_lines_[key] = phase.plot(self.frequencies, angle, **style)[0]
            if label in self.std:
                self.bands_[key] = self._band(axes, g, angle, self.std[label][:, o, i], style)
        low, high = np.log10(magnitude.get_ylim())
        magnitude.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
        unit = None
        if unit_of(source, units) and unit_of(target, units):
            unit = f"magnitude ({unit_of(target, units)} per {unit_of(source, units)})"
        dress(magnitude, title=f"{source} → {target}", y=unit)
        dress(phase)

    def _band(self, axes, g, angle, std, style):
        """95 % confidence of magnitude and phase, to first order in the deviations."""
        size = np.maximum(np.abs(g), np.finfo(float).tiny)
        along = np.hypot(g.real * std.real, g.imag * std.imag) / size
        across = np.hypot(g.imag * std.real, g.real * std.imag) / size**2
        reach, turn = REACH * along, np.degrees(REACH * across)
        look = {"color": style["color"], "alpha": 0.25, "lw": 0}
        edges = (
            (axes[0], np.maximum(size - reach, 1e-3 * size), size + reach),
            (axes[1], angle - turn, angle + turn),
        )
        self._edges += edges
        return [axis.fill_between(self.frequencies, *sides, **look) for axis, *sides in edges]


def default_frequencies(systems):
    """A grid in rad/s that holds all poles, and for discrete models ends where they do."""
    sizes, top = [], np.inf
    for system in systems:
        dt = sample_time(system)
        if dt > 0.0:
            top = min(top, np.pi / dt)
        sizes += [size for size in np.abs(continuous_poles(system.poles(), dt)) if size > 0.0]
    low, high = (min(sizes), max(sizes)) if sizes else (1.0, 1.0)
    high = min(10.0 * high, top)  # a decade beyond the slowest and the fastest pole
    return np.geomspace(min(low, high) / 10.0, high, num=400)


def _response(system, frequencies, inputs, outputs):
    dt = sample_time(system)
    points = 1j * frequencies if dt == 0.0 else np.exp(1j * frequencies * dt)
    return frequency_response(*matrices_between(system, inputs, outputs), points)


def _degrees(g):
    """Phase without jumps, that of the lowest frequency within half a turn of zero."""
    angle = np.degrees(np.unwrap(np.angle(g)))
    return angle - 360.0 * np.round(angle[0] / 360.0)
