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
                f"criterion={step.criterion!r} weighs each output by its noise; output_weights "
                f"and input_weights are those of a norm, so leave them None, or use "
                f"criterion='hinf' or 'least_squares'"
            )
        if lifted and periodic:
            raise ValueError(
                "this model is brought to periodic form in closed form, where nothing is "
                "weighed; leave output_weights and input_weights None, or, period by period, "
                "use criterion='output_error', which weighs each output by its noise"
            )
    given = step.input_noise
    if given is None:
        return None
    if not likelihood:
        raise ValueError(
            f"input_noise={given!r} is allowed for by maximum likelihood only; fit with "
            f"criterion='output_error', or leave input_noise=None"
        )
    if step.criterion == "prediction_error":
        raise ValueError(
            f"input_noise={given!r} is allowed for in simulations only, and "
            f"criterion='prediction_error' predicts; fit with criterion='output_error', or "
            f"leave input_noise=None, where noise on the inputs counts as gusts"
        )
    if step.structure is None and not basis.harmonic:
        raise ValueError(
            f"input_noise={given!r} is allowed for with the parameters of a structure, and "
            f"structure=None leaves every entry free; give a MatrixStructure, or leave "
            f"input_noise=None"
        )
    if basis.reading == "sample":
        raise ValueError(
            f"input_noise={given!r} cannot be told from loads, which a model of samples has; "
            f"use HarmonicAnalyzer(reading='period'), or leave input_noise=None"
        )
    if not periodic and not np.all(basis.held):
        raise ValueError(
            "input_noise is that of the measured inputs, but this model is driven by their "
            "harmonics; keep harmonic 0 of the inputs alone, or use a HarmonicStructure"
        )
    names = basis.input_signals
    values = given if isinstance(given, Mapping) else dict.fromkeys(names, given)
    if set(values) != set(names):
        raise ValueError(
            f"input_noise={given!r} must give a standard deviation for each of the inputs "
            f"{list(names)}"
        )
    return np.array([float(values[name]) for name in names])
