"""Eigenvalues in the complex plane: identified, judged, matched, true, of several models."""

from itertools import cycle

import numpy as np
import pandas as pd
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator
from scipy.stats import chi2, norm

from sklearn_hd._model_step import ModelStep
from sklearn_hd._opinion import doubtful
from sklearn_hd.algorithms.lti.simulation import continuous_poles
from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.plotting._display import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    IMAGINARY,
    LIGHT,
    ORANGE,
    POINTS,
    PURPLE,
    REAL,
    RED,
    SKY,
    Display,
    by_label,
    dress,
    find_step,
    fitted_step,
    is_real,
    looks,
    sample_time,
)
from sklearn_hd.reduction import SpuriousModeReducer
from sklearn_hd.subspace import MOESPRegressor
from sklearn_hd.systems import LTPSystem

VERDICTS = {  # marker, colour, size, words
    "window": (".", GREY, 6, "window's memory"),
    "copy": ("^", ORANGE, 7, "copy of a genuine mode"),
    "weak": ("s", PURPLE, 5, "weak"),
    "ambiguous": ("D", SKY, 6, "kept, ambiguous"),
    "second-order": ("v", GREEN, 6, "kept, second-order"),
    "genuine": ("x", BLUE, 8, "genuine, kept"),
}
MODEL = ("+", RED, 12)
DAMPING_RATIOS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)  # rays of the grid
TRUE = ("o", BLACK, 13, "true")
IN_DOUBT = ("s", SKY, 15, "in doubt")
OPINION = ("2", SKY, 12, "second opinion")


