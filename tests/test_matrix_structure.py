"""MatrixStructure: what cells mean, how entries are named and shared, what is refused."""

import copy
import pickle

import numpy as np
import pandas as pd
import pytest
from sklearn.base import BaseEstimator, clone

from sklearn_hd.structures import MatrixStructure

NAN = np.nan


def heave():
    return MatrixStructure(np.full((3, 3), NAN), [[0.0], [NAN], [0.0]])


def test_numbers_are_fixed_and_nan_is_free():
    structure = MatrixStructure([[NAN, 1.0], [-2.0, NAN]], [[0.0], [NAN]])
    assert structure.parameter_names == ("A[0,0]", "A[1,1]", "B[1,0]")
    A, B, C, D = structure.matrices([5.0, 6.0, 7.0])
    np.testing.assert_array_equal(A, [[5.0, 1.0], [-2.0, 6.0]])
    np.testing.assert_array_equal(B, [[0.0], [7.0]])
    np.testing.assert_array_equal(C, np.eye(2))
    np.testing.assert_array_equal(D, np.zeros((2, 1)))


def test_heave_structure_has_ten_parameters():
    structure = heave()
    assert (structure.n_parameters, structure.n_states) == (10, 3)
    assert (structure.n_inputs, structure.n_outputs) == (1, 3)


def test_names_are_shared_with_sign_and_scale_across_matrices():
    structure = MatrixStructure(
        [["-d", "w"], [" - w", "-d"]], [["2*k"], ["-0.5 * w"]], C=[["k", 0.0]], D=[["1e-3*k"]]
    )
    assert structure.parameter_names == ("d", "w", "k")
    A, B, C, D = structure.matrices([1.0, 10.0, 100.0])
    np.testing.assert_array_equal(A, [[-1.0, 10.0], [-10.0, -1.0]])
    np.testing.assert_array_equal(B, [[200.0], [-5.0]])
    np.testing.assert_array_equal(C, [[100.0, 0.0]])
    np.testing.assert_allclose(D, [[0.1]])


def test_numbers_written_as_text_are_numbers():
    structure = MatrixStructure([["-1.5", "nan"], ["1e3", 0]], [[1], [None]])
    assert structure.parameter_names == ("A[0,1]", "B[1,0]")
    assert structure.matrices([0.0, 0.0])[0].tolist() == [[-1.5, 0.0], [1000.0, 0.0]]


def test_dataframes_name_the_entries():
    states = ["w_0", "phi_dot_1c"]
    A = pd.DataFrame(NAN, index=states, columns=states)
    B = pd.DataFrame([[0.0], ["b"]], index=states, columns=["U_0"])
    structure = MatrixStructure(A, B)
    assert structure.parameter_names[1] == "A[w_0,phi_dot_1c]"
    assert structure.parameter_names[-1] == "b"
    assert structure.state_names == tuple(states)
    assert structure.input_names == ("U_0",)


def test_given_names_serve_arrays():
    structure = MatrixStructure([[NAN]], [[NAN]], state_names=["x"], input_names=["u"])
    assert structure.parameter_names == ("A[x,x]", "B[x,u]")


def test_matrices_are_affine_in_the_parameters():
    structure = MatrixStructure([["a", "b"], ["-2*a", 3.0]], [["b"], [NAN]], C=[[1, "a"]])
    random = np.random.default_rng(0)
    first, second = random.standard_normal((2, structure.n_parameters))
    mixed = structure.matrices(0.3 * first + 0.7 * second)
    for left, x, y in zip(
        mixed, structure.matrices(first), structure.matrices(second), strict=True
    ):
        np.testing.assert_allclose(left, 0.3 * x + 0.7 * y, atol=1e-14)


def test_affine_form_is_what_matrices_shows():
    structure = MatrixStructure([["a", 1.0], ["-a", NAN]], [[1.0], [NAN]])
    stacked = structure.affine.constant + np.tensordot([2.0, 3.0, 4.0], structure.affine.basis, 1)
    A, B, C, D = structure.matrices([2.0, 3.0, 4.0])
    np.testing.assert_array_equal(stacked, np.block([[A, B], [C, D]]))


@pytest.mark.parametrize(
    "initial",
    [{"B[1,0]": 2.0, "a": 1.0}, [1.0, 2.0], pd.Series([2.0, 1.0], index=["B[1,0]", "a"])],
    ids=["dict", "list", "series"],
)
def test_initial_values_in_parameter_order(initial):
    structure = MatrixStructure([["a", 0.0], [1.0, "-a"]], [[0.0], [NAN]], initial=initial)
    np.testing.assert_array_equal(structure.initial, [1.0, 2.0])


