"""Outputs predicted from the outputs before them, where a model has a Kalman gain."""

__all__ = ["predicted_ahead"]


def predicted_ahead(simulator, outputs, horizon, x0=None, *, rows=None, recompose=True):
    """Outputs of one segment, predicted some rows ahead.

    Parameters
    ----------
    simulator : SegmentSimulator
    outputs : ndarray, shape (n_samples, n_outputs)
        Measured, trim subtracted.
    horizon : int
        Rows of the model from the last output used to the one predicted.
    x0 : ndarray, shape (n_states,), optional
        The state with the least innovations where not given.
    rows : slice, optional
        Samples that x0 is fitted to; all by default.
    recompose : bool
        False gives harmonics.

    Returns
    -------
    predicted : ndarray, shape (n_samples, n_outputs)
    """
    model, u, basis, form = simulator.model, simulator.drive, simulator.basis, simulator.form
    Y, seen = basis.outputs_read(outputs, simulator.time), None
    if rows is not None:
        seen = max(1, basis.n_read_within(simulator.time, rows.stop))
    if x0 is None:
        x0 = form.initial_state(u[: len(Y)][:seen], Y[:seen], model.innovations_covariance)
    return simulator.observe(form.ahead(u, Y, x0, horizon), simulator.time, recompose)
