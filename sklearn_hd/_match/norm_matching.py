"""A structure matched to an identified model in a norm (step 5, Eq. 22)."""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._match.weights import read_weights
from sklearn_hd.algorithms.lti.simulation import frequency_response
from sklearn_hd.algorithms.matching.matching import match_structure
from sklearn_hd.algorithms.matching.matching_problem import channel_scales, matching_grid

NORMS = ("hinf", "h2", "least_squares")


@dataclass(frozen=True, eq=False)
class NormSettings:
    """How to match: the norm, its weights, and the search.

    Attributes
    ----------
    criterion : {"hinf", "h2", "least_squares"}
    scale : bool
        Whether the constants of the weights stand beside channel scales.
    output_weights, input_weights : as given to the matcher
    search : dict
        n_starts, n_jobs, max_iter, tol and random_state.
    """

    criterion: str
    scale: bool
    output_weights: object
    input_weights: object
    search: dict

    def match(self, model, affine, initial=None, bounds=None, report=None):
        """The MatchResult of an affine structure and a model in continuous time."""
        outputs = read_weights("output_weights", self.output_weights, model.output_names)
        inputs = read_weights("input_weights", self.input_weights, model.input_names)
        scales = np.ones(len(model.output_names)), np.ones(len(model.input_names))
        if self.scale:
            grid = matching_grid(np.linalg.eigvals(model.A))
            s = 1j * grid[np.isfinite(grid)]
            scales = channel_scales(frequency_response(model.A, model.B, model.C, model.D, s))
        return match_structure(
            model.A,
            model.B,
            model.C,
            model.D,
            affine,
            criterion=self.criterion,
            theta0=initial,
            bounds=bounds,
            output_weights=scales[0] * outputs.constants,
            input_weights=scales[1] * inputs.constants,
            emphasis=(outputs.constants, inputs.constants),
            output_filter=outputs.filter,
            input_filter=inputs.filter,
            report=report,
            **self.search,
        )
