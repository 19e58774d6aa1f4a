"""Harmonic transfer functions: models against what a record says without one."""

import numpy as np

from sklearn_hd._checks import FIRST, PERIOD_TOLERANCE
from sklearn_hd._clock import read_time
from sklearn_hd._records.data import read_experiment
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.model_selection._scorers import last_model_step
from sklearn_hd.plotting._display import (
    BLACK,
    FREQUENCY,
    GREY,
    Display,
    by_label,
    by_segment,
    check_periodic,
    chosen,
    dress,
    line_styles,
    periodic_system,
    step_of_samples,
    unit_of,
)
from sklearn_hd.systems import HarmonicTransferFunction, estimate_harmonic_transfer_function

MEASURED = {"color": GREY, "marker": ".", "ms": 3.5, "ls": ""}


class HarmonicTransferFunctionDisplay(
    Display, axes="one Axes a harmonic and pair of signals, and the coherence of each output"
):
    """Magnitude of H_n(jΩ), harmonic by harmonic, and the coherence of what was measured.

        u(t) = u e^{jΩt}   →   y(t) = Σ_n H_n(jΩ) u e^{j(Ω + nω)t}

    Parameters
    ----------
    responses : dict of HarmonicTransferFunction
        By label, between the same signals. Estimates (those with ``std``) are drawn as
        points with their standard deviation, models as lines.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (n_rows * (2 N + 1),)
        One row for each output and input, and one with the coherence of each output
        where something was measured; one column a harmonic, from −N to N.
    figure_ : Figure
    magnitude_lines_ : dict of Line2D
        By label, output, input and harmonic.
    std_lines_ : dict of Line2D
        Standard deviations of estimates, by the same.
    coherence_lines_ : dict of Line2D
        By label, output and harmonic.
    legend_ : Legend

    Raises
    ------
    TypeError
        If a response is no HarmonicTransferFunction.
    ValueError
        If responses are between different signals.

    References
    ----------
    Wereley, Hall (1990), Frequency response of linear time periodic systems, 29th IEEE
    Conference on Decision and Control.

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> display = HarmonicTransferFunctionDisplay.from_systems(mathieu(), n_harmonics=1)
    >>> [axis.get_title("left") for axis in display.axes_[:3]]
    ['n = −1', 'n = 0', 'n = 1']
    """

    def __init__(self, responses):
        for label, response in responses.items():
            if not isinstance(response, HarmonicTransferFunction):
                raise TypeError(
                    f"HarmonicTransferFunctionDisplay draws HarmonicTransferFunctions; {label!r} "
                    f"is of type {type(response).__name__}"
                )
        signals = {(r.output_names, r.input_names) for r in responses.values()}
        if len(signals) != 1:
            words = ", ".join(f"{list(o)} from {list(i)}" for o, i in sorted(signals))
            raise ValueError(
                f"the responses must have the same signals, but have {words or 'none'}"
            )
        self.responses = responses

    @classmethod
    def from_estimator(
        cls, estimator, X=None, y=None, *, n_harmonics=1, frequencies=None, ax=None, **plotted
    ):
        """Draw an identified linear time-periodic system, and a record beside it.

        Parameters
        ----------
        estimator : StructuredMatcher, or Pipeline or search that ends in one
            Fitted with a periodic structure.
        X, y : DataFrame or Series, optional
            A record from which the response is estimated without a model, best one that
            the model was not fitted to; the periodic trim is taken from it.
        n_harmonics : int, default=1
            Highest harmonic N of the response.
        frequencies : array_like, shape (n_frequencies,), optional
            In rad/s; without a record, up to N + 2 times ω by default. With one, its own.
        **plotted
            ``inputs``, ``outputs``, ``units``, ``xscale``: see :meth:`plot`.

        Raises
        ------
        ValueError
            If its structure is time-invariant, or the record is too short, or read as samples
            of which a turn has no whole number.
        """
        system = periodic_system(estimator, cls.__name__)
        systems = {"identified": system}
        if X is None:
            return cls.from_systems(systems, n_harmonics, frequencies, ax=ax, **plotted)
        u, y = _about_trim(estimator, X, y)
        return cls.from_data(
            u, y, system.omega, n_harmonics, systems=systems, ax=ax, plotted=plotted
        )

    @classmethod
    def from_systems(cls, systems, n_harmonics=1, frequencies=None, *, ax=None, **plotted):
        """Draw linear time-periodic systems.

        Parameters
        ----------
        systems : LTPSystem, or a dict of them by label
            Between the same signals.
        frequencies : array_like, shape (n_frequencies,), optional
            In rad/s; up to N + 2 times ω by default.

        Raises
        ------
        TypeError
            If a system is no LTPSystem.
        ValueError
            If systems have different signals.
        """
        systems = by_label(systems, "model")
        for label, system in systems.items():
            check_periodic(system, cls.__name__, label)
        if frequencies is None:
            omega = next(iter(systems.values())).omega
            frequencies = np.linspace(0.0, (n_harmonics + 2) * omega, num=400)
        responses = {
            label: system.harmonic_transfer_function(frequencies, n_harmonics)
            for label, system in systems.items()
        }
        return cls(responses).plot(ax=ax, **plotted)

    @classmethod
    def from_data(cls, u, y, omega, n_harmonics=1, *, systems=None, ax=None, plotted=None, **kw):
        """Estimate the response of a record without a model, and draw it.

        Parameters
        ----------
        u, y : DataFrame, Series or ndarray, shapes (n_samples, n_inputs or n_outputs)
            Inputs and outputs, the periodic trim subtracted.
        omega : float
            Fundamental frequency, rad/s.
        systems : LTPSystem, or a dict of them by label, optional
            Models to compare with, for inputs held from sample to sample.
        plotted : dict, optional
            Parameters of :meth:`plot`.
        **kw
            Of :func:`~sklearn_hd.systems.estimate_harmonic_transfer_function`.

        Raises
        ------
        TypeError
            If a system is no LTPSystem.
        ValueError
            If the record is too short, or systems have other signals than it.
        """
        measured = estimate_harmonic_transfer_function(u, y, omega, n_harmonics, **kw)
        responses = {"measured": measured}
        dt = read_time(u, kw.get("sample_time"), kw.get("time_origin", FIRST)).sample_time
        for label, system in by_label(systems or {}, "model").items():
            check_periodic(system, cls.__name__, label)
            responses[label] = system.harmonic_transfer_function(
                measured.frequencies, n_harmonics, sample_time=dt
            )
        return cls(responses).plot(ax=ax, **(plotted or {}))

    def plot(self, ax=None, *, inputs=None, outputs=None, units=None, xscale="linear"):
        """Draw, on a new figure by default.

        Parameters
        ----------
        inputs, outputs : sequence of str, optional
            Signals to draw; all by default.
        xscale : {"linear", "log"}, default="linear"
            Of the frequencies.
        """
        first = next(iter(self.responses.values()))
        inputs = chosen(inputs, first.input_names, "inputs")
        outputs = chosen(outputs, first.output_names, "outputs")
        N = max(response.n_harmonics for response in self.responses.values())
        measured = {k: r for k, r in self.responses.items() if r.coherence is not None}
        rows = [(o, i) for o in outputs for i in [*inputs, *([None] if measured else [])]]
        heights = [0.5 if i is None else 1.0 for _, i in rows]
        high = 2.3 if len(rows) <= 4 else 1.6
        size = max(5.0, min(15.0, 3.0 * (2 * N + 1))), 0.9 + high * sum(heights)
        cells = list(np.ndindex(len(rows), 2 * N + 1))
        panels = self._panels(ax, size, cells, heights=heights, share_x="all", share_y="row")
        axes = panels.axes.reshape(len(rows), -1)
        self.magnitude_lines_, self.std_lines_, self.coherence_lines_ = {}, {}, {}
        for (o, i), row in zip(rows, axes, strict=True):
            for n, axis in zip(range(-N, N + 1), row, strict=True):
                if i is None:
                    self._draw_coherence(axis, measured, o, n)
                else:
                    self._draw_magnitude(axis, o, i, n)
            if i is not None:
                _limit(row)
            self._label(row, first, o, i, units)
        for axis, n in zip(axes[0], range(-N, N + 1), strict=True):
            axis.set_title(f"n = {n}".replace("-", "−"), loc="left", fontsize=10.5)
        for axis in axes[-1]:
            axis.set_xlabel(FREQUENCY.replace("frequency", "frequency Ω"))
        for axis in self.axes_:
            axis.set_xscale(xscale)
        self.legend_ = panels.legend() if len(self.responses) > 1 or measured else None
        return self

    def _draw_magnitude(self, axis, o, i, n):
        styles = line_styles([label for label, r in self.responses.items() if r.std is None])
        for label, response in self.responses.items():
            if abs(n) > response.n_harmonics:
                continue
            key = label, response.output_names[o], response.input_names[i], n
            size = np.abs(response.harmonic(n)[:, o, i])
            style = styles.get(label, MEASURED) | {"label": label}
            (self.magnitude_lines_[key],) = axis.plot(response.frequencies, size, **style)
            if response.std is not None:
                std = response.std[:, response.n_harmonics + n, o, i]
                style = {"color": BLACK, "ls": ":", "lw": 1.0, "label": "its standard deviation"}
                (self.std_lines_[key],) = axis.plot(response.frequencies, std, **style)
        axis.set_yscale("log")
        dress(axis)

    def _draw_coherence(self, axis, measured, o, n):
        for label, response in measured.items():
            if abs(n) <= response.n_harmonics:
                values = response.coherence[:, response.n_harmonics + n, o]
                key = label, response.output_names[o], n
                (self.coherence_lines_[key],) = axis.plot(
                    response.frequencies, values, color=GREY, lw=1.0
                )
        dress(axis)
        axis.set(ylim=(0, 1.05), yticks=(0, 0.5, 1))

    @staticmethod
    def _label(row, first, o, i, units):
        """What a row shows, on its left."""
        target = first.output_names[o]
        words = f"coherence\n{target}"
        if i is not None:
            source = first.input_names[i]
            words = f"|$H_n$| {source} → {target}"
            if units is not None:
                units_ = [unit_of(name, units) or "–" for name in (target, source)]
                words += f"\n({units_[0]} per {units_[1]})"
        row[0].set_ylabel(words)
        for axis in row[1:]:
            axis.tick_params(labelleft=False, which="both")


