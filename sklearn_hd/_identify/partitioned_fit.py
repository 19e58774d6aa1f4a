"""``fit`` of MOESPRegressor on dask DataFrames."""

import numpy as np

from sklearn_hd._fit_checks import check_outputs_move, moving_inputs, warn_idle
from sklearn_hd._identify.checks import PREDICTOR
from sklearn_hd._identify.partitions import Partitions, basis_of
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns

__all__ = ["PartitionedFit"]


class PartitionedFit:
    """What a subspace method adds to identify from partitions, wherever they are."""

    def _fit_partitions(self, X, y, scale, feedthrough):
        """The model of dask DataFrames, of which no more than small statistics are moved."""
        if self.weighting == PREDICTOR:
            raise ValueError(
                f"weighting={PREDICTOR!r} reads no dask DataFrames; use partial_fit, one partition "
                f"after the other, or another weighting"
            )
        basis = basis_of(X)
        data = Partitions(X, y, 2 * self._block_rows_asked(basis))
        experiment, lengths, n_inputs = data.experiment, data.lengths, data.n_inputs
        n_outputs = len(self._output_names(basis, data.head[1]))
        i = self._check_block_rows(experiment, lengths, n_inputs, n_outputs)
        moving = moving_inputs(experiment.inputs, experiment)
        check_outputs_move(experiment)
        warn_idle(moving, experiment)
        if n_hankel_columns(lengths, i) <= i * n_inputs:
            raise ValueError(
                f"the {experiment.span()} in {X.npartitions} partition(s) are too few to identify "
                f"dynamics from {n_inputs} input(s); give frames in memory, X.compute() and "
                f"y.compute(), from which a static gain is fitted"
            )
        self.block_rows_ = i
        size = data.root_mean_squares()
        if not scale:
            size[n_inputs if data.highest else 0 :] = 1.0
        n_moving = n_inputs if data.highest else int(moving.sum())
        found = self._decompose_partitions(data, n_moving, size)
        while self._wants_more_rows(experiment, lengths, n_inputs, n_outputs):
            self.block_rows_ += (self.block_rows_ + 1) // 2
            data = data.with_lags(2 * self.block_rows_)
            found = self._decompose_partitions(data, n_moving, size)
        A, C = found.state_matrices(self.order_)
        u_scale = size[: n_inputs : 2 * data.highest + 1] if scale else np.ones(len(moving))
        scales = u_scale, size[n_inputs:]
        B, D, self.x0_ = data.input_matrices(A, C, feedthrough, scales)
        dt, y = experiment.base.sample_time, data.head[1]
        parts = A, B, C, D, *self._noise_model(found)
        model = self._model(parts, scales, experiment, dt, y, feedthrough)
        return self._remember(model, experiment, *data.head)

    def _decompose_partitions(self, data, n_moving, size):
        """Project the future outputs, look at the singular values and settle the order."""
        i, n_outputs = self.block_rows_, len(size) - data.n_inputs
        R, columns = data.factor(i, size), n_hankel_columns(data.lengths, i)
        experiment = data.experiment
        projected = self._project(R, columns, n_outputs, experiment)
        found = self._look_at(*projected, n_moving, experiment, size[-n_outputs:])
        self.order_ = self._choose_order(found, None, experiment, n_outputs)
        return found
