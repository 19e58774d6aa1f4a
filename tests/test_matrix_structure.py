"""MatrixStructure: what cells mean, how entries are named and shared, what is refused."""

import copy
import pickle
from html.parser import HTMLParser

import joblib
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


# ---- what is known of parameters by name -------------------------------------------------------


def oscillator(**known):
    return MatrixStructure([["-d", "w"], ["-w", "-d"]], [["b"], [0]], C=[[1, "c - d"]], **known)


def test_fixed_parameters_become_numbers():
    structure = oscillator(fixed={"d": 0.5})
    assert structure.parameter_names == ("w", "b", "c")
    assert structure.n_parameters == 3
    A, B, C, _ = structure.matrices([2.0, 3.0, 4.0])
    np.testing.assert_array_equal(A, [[-0.5, 2.0], [-2.0, -0.5]])
    np.testing.assert_array_equal(C, [[1.0, 3.5]])
    free = oscillator()
    for one, other in zip((A, B, C), free.matrices([0.5, 2.0, 3.0, 4.0]), strict=False):
        np.testing.assert_array_equal(one, other)


def test_fix_and_free_are_inverse():
    free = oscillator(initial=[1.0, 2.0, 3.0, 4.0], bounds={"d": (0, 5), "w": (None, 9.0)})
    fixed = free.fix({"d": 0.5}).fix(pd.Series({"c": 2.0}))
    assert fixed.fixed == {"d": 0.5, "c": 2.0}
    assert fixed.parameter_names == ("w", "b")
    np.testing.assert_array_equal(fixed.initial, [2.0, 3.0])
    np.testing.assert_array_equal(fixed.upper, [9.0, np.inf])
    back = fixed.free()
    np.testing.assert_array_equal(back.initial, [0.5, 2.0, 3.0, 2.0])  # from where they stood
    assert back.bounds == free.bounds
    assert oscillator().fix({"d": 1.0}).free(["d"]) == oscillator()
    assert free.fix({"d": 1.0}).free(["d"]) == free
    assert free.fixed == {}
    assert fixed.free(["c"]).parameter_names == ("w", "b", "c")


def test_everything_may_be_fixed():
    values = {"d": 1.0, "w": 2.0, "b": 3.0, "c": 4.0}
    for start in (None, values):
        structure = oscillator(initial=start).fix(values)
        assert structure.parameter_names == ()
        assert structure.matrices([])[0].tolist() == [[-1.0, 2.0], [-2.0, -1.0]]


def test_fixing_an_entry_by_its_place():
    structure = heave().fix({"A[0,1]": 0.0})
    assert structure.n_parameters == 9
    assert structure.affine.n_parameters == 9
    assert structure == heave().fix({"A[0,1]": -0.0})


def test_bounds_are_in_the_order_of_the_parameters():
    structure = oscillator(
        bounds={"c": [-1, 1], "d": (0, None), "b": (None, None), "w": (-np.inf, 2)}
    )
    np.testing.assert_array_equal(structure.lower, [0.0, -np.inf, -np.inf, -1.0])
    np.testing.assert_array_equal(structure.upper, [np.inf, 2.0, np.inf, 1.0])
    assert structure.bounds == {"c": (-1.0, 1.0), "d": (0.0, None), "w": (None, 2.0)}
    assert oscillator(bounds=structure.bounds) == structure
    np.testing.assert_array_equal(oscillator().lower, [-np.inf] * 4)
    np.testing.assert_array_equal(structure.fix({"d": 1}).lower, [-np.inf, -np.inf, -1.0])


def test_initial_values_beside_fixed_ones():
    given = {"w": 2.0, "b": 3.0, "c": 4.0}
    for initial in (given, {**given, "d": 0.5}, [2.0, 3.0, 4.0]):
        structure = oscillator(initial=initial, fixed={"d": 0.5})
        np.testing.assert_array_equal(structure.initial, [2.0, 3.0, 4.0])


