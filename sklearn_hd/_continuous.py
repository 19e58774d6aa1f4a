"""Conversion of an identified discrete model to a continuous one that fits the raw record."""

import numpy as np
from scipy import linalg

from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, discrete_to_continuous
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices


def to_continuous(model, experiment):
    """The whole of a discrete model in continuous time, under a zero-order hold.

    A model of coefficients seen through a window gets new B and D, fitted to the raw record; any
    other model keeps its own.

    Parameters
    ----------
    model : LTIModel
    experiment : Experiment

    Returns
    -------
    continuous : LTIModel
    """
    if model.dt == 0.0:
        return model
    A, B = discrete_to_continuous(model.A, model.B, model.dt)
    D = model.D
    if model.windowed:
        B, D, _ = refit_inputs(A, model.C, experiment, model.feedthrough)
    return model.in_continuous_time(A, B, model.C, D)


def refit_inputs(A, C, experiment, feedthrough):
    """B and D of a continuous model that fit the raw record best, and the R² reached.

    Parameters
    ----------
    A, C : ndarray
        Continuous-time state matrix, and output matrix to the coefficients.
    experiment : Experiment
    feedthrough : bool

    Returns
    -------
    B, D : ndarray
    r2 : float
    """
    dt = experiment.base.sample_time
    A_raw, hold = continuous_to_discrete(A, np.eye(len(A)), dt)
    scale = output_scale(experiment)
    observe = [R / scale[:, None] for R in observations(experiment)]
    outputs = scaled_outputs(experiment)
    u_scale = input_scale(experiment)
    inputs = [u / u_scale for u in experiment.drive]
    B_raw, D, _, rest = input_matrices(
        A_raw, C, inputs, outputs, feedthrough, observe, return_residual=True
    )
    B_raw, D = B_raw / u_scale, D / u_scale
    total = sum(float(np.sum(y**2)) for y in outputs)
    return linalg.solve(hold, B_raw), D, 1.0 - rest / total


def input_scale(experiment):
    """Largest value of each input over all segments, so that no square under- or overflows."""
    scale = np.max(np.abs(np.vstack(experiment.drive)), axis=0, initial=0.0)
    return np.where(scale == 0.0, 1.0, scale)


def output_scale(experiment):
    """Standard deviation of each output over all segments, so that each counts alike."""
    stacked = np.vstack(experiment.outputs)
    largest = np.max(np.abs(stacked), axis=0, initial=0.0)
    largest[largest == 0.0] = 1.0
    scale = largest * np.std(stacked / largest, axis=0)
    return np.where(scale == 0.0, largest, scale)


def scaled_outputs(experiment):
    """The outputs of each segment, divided by :func:`output_scale`."""
    scale = output_scale(experiment)
    return [y / scale for y in experiment.outputs]


def observations(experiment):
    """What is measured of the coefficients at each sample, a list of arrays."""
    basis = experiment.basis
    return [basis.recomposition(basis.azimuth(time)) for time in experiment.times()]
