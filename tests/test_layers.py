"""The import graph: left never imports right (docs/developing tells why)."""

import ast
from pathlib import Path

import pytest

import sklearn_hd

ROOT = Path(sklearn_hd.__file__).parent
LAYERS = [
    {"exceptions", "_arithmetic", "_validation", "_progress", "_threads", "_warn", "_tables"},
    {"algorithms"},
    {"systems", "structures"},
    {"_frame"},
    {"_records"},
    {"_continuous", "_fit_checks"},
    {"_base", "_subspace", "_reduction", "_matching"},
    {"harmonics", "subspace", "reduction", "matching"},
    {"datasets", "model_selection", "plotting"},
    {"__init__"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
STEPS = {"harmonics", "subspace", "reduction", "matching"}  # they never import each other
PARTS = {"_base", "_subspace", "_reduction", "_matching"}  # nor do their parts
ALGORITHM_LIBRARIES = {"numpy", "scipy", "slycot", "clarabel", "joblib", "sklearn_hd"}
STANDARD = {
    "collections", "contextlib", "dataclasses", "functools", "itertools", "math", "numbers",
    "threading", "typing", "warnings",
}  # fmt: skip
FILES = sorted(ROOT.rglob("*.py"))


def room(path):
    """Top-level room of a file of the package."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def step(name):
    """The step that a room is, or is a part of."""
    return name.removeprefix("_") if name.removeprefix("_") in STEPS else None


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
            assert step(there) in (None, step(here)) or here not in STEPS | PARTS, (
                f"step {here} imports {there}, of another step"
            )


@pytest.mark.parametrize("path", sorted((ROOT / "algorithms").glob("*.py")), ids=lambda p: p.stem)
def test_algorithms_know_neither_estimators_nor_frames(path):
    for module in imports(path):
        top = module.split(".")[0]
        assert top in ALGORITHM_LIBRARIES | STANDARD, f"{path.name} imports {module}"


@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(ROOT)) for p in FILES])
def test_matplotlib_stays_in_plotting_and_nothing_else_imports_it(path):
    if room(path) != "plotting":
        for module in imports(path):
            assert not module.startswith(("matplotlib", "sklearn_hd.plotting"))


@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(ROOT)) for p in FILES])
def test_one_module_alone_draws_progress_bars(path):
    if room(path) != "_progress":
        assert not any(module.startswith("tqdm") for module in imports(path))
