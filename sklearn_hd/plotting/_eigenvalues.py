"""Eigenvalues in the complex plane: identified, judged, matched, true, of several models."""

import numpy as np
import pandas as pd
from matplotlib.patches import Ellipse
from scipy.stats import chi2, norm

from sklearn_hd._model_step import ModelStep
from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.plotting._display import (
    BLACK,
    BLUE,
    GREY,
    IMAGINARY,
    LIGHT,
    ORANGE,
    PURPLE,
    REAL,
    RED,
    SKY,
    Display,
    dress,
    find_step,
    fitted_step,
    is_real,
)
from sklearn_hd.reduction import SpuriousModeReducer
from sklearn_hd.systems import LTPSystem

VERDICTS = {  # marker, colour, size, words
    "window": (".", GREY, 6, "window's memory"),
    "copy": ("^", ORANGE, 7, "copy of a genuine mode"),
    "weak": ("s", PURPLE, 5, "weak"),
    "ambiguous": ("D", SKY, 6, "kept, ambiguous"),
    "genuine": ("x", BLUE, 8, "genuine, kept"),
}
MODEL = ("+", RED, 12)
TRUE = ("o", BLACK, 13, "true")


class EigenvalueDisplay(Display):
    """Eigenvalues of models: all modes with their verdicts, the model after them, the truth.

    Seen through a sliding window each mode λ has copies λ + jpω; the modes of one
    family, which share one Floquet multiplier e^{λT}, are joined by a line.

    Parameters
    ----------
    modes : DataFrame, optional
        ``modes_`` of a SpuriousModeReducer: the columns eigenvalue, family, verdict.
    model : DataFrame or array_like, shape (n_states,), optional
        Eigenvalues of the model in use, 1/s; a DataFrame has the columns eigenvalue and,
        where they are known, the standard deviations std_real and std_imag.
    true : array_like, shape (n_states,), optional
        Eigenvalues of the truth, 1/s.
    omega : float, optional
        In rad/s; the strip of width ω in which Floquet exponents are told apart is marked.
    model_name : str, default="identified"
        What the legend calls the model.

    Attributes
    ----------
    ax_ : Axes
    figure_ : Figure
    mode_points_ : dict of Line2D
        By verdict.
    family_lines_ : list of Line2D
    model_points_, true_points_ : Line2D or None
    uncertainty_ : list of Ellipse or Line2D
        Of the model's eigenvalues; a line for real ones.
    legend_ : Legend or None

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

    def __init__(self, modes=None, *, model=None, true=None, omega=None, model_name="identified"):
        if model is not None and not isinstance(model, pd.DataFrame):
            model = pd.DataFrame({"eigenvalue": np.asarray(model, dtype=complex).ravel()})
        self.modes = modes
        self.model = model
        self.true = None if true is None else np.asarray(true, dtype=complex).ravel()
        self.omega = omega
        self.model_name = model_name

    @classmethod
    def from_estimator(cls, estimator, true=None, *, level=0.95, ax=None):
        """Draw what a fitted pipeline, or a step of it, has found.

        Parameters
        ----------
        estimator : model step of sklearn_hd, or Pipeline or search that holds some
            Fitted. The modes are those of its SpuriousModeReducer, the model is that of
            its StructuredMatcher, or of the last model step where there is no reducer.
        true : array_like, LTPSystem or control.StateSpace, optional
            The truth: eigenvalues in 1/s, shape (n_states,), or a system (an LTPSystem by
            its Floquet exponents).
        level : float, default=0.95
            Probability with which an ellipse holds the eigenvalue.
        """
        last = fitted_step(estimator, ModelStep, cls.__name__)
        reducer = find_step(estimator, SpuriousModeReducer)
        matcher = find_step(estimator, StructuredMatcher)
        model = None
        if matcher is not None:
            model = _matched(matcher)
        elif reducer is None:
            model = last.model_.exponents()
        basis = last.basis_
        display = cls(
            None if reducer is None else reducer.modes_,
            model=model,
            true=_of_truth(true),
            omega=getattr(basis, "omega", None),
            model_name="identified" if matcher is None else "after matching",
        )
        return display.plot(ax=ax, level=level)

    def plot(self, ax=None, *, level=0.95, families=True, legend=True):
        """Draw, on a new figure by default.

        The view holds the origin and all but the window's memory, which may lie far to
        the left; the legend says how many modes lie outside.

        Parameters
        ----------
        families : bool, default=True
            Whether to join the modes of a family.
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
            self._draw_modes(families, view)
        self.model_points_, self.uncertainty_ = None, []
        if self.model is not None:
            found = self.model["eigenvalue"].to_numpy()
            self.model_points_ = self._points(found, *MODEL, self.model_name, view)
            self._draw_uncertainty(level)
        self.ax_.set(xlim=view[0], ylim=view[1])
        self.legend_ = panels.legend(columns=3) if legend else None
        return self

    def _view(self, level):
        """Limits that hold all that is not the window's memory."""
        parts = [] if self.true is None else [self.true]
        if self.model is not None:
            parts.append(self.model["eigenvalue"].to_numpy())
            parts += [z + side for z, *reach in self._reaches(level) for side in _corners(*reach)]
        if self.modes is not None:
            window = (self.modes["verdict"] == "window").to_numpy()
            seen = window if window.all() else ~window
            parts.append(self.modes["eigenvalue"].to_numpy()[seen])
        z = np.concatenate(
            [*map(np.ravel, parts), [0.0]]
        )  # how near to instability is seen from the origin
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
        return self.ax_.plot(z.real, z.imag, marker, label=label, **style)[0]

    def _draw_modes(self, families, view):
        modes = self.modes
        for family, members in modes.groupby("family") if families else ():
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

    def _reaches(self, level):
        """Eigenvalues of known uncertainty, and how far it reaches in both directions."""
        if self.model is None or "std_real" not in self.model:
            return []
        joint, alone = np.sqrt(chi2.ppf(level, 2)), norm.ppf(0.5 + 0.5 * level)
        columns = self.model[["eigenvalue", "std_real", "std_imag"]]
        return [
            (z, alone * std_real, 0.0) if is_real(z) else (z, joint * std_real, joint * std_imag)
            for z, std_real, std_imag in columns.itertuples(index=False)
            if np.isfinite(std_real + std_imag)
        ]

    def _draw_uncertainty(self, level):
        label = f"{100 * level:g} % confidence"
        for z, right, up in self._reaches(level):
            if is_real(z):
                ends = [z.real - right, z.real + right]
                style = {"color": RED, "lw": 1.6, "marker": "|", "ms": 7, "label": label}
                self.uncertainty_ += self.ax_.plot(ends, [0.0, 0.0], **style)
            else:
                style = {"fill": False, "ec": RED, "lw": 1.2, "label": label}
                ellipse = Ellipse((z.real, z.imag), 2.0 * right, 2.0 * up, **style)
                self.uncertainty_.append(self.ax_.add_patch(ellipse))
            label = None

    def _mark_strip(self, view):
        if self.omega is None or max(view[1]) < 0.5 * self.omega:
            return
        style = {"color": LIGHT, "zorder": 0, "lw": 0, "label": "|imaginary part| < ω/2"}
        self.ax_.axhspan(-0.5 * self.omega, 0.5 * self.omega, alpha=0.5, **style)


def _corners(right, up):
    return [np.array([right * a + 1j * up * b]) for a in (-1, 1) for b in (-1, 1)]


def _matched(matcher):
    """Eigenvalues (Floquet exponents of periodic structures), with deviations if known."""
    if hasattr(matcher, "eigenvalues_"):  # after maximum likelihood
        return matcher.eigenvalues_
    if hasattr(matcher, "ltp_"):  # of a periodic structure
        return matcher.ltp_.floquet_exponents()
    return matcher.system_.poles()


def _of_truth(true):
    if isinstance(true, LTPSystem):
        return true.floquet_exponents()
    if hasattr(true, "poles"):
        return true.poles()
    return true
