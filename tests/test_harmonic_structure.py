"""HarmonicStructure: a linear time-periodic system of which some coefficients are parameters."""

import copy
import pickle

import joblib
import numpy as np
import pandas as pd
import pytest
from conftest import heave_pipeline
from periodic_cases import mathieu, record, synchronous
from sklearn.base import clone
from sklearn.pipeline import Pipeline

from sklearn_hd import HarmonicAnalyzer, HarmonicStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd._match import PeriodicModel
from sklearn_hd._readings import SlidingBasis
from sklearn_hd.algorithms.signals.fourier import harmonic_functions

STATES, INPUTS = ("x", "v"), ("u",)
OSCILLATOR = {
    "F": {"0": [[0, 1], ["-a", "-d"]], "1c": [[0, 0], ["q", 0]]},
    "G": {"1s": [[0], ["2*q"]]},
}


def oscillator():
    return HarmonicStructure(**copy.deepcopy(OSCILLATOR))


# ---- what it stands for ------------------------------------------------------------------------


def test_numbers_of_harmonics_leave_every_entry_free():
    structure = HarmonicStructure(F=1, G=0)
    names = structure.parameter_names(STATES, INPUTS)
    assert len(names) == 3 * 4 + 2
    assert names[:2] == ("F[x,x]_0", "F[x,v]_0")
    assert names[-1] == "G[v,u]_0"
    assert "F[v,x]_1s" in names


@pytest.mark.parametrize(("F", "G"), [(0, 0), (2, 1), (1, 3)])
def test_coefficients_are_affine_in_the_parameters(F, G, rng):
    resolved = HarmonicStructure(F=F, G=G, Q=1).resolve(STATES, INPUTS, STATES, {})
    theta = rng.standard_normal(resolved.n_parameters)
    K = max(F, G, 1)
    assert resolved.coefficients(theta).shape == (2 * K + 1, 4, 3)
    found = dict(zip(resolved.parameter_names, theta, strict=True))
    matrices = dict(zip("FGPQ", resolved.matrices(theta), strict=True))
    labels = ["0", *(f"{k}{c}" for k in range(1, K + 1) for c in "cs")]
    for name, value in found.items():
        head, label = name.rsplit("_", 1)
        row, column = head[2:-1].split(",")
        columns = STATES if head[0] in "FP" else INPUTS
        place = labels.index(label), STATES.index(row), columns.index(column)
        assert matrices[head[0]][place] == value
    np.testing.assert_array_equal(matrices["P"][0], np.eye(2))
    assert not matrices["P"][1:].any()


def test_entries_are_fixed_free_or_shared():
    resolved = oscillator().resolve(STATES, INPUTS, STATES, {})
    assert resolved.parameter_names == ("a", "d", "q")
    F, G, P, Q = resolved.matrices([2.0, 0.3, 0.5])
    np.testing.assert_array_equal(F, [[[0, 1], [-2, -0.3]], [[0, 0], [0.5, 0]], [[0, 0], [0, 0]]])
    np.testing.assert_array_equal(G.ravel(), [0, 0, 0, 0, 0, 1.0])
    np.testing.assert_array_equal(P[0], np.eye(2))
    assert not Q.any()
    psi = np.array([0.7])
    values = np.tensordot(harmonic_functions(psi, range(2)), F, 1)[0]
    assert values[1, 0] == pytest.approx(-2 + 0.5 * np.cos(0.7))


def test_free_entries_of_a_dict_are_named_after_their_place():
    structure = HarmonicStructure(F={"0": np.full((2, 2), np.nan), "2s": [[0, None], [0, 0]]}, G=0)
    names = structure.parameter_names(STATES, INPUTS)
    assert names[:5] == ("F[x,x]_0", "F[x,v]_0", "F[v,x]_0", "F[v,v]_0", "F[x,v]_2s")


def test_outputs_that_are_states_measure_them():
    resolved = HarmonicStructure(F=0, G=0, P=None).resolve(STATES, INPUTS, ("v", "sum"), {"P": 1})
    free = [name for name in resolved.parameter_names if name.startswith("P")]
    assert free == [f"P[sum,{state}]_{label}" for label in ("0", "1c", "1s") for state in STATES]
    P = resolved.matrices(np.zeros(resolved.n_parameters))[2]
    np.testing.assert_array_equal(P[0], [[0, 1], [0, 0]])