KNOWN = {
    "unknown fixed": (
        {"fixed": {"x": 1}},
        r"fixed names \['x'\], which are not parameters here; allowed are",
    ),
    "unknown bounds": (
        {"bounds": {"x": (0, 1)}},
        r"bounds names \['x'\], which are not parameters here",
    ),
    "fixed a list": ({"fixed": [1.0]}, r"fixed=\[1.0\] is not a mapping by name; give one such as"),
    "bounds a pair": (
        {"bounds": (0, 1)},
        r"bounds=\(0, 1\) is not a mapping by name; .* \{'k': \(0",
    ),
    "fixed a text": ({"fixed": {"d": "1"}}, r"fixed value of 'd' must be a finite number; got '1'"),
    "fixed too large": ({"fixed": {"d": 10**400}}, r"fixed value of 'd' must be a finite number"),
    "bounds too large": ({"bounds": {"d": (0, 10**400)}}, r"give \(low, high\) with low < high"),
    "fixed NaN": ({"fixed": {"d": np.nan}}, r"fixed value of 'd' must be a finite number; got nan"),
    "fixed twice": (
        {"fixed": pd.Series([1.0, 2.0], index=["d", "d"])},
        r"fixed names \['d'\] more than once; give every name one value",
    ),
    "low above high": (
        {"bounds": {"d": (2, 1)}},
        r"bounds of 'd' are \(2, 1\); give .* low < high",
    ),
    "one point": ({"bounds": {"d": (1, 1)}}, r"use fixed for a single value"),
    "bounds NaN": ({"bounds": {"d": (np.nan, 1)}}, r"bounds of 'd' are \(nan, 1\)"),
    "three bounds": ({"bounds": {"d": (0, 1, 2)}}, r"bounds of 'd' are \(0, 1, 2\)"),
    "bounds a number": ({"bounds": {"d": 3}}, r"bounds of 'd' are 3; give \(low, high\)"),
    "bounds texts": ({"bounds": {"d": ("0", "1")}}, r"bounds of 'd' are \('0', '1'\)"),
    "bounds at infinity": ({"bounds": {"d": (np.inf, None)}}, r"bounds of 'd' are \(inf, None\)"),
    "start outside": (
        {"initial": [1.0, 2.0, 3.0, 4.0], "bounds": {"w": (None, 1.5)}},
        r"the initial value 2 of 'w' is outside its bounds \(None, 1.5\); change one of them",
    ),
    "fixed outside": (
        {"fixed": {"d": -1.0}, "bounds": {"d": (0, None)}},
        r"the fixed value -1 of 'd' is outside its bounds \(0.0, None\); change one of them",
    ),
    "fixed elsewhere": (
        {"fixed": {"d": 1.0}, "initial": {"d": 2.0, "w": 2.0, "b": 3.0, "c": 4.0}},
        r"initial gives 'd' the value 2, but it is fixed at 1; leave it out of one of the two",
    ),
    "start of some": ({"initial": {"w": 2.0}}, r"missing \['d', 'b', 'c'\], unknown \[\], allowed"),
}


@pytest.mark.parametrize("case", KNOWN)
def test_contradictions_are_refused(case):
    arguments, message = KNOWN[case]
    with pytest.raises(ValueError, match=message):
        oscillator(**arguments)


def test_wrong_uses_of_fix_and_free_are_refused():
    structure = oscillator(fixed={"d": 0.5}, bounds={"w": (0, 9)})
    with pytest.raises(ValueError, match=r"'d' is fixed at 0.5 already and cannot be 1 too; free"):
        structure.fix({"d": 1.0})
    assert structure.fix({"d": 0.5}) == structure
    with pytest.raises(
        ValueError, match=r"fix names \['x'\], which are not parameters here; allowed are \['d'"
    ):
        structure.fix({"x": 1.0})
    with pytest.raises(ValueError, match=r"fixed=\[1.0\] is not a mapping by name; give one such"):
        structure.fix([1.0])
    with pytest.raises(ValueError, match=r"the fixed value 10 of 'w' is outside its bounds"):
        structure.fix({"w": 10.0})
    with pytest.raises(ValueError, match=r"\['w'\] are not fixed, so cannot be freed; fixed are"):
        structure.free(["w"])
    with pytest.raises(ValueError, match=r"free\('d'\): give a list of names, such as \['k'\]"):
        structure.free("d")


# ---- a parameter like any other ----------------------------------------------------------------


def test_equality_hash_pickle_and_copies():
    known = {"initial": [1.0, 2.0, 3.0], "bounds": {"w": (0, None)}, "fixed": {"d": 0.5}}
    for make in (heave, lambda: oscillator(**known)):
        structure = make()
        for twin in (make(), pickle.loads(pickle.dumps(structure)), copy.deepcopy(structure)):
            assert twin == structure
            assert hash(twin) == hash(structure)
            assert joblib.hash(twin) == joblib.hash(structure)
    assert structure != MatrixStructure(np.full((3, 3), NAN), [[0.0], [1.0], [0.0]])
    assert structure != "heave"
    assert MatrixStructure([["a"]], [[1.0]]) != MatrixStructure([["a"]], [[1.0]], initial=[1.0])
    different = [oscillator(), oscillator(**known | {"bounds": None})]
    different += [oscillator(fixed={"d": 0.5}), oscillator(fixed={"d": 0.6}), oscillator(**known)]
    assert len(set(different)) == len(different)
    order = {"d": 1.0, "w": 2.0}, {"w": 2.0, "d": 1.0}
    assert len({oscillator(fixed=fixed) for fixed in order}) == 1
    scales = MatrixStructure([["2.00000001*k"]], [[1]]), MatrixStructure([["2*k"]], [[1]])
    assert scales[0] != scales[1]


