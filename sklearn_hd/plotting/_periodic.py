"""Linear time-periodic systems as they are: modes by harmonic, matrices over the period."""

from dataclasses import KW_ONLY, dataclass

import numpy as np
import pandas as pd

from sklearn_hd._checks import check_choice
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.plotting._display import (
    BARS,
    Display,
    by_label,
    check_periodic,
    complex_number,
    dress,
    grid_of,
    line_styles,
    looks,
    periodic_system,
    places,
    step_of_samples,
    unit_of,
)

OF_SYSTEMS = ("F", "G", "P", "Q")
OF_SAMPLES = ("A", "B", "C", "D", "K")


@dataclass(eq=False, repr=False)
class ParticipationDisplay(Display, axes="one Axes a state"):
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

    shares: pd.DataFrame
    _: KW_ONLY
    mode_names: list | None = None

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

        Raises
        ------
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
        state_names : dict, optional
            What to call states in the titles.
        """
        states = list(dict.fromkeys(self.shares.index.get_level_values("state")))
        known = set(self.shares.columns)
        modes = [z for z in self.shares if z.imag >= 0.0 or z.conjugate() not in known]
        names = self._names(modes)
        most = 2 if len(states) <= 4 else 3 if len(states) <= 9 else 4
        rows, columns = grid_of(len(states), most=most)
        size = max(4.2, 3.5 * columns), 0.7 + 2.5 * rows
        cells = places(len(states), columns)
        panels = self._panels(ax, size, cells, share_x="all", share_y="all")
        self.bars_ = {}
        width = 0.8 / len(modes)
        for k, (state, axis) in enumerate(zip(states, panels.axes, strict=True)):
            part = self.shares.loc[state]
            styles = looks(BARS, len(modes))
            for j, (z, name, style) in enumerate(zip(modes, names, styles, strict=True)):
                x = part.index.to_numpy() + (j - 0.5 * (len(modes) - 1)) * width
                bars = axis.bar(x, part[z], 0.92 * width, label=name, **style)
                self.bars_[state, z] = bars
                if len(modes) <= 3 and len(states) <= 4:
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


@dataclass(eq=False, repr=False)
class PeriodicMatrixDisplay(Display, axes="one Axes an entry, row by row"):
    """Entries of F(ψ), G(ψ), P(ψ) or Q(ψ) over the period, identified against true.

        ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt

    Of a model of samples at their azimuths A(ψ), B(ψ), C(ψ), D(ψ) or K(ψ), whose states are no
    one's: :class:`AzimuthDisplay` draws what does not depend on them.

        x[k+1] = A(ψ) x[k] + B(ψ) u[k] + a(ψ) + K(ψ) e[k],
        y[k] = C(ψ) x[k] + D(ψ) u[k] + c(ψ) + e[k],   ψ = ψ_k

    Parameters
    ----------
    psi : ndarray, shape (n_points,)
        Radians.
    values : dict of ndarray, shape (n_points, rows, columns)
        By label.
    row_names, column_names : sequence of str
        Names of what the rows and columns stand for.
    matrix : str, default="F"
        What the matrix is called.
    reference : str, optional
        Label of the matrix drawn broad and grey: the truth.

    Attributes
    ----------
    axes_ : ndarray of Axes, shape (rows * columns,)
        Row by row.
    figure_ : Figure
    lines_ : dict of Line2D
        By label, row and column.
    legend_ : Legend or None

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 6.

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> display = PeriodicMatrixDisplay.from_systems(mathieu(), matrix="F")
    >>> len(display.axes_)
    4
    """

    psi: np.ndarray
    values: dict
    _: KW_ONLY
    row_names: list
    column_names: list
    matrix: str = "F"
    reference: str | None = None

    @classmethod
    def from_estimator(cls, estimator, matrix="F", *, true=None, units=None, ax=None):
        """Draw a matrix of an identified linear time-periodic system.

        Parameters
        ----------
        estimator : StructuredMatcher, or Pipeline or search that holds one
            Fitted with a periodic structure; or a MOESPRegressor fitted behind
            ``HarmonicAnalyzer(reading="sample")``.
        matrix : {"F", "G", "P", "Q"} or {"A", "B", "C", "D", "K"}, default="F"
            Which to draw; the latter are of a MOESPRegressor, from sample to sample.
        true : LTPSystem, optional
            The truth, of the same states and signals.

        Raises
        ------
        ValueError
            If there is no such matrix, the structure is time-invariant, the truth has other
            states, or it is given for a matrix from sample to sample.
        """
        if check_choice("matrix", matrix, OF_SYSTEMS + OF_SAMPLES) in OF_SAMPLES:
            return cls._of_samples(estimator, matrix, true).plot(ax=ax, units=units)
        system = periodic_system(estimator, cls.__name__)
        return cls.from_systems({"identified": system}, matrix, true=true, units=units, ax=ax)

    @classmethod
    def from_systems(cls, systems, matrix="F", *, true=None, units=None, ax=None):
        """Draw a matrix of linear time-periodic systems.

        Parameters
        ----------
        systems : LTPSystem, or a dict of them by label
            Of the same states and signals, which may be in another order.

        Raises
        ------
        TypeError
            If a system is no LTPSystem.
        ValueError
            If there is no such matrix, or systems have different states or signals.
        """
        check_choice("matrix", matrix, OF_SYSTEMS)
        systems = by_label(systems, "model")
        if true is not None:
            systems = {"true": true, **systems}
        for label, system in systems.items():
            check_periodic(system, cls.__name__, label)
        psi = np.linspace(0.0, 2.0 * np.pi, num=361)
        rows, columns = _names(next(reversed(systems.values())), matrix)
        values = {
            label: _entries(label, system, matrix, psi, rows, columns)
            for label, system in systems.items()
        }
        display = cls(
            psi,
            values,
            row_names=rows,
            column_names=columns,
            matrix=matrix,
            reference=None if true is None else "true",
        )
        return display.plot(ax=ax, units=units)

    @classmethod
    def _of_samples(cls, estimator, matrix, true):
        """A matrix of a model of samples."""
        if true is not None:
            raise ValueError(
                f"matrix={matrix!r} has states of its own, which cannot be compared with those of "
                f"true; leave true=None, or draw F, G, P or Q"
            )
        model = step_of_samples(estimator, cls.__name__).model_
        states = [f"x{k}" for k in range(1, model.n_states + 1)]
        rows = model.output_names if matrix in "CD" else states
        columns = {"B": model.input_names, "D": model.input_names, "K": model.output_names}
        parts = dict(zip("ABCD", model.innovations.matrices(), strict=True))
        psi = np.linspace(0.0, 2.0 * np.pi, num=361)
        values = evaluate_harmonics(parts.get(matrix, model.innovations.gain), psi)
        names = {"row_names": list(rows), "column_names": list(columns.get(matrix, states))}
        return cls(psi, {"identified": values}, matrix=matrix, **names)

    def plot(self, ax=None, *, units=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        units : dict, optional
            Unit of each state and signal; entries between two that have one are labelled.
        """
        shape = len(self.row_names), len(self.column_names)
        small = max(shape) >= 4
        wide, high = (min(1.7, 17.0 / shape[1]), 1.3) if small else (3.0, 2.2)
        size = max(4.6, wide * shape[1] + 0.6), 0.8 + high * shape[0]
        panels = self._panels(ax, size, list(np.ndindex(shape)), share_x="all")
        self.lines_, styles = {}, line_styles(self.values, self.reference)
        for (i, j), axis in zip(np.ndindex(shape), panels.axes, strict=True):
            names = self.row_names[i], self.column_names[j]
            for label, M in self.values.items():
                style = styles[label] | {"label": label}
                (self.lines_[label, *names],) = axis.plot(np.degrees(self.psi), M[:, i, j], **style)
            self._limit(axis, i, j)
            title = f"{self.matrix}[{names[0]}, {names[1]}]"
            unit = self._unit(*(unit_of(name, units) for name in names))
            below = "ψ (deg)" if i == shape[0] - 1 else None
            dress(axis, title=title, small=small, x=below, y=unit)
            axis.set(xlim=(0, 360), xticks=(0, 90, 180, 270, 360) if not small else (0, 180, 360))
            if small:  # ticks that change with the height would not be those of the layout
                axis.yaxis.get_major_locator().set_params(nbins=4)
        self.legend_ = panels.legend() if len(self.values) > 1 else None
        return self

    def _unit(self, row, column):
        """Unit of an entry; None where that of its row or column is not known."""
        if row is None or column is None:
            return None
        rate = "/s" if self.matrix in "FG" else ""
        if row == column:
            return f"1{rate}" if rate else None
        return f"({row}){rate} per {column}" if "/" in row and rate else f"{row}{rate} per {column}"

    def _limit(self, axis, i, j):
        """No magnifying: what hardly changes is drawn as what hardly changes.

        The view is 0.4 of the entry's largest value high at least, and 0.02 of the largest
        entries of its row and of its column.
        """
        sizes = np.max([np.abs(M).max(axis=0) for M in self.values.values()], axis=0)
        least = max(
            0.4 * sizes[i, j],
            0.02 * min(sizes[i].max(), sizes[:, j].max()),
            np.finfo(float).tiny,
        )
        entries = np.concatenate([M[:, i, j] for M in self.values.values()])
        if np.ptp(entries) < least:
            middle = 0.5 * (entries.min() + entries.max())
            axis.set_ylim(middle - 0.5 * least, middle + 0.5 * least)


def _names(system, matrix):
    rows = system.output_names if matrix in "PQ" else system.state_names
    columns = system.input_names if matrix in "GQ" else system.state_names
    return list(rows), list(columns)


def _entries(label, system, matrix, psi, rows, columns):
    """Values over the period, rows and columns in the order of some names."""
    places = []
    for found, wanted in zip(_names(system, matrix), (rows, columns), strict=True):
        if set(found) != set(wanted):
            raise ValueError(
                f"{label!r} has the names {found}, but the others have {wanted}, and entries in "
                f"different coordinates cannot be compared; give the same names, or compare "
                f"responses (HarmonicTransferFunctionDisplay)"
            )
        places.append([found.index(name) for name in wanted])
    return np.asarray(getattr(system, matrix)(psi))[np.ix_(range(len(psi)), *places)]