def _limit(row):
    """Whole decades that hold the curves of a row, but for what dips far below them.

    Left out are the lowest hundredth of each curve, and what is below 1e-6 of the largest.
    """
    drawn = [line.get_ydata() for axis in row for line in axis.lines]
    drawn = [values[values > 0.0] for values in drawn if np.any(values > 0.0)]
    if drawn:
        low = min(np.quantile(values, 0.01) for values in drawn)
        high = max(values.max() for values in drawn)
        bottom = np.floor(np.log10(max(low, 1e-6 * high)))
        for axis in row:
            axis.set_ylim(10.0**bottom, 10.0 ** max(np.ceil(np.log10(high)), bottom + 1.0))


def _about_trim(estimator, X, y):
    """Inputs and outputs on the grid that is analysed, segments for records.

    Trim is taken from both, the loads of a model of samples from the outputs.
    """
    if y is None:
        raise ValueError("X was given without y; give both, or neither")
    step, handed = last_model_step(estimator, X)
    experiment = read_experiment(step.transform(handed), y)
    basis, outputs = experiment.basis, experiment.outputs
    if basis.reading == "sample":
        _check_grid(basis)
        loads = step_of_samples(estimator, "HarmonicTransferFunctionDisplay").loads_.to_numpy()
        psi = experiment.phases
        outputs = [y - evaluate_harmonics(loads, p) for y, p in zip(outputs, psi, strict=True)]
    return (
        by_segment(experiment, experiment.inputs, [signal for signal, _ in basis.inputs]),
        by_segment(experiment, outputs, [signal for signal, _ in basis.outputs]),
    )


def _check_grid(basis):
    """Raise ValueError unless samples lie on a grid of the turn."""
    samples, azimuth = basis.samples_per_period, basis.timing.azimuth
    if azimuth is None and abs(samples - round(samples)) <= PERIOD_TOLERANCE:
        return
    what = f"{samples:.5g} samples a turn" if azimuth is None else "turns of varying length"
    raise ValueError(
        f"the record has {what}, but an estimate without a model needs a whole number of samples "
        f"per turn; draw the model alone (without X and y), or resample the record to such a grid "
        f"and use HarmonicTransferFunctionDisplay.from_data(u, y, omega, systems=...)"
    )