def test_use_does_not_change_the_hash():
    """A pipeline's cache would take a structure that has been fitted for another one."""
    structure = oscillator()
    before = joblib.hash(structure)
    structure.affine.response_and_sensitivity([1.0, 2.0, 3.0, 4.0], [1j])
    assert joblib.hash(structure) == before


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
    structure = MatrixStructure([["-k", 2.0], [0.0, NAN]], [[0.0], ["1 - 2*k + b"]])
    assert repr(structure) == (
        "MatrixStructure(2 states, 1 inputs, 2 outputs, parameters=['k', 'A[1,1]', 'b'])"
    )
    assert str(structure).splitlines() == [
        "A = [ -k       2 ]",
        "    [  0  A[1,1] ]",
        "B = [           0 ]",
        "    [ 1 - 2*k + b ]",
        "C = [ 1  0 ]",
        "    [ 0  1 ]",
        "D = [ 0 ]",
        "    [ 0 ]",
    ]


def test_repr_and_str_show_what_is_known():
    structure = oscillator(
        fixed={"c": 2}, bounds={"d": (0, 5), "w": (None, 9)}, initial=[1, 1e-4, 3]
    )
    assert repr(structure).endswith(
        "parameters=['d', 'w', 'b'], bounds={'d': (0.0, 5.0), 'w': (None, 9.0)}, fixed={'c': 2.0})"
    )
    assert str(structure).splitlines()[4:] == [
        "C = [ 1  2 - d ]",
        "D = [ 0 ]",
        "0 <= d <= 5, initial 1",
        "w <= 9, initial 0.0001",
        "b, initial 3",
        "c = 2, fixed",
    ]


class Cells(HTMLParser):
    """Texts of a page by tag, cells that stand out apart."""

    def __init__(self, html):
        super().__init__()
        self.found, self.open = {}, []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append((tag, "bold" in dict(attrs).get("style", "")))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        self.found.setdefault(self.open[-1], []).append(data)


def test_html_shows_names_and_lets_free_entries_stand_out():
    states = ["w_0", "<b>&"]
    A = pd.DataFrame([["-k", 2.5], ["k", NAN]], states, states)
    structure = MatrixStructure(A, [[0], [1]], input_names=["U"], bounds={"k": (0, None)})
    found = Cells(structure._repr_html_()).found
    assert found["i", False] == ["A", "B", "C", "D"]
    assert found["td", True] == ["-k", "k", "A[<b>&,<b>&]"]
    assert found["td", False][:3] == ["2.5", "0", "1"]
    assert found["th", False][:4] == ["w_0", "<b>&", "w_0", "<b>&"]
    assert found["th", False][4] == "U"
    assert found["div", False] == ["0 <= k"]


def test_html_counts_what_has_no_names():
    found = Cells(MatrixStructure([["a"]], [[1, 2]])._repr_html_()).found
    assert found["th", False] == ["0", "0", "0", "1", "0", "0", "0", "0", "1", "0"]


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
            r"B has shape \(3, 1\), but .* need \(2, 1\)",
        ),
        ({"A": np.eye(2), "B": np.ones((2, 1)), "C": np.ones((1, 3))}, r"C has shape .*\(1, 2\)"),
        ({"A": np.eye(2), "B": np.ones((2, 1)), "D": [[0.0]]}, r"D has shape .*\(2, 1\)"),
        ({"A": np.ones(3), "B": [[1]]}, "A must be a matrix"),
        ({"A": [[1, 2], [3]], "B": [[1], [1]]}, "A must be a matrix"),
        ({"A": [[np.inf]], "B": [[1]]}, r"A\[0,0\] = inf is not an entry"),
        ({"A": [[1j]], "B": [[1]]}, r"is not an entry; give a finite number"),
        ({"A": [["a"]], "B": [[1]], "initial": {"b": 1.0}}, r"missing \['a'\], unknown \['b'\]"),
        ({"A": [["a"]], "B": [[1]], "initial": [1.0, 2.0]}, "initial must hold 1 finite numbers"),
        ({"A": [["a"]], "B": [[1]], "initial": [NAN]}, "initial must hold 1 finite numbers"),
        ({"A": [["a"]], "B": [[1]], "initial": ["x"]}, r"each of \['a'\]; got \['x'\]"),
        ({"A": [["a"]], "B": [[1]], "initial": [[1], [1, 2]]}, "initial must hold 1 finite"),
        ({"A": [["a"]], "B": np.zeros((1, 0))}, r"without inputs, or without outputs, there is no"),
        ({"A": [["a"]], "B": [[1]], "C": np.zeros((0, 1))}, r"C \(0, 1\): without inputs, or"),
        ({"A": [["a"]], "B": [[1]], "state_names": 3}, "state_names=3 is not a sequence of names"),
        ({"A": [["a"]], "B": [[1]], "input_names": "u"}, "input_names='u' is not a sequence of"),
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
