"""Input of a step that follows another one."""

from sklearn.base import clone

from sklearn_hd._checks import check_outputs_given
from sklearn_hd._records.amplitudes import read_for_fit
from sklearn_hd._records.data import as_frame
from sklearn_hd._records.delays import in_machine_time

__all__ = ["upstream"]


def upstream(step, X, y):
    """Input of a reducing or matching step: the experiment, and the model it starts from.

    X carries the model, or it is that of ``step.estimator``, a clone of which is fitted here
    (``step.estimator_``).
    """
    check_outputs_given(y)
    step._check_warmup()
    if step.estimator is None:
        frame = as_frame(X)
        if frame.model is None:
            raise ValueError(
                f"{type(step).__name__} found no model on X; put it behind MOESPRegressor in a "
                f"Pipeline (without a step between them that rebuilds the frame), or give it one: "
                f"{type(step).__name__}(estimator=...)"
            )
        return _at_machine(frame, y), frame.model
    if not (hasattr(step.estimator, "get_params") and hasattr(step.estimator, "transform")) or (
        isinstance(step.estimator, type)
    ):
        raise ValueError(
            f"estimator={step.estimator!r} does not make a model; give a MOESPRegressor or "
            f"SpuriousModeReducer, or a Pipeline that ends in one"
        )
    step.estimator_ = clone(step.estimator).fit(X, y)
    frame = step._upstream_frame(X)
    if frame.model is None:
        raise ValueError(
            f"estimator={step.estimator!r} does not make a model; give a MOESPRegressor or "
            f"SpuriousModeReducer, or a Pipeline that ends in one"
        )
    return _at_machine(frame, y), frame.model


def _at_machine(frame, y):
    """The record of a fit in the machine's own time, without the delays of the model."""
    experiment, delays = read_for_fit(frame, y), frame.model.delays
    return experiment if delays is None else in_machine_time(experiment, delays)
