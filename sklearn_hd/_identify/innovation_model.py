"""What a subspace method adds where it identifies the noise, too: prediction from outputs."""

import numpy as np
from sklearn.utils.metaestimators import available_if
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._arithmetic import within_range
from sklearn_hd._checks import check_count, check_outputs_given
from sklearn_hd._containers import without_inputs
from sklearn_hd._identify.checks import PREDICTOR
from sklearn_hd._records.states import initial_states
from sklearn_hd._threads import one_blas_thread
from sklearn_hd.algorithms.subspace.innovations import InnovationForm

__all__ = ["InnovationModel"]


def _has_gain(step):
    """Whether a Kalman gain was, or will be, identified."""
    if hasattr(step, "model_"):
        return step.model_.kalman_gain is not None
    return bool(step.disturbance_model) or step.weighting == PREDICTOR


class InnovationModel:
    """Predictions from the outputs before, where the model has a Kalman gain."""

    @available_if(_has_gain)
    @one_blas_thread
    @within_range
    def predict_ahead(self, X, y, horizon=1, x0=None):
        """Outputs predicted some rows ahead from the outputs before them.

            x̂[k+1] = A x̂[k] + B u[k] + K e[k],   ŷ[k] = C x̂[k] + D u[k],   e = y − ŷ

        One row ahead; further ahead the model goes on without e. Where ``predict``
        simulates from the inputs alone, this also holds for what disturbances have done, and
        for unstable models.

        Parameters
        ----------
        X : DataFrame or ndarray, shape (n_samples, n_features), or None
            Inputs as at fit; None if there were none.
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            Measured outputs on the rows of X.
        horizon : int, default=1
            Rows (period by period, periods) from the last output used to the one predicted.
        x0 : array_like or dict, optional
            As in ``predict``; by default the state with the least innovations over
            the segment's first rows, as many as remember it.

        Returns
        -------
        y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
            In the container of y at fit.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If X, y, ``horizon`` or x0 do not fit the model.

        References
        ----------
        Ljung (1999), System Identification, Eq. 3.31 (predictions k steps ahead).

        Examples
        --------
        >>> from sklearn_hd import MOESPRegressor
        >>> e = np.random.default_rng(0).standard_normal(2000)
        >>> y = np.zeros(2000)
        >>> for k in range(1999):
        ...     y[k + 1] = 0.9 * y[k] + e[k + 1]
        >>> model = MOESPRegressor(1, block_rows=5, disturbance_model=True).fit(None, y)
        >>> round(float(np.std(y - model.predict_ahead(None, y)) / np.std(e)), 2)
        1.0
        """
        check_is_fitted(self)
        check_outputs_given(y)
        X = without_inputs(y) if X is None else X
        horizon = check_count("horizon", horizon, 1, "1 is the next row")
        experiment = self._experiment(X, y)
        simulators, n = self._simulators(experiment), self.model_.n_states
        starts = [None] * len(simulators)
        if x0 is not None:
            starts = initial_states(x0, experiment.base, n, self.model_.state_names)
        outputs = [
            self._predicted(simulator, measured, horizon, start)
            for simulator, measured, start in zip(
                simulators, experiment.outputs, starts, strict=True
            )
        ]
        trim = experiment.output_trim()
        if trim is not None and not self.predicts_harmonics_:
            outputs = [y + waveform for y, waveform in zip(outputs, trim, strict=True)]
        return self._mirror(experiment.sampling.back(outputs), X)

    def _predicted(self, simulator, outputs, horizon, x0=None, rows=None):
        """Outputs of one segment, predicted ahead; x0 fitted to some rows (else all) if None."""
        model, u = simulator.model, simulator.drive
        form = InnovationForm(model.A, model.B, model.C, model.D, model.kalman_gain)
        Y, seen = outputs, None if rows is None else rows.stop
        if simulator.basis.harmonic:
            basis, time = simulator.basis, simulator.time
            whole = basis.rows_read(time)
            Y = basis.output_coefficients(outputs, time, whole)
            if rows is not None:
                seen = max(1, int(np.sum(whole + len(basis.weights) <= rows.stop)))
        if x0 is None:
            x0 = form.initial_state(u[: len(Y)][:seen], Y[:seen], model.innovations_covariance)
        recompose = not self.predicts_harmonics_
        return simulator.observe(form.ahead(u, Y, x0, horizon), simulator.time, recompose)

    def _fitted_outputs(self, simulator, outputs, rows, horizon):
        if horizon is None or not _has_gain(self):
            return super()._fitted_outputs(simulator, outputs, rows, horizon)
        return self._predicted(simulator, outputs, horizon, rows=rows)

    @property
    def kalman_gain_(self):
        """K of the innovation form."""
        return self._noise("kalman_gain")

    @property
    def innovations_covariance_(self):
        """Covariance of the innovations, in the units of the outputs."""
        return self._noise("innovations_covariance")

    def _noise(self, name):
        check_is_fitted(self)
        found = getattr(self.model_, name)
        if found is None:
            raise AttributeError(
                f"no {name} was identified; fit with disturbance_model=True or weighting='pbsid'"
            )
        return found
