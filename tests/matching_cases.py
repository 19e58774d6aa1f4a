"""A small matching problem: three states to be matched by two."""

import numpy as np

from sklearn_hd.algorithms.matching.matching_problem import MatchingProblem
from sklearn_hd.structures import MatrixStructure

NAN = np.nan
A = np.array([[-1.0, 5.0, 0.0], [-5.0, -1.0, 1.0], [0.0, 0.3, -2.0]])
START = np.array([-1.0, 5.0, 0.5, 0.5, 0.5, 0.5])  # a, w, B


def problem_of(n_inputs=2, n_outputs=2, bounds=None):
    """B and a complex pair of poles are free; C is known."""
    random = np.random.default_rng(3)
    B, C = random.standard_normal((3, n_inputs)), random.standard_normal((n_outputs, 3))
    cells = [["a", "w"], ["-w", "a"]], np.full((2, n_inputs), NAN), np.eye(n_outputs, 2)
    structure = MatrixStructure(*cells).affine
    return MatchingProblem.build(A, B, C, np.zeros((n_outputs, n_inputs)), structure, bounds=bounds)


def start_of(problem):
    """START, as long as the problem's parameters."""
    return np.resize(START, problem.structure.n_parameters)
