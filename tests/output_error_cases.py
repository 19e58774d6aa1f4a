"""Output-error fits of periodic structures, of sixteen phases a period of a second."""

import numpy as np

from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.prediction_error import output_error_of

OMEGA, N_PHASES = 2 * np.pi, 16


def fitted(structure, segments, theta0, **options):
    return output_error_of(Form(structure, OMEGA, N_PHASES), segments, theta0, **options)