def test_entries_are_affine_in_the_parameters():
    structure = HarmonicStructure(
        F={"0": [[0, 1], ["-(a + b)/2", "0.5 - d"]], "1c": [[0, 0], ["a - b", "d"]]}, G=0
    )
    resolved = structure.resolve(STATES, INPUTS, STATES, {})
    assert resolved.parameter_names[:3] == ("a", "b", "d")
    F, *_ = resolved.matrices([3.0, 1.0, 0.25, 0.0, 0.0])
    np.testing.assert_array_equal(F[:2], [[[0, 1], [-2, 0.25]], [[0, 0], [2.0, 0.25]]])


def test_parameters_that_no_entry_tells_apart_are_refused():
    structure = HarmonicStructure(F={"0": [["a + b"]], "1c": [["2*b + 2*a"]]}, G=0)
    message = r"determine only combinations of \['a', 'b'\]; give each its own entry, or fix"
    with pytest.raises(ValueError, match=message):
        structure.parameter_names(["x"], ["u"])
    assert structure.fix({"b": 1.0}).parameter_names(["x"], ["u"]) == ("a", "G[x,u]_0")


def test_the_heave_decomposition_has_eight_parameters_in_A():
    """w_0, phi_dot_1c, phi_dot_1s: nine entries, but ω is known and the mean damping of the flap
    stands on the diagonal twice; and one input matrix of harmonic 0 stands in B."""
    omega, names = 165.0, ("w", "phi_dot")
    kept = (("U", (0,)),), (("w", (0,)), ("phi_dot", (1,)))
    basis = SlidingBasis(omega, 2 * np.pi / omega / 64, 64, "boxcar", 8, *kept)
    full = HarmonicStructure(F=2, G=1).resolve(names, ("U",), names, {})
    zero = np.zeros(full.n_parameters)
    periodic = PeriodicModel(full.coefficients(zero), omega, names, ("U",), names)
    affine, _ = periodic.decomposed_structure(full, basis)
    in_A = affine.basis[:, :3, :3].reshape(affine.n_parameters, -1)
    moving = [name for name, rate in zip(affine.parameter_names, in_A, strict=True) if rate.any()]
    assert moving == [
        "F[w,w]_0",
        "F[phi_dot,phi_dot]_0",
        "F[w,phi_dot]_1c",
        "F[phi_dot,w]_1c",
        "F[w,phi_dot]_1s",
        "F[phi_dot,w]_1s",
        "F[phi_dot,phi_dot]_2c",
        "F[phi_dot,phi_dot]_2s",
    ]
    assert np.linalg.matrix_rank(in_A) == 8
    np.testing.assert_array_equal(
        affine.constant[:3, :3], [[0, 0, 0], [0, 0, -omega], [0, omega, 0]]
    )
    A = affine.matrices(np.random.default_rng(0).standard_normal(affine.n_parameters))[0]
    assert A[2, 1] - A[1, 2] == pytest.approx(2 * omega, rel=1e-12)


# ---- parameters that are known -------------------------------------------------------------------


def test_fixed_parameters_become_numbers():
    fixed = HarmonicStructure(**OSCILLATOR, fixed={"a": 2.0, "q": 0.5})
    resolved = fixed.resolve(STATES, INPUTS, STATES, {})
    assert resolved.parameter_names == ("d",)
    free = oscillator().resolve(STATES, INPUTS, STATES, {})
    np.testing.assert_array_equal(resolved.coefficients([0.3]), free.coefficients([2.0, 0.3, 0.5]))
    assert oscillator().fix({"a": 2.0}).fix({"q": 0.5}) == fixed
    assert fixed.free() == oscillator()
    assert fixed.free(["q"]).fixed == {"a": 2.0}
    assert fixed != oscillator()


def test_entries_are_fixed_by_their_place():
    structure = HarmonicStructure(F=1, G=0).fix({"F[x,v]_0": 1.0, "F[x,x]_1s": 0.0})
    resolved = structure.resolve(STATES, INPUTS, STATES, {})
    assert resolved.n_parameters == 3 * 4 + 2 - 2
    assert resolved.matrices(np.zeros(12))[0][0, 0, 1] == 1.0
    assert structure.given_entries() == ["F"]


