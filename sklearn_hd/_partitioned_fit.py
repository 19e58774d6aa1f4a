"""``fit`` of MOESPRegressor on dask DataFrames."""

import numpy as np

from sklearn_hd._fit_checks import check_outputs_move, moving_inputs, warn_idle
from sklearn_hd._partitions import Partitions
from sklearn_hd.algorithms.hankel import n_hankel_columns
from sklearn_hd.algorithms.moesp import state_matrices

__all__ = ["PartitionedFit"]


class PartitionedFit:
    """What a subspace method adds to identify from partitions, wherever they are."""

    def _fit_partitions(self, X, y, scale, feedthrough):
        """The model of dask DataFrames, of which no more than small statistics are moved."""
        data = Partitions(X, y, 2 * self._block_rows_asked(None))
        experiment, lengths = data.experiment, data.lengths
        n_inputs, n_outputs = len(experiment.drive_names), len(experiment.output_names)
        i = self._check_block_rows(experiment, lengths, n_inputs, n_outputs)
        moving = moving_inputs(experiment.inputs, experiment)
        check_outputs_move(experiment)
        warn_idle(moving, experiment)
        columns = n_hankel_columns(lengths, i)
        if columns <= i * n_inputs:
            raise ValueError(
                f"the {experiment.span()} in {X.npartitions} partition(s) are too few to identify "
                f"dynamics from {n_inputs} input(s); give frames in memory, X.compute() and "
                f"y.compute(), from which a static gain is fitted"
            )
        self.block_rows_ = i
        size = data.root_mean_squares() if scale else np.ones(n_inputs + n_outputs)
        scales = size[:n_inputs], size[n_inputs:]
        R = data.factor(i, size)
        U, values, floor = self._look_at(R, columns, int(moving.sum()), experiment, scales[1])
        self.order_ = self._choose_order(U, values, floor, None, experiment, n_outputs)
        A, C = state_matrices(U, values, self.order_, n_outputs)
        B, D, self.x0_ = data.input_matrices(A, C, feedthrough, scales)
        model = self._model((A, B, C, D), scales, experiment, data.head[1], feedthrough)
        self.__dict__.pop("_stream", None)  # chunks of a partial_fit before
        return self._remember(model, experiment, *data.head)