def test_equality_hash_pickle_and_copies():
    structure = heave()
    for twin in (heave(), pickle.loads(pickle.dumps(structure)), copy.deepcopy(structure)):
        assert twin == structure
        assert hash(twin) == hash(structure)
    assert structure != MatrixStructure(np.full((3, 3), NAN), [[0.0], [1.0], [0.0]])
    assert structure != "heave"
    assert MatrixStructure([["a"]], [[1.0]]) != MatrixStructure([["a"]], [[1.0]], initial=[1.0])


def test_scikit_learn_clones_it_as_a_parameter():
    class Holder(BaseEstimator):
        def __init__(self, structure=None):
            self.structure = structure

    holder = Holder(heave())
    assert clone(holder).structure == holder.structure
    assert "MatrixStructure(3 states" in repr(holder)


def test_results_and_inputs_do_not_share_memory():
    given = np.array([[-1.0, NAN], [0.0, -1.0]])
    structure = MatrixStructure(given, [[1.0], [1.0]])
    given[0, 0] = 99.0
    structure.matrices([0.0])[0][0, 0] = 99.0
    assert structure.matrices([0.0])[0][0, 0] == -1.0


def test_repr_and_str_show_the_entries():
    structure = MatrixStructure([["-k", 2.0], [0.0, NAN]], [[0.0], ["2*k"]])
    assert repr(structure) == (
        "MatrixStructure(2 states, 1 inputs, 2 outputs, parameters=['k', 'A[1,1]'])"
    )
    text = str(structure)
    for part in ("A = [", "-k", "A[1,1]", "2*k", "D = ["):
        assert part in text


def test_no_free_entry_is_allowed_here():
    structure = MatrixStructure([[-1.0]], [[1.0]])
    assert structure.parameter_names == ()
    assert structure.matrices([])[0].tolist() == [[-1.0]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"A": [[1, 2]], "B": [[1]]}, r"A has shape \(1, 2\)"),
        (
            {"A": np.eye(2), "B": np.ones((3, 1))},
            r"B has shape \(3, 1\) where .* call for \(2, 1\)",
        ),
        ({"A": np.eye(2), "B": np.ones((2, 1)), "C": np.ones((1, 3))}, r"C has shape .*\(1, 2\)"),
        ({"A": np.eye(2), "B": np.ones((2, 1)), "D": [[0.0]]}, r"D has shape .*\(2, 1\)"),
        ({"A": np.ones(3), "B": [[1]]}, "A must be a matrix"),
        ({"A": [[1, 2], [3]], "B": [[1], [1]]}, "A must be a matrix"),
        ({"A": [[np.inf]], "B": [[1]]}, r"A\[0,0\] = inf is no entry"),
        ({"A": [[1j]], "B": [[1]]}, r"is no entry; give a finite number"),
        ({"A": [["a"]], "B": [[1]], "initial": {"b": 1.0}}, r"missing \['a'\], unknown \['b'\]"),
        ({"A": [["a"]], "B": [[1]], "initial": [1.0, 2.0]}, "initial must hold 1 finite numbers"),
        ({"A": [["a"]], "B": [[1]], "initial": [NAN]}, "initial must hold 1 finite numbers"),
        ({"A": [["a"]], "B": [[1]], "initial": ["x"]}, r"each of \['a'\]; got \['x'\]"),
        ({"A": [["a"]], "B": [[1]], "initial": [[1], [1, 2]]}, "initial must hold 1 finite"),
        ({"A": [["a"]], "B": [[1]], "state_names": 3}, "state_names=3 is no sequence of names"),
        ({"A": [["a"]], "B": [[1]], "input_names": "u"}, "input_names='u' is no sequence of"),
        ({"A": [["a"]], "B": [[1]], "state_names": ["x", "y"]}, "must be 1 different names"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        MatrixStructure(**arguments)


def test_labels_that_disagree_are_refused():
    A = pd.DataFrame(np.eye(2), index=["x", "y"], columns=["y", "x"])
    with pytest.raises(ValueError, match=r"state names disagree: \['x', 'y'\]"):
        MatrixStructure(A, np.ones((2, 1)))


def test_theta_of_wrong_length_is_refused():
    with pytest.raises(
        ValueError, match=r"must hold 10 finite numbers, one for each of \['A\[0,0\]'"
    ):
        heave().matrices([1.0, 2.0])