FIXED = {
    "list": ({"fixed": [1]}, r"fixed=\[1\] is not a mapping by name"),
    "text": ({"fixed": {"a": "b"}}, r"fixed value of 'a' must be a finite number; got 'b'"),
    "unknown": (
        {"fixed": {"x": 1}},
        r"fixed names 'x', which is not a parameter; give one of \['a', 'd', 'q'",
    ),
    "left to the data": (
        {"F": None, "fixed": {"F[x,x]_0": 1}},
        r"fixed names 'F\[x,x\]_0', but F=None does not include it; give F harmonic 0, as a number",
    ),
    "higher harmonic": (
        {"F": 1, "fixed": {"F[x,x]_2c": 1}},
        r"fixed names 'F\[x,x\]_2c', but F=1 does not include it; give F harmonic 2",
    ),
    "not in the dict": (
        {"fixed": {"F[x,x]_1s": 1}},
        r"'F\[x,x\]_1s', but F=\{0, 1c\} does not include it",
    ),
    "zero": ({"fixed": {"Q[x,u]_0": 1}}, r"'Q\[x,u\]_0', but Q=None does not include it"),
}


@pytest.mark.parametrize("case", FIXED)
def test_names_that_cannot_be_fixed_are_refused(case):
    arguments, message = FIXED[case]
    with pytest.raises(ValueError, match=message):
        HarmonicStructure(**{**OSCILLATOR, **arguments})


def test_names_of_other_signals_cannot_be_fixed():
    for name in ("F[x,w]_0", "F[x,v]_0"):  # no such state; a number
        structure = HarmonicStructure(**{**OSCILLATOR, "G": 0}, fixed={name: 1.0})
        with pytest.raises(
            ValueError, match=r"fixed names \['F\[x,.\]_0'\], which are not parameters here"
        ):
            structure.parameter_names(STATES, INPUTS)


def test_wrong_uses_of_fix_and_free_are_refused():
    structure = oscillator().fix({"a": 2.0})
    with pytest.raises(
        ValueError, match=r"'a' is fixed at 2 already and cannot be 3 too; free\(\['a"
    ):
        structure.fix({"a": 3.0})
    with pytest.raises(ValueError, match=r"fix names 'x', which is not a parameter"):
        structure.fix({"x": 3.0})
    with pytest.raises(ValueError, match=r"\['q'\] are not fixed, so cannot be freed; .* \['a'\]"):
        structure.free(["q"])


def test_what_is_known_beforehand():
    structure = oscillator()
    assert structure.n_states == 2
    assert HarmonicStructure().n_states is None
    assert HarmonicStructure(states=["a", "b", "c"]).n_states == 3
    assert [structure.n_harmonics(name) for name in "FGPQ"] == [1, 1, None, None]
    assert structure.given_entries() == ["F", "G"]
    assert HarmonicStructure(F=3).n_harmonics("F") == 3


# ---- a parameter like any other ------------------------------------------------------------------


def test_equality_hash_pickle_clone_and_copies():
    one, other = oscillator(), oscillator()
    assert one == other
    assert hash(one) == hash(other)
    assert joblib.hash(one) == joblib.hash(pickle.loads(pickle.dumps(one)))
    for twin in (pickle.loads(pickle.dumps(one)), copy.deepcopy(one)):
        assert twin == one
    assert clone(StructuredMatcher(structure=one)).structure == one
    different = [
        HarmonicStructure(),
        HarmonicStructure(F=1),
        HarmonicStructure(states=STATES),
        HarmonicStructure(F=OSCILLATOR["F"]),
        one.fix({"a": 1.0}),
        one.fix({"a": 2.0}),
        HarmonicStructure(F={"0": pd.DataFrame([["a"]], ["x"], ["x"])}),
        HarmonicStructure(F={"0": pd.DataFrame([["a"]], ["y"], ["y"])}),
    ]
    assert len(set(different)) == len(different)
    assert all(one != each for each in different)
    assert one != "F"
    assert HarmonicStructure(F={"0": [[np.nan]]}) == HarmonicStructure(F={"0": [[np.nan]]})


def test_what_was_given_may_change_afterwards():
    F = {"0": np.array([[np.nan]])}
    structure = HarmonicStructure(F=F, G=0)
    F["0"][0, 0], F["1c"] = 3.0, [[1.0]]
    assert structure.parameter_names(["x"], ["u"]) == ("F[x,x]_0", "G[x,u]_0")


