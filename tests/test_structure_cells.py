"""Entries of structures: what may be written in a cell, and what is refused."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sklearn_hd.structures import HarmonicStructure, MatrixStructure


def cell(text, **values):
    """Value of a text in a cell, with numbers for its parameters."""
    structure = MatrixStructure([[text]], [[1.0]])
    assert set(structure.parameter_names) == set(values)
    return structure.matrices([values[name] for name in structure.parameter_names])[0].item()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("k1 + k2", 5.0),
        ("k1+k2", 5.0),
        ("-k1 - k2", -5.0),
        ("+k1 + k2", 5.0),
        ("k1 - k2", -1.0),
        ("2*k1 - k2*3", -5.0),
        ("1.5 - 0.5*k1 + 2*k2", 6.5),
        ("(k1 + k2)/2", 2.5),
        ("-(k1 - 2*(k2 - 1))", 2.0),
        ("k1/4 + k2", 3.5),
        ("2*k1/4 + 1/2 + k2", 4.5),
        ("1e-3*k1 + k2*1.5E+2", 450.002),
        (".5*k1 + 2.*k2", 7.0),
        ("k1 + k2 + k1", 7.0),
    ],
)
def test_sums_of_numbers_and_multiples_of_parameters(text, value):
    assert cell(text, k1=2.0, k2=3.0) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    "name",
    ["k", "_k", "k_1", "lambda", "e", "e3", "None_", "λ_β", "A[w_0,phi_dot_1c]", "F[w,x]_1c", "p0"],
)
def test_names_are_free_of_pythons_words(name):
    assert cell(f"1 - 2*{name}", **{name: 3.0}) == -5.0
    assert cell(f"{name}/2 + other", **{name: 3.0, "other": 1.0}) == 2.5


def test_numbers_may_be_written_as_texts():
    structure = MatrixStructure([["1/4", " -2e1 "], ["2*(3 - 1)", "nan"]], [[0], [1]])
    assert structure.parameter_names == ("A[1,1]",)
    assert structure.matrices([0.0])[0].tolist() == [[0.25, -20.0], [4.0, 0.0]]


NUMBERS = st.floats(-9.0, 9.0).map(lambda x: round(x, 3))
EXPRESSIONS = st.recursive(
    NUMBERS.map(lambda x: (repr(x), np.array([x, 0.0, 0.0])))
    | st.sampled_from([("k1", np.array([0.0, 1.0, 0.0])), ("k2", np.array([0.0, 0.0, 1.0]))]),
    lambda parts: st.one_of(
        st.tuples(parts, parts).map(lambda p: (f"({p[0][0]} + {p[1][0]})", p[0][1] + p[1][1])),
        st.tuples(parts, parts).map(lambda p: (f"{p[0][0]} - ({p[1][0]})", p[0][1] - p[1][1])),
        st.tuples(NUMBERS, parts).map(lambda p: (f"{p[0]}*({p[1][0]})", p[0] * p[1][1])),
        parts.map(lambda p: (f"-({p[0]})/4", -p[1] / 4)),
    ),
    max_leaves=8,
)


@given(EXPRESSIONS)
def test_expressions_mean_what_they_say(expression):
    """Each is drawn along with its coefficients of 1, k1 and k2; more of both: none cancels."""
    text, expected = expression
    structure = MatrixStructure([[f"{text} + (k1 + k2)*1e3"]], [["k1 + k2"]])
    affine = structure.affine
    assert set(structure.parameter_names) == {"k1", "k2"}
    slopes = dict(zip(structure.parameter_names, affine.basis[:, 0, 0], strict=True))
    found = [affine.constant[0, 0], slopes["k1"], slopes["k2"]]
    np.testing.assert_allclose(found, np.add(expected, [0.0, 1e3, 1e3]), rtol=1e-12, atol=1e-9)


AFFINE = r"entries must be affine in the parameters"
REFUSED = {
    "k1*k2": rf"A\[0,0\] = 'k1\*k2' multiplies by 'k2'; {AFFINE}.* give the product a name",
    "k*(k + 1)": rf"multiplies by 'k'; {AFFINE}",
    "(k1 + k2)*(k1 - k2)": rf"multiplies by 'k1' and 'k2'; {AFFINE}",
    "1/k": rf"divides by 'k'; {AFFINE}.* give the quotient a name of its own",
    "k1/k1": rf"divides by 'k1'; {AFFINE}",
    "0*k": r"does not depend on 'k'; leave it out",
    "k1 + k2 - k1": r"does not depend on 'k1'; leave it out",
    "k/0": r"is not an entry: its numbers must be finite",
    "1e999*k": r"is not an entry: its numbers must be finite",
    "1/0": r"is not an entry: its numbers must be finite",
    "inf": r"A\[0,0\] = inf is not an entry; give a finite number",
    "2*nan": r"is not understood",
    "k + inf": r"is not understood",
    "2k": r"A\[0,0\] = '2k' is not understood; write numbers and parameters with \+ - \* /",
    "k1 k2": r"is not understood",
    "k+": r"is not understood",
    "(k": r"is not understood",
    "": r"is not understood; .* a name begins with a letter",
    "k**2": r"is not understood",
    "k^2": r"is not understood",
    "k.real": r"is not understood",
    "sin(k)": r"is not understood",
    "__import__('os')": r"is not understood",
    "k if 1 else 2": r"is not understood",
    "k; 1": r"is not understood",
    "k, 1": r"is not understood",
    "[k]": r"is not understood",
    "0x10": r"is not understood",
    "2j*k": r"is not understood",
    "k) + (1": r"is not understood",
    "k + \x00": r"is not understood",
    "'k'": r"is not understood",
    "-" * 100000 + "k": r"is not understood",
}


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:20])
def test_texts_that_are_no_entries_are_refused(text):
    with pytest.raises(ValueError, match=REFUSED[text]):
        MatrixStructure([[text]], [[1.0]])


@pytest.mark.parametrize(
    "value", [1j, np.inf, -np.inf, 10**400, [1.0], {}, pd.NaT, b"k"], ids=lambda x: repr(x)[:9]
)
def test_values_that_are_no_entries_are_refused(value):
    matrix = np.empty((1, 1), dtype=object)
    matrix[0, 0] = value
    with pytest.raises(ValueError, match=r"A\[0,0\] = .* is not an entry; give a finite number"):
        MatrixStructure(matrix, [[1.0]])


@pytest.mark.parametrize("missing", [None, np.nan, pd.NA, "nan", np.float32("nan")], ids=repr)
def test_what_is_missing_is_free(missing):
    assert MatrixStructure([[missing]], [[1.0]]).parameter_names == ("A[0,0]",)


def test_names_of_entries_may_be_shared():
    """An entry called after its place is a parameter like any other."""
    structure = MatrixStructure([[np.nan, 0.0], [0.0, "-A[0,0]"]], [[1.0], [1.0]])
    assert structure.parameter_names == ("A[0,0]",)
    np.testing.assert_array_equal(structure.matrices([-2.0])[0], [[-2.0, 0.0], [0.0, 2.0]])
    periodic = HarmonicStructure(F={"0": [[np.nan]], "1c": [["-F[x,x]_0/2"]]}, G=0)
    F, *_ = periodic.resolve(["x"], ["u"], ["x"], {}).matrices([3.0, 0.0])
    np.testing.assert_array_equal(F.ravel(), [3.0, -1.5, 0.0])


def test_a_name_is_not_that_of_a_known_entry():
    message = r"'A\[0,0\]' is used as the name of a parameter, but the entry at .* is 3;"
    with pytest.raises(ValueError, match=message):
        MatrixStructure([[3.0, 0.0], [0.0, "-A[0,0]"]], [[1.0], [1.0]])
    with pytest.raises(ValueError, match=r"but the entry at that place is 1 \+ A\[0,0\]"):
        MatrixStructure([["1 + A[0,0]"]], [[1.0]])
    periodic = HarmonicStructure(F={"0": [["a"]], "1c": [["F[x,x]_0"]]}, G=0)
    with pytest.raises(ValueError, match=r"'F\[x,x\]_0' is used as the name .* place is a;"):
        periodic.parameter_names(["x"], ["u"])


def test_cells_read_from_a_table_of_texts():
    """As a spreadsheet comes: mixed columns, empty cells are free."""
    A = pd.DataFrame(
        {"w": pd.array([-1.5, pd.NA], dtype="Float64"), "phi": ["k1 + k2", "-k1"]},
        index=["w", "phi"],
    )
    B = pd.DataFrame({"U": pd.array(["b", None], dtype="string")}, index=["w", "phi"])
    structure = MatrixStructure(A, B)
    assert structure.parameter_names == ("k1", "k2", "A[phi,w]", "b", "B[phi,U]")
    assert structure.matrices([1.0, 2.0, 0.0, 4.0, 0.0])[0].tolist() == [[-1.5, 3.0], [0.0, -1.0]]


def test_columns_that_merely_count_are_no_names():
    plain = pd.DataFrame([[np.nan, 1.0], [0.0, -1.0]])
    B = pd.DataFrame([["b"], [0.0]], index=["w", "phi"], columns=["U"])
    structure = MatrixStructure(plain, B)
    assert structure.state_names == ("w", "phi")
    assert structure.parameter_names == ("A[w,w]", "b")