class EigenvalueDisplay(Display):
    """Eigenvalues of models: all modes with their verdicts, the model after them, the truth.

    Seen through a sliding window each mode λ has copies λ + jpω; the modes of one
    family, which share one Floquet multiplier e^{λT}, are joined by a line.

    Parameters
    ----------
    modes : DataFrame, optional
        ``modes_`` of a SpuriousModeReducer: the columns eigenvalue, family, verdict.
    model : DataFrame or array_like, shape (n_states,), or a dict of them by label, optional
        Eigenvalues of the model in use, 1/s; a DataFrame has the columns eigenvalue and,
        where they are known, the standard deviations std_real and std_imag. Several models
        have a marker each.
    true : array_like, shape (n_states,), optional
        Eigenvalues of the truth, 1/s.
    omega : float, optional
        In rad/s; the strip of width ω in which Floquet exponents are told apart is marked.
    model_name : str, default="identified"
        What the legend calls the model.
    doubts : DataFrame, optional
        Eigenvalues that a second opinion does not confirm, in 1/s: the columns eigenvalue and
        opinion, what it has next to it (NaN where it has no value of its own).

    Attributes
    ----------
    ax_ : Axes
    figure_ : Figure
    mode_points_ : dict of Line2D
        By verdict.
    family_lines_ : list of Line2D
    model_points_, true_points_ : Line2D or None
        ``model_points_`` is a dict by label where several models are drawn.
    grid_lines_ : list of Line2D
        Of constant damping ratio, then of constant natural frequency.
    uncertainty_ : list of Ellipse or Line2D
        Of the model's eigenvalues; a line for real ones.
    doubt_points_, opinion_points_ : Line2D or None
        Eigenvalues in doubt, and what the second opinion has.
    legend_ : Legend or None

    Raises
    ------
    ValueError
        If ``doubts`` lacks one of its columns.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, section 2.3 and Figs. 4 to 15.

    Examples
    --------
    >>> import pandas as pd
    >>> modes = pd.DataFrame(
    ...     {
    ...         "eigenvalue": [-1 + 1j, -1 - 1j, -1 + 9j, -1 - 9j],
    ...         "family": [0, 1, 1, 0],
    ...         "verdict": ["genuine", "genuine", "copy", "copy"],
    ...     }
    ... )
    >>> display = EigenvalueDisplay(modes, true=[-1.02 + 1j, -1.02 - 1j], omega=10.0).plot()
    >>> list(display.mode_points_)
    ['copy', 'genuine']
    """

    def __init__(
        self,
        modes=None,
        *,
        model=None,
        true=None,
        omega=None,
        model_name="identified",
        doubts=None,
    ):
        if doubts is not None and not {"eigenvalue", "opinion"} <= set(doubts):
            raise ValueError(
                f"doubts has {list(doubts)}; it must be a DataFrame with the columns eigenvalue "
                f"and opinion (NaN where the second opinion has no value)"
            )
        self.modes, self.doubts = modes, doubts
        named = {} if model is None else by_label(model, model_name)
        self._models = {label: _eigenvalue_table(z) for label, z in named.items()}
        self.model = self._models if isinstance(model, dict) else self._models.get(model_name)
        self.true = None if true is None else np.asarray(true, dtype=complex).ravel()
        self.omega = omega
        self.model_name = model_name

    @classmethod
    def from_estimator(cls, estimator, true=None, *, level=0.95, grid=False, ax=None):
        """Draw what a fitted pipeline, or a step of it, has found.

        Of a single model, exponents that the record's second opinion does not confirm are marked.

        Parameters
        ----------
        estimator : model step of sklearn_hd, or Pipeline or search that holds some
            Fitted. The modes are those of its SpuriousModeReducer, the model is that of
            its StructuredMatcher, or of the last model step where there is no reducer.
            Several, in a dict by label, are drawn together, their models alone.
        true : array_like, LTPSystem or control.StateSpace, optional
            The truth: eigenvalues in 1/s, shape (n_states,), or a system (an LTPSystem by
            its Floquet exponents).
        level : float, default=0.95
            Probability with which an ellipse holds the eigenvalue.
        """
        if isinstance(estimator, dict):
            lasts = {k: fitted_step(e, ModelStep, cls.__name__) for k, e in estimator.items()}
            found = {k: _found(e, lasts[k]) for k, e in estimator.items()}
            omegas = {getattr(step.basis_, "omega", None) for step in lasts.values()}
            omega = omegas.pop() if len(omegas) == 1 else None
            display = cls(model=found, true=_of_truth(true), omega=omega)
            return display.plot(ax=ax, level=level, grid=grid)
        last = fitted_step(estimator, ModelStep, cls.__name__)
        reducer = find_step(estimator, SpuriousModeReducer)
        matcher = find_step(estimator, StructuredMatcher)
        model = None if matcher is None and reducer is not None else _found(estimator, last)
        display = cls(
            None if reducer is None else reducer.modes_,
            model=model,
            true=_of_truth(true),
            omega=getattr(last.basis_, "omega", None),
            model_name="identified" if matcher is None else "after matching",
            doubts=_doubts(estimator, last.model_.exponents() if model is None else model),
        )
        return display.plot(ax=ax, level=level, grid=grid)

    @classmethod
    def from_systems(cls, systems, true=None, *, omega=None, grid=False, ax=None):
        """Draw the poles of systems, LTPSystems by their Floquet exponents, on one axis.

        Parameters
        ----------
        systems : control.StateSpace or LTPSystem, or a dict of them by label
            Discrete ones are drawn where the logarithm of their poles lies, in 1/s.
        omega : float, optional
            In rad/s; that of an LTPSystem by default.
        """
        systems = by_label(systems, "model")
        speeds = {s.omega for s in systems.values() if isinstance(s, LTPSystem)}
        if omega is None and len(speeds) == 1:
            (omega,) = speeds
        poles = {label: _poles_of(system) for label, system in systems.items()}
        return cls(model=poles, true=_of_truth(true), omega=omega).plot(ax=ax, grid=grid)

    def plot(self, ax=None, *, level=0.95, grid=False, legend=True):
        """Draw, on a new figure by default.

        The view holds the origin and all but the window's memory, which may lie far to
        the left; the legend says how many modes lie outside.

        Parameters
        ----------
        grid : bool, default=False
            Whether to draw lines of constant damping ratio and of constant natural frequency;
            where ω is known, also the edges of the strips of Floquet exponents.
        legend : bool, default=True
            Whether to draw a legend.

        Raises
        ------
        ValueError
            If ``level`` is no probability, or there is nothing to draw.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level={level!r} must be a probability between 0 and 1, such as 0.95")
        if all(part is None for part in (self.modes, self.model, self.true)):
            raise ValueError("there is nothing to draw; give modes, model or true")
        panels = self._panels(ax, (6.4, 5.0))
        dress(self.ax_, x=REAL, y=IMAGINARY)
        self.ax_.axvline(0.0, color=BLACK, lw=0.8, zorder=0.5)
        view = self._view(level)
        self._mark_strip(view)
        self.true_points_ = None
        if self.true is not None:
            self.true_points_ = self._points(self.true, *TRUE, view, mew=1.4)
        self.family_lines_, self.mode_points_ = [], {}
        if self.modes is not None:
            self._draw_modes(view)
        self._draw_models(level, view)
        self._draw_doubts(view)
        self.ax_.set(xlim=view[0], ylim=view[1])
        self.grid_lines_ = self._draw_grid(view) if grid else []
        self.legend_ = panels.legend(columns=3) if legend else None
        return self

    def _draw_models(self, level, view):
        """Poles of each model, told apart by markers where there are several."""
        self.model_points_, self.uncertainty_ = None, []
        models, styles = self._models, [MODEL]
        if len(models) > 1:
            styles = [
                (marker, look["color"], 8)
                for marker, look in zip(cycle("+xsD^v"), looks(POINTS, len(models)), strict=False)
            ]
        points = {
            label: self._points(model["eigenvalue"].to_numpy(), *style, label, view)
            for (label, model), style in zip(models.items(), styles, strict=False)
        }
        if points:
            self.model_points_ = points if len(points) > 1 else next(iter(points.values()))
        for label, line in points.items():
            self._draw_uncertainty(level, label, line.get_color())

    def _draw_doubts(self, view):
        """A frame round each eigenvalue in doubt, joined to what the second opinion has."""
        self.doubt_points_ = self.opinion_points_ = None
        if self.doubts is None or self.doubts.empty:
            return
        z, other = (self.doubts[c].to_numpy(complex) for c in ("eigenvalue", "opinion"))
        self.doubt_points_ = self._points(z, *IN_DOUBT, view, mew=1.2)
        has = np.isfinite(other)
        if has.any():
            for ends in zip(z[has], other[has], strict=True):
                self.ax_.plot(np.real(ends), np.imag(ends), color=SKY, lw=0.8, zorder=1)
            self.opinion_points_ = self._points(other[has], *OPINION, view)

    def _draw_grid(self, view):
        """Damping ratios as rays from the origin, natural frequencies as circles round it."""
        (left, right), (low, high) = view
        far = np.hypot(max(abs(left), abs(right)), max(abs(low), abs(high)))
        style = {"color": GREY, "lw": 0.6, "ls": ":", "zorder": 0.3}
        words = {"fontsize": 7.5, "color": GREY, "annotation_clip": True}
        words |= {"textcoords": "offset points", "bbox": {"fc": "white", "ec": "none", "pad": 0.5}}
        lines, taken, room = [], [], (right - left, high - low)
        self.ax_.grid(False)
        for ratio in DAMPING_RATIOS:
            up = np.sqrt(1.0 - ratio**2)
            for side in (-1.0, 1.0):
                lines += self.ax_.plot([0.0, -ratio * far], [0.0, side * up * far], **style)
            at_top = -left * up >= high * ratio  # the ray leaves through the top of the view
            y = high if at_top else -left * up / ratio
            x = -high * ratio / up if at_top else left
            near = any(np.hypot((x - u) / room[0], (y - v) / room[1]) < 0.07 for u, v in taken)
            if high > 0.0 > left and not near and y > 0.04 * room[1] and -x > 0.04 * room[0]:
                taken.append((x, y))
                self.ax_.annotate(f"ζ = {ratio:g}", (x, y), (3, -2), va="top", **words)
        angle = np.linspace(0.5 * np.pi, 1.5 * np.pi, 181)
        for size in MaxNLocator(5).tick_values(0.0, max(abs(left), abs(low), abs(high)))[1:]:
            lines += self.ax_.plot(size * np.cos(angle), size * np.sin(angle), **style)
            if size < 0.97 * high:
                self.ax_.annotate(f"{size:g} rad/s", (0.0, size), (3, 0), va="center", **words)
        lines[0].set_label("damping ratio ζ, natural frequency")
        if self.omega is not None:
            edge = {"color": GREY, "lw": 0.8, "ls": "--", "zorder": 0.3}
            first, last = np.ceil(low / self.omega - 0.5), np.floor(high / self.omega - 0.5)
            label = "edges of strips, (k + ½) ω"
            for k in np.arange(first, last + 1.0)[:40]:
                lines.append(self.ax_.axhline((k + 0.5) * self.omega, label=label, **edge))
                label = None
        return lines

    def _view(self, level):
        """Limits that hold all that is not the window's memory."""
        parts = [] if self.true is None else [self.true]
        for label, model in self._models.items():
            parts.append(model["eigenvalue"].to_numpy())
            for z, right, up in self._reaches(level, label):
                parts += [z + right * a + 1j * up * b for a in (-1, 1) for b in (-1, 1)]
        if self.modes is not None:
            window = (self.modes["verdict"] == "window").to_numpy()
            seen = window if window.all() else ~window
            parts.append(self.modes["eigenvalue"].to_numpy()[seen])
        if self.doubts is not None:
            z, other = (self.doubts[c].to_numpy(complex) for c in ("eigenvalue", "opinion"))
            parts += [z, other[np.abs(other - z) <= np.abs(z)]]  # a far one is out of view
        parts.append([0.0])  # how near to instability is seen from the origin
        z = np.concatenate([np.ravel(part) for part in parts])
        extent = np.ptp(z.real), np.ptp(z.imag)
        size = max(*extent, 1e-3 * np.abs(z).max(), np.finfo(float).tiny)
        limits = []
        for values, width in zip((z.real, z.imag), extent, strict=True):
            room = 0.12 * max(width, 0.2 * size)
            limits.append((values.min() - room, values.max() + room))
        return limits

    def _points(self, z, marker, colour, size, label, view, mew=1.8):
        outside = sum(
            not (view[0][0] <= v.real <= view[0][1] and view[1][0] <= v.imag <= view[1][1])
            for v in z
        )
        if outside:
            label = f"{label} ({outside} out of view)"
        style = {"color": colour, "ms": size, "mew": mew, "mfc": "none", "ls": ""}
        return self.ax_.plot(z.real, z.imag, marker=marker, label=label, **style)[0]

    def _draw_modes(self, view):
        modes = self.modes
        for family, members in modes.groupby("family"):
            if family >= 0 and len(members) > 1:
                z = np.sort_complex(1j * members["eigenvalue"].to_numpy()) / 1j
                z = z[np.argsort(z.imag)]
                style = {"color": GREY, "lw": 0.8, "ls": (0, (2, 2)), "zorder": 1}
                self.family_lines_ += self.ax_.plot(z.real, z.imag, **style)
        if self.family_lines_:
            self.family_lines_[0].set_label("same family")
        for verdict, look in VERDICTS.items():
            z = modes.loc[modes["verdict"] == verdict, "eigenvalue"].to_numpy()
            if len(z):
                self.mode_points_[verdict] = self._points(z, *look, view)

    def _reaches(self, level, label):
        """Eigenvalues of known uncertainty, and how far it reaches in both directions."""
        model = self._models[label]
        if "std_real" not in model:
            return []
        joint, alone = np.sqrt(chi2.ppf(level, 2)), norm.ppf(0.5 + 0.5 * level)
        columns = model[["eigenvalue", "std_real", "std_imag"]]
        return [
            (z, alone * std_real, 0.0) if is_real(z) else (z, joint * std_real, joint * std_imag)
            for z, std_real, std_imag in columns.itertuples(index=False)
            if np.isfinite(std_real + std_imag)
        ]

    def _draw_uncertainty(self, level, model, colour):
        label = f"{100 * level:g} % confidence" if not self.uncertainty_ else None
        for z, right, up in self._reaches(level, model):
            if is_real(z):
                ends = [z.real - right, z.real + right]
                style = {"color": colour, "lw": 1.6, "marker": "|", "ms": 7, "label": label}
                self.uncertainty_ += self.ax_.plot(ends, [0.0, 0.0], **style)
            else:
                style = {"fill": False, "ec": colour, "lw": 1.2, "label": label}
                ellipse = Ellipse((z.real, z.imag), 2.0 * right, 2.0 * up, **style)
                self.uncertainty_.append(self.ax_.add_patch(ellipse))
            label = None

    def _mark_strip(self, view):
        if self.omega is None or max(view[1]) < 0.5 * self.omega:
            return
        style = {"color": LIGHT, "zorder": 0, "lw": 0, "label": "|imaginary part| < ω/2"}
        self.ax_.axhspan(-0.5 * self.omega, 0.5 * self.omega, alpha=0.5, **style)


