"""Periodic models of samples over a turn: loads, answers to pulses, and their harmonics."""

from dataclasses import KW_ONLY, dataclass

import numpy as np
import pandas as pd

from sklearn_hd._checks import check_positive
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.plotting._display import (
    BARS,
    GREY,
    LINES,
    RED,
    Display,
    chosen,
    dress,
    looks,
    number,
    step_of_samples,
    unit_of,
    with_unit,
)

DEGREES = 360  # azimuths that pulses are computed at
SETTLED = 0.02  # of its largest value, which a response has to stay below


@dataclass(eq=False, repr=False)
class AzimuthDisplay(Display, axes="two Axes an output, then two for each pair of signals"):
    """What a machine does at each turn: its loads, and how dynamics depend on the azimuth.

        g_s(ψ) = C(ψ + sδ) A(ψ + (s − 1)δ) … A(ψ + δ) B(ψ),   g_0 = D(ψ)

    On the left loads (the periodic response without inputs) over the azimuth, and responses to a
    unit pulse of an input, held for one sample, that acts at some azimuths: where they coincide,
    the dynamics do not vary. On the right the harmonics of both; the share of a harmonic in the
    dynamics is the root mean square of its part of g over that of g. None of it depends on the
    coordinates of the state.

    Parameters
    ----------
    loads : DataFrame, shape (2 L + 1, n_outputs)
        Fourier coefficients, in the order 0, 1c, 1s, …: ``loads_`` of a MOESPRegressor.
    pulses : ndarray, shape (360, n_rows, n_outputs, n_inputs)
        Of g, by the azimuth of the pulse in whole degrees and samples since.
    step : float
        Radians from sample to sample, δ.
    input_names : sequence of str
        In the order of the pulses.
    noise : Series, shape (n_outputs,), optional
        Standard deviation of the innovations: a load below it is less than the noise of a sample.
    about_trim : bool, default=False
        Whether loads are those beside a periodic trim.

    Attributes
    ----------
    amplitudes_ : DataFrame, shape (L, n_outputs)
        Of the loads, by harmonic.
    shares_ : DataFrame, shape (n_harmonics + 1, n_outputs * n_inputs)
        Of each harmonic in the dynamics, by harmonic and (output, input).
    axes_ : ndarray of Axes, shape (2 * (n_outputs + n_pairs),)
        Loads and their harmonics of each output, then responses and their harmonics of each pair.
    figure_ : Figure
    load_lines_ : dict of Line2D
        By output.
    pulse_lines_ : dict of Line2D
        By output, input and azimuth.
    bars_ : dict of BarContainer
        By output, and by (output, input).
    noise_lines_ : dict of Line2D
        By output: the standard deviation of innovations, where it is known.
    legend_ : Legend

    References
    ----------
    Bittanti, Colaneri (2009), Periodic Systems: Filtering and Control (Markov parameters of
    periodic systems).

    Examples
    --------
    >>> import numpy as np, pandas as pd
    >>> from sklearn.pipeline import make_pipeline
    >>> from sklearn_hd import HarmonicAnalyzer, MOESPRegressor
    >>> rng, t = np.random.default_rng(0), pd.Index(np.arange(900) / 10, name="time")
    >>> u, y, psi = rng.standard_normal(900), np.zeros(900), 7.0 * t.to_numpy()
    >>> for k in range(899):
    ...     y[k + 1] = (0.6 + 0.3 * np.cos(psi[k])) * y[k] + u[k]
    >>> y += 3.0 * np.sin(2.0 * psi) + 0.1 * rng.standard_normal(900)
    >>> pipe = make_pipeline(HarmonicAnalyzer(7.0, reading="sample"), MOESPRegressor(order=1))
    >>> pipe = pipe.fit(pd.DataFrame({"u": u}, t), pd.DataFrame({"y": y}, t))
    >>> display = AzimuthDisplay.from_estimator(pipe)
    >>> display.amplitudes_["y"].round(1).tolist()
    [0.0, 3.0, 0.0, 0.0]
    """

    loads: pd.DataFrame
    pulses: np.ndarray
    step: float
    _: KW_ONLY
    input_names: list
    noise: pd.Series | None = None
    about_trim: bool = False

    @classmethod
    def from_estimator(cls, estimator, *, turns=None, ax=None, **plotted):
        """Draw a model of samples at their azimuths.

        Parameters
        ----------
        estimator : MOESPRegressor, or Pipeline or search that holds one
            Fitted behind ``HarmonicAnalyzer(reading="sample")``.
        turns : float, optional
            Length of the responses; by default until they stay below 2 % of their largest value,
            one to four turns.
        **plotted
            ``azimuths``, ``inputs``, ``outputs``, ``units``: see :meth:`plot`.

        Raises
        ------
        ValueError
            If the model is none of samples, or ``turns`` is not positive.
        """
        step = step_of_samples(estimator, cls.__name__)
        innovations = step.model_.innovations
        if turns is not None:
            turns = check_positive("turns", turns, "revolutions", "2 is usual")
        pulses = _pulses(innovations, 4 if turns is None else turns)
        if turns is None:
            pulses = pulses[:, : _settled(pulses, innovations.samples_per_period)]
        display = cls(
            step.loads_,
            pulses,
            innovations.step,
            input_names=list(step.model_.input_names),
            noise=pd.Series(np.sqrt(np.diag(innovations.covariance)), list(step.loads_)),
            about_trim=step.basis_.about_trim,
        )
        return display.plot(ax=ax, **plotted)

    def plot(self, ax=None, *, azimuths=(0, 90, 180, 270), inputs=None, outputs=None, units=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        azimuths : sequence of int, default=(0, 90, 180, 270)
            Degrees at which pulses act.
        inputs, outputs : sequence of str, optional
            Signals to draw; all by default.

        Raises
        ------
        ValueError
            If an azimuth is no whole number, or a signal is unknown.
        """
        azimuths = _checked(azimuths)
        names = list(self.loads)
        inputs = [self.input_names[i] for i in chosen(inputs, self.input_names, "inputs")]
        outputs = [names[i] for i in chosen(outputs, names, "outputs")]
        pairs = [(o, i) for o in outputs for i in inputs]
        n_rows = len(outputs) + len(pairs)
        size = 9.0, 0.9 + (2.2 if n_rows <= 4 else 1.8) * n_rows
        panels = self._panels(ax, size, list(np.ndindex(n_rows, 2)))
        axes = panels.axes.reshape(n_rows, 2)
        self._measure()
        self.load_lines_, self.pulse_lines_, self.bars_, self.noise_lines_ = {}, {}, {}, {}
        for name, (left, right) in zip(outputs, axes[: len(outputs)], strict=True):
            self._draw_loads(name, left, units)
            amplitude = self.amplitudes_[name]
            self._draw_bars(name, right, amplitude)
            self._draw_noise(name, left, right)
            size = f"{number(amplitude.max())} {unit_of(name, units) or ''}"
            words = f"largest: harmonic {amplitude.idxmax()}, {size}".rstrip()
            dress(right, y=with_unit("amplitude", {"amplitude": unit_of(name, units)}), title=words)
        for pair, (left, right) in zip(pairs, axes[len(outputs) :], strict=True):
            self._draw_pulses(pair, left, azimuths, units)
            share = 100.0 * self.shares_[pair]
            bars = self._draw_bars(pair, right, share)
            told = [f"{v:.2g}" if v >= 1.0 else "" for v in share]  # percent
            right.bar_label(bars, told, fontsize=8, padding=2)
            varying = np.sqrt(max(1e4 - share[0] ** 2, 0.0))
            words = f"{varying:.2g} % of the response varies over the turn"
            dress(right, y="share (%)", title=words)
        axes[len(outputs) - 1, 0].set_xlabel("ψ (deg)")
        for row in {len(outputs) - 1, n_rows - 1}:
            axes[row, 1].set_xlabel("harmonic of the turn (–)")
        if pairs:
            axes[-1, 0].set_xlabel("azimuth passed since the pulse (deg)")
        handles = [self.pulse_lines_[(*pair, psi)] for pair in pairs[:1] for psi in azimuths]
        handles += list(self.noise_lines_.values())[:1]
        self.legend_ = panels.legend(handles, columns=5, fallback=2 * len(outputs) + 1)
        return self

    def _measure(self):
        """Amplitudes of the harmonics of loads, and shares of those of the dynamics."""
        c, s = self.loads.to_numpy()[1::2], self.loads.to_numpy()[2::2]
        harmonics = pd.RangeIndex(1, len(c) + 1, name="harmonic")
        self.amplitudes_ = pd.DataFrame(np.hypot(c, s), harmonics, self.loads.columns)
        power = np.sum(np.abs(np.fft.rfft(self.pulses, axis=0)) ** 2, axis=1)
        power[1:] *= 2.0
        whole = np.sum(power, axis=0)
        share = np.sqrt(power / np.where(whole > 0.0, whole, 1.0))[: max(len(c), 4) + 1]
        columns = [(o, i) for o in self.loads for i in self.input_names]
        table = share.reshape(len(share), -1)
        index = pd.RangeIndex(len(share), name="harmonic")
        self.shares_ = pd.DataFrame(dict(zip(columns, table.T, strict=True)), index)

    def _draw_loads(self, name, axis, units):
        psi, coefficients = np.arange(361), self.loads[name].to_numpy()
        values = evaluate_harmonics(coefficients, np.radians(psi))
        mean = coefficients[0]
        axis.axhline(mean, color=GREY, lw=1.0, ls="--")
        self.load_lines_[name] = axis.plot(psi, values, **LINES[0])[0]
        about = ", about trim" if self.about_trim else ""
        words = f"loads of {name}{about}: mean {number(mean)}"
        dress(axis, y=with_unit(name, units), title=words)
        axis.set(xlim=(0, 360), xticks=range(0, 361, 90))

    def _draw_noise(self, name, left, right):
        """What is smaller than innovations is drawn as small: no magnifying."""
        if self.noise is None:
            return
        size, mean = float(self.noise[name]), self.loads[name].iloc[0]
        style = {"color": RED, "ls": ":", "lw": 1.4, "label": "innovations (std)"}
        self.noise_lines_[name] = right.axhline(size, **style)
        right.set_ylim(0.0, max(right.get_ylim()[1], 1.15 * size))
        low, high = left.get_ylim()
        left.set_ylim(min(low, mean - size), max(high, mean + size))

    def _draw_pulses(self, pair, axis, azimuths, units):
        output, source = pair
        o, i = list(self.loads).index(output), self.input_names.index(source)
        passed = np.degrees(self.step) * np.arange(self.pulses.shape[1])
        axis.axhline(0.0, color=GREY, lw=0.8)
        for psi, look in zip(azimuths, looks(LINES, len(azimuths)), strict=True):
            values = self.pulses[psi % DEGREES, :, o, i]
            line = axis.plot(passed, values, label=f"pulse at {psi}°", **look)[0]
            self.pulse_lines_[output, source, psi] = line
        unit, per = (unit_of(name, units) for name in (output, source))
        words = f"{output} per {source}"
        if unit is not None or per is not None:
            words = f"{output} ({unit or '–'} per {per or '–'})"
        dress(axis, y=words, title=f"response of {output} to a pulse of {source}")
        axis.set_xlim(0, passed[-1])
        every = 90 if passed[-1] <= 540 else 180 if passed[-1] <= 1080 else 360
        axis.set_xticks(range(0, int(passed[-1]) + 1, every))

    def _draw_bars(self, key, axis, values):
        bars = axis.bar(values.index, values, 0.7, **BARS[0 if isinstance(key, str) else 1])
        self.bars_[key] = bars
        axis.set_xticks(values.index)
        axis.set_ylim(0.0, 1.15 * max(values.max(), np.finfo(float).tiny))
        return bars


def _checked(azimuths):
    """Azimuths in whole degrees."""
    given = list(np.atleast_1d(azimuths))
    if not given or any(isinstance(a, str) or not float(a).is_integer() for a in given):
        raise ValueError(f"azimuths={azimuths!r} must be whole degrees, such as (0, 90, 180, 270)")
    return [int(a) for a in given]


def _pulses(innovations, turns):
    """Responses to a unit pulse by its azimuth in degrees, (360, n_rows, n_outputs, n_inputs)."""
    n, psi = innovations.n_states, np.radians(np.arange(DEGREES))
    rows = innovations.rows(psi)
    x, found = rows.states[..., n:-1], [rows.outputs[..., n:-1]]
    for s in range(1, max(2, round(turns * innovations.samples_per_period) + 1)):
        rows = innovations.rows(psi + s * innovations.step)
        found.append(rows.outputs[..., :n] @ x)
        x = rows.states[..., :n] @ x
    return np.stack(found, axis=1)


def _settled(pulses, samples_per_period):
    """Rows after which every response stays below a small share of its largest value."""
    size = np.abs(pulses).max(axis=0)
    large = np.flatnonzero(np.any(size > SETTLED * size.max(axis=0), axis=(1, 2)))
    return max(large[-1] + 2 if len(large) else 0, round(samples_per_period) + 1)
