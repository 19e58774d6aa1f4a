"""The import graph: left never imports right (docs/developing tells why)."""

import ast
from pathlib import Path

import pytest

import sklearn_hd

ROOT = Path(sklearn_hd.__file__).parent
LAYERS = [
    {"exceptions", "_checks", "_clock", "_containers", "_guards"},
    {"algorithms"},
    {"systems", "structures"},
    {"_readings"},
    {"_frame"},
    {"_records"},
    {"_excitation", "_exported", "_fit_checks", "_residuals"},
    {"_opinion"},
    {"_model_step", "_simulators", "_identify", "_reduce", "_match"},
    {"frequency", "harmonics", "subspace", "reduction", "matching"},
    {"datasets", "design", "model_selection", "plotting"},
    {"_report"},
    {"__init__"},
]
TOPICS = [  # of algorithms; two of one row know nothing of each other
    {"linalg"},
    {"signals"},
    {"lti"},
    {"subspace", "periodic", "matching"},
    {"modes", "likelihood"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
TOPIC = {name: level for level, names in enumerate(TOPICS) for name in names}
STEPS = {"harmonics", "subspace", "reduction", "matching"}  # they never import each other
PARTS = {"_identify": "subspace", "_reduce": "reduction", "_match": "matching"}  # nor do these
ALGORITHM_LIBRARIES = {"numpy", "scipy", "slycot", "joblib", "sklearn_hd"}
STANDARD = {
    "collections", "contextlib", "dataclasses", "fractions", "functools", "itertools", "math",
    "numbers", "threading", "typing", "warnings",
}  # fmt: skip
FILES = sorted(ROOT.rglob("*.py"))


def room(path):
    """Top-level room of a file of the package."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def step(name):
    """The step that a room is, or is a part of."""
    return PARTS.get(name, name if name in STEPS else None)


def imports(path):
    """All modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the layer"
            yield node.module


@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(ROOT)) for p in FILES])
def test_left_never_imports_right(path):
    here = room(path)
    assert here in LEVEL, f"{here} has no place in the layers"
    for module in imports(path):
        parts = module.split(".")
        if parts[0] != "sklearn_hd":
            continue
        there = parts[1] if len(parts) > 1 else "__init__"
        if there != here:
            assert LEVEL[there] <= LEVEL[here], f"{here} imports {there}"
            assert step(there) in (None, step(here)) or step(here) is None, (
                f"step {here} imports {there}, of another step"
            )


ALGORITHMS = sorted((ROOT / "algorithms").rglob("*.py"))


@pytest.mark.parametrize("path", ALGORITHMS, ids=[str(p.relative_to(ROOT)) for p in ALGORITHMS])
def test_algorithms_know_neither_estimators_nor_frames(path):
    for module in imports(path):
        top = module.split(".")[0]
        assert top in ALGORITHM_LIBRARIES | STANDARD, f"{path.name} imports {module}"


@pytest.mark.parametrize("path", ALGORITHMS, ids=[str(p.relative_to(ROOT)) for p in ALGORITHMS])
def test_topics_of_algorithms_import_from_the_left_alone(path):
    here = path.relative_to(ROOT / "algorithms").parts[0].removesuffix(".py")
    for module in imports(path):
        if not module.startswith("sklearn_hd.algorithms."):
            continue
        there = module.split(".")[2]
        assert there == here or TOPIC[there] < TOPIC[here], f"{here} imports {there}"


@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(ROOT)) for p in FILES])
def test_matplotlib_stays_in_plotting_and_reports_and_nothing_else_imports_it(path):
    if room(path) not in ("plotting", "_report"):
        for module in imports(path):
            assert not module.startswith(("matplotlib", "sklearn_hd.plotting"))


def test_matplotlib_and_plotting_are_not_imported_with_the_package():
    at_once = ast.parse((ROOT / "_report" / "__init__.py").read_text(encoding="utf-8")).body
    assert not [node for node in at_once if isinstance(node, ast.Import | ast.ImportFrom)]