def _eigenvalue_table(model):
    if isinstance(model, pd.DataFrame):
        return model
    return pd.DataFrame({"eigenvalue": np.asarray(model, dtype=complex).ravel()})


def _found(estimator, last):
    """Eigenvalues of the model of an estimator: matched, or of its last step.

    Floquet exponents of periodic structures; with deviations if known.
    """
    matcher = find_step(estimator, StructuredMatcher)
    if matcher is None:
        return last.model_.exponents()
    if hasattr(matcher, "eigenvalues_"):  # after maximum likelihood
        return matcher.eigenvalues_
    if hasattr(matcher, "ltp_"):  # of a periodic structure
        return matcher.ltp_.floquet_exponents()
    return matcher.system_.poles()


def _doubts(estimator, found):
    """Eigenvalues that the second opinion of a record does not confirm, and what it has."""
    step = find_step(estimator, (MOESPRegressor, SpuriousModeReducer))
    opinion = None if step is None else step.model_.opinion
    if opinion is None:
        return None
    z = _eigenvalue_table(found)["eigenvalue"].to_numpy(complex)
    doubt = doubtful(z, opinion)
    other = np.full(len(z), np.nan) if opinion.own else opinion.about(z)[0]
    return pd.DataFrame({"eigenvalue": z[doubt], "opinion": other[doubt]})


def _poles_of(system):
    """Poles of a system in 1/s, Floquet exponents of a periodic one."""
    if isinstance(system, LTPSystem):
        return system.floquet_exponents()
    return continuous_poles(system.poles(), sample_time(system))


def _of_truth(true):
    is_system = isinstance(true, LTPSystem) or hasattr(true, "poles")
    return _poles_of(true) if is_system else true
