"""Plain data: ordinary subspace identification, sample by sample."""

import numpy as np

from sklearn_hd._fit_checks import check_motion
from sklearn_hd._frame import LTIModel
from sklearn_hd._identify.checks import (
    DEFAULT_BLOCK_ROWS,
    allowed_block_rows,
    fewer_block_rows,
    rows_of_predictor,
)
from sklearn_hd._identify.stages import SubspaceFit, decompose, fit_matrices, subspace_fit
from sklearn_hd._identify.statistics import Facts, Records
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.exceptions import ExcitationWarning

__all__ = ["asked_block_rows", "identify", "read"]


def read(experiment, settings):
    """Data of an experiment: its rows as they are."""
    facts = Facts.of(experiment, experiment.drive)
    return Records(experiment.drive, experiment.outputs, facts, settings.memory)


def asked_block_rows(basis, settings):
    """Block rows given, or 15."""
    return DEFAULT_BLOCK_ROWS if settings.block_rows is None else int(settings.block_rows)


def identify(data, settings, experiment=None):
    """Identify a model from samples.

    Parameters
    ----------
    data : Records, Summed or Partitions
    settings : Settings
    experiment : Experiment, optional
        Where data are in memory; a record too short for dynamics then has a static gain.

    Returns
    -------
    fit : SubspaceFit
    """
    i = _block_rows(data, settings)
    check_motion(data.facts)
    if n_hankel_columns(data.lengths, i) <= i * data.n_inputs:
        return static_gain(data.facts, experiment, settings, i)
    size, scales = data.scales(settings.scale)
    if settings.predictor and settings.block_rows is None:
        i = rows_of_predictor(data, i, size, settings)
    decomposition = decompose(data, i, size, settings)
    fitted = fit_matrices(data, decomposition, size, scales, settings, settings.feedthrough)
    return subspace_fit(decomposition, fitted, scales, data.facts, settings, settings.feedthrough)


def _block_rows(data, settings):
    """Block rows given, or as many as the record allows; a record of few rows has a gain alone."""
    asked = min(asked_block_rows(data.facts.basis, settings), data.most_block_rows)
    if settings.chooses and sum(data.lengths) > 1:
        return fewer_block_rows(asked, 2, data.lengths, data.n_inputs + data.n_outputs)
    return allowed_block_rows(settings, data, asked)


def static_gain(facts, experiment, settings, block_rows):
    """Gain without states, all that a record too short for any dynamics gives."""
    if experiment is None:
        raise ValueError(
            f"the {facts.span()} are too few to identify dynamics from {len(facts.drive_names)} "
            f"input(s); fit all rows at once, in memory, for a static gain"
        )
    inputs, outputs = experiment.drive, experiment.outputs
    n_outputs = outputs[0].shape[1]
    warn(
        f"the {facts.span()} are too few to identify dynamics from {inputs[0].shape[1]} "
        f"input(s): a static gain is fitted; use a longer record",
        ExcitationWarning,
    )
    A, C = np.zeros((0, 0)), np.zeros((n_outputs, 0))
    B, D, x0 = input_matrices(A, C, inputs, outputs, True)
    left = np.vstack(outputs) - np.vstack(inputs) @ D.T
    noise = {}
    if settings.disturbance_model or settings.predictor:
        noise["kalman_gain"] = np.zeros((0, n_outputs))
        noise["innovations_covariance"] = left.T @ left / len(left)
    model = LTIModel(
        A=A,
        B=B,
        C=C,
        D=D,
        dt=facts.sample_time,
        input_names=facts.basis.drive_labels,
        output_names=facts.basis.output_labels,
        feedthrough=True,
        **noise,
    )
    return SubspaceFit(model, x0, block_rows, 0)
