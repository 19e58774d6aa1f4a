"""Which harmonics of which states move in which mode."""

from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.plotting._fitted import fitted_step
from sklearn_hd.plotting._panels import Panels, places
from sklearn_hd.plotting._style import BARS, complex_number, dress, looks
from sklearn_hd.systems import LTPSystem

__all__ = ["ParticipationDisplay"]

WIDTH = 0.8  # of the bars of one harmonic together
LEGIBLE = 3  # bars of one harmonic, up to which their values are written on them


class ParticipationDisplay:
    """Share of each harmonic of a state in that state's motion, by mode (Fig. 1).

    Parameters
    ----------
    shares : DataFrame, n (N + 1) rows by n modes
        As :meth:`~sklearn_hd.systems.LTPSystem.modal_participation` returns it: index
        (state, harmonic), columns the eigenvalues in 1/s. Of conjugate pairs one is drawn.
    mode_names : sequence of str, optional
        Of the modes drawn, from the rightmost leftwards.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (n_states,)
    figure_ : Figure
    bars_ : dict of BarContainer
        By state and eigenvalue.
    legend_ : Legend

    References
    ----------
    Peters, Lieb (2009), American Helicopter Society Forum 65; Aerospace 2024, 11(11),
    875, Fig. 1.

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> display = ParticipationDisplay.from_system(mathieu(), n_harmonics=2)
    >>> len(display.axes_), len(display.axes_[0].containers)
    (2, 1)
    """

    def __init__(self, shares, *, mode_names=None):
        self.shares = shares
        self.mode_names = mode_names

    @classmethod
    def from_estimator(cls, estimator, n_harmonics=1, *, mode_names=None, ax=None):
        """Draw the modes of an identified linear time-periodic system.

        Parameters
        ----------
        estimator : StructuredMatcher, or Pipeline or search that holds one
            Fitted with a periodic structure.
        n_harmonics : int, default=1
            Harmonics kept of the states.
        mode_names : sequence of str, optional
            Of the modes drawn, from the rightmost leftwards.
        ax : Axes or array of Axes, optional
            One Axes a state, or one that is divided.

        Returns
        -------
        display : ParticipationDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If there is no StructuredMatcher.
        NotFittedError
            If it has not been fitted.
        ValueError
            If its structure is time-invariant.
        """
        system = periodic_system(estimator, cls.__name__)
        return cls.from_system(system, n_harmonics, mode_names=mode_names, ax=ax)

    @classmethod
    def from_system(cls, system, n_harmonics=1, *, mode_names=None, ax=None):
        """Draw the modes of a linear time-periodic system.

        Parameters
        ----------
        system : LTPSystem
            Whose modes to draw.
        n_harmonics : int, default=1
            Harmonics kept of the states.
        mode_names : sequence of str, optional
            Of the modes drawn, from the rightmost leftwards.
        ax : Axes or array of Axes, optional
            One Axes a state, or one that is divided.

        Returns
        -------
        display : ParticipationDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If the system is no LTPSystem.
        ValueError
            If the names are not as many as the modes drawn.
        """
        check_periodic(system, cls.__name__)
        return cls(system.modal_participation(n_harmonics), mode_names=mode_names).plot(ax=ax)

    def plot(self, ax=None, *, state_names=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        ax : Axes or array of Axes, optional
            One Axes a state, or one that is divided.
        state_names : dict, optional
            What to call states in the titles.

        Returns
        -------
        display : ParticipationDisplay
            Drawn; what it draws stands in its attributes.
        """
        states = list(dict.fromkeys(self.shares.index.get_level_values("state")))
        known = set(self.shares.columns)
        modes = [z for z in self.shares if z.imag >= 0.0 or z.conjugate() not in known]
        names = self._names(modes)
        columns = min(len(states), 2 if len(states) <= 4 else 3 if len(states) <= 9 else 4)
        rows = -(-len(states) // columns)
        panels = Panels(
            ax,
            places(len(states), columns),
            size=(max(4.2, 3.5 * columns), 0.7 + 2.5 * rows),
            share_x="all",
            share_y="all",
            names="one a state",
        )
        self.axes_, self.figure_, self.bars_ = panels.axes, panels.figure, {}
        width = WIDTH / len(modes)
        for k, (state, axis) in enumerate(zip(states, panels.axes, strict=True)):
            part = self.shares.loc[state]
            styles = looks(BARS, len(modes))
            for j, (z, name, style) in enumerate(zip(modes, names, styles, strict=True)):
                x = part.index.to_numpy() + (j - 0.5 * (len(modes) - 1)) * width
                bars = axis.bar(x, part[z], 0.92 * width, label=name, **style)
                self.bars_[state, z] = bars
                if len(modes) <= LEGIBLE and len(states) <= 4:
                    axis.bar_label(bars, fmt="%.2f", fontsize=8, padding=2)
            dress(axis, title=(state_names or {}).get(state, state))
            axis.grid(False, axis="x")
            axis.set(xticks=part.index, ylim=(0, 1.12))
            if k % columns == 0:
                axis.set_ylabel("modal participation (–)")
            else:
                axis.tick_params(labelleft=False)
            if k + columns >= len(states):
                axis.set_xlabel("harmonic of the state (–)")
        self.legend_ = panels.legend(columns=2)
        return self

    def _names(self, modes):
        own = [complex_number(z) for z in modes]
        if self.mode_names is None:
            return own
        if len(self.mode_names) != len(modes):
            raise ValueError(
                f"mode_names={list(self.mode_names)} must name the {len(modes)} modes drawn: {own}"
            )
        return [f"{name}, {words}" for name, words in zip(self.mode_names, own, strict=True)]


def periodic_system(estimator, display):
    """The linear time-periodic system that a fitted estimator has identified."""
    matcher = fitted_step(estimator, StructuredMatcher, display)
    if not hasattr(matcher, "ltp_"):
        raise ValueError(
            f"{display} needs a linear time-periodic model, and this match was made with "
            f"structure={matcher.structure!r}; fit with a HarmonicStructure, or with "
            f"HarmonicAnalyzer(reading='period')"
        )
    return matcher.ltp_


def check_periodic(system, display, label=None):
    """Raise TypeError unless a system is linear time-periodic."""
    if not isinstance(system, LTPSystem):
        what = "this" if label is None else repr(label)
        raise TypeError(f"{display} draws LTPSystems; {what} is of type {type(system).__name__}")
