"""Entries of periodic matrices over the period."""

import numpy as np

from sklearn_hd._checks import check_choice
from sklearn_hd.plotting._fitted import by_label
from sklearn_hd.plotting._panels import Panels
from sklearn_hd.plotting._participation import check_periodic, periodic_system
from sklearn_hd.plotting._style import LINES, REFERENCE, dress, looks

__all__ = ["PeriodicMatrixDisplay"]

POINTS = 361  # a degree apart
MATRICES = ("F", "G", "P", "Q")
SMALL = 4  # rows or columns, from which on panels and letters are smaller
LEAST = 0.4  # of an entry's largest value, the height of its panel
NEGLIGIBLE = 0.02  # of the largest entries of its row and of its column, the same


class PeriodicMatrixDisplay:
    """Entries of F(ψ), G(ψ), P(ψ) or Q(ψ) over the period, identified against true.

        ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt

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

    def __init__(self, psi, values, *, row_names, column_names, matrix="F", reference=None):
        self.psi = psi
        self.values = values
        self.row_names = list(row_names)
        self.column_names = list(column_names)
        self.matrix = matrix
        self.reference = reference

    @classmethod
    def from_estimator(cls, estimator, matrix="F", *, true=None, ax=None):
        """Draw a matrix of an identified linear time-periodic system.

        Parameters
        ----------
        estimator : StructuredMatcher, or Pipeline or search that holds one
            Fitted with a periodic structure.
        matrix : {"F", "G", "P", "Q"}, default="F"
            Which to draw.
        true : LTPSystem, optional
            The truth, of the same states and signals.
        ax : Axes or array of Axes, optional
            One Axes an entry, or one that is divided.

        Returns
        -------
        display : PeriodicMatrixDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If there is no StructuredMatcher, or ``true`` is no LTPSystem.
        NotFittedError
            If it has not been fitted.
        ValueError
            If its structure is time-invariant, or the truth has other states.
        """
        system = periodic_system(estimator, cls.__name__)
        return cls.from_systems({"identified": system}, matrix, true=true, ax=ax)

    @classmethod
    def from_systems(cls, systems, matrix="F", *, true=None, ax=None):
        """Draw a matrix of linear time-periodic systems.

        Parameters
        ----------
        systems : LTPSystem, or a dict of them by label
            Of the same states and signals, which may be in another order.
        matrix : {"F", "G", "P", "Q"}, default="F"
            Which to draw.
        true : LTPSystem, optional
            The truth, of the same states and signals.
        ax : Axes or array of Axes, optional
            One Axes an entry, or one that is divided.

        Returns
        -------
        display : PeriodicMatrixDisplay
            Drawn; what it draws stands in its attributes.

        Raises
        ------
        TypeError
            If a system is no LTPSystem.
        ValueError
            If there is no such matrix, or systems have different states or signals.
        """
        check_choice("matrix", matrix, MATRICES)
        systems = by_label(systems, "model")
        if true is not None:
            systems = {"true": true, **systems}
        for label, system in systems.items():
            check_periodic(system, cls.__name__, label)
        psi = np.linspace(0.0, 2.0 * np.pi, POINTS)
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
        return display.plot(ax=ax)

    def plot(self, ax=None):
        """Draw, on a new figure by default.

        Parameters
        ----------
        ax : Axes or array of Axes, optional
            One Axes an entry, row by row, or one that is divided.

        Returns
        -------
        display : PeriodicMatrixDisplay
            Drawn; what it draws stands in its attributes.
        """
        shape = len(self.row_names), len(self.column_names)
        small = max(shape) >= SMALL
        wide, high = (min(1.7, 17.0 / shape[1]), 1.3) if small else (3.0, 2.2)
        panels = Panels(
            ax,
            list(np.ndindex(shape)),
            size=(max(4.6, wide * shape[1] + 0.6), 0.8 + high * shape[0]),
            share_x="all",
            names="one an entry, row by row",
        )
        self.axes_, self.figure_, self.lines_ = panels.axes, panels.figure, {}
        own = [label for label in self.values if label != self.reference]
        styles = dict(zip(own, looks(LINES, len(own)), strict=True))
        if self.reference is not None:
            styles[self.reference] = REFERENCE | {"lw": 4.0}
        for (i, j), axis in zip(np.ndindex(shape), panels.axes, strict=True):
            for label, M in self.values.items():
                style = styles[label] | {"label": label}
                place = label, self.row_names[i], self.column_names[j]
                (self.lines_[place],) = axis.plot(np.degrees(self.psi), M[:, i, j], **style)
            self._limit(axis, i, j)
            title = f"{self.matrix}[{self.row_names[i]}, {self.column_names[j]}]"
            dress(axis, title=title, small=small, x="ψ (deg)" if i == shape[0] - 1 else None)
            axis.set(xlim=(0, 360), xticks=(0, 90, 180, 270, 360) if not small else (0, 180, 360))
        self.legend_ = panels.legend() if len(self.values) > 1 else None
        return self

    def _limit(self, axis, i, j):
        """No magnifying: what hardly changes is drawn as what hardly changes."""
        sizes = np.max([np.abs(M).max(axis=0) for M in self.values.values()], axis=0)
        least = max(
            LEAST * sizes[i, j],
            NEGLIGIBLE * min(sizes[i].max(), sizes[:, j].max()),
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
    own = _names(system, matrix)
    for found, wanted in zip(own, (rows, columns), strict=True):
        if set(found) != set(wanted):
            raise ValueError(
                f"{label!r} has the names {found}, the others {wanted}: entries of different "
                f"coordinates cannot be compared; give the same names, or compare responses "
                f"(HarmonicTransferFunctionDisplay)"
            )
    places = [
        [found.index(n) for n in wanted] for found, wanted in zip(own, (rows, columns), strict=True)
    ]
    return np.asarray(getattr(system, matrix)(psi))[np.ix_(range(len(psi)), *places)]