def test_repr_shows_what_is_given():
    assert repr(HarmonicStructure()) == "HarmonicStructure()"
    assert repr(oscillator()) == "HarmonicStructure(F={0, 1c}, G={1s})"
    assert repr(HarmonicStructure(F=4, states=["w"])) == "HarmonicStructure(F=4, states=['w'])"
    assert repr(oscillator().fix({"a": 2})).endswith("G={1s}, fixed={'a': 2.0})")


def test_text_and_html_show_what_is_given():
    structure = HarmonicStructure(**OSCILLATOR, P=1, states=["x", "<v>"], fixed={"a": 2.5})
    lines = [
        "F_0 = [    0   1 ]",
        "      [ -2.5  -d ]",
        "F_1c = [ 0  0 ]",
        "       [ q  0 ]",
        "G_1s = [   0 ]",
        "       [ 2*q ]",
        "P: 1 harmonic, every entry free",
        "Q: zero, unless the data show a feedthrough",
        "a = 2.5, fixed",
    ]
    assert str(structure).splitlines() == lines
    html = structure._repr_html_()
    for part in ("<i>F</i><sub>0</sub>", "<sub>1s</sub>", ">-d</td>", ">2*q</td>", ">&lt;v&gt;<"):
        assert part in html
    for line in lines[-3:]:
        assert f"<div>{line}</div>" in html
    assert html.count("font-weight:bold") == 3  # d, q and 2*q
    assert "<v>" not in html
    assert str(HarmonicStructure()).splitlines()[0] == "F: the data decide how many harmonics"


def test_labels_of_dataframes_are_the_names_of_the_signals():
    F = pd.DataFrame(np.nan, STATES, STATES)
    assert HarmonicStructure(F={"0": F}, G=0).parameter_names(STATES, INPUTS)[0] == "F[x,x]_0"
    plain = pd.DataFrame(F.to_numpy())
    assert HarmonicStructure(F={"0": plain}, G=0).parameter_names(STATES, INPUTS)[0] == "F[x,x]_0"
    for wrong in (F[["v", "x"]], F.rename(index={"v": "w"})):
        with pytest.raises(ValueError, match=r"F_0 is labelled \[.*\], but the signals are \['x'"):
            HarmonicStructure(F={"0": wrong}, G=0).parameter_names(STATES, INPUTS)


