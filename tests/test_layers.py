"""The import graph: left never imports right (docs/developing tells why)."""

import ast
from pathlib import Path

import pytest

import sklearn_hd

ROOT = Path(sklearn_hd.__file__).parent
LAYERS = [
    {
        "exceptions",
        "_arithmetic",
        "_validation",
        "_progress",
        "_threads",
        "_time",
        "_states",
        "_containers",
    },
    {"algorithms"},
    {"systems", "structures"},
    {"_frame"},
    {"_sampling"},
    {"_data"},
    {"_small_signal", "_fit_checks", "_sliding_inputs", "_weights", "_products_cache"},
    {"_stream", "_partition_statistics"},
    {"_partitions"},
    {"_subspace_checks"},
    {"_more_rows", "_streamed_fit", "_partitioned_fit", "_innovation_model"},
    {"_base"},
    {"_continuous"},
    {"_raw_modes", "_mode_choice"},
    {"_periodic"},
    {"_match"},
    {"_free_response"},
    {"_input_problem"},
    {"_realization"},
    {"_norm_matching", "_refinement"},
    {"_match_warnings"},
    {"harmonics", "subspace", "reduction", "matching"},
    {"datasets", "model_selection", "plotting"},
    {"__init__"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
ALONE = {"harmonics", "subspace", "reduction", "matching"}  # the steps never import each other
ALGORITHM_LIBRARIES = {"numpy", "scipy", "slycot", "clarabel", "joblib", "sklearn_hd"}
STANDARD = {
    "collections", "contextlib", "dataclasses", "functools", "itertools", "math", "numbers",
    "threading", "typing", "warnings",
}  # fmt: skip
FILES = sorted(ROOT.rglob("*.py"))


def room(path):
    """Top-level room of a file of the package."""
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


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
        if there == here:
            assert here not in ALONE
            continue
        assert LEVEL[there] <= LEVEL[here], f"{here} imports {there}"
        assert not (here in ALONE and there in ALONE), f"step {here} imports step {there}"


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
