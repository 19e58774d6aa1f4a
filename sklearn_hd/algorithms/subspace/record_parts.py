"""Equations of B, D and the initial state of a record that is read in parts, anywhere.

Each part is brought to triangular form by itself, as if it were a record: with x_p the state
at its first row,

    [X_p  F_p  y_p] = Q R_p          columns: x_p, B (row by row), D, the outputs

and leaves behind how the state after its last row follows, A^N and Ξ_N = Σ_t A^{N-1-t} u_t:

    x_q = A^N x_p + Ξ_N(B)

Put into the equations of the part right after it, this makes them equations of x_p as well:

    [X_q  F_q  y_q]  →  [X_q A^N   F_q + X_q Ξ_N   y_q]

So two neighbours become one part, by one small triangular factor, and a record in any number
of parts is the whole record, in whatever order neighbours are joined. No products of the data
are formed that the part alone would not stand: what is lost by reading in parts is rounding.
"""

from dataclasses import dataclass, field

import numpy as np

from sklearn_hd.algorithms.linalg.triangular import triangle
from sklearn_hd.algorithms.subspace.input_matrices import (
    RecordFactors,
    carry,
    pieces_of,
    solve_shared,
    without_start,
)
from sklearn_hd.algorithms.subspace.response_basis import split

__all__ = ["InputEquations", "RecordPart", "cuts", "input_equations", "record_part"]


@dataclass(frozen=True)
class RecordPart:
    """Equations of consecutive rows of a record, that others may follow.

    Attributes
    ----------
    R : ndarray, shape (r, n + n m [+ l m] + 1)
        Triangular; columns: the state at the first row, B, D, the outputs.
    power : ndarray, shape (n, n)
        A^N.
    forced : ndarray, shape (n, n m)
        Response of the state after the last row to each entry of B.
    n_rows : int
        N.
    """

    R: np.ndarray
    power: np.ndarray
    forced: np.ndarray
    n_rows: int

    def join(self, later):
        """This part and the rows right after it, as one."""
        n, n_forced = self.forced.shape
        own = later.R[:, :n]
        moved = later.R.copy()
        moved[:, :n] = own @ self.power
        moved[:, n : n + n_forced] += own @ self.forced
        return RecordPart(
            R=triangle(self.R, moved),
            power=later.power @ self.power,
            forced=later.forced + later.power @ self.forced,
            n_rows=self.n_rows + later.n_rows,
        )


def record_part(factors, u, y):
    """Equations of consecutive rows.

    Parameters
    ----------
    factors : RecordFactors
        Of the model and the scales.
    u, y : ndarray, shapes (n_rows, m), (n_rows, l)

    Returns
    -------
    part : RecordPart
    """
    return RecordPart(factors.of(u, y), *carry(factors.A, u / factors.scales[0]), n_rows=len(u))


def cuts(A, lengths):
    """Rows at which each record begins anew with a state of its own, the first and the last too.

    One piece a record, but where A is unstable.

    Parameters
    ----------
    A : ndarray, shape (n, n)
    lengths : sequence of int

    Returns
    -------
    cuts : list of ndarray of int
    """
    edges = [[0] for _ in lengths]
    for record, rows in pieces_of(A, lengths)[0]:
        edges[record].append(rows.stop)
    return [np.array(each) for each in edges]


@dataclass(frozen=True)
class InputEquations:
    """Equations that pieces of records leave for B and D, in the order of their rows.

    Attributes
    ----------
    shared : ndarray, shape (r, n m [+ l m] + 1)
        Triangular; of pieces that are whole.
    starts : dict
        Key of each whole piece to its ``InitialState``.
    open : tuple of (key, int, RecordPart)
        The first and the last piece, where rows of them are yet to come: their keys, and
        how many rows they have when whole.
    """

    shared: np.ndarray
    starts: dict = field(default_factory=dict)
    open: tuple = ()

    def __add__(self, later):
        """With the equations of the rows that follow."""
        parts = list(self.open)
        for key, size, part in later.open:
            if parts and parts[-1][0] == key:
                part = parts.pop()[2].join(part)
            parts.append((key, size, part))
        shared, starts, still = triangle(self.shared, later.shared), {}, []
        for key, size, part in parts:
            if part.n_rows < size:
                still.append((key, size, part))
                continue
            starts[key], left = without_start(part.R, len(part.power))
            shared = triangle(shared, left)
        return InputEquations(shared, self.starts | later.starts | starts, tuple(still))

    def solve(self, shape, firsts):
        """B, D and the initial states.

        Parameters
        ----------
        shape : tuple of int
            States, inputs and outputs.
        firsts : list
            Keys of the pieces whose initial states are asked for.

        Returns
        -------
        B, D : ndarray, shapes (n, m), (l, m)
        x0 : ndarray, shape (n_records, n)
        """
        theta = solve_shared(self.shared)
        return *split(theta, *shape), np.array([self.starts[key].solve(theta) for key in firsts])


def input_equations(A, C, feedthrough, scales, parts):
    """Equations of consecutive rows of some records.

    Parameters
    ----------
    A, C : ndarray, shapes (n, n), (l, n)
    feedthrough : bool
        Whether D is free.
    scales : tuple of ndarray, shapes (m,), (l,)
        What inputs and outputs are divided by.
    parts : iterable of (key, int, ndarray, ndarray)
        In the order of their rows: the piece that they belong to, how many rows it has when
        whole, inputs and outputs.

    Returns
    -------
    equations : InputEquations
    """
    factors = RecordFactors(A, C, feedthrough, scales)
    shared = np.zeros((0, len(scales[0]) * (len(A) + feedthrough * len(C)) + 1))
    starts, ends = {}, []
    for key, size, u, y in parts:
        if len(u) < size:
            ends.append((key, size, record_part(factors, u, y)))
            continue
        starts[key], left = without_start(factors.of(u, y), len(A))  # nothing follows
        shared = triangle(shared, left)
    return InputEquations(shared, starts, tuple(ends))
