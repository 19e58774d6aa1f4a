"""Parameters of the matcher that exclude each other, or do not fit the record."""

from collections.abc import Mapping

import numpy as np

__all__ = ["LIKELIHOODS", "checked_together"]

LIKELIHOODS = ("output_error", "prediction_error")


def checked_together(step, basis, lifted, periodic):
    """Refuse parameters that exclude each other; the noise of each input, or None."""
    likelihood = step.criterion in LIKELIHOODS
    if step.output_weights is not None or step.input_weights is not None:
        if likelihood:
            raise ValueError(
                f"criterion={step.criterion!r} weights each output by its noise; output_weights "
                f"and input_weights belong to a norm, so leave them None, or use criterion='hinf' "
                f"or 'least_squares'"
            )
        if lifted and periodic:
            raise ValueError(
                "this model is brought to periodic form in closed form, which uses no weights; "
                "leave output_weights and input_weights None, or, with reading='period', use "
                "criterion='output_error', which weights each output by its noise"
            )
    given = step.input_noise
    if given is None:
        return None
    if not likelihood:
        raise ValueError(
            f"input_noise={given!r} needs maximum likelihood; fit with criterion='output_error', "
            f"or leave input_noise=None"
        )
    if step.criterion == "prediction_error":
        raise ValueError(
            f"input_noise={given!r} needs simulations, but criterion='prediction_error' predicts; "
            f"fit with criterion='output_error', or leave input_noise=None, where noise on the "
            f"inputs counts as gusts"
        )
    if step.structure is None and not basis.harmonic:
        raise ValueError(
            f"input_noise={given!r} needs the parameters of a structure, but structure=None leaves "
            f"every entry free; give a MatrixStructure, or leave input_noise=None"
        )
    if basis.reading == "sample":
        raise ValueError(
            f"input_noise={given!r} cannot be separated from the loads that a model of samples "
            f"has; use HarmonicAnalyzer(reading='period'), or leave input_noise=None"
        )
    if not periodic and not np.all(basis.held):
        raise ValueError(
            "input_noise is the noise of the measured inputs, but this model is driven by their "
            "harmonics; keep only harmonic 0 of the inputs, or use a HarmonicStructure"
        )
    names = basis.input_signals
    values = given if isinstance(given, Mapping) else dict.fromkeys(names, given)
    if set(values) != set(names):
        raise ValueError(
            f"input_noise={given!r} must give a standard deviation for each of the inputs "
            f"{list(names)}"
        )
    return np.array([float(values[name]) for name in names])
