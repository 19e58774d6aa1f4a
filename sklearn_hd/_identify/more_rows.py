"""Block rows beyond the default, for records read through a sliding window."""

import numpy as np

from sklearn_hd._identify.modulation import changes_at_one_phase, inputs_by_phase
from sklearn_hd.algorithms.modes.families import FAINT, agreeing_copies, is_window_pole
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns

__all__ = ["MoreRows", "is_sliding"]

LARGEST_TRY = 2e10  # operations: beyond, only what noise lets be told apart
EXACT_FLOOR = 1e-9  # share of the largest singular value: what an exact model may leave


def is_sliding(experiment):
    """Whether the record is read through a window that slides."""
    return experiment.basis.reading == "sliding"


class MoreRows:
    """What a subspace method adds where a window's block rows may be too few."""

    def _wants_more_rows(self, experiment, lengths, n_inputs, n_outputs):
        """Whether the order chosen fills the rank that default block rows allow, and more fit.

        Few coefficients of many states: copies and memory need more rows than a window's.
        """
        i = self.block_rows_
        if not is_sliding(experiment):
            return False
        if self.block_rows is not None or self.order != "auto":
            return False
        more = i + (i + 1) // 2
        room = n_hankel_columns(lengths, more) >= 2 * more * (n_inputs + n_outputs)
        return self.order_ >= (i - 1) * n_outputs and room

    def _exact_map(self, kept, found, experiment, excitation, outputs, scale):
        """The model without noise in which most modes have copies that agree.

        Inputs that move within a hop at many phases ask for many inputs, more than noise
        would let be told apart; few coefficients of many states ask for many block rows.
        Where no more than rounding is left, noise is no matter. A model whose inputs are too
        few leaves no more, by modes that stand for inputs, but these have no copies.
        """
        basis, n_outputs = experiment.basis, outputs[0].shape[1]
        lengths = [len(y) for y in outputs]
        best = found, self.block_rows_, self.singular_values_, self.noise_floor_, self.order_
        columns = n_hankel_columns(lengths, self.block_rows_)
        one_phase = changes_at_one_phase(experiment)
        if one_phase and self._is_exact(columns, excitation[0].shape[1], n_outputs):
            return found
        most = self._n_agreeing(found, basis)
        for inputs in [excitation] if one_phase else inputs_by_phase(experiment):
            m, tries = inputs[0].shape[1], _block_rows_tried(basis.window_rows)
            i = next((i for i in tries if _fits(lengths, i, m, n_outputs)), 0)
            if i == 0:
                continue
            self.block_rows_ = i
            own = scale if one_phase else np.append(np.ones(m), scale[-n_outputs:])
            found = self._decompose(kept, inputs, outputs, m, experiment, own)
            if self._is_exact(n_hankel_columns(lengths, i), m, n_outputs):
                agreeing = self._n_agreeing(found, basis)
                if agreeing > most:
                    left = self.singular_values_, self.noise_floor_, self.order_
                    best, most = (found, i, *left), agreeing
        found, self.block_rows_, self.singular_values_, self.noise_floor_, self.order_ = best
        return found

    def _n_agreeing(self, found, basis):
        """Modes of the model that belong to families with all their copies."""
        z = np.linalg.eigvals(found.state_matrices(self.order_)[0])
        z = z[~is_window_pole(z, basis.window_rows, FAINT)]
        orders = [orders for _, orders in basis.outputs]
        return int(agreeing_copies(z, orders, basis.rows_per_period).sum())

    def _is_exact(self, n_columns, n_inputs, n_outputs):
        """Whether rounding is all that is left, and rank and record allow for more states."""
        i = self.block_rows_
        room = self.order_ + n_outputs <= (i - 1) * n_outputs
        left = n_columns - i * n_inputs >= self.order_ + i
        return room and left and self.noise_floor_ <= EXACT_FLOOR * self.singular_values_[0]


def _block_rows_tried(window_rows):
    """Block rows of some windows, the most first: the more, the better copies agree."""
    return [int(windows * window_rows) + 2 for windows in (4, 3, 2, 1.5, 1)]


def _fits(lengths, block_rows, n_inputs, n_outputs):
    """Whether inputs leave a quarter of the columns, and it takes no more than some seconds."""
    columns = n_hankel_columns(lengths, block_rows)
    left = columns - block_rows * n_inputs
    work = columns * (2.0 * block_rows * (n_inputs + n_outputs)) ** 2
    return left >= max(columns // 4, block_rows) and work <= LARGEST_TRY