WRONG = {
    "negative": ({"F": -1}, r"F=-1 is not understood; give a number of harmonics, a dict"),
    "fraction": ({"G": 1.5}, r"G=1\.5 is not understood"),
    "bool": ({"F": True}, r"F=True is not understood"),
    "empty": ({"F": {}}, r"F=\{\} is not understood"),
    "text": ({"P": "free"}, r"P='free' is not understood"),
    "too many": ({"F": 10**9}, r"harmonic 1000000000 of F is beyond 10000, more than any record"),
    "label beyond": ({"G": {"123456789c": [[1]]}}, r"harmonic 123456789 of G is beyond 10000"),
    "label": ({"F": {"c1": [[1]]}}, r"'c1' is not a label of F; labels are '0', '1c', '1s'"),
    "label 0c": ({"F": {"0c": [[1]]}}, r"'0c' is not a label of F"),
    "label number": ({"F": {0: [[1]]}}, r"0 is not a label of F"),
    "not square": ({"F": {"0": [[1, 2]]}}, r"F have shape \(1, 2\); with 1 states F must have 1"),
    "no matrix": ({"F": {"0": [1, 2]}}, r"F_0 must be a matrix, rows of equal"),
    "ragged": ({"F": {"0": [[1, 2], [3]]}}, r"F_0 must be a matrix, rows of equal"),
    "shapes": ({"F": {"0": [[1]], "1c": [[1, 2], [3, 4]]}}, r"coefficients of F differ in shape"),
    "states a number": ({"states": 5}, r"states=5 is not a sequence of names; give a list such as"),
    "states a text": ({"states": "w"}, r"states='w' is not a sequence of names"),
    "columns of F": ({"F": {"0": [[1, 2]]}}, r"\(1, 2\); with 1 states F must have 1 columns"),
    "rows of G": ({"F": {"0": [[1]]}, "G": {"0": [[1], [2]]}}, r"with 1 states G must have 1 rows"),
    "columns of P": (
        {"F": {"0": [[1]]}, "P": {"0": [[1, 2]]}},
        r"with 1 states P must have 1 columns",
    ),
    "states twice": ({"states": ["a", "a"]}, r"states=\['a', 'a'\] must be different outputs"),
    "states and F": (
        {"states": ["a", "b"], "F": {"0": [[1]]}},
        r"F has 1 states, but states=.* names 2",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_not_understood_is_refused(case):
    arguments, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        HarmonicStructure(**arguments)


@pytest.mark.parametrize("entry", ["1a", "k+", "a*b", 1j, np.inf])
def test_entries_that_are_none_are_refused(entry):
    with pytest.raises(
        ValueError, match=r"F\[0,0\]_1c = .* (is not an entry|is not understood|multiplies by)"
    ):
        HarmonicStructure(F={"1c": [[entry]]}, G=0)


def test_shapes_must_fit_the_signals():
    with pytest.raises(ValueError, match=r"G have shape \(2, 1\), but 2 x 2 are needed for"):
        oscillator().parameter_names(STATES, ("u1", "u2"))


# ---- on the sliding analyzer ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def heave(lti_signal):
    steps = heave_pipeline(lti_signal.omega).steps
    matcher = StructuredMatcher(structure=HarmonicStructure())
    return Pipeline([*steps, ("match", matcher)]).fit(lti_signal.inputs, lti_signal.outputs)


def test_the_heave_matrix_has_eight_free_parameters(heave, lti_signal):
    """ω is known, and what stands twice is one parameter."""
    match = heave["match"]
    in_A = [name for name in match.theta_.index[match.theta_ != 0] if name.startswith("F")]
    assert in_A == [
        "F[w,w]_0",
        "F[phi_dot,phi_dot]_0",
        "F[w,phi_dot]_1c",
        "F[phi_dot,w]_1c",
        "F[w,phi_dot]_1s",
        "F[phi_dot,w]_1s",
        "F[phi_dot,phi_dot]_2c",
        "F[phi_dot,phi_dot]_2s",
    ]
    A, exact = match.system_.A, lti_signal.A_exact.to_numpy()
    assert np.linalg.norm(A - exact) <= 1e-8 * np.linalg.norm(exact)
    assert A[1, 2] - A[2, 1] == pytest.approx(-2 * lti_signal.omega, rel=1e-12)
    assert match.hinf_error_relative_ < 1e-6
    assert np.isnan(match.theta_std_).all()


def test_the_periodic_model_of_the_match_predicts(heave, lti_signal):
    assert heave["match"].ltp_.state_names == ("w", "phi_dot")
    assert heave.score(lti_signal.inputs, lti_signal.outputs) > 0.99


def test_states_of_a_decomposition_are_all_its_outputs(lti_signal):
    steps = heave_pipeline(lti_signal.omega).steps
    matcher = StructuredMatcher(structure=HarmonicStructure(states=["w"]))
    with pytest.raises(ValueError, match=r"states=\['w'\] are not the outputs \['w', 'phi_dot'\]"):
        Pipeline([*steps, ("match", matcher)]).fit(lti_signal.inputs, lti_signal.outputs)


# ---- wrong uses ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data():
    return record(mathieu(), n_periods=30)


USES = {
    "states": (
        HarmonicStructure(states=["y", "q"]),
        r"must be 2 of the outputs .* \['q'\] are not",
    ),
    "too few states": (HarmonicStructure(states=["y"]), r"structure has 1 states, .* model has 2"),
    "too many states": (
        HarmonicStructure(F={"0": np.full((3, 3), np.nan)}),
        r"structure has 3 states, but the identified model has 2; .* MOESPRegressor\(order=3\)",
    ),
    "inputs": (HarmonicStructure(G={"0": [[0, 1], [1, 0]]}), r"G have shape \(2, 2\), but 2 x 1"),
    "text": ("ltp", r"structure='ltp' is not understood; give a MatrixStructure, a Harmonic"),
}


@pytest.mark.parametrize("case", USES)
def test_structures_that_do_not_fit_are_refused(case, data):
    structure, message = USES[case]
    with pytest.raises(ValueError, match=message):
        synchronous(2.0, structure).fit(*data)


FULL = HarmonicStructure(F={"0": [[0, 1], ["-a", "-d"]], "1c": [[0, 0], ["q", 0]]}, G=0)


@pytest.mark.parametrize("criterion", ["hinf", "output_error"])
@pytest.mark.slow
def test_fixed_parameters_are_held_period_by_period(criterion, data):
    """Either fixing is right here, so that the others come out as they are."""
    entries = {"F[y,y]_0": 0.0, "F[y,v]_0": 1.0, "F[v,v]_0": -0.2}
    for structure, truth in (
        (FULL.fix({"a": 2.0, "G[y,u1]_0": 0.0}), {"d": 0.2, "q": 1.0, "G[v,u1]_0": 1.0}),
        (HarmonicStructure(F=1, G=0).fix(entries), {"F[v,y]_0": -2.0, "F[v,y]_1c": 1.0}),
    ):
        match = synchronous(2.0, structure, criterion=criterion).fit(*data)["match"]
        assert match.theta_[list(truth)].to_dict() == pytest.approx(truth, rel=1e-6)
        assert not match.theta_.index.isin(structure.fixed).any()
        np.testing.assert_array_equal(match.ltp_.F.coefficients[0, 0], [0.0, 1.0])


@pytest.mark.parametrize(
    "structure",
    [
        HarmonicStructure(F={"0": [[0, 1], ["-a", "-d"]]}),
        HarmonicStructure(F=1, fixed={"F[y,y]_0": 0.0}),
    ],
    ids=["entries", "fixed"],
)
def test_known_entries_need_outputs_that_determine_the_state(structure, data):
    u, y = data
    with pytest.raises(ValueError, match=r"\['y'\] do not determine the 2 states .* entries of F"):
        synchronous(2.0, structure).fit(u, y[["y"]])


def test_a_harmonic_structure_needs_a_frequency():
    u = np.random.default_rng(0).standard_normal((200, 1))
    y = np.convolve(u[:, 0], [0.0, 1.0, 0.5])[:200]
    matcher = StructuredMatcher(MOESPRegressor(order=1, block_rows=5), structure=oscillator())
    with pytest.raises(ValueError, match=r"needs the fundamental frequency, .* HarmonicAnalyzer"):
        matcher.fit(u, y)


def test_only_maximum_likelihood_has_deviations(data):
    match = synchronous(2.0).fit(*data)["match"]
    assert np.isnan(match.theta_std_).all()
    for name in ("covariance_", "noise_std_", "eigenvalues_"):
        with pytest.raises(AttributeError, match=f"{name} exists only after maximum likelihood"):
            getattr(match, name)
    with pytest.raises(AttributeError, match="confidence_interval exists only after maximum"):
        match.confidence_interval()
    with pytest.raises(AttributeError, match="frequency_response exists only after maximum"):
        match.frequency_response([1.0])
    for level in (0.0, 1.0, 95):
        with pytest.raises(
            ValueError, match=f"level must be a number between 0 and 1, got {level}; it"
        ):
            match.confidence_interval(level)


def test_criterion_and_structure_are_checked(data):
    with pytest.raises(ValueError, match=r"criterion='ml' is not known; use one of 'hinf'"):
        synchronous(2.0, criterion="ml").fit(*data)
    sliding = Pipeline([
        ("harmonics", HarmonicAnalyzer(2.0, output_harmonics=1, reading="sliding")),
        ("identify", MOESPRegressor(order=4)),
        ("match", StructuredMatcher(criterion="output_error")),
    ])  # fmt: skip
    with pytest.raises(ValueError, match=r"needs a structure whose parameters the record determ"):
        sliding.fit(*data)


def test_a_structure_without_parameters_is_refused_through_a_window_too():
    """There is nothing to match, whichever route is taken."""
    t = pd.Index(np.arange(640) / 16, name="time")
    u = pd.DataFrame({"u": np.repeat(np.random.default_rng(0).standard_normal(40), 16)}, t)
    y = pd.DataFrame({"x": np.convolve(u["u"], 0.9 ** np.arange(60))[:640]}, t)
    analyzer = HarmonicAnalyzer(2 * np.pi, output_harmonics=0, reading="sliding")
    frame = analyzer.fit(u, y).transform(u)
    fixed = HarmonicStructure(F={"0": [[-0.5]]}, G={"0": [[1.0]]})
    match = StructuredMatcher(MOESPRegressor(2), structure=fixed)
    with pytest.raises(ValueError, match="the structure has no free parameter"):
        match.fit(frame, y)
