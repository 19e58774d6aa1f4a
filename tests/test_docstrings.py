"""Every public name says what it is, takes, returns and raises, and shows it: numpydoc's rules."""

import ast
import importlib
import inspect
import re
import textwrap
from dataclasses import is_dataclass
from functools import cached_property
from pathlib import Path

import pytest
from numpydoc.docscrape import get_doc_object
from numpydoc.validate import ERROR_MSGS, validate

PUBLIC = [
    "sklearn_hd",
    "sklearn_hd.systems",
    "sklearn_hd.datasets",
    "sklearn_hd.design",
    "sklearn_hd.structures",
    "sklearn_hd.model_selection",
    "sklearn_hd.plotting",
]
BESIDE = [  # functions of other modules that docs/api.md names
    ("sklearn_hd.algorithms.lti.hinf", "hinf_norm"),
]
EXEMPT = {
    "ES01": "the summary line is enough where it says all",
    "SA01": "links stand where they are of use, in the text",
    "EX01": "asked below of classes and functions; a method is shown by its class",
    "RT02": "what is returned has a name here, one value or several",
    "SS05": "a summary says what comes back, a noun as often as a verb",
}
ASKED = sorted(set(ERROR_MSGS) - set(EXEMPT))


def names(module):
    """What a module offers: pairs of a name and an object of ours."""
    found = importlib.import_module(module)
    return [(f"{module}.{name}", getattr(found, name)) for name in found.__all__]


def members(owner, cls):
    """Public methods, properties and constructors of a class that are defined in this package."""
    for name in dir(cls):
        home = next(base for base in cls.__mro__ if name in vars(base))
        if name.startswith("_") or not home.__module__.startswith("sklearn_hd"):
            continue
        member = vars(home)[name]
        if isinstance(member, classmethod | staticmethod):
            member = member.__func__
        if inspect.isfunction(member) or isinstance(member, property | cached_property):
            yield f"{owner}.{name}", member


TOP = dict(
    [*(pair for module in PUBLIC for pair in names(module))]
    + [(f"{m}.{n}", getattr(importlib.import_module(m), n)) for m, n in BESIDE]
)
EXCEPTIONS = {
    f"sklearn_hd.exceptions.{name}": value
    for name, value in vars(importlib.import_module("sklearn_hd.exceptions")).items()
    if inspect.isclass(value)
}
WITHIN = {
    name: member
    for owner, cls in TOP.items()
    if inspect.isclass(cls)
    for name, member in members(owner, cls)
}
ALL = {**TOP, **WITHIN, **EXCEPTIONS}


def each(objects):
    names = list(objects)
    return pytest.mark.parametrize("name", names, ids=[name.split(".", 1)[1] for name in names])


def sections(described):
    return set(re.findall(r"^(\w[\w ]*)\n-+$", inspect.getdoc(described) or "", re.MULTILINE))


def test_what_is_public_is_found():
    assert "sklearn_hd.StructuredMatcher.confidence_interval" in ALL  # from a base class
    assert "sklearn_hd.structures.MatrixStructure.affine" in ALL  # a cached property
    assert "sklearn_hd.plotting.BodeDisplay.from_systems" in ALL  # a constructor
    assert "sklearn_hd.HarmonicFrame.merge" not in ALL  # of pandas


@each(ALL)
def test_numpydoc_finds_nothing_wrong(name):
    report = validate(get_doc_object(ALL[name]))
    wrong = [f"{code}: {words}" for code, words in report["errors"] if code in ASKED]
    assert not wrong, "\n".join([name, *wrong])


@each(ALL)
def test_arrays_have_their_shape(name):
    described = get_doc_object(ALL[name])
    for section in ("Parameters", "Returns", "Attributes"):
        for entry in described[section]:
            if re.search(r"ndarray|array_like", entry.type):
                words = " ".join([entry.type, *entry.desc])
                assert re.search(r"shape|array(_like)? of (str|int|bool)", words), entry.name


@each(TOP)
def test_classes_and_functions_show_an_example_and_name_a_source(name):
    assert {"Examples", "References"} <= sections(TOP[name])
    assert ">>> " in inspect.getdoc(TOP[name])


def refuses(function):
    """Whether a function itself raises, or calls one that is there to."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(function))))
    for node in ast.walk(tree):
        if isinstance(node, ast.Raise):
            return True
        if isinstance(node, ast.Call):
            called = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if called.startswith(("check_", "_check_")):
                return True
    return False


FUNCTIONS = {name: value for name, value in {**TOP, **WITHIN}.items() if inspect.isfunction(value)}


@each(name for name, function in FUNCTIONS.items() if refuses(function))
def test_what_is_refused_is_said(name):
    owner = TOP.get(name.removesuffix(".fit"))  # what a fit refuses stands with the parameters
    assert "Raises" in sections(FUNCTIONS[name]) | (sections(owner) if owner else set())


CONSTRUCTORS = {
    name: value.__init__
    for name, value in TOP.items()
    if inspect.isclass(value) and vars(value).get("__init__") and not is_dataclass(value)
}


@each(name for name, constructor in CONSTRUCTORS.items() if refuses(constructor))
def test_what_a_constructor_refuses_is_said(name):
    assert "Raises" in sections(TOP[name])


def test_the_api_page_names_what_is_public():
    page = (Path(__file__).parents[1] / "docs" / "api.md").read_text(encoding="utf-8")
    listed = set()
    for module, names in re.findall(r"currentmodule:: (\S+)\n\n.*?\n\n(.*?)```", page, re.DOTALL):
        found = importlib.import_module(module)
        listed |= {getattr(found, name) for name in names.split()}
    assert listed == {*TOP.values(), *EXCEPTIONS.values()}
