"""``partial_fit`` of MOESPRegressor: a model of all chunks so far."""

import copy

import numpy as np

from sklearn_hd._arithmetic import within_range
from sklearn_hd._checks import check_outputs_given
from sklearn_hd._containers import without_inputs
from sklearn_hd._identify.checks import DEFAULT_BLOCK_ROWS, MOST_PREDICTOR_ROWS, PREDICTOR
from sklearn_hd._identify.stream import Stream, first_date, read_chunk
from sklearn_hd._progress import progress
from sklearn_hd._records.data import check_features
from sklearn_hd._threads import one_blas_thread
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.reporting import stage
from sklearn_hd.algorithms.subspace.hankel import factor_of_products, n_hankel_columns
from sklearn_hd.algorithms.subspace.running_equations import (
    initial_states_of_heads,
    input_matrices_of_factor,
    input_matrices_of_heads,
    input_matrices_of_sums,
)
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning

__all__ = ["StreamedFit"]


class StreamedFit:
    """What a subspace method adds to identify from chunks."""

    @one_blas_thread
    @within_range
    def partial_fit(self, X, y):
        """Identify the model from all chunks so far and this one.

        Chunks are consecutive rows of a record, in order, or whole records. What they leave
        behind are sums; memory does not grow with the rows of a record (it does by some
        thousand rows with each record). The model is that of ``fit`` on all rows with the same
        ``order`` and ``block_rows``, but that a sliding window's block rows stay where they
        began; ``fit`` forgets all chunks.

        Where a mode outlasts some thousand rows, and a record is longer, B and D come from the
        triangular factor alone, and are less certain than those of ``fit``.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs (None where there are none), with a harmonic basis riding on them (from
            ``HarmonicAnalyzer.transform``; not period by period) or plain. Rows whose index
            counts from 0 go on where the last chunk ended; others follow it by one sample
            time, or a gap lies between.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Outputs in time.

        Returns
        -------
        self : MOESPRegressor
            With the model of everything so far, once there are rows enough.

        Raises
        ------
        ValueError
            If a chunk has other columns, another sample time or basis than the first, or
            begins before the end of the last. What was read before is kept.

        Warns
        -----
        ExcitationWarning
            If an input, or all outputs, have not moved so far: there is no model yet.
        IdentifiabilityWarning
            If all chunks so far have no model of this order. They are kept, this one too, and so
            is the model before.

        References
        ----------
        Verhaegen (1994), Automatica 30(1), 61-74 (B and D from the factor).

        Examples
        --------
        >>> from sklearn_hd import MOESPRegressor
        >>> u = np.random.default_rng(0).standard_normal((900, 1))
        >>> y = np.zeros((900, 1))
        >>> for k in range(899):
        ...     y[k + 1] = 0.8 * y[k] + u[k]
        >>> model = MOESPRegressor(order=1, block_rows=5)
        >>> for rows in np.split(np.arange(900), 3):
        ...     model = model.partial_fit(u[rows], y[rows])
        >>> round(float(model.eigenvalues_[0].real), 6)
        0.8
        """
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        scale, feedthrough = self._check_parameters()
        stream = getattr(self, "_stream", None)
        origin = first_date(X) if stream is None else stream.origin
        experiment = read_chunk(X, y, origin)
        check_features(self, X, reset=stream is None)
        asked = self._block_rows_asked(experiment.basis)
        if self.weighting == PREDICTOR and self.block_rows is None:
            asked = MOST_PREDICTOR_ROWS  # some of which are chosen once more data are there
        self._check_rank_bound(asked, len(self._output_names(experiment.basis, y)))
        if stream is None:
            stream = Stream.begin(experiment, asked, origin)
        elif asked > stream.block_rows:
            raise ValueError(
                f"block_rows={asked} asks for more than the {stream.block_rows} that the first "
                f"chunk was read with; begin anew with a clone of the estimator"
            )
        result = copy.copy(self)
        with progress(self.verbose) as report:
            told = stage(report, "rows added up", len(experiment.base.time))
            result._stream = stream.with_chunk(experiment, told)
        try:
            model = result._model_of(result._stream, asked, y, scale, feedthrough)
        except ValueError as error:  # which rows to come may mend
            warn(f"no model of the {result._stream.span()}: {error}", IdentifiabilityWarning)
            self._stream = result._stream
            return self
        if model is not None:
            result._remember(model, experiment, X, y)
        self.__dict__.update(result.__dict__)  # at once: an interrupted call changes nothing
        return self

    def _model_of(self, stream, asked, y, scale, feedthrough):
        """The model of all chunks so far; None where they do not suffice."""
        sums = stream.sums()
        moving = _moving(stream)
        if sums is None or moving is None:
            return None
        wide, alone, outputs = stream.channels(sums, moving)
        n_inputs, n_outputs = len(wide), len(outputs)
        lengths = [ends.n_rows for ends in sums.ends]
        chosen = self.weighting == PREDICTOR and self.block_rows is None
        asked = min(asked, DEFAULT_BLOCK_ROWS) if chosen else asked
        i = self._fewer_block_rows(asked, stream.basis, lengths, n_inputs, n_outputs)
        columns = n_hankel_columns(lengths, i)
        least_order = 1 if self.order == "auto" else int(self.order)
        too_few = columns < i * (n_inputs + n_outputs) + least_order
        if too_few or least_order > (i - 1) * n_outputs:
            return None
        self.block_rows_ = i
        products = sums.products.channels(np.concatenate([wide, outputs]))
        size = products.root_mean_squares() if scale else np.ones(n_inputs + n_outputs)
        if chosen:
            i = self.block_rows_ = self._rows_of_predictor(
                lambda rows: factor_of_products(products.fewer(2 * rows), n_inputs, size),
                lengths,
                n_inputs,
                n_outputs,
                lifted=False,
            )
            columns = n_hankel_columns(lengths, i)
        place = np.searchsorted(wide, alone)
        scales = u_scale, y_scale = size[place], size[n_inputs:]
        R = factor_of_products(products.fewer(2 * i), n_inputs, size)
        projected = self._project(R, columns, n_outputs, stream)
        found = self._look_at(*projected, n_inputs, stream, y_scale)
        self.order_ = self._choose_order(found, None, stream, n_outputs)
        sums = sums.of_inputs(np.flatnonzero(moving))
        if self.weighting == PREDICTOR:
            A, B, C, D, K, covariance = found.model(self.order_)
            self.x0_ = initial_states_of_heads(A, B, C, D, sums.ends, scales, (K, covariance))
        else:
            A, C = found.state_matrices(self.order_)
            matrices = input_matrices_of_sums(A, C, sums, feedthrough, scales)
            if matrices is None:
                matrices = input_matrices_of_heads(A, C, sums.ends, feedthrough, scales)
            if matrices is None:
                B, D = input_matrices_of_factor(A, C, R, found.directions, i, n_inputs, feedthrough)
                B, D = B[:, place], D[:, place]
                matrices = B, D, initial_states_of_heads(A, B, C, D, sums.ends, scales)
            B, D, self.x0_ = matrices
            K, covariance = self._noise_model(found)
        B, D = (_with_idle(M / u_scale, moving) for M in (B, D))
        parts, scales = (A, B, C, D, K, covariance), (np.ones(len(moving)), y_scale)
        return self._model(parts, scales, stream, stream.sample_time, y, feedthrough)


def _with_idle(M, moving):
    """A matrix with zeros in the columns of inputs that have not moved."""
    whole = np.zeros((len(M), len(moving)))
    whole[:, moving] = M
    return whole


def _moving(stream):
    """Which of the drive has moved so far; None, which is said, where a signal has not."""
    moving, answered = stream.moving()
    signals = dict(zip(stream.drive_signals(), moving, strict=True))
    for signal, moves in zip(stream.drive_signals(), moving, strict=True):
        signals[signal] |= moves
    idle = [signal for signal, moves in signals.items() if not moves]
    if not idle and answered:
        return moving
    what = f"the inputs {idle} are" if idle else "all outputs are"
    warn(
        f"{what} at rest in the {stream.span()}: there is no model until a chunk comes in which "
        f"they move",
        ExcitationWarning,
    )
    return None
